"""A start that goes on from what was known: the truth lies where it says, whatever happened since.

The world of these tests is made here: an array with biases that walk, a vehicle that drives curves
or stands, headings from GPS, and interruptions of any length.
"""

import math

import numpy as np
import pytest
from msgspec import structs

from risaf_link.core import aiding, eskf, estimator, kernel, robust
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import EpochBlock, FusionParameters
from risaf_link.core.heading import Heading, HeadingParameters, HeadingSource, Motion
from risaf_link.core.memory import ArrayIdentity, Memory
from risaf_link.core.rotation import wrap
from risaf_link.core.track import RESETS
from risaf_link.core.track import WALK as BIAS_WALK
from risaf_link.core.warm import MOST, TRIAL, Trial

FORMS = {"numpy": (robust, eskf, aiding), "kernel": (kernel, kernel, kernel)}
UNIX_US, BOOT_US = 1_700_000_000_000_000, 5_000_000
DT, SENSORS = 0.1, 12
NOISE = 2e-3  # rad/s, of one reading
BIAS_STD, WALK = 3e-3, 5e-5  # rad/s; rad/s/sqrt(s), of one sensor
HEADING_STD = 0.02  # rad
LATITUDE = 0.5
PARAMETERS = (
    FusionParameters(bias_walk=WALK),
    AttitudeParameters(initial_bias_std=BIAS_STD, scale_std=1e-6, common_bias_walk=1e-9),
    HeadingParameters(delay=0.0),
)
SEEDS = range(20)


@pytest.fixture(scope="module", params=FORMS, autouse=True)
def form(request):
    """Estimators are of one form, then of the other."""
    if request.param == "kernel" and not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    of_fusion, of_filter, of_aiding = FORMS[request.param]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(estimator.FUSIONS, "robust", of_fusion.Robust)
        patch.setattr(kernel, "Robust", of_fusion.Robust)
        patch.setattr(kernel, "Eskf", of_filter.Eskf)
        patch.setattr(kernel, "Aiding", of_aiding.Aiding)
        yield request.param


class World:
    """A vehicle with an array and a receiver; it turns at random, or stands."""

    def __init__(self, seed, stands=False, sensors=SENSORS):
        self.generator = np.random.default_rng(seed)
        self.yaw = self.generator.uniform(-3.0, 3.0)
        self.rate, self.stands, self.time = 0.0, stands, 0.0
        self.speed = 0.0 if stands else 10.0  # m/s
        self.biases = self.generator.normal(0.0, BIAS_STD, (sensors, 3))
        self.host_us = UNIX_US

    def move(self, dt):
        """Go on for a moment; the rate of turn wanders about zero within seconds."""
        if not self.stands:
            self.rate *= math.exp(-dt / 3.0)
            self.rate += 0.15 * math.sqrt(1.0 - math.exp(-2.0 * dt / 3.0)) * self.generator.normal()
        self.yaw = wrap(self.yaw + self.rate * dt)
        self.time += dt
        walked = self.generator.normal(size=self.biases.shape)
        self.biases = self.biases + WALK * math.sqrt(dt) * walked

    def epoch(self, dt):
        rates_b = self.biases + NOISE * self.generator.normal(size=self.biases.shape)
        rates_b[:, 2] += self.rate
        forces_b = np.array([[0.0, self.speed * self.rate, -GRAVITY]])
        forces_b += 0.02 * self.generator.normal(size=(1, 3))
        return EpochBlock(
            np.array([BOOT_US + round(self.time * 1e6)]),
            np.array([dt]),
            rates_b[np.newaxis],
            forces_b[np.newaxis],
            np.array([self.host_us + round(self.time * 1e6)]),
        )

    def fix(self):
        heading = wrap(self.yaw + HEADING_STD * self.generator.normal())
        measured = Heading(heading, HEADING_STD**2, HeadingSource.DUAL_ANTENNA)
        return Motion(self.speed, measured, 0.1)

    def interrupt(self, seconds):
        for _ in range(max(round(seconds / DT), 1)):
            self.move(seconds / max(round(seconds / DT), 1))


