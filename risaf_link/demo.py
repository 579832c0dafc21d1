"""A demonstration without hardware: a simulated vehicle, the service, and the page.

Vehicle and service are processes of their own, the same commands that a person would type; so is
a broker, where mosquitto is installed.
"""

import asyncio
import os
import shutil
import socket
import sys
from asyncio.subprocess import Process
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from typing import Any

from risaf_link.errors import RisafError
from risaf_link.links import open_link
from risaf_link.monitor.server import serve
from risaf_link.monitor.source import Live
from risaf_link.parent import end_with

HOST = "127.0.0.1"
NAME = "demo"  # of the vehicle, at the broker
GROUND_PORT = 14550  # where ground stations listen
BROKER = "listener {port} {host}\nallow_anonymous true\nuser root\n"
"""How mosquitto is configured; one that root starts and that takes another user outlives us."""

END_S = 5.0  # in which a process that was asked to end must do so


async def demo(
    listen: tuple[str, int], seed: int, clock_us: Callable[[], int], tell: Callable[[str], None]
) -> None:
    """Run until cancelled, or until the drive is over.

    Parameters
    ----------
    listen : (str, int)
        Where the page is served.
    seed : int
        Of the drive and its faults.
    clock_us : callable
        Microseconds since 1970.
    tell : callable
        Told line by line what was started.

    Raises
    ------
    RisafError
        If one of the processes fails.
    """
    (vehicle_port, page_port), (broker_port,) = _free_ports(2), _free_ports(1, socket.SOCK_STREAM)
    broker = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
    links = (
        f"{{name: vehicle, url: 'udpin://{HOST}:{vehicle_port}', emit: {{}}}}",
        f"{{name: page, url: 'udpin://{HOST}:{page_port}'}}",
        f"{{name: ground, url: 'udpout://{HOST}:{GROUND_PORT}'}}",
    )
    mqtt = ("--set", f"mqtt.url=mqtt://{HOST}:{broker_port}", "--set", f"mqtt.vehicle={NAME}")
    ours = sys.executable, "-m", "risaf_link.cli"
    commands: dict[str, tuple[str, ...]] = {
        **({"broker": (broker, "-c", "/dev/stdin")} if broker else {}),
        "service": (
            *ours,
            "run",
            "--set",
            f"links=[{', '.join(links)}]",
            *(mqtt if broker else ()),
        ),
        "vehicle": (
            *(*ours, "simulate", "demo", "--seed", str(seed)),
            *("--live", f"udpout://{HOST}:{vehicle_port}"),
        ),
    }
    url = f"udpout://{HOST}:{page_port}"
    async with AsyncExitStack() as started:
        told = {"broker": BROKER.format(port=broker_port, host=HOST)}
        processes = {
            name: await started.enter_async_context(_running(*command, told=told.get(name)))
            for name, command in commands.items()
        }
        tell("service  risaf-link run")
        tell("vehicle  simulated: 120 gyros, shocked at times; some fall silent and come back;")
        tell("         40 s of every 2 minutes without GPS, 15 s of every 4 with a wrong course")
        tell(f"MAVLink  any ground station on UDP port {GROUND_PORT} sees it as well")
        if broker:
            tell(f"MQTT     mosquitto_sub -p {broker_port} -v -t 'risaf/{NAME}/#'")

        def tell_page(page: str) -> None:
            tell(f"page     {page}")
            tell("Ctrl-C ends all of it.")

        shown = Live(url, open_link(url, "page", clock_us), clock_us)
        page = asyncio.create_task(serve(shown, *listen, tell_page))
        await _until_one_ends(page, processes, tell)


async def _until_one_ends(
    page: "asyncio.Task[None]", processes: dict[str, Process], tell: Callable[[str], None]
) -> None:
    ends = {name: asyncio.create_task(p.wait()) for name, p in processes.items()}
    tasks: list[asyncio.Task[Any]] = [page, *ends.values()]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if page.done():
            page.result()
        name, status = next((name, end.result()) for name, end in ends.items() if end.done())
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    if status or name != "vehicle":
        raise RisafError(f"the {name} ended with status {status}")
    tell("The drive is over.")


@asynccontextmanager
async def _running(*command: str, told: str | None) -> AsyncIterator[Process]:
    """Run a command as a process, which ends with the block, and with us.

    Ctrl-C is for us alone: in a group of its own it does not hear of it. One that is told
    something says nothing.
    """
    nowhere = asyncio.subprocess.DEVNULL
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=nowhere if told is None else asyncio.subprocess.PIPE,
        stderr=None if told is None else nowhere,
        process_group=0,
        preexec_fn=partial(end_with, os.getpid()),
    )
    try:
        if process.stdin:
            process.stdin.write((told or "").encode())
            process.stdin.close()
        yield process
    finally:
        with suppress(ProcessLookupError):
            process.terminate()
        try:
            async with asyncio.timeout(END_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()


def _free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    """Ports that nobody uses now."""
    with_ports = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    try:
        for each in with_ports:
            each.bind((HOST, 0))
        return [each.getsockname()[1] for each in with_ports]
    finally:
        for each in with_ports:
            each.close()
