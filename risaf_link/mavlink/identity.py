"""Who we are on the network: part of the vehicle whose autopilot is heard.

An autopilot is known by what its HEARTBEAT says, never by its component id.
"""

from risaf_link.mavlink.dialect import IDS, reader
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.odometry import AUTOPILOTS, PROFILES, ProfileName

WINDOW_US = 3_000_000  # after the first autopilot, in which another one may be heard
GROUND_STATION, NO_AUTOPILOT = 6, 8  # MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
ARMED_FOR_US = 5_000_000  # since the last HEARTBEAT

_HEARTBEAT = reader("HEARTBEAT", "type", "autopilot", "base_mode")


def autopilot_in(frame: Frame) -> int:
    """Which autopilot a HEARTBEAT is of: MAV_AUTOPILOT."""
    return int(_HEARTBEAT(frame.payload)[1])


def autopilot_mode(frame: Frame) -> int | None:
    """Base mode in the HEARTBEAT of an autopilot; None: the frame is no such thing."""
    if frame.message_id != IDS["HEARTBEAT"]:
        return None
    vehicle_type, autopilot, base_mode = _HEARTBEAT(frame.payload)
    is_autopilot = autopilot != NO_AUTOPILOT and vehicle_type != GROUND_STATION
    return int(base_mode) if is_autopilot else None


class Identity:
    """Our ids, and what is known of the autopilot.

    Parameters
    ----------
    system, component : int
        Whom we are.
    adopts : bool
        Whether the system id of the one autopilot that is heard is taken.
    odometry : str or None
        Which autopilot ODOMETRY is for; auto: our vehicle's, as its HEARTBEAT tells; None: none.

    Attributes
    ----------
    profile : Profile or None
        How that one takes it; None: not known.
    feeds : bool
        Whether there may ever be one.
    """

    def __init__(
        self, system: int, component: int, adopts: bool, odometry: ProfileName | None = "auto"
    ) -> None:
        self.system = system
        self.component = component
        self.feeds = odometry is not None
        self.profile = PROFILES.get(odometry or "")
        self._follows = odometry == "auto"  # the autopilot's HEARTBEAT
        self._armed_us: int | None = None  # when the autopilot last said that it is
        self._undecided = adopts
        self._heard: set[int] = set()  # systems with an autopilot
        self._first_us = 0

    @property
    def own(self) -> tuple[int, int]:
        """System and component id."""
        return self.system, self.component

    def is_armed(self, now_us: int) -> bool:
        """Whether our vehicle is, as its autopilot said of late."""
        return self._armed_us is not None and 0 <= now_us - self._armed_us < ARMED_FOR_US

    def hear(self, frame: Frame, received_us: int) -> bool:
        """Take a frame that may be an autopilot's HEARTBEAT; whether our system id has changed."""
        base_mode = autopilot_mode(frame)
        is_own = (frame.system, frame.component) == self.own
        if base_mode is None or is_own or not frame.system:
            return False
        renamed = self._undecided and self._decide(frame.system, received_us)
        if frame.system == self.system:
            self._armed_us = received_us if base_mode & ARMED else None
            if self._follows:
                self.profile = AUTOPILOTS.get(autopilot_in(frame), self.profile)
        return renamed

    def _decide(self, system: int, received_us: int) -> bool:
        if not self._heard:
            self._first_us = received_us
        self._heard.add(system)
        if 0 <= received_us - self._first_us < WINDOW_US:
            return False
        self._undecided = False
        before = self.system
        if len(self._heard) == 1:
            self.system = system
        return self.system != before
