"""What is done with a heading: fused, rejected, or believed against the filter.

A filter's gate judges one heading at a time. That is not enough: a receiver that is led astray
slowly stays within the gate and takes yaw with it, and a filter that is itself wrong rejects all
that is right. So the headings are judged together.

- The mean of the last innovations must be as small as that of so many independent ones: in a filter
  whose model holds they are white (Kailath, "An innovations approach to least-squares estimation",
  IEEE Transactions on Automatic Control 13(6), 1968). A slow drift shows there long before it shows
  in one innovation.
- Headings that the receiver's own positions contradict are not used.
- Yaw is set anew by rejected headings only if they agree with one another and with the gyros, which
  is to say if they are all off by the same angle, as far as the gyros' bias is known, and if they
  do so for as long as yaw was confirmed before: ten seconds of headings do not outweigh minutes.
  If yaw turns away from them steadily and faster than that, and has done so for a minute, or since
  the start, the gyros' offset is larger than was presumed: it is then as uncertain as that is fast.
- The course of a vehicle in reverse is turned round.
- A heading of before a gap in the readings, that comes after it, does not tell what the vehicle has
  turned in the gap, and is not used; nor is one that comes before the first reading.
- A gyro that is alone and repeats its reading while GPS tells of motion is frozen: yaw is unknown.
  Where there are more, the fusion finds out by itself.
- Near a pole, where north turns with the way, yaw is not claimed to be known.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from risaf_link.core.attitude import UNSEEN_TURN, Innovation, PaperFilter
from risaf_link.core.eskf import Eskf
from risaf_link.core.gear import STANDING_SPEED, Gear
from risaf_link.core.heading import Heading, HeadingParameters, HeadingSource, Motion
from risaf_link.core.rotation import Floats, wrap
from risaf_link.core.track import BIAS_STD, FUSED, VALID, Track

SIDE_SLIP = 0.002  # rad for each m/s^2 to the side: road and load; the rest looks like a delay
MEMORY = 15  # innovations in a mean
LONG_MEMORY = 30  # corrections of yaw that a drift may have made before it shows
MEAN_GATE = 4.0  # standard deviations of the mean beyond which headings are rejected
MEAN_TRUST = 2.5  # and within which they are trusted again
LONGEST_DEFENCE = 6.0  # times `reset_after` for which a yaw is defended at most
OPPOSITE = -math.sqrt(0.5)  # cosine of an innovation beyond which a heading is opposite to yaw
BIAS_GATE = 5.0  # standard deviations by which the bias may be off, for the gyros to agree
AGREEMENT = 0.02  # rad by which headings of a dispute may differ, besides their noise
MANY = 6  # headings that are no line by chance
LARGEST_OFFSET = 0.35  # rad/s; 20 deg/s, of the cheapest gyros
FROZEN_AFTER = 1.0  # s of one reading on the move: filtered counts may stand still on calm water
RATES = 1024  # epochs; a second at 1 kHz
NO_READING: Floats = np.full((1, 3), math.nan)
ROOM = 4 * RATES  # so that room has to be made only now and then
RATE_SPAN = 0.1  # s before and after, over which a past rate is taken
SHORTEST_GAP = 0.1  # s; what is shorter is turned all but steadily
LONG_STEPS = 3.0  # usual steps; likewise

Estimator = Eskf | PaperFilter
Measured = tuple[float, float, float]
"""rad, rad^2, s ago: a heading of the vehicle."""


class Refused(Innovation, frozen=True):
    """An innovation that was not used, though it may be within the gate."""

    @property
    def fused(self) -> bool:
        """False."""
        return False


class Whiteness:
    """Whether innovations have a mean that independent ones would not have.

    Attributes
    ----------
    is_broken : bool
    doubt : float
        rad, by which yaw may have been led astray before that showed.
    """

    def __init__(self) -> None:
        self._mean = 0.0  # of innovations in their standard deviations
        self._pulled = 0.0  # rad, by the last innovations together
        self.is_broken = False
        self.doubt = 0.0

    def add(self, innovation: Innovation) -> None:
        """Take the next innovation, one within the gate."""
        ratio = innovation.value / math.sqrt(innovation.variance)
        self._mean += (ratio - self._mean) / MEMORY
        size = abs(self._mean) * math.sqrt(2 * MEMORY - 1)  # in its own standard deviations
        self.is_broken = size > (MEAN_TRUST if self.is_broken else MEAN_GATE)

    def note_refused(self) -> None:
        """Take note that a heading was not used: those before it may have been wrong already."""
        self.doubt = max(self.doubt, abs(self._pulled))

    def note_contradiction(self, innovation: Innovation) -> None:
        """Take note of a heading that speaks against a yaw for which little speaks."""
        self.doubt = max(self.doubt, abs(innovation.value))

    def pause(self) -> None:
        """Forget the innovations; what they did to yaw remains."""
        self._mean = self._pulled = 0.0
        self.is_broken = False

    def note_fused(self, innovation: Innovation, noise: float) -> None:
        """Take note that yaw was corrected, by a heading of this variance, rad^2."""
        gain = 1.0 - noise / innovation.variance
        self._pulled += gain * innovation.value - self._pulled / LONG_MEMORY
        self.doubt *= 1.0 - gain


class Dispute:
    """Headings rejected one after another.

    Parameters
    ----------
    longest : float
        Seconds for which they are remembered.
    """

    def __init__(self, longest: float) -> None:
        self.longest = longest
        self._since = 0.0
        self._rejected: deque[tuple[float, float, float]] = deque()  # s, rad, rad^2

    def settle(self) -> None:
        """Take note of a heading that was fused, or of a pause."""
        self._rejected.clear()

    def add(self, time_s: float, error: float, variance: float) -> None:
        """Take an innovation, rad, and the variance of its heading."""
        if not self._rejected:
            self._since = time_s
        self._rejected.append((time_s, error, variance))
        while time_s - self._rejected[0][0] > self.longest:
            self._rejected.popleft()

    def drift(self, after: float, fastest: float, fewest: int = 2) -> float | None:
        """How fast yaw has turned away from headings that agree with one another, rad/s.

        They agree if they have been on one line for `after` seconds. None: they do not, or yaw has
        turned away faster than `fastest`, rad/s, or fewer than `fewest` have come.
        """
        last_s, *_ = self._rejected[-1]
        if last_s - self._since < after:
            return None
        recent = np.array([row for row in self._rejected if last_s - row[0] <= after])
        times, errors, variances = recent.T
        if len(times) < fewest or times[0] >= last_s - after / 2.0:
            return None
        errors, times = np.unwrap(errors), times - times.mean()
        errors -= errors.mean()
        slope = float(times @ errors / (times @ times))
        rest = float((errors - slope * times).std())
        noise = math.sqrt(float(variances.mean()))
        uncertain = (AGREEMENT + 6.0 * noise / math.sqrt(len(errors))) / (after / 2.0)
        agree = rest < AGREEMENT + 2.0 * noise and abs(slope) < fastest + uncertain
        return slope if agree else None


class HeadingGuard:
    """Stands between headings and a filter.

    Parameters
    ----------
    parameters : HeadingParameters
    filter_knows : bool
        Whether the filter itself models that headings are off and late.

    Attributes
    ----------
    gear : Gear
    """

    def __init__(self, parameters: HeadingParameters, filter_knows: bool) -> None:
        self._parameters = parameters
        self._filter_knows = filter_knows
        self.gear = Gear()
        self._whiteness = Whiteness()
        self._dispute = Dispute(LONGEST_DEFENCE * parameters.reset_after)
        self._elapsed = 0.0  # s
        self._last = -math.inf  # s, when the last heading came
        self._unread: list[tuple[Track, Floats, Floats]] = []  # what `advance` was told
        self._unread_epochs = 0
        self._turned = np.zeros((ROOM, 4))  # rad, the rate's integral in body axes; s
        self._turns = 1  # how many of them are known
        self._usual = math.inf  # s, from epoch to epoch
        self._gap_end = -math.inf  # s, of the last gap in them
        self._rates: dict[float, tuple[float, float, float]] = {}  # of some ages, rad/s, as of now
        self._aligned = False
        self._bias_std = 0.0  # rad/s, on the axis on which it is largest
        self._confirmed = 0.0  # s for which headings have agreed with yaw
        self._is_hearsay = False  # yaw is remembered, and no heading has agreed with it since
        self._reading = NO_READING  # the last one of a gyro that is alone
        self._changed = 0.0  # s, when it was another

    def configure(self, parameters: HeadingParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self._parameters = parameters
        self._dispute.longest = LONGEST_DEFENCE * parameters.reset_after

    def note_hearsay(self) -> None:
        """Take note that yaw is remembered from before a restart: it is not defended for long."""
        self._is_hearsay = True

    def advance(self, track: Track, elapsed: Floats, dt: Floats) -> None:
        """Take note of k epochs: the time of each, s, and since the one before, (k,).

        The track is given the doubt about yaw that headings have left, which no filter knows of.
        """
        self._unread.append((track, elapsed, dt))
        self._unread_epochs += len(dt)
        if self._unread_epochs >= RATES:
            self._catch_up()
        if self._whiteness.doubt:
            doubted = np.hypot(track.yaw_std, self._whiteness.doubt)
            track.yaw_std[:] = np.minimum(doubted, math.pi)

    def _catch_up(self) -> None:
        """Read the epochs since the last fix, together: one by one each would cost as much."""
        if not self._unread:
            return
        track, elapsed, dt = self._unread[0]
        if len(self._unread) > 1:
            tracks, times, steps = zip(*self._unread, strict=True)
            track = Track(np.concatenate([each.values for each in tracks]))
            elapsed, dt = np.concatenate(times), np.concatenate(steps)
        self._unread, self._unread_epochs = [], 0
        self._rates.clear()
        self._note_gaps(elapsed, dt)
        self._turn(track.rate_b, elapsed, dt)
        self._note_readings(track.values, elapsed)
        self.gear.feel(track.ahead, dt)
        self._elapsed = float(elapsed[-1])
        self._aligned = bool(track.aligned[-1])
        self._bias_std = float(track.values[-1, BIAS_STD].max())

    def _note_gaps(self, elapsed: Floats, dt: Floats) -> None:
        """Take note of the last step that is much longer than usual."""
        steps = sorted(dt.tolist())  # quicker than NumPy on the few that come between two fixes
        usual = steps[len(steps) // 5]
        self._usual = usual if usual < self._usual else 0.9 * self._usual + 0.1 * usual
        longest = max(SHORTEST_GAP, LONG_STEPS * self._usual)
        if steps[-1] > longest:
            self._gap_end = float(elapsed[np.flatnonzero(dt > longest)[-1]])

    def _note_readings(self, values: Floats, elapsed: Floats) -> None:
        """Take note of when a gyro that is alone read something else."""
        is_alone = values[:, VALID] == 1
        if not is_alone.any():
            self._reading, self._changed = NO_READING, float(elapsed[-1])
            return
        alone = np.where(is_alone[:, np.newaxis], values[:, FUSED], math.nan)
        readings = np.concatenate((self._reading, alone))
        changed = np.flatnonzero((readings[1:] != readings[:-1]).any(axis=1))  # so does NaN
        if len(changed):
            self._changed = float(elapsed[changed[-1]])
        self._reading = readings[-1:]

    def _turn(self, rate_b: Floats, elapsed: Floats, dt: Floats) -> None:
        """Go on with the rate's integral."""
        if self._turns + len(dt) > len(self._turned):
            kept = self._turned[max(self._turns - RATES, 0) : self._turns]
            self._turned = np.empty((ROOM + len(dt), 4))
            self._turned[: len(kept)] = kept
            self._turns = len(kept)
        if self._turns == 1:  # it begins where the first epoch does
            self._turned[0, 3] = elapsed[0] - dt[0]
        last, fresh = self._turned[self._turns - 1], self._turned[self._turns :][: len(dt)]
        turns = fresh[:, :3]
        np.multiply(rate_b, dt[:, np.newaxis], out=turns)
        turns[0] += last[:3]
        if len(dt) > 1:
            np.add.accumulate(turns, axis=0, out=turns)
        fresh[:, 3] = elapsed
        self._turns += len(dt)

    def take(self, estimator: Estimator, motion: Motion) -> Innovation | None:
        """Use what one fix says; None: it says nothing of heading."""
        self._catch_up()
        self._hear(motion)
        moves = motion.speed > self._parameters.min_speed  # false for NaN
        if motion.polar or (moves and self._elapsed - self._changed > FROZEN_AFTER):
            self._whiteness.doubt = math.pi
            self._confirmed = 0.0
        if motion.heading is None or not self._tells_of_now(motion.heading):
            return None
        pause = self._elapsed - self._last
        self._last = self._elapsed
        if pause > self._parameters.timeout:
            self._pause(pause)
        if not self._aligned:
            self.gear.align()
            return self._set(estimator.correct_heading, self._measured(motion))
        if _is_course(motion) and self.gear.denies_yaw:
            self.gear.turn_round()
            return self._set(estimator.reset_heading, self._measured(motion))
        return self._judge(estimator, motion, pause)

    def _tells_of_now(self, heading: Heading) -> bool:
        """Whether what was turned since is known: there are epochs, and no gap in them."""
        read_s = self._elapsed - self._parameters.delay - heading.age
        return self._turns > 1 and read_s >= self._gap_end

    def ahead(self, motion: Motion) -> float:
        """Speed of the vehicle, not the antenna, ahead, m/s, by the fix that was just taken.

        Negative backwards.
        """
        rate_x, rate_y, rate_z = self._rate_before(self._parameters.delay)
        x, y, z = self._parameters.antenna
        across = rate_z * x - rate_x * z
        along = math.sqrt(max(motion.speed**2 - across**2, 0.0))
        return self.gear.sign * along + rate_z * y - rate_y * z

    def _hear(self, motion: Motion) -> None:
        """Let the gear be known by speed, and by course where yaw is measured."""
        if not motion.along or motion.contradicted:
            return
        if math.isfinite(motion.speed):
            self.gear.hear(motion.speed, motion.speed_std, self._elapsed)
        if motion.heading and not _is_course(motion) and math.isfinite(motion.course):
            ahead = math.cos(motion.course - motion.heading.heading) > 0.0
            self.gear.confirm(1 if ahead else -1)

    def _judge(self, estimator: Estimator, motion: Motion, pause: float) -> Innovation:
        gate = self._parameters.gate
        measured, compared = self._compare(estimator, motion)
        if compared is None:
            return estimator.correct_heading(*measured, gate)
        if not motion.contradicted:
            if compared.test_ratio <= 1.0:
                self._whiteness.add(compared)
                if not self._whiteness.is_broken:
                    self._whiteness.note_fused(compared, measured[1])
                    return self._fuse(estimator, motion, measured, pause)
            self._dispute.add(self._elapsed, compared.value, measured[1])
            offset = self._offset_if_lost(compared, motion)
            if offset is not None:
                estimator.doubt_bias(offset)
                return self._set(estimator.reset_heading, measured)
            if self._is_unconfirmed:
                self._whiteness.note_contradiction(compared)
        self._whiteness.note_refused()
        return Refused(compared.value, compared.variance, gate)

    def _fuse(
        self, estimator: Estimator, motion: Motion, measured: Measured, pause: float
    ) -> Innovation:
        self._dispute.settle()
        self._is_hearsay = False
        if pause <= self._parameters.timeout:
            self._confirmed += pause
        if _is_course(motion):
            self.gear.confirm(self.gear.sign)
        return estimator.correct_heading(*measured, self._parameters.gate)

    def _compare(self, estimator: Estimator, motion: Motion) -> tuple[Measured, Innovation | None]:
        """Hold a heading against the filter, in the gear that agrees with it."""
        gate = self._parameters.gate
        measured = self._measured(motion)
        compared = estimator.compare_heading(*measured, gate)
        if compared and compared.test_ratio > 1.0 and _is_course(motion) and self.gear.may_change:
            self.gear.sign = -self.gear.sign
            turned = self._measured(motion)
            other = estimator.compare_heading(*turned, gate)
            if other and other.test_ratio <= 1.0:
                return turned, other
            self.gear.sign = -self.gear.sign
        return measured, compared

    def _measured(self, motion: Motion) -> Measured:
        """Heading of the vehicle, where that measured is of an antenna's motion."""
        p, heading = self._parameters, motion.heading
        if heading is None:
            raise ValueError("motion: found no heading, expected one")
        age = p.delay + heading.age
        rate_x, _, rate_z = self._rate_before(age)
        blind = max(age - self._elapsed + float(self._turned[0, 3]), 0.0)  # before the first epoch
        angle, variance = heading.heading, heading.variance + (UNSEEN_TURN * blind) ** 2
        if _is_course(motion):
            across = rate_z * p.antenna[0] - rate_x * p.antenna[2]
            along = math.sqrt(max(motion.speed**2 - across**2, 0.0))
            angle -= math.atan2(across, self.gear.sign * along)
            variance += (SIDE_SLIP * motion.speed * rate_z) ** 2
        if not self._filter_knows:
            variance += p.offset_std**2 + (rate_z * p.delay_std) ** 2
        return wrap(angle), min(variance, math.pi**2), age

    def _set(
        self, how: Callable[[float, float, float, float], Innovation], measured: Measured
    ) -> Innovation:
        """Let a heading set yaw, by a method of the filter."""
        innovation = how(*measured, self._parameters.gate)
        self._aligned = self._aligned or innovation.reset
        self._whiteness = Whiteness()
        self._dispute.settle()
        self._confirmed = 0.0
        self._is_hearsay = False
        self.gear.confirm(self.gear.sign)
        return innovation

    def _pause(self, seconds: float) -> None:
        """Take note that there was no heading for a while: yaw is less certain."""
        self._confirmed = max(self._confirmed - seconds, 0.0)
        self._whiteness.pause()
        self._dispute.settle()
        self.gear.may_change = True

    def _patience(self, compared: Innovation, speed: float) -> float:
        """Seconds for which yaw is defended: as long as it was confirmed, within limits.

        At rest nothing but the antennas can have moved; on the move a vehicle does not turn round
        at once.
        """
        shortest = self._parameters.reset_after
        longest = self._dispute.longest
        if speed < STANDING_SPEED or self._is_hearsay:
            return shortest
        if math.cos(compared.value) < OPPOSITE:
            return longest
        return min(max(self._confirmed, shortest), longest)

    def _offset_if_lost(self, compared: Innovation, motion: Motion) -> float | None:
        """If yaw has lost the dispute, how far the gyros' bias must be off, rad/s; else None."""
        likely = BIAS_GATE * self._bias_std
        if self._dispute.drift(self._patience(compared, motion.speed), likely) is not None:
            return 0.0
        if not motion.is_news:  # the course of a frozen receiver is steady, too
            return None
        drift = self._dispute.drift(self._despair, LARGEST_OFFSET, fewest=MANY)
        return drift if drift is not None and abs(drift) > likely else None

    @property
    def _is_unconfirmed(self) -> bool:
        """Whether nothing speaks for yaw but one heading, and a presumed offset of the gyros."""
        return self._confirmed < self._parameters.reset_after and not self._is_hearsay

    @property
    def _despair(self) -> float:
        """Seconds after which the gyros are given up, however far their offset must be off."""
        return self._parameters.reset_after if self._is_unconfirmed else self._dispute.longest

    def _rate_before(self, age: float) -> tuple[float, float, float]:
        """Rate `age` seconds ago, rad/s, body."""
        if age not in self._rates:
            self._rates[age] = self._find_rate_before(age)
        return self._rates[age]

    def _find_rate_before(self, age: float) -> tuple[float, float, float]:
        known = self._turned[: self._turns]  # the oldest stands for what is older
        until_s = self._elapsed - max(age - RATE_SPAN, 0.0) + 1e-9
        since_s = self._elapsed - age - RATE_SPAN + 1e-9
        since, until = np.searchsorted(known[:, 3], (since_s, until_s), side="right").tolist()
        x, y, z, seconds = (known[max(until - 1, 0)] - known[max(since - 1, 0)]).tolist()
        return (x / seconds, y / seconds, z / seconds) if seconds > 0.0 else (0.0, 0.0, 0.0)


def _is_course(motion: Motion) -> bool:
    """Whether its heading is the direction of motion."""
    return motion.heading is not None and motion.heading.source is not HeadingSource.DUAL_ANTENNA
