"""The mean rate of a vehicle that its operator says is at rest: the bias of its gyros."""

from enum import Enum, auto

import numpy as np

from risaf_link.core.gear import STANDING_SPEED
from risaf_link.core.rotation import Floats

DURATION = 5.0  # s: a white noise of 1e-3 rad/s a sample at 100 Hz averages to 5e-5 rad/s
BLOCK = 0.5  # s
QUIET = 0.05  # rad/s, standard deviation within a block of what stands: an idling engine
STEADY = 0.01  # rad/s, between the means of blocks
LARGEST_BIAS = 0.15  # rad/s; no gyro at rest shows more: PX4's EKF2_GYR_B_LIM
FLOOR = 1e-4  # rad/s, standard deviation of a mean: wind, people
LONGEST_GAP = 1.0  # s, between rates
PATIENCE = 10.0  # s, without as many usable rates in it as it needs


class Zeroed(Enum):
    """How it stands."""

    WORKING = auto()
    DONE = auto()
    MOVED = auto()
    """The vehicle is not at rest."""
    STARVED = auto()
    """Too few rates came."""


class Zeroing:
    """Takes the mean of the fused rate over some seconds, and watches that it is that of rest.

    Attributes
    ----------
    state : Zeroed
    mean, variance : ndarray, shape (3,)
        Of the rate, rad/s, and of that mean; once it is done.
    """

    def __init__(self) -> None:
        self.state = Zeroed.WORKING
        self.mean = np.zeros(3)
        self.variance = np.zeros(3)
        self._rates: list[Floats] = []  # of the block that is not whole
        self._filled = 0.0  # s, of it
        self._means: list[Floats] = []
        self._since_s: float | None = None
        self._last_s = 0.0

    @property
    def progress(self) -> float:
        """Share of the time that is over, 0 to 1."""
        return min(len(self._means) * BLOCK / DURATION, 1.0)

    def take(self, rate_b: Floats, speed: float, time_s: float) -> None:
        """Use the next fused rate.

        Parameters
        ----------
        rate_b : ndarray, shape (3,)
            rad/s, bias not taken off; not used where not finite.
        speed : float
            m/s by GPS; NaN: not known.
        time_s : float
            When it was, seconds of the estimator.
        """
        if self.state is not Zeroed.WORKING:
            return
        if self._since_s is None:
            self._since_s = self._last_s = time_s
        step, self._last_s = time_s - self._last_s, time_s
        if step > LONGEST_GAP or time_s - self._since_s > PATIENCE:
            self.state = Zeroed.STARVED
        elif speed > STANDING_SPEED:
            self.state = Zeroed.MOVED
        elif np.isfinite(rate_b).all():
            self._rates.append(rate_b)
            self._filled += min(step, BLOCK)
            if self._filled >= BLOCK:
                self._close()

    def _close(self) -> None:
        """Judge a block that is whole."""
        rates = np.array(self._rates)
        self._rates, self._filled = [], 0.0
        self._means.append(rates.mean(axis=0))
        means = np.array(self._means)
        moved = (
            (rates.std(axis=0) > QUIET).any()
            or (np.abs(means[-1]) > LARGEST_BIAS).any()
            or (np.ptp(means, axis=0) > STEADY).any()
        )
        if moved:
            self.state = Zeroed.MOVED
        elif len(means) * BLOCK >= DURATION:
            self.mean = means.mean(axis=0)
            self.variance = means.var(axis=0, ddof=1) / len(means) + FLOOR**2
            self.state = Zeroed.DONE
