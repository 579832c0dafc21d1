"""A hand-held IMU, simulated: inclination by the error-state filter, by VQF and by imufusion.

The motion is like that of the Berlin data set for orientation estimation (Laidig, Caruso, Cereatti
and Seel, "BROAD: A Benchmark for Robust Inertial Orientation Estimation", Data 6(7), 72, 2021):
286 Hz, rests of 10 s between motions, slow and fast, some of it with taps on the casing. Nobody
tells a speed; every filter runs with its defaults on the same readings of one IMU.

    pip install .[bench]
    python benchmarks/handheld.py --seeds 10
"""

import argparse
import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import Pool

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt

from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.earth import GRAVITY
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import Floats, matrix_from_quaternion

RATE = 286.0  # Hz
FINE = 8  # steps of the truth a sample
REST, MOTION = 10.0, 20.0  # s each, in turn
SECONDS = 100.0
SETTLED = 2.0  # s, from which on errors count
LOW_PASS = 100.0  # Hz, of the sensors where they sample an instant

GYRO_NOISE = math.radians(0.1)  # rad/s a sample
GYRO_BIAS = np.radians([0.2, 0.5])  # rad/s, the range of its size on each axis
SCALE_ERROR, MISALIGNMENT = 0.003, math.radians(0.3)  # standard deviations
ACCEL_NOISE, ACCEL_BIAS = 0.05, 0.05  # m/s^2; a sample, and the standard deviation over units

FLIP = np.array([1.0, -1.0, -1.0])  # forward-right-down to forward-left-up, and back


@dataclass(frozen=True, slots=True)
class Kind:
    """A way of moving."""

    rate: float  # rad/s, largest
    acceleration: float  # m/s^2, standard deviation on each axis
    taps: bool


KINDS = {
    "slow": Kind(math.radians(300.0), 1.5, False),
    "fast": Kind(math.radians(1400.0), 4.0, False),
    "tapping": Kind(math.radians(300.0), 1.5, True),
    "fast tapping": Kind(math.radians(1400.0), 4.0, True),
}
SAMPLINGS = ("mean", "instant")  # over the sample interval, or of a low-pass at its end


@dataclass(frozen=True, slots=True)
class Trial:
    """What an IMU reads, and the truth."""

    rates_b: Floats  # (n, 3) rad/s
    forces_b: Floats  # (n, 3) m/s^2
    down_b: Floats  # (n, 3) the vertical in body axes
    moving: Floats  # (n,) 0 at rest, 1 in motion


def trial(kind: Kind, sampling: str, seed: int, seconds: float = SECONDS) -> Trial:
    """Simulate one."""
    generator = np.random.default_rng(seed)
    fine = RATE * FINE
    time = np.arange(round(seconds * fine)) / fine
    moving = _envelope(time)
    rate_b = _wander(generator, (0.15, 2.0), fine, len(time)) * moving[:, None]
    rate_b *= kind.rate / np.linalg.norm(rate_b, axis=1).max()
    sway_n = _wander(generator, (0.5, 2.0), fine, len(time))
    sway_n *= kind.acceleration / np.gradient(np.gradient(sway_n, axis=0), axis=0).std() / fine**2
    place_n = sway_n * moving[:, None]
    if kind.taps:
        knock_n, ring_b = _taps(generator, time, moving)
        place_n, rate_b = place_n + knock_n, rate_b + ring_b
    quaternions = _integrated(rate_b / fine, generator)
    matrix_nb = matrix_from_quaternion(quaternions)
    place_n += matrix_nb @ generator.normal(0.0, 0.05, 3)  # m, from the hand to the IMU
    force_n = np.gradient(np.gradient(place_n, axis=0), axis=0) * fine**2 - [0.0, 0.0, GRAVITY]
    force_b = np.einsum("kji,kj->ki", matrix_nb, force_n)
    rates_b, forces_b, late = _sampled(rate_b, sampling), _sampled(force_b, sampling), 0
    if sampling == "instant":  # the rate counts for the sample before; the low-pass is late
        late = round(math.sqrt(2.0) / (2.0 * math.pi * LOW_PASS) * fine - FINE / 2)
    instants = np.clip(np.arange(FINE - 1, len(time), FINE) - late, 0, len(time) - 1)
    low, high = GYRO_BIAS
    bias = generator.uniform(low, high, 3) * generator.choice([-1.0, 1.0], 3)
    return Trial(
        _misread(rates_b, bias, GYRO_NOISE, generator),
        _misread(forces_b, generator.normal(0.0, ACCEL_BIAS, 3), ACCEL_NOISE, generator),
        matrix_nb[instants, 2],
        moving[instants],
    )


