"""What happened in a run, in words: what the operator is told live, and gaps in the samples."""

from dataclasses import dataclass

import numpy as np

from risaf_link.core.estimate import Estimate, EstimateBlock
from risaf_link.mavlink.notices import Notices, Severity

GAP = 1.0  # s between two epochs that are a gap
LOOK = 0.2  # s, from one look at the whole estimate to the next: it costs more than its columns


@dataclass(frozen=True, slots=True)
class Event:
    """One line, and when it was true."""

    elapsed: float  # s since the first epoch
    time_us: int  # as samples were stamped
    boot_us: int
    received_us: int
    severity: Severity
    text: str


class Looks:
    """Looks at a run now and then.

    Attributes
    ----------
    estimate : Estimate or None
        As of the last look.
    """

    def __init__(self) -> None:
        self.estimate: Estimate | None = None
        self._period = LOOK
        self._last = -np.inf  # s

    def look(self, block: EstimateBlock) -> bool:
        """Take the next estimates; whether `estimate` is a new one, the last of these."""
        elapsed = float(block.elapsed[-1])
        if elapsed - self._last < self._period:
            return False
        self._last = elapsed
        self.estimate = block.at(len(block) - 1)
        return True


class Events:
    """Finds out what happens."""

    def __init__(self) -> None:
        self._notices = Notices()
        self._elapsed: float | None = None  # s, at the last epoch

    def take(self, block: EstimateBlock, looked: Estimate | None) -> list[Event]:
        """Take the next estimates, and the last of them where there was a look; what is new."""
        events = self._gaps(block)
        if looked:
            self._notices.observe(looked)
            elapsed_us = round(looked.elapsed * 1e6)
            due = self._notices.due(elapsed_us, has_stalled=False, trouble="", complaints={})
            last = len(block) - 1
            events += [_event(block, last, notice.severity, notice.text) for notice in due]
        return events

    def _gaps(self, block: EstimateBlock) -> list[Event]:
        elapsed = block.elapsed
        before = float(elapsed[0]) if self._elapsed is None else self._elapsed
        self._elapsed = float(elapsed[-1])
        if self._elapsed - before <= GAP:
            return []
        steps = np.diff(elapsed, prepend=before)
        return [
            _event(block, i, Severity.WARNING, f"no samples for {steps[i]:.1f} s")
            for i in np.flatnonzero(steps > GAP).tolist()
        ]


def _event(block: EstimateBlock, i: int, severity: Severity, text: str) -> Event:
    return Event(
        float(block.elapsed[i]),
        int(block.time_us[i]),
        int(block.boot_us[i]),
        int(block.received_us[i]),
        severity,
        text,
    )
