"""What is known of all vehicles on a link, from the frames that come: a model without any I/O."""

from collections import deque

import numpy as np
from msgspec import Struct

from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.timesync import timesync_in
from risaf_link.mavlink.tlog import Stamps
from risaf_link.monitor.estimator import OWN, TOLD, Estimator
from risaf_link.monitor.traffic import Traffic

MOST_ESTIMATORS = 16
MOST_EVENTS = 200
MOST_TEXTS = 32  # that are being put together
LONGEST_TRIP_US = 10_000_000  # of a round trip that is told
COMPONENT = 25  # ours, MAV_COMP_ID_USER1; that of TIMESYNC requests whose answers are read

HEARTBEAT, STATUSTEXT, TIMESYNC = IDS["HEARTBEAT"], IDS["STATUSTEXT"], IDS["TIMESYNC"]
READ = np.array(sorted(TOLD | {HEARTBEAT, STATUSTEXT, TIMESYNC}))

Who = tuple[int, int]
"""System and component."""


class Pulse(Struct, frozen=True):
    """HEARTBEAT: MAV_TYPE, MAV_AUTOPILOT, MAV_STATE."""

    type: int
    autopilot: int
    status: int


class Event(Struct, frozen=True):
    """A line of STATUSTEXT."""

    time_us: int
    system: int
    component: int
    severity: int
    text: str


class Vehicles:
    """All who are heard.

    Attributes
    ----------
    estimators : dict
        Of every component that sends our messages; who was heard last is last.
    pulses : dict
        The last HEARTBEAT of everybody.
    events : deque of Event
        The last ones.
    event_count : int
        How many there ever were.
    traffic : Traffic
    """

    def __init__(self) -> None:
        self.estimators: dict[Who, Estimator] = {}
        self.pulses: dict[Who, Pulse] = {}
        self.events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self.event_count = 0
        self.traffic = Traffic()
        self._texts: dict[tuple[int, int, int], list[bytes]] = {}

    def take(self, table: FrameTable, times_us: Stamps, peer: str = "") -> None:
        """Take frames that one peer handed on.

        Parameters
        ----------
        table : FrameTable
        times_us : ndarray of uint64
            When each of them came, microseconds since 1970; they never go back.
        peer : str
        """
        if not len(table):
            return
        self.traffic.note(table, times_us, peer)
        for row in np.flatnonzero(np.isin(table.cuts["message_id"], READ)).tolist():
            self._read(table.frame(row), int(times_us[row]), peer)

    def _read(self, frame: Frame, time_us: int, peer: str) -> None:
        who = frame.system, frame.component
        if frame.message_id == HEARTBEAT:
            self._note_pulse(who, Pulse(*_HEARTBEAT(frame.payload)))
        elif frame.message_id == STATUSTEXT:
            self._hear(frame, time_us)
        elif frame.message_id == TIMESYNC:
            self._time(frame, time_us, peer)
        elif frame.message_id in OWN or who in self.estimators:
            estimator = self.estimators.get(who) or Estimator()
            remember(self.estimators, who, estimator, MOST_ESTIMATORS)
            estimator.take(frame, time_us)

    def _note_pulse(self, who: Who, pulse: Pulse) -> None:
        self.pulses[who] = pulse
        if len(self.pulses) > 2 * len(self.traffic.accounts):
            known = {way[1:] for way in self.traffic.accounts}
            self.pulses = {w: pulse for w, pulse in self.pulses.items() if w in known}

    def _time(self, frame: Frame, time_us: int, peer: str) -> None:
        told = timesync_in(frame)
        sent_us, tag = divmod(told.ts1, 1000)
        if told.tc1 > 0 and tag == COMPONENT and 0 <= time_us - sent_us <= LONGEST_TRIP_US:
            account = self.traffic.account((peer, frame.system, frame.component))
            account.note_trip(time_us - sent_us)

    def _hear(self, frame: Frame, time_us: int) -> None:
        """Take a STATUSTEXT; what comes in parts is told when its last one has come."""
        severity, text, number, part = _STATUSTEXT(frame.payload)
        text = text.partition(b"\0")[0]
        if number:
            key = frame.system, frame.component, number
            parts = self._texts.pop(key, []) if part else []
            if part > len(parts):  # one was lost
                return
            parts[part:] = [text]  # it may come twice
            if len(text) == TEXT_BYTES:
                remember(self._texts, key, parts, MOST_TEXTS)
                return
            text = b"".join(parts)
        words = text.decode("utf-8", "replace")
        self.events.append(Event(time_us, frame.system, frame.component, severity, words))
        self.event_count += 1


TEXT_BYTES = 50  # of a STATUSTEXT that is full: another part follows

_HEARTBEAT = reader("HEARTBEAT", "type", "autopilot", "system_status")
_STATUSTEXT = reader("STATUSTEXT", "severity", "text", "id", "chunk_seq")
