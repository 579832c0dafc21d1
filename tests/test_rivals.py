"""The methods that ours is compared with, against closed forms and each other's limits."""

import math

import numpy as np
import pytest

from risaf_link.core.attitude import AttitudeParameters, PaperFilter
from risaf_link.core.fusion import Epoch, FusionParameters, Mean
from risaf_link.core.heading import Heading, HeadingParameters, HeadingSource, Motion
from risaf_link.errors import ConfigError
from risaf_link.experiments.case import Case, scenario_of
from risaf_link.experiments.catalogue import METHODS, make, read_own
from risaf_link.experiments.central import RATE, Centralised, Compact, Direct
from risaf_link.experiments.gyro_filters import Integration, MeanEkf, SingleEkf, Virtual
from risaf_link.experiments.inputs import array_model, instants
from risaf_link.experiments.method import Aided, ArrayModel, Gps, HeadingGate
from risaf_link.experiments.particles import Particles
from risaf_link.experiments.robust_filters import Correntropy, Huber, Variational
from risaf_link.experiments.so3 import exp, exps, logs
from risaf_link.experiments.unscented import Unscented

ARRAY = ArrayModel(sensors=10, rate=100.0, noise=2e-3, bias=0.0, bias_walk=5e-5)
DT = 0.01
HEADING_STD = 0.02


def gps(heading, std=HEADING_STD):
    measured = Heading(heading, std**2, HeadingSource.VELOCITY)
    return Gps(Motion(10.0, measured), 0.5, 0.0)


def drive(method, rates, truth, heading_every=20, seed=0, std=HEADING_STD):
    """Feed a level vehicle that turns: rates (k, n, 3), true yaw (k,); the estimates."""
    random = np.random.default_rng(seed)
    estimates = []
    for k, readings in enumerate(rates):
        method.step(Epoch(k * 10_000, DT if k else 0.0, readings, np.zeros((0, 3)), 0))
        if k % heading_every == 0:
            method.correct(gps(truth[k] + std * random.standard_normal(), std))
        estimates.append(method.estimate())
    return np.array(estimates)


def turning(epochs, sensors=10, noise=2e-3, bias=0.0, seed=1):
    """Readings of a level vehicle whose yaw rate swings, and its yaw."""
    random = np.random.default_rng(seed)
    rate = 0.3 * np.sin(np.arange(epochs) * DT)
    rates = noise * random.standard_normal((epochs, sensors, 3)) + bias
    rates[:, :, 2] += rate[:, None]
    yaw = np.cumsum(np.concatenate([[0.0], rate[1:]])) * DT
    return rates, yaw


def difference(a, b):
    return np.abs((a[:, 0] - b[:, 0] + math.pi) % (2 * math.pi) - math.pi).max()


