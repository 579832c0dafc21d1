"""Bytes as a script: which frames are sent, when, by whom. Any bytes are one.

A line is a head of six bytes and some more. The head says which message, how far the clocks of
sender and receiver go on, who sends it, how often, and where the further bytes go: they are laid
over the payload by exclusive or. A line whose further bytes are zero so sends a sensible message,
and what a fuzzer changes in it reaches the code behind the checksum.
"""

import math
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

from risaf_link.config import Config
from risaf_link.mavlink.dialect import CRC_EXTRA, IDS, MESSAGES, pack
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.parameters import parameters_of
from risaf_link.mavlink.search import CHECKSUM, HEADERS, MARK_V1, MARK_V2, checksum_of

HEAD = struct.Struct("<6B")
LONGEST = 150  # messages of a script: more take too long
REPEATS = (1, 1, 1, 1, 1, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)
SENSORS = 4
COMMANDS = [512, 511, 241, 245, 246, 510, 400]

OWN, AUTOPILOT, ARRAY, GCS = (1, 191), (1, 1), (1, 158), (255, 190)
OTHERS = [OWN, AUTOPILOT, ARRAY, GCS, (2, 1), (2, 158), (1, 159), (0, 0), (255, 255), (7, 191)]
NEAR, FAR, RADIO = ("ground", "10.0.0.2:14550"), ("ground", "10.0.0.3:14550"), ("vehicle", "")
PEERS = [NEAR, FAR, RADIO]

BOOT_US, START_US = 5_000_000, 1_767_225_600_000_000
LATEST_US = 2**53  # the year 2255; what receives has a clock that makes sense, be it wrong
STEPS_US = [
    *(10_000, 0, 1_000, 2_500, 25_000, 100_000, 300_000, 1_000_000),
    *(5_000_000, 70_000_000, 2**54, -10_000, -300_000, -2_000_000, -(10**9), -(2**55)),
]
"""By how much a clock goes on with each message."""

SENT = {
    "GYRO_ARRAY": ARRAY,
    "ACCEL_ARRAY": ARRAY,
    "IMU_ARRAY_INFO": ARRAY,
    "GPS_RAW_INT": AUTOPILOT,
    "HEARTBEAT": AUTOPILOT,
    "SYSTEM_TIME": AUTOPILOT,
    "TIMESYNC": AUTOPILOT,
    "HIGHRES_IMU": AUTOPILOT,
    "RAW_IMU": AUTOPILOT,
    "SCALED_IMU": AUTOPILOT,
    "SCALED_IMU2": AUTOPILOT,
    "SCALED_IMU3": AUTOPILOT,
    "DEBUG_FLOAT_ARRAY": ARRAY,
    "GPS2_RAW": AUTOPILOT,
    "GPS_INPUT": AUTOPILOT,
    "HIL_GPS": AUTOPILOT,
    "GLOBAL_POSITION_INT": AUTOPILOT,
    "HIL_STATE_QUATERNION": AUTOPILOT,
    "SIM_STATE": AUTOPILOT,
    "SIMSTATE": AUTOPILOT,
    "COMMAND_LONG": GCS,
    "COMMAND_INT": GCS,
    "PARAM_REQUEST_LIST": GCS,
    "PARAM_REQUEST_READ": GCS,
    "PARAM_SET": GCS,
    "SETUP_SIGNING": GCS,
    "COMMAND_ACK": AUTOPILOT,
    "RADIO_STATUS": (51, 68),
    "ATTITUDE_QUATERNION": OWN,
    "ATTITUDE_QUATERNION_COV": OWN,
    "GPS_HEADING_STATUS": OWN,
    "ARRAY_STATUS": OWN,
    "ARRAY_SENSOR_HEALTH": OWN,
    "ARRAY_SENSOR_REASON": OWN,
    "NAMED_VALUE_FLOAT": OWN,
    "STATUSTEXT": OWN,
    "TEMPERATURE_ARRAY": ARRAY,
    "ODOMETRY": OWN,
}
"""Messages of a script, in the order of their numbers, and who sends them unless told otherwise."""

