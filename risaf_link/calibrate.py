"""A log with motion -> the file that `array.calibration` names."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from risaf_link.config import Config, load_calibration
from risaf_link.core.array import ArrayCalibration, TriadCalibration
from risaf_link.core.calibration import ENOUGH, Calibrated, calibrate
from risaf_link.core.fusion import Epoch
from risaf_link.core.mounting import Readings
from risaf_link.core.rotation import Floats, matrix_from_quaternion
from risaf_link.errors import ConfigError, LogError
from risaf_link.links.file import read
from risaf_link.mavlink.epoch import EpochAssembler, GyroChunk
from risaf_link.mavlink.ingest import Ingest
from risaf_link.mavlink.tlog import TlogReader
from risaf_link.whole import replace_file

MOST_EPOCHS, MOST_READINGS = 50_000, 9_000_000  # that are kept; of more, every second is dropped
DIGITS = 9  # behind the point: beyond what any log tells
AXES = "xyz"


@dataclass
class Collection:
    """What the gyros of a log read, thinned evenly if it is long."""

    rates_s: list[Floats] = field(default_factory=list)  # (n, 3) each
    time_s: list[float] = field(default_factory=list)
    accelerometers: int = 0
    name: str = ""  # of the array
    frames: int = 0
    stride: int = 1
    _epochs: int = 0
    _elapsed: float = 0.0

    def add(self, epoch: Epoch) -> None:
        """Take one epoch."""
        self._elapsed += epoch.dt
        self.accelerometers = max(self.accelerometers, len(epoch.forces_b))
        if self._epochs % self.stride == 0:
            self.rates_s.append(epoch.rates_b)
            self.time_s.append(self._elapsed)
        self._epochs += 1
        kept = len(self.rates_s)
        if kept > MOST_EPOCHS or kept * epoch.rates_b.size > MOST_READINGS:
            del self.rates_s[1::2], self.time_s[1::2]
            self.stride *= 2

    @property
    def readings(self) -> Readings:
        """All that was kept; sensors that came late are NaN before."""
        n = max((len(rates) for rates in self.rates_s), default=0)
        rates = np.full((len(self.rates_s), n, 3), np.nan)
        for all_sensors, present in zip(rates, self.rates_s, strict=True):
            all_sensors[: len(present)] = present
        return Readings(np.array(self.time_s), rates)


@dataclass(frozen=True, slots=True)
class Result:
    """A calibration, how good it is, and of what."""

    found: Calibrated
    array: ArrayCalibration
    stride: int  # every which epoch was used


def calibrate_log(
    config: Config,
    path: Path,
    start: float = 0.0,
    end: float = math.inf,
    progress: Callable[[int], None] = lambda _: None,
) -> Result:
    """Calibrate an array from a log.

    Mountings, and what there is for accelerometers, are taken from the calibration that the
    configuration names; without one, mountings are found, and accelerometers have those of the
    gyros with the same number.

    Parameters
    ----------
    config : Config
    path : Path
        A tlog.
    start, end : float
        Seconds of the log's own time, from its first record.
    progress : callable
        Called now and then with the number of bytes read since the last call.

    Raises
    ------
    ConfigError
        If the configured calibration cannot be used, or is not of this array.
    LogError
        If the log cannot be read, holds too little, or its motion excites too little.
    """
    known = load_calibration(config)
    collection = _collect(config, path, start, end, progress)
    readings = collection.readings
    if not len(readings.time_s):
        raise LogError(
            f"{path}: found {collection.frames} frames but no gyro samples, expected one of "
            "GYRO_ARRAY (with IMU_ARRAY_INFO), DEBUG_FLOAT_ARRAY, HIGHRES_IMU, RAW_IMU, SCALED_IMU"
        )
    try:
        found = calibrate(readings, _given(known, readings.rates_s.shape[1]))
    except ValueError as error:
        raise LogError(f"{path}: {error}") from None
    _require_motion(path, found)
    return Result(found, _array(found, known, collection), collection.stride)


def write(path: Path, log: Path, result: Result) -> None:
    """Write a calibration file, all of it or nothing.

    Raises
    ------
    ConfigError
        If it cannot be written.
    """
    try:
        replace_file(path, text(log, result).encode())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None


def text(log: Path, result: Result) -> str:
    """A calibration as YAML, with what a reader should know of it."""
    found, array = result.found, result.array
    lines = [
        f"# Of {log.name}: {found.moving:.1f} s in motion, {found.rest:.1f} s at rest.",
        "# Scale and misalignment are relative to the array; "
        + ("bias is the mean at rest." if found.rest else "so are biases: there was no rest."),
        *([f"name: {_flow(array.name)}"] if array.name else []),
        "gyros:",
    ]
    scale, bias = found.scale_std.max(axis=1), np.degrees(found.bias_std.max(axis=1))
    for i, triad in enumerate(array.gyros):
        lines.append(f"  - {_flow(msgspec.to_builtins(triad))}")
        if found.determined[i]:
            lines.append(f"    # {i}: bias to {bias[i]:.4f} deg/s, scale to {100 * scale[i]:.3f} %")
        else:
            lines.append(f"    # {i}: not calibrated: {100 * found.used[i]:.0f} % of it is usable")
    if array.accels:
        lines += ["accels:", *(f"  - {_flow(msgspec.to_builtins(a))}" for a in array.accels)]
    return "\n".join(lines) + "\n"


def summary(result: Result) -> dict[str, Any]:
    """What was found, for JSON; angles in degrees, scale as in the file."""
    found = result.found
    return {
        "sensors": len(found.bias),
        "calibrated": int(found.determined.sum()),
        "moving_s": round(found.moving, 3),
        "rest_s": round(found.rest, 3),
        "every": result.stride,
        "motion_dps": _rounded(np.degrees(found.motion)),
        "disagreement_dps": {
            "before": _rounded(math.degrees(found.before.array)),
            "after": _rounded(math.degrees(found.after.array)),
            "before_untimed": _rounded(math.degrees(found.before.untimed)),
            "after_untimed": _rounded(math.degrees(found.after.untimed)),
        },
        "gyros": [_row(found, i) for i in range(len(found.bias))],
    }


def _row(found: Calibrated, i: int) -> dict[str, Any]:
    return {
        "calibrated": bool(found.determined[i]),
        "used": _rounded(found.used[i]),
        "bias_dps": _rounded(np.degrees(found.bias[i])),
        "bias_std_dps": _rounded(np.degrees(found.bias_std[i])),
        "scale": _rounded(found.scale[i]),
        "scale_std": _rounded(found.scale_std[i]),
        "misalignment_deg": _rounded(np.degrees(found.misalignment[i])),
        "misalignment_std_deg": _rounded(np.degrees(found.misalignment_std[i])),
        "mounting": _rounded(found.mounting[i]),
        "mounting_std_deg": _rounded(np.degrees(found.mounting_std[i])),
        "before_dps": _rounded(math.degrees(found.before.sensors[i])),
        "after_dps": _rounded(math.degrees(found.after.sensors[i])),
    }


def _rounded(values: Any) -> Any:
    """Plain numbers with six digits behind the point; None for what is not known."""
    if np.ndim(values):
        return [_rounded(value) for value in values]
    return round(float(values), 6) if math.isfinite(values) else None


def _flow(value: Any) -> str:
    whole: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return whole.removesuffix("\n").removesuffix("\n...")


def _collect(
    config: Config, path: Path, start: float, end: float, progress: Callable[[int], None]
) -> Collection:
    ingest = Ingest(config.array, config.gps, config.own)
    assembler = EpochAssembler(config.array)
    collection = Collection()
    for epoch in _epochs(TlogReader(read(path, progress)), (start, end), ingest, assembler):
        collection.add(epoch)
    collection.frames = sum(ingest.counts.values()) + assembler.counts["epochs"]
    info = ingest.info(assembler.source) if assembler.source else None
    collection.name = info.name if info else ""
    return collection


def _epochs(
    reader: TlogReader, span: tuple[float, float], ingest: Ingest, assembler: EpochAssembler
) -> Iterator[Epoch]:
    first_us: int | None = None
    for time_us, frame in reader:
        first_us = time_us if first_us is None else first_us
        elapsed = (time_us - first_us) / 1e6
        if elapsed > span[1]:
            break
        datum = ingest.decode(frame, time_us)
        if isinstance(datum, GyroChunk) and elapsed >= span[0]:
            yield from assembler.add(datum)
    yield from assembler.flush()


def _given(known: ArrayCalibration | None, sensors: int) -> Floats | None:
    """Mountings that are known, shape (n, 3, 3)."""
    if known is None:
        return None
    if len(known.gyros) < sensors:
        raise ConfigError(
            f"array.calibration: the calibration is for {len(known.gyros)} sensors, "
            f"the array has {sensors}"
        )
    quaternions = np.array([triad.mounting for triad in known.gyros[:sensors]], dtype=float)
    return matrix_from_quaternion(quaternions / np.linalg.norm(quaternions, axis=1)[:, None])


def _require_motion(path: Path, found: Calibrated) -> None:
    weak = np.flatnonzero(~(found.typical_std <= ENOUGH))
    if not len(weak):
        return
    turned = ", ".join(
        f"{AXES[i]} by {np.degrees(found.motion[i]):.2f} deg/s RMS (known to "
        f"{100 * found.typical_std[i]:.2g} %)"
        for i in weak
    )
    raise LogError(
        f"{path}: not turned about enough: {turned}; expected motion about every axis, in "
        f"{found.moving:.0f} s enough to know scale to {100 * ENOUGH:g} %"
    )


def _array(
    found: Calibrated, known: ArrayCalibration | None, collection: Collection
) -> ArrayCalibration:
    gyros = [
        TriadCalibration(*(_plain(values) for values in of_sensor))
        for of_sensor in zip(
            found.bias, found.scale, found.misalignment, found.mounting, strict=True
        )
    ]
    accelerometers = gyros[: collection.accelerometers]
    accels = [TriadCalibration(mounting=gyro.mounting) for gyro in accelerometers]
    return ArrayCalibration(gyros, known.accels if known else accels, collection.name)


def _plain(values: Floats) -> list[float]:
    return [round(float(value), DIGITS) + 0.0 for value in values]
