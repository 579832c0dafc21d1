"""The vehicle's boot clock, for an array that counts its own time.

Two clocks are compared through a third, the arrival time: of all that came within some seconds, the
frame that was least delayed tells best how far a sender's clock is ahead of it. Better still are
the autopilot's answers to TIMESYNC, which say how long they took. When the array's clock seems to
jump, the third may have been set or the link may have stalled: the offset that was found before
holds until the vehicle tells its time again.
"""

import numpy as np
from numpy.typing import NDArray

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.identity import autopilot_mode
from risaf_link.mavlink.timesync import Sample, Synchronised, sample_in

WINDOW_US = 10_000_000
SAME_CLOCK_US = 500_000  # clocks that differ by less are one

_SYSTEM_TIME = reader("SYSTEM_TIME", "time_unix_usec", "time_boot_ms")

Times = NDArray[np.int64]


class _Lead:
    """How far a sender's clock is ahead of the arrival time: the most of the last seconds."""

    def __init__(self) -> None:
        self.lead_us: int | None = None
        self._current_us = 0
        self._since_us = 0

    def note(self, time_us: int, received_us: int) -> bool:
        """Take a time and its arrival; whether one of the clocks has jumped."""
        lead_us = time_us - received_us
        has_jumped = self.lead_us is not None and abs(lead_us - self.lead_us) > SAME_CLOCK_US
        if self.lead_us is None or has_jumped:
            self.lead_us = self._current_us = lead_us
            self._since_us = received_us
        elif 0 <= received_us - self._since_us < WINDOW_US:
            self._current_us = max(self._current_us, lead_us)
            self.lead_us = max(self.lead_us, lead_us)
        else:
            self.lead_us = max(self._current_us, lead_us)
            self._current_us, self._since_us = lead_us, received_us
        return has_jumped

    def note_steady(self, time_us: Times, received_us: Times) -> Times | None:
        """Take k times and arrivals, (k,) each; the lead at each. None: one by one, `note` it."""
        if self.lead_us is None:
            return None
        leads_us = time_us - received_us
        most_us = int(leads_us.max())
        lead_us = max(self.lead_us, most_us)
        since_us = received_us - self._since_us
        steady = lead_us - min(self.lead_us, int(leads_us.min())) <= SAME_CLOCK_US
        if not steady or since_us.min() < 0 or since_us.max() >= WINDOW_US:
            return None
        self._current_us = max(self._current_us, most_us)
        before_us, self.lead_us = self.lead_us, lead_us
        return np.maximum.accumulate(np.maximum(leads_us, before_us))


