"""The autopilot as a component: it sends GPS, and the truth for scoring.

A GPS message is stamped with the time of its arrival at the autopilot, as by PX4: what it describes
is older by the receiver's latency.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.earth import GRAVITY
from risaf_link.core.rotation import Floats
from risaf_link.sim.message import AUTOPILOT, Message, table, whole
from risaf_link.sim.readings import clock_us
from risaf_link.sim.receiver import fixes
from risaf_link.sim.scenario import Scenario
from risaf_link.sim.trajectory import sample_times

TRUTH_RATE = 10.0  # Hz
UNKNOWN = 2**16 - 1


def gps(scenario: Scenario) -> Iterator[Message]:
    """GPS_RAW_INT, as the receiver reports; without a fix it repeats its last position.

    What is not known then has the value that MAVLink reserves for it; accuracies are those that
    u-blox receivers tell without a fix.
    """
    receiver = scenario.receiver
    f = fixes(scenario.trajectory, scenario.duration, receiver, scenario.generator("receiver"))
    for fault in scenario.receiver_faults.values():
        f = fault.spoil(f)
    lost = is_lost(f.arrival_s, scenario.outages)
    last = np.maximum.accumulate(np.where(lost, -1, np.arange(len(lost))))

    def repeated(values: Floats) -> NDArray[np.int64]:
        return np.where(last < 0, 0, whole(values)[last])

    altitude_mm = repeated(f.altitude * 1e3)
    columns = {
        "time_usec": clock_us(f.arrival_s),
        "lat": repeated(np.degrees(f.latitude) * 1e7),
        "lon": _around(repeated(np.degrees(f.longitude) * 1e7)),
        "alt": altitude_mm,
        "alt_ellipsoid": altitude_mm,  # the geoid is taken for the ellipsoid
    }
    known_or_not: dict[str, tuple[Any, int]] = {
        "fix_type": (3, 1),  # GPS_FIX_TYPE_3D_FIX, GPS_FIX_TYPE_NO_FIX
        "eph": (80, UNKNOWN),
        "epv": (120, UNKNOWN),
        "vel": (whole(f.speed * 1e2), UNKNOWN),
        "cog": (whole(np.degrees(f.course) * 1e2) % 36_000, UNKNOWN),
        "satellites_visible": (14, 0),
        "h_acc": (round(receiver.position_noise * 1e3), 2**32 - 1),
        "v_acc": (round(receiver.altitude_noise * 1e3), 2**32 - 1),
        "vel_acc": (round(receiver.velocity_noise * 1e3), 20_000),
        "hdg_acc": (whole(np.degrees(f.course_std) * 1e5), 18_000_000),
    }
    columns |= {name: np.where(lost, no, yes) for name, (yes, no) in known_or_not.items()}
    return table(AUTOPILOT, "GPS_RAW_INT", columns, yaw=0)  # one antenna


def is_lost(time_s: Floats, outages: Iterable[tuple[float, float]]) -> NDArray[np.bool_]:
    """Whether times, shape (k,), seconds, are in an outage."""
    lost = np.zeros(len(time_s), dtype=bool)
    for start, end in outages:
        lost |= (start <= time_s) & (time_s < end)
    return lost


def truth(scenario: Scenario) -> Iterator[Message]:
    """HIL_STATE_QUATERNION; accelerations are specific force, the air is still."""
    for time_s in sample_times(TRUTH_RATE, scenario.duration):
        t = scenario.trajectory(time_s)
        airspeed = whole(np.linalg.norm(t.velocity_n, axis=1) * 1e2)
        columns = {
            "time_usec": clock_us(time_s),
            "attitude_quaternion": t.q_nb,
            "lat": whole(np.degrees(t.latitude) * 1e7),
            "lon": _around(whole(np.degrees(t.longitude) * 1e7)),
            "alt": whole(t.altitude * 1e3),
            "ind_airspeed": airspeed,
            "true_airspeed": airspeed,
        }
        columns |= zip(("rollspeed", "pitchspeed", "yawspeed"), t.rate_b.T, strict=True)
        columns |= zip(("vx", "vy", "vz"), whole(t.velocity_n * 1e2).T, strict=True)
        columns |= zip(("xacc", "yacc", "zacc"), whole(t.force_b / GRAVITY * 1e3).T, strict=True)
        yield from table(AUTOPILOT, "HIL_STATE_QUATERNION", columns)


def _around(longitude: NDArray[np.int64]) -> NDArray[np.int64]:
    """Go on from the east behind the date line, 1e-7 deg."""
    half = 1_800_000_000
    around: NDArray[np.int64] = (longitude + half) % (2 * half) - half
    return around
