"""Whole epochs out of tables of frames, many at once, where all goes as usual.

What is usual: the array is the one that is listened to, and its scale is known; its frames bring
epoch after epoch, whole, with all sensors in order, numbered one by one; and nothing waits for what
is missing. Whatever else the pipeline reads is handed on frame by frame, in its place. So nothing
comes out otherwise than it would frame by frame; it only comes sooner.

A frame that has nothing to do with the array, a GPS fix, say, is handed on between two epochs; one
that came within an epoch, before it. Such a frame does not know that ingest and assembler have
taken epochs behind it already. What no estimate can depend on (an IMU_ARRAY_INFO that repeats the
last one, a HEARTBEAT of what is no autopilot) parts no block: it is handed on with what comes next.

The kernel finds the epochs. Where it was not built, every frame is handed on alone.
"""

from collections.abc import Collection, Iterator
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.compiled import native
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.rotation import Floats
from risaf_link.mavlink.choice import PATIENCE_US
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.epoch import (
    REVIEW,
    SET_US,
    EpochAssembler,
    GyroChunk,
    RegularEpochs,
    Source,
)
from risaf_link.mavlink.frame import Frame, FrameTable, cutter
from risaf_link.mavlink.gps import READERS
from risaf_link.mavlink.identity import NO_AUTOPILOT, autopilot_in
from risaf_link.mavlink.ingest import NONE, ArrayInfo, Ingest
from risaf_link.mavlink.tlog import Stamps

Columns = tuple[NDArray[np.int64], Floats, Floats, Floats, NDArray[np.int64]]
"""Those of an `EpochBlock`."""


class Kind(IntEnum):
    """What is done with a message."""

    IGNORED = 0  # nothing is read from it
    ASIDE = 1  # it has nothing to do with the array
    APART = 2  # it may change what the array's frames mean, or which array is listened to
    REFUSED = 3  # it is not listened to while the array is heard
    GYROS = 4
    FORCES = 5


