"""Gravity, rest and speed as the filter is told of them, against simulated truth."""

import math

import numpy as np
import pytest
from filters import (
    DEFAULTS,
    DOWN,
    DT,
    GATE,
    UNKNOWN,
    aligned_filter,
    assert_sound,
    fused,
    run,
    settled_filter,
    tilt_error,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from risaf_link.core.aiding import Aiding, SpeedTracker
from risaf_link.core.earth import GRAVITY
from risaf_link.core.error_state import BIAS, Gravity
from risaf_link.core.eskf import Eskf
from risaf_link.core.rotation import matrix_from_quaternion, quaternion_from_euler, wrap

pytestmark = pytest.mark.usefixtures("filter_form")

# Gravity


def drive(seconds, speed, rate_b, force_b, told=True, noise=0.0):
    """A filter and its aiding on a level road, yaw known; the largest tilt error, deg."""
    estimator, aiding = aligned_filter(), Aiding()
    generator = np.random.default_rng(1)
    yaw, worst = 0.0, 0.0
    for step in range(round(seconds / DT)):
        time = step * DT
        rate = np.array(rate_b(time))
        yaw += rate[2] * DT
        estimator.predict(fused(rate), DT)
        force = np.array(force_b(time)) + noise * generator.normal(size=3)
        aiding.take(estimator, fused(rate), force, DT)
        if told and step % 20 == 0:
            aiding.speed.hear(speed(time), 0.1**2, 0.0)
            estimator.correct_heading(wrap(yaw), 0.02**2, 0.0, GATE)
        worst = max(worst, tilt_error(estimator, quaternion_from_euler(0.0, 0.0, 0.0)))
    return worst, estimator


@pytest.mark.parametrize(("told", "limit"), [(True, 0.15), (False, 1.0)])
def test_a_curve_does_not_tilt_the_attitude(told, limit):
    """10 s at 15 m/s and 0.15 rad/s: the apparent vertical leans by 13 deg."""

    def rate(time):
        return (0.0, 0.0, 0.15 if 20 < time < 30 else 0.0)

    def force(time):
        return (0.0, 15.0 * rate(time)[2], -GRAVITY)

    worst, _ = drive(40.0, lambda _: 15.0, rate, force, told)
    assert worst < limit


@pytest.mark.parametrize(("told", "limit"), [(True, 0.5), (False, 1.0)])
def test_braking_does_not_tilt_the_attitude(told, limit):
    """3 m/s^2 for 5 s: the apparent vertical leans by 17 deg."""

    def braking(time):
        return 3.0 if 20 < time < 25 else 0.0

    worst, _ = drive(
        35.0,
        lambda time: 25.0 - 3.0 * min(max(time - 20.0, 0.0), 5.0),
        lambda _: (0.0, 0.0, 0.0),
        lambda time: (-braking(time), 0.0, -GRAVITY),
        told,
    )
    assert worst < limit


@pytest.mark.parametrize(("speed", "rate"), [(10.0, 0.1), (25.0, 0.04), (5.0, 0.3)])
def test_a_long_curve_at_a_speed_that_nobody_tells_is_no_tilt(speed, rate):
    """Two minutes; the apparent vertical leans by 6 to 9 deg all the time."""
    worst, estimator = drive(
        150.0,
        lambda _: speed,
        lambda time: (0.0, 0.0, rate if 20 < time < 140 else 0.0),
        lambda time: (0.0, speed * rate if 20 < time < 140 else 0.0, -GRAVITY),
        told=False,
        noise=0.05,
    )
    state = estimator.state(0)
    assert worst < 1.0
    assert worst < 2.0 * math.degrees(math.hypot(state.roll_std, state.pitch_std))


@pytest.mark.parametrize("noise", [0.05, 0.5])
def test_a_start_at_speed_in_a_curve_leaves_tilt_and_bias_within_what_is_claimed(noise):
    """Switched on at 15 m/s: the first gravity leans by 13 deg, and nothing is known yet."""
    generator = np.random.default_rng(3)
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    rate_b, force_b = np.array([0.0, 0.0, 0.15]), np.array([0.0, 15.0 * 0.15, -GRAVITY])
    yaw, level = 0.0, quaternion_from_euler(0.0, 0.0, 0.0)
    for step in range(1, 3000):
        yaw += 0.15 * DT
        reading = fused(rate_b + 1e-3 * generator.normal(size=3))
        estimator.predict(reading, DT)
        aiding.take(estimator, reading, force_b + noise * generator.normal(size=3), DT)
        if step % 20 == 0:
            aiding.speed.hear(15.0 + 0.1 * generator.normal(), 0.1**2, 0.0)
            estimator.correct_heading(wrap(yaw + 0.01 * generator.normal()), 0.01**2, 0.0, GATE)
        if step % 100 == 0:
            state, variance = estimator.state(0), estimator.covariance.diagonal()
            tilt_std = math.degrees(math.hypot(state.roll_std, state.pitch_std))
            assert tilt_error(estimator, level) < min(3.0 * tilt_std, 5.0)
            assert (state.bias_b**2 < 9.0 * variance[BIAS]).all()


def still_readings(bias, seconds, generator):
    """Rate and force of an IMU that lies there."""
    for _ in range(round(seconds / DT)):
        yield bias + 0.002 * generator.normal(size=3), -DOWN + 0.05 * generator.normal(size=3)


def test_the_accelerometers_lean_is_found_by_lying_on_two_sides():
    """A bias of 0.1 m/s^2 tilts the vertical by 0.6 deg on either side, each the other way."""
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    lean = np.array([0.1, 0.0, 0.0])
    generator = np.random.default_rng(8)

    def go(seconds, rate_b):
        for _, force in still_readings(np.zeros(3), seconds, generator):
            reading = fused(rate_b + 0.002 * generator.normal(size=3))
            estimator.predict(reading, DT)
            aiding.take(estimator, reading, force + lean, DT)

    level = quaternion_from_euler(0.0, 0.0, 0.0)
    go(10.0, np.zeros(3))
    assert tilt_error(estimator, level) > 0.4
    for _ in range(2):
        go(math.pi, np.array([0.0, 0.0, 1.0]))
        go(10.0, np.zeros(3))
    assert tilt_error(estimator, level) < 0.25


# Rest


def test_a_bias_that_climbs_at_rest_is_followed():
    """PX4: 1 to 5 mrad/s, 30 s each; 0.8 mrad/s on x and y, 4 mrad/s on z."""
    for sign in (1.0, -1.0):
        estimator, aiding = Eskf(DEFAULTS), Aiding()
        for bias in (0.0, 0.001, 0.002, 0.0035, 0.005):
            rate_b = np.full(3, sign * bias)
            for step in range(1500):
                estimator.predict(fused(rate_b), 2 * DT)
                aiding.take(estimator, fused(rate_b), -DOWN, 2 * DT)
                if step % 10 == 0:
                    aiding.speed.hear(0.1, 0.1**2, 0.0)
            error = np.abs(estimator.state(0).bias_b - rate_b)
            assert (error < [0.0008, 0.0008, 0.004]).all()


def test_rest_is_found_without_gps():
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    generator = np.random.default_rng(5)
    bias = np.array([0.004, -0.003, 0.005])
    for _ in range(6000):
        rate_b = bias + 0.002 * generator.normal(size=3)
        estimator.predict(fused(rate_b), DT)
        force_b = -DOWN + 0.05 * generator.normal(size=3)
        aiding.take(estimator, fused(rate_b), force_b, DT)
    state = estimator.state(0)
    assert np.abs(state.bias_b - bias).max() < 5e-4
    assert abs(state.euler[2]) < math.radians(3.0)


def test_a_steady_curve_is_no_rest():
    estimator, aiding = settled_filter(), Aiding()
    generator = np.random.default_rng(6)
    for _ in range(6000):
        rate_b = [0.0, 0.0, 0.1] + 0.002 * generator.normal(size=3)
        estimator.predict(fused(rate_b), DT)
        force_b = [0.0, 1.0, -GRAVITY] + 0.05 * generator.normal(size=3)
        for correction in aiding.take(estimator, fused(rate_b), force_b, DT):
            assert correction.source != "rest" or not correction.fused
    assert abs(estimator.state(0).bias_b[2]) < 1e-3


def test_a_bias_far_from_expectation_is_found_where_gps_confirms_the_rest():
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    bias = np.array([0.0, 0.0, 0.2])
    for step in range(3000):
        estimator.predict(fused(bias), DT)
        aiding.take(estimator, fused(bias), -DOWN, DT)
        if step % 20 == 0:
            aiding.speed.hear(0.1, 0.1**2, 0.0)
    assert np.abs(estimator.state(0).bias_b - bias).max() < 1e-3


def test_a_bias_that_gravity_refutes_is_found_without_gps():
    """11 deg/s about level axes: by now the vertical would have gone round."""
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    bias = np.array([0.2, -0.1, 0.1])
    for rate_b, force_b in still_readings(bias, 40.0, np.random.default_rng(9)):
        reading = fused(rate_b)
        estimator.predict(reading, DT)
        aiding.take(estimator, reading, force_b, DT)
    assert np.abs(estimator.state(0).bias_b - bias).max() < 1e-3
    state = estimator.state(0)
    sigma = math.degrees(math.hypot(state.roll_std, state.pitch_std))
    assert tilt_error(estimator, quaternion_from_euler(0.0, 0.0, 0.0)) < 2.0 * sigma


def test_a_turn_about_the_vertical_is_not_refuted_by_gravity():
    estimator, aiding = settled_filter(), Aiding()
    turn = np.array([0.0, 0.0, 0.2])
    for rate_b, force_b in still_readings(turn, 60.0, np.random.default_rng(10)):
        reading = fused(rate_b)
        estimator.predict(reading, DT)
        aiding.take(estimator, reading, force_b, DT)
    assert abs(estimator.state(0).bias_b[2]) < 1e-3


def test_speed_and_its_change_are_tracked_through_the_delay():
    speed, generator = SpeedTracker(), np.random.default_rng(7)
    errors = []
    for step in range(1, 6000):
        speed.advance(DT)
        if step % 20 == 0:
            then = 10.0 + 5.0 * math.sin(0.1 * (step * DT - 0.2))
            speed.hear(then + 0.1 * generator.normal(), 0.1**2, 0.2)
            now = 10.0 + 5.0 * math.sin(0.1 * step * DT)
            errors.append((speed.speed - now) ** 2 / speed.speed_variance)
    assert np.mean(errors) < 1.5
    run_out = speed.speed_variance
    for _ in range(1000):
        speed.advance(DT)
    assert speed.speed_variance > 10 * run_out
    assert not speed.recent


# Soundness


NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-10.0, 10.0),
)
TRIPLES = st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_nothing_that_is_fed_makes_the_state_unsound(data):
    estimator, aiding = aligned_filter(), Aiding()
    for _ in range(data.draw(st.integers(1, 8))):
        action = data.draw(st.integers(0, 5))
        a, b, c = (data.draw(NUMBERS) for _ in range(3))
        with np.errstate(all="ignore"):
            if action == 0:
                estimator.predict(fused(data.draw(TRIPLES), data.draw(TRIPLES), 2), a)
            elif action == 1:
                estimator.correct_heading(a, b, c, GATE)
            elif action == 2:
                estimator.correct_gravity(Gravity(data.draw(TRIPLES), a, b))
            elif action == 3:
                estimator.correct_zero_rate(data.draw(TRIPLES), data.draw(TRIPLES), a > 0)
            elif action == 4:
                aiding.speed.hear(a, b, c)
                estimator.set_latitude(a)
                estimator.reset_heading(a, b, c, GATE)
            else:
                rate = fused(data.draw(TRIPLES))
                for _ in range(30):
                    aiding.take(estimator, rate, data.draw(TRIPLES), 0.01)
        run(estimator, 0.05)
        assert_sound(estimator)


