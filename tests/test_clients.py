"""The service as its users meet it: real clients, processes of their own, over real sockets."""

import asyncio
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from random import Random

import numpy as np
import pytest
import yaml
from ports import free_port
from streams import parsed
from wire import frame

from risaf_link.config import Config
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.parameters import parameters_of

CLIENTS = Path(__file__).parent / "clients"
DEADLINE_S = 90
SYSTEM = 3
RISAF = [sys.executable, "-c", "from risaf_link.cli import main; main()"]
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
KEY = bytes(range(32))
either_link = pytest.mark.parametrize("is_bad", [False, True], ids=["good link", "bad link"])
needs_node = pytest.mark.skipif(
    "CI" not in os.environ and not (shutil.which("node") and (CLIENTS / "node_modules").is_dir()),
    reason="no node-mavlink: apt-get install nodejs npm; npm ci --prefix tests/clients",
)
UNSIGNED_SET = bytes(
    frame(
        "PARAM_SET",
        (255, 190),
        target_system=SYSTEM,
        target_component=191,
        param_id=b"FUS_GATE",
        param_value=9.0,
        param_type=9,
    ).raw
)


class Running:
    """The service and a simulated vehicle that feeds it, as processes of their own."""

    def __init__(self, directory: Path, **ground: object) -> None:
        array, self.port = free_port(), free_port()
        self.config = directory / "vehicle.yaml"
        links = [
            {"name": "array", "url": f"udpin://127.0.0.1:{array}", "emit": {}},
            {"name": "ground", "url": f"udpin://127.0.0.1:{self.port}", **ground},
        ]
        self.config.write_text(yaml.safe_dump({"links": links, "mavlink": {"system_id": SYSTEM}}))
        self.written = self.config.read_text()
        self.log = (directory / "log").open("w+")
        url = f"udpout://127.0.0.1:{array}"
        vehicle = ["simulate", "circle", "--seed", "1", "--sensors", "10", "--live", url]
        self._processes = [
            subprocess.Popen([*RISAF, *args], stderr=said, stdout=subprocess.DEVNULL)
            for args, said in (
                (["run", "--config", str(self.config)], self.log),
                (vehicle, subprocess.DEVNULL),
            )
        ]

    def said_so_far(self) -> str:
        return Path(self.log.name).read_text()

    def end(self) -> list[int]:
        """End both; exit statuses, that of the service first."""
        if self.log.closed:
            return self._status
        for process in self._processes:
            process.terminate()
        self._status = [process.wait(DEADLINE_S) for process in self._processes]
        self.log.seek(0)
        self.said = self.log.read()
        self.log.close()
        return self._status


@pytest.fixture
def service(tmp_path) -> Iterator[Running]:
    running = Running(tmp_path)
    yield running
    service, _ = running.end()
    assert (service, running.said) == (0, "")


class BadLink(asyncio.DatagramProtocol):
    """A relay that loses one datagram in ten, doubles some and lets some overtake others."""

    def __init__(self, to: tuple[str, int], seed: int) -> None:
        self._to, self._random = to, Random(seed)  # noqa: S311
        self._client: tuple[str, int] | None = None
        self._kept: dict[tuple[str, int], bytes] = {}
        self.lost = self.doubled = self.overtaken = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.port: int = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, address: tuple[str, int]) -> None:
        if address != self._to:
            self._client = address
        to = self._to if address != self._to else self._client
        chance = self._random.random()
        if to is None or chance < 0.1:
            self.lost += 1
        elif chance < 0.2:
            self._kept[to] = data
        else:
            times = 2 if chance < 0.3 else 1
            self.doubled += times - 1
            for _ in range(times):
                self.transport.sendto(data, to)
            if to in self._kept:
                self.overtaken += 1
                self.transport.sendto(self._kept.pop(to), to)