class BlockReader:
    """Reads tables of frames for a pipeline.

    Parameters
    ----------
    ingest : Ingest
    assembler : EpochAssembler
        Of the pipeline: blocks are taken here, what comes alone is taken there.
    apart : collection of int
        Ids of messages that are not the pipeline's, and are to be handed on in their place as well.
    """

    def __init__(
        self, ingest: Ingest, assembler: EpochAssembler, apart: Collection[int] = ()
    ) -> None:
        self._ingest, self._assembler = ingest, assembler
        self._kinds = _kinds(ingest, apart)
        self._layout: native.ArrayLayout
        self._laid_out: tuple[Source, ArrayInfo, int, int] | None = None  # what for
        self._steady: bool | None = None  # None: a frame was handed on, or it was reviewed, since
        self._finder: native.EpochFinder | None = None
        if native:
            self._finder = native.EpochFinder(
                list(self._kinds), IDS["IMU_ARRAY_INFO"], SET_US, PATIENCE_US
            )

    def read(
        self, table: FrameTable, times_us: Stamps | int, longest: int = REVIEW
    ) -> Iterator[EpochBlock | tuple[Frame, int]]:
        """Read the next frames of a log.

        Parameters
        ----------
        table : FrameTable
        times_us : ndarray of uint64, or int
            When each frame was received, or all of them.
        longest : int
            Epochs of a block, at most.

        Yields
        ------
        EpochBlock, or Frame and int
            What follows next in the log. Ingest and assembler have taken a block already. A frame,
            with its time, must have gone through them when the next item is asked for.
        """
        if self._finder is None:
            rows = np.flatnonzero(np.isin(table.cuts["message_id"], np.flatnonzero(self._kinds)))
            yield from (_timed(table, row, times_us) for row in rows.tolist())
            return
        self._finder.load(table.buffer, table.records, times_us)
        while True:
            most = min(self._assembler.until_review, longest)
            block = self._block(table, most)
            if block is not None:
                done, idle = 0, list[tuple[Frame, int]]()
                for row, before in block.asides:
                    aside = _timed(table, row, times_us)
                    if _is_idle(aside[0]):
                        idle.append(aside)
                        continue
                    if done < before:
                        yield block.part(slice(done, before))
                    done = before
                    yield from idle
                    idle.clear()
                    yield aside
                yield block.part(slice(done, None)) if done else block
                yield from idle
                if block.end == len(table):
                    return
                if len(block) == most:
                    continue
            row = self._finder.single()
            if row == len(table):
                return
            self._steady = None
            yield _timed(table, row, times_us)

    @property
    def is_steady(self) -> bool:
        """Whether nothing waits, and the next epoch may be taken at once."""
        if self._steady is None:
            self._steady = False
            source = self._assembler.source
            if self._finder is not None and source is not None and source == self._ingest.source:
                info = self._ingest.info_of_counts(source)
                self._steady = self._assembler.is_steady(info.sensors)
                self._lay_out(source, info)
        return self._steady

    @property
    def last(self) -> tuple[int, int] | None:
        """Time, us, and number of the epoch on which the next may follow at once; None: none."""
        last = self._assembler.last
        if not self.is_steady or last is None or last.sequence is None:
            return None
        return last.time_us, last.sequence

    def next(self, frames: bytes, time_us: int, sequence: int) -> tuple[int, float, bytes] | None:
        """Read the next epoch alone, without taking it.

        Parameters
        ----------
        frames : bytes
        time_us, sequence : int
            Of the epoch before.

        Returns
        -------
        tuple or None
            Its time, us, seconds since the one before, and its readings: rates and behind them
            forces, as doubles. None: it is not the next one, or not whole, or there is something
            else.
        """
        if self._finder is None or cutter is None or not self.is_steady:
            return None
        return self._finder.next(cutter, frames, self._layout, time_us, sequence)

    def _block(self, table: FrameTable, most: int) -> RegularEpochs | None:
        last = self.last
        if self._finder is None or last is None or self._laid_out is None:
            return None
        source, info, gyros, forces = self._laid_out
        heard_us = self._ingest.heard_us
        found = self._finder.take(self._layout, *last, heard_us, most)
        if found is None:
            return None
        size, values, came_us, last_row, sequence, unusable, refused, asides = found
        columns = _columns(values, size, gyros, forces)
        newest_us, begun_us, heard_us = came_us
        time_us = columns[0].item(-1)
        of_epoch = 0, NONE, NONE, sequence, info.sensors
        newest = GyroChunk(source, time_us, newest_us, *of_epoch)
        begun = GyroChunk(source, time_us, begun_us, *of_epoch)
        block = RegularEpochs(*columns, newest, begun, last_row + 1, asides)
        self._ingest.take_block(heard_us, *unusable, map(table.frame, refused))
        self._assembler.take_block(block)
        if self._assembler.until_review == REVIEW:  # other sensors may be waited for from now on
            self._steady = None
        return block

    def _lay_out(self, source: Source, info: ArrayInfo) -> None:
        wanted = (source, info, self._assembler.sensors, self._assembler.forces)
        if wanted != self._laid_out:
            *_, gyros, forces = wanted
            self._laid_out = wanted
            self._layout = native.ArrayLayout(
                source.system,
                source.component,
                source.array_id,
                native.Sensors(gyros, *info.count_of(is_gyro=True)),
                native.Sensors(forces, *info.count_of(is_gyro=False)),
                info.told,
            )


def _timed(table: FrameTable, row: int, times_us: Stamps | int) -> tuple[Frame, int]:
    """A frame, and when it was received."""
    return table.frame(row), times_us if isinstance(times_us, int) else int(times_us[row])


def _columns(values: bytes, k: int, gyros: int, forces: int) -> Columns:
    """Columns of k epochs out of what the kernel made of them."""
    return (
        np.ndarray(k, np.int64, values),
        np.ndarray(k, float, values, 16 * k),
        np.ndarray((k, gyros, 3), float, values, 24 * k),
        np.ndarray((k, forces, 3), float, values, 24 * k * (1 + gyros)),
        np.ndarray(k, np.int64, values, 8 * k),
    )


def _is_idle(aside: Frame) -> bool:
    """Whether no estimate can depend on a frame that was found beside epochs."""
    return aside.message_id == IDS["IMU_ARRAY_INFO"] or (
        aside.message_id == IDS["HEARTBEAT"] and autopilot_in(aside) == NO_AUTOPILOT
    )


def _kinds(ingest: Ingest, apart: Collection[int]) -> bytearray:
    """Kind of every message, by its id."""
    kinds = dict.fromkeys((*apart, *ingest.message_ids), Kind.APART)
    clocks = {IDS["SYSTEM_TIME"], IDS["TIMESYNC"]}
    aside = {IDS[name] for name in (*READERS, "HEARTBEAT")}
    kinds |= dict.fromkeys(ingest.refused_ids, Kind.REFUSED)
    kinds |= dict.fromkeys(aside & ingest.message_ids | clocks, Kind.ASIDE)
    kinds |= {IDS["GYRO_ARRAY"]: Kind.GYROS, IDS["ACCEL_ARRAY"]: Kind.FORCES}
    by_id = bytearray(max(kinds) + 1)
    for message_id, kind in kinds.items():
        by_id[message_id] = kind
    return by_id
