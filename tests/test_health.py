"""Who is healthy, suspect and dead, epoch by epoch."""

import numpy as np
import pytest

from risaf_link.core.fusion import Epoch
from risaf_link.core.health import ArrayHealth, HealthMonitor

DT = 0.1


def epoch(*valid, dt=DT):
    """An epoch of one sensor for each argument: whether it has a valid reading."""
    rates = np.array([[0.0, 0.0, 0.0 if v else np.nan] for v in valid]).reshape(-1, 3)
    return Epoch(0, dt, rates, np.zeros((0, 3)), 0)


@pytest.fixture
def monitor():
    return HealthMonitor()


def watch(monitor, times, *valid):
    for _ in range(times):
        health = monitor.watch(epoch(*valid))
    return health


def test_a_sensor_with_all_its_readings_is_healthy(monitor):
    assert watch(monitor, 100, True, True) == ArrayHealth(healthy=2, suspect=0, dead=0)


def test_a_silent_sensor_is_suspect_at_once_and_dead_after_more_than_a_second(monitor):
    watch(monitor, 5, True, True)
    assert watch(monitor, 1, True, False) == ArrayHealth(healthy=1, suspect=1, dead=0)
    assert watch(monitor, 8, True, False) == ArrayHealth(healthy=1, suspect=1, dead=0)
    assert watch(monitor, 3, True, False) == ArrayHealth(healthy=1, suspect=0, dead=1)


def test_a_sensor_that_speaks_again_is_healthy_and_its_silence_forgotten(monitor):
    watch(monitor, 50, True, False)
    assert watch(monitor, 1, True, True) == ArrayHealth(healthy=2, suspect=0, dead=0)
    assert watch(monitor, 5, True, False) == ArrayHealth(healthy=1, suspect=1, dead=0)


def test_a_sensor_that_never_spoke_is_dead_in_the_end(monitor):
    assert watch(monitor, 1, True, False) == ArrayHealth(healthy=1, suspect=1, dead=0)
    assert watch(monitor, 20, True, False) == ArrayHealth(healthy=1, suspect=0, dead=1)


def test_one_axis_that_is_missing_or_infinite_makes_a_sensor_suspect(monitor):
    rates = np.array([[0, 0, np.inf], [0, np.nan, 0], [0, 0, 0]])
    health = monitor.watch(Epoch(0, DT, rates, np.zeros((0, 3)), 0))
    assert health == ArrayHealth(healthy=1, suspect=2, dead=0)


def test_a_clock_that_is_set_back_neither_kills_nor_revives(monitor):
    watch(monitor, 5, True, True)
    for time_us in (9_000_000, 100_000, 200_000):
        late = Epoch(time_us, DT, np.array([[0, 0, 0], [0, 0, np.nan]]), np.zeros((0, 3)), 0)
        assert monitor.watch(late) == ArrayHealth(healthy=1, suspect=1, dead=0)


def test_when_the_number_of_sensors_changes_all_are_judged_anew(monitor):
    watch(monitor, 50, True, False)
    assert watch(monitor, 1, True, False, False) == ArrayHealth(healthy=1, suspect=2, dead=0)
    assert watch(monitor, 1, False) == ArrayHealth(healthy=0, suspect=1, dead=0)
    assert watch(monitor, 1) == ArrayHealth(healthy=0, suspect=0, dead=0)
