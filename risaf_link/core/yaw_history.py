"""Yaw of the last seconds, for measurements that come late."""

from collections import deque

from risaf_link.core.rotation import wrap

LENGTH = 4096  # epochs; four seconds at 1 kHz


class YawHistory:
    """Yaw as it was, known as well as it is now: corrections are those of all times before."""

    def __init__(self) -> None:
        self._elapsed = 0.0  # s
        self._yaws: deque[tuple[float, float]] = deque(maxlen=LENGTH)  # without corrections
        self._corrections = 0.0  # their sum

    def advance(self, dt: float, yaw: float) -> None:
        """Take the yaw of the next epoch, rad, `dt` seconds after the one before."""
        self._elapsed += dt
        self._yaws.append((self._elapsed, yaw - self._corrections))

    def correct(self, angle: float) -> None:
        """Take note that yaw was corrected by an angle, rad."""
        self._corrections += angle

    def before(self, age: float) -> float | None:
        """Yaw of `age` seconds ago, interpolated; the oldest where that is too long ago.

        None before the first epoch. It may lie outside of (-pi, pi].
        """
        time = self._elapsed - age
        later = None
        for earlier in reversed(self._yaws):
            if earlier[0] <= time:
                part = (time - earlier[0]) / (later[0] - earlier[0]) if later else 0.0
                change = wrap(later[1] - earlier[1]) if later else 0.0
                return earlier[1] + part * change + self._corrections
            later = earlier
        return later[1] + self._corrections if later else None
