"""The array as a component: it says what it is, and sends its readings.

Payloads of readings are laid out a block at a time: there are hundreds of frames a second.
"""

import math
from collections.abc import Iterator
from heapq import merge

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.mavlink.dialect import IDS, pack
from risaf_link.sim.message import ARRAY, Message, by_time, heartbeat
from risaf_link.sim.readings import readings
from risaf_link.sim.scenario import BOOT_US, Scenario
from risaf_link.sim.sensors import TriadErrors

MAX_COUNT, INVALID = 32767, -32768

CHUNK = np.dtype(
    [
        ("time_usec", "<u8"),
        ("epoch_seq", "<u2"),
        ("first_sensor", "<u2"),
        ("readings", "<i2", (40, 3)),
        ("sensor_count", "u1"),
        ("array_id", "u1"),
    ]
)
"""Payload of GYRO_ARRAY and of ACCEL_ARRAY."""


def count_scale(errors: TriadErrors) -> float:
    """Reading of one count, as precise as IMU_ARRAY_INFO tells it."""
    return float(np.float32(errors.full_scale / MAX_COUNT))


def status(scenario: Scenario) -> Iterator[Message]:
    """IMU_ARRAY_INFO and HEARTBEAT, every second."""
    pulse = heartbeat(40, 8)  # MAV_TYPE_IMU, MAV_AUTOPILOT_INVALID
    for second in range(math.ceil(scenario.duration)):
        time_us = BOOT_US + second * 1_000_000
        yield Message(time_us, ARRAY, *_info(scenario, time_us))
        yield Message(time_us, ARRAY, *pulse)


def _info(scenario: Scenario, time_us: int) -> tuple[int, bytes]:
    gyros, accelerometers = scenario.gyros, scenario.accelerometers
    return pack(
        "IMU_ARRAY_INFO",
        time_usec=time_us,
        gyro_scale=count_scale(gyros),
        gyro_range=gyros.full_scale,
        accel_scale=count_scale(accelerometers) if accelerometers else math.nan,
        accel_range=accelerometers.full_scale if accelerometers else math.nan,
        rate=scenario.rate,
        sensor_count=scenario.sensors,
        array_id=0,
        name=f"sim-{scenario.name}"[:16],
    )


def epochs(scenario: Scenario) -> Iterator[Message]:
    """GYRO_ARRAY and ACCEL_ARRAY, every epoch."""
    scales = {"GYRO_ARRAY": count_scale(scenario.gyros)}
    if scenario.accelerometers:
        scales["ACCEL_ARRAY"] = count_scale(scenario.accelerometers)
    for block in readings(scenario):
        values = {"GYRO_ARRAY": block.rates_b, "ACCEL_ARRAY": block.forces_b}
        chunked = (
            _chunks(name, block.time_us, block.epoch, _counts(values[name], scale))
            for name, scale in scales.items()
        )
        yield from merge(*chunked, key=by_time)


def _counts(values: Floats, scale: float) -> NDArray[np.int16]:
    counts = np.rint(values / scale)
    return np.where(np.isnan(counts), INVALID, counts).astype(np.int16)


def _chunks(
    name: str, time_us: NDArray[np.int64], epoch: NDArray[np.int64], counts: NDArray[np.int16]
) -> Iterator[Message]:
    """Lay out the messages of k epochs of n sensors; counts have the shape (k, n, 3)."""
    epochs, sensors, _ = counts.shape
    size = CHUNK["readings"].shape[0]
    first = np.arange(0, sensors, size)
    chunks = np.zeros((epochs, len(first)), CHUNK)
    chunks["time_usec"] = time_us[:, np.newaxis]
    chunks["epoch_seq"] = epoch[:, np.newaxis] & 0xFFFF
    chunks["first_sensor"] = first
    chunks["sensor_count"] = np.minimum(sensors - first, size)
    filled = np.zeros((epochs, len(first) * size, 3), np.int16)
    filled[:, :sensors] = counts
    chunks["readings"] = filled.reshape(epochs, len(first), size, 3)
    content, message_id = chunks.tobytes(), IDS[name]
    for i, sent_us in enumerate(np.repeat(time_us, len(first)).tolist()):
        payload = content[i * CHUNK.itemsize : (i + 1) * CHUNK.itemsize]
        yield Message(sent_us, ARRAY, message_id, payload)
