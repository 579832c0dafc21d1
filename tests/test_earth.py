"""Lengths on the ellipsoid against earth-centred coordinates."""

import math

import numpy as np
import pytest
from ellipsoid import earth_centred, north_east

from risaf_link.core.earth import radii


@pytest.mark.parametrize("latitude", [-89, -60, -1, 0, 30.2217, 45, 80])
@pytest.mark.parametrize("altitude", [0.0, 3000.0])
def test_a_step_of_latitude_or_longitude_is_as_long_as_in_earth_centred_coordinates(
    latitude, altitude
):
    place, step = (math.radians(latitude), 0.6), 1e-5
    north_way = earth_centred(place[0] + step / 2, place[1], altitude) - earth_centred(
        place[0] - step / 2, place[1], altitude
    )
    east_way = earth_centred(place[0], place[1] + step / 2, altitude) - earth_centred(
        place[0], place[1] - step / 2, altitude
    )
    north, east = north_east(*place)
    per_north, per_east = radii(place[0], altitude)
    assert per_north == pytest.approx(north @ north_way / step, rel=1e-7)
    assert per_east == pytest.approx(east @ east_way / step, rel=1e-7)


def test_many_places_are_measured_at_once():
    latitudes = np.radians([0.0, 30.0, 60.0])
    per_north, per_east = radii(latitudes)
    assert per_north.shape == per_east.shape == (3,)
    assert per_east[2] == radii(latitudes[2])[1]
