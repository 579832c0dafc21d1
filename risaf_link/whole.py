"""Files that are there whole, or as they were before."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from risaf_link.errors import ConfigError, RisafError


def replace_file(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file, all or nothing, also if power fails; raises OSError.

    Parameters
    ----------
    path : Path
    content : bytes
    mode : int
        Who may read and write it, less what the process's umask takes off.
    """
    new = path.with_name(f"{path.name}.new")
    new.unlink(missing_ok=True)  # who may read it would be as before
    try:
        with open(new, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        with suppress(OSError):
            new.unlink(missing_ok=True)  # half a file
        raise
    _sync(path.parent)


@contextmanager
def written(path: Path, mode: str) -> Iterator[Any]:
    """Open a file that takes the place of another when the block has ended well.

    If it has not, nothing is left of it. What is no regular file, such as a pipe, is written as it
    is.

    Parameters
    ----------
    path : Path
        That the user has named.
    mode : str
        `w`, text, or `wb`, bytes.

    Raises
    ------
    ConfigError
        If it cannot be made.
    RisafError
        If it cannot be written, as when the disk is full.
    """
    path_in_fact = path.resolve()  # what a link points to is replaced, and not the link
    is_special = path.exists() and not path.is_file()
    new = path if is_special else path_in_fact.with_name(f"{path_in_fact.name}.new")
    try:
        raw = _Output(new, path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    try:
        buffered = io.BufferedWriter(raw)
        file: Any = buffered if mode == "wb" else io.TextIOWrapper(buffered, encoding="utf-8")
        yield file
        file.close()
        if not is_special:
            new.replace(path_in_fact)
    except BaseException:
        with suppress(OSError):
            raw.close()  # at once: what is still to be written would fail again
        if not is_special:
            new.unlink(missing_ok=True)
        raise


class _Output(io.FileIO):
    """A file that says in a line why it cannot be written."""

    def __init__(self, path: Path, name: Path) -> None:
        super().__init__(path, "w")
        self._told = name

    def write(self, data: Any, /) -> int:
        """Write."""
        try:
            return super().write(data)
        except OSError as error:
            raise RisafError(f"{self._told}: {error.strerror or error}") from None


def _sync(directory: Path) -> None:
    """Make sure that a file's new name lasts."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
