"""Centralised filters that weigh every reading: Huber's, maximum correntropy, variational Bayes.

All iterate one update: by the readings' distances from the rate as estimated, weights; by the
weights, the rate. They begin at the array's median, since at the predicted rate nothing agrees with
the array when the vehicle begins to turn, and a redescending weight would leave nothing.
"""

import math

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.experiments.central import RATE, Centralised, Form, medians
from risaf_link.experiments.method import ArrayModel

MAX_ITERATIONS = 10
CONVERGED = 0.02  # standard deviations of one reading, by which the rate moves
LEAST_WEIGHT = 1e-12
TINY = 1e-300


class Reweighted(Centralised):
    """A centralised filter whose measurements have weights that depend on the estimate."""

    def measure(self, rates_b: Floats) -> None:
        """Update by all readings of an epoch, (n, 3), iterated until the rate stays."""
        offset, valid = self.offsets(rates_b)
        std = math.sqrt(self.variance)
        covariance = self.covariance
        at = medians(offset, valid)
        for _ in range(MAX_ITERATIONS):
            information = self.weigh((offset - at[:, None]) / std) * valid / self.variance
            change = self.form.change(covariance, offset, information)
            moved = np.abs(change[RATE] - at).max()
            at = change[RATE]
            covariance = self.weigh_prior(change)
            if moved < CONVERGED * std:
                break
        information = self.weigh((offset - at[:, None]) / std) * valid / self.variance
        self.apply(*self.form.update(covariance, offset, information))

    def weigh(self, distances: Floats) -> Floats:
        """Weights of measurements that are so many standard deviations off, (3, n)."""
        raise NotImplementedError

    def weigh_prior(self, _: Floats) -> Floats:
        """Covariance of the prediction, by how far the estimate has left it, (9,)."""
        return self.covariance


class Huber(Reweighted):
    """Huber's M-estimator in the measurement update.

    Weights are 1 up to `threshold` standard deviations and threshold over distance beyond. Of the
    measurements only, as in Chang, Hu, Chang and Li, "Robust derivative-free Kalman filter based on
    Huber's M-estimation methodology", Journal of Process Control 23, 2013; the threshold is that of
    95 % efficiency on Gaussian noise, as in Karlgaard and Schaub, "Huber-Based Divided Difference
    Filtering", Journal of Guidance, Control, and Dynamics 30, 2007.
    """

    def __init__(self, array: ArrayModel, threshold: float = 1.345, form: Form = "compact") -> None:
        super().__init__(array, form)
        self._threshold = threshold

    def weigh(self, distances: Floats) -> Floats:
        """Weights of measurements."""
        size = np.maximum(np.abs(distances), TINY)
        weights: Floats = np.minimum(self._threshold / size, 1.0)
        return weights


class Correntropy(Reweighted):
    """The maximum correntropy Kalman filter.

    Every part of the prediction and every measurement has the weight `exp(-e^2 / (2 width^2))`, e
    its error in standard deviations, those of the prediction along the columns of the Cholesky
    factor of its covariance: Chen, Liu, Zhao and Principe, "Maximum correntropy Kalman filter",
    Automatica 76, 2017. The kernel's width is one of those of their section 5.
    """

    def __init__(self, array: ArrayModel, width: float = 2.0, form: Form = "compact") -> None:
        super().__init__(array, form)
        self._scale = -0.5 / width**2

    def weigh(self, distances: Floats) -> Floats:
        """Weights of measurements."""
        weights: Floats = np.exp(self._scale * distances**2)
        return np.maximum(weights, LEAST_WEIGHT)

    def weigh_prior(self, change: Floats) -> Floats:
        """Covariance of the prediction."""
        factor = np.linalg.cholesky(self.covariance)
        errors = np.linalg.solve(factor, change)
        weights = np.maximum(np.exp(self._scale * errors**2), LEAST_WEIGHT)
        covariance: Floats = (factor / weights) @ factor.T
        return covariance


class Variational(Centralised):
    """The variational Bayesian adaptive filter: the variance of every channel is estimated as well.

    Inverse gamma distributions, which forget by `memory` an epoch: Sarkka and Nummenmaa, "Recursive
    Noise Adaptive Kalman Filtering by Variational Bayesian Approximations", IEEE Transactions on
    Automatic Control 54, 2009; the memory is that of their example. `shape` is how much is known of
    the variances at first: that many half samples.
    """

    ITERATIONS = 3

    def __init__(
        self,
        array: ArrayModel,
        memory: float = 1.0 - math.exp(-4.0),
        shape: float = 1.0,
        form: Form = "compact",
    ) -> None:
        super().__init__(array, form)
        self._memory = memory
        self._alpha = np.full((3, array.sensors), shape)
        self._beta = self._alpha * self.variance

    def measure(self, rates_b: Floats) -> None:
        """Update by all readings of an epoch, (n, 3)."""
        offset, valid = self.offsets(rates_b)
        self._alpha *= self._memory
        self._beta *= self._memory
        beta = self._beta
        self._alpha = self._alpha + 0.5 * valid
        change, updated = np.zeros(9), self.covariance
        at, spread = medians(offset, valid), np.zeros(3)
        for _ in range(self.ITERATIONS):
            squares = (offset - at[:, None]) ** 2 + spread[:, None]
            self._beta = beta + 0.5 * squares * valid
            information = self._alpha / self._beta * valid
            change, updated = self.form.update(self.covariance, offset, information)
            at, spread = change[RATE], updated.diagonal()[RATE]
        squares = (offset - at[:, None]) ** 2 + spread[:, None]
        self._beta = beta + 0.5 * squares * valid
        self.apply(change, updated)
