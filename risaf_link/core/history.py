"""What happened over time, in constant memory: however long it goes on, some thousand values.

Time is cut into steps of one length. When there are more steps than there is room for, every two
become one.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

ROOM = 2048  # steps; twice as many as a picture has points
SHORTEST = 0.02  # s, a step at first

Keeping = Literal["least", "most", "sum", "first"]

_UFUNCS: dict[Keeping, np.ufunc] = {"least": np.fmin, "most": np.fmax, "sum": np.add}


class History:
    """Values of c quantities over time, of which each step keeps one.

    Parameters
    ----------
    keeps : str
        Of the values in one step: `least`, `most`, the `sum`, or the `first`.
    columns : int
        c.
    """

    def __init__(self, keeps: Keeping, columns: int) -> None:
        self._keeps = keeps
        self._empty = 0.0 if keeps == "sum" else np.nan
        self._values = np.full((ROOM, columns), self._empty)
        self._used = 0
        self.step = SHORTEST

    def __len__(self) -> int:
        return self._used

    @property
    def columns(self) -> int:
        """How many quantities there are."""
        return self._values.shape[1]

    @property
    def edges(self) -> Floats:
        """Where the steps begin, and where the last one ends, (m + 1,), s."""
        return self.step * np.arange(self._used + 1, dtype=float)

    @property
    def times(self) -> Floats:
        """Middles of the steps, (m,), s."""
        return self.step * (np.arange(self._used, dtype=float) + 0.5)

    @property
    def values(self) -> Floats:
        """What the steps keep, (m, c); NaN where nothing was added, of sums 0."""
        return self._values[: self._used]

    def add(self, time_s: Floats, values: Floats) -> None:
        """Take values, (k, c), at times, (k,) s from the start; those before it count as then."""
        if not len(time_s):
            return
        latest = max(float(time_s.max()), 0.0)
        while latest >= ROOM * self.step:
            self._fold()
        steps = np.maximum(time_s / self.step, 0.0).astype(np.int64)
        if (steps[1:] < steps[:-1]).any():
            order = np.argsort(steps, kind="stable")
            steps, values = steps[order], values[order]
        starts = np.flatnonzero(np.diff(steps, prepend=-1))
        into = steps[starts]
        self._used = max(self._used, int(into[-1]) + 1)
        self._values[into] = self._joined(self._values[into], self._reduced(values, starts))

    def between(self, edges: Floats) -> Floats:
        """Sums between times, (k + 1,) s, as if each step's were spread evenly over it; (k, c)."""
        total = np.vstack((np.zeros((1, self.columns)), np.cumsum(self.values, axis=0)))
        at = [np.interp(edges, self.edges, column) for column in total.T]
        return np.diff(np.array(at).T, axis=0)

    def widen(self, columns: int) -> None:
        """Make room for further quantities."""
        more = columns - self.columns
        if more > 0:
            self._values = np.hstack((self._values, np.full((ROOM, more), self._empty)))

    def _reduced(self, values: Floats, starts: NDArray[np.int64]) -> Floats:
        if self._keeps == "first":
            return values[starts]
        reduced: Floats = _UFUNCS[self._keeps].reduceat(values, starts, axis=0)
        return reduced

    def _joined(self, earlier: Floats, later: Floats) -> Floats:
        if self._keeps == "first":
            return np.where(np.isnan(earlier), later, earlier)
        joined: Floats = _UFUNCS[self._keeps](earlier, later)
        return joined

    def _fold(self) -> None:
        """Make one step of every two."""
        half = self._joined(self._values[0::2], self._values[1::2])
        self._values = np.vstack((half, np.full_like(half, self._empty)))
        self._used = (self._used + 1) // 2
        self.step *= 2.0


class Worst:
    """Of many moments the worst ones, in the order of time.

    Each row is the worst of as many moments that follow one another. When there are twice `ROOM`
    rows, of every two the worse one stays.

    Parameters
    ----------
    columns : int
        Of the row that says what a moment was; the last is how bad it was.

    Attributes
    ----------
    seen : int
        How many moments there were.
    """

    def __init__(self, columns: int) -> None:
        self._rows = np.empty((2 * ROOM, columns))
        self._used = 0
        self._each = 1  # moments that a row is the worst of
        self.seen = 0

    @property
    def rows(self) -> Floats:
        """What is kept, (m, columns)."""
        return self._rows[: self._used]

    def add(self, row: tuple[float, ...]) -> None:
        """Take the next moment."""
        self.seen += 1
        if self.seen > self._used * self._each:
            if self._used == len(self._rows):
                self._fold()
            self._rows[self._used] = row
            self._used += 1
        elif row[-1] > self._rows[self._used - 1, -1]:
            self._rows[self._used - 1] = row

    def _fold(self) -> None:
        pairs = self._rows.reshape(ROOM, 2, -1)
        self._rows[:ROOM] = pairs[np.arange(ROOM), pairs[:, :, -1].argmax(axis=1)]
        self._used, self._each = ROOM, 2 * self._each
