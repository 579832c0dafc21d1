"""Drives of ground vehicles: a road and a pace, on the turning ellipsoid.

Everything but latitude, longitude and altitude is in closed form, so rates and specific forces are
the exact derivatives of attitude and velocity. Bumps and bends are those of the road: they come
as fast as the vehicle, and at standstill nothing moves.
"""

import numpy as np

from risaf_link.core.earth import EARTH_RATE, radii
from risaf_link.core.rotation import Floats
from risaf_link.sim.pace import Pace, Ride
from risaf_link.sim.road import Road, Track
from risaf_link.sim.trajectory import Motion, Place, Truth, earth_axis


class Drive:
    """A vehicle on a road; a `Trajectory`.

    Its yaw is its course but for the road's shaking.

    Parameters
    ----------
    start : Place
    road : Road
    pace : Pace
    """

    def __init__(self, start: Place, road: Road, pace: Pace) -> None:
        self._road = road
        self._pace = pace
        self._track = Track(road, start)

    def __call__(self, time_s: Floats) -> Truth:
        """Evaluate the drive."""
        ride = self._pace(time_s)
        height, slope, curvature = self._road.heave(ride.distance)
        velocity_n, acceleration_n = _along(self._road, ride)
        velocity_n[:, 2] -= slope * ride.speed
        acceleration_n[:, 2] -= curvature * ride.speed**2 + slope * ride.acceleration
        where = self._track(ride.distance)
        where[:, 2] += height
        q_nb, turn_b = _attitude(self._road, ride)
        earth_n = EARTH_RATE * earth_axis(where[:, 0])
        frame_n = earth_n + _transport(velocity_n, where)
        return Motion(q_nb, turn_b, velocity_n, acceleration_n).truth(
            time_s, where, frame_n, earth_n
        )


def _along(road: Road, ride: Ride) -> tuple[Floats, Floats]:
    """Velocity and acceleration along the road, shape (k, 3)."""
    course, turning, _ = road.course(ride.distance)
    slope, climbing, _ = road.slope(ride.distance)
    sin_c, cos_c, sin_s, cos_s = np.sin(course), np.cos(course), np.sin(slope), np.cos(slope)
    direction_n = np.stack([cos_s * cos_c, cos_s * sin_c, -sin_s], axis=-1)
    right_n = np.stack([-sin_c, cos_c, np.zeros_like(course)], axis=-1)
    up_n = np.stack([-sin_s * cos_c, -sin_s * sin_c, -cos_s], axis=-1)
    bend_n = climbing[:, np.newaxis] * up_n + (turning * cos_s)[:, np.newaxis] * right_n
    speed, acceleration = ride.speed[:, np.newaxis], ride.acceleration[:, np.newaxis]
    return speed * direction_n, acceleration * direction_n + speed**2 * bend_n


def _attitude(road: Road, ride: Ride) -> tuple[Floats, Floats]:
    """Attitude, shape (k, 4), and rate of the body relative to n, shape (k, 3)."""
    angles = []
    for smooth, shaken in zip((road.bank, road.slope, road.course), road.shaking, strict=True):
        angles.append(np.add(smooth(ride.distance)[:2], shaken(ride.distance)[:2]))
    (roll, roll_per_m), (pitch, pitch_per_m), (yaw, yaw_per_m) = angles
    sin_r, cos_r, sin_p, cos_p = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    turn_b = [
        roll_per_m - sin_p * yaw_per_m,
        cos_r * pitch_per_m + sin_r * cos_p * yaw_per_m,
        -sin_r * pitch_per_m + cos_r * cos_p * yaw_per_m,
    ]
    return _quaternions(roll, pitch, yaw), np.stack(turn_b, axis=-1) * ride.speed[:, np.newaxis]


def _quaternions(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    sr, sp, sy = np.sin(roll / 2), np.sin(pitch / 2), np.sin(yaw / 2)
    cr, cp, cy = np.cos(roll / 2), np.cos(pitch / 2), np.cos(yaw / 2)
    parts = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    return np.stack(parts, axis=-1)


def _transport(velocity_n: Floats, where: Floats) -> Floats:
    """Rate of n relative to the earth as the vehicle goes round it (Groves 2013, eq. 5.44)."""
    north, east = radii(where[:, 0], where[:, 2])
    longitude_rate = velocity_n[:, 1] / east
    return np.stack(
        [
            longitude_rate * np.cos(where[:, 0]),
            -velocity_n[:, 0] / north,
            -longitude_rate * np.sin(where[:, 0]),
        ],
        axis=-1,
    )
