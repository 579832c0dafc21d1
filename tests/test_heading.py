"""Headings from fixes whose course is known, and the account of what came of them."""

import math

import numpy as np
import pytest
from ellipsoid import away, earth_centred, north_east
from msgspec.structs import replace
from numpy import zeros

from risaf_link.core.attitude import AttitudeState, Innovation
from risaf_link.core.heading import (
    GpsFix,
    Heading,
    HeadingFinder,
    HeadingMonitor,
    HeadingParameters,
    HeadingSource,
    HeadingState,
    Motion,
)

NAN = math.nan
PARAN = (math.radians(30.2217), math.radians(34.8012))
DATE_LINE = (math.radians(-17.0), math.pi - 1e-8)
OSLO = (math.radians(60.0), math.radians(10.7))

FIX = GpsFix(
    time_us=10_000_000,
    usable=True,
    latitude=PARAN[0],
    longitude=PARAN[1],
    speed=10.0,
    course=1.0,
    yaw=NAN,
    speed_std=NAN,
    course_std=NAN,
    position_std=NAN,
)


def finder(source="auto", **parameters):
    return HeadingFinder(HeadingParameters(source=source, **parameters))


def at(place, seconds, **values):
    """A fix that knows its place and nothing else."""
    blind = replace(FIX, speed=NAN, course=NAN)
    latitude, longitude = place
    return replace(
        blind,
        time_us=round((10 + seconds) * 1e6),
        latitude=latitude,
        longitude=longitude,
        **values,
    )


def drive(headings, place, way, /, distance=2.0, seconds=0.2, **values):
    """Two fixes, one after another; the motion that is found from them."""
    there = away(*place, distance * math.cos(way), distance * math.sin(way))
    headings.take(at(place, 0.0, **values), 0.0)
    return headings.take(at(there, seconds, **values), 0.0)


# Velocity and antennas


def test_velocity_takes_the_course_and_its_spread_from_the_receiver():
    motion = finder("velocity").take(replace(FIX, course=6.0, course_std=0.05), 0.0)
    assert motion.speed == 10.0
    assert motion.heading.heading == pytest.approx(6.0 - math.tau)
    assert motion.heading.variance == pytest.approx(0.05**2)
    assert (motion.heading.source, motion.heading.age) == (HeadingSource.VELOCITY, 0.0)


@pytest.mark.parametrize(
    ("speed", "speed_std", "std"),
    [
        (2.0, 0.2, 0.1),  # the velocity's error across, over the speed
        (2.0, NAN, 0.05),  # a receiver that does not say errs by 0.1 m/s
        (2.0, 0.0, 0.05),
        (2.0, 0.007, 0.025),  # none tells speed better than 0.05 m/s
        (200.0, 0.1, 0.001),  # none is better than its resolution
        (1.0, 50.0, math.pi),  # none is worse than unknown
    ],
)
def test_a_course_without_a_spread_is_as_good_as_speed_and_its_error_make_it(speed, speed_std, std):
    motion = finder("velocity").take(replace(FIX, speed=speed, speed_std=speed_std), 0.0)
    assert math.sqrt(motion.heading.variance) == pytest.approx(std)


@pytest.mark.parametrize(("course_std", "std"), [(0.2, 0.2), (0.02, 0.05), (NAN, 0.05)])
def test_of_two_spreads_that_a_receiver_tells_the_larger_one_holds(course_std, std):
    fix = replace(FIX, speed=2.0, speed_std=0.1, course_std=course_std)
    heading = finder("velocity").take(fix, 0.0).heading
    assert math.sqrt(heading.variance) == pytest.approx(std)


