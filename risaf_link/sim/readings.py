"""What the array of a scenario reads, in blocks of about a second."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.sensors import TriadArray
from risaf_link.sim.trajectory import Truth, sample_times


@dataclass(frozen=True, slots=True)
class Readings:
    """Consecutive epochs of an array of n gyros and m accelerometers; m is n or 0."""

    epoch: NDArray[np.int64]  # (k,) number of the epoch, from 0
    time_us: NDArray[np.int64]  # (k,) on the vehicle's clock
    truth: Truth
    rates_b: Floats  # (k, n, 3) rad/s
    forces_b: Floats  # (k, m, 3) specific force, m/s^2


def readings(scenario: Scenario) -> Iterator[Readings]:
    """Run a scenario's sensors; without MAVLink's rounding to counts."""
    n, rate = scenario.sensors, scenario.rate
    gyros = TriadArray(scenario.gyros, n, rate, scenario.generator("gyros"))
    accelerometers = scenario.accelerometers and TriadArray(
        scenario.accelerometers, n, rate, scenario.generator("accelerometers")
    )
    first = 0
    for time_s in sample_times(rate, scenario.duration):
        truth = scenario.trajectory(time_s)
        yield Readings(
            epoch=np.arange(first, first + len(time_s)),
            time_us=clock_us(time_s),
            truth=truth,
            rates_b=gyros.read(truth.rate_b),
            forces_b=accelerometers.read(truth.force_b)
            if accelerometers
            else np.zeros((len(time_s), 0, 3)),
        )
        first += len(time_s)


def clock_us(time_s: Floats) -> NDArray[np.int64]:
    """Read the vehicle's clock at these times from the start, microseconds."""
    return BOOT_US + np.rint(time_s * 1e6).astype(np.int64)
