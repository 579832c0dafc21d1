"""Target: what browsers and Prometheus ask, and what vehicles tell the page."""

from functools import cache
from itertools import groupby
from types import SimpleNamespace
from typing import Any

import numpy as np
from aiohttp import web
from fuzz_checks import (
    check_update,
    done,
    drive,
)
from fuzz_script import PEERS, START_US, STATUSES, messages

from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.tlog import record
from risaf_link.monitor import server
from risaf_link.monitor.recording import Player, Recording
from risaf_link.monitor.source import Log as PlayedLog
from risaf_link.monitor.vehicles import Vehicles
from risaf_link.monitor.view import View
from risaf_link.publish import scrape


def page(data: bytes) -> None:
    """Whatever vehicles send and browsers ask, what the page is sent is JSON of bounded size."""
    size = data[0] if data else 0
    asked, data = data[1 : 1 + size], data[1 + size :]
    live = LiveLink()
    view = View(live, _wanted(asked))
    parsers = {peer: FrameParser() for peer in PEERS}
    sent = messages(data, [*STATUSES, "HEARTBEAT", "TIMESYNC", "GYRO_ARRAY"])
    for (peer, _), group in groupby(sent, lambda each: (each.peer, each.sequence // 8)):
        together = list(group)
        table = parsers[peer].receive_table(b"".join(each.raw for each in together))
        live.now_us = max(live.now_us, together[-1].received_us)
        live.vehicles.take(table, np.full(len(table), live.now_us, np.uint64), peer[1])
        check_update(view)
    check_update(view)
    check_update(View(live))
    _check_play(asked)
    _check_metrics(asked)


class LiveLink:
    """What the page shows of a link."""

    name, player = "a link", None

    def __init__(self) -> None:
        self.vehicles, self.now_us = Vehicles(), START_US
        self.rejected: dict[str, int] = {}

    async def run(self) -> None:
        """Nothing comes but what is given."""


def _wanted(asked: bytes) -> tuple[int, int] | None:
    return server._wanted(_asked({"of": asked.decode(errors="replace")}, b""))


def _asked(query: dict[str, str], body: bytes) -> Any:
    async def read() -> bytes:
        return body

    return SimpleNamespace(query=query, read=read, content_type="application/json")


def _check_play(body: bytes) -> None:
    player = Player(_recording())
    pages = server.Pages(PlayedLog("a log", player), "127.0.0.1")
    try:
        response = done(pages.play(_asked({}, body)))
    except web.HTTPException as refusal:
        response = refusal
    assert response.status in {204, 400}
    assert 0.1 <= player.speed <= 100.0
    player.advance(0.1)
    check_update(View(PlayedLog("a log", player)))


@cache
def _recording() -> Recording:
    return Recording([b"".join(record(sent.received_us, sent.raw) for sent in drive())])


def _check_metrics(head: bytes) -> None:
    async def make() -> bytes:
        return b"counters"

    answer = done(scrape.Page("127.0.0.1", 0, make, "text/plain")._response(head))
    assert answer.split(b" ")[1] in {b"200", b"403", b"404", b"405", b"429"}
