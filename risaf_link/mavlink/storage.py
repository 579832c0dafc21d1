"""PREFLIGHT_STORAGE: what was set over MAVLink is read again, written, or forgotten."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any

from risaf_link.mavlink.commands import Order, Result
from risaf_link.mavlink.parameters import Parameters

NO_PLACE = "no configuration file"


class StorageAction(IntEnum):
    """PREFLIGHT_STORAGE_PARAMETER_ACTION, as far as it is understood."""

    READ = 0
    WRITE = 1
    RESET = 2


class Storage:
    """Carries orders out; one that writes is ended by `end`, and no other begins before.

    Parameters
    ----------
    parameters : Parameters
    keep : callable or None
        Begins to store parameters, by name; None: there is no place.
    """

    def __init__(
        self, parameters: Parameters[Any], keep: Callable[[dict[str, float]], None] | None
    ) -> None:
        self._parameters = parameters
        self._keep = keep
        self._stored = dict(parameters.kept)
        self._order: Order | None = None  # that is being carried out

    def obey(self, order: Order) -> tuple[Result, bool]:
        """Obey an order, or begin to; and whether all parameters may be others now.

        It has failed where there is no place.
        """
        action = order.integer
        if action not in set(StorageAction):
            return Result.DENIED, False
        if self._order:
            running = self._order.asker, self._order.parameters
            same = running == (order.asker, order.parameters)
            return Result.IN_PROGRESS if same else Result.TEMPORARILY_REJECTED, False
        if action == StorageAction.WRITE:
            return self._begin(order), False
        self._parameters.reset()
        if action == StorageAction.READ:
            for name, value in self._stored.items():
                self._parameters.set(name, value)
        elif self._stored:
            return self._begin(order), True
        return Result.ACCEPTED, True

    def end(self, parameters: dict[str, float], failure: str) -> tuple[Order, Result] | None:
        """Take note that parameters were stored, or why they were not; whom to tell what of it."""
        order, self._order = self._order, None
        if not failure:
            self._stored = parameters
        return (order, Result.FAILED if failure else Result.ACCEPTED) if order else None

    def _begin(self, order: Order) -> Result:
        if self._keep is None:
            return Result.FAILED
        self._order = order
        self._keep(dict(self._parameters.kept))
        return Result.IN_PROGRESS
