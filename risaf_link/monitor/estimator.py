"""What is known of one risaf_link component: everything that it tells, as it told it last.

Angles in rad from true north or of the body, rates in rad/s, times in microseconds of whoever noted
the arrival. None: it has not told.
"""

import math
from collections import deque

import numpy as np
from msgspec import Struct, field

from risaf_link.core.rotation import euler_from_quaternion
from risaf_link.mavlink.dialect import IDS, reader, text_of
from risaf_link.mavlink.frame import Frame

HISTORY_S, STEP_S = 600, 0.2  # how far back it is remembered, and how finely
MOST_SENSORS = 4096  # that anybody is believed to have

Axes = tuple[float, float, float]
NOTHING = (math.nan,) * 3


class Attitude(Struct, frozen=True):
    """ATTITUDE_QUATERNION."""

    roll: float
    pitch: float
    yaw: float
    rate: Axes  # bias taken off


class Deviations(Struct, frozen=True):
    """ATTITUDE_QUATERNION_COV."""

    roll: float
    pitch: float
    yaw: float


class Heading(Struct, frozen=True):
    """GPS_HEADING_STATUS; NaN: not known."""

    gps: float
    gps_std: float
    innovation: float
    innovation_std: float
    test_ratio: float
    yaw: float
    yaw_std: float
    speed: float
    time_since_fused: float  # s
    fused: int
    rejected: int
    source: int
    state: int

    @property
    def gate(self) -> float:
        """How large an innovation may be to be fused, rad."""
        return abs(self.innovation) / self.test_ratio if self.test_ratio > 0 else math.nan


class Array(Struct, frozen=True):
    """ARRAY_STATUS."""

    rate: Axes  # fused, before the filter's bias is taken off
    rate_std: Axes
    epochs: int
    epochs_incomplete: int
    samples_lost: int
    sensors: int
    valid: int
    active: tuple[int, int, int]
    healthy: int
    suspect: int
    dead: int
    array_id: int


class Sensors(Struct):
    """ARRAY_SENSOR_HEALTH and ARRAY_SENSOR_REASON, of all sensors; None: not told yet."""

    bias: list[tuple[int, int, int] | None] = field(default_factory=list)  # 1e-5 rad/s
    rejected: list[int | None] = field(default_factory=list)  # percent
    state: list[int | None] = field(default_factory=list)
    reason: list[int | None] = field(default_factory=list)

    def resize(self, size: int) -> None:
        """Let there be so many."""
        for column in (self.bias, self.rejected, self.state, self.reason):
            del column[size:]
            column.extend([None] * (size - len(column)))


class Row(Struct, frozen=True, array_like=True):
    """One instant of the past."""

    time_us: int
    yaw: float
    yaw_std: float
    gps: float  # NaN where there was no new one
    innovation: float  # likewise
    gate: float  # likewise
    test_ratio: float  # likewise
    state: int | None
    roll: float
    pitch: float
    roll_std: float
    pitch_std: float
    rate: Axes
    bias: Axes
    bias_std: Axes
    healthy: int | None
    suspect: int | None
    dead: int | None


