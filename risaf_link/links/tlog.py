"""A recording of what was received and sent, as a ground station writes it."""

import asyncio
import contextlib
import io
import itertools
import os
import threading
from collections.abc import Callable
from pathlib import Path

from risaf_link.links.link import BACKOFF, Backoff, Connection, Link, Receive
from risaf_link.mavlink.tlog import RECEIVED, SENT, record

MOST_WAITING = 65536  # records
FLUSH_S = 1.0


def _append(file: io.FileIO, data: bytes) -> None:
    """Write all of it or, if that fails, nothing: half a record would spoil what follows."""
    end = file.seek(0, os.SEEK_END)
    rest = memoryview(data)
    try:
        while rest:
            rest = rest[file.write(rest) :]
        os.fdatasync(file.fileno())  # vehicles are switched off, not shut down
    except OSError:
        file.truncate(end)
        raise


class TlogLink(Link):
    """A recording. Nothing is ever received from it.

    Records wait in memory from the first on, and a thread writes them each second: a memory card
    can take longer over a write than a serial port's buffer lasts.

    Parameters
    ----------
    name : str
        What the log calls it.
    path : Path
        The file. One that exists is kept: NAME.1.tlog, NAME.2.tlog ... are taken instead.
    clock_us : Callable
        Microseconds since 1970.
    backoff : Backoff
        How long it waits before it tries the file again.
    flush_s : float
        How often it writes.

    Attributes
    ----------
    path : Path
        The file that is written in fact, once it is open.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        clock_us: Callable[[], int],
        backoff: Backoff = BACKOFF,
        flush_s: float = FLUSH_S,
    ) -> None:
        super().__init__(name, backoff)
        self.path = path
        self._clock_us = clock_us
        self._flush_s = flush_s
        self._made = False
        self._waiting: list[bytes] = []  # the loop's thread appends, the writing one removes
        self._writing = threading.Lock()

    def record(self, received_us: int, raw: bytes) -> None:
        """Record a frame that was received."""
        self._put(received_us, RECEIVED, raw)

    def send(self, data: bytes) -> None:
        """Record a frame that we send."""
        self._put(self._clock_us(), SENT, data)

    def _put(self, time_us: int, link: int, raw: bytes) -> None:
        if len(self._waiting) == MOST_WAITING:
            self.counts.dropped_out += 1
        else:
            self._waiting.append(record(time_us, raw, link))

    async def run(self, receive: Receive) -> None:
        """Write what was and will be recorded until cancelled; trouble with the file is retried."""
        try:
            await super().run(receive)
        finally:
            self.counts.dropped_out += len(self._waiting)
            self._waiting.clear()

    async def _hold(self, connection: Connection) -> None:
        with self._open() as file:
            try:
                await asyncio.to_thread(self._write, file)
                connection.up(str(self.path))
                while True:
                    await asyncio.sleep(self._flush_s)
                    await asyncio.to_thread(self._write, file)
            except asyncio.CancelledError:
                with contextlib.suppress(OSError):
                    self._write(file)
                raise

    def _open(self) -> io.FileIO:
        """Make the file under the first name that is free; once made it is gone on with."""
        if self._made:
            return io.FileIO(self.path, "a")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        path = self.path
        for number in itertools.count(1):
            if not path.exists():
                break
            path = self.path.with_stem(f"{self.path.stem}.{number}")
        file = io.FileIO(path, "x")
        self.path, self._made = path, True
        return file

    def _write(self, file: io.FileIO) -> None:
        """Write what waits; if that fails it goes on waiting."""
        with self._writing:
            count = len(self._waiting)
            data = b"".join(self._waiting[:count])
            _append(file, data)
            del self._waiting[:count]
            self.counts.bytes_out += len(data)
