"""The paper's filter against closed forms, finite differences and simulated truth."""

import math

import numpy as np
import pytest
from hamilton import derivative, product, rotation
from hypothesis import given
from hypothesis import strategies as st

from risaf_link.core.attitude import ATTITUDE, BIAS, AttitudeParameters, PaperFilter
from risaf_link.core.fusion import FusedRate
from risaf_link.core.rotation import (
    euler_from_quaternion,
    matrix_from_quaternion,
    quaternion_from_euler,
    wrap,
    yaw_of,
)

DT = 0.01
STD = 0.02  # rad, of a heading
GATE = 3.0
NOISE, UNKNOWN = np.full(3, 9e-6), np.full(3, np.nan)
ANGLES = [(0, 0, 0), (0.3, -0.2, 2.0), (-1.0, 1.2, -3.0), (3.0, -0.7, 0.5)]

rates = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


def fused(rate_b, variance=1e-6):
    rate_b, active = np.asarray(rate_b, float), np.full(3, 90)
    return FusedRate(0, rate_b, np.full(3, variance), active, 150, NOISE, UNKNOWN)


def filter_at(roll=0.0, pitch=0.0, yaw=0.0, bias=(0.0, 0.0, 0.0), **parameters):
    """A filter that is where a test wants it, as uncertain of it as at the start, yaw known."""
    estimator = PaperFilter(AttitudeParameters(**parameters))
    q = quaternion_from_euler(roll, pitch, yaw)
    turn = np.eye(7)
    turn[ATTITUDE, ATTITUDE] = np.transpose([product(unit, q) for unit in np.eye(4)])
    estimator._q, estimator._bias = q, np.array(bias)
    estimator._covariance = turn @ estimator._covariance @ turn.T
    estimator.correct_heading(yaw, STD**2, 0.0, GATE)
    return estimator


def run(estimator, seconds, rate_z=0.0, dt=DT, variance=1e-6):
    for _ in range(round(seconds / dt)):
        estimator.predict(fused([0, 0, rate_z], variance), dt)


def yaw(estimator):
    return estimator.state(0).euler[2]


def normalised(q):
    return q / np.linalg.norm(q)


def assert_sound(estimator):
    state, covariance = estimator.state(0), estimator._covariance
    assert np.isfinite([*state.q_nb, *state.rate_b, *state.bias_b]).all()
    assert np.isfinite([state.roll_std, state.pitch_std, state.yaw_std]).all()
    assert np.linalg.norm(state.q_nb) == pytest.approx(1.0, abs=1e-12)
    assert np.isfinite(covariance).all()
    assert (covariance == covariance.T).all()
    values = np.linalg.eigvalsh(covariance)
    assert values[0] >= -1e-12 * values[-1]
    assert covariance[:, ATTITUDE] @ state.q_nb == pytest.approx(0.0, abs=1e-9 * values[-1])


# Prediction


@pytest.mark.parametrize("rate_b", [[0.5, 0, 0], [0, -0.3, 0], [0.2, -0.4, 0.6]])
def test_a_constant_rate_turns_by_the_arc_tangent_of_each_step(rate_b):
    """First order: a step of angle a turns by 2 atan(a / 2), a^3 / 12 less."""
    estimator = filter_at()
    for _ in range(500):
        estimator.predict(fused(rate_b), DT)
    rate = math.hypot(*rate_b)
    turned = 500 * 2 * math.atan(rate * DT / 2)
    expected = rotation(turned * np.array(rate_b) / rate)
    assert estimator.state(0).q_nb == pytest.approx(expected, abs=1e-12)
    assert turned == pytest.approx(rate * 5.0, abs=500 * (rate * DT) ** 3 / 11)


def test_the_bias_is_taken_off_the_rate():
    estimator = filter_at(bias=(0.01, -0.02, 0.03))
    estimator.predict(fused([0.01, -0.02, 0.13]), 1.0)
    state = estimator.state(42)
    assert state.time_us == 42
    assert state.rate_b == pytest.approx([0, 0, 0.1])
    assert state.bias_b.tolist() == [0.01, -0.02, 0.03]
    assert state.euler == pytest.approx((0, 0, 0.1), abs=1e-4)


