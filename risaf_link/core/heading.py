"""GPS fixes -> heading measurements with their variance, and the account of what came of them.

Equation 4 is that of Hanani and Kipnis, "Robust Extended Kalman Filter for Land Navigation Using
Massive Array of MEMS IMUs".
"""

import math
from collections import deque
from enum import IntEnum
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from risaf_link.core.attitude import AttitudeState, Innovation
from risaf_link.core.earth import radii
from risaf_link.core.rotation import Floats, wrap, yaw_of
from risaf_link.core.tunable import Tunable

Metres = Annotated[float, Meta(ge=-1000, le=1000)]

RELATIVE_POSITION_NOISE = 0.1
"""Noise between two consecutive positions as a share of the receiver's absolute accuracy: most of
a receiver's position error changes within minutes, not between fixes."""

UNKNOWN_POSITION_STD = 1.0  # m, where a receiver does not say
UNKNOWN_SPEED_STD = 0.1  # m/s, likewise
LEAST_SPEED_STD = 0.05  # m/s; Doppler is not better, whatever a receiver says
RESOLUTION = 1e-3  # rad, of a course or yaw
WITNESS_TIME = 5.0  # s for which velocity is added up and held against positions
WITNESS_GATE = 4.0  # standard deviations of a position
WITNESS_SHARE = 0.2  # of the way: the course is filtered, and later or earlier than the position
POLAR_CAP = math.radians(88.0)  # beyond, 30 m/s along a parallel turn north by 0.5 deg a minute
ANTENNA_PATIENCE = 10.0  # s for which two antennas that have no yaw now are waited for


class HeadingParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How a heading is made from GPS fixes, and when it is believed."""

    source: Annotated[
        Literal["auto", "velocity", "positions", "positions_raw", "dual_antenna"],
        Tunable("HDG_SOURCE"),
    ] = "auto"
    """auto: dual antenna, else velocity, else positions; velocity: course over ground; positions:
    from fix to fix; positions_raw: the same in degrees of longitude and latitude, as the paper has
    it; dual_antenna."""
    course_is_heading: Annotated[Literal["auto", "always", "never"], Tunable("HDG_COURSE")] = "auto"
    """auto: unless the autopilot's HEARTBEAT is that of an aircraft or a submarine; always; never:
    two antennas alone tell the heading. A vehicle in reverse is found out."""
    min_speed: Annotated[float, Meta(ge=0, le=1000), Tunable("HDG_MIN_SPEED", "m/s")] = 1.0
    """below, course is noise (dual antenna needs no speed)."""
    gate: Annotated[float, Meta(gt=0, le=1000), Tunable("HDG_GATE", "standard deviations")] = 3.0
    """of the innovation, beyond which a heading is rejected."""
    delay: Annotated[float, Meta(ge=0, le=1), Tunable("HDG_DELAY", "s")] = 0.11
    """from a fix's validity to its arrival; receivers have 0.1 to 0.3."""
    delay_std: Annotated[float, Meta(ge=0, le=1), Tunable("HDG_DELAY_STD", "s")] = 0.1
    """how far that may be wrong; eskf learns it in turns."""
    offset_std: Annotated[float, Meta(ge=0, le=1), Tunable("HDG_OFFSET_STD", "rad")] = 0.003
    """how far heading may be off for long, by antennas or a crabbing vehicle: yaw is never held to
    be better known."""
    yaw_offset: Annotated[float, Meta(ge=-7, le=7), Tunable("HDG_YAW_OFFSET", "rad")] = 0.0
    """from forward to the right of the second antenna as seen from the first; taken off the yaw of
    two antennas."""
    antenna: Annotated[
        tuple[Metres, Metres, Metres], Tunable(("HDG_ANT_X", "HDG_ANT_Y", "HDG_ANT_Z"), "m")
    ] = (0.0, 0.0, 0.0)
    """forward, right and down, from the point that goes where the vehicle points (rear axle) to the
    antenna, which swings out in a turn."""
    timeout: Annotated[float, Meta(gt=0, le=1e6), Tunable("HDG_TIMEOUT", "s")] = 2.0
    """without a new fix after which dead reckoning is declared."""
    reset_after: Annotated[float, Meta(gt=0, le=1e6), Tunable("HDG_RESET_AFTER", "s")] = 10.0
    """of rejected headings that agree with one another and the gyros until yaw is set anew; up to
    six times as long if yaw was confirmed for longer."""


