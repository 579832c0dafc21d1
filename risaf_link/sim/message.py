"""Messages of a simulation that wait to be framed."""

from collections.abc import Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from risaf_link.mavlink.dialect import pack

AUTOPILOT, ARRAY = 1, 158  # components: MAV_COMP_ID_AUTOPILOT1, MAV_COMP_ID_PERIPHERAL


class Message(NamedTuple):
    """One message; its component numbers it only when it is sent."""

    time_us: int  # of sending, on the vehicle's clock
    component: int
    message_id: int
    payload: bytes


by_time = attrgetter("time_us")


def table(
    component: int, name: str, columns: dict[str, NDArray[Any]], **same: Any
) -> Iterator[Message]:
    """Make k messages of one kind.

    Parameters
    ----------
    component : int
    name : str
        The message; it has a field `time_usec`, which is the time of sending.
    columns : dict of ndarray, shape (k, ...)
        Values of the fields that change, in MAVLink's units.
    **same
        Values of the fields that do not.
    """
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        fields = dict(zip(columns, row, strict=True))
        yield Message(fields["time_usec"], component, *pack(name, **fields, **same))


def heartbeat(kind: int, autopilot: int) -> tuple[int, bytes]:
    """Make the HEARTBEAT of a component that is well: number and payload of the message."""
    return pack(
        "HEARTBEAT",
        type=kind,
        autopilot=autopilot,
        base_mode=0,
        custom_mode=0,
        system_status=4,  # MAV_STATE_ACTIVE
        mavlink_version=3,
    )


def whole(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Round to whole numbers, as most fields want them."""
    return np.rint(values).astype(np.int64)