class VehicleClock:
    """Puts the array's time stamps on the boot clock of the vehicle's autopilot.

    An autopilot is known by its HEARTBEAT, its clock by SYSTEM_TIME and by its answers to TIMESYNC.
    Stamps stay as they are while no autopilot has told its time, and where both clocks are the
    same. They do not go back, unless by so much that a clock was started anew.

    Parameters
    ----------
    component : int
        That of ours which asks with TIMESYNC.

    Attributes
    ----------
    delay_us : int
        By how much samples are older than their stamps say.
    """

    def __init__(self, component: int = 191) -> None:
        self._component = component
        self.delay_us = 0
        self._autopilot: tuple[int, int] | None = None
        self._vehicle, self._array = _Lead(), _Lead()
        self._synchronised = Synchronised()
        self._offset_us = 0
        self._last_us: int | None = None  # stamp

    def hear(self, frame: Frame, received_us: int) -> None:
        """Take note of a frame that may tell of an autopilot or of its time."""
        sender = (frame.system, frame.component)
        if frame.message_id == IDS["HEARTBEAT"]:
            if self._autopilot is None and autopilot_mode(frame) is not None:
                self._autopilot = sender
        elif frame.message_id == IDS["SYSTEM_TIME"] and sender == self._autopilot:
            _, boot_ms = _SYSTEM_TIME(frame.payload)
            self._vehicle.note(boot_ms * 1000, received_us)
            lead_us = boot_ms * 1000 - received_us
            if self._synchronised.is_contradicted(lead_us, received_us, SAME_CLOCK_US):
                self._synchronised = Synchronised()
        elif frame.message_id == IDS["TIMESYNC"] and sender == self._autopilot:
            sample = sample_in(frame, self._component, received_us)
            if sample:
                self._synchronise(sample)

    def now_us(self, received_us: int) -> int:
        """What the clock of our stamps shows at a time since 1970; that time, if none is known."""
        if self._array.lead_us is None:
            return received_us + (self._lead_of_vehicle(received_us) or 0)
        offset_us = self._offset_us if abs(self._offset_us) >= SAME_CLOCK_US else 0
        return max(received_us + self._array.lead_us + offset_us, 0)

    def boot_us(self, time_us: int, received_us: int) -> int:
        """When the samples of an epoch were taken, which has just been received."""
        if self._array.note(time_us, received_us):
            self._vehicle, self._synchronised = _Lead(), Synchronised()
        lead_us = self._lead_of_vehicle(received_us)
        if lead_us is not None and self._array.lead_us is not None:
            self._offset_us = lead_us - self._array.lead_us
        is_same = abs(self._offset_us) < SAME_CLOCK_US
        stamp_us = time_us if is_same else time_us + self._offset_us
        return self._steady(max(stamp_us - self.delay_us, 0))

    def boot_times(self, time_us: Times, received_us: Times) -> Times:
        """Do what `boot_us` does, for k epochs that were received one after another."""
        times_us = self._boot_times(time_us, received_us) if len(time_us) > 1 else None
        if times_us is None:
            pairs = zip(time_us.tolist(), received_us.tolist(), strict=True)
            return np.array([self.boot_us(*pair) for pair in pairs])
        return times_us

    def _boot_times(self, time_us: Times, received_us: Times) -> Times | None:
        """Times of epochs at which all goes as usual; None: it does not, and nothing was noted."""
        ends_us = int(received_us[0]), int(received_us[-1])
        if len({self._synchronised.is_known(end_us) for end_us in ends_us}) > 1:
            return None
        leads_us = self._array.note_steady(time_us, received_us)
        if leads_us is None:
            return None
        offsets_us = np.full(len(time_us), self._offset_us)
        if self._synchronised.is_known(ends_us[-1]):
            offsets_us = self._synchronised.leads(received_us) - leads_us
        elif self._vehicle.lead_us is not None:
            offsets_us = self._vehicle.lead_us - leads_us
        self._offset_us = int(offsets_us[-1])
        same = np.abs(offsets_us) < SAME_CLOCK_US
        stamps_us = np.where(same, time_us, time_us + offsets_us)
        stamps: Times = np.maximum(stamps_us - self.delay_us, 0)
        if (stamps[1:] < stamps[:-1]).any() or stamps[0] < (self._last_us or 0):
            return np.array([self._steady(stamp) for stamp in stamps.tolist()])
        self._last_us = int(stamps[-1])
        return stamps

    def _synchronise(self, sample: Sample) -> None:
        """Take an answer of the autopilot's."""
        is_new = self._synchronised.is_before(sample)
        if self._synchronised.note(sample) and not is_new:
            self._array = _Lead()  # the arrival times have jumped, not the vehicle
        if is_new:
            self._vehicle = _Lead()

    def _lead_of_vehicle(self, received_us: int) -> int | None:
        """How far the vehicle's clock is ahead of the arrival times; None: it is not known."""
        if self._synchronised.is_known(received_us):
            return self._synchronised.lead(received_us)
        return self._vehicle.lead_us

    def _steady(self, stamp_us: int) -> int:
        """A stamp that does not go back a little."""
        if self._last_us is not None and 0 < self._last_us - stamp_us < SAME_CLOCK_US:
            return self._last_us
        self._last_us = stamp_us
        return stamp_us
