"""What a way of loss and garbage does to a drive: datagrams as sent, spoiled, received, judged.

Datagrams are lost each by itself, or in bursts; any bit of what arrives may be turned round; and
frames may be wrong though their checksum holds, as one in 65536 of those garbled at random is.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from risaf_link.config import load
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.rotation import Floats, wraps, yaws_of
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.component import HEARD
from risaf_link.mavlink.dialect import CRC_EXTRA, pack
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.search import MARK_V2, checksum_of
from risaf_link.pipeline import Pipeline
from risaf_link.sim import array, autopilot
from risaf_link.sim.message import AUTOPILOT, Message, heartbeat
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.stream import EPOCH_START_US

BURST = 100  # datagrams, mean: a quarter of a second of 60 gyros and accelerometers at 100 Hz
HEADER, CHECKSUM = 10, 2  # bytes of MAVLink 2, without a signature
OLDEST_US, OFF_US = 10_000_000, 1_000  # an output is of an epoch that was sent so long ago at most
Datagram = tuple[int, bytes]
"""When it is sent, us of the vehicle's clock; a frame."""


@dataclass(frozen=True, slots=True)
class Spoil:
    """What happens on the way."""

    lost: float = 0.0  # share of the datagrams
    burst: float = 1.0  # datagrams that are lost in a row, mean; 1: each is lost by itself
    flipped: float = 0.0  # share of the bits
    forged: float = 0.0  # share of the frames that are wrong and carry a checksum that holds

    def apply(self, datagrams: Iterable[Datagram], seed: int) -> Iterator[Datagram]:
        """What arrives."""
        generator = np.random.default_rng(seed)
        gone = False
        for time_us, raw in datagrams:
            gone = self._is_gone(gone, generator.random())
            if gone:
                continue
            data = raw
            if self.forged and generator.random() < self.forged:
                data = _forged(data, generator)
            if self.flipped:
                data = _flipped(data, self.flipped, generator)
            yield time_us, data

    def _is_gone(self, gone: bool, draw: float) -> bool:
        """Gilbert's channel: how long it is bad or good is distributed geometrically."""
        if self.burst <= 1.0 or not 0.0 < self.lost < 1.0:
            return draw < self.lost
        ends = 1.0 / self.burst
        return draw >= ends if gone else draw < ends * self.lost / (1.0 - self.lost)


def resealed(raw: bytes, at: int, bits: int) -> bytes:
    """Turn some bits of a byte of header or payload round, and put the checksum right."""
    content = bytearray(raw[1:-CHECKSUM])
    content[at - 1] ^= bits
    return _sealed(content)


