"""Epoch -> FusedRate: one angular rate from all sensors of an array.

`Risaf` is the method of Hanani and Kipnis, "Robust Extended Kalman Filter for Land Navigation Using
Massive Array of MEMS IMUs", section III.B, eq. 5 to 8; equation numbers here are theirs. `Mean` and
`Median` are what it is compared with.

Inside, the readings stand by channel, shape (3, n), since NumPy is quickest along the last axis. A
reading that is not finite is not valid.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from risaf_link.core.health import ArrayHealth, SilenceMonitor
from risaf_link.core.rotation import Floats
from risaf_link.core.tunable import Tunable

MAD_TO_STD = 1.4826
"""Makes the median absolute deviation of Gaussian values their standard deviation: Rousseeuw and
Croux, "Alternatives to the Median Absolute Deviation", JASA 88, 1993."""


class FusionParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How the sensors of an array become one rate."""

    method: Annotated[Literal["robust", "risaf", "median", "mean"], Tunable("FUS_METHOD")] = (
        "robust"
    )
    """robust: trust by sensor and slow biases, for arrays that are shocked; risaf: relative bias
    and percentile gate, the paper's; median; mean."""
    gyro_noise: Annotated[float, Meta(gt=0, le=1), Tunable("FUS_GYRO_NOISE", "rad/s/sqrt(Hz)")] = (
        2e-4
    )
    """of one sensor; used where fewer than two are behind a rate, which cannot tell."""
    bias_walk: Annotated[float, Meta(ge=0, le=1), Tunable("FUS_BIAS_WALK", "rad/s/sqrt(s)")] = 5e-6
    """of one sensor: 0.02 deg/s in an hour; robust goes by what it sees instead, the more sensors
    the more."""
    gate: Annotated[float, Meta(ge=2, le=1000), Tunable("FUS_GATE", "standard deviations")] = 4.0
    """robust: from the rest, beyond which a reading is rejected; of Gaussian ones one in 16000, a
    tighter gate costs good sensors."""
    bias_time: Annotated[float, Meta(ge=5, le=1e6), Tunable("FUS_BIAS_TIME", "s")] = 100.0
    """robust: in which relative biases are learnt: long against bursts, of which a part is
    absorbed; short against warming up."""
    hold_time: Annotated[float, Meta(ge=0, le=1e6), Tunable("FUS_HOLD_TIME", "s")] = 5.0
    """robust: without an alarm until a sensor is trusted: some decay times of a burst's tail; at 20
    s, sensors that are hit often never come back."""
    resolution: Annotated[float, Meta(ge=0, le=1), Tunable("FUS_RESOLUTION", "rad/s")] = 3e-4
    """robust: no sensor is blamed for less; several counts' worth of rounding."""
    scale_error: Annotated[float, Meta(ge=0, le=1), Tunable("FUS_SCALE_ERR")] = 5e-3
    """robust: of scale factors and misalignments, one standard deviation; no sensor is blamed for
    so much of the rate. Less if the array is calibrated."""
    alpha: Annotated[float, Meta(ge=0, lt=1), Tunable("FUS_ALPHA")] = 0.995
    """risaf, eq. 5: memory of a relative bias, per epoch: 2 s at 100 Hz."""
    lower_quantile: Annotated[float, Meta(ge=0, le=0.5), Tunable("FUS_LOWER_Q")] = 0.20
    """risaf, eq. 6: readings below this quantile of the array are left out."""
    upper_quantile: Annotated[float, Meta(ge=0.5, le=1), Tunable("FUS_UPPER_Q")] = 0.80
    """risaf, eq. 6: readings above this one, too."""


@dataclass(frozen=True, slots=True)
class Epoch:
    """All readings of one instant."""

    time_us: int
    dt: float  # seconds since the epoch before; 0 at the first
    rates_b: Floats  # (n, 3) rad/s; NaN: no valid reading
    forces_b: Floats  # (m, 3) specific force, m/s^2; m may be 0
    lost: int  # sensors whose gyro sample never came


