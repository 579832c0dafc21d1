"""Run a day of stream in accelerated time, with faults drawn at random.

A drive of so many hours goes through parser and pipeline, as datagrams and as the service reads
them. Its sensors fail, its receiver has no fix, repeats one, jumps, drifts and is led astray; and
every so often something happens to the way or to a clock, all drawn by the seed:

    datagrams lost, one by one or in bursts; repeated; overtaken; garbled; cut short
    the array stops for a while; is started again, its clock at zero
    the autopilot is started again, its clock at zero; the host's clock is set, either way

Asked is, all through the day: does anything raise; does memory grow; is every frame of the array
that arrived part of an epoch or counted as dropped, by reason; is the heading within three of the
standard deviations that are told with it, 99.7 % of the time?

    python benchmarks/soak.py --hours 24 --rate 50
"""

import argparse
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from spoiled import SOURCES, Receiver, Spoil

from risaf_link.bench.live import memory_mb
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.rotation import Floats, wraps, yaws_of
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import encode
from risaf_link.pipeline import Pipeline
from risaf_link.sim.disturbances import Ramps, Steps
from risaf_link.sim.failures import Dropouts, Frozen, Saturated
from risaf_link.sim.faults import FAULTS
from risaf_link.sim.message import ARRAY, AUTOPILOT, Message
from risaf_link.sim.receiver_faults import (
    CourseError,
    LedAstray,
    PositionJump,
    ReceiverFault,
    Stuck,
)
from risaf_link.sim.scenario import BOOT_US, Scenario, scenario
from risaf_link.sim.stream import EPOCH_START_US, SYSTEM, messages

SPELL_S = 120.0  # mean, from one fault of way or clocks to the next
OUTAGE_S = 600.0  # mean, from one time without GPS to the next
ASTRAY_S = 1200.0  # mean, from one fault of the receiver to the next
STANDS_S = 3.0  # that an array or autopilot is away that is started again
FARTHEST_US = 3_600_000_000  # that the host's clock is set
SAMPLES = {IDS["GYRO_ARRAY"], IDS["ACCEL_ARRAY"]}
KINDS = (
    *("lost", "bursts", "repeated", "overtaken", "garbled", "cut"),
    *("silent", "array restart", "autopilot restart", "host clock"),
)


@dataclass
class Spell:
    """A fault of the way or of a clock, for a while."""

    kind: str
    begins_us: int  # since the start
    ends_us: int
    size: float  # in (0, 1)


class Day:
    """A scenario of many hours, and all that happens in it.

    Parameters
    ----------
    seed, hours, sensors, rate
        Hz.
    """

    def __init__(self, seed: int, hours: float, sensors: int, rate: float) -> None:
        self.generator = np.random.default_rng([seed, 7])
        seconds = 3600.0 * hours
        some_time = (30.0, seconds)
        chosen = scenario("drive1", seed, sensors=sensors, rate=rate, duration=seconds)
        self.scenario: Scenario = replace(
            chosen,
            faults={
                **{name: FAULTS[name] for name in ("spikes", "thermal", "scale", "invalid")},
                "steps": Steps(share=0.1, size=math.radians(2.0), onset=some_time),
                "ramps": Ramps(share=0.07, slope=math.radians(0.002), onset=some_time),
                "frozen": Frozen(share=0.07, onset=some_time),
                "saturated": Saturated(share=0.04, onset=some_time),
                "dropouts": Dropouts(share=0.1, returning=0.7, absence=600.0, onset=some_time),
            },
            receiver_faults=dict(self._astray(seconds)),
            outages=tuple(self._times(OUTAGE_S, seconds, 10.0, 180.0)),
        )
        self.spells = list(self._spells(seconds))

    def _times(
        self, every: float, seconds: float, shortest: float, longest: float
    ) -> Iterator[tuple[float, float]]:
        at = 100.0 + float(self.generator.exponential(every))
        while at < seconds:
            lasts = float(self.generator.uniform(shortest, longest))
            yield at, at + lasts
            at += lasts + float(self.generator.exponential(every))

    def _astray(self, seconds: float) -> Iterator[tuple[str, ReceiverFault]]:
        for begin, end in self._times(ASTRAY_S, seconds, 5.0, 40.0):
            when = {"begin": begin, "length": end - begin}
            slope = math.radians(float(self.generator.uniform(0.3, 1.0)))
            faults: tuple[ReceiverFault, ...] = (
                CourseError(size=math.radians(float(self.generator.uniform(10, 180))), **when),
                CourseError(size=0.0, slope=slope, **when),
                LedAstray(slope=slope, **when),
                PositionJump(north=300.0, east=-200.0, **when),
                Stuck(**when),
            )
            yield f"at {begin:.0f}", faults[int(self.generator.integers(len(faults)))]

    def _spells(self, seconds: float) -> Iterator[Spell]:
        for begin, end in self._times(SPELL_S, seconds, 1.0, 30.0):
            kind = KINDS[int(self.generator.integers(len(KINDS)))]
            size = float(self.generator.random())
            yield Spell(kind, round(begin * 1e6), round(end * 1e6), size)


