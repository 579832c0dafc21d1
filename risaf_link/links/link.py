"""What every link is: bytes in and out, held open for as long as somebody runs it."""

import asyncio
import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto


class Worth(Enum):
    """What came of bytes that were received: that is how much more of the kind is heard."""

    UNKNOWN = auto()  # they wait for others
    NOTHING = auto()
    FRAMES = auto()  # at least one was taken
    SAMPLES = auto()  # of the array that is listened to


Receive = Callable[[bytes, str], Worth]
"""Takes the bytes and who sent them: a peer such as ``127.0.0.1:14550``, "" where there is one."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class LinkCounts:
    """What went through a link since it was made."""

    bytes_in: int = 0
    bytes_out: int = 0  # handed to the system, once for each peer
    dropped_out: int = 0  # frames that a peer did not get, or that nobody was there for
    dropped_in: int = 0  # datagrams and connections of those who want too much
    connections: int = 0  # how often the link came up


@dataclass(frozen=True, slots=True)
class Backoff:
    """How long a link waits before it opens again: doubled at each failure in a row."""

    first_s: float = 0.1
    longest_s: float = 5.0


BACKOFF = Backoff()


class Connection:
    """One opening of a link, until it is lost."""

    def __init__(self, name: str, counts: LinkCounts, receive: Receive) -> None:
        self.name = name
        self.counts = counts
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.failure: Exception | None = None  # what `receive` raised
        self.up_s: float | None = None
        self._receive = receive
        self._bytes_in = counts.bytes_in

    def up(self, where: str) -> None:
        """Say that the link is open now."""
        self.up_s = asyncio.get_running_loop().time()
        self.counts.connections += 1
        _log.info("%s: up: %s", self.name, where)

    def deliver(self, data: bytes, peer: str) -> Worth:
        """Hand on what a peer sent; tell what came of it."""
        if self.lost.done():
            return Worth.NOTHING
        self.counts.bytes_in += len(data)
        try:
            return self._receive(data, peer)
        except Exception as error:
            self.failure = error
            self.end(ConnectionAbortedError("what was received could not be processed"))
            return Worth.NOTHING

    def end(self, error: Exception) -> None:
        """Give the connection up; the first reason counts."""
        if not self.lost.done():
            self.lost.set_exception(error)

    def held(self, seconds: float) -> bool:
        """Tell whether the connection was of use: it brought something, or stood that long."""
        if self.up_s is None:
            return False
        stood_s = asyncio.get_running_loop().time() - self.up_s
        return self.counts.bytes_in > self._bytes_in or stood_s >= seconds


class Link(ABC):
    """Bytes in and out. A link never looks into them.

    Making a link opens nothing; `run` does.

    Parameters
    ----------
    name : str
        What the log calls it.
    backoff : Backoff
        How long it waits before it opens again.

    Attributes
    ----------
    bytes_per_s : float
        What it carries; infinite: not known.
    """

    bytes_per_s = math.inf

    def __init__(self, name: str, backoff: Backoff = BACKOFF) -> None:
        self.name = name
        self.counts = LinkCounts()
        self._backoff = backoff

    async def run(self, receive: Receive) -> None:
        """Hold the link open until cancelled; trouble with the system or a peer is retried.

        Raises
        ------
        Exception
            What `receive` raised: that is no trouble of the link's.
        """
        delay_s, told = self._backoff.first_s, ""
        while True:
            connection = Connection(self.name, self.counts, receive)
            reason = ""
            try:
                await self._hold(connection)
            except OSError as error:
                reason = str(error) or type(error).__name__
            finally:
                connection.lost.cancel()  # a transport that still closes has nobody to tell
            if connection.failure is not None:
                raise connection.failure
            if connection.up_s is not None or reason != told:
                _log.warning("%s: down: %s", self.name, reason)
            if connection.held(self._backoff.longest_s):
                delay_s = self._backoff.first_s
            told = reason
            await asyncio.sleep(delay_s)
            delay_s = min(2 * delay_s, self._backoff.longest_s)

    @property
    def peers(self) -> Sequence[str]:
        """Who can be reached now, as far as is known; "" where there is one."""
        return ("",)

    @abstractmethod
    async def _hold(self, connection: Connection) -> None:
        """Open, say `connection.up`, stay until lost (raises OSError), close whatever happens."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Hand one frame to every peer now known; it never waits. What is not taken is counted."""

    def send_to(self, data: bytes, peer: str) -> None:  # noqa: ARG002
        """Hand one frame to one peer."""
        self.send(data)