@pytest.mark.parametrize("angles", ANGLES)
@pytest.mark.parametrize("dt", [0.01, 0.3])
def test_the_covariance_is_carried_on_by_the_derivatives_of_the_step(angles, dt):
    """Eq. 9 to 11 by finite differences, of the step with its normalisation."""
    rate_b, bias, variance = np.array([0.5, -0.8, 1.1]), np.array([0.02, 0.01, -0.03]), 1e-4
    estimator = filter_at(*angles, bias, bias_walk=0.02)
    root = np.random.default_rng(1).normal(0, 0.01, (7, 7))
    tangent = np.eye(7)
    tangent[ATTITUDE, ATTITUDE] -= np.outer(estimator._q, estimator._q)
    before = tangent @ root @ root.T @ tangent
    estimator._covariance = before

    def step(state, rate=rate_b):
        q, b = state[ATTITUDE], state[BIAS]
        moved = q + dt / 2 * product(q, [0.0, *(rate - b)])  # eq. 3, first order
        return np.concatenate([normalised(moved), b])

    at = np.concatenate([estimator._q, bias])
    by_state = derivative(step, at)
    by_rate = derivative(lambda rate: step(at, rate), rate_b)
    estimator.predict(fused(rate_b, variance), dt)
    walk = np.diag([0.0] * 4 + [0.02**2 * dt] * 3)
    expected = by_state @ before @ by_state.T + variance * by_rate @ by_rate.T + walk
    assert estimator._covariance == pytest.approx(expected, rel=1e-6, abs=1e-13)


def test_where_the_array_gives_no_variance_the_noise_of_its_sensors_does():
    silent, told = (filter_at() for _ in range(2))
    silent.predict(fused([0, 0, 0], math.nan), DT)
    told.predict(fused([0, 0, 0], NOISE[0]), DT)
    assert (silent._covariance == told._covariance).all()


def test_dead_reckoning_grows_uncertain_with_the_noise_and_with_the_bias():
    noisy = filter_at(initial_bias_std=1e-9, bias_walk=0.0)
    run(noisy, 100.0, variance=0.003**2, dt=0.05)
    grown = math.sqrt(noisy.state(0).yaw_std ** 2 - STD**2)
    assert grown == pytest.approx(0.003 * 0.05 * math.sqrt(2000), rel=1e-3)
    biased = filter_at(initial_bias_std=0.001, bias_walk=0.0)
    run(biased, 100.0, variance=0.0, dt=0.05)
    grown = math.sqrt(biased.state(0).yaw_std ** 2 - STD**2)
    assert grown == pytest.approx(0.001 * 100, rel=1e-3)


def test_a_step_of_no_time_changes_nothing():
    estimator = filter_at(0.1, 0.2, 0.3)
    before = estimator._covariance
    estimator.predict(fused([1, 2, 3]), 0.0)
    assert estimator.state(0).euler == pytest.approx((0.1, 0.2, 0.3))
    assert estimator._covariance == pytest.approx(before, abs=1e-15)


def test_a_rate_is_not_believed_for_a_minute():
    estimator = filter_at(yaw=1.0)
    estimator.predict(fused([0.1, 0.1, 0.1]), 60.0)
    state = estimator.state(0)
    assert state.euler == pytest.approx((0.1, 0.1, 1.1), abs=0.02)
    assert state.yaw_std == math.pi
    assert state.roll_std < 0.1
    assert_sound(estimator)
    innovation = estimator.correct_heading(-2.0, STD**2, 0.0, GATE)
    assert innovation.reset
    assert yaw(estimator) == pytest.approx(-2.0)


@pytest.mark.parametrize(("gap", "sets"), [(1.8, False), (2.2, True)])
def test_a_yaw_that_is_uncertain_by_more_than_half_a_radian_is_set_and_not_corrected(gap, sets):
    estimator = filter_at()
    estimator.predict(fused([0, 0, 0]), gap)
    innovation = estimator.correct_heading(0.4, STD**2, 0.0, GATE)
    assert (innovation.reset, innovation.fused) == (sets, True)
    assert yaw(estimator) == pytest.approx(0.4, abs=1e-9 if sets else 0.01)


def test_a_variance_without_bounds_makes_yaw_unknown_and_the_next_heading_known_again():
    estimator = filter_at()
    estimator.predict(fused([0, 0, 0], 1e60), DT)
    assert estimator.state(0).yaw_std == math.pi
    assert_sound(estimator)
    assert estimator.correct_heading(1.0, STD**2, 0.0, GATE).reset
    run(estimator, 0.2)
    assert estimator.correct_heading(1.0, STD**2, 0.0, GATE).variance < 3 * STD**2


