"""Robust fusion of simulated arrays, against the truth; the three axes are three draws."""

import math
import sys

import numpy as np
import pytest

from risaf_link.core import kernel, robust
from risaf_link.core.fusion import Epoch, FusionParameters
from risaf_link.core.health import Reason, SensorState

RATE = 25.0
NOISE = math.radians(0.1)  # of one reading
BIAS = math.radians(0.2)
WALK = math.radians(0.003)  # 1/sqrt(s)
RANGE = math.radians(250.0)
DEGREE = math.radians(1.0)
PARAMETERS = FusionParameters(bias_walk=WALK)


Robust = robust.Robust
FORMS = {"numpy": robust.Robust, "kernel": kernel.Robust}


@pytest.fixture(params=FORMS, autouse=True)
def _form(request, monkeypatch):
    """Run every test on both forms of the fusion."""
    if request.param == "kernel" and not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    monkeypatch.setattr(sys.modules[__name__], "Robust", FORMS[request.param])


class Drive:
    """A vehicle that turns and vibrates, and an array on it: rates (k, 3), readings (k, n, 3)."""

    def __init__(self, sensors, duration, seed=1, rate=RATE, walk=WALK):
        self.generator = np.random.default_rng(seed)
        self.rate = rate
        shape = (int(duration * rate), sensors, 3)
        time = np.arange(shape[0])[:, np.newaxis] / rate
        turns = math.radians(20.0) * np.sin(time * [0.7, 1.0, 0.4])
        self.truth = turns + self.normal(DEGREE, (shape[0], 3))
        self.bias = self.normal(BIAS, shape[1:])
        self.bias = self.bias + self.normal(walk / math.sqrt(rate), shape).cumsum(axis=0)
        self.readings = self.truth[:, np.newaxis] + self.bias + self.normal(NOISE, shape)

    def normal(self, size, shape):
        return self.generator.normal(0.0, size, shape)

    def at(self, seconds):
        return round(seconds * self.rate)

    def shock(self, who, seconds, size=20.0 * DEGREE, decay=0.5):
        """A one-sided burst, of each sensor its own size."""
        rest = self.readings[self.at(seconds) :, who]
        since = np.arange(len(rest))[:, np.newaxis, np.newaxis] / self.rate
        rest += self.generator.exponential(size, rest.shape[1:]) * np.exp(-since / decay)

    def fused(self, fusion=None):
        return fuse(self.readings, self.rate, fusion)


def fuse(readings, rate=RATE, fusion=None):
    """Every epoch's result, and the fusion as it is then."""
    fusion = fusion or Robust(PARAMETERS)
    none = np.zeros((0, 3))
    results = [
        fusion.fuse(Epoch(i, 1.0 / rate if i else 0.0, epoch, none, 0))
        for i, epoch in enumerate(readings)
    ]
    return results, fusion


def rates(results):
    return np.array([result.rate_b for result in results])


def drift(drive, start, end):
    """By how much the integrated rate has left its course until `start`, worst axis, rad."""
    results, _ = drive.fused()
    error = rates(results) - drive.truth
    late = error[drive.at(start) : drive.at(end)] - error[drive.at(1.0) : drive.at(start)].mean(0)
    return np.abs(late.cumsum(axis=0) / drive.rate).max()


def chi_square(drive, start=5.0):
    """Mean of the square of the white error against the stated variance, one for each axis.

    White is what differs from one epoch to the next.
    """
    results, _ = drive.fused()
    error = np.diff(rates(results) - drive.truth, axis=0)
    variance = np.array([result.noise for result in results])
    square = error**2 / (variance[1:] + variance[:-1])
    return square[drive.at(start) :].mean(axis=0)


def frozen(drive, who):
    drive.readings[drive.at(8) :, who] = drive.readings[drive.at(8), who]


def saturated(drive, who):
    drive.readings[drive.at(8) :, who] = RANGE


def silent(drive, who):
    drive.readings[drive.at(8) :, who] = np.nan


def stepped(drive, who):
    drive.readings[drive.at(8) :, who] += 2.0 * DEGREE


