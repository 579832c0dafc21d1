"""FusedRate -> AttitudeState: an error-state filter on SO(3), aided by heading, gravity and rest.

The error is a small rotation in the navigation frame, `R_nb = exp(angle_n) R_nb_estimated` (Sola,
"Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, chapter 7: global
angular errors), and what makes the readings of gyros and accelerometers wrong and stays as it is:
bias, scale and misalignment. What is constant is a state, no noise: an error of scale grows with
the angle turned and goes with turning back, and no number of measurements averages it away. In the
navigation frame

- the error stays as it is while the body turns: only the gyro's errors drive it,
  `-R_nb (bias + scale rate)`;
- gravity sees the angles about north and east, never that about down, whatever the attitude: yaw,
  which is not observed before the first heading, cannot leak into the tilt (Barrau and Bonnabel,
  "Intrinsic filtering on Lie groups with applications to attitude estimation", arXiv:1310.2539);
- a late heading is compared with the attitude of its own time: every correction since then is a
  rotation on the left, which that attitude takes just as well.

What is wrong with the headings is part of the state: an offset, which no averaging takes away, so
that yaw is never held to be better known than that; and how much later they are than told, which
turns show.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from risaf_link.core import quaternion
from risaf_link.core.attitude import AttitudeParameters, AttitudeState, angle_spread
from risaf_link.core.earth import EARTH_RATE, GRAVITY
from risaf_link.core.error_state import (
    ACCELEROMETER,
    ATTITUDE,
    BIAS,
    BIAS_AXES,
    DOWN,
    GYRO,
    HEADING,
    HEADING_AXES,
    IDENTITY,
    LATE,
    LEVEL,
    OFFSET,
    SCALE,
    STATES,
    STEEP,
    Correction,
    Gravity,
    Outcome,
    drive,
    level_rows,
    tilt_rows,
    yaw_row,
)
from risaf_link.core.fusion import FusedRate
from risaf_link.core.gap import Gaps, Step
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.memory import FilterMemory, known_errors
from risaf_link.core.quaternion import Quaternion, Vector
from risaf_link.core.rotation import Floats, wrap

HISTORY = 1024  # epochs; a second at 1 kHz
LONG_STEP = 0.5  # s; over a longer one nothing is known of the rate
UNKNOWN_RATE = 0.5  # rad/s, standard deviation of what a vehicle may do unseen
LARGEST_RATE = 1e3  # rad/s; no gyro measures more
LARGEST_FORCE = 1e4  # m/s^2; no accelerometer measures more
LARGEST_STEP = 3600.0  # s; afterwards nothing is known anyway
LARGEST_GAP = 2.5  # s; what is further apart is not one run
OFFSET_TIME, LATE_TIME = 300.0, 1000.0  # s, in which what is wrong with headings becomes another
RATE_SPAN = 0.1  # s before and after, over which a past rate is taken

USUAL_HEADING = HeadingParameters()


class Eskf:
    """Error-state Kalman filter of attitude and gyro bias.

    Yaw is unknown until the first heading sets it; tilt until the first gravity does.

    Parameters
    ----------
    parameters : AttitudeParameters
    heading : HeadingParameters
        Of them `offset_std` and `delay_std`.
    """

    def __init__(
        self, parameters: AttitudeParameters, heading: HeadingParameters = USUAL_HEADING
    ) -> None:
        p = self._parameters = parameters
        self._by_rate: Quaternion = (1.0, 0.0, 0.0, 0.0)  # the rate's integral alone
        self._correction: Quaternion = (1.0, 0.0, 0.0, 0.0)  # on its left: q_nb is their product
        self._bias = np.zeros(3)
        self._scale = np.zeros((3, 3))
        self._force_errors = np.zeros(12)
        self._rate = np.zeros(3)
        self._drive_ib = drive(np.eye(3), self._rate)
        self._unseen = np.zeros(3)  # s, each axis, since its rate was known
        self._gaps = Gaps()
        self._turned: Vector = (0.0, 0.0, 0.0)  # rotation vector of the last step
        self._in_gap = False  # whether that had a gap
        tilt = p.initial_tilt_std**2
        bias = p.initial_bias_std**2
        scale, force = p.scale_std**2, p.accel_bias_std**2
        wrong = [heading.offset_std**2, heading.delay_std**2]
        self._covariance = np.diag(
            [tilt, tilt, math.pi**2] + [bias] * 3 + [scale] * 9 + [force] * 3 + [scale] * 9 + wrong
        )
        self._wrong = np.zeros(2)  # what the headings are held to be off by: rad, s
        self._wrong_variance = np.array(wrong)  # that it comes back to
        self._latitude = math.nan
        self._aligned = False
        self._levelled = False
        self._resets = 0
        self._elapsed = 0.0  # s
        self._history: deque[tuple[float, Quaternion]] = deque(maxlen=HISTORY)
        self._rejecting: dict[str, tuple[float, float]] = {}  # source: since when, last
        self._rested = -math.inf  # when rest was last fused

    def configure(self, parameters: AttitudeParameters, heading: HeadingParameters) -> None:
        """Take new parameters; the state stays, and with it what they say of the start."""
        self._parameters = parameters
        self._wrong_variance = np.array([heading.offset_std**2, heading.delay_std**2])

    def set_latitude(self, latitude: float) -> None:
        """Tell where on earth the vehicle is, rad; before, the earth does not turn."""
        if abs(latitude) <= math.pi / 2:
            self._latitude = latitude

    @property
    def quaternion(self) -> Floats:
        """`q_nb` as of the last predict."""
        return np.array(self._attitude)

    @property
    def matrix(self) -> Floats:
        """`R_nb` as of the last predict."""
        return quaternion.matrix(self._attitude)

    @property
    def matrix_ib(self) -> Floats:
        """`R_ib` as of the last predict: i is n at the start, carried on by the rate alone."""
        return quaternion.matrix(self._by_rate)

    @property
    def drive_ib(self) -> Floats:
        """How the errors of `GYRO` turn `R_ib` in a second, amid the last step, (3, 12)."""
        return self._drive_ib

    @property
    def matrix_ni(self) -> Floats:
        """`R_ni`: all corrections, and the earth's rotation, until now."""
        return quaternion.matrix(self._correction)

    @property
    def rate(self) -> Floats:
        """Rate as of the last predict, rad/s, bias taken off."""
        return self._rate

    @property
    def levelled(self) -> bool:
        """Whether gravity has set the tilt."""
        return self._levelled

    @property
    def up_b(self) -> Floats:
        """The vertical in body axes, upwards, (3,): where the force points that holds it."""
        x, y, z = self.matrix[DOWN].tolist()
        return np.array([-x, -y, -z])

    @property
    def known_errors(self) -> Floats:
        """What is known of the readings' errors, (24,): `GYRO`, then `ACCELEROMETER`."""
        return np.concatenate((self._bias, self._scale.ravel(), self._force_errors))

    @property
    def resting(self) -> bool:
        """Whether rest was found, and fused, a moment ago."""
        return self._elapsed - self._rested < LARGEST_GAP

    @property
    def _attitude(self) -> Quaternion:
        return quaternion.product(self._correction, self._by_rate)

    @property
    def covariance(self) -> Floats:
        """Covariance of the error, (29, 29): `ATTITUDE`, `GYRO`, `ACCELEROMETER`, `HEADING`."""
        return self._covariance.copy()

    @property
    def heading_errors(self) -> Floats:
        """What the headings are held to be off by: rad, s."""
        return self._wrong

    def set_attitude(self, q_nb: Floats) -> None:
        """Take an attitude for known."""
        w, x, y, z = self._by_rate
        a, b, c, d = q_nb.tolist()
        self._correction = quaternion.product((a, b, c, d), (w, -x, -y, -z))

    def set_covariance(self, covariance: Floats) -> None:
        """Take a covariance for that of the error, (29, 29)."""
        self._covariance = covariance.copy()

    def doubt_bias(self, rate: float) -> None:
        """Take the bias about the vertical for off by so much, rad/s, one standard deviation."""
        down_b = self.matrix[DOWN]
        self._covariance[BIAS, BIAS] += rate**2 * np.outer(down_b, down_b)

    def memory(self, bias_walk: Floats) -> FilterMemory:
        """Tell what is known; `bias_walk`, (3,), is that of the last fused rate."""
        return FilterMemory(
            self.quaternion,
            self._rate.copy(),
            known_errors(self._bias, self._scale, self._force_errors, self._wrong),
            self.covariance,
            bias_walk,
            None if math.isnan(self._latitude) else self._latitude,
            self._aligned,
            self._levelled,
            self.resting,
        )

    def recall(self, memory: FilterMemory, resets: int) -> None:
        """Go on from what was known before a restart, at that time.

        Parameters
        ----------
        memory : FilterMemory
        resets : int
            How often yaw has been set since.
        """
        self.set_attitude(memory.q_nb)
        self.set_covariance(memory.covariance)
        self._rate = memory.rate_b.copy()
        bias, scale, self._force_errors, self._wrong = np.split(memory.errors, (3, 12, 24))
        self._bias, self._scale = bias, scale.reshape(3, 3)
        self._latitude = math.nan if memory.latitude is None else memory.latitude
        self._aligned, self._levelled = memory.aligned, memory.levelled
        self._resets = resets

    def predict(self, fused: FusedRate, dt: float) -> None:
        """Carry the state on to the time of a fused rate.

        The rate is held to be the mean over the step, as that of a gyro with a filter is; what the
        axis of rotation turned from step to step is put right (coning: Savage, "Computational
        Elements for Strapdown Systems", RTO-SET-116, 2008). A step that is longer than usual was
        not read as a whole: see `gap`.

        Parameters
        ----------
        fused : FusedRate
            The rate over the time since the state; its noise and bias walk make the process
            noise. On an axis where it is not finite, the last one holds for a moment.
        dt : float
            That time, seconds. A step that is not positive is no step.
        """
        if not dt > 0:
            return
        dt = min(dt, LARGEST_STEP)
        known = np.abs(fused.rate_b) < LARGEST_RATE  # false for NaN
        held = np.where(self._unseen < LONG_STEP, self._rate, 0.0)
        read = np.where(known, fused.rate_b - self._bias, held)
        rate_before, self._rate = self._rate, np.where(known, read - self._scale @ read, held)
        step = self._gaps.take(rate_before, self._rate, known, dt)
        unseen = self._see(known, dt, step.has_gap) + step.unseen
        before = self._by_rate
        self._by_rate = quaternion.unit(
            quaternion.product(before, quaternion.exp(self._rotation(step)))
        )
        self._drive_ib = drive(
            quaternion.matrix(quaternion.between(before, self._by_rate, 0.5)), step.rate_b
        )
        x, y, z = self._earth_rate()
        self._turn((-x * dt, -y * dt, -z * dt))
        self._elapsed += dt
        self._history.append((self._elapsed, self._by_rate))
        self._spread(self.matrix_ni @ self._drive_ib, fused, unseen, step.told, dt)

    def compare_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Correction | None:
        """Hold a heading against the state, which stays as it is; None: it cannot be.

        Parameters are those of `correct_heading`.
        """
        if not _usable(heading, variance, age):
            return None
        row, error = self._by_heading(heading, age)
        if row is None:
            return None
        spread = float(row @ self._covariance @ row) + variance
        inside = error * error <= gate * gate * spread
        outcome = Outcome.FUSED if inside else Outcome.REJECTED
        return Correction(error, spread, gate, False, "heading", outcome)

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Correction:
        """Fuse a heading; the first one sets yaw.

        Parameters
        ----------
        heading, variance : float
            rad from true north, and rad^2, of its noise.
        age : float
            How long ago it was valid, seconds, so far as is told. It is compared with the yaw of
            that time.
        gate : float
            Standard deviations of the innovation beyond which a heading is rejected.
        """
        if not _usable(heading, variance, age):
            return Correction(heading, variance, gate, False, "heading", Outcome.NOT_FINITE)
        row, error = self._by_heading(heading, age)
        if row is None:
            spread = float(self._covariance[DOWN, DOWN]) + variance
            return Correction(error, spread, gate, False, "heading", Outcome.UNOBSERVABLE)
        if not self._aligned:
            return self.reset_heading(heading, variance, age, gate)
        (correction,) = self._fuse_all("heading", (row,), (error,), (variance,), gate)
        return correction

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Correction:
        """Set yaw by a heading, whatever it was; the tilt and the bias stay."""
        if not _usable(heading, variance, age):
            return Correction(heading, variance, gate, False, "heading", Outcome.NOT_FINITE)
        age = self._true_age(age)
        error = wrap(heading - float(self._wrong[0]) - quaternion.yaw(self._attitude_before(age)))
        spread = float(self._covariance[DOWN, DOWN]) + variance
        self._turn((0.0, 0.0, error))
        cosine, sine = math.cos(error), math.sin(error)
        rotation = IDENTITY.copy()
        rotation[0:2, 0:2] = [[cosine, -sine], [sine, cosine]]
        rotation[DOWN, DOWN] = 0.0  # what was known of yaw, and its part in all else
        rotation[DOWN, HEADING] = -1.0, self._yaw_rate_before(age)
        self._covariance = rotation @ self._covariance @ rotation.T
        self._covariance[DOWN, DOWN] += min(variance, math.pi**2)
        if not self._aligned:
            self._doubt_bias_for_earth_rate()
        self._aligned = True
        self._resets += 1
        return Correction(error, spread, gate, True, "heading", Outcome.RESET)

    def correct_gravity(self, gravity: Gravity) -> tuple[Correction, ...]:
        """Fuse the direction of gravity; the first one sets the tilt if it knows better.

        The rotation from the vertical that the accelerometers show to the filter's own is measured
        about the vehicle's heading and across it: two scalars, fused if both are within the gate.
        A tilt that gravity contradicts for `gravity_distrust` seconds is doubted: its variance
        becomes as large as the contradiction.
        """
        north, east, down = gravity.less(self._force_errors).tolist()
        gate = self._parameters.gate
        level, size = math.hypot(north, east), math.hypot(north, east, down)
        sound = 0.1 * GRAVITY < size < LARGEST_FORCE
        if not sound or not all(0 < v < LARGEST_FORCE**2 for v in (gravity.forward, gravity.right)):
            return (Correction(size, 1.0, gate, False, "gravity", Outcome.NOT_FINITE),)
        # The rotation vector that takes the measured vertical to down: its axis is level.
        angle = math.atan2(level, down) / level if level > 1e-9 * size else 1.0 / size
        about_n = (east * angle, -north * angle)
        scale = 1.0 / size**2
        variances = [gravity.right * scale, gravity.forward * scale]
        if not self._levelled:
            if self._sets_tilt(about_n, variances):
                return self._level(about_n, gravity, variances)
            self._levelled = True
        rows = level_rows(quaternion.yaw(self._attitude), gravity, size)
        errors = [float(row[0] * about_n[0] + row[1] * about_n[1]) for row in rows]
        corrections = self._fuse_all("gravity", rows, errors, variances, gate)
        patience = 0.0 if self.resting else self._parameters.gravity_distrust
        if self._distrusts("gravity", patience):
            self._covariance[LEVEL, LEVEL] += errors[0] ** 2 + errors[1] ** 2
            corrections = self._fuse_all("gravity", rows, errors, variances, gate)
        if corrections[0].fused and gravity.down < LARGEST_FORCE**2:
            self._learn_size(gravity)
        return corrections

    def correct_zero_rate(
        self, rate_b: Floats, variance: Floats, confirmed: bool
    ) -> tuple[Correction, ...]:
        """Fuse the mean rate of a vehicle at rest: its bias, and the earth's rotation.

        Parameters
        ----------
        rate_b, variance : ndarray, shape (3,)
            Mean of the fused rate, bias not taken off, rad/s, and its variance.
        confirmed : bool
            Whether GPS or gravity says that it stands. Then a bias that is contradicted for
            `distrust` seconds is doubted.
        """
        p = self._parameters
        sound = (np.abs(rate_b) < LARGEST_RATE) & (variance > 0) & (variance < LARGEST_RATE**2)
        if not sound.all():
            return (Correction(math.nan, 1.0, p.gate, False, "rest", Outcome.NOT_FINITE),)
        error = rate_b - self._bias - np.array(self._earth_rate()) @ self.matrix
        rows = tuple(IDENTITY[BIAS])
        variances = variance.tolist()
        corrections = self._fuse_all("rest", rows, error.tolist(), variances, p.gate)
        if corrections[0].fused:
            self._rested = self._elapsed
        elif confirmed and self._distrusts("rest", p.distrust):
            self._covariance[BIAS_AXES, BIAS_AXES] += float(error @ error)
            return self._fuse_all("rest", rows, error.tolist(), variances, p.gate)
        return corrections

    def state(self, time_us: int) -> AttitudeState:
        """Read the estimate as of the last predict."""
        q_nb = self._attitude
        matrix_nb = quaternion.matrix(q_nb)
        rows = np.array([*tilt_rows(matrix_nb), yaw_row(matrix_nb, self._rate, 0.0)[ATTITUDE]])
        (roll, pitch, yaw), common = angle_spread(rows, self._covariance[ATTITUDE, ATTITUDE])
        if not self._aligned:
            yaw, common[1:] = math.pi, 0.0
        return AttitudeState(
            time_us,
            np.array(q_nb),
            self._rate.copy(),
            self._bias.copy(),
            roll,
            pitch,
            yaw,
            self._aligned,
            self._resets,
            common,
            np.sqrt(np.diag(self._covariance)[BIAS]),
        )

    def _rotation(self, step: Step) -> Vector:
        """Rotation vector of a step, from the rate of this step and of the one before."""
        x, y, z = (step.rate_b * step.told).tolist()
        follows = not (self._in_gap or step.has_gap) and step.told < LONG_STEP
        a, b, c = self._turned if follows else (0.0, 0.0, 0.0)
        self._turned, self._in_gap = (x, y, z), step.has_gap
        return (
            x + (b * z - c * y) / 12.0,
            y + (c * x - a * z) / 12.0,
            z + (a * y - b * x) / 12.0,
        )

    def _see(self, known: NDArray[np.bool_], dt: float, has_gap: bool) -> Floats:
        """Variance of what each axis turned unseen in a step, rad^2, (3,), but for a gap.

        A rate that is held stays right for a moment; in `LONG_STEP` it has become any rate.
        """
        seen = known & (has_gap or dt <= LONG_STEP)
        before, self._unseen = self._unseen, np.where(seen, 0.0, self._unseen + dt)
        turned = [UNKNOWN_RATE * t * np.minimum(t / LONG_STEP, 1.0) for t in (self._unseen, before)]
        variance: Floats = np.where(seen, 0.0, turned[0] ** 2 - turned[1] ** 2)
        self._unseen[known] = 0.0
        return variance

    def _spread(
        self, drive_nb: Floats, fused: FusedRate, unseen: Floats, told: float, dt: float
    ) -> None:
        """Carry the covariance on: `angle' = angle - drive told gyro`, and the noise of both."""
        angle, walk = self._noise(fused, unseen, told, dt)
        matrix_nb = drive_nb[:, 0:3]
        turned_nb = drive_nb * told
        covariance = self._covariance
        before = covariance.diagonal()[LEVEL].copy()
        covariance[ATTITUDE] -= turned_nb @ covariance[GYRO]
        among = covariance[ATTITUDE, ATTITUDE] - covariance[ATTITUDE, GYRO] @ turned_nb.T
        among += (matrix_nb * angle) @ matrix_nb.T
        covariance[ATTITUDE, ATTITUDE] = (among + among.T) / 2.0
        covariance[3:, ATTITUDE] = covariance[ATTITUDE, 3:].T
        kept = np.exp([-dt / OFFSET_TIME, -dt / LATE_TIME])
        self._wrong = self._wrong * kept
        covariance[HEADING] *= kept[:, np.newaxis]
        covariance[:, HEADING] *= kept
        covariance[LATE, OFFSET] = covariance[OFFSET, LATE]  # rounded in another order
        covariance[HEADING_AXES, HEADING_AXES] += self._wrong_variance * (1.0 - kept * kept)
        covariance[BIAS_AXES, BIAS_AXES] += walk
        if unseen.any():
            self._keep_level(before)
        self._bound()

    def _noise(
        self, fused: FusedRate, unseen: Floats, told: float, dt: float
    ) -> tuple[list[float], list[float]]:
        """Variances that a step adds to each axis: of the angle, rad^2, of the bias, (rad/s)^2."""
        p = self._parameters
        common = p.common_noise**2 * dt + p.turn_error**2 * math.hypot(*self._turned)
        angle, walk = [], []
        axes = zip(fused.noise.tolist(), fused.bias_walk.tolist(), unseen.tolist(), strict=True)
        for noise, bias_walk, unknown in axes:
            white = noise * told * told if 0.0 <= noise < LARGEST_RATE**2 else 0.0  # false for NaN
            walks = 0.0 <= bias_walk < LARGEST_RATE
            angle.append(white + common + unknown)
            walk.append(((bias_walk**2 if walks else 0.0) + p.common_bias_walk**2) * dt)
        return angle, walk

    def _bound(self) -> None:
        """Let no angle be less known than not at all: pi. Scaling keeps the matrix positive."""
        covariance = self._covariance
        if max(covariance[0, 0], covariance[1, 1], covariance[2, 2]) > math.pi**2:
            scale = np.ones(STATES)
            scale[ATTITUDE] = np.minimum(math.pi / np.sqrt(covariance.diagonal()[ATTITUDE]), 1.0)
            self._covariance = covariance * np.outer(scale, scale)

    def _keep_level(self, before: Floats) -> None:
        """Let what was not seen make the tilt no less known than that of a level vehicle.

        It is within `initial_tilt_std` of level, and the estimate may be off as much. Beyond that a
        filter that is linear would take headings for news of the tilt.

        Parameters
        ----------
        before : ndarray, shape (2,)
            Variances of the tilt before the step, rad^2.
        """
        level = 2.0 * self._parameters.initial_tilt_std**2
        level += 1.0 - min(max(float(self.matrix[2, 2]), 0.0), 1.0) ** 2
        known = self._covariance.diagonal()[LEVEL]
        scale = np.ones(STATES)
        scale[LEVEL] = np.minimum(np.sqrt(np.maximum(before, level) / known), 1.0)
        self._covariance = self._covariance * np.outer(scale, scale)

    def _earth_rate(self) -> Vector:
        """Rate of the earth, rad/s, NED; its horizontal part only where north is known."""
        if math.isnan(self._latitude):
            return (0.0, 0.0, 0.0)
        north = EARTH_RATE * math.cos(self._latitude) if self._aligned else 0.0
        return (north, 0.0, -EARTH_RATE * math.sin(self._latitude))

    def _doubt_bias_for_earth_rate(self) -> None:
        """Until north is known, the earth's horizontal rate was taken for bias."""
        if not math.isnan(self._latitude):
            level = (EARTH_RATE * math.cos(self._latitude)) ** 2
            matrix_nb = self.matrix
            self._covariance[BIAS, BIAS] += level * (matrix_nb.T * [1.0, 1.0, 0.0]) @ matrix_nb

    def _sets_tilt(self, about_n: tuple[float, float], variances: Sequence[float]) -> bool:
        """Whether the first gravity says more than what was known beforehand, or contradicts it."""
        known, gate = self._covariance.diagonal()[LEVEL], self._parameters.gate
        surprising = np.square(about_n) > gate**2 * (known + max(variances))
        return bool(max(variances) < known.min() or surprising.any())

    def _level(
        self, about_n: tuple[float, float], gravity: Gravity, variances: Sequence[float]
    ) -> tuple[Correction, ...]:
        """Set the tilt, whatever it was; yaw and all else stay."""
        gate = self._parameters.gate
        spreads = (self._covariance.diagonal()[LEVEL] + variances).tolist()
        self._turn((*about_n, 0.0))
        for axis in (0, 1):
            self._covariance[axis, :] = self._covariance[:, axis] = 0.0
            self._covariance[axis, axis] = math.pi**2
        turned = quaternion.matrix(quaternion.exp((*about_n, 0.0)))
        upright = replace(
            gravity, lever=turned @ gravity.lever, by_errors=turned @ gravity.by_errors
        )
        for row in level_rows(0.0, upright, GRAVITY):
            self._gain(row, max(variances))
        self._levelled = True
        return tuple(
            Correction(error, spread, gate, True, "gravity", Outcome.RESET)
            for error, spread in zip(about_n, spreads, strict=True)
        )

    def _learn_size(self, gravity: Gravity) -> None:
        """Find the accelerometers' bias along the vertical: what their reading is too large by."""
        row = np.zeros(STATES)
        row[ACCELEROMETER] = -gravity.by_errors[DOWN]
        size = float(np.linalg.norm(gravity.less(self._force_errors)))
        gate = self._parameters.gate
        self._fuse_all("size", (row,), (size - GRAVITY,), (gravity.down,), gate)

    def _turn(self, angle_n: Vector) -> None:
        """Turn the attitude, and with it its history, about axes of NED."""
        self._correction = quaternion.unit(
            quaternion.product(quaternion.exp(angle_n), self._correction)
        )

    def _fuse_all(
        self,
        source: str,
        rows: Sequence[Floats],
        errors: Sequence[float],
        variances: Sequence[float],
        gate: float,
    ) -> tuple[Correction, ...]:
        """Fuse scalars of one measurement one after another, if all are within the gate."""
        spreads = [
            float(row @ self._covariance @ row) + variance
            for row, variance in zip(rows, variances, strict=True)
        ]
        passed = all(
            error * error <= gate * gate * spread
            for error, spread in zip(errors, spreads, strict=True)
        )
        self._note(source, passed)
        change = np.zeros(STATES)
        if passed:
            for row, error, variance in zip(rows, errors, variances, strict=True):
                change += self._gain(row, variance) * (error - float(row @ change))
            self._turn((float(change[0]), float(change[1]), float(change[2])))
            self._bias = self._bias + change[BIAS]
            self._scale = self._scale + change[SCALE].reshape(3, 3)
            self._force_errors = self._force_errors + change[ACCELEROMETER]
            self._wrong = self._wrong + change[HEADING]
        outcome = Outcome.FUSED if passed else Outcome.REJECTED
        return tuple(
            Correction(error, spread, gate, False, source, outcome)
            for error, spread in zip(errors, spreads, strict=True)
        )

    def _gain(self, row: Floats, variance: float) -> Floats:
        """Gain of a scalar measurement; the covariance is updated in the form of Bucy and Joseph.

        `(1 - gain row) P (1 - gain row)' + variance gain gain'` stays symmetric and positive; its
        two products are each a matrix less one of rank one.
        """
        column = self._covariance @ row
        gain: Floats = column / (float(row @ column) + variance)
        remaining = self._covariance - np.outer(gain, column)
        covariance = remaining - np.outer(remaining @ row, gain) + variance * np.outer(gain, gain)
        self._covariance = (covariance + covariance.T) / 2.0
        return gain

    def _note(self, source: str, passed: bool) -> None:
        """Keep account of runs of rejections: when they began, and the last one."""
        if passed:
            self._rejecting.pop(source, None)
            return
        began, last = self._rejecting.get(source, (self._elapsed, self._elapsed))
        if self._elapsed - last > LARGEST_GAP:
            began = self._elapsed
        self._rejecting[source] = (began, self._elapsed)

    def _distrusts(self, source: str, after: float) -> bool:
        began, last = self._rejecting.get(source, (math.inf, self._elapsed))
        return last == self._elapsed and last - began >= after

    def _by_heading(self, heading: float, age: float) -> tuple[Floats | None, float]:
        """Derivative of a heading by the error, (29,), and the innovation.

        None while the vehicle points up or down: it says nothing of yaw.
        """
        age = self._true_age(age)
        matrix_then = quaternion.matrix(self._attitude_before(age))
        yaw_then = math.atan2(matrix_then[1, 0], matrix_then[0, 0])
        error = wrap(heading - float(self._wrong[0]) - yaw_then)
        if abs(matrix_then[2, 0]) > STEEP:
            return None, error
        row = yaw_row(matrix_then, self._rate, age)
        row[HEADING] = 1.0, -self._yaw_rate_before(age)
        return row, error

    def _true_age(self, told: float) -> float:
        return max(told + float(self._wrong[1]), 0.0)

    def _yaw_rate_before(self, age: float) -> float:
        """Rate of yaw `age` seconds ago, rad/s."""
        since, until = age + RATE_SPAN, max(age - RATE_SPAN, 0.0)
        if not until < since < math.inf:  # so long ago that nothing is known
            return 0.0
        turned = quaternion.yaw(self._attitude_before(until)) - quaternion.yaw(
            self._attitude_before(since)
        )
        return wrap(turned) / (since - until)

    def _attitude_before(self, age: float) -> Quaternion:
        """Attitude of `age` seconds ago, as known now; before the oldest by the present rate."""
        time = self._elapsed - age
        later: tuple[float, Quaternion] | None = None
        for earlier in reversed(self._history):
            if earlier[0] <= time:
                break
            later = earlier
        else:
            later_s, by_rate = later or (self._elapsed, self._by_rate)
            missing = min(later_s - time, LONG_STEP)
            x, y, z = (self._rate * -missing).tolist()
            before = quaternion.product(by_rate, quaternion.exp((x, y, z)))
            return quaternion.product(self._correction, before)
        by_rate = earlier[1]
        if later and later[0] > earlier[0]:
            part = (time - earlier[0]) / (later[0] - earlier[0])
            by_rate = quaternion.between(by_rate, later[1], part)
        return quaternion.product(self._correction, by_rate)


def _usable(heading: float, variance: float, age: float) -> bool:
    return math.isfinite(heading) and 0 < variance < math.inf and 0 <= age < math.inf
