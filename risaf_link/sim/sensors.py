"""An array of triads (gyros or accelerometers) and its errors.

A reading is the truth, plus a bias that walks, plus white noise, plus what faults do to it, held
within the sensor's range.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.sim.disturbances import Thermal
from risaf_link.sim.target import Strike


@dataclass(frozen=True, slots=True)
class TriadErrors:
    """What is wrong with every channel of a sound array, each on its own.

    The unit is the reading's: rad/s for gyros, m/s^2 for accelerometers.
    """

    noise_density: float  # unit/sqrt(Hz), two-sided: one sample's noise is this times sqrt(rate)
    initial_bias: float  # unit, standard deviation over the channels
    bias_walk: float  # unit/sqrt(s)
    full_scale: float  # unit; no reading is larger
    equal_biases: bool = False  # all start with the same size, and only the sign is random
    warming: Thermal | None = None


class TriadArray:
    """The sensors of an array, from sample to sample.

    Every cause of error draws from a generator of its own, so readings do not depend on how time is
    cut into blocks.

    Parameters
    ----------
    errors : TriadErrors
    sensors : int
    rate : float
        Samples a second.
    generator : numpy.random.Generator
        Its children are used, not itself.
    faults : sequence of Strike
        What spoils the readings, one after another.

    Attributes
    ----------
    bias_b : ndarray, shape (sensors, 3)
        The true bias at the last sample; without what comes by warming and faults.
    """

    def __init__(
        self,
        errors: TriadErrors,
        sensors: int,
        rate: float,
        generator: np.random.Generator,
        faults: Sequence[Strike] = (),
    ) -> None:
        self._errors = errors
        self._rate = rate
        self._samples = 0
        initial, self._white, self._walk = generator.spawn(3)
        bias_b = initial.normal(0.0, errors.initial_bias, (sensors, 3))
        self.bias_b: Floats = bias_b
        if errors.equal_biases:
            self.bias_b = np.copysign(errors.initial_bias, bias_b)
        warming = [errors.warming.drift(sensors, *initial.spawn(1))] if errors.warming else []
        self._strikes = [*warming, *faults]

    def read(self, truth_b: Floats) -> Floats:
        """Take the next samples.

        Parameters
        ----------
        truth_b : ndarray, shape (k, 3)
            What ideal sensors would read.

        Returns
        -------
        ndarray, shape (k, sensors, 3)
        """
        shape = (len(truth_b), *self.bias_b.shape)
        readings = self._biases(shape)
        readings += truth_b[:, np.newaxis]
        white = self._errors.noise_density * math.sqrt(self._rate)
        readings += white * self._white.standard_normal(shape)
        time_s = np.arange(self._samples, self._samples + len(truth_b)) / self._rate
        self._samples += len(truth_b)
        for strike in self._strikes:
            strike(time_s, truth_b, readings)
        limit = self._errors.full_scale
        return np.clip(readings, -limit, limit, out=readings)

    def _biases(self, shape: tuple[int, ...]) -> Floats:
        """Biases at the next samples; each has walked on by one step."""
        walk = self._errors.bias_walk / math.sqrt(self._rate)
        biases = walk * self._walk.standard_normal(shape)
        biases[:1] += self.bias_b
        np.cumsum(biases, axis=0, out=biases)
        if len(biases):
            self.bias_b = biases[-1].copy()
        return biases
