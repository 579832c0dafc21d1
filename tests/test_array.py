"""A calibration undoes what is wrong with a sensor, and is refused where it does not fit."""

import msgspec
import numpy as np
import pytest
from hamilton import rotation, turned

from risaf_link.core.array import ArrayCalibration, Calibration, TriadCalibration

UPSIDE_DOWN = [0.0, 1.0, 0.0, 0.0]
NONE = np.zeros((0, 3))


def calibration(*gyros, accels=(), name=""):
    return Calibration(ArrayCalibration(list(gyros), list(accels), name))


def random_triad(generator):
    return TriadCalibration(
        bias=generator.normal(0, 0.05, 3).tolist(),
        scale=generator.uniform(0.9, 1.1, 3).tolist(),
        misalignment=generator.normal(0, 0.02, 6).tolist(),
        mounting=(generator.uniform(0.5, 2) * rotation(generator.normal(0, 2, 3))).tolist(),
    )


def reading(triad, true_b):
    """What a sensor with these errors reads: the mounting, misalignment, scale, bias undone."""
    q_bs = np.array(triad.mounting) / np.linalg.norm(triad.mounting)
    true_s = turned(q_bs * [1, -1, -1, -1], true_b)
    xy, xz, yx, yz, zx, zy = triad.misalignment
    skewed = np.linalg.solve([[1, xy, xz], [yx, 1, yz], [zx, zy, 1]], true_s)
    return skewed / triad.scale + triad.bias


def test_bias_scale_misalignment_and_mounting_are_undone():
    generator = np.random.default_rng(1)
    gyros = [random_triad(generator) for _ in range(150)]
    accels = [random_triad(generator) for _ in range(40)]
    rate_b, force_b = generator.normal(0, 1, 3), generator.normal(0, 9, 3)
    rates_b, forces_b = calibration(*gyros, accels=accels).apply(
        np.array([reading(gyro, rate_b) for gyro in gyros]),
        np.array([reading(accel, force_b) for accel in accels]),
    )
    assert rates_b == pytest.approx(np.tile(rate_b, (150, 1)), abs=1e-12)
    assert forces_b == pytest.approx(np.tile(force_b, (40, 1)), abs=1e-12)


def test_without_any_entry_readings_stay_as_they_are():
    readings = np.arange(6.0).reshape(2, 3)
    rates_b, forces_b = calibration(TriadCalibration(), TriadCalibration()).apply(readings, NONE)
    assert (rates_b == readings).all()
    assert forces_b.shape == (0, 3)


def test_a_sensor_that_is_mounted_upside_down_turns_the_other_way():
    rates_b, _ = calibration(TriadCalibration(mounting=UPSIDE_DOWN)).apply(
        np.array([[0.1, 0.2, 0.3]]), NONE
    )
    assert rates_b.tolist() == [[0.1, -0.2, -0.3]]


def test_a_reading_that_is_not_valid_spoils_only_what_depends_on_it():
    turned_right = TriadCalibration(mounting=[1.0, 0.0, 0.0, 1.0])  # x to y, y to -x
    skewed = TriadCalibration(misalignment=[0.01, 0.0, 0.0, 0.0, 0.0, 0.0])  # x takes some of y
    rates_b, _ = calibration(TriadCalibration(), turned_right, skewed).apply(
        np.array([[np.nan, 1, 1], [np.nan, 1, 1], [1, np.nan, 1]]), NONE
    )
    assert np.isnan(rates_b).tolist() == [
        [True, False, False],
        [False, True, False],
        [True, True, False],
    ]


def test_fewer_sensors_than_are_calibrated_are_the_first_ones():
    gyros = [TriadCalibration(bias=[0.1 * i, 0, 0]) for i in range(5)]
    rates_b, _ = calibration(*gyros).apply(np.ones((3, 3)), NONE)
    assert rates_b[:, 0] == pytest.approx([1, 0.9, 0.8])


def test_accelerometers_without_a_calibration_stay_as_they_are():
    doubled = TriadCalibration(scale=[2.0, 2.0, 2.0])
    _, forces_b = calibration(TriadCalibration(), TriadCalibration(), accels=[doubled]).apply(
        np.zeros((2, 3)), np.ones((2, 3))
    )
    assert forces_b.tolist() == [[2, 2, 2], [1, 1, 1]]


def test_a_calibration_is_for_as_many_sensors_as_it_has_and_for_the_array_of_its_name():
    two = calibration(TriadCalibration(), TriadCalibration(), name="north")
    assert two.mismatch(2, "north") == two.mismatch(1, "north") == two.mismatch(2, "") == ""
    assert two.mismatch(3, "north") == "the calibration is for 2 sensors, the array has 3"
    assert two.mismatch(2, "south") == "the calibration is for array 'north', this is 'south'"
    assert calibration(TriadCalibration()).mismatch(1, "any") == ""


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ({"mounting": [0.0, 0.0, 0.0, 0.0]}, r"gyros\[1\].mounting: found .* expected"),
        ({"mounting": [1.0, 0.0, 0.0, np.nan]}, r"gyros\[1\].mounting: found .* expected"),
        ({"bias": [0.0, np.inf, 0.0]}, r"gyros\[1\].bias: found .* expected finite"),
        ({"scale": [1.0, np.nan, 1.0]}, r"gyros\[1\].scale: found .* expected finite"),
        ({"scale": [1.0, 0.0, 1.0]}, r"gyros\[1\].scale: found .* expected numbers other than 0"),
        ({"misalignment": [np.nan] * 6}, r"gyros\[1\].misalignment: found .* expected finite"),
    ],
)
def test_an_entry_that_makes_no_sense_is_refused_by_name(entry, complaint):
    with pytest.raises(ValueError, match=complaint):
        calibration(TriadCalibration(), TriadCalibration(**entry))


def test_more_accelerometers_than_gyros_are_refused():
    with pytest.raises(ValueError, match="accels: found 2, expected at most 1"):
        calibration(TriadCalibration(), accels=[TriadCalibration()] * 2)


@pytest.mark.parametrize(
    "content",
    [
        {"gyros": []},
        {"gyros": [{"bias": [0.0, 0.0]}]},
        {"gyros": [{"tilt": 1.0}]},
        {"gyros": [{"mounting": [1.0, 0.0, 0.0]}]},
    ],
)
def test_a_file_of_another_shape_is_refused(content):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(content, ArrayCalibration)