def drifting(drive, who):
    ramp = np.arange(len(drive.readings)) / drive.rate - 8.0
    drive.readings[:, who] += 0.1 * DEGREE * np.maximum(ramp, 0.0)[:, np.newaxis, np.newaxis]


def scaled(drive, who):
    drive.readings[drive.at(8) :, who] *= 1.3


def bursting(drive, who):
    for second in range(8, 30, 4):
        drive.shock(who, second)


def spiking(drive, who):
    hit = drive.generator.random(drive.readings[:, who].shape) < 0.1
    drive.readings[:, who] += hit * 30.0 * DEGREE


def dropping_out(drive, who):
    hit = drive.generator.random(drive.readings[:, who].shape[:2]) < 0.5
    drive.readings[:, who] += np.where(hit, np.nan, 0.0)[..., np.newaxis]


FAULTS = [
    frozen, saturated, silent, stepped, drifting, scaled, bursting, spiking, dropping_out
]  # fmt: skip


@pytest.mark.parametrize("sensors", [5, 30])
@pytest.mark.parametrize("fault", FAULTS)
def test_two_fifths_of_the_array_may_fail_in_any_way(fault, sensors):
    drive = Drive(sensors, 30.0)
    fault(drive, slice(0, int(0.4 * sensors)))
    assert drift(drive, 8.0, 30.0) < 1.5 * DEGREE  # a drift's two fifths alone make 9.7


def test_a_mix_of_faults_on_two_fifths_drifts_little_more_than_the_same_array_without():
    sound, faulty = [], []
    for seed in range(3):
        sound.append(drift(Drive(30, 40.0, seed), 15.0, 40.0))
        drive = Drive(30, 40.0, seed)
        for first, fault in enumerate([frozen, saturated, stepped, scaled, drifting, bursting]):
            fault(drive, slice(2 * first, 2 * first + 2))
        faulty.append(drift(drive, 15.0, 40.0))
    assert np.mean(faulty) < 3.0 * np.mean(sound)  # 0.1 degrees; the plain mean: 400


@pytest.mark.parametrize(("share", "rate"), [(0.2, 25.0), (0.35, 100.0)])
def test_spikes_on_every_sensor_are_no_reason_to_distrust_any(share, rate):
    drive = Drive(40, 40.0, rate=rate)
    sound = drift(drive, 10.0, 40.0)
    hit = drive.generator.random(drive.readings.shape) < share
    drive.readings += hit * drive.normal(20.0 * DEGREE, drive.readings.shape)
    _, fusion = drive.fused()
    assert (fusion.health().state == SensorState.HEALTHY).sum() >= 36
    assert drift(drive, 10.0, 40.0) < 2.0 * sound + math.radians(0.05)


def test_bursts_on_a_third_do_not_become_drift():
    clean = drift(Drive(60, 60.0), 20.0, 60.0)
    drive = Drive(60, 60.0)
    for second in range(5, 60, 6):
        drive.shock(slice(0, 20), second)
    mean_error = (drive.readings.mean(axis=1) - drive.truth - drive.bias.mean(axis=1)).sum(axis=0)
    hit = drift(drive, 20.0, 60.0)
    assert hit < 2.0 * clean + math.radians(0.05)
    assert hit < 0.02 * mean_error.min() / RATE


@pytest.mark.parametrize(("sensors", "seconds"), [(3, 60.0), (10, 40.0), (100, 20.0)])
def test_the_stated_variance_is_that_of_the_white_error(sensors, seconds):
    squares = chi_square(Drive(sensors, seconds))
    # Differences of neighbours are correlated by a half: 1.5 times the variance of chi-square.
    bound = 1.96 * math.sqrt(3.0 / (3 * (seconds - 5.0) * RATE))
    assert abs(squares.mean() - 1.0) < bound


def test_the_stated_variance_is_honest_under_faults():
    drive = Drive(30, 40.0)
    for first, fault in enumerate([frozen, saturated, spiking, bursting, dropping_out, stepped]):
        fault(drive, slice(2 * first, 2 * first + 2))
    squares = chi_square(drive, 10.0)
    assert abs(squares.mean() - 1.0) < 1.96 * math.sqrt(3.0 / (3 * 30.0 * RATE))


