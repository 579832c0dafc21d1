"""Array, robust fusion and filter together: the truth lies where they say, also under faults."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.error_state import ATTITUDE, BIAS, Gravity, Outcome
from risaf_link.core.eskf import Eskf
from risaf_link.core.fusion import Epoch, FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.robust import Robust
from risaf_link.core.rotation import matrix_from_quaternion, quaternion_from_euler, wrap

pytestmark = pytest.mark.usefixtures("filter_form")

SEEDS = range(50)
SENSORS, DT, SECONDS = 15, 0.1, 60.0
OUTAGE = 40.0  # s, from here on
NOISE = math.radians(0.05)  # of one reading
BIAS_STD = math.radians(0.2)
WALK = math.radians(0.003)  # 1/sqrt(s), of one sensor
HEADING_STD, GRAVITY_STD = 0.03, 0.3  # rad; m/s^2
FUSION = FusionParameters(bias_walk=WALK)
# The world of this test has nothing that sensors have in common but what the filter is told.
ATTITUDE_PARAMETERS = AttitudeParameters(
    initial_bias_std=BIAS_STD / math.sqrt(SENSORS),
    scale_std=1e-9,
    turn_error=0.0,
    common_noise=0.0,
    common_bias_walk=0.0,
    accel_bias_std=1e-6,
)

HEADING = HeadingParameters(offset_std=1e-6, delay_std=1e-6)


@dataclass(frozen=True)
class Run:
    angles: np.ndarray  # (times,) NEES of the attitude, 3 degrees of freedom
    bias: np.ndarray  # (times,) NEES of the bias, 3
    nis: dict


def faulty(readings, generator):
    """Bursts on a third, one sensor frozen, one saturated, one drifting, dropouts on another."""
    steps = len(readings)
    for sensor in range(5):
        for start in generator.uniform(0.0, SECONDS, 8):
            since = np.arange(steps) * DT - start
            size = generator.exponential(math.radians(20.0), 3)
            burst = np.where(since > 0.0, np.exp(-np.maximum(since, 0.0) / 0.3), 0.0)
            readings[:, sensor] += burst[:, np.newaxis] * size
    readings[200:, 5] = readings[200, 5]
    readings[300:, 6] = math.radians(250.0)
    readings[:, 7] += math.radians(0.05) * np.maximum(np.arange(steps) * DT - 20.0, 0.0)[:, None]
    readings[generator.random(steps) < 0.3, 8] = np.nan


def simulate(seed, fault):
    generator = np.random.default_rng(seed)
    steps = round(SECONDS / DT)
    time = np.arange(steps)[:, np.newaxis] * DT
    rates = np.array([0.2, 0.2, 0.4]) * np.sin(
        [0.31, 0.47, 0.23] * time + generator.uniform(0, 6, 3)
    )
    shape = (steps, SENSORS, 3)
    walked = generator.normal(0.0, WALK * math.sqrt(DT), shape).cumsum(axis=0)
    biases = generator.normal(0.0, BIAS_STD, shape[1:]) + walked
    readings = rates[:, np.newaxis] + biases + generator.normal(0.0, NOISE, shape)
    if fault:
        faulty(readings, generator)
    attitude, robust = Eskf(ATTITUDE_PARAMETERS, HEADING), Robust(FUSION)
    truth_nb = matrix_from_quaternion(
        quaternion_from_euler(*generator.normal(0.0, 0.05, 2), generator.uniform(-3, 3))
    )
    angles, bias_errors, nis = [], [], {"heading": [], "gravity": []}
    fused_errors, noises = [], []
    for step in range(steps):
        fused = robust.fuse(Epoch(0, DT if step else 0.0, readings[step], np.zeros((0, 3)), 0))
        angle = float(np.linalg.norm(rates[step])) * DT
        turn = np.array([math.cos(angle / 2), *(math.sin(angle / 2) / angle * rates[step] * DT)])
        truth_nb = truth_nb @ matrix_from_quaternion(turn)
        attitude.predict(fused, DT)
        fused_errors.append(fused.rate_b - rates[step])
        noises.append(fused.noise)
        corrections = ()
        if step % 2 == 0:
            wrong_n = np.array([*(GRAVITY_STD * generator.normal(size=2)), GRAVITY])
            gravity_n = attitude.matrix @ truth_nb.T @ wrong_n
            corrections += attitude.correct_gravity(
                Gravity(gravity_n, GRAVITY_STD**2, GRAVITY_STD**2)
            )
            if step * DT < OUTAGE:
                heading = math.atan2(truth_nb[1, 0], truth_nb[0, 0])
                heading = wrap(heading + HEADING_STD * generator.normal())
                corrections += (attitude.correct_heading(heading, HEADING_STD**2, 0.0, 6.0),)
        for correction in corrections:
            if correction.outcome is Outcome.FUSED:
                nis[correction.source].append(correction.value**2 / correction.variance)
        if step % 50 == 49:
            turned = truth_nb @ attitude.matrix.T
            skew = turned - turned.T
            error = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2.0
            covariance = attitude.covariance
            angles.append(error @ np.linalg.solve(covariance[ATTITUDE, ATTITUDE], error))
            # The fused rate's bias: its mean error over 2 s, which still has some noise.
            last = slice(step - 19, step + 1)
            bias = np.mean(fused_errors[last], axis=0) - attitude.state(0).bias_b
            white = np.diag(np.mean(noises[last], axis=0) / 20)
            bias_errors.append(bias @ np.linalg.solve(covariance[BIAS, BIAS] + white, bias))
    return Run(np.array(angles), np.array(bias_errors), nis)


@pytest.fixture(scope="module", params=[False, True], ids=["sound", "faulty"])
def runs(request, filter_form):  # noqa: ARG001 which form is run is its doing
    return [simulate(seed, request.param) for seed in SEEDS]


def bounds(degrees):
    """95 % of the mean of so many squared standard deviations."""
    half = 1.96 * math.sqrt(2.0 / degrees)
    return 1.0 - half, 1.0 + half


@pytest.mark.parametrize("part", ["angles", "bias"])
def test_the_average_nees_is_within_its_bounds(runs, part):
    values = np.array([getattr(run, part) for run in runs]) / 3.0
    low, high = bounds(3 * len(runs))  # as if all times of a run were one: they are correlated
    assert low < values.mean() < high


@pytest.mark.parametrize("kind", ["heading", "gravity"])
def test_the_average_nis_is_within_its_bounds(runs, kind):
    values = np.concatenate([run.nis[kind] for run in runs])
    low, high = bounds(len(values))
    assert low < values.mean() < high
