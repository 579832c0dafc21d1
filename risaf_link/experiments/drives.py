"""The paper's simulated circle and its drives: figures 5, 9, 10 and 12 to 16."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from risaf_link.experiments.case import Case, scenario_of
from risaf_link.experiments.catalogue import METHODS, SLOW_SEEDS, methods_on, titles
from risaf_link.experiments.figures import (
    colour,
    draw_bars,
    draw_errors,
    draw_headings,
    figure,
    legend,
    shade_outages,
    unwrapped,
)
from risaf_link.experiments.report import Section, Setting, rmses, spread, write
from risaf_link.sweep import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = ("mean", "single", "risaf", "robust", "ours")  # in figures of a course
QUICK_SENSORS = 30


@dataclass(frozen=True)
class Drive:
    """A drive: when GPS is withheld, in full and quick."""

    name: str
    title: str
    says: str
    paper: str
    full: tuple[float, tuple[float, float]]  # duration and outage, s
    quick: tuple[float, tuple[float, float]]
    baseline: float | None = None  # deg, RMSE that the paper reports
    risaf: float | None = None


DRIVES = {
    drive.name: drive
    for drive in (
        Drive(
            "circle",
            "a circle with spikes (fig. 5)",
            "A level circle of 100 m radius at 10 m/s; 1 % of all readings are spikes of 30 deg/s.",
            "the standard EKF diverges, RISAF holds heading and bias; no numbers are given.",
            (300.0, (100.0, 300.0)),
            (60.0, (30.0, 60.0)),
        ),
        Drive(
            "drive1",
            "Drive I, constant speed (fig. 9, 10, 14)",
            "A paved road at constant speed; 1 % spikes, a few biases that run away.",
            "heading RMSE in the outage 10.00 deg with the mean, 3.88 deg with RISAF: 2.6 times.",
            (300.0, (100.0, 300.0)),
            (120.0, (60.0, 120.0)),
            10.00,
            3.88,
        ),
        Drive(
            "drive2",
            "Drive II, an unpaved road (fig. 12, 13, 15)",
            "An unpaved road; 30 % of the sensors are shocked at every bump, to one side, some are "
            "frozen or saturated, and all warm up.",
            "heading RMSE in the outage 55.14 deg with the mean, 9.44 deg with RISAF: 5.8 times.",
            (800.0, (400.0, 650.0)),
            (160.0, (100.0, 160.0)),
            55.14,
            9.44,
        ),
    )
}


def drive(setting: Setting, name: str) -> Section:
    """Run one drive over all seeds, with every method."""
    d = DRIVES[name]
    duration, outage = d.quick if setting.quick else d.full
    names = (*METHODS, *(name for name, _ in setting.own))
    seeds = setting.range(2 if setting.quick else 20)
    cases = [
        Case(
            name,
            seed,
            methods_on(seed, dict(setting.own)),
            (outage,),
            duration=duration,
            sensors=QUICK_SENSORS if setting.quick else None,
            traced=seed == 0,
            own=setting.own,
        )
        for seed in seeds
    ]
    results = setting.sweep.run(cases, name)
    rows: list[Sequence[Any]] = []
    for method, title in _titles(setting, names).items():
        truth, gps = (spread(rmses(results, method, r)) for r in ("truth", "gps"))
        reported = {"mean": d.baseline, "risaf": d.risaf}.get(method)
        rows.append((title, *truth, *gps, "" if reported is None else f"{reported:.2f}"))
    ratio = _ratio(results, "mean", "risaf"), _ratio(results, "mean", "ours")
    head = ["method"]
    head += [
        f"{kind}, {ref}" for ref in ("truth", "GPS") for kind in ("median deg", "25 %", "75 %")
    ]
    section = Section(
        name,
        d.title,
        f"{d.says} {scenario_of(cases[0]).sensors} sensors; GPS heading for {outage[0]:.0f} s, "
        f"then none for {outage[1] - outage[0]:.0f} s. Over {len(seeds)} seeds (slow methods: "
        f"{min(len(seeds), SLOW_SEEDS)}) the mean's RMSE is "
        f"{ratio[0]:.2f} times that of RISAF as printed, and {ratio[1]:.1f} times ours (medians of "
        "ratios).",
        d.paper,
        [*head, "paper, deg"],
        rows,
        {"case": cases[0].parameters(), "seeds": list(seeds)},
        {
            "rmse_deg": {
                method: {ref: rmses(results, method, ref) for ref in ("truth", "gps")}
                for method in names
            },
            "mean_over_risaf": ratio[0],
            "mean_over_ours": ratio[1],
        },
    )
    return write(setting, section, _draw(setting, section, results, names, outage))


def _draw(
    setting: Setting, section: Section, results: Sequence[Row], names: Sequence[str], outage: Any
) -> "Figure":
    called = _titles(setting, names)
    made, axes = figure(6, figsize=(11.0, 21.0))
    (spreads, headings, errors, bias, relative, bars) = axes[:, 0]
    first = results[0]
    shown = [*SHOWN, *(name for name, _ in setting.own)]
    _draw_sensors(spreads, first)
    draw_headings(headings, first, [*shown, "integration"], called)
    draw_errors(errors, first, shown, called)
    _draw_bias(bias, first, shown, called)
    _draw_relative(relative, first)
    for each in (spreads, headings, errors, bias, relative):
        shade_outages(each, [outage])
        each.set(xlabel="time (s)")
        legend(each, scale=4.0)
    draw_bars(bars, names, called, [spread(rmses(results, name)) for name in names])
    bars.set(xlabel="heading RMSE without GPS (deg), median and quartiles")
    spreads.set_title(section.title)
    return made


def _draw_sensors(axes: "Axes", result: Row) -> None:
    """Draw what each sensor alone, integrated, makes of the heading."""
    trace = result["trace"]
    time_s, truth = np.array(trace["time_s"]), unwrapped(trace["yaw"])
    sensors = np.degrees(np.array(trace["sensors"])) + truth[0]
    axes.plot(time_s, sensors, color="0.75", linewidth=0.5)
    axes.plot([], [], color="0.75", label="each sensor, integrated")
    axes.plot(time_s, sensors.mean(axis=1), "k", linewidth=1.2, label="their mean")
    axes.plot(time_s, truth, "r--", linewidth=1.0, label="truth")
    low, high = np.quantile(sensors, (0.02, 0.98))
    low, high = min(low, truth.min()), max(high, truth.max())
    room = 0.1 * (high - low)
    axes.set(ylabel="heading (deg)", ylim=(low - room, high + room))


def _draw_bias(axes: "Axes", result: Row, names: Sequence[str], called: dict[str, str]) -> None:
    time_s = result["trace"]["time_s"]
    biases = [np.degrees(np.array(result["methods"][n]["bias_z"], dtype=float)) for n in names]
    for name, bias in zip(names, biases, strict=True):
        axes.plot(time_s, bias, color=colour(name), linewidth=1.0, label=called[name])
    error = np.degrees(np.array(result["trace"]["bias_z"], dtype=float))
    axes.plot(time_s, error, "k:", linewidth=0.8, label="error of the plain mean, 1 s")
    low, high = np.quantile(np.concatenate([*biases, error]), (0.01, 0.99))
    room = 0.2 * (high - low) + 0.01
    axes.set(ylabel="bias of the fused rate, z (deg/s)", ylim=(low - room, high + room))


def _draw_relative(axes: "Axes", result: Row) -> None:
    """Draw relative biases as RISAF tracks them; the steadiest and the wildest stand out."""
    time_s = result["trace"]["time_s"]
    bias = np.degrees(np.array(result["methods"]["risaf"]["relative_bias"]))
    wildness = bias.std(axis=0)
    axes.plot(time_s, bias, color="0.8", linewidth=0.4)
    for index, shade, word in (
        (int(wildness.argmin()), "tab:green", "steadiest"),
        (int(wildness.argmax()), "tab:red", "wildest"),
    ):
        axes.plot(time_s, bias[:, index], color=shade, linewidth=1.0, label=f"{word}: {index}")
    low, high = np.quantile(bias, (0.002, 0.998))
    room = 0.3 * (high - low)
    axes.set(ylabel="relative bias by RISAF, z (deg/s)", ylim=(low - room, high + room))


def outages(setting: Setting) -> Section:
    """Four sections with GPS first and none afterwards, one after another: figure 16."""
    aided, blind = (10.0, 30.0) if setting.quick else (50.0, 150.0)
    start = 20.0 if setting.quick else 0.0  # so that the vehicle drives
    length = aided + blind
    windows = tuple((start + i * length + aided, start + (i + 1) * length) for i in range(4))
    names = (*SHOWN, *(name for name, _ in setting.own))
    seeds = setting.range(1 if setting.quick else 10)
    cases = [
        Case(
            "drive2",
            seed,
            names,
            windows,
            duration=start + 4 * length,
            sensors=QUICK_SENSORS if setting.quick else None,
            own=setting.own,
        )
        for seed in seeds
    ]
    results = setting.sweep.run(cases, "outages")
    called = _titles(setting, names)
    by_section = {
        method: [
            spread(rmses([result], method)[i] for result in results) for i in range(len(windows))
        ]
        for method in names
    }
    made, axes = figure(1, figsize=(10.0, 4.5))
    width = 0.8 / len(names)
    for i, method in enumerate(names):
        middle, low, high = np.array(by_section[method]).T
        axes[0, 0].bar(
            np.arange(4) + (i - (len(names) - 1) / 2.0) * width,
            middle,
            width,
            yerr=[middle - low, high - middle],
            color=colour(method),
            label=called[method],
            capsize=2,
        )
    axes[0, 0].set(
        yscale="log",
        xticks=range(4),
        xticklabels=[f"section {i + 1}\n{a:.0f} to {b:.0f} s" for i, (a, b) in enumerate(windows)],
        ylabel="heading RMSE without GPS (deg)",
    )
    legend(axes[0, 0])
    section = Section(
        "outages",
        "four outages (fig. 16)",
        f"The unpaved road in four sections: {aided:.0f} s with GPS, {blind:.0f} s without. "
        f"Medians of {len(seeds)} seeds, against truth.",
        "RISAF is below the standard EKF in all four, and even; the EKF is not. No numbers.",
        ["method", *(f"section {i + 1}, deg" for i in range(4))],
        [(called[m], *(middle for middle, _, _ in by_section[m])) for m in names],
        {"case": cases[0].parameters(), "seeds": list(seeds)},
        {"rmse_deg": {method: rmses(results, method) for method in names}},
    )
    return write(setting, section, made)


def _titles(setting: Setting, names: Sequence[str]) -> dict[str, str]:
    called = titles(dict(setting.own))
    return {name: called[name] for name in names}


def _ratio(results: Sequence[Row], above: str, below: str) -> float:
    ratios = np.array(rmses(results, above)) / np.array(rmses(results, below))
    return spread(ratios.tolist())[0]
