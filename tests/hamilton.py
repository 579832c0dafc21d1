"""Rotations in other words than the code's: Hamilton's table, elementary matrices, Rodrigues."""

import math

import numpy as np

# Products of the units 1, i, j, k: which of them, and its sign; i j = k and so on.
TABLE = [
    [(0, 1), (1, 1), (2, 1), (3, 1)],
    [(1, 1), (0, -1), (3, 1), (2, -1)],
    [(2, 1), (3, -1), (0, -1), (1, 1)],
    [(3, 1), (2, 1), (1, -1), (0, -1)],
]


def product(p, q):
    """Hamilton product of two quaternions."""
    result = [0.0] * 4
    for a in range(4):
        for b in range(4):
            unit, sign = TABLE[a][b]
            result[unit] += sign * p[a] * q[b]
    return np.array(result)


def conjugate(q):
    return np.array([q[0], -q[1], -q[2], -q[3]])


def turned(q, vector):
    """A vector, rotated: q v q*."""
    return product(product(q, [0.0, *vector]), conjugate(q))[1:]


def rotation(vector):
    """Unit quaternion of a rotation vector, rad."""
    angle = math.hypot(*vector)
    share = math.sin(angle / 2) / angle if angle else 0.5
    return np.array([math.cos(angle / 2), *(share * np.asarray(vector))])


def euler_matrix(roll, pitch, yaw):
    """Body to NED: yaw about down, then pitch, then roll, by elementary matrices."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_down = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_right = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_forward = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_down @ about_right @ about_forward


def derivative(function, at, step=1e-6):
    """Jacobian of a function of a vector, by central differences: (outputs, inputs)."""
    at = np.asarray(at, float)
    columns = []
    for i in range(len(at)):
        shift = np.zeros_like(at)
        shift[i] = step
        change = np.asarray(function(at + shift)) - np.asarray(function(at - shift))
        columns.append(change / (2 * step))
    return np.array(columns).T
