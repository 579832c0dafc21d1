"""Every message definition known here: those that ship with pymavlink, and our own.

The definitions come from the dialect modules that mavgen generates. Only their tables are used
(names, field order, CRC_EXTRA, struct layout); framing is in `frame`.
"""

import struct
from collections.abc import Callable, Sequence
from functools import cache
from operator import itemgetter
from typing import Any

from pymavlink.dialects.v20 import all as public_dialect

from risaf_link.mavlink import risaf


class ComponentInformationBasic:
    """COMPONENT_INFORMATION_BASIC of MAVLink's common.xml, which pymavlink 2.4.50 does not have."""

    id = 396
    msgname = "COMPONENT_INFORMATION_BASIC"
    fieldnames = (
        *("time_boot_ms", "capabilities", "time_manufacture_s", "vendor_name", "model_name"),
        *("software_version", "hardware_version", "serial_number"),
    )
    ordered_fieldnames = ("capabilities", "time_boot_ms", *fieldnames[2:])
    lengths = (1,) * len(fieldnames)
    crc_extra = 50
    unpacker = struct.Struct("<QII32s32s24s24s32s")


class Timesync:
    """TIMESYNC with the extension by which an answer says whose request it answers."""

    id = 111
    msgname = "TIMESYNC"
    fieldnames = ordered_fieldnames = ("tc1", "ts1", "target_system", "target_component")
    lengths = (1,) * len(fieldnames)
    crc_extra = 34
    unpacker = struct.Struct("<qqBB")


MESSAGES: dict[int, Any] = {
    ComponentInformationBasic.id: ComponentInformationBasic,
    **public_dialect.mavlink_map,
    Timesync.id: Timesync,
    **risaf.mavlink_map,
}
"""Message class of the generated dialects, by message id."""

IDS: dict[str, int] = {message.msgname: message_id for message_id, message in MESSAGES.items()}
"""Message id, by name."""

CRC_EXTRA: dict[int, int] = {i: message.crc_extra for i, message in MESSAGES.items()}
"""Seed of a message's checksum, by message id."""


def name_of(message_id: int) -> str:
    """Name of a message, `UNKNOWN_<id>` where no definition is known."""
    message = MESSAGES.get(message_id)
    return message.msgname if message else f"UNKNOWN_{message_id}"


def reader(name: str, *fields: str) -> Callable[[bytes], tuple[Any, ...]]:
    """Make a function that reads some fields of a message from its payload.

    Parameters
    ----------
    name : str
        The message.
    *fields : str
        At least two of its fields. An array comes as a tuple, a string as bytes.

    Returns
    -------
    callable
        From a payload, as it came off the wire (trailing zeros cut, or extended by a newer
        dialect), to the values of `fields`, in that order.
    """
    message = MESSAGES[IDS[name]]
    unpacker: struct.Struct = message.unpacker
    size = unpacker.size
    pick = itemgetter(*(_position(message, field) for field in fields))

    def read(payload: bytes) -> tuple[Any, ...]:
        return pick(unpacker.unpack(payload[:size].ljust(size, b"\0")))  # type: ignore[no-any-return]

    return read


def writer(name: str, *fields: str) -> Callable[..., tuple[int, bytes]]:
    """Make a function that does what `pack` does from values of some fields, quicker.

    Parameters
    ----------
    name : str
        The message.
    *fields : str
        The first of its fields as they are laid out, none of them an array; all others are zero.

    Returns
    -------
    callable
        From the values of `fields`, in that order, to id and payload.
    """
    message_id, _, ordered, _, packer = _layout(name)
    if fields != tuple(ordered[: len(fields)]):
        raise ValueError(f"{name}: fields {fields}, expected the first of {ordered}")
    zeros = packer.unpack(bytes(packer.size))[len(fields) :]

    def write(*values: float) -> tuple[int, bytes]:
        return message_id, packer.pack(*values, *zeros)

    return write


def text_of(field: bytes) -> str:
    """Text of a field, which ends at the first NUL."""
    return field.partition(b"\0")[0].decode(errors="replace")


def pack(name: str, /, **fields: Any) -> tuple[int, bytes]:
    """Lay out a message's payload, whole: no trailing zeros cut.

    Parameters
    ----------
    name : str
        The message.
    **fields
        A value for every field; a sequence for an array, bytes or str for a string.

    Returns
    -------
    message_id : int
    payload : bytes

    Raises
    ------
    TypeError
        If a field is missing or not one of the message's.
    struct.error
        If a value does not fit its field.
    """
    message_id, expected, ordered, arrays, packer = _layout(name)
    if fields.keys() != expected:
        raise TypeError(f"{name}: fields {sorted(fields)}, expected {sorted(expected)}")
    values = [v.encode() if isinstance(v := fields[field], str) else v for field in ordered]
    for i in arrays:
        values[i : i + 1] = values[i]
    return message_id, packer.pack(*values)


@cache
def _layout(name: str) -> tuple[int, frozenset[str], Sequence[str], list[int], struct.Struct]:
    """Id and fields of a message; its fields as they are laid out; arrays, the last one first."""
    message = MESSAGES[IDS[name]]
    ordered = message.ordered_fieldnames
    arrays = [i for i, length in enumerate(message.lengths) if length > 1]
    return message.id, frozenset(ordered), ordered, arrays[::-1], message.unpacker


def _position(message: Any, field: str) -> int | slice:
    """Where a field stands in what the message's struct unpacks to."""
    index = message.ordered_fieldnames.index(field)
    start, length = sum(message.lengths[:index]), message.lengths[index]
    return start if length == 1 else slice(start, start + length)
