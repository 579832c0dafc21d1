"""What is known of an array and of an attitude, as it outlasts a restart.

Arrays stand as they do in `Robust` and `Eskf`, from which they come and to which they go.
"""

import math
from typing import Self

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from risaf_link.core.error_state import GYRO, STATES
from risaf_link.core.rotation import Floats

CHANNELS = ("bias", "age", "slow", "calm", "out")
"""Of what `Robust` remembers of each channel that which takes more than a second to be learnt."""

AXES = ("spread", "slow_spread", "turning", "jitter", "calm_walk", "noise")
"""What it knows of each axis."""

ERRORS = STATES - GYRO.start  # 26: `GYRO`, `ACCELEROMETER` and `HEADING` of `Eskf`
LARGEST = 1e9  # no number of these is larger


class ArrayMemory(Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of n sensors of one kind."""

    channels: Floats  # (5, 3, n): `CHANNELS`
    axes: Floats  # (6, 3): `AXES`; a noise may be NaN
    elapsed: float  # s, for which they have been fused
    calm: float  # 0 to 1, how calmly they turned

    def __len__(self) -> int:
        return len(self.channels[0, 0])

    @property
    def bias(self) -> Floats:
        """Relative biases, (3, n), rad/s."""
        bias: Floats = self.channels[0]
        return bias

    @property
    def noise(self) -> Floats:
        """Variance of one reading, (3,), (rad/s)^2."""
        noise: Floats = self.axes[5]
        return noise

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """Which channels were, (3, n)."""
        trusted: NDArray[np.bool_] = self.channels[4] == 0.0
        return trusted

    @property
    def is_sound(self) -> bool:
        """Whether it can have come from an array."""
        c, axes = self.channels, self.axes
        return (
            c.ndim == 3
            and c.shape[:2] == (len(CHANNELS), 3)
            and axes.shape == (len(AXES), 3)
            and bool((np.abs(c) < LARGEST).all() and (c[[1, 3, 4]] >= 0.0).all())
            and bool((np.abs(axes[:-1]) < LARGEST).all())
            and not bool((axes[[0, 1, 3]] < 0.0).any() or (self.noise < 0.0).any())
            and 0.0 <= self.elapsed < LARGEST
            and 0.0 <= self.calm <= 1.0
        )

    def older(self, changed: Floats, dt: float) -> Self:
        """The same when the biases of single sensors have changed since.

        A bias that was averaged for `age` seconds is known as well as its noise allows, and no
        better than that and the change: what is new weighs as much more.

        Parameters
        ----------
        changed : ndarray, shape (3,)
            Variance of the change, (rad/s)^2.
        dt : float
            From reading to reading, s.
        """
        density = np.where(self.noise > 0.0, self.noise * dt, math.inf)[:, np.newaxis]
        age = self.channels[1]
        channels = self.channels.copy()
        channels[1] = age / (1.0 + age * changed[:, np.newaxis] / density)
        return type(self)(channels, self.axes, self.elapsed, self.calm)


class FilterMemory(Struct, frozen=True, forbid_unknown_fields=True):
    """What is known of an attitude, and of what makes the readings wrong."""

    q_nb: Floats  # (4,)
    rate_b: Floats  # (3,) rad/s, bias taken off
    errors: Floats  # (26,) `GYRO`, `ACCELEROMETER`, `HEADING`
    covariance: Floats  # (29, 29)
    bias_walk: Floats  # (3,) rad/s/sqrt(s), of the fused rate
    latitude: float | None  # rad
    aligned: bool
    levelled: bool
    resting: bool

    @property
    def bias_b(self) -> Floats:
        """Bias of the fused rate, (3,), rad/s."""
        bias_b: Floats = self.errors[0:3]
        return bias_b

    @property
    def is_sound(self) -> bool:
        """Whether it can have come from a filter."""
        shapes = [value.shape for value in (self.q_nb, self.rate_b, self.errors, self.bias_walk)]
        values = np.concatenate([value.ravel() for value in (self.q_nb, self.rate_b, self.errors)])
        covariance = self.covariance
        if shapes != [(4,), (3,), (ERRORS,), (3,)] or covariance.shape != (STATES, STATES):
            return False
        if not (np.abs(values) < LARGEST).all() or not (np.abs(covariance) < LARGEST).all():
            return False
        if (covariance != covariance.T).any() or (covariance.diagonal() <= 0.0).any():
            return False
        deviation = np.sqrt(covariance.diagonal())
        return (
            abs(float(self.q_nb @ self.q_nb) - 1.0) < 1e-6
            and np.linalg.eigvalsh(covariance / np.outer(deviation, deviation)).min() > -1e-9
            and bool(((self.bias_walk >= 0.0) & (self.bias_walk < LARGEST)).all())
            and (self.latitude is None or abs(self.latitude) <= math.pi / 2)
        )


class ArrayIdentity(Struct, frozen=True, forbid_unknown_fields=True):
    """Which array it is, by what it and the configuration say."""

    encoding: str  # of its samples
    id: int
    name: str  # empty: it says none
    sensors: int
    calibration: int  # a checksum; 0: none

    def difference(self, found: "ArrayIdentity") -> str:
        """What tells another array from this one, in words; empty: nothing."""
        for name in ("encoding", "id", "name", "calibration", "sensors"):
            ours, theirs = getattr(self, name), getattr(found, name)
            if ours != theirs:
                return f"array's {name}: found {theirs!r}, expected {ours!r}"
        return ""


class Memory(Struct, frozen=True, forbid_unknown_fields=True):
    """What is known at one epoch."""

    array: ArrayIdentity
    time_us: int  # as its samples were stamped
    received_us: int  # since 1970
    gyros: ArrayMemory
    accelerometers: ArrayMemory
    attitude: FilterMemory

    @property
    def is_sound(self) -> bool:
        """Whether it can have come from an estimator."""
        parts = self.gyros, self.accelerometers, self.attitude
        return (
            all(0 <= time < 2**63 for time in (self.time_us, self.received_us))
            and all(part.is_sound for part in parts)
            and 0 < len(self.gyros) == self.array.sensors
        )


def known_errors(bias: Floats, scale: Floats, force: Floats, heading: Floats) -> Floats:
    """Errors in the order of the covariance, (26,)."""
    return np.concatenate((bias, scale.ravel(), force, heading))
