"""The faults of a GPS receiver that goes on to report a fix.

Times are in seconds from the start.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.earth import radii
from risaf_link.core.rotation import Floats
from risaf_link.sim.receiver import Fixes

BEGIN, LENGTH = 50.0, 40.0  # s: the heading has settled; every scenario has GPS until 100 s


class ReceiverFault(Protocol):
    """A kind of fault, with its parameters."""

    def spoil(self, fixes: Fixes) -> Fixes:
        """What the receiver reports in the place of these fixes."""
        ...


@dataclass(frozen=True, slots=True)
class CourseError:
    """A velocity whose direction is off, by an angle that may grow; the positions are right."""

    size: float  # rad, at the beginning
    slope: float = 0.0  # rad/s
    begin: float = BEGIN  # s
    length: float = LENGTH  # s
    every: float = math.inf  # s, from one beginning to the next

    def spoil(self, fixes: Fixes) -> Fixes:
        """Turn the course."""
        since = fixes.time_s - self.begin
        since = np.where(since < 0.0, since, np.remainder(since, self.every))
        angle = np.where(_lasts(since, self.length), self.size + self.slope * since, 0.0)
        return replace(fixes, course=_wrapped(fixes.course + angle))


@dataclass(frozen=True, slots=True)
class LedAstray:
    """A way that turns off from the true one, positions and velocity alike, as by a spoofer."""

    slope: float  # rad/s
    begin: float = BEGIN  # s
    length: float = LENGTH  # s

    def spoil(self, fixes: Fixes) -> Fixes:
        """Turn the course, and go that way."""
        since = fixes.time_s - self.begin
        lasts = _lasts(since, self.length)
        course = fixes.course + np.where(lasts, self.slope * since, 0.0)
        step = np.diff(fixes.time_s, prepend=fixes.time_s[:1])
        north = np.cumsum(fixes.speed * (np.cos(course) - np.cos(fixes.course)) * step)
        east = np.cumsum(fixes.speed * (np.sin(course) - np.sin(fixes.course)) * step)
        moved = _moved(fixes, lasts * north, lasts * east)
        return replace(moved, course=_wrapped(course))


@dataclass(frozen=True, slots=True)
class PositionJump:
    """Positions that are off by a constant way; the velocity is right."""

    north: float  # m
    east: float  # m
    begin: float = BEGIN  # s
    length: float = LENGTH  # s

    def spoil(self, fixes: Fixes) -> Fixes:
        """Move the positions."""
        lasts = _lasts(fixes.time_s - self.begin, self.length)
        return _moved(fixes, lasts * self.north, lasts * self.east)


@dataclass(frozen=True, slots=True)
class Stuck:
    """A receiver that repeats one report with new times."""

    begin: float = BEGIN  # s
    length: float = LENGTH  # s

    def spoil(self, fixes: Fixes) -> Fixes:
        """Repeat the report at the beginning."""
        lasts = _lasts(fixes.time_s - self.begin, self.length)
        if not lasts.any():
            return fixes
        shown = np.where(lasts, np.argmax(lasts), np.arange(len(lasts)))
        names = ("latitude", "longitude", "altitude", "speed", "course", "course_std")
        return replace(fixes, **{name: getattr(fixes, name)[shown] for name in names})


RECEIVER_FAULTS: dict[str, ReceiverFault] = {
    "gps_jump": CourseError(size=math.radians(45.0)),
    "gps_drift": CourseError(size=0.0, slope=math.radians(0.5)),
    "gps_spoofed": LedAstray(slope=math.radians(0.5)),
    "gps_position": PositionJump(north=300.0, east=-200.0),
    "gps_frozen": Stuck(),
}
"""Every fault by its name."""


def _lasts(since: Floats, length: float) -> NDArray[np.bool_]:
    lasts: NDArray[np.bool_] = (since >= 0.0) & (since < length)
    return lasts


def _moved(fixes: Fixes, north: NDArray[Any], east: NDArray[Any]) -> Fixes:
    per_north, per_east = radii(fixes.latitude, fixes.altitude)
    return replace(
        fixes,
        latitude=fixes.latitude + north / per_north,
        longitude=fixes.longitude + east / per_east,
    )


def _wrapped(angle: Floats) -> Floats:
    wrapped: Floats = math.pi - np.remainder(math.pi - angle, math.tau)
    return wrapped
