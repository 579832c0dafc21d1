"""TIMESYNC: what another's clock shows, as a request and its answer tell it.

A request carries the asker's time, ts1, and an answer the same with the answerer's, tc1, in
nanoseconds. Its clock showed tc1 somewhere between ts1 and the arrival: half the round trip is how
far the middle may be off.

The time in our requests is the one in which arrivals are noted, in whole microseconds, and the
nanoseconds tell that it is ours: our component id. So an answer says all that there is to know, to
a recording as well, and those to other askers are left alone.

https://mavlink.io/en/services/timesync.html
"""

from collections.abc import Callable
from typing import Any

from msgspec import Struct

from risaf_link.mavlink.commands import concerns
from risaf_link.mavlink.dialect import reader
from risaf_link.mavlink.frame import Frame

LONGEST_TRIP_US = 10_000  # of an answer that is believed
LATEST_US = (2**63 - 1) // 1000  # that fits into nanoseconds; an array's clock may show more


class Timesync(Struct, frozen=True):
    """A TIMESYNC message."""

    tc1: int  # ns; 0: it is a request
    ts1: int  # ns
    to: tuple[int, int]  # system and component; 0: all


class Sample(Struct, frozen=True):
    """What one answer says: the other's clock showed a time after it was asked, in our time."""

    time_us: int
    sent_us: int


def timesync_in(frame: Frame) -> Timesync:
    """Read a TIMESYNC frame."""
    tc1, ts1, system, component = _TIMESYNC(frame.payload)
    return Timesync(tc1, ts1, (system, component))


def request(now_us: int, component: int) -> dict[str, Any]:
    """Fields of a request, made at a time in microseconds since 1970 by a component of ours."""
    return {"tc1": 0, "ts1": now_us * 1000 + component, "target_system": 0, "target_component": 0}


def answer_to(
    frame: Frame, own: tuple[int, int], clock_us: Callable[[], int]
) -> dict[str, Any] | None:
    """Fields of the answer to a frame, by a clock of ours; None: it is not for us to answer."""
    asked, asker = timesync_in(frame), (frame.system, frame.component)
    if asked.tc1 != 0 or not concerns(asked.to, own) or asker == own:
        return None
    now_us = max(clock_us(), 1)
    if now_us > LATEST_US:
        return None
    return {
        "tc1": now_us * 1000,
        "ts1": asked.ts1,
        "target_system": asker[0],
        "target_component": asker[1],
    }


def sample_in(frame: Frame, component: int, received_us: int) -> Sample | None:
    """What an answer to a component of ours says; None: it is none, or took too long."""
    told = timesync_in(frame)
    sent_us, tag = divmod(told.ts1, 1000)
    trip_us = received_us - sent_us
    if told.tc1 <= 0 or tag != component or not 0 <= trip_us <= LONGEST_TRIP_US:
        return None
    return Sample(told.tc1 // 1000, sent_us)


_TIMESYNC = reader("TIMESYNC", "tc1", "ts1", "target_system", "target_component")
