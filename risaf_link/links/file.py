"""Bytes from a file."""

from collections.abc import Callable, Iterator
from pathlib import Path

from risaf_link.errors import LogError

CHUNK = 1 << 20  # bytes; with less, or more, a log takes longer


def read(path: Path, progress: Callable[[int], None] = lambda _: None) -> Iterator[bytes]:
    """Read a log piece by piece.

    Parameters
    ----------
    path : Path
    progress : callable
        Called with the size of every piece.

    Raises
    ------
    LogError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                progress(len(chunk))
                yield chunk
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from None
