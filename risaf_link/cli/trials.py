"""Commands that measure: the paper's experiments, and how fast it is."""

import json
from pathlib import Path
from typing import Any

import click

from risaf_link.cli.options import spread

GROUPS = ("limits", "epoch", "replay", "log", "live", "start")  # of `bench`


@click.command()
@click.argument("name")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Where figures and numbers go; one that was interrupted goes on from there.",
)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    metavar="N",
    help="At most so many.  [default: 20, fewer in some]",
)
@click.option("--quick", is_flag=True, help="Few seeds, few sensors, short drives.")
@click.option(
    "--method",
    "methods",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE.py",
    help="A method of your own to compare. Repeatable.",
)
@spread
def experiment(name: str, out: Path, **options: Any) -> None:
    """Repeat one of the paper's figures or tables, with every method on the same input.

    NAME is one of `sensors` (fig. 1, 2), `circle` (fig. 5), `montecarlo` (fig. 6), `drive1`
    (fig. 9, 10, 14), `drive2` (fig. 12, 13, 15), `outages` (fig. 16), `faults` (one kind at a
    time), `sensitivity` (section III.B), `cost` (table I), and `all`, which adds a page, index.md.
    Each leaves a PNG, JSON and CSV. Needs the extra `plot`.

    \b
    risaf-link experiment drive1 --out results
    risaf-link experiment all --quick --out results
    risaf-link experiment montecarlo --method mine.py --out results
    """
    from risaf_link.experiments.run import experiment as perform

    for section in perform(name, out, **options):
        click.echo(out / f"{section.name}.png")


@click.command()
@click.option("--quick", is_flag=True, help="Minutes become seconds; the figures spread more.")
@click.option(
    "--only",
    "groups",
    type=click.Choice(GROUPS),
    multiple=True,
    help="One kind of figures: what bounds them all, epochs, replays, logs of autopilots, the live "
    "service, its start. Repeatable.",
)
@click.option(
    "--log",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="LOG.tlog",
    help="A log of an autopilot to read, in place of one that is made.",
)
@click.option(
    "--minutes",
    type=click.FloatRange(min=0, min_open=True),
    metavar="N",
    help="How long 300 gyros are sent at 1 kHz.  [default: 20 s]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench(
    quick: bool, groups: tuple[str, ...], log: Path | None, minutes: float | None, as_json: bool
) -> None:
    """Measure how fast it is on this machine, beside what else there is.

    Every figure has a reference that was measured in the same run: the NumPy form, pymavlink and,
    where they are installed (the extra `bench`), imufusion, vqf and fasttlogparser. Nothing leaves
    127.0.0.1. The live service is measured on Linux.

    \b
    risaf-link bench
    risaf-link bench --quick --only live --json
    risaf-link bench --only live --minutes 10
    """
    from dataclasses import replace

    from rich.console import Console

    from risaf_link.bench import FULL, QUICK
    from risaf_link.bench import bench as measure
    from risaf_link.bench.machine import machine
    from risaf_link.bench.table import as_object, show

    extent = QUICK if quick else FULL
    if minutes:
        extent = replace(extent, fast_s=60.0 * minutes)
    where = machine()
    figures = []
    with Console(stderr=True).status("measuring") as status:
        for figure in measure(extent, groups or GROUPS, log):
            status.update(figure.text)
            figures.append(figure)
    if as_json:
        click.echo(json.dumps(as_object(where, figures)))
    else:
        show(where, figures, Console())
