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

class _Fusion:
    def fuse(
        self, dt: float, readings: Floats, values: Floats, active: NDArray[np.int64]
    ) -> int: ...

class Mean(_Fusion):
    def __init__(self, gyro_noise: float, bias_walk: float) -> None: ...
    def silent_for(self) -> Floats: ...

class Median(_Fusion):
    def __init__(self, gyro_noise: float, bias_walk: float, mad_to_std: float) -> None: ...
    def silent_for(self) -> Floats: ...

class Risaf(_Fusion):
    def __init__(
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
    def channels(self) -> dict[str, Floats]: ...
    def trusted(self) -> Floats: ...
