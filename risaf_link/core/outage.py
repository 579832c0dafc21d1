"""The estimated heading against the truth, and against GPS that was withheld."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingParameters, HeadingState
from risaf_link.core.rotation import Floats, wraps, yaws_of
from risaf_link.core.scoring import ErrorAccount, HeadingScore
from risaf_link.core.track import Track

SHORTEST_OUTAGE = 5.0  # s, of those that are found in a log
OVERLAP = 4096  # epochs that are remembered for a reference that comes late
GATHERED = 16384  # epochs after which they are compared

Reference = Literal["truth", "gps"]


class Errors(NamedTuple):
    """Heading errors against one reference, at m instants."""

    reference: Reference
    elapsed: Floats  # (m,) s
    error: Floats  # (m,) rad, estimated minus reference
    std: Floats  # (m,) rad, that the filter states for its yaw


@dataclass
class Outage:
    """A time without GPS, and the heading errors in it."""

    start: float  # s from the first sample
    end: float
    errors: defaultdict[Reference, ErrorAccount] = field(
        default_factory=lambda: defaultdict(ErrorAccount)
    )

    def includes(self, elapsed: Floats) -> NDArray[np.bool_]:
        """Which times, s from the first sample, are in it."""
        return (self.start <= elapsed) & (elapsed <= self.end)

    def rows(self) -> list[dict[str, Any]]:
        """One row a reference, for JSON; one without numbers if there was nothing to compare."""
        scores: dict[Reference | None, HeadingScore | None]
        scores = {name: account.score() for name, account in self.errors.items()} or {None: None}
        return [
            {
                "start_s": round(self.start, 3),
                "end_s": round(self.end, 3),
                "reference": reference,
                **in_degrees(score),
            }
            for reference, score in scores.items()
        ]


class _Yaws:
    """Yaw over the time of one clock, and the references that are to be held against it."""

    def __init__(self) -> None:
        self._points = np.zeros((4, 0))  # us, rad, s elapsed, rad
        self._expected: dict[Reference, list[Floats]] = {"truth": [], "gps": []}  # us, rad

    def expect(self, reference: Reference, time_us: Floats, yaw: Floats) -> None:
        """Take references, (m,) each; they may be ahead of the estimates."""
        self._expected[reference].append(np.array([time_us, yaw]))

    def add(self, points: Floats) -> Iterator[Errors]:
        """Take estimates, (4, k); the errors against references that they reach."""
        back = np.flatnonzero(np.diff(points[0]) < 0.0) + 1
        for part in np.split(points, back, axis=1):
            if not part.size:
                continue
            if self._points.size and part[0, 0] < self._points[0, -1]:
                self._points = np.zeros((4, 0))  # the clock was set: a track of its own begins
            self._points = np.hstack((self._points, part))
            for reference, expected in self._expected.items():
                if expected:
                    yield self._compare(reference, *np.hstack(expected))
            self._points = self._points[:, -OVERLAP:]

    def _compare(self, reference: Reference, time_us: Floats, yaw: Floats) -> Errors:
        times = self._points[0]
        due = time_us <= times[-1]
        self._expected[reference] = [np.array([time_us[~due], yaw[~due]])]
        reached = due & (time_us >= times[0])
        estimated, elapsed, std = _between(self._points, time_us[reached])
        return Errors(reference, elapsed, wraps(estimated - yaw[reached]), std)


def _between(points: Floats, time_us: Floats) -> tuple[Floats, Floats, Floats]:
    """Yaw, the short way round, elapsed time and deviation at times within the points'."""
    times, yaw, elapsed, std = points
    before = np.searchsorted(times, time_us, side="right") - 1
    after = np.minimum(before + 1, len(times) - 1)
    step = times[after] - times[before]
    part = np.where(step > 0.0, time_us - times[before], 0.0) / np.where(step > 0.0, step, 1.0)
    return (
        yaw[before] + part * wraps(yaw[after] - yaw[before]),
        elapsed[before] + part * (elapsed[after] - elapsed[before]),
        std[before] + part * (std[after] - std[before]),
    )


