"""What all links have in common, held against real sockets and pseudo terminals."""

import asyncio
import contextlib
import gc
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial
from pathlib import Path

import ports
import pytest

from risaf_link.links import (
    Link,
    MemoryLink,
    SerialLink,
    TcpInLink,
    TcpOutLink,
    UdpInLink,
    UdpOutLink,
    Worth,
)
from risaf_link.links.link import Backoff

SOON = Backoff(first_s=0.001, longest_s=0.004)
HOST = "127.0.0.1"
FRAME = b"\xfd\x09\x00\x00\x00\x01\x01" + bytes(range(20))


# Running a link


class Inbox(list[tuple[bytes, str]]):
    """What a link received, piece by piece."""

    def __call__(self, data: bytes, peer: str) -> Worth:
        self.append((data, peer))
        return Worth.FRAMES

    @property
    def stream(self) -> bytes:
        return b"".join(data for data, _ in self)

    @property
    def peers(self) -> set[str]:
        return {peer for _, peer in self}


async def until(condition: Callable[[], object]) -> None:
    """Wait for a state that the event loop or the kernel brings about."""
    async with asyncio.timeout(10):
        while not condition():
            await asyncio.sleep(0.001)


@contextlib.asynccontextmanager
async def running(*links: Link, up: bool = True) -> AsyncIterator[list[Inbox]]:
    inboxes = [Inbox() for _ in links]
    tasks = [
        asyncio.create_task(link.run(inbox)) for link, inbox in zip(links, inboxes, strict=True)
    ]
    try:
        if up:
            await until(lambda: all(link.counts.connections for link in links))
        yield inboxes
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
        assert [type(end) for end in ends] == [asyncio.CancelledError] * len(tasks)


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What links logged; asyncio in debug mode complains of a slow machine."""
    return [entry.getMessage() for entry in caplog.records if entry.name.startswith("risaf_link")]


def port_of(link: UdpInLink | TcpInLink) -> int:
    return int(link.address.rpartition(":")[2])


@pytest.fixture
def free_port() -> int:
    return ports.free_port(socket.SOCK_STREAM)


class Device:
    """A serial device under a lasting name, that can be unplugged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fd = -1

    def plug_in(self) -> None:
        self.fd, slave = os.openpty()
        os.set_blocking(self.fd, False)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        self.path.unlink()
        os.close(self.fd)
        self.fd = -1

    async def read(self, size: int) -> bytes:
        data = b""

        def complete() -> bool:
            nonlocal data
            with contextlib.suppress(BlockingIOError):
                data += os.read(self.fd, size)
            return len(data) >= size

        await until(complete)
        return data


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "ttyARRAY")
    yield device
    if device.fd >= 0:
        device.unplug()


# Bytes both ways


@contextlib.asynccontextmanager
async def network_pair(
    listening: type[TcpInLink | UdpInLink], calling: type[TcpOutLink | UdpOutLink], host: str = HOST
) -> AsyncIterator[tuple[Link, Inbox, Link, Inbox]]:
    server = listening("server", host, 0)
    async with running(server) as [at_server]:
        client = calling("client", host, port_of(server))
        async with running(client) as [at_client]:
            yield server, at_server, client, at_client


udp_pair = partial(network_pair, UdpInLink, UdpOutLink)
tcp_pair = partial(network_pair, TcpInLink, TcpOutLink)


@contextlib.asynccontextmanager
async def memory_pair(host: str = HOST) -> AsyncIterator[tuple[Link, Inbox, Link, Inbox]]:
    server, client = MemoryLink("server", host), MemoryLink("client", host)
    async with running(server, client) as [at_server, at_client]:
        yield server, at_server, client, at_client