@pytest.mark.parametrize(
    ("told", "by_sender", "made"),
    [
        ("auto", True, True),
        ("auto", False, False),
        ("always", False, True),
        ("never", True, False),
    ],
)
@pytest.mark.parametrize("source", ["auto", "velocity", "positions"])
def test_the_course_of_what_goes_anywhere_is_no_heading(source, told, by_sender, made):
    headings = finder(source, course_is_heading=told)
    there = away(*PARAN, 2.0, 0.0)
    headings.take(replace(FIX, course_is_heading=by_sender), 0.0)
    fix = replace(FIX, time_us=FIX.time_us + 200_000, latitude=there[0], longitude=there[1])
    motion = headings.take(replace(fix, course_is_heading=by_sender), 0.2)
    assert (motion.heading is not None) is made
    assert motion.along is made
    antennas = replace(fix, time_us=fix.time_us + 200_000, yaw=1.0, course_is_heading=by_sender)
    if source == "auto":
        assert headings.take(antennas, 0.4).heading.source is HeadingSource.DUAL_ANTENNA


def test_antennas_without_a_yaw_now_are_waited_for_before_the_course_stands_in():
    headings = finder("auto")
    silent = replace(FIX, yaw_capable=True)
    assert headings.take(silent, 0.0).heading is None
    assert headings.take(replace(silent, yaw=1.0), 5.0).heading is not None
    assert headings.take(silent, 14.0).heading is None
    assert headings.take(silent, 15.1).heading.source is HeadingSource.VELOCITY
    back = headings.take(replace(silent, yaw=1.0), 15.3)
    assert back.heading.source is HeadingSource.DUAL_ANTENNA


def test_a_receiver_with_one_antenna_is_not_waited_for():
    assert finder("auto").take(FIX, 0.0).heading.source is HeadingSource.VELOCITY


@pytest.mark.parametrize("source", ["auto", "velocity"])
def test_below_the_least_speed_there_is_no_course(source):
    headings = finder(source, min_speed=3.0)
    slow = headings.take(replace(FIX, speed=2.99), 0.0)
    assert (slow.speed, slow.heading) == (2.99, None)
    assert headings.take(replace(FIX, speed=3.0), 0.2).heading is not None


@pytest.mark.parametrize("unknown", [{"course": NAN}, {"speed": NAN}])
def test_velocity_makes_nothing_of_a_fix_without_speed_or_course(unknown):
    assert finder("velocity").take(replace(FIX, **unknown), 0.0).heading is None


@pytest.mark.parametrize("source", ["auto", "dual_antenna"])
def test_two_antennas_need_no_speed(source):
    parked = replace(FIX, speed=0.0, course=NAN, yaw=3.5, course_std=0.03)
    motion = finder(source).take(parked, 0.0)
    assert motion.speed == 0.0
    assert motion.heading == Heading(
        pytest.approx(3.5 - math.tau), pytest.approx(0.0009), HeadingSource.DUAL_ANTENNA
    )


def test_dual_antenna_waits_while_auto_falls_back_on_velocity_and_positions():
    without_yaw = replace(FIX, yaw=NAN)
    assert finder("dual_antenna").take(without_yaw, 0.0).heading is None
    assert finder("auto").take(without_yaw, 0.0).heading.source is HeadingSource.VELOCITY
    by_positions = drive(finder("auto"), PARAN, 0.5)
    assert by_positions.heading.source is HeadingSource.POSITIONS


# Positions


@pytest.mark.parametrize("place", [PARAN, DATE_LINE, OSLO], ids=["Paran", "date line", "Oslo"])
@pytest.mark.parametrize("course", [0.0, math.pi / 2, math.pi, -math.pi / 2, 0.7, -2.5])
def test_the_way_between_two_positions_has_the_course_that_was_driven(place, course):
    motion = drive(finder("positions"), place, course)
    assert math.cos(motion.heading.heading - course) == pytest.approx(1.0)
    assert math.sin(motion.heading.heading - course) == pytest.approx(0.0, abs=1e-5)
    assert motion.speed == pytest.approx(10.0, rel=1e-3)
    assert (motion.heading.source, motion.heading.age) == (HeadingSource.POSITIONS, 0.1)


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_on_a_turn_the_way_has_the_course_of_half_way_between_its_points(seconds):
    headings, rate, radius = finder("positions"), math.radians(30), 20.0

    def circle(time_s):
        return away(*PARAN, radius * math.sin(rate * time_s), -radius * math.cos(rate * time_s))

    headings.take(at(circle(0.0), 0.0), 0.0)
    heading = headings.take(at(circle(seconds), seconds), seconds).heading
    assert heading.age == pytest.approx(seconds / 2)
    assert heading.heading == pytest.approx(rate * (seconds - heading.age), abs=1e-4)


