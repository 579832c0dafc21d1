"""Which frames are taken from a peer, and what that says of it.

On a signed link those that signing takes. On every link no more orders than a ground station gives:
each of them is answered, some to everybody, and each may set the estimator up anew. What is not
taken is counted, and neither read nor recorded: a replay of the recording obeys what was obeyed.
"""

from collections import Counter
from collections.abc import Callable

import numpy as np

from risaf_link.keys import Keys
from risaf_link.links import Worth
from risaf_link.mavlink.allowance import Allowance, remember
from risaf_link.mavlink.commands import Peer, concerns
from risaf_link.mavlink.component import ORDERS
from risaf_link.mavlink.dialect import IDS, name_of, reader
from risaf_link.mavlink.frame import Frame, FrameTable

ORDERS_A_SECOND, ORDERS_AT_ONCE = 20.0, 200.0  # who sets all parameters at once sends some sixty
MOST_PEERS = 256  # that are remembered

_TARGETS = {
    message_id: reader(name_of(message_id), "target_system", "target_component")
    for message_id in ORDERS - {IDS["HEARTBEAT"]}
}


class Gate:
    """Takes frames, or does not.

    Parameters
    ----------
    keys : Keys
    own : callable
        Tells our system and component id.

    Attributes
    ----------
    refused : Counter
        Frames that were not taken: `too_many_orders`.
    """

    def __init__(self, keys: Keys, own: Callable[[], tuple[int, int]]) -> None:
        self.refused: Counter[str] = Counter()
        self._signings = keys.links
        self._own = own
        self._orders: dict[Peer, Allowance] = {}  # who gave one last is last

    def admitted(self, table: FrameTable, sender: Peer, received_us: int) -> FrameTable:
        """Those frames of a peer that are taken, at a time in microseconds."""
        signing = self._signings.get(sender[0])
        if signing is not None:
            table = signing.taken(table)
        if table.message_ids.isdisjoint(_TARGETS):
            return table
        taken = [
            message_id not in _TARGETS or self._obeys(table.frame(row), sender, received_us / 1e6)
            for row, (message_id, *_) in enumerate(table.origins)
        ]
        return table.part(np.array(taken, bool))

    def worth(self, table: FrameTable, link: str) -> Worth:
        """Whether frames that were taken show that who sent them belongs here."""
        signing = self._signings.get(link)
        showing = table.cuts["known"]
        if signing is not None and not signing.takes_all:
            showing = showing & table.cuts["signed"]
        return Worth.FRAMES if showing.any() else Worth.NOTHING

    def _obeys(self, frame: Frame, sender: Peer, now_s: float) -> bool:
        """Whether an order that is meant for us is not one too many."""
        if not concerns(_TARGETS[frame.message_id](frame.payload), self._own()):
            return True
        orders = self._orders.get(sender) or Allowance(ORDERS_A_SECOND, ORDERS_AT_ONCE)
        remember(self._orders, sender, orders, MOST_PEERS)
        few_enough = orders.takes(1.0, now_s)
        self.refused["too_many_orders"] += not few_enough
        return few_enough
