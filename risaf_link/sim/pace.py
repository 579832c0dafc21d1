"""How fast a simulated vehicle goes: speed over time, in closed form."""

from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats


@dataclass(frozen=True, slots=True)
class SpeedChange:
    """One smooth change of speed."""

    start: float  # s
    length: float  # s
    change: float  # m/s


@dataclass(frozen=True, slots=True)
class Ride:
    """A vehicle along its way at k instants."""

    distance: Floats  # (k,) m from the start, negative before it
    speed: Floats  # (k,) m/s
    acceleration: Floats  # (k,) m/s^2


@dataclass(frozen=True, slots=True)
class Pace:
    """A speed that changes now and then, and is constant otherwise.

    A change takes the course of 10 u^3 - 15 u^4 + 6 u^5, u from 0 to 1: acceleration and jerk begin
    and end with zero, and distance is a polynomial too.
    """

    speed: float  # m/s, before the first change
    changes: tuple[SpeedChange, ...] = ()

    def __call__(self, time_s: Floats) -> Ride:
        """Evaluate the pace at times, shape (k,), seconds; zero is the start."""
        plan = [(c.start, c.length, c.change) for c in self.changes]
        start, length, change = np.reshape(plan, (-1, 3)).T[:, :, np.newaxis]
        since = (time_s - start) / length
        u = np.clip(since, 0.0, 1.0)
        square = u * u
        gone = square * square * (2.5 + u * (u - 3.0)) + np.maximum(since - 1.0, 0.0)
        gained = u * square * (10.0 + u * (6.0 * u - 15.0))
        gaining = 30.0 * np.square(u * (1.0 - u))
        return Ride(
            distance=self.speed * time_s + np.sum(change * length * gone, axis=0),
            speed=self.speed + np.sum(change * gained, axis=0),
            acceleration=np.sum(change / length * gaining, axis=0),
        )


def wandering(
    generator: np.random.Generator,
    span: tuple[float, float],
    speeds: tuple[float, float],
    holds: tuple[float, float],
    speed: float,
) -> list[SpeedChange]:
    """Plan random changes of speed.

    Parameters
    ----------
    generator : numpy.random.Generator
    span : (float, float)
        Seconds; changes start and end within it.
    speeds : (float, float)
        m/s; every change is to a speed in between.
    holds : (float, float)
        Seconds; how long a speed is held.
    speed : float
        m/s, before.

    Returns
    -------
    list of SpeedChange
    """
    time_s, end = span
    changes: list[SpeedChange] = []
    while True:
        change = float(generator.uniform(*speeds)) - speed
        planned = change_of_speed(time_s, change)
        if time_s + planned.length > end:
            return changes
        changes.append(planned)
        speed += change
        time_s += planned.length + float(generator.uniform(*holds))


def change_of_speed(start: float, change: float) -> SpeedChange:
    """Change the speed with 1 m/s^2 in the mean, or softer: within 4 s at least."""
    return SpeedChange(start, max(4.0, abs(change)), change)
