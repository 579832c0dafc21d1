"""A log through the pipeline, and how far its heading was from truth."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal

from risaf_link.config import Config, load_calibration
from risaf_link.core.estimate import Estimate
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingParameters, HeadingState
from risaf_link.core.rotation import wrap, yaw_of
from risaf_link.core.scoring import ErrorAccount, HeadingScore, YawTrack
from risaf_link.errors import ConfigError, LogError
from risaf_link.links.file import read
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.ingest import Ingest, Truth, truth_of
from risaf_link.mavlink.telemetry import ComponentState, Emitter
from risaf_link.mavlink.tlog import SENT, Record, TlogReader, record
from risaf_link.pipeline import Pipeline

SHORTEST_OUTAGE = 5.0  # s, of those that are found in a log

Reference = Literal["truth", "gps"]


@dataclass(frozen=True, slots=True)
class Selection:
    """Which part of a log is replayed, and when GPS is withheld; seconds."""

    start: float = 0.0  # of the log's own time, from its first record
    end: float = math.inf
    outages: tuple[tuple[float, float], ...] = ()  # from the first sample


@dataclass
class Outage:
    """A time without GPS, and the heading errors in it."""

    start: float  # s from the first sample
    end: float
    errors: dict[Reference, ErrorAccount] = field(default_factory=dict)

    def add(self, reference: Reference, elapsed: float, error: float) -> None:
        """Take one error, if it is of this outage."""
        if self.start <= elapsed <= self.end:
            self.errors.setdefault(reference, ErrorAccount()).add(elapsed, error)

    def rows(self) -> list[dict[str, Any]]:
        """One row a reference, for JSON; one without numbers if there was nothing to compare."""
        scores: dict[Reference | None, HeadingScore | None]
        scores = {name: account.score() for name, account in self.errors.items()} or {None: None}
        return [
            {
                "start_s": round(self.start, 3),
                "end_s": round(self.end, 3),
                "reference": reference,
                **_degrees(score),
            }
            for reference, score in scores.items()
        ]


class Scorer:
    """Holds the estimated heading against the truth, and against GPS that was withheld.

    Attributes
    ----------
    truth : ErrorAccount
        Errors against the truth from the first alignment on.
    trace : list of (float, str, float)
        Every error, where it is to be kept: elapsed seconds, reference, rad.
    """

    def __init__(
        self, parameters: HeadingParameters, outages: list[Outage], keep_trace: bool
    ) -> None:
        self.truth = ErrorAccount()
        self.trace: list[tuple[float, Reference, float]] = []
        self._keep_trace = keep_trace
        self._withheld = outages
        self._found: list[Outage] = []
        self._delay_us = round(parameters.delay * 1e6)
        self._finder = HeadingFinder(parameters)
        self._by_boot, self._by_arrival = YawTrack(), YawTrack()
        self._pending: deque[tuple[YawTrack, int, float]] = deque(maxlen=1000)
        self._last: Estimate | None = None

    @property
    def outages(self) -> list[Outage]:
        """Those that were asked for, and those that the log has, in the order of time."""
        found = [o for o in self._found if o.end - o.start >= SHORTEST_OUTAGE]
        return sorted([*self._withheld, *found], key=lambda outage: outage.start)

    def is_withheld(self) -> bool:
        """Whether GPS must not reach the filter now."""
        now = self._last.elapsed if self._last else 0.0
        return any(outage.start <= now <= outage.end for outage in self._withheld)

    def take_estimate(self, estimate: Estimate, received_us: int) -> None:
        """Take the next estimate."""
        self._last = estimate
        yaw = estimate.attitude.euler[2]
        if estimate.attitude.aligned:
            self._by_boot.add(estimate.boot_us, yaw)
            self._by_arrival.add(received_us, yaw)
        self._follow_outage(estimate)
        while self._pending and self._is_due(*self._pending[0]):
            track, time_us, true_yaw = self._pending.popleft()
            self._compare("truth", track.at(time_us), true_yaw)

    def take_truth(self, truth: Truth, received_us: int) -> None:
        """Take a true attitude; it is compared as soon as the estimate has come that far."""
        by_boot = truth.time_us is not None
        track = self._by_boot if by_boot else self._by_arrival
        time_us = truth.time_us if truth.time_us is not None else received_us
        self._pending.append((track, time_us, yaw_of(truth.q_nb)))

    def take_withheld(self, fix: GpsFix) -> None:
        """Take a fix that the filter did not get."""
        if self._last is None:
            return
        motion = self._finder.take(fix, self._last.elapsed)
        if motion.heading:
            valid_us = self._last.boot_us - self._delay_us - round(motion.heading.age * 1e6)
            self._compare("gps", self._by_boot.at(valid_us), motion.heading.heading)

    def _is_due(self, track: YawTrack, time_us: int, _: float) -> bool:
        newest_us = track.newest_us
        return newest_us is not None and newest_us >= time_us

    def _compare(self, reference: Reference, yaw: float | None, expected: float) -> None:
        estimate = self._last
        if yaw is None or estimate is None or not estimate.attitude.aligned:
            return
        error = wrap(yaw - expected)
        if self._keep_trace:
            self.trace.append((estimate.elapsed, reference, error))
        if reference == "truth":
            self.truth.add(estimate.elapsed, error)
        for outage in (*self._withheld, *self._found[-1:]):
            outage.add(reference, estimate.elapsed, error)

    def _follow_outage(self, estimate: Estimate) -> None:
        """Find the outages that the log itself has."""
        now = estimate.elapsed
        is_out = estimate.heading.state is HeadingState.DEAD_RECKONING and not self.is_withheld()
        is_open = bool(self._found) and math.isinf(self._found[-1].end)
        if is_out and not is_open:
            self._found.append(Outage(now, math.inf))
        elif is_open and not is_out:
            self._found[-1].end = now

    def finish(self) -> None:
        """Close what is open at the end of the log."""
        if self._last and self._found:
            self._found[-1].end = min(self._found[-1].end, self._last.elapsed)


class OutputLog:
    """What the service would have sent, as a tlog."""

    def __init__(self, config: Config, file: BinaryIO) -> None:
        self._file = file
        self._emitter = Emitter(config.emit, *config.own)
        self._second = -1

    def write(self, estimate: Estimate, received_us: int) -> None:
        """Write the frames of one estimate, and HEARTBEAT once a second."""
        frames = self._emitter.emit(estimate)
        second = received_us // 1_000_000
        if second != self._second:
            self._second = second
            frames.append(self._emitter.heartbeat(ComponentState.ACTIVE))
        for raw in frames:
            self._file.write(record(received_us, raw, SENT))


class Replay:
    """One log, replayed.

    Parameters
    ----------
    config : Config
    path : Path
        A tlog.
    selection : Selection
    keep_trace : bool
        Keep every heading error, for a plot.

    Attributes
    ----------
    scorer : Scorer

    Raises
    ------
    ConfigError
        If the calibration cannot be used.
    LogError
        If the log cannot be read.
    """

    def __init__(
        self, config: Config, path: Path, selection: Selection, keep_trace: bool = False
    ) -> None:
        self._path = path
        self._selection = selection
        self._pipeline = Pipeline(config, config.own, load_calibration(config))
        self._gps = Ingest(config.array, config.gps, config.own)
        self._gps_ids = {IDS[name] for name in config.gps.messages}
        outages = [Outage(*outage) for outage in selection.outages]
        self.scorer = Scorer(config.heading, outages, keep_trace)
        self._reader: TlogReader | None = None
        self._frames = 0
        self._last: Estimate | None = None
        self._seconds = 0.0

    def estimates(
        self, progress: Callable[[int], None] = lambda _: None
    ) -> Iterator[tuple[int, Estimate]]:
        """Run the log.

        Parameters
        ----------
        progress : callable
            Called now and then with the number of bytes read since the last call.

        Yields
        ------
        received_us : int
            When the log had received what made the estimate possible.
        estimate : Estimate

        Raises
        ------
        ConfigError, LogError
            If nothing in the log can be used; after the end.
        """
        began = time.perf_counter()
        received_us = 0
        for logged in self._records(progress):
            received_us = logged.time_us
            for estimate in self._take(logged):
                yield received_us, estimate
        for estimate in self._pipeline.flush(received_us):
            self._note(estimate, received_us)
            yield received_us, estimate
        self.scorer.finish()
        self._seconds = time.perf_counter() - began
        self._require_estimates()

    def summary(self) -> dict[str, Any]:
        """What was found, and how far the heading was off; for JSON."""
        counts = self._pipeline.assembler.counts
        last = self._last
        duration = last.elapsed if last else 0.0
        parser = self._reader.parser if self._reader else None
        return {
            "frames": self._frames,
            "dropped": dict(parser.dropped) if parser else {},
            "bytes_skipped": parser.skipped if parser else 0,
            "epochs": counts["epochs"],
            "epochs_incomplete": counts["incomplete"],
            "samples_lost": counts["samples_lost"],
            "sensors": self._pipeline.assembler.sensors,
            "duration_s": round(duration, 6),
            "realtime_factor": round(duration / max(self._seconds, 1e-9), 1),
            "heading": {
                "fused": last.heading.fused_count if last else 0,
                "rejected": last.heading.rejected_count if last else 0,
            },
            "truth": _degrees(self.scorer.truth.score()),
            "outages": [row for outage in self.scorer.outages for row in outage.rows()],
            "unused": {
                reason: count
                for reason, count in (counts + self._pipeline.ingest.counts).items()
                if reason not in {"epochs", "incomplete", "samples_lost"}
            },
        }

    def _records(self, progress: Callable[[int], None]) -> Iterator[Record]:
        first_us: int | None = None
        self._reader = TlogReader(read(self._path, progress))
        for logged in self._reader:
            first_us = logged.time_us if first_us is None else first_us
            log_time = (logged.time_us - first_us) / 1e6
            if log_time > self._selection.end:
                return
            if log_time >= self._selection.start:
                self._frames += 1
                yield logged

    def _take(self, logged: Record) -> Iterator[Estimate]:
        received_us, frame = logged
        truth = truth_of(frame)
        if truth:
            self.scorer.take_truth(truth, received_us)
        if frame.message_id in self._gps_ids and self.scorer.is_withheld():
            fix = self._gps.decode(frame, received_us)
            if isinstance(fix, GpsFix):
                self.scorer.take_withheld(fix)
            return
        for estimate in self._pipeline.step(frame, received_us):
            self._note(estimate, received_us)
            yield estimate

    def _note(self, estimate: Estimate, received_us: int) -> None:
        self._last = estimate
        self.scorer.take_estimate(estimate, received_us)

    def _require_estimates(self) -> None:
        if self._last is not None:
            return
        if self._pipeline.mismatch:
            raise ConfigError(f"array.calibration: {self._pipeline.mismatch}")
        if not self._frames:
            raise LogError(f"{self._path}: found no MAVLink frame, expected a tlog")
        raise LogError(
            f"{self._path}: found {self._frames} frames but no gyro samples, expected one of "
            "GYRO_ARRAY (with IMU_ARRAY_INFO), DEBUG_FLOAT_ARRAY, HIGHRES_IMU, RAW_IMU, SCALED_IMU"
        )


def _degrees(score: HeadingScore | None) -> dict[str, float | int | None]:
    names = ("rmse_deg", "final_deg", "max_deg", "drift_deg_per_min")
    if score is None:
        return dict.fromkeys(names)
    angles = (score.rmse, score.final, score.largest, score.drift * 60)
    return {name: round(math.degrees(a), 4) for name, a in zip(names, angles, strict=True)}
