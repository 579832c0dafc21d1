"""How fast logs are read: replays, and a log of an autopilot's many messages."""

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from risaf_link.bench.epoch import SEED, NumpyForm
from risaf_link.bench.extent import Extent
from risaf_link.bench.figure import Figure, Spread, seconds_of
from risaf_link.bench.machine import has
from risaf_link.core.rotation import Floats
from risaf_link.links.file import read
from risaf_link.mavlink import risaf
from risaf_link.mavlink.dialect import IDS, MESSAGES
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.sim.array import count_scale
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import EPOCH_START_US, frames, record_time_us

SENSORS, RATE = 150, 100.0  # Hz
SENSORS_A_MESSAGE = 40
INSIDE, WHOLE = 1000.0, 400.0  # goals, times real time
MIXED = 150.0  # goal, MB/s
METHODS = ("mean", "risaf", "robust")
COMMAND = (sys.executable, "-m", "risaf_link.cli")
AUTOPILOT = (
    *("ATTITUDE", "ATTITUDE", "ATTITUDE", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    *("RAW_IMU", "SCALED_IMU2", "VFR_HUD", "SERVO_OUTPUT_RAW", "RC_CHANNELS", "SYS_STATUS"),
    *("GPS_RAW_INT", "VIBRATION", "SYSTEM_TIME", "SCALED_PRESSURE", "MISSION_CURRENT"),
    *("ESTIMATOR_STATUS", "NAV_CONTROLLER_OUTPUT", "POWER_STATUS", "HEARTBEAT"),
)
"""Messages of the mixed log, over and over: 20 to 44 bytes most of them."""


def replays(extent: Extent, directory: Path) -> Iterator[Figure]:
    """Replay a simulated log by a process of its own, with every method."""
    chosen = scenario("circle", SEED, sensors=SENSORS, rate=RATE, duration=extent.replay_s)
    path = directory / "array.tlog"
    with path.open("wb") as file:
        for time_us, raw in frames(chosen):
            file.write(record(record_time_us(time_us), raw))
    scale = count_scale(chosen.gyros)
    for method in METHODS:
        inside, whole = [], []
        for _ in range(extent.runs):
            began = time.perf_counter()
            summary = _replay(path, method)
            whole.append(summary["duration_s"] / (time.perf_counter() - began))
            inside.append(summary["realtime_factor"])
        rival = Spread.of([_pymavlink_and_numpy(path, method, scale, extent.rival_s)])
        reference = "pymavlink and NumPy", rival
        text = f"replay of {SENSORS} gyros at 100 Hz, {method}"
        yield Figure(
            *(f"replay_{method}_inside", f"{text}, inside", "x real time", Spread.of(inside)),
            *reference,
            goal=INSIDE,
            more_is_better=True,
        )
        yield Figure(
            *(f"replay_{method}_whole", f"{text}, process", "x real time", Spread.of(whole)),
            *reference,
            goal=WHOLE,
            more_is_better=True,
        )


def _replay(path: Path, method: str) -> dict[str, float]:
    command = [*COMMAND, "replay", str(path), "--json", "--set", f"fusion.method={method}"]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout  # noqa: S603
    summary: dict[str, float] = json.loads(output)
    return summary


def _pymavlink_and_numpy(path: Path, method: str, scale: float, seconds: float) -> float:
    """Times real time of what one would write first: message by message, then NumPy."""
    codec, form, no_forces = risaf.MAVLink(None), NumpyForm(method), np.zeros((0, 3))
    frames_per_s = RATE * math.ceil(SENSORS / SENSORS_A_MESSAGE)
    raws = [one.frame.raw for one in islice(TlogReader(read(path)), round(seconds * frames_per_s))]
    times_us: list[int] = []
    parts: list[Floats] = []
    began = time.perf_counter()
    for raw in raws:
        message = codec.parse_char(raw)
        if message.get_type() != "GYRO_ARRAY":
            continue
        parts.append(np.reshape(message.rates[: 3 * message.sensor_count], (-1, 3)) * scale)
        if message.first_sensor + message.sensor_count == SENSORS:
            times_us.append(message.time_usec)
            dt = (times_us[-1] - times_us[-2]) / 1e6 if len(times_us) > 1 else 0.0
            form.step(dt, np.concatenate(parts), no_forces)
            parts = []
    return (times_us[-1] - times_us[0]) / 1e6 / (time.perf_counter() - began)


def mixed(extent: Extent, directory: Path, log: Path | None = None) -> Iterator[Figure]:
    """Find and verify every frame of an autopilot's log."""
    path = log or directory / "mixed.tlog"
    if log is None:
        _write_mixed(path, extent.mixed_frames)
    size = path.stat().st_size / 1e6
    rates = [size / taken for taken in seconds_of(lambda: tables(path), extent.repeats)]
    few = directory / "part.tlog"
    few.write_bytes(b"".join(_first_records(path, extent.rival_frames)))
    part = few.stat().st_size / 1e6
    text = f"log of an autopilot, {size / tables(path) * 1e6:.0f} bytes a record"
    figure = partial(
        Figure, unit="MB/s", ours=Spread.of(rates), goal=MIXED, more_is_better=True, text=text
    )
    slow = [part / taken for taken in seconds_of(lambda: recv_match(few), extent.runs)]
    yield figure("mixed_pymavlink", against="recv_match", reference=Spread.of(slow))
    against = "fasttlogparser"
    if not has(against):
        yield figure("mixed_fasttlogparser", against=against, note=f"{against} is not installed")
        return
    fast = [size / taken for taken in _fasttlogparser(path, extent.repeats)]
    yield figure("mixed_fasttlogparser", against=against, reference=Spread.of(fast))


def _write_mixed(path: Path, count: int) -> None:
    """Write messages whose numbers mean nothing, at 1 kHz."""
    contents = np.random.default_rng(SEED).bytes(1 << 16)
    kinds = [(IDS[name], MESSAGES[IDS[name]].unpacker.size) for name in AUTOPILOT]
    with path.open("wb") as file:
        for k in range(count):
            message_id, length = kinds[k % len(kinds)]
            start = k * 97 % (len(contents) - length)
            raw = encode(message_id, contents[start : start + length], k & 0xFF, 1, 1)
            file.write(record(EPOCH_START_US + 1000 * k, raw))


def _first_records(path: Path, count: int) -> Iterator[bytes]:
    for one in islice(TlogReader(read(path)), count):
        yield record(one.time_us, one.frame.raw)


def tables(path: Path) -> int:
    """Count the frames of a log, found in tables."""
    return sum(len(table) for table, _ in TlogReader(read(path)).tables())


def recv_match(path: Path) -> int:
    """Count the messages that pymavlink finds."""
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path))
    found = 0
    while log.recv_match() is not None:
        found += 1
    log.close()
    return found


def _fasttlogparser(path: Path, repeats: int) -> list[float]:
    """Seconds that it takes, by its own process: it complains of what is not in its dialect."""
    code = (
        "import sys, time, fasttlogparser as parser\n"
        "for _ in range(int(sys.argv[2])):\n"
        "    began = time.perf_counter()\n"
        "    parser.parseTLog(sys.argv[1])\n"
        "    print('took', time.perf_counter() - began, file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", code, str(path), str(repeats)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
    lines = (line.split() for line in done.stderr.splitlines())
    return [float(words[1]) for words in lines if words[:1] == ["took"]]