def test_the_stated_bias_walk_is_that_of_the_fused_bias():
    squares = []
    for seed in range(100, 108):
        drive = Drive(20, 65.0, seed, rate=10.0, walk=10 * WALK)
        results, _ = drive.fused()
        means = (rates(results) - drive.truth).reshape(65, -1, 3).mean(axis=1)  # over 1 s
        stated = np.array([result.bias_walk for result in results]) ** 2 / drive.rate
        white = np.array([result.noise for result in results]).mean(axis=0) / drive.rate
        for second in (29, 44):
            walked = stated[drive.at(second + 1) : drive.at(second + 16)].sum(axis=0)
            squares.append((means[second + 15] - means[second]) ** 2 / (walked + 2 * white))
    assert 30.8 / 48 < np.mean(squares) < 69.0 / 48  # 48 draws of chi-square


@pytest.mark.parametrize("sensors", [2, 10])
def test_an_array_that_repeats_itself_says_nothing_until_it_goes_on(sensors):
    drive = Drive(sensors, 15.0)
    frozen = slice(drive.at(10), drive.at(12))
    drive.readings[frozen] = drive.readings[drive.at(10)]
    _, fusion = fuse(drive.readings[: drive.at(12)])
    assert (fusion.health().state == SensorState.DEAD).all()
    assert (fusion.health().reason == Reason.FROZEN).all()
    results, _ = drive.fused()
    is_known = np.isfinite(rates(results)).all(axis=1)
    assert not is_known[drive.at(10.1) : drive.at(12)].any()
    assert is_known[: drive.at(10)].all()
    assert is_known[drive.at(12) :].all()
    error = rates(results) - drive.truth - drive.bias.mean(axis=1)
    before, after = error[drive.at(8) : drive.at(10)], error[drive.at(12) :]
    assert np.abs(after.mean(axis=0) - before.mean(axis=0)).max() < 0.2 * BIAS


def test_counts_that_are_coarser_than_the_noise_do_not_look_frozen_at_rest():
    drive = Drive(4, 20.0, walk=0.0)
    noise = drive.readings - drive.truth[:, np.newaxis] - drive.bias
    drive.truth[drive.at(10) :] = 0.0
    drive.readings = drive.truth[:, np.newaxis] + drive.bias + 0.01 * noise
    drive.readings = np.rint(drive.readings / 0.001) * 0.001
    _, fusion = drive.fused()
    assert not (fusion.health().reason == Reason.FROZEN).any()


def test_a_shock_to_all_passes_and_leaves_every_sensor_trusted_in_the_end():
    drive = Drive(30, 30.0)
    drive.shock(slice(None), 10.0)
    results, fusion = drive.fused()
    assert (fusion.health().state == SensorState.HEALTHY).sum() >= 27
    error = rates(results) - drive.truth - drive.bias.mean(axis=1)
    moved = error[drive.at(25) :].mean(axis=0) - error[drive.at(5) : drive.at(10)].mean(axis=0)
    assert np.abs(moved).max() < 0.1 * BIAS


@pytest.mark.parametrize(
    ("fault", "state", "reason"),
    [
        (frozen, SensorState.DEAD, Reason.FROZEN),
        (saturated, SensorState.DEAD, Reason.FROZEN),
        (silent, SensorState.DEAD, Reason.SILENT),
        (stepped, SensorState.SUSPECT, Reason.OUTLYING),
        (drifting, SensorState.SUSPECT, Reason.OUTLYING),
    ],
)
def test_a_sensor_is_told_what_is_wrong_with_it(fault, state, reason):
    drive = Drive(20, 20.0)
    fault(drive, slice(0, 1))
    _, fusion = drive.fused()
    assert fusion.health().state[0] == state
    assert fusion.health().reason[0] == reason
    assert (fusion.health().state[1:] == SensorState.HEALTHY).sum() >= 17