def _flipped(raw: bytes, share: float, generator: np.random.Generator) -> bytes:
    count = generator.binomial(8 * len(raw), share)
    if not count:
        return raw
    data = bytearray(raw)
    for bit in generator.choice(8 * len(raw), count, replace=False).tolist():
        data[bit // 8] ^= 1 << bit % 8
    return bytes(data)


def _forged(raw: bytes, generator: np.random.Generator) -> bytes:
    """Turn some bits of header or payload round, but for mark and length; put the checksum right.

    A checksum of sixteen bits detects up to three: four and more are turned round.
    """
    content = bytearray(raw[1:-CHECKSUM])
    bits = generator.choice(np.arange(8, 8 * len(content)), generator.integers(4, 12))
    for bit in bits.tolist():
        content[bit // 8] ^= 1 << bit % 8
    content[1] = content[2] = 0  # flags that ask for more than there is: such a frame is dropped
    return _sealed(content)


def _sealed(content: bytearray) -> bytes:
    """Make a frame of what is behind its mark, with a checksum that holds."""
    extra = CRC_EXTRA.get(int.from_bytes(content[6:9], "little"), 0)
    return bytes((MARK_V2,)) + content + checksum_of(bytes(content), extra)


def clock(scenario: Scenario) -> Iterator[Message]:
    """HEARTBEAT and SYSTEM_TIME of the autopilot, every second."""
    pulse = heartbeat(10, 12)  # MAV_TYPE_GROUND_ROVER, MAV_AUTOPILOT_PX4
    for second in range(math.ceil(scenario.duration)):
        time_us = BOOT_US + second * 1_000_000
        boot = {"time_unix_usec": EPOCH_START_US + time_us, "time_boot_ms": time_us // 1000}
        yield Message(time_us, AUTOPILOT, *pulse)
        yield Message(time_us, AUTOPILOT, *pack("SYSTEM_TIME", **boot))


SOURCES = array.status, array.epochs, autopilot.gps, clock
"""Of a drive whose autopilot tells the time and no more than it knows."""


class Receiver:
    """Parser and pipeline, fed as the service feeds them.

    Attributes
    ----------
    pipeline : Pipeline
    frames : int
        That were taken.
    """

    def __init__(self, kind: type[Pipeline] = Pipeline) -> None:
        config = load(None)
        self.pipeline = kind(config, config.own)
        self.frames = 0
        self._blocks = BlockReader(self.pipeline.ingest, self.pipeline.assembler, apart=HEARD)
        self._parsers: dict[str, FrameParser] = {}

    def dropped(self) -> Counter[str]:
        """Frames that were lost in parsing, by reason."""
        return sum((parser.dropped for parser in self._parsers.values()), Counter[str]())

    def take(self, data: bytes, received_us: int, peer: str = "") -> list[EstimateBlock]:
        """What comes of a datagram."""
        parser = self._parsers.setdefault(peer, FrameParser())
        table = parser.receive_table(data)
        self.frames += len(table)
        found: list[EstimateBlock] = []
        for item in self._blocks.read(table, received_us, longest=1):
            if isinstance(item, EpochBlock):
                found += self.pipeline.advance(item)
            else:
                found += self.pipeline.gather(*item)
                found += self.pipeline.release()
        return found


@dataclass
class Errors:
    """Heading errors of epochs, and what was said of them."""

    time_us: list[int] = field(default_factory=list)  # as the epochs are stamped
    boot_us: list[int] = field(default_factory=list)  # as the vehicle is told
    sent_us: list[int] = field(default_factory=list)  # when what made the epoch whole was sent
    yaw: list[float] = field(default_factory=list)  # rad
    std: list[float] = field(default_factory=list)  # rad

    def note(self, blocks: Iterable[EstimateBlock], sent_us: int) -> None:
        """Take down estimates whose heading is known."""
        for block in blocks:
            known = block.track.aligned
            self.time_us += block.time_us[known].tolist()
            self.boot_us += block.boot_us[known].tolist()
            self.sent_us += [sent_us] * int(known.sum())
            self.yaw += yaws_of(block.track.q_nb[known]).tolist()
            self.std += block.track.yaw_std[known].tolist()

    def judge(self, scenario: Scenario, epochs: int) -> "Verdict":
        """Hold them against the truth at the instants that they name."""
        boot_us, sent_us = np.array(self.boot_us), np.array(self.sent_us)
        since = (boot_us - BOOT_US) / 1e6
        period_us = 1e6 / scenario.rate
        off_us = np.abs((boot_us - BOOT_US + period_us / 2) % period_us - period_us / 2)
        astray = (off_us > OFF_US) | (boot_us > sent_us) | (boot_us < sent_us - OLDEST_US)
        q_nb = np.concatenate(
            [scenario.trajectory(part).q_nb for part in np.array_split(since[~astray], 64)]
        )
        error: Floats = np.full(len(since), np.nan)
        error[~astray] = wraps(np.array(self.yaw)[~astray] - yaws_of(q_nb))
        return Verdict(since, error, np.array(self.std), int(astray.sum()), epochs)


@dataclass(frozen=True)
class Verdict:
    """How true and how honest a run was."""

    since: Floats  # (k,) s from the start
    error: Floats  # (k,) rad; NaN: the stamp is astray
    std: Floats  # (k,) rad
    astray: int  # epochs whose stamp is off
    epochs: int  # that were sent

    @property
    def rms_deg(self) -> float:
        """Of the heading's error, deg."""
        return math.degrees(math.sqrt(np.nanmean(self.error**2)))

    @property
    def ratio(self) -> Floats:
        """|error| over its stated standard deviation, (k,)."""
        return np.abs(self.error) / self.std

    @property
    def lies(self) -> float:
        """Share of the epochs that are off by more than three standard deviations, or astray."""
        ratio = self.ratio
        return float(np.mean(~(ratio <= 3.0)))

    @property
    def answered(self) -> float:
        """Share of the epochs sent that have a heading."""
        return len(self.since) / self.epochs

    def where(self, mask: NDArray[np.bool_]) -> "Verdict":
        """Part of it; the epochs that were sent are not parted."""
        return Verdict(self.since[mask], self.error[mask], self.std[mask], 0, self.epochs)
