"""Signing keys and what must outlast a restart, in files that nobody else may read.

A key file holds 32 bytes, as they are or as 64 hexadecimal digits. Beside it lies NAME.state, the
clock and the streams of that key. Both are replaced whole or not at all.
"""

import asyncio
import logging
import threading
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from risaf_link.config import Config
from risaf_link.errors import ConfigError
from risaf_link.mavlink.signing import (
    KEY_SIZE,
    KeySnapshot,
    LinkSigning,
    Rejection,
    SigningKey,
    SigningParameters,
    SigningState,
)
from risaf_link.private import read_private
from risaf_link.whole import replace_file

PRIVATE = 0o600
AGAIN_S = 5.0  # after what could not be stored; half of the clocks' reserve is 15 s
TELL_REJECTED_S = 60.0  # from one line on rejected frames to the next
EXPECTED = f"{KEY_SIZE} bytes or {2 * KEY_SIZE} hexadecimal digits, not all zero"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeyFile:
    """One key and where it is kept.

    Attributes
    ----------
    path : Path
    key : SigningKey
    """

    path: Path
    key: SigningKey
    _writing: threading.Lock = field(default_factory=threading.Lock)

    def write(self, snapshot: KeySnapshot) -> str:
        """Write what is to be stored; why that failed, or nothing. A thread may do it."""
        files = [(state_path(self.path), msgspec.json.encode(snapshot.state))]
        if snapshot.secret:
            files.insert(0, (self.path, f"{snapshot.secret.hex()}\n".encode()))
        with self._writing:
            for path, content in files:
                try:
                    replace_file(path, content, PRIVATE)
                except OSError as error:
                    return f"{path}: {error.strerror or error}"
        return ""


class Keys:
    """All keys of a configuration, and the links that are signed with them.

    Parameters
    ----------
    files : iterable of KeyFile
    links : dict
        Link's name to how it is signed.

    Attributes
    ----------
    links : dict
        As given.
    """

    def __init__(self, files: Iterable[KeyFile], links: dict[str, LinkSigning]) -> None:
        self.links = links
        self._files = tuple(files)
        self._next_s = 0.0  # when what is due is stored at the earliest
        self._failure = ""
        self._told_rejected: Counter[str] = Counter()
        self._next_telling_s = 0.0

    @property
    def rejected(self) -> Counter[str]:
        """Frames that were not taken, by link and reason."""
        return Counter(
            {
                f"{link}: {reason}": count
                for link, signing in self.links.items()
                for reason, count in signing.rejected.items()
            }
        )

    def advance(self, unix_us: int) -> None:
        """Set the clocks of all keys to a time that is not before theirs."""
        for file in self._files:
            file.key.advance(unix_us)

    def open(self) -> None:
        """Store what the clocks will not fall behind, before anything is signed.

        Raises
        ------
        ConfigError
            If that cannot be stored.
        """
        for file in self._files:
            snapshot = file.key.snapshot()
            failure = file.write(snapshot)
            if failure:
                raise ConfigError(f"{failure}: a signing key's clock has to be stored there")
            file.key.stored(snapshot)

    def is_due(self, now_s: float) -> bool:
        """Whether `store` has something to do, at a time in seconds that does not jump."""
        due = now_s >= self._next_s and any(file.key.is_due for file in self._files)
        if due:
            self._next_s = now_s + AGAIN_S
        return due

    async def store(self) -> None:
        """Store what is due, in a thread: a memory card can take longer than an epoch."""
        failure = ""
        for file in self._files:
            if file.key.is_due:
                snapshot = file.key.snapshot()
                failed = await asyncio.to_thread(file.write, snapshot)
                failure = failure or failed
                if not failed:
                    file.key.stored(snapshot)
        if not failure:
            self._next_s = 0.0
        elif failure != self._failure:
            _log.error("a signing key's clock is not stored: %s", failure)
        self._failure = failure

    def tell_rejected(self, now_s: float) -> None:
        """Say in the log what was rejected, if there is more, but not all the time."""
        if now_s < self._next_telling_s or not self.links:
            return
        rejected = self.rejected
        if rejected == self._told_rejected:
            return
        self._next_telling_s = now_s + TELL_REJECTED_S
        new = sorted((rejected - self._told_rejected).items())
        self._told_rejected = rejected
        counts = ", ".join(f"{reason} {count}" for reason, count in new)
        only_again = all(reason.endswith(Rejection.REPLAYED) for reason, _ in new)
        level = logging.INFO if only_again else logging.WARNING  # networks repeat and overtake
        _log.log(level, "rejected for their signatures: %s", counts)

    def close(self) -> None:
        """Store the clocks as they are."""
        for file in self._files:
            file.write(file.key.snapshot(is_last=True))


def state_path(path: Path) -> Path:
    """Where the state of a key is kept."""
    return path.with_name(f"{path.name}.state")


def open_keys(config: Config) -> Keys:
    """Read the keys that the links name. A file that several name is one key.

    Raises
    ------
    ConfigError
        In one line: which key of the configuration, what was found, what was expected.
    """
    files: dict[Path, KeyFile] = {}
    links: dict[str, LinkSigning] = {}
    for i, link in enumerate(config.links):
        if link.signing is None:
            continue
        path = Path(link.signing.key).absolute()
        where = f"links.{i}.signing.key: {path}: "
        if path not in files:
            secret = _read_secret(path, where, may_be_missing=_may_be_set_up(config, path))
            files[path] = KeyFile(path, SigningKey(secret, _read_state(path, where)))
        link_id = i % 256 if link.signing.link_id is None else link.signing.link_id
        links[link.name] = LinkSigning(files[path].key, link_id, link.signing)
    return Keys(files.values(), links)


def open_key(path: Path, where: str) -> LinkSigning:
    """Read a key for a link of a program that is only there for a while: it stores nothing.

    Its clock is the system's, set forward by what comes rightly signed from one that is ahead.

    Parameters
    ----------
    path : Path
    where : str
        Which option names it; every error begins so.

    Raises
    ------
    ConfigError
        As `open_keys` does.
    """
    secret = _read_secret(path, f"{where}: {path}: ", may_be_missing=False)
    return LinkSigning(SigningKey(secret), 0, SigningParameters(str(path)))


def _may_be_set_up(config: Config, path: Path) -> bool:
    """Whether some link may bring a key."""
    signings = [link.signing for link in config.links if link.signing]
    return any(each.setup and Path(each.key).absolute() == path for each in signings)


def _read_secret(path: Path, where: str, may_be_missing: bool) -> bytes:
    content = read_private(path, where)
    if content is None:
        if may_be_missing:
            return b""
        raise ConfigError(f"{where}found no file, expected {EXPECTED}")
    if len(content) == KEY_SIZE:
        secret = content
    else:
        try:
            secret = bytes.fromhex(content.decode("ascii"))
        except ValueError:
            secret = b""
    if len(secret) != KEY_SIZE or not any(secret):  # what was found is not for everyone to read
        raise ConfigError(f"{where}found something else, expected {EXPECTED}")
    return secret


def _read_state(path: Path, where: str) -> SigningState:
    content = read_private(state_path(path), where)
    if content is None:
        return SigningState()
    try:
        return msgspec.json.decode(content, type=SigningState)
    except (msgspec.DecodeError, UnicodeDecodeError):
        _log.warning("%sfound %s damaged: the clock starts anew", where, state_path(path).name)
        return SigningState()
