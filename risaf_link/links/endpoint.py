"""Our end of what a link opens: what streams and datagrams have in common."""

import asyncio
from abc import ABC, abstractmethod
from typing import Any, cast

from risaf_link.address import shown
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link

Address = tuple[Any, ...]  # as the socket module has it: host, port and, with IPv6, two more


def address_text(address: Address) -> str:
    """Write a socket's address as in a URL."""
    host, port = address[:2]
    return shown(host, port)


class Endpoint(ABC):
    """Our end of a socket or of a device; its loss ends the connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def stay(self, where: str) -> None:
        """Stay until the connection is lost, and close."""
        try:
            self._connection.up(where)
            await self._connection.lost
        finally:
            await self.close()

    @abstractmethod
    async def close(self) -> None:
        """Close at once, and wait until that is done."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Write a frame if there is room for it."""


class Stream(Endpoint, asyncio.BaseProtocol):
    """Our end of a stream of bytes."""

    def __init__(self, connection: Connection) -> None:
        super().__init__(connection)
        self._full = False
        self._closed = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the transport."""
        self._transport = cast("asyncio.Transport", transport)

    def connection_lost(self, error: Exception | None) -> None:
        """End the connection."""
        self._connection.end(error or ConnectionResetError("closed by the other side"))
        self._closed.set()

    def pause_writing(self) -> None:
        """Note that the transport's buffer is full, by default at 64 kB."""
        self._full = True

    def resume_writing(self) -> None:
        """Note that there is room again."""
        self._full = False

    async def close(self) -> None:
        """Close at once, and wait until that is done."""
        if not self._closed.is_set():
            self._transport.abort()
            await self._closed.wait()

    def take(self, data: bytes) -> None:
        """Hand on what came."""
        self._connection.deliver(data, "")

    def send(self, data: bytes) -> None:
        """Write a frame if there is room for it."""
        counts = self._connection.counts
        if self._full or self._transport.is_closing():
            counts.dropped_out += 1
        else:
            counts.bytes_out += len(data)
            self._transport.write(data)


class OnePeerLink(Link):
    """A link with one peer, at the other end of one socket or device.

    Parameters
    ----------
    name : str
        What the log calls it.
    where : str
        What it connects to, for the log.
    backoff : Backoff
        How long it waits before it connects again.
    """

    def __init__(self, name: str, where: str, backoff: Backoff = BACKOFF) -> None:
        super().__init__(name, backoff)
        self._where = where
        self._endpoint: Endpoint | None = None

    async def _hold(self, connection: Connection) -> None:
        endpoint = await self._connect(connection)
        self._endpoint = endpoint
        try:
            await endpoint.stay(self._where)
        finally:
            self._endpoint = None

    @abstractmethod
    async def _connect(self, connection: Connection) -> Endpoint: ...

    def send(self, data: bytes) -> None:
        """Hand one frame to the peer; while it is not connected the frame is dropped."""
        if self._endpoint is None:
            self.counts.dropped_out += 1
        else:
            self._endpoint.send(data)
