"""Telemetry logs: (time, frame) records <-> bytes.

A record is an 8-byte big-endian count of microseconds since 1970 and one raw frame; there is no
header. MAVProxy keeps the number of a link in the two low bits of the time: 0 received, 3 sent.
A `.tlog.raw` holds frames alone.

Real logs hold garbage between records, and stamps that are wrong. The frame parser finds the
frames; a stamp is believed if it is close behind the one before it or if most of those that follow
agree with it, and else replaced by the one before.
"""

import struct
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from risaf_link.mavlink.frame import Frame, FrameParser

STAMP = struct.Struct(">Q")
RECEIVED, SENT = 0, 3

STEP_US = 10_000_000  # stamps this close agree
LOOKAHEAD = 8  # records
SAMPLE = 16384  # bytes that tell a log with stamps from one without


class Record(NamedTuple):
    """One frame and the time at which it was logged."""

    time_us: int  # since 1970; the two low bits are cleared
    frame: Frame


def record(time_us: int, raw: bytes, link: int = RECEIVED) -> bytes:
    """Lay out one record.

    Parameters
    ----------
    time_us : int
        Microseconds since 1970; the two low bits make room for the link.
    raw : bytes
        The frame.
    link : int
        0 to 3.
    """
    return STAMP.pack(time_us & ~3 | link) + raw


class TlogReader:
    """Reads the records of one log, whatever else is in it.

    Parameters
    ----------
    chunks : iterable of bytes
        The log, cut anywhere.

    Attributes
    ----------
    parser : FrameParser
        Counts what was dropped and skipped.
    stamps_replaced : int
        Stamps that were missing or not believed.
    """

    def __init__(self, chunks: Iterable[bytes]) -> None:
        self._chunks = iter(chunks)
        self._first = next(self._chunks, b"")
        self.parser = FrameParser(_prefix_size(self._first))
        self.stamps_replaced = 0

    def __iter__(self) -> Iterator[Record]:
        last: int | None = None
        ahead: deque[tuple[Frame, int | None]] = deque()
        for frame in self._frames():
            ahead.append((frame, _stamp(frame)))
            if len(ahead) > LOOKAHEAD:
                last = self._believe(ahead, last)
                yield Record(last, ahead.popleft()[0])
        while ahead:
            last = self._believe(ahead, last)
            yield Record(last, ahead.popleft()[0])

    def _frames(self) -> Iterator[Frame]:
        yield from self.parser.receive_data(self._first)
        for chunk in self._chunks:
            yield from self.parser.receive_data(chunk)
        yield from self.parser.end()

    def _believe(self, ahead: deque[tuple[Frame, int | None]], last: int | None) -> int:
        """Time of the first record, given those behind it and the time before."""
        stamp = ahead[0][1]
        others = [s for _, s in list(ahead)[1:] if s is not None]
        if stamp is not None:
            if last is not None and 0 <= stamp - last <= STEP_US:
                return stamp
            agreeing = sum(abs(other - stamp) <= STEP_US for other in others)
            if 2 * agreeing > len(others) or (last is None and not others):
                return stamp
        self.stamps_replaced += 1
        if last is not None:
            return last
        return sorted(others)[len(others) // 2] if others else 0


def _stamp(frame: Frame) -> int | None:
    if len(frame.prefix) < STAMP.size:
        return None
    return int(STAMP.unpack(frame.prefix)[0]) & ~3


def _prefix_size(start: bytes) -> int:
    """Size of the stamps of a log: 0 if it reads better as a log without."""

    def good_frames(size: int) -> int:
        frames = FrameParser(size).receive_data(start[:SAMPLE])
        return sum(len(frame.prefix) == size for frame in frames)

    return max((STAMP.size, 0), key=good_frames)
