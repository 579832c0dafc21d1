"""What an array's gyros read in motion -> bias, scale, misalignment and mounting of each.

The reference is the array itself: the rate of an epoch is the mean of its sensors. So what is found
is relative, and a gauge says to what:

- Scale: the mean of the symmetric parts of all sensors' matrices is the identity. What all have in
  common, such as a scale that is 1 % too great on the average, no comparison can show.
- Body axes: those of the given mountings, on the average; if none are given, those of the largest
  group of sensors that are mounted alike (of equal groups, the one with the first sensor).
- Bias: the mean at rest. The earth's rotation, 0.004 deg/s, is in it, and so is any turn too slow
  and too even to be told from rest. Without rest, the biases' mean in the body frame is zero.

The model is that of `TriadCalibration`, w = A_i (u - b_i), with any A_i, split afterwards into
rotation, misalignment and scale. Given the rates w it is linear: y_i = (I + E_i) w + e_i for
y_i = A_i (u - b_i); given the A_i, w is the mean of the y_i. The two steps alternate until nothing
moves. That w is noisy does no harm: the residual d_i = y_i - w has no correlation with the noise of
w, if all sensors are equally good.

How much an epoch counts
------------------------
Sensors may sample by clocks of their own. At an angular acceleration a, one that is late by t is
off by t a: in violent motion far more than its noise, and along one direction. So each epoch is
weighed by the inverse of its own covariance, C = S / (NU + n - 1), S = NU s^2 I + sum d d^T: what
its residuals say, and isotropic noise s^2 as if `NU` sensors had said so; 1/s^2 is the mean
eigenvalue of all inverses. This is expectation maximisation for Student's t, as in Lange, Little
and Taylor, "Robust Statistical Modeling Using the t Distribution", JASA 84, 1989, with the readings
of an epoch sharing one weight, a matrix. Such an epoch says little along a, and all it can across.

A reading beyond `GATE` spreads of its epoch is left out. A sensor of which less than `USABLE` is
left, or too little to know it by `ENOUGH`, is not calibrated: it gets the mounting of those that it
sits like, and no more. If the typical one is not known by `ENOUGH`, the motion was too little.

How certain it is
-----------------
The sandwich of an M-estimator (Huber, "Robust Statistics", 1981), N^-1 M N^-1 / h^2. N is the
normal matrix. M is how the scores scatter, summed over blocks of time, since they are not white;
each sensor tells how large it is, all together how much larger than if white. h is the share of N
by which the scores answer to a change: a reading that is farther off weighs less. With
z = S^-1 d, they answer by (1 - d z) S^-1 - z z^T in the place of S^-1.
"""

from dataclasses import dataclass, replace

import numpy as np

from risaf_link.core.fusion import MAD_TO_STD
from risaf_link.core.mounting import (
    Bools,
    Mounting,
    Readings,
    Rest,
    find_mounting,
    find_rest,
    mean_rotation,
    median,
)
from risaf_link.core.rotation import Floats, nearest_rotation, quaternion_from_matrix

FEWEST = 3  # sensors: of two, none can tell which is wrong
ENOUGH = 0.005  # of scale, and rad: an axis that is known worse has not been turned about enough
USABLE = 0.5  # share of its readings that makes a sensor worth calibrating
GATE = 6.0  # spreads; wide, since the rest is weighed
NU = 5.0  # sensors that the prior of an epoch's covariance counts as
PRIOR = 0.3  # of scale, and rad: how far a sensor may be off; matters where readings tell nothing
STEPS, CONVERGED = 100, 1e-7  # of the iteration
SETTLED = 8  # steps after which the gate stands still
BLOCKS = 40  # of motion, equal in information
STEP = 1e-6  # of numerical derivatives
LEAST = 1e-12  # (rad/s)^2, noise of perfect sensors


