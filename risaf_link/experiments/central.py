"""Centralised filters: every reading of every sensor is a measurement of the vehicle's rate.

The state's error is the rotation about north, east and down, the bias of the array (gravity and
heading see it, no reading does), and the rate as the array reads it, bias included: a random walk.
A reading is that rate and noise; 3 n of them make one update.

Since all sensors of an axis measure the same number, the update of 3 n measurements is, without any
approximation, that of three: the means, weighted by the inverse variances, with the inverse sum of
these for variance. `Compact` does that in O(n); `Direct` does what is usually written down, and
what the paper counts in its table I, with a matrix of 3 n by 3 n in O(n^3).
"""

import math
from typing import Literal

import numpy as np

from risaf_link.core.attitude import UNKNOWN_YAW, AttitudeParameters, Innovation
from risaf_link.core.fusion import Epoch, quantiles
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import Floats, wrap
from risaf_link.core.yaw_history import YawHistory
from risaf_link.experiments.method import ArrayModel, Estimate, Gps, HeadingGate
from risaf_link.experiments.so3 import exp

ATTITUDE = slice(0, 3)  # rotation vector, rad, NED
BIAS = slice(3, 6)  # rad/s, body
RATE = slice(6, 9)  # rad/s, body, as the array reads it: bias included
DOWN = 2
IDENTITY = np.eye(9)
NO_INFORMATION = 1e-9  # (rad/s)^-2; of an axis that no sensor measures

RATE_WALK = 5.0  # rad/s/sqrt(s): on a rough road a vehicle's rate may change by 0.5 rad/s in 10 ms
COMMON_BIAS = 5e-4  # rad/s, of all sensors together, beside the mean of their own: temperature
RATE_STD = 1.0  # rad/s, before the first reading


Form = Literal["compact", "direct"]


class Centralised:
    """The extended Kalman filter with all 3 n readings.

    Parameters
    ----------
    array : ArrayModel
    form : {"compact", "direct"}
    """

    def __init__(self, array: ArrayModel, form: Form = "compact") -> None:
        p = AttitudeParameters()
        self._headings = HeadingGate(HeadingParameters())
        self.form = FORMS[form]
        self.variance = array.noise**2 + array.bias**2  # (rad/s)^2, of one reading
        self._bias_walk = p.bias_walk**2
        self.matrix_nb = np.eye(3)
        self.bias_b = np.zeros(3)
        self.rate_b = np.zeros(3)  # bias included
        tilt, bias = p.initial_tilt_std**2, common_bias_std(array) ** 2
        self.covariance = np.diag([tilt, tilt, math.pi**2, *[bias] * 3, *[RATE_STD**2] * 3])
        self._aligned = False
        self._resets = 0
        self._yaws = YawHistory()

    def step(self, epoch: Epoch) -> None:
        """Carry the state on to an epoch: let the rate walk, measure it, turn by it."""
        self.covariance[RATE, RATE] += RATE_WALK**2 * epoch.dt * np.eye(3)
        self.covariance[BIAS, BIAS] += self._bias_walk * epoch.dt * np.eye(3)
        self.measure(epoch.rates_b)
        if epoch.dt > 0:
            self.turn(epoch.dt)
            self._headings.advance(epoch.dt)
        self._yaws.advance(epoch.dt, self.yaw)

    def correct(self, gps: Gps) -> None:
        """Use a fix."""
        self._headings.take(self, gps)

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        yaw = self.yaw if self._aligned else math.nan
        row = self.heading_row()
        std = math.sqrt(max(float(row @ self.covariance @ row), 0.0))
        return Estimate(yaw, min(std, math.pi), float(self.bias_b[2]))

    @property
    def yaw(self) -> float:
        """Yaw as of the last epoch, rad."""
        return math.atan2(self.matrix_nb[1, 0], self.matrix_nb[0, 0])

    def measure(self, rates_b: Floats) -> None:
        """Update by all readings of an epoch, (n, 3)."""
        offset, valid = self.offsets(rates_b)
        self.apply(*self.form.update(self.covariance, offset, valid / self.variance))

    def offsets(self, rates_b: Floats) -> tuple[Floats, Floats]:
        """Readings less the predicted rate, (3, n), 0 where not valid, and 1 where valid."""
        offset = rates_b.T - self.rate_b[:, None]
        valid = np.isfinite(offset)
        return np.where(valid, offset, 0.0), valid.astype(float)

    def apply(self, change: Floats, covariance: Floats) -> None:
        """Take what an update made of the error, (9,), and of its covariance."""
        self.matrix_nb = exp(change[ATTITUDE]) @ self.matrix_nb
        self.bias_b = self.bias_b + change[BIAS]
        self.rate_b = self.rate_b + change[RATE]
        self.covariance = covariance

    def turn(self, dt: float) -> None:
        """Turn the attitude by the rate less the bias, for `dt` seconds."""
        turn = (self.rate_b - self.bias_b) * dt
        halfway = self.matrix_nb @ exp(turn / 2.0) * dt
        self.matrix_nb = self.matrix_nb @ exp(turn)
        transition = IDENTITY.copy()
        transition[ATTITUDE, RATE] = halfway
        transition[ATTITUDE, BIAS] = -halfway
        self.covariance = transition @ self.covariance @ transition.T

    def heading_row(self) -> Floats:
        """Derivative of yaw by the error, (9,)."""
        north, east, down = self.matrix_nb[:, 0].tolist()
        level = max(north * north + east * east, 1e-6)
        row = np.zeros(9)
        row[ATTITUDE] = -down * north / level, -down * east / level, 1.0
        return row

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Fuse a heading, as `PaperFilter` does."""
        if not self._aligned or self.covariance[DOWN, DOWN] > UNKNOWN_YAW**2:
            return self.reset_heading(heading, variance, age, gate)
        error = wrap(heading - self._yaw_before(age))
        row = self.heading_row()
        spread = float(row @ self.covariance @ row) + variance
        innovation = Innovation(error, spread, gate)
        if innovation.fused:
            before = self.yaw
            gain = self.covariance @ row / spread
            remaining = IDENTITY - np.outer(gain, row)
            covariance = remaining @ self.covariance @ remaining.T
            self.apply(gain * error, covariance + variance * np.outer(gain, gain))
            self._yaws.correct(wrap(self.yaw - before))
        return innovation

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set yaw by a heading, whatever it was; its error is that of the heading alone."""
        error = wrap(heading - self._yaw_before(age))
        innovation = Innovation(error, self.covariance[DOWN, DOWN] + variance, gate, reset=True)
        self.matrix_nb = exp(np.array([0.0, 0.0, error])) @ self.matrix_nb
        self.covariance[DOWN, :] = self.covariance[:, DOWN] = 0.0
        self.covariance[DOWN, DOWN] = variance
        self._yaws.correct(error)
        self._aligned = True
        return innovation

    def _yaw_before(self, age: float) -> float:
        yaw = self._yaws.before(age)
        return self.yaw if yaw is None else yaw


