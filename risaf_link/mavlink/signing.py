"""Signing: who may speak to us, and how others know that it was us who spoke.

The signature of a frame is a link id, a time stamp and 48 bits of a hash over a secret that both
sides hold, the frame, link id and stamp. The stamp counts ticks of 10 us since 2015 and is a clock
only by courtesy: what matters is that it rises from frame to frame of a stream, which is all that
one component sends with one link id, so that nothing can be sent again by somebody who listened.

A key has one clock for all that is signed with it. It follows the system's clock, is set forward
by whatever comes rightly signed from a clock that is ahead, and never goes back, over a restart
neither: what is stored is a time that is not reached before it is stored anew, so that it holds
after a power cut as well.

Frames are hashed before their stamps are looked at: nobody without the key changes anything here.

https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
import hmac
from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame, FrameTable

KEY_SIZE = 32
TICKS_PER_S = 100_000
EPOCH_S = 1_420_070_400  # 2015-01-01 UTC, seconds since 1970
WINDOW = 60 * TICKS_PER_S  # that a stream may lag when it is first heard
RESERVE = 30 * TICKS_PER_S  # that the stored clock is ahead; within the window of others
LATEST = 2**48 - 2**32  # no clock shows more until 2104, and half a day is left to count on
MOST_STREAMS = 256  # of one key
ALWAYS_UNSIGNED = frozenset({IDS["RADIO_STATUS"]})
"""Messages that are taken unsigned by all: the radios that send them have no key."""

SETUP_SIGNING = IDS["SETUP_SIGNING"]

Stream = tuple[int, int, int]
"""Link id, system and component."""


class SigningParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """How one link is signed."""

    key: Annotated[str, Meta(min_length=1)]  # file
    link_id: Annotated[int, Meta(ge=0, le=255)] | None = None  # None: place among the links
    sign: bool = True  # what is sent
    accept_unsigned: bool | tuple[str, ...] = ()  # True: all messages
    setup: bool = False  # whether SETUP_SIGNING is obeyed


class Rejection(StrEnum):
    """Why a frame is not taken."""

    UNSIGNED = "unsigned"
    NO_KEY = "no_key"  # it is signed, but none was set up yet
    SIGNATURE = "signature"  # made with another key, or of another frame
    REPLAYED = "replayed"  # not later than the one before, of its stream
    LATE = "late"  # more than a minute behind, of a stream that was not heard before
    FUTURE = "future"  # no clock shows that
    STREAMS = "streams"  # there are too many


class SigningState(Struct, frozen=True, forbid_unknown_fields=True):
    """What a key's clock and streams must not fall behind, over a restart."""

    ticks: Annotated[int, Meta(ge=0, le=LATEST + RESERVE)] = 0
    streams: tuple[tuple[int, int, int, int], ...] = ()  # link id, system, component, last ticks


class KeySnapshot(Struct, frozen=True):
    """What is to be stored of a key."""

    secret: bytes  # none: the one that is stored
    state: SigningState

    def __repr__(self) -> str:  # no log shows a secret
        return f"KeySnapshot(state={self.state!r})"


class SetupSigning(Struct, frozen=True):
    """A SETUP_SIGNING message."""

    to: tuple[int, int]
    ticks: int
    secret: bytes

    def __repr__(self) -> str:
        return f"SetupSigning(to={self.to!r}, ticks={self.ticks!r})"


