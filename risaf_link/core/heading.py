"""GPS fixes -> heading measurements with their variance, and the account of what came of them.

Equation 4 is that of Hanani and Kipnis, "Robust Extended Kalman Filter for Land Navigation Using
Massive Array of MEMS IMUs".
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal

from msgspec import Meta, Struct

from risaf_link.core.attitude import AttitudeState, Innovation
from risaf_link.core.earth import radii
from risaf_link.core.rotation import wrap

RELATIVE_POSITION_NOISE = 0.1
"""Noise between two consecutive positions as a share of the receiver's absolute accuracy: most of
a receiver's position error changes within minutes, not between fixes."""

UNKNOWN_POSITION_STD = 1.0  # m, where a receiver does not say
UNKNOWN_SPEED_STD = 0.1  # m/s, likewise


class HeadingParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How a heading is made from GPS fixes, and when it is believed."""

    source: Literal["auto", "velocity", "positions", "positions_raw", "dual_antenna"] = "auto"
    min_speed: Annotated[float, Meta(ge=0)] = 1.0  # m/s
    gate: Annotated[float, Meta(gt=0)] = 3.0  # standard deviations of the innovation
    delay: Annotated[float, Meta(ge=0, le=1)] = 0.11  # s from a fix's validity to its arrival
    min_std: Annotated[float, Meta(gt=0)] = 0.02  # rad, of any heading
    timeout: Annotated[float, Meta(gt=0)] = 2.0  # s without a fix until it is gone
    reset_after: Annotated[float, Meta(gt=0)] = 7.0  # s of rejected headings


class HeadingSource(IntEnum):
    """What a heading was made from."""

    NONE = 0
    VELOCITY = 1
    POSITIONS = 2
    POSITIONS_RAW = 3
    DUAL_ANTENNA = 4


@dataclass(frozen=True, slots=True)
class GpsFix:
    """One report of a GPS receiver. NaN: not known."""

    time_us: int  # on the sender's clock; 0: not known
    usable: bool  # the receiver itself calls it a 3D fix or better
    latitude: float  # rad
    longitude: float  # rad
    speed: float  # m/s over ground
    course: float  # rad from true north
    yaw: float  # rad from true north, by two antennas
    speed_std: float  # m/s
    course_std: float  # rad, of course or yaw
    position_std: float  # m, horizontal


@dataclass(frozen=True, slots=True)
class Heading:
    """One measurement of heading."""

    heading: float  # rad from true north, in (-pi, pi]
    variance: float  # rad^2
    source: HeadingSource
    age: float = 0.0  # s before the fix at which it was valid


@dataclass(frozen=True, slots=True)
class Motion:
    """What one fix says about the vehicle's motion."""

    speed: float  # m/s over ground, NaN: not known
    heading: Heading | None  # None: too slow, or nothing to make it from
    speed_std: float = UNKNOWN_SPEED_STD  # m/s


