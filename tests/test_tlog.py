"""Telemetry logs, read by pymavlink and by us, and logs that cannot be trusted."""

import struct
import tracemalloc
from itertools import count, islice

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from streams import chunks, raws, read_by_pymavlink, recording, seeded, sequence

from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.tlog import RECEIVED, SENT, TlogReader, record

pytestmark = pytest.mark.usefixtures("cutter")
START_US = 1_700_000_000_000_000
STEP_US = 10_000
FRAMES = sequence("both", 51, 40)
TIMES = [START_US + i * STEP_US for i in range(len(FRAMES))]
WILD = [0, 4, START_US // 1000, START_US - 86_400_000_000, START_US + 86_400_000_000, 2**64 - 4]


def log_of(stamps):
    return b"".join(
        (b"" if stamp is None else struct.pack(">Q", stamp)) + frame
        for stamp, frame in zip(stamps, FRAMES, strict=True)
    )


def read(*pieces):
    """Times and frames of a log, and how many stamps were not believed."""
    reader = TlogReader(pieces)
    records = list(reader)
    assert all(entry.time_us % 4 == 0 for entry in records)
    return (
        [entry.time_us for entry in records],
        [entry.frame.raw for entry in records],
        reader.stamps_replaced,
    )


# As MAVProxy


def test_a_record_is_a_big_endian_time_with_the_link_in_its_two_low_bits_and_the_frame():
    assert (RECEIVED, SENT) == (0, 3)
    assert record(0x0102030405060708, b"frame") == b"\1\2\3\4\5\6\7\x08frame"
    assert record(0x010203040506070B, b"frame") == b"\1\2\3\4\5\6\7\x08frame"
    assert record(0x0102030405060708, b"frame", SENT) == b"\1\2\3\4\5\6\7\x0bframe"


def test_pymavlink_reads_what_we_write(tmp_path):
    path = tmp_path / "ours.tlog"
    links = [i % 4 for i in range(len(FRAMES))]
    path.write_bytes(b"".join(map(record, TIMES, FRAMES, links)))
    stamps = [time_us + link for time_us, link in zip(TIMES, links, strict=True)]
    assert read_by_pymavlink(path) == [
        (stamp * 1e-6, frame) for stamp, frame in zip(stamps, FRAMES, strict=True)
    ]
    assert read(path.read_bytes()) == (TIMES, list(FRAMES), 0)


@pytest.mark.parametrize(
    "name", ["rover_sitl_fixture.tlog", "rover_mavproxy.tlog", "ardusub_bug.tlog"]
)
def test_a_recording_has_the_times_that_pymavlink_reads(name):
    path = recording(name)
    times, frames, replaced = read(path.read_bytes())
    by_pymavlink = read_by_pymavlink(path)
    assert replaced == 0
    assert frames == [raw for _, raw in by_pymavlink]
    assert times == [round(time * 1e6) & ~3 for time, _ in by_pymavlink]


@pytest.mark.parametrize("mix", ["both", "signed", "unknown, MAVLink 2", "nothing known"])
def test_a_log_without_stamps_holds_the_same_frames(mix, tmp_path):
    path = tmp_path / "log.tlog.raw"
    path.write_bytes(b"".join(sequence(mix, 52)))
    times, frames, replaced = read(path.read_bytes())
    assert frames == list(sequence(mix, 52))
    assert (set(times), replaced) == ({0}, 1000)
    if mix == "both":
        assert frames == [raw for _, raw in read_by_pymavlink(path, stamped=False)]


# Whatever is in it


def test_an_empty_log_has_no_records():
    assert read() == read(b"") == ([], [], 0)


def test_garbage_between_records_costs_nothing():
    random = seeded(53)
    records = [record(time_us, frame) for time_us, frame in zip(TIMES, FRAMES, strict=True)]
    garbage = [random.randbytes(random.choice((0, 1, 7, 30, 300))) for _ in records]
    log = b"".join(before + entry for before, entry in zip(garbage, records, strict=True))
    assert read(log) == (TIMES, list(FRAMES), 0)


def test_a_log_that_starts_within_a_record_keeps_its_stamps():
    whole = log_of(TIMES)
    for cut in range(1, 8):
        times, frames, replaced = read(whole[cut:])
        assert (times, frames) == ([TIMES[1], *TIMES[1:]], list(FRAMES))
        assert replaced == 1
    assert read(whole[8 + len(FRAMES[0]) // 2 :])[0] == TIMES[1:]


def test_a_log_that_ends_within_a_record_loses_that_record_only():
    last = 8 + len(FRAMES[-1])
    for cut in range(1, last + 1):
        assert read(log_of(TIMES)[:-cut]) == (TIMES[:-1], list(FRAMES[:-1]), 0)


@settings(max_examples=50)
@given(
    st.lists(st.sampled_from([*FRAMES, b"garbage", b"\xfe\xfd" * 30]), max_size=12),
    st.lists(st.sampled_from([None, START_US, START_US + 40, *WILD]), min_size=12, max_size=12),
    st.lists(st.integers(0, 100), max_size=20),
)
def test_records_are_the_same_whatever_the_chunks(frames, stamps, sizes):
    log = b"".join(
        (b"" if stamp is None else struct.pack(">Q", stamp)) + frame
        for stamp, frame in zip(stamps, frames, strict=False)
    )
    whole = read(log)
    assert read(*chunks(log, sizes)) == whole
    assert read(*chunks(log, [1] * len(log))) == whole


def test_a_log_is_read_as_it_comes():
    endless = (record(START_US + i * STEP_US, FRAMES[i % 40]) for i in count())
    times = [entry.time_us for entry in islice(TlogReader(endless), 5000)]
    assert times == [START_US + i * STEP_US for i in range(5000)]


# Stamps


wild = st.one_of(
    st.sampled_from(WILD),
    st.integers(0, 2**64 - 1),
    st.integers(START_US - 60_000_000, START_US + 60_000_000),
).map(lambda stamp: stamp & ~3)


@given(st.integers(1, len(FRAMES) - 2), wild)
def test_a_lone_stamp_is_not_trusted(place, stamp):
    assume(not TIMES[place - 2] <= stamp < TIMES[place - 1])  # either may be the wrong one then
    times, frames, replaced = read(log_of([*TIMES[:place], stamp, *TIMES[place + 1 :]]))
    assert frames == list(FRAMES)
    assert times[:place] + times[place + 1 :] == TIMES[:place] + TIMES[place + 1 :]
    assert TIMES[place - 1] <= times[place] <= TIMES[place + 1]
    assert replaced == (times[place] != stamp)


@pytest.mark.parametrize("stamp", WILD)
def test_the_first_stamp_is_not_trusted(stamp):
    assert read(log_of([stamp, *TIMES[1:]])) == ([TIMES[1], *TIMES[1:]], list(FRAMES), 1)


@pytest.mark.parametrize("stamp", WILD)
def test_the_last_stamp_is_not_trusted(stamp):
    assert read(log_of([*TIMES[:-1], stamp])) == ([*TIMES[:-1], TIMES[-2]], list(FRAMES), 1)


@pytest.mark.parametrize("stamp", [stamp for stamp in WILD if stamp < 2**62])
def test_a_single_record_has_the_only_time_there_is(stamp):
    (entry,) = TlogReader([record(stamp, FRAMES[0])])
    assert entry.time_us == stamp


@given(st.integers(1, 20), st.sampled_from(WILD), st.sampled_from(WILD))
def test_two_wild_stamps_in_a_row_are_not_believed_either(place, one, other):
    times, _, replaced = read(log_of([*TIMES[:place], one, other, *TIMES[place + 2 :]]))
    assert times == [*TIMES[:place], *[TIMES[place - 1]] * 2, *TIMES[place + 2 :]]
    assert replaced == 2


@given(
    st.integers(6, len(FRAMES) - 2),
    st.one_of(st.integers(-START_US // 4, -250_000), st.integers(0, 2**60), st.integers(0, 10**9)),
)
def test_a_clock_that_is_set_is_followed_at_once(place, step):
    step = step // 4 * 4
    times = TIMES[:place] + [time_us + step for time_us in TIMES[place:]]
    assert read(log_of(times)) == (times, list(FRAMES), 0)


def test_a_log_may_be_sparse_and_silent_for_long():
    for pause in (20_000_000, 100_000_000):
        times = [START_US + i * pause for i in range(len(FRAMES))]
        assert read(log_of(times)) == (times, list(FRAMES), 0)


@pytest.mark.parametrize("stamp", [2**62 + 4, 2**63, 2**64 - 4])
def test_a_stamp_that_no_clock_shows_is_none_however_many_follow(stamp):
    count = len(FRAMES) - 20
    expected = [*TIMES[:20], *[TIMES[19]] * count]
    assert read(log_of([*TIMES[:20], *[stamp] * count])) == (expected, list(FRAMES), count)
    assert read(log_of([stamp] * len(FRAMES)))[0] == [0] * len(FRAMES)


def test_equal_stamps_are_believed():
    times = sorted(TIMES[:10] * 4)
    assert read(log_of(times)) == (times, list(FRAMES), 0)


def test_small_disorder_is_straightened():
    times, _, replaced = read(log_of([*TIMES[:20], TIMES[18], *TIMES[21:]]))
    assert times == [*TIMES[:19], TIMES[18], TIMES[18], *TIMES[21:]]
    assert replaced == 1


@given(st.sets(st.integers(1, len(FRAMES) - 1), max_size=15))
def test_a_record_without_a_stamp_has_the_time_before(places):
    times, frames, replaced = read(
        log_of([None if i in places else time_us for i, time_us in enumerate(TIMES)])
    )
    expected = list(TIMES)
    for place in sorted(places):
        expected[place] = expected[place - 1]
    assert (times, frames, replaced) == (expected, list(FRAMES), len(places))


spans = st.one_of(
    st.tuples(st.just("steps"), st.integers(1, 30), st.sampled_from([0, 4, STEP_US, 400_000_000])),
    st.tuples(st.just("missing"), st.integers(1, 12), st.just(0)),
    st.tuples(st.just("wild"), st.integers(1, 3), st.sampled_from(WILD)),
    st.tuples(st.just("set"), st.just(1), st.integers(-(10**9), 10**9).map(lambda us: us * 4)),
)


@given(st.lists(spans, max_size=12), st.lists(st.integers(0, 900), max_size=12))
def test_times_in_tables_are_those_of_the_rule_for_one_record(parts, sizes):
    stamps, now_us = [], START_US
    for kind, length, value in parts:
        now_us += value if kind == "set" else 0
        for _ in range(length):
            now_us += value if kind == "steps" else 0
            stamps.append({"missing": None, "wild": value}.get(kind, now_us))
    frames = [FRAMES[i % 40] for i in range(len(stamps))]
    log = b"".join(
        (b"" if stamp is None else struct.pack(">Q", stamp)) + frame
        for stamp, frame in zip(stamps, frames, strict=True)
    )
    stamps = [stamp if stamp is None or stamp <= 2**62 else None for stamp in stamps]
    rule, expected, last = TlogReader([]), [], None
    for i, stamp in enumerate(stamps):
        last = rule._time(stamp, [s for s in stamps[i + 1 : i + 9] if s is not None], last)
        expected.append(last)
    reader = TlogReader([])
    reader.parser, reader._chunks = FrameParser(8), chunks(log, sizes)
    tables = list(reader.tables())
    assert [time_us for _, times_us in tables for time_us in times_us.tolist()] == expected
    assert [t.frame(row).raw for t, _ in tables for row in range(len(t))] == frames
    assert reader.stamps_replaced == rule.stamps_replaced


def test_frames_of_a_log_are_the_parsers():
    log = log_of(TIMES)
    reader = TlogReader([log])
    assert [entry.frame.raw for entry in reader] == raws(b"".join(FRAMES))
    assert (reader.parser.dropped, reader.parser.skipped) == ({}, 0)


def test_a_log_is_read_in_constant_memory():
    piece = b"".join(record(START_US + i * STEP_US, FRAMES[i % 40]) for i in range(1000))
    peaks = []
    for length in (20, 200):
        reader = TlogReader(bytes(bytearray(piece)) for _ in range(length))
        tracemalloc.start()
        assert sum(len(table) for table, _ in reader.tables()) == 1000 * length
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] < 20 * len(piece)
