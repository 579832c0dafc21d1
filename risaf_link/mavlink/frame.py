"""Framing: bytes in, frames out; and back.

How a stream is cut into frames. A frame starts with a mark (0xFE: MAVLink 1, 0xFD: MAVLink 2),
says its length in the next byte, and ends in a checksum that is seeded with a byte of the
message's definition (CRC_EXTRA). Nothing else sets frames apart, so a mark may be any byte of a
payload, and a corrupt length points anywhere. Three rules keep one bad byte from costing more than
its own frame:

1. A frame whose checksum fails is given up one byte at a time: the search for the next frame goes
   on behind its mark, not behind its end.
2. Where no frame follows a good one, the start of the next may have been taken for its end: for its
   last byte or for a part of its signature, which no checksum covers. The search goes on there.
3. The CRC_EXTRA of a message without a known definition is not known either; but its checksum must
   fit some CRC_EXTRA, as one in 256 does by chance. Such a frame is believed if moreover a mark
   follows it, or the end of the stream, and if no frame of a known message lies inside of it.

Whether a frame is returned depends on the bytes of the stream alone and never on how they were cut
into chunks. What cannot be decided yet stays in the buffer: little more than a frame. A frame of a
known message does not wait for what follows it.

Where every frame of a stream comes with a prefix (the time stamp in a tlog), the parser is told its
size, knows by it where a frame must start, and hands it out with the frame.

Layout of frames and checksum: https://mavlink.io/en/guide/serialization.html
Signature: https://mavlink.io/en/guide/message_signing.html
"""

import re
import struct
from collections import Counter
from enum import Enum, auto

from fastcrc.crc16 import mcrf4xx
from msgspec import Struct

from risaf_link.mavlink.dialect import CRC_EXTRA

MARKS = MARK_V1, MARK_V2 = 0xFE, 0xFD
CHECKSUM, SIGNATURE = 2, 13
SIGNED = 0x01  # the only incompatibility flag that is defined

_MARK = re.compile(b"[%c%c]" % MARKS)
_HEADER_V1 = struct.Struct("<xBBBBB")
_HEADER_V2 = struct.Struct("<xBBxBBBHB")
_CRC_STEPS = frozenset(mcrf4xx(bytes((byte,)), 0) for byte in range(256))


class Frame(Struct, frozen=True):  # a frozen dataclass takes as long to make as all the rest
    """One frame; its checksum holds, unless its message is unknown."""

    raw: bytes  # all of it, from the mark to the end of the signature
    version: int  # 1 or 2
    sequence: int
    system: int
    component: int
    message_id: int
    payload: bytes  # as sent: MAVLink 2 cuts trailing zeros
    signature: bytes = b""  # link id, time stamp and hash, 13 bytes; empty where not signed
    known: bool = True  # False: no definition, so the checksum could not be verified
    prefix: bytes = b""  # what stood before the frame, where the stream has prefixes


class _No(Enum):
    """Why there is no frame at a place."""

    MARK = auto()
    CHECKSUM = auto()
    INCOMPATIBLE = auto()  # a flag that is not known says: must not be read
    UNVERIFIED = auto()  # an unknown message that is not believed
    END = auto()  # its end has not arrived yet


class _Header(Struct, frozen=True):
    version: int
    sequence: int
    system: int
    component: int
    message_id: int
    payload: int  # where the payload starts
    checksum: int  # where it ends
    end: int  # where the frame ends


