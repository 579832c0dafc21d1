"""A hand-made vehicle: frames with whatever rates, fixes and times a test wants."""

import math

import numpy as np

from risaf_link.mavlink.dialect import pack
from risaf_link.mavlink.frame import Frame, FrameParser, encode

SCALE = math.radians(0.01)  # rad/s a count
FORCE_SCALE = 0.005  # m/s^2 a count


class Vehicle:
    """Makes frames of an array (component 158) and an autopilot (component 1)."""

    def __init__(self, sensors: int = 5) -> None:
        self.sensors = sensors
        self._parser = FrameParser()
        self._sequence = 0

    def frame(self, name: str, component: int = 1, /, **fields: object) -> Frame:
        self._sequence = (self._sequence + 1) % 256
        raw = encode(*pack(name, **fields), self._sequence, 1, component)
        (frame,) = self._parser.receive_data(raw)
        return frame

    def info(self) -> Frame:
        return self.frame(
            "IMU_ARRAY_INFO",
            158,
            time_usec=0,
            gyro_scale=SCALE,
            gyro_range=math.inf,
            accel_scale=FORCE_SCALE,
            accel_range=math.inf,
            rate=100.0,
            sensor_count=self.sensors,
            array_id=0,
            name="bench",
        )

    def epoch(self, time_us: int, rate: object = (0.0, 0.0, 0.0), component: int = 158) -> Frame:
        """One GYRO_ARRAY; `rate` (3,) or (sensors, 3), rad/s; NaN: invalid."""
        rates = np.broadcast_to(np.asarray(rate, float), (self.sensors, 3))
        counts = np.where(np.isnan(rates), -32768, np.round(rates / SCALE)).astype(int)
        return self.frame(
            "GYRO_ARRAY",
            component,
            time_usec=time_us,
            epoch_seq=time_us // 10_000 % 65536,
            first_sensor=0,
            rates=[*counts.ravel().tolist(), *[0] * (120 - counts.size)],
            sensor_count=self.sensors,
            array_id=0,
        )

    def forces(self, time_us: int, force: object) -> Frame:
        """One ACCEL_ARRAY; `force` (3,) or (sensors, 3), m/s^2; send it before its GYRO_ARRAY."""
        forces = np.broadcast_to(np.asarray(force, float), (self.sensors, 3))
        counts = np.round(forces / FORCE_SCALE).astype(int)
        return self.frame(
            "ACCEL_ARRAY",
            158,
            time_usec=time_us,
            epoch_seq=time_us // 10_000 % 65536,
            first_sensor=0,
            forces=[*counts.ravel().tolist(), *[0] * (120 - counts.size)],
            sensor_count=self.sensors,
            array_id=0,
        )

    def fix(self, time_us: int, course: float, speed: float = 10.0, fix_type: int = 3) -> Frame:
        """One GPS_RAW_INT with a course, rad."""
        return self.frame(
            "GPS_RAW_INT",
            time_usec=time_us,
            fix_type=fix_type,
            lat=302217000,
            lon=348012000,
            alt=0,
            eph=100,
            epv=100,
            vel=round(speed * 100),
            cog=round(math.degrees(course) * 100) % 36000,
            satellites_visible=12,
            alt_ellipsoid=0,
            h_acc=1000,
            v_acc=1000,
            vel_acc=100,
            hdg_acc=0,
            yaw=0,
        )
