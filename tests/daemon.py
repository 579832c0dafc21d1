"""The daemon on a real socket, and what feeds it and listens to it."""

import asyncio
import io
from itertools import groupby
from pathlib import Path

from risaf_link.config import Config, load
from risaf_link.links import UdpInLink
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import Frame, FrameParser
from risaf_link.mavlink.peers import EMITTED
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.replay import OutputLog, Replay, Selection
from risaf_link.service import Service
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames

SAFETY_S = 20
EPOCHS = 60


def bursts(epochs: int = EPOCHS, sensors: int = 60) -> list[list[bytes]]:
    """Frames of a simulated vehicle, grouped by the time at which they are sent."""
    stream = frames(scenario("circle", seed=7, duration=epochs / 100, sensors=sensors))
    return [[raw for _, raw in group] for _, group in groupby(stream, key=lambda sent: sent[0])]


def is_epoch(burst: list[bytes]) -> bool:
    return any(raw[7:10] == IDS["GYRO_ARRAY"].to_bytes(3, "little") for raw in burst)


class Ground(asyncio.DatagramProtocol):
    """A UDP socket that sends samples to the service and listens to what it says."""

    def __init__(self) -> None:
        self._parser = FrameParser()
        self._queue: asyncio.Queue[Frame] = asyncio.Queue()
        self.heard: list[Frame] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.port: int = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, _addr: object) -> None:
        for frame in self._parser.receive_data(data):
            self.heard.append(frame)
            self._queue.put_nowait(frame)

    async def next(self, name: str) -> Frame:
        async with asyncio.timeout(SAFETY_S):
            while True:
                frame = await self._queue.get()
                if frame.message_id == IDS[name]:
                    return frame


class Running:
    """A service that runs while the block is entered; links that must be up are waited for."""

    def __init__(self, config: Config, up: int) -> None:
        self._service = Service(config)
        self._up = up

    async def __aenter__(self) -> Service:
        self._task = asyncio.create_task(self._service.run())
        await until(lambda: all(li.counts.connections for li in self._service.links[: self._up]))
        return self._service

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        assert self._task.cancelled()


async def until(condition) -> None:
    async with asyncio.timeout(SAFETY_S):
        while not condition():
            await asyncio.sleep(0)


def config_for(ground: Ground, *links: str, first: str = "udpin://127.0.0.1:0") -> Config:
    """Input on the first link, output to the ground, an attitude for every epoch."""
    array = f"{{name: array, url: '{first}', emit: {{}}}}"
    output = f"{{name: ground, url: 'udpout://127.0.0.1:{ground.port}'}}"
    rates = "emit={ATTITUDE_QUATERNION: 10000, GPS_HEADING_STATUS: 10, ARRAY_STATUS: 2}"
    return load(None, [rates, f"links=[{', '.join([array, output, *links])}]"])


def address_of(service: Service) -> tuple[str, int]:
    """Where the first link listens."""
    link = service.links[0]
    assert isinstance(link, UdpInLink)
    host, _, port = link.address.partition(":")
    return host, int(port)


async def feed(ground: Ground, service: Service, sent: list[list[bytes]]) -> list[Frame]:
    """Send burst by burst over UDP; wait for the attitude of every epoch."""
    heard = []
    for burst in sent:
        for raw in burst:
            ground.transport.sendto(raw, address_of(service))
        if is_epoch(burst):
            heard.append(await ground.next("ATTITUDE_QUATERNION"))
    return heard


def outputs(heard: list[Frame]) -> list[tuple[int, bytes]]:
    return [(f.message_id, f.payload) for f in heard if f.message_id in EMITTED]


def replayed(config: Config, log: Path) -> list[tuple[int, bytes]]:
    file = io.BytesIO()
    output = OutputLog(config, file)
    for block in Replay(config, log, Selection()).blocks(singly=True):
        output.write(block)
    return outputs([logged.frame for logged in TlogReader([file.getvalue()])])
