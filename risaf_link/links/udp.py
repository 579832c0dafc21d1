"""UDP: to one peer that we know, or with whoever speaks to us."""

import asyncio
import errno
import logging
import os
import socket
import time
from collections.abc import Callable

from risaf_link.links.endpoint import Address, Endpoint, OnePeerLink, address_text
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link

MOST_PEERS = 32
SILENCE_S = 60.0  # after which a peer is forgotten
RECEIVE_BUFFER = 4 << 20  # bytes asked for; the system grants what net.core.rmem_max allows

MOST_AT_ONCE = 64  # datagrams, before other links have their turn
LARGEST = 65536  # bytes of a datagram

_log = logging.getLogger(__name__)


def _family(host: str) -> socket.AddressFamily:
    """Take a name for IPv4, as other MAVLink programs do: `localhost` may well be ::1 first."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


class _Datagrams(Endpoint, asyncio.DatagramProtocol):
    """Our end of a UDP socket.

    Parameters
    ----------
    connection : Connection
        What the socket belongs to.
    heard : Callable
        Told that an address spoke; says which peer that is.
    """

    def __init__(self, connection: Connection, heard: Callable[[Address], str]) -> None:
        super().__init__(connection)
        self._heard = heard

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        udp: socket.socket = transport.get_extra_info("socket")
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket = socket.socket(fileno=os.dup(udp.fileno()))
        self._socket.setblocking(False)

    def connection_lost(self, error: Exception | None) -> None:
        self._socket.close()
        super().connection_lost(error)

    def send(self, data: bytes, address: Address | None = None) -> None:
        if self._takes(data):
            self._transport.sendto(data, address)

    def datagram_received(self, data: bytes, address: Address) -> None:
        """Take a datagram, and those that have come behind it: the loop would give one a turn."""
        self._deliver(data, address)
        for _ in range(MOST_AT_ONCE):
            try:
                data, address = self._socket.recvfrom(LARGEST)
            except BlockingIOError:
                return
            except OSError as error:
                self.error_received(error)
                return
            self._deliver(data, address)

    def _deliver(self, data: bytes, address: Address) -> None:
        if data:
            self._connection.deliver(data, self._heard(address))

    def error_received(self, error: Exception) -> None:  # noqa: ARG002
        self._connection.counts.dropped_out += 1


class _Connected(_Datagrams):
    """A UDP socket with one peer."""

    def error_received(self, error: Exception) -> None:
        super().error_received(error)
        # Nobody there just now is no trouble of the socket's. Anything else may be: it keeps the
        # local address that it was given when it was connected, even when that is no more.
        absent = errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH
        if not (isinstance(error, OSError) and error.errno in absent):
            self._connection.end(error)


class UdpOutLink(OnePeerLink):
    """Datagrams to one peer, and its replies.

    Parameters
    ----------
    name : str
        What the log calls it.
    host, port : str, int
        The peer.
    backoff : Backoff
        How long it waits before it opens again.
    """

    def __init__(self, name: str, host: str, port: int, backoff: Backoff = BACKOFF) -> None:
        super().__init__(name, address_text((host, port)), backoff)
        self._host = host
        self._port = port

    async def _connect(self, connection: Connection) -> Endpoint:
        _, endpoint = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: _Connected(connection, lambda _: ""),
            remote_addr=(self._host, self._port),
            family=_family(self._host),
        )
        return endpoint


class UdpInLink(Link):
    """Datagrams from whoever speaks to us; all of them are answered.

    Parameters and attributes are those of `TcpInLink`, and

    Parameters
    ----------
    now_s : Callable
        A clock, seconds, that never jumps.
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
        self._local = host, port
        self._now_s = now_s
        self._socket: _Datagrams | None = None
        self._peers: dict[Address, tuple[str, float]] = {}  # heard when; longest silent first

    async def _hold(self, connection: Connection) -> None:
        transport, self._socket = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: _Datagrams(connection, self._heard),
            local_addr=self._local,
            family=_family(self._local[0]),
        )
        self.address = address_text(transport.get_extra_info("sockname"))
        try:
            await self._socket.stay(self.address)
        finally:
            self._socket = None

    def _heard(self, address: Address) -> str:
        """Note that a peer spoke; return its name."""
        if address in self._peers:
            peer, _ = self._peers.pop(address)
        else:
            peer = address_text(address)
            _log.info("%s: peer %s: new", self.name, peer)
            if len(self._peers) == MOST_PEERS:
                self._forget(next(iter(self._peers)))
        self._peers[address] = peer, self._now_s()
        return peer

    def _forget(self, address: Address) -> None:
        peer, _ = self._peers.pop(address)
        _log.info("%s: peer %s: forgotten", self.name, peer)

    @property
    def peers(self) -> list[str]:
        """Those who spoke in the last minute."""
        since_s = self._now_s() - SILENCE_S
        for address in [a for a, (_, heard_s) in self._peers.items() if heard_s < since_s]:
            self._forget(address)
        return [peer for peer, _ in self._peers.values()]

    def send_to(self, data: bytes, peer: str) -> None:
        """Hand one frame to one of them; if it is not known the frame is dropped."""
        for address, (name, _) in self._peers.items():
            if name == peer and self._socket is not None:
                self._socket.send(data, address)
                return
        self.counts.dropped_out += 1

    def send(self, data: bytes) -> None:
        """Hand one frame to everyone who spoke in the last minute; without any it is dropped."""
        if self._socket is None or not self.peers:
            self.counts.dropped_out += 1
            return
        for address in self._peers:
            self._socket.send(data, address)
