"""Maps anchored on the earth (S02): WGS 84 latitude, longitude and height, ECEF, and a local tangent plane (ENU).

The geodesy is PROJ's, through the optional package pyproj (`pip install 'umfeld[geo]'`); it is imported on first use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2

F64 = NDArray[np.float64]

_GEODETIC, _GEOCENTRIC = "EPSG:4979", "EPSG:4978"  # WGS 84 in three dimensions; its earth-centred frame


@cache
def _transformers() -> tuple[Any, Any]:
    try:
        from pyproj import Transformer
    except ImportError as error:
        raise ImportError("geographic frames need the package pyproj: pip install 'umfeld[geo]'") from error
    to_ecef = Transformer.from_crs(_GEODETIC, _GEOCENTRIC, always_xy=True)
    from_ecef = Transformer.from_crs(_GEOCENTRIC, _GEODETIC, always_xy=True)
    return to_ecef, from_ecef


def ecef_from_geodetic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike) -> F64:
    """(N, 3) earth-centred, earth-fixed metres of (N,) WGS 84 positions; height above the ellipsoid."""
    to_ecef, _ = _transformers()
    return np.stack(np.broadcast_arrays(*to_ecef.transform(longitude_deg, latitude_deg, height_m)), axis=-1)


def geodetic_from_ecef(points_m: ArrayLike) -> F64:
    """(N, 3) latitude in degrees, longitude in degrees, ellipsoidal height in metres of (N, 3) ECEF points."""
    p = np.asarray(points_m, dtype=np.float64)
    _, from_ecef = _transformers()
    longitude, latitude, height = from_ecef.transform(p[..., 0], p[..., 1], p[..., 2])
    return np.stack((latitude, longitude, height), axis=-1)


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where a map's origin lies on the earth, and how the map is turned.

    yaw_rad: the map's x axis, counter-clockwise from east (REP-103's ENU).
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (-90.0 <= self.latitude_deg <= 90.0 and -180.0 <= self.longitude_deg <= 360.0):
            raise ValueError(f"no place on earth: latitude {self.latitude_deg}, longitude {self.longitude_deg}")

    def _ecef_from_enu(self) -> tuple[F64, F64]:
        """Rotation (3, 3) and origin (3,) of the tangent plane: columns east, north, up."""
        lat, lon = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        east = (-math.sin(lon), math.cos(lon), 0.0)
        north = (-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat))
        up = (math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat))
        origin = ecef_from_geodetic(self.latitude_deg, self.longitude_deg, self.height_m)
        return np.array([east, north, up]).T, origin

    def enu_from_geodetic(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike) -> F64:
        """(N, 3) east, north, up in metres from the anchor."""
        rotation, origin = self._ecef_from_enu()
        return np.asarray((ecef_from_geodetic(latitude_deg, longitude_deg, height_m) - origin) @ rotation)

    def geodetic_from_enu(self, points_m: ArrayLike) -> F64:
        """(N, 3) latitude, longitude (degrees) and height of (N, 3) east, north, up."""
        rotation, origin = self._ecef_from_enu()
        return geodetic_from_ecef(np.asarray(points_m, dtype=np.float64) @ rotation.T + origin)

    def geodetic_from_map(self, points_m: ArrayLike) -> F64:
        """(N, 3) latitude, longitude, height of (N, 2) map points, taken at the anchor's height."""
        enu = Pose2(0.0, 0.0, self.yaw_rad).apply(points_m)
        return self.geodetic_from_enu(np.concatenate((enu, np.zeros((*enu.shape[:-1], 1))), axis=-1))

    def map_from_geodetic(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> F64:
        """(N, 2) map points straight below or above WGS 84 positions, taken at the anchor's height."""
        enu = self.enu_from_geodetic(latitude_deg, longitude_deg, self.height_m)
        return Pose2(0.0, 0.0, -self.yaw_rad).apply(enu[..., :2])
