"""How true and how honest the estimate is: scenarios, seeds, faults and methods in one table.

    python benchmarks/estimator.py drive2 --seeds 10 --methods robust risaf median mean
    python benchmarks/estimator.py drive2 --seeds 10 --methods robust oracle
    python benchmarks/estimator.py ekf2 --seeds 10 --set heading.delay=0

Every run is a whole simulation, its frames through the service's own pipeline; all methods are
given the same frames. `oracle` is `robust` told which sensors the faults hit, and without these
from the first sample on: nobody who leaves out faulty sensors can know more. A row is one method
over all seeds: RMS of the heading's error in the outage, or of the whole run where there is none;
RMS of error over stated standard deviation of each angle over the whole run; and the mean
normalised innovation squared of the headings that were fused.
"""

import argparse
import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from risaf_link.config import load
from risaf_link.core.estimate import EstimateBlock
from risaf_link.core.fusion import EpochBlock
from risaf_link.core.rotation import euler_from_quaternion, eulers_of, wraps
from risaf_link.core.track import Track
from risaf_link.mavlink.block import BlockReader
from risaf_link.mavlink.frame import Frame, FrameTable
from risaf_link.mavlink.tlog import Stamps, TlogReader, record
from risaf_link.mavlink.truth import truth_of
from risaf_link.pipeline import Pipeline
from risaf_link.sim.scenario import BOOT_US, Scenario, scenario
from risaf_link.sim.stream import frames, record_time_us

METHODS = ("robust", "risaf", "median", "mean", "oracle")
HIT = math.radians(0.5)  # rad/s by which a fault changes a reading at least once
Row = tuple[float, float, float, float, float]  # rmse and tilt, deg; error over sigma; NIS
Tables = Sequence[tuple[FrameTable, Stamps]]


def run(
    case: tuple[int, str], name: str, methods: Iterable[str], settings: Iterable[str]
) -> dict[str, Row]:
    """Run one seed with one choice of faults through every method."""
    seed, faults = case
    chosen = scenario(name, seed, faults=faults.split(","))
    tables = _tables(chosen)
    truths = dict(_truths(tables))
    outages = chosen.outages or ((0.0, math.inf),)
    rows = {}
    for method in methods:
        known = None
        if method == "oracle":
            known = _hit(tables, _tables(scenario(name, seed, faults=["none"])))
        fusion = "robust" if method == "oracle" else method
        config = load(None, [f"fusion.method={fusion}", *settings])
        blocks = list(_blocks(Pipeline(config, config.own), tables, known))
        rows[method] = _score(blocks, truths, outages[-1])
    return rows


def _tables(chosen: Scenario) -> Tables:
    log = [record(record_time_us(time_us), raw) for time_us, raw in frames(chosen)]
    return list(TlogReader([b"".join(log)]).tables())


def _items(pipeline: Pipeline, tables: Tables) -> Iterator[EpochBlock | tuple[Frame, int]]:
    reader = BlockReader(pipeline.ingest, pipeline.assembler)
    for parts in tables:
        yield from reader.read(*parts)


def _blocks(
    pipeline: Pipeline, tables: Tables, without: NDArray[np.bool_] | None = None
) -> Iterator[EstimateBlock]:
    """Run a log; `without` some sensors, (n,)."""
    for item in _items(pipeline, tables):
        if isinstance(item, EpochBlock):
            if without is not None:
                item.rates_b[:, without] = np.nan
            yield from pipeline.advance(item)
        else:
            yield from pipeline.gather(*item)
    yield from pipeline.flush(0)


def _hit(tables: Tables, sound: Tables) -> NDArray[np.bool_]:
    """Which sensors are hit by a fault, (n,): they read otherwise than without."""
    readings = []
    for each in (tables, sound):
        config = load(None)
        pipeline, epochs = Pipeline(config, config.own), {}
        for item in _items(pipeline, each):
            if isinstance(item, EpochBlock):
                epochs |= dict(zip(item.time_us.tolist(), item.rates_b, strict=True))
            else:
                pipeline.gather(*item)
        readings.append(epochs)
    common = sorted(readings[0].keys() & readings[1].keys())
    faulty, without = (np.array([epochs[time] for time in common]) for epochs in readings)
    differs = ~(np.abs(faulty - without) < HIT)  # true for NaN
    return np.logical_or.reduce(differs, axis=(0, 2))


