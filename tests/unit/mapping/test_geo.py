"""Geographic frames: PROJ does the geodesy; here its use is judged by closed forms and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.geo import Anchor, ecef_from_geodetic, geodetic_from_ecef

pytest.importorskip("pyproj")
SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1.0 / 298.257_223_563  # WGS 84
LATITUDE, LONGITUDE = st.floats(-89.9, 89.9), st.floats(-179.9, 179.9)


@given(LATITUDE, LONGITUDE, st.floats(-400.0, 9000.0))
def test_ecef_agrees_with_the_closed_form(latitude: float, longitude: float, height: float) -> None:
    lat, lon = math.radians(latitude), math.radians(longitude)
    e2 = FLATTENING * (2.0 - FLATTENING)
    n = SEMI_MAJOR_M / math.sqrt(1.0 - e2 * math.sin(lat) ** 2)
    flat = (n + height) * math.cos(lat)
    expected = (flat * math.cos(lon), flat * math.sin(lon), (n * (1.0 - e2) + height) * math.sin(lat))
    assert np.allclose(ecef_from_geodetic(latitude, longitude, height), expected, atol=1e-6)


@given(LATITUDE, LONGITUDE, st.floats(-400.0, 9000.0))
def test_there_and_back(latitude: float, longitude: float, height: float) -> None:
    back = geodetic_from_ecef(ecef_from_geodetic(latitude, longitude, height))
    assert np.allclose(back, (latitude, longitude, height), atol=1e-8 * 1e3)


@settings(max_examples=50)
@given(LATITUDE, LONGITUDE, st.floats(-3.0, 3.0), st.floats(-500.0, 500.0), st.floats(-500.0, 500.0))
def test_map_points_return(latitude: float, longitude: float, yaw: float, x: float, y: float) -> None:
    anchor = Anchor(latitude, longitude, 120.0, yaw)
    there = anchor.geodetic_from_map([[x, y]])
    # the tangent plane leaves the ellipsoid by d^2 / 2R: 2 cm at 500 m, seen again as a few micrometres sideways
    assert np.allclose(anchor.map_from_geodetic(there[:, 0], there[:, 1]), [[x, y]], atol=1e-2)


def test_north_is_y_and_east_is_x() -> None:
    anchor = Anchor(49.4, 7.75)
    east, north = anchor.enu_from_geodetic([49.4, 49.401], [7.751, 7.75], [0.0, 0.0])
    assert east[0] == pytest.approx(1e-3 * math.pi / 180 * SEMI_MAJOR_M * math.cos(math.radians(49.4)), rel=3e-3)
    assert abs(east[1]) < 0.01
    assert north[1] == pytest.approx(1e-3 * math.pi / 180 * SEMI_MAJOR_M, rel=3e-3)
    assert abs(north[0]) < 0.01


@pytest.mark.parametrize("place", [(91.0, 0.0), (0.0, 400.0), (math.nan, 0.0)])
def test_no_place_on_earth(place: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="no place"):
        Anchor(*place)
