"""The faults of sensors by name, and which of them, and of the receiver's, are on.

Every fault can be switched on and off without a change to any other, or to the sensors' noise.
Those that strike a share of the array strike different sensors, as far as there are enough.
"""

import math
from collections.abc import Iterable, Iterator, Mapping

from risaf_link.errors import ConfigError
from risaf_link.sim.disturbances import Ramps, Scale, Shocks, Spikes, Steps, Thermal
from risaf_link.sim.failures import Dropouts, Frozen, Invalid, Saturated
from risaf_link.sim.receiver_faults import RECEIVER_FAULTS, ReceiverFault
from risaf_link.sim.target import Fault

ONSET = (30.0, 200.0)  # s: in the aided part of a drive, or in the outage

# Of gyros, rad/s; the numbers are those that make a difference to an array of consumer parts.
FAULTS: dict[str, Fault] = {
    # At 100 sensors one on each axis of an epoch, in the mean: there is never an epoch to rest.
    # 300 times the noise: the mean of 100 sensors becomes three times as noisy as one good sensor.
    "spikes": Spikes(probability=0.01, amplitude=math.radians(30.0)),
    "shocks": Shocks(share=0.3, spacing=8.0, peak=math.radians(20.0), decay=0.3),
    "scale": Scale(error=0.01),
    "thermal": Thermal(common=math.radians(0.05), own=math.radians(0.1), time_constant=300.0),
    "steps": Steps(share=0.05, size=math.radians(2.0), onset=ONSET),
    "ramps": Ramps(share=0.05, slope=math.radians(0.02), onset=ONSET),
    "frozen": Frozen(share=0.02, onset=ONSET),
    "saturated": Saturated(share=0.01, onset=ONSET),
    "invalid": Invalid(share=0.1, every=30.0, length=0.5),
    "dropouts": Dropouts(share=0.05, returning=0.5, absence=30.0, onset=ONSET),
}
"""Every fault with the parameters that it has where a scenario does not say otherwise.

They strike in this order: who is stuck is stuck with the errors it had.
"""

OF_CHIPS = frozenset({"frozen", "saturated", "invalid", "dropouts"})
"""Faults of a chip as a whole: its gyro and its accelerometer fail together."""

WORDS = ("none", "default")


def choose(
    names: Iterable[str] | None,
    own: Mapping[str, Fault],
    own_of_receiver: Mapping[str, ReceiverFault],
) -> tuple[dict[str, Fault], dict[str, ReceiverFault]]:
    """Switch faults on.

    Parameters
    ----------
    names : iterable of str or None
        Of `FAULTS` and `RECEIVER_FAULTS`; `default` stands for the scenario's own, `none` for
        nothing. None: its own.
    own, own_of_receiver : mapping
        A scenario's own faults, of sensors and of the GPS receiver; where it has one, its
        parameters hold.

    Returns
    -------
    faults, receiver_faults : dict
        Of sensors, and of the GPS receiver.

    Raises
    ------
    ConfigError
        If there is no such fault.
    """
    on = set(_expand(["default"] if names is None else names, [*own, *own_of_receiver]))
    return (
        {name: own.get(name, usual) for name, usual in FAULTS.items() if name in on},
        {
            name: own_of_receiver.get(name, usual)
            for name, usual in RECEIVER_FAULTS.items()
            if name in on
        },
    )


def _expand(names: Iterable[str], own: Iterable[str]) -> Iterator[str]:
    for name in names:
        if name in FAULTS or name in RECEIVER_FAULTS:
            yield name
        elif name == "default":
            yield from own
        elif name != "none":
            known = ", ".join([*FAULTS, *RECEIVER_FAULTS, *WORDS])
            raise ConfigError(f"faults: {name!r}, expected one of {known}")
