"""The process that writes a recording, and lives on when the service is killed.

`TlogLink` runs this file by its path, so that nothing but the standard library is imported: 10 MB.
It reads messages from pipes: `HEAD`, then whole records. There are several, as none may be larger
than a megabyte: when one is full the next is taken, and numbers tell the order. What is in them
outlives the service, and this process ends when it has written all of it and nobody holds the
other ends any more; signals that mean the service do not end it.

One thread empties the pipes into memory, the other writes: a card or a network disk may take its
time, and until memory is full nobody notices. Standard output carries a line of JSON whenever
something has changed: `path`, `failure`, `records` and `bytes` written so far; or `deleted`, `why`.
"""

import errno
import json
import os
import re
import select
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

HEAD = struct.Struct("<HHHQ")  # MARK, bytes that follow, records that they are, which message
MARK = 0x7454
PIPE_BYTES = 1 << 20  # what Linux lets everybody have
PAUSE_S = 0.02  # between two looks into the pipes
MOST_WAITING = 32 << 20  # bytes in memory: 15 s of 300 sensors at 1 kHz, 5 min of 150 at 100 Hz
MOST_UNSYNCED = 4 << 20  # bytes that may have to be written again
MOST_AT_ONCE = 1 << 20  # bytes
SHARE_OF_ALL = 4  # segments that `most_bytes` holds at least
MODE = 0o640  # where a vehicle was is not for everybody on the computer

Message = tuple[bytes, int]  # whole records, and how many
Numbered = tuple[int, Message]
Tell = Callable[[dict[str, Any]], None]


def names_of(name: str) -> str:
    """A pattern of what the files of a recording are called, with the number of each."""
    stem, suffix = os.path.splitext(name)
    return re.escape(stem) + r"(?:\.([1-9][0-9]*))?" + re.escape(suffix)


def _tell_nobody(_: dict[str, Any]) -> None:
    pass


