"""Framing, held against pymavlink and spoiled in every way that a line spoils a stream."""

import hashlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import (
    CLASSES,
    KEY,
    MIXES,
    OURS,
    SHORT,
    STOCK,
    chunks,
    codec,
    framed,
    made,
    message,
    parsed,
    payloads,
    raws,
    recording,
    seeded,
    sequence,
    unknown,
    with_length,
    without_byte,
)

from risaf_link.mavlink import frame as frame_module
from risaf_link.mavlink import search
from risaf_link.mavlink.dialect import CRC_EXTRA, IDS
from risaf_link.mavlink.frame import FrameParser, encode

HEARTBEAT = IDS["HEARTBEAT"]
UNKNOWN = 70_000
LARGEST = 10 + 255 + 2 + 13  # bytes of a frame
MOST_HELD = 13 + 8 + 2 * LARGEST + 8  # bytes: a signature before them, a prefix on either side
SEEDS = [3, 4, 5]  # without an accident: a checksum fits by chance once in 65,536 times
pytestmark = pytest.mark.usefixtures("cutter")
KNOWN_MIXES = ["arrays", "MAVLink 2", "MAVLink 1", "both", "signed"]


def heartbeat(payload: bytes = b"\1\2\3\4\5\6\7\3\3", flags: int = 0) -> bytes:
    return framed(HEARTBEAT, payload, CRC_EXTRA[HEARTBEAT], flags=flags)


# Both ways against pymavlink


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("name", STOCK + OURS)
@settings(max_examples=15)
@given(st.data())
def test_what_pymavlink_sends_we_read(name, signed, data):
    payload = data.draw(payloads(name))
    mavlink = codec(name, signed)
    mavlink.seq = data.draw(st.integers(0, 255))
    header = (mavlink.seq, 7, 9, CLASSES[name].id)
    raw = bytes(message(name, payload).pack(mavlink))
    (frame,), parser = parsed([raw])
    assert (frame.sequence, frame.system, frame.component, frame.message_id) == header
    assert (frame.raw, frame.version, frame.known) == (raw, 2, True)
    assert frame.payload == payload[:1] + payload[1:].rstrip(b"\0")
    assert frame.signature == (raw[-13:] if signed else b"")
    assert (parser.dropped, parser.skipped) == ({}, 0)


@pytest.mark.parametrize("name", SHORT)
@settings(max_examples=15)
@given(st.data())
def test_what_pymavlink_sends_as_mavlink_1_we_read(name, data):
    payload = data.draw(payloads(name))
    mavlink = codec(name)
    mavlink.seq = data.draw(st.integers(0, 255))
    raw = bytes(message(name, payload).pack(mavlink, force_mavlink1=True))
    (frame,), _ = parsed([raw])
    assert (frame.raw, frame.version, frame.payload, frame.signature) == (raw, 1, payload, b"")
    header = (mavlink.seq, 7, 9, CLASSES[name].id)
    assert (frame.sequence, frame.system, frame.component, frame.message_id) == header


@pytest.mark.parametrize("name", STOCK + OURS)
@settings(max_examples=15)
@given(st.data())
def test_what_we_send_pymavlink_reads_and_would_send_alike(name, data):
    payload = data.draw(payloads(name))
    sequence_number = data.draw(st.integers(0, 255))
    raw = encode(CLASSES[name].id, payload, sequence_number, 7, 9)
    (received,) = codec(name).parse_buffer(raw)
    assert received.get_type() == name
    assert (received.get_seq(), received.get_srcSystem(), received.get_srcComponent()) == (
        sequence_number,
        7,
        9,
    )
    sender = codec(name)
    sender.seq = sequence_number
    assert bytes(received.pack(sender)) == raw


@pytest.mark.parametrize(
    ("name", "frames"),  # numbers of pymavlink 2.4.50
    [
        ("rover_sitl_fixture.tlog", 8561),
        ("rover_sitl_signed.tlog", 38454),
        ("rover_mavproxy.tlog", 34048),
        ("rover_sitl_gps_unplugged.tlog", 118346),
        ("dronekit_flight.tlog", 75477),
        ("ardusub_small.tlog", 35912),
        ("ardusub_bug.tlog", 50136),
    ],
)
def test_a_recording_holds_as_many_frames_as_pymavlink_finds(name, frames):
    found, _ = parsed([recording(name).read_bytes()], prefix_size=8)
    assert len(found) == frames


