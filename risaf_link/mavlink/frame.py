"""Framing: bytes in, frames out; and back.

How a stream is cut into frames. A frame starts with a mark (0xFE: MAVLink 1, 0xFD: MAVLink 2),
says its length in the next byte, and ends in a checksum that is seeded with a byte of the
message's definition (CRC_EXTRA). Nothing else sets frames apart, so a mark may be any byte of a
payload, and a corrupt length points anywhere. Two rules keep one corrupt byte from costing more
than its own frame:

1. A frame whose checksum fails is given up one byte at a time: the search for the next frame goes
   on behind its mark, not behind its end.
2. A message without a known definition has no checksum that could be verified. It is believed only
   where a frame must start, that is directly behind another frame; if no verified frame starts
   inside of it; and if something that looks like a frame (or the end of the stream) follows it.

Whether a frame is returned depends on the bytes of the stream alone and never on how they were cut
into chunks. What cannot be decided yet stays in the buffer: at most two frames.

Where every frame of a stream comes with a prefix (the time stamp in a tlog), the parser is told its
size, knows by it where a frame must start, and hands it out with the frame.

Layout of frames and checksum: https://mavlink.io/en/guide/serialization.html
Signature: https://mavlink.io/en/guide/message_signing.html
"""

import re
from collections import Counter
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

from risaf_link.mavlink.dialect import CRC_EXTRA

MARK_V1, MARK_V2 = 0xFE, 0xFD
HEADER_V1, HEADER_V2 = 6, 10
CHECKSUM, SIGNATURE = 2, 13
SIGNED = 0x01  # the only incompatibility flag that is defined

_MARK = re.compile(b"[\xfd\xfe]")


@dataclass(frozen=True, slots=True)
class Frame:
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


class _Header(NamedTuple):
    version: int
    message_id: int
    payload: int  # where the payload starts
    checksum: int  # where it ends
    end: int  # where the frame ends
    plain: bool  # no compatibility flags


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
        self._searched = 0  # no frame starts before this place of the buffer
        self._in_step = True  # a frame must start right at the buffer's start, behind its prefix
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
        self.skipped += len(self._buffer)
        self._buffer = b""
        return frames

    def _cut(self) -> list[Frame]:
        frames = []
        done, at = 0, self._searched  # the last frame's end; where to look next
        while True:
            start = done + self._prefix_size if self._in_step else self._next_mark(at)
            found = self._frame_at(start, done) if start < len(self._buffer) else _No.END
            if isinstance(found, Frame):
                frames.append(found)
                self.skipped += start - len(found.prefix) - done
                done = at = start + len(found.raw)
                self._in_step = True
            elif found is _No.END and (not self._ended or start >= len(self._buffer)):
                break
            elif self._in_step:
                self._count(found)
                self._in_step = False
            else:
                at = start + 1
        keep = done if self._in_step else max(done, start - self._prefix_size)
        self.skipped += keep - done
        self._buffer = self._buffer[keep:]
        self._searched = 0 if self._in_step else start - keep
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
        found = self._verified(start, header)
        if found is _No.UNVERIFIED and self._in_step:
            found = self._believed(start, header)
        if isinstance(found, _No):
            return found
        return self._frame(
            start, header, self._buffer[max(done, start - self._prefix_size) : start]
        )

    def _header_at(self, start: int) -> _Header | _No:
        buffer = self._buffer
        mark = buffer[start]
        if mark == MARK_V2:
            if len(buffer) < start + HEADER_V2:
                return _No.END
            flags = buffer[start + 2]
            if flags & ~SIGNED:
                return _No.INCOMPATIBLE
            message_id = int.from_bytes(buffer[start + 7 : start + HEADER_V2], "little")
            payload = start + HEADER_V2
            checksum = payload + buffer[start + 1]
            end = checksum + CHECKSUM + (SIGNATURE if flags else 0)
            return _Header(2, message_id, payload, checksum, end, buffer[start + 3] == 0)
        if mark == MARK_V1:
            if len(buffer) < start + HEADER_V1:
                return _No.END
            payload = start + HEADER_V1
            checksum = payload + buffer[start + 1]
            return _Header(1, buffer[start + 5], payload, checksum, checksum + CHECKSUM, plain=True)
        return _No.MARK

    def _verified(self, start: int, header: _Header) -> _Header | _No:
        """Whether the frame is whole and its checksum holds."""
        extra = CRC_EXTRA.get(header.message_id)
        if extra is None:
            return _No.UNVERIFIED
        if len(self._buffer) < header.end:
            return _No.END
        checksum = checksum_of(self._buffer[start + 1 : header.checksum], extra)
        sent = self._buffer[header.checksum : header.checksum + CHECKSUM]
        return header if sent == checksum else _No.CHECKSUM

    def _believed(self, start: int, header: _Header) -> _Header | _No:
        """Whether an unknown message is believed: the second rule at the head of this module."""
        if len(self._buffer) < header.end:
            return _No.END
        for mark in _MARK.finditer(self._buffer, start + 1, header.end):
            inner = self._header_at(mark.start())
            found = inner if isinstance(inner, _No) else self._verified(mark.start(), inner)
            if isinstance(found, _Header):
                return _No.UNVERIFIED
            if found is _No.END and not self._ended:
                return found
        return self._looks_like_a_frame(header)

    def _looks_like_a_frame(self, header: _Header) -> _Header | _No:
        """Answer `header` if what follows its frame could be the next one."""
        start = header.end + self._prefix_size
        if start >= len(self._buffer):
            return header if self._ended and header.end == len(self._buffer) else _No.END
        following = self._header_at(start)
        if isinstance(following, _No):
            return _No.END if following is _No.END and not self._ended else _No.UNVERIFIED
        if following.version == 2:
            believable = following.plain or following.message_id in CRC_EXTRA
            return header if believable else _No.UNVERIFIED
        found = self._verified(start, following)
        return header if isinstance(found, _Header) else found

    def _frame(self, start: int, header: _Header, prefix: bytes) -> Frame:
        raw = self._buffer[start : header.end]
        sequence, system, component = raw[4:7] if header.version == 2 else raw[2:5]
        return Frame(
            raw,
            header.version,
            sequence,
            system,
            component,
            header.message_id,
            self._buffer[header.payload : header.checksum],
            raw[-SIGNATURE:] if header.version == 2 and raw[2] & SIGNED else b"",
            header.message_id in CRC_EXTRA,
            prefix,
        )


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
