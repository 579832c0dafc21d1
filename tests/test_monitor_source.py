"""Where the page's frames come from, and what goes out of the web server: without a browser."""

import asyncio
import json
from contextlib import asynccontextmanager
from itertools import count

import msgspec
import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer
from test_monitor import LEVEL, NOW_US, STATUS, taken, told
from wire import SERVICE, frame

from risaf_link.errors import ConfigError, LogError
from risaf_link.links import MemoryLink
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.monitor.recording import FASTEST, Player, Recording, open_recording
from risaf_link.monitor.server import application, serve
from risaf_link.monitor.source import Live, Log
from risaf_link.monitor.vehicles import Vehicles
from risaf_link.monitor.view import View

SECONDS = 1200
SAFETY_S = 20


def log_of(seconds: int = SECONDS) -> bytes:
    """A log with a heading, an attitude and a foreign message each second, and some texts."""
    records = []
    for i in range(seconds):
        at_us = NOW_US + i * 1_000_000
        status = {**STATUS, "yaw": i / 1000, "fused_count": i}
        records.append(record(at_us, frame("GPS_HEADING_STATUS", SERVICE, **status).raw))
        records.append(record(at_us + 4, frame("ATTITUDE_QUATERNION", SERVICE, **LEVEL).raw))
        records.append(record(at_us + 8, frame("RAW_IMU", xgyro=i).raw))
        if i % 60 == 0:
            text = frame("STATUSTEXT", SERVICE, text=f"minute {i // 60}".encode()).raw
            records.append(record(at_us + 12, text))
    return b"".join(records)


@pytest.fixture(scope="module")
def recording():
    return Recording([log_of()])


def known(vehicles: Vehicles) -> list:
    """All that the page would be told, but for rates and losses."""
    told = []
    for who, estimator in sorted(vehicles.estimators.items()):
        told += [who, estimator.heading, estimator.attitude, list(estimator.rows)]
    return [*told, vehicles.pulses, [event.text for event in vehicles.events]]


def test_a_recording_has_all_frames_at_their_times():
    log = log_of(30)
    records = list(TlogReader([log]))
    cut = Recording([log[i : i + 1000] for i in range(0, len(log), 1000)])
    assert cut.times_us.tolist() == [found.time_us for found in records]
    whole, one_by_one = Vehicles(), Vehicles()
    cut.feed(whole, 0, len(cut))
    for found in records:
        taken(one_by_one, found.frame.raw, time_us=found.time_us)
    assert known(whole) == known(one_by_one)
    (account, other) = (v.traffic.accounts["", *SERVICE] for v in (whole, one_by_one))
    now_us = NOW_US + 30_000_000
    assert account.rates(now_us) == other.rates(now_us)


def test_time_never_goes_back_where_the_clock_was_set():
    pieces = [record(NOW_US + i * 1_000_000, frame("RAW_IMU").raw) for i in range(20)]
    earlier = NOW_US - 3_600_000_000
    pieces += [record(earlier + i * 1_000_000, frame("RAW_IMU").raw) for i in range(20)]
    times = Recording([b"".join(pieces)]).times_us.astype(np.int64)
    assert times[0] == NOW_US
    assert set(np.diff(times).tolist()) == {0, 1_000_000}
    assert times[-1] == NOW_US + 38_000_000


def test_a_log_without_frames_is_refused(tmp_path):
    path = tmp_path / "empty.tlog"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(LogError, match=r"empty\.tlog: found no MAVLink frame"):
        open_recording(path)
    with pytest.raises(LogError, match="No such file"):
        open_recording(tmp_path / "missing.tlog")


@pytest.mark.parametrize("at_s", [0, 3, 599, 601, 1000, SECONDS])
def test_after_a_jump_it_knows_what_it_would_know_had_it_played(recording, at_s):
    jumped, played = Player(recording), Player(recording)
    jumped.seek(NOW_US + at_s * 1_000_000)
    for _ in range(at_s):
        played.advance(1.0)
    assert jumped.now_us == played.now_us
    (at,) = jumped.vehicles.estimators.values()
    (was,) = played.vehicles.estimators.values()
    assert at.heading == was.heading
    since_us = jumped.now_us - 590_000_000
    assert [r for r in at.rows if r.time_us > since_us] == [
        r for r in was.rows if r.time_us > since_us
    ]


def test_it_plays_pauses_and_goes_faster(recording):
    player = Player(recording)
    begin_us = player.now_us
    player.advance(2.0)
    assert player.now_us == begin_us + 2_000_000
    player.set_speed(10)
    player.advance(2.0)
    assert player.now_us == begin_us + 22_000_000
    player.is_paused = True
    player.advance(2.0)
    assert player.now_us == begin_us + 22_000_000
    player.is_paused = False
    player.set_speed(1e9)
    assert player.speed == FASTEST
    player.advance(1000.0)
    assert player.is_paused
    assert player.now_us == player.playback.end_us
    player.seek(0)
    assert player.now_us == begin_us


