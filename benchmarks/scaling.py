"""What an epoch costs against the number of sensors, and a replay against the length of its log.

    pip install .[plot]
    python benchmarks/scaling.py --out scaling.png

The lines are a fixed cost and one for each sensor, or second, fitted to relative errors. Printed
beside them: the exponent at the end, 1 where the cost is a line.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from risaf_link.bench.epoch import METHODS, Samples, samples
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import Floats
from risaf_link.mavlink.tlog import record
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames, record_time_us

SENSORS = (3, 10, 30, 100, 200, 300, 500, 700, 1000)
LENGTHS = (30.0, 60.0, 120.0, 300.0, 600.0)  # s
EPOCH_S, REPEATS = 3.0, 7
COLOURS = dict(zip(METHODS, ("#4477aa", "#ccbb44", "#228833", "#ee6677"), strict=True))


def epoch_us(method: str, given: Samples) -> float:
    """Time of an epoch inside the kernel, us: the best of some runs, for others use the machine."""
    parameters = FusionParameters(method=method)
    estimator = Estimator(parameters, AttitudeParameters(), HeadingParameters())
    taken = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        estimator.advance(given.dt, given.rates_b, given.forces_b)
        taken.append(time.perf_counter() - began)
    return 1e6 * min(taken) / len(given)


def replay_s(path: Path, method: str) -> float:
    """Seconds of a replay, Python's start not counted: the best of three."""
    setting = f"fusion.method={method}"
    command = [sys.executable, "-m", "risaf_link.cli", "replay", path, "--json", "--set", setting]
    found = [json.loads(subprocess.run(command, check=True, stdout=-1).stdout) for _ in range(3)]  # noqa: S603
    return min(each["duration_s"] / each["realtime_factor"] for each in found)


def line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and offset, by least squares of the relative error."""
    terms = np.stack((x, np.ones_like(x)), axis=1)
    slope, offset = np.linalg.lstsq(terms / y[:, np.newaxis], np.ones_like(y), rcond=None)[0]
    return float(slope), float(offset)


def main() -> None:
    """Measure, print and draw."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--out", type=Path, default=Path("scaling.png"))
    asked = options.parse_args()
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    arrays = {n: samples("circle", n, EPOCH_S) for n in SENSORS}
    x = np.array(SENSORS, dtype=float)
    for method in METHODS:
        y = np.array([epoch_us(method, arrays[n]) for n in SENSORS])
        _draw(left, method, x, y)
    left.set(xlabel="gyros", ylabel="us an epoch", title="fusion and filter step")
    with tempfile.TemporaryDirectory() as name:
        logs = [Path(name) / f"{seconds:.0f}.tlog" for seconds in LENGTHS]
        for path, seconds in zip(logs, LENGTHS, strict=True):
            chosen = scenario("circle", 1, sensors=50, duration=seconds)
            stream = frames(chosen)
            path.write_bytes(b"".join(record(record_time_us(t), raw) for t, raw in stream))
        for method in METHODS:
            y = np.array([replay_s(path, method) for path in logs])
            _draw(right, method, np.array(LENGTHS), y)
    right.set(xlabel="log, s", ylabel="s", title="replay of 50 gyros at 100 Hz")
    for axes in (left, right):
        axes.set(xlim=0, ylim=0)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    figure.savefig(asked.out, dpi=120)


def _draw(axes: object, method: str, x: Floats, y: Floats) -> None:
    slope, offset = line(x, y)
    exponent = np.log(y[-1] / y[-3]) / np.log(x[-1] / x[-3])
    print(f"{method:7} {offset:9.4f} + {slope:9.6f} each; exponent at the end {exponent:.2f}", y)
    axes.plot(x, y, "o", color=COLOURS[method], label=method)  # type: ignore[attr-defined]
    ends = np.array([0.0, x[-1]])
    axes.plot(ends, offset + slope * ends, color=COLOURS[method], lw=1)  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
