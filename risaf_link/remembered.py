"""What is known of array and attitude, in a file that outlasts a crash or a loss of power.

    {"version": 1, "memory": {...}}    JSON; of the covariance its lower triangle

The file is replaced as a whole. What is in it is believed no further than `core.warm` says, and a
file that is damaged, or another program's, is no reason not to start.
"""

import asyncio
import errno
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from risaf_link.config import Config
from risaf_link.core.memory import Memory
from risaf_link.whole import replace_file

VERSION = 1
LARGEST = 4_000_000  # bytes; 1000 sensors take 200 kB
USED = ".used"  # behind the name of the file: what the last start found there

_log = logging.getLogger(__name__)


class MemoryFile:
    """Where a memory is kept.

    Parameters
    ----------
    path : Path or None
        None: nowhere.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._failure = ""

    @property
    def is_named(self) -> bool:
        """Whether there is a place for it."""
        return self._path is not None

    def read(self) -> Memory | None:
        """Read it; None: there is none, or none that can be used, which is said in the log."""
        if self._path is None:
            return None
        try:
            with self._path.open("rb") as file:
                return decoded(file.read(LARGEST + 1))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            _log.warning("%s: %s; the start is cold", self._path, reason)
            return None

    def keep_used(self) -> None:
        """Keep a copy of what is there: a replay of what follows begins with it."""
        if self._path is None:
            return
        try:
            copy = self._path.with_name(self._path.name + USED)
            replace_file(copy, self._path.read_bytes(), 0o600)
        except OSError as error:
            _log.warning("%s%s: not kept: %s", self._path, USED, error.strerror)

    def write(self, memory: Memory) -> bool:
        """Replace it; whether that could be done. A failure is said in the log, once."""
        if self._path is None:
            return False
        try:
            replace_file(self._path, encoded(memory), 0o600)
        except OSError as error:
            failure = error.strerror or errno.errorcode.get(error.errno or 0, "failed")
            if failure != self._failure:
                _log.warning("%s: not written: %s", self._path, failure)
            self._failure = failure
            return False
        self._failure = ""
        return True


class MemoryKeeper:
    """Keeps what is known in a file, again and again as it changes.

    Parameters
    ----------
    file : MemoryFile
    period : float
        Seconds from one time to the next.
    memory : callable
        Tells what is known now; None: nothing.
    """

    def __init__(
        self, file: MemoryFile, period: float, memory: Callable[[], Memory | None]
    ) -> None:
        self._file = file
        self._period = period
        self._memory = memory
        self._next_s = 0.0
        self._kept_us = 0  # when what was last kept was received
        self._is_storing = False

    def due(self, now_s: float) -> Memory | None:
        """What is to be stored, at a time in seconds that does not jump; None: nothing."""
        if not self._file.is_named or now_s < self._next_s or self._is_storing:
            return None
        self._next_s = now_s + self._period
        memory = self._memory()
        if memory is None or memory.received_us == self._kept_us:
            return None
        self._kept_us = memory.received_us
        self._is_storing = True
        return memory

    async def store(self, memory: Memory) -> None:
        """Store what was due, in a thread: a memory card can take longer than an epoch."""
        try:
            await asyncio.to_thread(self._file.write, memory)
        finally:
            self._is_storing = False

    def end(self) -> None:
        """Store what is known at the end."""
        memory = self._memory() if self._file.is_named else None
        if memory is not None and not self._is_storing:
            self._file.write(memory)


def memory_file(config: Config) -> MemoryFile:
    """Where a configuration keeps its memory."""
    return MemoryFile(Path(config.state.file) if config.state.file else None)


def encoded(memory: Memory) -> bytes:
    """A memory as a file has it; biases to 1e-10, times to a millisecond."""
    tree = msgspec.to_builtins(memory, enc_hook=lambda array: array.tolist())
    for kind in ("gyros", "accelerometers"):
        channels = getattr(memory, kind).channels
        digits = (10, 3, 10, 3, 3)  # as CHANNELS
        rounded = map(np.round, channels, digits)
        tree[kind]["channels"] = [row.tolist() for row in rounded]
    whole = enumerate(tree["attitude"]["covariance"], 1)
    tree["attitude"]["covariance"] = [row[:length] for length, row in whole]
    return msgspec.json.encode({"version": VERSION, "memory": tree})


def decoded(content: bytes) -> Memory:
    """A memory from a file.

    Raises
    ------
    ValueError
        What was found, in one line.
    """
    if len(content) > LARGEST:
        raise ValueError(f"found more than {LARGEST} bytes, expected a state")
    try:
        tree = msgspec.json.decode(content)
        version = tree["version"]
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, TypeError, KeyError):
        raise ValueError("found something else or half of it, expected a state") from None
    if version != VERSION:
        raise ValueError(f"found version {version!r:.20}, expected {VERSION}")
    try:
        memory = msgspec.convert(tree["memory"], Memory, dec_hook=_array)
        sound = memory.is_sound
    except (KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError):
        sound = False
    if not sound:
        raise ValueError("found a state that cannot be, expected one of an array")
    return memory


def _array(_: type, found: Any) -> Any:
    if len(found) > 1 and isinstance(found[-1], list) and len(found[0]) == 1 < len(found[-1]):
        lower = np.zeros((len(found), len(found)))
        lower[np.tril_indices(len(found))] = np.concatenate(found)
        return lower + np.tril(lower, -1).T
    return np.array(found, float)
