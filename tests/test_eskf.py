"""The error-state filter against closed forms, simulated truth, and the limits of PX4's tests."""

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from filters import (
    DEFAULTS,
    DOWN,
    DT,
    GATE,
    SENSORS,
    aligned_filter,
    assert_sound,
    degrees_between,
    fused,
    level_filter,
    run,
    settled_filter,
    tilt_error,
)
from hamilton import derivative, product, rotation
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace as set_parameters

from risaf_link.core.aiding import Aiding
from risaf_link.core.earth import EARTH_RATE, GRAVITY
from risaf_link.core.error_state import (
    ACCELEROMETER,
    ATTITUDE,
    BIAS,
    STATES,
    Gravity,
    Outcome,
    drive,
)
from risaf_link.core.eskf import Eskf
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import (
    euler_from_quaternion,
    matrix_from_quaternion,
    quaternion_from_euler,
    wrap,
)

pytestmark = pytest.mark.usefixtures("filter_form")

DATA = Path(os.environ.get("RISAF_DATA", Path(__file__).parents[1] / "../shared/data"))
RUNS = sorted((DATA / "ekf2_runs").glob("*.npz"))
ZURICH = math.radians(47.4)
SIMULATED = ACCELEROMETER.stop  # states: all but what is wrong with headings


# Prediction


@pytest.mark.parametrize("parts", [1, 3, 10])
def test_a_constant_rate_turns_by_its_integral_however_it_is_sampled(parts):
    estimator = Eskf(DEFAULTS)
    rate_b = np.array([1.0, -2.0, 3.0])
    steps = np.random.default_rng(parts).uniform(0.33, 1.6, 20 * parts)
    for dt in steps / steps.sum():
        estimator.predict(fused(rate_b), float(dt))
    angle = float(np.linalg.norm(rate_b))
    exact = np.concatenate(([math.cos(angle / 2)], math.sin(angle / 2) * rate_b / angle))
    assert np.abs(estimator.quaternion - exact).max() < 1e-12


def test_coning_of_a_vibrating_axis_is_carried_to_the_third_order():
    """A cone of half-angle a turned at w drifts by w (1 - cos a)."""
    half, rate, dt, seconds = math.radians(2.0), 60.0, 0.005, 2.0
    estimator = Eskf(DEFAULTS)
    steps = round(seconds / dt)
    times = np.arange(steps + 1) * dt
    cone = [
        np.array(
            [
                math.cos(half / 2),
                math.sin(half / 2) * math.cos(rate * t),
                math.sin(half / 2) * math.sin(rate * t),
                0.0,
            ]
        )
        for t in np.linspace(0.0, seconds, steps * 10 + 1)
    ]
    matrices = matrix_from_quaternion(np.array(cone))
    turned = np.einsum("nji,njk->nik", matrices[:-1], matrices[1:])
    small = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
    means = small.reshape(steps, 10, 3).sum(axis=1) / dt
    estimator.set_attitude(cone[0])
    for mean in means:
        estimator.predict(fused(mean), dt)
    drift = math.degrees(rate * (1 - math.cos(half)) * times[-1])
    assert degrees_between(estimator.quaternion, cone[-1]) < 0.02 * drift


def test_an_earthfast_array_does_not_turn():
    estimator = aligned_filter(math.radians(30.0))
    estimator.set_latitude(ZURICH)
    earth_n = EARTH_RATE * np.array([math.cos(ZURICH), 0.0, -math.sin(ZURICH)])
    before = estimator.quaternion
    run(estimator, 3600.0, earth_n @ estimator.matrix, dt=1.0 / 3)
    assert degrees_between(before, estimator.quaternion) < 0.01


def test_yaw_variance_grows_without_aiding():
    estimator = aligned_filter()
    stds = []
    for _ in range(5):
        run(estimator, 4.0)
        stds.append(estimator.state(0).yaw_std)
    assert all(later > earlier for earlier, later in pairwise(stds))


