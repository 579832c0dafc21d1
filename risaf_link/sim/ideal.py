"""What ideal inertial sensors read: means over the interval that ends with the sample.

A sensor integrates, or filters before it samples; it does not catch an instant. The rate is the one
that, held over the interval, turns the body as it turned: integrated, the readings give the
attitude, without coning errors, whatever the rate of sampling. Likewise the specific force is the
one that, held in the axes halfway, changes the velocity as it changed.
"""

import numpy as np

from risaf_link.core.earth import GRAVITY
from risaf_link.core.rotation import Floats
from risaf_link.sim.trajectory import Truth


def mean_readings(truth: Truth) -> tuple[Floats, Floats]:
    """Find the readings over the intervals between consecutive instants.

    Parameters
    ----------
    truth : Truth
        At k + 1 instants.

    Returns
    -------
    rates_b : ndarray, shape (k, 3)
        rad/s, of the body relative to inertial space.
    forces_b : ndarray, shape (k, 3)
        Specific force, m/s^2.
    """
    interval = np.diff(truth.time_s)[:, np.newaxis]
    frame_n, earth_n = _halfway(truth.frame_n), _halfway(truth.earth_n)
    before, after = truth.q_nb[:-1], truth.q_nb[1:]
    turned_frame = _product(_exponential(frame_n * interval), after)
    turn_b = _logarithm(_product(_conjugate(before), turned_frame))
    coriolis_n = np.cross(frame_n + earth_n, _halfway(truth.velocity_n))
    force_n = np.diff(truth.velocity_n, axis=0) / interval + coriolis_n - [0.0, 0.0, GRAVITY]
    halfway = _product(before, _exponential(turn_b / 2.0))
    return turn_b / interval, _turned_back(halfway, force_n)


def _halfway(values: Floats) -> Floats:
    return (values[1:] + values[:-1]) / 2.0


def _product(p: Floats, q: Floats) -> Floats:
    """Hamilton product of quaternions, both of shape (k, 4)."""
    a, u = p[:, :1], p[:, 1:]
    b, v = q[:, :1], q[:, 1:]
    scalar = a * b - np.sum(u * v, axis=1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=1)


def _conjugate(q: Floats) -> Floats:
    return q * [1.0, -1.0, -1.0, -1.0]


def _exponential(turns: Floats) -> Floats:
    """Quaternions, shape (k, 4), of rotation vectors, shape (k, 3), rad."""
    half = turns / 2.0
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    return np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=1)


def _logarithm(q: Floats) -> Floats:
    """Rotation vectors, shape (k, 3), rad, of unit quaternions; less than half a turn."""
    vector = q[:, 1:] * np.where(q[:, :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = np.arctan2(sine, np.abs(q[:, :1]))
    length = np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0.0)
    turns: Floats = 2.0 * length * vector
    return turns


def _turned_back(q_nb: Floats, vectors_n: Floats) -> Floats:
    """Vectors in n, shape (k, 3), in the axes of b: v + 2 w (v x u) + 2 (v x u) x u."""
    w, u = q_nb[:, :1], q_nb[:, 1:]
    across = np.cross(vectors_n, u)
    turned: Floats = vectors_n + 2.0 * (w * across + np.cross(across, u))
    return turned
