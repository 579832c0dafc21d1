"""The particle filter with a likelihood of maximum correntropy."""

import math

import numpy as np

from risaf_link.core.attitude import AttitudeParameters, Innovation
from risaf_link.core.fusion import Epoch
from risaf_link.core.heading import HeadingParameters
from risaf_link.core.rotation import Floats, wrap, wraps
from risaf_link.core.yaw_history import YawHistory
from risaf_link.experiments.central import common_bias_std, medians
from risaf_link.experiments.method import ArrayModel, Estimate, Gps, HeadingGate
from risaf_link.experiments.so3 import exp, exps

SHRINK = 0.98  # Liu and West: (3 d - 1) / (2 d), for their discount d between 0.95 and 0.99


class Particles:
    """Particles of attitude and bias, with correntropy for the sensors and for GPS.

    The array's rate is the location of greatest correntropy of the readings of an axis, by fixed
    point from their median; it drives the particles. A heading weighs them by
    `exp(width^2 (exp(-e^2 / (2 width^2)) - 1))`, e its error in standard deviations: Gaussian near
    0, and never less than `exp(-width^2)`, so an outlier cannot kill the right ones (the kernel of
    Liu, Pokharel and Principe, "Correntropy: Properties and Applications in Non-Gaussian Signal
    Processing", IEEE Transactions on Signal Processing 55, 2007). Resampling is systematic, when
    the effective number is below half (Arulampalam, Maskell, Gordon and Clapp, "A Tutorial on
    Particle Filters for Online Nonlinear/Non-Gaussian Bayesian Tracking", IEEE Transactions on
    Signal Processing 50, 2002); since biases hardly move, particles that were doubled are spread by
    the shrinking kernel of Liu and West, "Combined Parameter and State Estimation in
    Simulation-Based Filtering", 2001, which keeps mean and covariance.

    Parameters
    ----------
    array : ArrayModel
    width : float
        Of the kernel, standard deviations.
    count : int
    """

    def __init__(self, array: ArrayModel, width: float = 2.0, count: int = 500) -> None:
        p = AttitudeParameters()
        self._headings = HeadingGate(HeadingParameters(gate=1e9))  # the kernel is the gate
        self._width = width
        self._variance = array.noise**2 + array.bias**2
        self._noise = array.noise / math.sqrt(array.sensors)
        self._bias_walk = p.bias_walk
        self._random = np.random.default_rng(0)
        draw = self._random.standard_normal((count, 6))
        self._matrix_nb = np.eye(3)  # the middle; the particles' errors are on its left
        self._error = draw[:, :3] * [p.initial_tilt_std, p.initial_tilt_std, 0.0]  # rad, NED
        self._bias = draw[:, 3:] * common_bias_std(array)  # rad/s, body
        self._weights = np.full(count, 1.0 / count)
        self._aligned = False
        self._yaws = YawHistory()  # of the middle

    def step(self, epoch: Epoch) -> None:
        """Carry the particles on to an epoch."""
        rate_b = self.fuse(epoch.rates_b)
        if epoch.dt > 0:
            self._turn(rate_b, epoch.dt)
            self._headings.advance(epoch.dt)
        self._yaws.advance(epoch.dt, self._middle)

    def fuse(self, rates_b: Floats) -> Floats:
        """Location of greatest correntropy of the readings, (n, 3), on each axis, rad/s."""
        readings = rates_b.T
        valid = np.isfinite(readings)
        readings = np.where(valid, readings, 0.0)
        at = medians(readings, valid.astype(float))
        for _ in range(10):
            distance = readings - at[:, None]
            weights = np.exp(-(distance**2) / (2.0 * self._width**2 * self._variance)) * valid
            total = np.maximum(weights.sum(axis=1), 1e-300)
            moved = np.einsum("ij,ij->i", weights, distance) / total
            at = at + moved
            if np.abs(moved).max() < 1e-3 * math.sqrt(self._variance):
                break
        return at

    def _turn(self, rate_b: Floats, dt: float) -> None:
        """Turn the middle by the mean rate, and the particles against it."""
        count = len(self._bias)
        bias = self._weights @ self._bias
        halfway = self._matrix_nb @ exp((rate_b - bias) * dt / 2.0)
        self._matrix_nb = self._matrix_nb @ exp((rate_b - bias) * dt)
        noise = self._noise * self._random.standard_normal((count, 3))
        self._error += (noise - (self._bias - bias)) @ halfway.T * dt
        walk = self._bias_walk * math.sqrt(dt)
        self._bias += walk * self._random.standard_normal((count, 3))

    def correct(self, gps: Gps) -> None:
        """Use a fix."""
        self._headings.take(self, gps)

    def correct_heading(
        self, heading: float, variance: float, age: float, gate: float
    ) -> Innovation:
        """Weigh the particles by a heading; the first one sets yaw."""
        if not self._aligned:
            return self.reset_heading(heading, variance, age, gate)
        change = wrap(self._middle - self._middle_before(age))
        yaws = self._yaw_errors()
        error = wrap(heading + change - self._middle)
        innovation = Innovation(
            error - float(self._weights @ yaws), self._spread(yaws) + variance, gate
        )
        square = (error - yaws) ** 2 / variance
        kernel = self._width**2 * np.expm1(-square / (2.0 * self._width**2))
        weights = self._weights * np.exp(kernel - kernel.max())
        self._weights = weights / weights.sum()
        if len(weights) * float(self._weights @ self._weights) > 2.0:
            self._resample()
        self._recentre()
        return innovation

    def reset_heading(self, heading: float, variance: float, age: float, gate: float) -> Innovation:
        """Set the yaw of all particles by a heading."""
        error = wrap(heading - self._middle_before(age))
        self._matrix_nb = exp(np.array([0.0, 0.0, error])) @ self._matrix_nb
        self._yaws.correct(error)
        count = len(self._weights)
        self._error[:, 2] = math.sqrt(variance) * self._random.standard_normal(count)
        self._aligned = True
        return Innovation(error, math.pi**2 + variance, gate, reset=True)

    def estimate(self) -> Estimate:
        """Say the heading as of the last epoch."""
        yaws = self._yaw_errors()
        mean = float(self._weights @ yaws)
        yaw = wrap(self._middle + mean) if self._aligned else math.nan
        std = math.sqrt(self._spread(yaws)) if self._aligned else math.pi
        return Estimate(yaw, std, float(self._weights @ self._bias[:, 2]))

    @property
    def _middle(self) -> float:
        """Yaw of the middle."""
        return math.atan2(self._matrix_nb[1, 0], self._matrix_nb[0, 0])

    def _middle_before(self, age: float) -> float:
        yaw = self._yaws.before(age)
        return self._middle if yaw is None else yaw

    def _yaw_errors(self) -> Floats:
        """Yaw of every particle against the middle, rad, (m,)."""
        forward = np.einsum("kij,j->ki", exps(self._error), self._matrix_nb[:, 0])
        return wraps(np.arctan2(forward[:, 1], forward[:, 0]) - self._middle)

    def _spread(self, yaws: Floats) -> float:
        mean = float(self._weights @ yaws)
        return float(self._weights @ (yaws - mean) ** 2)

    def _resample(self) -> None:
        count = len(self._weights)
        state = np.hstack([self._error, self._bias])
        mean = self._weights @ state
        offset = state - mean
        covariance = (offset * self._weights[:, None]).T @ offset
        places = (np.arange(count) + self._random.random()) / count
        chosen = np.searchsorted(np.cumsum(self._weights), places).clip(max=count - 1)
        values, axes = np.linalg.eigh(covariance)
        spread = axes * np.sqrt(np.maximum(values, 0.0) * (1.0 - SHRINK**2))
        state = mean + SHRINK * offset[chosen]
        state += self._random.standard_normal((count, 6)) @ spread.T
        self._error, self._bias = state[:, :3].copy(), state[:, 3:].copy()
        self._weights = np.full(count, 1.0 / count)

    def _recentre(self) -> None:
        """Move the middle to the mean, so that errors stay small rotations."""
        mean = self._weights @ self._error
        before = self._middle
        self._matrix_nb = exp(mean) @ self._matrix_nb
        self._error = self._error - mean
        self._yaws.correct(wrap(self._middle - before))
