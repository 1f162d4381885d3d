"""Geodetic, Earth-centred and local coordinates against PROJ, and fixes cleaned of what is no position."""

from __future__ import annotations

import sys

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.sensors.satellites.geodesy import EnuFrame, ecef_to_geodetic, geodetic_to_ecef, to_utm, utm_epsg
from boxplus.sensors.satellites.gnss import GnssFixes, antenna_offset

EVERYWHERE = (st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-5000.0, 50_000.0))


def test_earth_centred_coordinates_are_those_of_proj() -> None:
    rng = np.random.default_rng(0)
    lla = np.column_stack([rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500), rng.uniform(-5e3, 5e5, 500)])
    lla[:2, 0] = 90.0, -90.0
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    p = np.column_stack(to_ecef.transform(lla[:, 1], lla[:, 0], lla[:, 2]))
    np.testing.assert_allclose(geodetic_to_ecef(lla), p, atol=1e-7)
    found = ecef_to_geodetic(p)  # PROJ's own way back is off by millimetres at 500 km
    np.testing.assert_allclose(found[:, [0, 2]], lla[:, [0, 2]], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found[2:, 1], lla[2:, 1], rtol=0, atol=1e-9)  # at a pole there is none


@given(*EVERYWHERE)
def test_there_and_back(lat: float, lon: float, alt: float) -> None:
    p = geodetic_to_ecef([[lat, lon, alt]])
    np.testing.assert_allclose(geodetic_to_ecef(ecef_to_geodetic(p)), p, atol=1e-7)


def test_a_local_frame_is_that_of_proj_s_topocentric_pipeline() -> None:
    frame = EnuFrame(49.01, 8.43, 116.0)
    rng = np.random.default_rng(1)
    lla = np.array([49.01, 8.43, 116.0]) + rng.uniform(-1, 1, (50, 3)) * [0.05, 0.05, 200.0]
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lat_0=49.01 +lon_0=8.43 +h_0=116"
    )
    np.testing.assert_allclose(frame.to_enu(lla), np.column_stack(pipeline.transform(lla[:, 1], lla[:, 0], lla[:, 2])), atol=1e-6)
    np.testing.assert_allclose(frame.to_geodetic(frame.to_enu(lla)), lla, atol=1e-8)


@pytest.mark.parametrize(
    ("lat", "lon", "epsg"),
    [
        (49.0, 8.4, 32632),
        (-33.9, 151.2, 32756),
        (60.4, 5.3, 32632),
        (78.2, 15.6, 32633),
        (0.0, -180.0, 32601),
        (1.0, 180.0, 32601),
    ],
)
def test_zones_of_utm(lat: float, lon: float, epsg: int) -> None:
    assert utm_epsg(lat, lon) == epsg
    area = pyproj.CRS.from_epsg(epsg).area_of_use
    assert area is not None and (lat == 60.4 or area.west <= lon % 360.0 - 360.0 * (lon % 360.0 >= 180.0) <= area.east)


def test_utm_is_that_of_proj_and_missing_pyproj_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    np.testing.assert_allclose(to_utm([[49.0, 9.0, 7.0]], 32632), [[500000.0, 5427309.2, 7.0]], atol=500.0)
    expected = pyproj.Proj("EPSG:32632")(8.4, 49.0)
    np.testing.assert_allclose(to_utm([[49.0, 8.4, 7.0]], 32632)[0, :2], expected, atol=1e-3)
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(InputError, match=r"pip install .*pyproj"):
        to_utm([[49.0, 8.4, 7.0]], 32632)


def test_what_is_no_place_is_refused() -> None:
    with pytest.raises(InputError, match="latitude first"):
        geodetic_to_ecef([[139.7, 35.6, 0.0]])
    with pytest.raises(InputError, match="UTM"):
        utm_epsg(85.0, 0.0)


def test_fixes_that_are_no_position_are_left_out_and_counted() -> None:
    lla = np.array([[49.0, 8.0, 1.0]] * 8)
    lla[1], lla[2, 2], lla[3, 0] = 0.0, np.nan, 91.0
    covariance = np.tile(np.eye(3), (8, 1, 1))
    covariance[5] = 0.0
    fixes = GnssFixes.from_arrays([8, 7, 6, 5, 4, 3, 3, 1], lla, covariance, [0, 0, 0, 0, -1, 2, 0, 1])
    assert fixes.time_ns.tolist() == [1, 3, 8] and fixes.status.tolist() == [1, 2, 0]
    assert fixes.has_covariance.tolist() == [True, False, True]
    assert dict(fixes.rejected) == {
        "no fix": 1,
        "not finite": 1,
        "0°, 0°: no position yet": 1,
        "beyond 90° of latitude or 180° of longitude": 1,
        "repeated time": 1,
    }
    assert len(GnssFixes.from_arrays([], np.zeros((0, 3)))) == 0
    with pytest.raises(InputError, match="one row of each"):
        GnssFixes.from_arrays([1, 2], np.zeros((3, 3)))


def test_a_lever_arm_from_a_text() -> None:
    assert antenna_offset("0.1, -2,0.85").tolist() == [0.1, -2.0, 0.85]
    for text in ("1,2", "a,b,c", "1e9,0,0", "nan,0,0"):
        with pytest.raises(InputError, match="lever arm"):
            antenna_offset(text)
