"""Epoch -> FusedRate: one angular rate from an array of which up to 40 % may fail, in any way.

Why not eq. 5 to 8
------------------
The mean in eq. 5 carries every spike into all relative biases, and a sensor's own bias absorbs its
one-sided bursts; where the set of eq. 6 changes, they come back as drift. What an array can never
see is the common mode of its biases: its error is the heading's. So everything below keeps the
common mode as it is, unless there is evidence.

What is done instead, for each channel of one axis; times are in seconds, not epochs
-----------------------------------------------------------------------------------
A channel is on the jury if it is valid and trusted; r_i is its reading less its relative bias.

1. Fuse. Centre m and spread s: median and scaled median absolute deviation of the jury's r_i; s is
   averaged over `NOISE_TIME`, or that of the epoch if greater (up to `SWELL`: noise may grow, but
   of three sensors two may be struck at once). With |r_i - m| <= gate s a reading is inside; those
   inside and trusted are active. The rate is their mean: w = m + mean(r_i - m).
2. Learn. The relative bias b_i of an active channel follows its residual e_i = r_i - w:
   b_i += dt / min(age_i, T) e_i. Of the active ones the residuals sum to zero and so do the steps:
   the common mode stands still, whoever is active, and no explicit sum has to be held. A reading
   that is rejected, or of a channel that is not trusted, teaches nothing; the bias waits for it.
   So a burst is not absorbed, and a sensor that is hit now and then still tells, in between, how
   its bias has walked against the others': its share of the common mode is not lost.
3. Watch. z_i, the residuals inside low-passed, shows what no single reading does: a burst's tail, a
   step, a drift, a scale. Alarms are |z_i - median z| beyond gate times the scaled median absolute
   deviation of all z; of the readings of a second, `BURST` more rejected than of the trusted on the
   average; a reading that does not change although it should; silence. The median and deviation are
   those of all channels that change, trusted or not: however many are out, the bar does not close
   in on the rest.
4. Trust. A channel is trusted once it has been `hold_time` without an alarm. One that has not been
   trusted for `RELEARN` is taken to have changed for good, and learns its bias anew, as a new one
   does: from all of its readings, without a say in the rate.

If less than half of the valid channels, or less than three, are trusted, all that change are the
jury; it is active itself only where none of the trusted is inside. If none of an axis changes,
there is no rate of it: an array that repeats itself says nothing. One or two sensors have no
majority: their mean is taken, and neither is blamed but for silence or a reading that does not
change. Of few sensors, scale factors and misalignments that are usual are no reason for blame
(`scale_error`): they do not show themselves how far they differ.

How certain the rate is
-----------------------
`noise` is the variance of its white part, a sample: (s^2 - V) / (active). s^2 is the mean over
`NOISE_TIME` of the active residuals' sample variance (at 4 standard deviations, truncation takes
0.1 % off it), V the mean square of their z: what relative biases are not learnt yet spreads the
residuals, but hardly changes from one epoch to the next.
`bias_walk` is how quickly the bias of the rate wanders, rad/s/sqrt(s). If a channel's bias walks
by q, then V = q^2 T^2 / (2 (T + S)) + s^2 dt T / (2 S (T + S)), S the time constant of z, T at
first two thirds of the time since the start; solved for q^2 and averaged over calm times, since in
turns z shows scale factors as well, it gives q / sqrt(active). Each of c channels that have come or
gone since the last epoch has moved the rate by about sqrt(V) / (active): c V / (active)^2 / dt is
added to the square. A filter adds `noise * dt**2` to the angles'
covariance and `bias_walk**2 * dt` to that of the bias of the rate.
What all sensors have in common (the mean's bias at the start, its temperature, vibration rectified
alike) no residual shows: the filter has to add what it knows of that.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.fusion import MAD_TO_STD, Epoch, FusedRate, FusionParameters
from risaf_link.core.health import SILENT_AFTER, ArrayHealth, Reason, SensorState
from risaf_link.core.memory import AXES, CHANNELS, ArrayMemory
from risaf_link.core.rotation import Floats

Bools = NDArray[np.bool_]

LIMIT = 1e6  # rad/s; beyond, a reading is not one
LONGEST = 0.1  # s; an epoch counts for no more, so after a gap nothing is judged at once
WATCH_TIME = 3.0  # s, low pass of z: far below T, long enough to see a tenth of the noise
BURST_TIME, BURST = 1.0, 0.2  # s and share rejected: 0.2 s of shock are a burst
SWELL = 3.0  # times the spread of late: what the spread of an epoch may be, if noise has grown
NOISE_TIME = 2.0  # s, of averaging the noise: vibration comes and goes in seconds
SPREAD_TIME = 30.0  # s, of averaging the spread of z: ten times its low pass
FROZEN_AFTER = 0.5  # s; at a noise of one count, 50 equal readings have a chance of 1e-27
REPEATED_AFTER = 0.05  # s; at least an epoch, for which all of an array repeat themselves
MANY = 6  # channels; noisier than half a count, all of them repeat themselves once in 250 epochs
RELEARN = 30.0  # s; bursts are over by then
DEAD_AFTER = 60.0  # s without trust: it did not come back when it had learnt anew
TINY = 1e-9  # s
LEAST_WHITE = 0.1  # share of the residuals' variance that is white at least: V is an estimate
PRIOR = 3.0  # sensors that the prior of the bias walk counts as

MAD_FACTORS = MAD_TO_STD * np.array(
    [1.0, 1.0, 1.196, 1.495, 1.363, 1.206, 1.200, 1.140, 1.129, 1.107]
    + [n / (n - 0.8) for n in range(10, 1001)]
)
"""By their number, what makes the median absolute deviation of Gaussian values their standard
deviation. Croux and Rousseeuw, "Time-Efficient Algorithms for Two Highly Robust Estimators of
Scale", 1992."""