NAMES = list(SENT)
INPUTS = NAMES[: NAMES.index("COMMAND_LONG")]  # what estimates are made of
ORDERS = ["COMMAND_LONG", "COMMAND_INT", *(name for name in NAMES if name.startswith("PARAM_"))]
STATUSES = NAMES[NAMES.index("ATTITUDE_QUATERNION") :]  # what the page shows


class Sent(NamedTuple):
    """One frame."""

    name: str
    raw: bytes
    payload: bytes  # whole
    sender: tuple[int, int]
    peer: tuple[str, str]  # that hands it on
    received_us: int  # since 1970
    sequence: int


def messages(data: bytes, names: list[str] = NAMES) -> Iterator[Sent]:
    """Send what a script says, of these messages."""
    clock_us, received_us, sequence, at = BOOT_US, START_US, 0, 0
    while at + HEAD.size <= len(data) and sequence < LONGEST:
        kind, steps, who, repeat, offset, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        overlay, name = data[at : at + length], names[kind % len(names)]
        at += length
        sender = OTHERS[(who & 31) % len(OTHERS)] if who & 32 else SENT[name]
        for _ in range(min(REPEATS[repeat % len(REPEATS)], LONGEST - sequence)):
            clock_us += STEPS_US[steps & 15]
            received_us = min(max(received_us + STEPS_US[steps >> 4], 0), LATEST_US)
            message_id, payload = pack(name, **_sensible(name, clock_us, received_us, sequence))
            payload = _laid_over(payload, overlay, offset)
            raw = encode(message_id, payload, sequence % 256, *sender)
            peer = PEERS[(who >> 6) % len(PEERS)]
            yield Sent(name, raw, payload, sender, peer, received_us, sequence)
            sequence += 1


def line(name: str, overlay: bytes = b"", *, offset: int = 0, **told: int) -> bytes:
    """One line of a script of all messages; `steps`, `who` and `repeat` as its head has them."""
    head = (NAMES.index(name), told.get("steps", 0), told.get("who", 0), told.get("repeat", 0))
    return HEAD.pack(*head, offset, len(overlay)) + overlay


def mended(data: bytes) -> bytes:
    """The same bytes, with the checksums of what may be frames put right, one after another."""
    fixed, at = bytearray(data), 0
    while at < len(fixed):
        end = _end(fixed, at)
        if end is None:
            at += 1
            continue
        message_id = int.from_bytes(fixed[at + 7 : at + 10], "little")
        if fixed[at] == MARK_V1:
            message_id = fixed[at + 5]
        extra = CRC_EXTRA.get(message_id, 0)
        fixed[end : end + CHECKSUM] = checksum_of(bytes(fixed[at + 1 : end]), extra)
        at = end + CHECKSUM
    return bytes(fixed)


def _end(data: bytearray, at: int) -> int | None:
    """Where the checksum of the frame would stand that may begin at a place."""
    version = {MARK_V1: 1, MARK_V2: 2}.get(data[at])
    if version is None or at + HEADERS[version] > len(data):
        return None
    end = at + HEADERS[version] + data[at + 1]
    return end if end + CHECKSUM <= len(data) else None


def _laid_over(payload: bytes, overlay: bytes, offset: int) -> bytes:
    start = offset % len(payload)
    changed = bytearray(payload.ljust(min(start + len(overlay), 255), b"\0"))
    for i, byte in enumerate(overlay[: len(changed) - start], start):
        changed[i] ^= byte
    return bytes(changed)


