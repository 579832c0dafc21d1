"""The steps of every epoch in C++, where they were built: as the NumPy forms, only faster.

The NumPy forms stay the statement of what is done, and run where nothing was built.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs

from risaf_link.core import aiding, eskf, fusion, gap, quaternion, robust
from risaf_link.core.attitude import AttitudeParameters, AttitudeState
from risaf_link.core.compiled import native
from risaf_link.core.error_state import Correction, Gravity, Outcome
from risaf_link.core.eskf import USUAL_HEADING
from risaf_link.core.fusion import MAD_TO_STD, Epoch, FusedRate, Fusion, FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.health import SILENT_AFTER, ArrayHealth, judge_silence
from risaf_link.core.memory import ArrayMemory, FilterMemory
from risaf_link.core.rotation import Floats
from risaf_link.core.track import COLUMNS

BUILT = native is not None
"""Whether there is a kernel."""

_SHARED = (
    *("LIMIT", "LONGEST", "WATCH_TIME", "BURST_TIME", "BURST", "SWELL", "NOISE_TIME"),
    *("SPREAD_TIME", "FROZEN_AFTER", "REPEATED_AFTER", "MANY", "DEAD_AFTER", "RELEARN", "TINY"),
    *("LEAST_WHITE", "PRIOR"),
)


class _Fusion:
    """What the fusions of the kernel have in common."""

    kernel: Any

    def fuse(self, epoch: Epoch) -> FusedRate:
        """Fuse the next epoch; its number of sensors may differ from the one before."""
        return self.fuse_readings(epoch.time_us, epoch.dt, epoch.rates_b)

    def fuse_readings(self, time_us: int, dt: float, readings: Floats) -> FusedRate:
        """Fuse what sensors of one kind read at one instant, (n, 3)."""
        values, active = np.empty((4, 3)), np.empty(3, np.int64)
        valid = self.kernel.fuse(dt, readings, values, active)
        rate, variance, noise, bias_walk = values
        return FusedRate(time_us, rate, variance, active, valid, noise, bias_walk)


class _Plain(_Fusion):
    """One that learns nothing of the sensors."""

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters."""
        self.kernel.configure(parameters.gyro_noise, parameters.bias_walk)

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return judge_silence(self.kernel.silent_for())


class _Mean(_Plain):
    """`fusion.Mean` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        self.kernel = native.Mean(parameters.gyro_noise, parameters.bias_walk)


class _Median(_Plain):
    """`fusion.Median` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        p = parameters
        self.kernel = native.Median(p.gyro_noise, p.bias_walk, MAD_TO_STD)


