"""MQTT: what is estimated, and what the operator is told, at a broker.

States, which the next one replaces, wait in short queues, from which the oldest is dropped. Events
wait until the broker has acknowledged them: what was under way when a connection broke is sent
again. A broker that is away, slow or refuses is told of once, and tried for ever.

Nothing here may cost the estimator anything: `take` and `tell` put bytes into a queue, two tasks
take them out.
"""

import asyncio
import logging
import math
import random
import time
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from msgspec import Struct

from risaf_link import __version__
from risaf_link.core.estimate import Estimate
from risaf_link.mavlink.notices import Notice
from risaf_link.publish import topics
from risaf_link.publish.access import MqttParameters, broker_of
from risaf_link.publish.account import MqttCounts
from risaf_link.publish.connection import (
    Message,
    NoAnswerError,
    ProtocolRefusedError,
    Session,
    connected,
)
from risaf_link.publish.discovery import discovery

AT_ONCE = 8  # events under way; brokers take 20 and more
OLDEST = 4  # MQTT 3.1.1, as the protocol counts
FAREWELL_S = 2.0  # for what is left to be said at the end

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Pauses:
    """How long until the next attempt, s: doubled at each failure in a row; half is chance."""

    first_s: float = 0.5
    longest_s: float = 30.0


PAUSES = Pauses()


@dataclass(slots=True)
class Topic:
    """A topic that tells of estimates.

    Attributes
    ----------
    published, dropped : int
        Messages that were handed to the system, and that nobody got.
    """

    name: str
    rate: float  # Hz
    make: Callable[[Estimate, int], Struct]
    waiting: deque[bytes]
    last: bytes = b""
    due_s: float = 0.0
    published: int = 0
    dropped: int = 0

    def put(self, payload: bytes) -> None:
        """Let a message wait; the oldest one goes if there is no room."""
        self.dropped += len(self.waiting) == self.waiting.maxlen
        self.waiting.append(payload)
        self.last = payload