class Scorer:
    """Holds the estimated heading against the truth, and against GPS that was withheld.

    Estimates are gathered, and compared many at once.

    Parameters
    ----------
    parameters : HeadingParameters
    outages : list of Outage
        Those in which GPS is withheld.

    Attributes
    ----------
    truth : ErrorAccount
        Errors against the truth from the first alignment on.
    listeners : list of callable
        Called with errors as they are found.
    """

    def __init__(self, parameters: HeadingParameters, outages: list[Outage]) -> None:
        self.truth = ErrorAccount()
        self.listeners: list[Callable[[Errors], None]] = []
        self._withheld = outages
        self._found: list[Outage] = []
        self._fix_delay_us = round(parameters.delay * 1e6)
        self._finder = HeadingFinder(parameters)
        self._by_boot, self._by_arrival = _Yaws(), _Yaws()
        self._gathered: list[EstimateBlock] = []
        self._epochs = 0  # in them
        self._elapsed = 0.0  # at the last epoch
        self._last: EstimateBlock | None = None

    @property
    def outages(self) -> list[Outage]:
        """Those that were asked for, and those that the log has, in the order of time."""
        found = [o for o in self._found if o.end - o.start >= SHORTEST_OUTAGE]
        return sorted([*self._withheld, *found], key=lambda outage: outage.start)

    def is_withheld(self) -> bool:
        """Whether GPS must not reach the filter now."""
        return any(outage.start <= self._elapsed <= outage.end for outage in self._withheld)

    def take_estimates(self, block: EstimateBlock) -> None:
        """Take the next estimates."""
        self._elapsed = float(block.elapsed[-1])
        self._last = block
        self._gathered.append(block)
        self._epochs += len(block)
        if self._epochs >= GATHERED:
            self._compare()

    def take_truth(self, time_us: Floats, yaw: Floats, by_boot: bool) -> None:
        """Take true yaws, (m,) rad, at times, (m,) us, of the boot clock or of the arrival."""
        (self._by_boot if by_boot else self._by_arrival).expect("truth", time_us, yaw)

    def take_withheld(self, fix: GpsFix) -> None:
        """Take a fix that the filter did not get."""
        heading = self._finder.take(fix, self._elapsed).heading
        if heading and self._last:
            now_us = int(self._last.boot_us[-1]) + self._last.delay_us
            valid_us = now_us - self._fix_delay_us - round(heading.age * 1e6)
            self._by_boot.expect("gps", np.array([valid_us]), np.array([heading.heading]))

    def finish(self) -> None:
        """Compare what is left at the end of the log."""
        self._compare()
        if self._found:
            self._found[-1].end = min(self._found[-1].end, self._elapsed)

    def _compare(self) -> None:
        blocks, self._gathered, self._epochs = self._gathered, [], 0
        if not blocks:
            return
        boot_us, taken_us, elapsed, state = map(
            np.concatenate, zip(*map(_columns, blocks), strict=True)
        )
        track = Track(np.concatenate([block.track.values for block in blocks]))
        yaw, aligned = yaws_of(track.q_nb), track.aligned
        self._follow_outages(elapsed, state)
        for yaws, time_us in ((self._by_boot, boot_us), (self._by_arrival, taken_us)):
            for errors in yaws.add(np.array([time_us, yaw, elapsed, track.yaw_std])[:, aligned]):
                self._account(errors)

    def _follow_outages(self, elapsed: Floats, state: NDArray[np.int64]) -> None:
        """Find the outages that the log itself has."""
        out = state == HeadingState.DEAD_RECKONING
        for outage in self._withheld:
            out &= ~outage.includes(elapsed)
        is_open = bool(self._found) and math.isinf(self._found[-1].end)
        for i in np.flatnonzero(np.diff(out, prepend=is_open)).tolist():
            if out[i]:
                self._found.append(Outage(float(elapsed[i]), math.inf))
            else:
                self._found[-1].end = float(elapsed[i])

    def _account(self, found: Errors) -> None:
        for listener in self.listeners:
            listener(found)
        reference, elapsed, errors, _ = found
        if reference == "truth":
            self.truth.add_all(elapsed, errors)
        for outage in (*self._withheld, *self._found):
            inside = outage.includes(elapsed)
            if inside.any():
                outage.errors[reference].add_all(elapsed[inside], errors[inside])


def _columns(block: EstimateBlock) -> tuple[NDArray[Any], ...]:
    taken_us = block.received_us - block.delay_us
    return block.boot_us, taken_us, block.elapsed, block.heading.state


def in_degrees(score: HeadingScore | None) -> dict[str, float | int | None]:
    """A score for JSON, in degrees."""
    names = ("rmse_deg", "final_deg", "max_deg", "drift_deg_per_min")
    if score is None:
        return dict.fromkeys(names)
    angles = (score.rmse, score.final, score.largest, score.drift * 60)
    return {name: round(math.degrees(a), 4) for name, a in zip(names, angles, strict=True)}
