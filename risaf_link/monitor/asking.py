"""What the page says on the link: as little as it can.

It asks each risaf_link component for the messages that it shows, with SET_MESSAGE_INTERVAL, and
everybody for the time, with TIMESYNC: the answers tell the round trip, and a port that answers
whoever spoke learns that we are there. There is no HEARTBEAT: autopilots would take it for their
ground station's, and not notice when the real one has gone.
"""

import math
from collections.abc import Iterable
from typing import Any

from risaf_link.mavlink.commands import Command
from risaf_link.mavlink.dialect import IDS, pack
from risaf_link.mavlink.frame import encode
from risaf_link.mavlink.identity import NO_AUTOPILOT
from risaf_link.mavlink.signing import LinkSigning
from risaf_link.mavlink.telemetry import ONBOARD_CONTROLLER, Rates
from risaf_link.mavlink.timesync import request
from risaf_link.monitor.vehicles import COMPONENT, Vehicles, Who

SYSTEM = 254
"""Ours: not 255, which is the vehicle's own ground station."""

TIMESYNC_US = 1_000_000  # from one request to the next
AGAIN_US = 30_000_000  # from one asking to the next: the component may have been started anew
GONE_US = 5_000_000  # without a frame after which nobody is asked
PAUSE_US = 50_000  # from one command to the next: radios are slow

WANTED: Rates = {
    "GPS_HEADING_STATUS": 5.0,
    "ATTITUDE_QUATERNION": 10.0,
    "ARRAY_STATUS": 5.0,
    "ARRAY_SENSOR_HEALTH": 5.0,
    "ARRAY_SENSOR_REASON": 2.0,
    "ATTITUDE_QUATERNION_COV": 2.0,
    "NAMED_VALUE_FLOAT": 22.0,  # one after another: each of the eleven twice a second
}
"""Hz; the first is sent by nobody else, and tells who is a risaf_link component."""


class Asking:
    """Asks, as time goes by.

    Parameters
    ----------
    signing : LinkSigning or None
        How the link is signed.
    """

    def __init__(self, signing: LinkSigning | None = None) -> None:
        self._signing = signing
        self._asked: dict[tuple[Who, str], int] = {}  # when
        self._next_us = self._next_timesync_us = -math.inf
        self._sequence = 0

    def advance(self, vehicles: Vehicles, now_us: int) -> list[bytes]:
        """Frames that are to be sent now, to everybody on the link."""
        frames = []
        if now_us >= self._next_timesync_us:
            self._next_timesync_us = now_us + TIMESYNC_US
            frames.append(self._frame("TIMESYNC", **request(now_us, COMPONENT)))
        if now_us >= self._next_us:
            for who in self._candidates(vehicles, now_us):
                name = self._due(who, who in vehicles.estimators, now_us)
                if name:
                    self._next_us = now_us + PAUSE_US
                    self._asked[who, name] = now_us
                    return [*frames, self._frame("COMMAND_LONG", **_interval(who, name))]
        return frames

    def _candidates(self, vehicles: Vehicles, now_us: int) -> Iterable[Who]:
        """Who is, or may be, a risaf_link component, and is there."""
        there = {
            way[1:]
            for way, account in vehicles.traffic.accounts.items()
            if now_us - account.sender.heard_us < GONE_US
        }
        self._asked = {key: when for key, when in self._asked.items() if key[0] in there}
        for who in sorted(there):
            pulse = vehicles.pulses.get(who)
            if who in vehicles.estimators or (
                pulse and (pulse.type, pulse.autopilot) == (ONBOARD_CONTROLLER, NO_AUTOPILOT)
            ):
                yield who

    def _due(self, who: Who, is_known: bool, now_us: int) -> str | None:
        wanted = list(WANTED) if is_known else list(WANTED)[:1]
        due = (n for n in wanted if now_us - self._asked.get((who, n), -AGAIN_US) >= AGAIN_US)
        return next(due, None)

    def _frame(self, name: str, **fields: Any) -> bytes:
        sign = self._signing.sign if self._signing else None
        frame = encode(*pack(name, **fields), self._sequence, SYSTEM, COMPONENT, sign)
        self._sequence = (self._sequence + 1) % 256
        return frame


def _interval(who: Who, name: str) -> dict[str, Any]:
    """Fields of the COMMAND_LONG that asks for a message."""
    interval_us = float(round(1e6 / WANTED[name]))  # type: ignore[index]
    params = (float(IDS[name]), interval_us, *[0.0] * 5)
    return {
        "target_system": who[0],
        "target_component": who[1],
        "command": Command.SET_MESSAGE_INTERVAL,
        "confirmation": 0,
        **{f"param{i}": value for i, value in enumerate(params, 1)},
    }
