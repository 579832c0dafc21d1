"""TCP: a connection that we make, or several that are made to us."""

import asyncio
import logging
import socket
import time
from collections.abc import Callable

from risaf_link.links.admission import Guest, Strangers
from risaf_link.links.endpoint import Endpoint, OnePeerLink, Stream, address_text
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link

MOST_CLIENTS = 16
ANSWER_S = 5.0
ROOM = 65536  # bytes that are read at once

_log = logging.getLogger(__name__)

# A peer that vanished without a word (a pulled cable, a dead battery) is given up after 15 s.
_VIGILANCE = [
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 2),
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 15_000),
]


class _TcpStream(Stream, asyncio.BufferedProtocol):
    """A stream that notices when its peer has vanished, and takes memory to read but once."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(connection)
        self._room = memoryview(bytearray(ROOM))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        for option in _VIGILANCE:
            transport.get_extra_info("socket").setsockopt(*option)

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002
        return self._room

    def buffer_updated(self, nbytes: int) -> None:
        self.take(bytes(self._room[:nbytes]))


class TcpOutLink(OnePeerLink):
    """A TCP connection that we make.

    Parameters
    ----------
    name : str
        What the log calls it.
    host, port : str, int
        Whom it connects to.
    backoff : Backoff
        How long it waits before it connects again.
    """

    def __init__(self, name: str, host: str, port: int, backoff: Backoff = BACKOFF) -> None:
        super().__init__(name, address_text((host, port)), backoff)
        self._host = host
        self._port = port

    async def _connect(self, connection: Connection) -> Endpoint:
        async with asyncio.timeout(ANSWER_S):
            _, stream = await asyncio.get_running_loop().create_connection(
                lambda: _TcpStream(connection), self._host, self._port
            )
        return stream


class TcpInLink(Link):
    """TCP connections that are made to us; every client gets every frame.

    Parameters
    ----------
    name : str
        What the log calls it.
    host, port : str, int
        Where it listens; with port 0 the system chooses one.
    backoff : Backoff
        How long it waits before it listens again.
    now_s : Callable
        A clock, seconds, that never jumps.

    Attributes
    ----------
    address : str
        Where it listens in fact, once it does.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int,
        backoff: Backoff = BACKOFF,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(name, backoff)
        self.address = address_text((host, port))
        self._host = host
        self._port = port
        self._clients: dict[str, _Client] = {}
        self._now_s = now_s
        self._strangers = Strangers(name, self.counts)

    async def _hold(self, connection: Connection) -> None:
        # Started apart: asyncio leaves the socket open if it is cancelled while it does both.
        server = await asyncio.get_running_loop().create_server(
            lambda: _Client(connection, self), self._host, self._port, start_serving=False
        )
        try:
            await server.start_serving()
            self.address = address_text(server.sockets[0].getsockname())
            connection.up(self.address)
            await connection.lost
        finally:
            server.close()
            for client in list(self._clients.values()):
                await client.close()
            await server.wait_closed()

    def enter(self, client: "_Client") -> bool:
        """Take a client in, if there is a place for it."""
        now_s = self._now_s()
        host, guests = client.host, {name: each.guest for name, each in self._clients.items()}
        yielding = self._strangers.place(host, guests, MOST_CLIENTS, now_s)
        if yielding is None:
            return False
        if yielding:
            self._clients[yielding].give_way()
        client.guest = Guest(client.peer, host, now_s)
        self._clients[client.peer] = client
        _log.info("%s: peer %s: new", self.name, client.peer)
        return True

    def leave(self, client: "_Client", reason: object) -> None:
        """Take note that a client has gone."""
        if self._clients.get(client.peer) is client:
            del self._clients[client.peer]
            _log.info("%s: peer %s: gone: %s", self.name, client.peer, reason)

    def hear(self, client: "_Client", data: bytes, connection: Connection) -> float:
        """Hand on what a client sent; seconds until it may send more."""
        now_s, guest = self._now_s(), client.guest
        guest.note(connection.deliver(data, client.peer), now_s)
        return 0.0 if guest.feeds(now_s) else guest.allowance.charge(len(data), now_s)

    def send(self, data: bytes) -> None:
        """Hand one frame to every client; without any it is dropped."""
        if not self._clients:
            self.counts.dropped_out += 1
        for client in self._clients.values():
            client.send(data)

    @property
    def peers(self) -> list[str]:
        """The clients."""
        return list(self._clients)

    def send_to(self, data: bytes, peer: str) -> None:
        """Hand one frame to one client; if it has gone the frame is dropped."""
        client = self._clients.get(peer)
        if client is None:
            self.counts.dropped_out += 1
        else:
            client.send(data)


class _Client(_TcpStream):
    """One client of several: its loss does not end the link's connection."""

    guest: Guest  # once it is taken in

    def __init__(self, connection: Connection, link: TcpInLink) -> None:
        super().__init__(connection)
        self._link = link
        self.peer = self.host = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        address = transport.get_extra_info("peername")
        if not address or self._connection.lost.done():  # it has gone already, or we have
            self._transport.abort()
            return
        self.peer, self.host = address_text(address), address[0]
        if not self._link.enter(self):
            self._transport.abort()

    def take(self, data: bytes) -> None:
        wait_s = self._link.hear(self, data, self._connection)
        if wait_s and not self._transport.is_closing():
            self._transport.pause_reading()
            asyncio.get_running_loop().call_later(wait_s, self._go_on)

    def _go_on(self) -> None:
        if not self._transport.is_closing():
            self._transport.resume_reading()

    def give_way(self) -> None:
        """Be closed for another one."""
        self._link.leave(self, "silent, and others want its place")
        self._transport.abort()

    def connection_lost(self, error: Exception | None) -> None:
        self._closed.set()
        self._link.leave(self, error or "closed by it")
