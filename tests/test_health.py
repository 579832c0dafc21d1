"""Which sensors are healthy, suspect and dead by their silence alone, epoch by epoch."""

import numpy as np
import pytest

from risaf_link.core.health import Reason, SensorState, SilenceMonitor

DT = 0.1
HEALTHY, SUSPECT, DEAD = SensorState


@pytest.fixture
def monitor():
    return SilenceMonitor()


def watch(monitor, times, *valid, dt=DT):
    """Show epochs of one sensor for each argument: whether it has a valid reading."""
    rates = np.array([[0.0, 0.0, 0.0 if v else np.nan] for v in valid]).reshape(-1, 3)
    for _ in range(times):
        monitor.watch(rates, dt)
    return monitor.health().state.tolist()


def test_a_sensor_with_all_its_readings_is_healthy(monitor):
    assert watch(monitor, 100, True, True) == [HEALTHY, HEALTHY]


def test_a_silent_sensor_is_suspect_at_once_and_dead_after_more_than_a_second(monitor):
    watch(monitor, 5, True, True)
    assert watch(monitor, 1, True, False) == [HEALTHY, SUSPECT]
    assert watch(monitor, 8, True, False) == [HEALTHY, SUSPECT]
    assert watch(monitor, 3, True, False) == [HEALTHY, DEAD]
    assert monitor.health().reason.tolist() == [Reason.NONE, Reason.SILENT]


def test_a_sensor_that_speaks_again_is_healthy_and_its_silence_forgotten(monitor):
    watch(monitor, 50, True, False)
    assert watch(monitor, 1, True, True) == [HEALTHY, HEALTHY]
    assert watch(monitor, 5, True, False) == [HEALTHY, SUSPECT]


def test_a_sensor_that_never_spoke_is_dead_in_the_end(monitor):
    assert watch(monitor, 1, True, False, dt=0.0) == [HEALTHY, SUSPECT]
    assert watch(monitor, 20, True, False) == [HEALTHY, DEAD]


def test_one_axis_that_is_missing_or_infinite_makes_a_sensor_suspect(monitor):
    monitor.watch(np.array([[0, 0, np.inf], [0, np.nan, 0], [0, 0, 0]]), DT)
    assert monitor.health().state.tolist() == [SUSPECT, SUSPECT, HEALTHY]


def test_when_the_number_of_sensors_changes_all_are_judged_anew(monitor):
    watch(monitor, 50, True, False)
    assert watch(monitor, 1, True, False, False) == [HEALTHY, SUSPECT, SUSPECT]
    assert watch(monitor, 1, False) == [SUSPECT]
    assert watch(monitor, 1) == []