class MqttPublisher:
    """Publishes estimates and notices.

    Parameters
    ----------
    parameters : MqttParameters
        With a URL.
    pauses : Pauses
    started_us : int or None
        Microseconds since 1970 at which the service started; None: now.

    Raises
    ------
    ConfigError
        If password, CA or certificate cannot be used.
    """

    def __init__(
        self,
        parameters: MqttParameters,
        pauses: Pauses = PAUSES,
        started_us: int | None = None,
    ) -> None:
        self._broker = broker_of(parameters)
        self._parameters = p = parameters
        self._pauses = pauses
        self._started_us = time.time_ns() // 1000 if started_us is None else started_us
        self._topics = [
            Topic(name, getattr(p.rates, name), make, deque(maxlen=p.states_kept))
            for name, make in topics.STATES.items()
            if getattr(p.rates, name) > 0
        ]
        self.next_s = 0.0 if self._topics else math.inf  # when the first of them is due
        self._events: deque[bytes] = deque()
        self._told = 0
        self._events_published = self._events_dropped = 0
        self._has_states, self._has_events = asyncio.Event(), asyncio.Event()
        self._newest = self._version = 5  # of MQTT, that may be spoken and that is tried next
        self._is_certain = False  # that it is spoken
        self._is_up = self._is_ending = False
        self._connections = 0
        self._up_s: float | None = None  # when the last connection came up
        self._reason = ""  # why there is none, as told last

    def counts(self) -> MqttCounts:
        """What became of it all, as of now."""
        waiting = self._told - self._events_published - self._events_dropped
        told = {topic.name: topic for topic in self._topics}
        return MqttCounts(
            self._is_up,
            self._connections,
            {"events": self._events_published} | {n: t.published for n, t in told.items()},
            {"events": self._events_dropped} | {n: t.dropped for n, t in told.items()},
            {"events": waiting} | {n: len(t.waiting) for n, t in told.items()},
        )

    # In

    def take(self, estimate: Estimate, received_us: int, began_ns: int, done_ns: int) -> None:  # noqa: ARG002
        """Take the next estimate: let those topics wait that are due."""
        elapsed = estimate.elapsed
        if elapsed < self.next_s:
            return
        for topic in self._topics:
            if elapsed >= topic.due_s:
                topic.due_s = (math.floor(elapsed * topic.rate) + 1) / topic.rate
                topic.put(topics.encode(topic.make(estimate, received_us)))
        self.next_s = min(topic.due_s for topic in self._topics)
        self._has_states.set()

    def tell(self, notice: Notice, time_us: int, unix_us: int) -> None:
        """Take what the operator is told: an event."""
        self._told += 1
        times_us = time_us, unix_us, self._started_us
        self._events.append(topics.encode(topics.event(notice, self._told, times_us)))
        self._trim()
        self._has_events.set()

    def _trim(self) -> None:
        """Drop the oldest events beyond what is kept."""
        while len(self._events) > self._parameters.events_kept:
            self._events.popleft()
            self._events_dropped += 1

    # Out

    async def run(self) -> None:
        """Hold a connection to the broker until cancelled, and publish."""
        pause_s = self._pauses.first_s
        while True:
            self._up_s = None
            try:
                await self._hold()
            except ProtocolRefusedError as error:
                if self._version > OLDEST:
                    self._newest = self._version = OLDEST
                    continue
                self._go_down(str(error))
            except OSError as error:
                self._go_down(str(error) or type(error).__name__)
                self._choose_version(error)
            except Exception as error:
                self._go_down(f"an error of ours: {error!r}", error)
            if self._stood_s() >= self._pauses.longest_s:
                pause_s = self._pauses.first_s
            await asyncio.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 no secret
            pause_s = min(2 * pause_s, self._pauses.longest_s)

    def _choose_version(self, error: OSError) -> None:
        """What is tried next: one that does not know MQTT 5 may just be silent."""
        silent = isinstance(error, NoAnswerError) and not self._is_certain
        self._version = OLDEST if silent and self._version > OLDEST else self._newest

    async def _hold(self) -> None:
        """Connect, and publish until the connection is lost."""
        offline = topics.Availability(topics.SCHEMA, "offline")
        will = self._state("availability", topics.encode(offline), 1)
        async with connected(self._broker, will, self._version) as session:
            try:
                await self._publish_all(session)
            except asyncio.CancelledError:
                farewell = asyncio.create_task(self._take_leave(session, will))
                await asyncio.wait([farewell], timeout=FAREWELL_S)
                farewell.cancel()
                await asyncio.wait([farewell])
                raise
            finally:
                self._is_up = False

    async def _publish_all(self, session: Session) -> None:
        """Publish until the connection is lost; when cancelled, first the events that wait."""
        works = session.lost(), self._publish_events(session), self._publish_states(session)
        tasks = lost, events, _ = [asyncio.ensure_future(work) for work in works]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        except asyncio.CancelledError:
            self._is_ending = True
            self._has_events.set()
            await asyncio.wait(
                [lost, events], timeout=FAREWELL_S, return_when=asyncio.FIRST_COMPLETED
            )
            raise
        finally:
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
        _raise_first(ends)

    async def _greet(self, session: Session) -> None:
        """Say that we are there, and once more what was said last: the broker may be a new one."""
        online = topics.Availability(topics.SCHEMA, "online", time.time_ns() // 1000, __version__)
        await session.publish(self._state("availability", topics.encode(online), 1))
        if self._parameters.discovery:
            config = Message(*discovery(self._parameters), qos=1, retain=True)
            await session.publish(config)
        for topic in self._topics:
            if topic.last and not topic.waiting:
                topic.waiting.append(topic.last)
        self._has_states.set()
        self._come_up()

    async def _publish_states(self, session: Session) -> None:
        await self._greet(session)
        while True:
            await self._has_states.wait()
            self._has_states.clear()
            while due := [topic for topic in self._topics if topic.waiting]:
                await _all([self._publish_state(session, topic) for topic in due])

    async def _publish_state(self, session: Session, topic: Topic) -> None:
        payload = topic.waiting.popleft()
        try:
            qos = getattr(self._parameters.qos, topic.name)
            await session.publish(self._state(topic.name, payload, qos))
        except BaseException:
            topic.dropped += 1
            raise
        topic.published += 1

    async def _publish_events(self, session: Session) -> None:
        self._has_events.set()  # some may have been left
        while not self._is_ending:
            await self._has_events.wait()
            self._has_events.clear()
            while self._events:
                await self._publish_some(session)

    async def _publish_some(self, session: Session) -> None:
        """Publish the oldest events; if the broker does not take them all, they wait again."""
        batch = [self._events.popleft() for _ in range(min(len(self._events), AT_ONCE))]
        topic, qos = f"{self._parameters.root}/events", self._parameters.qos.events
        try:
            await _all(
                [session.publish(Message(topic, payload, qos, retain=False)) for payload in batch]
            )
        except BaseException:
            self._events.extendleft(reversed(batch))
            self._trim()
            raise
        self._events_published += len(batch)

    async def _take_leave(self, session: Session, offline: Message) -> None:
        """Say that we go, and go."""
        try:
            await session.publish(offline)
        except OSError:
            return
        await session.leave()

    def _state(self, name: str, payload: bytes, qos: int) -> Message:
        return Message(f"{self._parameters.root}/{name}", payload, qos, retain=True)

    # The log

    def _come_up(self) -> None:
        self._is_up = True
        self._newest, self._is_certain = self._version, True
        self._connections += 1
        self._up_s = asyncio.get_running_loop().time()
        version = "5" if self._version == 5 else "3.1.1"
        _log.info("mqtt: up: %s:%d, MQTT %s", self._broker.host, self._broker.port, version)

    def _go_down(self, reason: str, error: Exception | None = None) -> None:
        """Say why there is no connection, once; with a traceback, if it is an error of ours."""
        if self._up_s is not None or reason != self._reason:
            where = self._broker.host, self._broker.port
            _log.warning("mqtt: down: %s:%d: %s", *where, reason, exc_info=error)
        self._reason = reason

    def _stood_s(self) -> float:
        """How long the last connection stood."""
        return 0.0 if self._up_s is None else asyncio.get_running_loop().time() - self._up_s


async def _all(works: list[Coroutine[Any, Any, None]]) -> None:
    """Do several things at once, all to their end; the first error counts."""
    if len(works) == 1:
        await works[0]
    else:
        _raise_first(await asyncio.gather(*works, return_exceptions=True))


def _raise_first(ends: list[BaseException | None]) -> None:
    for end in ends:
        if isinstance(end, Exception):
            raise end
