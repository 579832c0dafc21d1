"""A simulated sensor errs as its parameters say; bounds are five standard deviations wide."""

import math
from dataclasses import replace

import numpy as np
import pytest

from risaf_link.sim.disturbances import Thermal
from risaf_link.sim.equipment import CONSUMER_GYROS
from risaf_link.sim.receiver import ReceiverParameters, fixes
from risaf_link.sim.routes import PARAN
from risaf_link.sim.sensors import TriadArray, TriadErrors
from risaf_link.sim.trajectory import Circle

PERFECT = TriadErrors(0.0, 0.0, 0.0, math.inf)
CIRCLE = Circle(PARAN, speed=10.0, radius=100.0)
QUIET = ReceiverParameters(velocity_noise=0.0, position_noise=0.0, altitude_noise=0.0)


def read(errors, samples, sensors, rate=100.0, truth=(0.0, 0.0, 0.0), seed=1):
    array = TriadArray(errors, sensors, rate, np.random.default_rng(seed))
    return array.read(np.tile(truth, (samples, 1)))


def within(estimate, expected, independent):
    """Whether an estimated standard deviation is as good as so many samples make it."""
    return abs(estimate / expected - 1) < 5 / math.sqrt(2 * independent)


def test_a_perfect_array_reads_the_truth():
    readings = read(PERFECT, 3, 2, truth=(0.1, 0.2, -0.3))
    assert readings.shape == (3, 2, 3)
    assert (readings == [0.1, 0.2, -0.3]).all()


@pytest.mark.parametrize("rate", [10.0, 1000.0])
def test_noise_is_white_and_integrates_to_the_same_walk_at_every_rate(rate):
    noise = read(replace(PERFECT, noise_density=2e-4), 1000, 100, rate)
    assert within(noise.std(), 2e-4 * math.sqrt(rate), noise.size)
    scaled = noise / noise.std()
    limit = 5 / math.sqrt(noise.size)
    assert abs(scaled.mean()) < limit
    assert abs((scaled[1:] * scaled[:-1]).mean()) < limit
    assert abs((scaled[:, 1:] * scaled[:, :-1]).mean()) < limit
    assert abs((scaled[..., 1:] * scaled[..., :-1]).mean()) < limit


@pytest.mark.parametrize("rate", [10.0, 40.0])
def test_biases_start_apart_and_walk_away(rate):
    errors = replace(PERFECT, initial_bias=0.01, bias_walk=0.003)
    biases = read(errors, int(10 * rate), 800, rate)
    channels = biases[0].size
    assert within(biases[0].std(), 0.01, channels)
    walked = biases[-1] - biases[0]
    assert within(walked.std(), 0.003 * math.sqrt(10 - 1 / rate), channels)
    assert abs((walked * biases[0]).mean()) < 5 * walked.std() * biases[0].std() / math.sqrt(
        channels
    )
    steps = np.diff(biases, axis=0)
    assert within(steps.std(), 0.003 / math.sqrt(rate), steps.size)


def test_the_bias_that_is_told_is_the_one_in_the_readings():
    array = TriadArray(
        replace(PERFECT, initial_bias=0.01, bias_walk=0.003), 5, 100.0, np.random.default_rng(1)
    )
    readings = array.read(np.zeros((20, 3)))
    assert (array.bias_b == readings[-1]).all()


def test_biases_may_all_be_of_one_size():
    biases = read(replace(PERFECT, initial_bias=0.01, equal_biases=True), 1, 1000)
    assert (abs(biases) == 0.01).all()
    assert abs((biases > 0).mean() - 0.5) < 2.5 / math.sqrt(biases.size)


def test_a_sound_array_drifts_together_as_it_warms_up():
    warming = Thermal(common=1.0, own=0.1, time_constant=50.0)
    drift = read(replace(PERFECT, warming=warming), 2000, 400, rate=10.0)
    assert (drift[0] == 0.0).all()
    final = drift[-1] / (1 - math.exp(-199.9 / 50.0))
    assert drift[500] == pytest.approx(final * (1 - math.exp(-1.0)))
    assert within(final.std(axis=0).mean(), 0.1, 3 * 400)
    common = [
        read(replace(PERFECT, warming=replace(warming, own=0.0)), 2, 5, 1e-3, seed=seed)[1, :, 2]
        for seed in range(300)
    ]
    assert np.ptp(common, axis=1).max() == 0.0
    assert within(np.std(common), 1.0, 300)


