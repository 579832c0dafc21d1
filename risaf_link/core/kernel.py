"""The steps of every epoch in C++, where they were built: as the NumPy forms, only faster.

The NumPy forms stay the statement of what is done, and run where nothing was built.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs

from risaf_link.core import fusion, robust
from risaf_link.core.fusion import MAD_TO_STD, Epoch, FusedRate, Fusion, FusionParameters
from risaf_link.core.health import SILENT_AFTER, ArrayHealth, judge_silence
from risaf_link.core.rotation import Floats

if TYPE_CHECKING:
    from risaf_link.core import _kernel
else:
    try:
        from risaf_link.core import _kernel
    except ImportError:
        _kernel = None

BUILT = _kernel is not None
"""Whether there is a kernel."""

_SHARED = (
    *("LIMIT", "LONGEST", "WATCH_TIME", "BURST_TIME", "BURST", "SWELL", "NOISE_TIME"),
    *("SPREAD_TIME", "FROZEN_AFTER", "RELEARN", "TINY", "LEAST_WHITE", "PRIOR"),
)


class _Mean:
    """`fusion.Mean` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        self._kernel = _kernel.Mean(parameters.gyro_noise, parameters.bias_walk)

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return judge_silence(self._kernel.silent_for())

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch; the variance is that of one sensor, as in eq. 8."""
        return _fuse(self._kernel, epoch.time_us, epoch.dt, epoch.rates_b)


class _Median:
    """`fusion.Median` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        p = parameters
        self._kernel = _kernel.Median(p.gyro_noise, p.bias_walk, MAD_TO_STD)

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return judge_silence(self._kernel.silent_for())

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse one epoch; the variance is that of one sensor, by the median absolute deviation."""
        return _fuse(self._kernel, epoch.time_us, epoch.dt, epoch.rates_b)


class _Risaf:
    """`fusion.Risaf` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        p = parameters
        self._kernel = _kernel.Risaf(
            p.alpha, p.lower_quantile, p.upper_quantile, p.gyro_noise, p.bias_walk
        )

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s, as of the last epoch."""
        return self._kernel.relative_bias().T

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return judge_silence(self._kernel.silent_for(), self.relative_bias)

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; the variance is eq. 8, that of one sensor of the active set."""
        return _fuse(self._kernel, epoch.time_us, epoch.dt, epoch.rates_b)


class _Robust:
    """`robust.Robust` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        told = _kernel.RobustParameters()
        for name in _SHARED:
            setattr(told, name.lower(), getattr(robust, name))
        told.silent_after = SILENT_AFTER
        told.mad_factors = robust.MAD_FACTORS.tolist()
        for name, value in structs.asdict(parameters).items():
            if hasattr(told, name):
                setattr(told, name, value)
        self._kernel = _kernel.Robust(told)

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s."""
        return self._channels.bias.T

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch; of a sensor, its worst axis counts."""
        return robust.judge(self._channels, self._kernel.trusted() > 0.0)

    @property
    def _channels(self) -> robust.Channels:
        return robust.Channels(**self._kernel.channels())

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; its number of sensors may differ from the one before."""
        return _fuse(self._kernel, epoch.time_us, epoch.dt, epoch.rates_b)

    def fuse_readings(self, time_us: int, dt: float, readings: Floats) -> FusedRate:
        """Fuse what sensors of one kind read at one instant, (n, 3)."""
        return _fuse(self._kernel, time_us, dt, readings)


def _fuse(kernel: "_kernel._Fusion", time_us: int, dt: float, readings: Floats) -> FusedRate:
    values, active = np.empty((4, 3)), np.empty(3, np.int64)
    valid = kernel.fuse(dt, readings, values, active)
    rate, variance, noise, bias_walk = values
    return FusedRate(time_us, rate, variance, active, valid, noise, bias_walk)


Mean: Callable[[FusionParameters], Fusion] = _Mean if BUILT else fusion.Mean
Median: Callable[[FusionParameters], Fusion] = _Median if BUILT else fusion.Median
Risaf: Callable[[FusionParameters], Fusion] = _Risaf if BUILT else fusion.Risaf
Robust = _Robust if BUILT else robust.Robust
