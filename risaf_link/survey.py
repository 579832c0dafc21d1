"""What is in a log, and what the service could do with it."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from risaf_link.config import Config
from risaf_link.core.heading import GpsFix
from risaf_link.errors import LogError
from risaf_link.links.file import read
from risaf_link.mavlink.dialect import name_of
from risaf_link.mavlink.epoch import EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.mavlink.truth import truth_of

GAP = 1.0  # s, between epochs
REORDERED = 128  # a larger step of the sequence number is a frame out of order


@dataclass
class MessageCount:
    """How often a message came, and when."""

    count: int = 0
    first_us: int = 0
    last_us: int = 0

    def note(self, time_us: int) -> None:
        """Take note of one more."""
        if not self.count:
            self.first_us = time_us
        self.count += 1
        self.last_us = time_us

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
    messages: dict[tuple[int, int, str], MessageCount] = field(default_factory=dict)
    frames_lost: dict[tuple[int, int], int] = field(default_factory=dict)
    assembly: Counter[str] = field(default_factory=Counter)
    unused: Counter[str] = field(default_factory=Counter)
    encoding: str = ""
    sensors: int = 0
    epoch_rate: float = 0.0  # Hz
    gaps: list[tuple[float, float]] = field(default_factory=list)  # s since the first epoch; length
    gps: GpsQuality = field(default_factory=GpsQuality)
    truth: str = ""  # the message that carries it


def survey(config: Config, path: Path, progress: Callable[[int], None] = lambda _: None) -> Survey:
    """Read a log through.

    Raises
    ------
    LogError
        If it cannot be read, or holds no frame.
    """
    reader = TlogReader(read(path, progress))
    ingest = Ingest(config.array, config.gps, config.own)
    assembler = EpochAssembler(config.array)
    found = Survey(assembly=assembler.counts, unused=ingest.counts)
    sequences: dict[tuple[int, int], int] = {}
    elapsed, first_us = 0.0, None
    for time_us, frame in reader:
        first_us = time_us if first_us is None else first_us
        found.duration = max(found.duration, (time_us - first_us) / 1e6)
        _count(found, sequences, frame, time_us)
        datum = ingest.decode(frame, time_us)
        if isinstance(datum, GpsFix):
            found.gps.note(datum)
        elif isinstance(datum, GyroChunk):
            for epoch in assembler.add(datum):
                if epoch.dt > GAP:
                    found.gaps.append((elapsed, epoch.dt))
                elapsed += epoch.dt
        if truth_of(frame):
            found.truth = name_of(frame.message_id)
    if first_us is None:
        raise LogError(f"{path}: found no MAVLink frame, expected a tlog")
    found.dropped, found.bytes_skipped = reader.parser.dropped, reader.parser.skipped
    found.stamps_replaced = reader.stamps_replaced
    found.sensors = assembler.sensors
    found.encoding = assembler.source.encoding if assembler.source else ""
    found.epoch_rate = assembler.counts["epochs"] / elapsed if elapsed > 0 else 0.0
    return found


def _count(
    found: Survey, sequences: dict[tuple[int, int], int], frame: Frame, time_us: int
) -> None:
    sender = (frame.system, frame.component)
    key = (*sender, name_of(frame.message_id))
    found.messages.setdefault(key, MessageCount()).note(time_us)
    missing = (frame.sequence - sequences.get(sender, frame.sequence - 1) - 1) % 256
    sequences[sender] = frame.sequence
    if missing < REORDERED:
        found.frames_lost[sender] = found.frames_lost.get(sender, 0) + missing


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
    elif gps.with_course and gps.fastest >= 1.0:
        parts.append(
            f"heading from {gps.with_course} fixes with course, up to {gps.fastest:.1f} m/s"
        )
    elif gps.fixes:
        parts.append("GPS fixes, but too slow for a heading")
    else:
        parts.append("no GPS fix: the heading cannot be aligned")
    parts.append(f"truth from {found.truth}" if found.truth else "no truth to score against")
    return "; ".join(parts) + "."
