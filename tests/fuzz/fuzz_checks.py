"""What several targets hold their answers against."""

import json
import tempfile
from collections.abc import Coroutine, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from fuzz_script import Sent, line, messages
from network import public as dialects

from risaf_link.config import Config, dump, load
from risaf_link.core.estimate import EstimateBlock
from risaf_link.mavlink.frame import Frame, FrameParser
from risaf_link.mavlink.ingest import GpsParameters
from risaf_link.monitor.view import View

ROOM = Path(tempfile.mkdtemp(prefix="fuzz"))


LONGEST_LINE = 4000  # characters of an error: it may list all the keys that there are


ALL_GPS = GpsParameters(("GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS", "GLOBAL_POSITION_INT"))


@cache
def configs() -> list[Config]:
    settings = [
        [],
        ["fusion.method=risaf", "attitude.filter=paper", "heading.source=positions_raw"],
        ["fusion.method=median", "heading.source=dual_antenna", "array.gyro_scale=0.001"],
        ["fusion.method=mean", "heading.source=positions", "array.max_wait=0"],
        ["array.encodings=[IMU]", "gps.messages=[GLOBAL_POSITION_INT]", "mavlink.system_id=7"],
    ]
    return [load(None, each) for each in settings]


def check_line(error: Exception) -> None:
    """An error is told in one line."""
    text = str(error)
    assert text
    assert text.isprintable(), text
    assert len(text) < LONGEST_LINE, text


def check_config(found: Config, known: Config | None = None) -> None:
    """A configuration can be written and read again; one that is known to be sound need not."""
    if found not in (known, Config()):
        path = ROOM / "again.yaml"
        path.write_text(dump(found))
        assert load(path) == found


def check_estimates(block: EstimateBlock) -> None:
    """An attitude is a rotation, and how well it is known a number."""
    track = block.track
    assert np.isfinite(track.q_nb).all()
    assert (np.abs(np.linalg.norm(track.q_nb, axis=1) - 1.0) < 1e-9).all()
    assert np.isfinite(track.rate_b).all()
    assert np.isfinite(track.bias_b).all()
    assert (track.angle_std >= 0.0).all()
    assert not np.isnan(track.angle_std).any()
    assert (block.boot_us >= 0).all()
    assert (np.diff(block.elapsed) >= 0.0).all()


def check_update(view: View) -> None:
    text = msgspec.json.encode(view.update())
    assert len(text) < 2_000_000
    json.loads(text)


def frame_of(raw: bytes) -> Frame:
    (frame,) = FrameParser().receive_data(raw)
    return frame


def decoded_all(raws: Iterable[bytes]) -> list[Any]:
    """Messages of frames, as pymavlink reads them; none of them is bad."""
    reader = dialects.MAVLink(None)
    found = []
    for raw in raws:
        (message,) = reader.parse_buffer(raw)
        assert message.get_type() != "BAD_DATA"
        found.append(message)
    return found


@cache
def driven() -> list[tuple[Frame, int]]:
    return [(frame_of(sent.raw), sent.received_us) for sent in drive()]


@cache
def drive() -> tuple[Sent, ...]:
    """A drive of 1.5 s: an array, and a receiver."""
    told = line("IMU_ARRAY_INFO") + line("HEARTBEAT")
    epochs = line("GYRO_ARRAY", steps=0x44, repeat=6) + line("ACCEL_ARRAY", steps=0x11)
    fix = line("GPS_RAW_INT", steps=0x11)
    return tuple(messages(told + (epochs + fix) * 30))


def done(work: Coroutine[Any, Any, Any]) -> Any:
    """Result of what waits for nothing but its turn."""
    while True:
        try:
            assert work.send(None) is None, "it waits"
        except StopIteration as end:
            return end.value
