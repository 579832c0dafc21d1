"""What commands have in common: options, progress, and errors in a line."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

from risaf_link.address import address_in
from risaf_link.errors import RisafError

Command = TypeVar("Command", bound=Callable[..., Any])


class Span(click.ParamType[Any]):
    """A time span, seconds."""

    name = "A:B"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Read it."""
        if isinstance(value, tuple):
            return value
        try:
            start, end = map(float, value.split(":"))
        except ValueError:
            self.fail(f"found {value!r}, expected A:B in seconds, such as 100:300", param, ctx)
        if not 0 <= start < end:
            self.fail(f"found {value!r}, expected 0 <= A < B", param, ctx)
        return start, end


class Address(click.ParamType[Any]):
    """Where to listen."""

    name = "ADDRESS:PORT"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        """Read it."""
        if isinstance(value, tuple):
            return value
        found = address_in(value)
        if found is None:
            self.fail(f"found {value!r}, expected ADDRESS:PORT, such as 0.0.0.0:8765", param, ctx)
        return found


def configured(command: Command) -> Command:
    """Add the options that make a configuration."""
    setting = click.option(
        "--set",
        "settings",
        metavar="KEY=VALUE",
        multiple=True,
        help="Set one key over the configuration, such as fusion.method=mean. Repeatable.",
    )
    file = click.option(
        "--config",
        "config_path",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="A YAML file; config/risaf_link.yaml shows every key.  [default: built-in defaults]",
    )
    return file(setting(command))


def spread(command: Command) -> Command:
    """Add the options that say where many cases run."""
    workers = click.option(
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        help="Processes.  [default: all cores]",
    )
    cluster = click.option(
        "--cluster", metavar="ADDRESS", help="A Dask scheduler (needs the extra `cluster`)."
    )
    return workers(cluster(command))


def selected(command: Command) -> Command:
    """Add the options that choose a part of a log."""
    end = click.option(
        "--end",
        type=click.FloatRange(min=0),
        default=float("inf"),
        metavar="S",
        help="Stop after S seconds of the log.",
    )
    start = click.option(
        "--start",
        type=click.FloatRange(min=0),
        default=0.0,
        metavar="S",
        help="Skip the first S seconds of the log.",
    )
    return start(end(command))


def listening(command: Command) -> Command:
    """Add the option that says where a page is served."""
    return click.option(
        "--listen",
        type=Address(),
        default="127.0.0.1:8765",
        show_default=True,
        help="Where the page is served; on another address than this, everyone there sees it.",
    )(command)


def rooted(command: Command) -> Command:
    """Add the option that says which system is meant."""
    return click.option(
        "--root",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        default="/",
        metavar="DIR",
        help="Root directory of an image, where nothing is started.  [default: this system]",
    )(command)


def interrupted(command: Callable[..., None]) -> Callable[..., None]:
    """Take Ctrl-C for the end that it is, also before the command has quite begun."""

    @wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        with suppress(KeyboardInterrupt):
            command(*args, **kwargs)

    return run


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Say which extra is missing where an import fails."""
    try:
        yield
    except ImportError as error:
        raise RisafError(
            f"needs {error.name}: install risaf-link with the extra `{name}`"
        ) from None


@contextmanager
def progress_over(log: Path) -> Iterator[Callable[[int], None]]:
    """Show a progress bar over the bytes of a log, on a terminal."""
    if not sys.stderr.isatty() or not log.is_file():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(log.name, total=log.stat().st_size)
        yield lambda size: bar.advance(task, size)
