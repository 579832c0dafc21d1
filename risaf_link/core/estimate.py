"""What is known at one epoch: all that is told to others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from msgspec import Struct
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


class Estimate:
    """The estimator's output at one epoch, put together as far as it is asked for.

    Attributes
    ----------
    time_us : int
        As the samples were stamped.
    """

    def __init__(self, block: "EstimateBlock", i: int) -> None:
        self._block, self._i = block, i
        self.time_us = int(block.time_us[i])

    @cached_property
    def elapsed(self) -> float:
        """Seconds since the first epoch, whatever the clocks did."""
        return float(self._block.elapsed[self._i])

    @cached_property
    def boot_us(self) -> int:
        """The instant that it tells of, on the vehicle's boot clock."""
        return int(self._block.boot_us[self._i])

    @cached_property
    def fused(self) -> FusedRate:
        """The array's rate."""
        return self._block.track.fused(self._i, self.time_us)

    @cached_property
    def attitude(self) -> AttitudeState:
        """The filter's attitude."""
        return self._block.track.attitude(self._i, self.time_us)

    @cached_property
    def heading(self) -> HeadingStatus:
        """GPS heading, and what came of it."""
        return self._block.heading.at(self._i, self.attitude)

    @cached_property
    def array(self) -> ArrayStatus:
        """The account of the array, when this is first asked for."""
        return self._block.array()


class EstimateBlock(Struct, frozen=True):
    """The estimator's output at k epochs between which no fix came."""

    time_us: NDArray[np.int64]  # (k,)
    received_us: NDArray[np.int64]  # (k,) when what made each of them possible came
    stamps: Callable[[], NDArray[np.int64]]  # boot_us
    delay_us: int  # by how much the samples lag behind their stamps; boot_us is without it
    elapsed: Floats  # (k,) s
    track: Track
    heading: HeadingTrack
    array: Callable[[], ArrayStatus]  # as of now

    @property
    def boot_us(self) -> NDArray[np.int64]:
        """The instants that they tell of, on the vehicle's boot clock, (k,)."""
        return self.stamps()

    def __len__(self) -> int:
        return len(self.time_us)

    def __iter__(self) -> Iterator[Estimate]:
        return map(self.at, range(len(self)))

    def at(self, i: int) -> Estimate:
        """The output at one epoch."""
        return Estimate(self, i)
