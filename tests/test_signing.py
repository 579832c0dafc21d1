"""Signing: held against pymavlink byte for byte, and against the rules of the MAVLink guide."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from network import FAR, GCS, NEAR, OWN, Network, texts
from pymavlink.dialects.v20 import all as public
from streams import KEY, ROOT, STOCK, codec, made, message, parsed, payloads, seeded
from wire import frame

from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import Frame, encode
from risaf_link.mavlink.peers import Terms
from risaf_link.mavlink.requests import Requests
from risaf_link.mavlink.signing import (
    LATEST,
    MOST_STREAMS,
    RESERVE,
    WINDOW,
    LinkSigning,
    Rejection,
    SigningKey,
    SigningParameters,
    SigningState,
    ticks_at,
)
from risaf_link.mavlink.telemetry import ComponentState, Emitter
from risaf_link.mavlink.tlog import TlogReader

NEW_YEAR_2026_US = 1_767_225_600_000_000
OTHER_KEY = bytes(range(1, 33))
MINUTE = 60 * 100_000


def link(key: SigningKey | None = None, link_id: int = 4, **parameters) -> LinkSigning:
    return LinkSigning(key or SigningKey(KEY), link_id, SigningParameters("key", **parameters))


def signed(ticks: int, stream=(3, 7, 9), key: bytes = KEY) -> Frame:
    """A frame that pymavlink signed at some time."""
    link_id, system, component = stream
    mavlink = public.MAVLink(None, system, component)
    mavlink.signing.secret_key, mavlink.signing.link_id = key, link_id
    mavlink.signing.timestamp, mavlink.signing.sign_outgoing = ticks, True
    raw = bytes(public.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink))
    ((found,), _) = parsed([raw])
    return found


def reader(key: bytes = KEY):
    """A pymavlink codec that takes nothing unsigned."""
    mavlink = public.MAVLink(None)
    mavlink.signing.secret_key = key
    return mavlink


# Bytes


@given(ticks=st.integers(0, LATEST), link_id=st.integers(0, 255))
def test_pymavlink_takes_what_we_sign(ticks, link_id):
    key = SigningKey(KEY, SigningState(ticks))
    emitter = Emitter({}, *OWN, link(key, link_id))
    mavlink = reader()
    for k in range(3):
        raw = emitter.heartbeat(ComponentState.ACTIVE)
        (heard,) = mavlink.parse_buffer(raw)
        assert heard.get_type() == "HEARTBEAT"
        assert (heard.get_signed(), heard.get_link_id()) == (True, link_id)
        assert int.from_bytes(raw[-12:-6], "little") == ticks + k + 1


@pytest.mark.parametrize("name", STOCK)
@given(data=st.data())
def test_we_sign_as_pymavlink_does_and_take_what_it_signs(name, data):
    payload = data.draw(payloads(name))
    theirs = codec(name, signed=True)
    raw = bytes(message(name, payload).pack(theirs))
    ((found,), _) = parsed([raw])
    key = SigningKey(KEY, SigningState((1 << 40) - 1))
    ours = link(key, link_id=3)
    assert encode(found.message_id, payload, 0, 7, 9, ours.sign) == raw
    assert link().accepts(found)


def test_every_frame_of_a_signed_recording_is_taken():
    log = (ROOT / "sitl_fixtures" / "rover_sitl_signed.tlog").read_bytes()
    verifier, taken = link(), 0
    for record in TlogReader([log]):
        verifier.key.advance(record.time_us)
        taken += verifier.accepts(record.frame)
    assert (taken, verifier.rejected) == (38454, {})


def test_none_of_it_is_taken_with_another_key_or_a_second_time():
    log = (ROOT / "sitl_fixtures" / "rover_sitl_signed.tlog").read_bytes()
    frames = [record.frame for record in TlogReader([log])][:2000]
    stranger, verifier = link(SigningKey(OTHER_KEY)), link()
    assert not any(stranger.accepts(each) for each in frames)
    assert stranger.rejected == {"signature": 2000}
    assert all(verifier.accepts(each) for each in frames)
    assert not any(verifier.accepts(each) for each in frames)
    assert verifier.rejected == {"replayed": 2000}


@given(
    name=st.sampled_from(STOCK),
    seed=st.integers(0, 1000),
    at=st.floats(0, 1, exclude_max=True),
    bit=st.integers(0, 7),
)
def test_one_spoiled_bit_is_noticed_and_changes_nothing(name, seed, at, bit):
    ((whole,), _) = parsed([made(name, seeded(seed), signed=True)])
    spoiled = bytearray(whole.raw)
    spoiled[int(at * len(spoiled))] ^= 1 << bit
    raw = bytes(spoiled)
    received = Frame(raw, 2, 0, 7, 9, whole.message_id, whole.payload, raw[-13:])
    verifier = link()
    before = verifier.key.snapshot()
    assert not verifier.accepts(received)
    assert verifier.rejected == {"signature": 1}
    assert verifier.key.snapshot() == before
    assert verifier.accepts(whole)


# Time


def test_time_is_counted_from_2015_in_10_us():
    assert ticks_at(1_420_070_400_000_000) == 0
    assert ticks_at(1_420_070_401_000_000) == 100_000
    assert ticks_at(0) == 0


STREAMS = st.tuples(st.integers(0, 1), st.integers(1, 2), st.just(1))
TIMES = st.integers(5 * MINUTE, 8 * MINUTE)


@given(st.lists(st.tuples(STREAMS, TIMES), max_size=30))
def test_stamps_are_judged_as_pymavlink_judges_them(arrivals):
    verifier, oracle = link(), reader()
    for stream, ticks in arrivals:
        received = signed(ticks, stream)
        expected = oracle.check_signature(bytearray(received.raw), *stream[1:])
        assert verifier.accepts(received) == expected
        assert verifier.key.ticks == oracle.signing.timestamp


@given(st.lists(st.tuples(STREAMS, TIMES, st.sampled_from([KEY, OTHER_KEY])), max_size=30))
def test_a_stream_rises_and_no_clock_goes_back_whatever_comes(arrivals):
    verifier, last = link(), {}
    for stream, ticks, key in arrivals:
        before = verifier.key.ticks
        if verifier.accepts(signed(ticks, stream, key)):
            assert key == KEY
            assert ticks > last.get(stream, -1)
            assert stream in last or ticks + MINUTE >= before
            last[stream] = ticks
        assert verifier.key.ticks == max(before, last.get(stream, 0))


@given(st.lists(st.integers(0, 2 * NEW_YEAR_2026_US), max_size=20), st.lists(st.booleans()))
def test_what_we_send_rises_whatever_the_clock_and_over_restarts(times_us, cuts):
    key, sent, disk = SigningKey(KEY), [], SigningState()
    for i, time_us in enumerate(times_us):
        key.advance(time_us)
        for _ in range(3):
            if key.is_due:
                disk = key.snapshot().state
                key.stored(key.snapshot())
            sent.append(int.from_bytes(key.signature(b"", 0)[1:7], "little"))
        if i < len(cuts):  # the power is cut, or not
            key = SigningKey(KEY, disk if cuts[i] else key.snapshot(is_last=True).state)
    assert all(after > before for before, after in itertools.pairwise(sent))


def test_what_was_taken_before_a_restart_is_not_taken_after_it():
    verifier = link()
    verifier.key.advance(NEW_YEAR_2026_US)
    old = signed(verifier.key.ticks)
    assert verifier.accepts(old)
    again = link(SigningKey(KEY, verifier.key.snapshot(is_last=True).state))
    assert not again.accepts(old)
    assert again.rejected == {"replayed": 1}


def test_a_clock_without_a_battery_is_set_by_what_is_rightly_signed():
    verifier = link()
    verifier.key.advance(0)
    ticks = ticks_at(NEW_YEAR_2026_US)
    verifier.accepts(signed(ticks, key=OTHER_KEY))
    assert verifier.key.ticks == 0
    verifier.accepts(signed(ticks))
    assert verifier.key.ticks == ticks


def test_a_new_stream_may_lag_one_minute():
    for lag, expected in ((WINDOW, {}), (WINDOW + 1, {"late": 1})):
        verifier = link()
        verifier.key.advance(NEW_YEAR_2026_US)
        verifier.accepts(signed(verifier.key.ticks - lag))
        assert verifier.rejected == expected
    assert WINDOW == MINUTE
    assert RESERVE < WINDOW  # or a restart would lock out those who go by their own clocks


def test_a_stamp_that_would_use_up_all_time_is_refused():
    verifier = link()
    assert not verifier.accepts(signed(2**48 - 1))
    assert verifier.rejected == {"future": 1}
    assert verifier.key.ticks == 0


def test_streams_beyond_memory_are_refused_until_old_ones_can_be_forgotten():
    verifier = link()
    streams = [(k, s, 1) for s in (1, 2) for k in range(256)]
    taken = [verifier.accepts(signed(MINUTE, stream)) for stream in streams]
    assert taken == [True] * MOST_STREAMS + [False] * (len(streams) - MOST_STREAMS)
    first = signed(MINUTE, streams[0])
    assert verifier.accepts(signed(3 * MINUTE, streams[1]))
    assert verifier.accepts(signed(3 * MINUTE, streams[-1]))  # the oldest one is forgotten
    assert not verifier.accepts(first)


# What may come unsigned


def test_unsigned_frames_are_refused_but_those_of_radios():
    verifier = link()
    assert verifier.accepts(frame("RADIO_STATUS"))
    assert not verifier.accepts(frame("HEARTBEAT"))
    assert not verifier.accepts(frame("HEARTBEAT", version=1))
    assert not verifier.accepts(frame("SETUP_SIGNING"))
    assert verifier.rejected == {"unsigned": 3}


def test_what_is_named_may_come_unsigned_but_not_wrongly_signed():
    named = link(accept_unsigned=("HEARTBEAT",))
    assert named.accepts(frame("HEARTBEAT"))
    assert not named.accepts(frame("GPS_RAW_INT"))
    assert not named.accepts(signed(1, key=OTHER_KEY))
    everything = link(accept_unsigned=True)
    assert everything.accepts(frame("GPS_RAW_INT"))
    assert not everything.accepts(signed(1, key=OTHER_KEY))


def test_a_link_may_be_verified_without_being_signed():
    raw = Emitter({}, *OWN, link(sign=False)).heartbeat(ComponentState.ACTIVE)
    assert raw == Emitter({}, *OWN).heartbeat(ComponentState.ACTIVE)


# SETUP_SIGNING


def setup(secret: bytes, to=OWN, ticks: int = 5) -> dict:
    system, component = to
    return {
        "target_system": system,
        "target_component": component,
        "secret_key": list(secret),
        "initial_timestamp": ticks,
    }


def network(signing: LinkSigning) -> Network:
    return Network(links={"ground": Terms(signing=signing)})


def test_the_first_key_may_be_set_where_that_is_configured():
    signing = link(SigningKey(), setup=True)
    net = network(signing)
    offered = frame("SETUP_SIGNING", GCS, **setup(KEY, ticks=77))
    assert signing.accepts(offered)
    assert not signing.accepts(frame("HEARTBEAT"))
    assert not signing.accepts(signed(1))
    assert signing.rejected == {"unsigned": 1, "no_key": 1}
    assert Emitter({}, *OWN, signing).heartbeat(ComponentState.BOOT)[2] == 0
    net.component.receive(offered, NEAR, net.now_us)
    assert signing.key.is_due
    assert signing.key.snapshot().secret == KEY
    assert signing.key.ticks == 77
    heard = {
        peer: [m for raw in [r for p, r in frames if p == peer] for m in reader().parse_buffer(raw)]
        for frames in [net.component.collect(net.peers)]
        for peer in (NEAR, FAR)
    }
    assert texts(heard[NEAR]) == texts(heard[FAR]) == ["signing key set"]
    assert not signing.accepts(offered)  # from now on, keys come signed


@pytest.mark.parametrize(
    ("to", "options"),
    [((0, 0), {}), ((OWN[0], 0), {}), ((0, OWN[1]), {}), ((2, 191), {}), (OWN, {"setup": False})],
)
def test_no_key_is_set_that_is_not_for_us_alone_or_not_allowed(to, options):
    signing = link(**({"setup": True, "accept_unsigned": True} | options))
    net = network(signing)
    net.component.receive(frame("SETUP_SIGNING", GCS, **setup(OTHER_KEY, to)), NEAR, net.now_us)
    assert signing.accepts(signed(10))
    assert not signing.key.snapshot().secret


def test_no_key_is_set_in_flight_and_none_that_is_zero():
    signing = link(setup=True, accept_unsigned=True, sign=False)
    net = network(signing)
    assert texts(net.send("SETUP_SIGNING", **setup(bytes(32)))) == [
        "signing key refused: it is all zero"
    ]
    net.send("HEARTBEAT", (OWN[0], 1), type=2, autopilot=3, base_mode=128)
    assert texts(net.send("SETUP_SIGNING", **setup(OTHER_KEY))) == [
        "signing key refused: the vehicle is armed"
    ]
    assert signing.accepts(signed(10))


FUZZED = ["SETUP_SIGNING", "COMMAND_ACK", "TIMESYNC", "HEARTBEAT", "DEBUG_FLOAT_ARRAY"]


@given(st.lists(st.tuples(st.sampled_from(FUZZED), st.binary(max_size=255)), max_size=20))
def test_no_content_is_too_strange(contents):
    signing = link(setup=True, accept_unsigned=True)
    net = Network(links={"ground": Terms(signing=signing)}, requests=Requests({"ground": None}))
    for name, payload in contents:
        raw = encode(IDS[name], payload, 0, OWN[0], 1)
        ((received,), _) = parsed([raw])
        assert signing.accepts(received)
        net.component.receive(received, NEAR, net.now_us)
        net.now_us += 5_000_000
        net.component.advance(net.now_us, net.now_us)
        net.component.collect(net.peers)


def test_the_key_that_is_in_use_set_again_forgets_no_stream():
    signing = link(setup=True, accept_unsigned=True)
    assert signing.accepts(signed(10))
    signing.key.replace(KEY, 0)
    assert not signing.accepts(signed(10))
    signing.key.replace(OTHER_KEY, 0)
    assert signing.rejected == {Rejection.REPLAYED: 1}
    assert not signing.accepts(signed(11))
    assert signing.accepts(signed(11, key=OTHER_KEY))