def test_without_accelerometer_the_tilt_is_as_unknown_as_the_bias_makes_it():
    estimator = Eskf(DEFAULTS)
    run(estimator, 10.0)
    state = estimator.state(0)
    expected = math.hypot(DEFAULTS.initial_tilt_std, 10.0 * DEFAULTS.initial_bias_std)
    assert state.roll_std == pytest.approx(expected, rel=0.02)
    assert state.pitch_std == pytest.approx(expected, rel=0.02)
    assert state.yaw_std == math.pi
    assert not state.aligned
    assert (state.angle_covariance[2, :2] == 0.0).all()


@pytest.mark.parametrize("angles", [(0, 0, 1), (0.3, 0.2, -2), (-1.2, 0.8, 3), (2.5, -1.3, 0.5)])
def test_the_covariance_of_the_angles_is_that_of_the_attitude(angles):
    estimator = aligned_filter()
    run(estimator, 3.0, (0.4, -0.3, 0.5))  # so that the errors have something in common
    q_nb = quaternion_from_euler(*angles)
    estimator.set_attitude(q_nb)
    by_error = derivative(lambda e: euler_from_quaternion(product(rotation(e), q_nb)), np.zeros(3))
    expected = by_error @ estimator.covariance[ATTITUDE, ATTITUDE] @ by_error.T
    std = np.sqrt(expected.diagonal())
    found = estimator.state(0).angle_covariance
    assert found / np.outer(std, std) == pytest.approx(expected / np.outer(std, std), abs=1e-6)
    assert np.abs(found[0, 1]) > 1e-3 * std[0] * std[1]


def test_the_bias_is_known_as_well_as_the_start_and_rest_tell():
    estimator = Eskf(DEFAULTS)
    run(estimator, 0.01)
    start = DEFAULTS.initial_bias_std
    assert estimator.state(0).bias_std == pytest.approx([start] * 3, rel=1e-3)
    rest = np.array([1.0, 2.0, 3.0]) * 1e-3  # rad/s
    estimator.correct_zero_rate(np.zeros(3), np.square(rest), confirmed=True)
    both = 1.0 / np.sqrt(1.0 / start**2 + 1.0 / np.square(rest))
    assert estimator.state(0).bias_std == pytest.approx(both, rel=1e-3)


def test_an_error_of_scale_grows_with_the_angle_turned_and_goes_with_turning_back():
    known = set_parameters(DEFAULTS, initial_bias_std=1e-9, turn_error=0.0)
    estimator = aligned_filter(std=1e-3, parameters=known)
    run(estimator, 10.0, (0.0, 0.0, 2.0))
    assert estimator.state(0).yaw_std == pytest.approx(20.0 * DEFAULTS.scale_std, rel=0.02)
    run(estimator, 10.0, (0.0, 0.0, -2.0))
    assert estimator.state(0).yaw_std < math.hypot(0.002, HeadingParameters().offset_std)


def test_an_error_of_scale_is_learnt_from_headings():
    """A gyro that shows 0.5 % too much: turns and stops under GPS, then three turns without."""
    estimator = aligned_filter(std=0.02)
    truth, errors = 0.0, []
    for step in range(12000):
        rate = 2.0 if step >= 11000 else 1.0 if step % 2000 < 1000 else 0.0
        truth = wrap(truth + rate * DT)
        estimator.predict(fused([0.0, 0.0, 1.005 * rate]), DT)
        if step < 11000 and step % 20 == 0:
            estimator.correct_heading(truth, 0.02**2, 0.0, GATE)
        elif step >= 11000:
            errors.append(wrap(estimator.state(0).euler[2] - truth))
    assert np.abs(errors).max() < 0.3 * 0.005 * 20.0


def test_an_array_of_many_sensors_wanders_less():
    known = set_parameters(DEFAULTS, initial_bias_std=1e-9, initial_tilt_std=1e-9)
    tilts = []
    for sensors in (1, 100):
        estimator = Eskf(known)
        for _ in range(1000):
            estimator.predict(fused(np.zeros(3), sensors=sensors), DT)
        tilts.append(estimator.state(0).roll_std)
    assert tilts[0] > 5.0 * tilts[1]


