"""A log through the pipeline, and how far its heading was from truth."""

import logging
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from risaf_link.config import Config, identity_of, load_calibration
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.heading import GpsFix
from risaf_link.core.outage import Outage, Scorer, in_degrees
from risaf_link.core.rotation import yaws_of
from risaf_link.errors import ConfigError, LogError
from risaf_link.links.file import read
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.commands import Peer
from risaf_link.mavlink.component import ORDERS, Component
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.identity import Identity
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.parameters import Parameters
from risaf_link.mavlink.telemetry import ComponentState, Emitter
from risaf_link.mavlink.tlog import SENT, Stamps, TlogReader, record
from risaf_link.mavlink.truth import Truths, truths_in
from risaf_link.pipeline import Pipeline
from risaf_link.remembered import memory_file

LOG: Peer = ("log", "")
T = TypeVar("T")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which part of a log is replayed, and when GPS is withheld; seconds."""

    start: float = 0.0  # of the log's own time, from its first record
    end: float = math.inf
    outages: tuple[tuple[float, float], ...] = ()  # from the first sample
    fixed: tuple[str, ...] = ()  # parameters that ground stations in the log do not set


class OutputLog:
    """What the service would have sent, as a tlog.

    Parameters
    ----------
    config : Config
    file : file object
        Written to.
    identity : Identity or None
        Of the service, which may change; None: as configured.
    """

    def __init__(self, config: Config, file: BinaryIO, identity: Identity | None = None) -> None:
        self._file = file
        self._identity = identity or identity_of(config)
        self._emitter = Emitter(config.emit, *config.own)
        self._second = -1

    def write(self, block: EstimateBlock) -> None:
        """Write the frames of the next estimates, and HEARTBEAT once a second."""
        self._emitter.system = self._identity.system
        self._emitter.profile = self._identity.profile
        for i, received_us in enumerate(block.received_us.tolist()):
            frames = self._emitter.emit(block.at(i))
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

    Attributes
    ----------
    identity : Identity
        Whom the service would have been.
    scorer : Scorer
    truth_listeners : list of callable
        Called with the true attitudes that the log states.

    Raises
    ------
    ConfigError
        If the calibration cannot be used.
    LogError
        If the log cannot be read.
    """

    def __init__(self, config: Config, path: Path, selection: Selection) -> None:
        self._path = path
        self._selection = selection
        memory = memory_file(config).read()
        self._pipeline = Pipeline(config, config.own, load_calibration(config), memory)
        self.identity = identity_of(config)
        parameters = Parameters(config, fixed={*selection.fixed, *config.unsettable})
        self._component = Component(parameters, self._pipeline, self.identity, keep=self._keep)
        self._gps = Ingest(config.array, config.gps, config.own)
        self._gps_ids = {IDS[name] for name in config.gps.messages}
        outages = [Outage(*outage) for outage in selection.outages]
        self.scorer = Scorer(config.heading, outages)
        self.truth_listeners: list[Callable[[Truths], None]] = []
        self._reader: TlogReader | None = None
        self._frames = 0
        self._last: EstimateBlock | None = None
        self._seconds = 0.0
        self._mismatch = ""  # why there were no estimates from some epochs

    def blocks(
        self, progress: Callable[[int], None] = lambda _: None, singly: bool = False
    ) -> Iterator[EstimateBlock]:
        """Run the log.

        Parameters
        ----------
        progress : callable
            Called now and then with the number of bytes read since the last call.
        singly : bool
            Epoch by epoch, as live: with the array's standing at each of them.

        Yields
        ------
        EstimateBlock
            The next estimates.

        Raises
        ------
        ConfigError, LogError
            If nothing in the log can be used; after the end.
        """
        began = time.perf_counter()
        received_us = 0
        reader = BlockReader(self._pipeline.ingest, self._pipeline.assembler, apart=ORDERS)
        for table, times_us in self._tables(progress):
            received_us = int(times_us[-1])
            for truth in truths_in(table, times_us):
                self.scorer.take_truth(truth.time_us, yaws_of(truth.q_nb), truth.by_boot)
                for listener in self.truth_listeners:
                    listener(truth)
            for item in _singly(table, times_us) if singly else reader.read(table, times_us):
                yield from self._take(item)
                self._mismatch = self._pipeline.mismatch or self._mismatch
                if singly:
                    yield from self._noted(self._pipeline.release())
        yield from self._noted(self._pipeline.flush(received_us))
        self.scorer.finish()
        self._seconds = time.perf_counter() - began
        if self._pipeline.recalled:
            _log.warning("%s: %s", self._path, self._pipeline.recalled)
        self._require_estimates()

    def summary(self) -> dict[str, Any]:
        """What was found, and how far the heading was off; for JSON."""
        counts = self._pipeline.assembler.counts
        last = self._last
        duration = float(last.elapsed[-1]) if last else 0.0
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
            "mismatch": self._mismatch,
            "truth": in_degrees(self.scorer.truth.score()),
            "outages": [row for outage in self.scorer.outages for row in outage.rows()],
            "unused": {
                reason: count
                for reason, count in (counts + self._pipeline.ingest.counts).items()
                if reason not in {"epochs", "incomplete", "samples_lost"}
            },
        }

    @property
    def array_name(self) -> str:
        """What the array calls itself; empty: nothing."""
        source = self._pipeline.assembler.source
        info = self._pipeline.ingest.info(source) if source else None
        return info.name if info else ""

    def _tables(self, progress: Callable[[int], None]) -> Iterator[tuple[FrameTable, Stamps]]:
        """Frames and times of what was selected."""
        first_us: int | None = None
        self._reader = TlogReader(read(self._path, progress))
        for table, times_us in _ahead(self._reader.tables()):
            first_us = int(times_us[0]) if first_us is None else first_us
            log_time = (times_us.astype(np.int64) - first_us) / 1e6
            late = log_time > self._selection.end
            until = int(late.argmax()) if late.any() else len(table)
            # Behind a clock that was set back, what came later is from before the first record.
            start = self._selection.start or -math.inf
            chosen = log_time[:until] >= start
            if chosen.any():
                self._frames += int(np.count_nonzero(chosen))
                yield table.part(slice(until)).part(chosen), times_us[:until][chosen]
            if until < len(table):
                return

    def _take(self, item: EpochBlock | tuple[Frame, int]) -> Iterator[EstimateBlock]:
        if isinstance(item, EpochBlock):
            yield from self._noted(self._advance(item))
            return
        frame, received_us = item
        if frame.message_id in self._gps_ids or frame.message_id in ORDERS:
            yield from self._noted(self._pipeline.release())
        if frame.message_id in ORDERS:
            self._order(frame, received_us)
        if frame.message_id in self._gps_ids and self.scorer.is_withheld():
            fix = self._gps.decode(frame, received_us)
            if isinstance(fix, GpsFix):
                self.scorer.take_withheld(fix)
            return
        yield from self._noted(self._pipeline.gather(frame, received_us))
        if self._component.is_calibrating:
            yield from self._noted(self._observed(self._pipeline.release()))

    def _advance(self, epochs: EpochBlock) -> list[EstimateBlock]:
        if not self._component.is_calibrating:
            return self._pipeline.advance(epochs)
        singles = map(self._pipeline.advance, epochs.each())
        return [block for blocks in singles for block in self._observed(blocks)]

    def _order(self, frame: Frame, received_us: int) -> None:
        """Take what another component said as the live run did, after all that came before it."""
        if self._last:
            self._component.observe(self._last.at(len(self._last) - 1))
        self._component.receive(frame, LOG, received_us)
        self._component.collect(())  # the answers are in the log
        self._gps.own = self._pipeline.ingest.own

    def _observed(self, blocks: list[EstimateBlock]) -> list[EstimateBlock]:
        for block in blocks:
            for estimate in block:
                self._component.observe(estimate)
        return blocks

    def _keep(self, parameters: dict[str, float]) -> None:
        """Take what a ground station has stored for stored; nothing is written."""
        self._component.kept(parameters)

    def _noted(self, blocks: list[EstimateBlock]) -> list[EstimateBlock]:
        for block in blocks:
            self._last = block
            self.scorer.take_estimates(block)
        return blocks

    def _require_estimates(self) -> None:
        if self._last is not None:
            return
        if self._mismatch:
            raise ConfigError(f"array.calibration: {self._mismatch}")
        if not self._frames:
            raise LogError(f"{self._path}: found no MAVLink frame, expected a tlog")
        raise LogError(
            f"{self._path}: found {self._frames} frames but no gyro samples, expected one of "
            "GYRO_ARRAY (with IMU_ARRAY_INFO), DEBUG_FLOAT_ARRAY, HIGHRES_IMU, RAW_IMU, SCALED_IMU"
        )


def _ahead(items: Iterator[T]) -> Iterator[T]:
    """Look for the next one in another thread, while one is used."""
    with ThreadPoolExecutor(1) as executor:
        coming = executor.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = executor.submit(next, items, None)
            yield item


def _singly(table: FrameTable, times_us: Stamps) -> Iterator[tuple[Frame, int]]:
    for row, time_us in enumerate(times_us.tolist()):
        yield table.frame(row), time_us