def test_every_signature_of_a_signed_recording_is_split_off_and_right():
    data = recording("rover_sitl_signed.tlog").read_bytes()
    found, parser = parsed([data], prefix_size=8)
    assert (parser.dropped, parser.skipped) == ({}, 0)
    for frame in found:
        digest = hashlib.sha256(KEY + frame.raw[:-6]).digest()
        assert len(frame.signature) == 13
        assert frame.signature[7:] == digest[:6]
        assert frame.raw == frame.raw[:-13] + frame.signature


# One bad frame costs no other


@pytest.mark.parametrize("prefix_size", [0, 8])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("mix", MIXES)
def test_900_others_are_returned_when_every_tenth_length_is_corrupt(mix, seed, prefix_size):
    random, frames = seeded(seed), list(sequence(mix, seed))
    damaged = [with_length(f, (f[1] + random.randrange(1, 256)) % 256) for f in frames[5::10]]
    others = [frame for i, frame in enumerate(frames) if i % 10 != 5]
    frames[5::10] = damaged
    stream = b"".join(random.randbytes(prefix_size) + frame for frame in frames)
    found, parser = parsed([stream], prefix_size)
    assert [frame.raw for frame in found] == others
    assert sum(parser.dropped.values()) == 100
    held = sum(len(frame.prefix) + len(frame.raw) for frame in found)
    assert held + parser.skipped == len(stream)


@pytest.mark.parametrize("prefix_size", [0, 8])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("mix", KNOWN_MIXES)
def test_900_others_are_returned_when_every_tenth_lost_a_byte(mix, seed, prefix_size):
    random, frames = seeded(seed), list(sequence(mix, seed))
    signature = 13 if mix == "signed" else 0
    chosen, others = frames[5::10], [frame for i, frame in enumerate(frames) if i % 10 != 5]
    frames[5::10] = [without_byte(f, random.randrange(len(f) - signature)) for f in chosen]
    stream = b"".join(random.randbytes(prefix_size) + frame for frame in frames)
    found = [frame.raw for frame in parsed([stream], prefix_size)[0]]
    # a frame is whole again if what follows begins with the last byte, which it has lost
    assert [raw for raw in found if raw not in chosen] == others


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("mix", ["unknown, MAVLink 2", "unknown, MAVLink 1", "nothing known"])
def test_unknown_messages_survive_a_byte_lost_nearby_if_a_mark_follows_them(mix, seed):
    random, frames = seeded(seed), list(sequence(mix, seed))
    others = [frame for i, frame in enumerate(frames) if i % 10 != 5]
    frames[5::10] = [without_byte(f, random.randrange(1, len(f) - 1)) for f in frames[5::10]]
    assert raws(b"".join(frames)) == others


@pytest.mark.parametrize("lost", range(1, 14))
def test_bytes_lost_from_a_signature_do_not_cost_the_next_frame(lost):
    frames = list(sequence("signed", 3))
    others = [frame for i, frame in enumerate(frames) if i % 10 != 5]
    damaged = {frame[:-13] for frame in frames[5::10]}
    frames[5::10] = [frame[:-lost] for frame in frames[5::10]]
    assert [raw for raw in raws(b"".join(frames)) if raw[:-13] not in damaged] == others


def test_a_mark_that_is_taken_for_the_end_of_a_checksum_still_starts_its_frame():
    payloads = (bytes((i, j)) for i in range(256) for j in range(1, 256))
    frame = next(f for f in map(heartbeat, payloads) if f[-1] == 0xFD)
    assert raws(frame[:-1] + heartbeat() + heartbeat()) == [frame, heartbeat(), heartbeat()]


@pytest.mark.parametrize(
    "frame",
    [
        heartbeat(),
        made("GYRO_ARRAY", seeded(1)),
        made("RAW_IMU", seeded(2), version=1),
        made("SIM_STATE", seeded(3), signed=True),
        unknown(seeded(4)),
        unknown(seeded(5), version=1),
    ],
    ids=["short", "long", "MAVLink 1", "signed", "unknown", "unknown, MAVLink 1"],
)
@pytest.mark.parametrize("mix", ["MAVLink 1", "MAVLink 2", "unknown, MAVLink 2"])
def test_no_length_that_is_wrong_costs_another_frame(frame, mix):
    before, after = sequence(mix, 11, 3), sequence(mix, 12, 20)
    for length in set(range(256)) - {frame[1]}:
        stream = b"".join([*before, with_length(frame, length), *after])
        assert raws(stream) == [*before, *after], length


# Chunks do not matter


