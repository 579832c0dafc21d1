"""What one open page is sent: all that is known now, and of the past what it does not have yet."""

from itertools import islice

from msgspec import Struct

from risaf_link.monitor.estimator import (
    Array,
    Attitude,
    Axes,
    Deviations,
    Estimator,
    Heading,
    Row,
    Sensors,
)
from risaf_link.monitor.recording import Playback
from risaf_link.monitor.source import Source
from risaf_link.monitor.vehicles import Event, Pulse, Vehicles, Who


class Heard(Struct, frozen=True):
    """A component, by one way."""

    peer: str
    system: int
    component: int
    is_estimator: bool
    pulse: Pulse | None
    heard_us: int
    frames_per_s: float
    bytes_per_s: float
    loss: float | None  # share
    trip_us: float | None


class Known(Struct, frozen=True):
    """What the chosen component tells."""

    heard_us: int
    attitude: Attitude | None
    deviations: Deviations | None
    heading: Heading | None
    gate: float | None  # rad
    array: Array | None
    bias: Axes
    bias_std: Axes


class Update(Struct, frozen=True, omit_defaults=True):
    """What the page is sent; what it has already is left out."""

    source: str
    now_us: int
    playback: Playback | None
    is_new: bool  # what was sent before belongs to something else
    heard: list[Heard]
    rejected: dict[str, int]  # frames that were not taken for their signatures, by reason
    chosen: Who | None
    known: Known | None
    rows: list[Row]
    events: list[Event]
    sensors: Sensors | None = None


class View:
    """One open page.

    Parameters
    ----------
    source : Source
    wanted : (int, int) or None
        System and component that it shows; None: the first that is there.
    """

    def __init__(self, source: Source, wanted: Who | None = None) -> None:
        self._source = source
        self._wanted = wanted
        self._vehicles: Vehicles | None = None
        self._estimator: Estimator | None = None
        self._rows = self._events = self._sensors = 0

    def update(self) -> Update:
        """What is to be sent now."""
        vehicles, now_us = self._source.vehicles, self._source.now_us
        chosen = self._wanted or min(vehicles.estimators, default=None)
        estimator = vehicles.estimators.get(chosen) if chosen else None
        is_new = vehicles is not self._vehicles or estimator is not self._estimator
        if is_new:
            self._vehicles, self._estimator = vehicles, estimator
            self._rows = self._events = self._sensors = 0
        player = self._source.player
        return Update(
            self._source.name,
            now_us,
            player.playback if player else None,
            is_new,
            _heard(vehicles, now_us),
            dict(self._source.rejected),
            chosen,
            _known(estimator) if estimator else None,
            self._new_rows(estimator) if estimator else [],
            self._new_events(vehicles),
            self._new_sensors(estimator) if estimator else None,
        )

    def _new_rows(self, estimator: Estimator) -> list[Row]:
        count, self._rows = estimator.row_count - self._rows, estimator.row_count
        return list(islice(estimator.rows, max(0, len(estimator.rows) - count), None))

    def _new_events(self, vehicles: Vehicles) -> list[Event]:
        count, self._events = vehicles.event_count - self._events, vehicles.event_count
        return list(islice(vehicles.events, max(0, len(vehicles.events) - count), None))

    def _new_sensors(self, estimator: Estimator) -> Sensors | None:
        if self._sensors == estimator.sensors_version:
            return None
        self._sensors = estimator.sensors_version
        return estimator.sensors


def _heard(vehicles: Vehicles, now_us: int) -> list[Heard]:
    heard = []
    for way, account in vehicles.traffic.accounts.items():
        sender = account.sender
        who = sender.system, sender.component
        heard.append(
            Heard(
                *way,
                who in vehicles.estimators,
                vehicles.pulses.get(who),
                sender.heard_us,
                *account.rates(now_us),
                account.loss(now_us),
                sender.trip_us,
            )
        )
    return sorted(heard, key=lambda h: (h.system, h.component, h.peer))


def _known(estimator: Estimator) -> Known:
    return Known(
        estimator.heard_us,
        estimator.attitude,
        estimator.deviations,
        estimator.heading,
        estimator.heading.gate if estimator.heading else None,
        estimator.array,
        estimator.bias,
        estimator.bias_std,
    )
