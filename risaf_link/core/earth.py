"""The earth: its shape, its rotation, its gravity.

WGS 84: NIMA TR8350.2, third edition, 2000.
"""

import math
from typing import Any

import numpy as np

from risaf_link.core.rotation import Floats

EQUATORIAL_RADIUS = 6_378_137.0  # m
ECCENTRICITY_SQUARED = 6.694_379_990_14e-3
EARTH_RATE = 7.292_115e-5  # rad/s
GRAVITY = 9.80665  # m/s^2, standard gravity


def radii(latitude: Floats | float, altitude: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Length of a step of one radian on the ellipsoid (Groves 2013, eq. 2.105 and 2.106).

    Parameters
    ----------
    latitude : ndarray or float
        rad.
    altitude : ndarray or float
        m.

    Returns
    -------
    north, east : ndarray
        m/rad of latitude, and of longitude.
    """
    m: Any = math if isinstance(latitude, float) else np
    flattening = 1.0 - ECCENTRICITY_SQUARED * m.sin(latitude) ** 2
    normal = EQUATORIAL_RADIUS / m.sqrt(flattening)
    meridian = normal * (1.0 - ECCENTRICITY_SQUARED) / flattening
    return meridian + altitude, (normal + altitude) * m.cos(latitude)
