"""The scenarios: which vehicle, which sensors, which faults."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from risaf_link.errors import ConfigError
from risaf_link.sim.receiver import ReceiverParameters
from risaf_link.sim.sensors import TriadErrors
from risaf_link.sim.trajectory import Circle, Place, Trajectory

BOOT_US = 1_000_000  # on the vehicle's clock at the start of every scenario
LIMITS = {"sensors": (1, 1000), "rate": (1, 1000), "duration": (0.001, 86_400)}

Part = Literal["gyros", "accelerometers", "receiver"]
PARTS: tuple[Part, ...] = ("gyros", "accelerometers", "receiver")


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
    seed: int = 0

    def __post_init__(self) -> None:
        for key, (low, high) in LIMITS.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ConfigError(f"{key}: {value}, expected {low} to {high}")
        if self.seed < 0:
            raise ConfigError(f"seed: {self.seed}, expected 0 or more")

    def generator(self, part: Part) -> np.random.Generator:
        """Make the generator of one part: no part's draws depend on another's."""
        key = (PARTS.index(part),)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


# Gyros as a calibrated array of consumer parts has them; the paper gives no numbers. Data sheet:
# that of the MPU-6050, rev. 3.4, section 6.1.
CONSUMER_GYROS = TriadErrors(
    # Twice the data sheet's, which is that of one part at 10 Hz and rest: 0.1 deg/s a sample at
    # 100 Hz, 0.6 deg/sqrt(h).
    noise_density=math.radians(0.01),
    # What calibration leaves from one power-up to the next; the data sheet allows 20 without.
    initial_bias=math.radians(0.2),
    # An Allan deviation of 0.017 deg/s at 100 s, as of a part whose temperature changes; 100 of
    # them together turn 0.5 deg in 200 s without GPS.
    bias_walk=math.radians(0.003),
    # At 100 sensors one on each axis of an epoch, in the mean: there is never an epoch to rest.
    spike_probability=0.01,
    # 300 times the noise: the mean of 100 sensors becomes three times as noisy as one good sensor.
    spike_amplitude=math.radians(30.0),
    # The data sheet's smallest; a count is a thirteenth of the noise.
    full_scale=math.radians(250.0),
)

# Where the drives of the paper started, section V.B; the altitude is no more than likely.
PARAN = Place(math.radians(30.2217), math.radians(34.8012), altitude=300.0)

SCENARIOS = {
    "circle": Scenario(
        "circle",
        # A turn a minute, as on a roundabout of 200 m: 0.1 g to the side.
        Circle(PARAN, speed=10.0, radius=100.0),
        CONSUMER_GYROS,
        accelerometers=None,
        receiver=ReceiverParameters(),
        duration=300.0,
        sensors=100,
        rate=100.0,
    ),
}
"""Every scenario by its name. `circle` is the paper's, section IV."""


def scenario(
    name: str,
    seed: int,
    duration: float | None = None,
    sensors: int | None = None,
    rate: float | None = None,
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

    Raises
    ------
    ConfigError
        If there is no such scenario, or a value is outside of what can be simulated.
    """
    chosen = SCENARIOS.get(name)
    if chosen is None:
        raise ConfigError(f"scenario: {name!r}, expected one of {', '.join(SCENARIOS)}")
    return replace(
        chosen,
        seed=seed,
        duration=chosen.duration if duration is None else duration,
        sensors=chosen.sensors if sensors is None else sensors,
        rate=chosen.rate if rate is None else rate,
    )
