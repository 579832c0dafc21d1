"""What a vehicle turns while no reading tells of it, because readings were lost on the way.

A reading tells the mean rate over the usual step. Of a longer step the rest is a gap. Its ends are
known: the rate before and the rate after, and half their sum is the mean in between, for as long as
a rate lasts. How far that is wrong has two parts, of which the larger matters:

- what shakes the vehicle. It is seen in how the rate changes from step to step; held at both ends,
  a random walk of the rate has turned with variance `shaken gap**3 / 12` (the integral of a
  Brownian bridge);
- what the vehicle decides to do. A corner that begins and ends in the gap shows at neither end.

A vehicle that was level does not tilt by more than `initial_tilt_std` allows, however long the gap.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

GAP = 1.5  # usual steps; a longer one has a gap
# By what the usual step follows shorter and longer ones: a fifth are shorter, so that it is right
# while half of the epochs are lost.
USUAL_LESS, USUAL_MORE = 0.92, 1.02
SHAKEN_TIME = 1.0  # s, of the mean of how much a rate changes
END_TIME = 0.5  # s for which the rate at an end of the gap lasts into it
UNSEEN_CHANGE = 0.07  # rad/s^2; over 4 s a right-angled corner is one and a half deviations


class Step(NamedTuple):
    """A step, as far as it is known."""

    rate_b: Floats  # (3,) rad/s, mean over the time that is told of
    told: float  # s of it
    unseen: Floats  # (3,) rad^2, variance of what was turned besides; zero: there is no gap

    @property
    def has_gap(self) -> bool:
        """Whether it was not read as a whole."""
        return bool(self.unseen.any())


class Gaps:
    """Tells gaps from steps, and bridges them."""

    def __init__(self) -> None:
        self._usual = 0.0  # s
        self._shaken = np.zeros(3)  # (rad/s)^2/s

    def take(self, before_b: Floats, rate_b: Floats, known: NDArray[np.bool_], dt: float) -> Step:
        """Take the next step.

        Parameters
        ----------
        before_b, rate_b : ndarray, shape (3,)
            Rates of the vehicle that the step begins and ends with, rad/s.
        known : ndarray, shape (3,)
            Whether the latter was read.
        dt : float
            s, more than zero.
        """
        gap = self._gap(dt)
        if not gap:
            weight = dt / (dt + SHAKEN_TIME)
            change = (rate_b - before_b) ** 2 / dt
            self._shaken = np.where(
                known, self._shaken + weight * (change - self._shaken), self._shaken
            )
            return Step(rate_b, dt, np.zeros(3))
        bridged = min(gap, 2.0 * END_TIME)
        told = dt - gap + bridged
        mean_b = rate_b + (before_b - rate_b) * (0.5 * bridged / told)
        unseen = self._shaken * (gap * gap * gap) / 12.0 + (UNSEEN_CHANGE * gap * gap) ** 2
        return Step(mean_b, told, np.where(known, unseen, 0.0))

    def _gap(self, dt: float) -> float:
        usual = self._usual or dt
        self._usual = usual * (USUAL_MORE if dt > usual else USUAL_LESS)
        return dt - usual if dt > GAP * usual else 0.0
