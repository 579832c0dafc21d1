"""The robust M-M unscented Kalman filter.

Yang, Shi and Chen, "Robust M-M unscented Kalman filtering for GPS/IMU navigation", Journal of
Geodesy 93, 2019: an unscented filter in which the principle of M-estimation weighs the measurements
and the prediction both, with bi-factor equivalent weights (Yang, Song and Xu, "Robust estimator for
correlated observations based on bifactor equivalent weights", Journal of Geodesy 76, 2002), which
leave correlations as they are.
"""

import numpy as np

from risaf_link.core.rotation import Floats
from risaf_link.experiments.central import ATTITUDE, BIAS, DOWN, RATE, Form
from risaf_link.experiments.method import ArrayModel
from risaf_link.experiments.robust_filters import Reweighted
from risaf_link.experiments.so3 import exps, logs

KEEP, DROP = 1.5, 3.0  # standard deviations: full weight up to, least weight from; as usual in IGG
LEAST_WEIGHT = 1e-3  # so that a variance stays finite
SIZE = 9


class Unscented(Reweighted):
    """The robust M-M unscented filter on all 3 n readings.

    A reading is linear in the state, so its update by sigma points is that of the covariance; they
    carry the attitude.

    Parameters
    ----------
    keep, drop : float
        Distances, in standard deviations, of full and of least weight.
    """

    def __init__(
        self, array: ArrayModel, keep: float = KEEP, drop: float = DROP, form: Form = "compact"
    ) -> None:
        super().__init__(array, form)
        self._keep, self._drop = keep, drop
        # The first heading sets yaw, whatever is believed of it before; sigma points must be near.
        self.covariance[DOWN, DOWN] = self.covariance[0, 0]

    def weigh(self, distances: Floats) -> Floats:
        """Weights of measurements."""
        return igg(distances, self._keep, self._drop)

    def weigh_prior(self, change: Floats) -> Floats:
        """Covariance of the prediction: a bi-factor on every row and column."""
        prior = self.covariance
        weights = igg(change / np.sqrt(prior.diagonal()), self._keep, self._drop)
        factors = 1.0 / np.sqrt(weights)
        covariance: Floats = prior * np.outer(factors, factors)
        return covariance

    def turn(self, dt: float) -> None:
        """Turn the attitude, by symmetric sigma points of equal weights.

        Julier and Uhlmann, "Unscented Filtering and Nonlinear Estimation", Proceedings of the IEEE
        92, 2004, section III.
        """
        root = np.linalg.cholesky(SIZE * self.covariance).T
        points = np.concatenate([root, -root])
        rates_b = self.rate_b - self.bias_b + points[:, RATE] - points[:, BIAS]
        turned = exps(points[:, ATTITUDE]) @ self.matrix_nb @ exps(rates_b * dt)
        centre = self.matrix_nb @ exps((self.rate_b - self.bias_b)[None] * dt)[0]
        points[:, ATTITUDE] = logs(turned @ centre.T)
        mean = points.mean(axis=0)
        points = points - mean
        self.matrix_nb = exps(mean[None, ATTITUDE])[0] @ centre
        self.covariance = points.T @ points / len(points)


def igg(distances: Floats, keep: float, drop: float) -> Floats:
    """Equivalent weights of distances in standard deviations: IGG III."""
    size = np.maximum(np.abs(distances), keep)
    if not np.isfinite(keep):
        return np.ones_like(distances)
    part = np.clip((drop - size) / (drop - keep), 0.0, 1.0)
    weights: Floats = np.maximum(keep / size * part**2, LEAST_WEIGHT)
    return weights