# Level


def test_without_accelerometers_a_vehicle_is_level_on_the_average():
    """Headings that are a little wrong say of the tilt what is not so, and a circle repeats it."""
    generator = np.random.default_rng(8)
    estimator, aiding = aligned_filter(), Aiding(DEFAULTS)
    yaw, worst = 0.0, 0.0
    for step in range(round(200.0 / DT)):
        rate = np.array([0.0, 0.0, 0.1]) + 1e-3 * generator.normal(size=3) + [5e-4, -8e-4, 0.0]
        yaw += 0.1 * DT
        estimator.predict(fused(rate), DT)
        aiding.take(estimator, fused(rate), UNKNOWN, DT)
        if step % 20 == 0:
            heading = yaw + 0.005 + 0.01 * generator.normal()
            estimator.correct_heading(wrap(heading), 0.01**2, 0.0, GATE)
        worst = max(worst, tilt_error(estimator, quaternion_from_euler(0.0, 0.0, 0.0)))
    assert worst < 2.0
    assert estimator.state(0).roll_std < DEFAULTS.initial_tilt_std


def test_accelerometers_that_fall_silent_for_seconds_do_not_make_a_tilted_vehicle_level():
    estimator, aiding = Eskf(DEFAULTS), Aiding(DEFAULTS)
    tilted = quaternion_from_euler(0.3, 0.0, 0.0)
    force_b = -DOWN @ matrix_from_quaternion(tilted)
    for silent in (False, True):
        for _ in range(round(9.0 / DT)):
            estimator.predict(fused(np.zeros(3)), DT)
            aiding.take(estimator, fused(np.zeros(3)), UNKNOWN if silent else force_b, DT)
    assert tilt_error(estimator, tilted) < 0.5