class Run:
    """An estimator in a world, with what it remembers from before a restart."""

    def __init__(self, world, memory=None, gps=True):
        self.world, self.gps = world, gps
        self.estimator = Estimator(*PARAMETERS)
        self.trial = Trial(memory) if memory else None
        self.text, self.step = "", 0
        self.off = []  # rad/s, fused rate and the true one

    def go(self, seconds):
        for _ in range(round(seconds / DT)):
            dt = DT if self.step else 0.0
            if dt:
                self.world.move(dt)
            self.take(self.world.epoch(dt))
            if self.gps and self.step % 2 == 0:
                self.hear(self.world.fix())
            self.step += 1
        return self

    def take(self, epoch):
        if self.trial:
            self.trial.note_epochs(epoch, self.estimator.elapsed)
        self.track, _ = self.estimator.advance(epoch.dt, epoch.rates_b, epoch.forces_b)
        self.off.append(self.track.fused_b[0] - (0.0, 0.0, self.world.rate))
        self.epoch = epoch
        if self.trial and self.trial.is_over:
            verdict = self.trial.judge(PARAMETERS, int(self.track.values[0, RESETS]))
            self.trial, self.text = None, verdict.text
            self.estimator = verdict.estimator or self.estimator

    def hear(self, motion):
        if self.trial:
            self.trial.note_fix(motion, LATITUDE)
        self.estimator.correct(motion, LATITUDE)

    def memory(self):
        parts = self.estimator.memory(self.track.values[0, BIAS_WALK])
        times = int(self.epoch.time_us[0]), int(self.epoch.received_us[0])
        return Memory(ArrayIdentity("GYRO_ARRAY", 0, "", len(parts[0]), 0), *times, *parts)

    @property
    def yaw_ratio(self):
        """Error of yaw over its standard deviation."""
        return wrap(self.state.euler[2] - self.world.yaw) / self.state.yaw_std

    @property
    def state(self):
        return self.track.attitude(0, 0)

    @property
    def bias_ratios(self):
        """Errors of the bias over its standard deviation, (3,), by the truth of 1.5 s."""
        last = np.array(self.off[-15:])
        variance = self.estimator.memory(np.zeros(3))[2].covariance.diagonal()[3:6]
        white = NOISE**2 / SENSORS / len(last)
        return (last.mean(axis=0) - self.state.bias_b) / np.sqrt(variance + white)


def restarted(seed, gap, *, stands=False, gps=False, before=20.0, after=2.0, meanwhile=None):
    """A run after an interruption; of the world meanwhile more may have changed."""
    world = World(seed, stands)
    memory = Run(world).go(before).memory()
    assert memory.is_sound
    world.interrupt(gap)
    if meanwhile:
        meanwhile(world)
    return Run(world, memory, gps).go(after)


def bounds(degrees):
    """95 % of the mean of so many squared standard deviations."""
    half = 1.96 * math.sqrt(2.0 / degrees)
    return 1.0 - half, 1.0 + half


def gaps(seed):
    return float(np.random.default_rng(seed + 100).uniform(0.3, 4.0))


def power_off(world):
    """Every sensor has another bias when it is switched on again, and clocks start anew."""
    world.biases = world.biases + world.generator.normal(0.0, 1e-3, world.biases.shape)
    world.host_us += round(1e6 * world.time)
    world.time = 0.0


def another_array(world):
    world.biases = world.generator.normal(0.0, BIAS_STD, world.biases.shape)


CASES = {
    "crash on the move": lambda seed: restarted(seed, gaps(seed)),
    "crash on the move, GPS there": lambda seed: restarted(seed, gaps(seed), gps=True),
    "crash at rest": lambda seed: restarted(seed, 2.0 * gaps(seed), stands=True),
    "five minutes": lambda seed: restarted(seed, 300.0, gps=True, after=3.0),
    "power off": lambda seed: restarted(seed, 100.0, gps=True, after=3.0, meanwhile=power_off),
}


@pytest.fixture(scope="module", params=CASES)
def runs(request, form):  # noqa: ARG001 which form is run is its doing
    return [CASES[request.param](seed) for seed in SEEDS]


