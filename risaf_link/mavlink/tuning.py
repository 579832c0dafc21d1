"""The parameter protocol: PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET, answered.

https://mavlink.io/en/services/parameter.html
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from risaf_link.mavlink.commands import Peer, concerns
from risaf_link.mavlink.dialect import IDS, reader, text_of
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.parameters import Parameters

REAL32 = 9  # MAV_PARAM_TYPE
MOST_A_SECOND = 200.0  # values of a list; a link's own limit may be lower
MOST_LISTS = 64  # that are sent at a time
UNKNOWN_INDEX = -1

_LIST = reader("PARAM_REQUEST_LIST", "target_system", "target_component")
_READ = reader("PARAM_REQUEST_READ", "target_system", "target_component", "param_id", "param_index")
_SET = reader(
    *("PARAM_SET", "target_system", "target_component", "param_id", "param_value", "param_type"),
)


class ParamError(IntEnum):
    """MAV_PARAM_ERROR, as far as it is used here."""

    DOES_NOT_EXIST = 1
    VALUE_OUT_OF_RANGE = 2
    TYPE_MISMATCH = 7


@dataclass(frozen=True, slots=True)
class Answer:
    """A message, and whether it is for all or for the one who asked."""

    name: str
    fields: dict[str, Any]
    to_all: bool = False


class Tuning:
    """Answers what is asked of the parameters.

    Parameters
    ----------
    parameters : Parameters
    """

    def __init__(self, parameters: Parameters[Any]) -> None:
        self._parameters = parameters
        self._lists: dict[Peer, tuple[int, float]] = {}  # next index, what may be sent already

    def take(self, frame: Frame, own: tuple[int, int], peer: Peer) -> list[Answer]:
        """Take a frame; the answers, if it is one of this protocol and addressed to us.

        What is addressed to all and names no parameter of ours is another's to answer.
        """
        asker = (frame.system, frame.component)
        if frame.message_id == IDS["PARAM_REQUEST_LIST"]:
            if concerns(_LIST(frame.payload), own):
                self.list_to(peer)
            return []
        if frame.message_id == IDS["PARAM_REQUEST_READ"]:
            *to, name, index = _READ(frame.payload)
            return list(self._read(text_of(name), index, to, own, asker))
        if frame.message_id == IDS["PARAM_SET"]:
            *to, name, value, kind = _SET(frame.payload)
            return list(self._set(text_of(name), value, kind, to, own, asker))
        return []

    def list_to(self, peer: Peer) -> None:
        """Begin to send all values to a peer, from the first one."""
        if peer in self._lists or len(self._lists) < MOST_LISTS:
            self._lists[peer] = 0, 0.0

    def due(self, seconds: float, pace: dict[str, float]) -> list[tuple[Peer, Answer]]:
        """Values of lists that may be sent now.

        Parameters
        ----------
        seconds : float
            Since this was last asked.
        pace : dict
            Link's name to how many values a second it can take; `MOST_A_SECOND` else.
        """
        found = []
        for peer, (first, saved) in list(self._lists.items()):
            rate = min(pace.get(peer[0], MOST_A_SECOND), MOST_A_SECOND)
            credit = min(saved + rate * seconds, rate)
            end = min(first + int(credit), len(self._parameters.all))
            found += [(peer, self.value(i)) for i in range(first, end)]
            self._lists[peer] = end, credit - int(credit)
            if end == len(self._parameters.all):
                del self._lists[peer]
        return found

    def value(self, index: int, to_all: bool = False) -> Answer:
        """PARAM_VALUE with the value in force."""
        fields = {
            "param_id": self._parameters.all[index].name,
            "param_value": self._parameters.value(index),
            "param_type": REAL32,
            "param_count": len(self._parameters.all),
            "param_index": index,
        }
        return Answer("PARAM_VALUE", fields, to_all)

    def _read(
        self, name: str, index: int, to: list[int], own: tuple[int, int], asker: tuple[int, int]
    ) -> Iterator[Answer]:
        if not concerns(to, own):
            return
        by_name = self._parameters.index(name)
        wanted = by_name if index == UNKNOWN_INDEX else index
        if wanted is not None and 0 <= wanted < len(self._parameters.all):
            yield self.value(wanted)
        elif to[1] == own[1]:
            yield _error(ParamError.DOES_NOT_EXIST, name, index, asker)

    def _set(
        self,
        name: str,
        value: float,
        kind: int,
        to: list[int],
        own: tuple[int, int],
        asker: tuple[int, int],
    ) -> Iterator[Answer]:
        if not concerns(to, own):
            return
        index = self._parameters.index(name)
        if index is None:
            if to[1] == own[1]:
                yield _error(ParamError.DOES_NOT_EXIST, name, UNKNOWN_INDEX, asker)
            return
        if kind != REAL32:
            yield _error(ParamError.TYPE_MISMATCH, name, index, asker)
        elif not self._parameters.set(name, value):
            yield _error(ParamError.VALUE_OUT_OF_RANGE, name, index, asker)
        yield self.value(index, to_all=True)


def _error(error: ParamError, name: str, index: int, asker: tuple[int, int]) -> Answer:
    fields = {
        "target_system": asker[0],
        "target_component": asker[1],
        "param_id": name.encode("ascii", "replace"),
        "param_index": index,
        "error": error,
    }
    return Answer("PARAM_ERROR", fields)
