"""The sensors of one kind in an array: which of them take part, and which samples have come."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

REMEMBERED = 64  # instants handed on, at least, to tell late samples from duplicates

Mask = NDArray[np.bool_]
T = TypeVar("T", bound=np.generic)


@dataclass(slots=True)
class Instant:
    """What has come of all that was read at one instant."""

    values: Floats  # (n, 3); NaN: did not come, or is not valid
    came: Mask  # (n,)
    count: int = 0  # of those that came

    @classmethod
    def empty(cls, size: int) -> "Instant":
        """Nothing has come yet from so many sensors."""
        return cls(np.full((size, 3), np.nan), np.zeros(size, dtype=bool))

    def mark(self, first: int, count: int) -> Mask:
        """Take note of samples; which of them had not come before."""
        end = first + count
        if end > len(self.came):
            self.values = fitted(self.values, end, np.nan)
            self.came = fitted(self.came, end, False)
        new = ~self.came[first:end]
        self.came[first:end] = True
        self.count += int(np.count_nonzero(new))
        return new

    def put(self, first: int, values: Floats) -> int:
        """Take the samples that had not come before; how many those are."""
        before = self.count
        new = self.mark(first, len(values))
        if self.count - before == len(values):
            self.values[first : first + len(values)] = values
        else:
            self.values[first : first + len(values)][new] = values[new]
        return self.count - before

    def includes(self, first: int, count: int) -> bool:
        """Whether all of some samples have come."""
        return int(np.count_nonzero(self.came[first : first + count])) == count


class Roster:
    """All gyros, or all accelerometers, of an array.

    Parameters
    ----------
    told : int
        How many there are at least; 0: not known.

    Attributes
    ----------
    told : int
        How many there are, as the array says; 0: it has not said.
    awaited : ndarray of bool, shape (n,)
        Who came, of late, more than half as often as the most regular one of the array.
    expected : int
        How many belong to a complete epoch: who is awaited, and all that are told of.
    open, gone : dict of int to Instant
        Samples, by the time at which they were read: what waits, and what was handed on of late;
        there, a number stands for an instant at which all of so many sensors came.
    """

    def __init__(self, told: int = 0) -> None:
        self.open: dict[int, Instant] = {}
        self.gone: dict[int, Instant | int] = {}
        self.told = told
        self._attended = np.zeros(told, dtype=np.int64)  # with epochs that were not whole
        self._whole = 0  # epochs
        self._seen = 0  # the last sensor that came of late, plus one
        self._await(np.ones(told, dtype=bool))

    @property
    def size(self) -> int:
        """How many sensors there are."""
        return len(self.awaited)

    @property
    def attended(self) -> NDArray[np.int64]:
        """With how many epochs each came since the last review, (n,)."""
        return self._attended + self._whole

    @property
    def awaits_all(self) -> bool:
        """Whether all sensors are awaited."""
        return self._quorum == self.size

    def tell(self, size: int) -> None:
        """Believe the array that it has so many; 0: it does not say."""
        if size not in (0, self.told):
            self.told, self._seen = size, 0
            self._resize(size)

    def see(self, end: int) -> None:
        """Take note that there is a sensor `end - 1`."""
        self._seen = max(self._seen, end)
        if end > self.size:
            self._resize(end)

    def put(self, time_us: int, first: int, values: Floats) -> int:
        """Take samples that are to be handed on; how many of them had not come before."""
        instant = self.open.get(time_us)
        if instant is None:
            instant = self.open[time_us] = Instant.empty(self.size)
        return instant.put(first, values)

    def close(self, time_us: int) -> Instant:
        """Hand on what was read at a time."""
        instant = self.gone[time_us] = self.open.pop(time_us)
        self._forget_old()
        return instant

    def close_whole(self, times_us: list[int]) -> None:
        """Hand on instants at which all sensors came, as `see`, `put`, `attend` and `close` do."""
        if not self.size:
            return
        self._seen = max(self._seen, self.size)
        self._whole += len(times_us)
        self.gone.update(dict.fromkeys(times_us, self.size))
        self._forget_old()

    def _forget_old(self) -> None:
        """Keep half of the instants handed on whenever there are twice as many as needed."""
        if len(self.gone) >= 2 * REMEMBERED:
            keep = REMEMBERED + len(self.gone) % REMEMBERED
            self.gone = dict(list(self.gone.items())[-keep:])

    def recall(self, time_us: int) -> Instant | None:
        """What was handed on of late that had been read at a time."""
        instant = self.gone.get(time_us)
        if isinstance(instant, int):
            whole = np.ones(instant, dtype=bool)
            instant = self.gone[time_us] = Instant(np.full((instant, 3), np.nan), whole, instant)
        return instant

    def is_whole(self, time_us: int) -> bool:
        """Whether all that are awaited have come."""
        instant = self.open.get(time_us)
        if instant is None or instant.count < self._quorum:
            return not self._quorum
        return not (self.awaited & ~fitted(instant.came, self.size, False)).any()

    def lost(self, instant: Instant) -> int:
        """How many of those that were expected have not come."""
        if instant.count == self.size:
            return 0
        return int(np.count_nonzero(self._expected & ~fitted(instant.came, self.size, False)))

    def attend(self, first: int, came: Mask) -> None:
        """Take note of who came with an epoch."""
        attended = self._attended[first : first + len(came)]
        attended += came[: len(attended)]

    def review(self, most: int) -> None:
        """Settle who is awaited from now on.

        Parameters
        ----------
        most : int
            With how many epochs the most regular sensor of the array has come.
        """
        self._await(2 * self.attended > most)
        self._attended[:] = self._whole = 0

    def forget_silent(self) -> None:
        """Forget the last sensors if they have not come since this was last done."""
        self._resize(max(self.told, self._seen))
        self._seen = 0

    def _resize(self, size: int) -> None:
        """Take newcomers to be as regular as the best."""
        self._attended = fitted(self._attended, size, self._attended.max(initial=0))
        self._await(fitted(self.awaited, size, True))

    def _await(self, awaited: Mask) -> None:
        self.awaited, self._expected = awaited, awaited.copy()
        self._expected[: self.told] = True
        self._quorum = int(np.count_nonzero(awaited))
        self.expected = int(np.count_nonzero(self._expected))


def fitted(values: NDArray[T], size: int, filler: float) -> NDArray[T]:
    """Cut an array off, or fill it up, to a length."""
    if size == len(values):
        return values
    result = np.full((size, *values.shape[1:]), filler, dtype=values.dtype)
    result[: len(values)] = values[:size]
    return result
