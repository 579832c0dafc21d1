"""A sensor's standing over time: healthy, suspect or dead."""

from dataclasses import dataclass

import numpy as np

from risaf_link.core.fusion import Epoch

DEAD_AFTER_US = 1_000_000


@dataclass(frozen=True, slots=True)
class ArrayHealth:
    """How many sensors of the array stand how."""

    healthy: int
    suspect: int
    dead: int


class HealthMonitor:
    """Tells sensors that are silent for a moment from those that are silent for good.

    A sensor with a valid reading on all axes is healthy; one without is suspect, and dead after a
    second without.
    """

    def __init__(self) -> None:
        self._last_valid_us = np.zeros(0, dtype=np.int64)

    def watch(self, epoch: Epoch) -> ArrayHealth:
        """Take note of one epoch."""
        valid = np.atleast_1d(~np.isnan(epoch.rates_b).any(axis=1))
        if len(valid) != len(self._last_valid_us):
            self._last_valid_us = np.full(len(valid), epoch.time_us)
        self._last_valid_us[valid] = epoch.time_us
        np.minimum(self._last_valid_us, epoch.time_us, out=self._last_valid_us)  # the clock reset
        dead = epoch.time_us - self._last_valid_us > DEAD_AFTER_US
        healthy, gone = int(valid.sum()), int(dead.sum())
        return ArrayHealth(healthy, len(valid) - healthy - gone, gone)
