"""Where a simulated vehicle is, and what an ideal inertial sensor in it would read."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from risaf_link.core.earth import GRAVITY, radii
from risaf_link.core.rotation import Floats, matrix_from_quaternion


@dataclass(frozen=True, slots=True)
class Truth:
    """The motion of a vehicle at k instants."""

    time_s: Floats  # (k,) seconds from the start
    q_nb: Floats  # (k, 4) unit quaternions
    rate_b: Floats  # (k, 3) rad/s, of the body relative to inertial space
    force_b: Floats  # (k, 3) specific force, m/s^2
    velocity_n: Floats  # (k, 3) m/s
    latitude: Floats  # (k,) rad
    longitude: Floats  # (k,) rad
    altitude: Floats  # (k,) m


Trajectory = Callable[[Floats], Truth]
"""A vehicle's way: from times, shape (k,), seconds from the start, to the truth at them."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a trajectory starts; n is the plane that touches the earth here."""

    latitude: float  # rad
    longitude: float  # rad
    altitude: float  # m
    earth_rate: float = 0.0  # rad/s; EARTH_RATE for sensors that feel the earth turn

    def earth_rate_n(self) -> Floats:
        """Rate of the earth's rotation, shape (3,), rad/s."""
        direction_n = [math.cos(self.latitude), 0.0, -math.sin(self.latitude)]
        return self.earth_rate * np.array(direction_n)


@dataclass(frozen=True, slots=True)
class Motion:
    """How a body moves in n at k instants."""

    q_nb: Floats  # (k, 4)
    turn_b: Floats  # (k, 3) rad/s, of the body relative to n
    position_n: Floats  # (k, 3) m from the start
    velocity_n: Floats  # (k, 3) m/s
    acceleration_n: Floats  # (k, 3) m/s^2

    def truth(self, time_s: Floats, start: Place) -> Truth:
        """Add the earth: its rotation, its gravity, its latitudes and longitudes.

        Gravity is the standard one, straight down. The transport rate, 0.3 deg/h at 10 m/s, is
        left out: n stays the plane at the start.
        """
        earth_n = start.earth_rate_n()
        coriolis_n = 2.0 * np.cross(earth_n, self.velocity_n)
        force_n = self.acceleration_n + coriolis_n - [0.0, 0.0, GRAVITY]
        rotation_nb = matrix_from_quaternion(self.q_nb)
        north, east = radii(start.latitude, start.altitude)
        return Truth(
            time_s=time_s,
            q_nb=self.q_nb,
            rate_b=self.turn_b + np.einsum("kji,j->ki", rotation_nb, earth_n),
            force_b=np.einsum("kji,kj->ki", rotation_nb, force_n),
            velocity_n=self.velocity_n,
            latitude=start.latitude + self.position_n[:, 0] / north,
            longitude=start.longitude + self.position_n[:, 1] / east,
            altitude=start.altitude - self.position_n[:, 2],
        )


@dataclass(frozen=True, slots=True)
class Circle:
    """A level circle to the right at constant speed, from the start northward."""

    start: Place
    speed: float  # m/s
    radius: float  # m

    def __call__(self, time_s: Floats) -> Truth:
        """Evaluate the circle, in closed form."""
        turn = self.speed / self.radius
        yaw = turn * time_s
        sin, cos, zero = np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)
        motion = Motion(
            q_nb=_columns(np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)),
            turn_b=_columns(zero, zero, zero + turn),
            position_n=self.radius * _columns(sin, 1.0 - cos, zero),
            velocity_n=self.speed * _columns(cos, sin, zero),
            acceleration_n=self.speed * turn * _columns(-sin, cos, zero),
        )
        return motion.truth(time_s, self.start)


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
