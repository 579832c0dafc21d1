"""Allan deviation of a gyro, and the noise coefficients that are read off it."""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from risaf_link.core.rotation import Floats

FLICKER = 2.0 * np.log(2.0) / np.pi  # Allan variance of flicker noise, of its coefficient squared


class Coefficients(NamedTuple):
    """What an Allan deviation is made of; NaN where it does not show in the record."""

    arw: float  # rad/s/sqrt(Hz), angle random walk
    bias_instability: float  # rad/s
    rate_random_walk: float  # rad/s/sqrt(s)


def allan_deviation(rates: Floats, period: float) -> tuple[Floats, Floats]:
    """Overlapping Allan deviation.

    IEEE Std 952-1997, annex C, in its form for angles: of a third of the record at most.

    Parameters
    ----------
    rates : ndarray, shape (k, ...)
        Samples at rest, rad/s.
    period : float
        s from one to the next.

    Returns
    -------
    times : ndarray, shape (m,)
        Averaging times, s, a few a decade.
    deviations : ndarray, shape (m, ...)
        rad/s.
    """
    angles = np.concatenate([np.zeros((1, *rates.shape[1:])), np.cumsum(rates, axis=0)]) * period
    longest = max(1, len(rates) // 3)
    sizes = np.unique(np.geomspace(1, longest, 40).astype(int))
    deviations = []
    for size in sizes:
        second = angles[2 * size :] - 2.0 * angles[size:-size] + angles[: -2 * size]
        deviations.append(np.sqrt((second**2).mean(axis=0) / 2.0) / (size * period))
    return sizes * period, np.array(deviations)


def coefficients(times: Floats, deviations: Floats) -> Coefficients:
    """Fit angle random walk, bias instability and rate random walk to an Allan deviation, (m,).

    `variance = N^2 / t + B^2 2 ln 2 / pi + K^2 t / 3`, by least squares of relative errors; long
    times, of which the record has few, count less. A term that would be negative is left out.
    """
    variances = deviations**2
    weights = 1.0 / (variances * np.sqrt(times / times[0]))
    terms = np.stack([1.0 / times, np.full_like(times, FLICKER), times / 3.0], axis=1)
    best, least = np.full(3, np.nan), np.inf
    for count in (1, 2, 3):
        for chosen in combinations(range(3), count):
            columns = list(chosen)
            weighted = terms[:, columns] * weights[:, None]
            solution = np.linalg.lstsq(weighted, variances * weights, rcond=None)[0]
            residual = float(np.sum((weighted @ solution - variances * weights) ** 2))
            if (solution > 0).all() and residual < least:
                least = residual
                best = np.full(3, np.nan)
                best[columns] = np.sqrt(solution)
    return Coefficients(*best.tolist())
