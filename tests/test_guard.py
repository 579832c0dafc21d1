"""What comes of headings that are right, late, backwards, off, drifting, frozen or made up."""

import math
from collections import deque

import numpy as np
import pytest
from msgspec.structs import replace
from msgspec.structs import replace as set_parameters

from risaf_link.core.attitude import AttitudeParameters, Innovation, PaperFilter
from risaf_link.core.earth import GRAVITY, radii
from risaf_link.core.error_state import LATE, Gravity
from risaf_link.core.eskf import Eskf
from risaf_link.core.fusion import FusedRate
from risaf_link.core.guard import HeadingGuard, Whiteness
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingParameters
from risaf_link.core.rotation import left_matrix, quaternion_from_euler, wrap
from risaf_link.core.track import Track

pytestmark = pytest.mark.usefixtures("filter_form")

DT = 0.02
NAN = math.nan
NONE = np.full(3, NAN)
PARAN = (math.radians(30.2217), math.radians(34.8012))
SPEED_NOISE, GYRO_NOISE = 0.1, 1e-3
DOWN = np.array([0.0, 0.0, GRAVITY])
DUAL = HeadingParameters(source="dual_antenna")


class Ride:
    """A vehicle on a plane, its receiver, and a filter behind a guard; time is the vehicle's.

    `spoil` changes a fix before it is used; `antenna` is where the antenna really is.
    """

    def __init__(self, parameters=None, delay=0.11, antenna=(0.0, 0.0), yaw=1.0, seed=1, paper=0):
        self.parameters = parameters or HeadingParameters()
        self.filter = (
            PaperFilter(AttitudeParameters())
            if paper
            else Eskf(AttitudeParameters(), self.parameters)
        )
        self.guard = HeadingGuard(self.parameters, filter_knows=not paper)
        self.finder = HeadingFinder(self.parameters)
        self.generator = np.random.default_rng(seed)
        self.yaw, self.north, self.east, self.speed, self.time = yaw, 0.0, 0.0, 0.0, 0.0
        self.bias = 0.0  # rad/s, of the rate about the vertical
        self.antenna, self.late = antenna, deque(maxlen=max(round(delay / DT), 1) + 1)
        self.errors, self.ratios, self.innovations = [], [], []
        self.predict(0.0)

    def predict(self, rate):
        rate_b = np.array([0.0, 0.0, rate + self.bias]) + GYRO_NOISE * self.generator.normal(size=3)
        noise = np.full(3, GYRO_NOISE**2)
        walk = np.full(3, 5e-6)
        self.filter.predict(FusedRate(0, rate_b, noise, np.full(3, 1), 1, noise, walk), DT)
        if not isinstance(self.filter, PaperFilter) and round(self.time / DT) % 50 == 0:
            noise_n = np.array([*0.05 * self.generator.normal(size=2), 0.0])
            self.filter.correct_gravity(Gravity(self.filter.matrix @ (DOWN + noise_n), 0.01, 0.01))

    def fix(self, rate):
        forward, right = self.speed - rate * self.antenna[1], rate * self.antenna[0]
        sine, cosine = math.sin(self.yaw), math.cos(self.yaw)
        north, east = forward * cosine - right * sine, forward * sine + right * cosine
        north, east = (north, east) + SPEED_NOISE * self.generator.normal(size=2)
        per_north, per_east = radii(PARAN[0])
        place = self.generator.normal(size=2) * 0.1 + (self.north, self.east)
        speed = math.hypot(north, east)
        return GpsFix(
            round(self.time * 1e6),
            True,
            PARAN[0] + place[0] / float(per_north),
            PARAN[1] + place[1] / float(per_east),
            speed,
            math.atan2(east, north),
            NAN,
            SPEED_NOISE,
            NAN,
            1.5,
        )

    def go(self, seconds, rate=0.0, gain=0.0, gps=True, spoil=lambda fix: fix):
        """Drive on with a rate of yaw, rad/s, and a gain of speed, m/s^2; 5 fixes a second."""
        for _ in range(round(seconds / DT)):
            self.time += DT
            self.yaw += rate * DT
            self.speed += gain * DT
            self.north += self.speed * math.cos(self.yaw) * DT
            self.east += self.speed * math.sin(self.yaw) * DT
            self.predict(rate)
            force_b = np.array([gain, rate * self.speed, -GRAVITY])
            fused = FusedRate(0, NONE, NONE, np.zeros(3, np.int64), 1, NONE, NONE)
            track = Track.of([(fused, self.filter.state(0), force_b)])
            self.guard.advance(track, np.array([self.time]), np.array([DT]))
            self.state = track.attitude(0, 0)
            self.late.append((self.time, self.fix(rate)))
            if gps and round(self.time / DT) % 10 == 0:
                motion = self.finder.take(spoil(self.late[0][1]), self.time)
                innovation = self.guard.take(self.filter, motion)
                if innovation:
                    self.innovations.append(innovation)
            if self.state.aligned:
                self.errors.append(wrap(self.state.euler[2] - self.yaw))
                self.ratios.append(self.errors[-1] / self.state.yaw_std)
        return self

    def begin(self, speed=10.0):
        """Gain speed and let yaw settle; forget how it went."""
        self.go(abs(speed), gain=math.copysign(1.0, speed)).go(20.0, 0.05).go(20.0, -0.05)
        self.forget()
        return self

    def forget(self):
        self.errors, self.ratios, self.innovations = [], [], []

    @property
    def resets(self):
        return self.filter.state(0).resets

    @property
    def error(self):
        """The largest of late, deg."""
        return math.degrees(np.abs(self.errors).max())

    @property
    def honesty(self):
        return float(np.sqrt(np.mean(np.square(self.ratios))))

    @property
    def used(self):
        return [innovation.fused for innovation in self.innovations]