class HeadingFinder:
    """Makes headings from fixes, one after another.

    `velocity` takes the receiver's course over ground; `positions` the direction from the previous
    position to this one (eq. 4) with the convergence of the meridians put right; `positions_raw`
    eq. 4 to the letter, in angles of longitude and latitude; `dual_antenna` the yaw that the
    receiver measures. `auto` takes the first of dual antenna, velocity, positions that a fix
    allows. All but the antennas need `min_speed`: for positions it is the speed between the two
    points, section III.A. A direction between two points is the course half-way between them.
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._parameters = parameters
        self._previous: tuple[GpsFix, float] | None = None

    def take(self, fix: GpsFix, time_s: float) -> Motion:
        """Use the next fix.

        Parameters
        ----------
        fix : GpsFix
            One that is usable.
        time_s : float
            When it came, seconds; stands in where the fix itself has no time.
        """
        source = self._parameters.source
        track = self._track(fix, time_s)
        speed = fix.speed if math.isfinite(fix.speed) else track.speed
        speed_std = _known(fix.speed_std, track.speed_std)
        if source in {"auto", "dual_antenna"} and math.isfinite(fix.yaw):
            return Motion(
                speed, self._heading(fix.yaw, fix.course_std, HeadingSource.DUAL_ANTENNA), speed_std
            )
        if source == "dual_antenna":
            return Motion(speed, None, speed_std)
        by_velocity = math.isfinite(fix.course) and math.isfinite(fix.speed)
        if source == "velocity" or (source == "auto" and by_velocity):
            return Motion(speed, self._from_velocity(fix) if by_velocity else None, speed_std)
        return track

    def _from_velocity(self, fix: GpsFix) -> Heading | None:
        if fix.speed < self._parameters.min_speed:
            return None
        across = _known(fix.speed_std, UNKNOWN_SPEED_STD) / max(fix.speed, 1e-3)
        return self._heading(fix.course, _known(fix.course_std, across), HeadingSource.VELOCITY)

    def _track(self, fix: GpsFix, time_s: float) -> Motion:
        """Speed and heading from the previous position to this one."""
        previous, self._previous = self._previous, (fix, time_s)
        if previous is None:
            return Motion(math.nan, None)
        before, before_s = previous
        timed = fix.time_us and before.time_us
        elapsed = (fix.time_us - before.time_us) / 1e6 if timed else time_s - before_s
        turned_north = fix.latitude - before.latitude
        turned_east = wrap(fix.longitude - before.longitude)
        per_north, per_east = radii((fix.latitude + before.latitude) / 2)
        north, east = float(per_north * turned_north), float(per_east * turned_east)
        distance = math.hypot(north, east)
        if not 0 < elapsed <= self._parameters.timeout or not math.isfinite(distance):
            return Motion(math.nan, None)
        speed = distance / elapsed
        if speed < self._parameters.min_speed or distance == 0.0:
            return Motion(speed, None)
        std = _known(fix.position_std, UNKNOWN_POSITION_STD) * RELATIVE_POSITION_NOISE / distance
        angle, source = math.atan2(east, north), HeadingSource.POSITIONS
        if self._parameters.source == "positions_raw":
            angle, source = math.atan2(turned_east, turned_north), HeadingSource.POSITIONS_RAW
        return Motion(speed, self._heading(angle, std, source, elapsed / 2))

    def _heading(
        self, angle: float, std: float, source: HeadingSource, age: float = 0.0
    ) -> Heading:
        std = min(max(_known(std, 0.0), self._parameters.min_std), math.pi)
        return Heading(wrap(angle), std * std, source, age)


class HeadingState(IntEnum):
    """What the filter does with GPS heading now; GPS_HEADING_STATUS.state."""

    NO_FIX = 0  # no fix, and yaw was never known
    TOO_SLOW = 1  # fixes, but no heading can be made from the last one
    ALIGNING = 2  # a heading has set yaw, none has confirmed it
    FUSING = 3  # the last heading was fused
    REJECTING = 4  # it was rejected
    DEAD_RECKONING = 5  # no fix; yaw is carried on by the gyros alone


@dataclass(frozen=True, slots=True)
class HeadingStatus:
    """GPS heading, and what came of it, at one epoch."""

    time_us: int
    heading: Heading | None  # the last one measured
    innovation: Innovation | None  # what came of it
    yaw: float  # estimated, rad
    yaw_std: float  # rad
    speed: float  # of the last fix, m/s
    time_since_fused: float  # s; NaN: never
    fused_count: int
    rejected_count: int
    state: HeadingState


class HeadingMonitor:
    """Keeps the account of GPS heading: what came, what was fused, and for how long not.

    Parameters
    ----------
    parameters : HeadingParameters
        `timeout` seconds after the last fix there is none; after `reset_after` seconds of rejected
        headings, none of them longer than `timeout` after the one before, the filter is distrusted.
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._parameters = parameters
        self._motion = Motion(math.nan, None)
        self._heading: Heading | None = None
        self._innovation: Innovation | None = None
        self._since_fix = self._since_heading = math.inf
        self._since_fused = math.nan
        self._rejecting_for = 0.0
        self._fused_count = 0
        self._rejected_count = 0

    def advance(self, dt: float) -> None:
        """Let time pass, seconds."""
        self._since_fix += dt
        self._since_heading += dt
        self._since_fused += dt
        if self._since_heading > self._parameters.timeout:
            self._rejecting_for = 0.0
        elif self._innovation is not None and not self._innovation.fused:
            self._rejecting_for += dt

    def note_motion(self, motion: Motion) -> None:
        """Take note of a usable fix."""
        self._since_fix = 0.0
        self._motion = motion

    def note_innovation(self, heading: Heading, innovation: Innovation) -> None:
        """Take note of what the filter made of a heading."""
        self._heading, self._innovation = heading, innovation
        self._since_heading = 0.0
        if innovation.fused:
            self._fused_count += 1
            self._since_fused = self._rejecting_for = 0.0
        else:
            self._rejected_count += 1

    @property
    def distrusts_filter(self) -> bool:
        """Whether headings were rejected for so long that the filter must be wrong, not they."""
        return self._rejecting_for > self._parameters.reset_after

    def status(self, attitude: AttitudeState) -> HeadingStatus:
        """Read the account at an epoch."""
        return HeadingStatus(
            attitude.time_us,
            self._heading,
            self._innovation,
            attitude.euler[2],
            attitude.yaw_std,
            self._motion.speed,
            self._since_fused,
            self._fused_count,
            self._rejected_count,
            self._state(attitude.aligned),
        )

    def _state(self, aligned: bool) -> HeadingState:
        if self._since_fix > self._parameters.timeout:
            return HeadingState.DEAD_RECKONING if aligned else HeadingState.NO_FIX
        if self._motion.heading is None:
            return HeadingState.TOO_SLOW
        if not aligned or self._innovation is None or self._innovation.reset:
            return HeadingState.ALIGNING
        return HeadingState.FUSING if self._innovation.fused else HeadingState.REJECTING


def _known(value: float, otherwise: float) -> float:
    return value if math.isfinite(value) and value > 0 else otherwise
