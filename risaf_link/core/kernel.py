"""The steps of every epoch in C++, where they were built: as the NumPy forms, only faster.

The NumPy forms stay the statement of what is done, and run where nothing was built.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from risaf_link.core import fusion, robust
from risaf_link.core.fusion import Epoch, FusedRate, Fusion, FusionParameters
from risaf_link.core.health import SILENT_AFTER, ArrayHealth, SilenceMonitor
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


class _Risaf:
    """`fusion.Risaf` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        p = parameters
        self._kernel = _kernel.Risaf(
            p.alpha, p.lower_quantile, p.upper_quantile, p.gyro_noise, p.bias_walk
        )
        self._silence = SilenceMonitor()

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s, as of the last epoch."""
        return self._kernel.relative_bias().T

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return self._silence.health(self.relative_bias)

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; the variance is eq. 8, that of one sensor of the active set."""
        self._silence.watch(epoch.rates_b, epoch.dt)
        return _fused(epoch.time_us, self._kernel.fuse(epoch.dt, epoch.rates_b))


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
        return self.fuse_readings(epoch.time_us, epoch.dt, epoch.rates_b)

    def fuse_readings(self, time_us: int, dt: float, readings: Floats) -> FusedRate:
        """Fuse what sensors of one kind read at one instant, (n, 3)."""
        return _fused(time_us, self._kernel.fuse(dt, readings))


def _fused(time_us: int, parts: tuple[Floats, NDArray[np.int64], int]) -> FusedRate:
    (rate, variance, noise, bias_walk), active, valid = parts
    return FusedRate(time_us, rate, variance, active, valid, noise, bias_walk)


Risaf: Callable[[FusionParameters], Fusion] = _Risaf if BUILT else fusion.Risaf
Robust = _Robust if BUILT else robust.Robust
