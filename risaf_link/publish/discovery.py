"""Home Assistant: which of our topics are sensors, by MQTT discovery of devices.

Home Assistant's documentation, "MQTT", section "MQTT discovery", device discovery payload
(https://www.home-assistant.io/integrations/mqtt/); since its version 2024.11.
"""

from typing import Any

import msgspec

from risaf_link import __version__
from risaf_link.publish.access import MqttParameters

DEGREES = "(value_json.{} * 57.29577951)"
HEADING_STATES = ("NO_FIX", "TOO_SLOW", "ALIGNING", "FUSING", "REJECTING", "DEAD_RECKONING")


def discovery(parameters: MqttParameters) -> tuple[str, bytes]:
    """Topic and payload that make the vehicle a device of Home Assistant's.

    Parameters
    ----------
    parameters : MqttParameters
        With a prefix for `discovery`. Of what is not published there is no sensor.
    """
    unique = f"risaf_link_{parameters.root}".replace("/", "_").replace(".", "_")
    sensors = {
        f"{unique}_{key}": {
            "platform": "sensor",
            "unique_id": f"{unique}_{key}",
            "state_topic": f"{parameters.root}/{topic}",
            **told,
        }
        for key, topic, told in _SENSORS
        if getattr(parameters.rates, topic) > 0
    }
    payload = {
        "device": {
            "identifiers": [unique],
            "name": parameters.name,
            "manufacturer": "risaf_link",
            "model": "gyro array estimator",
            "sw_version": __version__,
        },
        "origin": {"name": "risaf_link", "sw_version": __version__},
        "availability_topic": f"{parameters.root}/availability",
        "availability_template": "{{ value_json.state }}",
        "components": sensors,
    }
    return f"{parameters.discovery}/device/{unique}/config", msgspec.json.encode(payload)


def _angle(name: str, field: str, digits: int = 1) -> dict[str, Any]:
    """An angle in degrees; unknown while it is null."""
    return {
        "name": name,
        "unit_of_measurement": "°",
        "state_class": "measurement",
        "value_template": _unless_null(field, f"{DEGREES.format(field)} | round({digits})"),
    }


def _plain(name: str, field: str) -> dict[str, Any]:
    return {
        "name": name,
        "state_class": "measurement",
        "value_template": _unless_null(field, f"value_json.{field}"),
    }


def _unless_null(field: str, expression: str) -> str:
    return f"{{{{ {expression} if value_json.{field} is not none else none }}}}"


_HEADING = f"({DEGREES.format('yaw_rad')} % 360) | round(1)"
_SENSORS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    (
        "heading",
        "heading",
        {**_angle("Heading", "yaw_rad"), "value_template": _unless_null("yaw_rad", _HEADING)},
    ),
    ("heading_std", "heading", _angle("Heading deviation", "yaw_std_rad", 2)),
    (
        "heading_state",
        "heading",
        {
            "name": "GPS heading",
            "device_class": "enum",
            "options": list(HEADING_STATES),
            "value_template": "{{ value_json.state }}",
        },
    ),
    ("test_ratio", "heading", _plain("Heading test ratio", "test_ratio")),
    ("roll", "attitude", _angle("Roll", "roll_rad")),
    ("pitch", "attitude", _angle("Pitch", "pitch_rad")),
    ("healthy", "array", _plain("Sensors healthy", "healthy")),
    ("suspect", "array", _plain("Sensors suspect", "suspect")),
    ("dead", "array", _plain("Sensors dead", "dead")),
    ("samples_lost", "array", _plain("Samples lost", "samples_lost")),
)
"""Key, topic, and what Home Assistant is told of each."""