class HeadingSource(IntEnum):
    """What a heading was made from."""

    NONE = 0
    VELOCITY = 1
    POSITIONS = 2
    POSITIONS_RAW = 3
    DUAL_ANTENNA = 4


class GpsFix(Struct, frozen=True):
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
    yaw_capable: bool = False  # it has two antennas, whether they have a yaw now or not
    course_is_heading: bool = True  # so far as its sender tells: of a vehicle that hovers it is not


class Heading(Struct, frozen=True):
    """One measurement of heading."""

    heading: float  # rad from true north, in (-pi, pi]
    variance: float  # rad^2
    source: HeadingSource
    age: float = 0.0  # s before the fix at which it was valid


class Motion(Struct, frozen=True):
    """What one fix says about the vehicle's motion."""

    speed: float  # m/s over ground, NaN: not known
    heading: Heading | None  # None: too slow, or nothing to make it from
    speed_std: float = UNKNOWN_SPEED_STD  # m/s
    course: float = math.nan  # rad; NaN: too slow, or not known
    along: bool = True  # the vehicle goes where it points, or backwards
    is_news: bool = True  # it differs from the fix before
    contradicted: bool = False  # by the receiver's own positions
    polar: bool = False  # so near to a pole that north does not stay where it is


UNKNOWN_TRACK = Motion(math.nan, None)


class _Seen(Struct, frozen=True):
    """A fix, and what its velocity and those before it add up to."""

    time_s: float
    fix: GpsFix
    speed_north: float  # m/s
    speed_east: float
    north: float  # m
    east: float
    way: float


