"""The steps of every epoch in C++, where they were built: as the NumPy forms, only faster.

The NumPy forms stay the statement of what is done, and run where nothing was built.
"""

from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs

from risaf_link.core import robust
from risaf_link.core.fusion import Epoch, FusedRate, FusionParameters
from risaf_link.core.health import SILENT_AFTER, ArrayHealth
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
        fused, active, valid = self._kernel.fuse(dt, np.ascontiguousarray(readings))
        rate, variance, noise, bias_walk = fused
        return FusedRate(time_us, rate, variance, active, valid, noise, bias_walk)


Robust = _Robust if BUILT else robust.Robust
