"""What is in a log, and what the service could do with it."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from risaf_link.config import Config
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.heading import GpsFix
from risaf_link.core.history import History
from risaf_link.core.rotation import Floats
from risaf_link.errors import LogError
from risaf_link.links.file import read
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.dialect import name_of
from risaf_link.mavlink.epoch import EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.tlog import Stamps, TlogReader
from risaf_link.mavlink.truth import truths_in
from risaf_link.publish.events import GAP

REORDERED = 128  # a larger step of the sequence number is a frame out of order
MOST_ROWS = 128  # messages that are followed over time; garbage looks like any number of them
LEAST_COUNTED = 10  # messages in a part of the time, for a rate: fewer flicker
RARE = 50  # messages in all; what comes so seldom has no rate

Key = tuple[int, int, str]
"""System, component and name of a message."""


@dataclass
class MessageCount:
    """How often a message came, and when."""

    count: int = 0
    first_us: int = 0
    last_us: int = 0
    history: History | None = None  # how many, over the log's time; None: not followed

    def note(self, times_us: Stamps, log_time: Floats) -> None:
        """Take note of more: when they came, (m,) us and s from the start of the log."""
        if not self.count:
            self.first_us = int(times_us[0])
        self.count += len(times_us)
        self.last_us = int(times_us[-1])
        if self.history is not None:
            self.history.add(log_time, np.ones((len(log_time), 1)))

    @property
    def rate(self) -> float:
        """Hz, over the time in which the message came."""
        seconds = (self.last_us - self.first_us) / 1e6
        return (self.count - 1) / seconds if seconds > 0 else 0.0


@dataclass
class GpsQuality:
    """What the receiver offers."""

    fixes: int = 0
    with_course: int = 0
    with_yaw: int = 0
    fastest: float = 0.0  # m/s

    def note(self, fix: GpsFix) -> None:
        """Take note of one fix."""
        self.fixes += 1
        self.with_course += math.isfinite(fix.course)
        self.with_yaw += math.isfinite(fix.yaw)
        self.fastest = max(self.fastest, fix.speed if fix.speed > 0 else 0.0)


@dataclass
class Survey:
    """Findings. Times are the log's."""

    duration: float = 0.0  # s
    bytes_skipped: int = 0
    stamps_replaced: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    messages: dict[Key, MessageCount] = field(default_factory=dict)
    frames_lost: dict[tuple[int, int], int] = field(default_factory=dict)
    assembly: Counter[str] = field(default_factory=Counter)
    unused: Counter[str] = field(default_factory=Counter)
    encoding: str = ""
    sensors: int = 0
    epoch_rate: float = 0.0  # Hz
    gaps: list[tuple[float, float]] = field(default_factory=list)  # s since the first epoch; length
    gps: GpsQuality = field(default_factory=GpsQuality)
    truth: str = ""  # the message that carries it
    min_speed: float = 1.0  # m/s, below which course is not taken for heading


def survey(config: Config, path: Path, progress: Callable[[int], None] = lambda _: None) -> Survey:
    """Read a log through.

    Raises
    ------
    LogError
        If it cannot be read, or holds no frame.
    """
    reader = TlogReader(read(path, progress))
    surveyor = _Surveyor(config)
    for table, times_us in reader.tables():
        surveyor.take(table, times_us)
    found = surveyor.finish()
    if not found.messages:
        raise LogError(f"{path}: found no MAVLink frame, expected a tlog")
    found.dropped, found.bytes_skipped = reader.parser.dropped, reader.parser.skipped
    found.stamps_replaced = reader.stamps_replaced
    return found


