"""Who listens to us, and what each of them gets: rates and sequence numbers of its own."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import get_args

from risaf_link.mavlink.allowance import remember
from risaf_link.mavlink.commands import Peer
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.odometry import Profile
from risaf_link.mavlink.pulse import HEARTBEAT_US
from risaf_link.mavlink.signing import LinkSigning
from risaf_link.mavlink.telemetry import Emitter, Message, Rates

MOST_PEERS = 256  # that are remembered
FASTEST_US = 1000.0  # shortest interval of a message: that of the fastest array
LARGEST_INTERVAL_US = 2**31 - 1

UNFED_US = 10_000_000  # that ODOMETRY may wait for the autopilot's HEARTBEAT
UNFED = "not sent: neither PX4 nor ArduPilot is heard, and mavlink.odometry is auto"

EMITTED: dict[int, Message] = {IDS[name]: name for name in get_args(Message)}
"""Messages that may be asked for, by their ids."""


@dataclass(frozen=True, slots=True)
class Terms:
    """What holds for all peers of one link."""

    rates: Rates | None = None  # Hz; None: the default ones
    pace: float = math.inf  # how many PARAM_VALUE a second the link takes at most
    signing: LinkSigning | None = None  # None: nothing is signed


ANY = Terms()


class Peers:
    """The emitters of all peers.

    Parameters
    ----------
    system, component : int
        Whom the frames come from.
    rates : dict
        Of links without rates of their own.
    links : mapping
        Link's name to its terms.
    """

    def __init__(
        self, system: int, component: int, rates: Rates, links: Mapping[str, Terms]
    ) -> None:
        self._own = system, component
        self._rates = rates
        self._links = links
        self._profile: Profile | None = None
        self._unfed_us: int | None = None  # since when somebody waits for ODOMETRY in vain
        self._emitters: dict[Peer, Emitter] = {}  # who was sent something last is last

    def emitter(self, peer: Peer) -> Emitter:
        """The one that makes the frames for a peer."""
        emitter = self._emitters.get(peer)
        if emitter is None:
            terms = self._links.get(peer[0], ANY)
            rates = self._rates if terms.rates is None else terms.rates
            emitter = Emitter(rates, *self._own, terms.signing, self._profile)
        remember(self._emitters, peer, emitter, MOST_PEERS)
        return emitter

    def listening(self, peers: Iterable[Peer]) -> list[Peer]:
        """Those that get anything: what is for all is for them."""
        return [peer for peer in peers if self.emitter(peer).rates]

    def known(self) -> list[Peer]:
        """All that were ever sent anything, and get something."""
        return self.listening(list(self._emitters))

    def set_defaults(self, rates: Rates) -> None:
        """Change the rates of links without rates of their own."""
        self._rates = rates
        for (link, _), emitter in self._emitters.items():
            own = self._links.get(link, ANY).rates
            emitter.set_defaults(rates if own is None else own)

    def rename(self, system: int) -> None:
        """Speak under another system id from now on."""
        self._own = system, self._own[1]
        for emitter in self._emitters.values():
            emitter.system = system

    def feed(self, profile: Profile | None) -> None:
        """Take note of how the vehicle's autopilot takes ODOMETRY; None: it is not known."""
        if profile is not self._profile:
            self._profile = profile
            for emitter in self._emitters.values():
                emitter.profile = profile

    def complaint(self, now_us: int) -> str:
        """What is wrong with ODOMETRY: for long nobody has told in which form it is wanted.

        Parameters
        ----------
        now_us : int
            Microseconds of a clock that does not jump.
        """
        wanted = any("ODOMETRY" in emitter.rates for emitter in self._emitters.values())
        if self._profile or not wanted:
            self._unfed_us = None
        elif self._unfed_us is None:
            self._unfed_us = now_us
        unfed = self._unfed_us is not None and now_us - self._unfed_us >= UNFED_US
        return UNFED if unfed else ""

    def ask(self, peer: Peer, message_id: int, interval_us: float) -> bool:
        """Let a peer have a message so often, -1 not at all, 0 by default; whether that can be."""
        name = EMITTED.get(message_id)
        sensible = interval_us in {-1.0, 0.0} or 0 < interval_us <= LARGEST_INTERVAL_US
        if name is None or not sensible:
            return False
        rate = 0.0 if interval_us < 0 else 1e6 / max(interval_us, FASTEST_US)
        return self.emitter(peer).ask(name, rate if interval_us else None)

    def interval_us(self, peer: Peer, message_id: int) -> int:
        """How often a peer gets a message, as MESSAGE_INTERVAL says it."""
        if message_id == IDS["HEARTBEAT"]:
            return HEARTBEAT_US
        if message_id not in EMITTED:
            return 0
        rate = self.emitter(peer).rates.get(EMITTED[message_id], 0.0)
        return min(max(round(1e6 / rate), 1), LARGEST_INTERVAL_US) if rate else -1