def test_a_slow_drift_is_seen_before_any_reading_is_outlying():
    drive = Drive(20, 40.0)
    drive.readings[:, 0] += 0.01 * DEGREE * np.arange(len(drive.readings))[:, np.newaxis] / RATE
    _, fusion = drive.fused()
    assert fusion.health().reason[0] in {Reason.WANDERING, Reason.SETTLING}
    assert fusion.health().rejected[0] < 0.2


def test_a_sensor_that_recovers_is_used_again():
    drive = Drive(10, 60.0)
    drive.readings[drive.at(10) : drive.at(20), 0] = RANGE
    drive.readings[drive.at(10) : drive.at(50), 1] = np.nan
    _, fusion = drive.fused()
    assert (fusion.health().state[:2] == SensorState.HEALTHY).all()


def test_a_sensor_that_stepped_for_good_comes_back_with_its_new_bias():
    drive = Drive(10, 60.0)
    drive.readings[drive.at(10) :, 0] += 2.0 * DEGREE
    results, fusion = drive.fused()
    assert fusion.health().state[0] == SensorState.HEALTHY
    expected = drive.bias[-1, 0] + 2.0 * DEGREE - drive.bias[-1, 1:].mean(axis=0)
    assert np.allclose(fusion.relative_bias[0], expected, atol=0.4 * BIAS)
    error = rates(results) - drive.truth - drive.bias.mean(axis=1)
    moved = error[-drive.at(5) :].mean(axis=0) - error[drive.at(5) : drive.at(10)].mean(axis=0)
    assert np.abs(moved).max() < 0.2 * BIAS


@pytest.mark.parametrize("rate", [25.0, 250.0])
def test_times_are_seconds_at_every_rate(rate):
    drive = Drive(12, 10.0, rate=rate)
    drive.readings[drive.at(1) : drive.at(3), 0] = np.nan
    drive.readings[drive.at(1) :, 1] = 0.0
    fusion, states = Robust(PARAMETERS), []
    for i, epoch in enumerate(drive.readings):
        fusion.fuse(Epoch(i, 1 / rate if i else 0.0, epoch, np.zeros((0, 3)), 0))
        states.append(fusion.health().state)
    silent, unchanging = np.transpose(states)[:2]
    dead = silent == SensorState.DEAD
    assert dead.argmax() / rate == pytest.approx(2.0, abs=0.05)
    last_dead = dead.nonzero()[0].max()
    assert last_dead / rate == pytest.approx(3.0, abs=0.05)
    healthy_again = last_dead + (silent[last_dead:] == SensorState.HEALTHY).argmax()
    assert healthy_again / rate == pytest.approx(8.0, abs=0.1)
    assert (unchanging == SensorState.DEAD).argmax() / rate == pytest.approx(1.5, abs=0.05)


def test_one_sensor_is_taken_as_it_is_and_believed_as_configured():
    drive = Drive(1, 2.0)
    results, fusion = drive.fused()
    assert np.array_equal(rates(results), drive.readings[:, 0])
    assert np.isnan(results[-1].variance).all()
    assert np.allclose(results[-1].noise, PARAMETERS.gyro_noise**2 * RATE)
    assert np.allclose(results[-1].bias_walk, PARAMETERS.bias_walk)
    assert fusion.health().state.tolist() == [SensorState.HEALTHY]


def test_of_two_sensors_the_mean_is_taken_and_neither_is_blamed():
    drive = Drive(2, 10.0)
    drive.readings[:, 0] += DEGREE
    results, fusion = drive.fused()
    assert np.allclose(rates(results), drive.readings.mean(axis=1))
    assert fusion.health().state.tolist() == [SensorState.HEALTHY] * 2
    assert np.allclose(results[-1].noise, NOISE**2 / 2, rtol=0.8)


def test_an_array_may_grow_and_shrink_without_a_step_of_the_rate():
    drive = Drive(30, 60.0)
    # Of ten sensors more, each of 2 deg/s, nothing may show but what they settle to.
    drive.readings[:, 20:] += 2.0 * DEGREE
    fusion = Robust(PARAMETERS)
    sizes = [(0.0, 20.0, 20), (20.0, 40.0, 30), (40.0, 60.0, 12)]
    parts = [
        rates(fuse(drive.readings[drive.at(a) : drive.at(b), :n], fusion=fusion)[0])
        for a, b, n in sizes
    ]
    assert len(fusion.health().state) == 12
    error = np.vstack(parts) - drive.truth
    means = error.reshape(12, -1, 3).mean(axis=1)  # over 5 s
    assert np.abs(means - means[0]).max() < 0.15 * BIAS


