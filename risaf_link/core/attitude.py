"""FusedRate -> AttitudeState: the attitude filters.

`PaperFilter` is the reduced EKF of Hanani and Kipnis, "Robust Extended Kalman Filter for Land
Navigation Using Massive Array of MEMS IMUs", eq. 2, 3, 9 to 11 and section III.C; equation numbers
here are theirs.
"""

import math
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct, field

from risaf_link.core.fusion import FusedRate
from risaf_link.core.rotation import (
    Floats,
    euler_from_quaternion,
    left_matrix,
    matrix_from_quaternion,
    rate_matrix,
    right_matrix,
    wrap,
    yaw_of,
)
from risaf_link.core.tunable import Tunable
from risaf_link.core.yaw_history import YawHistory

ATTITUDE = slice(0, 4)  # q_nb (w, x, y, z)
BIAS = slice(4, 7)  # bias of the fused rate, rad/s, body

LONG_STEP = 1.0  # s that a rate is believed to have lasted
UNSEEN_TURN = 0.5  # rad/s, standard deviation of a vehicle's turning that no rate tells of
UNKNOWN_YAW = 0.5  # rad, standard deviation of a yaw that a heading sets instead of correcting it

PAIRS = (np.array([0, 0, 1]), np.array([1, 2, 2]))  # of roll, pitch and yaw
_I4, _I7 = np.eye(4), np.eye(7)


class AttitudeParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """What the attitude filters assume of the array and of the world. Defaults: consumer MEMS."""

    filter: Literal["eskf", "paper"] = "eskf"
    """Eskf: error state, aided by heading, gravity and rest; paper: the seven-state EKF, aided by
    heading alone."""
    initial_bias_std: Annotated[
        float, Meta(gt=0, le=10), Tunable("ATT_BIAS_STD", "rad/s", at_start=True)
    ] = 0.01
    """bias at the start: 0.6 deg/s, the zero-rate offset of a good consumer gyro."""
    initial_tilt_std: Annotated[
        float, Meta(gt=0, le=10), Tunable("ATT_TILT_STD", "rad", at_start=True)
    ] = 0.05
    """roll and pitch at the start, where no accelerometer tells: a road vehicle stands level within
    3 deg."""
    bias_walk: Annotated[float, Meta(ge=0, le=1), Tunable("ATT_BIAS_WALK", "rad/s/sqrt(s)")] = 5e-6
    """paper: how fast the fused rate's bias wanders."""
    common_noise: Annotated[float, Meta(ge=0, le=1), Tunable("ATT_NOISE", "rad/s/sqrt(Hz)")] = 2e-5
    """eskf: noise that all sensors have in common: vibration."""
    common_bias_walk: Annotated[
        float, Meta(ge=0, le=1), Tunable("ATT_COMMON_WALK", "rad/s/sqrt(s)")
    ] = 5e-7
    """eskf: bias walk that all sensors have in common: the board's temperature."""
    scale_std: Annotated[float, Meta(ge=0, le=1), Tunable("ATT_SCALE_STD", at_start=True)] = 5e-3
    """eskf: scale factor and misalignment (rad) that calibration left: 0.5 %, 0.3 deg."""
    turn_error: Annotated[float, Meta(ge=0, le=1), Tunable("ATT_TURN_ERR", "rad/sqrt(rad)")] = 3e-4
    """eskf: for each sqrt(rad) turned, what of the rate's error is not linear."""
    accel_bias_std: Annotated[
        float, Meta(gt=0, le=100), Tunable("ATT_ACC_BIAS", "m/s^2", at_start=True)
    ] = 0.05
    """eskf: of the fused accelerometers, 5 mg; it tilts the apparent vertical by 0.3 deg."""
    gate: Annotated[float, Meta(gt=0, le=1000), Tunable("ATT_GATE", "standard deviations")] = 5.0
    """eskf: within which gravity and rest are fused."""
    gravity_distrust: Annotated[float, Meta(gt=0, le=1e6), Tunable("ATT_GRAV_TIME", "s")] = 3.0
    """eskf: of rejected gravity after which the tilt is taken to be wrong."""
    distrust: Annotated[float, Meta(gt=0, le=1e6), Tunable("ATT_REST_TIME", "s")] = 10.0
    """eskf: of rest that contradicts the bias until the bias is taken to be wrong."""


