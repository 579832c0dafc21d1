"""Calibration against arrays whose errors are known, in the gauge that it promises."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from risaf_link.core.calibration import Calibrated, calibrate
from risaf_link.core.mounting import Readings
from risaf_link.core.rotation import matrix_from_quaternion

RATE = 100.0  # Hz
UPSIDE_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MAKING = np.radians(1.0)  # rad/s, standard deviation of biases


@dataclass
class Array:
    """A simulated array that rests, and then is turned about in all directions."""

    seed: int
    sensors: int = 8
    rest: float = 8.0
    moving: float = 12.0
    amplitude: tuple[float, float, float] = (40.0, 40.0, 40.0)  # deg/s RMS
    noise: float = 0.2  # deg/s
    late: float = 0.0  # s, most that a sensor samples early or late
    off: float = 0.01  # of scale and misalignment

    def __post_init__(self):
        random = np.random.default_rng(self.seed)
        self.random, n = random, self.sensors
        self.mounting = np.tile(np.eye(3), (n, 1, 1))
        self.matrix = np.eye(3) + self.off * random.standard_normal((n, 3, 3))
        self.bias = MAKING * random.standard_normal((n, 3))
        self.time_s = np.arange(round((self.rest + self.moving) * RATE)) / RATE

    def mount(self, rotation, which):
        self.mounting[which] = rotation
        return self

    def read(self):
        """Readings (k, n, 3): w = matrix @ mounting @ (u - bias)."""
        k, n = len(self.time_s), self.sensors
        late = self.late * self.random.uniform(-1.0, 1.0, (k, n))
        seen_s = np.maximum(self.time_s[:, None] + late - self.rest, 0.0)
        rate = np.zeros((k, n, 3))
        for axis, frequency in np.ndindex(3, 4):
            hertz = (0.13, 0.41, 0.77, 1.3)[frequency] * self.random.uniform(0.8, 1.2)
            phase = self.random.uniform(0.0, np.pi)
            swing = np.sin(2 * np.pi * hertz * seen_s + phase) - np.sin(phase)
            rate[:, :, axis] += np.radians(self.amplitude[axis]) / np.sqrt(2) * swing
        rate[self.time_s < self.rest] = 0.0
        backward = np.linalg.inv(self.matrix @ self.mounting)
        noise = np.radians(self.noise) * self.random.standard_normal((k, n, 3))
        return np.einsum("nij,knj->kni", backward, rate) + self.bias + noise

    def truth(self, axes):
        """The matrices in the gauge: their mean stretch is none, and that of `axes` no turn."""
        matrix = self.matrix @ self.mounting
        _, stretch = polar(matrix)
        matrix = np.linalg.inv(stretch.mean(axis=0)) @ matrix
        return polar(matrix[axes].mean(axis=0))[0].T @ matrix


def polar(matrix):
    """Rotation and, from the left, symmetric part."""
    u, s, v = np.linalg.svd(matrix)
    return u @ v, u * s[..., None, :] @ np.swapaxes(u, -1, -2)


def shape(found: Calibrated):
    """M diag(scale), (n, 3, 3)."""
    shape = np.tile(np.eye(3), (len(found.bias), 1, 1))
    shape[:, ~np.eye(3, dtype=bool)] = found.misalignment
    return shape * found.scale[:, None, :]


def matrices(found: Calibrated):
    return matrix_from_quaternion(found.mounting) @ shape(found)


def scores(found, true):
    """Error over deviation of scale, misalignment and mounting, (n, 12)."""
    rotation, _ = polar(true)
    stretch = np.swapaxes(rotation, 1, 2) @ true
    scale = np.einsum("nii->ni", stretch)
    misalignment = (stretch / scale[:, None, :])[:, ~np.eye(3, dtype=bool)]
    turned = matrix_from_quaternion(found.mounting) @ np.swapaxes(rotation, 1, 2)
    return np.concatenate(
        [
            (found.scale - scale) / found.scale_std,
            (found.misalignment - misalignment) / found.misalignment_std,
            Rotation.from_matrix(turned).as_rotvec() / found.mounting_std,
        ],
        axis=1,
    )


EVEN, ALL = np.arange(0, 8, 2), np.arange(8)


@pytest.mark.parametrize(
    "case",
    [{}, {"late": 0.002}, {"rest": 3.0, "moving": 6.0}, {"rest": 0.0}],
    ids=["sound", "sampled by clocks of their own", "short", "without rest"],
)
def test_errors_are_as_large_as_the_deviations_say(case):
    squares = []
    for seed in range(8):
        array = Array(seed, **case).mount(UPSIDE_DOWN, slice(1, None, 2))
        found = calibrate(Readings(array.time_s, array.read()))
        assert found.determined.all()
        squares.append(scores(found, array.truth(EVEN)) ** 2)
    # 8 seeds of 8 sensors of 12 numbers, not quite independent: 1 within a quarter, in RMS
    assert 0.75 < np.sqrt(np.mean(squares)) < 1.25
    assert np.max(squares) < 5.5**2


def test_bias_is_the_mean_at_rest_within_its_deviation():
    squares = []
    for seed in range(8):
        array = Array(seed, moving=6.0)
        found = calibrate(Readings(array.time_s, array.read()))
        assert found.rest == pytest.approx(array.rest, abs=1.0)
        squares.append(((found.bias - array.bias) / found.bias_std) ** 2)
    assert 0.8 < np.sqrt(np.mean(squares)) < 1.2


def test_without_rest_biases_are_relative_and_their_mean_in_the_body_is_zero():
    array = Array(4, rest=0.0).mount(UPSIDE_DOWN, slice(1, None, 2))
    found = calibrate(Readings(array.time_s, array.read()))
    assert found.rest == 0.0
    true = array.truth(EVEN)
    offset = np.einsum("nij,nj->ni", true, found.bias - array.bias)
    np.testing.assert_allclose(offset - offset.mean(axis=0), 0.0, atol=5 * found.bias_std.max())
    in_body = np.einsum("nij,nj->ni", matrices(found), found.bias)
    np.testing.assert_allclose(in_body.mean(axis=0), 0.0, atol=1e-3 * MAKING)


def test_an_array_mounted_alike_keeps_its_axes_and_its_scale_on_the_average():
    array = Array(5)
    found = calibrate(Readings(array.time_s, array.read()))
    np.testing.assert_allclose(matrices(found).mean(axis=0), np.eye(3), atol=1e-4)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.integers(5, 12))
def test_any_mounting_is_found_and_most_sensors_say_what_the_axes_are(seed, sensors):
    array = Array(seed, sensors=sensors, moving=8.0)
    odd = array.random.choice(sensors, (sensors - 1) // 2, replace=False)
    array.mount(Rotation.random(len(odd), random_state=seed % 1000).as_matrix(), odd)
    found = calibrate(Readings(array.time_s, array.read()))
    apart = polar(matrices(found))[0] @ np.swapaxes(array.mounting, 1, 2)
    turns = Rotation.from_matrix(apart).magnitude()
    assert turns.max() < np.radians(6.0)  # misalignment of some 0.6 deg


def test_mountings_that_are_known_say_what_the_axes_are():
    known = Rotation.from_euler("xyz", [[0, 0, 90.0 * (i % 4)] for i in range(8)], degrees=True)
    array = Array(6).mount(known.as_matrix(), slice(None))
    found = calibrate(Readings(array.time_s, array.read()), known.as_matrix())
    body = matrices(found) @ np.swapaxes(known.as_matrix(), 1, 2)
    np.testing.assert_allclose(body.mean(axis=0), np.eye(3), atol=1e-4)


def test_dead_frozen_and_spiky_sensors_neither_spoil_the_others_nor_pass_for_good():
    array = Array(7, sensors=12)
    read = array.read()
    read[:, 1] = np.nan
    read[:, 2] = read[0, 2]
    read[len(read) // 3 :, 3] = read[0, 3]
    spikes = array.random.random(read.shape) < 0.02
    spikes[:, 6:] = False
    read[spikes] += np.radians(300.0)
    read[array.random.random(read.shape) < 0.01] = np.nan
    found = calibrate(Readings(array.time_s, read))
    broken = np.isin(np.arange(12), [1, 2, 3])
    np.testing.assert_array_equal(found.determined, ~broken)
    sound = np.flatnonzero(~broken)
    # The broken ones have a say in the gauge: compare what does not depend on it.
    one, true = matrices(found)[sound], (array.matrix @ array.mounting)[sound]
    relative = np.linalg.inv(one[0]) @ one - np.linalg.inv(true[0]) @ true
    assert np.abs(relative).max() < 6 * found.axis_std[sound].max()
    np.testing.assert_allclose(matrices(found)[1], np.eye(3), atol=1e-12)


def test_what_it_gains_is_judged_where_it_did_not_learn():
    array = Array(8, sensors=20)
    found = calibrate(Readings(array.time_s, array.read()))
    assert np.degrees(found.after.array) == pytest.approx(array.noise, rel=0.03)
    expected = np.hypot(MAKING, 0.01 * np.radians(np.sqrt(3) * 57.0))
    assert found.before.array == pytest.approx(expected, rel=0.35)
    assert (found.after.sensors < found.before.sensors).all()


@pytest.mark.parametrize("axis", range(3))
def test_an_axis_that_was_not_turned_about_is_not_determined(axis):
    amplitude = [40.0, 40.0, 40.0]
    amplitude[axis] = 0.0
    array = Array(9, amplitude=tuple(amplitude))
    found = calibrate(Readings(array.time_s, array.read()))
    np.testing.assert_array_equal(found.typical_std > 0.005, np.arange(3) == axis)


def test_a_log_of_nothing_but_rest_is_refused():
    array = Array(11, moving=0.0)
    with pytest.raises(ValueError, match="found the array at rest throughout"):
        calibrate(Readings(array.time_s, array.read()))


def test_two_sensors_are_refused():
    array = Array(10, sensors=2)
    with pytest.raises(ValueError, match="found 2 gyros, expected 3 or more"):
        calibrate(Readings(array.time_s, array.read()))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.9))
def test_whatever_is_read_gives_finite_numbers_or_is_refused(seed, missing):
    random = np.random.default_rng(seed)
    read = random.standard_normal((random.integers(2, 300), random.integers(3, 7), 3))
    read[random.random(read.shape) < missing] = np.nan
    try:
        found = calibrate(Readings(np.arange(len(read)) / RATE, read))
    except ValueError as refusal:
        assert str(refusal).startswith("found ")  # noqa: PT017 it may be refused, or not
    else:
        assert np.isfinite(matrices(found)).all()
        assert np.isfinite(found.bias).all()
