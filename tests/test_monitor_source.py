"""Where the page's frames come from, and what goes out of the web server: without a browser."""

import asyncio
import json
from contextlib import asynccontextmanager
from itertools import count

import msgspec
import numpy as np
import pytest
from aiohttp import ClientSession
from aiohttp.test_utils import TestClient, TestServer
from click.testing import CliRunner
from pymavlink.dialects.v20 import all as public
from streams import KEY
from test_monitor import LEVEL, NOW_US, STATUS, taken, told
from wire import SERVICE, frame

from risaf_link.cli import main
from risaf_link.errors import ConfigError, LogError
from risaf_link.links import MemoryLink
from risaf_link.mavlink.dialect import IDS, pack
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.mavlink.signing import LinkSigning, SigningKey, SigningParameters
from risaf_link.mavlink.tlog import TlogReader, record
from risaf_link.monitor import server
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
        name, player, now_us, vehicles, rejected = "link", None, NOW_US, Vehicles(), {}

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


async def test_a_page_with_a_key_signs_what_it_asks_and_shows_only_what_is_signed_with_it():
    key, other, unknown = SigningKey(KEY), SigningKey(bytes(range(1, 33))), (7, 191)
    signing = LinkSigning(SigningKey(KEY), 0, SigningParameters("key"))
    here, there = MemoryLink("page", "signed"), MemoryLink("service", "signed")
    live = Live("memory://signed", here, count(NOW_US, 100_000).__next__, signing)
    codec = public.MAVLink(None)
    codec.signing.secret_key, asked = KEY, []

    def status(who, sign) -> bytes:
        return encode(*pack("GPS_HEADING_STATUS", time_usec=0, **STATUS), 0, *who, sign)

    def hear(data: bytes, _: str) -> None:
        asked.extend(codec.parse_buffer(data) or [])  # raises where a signature is wrong
        for one in (key, other):
            one.advance(NOW_US + 60_000_000)  # a vehicle whose clock is ahead
        there.send(status(SERVICE, lambda content: key.signature(content, 3)))
        there.send(status(unknown, lambda content: other.signature(content, 3)))
        there.send(status(unknown, None))

    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(there.run(hear)), tasks.create_task(live.run())]
        async with asyncio.timeout(SAFETY_S):
            while "COMMAND_LONG" not in [message.get_type() for message in asked]:
                await asyncio.sleep(0)
        for task in running:
            task.cancel()
    assert all(message.get_signed() for message in asked)
    assert list(live.vehicles.estimators) == [SERVICE]
    update = View(live).update()
    assert update.rejected.keys() == {"signature", "unsigned"}


def test_a_log_and_a_key_do_not_go_together(tmp_path):
    path = tmp_path / "signing.key"
    path.write_bytes(KEY)
    told = CliRunner().invoke(main, ["monitor", "drive.tlog", "--key", str(path)])
    assert (told.exit_code, told.stderr.count("\n")) == (2, 1)
    path.chmod(0o644)
    told = CliRunner().invoke(main, ["monitor", "udpin://127.0.0.1:0", "--key", str(path)])
    assert told.exit_code == 2
    assert f"--key: {path}: found signing.key with mode 0644" in told.stderr


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
        for damage in (b"", b'{"\xff": 1}', b"[" * 4000):
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


@pytest.mark.parametrize(
    ("listening", "asked", "status"),
    [
        ("127.0.0.1", "evil.example", 403),
        ("127.0.0.1", "evil.example:8765", 403),
        ("127.0.0.1", "evil.local", 403),
        ("127.0.0.1", "127.0.0.1.evil.example", 403),
        ("127.0.0.1", "localhost:8765", 200),
        ("127.0.0.1", "[::1]:8765", 200),
        ("0.0.0.0", "evil.example:8765", 403),  # noqa: S104
        ("0.0.0.0", "10.0.0.7:8765", 200),  # noqa: S104
        ("0.0.0.0", "boat.local", 200),  # noqa: S104
        ("boat.fleet.example", "boat.fleet.example:8765", 200),
        ("boat.fleet.example", "[evil]:x", 403),
    ],
)
async def test_a_name_that_another_site_can_give_us_is_refused(recording, listening, asked, status):
    async with browsing(Log("drive.tlog", Player(recording)), listening) as client:
        for path in ("/", "/page/page.js", "/updates"):
            response = await client.get(path, headers={"Host": asked})
            assert response.status == status
            response.close()


async def test_another_sites_page_may_neither_read_nor_say_anything(recording):
    player = Player(recording)
    other = {"Origin": "https://evil.example"}
    async with browsing(Log("drive.tlog", player)) as client:
        asking = {**other, "Access-Control-Request-Method": "POST"}
        asking["Access-Control-Request-Headers"] = "content-type"
        for answer in (
            await client.options("/play", headers=asking),
            await client.get("/updates", headers=other),
        ):
            assert not [name for name in answer.headers if name.startswith("Access-Control")]
            answer.close()
        assert (await client.options("/play", headers=asking)).status == 405


async def test_so_many_pages_are_open_and_no_more(recording, monkeypatch):
    monkeypatch.setattr(server, "MOST_PAGES", 2)
    async with browsing(Log("drive.tlog", Player(recording))) as client:
        streams = [await client.get("/updates") for _ in range(2)]
        assert (await client.get("/updates")).status == 503
        streams[0].close()
        async with asyncio.timeout(SAFETY_S):
            while (again := await client.get("/updates")).status == 503:
                await asyncio.sleep(0.01)
        again.close()
        streams[1].close()


async def test_a_wish_is_short(recording):
    async with browsing(Log("drive.tlog", Player(recording))) as client:
        wish = {"speed": 1, "is_paused": True, "seek_us": 1}
        long = json.dumps(wish) + " " * server.LARGEST_WISH
        headers = {"Content-Type": "application/json"}
        assert (await client.post("/play", data=long, headers=headers)).status == 413


async def test_a_page_on_ipv6_tells_a_url_that_a_browser_takes(recording):
    urls: asyncio.Queue[str] = asyncio.Queue()
    source = Log("drive.tlog", Player(recording))
    serving = asyncio.create_task(serve(source, "::1", 0, urls.put_nowait))
    async with ClientSession() as session, session.get(await urls.get()) as page:
        assert page.status == 200
    serving.cancel()
    await asyncio.wait([serving])


async def test_a_port_that_is_taken_is_said_in_one_line(recording):
    source = Log("drive.tlog", Player(recording))
    urls: asyncio.Queue[str] = asyncio.Queue()
    serving = asyncio.create_task(serve(source, "127.0.0.1", 0, urls.put_nowait))
    port = int((await urls.get()).rpartition(":")[2])
    with pytest.raises(ConfigError, match=rf"--listen 127.0.0.1:{port}: .*in use"):
        await serve(source, "127.0.0.1", port, urls.put_nowait)
    serving.cancel()
    await asyncio.wait([serving])
