"""The event loop: which one, until when, and undisturbed."""

import asyncio
import gc
import signal
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from typing import Any


def unix_us() -> int:
    """Microseconds since 1970."""
    return time.time_ns() // 1000


async def until_told(work: Coroutine[Any, Any, None]) -> None:
    """Run until done, or until SIGINT or SIGTERM ask for the end."""
    task = asyncio.ensure_future(work)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    with suppress(asyncio.CancelledError):
        await task


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Choose the event loop: uvloop's where it is installed, which costs less a datagram."""
    try:
        from uvloop import new_event_loop
    except ImportError:
        return None
    made: Callable[[], asyncio.AbstractEventLoop] = new_event_loop
    return made


@contextmanager
def settled() -> Iterator[None]:
    """Let the garbage collector pass over all that is there by now.

    To look through it takes 10 ms, in which an epoch would wait; what comes and goes with each
    epoch is looked through in microseconds.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
