"""Table I: what one step of every method costs, with the heading told after it, measured."""

import hashlib
import platform
import time
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from risaf_link.core.fusion import Epoch
from risaf_link.core.kernel import BUILT
from risaf_link.core.rotation import Floats
from risaf_link.experiments.case import PARTS
from risaf_link.experiments.catalogue import METHODS, make, titles
from risaf_link.experiments.figures import colour, figure, legend
from risaf_link.experiments.method import ArrayModel
from risaf_link.experiments.report import Section, Setting, write
from risaf_link.sweep import Row, program

SENSORS = (3, 10, 30, 100, 150, 300, 1000)
FITTED_FROM = 100  # sensors; below, what does not depend on them counts
SHOWS = 0.2  # share of the time of small arrays that an array must take longer to tell
EPOCHS = 16
NOISE, BIAS = 1.7e-3, 3.5e-3  # rad/s
NO_FORCES = np.zeros((0, 3))


class Timing(Struct, frozen=True):
    """One method, timed over growing arrays until a step takes too long."""

    method: str
    sensors: tuple[int, ...]
    limit: float
    """s; a step that takes longer is the last one that is measured."""
    spent: float
    """s, of measuring one size."""
    own: tuple[tuple[str, str], ...] = ()

    @property
    def key(self) -> str:
        """Name of the result: on this machine, of this program."""
        content = msgspec.json.encode(self) + program(*PARTS).encode() + platform.node().encode()
        return f"cost-{hashlib.sha256(content).hexdigest()[:16]}"

    def run(self) -> Row:
        """Measure: `seconds` of a step, their lower quartile, of sizes that were fast enough."""
        seconds: list[float] = []
        for sensors in self.sensors:
            seconds.append(self._quartile(sensors))
            if seconds[-1] > self.limit:
                break
        return {"sensors": list(self.sensors[: len(seconds)]), "seconds": seconds}

    def _quartile(self, sensors: int) -> float:
        method = make(self.method, ArrayModel(sensors, 100.0, NOISE, BIAS, 5e-5), dict(self.own))
        random = np.random.default_rng(sensors)
        bias = BIAS * random.standard_normal((sensors, 3))
        rates = bias + NOISE * random.standard_normal((EPOCHS, sensors, 3))
        taken: list[float] = []
        began = time.perf_counter()
        number = 0
        while number < 3 or (time.perf_counter() - began < self.spent and number < 4000):
            epoch = Epoch(
                number * 10_000, 0.01 if number else 0.0, rates[number % EPOCHS], NO_FORCES, 0
            )
            start = time.perf_counter()
            method.step(epoch)
            method.estimate()
            taken.append(time.perf_counter() - start)
            number += 1
        return float(np.quantile(taken[1:], 0.25))  # others use the machine too


def exponent(sensors: Floats, seconds: Floats) -> float:
    """Power of the number of sensors by which a step grows.

    Parameters
    ----------
    sensors, seconds : ndarray, shape (k,)
        The least time of arrays below `FITTED_FROM` is what every step takes, and is taken off.

    Returns
    -------
    float
        Slope of the logarithms, from `FITTED_FROM` sensors on; NaN where growth does not show.
    """
    always = seconds[sensors < FITTED_FROM].min()
    grown = seconds - always
    large = (sensors >= FITTED_FROM) & (grown > SHOWS * always)
    if large.sum() < 2:
        return float("nan")
    return float(np.polyfit(np.log(sensors[large]), np.log(grown[large]), 1)[0])


def cost(setting: Setting) -> Section:
    """Time one step of every method."""
    called = titles(dict(setting.own))
    forms = {name: called[name] for name, entry in METHODS.items() if not entry.direct}
    for name, entry in METHODS.items():
        if entry.direct:
            forms[f"{name}:form=direct"] = f"{entry.title}, 3N x 3N"
            forms[f"{name}:form=compact"] = f"{entry.title}, as three"
    forms |= {name: name for name, _ in setting.own}
    sensors = SENSORS[:-2] if setting.quick else SENSORS
    limit, spent = (0.3, 0.15) if setting.quick else (3.0, 1.0)
    timings = [Timing(form, sensors, limit, spent, setting.own) for form in forms]
    results = dict(zip(forms, setting.sweep.run(timings, "cost", alone=True), strict=True))
    made, axes = figure(1, figsize=(10.0, 6.0))
    rows: list[list[Any]] = []
    at_150: dict[str, float] = {}
    for form, title in forms.items():
        size, seconds = (np.array(results[form][key]) for key in ("sensors", "seconds"))
        slope = exponent(size, seconds)
        dashed = "--" if form.endswith("compact") else "-"
        axes[0, 0].plot(
            size,
            1e6 * seconds,
            dashed,
            marker="o",
            markersize=3,
            color=colour(form),
            label=title if np.isnan(slope) else f"{title}: {slope:.1f}",
        )
        times = (1e6 * seconds).tolist() + [float("nan")] * (len(sensors) - len(size))
        rows.append([title, *times, slope, _table(form)])
        at_150 |= {form: float(seconds[size == 150][0])} if 150 in size else {}
    axes[0, 0].set(
        xscale="log",
        yscale="log",
        xlabel="sensors",
        ylabel="one step (us)",
        title="and the exponent of the sensors' number",
    )
    legend(axes[0, 0])
    factor = at_150.get("centralised:form=direct", float("nan")) / at_150["ours"]
    section = Section(
        "cost",
        "cost of a step (table I)",
        f"One core of this machine ({platform.machine()}), gyros alone; lower quartile of the time "
        f"of a step, us. Fusions {'in C++' if BUILT else 'in NumPy'}, all else in NumPy. A method "
        f"whose step took more than {limit:g} s was stopped. The exponent is fitted from "
        f"{FITTED_FROM} sensors on, less the least of smaller ones; it is empty where "
        "growth does not show. "
        f"At 150 sensors the centralised EKF takes {factor:.0f} times as long as ours. "
        "That is the textbook's update, with a matrix of 3N x 3N; since all sensors of an axis "
        "measure the same number, its result can be had as that of three measurements, without "
        "approximation (`as three`): the cubic cost is one of form.",
        "centralised and robust EKF: N^3; variational Bayes: iterations times N^3; RISAF: N log N.",
        ["method", *(f"N = {n}" for n in sensors), "exponent", "paper"],
        rows,
        {"sensors": sensors, "limit_s": limit, "spent_s": spent, "kernel": BUILT},
        {"centralised_over_ours_at_150": factor, "seconds": results},
    )
    return write(setting, section, made)


def _table(form: str) -> str:
    """What the paper's table I says of a method."""
    name, _, how = form.partition(":form=")
    if how == "direct":
        return "iter N^3" if name == "vb" else "N^3" if name != "mmukf" else ""
    return "N log N" if name == "risaf" else ""
