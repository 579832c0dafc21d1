"""Logs that were simulated, and what replays of them say whenever and wherever they ran."""

from pathlib import Path
from typing import Any

from risaf_link.mavlink.tlog import record
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames, record_time_us


def simulated(
    path: Path, duration: float = 12.0, sensors: int = 20, rate: float = 50, seed: int = 3
) -> Path:
    """Write a drive in circles."""
    drive = scenario("circle", seed=seed, duration=duration, sensors=sensors, rate=rate)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(record(record_time_us(t), raw) for t, raw in frames(drive)))
    return path


def timeless(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows but for how fast they were made."""
    return [{key: row[key] for key in row if key != "realtime_factor"} for row in rows]
