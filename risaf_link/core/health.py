"""A sensor's standing over time: healthy, suspect or dead, and why."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

SILENT_AFTER = 1.0  # s without a valid reading that make a sensor dead


class SensorState(IntEnum):
    """A sensor's standing, as RISAF_SENSOR_STATE."""

    HEALTHY = 0
    SUSPECT = 1
    DEAD = 2


class Reason(IntEnum):
    """Why a sensor is not healthy, as RISAF_SENSOR_REASON; of several, the greatest is told."""

    NONE = 0
    SETTLING = 1  # new, or back: not long enough without an alarm
    WANDERING = 2  # its bias has left the others': a step, a drift, a scale
    OUTLYING = 3  # too many of its readings are rejected
    FROZEN = 4  # its reading does not change; so does one at the end of its range
    SILENT = 5  # no valid reading


@dataclass(frozen=True, slots=True)
class ArrayHealth:
    """How the n sensors of an array stand."""

    state: NDArray[np.int8]  # (n,) SensorState
    reason: NDArray[np.int8]  # (n,) Reason
    rejected: Floats  # (n,) share of the readings rejected of late, the worst axis
    relative_bias: Floats  # (n, 3) rad/s, against the array

    def count(self, state: SensorState) -> int:
        """How many sensors stand so."""
        return int((self.state == state).sum())


class SilenceMonitor:
    """Judges sensors by their silence alone: for methods that do not judge them otherwise.

    A sensor with a valid reading on all axes is healthy; one without is suspect, and dead after
    more than `SILENT_AFTER` without. When their number changes, all are judged anew.
    """

    def __init__(self) -> None:
        self._silent_for = np.zeros(0)  # s, each sensor

    def watch(self, rates: Floats, dt: float) -> None:
        """Take note of the readings of one epoch, shape (n, 3)."""
        valid: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(rates), axis=1)
        if len(valid) != len(self._silent_for):
            self._silent_for = np.zeros(len(valid))
            dt = max(dt, np.finfo(float).tiny)
        self._silent_for = np.where(valid, 0.0, self._silent_for + dt)

    def health(self, relative_bias: Floats | None = None) -> ArrayHealth:
        """Judge the sensors as of the last epoch; `relative_bias` (n, 3), rad/s."""
        return judge_silence(self._silent_for, relative_bias)


def judge_silence(silent_for: Floats, relative_bias: Floats | None = None) -> ArrayHealth:
    """Judge n sensors by for how long each has been silent, s; `relative_bias` (n, 3), rad/s."""
    silent, n = silent_for > 0.0, len(silent_for)
    state = silent.astype(np.int8) + (silent_for > SILENT_AFTER)
    bias = np.zeros((n, 3)) if relative_bias is None else relative_bias
    reason = np.where(silent, Reason.SILENT, Reason.NONE).astype(np.int8)
    return ArrayHealth(state.astype(np.int8), reason, np.zeros(n), bias)
