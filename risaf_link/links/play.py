"""Frames with times, sent over a link as time goes by."""

import asyncio
from collections.abc import Iterable

from risaf_link.links.link import Link, Worth

POLL_S = 0.01
LINGER_S = 0.2  # for what the link's buffer still holds at the end


async def play(frames: Iterable[tuple[int, bytes]], link: Link) -> None:
    """Send each frame at its time, from the moment at which the link is up.

    A link that cannot keep up drops frames and counts them; time goes on.

    Parameters
    ----------
    frames : iterable of (int, bytes)
        Times in microseconds, never going back, and frames.
    link : Link
        It is run here.
    """
    async with asyncio.TaskGroup() as tasks:
        running = tasks.create_task(link.run(lambda _data, _peer: Worth.NOTHING))
        while not link.counts.connections:  # noqa: ASYNC110 a link tells only by its counts
            await asyncio.sleep(POLL_S)
        await _send(frames, link)
        await asyncio.sleep(LINGER_S)
        running.cancel()


async def _send(frames: Iterable[tuple[int, bytes]], link: Link) -> None:
    now = asyncio.get_running_loop().time
    began: float | None = None
    for time_us, raw in frames:
        began = now() - time_us / 1e6 if began is None else began
        wait = began + time_us / 1e6 - now()
        if wait > 0:
            await asyncio.sleep(wait)
        link.send(raw)