def test_a_step_of_a_third_of_a_second_is_a_step_like_any_other():
    estimator = filter_at()
    estimator.predict(fused([0, 0, 0.5]), 0.3)
    assert yaw(estimator) == pytest.approx(2 * math.atan(0.075))
    assert estimator.state(0).yaw_std < 0.03


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_where_there_is_no_rate_the_next_one_counts_for_the_time(unknown):
    estimator = filter_at(yaw=1.0)
    for _ in range(5):
        estimator.predict(fused([0, unknown, 0.5]), DT)
    assert yaw(estimator) == pytest.approx(1.0)
    estimator.predict(fused([0, 0, 0.5]), DT)
    assert yaw(estimator) == pytest.approx(1.0 + 6 * 0.5 * DT, abs=1e-5)
    assert_sound(estimator)


@pytest.mark.parametrize("dt", [-DT, math.nan, math.inf])
def test_a_step_that_cannot_be_is_refused_and_leaves_the_state_alone(dt):
    estimator = filter_at(yaw=1.0)
    with pytest.raises(ValueError, match="expected a finite time"):
        estimator.predict(fused([0, 0, 0]), dt)
    assert yaw(estimator) == pytest.approx(1.0)
    assert_sound(estimator)


# Heading


def test_yaw_is_unknown_until_the_first_heading_sets_it():
    estimator = PaperFilter(AttitudeParameters())
    run(estimator, 5.0, rate_z=0.2)
    before = estimator.state(0)
    assert (before.aligned, before.resets, before.yaw_std) == (False, 0, math.pi)
    innovation = estimator.correct_heading(-2.0, STD**2, 0.0, GATE)
    after = estimator.state(0)
    assert (innovation.reset, innovation.fused) == (True, True)
    assert (after.aligned, after.resets) == (True, 1)
    assert after.euler[2] == pytest.approx(-2.0)
    assert after.yaw_std == pytest.approx(STD)


@pytest.mark.parametrize("angles", ANGLES)
def test_a_correction_is_the_kalman_gain_of_yaws_derivative_by_the_quaternion(angles):
    """Section III.C, the heading row by finite differences."""
    estimator = filter_at(*angles, bias=(0.01, 0.02, 0.03))
    run(estimator, 0.5)
    q, bias, covariance = estimator._q, estimator._bias, estimator._covariance
    row = np.concatenate([derivative(lambda p: [yaw_of(p)], q)[0], np.zeros(3)])
    expected_variance = row @ covariance @ row + STD**2
    gain = covariance @ row / expected_variance
    innovation = estimator.correct_heading(wrap(yaw_of(q) + 0.03), STD**2, 0.0, GATE)
    assert innovation.value == pytest.approx(0.03)
    assert innovation.variance == pytest.approx(expected_variance, rel=1e-6)
    moved = q + gain[ATTITUDE] * 0.03
    assert estimator._q == pytest.approx(normalised(moved), abs=1e-9)
    assert estimator._bias == pytest.approx(bias + gain[BIAS] * 0.03, abs=1e-9)
    less = covariance - np.outer(gain, gain) * expected_variance
    shrunk = np.eye(7)
    shrunk[ATTITUDE, ATTITUDE] = derivative(normalised, moved)
    assert estimator._covariance == pytest.approx(shrunk @ less @ shrunk.T, abs=1e-10)
    assert_sound(estimator)


@pytest.mark.parametrize("angles", ANGLES)
def test_reported_deviations_are_those_of_the_euler_angles(angles):
    estimator = filter_at(*angles)
    run(estimator, 0.2)
    jacobian = derivative(euler_from_quaternion, estimator._q)
    covariance = jacobian @ estimator._covariance[ATTITUDE, ATTITUDE] @ jacobian.T
    std = np.sqrt(np.diag(covariance))
    state = estimator.state(0)
    found = [state.roll_std, state.pitch_std, state.yaw_std]
    assert found == pytest.approx(np.minimum(std, math.pi), rel=1e-6)
    correlation = state.angle_covariance / np.outer(found, found)
    assert correlation == pytest.approx(covariance / np.outer(std, std), abs=1e-6)


@pytest.mark.parametrize(("before", "heading"), [(3.1, -3.1), (-3.1, 3.1), (3.1, math.pi)])
def test_a_heading_on_the_other_side_of_south_is_close(before, heading):
    estimator = filter_at(yaw=before)
    run(estimator, 1.0)
    innovation = estimator.correct_heading(heading, STD**2, 0.0, GATE)
    assert innovation.value == pytest.approx(math.remainder(heading - before, math.tau))
    assert innovation.fused
    assert abs(yaw(estimator)) > 3.1


def test_a_heading_beyond_the_gate_is_rejected_and_changes_nothing():
    estimator = filter_at(yaw=1.0)
    run(estimator, 1.0)
    before = estimator.state(0), estimator._covariance
    outlier = estimator.correct_heading(1.5, STD**2, 0.0, GATE)
    assert (outlier.fused, outlier.test_ratio > 1) == (False, True)
    assert yaw(estimator) == before[0].euler[2]
    assert estimator._covariance is before[1]
    limit = GATE * math.sqrt(outlier.variance)
    assert estimator.correct_heading(1.0 + 0.999 * limit, STD**2, 0.0, GATE).fused


