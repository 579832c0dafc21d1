"""Drives on the turning ellipsoid are consistent physics, and what their scenarios promise."""

import math

import numpy as np
import pytest

from risaf_link.core.earth import EARTH_RATE, GRAVITY
from risaf_link.sim.ideal import mean_readings
from risaf_link.sim.pace import Pace, SpeedChange
from risaf_link.sim.scenario import scenario
from risaf_link.sim.trajectory import sample_times

DRIVES = ("drive1", "drive2", "ekf2")
EARTH_E = EARTH_RATE * np.array([0.0, 0.0, 1.0])


def matrix(q):
    """Rotation matrices of quaternions, by turning the axes: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[:, 0, None, None], q[:, None, 1:]
    axes = np.eye(3)
    rotated = axes + 2 * w * np.cross(u, axes) + 2 * np.cross(u, np.cross(u, axes))
    return rotated.transpose(0, 2, 1)


def exponential(turns):
    """Rotation matrices of rotation vectors (Rodrigues), shape (k, 3, 3)."""
    x, y, z = turns.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    half = np.sinc(angle / math.tau)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * cross @ cross


def rotation_en(truth):
    """Axes north, east, down as columns, in the frame that is fixed in the earth."""
    sin, cos = np.sin(truth.latitude), np.cos(truth.latitude)
    sin_lon, cos_lon = np.sin(truth.longitude), np.cos(truth.longitude)
    north = np.stack([-sin * cos_lon, -sin * sin_lon, cos], axis=-1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(sin)], axis=-1)
    return np.stack([north, east, np.cross(north, east)], axis=-1)


def rotation_ib(truth):
    """Body axes among the stars; i is e at time zero."""
    rotation_ie = exponential(truth.time_s[:, None] * EARTH_E)
    return rotation_ie @ rotation_en(truth) @ matrix(truth.q_nb)


def position_e(truth):
    """WGS 84 coordinates fixed in the earth, from the ellipsoid's axes."""
    a, b = 6378137.0, 6356752.314245
    sin, cos = np.sin(truth.latitude), np.cos(truth.latitude)
    length = np.hypot(a * cos, b * sin)
    out, up = (a * a / length + truth.altitude) * cos, (b * b / length + truth.altitude) * sin
    return np.stack([out * np.cos(truth.longitude), out * np.sin(truth.longitude), up], axis=-1)


def derivative(values, step_s):
    """Of values at five instants a step apart, fourth order."""
    first, second, _, fourth, fifth = values
    return (first - 8 * second + 8 * fourth - fifth) / (12 * step_s)


def around(trajectory, time_s, step_s):
    return [trajectory(time_s + shift * step_s) for shift in range(-2, 3)]


def speed_of(truth):
    return np.linalg.norm(truth.velocity_n, axis=1)


@pytest.mark.parametrize("name", DRIVES)
def test_the_integrated_readings_of_perfect_gyros_are_the_attitude_over_the_whole_drive(name):
    chosen = scenario(name, 5)
    time_s = np.arange(round(chosen.duration * 100)) / 100
    truth = chosen.trajectory(time_s)
    rates_b, _ = mean_readings(truth)
    expected = rotation_ib(truth)
    attitude, worst = expected[0], 0.0
    for step, whole in zip(exponential(rates_b / 100), expected[1:], strict=True):
        attitude = attitude @ step
        worst = max(worst, abs(attitude - whole).max())
    assert worst < math.radians(1e-6)


@pytest.mark.parametrize("name", DRIVES)
def test_the_rate_is_the_derivative_of_the_attitude_in_inertial_space(name):
    chosen = scenario(name, 5)
    time_s = np.arange(3.0, chosen.duration, 0.37)
    instants = around(chosen.trajectory, time_s, 1e-3)
    turning = derivative([rotation_ib(t) for t in instants], 1e-3)
    cross_b = np.swapaxes(rotation_ib(instants[2]), 1, 2) @ turning
    rate_b = np.stack([cross_b[:, 2, 1], cross_b[:, 0, 2], cross_b[:, 1, 0]], axis=-1)
    assert instants[2].rate_b == pytest.approx(rate_b, abs=1e-5)


