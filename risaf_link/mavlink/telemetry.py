"""Core values -> messages. With `ingest`, the only place of MAVLink's units, frames and enums."""

import math
from collections.abc import Callable
from enum import IntEnum
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from risaf_link.core.estimate import Estimate
from risaf_link.core.heading import HeadingSource, HeadingState
from risaf_link.core.health import ArrayHealth, SensorState
from risaf_link.mavlink.dialect import pack, writer
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.identity import NO_AUTOPILOT
from risaf_link.mavlink.odometry import Profile, odometry
from risaf_link.mavlink.signing import LinkSigning

Message = Literal[
    "ATTITUDE_QUATERNION",
    "GPS_HEADING_STATUS",
    "ARRAY_STATUS",
    "ARRAY_SENSOR_HEALTH",
    "ARRAY_SENSOR_REASON",
    "ATTITUDE_QUATERNION_COV",
    "ESTIMATOR_STATUS",
    "NAMED_VALUE_FLOAT",
    "ODOMETRY",
]

ATTITUDE: Message = "ATTITUDE_QUATERNION"

Rates = dict[Message, Annotated[float, Meta(gt=0, le=10_000)]]
"""Hz; what is not named is not sent."""

DEFAULT_RATES: Rates = {
    "ATTITUDE_QUATERNION": 50.0,
    "GPS_HEADING_STATUS": 5.0,
    "ARRAY_STATUS": 1.0,
    "ARRAY_SENSOR_HEALTH": 1.0,
    "ARRAY_SENSOR_REASON": 1.0,
    "ATTITUDE_QUATERNION_COV": 5.0,
}
"""What a link emits unless told otherwise, Hz. ESTIMATOR_STATUS is not among it: ground stations
take it for the autopilot's. ODOMETRY is not: an autopilot may steer by it."""

ONBOARD_CONTROLLER = 18  # MAV_TYPE
MAVLINK_VERSION = 3
MOST_ASKED = 2000.0  # Hz, of all messages that one peer asks for
ESTIMATOR_ATTITUDE, ESTIMATOR_GPS_GLITCH = 1, 1024  # ESTIMATOR_STATUS_FLAGS
UINT32_LIMIT = 2**32 - 1
ROUNDED_US = 1000  # more than the end of a period can be off by

_ATTITUDE_FIELDS = (
    *("time_boot_ms", "q1", "q2", "q3", "q4"),
    *("rollspeed", "pitchspeed", "yawspeed"),
)
_write_attitude = writer(ATTITUDE, *_ATTITUDE_FIELDS)


class ComponentState(IntEnum):
    """MAV_STATE, as far as it applies to an estimator."""

    BOOT = 1  # nothing to estimate from has come yet
    ACTIVE = 4
    CRITICAL = 5  # the samples have stopped