# Start


@pytest.mark.parametrize("roll", [0.0, 30.0, 60.0, 90.0])
@pytest.mark.parametrize("pitch", [0.0, 30.0, 60.0, 90.0])
def test_the_tilt_is_that_of_gravity_from_the_start(roll, pitch):
    truth = quaternion_from_euler(math.radians(roll), math.radians(pitch), 0.0)
    force_b = -DOWN @ matrix_from_quaternion(truth)
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    for _ in range(70):
        estimator.predict(fused(np.zeros(3)), DT)
        aiding.take(estimator, fused(np.zeros(3)), force_b, DT)
    assert tilt_error(estimator, truth) < 1e-6
    assert estimator.state(0).resets == 0
    assert estimator.covariance[0, 0] / 4 > 1e-6
    assert_sound(estimator)


def test_the_first_heading_sets_yaw_and_is_counted():
    estimator = level_filter()
    run(estimator, 0.4)
    before = estimator.state(0)
    correction = estimator.correct_heading(math.radians(20.0), 0.02**2, 0.0, GATE)
    after = estimator.state(0)
    assert correction.outcome is Outcome.RESET
    assert correction.fused
    assert after.resets == before.resets + 1
    assert after.aligned
    assert abs(after.euler[2] - math.radians(20.0)) < 1e-3
    assert correction.value == pytest.approx(wrap(after.euler[2] - before.euler[2]))
    assert after.yaw_std == pytest.approx(math.hypot(0.02, HeadingParameters().offset_std))


def test_unknown_yaw_does_not_leak_into_the_tilt():
    truth = quaternion_from_euler(math.radians(40.0), math.radians(-50.0), 0.0)
    estimator = level_filter()
    estimator.set_attitude(truth)
    run(estimator, 1.0)
    stds = [math.sqrt(estimator.covariance[axis, axis]) for axis in (0, 1)]
    for yaw in (100.0, -170.0, 10.0):
        estimator.reset_heading(math.radians(yaw), 0.01, 0.0, GATE)
        assert tilt_error(estimator, truth) < 1e-6
        for axis in (0, 1):
            assert math.sqrt(estimator.covariance[axis, axis]) < 1.5 * max(stds)


# Heading


def test_heading_converges_as_in_px4():
    """10 deg to 0.05 deg in 5 s, then a step of 2 deg to 0.5 deg in 20 s."""
    estimator = level_filter()
    aim = math.radians(10.0)
    for step in range(125):
        run(estimator, 0.2)
        if step == 25:
            assert abs(estimator.state(0).euler[2] - aim) < math.radians(0.05)
            aim += math.radians(2.0)
        estimator.correct_zero_rate(np.zeros(3), np.full(3, 1e-8), confirmed=True)
        estimator.correct_heading(aim, 0.02**2, 0.0, GATE)
    assert abs(estimator.state(0).euler[2] - aim) < math.radians(0.5)


def test_a_late_heading_is_compared_with_the_yaw_of_its_own_time():
    turning = math.radians(30.0)
    estimator = aligned_filter(std=0.001)
    for step in range(1, 200):
        estimator.predict(fused([0.0, 0.0, turning]), DT)
        if step % 20 == 0:
            then = (step * DT - 0.115) * turning
            correction = estimator.correct_heading(wrap(then), 0.02**2, 0.115, GATE)
            assert abs(correction.value) < 1e-9
            assert correction.outcome is Outcome.FUSED


def test_a_heading_older_than_the_history_is_compared_with_yaw_half_a_second_before_it_at_most():
    estimator = aligned_filter()
    run(estimator, 1.0, (0.0, 0.0, 0.1))
    correction = estimator.correct_heading(0.0, 0.02**2, 100.0, GATE)
    assert correction.value == pytest.approx(0.05, abs=0.01)


