"""The frames of a simulated array, epoch by epoch, for as long as one likes."""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from itertools import count, groupby

from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.ingest import ARRAY_HEAD
from risaf_link.sim import array, autopilot
from risaf_link.sim.message import Message, by_time
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.stream import SYSTEM

STAMPED = {IDS[name] for name in ("IMU_ARRAY_INFO", "GYRO_ARRAY", "ACCEL_ARRAY")}
NUMBERED = STAMPED - {IDS["IMU_ARRAY_INFO"]}


@dataclass(frozen=True, slots=True)
class Burst:
    """What is sent at one instant."""

    due_s: float  # since the start
    frames: list[bytes]
    stamp_ms: int | None  # of the epoch that the last frame makes whole; None: no epoch


def bursts(scenario: Scenario, seconds: float) -> Iterator[Burst]:
    """Send a scenario; one that is over starts again, with times and numbers that go on.

    GPS is sent where the scenario is long enough not to start again: the vehicle would jump.
    """
    sources = [array.status(scenario), array.epochs(scenario)]
    if seconds <= scenario.duration:
        sources.append(autopilot.gps(scenario))
    piece = list(merge(*sources, key=by_time))
    epochs_a_round = round(scenario.duration * scenario.rate)
    sequences = {message.component: count() for message in piece}
    for turn in count():
        shift_us = turn * round(scenario.duration * 1e6)
        for time_us, messages in groupby(piece, key=by_time):
            due_s = (time_us + shift_us - BOOT_US) / 1e6
            if due_s >= seconds:
                return
            several = list(messages)
            several.sort(key=lambda each: each.message_id in NUMBERED)  # epochs come last
            frames = [
                encode(
                    message.message_id,
                    _later(message, shift_us, turn * epochs_a_round),
                    next(sequences[message.component]) & 0xFF,
                    SYSTEM,
                    message.component,
                )
                for message in several
            ]
            is_epoch = several[-1].message_id in NUMBERED
            yield Burst(due_s, frames, (time_us + shift_us) // 1000 if is_epoch else None)


def _later(message: Message, shift_us: int, epochs: int) -> bytes:
    payload = bytearray(message.payload)
    if shift_us and message.message_id in STAMPED:
        time_us, sequence, first = ARRAY_HEAD.unpack_from(payload)
        if message.message_id in NUMBERED:
            sequence = (sequence + epochs) & 0xFFFF
        ARRAY_HEAD.pack_into(payload, 0, time_us + shift_us, sequence, first)
    return bytes(payload)