@dataclass(frozen=True, slots=True)
class Disagreement:
    """How far sensors are from their mean in motion: RMS of one axis, rad/s."""

    sensors: Floats  # (n,) NaN: no reading
    array: float
    untimed: float
    """Of the array, but for the direction along which an epoch's sensors differ most: without what
    differences of sampling time make."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What was found of n sensors; `std` is one standard deviation.

    `R M diag(scale) (u - bias)` is the rate in the body frame, as in `TriadCalibration`.
    """

    bias: Floats  # (n, 3) rad/s, in the sensor's axes
    bias_std: Floats  # (n, 3)
    scale: Floats  # (n, 3)
    scale_std: Floats  # (n, 3)
    misalignment: Floats  # (n, 6) of M: xy, xz, yx, yz, zx, zy; rad
    misalignment_std: Floats  # (n, 6)
    mounting: Floats  # (n, 4) quaternion of R, sensor to body
    mounting_std: Floats  # (n, 3) rad, about the body's axes
    turn: Floats  # (n,) rad, between R and the mounting of all that are mounted alike
    axis_std: Floats  # (n, 3) the worst of what a turn about a body axis is read as
    used: Floats  # (n,) share of its readings, of epochs in motion that half of the sensors read
    before: Disagreement  # with nothing but the nominal mounting put right
    after: Disagreement  # of each half of the motion, calibrated by the other
    rest: float  # s; 0: the biases are relative
    moving: float  # s
    motion: Floats  # (3,) rad/s, RMS about each body axis in motion

    @property
    def determined(self) -> Bools:
        """Which sensors are calibrated, shape (n,)."""
        return _determined(self.axis_std, self.used)

    @property
    def typical_std(self) -> Floats:
        """By body axis, `axis_std` of the median sensor, shape (3,)."""
        typical: Floats = np.median(self.axis_std, axis=0)
        return typical


def calibrate(readings: Readings, given: Floats | None = None) -> Calibrated:
    """Calibrate gyros relative to their array.

    Parameters
    ----------
    readings : Readings
        Saturated ones are NaN.
    given : ndarray, shape (n, 3, 3), optional
        Rotation of each sensor, sensor to body, where it is known; None: they are found.

    Returns
    -------
    Calibrated
        Where the motion was too little, `typical_std` says so.

    Raises
    ------
    ValueError
        If there are less than `FEWEST` sensors, or never so many valid readings at once, or no
        motion.
    """
    n = readings.rates_s.shape[1]
    if n < FEWEST:
        raise ValueError(f"found {n} gyros, expected {FEWEST} or more")
    valid = _whole(readings.rates_s)
    rates = np.where(valid[:, :, None], readings.rates_s, np.nan)
    enough = valid.sum(axis=1) >= FEWEST
    if not enough.any():
        raise ValueError(f"found no epoch with {FEWEST} valid readings")
    readings = Readings(readings.time_s[enough], rates[enough])
    mounting = find_mounting(readings, given)
    rest = find_rest(readings, mounting)
    if rest.epochs.all():
        raise ValueError("found the array at rest throughout, expected turns about all axes")
    fit = _iterate(_started(readings, mounting, rest))
    return _told(readings, fit, _covariance(fit), *_judge(fit))


@dataclass(frozen=True, slots=True)
class _Fit:
    """What is known of n sensors after some steps, from k epochs in motion."""

    mounting: Mounting
    rest: Rest
    zero: Floats  # (n, 3) rad/s, about what the sensors read at no rate
    rates_s: Floats  # (k, n, 3) rad/s, without zero; 0 where not valid
    valid: Bools  # (k, n)
    used: Bools  # (k, n) valid, and inside of the gate
    matrix: Floats  # (n, 3, 3) A
    offset: Floats  # (n, 3) rad/s, added in the body frame
    noise: float = 0.0  # s^2, (rad/s)^2; 0: not known

    @property
    def rates_b(self) -> Floats:
        """Readings in the body frame, shape (k, n, 3)."""
        rates = self.rates_s.swapaxes(0, 1) @ self.matrix.swapaxes(1, 2)
        return rates.swapaxes(0, 1) + self.offset


@dataclass(frozen=True, slots=True)
class _Equations:
    """The linear equations of a step, for each sensor, of E and the offset: 12 unknowns."""

    rate: Floats  # (k, 4) w and 1
    residual: Floats  # (k, n, 3) d, 0 where not used
    weight: Floats  # (k, 3, 3) inverse of C
    normal: Floats  # (n, 12, 12)
    right: Floats  # (n, 12)
    prior: Floats  # (n, 12) information
    noise: float


def _started(readings: Readings, mounting: Mounting, rest: Rest) -> _Fit:
    zero = np.where(np.isfinite(rest.bias), rest.bias, mounting.zero)
    rates = readings.rates_s[~rest.epochs] - zero
    valid = _whole(rates)
    rates = np.where(valid[:, :, None], rates, 0.0)
    return _Fit(mounting, rest, zero, rates, valid, valid, mounting.matrix, np.zeros_like(zero))


def _whole(rates: Floats) -> Bools:
    """Which sensors have a reading on all axes, shape (k, n)."""
    return np.asarray(np.isfinite(rates).all(axis=2))