def test_a_reset_turns_about_down_and_leaves_tilt_bias_and_their_errors_alone():
    estimator = filter_at(0.2, -0.3, 1.0, (0.01, 0.02, 0.03))
    run(estimator, 5.0, rate_z=0.03)
    before = estimator.state(0)
    tilt_before = tilt_and_bias_covariance(estimator)
    innovation = estimator.reset_heading(-2.0, STD**2, 0.0, GATE)
    after = estimator.state(0)
    assert (innovation.reset, after.resets) == (True, 2)
    assert innovation.value == pytest.approx(wrap(-2.0 - before.euler[2]))
    assert after.euler == pytest.approx((*before.euler[:2], -2.0))
    assert (after.bias_b == before.bias_b).all()
    assert tilt_and_bias_covariance(estimator) == pytest.approx(tilt_before, abs=1e-12)
    assert estimator._turn_variance() == pytest.approx(STD**2)
    assert_sound(estimator)


def tilt_and_bias_covariance(estimator):
    """Covariance of the body's down direction and of the bias."""
    down = derivative(lambda q: matrix_from_quaternion(q)[2], estimator._q)
    jacobian = np.zeros((6, 7))
    jacobian[:3, ATTITUDE], jacobian[3:, BIAS] = down, np.eye(3)
    return jacobian @ estimator._covariance @ jacobian.T


# A late heading


@pytest.mark.parametrize("rate_z", [math.radians(30), -math.radians(30)])
def test_a_late_heading_corrects_a_turning_vehicle_in_the_right_direction(rate_z):
    """30 deg/s and 0.2 s make 6 deg; the filter is 1 deg behind."""
    estimator = filter_at(initial_bias_std=1e-6)
    run(estimator, 3.0, rate_z)
    late = rate_z * (3.0 - 0.2)
    error = math.copysign(math.radians(1), rate_z)
    innovation = estimator.correct_heading(wrap(late + error), STD**2, 0.2, GATE)
    assert innovation.value == pytest.approx(error, abs=1e-5)
    corrected = wrap(yaw(estimator) - rate_z * 3.0)
    assert corrected == pytest.approx(error / 2, rel=0.05)


def test_corrections_since_then_count_when_a_late_heading_is_compared():
    estimator = filter_at(initial_bias_std=1e-6)
    run(estimator, 1.0)
    estimator.correct_heading(0.03, STD**2, 0.0, GATE)
    corrected = yaw(estimator)
    assert corrected > 0.01
    innovation = estimator.correct_heading(corrected, STD**2, 0.2, GATE)
    assert innovation.value == pytest.approx(0.0, abs=1e-12)
    run(estimator, 0.1)
    estimator.reset_heading(-3.0, STD**2, 0.1, GATE)
    assert estimator.correct_heading(-3.0, STD**2, 0.3, GATE).value == pytest.approx(0.0, abs=1e-9)


def test_a_late_heading_falls_between_two_epochs():
    estimator = filter_at()
    run(estimator, 1.0, rate_z=0.5, dt=0.1)
    heading = 0.5 * (1.0 - 0.25)
    assert estimator.correct_heading(heading, STD**2, 0.25, GATE).value == pytest.approx(
        0.0, abs=1e-3
    )


def test_a_heading_from_before_the_beginning_is_compared_with_the_first_yaw():
    estimator = filter_at()
    assert estimator.correct_heading(0.01, STD**2, 5.0, GATE).value == pytest.approx(0.01)
    first = yaw(estimator)
    run(estimator, 0.1, rate_z=1.0)
    innovation = estimator.correct_heading(first, STD**2, 5.0, GATE)
    assert innovation.value == pytest.approx(-DT, abs=1e-6)


# In the long run


def test_the_bias_is_found_on_a_turning_vehicle():
    estimator = filter_at(initial_bias_std=0.02)
    bias, rate_z = np.array([0.003, -0.002, 0.01]), 0.2
    turning = bias + np.array([0, 0, rate_z])
    for k in range(1, 6001):
        estimator.predict(fused(turning, 1e-8), DT)
        if k % 20 == 0:
            estimator.correct_heading(wrap(rate_z * k * DT), STD**2, 0.0, GATE)
    assert estimator.state(0).bias_b[2] == pytest.approx(bias[2], abs=2e-4)
    run_out = yaw(estimator)
    for _ in range(3000):
        estimator.predict(fused(turning, 1e-8), DT)
    assert wrap(yaw(estimator) - run_out - rate_z * 30) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("rate_z", "dt"), [(3.0, 0.01), (1.0, 0.3), (0.0, 0.01), (0.2, 1.5)])
