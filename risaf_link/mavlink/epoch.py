"""Chunks of samples -> whole epochs, in order; late, missing and duplicate ones are counted.

An epoch is handed on as soon as it is whole and all before it are. It waits for a missing chunk no
longer than `max_wait` of the array's own time; then it goes on with what it has.

The number of sensors is taken from who knows it: the configuration, the calibration or the array
itself (IMU_ARRAY_INFO); otherwise it is the largest seen. It grows at once, and shrinks when the
last sensors have been silent for `SHRINK_AFTER` epochs.

Time is the array's. When it jumps (the array was rebooted, or its clock was set) the open epochs
are handed on, the jump is counted, and the length of the step is taken from the arrival times.
"""

from collections import Counter, deque
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from risaf_link.core.fusion import Epoch
from risaf_link.core.rotation import Floats

Encoding = Literal["GYRO_ARRAY", "DEBUG_FLOAT_ARRAY", "IMU"]

JUMP_US = 1_000_000  # a step back of more is a new clock, not a late frame
SHRINK_AFTER = 200  # epochs
REMEMBERED = 64  # epochs handed on, to tell late chunks from duplicates
FIRST_TOLERANCE_US = 2_000  # of one instant, before the sample period is known
REVIEW = 32  # epochs, after which it is reviewed what an epoch waits for
MAX_OPEN = 64  # epochs
MAX_SENSORS = 4096


class ArrayParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Which array is listened to, and how its epochs are put together."""

    encodings: tuple[Encoding, ...] = ("GYRO_ARRAY", "DEBUG_FLOAT_ARRAY", "IMU")
    id: Annotated[int, Meta(ge=0, le=255)] | None = None
    sensors: Annotated[int, Meta(ge=0, le=MAX_SENSORS)] = 0
    max_wait: Annotated[float, Meta(ge=0, le=1)] = 0.025
    gyro_scale: Annotated[float, Meta(ge=0)] = 0.0
    gyro_range: Annotated[float, Meta(ge=0)] = 0.0
    calibration: str = ""


class Source(NamedTuple):
    """Where samples come from."""

    system: int
    component: int
    encoding: Encoding
    array_id: int


@dataclass(frozen=True, slots=True)
class GyroChunk:
    """Readings of some sensors of an array at one instant, as one frame carries them."""

    source: Source
    time_us: int
    received_us: int
    first_sensor: int
    rates_s: Floats  # (m, 3) rad/s, each in its sensor's axes; NaN: no valid reading; m may be 0
    forces_s: Floats  # (m, 3) m/s^2, likewise
    sequence: int | None = None  # number of the epoch, modulo 65536
    sensors: int = 0  # gyros that the array says it has; 0: it does not say
    loose: bool = False  # stamps within one epoch differ by up to half a sample period
    padded: bool = False  # NaN behind the last reading is padding


@dataclass
class _Readings:
    """What has come of one quantity in one epoch."""

    values: Floats
    came: NDArray[np.bool_]

    @classmethod
    def none(cls, size: int) -> "_Readings":
        return cls(np.full((size, 3), np.nan), np.zeros(size, dtype=bool))

    def put(self, first: int, values: Floats) -> bool:
        """Take values for sensors from `first` on; False if any of them had come before."""
        end = first + len(values)
        if end > len(self.came):
            grown = _Readings.none(end)
            grown.values[: len(self.came)] = self.values
            grown.came[: len(self.came)] = self.came
            self.values, self.came = grown.values, grown.came
        if self.came[first:end].any():
            return False
        self.values[first:end] = values
        self.came[first:end] = True
        return True

    def sized(self, size: int) -> Floats:
        """Fit the values to `size` sensors, NaN where nothing came."""
        if size == len(self.values):
            return self.values
        fitted = np.full((size, 3), np.nan)
        fitted[: len(self.values)] = self.values[:size]
        return fitted


@dataclass
class _OpenEpoch:
    time_us: int
    received_us: int
    sequence: int | None
    gyros: _Readings
    accels: _Readings


@dataclass
class _Size:
    """How many sensors of one kind there are, and whether an epoch has to wait for them."""

    expected: int = 0
    awaited: bool = False
    _told: int = 0
    _seen: int = 0  # since the last review
    _instants: int = 0  # likewise
    _epochs: int = 0  # likewise
    _last_us: int = -1

    def tell(self, size: int) -> bool:
        """Believe what the array says; True if that is a change."""
        if size in (0, self._told):
            return False
        changed = self.expected not in (0, size)
        self._told = self.expected = self._seen = size
        return changed

    def see(self, size: int, time_us: int) -> bool:
        """Take note of the highest sensor in a chunk; True if there are more than expected."""
        self._seen = max(self._seen, size)
        self._instants += time_us != self._last_us
        self._last_us = time_us
        if not 0 < self.expected < size:
            return False
        self.expected = size
        return True

    def end_epoch(self) -> bool:
        """Review at times; True if there are fewer than expected."""
        self._epochs += 1
        self.expected = self.expected or self._seen
        if self._epochs == 1 or self._epochs % REVIEW == 0:
            self.awaited = 2 * self._instants > min(self._epochs, REVIEW)
            self._instants = 0
        if self._epochs < SHRINK_AFTER:
            return False
        shrinks = self._told == 0 and self._seen < self.expected
        self.expected = self._seen if shrinks else self.expected
        self._seen = self._epochs = 0
        return shrinks


class EpochAssembler:
    """Puts the chunks of one array together.

    Attributes
    ----------
    counts : Counter
        `epochs`, `incomplete` epochs, `samples_lost`; chunks `late`, `duplicate`, `out_of_range`;
        instants `without_gyros`; `clock_resets` (back), `clock_jumps` (ahead), `size_changes`,
        `source_changes`.
    """

    def __init__(self, parameters: ArrayParameters) -> None:
        self.counts: Counter[str] = Counter()
        self._parameters = parameters
        self._max_wait_us = round(parameters.max_wait * 1e6)
        self._source: Source | None = None
        self._last: _OpenEpoch | None = None  # handed on
        self._jumped = False  # the clock, since then
        self._steps_us: deque[int] = deque(maxlen=15)
        self._start(None)

    @property
    def sensors(self) -> int:
        """How many gyros the array has, as far as is known."""
        return self._gyros.expected

    @property
    def source(self) -> Source | None:
        """Where the samples come from."""
        return self._source

    def add(self, chunk: GyroChunk) -> list[Epoch]:
        """Take one chunk; hand on what is whole now, in order."""
        if chunk.first_sensor + max(len(chunk.rates_s), len(chunk.forces_s)) > MAX_SENSORS:
            self.counts["out_of_range"] += 1
            return []
        epochs = self._follow(chunk)
        self._learn_sizes(chunk)
        epoch = self._epoch_of(chunk)
        if epoch is None:
            return epochs
        new = epoch.gyros.put(chunk.first_sensor, chunk.rates_s)
        new &= epoch.accels.put(chunk.first_sensor, chunk.forces_s)
        self.counts["duplicate"] += not new
        return epochs + self._ready()

    def flush(self) -> list[Epoch]:
        """Hand on all that is open."""
        return [epoch for time_us in sorted(self._open) for epoch in self._close(time_us)]

    def _start(self, source: Source | None) -> None:
        """Start anew on an array of which nothing is known."""
        self._source = source
        self._gyros, self._accels = _Size(), _Size()
        self._gyros.tell(self._parameters.sensors)
        self._open: dict[int, _OpenEpoch] = {}
        self._closed: deque[_OpenEpoch] = deque(maxlen=REMEMBERED)
        self._newest_us = self._newest_received_us = 0

    def _follow(self, chunk: GyroChunk) -> list[Epoch]:
        """Follow the array when another takes its place, or when its clock jumps."""
        if self._source is None:
            self._start(chunk.source)
            self._newest_us, self._newest_received_us = chunk.time_us, chunk.received_us
        ahead = chunk.time_us - self._newest_us
        passed = chunk.received_us - self._newest_received_us
        epochs: list[Epoch] = []
        if chunk.source != self._source:
            epochs = self._jump("source_changes")
            self._start(chunk.source)
        elif ahead < -JUMP_US:
            epochs = self._jump("clock_resets")
        elif ahead > passed + JUMP_US:
            epochs = self._jump("clock_jumps")
        if epochs or ahead > 0 or self._jumped:
            self._newest_us, self._newest_received_us = chunk.time_us, chunk.received_us
        return epochs

    def _jump(self, reason: str) -> list[Epoch]:
        self.counts[reason] += 1
        epochs = self.flush()
        self._closed.clear()
        self._jumped = True
        return epochs

    def _learn_sizes(self, chunk: GyroChunk) -> None:
        changes = 0
        if self._parameters.sensors == 0:
            changes += self._gyros.tell(chunk.sensors)
        for size, values in ((self._gyros, chunk.rates_s), (self._accels, chunk.forces_s)):
            if len(values):
                used = _used(values) if chunk.padded else len(values)
                changes += size.see(chunk.first_sensor + used, chunk.time_us)
        self.counts["size_changes"] += changes

    def _epoch_of(self, chunk: GyroChunk) -> _OpenEpoch | None:
        """The epoch that a chunk belongs to; None (counted) if that was handed on before."""
        tolerance_us = self._tolerance_us() if chunk.loose else 0
        for time_us in self._open:
            if abs(time_us - chunk.time_us) <= tolerance_us:
                return self._open[time_us]
        if self._closed and chunk.time_us <= self._closed[-1].time_us + tolerance_us:
            self.counts["duplicate" if self._is_known(chunk, tolerance_us) else "late"] += 1
            return None
        self._open[chunk.time_us] = _OpenEpoch(
            chunk.time_us,
            chunk.received_us,
            chunk.sequence,
            _Readings.none(self._gyros.expected),
            _Readings.none(self._accels.expected),
        )
        return self._open[chunk.time_us]

    def _is_known(self, chunk: GyroChunk, tolerance_us: int) -> bool:
        """Whether all readings of a chunk are part of an epoch that was handed on."""
        gyros = slice(chunk.first_sensor, chunk.first_sensor + len(chunk.rates_s))
        accels = slice(chunk.first_sensor, chunk.first_sensor + len(chunk.forces_s))
        return any(
            len(epoch.gyros.came) >= gyros.stop
            and len(epoch.accels.came) >= accels.stop
            and epoch.gyros.came[gyros].all()
            and epoch.accels.came[accels].all()
            for epoch in self._closed
            if abs(epoch.time_us - chunk.time_us) <= tolerance_us
        )

    def _ready(self) -> list[Epoch]:
        epochs = []
        while self._open:
            oldest = self._open[min(self._open)]
            waited_us = self._newest_us - oldest.time_us
            overdue = waited_us > self._max_wait_us or len(self._open) > MAX_OPEN
            if not (overdue or self._is_whole(oldest)):
                break
            epochs += self._close(oldest.time_us)
        return epochs

    def _is_whole(self, epoch: _OpenEpoch) -> bool:
        return self._gyros.expected > 0 and all(
            readings.came[: size.expected].sum() >= size.expected
            for size, readings in ((self._gyros, epoch.gyros), (self._accels, epoch.accels))
            if size.awaited or size is self._gyros
        )

    def _close(self, time_us: int) -> list[Epoch]:
        epoch = self._open.pop(time_us)
        if not epoch.gyros.came.any():
            self.counts["without_gyros"] += 1
            return []
        self.counts["size_changes"] += self._gyros.end_epoch() + self._accels.end_epoch()
        expected = self._gyros.expected
        missing = expected - int(epoch.gyros.came[:expected].sum())
        dt = self._step(epoch)
        self.counts["epochs"] += 1
        self.counts["incomplete"] += missing > 0
        self.counts["samples_lost"] += missing + expected * self._epochs_between(epoch)
        self._last, self._jumped = epoch, False
        self._closed.append(epoch)
        rates = epoch.gyros.sized(expected)
        return [Epoch(time_us, dt, rates, epoch.accels.sized(self._accels.expected), missing)]

    def _step(self, epoch: _OpenEpoch) -> float:
        """Seconds since the epoch before: by the array's clock, by arrival if that jumped."""
        if self._last is None:
            return 0.0
        if self._jumped:
            return max(self._period_us(), epoch.received_us - self._last.received_us) / 1e6
        return (epoch.time_us - self._last.time_us) / 1e6

    def _epochs_between(self, epoch: _OpenEpoch) -> int:
        """How many epochs are missing between the last one and this; learns the period."""
        if self._last is None or self._jumped:
            return 0
        step_us = epoch.time_us - self._last.time_us
        period_us = self._period_us()
        self._steps_us.append(step_us)
        by_time = max(0, round(step_us / period_us) - 1) if period_us else 0
        if epoch.sequence is None or self._last.sequence is None:
            return by_time
        return min(by_time, (epoch.sequence - self._last.sequence - 1) % 65536)

    def _period_us(self) -> int:
        return round(median(self._steps_us)) if self._steps_us else 0

    def _tolerance_us(self) -> int:
        return self._period_us() // 2 or FIRST_TOLERANCE_US


def _used(values: Floats) -> int:
    """How many rows there are up to the last reading."""
    rows = np.flatnonzero(~np.isnan(values).all(axis=1))
    return int(rows[-1]) + 1 if len(rows) else 0