class AttitudeState(Struct, frozen=True):
    """The filter's estimate at one epoch."""

    time_us: int
    q_nb: Floats  # (4,) unit quaternion
    rate_b: Floats  # (3,) rad/s, bias taken off
    bias_b: Floats  # (3,) rad/s
    roll_std: float  # rad
    pitch_std: float  # rad
    yaw_std: float  # rad; pi while yaw is not known
    aligned: bool  # yaw has been set by a heading
    resets: int  # how often yaw was set, also by filters before this one
    common: Floats = field(default_factory=lambda: np.zeros(3))
    """(3,) rad^2, covariances of roll with pitch, of roll with yaw, of pitch with yaw"""
    bias_std: Floats = field(default_factory=lambda: np.full(3, math.nan))
    """(3,) rad/s"""

    @property
    def angle_covariance(self) -> Floats:
        """Covariance of roll, pitch and yaw, (3, 3), rad^2."""
        covariance = np.diag(np.square((self.roll_std, self.pitch_std, self.yaw_std)))
        covariance[PAIRS] = covariance[PAIRS[::-1]] = self.common
        return covariance

    @property
    def euler(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw, rad."""
        return euler_from_quaternion(self.q_nb)


class Innovation(Struct, frozen=True):
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

    Roll and pitch start level, since nothing in this filter measures them; yaw is unknown until the
    first heading sets it.

    Beyond the paper: whenever the quaternion is normalised, its covariance is as well; otherwise
    the error along the quaternion, which is none, would grow without end. A heading sets yaw where
    yaw is too uncertain for the linear correction. A rate is not believed for longer than
    `LONG_STEP`.
    """

    def __init__(self, parameters: AttitudeParameters) -> None:
        p = self._parameters = parameters
        # No array is changed once it is part of a state.
        self._q = np.array([1.0, 0.0, 0.0, 0.0])
        self._bias = np.zeros(3)
        self._rate = np.zeros(3)
        angles = np.array([p.initial_tilt_std, p.initial_tilt_std, math.pi])
        std = np.concatenate([[0.0], angles / 2, np.full(3, p.initial_bias_std)])
        self._covariance = np.diag(std**2)
        self._bias_walk = np.diag([0.0] * 4 + [p.bias_walk**2] * 3)  # a second
        self._resets = 0
        self._waiting = 0.0  # s, for a rate
        self._yaws = YawHistory()

    def configure(self, parameters: AttitudeParameters) -> None:
        """Take new parameters; the state stays, and with it what they say of the start."""
        self._parameters = parameters
        self._bias_walk = np.diag([0.0] * 4 + [parameters.bias_walk**2] * 3)

    def set_bias(self, rate_b: Floats, variance: Floats) -> None:
        """Believe the mean rate of a vehicle that rests to be the bias, whatever it was held to be.

        Parameters are those of `Estimator.set_bias`.
        """
        self._bias = rate_b.copy()
        covariance = self._covariance.copy()
        covariance[BIAS] = covariance[:, BIAS] = 0.0
        covariance[BIAS, BIAS] = np.diag(variance)
        self._covariance = covariance

    def doubt_bias(self, rate: float) -> None:
        """Take the bias about the vertical for off by so much, rad/s, one standard deviation."""
        down_b = matrix_from_quaternion(self._q)[2]
        covariance = self._covariance.copy()
        covariance[BIAS, BIAS] += rate**2 * np.outer(down_b, down_b)
        self._covariance = covariance

    def predict(self, fused: FusedRate, dt: float) -> None:
        """Carry the state on to the time of a fused rate: eq. 3 to first order, eq. 9 to 11.

        Parameters
        ----------
        fused : FusedRate
            The rate over the time since the state; its variance (eq. 8) is the process noise. Where
            it is not finite on an axis, the state waits for the next one.
        dt : float
            That time, seconds.

        Raises
        ------
        ValueError
            If the time is not finite, or negative.
        """
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt: found {dt}, expected a finite time, at least 0")
        dt += self._waiting
        rate = fused.rate_b - self._bias
        if not np.isfinite(rate).all():
            self._waiting = dt
            return
        self._waiting = 0.0
        self._rate = rate
        variance = np.where(np.isnan(fused.variance), fused.noise, fused.variance)
        self._integrate(rate, np.nan_to_num(variance), dt)
        self._yaws.advance(dt, yaw_of(self._q))

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Fuse a heading, section III.C; while yaw is unknown, set it.

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
        if self._turn_variance() > UNKNOWN_YAW**2:
            return self.reset_heading(heading, variance, age, gate)
        innovation = self.compare_heading(heading, variance, age, gate)
        if innovation.fused:
            direction = _euler_jacobian(self._q)[2]
            gain = self._covariance[:, ATTITUDE] @ direction / innovation.variance
            self._correct(gain, innovation.value, direction, variance)
        return innovation

    def compare_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Hold a heading against the state, which stays as it is.

        Parameters are those of `correct_heading`.
        """
        error = wrap(heading - self._yaw_before(age))
        direction = _euler_jacobian(self._q)[2]
        spread = float(direction @ self._covariance[ATTITUDE, ATTITUDE] @ direction) + variance
        return Innovation(error, spread, gate)

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set yaw by a heading, whatever it was; roll, pitch and bias stay.

        Parameters are those of `correct_heading`. The error of yaw becomes that of the heading,
        and independent of all others.
        """
        error = wrap(heading - self._yaw_before(age))
        jacobian = _euler_jacobian(self._q)
        before, _ = angle_spread(jacobian, self._covariance[ATTITUDE, ATTITUDE])
        innovation = Innovation(error, before[2] ** 2 + variance, gate, reset=True)
        turn = left_matrix(np.array([math.cos(error / 2), 0.0, 0.0, math.sin(error / 2)]))
        by_yaw = _by_angles(self._q)[:, 2]
        keep = _I7.copy()
        keep[ATTITUDE, ATTITUDE] = turn @ (_I4 - 4 * np.outer(by_yaw, by_yaw))
        covariance = keep @ self._covariance @ keep.T
        by_yaw = turn @ by_yaw
        covariance[ATTITUDE, ATTITUDE] += variance * np.outer(by_yaw, by_yaw)
        self._covariance = _symmetric(covariance)
        self._q = turn @ self._q
        self._yaws.correct(error)
        self._resets += 1
        return innovation

    def state(self, time_us: int) -> AttitudeState:
        """Read the estimate as of the last predict."""
        jacobian = _euler_jacobian(self._q)
        std, common = angle_spread(jacobian, self._covariance[ATTITUDE, ATTITUDE])
        roll, pitch, yaw = std
        return AttitudeState(
            time_us,
            self._q,
            self._rate,
            self._bias,
            roll,
            pitch,
            yaw,
            self._resets > 0,
            self._resets,
            common,
            np.sqrt(np.diag(self._covariance)[BIAS]),
        )

    def _integrate(self, rate: Floats, variance: Floats, dt: float) -> None:
        believed = min(dt, LONG_STEP)
        transition = _I4 + believed / 2 * rate_matrix(rate)  # eq. 10
        by_angle = left_matrix(self._q)[:, 1:] / 2  # G(q) / 2
        self._q, normalise = _normalised(transition @ self._q)
        by_angle = normalise @ by_angle
        jacobian = _I7.copy()  # eq. 9
        jacobian[ATTITUDE, ATTITUDE] = normalise @ transition
        jacobian[ATTITUDE, BIAS] = -believed * by_angle  # eq. 11
        covariance = jacobian @ self._covariance @ jacobian.T + self._bias_walk * dt
        angles = np.minimum(variance * believed**2, math.pi**2)  # beyond, nothing is known
        covariance[ATTITUDE, ATTITUDE] += (by_angle * angles) @ by_angle.T
        if dt > believed:
            covariance[ATTITUDE, ATTITUDE] += self._unseen(dt - believed)
        self._covariance = _symmetric(covariance)

    def _unseen(self, dt: float) -> Floats:
        """Covariance of what a vehicle may turn and tilt in a time that no rate tells of."""
        tilt = self._parameters.initial_tilt_std * min(dt, 1.0)
        angles = np.array([tilt, tilt, min(UNSEEN_TURN * dt, math.pi)])
        by_angles = _by_angles(self._q)
        covariance: Floats = (by_angles * angles**2) @ by_angles.T
        return covariance

    def _correct(self, gain: Floats, error: float, direction: Floats, variance: float) -> None:
        """Use a gain; the covariance by the form of Bucy and Joseph, 1968, which stays positive."""
        before = yaw_of(self._q)
        remaining = _I7.copy()
        remaining[:, ATTITUDE] -= np.outer(gain, direction)
        self._bias = self._bias + gain[BIAS] * error
        self._q, normalise = _normalised(self._q + gain[ATTITUDE] * error)
        remaining[ATTITUDE] = normalise @ remaining[ATTITUDE]
        gain[ATTITUDE] = normalise @ gain[ATTITUDE]
        self._covariance = _symmetric(
            remaining @ self._covariance @ remaining.T + variance * np.outer(gain, gain)
        )
        self._yaws.correct(wrap(yaw_of(self._q) - before))

    def _turn_variance(self) -> float:
        """Variance of the attitude's error about the down axis, rad^2."""
        by_yaw = _by_angles(self._q)[:, 2]
        return float(16 * by_yaw @ self._covariance[ATTITUDE, ATTITUDE] @ by_yaw)

    def _yaw_before(self, age: float) -> float:
        yaw = self._yaws.before(age)
        return yaw_of(self._q) if yaw is None else yaw


def angle_spread(jacobian: Floats, covariance: Floats) -> tuple[list[float], Floats]:
    """How far roll, pitch and yaw may be off.

    Parameters
    ----------
    jacobian : ndarray, shape (3, n)
        Their derivatives by the error of an attitude.
    covariance : ndarray, shape (n, n)
        Of that error.

    Returns
    -------
    std : list of float
        Their three standard deviations, rad; half a turn at most, from where on nothing is known.
    common : ndarray, shape (3,)
        Covariances of roll with pitch, of roll with yaw, of pitch with yaw, rad^2.
    """
    carried = jacobian @ covariance
    whole = np.sqrt(np.maximum((carried * jacobian).sum(axis=1), 0.0))
    kept = math.pi / np.maximum(whole, math.pi)  # of each, so that they stay a covariance
    one, other = PAIRS
    common: Floats = (carried @ jacobian.T)[PAIRS] * kept[one] * kept[other]
    return np.minimum(whole, math.pi).tolist(), common


def _normalised(q: Floats) -> tuple[Floats, Floats]:
    """A quaternion brought to unit length, (4,), and its derivative by the one before, (4, 4)."""
    length = math.sqrt(q @ q)
    unit = q / length
    return unit, (_I4 - unit[:, None] * unit) / length


def _symmetric(covariance: Floats) -> Floats:
    return (covariance + covariance.T) / 2


def _by_angles(q_nb: Floats) -> Floats:
    """Derivatives of the quaternion by small rotations about north, east and down, (4, 3).

    Its columns are orthogonal, of length 1/2.
    """
    return right_matrix(q_nb)[:, 1:] / 2


def _euler_jacobian(q_nb: Floats) -> Floats:
    """Derivatives of roll, pitch and yaw by the quaternion, shape (3, 4).

    Those of `euler_from_quaternion`, whose arc tangents do not change with the quaternion's length.
    """
    w, x, y, z = q_nb.tolist()
    roll = _arctan_gradient(
        2 * (w * x + y * z), w * w - x * x - y * y + z * z, (x, w, z, y), (w, -x, -y, z)
    )
    cosine = math.sqrt(max(1.0 - (2 * (w * y - x * z)) ** 2, 1e-12))
    pitch = [2 * y / cosine, -2 * z / cosine, 2 * w / cosine, -2 * x / cosine]
    yaw = _arctan_gradient(
        2 * (w * z + x * y), w * w + x * x - y * y - z * z, (z, y, x, w), (w, x, -y, -z)
    )
    return np.array([roll, pitch, yaw])


def _arctan_gradient(
    a: float, b: float, half_da: tuple[float, ...], half_db: tuple[float, ...]
) -> list[float]:
    """Gradient of atan2(a, b); zero where the angle is undefined (gimbal lock)."""
    square = a * a + b * b
    if square < 1e-12:
        return [0.0] * len(half_da)
    return [2.0 * (b * da - a * db) / square for da, db in zip(half_da, half_db, strict=True)]
