"""What is known at one epoch: all that is told to others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.attitude import AttitudeState
from risaf_link.core.fusion import FusedRate
from risaf_link.core.heading import HeadingStatus, HeadingTrack
from risaf_link.core.health import ArrayHealth
from risaf_link.core.rotation import Floats
from risaf_link.core.track import Track


@dataclass(frozen=True, slots=True)
class ArrayStatus:
    """The account of the array: how much came, how much of it is good."""

    array_id: int
    epochs: int
    epochs_incomplete: int
    samples_lost: int
    sensors: int  # that the array has
    health: ArrayHealth


@dataclass(frozen=True, slots=True)
class Estimate:
    """The estimator's output at one epoch."""

    time_us: int  # as the samples were stamped
    boot_us: int  # the same instant on the vehicle's boot clock
    elapsed: float  # seconds since the first epoch, whatever the clocks did
    fused: FusedRate
    attitude: AttitudeState
    heading: HeadingStatus
    array: ArrayStatus


@dataclass(frozen=True, slots=True)
class EstimateBlock:
    """The estimator's output at k epochs between which no fix came."""

    time_us: NDArray[np.int64]  # (k,)
    received_us: NDArray[np.int64]  # (k,) when what made each of them possible came
    boot_us: NDArray[np.int64]  # (k,)
    elapsed: Floats  # (k,) s
    track: Track
    heading: HeadingTrack
    array: Callable[[], ArrayStatus]  # as of now: to be asked before the next epochs come

    def __len__(self) -> int:
        return len(self.time_us)

    def __iter__(self) -> Iterator[Estimate]:
        return map(self.at, range(len(self)))

    def at(self, i: int) -> Estimate:
        """The output at one epoch."""
        time_us = int(self.time_us[i])
        attitude = self.track.attitude(i, time_us)
        return Estimate(
            time_us,
            int(self.boot_us[i]),
            float(self.elapsed[i]),
            self.track.fused(i, time_us),
            attitude,
            self.heading.at(i, attitude),
            self.array(),
        )
