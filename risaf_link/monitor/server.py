"""The web server: one page, and a stream of what it shows.

The stream is of server-sent events, a JSON object each: `view.Update`. A page that reads slowly
gets fewer of them. Nothing goes from the page to the vehicle; what it may say is how a log is
played.
"""

import asyncio
import re
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
from aiohttp import web

from risaf_link.address import shown
from risaf_link.errors import ConfigError
from risaf_link.monitor.source import Source
from risaf_link.monitor.view import View
from risaf_link.publish.visitor import may_ask

PAGE = Path(__file__).parent / "page"
PERIOD_S = 0.1  # from one update to the next
MOST_PAGES = 16  # that are open; a stream of updates each
LARGEST_WISH = 4096  # bytes of what a page may say
ADDRESS = re.compile(r"([0-9]{1,3}):([0-9]{1,3})")  # SYSTEM:COMPONENT
HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Play(msgspec.Struct, forbid_unknown_fields=True):
    """How a log is to be played; what is not said stays."""

    is_paused: bool | None = None
    speed: float | None = None
    seek_us: float | None = None


async def serve(source: Source, host: str, port: int, started: Callable[[str], None]) -> None:
    """Serve the page until cancelled.

    Parameters
    ----------
    source : Source
        It is run here.
    host, port : str, int
        Where; with port 0 the system chooses one.
    started : callable
        Told the page's URL once it is there.

    Raises
    ------
    ConfigError
        If it cannot listen there.
    """
    runner = web.AppRunner(application(source, host), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, host, port).start()
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"--listen {shown(host, port)}: {reason}") from None
        started(f"http://{shown(host, runner.addresses[0][1])}")
        await source.run()
    finally:
        await runner.cleanup()


def application(source: Source, host: str) -> web.Application:
    """Make the page's application."""
    pages = Pages(source, host)
    made = web.Application(middlewares=[pages.check], client_max_size=LARGEST_WISH)
    made.on_response_prepare.append(_add_headers)
    made.router.add_get("/", pages.index)
    made.router.add_get("/updates", pages.updates)
    made.router.add_post("/play", pages.play)
    made.router.add_static("/page", PAGE)
    return made


class Pages:
    """Answers browsers.

    Parameters
    ----------
    source : Source
    host : str
        Where it is served.
    """

    def __init__(self, source: Source, host: str) -> None:
        self._source = source
        self._host = host
        self._open = 0  # streams

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse who was sent by another site, whose name was made to mean this address."""
        if not may_ask(request.headers.get("Host", ""), self._host):
            raise web.HTTPForbidden(text="ask for it by its address, or by this machine's name")
        return await handler(request)

    async def index(self, _: web.Request) -> web.FileResponse:
        """The page."""
        return web.FileResponse(PAGE / "index.html")

    async def updates(self, request: web.Request) -> web.StreamResponse:
        """The stream of what it shows, of the component `of=SYSTEM:COMPONENT` or of the first."""
        if self._open >= MOST_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MOST_PAGES} pages are open already")
        self._open += 1
        try:
            return await self._stream(request)
        finally:
            self._open -= 1

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await response.prepare(request)
        view = View(self._source, _wanted(request))
        try:
            while True:
                await response.write(b"data: " + msgspec.json.encode(view.update()) + b"\n\n")
                await asyncio.sleep(PERIOD_S)
        except ConnectionError:  # the page was closed
            return response

    async def play(self, request: web.Request) -> web.Response:
        """Do with the log what the page asks for."""
        player = self._source.player
        if player is None:
            raise web.HTTPConflict(text="it is live")
        if request.content_type != "application/json":  # another site's page cannot send that
            raise web.HTTPUnsupportedMediaType
        try:
            wish = msgspec.json.decode(await request.read(), type=Play)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise web.HTTPBadRequest(text=str(error)) from None
        if wish.seek_us is not None:
            player.seek(wish.seek_us)
        if wish.speed is not None:
            player.set_speed(wish.speed)
        if wish.is_paused is not None:
            player.is_paused = wish.is_paused
        return web.Response(status=204)


def _wanted(request: web.Request) -> tuple[int, int] | None:
    found = ADDRESS.fullmatch(request.query.get("of", ""))
    return (int(found[1]), int(found[2])) if found else None


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)
