"""Readings -> attitude: what is done at every epoch, for a run of epochs at once.

    readings -> FusedRate -> predict -> gravity and rest

Where there is a kernel it does the run; what it does at an epoch is `step`. What GPS says comes in
between two runs.
"""

from collections.abc import Callable, Iterable

import numpy as np
from msgspec import structs

from risaf_link.core import kernel
from risaf_link.core.attitude import AttitudeParameters, AttitudeState, Innovation, PaperFilter
from risaf_link.core.earth import EARTH_RATE
from risaf_link.core.error_state import BIAS_AXES
from risaf_link.core.fusion import Epoch, FusedRate, Fusion, FusionParameters
from risaf_link.core.guard import HeadingGuard
from risaf_link.core.heading import HeadingParameters, Motion
from risaf_link.core.memory import ArrayMemory, FilterMemory
from risaf_link.core.rotation import Floats
from risaf_link.core.track import COLUMNS, RESETS, Track

FUSIONS: dict[str, Callable[[FusionParameters], Fusion]] = {
    "robust": kernel.Robust,
    "risaf": kernel.Risaf,
    "median": kernel.Median,
    "mean": kernel.Mean,
}
FORCE_RESOLUTION = 0.02  # m/s^2; no accelerometer is blamed for less
NO_FORCE = np.full(3, np.nan)


