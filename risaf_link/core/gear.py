"""Whether a vehicle drives forwards or backwards.

GPS tells the speed without its sign, and the course of a vehicle in reverse is opposite to its
heading. Two things tell the gear. It changes only where the vehicle stands, so that a course which
turns round at speed is no change of gear. And what the accelerometer feels along the vehicle is
the change of speed, with the gear's sign.
"""

import numpy as np

from risaf_link.core.rotation import Floats

STANDING_SPEED = 0.5  # m/s; GPS shows half of it where nothing moves
LARGEST_FORCE = 1e3  # m/s^2
WINDOW = 2.0  # s, over which speed gained and force felt are compared
FORCE_ERROR = 0.5  # m/s^2; of a tilt of 3 deg
MOST = 10.0  # evidence from one window
ENOUGH, PROVEN = 20.0, 40.0  # evidence against yaw that turns it round; most that is kept


class Gear:
    """Keeps account of the gear.

    Evidence is a logarithm of likelihoods: how much better forwards explains than backwards, or a
    right yaw than an opposite one.

    Attributes
    ----------
    sign : int
        1: forwards, -1: backwards.
    may_change : bool
        The vehicle stood since the gear was last confirmed.
    """

    def __init__(self) -> None:
        self.sign = 1
        self.may_change = True
        self._felt = 0.0  # m/s, that the accelerometer has added up
        self._begun: tuple[float, float, float] | None = None  # s, m/s by GPS, m/s as felt
        self._forwards = 0.0  # evidence since the vehicle stood
        self._lately = 0.0  # and in the window that is not over
        self._right = 0.0  # evidence before, that yaw is not off by half a turn

    def feel(self, ahead: Floats, dt: Floats) -> None:
        """Use what k epochs felt ahead, (k,) m/s^2; NaN: there is no accelerometer."""
        known = np.abs(ahead) < LARGEST_FORCE
        if not known.all():
            self._begun = None
        for gained in (ahead * dt)[known].tolist():
            self._felt += gained

    def hear(self, speed: float, speed_std: float, time_s: float) -> None:
        """Use a speed over ground, m/s, with its standard deviation."""
        if speed < STANDING_SPEED:
            self._stand()
            self._begun = (time_s, speed, self._felt)
            return
        if self._begun is None or not 0.0 <= time_s - self._begun[0] < 2.0 * WINDOW:
            self._begun = (time_s, speed, self._felt)
        begun_s, before, felt_before = self._begun
        elapsed = time_s - begun_s
        gained, felt = speed - before, self._felt - felt_before
        variance = 2.0 * speed_std**2 + (FORCE_ERROR * max(elapsed, 0.1)) ** 2
        self._lately = min(max(2.0 * gained * felt / variance, -MOST), MOST)
        if elapsed >= WINDOW:
            self._forwards, self._lately = self._evidence(), 0.0
            self._begun = (time_s, speed, self._felt)

    def align(self) -> None:
        """Choose the gear before yaw is known: forwards, unless it was felt to be backwards."""
        self.sign = -1 if self._evidence() < -MOST / 2 else 1

    def confirm(self, sign: int) -> None:
        """Take note of a gear in which the course agrees with yaw."""
        self.sign = sign
        self.may_change = False

    @property
    def denies_yaw(self) -> bool:
        """Whether what was felt says that yaw is off by half a turn."""
        return self._right + self.sign * self._evidence() < -ENOUGH

    def turn_round(self) -> None:
        """Take note that yaw was turned round: what spoke against it now speaks for it."""
        self.sign = -self.sign
        self._right = -self._right

    def _stand(self) -> None:
        self._right = min(self._right + self.sign * self._evidence(), PROVEN)
        self._forwards = self._lately = 0.0
        self.may_change = True

    def _evidence(self) -> float:
        return min(max(self._forwards + self._lately, -PROVEN), PROVEN)
