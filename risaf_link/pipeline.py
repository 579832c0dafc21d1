"""The datum's way, on one page: frames in, estimates out.

    Frame -> GyroChunk -> Epoch -> FusedRate -> AttitudeState + Innovation -> Estimate
           ingest      assembler  fusion      attitude filter

Nothing here reads a clock, opens a file or waits. A live link and a log feed the same function, so
that a live run that is recorded and replayed gives the same estimates, bit for bit.
"""

from functools import partial
from itertools import groupby, starmap
from zlib import crc32

import msgspec
import numpy as np
from msgspec import Struct, field, structs

from risaf_link.core.array import ArrayCalibration, Calibration
from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.estimate import ArrayStatus, Estimate, EstimateBlock
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import Epoch, EpochBlock, FusionParameters
from risaf_link.core.heading import GpsFix, HeadingFinder, HeadingMonitor, HeadingParameters
from risaf_link.core.memory import ArrayIdentity, Memory
from risaf_link.core.rotation import Floats
from risaf_link.core.track import ALIGNED, WALK, Track
from risaf_link.core.warm import WarmStart
from risaf_link.mavlink.clock import VehicleClock
from risaf_link.mavlink.dialect import IDS
from risaf_link.mavlink.epoch import ArrayParameters, EpochAssembler, GyroChunk
from risaf_link.mavlink.frame import Frame
from risaf_link.mavlink.ingest import SAMPLES, GpsParameters, Ingest

