"""What the array's readings and the speed from GPS say of gravity and of rest."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.error_state import ACCELEROMETER, GYRO, Correction, Gravity, drive
from risaf_link.core.eskf import LARGEST_FORCE, LARGEST_GAP, LARGEST_STEP, LONG_STEP, Eskf
from risaf_link.core.fusion import FusedRate
from risaf_link.core.gear import STANDING_SPEED
from risaf_link.core.rotation import Floats

PART, PARTS = 0.1, 30  # s, and their number in a mean of specific force
SHORTEST_SPAN = PART * PARTS / 4.0  # s, from one mean to the next but for the first: half of it
HEAVES = 2.0  # standard deviations of the size that are no level acceleration
FLOOR = 0.01  # m/s^2, of a mean: rounding, nonlinearity
HIDDEN_TIME = 1.0  # s for which one lasts that drives it
ANY_SPEED = 30.0  # m/s, that a vehicle may have whose speed nobody tells
SPEED_TIME = 0.5  # s for which an error of the tracked speed lasts
ACCELERATION_STD = 1.5  # m/s^2, of a vehicle along its way
ACCELERATION_TIME = 2.0  # s for which it lasts
SPEED_LOST = 15.0  # m/s, standard deviation beyond which a speed says nothing
SPEED_JUMP = 1.0  # m/s; a speed that changes by more at once was wrong before
BLOCK = 0.5  # s, of rest
STILL, STILL_ALONE, STILL_ON_ROAD = 1.0, 3.0, 6.0  # s: GPS confirms, was never there, is gone
STILL_BY_GRAVITY, CLAIMED_TURN = 10.0, 0.5  # s and rad, by which gravity refutes a rate
LEVEL_PART = 0.6  # of that rate; a force that leans in a curve lends it less
LEVEL_TIME, TILTED_TIME = 2.0, 15.0  # s, from level to level; s for which a road is as it is
UNFELT = 10.0  # s without specific force after which there is no accelerometer
QUIET = np.array([0.05] * 3 + [0.5] * 3)  # rad/s, m/s^2, standard deviation within a block
LOOSE = np.array([0.01] * 3 + [0.2] * 3)  # rad/s, m/s^2, between blocks, with GPS
STRICT = np.array([3e-4] * 3 + [0.01] * 3)  # without
REST_RATE, UNCONFIRMED_RATE = 1e-4, 1e-3  # rad/s, of a vehicle at rest: wind, people
USUAL = AttitudeParameters()


class SpeedTracker:
    """Speed ahead and its derivative, from speeds that come late and seldom.

    A Kalman filter of two states; the acceleration forgets itself, a Gauss-Markov process.
    """

    def __init__(self) -> None:
        self._since_told = math.inf  # s
        self._start(0.0, math.inf)

    def _start(self, speed: float, variance: float) -> None:
        self.speed = speed  # m/s
        self.acceleration = 0.0  # m/s^2, along the vehicle
        self.speed_variance = variance
        self.acceleration_variance = ACCELERATION_STD**2
        self._common = 0.0  # their covariance

    @property
    def known(self) -> bool:
        """Whether a speed was ever told: that of a vehicle."""
        return self.speed_variance < math.inf

    @property
    def recent(self) -> bool:
        """Whether GPS tells the speed."""
        return self._since_told < LARGEST_GAP

    @property
    def standing(self) -> bool:
        """Whether GPS says that the vehicle stands."""
        return self.recent and abs(self.speed) < STANDING_SPEED

    def advance(self, dt: float) -> None:
        """Let time pass, seconds."""
        self._since_told += dt
        keep = math.exp(-dt / ACCELERATION_TIME)
        self.speed_variance += dt * (2.0 * self._common + dt * self.acceleration_variance)
        self._common = keep * (self._common + dt * self.acceleration_variance)
        self.speed += dt * self.acceleration
        self.acceleration *= keep
        change = self.acceleration_variance - ACCELERATION_STD**2
        self.acceleration_variance = ACCELERATION_STD**2 + keep**2 * change

    def turn_round(self) -> None:
        """Take note that the vehicle drives the other way: the gear was not known."""
        self.speed, self.acceleration = -self.speed, -self.acceleration

    def hear(self, speed: float, variance: float, age: float) -> None:
        """Use a speed ahead, m/s, negative backwards, of `age` seconds ago, and its variance."""
        if not (abs(speed) < 1e3 and 0 < variance < 1e6 and 0 <= age < 10):
            return
        self._since_told = 0.0
        if not self.speed_variance < SPEED_LOST**2:
            self._start(speed, variance)
            return
        by_speed = self.speed_variance - age * self._common
        by_acceleration = self._common - age * self.acceleration_variance
        spread = by_speed - age * by_acceleration + variance
        error = speed - (self.speed - age * self.acceleration)
        self.speed += by_speed / spread * error
        self.acceleration += by_acceleration / spread * error
        self.speed_variance -= by_speed**2 / spread
        self.acceleration_variance -= by_acceleration**2 / spread
        self._common -= by_speed * by_acceleration / spread


class GravityFinder:
    """Makes gravity from specific force: means over seconds, and how far they can be believed.

    In a frame that does not turn, the mean specific force is gravity and the mean acceleration
    (Laidig and Seel, "VQF: highly accurate IMU orientation estimation with bias estimation and
    magnetic disturbance rejection", arXiv:2203.17024). What shakes a vehicle comes to nothing; the
    more so the more smoothly the mean begins and ends (a Hann window). Of what lasts, GPS tells
    what the speed and the rate make (along: its derivative; across: speed times rate). The rest
    shows itself in two ways: means differ by more than the gyro's errors explain, and the specific
    force is larger than gravity, `|f|^2 - g^2 = |a|^2` for a level acceleration. Where no speed was
    ever told, a turn that lasts is held to be a curve, for as long as it lasts.
    """

    def __init__(self) -> None:
        self._last: Floats | None = None  # the mean before, m/s^2, i
        self._speed = 0.0  # m/s, at the epoch before
        self._curves = 0  # means since a lasting turn began
        self._unsteady = 0.0  # (m/s^2)^2, variance of the means, each level axis
        self._heaving = 0.0  # (m/s^2)^2, of their size
        self.restart()

    def restart(self) -> None:
        """Forget what was measured: the attitude between is not known."""
        self._parts: deque[Floats] = deque(maxlen=PARTS)  # integrals, turn, time
        self._new = 0
        self._begin()

    def _begin(self) -> None:
        self._part = np.zeros((3, 25))
        self._turned = self._time = 0.0

    def take(
        self, attitude: Eskf, force_b: Floats, dt: float, speed: SpeedTracker
    ) -> Gravity | None:
        """Use the specific force of one epoch; the gravity of a window that it completes."""
        if not (np.abs(force_b) < LARGEST_FORCE).all():
            return None
        matrix_ib = attitude.matrix_ib
        level_b = force_b
        _, rate_y, rate_z = attitude.rate.tolist()
        if speed.speed_variance < speed.speed**2:
            gained = speed.speed - self._speed
            along = gained / dt if abs(gained) < SPEED_JUMP else 0.0
            level_b = force_b - (along, speed.speed * rate_z, -speed.speed * rate_y)
        self._speed = speed.speed
        self._part[:, 0] -= matrix_ib @ level_b * dt
        self._part[:, 1:13] += attitude.drive_ib * dt
        # By what it should be: the noise of a reading must not find itself in the bias it leads to.
        support_b = force_b if not attitude.levelled else GRAVITY * attitude.up_b
        self._part[:, 13:] += drive(matrix_ib, support_b) * dt
        self._time += dt
        self._turned += rate_z * dt
        if self._time < PART:
            return None
        self._parts.append(np.array([*self._part.ravel(), self._turned, self._time]))
        self._new += 1
        self._begin()
        if self._last is not None and self._new < PARTS // 2:
            return None
        self._new = 0
        return self._judge(attitude, speed)

    def _judge(self, attitude: Eskf, speed: SpeedTracker) -> Gravity:
        parts = np.array(self._parts)
        times = parts[:, 76]
        weights = np.hanning(len(parts) + 2)[1:-1] * times
        weights /= weights.sum()
        integrals = parts[:, :75].reshape(-1, 3, 25)
        means_i = np.einsum("k,kij->ij", weights / times, integrals)
        since = np.cumsum(weights) - weights / 2.0  # share of the mean older than each part
        lever_i = np.einsum("k,kij->ij", since, integrals[:, :, 1:13])
        matrix_ni = attitude.matrix_ni
        means_n, lever = matrix_ni @ means_i, matrix_ni @ lever_i
        span = float(times.sum()) / 2.0  # that the window is worth
        by_errors = means_n[:, 13:]
        size = float(np.linalg.norm(means_n[:, 0] + by_errors @ attitude.known_errors[12:]))
        covariance = attitude.covariance
        size_variance = float(
            by_errors[2] @ covariance[ACCELEROMETER, ACCELEROMETER] @ by_errors[2]
        )
        change = np.zeros(3) if self._last is None else matrix_ni @ (means_i[:, 0] - self._last)
        drift = lever[0:2] @ covariance[GYRO, GYRO] @ lever[0:2].T
        now = max(float(change[0:2] @ change[0:2]) - GRAVITY**2 * float(np.trace(drift)), 0.0) * 0.3
        self._unsteady += 0.2 * (now - self._unsteady)
        heave = 0.0
        if self._last is not None:
            heave = 0.6 * float(change[2]) ** 2
            self._heaving += 0.2 * (heave - self._heaving)
        self._last = means_i[:, 0]
        hidden = size**2 - GRAVITY**2  # what a level acceleration adds
        doubt = 2.0 * GRAVITY * HEAVES * math.sqrt(size_variance + max(self._heaving, heave))
        lasting = max(2.0 * HIDDEN_TIME / max(span, SHORTEST_SPAN), 1.0)
        turning = float(parts[:, 75] @ parts[:, 75] / (times @ times))
        along = across = max(hidden - doubt, 0.0)
        if not speed.known:
            curve = _lasting_turn(parts[:, 75], times)
            self._curves = self._curves + 1 if curve > 0.0 else 0
            across += self._curves * min(curve * ANY_SPEED**2, doubt)  # the same error every time
        else:
            seen = 4.0 * math.pi**2 * SPEED_TIME / (2.0 * span) ** 3 * speed.speed_variance
            along = min(max(hidden, 0.0) + doubt, speed.acceleration_variance, seen / lasting)
            across = min(max(hidden, 0.0) + doubt, turning * speed.speed_variance)
        known = FLOOR**2 + max(self._unsteady, now)
        variances = known + lasting * along, known + lasting * across
        down = known if attitude.resting else math.inf
        return Gravity(means_n[:, 0], *variances, down, lever, by_errors)


def _lasting_turn(turns: Floats, times: Floats) -> float:
    """Square of a rate that lasts as that of a vehicle in a curve does, (rad/s)^2; 0: it does not.

    It changes little, and in the time of a mean it makes less than half a turn.
    """
    turned, time = float(turns.sum()), float(times.sum())
    mean = turned / time
    spread = float(((turns / times - mean) ** 2).mean())
    return mean**2 if 4.0 * spread < mean**2 and abs(turned) < math.pi else 0.0


@dataclass(frozen=True, slots=True)
class Rest:
    """The mean rate of a vehicle at rest."""

    rate_b: Floats  # (3,) rad/s
    variance: Floats  # (3,) (rad/s)^2
    confirmed: bool  # by GPS, or by gravity that does not turn


class RestFinder:
    """Finds rest in the array's readings, by blocks.

    At rest the readings are a constant and noise. With GPS that says so it is enough that nothing
    shakes or changes much. Without it a smooth road looks alike: then the noise must be white (the
    mean square of successive differences is twice the variance), and the means of blocks must agree
    for long, to what noise allows.
    """

    def __init__(self) -> None:
        self._reference: Floats | None = None
        self._still = 0.0  # s
        self.restart()

    def restart(self) -> None:
        """Begin a new block."""
        self._values: list[Floats] = []
        self._time = 0.0

    def take(self, rate_b: Floats, force_b: Floats, dt: float, speed: SpeedTracker) -> Rest | None:
        """Use one epoch; the rest that a block which it completes shows.

        Parameters
        ----------
        rate_b, force_b : ndarray, shape (3,)
            rad/s, bias not taken off, and m/s^2; NaN: no accelerometer.
        dt : float
            s.
        speed : SpeedTracker
        """
        self._values.append(np.concatenate((rate_b, force_b)))
        self._time += dt
        if self._time < BLOCK or len(self._values) < 5:
            return None
        values, time = np.array(self._values), self._time
        self.restart()
        with np.errstate(invalid="ignore"):
            return self._judge(values, time, speed)

    def _judge(self, values: Floats, time: float, speed: SpeedTracker) -> Rest | None:
        if np.isnan(values[:, 3:]).any():
            values = values[:, :3]
        n, axes = values.shape
        mean, variance = values.mean(axis=0), values.var(axis=0)
        noise = (np.diff(values, axis=0) ** 2).mean(axis=0) / 2.0
        standing = speed.standing
        allowed = (LOOSE if standing else STRICT)[:axes]
        quiet = (variance < QUIET[:axes] ** 2).all() and np.isfinite(mean).all()
        if not standing:
            white = 1.0 - min(4.0 / math.sqrt(n), 0.7)  # the ratio within 4 standard deviations
            quiet &= bool((variance * white < noise + 1e-9).all()) and not speed.recent
        reference = self._reference
        agree = (
            reference is not None
            and len(reference) == axes
            and (np.abs(mean - reference) < allowed + 5.0 * np.sqrt(2.0 * noise / n)).all()
        )
        if not (quiet and agree):
            self._reference, self._still = mean if quiet else None, 0.0
            return None
        self._still += time
        if self._still < (STILL if standing else STILL_ON_ROAD if speed.known else STILL_ALONE):
            return None
        floor = REST_RATE if standing else UNCONFIRMED_RATE
        spread = np.maximum(noise, variance)[:3] / n + floor**2
        return Rest(mean[:3], spread, standing or self._contradicts(mean))

    def _contradicts(self, mean: Floats) -> bool:
        """Whether gravity, which stood still, would have turned by what the rate claims."""
        if len(mean) < 6 or self._still < STILL_BY_GRAVITY:
            return False
        rate, force = float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))
        claimed = float(np.linalg.norm(np.cross(mean[:3], mean[3:])))
        return claimed > max(LEVEL_PART * rate, CLAIMED_TURN / self._still) * force


class Aiding:
    """Feeds a filter with what the array and the speed tell of gravity and rest.

    Without accelerometers nothing but headings would hold the tilt, and they hold it by what is
    left of their errors. Then it is held by what is known beforehand: a vehicle is level on the
    average, within `initial_tilt_std`, and stays as tilted as it is for about `TILTED_TIME`.

    Parameters
    ----------
    parameters : AttitudeParameters
    """

    def __init__(self, parameters: AttitudeParameters = USUAL) -> None:
        self._level_variance = (GRAVITY * parameters.initial_tilt_std) ** 2
        self._level_variance *= 2.0 * TILTED_TIME / LEVEL_TIME
        self._unfelt = 0.0  # s, since there was a specific force, or level was taken for granted
        self._feels = False  # whether there was one of late
        self.speed = SpeedTracker()
        self._gravity = GravityFinder()
        self._rest = RestFinder()

    def take(
        self, attitude: Eskf, fused: FusedRate, force_b: Floats, dt: float
    ) -> tuple[Correction, ...]:
        """Correct the attitude after a predict, where there is something to correct it by.

        Parameters
        ----------
        attitude : Eskf
        fused : FusedRate
        force_b : ndarray, shape (3,)
            Specific force, m/s^2; NaN: there is no accelerometer.
        dt : float
            Seconds since the epoch before.
        """
        if not dt > 0:
            return ()
        self.speed.advance(min(dt, LARGEST_STEP))
        if dt > LONG_STEP or not np.isfinite(fused.rate_b).all():
            self._gravity.restart()
            self._rest.restart()
            return ()
        corrections: tuple[Correction, ...] = ()
        rest = self._rest.take(fused.rate_b, force_b, dt, self.speed)
        if rest is not None:
            corrections += attitude.correct_zero_rate(rest.rate_b, rest.variance, rest.confirmed)
        gravity = self._gravity.take(attitude, force_b, dt, self.speed)
        if gravity is None:
            gravity = self._usual(attitude, force_b, dt)
        if gravity is not None:
            corrections += attitude.correct_gravity(gravity)
        return corrections

    def _usual(self, attitude: Eskf, force_b: Floats, dt: float) -> Gravity | None:
        """Gravity of a vehicle that is level, now and then, where none is felt."""
        if np.isfinite(force_b).all():
            self._unfelt, self._feels = 0.0, True
            return None
        self._unfelt += dt
        if self._unfelt < (UNFELT if self._feels else LEVEL_TIME):
            return None
        self._unfelt, self._feels = 0.0, False
        variance = self._level_variance
        return Gravity(attitude.matrix @ (0.0, 0.0, GRAVITY), variance, variance)
