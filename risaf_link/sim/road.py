"""Roads: where they lead, how they climb, and how rough they are, over the distance along them."""

import math
from dataclasses import dataclass

import numpy as np

from risaf_link.core.earth import radii
from risaf_link.core.rotation import Floats
from risaf_link.sim.trajectory import Place


@dataclass(frozen=True, slots=True)
class Waves:
    """A smooth function of distance: sines about a level."""

    amplitude: Floats  # (m,)
    wavenumber: Floats  # (m,) rad/m
    phase: Floats  # (m,) rad
    level: float = 0.0

    def __call__(self, distance: Floats) -> tuple[Floats, Floats, Floats]:
        """Evaluate at distances, shape (k,), m: the value and its first two derivatives."""
        phase = np.multiply.outer(self.wavenumber, distance) + self.phase[:, np.newaxis]
        a = self.amplitude[:, np.newaxis]
        k = self.wavenumber[:, np.newaxis]
        sines, cosines = a * np.sin(phase), a * np.cos(phase)
        value = self.level + sines.sum(axis=0)
        return value, (k * cosines).sum(axis=0), (-k * k * sines).sum(axis=0)


LEVEL = Waves(np.zeros(0), np.zeros(0), np.zeros(0))
"""Nothing but zero."""


def waves(
    generator: np.random.Generator,
    amplitudes: Floats | tuple[float, ...],
    lengths: Floats | tuple[float, ...],
    level: float = 0.0,
) -> Waves:
    """Make waves with random phases; amplitudes up to a tenth smaller, lengths up to one off."""
    count = len(amplitudes)
    return Waves(
        amplitude=np.asarray(amplitudes) * generator.uniform(0.9, 1.0, count),
        wavenumber=math.tau / (np.asarray(lengths) * generator.uniform(0.9, 1.1, count)),
        phase=generator.uniform(0.0, math.tau, count),
        level=level,
    )


@dataclass(frozen=True, slots=True)
class Road:
    """Angles in rad, the heave in m.

    The vehicle's centre follows course and slope, and the heave on top. Its body has the road's
    angles plus the shaking.
    """

    course: Waves  # from true north
    slope: Waves  # up
    bank: Waves  # right side down
    shaking: tuple[Waves, Waves, Waves] = (LEVEL, LEVEL, LEVEL)  # roll, pitch, yaw
    heave: Waves = LEVEL  # up


SHORTEST_BUMP, LONGEST_BUMP = 0.7, 8.0  # m; at 14 m/s the shortest is met 20 times a second


def shaking(generator: np.random.Generator, angle: float) -> Waves:
    """Make shaking by the bumps of an unpaved road, of so many radians a metre (RMS).

    Twelve waves contribute the same to the angular rate, which grows with speed.
    """
    lengths = _bumps()
    amplitudes = angle * math.sqrt(2.0 / len(lengths)) * lengths / math.tau
    return waves(generator, amplitudes, lengths)


def heave(generator: np.random.Generator, curvature: float) -> Waves:
    """Make the heave of a wheel-borne body, of so much curvature (1/m, RMS).

    Twelve waves contribute the same to the acceleration, which grows with the square of speed.
    """
    lengths = _bumps()
    amplitudes = curvature * math.sqrt(2.0 / len(lengths)) * (lengths / math.tau) ** 2
    return waves(generator, amplitudes, lengths)


def _bumps() -> Floats:
    return np.geomspace(SHORTEST_BUMP, LONGEST_BUMP, 12)


class Track:
    """Latitude, longitude and altitude along a road, on the ellipsoid.

    They are integrals without a closed form: tabulated every two metres as far as was asked for, by
    Gauss-Legendre quadrature, and interpolated with their exact derivatives (cubic Hermite). On
    roads that bend within hundreds of metres that errs by less than a micrometre.

    Parameters
    ----------
    road : Road
    start : Place
    """

    _BEFORE, _STEP = 100.0, 2.0  # m; the table begins before the start

    def __init__(self, road: Road, start: Place) -> None:
        self._road = road
        self._start = start
        self._tabulate(1000.0)

    def __call__(self, distance: Floats) -> Floats:
        """Find places, shape (k, 3): latitude, longitude (rad), altitude (m)."""
        farthest = float(distance.max(initial=0.0))
        if farthest + self._STEP > self._length:
            self._tabulate(2.0 * farthest)
        place = (distance + self._BEFORE) / self._STEP
        cell = place.astype(np.intp)
        u = (place - cell)[:, np.newaxis]
        begin, end = self._nodes[cell], self._nodes[cell + 1]
        bend = (1.0 - u) * self._tangents[cell] - u * self._tangents[cell + 1]
        bend += (2.0 * u - 1.0) * (end - begin)
        found: Floats = (1.0 - u) * begin + u * end + u * (1.0 - u) * bend
        return found

    def _tabulate(self, length: float) -> None:
        """Fill the table: `_nodes` and, per step, `_tangents`, both of shape (m, 3)."""
        self._length = length
        nodes = np.arange(-self._BEFORE, length + 2 * self._STEP, self._STEP)
        points, weights = np.polynomial.legendre.leggauss(3)
        inside = nodes[:-1, np.newaxis] + self._STEP * (points + 1.0) / 2.0
        directions = self._directions(inside.ravel()).reshape(*inside.shape, 3)
        moves_n = self._STEP * np.einsum("q,mqi->mi", weights / 2.0, directions)  # m
        here = self._from_start(
            moves_n / self._per_unit(self._start.latitude, self._start.altitude)
        )
        halfway = (here[1:] + here[:-1]) / 2.0
        self._nodes = self._from_start(moves_n / self._per_unit(halfway[:, 0], halfway[:, 2]))
        per_unit = self._per_unit(self._nodes[:, 0], self._nodes[:, 2])
        self._tangents = self._STEP * self._directions(nodes) / per_unit

    def _from_start(self, moves: Floats) -> Floats:
        """Places after moves in latitude, longitude, altitude; one more than moves."""
        origin = round(self._BEFORE / self._STEP)
        places = np.concatenate([np.zeros((1, 3)), np.cumsum(moves, axis=0)])
        start = [self._start.latitude, self._start.longitude, self._start.altitude]
        moved: Floats = places - places[origin] + start
        return moved

    def _directions(self, distance: Floats) -> Floats:
        """Steps north, east and up for a step along the road, shape (k, 3)."""
        course, slope = self._road.course(distance)[0], self._road.slope(distance)[0]
        level = np.cos(slope)
        return np.stack([level * np.cos(course), level * np.sin(course), np.sin(slope)], axis=-1)

    @staticmethod
    def _per_unit(latitude: Floats | float, altitude: Floats | float) -> Floats:
        """Metres for a unit of latitude, longitude and altitude."""
        north, east = radii(latitude, altitude)
        return np.stack([north, east, np.ones_like(north)], axis=-1)