@dataclass
class Arrival:
    """A datagram where it arrives."""

    true_us: int  # since the start
    received_us: int  # by the host's clock
    data: bytes
    samples: int = 0  # frames of readings in it that are whole


class Way:
    """What becomes of messages: they are stamped by clocks that jump, framed, and spoiled."""

    def __init__(self, day: Day) -> None:
        self._day = day
        self._generator = day.generator
        self._waiting = iter(day.spells)
        self._next = next(self._waiting, None)
        self.now: dict[str, Spell] = {}
        self.happened: Counter[str] = Counter()
        self._numbers = {AUTOPILOT: 0, ARRAY: 0}
        self._first_epoch = 0  # that the array has counted since it was started
        self.offsets_us = [0, 0]  # of the array's clock, now and before
        self._autopilot_us = 0
        self._host_us = EPOCH_START_US + BOOT_US
        self._away: dict[int, int] = {}  # component: until when
        self._kept: list[tuple[int, bytes, int]] = []
        self._gone = False
        self._flip = Spoil(flipped=1e-4)

    def arrivals(self) -> Iterator[Arrival]:
        """Carry the day's messages."""
        for message in messages(self._day.scenario, SOURCES):
            since_us = message.time_us - BOOT_US
            self._turn_to(since_us)
            while self._kept and self._kept[0][0] <= since_us:
                _, raw, samples = self._kept.pop(0)
                yield self._arrival(since_us, raw, samples)
            if self._away.get(message.component, 0) > since_us:
                continue
            raw = self._framed(message)
            yield from self._carried(since_us, raw, int(message.message_id in SAMPLES))

    def _turn_to(self, since_us: int) -> None:
        while self._next and self._next.begins_us <= since_us:
            spell, self._next = self._next, next(self._waiting, None)
            self.now[spell.kind] = spell
            self.happened[spell.kind] += 1
            self._begin(spell, since_us)
        self.now = {k: s for k, s in self.now.items() if since_us < s.ends_us}

    def _begin(self, spell: Spell, since_us: int) -> None:
        away_us = since_us + round(STANDS_S * 1e6)
        if spell.kind == "silent":
            self._away[ARRAY] = spell.ends_us
        elif spell.kind == "array restart":
            self._away[ARRAY] = away_us
            self.offsets_us = [-away_us - BOOT_US, self.offsets_us[0]]
            self._first_epoch = round(away_us / 1e6 * self._day.scenario.rate)
        elif spell.kind == "autopilot restart":
            self._away[AUTOPILOT] = away_us
            self._autopilot_us = -away_us - BOOT_US
        elif spell.kind == "host clock":
            self._host_us += round((2.0 * spell.size - 1.0) * FARTHEST_US)

    def _framed(self, message: Message) -> bytes:
        payload = bytearray(message.payload)
        if message.component == ARRAY and message.message_id != IDS["HEARTBEAT"]:
            _shift(payload, 0, 8, self.offsets_us[0])
            if message.message_id in SAMPLES:
                _shift(payload, 8, 2, -self._first_epoch)
        elif message.message_id == IDS["SYSTEM_TIME"]:
            _shift(payload, 8, 4, self._autopilot_us // 1000)
        elif message.message_id == IDS["GPS_RAW_INT"]:
            _shift(payload, 0, 8, self._autopilot_us)
        number = self._numbers[message.component]
        self._numbers[message.component] = number + 1 & 0xFF
        return encode(message.message_id, bytes(payload), number, SYSTEM, message.component)

    def _carried(self, since_us: int, raw: bytes, samples: int) -> Iterator[Arrival]:
        draw = float(self._generator.random())
        now = self.now
        if "lost" in now and draw < 0.5 * now["lost"].size:
            return
        if "bursts" in now:
            self._gone = draw > 0.02 if self._gone else draw < 0.01
            if self._gone:
                return
        if "overtaken" in now and draw < 0.05:
            later_us = since_us + round(50_000 * now["overtaken"].size)
            self._kept.append((later_us, raw, samples))
            return
        if "garbled" in now:
            ((_, data),) = self._flip.apply([(0, raw)], int(self._generator.integers(1 << 31)))
            yield self._arrival(since_us, data, samples * (data == raw))
            return
        if "cut" in now and draw < 0.02:
            cut = int(self._generator.integers(1, len(raw)))
            yield self._arrival(since_us, raw[:cut], 0)
            return
        yield self._arrival(since_us, raw, samples)
        if "repeated" in now and draw < 0.1:
            yield self._arrival(since_us, raw, samples)

    def _arrival(self, since_us: int, data: bytes, samples: int) -> Arrival:
        return Arrival(since_us, (self._host_us + since_us) & ~3, data, samples)


def _shift(payload: bytearray, at: int, size: int, by: int) -> None:
    value = int.from_bytes(payload[at : at + size], "little") + by
    payload[at : at + size] = (value % (1 << 8 * size)).to_bytes(size, "little")


class Counted(Pipeline):
    """A pipeline that counts the chunks of which its epochs are made; one makes all of a kind."""

    chunks = 0

    def _advance(self, epochs: EpochBlock) -> list[EstimateBlock]:
        with_forces = np.isfinite(epochs.forces_b).any(axis=(1, 2))
        self.chunks += len(epochs) + int(with_forces.sum())
        return super()._advance(epochs)


@dataclass
class Honesty:
    """Error over stated deviation, by whether GPS was gone or wrong."""

    epochs: int = 0
    beyond: int = 0  # three standard deviations
    squares: float = 0.0
    error: float = 0.0  # rad^2, sum
    worst: float = 0.0

    def note(self, error: Floats, ratio: Floats) -> None:
        """Take more epochs."""
        self.epochs += len(ratio)
        self.beyond += int((~(ratio <= 3.0)).sum())
        self.squares += float((ratio**2).sum())
        self.error += float((error**2).sum())
        self.worst = max(self.worst, float(ratio.max(initial=0.0)))

    def __str__(self) -> str:
        count = max(self.epochs, 1)
        rms_deg = math.degrees(math.sqrt(self.error / count))
        return (
            f"{self.epochs} epochs, {100 * self.beyond / count:.3f} % beyond 3 sigma, "
            f"worst {self.worst:.1f}, RMS of error over sigma "
            f"{math.sqrt(self.squares / count):.2f}, RMS {rms_deg:.2f} deg"
        )


class Soak:
    """One day, from end to end."""

    def __init__(self, day: Day) -> None:
        self.day, self.way, self.receiver = day, Way(day), Receiver(Counted)
        self.whole = self.handed = 0  # datagrams of readings that arrived whole, and all
        self.all, self.sound = Honesty(), Honesty()
        self.by_kind: Counter[str] = Counter()  # lies, by what was happening
        self.memory_mb: list[float] = []
        self._found: list[tuple[int, tuple[int, ...], EstimateBlock]] = []
        """When, by which offsets of the array's clock then, what."""
        faults = day.scenario.receiver_faults.values()
        spoilt = [(f.begin, f.begin + f.length) for f in faults]  # type: ignore[attr-defined]
        self._spoilt = np.array(spoilt).reshape(-1, 2)

    def run(self) -> None:
        """Carry it through."""
        told_s = 3600
        for arrival in self.way.arrivals():
            self.whole += arrival.samples
            self.handed += 1
            blocks = self.receiver.take(arrival.data, arrival.received_us)
            self._note(arrival.true_us, blocks)
            if len(self._found) >= 2048:
                self._judge()
            if arrival.true_us >= told_s * 1_000_000:
                self._judge()
                self.memory_mb.append(memory_mb(os.getpid()))
                hour = told_s // 3600
                print(f"{hour} h: {self.memory_mb[-1]:.1f} MB; {self.all}", flush=True)
                told_s += 3600
        last_us = round(self.day.scenario.duration * 1e6)
        self._note(last_us, self.receiver.pipeline.flush(0))
        self._judge()

    def _note(self, true_us: int, blocks: list[EstimateBlock]) -> None:
        offsets_us = tuple(self.way.offsets_us)
        self._found += [(true_us, offsets_us, block) for block in blocks]

    def _judge(self) -> None:
        found, self._found = self._found, []
        if not found:
            return
        rows = [
            np.column_stack(
                (
                    np.full(int(known.sum()), now_us),
                    block.time_us[known],
                    np.tile(offsets_us, (int(known.sum()), 1)),
                )
            )
            for now_us, offsets_us, block in found
            for known in [block.track.aligned]
        ]
        now, stamp, *offsets = np.concatenate(rows).T
        if not len(stamp):
            return
        tracks = [block.track for *_, block in found]
        yaw = np.concatenate([yaws_of(track.q_nb[track.aligned]) for track in tracks])
        std = np.concatenate([track.yaw_std[track.aligned] for track in tracks])
        # An epoch of before the array was started again may come out after.
        true = np.array([stamp - offset - BOOT_US for offset in offsets])
        age = now - true
        first = (age[0] >= 0) & ((age[0] <= age[1]) | (age[1] < 0))
        true_us = np.where(first, true[0], true[1])
        error = wraps(yaw - yaws_of(self.day.scenario.trajectory(true_us / 1e6).q_nb))
        ratio = np.abs(error) / std
        self.all.note(error, ratio)
        since = (true_us / 1e6)[:, np.newaxis]
        begin, end = self._spoilt[:, 0], self._spoilt[:, 1]
        sound = ~((begin <= since) & (since < end + 60.0)).any(axis=1)
        self.sound.note(error[sound], ratio[sound])
        lies = int((ratio > 3.0).sum())
        if lies:
            self.by_kind[", ".join(sorted(self.way.now)) or "nothing else"] += lies

    def unaccounted(self, sensors: int) -> int:
        """Readings of one sensor that arrived, and are in no epoch nor counted as dropped."""
        counts, unused = (
            self.receiver.pipeline.assembler.counts,
            self.receiver.pipeline.ingest.counts,
        )
        names = "late", "duplicate", "astray", "unclaimed", "out_of_range"
        dropped = sum(counts[name] for name in names)
        frames = sum(unused[name] for name in ("unscaled", "other_source", "malformed"))
        return sensors * (self.whole - self.receiver.pipeline.chunks - frames) - dropped


def main() -> None:
    """Run a day, and sum up."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--sensors", type=int, default=30, help="at most 40: a datagram has all")
    parser.add_argument("--rate", type=float, default=50.0, help="Hz")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    soak = Soak(Day(options.seed, options.hours, options.sensors, options.rate))
    soak.run()
    pipeline = soak.receiver.pipeline
    missing = soak.unaccounted(options.sensors)
    print(
        f"{options.hours:g} h of {options.sensors} gyros and accelerometers at {options.rate:g} Hz"
    )
    print(
        f"happened: {dict(soak.way.happened)}, {len(soak.day.scenario.outages)} times without GPS"
    )
    print(f"datagrams: {soak.handed}, of readings and whole {soak.whole}")
    print(f"dropped by the parser: {dict(soak.receiver.dropped())}")
    print(f"assembler: {dict(pipeline.assembler.counts)}")
    print(f"ingest: {dict(pipeline.ingest.counts)}")
    print(f"readings that arrived and are in no epoch nor counted as dropped: {missing}")
    print(f"memory, MB, hour by hour: {[round(mb, 1) for mb in soak.memory_mb]}")
    print(f"heading: {soak.all}")
    print(f"but for a receiver that errs, and a minute after: {soak.sound}")
    print(f"beyond 3 sigma while: {dict(soak.by_kind)}")
    sys.exit(missing != 0)


if __name__ == "__main__":
    main()
