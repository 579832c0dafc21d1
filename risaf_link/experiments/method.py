"""What every method that is compared can do, and all that it is given.

A method of one's own is a class in a file, tried with `--method FILE.py`. The class gets an
`ArrayModel` and has three functions; `Aided` brings a filter and its heading updates, so that a new
fusion is this:

    import numpy as np
    from risaf_link.core.attitude import AttitudeParameters, PaperFilter
    from risaf_link.experiments.method import Aided, one_rate

    class Trimmed(Aided):
        def __init__(self, array, cut=10.0):
            super().__init__(PaperFilter(AttitudeParameters()))
            self.cut, self.variance = int(cut), array.noise**2

        def step(self, epoch):
            kept = np.sort(epoch.rates_b, axis=0)[self.cut : -self.cut]
            self.advance(one_rate(epoch, kept.mean(axis=0), self.variance, len(kept)), epoch.dt)
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from risaf_link.core.attitude import AttitudeState, Innovation
from risaf_link.core.fusion import Epoch, FusedRate
from risaf_link.core.heading import HeadingMonitor, HeadingParameters, Motion
from risaf_link.core.rotation import Floats


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


class HeadingFilter(Protocol):
    """A filter of attitude that takes one fused rate an epoch, such as `PaperFilter` or `Eskf`."""

    def predict(self, fused: FusedRate, dt: float) -> None:
        """Carry the state on."""
        ...

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Fuse a heading."""
        ...

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set yaw by a heading."""
        ...

    def state(self, time_us: int) -> AttitudeState:
        """Read the estimate."""
        ...


class HeadingGate:
    """Feeds a filter with headings as the service does: gated, and believed when it must be wrong.

    Parameters
    ----------
    parameters : HeadingParameters
    """

    def __init__(self, parameters: HeadingParameters) -> None:
        self._gate = parameters.gate
        self._monitor = HeadingMonitor(parameters)

    def advance(self, dt: float) -> None:
        """Let time pass, s."""
        self._monitor.advance(dt)

    def take(self, attitude: "Corrected", gps: Gps) -> None:
        """Correct an attitude by a fix, if it holds a heading."""
        self._monitor.note_motion(gps.motion)
        heading = gps.motion.heading
        if heading is None:
            return
        measured = heading.heading, heading.variance, gps.delay + heading.age
        innovation = attitude.correct_heading(*measured, self._gate)
        if self._monitor.distrusts_filter and not innovation.fused:
            innovation = attitude.reset_heading(*measured, self._gate)
        self._monitor.note_innovation(heading, innovation)


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


class Aided:
    """A filter with its headings: all of a method but the fusion, and `step`.

    Parameters
    ----------
    attitude : HeadingFilter
    heading : HeadingParameters
    """

    def __init__(self, attitude: HeadingFilter, heading: HeadingParameters | None = None) -> None:
        self.attitude = attitude
        self._headings = HeadingGate(heading or HeadingParameters())

    def advance(self, fused: FusedRate, dt: float) -> None:
        """Carry the filter on by a fused rate, over `dt` seconds."""
        self.attitude.predict(fused, dt)
        self._headings.advance(dt)

    def correct(self, gps: Gps) -> None:
        """Use a fix."""
        self._headings.take(self.attitude, gps)

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        state = self.attitude.state(0)
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