MOST_WAITING = 256  # epochs


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
    memory : Memory or None
        What was known before a restart.

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
        memory: Memory | None = None,
    ) -> None:
        p = parameters
        sensors = p.array.sensors or (len(calibration.gyros) if calibration else 0)
        self.ingest = Ingest(p.array, p.gps, own)
        clocks = {IDS["SYSTEM_TIME"], IDS["TIMESYNC"]}
        self._decisive = self.ingest.message_ids - SAMPLES | clocks
        self.assembler = EpochAssembler(structs.replace(p.array, sensors=sensors))
        self.mismatch = ""
        self._calibration = Calibration(calibration) if calibration else None
        self._checksum = crc32(msgspec.json.encode(calibration)) if calibration else 0
        self._clock = VehicleClock(own[1])
        self._parameters = p
        self._delay = 0.0  # s, of the samples
        estimator = Estimator(p.fusion, p.attitude, p.heading)
        self._start = WarmStart(estimator, memory, self._identity)
        self._finder = HeadingFinder(p.heading)
        self._monitor = HeadingMonitor(p.heading)
        self._waiting: list[tuple[Epoch, int]] = []
        self._latest: EstimateBlock | None = None

    def configure(self, parameters: PipelineParameters) -> None:
        """Take new parameters of fusion, heading and attitude, from the next epoch on.

        What was learnt stays. Another method of fusion starts anew; another filter waits for
        `restart`, and so does what is said of the filter's start.
        """
        p = self._parameters = parameters
        self._set_delay(self._delay)
        self._finder.configure(p.heading)
        self._monitor.configure(p.heading)

    def restart(self) -> None:
        """Start the attitude filter, and what judges its headings, anew; the array stays known."""
        self._start.give_up("the filter was started anew")
        self._start.estimator.restart()
        self._finder = HeadingFinder(self._parameters.heading)
        self._monitor = HeadingMonitor(self._parameters.heading)

    def set_bias(self, rate_b: Floats, variance: Floats) -> None:
        """Believe the mean fused rate of a vehicle at rest, (3,) rad/s, and its variance."""
        self._start.give_up("the bias was set anew")
        self._start.estimator.set_bias(rate_b, variance)

    def memory(self) -> Memory | None:
        """Tell what is known, so that it outlasts a restart; None: it is not worth it, or not yet.

        It is not while an older memory is on trial, nor at an epoch without a valid reading on some
        axis; and of other fusions than `robust` and other filters than `eskf` nothing can be told.
        """
        latest = self._latest
        if latest is None or self._start.is_on_trial:
            return None
        walk = latest.track.values[-1, WALK].copy()
        if not np.isfinite(walk).all():
            return None
        parts = self._start.estimator.memory(walk)
        if parts is None:
            return None
        gyros, accelerometers, attitude = parts
        times = int(latest.time_us[-1]), int(latest.received_us[-1])
        return Memory(self._identity(len(gyros)), *times, gyros, accelerometers, attitude)

    @property
    def recalled(self) -> str:
        """What came of the memory, in one line; empty: there is none, or it is not known yet."""
        return self._start.outcome

    def adopt(self, own: tuple[int, int]) -> None:
        """Take note that this service has other ids now."""
        self.ingest.own = own

    def now_us(self, unix_us: int) -> int:
        """What the clock of the estimates shows, us, at a time in microseconds since 1970."""
        return self._clock.now_us(unix_us)

    def step(self, frame: Frame, received_us: int) -> list[Estimate]:
        """Take one frame; the estimates that became possible by it, one an epoch.

        Parameters
        ----------
        frame : Frame
        received_us : int
            When it came, microseconds since 1970.
        """
        blocks = self.gather(frame, received_us) + self.release()
        return [estimate for block in blocks for estimate in block]

    def flush(self, received_us: int) -> list[EstimateBlock]:
        """Use what is left when the links, a log or a source of samples have ended."""
        self._wait(self.assembler.flush(), received_us)
        return self.release()

    def gather(self, frame: Frame, received_us: int) -> list[EstimateBlock]:
        """Take one frame as `step` does, only that epochs wait for `release`.

        They are released before a frame that bears on what they come to: estimates are the same.
        """
        blocks = self.release() if frame.message_id in self._decisive else []
        self._clock.hear(frame, received_us)
        datum = self.ingest.decode(frame, received_us)
        if isinstance(datum, GyroChunk):
            if datum.source != self.assembler.source:
                blocks += self.flush(received_us)  # their samples are as late as that source's
            self._wait(self.assembler.add(datum), received_us)
        elif isinstance(datum, GpsFix):
            self._correct(datum)
        return blocks + (self.release() if len(self._waiting) >= MOST_WAITING else [])

    def release(self) -> list[EstimateBlock]:
        """Use the epochs that wait."""
        if not self._waiting:
            return []
        waiting, self._waiting = self._waiting, []
        same_array = groupby(waiting, lambda each: (each[0].rates_b.shape, each[0].forces_b.shape))
        groups = (self._advance(EpochBlock.of(list(epochs))) for _, epochs in same_array)
        return [block for blocks in groups for block in blocks]

    def advance(self, epochs: EpochBlock) -> list[EstimateBlock]:
        """Carry the estimate on over epochs that ingest and assembler have handed on already."""
        return [*self.release(), *self._advance(epochs)]

    @property
    def elapsed(self) -> float:
        """Time of the last epoch, s."""
        return self._start.estimator.elapsed

    @property
    def may_go_ahead(self) -> bool:
        """Whether nothing but readings bears on the next epoch."""
        calibration, assembler = self._calibration, self.assembler
        return (
            not self._waiting
            and not self._start.is_on_trial
            and (calibration is None or self._fits(calibration, assembler.sensors))
            and self.ingest.delay_of(assembler.source) == self._delay
        )

    def go_ahead(
        self, time_us: int, received_us: int, dt: float, readings: bytes
    ) -> tuple[int, bytes] | None:
        """Carry fusion and filter on over an epoch that `advance` is given later.

        It is given all such epochs in one block, and nothing else is asked for before.

        Parameters
        ----------
        time_us, received_us, dt
            As in an `EpochBlock`.
        readings : bytes
            Its rates_b, and behind them forces_b.

        Returns
        -------
        int and bytes, or None
            The epoch's stamp on the vehicle's boot clock, us, and its row of the track. None:
            there is no kernel for that, and nothing has been done.
        """
        n = self.assembler.sensors
        if self._calibration:
            values = np.frombuffer(readings).reshape(1, -1, 3)
            corrected = self._calibration.apply(values[:, :n], values[:, n:])
            readings = b"".join(each.tobytes() for each in corrected)
        row = self._start.estimator.go_ahead(dt, readings, n)
        return None if row is None else (self._clock.stamp(time_us, received_us), row)

    def _wait(self, epochs: list[Epoch], received_us: int) -> None:
        self._waiting += [(epoch, received_us) for epoch in epochs]

    def _advance(self, epochs: EpochBlock) -> list[EstimateBlock]:
        """Carry the estimate on; none if the calibration is not of this array."""
        if self._calibration:
            if not self._fits(self._calibration, epochs.rates_b.shape[1]):
                return []
            rates_b, forces_b = self._calibration.apply(epochs.rates_b, epochs.forces_b)
            epochs = structs.replace(epochs, rates_b=rates_b, forces_b=forces_b)
        delay = self.ingest.delay_of(self.assembler.source)
        if delay != self._delay:
            self._set_delay(delay)
        return list(starmap(self._told, self._start.advance(epochs)))

    def _told(self, epochs: EpochBlock, track: Track, elapsed: Floats) -> EstimateBlock:
        self._latest = EstimateBlock(
            epochs.time_us,
            epochs.received_us,
            self._clock.stamps(epochs.time_us, epochs.received_us),
            self._clock.delay_us,
            elapsed,
            track,
            self._monitor.advance(elapsed, track.values[:, ALIGNED]),
            partial(self._array_status, epochs.rates_b.shape[1]),
        )
        return self._latest

    def _identity(self, sensors: int) -> ArrayIdentity:
        """Which array sends, if it has so many gyros."""
        source = self.assembler.source
        info = source and self.ingest.info(source)
        encoding, array_id = (source.encoding, source.array_id) if source else ("", 0)
        name = info.name if info else ""
        return ArrayIdentity(encoding, array_id, name, sensors, self._checksum)

    def _set_delay(self, delay: float) -> None:
        """Take samples for so many seconds old: a fix is less late than against present ones."""
        self._delay = delay
        self._clock.delay_us = round(delay * 1e6)
        self._start.estimator.configure(*self._in_force())

    def _in_force(self) -> tuple[FusionParameters, AttitudeParameters, HeadingParameters]:
        """Parameters of the estimator."""
        p = self._parameters
        heading = structs.replace(p.heading, delay=max(p.heading.delay - self._delay, 0.0))
        return p.fusion, p.attitude, heading

    def _correct(self, fix: GpsFix) -> None:
        """Correct the attitude by a GPS fix."""
        motion = self._finder.take(fix, self._start.estimator.elapsed)
        self._monitor.note_motion(motion)
        innovation = self._start.correct(motion, fix.latitude)
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
            self._start.estimator.fusion.health(),
        )

    def _fits(self, calibration: Calibration, sensors: int) -> bool:
        """Whether a calibration is that of the array."""
        source = self.assembler.source
        info = source and self.ingest.info(source)
        self.mismatch = calibration.mismatch(
            max(sensors, info.sensors if info else 0), info.name if info else ""
        )
        return not self.mismatch
