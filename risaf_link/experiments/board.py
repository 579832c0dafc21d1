"""The real board of eight IMUs, MIMU4444, as its public recordings hold it.

Carlsson, Skog and Jalden, "Self-Calibration of Inertial Sensor Arrays", IEEE Sensors Journal 21,
2021. Big-endian frames of 106 bytes, 62.5 Hz; gyros of 16.4 counts for 1 deg/s; every second IMU
sits upside down.
"""

import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.errors import LogError

PERIOD = 0.016  # s
SCALE = math.radians(1 / 16.4)  # rad/s per count
LIMIT = 32767  # counts
UPSIDE_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NOMINAL = np.tile(np.eye(3), (8, 1, 1))
NOMINAL[1::2] = UPSIDE_DOWN  # the second, the fourth, ...
AT_REST = 1400  # epochs of a slice's beginning, before the board is touched
STATIC = ("exp_5_first", "exp_6_first")  # slices that begin at rest
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


def directory() -> Path:
    """Where recordings are looked for: `RISAF_DATA`, or `../shared/data` beside the checkout."""
    beside = Path(__file__).parents[2] / "../shared/data"
    return Path(os.environ.get("RISAF_DATA", beside)) / "mimu4444_array8"


def slice_path(name: str) -> Path:
    """File of a slice, such as `exp_5_first`."""
    return directory() / f"slice_{name}_60s.bin"


def counts(path: Path) -> NDArray[np.int64]:
    """Read the gyros' counts, (k, 8, 3), each in its own axes.

    Raises
    ------
    LogError
        If it is no such recording, or a frame is corrupt.
    """
    content = path.read_bytes()[HEADER:]
    if not content or len(content) % FRAME.itemsize:
        raise LogError(f"{path}: {len(content)} bytes, expected whole frames of {FRAME.itemsize}")
    frames = np.frombuffer(content, FRAME)
    sums = np.frombuffer(content, np.uint8).reshape(len(frames), -1)[:, :-2].sum(axis=1)
    if (frames["start"] != 0xAA).any() or (frames["sum"] != sums % 65536).any():
        raise LogError(f"{path}: corrupt frames, expected 0xAA at the start and a sum at the end")
    read: NDArray[np.int64] = frames["readings"][:, :, 1].astype(int)
    return read


def rates(path: Path) -> Floats:
    """Read the rates, rad/s, (k, 8, 3), each sensor in its own axes; NaN where saturated."""
    read = counts(path)
    return np.where(np.abs(read) >= LIMIT, np.nan, read * SCALE)


def at_rest(path: Path) -> Floats:
    """Read the rates at rest, rad/s, (k, 8, 3), with the nominal mounting put right."""
    turned: Floats = np.einsum("nij,knj->kni", NOMINAL, rates(path)[:AT_REST])
    return turned