def _envelope(time: Floats) -> Floats:
    """0 at rest, 1 in motion, half a second from one to the other."""
    phase = time % (REST + MOTION)
    rise = np.clip(np.minimum(phase - REST, REST + MOTION - phase) / 0.5, 0.0, 1.0)
    return rise**3 * (10.0 - 15.0 * rise + 6.0 * rise**2)


def _wander(generator: np.random.Generator, band: Sequence[float], rate: float, n: int) -> Floats:
    """Three processes within a band of frequencies, Hz, shape (n, 3)."""
    coarse = int(rate / 40.0)  # the band is far below 40 Hz
    few = generator.standard_normal((n // coarse + 400, 3))
    sos = butter(3, band, "bandpass", fs=rate / coarse, output="sos")
    slow = sosfiltfilt(sos, few, axis=0)[200:]
    sos = butter(3, 8.0, fs=rate, output="sos")  # takes the steps out
    wanted: Floats = sosfiltfilt(sos, np.repeat(slow, coarse, axis=0)[:n], axis=0)
    return wanted


def _taps(generator: np.random.Generator, time: Floats, moving: Floats) -> tuple[Floats, Floats]:
    """Displacement, m, NED, and rates, rad/s, body, of taps on the casing while it moves."""
    place_n, angle_b = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    start = 0.0
    while start < time[-1] - 1.0:
        start += generator.uniform(0.3, 1.2)
        first = int(np.searchsorted(time, start))
        if first >= len(time) or moving[first] < 1.0:
            continue
        since = time[first : first + int(0.6 / (time[1] - time[0]))] - time[first]
        turn = 2.0 * math.pi * generator.uniform(30.0, 200.0)  # rad/s, of the casing's ringing
        fade = generator.uniform(0.005, 0.02)  # s
        ringing = (1.0 - np.exp(-((since / 1e-3) ** 2))) * np.exp(-since / fade)
        ringing *= np.sin(turn * since)
        shock = generator.uniform(10.0, 100.0)  # m/s^2
        push = generator.uniform(0.02, 0.2) * since * np.exp(-since / 0.05)  # the hand gives way
        axis, twist = generator.normal(size=(2, 3))
        stretch = slice(first, first + len(since))
        axis /= np.linalg.norm(axis)
        place_n[stretch] += np.multiply.outer(shock / turn**2 * ringing + push, axis)
        rings = generator.uniform(0.5, 5.0) / turn * ringing  # rad
        sways = generator.uniform(0.1, 1.0) * since * np.exp(-since / 0.05)
        angle_b[stretch] += np.multiply.outer(rings + sways, twist / np.linalg.norm(twist))
    return place_n, np.gradient(angle_b, time[1] - time[0], axis=0)


def _integrated(turns: Floats, generator: np.random.Generator) -> Floats:
    """Attitudes after each of the turns, rotation vectors, shape (n, 3); the first is any."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    q = np.concatenate(
        [np.cos(angle / 2.0), np.sinc(angle / (2.0 * math.pi)) / 2.0 * turns], axis=1
    )
    first = generator.normal(size=4)
    q[0] = first / np.linalg.norm(first)
    step = 1
    while step < len(q):  # a product of all until each, by doubling
        q[step:] = _product(q[:-step], q[step:])
        step *= 2
    unit: Floats = q / np.linalg.norm(q, axis=1, keepdims=True)
    return unit


def _product(p: Floats, q: Floats) -> Floats:
    """Hamilton products, shape (n, 4)."""
    a, b, c, d = p.T
    w, x, y, z = q.T
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(parts, axis=1)


def _sampled(values: Floats, sampling: str) -> Floats:
    """Readings of ideal sensors."""
    if sampling == "mean":
        n = len(values) // FINE * FINE
        means: Floats = values[:n].reshape(-1, FINE, 3).mean(axis=1)
        return means
    numerator, denominator = butter(2, LOW_PASS, fs=RATE * FINE)
    passed: Floats = lfilter(numerator, denominator, values, axis=0)[FINE - 1 :: FINE]
    return passed


def _misread(values: Floats, bias: Floats, noise: float, generator: np.random.Generator) -> Floats:
    scale = np.eye(3) * (1.0 + generator.normal(0.0, SCALE_ERROR, 3))
    scale += (1.0 - np.eye(3)) * generator.normal(0.0, MISALIGNMENT, (3, 3))
    read: Floats = values @ scale.T + bias + generator.normal(0.0, noise, values.shape)
    return read


def by_eskf(one: Trial) -> Floats:
    """Verticals in body axes, shape (n, 3), by the package's own chain."""
    estimator = Estimator(FusionParameters(), AttitudeParameters(), HeadingParameters())
    dt = np.full(len(one.rates_b), 1.0 / RATE)
    dt[0] = 0.0
    track, _ = estimator.advance(dt, one.rates_b[:, np.newaxis], one.forces_b[:, np.newaxis])
    return matrix_from_quaternion(track.q_nb)[:, 2]


def by_vqf(one: Trial) -> Floats:
    """Verticals in body axes, shape (n, 3), by VQF."""
    from vqf import VQF

    readings = [np.ascontiguousarray(values * FLIP) for values in (one.rates_b, one.forces_b)]
    q = VQF(1.0 / RATE).updateBatch(*readings)["quat6D"]
    return -matrix_from_quaternion(q)[:, 2] * FLIP


def by_imufusion(one: Trial) -> Floats:
    """Verticals in body axes, shape (n, 3), by imufusion."""
    import imufusion

    ahrs = imufusion.Ahrs()
    ahrs.set_sample_period(1.0 / RATE)
    downs = np.empty_like(one.down_b)
    for k, (rate_b, force_b) in enumerate(zip(one.rates_b, one.forces_b, strict=True)):
        ahrs.update_no_magnetometer(np.degrees(rate_b * FLIP), force_b * FLIP / GRAVITY)
        downs[k] = -np.asarray(ahrs.get_gravity()) * FLIP
    return downs


RIVALS = {"vqf": by_vqf, "imufusion": by_imufusion}
INSTALLED = {name: by for name, by in RIVALS.items() if importlib.util.find_spec(name)}
METHODS: dict[str, Callable[[Trial], Floats]] = {"eskf": by_eskf, **INSTALLED}


def errors(one: Trial, downs_b: Floats) -> Floats:
    """Inclination errors, deg, shape (n,)."""
    sines = np.linalg.norm(np.cross(downs_b, one.down_b), axis=1)
    angle: Floats = np.degrees(np.arctan2(sines, (downs_b * one.down_b).sum(axis=1)))
    return angle


def score(kind: str, sampling: str, seed: int, methods: Sequence[str]) -> list[float]:
    """RMS inclination error, deg, of each method, after `SETTLED`."""
    one = trial(KINDS[kind], sampling, seed)
    settled = slice(round(SETTLED * RATE), None)
    means = [(errors(one, METHODS[name](one))[settled] ** 2).mean() for name in methods]
    return [math.sqrt(mean) for mean in means]


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--seeds", type=int, default=10)
    arguments.add_argument("--first", type=int, default=0, help="the first seed")
    arguments.add_argument("--jobs", type=int, default=2)
    options = arguments.parse_args()
    methods = list(METHODS)
    seeds = range(options.first, options.first + options.seeds)
    print(f"inclination, deg RMS, median (worst) of {options.seeds} runs")
    print(f"{'motion':14}{'sampling':10}" + "".join(f"{name:>16}" for name in methods))
    with Pool(options.jobs) as pool:
        for kind in KINDS:
            for sampling in SAMPLINGS:
                runs = [(kind, sampling, seed, methods) for seed in seeds]
                scores = np.array(pool.starmap(score, runs))
                cells = zip(np.median(scores, axis=0), scores.max(axis=0), strict=True)
                line = "".join(f"{median:9.2f} ({worst:4.2f})" for median, worst in cells)
                print(f"{kind:14}{sampling:10}{line}", flush=True)


if __name__ == "__main__":
    main()
