"""A filter as tests begin with it, and its errors."""

import math

import numpy as np

from risaf_link.core import aiding, eskf, kernel, robust
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.error_state import Gravity
from risaf_link.core.eskf import Eskf
from risaf_link.core.fusion import FusedRate, FusionParameters
from risaf_link.core.rotation import matrix_from_quaternion

FORMS = {
    "numpy": (robust.Robust, eskf.Eskf, aiding.Aiding, aiding.SpeedTracker),
    "kernel": (kernel.Robust, kernel.Eskf, kernel.Aiding, kernel.SpeedTracker),
}
"""What tests of the filter are run on, one form after the other: fixture `filter_form`."""

DEFAULTS = AttitudeParameters()
SENSORS = FusionParameters()
UNKNOWN = np.full(3, np.nan)
DOWN = np.array([0.0, 0.0, GRAVITY])
DT = 0.01
GATE = 3.0


def fused(rate_b, noise=UNKNOWN, sensors=1, dt=DT):
    """What a fusion makes of sensors of the default parameters; `noise` where it is told."""
    rate_b = np.asarray(rate_b, dtype=float)
    noise = np.where(np.isnan(noise), SENSORS.gyro_noise**2 / dt / sensors, noise)
    walk = np.full(3, SENSORS.bias_walk / math.sqrt(sensors))
    return FusedRate(0, rate_b, UNKNOWN, np.full(3, sensors), sensors, noise, walk)


def level_filter(parameters=DEFAULTS):
    """A filter that knows the tilt, not yet yaw."""
    estimator = Eskf(parameters)
    estimator.predict(fused(np.zeros(3)), DT)
    estimator.correct_gravity(Gravity(DOWN, 1e-4, 1e-4))
    return estimator


def aligned_filter(yaw=0.0, std=0.02, parameters=DEFAULTS):
    estimator = level_filter(parameters)
    estimator.correct_heading(yaw, std**2, 0.0, GATE)
    return estimator


def run(estimator, seconds, rate_b=(0.0, 0.0, 0.0), dt=DT):
    for _ in range(round(seconds / dt)):
        estimator.predict(fused(rate_b, dt=dt), dt)


def degrees_between(p_nb, q_nb):
    turned = np.trace(matrix_from_quaternion(p_nb).T @ matrix_from_quaternion(q_nb))
    return math.degrees(math.acos(min(1.0, max(-1.0, (turned - 1.0) / 2.0))))


def tilt_error(estimator, truth_nb):
    """Angle between the estimated vertical and the true one, deg."""
    down = estimator.matrix[2] @ matrix_from_quaternion(truth_nb)[2]
    return math.degrees(math.acos(min(1.0, down)))


def assert_sound(estimator):
    covariance = estimator.covariance
    deviation = np.sqrt(covariance.diagonal())
    assert np.isfinite(covariance).all()
    assert (covariance == covariance.T).all()
    assert np.linalg.eigvalsh(covariance / np.outer(deviation, deviation)).min() > -1e-9
    assert np.isfinite(estimator.state(0).q_nb).all()
    assert abs(np.linalg.norm(estimator.state(0).q_nb) - 1.0) < 1e-12


def settled_filter():
    estimator = aligned_filter()
    for _ in range(25):
        run(estimator, 0.2)
        estimator.correct_heading(0.0, 0.02**2, 0.0, GATE)
        estimator.correct_zero_rate(np.zeros(3), np.full(3, 1e-8), confirmed=True)
    return estimator
