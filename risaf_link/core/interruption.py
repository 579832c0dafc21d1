"""What an interruption has changed, by what is remembered from before and what comes at once after.

Is it the same array?
---------------------
A relative bias explains why a sensor differs from the others. With those that are remembered taken
off, the sensors must differ no more than without, each by the median of the trial: shocks are
shorter. Biases of another array make it worse: their variance adds to what is there. Fewer than
three sensors cannot be held against one another; they are believed only while their clock has run
on, since they had power.

How have the biases changed?
----------------------------
What is left of the differences shows it, whatever the age, also if power was off: their variance W
over all sensors, less what noise and scale factors make, and more where few sensors tell it (the
variance of Student's t). The bias of the fused rate is the mean of
what the active sensors' biases have become: its variance grows by W over their number, or by the
random walk that fusion had seen, if that is more; and by what all have in common, which nothing
shows (`common_bias_walk`). Each relative bias is believed as `ArrayMemory.older` has it.

And the attitude?
-----------------
It is worth remembering while the sensors' clock has run on and the host's clock agrees with it, for
as long as yaw stays known to `KNOWN_YAW`. A vehicle that rested before and rests now, within
`STOOD`, has not turned. Of one that drives, the rate before and the rate after are known; between,
it wanders. Held at both ends, a random walk of the rate has turned by half their sum on the
average, with variance `RATE_WALK**2 gap**3 / 12` (the integral of a Brownian bridge). Else tilt and
yaw are unknown again, and the earth's rotation is a part of the bias.
"""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from risaf_link.core.aiding import QUIET
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import EARTH_RATE
from risaf_link.core.error_state import (
    ACCELEROMETER,
    ATTITUDE,
    BIAS_AXES,
    DOWN,
    HEADING_AXES,
    LEVEL,
    STATES,
)
from risaf_link.core.eskf import LATE_TIME, OFFSET_TIME
from risaf_link.core.fusion import EpochBlock, FusedRate, FusionParameters, quantiles
from risaf_link.core.gear import STANDING_SPEED
from risaf_link.core.heading import HeadingParameters, Motion
from risaf_link.core.memory import FilterMemory, Memory
from risaf_link.core.robust import MAD_FACTORS
from risaf_link.core.rotation import Floats

OLDEST = 365 * 86400.0  # s; what seems older was stamped by a clock that was wrong
SAME_CLOCK, DRIFT = 1.0, 1e-3  # s, and s/s: by how much two clocks that both run on may differ
STOOD = 10.0  # s between two rests in which a vehicle has not turned
STANDS = 3e-3  # rad/s, mean over the trial, of one at rest: people get in
STANDING_RATE = 1e-3  # rad/s, that it may have turned with in between
RATE_WALK = 0.25  # rad/s/sqrt(s): three standard deviations are a right-angled corner in 4 s
KNOWN_YAW = 1.0  # rad; less well known, it is better set than corrected
SOON = 0.2  # s, of which the rate after the gap is the median
STEP = 0.2  # s, in which the gap is gone through
SAMPLES = 200  # epochs that are looked at, at most
MEDIAN_NOISE = math.pi / 2  # variance of a median over that of a mean
FREEDOM = 0.37  # degrees of freedom, of a sensor in a spread by median absolute deviation
FEWEST_SENSORS = 3  # that can be held against one another
UNKNOWN = np.full(3, np.nan)


