"""A day of stream in accelerated time, with faults drawn at random: is anything lost, or untrue?

Hour after hour of simulated drives goes through parser and pipeline, as datagrams and as the service
reads them. Each piece of some minutes has a drive, sensor faults and a fault of the receiver of its
own; and every so often something happens to the way or to a clock, drawn by the seed:

    datagrams lost, one by one or in bursts; repeated; overtaken; garbled; cut short
    the array stops for a while; is started again, its clock at zero
    the autopilot is started again, its clock at zero; the host's clock is set, either way

Asked is, all through the day: does anything raise; does memory grow; is every frame of the array
that arrived part of an epoch or counted as dropped, by reason; is the heading within three of the
standard deviations that are told with it, 99.7 % of the time?

    python benchmarks/soak.py --hours 24
    python benchmarks/soak.py --live 30        # minutes, of 300 gyros at 1 kHz through the service
"""

import argparse
import gc
import math
import os
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from spoiled import Datagram, Receiver, Spoil, sent

from risaf_link.bench.feed import Burst
from risaf_link.bench.live import COMMAND, Meter, drive, memory_mb, service
from risaf_link.core.rotation import wraps, yaws_of
from risaf_link.mavlink.dialect import IDS
from risaf_link.sim.faults import FAULTS
from risaf_link.sim.receiver_faults import RECEIVER_FAULTS
from risaf_link.sim.scenario import BOOT_US, Scenario, scenario
from risaf_link.sim.stream import EPOCH_START_US

PIECE_S = 600.0  # of one drive
SPELL_S = 120.0  # mean, from one fault of way or clocks to the next
PART = 40  # sensors of a datagram
SETTLING_S = 5.0  # after a fault of a clock, in which a stamp may be of the clock before
GYROS, FORCES = (IDS[name].to_bytes(3, "little") for name in ("GYRO_ARRAY", "ACCEL_ARRAY"))
HEAD = 10
KINDS = (
    *("lost", "bursts", "repeated", "overtaken", "garbled", "cut"),
    *("silent", "array restart", "autopilot restart", "host clock"),
)


@dataclass
class Spell:
    """A fault of the way or of a clock, for a while."""

    kind: str
    begins_us: int  # since the start of the piece
    ends_us: int
    size: float  # in (0, 1)


def spells(generator: np.random.Generator, seconds: float) -> list[Spell]:
    """What happens in a piece."""
    found, at = [], float(generator.exponential(SPELL_S))
    while at < seconds:
        lasts = float(generator.uniform(1.0, 30.0))
        kind = KINDS[int(generator.integers(len(KINDS)))]
        begins, ends = round(at * 1e6), round((at + lasts) * 1e6)
        found.append(Spell(kind, begins, ends, float(generator.random())))
        at += lasts + float(generator.exponential(SPELL_S))
    return found


@dataclass
class Arrival:
    """A datagram where it arrives."""

    true_us: int  # since the start of the piece
    data: bytes
    is_whole: bool = True


@dataclass
class Clocks:
    """By how much each is ahead of the time since the start of the day, us."""

    array: int = 0
    autopilot: int = 0
    host: int = EPOCH_START_US


@dataclass
class Account:
    """What came of the day."""

    hours: float = 0.0
    sent: int = 0  # frames of gyros that left the array
    arrived: int = 0  # of them, whole
    samples_arrived: int = 0
    epochs: int = 0
    judged: int = 0
    lies: int = 0
    squares: float = 0.0  # of error over deviation
    worst: float = 0.0
    kinds: Counter[str] = field(default_factory=Counter)
    memory_mb: list[float] = field(default_factory=list)


def resident_mb() -> float:
    """Memory of this process, MB."""
    return memory_mb(os.getpid())


def piece(seed: int, sensors: int, rate: float, seconds: float) -> Scenario:
    """A drive with faults of its sensors and of its receiver."""
    generator = np.random.default_rng([seed, 1])
    names = generator.permutation([*FAULTS])[: int(generator.integers(0, 4))].tolist()
    if generator.random() < 0.5:
        names.append(str(generator.choice([*RECEIVER_FAULTS])))
    name = ("drive1", "drive2", "circle")[seed % 3]
    chosen = scenario(name, seed, sensors=sensors, rate=rate, duration=seconds, faults=names)
    start = float(generator.uniform(120.0, seconds - 200.0))
    outage = (start, start + float(generator.uniform(10.0, 180.0)))
    return Scenario(
        **{name: getattr(chosen, name) for name in chosen.__dataclass_fields__}
        | {"outages": (outage,)}
    )


def on_the_way(
    datagrams: Iterator[Datagram], happening: list[Spell], generator: np.random.Generator
) -> Iterator[Arrival]:
    """What becomes of datagrams: lost, repeated, overtaken, garbled, cut short."""
    kept: list[tuple[int, bytes]] = []  # overtaken
    gone = False
    spoil = Spoil(flipped=1e-4)
    for time_us, raw in datagrams:
        since_us = time_us - BOOT_US
        now = {s.kind: s for s in happening if s.begins_us <= since_us < s.ends_us}
        draw = generator.random()
        while kept and kept[0][0] <= since_us:
            yield Arrival(since_us, kept.pop(0)[1])
        if "silent" in now and raw[6] != 1:
            continue
        if "lost" in now and draw < 0.5 * now["lost"].size:
            continue
        if "bursts" in now:
            gone = draw > 0.02 if gone else draw < 0.01
            if gone:
                continue
        if "overtaken" in now and draw < 0.05:
            kept.append((since_us + round(30_000 * now["overtaken"].size), raw))
            continue
        if "garbled" in now:
            ((_, data),) = spoil.apply([(0, raw)], int(generator.integers(1 << 31)))
            yield Arrival(since_us, data, data == raw)
            continue
        if "cut" in now and draw < 0.02:
            yield Arrival(since_us, raw[: int(generator.integers(1, len(raw)))], False)
            continue
        yield Arrival(since_us, raw)
        if "repeated" in now and draw < 0.1:
            yield Arrival(since_us, raw)