class Recording:
    """The files of one recording, of which the newest is written.

    They are called NAME.tlog, NAME.1.tlog, NAME.2.tlog ... in the order of their age. Each holds
    whole records. No file is ever opened that was there before.

    Parameters
    ----------
    path : str
        NAME.tlog.
    segment_bytes : int
        Size of a file that is followed by the next one.
    segment_s : float
        Age of one, likewise.
    most_bytes : int
        Of all files together, beyond which the oldest is deleted; 0: no limit.
    least_free_bytes : int
        On the disk, below which the oldest is deleted and, if there is none, nothing is written.
    flush_s : float
        How often what was written is made durable, and the disk is looked at.
    clock_s : callable
        Seconds, of a clock that nobody sets.
    tell : callable
        Takes `{"deleted": path, "why": reason}`.

    Attributes
    ----------
    path : str
        The file that is written, or was last; empty: none yet.
    records, bytes : int
        Written so far.
    """

    def __init__(  # noqa: PLR0913
        self,
        path: str,
        *,
        segment_bytes: int,
        segment_s: float,
        most_bytes: int = 0,
        least_free_bytes: int = 0,
        flush_s: float = 1.0,
        clock_s: Callable[[], float] = time.monotonic,
        tell: Tell = _tell_nobody,
    ) -> None:
        self._directory, name = os.path.split(path)
        self._stem, self._suffix = os.path.splitext(name)
        self._names = names_of(name)
        self._segment_bytes = min(segment_bytes, most_bytes // SHARE_OF_ALL or segment_bytes)
        self._segment_s = segment_s
        self._most_bytes = most_bytes
        self._least_free_bytes = least_free_bytes
        self._flush_s = flush_s
        self._clock_s = clock_s
        self._tell = tell
        self._file: int | None = None
        self._number = -1
        self._size = self._synced_size = 0
        self._unsynced: list[Message] = []
        self._others: list[tuple[str, int]] = []  # older segments and their sizes, oldest first
        self._others_bytes = 0
        self._room = 0  # bytes that may be written
        self._until_s = self._flush_due_s = self._look_due_s = 0.0
        self.path = ""
        self.records = self.bytes = 0

    def open(self) -> None:
        """Make the file, if there is none, and see whether there is room.

        Raises
        ------
        OSError
            The next call tries again.
        """
        if self._file is None:
            self._begin()
        self._make_room(0)

    def write(self, waiting: list[Message]) -> None:
        """Write what waits, and take it off the list.

        Raises
        ------
        OSError
            What is still on the list was not written, and no file holds half a record.
        """
        while waiting:
            file = self._turn(waiting)
            part = self._fitting(waiting)
            if self._append(file, part, waiting):
                del waiting[: len(part)]

    def flush(self, waiting: list[Message], at_once: bool = False) -> bool:
        """Make durable what was written, if that is due; tell whether it was.

        Raises
        ------
        OSError
            What is not on the disk is on the list again, before the rest.
        """
        unsynced = self._size - self._synced_size
        due = at_once or self._clock_s() >= self._flush_due_s or unsynced > MOST_UNSYNCED
        if due:
            self._sync(waiting)
        return due

    def close(self) -> None:
        """Close the file; the next one follows if there is more to write."""
        file, self._file, self._size, self._unsynced = self._file, None, 0, []
        if file is not None:
            with suppress(OSError):
                os.close(file)

    @property
    def rest_s(self) -> float | None:
        """For how long there is nothing to do if nothing comes; None: for ever."""
        return max(0.0, self._flush_due_s - self._clock_s()) if self._unsynced else None

    def _begin(self) -> int:
        """Make the next segment."""
        os.makedirs(self._directory, exist_ok=True)
        found = self._found()
        self._others = [(path, size) for _, path, size in sorted(found) if size is not None]
        self._others_bytes = sum(size for _, size in self._others)
        self._make_room(0)
        number = max([self._number, *(number for number, *_ in found)], default=-1)
        file = None
        while file is None:
            number += 1
            infix = f".{number}" if number else ""
            path = os.path.join(self._directory, f"{self._stem}{infix}{self._suffix}")
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
            with suppress(FileExistsError):  # somebody was faster
                file = os.open(path, flags, MODE)
        self._file, self.path, self._number = file, path, number
        self._size = self._synced_size = 0
        self._until_s = self._clock_s() + self._segment_s
        with suppress(OSError):  # some file systems cannot
            folder = os.open(self._directory, os.O_RDONLY)
            try:
                os.fsync(folder)  # a name can be lost as well
            finally:
                os.close(folder)
        return file

    def _found(self) -> list[tuple[int, str, int | None]]:
        """Numbers, paths and sizes of what bears the recording's names; None: no file."""
        found = []
        with os.scandir(self._directory) as entries:
            for entry in entries:
                name = re.fullmatch(self._names, entry.name)
                if name:
                    is_file = entry.is_file(follow_symlinks=False)
                    size = entry.stat(follow_symlinks=False).st_size if is_file else None
                    found.append((int(name[1] or 0), entry.path, size))
        return found

    def _turn(self, waiting: list[Message]) -> int:
        """Go on to the next segment, if this one is full or old, or there is none."""
        full = self._size + len(waiting[0][0]) > self._segment_bytes
        if self._size and (full or self._clock_s() >= self._until_s):
            self._end(waiting)
        return self._begin() if self._file is None else self._file

    def _fitting(self, waiting: list[Message]) -> list[Message]:
        """As many as the segment takes."""
        room = min(self._segment_bytes - self._size, MOST_AT_ONCE)
        part: list[Message] = []
        for message in waiting:
            room -= len(message[0])
            if part and room < 0:
                break
            part.append(message)
        return part

    def _append(self, file: int, part: list[Message], waiting: list[Message]) -> bool:
        """Write all of it or nothing; False: the file may not grow, another one is needed."""
        data = b"".join(data for data, _ in part)
        self._make_room(len(data))
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(file, rest) :]
        except OSError as error:
            self._cut(file, self._size)
            if error.errno != errno.EFBIG or not self._size:
                raise
            self._end(waiting)
            return False
        self._size += len(data)
        self._unsynced += part
        self.bytes += len(data)
        self.records += sum(records for _, records in part)
        return True

    def _make_room(self, size: int) -> None:
        """Delete the oldest segments as far as the limits ask for it."""
        while self._most_bytes and self._others:
            if self._others_bytes + self._size + size <= self._most_bytes:
                break
            self._delete("most_bytes")
        if not self._least_free_bytes:
            return
        now_s = self._clock_s()
        if now_s >= self._look_due_s:  # a file system may count late what was deleted
            disk = os.statvfs(self._directory)
            self._room = disk.f_bavail * disk.f_frsize - self._least_free_bytes
            self._look_due_s = now_s + self._flush_s
        while size > self._room and self._others:
            self._room += self._delete("least_free_bytes")
        if size > self._room:
            self._look_due_s = now_s
            text = f"less than {self._least_free_bytes} bytes are free"
            raise OSError(errno.ENOSPC, text, self._directory)
        self._room -= size

    def _delete(self, why: str) -> int:
        path, size = self._others[0]
        with suppress(FileNotFoundError):
            os.unlink(path)
            self._tell({"deleted": path, "why": why})
        del self._others[0]
        self._others_bytes -= size
        return size

    def _sync(self, waiting: list[Message]) -> None:
        if self._file is None:
            return
        self._flush_due_s = self._clock_s() + self._flush_s
        if self._unsynced:
            try:
                os.fdatasync(self._file)  # vehicles are switched off, not shut down
            except OSError:  # the system has given up what it held
                waiting[:0] = self._unsynced
                self.bytes -= sum(len(data) for data, _ in self._unsynced)
                self.records -= sum(records for _, records in self._unsynced)
                self._unsynced = []
                self._cut(self._file, self._synced_size)
                raise
            self._synced_size = self._size
            self._unsynced = []
        try:
            os.stat(self.path)
        except FileNotFoundError:  # somebody has removed it
            self.close()

    def _end(self, waiting: list[Message]) -> None:
        self._sync(waiting)
        self.close()

    def _cut(self, file: int, size: int) -> None:
        """Take off what follows; if that fails, nothing may follow it."""
        try:
            os.ftruncate(file, size)
            self._size = size
        except OSError:
            self.close()


