"""Messages -> core values. With `telemetry`, the only place of MAVLink's units, frames and enums.

Bytes from outside never raise here: what cannot be used is counted by reason.
"""

import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import numpy as np
from msgspec import Struct

from risaf_link.core.heading import GpsFix
from risaf_link.core.rotation import Floats, quaternion_from_euler
from risaf_link.mavlink.dialect import IDS, name_of, reader
from risaf_link.mavlink.epoch import ArrayParameters, GyroChunk, Source
from risaf_link.mavlink.frame import Frame

GpsMessage = Literal["GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS", "GLOBAL_POSITION_INT"]

MILLI = np.repeat([1e-3, 9.80665e-3], 3)  # rad/s and m/s^2 of a count of mrad/s and mG
INVALID = -32768  # reading of a channel in our dialect
INT16_LIMIT = 32767
PATIENCE_US = 3_000_000  # how long a source may be silent before another one is taken
USABLE_FIX = 3  # GPS_FIX_TYPE_3D_FIX
IGNORE_VELOCITY, IGNORE_SPEED_ACCURACY, IGNORE_POSITION_ACCURACY = 8, 32, 64
UNKNOWN = 65535
NONE = np.zeros((0, 3))
MAX_SENDERS = 64

_ARRAY_HEAD = struct.Struct("<QHH")  # time_usec, epoch_seq, first_sensor
ARRAY_SIZE = 254  # payload of GYRO_ARRAY and ACCEL_ARRAY; its last bytes: sensor_count, array_id
ARRAY_CAPACITY, DEBUG_CAPACITY = 40, 19  # sensors a message


class GpsParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Which GPS messages are believed, the best first."""

    messages: tuple[GpsMessage, ...] = ("GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS")


@dataclass(frozen=True, slots=True)
class Truth:
    """The true attitude, from a simulator: for scoring only."""

    time_us: int | None  # on the vehicle's clock; None: the message has no time
    q_nb: Floats


@dataclass(frozen=True, slots=True)
class ArrayInfo:
    """What an array says of itself."""

    name: str
    gyro_scale: float  # rad/s per count
    gyro_range: float  # rad/s; inf: not known
    accel_scale: float  # m/s^2 per count; NaN: no accelerometers
    accel_range: float
    sensors: int


class _Choice:
    """Keeps to one of several sources: the best one that is not silent."""

    def __init__(self) -> None:
        self._chosen: object = None
        self._rank = 0
        self._heard_us = 0

    def admits(self, source: object, rank: int, now_us: int) -> bool:
        """Whether this source, which has just been heard, is the one to take."""
        silent = not 0 <= now_us - self._heard_us <= PATIENCE_US
        if source != self._chosen and (self._chosen is None or silent or rank < self._rank):
            self._chosen, self._rank = source, rank
        if source == self._chosen:
            self._heard_us = now_us
        return source == self._chosen


@dataclass
class _Stream:
    """One message that carries a sensor which may come in other messages too."""

    last_us: int
    period_us: float = math.inf

    def note(self, time_us: int) -> None:
        step = time_us - self.last_us
        if step > 0:
            self.period_us = step if math.isinf(self.period_us) else (7 * self.period_us + step) / 8
        self.last_us = time_us

    def replaces(self, coarser: "_Stream") -> bool:
        """Whether this one is there, and often enough, to do without a coarser one."""
        age_us = abs(coarser.last_us - self.last_us)
        return age_us <= 4 * min(self.period_us, 1e6) and self.period_us <= 2 * coarser.period_us


class Ingest:
    """Reads what the estimator needs from frames.

    Parameters
    ----------
    array : ArrayParameters
    gps : GpsParameters
    own : tuple of int
        System and component id of this service: what it sent itself is not taken for input.

    Attributes
    ----------
    counts : Counter
        Frames that were not used: `own`, `malformed`, `unscaled` (nothing has told the scale of
        GYRO_ARRAY yet), `superseded` (the sensor comes in a finer message), `other_source`,
        `no_fix`, `repeated_fix`; readings that are not valid: `invalid`, `saturated`.
    """

    def __init__(self, array: ArrayParameters, gps: GpsParameters, own: tuple[int, int]) -> None:
        self.counts: Counter[str] = Counter()
        self._parameters = array
        self._gps_messages = gps.messages
        self._own = own
        self._arrays, self._receivers = _Choice(), _Choice()
        self._infos: dict[tuple[int, int, int], ArrayInfo] = {}
        self._streams: dict[tuple[int, int, int], dict[int, _Stream]] = {}
        self._last_fixes: dict[tuple[int, int, str], object] = {}
        self._readers: dict[int, Callable[[Frame, int], GyroChunk | GpsFix | None]] = {
            IDS["IMU_ARRAY_INFO"]: self._array_info,
            IDS["GYRO_ARRAY"]: self._dialect_array,
            IDS["ACCEL_ARRAY"]: self._dialect_array,
            IDS["DEBUG_FLOAT_ARRAY"]: self._debug_float_array,
            IDS["HIGHRES_IMU"]: self._highres_imu,
            IDS["RAW_IMU"]: self._raw_imu,
            IDS["SCALED_IMU"]: self._scaled_imu,
            IDS["SCALED_IMU2"]: self._scaled_imu,
            IDS["SCALED_IMU3"]: self._scaled_imu,
            **{IDS[name]: self._gps for name in gps.messages},
        }

    def decode(self, frame: Frame, received_us: int) -> GyroChunk | GpsFix | None:
        """Read one frame.

        Parameters
        ----------
        frame : Frame
        received_us : int
            When it came, microseconds: tells silent sources from present ones.

        Returns
        -------
        GyroChunk, GpsFix or None
            None if there is nothing in it for the estimator.
        """
        read = self._readers.get(frame.message_id)
        if read is None:
            return None
        if (frame.system, frame.component) == self._own:
            self.counts["own"] += 1
            return None
        return read(frame, received_us)

    def info(self, source: Source) -> ArrayInfo | None:
        """What an array has said of itself."""
        return self._infos.get((source.system, source.component, source.array_id))

    def _admits(self, source: Source, received_us: int) -> bool:
        wanted = self._parameters
        admitted = (
            source.encoding in wanted.encodings
            and wanted.id in {None, source.array_id}
            and self._arrays.admits(source, wanted.encodings.index(source.encoding), received_us)
        )
        self.counts["other_source"] += not admitted
        return admitted

    def _clean(self, values: Floats, limit: float | Floats) -> Floats:
        """Make readings NaN that are not finite or at the end of the sensor's range."""
        saturated = np.abs(values) >= limit
        invalid = ~np.isfinite(values)
        if saturated.any() or invalid.any():
            self.counts["invalid"] += int(invalid.sum())
            self.counts["saturated"] += int((saturated & ~invalid).sum())
            values[saturated | invalid] = np.nan
        return values

    # Our own dialect

    def _array_info(self, frame: Frame, _: int) -> None:
        scale, limit, accel_scale, accel_limit, sensors, array_id, name = _INFO(frame.payload)
        key = (frame.system, frame.component, array_id)
        if not 0 < scale < math.inf or (key not in self._infos and len(self._infos) == MAX_SENDERS):
            self.counts["malformed"] += 1
            return
        self._infos[key] = ArrayInfo(
            name.rstrip(b"\0").decode(errors="replace"),
            scale,
            limit if limit > 0 else math.inf,
            accel_scale,
            accel_limit if accel_limit > 0 else math.inf,
            sensors,
        )

    def _dialect_array(self, frame: Frame, received_us: int) -> GyroChunk | None:
        payload = frame.payload.ljust(ARRAY_SIZE, b"\0")
        time_us, sequence, first = _ARRAY_HEAD.unpack_from(payload)
        count, array_id = payload[ARRAY_SIZE - 2 : ARRAY_SIZE]
        source = Source(frame.system, frame.component, "GYRO_ARRAY", array_id)
        if not 0 < count <= ARRAY_CAPACITY:
            self.counts["malformed"] += 1
            return None
        if not self._admits(source, received_us):
            return None
        is_gyro = frame.message_id == IDS["GYRO_ARRAY"]
        info = self.info(source) or self._assumed_info()
        scale = info.gyro_scale if is_gyro else info.accel_scale
        if not scale > 0:
            self.counts["unscaled"] += 1
            return None
        counts = np.frombuffer(payload, "<i2", 3 * count, _ARRAY_HEAD.size).reshape(count, 3)
        values = np.where(counts == INVALID, np.nan, counts * scale)
        limit = info.gyro_range if is_gyro else info.accel_range
        values = self._clean(values, min(limit * (1 - 1e-6), INT16_LIMIT * scale))
        rates, forces = (values, NONE) if is_gyro else (NONE, values)
        return GyroChunk(source, time_us, received_us, first, rates, forces, sequence, info.sensors)

    def _assumed_info(self) -> ArrayInfo:
        """Stand in for an array that has said nothing of itself."""
        p = self._parameters
        return ArrayInfo("", p.gyro_scale, p.gyro_range or math.inf, math.nan, math.inf, 0)

    # What stock senders emit

    def _debug_float_array(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, name, first, data = _DEBUG(frame.payload)
        name = name.rstrip(b"\0")
        if name not in {b"gyro", b"accel"}:
            return None
        source = Source(frame.system, frame.component, "DEBUG_FLOAT_ARRAY", 0)
        if not self._admits(source, received_us):
            return None
        values = np.array(data[: 3 * DEBUG_CAPACITY]).reshape(-1, 3)
        limit = self._parameters.gyro_range if name == b"gyro" else 0.0
        values = self._clean(values, limit or math.inf)
        rates, forces = (values, NONE) if name == b"gyro" else (NONE, values)
        return GyroChunk(source, time_us, received_us, first, rates, forces, padded=True)

    def _highres_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, *readings, sensor = _HIGHRES(frame.payload)
        return self._autopilot_imu(frame, received_us, sensor, time_us, np.array(readings))

    def _raw_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, *counts, sensor = _RAW(frame.payload)
        return self._autopilot_imu(frame, received_us, sensor, time_us, np.array(counts) * MILLI)

    def _scaled_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_ms, *counts = _SCALED(frame.payload)
        time_us, sensor = time_ms * 1000, SCALED_IMUS.index(frame.message_id)
        return self._autopilot_imu(frame, received_us, sensor, time_us, np.array(counts) * MILLI)

    def _autopilot_imu(
        self, frame: Frame, received_us: int, sensor: int, time_us: int, readings: Floats
    ) -> GyroChunk | None:
        source = Source(frame.system, frame.component, "IMU", 0)
        if not self._admits(source, received_us):
            return None
        streams = self._streams.setdefault((frame.system, frame.component, sensor), {})
        stream = streams.setdefault(frame.message_id, _Stream(time_us))
        stream.note(time_us)
        finer = FINEST_FIRST[: FINEST_FIRST.index(frame.message_id)]
        if any(i in streams and streams[i].replaces(stream) for i in finer):
            self.counts["superseded"] += 1
            return None
        is_float = frame.message_id == FINEST_FIRST[0]
        limits = np.full(6, math.inf) if is_float else INT16_LIMIT * MILLI
        limits[:3] = np.minimum(limits[:3], self._parameters.gyro_range or math.inf)
        rates, forces = self._clean(readings, limits).reshape(2, 1, 3)
        return GyroChunk(source, time_us, received_us, sensor, rates, forces, loose=True)

    # GPS

    def _gps(self, frame: Frame, received_us: int) -> GpsFix | None:
        name = cast("GpsMessage", name_of(frame.message_id))
        fix = _FIXES[name](frame.payload)
        source = (frame.system, frame.component, name)
        if not fix.usable:
            self.counts["no_fix"] += 1
            return None
        if not self._receivers.admits(source, self._gps_messages.index(name), received_us):
            self.counts["other_source"] += 1
            return None
        content = fix.time_us or (fix.latitude, fix.longitude, fix.speed, fix.course)
        if self._last_fixes.get(source) == content:
            self.counts["repeated_fix"] += 1
            return None
        self._last_fixes[source] = content
        return fix


def truth_of(frame: Frame) -> Truth | None:
    """The true attitude, if a simulator states it in this frame."""
    if frame.message_id == IDS["HIL_STATE_QUATERNION"]:
        time_us, q_nb = _HIL_STATE(frame.payload)
        return Truth(time_us, np.array(q_nb))
    if frame.message_id == IDS["SIM_STATE"]:
        return Truth(None, quaternion_from_euler(*_SIM_STATE(frame.payload)))
    if frame.message_id == IDS["SIMSTATE"]:
        return Truth(None, quaternion_from_euler(*_SIMSTATE(frame.payload)))
    return None


_EULER = ("roll", "pitch", "yaw")
_IMU = ("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc")
_INFO = reader(
    "IMU_ARRAY_INFO",
    *("gyro_scale", "gyro_range", "accel_scale", "accel_range", "sensor_count", "array_id", "name"),
)
_DEBUG = reader("DEBUG_FLOAT_ARRAY", "time_usec", "name", "array_id", "data")
_HIGHRES = reader("HIGHRES_IMU", "time_usec", *_IMU, "id")
_RAW = reader("RAW_IMU", "time_usec", *_IMU, "id")
_SCALED = reader("SCALED_IMU", "time_boot_ms", *_IMU)
_HIL_STATE = reader("HIL_STATE_QUATERNION", "time_usec", "attitude_quaternion")
_SIM_STATE = reader("SIM_STATE", *_EULER)
_SIMSTATE = reader("SIMSTATE", *_EULER)
SCALED_IMUS = [IDS["SCALED_IMU"], IDS["SCALED_IMU2"], IDS["SCALED_IMU3"]]
FINEST_FIRST = [IDS["HIGHRES_IMU"], IDS["RAW_IMU"], *SCALED_IMUS]


_RAW_INT_FIELDS = (
    *("time_usec", "fix_type", "lat", "lon", "vel", "cog", "yaw"),
    *("vel_acc", "hdg_acc", "h_acc"),
)
_GPS_RAW_INT = reader("GPS_RAW_INT", *_RAW_INT_FIELDS)
_GPS2_RAW = reader("GPS2_RAW", *_RAW_INT_FIELDS)
_HIL_GPS = reader("HIL_GPS", "time_usec", "fix_type", "lat", "lon", "vel", "cog", "yaw")
_GPS_INPUT = reader(
    "GPS_INPUT",
    *("time_usec", "fix_type", "lat", "lon", "vn", "ve", "yaw"),
    *("ignore_flags", "speed_accuracy", "horiz_accuracy"),
)
_GLOBAL_POSITION = reader("GLOBAL_POSITION_INT", "time_boot_ms", "lat", "lon", "vx", "vy")


def _raw_fix(
    read: Callable[[bytes], tuple[Any, ...]], payload: bytes, has_accuracy: bool = True
) -> GpsFix:
    time_us, fix_type, lat, lon, vel, cog, yaw, *accuracy = read(payload)
    vel_acc, hdg_acc, h_acc = accuracy if has_accuracy else (0, 0, 0)
    return GpsFix(
        time_us,
        fix_type >= USABLE_FIX,
        _angle(lat, 1e-7),
        _angle(lon, 1e-7),
        vel * 1e-2 if vel != UNKNOWN else math.nan,
        _angle(cog, 1e-2) if cog != UNKNOWN else math.nan,
        _yaw(yaw),
        vel_acc * 1e-3 or math.nan,
        _angle(hdg_acc, 1e-5) or math.nan,
        h_acc * 1e-3 or math.nan,
    )


def _gps_input(payload: bytes) -> GpsFix:
    time_us, fix_type, lat, lon, vn, ve, yaw, ignored, speed_std, position_std = _GPS_INPUT(payload)
    speed, course = _polar(vn, ve) if not ignored & IGNORE_VELOCITY else (math.nan, math.nan)
    return GpsFix(
        time_us,
        fix_type >= USABLE_FIX,
        _angle(lat, 1e-7),
        _angle(lon, 1e-7),
        speed,
        course,
        _yaw(yaw),
        speed_std if not ignored & IGNORE_SPEED_ACCURACY else math.nan,
        math.nan,
        position_std if not ignored & IGNORE_POSITION_ACCURACY else math.nan,
    )


def _global_position(payload: bytes) -> GpsFix:
    time_ms, lat, lon, vn, ve = _GLOBAL_POSITION(payload)
    speed, course = _polar(vn * 1e-2, ve * 1e-2)
    position = _angle(lat, 1e-7), _angle(lon, 1e-7)
    unknown = (math.nan, math.nan, math.nan, math.nan)
    return GpsFix(time_ms * 1000, True, *position, speed, course, *unknown)


_FIXES: dict[GpsMessage, Callable[[bytes], GpsFix]] = {
    "GPS_RAW_INT": partial(_raw_fix, _GPS_RAW_INT),
    "GPS2_RAW": partial(_raw_fix, _GPS2_RAW),
    "HIL_GPS": partial(_raw_fix, _HIL_GPS, has_accuracy=False),
    "GPS_INPUT": _gps_input,
    "GLOBAL_POSITION_INT": _global_position,
}


def _angle(value: float, degrees: float) -> float:
    """Radians of a count of so many degrees."""
    return math.radians(value * degrees)


def _yaw(centidegrees: int) -> float:
    """Yaw of two antennas: 0 is "never", 65535 "not now", 36000 north."""
    return math.nan if centidegrees in {0, UNKNOWN} else _angle(centidegrees, 1e-2)


def _polar(north: float, east: float) -> tuple[float, float]:
    return math.hypot(north, east), math.atan2(east, north)
