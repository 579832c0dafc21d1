"""The ways of the scenarios' vehicles, drawn at random: another seed, another drive."""

import math

import numpy as np

from risaf_link.sim.drive import Drive
from risaf_link.sim.pace import Pace, SpeedChange, change_of_speed, wandering
from risaf_link.sim.road import Road, heave, shaking, waves
from risaf_link.sim.trajectory import Place

# Where the drives of the paper started, section V.B; the altitude is no more than likely.
PARAN = Place(math.radians(30.2217), math.radians(34.8012), altitude=300.0)

# As in the runs that PX4's EKF2 was given.
ZURICH = Place(math.radians(47.4), math.radians(8.5), altitude=450.0)


def paved(generator: np.random.Generator) -> Drive:
    """Drive at a constant 15 m/s on a winding road in the mountains."""
    road = Road(
        course=waves(
            generator,
            np.radians([35.0, 20.0, 12.0, 6.0]),
            (2300.0, 900.0, 500.0, 280.0),
            level=_any_angle(generator),
        ),
        slope=waves(generator, np.radians([2.0, 1.0]), (600.0, 210.0)),
        bank=waves(generator, np.radians([1.2, 0.5]), (400.0, 130.0)),
        shaking=(
            shaking(generator, math.radians(0.05)),
            shaking(generator, math.radians(0.05)),
            shaking(generator, math.radians(0.01)),
        ),
        heave=heave(generator, 0.001),
    )
    return Drive(PARAN, road, Pace(15.0))


STOP = (430.0, 460.0)  # s: in between the vehicle begins to brake
OUTAGE = (400.0, 650.0)  # s, of drive2


def unpaved(generator: np.random.Generator) -> Drive:
    """Drive south on an unpaved road: rest, changing speed, a stop of 30 s, changing speed."""
    road = Road(
        course=waves(
            generator,
            np.radians([35.0, 25.0, 15.0, 8.0]),
            (2000.0, 700.0, 300.0, 120.0),
            level=math.pi + generator.uniform(-0.5, 0.5),
        ),
        slope=waves(generator, np.radians([2.0, 1.0]), (500.0, 160.0)),
        bank=waves(generator, np.radians([1.5, 1.0]), (300.0, 90.0)),
        # At 10 m/s 5 deg/s of roll and pitch, 1 deg/s of yaw, 2 m/s^2 up and down.
        shaking=(
            shaking(generator, math.radians(0.5)),
            shaking(generator, math.radians(0.5)),
            shaking(generator, math.radians(0.1)),
        ),
        heave=heave(generator, 0.02),
    )
    stop = float(generator.uniform(*STOP))
    before = _wander_from_rest(generator, 10.0, stop)
    speed = sum(c.change for c in before)
    brake = change_of_speed(stop, -speed)
    after = _wander_from_rest(generator, stop + brake.length + 30.0, 1000.0)
    return Drive(PARAN, road, Pace(0.0, (*before, brake, *after)))


def _wander_from_rest(
    generator: np.random.Generator, start: float, end: float
) -> list[SpeedChange]:
    return wandering(generator, (start, end), speeds=(5.0, 13.0), holds=(10.0, 40.0), speed=0.0)


def hills(generator: np.random.Generator) -> Drive:
    """Rest for 10 s, gain 15 m/s within 10 s, and go on about as fast over hills and curves.

    Angles and angular rates are those of the runs that PX4's EKF2 was given.
    """
    road = Road(
        course=waves(
            generator, np.radians([36.0, 18.0, 22.0]), (2100.0, 900.0, 600.0), _any_angle(generator)
        ),
        slope=waves(generator, np.radians([2.4, 0.7]), (430.0, 130.0)),
        bank=waves(generator, np.radians([1.9, 0.7]), (350.0, 95.0)),
    )
    gain = SpeedChange(10.0, 10.0, 15.0)
    after = wandering(generator, (20.0, 400.0), speeds=(13.5, 16.5), holds=(2.0, 8.0), speed=15.0)
    return Drive(ZURICH, road, Pace(0.0, (gain, *after)))


def _any_angle(generator: np.random.Generator) -> float:
    return float(generator.uniform(-math.pi, math.pi))
