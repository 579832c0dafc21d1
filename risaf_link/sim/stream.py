"""A scenario as the MAVLink frames that its vehicle would send."""

from collections.abc import Callable, Iterable, Iterator
from heapq import merge
from itertools import count

from risaf_link.mavlink.frame import encode
from risaf_link.sim import array, autopilot
from risaf_link.sim.message import ARRAY, AUTOPILOT, Message, by_time
from risaf_link.sim.scenario import Scenario

SYSTEM = 1
Sources = Iterable[Callable[[Scenario], Iterator[Message]]]
EPOCH_START_US = 1_767_225_600_000_000  # 2026-01-01: when every scenario's vehicle booted


SOURCES = array.status, array.epochs, autopilot.gps, autopilot.truth


def messages(scenario: Scenario, sources: Sources = SOURCES) -> Iterator[Message]:
    """Run a scenario: what its array and its autopilot send, not framed yet."""
    yield from merge(*(source(scenario) for source in sources), key=by_time)


def frames(scenario: Scenario, sources: Sources = SOURCES) -> Iterator[tuple[int, bytes]]:
    """Run a scenario.

    Yields
    ------
    time_us : int
        When the frame is sent, on the vehicle's clock; it never goes back.
    raw : bytes
        One frame.
    """
    sequences = {AUTOPILOT: count(), ARRAY: count()}
    for time_us, component, message_id, payload in messages(scenario, sources):
        sequence = next(sequences[component]) & 0xFF
        yield time_us, encode(message_id, payload, sequence, SYSTEM, component)


def record_time_us(time_us: int) -> int:
    """Turn a time of the vehicle's clock into that of a tlog's record.

    Returns
    -------
    int
        Microseconds since 1970; the two low bits are cleared.
    """
    return EPOCH_START_US + time_us & ~3
