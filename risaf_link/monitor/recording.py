"""A log to be looked at: found by time, and played."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from msgspec import Struct

from risaf_link.errors import LogError
from risaf_link.links.file import read
from risaf_link.mavlink.frame import FrameTable
from risaf_link.mavlink.search import CUTS
from risaf_link.mavlink.tlog import Stamps, TlogReader
from risaf_link.monitor.estimator import HISTORY_S
from risaf_link.monitor.vehicles import READ, Vehicles

SLOWEST, FASTEST = 0.1, 100.0  # times real time


class Recording:
    """The frames of a log in memory: of most only the header, of those that are read all.

    Parameters
    ----------
    chunks : iterable of bytes
        The log, cut anywhere.

    Attributes
    ----------
    times_us : ndarray of uint64
        When each frame was logged, since 1970. Where the clock that wrote the log was set back,
        time stands still and then goes on: what is shown never goes back.
    """

    def __init__(self, chunks: Iterable[bytes]) -> None:
        cuts, times_us = [np.zeros(0, CUTS)], [np.zeros(0, np.uint64)]
        pieces, size = [b""], 0
        for table, times in TlogReader(chunks).tables():
            kept = table.cuts.copy()
            kept["start"] = 0
            for row in np.flatnonzero(np.isin(kept["message_id"], READ)).tolist():
                raw = table.frame(row).raw
                kept["start"][row] = size
                pieces.append(raw)
                size += len(raw)
            kept["prefix"] = 0
            cuts.append(kept)
            times_us.append(times)
        stamps = np.concatenate(times_us)
        steps = np.diff(stamps.astype(np.int64), prepend=stamps[:1].astype(np.int64))
        self.times_us: Stamps = stamps[:1] + np.cumsum(np.maximum(steps, 0)).astype(np.uint64)
        self._table = FrameTable(b"".join(pieces), np.concatenate(cuts).tobytes())

    def __len__(self) -> int:
        return len(self.times_us)

    def row(self, time_us: float) -> int:
        """The first frame after a time."""
        return int(np.searchsorted(self.times_us, np.uint64(time_us), side="right"))

    def feed(self, vehicles: Vehicles, begin: int, end: int) -> None:
        """Let frames, from a row to another, arrive."""
        table = self._table.part(slice(begin, end))
        vehicles.take(table, self.times_us[begin:end])


def open_recording(path: Path, progress: Callable[[int], None] = lambda _: None) -> Recording:
    """Read a log.

    Raises
    ------
    LogError
        If it cannot be read, or holds no frame.
    """
    recording = Recording(read(path, progress))
    if not len(recording):
        raise LogError(f"{path}: found no MAVLink frame, expected a tlog")
    return recording


class Playback(Struct, frozen=True):
    """Where a log is, microseconds since 1970, and how fast it goes."""

    begin_us: int
    end_us: int
    speed: float
    is_paused: bool


class Player:
    """Plays a recording.

    Attributes
    ----------
    vehicles : Vehicles
        What is known at this point of the log; another one after each jump.
    speed : float
        Times real time.
    is_paused : bool
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._begin_us, self._end_us = (int(recording.times_us[i]) for i in (0, -1))
        self.speed = 1.0
        self.is_paused = False
        self.seek(self._begin_us)

    @property
    def playback(self) -> Playback:
        """Where it is, and how fast it goes."""
        return Playback(self._begin_us, self._end_us, self.speed, self.is_paused)

    @property
    def now_us(self) -> int:
        """The log's time."""
        return round(self._at_us)

    def seek(self, time_us: float) -> None:
        """Go to a time of the log; the minutes before it are looked through."""
        self._at_us: float = min(max(time_us, self._begin_us), self._end_us)
        self.vehicles = Vehicles()
        begin = self._recording.row(max(0.0, self._at_us - HISTORY_S * 1e6))
        self._row = self._recording.row(self._at_us)
        self._recording.feed(self.vehicles, begin, self._row)

    def set_speed(self, speed: float) -> None:
        """Go so many times as fast as it was."""
        self.speed = min(max(speed, SLOWEST), FASTEST)

    def advance(self, seconds: float) -> None:
        """Let time pass; at the end it stands still."""
        if self.is_paused:
            return
        self._at_us = min(self._at_us + seconds * self.speed * 1e6, self._end_us)
        row = self._recording.row(self._at_us)
        self._recording.feed(self.vehicles, self._row, row)
        self._row = row
        if self._at_us >= self._end_us:
            self.is_paused = True
