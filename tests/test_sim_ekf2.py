"""The scenario `ekf2` is like the drives that PX4's EKF2 was run on."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from risaf_link.sim.autopilot import is_lost
from risaf_link.sim.readings import readings
from risaf_link.sim.receiver import fixes
from risaf_link.sim.scenario import scenario

CHECKOUT = Path(__file__).resolve().parents[1]
RUNS = Path(os.environ.get("RISAF_DATA", CHECKOUT.parent / "shared" / "data")) / "ekf2_runs"

needs_runs = pytest.mark.skipif(
    not RUNS.is_dir(), reason=f"no recorded runs in {RUNS}; RISAF_DATA names the folder of data"
)


def recorded(path):
    run = np.load(path)
    gps = run["gps"]
    position = np.column_stack([np.radians(gps[:, 1:3]), gps[:, 3]])
    speed, course = np.hypot(gps[:, 4], gps[:, 5]), np.arctan2(gps[:, 5], gps[:, 4])
    return statistics(
        run["gyro"],
        run["accel"],
        np.degrees(np.unwrap(np.radians(run["rpy_deg"]), axis=0)),
        ((gps[:, 0] - 1e6) / 1e6, position, speed, course),
    )


def simulated(seed):
    chosen = scenario("ekf2", seed)
    blocks = list(readings(chosen))
    gyro = np.concatenate([block.rates_b[:, 0] for block in blocks])
    accel = np.concatenate([block.forces_b[:, 0] for block in blocks])
    truth = chosen.trajectory(np.arange(30_000) / 100)
    f = fixes(chosen.trajectory, 300.0, chosen.receiver, chosen.generator("receiver"))
    has = ~is_lost(f.arrival_s, chosen.outages)
    position = np.column_stack([f.latitude, f.longitude, f.altitude])[has]
    gps = f.arrival_s[has], position, f.speed[has], f.course[has]
    return statistics(gyro, accel, euler(truth.q_nb), gps)


def euler(q):
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(2 * (w * y - x * z))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.unwrap([roll, pitch, yaw]).T)


def statistics(gyro, accel, rpy_deg, gps):
    """Numbers that describe a run of 300 s at 100 Hz and its GPS."""
    time_s, position, speed, course = gps
    rest, cruise = slice(0, 990), slice(2100, None)
    moving = time_s > 21
    smooth = [np.apply_along_axis(smoothed, 0, values[cruise]) for values in (gyro, accel)]
    yaw = np.interp(time_s, np.arange(30_000) / 100, np.radians(rpy_deg[:, 2]))
    off = np.angle(np.exp(1j * (course - yaw)))[moving]
    metres = np.diff(position[time_s < 9.9], axis=0) * [6.37e6, 4.31e6, 1.0] / math.sqrt(2)
    return {
        "gyro noise": np.diff(gyro, axis=0).std(axis=0) / math.sqrt(2),
        "accel noise": np.diff(accel, axis=0).std(axis=0) / math.sqrt(2),
        "gyro bias": abs(gyro[rest].mean(axis=0)),
        "gravity at rest": np.linalg.norm(accel[rest].mean(axis=0)),
        "rates": smooth[0].std(axis=0),
        "forces": smooth[1].std(axis=0),
        "tilt": rpy_deg[cruise, :2].std(axis=0),
        "largest tilt": abs(rpy_deg[cruise, :2]).max(axis=0),
        "mean speed": speed[moving].mean(),
        "speed change": speed[moving].std(),
        "speed at 15 s": np.interp(15.0, time_s, speed),
        "speed at rest": speed[time_s < 9.9].mean(),
        "course noise": off.std(),
        "course offset": off.mean(),
        "position noise": metres.std(axis=0),
        "fixes": len(time_s),
        "last fix": time_s[-1],
    }


def smoothed(values):
    return np.convolve(values, np.ones(50) / 50, "valid")


TOLERANCES = {
    "gyro noise": {"rel": 0.01},
    "accel noise": {"rel": 0.01},
    "gyro bias": {"abs": math.radians(0.02)},
    "gravity at rest": {"abs": 0.01},
    "rates": {"rel": 0.25},
    "forces": {"rel": 0.25},
    "tilt": {"rel": 0.15},
    "largest tilt": {"rel": 0.1},
    "mean speed": {"abs": 0.7},
    "speed change": {"rel": 0.4},
    "speed at 15 s": {"abs": 0.3},
    "speed at rest": {"abs": 0.05},
    "course noise": {"rel": 0.15},
    "course offset": {"abs": math.radians(0.06)},
    "position noise": {"rel": 0.3},
    "fixes": {"abs": 2},
    "last fix": {"abs": 0.01},
}


@needs_runs
def test_the_statistics_of_the_sensors_and_of_the_drive_are_those_of_the_recorded_runs():
    paths = sorted(RUNS.glob("*.npz"))
    assert paths
    theirs = [recorded(path) for path in paths]
    ours = [simulated(seed) for seed in (1, 2)]
    for name, tolerance in TOLERANCES.items():
        expected = np.mean([run[name] for run in theirs], axis=0)
        found = np.mean([run[name] for run in ours], axis=0)
        assert found == pytest.approx(expected, **tolerance), name


def test_the_gyro_of_ekf2_has_the_errors_that_are_asked_for():
    chosen = scenario("ekf2", 4)
    assert (chosen.sensors, chosen.rate, chosen.duration) == (1, 100.0, 300.0)
    blocks = list(readings(chosen))
    errors = np.concatenate([b.rates_b[:, 0] - b.ideal_rates_b for b in blocks])
    forces = np.concatenate([b.forces_b[:, 0] - b.ideal_forces_b for b in blocks])
    assert np.diff(errors, axis=0).std() / math.sqrt(2) == pytest.approx(
        math.radians(0.1), rel=5 / math.sqrt(9e4)
    )
    assert forces.std() == pytest.approx(0.05, rel=5 / math.sqrt(2 * 9e4))
    start = errors[:1000].mean(axis=0)
    assert abs(start) == pytest.approx(math.radians(0.2), abs=math.radians(5 * 0.1 / 31))
    walked = errors[-1000:].mean(axis=0) - start
    limit = 5 * math.hypot(math.radians(3e-4) * math.sqrt(300), math.radians(0.1 / 22))
    assert abs(walked).max() < limit


def test_ekf2_rests_then_gains_15_metres_a_second_in_10_s():
    truth = scenario("ekf2", 4).trajectory(np.array([0.0, 5.0, 10.0, 15.0, 20.0]))
    speed = np.linalg.norm(truth.velocity_n, axis=1)
    assert speed == pytest.approx([0.0, 0.0, 0.0, 7.5, 15.0])
