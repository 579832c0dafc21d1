"""A page of text over HTTP, for who comes and asks: a Prometheus server.

It is read, never written to. Whoever is slow is waited for apart, and not for long.
"""

import asyncio
import logging
import os
import re
from collections.abc import Awaitable, Callable

from msgspec import Struct

from risaf_link.address import address_in, shown
from risaf_link.errors import ConfigError
from risaf_link.mavlink.allowance import Allowance
from risaf_link.publish.visitor import is_loopback, may_ask

PATH = "/metrics"
PATIENCE_S = 5.0  # with one who asks, all in all
MOST_AT_ONCE = 8  # who ask; more are turned away
LARGEST = 8192  # bytes of a request's head
PAGES_A_SECOND, PAGES_AT_ONCE = 5.0, 20.0  # each takes some milliseconds; a server asks all 15 s
HOST = re.compile(rb"(?im)^host:[ \t]*([^\s]*)[ \t]*\r$")
AGAIN_S = 5.0  # until the port is tried again

_log = logging.getLogger(__name__)


class MetricsParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the service's counters can be read."""

    listen: str = ""


def check(parameters: MetricsParameters, where: str) -> None:
    """Raise ConfigError where there is no such address; `where` stands before it."""
    if parameters.listen and address_in(parameters.listen) is None:
        raise ConfigError(
            f"{where}metrics.listen: found {parameters.listen!r}, expected ADDRESS:PORT, such as "
            "127.0.0.1:9100"
        )


class Page:
    """Serves what a function makes, at one path.

    Parameters
    ----------
    host, port : str, int
        Where it listens; with port 0 the system chooses one.
    make : callable
        Makes the page.
    kind : str
        Its content type.

    Attributes
    ----------
    port : int
        Where it listens in fact, once it does.
    """

    def __init__(
        self, host: str, port: int, make: Callable[[], Awaitable[bytes]], kind: str
    ) -> None:
        self.port = port
        self._host = host
        self._make = make
        self._kind = kind
        self._answering: set[asyncio.Task[None]] = set()
        self._allowance = Allowance(PAGES_A_SECOND, PAGES_AT_ONCE)

    async def run(self) -> None:
        """Serve until cancelled; a port that is taken is tried again."""
        told = ""
        while True:
            try:
                await self._serve()
            except OSError as error:
                reason = os.strerror(error.errno) if error.errno else str(error)
                if reason != told:
                    _log.warning("metrics: down: %s: %s", shown(self._host, self.port), reason)
                told = reason
            await asyncio.sleep(AGAIN_S)

    async def _serve(self) -> None:
        # Started apart: asyncio leaves the socket open if it is cancelled while it does both.
        server = await asyncio.start_server(
            self._meet, self._host, self.port, limit=LARGEST, start_serving=False
        )
        try:
            await server.start_serving()
            self.port = server.sockets[0].getsockname()[1]
            _log.info("metrics: up: http://%s%s", shown(self._host, self.port), PATH)
            await asyncio.get_running_loop().create_future()  # until cancelled
        finally:
            server.close()
            for task in self._answering:
                task.cancel()
            await asyncio.gather(*self._answering, return_exceptions=True)

    def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._answering) >= MOST_AT_ONCE:
            writer.transport.abort()
            return
        task = asyncio.create_task(self._answer(reader, writer))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(PATIENCE_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(await self._response(head))
                writer.close()
                await writer.wait_closed()
        except (OSError, EOFError, asyncio.LimitOverrunError):  # TimeoutError is an OSError
            pass
        except Exception:
            _log.exception("metrics: an error of ours")
        finally:
            writer.transport.abort()

    async def _response(self, head: bytes) -> bytes:
        method, _, rest = head.partition(b"\r\n")[0].partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if method not in {b"GET", b"HEAD"}:
            return _reply("405 Method Not Allowed", "text/plain", b"only GET\n", "Allow: GET, HEAD")
        if path != PATH.encode():
            return _reply("404 Not Found", "text/plain", f"only {PATH}\n".encode())
        asked = HOST.search(head)
        host = asked[1].decode("latin-1") if asked else ""
        if is_loopback(self._host) and not may_ask(host, self._host):
            return _reply("403 Forbidden", "text/plain", b"ask for it by its address\n")
        if not self._allowance.takes(1.0, asyncio.get_running_loop().time()):
            return _reply("429 Too Many Requests", "text/plain", b"ask less often\n")
        reply = _reply("200 OK", self._kind, await self._make())
        return reply if method == b"GET" else reply.partition(b"\r\n\r\n")[0] + b"\r\n\r\n"


def _reply(status: str, kind: str, body: bytes, *more: str) -> bytes:
    lines = [
        f"HTTP/1.1 {status}",
        f"Content-Type: {kind}",
        f"Content-Length: {len(body)}",
        "Connection: close",
        *more,
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body
