"""What inspect says of a log."""

import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from logs import simulated
from pymavlink.dialects.v20 import all as public
from test_look_back import epochs, written
from vehicle import Vehicle

from risaf_link.cli import main
from risaf_link.config import Config, load
from risaf_link.core.heading import GpsFix
from risaf_link.mavlink.epoch import EpochAssembler, GyroChunk
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.survey import paces, survey, verdict

FIXTURES = Path(__file__).parents[1] / "sitl_fixtures"
LOGS = ("rover_mavproxy.tlog", "rover_sitl_fixture.tlog", "rover_sitl_signed.tlog")


def by_pymavlink(path: Path) -> Counter[tuple[int, int, str]]:
    """How many messages there are of each kind, by the reference's decoder."""
    codec = public.MAVLink(None)
    codec.robust_parsing = True
    found: Counter[tuple[int, int, str]] = Counter()
    data, at = path.read_bytes(), 0
    while at + 8 < len(data):
        size = data[at + 9] + 12 + 13 * (data[at + 10] & 1)
        message = codec.decode(bytearray(data[at + 8 : at + 8 + size]))
        found[message.get_srcSystem(), message.get_srcComponent(), message.get_type()] += 1
        at += 8 + size
    return found


@pytest.mark.parametrize("name", LOGS)
def test_messages_are_counted_as_pymavlink_counts_them(name):
    found = survey(Config(), FIXTURES / name)
    assert {key: m.count for key, m in found.messages.items()} == by_pymavlink(FIXTURES / name)


@pytest.mark.parametrize("log", [*LOGS, "array"])
def test_tables_give_what_single_frames_give(log, tmp_path):
    path = simulated(tmp_path / "array.tlog", duration=8.0) if log == "array" else FIXTURES / log
    found = survey(Config(), path)
    ingest = Ingest(Config().array, Config().gps, Config().own)
    assembler = EpochAssembler(Config().array)
    fixes = elapsed = 0.0
    lost: Counter[tuple[int, int]] = Counter()
    last: dict[tuple[int, int], int] = {}
    for time_us, frame in TlogReader([path.read_bytes()]):
        sender = frame.system, frame.component
        missing = (frame.sequence - last.get(sender, frame.sequence - 1) - 1) % 256
        lost[sender] += missing if missing < 128 else 0
        last[sender] = frame.sequence
        datum = ingest.decode(frame, time_us)
        fixes += isinstance(datum, GpsFix)
        if isinstance(datum, GyroChunk):
            elapsed += sum(epoch.dt for epoch in assembler.add(datum))
    assert found.frames_lost == lost
    assert (found.assembly, found.unused) == (assembler.counts, ingest.counts)
    assert found.gps.fixes == fixes
    assert found.sensors == assembler.sensors
    assert found.epoch_rate == pytest.approx(assembler.counts["epochs"] / elapsed)


def test_a_gap_is_told_with_its_time_and_its_length(tmp_path):
    vehicle = Vehicle()
    parts = [epochs(vehicle, *span, lambda noise: noise) for span in ((0.0, 4.0), (7.0, 10.0))]
    found = survey(Config(), written(tmp_path / "gap.tlog", parts[0] + parts[1]))
    (gap,) = found.gaps
    assert gap == pytest.approx((3.99, 3.01), abs=0.05)


def test_the_rate_of_a_message_over_time_shows_when_it_did_not_come(tmp_path):
    vehicle = Vehicle()
    ticks = [k for k in range(600) if not 200 <= k < 400]  # 10 Hz
    fixes = [(100_000 * k, vehicle.fix(100_000 * k, 0.0)) for k in ticks]
    log = written(tmp_path / "fixes.tlog", fixes)
    found = survey(Config(), log)
    message = found.messages[1, 1, "GPS_RAW_INT"]
    shares = paces(message, found.duration, 30)
    times = (np.arange(30) + 0.5) * found.duration / 30
    silent = (times > 21.0) & (times < 39.0)
    assert (shares[silent] == 0.0).all()
    assert shares[(times < 19.0) | (times > 41.0)] == pytest.approx(1.0, abs=0.15)
    picture = tmp_path / "rates.png"
    result = CliRunner().invoke(main, ["inspect", str(log), "--plot", str(picture)])
    assert picture.read_bytes().startswith(b"\x89PNG")
    (line,) = [line for line in result.stdout.splitlines() if "GPS_RAW_INT" in line]
    bars = line[line.index("▆") :].rstrip()
    assert (len(bars), len(set(bars[:10]))) == (32, 1)
    assert bars[12:20].strip() == ""


def test_what_hardly_ever_comes_is_marked_where_it_came(tmp_path):
    vehicle = Vehicle()
    frames = [(1_000_000 * k, vehicle.fix(k, 0.0)) for k in (0, 30, 60)]
    found = survey(Config(), written(tmp_path / "rare.tlog", frames))
    shares = paces(found.messages[1, 1, "GPS_RAW_INT"], found.duration, 10)
    assert np.flatnonzero(shares).tolist() == [0, 5, 9]


def test_garbage_that_looks_like_a_thousand_messages_is_not_followed_over_time(tmp_path):
    log = tmp_path / "many.tlog"
    unknown = (
        struct.pack(">Q", 10**15 + k)
        + b"\xfd\x01\x00\x00\x00\x01\x01"
        + (50_000 + k).to_bytes(3, "little")
        + b"\x00\x00\x00"
        for k in range(1000)
    )
    log.write_bytes((FIXTURES / LOGS[1]).read_bytes()[:100_000] + b"".join(unknown))
    found = survey(Config(), log)
    assert sum(message.history is not None for message in found.messages.values()) <= 128


def test_the_speed_that_makes_a_course_a_heading_is_the_configured_one():
    log = FIXTURES / "rover_sitl_fixture.tlog"
    assert "fixes with course" in verdict(survey(Config(), log))
    assert "too slow for a heading" in verdict(survey(load(None, ["heading.min_speed=30"]), log))