def test_no_reading_is_beyond_the_range():
    loud = replace(CONSUMER_GYROS, full_scale=math.radians(10))
    readings = read(loud, 200, 50, truth=(0.0, 0.5, -0.5))
    assert abs(readings).max() == math.radians(10)
    assert (readings[..., 1] == math.radians(10)).mean() > 0.95


def test_readings_do_not_depend_on_how_time_is_cut():
    truth = np.random.default_rng(3).normal(size=(60, 3))
    whole, cut = (TriadArray(CONSUMER_GYROS, 7, 100.0, np.random.default_rng(5)) for _ in range(2))
    blocks = [cut.read(block) for block in np.split(truth, [1, 1, 20, 41])]
    assert (np.concatenate(blocks) == whole.read(truth)).all()


def observe(parameters, duration):
    return fixes(CIRCLE, duration, parameters, np.random.default_rng(2))


def test_a_perfect_receiver_reports_the_past():
    report = observe(replace(QUIET, latency=0.25), 60.0)
    past = CIRCLE(report.arrival_s - 0.25)
    assert report.latitude == pytest.approx(past.latitude, abs=1e-15)
    assert report.longitude == pytest.approx(past.longitude, abs=1e-15)
    assert report.speed == pytest.approx(10.0)
    yaw = 0.1 * (report.arrival_s - 0.25)
    assert np.sin(report.course - yaw) == pytest.approx(0.0, abs=1e-12)
    assert np.diff(report.arrival_s) == pytest.approx(0.2)
    assert report.arrival_s[-1] < 60.0 <= report.arrival_s[-1] + 0.2


def test_positions_err_slowly_and_as_much_as_the_receiver_says():
    report = observe(ReceiverParameters(), 20_000.0)
    truth = CIRCLE(report.time_s)
    # A sphere is good enough for metres.
    north = 6.37e6 * (report.latitude - truth.latitude)
    east = 6.37e6 * (report.longitude - truth.longitude) * math.cos(PARAN.latitude)
    errors = {
        report.position_std: (north, east),
        report.altitude_std: (truth.altitude - report.altitude,),
    }
    for std, components in errors.items():
        for error in components:
            assert within(error.std(), std, 20_000 / (2 * 60))
            step = std * math.sqrt(2 * (1 - math.exp(-0.2 / 60)))
            assert np.diff(error).std() == pytest.approx(step, rel=0.02)


def test_positions_may_err_without_memory():
    report = observe(ReceiverParameters(time_constant=0.0), 4000.0)
    north = 6.37e6 * (report.latitude - CIRCLE(report.time_s).latitude)
    assert within(north.std(), 1.5, len(north))
    assert abs((north[1:] * north[:-1]).mean()) < 5 * 1.5**2 / math.sqrt(len(north))


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_the_course_errs_as_the_receiver_says(speed):
    trajectory = replace(CIRCLE, speed=speed)
    report = fixes(trajectory, 4000.0, ReceiverParameters(), np.random.default_rng(4))
    error = np.sin(report.course - speed / 100 * report.time_s)
    ratio = error / report.course_std
    assert np.sqrt((ratio**2).mean()) == pytest.approx(1.0, abs=0.05)
    assert abs(ratio.mean()) < 5 / math.sqrt(len(ratio))
    assert within((report.speed - speed).std(), report.velocity_std, len(ratio))


def test_the_course_of_a_vehicle_at_rest_is_not_known():
    resting = fixes(replace(CIRCLE, speed=0.0), 10.0, QUIET, np.random.default_rng(4))
    assert (resting.course_std == math.pi).all()


def test_a_run_shorter_than_the_latency_has_no_fix():
    assert len(observe(ReceiverParameters(), 0.1).time_s) == 0
