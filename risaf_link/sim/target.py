"""What a fault of sensors needs to know of those it strikes."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.sim.trajectory import Trajectory, sample_times

Strike = Callable[[Floats, Floats, Floats], None]
"""Spoils the next readings in place: times (k,), truth (k, 3), readings (k, sensors, 3)."""


@dataclass(frozen=True, slots=True)
class Target:
    """An array that is to be struck by one fault.

    A fault has two generators and draws from both in the order of time, so a shorter run is the
    beginning of a longer one.
    """

    sensors: int
    trajectory: Trajectory
    duration: float  # s
    order: NDArray[np.intp]  # (sensors,) every sensor once: victims are taken in this order
    first: int  # where in it this fault begins to take
    when: np.random.Generator  # for what is struck, and when
    how_much: np.random.Generator

    def victims(self, share: float) -> NDArray[np.intp]:
        """Choose a share of the array, at least one sensor."""
        count = max(1, round(share * self.sensors))
        chosen: NDArray[np.intp] = np.roll(self.order, -self.first)[:count]
        return chosen

    def waypoints(self, spacing: float) -> Floats:
        """When the vehicle passes random points of its way, so many metres apart in the mean."""
        steps = [0.0]
        times = [0.0]
        for time_s in sample_times(_STEPS_RATE, self.duration):
            speed = np.linalg.norm(self.trajectory(time_s).velocity_n, axis=1)
            steps.extend((speed / _STEPS_RATE).tolist())
            times.extend((time_s + 1.0 / _STEPS_RATE).tolist())
        distance = np.cumsum(steps)
        expected = distance[-1] / spacing
        count = math.ceil(expected + 10.0 * math.sqrt(expected) + 10.0)  # it is a Poisson process
        points = np.cumsum(self.when.exponential(spacing, count))
        passed: Floats = np.interp(points[points < distance[-1]], distance, times)
        return passed


_STEPS_RATE = 10.0  # Hz, of the speed that is summed up


class Fault(Protocol):
    """A kind of fault, with its parameters."""

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        ...