@pytest.mark.parametrize("host", [HOST, "::1"])
@pytest.mark.parametrize("pair", [udp_pair, tcp_pair, memory_pair])
async def test_a_pair_of_links_carries_bytes_both_ways(
    pair: Callable[[str], contextlib.AbstractAsyncContextManager[tuple[Link, Inbox, Link, Inbox]]],
    host: str,
) -> None:
    async with pair(host) as (server, at_server, client, at_client):
        client.send(FRAME)
        await until(lambda: at_server.stream == FRAME)
        server.send(FRAME + FRAME)
        await until(lambda: at_client.stream == FRAME + FRAME)
        assert server.counts.bytes_in == client.counts.bytes_out == len(FRAME)
        assert client.counts.bytes_in == server.counts.bytes_out == 2 * len(FRAME)
        assert server.counts.dropped_out == client.counts.dropped_out == 0
        assert at_client.peers == {""}


async def test_a_serial_link_carries_every_byte_value_both_ways(device: Device) -> None:
    device.plug_in()
    link = SerialLink("array", str(device.path), 3_000_000)
    every_byte = bytes(range(256))
    async with running(link) as [inbox]:
        os.write(device.fd, every_byte)
        await until(lambda: inbox.stream == every_byte)
        link.send(every_byte)
        assert await device.read(256) == every_byte
        assert inbox.peers == {""}
        assert (link.counts.bytes_in, link.counts.bytes_out) == (256, 256)


async def test_links_of_one_process_do_not_meet() -> None:
    async with (
        tcp_pair() as (_, at_tcp_server, tcp_client, _),
        udp_pair() as (_, at_udp_server, udp_client, _),
        memory_pair("one") as (_, at_one, one, _),
        memory_pair("other") as (_, at_other, _, _),
    ):
        tcp_client.send(b"tcp")
        udp_client.send(b"udp")
        one.send(b"one")
        await until(lambda: at_tcp_server and at_udp_server and at_one)
        assert (at_tcp_server.stream, at_udp_server.stream) == (b"tcp", b"udp")
        assert (at_one.stream, at_other.stream) == (b"one", b"")


# What cannot be sent


def links_of_all_kinds(device: Path, port: int) -> list[Link]:
    return [
        SerialLink("serial", str(device), 115_200, SOON),
        UdpInLink("udpin", HOST, 0, SOON),
        UdpOutLink("udpout", HOST, port, SOON),
        TcpInLink("tcpin", HOST, 0, SOON),
        TcpOutLink("tcpout", HOST, port, SOON),
        MemoryLink("memory", "nobody"),
    ]


def test_a_frame_is_dropped_and_counted_before_the_link_runs(tmp_path: Path) -> None:
    for link in links_of_all_kinds(tmp_path / "absent", 9):
        link.send(FRAME)
        link.send(FRAME)
        assert (link.counts.dropped_out, link.counts.bytes_out) == (2, 0), link.name


async def test_a_frame_is_dropped_and_counted_without_peers() -> None:
    links = [UdpInLink("u", HOST, 0), TcpInLink("t", HOST, 0), MemoryLink("m", "nobody")]
    async with running(*links):
        for link in links:
            link.send(FRAME)
            assert (link.counts.dropped_out, link.counts.bytes_out) == (1, 0), link.name


async def test_a_peer_that_does_not_read_costs_whole_frames() -> None:
    frame = bytes(10_000)
    with socket.create_server((HOST, 0)) as listener:
        listener.setblocking(False)
        link = TcpOutLink("slow", HOST, listener.getsockname()[1])
        async with running(link):
            peer, _ = await asyncio.get_running_loop().sock_accept(listener)
            with peer:
                while not link.counts.dropped_out:
                    link.send(frame)
                taken = link.counts.bytes_out
                received = 0
                while received < taken:
                    received += len(await asyncio.get_running_loop().sock_recv(peer, 1 << 20))
                assert received == taken
                assert taken % len(frame) == 0
                link.send(frame)
                assert link.counts.bytes_out == taken + len(frame)


async def test_no_more_than_a_second_waits_for_a_slow_serial_line(device: Device) -> None:
    device.plug_in()
    link = SerialLink("radio", str(device.path), 9_600)
    async with running(link):
        link.send(bytes(100_000))  # the pseudo terminal takes some, the rest waits
        link.send(FRAME)
        assert link.counts.dropped_out == 1


