"""UDP: to one peer that we know, or with whoever speaks to us."""

import asyncio
import errno
import logging
import socket
import time
from collections.abc import Callable
from functools import partial

from risaf_link.links.admission import FRAME_BYTES, Guest, Strangers
from risaf_link.links.endpoint import Address, Endpoint, OnePeerLink, address_text
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link, Worth

MOST_PEERS = 32
SILENCE_S = 60.0  # after which a peer is forgotten
RECEIVE_BUFFER = 4 << 20  # bytes asked for; the system grants what net.core.rmem_max allows

MOST_AT_ONCE = 64  # datagrams, before other links have their turn
LARGEST = 65536  # bytes of a datagram
# A full buffer of the system's, nobody there just now: no trouble of the socket's.
PASSING = {
    errno.EAGAIN,
    errno.ENOBUFS,
    errno.ECONNREFUSED,
    errno.EHOSTUNREACH,
    errno.ENETUNREACH,
}

_log = logging.getLogger(__name__)


async def _opened(
    host: str, port: int, join: Callable[[socket.socket, Address], None]
) -> socket.socket:
    """Make a socket, and bind or connect it."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET  # `localhost` may be ::1 first
    try:
        found = socket.getaddrinfo(
            host, port, family, socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST
        )
    except socket.gaierror:  # a name: to look it up may take long
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host, port, family=family, type=socket.SOCK_DGRAM)
    *_, address = found[0]
    udp = socket.socket(family, socket.SOCK_DGRAM)
    try:
        udp.setblocking(False)
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        join(udp, address)
    except BaseException:
        udp.close()
        raise
    return udp


class _Datagrams(Endpoint):
    """Our end of a UDP socket.

    It reads the socket itself, and all that waits there: asyncio's transport gives one datagram a
    turn of the loop, and asks for 256 kB of memory for each.

    Parameters
    ----------
    connection : Connection
        What the socket belongs to.
    udp : socket
        Bound or connected.
    hear : Callable
        Takes a datagram, and the address that it came from.
    """

    def __init__(
        self, connection: Connection, udp: socket.socket, hear: Callable[[bytes, Address], object]
    ) -> None:
        super().__init__(connection)
        self._socket = udp
        self._hear = hear
        self._room = memoryview(bytearray(LARGEST))
        asyncio.get_running_loop().add_reader(udp, self._read)

    async def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()

    def send(self, data: bytes, address: Address | None = None) -> None:
        counts = self._connection.counts
        try:
            if address is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, address)
        except OSError as error:  # the system's buffer is full, or there is trouble
            counts.dropped_out += 1
            self._note(error)
        else:
            counts.bytes_out += len(data)

    def _read(self) -> None:
        """Take what has come, as long as other links can wait."""
        for _ in range(MOST_AT_ONCE):
            try:
                size, address = self._socket.recvfrom_into(self._room)
            except BlockingIOError:
                return
            except OSError as error:  # of something that was sent
                self._connection.counts.dropped_out += 1
                self._note(error)
                return
            if size:
                self._hear(bytes(self._room[:size]), address)

    def _note(self, error: OSError) -> None:
        """Take note of trouble: a socket that many share lives on."""


class _Connected(_Datagrams):
    """A UDP socket with one peer."""

    def _note(self, error: OSError) -> None:
        # It keeps the local address that it was given when it was connected, even when that is no
        # more: what does not pass by itself may pass with another socket.
        if error.errno not in PASSING:
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
        udp = await _opened(self._host, self._port, socket.socket.connect)
        return _Connected(connection, udp, lambda data, _: connection.deliver(data, ""))


class UdpInLink(Link):
    """Datagrams from whoever speaks to us; who sends what can be taken is answered.

    Parameters and attributes are those of `TcpInLink`.
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
        self._now_s = now_s
        self._socket: _Datagrams | None = None
        self._guests: dict[str, Guest] = {}  # by name
        self._known: dict[Address, Guest] = {}
        self._addresses: dict[str, Address] = {}  # theirs, and of the stranger who is heard
        self._strangers = Strangers(name, self.counts)

    async def _hold(self, connection: Connection) -> None:
        udp = await _opened(self._host, self._port, socket.socket.bind)
        self._socket = _Datagrams(connection, udp, partial(self._hear, connection))
        self.address = address_text(udp.getsockname())
        try:
            await self._socket.stay(self.address)
        finally:
            self._socket = None

    def _hear(self, connection: Connection, data: bytes, address: Address) -> None:
        """Take a datagram, if its sender may send so much."""
        now_s = self._now_s()
        guest = self._known.get(address)
        if guest is None:
            self._hear_stranger(connection, data, address, now_s)
        elif guest.feeds(now_s) or guest.allowance.takes(max(len(data), FRAME_BYTES), now_s):
            guest.note(connection.deliver(data, guest.name), now_s)
        else:
            self._strangers.refuse(now_s)

    def _hear_stranger(
        self, connection: Connection, data: bytes, address: Address, now_s: float
    ) -> None:
        """Take a stranger's datagram; if it was worth it, the stranger is a peer."""
        host = address[0]
        yielding = self._strangers.place(host, self._guests, MOST_PEERS, now_s)
        if yielding is None:
            return
        name = address_text(address)
        self._addresses[name] = address  # it may be answered at once
        worth = connection.deliver(data, name)
        if worth not in {Worth.FRAMES, Worth.SAMPLES}:
            del self._addresses[name]
            return
        if yielding in self._guests:
            self._forget(yielding)
        self._known[address] = self._guests[name] = guest = Guest(name, host, now_s)
        guest.note(worth, now_s)
        _log.info("%s: peer %s: new", self.name, name)

    def _forget(self, name: str) -> None:
        del self._guests[name], self._known[self._addresses.pop(name)]
        _log.info("%s: peer %s: forgotten", self.name, name)

    @property
    def peers(self) -> list[str]:
        """Those of whom something was taken in the last minute."""
        since_s = self._now_s() - SILENCE_S
        for name in [name for name, guest in self._guests.items() if guest.heard_s < since_s]:
            self._forget(name)
        return list(self._guests)

    def send_to(self, data: bytes, peer: str) -> None:
        """Hand one frame to one of them; if it is not known the frame is dropped."""
        address = self._addresses.get(peer)
        if address is None or self._socket is None:
            self.counts.dropped_out += 1
        else:
            self._socket.send(data, address)

    def send(self, data: bytes) -> None:
        """Hand one frame to everyone heard in the last minute; without any it is dropped."""
        if self._socket is None or not self.peers:
            self.counts.dropped_out += 1
            return
        for address in self._known:
            self._socket.send(data, address)
