"""The truth of a simulation is consistent physics."""

import math
from dataclasses import replace

import numpy as np
import pytest

from risaf_link.core.earth import EARTH_RATE, GRAVITY
from risaf_link.sim.trajectory import Circle, Place, sample_times

START = Place(math.radians(30.2217), math.radians(34.8012), 300.0)
CIRCLE = Circle(START, speed=10.0, radius=100.0)
ON_EARTH = replace(CIRCLE, earth_rate=EARTH_RATE)


def exponential(turns):
    """Rotation matrices of rotation vectors (Rodrigues), shape (k, 3, 3)."""
    x, y, z = turns.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    return (
        np.eye(3)
        + np.sinc(angle / np.pi) * cross
        + np.sinc(angle / math.tau) ** 2 / 2 * cross @ cross
    )


def matrix(q):
    """Rotation matrices of quaternions, by turning the axes: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[:, 0, None, None], q[:, None, 1:]
    axes = np.eye(3)
    rotated = axes + 2 * w * np.cross(u, axes) + 2 * np.cross(u, np.cross(u, axes))
    return rotated.transpose(0, 2, 1)


def test_the_integral_of_the_rate_is_the_attitude():
    time_s = np.concatenate(list(sample_times(100.0, 300.0)))
    truth = CIRCLE(time_s)
    attitudes = matrix(truth.q_nb)
    attitude = attitudes[0]
    steps = exponential(truth.rate_b[1:] * np.diff(time_s)[:, None])
    worst = 0.0
    for step, expected in zip(steps, attitudes[1:], strict=True):
        attitude = attitude @ step
        worst = max(worst, abs(attitude - expected).max())
    assert worst < 1e-9


def test_the_rate_on_a_turning_earth_is_relative_to_inertial_space():
    step_s = 0.02
    time_s = np.arange(0, 60, step_s)
    halfway = ON_EARTH(time_s + step_s / 2)
    attitude_ib = matrix(ON_EARTH(np.zeros(1)).q_nb)[0]
    for step in exponential(halfway.rate_b * step_s):
        attitude_ib = attitude_ib @ step
    rotation_in = exponential(START_RATE_N * (time_s[-1] + step_s))[0]
    attitude_nb = matrix(ON_EARTH(time_s[-1:] + step_s).q_nb)[0]
    assert attitude_ib == pytest.approx(rotation_in @ attitude_nb, abs=1e-8)
    assert np.linalg.norm(attitude_ib - attitude_nb) > 1e-3


START_RATE_N = EARTH_RATE * np.array([[math.cos(START.latitude), 0, -math.sin(START.latitude)]])


def test_the_velocity_is_the_derivative_of_the_position_on_the_ellipsoid():
    step_s = 0.01
    time_s = np.arange(0, 70, 0.5)
    before, truth, after = (CIRCLE(time_s + shift) for shift in (-step_s, 0.0, step_s))
    velocity_e = (ecef(after) - ecef(before)) / (2 * step_s)
    velocity_n = np.einsum("kij,kj->ki", rotation_ne(truth), velocity_e)
    # The plane at the start against the ellipsoid 200 m further: 2e-5 of 10 m/s.
    assert velocity_n == pytest.approx(truth.velocity_n, abs=5e-4)


def ecef(truth):
    """WGS 84 coordinates fixed in the earth, from the ellipsoid's axes."""
    a, b = 6378137.0, 6356752.314245
    sin, cos = np.sin(truth.latitude), np.cos(truth.latitude)
    length = np.hypot(a * cos, b * sin)
    out, up = (a * a / length + truth.altitude) * cos, (b * b / length + truth.altitude) * sin
    return np.stack([out * np.cos(truth.longitude), out * np.sin(truth.longitude), up], axis=-1)


def rotation_ne(truth):
    sin, cos = np.sin(truth.latitude), np.cos(truth.latitude)
    sin_lon, cos_lon = np.sin(truth.longitude), np.cos(truth.longitude)
    north = np.stack([-sin * cos_lon, -sin * sin_lon, cos], axis=-1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(sin)], axis=-1)
    return np.stack([north, east, np.cross(north, east)], axis=1)


def test_the_vehicle_moves_where_it_points():
    truth = CIRCLE(np.arange(0, 300, 0.1))
    forward_n = matrix(truth.q_nb)[:, :, 0]
    assert truth.velocity_n == pytest.approx(10.0 * forward_n, abs=1e-12)


def test_yaw_increases_all_around():
    truth = CIRCLE(np.arange(0, 300, 0.1))
    yaw = np.unwrap(np.arctan2(truth.velocity_n[:, 1], truth.velocity_n[:, 0]))
    assert np.diff(yaw) == pytest.approx(0.01)


def test_the_specific_force_is_the_acceleration_in_inertial_space_without_gravity():
    step_s = 0.01
    time_s = np.arange(1, 60, 1.0)

    def position_i(t):
        position_n = 100.0 * np.stack([np.sin(0.1 * t), 1 - np.cos(0.1 * t), 0 * t], axis=-1)
        return np.einsum("kij,kj->ki", exponential(START_RATE_N * t[:, None]), position_n)

    before, now, after = (position_i(time_s + shift) for shift in (-step_s, 0.0, step_s))
    acceleration_i = (after - 2 * now + before) / step_s**2
    acceleration_n = np.einsum(
        "kji,kj->ki", exponential(START_RATE_N * time_s[:, None]), acceleration_i
    )
    truth = ON_EARTH(time_s)
    force_n = np.einsum("kij,kj->ki", matrix(truth.q_nb), truth.force_b)
    assert force_n == pytest.approx(acceleration_n - [0, 0, GRAVITY], abs=2e-5)


@pytest.mark.parametrize(
    ("rate", "duration", "expected"), [(100, 2.5, 250), (1, 3, 3), (1, 0.1, 1)]
)
def test_sample_times_are_evenly_spaced_and_come_in_short_blocks(rate, duration, expected):
    blocks = list(sample_times(rate, duration))
    assert max(len(block) for block in blocks) <= rate
    assert np.concatenate(blocks) == pytest.approx(np.arange(expected) / rate)
