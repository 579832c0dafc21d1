"""Sweeps over spikes, faults and parameters: figure 6, and what section III.B says of alpha."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from risaf_link.experiments.case import Case, scenario_of
from risaf_link.experiments.catalogue import METHODS, SLOW_SEEDS, methods_on, titles
from risaf_link.experiments.drives import QUICK_SENSORS, SHOWN
from risaf_link.experiments.figures import colour, figure, legend
from risaf_link.experiments.report import Section, Setting, rmses, spread, write
from risaf_link.sim.faults import FAULTS

PROBABILITIES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)
ALPHAS = (0.95, 0.98, 0.99, 0.995, 0.999)
GATES = (0.15, 0.2, 0.25, 0.3)
SPIKE_HEAD = "spikes {:g} %, deg"


def montecarlo(setting: Setting) -> Section:
    """Heading RMSE against the probability of spikes: figure 6."""
    probabilities = PROBABILITIES[::2] + PROBABILITIES[-1:] if setting.quick else PROBABILITIES
    duration, outage = (60.0, (30.0, 60.0)) if setting.quick else (150.0, (50.0, 150.0))
    names = (*METHODS, *(name for name, _ in setting.own))
    seeds = setting.range(2 if setting.quick else 10)
    cases = [
        Case(
            "circle",
            seed,
            methods_on(seed, dict(setting.own)),
            (outage,),
            duration=duration,
            sensors=QUICK_SENSORS if setting.quick else None,
            spikes=probability,
            own=setting.own,
        )
        for probability in probabilities
        for seed in seeds
    ]
    results = setting.sweep.run(cases, "montecarlo")
    called = titles(dict(setting.own))
    of = [results[i : i + len(seeds)] for i in range(0, len(results), len(seeds))]
    bands = {name: np.array([spread(rmses(each, name)) for each in of]) for name in names}
    made, axes = figure(1, 2, figsize=(15.0, 5.5), sharey=True)
    percent = 100.0 * np.array(probabilities)
    for axis, shown in zip(axes[0], (SHOWN, [n for n in names if n not in SHOWN]), strict=True):
        for name in shown:
            middle, low, high = bands[name].T
            axis.plot(percent, middle, "o-", color=colour(name), markersize=3, label=called[name])
            axis.fill_between(percent, low, high, color=colour(name), alpha=0.15, linewidth=0)
        axis.set(yscale="log", xlabel="probability of a spike, of each reading (%)")
        axis.legend(fontsize=8)
    axes[0, 0].set_ylabel("heading RMSE without GPS (deg)")
    flat = {name: float(bands[name][:, 0].max() / bands[name][0, 0] - 1.0) for name in names}
    section = Section(
        "montecarlo",
        "Monte Carlo over spikes (fig. 6)",
        f"The circle, {duration - outage[0]:.0f} s without GPS after {outage[0]:.0f} s with it, "
        f"{scenario_of(cases[0]).sensors} sensors; spikes of 30 deg/s to both sides, on all. "
        f"Medians of {len(seeds)} seeds (slow methods: {min(len(seeds), SLOW_SEEDS)}); bands are "
        "quartiles. The last column is by how much the "
        "worst median is above that without spikes.",
        "the standard EKF grows steadily with the probability, RISAF stays low; no numbers.",
        ["method", *(SPIKE_HEAD.format(p) for p in percent), "rises by, %"],
        [(called[n], *bands[n][:, 0].tolist(), 100.0 * flat[n]) for n in names],
        {
            **cases[0].parameters(),
            "probabilities": probabilities,
            "seeds": list(seeds),
        },
        {"rmse_deg": {name: [rmses(each, name) for each in of] for name in names}},
    )
    return write(setting, section, made)


def sensitivity(setting: Setting) -> Section:
    """RISAF over alpha and the gate, on Drive I."""
    alphas = [f"risaf:alpha={alpha},gate=0.2" for alpha in ALPHAS]
    gates = [f"risaf:alpha=0.995,gate={gate}" for gate in GATES]
    names = tuple(dict.fromkeys([*alphas, *gates, "ours"]))
    duration, outage = (120.0, (60.0, 120.0)) if setting.quick else (300.0, (100.0, 300.0))
    sensors = QUICK_SENSORS if setting.quick else None
    seeds = setting.range(1 if setting.quick else 10)
    kinds = {"drive1": duration, "drive2": duration}
    cases = [
        Case(name, seed, names, (outage,), duration=kinds[name], sensors=sensors)
        for name in kinds
        for seed in seeds
    ]
    results = setting.sweep.run(cases, "sensitivity")
    of = dict(zip(kinds, (results[: len(seeds)], results[len(seeds) :]), strict=True))
    made, axes = figure(1, 2, figsize=(12.0, 4.5))
    for kind, shade in zip(kinds, ("tab:blue", "tab:orange"), strict=True):
        for axis, specifications, values in zip(
            axes[0], (alphas, gates), (ALPHAS, GATES), strict=True
        ):
            bands = np.array([spread(rmses(of[kind], each)) for each in specifications])
            places = np.arange(len(values))
            axis.plot(places, bands[:, 0], "o-", color=shade, label=f"RISAF, {kind}")
            axis.fill_between(places, bands[:, 1], bands[:, 2], color=shade, alpha=0.15)
            ours = spread(rmses(of[kind], "ours"))[0]
            axis.axhline(ours, color=shade, linestyle=":", label=f"ours, {kind}")
            axis.set(yscale="log", xticks=places, xticklabels=[f"{value:g}" for value in values])
    axes[0, 0].set(xlabel="alpha, the gates at 20 %", ylabel="heading RMSE without GPS (deg)")
    axes[0, 1].set(xlabel="gate on either side, alpha 0.995")
    legend(axes[0, 1])
    rows = [
        (name.partition(":")[2] or name, *(spread(rmses(of[kind], name))[0] for kind in kinds))
        for name in names
    ]
    section = Section(
        "sensitivity",
        "RISAF's parameters (section III.B)",
        f"RISAF with the paper's filter over alpha and the gate, {outage[1] - outage[0]:.0f} s "
        f"without GPS on both drives' roads. Medians of {len(seeds)} seeds.",
        "the RMSE stays stable for alpha from 0.95 to 0.999 and gates from 15 to 30 %.",
        ["parameters", *(f"{kind}, deg" for kind in kinds)],
        rows,
        {**cases[0].parameters(), "scenario": list(kinds), "seeds": list(seeds)},
        {"rmse_deg": {k: {name: rmses(of[k], name) for name in names} for k in kinds}},
    )
    return write(setting, section, made)


def faults(setting: Setting) -> Section:
    """Every kind of fault alone, on Drive I: where the printed method reaches what it promises."""
    names = (*SHOWN, *(name for name, _ in setting.own))
    duration, outage = (120.0, (60.0, 120.0)) if setting.quick else (300.0, (100.0, 300.0))
    seeds = setting.range(1 if setting.quick else 5)
    kinds = ("none", *FAULTS)
    cases = [
        Case(
            "drive1",
            seed,
            names,
            (outage,),
            duration=duration,
            sensors=QUICK_SENSORS if setting.quick else 100,
            faults=(kind,),
            own=setting.own,
        )
        for kind in kinds
        for seed in seeds
    ]
    results = setting.sweep.run(cases, "faults")
    of = {kind: results[i * len(seeds) : (i + 1) * len(seeds)] for i, kind in enumerate(kinds)}
    called = titles(dict(setting.own))
    medians = {name: [spread(rmses(of[kind], name))[0] for kind in kinds] for name in names}
    made, axes = figure(1, figsize=(12.0, 4.5))
    width = 0.8 / len(names)
    for i, name in enumerate(names):
        places = np.arange(len(kinds)) + (i - (len(names) - 1) / 2.0) * width
        axes[0, 0].bar(places, medians[name], width, color=colour(name), label=called[name])
    axes[0, 0].set(
        yscale="log",
        xticks=range(len(kinds)),
        xticklabels=kinds,
        ylabel="heading RMSE without GPS (deg)",
    )
    legend(axes[0, 0])
    rows: list[Sequence[Any]] = []
    for i, kind in enumerate(kinds):
        row = [medians[name][i] for name in names]
        gain = row[names.index("mean")] / row[names.index("risaf")]
        rows.append((kind, *row, gain))
    section = Section(
        "faults",
        "one kind of fault at a time",
        f"Drive I's road with each fault of the simulation alone, {outage[1] - outage[0]:.0f} s "
        f"without GPS. Medians of {len(seeds)} seeds. The last column is what the printed method "
        "gains over the mean: the paper's 2.6 and 5.8 are to be looked for there.",
        "RISAF is 2.6 (Drive I) and 5.8 (Drive II) times better than the mean.",
        ["fault", *(f"{called[name]}, deg" for name in names), "mean over RISAF"],
        rows,
        {**cases[0].parameters(), "faults": kinds, "seeds": list(seeds)},
        {"rmse_deg": {k: {name: rmses(of[k], name) for name in names} for k in kinds}},
    )
    return write(setting, section, made)
