"""How a stream is cut into frames.

A frame starts with a mark (0xFE: MAVLink 1, 0xFD: MAVLink 2), says its length in the next byte, and
ends in a checksum that is seeded with a byte of the message's definition (CRC_EXTRA). Nothing else
sets frames apart, so a mark may be any byte of a payload, and a corrupt length points anywhere.
Three rules keep one bad byte from costing more than its own frame:

1. A frame whose checksum fails is given up one byte at a time: the search for the next frame goes
   on behind its mark, not behind its end.
2. Where no frame follows a good one, the start of the next may have been taken for its end: for its
   last byte or for a part of its signature, which no checksum covers. The search goes on there.
3. The CRC_EXTRA of a message without a known definition is not known either; but its checksum must
   fit some CRC_EXTRA, as one in 256 does by chance. Such a frame is believed if moreover a mark
   follows it, or the end of the stream, and if no frame of a known message lies inside of it; where
   it does not follow a good frame, none may begin inside of it either.

Whether a frame is returned depends on the bytes of the stream alone and never on how they were cut
into chunks. What cannot be decided yet stays in the buffer: little more than a frame, or than two
where the third rule has to wait. A frame of a known message does not wait for what follows it.

Where every frame of a stream comes with a prefix (the time stamp in a tlog), its size tells where a
frame must start.

Layout of frames and checksum: https://mavlink.io/en/guide/serialization.html
Signature: https://mavlink.io/en/guide/message_signing.html
"""

import re
import struct
from enum import IntEnum, auto

import numpy as np
from fastcrc.crc16 import mcrf4xx
from msgspec import Struct

from risaf_link.mavlink.dialect import CRC_EXTRA

MARKS = MARK_V1, MARK_V2 = 0xFE, 0xFD
HEADERS = {1: 6, 2: 10}  # bytes, by version
CHECKSUM, SIGNATURE = 2, 13
SIGNED = 0x01  # the only incompatibility flag that is defined
REASONS = ("checksum", "incompatible", "unverified", "truncated")  # why a frame is lost

CUTS = np.dtype(
    [
        *(("start", "<i8"), ("prefix", "<i4"), ("message_id", "<u4")),
        *((name, "u1") for name in ("version", "sequence", "system", "component", "size")),
        *((name, "?") for name in ("signed", "known")),
    ],
    align=True,
)
"""A frame in a table: where it starts, bytes of its prefix, and what is in its header."""

CUT = struct.Struct("<qiIBBBBB??x")  # the same
_MARK = re.compile(b"[%c%c]" % MARKS)
_HEADER_V1 = struct.Struct("<xBBBBB")
_HEADER_V2 = struct.Struct("<xBBxBBBHB")
_CRC_STEPS = frozenset(mcrf4xx(bytes((byte,)), 0) for byte in range(256))

Cutting = tuple[bytes, int, int, bool, int, tuple[int, ...]]


class _No(IntEnum):
    """Why there is no frame at a place."""

    MARK = -1
    CHECKSUM = 0
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


class Search:
    """Looks for frames in a piece of a stream.

    Parameters
    ----------
    buffer : bytes
        The piece; of what was cut before, it begins with what may belong to the next frame.
    prefix_size : int
        How many bytes stand before each frame.
    ended : bool
        Whether the stream ends with the piece.
    """

    def __init__(self, buffer: bytes, prefix_size: int, ended: bool) -> None:
        self._buffer = buffer
        self._prefix_size = prefix_size
        self._ended = ended

    def cut(self, done: int, in_step: bool) -> Cutting:
        """Find all frames that are certain.

        Parameters
        ----------
        done : int
            Where the last frame ended.
        in_step : bool
            Whether the next must start there, behind a prefix.

        Returns
        -------
        cuts : bytes
            The frames, of type CUTS.
        keep : int
            Where the next piece has to begin.
        done, in_step
            For the next piece.
        skipped : int
            Bytes that belonged to no frame.
        dropped : tuple of int
            Frames lost, in the order of REASONS.
        """
        cuts, skipped, dropped = [], 0, [0] * len(REASONS)
        at = free = 0  # the next frame may start from `free` on
        while True:
            start = done + self._prefix_size if in_step else self._next_mark(at)
            found = self._found(start, in_step) if start < len(self._buffer) else _No.END
            if isinstance(found, _Header):
                prefix = max(min(self._prefix_size, start - done), 0)
                skipped += max(start - prefix - done, 0)
                cuts.append(_packed(start, prefix, found))
                done = found.end
                at = free = done - (SIGNATURE if _is_signed(found) else 1)
                in_step = True
            elif found is _No.END and (not self._ended or start >= len(self._buffer)):
                break
            elif in_step:
                if found is not _No.MARK:
                    dropped[found] += 1
                in_step = False
            else:
                at = start + 1
        keep = free if in_step else max(free, start - self._prefix_size)
        skipped += max(keep - done, 0)
        return b"".join(cuts), keep, max(done - keep, 0), in_step, skipped, tuple(dropped)

    def _next_mark(self, at: int) -> int:
        mark = _MARK.search(self._buffer, at)
        return mark.start() if mark else len(self._buffer)

    def _found(self, start: int, in_step: bool) -> _Header | _No:
        header = self._header_at(start)
        if isinstance(header, _No):
            return header
        known = header.message_id in CRC_EXTRA
        fault = self._fault(start, header)
        if fault is None and not known:
            fault = self._doubt(start, header, in_step)
        return header if fault is None else fault

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

    def _doubt(self, start: int, header: _Header, in_step: bool) -> _No | None:
        """Why an unknown message is not believed: the third rule at the head of this module."""
        behind = header.end + self._prefix_size
        if behind < len(self._buffer):
            if self._buffer[behind] not in MARKS:
                return _No.UNVERIFIED
        elif not self._ended:
            return _No.END
        open_end = None
        for mark in _MARK.finditer(self._buffer, start + 1, header.end):
            inner = self._header_at(mark.start())
            fault: _No | None
            if isinstance(inner, _No):
                fault = inner
            elif inner.message_id not in CRC_EXTRA or (in_step and inner.end > header.end):
                continue
            else:
                fault = self._fault(mark.start(), inner)
            if fault is None:
                return _No.UNVERIFIED
            if fault is _No.END and not (in_step or self._ended):
                open_end = _No.END
        return open_end


def _is_signed(header: _Header) -> bool:
    return header.end - header.checksum > CHECKSUM


def _packed(start: int, prefix: int, header: _Header) -> bytes:
    h = header
    address = (h.version, h.sequence, h.system, h.component)
    known = h.message_id in CRC_EXTRA
    size = h.checksum - h.payload
    return CUT.pack(start, prefix, h.message_id, *address, size, _is_signed(h), known)


def cut(buffer: bytes, prefix_size: int, done: int, in_step: bool, ended: bool) -> Cutting:
    """Find all frames that are certain: see `Search`."""
    return Search(buffer, prefix_size, ended).cut(done, in_step)


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