def _iterate(fit: _Fit, first: int = 0) -> _Fit:
    """Step until nothing moves."""
    for step in range(first, STEPS):
        if step < SETTLED:
            fit = replace(fit, used=_gate(fit))
        last, fit = fit, _step(fit)
        if step >= SETTLED and np.abs(fit.matrix - last.matrix).max() < CONVERGED:
            break
    return fit


def _gate(fit: _Fit) -> Bools:
    """Which readings are valid and like the others of their epoch."""
    rates = np.where(fit.valid[:, :, None], fit.rates_b, np.nan)
    distance = np.abs(rates - median(rates)[:, None])
    spread = MAD_TO_STD * median(distance)
    limit = GATE * np.maximum(spread, np.median(spread, axis=0))
    with np.errstate(invalid="ignore"):
        used = np.asarray((distance <= limit[:, None]).all(axis=2))
    return np.asarray(used & (used.sum(axis=1) >= FEWEST)[:, None])


def _equations(fit: _Fit) -> _Equations:
    used = fit.used.astype(float)
    count = np.maximum(used.sum(axis=1), 1.0)
    rates = fit.rates_b
    rate = np.einsum("kn,kni->ki", used, rates) / count[:, None]
    residual = (rates - rate[:, None]) * used[:, :, None]
    scatter = residual.swapaxes(1, 2) @ residual
    degrees = np.maximum(count - 1.0, 1.0)
    noise = fit.noise or np.median(np.trace(scatter, axis1=1, axis2=2) / degrees) / 3.0 + LEAST
    weight = np.linalg.inv((NU * noise * np.eye(3) + scatter) / (NU + degrees)[:, None, None])
    unknowns = np.concatenate([rate, np.ones((len(rate), 1))], axis=1)
    normal = used.T @ _squares(weight, unknowns)
    right = (residual @ weight).transpose(1, 2, 0) @ unknowns
    return _Equations(
        unknowns,
        residual,
        weight,
        normal.reshape(-1, 12, 12),
        right.reshape(-1, 12),
        _prior(fit),
        max(LEAST, 3.0 / np.trace(weight, axis1=1, axis2=2).mean()),
    )


def _squares(weight: Floats, unknowns: Floats) -> Floats:
    """Of each epoch, what it adds to the normal matrix of a sensor; shape (k, 144)."""
    squares: Floats = np.einsum("kij,kc,kd->kicjd", weight, unknowns, unknowns)
    return squares.reshape(-1, 144)


def _prior(fit: _Fit) -> Floats:
    """Information, shape (n, 12), that there is of E and of the offset without motion."""
    information = np.full((len(fit.zero), 3, 4), PRIOR**-2)
    if fit.rest.epochs.any():
        variance = np.maximum(fit.rest.variance.mean(axis=1), LEAST)
        information[:, :, 3] = np.where(np.isfinite(variance), 1.0 / variance, PRIOR**-2)[:, None]
    return information.reshape(-1, 12)


def _step(fit: _Fit) -> _Fit:
    equations = _equations(fit)
    expected = np.zeros((len(fit.zero), 3, 4))
    expected[:, :, :3] = fit.matrix @ np.linalg.inv(fit.mounting.matrix) - np.eye(3)
    expected[:, :, 3] = fit.offset
    right = equations.right + equations.prior * expected.reshape(-1, 12)
    found = np.linalg.solve(_informed(equations), right[:, :, None]).reshape(-1, 3, 4)
    correction = np.linalg.inv(np.eye(3) + found[:, :, :3])
    matrix = correction @ fit.matrix
    offset = np.einsum("nij,nj->ni", correction, fit.offset - found[:, :, 3])
    matrix, offset = _gauged(fit, matrix, offset)
    return replace(fit, matrix=matrix, offset=offset, noise=equations.noise)


def _informed(equations: _Equations) -> Floats:
    return equations.normal + equations.prior[:, :, None] * np.eye(12)


def _gauged(fit: _Fit, matrix: Floats, offset: Floats) -> tuple[Floats, Floats]:
    """The same, in the gauge that the head of this module states."""
    m = fit.mounting
    sound = m.sound if m.sound.any() else np.ones_like(m.sound)
    symmetric = matrix @ nearest_rotation(matrix).swapaxes(1, 2)
    gauge = np.linalg.inv(symmetric[sound].mean(axis=0))
    gauge = mean_rotation(gauge @ matrix, m.nominal, m.axes).T @ gauge
    offset = offset @ gauge.T
    if not fit.rest.epochs.any():
        offset = offset - offset[sound].mean(axis=0)
    return gauge @ matrix, offset


