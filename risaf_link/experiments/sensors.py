"""Sensors at rest: figures 1 and 2, and the Allan deviation."""

from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.experiments import board
from risaf_link.experiments.allan import allan_deviation, coefficients
from risaf_link.experiments.figures import figure, legend
from risaf_link.experiments.report import Section, Setting, write
from risaf_link.sim.equipment import CONSUMER_GYROS
from risaf_link.sim.sensors import TriadArray

SHOWN = 0  # the sensor of figure 1
RUN = 60.0  # s, of figure 1
SIMULATED_SENSORS = 20
SIMULATED_RATE = 50.0  # Hz
BEYOND = (3.0, 4.0)  # standard deviations, of tails


class Static(NamedTuple):
    """Two runs at rest of the same sensors."""

    source: str
    runs: tuple[Floats, Floats]  # rad/s, (k, n, 3)
    period: float  # s
    truth: str


def sensors(setting: Setting) -> Section:
    """Show drift, errors and Allan deviation of sensors at rest."""
    static = _recorded() or _simulated(setting.quick)
    first, second = (run[:, :, 2] for run in static.runs)
    made, axes = figure(3, 2, figsize=(13.0, 12.0))
    _draw_drift(axes[0], static)
    errors = (first - second.mean(axis=0)).ravel()
    own = ((first - first.mean(axis=0)) / first.std(axis=0)).ravel()
    tails = _draw_errors(axes[1], errors)
    times, deviations = allan_deviation(first, static.period)
    fits = [coefficients(times, deviation) for deviation in deviations.T]
    axes[2, 0].loglog(times, np.degrees(deviations), color="0.7", linewidth=0.7)
    mean_times, of_mean = allan_deviation(first.mean(axis=1), static.period)
    axes[2, 0].loglog(mean_times, np.degrees(of_mean), "k", label="the array's mean")
    typical = np.sqrt((deviations**2).mean(axis=1))
    axes[2, 0].loglog(times, np.degrees(typical), "r", label="a sensor, root mean square")
    axes[2, 0].set(xlabel="averaging time (s)", ylabel="Allan deviation, z (deg/s)")
    legend(axes[2, 0])
    found = np.degrees(np.array(fits))
    of_array = np.degrees(np.array(coefficients(mean_times, of_mean)))
    axes[2, 1].axis("off")
    rows: list[list[Any]] = [
        [f"sensor {i}", *_units(fit), *np.degrees([first[:, i].mean(), second[:, i].mean()])]
        for i, fit in enumerate(found)
    ]
    means = np.degrees([first.mean(), second.mean()])
    rows.append(["the array's mean", *_units(of_array), *means.tolist()])
    duration = len(first) * static.period
    section = Section(
        "sensors",
        "sensors at rest (fig. 1, 2)",
        f"{static.source}. z axes. Each sensor's bias is taken from the second run and judged in "
        f"the first, as after a calibration: beyond 3 and 4 standard deviations are {tails[0]:.2e} "
        f"and {tails[1]:.2e} of all errors (of Gaussian ones 2.7e-03 and 6.3e-05); of each "
        f"sensor's noise about its own mean, in its own standard deviations, {_beyond(own)[0]:.2e} "
        f"and {_beyond(own)[1]:.2e}. {static.truth} A run is {duration:.0f} s; what does not show "
        "in that time is left empty: no bias instability or rate random walk can be read off a "
        "short record.",
        "a sensor's heading drifts differently in two runs; the array's errors have heavier tails "
        "than Gaussian ones. About 150 sensors; no coefficients are given.",
        [
            "",
            "ARW, deg/sqrt(h)",
            "bias instability, deg/h",
            "rate random walk, deg/h/sqrt(h)",
            "mean of run 1, deg/s",
            "mean of run 2, deg/s",
        ],
        rows,
        {"source": static.source, "period_s": static.period, "seed": 0},
        {"beyond_3_and_4_sigma": tails, "noise_beyond_3_and_4_sigma": _beyond(own)},
    )
    text = "\n".join(
        f"{row[0]:17} ARW {row[1]:6.3f}  BI {row[2]:7.2f}  RRW {row[3]:8.2f}" for row in rows[-9:]
    ).replace("nan", "  -")
    heading = "deg/sqrt(h), deg/h, deg/h/sqrt(h); -: does not show\n\n"
    axes[2, 1].text(0.0, 0.95, heading + text, family="monospace", fontsize=8, va="top")
    made.suptitle(static.source)
    return write(setting, section, made)


