"""The datum's way, on one page: frames in, estimates out.

    Frame -> GyroChunk -> Epoch -> FusedRate -> AttitudeState + Innovation -> Estimate
           ingest      assembler  fusion      attitude filter

Nothing here reads a clock, opens a file or waits. A live link and a log feed the same function, so
that a live run that is recorded and replayed gives the same estimates, bit for bit.
"""

import numpy as np
from msgspec import Struct, field, structs

from risaf_link.core.array import ArrayCalibration, Calibration
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.estimate import ArrayStatus, Estimate, EstimateBlock
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import Epoch, EpochBlock, FusionParameters
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingMonitor, HeadingParameters
from risaf_link.core.health import ArrayHealth
from risaf_link.mavlink.clock import VehicleClock
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.ingest import GpsParameters, Ingest

HEALTH_PERIOD = 0.1  # s, from one judgement of the sensors to the next


class PipelineParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that the estimate depends on, but for the input."""

    array: ArrayParameters = field(default_factory=ArrayParameters)
    gps: GpsParameters = field(default_factory=GpsParameters)
    fusion: FusionParameters = field(default_factory=FusionParameters)
    heading: HeadingParameters = field(default_factory=HeadingParameters)
    attitude: AttitudeParameters = field(default_factory=AttitudeParameters)


class Pipeline:
    """Estimates attitude and heading from a stream of frames.

    Parameters
    ----------
    parameters : PipelineParameters
    own : tuple of int
        System and component id of this service; its own frames are not taken for input.
    calibration : ArrayCalibration or None
        Of the array; None: its readings are taken as they come.

    Attributes
    ----------
    mismatch : str
        Why the calibration is not that of the array which sends, in one line; there are no
        estimates from such epochs. Empty: all is well.
    """

    def __init__(
        self,
        parameters: PipelineParameters,
        own: tuple[int, int],
        calibration: ArrayCalibration | None = None,
    ) -> None:
        p = parameters
        sensors = p.array.sensors or (len(calibration.gyros) if calibration else 0)
        self.ingest = Ingest(p.array, p.gps, own)
        self.assembler = EpochAssembler(structs.replace(p.array, sensors=sensors))
        self.mismatch = ""
        self._calibration = Calibration(calibration) if calibration else None
        self._clock = VehicleClock()
        self._estimator = Estimator(p.fusion, p.attitude, p.heading)
        self._health = self._estimator.fusion.health()
        self._judged = 0.0  # s, when it was made
        self._finder = HeadingFinder(p.heading)
        self._monitor = HeadingMonitor(p.heading)
        self._elapsed = 0.0  # s, of epochs

    def step(self, frame: Frame, received_us: int) -> list[Estimate]:
        """Take one frame; the estimates that became possible by it, one an epoch.

        Parameters
        ----------
        frame : Frame
        received_us : int
            When it came, microseconds since 1970.
        """
        self._clock.hear(frame, received_us)
        datum = self.ingest.decode(frame, received_us)
        if isinstance(datum, GyroChunk):
            return self._estimates(self.assembler.add(datum), received_us)
        if isinstance(datum, GpsFix):
            self._correct(datum)
        return []

    def flush(self, received_us: int) -> list[Estimate]:
        """Use what is left when a log has ended."""
        return self._estimates(self.assembler.flush(), received_us)

    def _estimates(self, epochs: list[Epoch], received_us: int) -> list[Estimate]:
        blocks = [self.advance(EpochBlock.of(epoch, received_us)) for epoch in epochs]
        return [block.at(0) for block in blocks if block]

    def advance(self, epochs: EpochBlock) -> EstimateBlock | None:
        """Carry the estimate on over epochs between which no fix came; None: they do not fit."""
        sensors = epochs.rates_b.shape[1]
        if not self._fits(sensors):
            return None
        rates_b, forces_b = epochs.rates_b, epochs.forces_b
        if self._calibration:
            rates_b, forces_b = self._calibration.apply(rates_b, forces_b)
        track = self._estimator.advance(epochs.dt, rates_b, forces_b)
        elapsed = np.cumsum(np.concatenate(([self._elapsed], epochs.dt)))[1:]
        self._elapsed = float(elapsed[-1])
        times = zip(epochs.time_us.tolist(), epochs.received_us.tolist(), strict=True)
        return EstimateBlock(
            epochs.time_us,
            epochs.received_us,
            np.array([self._clock.boot_us(*time) for time in times]),
            elapsed,
            track,
            self._monitor.advance(epochs.dt, track.aligned),
            self._array_status(sensors),
        )

    def _correct(self, fix: GpsFix) -> None:
        """Correct the attitude by a GPS fix."""
        motion = self._finder.take(fix, self._elapsed)
        self._monitor.note_motion(motion)
        innovation = self._estimator.correct(motion, fix.latitude)
        if innovation and motion.heading:
            self._monitor.note_innovation(motion.heading, innovation)

    def _array_status(self, sensors: int) -> ArrayStatus:
        counts, source = self.assembler.counts, self.assembler.source
        return ArrayStatus(
            source.array_id if source else 0,
            counts["epochs"],
            counts["incomplete"],
            counts["samples_lost"],
            sensors,
            self._judge(sensors),
        )

    def _judge(self, sensors: int) -> ArrayHealth:
        """Standing of the sensors, judged anew now and then."""
        due = self._elapsed - self._judged >= HEALTH_PERIOD
        if due or len(self._health.state) != sensors:
            self._health, self._judged = self._estimator.fusion.health(), self._elapsed
        return self._health

    def _fits(self, sensors: int) -> bool:
        if self._calibration is None:
            return True
        source = self.assembler.source
        info = source and self.ingest.info(source)
        self.mismatch = self._calibration.mismatch(
            max(sensors, info.sensors if info else 0), info.name if info else ""
        )
        return not self.mismatch