@dataclass(slots=True)
class Channels:
    """What is remembered of each channel, shape (3, n); times in s."""

    reading: Floats  # the last valid one
    count: Floats  # the smallest change of it
    residual: Floats  # the last one, rad/s; 0 where not active
    bias: Floats  # relative, rad/s
    age: Floats  # how long the bias has been learnt
    slow: Floats  # z: low-passed residual, rad/s
    rejected: Floats  # share of its readings, of about a second
    unchanged: Floats  # for how long the reading has been
    moved: Floats  # by how much the array's rate has since, rad/s
    frozen: Floats  # 1: it should have changed
    silent: Floats  # for how long
    calm: Floats  # since the last alarm
    out: Floats  # since it was last trusted
    wandering: Floats  # 1: z is an alarm
    outlying: Floats  # 1: so is the share rejected

    @classmethod
    def new(cls, n: int) -> "Channels":
        """Make n sensors of which nothing is known: they are learnt like those that are back."""
        channels = cls(*(np.zeros((3, n)) for _ in fields(cls)))
        channels.reading += np.nan
        channels.count += np.nan
        channels.out += RELEARN
        return channels

    def resized(self, n: int) -> "Channels":
        """The same with n sensors: the last are forgotten, or new ones added that must settle."""
        new = Channels.new(max(0, n - self.bias.shape[1]))
        return Channels(
            *(np.hstack([getattr(self, f.name)[:, :n], getattr(new, f.name)]) for f in fields(self))
        )


