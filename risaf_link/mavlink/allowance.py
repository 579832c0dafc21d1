"""How much others may have of us: of something in a second, and of our memory."""

from typing import TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


def remember(memory: dict[Key, Value], key: Key, value: Value, most: int) -> Value | None:
    """Keep a value; forget and return that which was renewed longest ago if there are too many."""
    memory.pop(key, None)
    memory[key] = value
    return memory.pop(next(iter(memory))) if len(memory) > most else None


class Allowance:
    """Fills up at a rate, and holds no more than what may be had at once.

    Parameters
    ----------
    rate : float
        What it gains in a second.
    most : float
        What it holds; at the beginning it is full.
    """

    __slots__ = ("_at_s", "_held", "_most", "_rate")

    def __init__(self, rate: float, most: float) -> None:
        self._rate = rate
        self._most = self._held = most
        self._at_s = 0.0

    def takes(self, amount: float, now_s: float) -> bool:
        """Take an amount, if it is there, at a time in seconds; going back gains nothing."""
        self._fill(now_s)
        if self._held < amount:
            return False
        self._held -= amount
        return True

    def charge(self, amount: float, now_s: float) -> float:
        """Take an amount whether it is there or not; how many seconds it takes to make it good."""
        self._fill(now_s)
        self._held -= amount
        return max(0.0, -self._held / self._rate)

    def _fill(self, now_s: float) -> None:
        gained = self._rate * max(0.0, now_s - self._at_s)
        self._held = min(self._most, self._held + gained)
        self._at_s = now_s