def turned(angle):
    return lambda fix: replace(fix, course=fix.course + angle)


# What is right


@pytest.mark.parametrize("paper", [False, True], ids=["eskf", "paper"])
def test_good_headings_are_fused_and_their_innovations_are_as_large_as_told(paper):
    ride = Ride(paper=paper).begin()
    ride.go(60.0).go(20.0, 0.02)
    squares = [i.value**2 / i.variance for i in ride.innovations]
    assert np.mean(ride.used) > 0.95
    assert 0.7 < np.mean(squares) < 1.3
    assert ride.honesty < 1.5


def test_of_innovations_that_are_white_less_than_two_in_a_hundred_are_refused():
    whiteness, generator = Whiteness(), np.random.default_rng(2)
    broken = 0
    for value in generator.normal(size=20_000):
        whiteness.add(Innovation(float(value), 1.0, 3.0))
        broken += whiteness.is_broken
    assert broken < 400


def test_what_does_not_average_out_is_not_averaged_out():
    parameters = HeadingParameters(offset_std=0.01)
    ride = Ride(parameters).begin()
    ride.go(100.0)
    assert ride.filter.state(0).yaw_std > 0.009


@pytest.mark.parametrize("delay", [0.02, 0.2, 0.32])
def test_a_receiver_that_is_later_than_told_is_found_out_in_turns(delay):
    ride = Ride(delay=delay).begin()
    for _ in range(5):
        ride.go(4.0, 0.4).go(4.0, -0.4)
    assert ride.parameters.delay + ride.filter.heading_errors[1] == pytest.approx(delay, abs=0.03)
    assert math.sqrt(ride.filter.covariance[LATE, LATE]) < 0.03
    assert ride.honesty < 1.5
    assert ride.resets == 1


@pytest.mark.parametrize("paper", [False, True], ids=["eskf", "paper"])
def test_the_antenna_s_swing_in_a_turn_is_not_taken_for_heading(paper):
    """1.5 m ahead at 3 m/s and 0.5 rad/s: 14 deg."""
    parameters = HeadingParameters(antenna=(1.5, 0.5, 0.0), delay_std=0.0)
    ride = Ride(parameters, antenna=(1.5, 0.5), paper=paper).begin(3.0)
    ride.go(12.0, 0.5).go(12.0, -0.5)
    assert ride.error < 1.5
    ride.speed = 0.0
    assert np.mean(ride.used) > 0.95