def test_there_is_a_rate_as_long_as_one_reading_is_valid():
    drive = Drive(8, 4.0)
    drive.readings[drive.at(2) :, 1:, 0] = np.nan
    drive.readings[drive.at(2) :, :, 1] = np.inf
    results, _ = drive.fused()
    finite = np.isfinite(rates(results))[drive.at(2) :]
    assert finite[:, [0, 2]].all()
    assert not finite[:, 1].any()
    assert results[-1].active.tolist() == [1, 0, 8]
    assert results[-1].valid == 0


def test_no_array_at_all_is_no_rate():
    results, fusion = fuse(np.zeros((3, 0, 3)))
    assert np.isnan(rates(results)).all()
    assert fusion.health().state.shape == (0,)


@pytest.mark.parametrize("dt", [0.0, math.nan, -1.0, 1e9])
def test_any_time_step_is_survived(dt):
    drive = Drive(5, 4.0)
    _, fusion = drive.fused()
    epochs = [Epoch(0, dt, epoch, np.zeros((0, 3)), 0) for epoch in drive.readings[:5]]
    results = [fusion.fuse(epoch) for epoch in epochs]
    assert np.abs(rates(results) - drive.truth[:5]).max() < 5 * BIAS
    assert (fusion.health().state == SensorState.HEALTHY).all()


def test_coarse_counts_are_no_fault():
    drive = Drive(30, 15.0)
    count = 2 * math.radians(2000.0) / 65536
    drive.readings = np.rint(drive.readings / count) * count
    _, fusion = drive.fused()
    assert (fusion.health().state == SensorState.HEALTHY).sum() >= 27


def test_accelerometers_are_fused_by_the_same_code():
    forces = np.random.default_rng(1).normal([0.0, 0.0, -9.8], 0.05, (400, 12, 3))
    forces[200:, 0] = 0.0
    fusion = Robust(FusionParameters(resolution=0.01, bias_walk=1e-3))
    for i, epoch in enumerate(forces):
        fused = fusion.fuse_readings(i, 0.01, epoch)
    assert np.allclose(fused.rate_b, [0.0, 0.0, -9.8], atol=0.1)
    assert fusion.health().state[0] == SensorState.DEAD


def test_a_thousand_sensors_are_fused():
    drive = Drive(1000, 2.0)
    drive.shock(slice(0, 400), 1.0)
    results, _ = drive.fused()
    error = rates(results) - drive.truth - drive.bias.mean(axis=1)
    assert np.abs(error).max() < NOISE


@pytest.mark.parametrize("sensors", [1, 2, 3, 5, 150])
@pytest.mark.parametrize("fault", FAULTS)
def test_the_kernel_does_what_the_numpy_form_says(fault, sensors):
    if not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    drive = Drive(sensors, 40.0)
    fault(drive, slice(0, int(0.4 * sensors)))
    stated, numpy_form = fuse(drive.readings, fusion=robust.Robust(PARAMETERS))
    done, kernel_form = fuse(drive.readings, fusion=kernel.Robust(PARAMETERS))
    for a, b in zip(stated, done, strict=True):
        assert (a.active.tolist(), a.valid) == (b.active.tolist(), b.valid)
        for name in ("rate_b", "variance", "noise", "bias_walk"):
            x, y = getattr(a, name), getattr(b, name)
            # The rate is a sum of readings: what rounds is as large as they are.
            assert np.allclose(x, y, rtol=1e-12, atol=1e-12 * (name == "rate_b"), equal_nan=True)
    assert (numpy_form.health().state == kernel_form.health().state).all()
    assert (numpy_form.health().reason == kernel_form.health().reason).all()
    assert np.allclose(numpy_form.relative_bias, kernel_form.relative_bias, rtol=1e-9, atol=1e-14)