class _Risaf(_Fusion):
    """`fusion.Risaf` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        self.kernel = native.Risaf(*_told_risaf(parameters))

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self.kernel.configure(*_told_risaf(parameters))

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s, as of the last epoch."""
        bias: Floats = self.kernel.relative_bias().T
        return bias

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch, by their silence alone."""
        return judge_silence(self.kernel.silent_for(), self.relative_bias)


class _Robust(_Fusion):
    """`robust.Robust` in C++."""

    def __init__(self, parameters: FusionParameters) -> None:
        self.kernel = native.Robust(_told_robust(parameters))

    def configure(self, parameters: FusionParameters) -> None:
        """Take new parameters; what was learnt stays."""
        self.kernel.configure(_told_robust(parameters))

    @property
    def relative_bias(self) -> Floats:
        """Relative bias of each sensor, shape (n, 3), rad/s."""
        return self.health().relative_bias

    def health(self) -> ArrayHealth:
        """Judge the sensors as of the last epoch; of a sensor, its worst axis counts."""
        return ArrayHealth(*self.kernel.health())

    def memory(self) -> ArrayMemory:
        """Tell what was learnt."""
        return ArrayMemory(*self.kernel.memory())

    def recall(self, memory: ArrayMemory) -> None:
        """Go on from what was learnt before a restart, in place of anything learnt since."""
        m = memory
        self.kernel.recall(m.channels, m.axes, m.elapsed, m.calm)


_SOURCES = ("heading", "gravity", "size", "rest")
_OUTCOMES = tuple(Outcome)
_BY_AXIS = ("QUIET", "LOOSE", "STRICT")

Told = tuple[float, float, float, bool, int, int]


def _numbers(parameters: AttitudeParameters, heading: HeadingParameters) -> Any:
    """Parameters of the filter, and the constants of its modules, for the kernel."""
    constants = {**vars(gap), **vars(eskf), **vars(aiding), **structs.asdict(parameters)}
    constants |= {name: constants[name].tolist() for name in _BY_AXIS}
    constants |= {"offset_std": heading.offset_std, "delay_std": heading.delay_std}
    return native.FilterNumbers(constants)


def _correction(told: Told) -> Correction:
    value, variance, gate, reset, source, outcome = told
    return Correction(value, variance, gate, reset, _SOURCES[source], _OUTCOMES[outcome])


class _Eskf:
    """`eskf.Eskf` in C++."""

    def __init__(
        self, parameters: AttitudeParameters, heading: HeadingParameters = USUAL_HEADING
    ) -> None:
        self.kernel = native.Eskf(_numbers(parameters, heading))

    @property
    def quaternion(self) -> Floats:
        """`q_nb` as of the last predict."""
        return self.kernel.state()[0]

    @property
    def matrix(self) -> Floats:
        """`R_nb` as of the last predict."""
        w, x, y, z = self.quaternion.tolist()
        return quaternion.matrix((w, x, y, z))

    @property
    def covariance(self) -> Floats:
        """Covariance of the error, (29, 29)."""
        return self.kernel.covariance()

    @property
    def heading_errors(self) -> Floats:
        """What the headings are held to be off by: rad, s."""
        return np.array(self.kernel.wrong)

    def configure(self, parameters: AttitudeParameters, heading: HeadingParameters) -> None:
        """Take new parameters; the state stays, and with it what they say of the start."""
        self.kernel.configure(_numbers(parameters, heading))

    def set_latitude(self, latitude: float) -> None:
        """Tell where on earth the vehicle is, rad."""
        self.kernel.set_latitude(latitude)

    def set_attitude(self, q_nb: Floats) -> None:
        """Take an attitude for known."""
        self.kernel.set_attitude(q_nb.tolist())

    def set_covariance(self, covariance: Floats) -> None:
        """Take a covariance for that of the error, (29, 29)."""
        self.kernel.set_covariance(covariance)

    def doubt_bias(self, rate: float) -> None:
        """Take the bias about the vertical for off by so much, rad/s, one standard deviation."""
        self.kernel.doubt_bias(rate)

    def memory(self, bias_walk: Floats) -> FilterMemory:
        """Tell what is known; `bias_walk`, (3,), is that of the last fused rate."""
        q_nb, rate_b, *_ = self.kernel.state()
        errors, latitude, aligned, levelled, resting = self.kernel.memory()
        return FilterMemory(
            q_nb,
            rate_b,
            errors,
            self.covariance,
            bias_walk,
            None if math.isnan(latitude) else latitude,
            aligned,
            levelled,
            resting,
        )

    def recall(self, memory: FilterMemory, resets: int) -> None:
        """Go on from what was known before a restart, at that time."""
        m = memory
        latitude = math.nan if m.latitude is None else m.latitude
        self.kernel.recall(
            m.q_nb, m.rate_b, m.errors, m.covariance, latitude, m.aligned, m.levelled, resets
        )

    def predict(self, fused: FusedRate, dt: float) -> None:
        """Carry the state on to the time of a fused rate."""
        self.kernel.predict(fused.rate_b, fused.noise, fused.bias_walk, dt)

    def compare_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Correction | None:
        """Hold a heading against the state, which stays as it is; None: it cannot be."""
        told = self.kernel.compare_heading(heading, variance, age, gate)
        return None if told is None else _correction(told)

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Correction:
        """Fuse a heading; the first one sets yaw."""
        return _correction(self.kernel.correct_heading(heading, variance, age, gate))

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Correction:
        """Set yaw by a heading, whatever it was."""
        return _correction(self.kernel.reset_heading(heading, variance, age, gate))

    def correct_gravity(self, gravity: Gravity) -> tuple[Correction, ...]:
        """Fuse the direction of gravity; the first one sets the tilt."""
        g = gravity
        told = self.kernel.correct_gravity(
            g.gravity_n, g.forward, g.right, g.down, g.lever, g.by_errors
        )
        return tuple(map(_correction, told))

    def correct_zero_rate(
        self, rate_b: Floats, variance: Floats, confirmed: bool
    ) -> tuple[Correction, ...]:
        """Fuse the mean rate of a vehicle at rest."""
        return tuple(map(_correction, self.kernel.correct_zero_rate(rate_b, variance, confirmed)))

    def state(self, time_us: int) -> AttitudeState:
        """Read the estimate as of the last predict."""
        q_nb, rate_b, bias_b, std, common, aligned, resets, bias_std = self.kernel.state()
        roll, pitch, yaw = std
        known = aligned, resets, np.array(common), np.array(bias_std)
        return AttitudeState(time_us, q_nb, rate_b, bias_b, roll, pitch, yaw, *known)


class _SpeedTracker(native.SpeedTracker if BUILT else object):  # type: ignore[misc]
    """`aiding.SpeedTracker` in C++."""

    def __init__(self) -> None:
        super().__init__(_numbers(AttitudeParameters(), USUAL_HEADING))


class _Aiding:
    """`aiding.Aiding` in C++."""

    def __init__(self, parameters: AttitudeParameters = aiding.USUAL) -> None:
        self.kernel = native.Aiding(_numbers(parameters, USUAL_HEADING))
        self.speed = self.kernel.speed

    def take(
        self, attitude: _Eskf, fused: FusedRate, force_b: Floats, dt: float
    ) -> tuple[Correction, ...]:
        """Correct the attitude after a predict, where there is something to correct it by."""
        told = self.kernel.take(attitude.kernel, fused.rate_b, force_b, dt)
        return tuple(map(_correction, told))


def advance(
    gyros: Fusion,
    accelerometers: object,
    attitude: object,
    aid: object,
    dt: Floats,
    rates_b: Floats,
    forces_b: Floats,
) -> Floats | None:
    """Carry all of them on over k epochs at once; None: not all of them are the kernel's.

    Parameters are those of `Estimator.advance`; the result is the values of a `Track`.
    """
    parts = _kernels(gyros, accelerometers, attitude, aid)
    if parts is None:
        return None
    known: Floats = np.empty((len(dt), COLUMNS))
    native.advance(*parts, dt, rates_b, forces_b, known)
    return known


def advance_one(
    gyros: Fusion,
    accelerometers: object,
    attitude: object,
    aid: object,
    dt: float,
    readings: bytes,
    n: int,
) -> bytes | None:
    """Carry all of them on over one epoch, as `advance` does.

    Parameters are those of `Estimator.go_ahead`; the result is the bytes of a row of a `Track`.
    """
    parts = _kernels(gyros, accelerometers, attitude, aid)
    return None if parts is None else native.advance_one(*parts, dt, readings, n)


def _kernels(
    gyros: Fusion, accelerometers: object, attitude: object, aid: object
) -> "tuple[Any, native.Robust, native.Eskf, native.Aiding] | None":
    if (
        BUILT
        and isinstance(gyros, _Fusion)
        and isinstance(accelerometers, _Robust)
        and isinstance(attitude, _Eskf)
        and isinstance(aid, _Aiding)
    ):
        return gyros.kernel, accelerometers.kernel, attitude.kernel, aid.kernel
    return None


def _told_risaf(p: FusionParameters) -> tuple[float, ...]:
    return p.alpha, p.lower_quantile, p.upper_quantile, p.gyro_noise, p.bias_walk


def _told_robust(parameters: FusionParameters) -> "native.RobustParameters":
    told = native.RobustParameters()
    for name in _SHARED:
        setattr(told, name.lower(), getattr(robust, name))
    told.silent_after = SILENT_AFTER
    told.mad_factors = robust.MAD_FACTORS.tolist()
    for name, value in structs.asdict(parameters).items():
        if hasattr(told, name):
            setattr(told, name, value)
    return told


Mean: Callable[[FusionParameters], Fusion] = _Mean if BUILT else fusion.Mean
Median: Callable[[FusionParameters], Fusion] = _Median if BUILT else fusion.Median
Risaf: Callable[[FusionParameters], Fusion] = _Risaf if BUILT else fusion.Risaf
if TYPE_CHECKING or not BUILT:
    from risaf_link.core.aiding import Aiding, SpeedTracker
    from risaf_link.core.eskf import Eskf
    from risaf_link.core.robust import Robust
else:
    Robust, Eskf, Aiding, SpeedTracker = _Robust, _Eskf, _Aiding, _SpeedTracker

__all__ = [
    "BUILT",
    "Aiding",
    "Eskf",
    "Mean",
    "Median",
    "Risaf",
    "Robust",
    "SpeedTracker",
    "advance",
    "advance_one",
]
