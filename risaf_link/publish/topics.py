"""What MQTT topics tell, as JSON.

Units are in the names. What is not known is null. `docs/mqtt.md` has the same as tables, written
from here.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from risaf_link.core.estimate import Estimate
from risaf_link.core.health import Reason, SensorState
from risaf_link.mavlink.notices import Notice

SCHEMA = 1  # to be raised when a field goes or changes its meaning; new ones may come
DIGITS = 6  # of angles, rad, and of relative biases, rad/s
RATE_DIGITS = 8  # of the fused rate, rad/s, and of the quaternion: finer than the best array

Number = float | None
Vector = list[float]
Schema = Annotated[int, Meta(description="version of this schema")]
BootTime = Annotated[int, Meta(description="vehicle's boot clock, microseconds")]
UnixTime = Annotated[
    int, Meta(description="microseconds since 1970, on the companion computer's clock")
]


class Attitude(Struct, frozen=True):
    """Attitude and rates."""

    schema: Schema
    time_us: BootTime
    unix_us: UnixTime
    q_nb: Annotated[Vector, Meta(description="unit quaternion w, x, y, z, body (FRD) to NED")]
    roll_rad: Annotated[float, Meta(description="roll")]
    pitch_rad: Annotated[float, Meta(description="pitch")]
    yaw_rad: Annotated[Number, Meta(description="from true north, clockwise; null until aligned")]
    roll_std_rad: Annotated[float, Meta(description="standard deviation of roll")]
    pitch_std_rad: Annotated[float, Meta(description="standard deviation of pitch")]
    yaw_std_rad: Annotated[float, Meta(description="standard deviation of yaw")]
    rate_b_rad_s: Annotated[Vector, Meta(description="rates about x, y, z of the body, bias off")]
    bias_b_rad_s: Annotated[Vector, Meta(description="bias of the fused rate")]
    yaw_resets: Annotated[int, Meta(description="how often yaw was set")]


class HeadingReport(Struct, frozen=True):
    """GPS heading, and what came of it."""

    schema: Schema
    time_us: BootTime
    unix_us: UnixTime
    state: Annotated[
        str, Meta(description="NO_FIX, TOO_SLOW, ALIGNING, FUSING, REJECTING or DEAD_RECKONING")
    ]
    source: Annotated[
        str, Meta(description="NONE, VELOCITY, POSITIONS, POSITIONS_RAW or DUAL_ANTENNA")
    ]
    yaw_rad: Annotated[Number, Meta(description="estimated, from true north; null until aligned")]
    yaw_std_rad: Annotated[float, Meta(description="its standard deviation")]
    measured_rad: Annotated[Number, Meta(description="the last heading that GPS gave")]
    measured_std_rad: Annotated[Number, Meta(description="its standard deviation")]
    innovation_rad: Annotated[Number, Meta(description="measured minus predicted")]
    innovation_std_rad: Annotated[Number, Meta(description="its standard deviation")]
    test_ratio: Annotated[
        Number,
        Meta(description="size of the innovation / (gate x its deviation); rejected above 1"),
    ]
    speed_m_s: Annotated[Number, Meta(description="over ground, of the last fix")]
    since_fused_s: Annotated[Number, Meta(description="since the last heading that was fused")]
    fused_count: Annotated[int, Meta(description="headings fused")]
    rejected_count: Annotated[int, Meta(description="headings rejected")]


class ArrayReport(Struct, frozen=True):
    """The fused rate, and how much of the array stands behind it."""

    schema: Schema
    time_us: BootTime
    unix_us: UnixTime
    rate_b_rad_s: Annotated[Vector, Meta(description="fused rate, bias not taken off")]
    rate_std_rad_s: Annotated[list[Number], Meta(description="its standard deviation")]
    epochs: Annotated[int, Meta(description="since the service started")]
    epochs_incomplete: Annotated[int, Meta(description="of these, with samples missing")]
    samples_lost: Annotated[int, Meta(description="readings of one gyro that never came")]
    sensors: Annotated[int, Meta(description="gyros in the array")]
    valid: Annotated[int, Meta(description="with a valid reading")]
    active: Annotated[list[int], Meta(description="behind the fused rate, on x, y, z")]
    healthy: Annotated[int, Meta(description="sensors that stand so")]
    suspect: Annotated[int, Meta(description="likewise")]
    dead: Annotated[int, Meta(description="likewise")]


class SensorsReport(Struct, frozen=True):
    """Every sensor, in columns."""

    schema: Schema
    time_us: BootTime
    unix_us: UnixTime
    state: Annotated[list[str], Meta(description="HEALTHY, SUSPECT or DEAD, of each sensor")]
    reason: Annotated[
        list[str],
        Meta(description="NONE, SETTLING, WANDERING, OUTLYING, FROZEN or SILENT, of each"),
    ]
    rejected: Annotated[Vector, Meta(description="share of its readings rejected of late, 0 to 1")]
    relative_bias_rad_s: Annotated[
        list[list[Number]], Meta(description="[x, y, z] of each, against the array")
    ]


class Event(Struct, frozen=True):
    """What STATUSTEXT tells the operator."""

    schema: Schema
    time_us: BootTime
    unix_us: UnixTime
    started_us: Annotated[
        int, Meta(description="microseconds since 1970 at which the service started")
    ]
    number: Annotated[
        int,
        Meta(description="1, 2, ... since then: what comes twice has the same, a gap was dropped"),
    ]
    severity: Annotated[str, Meta(description="CRITICAL, ERROR, WARNING, NOTICE or INFO")]
    text: Annotated[str, Meta(description="what is told")]


class Availability(Struct, frozen=True, omit_defaults=True):
    """Whether the service is there; the broker itself says `offline` when it vanishes."""

    schema: Schema
    state: Annotated[str, Meta(description="online or offline")]
    unix_us: Annotated[
        int | None, Meta(description="when it came online; not in the last will")
    ] = None
    version: Annotated[str | None, Meta(description="of risaf_link; likewise")] = None


def encode(message: Struct) -> bytes:
    """A message as it is sent; what is not finite is null."""
    return msgspec.json.encode(message)


def attitude(estimate: Estimate, unix_us: int) -> Attitude:
    """What `attitude` tells of an estimate."""
    state = estimate.attitude
    roll, pitch, yaw = (_angle(angle) for angle in state.euler)
    return Attitude(
        SCHEMA,
        estimate.boot_us,
        unix_us,
        _rounded(state.q_nb, RATE_DIGITS),
        roll,
        pitch,
        yaw if state.aligned else None,
        _angle(state.roll_std),
        _angle(state.pitch_std),
        _angle(state.yaw_std),
        _rounded(state.rate_b, RATE_DIGITS),
        _rounded(state.bias_b, RATE_DIGITS),
        state.resets,
    )


def heading(estimate: Estimate, unix_us: int) -> HeadingReport:
    """What `heading` tells of an estimate."""
    status = estimate.heading
    measured, innovation = status.heading, status.innovation
    return HeadingReport(
        SCHEMA,
        estimate.boot_us,
        unix_us,
        status.state.name,
        measured.source.name if measured else "NONE",
        _angle(status.yaw) if estimate.attitude.aligned else None,
        _angle(status.yaw_std),
        _angle(measured.heading) if measured else None,
        _angle(math.sqrt(measured.variance)) if measured else None,
        _angle(innovation.value) if innovation else None,
        _angle(math.sqrt(innovation.variance)) if innovation else None,
        round(innovation.test_ratio, 4) if innovation else None,
        round(status.speed, 3),
        round(status.time_since_fused, 3),
        status.fused_count,
        status.rejected_count,
    )


def array(estimate: Estimate, unix_us: int) -> ArrayReport:
    """What `array` tells of an estimate."""
    fused, status = estimate.fused, estimate.array
    return ArrayReport(
        SCHEMA,
        estimate.boot_us,
        unix_us,
        _rounded(fused.rate_b, RATE_DIGITS),
        _rounded(np.sqrt(fused.noise), RATE_DIGITS),
        status.epochs,
        status.epochs_incomplete,
        status.samples_lost,
        status.sensors,
        fused.valid,
        fused.active.tolist(),
        *(status.health.count(state) for state in SensorState),
    )


def sensors(estimate: Estimate, unix_us: int) -> SensorsReport:
    """What `sensors` tells of an estimate."""
    health = estimate.array.health
    return SensorsReport(
        SCHEMA,
        estimate.boot_us,
        unix_us,
        [_STATES[state] for state in health.state.tolist()],
        [_REASONS[reason] for reason in health.reason.tolist()],
        _rounded(health.rejected, 4),
        _rounded(health.relative_bias, DIGITS),
    )


def event(notice: Notice, number: int, times_us: tuple[int, int, int]) -> Event:
    """What `events` tells of a notice; boot clock, UNIX, UNIX of the start."""
    return Event(SCHEMA, *times_us, number, notice.severity.name, notice.text)


STATES: dict[str, Callable[[Estimate, int], Struct]] = {
    "attitude": attitude,
    "heading": heading,
    "array": array,
    "sensors": sensors,
}
"""What a topic that tells of estimates makes of one, and of the UNIX time at which it came."""

MESSAGES: dict[str, type[Struct]] = {
    "attitude": Attitude,
    "heading": HeadingReport,
    "array": ArrayReport,
    "sensors": SensorsReport,
    "events": Event,
    "availability": Availability,
}
"""What is sent under each topic."""

_STATES = {int(state): state.name for state in SensorState}
_REASONS = {int(reason): reason.name for reason in Reason}


def _angle(value: float) -> float:
    return round(value, DIGITS)


def _rounded(values: NDArray[Any], digits: int) -> list[Any]:
    rounded: list[Any] = np.round(values, digits).tolist()
    return rounded
