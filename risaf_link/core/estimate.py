"""What is known at one epoch: all that is told to others."""

from dataclasses import dataclass

from risaf_link.core.attitude import AttitudeState
from risaf_link.core.fusion import FusedRate
from risaf_link.core.heading import HeadingStatus
from risaf_link.core.health import ArrayHealth


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