def ticks_at(unix_us: int) -> int:
    """Signing time at a time in microseconds since 1970."""
    return min(max(unix_us // 10 - EPOCH_S * TICKS_PER_S, 0), LATEST)


def hash_of(secret: bytes, content: bytes) -> bytes:
    """The last six bytes of a signed frame, whose other bytes are the content."""
    return hashlib.sha256(secret + content).digest()[:6]


def setup_in(frame: Frame) -> SetupSigning:
    """Read a SETUP_SIGNING frame."""
    system, component, ticks, secret = _SETUP(frame.payload)
    return SetupSigning((system, component), ticks, bytes(secret))


class SigningKey:
    """One key, its clock, and the streams that were verified with it.

    Parameters
    ----------
    secret : bytes
        32 of them, not all zero; none: it waits to be set up.
    state : SigningState
        That was stored.
    """

    def __init__(self, secret: bytes = b"", state: SigningState | None = None) -> None:
        state = state or SigningState()
        self._secret = secret
        self._changed = False  # whether it is another one than is stored
        self._ticks = self._stored = state.ticks
        self._streams: dict[Stream, int] = {
            (link_id, system, component): ticks
            for link_id, system, component, ticks in state.streams
        }

    @property
    def is_set(self) -> bool:
        """Whether there is a secret."""
        return bool(self._secret)

    @property
    def ticks(self) -> int:
        """What the clock shows."""
        return self._ticks

    def advance(self, unix_us: int) -> None:
        """Let it be so late, microseconds since 1970, unless the clock is ahead of that."""
        self._ticks = max(self._ticks, ticks_at(unix_us))

    def signature(self, content: bytes, link_id: int) -> bytes:
        """The signature of an unsigned frame, whose header says that it is signed."""
        self._ticks += 1
        head = bytes((link_id,)) + self._ticks.to_bytes(6, "little")
        return head + hash_of(self._secret, content + head)

    def verify(self, frame: Frame) -> Rejection | None:
        """Take a signed frame's stamp if its signature is right; or say what is wrong."""
        if not self._secret:
            return Rejection.NO_KEY
        if not hmac.compare_digest(hash_of(self._secret, frame.raw[:-6]), frame.signature[7:]):
            return Rejection.SIGNATURE
        ticks = int.from_bytes(frame.signature[1:7], "little")
        stream = (frame.signature[0], frame.system, frame.component)
        rejection = self._judge(stream, ticks)
        if rejection is None:
            self._streams[stream] = ticks
            self._ticks = max(self._ticks, ticks)
        return rejection

    def replace(self, secret: bytes, ticks: int) -> None:
        """Take another secret, set up at a time that is not before the given one."""
        self._ticks = max(self._ticks, min(ticks, LATEST))
        if secret != self._secret:  # with the same one, what was sent could be sent again
            self._secret = secret
            self._streams.clear()
            self._changed = True

    @property
    def is_due(self) -> bool:
        """Whether the state, or the secret, wants to be stored."""
        return self._changed or self._ticks > self._stored - RESERVE // 2

    def snapshot(self, is_last: bool = False) -> KeySnapshot:
        """What is to be stored: with a time that is not reached before it is due again.

        Parameters
        ----------
        is_last : bool
            Nothing is signed or verified any more: the time as it is.
        """
        ticks = self._ticks if is_last else self._ticks + RESERVE
        streams = tuple((*stream, last) for stream, last in self._streams.items())
        secret = self._secret if self._changed else b""
        return KeySnapshot(secret, SigningState(min(ticks, LATEST + RESERVE), streams))

    def stored(self, snapshot: KeySnapshot) -> None:
        """Take note of what was stored."""
        self._stored = snapshot.state.ticks
        if snapshot.secret == self._secret:
            self._changed = False

    def _judge(self, stream: Stream, ticks: int) -> Rejection | None:
        if ticks > LATEST:
            return Rejection.FUTURE
        last = self._streams.get(stream)
        if last is not None:
            return Rejection.REPLAYED if ticks <= last else None
        if ticks + WINDOW < self._ticks:
            return Rejection.LATE
        return None if self._has_room() else Rejection.STREAMS

    def _has_room(self) -> bool:
        """Whether one more stream can be remembered; one that lags too much may be forgotten.

        Whatever it sent is late from now on.
        """
        if len(self._streams) < MOST_STREAMS:
            return True
        oldest = min(self._streams, key=self._streams.__getitem__)
        if self._streams[oldest] + WINDOW >= self._ticks:
            return False
        del self._streams[oldest]
        return True


class LinkSigning:
    """What is taken from one link, and how what goes there is signed.

    Parameters
    ----------
    key : SigningKey
        It may be that of other links as well.
    link_id : int
        That is sent.
    parameters : SigningParameters

    Attributes
    ----------
    key : SigningKey
        As given.
    takes_setup : bool
        Whether SETUP_SIGNING is obeyed.
    takes_all : bool
        Whether every message may come without a signature.
    rejected : Counter
        Frames that were not taken, by `Rejection`.
    """

    def __init__(self, key: SigningKey, link_id: int, parameters: SigningParameters) -> None:
        self.key = key
        self.takes_setup = parameters.setup
        self.rejected: Counter[str] = Counter()
        self._link_id = link_id
        self._signs = parameters.sign
        unsigned = parameters.accept_unsigned
        self.takes_all = unsigned is True
        named = () if isinstance(unsigned, bool) else unsigned
        self._unsigned = {*ALWAYS_UNSIGNED, *(IDS[name] for name in named)}

    def accepts(self, frame: Frame) -> bool:
        """Whether a frame is taken; if not, it is counted."""
        if frame.signature:
            rejection = self.key.verify(frame)
        else:
            rejection = None if self._takes_unsigned(frame) else Rejection.UNSIGNED
        if rejection:
            self.rejected[rejection] += 1
        return rejection is None

    def taken(self, table: FrameTable) -> FrameTable:
        """Those frames of a table that are taken; the others are counted."""
        taken = [self.accepts(table.frame(row)) for row in range(len(table))]
        return table.part(np.array(taken, bool))

    @property
    def sign(self) -> Callable[[bytes], bytes] | None:
        """From a frame to its signature; None: frames are not signed."""
        return self._signature if self._signs and self.key.is_set else None

    def _signature(self, content: bytes) -> bytes:
        return self.key.signature(content, self._link_id)

    def _takes_unsigned(self, frame: Frame) -> bool:
        """Whether a message may come without a signature; the first key cannot come with one."""
        first_key = self.takes_setup and not self.key.is_set
        return (
            self.takes_all
            or frame.message_id in self._unsigned
            or (first_key and frame.message_id == SETUP_SIGNING)
        )


_SETUP = reader(
    "SETUP_SIGNING", "target_system", "target_component", "initial_timestamp", "secret_key"
)
