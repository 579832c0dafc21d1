"""Where the page's frames come from: a link, or a log."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from risaf_link.links import Link, Worth
from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.signing import LinkSigning
from risaf_link.monitor.asking import Asking
from risaf_link.monitor.recording import Player
from risaf_link.monitor.vehicles import Vehicles

TICK_S = 0.05
MOST_PEERS = 64


class Source(Protocol):
    """What the page shows."""

    name: str

    @property
    def vehicles(self) -> Vehicles:
        """What is known; another object after a jump in time."""

    @property
    def now_us(self) -> int:
        """Microseconds since 1970, by the clock by which frames arrive."""

    @property
    def player(self) -> Player | None:
        """What plays the log; None: it is live."""

    @property
    def rejected(self) -> Mapping[str, int]:
        """Frames that were not taken for their signatures, by reason."""

    async def run(self) -> None:
        """Let frames come until cancelled."""


class Live:
    """A link.

    Parameters
    ----------
    name : str
        Its URL.
    link : Link
    clock_us : callable
        Microseconds since 1970.
    signing : LinkSigning or None
        How the link is signed; None: it is not, and who has signed what comes is not looked at.
    """

    player: Player | None = None

    def __init__(
        self,
        name: str,
        link: Link,
        clock_us: Callable[[], int],
        signing: LinkSigning | None = None,
    ) -> None:
        self.name = name
        self.vehicles = Vehicles()
        self._link = link
        self._clock_us = clock_us
        self._signing = signing
        self._asking = Asking(signing)
        self._parsers: dict[str, FrameParser] = {}
        self._latest_us = 0

    @property
    def now_us(self) -> int:
        """The time, which never goes back, even where the system's clock is set."""
        self._latest_us = max(self._latest_us, self._clock_us())
        return self._latest_us

    @property
    def rejected(self) -> Mapping[str, int]:
        """Frames that were not taken for their signatures, by reason."""
        return self._signing.rejected if self._signing else {}

    async def run(self) -> None:
        """Listen, and ask for what is shown."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._link.run(self._receive))
            while True:
                if self._signing:
                    self._signing.key.advance(self.now_us)
                for raw in self._asking.advance(self.vehicles, self.now_us):
                    self._link.send(raw)
                await asyncio.sleep(TICK_S)

    def _receive(self, data: bytes, peer: str) -> Worth:
        parser = self._parsers.get(peer) or FrameParser()
        remember(self._parsers, peer, parser, MOST_PEERS)
        table = parser.receive_table(data)
        if self._signing:
            self._signing.key.advance(self.now_us)
            table = self._signing.taken(table)
        self.vehicles.take(table, np.full(len(table), self.now_us, np.uint64), peer)
        return Worth.SAMPLES if table.cuts["known"].any() else Worth.NOTHING  # all of it is shown


class Log:
    """A recording that is played."""

    rejected: Mapping[str, int] = {}

    def __init__(self, name: str, player: Player) -> None:
        self.name = name
        self.player = player

    @property
    def vehicles(self) -> Vehicles:
        """What is known at this point of the log."""
        return self.player.vehicles

    @property
    def now_us(self) -> int:
        """The log's time."""
        return self.player.now_us

    async def run(self) -> None:
        """Play."""
        loop = asyncio.get_running_loop()
        last_s = loop.time()
        while True:
            await asyncio.sleep(TICK_S)
            now_s = loop.time()
            self.player.advance(now_s - last_s)
            last_s = now_s
