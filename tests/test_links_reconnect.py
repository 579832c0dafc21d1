"""Links whose peer is absent, goes away and comes back."""

import asyncio
import contextlib
import logging
import os
import socket
from pathlib import Path

import pytest
from test_links import (
    FRAME,
    HOST,
    SOON,
    Device,
    Inbox,
    device,
    free_port,
    port_of,
    running,
    told,
    until,
)

from risaf_link.links import Link, SerialLink, TcpInLink, TcpOutLink, UdpInLink, UdpOutLink, tcp
from risaf_link.links.link import Backoff, Connection

__all__ = ["device", "free_port"]  # fixtures


async def test_a_serial_device_may_come_late_be_unplugged_and_come_back(
    device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "risaf_link")
    link = SerialLink("array", str(device.path), 115_200, SOON)
    async with running(link, up=False) as [inbox]:
        await until(lambda: "array: down: " in caplog.text)
        for connection in 1, 2, 3:
            device.plug_in()
            await until(lambda n=connection: link.counts.connections == n)
            os.write(device.fd, b"%d" % connection)
            await until(lambda n=connection: inbox.stream.endswith(b"%d" % n))
            device.unplug()
    assert inbox.stream == b"123"


async def test_a_serial_device_in_use_is_waited_for(
    device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    device.plug_in()
    first, second = (SerialLink(n, str(device.path), 115_200, SOON) for n in ("first", "second"))
    async with contextlib.AsyncExitStack() as stack:
        async with running(first):
            await stack.enter_async_context(running(second, up=False))
            await until(lambda: "second: down: " in caplog.text)
        await until(lambda: second.counts.connections == 1)
    assert "already locked by another process" in caplog.text


async def test_what_is_no_serial_device_is_retried(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "file"
    path.touch()
    link = SerialLink("array", str(path), 115_200, SOON)
    async with running(link, up=False):
        await until(lambda: "array: down: " in caplog.text)
    assert "Inappropriate ioctl for device" in caplog.text


async def test_a_tcp_peer_may_come_late_go_and_come_back(free_port: int) -> None:
    link = TcpOutLink("autopilot", HOST, free_port, SOON)
    async with running(link, up=False):
        for connection in 1, 2, 3:
            async with running(TcpInLink("peer", HOST, free_port, SOON)) as [at_peer]:
                await until(lambda n=connection: link.counts.connections == n)
                link.send(FRAME)
                await until(lambda inbox=at_peer: inbox.stream == FRAME)


async def test_a_tcp_client_may_go_and_come_back() -> None:
    server = TcpInLink("server", HOST, 0)
    async with running(server) as [inbox]:
        for data in b"one", b"two":
            client = TcpOutLink("client", HOST, port_of(server))
            async with running(client):
                client.send(data)
                await until(lambda d=data: inbox.stream.endswith(d))
    assert inbox.stream == b"onetwo"
    assert server.counts.connections == 1
    assert len(inbox.peers) == 2


@pytest.mark.parametrize("kind", [TcpInLink, UdpInLink])
async def test_a_port_in_use_is_waited_for(
    kind: type[TcpInLink] | type[UdpInLink], caplog: pytest.LogCaptureFixture
) -> None:
    first = kind("first", HOST, 0)
    async with contextlib.AsyncExitStack() as stack:
        async with running(first):
            second = kind("second", HOST, port_of(first), SOON)
            await stack.enter_async_context(running(second, up=False))
            await until(lambda: "second: down: " in caplog.text)
        await until(lambda: second.counts.connections == 1)


async def test_a_udp_peer_that_is_not_there_is_survived_quietly(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "risaf_link")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind((HOST, 0))
        address = peer.getsockname()
    link = UdpOutLink("ground", *address)
    async with running(link) as [inbox]:
        link.send(FRAME)
        await until(lambda: link.counts.dropped_out == 1)  # ICMP: connection refused
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.bind(address)
            peer.setblocking(False)
            link.send(FRAME)
            data, sender = await asyncio.get_running_loop().sock_recvfrom(peer, 4096)
            peer.sendto(b"reply", sender)
            await until(lambda: inbox.stream == b"reply")
    assert data == FRAME
    assert told(caplog) == [f"ground: up: {HOST}:{address[1]}"]


async def test_a_udp_socket_in_trouble_is_opened_again(free_port: int) -> None:
    link = UdpOutLink("ground", HOST, free_port, SOON)
    async with running(link):
        link.send(bytes(70_000))  # no datagram can be that long
        await until(lambda: link.counts.connections == 2)
    assert link.counts.dropped_out == 1


@pytest.mark.parametrize("kind", [TcpOutLink, UdpOutLink])
async def test_a_name_that_does_not_resolve_yet_is_retried(
    kind: type[TcpOutLink] | type[UdpOutLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    asked = 0
    known = await loop.getaddrinfo(HOST, 9, type=socket.SOCK_DGRAM)

    async def getaddrinfo(*_: object, **__: object) -> object:
        nonlocal asked
        asked += 1
        if asked < 4:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return known

    monkeypatch.setattr(loop, "getaddrinfo", getaddrinfo)
    async with running(kind("ground", "groundstation.local", 9, SOON), up=False):
        await until(lambda: asked == 4)


async def test_a_host_that_does_not_answer_is_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "ANSWER_S", 0.001)
    asked = 0

    async def create_connection(*_: object) -> None:
        nonlocal asked
        asked += 1
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", create_connection)
    async with running(TcpOutLink("autopilot", "192.0.2.1", 5760, SOON), up=False):
        await until(lambda: asked == 3)


# What is logged, and when it is tried again


class Failing(Link):
    """A link whose openings go as told: a reason, or bytes that come before the loss."""

    def __init__(self, openings: list[str | bytes]) -> None:
        super().__init__("link", Backoff(1.0, 5.0))
        self._openings = iter(openings)

    async def _hold(self, connection: Connection) -> None:
        opening = next(self._openings, None)
        if opening is None:
            await asyncio.get_running_loop().create_future()
        if isinstance(opening, bytes):
            connection.up("there")
            connection.deliver(opening, "")
            raise OSError("lost")
        raise OSError(opening)

    def send(self, data: bytes) -> None:
        raise NotImplementedError


async def delays_of(openings: list[str | bytes], monkeypatch: pytest.MonkeyPatch) -> list[float]:
    delays: list[float] = []
    real_sleep = asyncio.sleep

    async def sleep(delay: float) -> None:
        delays.append(delay)
        await real_sleep(0)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    task = asyncio.create_task(Failing(openings).run(Inbox()))
    while len(delays) < len(openings):
        await real_sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return delays


async def test_the_delay_doubles_up_to_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    assert await delays_of(["absent"] * 5, monkeypatch) == [1.0, 2.0, 4.0, 5.0, 5.0]


async def test_a_connection_that_brought_nothing_does_not_reset_the_delay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert await delays_of(["absent", b"", b"", b"bytes", b""], monkeypatch) == [1, 2, 4, 1, 2]


async def test_the_reason_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "risaf_link")
    await delays_of(["absent", "absent", "locked", b"bytes", "absent", "absent"], monkeypatch)
    assert told(caplog) == [
        "link: down: absent",
        "link: down: locked",
        "link: up: there",
        "link: down: lost",
        "link: down: absent",
    ]


async def test_bytes_are_never_logged(device: Device, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    device.plug_in()
    link = SerialLink("array", str(device.path), 115_200)
    async with running(link) as [inbox]:
        os.write(device.fd, b"secret")
        await until(lambda: inbox.stream == b"secret")
    assert "secret" not in caplog.text