def test_half_a_turn_is_positive():
    motion = drive(finder("positions"), PARAN, math.pi)
    assert abs(motion.heading.heading) == pytest.approx(math.pi, abs=1e-6)


@pytest.mark.parametrize("course", [0.0, 0.7, math.pi / 2, -2.5])
def test_equation_4_to_the_letter_is_off_by_the_convergence_of_the_meridians(course):
    there = away(*OSLO, 20 * math.cos(course), 20 * math.sin(course))
    way = earth_centred(*there) - earth_centred(*OSLO)
    true_north, true_east = north_east(*OSLO) @ way
    motion = drive(finder("positions_raw"), OSLO, course, distance=20.0)
    assert motion.heading.source is HeadingSource.POSITIONS_RAW
    letter = math.atan2(there[1] - OSLO[1], there[0] - OSLO[0])
    assert motion.heading.heading == pytest.approx(letter, abs=1e-6)
    # a degree of longitude is half as long here as one of latitude
    stretched = math.atan2(2 * true_east, true_north)
    assert motion.heading.heading == pytest.approx(stretched, abs=2e-3)


@pytest.mark.parametrize(
    ("position_std", "std"), [(2.0, 0.1), (NAN, 0.05), (0.0, 0.05), (0.01, 0.001), (1e4, math.pi)]
)
def test_a_way_is_as_good_as_its_length_and_the_receivers_noise_make_it(position_std, std):
    motion = drive(finder("positions"), PARAN, 1.0, position_std=position_std)
    assert math.sqrt(motion.heading.variance) == pytest.approx(std, rel=1e-3)


def test_the_speed_that_gates_a_way_is_that_between_its_points():
    headings = finder("positions", min_speed=5.0)
    slow = drive(headings, PARAN, 1.0, distance=0.9, speed=30.0, course=0.0)
    assert (slow.speed, slow.heading) == (pytest.approx(4.5, rel=1e-3), None)
    fast = drive(headings, PARAN, 1.0, distance=1.1, speed=0.0, course=0.0)
    assert fast.heading.heading == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("source", ["positions", "positions_raw"])
def test_one_position_alone_and_one_that_has_not_moved_have_no_direction(source):
    headings = finder(source, min_speed=0.0)
    first = headings.take(at(PARAN, 0.0), 0.0)
    assert math.isnan(first.speed)
    assert first.heading is None
    second = headings.take(at(PARAN, 0.2), 0.0)
    assert (second.speed, second.heading) == (0.0, None)


@pytest.mark.parametrize("seconds", [2.1, 0.0, -0.2])
def test_a_previous_position_that_is_stale_or_later_is_not_used_but_the_next_one_is(seconds):
    headings = finder("positions", timeout=2.0)
    assert drive(headings, PARAN, 1.0, distance=30.0, seconds=seconds).heading is None
    assert drive(headings, PARAN, 1.0).heading is not None


@pytest.mark.parametrize("lost", ["latitude", "longitude"])
def test_a_position_that_is_not_known_is_passed_over(lost):
    headings = finder("positions")
    headings.take(replace(at(PARAN, 0.0), **{lost: NAN}), 0.0)
    assert headings.take(at(PARAN, 0.2), 0.2).heading is None
    assert drive(headings, PARAN, 1.0).heading is not None


@pytest.mark.parametrize("untimed", [(0, 0), (0, 10_200_000), (10_000_000, 0)])
def test_fixes_without_a_time_are_as_far_apart_as_they_came(untimed):
    headings = finder("positions")
    there = away(*PARAN, 2.0, 0.0)
    headings.take(replace(at(PARAN, 0.0), time_us=untimed[0]), 5.0)
    motion = headings.take(replace(at(there, 0.0), time_us=untimed[1]), 5.4)
    assert motion.speed == pytest.approx(5.0, rel=1e-3)
    assert motion.heading.age == pytest.approx(0.2)