def pieces():
    """Streams of anything: frames, damaged frames, garbage."""
    pool = [frame for mix in MIXES for frame in sequence(mix, 21, 12)]
    pool += [heartbeat(b""), heartbeat(flags=2), framed(UNKNOWN, b"", 0), framed(9, b"", 0, 1)]
    good = st.sampled_from(pool)
    damaged = st.one_of(
        st.builds(with_length, good, st.integers(0, 255)),
        st.builds(without_byte, good, st.integers(0, 20)),
        st.builds(lambda frame, size: frame[:size], good, st.integers(0, 40)),
        st.builds(lambda frame, size: frame[:-size], good, st.integers(1, 13)),
    )
    marks = st.lists(st.sampled_from([0xFD, 0xFE, 0, 1, 9]), max_size=300).map(bytes)
    return st.lists(st.one_of(good, damaged, st.binary(max_size=20), marks), max_size=12)


PIECES_AND_CHUNKS = given(
    pieces(),
    st.sampled_from([0, 8]),
    st.lists(st.integers(0, 400), max_size=12),
    st.randoms(use_true_random=False),
)


@settings(max_examples=200)
@PIECES_AND_CHUNKS
def test_frames_and_counts_are_the_same_whatever_the_chunks(parts, prefix_size, sizes, random):
    stream = b"".join(random.randbytes(random.choice((0, prefix_size))) + part for part in parts)
    whole, parser = parsed([stream], prefix_size)
    for cut in (chunks(stream, sizes), chunks(stream, [1] * len(stream))):
        found, other = parsed(cut, prefix_size)
        assert found == whole
        assert (other.dropped, other.skipped) == (parser.dropped, parser.skipped)
    held = sum(len(frame.prefix) + len(frame.raw) for frame in whole)
    assert held + parser.skipped >= len(stream)


@settings(max_examples=50)
@given(pieces(), st.sampled_from([0, 8]), st.lists(st.integers(0, 2000), max_size=12))
def test_the_parser_never_holds_more_than_two_frames(parts, prefix_size, sizes):
    for cut in (sizes, [1] * 2000):
        parser = FrameParser(prefix_size)
        for chunk in chunks(b"".join(parts), cut):
            parser.receive_data(chunk)
            assert len(parser._buffer) < MOST_HELD


@settings(max_examples=200)
@PIECES_AND_CHUNKS
def test_both_forms_find_the_same_in_every_piece(parts, prefix_size, sizes, random):
    stream = b"".join(random.randbytes(random.choice((0, prefix_size))) + part for part in parts)
    for cut in (chunks(stream, sizes), chunks(stream, [1] * len(stream))):
        buffer, done, in_step = b"", 0, True
        *early, last = cut
        for piece, ended in [*((piece, False) for piece in early), (last, True)]:
            buffer += piece
            found = frame_module.cut(buffer, prefix_size, done, in_step, ended)
            assert found == search.cut(buffer, prefix_size, done, in_step, ended)
            _, keep, done, in_step, _, _ = found
            buffer = buffer[keep:]


@settings(max_examples=50)
@given(pieces(), st.sampled_from([0, 8]), st.lists(st.integers(0, 400), max_size=12))
def test_tables_hold_the_frames_that_are_returned_one_by_one(parts, prefix_size, sizes):
    stream = b"".join(parts)
    frames, parser = parsed(chunks(stream, sizes), prefix_size)
    other = FrameParser(prefix_size)
    tables = [*map(other.receive_table, chunks(stream, sizes)), other.end_table()]
    assert [table.frame(row) for table in tables for row in range(len(table))] == frames
    assert (other.dropped, other.skipped) == (parser.dropped, parser.skipped)
    for table in tables:
        for row, start in enumerate(table.payloads):
            payload = table.buffer[start : start + table.cuts["size"][row]]
            assert payload == table.frame(row).payload
        others = [table.frame(row) for row in range(len(table))]
        assert table.raw(but=0) == [frame.raw for frame in others if frame.message_id != 0]


@pytest.mark.parametrize("mix", KNOWN_MIXES)
def test_a_frame_comes_with_its_last_byte(mix):
    parser = FrameParser()
    for frame in sequence(mix, 31, 50):
        *early, last = (parser.receive_data(frame[i : i + 1]) for i in range(len(frame)))
        assert not any(early)
        assert [found.raw for found in last] == [frame]


