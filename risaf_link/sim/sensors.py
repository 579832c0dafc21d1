"""An array of triads (gyros or accelerometers) and its errors.

A reading is the truth, plus a bias that walks, plus white noise, plus now and then a spike, held
within the sensor's range.
"""

import math
from dataclasses import dataclass

import numpy as np

from risaf_link.core.rotation import Floats


@dataclass(frozen=True, slots=True)
class TriadErrors:
    """What is wrong with every channel of an array, each on its own.

    The unit is the reading's: rad/s for gyros, m/s^2 for accelerometers.
    """

    noise_density: float  # unit/sqrt(Hz), two-sided: one sample's noise is this times sqrt(rate)
    initial_bias: float  # unit, standard deviation over the channels
    bias_walk: float  # unit/sqrt(s)
    spike_probability: float  # of each sample of each channel
    spike_amplitude: float  # unit, mean size; both signs
    full_scale: float  # unit; no reading is larger


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

    Attributes
    ----------
    bias_b : ndarray, shape (sensors, 3)
        The true bias at the last sample.
    """

    def __init__(
        self, errors: TriadErrors, sensors: int, rate: float, generator: np.random.Generator
    ) -> None:
        self._errors = errors
        self._rate = rate
        initial, self._white, self._walk, self._hits, self._spikes = generator.spawn(5)
        self.bias_b: Floats = initial.normal(0.0, errors.initial_bias, (sensors, 3))

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
        self._add_spikes(readings)
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

    def _add_spikes(self, readings: Floats) -> None:
        """Add spikes of half to one and a half times the mean size."""
        hit = self._hits.random(readings.shape) < self._errors.spike_probability
        shares = self._spikes.uniform(-1.0, 1.0, np.count_nonzero(hit))
        readings[hit] += self._errors.spike_amplitude * (shares + np.copysign(0.5, shares))
