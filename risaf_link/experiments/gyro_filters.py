"""Methods that make one rate of the array first, and filter it afterwards."""

import math

import numpy as np

from risaf_link.core.attitude import AttitudeParameters
from risaf_link.core.estimator import Estimator
from risaf_link.core.fusion import Epoch, EpochBlock, FusionParameters
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import Floats, wrap
from risaf_link.experiments.method import Aided, ArrayModel, Estimate, Gps, estimate_of, one_rate
from risaf_link.experiments.so3 import exp

PAPER = AttitudeParameters(filter="paper")


class Service:
    """A fusion and a filter of the service, with all that it feeds them.

    Parameters
    ----------
    fusion : FusionParameters
    attitude : AttitudeParameters
    """

    def __init__(self, fusion: FusionParameters, attitude: AttitudeParameters) -> None:
        self._estimator = Estimator(fusion, attitude, HeadingParameters())
        self.fusion = self._estimator.fusion
        self._waiting: list[Epoch] = []  # until somebody asks
        self._estimate = Estimate(math.nan, math.pi, 0.0)

    def step(self, epoch: Epoch) -> None:
        """Carry the estimate on to an epoch."""
        self._waiting.append(epoch)

    def correct(self, gps: Gps) -> None:
        """Use a fix: its heading, speed and latitude."""
        self._advance()
        self._estimator.correct(gps.motion, gps.latitude)

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        self._advance()
        return self._estimate

    def _advance(self) -> None:
        epochs, self._waiting = self._waiting, []
        if epochs:
            block = EpochBlock.of([(epoch, 0) for epoch in epochs])
            track, _ = self._estimator.advance(block.dt, block.rates_b, block.forces_b)
            self._estimate = estimate_of(track)


class Ours(Service):
    """The service as it comes."""

    def __init__(self, _: ArrayModel) -> None:
        super().__init__(FusionParameters(), AttitudeParameters())


class Risaf(Service):
    """The paper's method as printed: eq. 5 to 8, and its filter.

    Parameters
    ----------
    alpha : float
        Memory of eq. 5, an epoch.
    gate : float
        Share of the readings that eq. 6 leaves out on either side.
    """

    def __init__(self, _: ArrayModel, alpha: float = 0.995, gate: float = 0.2) -> None:
        parameters = FusionParameters(
            method="risaf", alpha=alpha, lower_quantile=gate, upper_quantile=1.0 - gate
        )
        super().__init__(parameters, PAPER)


class RobustFusion(Service):
    """Our fusion with the paper's filter: what the fusion alone does."""

    def __init__(self, _: ArrayModel) -> None:
        super().__init__(FusionParameters(), PAPER)


class MeanEkf(Service):
    """The paper's baseline, its "Standard EKF": the array's mean, and its filter."""

    def __init__(self, _: ArrayModel) -> None:
        super().__init__(FusionParameters(method="mean"), PAPER)


class SingleEkf(Aided):
    """The paper's filter on one sensor of the array, the first.

    A reading that is not valid is left out: the filter waits for the next.
    """

    def __init__(self, array: ArrayModel) -> None:
        super().__init__()
        self._variance = array.noise**2

    def step(self, epoch: Epoch) -> None:
        """Carry the estimate on to an epoch."""
        self.advance(one_rate(epoch, epoch.rates_b[0], self._variance, 1), epoch.dt)


class Integration:
    """The array's mean, integrated from the first heading on; nothing corrects it any more.

    The attitude starts level, as that of the paper's filter.
    """

    def __init__(self, array: ArrayModel) -> None:
        self._matrix_nb = np.eye(3)
        self._aligned = False
        self._variance = 0.0
        self._step_variance = (array.noise / array.rate) ** 2 / array.sensors

    def step(self, epoch: Epoch) -> None:
        """Carry the attitude on; an axis without a valid reading does not turn."""
        valid = np.isfinite(epoch.rates_b)
        rate_b = np.where(valid, epoch.rates_b, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
        self._matrix_nb = self._matrix_nb @ exp(rate_b * epoch.dt)
        self._variance += self._step_variance

    def correct(self, gps: Gps) -> None:
        """Take the first heading for yaw."""
        heading = gps.motion.heading
        if heading is None or self._aligned:
            return
        turn = exp(np.array([0.0, 0.0, wrap(heading.heading - self._yaw)]))
        self._matrix_nb = turn @ self._matrix_nb
        self._variance = heading.variance
        self._aligned = True

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        yaw = self._yaw if self._aligned else math.nan
        return Estimate(yaw, math.sqrt(self._variance), math.nan)

    @property
    def _yaw(self) -> float:
        return math.atan2(self._matrix_nb[1, 0], self._matrix_nb[0, 0])


class Virtual(Aided):
    """The augmented virtual filter: a bias for each sensor, and one virtual sensor to filter.

    As Hanani and Kipnis describe it (section II): the array is compressed to one synthetic reading
    before the prediction, without weights, and without a bias of each sensor in the filter's state.
    The particulars are ours. A scalar Kalman filter a channel estimates its bias against the array,
    a random walk seen through white noise; the synthetic reading is the mean of the readings less
    these. As long as all sensors are valid the biases' sum is zero, and it is the plain mean.
    """

    def __init__(self, array: ArrayModel) -> None:
        super().__init__()
        self._noise = array.noise**2
        self._walk = array.bias_walk**2
        self._bias = np.zeros((array.sensors, 3))
        self._variance = np.full((array.sensors, 3), array.bias**2)

    @property
    def relative_bias(self) -> Floats:
        """Of each sensor against the array, rad/s, (n, 3)."""
        return self._bias

    def step(self, epoch: Epoch) -> None:
        """Carry the estimate on to an epoch."""
        valid = np.isfinite(epoch.rates_b)
        count = np.maximum(valid.sum(axis=0), 1)
        corrected = np.where(valid, epoch.rates_b - self._bias, 0.0)
        rate_b = np.where(valid.any(axis=0), corrected.sum(axis=0) / count, np.nan)
        self._variance += self._walk * epoch.dt
        gain = np.where(valid, self._variance / (self._variance + self._noise), 0.0)
        self._bias += gain * np.nan_to_num(corrected - rate_b)
        self._variance *= 1.0 - gain
        self.advance(one_rate(epoch, rate_b, self._noise, int(count.min())), epoch.dt)
