"""The kernel's filter beside its statement in Python: the same drives, the same numbers."""

import math

import numpy as np
import pytest
from filters import DEFAULTS, fused
from msgspec import structs

from risaf_link.core import aiding, eskf, kernel
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import wrap

pytestmark = pytest.mark.skipif(
    not kernel.BUILT, reason="no kernel was built: that takes a C++ compiler"
)


OTHERS = structs.replace(DEFAULTS, common_noise=1e-4, turn_error=1e-3, gate=3.0, distrust=4.0)


def readings(seed, steps):
    """What a vehicle reads that stands, drives curves, shakes, and at times falls silent."""
    generator = np.random.default_rng(seed)
    forms = generator.uniform(0.1, 0.5, 3), generator.uniform(0.0, 6.0, 3)
    for step in range(steps):
        dt = float(generator.choice([0.01, 0.01, 0.01, 0.011, 0.05, 0.7]))
        moving = step % 4000 > 1500
        rate = moving * np.array([0.1, 0.1, 0.5]) * np.sin(forms[0] * step / 100 + forms[1])
        speed = moving * 12.0
        force = np.array([0.0, speed * rate[2], -GRAVITY]) + 0.05 * generator.normal(size=3)
        rate = rate + [0.003, -0.002, 0.001] + 0.002 * generator.normal(size=3)
        if generator.random() < 0.01:
            rate[generator.integers(3)] = math.nan
        if step % 5000 > 4500:
            force[:] = math.nan
        yield step, dt, rate, force, speed, generator


@pytest.mark.parametrize("seed", range(4))
def test_the_kernel_s_filter_is_that_of_the_python_form(seed):
    heading = HeadingParameters(offset_std=0.01)
    filters = [form.Eskf(DEFAULTS, heading) for form in (eskf, kernel)]
    aids = [form.Aiding(DEFAULTS) for form in (aiding, kernel)]
    yaw = 1.0
    for step, dt, rate, force, speed, generator in readings(seed, 8000):
        yaw = wrap(yaw + float(np.nan_to_num(rate[2])) * dt)
        corrections = []
        course = yaw + 0.02 * generator.normal() + (0.5 if step % 1000 > 900 else 0.0)
        for estimator, aid in zip(filters, aids, strict=True):
            if step == 4000:
                estimator.configure(OTHERS, HeadingParameters(offset_std=0.02, delay_std=0.2))
            estimator.predict(fused(rate, dt=dt), dt)
            made = list(aid.take(estimator, fused(rate, dt=dt), force, dt))
            if step % 20 == 0 and step % 3000 < 2000:
                estimator.set_latitude(0.5)
                made.append(estimator.compare_heading(wrap(course), 4e-4, 0.11, 3.0))
                made.append(estimator.correct_heading(wrap(course), 4e-4, 0.11, 3.0))
                aid.speed.hear(speed, 0.01, 0.11)
            if step % 2900 == 2899:
                made.append(estimator.reset_heading(wrap(course), 4e-4, 0.11, 3.0))
            corrections.append(made)
        for python, native in zip(*corrections, strict=True):
            if python is None:
                assert native is None
                continue
            assert (python.source, python.outcome) == (native.source, native.outcome)
            assert native.value == pytest.approx(python.value, rel=1e-9, abs=1e-12)
            assert native.variance == pytest.approx(python.variance, rel=1e-9)
        python, native = (estimator.state(0) for estimator in filters)
        assert np.abs(python.q_nb - native.q_nb).max() < 1e-9  # 8000 steps, a sixth with gaps
        std = np.sqrt(python.angle_covariance.diagonal())
        apart = (python.angle_covariance - native.angle_covariance) / np.outer(std, std)
        assert np.abs(apart).max() < 1e-9
        assert native.bias_std == pytest.approx(python.bias_std, rel=1e-9)
    deviation = np.sqrt(filters[0].covariance.diagonal())
    difference = (filters[0].covariance - filters[1].covariance) / np.outer(deviation, deviation)
    assert np.abs(difference).max() < 1e-11


@pytest.mark.parametrize("method", ["mean", "median", "risaf", "robust"])
@pytest.mark.parametrize("accelerometers", [0, 4])
def test_epochs_gone_ahead_of_are_those_of_a_block(method, accelerometers):
    generator = np.random.default_rng(1)
    parameters = FusionParameters(method=method), AttitudeParameters(), HeadingParameters()
    ahead, usual = Estimator(*parameters), Estimator(*parameters)
    for epochs in (7, 1, 30):
        dt = np.full(epochs, 0.01)
        rates_b = generator.normal(0.0, 0.1, (epochs, 5, 3))
        forces_b = generator.normal(0.0, 9.0, (epochs, accelerometers, 3))
        rows = [
            ahead.go_ahead(0.01, rates.tobytes() + forces.tobytes(), 5)
            for rates, forces in zip(rates_b, forces_b, strict=True)
        ]
        tracks = [each.advance(dt, rates_b, forces_b) for each in (ahead, usual)]
        assert b"".join(rows) == tracks[1][0].values.tobytes()
        assert tracks[0][0].values.tobytes() == tracks[1][0].values.tobytes()
        assert tracks[0][1].tolist() == tracks[1][1].tolist()


def test_a_block_that_is_not_what_was_gone_ahead_of_is_refused():
    estimator = Estimator(FusionParameters(), AttitudeParameters(), HeadingParameters())
    estimator.go_ahead(0.01, bytes(24 * 3), 3)
    with pytest.raises(ValueError, match="dt: found 2 epochs, expected the 1 gone ahead of"):
        estimator.advance(np.full(2, 0.01), np.zeros((2, 3, 3)), np.zeros((2, 0, 3)))


@pytest.mark.parametrize("size", [24 * 2, 24 * 3 + 8])
def test_readings_that_are_too_few_or_broken_are_refused(size):
    estimator = Estimator(FusionParameters(), AttitudeParameters(), HeadingParameters())
    with pytest.raises(ValueError, match="readings: "):
        estimator.go_ahead(0.01, bytes(size), 3)