def test_a_first_heading_older_than_the_filter_sets_the_yaw_of_now():
    """And in a turn that goes on like that, nothing is taken for a delay."""
    estimator, delay, rate = level_filter(), 0.11, 0.2
    for step in range(1, 3000):
        run(estimator, DT, (0.0, 0.0, rate))
        if step % 20 == 5:
            estimator.correct_heading(wrap(rate * (step * DT - delay)), 0.01**2, delay, GATE)
            error = wrap(estimator.state(0).euler[2] - rate * step * DT)
            assert abs(error) < math.radians(0.1)


def jump(estimator, angle, seconds, at_rest):
    """Feed headings that are off by an angle; the corrections."""
    corrections = []
    aim = wrap(estimator.state(0).euler[2] + angle)
    for _ in range(round(seconds / 0.2)):
        run(estimator, 0.2)
        if at_rest:
            estimator.correct_zero_rate(np.zeros(3), np.full(3, 1e-8), confirmed=True)
        corrections.append(estimator.correct_heading(aim, 0.02**2, 0.0, GATE))
    return corrections


def test_a_heading_beyond_the_gate_is_rejected_and_changes_nothing():
    estimator = settled_filter()
    before = estimator.state(0)
    corrections = jump(estimator, math.radians(45.0), 20.0, at_rest=True)
    assert {c.outcome for c in corrections} == {Outcome.REJECTED}
    assert estimator.state(0).resets == before.resets
    assert abs(estimator.state(0).euler[2] - before.euler[2]) < 1e-6
    assert estimator.state(0).yaw_std > before.yaw_std


def test_a_comparison_says_what_a_correction_would_and_changes_nothing():
    estimator = settled_filter()
    before = estimator.state(0)
    compared = estimator.compare_heading(0.01, 0.02**2, 0.1, GATE)
    assert np.array_equal(estimator.state(0).q_nb, before.q_nb)
    assert estimator.correct_heading(0.01, 0.02**2, 0.1, GATE) == compared
    assert estimator.compare_heading(math.nan, 0.02**2, 0.1, GATE) is None


def test_every_reset_is_counted_and_its_value_is_the_change():
    estimator = level_filter()
    generator = np.random.default_rng(3)
    for count, heading in enumerate(generator.uniform(-math.pi, math.pi, 20), start=1):
        run(estimator, 0.1, generator.normal(size=3))
        before = estimator.state(0)
        correction = estimator.reset_heading(heading, 0.01, 0.0, GATE)
        after = estimator.state(0)
        assert after.resets == count
        assert wrap(after.euler[2] - before.euler[2] - correction.value) == pytest.approx(0.0)
        assert after.euler[:2] == pytest.approx(before.euler[:2])


def test_a_bias_in_doubt_is_less_certain_about_the_vertical_and_nowhere_else():
    estimator = settled_filter()
    estimator.set_attitude(quaternion_from_euler(0.4, -0.7, 2.0))
    before, rate = estimator.covariance, math.radians(5.0)
    estimator.doubt_bias(rate)
    added = estimator.covariance - before
    down_b = estimator.matrix[2]
    assert added[BIAS, BIAS] == pytest.approx(rate**2 * np.outer(down_b, down_b))
    added[BIAS, BIAS] = 0.0
    assert not added.any()
    assert_sound(estimator)


@given(
    roll=st.floats(-math.pi, math.pi),
    pitch=st.one_of(
        st.floats(-math.pi / 2, math.pi / 2), st.sampled_from([-math.pi / 2, math.pi / 2])
    ),
    yaw=st.floats(-math.pi, math.pi),
)
def test_a_heading_s_spread_is_between_its_variance_and_100_in_every_attitude(roll, pitch, yaw):
    estimator = aligned_filter(std=0.1)
    estimator.set_attitude(quaternion_from_euler(roll, pitch, yaw))
    variance = 0.1**2
    correction = estimator.correct_heading(yaw, variance, 0.0, GATE)
    assert variance < correction.variance < 100.0
    if abs(math.sin(pitch)) > 0.995:
        assert correction.outcome is Outcome.UNOBSERVABLE
    assert_sound(estimator)