class PositionWitness:
    """Holds a receiver's velocity against its own positions, over some seconds.

    What the velocity adds up to must be the way between the positions. A receiver that was once
    seen to agree with itself, on a way longer than its positions err, and then does not is frozen,
    has jumped or is led astray; one that never agreed says nothing by it.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._seen: deque[_Seen] = deque()
        self._was_borne_out = False

    def contradicts(self, fix: GpsFix, time_s: float) -> bool:
        """Whether the positions speak against the velocity of a fix that came at `time_s`."""
        if not all(map(math.isfinite, _content(fix))):
            self._seen.clear()
            return False
        speed_north = fix.speed * math.cos(fix.course)
        speed_east = fix.speed * math.sin(fix.course)
        north = east = way = 0.0
        if self._seen:
            last = self._seen[-1]
            timed = fix.time_us and last.fix.time_us
            elapsed = (fix.time_us - last.fix.time_us) / 1e6 if timed else time_s - last.time_s
            if not 0 < elapsed <= self.timeout:
                self._seen.clear()
            half = 0.5 * elapsed  # the trapezoidal rule
            north = last.north + half * (last.speed_north + speed_north)
            east = last.east + half * (last.speed_east + speed_east)
            way = last.way + half * (last.fix.speed + fix.speed)
            time_s = last.time_s + elapsed
        self._seen.append(_Seen(time_s, fix, speed_north, speed_east, north, east, way))
        while time_s - self._seen[0].time_s > WITNESS_TIME:
            self._seen.popleft()
        first = self._seen[0]
        per_north, per_east = radii((fix.latitude + first.fix.latitude) / 2)
        missed = math.hypot(
            float(per_north) * (fix.latitude - first.fix.latitude) - (north - first.north),
            float(per_east) * wrap(fix.longitude - first.fix.longitude) - (east - first.east),
        )
        spread = math.sqrt(2.0) * _known(fix.position_std, UNKNOWN_POSITION_STD)
        allowed = WITNESS_GATE * spread + WITNESS_SHARE * (way - first.way)
        if missed <= allowed:
            self._was_borne_out |= way - first.way > 1.5 * allowed
            return False
        return self._was_borne_out


class HeadingFinder:
    """Makes headings from fixes, one after another.

    `velocity` takes the receiver's course over ground; `positions` the direction from the previous
    position to this one (eq. 4) with the convergence of the meridians put right; `positions_raw`
    eq. 4 to the letter, in angles of longitude and latitude; `dual_antenna` the yaw that the
    receiver measures. `auto` takes the first of dual antenna, velocity, positions that a fix
    allows; antennas that had a yaw, or say that they can, are waited for. All but the antennas need
    a vehicle whose course is its heading, and `min_speed`: for positions it is the speed between
    the two points, section III.A. A direction between two points is the course half-way between
    them. Beyond `POLAR_CAP` no fix says a heading.
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._parameters = parameters
        self._previous: tuple[GpsFix, float] | None = None
        self._witness = PositionWitness(parameters.timeout)
        self._yaw_s = -math.inf  # when there was a yaw, or could have been for the first time

    def configure(self, parameters: HeadingParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self._parameters = parameters
        self._witness.timeout = parameters.timeout

    def take(self, fix: GpsFix, time_s: float) -> Motion:
        """Use the next fix.

        Parameters
        ----------
        fix : GpsFix
            One that is usable.
        time_s : float
            When it came, seconds; stands in where the fix itself has no time.
        """
        previous, self._previous = self._previous, (fix, time_s)
        by_positions = self._parameters.source.startswith("positions")
        by_velocity = math.isfinite(fix.course) and math.isfinite(fix.speed) and not by_positions
        track = UNKNOWN_TRACK if by_velocity else self._track(previous, fix, time_s)
        by_track = by_positions or math.isnan(fix.speed)
        polar = abs(fix.latitude) > POLAR_CAP
        heading = self._choose(fix, by_velocity, track, time_s)
        return Motion(
            track.speed if by_track else fix.speed,
            None if polar else heading,
            track.speed_std if by_track else _known(fix.speed_std, UNKNOWN_SPEED_STD),
            fix.course if fix.speed >= self._parameters.min_speed else math.nan,
            self._goes_ahead(fix),
            previous is None or _content(fix) != _content(previous[0]),
            self._witness.contradicts(fix, time_s),
            polar,
        )

    def _goes_ahead(self, fix: GpsFix) -> bool:
        told = self._parameters.course_is_heading
        return fix.course_is_heading if told == "auto" else told == "always"

    def _choose(
        self, fix: GpsFix, by_velocity: bool, track: Motion, time_s: float
    ) -> Heading | None:
        source = self._parameters.source
        if source in {"auto", "dual_antenna"} and math.isfinite(fix.yaw):
            self._yaw_s = time_s
            yaw = fix.yaw - self._parameters.yaw_offset
            return _heading(yaw, _known(fix.course_std, 0.0), HeadingSource.DUAL_ANTENNA)
        if fix.yaw_capable:
            self._yaw_s = time_s if math.isinf(self._yaw_s) else self._yaw_s
        awaited = source == "auto" and time_s - self._yaw_s < ANTENNA_PATIENCE
        if source == "dual_antenna" or awaited or not self._goes_ahead(fix):
            return None
        if source == "velocity" or (source == "auto" and by_velocity):
            return self._from_velocity(fix) if by_velocity else None
        return track.heading

    def _from_velocity(self, fix: GpsFix) -> Heading | None:
        """Course over ground: as good as the worse of what the receiver says in two ways."""
        if fix.speed < self._parameters.min_speed:
            return None
        told = math.isfinite(fix.course_std) and fix.course_std > 0
        speed_std = _known(fix.speed_std, LEAST_SPEED_STD if told else UNKNOWN_SPEED_STD)
        across = max(speed_std, LEAST_SPEED_STD) / max(fix.speed, 1e-3)
        std = max(fix.course_std, across) if told else across
        return _heading(fix.course, std, HeadingSource.VELOCITY)

    def _track(self, previous: tuple[GpsFix, float] | None, fix: GpsFix, time_s: float) -> Motion:
        """Speed and heading from the previous position to this one."""
        if previous is None:
            return UNKNOWN_TRACK
        before, before_s = previous
        timed = fix.time_us and before.time_us
        elapsed = (fix.time_us - before.time_us) / 1e6 if timed else time_s - before_s
        turned_north = fix.latitude - before.latitude
        turned_east = wrap(fix.longitude - before.longitude)
        per_north, per_east = radii((fix.latitude + before.latitude) / 2)
        north, east = float(per_north * turned_north), float(per_east * turned_east)
        distance = math.hypot(north, east)
        if not 0 < elapsed <= self._parameters.timeout or not math.isfinite(distance):
            return UNKNOWN_TRACK
        speed = distance / elapsed
        if speed < self._parameters.min_speed or distance == 0.0:
            return Motion(speed, None)
        std = _known(fix.position_std, UNKNOWN_POSITION_STD) * RELATIVE_POSITION_NOISE / distance
        angle, source = math.atan2(east, north), HeadingSource.POSITIONS
        if self._parameters.source == "positions_raw":
            angle, source = math.atan2(turned_east, turned_north), HeadingSource.POSITIONS_RAW
        return Motion(speed, _heading(angle, std, source, elapsed / 2))


def _heading(angle: float, std: float, source: HeadingSource, age: float = 0.0) -> Heading:
    std = min(max(std, RESOLUTION), math.pi)
    return Heading(wrap(angle), std * std, source, age)


def _content(fix: GpsFix) -> tuple[float, ...]:
    return fix.latitude, fix.longitude, fix.speed, fix.course


class HeadingState(IntEnum):
    """What the filter does with GPS heading now; GPS_HEADING_STATUS.state."""

    NO_FIX = 0  # no fix, and yaw was never known
    TOO_SLOW = 1  # fixes, but no heading can be made from the last one
    ALIGNING = 2  # a heading has set yaw, none has confirmed it
    FUSING = 3  # the last heading was fused
    REJECTING = 4  # it was rejected
    DEAD_RECKONING = 5  # no fix; yaw is carried on by the gyros alone


States = tuple[HeadingState, HeadingState]
"""While yaw is not known, and when it is."""

WITHOUT_FIX: States = (HeadingState.NO_FIX, HeadingState.DEAD_RECKONING)


class HeadingStatus(Struct, frozen=True):
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


class HeadingTrack(Struct, frozen=True):
    """`HeadingStatus` at k epochs between which no fix came."""

    heading: Heading | None
    innovation: Innovation | None
    speed: float  # m/s
    fused_count: int
    rejected_count: int
    fused_s: float  # when a heading was fused; NaN: never
    lost_s: float  # from when on there is no fix
    with_fix: States  # until then
    elapsed: Floats  # (k,) s
    aligned: Floats  # (k,) 1: yaw is known; 0: it is not

    @property
    def state(self) -> NDArray[np.int64]:
        """HeadingState at each epoch, (k,)."""
        states = np.array((self.with_fix, WITHOUT_FIX), np.int64)
        return states[(self.elapsed > self.lost_s).astype(np.intp), self.aligned.astype(np.intp)]

    def at(self, i: int, attitude: AttitudeState) -> HeadingStatus:
        """The account at one epoch."""
        elapsed = float(self.elapsed[i])
        states = WITHOUT_FIX if elapsed > self.lost_s else self.with_fix
        return HeadingStatus(
            attitude.time_us,
            self.heading,
            self.innovation,
            yaw_of(attitude.q_nb),
            attitude.yaw_std,
            self.speed,
            elapsed - self.fused_s,
            self.fused_count,
            self.rejected_count,
            states[attitude.aligned],
        )


class HeadingMonitor:
    """Keeps the account of GPS heading: what came, what was fused, and for how long not.

    Parameters
    ----------
    parameters : HeadingParameters
        `timeout` seconds after the last fix there is none.
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._parameters = parameters
        self._motion = Motion(math.nan, None)
        self._heading: Heading | None = None
        self._innovation: Innovation | None = None
        self._elapsed = 0.0  # s
        self._fix_s = -math.inf  # when the last one came
        self._fused_s = math.nan
        self._fused_count = 0
        self._rejected_count = 0

    def configure(self, parameters: HeadingParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self._parameters = parameters

    def advance(self, elapsed: Floats, aligned: Floats) -> HeadingTrack:
        """Let k epochs pass, with yaw known, 1, or not, 0; nothing is noted in between.

        Parameters
        ----------
        elapsed : ndarray, shape (k,)
            Time of each, s.
        aligned : ndarray, shape (k,)
        """
        self._elapsed = float(elapsed[-1])
        return HeadingTrack(
            self._heading,
            self._innovation,
            self._motion.speed,
            self._fused_count,
            self._rejected_count,
            self._fused_s,
            self._fix_s + self._parameters.timeout,
            self._with_fix(),
            elapsed,
            aligned,
        )

    def note_motion(self, motion: Motion) -> None:
        """Take note of a usable fix."""
        self._fix_s = self._elapsed
        self._motion = motion

    def note_innovation(self, heading: Heading, innovation: Innovation) -> None:
        """Take note of what the filter made of a heading."""
        self._heading, self._innovation = heading, innovation
        if innovation.fused:
            self._fused_count += 1
            self._fused_s = self._elapsed
        else:
            self._rejected_count += 1

    def _with_fix(self) -> States:
        if self._motion.heading is None:
            return HeadingState.TOO_SLOW, HeadingState.TOO_SLOW
        if self._innovation is None or self._innovation.reset:
            return HeadingState.ALIGNING, HeadingState.ALIGNING
        judged = HeadingState.FUSING if self._innovation.fused else HeadingState.REJECTING
        return HeadingState.ALIGNING, judged


def _known(value: float, otherwise: float) -> float:
    return value if math.isfinite(value) and value > 0 else otherwise