class Emitter:
    """Makes the frames that go to one peer.

    Messages are thinned out on the estimate's own time, so that the same input gives the same
    output however fast it comes: of all estimates between two multiples of a message's period the
    first one is sent.

    Parameters
    ----------
    rates : dict
        Message name to Hz; a rate above the array's means every epoch.
    system, component : int
        Whom the frames come from.
    signing : LinkSigning or None
        Of the link; None: frames are not signed.
    profile : Profile or None
        Of the autopilot that ODOMETRY is for; None: it is not sent.

    Attributes
    ----------
    system, profile
        As given; they may be others later.
    """

    def __init__(
        self,
        rates: Rates,
        system: int,
        component: int,
        signing: LinkSigning | None = None,
        profile: Profile | None = None,
    ) -> None:
        self.system = system
        self.profile = profile
        self._signing = signing
        self._asked: dict[Message, float] = {}  # Hz, 0: none
        self.set_defaults(rates)
        self._component = component
        self._sequence = 0
        self._next_part: dict[str, int] = {}  # of messages that tell of some at a time
        self._periods: dict[str, int] = {}  # which period a message was last sent in

    @property
    def rates(self) -> Rates:
        """What is sent, Hz."""
        return self._sent

    def set_defaults(self, rates: Rates) -> None:
        """Change what is sent of messages that the peer has not asked for."""
        self._rates = rates
        asked = {ATTITUDE: 0.0, **rates, **self._asked}  # it goes first, for it is answered first
        self._sent = {name: rate for name, rate in asked.items() if rate > 0}

    def ask(self, name: Message, rate: float | None) -> bool:
        """Let the peer have a message at so many Hz; 0: not at all, None: by default.

        Returns whether it may: all that one asks for is no more than `MOST_ASKED`.
        """
        others = sum(hertz for other, hertz in self._asked.items() if other != name)
        if rate and others + rate > MOST_ASKED:
            return False
        self._asked.pop(name, None)
        if rate is not None:
            self._asked[name] = rate
        self.set_defaults(self._rates)
        return True

    def emit(self, estimate: Estimate) -> list[bytes]:
        """Frames due at an estimate."""
        frames = []
        for name, rate in self._sent.items():
            if self._is_due(name, rate, estimate.time_us) and self.can_tell(name, estimate):
                frames.append(self.tell(name, estimate))
        return frames

    @property
    def until_us(self) -> float:
        """Before which time of an epoch nothing is due but its attitude; epochs go on in time."""
        others = [(name, rate) for name, rate in self._sent.items() if name != ATTITUDE]
        return min(
            ((self._periods.get(name, -1) + 1) * 1e6 / rate - ROUNDED_US for name, rate in others),
            default=math.inf,
        )

    def emit_attitude(self, time_us: int, boot_us: int, *attitude: float) -> list[bytes]:
        """Do what `emit` does with an attitude: its quaternion and rate, rad/s."""
        rate = self._sent.get(ATTITUDE)
        if rate is None or not self._is_due(ATTITUDE, rate, time_us):
            return []
        return [self._frame(*_write_attitude(_boot_ms(boot_us), *attitude))]

    def _is_due(self, name: Message, rate: float, time_us: int) -> bool:
        """Whether a message is due at an epoch; if so, it is taken for sent."""
        period = math.floor(time_us * rate / 1e6)
        is_due = period != self._periods.get(name)
        self._periods[name] = period
        return is_due

    def can_tell(self, name: Message, estimate: Estimate) -> bool:
        """Whether there is anything to tell: to an autopilot nothing before the heading is set."""
        return name != "ODOMETRY" or (self.profile is not None and estimate.attitude.aligned)

    def tell(self, name: Message, estimate: Estimate) -> bytes:
        """A frame that tells of an estimate, whether it is due or not."""
        return self.frame(name, **self.fields(name, estimate))

    def fields(self, name: Message, estimate: Estimate) -> dict[str, Any]:
        """What a message tells of an estimate; where it tells of a part, of the next one."""
        if name == "NAMED_VALUE_FLOAT":
            turn = self._next_part.get(name, 0)
            self._next_part[name] = (turn + 1) % len(_NAMED)
            return _named_value_float(estimate, turn)
        if name == "ODOMETRY" and self.profile:
            return odometry(estimate, self.profile)
        if name not in _ROUND_ROBIN:
            return _FIELDS[name](estimate)
        fields, most = _ROUND_ROBIN[name]
        n = len(estimate.array.health.state)
        first = self._next_part.get(name, 0)
        first = first if first < n else 0
        self._next_part[name] = first + most
        return {
            "time_usec": estimate.boot_us,
            "first_sensor": first,
            "sensor_count": min(n - first, most),
            "array_id": estimate.array.array_id,
            **fields(estimate.array.health, slice(first, first + most)),
        }

    def heartbeat(self, state: ComponentState) -> bytes:
        """A HEARTBEAT frame."""
        return self.frame("HEARTBEAT", **heartbeat(state))

    def frame(self, name: str, /, **fields: Any) -> bytes:
        """Any message, from us."""
        return self._frame(*pack(name, **fields))

    def _frame(self, message_id: int, payload: bytes) -> bytes:
        sign = self._signing.sign if self._signing else None
        ours = self._sequence, self.system, self._component
        frame = encode(message_id, payload, *ours, sign)
        self._sequence = (self._sequence + 1) % 256
        return frame


def heartbeat(state: ComponentState) -> dict[str, Any]:
    """Fields of a HEARTBEAT."""
    return {
        "type": ONBOARD_CONTROLLER,
        "autopilot": NO_AUTOPILOT,
        "base_mode": 0,
        "custom_mode": 0,
        "system_status": state,
        "mavlink_version": MAVLINK_VERSION,
    }


def _boot_ms(boot_us: int) -> int:
    return boot_us // 1000 % 2**32


def _attitude_quaternion(estimate: Estimate) -> dict[str, Any]:
    attitude = estimate.attitude
    told = _boot_ms(estimate.boot_us), *attitude.q_nb.tolist(), *attitude.rate_b.tolist()
    fields = dict(zip(_ATTITUDE_FIELDS, told, strict=True))
    return {**fields, "repr_offset_q": (0.0, 0.0, 0.0, 0.0)}


def _attitude_quaternion_cov(estimate: Estimate) -> dict[str, Any]:
    attitude = estimate.attitude
    return {
        "time_usec": estimate.boot_us,
        "q": attitude.q_nb,
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), attitude.rate_b, strict=True)),
        "covariance": attitude.angle_covariance.ravel(),
    }


def _estimator_status(estimate: Estimate) -> dict[str, Any]:
    """The heading in the place of the compass; nothing is estimated of position and velocity."""
    innovation = estimate.heading.innovation
    is_rejecting = estimate.heading.state is HeadingState.REJECTING
    flags = ESTIMATOR_ATTITUDE if estimate.attitude.aligned else 0
    ratios = ("vel_ratio", "pos_horiz_ratio", "pos_vert_ratio", "hagl_ratio", "tas_ratio")
    return {
        "time_usec": estimate.boot_us,
        "flags": flags | (ESTIMATOR_GPS_GLITCH if is_rejecting else 0),
        "mag_ratio": innovation.test_ratio if innovation else math.nan,
        **dict.fromkeys((*ratios, "pos_horiz_accuracy", "pos_vert_accuracy"), math.nan),
    }


