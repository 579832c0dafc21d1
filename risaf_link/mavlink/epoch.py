"""Chunks of samples -> whole epochs, in order; what is late, missing or duplicate is counted.

What the gyros read at one instant is an epoch. The rules:

1. An epoch is handed on when it is whole and follows directly on the one before. Else it waits for
   what is missing, but no longer than `max_wait` of the array's own time. The first one waits that
   long in any case, unless the array has said how many sensors it has.
2. An epoch is whole when all sensors are there that came, of late, more than half as often as the
   most regular one. So neither slow sensors nor silent ones hold up the others.
3. Accelerometers may be slower than gyros, or read at instants of their own. An epoch takes along
   what they read at its instant and, of those that did not, the newest reading before it that no
   other epoch has taken.
4. The array has as many sensors as it says (IMU_ARRAY_INFO) or as the configuration says, and at
   least as many as have come. It grows at once; it shrinks when the last sensors have been silent
   for `SHRINK_AFTER` epochs.
5. Time is the array's. A chunk whose time is far off is set aside, and so is one whose time its
   sequence number contradicts. When several in a row are, or nothing else has arrived for long, the
   clock has jumped (the array was rebooted, or its clock was set): what is open is handed on, and
   the length of the step is taken from the arrival times.
"""

from collections import Counter, deque
from operator import sub
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from risaf_link.core.fusion import Epoch, EpochBlock
from risaf_link.core.rotation import Floats
from risaf_link.mavlink.roster import Roster, fitted

Encoding = Literal["GYRO_ARRAY", "DEBUG_FLOAT_ARRAY", "IMU"]

MAX_SENSORS = 1024
MAX_OPEN = 64  # instants
REVIEW = 128  # epochs, after which it is reviewed whom an epoch waits for
SHRINK_AFTER = 8 * REVIEW
JUMP_US = 1_000_000  # more is far off
SET_US = 50_000  # so is what an epoch's number contradicts by more; 20 Hz go on at once below it
BELIEVED = 4  # chunks far off in a row
STEPS = 15  # from epoch to epoch; their median is the period


class ArrayParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Which array is listened to, and how its epochs are put together."""

    encodings: tuple[Encoding, ...] = ("GYRO_ARRAY", "DEBUG_FLOAT_ARRAY", "IMU")
    id: Annotated[int, Meta(ge=0, le=255)] | None = None
    sensors: Annotated[int, Meta(ge=0, le=MAX_SENSORS)] = 0
    max_wait: Annotated[float, Meta(ge=0, le=1)] = 0.025
    delay: Annotated[float, Meta(ge=0, le=1)] | None = None
    gyro_scale: Annotated[float, Meta(ge=0)] = 0.0
    gyro_range: Annotated[float, Meta(ge=0)] = 0.0
    calibration: str = ""


class Source(NamedTuple):
    """Where samples come from."""

    system: int
    component: int
    encoding: Encoding
    array_id: int


class GyroChunk(Struct, frozen=True):  # like Frame: there are hundreds a second
    """Readings of some sensors of an array at one instant, as one frame carries them."""

    source: Source
    time_us: int
    received_us: int
    first_sensor: int
    rates_s: Floats  # (m, 3) rad/s, each in its sensor's axes; NaN: no valid reading; m may be 0
    forces_s: Floats  # (m, 3) m/s^2, likewise
    sequence: int | None = None  # number of the epoch, modulo 65536
    sensors: int = 0  # gyros that the array says it has; 0: it does not say
    tolerance_us: int = 0  # two stamps that differ by less may be one instant

    @property
    def end(self) -> int:
        """Index behind the last sensor."""
        return self.first_sensor + max(len(self.rates_s), len(self.forces_s))

    @property
    def samples(self) -> int:
        """How many readings of one sensor there are."""
        return len(self.rates_s) + len(self.forces_s)


class RegularEpochs(EpochBlock, frozen=True):
    """Epochs in a row, each of which is whole and follows directly on the one before."""

    newest: GyroChunk  # the first of the last epoch; of these two, readings do not matter any more
    begun: GyroChunk  # the first of the last epoch's gyros
    end: int  # behind the row of the frame that made the last one whole, in its table
    asides: list[tuple[int, int]]  # rows between, each with the epoch before which it belongs


class EpochAssembler:
    """Puts the chunks of one array together.

    Attributes
    ----------
    counts : Counter
        `epochs`, and those that were `incomplete`; `size_changes` of the array, `source_changes`,
        `clock_resets` (back), `clock_jumps` (ahead); of samples, that is readings of one sensor:
        `samples_lost` (of gyros, that never came), `late`, `duplicate`, `astray` (far off),
        `unclaimed` (of accelerometers, no epoch came for them), `out_of_range`.
    source : Source or None
        Where the samples come from.
    last : GyroChunk or None
        What began the last epoch, by the present clock.
    """

    def __init__(self, parameters: ArrayParameters) -> None:
        self.counts: Counter[str] = Counter()
        self._parameters = parameters
        self._max_wait_us = round(parameters.max_wait * 1e6)
        self.source: Source | None = None
        self._gyros, self._accels = Roster(parameters.sensors), Roster()
        self._begun_by: dict[int, GyroChunk] = {}  # every epoch that waits
        self._newest: GyroChunk | None = None
        self._astray: list[GyroChunk] = []
        self.last: GyroChunk | None = None
        self._last_received_us: int | None = None  # when it came, by any clock of the array
        self._last_size = 0
        self._steps_us: deque[int] = deque(maxlen=STEPS)

    @property
    def sensors(self) -> int:
        """How many gyros the array has, as far as is known."""
        return self._gyros.size

    def add(self, chunk: GyroChunk) -> list[Epoch]:
        """Take one chunk; hand on what is ready now, in order."""
        if chunk.end > MAX_SENSORS:
            self.counts["out_of_range"] += chunk.samples
            return []
        if chunk.source != self.source:
            return self._change_source(chunk) + self._take(chunk)
        ahead_us, passed_us = self._since_newest(chunk)
        is_near = -JUMP_US <= ahead_us <= passed_us + JUMP_US
        if is_near and not self._is_contradicted(chunk, ahead_us, passed_us):
            self._drop_astray()
            return self._take(chunk)
        self._astray.append(chunk)
        if len(self._astray) < BELIEVED and passed_us <= JUMP_US:
            return []
        return self._change_clock("clock_jumps" if ahead_us > 0 else "clock_resets")

    def flush(self) -> list[Epoch]:
        """Hand on all that is open."""
        self._drop_astray()
        epochs = [self._close(time_us) for time_us in sorted(self._gyros.open)]
        self._drop_forces(leave=0)
        return epochs

    # Whole epochs at once

    def is_steady(self, told: int) -> bool:
        """Whether whole epochs that follow may be taken at once.

        That is so when nothing waits, when the size of the array is as before, and when an epoch
        that is whole has come from every sensor.

        Parameters
        ----------
        told : int
            How many gyros the array says it has; 0: it does not say.
        """
        last, newest = self.last, self._newest
        return (
            last is not None
            and newest is not None
            and newest.time_us == last.time_us
            and last.sequence is not None
            and not (self._begun_by or self._gyros.open or self._accels.open or self._astray)
            and 0 < self._last_size == self._gyros.size
            and (told in {0, self._gyros.told} or self._parameters.sensors > 0)
            and self._gyros.awaits_all
            and self._accels.awaits_all
        )

    @property
    def forces(self) -> int:
        """How many accelerometers the array has, as far as is known."""
        return self._accels.size

    @property
    def until_review(self) -> int:
        """How many epochs may be taken at once, at most."""
        return REVIEW - self.counts["epochs"] % REVIEW

    def take_block(self, block: RegularEpochs) -> None:
        """Take epochs as `add` would take their chunks; they are steady, and all sensors are in.

        The chunks of an epoch came together, those of either kind in the order of the sensors. The
        time goes on from `last` by no more than SET_US an epoch, and the sequence number by one.
        """
        times_us = block.time_us.tolist()
        if self.last is None or len(times_us) > self.until_review:
            raise ValueError("block: must follow on an epoch and end with the next review")
        for roster in (self._gyros, self._accels):
            roster.close_whole(times_us)
        self.counts["epochs"] += len(times_us)
        recent_us = [self.last.time_us, *times_us][-STEPS - 1 :]
        self._steps_us.extend(map(sub, recent_us[1:], recent_us))
        self._newest = block.newest
        self._close_steps(block.begun)

    # Sources and clocks

    def _change_source(self, chunk: GyroChunk) -> list[Epoch]:
        """Begin anew with an array of which nothing is known."""
        if self.source is not None:
            self.counts["source_changes"] += 1
        epochs = self._begin_clock(chunk)
        self.source = chunk.source
        self._gyros, self._accels = Roster(self._parameters.sensors), Roster()
        self._steps_us.clear()
        self._last_size = 0
        return epochs

    def _since_newest(self, chunk: GyroChunk) -> tuple[int, int]:
        """How much later than the newest chunk one was read, and how much later it arrived."""
        newest = self._newest or chunk
        passed_us = max(0, chunk.received_us - newest.received_us)
        return chunk.time_us - newest.time_us, passed_us

    def _is_contradicted(self, chunk: GyroChunk, ahead_us: int, passed_us: int) -> bool:
        """Whether a chunk's number speaks against its time: back, or ahead though none is missing.

        An array that paused has no numbers for it either, but then nothing arrived for as long.
        """
        newest, period_us = self._newest, self._period_us()
        if newest is None or newest.sequence is None or chunk.sequence is None or not period_us:
            return False
        step = (chunk.sequence - newest.sequence) % 65536
        if step > MAX_OPEN:
            return False
        if ahead_us < 0:
            return step > 0
        return ahead_us - max(passed_us, (step + 1) * period_us) > SET_US

    def _change_clock(self, reason: str) -> list[Epoch]:
        """Follow the clock of the chunks that were set aside."""
        self.counts[reason] += 1
        astray, self._astray = self._astray, []
        epochs = self._begin_clock(astray[0])
        return epochs + [epoch for chunk in astray for epoch in self.add(chunk)]

    def _begin_clock(self, chunk: GyroChunk) -> list[Epoch]:
        epochs = self.flush()
        self._gyros.gone.clear()
        self._accels.gone.clear()
        self._newest, self.last = chunk, None
        return epochs

    def _drop_astray(self) -> None:
        if self._astray:
            self.counts["astray"] += sum(chunk.samples for chunk in self._astray)
            self._astray.clear()

    # Chunks in

    def _take(self, chunk: GyroChunk) -> list[Epoch]:
        if self._newest is None or chunk.time_us > self._newest.time_us:
            self._newest = chunk
        if not self._parameters.sensors:
            self._gyros.tell(chunk.sensors)
        time_us = self._instant_of(chunk)
        if len(chunk.rates_s):
            self._take_rates(time_us, chunk)
        if len(chunk.forces_s):
            self._take_forces(time_us, chunk)
        return self._ready()

    def _instant_of(self, chunk: GyroChunk) -> int:
        """When the epoch that a chunk belongs to began."""
        time_us = chunk.time_us
        if not chunk.tolerance_us or time_us in self._gyros.open:
            return time_us
        known = (*self._gyros.open, *self._gyros.gone)
        nearest_us = min(known, key=lambda known_us: abs(known_us - time_us), default=time_us)
        return nearest_us if abs(nearest_us - time_us) < chunk.tolerance_us else time_us

    def _take_rates(self, time_us: int, chunk: GyroChunk) -> None:
        first, count = chunk.first_sensor, len(chunk.rates_s)
        self._gyros.see(first + count)
        gone = self._gyros.recall(time_us)
        if gone is not None:
            came = gone.mark(first, count)
            self._gyros.attend(first, came)
            new = int(np.count_nonzero(came))
            self.counts["late"] += new
        elif self.last is not None and time_us <= self.last.time_us:
            new = count
            self.counts["late"] += new
        else:
            self._begun_by.setdefault(time_us, chunk)
            new = self._gyros.put(time_us, first, chunk.rates_s)
        if new < count:
            self.counts["duplicate"] += count - new

    def _take_forces(self, time_us: int, chunk: GyroChunk) -> None:
        first, count = chunk.first_sensor, len(chunk.forces_s)
        self._accels.see(first + count)
        gone = self._accels.recall(time_us)
        if gone and gone.includes(first, count):
            self.counts["duplicate"] += count
            return
        if time_us in self._gyros.gone:
            self._accels.attend(first, np.ones(count, dtype=bool))
        new = self._accels.put(time_us, first, chunk.forces_s)
        if new < count:
            self.counts["duplicate"] += count - new
        self._drop_forces(leave=MAX_OPEN)

    def _drop_forces(self, leave: int) -> None:
        while len(self._accels.open) > leave:
            oldest = self._accels.open.pop(min(self._accels.open))
            self.counts["unclaimed"] += int(np.count_nonzero(oldest.came))

    # Epochs out

    def _ready(self) -> list[Epoch]:
        epochs = []
        while self._begun_by and self._newest is not None:
            oldest = self._begun_by[min(self._begun_by)]
            waited_us = self._newest.time_us - oldest.time_us
            overdue = waited_us > self._max_wait_us or len(self._begun_by) > MAX_OPEN
            if not (overdue or self._is_ready(oldest)):
                break
            epochs.append(self._close(oldest.time_us))
        return epochs

    def _is_ready(self, begun: GyroChunk) -> bool:
        """Whether an epoch is whole, as far as is known, and follows directly on the one before."""
        return (
            (self._last_size > 0 or self._gyros.told > 0)
            and self._gyros.is_whole(begun.time_us)
            and self._accels.is_whole(begun.time_us)
            and self._epochs_before(begun) == 0
        )

    def _close(self, time_us: int) -> Epoch:
        begun = self._begun_by.pop(time_us)
        gyros = self._gyros.close(time_us)
        self._gyros.attend(0, gyros.came)
        rates = fitted(gyros.values, max(self._gyros.size, len(gyros.came)), np.nan)
        forces = self._forces_until(time_us)
        lost = self._gyros.lost(gyros)
        self._count(len(rates), lost, self._epochs_before(begun))
        dt = self._step(begun)
        self._end_epoch(begun)
        return Epoch(time_us, dt, rates, forces, lost)

    def _forces_until(self, time_us: int) -> Floats:
        """Take what the accelerometers read at an instant or, of those that did not, before."""
        if not self._accels.open:
            return np.full((self._accels.size, 3), np.nan)
        if time_us in self._accels.open:
            self._accels.attend(0, self._accels.open[time_us].came)
        forces = np.full((self._accels.size, 3), np.nan)
        missing = np.ones(self._accels.size, dtype=bool)
        for read_us in sorted((t for t in self._accels.open if t <= time_us), reverse=True):
            instant = self._accels.close(read_us)
            came = fitted(instant.came, len(missing), False)
            taken = np.flatnonzero(came & missing)
            forces[taken] = instant.values[taken]
            missing[taken] = False
            self.counts["late"] += int(np.count_nonzero(came)) - len(taken)
        return forces

    def _count(self, size: int, lost: int, epochs_lost: int) -> None:
        self.counts["epochs"] += 1
        self.counts["incomplete"] += lost > 0
        self.counts["samples_lost"] += lost + epochs_lost * self._gyros.expected
        self.counts["size_changes"] += self._last_size not in (0, size)
        self._last_size = size

    def _step(self, begun: GyroChunk) -> float:
        """Seconds since the epoch before: by the array's clock, by arrival if that has jumped."""
        if self.last is not None:
            return (begun.time_us - self.last.time_us) / 1e6
        if self._last_received_us is None:
            return 0.0
        return max(self._period_us(), begun.received_us - self._last_received_us) / 1e6

    def _epochs_before(self, begun: GyroChunk) -> int:
        """How many epochs are missing between the last one and this."""
        if self.last is None:
            return 0
        step_us = begun.time_us - self.last.time_us
        period_us = self._period_us()
        by_time = max(0, round(step_us / period_us) - 1) if period_us else 0
        if begun.sequence is None or self.last.sequence is None:
            return by_time
        by_number = (begun.sequence - self.last.sequence - 1) % 65536
        return by_number if by_number <= MAX_OPEN else min(by_number, by_time)

    def _period_us(self) -> int:
        """From epoch to epoch; 0: not known."""
        steps_us = sorted(self._steps_us)
        return steps_us[len(steps_us) // 2] if steps_us else 0

    def _end_epoch(self, begun: GyroChunk) -> None:
        if self.last is not None:
            self._steps_us.append(begun.time_us - self.last.time_us)
        self._close_steps(begun)

    def _close_steps(self, begun: GyroChunk) -> None:
        self.last, self._last_received_us = begun, begun.received_us
        if self.counts["epochs"] % REVIEW == 0:
            most = self._gyros.attended.max()
            for roster in (self._gyros, self._accels):
                roster.review(most)
        if self.counts["epochs"] % SHRINK_AFTER == 0:
            for roster in (self._gyros, self._accels):
                roster.forget_silent()
