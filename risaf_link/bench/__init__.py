"""How fast it is on this machine: figures beside their references, measured in the same run."""

import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

from risaf_link.bench import epoch, limits, live, reading
from risaf_link.bench.extent import FULL, QUICK, Extent
from risaf_link.bench.figure import Figure


def bench(extent: Extent, groups: Collection[str], log: Path | None = None) -> Iterator[Figure]:
    """Measure.

    Parameters
    ----------
    extent : Extent
    groups : collection of str
        Some of `limits`, `epoch`, `replay`, `log`, `live`, `start`.
    log : Path or None
        A mixed tlog; None: one is made.

    Yields
    ------
    Figure
        As soon as it is known.
    """
    if "limits" in groups:
        yield from limits.limits(extent)
    if "epoch" in groups:
        yield from epoch.epochs(extent)
        yield from epoch.filter_step(extent)
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        if "replay" in groups:
            yield from reading.replays(extent, directory)
        if "log" in groups:
            yield from reading.mixed(extent, directory, log)
    if "live" in groups:
        yield from live.at_100_hz(extent)
        yield from live.at_1_khz(extent)
    if "start" in groups:
        yield from live.start(extent)


__all__ = ["FULL", "QUICK", "Extent", "Figure", "bench"]
