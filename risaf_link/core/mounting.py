"""How an array's sensors are mounted, and when it was at rest, from what they read.

Nothing but readings is needed: the size of a rate is the same in all axes, so sensors are compared
before it is known how they are mounted; their axes follow from how they read the same turns.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.fusion import MAD_TO_STD, quantiles
from risaf_link.core.rotation import Floats, nearest_rotation

Bools = NDArray[np.bool_]

ALIKE = np.radians(20.0)  # between sensors that are meant to be mounted alike
LIKELY_SCALE = (0.5, 2.0)  # against the array; beyond, a sensor is broken
NEAR = 0.2  # of a rate's size: so far may a reading's be off
UNMOVED = 1e-3  # of the turning, by its square: about axes turned less, mounting is as expected

WINDOW = 0.5  # s, of looking for rest
FEWEST_SAMPLES = 5  # of a window
SHORTEST_REST = 2.0  # s
SHAKING = np.radians(0.2)  # rad/s, RMS within a window: as much as with an engine idling
LEVEL = np.radians(0.1)  # rad/s: so much may the means of windows at rest differ
LIKELY_BIAS = np.radians(1.0)  # rad/s, of one gyro
LIMIT = 4.0  # standard deviations
TAILS = (0.05, 0.95)
BETWEEN_TAILS = 3.29  # standard deviations, of Gaussian values


@dataclass(frozen=True, slots=True)
class Readings:
    """What the array read: k epochs of n sensors."""

    time_s: Floats  # (k,) s, never going back
    rates_s: Floats  # (k, n, 3) rad/s, each in its sensor's axes; NaN: no valid reading

    @property
    def windows(self) -> NDArray[np.int64]:
        """Number of the window that each epoch is in, shape (k,); there are no empty ones."""
        number = np.floor((self.time_s - self.time_s[0]) / WINDOW).astype(np.int64)
        windows: NDArray[np.int64] = np.unique(number, return_inverse=True)[1]
        return windows


@dataclass(frozen=True, slots=True)
class Mounting:
    """How the sensors are mounted, roughly."""

    nominal: Floats  # (n, 3, 3) rotation, sensor to body, of all that are mounted alike
    matrix: Floats  # (n, 3, 3) rotation and size, sensor to body
    zero: Floats  # (n, 3) rad/s, what each read when the array was quietest
    axes: Bools  # (n,) those that say what the body axes are
    sound: Bools  # (n,) those that read turns of about the right size, mostly


@dataclass(frozen=True, slots=True)
class Rest:
    """When the array was at rest, and what it read then."""

    epochs: Bools  # (k,)
    bias: Floats  # (n, 3) rad/s; NaN without rest
    variance: Floats  # (n, 3) (rad/s)^2, of the bias


def find_mounting(readings: Readings, given: Floats | None) -> Mounting:
    """Find how sensors are mounted.

    Parameters
    ----------
    readings : Readings
        At every epoch of three sensors at least.
    given : ndarray, shape (n, 3, 3), or None
        Rotations that are known: then only what the sensors say otherwise is found.
    """
    n = readings.rates_s.shape[1]
    expected = np.tile(np.eye(3), (n, 1, 1)) if given is None else given
    zero = _zero(readings)
    turned = readings.rates_s - zero
    scale, good = _sizes(turned)
    sound = good.sum(axis=0) > 0.5 * good.any(axis=1).sum()
    first = int(np.argmax(good.sum(axis=0)))
    turned = np.where(good[:, :, None], turned, 0.0)
    rotation = _rotations(turned[:, first] @ expected[first].T, turned, expected)
    common = np.einsum("nij,knj->ki", rotation, turned) / np.maximum(good.sum(axis=1), 1)[:, None]
    rotation = _rotations(common, turned, expected)
    alike = _alike(rotation) & sound
    largest = np.argmax((alike & sound[:, None]).sum(axis=1))
    axes = alike[largest] if given is None else sound
    turn = mean_rotation(rotation, expected, axes)
    rotation = turn.T @ rotation
    nominal = expected if given is not None else _nominal(rotation, alike, axes)
    return Mounting(nominal, scale[:, None, None] * rotation, zero, axes, sound)


def mean_rotation(matrices: Floats, expected: Floats, axes: Bools) -> Floats:
    """Rotation, shape (3, 3), by which sensors are off the expected mounting, on the average."""
    if not axes.any():
        return np.eye(3)
    return nearest_rotation((matrices @ expected.swapaxes(1, 2))[axes].mean(axis=0))


def find_rest(readings: Readings, mounting: Mounting) -> Rest:
    """Find when the array was at rest.

    A window is at rest if the median of the sensors is as quiet as their noise or `SHAKING` makes
    it, no farther from zero than the sensors' biases explain, and near the others.
    """
    k, n, _ = readings.rates_s.shape
    window = readings.windows
    rates = np.einsum("nij,knj->kni", mounting.matrix, readings.rates_s)
    common = median(rates)
    count = np.bincount(window)
    mean = _by_window(common, window) / count[:, None]
    variance = _by_window((common - mean[window]) ** 2, window) / count[:, None]
    difference: Floats = np.diff(rates - common[:, None], axis=0)
    (typical,) = quantiles(np.abs(difference).reshape(-1, 3).T, (0.5,))
    noise = MAD_TO_STD / np.sqrt(2.0) * typical
    level = np.einsum("nij,nj->ni", mounting.matrix, mounting.zero)
    spread = np.nanmedian(np.abs(level - np.nanmedian(level, axis=0)), axis=0) * MAD_TO_STD
    quiet = (variance <= LIMIT * noise**2 / n * np.pi / 2 + SHAKING**2).all(axis=1)
    common_bias = np.maximum(spread, LIKELY_BIAS) / np.sqrt(n)
    quiet &= (np.abs(mean) <= LIMIT * common_bias + LEVEL).all(axis=1)
    quiet &= count >= FEWEST_SAMPLES
    if quiet.any():
        error = LIMIT * np.sqrt(variance / count[:, None]) + LEVEL
        quiet &= (np.abs(mean - np.median(mean[quiet], axis=0)) <= error).all(axis=1)
    unknown = np.full((n, 3), np.nan)
    if quiet.sum() * WINDOW < SHORTEST_REST:
        return Rest(np.zeros(k, dtype=bool), unknown, unknown)
    epochs: Bools = quiet[window]
    return Rest(epochs, *_bias(readings.rates_s[epochs], window[epochs]))


def median(rates: Floats) -> Floats:
    """Median of the sensors, shape (k, 3), of readings, shape (k, n, 3); NaN is left out."""
    k, n, _ = rates.shape
    by_axis = rates.swapaxes(1, 2).reshape(-1, n)
    middle: Floats = quantiles(by_axis, (0.5,))[0].reshape(k, 3)
    return middle


def _zero(readings: Readings) -> Floats:
    """Mean reading of each sensor in the quietest window, shape (n, 3)."""
    window, rates = readings.windows, readings.rates_s
    valid: Bools = np.asarray(np.isfinite(rates))
    count = _by_window(valid, window)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = _by_window(np.where(valid, rates, 0.0), window) / count
        square = _by_window(np.where(valid, (rates - mean[window]) ** 2, 0.0), window) / count
    (loudness,) = quantiles(square.sum(axis=2), (0.5,))
    long_enough = np.bincount(window) >= min(FEWEST_SAMPLES, len(rates))
    quietest = np.nanargmin(np.where(long_enough, loudness, np.inf))
    zero: Floats = np.where(np.isfinite(mean[quietest]), mean[quietest], 0.0)
    return zero


def _sizes(turned: Floats) -> tuple[Floats, Bools]:
    """Scale of each sensor, shape (n,), and which of its readings are of the array's size."""
    size = np.linalg.norm(turned, axis=2)
    (common,) = quantiles(size, (0.5,))
    lively = common >= 0.5 * np.sqrt(np.mean(common**2))
    (scale,) = quantiles((common[lively, None] / np.maximum(size[lively], 1e-12)).T, (0.5,))
    scale = np.where((scale > LIKELY_SCALE[0]) & (scale < LIKELY_SCALE[1]), scale, 1.0)
    near = np.abs(scale * size - common[:, None]) <= NEAR * common[:, None]
    return scale, near & lively[:, None]


