"""Fusion against eq. 5 to 8 written out sensor by sensor, and against NumPy's own statistics."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from risaf_link.core import fusion as numpy_forms
from risaf_link.core import kernel
from risaf_link.core.fusion import Epoch, FusionParameters, Mean, Median, quantiles

AGREEMENT = 1e-9  # rad/s
FUSIONS = {"risaf": numpy_forms.Risaf, "mean": Mean, "median": Median}
NUMPY = dict(FUSIONS)
KERNEL = {"risaf": kernel.Risaf, "mean": kernel.Mean, "median": kernel.Median}


@pytest.fixture(params=["numpy", "kernel"], autouse=True)
def _form(request, monkeypatch):
    """Run every test on both forms of the fusion."""
    if request.param == "kernel":
        if not kernel.BUILT:
            pytest.skip("no kernel was built: that takes a C++ compiler")
        for name, form in KERNEL.items():
            monkeypatch.setitem(FUSIONS, name, form)


# A coarse grid gives ties at the quantiles, as the counts of a real sensor do.
readings = st.integers(-5, 5).map(lambda count: np.float32(0.01) * count) | st.just(np.nan)


@st.composite
def recordings(draw):
    """A few epochs of 1 to 300 sensors, float32, (epochs, n, 3)."""
    epochs, sensors = draw(st.integers(1, 5)), draw(st.integers(1, 300))
    shape = (epochs, sensors, 3)
    return draw(arrays(np.float32, shape, elements=readings, fill=readings))


class Channel:
    """Eq. 5 to 8 for one axis, in plain loops."""

    def __init__(self, alpha, lower, upper):
        self.alpha, self.shares = alpha, (lower, upper)
        self.bias = {}

    def fuse(self, readings):
        """(rate, variance, active), of readings that are NaN where not valid."""
        valid = {i: float(u) for i, u in enumerate(readings) if not math.isnan(u)}
        if not valid:
            return math.nan, math.nan, 0
        mean = math.fsum(valid.values()) / len(valid)
        for i, u in valid.items():
            before = self.bias.get(i, 0.0)
            self.bias[i] = self.alpha * before + (1 - self.alpha) * (u - mean)  # eq. 5
        corrected = {i: u - self.bias[i] for i, u in valid.items()}
        lower, upper = np.quantile(list(corrected.values()), self.shares)
        active = [c for c in corrected.values() if lower <= c <= upper]  # eq. 6
        return mean_and_variance(active or list(corrected.values()))


def mean_and_variance(values):
    """Eq. 7 and 8."""
    if not values:
        return math.nan, math.nan, 0
    mean = math.fsum(values) / len(values)
    squares = math.fsum((value - mean) ** 2 for value in values)
    return mean, squares / (len(values) - 1) if len(values) > 1 else math.nan, len(values)


def fusion(method="risaf", **parameters):
    return FUSIONS[method](FusionParameters(method=method, **parameters))


def epoch(rates):
    return Epoch(0, 0.01, np.array(rates, dtype=float).reshape(-1, 3), np.zeros((0, 3)), 0)


def assert_fused(fused, expected):
    rate, variance, active = np.array(expected).T
    assert fused.rate_b == pytest.approx(rate, abs=AGREEMENT, rel=0, nan_ok=True)
    assert fused.variance == pytest.approx(variance, abs=AGREEMENT, rel=1e-9, nan_ok=True)
    assert fused.active.tolist() == active.tolist()


@given(recordings(), st.floats(0.5, 0.999), st.floats(0, 0.5), st.floats(0.5, 1))
def test_risaf_agrees_with_the_equations_ties_and_gaps_included(recording, alpha, lower, upper):
    risaf = fusion(alpha=alpha, lower_quantile=lower, upper_quantile=upper)
    channels = [Channel(alpha, lower, upper) for _ in range(3)]
    for rates in recording:
        expected = [channel.fuse(rates[:, i]) for i, channel in enumerate(channels)]
        assert_fused(risaf.fuse(epoch(rates)), expected)


@pytest.mark.parametrize("grid", [0.0, 0.001])
def test_risaf_agrees_with_the_equations_over_a_thousand_epochs(grid):
    generator = np.random.default_rng(7)
    risaf, channels = fusion(), [Channel(0.995, 0.20, 0.80) for _ in range(3)]
    bias = generator.normal(0, 0.003, (150, 3))
    for k in range(1000):
        truth = [0.02 * math.sin(k / 50), 0.0, 0.3]
        rates = truth + bias + generator.normal(0, 0.002, (150, 3))
        rates[generator.random((150, 3)) < 0.01] += 0.5
        rates[generator.random((150, 3)) < 0.01] = np.nan
        if grid:
            rates = np.round(rates / grid) * grid
        rates = rates.astype(np.float32)
        expected = [channel.fuse(rates[:, i]) for i, channel in enumerate(channels)]
        assert_fused(risaf.fuse(epoch(rates)), expected)
    tracked = [[channel.bias[i] for channel in channels] for i in range(150)]
    assert risaf.relative_bias == pytest.approx(np.array(tracked), abs=AGREEMENT)


@given(recordings())
def test_the_plain_mean_agrees_with_a_sum_and_the_sample_variance(recording):
    for rates in recording:
        valid = [[float(u) for u in column if not math.isnan(u)] for column in rates.T]
        assert_fused(fusion("mean").fuse(epoch(rates)), [mean_and_variance(v) for v in valid])


@given(recordings())
def test_the_median_agrees_with_numpys_and_its_variance_with_the_absolute_deviation(recording):
    for rates in recording:
        expected = []
        for column in rates.T.astype(float):
            values = column[~np.isnan(column)]
            median = np.median(values) if len(values) else math.nan
            spread = np.median(abs(values - median)) if len(values) > 1 else math.nan
            expected.append((median, (1.4826 * spread) ** 2, len(values)))
        assert_fused(fusion("median").fuse(epoch(rates)), expected)


@given(
    arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, max_side=40),
        elements=st.floats(-1e6, 1e6, width=32) | st.just(np.nan),
    ),
    st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_quantiles_are_numpys_to_the_last_bit(values, shares):
    found = quantiles(values, shares)
    empty = np.isnan(values).all(axis=1)
    assert np.isnan(found[:, empty]).all()
    expected = np.nanquantile(values[~empty], shares, axis=1)
    assert (found[:, ~empty] == expected).all()


def test_quantiles_of_many_sizes_are_numpys_to_the_last_bit():
    generator = np.random.default_rng(11)
    for n in range(1, 301):
        values, shares = generator.normal(size=(3, n)), tuple(generator.random(4))
        values[generator.random((3, n)) < 0.05] = np.nan
        values[:, 0] = 0.1
        assert (quantiles(values, shares) == np.nanquantile(values, shares, axis=1)).all()


def test_quantiles_of_nothing_are_not_there():
    assert np.isnan(quantiles(np.zeros((3, 0)), (0.2, 0.8))).all()


@pytest.mark.parametrize("method", FUSIONS)
def test_one_sensor_is_passed_on_without_a_variance(method):
    fused = fusion(method).fuse(epoch([[0.1, -0.2, 0.3]]))
    assert fused.rate_b == pytest.approx([0.1, -0.2, 0.3])
    assert np.isnan(fused.variance).all()
    assert (fused.active.tolist(), fused.valid) == ([1, 1, 1], 1)


@pytest.mark.parametrize("method", FUSIONS)
def test_two_sensors_are_averaged(method):
    fused = fusion(method).fuse(epoch([[0.1, 0, 0.5], [0.3, 0, np.nan]]))
    assert fused.rate_b == pytest.approx([0.2, 0.0, 0.5])
    assert fused.active.tolist() == [2, 2, 1]
    assert np.isnan(fused.variance).tolist() == [False, False, True]
    assert fused.valid == 1


def test_of_three_sensors_risaf_takes_the_middle_one():
    fused = fusion().fuse(epoch([[0, 0, 0], [0.1, 0.1, 0.1], [9, 9, 9]]))
    assert fused.active.tolist() == [1, 1, 1]
    assert fused.rate_b == pytest.approx(0.1 - 0.005 * (0.1 - 9.1 / 3))


@pytest.mark.parametrize("method", FUSIONS)
@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf])
def test_an_axis_without_a_finite_reading_has_no_rate_and_spoils_no_other(method, nothing):
    sensors = fusion(method)
    sensors.fuse(epoch(np.zeros((4, 3))))
    fused = sensors.fuse(epoch([[0.1, nothing, 0.2]] * 4))
    assert np.isnan(fused.rate_b).tolist() == [False, True, False]
    assert np.isnan(fused.variance[1])
    assert (fused.active.tolist(), fused.valid) == ([4, 0, 4], 0)
    assert fusion(method).fuse(epoch([[0.1, 0.1, 0.1]] * 4)).rate_b == pytest.approx(0.1)


@pytest.mark.parametrize("method", FUSIONS)
def test_an_array_without_sensors_has_no_rate(method):
    fused = fusion(method).fuse(epoch([]))
    assert np.isnan(fused.rate_b).all()
    assert (fused.active.tolist(), fused.valid) == ([0, 0, 0], 0)


def test_a_silent_sensors_relative_bias_waits_for_its_return():
    risaf, steady = fusion(alpha=0.5), np.zeros((5, 3))
    steady[0] = 0.1
    for _ in range(20):
        risaf.fuse(epoch(steady))
    held = risaf.relative_bias[0].copy()
    assert held == pytest.approx(0.08, abs=1e-4)
    silent = steady.copy()
    silent[0] = np.nan
    for _ in range(20):
        risaf.fuse(epoch(silent))
    assert (risaf.relative_bias[0] == held).all()
    assert risaf.fuse(epoch(steady)).variance.max() < 1e-8


def test_sensors_that_are_added_start_without_a_bias_and_those_that_go_are_forgotten():
    risaf, rates = fusion(alpha=0.5), np.arange(12.0).reshape(4, 3) ** 2
    risaf.fuse(epoch(rates))
    kept = risaf.relative_bias[:2].copy()
    risaf.fuse(epoch(np.full((2, 3), np.nan)))
    assert (risaf.relative_bias == kept).all()
    risaf.fuse(epoch(np.full((4, 3), np.nan)))
    assert (risaf.relative_bias[:2] == kept).all()
    assert (risaf.relative_bias[2:] == 0).all()


def test_risaf_and_the_median_do_not_follow_bursts_of_a_sixth_of_the_sensors():
    rates = np.random.default_rng(3).normal(0, 0.002, (600, 150, 3))
    rates[::2, :25] += 1.0
    jitter = {}
    for method in FUSIONS:
        sensors = fusion(method)
        fused = [sensors.fuse(epoch(r)).rate_b for r in rates]
        jitter[method] = np.diff(fused[300:], axis=0).std()
    assert jitter["mean"] > 0.1
    assert jitter["median"] < 0.001
    assert jitter["risaf"] < 0.002


def test_the_fused_variance_is_that_of_one_sensor_not_of_their_mean():
    generator = np.random.default_rng(5)
    rates = generator.normal(0, 0.01, (300, 3))
    for method in ("mean", "median"):
        variance = fusion(method).fuse(epoch(rates)).variance
        assert np.sqrt(variance) == pytest.approx(0.01, rel=0.2)


def normal(generator, n):
    return generator.normal(0.0, 1e-3, (n, 3))


def leaping(generator, n):
    return normal(generator, n) + generator.choice([-40.0, -0.1, 0.02, 5.0])


def heavy_tailed(generator, n):
    return 1e-3 * generator.standard_cauchy((n, 3))


def rising(generator, n):
    return np.sort(normal(generator, n), axis=0)


def falling(generator, n):
    return -rising(generator, n)


def one_sided(generator, n):
    return np.where(np.arange(n)[:, np.newaxis] < n // 2, 30.0, normal(generator, n))


def constant(generator, n):
    return np.full((n, 3), generator.choice([0.0, 0.1, -1e-300]))


def neighbouring(generator, n):
    return 0.1 + np.spacing(0.1) * generator.integers(-3, 4, (n, 3))


def counted(generator, n):
    return np.rint(generator.normal(0.0, 2.0, (n, 3))) * 1e-3


def gappy(generator, n):
    return np.where(generator.random((n, 3)) < 0.4, np.nan, normal(generator, n))


CONTINUOUS = [normal, leaping, heavy_tailed, rising, falling, one_sided, gappy]
COARSE = [constant, neighbouring, counted]


def sequences(kinds):
    """Epochs of different kinds in any order, and their number of sensors, which may change."""
    return st.lists(
        st.tuples(st.sampled_from(kinds), st.sampled_from([1, 2, 3, 7, 8, 9, 150, 1000])),
        min_size=1,
        max_size=12,
    )


@given(sequences(CONTINUOUS + COARSE), st.integers(0, 99))
def test_the_median_is_numpys_to_the_last_bit_whatever_came_before(sequence, seed):
    generator, median = np.random.default_rng(seed), fusion("median")
    for kind, n in sequence:
        rates = kind(generator, n)
        rates[0] = 0.05
        assert (median.fuse(epoch(rates)).rate_b == np.nanquantile(rates, 0.5, axis=0)).all()


@pytest.mark.parametrize("kind", CONTINUOUS + COARSE)
def test_the_median_of_every_number_of_sensors_is_numpys_to_the_last_bit(kind):
    generator, median = np.random.default_rng(3), fusion("median")
    for n in range(1, 300):
        rates = kind(generator, n)
        rates[0] = 0.0
        assert (median.fuse(epoch(rates)).rate_b == np.nanquantile(rates, 0.5, axis=0)).all()


@pytest.mark.parametrize("method", FUSIONS)
@given(sequence=sequences(CONTINUOUS), lower=st.floats(0, 0.5), seed=st.integers(0, 99))
def test_the_kernel_does_what_the_numpy_form_says(method, sequence, lower, seed):
    if not kernel.BUILT:
        pytest.skip("no kernel was built: that takes a C++ compiler")
    parameters = FusionParameters(lower_quantile=lower, upper_quantile=1.0 - lower / 2)
    stated, done = NUMPY[method](parameters), KERNEL[method](parameters)
    generator, largest = np.random.default_rng(seed), 0.0
    for kind, n in sequence:
        rates = kind(generator, n)
        a, b = stated.fuse(epoch(rates)), done.fuse(epoch(rates))
        assert (a.active.tolist(), a.valid) == (b.active.tolist(), b.valid)
        # What rounds is as large as the readings have been: relative biases remember them.
        largest = np.nanmax(np.abs(rates), initial=largest)
        sizes = {"rate_b": largest, "variance": largest**2, "noise": largest**2, "bias_walk": 0.0}
        for name, size in sizes.items():
            x, y = getattr(a, name), getattr(b, name)
            assert np.allclose(x, y, rtol=1e-12, atol=1e-12 * size, equal_nan=True)
        for name in ("state", "reason", "rejected"):
            assert (getattr(stated.health(), name) == getattr(done.health(), name)).all()
