"""Files with secrets, that nobody but their owner may read."""

import os
import stat
from pathlib import Path

from risaf_link.errors import ConfigError

OTHERS = stat.S_IRWXG | stat.S_IRWXO
LARGEST = 65536  # bytes; the largest secret, a key in PEM, has some thousand


def read_private(path: Path, where: str) -> bytes | None:
    """Content of a file that nobody but its owner may read; None: there is none.

    Parameters
    ----------
    path : Path
    where : str
        Which key of the configuration names it; every error begins so.

    Raises
    ------
    ConfigError
        If others may read it, if it belongs to somebody else, or if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if status.st_mode & OTHERS:
                mode = stat.S_IMODE(status.st_mode)
                raise ConfigError(
                    f"{where}found {path.name} with mode {mode:04o}, expected 0600 or 0400: "
                    "readable by its owner alone"
                )
            if status.st_uid not in {0, os.geteuid()}:
                raise ConfigError(
                    f"{where}found {path.name} owned by user {status.st_uid}, "
                    f"expected {os.geteuid()}, who runs this"
                )
            content = file.read(LARGEST + 1)
            if len(content) > LARGEST:
                raise ConfigError(f"{where}found more than {LARGEST} bytes, expected a secret")
            return content
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{where}{error.strerror or error}") from None
