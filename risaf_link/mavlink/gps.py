"""GPS messages -> fixes. A part of `ingest`: MAVLink's units and values for "unknown" end here."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from risaf_link.core.heading import GpsFix
from risaf_link.mavlink.dialect import reader

GpsMessage = Literal["GPS_RAW_INT", "GPS2_RAW", "GPS_INPUT", "HIL_GPS", "GLOBAL_POSITION_INT"]

USABLE_FIX = 3  # GPS_FIX_TYPE_3D_FIX
IGNORE_VELOCITY, IGNORE_SPEED_ACCURACY, IGNORE_POSITION_ACCURACY = 8, 32, 64
UNKNOWN = 65535
NEVER = 0  # of a yaw: the receiver has one antenna
RIGHT_ANGLE = 900_000_000  # degE7


class Report(NamedTuple):
    """A fix, and which of its sender's receivers it is from."""

    fix: GpsFix
    receiver: int = 0


def _gps_raw(read: Callable[[bytes], tuple[Any, ...]], payload: bytes) -> Report:
    time_us, fix_type, lat, lon, vel, cog, yaw, vel_acc, hdg_acc, h_acc = read(payload)
    return Report(
        GpsFix(
            time_us,
            fix_type >= USABLE_FIX,
            *_position(lat, lon),
            *_motion(vel, cog),
            _yaw(yaw),
            vel_acc * 1e-3 or math.nan,
            _angle(hdg_acc, 1e-5) or math.nan,
            h_acc * 1e-3 or math.nan,
            yaw != NEVER,
        )
    )


def _hil_gps(payload: bytes) -> Report:
    time_us, fix_type, lat, lon, vel, cog, yaw, receiver = _HIL_GPS(payload)
    position, motion = _position(lat, lon), _motion(vel, cog)
    accuracy = (math.nan, math.nan, math.nan)
    usable, capable = fix_type >= USABLE_FIX, yaw != NEVER
    fix = GpsFix(time_us, usable, *position, *motion, _yaw(yaw), *accuracy, capable)
    return Report(fix, receiver)


def _gps_input(payload: bytes) -> Report:
    time_us, fix_type, lat, lon, vn, ve, yaw, ignored, speed_std, position_std, receiver = (
        _GPS_INPUT(payload)
    )
    fix = GpsFix(
        time_us,
        fix_type >= USABLE_FIX,
        *_position(lat, lon),
        *(_polar(vn, ve) if not ignored & IGNORE_VELOCITY else (math.nan, math.nan)),
        _yaw(yaw),
        speed_std if not ignored & IGNORE_SPEED_ACCURACY else math.nan,
        math.nan,
        position_std if not ignored & IGNORE_POSITION_ACCURACY else math.nan,
        yaw != NEVER,
    )
    return Report(fix, receiver)


def _global_position(payload: bytes) -> Report:
    time_ms, lat, lon, vn, ve = _GLOBAL_POSITION(payload)
    is_known = lat != 0 or lon != 0  # ArduPilot sends zeros until it knows where it is
    unknown = (math.nan, math.nan, math.nan, math.nan)
    position, motion = _position(lat, lon), _polar(vn * 1e-2, ve * 1e-2)
    return Report(GpsFix(time_ms * 1000, is_known, *position, *motion, *unknown))


def _angle(value: float, degrees: float) -> float:
    """Radians of a count of so many degrees."""
    return math.radians(value * degrees)


def _position(lat: int, lon: int) -> tuple[float, float]:
    """Latitude and longitude; not known if they are none, such as INT32_MAX."""
    if abs(lat) > RIGHT_ANGLE or abs(lon) > 2 * RIGHT_ANGLE:
        return math.nan, math.nan
    return _angle(lat, 1e-7), _angle(lon, 1e-7)


def _motion(vel: int, cog: int) -> tuple[float, float]:
    """Speed and course."""
    speed = vel * 1e-2 if vel != UNKNOWN else math.nan
    return speed, _angle(cog, 1e-2) if cog != UNKNOWN else math.nan


def _yaw(centidegrees: int) -> float:
    """Yaw of two antennas: 0 is "never", 65535 "not now", 36000 north."""
    return math.nan if centidegrees in {NEVER, UNKNOWN} else _angle(centidegrees, 1e-2)


def _polar(north: float, east: float) -> tuple[float, float]:
    return math.hypot(north, east), math.atan2(east, north)


_FIX = ("time_usec", "fix_type", "lat", "lon")
_RAW = (*_FIX, "vel", "cog", "yaw", "vel_acc", "hdg_acc", "h_acc")
_GPS_RAW_INT, _GPS2_RAW = reader("GPS_RAW_INT", *_RAW), reader("GPS2_RAW", *_RAW)
_HIL_GPS = reader("HIL_GPS", *_FIX, "vel", "cog", "yaw", "id")
_GPS_INPUT = reader(
    "GPS_INPUT",
    *(*_FIX, "vn", "ve", "yaw"),
    *("ignore_flags", "speed_accuracy", "horiz_accuracy", "gps_id"),
)
_GLOBAL_POSITION = reader("GLOBAL_POSITION_INT", "time_boot_ms", "lat", "lon", "vx", "vy")

READERS: dict[GpsMessage, Callable[[bytes], Report]] = {
    "GPS_RAW_INT": lambda payload: _gps_raw(_GPS_RAW_INT, payload),
    "GPS2_RAW": lambda payload: _gps_raw(_GPS2_RAW, payload),
    "HIL_GPS": _hil_gps,
    "GPS_INPUT": _gps_input,
    "GLOBAL_POSITION_INT": _global_position,
}
"""How a payload is read, by the message's name."""
