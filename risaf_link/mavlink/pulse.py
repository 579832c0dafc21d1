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
    is_stuck : bool
        Epochs come, but for two seconds nothing has come of them.
    """

    def __init__(self) -> None:
        self.has_stalled = self.is_stuck = False
        self._gathered_before = 0
        self._answered_us: int | None = None
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

    def note_gathered(self, gathered: int, now_us: int) -> None:
        """Take note of how many epochs have come to the estimator by now, since the start.

        To be called before `advance`. While none comes, nothing is stuck.
        """
        if (
            self._epochs != self._epochs_before
            or gathered == self._gathered_before
            or self._answered_us is None
        ):
            self._gathered_before, self._answered_us = gathered, now_us
        self.is_stuck = now_us - self._answered_us >= STALLED_US

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
