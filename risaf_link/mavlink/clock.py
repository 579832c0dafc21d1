"""The vehicle's boot clock, for an array that counts its own time.

Two clocks are compared through a third, the arrival time: `Lead` tells how far each is ahead of it.
The array's is told by its epochs, the vehicle's by SYSTEM_TIME and by answers to TIMESYNC.

When epochs come too early or too late, by their own time, one of three things has happened. The
array's clock was started anew, or set; the link has stalled; or the arrival times were set, and
then the vehicle's come too early or too late by as much. Until that is known, the offset between
both clocks holds as it was.
"""

from collections.abc import Callable
from typing import cast

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.identity import autopilot_mode
from risaf_link.mavlink.lead import GROSS_US, WINDOW_US, Lead
from risaf_link.mavlink.timesync import sample_in

SAME_CLOCK_US = 500_000  # clocks that differ by less are one
MANY = 8  # epochs, or runs of them; fewer cost less one by one
MOST_UNREAD = 256  # runs of epochs
DECIDED_US = 2_000_000  # for which epochs are out of the way before it is said why

TELLING = frozenset({IDS["SYSTEM_TIME"], IDS["TIMESYNC"]})

_SYSTEM_TIME = reader("SYSTEM_TIME", "time_unix_usec", "time_boot_ms")

Times = NDArray[np.int64]


class _Stamps(Struct):
    """Boot times of some epochs, when they are asked for."""

    time_us: Times
    received_us: Times
    catch_up: Callable[[], None]
    boot_us: Times | None = None  # not known yet

    def __call__(self) -> Times:
        if self.boot_us is None:
            self.catch_up()
        return cast("Times", self.boot_us)


