"""Quaternions and angles against Hamilton's table and elementary matrices."""

import math

import numpy as np
import pytest
from hamilton import euler_matrix, product, turned
from hypothesis import assume, given
from hypothesis import strategies as st

from risaf_link.core.rotation import (
    euler_from_quaternion,
    left_matrix,
    matrix_from_quaternion,
    quaternion_from_euler,
    rate_matrix,
    right_matrix,
    wrap,
    yaw_of,
)

numbers = st.floats(-2, 2)
quaternions = st.tuples(numbers, numbers, numbers, numbers).map(np.array)
rates = st.tuples(numbers, numbers, numbers).map(np.array)
angles = st.floats(-1e6, 1e6)
turns = st.floats(-math.pi, math.pi)
slopes = st.floats(-1.5, 1.5)


@st.composite
def attitudes(draw):
    q = draw(quaternions)
    assume(np.linalg.norm(q) > 0.1)
    return q / np.linalg.norm(q)


@given(angles)
def test_a_wrapped_angle_points_the_same_way_and_lies_within_half_a_turn(angle):
    wrapped = wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)
    assert math.sin(wrapped - angle) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-3.14, 3.14))
def test_an_angle_that_is_in_range_is_not_touched_by_wrapping(angle):
    assert wrap(angle) == angle


@pytest.mark.parametrize("turns_more", [0, 1, -1, 5])
def test_half_a_turn_is_positive_from_either_side(turns_more):
    assert wrap(math.pi + turns_more * math.tau) == pytest.approx(math.pi)
    assert wrap(math.pi) == wrap(-math.pi) == math.pi
    assert -math.pi < wrap(math.nextafter(math.pi, 4)) < -3.14
    assert wrap(math.nextafter(-math.pi, 0)) < -3.14


def test_no_angle_stays_none_and_an_infinite_one_is_refused():
    assert math.isnan(wrap(math.nan))
    with pytest.raises(ValueError, match="domain"):
        wrap(math.inf)


@given(quaternions, quaternions)
def test_left_and_right_matrix_multiply_as_hamiltons_table_does(p, q):
    expected = pytest.approx(product(p, q), abs=1e-12)
    assert left_matrix(p) @ q == expected
    assert right_matrix(q) @ p == expected


@given(rates, quaternions)
def test_the_rate_matrix_multiplies_by_the_rate_from_the_right_and_is_skew(rate, q):
    omega = rate_matrix(rate)
    assert omega @ q == pytest.approx(product(q, [0.0, *rate]), abs=1e-12)
    assert (omega == -omega.T).all()


@given(attitudes(), rates)
def test_the_matrix_turns_a_vector_as_the_quaternion_does(q, vector):
    matrix = matrix_from_quaternion(q)
    assert matrix @ vector == pytest.approx(turned(q, vector), abs=1e-12)
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_many_quaternions_become_matrices_at_once():
    stack = np.random.default_rng(1).normal(size=(2, 5, 4))
    stack /= np.linalg.norm(stack, axis=-1, keepdims=True)
    matrices = matrix_from_quaternion(stack)
    assert matrices.shape == (2, 5, 3, 3)
    assert (matrices[1, 3] == matrix_from_quaternion(stack[1, 3])).all()


@given(turns, slopes, turns)
def test_euler_angles_make_the_quaternion_of_yaw_then_pitch_then_roll(roll, pitch, yaw):
    matrix = matrix_from_quaternion(quaternion_from_euler(roll, pitch, yaw))
    assert matrix == pytest.approx(euler_matrix(roll, pitch, yaw), abs=1e-12)


@given(attitudes())
def test_the_euler_angles_of_an_attitude_make_the_same_attitude(q):
    assume(abs(q[0] * q[2] - q[1] * q[3]) < 0.4999)
    roll, pitch, yaw = euler_from_quaternion(q)
    assert matrix_from_quaternion(q) == pytest.approx(euler_matrix(roll, pitch, yaw), abs=1e-6)
    assert yaw_of(q) == yaw


@given(attitudes(), st.floats(1e-3, 1e3))
def test_yaw_does_not_depend_on_the_quaternions_length_or_sign(q, length):
    assume(abs(q[0] * q[2] - q[1] * q[3]) < 0.499)
    assert math.cos(yaw_of(length * q) - yaw_of(q)) == pytest.approx(1.0)
    assert math.cos(yaw_of(-q) - yaw_of(q)) == pytest.approx(1.0)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_at_gimbal_lock_the_angles_are_finite(pitch):
    angles = euler_from_quaternion(quaternion_from_euler(0.3, pitch, -1.0))
    assert np.isfinite(angles).all()
    assert angles[1] == pytest.approx(pitch, abs=1e-7)