@pytest.mark.parametrize("tilt", [0.0, 0.7, -1.2])
def test_the_derivative_of_yaw_is_that_of_a_difference(tilt):
    estimator = aligned_filter(std=0.01)
    estimator.set_attitude(quaternion_from_euler(0.4, tilt, 1.0))
    for axis in range(3):
        covariance = np.zeros((STATES, STATES))
        covariance[axis, axis] = 1e-6
        estimator.set_covariance(covariance)
        turned = quaternion_from_euler(*(1e-5 * np.eye(3)[axis]))
        matrix_nb = matrix_from_quaternion(turned) @ estimator.matrix
        slope = (math.atan2(matrix_nb[1, 0], matrix_nb[0, 0]) - 1.0) / 1e-5
        spread = estimator.correct_heading(1.0, 1e-12, 0.0, GATE).variance
        assert math.sqrt(spread / 1e-6) == pytest.approx(abs(slope), rel=1e-3, abs=1e-2)


# Gravity


@pytest.mark.parametrize("spin", [0.0, 1.0, 5.0, 25.0])
def test_two_degrees_of_tilt_are_gone_within_four_seconds_while_spinning(spin):
    estimator, aiding = aligned_filter(), Aiding()
    truth = quaternion_from_euler(0.0, 0.0, 0.0)
    estimator.set_attitude(quaternion_from_euler(math.radians(2.0), 0.0, 0.0))
    covariance = estimator.covariance
    covariance[ATTITUDE, ATTITUDE] = np.eye(3) * 0.05**2
    estimator.set_covariance(covariance)
    for _ in range(400):
        estimator.predict(fused([0.0, 0.0, spin]), DT)
        aiding.take(estimator, fused([0.0, 0.0, spin]), -DOWN, DT)
    assert tilt_error(estimator, truth) < 0.05


def test_level_is_found_again_after_a_dropout_of_the_accelerometer():
    """PX4 issue 24299: 4 s at 8 deg/s and 1.25 g, then level; below 5 deg within 8 s."""
    estimator, aiding = Eskf(DEFAULTS), Aiding()

    def go(seconds, rate_b, force_b):
        for _ in range(round(seconds / DT)):
            estimator.predict(fused(rate_b), DT)
            aiding.take(estimator, fused(rate_b), force_b, DT)

    go(9.0, np.zeros(3), -DOWN)
    go(4.0, np.radians([8.0, 0.0, 0.0]), -1.25 * DOWN)
    assert abs(estimator.state(0).euler[0]) > math.radians(15.0)
    go(8.0, np.zeros(3), -DOWN)
    assert tilt_error(estimator, np.array([1.0, 0.0, 0.0, 0.0])) < 5.0
    assert estimator.state(0).resets == 0


@pytest.mark.parametrize("angle", [40.0, 120.0, 179.0])
def test_no_tilt_is_so_wrong_that_gravity_stays_locked_out(angle):
    estimator = aligned_filter()
    for _ in range(300):
        run(estimator, 0.1)
        estimator.correct_gravity(Gravity(estimator.matrix @ DOWN, 0.003, 0.003))
    estimator.set_attitude(quaternion_from_euler(math.radians(angle), 0.0, 0.0))
    for _ in range(100):
        run(estimator, 0.1)
        gravity_n = estimator.matrix @ DOWN  # the body is level in truth
        estimator.correct_gravity(Gravity(gravity_n, 0.003, 0.003))
    assert tilt_error(estimator, np.array([1.0, 0.0, 0.0, 0.0])) < 0.1
    assert_sound(estimator)


# Honesty


@dataclass(frozen=True)
class Honesty:
    nees: np.ndarray  # (seeds, times)
    nis: dict