class Inbox:
    """What came through the pipes and waits to be written.

    Parameters
    ----------
    pipes : sequence of int
        Where it comes from, file descriptors.

    Attributes
    ----------
    waiting : list of Message
        One thread appends, the other one removes.
    taken : int
        Bytes that came so far.
    more, ended : threading.Event
        Whether something has come since it was cleared, and whether nothing will any more.
    """

    def __init__(self, pipes: Sequence[int]) -> None:
        self._pipes = dict.fromkeys(pipes, b"")  # with the beginning of a message from each
        self._early: list[Numbered] = []  # others come before
        self._next: int | None = None
        self.waiting: list[Message] = []
        self.taken = 0
        self.more = threading.Event()
        self.ended = threading.Event()

    def fill(self, written: Callable[[], int]) -> None:
        """Empty the pipes until nobody holds their other ends.

        Parameters
        ----------
        written : callable
            How many of the bytes that came are written: the others are in memory.
        """
        hung_up, readable = select.poll(), select.poll()
        for pipe in self._pipes:
            hung_up.register(pipe, 0)
            readable.register(pipe, select.POLLIN)
        try:
            while self._pipes:
                while self.taken - written() > MOST_WAITING and not hung_up.poll(PAUSE_S * 1000):
                    pass
                for pipe, _ in readable.poll():
                    if not self._read(pipe):
                        readable.unregister(pipe)
                        hung_up.unregister(pipe)
                self._deliver(at_once=not self._pipes)
                self.more.set()
                time.sleep(PAUSE_S)
        finally:
            self.ended.set()
            self.more.set()

    def _read(self, pipe: int) -> bool:
        """Read all that is in a pipe; False: it has ended."""
        data = os.read(pipe, PIPE_BYTES)
        if not data:
            del self._pipes[pipe]
            return False
        messages, self._pipes[pipe] = cut(self._pipes[pipe] + data)
        self._early += messages
        return True

    def _deliver(self, at_once: bool) -> None:
        """Let them be written in their order."""
        self._early.sort()
        for count, (number, message) in enumerate(self._early):
            if self._next is not None and number > self._next and not at_once:
                del self._early[:count]
                return
            self._next = number + 1
            self.taken += len(message[0])
            self.waiting.append(message)
        self._early.clear()


def cut(data: bytes) -> tuple[list[Numbered], bytes]:
    """Cut what comes through a pipe into messages; the rest may be the beginning of one."""
    messages: list[Numbered] = []
    at = 0
    while len(data) - at >= HEAD.size:
        mark, size, records, number = HEAD.unpack_from(data, at)
        start = at + HEAD.size
        at = start + size
        if mark != MARK:  # nobody but us writes there, whole messages only
            return messages, b""
        if at > len(data):
            return messages, data[start - HEAD.size :]
        messages.append((number, (data[start:at], records)))
    return messages, data[at:]


def work(recording: Recording, inbox: Inbox, tell: Tell, retry_s: float) -> None:
    """Write what comes until nothing will come any more; trouble with the disk is retried.

    Parameters
    ----------
    recording : Recording
    inbox : Inbox
    tell : callable
        Takes the state whenever it has changed.
    retry_s : float
        How long it waits after trouble.
    """
    told: dict[str, Any] = {}
    ended = False
    while not ended:
        inbox.more.clear()
        ended = inbox.ended.is_set()  # what came before that is written now
        failure, changed = "", ended
        try:
            recording.open()
            recording.write(inbox.waiting)
            changed |= recording.flush(inbox.waiting, at_once=ended)
        except OSError as error:
            failure = f"{error.filename or recording.path}: {error.strerror}"
        state: dict[str, Any] = {"path": recording.path, "failure": failure}
        changed |= any(told.get(key) != value for key, value in state.items())
        state |= {"records": recording.records, "bytes": recording.bytes}
        if changed and state != told:
            tell(state)
            told = state
        if failure:
            inbox.ended.wait(retry_s)
        elif not ended:
            inbox.more.wait(recording.rest_s)


def main() -> None:
    """Record what the pipes bring; the argument is JSON: `path`, the limits and the pipes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    options = json.loads(sys.argv[1])
    retry_s, pipes = options.pop("retry_s"), options.pop("pipes")
    os.set_blocking(sys.stdout.fileno(), False)
    recording = Recording(**options, tell=_print)
    inbox = Inbox(pipes)
    filling = threading.Thread(target=inbox.fill, args=[lambda: recording.bytes], daemon=True)
    filling.start()
    work(recording, inbox, _print, retry_s)
    recording.close()


def _print(state: dict[str, Any]) -> None:
    """Tell the service, if it still listens: what is lost now is in the next line."""
    with suppress(OSError):
        os.write(sys.stdout.fileno(), json.dumps(state).encode() + b"\n")


if __name__ == "__main__":
    main()