@pytest.mark.parametrize("offset", [80.0, -20.0, -42.0, 10.0])
def test_the_angle_of_two_antennas_is_taken_off(offset):
    """PX4's, to 0.01 deg."""
    parameters = set_parameters(DUAL, yaw_offset=math.radians(offset))
    ride = Ride(parameters)

    def measure(fix):
        return replace(fix, yaw=ride.yaw + math.radians(offset), course_std=0.02)

    ride.go(20.0, spoil=measure)
    assert abs(math.degrees(wrap(ride.filter.state(0).euler[2] - ride.yaw))) < 0.1
    heading = ride.finder.take(measure(ride.fix(0.0)), ride.time).heading
    assert math.degrees(heading.heading) == pytest.approx(math.degrees(ride.yaw), abs=0.01)


def test_headings_at_10_hz_are_fused_at_least_nine_times_a_second_however_poor_the_position():
    ride = Ride(DUAL)

    def measure(fix):
        return replace(fix, yaw=ride.yaw, course_std=0.05, position_std=500.0)

    counts = []
    for _ in range(10):
        ride.forget()
        for _ in range(10):
            ride.go(0.1, gps=False)
            motion = ride.finder.take(measure(ride.fix(0.0)), ride.time)
            ride.innovations.append(ride.guard.take(ride.filter, motion))
        counts.append(sum(ride.used))
    assert min(counts) >= 9


# Backwards


def test_a_vehicle_in_reverse_is_aided_as_well_as_forwards():
    ride = Ride().begin().go(5.0, gain=-2.0).go(2.0)
    ride.forget()
    ride.go(4.0, gain=-1.0).go(10.0, 0.2).go(10.0, -0.1)
    assert ride.guard.gear.sign == -1
    assert ride.guard.ahead(ride.finder.take(ride.fix(0.0), ride.time)) == pytest.approx(
        -4, abs=0.5
    )
    ride.go(4.0, gain=1.0).go(1.0).go(5.0, gain=1.0).go(10.0)
    assert ride.guard.gear.sign == 1
    assert np.mean(ride.used) > 0.97
    assert ride.error < 1.0
    assert ride.resets == 1


def test_a_course_that_turns_round_at_speed_is_no_change_of_gear():
    """PX4: no reset, and fusion stops."""
    ride = Ride().begin()
    ride.go(30.0, 0.02, spoil=turned(math.pi))
    assert not any(ride.used)
    assert ride.resets == 1
    assert ride.error < 1.0


def test_a_start_in_reverse_is_felt_by_the_accelerometer():
    ride = Ride().go(5.0).go(4.0, gain=-1.0).go(10.0, 0.1)
    assert ride.resets == 1
    assert abs(math.degrees(ride.errors[-1])) < 1.5
    assert ride.guard.gear.sign == -1


def test_a_yaw_that_was_aligned_in_reverse_is_turned_round_when_speed_changes():
    ride = Ride()
    ride.speed = -5.0
    ride.go(10.0)
    assert abs(ride.errors[-1]) > 3.0
    for _ in range(4):
        ride.go(3.0, gain=-1.0).go(3.0, gain=1.0)
    assert abs(math.degrees(ride.errors[-1])) < 1.5
    assert (ride.resets, ride.guard.gear.sign) == (2, -1)


def test_the_gear_by_two_antennas_needs_no_stop():
    ride = Ride(DUAL)
    ride.speed = -5.0
    ride.go(5.0, spoil=lambda fix: replace(fix, yaw=ride.yaw, course_std=0.02))
    assert ride.guard.gear.sign == -1
    assert abs(math.degrees(ride.errors[-1])) < 1.0


# Wrong


def test_a_skid_is_sat_out():
    ride = Ride().begin()
    for step in range(20):
        angle = math.radians(30.0) * math.sin(math.pi * step / 20)
        ride.go(0.2, 0.3, spoil=turned(angle))
    assert ride.error < 1.0
    ride.forget()
    ride.go(20.0)
    assert np.mean(ride.used[50:]) > 0.9
    assert (ride.error < 1.0, ride.resets) == (True, 1)


