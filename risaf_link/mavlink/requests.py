"""Asking the autopilot for what the estimator lives on, and again when it no longer comes.

SET_MESSAGE_INTERVAL holds for the channel by which it comes, until the autopilot restarts or
another program sets other rates there, as MAVProxy does with its stream rates. So what counts is
what arrives: a message that comes too slowly is asked for, with growing pauses and not for ever.
What comes of three requests is taken for the most that the autopilot gives: ArduPilot sends at most
0.8 times its loop rate (newer ones deny more, and are asked for half), PX4 what its data rate
leaves.

Acknowledgements name the command and not the message: one request waits for its answer, or a
second, before the next is made.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta

from risaf_link.mavlink.commands import Command, Peer, Result
from risaf_link.mavlink.dialect import IDS, MESSAGES, reader, text_of
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.identity import autopilot_mode

Requested = Literal[
    "HIGHRES_IMU",
    "RAW_IMU",
    "SCALED_IMU",
    "SCALED_IMU2",
    "SCALED_IMU3",
    "GPS_RAW_INT",
    "GPS2_RAW",
    "GLOBAL_POSITION_INT",
    "SYSTEM_TIME",
    "TIMESYNC",
]
RequestedRates = dict[Requested, Annotated[float, Meta(gt=0, le=1000)]]
"""Hz; what is not named is not asked for."""

IMU_RATE, GPS_RATE, TIME_RATE = 100.0, 5.0, 1.0  # Hz: of the filter's design; of most receivers
IMUS: tuple[tuple[Requested, ...], ...] = (
    ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU"),  # the same sensor, the finest first
    ("SCALED_IMU2",),
    ("SCALED_IMU3",),
)

GYRO_ARRAY = IDS["GYRO_ARRAY"]
FRAME_BYTES = 12  # of a MAVLink 2 frame, around its payload
SHARE = 0.5  # of a link, that all that is asked for may take
WINDOW_US = 4_000_000  # in which a rate is measured: four of SYSTEM_TIME
ENOUGH = 0.7  # of a rate; less is too slow
ANSWER_US = 1_000_000  # that an acknowledgement may take
PAUSE_US, LONGEST_PAUSE_US = 4_000_000, 64_000_000  # after a request; doubled each time
MOST_REQUESTS = 8  # for a message, in a row
ENOUGH_REQUESTS = 3  # in a row, until what comes is taken for all that will
CALM_US = 60_000_000  # of enough, after which a request counts as a first one
GONE_US = 5_000_000  # without HEARTBEAT
SLOWEST = 1.0  # Hz that is asked for

_ACK = reader("COMMAND_ACK", "command", "result", "target_system", "target_component")
_DEBUG = reader("DEBUG_FLOAT_ARRAY", "name", "array_id")


@dataclass(slots=True)
class _Need:
    """One datum, and how well it is supplied."""

    names: tuple[Requested, ...]  # that carry it, the best first
    rate: float  # Hz, wanted
    best: float = 0.0  # Hz, of what came of requests
    is_most: bool = False  # more than the best does not come
    counts: Counter[Peer] = field(default_factory=Counter)  # of messages since, by way
    since_us: int = 0
    lacks: bool = False  # as last measured
    asked: bool = False  # since it was last measured
    requests: int = 0  # in a row
    next_us: int = 0  # when the next one may be made
    calm_us: int | None = None  # since when nothing lacks

    @property
    def message_id(self) -> int:
        """What is asked for."""
        return IDS[self.names[0]]

    @property
    def is_imu(self) -> bool:
        """Whether it is a part of the array."""
        return "IMU" in self.names[0]

    def is_due(self, now_us: int) -> bool:
        """Whether to ask for it."""
        return self.lacks and self.requests < MOST_REQUESTS and now_us >= self.next_us

    def begin(self, now_us: int) -> None:
        """Measure anew."""
        self.counts.clear()
        self.since_us, self.lacks = now_us, False

    def measure(self, now_us: int) -> None:
        """Judge a window that has passed."""
        count = max(self.counts.values(), default=0)  # the same comes by several ways
        rate = count / ((now_us - self.since_us) / 1e6)
        self.begin(now_us)
        if self.asked:
            self.best = max(self.best, rate)
            self.is_most = self.is_most or (self.requests >= ENOUGH_REQUESTS and self.best > 0)
            self.asked = False
        self.lacks = rate < ENOUGH * (min(self.rate, self.best) if self.is_most else self.rate)
        if self.lacks:
            self.calm_us = None
            if self.requests >= MOST_REQUESTS and not self.best:
                self.give_up()
        elif self.calm_us is None:
            self.calm_us = now_us
        elif now_us - self.calm_us >= CALM_US:
            self.requests = 0

    def ask(self, now_us: int) -> None:
        """Take note that it is being asked for."""
        self.next_us = now_us + min(PAUSE_US << self.requests, LONGEST_PAUSE_US)
        self.requests += 1
        self.begin(now_us)
        self.asked = True

    def refuse(self, result: int) -> None:
        """Take note that a request was not accepted."""
        if result == Result.DENIED and self.rate > GPS_RATE:  # it may have been too fast
            self.rate /= 2
            self.lacks, self.next_us = True, 0
        elif result != Result.TEMPORARILY_REJECTED:
            self.give_up()

    def give_up(self) -> None:
        """Try the next message that carries it; without one, wait until it comes by itself."""
        if len(self.names) > 1:
            self.names, self.requests, self.next_us = self.names[1:], 0, 0
            self.best, self.is_most, self.lacks = 0.0, False, True
        else:
            self.requests = MOST_REQUESTS


@dataclass(slots=True)
class _Autopilot:
    """The autopilot as it is heard from one peer."""

    sender: tuple[int, int]
    since_us: int
    heard_us: int
    needs: list[_Need] = field(default_factory=list)
    waiting: tuple[_Need, int] | None = None  # for an acknowledgement; since when


class Requests:
    """Asks the vehicle's autopilot for messages, on one link at a time.

    Of several links on which it is heard, the first in order is asked: a radio that carries the
    same vehicle to the ground is not burdened. What comes by that link counts, or by one before it,
    where nothing is asked for; what comes by one behind it may have come a long way round.

    Parameters
    ----------
    links : mapping
        Name of each link to what is asked for there, Hz; None: what is needed. In order.
    encodings : sequence of str
        Senders that are taken for the array. IMU messages are needed if `IMU` is among them and
        nothing better comes.
    gps : sequence of str
        GPS messages that are believed.
    capacity : mapping
        Name of each link to the bytes a second that it carries.
    """

    def __init__(
        self,
        links: Mapping[str, RequestedRates | None],
        encodings: Sequence[str] = ("IMU",),
        gps: Sequence[str] = ("GPS_RAW_INT",),
        capacity: Mapping[str, float] | None = None,
    ) -> None:
        self._links = {name: rates for name, rates in links.items() if rates != {}}
        self._order = {name: i for i, name in enumerate(links)}
        self._encodings = frozenset(encodings)
        self._gps = gps
        self._capacity = dict(capacity or {})
        self._autopilots: dict[Peer, _Autopilot] = {}
        self._at: Peer | None = None  # who is asked
        self._now_us = self._next_timesync_us = 0
        self._array_us: int | None = None  # when an array was last heard

    def note_traffic(self, table: FrameTable, peer: Peer) -> None:
        """Take note of all that a peer sent: what counts is what arrives."""
        if "GYRO_ARRAY" in self._encodings and GYRO_ARRAY in table.message_ids:
            self._array_us = self._now_us
        if self._at is None or self._order[peer[0]] > self._order[self._at[0]]:
            return
        sender, needs = self._autopilots[self._at].sender, self._autopilots[self._at].needs
        for message_id, *whose in table.origins:
            for need in needs:
                if need.message_id == message_id and tuple(whose) == sender:
                    need.counts[peer] += 1

    def hear(self, frame: Frame, peer: Peer, own: tuple[int, int]) -> None:
        """Take a frame that tells of an autopilot, or of an array that is not in our dialect.

        Parameters
        ----------
        frame : Frame
        peer : Peer
            Whom it came from.
        own : tuple of int
            Our system and component id; the autopilot is that of our system.
        """
        if frame.message_id == IDS["DEBUG_FLOAT_ARRAY"]:
            self._hear_array(frame)
        elif frame.system != own[0] or peer[0] not in self._links:
            return
        elif frame.message_id == IDS["HEARTBEAT"]:
            self._hear_heartbeat(frame, peer)
        elif peer == self._at and frame.message_id == IDS["COMMAND_ACK"]:
            autopilot = self._autopilots[peer]
            if autopilot.sender == (frame.system, frame.component):
                self._hear_answer(frame, autopilot, own)

    def advance(self, now_us: int) -> list[tuple[Peer, dict[str, Any]]]:
        """Let it be later, microseconds of a clock that does not jump; COMMAND_LONGs to be sent."""
        self._now_us = now_us
        for peer in [p for p, a in self._autopilots.items() if now_us - a.heard_us > GONE_US]:
            del self._autopilots[peer]
        self._choose()
        autopilot = self._autopilots.get(self._at) if self._at else None
        if autopilot is None or self._at is None:
            return []
        if autopilot.waiting and now_us - autopilot.waiting[1] >= ANSWER_US:
            autopilot.waiting = None
        self._measure(autopilot.needs)
        due = next((need for need in autopilot.needs if need.is_due(now_us)), None)
        if due is None or autopilot.waiting:
            return []
        return [(self._at, self._ask(due, autopilot))]

    def due_timesync(self) -> Peer | None:
        """Whom to ask for the time now: the one who is asked for the rest, once a second."""
        rates = self._links.get(self._at[0]) if self._at else {}
        rate = TIME_RATE if rates is None else rates.get("TIMESYNC", 0.0)
        if not rate or self._now_us < self._next_timesync_us:
            return None
        self._next_timesync_us = self._now_us + round(1e6 / rate)
        return self._at

    def _hear_array(self, frame: Frame) -> None:
        is_gyro = text_of(_DEBUG(frame.payload)[0]) == "gyro"
        if is_gyro and "DEBUG_FLOAT_ARRAY" in self._encodings:
            self._array_us = self._now_us

    def _hear_heartbeat(self, frame: Frame, peer: Peer) -> None:
        if autopilot_mode(frame) is None:
            return
        sender = frame.system, frame.component
        autopilot = self._autopilots.get(peer)
        if autopilot is None:
            autopilot = _Autopilot(sender, self._now_us, self._now_us)
            self._autopilots[peer] = autopilot
        if autopilot.sender == sender:
            autopilot.heard_us = self._now_us

    def _hear_answer(self, frame: Frame, autopilot: _Autopilot, own: tuple[int, int]) -> None:
        command, result, *to = _ACK(frame.payload)
        ours = tuple(to) in {own, (0, 0)}  # MAVLink 1 has no address
        if command != Command.SET_MESSAGE_INTERVAL or not ours or not autopilot.waiting:
            return
        need, _ = autopilot.waiting
        autopilot.waiting = None
        if result not in {Result.ACCEPTED, Result.IN_PROGRESS}:
            need.refuse(result)

    def _choose(self) -> None:
        """Ask on the first of the links on which the autopilot is heard, a window after it was."""
        heard = [p for p, a in self._autopilots.items() if self._now_us - a.since_us >= WINDOW_US]
        at = min(heard, key=lambda peer: self._order[peer[0]], default=None)
        stays = self._at in heard and at and self._order[self._at[0]] == self._order[at[0]]
        if not stays:
            self._at = at
            if at:
                self._autopilots[at].needs = self._needs(at[0])
                self._autopilots[at].waiting = None

    def _needs(self, link: str) -> list[_Need]:
        """What is needed on a link, and how fast it may come."""
        rates = self._links[link]
        if rates is not None:
            needs = [_Need((name,), rate) for name, rate in rates.items() if name != "TIMESYNC"]
        else:
            imus = IMUS if "IMU" in self._encodings else ()
            needs = [_Need(names, IMU_RATE) for names in imus]
            positions = [name for name in get_args(Requested) if name in self._gps]
            needs += [_Need((name,), GPS_RATE) for name in positions[:1]]
            needs.append(_Need(("SYSTEM_TIME",), TIME_RATE))
        size = sum(need.rate * _size(need.names[0]) for need in needs)
        room = SHARE * self._capacity.get(link, math.inf)
        for need in needs:
            need.rate = max(need.rate * min(1.0, room / size), min(need.rate, SLOWEST))
            need.begin(self._now_us)
        return needs

    def _measure(self, needs: list[_Need]) -> None:
        now_us = self._now_us
        has_array = self._array_us is not None and now_us - self._array_us < GONE_US
        for need in needs:
            if need.is_imu and has_array:  # whose own samples are better
                need.begin(now_us)
            elif now_us - need.since_us >= WINDOW_US:
                need.measure(now_us)

    def _ask(self, need: _Need, autopilot: _Autopilot) -> dict[str, Any]:
        need.ask(self._now_us)
        autopilot.waiting = need, self._now_us
        params = (float(need.message_id), float(round(1e6 / need.rate)), *[0.0] * 5)
        return {
            "target_system": autopilot.sender[0],
            "target_component": autopilot.sender[1],
            "command": Command.SET_MESSAGE_INTERVAL,
            "confirmation": 0,
            **{f"param{i}": value for i, value in enumerate(params, 1)},
        }


def _size(name: str) -> int:
    size: int = MESSAGES[IDS[name]].unpacker.size
    return FRAME_BYTES + size
