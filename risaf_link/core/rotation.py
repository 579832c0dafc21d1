"""Quaternions (w, x, y, z) and the angles made from them.

Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508.
"""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def wrap(angle: float) -> float:
    """Bring an angle into (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau


def yaw_of(q_nb: Floats) -> float:
    """Yaw of an attitude quaternion of any length but zero, rad, in (-pi, pi]."""
    w, x, y, z = q_nb
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def euler_from_quaternion(q_nb: Floats) -> tuple[float, float, float]:
    """Roll, pitch and yaw (z-y-x) of a unit quaternion, rad."""
    w, x, y, z = q_nb
    roll = math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - x * z))))
    return roll, pitch, yaw_of(q_nb)


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> Floats:
    """Unit quaternion of roll, pitch and yaw (z-y-x), rad."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def matrix_from_quaternion(q_nb: Floats) -> Floats:
    """Rotation matrix `R_nb`, shape (..., 3, 3), of unit quaternions, shape (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q_nb, dtype=float), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def left_matrix(q: Floats) -> Floats:
    """Matrix L with `L @ p` = q (x) p, the Hamilton product; shape (4, 4)."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def right_matrix(q: Floats) -> Floats:
    """Matrix R with `R @ p` = p (x) q, the Hamilton product; shape (4, 4)."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def rate_matrix(rate_b: Floats) -> Floats:
    """Matrix Omega with `Omega @ q` = q (x) (0, rate); shape (4, 4).

    Sola, eq. 199: the right-product matrix of a pure quaternion.
    """
    x, y, z = rate_b
    return np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])
