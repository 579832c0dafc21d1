"""The datum's way, on one page: frames in, estimates out.

    Frame -> GyroChunk -> Epoch -> FusedRate -> AttitudeState + Innovation -> Estimate
           ingest      assembler  fusion      attitude filter

Nothing here reads a clock, opens a file or waits. A live link and a log feed the same function, so
that a live run that is recorded and replayed gives the same estimates, bit for bit.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from msgspec import Struct, field, structs

from risaf_link.core import kernel
from risaf_link.core.aiding import Aiding
from risaf_link.core.array import ArrayCalibration, Calibration
from risaf_link.core.attitude import AttitudeParameters, PaperFilter
from risaf_link.core.eskf import Eskf
from risaf_link.core.estimate import ArrayStatus, Estimate
from risaf_link.core.fusion import Epoch, Fusion, FusionParameters
from risaf_link.core.guard import HeadingGuard
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingMonitor, HeadingParameters
from risaf_link.core.health import ArrayHealth
from risaf_link.core.rotation import Floats
from risaf_link.mavlink.clock import VehicleClock
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.ingest import GpsParameters, Ingest

FUSIONS: dict[str, Callable[[FusionParameters], Fusion]] = {
    "robust": kernel.Robust,
    "risaf": kernel.Risaf,
    "median": kernel.Median,
    "mean": kernel.Mean,
}
FORCE_RESOLUTION = 0.02  # m/s^2; no accelerometer is blamed for less
HEALTH_PERIOD = 0.1  # s, from one judgement of the sensors to the next
NO_FORCE = np.full(3, np.nan)


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
        self._fusion = FUSIONS[p.fusion.method](p.fusion)
        self._force_fusion = kernel.Robust(structs.replace(p.fusion, resolution=FORCE_RESOLUTION))
        self._health = self._fusion.health()
        self._judged = 0.0  # s, when it was made
        self._filter: Eskf | PaperFilter
        self._aiding: Aiding | None = None
        if p.attitude.filter == "eskf":
            self._filter, self._aiding = Eskf(p.attitude, p.heading), Aiding(p.attitude)
        else:
            self._filter = PaperFilter(p.attitude)
        self._heading = p.heading
        self._finder = HeadingFinder(p.heading)
        self._guard = HeadingGuard(p.heading, filter_knows=self._aiding is not None)
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
            self._aid(datum)
        return []

    def flush(self, received_us: int) -> list[Estimate]:
        """Use what is left when a log has ended."""
        return self._estimates(self.assembler.flush(), received_us)

    def _estimates(self, epochs: list[Epoch], received_us: int) -> list[Estimate]:
        fitting = [epoch for epoch in epochs if self._fits(epoch)]
        return [self._advance(self._calibrated(epoch), received_us) for epoch in fitting]

    def _advance(self, epoch: Epoch, received_us: int) -> Estimate:
        """Carry the estimate on to an epoch."""
        fused = self._fusion.fuse(epoch)
        self._elapsed += epoch.dt
        self._filter.predict(fused, epoch.dt)
        force_b = self._force(epoch)
        if isinstance(self._filter, Eskf) and self._aiding:
            self._aiding.take(self._filter, fused, force_b, epoch.dt)
        self._monitor.advance(epoch.dt)
        attitude = self._filter.state(epoch.time_us)
        attitude = self._guard.advance(attitude, force_b, epoch.dt)
        return Estimate(
            epoch.time_us,
            self._clock.boot_us(epoch.time_us, received_us),
            self._elapsed,
            fused,
            attitude,
            self._monitor.status(attitude),
            self._array_status(epoch),
        )

    def _aid(self, fix: GpsFix) -> None:
        """Correct the attitude by a GPS fix."""
        motion = self._finder.take(fix, self._elapsed)
        self._monitor.note_motion(motion)
        gear = self._guard.gear.sign
        innovation = self._guard.take(self._filter, motion)
        if innovation and motion.heading:
            self._monitor.note_innovation(motion.heading, innovation)
        if isinstance(self._filter, Eskf) and self._aiding:
            self._filter.set_latitude(fix.latitude)
            if self._guard.gear.sign != gear:
                self._aiding.speed.turn_round()
            if motion.along and motion.is_news and not motion.contradicted:
                ahead = self._guard.ahead(motion)
                self._aiding.speed.hear(ahead, motion.speed_std**2, self._heading.delay)

    def _array_status(self, epoch: Epoch) -> ArrayStatus:
        counts, source = self.assembler.counts, self.assembler.source
        return ArrayStatus(
            source.array_id if source else 0,
            counts["epochs"],
            counts["incomplete"],
            counts["samples_lost"],
            len(epoch.rates_b),
            self._judge(len(epoch.rates_b)),
        )

    def _judge(self, sensors: int) -> ArrayHealth:
        """Standing of the sensors, judged anew now and then."""
        due = self._elapsed - self._judged >= HEALTH_PERIOD
        if due or len(self._health.state) != sensors:
            self._health, self._judged = self._fusion.health(), self._elapsed
        return self._health

    def _force(self, epoch: Epoch) -> Floats:
        """Fused specific force, m/s^2; NaN: there is no accelerometer."""
        if not len(epoch.forces_b):
            return NO_FORCE
        return self._force_fusion.fuse_readings(epoch.time_us, epoch.dt, epoch.forces_b).rate_b

    def _fits(self, epoch: Epoch) -> bool:
        if self._calibration is None:
            return True
        source = self.assembler.source
        info = source and self.ingest.info(source)
        self.mismatch = self._calibration.mismatch(
            max(len(epoch.rates_b), info.sensors if info else 0), info.name if info else ""
        )
        return not self.mismatch

    def _calibrated(self, epoch: Epoch) -> Epoch:
        if self._calibration is None:
            return epoch
        rates_b, forces_b = self._calibration.apply(epoch.rates_b, epoch.forces_b)
        return replace(epoch, rates_b=rates_b, forces_b=forces_b)