class Interruption:
    """The time between a memory and what came after it.

    Parameters
    ----------
    memory : Memory
    epochs : sequence of EpochBlock
        What came at once after it, calibrated; of as many sensors.
    motions : sequence of Motion
        What GPS said meanwhile.
    """

    def __init__(
        self, memory: Memory, epochs: Sequence[EpochBlock], motions: Sequence[Motion]
    ) -> None:
        self._memory = memory
        self._motions = motions
        times = np.cumsum(np.concatenate([block.dt for block in epochs]))
        self.dt = float(times[-1] - times[0]) / max(len(times) - 1, 1)  # s, from reading to reading
        some = slice(None, None, -(-len(times) // SAMPLES))
        self._times = times[some] - times[0]
        rates_b = np.concatenate([block.rates_b for block in epochs])[some]
        relative = rates_b.transpose(2, 1, 0) - memory.gyros.bias[:, :, np.newaxis]  # (3, n, k)
        heard = memory.gyros.trusted[:, :, np.newaxis] & np.isfinite(relative)
        self._relative = np.where(heard, relative, np.nan)
        self._centre = _median(self._relative.transpose(0, 2, 1))  # (3, k)
        first = epochs[0]
        self._host_age = (int(first.received_us[0]) - memory.received_us) / 1e6
        self.gap = (int(first.time_us[0]) - memory.time_us) / 1e6 - float(
            first.dt[0]
        )  # s, sensors'

    @property
    def age(self) -> float:
        """How long it was, s: by the clock that says more."""
        return max(self._host_age, self.gap if self.gap < OLDEST else 0.0)

    @property
    def clock_ran_on(self) -> bool:
        """Whether the sensors' clock, and so their power, was not interrupted."""
        apart = abs(self.gap - self._host_age)
        return self.gap > 0.0 and apart < SAME_CLOCK + DRIFT * self._host_age

    def refusal(self) -> str:
        """Why the memory is of no use; empty: it is."""
        if self._host_age < 0.0:
            return f"{-self._host_age:.0f} s from the future: the clock went back"
        if self._host_age > OLDEST:
            return f"{self._host_age / 86400.0:.0f} days old, or the clock is wrong"
        if not self._are_many:
            return "" if self.clock_ran_on else "too few sensors to tell whether they are the same"
        if float((self._spread**2).sum()) > float((self._spread_without**2).sum()):
            return "the sensors' biases are others"
        return ""

    def changed(self, parameters: FusionParameters) -> Floats:
        """Variance of the change of each sensor's bias, (3,), (rad/s)^2."""
        walked = np.full(3, parameters.bias_walk**2 * self.age)
        if not self._are_many:
            return walked
        noise = MEDIAN_NOISE * np.nan_to_num(self._memory.gyros.noise) / len(self._times)
        scale = parameters.scale_error * float(np.linalg.norm(self._mean_rate))
        freedom = np.maximum(FREEDOM * self._trusted, 2.5)
        seen = (self._spread**2 - noise - scale**2) * freedom / (freedom - 2.0)
        changed: Floats = np.maximum(seen, walked)
        return changed

    def attitude(
        self, fusion: FusionParameters, parameters: AttitudeParameters, heading: HeadingParameters
    ) -> FilterMemory | None:
        """What was known of the attitude, or at least of the bias, as it is known now.

        If it is aligned, `steps` leads from then to now. None: it is known no better than at any
        start.
        """
        before = self._memory.attitude
        grown = np.maximum(
            self.changed(fusion) / np.maximum(self._trusted, 1),
            before.bias_walk**2 * self.age,
        )
        covariance = before.covariance.copy()
        covariance[BIAS_AXES, BIAS_AXES] += grown
        if before.aligned and before.levelled and self.clock_ran_on:
            yaw = math.sqrt(covariance[DOWN, DOWN] + self._turned_variance(parameters)[DOWN])
            if yaw < KNOWN_YAW:
                return structs.replace(before, covariance=covariance)
        return self._without_attitude(covariance, parameters, heading)

    def _without_attitude(
        self, covariance: Floats, parameters: AttitudeParameters, heading: HeadingParameters
    ) -> FilterMemory | None:
        """The errors of gyros and headings alone."""
        p = parameters
        keep = np.ones(STATES)
        keep[ATTITUDE] = keep[ACCELEROMETER] = 0.0
        kept = np.exp([-self.age / OFFSET_TIME, -self.age / LATE_TIME])
        keep[HEADING_AXES] = kept
        covariance = covariance * np.outer(keep, keep)
        fresh = np.zeros(STATES)
        fresh[LEVEL] = p.initial_tilt_std**2
        fresh[DOWN] = math.pi**2
        fresh[BIAS_AXES] = p.common_bias_walk**2 * self.age + EARTH_RATE**2
        fresh[ACCELEROMETER] = p.scale_std**2
        fresh[ACCELEROMETER.start : ACCELEROMETER.start + 3] = p.accel_bias_std**2
        wrong = np.array([heading.offset_std, heading.delay_std])
        fresh[HEADING_AXES] = wrong**2 * (1.0 - kept**2)
        covariance += np.diag(fresh)
        if (covariance[BIAS_AXES, BIAS_AXES] > p.initial_bias_std**2).any():
            return None
        errors = np.concatenate((np.zeros(3), self._memory.attitude.errors)) * keep
        return structs.replace(
            self._memory.attitude,
            q_nb=np.array([1.0, 0.0, 0.0, 0.0]),
            rate_b=np.zeros(3),
            errors=errors[3:],
            covariance=covariance,
            aligned=False,
            levelled=False,
            resting=False,
        )

    def steps(self, parameters: AttitudeParameters) -> Iterator[tuple[FusedRate, float]]:
        """Lead a filter through the gap: rates, with what is not known of them, and times."""
        before, bias_b = self._memory.attitude.rate_b, self._memory.attitude.bias_b
        count = max(math.ceil(self.gap / STEP), 1)
        dt = self.gap / count
        noise = self._turned_variance(parameters) / count / dt**2
        for i in range(count):
            after = (i + 0.5) / count
            rate_b = (1.0 - after) * before + after * self._first_rate + bias_b
            yield FusedRate(0, rate_b, UNKNOWN, np.zeros(3, int), 0, noise, np.zeros(3)), dt

    def _turned_variance(self, parameters: AttitudeParameters) -> Floats:
        """Of what the vehicle turned in the gap, (3,), rad^2.

        Before and after it is level within `initial_tilt_std`.
        """
        turned = (STANDING_RATE * self.gap) ** 2 if self._stood else RATE_WALK**2 * self.gap**3 / 12
        tilted = min(turned, 2.0 * parameters.initial_tilt_std**2)
        return np.array([tilted, tilted, turned])

    @property
    def _trusted(self) -> NDArray[np.int64]:
        """How many channels of each axis were trusted and have been heard, (3,)."""
        trusted: NDArray[np.int64] = np.isfinite(self._apart).sum(axis=1)
        return trusted

    @property
    def _are_many(self) -> bool:
        return bool(self._trusted.min() >= FEWEST_SENSORS)

    @cached_property
    def _apart(self) -> Floats:
        """How far each channel is from the others, the bias remembered taken off, (3, n), rad/s.

        NaN: it was not trusted, or is silent.
        """
        return _median(self._relative - self._centre[:, np.newaxis])

    @cached_property
    def _spread(self) -> Floats:
        """Standard deviation of the channels, (3,), rad/s, the biases remembered taken off."""
        return _deviation(self._apart)

    @cached_property
    def _spread_without(self) -> Floats:
        return _deviation(self._apart + self._memory.gyros.bias)

    @cached_property
    def _mean_rate(self) -> Floats:
        """Of the vehicle over the trial, (3,), rad/s."""
        return np.nan_to_num(_median(self._centre) - self._memory.attitude.bias_b)

    @cached_property
    def _first_rate(self) -> Floats:
        """Of the vehicle when it was seen again, (3,), rad/s."""
        soon = self._times <= SOON
        return np.nan_to_num(_median(self._centre[:, soon]) - self._memory.attitude.bias_b)

    @cached_property
    def _stood(self) -> bool:
        """Whether the vehicle rested before and rests now."""
        if not self._memory.attitude.resting or self.gap > STOOD:
            return False
        if any(motion.speed > STANDING_SPEED for motion in self._motions):
            return False
        if not self._trusted.all():
            return False
        quiet = np.nanstd(self._centre, axis=1) < QUIET[:3]
        return bool(quiet.all() and (np.abs(self._mean_rate) < STANDS).all())


def _median(values: Floats) -> Floats:
    """Median of what is finite along the last axis; NaN: nothing is."""
    (median,) = quantiles(values.reshape(-1, values.shape[-1]), (0.5,))
    reshaped: Floats = median.reshape(values.shape[:-1])
    return reshaped


def _deviation(channels: Floats) -> Floats:
    """Robust standard deviation of the finite channels of each axis, (3, n) -> (3,)."""
    distance = np.abs(channels - _median(channels)[:, np.newaxis])
    count = np.minimum(np.isfinite(channels).sum(axis=1), len(MAD_FACTORS) - 1)
    deviation: Floats = MAD_FACTORS[count] * _median(distance)
    return deviation
