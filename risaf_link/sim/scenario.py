"""The scenarios: which vehicle, which sensors, which faults."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import inf, radians
from typing import Literal

import numpy as np

from risaf_link.errors import ConfigError
from risaf_link.sim.disturbances import Ramps, Shocks
from risaf_link.sim.equipment import (
    CONSUMER_ACCELEROMETERS,
    CONSUMER_GYROS,
    EKF2_ACCELEROMETER,
    EKF2_GYRO,
    EKF2_RECEIVER,
    WARMING,
)
from risaf_link.sim.failures import Frozen, Invalid, Saturated
from risaf_link.sim.faults import FAULTS, choose
from risaf_link.sim.receiver import ReceiverParameters
from risaf_link.sim.receiver_faults import CourseError, ReceiverFault
from risaf_link.sim.routes import OUTAGE, PARAN, hills, paved, unpaved
from risaf_link.sim.sensors import TriadErrors
from risaf_link.sim.target import Fault
from risaf_link.sim.trajectory import Circle, Trajectory

BOOT_US = 1_000_000  # on the vehicle's clock at the start of every scenario
LIMITS = {"sensors": (1, 1000), "rate": (1, 1000), "duration": (0.001, 86_400)}

Part = Literal["gyros", "accelerometers", "receiver", "route", "victims"]
PARTS: tuple[Part, ...] = ("gyros", "accelerometers", "receiver", "route", "victims")


@dataclass(frozen=True, slots=True)
class Scenario:
    """All that a simulation depends on.

    Raises
    ------
    ConfigError
        If a value is outside of what can be simulated.
    """

    name: str
    trajectory: Trajectory
    gyros: TriadErrors
    accelerometers: TriadErrors | None  # None: the array has none
    receiver: ReceiverParameters
    duration: float  # s
    sensors: int
    rate: float  # Hz, epochs
    faults: Mapping[str, Fault] = field(default_factory=dict)  # those that are on
    receiver_faults: Mapping[str, ReceiverFault] = field(default_factory=dict)  # likewise
    outages: tuple[tuple[float, float], ...] = ()  # s; the receiver has no fix from, until
    seed: int = 0

    def __post_init__(self) -> None:
        for key, (low, high) in LIMITS.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ConfigError(f"{key}: {value}, expected {low} to {high}")

    def generator(self, part: Part, *child: int) -> np.random.Generator:
        """Make the generator of one part, or a child's: no part's draws depend on another's."""
        return _generator(self.seed, part, *child)


def _generator(seed: int, part: Part, *child: int) -> np.random.Generator:
    if seed < 0:
        raise ConfigError(f"seed: {seed}, expected 0 or more")
    key = (PARTS.index(part), *child)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def _circle(_: np.random.Generator) -> Scenario:
    """The paper's, section IV."""
    return Scenario(
        "circle",
        # A turn a minute, as on a roundabout of 200 m: 0.1 g to the side.
        Circle(PARAN, speed=10.0, radius=100.0),
        CONSUMER_GYROS,
        accelerometers=None,
        receiver=ReceiverParameters(),
        duration=300.0,
        sensors=100,
        rate=100.0,
        faults={"spikes": FAULTS["spikes"]},
    )


def _drive1(generator: np.random.Generator) -> Scenario:
    """Drive I of the paper, section V.B: constant speed, GPS cut after 100 s."""
    return Scenario(
        "drive1",
        paved(generator),
        CONSUMER_GYROS,
        CONSUMER_ACCELEROMETERS,
        receiver=ReceiverParameters(),
        duration=300.0,
        sensors=150,
        rate=100.0,
        faults={
            "spikes": FAULTS["spikes"],
            # Its sensor 60, figure 10: the relative bias goes astray, and further and further.
            "ramps": Ramps(share=0.02, slope=radians(0.02), onset=(20.0, 150.0)),
        },
        outages=((100.0, inf),),
    )


def _drive2(generator: np.random.Generator) -> Scenario:
    """Drive II of the paper, section V.B: an unpaved road, a third of the array shocked."""
    return Scenario(
        "drive2",
        unpaved(generator),
        replace(CONSUMER_GYROS, warming=WARMING),
        CONSUMER_ACCELEROMETERS,
        receiver=ReceiverParameters(),
        duration=800.0,
        sensors=100,
        rate=100.0,
        faults={
            "shocks": Shocks(share=0.3, spacing=8.0, peak=radians(20.0), decay=0.3),
            "frozen": Frozen(share=0.02, onset=(100.0, 500.0)),
            "saturated": Saturated(share=0.01, onset=(100.0, 500.0)),
        },
        outages=(OUTAGE,),
    )


def _ekf2(generator: np.random.Generator) -> Scenario:
    """A drive such as PX4's EKF2 was run on: one sound IMU."""
    return Scenario(
        "ekf2",
        hills(generator),
        EKF2_GYRO,
        EKF2_ACCELEROMETER,
        EKF2_RECEIVER,
        duration=300.0,
        sensors=1,
        rate=100.0,
        outages=((100.0, inf),),
    )


def _demo(generator: np.random.Generator) -> Scenario:
    """A drive of an hour on which faults come and go, to be looked at."""
    duration = 3600.0
    return Scenario(
        "demo",
        paved(generator),
        CONSUMER_GYROS,
        CONSUMER_ACCELEROMETERS,
        receiver=ReceiverParameters(),
        duration=duration,
        sensors=120,
        rate=100.0,
        faults={
            "spikes": FAULTS["spikes"],
            "shocks": Shocks(share=0.1, spacing=150.0, peak=radians(20.0), decay=0.3),
            "invalid": Invalid(share=0.1, every=60.0, length=20.0),
        },
        # Between two outages, and over a while before the next one.
        receiver_faults={
            "gps_jump": CourseError(size=radians(45.0), begin=120.0, length=15.0, every=240.0)
        },
        outages=tuple((start, start + 40.0) for start in np.arange(60.0, duration, 120.0).tolist()),
    )


SCENARIOS: dict[str, Callable[[np.random.Generator], Scenario]] = {
    "circle": _circle,
    "drive1": _drive1,
    "drive2": _drive2,
    "ekf2": _ekf2,
    "demo": _demo,
}
"""Every scenario by its name; made with what is drawn for its route."""


def scenario(
    name: str,
    seed: int,
    duration: float | None = None,
    sensors: int | None = None,
    rate: float | None = None,
    faults: Iterable[str] | None = None,
) -> Scenario:
    """Choose a scenario.

    Parameters
    ----------
    name : str
        One of `SCENARIOS`.
    seed : int
        Of everything random.
    duration, sensors, rate : optional
        Seconds, number, Hz; the scenario's own where None.
    faults : iterable of str, optional
        Those that are on, of `FAULTS` and `RECEIVER_FAULTS`; `default` stands for the scenario's
        own, `none` for nothing. The scenario's own where None. The drive, the noise and every other
        fault stay the same.

    Raises
    ------
    ConfigError
        If there is no such scenario or fault, or a value is outside of what can be simulated.
    """
    make = SCENARIOS.get(name)
    if make is None:
        raise ConfigError(f"scenario: {name!r}, expected one of {', '.join(SCENARIOS)}")
    chosen = make(_generator(seed, "route"))
    of_sensors, of_receiver = choose(faults, chosen.faults, chosen.receiver_faults)
    return replace(
        chosen,
        seed=seed,
        duration=chosen.duration if duration is None else duration,
        sensors=chosen.sensors if sensors is None else sensors,
        rate=chosen.rate if rate is None else rate,
        faults=of_sensors,
        receiver_faults=of_receiver,
    )
