from typing import Any

import numpy as np
from numpy.typing import NDArray

from risaf_link.core.rotation import Floats

class RobustParameters:
    gate: float
    bias_time: float
    hold_time: float
    resolution: float
    scale_error: float
    gyro_noise: float
    bias_walk: float
    limit: float
    longest: float
    watch_time: float
    burst_time: float
    burst: float
    swell: float
    noise_time: float
    spread_time: float
    frozen_after: float
    silent_after: float
    dead_after: float
    relearn: float
    tiny: float
    least_white: float
    prior: float
    mad_factors: list[float]

class _Fusion:
    def fuse(
        self, dt: float, readings: Floats, values: Floats, active: NDArray[np.int64]
    ) -> int: ...

class _Plain(_Fusion):
    def configure(self, gyro_noise: float, bias_walk: float) -> None: ...
    def silent_for(self) -> Floats: ...

class Mean(_Plain):
    def __init__(self, gyro_noise: float, bias_walk: float) -> None: ...

class Median(_Plain):
    def __init__(self, gyro_noise: float, bias_walk: float, mad_to_std: float) -> None: ...

class Risaf(_Fusion):
    def __init__(
        self,
        alpha: float,
        lower_quantile: float,
        upper_quantile: float,
        gyro_noise: float,
        bias_walk: float,
    ) -> None: ...
    def configure(
        self,
        alpha: float,
        lower_quantile: float,
        upper_quantile: float,
        gyro_noise: float,
        bias_walk: float,
    ) -> None: ...
    def silent_for(self) -> Floats: ...
    def relative_bias(self) -> Floats: ...

class Robust(_Fusion):
    def __init__(self, parameters: RobustParameters) -> None: ...
    def configure(self, parameters: RobustParameters) -> None: ...
    def health(self) -> tuple[NDArray[np.int8], NDArray[np.int8], Floats, Floats]: ...
    def memory(self) -> tuple[Floats, Floats, float, float]: ...
    def recall(self, channels: Floats, axes: Floats, elapsed: float, calm: float) -> None: ...

Told = tuple[float, float, float, bool, int, int]

class FilterNumbers:
    def __init__(self, told: dict[str, Any]) -> None: ...

class Eskf:
    def __init__(self, numbers: FilterNumbers) -> None: ...
    def configure(self, numbers: FilterNumbers) -> None: ...
    def set_latitude(self, latitude: float) -> None: ...
    def set_attitude(self, q_nb: list[float]) -> None: ...
    def set_covariance(self, covariance: Floats) -> None: ...
    def memory(self) -> tuple[Floats, float, bool, bool, bool]: ...
    def recall(
        self,
        q_nb: Floats,
        rate_b: Floats,
        errors: Floats,
        covariance: Floats,
        latitude: float,
        aligned: bool,
        levelled: bool,
        resets: int,
    ) -> None: ...
    def predict(self, rate: Floats, noise: Floats, bias_walk: Floats, dt: float) -> None: ...
    def compare_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Told | None: ...
    def correct_heading(self, heading: float, variance: float, age: float, gate: float) -> Told: ...
    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Told: ...
    def doubt_bias(self, rate: float) -> None: ...
    def correct_gravity(
        self,
        gravity_n: Floats,
        forward: float,
        right: float,
        down: float,
        lever: Floats,
        by_errors: Floats,
    ) -> list[Told]: ...
    def correct_zero_rate(
        self, rate_b: Floats, variance: Floats, confirmed: bool
    ) -> list[Told]: ...
    def state(
        self,
    ) -> tuple[Floats, Floats, Floats, list[float], list[float], bool, int, list[float]]: ...
    def covariance(self) -> Floats: ...
    @property
    def wrong(self) -> list[float]: ...

class SpeedTracker:
    speed: float
    acceleration: float
    speed_variance: float
    recent: bool
    def __init__(self, numbers: FilterNumbers) -> None: ...
    def advance(self, dt: float) -> None: ...
    def hear(self, speed: float, variance: float, age: float) -> None: ...
    def turn_round(self) -> None: ...

class Aiding:
    speed: SpeedTracker
    def __init__(self, numbers: FilterNumbers) -> None: ...
    def take(self, attitude: Eskf, rate_b: Floats, force_b: Floats, dt: float) -> list[Told]: ...

def advance(
    gyros: _Fusion,
    accelerometers: Robust,
    attitude: Eskf,
    aiding: Aiding,
    dt: Floats,
    rates_b: Floats,
    forces_b: Floats,
    known: Floats,
) -> None: ...
def advance_one(
    gyros: _Fusion,
    accelerometers: Robust,
    attitude: Eskf,
    aiding: Aiding,
    dt: float,
    readings: bytes,
    n: int,
) -> bytes: ...

class Cutter:
    summed: int
    def __init__(self, extras: dict[int, int]) -> None: ...
    def cut(
        self, buffer: bytes, prefix_size: int, done: int, in_step: bool, ended: bool
    ) -> tuple[bytes, int, int, bool, int, tuple[int, ...]]: ...

class Sensors:
    def __init__(self, count: int, scale: float, limit: float) -> None: ...

class ArrayLayout:
    def __init__(
        self,
        system: int,
        component: int,
        array_id: int,
        gyros: Sensors,
        accels: Sensors,
        told: bytes,
    ) -> None: ...

class EpochFinder:
    def __init__(self, kinds: list[int], info_id: int, jump_us: int, patience_us: int) -> None: ...
    def load(self, buffer: bytes, records: bytes, times_us: NDArray[np.uint64] | int) -> None: ...
    def take(
        self, array: ArrayLayout, time_us: int, sequence: int, heard_us: int, most: int
    ) -> (
        tuple[
            int,
            bytes,
            tuple[int, int, int],
            int,
            int,
            tuple[int, int],
            list[int],
            list[tuple[int, int]],
        ]
        | None
    ): ...
    def single(self) -> int: ...
    def next(
        self,
        cutter: Cutter,
        frames: bytes,
        array: ArrayLayout,
        time_us: int,
        sequence: int,
    ) -> tuple[int, float, bytes] | None: ...
