"""Positions on the Earth: geodetic coordinates of WGS84, Earth-centred ones, and a local frame of east, north and up.

With the semi-axis a and e² = f (2 − f), a point of latitude φ, longitude λ and height h above the ellipsoid is at

    N = a/√(1 − e² sin²φ),   p_ecef = [(N + h) cos φ cos λ, (N + h) cos φ sin λ, (N (1 − e²) + h) sin φ],

and the axes of the local frame at it are the columns of

    R_ecef_enu = [−sin λ  −sin φ cos λ  cos φ cos λ;  cos λ  −sin φ sin λ  cos φ sin λ;  0  cos φ  sin φ].

The way back starts from Bowring's formula, exact to micrometres near the ground, and repeats it until nothing changes.

Sources: NIMA TR8350.2, Department of Defense World Geodetic System 1984; Bowring, Survey Review 1976. Derivations: docs/gnss.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._extras import require
from boxplus._numbers import as_floats
from boxplus.errors import InputError

Floats = NDArray[np.float64]

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_ROUNDS = 4


def geodetic_to_ecef(lat_lon_alt: ArrayLike) -> Floats:
    """Earth-centred, Earth-fixed coordinates (N, 3) [m] of latitude, longitude [°] and height above the ellipsoid [m], (N, 3).

    Raises:
        InputError: an array of another shape, a latitude beyond 90° or a longitude beyond 360°.
    """
    lla = _checked(lat_lon_alt)
    lat, lon, alt = np.radians(lla[:, 0]), np.radians(lla[:, 1]), lla[:, 2]
    N = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    across = (N + alt) * np.cos(lat)
    return np.column_stack([across * np.cos(lon), across * np.sin(lon), (N * (1.0 - _E2) + alt) * np.sin(lat)])


def ecef_to_geodetic(p_ecef: ArrayLike) -> Floats:
    """Latitude, longitude [°] and height above the ellipsoid [m], (N, 3), of Earth-centred coordinates (N, 3) [m].

    To nanometres for points from 100 km below the ground to the orbits of satellites.

    Raises:
        InputError: an array of another shape.
    """
    p = _rows(p_ecef, "p_ecef")
    across = np.hypot(p[:, 0], p[:, 1])
    reduced = np.arctan2(p[:, 2] * SEMI_MAJOR_M, across * _SEMI_MINOR_M)
    second_e2 = _E2 / (1.0 - _E2)
    lat = reduced
    for _ in range(_ROUNDS):
        lat = np.arctan2(
            p[:, 2] + second_e2 * _SEMI_MINOR_M * np.sin(reduced) ** 3, across - _E2 * SEMI_MAJOR_M * np.cos(reduced) ** 3
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(lat), np.cos(lat))
    # Along the normal, which has no singularity at the poles as a division by cos φ has.
    N = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    alt = across * np.cos(lat) + p[:, 2] * np.sin(lat) - N * (1.0 - _E2 * np.sin(lat) ** 2)
    return np.column_stack([np.degrees(lat), np.degrees(np.arctan2(p[:, 1], p[:, 0])), alt])


@dataclass(frozen=True, slots=True)
class EnuFrame:
    """East, north and up at an origin on the Earth.

    Attributes:
        latitude, longitude: of the origin [°]; altitude: its height above the ellipsoid of WGS84 [m].

    Raises:
        InputError: an origin that is not on the Earth.

    Example:
        `EnuFrame(49.0, 8.4, 115.0).to_enu([[49.001, 8.4, 115.0]])`  # 111 m north
    """

    latitude: float
    longitude: float
    altitude: float

    def __post_init__(self) -> None:
        _checked([[self.latitude, self.longitude, self.altitude]])

    @property
    def R_ecef_enu(self) -> Floats:
        """(3, 3) axes of this frame in Earth-centred coordinates."""
        lat, lon = np.radians(self.latitude), np.radians(self.longitude)
        s, c, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
        return np.array([[-sl, -s * cl, c * cl], [cl, -s * sl, c * sl], [0.0, c, s]])

    @property
    def _origin(self) -> Floats:
        return geodetic_to_ecef([[self.latitude, self.longitude, self.altitude]])

    @property
    def projection(self) -> str:
        """A map projection whose coordinates are east and north of this frame, as a PROJ string: 3 mm off at 1 km, 4 cm at 10 km.

        Transverse Mercator about the origin, at the scale of its height above the ellipsoid.
        """
        s2 = np.sin(np.radians(self.latitude)) ** 2
        across = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * s2)
        along = SEMI_MAJOR_M * (1.0 - _E2) / (1.0 - _E2 * s2) ** 1.5
        scale = 1.0 + self.altitude / np.sqrt(across * along)
        place = f"+lat_0={self.latitude:.10f} +lon_0={self.longitude:.10f} +k={scale:.12f}"
        return f"+proj=tmerc {place} +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"

    def to_enu(self, lat_lon_alt: ArrayLike) -> Floats:
        """Positions (N, 3) [m] in this frame, of latitude, longitude [°] and height [m] (N, 3)."""
        found: Floats = (geodetic_to_ecef(lat_lon_alt) - self._origin) @ self.R_ecef_enu
        return found

    def to_geodetic(self, p_enu: ArrayLike) -> Floats:
        """Latitude, longitude [°] and height [m] (N, 3), of positions (N, 3) [m] in this frame."""
        return ecef_to_geodetic(_rows(p_enu, "p_enu") @ self.R_ecef_enu.T + self._origin)


def utm_epsg(latitude: float, longitude: float) -> int:
    """EPSG code of the UTM zone a place lies in, with the exceptions of Norway and Svalbard.

    Raises:
        InputError: a place that UTM does not cover, beyond 84° north or 80° south.
    """
    if not -80.0 <= latitude <= 84.0:
        raise InputError("a latitude from −80° to 84°, where UTM is defined", f"{latitude:.3f}°", "use ENU coordinates there")
    east = (longitude + 180.0) % 360.0 - 180.0
    zone = int((east + 180.0) // 6.0) + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= east < 12.0:
        zone = 32
    if latitude >= 72.0 and 0.0 <= east < 42.0:
        zone = 31 + 2 * int((east + 3.0) // 12.0)
    return (32600 if latitude >= 0.0 else 32700) + zone


def to_utm(lat_lon_alt: ArrayLike, epsg: int) -> Floats:
    """Easting, northing and height above the ellipsoid (N, 3) [m] in a UTM zone, by PROJ.

    Raises:
        InputError: pyproj, the extra `gnss`, is not installed; an array of another shape.
    """
    lla = _checked(lat_lon_alt)
    transformer = _pyproj().Transformer.from_crs(4326, epsg, always_xy=True)
    east, north = transformer.transform(lla[:, 1], lla[:, 0])
    return np.column_stack([east, north, lla[:, 2]])


def require_utm() -> None:
    """Raise InputError where pyproj is missing, before an export is begun."""
    _pyproj()


def _pyproj() -> Any:
    return require("pyproj", "which knows UTM")


def _rows(values: ArrayLike, name: str) -> Floats:
    array = np.atleast_2d(as_floats(values, name))
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name} of shape (N, 3)", f"shape {np.shape(values)}", "give one row for each position")
    return array


def _checked(lat_lon_alt: ArrayLike) -> Floats:
    lla = _rows(lat_lon_alt, "lat_lon_alt")
    if (np.abs(lla[:, 0]) > 90.0).any() or (np.abs(lla[:, 1]) > 360.0).any():
        n = int(np.argmax((np.abs(lla[:, 0]) > 90.0) | (np.abs(lla[:, 1]) > 360.0)))
        raise InputError(
            "latitude (−90° to 90°), longitude (−180° to 180°), height", f"{lla[n, 0]:.6g}, {lla[n, 1]:.6g} in row {n}",
            "give degrees, latitude first",
        )  # fmt: skip
    return lla
