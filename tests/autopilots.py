"""What PX4 and ArduPilot do with an ODOMETRY message, written from their sources.

PX4: mavlink_receiver.cpp handle_message_odometry, EKF2.cpp UpdateExtVisionSample,
estimator_interface.cpp setExtVisionData, ev_control.cpp, ev_yaw_control.cpp. ArduPilot:
GCS_Common.cpp handle_odometry, AP_VisualOdom_MAV.cpp, AP_NavEKF3_Measurements.cpp
writeExtNavData. Both with GPS in use, as beside us. Their parameters have their defaults unless
told otherwise.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

LOCAL_NED, LOCAL_ENU, BODY_FRD, LOCAL_FRD, LOCAL_FLU = 1, 4, 12, 20, 21
UNKNOWN, NAIVE, VISION, VIO = 0, 1, 2, 3


def yaw_of(q: Any) -> float:
    w, x, y, z = map(float, q)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


@dataclass
class Px4:
    """EKF2 with EKF2_EV_CTRL = 8: yaw alone."""

    ev_qmin: int = 0
    eva_noise: float = 0.1  # rad
    yaw_aligned: bool = True  # by the compass, on the ground
    ev_yaw: bool = False  # is fused
    refused: list[str] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    fused: list[tuple[int, float, float]] = field(default_factory=list)  # us, rad, rad^2
    _last_good: tuple[int, int, int] | None = None  # us, quality, reset counter
    _newest_us: int | None = None

    def hear(self, m: Any) -> None:
        if m.estimator_type not in {UNKNOWN, NAIVE, VISION, VIO}:
            self.refused.append("estimator_type")  # and says so on the ground station
            return
        pose = {LOCAL_NED: "NED", LOCAL_ENU: "NED", LOCAL_FRD: "FRD", LOCAL_FLU: "FRD"}
        frame = pose.get(m.frame_id) if finite(m.x, m.y, m.z) else None
        q = np.array(m.q, np.float32)
        norm = float(np.sqrt(np.sum(q * q, dtype=np.float32)))
        if not finite(*q) or abs(1.0 - norm) > 1e-5 or not any(q):
            self.refused.append("q")
            return
        told = [m.pose_covariance[i] for i in (15, 18, 20)] if m.estimator_type != NAIVE else [NAN]
        floor = max(self.eva_noise**2, self.eva_noise, 0.01**2)  # as it is there: not squared
        variance = max(floor, told[2]) if finite(*told) else floor
        if self._newest_us is not None and m.time_usec < self._newest_us + MIN_INTERVAL_US:
            self.refused.append("too fast")
            return
        self._newest_us = m.time_usec
        if frame != "NED" and self.yaw_aligned:  # FRD, unless told otherwise
            self.refused.append("frame")
            return
        self._control(m.time_usec, yaw_of(q), variance, m.quality, m.reset_counter)

    def _control(self, time_us: int, yaw: float, variance: float, quality: int, resets: int):
        before = self._last_good or (-(10**9), 0, 0)
        is_good = self.ev_qmin <= 0 or quality >= self.ev_qmin
        was_good = self.ev_qmin <= 0 or before[1] >= self.ev_qmin
        if self.ev_yaw and time_us - before[0] > 400_000:
            self.ev_yaw = False
            self.events.append("stopped")
        if not is_good:
            self.refused.append("quality")
            return
        if self.ev_yaw and resets != before[2]:
            self.events.append("reset")
        elif not self.ev_yaw and was_good and time_us - before[0] < 200_000:
            self.ev_yaw = True
            self.events.append("started" if self.yaw_aligned else "started with a reset")
            self.yaw_aligned = True
        self._last_good = (time_us, quality, resets)
        if self.ev_yaw:
            self.fused.append((time_us, yaw, variance))


@dataclass
class ArduPilot:
    """EKF3 with VISO_TYPE = 1 and EK3_SRC1_YAW = 6."""

    viso_qual_min: int = 0
    viso_yaw_noise: float = 0.2  # rad
    viso_pos_noise: float = 0.2  # m
    refused: list[str] = field(default_factory=list)
    used: list[tuple[int, float, float]] = field(default_factory=list)  # ms of arrival, rad, rad
    velocities: int = 0
    resets: int = 0
    position_errors: set[float] = field(default_factory=set)
    _counter: int = 0
    _heard_ms: int | None = None
    _written_ms: int | None = None

    def is_healthy(self, now_ms: int) -> bool:
        return self._heard_ms is not None and now_ms - self._heard_ms < 300

    def hear(self, m: Any, now_ms: int) -> None:
        if (m.frame_id, m.child_frame_id) != (LOCAL_FRD, BODY_FRD):
            self.refused.append("frame")
            return
        cov, angle_error, position_error = m.pose_covariance, 0.0, 0.0
        if not math.isnan(cov[0]):
            position_error = math.cbrt(sum(cov[i] ** 2 for i in (0, 6, 11)))
            angle_error = math.cbrt(sum(cov[i] ** 2 for i in (15, 18, 20)))
        angle_error = min(max(angle_error, self.viso_yaw_noise), 1.5)
        self.position_errors.add(min(max(position_error, self.viso_pos_noise), 100.0))
        self._heard_ms = now_ms
        self.velocities += not any(map(math.isnan, (m.vx, m.vy, m.vz)))
        if m.quality < self.viso_qual_min:
            self.refused.append("quality")
            return
        if any(map(math.isnan, (m.x, m.y, m.z))):
            self.refused.append("position")
            return
        if self._written_ms is not None and now_ms - self._written_ms < 20:
            self.refused.append("too fast")
            return
        self._written_ms = now_ms
        if m.reset_counter != self._counter:
            self._counter = m.reset_counter
            self.resets += 1  # of the position alone
        if any(map(math.isnan, m.q)):
            self.refused.append("q")
            return
        self.used.append((now_ms, yaw_of(m.q), max(angle_error, math.radians(5))))


NAN = math.nan
MIN_INTERVAL_US = 12_000
"""PX4: time in the buffer of IMU samples by the length of that of observations; some 10 ms."""