class FrameParser:
    """Cuts one stream of bytes into frames.

    A stream is what one peer writes on one link: each wants a parser of its own.

    Parameters
    ----------
    prefix_size : int
        How many bytes stand before each frame.

    Attributes
    ----------
    dropped : Counter
        Frames lost, by reason: `checksum`, `incompatible`, `unverified`, `truncated`.
    skipped : int
        Bytes that belonged to no frame.
    """

    def __init__(self, prefix_size: int = 0) -> None:
        self.dropped: Counter[str] = Counter()
        self.skipped = 0
        self._prefix_size = prefix_size
        self._buffer = b""
        self._done = 0  # where the last frame ended
        self._in_step = True  # a frame must start behind the last one and a prefix
        self._ended = False

    def receive_data(self, data: bytes) -> list[Frame]:
        """Take the next bytes of the stream.

        Returns
        -------
        list of Frame
            The frames that are certain now, in the order of the stream.
        """
        self._buffer += data
        return self._cut()

    def end(self) -> list[Frame]:
        """Take note that the stream has ended; decide what was still open."""
        self._ended = True
        frames = self._cut()
        self.skipped += len(self._buffer) - self._done
        self._buffer, self._done = b"", 0
        return frames

    def _cut(self) -> list[Frame]:
        frames = []
        done, at, free = self._done, 0, 0  # the next frame may start from `free` on
        while True:
            start = done + self._prefix_size if self._in_step else self._next_mark(at)
            found = self._frame_at(start, done) if start < len(self._buffer) else _No.END
            if isinstance(found, Frame):
                frames.append(found)
                self.skipped += max(start - len(found.prefix) - done, 0)
                done = start + len(found.raw)
                at = free = done - (len(found.signature) or 1)
                self._in_step = True
            elif found is _No.END and (not self._ended or start >= len(self._buffer)):
                break
            elif self._in_step:
                self._count(found)
                self._in_step = False
            else:
                at = start + 1
        keep = free if self._in_step else max(free, start - self._prefix_size)
        self.skipped += max(keep - done, 0)
        self._buffer = self._buffer[keep:]
        self._done = max(done - keep, 0)
        return frames

    def _count(self, found: _No) -> None:
        if found is not _No.MARK:
            self.dropped["truncated" if found is _No.END else found.name.lower()] += 1

    def _next_mark(self, at: int) -> int:
        mark = _MARK.search(self._buffer, at)
        return mark.start() if mark else len(self._buffer)

    def _frame_at(self, start: int, done: int) -> Frame | _No:
        header = self._header_at(start)
        if isinstance(header, _No):
            return header
        known = header.message_id in CRC_EXTRA
        fault = self._fault(start, header) or (None if known else self._doubt(start, header))
        if fault:
            return fault
        buffer = self._buffer
        return Frame(
            buffer[start : header.end],
            header.version,
            header.sequence,
            header.system,
            header.component,
            header.message_id,
            buffer[header.payload : header.checksum],
            buffer[header.checksum + CHECKSUM : header.end],
            known,
            buffer[max(done, start - self._prefix_size) : start],
        )

    def _header_at(self, start: int) -> _Header | _No:
        buffer = self._buffer
        mark = buffer[start]
        if mark == MARK_V2:
            payload = start + _HEADER_V2.size
            if len(buffer) < payload:
                return _No.END
            size, flags, sequence, system, component, low, high = _HEADER_V2.unpack_from(
                buffer, start
            )
            if flags & ~SIGNED:
                return _No.INCOMPATIBLE
            checksum = payload + size
            end = checksum + CHECKSUM + (SIGNATURE if flags else 0)
            message_id = low | high << 16
            return _Header(2, sequence, system, component, message_id, payload, checksum, end)
        if mark == MARK_V1:
            payload = start + _HEADER_V1.size
            if len(buffer) < payload:
                return _No.END
            size, sequence, system, component, message_id = _HEADER_V1.unpack_from(buffer, start)
            checksum = payload + size
            end = checksum + CHECKSUM
            return _Header(1, sequence, system, component, message_id, payload, checksum, end)
        return _No.MARK

    def _fault(self, start: int, header: _Header) -> _No | None:
        """What is wrong with a frame: it is not whole, or its checksum does not hold."""
        if len(self._buffer) < header.end:
            return _No.END
        content = self._buffer[start + 1 : header.checksum]
        sent = self._buffer[header.checksum : header.checksum + CHECKSUM]
        extra = CRC_EXTRA.get(header.message_id)
        holds = fits_any(content, sent) if extra is None else sent == checksum_of(content, extra)
        return None if holds else _No.CHECKSUM

    def _doubt(self, start: int, header: _Header) -> _No | None:
        """Why an unknown message is not believed: the third rule at the head of this module."""
        behind = header.end + self._prefix_size
        if behind < len(self._buffer):
            if self._buffer[behind] not in MARKS:
                return _No.UNVERIFIED
        elif not self._ended:
            return _No.END
        for mark in _MARK.finditer(self._buffer, start + 1, header.checksum):
            inner = self._header_at(mark.start())
            if (
                isinstance(inner, _Header)
                and inner.message_id in CRC_EXTRA
                and inner.end <= header.end
                and not self._fault(mark.start(), inner)
            ):
                return _No.UNVERIFIED
        return None


def fits_any(content: bytes, checksum: bytes) -> bool:
    """Whether a checksum, as it is sent, is right for some CRC_EXTRA."""
    step = int.from_bytes(checksum, "little") ^ mcrf4xx(content) >> 8
    return step in _CRC_STEPS


def checksum_of(content: bytes, extra: int) -> bytes:
    """Checksum of a frame, as it is sent.

    Parameters
    ----------
    content : bytes
        Header without its mark, and payload.
    extra : int
        The message's CRC_EXTRA.
    """
    return mcrf4xx(content + bytes((extra,))).to_bytes(2, "little")


def encode(message_id: int, payload: bytes, sequence: int, system: int, component: int) -> bytes:
    """Make a MAVLink 2 frame, not signed.

    Parameters
    ----------
    message_id : int
        A message with a known definition.
    payload : bytes
        At most 255 bytes; trailing zeros are cut here, the first byte always stays.
    sequence, system, component : int
        One byte each.
    """
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    header = bytes((len(payload), 0, 0, sequence, system, component))
    content = header + message_id.to_bytes(3, "little") + payload
    return bytes((MARK_V2,)) + content + checksum_of(content, CRC_EXTRA[message_id])