def _blocks(fit: _Fit) -> list[Bools]:
    """The epochs in consecutive blocks, equal in information."""
    turned = (fit.rates_b**2 * fit.used[:, :, None]).sum(axis=(1, 2)) + LEAST
    share = np.cumsum(turned) / turned.sum()
    number = np.minimum((share * BLOCKS).astype(int), BLOCKS - 1)
    return [number == i for i in np.unique(number)]


def _covariance(fit: _Fit) -> Floats:
    """Covariance of E and the offset of each sensor, shape (n, 12, 12)."""
    equations = _equations(fit)
    covariance = np.linalg.inv(_informed(equations))
    weighted = equations.residual @ equations.weight
    count = np.maximum(fit.used.sum(axis=0), 1)
    white = (weighted * equations.residual).sum(axis=(0, 2)) / (3.0 * count)
    found = expected = np.zeros(len(count))
    for block in _blocks(fit):
        rate = equations.rate[block]
        score = (weighted[block].transpose(1, 2, 0) @ rate).reshape(-1, 12)
        squares = _squares(equations.weight[block], rate)
        normal = (fit.used[block].astype(float).T @ squares).reshape(-1, 12, 12)
        share = covariance @ normal
        found = found + np.einsum("ni,nij,nj->n", score, covariance, score)
        expected = expected + np.trace(share - share @ share, axis1=1, axis2=2)
    sure = (white > 0.0) & (expected > 0.0)
    ratio = found[sure] / expected[sure] / white[sure]
    colour = max(1.0, float(np.median(ratio))) if sure.any() else 1.0
    excess = np.asarray(white * colour / _answer(fit, equations) ** 2)
    return np.asarray(covariance * np.where(white > 0.0, excess, 1.0)[:, None, None])


def _answer(fit: _Fit, equations: _Equations) -> Floats:
    """Share of the normal matrix by which the scores of each sensor answer, shape (n,): h."""
    degrees = NU + np.maximum(fit.used.sum(axis=1) - 1.0, 1.0)
    inverse = equations.weight / degrees[:, None, None]
    size = np.trace(inverse, axis1=1, axis2=2)
    z = equations.residual @ inverse
    inner = (equations.residual * z).sum(axis=2)
    lost = (inner * size[:, None] + (z**2).sum(axis=2)).sum(axis=0)
    answer: Floats = 1.0 - lost / np.maximum(fit.used.T @ size, LEAST)
    return answer


def _judge(fit: _Fit) -> tuple[Disagreement, Disagreement]:
    """Disagreement without calibration, and with one from the other half of the motion."""
    nominal = fit.mounting.nominal
    raw = (fit.rates_s + fit.zero).swapaxes(0, 1) @ nominal.swapaxes(1, 2)
    before, after = raw.swapaxes(0, 1), np.zeros_like(raw.swapaxes(0, 1))
    blocks = _blocks(fit)
    for parity in (0, 1):
        judged = np.logical_or.reduce(blocks[parity::2], initial=False)
        if len(blocks) < 2:
            judged = np.ones(len(fit.used), dtype=bool)  # there is no other half
        learnt = fit if judged.all() else _iterate(_during(fit, ~judged), first=SETTLED)
        half = replace(_during(fit, judged), matrix=learnt.matrix, offset=learnt.offset)
        after[judged] = half.rates_b
    return _disagreement(before, fit.used), _disagreement(after, fit.used)


def _during(fit: _Fit, epochs: Bools) -> _Fit:
    return replace(fit, rates_s=fit.rates_s[epochs], valid=fit.valid[epochs], used=fit.used[epochs])


def _disagreement(rates_b: Floats, used: Bools) -> Disagreement:
    count = used.sum(axis=1)
    rates, used = rates_b[count >= FEWEST], used[count >= FEWEST]
    count = used.sum(axis=1)
    if not len(count):
        return Disagreement(np.full(rates_b.shape[1], np.nan), np.nan, np.nan)
    mean = np.einsum("kn,kni->ki", used, rates) / count[:, None]
    residual = (rates - mean[:, None]) * used[:, :, None]
    squares = np.linalg.eigvalsh(residual.swapaxes(1, 2) @ residual)  # ascending
    by_sensor = (residual**2).sum(axis=(0, 2)) / np.where(
        used.any(axis=0), 3 * used.sum(axis=0), np.nan
    )
    return Disagreement(
        np.sqrt(by_sensor),
        float(np.sqrt(squares.sum() / (3 * (count - 1)).sum())),
        float(np.sqrt(squares[:, :2].sum() / (2 * (count - 2)).sum())),
    )


