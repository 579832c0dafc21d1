"""Telemetry logs: (time, frame) records <-> bytes.

A record is an 8-byte big-endian count of microseconds since 1970 and one raw frame; there is no
header. MAVProxy keeps the number of a link in the two low bits of the time: 0 received, 3 sent.
A `.tlog.raw` holds frames alone.

Real logs hold garbage between records, and stamps that are wrong. The frame parser finds the
frames. A stamp is believed if those that follow bear it out, and else replaced by the one before.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from risaf_link.mavlink.frame import Frame, FrameParser, FrameTable

STAMP = struct.Struct(">Q")
RECEIVED, SENT = 0, 3

LEAP_US = 600_000_000  # a log is hardly ever silent for so long
LOOKAHEAD = 8  # records
LATEST_US = 1 << 62  # no clock shows more; twice as much is no int64
SAMPLE = 16384  # bytes that tell a log with stamps from one without

Stamps = NDArray[np.uint64]
Mask = NDArray[np.bool_]


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
        for table, times_us in self.tables():
            for row, time_us in enumerate(times_us.tolist()):
                yield Record(time_us, table.frame(row))

    def tables(self) -> Iterator[tuple[FrameTable, Stamps]]:
        """Read the log in pieces as long as its chunks.

        Yields
        ------
        table : FrameTable
            The next frames, at least one.
        times_us : ndarray of uint64
            The time of each, as in Record.
        """
        last: int | None = None
        waiting: list[tuple[FrameTable, Stamps, Mask]] = []
        for table, is_last in self._tables():
            if len(table):
                waiting.append((table, *_stamps(table)))
            while waiting and (is_last or sum(len(t) for t, *_ in waiting[1:]) >= LOOKAHEAD):
                first, *_ = waiting[0]
                end = len(first) + LOOKAHEAD
                stamps = np.concatenate([each for _, each, _ in waiting])[:end]
                stamped = np.concatenate([each for _, _, each in waiting])[:end]
                times_us = self._times(stamps, stamped, len(first), last)
                last = int(times_us[-1])
                del waiting[0]
                yield first, times_us

    def _tables(self) -> Iterator[tuple[FrameTable, bool]]:
        """Frames of every chunk, and whether they are the last."""
        yield self.parser.receive_table(self._start), False
        for chunk in self._chunks:
            yield self.parser.receive_table(chunk), False
        yield self.parser.end_table(), True

    def _times(self, stamps: Stamps, stamped: Mask, count: int, last: int | None) -> Stamps:
        """Times of the first `count` records, given the one before; further stamps may follow.

        Where stamps are missing, or are none that `_is_believable` would doubt, a whole run of
        them is taken at once.
        """
        times_us = np.empty(count, np.uint64)
        rising = stamped[1:] & stamped[:-1] & (stamps[1:] >= stamps[:-1])
        borne_out = np.append(rising, True)  # by the next one
        usual = np.append(False, rising & (stamps[1:] - stamps[:-1] <= LEAP_US)) & borne_out
        missing = ~stamped
        at = 0
        while at < count:
            end, stamp = at + 1, int(stamps[at])
            if last is not None and missing[at]:
                end = _run(missing[:count], end)
                times_us[at:end] = last
                self.stamps_replaced += end - at
            elif last is not None and last <= stamp <= last + LEAP_US and borne_out[at]:
                end = _run(usual[:count], end)
                times_us[at:end] = stamps[at:end]
            else:
                following = slice(end, end + LOOKAHEAD)
                borne_by = stamps[following][stamped[following]].tolist()
                times_us[at] = self._time(stamp if stamped[at] else None, borne_by, last)
            last = int(times_us[end - 1])
            at = end
        return times_us

    def _time(self, stamp: int | None, following: Sequence[int], last: int | None) -> int:
        """Time of a record, given its stamp, the next ones and the time before."""
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


def _stamps(table: FrameTable) -> tuple[Stamps, Mask]:
    """Stamps of the frames, and which frames have one that a clock may have shown."""
    stamped = table.cuts["prefix"] >= STAMP.size
    stamps = np.zeros(len(table), np.uint64)
    if stamped.any():
        size = len(table.buffer) - STAMP.size + 1
        at = np.ndarray(size, ">u8", table.buffer, strides=1)  # what starts at each byte
        stamps[stamped] = at[table.cuts["start"][stamped] - STAMP.size]
    return stamps & ~np.uint64(3), stamped & (stamps <= LATEST_US)


def _run(mask: Mask, start: int) -> int:
    """Where a run of True that goes on at `start` ends."""
    rest = mask[start:]
    return start + int(rest.argmin()) if not rest.all() else len(mask)


def _prefix_size(start: bytes) -> int:
    """Size of the stamps of a log: 0 if most frames adjoin each other."""
    stamped = FrameParser(STAMP.size).receive_table(start)
    bare = FrameParser().receive_table(start)
    adjoining = np.count_nonzero(stamped.cuts["prefix"] == 0) + len(bare) - len(stamped)
    return 0 if 2 * adjoining > len(bare) else STAMP.size
