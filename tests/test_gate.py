"""What is taken from a peer, and whether it shows that the peer belongs here."""

import contextlib
import logging
import random
import socket

import pytest
from daemon import (
    EPOCHS,
    Running,
    address_of,
    bursts,
    config_for,
    feed,
    until,
)
from network import FAR, GCS, NEAR
from streams import KEY, seeded, unknown
from test_signing import link, signed
from wire import AUTOPILOT, frame

from risaf_link.gate import ORDERS_A_SECOND, ORDERS_AT_ONCE, Gate
from risaf_link.keys import Keys
from risaf_link.links import Worth, udp
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import Frame, FrameParser, FrameTable
from risaf_link.mavlink.signing import LinkSigning, SigningKey
from risaf_link.service import MOST_PEERS as MOST_PARSERS

OWN = (1, 191)
NOW_US = 1_800_000_000_000_000
MANY = 300


def gate(signing: LinkSigning | None = None) -> Gate:
    return Gate(Keys([], {NEAR[0]: signing} if signing else {}), lambda: OWN)


def table(*frames: Frame) -> FrameTable:
    return FrameParser().receive_table(b"".join(one.raw for one in frames))


def order(name: str, to: tuple[int, int] = OWN) -> Frame:
    fields = {"target_system": to[0], "target_component": to[1]}
    return frame(name, GCS, **fields)


ORDERS = ["PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "COMMAND_LONG", "COMMAND_INT"]


@pytest.mark.parametrize("name", [*ORDERS, "SETUP_SIGNING"])
@pytest.mark.parametrize("to", [OWN, (0, 0), (1, 0)])
def test_a_peer_gives_so_many_orders_at_once_and_a_second(name, to):
    orders = table(*[order(name, to)] * MANY)
    one = gate()
    assert len(one.admitted(orders, NEAR, NOW_US)) == ORDERS_AT_ONCE
    assert one.refused == {"too_many_orders": MANY - ORDERS_AT_ONCE}
    assert len(one.admitted(orders, NEAR, NOW_US + 1_000_000)) == ORDERS_A_SECOND
    assert len(one.admitted(orders, FAR, NOW_US + 1_000_000)) == ORDERS_AT_ONCE


def test_what_is_no_order_to_us_is_not_limited():
    others = [frame("HEARTBEAT", GCS), frame("TIMESYNC", GCS), order("PARAM_SET", AUTOPILOT)]
    one = gate()
    assert len(one.admitted(table(*others * MANY), NEAR, NOW_US)) == len(others) * MANY
    assert not one.refused


def test_the_frames_beside_an_order_too_many_are_taken():
    mixed = table(*[order("PARAM_SET"), frame("GPS_RAW_INT")] * MANY)
    ids = gate().admitted(mixed, NEAR, NOW_US).cuts["message_id"].tolist()
    assert ids.count(IDS["GPS_RAW_INT"]) == MANY
    assert ids.count(IDS["PARAM_SET"]) == ORDERS_AT_ONCE


@pytest.mark.parametrize(
    ("shown", "signing", "expected"),
    [
        (frame("HEARTBEAT"), {}, Worth.FRAMES),
        (frame("RADIO_STATUS"), {"accept_unsigned": ()}, Worth.NOTHING),
        (frame("HEARTBEAT"), {"accept_unsigned": ("HEARTBEAT",)}, Worth.NOTHING),
        (frame("HEARTBEAT"), {"accept_unsigned": True}, Worth.FRAMES),
        (signed(2), {"accept_unsigned": ()}, Worth.FRAMES),
    ],
)
def test_on_a_signed_link_a_signature_shows_who_belongs_here(shown, signing, expected):
    one = gate(link(SigningKey(KEY), **signing) if signing else None)
    taken = one.admitted(table(shown), NEAR, NOW_US)
    assert len(taken) == 1
    assert one.worth(taken, NEAR[0]) is expected


def test_a_frame_whose_checksum_cannot_be_verified_shows_nothing():
    known = frame("HEARTBEAT").raw
    cut = FrameParser().receive_table(known + unknown(seeded(4)) + known)
    assert cut.cuts["known"].tolist() == [True, False, True]
    assert gate().worth(FrameTable(cut.buffer, cut.cuts[1:2]), NEAR[0]) is Worth.NOTHING


async def test_a_stranger_is_answered_once_it_sends_a_frame(ground):
    config = config_for(ground, "{name: open, url: 'udpin://127.0.0.1:0'}")
    async with Running(config, up=3) as service:
        port = int(service.links[2].address.rpartition(":")[2])
        ground.transport.sendto(b"garbage", ("127.0.0.1", port))
        await until(lambda: service.links[2].counts.bytes_in == 7)
        assert not service.links[2].peers
        ground.transport.sendto(frame("HEARTBEAT").raw, ("127.0.0.1", port))
        await until(lambda: service.links[2].peers)


async def test_strangers_who_flood_the_arrays_port_cost_no_epoch_and_little_memory(
    ground,
    caplog,
):
    caplog.set_level(logging.INFO, "risaf_link.links")
    chance = random.Random(1)  # noqa: S311
    flood = [chance.randbytes(size) for size in range(1, 280)]
    flood += [frame("HEARTBEAT", (system, 190)).raw for system in range(2, 250)]
    flood += [order(name).raw for name in ORDERS for _ in range(50)]
    chance.shuffle(flood)
    with contextlib.ExitStack() as stack:
        strangers = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            for _ in range(100)
        ]
        async with Running(config_for(ground), up=2) as service:
            heard = []
            for number, burst in enumerate(bursts()):
                for stranger in strangers if number > 2 else ():  # the array is there
                    stranger.sendto(chance.choice(flood), address_of(service))
                heard += await feed(ground, service, [burst])
            array = service.links[0]
            assert len(heard) == EPOCHS
            assert service.account().assembly["samples_lost"] == 0
            assert array.counts.dropped_in > 50 * EPOCHS
            assert len(array.peers) <= udp.MOST_PEERS // 2
            assert len(service._parsers) <= MOST_PARSERS
    told = [line for line in caplog.messages if line.startswith("array: ")]
    assert len(told) < 40
