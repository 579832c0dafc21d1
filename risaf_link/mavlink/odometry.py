"""ODOMETRY: our heading, as an autopilot's own filter takes it. A part of `telemetry`.

PX4 and ArduPilot accept different frames and estimators, and drop without a word what is not as
they want it; docs/px4.md and docs/ardupilot.md say what they check. Both need a position to believe
the yaw beside it. We know none: it is told as the origin, give or take 1000 km.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from risaf_link.core.estimate import Estimate

LOCAL_NED, BODY_FRD, LOCAL_FRD = 1, 12, 20  # MAV_FRAME
UNKNOWN, GPS_INS = 0, 5  # MAV_ESTIMATOR_TYPE
POSITION_VARIANCE = 1e12  # m^2: 1000 km, so that who fuses the position by mistake is not moved
WORST_STD = math.radians(20)  # of yaw, from which on the quality is the worst
BEST, WORST, FAILED = 100, 1, -1  # quality


@dataclass(frozen=True, slots=True)
class Profile:
    """How a kind of autopilot takes ODOMETRY."""

    frame: int  # MAV_FRAME of the pose
    estimator: int  # MAV_ESTIMATOR_TYPE


ProfileName = Literal["auto", "px4", "ardupilot"]

PROFILES: dict[str, Profile] = {
    # Only LOCAL_NED has yaw from north, beside GPS; GPS_INS, which we are, is refused.
    "px4": Profile(LOCAL_NED, UNKNOWN),
    # Only LOCAL_FRD is taken, and its yaw as one from north.
    "ardupilot": Profile(LOCAL_FRD, GPS_INS),
}
AUTOPILOTS: dict[int, Profile] = {3: PROFILES["ardupilot"], 12: PROFILES["px4"]}
"""By MAV_AUTOPILOT."""


def quality_of(yaw_std: float) -> int:
    """Quality of a heading in percent: 100 less 5 for each degree of its standard deviation, rad.

    At least 1, the worst.
    """
    return max(round(BEST * (1.0 - yaw_std / WORST_STD)), WORST)


def odometry(estimate: Estimate, profile: Profile) -> dict[str, Any]:
    """Fields of ODOMETRY; where no sensor is behind the rate, the quality is -1: failed."""
    attitude = estimate.attitude
    pose = np.diag([POSITION_VARIANCE] * 6)
    pose[3:, 3:] = attitude.angle_covariance
    return {
        "time_usec": estimate.boot_us,
        "frame_id": profile.frame,
        "child_frame_id": BODY_FRD,
        **dict.fromkeys(("x", "y", "z"), 0.0),
        "q": attitude.q_nb / np.linalg.norm(attitude.q_nb),
        **dict.fromkeys(("vx", "vy", "vz"), math.nan),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), attitude.rate_b, strict=True)),
        "pose_covariance": pose[np.triu_indices(6)],
        "velocity_covariance": [math.nan] + [0.0] * 20,
        "reset_counter": attitude.resets % 256,
        "estimator_type": profile.estimator,
        "quality": quality_of(attitude.yaw_std) if estimate.fused.valid else FAILED,
    }
