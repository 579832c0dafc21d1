"""Frames as pymavlink, the independent encoder, makes them."""

import math

from pymavlink.dialects.v20 import all as public

from risaf_link.mavlink import risaf
from risaf_link.mavlink.frame import Frame, FrameParser

AUTOPILOT, ARRAY, SERVICE = (1, 1), (1, 158), (1, 191)
GYROS, FORCES = ("GYRO_ARRAY", "rates"), ("ACCEL_ARRAY", "forces")

_CLASSES = {
    message.msgname: (dialect, message)
    for dialect in (public, risaf)
    for message in dialect.mavlink_map.values()
}


def frame(name, sender=AUTOPILOT, /, *, version=2, **fields) -> Frame:
    """One message off the wire; fields that are not given are zero."""
    dialect, message = _CLASSES[name]
    codec = dialect.MAVLink(None, *sender)
    raw = message(**(_zeros(message) | fields)).pack(codec, force_mavlink1=version == 1)
    parser = FrameParser()
    (found,) = parser.receive_data(bytes(raw)) + parser.end()
    return found


def _zeros(message):
    lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
    return {
        name: b"" if kind == "char" else [0] * lengths[name] if lengths[name] else 0
        for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True)
    }


def info(sender=ARRAY, **fields) -> Frame:
    """IMU_ARRAY_INFO of three sensors without accelerometers; a count is 1 mrad/s."""
    told = {"gyro_scale": 1e-3, "gyro_range": 10.0, "sensor_count": 3, "name": b"bench"}
    unknown = {"accel_scale": math.nan, "accel_range": math.nan}
    return frame("IMU_ARRAY_INFO", sender, **(told | unknown | fields))


def array(time_us, counts, sender=ARRAY, *, of=GYROS, **fields) -> Frame:
    """GYRO_ARRAY or ACCEL_ARRAY of as many sensors as there are rows of counts."""
    name, field = of
    flat = [count for sensor in counts for count in sensor]
    readings = {field: flat + [0] * (120 - len(flat)), "sensor_count": len(counts)}
    return frame(name, sender, time_usec=time_us, **(readings | fields))


def debug_array(time_us, name, readings, sender=AUTOPILOT, *, first=0) -> Frame:
    """DEBUG_FLOAT_ARRAY of as many sensors as there are rows, the rest NaN."""
    flat = [value for sensor in readings for value in sensor]
    data = flat + [math.nan] * (58 - len(flat))
    return frame(
        "DEBUG_FLOAT_ARRAY", sender, time_usec=time_us, name=name, array_id=first, data=data
    )


def imu(name, time_us, rate=(1, 2, 3), force=(0, 0, -1000), sender=AUTOPILOT, **fields) -> Frame:
    """HIGHRES_IMU (rad/s, m/s^2), RAW_IMU or SCALED_IMU/2/3 (mrad/s, mG)."""
    time = {"time_boot_ms": time_us // 1000} if "SCALED" in name else {"time_usec": time_us}
    axes = zip(("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc"), (*rate, *force), strict=True)
    return frame(name, sender, **time, **dict(axes), **fields)
