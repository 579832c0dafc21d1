"""A recording of what was received and sent, as a ground station writes it."""

import asyncio
import fcntl
import itertools
import json
import logging
import os
import re
import select
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, Any

from msgspec import Meta, Struct, structs

from risaf_link.links import recorder
from risaf_link.links.link import BACKOFF, Backoff, Connection, Link, Receive
from risaf_link.mavlink.tlog import RECEIVED, SENT, record

FLUSH_S = 1.0
LEAVE_S = 5.0  # that the end waits for the recorder: a network disk may hang for ever
TELL_LOST_S = 60.0  # from one line on lost records to the next
MOST_WAITING = 65536  # records in our memory, while the pipes are full or not there
PIPES = 8  # of a megabyte each
ROOM = select.PIPE_BUF - recorder.HEAD.size  # bytes of records that go into a pipe whole or not

_log = logging.getLogger(__name__)


class RecordingParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How a recording is cut into files, and what it may take of the disk."""

    segment_bytes: Annotated[int, Meta(ge=1_000_000)] = 256_000_000
    segment_s: Annotated[float, Meta(ge=1.0)] = 3600.0
    most_bytes: Annotated[int, Meta(ge=4_000_000)] | None = None  # None: no limit
    least_free_bytes: Annotated[int, Meta(ge=0)] = 512_000_000


DEFAULTS = RecordingParameters()


def overlap(one: Path, other: Path) -> bool:
    """Whether two recordings would have files of the same name."""
    return one.parent.resolve() == other.parent.resolve() and any(
        re.fullmatch(recorder.names_of(a.name), b.name) for a, b in ((one, other), (other, one))
    )


class Pipes:
    """Records on their way to the recorder: they outlive both sides of it.

    What is written goes in whole or not at all, and what is read is all there is. When one is full
    the next is taken: together they hold three seconds of 300 sensors at 1 kHz.
    """

    def __init__(self) -> None:
        self.outs: list[int] = []
        self._ins: list[int] = []
        self._number = 0
        for _ in range(PIPES):
            out, into = os.pipe()
            self.outs.append(out)
            self._ins.append(into)
            with suppress(OSError):  # if many pipes are open the system allows us less
                fcntl.fcntl(into, fcntl.F_SETPIPE_SZ, recorder.PIPE_BYTES)
            os.set_blocking(into, False)

    def put(self, records: bytes, count: int) -> bool:
        """Write records of no more than `ROOM` together; False: there is no room."""
        head = recorder.HEAD.pack(recorder.MARK, len(records), count, self._number)
        for _ in self.outs:
            try:
                os.write(self._ins[0], head + records)
            except BlockingIOError:
                self._ins.append(self._ins.pop(0))
            else:
                self._number += 1
                return True
        return False

    def take(self) -> list[recorder.Message]:
        """Read what the recorder has not."""
        ready, _, _ = select.select(self.outs, [], [], 0)
        found = [recorder.cut(os.read(out, recorder.PIPE_BYTES))[0] for out in ready]
        return [message for _, message in sorted(itertools.chain(*found))]

    def end(self) -> None:
        """Say that nothing will come any more."""
        while self._ins:
            os.close(self._ins.pop())

    def close(self) -> None:
        """Close both sides."""
        self.end()
        while self.outs:
            os.close(self.outs.pop())


class TlogLink(Link):
    """A recording. Nothing is ever received from it.

    Records go through pipes to a process of its own, which writes them: a disk that takes its
    time holds nobody up, and what was handed over is written though the service be killed. They
    wait in memory only before that process has started, and if it takes nothing.

    Parameters
    ----------
    name : str
        What the log calls it.
    path : Path
        The first file. One that exists is kept: NAME.1.tlog, NAME.2.tlog ... follow.
    clock_us : Callable
        Microseconds since 1970.
    backoff : Backoff
        How long it waits before it starts a recorder again that died.
    flush_s : float
        How often what was written is made durable, and after trouble tried again.
    limits : RecordingParameters

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
        limits: RecordingParameters = DEFAULTS,
    ) -> None:
        super().__init__(name, backoff)
        self.path = path
        self._clock_us = clock_us
        self._options = structs.asdict(limits) | {
            "path": str(path),
            "most_bytes": limits.most_bytes or 0,
            "flush_s": flush_s,
            "retry_s": flush_s,
        }
        self._pipes: Pipes | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._waiting: deque[recorder.Message] = deque()  # for the pipes
        self._waiting_records = 0
        self._handed = self._written = 0  # records that went into the pipes, and were written
        self._bytes = 0  # that it told of
        self._failure: str | None = None  # that it told of; None: nothing yet
        self._told_lost = 0
        self._next_telling_s = 0.0

    @property
    def trouble(self) -> str:
        """Why nothing is written just now; empty: it is, or will be soon."""
        return self._failure or ""

    def record(self, received_us: int, *frames: bytes) -> None:
        """Record frames that were received."""
        self._put([record(received_us, raw, RECEIVED) for raw in frames])

    def send(self, data: bytes) -> None:
        """Record a frame that we send."""
        self._put([record(self._clock_us(), data, SENT)])

    def _put(self, records: Sequence[bytes]) -> None:
        """Hand records over; what can neither be handed over nor wait is lost and counted."""
        for message in _messages(records):
            _, count = message
            if self._waiting_records + count > MOST_WAITING:
                self.counts.dropped_out += count
                self._tell_lost()
            else:
                self._waiting.append(message)
                self._waiting_records += count
        self._hand_over()

    def _hand_over(self) -> None:
        """Put into the pipes what waits and goes in."""
        while self._waiting and self._pipes is not None and self._pipes.put(*self._waiting[0]):
            _, count = self._waiting.popleft()
            self._waiting_records -= count
            self._handed += count

    async def run(self, receive: Receive) -> None:
        """Record until cancelled; trouble with the disk or the recorder is retried."""
        try:
            await super().run(receive)
        finally:
            self.counts.dropped_out += self._handed - self._written + self._waiting_records
            self._handed = self._written = self._waiting_records = 0
            self._waiting.clear()
            if self._pipes is not None:
                self._pipes.close()
                self._pipes = None
            self._tell_lost(at_once=True)

    async def _hold(self, connection: Connection) -> None:
        if self._pipes is None:
            self._pipes = Pipes()
            self._hand_over()
        process, lines = self._start(self._pipes)
        try:
            await self._listen(lines, connection)
            status = process.wait()  # it has closed all its files: that is its very end
            self._recover(self._pipes.take())
            raise ChildProcessError(f"the recorder has ended with status {status}")
        except asyncio.CancelledError:
            self._hand_over()
            self._pipes.end()
            try:
                async with asyncio.timeout(LEAVE_S):
                    await self._listen(lines, connection)
                process.wait()
            except TimeoutError:
                _log.warning("%s: the disk hangs: the recorder goes on alone", self.name)
            raise
        finally:
            self._process = None
            asyncio.get_running_loop().remove_reader(_stdout(process))
            _stdout(process).close()

    def _start(self, pipes: Pipes) -> tuple[subprocess.Popen[bytes], asyncio.StreamReader]:
        """Start a recorder; the lines that it tells.

        It must be there before anything is received, so this waits the millisecond that it takes.
        """
        options = json.dumps(self._options | {"pipes": pipes.outs})
        command = [sys.executable, "-I", "-S", recorder.__file__, options]
        self._process = process = subprocess.Popen(  # noqa: S603
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=pipes.outs,
            cwd="/",
            start_new_session=True,
        )
        self._bytes, self._failure = 0, None
        told, lines = _stdout(process), asyncio.StreamReader()

        def read() -> None:
            data = os.read(told.fileno(), select.PIPE_BUF)
            if data:
                lines.feed_data(data)
            else:
                lines.feed_eof()
                loop.remove_reader(told)

        loop = asyncio.get_running_loop()
        loop.add_reader(told, read)
        return process, lines

    def _recover(self, left: list[recorder.Message]) -> None:
        """Keep for the next recorder what this one has not taken; count what it took with it."""
        count = sum(count for _, count in left)
        self.counts.dropped_out += self._handed - self._written - count
        self._handed = self._written = 0
        self._waiting.extendleft(reversed(left))
        self._waiting_records += count
        self._hand_over()

    async def _listen(self, lines: asyncio.StreamReader, connection: Connection) -> None:
        """Take what the recorder tells, to its end."""
        async for line in lines:
            try:
                told = json.loads(line)
            except ValueError:  # it dies, and says why
                _log.warning("%s: %s", self.name, line.decode(errors="replace").rstrip())
                continue
            if "deleted" in told:
                # That it deletes by its total is routine; that a disk gets full is not.
                level = logging.INFO if told["why"] == "most_bytes" else logging.WARNING
                _log.log(level, "%s: deleted %s: %s", self.name, told["deleted"], told["why"])
            else:
                self._note(told, connection)

    def _note(self, state: dict[str, Any], connection: Connection) -> None:
        """Take what the recorder says of itself."""
        written = max(state["bytes"], self._bytes)  # some may have to be written again
        self.counts.bytes_out += written - self._bytes
        self._bytes, self._written = written, state["records"]
        failure, path = state["failure"], Path(state["path"] or self.path)
        if failure and failure != self._failure:
            _log.warning("%s: down: %s", self.name, failure)
        elif not failure and (self._failure is None or self._failure):
            connection.up(str(path))
        elif path != self.path:
            _log.info("%s: goes on in %s", self.name, path)
        self.path, self._failure = path, failure
        self._hand_over()
        self._tell_lost()

    def _tell_lost(self, at_once: bool = False) -> None:
        """Say how many records are lost, if there are more, but not all the time."""
        if self.counts.dropped_out == self._told_lost:
            return
        now_s = time.monotonic()
        if at_once or now_s >= self._next_telling_s:
            self._next_telling_s = now_s + TELL_LOST_S
            self._told_lost = self.counts.dropped_out
            _log.warning("%s: %d records lost so far", self.name, self._told_lost)


def _messages(records: Sequence[bytes]) -> Iterator[recorder.Message]:
    """Put records together that go into a pipe at once."""
    part: list[bytes] = []
    size = 0
    for one in records:
        if part and size + len(one) > ROOM:
            yield b"".join(part), len(part)
            part, size = [], 0
        part.append(one)
        size += len(one)
    if part:
        yield b"".join(part), len(part)


def _stdout(process: subprocess.Popen[bytes]) -> IO[bytes]:
    assert process.stdout is not None  # noqa: S101 it is a pipe
    return process.stdout
