"""Who is heard: rates, losses and round trips of every sender on every way that it comes by."""

from collections import deque

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.frame import FrameTable
from risaf_link.mavlink.tlog import Stamps

RATE_S, LOSS_S = 5, 60  # spans over which rates and losses are told
MOST_SENDERS = 64
TRIPS = 9  # round trips of which the median is told
REORDERED = 16  # a frame that is further behind than that is the first after a restart

Way = tuple[str, int, int]
"""The peer that hands it on, system, component."""


class Sender(Struct):
    """One component, by one way."""

    peer: str
    system: int
    component: int
    heard_us: int = 0
    trip_us: float | None = None  # median of the last round trips


class Account:
    """What came from one sender: by the second, for as long as losses are told."""

    def __init__(self, way: Way) -> None:
        self.sender = Sender(*way)
        self._first_us = -1
        self._sequence: int | None = None
        self._behind = 0  # how far the last frame was behind the newest
        self._trips: deque[int] = deque(maxlen=TRIPS)
        self._seconds: deque[list[int]] = deque(maxlen=LOSS_S + 1)  # second, frames, lost, bytes

    def note(
        self, times_us: Stamps, sequences: NDArray[np.uint8], sizes: NDArray[np.int64]
    ) -> None:
        """Take note of frames, k in a row."""
        if self._first_us < 0:
            self._first_us = int(times_us[0])
        self.sender.heard_us = int(times_us[-1])
        lost = self._lost(sequences)
        seconds = (times_us // 1_000_000).astype(np.int64)
        starts = np.flatnonzero(np.diff(seconds, prepend=-1))
        ends = np.append(starts[1:], len(seconds))
        columns = (ends - starts, np.add.reduceat(lost, starts), np.add.reduceat(sizes, starts))
        for second, *counts in np.stack([seconds[starts], *columns], axis=1).tolist():
            if not self._seconds or self._seconds[-1][0] != second:
                self._seconds.append([second, 0, 0, 0])
            last = self._seconds[-1]
            last[1:] = [a + b for a, b in zip(last[1:], counts, strict=True)]

    def note_trip(self, trip_us: int) -> None:
        """Take note of a round trip."""
        self._trips.append(trip_us)
        self.sender.trip_us = float(np.median(self._trips))

    def rates(self, now_us: int) -> tuple[float, float]:
        """Frames and bytes a second."""
        span = self._span(now_us, RATE_S)
        seconds = min(RATE_S, max(1.0, (now_us // 1_000_000 * 1_000_000 - self._first_us) / 1e6))
        return sum(s[1] for s in span) / seconds, sum(s[3] for s in span) / seconds

    def loss(self, now_us: int) -> float | None:
        """Share of its frames that did not come; None: nothing came."""
        span = self._span(now_us, LOSS_S)
        came, lost = sum(s[1] for s in span), max(0, sum(s[2] for s in span))
        return lost / (came + lost) if came else None

    def _span(self, now_us: int, length: int) -> list[list[int]]:
        """The last whole seconds."""
        this = now_us // 1_000_000
        return [s for s in self._seconds if this - length <= s[0] < this]

    def _lost(self, sequences: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Frames that are missing before each one; -1: it fills a gap, being late."""
        last = int(sequences[0]) - 1 if self._sequence is None else self._sequence
        before = np.concatenate([[last % 256], sequences[:-1]]).astype(np.uint8)
        steps = (sequences - before).astype(np.int8).astype(np.int64)
        steps[steps < -REORDERED] = 1
        at = np.cumsum(steps) - self._behind
        newest = np.maximum.accumulate(np.append(0, at))
        self._sequence, self._behind = int(sequences[-1]), int(newest[-1] - at[-1])
        lost: NDArray[np.int64] = np.where(at > newest[:-1], at - newest[:-1] - 1, -1)
        lost[steps == 0] = 0
        return lost


class Traffic:
    """The accounts of all who were heard of late."""

    def __init__(self) -> None:
        self.accounts: dict[Way, Account] = {}

    def note(self, table: FrameTable, times_us: Stamps, peer: str) -> None:
        """Take note of frames that one peer handed on."""
        cuts = table.cuts
        whose = cuts["system"].astype(np.int64) * 256 + cuts["component"]
        ends = np.where(cuts["version"] == 2, 12, 8) + 13 * cuts["signed"]
        sizes = cuts["size"] + ends
        for key in np.unique(whose).tolist():
            rows = whose == key
            account = self.account((peer, *divmod(key, 256)))
            account.note(times_us[rows], cuts["sequence"][rows], sizes[rows])

    def account(self, way: Way) -> Account:
        """The account of a sender; who was heard last is last."""
        account = self.accounts.get(way) or Account(way)
        remember(self.accounts, way, account, MOST_SENDERS)
        return account