@pytest.mark.parametrize("name", DRIVES)
def test_the_velocity_is_the_derivative_of_the_position_on_the_ellipsoid(name):
    chosen = scenario(name, 5)
    instants = around(chosen.trajectory, np.arange(3.0, chosen.duration, 0.37), 1e-3)
    velocity_e = derivative([position_e(t) for t in instants], 1e-3)
    velocity_n = np.einsum("kji,kj->ki", rotation_en(instants[2]), velocity_e)
    assert instants[2].velocity_n == pytest.approx(velocity_n, abs=2e-5)


@pytest.mark.parametrize("name", DRIVES)
def test_the_specific_force_is_what_is_left_of_the_acceleration_without_gravity(name):
    chosen = scenario(name, 5)
    instants = around(chosen.trajectory, np.arange(3.0, chosen.duration, 0.37), 1e-3)
    truth = instants[2]
    velocity_e = [np.einsum("kij,kj->ki", rotation_en(t), t.velocity_n) for t in instants]
    force_e = derivative(velocity_e, 1e-3) + 2 * np.cross(EARTH_E, velocity_e[2])
    force_e -= GRAVITY * rotation_en(truth)[:, :, 2]
    force_b = np.einsum("kji,kj->ki", rotation_en(truth) @ matrix(truth.q_nb), force_e)
    assert truth.force_b == pytest.approx(force_b, abs=1e-4)


@pytest.mark.parametrize("name", DRIVES)
def test_readings_are_means_over_the_interval_that_ends_with_the_sample(name):
    chosen = scenario(name, 5)
    begin_s = np.arange(12.0, 60.0, 0.5)
    points, weights = np.polynomial.legendre.leggauss(5)
    inside_s = begin_s[:, None] + 0.005 * (1 + points)
    within = chosen.trajectory(inside_s.ravel())
    for i, start in enumerate(begin_s):
        rates_b, forces_b = mean_readings(chosen.trajectory(np.array([start, start + 0.01])))
        part = slice(5 * i, 5 * i + 5)
        assert rates_b[0] == pytest.approx(weights @ within.rate_b[part] / 2, abs=2e-5)
        assert forces_b[0] == pytest.approx(weights @ within.force_b[part] / 2, abs=2e-3)


def test_vibration_of_a_rough_road_is_bounded_motion_and_shakes_the_sensors():
    chosen = scenario("drive2", 5)
    fast = [
        t for t in map(chosen.trajectory, sample_times(100.0, 400.0)) if speed_of(t).min() > 9.0
    ]
    rates_b = np.concatenate([t.rate_b - t.rate_b.mean(axis=0) for t in fast])
    up = np.concatenate([t.force_b[:, 2] for t in fast])
    assert (np.degrees(rates_b.std(axis=0)) > [3.0, 3.0, 0.6]).all()
    assert (np.degrees(rates_b.std(axis=0)) < [9.0, 9.0, 2.0]).all()
    assert 1.0 < up.std() < 4.0
    velocity = np.concatenate([t.velocity_n for t in fast])
    yaw = np.concatenate(
        [np.arctan2(m[:, 1, 0], m[:, 0, 0]) for m in (matrix(t.q_nb) for t in fast)]
    )
    off = np.angle(np.exp(1j * (yaw - np.arctan2(velocity[:, 1], velocity[:, 0]))))
    assert 0.0 < abs(np.degrees(off)).max() < 0.3


@pytest.mark.parametrize("name", ["drive1", "ekf2"])
def test_on_a_road_the_course_is_the_yaw(name):
    truth = scenario(name, 5).trajectory(np.arange(25.0, 300.0, 0.1))
    forward_n = matrix(truth.q_nb)[:, :, 0]
    yaw = np.arctan2(forward_n[:, 1], forward_n[:, 0])
    course = np.arctan2(truth.velocity_n[:, 1], truth.velocity_n[:, 0])
    off = np.degrees(np.angle(np.exp(1j * (course - yaw))))
    assert abs(off).max() < (0.03 if name == "drive1" else 1e-9)