def _told(
    readings: Readings, fit: _Fit, covariance: Floats, before: Disagreement, after: Disagreement
) -> Calibrated:
    n = len(fit.zero)
    by_element = covariance.reshape(n, 3, 4, 3, 4)
    of_matrix = by_element[:, :, :3, :, :3].reshape(n, 9, 9)
    deviation = np.sqrt(np.maximum(of_matrix.diagonal(axis1=1, axis2=2), 0.0))
    axis_std = deviation.reshape(n, 3, 3).max(axis=1)
    shared = fit.used[fit.used.mean(axis=1) >= 0.5]
    used = shared.mean(axis=0) if len(shared) else fit.used.mean(axis=0)
    known = _determined(axis_std, used)
    matrix = np.where(known[:, None, None], fit.matrix, fit.mounting.nominal)
    parts, parts_std = _split(matrix), _split_std(matrix, of_matrix)
    rotation = nearest_rotation(matrix)
    bias, bias_std = _bias(fit, by_element, known)
    moving = ~fit.rest.epochs
    count = np.maximum(fit.used.sum(axis=1), 1)
    rate = np.einsum("kn,kni->ki", fit.used, fit.rates_b) / count[:, None]
    cosine = (np.einsum("nij,nij->n", rotation, fit.mounting.nominal) - 1.0) / 2.0
    return Calibrated(
        bias,
        bias_std,
        parts[:, :3],
        parts_std[:, :3],
        parts[:, 3:9],
        parts_std[:, 3:9],
        quaternion_from_matrix(rotation),
        parts_std[:, 9:],
        np.arccos(np.clip(cosine, -1.0, 1.0)),
        axis_std,
        used,
        before,
        after,
        _seconds(readings.time_s, fit.rest.epochs),
        _seconds(readings.time_s, moving),
        np.sqrt((rate**2).mean(axis=0)),
    )


def _determined(axis_std: Floats, used: Floats) -> Bools:
    return np.asarray((axis_std <= ENOUGH).all(axis=1) & (used >= USABLE))


def _bias(fit: _Fit, covariance: Floats, known: Bools) -> tuple[Floats, Floats]:
    """Bias at rest, or relative, and its standard deviation; 0 where nothing is known."""
    if fit.rest.epochs.any():
        bias, variance = fit.rest.bias, fit.rest.variance
    else:
        inverse = np.linalg.inv(fit.matrix)
        bias_b = np.einsum("nij,nj->ni", fit.matrix, fit.zero) - fit.offset
        common_b = bias_b[known if known.any() else ~known].mean(axis=0)
        bias = np.einsum("nij,nj->ni", inverse, bias_b - common_b)
        bias[~known] = np.nan
        at = np.append(-common_b, 1.0)  # the rate that the bias would be a reading of, and 1
        of_bias_b = np.einsum("c,nicjd,d->nij", at, covariance, at)
        variance = np.einsum("nij,njk,nik->ni", inverse, of_bias_b, inverse)
    told = np.isfinite(bias) & np.isfinite(variance)
    deviation = np.sqrt(np.where(told, np.maximum(variance, 0.0), np.nan))
    return np.where(told, bias, 0.0), deviation


def _split(matrix: Floats, about: Floats | None = None) -> Floats:
    """Scale, misalignment and turn of R from that of `about`; shape (n, 12)."""
    rotation = nearest_rotation(matrix)
    symmetric = rotation.swapaxes(1, 2) @ matrix
    scale = symmetric.diagonal(axis1=1, axis2=2)
    misalignment = (symmetric / scale[:, None, :])[:, ~np.eye(3, dtype=bool)]
    turn = rotation @ (rotation if about is None else nearest_rotation(about)).swapaxes(1, 2)
    skew = (turn - turn.swapaxes(1, 2)) / 2.0
    angles = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    return np.concatenate([scale, misalignment, angles], axis=1)


def _split_std(matrix: Floats, covariance: Floats) -> Floats:
    """Standard deviations of what `_split` gives, from the covariance of E, shape (n, 9, 9)."""
    slopes = []
    for i, j in np.ndindex(3, 3):
        small = np.zeros((3, 3))
        small[i, j] = STEP
        above, below = ((np.eye(3) + sign * small) @ matrix for sign in (1, -1))
        slopes.append((_split(above, matrix) - _split(below, matrix)) / (2.0 * STEP))
    slope = np.stack(slopes, axis=2)
    variance = np.einsum("nij,njk,nik->ni", slope, covariance, slope)
    deviation: Floats = np.sqrt(np.maximum(variance, 0.0))
    return deviation


def _seconds(time_s: Floats, epochs: Bools) -> float:
    """How long some epochs last."""
    if len(time_s) < 2:
        return 0.0
    return float(epochs.sum() * np.median(np.diff(time_s)))
