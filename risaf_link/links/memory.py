"""Links that meet inside one process, for tests."""

import asyncio
from collections import defaultdict

from risaf_link.links.link import Connection, Link

_running: defaultdict[str, list[Connection]] = defaultdict(list)  # by the place where they meet


class MemoryLink(Link):
    """One end of a pair: what it sends, the other running links of its place receive.

    Parameters
    ----------
    name : str
        What the log calls it.
    place : str
        Where the two ends meet.
    """

    def __init__(self, name: str, place: str) -> None:
        super().__init__(name)
        self._ends = _running[place]
        self._place = place
        self._end: Connection | None = None

    async def _hold(self, connection: Connection) -> None:
        self._end = connection
        self._ends.append(connection)
        try:
            connection.up(self._place)
            await connection.lost
        finally:
            self._ends.remove(connection)
            self._end = None

    def send(self, data: bytes) -> None:
        """Hand one frame to the other end; while either is not running it is dropped."""
        others = [end for end in self._ends if end is not self._end]
        if self._end is None or not others:
            self.counts.dropped_out += 1
            return
        for end in others:  # soon, not now: the other end may answer at once
            asyncio.get_running_loop().call_soon(end.deliver, data, "")
            self.counts.bytes_out += len(data)
