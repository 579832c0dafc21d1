"""Frames that pymavlink made, streams of them, and what a parser finds there."""

import os
import struct
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega

from risaf_link.mavlink import risaf
from risaf_link.mavlink.dialect import CRC_EXTRA
from risaf_link.mavlink.frame import Frame, FrameParser

ROOT = Path(__file__).resolve().parent.parent
KEY = bytes(range(32))  # of rover_sitl_signed.tlog

SYSTEM = ["HEARTBEAT", "SYSTEM_TIME", "ATTITUDE_QUATERNION"]
SENSORS = ["HIGHRES_IMU", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"]
RECEIVERS = ["GPS_RAW_INT", "GPS2_RAW", "HIL_GPS", "GPS_INPUT", "GLOBAL_POSITION_INT"]
TRUTHS = ["HIL_STATE_QUATERNION", "SIM_STATE", "SIMSTATE"]
STOCK = [*SYSTEM, *SENSORS, "DEBUG_FLOAT_ARRAY", *RECEIVERS, *TRUTHS]
ARRAYS = ["IMU_ARRAY_INFO", "GYRO_ARRAY", "ACCEL_ARRAY", "TEMPERATURE_ARRAY"]
OURS = [*ARRAYS, "GPS_HEADING_STATUS", "ARRAY_STATUS", "ARRAY_SENSOR_HEALTH"]
CLASSES: dict[str, Any] = {
    kind.msgname: kind
    for dialect in (ardupilotmega, risaf)
    for kind in dialect.mavlink_map.values()
    if kind.msgname in STOCK + OURS
}
SHORT = [name for name in STOCK if CLASSES[name].id < 256]  # what MAVLink 1 can carry
UNKNOWN_V1 = [i for i in range(256) if i not in CRC_EXTRA]

Make = Callable[[Random], bytes]


def seeded(seed: int) -> Random:
    return Random(seed)  # noqa: S311


def codec(name: str, signed: bool = False) -> Any:
    """A codec of pymavlink for a message, and a sender's address."""
    mavlink = (risaf if name in OURS else ardupilotmega).MAVLink(None, 7, 9)
    if signed:
        mavlink.signing.secret_key = KEY
        mavlink.signing.link_id = 3
        mavlink.signing.timestamp = 1 << 40
        mavlink.signing.sign_outgoing = True
    return mavlink


def message(name: str, payload: bytes) -> Any:
    """A message of pymavlink with the fields that a whole payload holds."""
    kind = CLASSES[name]
    values = kind.unpacker.unpack(payload)
    fields = {}
    for field, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
        taken, values = values[:length], values[length:]
        fields[field] = taken[0] if length == 1 else list(taken)
    return kind(**fields)


def payloads(name: str) -> st.SearchStrategy[bytes]:
    """Whole payloads of a message, of any content; the NaNs in them are quiet, as Python's are."""
    layout = CLASSES[name].unpacker
    whole = st.binary(max_size=layout.size).map(lambda start: start.ljust(layout.size, b"\0"))
    return whole.map(lambda payload: layout.pack(*layout.unpack(payload)))


def made(name: str, random: Random, signed: bool = False, version: int = 2) -> bytes:
    """A frame with a random payload; half of them end in zeros."""
    size = CLASSES[name].unpacker.size
    payload = random.randbytes(random.choice((size, size // 2))).ljust(size, b"\0")
    mavlink = codec(name, signed)
    mavlink.seq = random.randrange(256)
    return bytes(message(name, payload).pack(mavlink, force_mavlink1=version == 1))


def framed(message_id: int, payload: bytes, extra: int, version: int = 2, flags: int = 0) -> bytes:
    """A frame of any message, known or not."""
    head = [len(payload), 1, 7, 9] if version == 1 else [len(payload), flags, 0, 1, 7, 9]
    content = bytes(head) + message_id.to_bytes(1 if version == 1 else 3, "little") + payload
    checksum = ardupilotmega.x25crc(content + bytes((extra,))).crc
    return bytes((0xFE if version == 1 else 0xFD,)) + content + struct.pack("<H", checksum)


def unknown(random: Random, version: int = 2) -> bytes:
    """A frame of a message that nobody has defined."""
    message_id = random.choice(UNKNOWN_V1) if version == 1 else random.randrange(60_000, 1 << 24)
    return framed(message_id, random.randbytes(random.randrange(256)), message_id % 251, version)


MIXES: dict[str, list[Make]] = {
    "arrays": [lambda r: made("GYRO_ARRAY", r)],
    "MAVLink 2": [lambda r, name=name: made(name, r) for name in STOCK + OURS],
    "MAVLink 1": [lambda r, name=name: made(name, r, version=1) for name in SHORT],
    "both": [lambda r, v=version: made(r.choice(SHORT), r, version=v) for version in (1, 2)],
    "signed": [lambda r, name=name: made(name, r, signed=True) for name in STOCK + OURS],
    "unknown, MAVLink 2": [unknown, lambda r: made(r.choice(STOCK), r)],
    "unknown, MAVLink 1": [lambda r: unknown(r, 1), lambda r: made(r.choice(SHORT), r, version=1)],
    "nothing known": [unknown],
}


@cache
def sequence(mix: str, seed: int, count: int = 1000) -> tuple[bytes, ...]:
    random = seeded(seed)
    return tuple(random.choice(MIXES[mix])(random) for _ in range(count))


def with_length(frame: bytes, length: int) -> bytes:
    return frame[:1] + bytes((length,)) + frame[2:]


def without_byte(frame: bytes, at: int) -> bytes:
    return frame[:at] + frame[at + 1 :]


def chunks(data: bytes, sizes: Iterable[int]) -> Iterator[bytes]:
    """The data in pieces of these sizes, and the rest."""
    at = 0
    for size in sizes:
        yield data[at : at + size]
        at += size
    yield data[at:]


def parsed(pieces: Iterable[bytes], prefix_size: int = 0) -> tuple[list[Frame], FrameParser]:
    """All frames of a stream, and their parser with its counts."""
    parser = FrameParser(prefix_size)
    frames = [frame for piece in pieces for frame in parser.receive_data(piece)]
    return frames + parser.end(), parser


def raws(*pieces: bytes) -> list[bytes]:
    return [frame.raw for frame in parsed(pieces)[0]]


def recording(name: str) -> Path:
    """A log, of the repository or one of those that are too large for it."""
    if name.startswith("rover"):
        return ROOT / "sitl_fixtures" / name
    data = Path(os.environ.get("RISAF_DATA", ROOT.parent / "shared" / "data"))
    path = data / "real_tlogs" / name
    if not path.exists():
        pytest.skip(f"{path} is not there; RISAF_DATA says where such logs are")
    return path


def read_by_pymavlink(path: Path, stamped: bool = True) -> list[tuple[float, bytes]]:
    """Times and frames of a log, but for BAD_DATA."""
    log = mavutil.mavlogfile(str(path), notimestamps=not stamped)
    messages = list(iter(log.recv_msg, None))
    log.close()
    return [
        (found._timestamp, bytes(found.get_msgbuf()))
        for found in messages
        if found.get_type() != "BAD_DATA"
    ]