def _truths(tables: Tables) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Time of each true attitude, us, and its angles."""
    for table, _ in tables:
        for frame in map(table.frame, range(len(table))):
            truth = truth_of(frame)
            if truth is not None and truth.time_us is not None:
                yield truth.time_us, euler_from_quaternion(truth.q_nb)


def _score(
    blocks: list[EstimateBlock],
    truths: dict[int, tuple[float, float, float]],
    outage: tuple[float, float],
) -> Row:
    time_us = np.concatenate([block.time_us for block in blocks])
    values = np.concatenate([block.track.values for block in blocks])
    track = Track(values)
    true = np.array([truths.get(time, (np.nan,) * 3) for time in time_us.tolist()])
    known = track.aligned & np.isfinite(true[:, 0])
    error = wraps(eulers_of(track.q_nb[known]).T - true[known])
    since = (time_us[known] - BOOT_US) / 1e6
    inside = (outage[0] <= since) & (since < outage[1])
    ratio = np.sqrt(((error / track.angle_std[known]) ** 2).mean(axis=0))
    rmse = np.degrees(np.sqrt((error[inside] ** 2).mean(axis=0)))
    nis = _nis(blocks)
    return (
        float(rmse[2]),
        float(rmse[:2].max()),
        float(ratio[:2].max()),
        float(ratio[2]),
        float(np.mean(nis)) if nis else math.nan,
    )


def _nis(blocks: list[EstimateBlock]) -> list[float]:
    """Normalised innovations squared of the headings that were fused."""
    found, count = [], 0
    for heading in (block.heading for block in blocks):
        fresh, count = heading.fused_count > count, heading.fused_count
        if fresh and heading.innovation and not heading.innovation.reset:
            found.append(heading.innovation.value**2 / heading.innovation.variance)
    return found


def main() -> None:
    """Run all cases and print the table."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("scenario")
    options.add_argument("--seeds", type=int, default=10)
    options.add_argument("--first", type=int, default=0, help="the first seed")
    options.add_argument("--methods", nargs="+", default=METHODS[:1], choices=METHODS)
    options.add_argument("--faults", nargs="+", default=["none", "default"])
    options.add_argument("--set", dest="settings", action="append", default=[])
    options.add_argument("--workers", type=int, default=None)
    chosen = options.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    cases = [(seed, faults) for faults in chosen.faults for seed in seeds]
    work = partial(
        run, name=chosen.scenario, methods=tuple(chosen.methods), settings=chosen.settings
    )
    with ProcessPoolExecutor(chosen.workers) as pool:
        rows = dict(zip(cases, pool.map(work, cases), strict=True))
    print(
        f"{chosen.scenario}, {chosen.seeds} seeds from {chosen.first}, {' '.join(chosen.settings)}"
    )
    print(
        f"{'faults':10} {'method':7} {'median':>7} {'worst':>7} {'tilt':>6} "
        f"{'e/s tilt':>8} {'e/s yaw':>8} {'NIS':>5}  heading RMS of each seed, deg"
    )
    for faults in chosen.faults:
        for method in chosen.methods:
            values = np.array([rows[seed, faults][method] for seed in seeds])
            rms = np.sqrt((values[:, 2:4] ** 2).mean(axis=0))
            print(
                f"{faults:10} {method:7} {np.median(values[:, 0]):7.2f} {values[:, 0].max():7.2f} "
                f"{np.median(values[:, 1]):6.2f} {rms[0]:8.2f} {rms[1]:8.2f} "
                f"{np.nanmean(values[:, 4]):5.2f}  {' '.join(f'{v:.2f}' for v in values[:, 0])}"
            )


if __name__ == "__main__":
    main()
