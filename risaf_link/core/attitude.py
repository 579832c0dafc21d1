"""FusedRate -> AttitudeState: the attitude filters.

`PaperFilter` is the reduced EKF of Hanani and Kipnis, "Robust Extended Kalman Filter for Land
Navigation Using Massive Array of MEMS IMUs", eq. 2, 3, 9 to 11 and section III.C; equation numbers
here are theirs.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from risaf_link.core.fusion import FusedRate
from risaf_link.core.rotation import (
    Floats,
    euler_from_quaternion,
    left_matrix,
    quaternion_from_euler,
    rate_matrix,
    right_matrix,
    wrap,
    yaw_of,
)

ATTITUDE = slice(0, 4)  # q_nb (w, x, y, z)
BIAS = slice(4, 7)  # bias of the fused rate, rad/s, body

YAW_HISTORY = 1024  # epochs; a second at 1 kHz
LONG_STEP = 0.5  # s; over a longer one nothing is known of the rate
UNKNOWN_RATE = 0.5  # rad/s, standard deviation of what a vehicle may do unseen


class AttitudeParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """What the attitude filter assumes of the fused rate."""

    filter: Literal["paper"] = "paper"
    gyro_noise: Annotated[float, Meta(gt=0)] = 0.003
    bias_walk: Annotated[float, Meta(ge=0)] = 5e-6
    initial_bias_std: Annotated[float, Meta(gt=0)] = 0.01
    initial_tilt_std: Annotated[float, Meta(gt=0)] = 0.05


@dataclass(frozen=True, slots=True)
class AttitudeState:
    """The filter's estimate at one epoch."""

    time_us: int
    q_nb: Floats  # (4,) unit quaternion
    rate_b: Floats  # (3,) rad/s, bias taken off
    bias_b: Floats  # (3,) rad/s
    roll_std: float  # rad
    pitch_std: float  # rad
    yaw_std: float  # rad; pi while yaw is not known
    aligned: bool  # yaw has been set by a heading
    resets: int  # how often yaw was set

    @property
    def euler(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw, rad."""
        return euler_from_quaternion(self.q_nb)


@dataclass(frozen=True, slots=True)
class Innovation:
    """What came of one measurement."""

    value: float  # measured minus predicted
    variance: float  # of the innovation
    gate: float  # standard deviations
    reset: bool = False  # the state was set by the measurement, gate or not

    @property
    def test_ratio(self) -> float:
        """|innovation| over gate times standard deviation."""
        return abs(self.value) / (self.gate * math.sqrt(self.variance))

    @property
    def fused(self) -> bool:
        """Whether the measurement was used."""
        return self.reset or self.test_ratio <= 1.0


class PaperFilter:
    """The 7-state EKF of the paper: quaternion and gyro bias, both additive.

    Yaw is unknown until the first heading sets it; roll and pitch start level, since nothing in
    this filter measures them.
    """

    def __init__(self, parameters: AttitudeParameters) -> None:
        self._parameters = parameters
        self._q = np.array([1.0, 0.0, 0.0, 0.0])
        self._bias = np.zeros(3)
        self._rate = np.zeros(3)
        self._aligned = False
        self._resets = 0
        self._covariance = np.zeros((7, 7))
        self._covariance[BIAS, BIAS] = np.eye(3) * parameters.initial_bias_std**2
        tilt = parameters.initial_tilt_std
        self._set_attitude_covariance(tilt, tilt, math.pi)
        self._elapsed = 0.0  # s
        self._yaws: deque[tuple[float, float]] = deque(maxlen=YAW_HISTORY)  # without corrections
        self._yaw_corrections = 0.0  # their sum

    def predict(self, fused: FusedRate, dt: float) -> None:
        """Carry the state on to the time of a fused rate.

        Parameters
        ----------
        fused : FusedRate
            The rate over the time since the state; its variance (eq. 8) is the process noise.
        dt : float
            That time, seconds.
        """
        p = self._parameters
        self._rate = fused.rate_b - self._bias
        variance = np.where(np.isnan(fused.variance), p.gyro_noise**2, fused.variance)
        if dt > LONG_STEP:
            variance = variance + UNKNOWN_RATE**2
        transition = np.eye(4) + dt / 2 * rate_matrix(self._rate)  # eq. 10
        by_rate = dt / 2 * left_matrix(self._q)[:, 1:]  # minus eq. 11: dt/2 G(q)
        jacobian = np.eye(7)  # eq. 9
        jacobian[ATTITUDE, ATTITUDE] = transition
        jacobian[ATTITUDE, BIAS] = -by_rate
        covariance = jacobian @ self._covariance @ jacobian.T
        covariance[ATTITUDE, ATTITUDE] += (by_rate * variance) @ by_rate.T
        covariance[BIAS, BIAS] += np.eye(3) * (p.bias_walk**2 * dt)
        self._covariance = (covariance + covariance.T) / 2
        self._q = transition @ self._q  # eq. 3, to first order
        self._q /= np.linalg.norm(self._q)
        self._elapsed += dt
        self._yaws.append((self._elapsed, yaw_of(self._q) - self._yaw_corrections))

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Fuse a heading; the first one sets yaw.

        Parameters
        ----------
        heading, variance : float
            rad from true north, and rad^2.
        age : float
            How long ago it was valid, seconds. It is compared with the yaw of that time; by what
            they differ, the yaw of now is corrected.
        gate : float
            Standard deviations of the innovation beyond which a heading is rejected.
        """
        if not self._aligned:
            return self.reset_heading(heading, variance, age, gate)
        error = wrap(heading - self._yaw_before(age))
        direction = _euler_jacobian(self._q)[2]
        gain = self._covariance[:, ATTITUDE] @ direction
        innovation = Innovation(error, float(direction @ gain[ATTITUDE]) + variance, gate)
        if innovation.fused:
            gain /= innovation.variance
            self._correct(gain, error)
            self._joseph(direction, gain, variance)
        return innovation

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set yaw by a heading, whatever it was; roll, pitch and bias stay."""
        error = wrap(heading - self._yaw_before(age))
        roll, pitch, yaw = euler_from_quaternion(self._q)
        roll_std, pitch_std, yaw_std = self._euler_std()
        self._q = quaternion_from_euler(roll, pitch, wrap(yaw + error))
        self._yaw_corrections += error
        self._set_attitude_covariance(roll_std, pitch_std, math.sqrt(variance))
        self._aligned = True
        self._resets += 1
        return Innovation(error, yaw_std**2 + variance, gate, reset=True)

    def state(self, time_us: int) -> AttitudeState:
        """Read the estimate as of the last predict."""
        roll_std, pitch_std, yaw_std = self._euler_std()
        return AttitudeState(
            time_us,
            self._q.copy(),
            self._rate.copy(),
            self._bias.copy(),
            roll_std,
            pitch_std,
            yaw_std if self._aligned else math.pi,
            self._aligned,
            self._resets,
        )

    def _correct(self, gain: Floats, error: float) -> None:
        before = yaw_of(self._q)
        self._q = self._q + gain[ATTITUDE] * error
        self._q /= np.linalg.norm(self._q)
        self._bias = self._bias + gain[BIAS] * error
        self._yaw_corrections += wrap(yaw_of(self._q) - before)

    def _joseph(self, direction: Floats, gain: Floats, variance: float) -> None:
        """Bucy and Joseph's form of the covariance update: symmetric and positive."""
        remaining = np.eye(7)
        remaining[:, ATTITUDE] -= np.outer(gain, direction)
        covariance = remaining @ self._covariance @ remaining.T
        self._covariance = covariance + variance * np.outer(gain, gain)

    def _set_attitude_covariance(self, roll_std: float, pitch_std: float, yaw_std: float) -> None:
        """Make the attitude's errors independent of the bias: small rotations about NED axes.

        Roll and pitch stand for the tilt about north and east; the larger of both is taken.
        """
        tilt = max(roll_std, pitch_std) ** 2
        by_angle = right_matrix(self._q)[:, 1:] / 2
        self._covariance[ATTITUDE, :] = 0.0
        self._covariance[:, ATTITUDE] = 0.0
        self._covariance[ATTITUDE, ATTITUDE] = (by_angle * [tilt, tilt, yaw_std**2]) @ by_angle.T

    def _euler_std(self) -> tuple[float, float, float]:
        jacobian = _euler_jacobian(self._q)
        variance = ((jacobian @ self._covariance[ATTITUDE, ATTITUDE]) * jacobian).sum(axis=1)
        roll, pitch, yaw = np.minimum(np.sqrt(np.maximum(variance, 0.0)), math.pi)
        return float(roll), float(pitch), float(yaw)

    def _yaw_before(self, age: float) -> float:
        """Yaw of `age` seconds ago, interpolated; the oldest known where that is too long ago."""
        time = self._elapsed - age
        later = None
        for earlier in reversed(self._yaws):
            if earlier[0] <= time:
                part = (time - earlier[0]) / (later[0] - earlier[0]) if later else 0.0
                change = wrap(later[1] - earlier[1]) if later else 0.0
                return earlier[1] + part * change + self._yaw_corrections
            later = earlier
        return later[1] + self._yaw_corrections if later else yaw_of(self._q)


FILTERS: dict[str, type[PaperFilter]] = {"paper": PaperFilter}


def _euler_jacobian(q_nb: Floats) -> Floats:
    """Derivatives of roll, pitch and yaw by the quaternion, shape (3, 4).

    Those of `euler_from_quaternion`, whose arc tangents do not change with the quaternion's length.
    """
    w, x, y, z = q_nb
    roll = _arctan_gradient(
        2 * (w * x + y * z), w * w - x * x - y * y + z * z, (x, w, z, y), (w, -x, -y, z)
    )
    cosine = math.sqrt(max(1.0 - (2 * (w * y - x * z)) ** 2, 1e-12))
    pitch = np.array([2 * y, -2 * z, 2 * w, -2 * x]) / cosine
    yaw = _arctan_gradient(
        2 * (w * z + x * y), w * w + x * x - y * y - z * z, (z, y, x, w), (w, x, -y, -z)
    )
    return np.array([roll, pitch, yaw])


def _arctan_gradient(
    a: float, b: float, half_da: tuple[float, ...], half_db: tuple[float, ...]
) -> Floats:
    """Gradient of atan2(a, b); zero where the angle is undefined (gimbal lock)."""
    square = a * a + b * b
    if square < 1e-12:
        return np.zeros(4)
    return 2.0 * (b * np.array(half_da) - a * np.array(half_db)) / square