def _named_value_float(estimate: Estimate, turn: int) -> dict[str, Any]:
    name, value = _NAMED[turn]
    return {
        "time_boot_ms": _boot_ms(estimate.boot_us),
        "name": name,
        "value": value(estimate),
    }


def _gps_heading_status(estimate: Estimate) -> dict[str, Any]:
    status = estimate.heading
    heading, innovation = status.heading, status.innovation
    return {
        "time_usec": estimate.boot_us,
        "heading": heading.heading if heading else math.nan,
        "heading_std": math.sqrt(heading.variance) if heading else math.nan,
        "innovation": innovation.value if innovation else math.nan,
        "innovation_std": math.sqrt(innovation.variance) if innovation else math.nan,
        "test_ratio": innovation.test_ratio if innovation else math.nan,
        "yaw": status.yaw if estimate.attitude.aligned else math.nan,
        "yaw_std": status.yaw_std,
        "speed": status.speed,
        "time_since_fused": status.time_since_fused,
        "fused_count": status.fused_count,
        "rejected_count": status.rejected_count,
        "source": heading.source if heading else HeadingSource.NONE,
        "state": status.state,
    }


def _array_status(estimate: Estimate) -> dict[str, Any]:
    fused, array = estimate.fused, estimate.array
    return {
        "time_usec": estimate.boot_us,
        "rate": fused.rate_b,
        "rate_std": np.sqrt(fused.noise),
        "epochs": min(array.epochs, UINT32_LIMIT),
        "epochs_incomplete": min(array.epochs_incomplete, UINT32_LIMIT),
        "samples_lost": min(array.samples_lost, UINT32_LIMIT),
        "sensors_expected": array.sensors,
        "sensors_valid": fused.valid,
        "active": fused.active,
        "healthy": array.health.count(SensorState.HEALTHY),
        "suspect": array.health.count(SensorState.SUSPECT),
        "dead": array.health.count(SensorState.DEAD),
        "array_id": array.array_id,
    }


def _array_sensor_health(health: ArrayHealth, sensors: slice) -> dict[str, Any]:
    bias = np.clip(np.rint(health.relative_bias[sensors] * 1e5), -32767, 32767)
    percent = np.clip(np.rint(health.rejected[sensors] * 100), 0, 100)
    return {
        "relative_bias": _filled(bias, 90),
        "rejected_percent": _filled(percent, 30),
        "state": _filled(health.state[sensors], 30),
    }


def _array_sensor_reason(health: ArrayHealth, sensors: slice) -> dict[str, Any]:
    return {"reason": _filled(health.reason[sensors], 120)}


def _filled(values: NDArray[Any], length: int) -> list[int]:
    """As integers, and zeros behind them."""
    known: list[int] = values.ravel().astype(int).tolist()
    return known + [0] * (length - len(known))


_ROUND_ROBIN: dict[str, tuple[Callable[[ArrayHealth, slice], dict[str, Any]], int]] = {
    "ARRAY_SENSOR_HEALTH": (_array_sensor_health, 30),
    "ARRAY_SENSOR_REASON": (_array_sensor_reason, 120),
}
"""Messages that tell of so many sensors at a time, one block after another."""

_NAMED: tuple[tuple[str, Callable[[Estimate], float]], ...] = (
    ("yaw_std", lambda e: e.attitude.yaw_std),  # rad
    (
        "hdg_innov",
        lambda e: e.heading.innovation.value if e.heading.innovation else math.nan,
    ),  # rad
    ("hdg_ratio", lambda e: e.heading.innovation.test_ratio if e.heading.innovation else math.nan),
    ("bias_x", lambda e: float(e.attitude.bias_b[0])),  # rad/s
    ("bias_y", lambda e: float(e.attitude.bias_b[1])),
    ("bias_z", lambda e: float(e.attitude.bias_b[2])),
    ("bias_std_x", lambda e: float(e.attitude.bias_std[0])),  # rad/s
    ("bias_std_y", lambda e: float(e.attitude.bias_std[1])),
    ("bias_std_z", lambda e: float(e.attitude.bias_std[2])),
    ("healthy", lambda e: float(e.array.health.count(SensorState.HEALTHY))),  # sensors
    ("dead", lambda e: float(e.array.health.count(SensorState.DEAD))),
)
"""Names of at most 10 characters, one after another."""

_FIELDS: dict[str, Callable[[Estimate], dict[str, Any]]] = {
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "GPS_HEADING_STATUS": _gps_heading_status,
    "ARRAY_STATUS": _array_status,
    "ATTITUDE_QUATERNION_COV": _attitude_quaternion_cov,
    "ESTIMATOR_STATUS": _estimator_status,
}