def test_drive1_goes_at_constant_speed():
    truth = scenario("drive1", 5).trajectory(np.arange(0.0, 300.0, 0.1))
    assert speed_of(truth) == pytest.approx(15.0, abs=0.2)
    assert np.degrees(np.ptp(np.unwrap(np.arctan2(*truth.velocity_n[:, 1::-1].T)))) > 60


@pytest.mark.parametrize("seed", range(5))
def test_drive2_starts_at_the_camp_changes_speed_and_stops_within_the_outage(seed):
    chosen = scenario("drive2", seed)
    truth = chosen.trajectory(np.arange(0.0, 800.0, 0.1))
    speed = speed_of(truth)
    assert np.degrees([truth.latitude[0], truth.longitude[0]]) == pytest.approx([30.2217, 34.8012])
    assert (speed[:100] == 0.0).all()
    assert 8.0 < speed.max() < 14.0
    ((start, end),) = chosen.outages
    standing = truth.time_s[(speed < 1e-9) & (truth.time_s > 20.0)]
    assert 29.5 < len(standing) / 10 < 30.5
    assert start + 20 < standing[0] < standing[-1] < end - 100
    at_rest = chosen.trajectory(standing)
    assert np.linalg.norm(at_rest.rate_b, axis=1) == pytest.approx(EARTH_RATE)
    assert np.linalg.norm(at_rest.force_b, axis=1) == pytest.approx(GRAVITY)


@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("seed", range(5))
def test_hills_are_of_two_to_three_degrees(name, seed):
    chosen = scenario(name, seed)
    truth = chosen.trajectory(np.arange(0.0, chosen.duration, 0.1))
    pitch = -np.degrees(np.arcsin(matrix(truth.q_nb)[:, 2, 0]))
    smooth = np.convolve(pitch, np.ones(10) / 10, "valid")
    assert 2.0 < abs(smooth).max() < 3.1


@pytest.mark.parametrize("name", DRIVES)
def test_another_seed_is_another_drive(name):
    time_s = np.arange(30.0, 200.0, 1.0)
    drives = [scenario(name, seed).trajectory(time_s) for seed in range(10)]
    yaw_rates = np.array([t.rate_b[:, 2] for t in drives])
    alike = np.corrcoef(yaw_rates) - np.eye(10)
    assert abs(alike).max() < 0.98
    assert (scenario(name, 3).trajectory(time_s).q_nb == drives[3].q_nb).all()


@pytest.mark.parametrize("rate", [1.0, 7.0, 1000.0])
def test_a_drive_does_not_depend_on_when_it_is_looked_at(rate):
    chosen = scenario("drive2", 5)
    chosen.trajectory(np.array([5000.0]))
    early = np.arange(0.0, 30.0, 1.0 / rate)
    looked, fresh = (c.trajectory(early) for c in (chosen, scenario("drive2", 5)))
    assert looked.latitude == pytest.approx(fresh.latitude, abs=1e-15)
    assert (looked.q_nb == fresh.q_nb).all()


def test_a_pace_is_the_integral_of_its_acceleration():
    pace = Pace(3.0, (SpeedChange(1.0, 4.0, 5.0), SpeedChange(3.0, 2.0, -4.0)))
    step_s = 1e-3
    time_s = np.arange(-1.0, 9.0, step_s)
    before, ride, after = (pace(time_s + shift) for shift in (-step_s, 0.0, step_s))
    assert ride.speed == pytest.approx((after.distance - before.distance) / (2 * step_s), abs=1e-5)
    assert ride.acceleration == pytest.approx((after.speed - before.speed) / (2 * step_s), abs=1e-4)
    assert pace(np.array([0.0, 20.0])).speed == pytest.approx([3.0, 4.0])
    assert pace(np.zeros(1)).distance == 0.0
