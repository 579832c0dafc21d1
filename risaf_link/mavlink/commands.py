"""Commands, COMMAND_LONG and COMMAND_INT: what is asked, by whom, and what is answered."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame

Peer = tuple[str, str]
"""A link's name, and who on it: "" where there is one."""


class Command(IntEnum):
    """MAV_CMD, as far as it is understood here."""

    PREFLIGHT_CALIBRATION = 241
    PREFLIGHT_STORAGE = 245
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


@dataclass(frozen=True, slots=True)
class Order:
    """One command."""

    command: int
    parameters: tuple[float, ...]  # 1 to 7
    to: tuple[int, int]  # system and component; 0: all
    asker: tuple[int, int]  # who sent it
    peer: Peer  # by which way it came

    def ack(self, result: Result, progress: int = 255) -> dict[str, Any]:
        """Fields of the COMMAND_ACK; the progress in percent, 255: not known."""
        return {
            "command": self.command,
            "result": result,
            "progress": progress,
            "result_param2": 0,
            "target_system": self.asker[0],
            "target_component": self.asker[1],
        }

    @property
    def integer(self) -> int | None:
        """The first parameter, a whole number; None: it is not one."""
        return whole(self.parameters[0])

    @property
    def told(self) -> tuple[float, ...]:
        """The parameters, 0 for those that were left out: NaN."""
        return tuple(0.0 if math.isnan(value) else value for value in self.parameters)


def concerns(to: Sequence[int], own: tuple[int, int]) -> bool:
    """Whether what is addressed to a system and a component is for us, alone or among all."""
    return to[0] in {0, own[0]} and to[1] in {0, own[1]}


def whole(value: float) -> int | None:
    """A value that is a whole number; None: it is not one."""
    return int(value) if abs(value) < 2**31 and value == int(value) else None


def order_in(frame: Frame, peer: Peer) -> Order | None:
    """The command in a frame; None: there is none."""
    read = _READERS.get(frame.message_id)
    if read is None:
        return None
    system, component, command, *parameters = read(frame.payload)
    asker = (frame.system, frame.component)
    return Order(command, tuple(parameters), (system, component), asker, peer)


_HEAD = ("target_system", "target_component", "command", "param1", "param2", "param3", "param4")
_READERS = {
    IDS["COMMAND_LONG"]: reader("COMMAND_LONG", *_HEAD, "param5", "param6", "param7"),
    IDS["COMMAND_INT"]: reader("COMMAND_INT", *_HEAD, "x", "y", "z"),
}