def common_bias_std(array: ArrayModel) -> float:
    """What is known of the bias of a whole array at the start, rad/s, standard deviation."""
    return math.hypot(array.bias / math.sqrt(array.sensors), COMMON_BIAS)


class Compact:
    """Update by 3 n readings of the rate, as by three."""

    @staticmethod
    def change(covariance: Floats, offset: Floats, information: Floats) -> Floats:
        """Estimate of the error, (9,).

        Parameters
        ----------
        covariance : ndarray, shape (9, 9)
        offset : ndarray, shape (3, n)
            Readings less the predicted rate, rad/s.
        information : ndarray, shape (3, n)
            Their inverse variances, 0 where there is none.
        """
        total = np.maximum(information.sum(axis=1), NO_INFORMATION)
        mean = np.einsum("ij,ij->i", information, offset) / total
        spread = covariance[RATE, RATE] + np.diag(1.0 / total)
        change: Floats = np.linalg.solve(spread, mean) @ covariance[RATE]
        return change

    @staticmethod
    def update(covariance: Floats, offset: Floats, information: Floats) -> tuple[Floats, Floats]:
        """Estimate of the error, and its covariance in the form of Bucy and Joseph."""
        total = np.maximum(information.sum(axis=1), NO_INFORMATION)
        mean = np.einsum("ij,ij->i", information, offset) / total
        spread = covariance[RATE, RATE] + np.diag(1.0 / total)
        gain = np.linalg.solve(spread, covariance[RATE]).T
        remaining = IDENTITY.copy()
        remaining[:, RATE] -= gain
        updated = remaining @ covariance @ remaining.T + (gain / total) @ gain.T
        return gain @ mean, (updated + updated.T) / 2.0


class Direct:
    """The same by the textbook: with the innovations' covariance, 3 n by 3 n."""

    @staticmethod
    def change(covariance: Floats, offset: Floats, information: Floats) -> Floats:
        """Estimate of the error, (9,)."""
        rows, spread, innovation, _ = _innovations(covariance, offset, information)
        change: Floats = np.linalg.solve(spread, innovation) @ rows @ covariance
        return change

    @staticmethod
    def update(covariance: Floats, offset: Floats, information: Floats) -> tuple[Floats, Floats]:
        """Estimate of the error, and its covariance in the form of Bucy and Joseph."""
        rows, spread, innovation, noise = _innovations(covariance, offset, information)
        gain = np.linalg.solve(spread, rows @ covariance).T
        remaining = IDENTITY - gain @ rows
        updated = remaining @ covariance @ remaining.T + (gain * noise) @ gain.T
        return gain @ innovation, (updated + updated.T) / 2.0


def _innovations(
    covariance: Floats, offset: Floats, information: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Measurement matrix (m, 9), innovations' covariance (m, m), innovations, variances (m,)."""
    axis, sensor = np.nonzero(information > 0.0)
    rows = IDENTITY[RATE][axis]
    noise = 1.0 / information[axis, sensor]
    spread = rows @ covariance @ rows.T
    spread[np.diag_indices_from(spread)] += noise
    return rows, spread, offset[axis, sensor], noise


FORMS: dict[str, type[Compact] | type[Direct]] = {"compact": Compact, "direct": Direct}


def medians(offset: Floats, valid: Floats) -> Floats:
    """Median of the valid offsets of each axis, (3,); 0 where there is none."""
    median: Floats = quantiles(np.where(valid > 0.0, offset, np.nan), (0.5,))[0]
    return np.nan_to_num(median)
