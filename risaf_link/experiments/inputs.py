"""What a simulated array and receiver give to every method: the content of the frames.

Nothing is framed and parsed, but values are those that the frames carry: counts of the sensors'
resolution, GPS in the units of its message.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from risaf_link.core.fusion import Epoch
from risaf_link.core.heading import HeadingFinder, HeadingParameters
from risaf_link.core.rotation import Floats, yaw_of
from risaf_link.experiments.method import ArrayModel, Gps
from risaf_link.mavlink.gps import READERS
from risaf_link.mavlink.ingest import INT16_LIMIT
from risaf_link.sim import autopilot
from risaf_link.sim.array import count_scale
from risaf_link.sim.readings import readings
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.sensors import TriadErrors

NEAR_RANGE = 1.0 - 1e-6  # of the range; a reading beyond is at its end


@dataclass(frozen=True, slots=True)
class Instant:
    """One epoch, the truth at it, and the fixes that came until the next."""

    elapsed: float  # s from the first epoch
    epoch: Epoch
    yaw: float  # rad, true
    rate_b: Floats  # (3,) rad/s, what a perfect gyro reads
    fixes: list[Gps] = field(default_factory=list)


def array_model(scenario: Scenario) -> ArrayModel:
    """Tell what the data sheet of a scenario's gyros tells."""
    g = scenario.gyros
    noise = g.noise_density * float(np.sqrt(scenario.rate))
    return ArrayModel(scenario.sensors, scenario.rate, noise, g.initial_bias, g.bias_walk)


def instants(scenario: Scenario, heading: HeadingParameters) -> Iterator[Instant]:
    """Run a scenario.

    Parameters
    ----------
    scenario : Scenario
    heading : HeadingParameters
        How headings are made from fixes.
    """
    fixes = list(_fixes(scenario, heading))
    next_fix = 0
    last_us: int | None = None
    for block in readings(scenario):
        rates = as_sent(block.rates_b, scenario.gyros)
        forces = block.forces_b
        if scenario.accelerometers:
            forces = as_sent(forces, scenario.accelerometers)
        truth = scenario.trajectory((block.time_us - BOOT_US) / 1e6)
        for k, time_us in enumerate(block.time_us.tolist()):
            dt = (time_us - last_us) / 1e6 if last_us is not None else 0.0
            last_us = time_us
            came = next_fix
            while next_fix < len(fixes) and fixes[next_fix][0] < time_us + 1e6 / scenario.rate:
                next_fix += 1
            yield Instant(
                (time_us - BOOT_US) / 1e6,
                Epoch(time_us, dt, rates[k], forces[k], 0),
                yaw_of(truth.q_nb[k]),
                block.ideal_rates_b[k],
                [gps for _, gps in fixes[came:next_fix]],
            )


def as_sent(values: Floats, errors: TriadErrors) -> Floats:
    """Readings as they come out of frames: whole counts, and NaN at the end of the range."""
    scale = count_scale(errors)
    limit = min(float(np.float32(errors.full_scale)) * NEAR_RANGE, INT16_LIMIT * scale)
    sent = np.rint(values / scale) * scale
    sent[~(np.abs(sent) < limit)] = np.nan
    return sent


def _fixes(scenario: Scenario, heading: HeadingParameters) -> Iterator[tuple[int, Gps]]:
    """Fixes, and when they come, us."""
    finder = HeadingFinder(heading)
    for message in autopilot.gps(scenario):
        fix, _ = READERS["GPS_RAW_INT"](message.payload)
        if fix.usable:
            motion = finder.take(fix, (message.time_us - BOOT_US) / 1e6)
            yield message.time_us, Gps(motion, fix.latitude, heading.delay)


def with_gps_throughout(scenario: Scenario) -> Scenario:
    """The same drive with a receiver that is never silent: its fixes can be withheld, and judge."""
    return replace(scenario, outages=())