async def client(name: str, *arguments: object) -> dict:
    process = await asyncio.create_subprocess_exec(
        "node" if name.endswith(".js") else sys.executable,
        str(CLIENTS / name),
        *map(str, arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    async with asyncio.timeout(DEADLINE_S):
        out, err = await process.communicate()
    assert process.returncode == 0, err.decode()
    return json.loads(out)


def assert_served(found: dict, rate: float) -> None:
    """What a ground station must have found, whatever its link does."""
    heartbeat = found["heartbeat"]
    assert (heartbeat["type"], heartbeat["autopilot"]) == (18, 8)
    assert set(found["parameters"]) == {parameter.name for parameter in parameters_of(Config)}
    assert (found["set"], found["refused"]) == (4.5, 4.5)
    assert found["interval"][-1] == ACCEPTED
    assert found["told_interval"] == round(1e6 / rate)
    assert (found["no_message"], found["no_command"]) == ([DENIED], [UNSUPPORTED])
    assert found["stored"][-1] == ACCEPTED


async def test_two_ground_stations_at_once_each_with_its_own_rates(service):
    url = f"udpout:127.0.0.1:{service.port}"
    slow, fast = await asyncio.gather(
        client("ground_station.py", url, 5), client("ground_station.py", url, 20)
    )
    assert_served(slow, 5)
    assert_served(fast, 20)
    assert set(slow["periods_ms"]) == {200}
    assert set(fast["periods_ms"]) == {50}
    kept = service.config.with_suffix(".parameters.yaml")
    assert yaml.safe_load(kept.read_text()) == {"HDG_GATE": 4.5}
    assert service.config.read_text() == service.written


@asynccontextmanager
async def bad_link(service: Running) -> AsyncIterator[BadLink]:
    transport, link = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: BadLink(("127.0.0.1", service.port), seed=5), local_addr=("127.0.0.1", 0)
    )
    yield link
    transport.close()
    assert min(link.lost, link.doubled, link.overtaken) > 5


@asynccontextmanager
async def link_to(service: Running, is_bad: bool) -> AsyncIterator[int]:
    """Port behind which the service is."""
    if not is_bad:
        yield service.port
        return
    async with bad_link(service) as link:
        yield link.port


async def test_a_ground_station_on_a_bad_link(service):
    async with bad_link(service) as link:
        found = await client("ground_station.py", f"udpout:127.0.0.1:{link.port}", 10)
    assert_served(found, 10)


@pytest.fixture
def signed_service(tmp_path) -> Iterator[Running]:
    key = tmp_path / "signing.key"
    key.touch(0o600)
    key.write_text(f"{KEY.hex()}\n")
    running = Running(tmp_path, signing={"key": str(key)})
    yield running
    service, _ = running.end()
    assert service == 0
    assert KEY.hex() not in running.said


async def test_a_ground_station_that_signs_and_one_that_does_not(signed_service):
    port = signed_service.port
    found = await client("ground_station.py", f"udpout:127.0.0.1:{port}", 10, KEY.hex())
    assert_served(found, 10)
    assert found["signed"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(UNSIGNED_SET, ("127.0.0.1", port))
        async with asyncio.timeout(DEADLINE_S):
            while "signatures: ground: unsigned 1" not in signed_service.said_so_far():
                await asyncio.sleep(0.05)
        stranger.setblocking(False)
        heard = parsed(everything(stranger))[0]
    assert IDS["PARAM_VALUE"] not in {each.message_id for each in heard}


def everything(received: socket.socket) -> Iterator[bytes]:
    """What a socket has received so far."""
    with suppress(BlockingIOError):
        while True:
            yield received.recv(2048)


async def test_a_ground_station_that_signs_on_a_bad_link(signed_service):
    async with bad_link(signed_service) as link:
        found = await client("ground_station.py", f"udpout:127.0.0.1:{link.port}", 10, KEY.hex())
    assert_served(found, 10)
    assert found["signed"]


@either_link
async def test_an_autopilot_is_asked_for_what_is_missing_and_for_its_time(service, is_bad):
    async with link_to(service, is_bad) as port:
        found = await client("autopilot.py", f"udpout:127.0.0.1:{port}", 2)
    assert found["asked"] == {str(IDS["GPS_RAW_INT"]): 200_000, str(IDS["SYSTEM_TIME"]): 1_000_000}
    assert abs(found["offsets_s"][-1]) < 0.05  # our stamps are on the autopilot's clock by then


@pytest.mark.skipif(not find_spec("mavsdk"), reason="mavsdk is not installed")
@either_link
async def test_mavsdk_takes_us_for_a_component_and_tunes_it(service, is_bad):
    async with link_to(service, is_bad) as port:
        found = await client("mavsdk_client.py", port, SYSTEM)
    assert found["components"] == [191]
    assert not found["has_autopilot"]
    assert (found["read"], found["set"], found["read_again"]) == (4.0, 1, 5.5)  # 1: SUCCESS
    assert (found["unknown"], found["refused"]) == ("DOES_NOT_EXIST", "VALUE_OUT_OF_RANGE")
    assert found["all"] == sorted(parameter.name for parameter in parameters_of(Config))
    results = [found[name] for name in ("accepted", "denied", "unsupported")]
    assert results == [ACCEPTED, DENIED, UNSUPPORTED]
    attitude = found["attitude"]
    assert sum(attitude[f"q{i}"] ** 2 for i in range(1, 5)) == pytest.approx(1.0, abs=1e-6)


def assert_decoded(found: dict) -> None:
    """What another codec must have made of our frames."""
    counts = found["counts"]
    assert counts["frames"] > 50
    assert (counts["checksums"], counts["signatures"]) == (0, 0)
    assert counts["spoiled"] == 1  # it does look
    one, other = found["attitude"], found["attitude_cov"]
    assert np.linalg.norm([one, other], axis=1) == pytest.approx([1.0, 1.0], abs=1e-6)
    assert abs(np.dot(one, other)) > 0.9  # within a turn of some seconds
    covariance = np.reshape(found["covariance"], (3, 3))
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert covariance.tolist() == covariance.T.tolist()


@needs_node
@either_link
async def test_another_codec_understands_us_and_is_understood(service, is_bad):
    async with link_to(service, is_bad) as port:
        found = await client("node_client.js", port, 20)
    assert_served(found, 20)
    assert_decoded(found)
    assert is_bad or set(found["periods_ms"]) == {50}


@needs_node
@either_link
async def test_another_codec_signs_and_finds_our_signatures_right(signed_service, is_bad):
    async with link_to(signed_service, is_bad) as port:
        found = await client("node_client.js", port, 20, KEY.hex())
    assert_served(found, 20)
    assert_decoded(found)