def _units(degrees: Floats) -> list[float]:
    """From deg/s/sqrt(Hz), deg/s and deg/s/sqrt(s) to those with hours."""
    arw, instability, walk = degrees.tolist()
    return [60.0 * arw, 3600.0 * instability, 3600.0 * 60.0 * walk]


def _recorded() -> Static | None:
    paths = [board.slice_path(name) for name in board.STATIC]
    if not all(path.exists() for path in paths):
        return None
    first, second = map(board.at_rest, paths)
    source = "The real board MIMU4444 of eight IMUs, two recordings"
    return Static(source, (first, second), board.PERIOD, "The truth is rest.")


def _simulated(quick: bool) -> Static:
    """Two runs of the simulated consumer gyros; the longer they are, the more shows."""
    count = round((120.0 if quick else 1800.0) * SIMULATED_RATE)
    truth = np.zeros((count, 3))
    runs = []
    for run in range(2):
        generator = np.random.default_rng([0, run])
        array = TriadArray(CONSUMER_GYROS, SIMULATED_SENSORS, SIMULATED_RATE, generator)
        runs.append(array.read(truth))
    arw, walk = np.degrees([CONSUMER_GYROS.noise_density, CONSUMER_GYROS.bias_walk])
    told = (
        f"They were simulated with an ARW of {60 * arw:.3f} deg/sqrt(h), no flicker and a rate "
        f"random walk of {216_000 * walk:.0f} deg/h/sqrt(h)."
    )
    source = "A simulation of consumer gyros: there is no recording of the real board here"
    return Static(source, (runs[0], runs[1]), 1.0 / SIMULATED_RATE, told)


def _draw_drift(axes: "Any", static: Static) -> None:
    """Draw figure 1: the rate of one sensor in two runs, and its integral."""
    for number, run in enumerate(static.runs, 1):
        rate = np.degrees(run[: round(RUN / static.period), SHOWN, 2])
        time_s = np.arange(len(rate)) * static.period
        axes[0].plot(time_s, rate, linewidth=0.4, alpha=0.7, label=f"run {number}")
        axes[1].plot(time_s, np.cumsum(rate) * static.period, label=f"run {number}")
    axes[0].set(ylabel="rate at rest, z (deg/s)", xlabel="time (s)")
    axes[1].set(ylabel="its integral (deg)", xlabel="time (s)")
    legend(axes[0])
    legend(axes[1])


def _draw_errors(axes: "Any", errors: Floats) -> tuple[float, float]:
    """Draw figure 2: distribution and quantiles of errors; the shares of the tails."""
    scaled = (errors - errors.mean()) / errors.std()
    normal = NormalDist()
    axes[0].hist(scaled, bins=40, density=True, color="tab:blue", alpha=0.6, label="errors")
    grid = np.linspace(-6, 6, 200)
    axes[0].plot(grid, [normal.pdf(x) for x in grid], "r", label="Gaussian")
    axes[0].set(yscale="log", ylim=(1e-5, 1), xlabel="error, all sensors (standard deviations)")
    ordered = np.sort(scaled)
    chosen = np.unique(np.geomspace(1, len(ordered) // 2, 200).astype(int)) - 1
    chosen = np.unique(np.concatenate([chosen, len(ordered) - 1 - chosen]))
    expected = [normal.inv_cdf((i + 0.5) / len(ordered)) for i in chosen.tolist()]
    axes[1].plot(expected, ordered[chosen], ".", markersize=3, label="errors")
    axes[1].plot(expected, expected, "r", linewidth=0.8, label="Gaussian")
    axes[1].set(xlabel="Gaussian quantile", ylabel="quantile of the errors")
    legend(axes[0])
    legend(axes[1])
    return _beyond(scaled)


def _beyond(scaled: Floats) -> tuple[float, float]:
    sizes = np.abs(scaled)
    return float((sizes > BEYOND[0]).mean()), float((sizes > BEYOND[1]).mean())
