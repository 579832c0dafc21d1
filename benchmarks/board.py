"""The real board of eight IMUs: what calibration and every method of fusion make of it.

    python benchmarks/board.py [DIRECTORY OF mimu4444_array8]

At rest: mean and noise of the fused rate, of raw readings with the mounting put right, and of
calibrated ones; the calibration is from another recording. In motion with saturation: a quarter of
the sensors are set aside, two of the eight at a time; the mean of those, calibrated, judges what
the other six are fused to, where neither of the two is near the end of its range. So the reference
shares no noise with what it judges. Sensors sample up to half a millisecond apart, which at the
50000 deg/s^2 of this recording is some 10 deg/s for each of them, whatever is done.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import mimu4444

from risaf_link.core.calibration import Calibrated, calibrate
from risaf_link.core.fusion import FUSIONS, Epoch, FusionParameters
from risaf_link.core.mounting import Readings
from risaf_link.core.robust import Robust
from risaf_link.core.rotation import matrix_from_quaternion

PERIOD = mimu4444.PERIOD_US / 1e6  # s
METHODS = ("mean", "median", "risaf", "robust")
AT_REST = slice(0, 1400)  # epochs: 22 s, before the board is touched
JUDGED = slice(1875, 3600)  # the second half of the motion; the first calibrates
PAIRS = [(0, 1), (2, 3), (4, 5), (6, 7)]  # one above, one below
NEAR = 0.98  # of the range


def applied(found: Calibrated, rates_s: np.ndarray) -> np.ndarray:
    """Calibrated readings, (k, n, 3)."""
    shape = np.tile(np.eye(3), (len(found.bias), 1, 1))
    shape[:, ~np.eye(3, dtype=bool)] = found.misalignment
    matrix = matrix_from_quaternion(found.mounting) @ (shape * found.scale[:, None, :])
    return np.einsum("nij,knj->kni", matrix, rates_s - found.bias)


def fused(method: str, rates_b: np.ndarray) -> np.ndarray:
    """The array as one gyro, (k, 3)."""
    fusion = {**FUSIONS, "robust": Robust}[method](FusionParameters())
    empty = np.zeros((0, 3))
    return np.array(
        [
            fusion.fuse(Epoch(round(k * mimu4444.PERIOD_US), PERIOD, rates, empty, 0)).rate_b
            for k, rates in enumerate(rates_b)
        ]
    )


def learnt(name: str, part: slice = slice(None)) -> Calibrated:
    """Calibration from a part of a slice."""
    rates = mimu4444.rates(name)[part]
    return calibrate(Readings(np.arange(len(rates)) * PERIOD, rates))


def at_rest(name: str, calibrated_by: str) -> None:
    """Print mean and noise of the fused rate while the board lies still."""
    raw = mimu4444.rates(name)[AT_REST]
    mounted = np.einsum("nij,knj->kni", mimu4444.NOMINAL, raw)
    print(f"\n{name}, at rest {len(raw) * PERIOD:.0f} s; calibrated by {calibrated_by}")
    print(
        f"{'':8}{'raw: mean x, y, z':>26}{'noise':>9}{'calibrated: mean x, y, z':>30}{'noise':>9}"
    )
    single = np.degrees(np.sqrt(mounted.var(axis=0).mean()))
    for method in METHODS:
        line = f"{method:8}"
        for rates in (mounted, applied(learnt(calibrated_by), raw)):
            rate = np.degrees(fused(method, rates))
            mean = " ".join(f"{value:+.3f}" for value in rate.mean(axis=0))
            line += f"{mean:>28}{np.sqrt(rate.var(axis=0).mean()):9.4f}"
        print(line)
    print(f"one sensor's noise, RMS: {single:.4f} deg/s")


def in_motion() -> None:
    """Print how far six fused sensors are from two others, in motion with saturation."""
    raw = mimu4444.rates("exp_5_last")
    found = learnt("exp_5_last", slice(0, JUDGED.start))
    clipped = np.clip(
        mimu4444.counts("exp_5_last") * mimu4444.SCALE, -mimu4444.RANGE, mimu4444.RANGE
    )
    cases = {
        "raw, saturated ones left out": np.einsum("nij,knj->kni", mimu4444.NOMINAL, raw),
        "calibrated, saturated ones left out": applied(found, raw),
        "calibrated, saturated ones believed": applied(found, clipped),
    }
    calibrated = applied(found, raw)
    near = np.abs(np.nan_to_num(raw, nan=mimu4444.RANGE)) > NEAR * mimu4444.RANGE
    print("\nexp_5_last, second half of the motion: RMS from the mean of two sensors set aside")
    print(f"{'':40}" + "".join(f"{method:>9}" for method in METHODS))
    for saturated in (False, True):
        print("epochs with a saturated sensor" if saturated else "epochs without")
        for name, rates in cases.items():
            errors = [rms(rates, calibrated, near, method, saturated) for method in METHODS]
            print(f"  {name:38}" + "".join(f"{error:9.2f}" for error in errors))


def rms(
    rates: np.ndarray, calibrated: np.ndarray, near: np.ndarray, method: str, saturated: bool
) -> float:
    """RMS of one axis, deg/s, over all pairs that are set aside."""
    squares = []
    for pair in PAIRS:
        rest = [i for i in range(8) if i not in pair]
        judged = np.zeros(len(rates), dtype=bool)
        judged[JUDGED] = True
        judged &= ~near[:, pair].any(axis=(1, 2))
        judged &= near[:, rest].any(axis=(1, 2)) == saturated
        error = (fused(method, rates[:, rest]) - calibrated[:, pair].mean(axis=1))[judged]
        squares.append(error[np.isfinite(error).all(axis=1)] ** 2)
    return float(np.degrees(np.sqrt(np.concatenate(squares).mean())))


def main() -> None:
    """Print all tables."""
    if len(sys.argv) > 1:
        mimu4444.BOARD = Path(sys.argv[1])
    for name in ("exp_5_last", "exp_6_first", "exp_5_first"):
        found = learnt(name)
        values = found.before.array, found.after.array, found.before.untimed, found.after.untimed
        before, after, untimed_before, untimed_after = np.degrees(values)
        print(
            f"{name}: sensors differ by {before:.2f} deg/s, calibrated {after:.2f}; without what "
            f"sampling times make {untimed_before:.2f}, calibrated {untimed_after:.2f}"
        )
    at_rest("exp_5_first", calibrated_by="exp_6_first")
    at_rest("exp_6_first", calibrated_by="exp_6_first")
    in_motion()


if __name__ == "__main__":
    main()
