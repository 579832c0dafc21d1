"""What stands in the messages of an MCAP, topic by topic, as JSON schemas."""

from collections.abc import Iterable
from typing import Any

AXES = ("x", "y", "z")
ANGLES = ("roll", "pitch", "yaw")
QUATERNION = ("q_w", "q_x", "q_y", "q_z")
IN_DEGREES = tuple(f"{name}_deg" for name in ANGLES)
ATTITUDE = (*QUATERNION, *IN_DEGREES, *(f"{name}_std_deg" for name in ANGLES))
FUSED = (*(f"fused_{axis}" for axis in AXES), *(f"fused_var_{axis}" for axis in AXES))
ACTIVE = tuple(f"active_{axis}" for axis in AXES)

Schema = dict[str, Any]
Message = dict[str, Any]
NUMBER, INTEGER, TEXT, TRUE = ({"type": t} for t in ("number", "integer", "string", "boolean"))
TIME: Schema = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {**INTEGER, "minimum": 0}, "nsec": {**INTEGER, "minimum": 0}},
}


def _object(title: str, **properties: Schema) -> Schema:
    return {"type": "object", "title": title, "properties": properties}


def _ours(title: str, description: str, properties: dict[str, Schema]) -> tuple[str, Schema]:
    stamped = {"time_us": {**INTEGER, "description": "as samples were stamped, us"}, **properties}
    whole = {**_object(title, **stamped), "description": description}
    return f"risaf_link.{title}", whole


def _numbers(names: Iterable[str], description: str) -> dict[str, Schema]:
    return {name: {**NUMBER, "description": description} for name in names}


def _each(schema: Schema, description: str) -> Schema:
    return {"type": "array", "items": schema, "description": description}


_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=TEXT,
    child_frame_id=TEXT,
    translation=_object("foxglove.Vector3", **dict.fromkeys(AXES, NUMBER)),
    rotation=_object("foxglove.Quaternion", **dict.fromkeys((*AXES, "w"), NUMBER)),
)
SCHEMAS: dict[str, tuple[str, Schema]] = {
    "/attitude": _ours(
        "Attitude",
        "Body (forward, right, down) to north-east-down: Hamilton quaternion, angles in degrees.",
        {
            **_numbers(QUATERNION, "unit quaternion, body to NED"),
            **_numbers(ATTITUDE[4:7], "deg"),
            **_numbers(ATTITUDE[7:], "one standard deviation, deg"),
        },
    ),
    "/fused_rate": _ours(
        "FusedRate",
        "The array as one gyro, body axes, before the filter's bias is taken off.",
        {
            **_numbers(FUSED[:3], "rad/s"),
            **_numbers(FUSED[3:], "of one sensor behind it, (rad/s)^2"),
            **{name: {**INTEGER, "description": "sensors behind it"} for name in ACTIVE},
        },
    ),
    "/bias": _ours(
        "Bias",
        "Bias of the fused rate as the filter holds it, body axes.",
        {
            **_numbers((f"bias_{axis}" for axis in AXES), "rad/s"),
            **_numbers((f"bias_std_{axis}" for axis in AXES), "one standard deviation, rad/s"),
        },
    ),
    "/heading": _ours(
        "Heading",
        "What is done with GPS heading.",
        {
            "yaw_deg": {**NUMBER, "description": "estimated, from true north, 0 to 360 deg"},
            "yaw_std_deg": {**NUMBER, "description": "one standard deviation, deg"},
            "speed": {**NUMBER, "description": "of the last fix, m/s"},
            "time_since_fused": {**NUMBER, "description": "s"},
            "fused_count": INTEGER,
            "rejected_count": INTEGER,
            "heading_state": {**TEXT, "description": "as in GPS_HEADING_STATUS"},
            "heading_state_number": INTEGER,
        },
    ),
    "/innovation": _ours(
        "Innovation",
        "One GPS heading, and what came of it.",
        {
            "heading_deg": {**NUMBER, "description": "measured, from true north, deg"},
            "innovation_deg": {**NUMBER, "description": "measured minus predicted, deg"},
            "std_deg": {**NUMBER, "description": "standard deviation of the innovation, deg"},
            "gate": {**NUMBER, "description": "standard deviations"},
            "test_ratio": {**NUMBER, "description": "size over gate"},
            "fused": TRUE,
            "reset": {**TRUE, "description": "yaw was set by it"},
            "source": TEXT,
        },
    ),
    "/heading_error": _ours(
        "HeadingError",
        "Estimated heading minus a reference.",
        {
            "reference": {**TEXT, "description": "truth, or gps that was withheld"},
            "error_deg": {**NUMBER, "description": "deg"},
            "std_deg": {**NUMBER, "description": "as stated, deg"},
        },
    ),
    "/truth": _ours(
        "Truth",
        "The true attitude, as a simulator states it; time_us is 0 where it states no time.",
        {**_numbers(QUATERNION, "unit quaternion, body to NED"), **_numbers(IN_DEGREES, "deg")},
    ),
    "/array_status": _ours(
        "ArrayStatus",
        "The account of the array.",
        dict.fromkeys(
            (
                *("epochs", "epochs_incomplete", "samples_lost", "sensors"),
                *("healthy", "suspect", "dead"),
            ),
            INTEGER,
        ),
    ),
    "/sensor_health": _ours(
        "SensorHealth",
        "How every sensor stands.",
        {
            "state": _each(INTEGER, "0 healthy, 1 suspect, 2 dead"),
            "reason": _each(
                INTEGER, "0 none, 1 settling, 2 wandering, 3 outlying, 4 frozen, 5 silent"
            ),
            "rejected": _each(NUMBER, "share of the readings, the worst axis"),
            **{f"relative_bias_{axis}": _each(NUMBER, "rad/s") for axis in AXES},
        },
    ),
    "/events": (
        "foxglove.Log",
        _object(
            "foxglove.Log",
            timestamp=TIME,
            level=INTEGER,
            message=TEXT,
            name=TEXT,
            file=TEXT,
            line=INTEGER,
        ),
    ),
    "/tf": (
        "foxglove.FrameTransforms",
        _object("foxglove.FrameTransforms", transforms=_each(_TRANSFORM, "enu, ned, body")),
    ),
}
"""Topic: name and JSON schema of its messages."""