def test_the_covariance_stays_sound_over_thousands_of_steps(rate_z, dt):
    estimator = filter_at()
    for k in range(1, 5001):
        estimator.predict(fused([0.01, -0.02, rate_z], 1e-6), dt)
        if k % 20 == 0:
            estimator.reset_heading(1.0, STD**2, 0.0, GATE)
            estimator.correct_heading(1.01, STD**2, 0.1, GATE)
    assert_sound(estimator)
    assert estimator._covariance[BIAS, BIAS].max() < 1e-3


@given(
    st.lists(
        st.tuples(
            rates,
            st.sampled_from([0.0, 0.001, 0.01, 0.3, 2.0, 60.0]),
            st.sampled_from([0.0, 1e-6, 1e30, math.nan]),
            st.none() | st.tuples(st.floats(-7, 7), st.floats(0, 2), st.booleans()),
        ),
        max_size=30,
    )
)
def test_nothing_makes_the_state_unsound(steps):
    estimator = PaperFilter(AttitudeParameters())
    for rate_b, dt, variance, heading in steps:
        estimator.predict(fused(rate_b, variance), dt)
        if heading:
            angle, age, reset = heading
            use = estimator.reset_heading if reset else estimator.correct_heading
            use(angle, STD**2, age, GATE)
        assert_sound(estimator)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2, 1.5707, -1.57])
def test_at_gimbal_lock_the_state_stays_sound(pitch):
    estimator = filter_at(0.3, pitch, 1.0)
    for k in range(100):
        estimator.predict(fused([0.1, 0.2, -0.1]), DT)
        estimator.correct_heading(0.1 * k, STD**2, 0.0, GATE)
        assert_sound(estimator)
    estimator.reset_heading(1.0, STD**2, 0.0, GATE)
    assert_sound(estimator)


# Honesty

SEEDS = 50


def bounds(count, deviations):
    """Bounds of the mean of so many squares of normal values: Wilson and Hilferty's chi^2."""
    middle, spread = 1 - 2 / (9 * count), deviations * math.sqrt(2 / (9 * count))
    return (middle - spread) ** 3, (middle + spread) ** 3


def errors_of_one_run(seed, rate_of, dt=0.1, seconds=30.0, noise=0.003, std=0.03):
    """NEES of yaw and NIS, once a heading, of a filter whose assumptions are true."""
    generator = np.random.default_rng(seed)
    parameters = AttitudeParameters(initial_bias_std=0.005, initial_tilt_std=0.02)
    estimator = PaperFilter(parameters)
    true_yaw = generator.uniform(-math.pi, math.pi)
    bias = generator.normal(0, parameters.initial_bias_std, 3)
    nees, nis = [], []
    for k in range(1, round(seconds / dt) + 1):
        rate_z = rate_of(k * dt)
        true_yaw += 2 * math.atan(rate_z * dt / 2)  # the filter's own first order
        bias += generator.normal(0, parameters.bias_walk * math.sqrt(dt), 3)
        measured = bias + generator.normal(0, noise, 3) + [0, 0, rate_z]
        estimator.predict(fused(measured, noise**2), dt)
        if k % 2 == 0:
            heading = true_yaw + generator.normal(0, std)
            innovation = estimator.correct_heading(wrap(heading), std**2, 0.0, 100.0)
            nis.append(innovation.value**2 / innovation.variance)
            state = estimator.state(0)
            nees.append((wrap(state.euler[2] - true_yaw) / state.yaw_std) ** 2)
    return nees, nis[1:]  # the first one set yaw


@pytest.mark.parametrize(
    "rate_of", [lambda _: 0.2, lambda t: 0.4 * math.sin(t / 5)], ids=["circle", "weave"]
)
def test_yaw_errors_and_innovations_are_as_large_as_the_filter_says(rate_of):
    runs = [errors_of_one_run(seed, rate_of) for seed in range(SEEDS)]
    nees, nis = (np.array(squares) for squares in zip(*runs, strict=True))
    low, high = bounds(SEEDS, 3.0)  # six means: one beyond 95 % would be no surprise
    for after_10_20_and_30_s in nees[:, [49, 99, 149]].T:
        assert low < after_10_20_and_30_s.mean() < high
    low, high = bounds(nis.size, 1.96)  # innovations are white: each is a sample of its own
    assert low < nis.mean() < high
