"""Faults of sensors that go on reading, but wrong. Angular rates and times in SI units."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats
from risaf_link.sim.target import Strike, Target


@dataclass(frozen=True, slots=True)
class Spikes:
    """Single readings of any channel that are far off, to both sides."""

    probability: float  # of each sample of each channel
    amplitude: float  # mean size; from half to one and a half times this

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""

        def spoil(_: Floats, __: Floats, readings: Floats) -> None:
            hit = target.when.random(readings.shape) < self.probability
            shares = target.how_much.uniform(-1.0, 1.0, np.count_nonzero(hit))
            readings[hit] += self.amplitude * (shares + np.copysign(0.5, shares))

        return spoil


@dataclass(frozen=True, slots=True)
class Shocks:
    """Bursts that decay, always to the same side, at every bump of the road.

    All victims feel a bump together, each as it happens to. The side is one for each axis: the
    parts are of one make, and mounted alike. At standstill there are no bumps.
    """

    share: float  # of the array
    spacing: float  # m of the way from bump to bump, in the mean
    peak: float  # in the mean; exponentially distributed
    decay: float  # s, time constant

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        side = np.sign(target.how_much.uniform(-1.0, 1.0, 3))
        return _ShockResponse(self, victims, side, target.waypoints(self.spacing), target.how_much)


class _ShockResponse:
    LASTING = 20.0  # time constants; then a burst is less than a count

    def __init__(
        self,
        shocks: Shocks,
        victims: NDArray[np.intp],
        side: Floats,
        bump_s: Floats,
        generator: np.random.Generator,
    ) -> None:
        self._shocks = shocks
        self._victims = victims
        self._side = side
        self._bump_s = bump_s
        self._generator = generator
        self._first = self._next = 0  # of the bumps that last, and of those to come
        self._peaks = np.zeros((0, len(victims), 3))

    def __call__(self, time_s: Floats, _: Floats, readings: Floats) -> None:
        self._meet(time_s[-1])
        bump_s = self._bump_s[self._first : self._next]
        age = (time_s[:, np.newaxis] - bump_s) / self._shocks.decay
        lasts = (age >= 0.0) & (age < self.LASTING)
        response = np.exp(-age, out=np.zeros_like(age), where=lasts)
        readings[:, self._victims] += np.einsum("kb,bva->kva", response, self._peaks)
        gone = int(np.sum((time_s[-1] - bump_s) / self._shocks.decay >= self.LASTING))
        self._first += gone
        self._peaks = self._peaks[gone:]

    def _meet(self, now: float) -> None:
        """Draw the peaks of the bumps that were met by now."""
        met = int(np.searchsorted(self._bump_s, now, side="right"))
        shape = (met - self._next, len(self._victims), 3)
        peaks = self._side * self._generator.exponential(self._shocks.peak, shape)
        self._peaks = np.concatenate([self._peaks, peaks])
        self._next = met


@dataclass(frozen=True, slots=True)
class Scale:
    """A wrong scale of every channel."""

    error: float  # standard deviation over the channels, as a share of the true value

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        errors = target.how_much.normal(0.0, self.error, (target.sensors, 3))

        def spoil(_: Floats, truth_b: Floats, readings: Floats) -> None:
            readings += truth_b[:, np.newaxis] * errors

        return spoil


@dataclass(frozen=True, slots=True)
class Thermal:
    """Biases that drift as the array warms up; a part of it is the same for all sensors."""

    common: float  # standard deviation of what all come to drift, on each axis
    own: float  # of what each channel comes to drift on top
    time_constant: float  # s, of the warming

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        return self.drift(target.sensors, target.how_much)

    def drift(self, sensors: int, generator: np.random.Generator) -> Strike:
        """Let so many sensors drift."""
        final = generator.normal(0.0, self.common, 3)
        final = final + generator.normal(0.0, self.own, (sensors, 3))

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            warmth = -np.expm1(-time_s / self.time_constant)
            readings += warmth[:, np.newaxis, np.newaxis] * final

        return spoil


@dataclass(frozen=True, slots=True)
class Steps:
    """Biases that jump, once, and stay."""

    share: float  # of the array
    size: float  # mean; from half to one and a half times this, to both sides
    onset: tuple[float, float]  # s from the start: some time in between

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        begin = target.when.uniform(*self.onset, len(victims))
        sizes = self.size * _both_sides(target.how_much, len(victims))

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            jumped = time_s[:, np.newaxis] >= begin
            readings[:, victims] += jumped[:, :, np.newaxis] * sizes

        return spoil


@dataclass(frozen=True, slots=True)
class Ramps:
    """Biases that begin to grow, slowly and for ever."""

    share: float  # of the array
    slope: float  # a second; mean; from half to one and a half times this, to both sides
    onset: tuple[float, float]  # s from the start: some time in between

    def strike(self, target: Target) -> Strike:
        """Begin to strike an array."""
        victims = target.victims(self.share)
        begin = target.when.uniform(*self.onset, len(victims))
        slopes = self.slope * _both_sides(target.how_much, len(victims))

        def spoil(time_s: Floats, _: Floats, readings: Floats) -> None:
            since = np.maximum(time_s[:, np.newaxis] - begin, 0.0)
            readings[:, victims] += since[:, :, np.newaxis] * slopes

        return spoil


def _both_sides(generator: np.random.Generator, sensors: int) -> Floats:
    """Sizes from half to one and a half, of random sign, of every channel."""
    shares = generator.uniform(-1.0, 1.0, (sensors, 3))
    return shares + np.copysign(0.5, shares)
