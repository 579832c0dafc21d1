"""Where a simulated vehicle is, and what an ideal inertial sensor in it would read."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from risaf_link.core.earth import GRAVITY, radii
from risaf_link.core.rotation import Floats, matrix_from_quaternion


@dataclass(frozen=True, slots=True)
class Truth:
    """The motion of a vehicle at k instants; n is the local frame where it is."""

    time_s: Floats  # (k,) seconds from the start
    q_nb: Floats  # (k, 4) unit quaternions
    rate_b: Floats  # (k, 3) rad/s, of the body relative to inertial space
    force_b: Floats  # (k, 3) specific force, m/s^2
    velocity_n: Floats  # (k, 3) m/s
    latitude: Floats  # (k,) rad
    longitude: Floats  # (k,) rad
    altitude: Floats  # (k,) m
    frame_n: Floats  # (k, 3) rad/s, of n relative to inertial space
    earth_n: Floats  # (k, 3) rad/s, of the earth


Trajectory = Callable[[Floats], Truth]
"""A vehicle's way: from times, shape (k,), seconds from the start, to the truth at them.

It goes on before the start and after the end.
"""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a trajectory starts."""

    latitude: float  # rad
    longitude: float  # rad
    altitude: float  # m


@dataclass(frozen=True, slots=True)
class Motion:
    """How a body moves in n at k instants."""

    q_nb: Floats  # (k, 4)
    turn_b: Floats  # (k, 3) rad/s, of the body relative to n
    velocity_n: Floats  # (k, 3) m/s
    acceleration_n: Floats  # (k, 3) m/s^2, the derivative of the velocity's components

    def truth(self, time_s: Floats, where: Floats, frame_n: Floats, earth_n: Floats) -> Truth:
        """Add the earth.

        Groves 2013, eq. 5.53, solved for the specific force. Gravity is the standard one, straight
        down.

        Parameters
        ----------
        time_s : ndarray, shape (k,)
            Seconds from the start.
        where : ndarray, shape (k, 3)
            Latitude and longitude, rad, altitude, m.
        frame_n, earth_n : ndarray, shape (k, 3)
            Rates of n and of the earth relative to inertial space, rad/s.
        """
        coriolis_n = np.cross(frame_n + earth_n, self.velocity_n)
        force_n = self.acceleration_n + coriolis_n - [0.0, 0.0, GRAVITY]
        rotation_nb = matrix_from_quaternion(self.q_nb)
        return Truth(
            time_s=time_s,
            q_nb=self.q_nb,
            rate_b=self.turn_b + np.einsum("kji,kj->ki", rotation_nb, frame_n),
            force_b=np.einsum("kji,kj->ki", rotation_nb, force_n),
            velocity_n=self.velocity_n,
            latitude=where[:, 0],
            longitude=where[:, 1],
            altitude=where[:, 2],
            frame_n=frame_n,
            earth_n=earth_n,
        )


@dataclass(frozen=True, slots=True)
class Circle:
    """A level circle to the right at constant speed, from the start northward.

    It lies in the plane that touches the earth at the start, and that is n throughout: the earth
    does not curve, and turns only if it is told to.
    """

    start: Place
    speed: float  # m/s
    radius: float  # m
    earth_rate: float = 0.0  # rad/s; EARTH_RATE for sensors that feel the earth turn

    def __call__(self, time_s: Floats) -> Truth:
        """Evaluate the circle, in closed form."""
        turn = self.speed / self.radius
        yaw = turn * time_s
        sin, cos, zero = np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)
        motion = Motion(
            q_nb=_columns(np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)),
            turn_b=_columns(zero, zero, zero + turn),
            velocity_n=self.speed * _columns(cos, sin, zero),
            acceleration_n=self.speed * turn * _columns(-sin, cos, zero),
        )
        start = self.start
        north, east = radii(start.latitude, start.altitude)
        where = _columns(
            start.latitude + self.radius * sin / north,
            start.longitude + self.radius * (1.0 - cos) / east,
            zero + start.altitude,
        )
        earth_n = self.earth_rate * earth_axis(np.full_like(yaw, start.latitude))
        return motion.truth(time_s, where, earth_n, earth_n)


def earth_axis(latitude: Floats) -> Floats:
    """Direction of the earth's rotation in n, shape (k, 3)."""
    return _columns(np.cos(latitude), np.zeros_like(latitude), -np.sin(latitude))


def sample_times(rate: float, duration: float) -> Iterator[Floats]:
    """Instants from zero on, in blocks of about a second.

    Parameters
    ----------
    rate : float
        Hz.
    duration : float
        Seconds; there is always at least one instant.

    Yields
    ------
    ndarray, shape (k,)
        Seconds.
    """
    count = max(1, round(rate * duration))
    size = max(1, round(rate))
    for first in range(0, count, size):
        yield np.arange(first, min(first + size, count)) / rate


def _columns(*columns: Floats) -> Floats:
    return np.stack(columns, axis=-1)
