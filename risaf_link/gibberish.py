"""Links that bring bytes and no frames: a wrong baud rate, another protocol, half a frame."""

from collections import Counter
from collections.abc import Mapping

from risaf_link.mavlink.notices import Notice, Severity

PERIOD_S = 5.0  # from one look to the next: every sender of MAVLink says something once a second
LEAST_BYTES = 256  # in that time; less may be a plug that is pushed in


class Gibberish:
    """Finds links whose bytes are no MAVLink, and says so once, until they are."""

    def __init__(self) -> None:
        self._frames: Counter[str] = Counter()  # by link, since the last look
        self._bytes_before: dict[str, int] = {}
        self._told: set[str] = set()
        self._next_s = 0.0

    def note(self, link: str, frames: int) -> None:
        """Take note of frames that were found in what a link brought."""
        self._frames[link] += frames

    def look(self, bytes_in: Mapping[str, int], now_s: float) -> list[Notice]:
        """What is to be told now.

        Parameters
        ----------
        bytes_in : mapping
            What each link has brought since the start.
        now_s : float
            A clock, seconds, that does not jump.
        """
        if now_s < self._next_s:
            return []
        self._next_s = now_s + PERIOD_S
        frames, self._frames = self._frames, Counter()
        before, self._bytes_before = self._bytes_before, dict(bytes_in)
        notices = []
        for link, count in bytes_in.items():
            came = count - before.get(link, 0)
            if frames[link] and link in self._told:
                self._told.remove(link)
                notices.append(Notice(Severity.INFO, f"{link}: MAVLink comes"))
            elif not frames[link] and came >= LEAST_BYTES and link not in self._told:
                self._told.add(link)
                notices.append(
                    Notice(Severity.WARNING, f"{link}: what comes is no MAVLink: wrong baud rate?")
                )
        return notices