def test_a_page_is_sent_what_it_does_not_have_yet(recording):
    player = Player(recording)
    player.seek(NOW_US + 100_000_000)
    view = View(Log("drive.tlog", player))
    first = view.update()
    assert first.is_new
    assert (first.chosen, first.source) == (SERVICE, "drive.tlog")
    assert len(first.rows) == 100
    assert [event.text for event in first.events] == ["minute 0", "minute 1"]
    assert not view.update().is_new
    assert not view.update().rows
    player.advance(30.0)
    assert len(view.update().rows) == 30
    player.seek(NOW_US + 50_000_000)
    again = view.update()
    assert again.is_new
    assert len(again.rows) == 50


def test_what_is_not_known_is_null_for_the_page():
    class Still:
        name, player, now_us, vehicles = "link", None, NOW_US, Vehicles()

    told(Still.vehicles, "GPS_HEADING_STATUS", **{**STATUS, "yaw": float("nan")})
    sent = json.loads(msgspec.json.encode(View(Still()).update()))
    assert sent["known"]["heading"]["yaw"] is None
    assert sent["known"]["attitude"] is None
    assert sent["known"]["bias"] == [None] * 3
    assert sent["playback"] is None


async def test_a_live_page_asks_and_listens():
    here, there = MemoryLink("page", "monitor"), MemoryLink("service", "monitor")
    live = Live("memory://monitor", here, count(NOW_US, 100_000).__next__)
    asked = asyncio.Event()
    parser = FrameParser()

    def hear(data: bytes, _: str) -> None:
        if any(f.message_id == IDS["COMMAND_LONG"] for f in parser.receive_data(data)):
            asked.set()
        there.send(frame("GPS_HEADING_STATUS", SERVICE, **STATUS).raw)

    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(there.run(hear)), tasks.create_task(live.run())]
        async with asyncio.timeout(SAFETY_S):
            await asked.wait()
        for task in running:
            task.cancel()
    assert live.vehicles.estimators[SERVICE].heading is not None


@asynccontextmanager
async def browsing(source, host="127.0.0.1"):
    async with TestClient(TestServer(application(source, host))) as client:
        yield client


async def next_update(response) -> dict:
    line = await response.content.readuntil(b"\n\n")
    return json.loads(line.removeprefix(b"data: "))


async def test_the_stream_brings_updates(recording):
    player = Player(recording)
    player.seek(NOW_US + 100_000_000)
    async with browsing(Log("drive.tlog", player)) as client:
        response = await client.get("/updates?of=1:191")
        assert response.headers["Content-Type"] == "text/event-stream"
        first, second = await next_update(response), await next_update(response)
        assert (len(first["rows"]), len(second["rows"])) == (100, 0)
        response.close()
        response = await client.get("/updates?of=9:9")
        assert (await next_update(response))["known"] is None
        response.close()


@pytest.mark.parametrize(
    "wish", ["", "1", "1:", "1:191:1", "-1:191", "\u0661:191", "9" * 5000 + ":1"]
)
async def test_a_component_that_is_none_is_not_asked_for(recording, wish):
    player = Player(recording)
    player.seek(NOW_US + 100_000_000)
    async with browsing(Log("drive.tlog", player)) as client:
        response = await client.get("/updates", params={"of": wish})
        assert (await next_update(response))["chosen"] == [1, 191]


async def test_a_page_tells_how_a_log_is_played(recording):
    player = Player(recording)
    async with browsing(Log("drive.tlog", player)) as client:
        wish = {"seek_us": NOW_US + 60_000_000, "speed": 5, "is_paused": True}
        assert (await client.post("/play", json=wish)).status == 204
        assert player.playback.speed == 5
        assert player.playback.is_paused
        assert player.now_us == NOW_US + 60_000_000
        for wrong in ({"seek": 3}, {"speed": "fast"}, [], {"seek_us": "now"}):
            assert (await client.post("/play", json=wrong)).status == 400
        for damage in (b"", b'{"\xff": 1}', b"[" * 10_000):
            answer = await client.post(
                "/play", data=damage, headers={"Content-Type": "application/json"}
            )
            assert answer.status == 400
        text = json.dumps({"is_paused": False})  # what another site's form can send
        assert (await client.post("/play", data=text)).status == 415
        assert player.is_paused


async def test_nothing_can_be_done_to_what_is_live():
    live = Live("memory://nobody", MemoryLink("page", "nobody"), lambda: NOW_US)
    async with browsing(live) as client:
        assert (await client.post("/play", json={"is_paused": True})).status == 409
        assert (await client.get("/")).status == 200


async def test_another_name_for_this_machine_is_refused(recording):
    async with browsing(Log("drive.tlog", Player(recording))) as client:
        assert (await client.get("/", headers={"Host": "evil.example"})).status == 403
        assert (await client.get("/", headers={"Host": "localhost:8765"})).status == 200
    async with browsing(Log("drive.tlog", Player(recording)), host="10.0.0.7") as client:
        assert (await client.get("/", headers={"Host": "boat.local"})).status == 200


async def test_a_port_that_is_taken_is_said_in_one_line(recording):
    source = Log("drive.tlog", Player(recording))
    urls: asyncio.Queue[str] = asyncio.Queue()
    serving = asyncio.create_task(serve(source, "127.0.0.1", 0, urls.put_nowait))
    port = int((await urls.get()).rpartition(":")[2])
    with pytest.raises(ConfigError, match=rf"--listen 127.0.0.1:{port}: .*in use"):
        await serve(source, "127.0.0.1", port, urls.put_nowait)
    serving.cancel()
    await asyncio.wait([serving])
