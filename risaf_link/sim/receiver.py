"""A GPS receiver.

Its velocity comes from Doppler, with white noise. Its position error is a first-order Gauss-Markov
process in each direction, since what causes it (ionosphere, multipath) lasts for a minute: two
consecutive positions are much closer to each other than to the truth. A real receiver's errors have
several time constants, and its filter delays turns; this one's do not.
"""

import math
from dataclasses import dataclass

import numpy as np

from risaf_link.core.earth import radii
from risaf_link.core.rotation import Floats
from risaf_link.sim.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class ReceiverParameters:
    """What a receiver is: by default a good single-band one under an open sky."""

    rate: float = 5.0  # Hz
    velocity_noise: float = 0.1  # m/s, standard deviation along each axis
    position_noise: float = 1.5  # m, standard deviation north and east
    altitude_noise: float = 3.0  # m; satellites are above only
    time_constant: float = 60.0  # s, of the position error; 0: it is white
    latency: float = 0.11  # s from the instant that a fix describes to its arrival


@dataclass(frozen=True, slots=True)
class Fixes:
    """What a receiver reports, k fixes."""

    time_s: Floats  # (k,) seconds from the start, of the instant that is described
    arrival_s: Floats  # (k,) when the report comes
    latitude: Floats  # (k,) rad
    longitude: Floats  # (k,) rad
    altitude: Floats  # (k,) m
    speed: Floats  # (k,) m/s over ground
    course: Floats  # (k,) rad from true north, in (-pi, pi]
    position_std: float  # m, north and east
    altitude_std: float  # m
    velocity_std: float  # m/s, along each axis
    course_std: Floats  # (k,) rad


def fixes(
    trajectory: Trajectory,
    duration: float,
    parameters: ReceiverParameters,
    generator: np.random.Generator,
) -> Fixes:
    """Observe a vehicle.

    Parameters
    ----------
    trajectory : callable
    duration : float
        Seconds; fixes that arrive later are left out.
    parameters : ReceiverParameters
    generator : numpy.random.Generator
    """
    p = parameters
    count = max(0, math.ceil((duration - p.latency) * p.rate))
    time_s = np.arange(count) / p.rate
    truth = trajectory(time_s)
    position_noise, velocity_noise = generator.spawn(2)
    sizes = np.array([p.position_noise, p.position_noise, p.altitude_noise])
    error_n = sizes * _gauss_markov(count, p.rate * p.time_constant, position_noise)
    velocity_n = truth.velocity_n + velocity_noise.normal(0.0, p.velocity_noise, (count, 3))
    speed = np.hypot(velocity_n[:, 0], velocity_n[:, 1])
    north, east = radii(truth.latitude, truth.altitude)
    return Fixes(
        time_s=time_s,
        arrival_s=time_s + p.latency,
        latitude=truth.latitude + error_n[:, 0] / north,
        longitude=truth.longitude + error_n[:, 1] / east,
        altitude=truth.altitude - error_n[:, 2],
        speed=speed,
        course=np.arctan2(velocity_n[:, 1], velocity_n[:, 0]),
        position_std=p.position_noise,
        altitude_std=p.altitude_noise,
        velocity_std=p.velocity_noise,
        course_std=_course_std(speed, p.velocity_noise),
    )


def _gauss_markov(count: int, samples: float, generator: np.random.Generator) -> Floats:
    """Unit processes along three axes, shape (count, 3), that forget within so many samples."""
    kept = math.exp(-1.0 / samples) if samples else 0.0
    values = generator.standard_normal((count, 3))
    values[1:] *= math.sqrt(1.0 - kept * kept)
    for i in range(1, count):
        values[i] += kept * values[i - 1]
    return values


def _course_std(speed: Floats, velocity_noise: float) -> Floats:
    """Noise across the motion over its speed; nothing is known of the course at standstill."""
    unknown = np.full_like(speed, math.pi)
    return np.minimum(
        unknown, np.divide(velocity_noise, speed, out=unknown.copy(), where=speed > 0)
    )
