"""HEARTBEAT, tied to the estimator's progress."""

from risaf_link.mavlink.telemetry import ComponentState

HEARTBEAT_US = 1_000_000
STALLED_US, SILENT_US = 2_000_000, 10_000_000  # without an epoch: CRITICAL, then no HEARTBEAT


class Pulse:
    """Tells when a HEARTBEAT is due, and what it says.

    Attributes
    ----------
    has_stalled : bool
        No epochs come, though they did.
    """

    def __init__(self) -> None:
        self.has_stalled = False
        self._epochs = self._epochs_before = 0
        self._progress_us = 0
        self._next_us: int | None = None  # when the next one is due

    @property
    def state(self) -> ComponentState:
        """How the estimator is, as of the last look at the time."""
        if not self._epochs:
            return ComponentState.BOOT
        return ComponentState.CRITICAL if self.has_stalled else ComponentState.ACTIVE

    def note_epoch(self) -> None:
        """Take note that the estimator has made progress."""
        self._epochs += 1

    def advance(self, now_us: int) -> bool:
        """Let it be later, microseconds of a clock that does not jump; whether one is due."""
        if self._epochs != self._epochs_before:
            self._epochs_before, self._progress_us = self._epochs, now_us
        still_us = now_us - self._progress_us if self._epochs else 0
        self.has_stalled = still_us >= STALLED_US
        if self._next_us is not None and now_us < self._next_us:
            return False
        is_late = self._next_us is None or now_us - self._next_us >= HEARTBEAT_US
        self._next_us = (now_us if is_late else self._next_us or now_us) + HEARTBEAT_US
        return still_us < SILENT_US
