"""The daemon: links on one side, the pipeline on the other, and nothing between that waits."""

import asyncio
import logging
import signal
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import suppress
from functools import partial
from typing import Any

from risaf_link.config import Config, LinkParameters, load_calibration
from risaf_link.core.estimate import Estimate
from risaf_link.links import Link, TlogLink, open_link
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.telemetry import ComponentState, Emitter
from risaf_link.pipeline import Pipeline

HEARTBEAT_S = 1.0
STALLED_S = 2.0  # without an epoch
MOST_PEERS = 256  # of all links together

_log = logging.getLogger(__name__)


def unix_us() -> int:
    """Microseconds since 1970."""
    return time.time_ns() // 1000


async def until_told(work: Coroutine[Any, Any, None]) -> None:
    """Run until done, or until SIGINT or SIGTERM ask for the end."""
    task = asyncio.ensure_future(work)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with suppress(asyncio.CancelledError):
        await task


class Service:
    """Runs the pipeline on live links.

    What a link receives goes through the pipeline at once, in the link's own callback; the frames
    that come of it are handed to all links before it returns.

    Parameters
    ----------
    config : Config
    clock_us : callable
        Microseconds since 1970.

    Raises
    ------
    ConfigError
        If the calibration cannot be used.
    """

    def __init__(self, config: Config, clock_us: Callable[[], int] = unix_us) -> None:
        self.pipeline = Pipeline(config, config.own, load_calibration(config))
        self._clock_us = clock_us
        self._ports = [self._port(config, link) for link in config.links]
        self._recordings = [link for link, _ in self._ports if isinstance(link, TlogLink)]
        self._parsers: dict[tuple[str, str], FrameParser] = {}
        self._frames = 0
        self._received_us = 0
        self._mismatch = ""

    @property
    def links(self) -> list[Link]:
        """The links, in the order of the configuration."""
        return [link for link, _ in self._ports]

    @property
    def dropped(self) -> Counter[str]:
        """Frames that were lost in parsing, by reason, from the peers that are remembered."""
        return sum((parser.dropped for parser in self._parsers.values()), Counter())

    async def run(self) -> None:
        """Run until cancelled."""
        _log.info("started: %s", ", ".join(link.name for link in self.links) or "no links")
        try:
            async with asyncio.TaskGroup() as tasks:
                for link in self.links:
                    tasks.create_task(link.run(partial(self._receive, link)))
                try:
                    await self._beat()
                finally:  # the links are still open
                    for block in self.pipeline.flush(self._received_us):
                        self._send(list(block))
        finally:
            counts = self.pipeline.assembler.counts
            _log.info("ended: %d frames, %d epochs", self._frames, counts["epochs"])

    def _port(self, config: Config, link: LinkParameters) -> tuple[Link, Emitter | None]:
        rates = config.emit if link.emit is None else link.emit
        emitter = Emitter(rates, *config.own) if rates else None
        return open_link(link.url, link.name, self._clock_us), emitter

    def _receive(self, link: Link, data: bytes, peer: str) -> None:
        """Take what came over a link, and send what comes of it."""
        self._received_us = received_us = self._clock_us() & ~3  # as a recording keeps it
        for frame in self._parser(link.name, peer).receive_data(data):
            self._frames += 1
            for recording in self._recordings:
                recording.record(received_us, frame.raw)
            self._send(self.pipeline.step(frame, received_us))
        self._tell_mismatch()

    def _send(self, estimates: list[Estimate]) -> None:
        for estimate in estimates:
            for link, emitter in self._ports:
                for raw in emitter.emit(estimate) if emitter else ():
                    link.send(raw)

    def _parser(self, link: str, peer: str) -> FrameParser:
        parser = self._parsers.pop((link, peer), None) or FrameParser()
        self._parsers[link, peer] = parser  # the one that spoke last is last
        if len(self._parsers) > MOST_PEERS:
            del self._parsers[next(iter(self._parsers))]
        return parser

    def _tell_mismatch(self) -> None:
        if self.pipeline.mismatch != self._mismatch:
            self._mismatch = self.pipeline.mismatch
            if self._mismatch:
                _log.error("no estimates: array.calibration: %s", self._mismatch)

    async def _beat(self) -> None:
        """Send HEARTBEAT once a second; what it says follows the estimator's progress."""
        epochs, still_s = 0, 0.0
        while True:
            progress = self.pipeline.assembler.counts["epochs"]
            still_s = 0.0 if progress != epochs else still_s + HEARTBEAT_S
            epochs = progress
            state = ComponentState.ACTIVE if still_s < STALLED_S else ComponentState.CRITICAL
            for link, emitter in self._ports:
                if emitter:
                    link.send(emitter.heartbeat(state if epochs else ComponentState.BOOT))
            await asyncio.sleep(HEARTBEAT_S)
