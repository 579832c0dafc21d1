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
    relearn: float
    tiny: float
    least_white: float
    prior: float
    mad_factors: list[float]

class Risaf:
    def __init__(
        self,
        alpha: float,
        lower_quantile: float,
        upper_quantile: float,
        gyro_noise: float,
        bias_walk: float,
    ) -> None: ...
    def fuse(self, dt: float, readings: Floats) -> tuple[Floats, NDArray[np.int64], int]: ...
    def relative_bias(self) -> Floats: ...

class Robust:
    def __init__(self, parameters: RobustParameters) -> None: ...
    def fuse(self, dt: float, readings: Floats) -> tuple[Floats, NDArray[np.int64], int]: ...
    def channels(self) -> dict[str, Floats]: ...
    def trusted(self) -> Floats: ...

class Cutter:
    summed: int
    def __init__(self, extras: dict[int, int]) -> None: ...
    def cut(
        self, buffer: bytes, prefix_size: int, done: int, in_step: bool, ended: bool
    ) -> tuple[bytes, int, int, bool, int, tuple[int, ...]]: ...
