"""Who of those that speak to a port of ours is heard, how much of it, and who is answered.

A stranger is an address of which nothing was taken yet. All strangers of a host are heard some
times a second, all hosts together a few times more. Who sent something that was taken, a frame
whose checksum and, on a signed link, whose signature holds, is a peer: it is answered, and heard up
to a rate of its own, which is that of a busy radio or autopilot many times over. There is no such
rate for who brings samples of the array that is listened to.

Places are few, and one host never has all of them. When all are taken, the peer that was silent for
longest gives way, but only after it has missed several HEARTBEATs: strangers, however many, do not
drive out those who are there.
"""

import logging
from dataclasses import dataclass, field

from risaf_link.links.link import LinkCounts, Worth
from risaf_link.mavlink.allowance import Allowance, remember

STRANGERS_A_SECOND, STRANGERS_OF_A_HOST_A_SECOND = 200.0, 20.0  # datagrams
MOST_HOSTS = 64  # of strangers that are remembered
FRAME_BYTES = 280  # the longest, and what a datagram counts for at least
PEER_BYTES_PER_S = 2000.0 * FRAME_BYTES
FEEDING_S = 1.0  # since samples came
GIVES_WAY_S = 5.0  # five HEARTBEATs
TELL_S = 60.0  # from one line on what was not heard to the next

_log = logging.getLogger(__name__)


def peer_allowance() -> Allowance:
    """How many bytes a peer may send: a second's worth at once."""
    return Allowance(PEER_BYTES_PER_S, PEER_BYTES_PER_S)


@dataclass(slots=True)
class Guest:
    """A peer, and what it may still send."""

    name: str
    host: str
    heard_s: float  # when something of it was taken
    fed_s: float = -FEEDING_S  # when samples of the array that is listened to were
    allowance: Allowance = field(default_factory=peer_allowance)

    def note(self, worth: Worth, now_s: float) -> None:
        """Take note of what came of what it sent."""
        if worth in {Worth.FRAMES, Worth.SAMPLES}:
            self.heard_s = now_s
        if worth is Worth.SAMPLES:
            self.fed_s = now_s

    def feeds(self, now_s: float) -> bool:
        """Whether it brings samples."""
        return now_s - self.fed_s < FEEDING_S


class Strangers:
    """Those who are not known yet, as far as they are heard.

    Parameters
    ----------
    name : str
        The link's.
    counts : LinkCounts
    """

    def __init__(self, name: str, counts: LinkCounts) -> None:
        self._name = name
        self._counts = counts
        self._all = Allowance(STRANGERS_A_SECOND, STRANGERS_A_SECOND)
        self._hosts: dict[str, Allowance] = {}
        self._next_telling_s = 0.0

    def place(self, host: str, guests: dict[str, Guest], most: int, now_s: float) -> str | None:
        """Who has to go for one more of them; what is not to be heard is counted.

        Parameters and result are those of `who_gives_way`.
        """
        yielding = who_gives_way(host, guests, most, now_s) if self._admits(host, now_s) else None
        if yielding is None:
            self.refuse(now_s)
        return yielding

    def refuse(self, now_s: float) -> None:
        """Count what is not heard; say so, but not all the time."""
        self._counts.dropped_in += 1
        if now_s >= self._next_telling_s:
            self._next_telling_s = now_s + TELL_S
            count = self._counts.dropped_in
            _log.warning("%s: too much comes: %d not heard so far", self._name, count)

    def _admits(self, host: str, now_s: float) -> bool:
        few = STRANGERS_OF_A_HOST_A_SECOND
        of_host = self._hosts.get(host) or Allowance(few, few)
        remember(self._hosts, host, of_host, MOST_HOSTS)
        return of_host.takes(1.0, now_s) and self._all.takes(1.0, now_s)


def who_gives_way(host: str, guests: dict[str, Guest], most: int, now_s: float) -> str | None:
    """Who has to go if one more is to have a place; "": nobody; None: nobody will.

    Parameters
    ----------
    host : str
        Of who comes; it may have half of the places.
    guests : dict
        By name.
    most : int
        How many places there are.
    now_s : float
        Seconds, of a clock that does not jump.
    """
    rivals = [guest for guest in guests.values() if guest.host == host]
    if len(rivals) < max(1, most // 2):
        if len(guests) < most:
            return ""
        rivals = list(guests.values())
    silent = min(rivals, key=lambda guest: guest.heard_s)
    return silent.name if now_s - silent.heard_s >= GIVES_WAY_S else None
