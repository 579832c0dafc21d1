"""Real MQTT brokers, each on a port of its own, and what stands between them and a client."""

import asyncio
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from ports import free_port

SAFETY_S = 30.0
TURN_S = 0.005  # from one look at something outside to the next

PUBLISH, SUBACK = 3, 9  # packets

AMQTT = """
import asyncio, logging, sys
from amqtt.broker import Broker
logging.disable(logging.CRITICAL)
async def main():
    listener = {"type": "tcp", "bind": f"127.0.0.1:{sys.argv[1]}"}
    plugin = "amqtt.plugins.authentication.AnonymousAuthPlugin"
    broker = Broker({"listeners": {"default": listener}, "plugins": {plugin: {}}})
    await broker.start()
    await asyncio.Event().wait()
asyncio.run(main())
"""


async def until(condition: Callable[[], Any]) -> None:
    """Wait for something outside of this process, with a deadline."""
    async with asyncio.timeout(SAFETY_S):
        while not condition():
            await asyncio.sleep(TURN_S)


def accepts(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


class Running:
    """A broker in a process of its own, that may be killed and come back on its port."""

    def __init__(self, directory: Path) -> None:
        self.port = free_port(socket.SOCK_STREAM)
        self.directory = directory
        self._process: subprocess.Popen[bytes] | None = None

    def command(self) -> list[str]:
        raise NotImplementedError

    async def start(self) -> None:
        with (self.directory / "broker.log").open("ab") as log:
            self._process = subprocess.Popen(  # noqa: ASYNC220 it is quick
                self.command(), stdout=log, stderr=log
            )
        await until(lambda: accepts(self.port) or self._has_ended())
        assert not self._has_ended(), (self.directory / "broker.log").read_text()

    def kill(self, number: int = signal.SIGKILL) -> None:
        if self._process and self._process.poll() is None:
            self._process.send_signal(number)
            self._process.wait(SAFETY_S)

    def send_signal(self, number: int) -> None:
        self._process.send_signal(number)

    def _has_ended(self) -> bool:
        return self._process is not None and self._process.poll() is not None


class Mosquitto(Running):
    """Debian's broker; lines are added to its configuration."""

    def __init__(self, directory: Path, *lines: str) -> None:
        super().__init__(directory)
        if program() is None:
            assert "CI" not in os.environ, "mosquitto is not installed"
            pytest.skip("mosquitto is not installed: apt-get install mosquitto")
        self.store = directory / "mosquitto.db"
        self._lines = lines or ("allow_anonymous true",)

    def command(self) -> list[str]:
        lines = (
            f"listener {self.port} 127.0.0.1",
            *self._lines,
            "max_queued_messages 100000",
            "queue_qos0_messages true",
            "set_tcp_nodelay true",
            "persistence true",
            f"persistence_location {self.directory}/",
            *(["user root"] if os.geteuid() == 0 else []),
        )
        file = self.directory / "mosquitto.conf"
        file.write_text("\n".join(lines) + "\n")
        return [program(), "-c", str(file)]

    async def store_sessions(self) -> None:
        """Have it store what it must still know after it was killed."""
        self.store.unlink(missing_ok=True)
        self.send_signal(signal.SIGUSR1)
        await until(self.store.exists)


class Amqtt(Running):
    """A broker in Python, which speaks MQTT 3.1.1 alone."""

    def command(self) -> list[str]:
        return [sys.executable, "-c", AMQTT, str(self.port)]


def program() -> str | None:
    return shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")


class Listener:
    """A subscriber that comes back, and that the broker keeps messages for.

    It writes nothing once it has subscribed, so that what a broker sent before it was killed can
    be read to its end.
    """

    def __init__(self, port: int) -> None:
        self.count = 0
        self.connections = 0
        self._port = port
        self._told: defaultdict[str, list[Any]] = defaultdict(list)
        self._retained: defaultdict[str, list[Any]] = defaultdict(list)

    async def __aenter__(self) -> "Listener":
        self._task = asyncio.create_task(self._listen())
        await until(lambda: self.connections or self._task.done())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        assert self._task.cancelled(), self._task.exception()

    def of(self, topic: str) -> list[Any]:
        """What was told under a topic, in order."""
        return self._told[topic]

    def retained(self, topic: str) -> list[Any]:
        """Likewise, what the broker had kept when we came."""
        return self._retained[topic]

    async def _listen(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            with suppress(OSError):
                _, reading = await loop.create_connection(
                    lambda: _Subscription(self._take), "127.0.0.1", self._port
                )
                try:
                    await reading.lost
                finally:
                    reading.transport.abort()
            await asyncio.sleep(TURN_S)

    def _take(self, kind: int, body: bytes) -> None:
        self.connections += kind >> 4 == SUBACK
        if kind >> 4 != PUBLISH:
            return
        end = 2 + int.from_bytes(body[:2])
        number = 2 if kind & 0x06 else 0  # bytes; amqtt gives more service than was asked for
        topic, told = body[2:end].decode(), json.loads(body[end + number :])
        self.count += 1
        self._told[topic.rpartition("/")[2]].append(told)
        if kind & 1:
            self._retained[topic.rpartition("/")[2]].append(told)


class _Subscription(asyncio.Protocol):
    """One connection that subscribes to everything, in MQTT 3.1.1."""

    def __init__(self, take: Callable[[int, bytes], None]) -> None:
        self.lost = asyncio.get_running_loop().create_future()
        self._take = take
        self._data = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        name = b"listener"
        connect = b"\0\4MQTT\4\0\0\0" + len(name).to_bytes(2) + name  # the session stays
        transport.write(bytes([0x10, len(connect)]) + connect + b"\x82\6\0\1\0\1#\0")

    def data_received(self, data: bytes) -> None:
        self._data += data
        while (head := self._head()) and len(self._data) >= sum(head):
            length, size = head
            kind, body = self._data[0], self._data[length : length + size]
            self._data = self._data[length + size :]
            self._take(kind, body)

    def _head(self) -> tuple[int, int] | None:
        """Length of the next packet's head and of its body; None: more must come."""
        size = 0
        for k, byte in enumerate(self._data[1:5]):
            size |= (byte & 0x7F) << 7 * k
            if byte < 0x80:
                return k + 2, size
        return None

    def connection_lost(self, _error: Exception | None) -> None:
        if not self.lost.done():
            self.lost.set_result(None)


class Proxy:
    """Stands between a client and a broker; cuts connections, and stops what comes from clients."""

    def __init__(self, port: int) -> None:
        self.port = 0
        self.connections = 0
        self.flowing = asyncio.Event()
        self.flowing.set()
        self._to = port
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> "Proxy":
        listening = socket.create_server(("127.0.0.1", 0))
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.port = listening.getsockname()[1]
        self._server = await asyncio.start_server(self._meet, sock=listening, limit=4096)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.cut()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def cut(self) -> None:
        """End every connection, whatever is under way."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.add(writer)
        task = asyncio.create_task(self._join(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            back_reader, back_writer = await asyncio.open_connection("127.0.0.1", self._to)
            self._writers.add(back_writer)
            ways = (self._pass(reader, back_writer, True), self._pass(back_reader, writer, False))
            await asyncio.gather(*ways, return_exceptions=True)

    async def _pass(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, held: bool
    ) -> None:
        try:
            while data := await reader.read(1024):
                if held:
                    await self.flowing.wait()
                writer.write(data)
                await writer.drain()
        finally:
            writer.transport.abort()
