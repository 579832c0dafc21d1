"""Framing: bytes in, frames out; and back.

How a stream is cut into frames is said in `search`. The kernel does the same where it was built.
"""

import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.core.compiled import native
from risaf_link.mavlink import search
from risaf_link.mavlink.dialect import CRC_EXTRA
from risaf_link.mavlink.search import (
    CHECKSUM,
    CUT,
    CUTS,
    HEADERS,
    MARK_V2,
    REASONS,
    SIGNATURE,
    SIGNED,
)

_HEADER = struct.Struct("<BBBBBBBHB")

cutter = native.Cutter(CRC_EXTRA) if native else None
cut = cutter.cut if cutter else search.cut


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


class FrameTable(Struct, frozen=True):
    """Frames of one piece of a stream, without an object for each."""

    buffer: bytes
    records: bytes  # a CUT for each, in the order of the stream

    def __len__(self) -> int:
        return len(self.records) // CUT.size

    @property
    def cuts(self) -> NDArray[np.void]:
        """The records as an array, of type CUTS."""
        return np.frombuffer(self.records, CUTS)

    @property
    def message_ids(self) -> set[int]:
        """Which messages there are; of a few frames, quicker than the column."""
        return {record[2] for record in CUT.iter_unpack(self.records)}

    @property
    def origins(self) -> list[tuple[int, int, int]]:
        """Message, system and component of each, likewise."""
        return [
            (message_id, system, component)
            for _, _, message_id, _, _, system, component, *_ in CUT.iter_unpack(self.records)
        ]

    @property
    def payloads(self) -> NDArray[np.int64]:
        """Where each payload starts in the buffer; it has `size` bytes."""
        headers = np.where(self.cuts["version"] == 2, HEADERS[2], HEADERS[1])
        return self.cuts["start"] + headers

    def raw(self, but: int) -> list[bytes]:
        """Give the frames of all messages but one, as they came."""
        return [
            self.buffer[start : start + HEADERS[version] + size + CHECKSUM + SIGNATURE * signed]
            for start, _, message_id, version, *_, size, signed, _ in CUT.iter_unpack(self.records)
            if message_id != but
        ]

    def part(self, some: slice | NDArray[np.bool_]) -> "FrameTable":
        """Some of the frames."""
        return FrameTable(self.buffer, self.cuts[some].tobytes())

    def frame(self, row: int) -> Frame:
        """One of the frames."""
        return _frame(self.buffer, CUT.unpack_from(self.records, row * CUT.size))


class FrameParser:
    """Cuts one stream of bytes into frames.

    A stream is what one peer writes on one link: each wants a parser of its own.

    Parameters
    ----------
    prefix_size : int
        How many bytes stand before each frame; they are handed out with it.

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

    @property
    def is_between_frames(self) -> bool:
        """Whether a frame has ended with the last byte, so that the next one may follow."""
        return self._in_step and self._done == len(self._buffer)

    def receive_data(self, data: bytes) -> list[Frame]:
        """Take the next bytes of the stream.

        Returns
        -------
        list of Frame
            The frames that are certain now, in the order of the stream.
        """
        return _frames(*self._cut(data))

    def receive_table(self, data: bytes) -> FrameTable:
        """Take the next bytes of the stream, as `receive_data`, for the same frames in a table."""
        return FrameTable(*self._cut(data))

    def end(self) -> list[Frame]:
        """Take note that the stream has ended; decide what was still open."""
        return _frames(*self._end())

    def end_table(self) -> FrameTable:
        """Take note that the stream has ended, as `end`, for the same frames in a table."""
        return FrameTable(*self._end())

    def _cut(self, data: bytes, ended: bool = False) -> tuple[bytes, bytes]:
        """Cut what can be cut; the buffer that was cut, and the frames in it."""
        buffer = self._buffer + data
        cuts, keep, self._done, self._in_step, skipped, dropped = cut(
            buffer, self._prefix_size, self._done, self._in_step, ended
        )
        self._buffer = buffer[keep:]
        self.skipped += skipped
        if any(dropped):
            self.dropped += Counter(dict(zip(REASONS, dropped, strict=True)))
        return buffer, cuts

    def _end(self) -> tuple[bytes, bytes]:
        buffer, cuts = self._cut(b"", ended=True)
        self.skipped += len(self._buffer) - self._done
        self._buffer, self._done = b"", 0
        return buffer, cuts


def _frames(buffer: bytes, records: bytes) -> list[Frame]:
    return [_frame(buffer, record) for record in CUT.iter_unpack(records)]


def _frame(buffer: bytes, record: Any) -> Frame:
    start, prefix, message_id, version, sequence, system, component, size, signed, known = record
    payload = start + HEADERS[version]
    checksum = payload + size
    signature = checksum + CHECKSUM
    end = signature + SIGNATURE if signed else signature
    return Frame(
        buffer[start:end],
        version,
        sequence,
        system,
        component,
        message_id,
        buffer[payload:checksum],
        buffer[signature:end],
        known,
        buffer[start - prefix : start],
    )


def encode(
    message_id: int,
    payload: bytes,
    sequence: int,
    system: int,
    component: int,
    sign: Callable[[bytes], bytes] | None = None,
) -> bytes:
    """Make a MAVLink 2 frame.

    Parameters
    ----------
    message_id : int
        A message with a known definition.
    payload : bytes
        At most 255 bytes; trailing zeros are cut here, the first byte always stays.
    sequence, system, component : int
        One byte each.
    sign : callable or None
        From the frame to its signature, 13 bytes; None: it is not signed.
    """
    payload = payload[:1] + payload[1:].rstrip(b"\0")
    flags, low, high = SIGNED if sign else 0, message_id & 0xFFFF, message_id >> 16
    header = _HEADER.pack(MARK_V2, len(payload), flags, 0, sequence, system, component, low, high)
    frame = header + payload
    frame += search.checksum_of(frame[1:], CRC_EXTRA[message_id])
    return frame + sign(frame) if sign else frame