class EpochBlock(Struct, frozen=True):  # as those that come of it: live, it is one an epoch
    """k epochs, one after another, of an array that stays as it is."""

    time_us: NDArray[np.int64]  # (k,)
    dt: Floats  # (k,) seconds, each since the epoch before
    rates_b: Floats  # (k, n, 3) rad/s; NaN: no valid reading
    forces_b: Floats  # (k, m, 3) m/s^2; m may be 0
    received_us: NDArray[np.int64]  # (k,) when the frame came that made each of them whole

    @classmethod
    def of(cls, epochs: Sequence[tuple[Epoch, int]]) -> "EpochBlock":
        """Put single epochs together, each with the time at which it was received."""
        return cls(
            np.array([epoch.time_us for epoch, _ in epochs]),
            np.array([epoch.dt for epoch, _ in epochs]),
            np.array([epoch.rates_b for epoch, _ in epochs]),
            np.array([epoch.forces_b for epoch, _ in epochs]),
            np.array([received_us for _, received_us in epochs]),
        )

    def __len__(self) -> int:
        return len(self.time_us)

    def each(self) -> "Iterator[EpochBlock]":
        """The epochs, one by one."""
        return (self.part(slice(i, i + 1)) for i in range(len(self)))

    def part(self, some: slice) -> "EpochBlock":
        """Some of the epochs."""
        return EpochBlock(
            self.time_us[some],
            self.dt[some],
            self.rates_b[some],
            self.forces_b[some],
            self.received_us[some],
        )


class FusedRate(Struct, frozen=True):
    """The array as one gyro."""

    time_us: int
    rate_b: Floats  # (3,) rad/s; NaN on an axis without a valid reading
    variance: Floats  # (3,) (rad/s)^2, eq. 8: of one sensor among those behind it; NaN below two
    active: NDArray[np.int64]  # (3,) sensors behind the rate
    valid: int  # sensors with a valid reading on all axes
    noise: Floats  # (3,) (rad/s)^2, of the rate itself: its white part; NaN: not known
    bias_walk: Floats  # (3,) rad/s/sqrt(s), of the rate's bias; NaN: not known


class Fusion(Protocol):
    """What every method of fusion can do."""

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters; what was learnt stays."""
        ...

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; its number of sensors may differ from the one before."""
        ...

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch."""
        ...


class Risaf:
    """Robust Inertial Sensor Array Fusion: eq. 5 to 8.

    Each channel's relative bias against the array's mean is tracked and taken off; of each axis,
    the readings between two quantiles are averaged.

    What the paper leaves open: relative biases start from zero; the mean in eq. 5 runs over the
    channels valid at that epoch, and the relative bias of the others stays as it is; the set of
    eq. 6 is taken per axis; quantiles interpolate linearly between order statistics, and a sensor
    on a threshold is inside. Of two sensors neither is: their mean is taken.
    """

    def __init__(self, parameters: FusionParameters) -> None:
        self._parameters = parameters
        self._silence = SilenceMonitor()
        self._relative_bias = np.zeros((3, 0))

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s, as of the last epoch."""
        return self._relative_bias.T

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self._parameters = parameters

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; the variance is eq. 8, that of one sensor of the active set."""
        p = self._parameters
        rates, valid = _channels(epoch)
        self._silence.watch(epoch.rates_b, epoch.dt)
        self._resize(rates.shape[1])
        mean = rates.sum(axis=1, where=valid) / np.maximum(valid.sum(axis=1), 1)
        residual = rates - mean[:, None]
        tracked = p.alpha * self._relative_bias + (1.0 - p.alpha) * residual  # eq. 5
        self._relative_bias = np.where(valid, tracked, self._relative_bias)
        corrected = rates - self._relative_bias
        lower, upper = quantiles(corrected, (p.lower_quantile, p.upper_quantile))
        active = (lower[:, None] <= corrected) & (corrected <= upper[:, None])  # eq. 6
        if not active.any(axis=1).all():
            active |= valid & ~active.any(axis=1, keepdims=True)
        return _mean_of_active(p, epoch, corrected, active, valid)  # eq. 7 and 8

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return self._silence.health(self.relative_bias)

    def _resize(self, n: int) -> None:
        """Forget the last sensors, or add some without a bias, if their number has changed."""
        known = self._relative_bias.shape[1]
        if n != known:
            new = np.zeros((3, max(0, n - known)))
            self._relative_bias = np.hstack([self._relative_bias[:, :n], new])


class _Plain:
    """A fusion that learns nothing of the sensors."""

    def __init__(self, parameters: FusionParameters) -> None:
        self._parameters = parameters
        self._silence = SilenceMonitor()

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters."""
        self._parameters = parameters

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return self._silence.health()


