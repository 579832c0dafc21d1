"""What every method that is compared can do, and all that it is given.

A method of one's own is a class in a file, tried with `--method FILE.py`. The class gets an
`ArrayModel` and has three functions; `Aided` brings a filter and its heading updates, so that a new
fusion is this:

    import numpy as np
    from risaf_link.experiments.method import Aided, one_rate

    class Trimmed(Aided):
        def __init__(self, array, cut=10.0):
            super().__init__()
            self.cut, self.variance = int(cut), array.noise**2

        def step(self, epoch):
            kept = np.sort(epoch.rates_b, axis=0)[self.cut : -self.cut]
            self.advance(one_rate(epoch, kept.mean(axis=0), self.variance, len(kept)), epoch.dt)
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from risaf_link.core.attitude import AttitudeParameters, Innovation, PaperFilter
from risaf_link.core.estimator import NO_FORCE
from risaf_link.core.fusion import Epoch, FusedRate
from risaf_link.core.guard import HeadingGuard
from risaf_link.core.heading import HeadingParameters, Motion
from risaf_link.core.rotation import Floats
from risaf_link.core.track import Track


class ArrayModel(NamedTuple):
    """What a data sheet tells of the sensors: standard deviations over the channels."""

    sensors: int
    rate: float  # Hz
    noise: float  # rad/s, of one reading, white
    bias: float  # rad/s, of what calibration leaves
    bias_walk: float  # rad/s/sqrt(s)


@dataclass(frozen=True, slots=True)
class Gps:
    """One fix, as every method gets it: right after the epoch in which it came."""

    motion: Motion  # speed over ground, and the heading if there is one
    latitude: float  # rad
    delay: float  # s from the fix's validity to its arrival


class Estimate(NamedTuple):
    """What a method says at an epoch."""

    yaw: float  # rad; NaN: not known yet
    yaw_std: float  # rad
    bias_z: float  # rad/s, of the fused rate about the down axis of the body; NaN: not estimated


class Method(Protocol):
    """An estimator of heading. It is made with the array's model."""

    def step(self, epoch: Epoch) -> None:
        """Carry the estimate on to an epoch."""
        ...

    def correct(self, gps: Gps) -> None:
        """Use a fix."""
        ...

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        ...


class Corrected(Protocol):
    """What headings correct."""

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Fuse a heading."""
        ...

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set yaw by a heading."""
        ...


class HeadingGate:
    """Feeds a rival with headings: gated, and believed when all were rejected for long.

    Parameters
    ----------
    parameters : HeadingParameters
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._parameters = parameters
        self._elapsed = 0.0  # s
        self._last = -math.inf  # s, when the last heading came
        self._rejecting_since = math.inf  # s

    def advance(self, dt: float) -> None:
        """Let time pass, s."""
        self._elapsed += dt

    def take(self, attitude: Corrected, gps: Gps) -> None:
        """Correct an attitude by a fix, if it holds a heading that its positions do not deny."""
        p, heading = self._parameters, gps.motion.heading
        if heading is None or gps.motion.contradicted:
            return
        measured = heading.heading, heading.variance, gps.delay + heading.age
        fused = attitude.correct_heading(*measured, p.gate).fused
        if fused or self._elapsed - self._last > p.timeout:
            self._rejecting_since = math.inf
        if not fused:
            self._rejecting_since = min(self._rejecting_since, self._elapsed)
        self._last = self._elapsed
        if self._elapsed - self._rejecting_since > p.reset_after:
            attitude.reset_heading(*measured, p.gate)
            self._rejecting_since = math.inf


class Aided:
    """The paper's filter with the service's headings: all of a method but the fusion, and `step`.

    Attributes
    ----------
    attitude : PaperFilter
    """

    def __init__(self) -> None:
        self.attitude = PaperFilter(AttitudeParameters())
        self._guard = HeadingGuard(HeadingParameters(), filter_knows=False)
        self._elapsed = 0.0  # s
        self._estimate = Estimate(math.nan, math.pi, 0.0)

    def advance(self, fused: FusedRate, dt: float) -> None:
        """Carry the filter on by a fused rate, over `dt` seconds."""
        self.attitude.predict(fused, dt)
        track = Track.of([(fused, self.attitude.state(fused.time_us), NO_FORCE)])
        self._elapsed += dt
        self._guard.advance(track, np.array([self._elapsed]), np.array([dt]))
        self._estimate = estimate_of(track)

    def correct(self, gps: Gps) -> None:
        """Use a fix."""
        self._guard.take(self.attitude, gps.motion)

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        return self._estimate


def estimate_of(track: Track) -> Estimate:
    """What the last epoch of a track comes to."""
    state = track.attitude(-1, 0)
    yaw = state.euler[2] if state.aligned else math.nan
    return Estimate(yaw, state.yaw_std, float(state.bias_b[2]))


def one_rate(epoch: Epoch, rate_b: Floats, variance: float, sensors: int) -> FusedRate:
    """Make a fused rate of sensors that are alike and independent.

    Parameters
    ----------
    epoch : Epoch
    rate_b : ndarray, shape (3,)
        rad/s.
    variance : float
        (rad/s)^2, of one sensor.
    sensors : int
        How many are behind it.
    """
    count = np.full(3, sensors)
    each = np.full(3, variance)
    return FusedRate(epoch.time_us, rate_b, each, count, sensors, each / sensors, np.zeros(3))