class Estimator:
    """One component, from the frames that it sends.

    Attributes
    ----------
    rows : deque of Row
        Its past, a row each fifth of a second in which anything came.
    row_count : int
        How many rows there ever were.
    sensors_version : int
        Changes with what is known of the sensors.
    """

    def __init__(self) -> None:
        self.attitude: Attitude | None = None
        self.deviations: Deviations | None = None
        self.heading: Heading | None = None
        self.array: Array | None = None
        self.named: dict[str, float] = {}
        self.sensors = Sensors()
        self.sensors_version = 0
        self.heard_us = 0
        self.rows: deque[Row] = deque(maxlen=round(HISTORY_S / STEP_S))
        self.row_count = 0
        self._slot = -1
        self._counted: tuple[int, int] | None = None  # headings that the last row told of
        self._takers = {
            IDS["ATTITUDE_QUATERNION"]: self._take_attitude,
            IDS["ATTITUDE_QUATERNION_COV"]: self._take_deviations,
            IDS["GPS_HEADING_STATUS"]: self._take_heading,
            IDS["ARRAY_STATUS"]: self._take_array,
            IDS["ARRAY_SENSOR_HEALTH"]: self._take_health,
            IDS["ARRAY_SENSOR_REASON"]: self._take_reason,
            IDS["NAMED_VALUE_FLOAT"]: self._take_named,
        }

    def take(self, frame: Frame, time_us: int) -> None:
        """Take the next frame."""
        self.heard_us = time_us
        slot = int(time_us / (STEP_S * 1e6))
        if slot != self._slot and self.attitude is not None:
            self._slot = slot
            self._remember(time_us)
        self._takers[frame.message_id](frame.payload)

    @property
    def bias(self) -> Axes:
        """Of the fused rate, as the filter has it."""
        return self._axes("bias_")

    @property
    def bias_std(self) -> Axes:
        """Its standard deviation."""
        return self._axes("bias_std_")

    def _axes(self, prefix: str) -> Axes:
        x, y, z = (self.named.get(prefix + axis, math.nan) for axis in "xyz")
        return x, y, z

    def _remember(self, time_us: int) -> None:
        attitude, deviations, h, array = self.attitude, self.deviations, self.heading, self.array
        counted = (h.fused, h.rejected) if h else None
        is_new = h is not None and self._counted is not None and counted != self._counted
        self._counted = counted
        new = h if is_new else None
        row = Row(
            time_us,
            h.yaw if h else math.nan,
            h.yaw_std if h else math.nan,
            new.gps if new else math.nan,
            new.innovation if new else math.nan,
            new.gate if new else math.nan,
            new.test_ratio if new else math.nan,
            h.state if h else None,
            attitude.roll if attitude else math.nan,
            attitude.pitch if attitude else math.nan,
            deviations.roll if deviations else math.nan,
            deviations.pitch if deviations else math.nan,
            array.rate if array else NOTHING,
            self.bias,
            self.bias_std,
            array.healthy if array else None,
            array.suspect if array else None,
            array.dead if array else None,
        )
        self.rows.append(row)
        self.row_count += 1

    def _take_attitude(self, payload: bytes) -> None:
        *q_nb, p, q, r = _ATTITUDE(payload)
        self.attitude = Attitude(*euler_from_quaternion(np.array(q_nb)), (p, q, r))

    def _take_deviations(self, payload: bytes) -> None:
        covariance, _ = _COVARIANCE(payload)
        roll, pitch, yaw = (math.sqrt(max(covariance[i], 0.0)) for i in (0, 4, 8))
        self.deviations = Deviations(roll, pitch, yaw)

    def _take_heading(self, payload: bytes) -> None:
        self.heading = Heading(*_HEADING(payload))

    def _take_array(self, payload: bytes) -> None:
        self.array = array = Array(*_ARRAY(payload))
        if array.sensors <= MOST_SENSORS and array.sensors != len(self.sensors.state):
            self.sensors.resize(array.sensors)
            self.sensors_version += 1

    def _take_health(self, payload: bytes) -> None:
        first, count, bias, rejected, state = _HEALTH(payload)
        count = min(count, len(state))
        there = slice(first, first + count)
        if self._reaches(first + count):
            self.sensors.bias[there] = list(
                zip(*(bias[i : 3 * count : 3] for i in range(3)), strict=True)
            )
            self.sensors.rejected[there] = rejected[:count]
            self.sensors.state[there] = state[:count]

    def _take_reason(self, payload: bytes) -> None:
        first, count, reason = _REASON(payload)
        count = min(count, len(reason))
        if self._reaches(first + count):
            self.sensors.reason[first : first + count] = reason[:count]

    def _reaches(self, end: int) -> bool:
        """Make room for so many sensors; whether there can be so many."""
        if end > MOST_SENSORS:
            return False
        if end > len(self.sensors.state):
            self.sensors.resize(end)
        self.sensors_version += 1
        return True

    def _take_named(self, payload: bytes) -> None:
        name, value = _NAMED(payload)
        text = text_of(name)
        if text in NAMES:
            self.named[text] = value


NAMES = frozenset(f"{what}_{axis}" for what in ("bias", "bias_std") for axis in "xyz")
"""Of NAMED_VALUE_FLOAT, what is shown."""

_ATTITUDE = reader(
    "ATTITUDE_QUATERNION", "q1", "q2", "q3", "q4", "rollspeed", "pitchspeed", "yawspeed"
)
_COVARIANCE = reader("ATTITUDE_QUATERNION_COV", "covariance", "time_usec")
_HEADING = reader(
    "GPS_HEADING_STATUS",
    *("heading", "heading_std", "innovation", "innovation_std", "test_ratio", "yaw", "yaw_std"),
    *("speed", "time_since_fused", "fused_count", "rejected_count", "source", "state"),
)
_ARRAY = reader(
    "ARRAY_STATUS",
    *("rate", "rate_std", "epochs", "epochs_incomplete", "samples_lost", "sensors_expected"),
    *("sensors_valid", "active", "healthy", "suspect", "dead", "array_id"),
)
_HEALTH = reader(
    "ARRAY_SENSOR_HEALTH",
    *("first_sensor", "sensor_count", "relative_bias", "rejected_percent", "state"),
)
_REASON = reader("ARRAY_SENSOR_REASON", "first_sensor", "sensor_count", "reason")
_NAMED = reader("NAMED_VALUE_FLOAT", "name", "value")

_OWN = "GPS_HEADING_STATUS", "ARRAY_STATUS", "ARRAY_SENSOR_HEALTH", "ARRAY_SENSOR_REASON"
_SHARED = "ATTITUDE_QUATERNION", "ATTITUDE_QUATERNION_COV", "NAMED_VALUE_FLOAT"

OWN = frozenset(IDS[name] for name in _OWN)
"""Messages that only a risaf_link component sends."""

TOLD = OWN | {IDS[name] for name in _SHARED}
"""Messages that it is known by."""
