"""Links with several peers."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Iterator

import pytest
from test_links import FRAME, HOST, SOON, port_of, running, told, until

from risaf_link.links import TcpInLink, TcpOutLink, UdpInLink, Worth, admission, tcp, udp


@pytest.fixture
def udp_socket() -> Iterator[Callable[..., socket.socket]]:
    with contextlib.ExitStack() as stack:

        def make(host: str = HOST) -> socket.socket:
            made = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            made.bind((host, 0))
            made.setblocking(False)
            return made

        yield make


async def receive_from(udp_socket: socket.socket) -> bytes:
    return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(udp_socket, 4096), 10)


async def test_udp_peers_are_named_and_all_are_answered(
    udp_socket: Callable[[], socket.socket],
) -> None:
    link = UdpInLink("ground", HOST, 0)
    first, second = udp_socket(), udp_socket()
    async with running(link) as [inbox]:
        for data, peer in (b"1", first), (b"2", second), (b"3", first):
            peer.sendto(data, (HOST, port_of(link)))
            await until(lambda d=data: inbox.stream.endswith(d))
        names = [f"{HOST}:{peer.getsockname()[1]}" for peer in (first, second)]
        assert inbox == [(b"1", names[0]), (b"2", names[1]), (b"3", names[0])]
        link.send(FRAME)
        assert await receive_from(first) == await receive_from(second) == FRAME
        assert link.counts.bytes_out == 2 * len(FRAME)


async def test_the_udp_peer_silent_longest_gives_way_once_it_has_missed_five_heartbeats(
    udp_socket: Callable[[], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "MOST_PEERS", 4)  # two of one host
    now_s = 1000.0
    link = UdpInLink("ground", HOST, 0, now_s=lambda: now_s)
    first, second, third = udp_socket(), udp_socket(), udp_socket()
    async with running(link) as [inbox]:
        for count, (later_s, peer) in enumerate([(0.0, first), (4.0, second), (2.0, third)], 1):
            now_s += later_s
            peer.sendto(b"here", (HOST, port_of(link)))
            await until(lambda n=count: len(inbox) == n)
        link.send(FRAME)
        assert await receive_from(second) == await receive_from(third) == FRAME
        with pytest.raises(BlockingIOError):
            first.recv(4096)


async def test_strangers_do_not_drive_out_the_udp_peers_that_are_there(
    udp_socket: Callable[[], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "MOST_PEERS", 4)  # two of one host
    link = UdpInLink("ground", HOST, 0, now_s=lambda: 1000.0)
    peers, strangers = [udp_socket(), udp_socket()], [udp_socket() for _ in range(50)]
    async with running(link) as [inbox]:
        for count, peer in enumerate(peers, 1):
            peer.sendto(b"here", (HOST, port_of(link)))
            await until(lambda n=count: len(inbox) == n)
        for stranger in strangers:
            stranger.sendto(b"here", (HOST, port_of(link)))
        await until(lambda: link.counts.dropped_in == len(strangers))
        assert len(inbox) == 2
        link.send(FRAME)
        assert [await receive_from(peer) for peer in peers] == [FRAME, FRAME]


async def test_garbage_takes_no_place_of_a_silent_peer(
    udp_socket: Callable[..., socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "MOST_PEERS", 2)  # one of one host
    now_s = 1000.0
    link = UdpInLink("ground", HOST, 0, now_s=lambda: now_s)
    heard: list[bytes] = []

    def receive(data: bytes, _: str) -> Worth:
        heard.append(data)
        return Worth.NOTHING if data == b"garbage" else Worth.FRAMES

    task = asyncio.create_task(link.run(receive))
    await until(lambda: link.counts.connections)
    peer, stranger = udp_socket(), udp_socket()
    peer.sendto(b"here", (HOST, port_of(link)))
    await until(lambda: link.peers)
    before = link.peers
    now_s += 30.0
    stranger.sendto(b"garbage", (HOST, port_of(link)))
    await until(lambda: b"garbage" in heard)
    assert link.peers == before
    stranger.sendto(b"here", (HOST, port_of(link)))
    await until(lambda: link.peers != before)
    task.cancel()
    await asyncio.wait([task])


async def test_one_host_never_has_all_places(
    udp_socket: Callable[..., socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udp, "MOST_PEERS", 4)
    link = UdpInLink("ground", "0.0.0.0", 0, now_s=lambda: 1000.0)  # noqa: S104
    async with running(link) as [inbox]:
        for _ in range(6):
            udp_socket("127.0.0.2").sendto(b"one of many", (HOST, port_of(link)))
        await until(lambda: link.counts.dropped_in == 4)
        udp_socket("127.0.0.3").sendto(b"alone", (HOST, port_of(link)))
        await until(lambda: len(inbox) == 3)
        assert [peer.partition(":")[0] for peer in link.peers] == [*["127.0.0.2"] * 2, "127.0.0.3"]


async def test_who_sends_nothing_that_is_taken_is_no_peer(
    udp_socket: Callable[..., socket.socket],
) -> None:
    link = UdpInLink("ground", HOST, 0)
    garbler = udp_socket()
    heard: list[bytes] = []

    def receive(data: bytes, peer: str) -> Worth:
        heard.append(data)
        link.send_to(b"an answer to this alone", peer)
        return Worth.NOTHING

    task = asyncio.create_task(link.run(receive))
    await until(lambda: link.counts.connections)
    garbler.sendto(b"?", (HOST, port_of(link)))
    await until(lambda: heard)
    link.send(FRAME)
    assert await receive_from(garbler) == b"an answer to this alone"
    assert not link.peers
    with pytest.raises(BlockingIOError):
        garbler.recv(4096)
    task.cancel()
    await asyncio.wait([task])


async def test_strangers_of_a_host_are_heard_twenty_times_a_second(
    udp_socket: Callable[..., socket.socket], caplog: pytest.LogCaptureFixture
) -> None:
    now_s = 1000.0
    link = UdpInLink("ground", HOST, 0, now_s=lambda: now_s)
    heard: list[str] = []

    def receive(_: bytes, peer: str) -> Worth:
        heard.append(peer)
        return Worth.NOTHING

    task = asyncio.create_task(link.run(receive))
    await until(lambda: link.counts.connections)
    strangers = [udp_socket() for _ in range(30)]
    for expected in (20, 40):
        for stranger in strangers:
            stranger.sendto(b"?", (HOST, port_of(link)))
        await until(lambda n=expected: len(heard) + link.counts.dropped_in == 30 * n // 20)
        assert len(heard) == expected
        now_s += 1.0
    assert told(caplog) == ["ground: too much comes: 1 not heard so far"]
    task.cancel()
    await asyncio.wait([task])


@pytest.mark.parametrize(("worth", "expected"), [(Worth.FRAMES, 2000), (Worth.SAMPLES, 2100)])
async def test_a_peer_is_heard_2000_times_a_second_and_who_brings_samples_without_limit(
    udp_socket: Callable[..., socket.socket], worth: Worth, expected: int
) -> None:
    link = UdpInLink("array", HOST, 0, now_s=lambda: 1000.0)
    heard: list[bytes] = []

    def receive(data: bytes, _: str) -> Worth:
        heard.append(data)
        return worth

    task = asyncio.create_task(link.run(receive))
    await until(lambda: link.counts.connections)
    peer = udp_socket()
    for number in range(1, 2102):  # the first one as a stranger
        peer.sendto(b"!", (HOST, port_of(link)))
        await until(lambda n=number: len(heard) + link.counts.dropped_in == n)
    assert len(heard) == 1 + expected
    task.cancel()
    await asyncio.wait([task])


async def test_a_udp_peer_silent_for_a_minute_is_forgotten(
    udp_socket: Callable[[], socket.socket], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "risaf_link")
    now_s = 1000.0
    link = UdpInLink("ground", HOST, 0, now_s=lambda: now_s)
    peer = udp_socket()
    async with running(link) as [inbox]:
        peer.sendto(b"here", (HOST, port_of(link)))
        await until(lambda: inbox)
        now_s += 60.0
        link.send(b"kept")
        now_s += 0.1
        link.send(b"lost")
        assert await receive_from(peer) == b"kept"
        assert link.counts.dropped_out == 1
    name = f"{HOST}:{peer.getsockname()[1]}"
    assert told(caplog)[1:] == [f"ground: peer {name}: new", f"ground: peer {name}: forgotten"]


async def test_garbage_and_empty_datagrams_are_survived(
    udp_socket: Callable[[], socket.socket],
) -> None:
    link = UdpInLink("ground", HOST, 0)
    silent, loud = udp_socket(), udp_socket()
    async with running(link) as [inbox]:
        silent.sendto(b"", (HOST, port_of(link)))
        garbage = [bytes([0xFD]) * n for n in (1, 2000, 60_000)]
        for data in garbage:
            loud.sendto(data, (HOST, port_of(link)))
        await until(lambda: len(inbox) == 3)
        assert [data for data, _ in inbox] == garbage
        link.send(FRAME)
        assert await receive_from(loud) == FRAME
        with pytest.raises(BlockingIOError):
            silent.recv(4096)


async def test_a_burst_of_datagrams_waits_in_the_sockets_buffer(
    udp_socket: Callable[[], socket.socket],
) -> None:
    link = UdpInLink("array", HOST, 0)
    sender = udp_socket()
    async with running(link) as [inbox]:
        for n in range(150):  # the event loop does not run meanwhile
            sender.sendto(n.to_bytes(2, "big") + bytes(264), (HOST, port_of(link)))
        await until(lambda: len(inbox) == 150)
        assert [int.from_bytes(data[:2], "big") for data, _ in inbox] == list(range(150))


async def test_tcp_clients_are_named_and_all_are_answered() -> None:
    server = TcpInLink("ground", HOST, 0)
    async with running(server) as [inbox]:
        first = TcpOutLink("first", HOST, port_of(server))
        second = TcpOutLink("second", HOST, port_of(server))
        async with running(first, second) as [at_first, at_second]:
            first.send(b"1")
            second.send(b"2")
            await until(lambda: len(inbox) == 2)
            assert len(inbox.peers) == 2
            assert all(peer.startswith(f"{HOST}:") for peer in inbox.peers)
            server.send(FRAME)
            await until(lambda: at_first.stream == at_second.stream == FRAME)


async def test_a_tcp_peer_that_vanishes_is_noticed_at_both_ends() -> None:
    server = TcpInLink("ground", HOST, 0)
    async with running(server):
        client = TcpOutLink("autopilot", HOST, port_of(server))
        async with running(client):
            await until(lambda: server._clients)
            for end in *server._clients.values(), client._endpoint:
                probed = end._transport.get_extra_info("socket")
                assert probed.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
                assert probed.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 15_000


async def test_one_tcp_client_too_many_is_refused(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tcp, "MOST_CLIENTS", 1)
    server = TcpInLink("ground", HOST, 0)
    async with running(server) as [inbox]:
        first = TcpOutLink("first", HOST, port_of(server))
        async with running(first):
            first.send(b"1")
            await until(lambda: inbox.stream == b"1")
            second = TcpOutLink("second", HOST, port_of(server), SOON)
            async with running(second):
                await until(lambda: second.counts.connections == 2)  # was closed, tried again
                first.send(b"2")
                await until(lambda: inbox.stream == b"12")
    assert "ground: too much comes: 1 not heard so far" in told(caplog)


async def test_a_silent_tcp_client_gives_way_to_one_that_comes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "risaf_link")
    monkeypatch.setattr(tcp, "MOST_CLIENTS", 1)
    now_s = 1000.0
    server = TcpInLink("ground", HOST, 0, now_s=lambda: now_s)
    async with running(server) as [inbox]:
        first = TcpOutLink("first", HOST, port_of(server))
        async with running(first):
            await until(lambda: server.peers)
            [silent] = server.peers
            now_s += 6.0
            second = TcpOutLink("second", HOST, port_of(server))
            async with running(second):
                await until(lambda: server.peers not in ([], [silent]))
                second.send(b"here")
                await until(lambda: inbox.stream == b"here")
    assert f"ground: peer {silent}: gone: silent, and others want its place" in told(caplog)


async def test_a_tcp_client_that_sends_too_much_waits_and_loses_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(admission, "PEER_BYTES_PER_S", 1_000_000.0)
    server = TcpInLink("ground", HOST, 0)
    sent = bytes(range(256)) * 5000  # 1.3 MB: a second's worth, and 0.28 s
    async with running(server) as [inbox]:
        reader, writer = await asyncio.open_connection(HOST, port_of(server))
        began_s = asyncio.get_running_loop().time()
        writer.write(sent)
        await until(lambda: len(inbox.stream) >= len(sent))
        [client] = server._clients.values()
        assert inbox.stream == sent
        writer.write(b"!")
        await until(lambda: inbox.stream.endswith(b"!"))
        assert asyncio.get_running_loop().time() - began_s > 0.2
        assert client._transport.is_reading()
        writer.close()
        await until(lambda: not server.peers)
    assert await reader.read() == b""
