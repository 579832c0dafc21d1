"""How far an estimated heading was from a reference."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats, wrap, wraps


@dataclass(frozen=True, slots=True)
class HeadingScore:
    """Heading errors over a stretch of time."""

    samples: int
    rmse: float  # rad, root of the mean square
    final: float  # rad, size of the last error
    largest: float  # rad
    drift: float  # rad/s: by how much the error grew or shrank from first to last, over the time


class ErrorAccount:
    """Adds up heading errors, in constant memory.

    Sizes are those of wrapped errors; the drift follows an error through half a turn, as long as it
    changes by less than that between two samples.
    """

    def __init__(self) -> None:
        self._samples = 0
        self._squares = 0.0
        self._largest = 0.0
        self._first = self._last = (0.0, 0.0)  # time, s; error, rad, unwrapped

    def add(self, time_s: float, error: float) -> None:
        """Take one error, rad, at a time, s, that is not before the last one."""
        if self._samples:
            error = self._last[1] + wrap(error - self._last[1])
        else:
            self._first = (time_s, error)
        self._last = (time_s, error)
        self._samples += 1
        size = abs(wrap(error))
        self._squares += size * size
        self._largest = max(self._largest, size)

    def add_all(self, time_s: Floats, errors: Floats) -> None:
        """Take errors, (m,) rad, at times, (m,) s, in the order of time."""
        if not len(errors):
            return
        last = self._last[1] if self._samples else float(errors[0])
        unwrapped = last + np.cumsum(wraps(np.diff(errors, prepend=last)))
        if not self._samples:
            self._first = (float(time_s[0]), float(unwrapped[0]))
        self._last = (float(time_s[-1]), float(unwrapped[-1]))
        self._samples += len(errors)
        sizes = np.abs(wraps(unwrapped))
        self._squares += float(sizes @ sizes)
        self._largest = max(self._largest, float(sizes.max()))

    def score(self) -> HeadingScore | None:
        """The score so far; None without any error."""
        if not self._samples:
            return None
        seconds = self._last[0] - self._first[0]
        return HeadingScore(
            self._samples,
            math.sqrt(self._squares / self._samples),
            abs(wrap(self._last[1])),
            self._largest,
            abs(self._last[1] - self._first[1]) / seconds if seconds > 0 else 0.0,
        )


class YawTrack:
    """The last seconds of an estimated yaw, to be read at times in between.

    Parameters
    ----------
    length : int
        How many estimates are kept.
    """

    def __init__(self, length: int = 4096) -> None:
        self._points: deque[tuple[int, float]] = deque(maxlen=length)

    def add(self, time_us: int, yaw: float) -> None:
        """Take the next estimate; where time goes back the track starts anew."""
        if self._points and time_us < self._points[-1][0]:
            self._points.clear()
        self._points.append((time_us, yaw))

    def at(self, time_us: int) -> float | None:
        """Yaw at a time, interpolated, rad; None where the track does not reach.

        Between two points it may lie up to half a turn outside of (-pi, pi].
        """
        later = None
        for point in reversed(self._points):
            if point[0] == time_us:
                return point[1]
            if point[0] < time_us:
                return _between(point, later, time_us) if later else None
            later = point
        return None


def _between(earlier: tuple[int, float], later: tuple[int, float], time_us: int) -> float:
    part = (time_us - earlier[0]) / (later[0] - earlier[0])
    return earlier[1] + part * wrap(later[1] - earlier[1])
