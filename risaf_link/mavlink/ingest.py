"""Messages -> core values. With `gps` and `telemetry`, the only place of MAVLink's units and enums.

Bytes from outside never raise here: what cannot be used is counted by reason.
"""

import math
import struct
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import cast

import numpy as np
from msgspec import Struct, structs

from risaf_link.core.heading import GpsFix
from risaf_link.core.rotation import Floats
from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.choice import Choice, Streams
from risaf_link.mavlink.dialect import IDS, name_of, reader, text_of
from risaf_link.mavlink.epoch import MAX_SENSORS, ArrayParameters, GyroChunk, Source
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.gps import READERS, GpsMessage
from risaf_link.mavlink.identity import NO_AUTOPILOT

MILLI = np.repeat([1e-3, 9.80665e-3], 3)  # rad/s and m/s^2 of a count of mrad/s and mG
INVALID = -32768  # reading of a channel in our dialect
INT16_LIMIT = 32767
LATEST_US = 1 << 62  # no clock shows more
MAX_SENDERS = 64  # of one kind of message that are remembered
NONE = np.zeros((0, 3))

ARRAY_HEAD = struct.Struct("<QHH")  # time_usec, epoch_seq, first_sensor
INFO_TIME = 8  # bytes of IMU_ARRAY_INFO that tell the time: they are first
ARRAY_SIZE = 254  # payload of GYRO_ARRAY and ACCEL_ARRAY; its last bytes: sensor_count, array_id
ARRAY_CAPACITY, DEBUG_CAPACITY = 40, 19  # sensors a message
SCALED_IMUS = [IDS["SCALED_IMU"], IDS["SCALED_IMU2"], IDS["SCALED_IMU3"]]
FINEST_FIRST = [IDS["HIGHRES_IMU"], IDS["RAW_IMU"], *SCALED_IMUS]
SAMPLES = {IDS[name] for name in ("GYRO_ARRAY", "ACCEL_ARRAY", "DEBUG_FLOAT_ARRAY")}
SAMPLES |= {*FINEST_FIRST}  # messages that carry readings
SIDEWAYS = frozenset({1, 2, 3, 4, 7, 8, *range(12, 18), *range(19, 26), 28, 29, 35, 37, 43, 45, 47})
"""MAV_TYPE of what goes where it does not point: it hovers, drifts with the wind, or dives.

Aeroplanes, rotorcraft, airships, balloons, submarines, kites, parafoils. What is not listed, rovers
and boats among it, goes where it points.
"""
ARDUPILOT = 3  # MAV_AUTOPILOT
ON_THE_GROUND = frozenset({10, 11})  # MAV_TYPE of rovers and boats
GROUND_FILTER, OTHER_FILTER = 4.0, 20.0  # Hz; INS_GYRO_FILTER of ArduPilot, by default
STALE_FIX_US = 10_000_000  # a fix that is older by less came late; by more, the clock has jumped


class GpsParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Which GPS messages are believed, the best first."""

    messages: tuple[GpsMessage, ...] = ("GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS")


@dataclass(frozen=True, slots=True)
class ArrayInfo:
    """What an array says of itself."""

    name: str
    gyro_scale: float  # rad/s per count
    gyro_range: float  # rad/s; inf: not known
    accel_scale: float  # m/s^2 per count; NaN: no accelerometers
    accel_range: float  # m/s^2; inf: not known
    sensors: int  # 0: not known
    told: bytes = b""  # payload that said so, behind its time; empty: it is assumed

    def contradicts(self, other: "ArrayInfo") -> bool:
        """Whether an array of this name cannot be both."""
        return self.name == other.name and (self.gyro_scale, str(self.accel_scale)) != (
            other.gyro_scale,
            str(other.accel_scale),  # NaN is NaN here
        )

    def count_of(self, is_gyro: bool) -> tuple[float, float]:
        """Scale of a count, NaN: not known; and from which magnitude on a reading is saturated."""
        scale, limit = (
            (self.gyro_scale, self.gyro_range) if is_gyro else (self.accel_scale, self.accel_range)
        )
        return scale, min(limit * (1 - 1e-6), INT16_LIMIT * scale)


class Ingest:
    """Reads what the estimator needs from frames.

    Of several arrays, or receivers, one is listened to as long as it is not silent: for arrays the
    one with the best encoding, for receivers one of this vehicle with the best message.

    Parameters
    ----------
    array : ArrayParameters
    gps : GpsParameters
    own : tuple of int
        System and component id of this service: what it sent itself is not taken for input.

    Attributes
    ----------
    own : tuple of int
        As given; it may be another later.
    counts : Counter
        Frames that were not used: `own`, `malformed`, `unscaled` (nothing has told the scale of
        the array yet), `superseded` (the sensor comes in a better message), `absent` (there is no
        such sensor), `contested` (an array of the same name tells another scale than before; it
        is believed when it says so again), `other_source`, `no_fix`, `repeated_fix`; readings of
        one axis that are not valid: `invalid`, `saturated`.
    """

    def __init__(self, array: ArrayParameters, gps: GpsParameters, own: tuple[int, int]) -> None:
        self.counts: Counter[str] = Counter()
        self._parameters = array
        self._gps_messages = gps.messages
        self.own = own
        self._arrays, self._receivers = Choice(), Choice()
        self._infos: dict[tuple[int, int, int], ArrayInfo] = {}
        # What contradicts them: one frame in 65536 that are garbled has a checksum that holds, and
        # a wrong scale turns the vehicle.
        self._contested: dict[tuple[int, int, int], ArrayInfo] = {}
        self._imus = Streams(FINEST_FIRST)
        self._autopilot: Source | None = None  # whose they are
        self._last_fixes: dict[Hashable, tuple[int, bytes]] = {}
        self._sideways: dict[int, bool] = {}  # vehicles: whether they go where they do not point
        self._filters: dict[int, float] = {}  # vehicles whose gyros are filtered: by so many Hz
        self._readers: dict[int, Callable[[Frame, int], GyroChunk | GpsFix | None]] = {
            IDS["IMU_ARRAY_INFO"]: self._array_info,
            IDS["GYRO_ARRAY"]: self._gyro_array,
            IDS["ACCEL_ARRAY"]: self._accel_array,
            IDS["DEBUG_FLOAT_ARRAY"]: self._debug_float_array,
            IDS["HIGHRES_IMU"]: self._highres_imu,
            IDS["RAW_IMU"]: self._raw_imu,
            **dict.fromkeys(SCALED_IMUS, self._scaled_imu),
            IDS["HEARTBEAT"]: self._heartbeat,
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
        if (frame.system, frame.component) == self.own:
            self.counts["own"] += 1
            return None
        return read(frame, received_us)

    def info(self, source: Source) -> ArrayInfo | None:
        """What an array has said of itself."""
        return self._infos.get((source.system, source.component, source.array_id))

    def info_of_counts(self, source: Source) -> ArrayInfo:
        """What the counts of an array mean, by what it says or, else, by the configuration."""
        return self.info(source) or self._assumed_info()

    def delay_of(self, source: Source | None) -> float:
        """By how much an array's samples lag behind their stamps, s, as told or as is usual.

        A second-order Butterworth filter delays what changes slowly by sqrt(2) / (2 pi f_c).
        """
        if self._parameters.delay is not None:
            return self._parameters.delay
        cutoff = self._filters.get(source.system) if source and source.encoding == "IMU" else None
        return math.sqrt(2.0) / (math.tau * cutoff) if cutoff else 0.0

    @property
    def message_ids(self) -> frozenset[int]:
        """Of the messages that are read."""
        return frozenset(self._readers)

    @property
    def refused_ids(self) -> frozenset[int]:
        """Of those that are not listened to while there is an array of our dialect."""
        is_best = self._parameters.encodings[:1] == ("GYRO_ARRAY",)
        return frozenset((*FINEST_FIRST, IDS["DEBUG_FLOAT_ARRAY"]) if is_best else ())

    @property
    def source(self) -> Source | None:
        """The array that is listened to."""
        return cast("Source | None", self._arrays.chosen)

    @property
    def heard_us(self) -> int:
        """When its last gyros came."""
        return self._arrays.heard_us

    def take_block(
        self, heard_us: int, invalid: int, saturated: int, refused: Iterable[Frame]
    ) -> None:
        """Take note of frames of the array that were read elsewhere.

        Parameters
        ----------
        heard_us : int
            When the last one with gyros came.
        invalid, saturated : int
            Readings of one axis, as in `counts`.
        refused : iterable of Frame
            What came in between from sources that are less good and not listened to.
        """
        self._arrays.heard_us = heard_us
        self.counts["invalid"] += invalid
        self.counts["saturated"] += saturated
        for frame in refused:
            self.decode(frame, heard_us)

    def _admits(self, source: Source, time_us: int, received_us: int, has_gyros: bool) -> bool:
        """Whether samples are of the array that is listened to; gyros decide which one that is."""
        if time_us > LATEST_US:
            self.counts["malformed"] += 1
            return False
        wanted = self._parameters
        admitted = source.encoding in wanted.encodings and (
            source.encoding != "GYRO_ARRAY" or wanted.id in {None, source.array_id}
        )
        if admitted and has_gyros:
            best_first = wanted.encodings.index(source.encoding)
            rank = (best_first, int(source.system != self.own[0]), source.component)
            admitted = self._arrays.admits(source, rank, received_us)
        if not admitted or source != self._arrays.chosen:
            self.counts["other_source"] += 1
            return False
        return True

    def _clean(self, values: Floats, limit: float | Floats) -> Floats:
        """Make readings NaN that are not finite or at the end of the sensor's range."""
        invalid = ~np.isfinite(values)
        unusable = invalid | (np.abs(values) >= limit)
        if unusable.any():
            self.counts["invalid"] += int(np.count_nonzero(invalid))
            self.counts["saturated"] += int(np.count_nonzero(unusable & ~invalid))
            values[unusable] = np.nan
        return values

    # Our own dialect

    def _array_info(self, frame: Frame, _: int) -> None:
        scale, limit, accel_scale, accel_limit, sensors, array_id, name = _INFO(frame.payload)
        if not 0 < scale < math.inf or sensors > MAX_SENSORS:
            self.counts["malformed"] += 1
            return
        info = ArrayInfo(
            text_of(name),
            scale,
            limit if limit > 0 else math.inf,
            accel_scale if 0 < accel_scale < math.inf else math.nan,
            accel_limit if accel_limit > 0 else math.inf,
            sensors,
            frame.payload[INFO_TIME:],
        )
        key = (frame.system, frame.component, array_id)
        known = self._infos.get(key, info)
        if known.contradicts(info) and info != self._contested.get(key):
            remember(self._contested, key, info, MAX_SENDERS)
            self.counts["contested"] += 1
            return
        self._contested.pop(key, None)
        remember(self._infos, key, info, MAX_SENDERS)

    def _gyro_array(self, frame: Frame, received_us: int) -> GyroChunk | None:
        return self._dialect_array(frame, received_us, is_gyro=True)

    def _accel_array(self, frame: Frame, received_us: int) -> GyroChunk | None:
        return self._dialect_array(frame, received_us, is_gyro=False)

    def _dialect_array(self, frame: Frame, received_us: int, is_gyro: bool) -> GyroChunk | None:
        payload = frame.payload.ljust(ARRAY_SIZE, b"\0")
        time_us, sequence, first = ARRAY_HEAD.unpack_from(payload)
        count, array_id = payload[ARRAY_SIZE - 2 : ARRAY_SIZE]
        if not 0 < count <= ARRAY_CAPACITY:
            self.counts["malformed"] += 1
            return None
        source = Source(frame.system, frame.component, "GYRO_ARRAY", array_id)
        info = self.info_of_counts(source)
        scale, limit = info.count_of(is_gyro)
        if not scale > 0:
            self.counts["unscaled"] += 1
            return None
        if not self._admits(source, time_us, received_us, is_gyro):
            return None
        counts = np.frombuffer(payload, "<i2", 3 * count, ARRAY_HEAD.size).reshape(count, 3)
        values = counts * scale
        if np.abs(values).max() >= limit:
            values[counts == INVALID] = np.nan
            values = self._clean(values, limit)
        rates, forces = (values, NONE) if is_gyro else (NONE, values)
        return GyroChunk(source, time_us, received_us, first, rates, forces, sequence, info.sensors)

    def _assumed_info(self) -> ArrayInfo:
        """Stand in for an array that has said nothing of itself."""
        p = self._parameters
        return ArrayInfo("", p.gyro_scale, p.gyro_range or math.inf, math.nan, math.inf, 0)

    # What stock senders emit

    def _debug_float_array(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, name, first, data = _DEBUG(frame.payload)
        is_gyro = text_of(name) == "gyro"
        if not is_gyro and text_of(name) != "accel":
            return None
        source = Source(frame.system, frame.component, "DEBUG_FLOAT_ARRAY", 0)
        if not self._admits(source, time_us, received_us, is_gyro):
            return None
        values = np.array(data[: 3 * DEBUG_CAPACITY]).reshape(-1, 3)
        used = np.flatnonzero(~np.isnan(values).all(axis=1))
        values = values[: used[-1] + 1] if len(used) else NONE  # what is NaN behind is padding
        limit = self._parameters.gyro_range if is_gyro else 0.0
        values = self._clean(values, limit or math.inf)
        rates, forces = (values, NONE) if is_gyro else (NONE, values)
        return GyroChunk(source, time_us, received_us, first, rates, forces)

    def _highres_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, *readings, sensor = _HIGHRES(frame.payload)
        return self._imu(frame, received_us, sensor, time_us, np.array(readings))

    def _raw_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_us, *counts, sensor = _RAW(frame.payload)
        return self._imu(frame, received_us, sensor, time_us, np.array(counts) * MILLI)

    def _scaled_imu(self, frame: Frame, received_us: int) -> GyroChunk | None:
        time_ms, *counts = _SCALED(frame.payload)
        if not any(counts):  # ArduPilot sends this for a third compass without a third IMU
            self.counts["absent"] += 1
            return None
        sensor = SCALED_IMUS.index(frame.message_id)
        return self._imu(frame, received_us, sensor, time_ms * 1000, np.array(counts) * MILLI)

    def _imu(
        self, frame: Frame, received_us: int, sensor: int, time_us: int, readings: Floats
    ) -> GyroChunk | None:
        source = Source(frame.system, frame.component, "IMU", 0)
        if not self._admits(source, time_us, received_us, has_gyros=True):
            return None
        if source != self._autopilot:
            self._autopilot, self._imus = source, Streams(FINEST_FIRST)
        if not self._imus.admits(sensor, frame.message_id, time_us):
            self.counts["superseded"] += 1
            return None
        limits = np.repeat([self._parameters.gyro_range or math.inf, math.inf], 3)
        if frame.message_id != IDS["HIGHRES_IMU"]:
            limits = np.minimum(limits, INT16_LIMIT * MILLI)
        rates, forces = self._clean(readings, limits).reshape(2, 1, 3)
        tolerance = self._imus.tolerance_us
        return GyroChunk(source, time_us, received_us, sensor, rates, forces, None, 0, tolerance)

    # GPS

    def _heartbeat(self, frame: Frame, _: int) -> None:
        vehicle_type, autopilot = _HEARTBEAT(frame.payload)
        if autopilot != NO_AUTOPILOT:
            remember(self._sideways, frame.system, vehicle_type in SIDEWAYS, MAX_SENDERS)
        if autopilot == ARDUPILOT:
            cutoff = GROUND_FILTER if vehicle_type in ON_THE_GROUND else OTHER_FILTER
            remember(self._filters, frame.system, cutoff, MAX_SENDERS)

    def _gps(self, frame: Frame, received_us: int) -> GpsFix | None:
        name = cast("GpsMessage", name_of(frame.message_id))
        fix, number = READERS[name](frame.payload)
        if not fix.usable:
            self.counts["no_fix"] += 1
            return None
        receiver = (frame.system, frame.component, name, number)
        if self._is_repeated(receiver, fix, frame.payload):
            self.counts["repeated_fix"] += 1
            return None
        best_first = self._gps_messages.index(name)
        rank = (int(frame.system != self.own[0]), best_first, frame.component, number)
        if not self._receivers.admits(receiver, rank, received_us):
            self.counts["other_source"] += 1
            return None
        if self._sideways.get(frame.system, False):
            return structs.replace(fix, course_is_heading=False)
        return fix

    def _is_repeated(self, receiver: Hashable, fix: GpsFix, payload: bytes) -> bool:
        """Whether a fix is not newer than the last one of its receiver."""
        last_us, last_payload = self._last_fixes.get(receiver, (0, b""))
        if fix.time_us and last_us:
            repeated = 0 <= last_us - fix.time_us < STALE_FIX_US
        else:
            repeated = payload == last_payload
        if not repeated:
            remember(self._last_fixes, receiver, (fix.time_us, payload), MAX_SENDERS)
        return repeated


_IMU = ("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc")
_INFO = reader(
    "IMU_ARRAY_INFO",
    *("gyro_scale", "gyro_range", "accel_scale", "accel_range", "sensor_count", "array_id", "name"),
)
_DEBUG = reader("DEBUG_FLOAT_ARRAY", "time_usec", "name", "array_id", "data")
_HIGHRES = reader("HIGHRES_IMU", "time_usec", *_IMU, "id")
_HEARTBEAT = reader("HEARTBEAT", "type", "autopilot")
_RAW = reader("RAW_IMU", "time_usec", *_IMU, "id")
_SCALED = reader("SCALED_IMU", "time_boot_ms", *_IMU)
