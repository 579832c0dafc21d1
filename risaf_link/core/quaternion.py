"""One quaternion (w, x, y, z) at a time, as a tuple: in the step of a filter arrays are slow.

`rotation` has the same for arrays of any number.
"""

import math

import numpy as np

from risaf_link.core.rotation import Floats

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p (x) q."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def exp(angle: Vector) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    x, y, z = angle
    norm = math.sqrt(x * x + y * y + z * z)
    part = math.sin(norm / 2.0) / norm if norm > 1e-9 else 0.5
    return math.cos(norm / 2.0), part * x, part * y, part * z


def unit(q: Quaternion) -> Quaternion:
    """Make it of unit length."""
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm


def between(p: Quaternion, q: Quaternion, part: float) -> Quaternion:
    """Attitude between two that are a sample apart; of a linear rotation, to the third order."""
    a, b, c, d = p
    w, x, y, z = q
    return unit((a + part * (w - a), b + part * (x - b), c + part * (y - c), d + part * (z - d)))


def yaw(q: Quaternion) -> float:
    """Yaw, rad."""
    w, x, y, z = q
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def matrix(q: Quaternion) -> Floats:
    """Rotation matrix, (3, 3), of a unit quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
