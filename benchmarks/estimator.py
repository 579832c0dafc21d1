"""How true and how honest the estimate is: scenarios, seeds, faults and methods in one table.

    python benchmarks/estimator.py drive2 --seeds 10 --methods robust risaf median mean
    python benchmarks/estimator.py ekf2 --seeds 10 --set heading.delay=0

Every run is a whole simulation, its frames through the service's own pipeline; all methods are
given the same frames. A row is one method over all seeds: RMS of the heading's error in the outage,
or of the whole run where there is none; RMS of error over stated standard deviation of each angle
over the whole run; and the mean normalised innovation squared of the headings that were fused.
"""

import argparse
import math
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from risaf_link.config import load
from risaf_link.core.rotation import Floats, euler_from_quaternion
from risaf_link.mavlink.frame import FrameParser
from risaf_link.mavlink.truth import truth_of
from risaf_link.pipeline import Pipeline
from risaf_link.sim.scenario import BOOT_US, scenario
from risaf_link.sim.stream import frames

METHODS = ("robust", "risaf", "median", "mean")
Row = tuple[float, float, float, float, float]  # rmse and tilt, deg; error over sigma; NIS


def run(
    case: tuple[int, str], name: str, methods: Iterable[str], settings: Iterable[str]
) -> dict[str, Row]:
    """Run one seed with one choice of faults through every method."""
    seed, faults = case
    chosen = scenario(name, seed, faults=faults.split(","))
    configs = [load(None, [f"fusion.method={method}", *settings]) for method in methods]
    pipelines = [Pipeline(config, config.own) for config in configs]
    estimates: list[dict[int, Floats]] = [{} for _ in pipelines]
    truths: dict[int, Floats] = {}
    nis: list[list[float]] = [[] for _ in pipelines]
    fused = [0] * len(pipelines)
    parser = FrameParser()
    for time_us, raw in frames(chosen):
        for frame in parser.receive_data(raw):
            truth = truth_of(frame)
            if truth is not None and truth.time_us is not None:
                truths[truth.time_us] = truth.q_nb
            for i, pipeline in enumerate(pipelines):
                for estimate in pipeline.step(frame, time_us):
                    attitude, heading = estimate.attitude, estimate.heading
                    if heading.fused_count > fused[i] and heading.innovation:
                        fused[i] = heading.fused_count
                        if not heading.innovation.reset:
                            nis[i].append(heading.innovation.value**2 / heading.innovation.variance)
                    if attitude.aligned:
                        stds = (attitude.roll_std, attitude.pitch_std, attitude.yaw_std)
                        estimates[i][estimate.time_us] = np.array([*attitude.q_nb, *stds])
    outages = chosen.outages or ((0.0, math.inf),)
    return {
        method: _score(estimates[i], truths, outages[-1], nis[i])
        for i, method in enumerate(methods)
    }


def _score(
    estimates: dict[int, Floats],
    truths: dict[int, Floats],
    outage: tuple[float, float],
    nis: list[float],
) -> Row:
    times = sorted(estimates.keys() & truths.keys())
    estimated = np.array([estimates[time] for time in times])
    euler = np.array([euler_from_quaternion(q) for q in estimated[:, :4]])
    truth = np.array([euler_from_quaternion(truths[time]) for time in times])
    error = (euler - truth + math.pi) % (2 * math.pi) - math.pi
    since = (np.array(times) - BOOT_US) / 1e6
    inside = (outage[0] <= since) & (since < outage[1])
    ratio = np.sqrt(((error / estimated[:, 4:]) ** 2).mean(axis=0))
    rmse = np.degrees(np.sqrt((error[inside] ** 2).mean(axis=0)))
    return (
        float(rmse[2]),
        float(rmse[:2].max()),
        float(ratio[:2].max()),
        float(ratio[2]),
        float(np.mean(nis)) if nis else math.nan,
    )


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