def _rotations(common: Floats, turned: Floats, expected: Floats) -> Floats:
    """Rotations, shape (n, 3, 3), that bring each sensor's readings to the common ones.

    Wahba's problem, as Markley solves it. About an axis without turns, the expected one holds.
    """
    products = np.einsum("ki,knj->nij", common, turned)
    unmoved = UNMOVED * np.sum(common**2)
    return nearest_rotation(products + unmoved * expected)


def _alike(rotation: Floats) -> Bools:
    """Which sensors are mounted alike, shape (n, n)."""
    flat = rotation.reshape(len(rotation), 9)
    alike: Bools = (flat @ flat.T - 1.0) / 2.0 >= np.cos(ALIKE)
    return alike


def _nominal(rotation: Floats, alike: Bools, axes: Bools) -> Floats:
    """Mean rotation of the sound sensors that are mounted as each one is; the axes' is none."""
    mean = np.tensordot(alike.astype(float), rotation, axes=1)
    in_group = np.asarray(alike.any(axis=1))
    nominal = nearest_rotation(np.where(in_group[:, None, None], mean, rotation))
    nominal[axes] = np.eye(3)
    return nominal


def _by_window(values: Floats | Bools, window: NDArray[np.int64]) -> Floats:
    """Sums over the epochs of each window."""
    starts = np.searchsorted(window, np.arange(window[-1] + 1))
    sums: Floats = np.add.reduceat(values, starts, axis=0, dtype=float)
    return sums


def _bias(rates: Floats, window: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Mean of the readings at rest and its variance, both of shape (n, 3)."""
    window = np.unique(window, return_inverse=True)[1]
    by_channel = rates.reshape(len(rates), -1)
    middle, low, high = quantiles(by_channel.T, (0.5, *TAILS))
    limit = 2 * LIMIT * (high - low) / BETWEEN_TAILS
    with np.errstate(invalid="ignore", divide="ignore"):
        valid = np.abs(by_channel - middle) <= limit
        count = valid.sum(axis=0)
        centred = np.where(valid, by_channel - middle, 0.0)
        mean = centred.sum(axis=0) / count
        centred = np.where(valid, centred - mean, 0.0)
        white = (centred**2).sum(axis=0) / (count - 1) / count
        sums = _by_window(centred, window)
        windows = len(sums)
        coloured = (sums**2).sum(axis=0) / count**2 * windows / (windows - 1)
        ratio = np.nanmean(coloured) / np.nanmean(white)
    shape = rates.shape[1:]
    return (middle + mean).reshape(shape), (white * max(1.0, ratio)).reshape(shape)
