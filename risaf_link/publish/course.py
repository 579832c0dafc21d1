"""The course of a run, for whoever looks back: what is kept of it does not grow with its length.

Estimates are gathered, and condensed many at once, by columns; the whole estimate is looked at only
now and then.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.attitude import Innovation
from risaf_link.core.estimate import ArrayStatus, EstimateBlock
from risaf_link.core.heading import Heading
from risaf_link.core.health import Reason, SensorState
from risaf_link.core.history import History, Worst
from risaf_link.core.outage import Errors, Reference
from risaf_link.core.rotation import Floats, eulers_of
from risaf_link.publish.events import GAP, Event, Events, Looks

GATHERED = 8192  # epochs that are condensed at once
MOST_EVENTS = 200
REASONS = len(Reason)

ROLL, PITCH, YAW_STD, TILT_STD, ACTIVE = 0, 1, 2, slice(3, 5), 5
BIAS, RATE = slice(6, 9), slice(9, 12)
COLUMNS = 12  # of `least` and `most`: rad, rad/s; ACTIVE in sensors
TIME, YAW, VALUE, STD, GATE, FUSED, RESET, RATIO = range(8)  # of `innovations`


@dataclass
class Standing:
    """How long each of n sensors was not healthy, and why."""

    suspect: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) s
    dead: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) s
    first: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) s, when it began; NaN: never
    last: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) s, when it ended
    reasons: Floats = field(default_factory=lambda: np.zeros((0, REASONS)))  # (n, reasons) s
    rejected: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) largest share of readings

    def add(self, status: ArrayStatus, begin: float, end: float) -> None:
        """Take note of how the sensors stood between two times, s."""
        health = status.health
        n = len(health.state)
        self._grow(n)
        span, ill = end - begin, health.state > SensorState.HEALTHY
        self.suspect[:n] += span * (health.state == SensorState.SUSPECT)
        self.dead[:n] += span * (health.state == SensorState.DEAD)
        self.reasons[np.arange(n), health.reason] += span
        self.first[:n] = np.where(ill, np.fmin(self.first[:n], begin), self.first[:n])
        self.last[:n] = np.where(ill, end, self.last[:n])
        self.rejected[:n] = np.maximum(self.rejected[:n], health.rejected)

    def _grow(self, n: int) -> None:
        more = n - len(self.dead)
        if more <= 0:
            return
        for name in ("suspect", "dead", "rejected"):
            setattr(self, name, np.append(getattr(self, name), np.zeros(more)))
        for name in ("first", "last"):
            setattr(self, name, np.append(getattr(self, name), np.full(more, np.nan)))
        self.reasons = np.vstack((self.reasons, np.zeros((more, REASONS))))


@dataclass
class ErrorCourse:
    """Heading errors against one reference over time."""

    least: History = field(default_factory=lambda: History("least", 1))  # rad
    most: History = field(default_factory=lambda: History("most", 1))
    count: int = 0
    within: NDArray[np.int64] = field(default_factory=lambda: np.zeros(3, np.int64))
    """how many were within one, two and three of the deviations that were stated."""

    def add(self, errors: Errors) -> None:
        """Take the next errors."""
        self.least.add(errors.elapsed, errors.error[:, np.newaxis])
        self.most.add(errors.elapsed, errors.error[:, np.newaxis])
        self.count += len(errors.error)
        sizes = np.abs(errors.error)[:, np.newaxis]
        self.within += (sizes <= errors.std[:, np.newaxis] * (1.0, 2.0, 3.0)).sum(axis=0)


class Course:
    """What one run came to, over time.

    Attributes
    ----------
    yaw : History
        rad, where it is known.
    least, most : History
        Of each step, of the columns that this module names; rad, rad/s, sensors.
    bias_std : History
        rad/s.
    epochs : History
        How many.
    lost : History
        Samples that never came.
    health : History
        Of each sensor, the worst of `8 * SensorState + Reason`.
    innovations : Worst
        Of GPS headings, in the columns that this module names: s, rad; `FUSED` and `RESET` 1 or 0.
    standing : Standing
    errors : dict
        By reference.
    gaps : list of (float, float)
        When no samples came, s from the first: begin and end.
    events : list of Event
        The first ones; `more_events` came after them.
    nis : float
        Mean of the innovations' squares over their variances, of the `fused` ones that were not
        resets; 1 is as stated.
    duration : float
        s.
    began_us : int
        When the first epoch was received, us since 1970.
    aligned_s : float or None
        When yaw was first known.
    """

    def __init__(self) -> None:
        self.yaw = History("first", 1)
        self.least, self.most = History("least", COLUMNS), History("most", COLUMNS)
        self.bias_std = History("most", 3)
        self.epochs, self.lost = History("sum", 1), History("sum", 1)
        self.health = History("most", 0)
        self.innovations = Worst(RATIO + 1)
        self.standing = Standing()
        self.errors: dict[Reference, ErrorCourse] = {}
        self.gaps: list[tuple[float, float]] = []
        self.events: list[Event] = []
        self.more_events = 0
        self.duration = 0.0
        self.began_us = 0
        self.aligned_s: float | None = None
        self._gathered: list[EstimateBlock] = []
        self._waiting = 0  # epochs in them
        self._looks, self._events = Looks(), Events()
        self._seen: list[tuple[float, int, Floats, Floats]] = []  # looks: s, samples, rad/s, codes
        self._looked, self._lost = 0.0, 0  # at the last look: s, samples
        self._condensed = 0.0  # s, at the last one that is condensed
        self.nis = 0.0
        self.fused = 0
        self._last: Innovation | None = None
        self._begun = False

    def take(self, block: EstimateBlock) -> None:
        """Take the next estimates."""
        if not self._begun:
            self._begun, self.began_us = True, int(block.received_us[0])
        self._gathered.append(block)
        self._waiting += len(block)
        heading, innovation = block.heading.heading, block.heading.innovation
        if innovation is not None and heading is not None and innovation is not self._last:
            self._last = innovation
            self._note_innovation(float(block.elapsed[0]), heading, innovation)
        looked = self._looks.estimate if self._looks.look(block) else None
        if looked is not None:
            self._note_array(looked.array, looked.elapsed, looked.attitude.bias_std)
        self._note_events(self._events.take(block, looked))
        if self._waiting >= GATHERED:
            self._condense()

    def take_errors(self, errors: Errors) -> None:
        """Take heading errors."""
        if len(errors.error):
            self.errors.setdefault(errors.reference, ErrorCourse()).add(errors)

    def finish(self) -> None:
        """Condense what is left at the end."""
        self._condense()

    def _condense(self) -> None:
        self._condense_looks()
        blocks, self._gathered, self._waiting = self._gathered, [], 0
        if not blocks:
            return
        elapsed = np.concatenate([block.elapsed for block in blocks])
        tracks = [block.track for block in blocks]
        values = _joined(track.angle_std for track in tracks)
        roll, pitch, yaw = eulers_of(_joined(track.q_nb for track in tracks))
        aligned = np.concatenate([track.aligned for track in tracks])
        columns = np.empty((len(elapsed), COLUMNS))
        columns[:, ROLL], columns[:, PITCH] = roll, pitch
        columns[:, YAW_STD] = np.where(aligned, values[:, 2], np.nan)
        columns[:, TILT_STD] = values[:, :2]
        columns[:, ACTIVE] = _joined(track.active for track in tracks).min(axis=1)
        columns[:, BIAS] = _joined(track.bias_b for track in tracks)
        columns[:, RATE] = _joined(track.rate_b for track in tracks)
        self.least.add(elapsed, columns)
        self.most.add(elapsed, columns)
        self.yaw.add(elapsed, np.where(aligned, yaw, np.nan)[:, np.newaxis])
        self.epochs.add(elapsed, np.ones((len(elapsed), 1)))
        if self.aligned_s is None and aligned.any():
            self.aligned_s = float(elapsed[aligned.argmax()])
        self._note_gaps(elapsed)
        self.duration = float(elapsed[-1])

    def _note_gaps(self, elapsed: Floats) -> None:
        steps = np.diff(elapsed, prepend=self.duration)
        for i in np.flatnonzero(steps > GAP)[: MOST_EVENTS - len(self.gaps)].tolist():
            self.gaps.append((float(elapsed[i] - steps[i]), float(elapsed[i])))

    def _note_innovation(self, elapsed: float, heading: Heading, innovation: Innovation) -> None:
        std = float(np.sqrt(innovation.variance))
        fused, reset, ratio = innovation.fused, innovation.reset, innovation.test_ratio
        row = (elapsed, heading.heading, innovation.value, std, innovation.gate, fused, reset)
        self.innovations.add((*row, ratio))
        if fused and not reset:
            self.fused += 1
            self.nis += (innovation.value**2 / innovation.variance - self.nis) / self.fused

    def _note_array(self, status: ArrayStatus, elapsed: float, bias_std: Floats) -> None:
        self.standing.add(status, self._looked, elapsed)
        codes: Floats = (8 * status.health.state + status.health.reason).astype(float)
        self._seen.append((elapsed, status.samples_lost - self._lost, bias_std, codes))
        self._looked, self._lost = elapsed, status.samples_lost

    def _condense_looks(self) -> None:
        looks, self._seen = self._seen, []
        if not looks:
            return
        elapsed = np.array([look[0] for look in looks])
        begin = np.append(self._condensed, elapsed[:-1])
        self._condensed = float(elapsed[-1])
        self.lost.add(elapsed, np.array([[float(look[1])] for look in looks]))
        self.bias_std.add(elapsed, np.array([look[2] for look in looks]))
        self.health.widen(max(len(look[3]) for look in looks))
        codes = np.full((len(looks), self.health.columns), np.nan)
        for row, look in zip(codes, looks, strict=True):
            row[: len(look[3])] = look[3]
        self.health.add(elapsed, codes)
        step = self.health.step  # how a sensor stands is how it stood since the look before
        first, last = (begin / step).astype(np.int64), (elapsed / step).astype(np.int64)
        spans = last - first + 1
        rows = np.repeat(np.arange(len(looks)), spans)
        within = np.arange(len(rows)) - (np.cumsum(spans) - spans)[rows]
        self.health.add((first[rows] + within + 0.5) * step, codes[rows])

    def _note_events(self, events: list[Event]) -> None:
        room = MOST_EVENTS - len(self.events)
        self.events += events[:room]
        self.more_events += max(0, len(events) - room)


def _joined(parts: Iterable[Floats | NDArray[np.int64]]) -> Floats:
    return np.concatenate(list(parts)).astype(float)
