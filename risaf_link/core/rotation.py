"""Quaternions (w, x, y, z) and the angles made from them.

Hamilton's convention throughout: Sola, "Quaternion kinematics for the error-state Kalman filter",
arXiv:1711.02508; equation numbers here are his. Angles are in rad.
"""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def wrap(angle: float) -> float:
    """Bring an angle, rad, into (-pi, pi]; one that is there already comes back as it was.

    Raises
    ------
    ValueError
        If it is infinite; NaN stays NaN.
    """
    remainder = math.remainder(angle, math.tau)
    return math.pi if remainder == -math.pi else remainder


def wraps(angles: Floats) -> Floats:
    """Bring angles, rad, into [-pi, pi)."""
    return (angles + math.pi) % math.tau - math.pi


def yaw_of(q_nb: Floats) -> float:
    """Yaw, rad, in [-pi, pi], of an attitude quaternion, shape (4,), of any length but zero."""
    w, x, y, z = q_nb.tolist()
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def eulers_of(q_nb: Floats) -> Floats:
    """Roll, pitch and yaw, (3, k) rad, of k unit quaternions, (k, 4): `euler_from_quaternion`."""
    w, x, y, z = q_nb.T
    roll = np.arctan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    return np.array([roll, pitch, yaws_of(q_nb)])


def yaws_of(q_nb: Floats) -> Floats:
    """Yaw, (k,) rad, of k attitude quaternions, (k, 4)."""
    w, x, y, z = q_nb.T
    yaw: Floats = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return yaw


def euler_from_quaternion(q_nb: Floats) -> tuple[float, float, float]:
    """Roll, pitch and yaw (z-y-x), rad, of a unit quaternion, shape (4,).

    They are those of the matrix of eq. 115. At a pitch of a quarter turn only the sum or the
    difference of roll and yaw is defined; both are then finite, and without meaning.
    """
    w, x, y, z = q_nb.tolist()
    roll = math.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - x * z))))
    return roll, pitch, yaw_of(q_nb)


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> Floats:
    """Unit quaternion, shape (4,), of roll, pitch and yaw (z-y-x), rad: yaw (x) pitch (x) roll."""
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


def matrix_from_quaternion(q_ab: Floats) -> Floats:
    """Rotation matrices `R_ab`, shape (..., 3, 3), of unit quaternions, shape (..., 4): eq. 115."""
    w, x, y, z = np.moveaxis(np.asarray(q_ab, dtype=float), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def left_matrix(q: Floats) -> Floats:
    """Matrix L, shape (4, 4), with `L @ p` = q (x) p, the Hamilton product: eq. 18."""
    w, x, y, z = q.tolist()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def right_matrix(q: Floats) -> Floats:
    """Matrix R, shape (4, 4), with `R @ p` = p (x) q, the Hamilton product: eq. 18."""
    w, x, y, z = q.tolist()
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def rate_matrix(rate_b: Floats) -> Floats:
    """Matrix Omega, shape (4, 4), with `Omega @ q` = q (x) (0, rate), of a rate, shape (3,), rad/s.

    The right matrix of a pure quaternion: skew symmetric.
    """
    x, y, z = rate_b.tolist()
    return np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])


def quaternion_from_matrix(R_ab: Floats) -> Floats:  # noqa: N803 a matrix is a capital
    """Unit quaternions, shape (..., 4), w not negative, of rotation matrices, shape (..., 3, 3).

    The eigenvector of the greatest eigenvalue of a symmetric matrix, which is as exact near half a
    turn as elsewhere: Bar-Itzhack, "New Method for Extracting the Quaternion from a Rotation
    Matrix", Journal of Guidance, Control, and Dynamics 23, 2000.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(R_ab, (-2, -1), (0, 1))
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    vectors = np.linalg.eigh(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))[1]
    q_ab: Floats = vectors[..., -1]
    return np.where(q_ab[..., :1] < 0.0, -q_ab, q_ab)


def nearest_rotation(matrices: Floats) -> Floats:
    """Rotation matrices nearest to matrices, shape (..., 3, 3), by the sum of squared differences.

    Markley, "Attitude Determination using Vector Observations and the Singular Value
    Decomposition", Journal of the Astronautical Sciences 36, 1988.
    """
    u, _, v = np.linalg.svd(matrices)
    u[..., -1] *= np.linalg.det(u @ v)[..., None]
    rotations: Floats = u @ v
    return rotations
