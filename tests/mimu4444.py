"""The real board of eight IMUs: its slices, and logs as its array would have sent them."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.tlog import record

DATA = Path(os.environ.get("RISAF_DATA", Path(__file__).parents[1] / "../shared/data"))
BOARD = DATA / "mimu4444_array8"
PERIOD_US = 16_000
SCALE = math.radians(1 / 16.4)  # rad/s per count
RANGE = 32767 * SCALE
UPSIDE_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NOMINAL = np.tile(np.eye(3), (8, 1, 1))
NOMINAL[1::2] = UPSIDE_DOWN  # the second, the fourth, ...
HEADER = 4  # bytes: the answer to the command that started the stream
FRAME = np.dtype(
    [
        ("start", "u1"),
        ("number", ">u2"),
        ("length", "u1"),
        ("clock", ">u4"),
        ("readings", ">i2", (8, 2, 3)),  # accelerometer, gyro
        ("sum", ">u2"),
    ]
)


def counts(name: str) -> np.ndarray:
    """Counts of the gyros, (k, 8, 3)."""
    path = BOARD / f"slice_{name}_60s.bin"
    if not path.exists():
        pytest.skip(f"{path} is not there; RISAF_DATA says where such data are")
    content = path.read_bytes()[HEADER:]
    frames = np.frombuffer(content, FRAME)
    assert (frames["start"] == 0xAA).all()
    sums = np.frombuffer(content, np.uint8).reshape(len(frames), -1)[:, :-2].sum(axis=1)
    assert (frames["sum"] == sums % 65536).all()
    return frames["readings"][:, :, 1].astype(int)


def rates(name: str) -> np.ndarray:
    """rad/s, (k, 8, 3); NaN where saturated."""
    read = counts(name)
    return np.where(np.abs(read) >= 32767, np.nan, read * SCALE)


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
