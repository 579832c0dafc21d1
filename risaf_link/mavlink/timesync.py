"""TIMESYNC: what another's clock shows, as a request and its answer tell it.

A request carries the asker's time, ts1, and an answer the same with the answerer's, tc1, in
nanoseconds. Its clock showed tc1 somewhere between ts1 and the arrival: half the round trip is how
far the middle may be off.

The time in our requests is the one in which arrivals are noted, in whole microseconds, and the
nanoseconds tell that it is ours: our component id. So an answer says all that there is to know, to
a recording as well, and those to other askers are left alone.

https://mavlink.io/en/services/timesync.html
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.mavlink.commands import concerns
from risaf_link.mavlink.dialect import reader
from risaf_link.mavlink.frame import Frame

LONGEST_TRIP_US = 10_000  # of an answer that is believed
JUMP_US = 10_000  # what an answer cannot be off by
MOST_SAMPLES = 64  # a minute
FRESH_US = 60_000_000  # after which a clock that does not answer is not known any more
SILENT_US = 3_000_000  # three answers
SKEW_SPAN_US = 10_000_000  # from which a skew can be told: a millisecond in it is 100 ppm
LARGEST_SKEW = 1e-3  # of clocks that are in order

Times = NDArray[np.int64]


class Timesync(Struct, frozen=True):
    """A TIMESYNC message."""

    tc1: int  # ns; 0: it is a request
    ts1: int  # ns
    to: tuple[int, int]  # system and component; 0: all


class Sample(Struct, frozen=True):
    """What one answer says."""

    time_us: int  # our time, half way
    lead_us: int  # how far the other's clock is ahead of it
    trip_us: int


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
    return {
        "tc1": max(clock_us(), 1) * 1000,
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
    middle_us = sent_us + trip_us // 2
    return Sample(middle_us, told.tc1 // 1000 - middle_us, trip_us)


class Synchronised:
    """Another's clock, as its answers tell it: how far it is ahead, and how fast that changes.

    A line through the answers of the last minute that were fastest.
    """

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=MOST_SAMPLES)
        self._at_us = 0
        self._lead_us = 0.0
        self.skew = 0.0

    def is_known(self, now_us: int) -> bool:
        """Whether it has answered of late."""
        return bool(self._samples) and abs(now_us - self._samples[-1].time_us) < FRESH_US

    def note(self, sample: Sample) -> bool:
        """Take an answer; whether one of the clocks has jumped, and all that was known is gone."""
        is_known = self.is_known(sample.time_us)
        expected_us = self.lead(sample.time_us)
        has_jumped = is_known and abs(sample.lead_us - expected_us) > JUMP_US
        if has_jumped or not is_known:
            self._samples.clear()
        self._samples.append(sample)
        self._fit()
        return has_jumped

    def is_contradicted(self, lead_us: int, now_us: int, by_us: int) -> bool:
        """Whether another lead differs by so much, and no answer tells which is right."""
        if not self._samples or abs(now_us - self._samples[-1].time_us) < SILENT_US:
            return False
        return abs(self.lead(now_us) - lead_us) > by_us

    def is_before(self, sample: Sample) -> bool:
        """Whether the other's clock has gone back since its last answer: it was started anew."""
        last = self._samples[-1] if self._samples else None
        return last is not None and sample.time_us + sample.lead_us < last.time_us + last.lead_us

    def lead(self, now_us: int) -> int:
        """How far it is ahead at a time of ours."""
        return round(self._lead_us + self.skew * (now_us - self._at_us))

    def leads(self, now_us: Times) -> Times:
        """How far it is ahead at times of ours, (k,) us, as `lead` says it."""
        leads_us: Times = np.rint(self._lead_us + self.skew * (now_us - self._at_us)).astype(int)
        return leads_us

    def _fit(self) -> None:
        samples = np.array([[s.time_us, s.lead_us, s.trip_us] for s in self._samples], np.int64)
        fast = samples[samples[:, 2] <= 2 * samples[:, 2].min() + 100]
        self._at_us, base_us = int(fast[-1, 0]), int(fast[-1, 1])
        times, leads = (fast[:, 0] - self._at_us).astype(float), fast[:, 1] - base_us
        mean_time, mean_lead = times.mean(), leads.mean()
        self.skew = 0.0
        if times[-1] - times[0] >= SKEW_SPAN_US:
            off = times - mean_time
            skew = float(off @ (leads - mean_lead) / (off @ off))
            self.skew = min(max(skew, -LARGEST_SKEW), LARGEST_SKEW)
        self._lead_us = float(base_us + mean_lead - self.skew * mean_time)


_TIMESYNC = reader("TIMESYNC", "tc1", "ts1", "target_system", "target_component")