class Robust:
    """Fuses an array of gyros, or of accelerometers in their unit, robustly.

    Parameters
    ----------
    parameters : FusionParameters
    """

    def __init__(self, parameters: FusionParameters) -> None:
        self._parameters = parameters
        self._channels = Channels.new(0)
        self._trusted: Bools = np.zeros((3, 0), dtype=bool)
        self._elapsed = 0.0  # s
        self._spread = np.zeros((3, 1))  # s, robust standard deviation of one reading
        self._slow_spread = np.zeros((3, 1))  # that of z
        self._centre = np.zeros((3, 1))
        self._turning = np.zeros((3, 1))  # the centre, low-passed as z is
        self._jitter = np.zeros((3, 1))  # standard deviation of what changes from epoch to epoch
        self._calm = 0.0  # how calmly the array turned of late, 0 to 1
        self._calm_walk = np.zeros(3)  # that times the square of a sensor's bias walk
        self._noise = np.full(3, np.nan)  # variance of one active reading

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self._parameters = parameters

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s."""
        return self._channels.bias.T.copy()

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch; of a sensor, its worst axis counts."""
        return judge(self._channels, self._trusted)

    def memory(self) -> ArrayMemory:
        """Tell what was learnt."""
        c = self._channels
        axes = [getattr(self, f"_{name}").ravel() for name in AXES]
        channels = np.array([getattr(c, name) for name in CHANNELS])
        return ArrayMemory(channels, np.array(axes), self._elapsed, self._calm)

    def recall(self, memory: ArrayMemory) -> None:
        """Go on from what was learnt before a restart, in place of anything learnt since."""
        self._channels = Channels.new(len(memory))
        for name, values in zip(CHANNELS, memory.channels, strict=True):
            setattr(self._channels, name, values.copy())
        for name, values in zip(AXES, memory.axes, strict=True):
            setattr(self, f"_{name}", values.reshape(getattr(self, f"_{name}").shape).copy())
        self._elapsed, self._calm = memory.elapsed, memory.calm
        self._trusted = self._channels.calm >= self._parameters.hold_time

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; its number of sensors may differ from the one before."""
        return self.fuse_readings(epoch.time_us, epoch.dt, epoch.rates_b)

    def fuse_readings(self, time_us: int, dt: float, readings: Floats) -> FusedRate:
        """Fuse what sensors of one kind read at one instant.

        Parameters
        ----------
        time_us : int
        dt : float
            Seconds since the last; at the first it does not matter.
        readings : ndarray, shape (n, 3)
            rad/s; for accelerometers all units are theirs. Not valid where not finite.
        """
        dt = min(dt, LONGEST) if dt > 0 and self._trusted.size else 0.0
        self._resize(len(readings))
        self._elapsed += dt
        raw = readings.T.copy()
        valid = np.abs(raw) < LIMIT
        changing = self._note_changes(raw, valid, dt)
        trusted = self._trusted & changing
        jury = _jury(trusted, changing, valid)

        corrected = np.where(valid, raw - self._channels.bias, 0.0)
        is_heard: Bools = np.logical_or.reduce(jury, axis=1, keepdims=True)
        centre = np.where(is_heard, _median(corrected, jury), self._centre)
        offset = corrected - centre
        distance = np.abs(offset)
        self._note_turning(centre, dt)
        inside = (distance <= self._limit(distance, jury, is_heard, centre, dt)) & valid
        active = trusted & inside
        count = active.sum(axis=1)
        if not count.all():  # where none of the trusted is inside, the rest of the jury
            active |= jury & inside & (count == 0)[:, None]
            count = active.sum(axis=1)
        mean = (offset * active).sum(axis=1) / np.maximum(count, 1)
        residual = offset - mean[:, None]

        self._average_noise(residual * active, count, dt)
        self._learn(residual, active, changing, dt)
        self._watch(residual * inside, valid ^ inside, changing, dt)
        moved = self._trust(dt)
        known = np.where(count > 0, count, np.nan)
        slow = self._slow_square(active, known)
        white = np.maximum(self._noise - slow, LEAST_WHITE * self._noise)
        return FusedRate(
            time_us,
            centre[:, 0] + mean + 0.0 * known,
            self._noise + 0.0 * known,
            count,
            int(valid.all(axis=0).sum()),
            np.where(np.isnan(white), self._noise_alone(dt), white) / known,
            self._bias_walk(white, slow, known, moved, dt),
        )

    def _note_changes(self, readings: Floats, valid: Bools, dt: float) -> Bools:
        """Which channels are valid and not frozen.

        Frozen is what does not change although there was reason to: the array has moved by two
        counts since, or its noise is more than half a count (rounding alone makes 0.29). What no
        noise and no motion makes change, such as coarse counts at rest, is not frozen. Where all
        repeat themselves at once, and enough of them by their noise should not, all are frozen.
        """
        c = self._channels
        change = np.abs(readings - c.reading)
        changed = valid & (change > 0.0)  # false for the first
        c.count = np.where(changed, np.fmin(c.count, change), c.count)
        c.unchanged += dt * valid
        c.unchanged *= ~changed
        c.silent += dt
        c.silent *= ~valid
        c.reading = np.where(valid, readings, c.reading)
        count = np.fmax(c.count, self._parameters.resolution)
        noisy = 2.0 * self._jitter > count
        reason = (np.abs(c.moved) > 2.0 * count) | noisy | (c.frozen > 0.0)
        c.frozen[:] = valid & (c.unchanged > FROZEN_AFTER) & reason
        if (c.unchanged > REPEATED_AFTER)[valid].all() and (noisy & valid).sum() >= MANY:
            c.frozen[:] = valid
        changing: Bools = valid & (c.frozen == 0.0)
        return changing

    def _note_turning(self, centre: Floats, dt: float) -> None:
        """Keep account of how the centre moves, shape (3, 1)."""
        c = self._channels
        c.moved += centre - self._centre
        c.moved *= c.unchanged > 0.0
        self._centre = centre
        self._turning += dt / WATCH_TIME * (centre - self._turning)

    def _unscaled(self, rate: Floats) -> float:
        """By how much a sound sensor may differ at a rate (3, 1), one standard deviation.

        Many sensors show how their scale factors differ; few are judged by what is usual.
        """
        believed = PRIOR / (PRIOR + self._trusted.shape[1])
        return self._parameters.scale_error * math.sqrt(believed * float((rate**2).sum()))

    def _limit(
        self, distance: Floats, jury: Bools, is_heard: Bools, centre: Floats, dt: float
    ) -> Floats:
        """How far from the centre of the jury a reading is inside; shape (3, 1)."""
        p = self._parameters
        least = math.hypot(p.resolution, self._unscaled(centre))
        usual = np.maximum(self._spread, least)
        spread = _deviation(distance, jury)
        if self._elapsed > 0:
            spread = np.minimum(spread, SWELL * usual)
        self._spread += is_heard * self._share(dt, NOISE_TIME) * (spread - self._spread)
        nearest = np.where(jury, distance, np.inf).min(axis=1, initial=np.inf, keepdims=True)
        widest = np.maximum(np.maximum(spread, self._spread), least)
        limit: Floats = np.maximum(p.gate * widest, nearest)
        return limit

    def _noise_alone(self, dt: float) -> float:
        """Variance of the reading of a sensor that is alone, as the parameters have it."""
        return self._parameters.gyro_noise**2 / dt if dt > 0 else math.nan

    def _average_noise(self, residual: Floats, count: NDArray[np.int64], dt: float) -> None:
        square = np.einsum("ij,ij->i", residual, residual) / np.maximum(count - 1, 1)
        known = np.where(np.isnan(self._noise), square, self._noise)
        averaged = known + self._share(dt, NOISE_TIME) * (square - known)
        self._noise = np.where(count > 1, averaged, self._noise)
        c = self._channels
        change = residual - c.residual
        c.residual = residual
        size = np.sqrt(np.einsum("ij,ij->i", change, change) / np.maximum(2 * count, 1))[:, None]
        change_of_size = self._share(dt, SPREAD_TIME) * (size - self._jitter)
        self._jitter += np.where(count[:, None] > 0, change_of_size, 0.0)

    def _learn(self, residual: Floats, active: Bools, changing: Bools, dt: float) -> None:
        """Let relative biases follow the residuals: the trusted if active, the new always."""
        c = self._channels
        learning = self._trusted & active
        relearning = c.out >= RELEARN
        if relearning.any():
            learning |= relearning & changing
        elapsed = learning * dt
        c.age += elapsed
        c.bias += elapsed / np.clip(c.age, TINY, self._parameters.bias_time) * residual

    def _watch(self, residual: Floats, rejected: Bools, changing: Bools, dt: float) -> None:
        """See which channels are wandering, and how much of them is rejected."""
        c = self._channels
        c.slow += dt / WATCH_TIME * (residual - c.slow)
        c.rejected += dt / BURST_TIME * (rejected - c.rejected)
        distance = np.abs(c.slow - _median(c.slow, changing))
        white = self._spread * math.sqrt(dt / (2 * WATCH_TIME))
        spread = np.maximum(_deviation(distance, changing), white)
        self._slow_spread += self._share(dt, SPREAD_TIME) * (spread - self._slow_spread)
        p = self._parameters
        limit = p.gate * np.maximum(spread, self._slow_spread)
        least = math.hypot(p.resolution, p.gate * self._unscaled(self._turning))
        np.greater(distance, np.maximum(limit, least), out=c.wandering)

    def _trust(self, dt: float) -> NDArray[np.int64]:
        """Judge every channel anew; how many of each axis have come or gone."""
        c = self._channels
        usual = (c.rejected * self._trusted).sum(axis=1) / np.maximum(self._trusted.sum(axis=1), 1)
        np.greater(c.rejected, usual[:, None] + BURST, out=c.outlying)
        alarm = c.outlying > 0.0
        alarm |= c.wandering > 0.0
        alarm |= c.frozen > 0.0
        alarm |= c.silent > SILENT_AFTER
        c.calm += dt
        c.calm *= ~alarm
        trusted = c.calm >= self._parameters.hold_time
        c.out += dt
        c.out *= ~trusted
        late = c.out >= RELEARN
        if late.any():
            anew = late & ((c.out < RELEARN + dt) | (c.age >= RELEARN))
            c.age[anew] = 0.0
            c.slow[anew] = 0.0
        moved: NDArray[np.int64] = (trusted ^ self._trusted).sum(axis=1)
        self._trusted = trusted
        return moved

    def _slow_square(self, active: Bools, count: Floats) -> Floats:
        """V, the mean square of z of the active channels."""
        slow = self._channels.slow * active
        square: Floats = np.einsum("ij,ij->i", slow, slow) / np.maximum(count - 1, 1)
        return square

    def _averaged_walk(self, walk: Floats, dt: float) -> Floats:
        """Average over `SPREAD_TIME`, in which a turn counts little: scale factors show there."""
        scale = self._parameters.scale_error * float(np.linalg.norm(self._turning))
        least = max(self._parameters.resolution, TINY)
        calm = 1.0 / (1.0 + (scale / least) ** 2)
        share = dt / min(max(self._elapsed / 3.0, dt), SPREAD_TIME) if dt > 0 else 0.0
        self._calm += share * (calm - self._calm)
        self._calm_walk += share * (calm * walk - self._calm_walk)
        average: Floats = self._calm_walk / max(self._calm, TINY)
        return average

    def _bias_walk(
        self, white: Floats, slow: Floats, count: Floats, moved: NDArray[np.int64], dt: float
    ) -> Floats:
        """rad/s/sqrt(s), as the head of this module says."""
        p = self._parameters
        time = min(max(2 / 3 * self._elapsed, WATCH_TIME), p.bias_time)
        noise = np.where(np.isnan(white), 0.0, white)
        walk = 2 * (time + WATCH_TIME) / time**2 * slow - dt / (WATCH_TIME * time) * noise
        walk = self._averaged_walk(np.where(np.isnan(walk), 0.0, walk), dt)
        told = count - 1  # one sensor has no residual
        walk = (PRIOR * p.bias_walk**2 + told * np.maximum(walk, 0.0)) / (PRIOR + told)
        if dt > 0 and moved.any():
            walk += moved / (count * dt) * slow
        density: Floats = np.sqrt(walk / count)
        return density

    def _share(self, dt: float, time_constant: float) -> float:
        """Weight of the newest in an average over a time constant; at first, over all there is."""
        return dt / min(self._elapsed, time_constant) if self._elapsed > 0 else 1.0

    def _resize(self, n: int) -> None:
        known = self._trusted.shape[1]
        if n == known:
            return
        self._channels = self._channels.resized(n)
        if not known:  # the first: all are trusted until they give cause for alarm
            self._channels.calm += self._parameters.hold_time
            self._channels.out[:] = 0.0
        self._trusted = self._channels.calm >= self._parameters.hold_time


def judge(channels: Channels, trusted: Bools) -> ArrayHealth:
    """Judge sensors by their channels; of a sensor, its worst axis counts.

    Dead: frozen, or for a second silent, or for a minute not trusted.
    """
    c = channels
    reason = np.where(trusted, Reason.NONE, Reason.SETTLING).astype(np.int8)
    reason[c.wandering > 0] = Reason.WANDERING
    reason[c.outlying > 0] = Reason.OUTLYING
    reason[c.frozen > 0] = Reason.FROZEN
    reason[c.silent > 0] = Reason.SILENT
    worst = reason.max(axis=0)
    dead = (c.frozen > 0) | (c.silent > SILENT_AFTER) | (c.out > DEAD_AFTER)
    state = np.where(dead.any(axis=0), SensorState.DEAD, worst > Reason.NONE).astype(np.int8)
    return ArrayHealth(state, worst, c.rejected.max(axis=0), c.bias.T.copy())


def _jury(trusted: Bools, changing: Bools, valid: Bools) -> Bools:
    """Those of each axis who say what is outlying: the trusted, or if they are too few, more."""
    few = trusted.sum(axis=1) < np.maximum(3, valid.sum(axis=1) / 2)
    if not few.any():
        return trusted
    return np.where(few[:, None], changing, trusted)


def _median(values: Floats, chosen: Bools) -> Floats:
    """Median of the chosen values of each row, shape (k, 1); 0 where none is."""
    if not values.size:
        return np.zeros((len(values), 1))
    ordered = np.sort(np.where(chosen, values, np.inf), axis=1)  # quicker than a partition
    count = chosen.sum(axis=1)
    rows = np.arange(len(values))
    twice = ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, count // 2]
    return np.where(count > 0, 0.5 * twice, 0.0)[:, None]


def _deviation(distance: Floats, chosen: Bools) -> Floats:
    """Robust standard deviation of the chosen of each row, from their distance to the centre."""
    count = np.minimum(chosen.sum(axis=1, keepdims=True), len(MAD_FACTORS) - 1)
    deviation: Floats = MAD_FACTORS[count] * _median(distance, chosen)
    return deviation
