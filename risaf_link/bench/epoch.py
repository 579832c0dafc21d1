"""What an epoch costs: fusion and filter step, in the kernel, from Python, and in NumPy."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from risaf_link.bench.extent import Extent
from risaf_link.bench.figure import Figure, Spread, spread_of
from risaf_link.bench.machine import has
from risaf_link.core import kernel
from risaf_link.core.aiding import Aiding
from risaf_link.core.attitude import AttitudeParameters, AttitudeState
from risaf_link.core.earth import GRAVITY
from risaf_link.core.eskf import Eskf
from risaf_link.core.estimator import FORCE_RESOLUTION, Estimator, step
from risaf_link.core.fusion import Epoch, Fusion, FusionParameters, Mean, Median, Risaf
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.robust import Robust
from risaf_link.core.rotation import Floats
from risaf_link.sim.readings import readings
from risaf_link.sim.scenario import scenario

SEED = 1
RATE = 100.0  # Hz
METHODS = ("mean", "median", "risaf", "robust")
INSIDE_US = {150: 7.0, 300: 14.0}  # the goals, by the number of sensors
CALLED_US = {150: 15.0, 300: 30.0}
STEP_US = 1.0
NUMPY_FORMS: dict[str, Callable[[FusionParameters], Fusion]] = {
    "mean": Mean,
    "median": Median,
    "risaf": Risaf,
    "robust": Robust,
}


@dataclass(frozen=True, slots=True)
class Samples:
    """Readings of k epochs."""

    dt: Floats  # (k,) s
    rates_b: Floats  # (k, n, 3) rad/s
    forces_b: Floats  # (k, m, 3) m/s^2, m may be 0

    def __len__(self) -> int:
        return len(self.dt)

    def first(self, share: float) -> "Samples":
        """The first part of them, at least one epoch."""
        k = max(1, round(share * len(self)))
        return Samples(self.dt[:k], self.rates_b[:k], self.forces_b[:k])


class NumpyForm:
    """The whole step of an epoch without the kernel."""

    def __init__(self, method: str) -> None:
        parameters = FusionParameters(method=method)  # type: ignore[arg-type]
        self._gyros = NUMPY_FORMS[method](parameters)
        self._forces = Robust(FusionParameters(resolution=FORCE_RESOLUTION))
        self._filter = Eskf(AttitudeParameters(), HeadingParameters())
        self._aiding = Aiding()

    def step(self, dt: float, rates_b: Floats, forces_b: Floats) -> AttitudeState:
        """Carry the estimate on by one epoch; shapes (n, 3) and (m, 3)."""
        parts = self._gyros, self._forces, self._filter, self._aiding
        _, state, _ = step(*parts, Epoch(0, dt, rates_b, forces_b, 0))
        return state

    def run(self, samples: Samples) -> None:
        """All epochs, one after another."""
        for each in zip(samples.dt.tolist(), samples.rates_b, samples.forces_b, strict=True):
            self.step(*each)


def samples(name: str, sensors: int, seconds: float) -> Samples:
    """Simulate an array at 100 Hz."""
    blocks = list(readings(scenario(name, SEED, sensors=sensors, duration=seconds, rate=RATE)))
    rates_b = np.concatenate([block.rates_b for block in blocks])
    forces_b = np.concatenate([block.forces_b for block in blocks])
    return Samples(np.full(len(rates_b), 1.0 / RATE), rates_b, forces_b)


def epochs(extent: Extent) -> Iterator[Figure]:
    """Epochs of 150 and of 300 sensors, by every method."""
    for sensors in (150, 300):
        gyros = samples("circle", sensors, extent.epoch_s)
        for method in METHODS:
            yield from _epoch(f"{sensors} gyros, {method}", f"{sensors}_{method}", gyros, extent)
    both = samples("drive1", 150, extent.epoch_s)
    for figure in _epoch("150 gyros and accelerometers, robust", "150_both_robust", both, extent):
        yield replace(figure, goal=None)


def _epoch(text: str, key: str, given: Samples, extent: Extent) -> Iterator[Figure]:
    method, sensors = key.rpartition("_")[2], given.rates_b.shape[1]
    few = given.first(extent.slow_share)
    slow = spread_of(lambda: NumpyForm(method).run(few), min(extent.repeats, 3), 1e6 / len(few))
    if not kernel.BUILT:
        note = "the kernel is not built"
        yield Figure(f"epoch_{key}_inside", f"epoch, {text}", "us", None, "NumPy", slow, note=note)
        return
    estimator = _estimator(method)
    scale = 1e6 / len(given)
    inside = spread_of(lambda: _at_once(estimator, given), extent.repeats, scale)
    called = spread_of(lambda: _one_by_one(estimator, given), extent.repeats, scale)
    yield Figure(
        *(f"epoch_{key}_inside", f"epoch, {text}, inside", "us", inside, "NumPy", slow),
        goal=INSIDE_US[sensors],
    )
    yield Figure(
        *(f"epoch_{key}_called", f"epoch, {text}, from Python", "us", called, "NumPy", slow),
        goal=CALLED_US[sensors],
    )


def _estimator(method: str) -> Estimator:
    parameters = FusionParameters(method=method)  # type: ignore[arg-type]
    return Estimator(parameters, AttitudeParameters(), HeadingParameters())


def _at_once(estimator: Estimator, given: Samples) -> None:
    estimator.advance(given.dt, given.rates_b, given.forces_b)


def _one_by_one(estimator: Estimator, given: Samples) -> None:
    dt, rates_b, forces_b = given.dt, given.rates_b, given.forces_b
    for k in range(len(given)):
        one = slice(k, k + 1)
        estimator.advance(dt[one], rates_b[one], forces_b[one])


def filter_step(extent: Extent) -> Iterator[Figure]:
    """The filter with one IMU, beside other attitude filters: gyro and accelerometer in."""
    given = samples("ekf2", 1, extent.epoch_s)
    gyro = Samples(given.dt, given.rates_b, given.forces_b[:, :0])
    scale = 1e6 / len(given)
    if kernel.BUILT:
        estimator, aided = _estimator("mean"), _estimator("mean")
        step = spread_of(lambda: _at_once(estimator, gyro), extent.repeats, scale)
        inside = spread_of(lambda: _at_once(aided, given), extent.repeats, scale)
        called = spread_of(lambda: _one_by_one(aided, given), extent.repeats, scale)
    else:
        few = gyro.first(extent.slow_share)
        step = spread_of(lambda: NumpyForm("mean").run(few), extent.repeats, 1e6 / len(few))
        few_aided = given.first(extent.slow_share)
        inside = called = spread_of(
            lambda: NumpyForm("mean").run(few_aided), extent.repeats, 1e6 / len(few_aided)
        )
    yield Figure("filter_gyro", "filter step, one gyro, inside", "us", step, goal=STEP_US)
    text = "filter step, gyro and accelerometer"
    batch, note = _vqf_batch(given, extent)
    yield Figure("filter_inside", f"{text}, inside", "us", inside, "vqf", batch, note=note)
    single, note = _imufusion(given, extent)
    against = "imufusion"
    yield Figure("filter_called", f"{text}, from Python", "us", called, against, single, note=note)


def _vqf_batch(given: Samples, extent: Extent) -> tuple[Spread | None, str]:
    if not has("vqf"):
        return None, "vqf is not installed"
    from vqf import VQF

    gyro, force = (np.ascontiguousarray(a[:, 0]) for a in (given.rates_b, -given.forces_b))
    vqf = VQF(1.0 / RATE)
    return spread_of(lambda: vqf.updateBatch(gyro, force), extent.repeats, 1e6 / len(given)), ""


def _imufusion(given: Samples, extent: Extent) -> tuple[Spread | None, str]:
    if not has("imufusion"):
        return None, "imufusion is not installed"
    import imufusion

    ahrs = imufusion.Ahrs()
    ahrs.set_sample_period(1.0 / RATE)
    gyro, force = np.degrees(given.rates_b[:, 0]), -given.forces_b[:, 0] / GRAVITY

    def run() -> None:
        for each in zip(gyro, force, strict=True):
            ahrs.update_no_magnetometer(*each)

    return spread_of(run, extent.repeats, 1e6 / len(given)), ""
