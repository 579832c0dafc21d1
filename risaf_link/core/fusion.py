"""Epoch -> FusedRate: one angular rate from all sensors of an array.

`Risaf` is the method of Hanani and Kipnis, "Robust Extended Kalman Filter for Land Navigation Using
Massive Array of MEMS IMUs", eq. 5 to 8; equation numbers here are theirs. `Mean` and `Median` are
what it is compared with.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats


class FusionParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How the sensors of an array become one rate."""

    method: Literal["risaf", "median", "mean"] = "risaf"
    alpha: Annotated[float, Meta(ge=0, lt=1)] = 0.995
    lower_quantile: Annotated[float, Meta(ge=0, le=0.5)] = 0.20
    upper_quantile: Annotated[float, Meta(ge=0.5, le=1)] = 0.80


@dataclass(frozen=True, slots=True)
class Epoch:
    """All readings of one instant."""

    time_us: int
    dt: float  # seconds since the epoch before; NaN at the first
    rates_b: Floats  # (n, 3) rad/s; NaN: no valid reading
    forces_b: Floats  # (m, 3) specific force, m/s^2; m may be 0
    lost: int  # sensors whose gyro sample never came


@dataclass(frozen=True, slots=True)
class FusedRate:
    """The array as one gyro."""

    time_us: int
    rate_b: Floats  # (3,) rad/s; NaN on an axis without a valid reading
    variance: Floats  # (3,) (rad/s)^2, of one sensor among those behind the rate; NaN below two
    active: NDArray[np.int64]  # (3,) sensors behind the rate
    valid: int  # sensors with a valid reading on all axes


class Fusion(Protocol):
    """What every method of fusion can do."""

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; its number of sensors may differ from the one before."""
        ...


@dataclass
class Risaf:
    """Robust Inertial Sensor Array Fusion: eq. 5 to 8.

    The relative bias of each sensor against the array's mean is tracked and taken off; per axis,
    the readings between two quantiles are averaged. Quantiles interpolate linearly between order
    statistics, a sensor on a threshold is inside. The relative bias of a channel without a valid
    reading stays as it is. With two sensors neither lies between the quantiles: their mean is
    taken.

    Attributes
    ----------
    relative_bias : ndarray, shape (n, 3)
        rad/s; starts from zero.
    """

    parameters: FusionParameters
    relative_bias: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch, equations 5 to 8."""
        p = self.parameters
        rates = epoch.rates_b
        self._resize(len(rates))
        residual = rates - _mean(rates)
        updated = p.alpha * self.relative_bias + (1.0 - p.alpha) * residual  # eq. 5
        self.relative_bias = np.where(np.isnan(rates), self.relative_bias, updated)
        corrected = rates - self.relative_bias
        lower, upper = quantiles(corrected, p.lower_quantile, p.upper_quantile)
        inside = (lower <= corrected) & (corrected <= upper)  # eq. 6
        inside |= ~inside.any(axis=0) & ~np.isnan(corrected)
        return _mean_of_members(epoch, corrected, inside)  # eq. 7 and 8

    def _resize(self, n: int) -> None:
        missing = n - len(self.relative_bias)
        if missing:
            new = np.zeros((max(0, missing), 3))
            self.relative_bias = np.vstack([self.relative_bias[:n], new])


@dataclass
class Mean:
    """The plain mean of the valid readings, per axis."""

    parameters: FusionParameters

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch; the variance is that of one sensor."""
        return _mean_of_members(epoch, epoch.rates_b, ~np.isnan(epoch.rates_b))


@dataclass
class Median:
    """The median of the valid readings, per axis; no bias tracking.

    The variance of one sensor comes from the median absolute deviation, scaled for a Gaussian
    (Rousseeuw and Croux, "Alternatives to the Median Absolute Deviation", 1993: 1.4826).
    """

    parameters: FusionParameters

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch."""
        rates = epoch.rates_b
        active = (~np.isnan(rates)).sum(axis=0)
        rate = quantiles(rates, 0.5)[0]
        deviation = quantiles(np.abs(rates - rate), 0.5)[0]
        variance = np.where(active > 1, (1.4826 * deviation) ** 2, np.nan)
        return FusedRate(epoch.time_us, rate, variance, active, _valid(rates))


FUSIONS: dict[str, type[Risaf | Mean | Median]] = {"risaf": Risaf, "mean": Mean, "median": Median}


def quantiles(values: Floats, *shares: float) -> list[Floats]:
    """Quantiles of the valid values of each column, interpolated linearly.

    The same numbers as `numpy.nanquantile(values, share, axis=0)`, to the last bit, without its
    overhead of a millisecond.

    Parameters
    ----------
    values : ndarray, shape (n, k)
        NaN where not valid.
    *shares : float
        In [0, 1].

    Returns
    -------
    list of ndarray, shape (k,)
        One for each share; NaN where a column has no valid value.
    """
    if not len(values):
        return [np.full(values.shape[1], np.nan) for _ in shares]
    ordered = np.sort(values, axis=0)  # NaN comes last
    last = np.maximum((~np.isnan(ordered)).sum(axis=0) - 1, 0)
    columns = np.arange(values.shape[1])
    results = []
    for share in shares:
        place = share * last
        below = place.astype(np.intp)
        part = place - below
        low, high = ordered[below, columns], ordered[np.minimum(below + 1, last), columns]
        step = high - low
        results.append(np.where(part < 0.5, low + step * part, high - step * (1.0 - part)))
    return results


def _mean(rates: Floats) -> Floats:
    valid = ~np.isnan(rates)
    count = valid.sum(axis=0)
    total = np.where(valid, rates, 0.0).sum(axis=0)
    mean: Floats = np.divide(total, count, out=np.full(3, np.nan), where=count > 0)
    return mean


def _mean_of_members(epoch: Epoch, rates: Floats, members: NDArray[np.bool_]) -> FusedRate:
    """Mean and sample variance (one degree of freedom less) of the members, per axis."""
    active = members.sum(axis=0)
    total = np.where(members, rates, 0.0).sum(axis=0)
    rate = np.divide(total, active, out=np.full(3, np.nan), where=active > 0)
    square = (np.where(members, rates - rate, 0.0) ** 2).sum(axis=0)
    variance = np.divide(square, active - 1, out=np.full(3, np.nan), where=active > 1)
    return FusedRate(epoch.time_us, rate, variance, active, _valid(epoch.rates_b))


def _valid(rates: Floats) -> int:
    return int((~np.isnan(rates)).all(axis=1).sum())
