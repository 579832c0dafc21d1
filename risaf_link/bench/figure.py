"""What was measured: values with their spread, beside those of a reference from the same run."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any


@dataclass(frozen=True, slots=True)
class Spread:
    """One quantity, measured several times."""

    median: float
    least: float
    most: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Of at least one value."""
        return cls(median(values), min(values), max(values))


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of the benchmark."""

    key: str  # its name for programs
    text: str  # what was measured
    unit: str
    ours: Spread | None  # None: could not be measured, and `note` says why
    against: str = ""  # what the reference is
    reference: Spread | None = None  # None: there is none, or `note` says why
    goal: float | None = None
    more_is_better: bool = False
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """How many times better than the reference."""
        if self.ours is None or self.reference is None:
            return None
        ours, reference = self.ours.median, self.reference.median
        better, worse = (ours, reference) if self.more_is_better else (reference, ours)
        return better / worse if worse else None

    @property
    def reached(self) -> bool | None:
        """Whether the median is on the right side of the goal; None: there is no goal."""
        if self.goal is None or self.ours is None:
            return None
        if self.more_is_better:
            return self.ours.median >= self.goal
        return self.ours.median <= self.goal

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "text": self.text,
            "unit": self.unit,
            "ours": _values(self.ours),
            "against": self.against or None,
            "reference": _values(self.reference),
            "ratio": self.ratio,
            "goal": self.goal,
            "more_is_better": self.more_is_better,
            "reached": self.reached,
            "note": self.note or None,
        }


def _values(spread: Spread | None) -> dict[str, float] | None:
    if spread is None:
        return None
    return {"median": spread.median, "least": spread.least, "most": spread.most}


def seconds_of(work: Callable[[], object], repeats: int) -> list[float]:
    """Do the same several times; how long each took, s."""
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return taken


def spread_of(work: Callable[[], object], repeats: int, scale: float) -> Spread:
    """Do the same several times; how long each took, in seconds times `scale`."""
    return Spread.of([scale * seconds for seconds in seconds_of(work, repeats)])
