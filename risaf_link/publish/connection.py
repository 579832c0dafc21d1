"""A connection to an MQTT broker, by aiomqtt, which is imported nowhere else: it takes its time.

A thread resolves the name, connects and shakes hands; all else happens in the event loop. Trouble
of any kind is a ConnectionError that says what it was.
"""

import asyncio
import contextlib
import logging
import re
import socket
import threading
import traceback
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, NoReturn

import aiomqtt
from paho.mqtt.enums import MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from risaf_link.publish.access import Broker

CONNECT_S = 5.0  # for a TCP connection, and for the handshake of TLS
ANSWER_S = 5.0  # for whatever the broker has to answer, and for what is written to leave
LEAVE_S = 1.0  # for a farewell
SEND_BUFFER = 65536  # bytes; what lies in it is not the newest any more
WRONG_PROTOCOL = {1, 132}  # reasons of MQTT 3.1.1 and 5
SOCKET_OPTIONS = (
    (socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER),
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
)
LOST = {MQTTErrorCode.MQTT_ERR_NO_CONN, MQTTErrorCode.MQTT_ERR_CONN_LOST, 128}  # unspecified
NO_ANSWER, TIMED_OUT = "no answer", "Operation timed out"  # our word, and aiomqtt's
MOST_PENDING = 100  # calls; aiomqtt would warn of ten

_quiet = logging.getLogger(f"{__name__}.client")
_quiet.setLevel(logging.CRITICAL + 1)  # what matters is in the exceptions


class ProtocolRefusedError(ConnectionError):
    """The broker does not speak this version of MQTT."""


class NoAnswerError(ConnectionError):
    """Somebody is there, but does not answer."""


@dataclass(frozen=True, slots=True)
class Message:
    """What is published."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class _Client(aiomqtt.Client):
    """A client that can be dropped, and that notices when a broker closes without an answer."""

    def __init__(self, broker: Broker, will: Message, version: int) -> None:
        self.thread_ended = asyncio.Event()
        self._loop_thread = threading.get_ident()
        five = version == 5
        super().__init__(
            broker.host,
            broker.port,
            username=broker.user,
            password=broker.password,
            tls_context=broker.tls,
            identifier=broker.client_id,
            protocol=aiomqtt.ProtocolVersion.V5 if five else aiomqtt.ProtocolVersion.V311,
            clean_session=None if five else True,
            will=aiomqtt.Will(will.topic, will.payload, will.qos, will.retain),
            keepalive=broker.keepalive,
            timeout=ANSWER_S,
            socket_options=SOCKET_OPTIONS,
            logger=_quiet,
        )
        self.pending_calls_threshold = MOST_PENDING
        self._client.connect_timeout = CONNECT_S

    def drop(self) -> None:
        """Close the socket, without a word: the broker then publishes the last will."""
        self._client._sock_close()  # noqa: SLF001 all else would say DISCONNECT
        for future in (self._connected, self._disconnected):
            if future.done() and not future.cancelled():
                future.exception()  # it has been seen

    def _client_connect(self) -> None:
        try:
            super()._client_connect()
        except BaseException as error:
            traceback.clear_frames(error.__traceback__)  # one of them holds a socket open
            raise
        finally:
            self._loop.call_soon_threadsafe(self.thread_ended.set)

    def _on_disconnect(self, *args: Any) -> None:
        if self._connected.done():
            super()._on_disconnect(*args)
        else:  # aiomqtt would go on waiting
            self._connected.set_exception(aiomqtt.MqttError(NO_ANSWER))

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: Any) -> None:
        """Watch for room from now on: a turn later, the number of the socket may be another's."""
        if threading.get_ident() == self._loop_thread:
            self._loop.add_writer(sock.fileno(), self._write)
        else:
            super()._on_socket_register_write(client, userdata, sock)

    def _write(self) -> None:
        try:
            self._client.loop_write()
        except Exception as error:
            if not self._disconnected.done():
                self._disconnected.set_exception(error)


class Session:
    """A connection that stands."""

    def __init__(self, client: _Client) -> None:
        self._client = client

    async def publish(self, message: Message) -> None:
        """Publish, and wait: at QoS 0 until it is written, else until the broker has it.

        Raises
        ------
        ConnectionError
        """
        try:
            await self._client.publish(message.topic, message.payload, message.qos, message.retain)
        except aiomqtt.MqttError as error:
            raise ConnectionError(_reason(error)) from None

    async def lost(self) -> NoReturn:
        """Wait until the connection is lost.

        Raises
        ------
        ConnectionError
            When it is.
        """
        try:
            async for _ in self._client.messages:
                pass
        except aiomqtt.MqttError as error:
            raise ConnectionError(_reason(error.__cause__ or error)) from None
        raise ConnectionError("closed by the broker")

    async def leave(self) -> None:
        """Say goodbye: there is no last will then."""
        with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
            async with asyncio.timeout(LEAVE_S):
                await self._client.__aexit__(None, None, None)


@contextlib.asynccontextmanager
async def connected(broker: Broker, will: Message, version: int) -> AsyncIterator[Session]:
    """Connect, and drop the connection at the end, unless the session has left.

    Parameters
    ----------
    broker : Broker
    will : Message
        What the broker publishes when we vanish.
    version : int
        Of MQTT: 5, or 4 for 3.1.1.

    Raises
    ------
    ConnectionError
        It cannot be had. `ProtocolRefusedError`: not in this version; `NoAnswerError`: there is
        somebody, who does not answer.
    """
    client = _Client(broker, will, version)
    entering = asyncio.ensure_future(client.__aenter__())
    try:
        await asyncio.shield(entering)
        yield Session(client)
    except aiomqtt.MqttCodeError as error:  # the broker's answer
        wrong = _number(error.rc) in WRONG_PROTOCOL
        kind = ProtocolRefusedError if wrong else ConnectionRefusedError
        raise kind(f"refused: {_words(error.rc)}") from None
    except aiomqtt.MqttError as error:
        reason = _reason(error)
        raise (NoAnswerError if reason == NO_ANSWER else ConnectionError)(reason) from None
    finally:
        if not entering.done():  # a thread cannot be interrupted
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(client.thread_ended.wait(), 2 * CONNECT_S)
            entering.cancel()
            await asyncio.wait([entering])
        if not entering.cancelled():
            entering.exception()
        client.drop()


def _reason(error: BaseException) -> str:
    """What went wrong, in a few words."""
    if isinstance(error, aiomqtt.MqttCodeError):
        return "connection lost" if _number(error.rc) in LOST else _words(error.rc)
    text = re.sub(r"^\[Errno -?\d+\] ", "", str(error))
    return NO_ANSWER if text == TIMED_OUT else text or type(error).__name__


def _number(code: ReasonCode | int | None) -> int | None:
    return code.value if isinstance(code, ReasonCode) else code


def _words(code: ReasonCode | int | None) -> str:
    return code.getName() if isinstance(code, ReasonCode) else str(code)
