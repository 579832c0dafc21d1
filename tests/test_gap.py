"""Readings that were lost on the way: what was turned meanwhile is as uncertain as it is told."""

import math

import numpy as np
import pytest
from filters import DT, SENSORS, aligned_filter, fused

from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.eskf import Eskf
from risaf_link.core.gap import Gaps
from risaf_link.core.guard import HeadingGuard
from risaf_link.core.heading import Heading, HeadingParameters, HeadingSource, Motion
from risaf_link.core.rotation import wrap, yaw_of
from risaf_link.core.track import Track

pytestmark = pytest.mark.usefixtures("filter_form")

KNOWN = np.ones(3, dtype=bool)
NO_FORCE = np.full(3, math.nan)
SURE = AttitudeParameters(initial_bias_std=1e-5, scale_std=1e-9, turn_error=0.0, common_noise=0.0)


def gaps_of(steps):
    finder = Gaps()
    return [bool(finder.take(np.zeros(3), np.zeros(3), KNOWN, dt).unseen.any()) for dt in steps]


def test_steps_of_a_steady_array_are_no_gaps_however_its_stamps_jitter():
    generator = np.random.default_rng(1)
    assert not any(gaps_of([0.01] * 1000))
    assert not any(gaps_of(generator.uniform(0.009, 0.011, 1000)))
    assert not any(gaps_of([1.0] * 100))


def test_gaps_are_found_while_half_of_the_epochs_are_lost():
    generator = np.random.default_rng(2)
    steps = 0.01 * generator.geometric(0.5, 5000)
    found = np.array(gaps_of(steps))
    assert (found[100:] == (steps[100:] > 0.015)).mean() > 0.99


def test_an_array_that_has_become_slower_has_no_gaps_after_a_while():
    assert not any(gaps_of([0.01] * 500 + [0.1] * 300)[700:])


def test_a_gap_between_two_equal_rates_is_bridged_by_that_rate():
    step = (finder := Gaps()).take(np.zeros(3), np.zeros(3), KNOWN, 0.01)
    rate = np.array([0.1, -0.2, 0.3])
    for _ in range(500):
        finder.take(rate, rate, KNOWN, 0.01)
    step = finder.take(rate, rate, KNOWN, 0.4)
    np.testing.assert_allclose(step.rate_b * step.told, 0.4 * rate)
    late = finder.take(rate, rate, KNOWN, 60.0)
    assert late.told < 1.1  # nobody turns on for a minute because he turned at its end


@pytest.mark.parametrize("lost", [0.1, 0.5])
def test_yaw_through_lost_bursts_lies_within_three_of_its_deviations(lost):
    """A vehicle in curves, shaken; a quarter of a second is lost at a time, without aiding."""
    ratios = []
    for seed in range(12):
        generator = np.random.default_rng(seed)
        steps = 2000
        times = np.arange(steps) * DT
        curve = 0.3 * np.sin(0.4 * times + generator.uniform(0.0, 6.0))
        shaken = 0.03 * np.convolve(generator.normal(size=steps + 3), [0.25] * 4, "valid")
        rates = curve + 2.0 * shaken
        gone = False
        estimator, yaw, since = aligned_filter(0.0, 1e-3, SURE), 0.0, 0.0
        for k, rate in enumerate(rates):
            yaw, since = yaw + rate * DT, since + DT
            gone = (
                generator.random() > 0.04 if gone else generator.random() < 0.04 * lost / (1 - lost)
            )
            if gone and k > 200:
                continue
            read = np.array(
                [0.0, 0.0, rate + SENSORS.gyro_noise / math.sqrt(DT) * 0.1 * generator.normal()]
            )
            estimator.predict(fused(read, dt=since), since)
            since = 0.0
        state = estimator.state(0)
        ratios.append(wrap(yaw_of(state.q_nb) - yaw) / state.yaw_std)
    assert max(map(abs, ratios)) < 3.0
    assert math.sqrt(np.mean(np.square(ratios))) < 1.3


def test_a_gap_of_seconds_does_not_overturn_a_level_vehicle():
    """It was shaken at 7 deg/s when the readings came back; that is no tilt of 15 degrees."""
    estimator = aligned_filter()
    for _ in range(300):
        estimator.predict(fused(np.zeros(3)), DT)
    estimator.predict(fused(np.radians([7.0, -7.0, 0.0]), dt=2.0), 2.0)
    state = estimator.state(0)
    roll, pitch, _ = state.euler
    assert max(abs(roll), abs(pitch)) < math.radians(4.0)
    assert max(abs(roll) / state.roll_std, abs(pitch) / state.pitch_std) < 1.5
    assert state.roll_std < math.radians(7.0)
    assert state.yaw_std > math.radians(10.0)


def test_a_heading_of_before_a_gap_says_nothing_of_what_was_turned_in_it():
    parameters = HeadingParameters()
    estimator, guard = Eskf(AttitudeParameters(), parameters), HeadingGuard(parameters, True)
    elapsed = 0.0

    def epoch(dt):
        nonlocal elapsed
        elapsed += dt
        estimator.predict(fused(np.zeros(3), dt=dt), dt)
        track = Track.of([(fused(np.zeros(3)), estimator.state(0), NO_FORCE)])
        guard.advance(track, np.array([elapsed]), np.array([dt]))

    def fix(heading):
        motion = Motion(10.0, Heading(heading, 1e-4, HeadingSource.VELOCITY))
        return guard.take(estimator, motion)

    assert fix(1.0) is None  # who knows when the first epoch comes
    for k in range(300):
        epoch(0.01)
        if k % 20 == 19:
            assert fix(1.0) is not None
    known = estimator.state(0).yaw_std
    epoch(1.0)
    assert fix(1.0) is None
    assert estimator.state(0).yaw_std > 2.0 * known
    for _ in range(20):
        epoch(0.01)
    assert fix(1.05).fused