async def test_sending_while_a_serial_device_goes_away_never_raises(device: Device) -> None:
    device.plug_in()
    link = SerialLink("array", str(device.path), 115_200, SOON)
    async with running(link):
        device.unplug()
        async with asyncio.timeout(10):
            while not link.counts.dropped_out:
                link.send(FRAME)
                await asyncio.sleep(0)


async def test_sending_while_a_tcp_peer_goes_away_never_raises(free_port: int) -> None:
    link = TcpOutLink("autopilot", HOST, free_port, SOON)
    async with running(link, up=False):
        async with running(TcpInLink("peer", HOST, free_port, SOON)):
            await until(lambda: link.counts.connections)
        async with asyncio.timeout(10):
            while not link.counts.dropped_out:
                link.send(FRAME)
                await asyncio.sleep(0)


# Errors in what receives


@pytest.mark.parametrize("error", [ZeroDivisionError("bug"), OSError("bug")])
@pytest.mark.parametrize("pair", [udp_pair, tcp_pair, memory_pair])
async def test_what_receive_raises_ends_run(
    pair: Callable[[], contextlib.AbstractAsyncContextManager[tuple[Link, Inbox, Link, Inbox]]],
    error: Exception,
) -> None:
    calls: list[bytes] = []

    def receive(data: bytes, _peer: str) -> None:
        calls.append(data)
        raise error

    async with pair() as (server, _, _, _):
        place: dict[type[Link], Callable[[], Link]] = {
            UdpInLink: lambda: UdpOutLink("bad", HOST, port_of(server)),
            TcpInLink: lambda: TcpOutLink("bad", HOST, port_of(server)),
            MemoryLink: lambda: MemoryLink("bad", HOST),
        }
        bad = place[type(server)]()
        task = asyncio.create_task(bad.run(receive))
        await until(lambda: bad.counts.connections)
        bad.send(b"here I am")
        await until(lambda: server.counts.bytes_in)
        server.send(FRAME)
        with pytest.raises(type(error), match="bug"):
            await asyncio.wait_for(task, 10)
        assert calls == [FRAME]


async def test_what_receive_raises_ends_run_of_a_serial_link(device: Device) -> None:
    device.plug_in()
    link = SerialLink("array", str(device.path), 115_200)

    def receive(data: bytes, _peer: str) -> None:
        raise ZeroDivisionError(data)

    task = asyncio.create_task(link.run(receive))
    await until(lambda: link.counts.connections)
    os.write(device.fd, FRAME)
    with pytest.raises(ZeroDivisionError):
        await asyncio.wait_for(task, 10)


# Cancellation


def open_descriptors() -> set[str]:
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.add(f"{entry.name} {entry.readlink()}")
    return found


@pytest.mark.parametrize("turns", [0, 1, 2, 3, 4, 5, 6, 8, 12, 25, 100, 400, 1600])
@pytest.mark.parametrize("kind", range(6))
async def test_cancelling_at_any_moment_closes_everything(
    kind: int, turns: int, device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    device.plug_in()
    with socket.create_server((HOST, 0)) as listener:
        await asyncio.to_thread(int)  # the default executor exists
        before = open_descriptors()
        link = links_of_all_kinds(device.path, listener.getsockname()[1])[kind]
        task = asyncio.create_task(link.run(Inbox()))
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await until(lambda: open_descriptors() <= before)
    gc.collect()  # what was left open or unsaid complains when it is collected
    assert "never" not in caplog.text


async def test_cancelling_a_server_closes_its_clients() -> None:
    server = TcpInLink("server", HOST, 0)
    async with running(server):
        reader, writer = await asyncio.open_connection(HOST, port_of(server))
        writer.write(b"here")
        await until(lambda: server.counts.bytes_in == 4)
    assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()