class VehicleClock:
    """Puts the array's time stamps on the boot clock of the vehicle's autopilot.

    An autopilot is known by its HEARTBEAT, its clock by SYSTEM_TIME and by its answers to TIMESYNC.
    Stamps stay as they are while no autopilot has told its time, and where both clocks are the
    same. They do not go back, unless by so much that a clock was started anew.

    Parameters
    ----------
    component : int
        That of ours which asks with TIMESYNC.
    """

    def __init__(self, component: int = 191) -> None:
        self._component = component
        self._delay_us = 0
        self._unread: list[_Stamps] = []
        self._ahead_us: list[int] = []  # stamps of epochs that `stamps` will be given
        self._autopilot: tuple[int, int] | None = None
        self._vehicle, self._array = Lead(), Lead()
        self._other: Lead | None = None  # the array's, of epochs that are out of the way
        self._other_since_us = 0
        self._told_us = 0  # time of the vehicle, when last told
        self._odd_since_us = 0  # arrival, since when it is out of the way
        self._last: tuple[int, int] | None = None  # epoch: its time, and its arrival
        self._offset_us = 0
        self._last_us: int | None = None  # stamp

    def hear(self, frame: Frame, received_us: int) -> None:
        """Take note of a frame that may tell of an autopilot or of its time."""
        sender = (frame.system, frame.component)
        is_heartbeat = frame.message_id == IDS["HEARTBEAT"]
        if is_heartbeat and self._autopilot is None and autopilot_mode(frame) is not None:
            self._autopilot = sender
        if frame.message_id not in TELLING or sender != self._autopilot:
            return
        self._catch_up()
        if frame.message_id == IDS["SYSTEM_TIME"]:
            _, boot_ms = _SYSTEM_TIME(frame.payload)
            if self._believes(boot_ms * 1000, received_us):
                self._vehicle.note(boot_ms * 1000, received_us)
        else:
            sample = sample_in(frame, self._component, received_us)
            if sample and self._believes(sample.time_us, received_us):
                self._vehicle.note_answer(sample.time_us, sample.sent_us, received_us)

    @property
    def delay_us(self) -> int:
        """By how much samples are older than their stamps say."""
        return self._delay_us

    @delay_us.setter
    def delay_us(self, delay_us: int) -> None:
        self._catch_up()
        self._delay_us = delay_us

    def now_us(self, received_us: int) -> int:
        """What the clock of our stamps shows at a time since 1970; that time, if none is known."""
        self._catch_up()
        if not self._array.is_known:
            return received_us + (self._vehicle.at(received_us) if self._vehicle.is_known else 0)
        offset_us = self._offset_us if abs(self._offset_us) >= SAME_CLOCK_US else 0
        leads_us = [each.at(received_us) for each in (self._array, self._other) if each]
        return max(received_us + max(leads_us) + offset_us, 0)  # what is late may be held up

    def stamps(self, time_us: Times, received_us: Times) -> Callable[[], Times]:
        """Do what `boot_us` does for k epochs received one after another, once somebody asks.

        Epochs between which nothing was heard are then taken together: one by one each would cost
        as much.
        """
        stamps = _Stamps(time_us, received_us, self._catch_up)
        if self._ahead_us:
            stamps.boot_us, self._ahead_us = np.array(self._ahead_us), []
            return stamps
        self._unread.append(stamps)
        if len(self._unread) >= MOST_UNREAD:
            self._catch_up()
        return stamps

    def stamp(self, time_us: int, received_us: int) -> int:
        """Do what `boot_us` does for an epoch that `stamps` is given later, with all such ones."""
        self._catch_up()
        self._ahead_us.append(self.boot_us(time_us, received_us))
        return self._ahead_us[-1]

    def _catch_up(self) -> None:
        """Take the epochs that nobody has asked for yet."""
        unread, self._unread = self._unread, []
        if len(unread) < MANY:
            for each in unread:
                each.boot_us = self.boot_times(each.time_us, each.received_us)
            return
        time_us = np.concatenate([each.time_us for each in unread])
        received_us = np.concatenate([each.received_us for each in unread])
        boot_us = self.boot_times(time_us, received_us)
        end = 0
        for each in unread:
            begin, end = end, end + len(each.time_us)
            each.boot_us = boot_us[begin:end]

    def boot_us(self, time_us: int, received_us: int) -> int:
        """When the samples of an epoch were taken, which has just been received."""
        off_us = self._array.off(time_us, received_us)
        if off_us and not self._is_array_anew(time_us, received_us):
            self._set_aside(time_us, received_us)
        else:
            if off_us:
                self._array = Lead()
            self._other = None
            self._array.note(time_us, received_us)
            if self._vehicle.is_known:
                self._offset_us = self._vehicle.at(received_us) - self._array.at(received_us)
        self._last = time_us, received_us
        is_same = abs(self._offset_us) < SAME_CLOCK_US
        stamp_us = time_us if is_same else time_us + self._offset_us
        return self._steady(max(stamp_us - self._delay_us, 0))

    def boot_times(self, time_us: Times, received_us: Times) -> Times:
        """Do what `boot_us` does, for k epochs that were received one after another."""
        if len(time_us) < MANY:
            return np.array(list(map(self.boot_us, time_us.tolist(), received_us.tolist())))
        stamps = np.empty(len(time_us), np.int64)
        done = 0
        while done < len(stamps):
            alike = self._boot_times(time_us[done:], received_us[done:])
            if not len(alike):
                alike = np.array([self.boot_us(int(time_us[done]), int(received_us[done]))])
            stamps[done : done + len(alike)] = alike
            done += len(alike)
        return stamps

    def _boot_times(self, time_us: Times, received_us: Times) -> Times:
        """Stamps of the first epochs, as far as all goes as usual."""
        if len(time_us) == 1 or self._other:
            return time_us[:0]
        leads_us = self._array.note_each(time_us, received_us)
        count = len(leads_us)
        if not count:
            return time_us[:0]
        time_us, received_us = time_us[:count], received_us[:count]
        offsets_us = np.full(count, self._offset_us)
        if self._vehicle.is_known:
            offsets_us = self._vehicle.at_each(received_us) - leads_us
        self._offset_us = int(offsets_us[-1])
        self._last = int(time_us[-1]), int(received_us[-1])
        same = np.abs(offsets_us) < SAME_CLOCK_US
        stamps_us = np.where(same, time_us, time_us + offsets_us)
        stamps: Times = np.maximum(stamps_us - self._delay_us, 0)
        if (stamps[1:] < stamps[:-1]).any() or stamps[0] < (self._last_us or 0):
            return np.array([self._steady(stamp) for stamp in stamps.tolist()])
        self._last_us = int(stamps[-1])
        return stamps

    def _is_array_anew(self, time_us: int, received_us: int) -> bool:
        """Whether it is the array's clock that has jumped, beyond doubt."""
        if self._last is None:
            return False
        step_us, passed_us = time_us - self._last[0], received_us - self._last[1]
        return step_us < 0 or 0 <= passed_us < step_us - GROSS_US

    def _set_aside(self, time_us: int, received_us: int) -> None:
        """Take an epoch that is out of the way, for reasons that are not known yet."""
        if self._other is None or self._other.off(time_us, received_us):
            self._other, self._other_since_us = Lead(), received_us
        self._other.note(time_us, received_us)
        lasts_us = received_us - self._other_since_us
        if lasts_us > WINDOW_US or (lasts_us > DECIDED_US and not self._vehicle.is_known):
            self._array, self._other = self._other, None

    def _believes(self, time_us: int, received_us: int) -> bool:
        """Whether the vehicle's time may be taken; it tells which clock has jumped, if one has."""
        has_gone_back = self._told_us - time_us > SAME_CLOCK_US
        self._told_us = time_us
        if has_gone_back:
            self._vehicle = Lead()
        off_us = self._vehicle.off(time_us, received_us)
        if self._other:
            if received_us - self._other_since_us > DECIDED_US:
                self._decide(self._other, off_us, received_us)
                off_us = self._vehicle.off(time_us, received_us)
        elif off_us:
            self._odd_since_us = self._odd_since_us or received_us
            patience_us = 2 * DECIDED_US if off_us > 0 else WINDOW_US
            if received_us - self._odd_since_us > patience_us:
                self._vehicle, off_us = Lead(), 0
        if not off_us:
            self._odd_since_us = 0
        return not off_us

    def _decide(self, other: Lead, off_us: int, received_us: int) -> None:
        """Say why epochs are out of the way, given how far the vehicle's time is."""
        jump_us = other.at(received_us) - self._array.at(received_us)
        if abs(off_us - jump_us) < abs(jump_us) / 2:
            self._array.shift(jump_us)
            self._vehicle.shift(jump_us)
            self._other = None
        elif jump_us > 0:
            self._array, self._other = other, None

    def _steady(self, stamp_us: int) -> int:
        """A stamp that does not go back a little."""
        if self._last_us is not None and 0 < self._last_us - stamp_us < SAME_CLOCK_US:
            return self._last_us
        self._last_us = stamp_us
        return stamp_us
