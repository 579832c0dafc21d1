"""What the array of a scenario reads, in blocks of about a second."""

from collections.abc import Container, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.sim.faults import FAULTS, OF_CHIPS
from risaf_link.sim.ideal import mean_readings
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.sensors import TriadArray
from risaf_link.sim.target import Strike, Target
from risaf_link.sim.trajectory import sample_times


@dataclass(frozen=True, slots=True)
class Readings:
    """Consecutive epochs of an array of n gyros and m accelerometers; m is n or 0."""

    epoch: NDArray[np.int64]  # (k,) number of the epoch, from 0
    time_us: NDArray[np.int64]  # (k,) on the vehicle's clock
    ideal_rates_b: Floats  # (k, 3) rad/s, what perfect gyros would read
    ideal_forces_b: Floats  # (k, 3) m/s^2, what perfect accelerometers would
    rates_b: Floats  # (k, n, 3) rad/s
    forces_b: Floats  # (k, m, 3) specific force, m/s^2


def readings(scenario: Scenario) -> Iterator[Readings]:
    """Run a scenario's sensors; without MAVLink's rounding to counts."""
    n, rate = scenario.sensors, scenario.rate
    gyros = TriadArray(
        scenario.gyros, n, rate, scenario.generator("gyros"), strikes(scenario, FAULTS)
    )
    accelerometers = scenario.accelerometers and TriadArray(
        scenario.accelerometers,
        n,
        rate,
        scenario.generator("accelerometers"),
        strikes(scenario, OF_CHIPS),
    )
    first = 0
    for time_s in sample_times(rate, scenario.duration):
        before_s = np.array([(first - 1) / rate])
        motion = scenario.trajectory(np.concatenate([before_s, time_s]))
        rates_b, forces_b = mean_readings(motion)
        yield Readings(
            epoch=np.arange(first, first + len(time_s)),
            time_us=clock_us(time_s),
            ideal_rates_b=rates_b,
            ideal_forces_b=forces_b,
            rates_b=gyros.read(rates_b),
            forces_b=accelerometers.read(forces_b)
            if accelerometers
            else np.zeros((len(time_s), 0, 3)),
        )
        first += len(time_s)


def strikes(scenario: Scenario, names: Container[str]) -> list[Strike]:
    """Begin the scenario's faults, those of the names.

    Every fault has the same generators whatever it strikes: gyros and accelerometers of a chip fail
    together.
    """
    n = scenario.sensors
    order = scenario.generator("victims").permutation(n)
    begun = []
    for i, name in enumerate(FAULTS):
        if name in scenario.faults and name in names:
            target = Target(
                sensors=n,
                trajectory=scenario.trajectory,
                duration=scenario.duration,
                order=order,
                first=n * i // len(FAULTS),
                when=scenario.generator("gyros", 3 + 2 * i),
                how_much=scenario.generator("gyros", 4 + 2 * i),
            )
            begun.append(scenario.faults[name].strike(target))
    return begun


def clock_us(time_s: Floats) -> NDArray[np.int64]:
    """Read the vehicle's clock at these times from the start, microseconds."""
    return BOOT_US + np.rint(time_s * 1e6).astype(np.int64)