def test_after_an_interruption_the_truth_lies_within_three_standard_deviations(runs):
    assert all(run.text.startswith("warm start") for run in runs)
    assert max(abs(run.yaw_ratio) for run in runs) < 3.0
    # Of 60 values one in six series goes beyond 3.
    assert np.abs([run.bias_ratios for run in runs]).max() < 3.5


def test_the_average_nees_of_the_bias_is_within_its_bounds(runs):
    squares = np.array([run.bias_ratios for run in runs]) ** 2
    _, high = bounds(squares.size)
    assert 0.25 < squares.mean() < high  # pessimistic: few sensors tell little


def test_nothing_is_believed_before_the_trial_is_over():
    run = restarted(1, 1.0, after=0.9 * TRIAL)
    assert (run.text, run.state.aligned, run.state.yaw_std) == ("", False, math.pi)


def test_what_was_known_of_the_bias_spares_learning_it_again():
    warm, cold = restarted(1, 300.0), Run(World(1), gps=False).go(2.0)
    variances = [
        run.estimator.memory(np.zeros(3))[2].covariance.diagonal()[3:6] for run in (warm, cold)
    ]
    assert (variances[0] < variances[1] / 10.0).all()


def test_a_vehicle_that_stood_keeps_its_heading():
    run = restarted(2, 8.0, stands=True)
    assert run.text == "warm start: heading of 8 s ago"
    assert run.state.yaw_std < math.radians(1.0)


def test_a_vehicle_that_drove_on_may_point_anywhere_after_a_while():
    run = restarted(2, 8.0)
    assert (run.text, run.state.aligned) == ("warm start: biases of 8 s ago", False)


@pytest.mark.parametrize(
    ("meanwhile", "text"),
    [
        (another_array, "state ignored: the sensors' biases are others"),
        (
            lambda world: setattr(world, "host_us", UNIX_US - 100_000_000),
            "state ignored: 90 s from the future: the clock went back",
        ),
        (
            lambda world: setattr(world, "host_us", UNIX_US + 10**15),
            "state ignored: 11574 days old, or the clock is wrong",
        ),
    ],
)
def test_a_memory_that_does_not_fit_is_no_different_from_none(meanwhile, text):
    warm = restarted(3, 10.0, gps=True, meanwhile=meanwhile, after=5.0)
    world = World(3)
    Run(world).go(20.0)
    world.interrupt(10.0)
    meanwhile(world)
    cold = Run(world).go(5.0)
    assert warm.text == text
    assert (warm.track.values == cold.track.values).all()


@pytest.mark.parametrize("jump_us", [-5_000_000, 60_000_000])
def test_without_clocks_that_agree_no_heading_is_believed(jump_us):
    def jump(world):
        world.host_us += jump_us

    run = restarted(3, 8.0 if jump_us < 0 else 2.0, stands=True, meanwhile=jump)
    assert run.text.startswith("warm start: biases")
    assert not run.state.aligned


def test_two_sensors_are_believed_only_while_they_had_power():
    def run(meanwhile=None):
        world = World(5, sensors=2)
        memory = Run(world).go(20.0).memory()
        world.interrupt(2.0)
        if meanwhile:
            meanwhile(world)
        return Run(world, memory, gps=False).go(1.5)

    assert run().text == "warm start: heading of 2 s ago"
    assert run(power_off).text.startswith("state ignored: too few sensors")


def test_another_number_of_sensors_is_another_array():
    memory = Run(World(5)).go(10.0).memory()
    world = World(5, sensors=8)
    world.interrupt(12.0)
    run = Run(world, memory).go(6.0)
    assert run.text == "state ignored: no 0.5 s of 12 sensors"


def test_a_clock_that_stands_still_does_not_keep_it_waiting_for_ever():
    memory = Run(World(5)).go(10.0).memory()
    run = Run(World(5), memory)
    for _ in range(MOST):
        run.trial.note_epochs(run.world.epoch(0.0), 0.0)
        run.trial.note_fix(run.world.fix(), LATITUDE)
    assert run.trial.is_over
    assert run.trial.judge(PARAMETERS, 0).estimator is None


