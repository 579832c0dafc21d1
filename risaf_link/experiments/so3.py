"""Rotation vectors to matrices and back: of small arrays, quickly."""

import math

import numpy as np

from risaf_link.core.rotation import Floats

SMALL = 1e-6  # rad; below, the series' next term is beyond double precision


def exp(angle: Floats) -> Floats:
    """Rotation matrix, (3, 3), of a rotation vector, (3,), rad: Rodrigues' formula."""
    x, y, z = angle.tolist()
    size = math.sqrt(x * x + y * y + z * z)
    sine = math.sin(size) / size if size > SMALL else 1.0
    versine = (1.0 - math.cos(size)) / (size * size) if size > SMALL else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Floats = sine * cross + versine * (cross @ cross)
    matrix[0, 0] += 1.0
    matrix[1, 1] += 1.0
    matrix[2, 2] += 1.0
    return matrix


def exps(angles: Floats) -> Floats:
    """Rotation matrices, (k, 3, 3), of rotation vectors, (k, 3), rad."""
    size = np.linalg.norm(angles, axis=1)
    safe = np.maximum(size, SMALL)
    sine = np.where(size > SMALL, np.sin(safe) / safe, 1.0)
    versine = np.where(size > SMALL, (1.0 - np.cos(safe)) / safe**2, 0.5)
    cross = np.zeros((len(angles), 3, 3))
    x, y, z = angles.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    turned: Floats = (
        np.eye(3) + sine[:, None, None] * cross + versine[:, None, None] * (cross @ cross)
    )
    return turned


def logs(matrices: Floats) -> Floats:
    """Rotation vectors, (k, 3), rad, of rotation matrices, (k, 3, 3), of less than half a turn."""
    m = matrices
    cosine = (np.trace(m, axis1=1, axis2=2) - 1.0) / 2.0
    axis = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    sine = np.linalg.norm(axis, axis=1) / 2.0
    angle = np.arctan2(sine, cosine)
    factor = np.where(sine > SMALL, angle / np.maximum(sine, SMALL), 1.0) / 2.0
    vectors: Floats = factor[:, None] * axis
    return vectors