@pytest.mark.parametrize("mix", KNOWN_MIXES)
def test_it_is_known_whether_a_frame_has_ended(mix):
    parser, (first, second) = FrameParser(), sequence(mix, 31, 2)
    assert parser.is_between_frames
    for byte in first[:-1]:
        parser.receive_data(bytes([byte]))
        assert not parser.is_between_frames
    parser.receive_data(first[-1:])
    assert parser.is_between_frames
    parser.receive_data(b"\0")
    assert not parser.is_between_frames
    parser.receive_data(second)
    assert parser.is_between_frames


@pytest.mark.parametrize("size", [1, 100, 65536])
@pytest.mark.parametrize(
    "pattern",
    [
        b"\xfe",
        b"\xfd",
        b"\xfe\xff",
        b"\xfd\xff\0\0\0\0\0\x1e\0\0",
        b"\xfd\xf7\1\0\0\0\0\x1e\0\x77",
        b"".join(sequence("nothing known", 32, 20)),
        *[frame[:-1] for frame in sequence("nothing known", 32, 3)],
    ],
)
def test_a_stream_of_marks_costs_at_most_one_frames_checksum_a_byte(pattern, size, monkeypatch):
    stream = (pattern * 20_000)[:20_000]
    pieces = list(chunks(stream, [size] * (len(stream) // size)))
    assert summed(pieces, monkeypatch) <= LARGEST * len(stream)


def summed(pieces, monkeypatch):
    """How many bytes go through a checksum while a stream is cut."""
    if frame_module.cut is not search.cut:
        kernel = frame_module.native.Cutter(CRC_EXTRA)
        monkeypatch.setattr(frame_module, "cut", kernel.cut)
        parsed(pieces)
        return kernel.summed
    sizes = []
    checksum = search.mcrf4xx
    monkeypatch.setattr(
        search, "mcrf4xx", lambda content: sizes.append(len(content)) or checksum(content)
    )
    parsed(pieces)
    return sum(sizes)


# What is inside a frame


def test_a_payload_may_be_shorter_or_longer_than_our_definition():
    for size in (*range(1, 12), 255):
        raw = heartbeat(bytes(range(1, size + 1)))
        (frame,), _ = parsed([raw])
        assert frame.payload == bytes(range(1, size + 1))


def test_a_payload_may_be_empty():
    stream = heartbeat(b"") + framed(UNKNOWN, b"", 3) + framed(HEARTBEAT, b"", CRC_EXTRA[0], 1)
    found, _ = parsed([stream])
    assert [frame.payload for frame in found] == [b""] * 3
    assert encode(HEARTBEAT, b"", 1, 7, 9) == heartbeat(b"")


def test_zeros_at_the_end_are_cut_but_for_the_first_byte():
    assert encode(HEARTBEAT, bytes(9), 1, 7, 9) == heartbeat(b"\0")
    assert encode(HEARTBEAT, b"\0\0\5\0", 1, 7, 9) == heartbeat(b"\0\0\5")


def test_a_frame_in_a_payload_is_payload():
    tunnel = framed(IDS["TUNNEL"], heartbeat() * 3, CRC_EXTRA[IDS["TUNNEL"]])
    assert raws(tunnel + heartbeat()) == [tunnel, heartbeat()]


def test_compatibility_flags_do_not_matter():
    flagged = bytearray(heartbeat())
    flagged[3] = 0x80
    flagged[-2:] = search.checksum_of(bytes(flagged[1:-2]), CRC_EXTRA[HEARTBEAT])
    assert raws(bytes(flagged)) == [bytes(flagged)]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (heartbeat()[:-1] + b"\0", "checksum"),
        (with_length(heartbeat(), 200), "checksum"),
        (heartbeat(flags=2), "incompatible"),
        (heartbeat(flags=3) + bytes(13), "incompatible"),
        (framed(UNKNOWN, b"1234", 5) + b"?", "unverified"),
        (framed(UNKNOWN, b"1234" + heartbeat(), 5), "unverified"),
        (with_length(framed(UNKNOWN, b"1234", 5), 3), "checksum"),
    ],
)
def test_what_is_dropped_is_counted_by_reason(bad, reason):
    found, parser = parsed([heartbeat() + bad + heartbeat() * 20])
    assert parser.dropped == {reason: 1}
    inside = bad.count(heartbeat())
    assert [frame.raw for frame in found] == [heartbeat()] * (21 + inside)
    assert parser.skipped == len(bad) - inside * len(heartbeat())


@pytest.mark.parametrize("tail", [b"", b"\xfd", heartbeat()[:-1], heartbeat()[:4]])
def test_a_frame_that_the_end_cuts_off_is_counted(tail):
    found, parser = parsed([heartbeat() + tail])
    assert [frame.raw for frame in found] == [heartbeat()]
    assert parser.dropped == ({"truncated": 1} if tail else {})
    assert parser.skipped == len(tail)


def test_an_intact_frame_behind_a_length_that_points_beyond_the_end_is_found():
    assert raws(with_length(heartbeat(), 255) + heartbeat()) == [heartbeat()]


# Unknown messages


@pytest.mark.parametrize("version", [1, 2])
def test_unknown_messages_are_passed_on_as_such(version):
    frames = [unknown(seeded(seed), version) for seed in range(50)]
    found, parser = parsed([b"".join([heartbeat(), *frames, heartbeat()])])
    assert [frame.raw for frame in found] == [heartbeat(), *frames, heartbeat()]
    assert [frame.known for frame in found] == [True, *[False] * 50, True]
    assert (parser.dropped, parser.skipped) == ({}, 0)


def test_an_unknown_message_waits_for_the_mark_behind_it_or_the_end():
    parser = FrameParser()
    frame = framed(UNKNOWN, b"1234", 5)
    assert parser.receive_data(frame) == []
    assert [found.raw for found in parser.receive_data(b"\xfd")] == [frame]
    assert raws(frame) == [frame]
    assert [found.raw for found in parsed([bytes(8) + frame + bytes(7)], 8)[0]] == [frame]


def test_an_unknown_message_is_found_behind_garbage():
    frame = framed(UNKNOWN, b"1234", 5)
    assert raws(heartbeat() + b"garbage \xfd garbage" + frame + heartbeat()) == [
        heartbeat(),
        frame,
        heartbeat(),
    ]


def test_an_unknown_message_in_an_unknown_message_is_payload():
    frame = framed(UNKNOWN, framed(UNKNOWN + 1, b"1234", 5), 5)
    assert raws(frame + heartbeat()) == [frame, heartbeat()]


def test_a_frame_that_only_starts_in_an_unknown_message_does_not_speak_against_it():
    start = bytes((0xFE, 20, 1, 7, 9, HEARTBEAT))
    unknown_frame = framed(UNKNOWN, start, 5)
    head = b"\xfd\x0c\0\0\1\7\x09" + HEARTBEAT.to_bytes(3, "little")
    crossing = start + unknown_frame[-2:] + head + b"12345678"
    checksum = search.checksum_of(crossing[1:], CRC_EXTRA[HEARTBEAT])
    follower = heartbeat(b"12345678" + checksum + b"90")
    assert raws(crossing + checksum) == [crossing + checksum]
    for pieces in ([unknown_frame + follower], chunks(unknown_frame + follower, [1] * 60)):
        assert raws(*pieces) == [unknown_frame, follower]


def test_an_unknown_message_in_garbage_does_not_cost_the_frame_that_begins_in_it():
    head = b"\xfd\x28\0\0\1\7\x09" + UNKNOWN.to_bytes(3, "little")
    payload = bytearray(seeded(6).randbytes(253))
    begin = encode(IDS["GYRO_ARRAY"], bytes(payload), 1, 7, 9)[:40]
    payload[30:33] = search.checksum_of(head[1:] + begin, 5) + b"\xfd"
    frame = encode(IDS["GYRO_ARRAY"], bytes(payload), 1, 7, 9)
    stream = head + frame + heartbeat()
    assert raws(stream) == [stream[:52], heartbeat()]  # it may well be one
    for pieces in ([b"\0" + stream], chunks(b"\0" + stream, [1] * 400)):
        assert raws(*pieces) == [frame, heartbeat()]


def test_one_unknown_message_in_256_gets_past_with_a_wrong_checksum():
    random = seeded(41)
    frames = [bytearray(unknown(random)) for _ in range(5000)]
    for frame in frames:
        frame[-2:] = random.randbytes(2)
    passed = sum(len(raws(bytes(frame) + heartbeat())) - 1 for frame in frames)
    assert 5 <= passed <= 40


@pytest.mark.parametrize("seed", range(3))
def test_garbage_holds_no_unknown_messages(seed):
    found, _ = parsed([seeded(seed).randbytes(2_000_000)])
    assert [frame for frame in found if not frame.known] == []


def test_frames_in_garbage_are_all_found():
    random = seeded(42)
    frames = list(sequence("MAVLink 2", 42))
    stream = b"".join(random.randbytes(random.randrange(50)) + frame for frame in frames)
    found, parser = parsed([stream])
    assert [frame.raw for frame in found] == frames
    assert parser.skipped == len(stream) - sum(map(len, frames))