def test_a_heading_that_gps_contradicts_is_given_up_within_seconds():
    def turned_by_hand(world):
        world.yaw = wrap(world.yaw + 2.5)

    run = restarted(4, 5.0, stands=True, gps=True, after=3.0, meanwhile=turned_by_hand)
    assert abs(run.yaw_ratio) > 100.0
    run.world.stands, run.world.speed = False, 10.0
    run.go(10.0)
    assert abs(run.yaw_ratio) < 4.0


def test_a_sensor_that_was_out_stays_out():
    world = World(6)
    run = Run(world).go(20.0)
    world.biases[4] += 0.05
    memory = run.go(5.0).memory()
    assert not memory.gyros.trusted[:, 4].any()
    world.interrupt(1.0)
    run = Run(world, memory, gps=False).go(1.2)
    health = run.estimator.fusion.health()
    assert health.state[4] > 0
    assert (np.delete(health.state, 4) == 0).all()
    assert (run.track.active[0] == SENSORS - 1).all()


def test_a_burst_in_the_first_second_spoils_nothing():
    world = World(7)
    memory = Run(world).go(20.0).memory()
    world.interrupt(2.0)
    run = Run(world, memory, gps=False)
    true = world.biases
    for _ in range(3):
        world.biases = true + np.where(np.arange(SENSORS)[:, np.newaxis] < 4, 0.3, 0.0)
        run.go(0.1)
        world.biases = true
        run.go(0.4)
    assert run.text == "warm start: heading of 2 s ago"
    variance = run.estimator.memory(np.zeros(3))[2].covariance.diagonal()[3:6]
    error = run.state.bias_b - world.biases.mean(axis=0)
    assert (np.abs(error) < 3.0 * np.sqrt(variance)).all()
    assert np.sqrt(variance).max() < BIAS_STD / 3.0  # as after 20 s, not as at a start


def spoilt(memory, part, **values):
    return structs.replace(memory, **{part: structs.replace(getattr(memory, part), **values)})


def test_a_memory_that_no_estimator_can_have_is_found_out():
    memory = Run(World(8)).go(3.0).memory()
    gyros, attitude = memory.gyros, memory.attitude
    negative = attitude.covariance.copy()
    negative[4, 4] = -1.0
    for part, values in [
        ("gyros", {"channels": gyros.channels[:4]}),
        ("gyros", {"channels": gyros.channels + np.nan}),
        ("gyros", {"channels": gyros.channels[:, :, :0]}),
        ("gyros", {"axes": -gyros.axes}),
        ("gyros", {"elapsed": math.inf}),
        ("attitude", {"q_nb": 2.0 * attitude.q_nb}),
        ("attitude", {"q_nb": attitude.q_nb[:3]}),
        ("attitude", {"covariance": negative}),
        ("attitude", {"covariance": attitude.covariance + np.eye(29, k=1)}),
        ("attitude", {"latitude": 7.0}),
        ("attitude", {"errors": attitude.errors * np.nan}),
    ]:
        assert not spoilt(memory, part, **values).is_sound


def test_both_forms_go_on_alike():
    if not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    forms = [(robust.Robust, eskf.Eskf), (kernel._Robust, kernel._Eskf)]
    memory = Run(World(9)).go(5.0).memory()
    told = []
    for make_fusion, make_filter in forms:
        fusion, attitude = make_fusion(PARAMETERS[0]), make_filter(*PARAMETERS[1:])
        fusion.recall(memory.gyros)
        attitude.recall(memory.attitude, 3)
        again = fusion.memory(), attitude.memory(memory.attitude.bias_walk)
        np.testing.assert_array_equal(again[0].channels, memory.gyros.channels)
        np.testing.assert_array_equal(again[1].covariance, memory.attitude.covariance)
        assert attitude.state(0).resets == 3
        world = World(9)
        for _ in range(100):
            world.move(DT)
            epoch = world.epoch(DT)
            fused = fusion.fuse_readings(0, DT, epoch.rates_b[0])
            attitude.predict(fused, DT)
        told.append((fused.rate_b, attitude.quaternion, attitude.covariance))
    for python, native in zip(*told, strict=True):
        np.testing.assert_allclose(native, python, rtol=1e-9, atol=1e-12)