class _Surveyor:
    """Counts what comes, table by table."""

    def __init__(self, config: Config) -> None:
        self._ingest = Ingest(config.array, config.gps, config.own)
        self._assembler = EpochAssembler(config.array)
        self._reader = BlockReader(self._ingest, self._assembler)
        self._found = Survey(
            assembly=self._assembler.counts,
            unused=self._ingest.counts,
            min_speed=config.heading.min_speed,
        )
        self._sequences: dict[int, int] = {}  # of each sender, the last
        self._first_us: int | None = None
        self._elapsed = 0.0  # s, at the last epoch

    def take(self, table: FrameTable, times_us: Stamps) -> None:
        """Take the next frames."""
        if self._first_us is None:
            self._first_us = int(times_us[0])
        log_time = (times_us.astype(np.int64) - self._first_us) / 1e6
        self._found.duration = max(self._found.duration, float(log_time.max()))
        self._count(table, times_us, log_time)
        self._count_missing(table)
        for item in self._reader.read(table, times_us):
            if isinstance(item, EpochBlock):
                self._note_steps(item.dt)
            else:
                self._take_frame(*item)
        for truth in truths_in(table, times_us):
            if len(truth.time_us):
                self._found.truth = truth.message

    def finish(self) -> Survey:
        """What was found."""
        found, assembler = self._found, self._assembler
        found.sensors = assembler.sensors
        found.encoding = assembler.source.encoding if assembler.source else ""
        if self._elapsed > 0.0:
            found.epoch_rate = assembler.counts["epochs"] / self._elapsed
        return found

    def _count(self, table: FrameTable, times_us: Stamps, log_time: Floats) -> None:
        cuts, messages = table.cuts, self._found.messages
        senders = cuts["system"].astype(np.int64) << 8 | cuts["component"]
        kinds, kind = np.unique(senders << 24 | cuts["message_id"], return_inverse=True)
        order = np.argsort(kind, kind="stable")
        ends = np.cumsum(np.bincount(kind))
        for key, rows in zip(kinds.tolist(), np.split(order, ends[:-1]), strict=True):
            named = (key >> 32, key >> 24 & 0xFF, name_of(key & 0xFFFFFF))
            if named not in messages:
                followed = len(messages) < MOST_ROWS
                messages[named] = MessageCount(history=History("sum", 1) if followed else None)
            messages[named].note(times_us[rows], log_time[rows])

    def _count_missing(self, table: FrameTable) -> None:
        """Count the frames that the sequence numbers of each sender leave out."""
        senders = table.cuts["system"].astype(np.int64) << 8 | table.cuts["component"]
        order = np.argsort(senders, kind="stable")
        firsts = np.flatnonzero(np.diff(senders[order], prepend=-1))
        sequences = table.cuts["sequence"].astype(np.int64)
        for rows in np.split(order, firsts[1:]):
            sender, numbers = int(senders[rows[0]]), sequences[rows]
            before = self._sequences.get(sender, int(numbers[0]) - 1)
            missing = (np.diff(numbers, prepend=before) - 1) % 256
            lost, key = int(missing[missing < REORDERED].sum()), (sender >> 8, sender & 0xFF)
            self._found.frames_lost[key] = self._found.frames_lost.get(key, 0) + lost
            self._sequences[sender] = int(numbers[-1])

    def _take_frame(self, frame: Frame, received_us: int) -> None:
        datum = self._ingest.decode(frame, received_us)
        if isinstance(datum, GpsFix):
            self._found.gps.note(datum)
        elif isinstance(datum, GyroChunk):
            self._note_steps(np.array([epoch.dt for epoch in self._assembler.add(datum)]))

    def _note_steps(self, dt: Floats) -> None:
        """Take note of how long each of some epochs, (k,) s, is after the one before."""
        if (dt > GAP).any():
            starts = self._elapsed + np.cumsum(dt) - dt
            gaps = zip(starts[dt > GAP].tolist(), dt[dt > GAP].tolist(), strict=True)
            self._found.gaps.extend(gaps)
        self._elapsed += float(dt.sum())


def paces(message: MessageCount, duration: float, parts: int) -> Floats:
    """Rate of a message over the time of a log, as a share of its median rate.

    Parameters
    ----------
    message : MessageCount
        One that was followed.
    duration : float
        Of the log, s.
    parts : int
        Into which its time is cut; a slow message has the same rate in several.

    Returns
    -------
    ndarray, shape (parts,)
        1 is the median of what is not 0; of a message that hardly ever came, 1 where it did.
    """
    if message.history is None:
        raise ValueError("message: found no history, expected one that was followed")
    is_rare = message.count < RARE
    wide = parts if is_rare else min(parts, message.count // LEAST_COUNTED)
    edges = np.linspace(0.0, duration, wide + 1)
    edges[-1] = max(duration, message.history.edges[-1])  # whose last step goes beyond the end
    counts = message.history.between(edges)[:, 0]
    came = counts > 0.0
    shares = came.astype(float) if is_rare else counts / np.median(counts[came])
    return shares[np.arange(parts) * wide // parts]


def verdict(found: Survey) -> str:
    """What the service could do with the log, in words."""
    if not found.sensors:
        return "No gyro samples: nothing to estimate from."
    parts = [
        f"{found.sensors} gyro{'s' if found.sensors > 1 else ''} from {found.encoding} at "
        f"{found.epoch_rate:.1f} Hz"
    ]
    gps = found.gps
    if gps.with_yaw:
        parts.append(f"heading from {gps.with_yaw} fixes with yaw")
    elif gps.with_course and gps.fastest >= found.min_speed:
        parts.append(
            f"heading from {gps.with_course} fixes with course, up to {gps.fastest:.1f} m/s"
        )
    elif gps.fixes:
        parts.append("GPS fixes, but too slow for a heading")
    else:
        parts.append("no GPS fix: the heading cannot be aligned")
    parts.append(f"truth from {found.truth}" if found.truth else "no truth to score against")
    return "; ".join(parts) + "."
