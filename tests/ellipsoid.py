"""Directions on the WGS 84 ellipsoid by way of earth-centred coordinates, as an oracle."""

import math

import numpy as np

A, B = 6378137.0, 6356752.314245  # m, semi-axes


def earth_centred(latitude, longitude, altitude=0.0):
    """Position (x, y, z), m, of angles in rad."""
    cl, sl = math.cos(latitude), math.sin(latitude)
    normal = A * A / math.hypot(A * cl, B * sl)
    east = (normal + altitude) * cl
    up = (B * B / (A * A) * normal + altitude) * sl
    return np.array([east * math.cos(longitude), east * math.sin(longitude), up])


def north_east(latitude, longitude):
    """Unit vectors to the north and to the east at a place."""
    cl, sl = math.cos(latitude), math.sin(latitude)
    co, so = math.cos(longitude), math.sin(longitude)
    return np.array([[-sl * co, -sl * so, cl], [-so, co, 0.0]])


def away(latitude, longitude, north, east):
    """Where one arrives: latitude and longitude some metres from a place, by Newton's method."""
    start = earth_centred(latitude, longitude)
    goal = np.array([north, east])
    there = np.array([latitude, longitude])
    for _ in range(5):
        step = north_east(latitude, longitude) @ (earth_centred(*there) - start)
        there = there + (goal - step) / [A, A * math.cos(latitude)]
    return float(there[0]), math.remainder(float(there[1]), math.tau)
