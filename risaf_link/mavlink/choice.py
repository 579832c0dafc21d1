"""Which of several senders, and which of several messages of the same sensor, is listened to."""

import math
from collections import deque
from collections.abc import Hashable, Sequence

PATIENCE_US = 3_000_000  # how long a source may be silent before another one is taken
SAME_INSTANT_US = 2_000  # at most, while the sample period is not known


class Choice:
    """Keeps to one of several sources: the best one that is not silent."""

    def __init__(self) -> None:
        self.chosen: Hashable = None
        self.heard_us = 0  # when it was, the last time
        self._rank: tuple[int, ...] = ()

    def admits(self, source: Hashable, rank: tuple[int, ...], now_us: int) -> bool:
        """Whether this source, which has just been heard, is the one to take.

        Parameters
        ----------
        source : hashable
            Anything but None.
        rank : tuple of int
            The smaller, the better; of equals the first that was heard is kept.
        now_us : int
            Arrival time.
        """
        if source != self.chosen:
            is_silent = abs(now_us - self.heard_us) > PATIENCE_US
            if self.chosen is not None and not is_silent and rank >= self._rank:
                return False
            self.chosen, self._rank = source, rank
        self.heard_us = now_us
        return True


class _Stream:
    """One message that carries a sensor."""

    def __init__(self) -> None:
        self.period_us = math.inf  # until it has come twice
        self._last_us: int | None = None
        self._steps_us: deque[int] = deque(maxlen=7)

    def note(self, time_us: int) -> None:
        if self._last_us is not None and time_us > self._last_us:
            self._steps_us.append(time_us - self._last_us)
            self.period_us = sorted(self._steps_us)[len(self._steps_us) // 2]
        self._last_us = time_us

    def is_present(self, now_us: int) -> bool:
        return self._last_us is not None and abs(now_us - self._last_us) <= 4 * self.period_us


class Streams:
    """The sensors of one sender, each of which may come in several messages.

    Parameters
    ----------
    finest_first : sequence of int
        Ids of these messages.
    """

    def __init__(self, finest_first: Sequence[int]) -> None:
        self._finest_first = finest_first
        self._streams: dict[int, dict[int, _Stream]] = {}
        self._shortest_us = math.inf

    def admits(self, sensor: int, message_id: int, time_us: int) -> bool:
        """Whether a message, which has just come, is the one to take a sensor from.

        That is the finest one of those that come at least half as often as any other.
        """
        streams = self._streams.setdefault(sensor, {})
        stream = streams.setdefault(message_id, _Stream())
        stream.note(time_us)
        self._shortest_us = min(self._shortest_us, stream.period_us)
        periods_us = {i: s.period_us for i, s in streams.items() if s.is_present(time_us)}
        longest_us = 2 * min(periods_us.values())
        often = [i for i, period_us in periods_us.items() if period_us <= longest_us]
        return min(often, key=self._finest_first.index) == message_id

    @property
    def tolerance_us(self) -> int:
        """Half the sample period: two stamps that differ by less may be one instant."""
        period_us = self._shortest_us
        return int(period_us / 2) if math.isfinite(period_us) else SAME_INSTANT_US