def simulate(seed, parameters, seconds=60.0, dt=0.1):
    """One run by the filter's own model; NEES over time, NIS of each kind."""
    p, generator = parameters, np.random.default_rng(seed)
    yaw = generator.uniform(-math.pi, math.pi)
    truth = quaternion_from_euler(*generator.normal(size=2) * p.initial_tilt_std, yaw)
    truth_nb = matrix_from_quaternion(truth)
    bias = generator.normal(size=3) * p.initial_bias_std
    estimator = Eskf(p, HeadingParameters(offset_std=1e-6, delay_std=1e-6))
    phases, speeds = generator.uniform(0, 6, 3), np.array([0.31, 0.47, 0.23])
    nees, nis = [], {"heading": [], "gravity": [], "rest": []}
    scale = generator.normal(size=(3, 3)) * p.scale_std
    force_bias = generator.normal(size=3) * p.accel_bias_std
    force_scale = generator.normal(size=(3, 3)) * p.scale_std
    for step in range(round(seconds / dt)):
        rate = np.array([0.3, 0.3, 0.5]) * np.sin(speeds * step * dt + phases)
        if 0.5 < step * dt / seconds < 0.6:
            rate = np.zeros(3)
        angle = float(np.linalg.norm(rate)) * dt
        half = math.sin(angle / 2) / max(angle, 1e-12) * rate * dt
        truth_nb = truth_nb @ matrix_from_quaternion(np.array([math.cos(angle / 2), *half]))
        bias = bias + generator.normal(size=3) * SENSORS.bias_walk * math.sqrt(dt)
        noise = generator.normal(size=3) * SENSORS.gyro_noise / math.sqrt(dt)
        estimator.predict(fused(rate + scale @ rate + bias + noise, dt=dt), dt)
        corrections = ()
        shaken_n = -DOWN + 0.3 * generator.normal(size=3)
        force_b = truth_nb.T @ shaken_n
        force_b = force_b + force_scale @ force_b + force_bias
        by_errors = drive(estimator.matrix, -GRAVITY * estimator.matrix[2])
        gravity = Gravity(-estimator.matrix @ force_b, 0.09, 0.09, by_errors=by_errors)
        corrections += estimator.correct_gravity(gravity)
        if step % 2 == 0:
            heading = math.atan2(truth_nb[1, 0], truth_nb[0, 0]) + 0.03 * generator.normal()
            corrections += (estimator.correct_heading(wrap(heading), 0.03**2, 0.0, 6.0),)
        if 0.5 < step * dt / seconds < 0.6 and step % 5 == 0:
            mean = bias + 5e-4 * generator.normal(size=3)
            corrections += estimator.correct_zero_rate(mean, np.full(3, 2.5e-7), confirmed=True)
        for correction in corrections:
            if correction.outcome is Outcome.FUSED:
                nis[correction.source].append(correction.value**2 / correction.variance)
        if step % 50 == 49:
            difference = truth_nb @ estimator.matrix.T
            angles = np.array(
                [
                    difference[2, 1] - difference[1, 2],
                    difference[0, 2] - difference[2, 0],
                    difference[1, 0] - difference[0, 1],
                ]
            )
            wrong = np.concatenate((bias, scale.ravel(), force_bias, force_scale.ravel()))
            known = estimator.memory(np.zeros(3)).errors[: len(wrong)]
            error = np.concatenate((angles / 2, wrong - known))
            covariance = estimator.covariance[:SIMULATED, :SIMULATED]
            nees.append(error @ np.linalg.solve(covariance, error))
            if step % 200 == 199:
                assert_sound(estimator)
    return nees, {kind: np.mean(values) for kind, values in nis.items()}, nis


@pytest.fixture(scope="module")
def honesty(filter_form):  # noqa: ARG001 which form is run is its doing
    parameters = set_parameters(
        DEFAULTS,
        turn_error=0.0,
        common_noise=0.0,
        common_bias_walk=0.0,
        accel_bias_std=0.02,
    )
    runs = [simulate(seed, parameters) for seed in range(50)]
    return np.array([nees for nees, _, _ in runs]), [nis for _, _, nis in runs]


def chi_square_bounds(degrees):
    """95 % of the mean of so many squared standard deviations (normal approximation)."""
    half = 1.96 * math.sqrt(2.0 / degrees)
    return 1.0 - half, 1.0 + half


