"""The real board of eight IMUs: its slices, and logs as its array would have sent them."""

import math
from pathlib import Path

import numpy as np
import pytest

from risaf_link.experiments import board
from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.tlog import record

BOARD = board.directory()
PERIOD_US = round(1e6 * board.PERIOD)
SCALE, NOMINAL = board.SCALE, board.NOMINAL
RANGE = board.LIMIT * SCALE


def _path(name: str) -> Path:
    path = BOARD / f"slice_{name}_60s.bin"
    if not path.exists():
        pytest.skip(f"{path} is not there; RISAF_DATA says where such data are")
    return path


def counts(name: str) -> np.ndarray:
    """Counts of the gyros, (k, 8, 3)."""
    return board.counts(_path(name))


def rates(name: str) -> np.ndarray:
    """rad/s, (k, 8, 3); NaN where saturated."""
    return board.rates(_path(name))


def write_log(path: Path, read: np.ndarray) -> Path:
    """GYRO_ARRAY with IMU_ARRAY_INFO, of counts."""
    info = pack(
        "IMU_ARRAY_INFO",
        time_usec=0,
        gyro_scale=SCALE,
        gyro_range=RANGE,
        accel_scale=math.nan,
        accel_range=math.nan,
        rate=1e6 / PERIOD_US,
        sensor_count=read.shape[1],
        array_id=0,
        name="mimu4444",
    )
    log = record(0, encode(*info, 0, 1, 158))
    for k, epoch in enumerate(read):
        message = pack(
            "GYRO_ARRAY",
            time_usec=k * PERIOD_US,
            epoch_seq=k % 65536,
            first_sensor=0,
            rates=[*epoch.ravel().tolist(), *[0] * (120 - epoch.size)],
            sensor_count=len(epoch),
            array_id=0,
        )
        log += record(k * PERIOD_US, encode(*message, (k + 1) % 256, 1, 158))
    path.write_bytes(log)
    return path