@pytest.mark.parametrize("slope", [0.1, 0.5, 1.0, -0.5])
def test_a_course_that_drifts_slowly_does_not_take_yaw_or_bias_with_it(slope):
    """After a minute it is off by 6 to 60 deg; no heading differs much from the one before."""
    rides = [Ride(seed=seed).begin() for seed in (1, 2, 3)]
    for ride in rides:
        follow_a_drift(ride, slope)
    # Above the 1.5 that a whole drive keeps: these are the moments of the fault alone.
    assert np.sqrt(np.mean([ride.honesty**2 for ride in rides])) < 2.0
    for ride in rides:
        ride.forget()
        ride.go(30.0)
        assert np.mean(ride.used[100:]) > 0.8
        assert (abs(math.degrees(ride.errors[-1])) < 1.0, ride.resets) == (True, 1)


def follow_a_drift(ride, slope):
    bias, began = ride.filter.state(0).bias_b[2], ride.time

    def drift(fix):
        return turned(math.radians(slope) * (ride.time - began))(fix)

    ride.go(30.0, 0.05, spoil=drift).go(30.0, -0.05, spoil=drift)
    assert ride.error < 2.0
    assert abs(ride.filter.state(0).bias_b[2] - bias) < math.radians(0.02)


def test_a_frozen_receiver_is_not_followed_round_a_curve():
    rides = [Ride(seed=seed).begin() for seed in (1, 2, 3)]
    for ride in rides:
        stuck = ride.late[0][1]
        frozen = lambda fix, stuck=stuck: replace(stuck, time_us=fix.time_us)  # noqa: E731
        for _ in range(4):
            ride.go(10.0, 0.03, spoil=frozen).go(10.0, -0.03, spoil=frozen)
        assert (ride.resets, ride.error < 2.0) == (1, True)
        assert np.mean(ride.used) < 0.1
        motion = ride.finder.take(frozen(ride.fix(0.0)), ride.time)
        assert not motion.is_news
        assert motion.contradicted
    # Above the 1.5 that a whole drive keeps: these are the moments of the fault alone.
    assert np.sqrt(np.mean([ride.honesty**2 for ride in rides])) < 2.0


def test_a_jump_that_the_positions_deny_is_never_believed():
    ride = Ride().begin()
    ride.go(100.0, spoil=turned(math.radians(60.0)))
    assert (ride.resets, ride.error < 1.0) == (1, True)
    assert not any(ride.used)


def test_positions_that_jump_cost_the_heading_some_seconds_and_no_more():
    ride = Ride().begin()
    far = lambda fix: replace(fix, latitude=fix.latitude + 1e-4)  # noqa: E731
    ride.go(10.0, spoil=far)
    assert not any(ride.used[:24])
    assert all(ride.used[26:])
    assert ride.error < 1.0


def test_headings_that_disagree_with_one_another_never_set_yaw():
    """Positions that say nothing; errors of 20 to 60 deg that wander."""
    ride = Ride(DUAL)
    ride.go(60.0, spoil=lambda fix: replace(fix, yaw=ride.yaw, course_std=0.02))
    ride.speed = 5.0

    def wander(fix):
        off = math.radians(40.0 + 20.0 * math.sin(0.7 * ride.time))
        return replace(fix, yaw=ride.yaw + off, course_std=0.02)

    ride.forget()
    ride.go(100.0, spoil=wander)
    assert (ride.resets, any(ride.used)) == (1, False)
    assert ride.error < 3.0


def test_a_jump_of_45_deg_at_standstill_is_distrusted_for_ten_seconds_and_then_believed():
    """PX4's."""
    ride = Ride(DUAL)
    ride.go(30.0, spoil=lambda fix: replace(fix, yaw=ride.yaw, course_std=0.02))
    ride.forget()
    off = math.radians(45.0)
    jump = lambda fix: replace(fix, yaw=ride.yaw + off, course_std=0.02)  # noqa: E731
    ride.go(9.8, spoil=jump)
    assert (ride.resets, any(ride.used)) == (1, False)
    assert ride.error < 1.0
    ride.go(0.8, spoil=jump)
    assert ride.resets == 2
    assert abs(math.degrees(ride.errors[-1])) == pytest.approx(45.0, abs=3.0)


