"""Estimates of a simulated vehicle."""

from functools import cache

from risaf_link.core.estimate import Estimate
from risaf_link.mavlink.frame import FrameParser
from risaf_link.pipeline import Pipeline, PipelineParameters
from risaf_link.sim.scenario import scenario
from risaf_link.sim.stream import frames


@cache
def estimates(seconds: float = 2.0, sensors: int = 5, rate: float = 100.0) -> list[Estimate]:
    """What comes of the paper's circle."""
    chosen = scenario("circle", seed=3, duration=seconds, sensors=sensors, rate=rate)
    pipeline, parser = Pipeline(PipelineParameters(), (1, 191)), FrameParser()
    return [
        estimate
        for time_us, raw in frames(chosen)
        for frame in parser.receive_data(raw)
        for estimate in pipeline.step(frame, time_us)
    ]
