"""The error of the filter `Eskf`, and what measurements have to do with it.

Rows are derivatives of a scalar measurement by the error, shape (29,).
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from risaf_link.core.attitude import Innovation
from risaf_link.core.rotation import Floats

ATTITUDE = slice(0, 3)  # error: rotation vector, rad, NED
BIAS = slice(3, 6)  # error of the fused rate's bias, rad/s, body
SCALE = slice(6, 15)  # error of the matrix that the rate is too large by, row by row
GYRO = slice(3, 15)  # both
ACCELEROMETER = slice(15, 27)  # the same of the accelerometers: m/s^2, body; 9 of the matrix
HEADING = slice(27, 29)  # what is wrong with the headings:
OFFSET = 27  # rad, by which all of them are off: antennas, a crabbing vehicle
LATE = 28  # s, by which they are later than told
STATES = 29
DOWN = 2
LEVEL, BIAS_AXES, HEADING_AXES = np.arange(2), np.arange(3, 6), np.arange(27, 29)  # for diagonals
IDENTITY = np.eye(STATES)

STEEP = 0.99  # sine of the pitch beyond which a heading says nothing of yaw: 82 deg


class Outcome(IntEnum):
    """What came of a measurement."""

    FUSED = 0
    RESET = 1
    """The state was set by it."""
    REJECTED = 2
    """Beyond the gate."""
    NOT_FINITE = 3
    """NaN, infinite or of a size that nothing real has."""
    UNOBSERVABLE = 4
    """A heading while the vehicle points up or down."""


class Correction(Innovation, frozen=True):
    """An innovation, and what came of it."""

    source: str = ""
    outcome: Outcome = Outcome.FUSED

    @property
    def fused(self) -> bool:
        """Whether the measurement was used."""
        return self.outcome in {Outcome.FUSED, Outcome.RESET}


@dataclass(frozen=True, slots=True)
class Gravity:
    """What the accelerometers say of the vertical."""

    gravity_n: Floats  # (3,) m/s^2, by the filter's attitude; (0, 0, g) if that is right
    forward: float  # (m/s^2)^2, variance of its part along the vehicle's heading
    right: float  # (m/s^2)^2, variance of its part across
    down: float = math.inf  # (m/s^2)^2, of its size; infinite: not known
    lever: Floats = field(default_factory=lambda: np.zeros((3, 12)))
    """Integral of `drive` from the time of the measurement: what the gyro's errors turned since."""
    by_errors: Floats = field(default_factory=lambda: np.zeros((3, 12)))
    """What the accelerometers' errors make of it."""

    def less(self, force_errors: Floats) -> Floats:
        """It without what the accelerometers are known to err by, (12,); (3,) m/s^2."""
        corrected: Floats = self.gravity_n + self.by_errors @ force_errors
        return corrected


def drive(matrix: Floats, reading_b: Floats) -> Floats:
    """What the errors of a triad make of its reading in another frame, shape (3, 12).

    A bias `b` and a matrix `M`, row by row, make the reading too large by `b + M reading`.
    """
    by_errors = np.empty((3, 12))
    by_errors[:, 0:3] = matrix
    by_errors[:, 3:] = (matrix[:, :, np.newaxis] * reading_b).reshape(3, 9)
    return by_errors


def yaw_row(matrix_nb: Floats, rate_b: Floats, age: float) -> Floats:
    """Yaw's derivative by the error, `age` after the attitude, shape (29,).

    With the forward axis x: `d yaw = angle_D - x_D (x_N angle_N + x_E angle_E) / (x_N^2 + x_E^2)`;
    the angle of then is that of now and what the gyro's errors have done since.
    """
    row = np.zeros(STATES)
    row[DOWN] = 1.0
    north, east, down = matrix_nb[:, 0].tolist()
    level = max(north * north + east * east, 1.0 - STEEP**2)
    row[0], row[1] = -down * north / level, -down * east / level
    row[GYRO] = row[ATTITUDE] @ drive(matrix_nb, rate_b) * age
    return row


def level_rows(yaw: float, gravity: Gravity, size: float) -> tuple[Floats, Floats]:
    """Derivatives of what gravity shows about the heading and across it, shape (29,) each.

    That is the angle at the time of the measurement, and what a bias of the accelerometers leans:
    `angle_N - (R_nb bias)_E / g`, `angle_E + (R_nb bias)_N / g`.
    """
    about = np.zeros((2, STATES))
    about[0, 0] = about[1, 1] = 1.0
    about[:, GYRO] = gravity.lever[0:2]
    about[0, ACCELEROMETER] = gravity.by_errors[1] / -size
    about[1, ACCELEROMETER] = gravity.by_errors[0] / size
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return cosine * about[0] + sine * about[1], cosine * about[1] - sine * about[0]


def tilt_rows(matrix_nb: Floats) -> tuple[Floats, Floats]:
    """Derivatives of roll and pitch by the angles about north, east, down, shape (3,) each."""
    north, east, _ = matrix_nb[:, 0].tolist()
    level = max(north * north + east * east, 1e-12)
    cosine = math.sqrt(level)
    return np.array([north, east, 0.0]) / level, np.array([-east, north, 0.0]) / cosine