# The account

HEADING = Heading(1.0, 0.01, HeadingSource.VELOCITY)
MOVING = Motion(10.0, HEADING)
PARKED = Motion(0.2, None)
FUSED = Innovation(0.1, 0.01, 3.0)
REJECTED = Innovation(1.0, 0.01, 3.0)
RESET = Innovation(1.0, 0.01, 3.0, reset=True)


class Account:
    """A monitor, told of one event after another."""

    def __init__(self):
        self.monitor = HeadingMonitor(HeadingParameters(timeout=2.0))
        self.resets, self.elapsed = 0, 0.0

    def wait(self, seconds, dt=0.1):
        for _ in range(round(seconds / dt)):
            self.elapsed += dt
            self.monitor.advance(np.array([self.elapsed]), np.array([self.resets > 0]))

    def fix(self, motion, innovation=None):
        self.monitor.note_motion(motion)
        if innovation:
            self.monitor.note_innovation(motion.heading, innovation)
            self.resets += innovation.reset

    def headings(self, innovation, seconds):
        """A heading five times a second."""
        for _ in range(round(seconds * 5)):
            self.wait(0.2)
            self.fix(MOVING, innovation)

    @property
    def status(self):
        attitude = AttitudeState(
            7, zeros(4) + 0.5, zeros(3), zeros(3), 0.1, 0.1, 0.2, self.resets > 0, self.resets
        )
        now, aligned = np.array([self.elapsed]), np.array([attitude.aligned])
        return self.monitor.advance(now, aligned).at(0, attitude)

    @property
    def state(self):
        return self.status.state


@pytest.fixture
def account():
    return Account()


def test_before_anything_came_there_is_no_fix_and_nothing_is_known(account):
    status = account.status
    assert (status.state, status.heading, status.innovation) == (HeadingState.NO_FIX, None, None)
    assert math.isnan(status.speed)
    assert math.isnan(status.time_since_fused)
    assert (status.fused_count, status.rejected_count) == (0, 0)
    assert (status.time_us, status.yaw_std) == (7, 0.2)
    assert status.yaw == pytest.approx(math.pi / 2)


def test_from_the_first_fix_over_driving_and_a_stop_to_dead_reckoning_and_back(account):
    account.fix(PARKED)
    assert account.state is HeadingState.TOO_SLOW
    account.fix(MOVING, RESET)
    assert account.state is HeadingState.ALIGNING
    account.headings(FUSED, 1.0)
    assert account.state is HeadingState.FUSING
    account.headings(REJECTED, 1.0)
    assert account.state is HeadingState.REJECTING
    account.fix(PARKED)
    assert account.state is HeadingState.TOO_SLOW
    account.wait(1.9)
    assert account.state is HeadingState.TOO_SLOW
    account.wait(0.2)
    assert account.state is HeadingState.DEAD_RECKONING
    account.fix(MOVING, FUSED)
    assert account.state is HeadingState.FUSING


def test_without_ever_a_heading_a_lost_fix_is_no_dead_reckoning(account):
    account.fix(PARKED)
    account.wait(3.0)
    assert account.state is HeadingState.NO_FIX


def test_the_account_counts_and_says_how_long_ago_a_heading_was_fused(account):
    account.fix(MOVING, RESET)
    account.headings(FUSED, 2.0)
    account.headings(REJECTED, 1.0)
    status = account.status
    assert (status.fused_count, status.rejected_count) == (11, 5)
    assert status.time_since_fused == pytest.approx(1.0)
    assert (status.heading, status.innovation, status.speed) == (HEADING, REJECTED, 10.0)


def test_an_innovation_is_fused_up_to_its_gate_and_always_when_it_resets():
    at_the_gate = Innovation(-0.75, 0.0625, 3.0)
    assert (at_the_gate.test_ratio, at_the_gate.fused) == (1.0, True)
    beyond = replace(at_the_gate, value=-0.7501)
    assert (beyond.test_ratio > 1, beyond.fused) == (True, False)
    assert replace(beyond, reset=True).fused
