"""A sensor's standing over time: healthy, suspect or dead."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.fusion import Epoch

DEAD_AFTER = 1.0  # s


@dataclass(frozen=True, slots=True)
class ArrayHealth:
    """How many sensors of the array stand how."""

    healthy: int
    suspect: int
    dead: int


class HealthMonitor:
    """Tells sensors that are silent for a moment from those that are silent for good.

    A sensor with a valid reading on all axes is healthy; one without is suspect, and dead after
    more than `DEAD_AFTER` without. When their number changes, all are judged anew.
    """

    def __init__(self) -> None:
        self._silent_for = np.zeros(0)  # s, each sensor

    def watch(self, epoch: Epoch) -> ArrayHealth:
        """Take note of one epoch, and judge the sensors as of then."""
        finite = np.isfinite(epoch.rates_b)
        valid: NDArray[np.bool_] = np.logical_and.reduce(finite, axis=1)
        if len(valid) != len(self._silent_for):
            self._silent_for = np.zeros(len(valid))
        else:
            self._silent_for = np.where(valid, 0.0, self._silent_for + epoch.dt)
        healthy = int(valid.sum())
        dead = int((self._silent_for > DEAD_AFTER).sum())
        return ArrayHealth(healthy, len(valid) - healthy - dead, dead)
