"""TCP: a connection that we make, or several that are made to us."""

import asyncio
import logging
import socket

from risaf_link.links.endpoint import Endpoint, OnePeerLink, Stream, address_text
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link

MOST_CLIENTS = 16
ANSWER_S = 5.0

_log = logging.getLogger(__name__)

# A peer that vanished without a word (a pulled cable, a dead battery) is given up after 15 s.
_VIGILANCE = [
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 2),
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 15_000),
]


class _TcpStream(Stream):
    """A stream that notices when its peer has vanished."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        for option in _VIGILANCE:
            transport.get_extra_info("socket").setsockopt(*option)


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

    Attributes
    ----------
    address : str
        Where it listens in fact, once it does.
    """

    def __init__(self, name: str, host: str, port: int, backoff: Backoff = BACKOFF) -> None:
        super().__init__(name, backoff)
        self.address = address_text((host, port))
        self._host = host
        self._port = port
        self._clients: set[_Client] = set()

    async def _hold(self, connection: Connection) -> None:
        # Started apart: asyncio leaves the socket open if it is cancelled while it does both.
        server = await asyncio.get_running_loop().create_server(
            lambda: _Client(connection, self._clients), self._host, self._port, start_serving=False
        )
        try:
            await server.start_serving()
            self.address = address_text(server.sockets[0].getsockname())
            connection.up(self.address)
            await connection.lost
        finally:
            server.close()
            for client in list(self._clients):
                await client.close()
            await server.wait_closed()

    def send(self, data: bytes) -> None:
        """Hand one frame to every client; without any it is dropped."""
        if not self._clients:
            self.counts.dropped_out += 1
        for client in self._clients:
            client.send(data)

    @property
    def peers(self) -> list[str]:
        """The clients."""
        return [client.peer for client in self._clients]

    def send_to(self, data: bytes, peer: str) -> None:
        """Hand one frame to one client; if it has gone the frame is dropped."""
        for client in self._clients:
            if client.peer == peer:
                client.send(data)
                return
        self.counts.dropped_out += 1


class _Client(_TcpStream):
    """One client of several: its loss does not end the link's connection."""

    def __init__(self, connection: Connection, clients: "set[_Client]") -> None:
        super().__init__(connection)
        self._clients = clients

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self._clients) == MOST_CLIENTS or self._connection.lost.done():
            self._transport.abort()
            return
        self.peer = address_text(transport.get_extra_info("peername"))
        self._clients.add(self)
        _log.info("%s: peer %s: new", self._connection.name, self.peer)
        if len(self._clients) == MOST_CLIENTS:
            _log.warning("%s: no more than %d peers", self._connection.name, MOST_CLIENTS)

    def connection_lost(self, error: Exception | None) -> None:
        self._closed.set()
        if self in self._clients:
            self._clients.remove(self)
            reason = error or "closed by it"
            _log.info("%s: peer %s: gone: %s", self._connection.name, self.peer, reason)
