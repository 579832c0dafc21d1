"""Datagrams that only begin an epoch wait for the one that makes it whole.

An array sends an epoch in several datagrams, one right after the other, and all but the last one
change nothing that could be told. To take them together costs a third of what each of them costs
by itself.

One is held only while nothing else waits, and if it is a single frame of readings, but not of those
sensors that came last in the epoch before. So an epoch is never late: if its frames come in another
order, the one that came last before is taken as it comes, and with it the epoch has begun.
"""

from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.search import CHECKSUM, HEADERS, MARK_V2

MOST_HELD = 64  # datagrams
READINGS = {IDS[name].to_bytes(3, "little") for name in ("GYRO_ARRAY", "ACCEL_ARRAY")}
MESSAGE_ID = slice(7, 10)
FIRST_SENSOR = slice(20, 22)


class Held:
    """What waits of one peer's datagrams."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._present = b""  # which readings the present datagram carries; empty: it is another
        self._last = b""  # which came last in an epoch; empty: nothing is held

    def __bool__(self) -> bool:
        return bool(self._parts)

    def holds(self, data: bytes) -> bool:
        """Keep a datagram, if it can wait."""
        part = self._present = _part(data)
        if not (part and self._last) or part == self._last or len(self._parts) >= MOST_HELD:
            return False
        self._parts.append(data)
        return True

    @property
    def is_whole(self) -> bool:
        """Whether the present datagram, which is not held, is the one that came last before."""
        return bool(self._last) and self._present == self._last

    @property
    def parts(self) -> list[bytes]:
        """What waits."""
        return self._parts

    def take(self, data: bytes = b"") -> bytes:
        """Give all that waits, and what came after it."""
        if not self._parts:
            return data
        parts, self._parts = self._parts, []
        return b"".join((*parts, data))

    def note_end(self, steady: bool) -> None:
        """Take note that the present datagram was taken, and whether nothing waits since."""
        self._last = (self._present or self._last) if steady else b""


def _part(data: bytes) -> bytes:
    """Which readings a datagram carries; empty: it is anything else than a frame of readings."""
    whole = len(data) > FIRST_SENSOR.stop and data[0] == MARK_V2
    if (
        not whole
        or len(data) != HEADERS[2] + data[1] + CHECKSUM
        or data[MESSAGE_ID] not in READINGS
    ):
        return b""
    return data[MESSAGE_ID] + data[FIRST_SENSOR]
