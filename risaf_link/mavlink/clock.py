"""The vehicle's boot clock, for an array that counts its own time.

Two clocks are compared through a third, the arrival time: of all that came within some seconds, the
frame that was least delayed tells best how far a sender's clock is ahead of it. When the array's
clock seems to jump, the third may have been set or the link may have stalled: the offset that was
found before holds until the vehicle tells its time again.
"""

import numpy as np
from numpy.typing import NDArray

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame

WINDOW_US = 10_000_000
SAME_CLOCK_US = 500_000  # clocks that differ by less are one
GROUND_STATION, NO_AUTOPILOT = 6, 8  # MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID

_HEARTBEAT = reader("HEARTBEAT", "type", "autopilot")
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

    An autopilot is known by its HEARTBEAT, its clock by SYSTEM_TIME. Stamps stay as they are while
    no autopilot has told its time, and where both clocks are the same.
    """

    def __init__(self) -> None:
        self._autopilot: tuple[int, int] | None = None
        self._vehicle, self._array = _Lead(), _Lead()
        self._offset_us = 0

    def hear(self, frame: Frame, received_us: int) -> None:
        """Take note of a frame that may tell of an autopilot or of its time."""
        sender = (frame.system, frame.component)
        if frame.message_id == IDS["HEARTBEAT"] and self._autopilot is None:
            vehicle_type, autopilot = _HEARTBEAT(frame.payload)
            if autopilot != NO_AUTOPILOT and vehicle_type != GROUND_STATION:
                self._autopilot = sender
        elif frame.message_id == IDS["SYSTEM_TIME"] and sender == self._autopilot:
            _, boot_ms = _SYSTEM_TIME(frame.payload)
            self._vehicle.note(boot_ms * 1000, received_us)

    def boot_us(self, time_us: int, received_us: int) -> int:
        """Time of an epoch, which has just been received, on the vehicle's clock."""
        if self._array.note(time_us, received_us):
            self._vehicle = _Lead()
        if self._vehicle.lead_us is not None and self._array.lead_us is not None:
            self._offset_us = self._vehicle.lead_us - self._array.lead_us
        if abs(self._offset_us) < SAME_CLOCK_US:
            return time_us
        return max(time_us + self._offset_us, 0)

    def boot_times(self, time_us: Times, received_us: Times) -> Times:
        """Do what `boot_us` does, for k epochs that were received one after another."""
        several = len(time_us) > 1
        leads_us = self._array.note_steady(time_us, received_us) if several else None
        if leads_us is None:
            pairs = zip(time_us.tolist(), received_us.tolist(), strict=True)
            return np.array([self.boot_us(*pair) for pair in pairs])
        offsets_us = np.full(len(time_us), self._offset_us)
        if self._vehicle.lead_us is not None:
            offsets_us = self._vehicle.lead_us - leads_us
            self._offset_us = int(offsets_us[-1])
        same = np.abs(offsets_us) < SAME_CLOCK_US
        return np.where(same, time_us, np.maximum(time_us + offsets_us, 0))