def test_the_average_nees_over_50_seeds_is_within_its_bounds(honesty):
    """At every time within three standard deviations, in the mean over time within 95 %."""
    nees, _ = honesty
    averages = nees.mean(axis=0) / SIMULATED
    low, high = chi_square_bounds(
        SIMULATED * len(nees)
    )  # as if all times were one: they are correlated
    assert low < averages.mean() < high
    assert np.abs(averages - 1.0).max() < 3.0 * math.sqrt(2.0 / (SIMULATED * len(nees)))


@pytest.mark.parametrize("kind", ["heading", "gravity", "rest"])
def test_the_average_nis_over_50_seeds_is_within_its_bounds(honesty, kind):
    _, runs = honesty
    values = np.concatenate([run[kind] for run in runs])
    low, high = chi_square_bounds(len(values))
    assert low < values.mean() < high


# Soundness


def test_a_measurement_that_is_no_number_says_so():
    estimator = aligned_filter()
    for bad in (math.nan, math.inf, -math.inf):
        assert estimator.correct_heading(bad, 0.01, 0.0, GATE).outcome is Outcome.NOT_FINITE
        assert estimator.correct_heading(0.0, bad, 0.0, GATE).outcome is Outcome.NOT_FINITE
        gravity = Gravity(np.array([0.0, bad, GRAVITY]), 0.1, 0.1)
        assert estimator.correct_gravity(gravity)[0].outcome is Outcome.NOT_FINITE
        rest = estimator.correct_zero_rate(np.array([0.0, bad, 0.0]), np.ones(3), confirmed=True)
        assert not rest[0].fused
    assert_sound(estimator)


def test_an_hour_of_precise_corrections_leaves_the_covariance_sound():
    estimator = aligned_filter()
    for _ in range(3600):
        estimator.predict(fused(np.zeros(3)), 1.0 / 3)
        estimator.correct_heading(0.0, 1e-12, 0.0, GATE)
        estimator.correct_gravity(Gravity(DOWN, 1e-10, 1e-10))
        estimator.correct_zero_rate(np.zeros(3), np.full(3, 1e-16), confirmed=True)
    assert_sound(estimator)


# PX4's runs


@pytest.mark.skipif(not RUNS, reason=f"no recordings in {DATA / 'ekf2_runs'}")
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_heading_in_an_outage_of_200_s_beats_px4(path):
    """PX4's EKF2 on the same data: 1.48, 0.55 and 0.93 deg."""
    log = np.load(path)
    truth = np.radians(log["rpy_deg"].astype(float))
    gyro, accel = log["gyro"].astype(float), log["accel"].astype(float)
    fixes = dict(
        zip(np.searchsorted(log["t_us"], log["gps"][:, 0]), log["gps"][:, 4:6], strict=True)
    )
    estimator, aiding = Eskf(DEFAULTS), Aiding()
    estimator.set_latitude(math.radians(log["gps"][0, 1]))
    errors = []
    for k in range(len(gyro)):
        rate = fused(gyro[k])
        estimator.predict(rate, DT)
        aiding.take(estimator, rate, accel[k], DT)
        if k in fixes:
            north, east = fixes[k]
            speed = math.hypot(north, east)
            aiding.speed.hear(speed, 0.1**2, 0.0)
            if speed > 1.0:
                estimator.correct_heading(math.atan2(east, north), 0.01 / speed**2, 0.0, GATE)
        if k >= 10000 and k % 10 == 0:
            euler = euler_from_quaternion(estimator.quaternion)
            errors.append([wrap(a - b) for a, b in zip(euler, truth[k], strict=True)])
    roll, pitch, yaw = np.degrees(np.sqrt((np.array(errors) ** 2).mean(axis=0)))
    assert yaw < {"base_s01": 1.48, "base_s02": 0.55, "base_s03": 0.93}[path.stem]
    assert roll < 0.5
    assert pitch < 0.5