class Estimator:
    """A fusion, a filter, what aids it at every epoch, and what stands guard over its headings.

    Parameters
    ----------
    fusion : FusionParameters
    attitude : AttitudeParameters
    heading : HeadingParameters

    Attributes
    ----------
    fusion : Fusion
    elapsed : float
        Time of the last epoch, s.
    """

    def __init__(
        self, fusion: FusionParameters, attitude: AttitudeParameters, heading: HeadingParameters
    ) -> None:
        self.fusion = FUSIONS[fusion.method](fusion)
        self._force_fusion = kernel.Robust(structs.replace(fusion, resolution=FORCE_RESOLUTION))
        self.elapsed = 0.0
        self._parameters = fusion, attitude, heading
        self._resets = 0  # of yaw, by the filters before this one
        self._ahead: list[bytes] = []  # rows of epochs that `advance` will be given
        self._begin()

    @property
    def parameters(self) -> tuple[FusionParameters, AttitudeParameters, HeadingParameters]:
        """What is in force."""
        return self._parameters

    def restart(self) -> None:
        """Start the filter, and what aids and guards it, anew; the array stays known."""
        self._resets += self._filter.state(0).resets
        self._begin()

    def _begin(self) -> None:
        _, attitude, heading = self._parameters
        self._filter: kernel.Eskf | PaperFilter
        if attitude.filter == "eskf":
            self._filter = kernel.Eskf(attitude, heading)
        else:
            self._filter = PaperFilter(attitude)
        self._aiding = kernel.Aiding(attitude)  # of the Eskf
        self._guard = HeadingGuard(heading, not isinstance(self._filter, PaperFilter))

    def configure(
        self, fusion: FusionParameters, attitude: AttitudeParameters, heading: HeadingParameters
    ) -> None:
        """Take new parameters; what was learnt stays.

        Another method of fusion starts anew; another filter waits for `restart`, and so does what
        is said of the filter's start.
        """
        before, *_ = self._parameters
        self._parameters = fusion, attitude, heading
        if fusion.method != before.method:
            self.fusion = FUSIONS[fusion.method](fusion)
        self.fusion.configure(fusion)
        self._force_fusion.configure(structs.replace(fusion, resolution=FORCE_RESOLUTION))
        if isinstance(self._filter, PaperFilter):
            self._filter.configure(attitude)
        else:
            self._filter.configure(attitude, heading)
        self._guard.configure(heading)

    def set_bias(self, rate_b: Floats, variance: Floats) -> None:
        """Believe the mean rate of a vehicle that rests, whatever the bias was held to be.

        Parameters
        ----------
        rate_b, variance : ndarray, shape (3,)
            Mean of the fused rate, bias not taken off, rad/s, and its variance.
        """
        if isinstance(self._filter, PaperFilter):
            self._filter.set_bias(rate_b, variance)
            return
        covariance = self._filter.covariance
        error = rate_b - self._filter.state(0).bias_b
        covariance[BIAS_AXES, BIAS_AXES] += float(error @ error) + EARTH_RATE**2
        self._filter.set_covariance(covariance)
        self._filter.correct_zero_rate(rate_b, variance, confirmed=True)

    def memory(self, bias_walk: Floats) -> tuple[ArrayMemory, ArrayMemory, FilterMemory] | None:
        """Tell what is known of gyros, accelerometers and attitude.

        None: this fusion, or this filter, cannot tell. `bias_walk`, (3,), is that of the last
        fused rate.
        """
        if not isinstance(self.fusion, kernel.Robust) or isinstance(self._filter, PaperFilter):
            return None
        parts = self.fusion.memory(), self._force_fusion.memory()
        return *parts, self._filter.memory(bias_walk)

    def recall(
        self,
        gyros: ArrayMemory,
        accelerometers: ArrayMemory | None,
        attitude: FilterMemory | None,
        resets: int,
        steps: Iterable[tuple[FusedRate, float]],
    ) -> None:
        """Go on from what was known before a restart; None: of that, nothing is.

        Parameters
        ----------
        gyros, accelerometers : ArrayMemory
        attitude : FilterMemory
        resets : int
            How often yaw has been set since.
        steps : iterable of FusedRate and float
            Rates, and for how long each, s, from then until now.
        """
        if not isinstance(self.fusion, kernel.Robust) or isinstance(self._filter, PaperFilter):
            raise TypeError("recall: found another fusion or filter, expected robust and eskf")
        self.fusion.recall(gyros)
        if accelerometers is not None:
            self._force_fusion.recall(accelerometers)
        if attitude is not None:
            self._filter.recall(attitude, resets)
            for fused, dt in steps:
                self._filter.predict(fused, dt)
            self._guard.note_hearsay()

    def go_ahead(self, dt: float, readings: bytes, n: int) -> bytes | None:
        """Carry fusion and filter on over one epoch, of which `advance` takes account later.

        Nothing else may be asked for until `advance` has been given all such epochs at once.

        Parameters
        ----------
        dt : float
            Seconds since the epoch before.
        readings : bytes
            Of n gyros, and behind them of the accelerometers: those of `advance`, as doubles.

        Returns
        -------
        bytes or None
            The epoch's row of the track. None: fusion or filter are not the kernel's, and nothing
            has been done.
        """
        parts = self.fusion, self._force_fusion, self._filter, self._aiding
        row = kernel.advance_one(*parts, dt, readings, n)
        if row is not None:
            self._ahead.append(row)
        return row

    def advance(self, dt: Floats, rates_b: Floats, forces_b: Floats) -> tuple[Track, Floats]:
        """Carry the estimate on over k epochs, at least one.

        Parameters
        ----------
        dt : ndarray, shape (k,)
            Seconds, each since the epoch before.
        rates_b, forces_b : ndarray, shapes (k, n, 3) and (k, m, 3)
            rad/s and m/s^2; NaN where not valid. m may be 0.

        Returns
        -------
        track : Track
        elapsed : ndarray, shape (k,)
            Time of each epoch, s.
        """
        parts = self.fusion, self._force_fusion, self._filter, self._aiding
        if self._ahead:
            values: Floats | None = self._take_ahead(len(dt))
        else:
            values = kernel.advance(*parts, dt, rates_b, forces_b)
        if values is None:
            epochs = zip(dt.tolist(), rates_b, forces_b, strict=True)
            track = Track.of([step(*parts, Epoch(0, *epoch, 0)) for epoch in epochs])
        else:
            track = Track(values)
        if self._resets:
            track.values[:, RESETS] += self._resets
        elapsed: Floats = dt.copy()
        elapsed[0] += self.elapsed
        if len(dt) > 1:
            elapsed.cumsum(out=elapsed)
        self.elapsed = float(elapsed[-1])
        self._guard.advance(track, elapsed, dt)
        return track, elapsed

    def _take_ahead(self, epochs: int) -> Floats:
        """Rows of the track that is known already."""
        rows: Floats = np.frombuffer(bytearray().join(self._ahead)).reshape(-1, COLUMNS)
        self._ahead.clear()
        if len(rows) != epochs:
            raise ValueError(f"dt: found {epochs} epochs, expected the {len(rows)} gone ahead of")
        return rows

    def correct(self, motion: Motion, latitude: float) -> Innovation | None:
        """Use what a fix says; None: it says nothing of heading.

        Parameters
        ----------
        motion : Motion
        latitude : float
            rad.
        """
        gear = self._guard.gear.sign
        innovation = self._guard.take(self._filter, motion)
        if not isinstance(self._filter, PaperFilter):
            self._filter.set_latitude(latitude)
            if self._guard.gear.sign != gear:
                self._aiding.speed.turn_round()
            if motion.along and motion.is_news and not motion.contradicted:
                ahead = self._guard.ahead(motion)
                self._aiding.speed.hear(ahead, motion.speed_std**2, self._parameters[2].delay)
        return innovation


def step(
    gyros: Fusion,
    accelerometers: kernel.Robust,
    attitude: kernel.Eskf | PaperFilter,
    aiding: kernel.Aiding,
    epoch: Epoch,
) -> tuple[FusedRate, AttitudeState, Floats]:
    """Carry all of them on by one epoch; the fused rate, the attitude and the specific force."""
    fused = gyros.fuse(epoch)
    attitude.predict(fused, epoch.dt)
    force_b = NO_FORCE
    if len(epoch.forces_b):
        force_b = accelerometers.fuse_readings(0, epoch.dt, epoch.forces_b).rate_b
    if not isinstance(attitude, PaperFilter):
        aiding.take(attitude, fused, force_b, epoch.dt)
    return fused, attitude.state(0), force_b
