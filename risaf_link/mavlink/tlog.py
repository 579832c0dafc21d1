"""Telemetry logs: (time, frame) records <-> bytes.

A record is an 8-byte big-endian count of microseconds since 1970 and one raw frame; there is no
header. MAVProxy keeps the number of a link in the two low bits of the time: 0 received, 3 sent.
A `.tlog.raw` holds frames alone.

Real logs hold garbage between records, and stamps that are wrong. The frame parser finds the
frames. A stamp is believed if those that follow bear it out, and else replaced by the one before.
"""

import struct
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from risaf_link.mavlink.frame import Frame, FrameParser

STAMP = struct.Struct(">Q")
RECEIVED, SENT = 0, 3

LEAP_US = 600_000_000  # a log is hardly ever silent for so long
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
        self._start = b""
        for chunk in self._chunks:
            self._start += chunk
            if len(self._start) >= SAMPLE:
                break
        self.parser = FrameParser(_prefix_size(self._start[:SAMPLE]))
        self.stamps_replaced = 0

    def __iter__(self) -> Iterator[Record]:
        last: int | None = None
        ahead: deque[Frame] = deque()
        stamps: deque[int | None] = deque()
        for frame in self._frames():
            ahead.append(frame)
            stamps.append(_stamp(frame))
            if len(ahead) > LOOKAHEAD:
                last = self._time(stamps, last)
                yield Record(last, ahead.popleft())
        while ahead:
            last = self._time(stamps, last)
            yield Record(last, ahead.popleft())

    def _frames(self) -> Iterator[Frame]:
        yield from self.parser.receive_data(self._start)
        for chunk in self._chunks:
            yield from self.parser.receive_data(chunk)
        yield from self.parser.end()

    def _time(self, stamps: deque[int | None], last: int | None) -> int:
        """Take the first stamp; the time of its record, given the one before."""
        stamp = stamps.popleft()
        following = [s for s in stamps if s is not None]
        if stamp is not None and _is_believable(stamp, last, following):
            return stamp
        self.stamps_replaced += 1
        if last is not None:
            return last
        tails = (following[i:] for i in range(len(following)))
        return next((tail[0] for tail in tails if _is_believable(tail[0], None, tail[1:])), 0)


def _is_believable(stamp: int, last: int | None, following: Sequence[int]) -> bool:
    """Whether the stamps that follow bear out this one, given the time before."""
    half = len(following) / 2
    if last is None:
        return not following or sum(0 <= s - stamp <= LEAP_US for s in following) > half
    if stamp < last:  # the clock may have been set
        return sum(stamp <= s < last for s in following) > half
    if stamp > last + LEAP_US:
        return sum(stamp <= s for s in following) > half
    return not following or not last <= following[0] < stamp


def _stamp(frame: Frame) -> int | None:
    if len(frame.prefix) < STAMP.size:
        return None
    return int(STAMP.unpack(frame.prefix)[0]) & ~3


def _prefix_size(start: bytes) -> int:
    """Size of the stamps of a log: 0 if most frames adjoin each other."""
    stamped = FrameParser(STAMP.size).receive_data(start)
    bare = FrameParser().receive_data(start)
    adjoining = sum(not frame.prefix for frame in stamped) + len(bare) - len(stamped)
    return 0 if 2 * adjoining > len(bare) else STAMP.size
