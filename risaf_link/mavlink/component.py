"""The citizen of the MAVLink network: heartbeat, parameters, commands, and what each peer gets.

Sans-IO. Frames go in with the peer they came from, estimates as they are made, and now and then the
time; frames come out with the peer they are for. A peer is somebody on a link: each has sequence
numbers and rates of its own, so that what one asks for costs no other.

What is addressed to us is always answered. What is addressed to all is answered where it was done,
and where it was not, others may: we are silent.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from risaf_link import __version__
from risaf_link.core.estimate import Estimate
from risaf_link.core.rotation import Floats
from risaf_link.mavlink import timesync
from risaf_link.mavlink.commands import Command, Order, Peer, Result, concerns, order_in, whole
from risaf_link.mavlink.dialect import IDS, name_of
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.gyro_calibration import GyroCalibration, Report
from risaf_link.mavlink.identity import Identity
from risaf_link.mavlink.notices import Notice, Notices, Severity, statustexts
from risaf_link.mavlink.parameters import Parameters
from risaf_link.mavlink.peers import ANY, EMITTED, Peers, Terms
from risaf_link.mavlink.pulse import Pulse
from risaf_link.mavlink.requests import Requests
from risaf_link.mavlink.signing import KEY_SIZE, SETUP_SIGNING, setup_in
from risaf_link.mavlink.storage import NO_PLACE, Storage
from risaf_link.mavlink.telemetry import Emitter, heartbeat
from risaf_link.mavlink.tuning import Answer, Tuning

CAPABILITIES = 8 | 16 | 8192
"""MAV_PROTOCOL_CAPABILITY: COMMAND_INT, PARAM_ENCODE_BYTEWISE (REAL32 is the same in both ways, and
one must be told), MAVLINK2."""

TIMESYNC = IDS["TIMESYNC"]
ORDERS = frozenset(
    IDS[name]
    for name in (
        *("HEARTBEAT", "COMMAND_LONG", "COMMAND_INT"),
        *("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "SETUP_SIGNING"),
    )
)
"""Messages that may change what we do."""

HEARD = ORDERS | {TIMESYNC, IDS["COMMAND_ACK"]}
"""Messages that are read here."""


class Estimator(Protocol):
    """What can be done to the estimator from outside."""

    def configure(self, parameters: Any) -> None:
        """Take new parameters, from the next epoch on."""

    def restart(self) -> None:
        """Start the attitude filter anew."""

    def set_bias(self, rate_b: Floats, variance: Floats) -> None:
        """Believe the mean rate, rad/s, of a vehicle at rest."""

    def adopt(self, own: tuple[int, int]) -> None:
        """Take note of our ids."""

    def now_us(self, unix_us: int) -> int:
        """What the clock of the estimates shows, us, at a time since 1970."""


class Component:
    """One component of the vehicle.

    Parameters
    ----------
    parameters : Parameters
        Of a configuration with an `emit`: the rates of links that have none of their own.
    estimator : Estimator
    identity : Identity
    links : mapping
        Link's name to its terms. Frames that its signing rejects must not get here.
    keep : callable or None
        Begins to store parameters, by name, whose end is told by `kept`; None: there is no place.
    requests : Requests or None
        For what the autopilot is asked; None: for nothing.
    listen : callable or None
        Takes every notice as it is told.

    Attributes
    ----------
    trouble : str
        Why there are no estimates, for the operator.
    complaints : dict
        What else may be wrong to what is wrong with it, for the operator; empty: nothing.
    """

    def __init__(
        self,
        parameters: Parameters[Any],
        estimator: Estimator,
        identity: Identity,
        *,
        links: Mapping[str, Terms] | None = None,
        keep: Callable[[dict[str, float]], None] | None = None,
        requests: Requests | None = None,
        listen: Callable[[Notice], None] | None = None,
    ) -> None:
        self.trouble = ""
        self.complaints: dict[str, str] = {}
        self._parameters = parameters
        self._tuned = parameters.tuned
        self._estimator = estimator
        self._identity = identity
        self._links = links or {}
        self._requests = requests or Requests({})
        self._peers = Peers(*identity.own, parameters.tuned.emit, self._links)
        self._peers.feed(identity.profile)
        self._pace = {name: terms.pace for name, terms in self._links.items()}
        self._storage = Storage(parameters, keep)
        self._tuning = Tuning(parameters)
        self._notices = Notices()
        self._told = 0  # notices
        self._listen = listen
        self._outbox: list[tuple[Peer | None, str, dict[str, Any]]] = []  # None: to all
        self._estimate: Estimate | None = None
        self._ahead = 0  # estimates that `observe` will be given
        self._received_us = 0
        self._calibration = GyroCalibration(estimator.set_bias)
        self._pulse = Pulse()
        self._advanced_us: int | None = None
        self._commands: dict[int, Callable[[Order], Result]] = {
            Command.PREFLIGHT_CALIBRATION: self._calibrate,
            Command.PREFLIGHT_STORAGE: self._store,
            Command.PREFLIGHT_REBOOT_SHUTDOWN: self._restart,
            Command.GET_MESSAGE_INTERVAL: self._tell_interval,
            Command.SET_MESSAGE_INTERVAL: self._set_interval,
            Command.REQUEST_MESSAGE: self._request,
        }

    # In

    def receive(self, frame: Frame, peer: Peer, received_us: int) -> None:
        """Take a frame.

        Parameters
        ----------
        frame : Frame
        peer : Peer
            Whom it came from.
        received_us : int
            When, microseconds since 1970.
        """
        own = self._identity.own
        self._received_us = received_us
        self._requests.hear(frame, peer, own)
        if frame.message_id == TIMESYNC:
            answer = timesync.answer_to(frame, own, lambda: self._estimator.now_us(received_us))
            self._outbox += [(peer, "TIMESYNC", answer)] if answer else []
        if frame.message_id not in ORDERS or (frame.system, frame.component) == own:
            return
        if self._identity.hear(frame, received_us):
            self._adopt()
        self._peers.feed(self._identity.profile)
        if frame.message_id == SETUP_SIGNING:
            self._set_up_signing(frame, peer)
        order = order_in(frame, peer)
        if order:
            self._obey(order)
        for told in self._tuning.take(frame, own, peer):
            self._post(told, peer)
        if self._parameters.tuned is not self._tuned:
            self._take_effect()

    def note_traffic(self, table: FrameTable, peer: Peer) -> None:
        """Take note of all that a peer sent, also of what is not handed to `receive`."""
        self._requests.note_traffic(table, peer)

    def note_ahead(self) -> None:
        """Take note that there is an estimate, which `observe` is given later."""
        self._ahead += 1
        self._pulse.note_epoch()

    def observe(self, estimate: Estimate) -> None:
        """Take the next estimate."""
        self._estimate = estimate
        if self._ahead:
            self._ahead -= 1
        else:
            self._pulse.note_epoch()
        self._notices.observe(estimate)
        if self._calibration.is_running:
            self._report(self._calibration.observe(estimate))

    def note_gathered(self, epochs: int, now_us: int) -> bool:
        """Take note of how many epochs have come by now, as `advance` takes the time.

        Returns whether the estimator makes something of them, or none come.
        """
        self._pulse.note_gathered(epochs, now_us)
        return bool(self.trouble) or not self._pulse.is_stuck

    def advance(self, now_us: int, unix_us: int | None = None) -> None:
        """Do what is due by time: HEARTBEAT, notices, lists of parameters, requests.

        Parameters
        ----------
        now_us : int
            Microseconds of a clock that does not jump.
        unix_us : int or None
            Microseconds since 1970; None: the autopilot is not asked for its time.
        """
        seconds = (now_us - self._advanced_us) / 1e6 if self._advanced_us is not None else 0.0
        self._advanced_us = now_us
        if self._pulse.advance(now_us):
            self._outbox.append((None, "HEARTBEAT", heartbeat(self._pulse.state)))
        if self._pulse.has_stalled:
            self._report(self._calibration.end("failed: no samples"))
        self.complaints["ODOMETRY"] = self._peers.complaint(now_us)
        stalled = self._pulse.has_stalled
        for notice in self._notices.due(now_us, stalled, self.trouble, self.complaints):
            self._tell(notice)
        for peer, fields in self._requests.advance(now_us):
            self._outbox.append((peer, "COMMAND_LONG", fields))
        whom = self._requests.due_timesync() if unix_us is not None else None
        if whom and unix_us is not None:
            fields = timesync.request(unix_us, self._identity.component)
            self._outbox.append((whom, "TIMESYNC", fields))
        for peer, answer in self._tuning.due(seconds, self._pace):
            self._outbox.append((peer, answer.name, answer.fields))

    def kept(self, parameters: dict[str, float], failure: str = "") -> None:
        """Take note that parameters were stored, or why they were not."""
        told = self._storage.end(parameters, failure)
        if failure:
            self._tell_not_stored(failure)
        if told:
            self._acknowledge(*told)

    @property
    def status(self) -> str:
        """How it is, in one line."""
        estimate = self._estimate
        if self.trouble or estimate is None:
            return f"no estimates: {self.trouble or 'no samples yet'}"
        if self._pulse.has_stalled:
            return "no estimates: no samples"
        attitude, heading = estimate.attitude, estimate.heading
        yaw, deviation = math.degrees(attitude.euler[2]) % 360.0, math.degrees(attitude.yaw_std)
        told = f"{yaw:.1f} deg +- {deviation:.1f}" if attitude.aligned else "not known yet"
        state = heading.state.name.lower().replace("_", " ")
        return f"heading {told}, {state}; {estimate.fused.valid} sensors"

    def tell(self, notice: Notice) -> None:
        """Tell the operators."""
        self._tell(notice)

    @property
    def is_calibrating(self) -> bool:
        """Whether every estimate must be observed, even if nobody listens."""
        return self._calibration.is_running

    # Out

    def collect(self, peers: Iterable[Peer]) -> list[tuple[Peer, bytes]]:
        """Take the frames that came of what was taken in.

        Parameters
        ----------
        peers : iterable of Peer
            Who can be reached now, and who was just heard. What is for all goes to those of them
            that get anything, once.
        """
        outbox, self._outbox = self._outbox, []
        if not outbox:
            return []
        listening = self._peers.listening(dict.fromkeys(peers))
        return [
            (peer, self._peers.emitter(peer).frame(name, **fields))
            for to, name, fields in outbox
            for peer in (listening if to is None else (to,))
        ]

    def emit(self, estimate: Estimate, peers: Iterable[Peer]) -> list[tuple[Peer, bytes]]:
        """Take the frames that are due to each peer at an estimate."""
        return [(peer, raw) for peer in peers for raw in self._peers.emitter(peer).emit(estimate)]

    def emitters(self, peers: Iterable[Peer]) -> list[Emitter]:
        """What makes the frames of each peer."""
        return [self._peers.emitter(peer) for peer in peers]

    def _post(self, answer: Answer, peer: Peer) -> None:
        """Send an answer; to the one who asked, also where a link is silent else."""
        if answer.to_all:
            self._outbox.append((None, answer.name, answer.fields))
            if self._peers.emitter(peer).rates:
                return
        self._outbox.append((peer, answer.name, answer.fields))

    def _tell(self, notice: Notice) -> None:
        self._told += 1
        for fields in statustexts(notice, self._told):
            self._outbox.append((None, "STATUSTEXT", fields))
        if self._listen:
            self._listen(notice)

    def _adopt(self) -> None:
        """Speak under the vehicle's system id from now on."""
        self._estimator.adopt(self._identity.own)
        self._peers.rename(self._identity.system)

    def _take_effect(self) -> None:
        """Let what was set be in force from the next epoch on."""
        before, self._tuned = self._tuned, self._parameters.tuned
        self._estimator.configure(self._tuned)
        if self._tuned.emit != before.emit:
            self._peers.set_defaults(self._tuned.emit)

    def _set_up_signing(self, frame: Frame, peer: Peer) -> None:
        """Take another key, if it is for us alone and the link is one that may set it."""
        signing, setup = self._links.get(peer[0], ANY).signing, setup_in(frame)
        if signing is None or not signing.takes_setup or setup.to != self._identity.own:
            return
        if setup.secret == bytes(KEY_SIZE):
            self._tell(Notice(Severity.WARNING, "signing key refused: it is all zero"))
        elif self._identity.is_armed(self._received_us):
            self._tell(Notice(Severity.WARNING, "signing key refused: the vehicle is armed"))
        else:
            signing.key.replace(setup.secret, setup.ticks)
            self._tell(Notice(Severity.NOTICE, "signing key set"))

    # Commands

    def _obey(self, order: Order) -> None:
        own = self._identity.own
        if not concerns(order.to, own):
            return
        command = self._commands.get(order.command)
        result = command(order) if command else Result.UNSUPPORTED
        done = result in {Result.ACCEPTED, Result.IN_PROGRESS}
        if done or order.to == own:
            in_progress = result is Result.IN_PROGRESS and command == self._calibrate
            self._acknowledge(order, result, self._calibration.percent if in_progress else 255)

    def _acknowledge(self, order: Order, result: Result, progress: int = 255) -> None:
        self._outbox.append((order.peer, "COMMAND_ACK", order.ack(result, progress)))

    def _set_interval(self, order: Order) -> Result:
        wanted = order.integer
        if wanted is None or self._must_not_tell(wanted):
            return Result.DENIED
        if not self._peers.ask(order.peer, wanted, order.parameters[1]):
            return Result.DENIED
        return Result.ACCEPTED

    def _must_not_tell(self, wanted: int) -> bool:
        return wanted == IDS["ODOMETRY"] and not self._identity.feeds

    def _tell_interval(self, order: Order) -> Result:
        return self._post_interval(order.integer, order)

    def _post_interval(self, wanted: int | None, order: Order) -> Result:
        if wanted is None or not 0 <= wanted < 2**16:  # as MESSAGE_INTERVAL has it
            return Result.DENIED
        fields = {"message_id": wanted, "interval_us": self._peers.interval_us(order.peer, wanted)}
        self._outbox.append((order.peer, "MESSAGE_INTERVAL", fields))
        return Result.ACCEPTED

    def _request(self, order: Order) -> Result:
        wanted = order.integer
        if wanted is None or self._must_not_tell(wanted):
            return Result.DENIED
        if wanted in EMITTED:
            emitter, name = self._peers.emitter(order.peer), EMITTED[wanted]
            if self._estimate is None or not emitter.can_tell(name, self._estimate):
                return Result.TEMPORARILY_REJECTED
            fields = emitter.fields(name, self._estimate)
        elif wanted == IDS["COMPONENT_INFORMATION_BASIC"]:
            fields = self._information()
        elif wanted == IDS["HEARTBEAT"]:
            fields = heartbeat(self._pulse.state)
        elif wanted == IDS["MESSAGE_INTERVAL"]:
            return self._post_interval(whole(order.parameters[1]), order)
        else:
            return Result.DENIED
        self._outbox.append((order.peer, name_of(wanted), fields))
        return Result.ACCEPTED

    def _information(self) -> dict[str, Any]:
        boot_us = self._estimate.boot_us if self._estimate else 0
        return {
            "time_boot_ms": boot_us // 1000 % 2**32,
            "capabilities": CAPABILITIES,
            "time_manufacture_s": 0,
            "vendor_name": "risaf_link",
            "model_name": "gyro array estimator",
            "software_version": __version__,
            "hardware_version": "",
            "serial_number": "",
        }

    def _restart(self, order: Order) -> Result:
        """Start the filter anew, if we are meant: a reboot for all is the autopilot's."""
        autopilot, computer, action, component, *_ = order.told
        for_us = order.to == self._identity.own and autopilot == 1 and not computer and not action
        by_id = action == 1 and component == self._identity.component and not autopilot
        if not (for_us or (by_id and not computer)):
            return Result.DENIED
        if self._identity.is_armed(self._received_us):
            return Result.TEMPORARILY_REJECTED
        self._report(self._calibration.end("ended: the filter restarts"))
        self._estimator.restart()
        self._tell(Notice(Severity.NOTICE, "the filter restarts"))
        return Result.ACCEPTED

    def _store(self, order: Order) -> Result:
        result, is_new = self._storage.obey(order)
        if is_new:
            self._take_effect()
            for peer in {*self._peers.known(), order.peer}:
                self._tuning.list_to(peer)
        if result is Result.FAILED:
            self._tell_not_stored(NO_PLACE)
        return result

    def _tell_not_stored(self, why: str) -> None:
        self._tell(Notice(Severity.ERROR, f"parameters not stored: {why}"))

    def _calibrate(self, order: Order) -> Result:
        wanted = order.told
        if not any(wanted):
            self._report(self._calibration.end("cancelled"))
            return Result.ACCEPTED
        if wanted[0] != 1 or any(wanted[1:]):
            return Result.DENIED
        if self._identity.is_armed(self._received_us) or self._estimate is None:
            return Result.TEMPORARILY_REJECTED
        return self._calibration.begin(order)

    def _report(self, reports: list[Report]) -> None:
        for report in reports:
            if report.notice:
                self._tell(report.notice)
            self._acknowledge(report.order, report.result, report.progress)