class Mean(_Plain):
    """The plain mean of the valid readings, per axis."""

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch; the variance is that of one sensor, as in eq. 8."""
        rates, valid = _channels(epoch)
        self._silence.watch(epoch.rates_b, epoch.dt)
        return _mean_of_active(self._parameters, epoch, rates, valid, valid)


class Median(_Plain):
    """The median of the valid readings, per axis."""

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch; the variance is that of one sensor, by the median absolute deviation."""
        rates, valid = _channels(epoch)
        self._silence.watch(epoch.rates_b, epoch.dt)
        (median,) = quantiles(rates, (0.5,))
        (deviation,) = quantiles(np.abs(rates - median[:, None]), (0.5,))
        count = valid.sum(axis=1)
        variance = np.where(count > 1, (MAD_TO_STD * deviation) ** 2, np.nan)
        return _fused(self._parameters, epoch, median, variance, count, valid)


def quantiles(values: Floats, shares: tuple[float, ...]) -> Floats:
    """Quantiles of the valid values of each row, interpolated linearly between order statistics.

    To the last bit what `numpy.nanquantile(values, shares, axis=1)` gives, which takes seven times
    as long.

    Parameters
    ----------
    values : ndarray, shape (k, n)
        Finite, or NaN where not valid.
    shares : tuple of s floats
        In [0, 1].

    Returns
    -------
    ndarray, shape (s, k)
        NaN where a row has no valid value.
    """
    if not values.size:
        return np.full((len(shares), len(values)), np.nan)
    ordered = np.sort(values, axis=1)  # NaN comes last
    last = np.maximum((~np.isnan(ordered)).sum(axis=1) - 1, 0)
    place = np.multiply.outer(shares, last)
    below = place.astype(np.intp)
    part = place - below
    rows = np.arange(len(values))
    low, high = ordered[rows, below], ordered[rows, np.minimum(below + 1, last)]
    step = high - low
    result: Floats = np.where(part < 0.5, low + step * part, high - step * (1.0 - part))
    return result


def _channels(epoch: Epoch) -> tuple[Floats, NDArray[np.bool_]]:
    """The readings by channel, shape (3, n), NaN where not valid, and which are valid."""
    rates = epoch.rates_b.T.copy()
    valid = np.isfinite(rates)
    return np.where(valid, rates, np.nan), valid


def _mean_of_active(
    parameters: FusionParameters,
    epoch: Epoch,
    rates: Floats,
    active: NDArray[np.bool_],
    valid: NDArray[np.bool_],
) -> FusedRate:
    """Mean and sample variance of the active channels of each axis: eq. 7 and 8."""
    count = active.sum(axis=1)
    rate = rates.sum(axis=1, where=active) / _or_nan(count)
    square = ((rates - rate[:, None]) ** 2).sum(axis=1, where=active)
    return _fused(parameters, epoch, rate, square / _or_nan(count - 1), count, valid)


def _fused(
    parameters: FusionParameters,
    epoch: Epoch,
    rate: Floats,
    variance: Floats,
    count: NDArray[np.int64],
    valid: NDArray[np.bool_],
) -> FusedRate:
    """A rate with its noise and bias walk, as if its sensors were independent and Gaussian."""
    sensors = _or_nan(count)
    one = parameters.gyro_noise**2 / epoch.dt if epoch.dt > 0 else np.nan
    return FusedRate(
        epoch.time_us,
        rate,
        variance,
        count,
        int(valid.all(axis=0).sum()),
        np.where(np.isnan(variance), one, variance) / sensors,
        parameters.bias_walk / np.sqrt(sensors),
    )


def _or_nan(count: NDArray[np.int64]) -> Floats:
    """A divisor that gives NaN, silently, where there is nothing to divide by."""
    return np.where(count > 0, count, np.nan)
