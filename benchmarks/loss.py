"""How heading fares on a bad link: datagrams lost, bits turned round, and frames that are wrong.

    python benchmarks/loss.py --scenario drive1 --seeds 5 --plot loss.png

A drive with truth is sent as datagrams, spoiled on the way, and read as the service reads them;
GPS is gone for a part of it. The whole run and the time without GPS are judged apart. A lie is an
epoch whose heading is off by more than three of the standard deviations that were told with it, or
whose time stamp is that of no epoch that was sent: an honest estimate has 0.27 % of them.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from spoiled import BURST, SOURCES, Errors, Receiver, Spoil

from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import EPOCH_START_US, frames

LOSSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
FLIPS = (0.0, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3)
FORGED = (0.0, 1e-5, 1e-4, 1e-3, 1e-2)
CURVES: dict[str, tuple[str, list[Spoil], list[float]]] = {
    "lost": ("lost, each by itself", [Spoil(lost=x) for x in LOSSES], list(LOSSES)),
    "bursts": ("lost in bursts", [Spoil(lost=x, burst=BURST) for x in LOSSES], list(LOSSES)),
    "bits": ("bits turned round", [Spoil(flipped=x) for x in FLIPS], list(FLIPS)),
    "wrong": ("wrong, with a right checksum", [Spoil(forged=x) for x in FORGED], list(FORGED)),
}
Row = dict[str, Any]


def run(
    seed: int, name: str, sensors: int, duration: float | None, curves: Sequence[str]
) -> list[Row]:
    """Spoil the drive of one seed in every way."""
    chosen = scenario(name, seed, sensors=sensors, duration=duration)
    datagrams = list(frames(chosen, SOURCES))
    epochs = round(chosen.duration * chosen.rate)
    rows = []
    for curve in curves:
        _, ways, places = CURVES[curve]
        for way, place in zip(ways, places, strict=True):
            receiver, errors = Receiver(), Errors()
            for time_us, data in way.apply(datagrams, seed):
                errors.note(receiver.take(data, EPOCH_START_US + time_us), time_us)
            verdict = errors.judge(chosen, epochs)
            start, end = chosen.outages[-1] if chosen.outages else (0.0, 0.0)
            outage = verdict.where((start <= verdict.since) & (verdict.since < end))
            counts = receiver.pipeline.assembler.counts
            print(f"{name} {seed}: {curve} {place:g}", file=sys.stderr, flush=True)
            rows.append(
                {"scenario": name, "seed": seed, "curve": curve, "at": place, **asdict(way)}
                | {"rms_deg": verdict.rms_deg, "lies": verdict.lies, "astray": verdict.astray}
                | {"answered": verdict.answered, "worst": float(np.nanmax(verdict.ratio))}
                | {"outage_rms_deg": outage.rms_deg, "outage_lies": outage.lies}
                | {"outage_ratio": float(np.sqrt(np.nanmean(outage.ratio**2)))}
                | {"dropped": dict(receiver.dropped()), "assembler": dict(counts)}
            )
    return rows


def main() -> None:
    """Run all seeds, print the table, and draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenario", default="drive1")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--sensors", type=int, default=60)
    parser.add_argument("--duration", type=float, default=None, help="s")
    parser.add_argument("--curves", nargs="+", choices=CURVES, default=list(CURVES))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    work = partial(
        run,
        name=options.scenario,
        sensors=options.sensors,
        duration=options.duration,
        curves=options.curves,
    )
    seeds = range(options.first, options.first + options.seeds)
    with ProcessPoolExecutor(options.workers) as pool:
        rows = [row for found in pool.map(work, seeds) for row in found]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    table(rows, options.curves)
    if options.plot:
        plot(rows, options.curves, options.plot)


def table(rows: Sequence[Row], curves: Sequence[str]) -> None:
    """Print medians and means over the seeds."""
    print(f"{rows[0]['scenario']}, seeds {sorted({row['seed'] for row in rows})}")
    print(
        f"{'curve':8} {'at':>7} {'answered':>9} {'RMS deg':>8} {'worst':>6} {'lies':>8} "
        f"{'worst seed':>10} | {'outage deg':>10} {'e/s':>5} {'lies':>8} {'e/s max':>7} "
        f"{'astray':>6} dropped"
    )
    for curve in curves:
        for place in CURVES[curve][2]:
            some = [row for row in rows if (row["curve"], row["at"]) == (curve, place)]
            column = {name: np.array([row[name] for row in some]) for name in NUMBERS}
            dropped = sum(sum(row["dropped"].values()) for row in some)
            print(
                f"{curve:8} {place:7.2g} {column['answered'].mean():9.4f} "
                f"{np.median(column['rms_deg']):8.3f} {column['rms_deg'].max():6.2f} "
                f"{100 * column['lies'].mean():7.3f}% {100 * column['lies'].max():9.3f}% | "
                f"{np.median(column['outage_rms_deg']):10.3f} "
                f"{np.sqrt((column['outage_ratio'] ** 2).mean()):5.2f} "
                f"{100 * column['outage_lies'].mean():7.3f}% {column['worst'].max():7.2f} "
                f"{column['astray'].sum():6d} {dropped}",
                flush=True,
            )


NUMBERS = (
    *("rms_deg", "lies", "answered", "worst", "astray"),
    *("outage_rms_deg", "outage_ratio", "outage_lies"),
)


def plot(rows: Sequence[Row], curves: Sequence[str], path: Path) -> None:
    """Draw error, honesty and answers against how bad the way is."""
    from matplotlib import figure as mpl

    made = mpl.Figure(figsize=(4 * len(curves), 9), layout="constrained")
    axes = made.subplots(3, len(curves), squeeze=False, sharex="col", sharey="row")
    for column, curve in enumerate(curves):
        title, _, places = CURVES[curve]
        x = np.array(places)
        for row, (names, label, scale) in enumerate(
            (
                (("rms_deg", "outage_rms_deg"), "RMS of heading error, deg", 1.0),
                (("lies", "outage_lies"), "beyond three sigma, %", 100.0),
                (("answered",), "epochs with a heading, %", 100.0),
            )
        ):
            ax = axes[row, column]
            for name, colour in zip(names, ("#1f77b4", "#d62728"), strict=False):
                values = np.array(
                    [
                        [each[name] for each in rows if (each["curve"], each["at"]) == (curve, p)]
                        for p in places
                    ]
                )
                said = "without GPS" if name.startswith("outage") else "whole run"
                ax.plot(x, scale * values, "o", color=colour, alpha=0.3, ms=3)
                centre = values.mean(axis=1) if row else np.median(values, axis=1)
                ax.plot(x, scale * centre, color=colour, label=said)
            if row == 1:
                ax.axhline(0.3, color="k", ls=":", lw=1)
            if x.max() < 0.1:
                ax.set_xscale("symlog", linthresh=x[1])
            ax.set_ylim(bottom=0)
            ax.grid(alpha=0.3)
            ax.set_ylabel(label if not column else "")
            if not row:
                ax.set_title(title)
            ax.legend(fontsize="small")
    made.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