def _sensible(name: str, clock_us: int, received_us: int, sequence: int) -> dict[str, Any]:
    """Fields of a message as a vehicle would send it at a time."""
    fields = _zeros(name).copy()
    told = {
        "time_usec": max(clock_us, 0) % 2**64,
        "time_boot_ms": clock_us // 1000 % 2**32,
        "time_unix_usec": received_us,
        "epoch_seq": sequence % 65536,
        "sensor_count": SENSORS,
        "target_system": OWN[0],
        "target_component": OWN[1],
        **_PARTICULAR.get(name, {}),
    }
    fields.update({field: value for field, value in told.items() if field in fields})
    if name == "TIMESYNC":
        answer = max(clock_us, 1) * 1000 % 2**63 if sequence % 2 else 0  # else it is a request
        fields |= {"ts1": received_us // 4 * 4000 + OWN[1], "tc1": answer}
    if name.startswith("COMMAND_"):
        fields |= {"command": COMMANDS[sequence % len(COMMANDS)]}
    if name.startswith("PARAM_") and "param_id" in fields:
        fields |= {"param_id": _parameters()[sequence % len(_parameters())].encode()}
    if name in {"GYRO_ARRAY", "ACCEL_ARRAY"}:
        readings = [(sequence * 7 + i * 13) % 9 - 4 for i in range(3 * SENSORS)]
        readings[2::3] = [value - (1961 if "ACCEL" in name else 0) for value in readings[2::3]]
        fields["rates" if "GYRO" in name else "forces"] = readings + [0] * (120 - len(readings))
    return fields


@cache
def _parameters() -> list[str]:
    return [parameter.name for parameter in parameters_of(Config)]


@cache
def _zeros(name: str) -> dict[str, Any]:
    message = MESSAGES[IDS[name]]
    values = message.unpacker.unpack(bytes(message.unpacker.size))
    fields = {}
    for field, length in zip(message.ordered_fieldnames, message.lengths, strict=True):
        fields[field] = values[0] if length == 1 else list(values[:length])
        values = values[length:]
    return fields


_FIX = {
    "fix_type": 3,
    "lat": 302_217_000,
    "lon": 348_012_000,
    "vel": 1000,
    "cog": 9000,
    "vn": 0,
    "ve": 10,
    "vx": 0,
    "vy": 1000,
    "h_acc": 1000,
    "vel_acc": 100,
    "speed_accuracy": 0.1,
    "horiz_accuracy": 1.0,
}
_PARTICULAR: dict[str, dict[str, Any]] = {
    "IMU_ARRAY_INFO": {
        "gyro_scale": 1e-4,
        "gyro_range": math.nan,
        "accel_scale": 5e-3,
        "accel_range": math.nan,
        "rate": 100.0,
        "name": b"fuzzed",
    },
    "DEBUG_FLOAT_ARRAY": {"name": b"gyro", "data": [0.01] * 6 + [math.nan] * 52},
    "HEARTBEAT": {"type": 10, "autopilot": 3, "system_status": 4, "mavlink_version": 3},
    "HIGHRES_IMU": {"xgyro": 0.01, "zacc": -9.8},
    "RAW_IMU": {"xgyro": 10, "zacc": -1000},
    "SCALED_IMU": {"xgyro": 10, "zacc": -1000},
    "SCALED_IMU2": {"xgyro": 11, "zacc": -1000},
    "SCALED_IMU3": {"xgyro": 12, "zacc": -1000},
    "COMMAND_LONG": {"param1": 1.0},
    "COMMAND_INT": {"param1": 31.0, "param2": 100_000.0},
    "PARAM_REQUEST_READ": {"param_index": -1},
    "PARAM_SET": {"param_value": 1.0, "param_type": 9},
    "SETUP_SIGNING": {"secret_key": list(range(32))},
    "ATTITUDE_QUATERNION": {"q1": 1.0},
    "NAMED_VALUE_FLOAT": {"name": b"bias_x", "value": 1e-3},
    "STATUSTEXT": {"severity": 6, "text": b"x" * 50, "id": 1},
    "HIL_STATE_QUATERNION": {"attitude_quaternion": [1.0, 0.0, 0.0, 0.0]},
    **dict.fromkeys(
        ("GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS", "GLOBAL_POSITION_INT"), _FIX
    ),
}