def test_rotations_and_their_vectors_are_inverse():
    vectors = np.random.default_rng(0).normal(size=(50, 3)) * np.logspace(-9, -0.2, 50)[:, None]
    np.testing.assert_allclose(logs(exps(vectors)), vectors, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(exps(vectors)[3], exp(vectors[3]), atol=1e-15)


def test_the_compact_update_is_that_of_the_textbook():
    random = np.random.default_rng(0)
    root = random.normal(size=(9, 9)) * 0.01
    covariance = root @ root.T + 1e-6 * np.eye(9)
    offset = random.normal(size=(3, 40))
    information = random.uniform(0, 1e4, (3, 40)) * (random.random((3, 40)) < 0.8)
    expected, expected_covariance = Direct.update(covariance, offset, information)
    change, updated = Compact.update(covariance, offset, information)
    np.testing.assert_allclose(change, expected, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(updated, expected_covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        Compact.change(covariance, offset, information), expected, rtol=1e-6, atol=1e-10
    )
    np.testing.assert_allclose(
        Direct.change(covariance, offset, information), expected, rtol=1e-6, atol=1e-10
    )


@pytest.mark.parametrize("name", [name for name, entry in METHODS.items() if entry.direct])
def test_both_forms_of_a_method_give_the_same_heading(name):
    rates, yaw = turning(300)
    rates[100, 3] = np.nan
    results = [
        drive(make(f"{name}:form={form}", ARRAY, {}), rates, yaw) for form in ("compact", "direct")
    ]
    assert difference(*results) < 1e-7


def test_all_readings_together_are_worth_their_mean():
    """Of n alike sensors: the same as one that reads their mean, with an n-th of the variance."""
    rates, yaw = turning(2000)
    one = ArrayModel(1, 100.0, ARRAY.noise / math.sqrt(10), 0.0, 5e-5)
    many = drive(Centralised(ARRAY), rates, yaw)
    mean = drive(Centralised(one), rates.mean(axis=1, keepdims=True), yaw)
    assert difference(many, mean) < 1e-9
    np.testing.assert_allclose(many[:, 1], mean[:, 1], rtol=1e-9)


def test_the_centralised_filter_is_the_papers_on_the_mean():
    """As long as the rate may change at will; its noise is then that of the mean."""
    rates, yaw = turning(4000)
    parameters = AttitudeParameters(initial_bias_std=5e-4)
    filtered = Centralised(ARRAY)

    class OfMean(Aided):
        def __init__(self):
            super().__init__()
            self.attitude = PaperFilter(parameters)
            self.fusion = Mean(FusionParameters(method="mean"))
            self.headings = HeadingGate(HeadingParameters())

        def step(self, epoch):
            fused = self.fusion.fuse(epoch)
            fused.variance[:] = ARRAY.noise**2 / 10
            self.headings.advance(epoch.dt)
            self.advance(fused, epoch.dt)

        def correct(self, gps):
            self.headings.take(self.attitude, gps)

    late = slice(1001, None, 20)  # epochs after which there was no heading
    apart = difference(drive(filtered, rates, yaw)[late], drive(OfMean(), rates, yaw)[late])
    assert apart < 2e-4  # rad; the heading's standard deviation is a hundred times that


def test_a_bias_of_all_sensors_is_found_by_headings():
    bias = 4e-4
    rates, yaw = turning(20_000, bias=bias)
    for method in (Centralised(ARRAY), Particles(ARRAY)):
        estimates = drive(method, rates, yaw)
        assert abs(estimates[-1, 2] - bias) < 1.5e-4
        assert abs(estimates[-1, 0] - yaw[-1]) < 0.02


@pytest.mark.parametrize(
    ("method", "tolerance"),
    [
        (lambda: Huber(ARRAY, threshold=math.inf), 1e-9),
        (lambda: Correntropy(ARRAY, width=1e6), 1e-7),
        (lambda: Variational(ARRAY, memory=1.0, shape=1e12), 1e-7),
        (lambda: Unscented(ARRAY, keep=math.inf, drop=math.inf), 1e-3),
    ],
    ids=["Huber", "correntropy", "variational", "unscented"],
)
def test_a_robust_filter_without_robustness_is_the_extended_kalman_filter(method, tolerance):
    rates, yaw = turning(1500)
    assert (
        difference(drive(method(), rates, yaw), drive(Centralised(ARRAY), rates, yaw)) < tolerance
    )


def test_hubers_weights_are_those_of_his_function():
    weights = Huber(ARRAY, threshold=1.5).weigh(np.array([[0.0, -1.5, 3.0, -15.0]]))
    np.testing.assert_allclose(weights, [[1.0, 1.0, 0.5, 0.1]])


def test_huber_finds_the_m_estimate_of_the_array():
    """The rate at which the sum of Huber's psi is zero; the prediction hardly counts."""
    scipy_optimize = pytest.importorskip("scipy.optimize")
    readings = np.random.default_rng(3).standard_t(2, (10, 3)) * 2e-3
    method = Huber(ARRAY, threshold=1.345)
    method.step(Epoch(0, 0.0, readings, np.zeros((0, 3)), 0))
    for axis in range(3):

        def score(rate, axis=axis):
            return np.clip((readings[:, axis] - rate) / ARRAY.noise, -1.345, 1.345).sum()

        assert abs(method.rate_b[axis] - scipy_optimize.brentq(score, -1, 1)) < 0.03 * ARRAY.noise


@pytest.mark.parametrize("name", ["huber", "mcc", "vb", "mmukf", "particles", "robust", "ours"])
def test_a_robust_method_outlives_a_wild_sensor_that_spoils_the_mean(name):
    rates, yaw = turning(1500)
    rates[500:, 0] += 0.3
    methods = (make(name, ARRAY, {}), make("mean", ARRAY, {}))
    robust, mean = (drive(method, rates, yaw, heading_every=10_000) for method in methods)
    assert np.abs(mean[-1, 0] - yaw[-1]) > 0.2
    assert np.abs(robust[-1, 0] - yaw[-1]) < 0.08


def test_a_variance_that_is_wrong_is_learnt():
    rates, yaw = turning(1000, noise=1e-2)
    method = Variational(ARRAY)
    drive(method, rates, yaw)
    learnt = np.sqrt(np.median(method._beta / method._alpha))
    assert learnt == pytest.approx(1e-2, rel=0.1)


def test_particles_follow_the_kalman_filter_where_all_is_linear_and_gaussian():
    rates, yaw = turning(3000, bias=3e-4)
    array = ArrayModel(10, 100.0, 2e-3, 0.0, 5e-5)
    particles, kalman = Particles(array, width=1e3, count=3000), Centralised(array)
    of_particles, of_kalman = drive(particles, rates, yaw), drive(kalman, rates, yaw)
    late = slice(1000, None)
    apart = np.abs(of_particles[late, 0] - of_kalman[late, 0])
    assert (apart < 0.35 * of_kalman[late, 1]).all()
    ratio = of_particles[late, 1] / of_kalman[late, 1]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


def test_particles_are_fused_at_the_mode_of_the_readings():
    readings = np.full((10, 3), 0.1)
    readings[:4] = 5.0
    np.testing.assert_allclose(Particles(ARRAY).fuse(readings), 0.1, atol=1e-9)


def test_the_mean_is_integrated_from_the_first_heading():
    rates, yaw = turning(1000, noise=0.0, bias=np.array([0.0, 0.0, 0.01]))
    estimates = drive(Integration(ARRAY), rates, yaw, heading_every=10_000, std=1e-9)
    expected = yaw + 0.01 * DT * np.arange(1000)
    assert estimates[-1, 0] == pytest.approx(expected[-1], abs=1e-6)


def test_one_sensor_is_filtered_as_if_it_were_the_array():
    rates, yaw = turning(1000)
    spoilt = rates.copy()
    spoilt[:, 1:] += 1.0
    np.testing.assert_array_equal(
        drive(SingleEkf(ARRAY), rates, yaw), drive(SingleEkf(ARRAY), spoilt, yaw)
    )


def test_the_virtual_sensor_is_the_mean_until_a_sensor_falls_silent():
    rates, yaw = turning(1000)
    rates[:, 0, 2] += 0.05
    array = ARRAY._replace(bias=0.05)
    virtual, mean = (drive(m(array), rates, yaw, 10_000) for m in (Virtual, MeanEkf))
    assert difference(virtual[1:], mean[1:]) < 1e-9
    rates[500:, 0] = np.nan
    virtual, mean = (drive(m(array), rates, yaw, 10_000) for m in (Virtual, MeanEkf))
    assert virtual[-1, 0] - virtual[499, 0] == pytest.approx(yaw[-1] - yaw[499] + 0.025, abs=2e-3)
    assert mean[-1, 0] - mean[499, 0] == pytest.approx(yaw[-1] - yaw[499], abs=2e-3)


def test_a_covariance_stays_one_in_a_real_drive():
    scenario = scenario_of(Case("drive2", 1, (), (), duration=20.0, sensors=12))
    methods = [make(name, array_model(scenario), {}) for name, e in METHODS.items() if e.direct]
    for instant in instants(scenario, HeadingParameters()):
        for method in methods:
            method.step(instant.epoch)
            for fix in instant.fixes:
                method.correct(fix)
    for method in methods:
        assert np.linalg.eigvalsh(method.covariance).min() > 0
        assert method.covariance[RATE, RATE].max() < 1.0


TRIMMED = """
import numpy as np
from risaf_link.experiments.method import Aided, one_rate


class Trimmed(Aided):
    def __init__(self, array, cut=2.0):
        super().__init__()
        self.cut, self.variance = int(cut), array.noise**2

    def step(self, epoch):
        kept = np.sort(epoch.rates_b, axis=0)[self.cut : -self.cut]
        self.advance(one_rate(epoch, kept.mean(axis=0), self.variance, len(kept)), epoch.dt)
"""


def test_a_method_of_ones_own_takes_a_file_of_a_dozen_lines(tmp_path):
    path = tmp_path / "trimmed.py"
    path.write_text(TRIMMED)
    name, source = read_own(path)
    method = make(f"{name}:cut=3", ARRAY, {name: source})
    assert method.cut == 3
    rates, yaw = turning(300)
    assert abs(drive(method, rates, yaw)[-1, 0] - yaw[-1]) < 0.03


@pytest.mark.parametrize(
    ("text", "told"),
    [("x = ", "SyntaxError"), ("import risaf_link", "expected a class"), ("1 / 0", "ZeroDivision")],
)
def test_a_file_that_holds_no_method_is_refused_in_one_line(tmp_path, text, told):
    path = tmp_path / "own.py"
    path.write_text(text)
    with pytest.raises(ConfigError, match=told):
        read_own(path)


def test_an_unknown_method_is_refused_with_those_that_are_known():
    with pytest.raises(ConfigError, match="'kalman', expected one of ours"):
        make("kalman", ARRAY, {})
