"""Simulated drives that are spoilt on the way to the pipeline, and judged against the truth.

Whatever happens, an estimate must not lie: its error stays within three of its own standard
deviations, or it says that it does not know.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from risaf_link.core.rotation import wraps, yaws_of
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.frame import FrameParser, encode
from risaf_link.pipeline import Pipeline, PipelineParameters
from risaf_link.sim.scenario import BOOT_US, Scenario, scenario
from risaf_link.sim.stream import frames

Stream = Iterable[tuple[int, bytes]]
"""When each frame came, us, and the frame."""

OWN, ARRAY = (1, 191), 158
SENSORS, RATE = 12, 25.0
SETTLED, FAULT, DURATION = 20.0, 35.3, 60.0  # s: errors count from, the fault begins, the end
READINGS = {IDS[name].to_bytes(3, "little") for name in ("GYRO_ARRAY", "ACCEL_ARRAY")}


def drive(seed: int = 1, gps: bool = True, duration: float = DURATION, **changed) -> Scenario:
    """A drive on a winding road without faults, GPS on to the end or gone before the fault."""
    sound = scenario("drive1", seed, duration, SENSORS, RATE, ["none"])
    outages = () if gps else ((FAULT - 2.0, math.inf),)
    return replace(sound, outages=outages, **changed)


@dataclass(frozen=True)
class Outcome:
    """What came of a drive, at every epoch."""

    pipeline: Pipeline
    estimates: list
    time_s: np.ndarray  # when its samples came
    error: np.ndarray  # of yaw, rad
    std: np.ndarray  # rad

    @property
    def worst(self) -> float:
        """The largest error of yaw in its own standard deviations, once it had settled."""
        return float((self.error / self.std)[self.time_s > SETTLED].max())

    def after(self, seconds: float) -> slice:
        """The epochs from then on."""
        return slice(int(np.searchsorted(self.time_s, seconds)), None)

    @property
    def counts(self):
        return self.pipeline.assembler.counts


def run(chosen: Scenario, spoil: Callable[[Stream], Stream] = iter, clock=lambda time_us: time_us):
    """Let a drive go through the pipeline; `clock` is that of the host."""
    pipeline, parser = Pipeline(PipelineParameters(), OWN), FrameParser()
    rows = [
        ((time_us - BOOT_US) / 1e6, estimate)
        for time_us, raw in spoil(frames(chosen))
        for frame in parser.receive_data(raw)
        for estimate in pipeline.step(frame, clock(time_us))
    ]
    time_s = np.array([seconds for seconds, _ in rows])
    estimates = [estimate for _, estimate in rows]
    truth = yaws_of(chosen.trajectory(time_s).q_nb)
    error = np.abs(wraps(np.array([e.heading.yaw for e in estimates]) - truth))
    return Outcome(
        pipeline, estimates, time_s, error, np.array([e.heading.yaw_std for e in estimates])
    )


def is_reading(raw: bytes) -> bool:
    return raw[7:10] in READINGS


def silent(begin: float, end: float) -> Callable[[Stream], Iterator[tuple[int, bytes]]]:
    """The array stops, and goes on."""

    def spoil(stream: Stream) -> Iterator[tuple[int, bytes]]:
        for time_us, raw in stream:
            if not (is_reading(raw) and begin <= (time_us - BOOT_US) / 1e6 < end):
                yield time_us, raw

    return spoil


def followed_by(other: Scenario) -> Callable[[Stream], Iterator[tuple[int, bytes]]]:
    """Another array, or the same with another rate, takes over."""

    def spoil(stream: Stream) -> Iterator[tuple[int, bytes]]:
        yield from ((t, raw) for t, raw in stream if t < BOOT_US + FAULT * 1e6)
        yield from ((t, raw) for t, raw in frames(other) if t >= BOOT_US + FAULT * 1e6)

    return spoil


def rewritten(change: Callable[[int, int], tuple[int, int]], begin: float = FAULT):
    """The array stamps and numbers its epochs otherwise: (us, number) to (us, number)."""

    def spoil(stream: Stream) -> Iterator[tuple[int, bytes]]:
        parser = FrameParser()
        for time_us, raw in stream:
            if is_reading(raw) and (time_us - BOOT_US) / 1e6 >= begin:
                (frame,) = parser.receive_data(raw)
                payload = frame.payload.ljust(254, b"\0")
                stamp, number = (
                    int.from_bytes(payload[a:b], "little") for a, b in ((0, 8), (8, 10))
                )
                stamp, number = change(stamp, number)
                head = stamp.to_bytes(8, "little") + (number % 65536).to_bytes(2, "little")
                yield time_us, encode(frame.message_id, head + payload[10:], raw[4], 1, ARRAY)
            else:
                yield time_us, raw

    return spoil