@pytest.mark.parametrize(("confirmed", "patience"), [(5.0, 10.0), (40.0, 40.0), (300.0, 60.0)])
def test_yaw_is_defended_for_as_long_as_it_was_confirmed(confirmed, patience):
    ride = Ride(DUAL)
    ride.speed = 10.0
    right = lambda fix: replace(fix, yaw=ride.yaw, course_std=0.02)  # noqa: E731
    wrong = lambda fix: replace(fix, yaw=ride.yaw + 1.0, course_std=0.02)  # noqa: E731
    ride.go(confirmed, spoil=right).go(patience - 0.6, spoil=wrong)
    assert ride.resets == 1
    ride.go(1.6, spoil=wrong)
    assert ride.resets == 2


def test_after_an_outage_headings_that_agree_set_yaw_within_ten_seconds():
    ride = Ride().begin()
    ride.go(100.0, gps=False)
    turned = quaternion_from_euler(0.0, 0.0, math.radians(20.0))
    ride.filter.set_attitude(left_matrix(turned) @ ride.filter.quaternion)
    assert abs(ride.errors[-1]) < 20.0 * ride.filter.state(0).yaw_std
    ride.go(9.0, 0.05)
    assert ride.resets == 1
    ride.go(2.0, 0.05)
    assert ride.resets == 2
    assert abs(math.degrees(ride.errors[-1])) < 3.0


@pytest.mark.parametrize("seed", range(5))
def test_a_bias_that_is_not_known_yet_does_not_lock_headings_out(seed):
    ride = Ride(HeadingParameters(gate=1.5), seed=seed)
    ride.bias = 4.0 * AttitudeParameters().initial_bias_std
    ride.go(10.0, gain=1.0).go(120.0)
    ride.forget()
    ride.go(60.0)
    assert np.mean(ride.used) > 0.8
    assert ride.error < 5.0


@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize("offset", [-20.0, 5.0])
def test_an_offset_that_nobody_expects_of_gyros_is_learnt_from_the_first_headings(offset, paper):
    ride = Ride(paper=paper)
    ride.bias = math.radians(offset)
    ride.go(10.0, gain=1.0).go(20.0)
    assert ride.resets == 2
    if not paper:  # it does not know how uncertain it is
        assert np.mean(np.abs(ride.ratios) > 3.0) < 0.1
    ride.forget()
    ride.go(30.0, rate=0.1).go(30.0)
    assert np.mean(ride.used) > 0.8
    assert np.abs(np.degrees(ride.errors)).max() < 4.0
    assert math.degrees(ride.state.bias_b[2]) == pytest.approx(offset, abs=0.2)


def test_a_receiver_that_freezes_in_the_first_curve_is_not_taken_for_an_offset():
    ride = Ride().go(5.0, gain=2.0)
    stuck = ride.late[0][1]
    ride.go(30.0, 0.2, spoil=lambda fix: replace(stuck, time_us=fix.time_us))
    assert ride.resets == 1
    assert ride.error < 5.0
    assert abs(math.degrees(ride.state.bias_b[2])) < 0.5


@pytest.mark.parametrize("step", [-1.0, 3.0])
def test_an_offset_that_changes_at_once_is_believed_after_a_minute(step):
    ride = Ride().begin()
    ride.go(60.0)
    ride.bias = math.radians(step)
    ride.go(80.0)
    ride.forget()
    ride.go(30.0)
    assert np.mean(ride.used) > 0.8
    assert np.abs(np.degrees(ride.errors)).max() < 3.0


def test_yaw_gets_less_certain_while_headings_are_refused():
    ride = Ride().begin()
    before = ride.filter.state(0).yaw_std
    ride.go(20.0, spoil=turned(2.0))
    assert ride.filter.state(0).yaw_std > before
