"""The vehicle's outline as seen from a virtual sensor: how far its border is in every direction (S35)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2
from mapping.kernels import sectors as kernels

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


def checked_polygon(footprint: ArrayLike) -> F64:
    """(V, 2) float64 corners in counter-clockwise order, first not repeated.

    Raises ValueError for fewer than three corners, numbers that are not finite, or no area.
    """
    polygon = np.array(footprint, dtype=np.float64)
    if polygon.ndim != 2 or polygon.shape[1] != 2:
        raise ValueError(f"a footprint is (V, 2) corners, got shape {polygon.shape}")
    if len(polygon) > 1 and np.array_equal(polygon[0], polygon[-1]):
        polygon = polygon[:-1]
    if len(polygon) < 3 or not np.isfinite(polygon).all():
        raise ValueError("a footprint needs three finite corners or more")
    area = signed_area(polygon)
    if abs(area) < 1e-9:
        raise ValueError("a footprint must enclose an area")
    return np.ascontiguousarray(polygon if area > 0.0 else polygon[::-1])


def signed_area(polygon: F64) -> float:
    """Area in square metres, positive if the corners run counter-clockwise."""
    x, y = polygon[:, 0], polygon[:, 1]
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def in_polygon(points: ArrayLike, polygon: F64) -> Bool:
    """(N,) which of the (N, 2) points lie inside; one on the border may count either way."""
    p = np.ascontiguousarray(np.atleast_2d(np.asarray(points, dtype=np.float64)))
    inside: Bool = kernels.inside_polygon(p[:, 0].copy(), p[:, 1].copy(), polygon)
    return inside


def is_star_shaped(polygon: F64) -> bool:
    """Whether the origin lies inside and sees every corner: then one border distance belongs to each bearing."""
    following = np.roll(polygon, -1, axis=0)
    cross = polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]
    return bool((cross > 0.0).all()) and bool(in_polygon(np.zeros((1, 2)), polygon)[0])


class Outline:
    """A footprint in the frame of a virtual sensor.

    footprint: (V, 2) corners in the base frame, or None for a point-like vehicle.  base_from_sensor: the virtual
    sensor.  contains_origin: whether the virtual origin lies inside it.
    """

    def __init__(self, footprint: ArrayLike | None, base_from_sensor: Pose2) -> None:
        if footprint is None:
            self.polygon: F64 = np.empty((0, 2))
            self.contains_origin = False
            return
        self.polygon = np.ascontiguousarray(base_from_sensor.inverse().apply(checked_polygon(footprint)))
        self.contains_origin = bool(in_polygon(np.zeros((1, 2)), self.polygon)[0]) and self._border_is_off_origin()

    def _border_is_off_origin(self) -> bool:
        following = np.roll(self.polygon, -1, axis=0)
        edge = following - self.polygon
        share = -(self.polygon * edge).sum(axis=1) / (edge * edge).sum(axis=1)
        nearest = self.polygon + np.clip(share, 0.0, 1.0)[:, None] * edge
        return bool((np.hypot(nearest[:, 0], nearest[:, 1]) > 1e-9).all())

    def border_m(self, bearing_rad: ArrayLike) -> F64:
        """(N,) k of d = r - k (S35): where the ray from the virtual origin leaves the outline for the last time.

        That is the border, once and for all, of an outline that is star-shaped about the virtual origin; of any other
        it is the choice that keeps d small. Seen from outside, d counts from the side of the vehicle that faces the
        obstacle; a ray that misses the vehicle has k = 0. NaN bearings give NaN.
        """
        bearing = np.atleast_1d(np.asarray(bearing_rad, dtype=np.float64))
        border: F64 = kernels.border_distances(np.ascontiguousarray(bearing), self.polygon)
        return border

    def contains(self, points: F64) -> Bool:
        """(N,) which of the (N, 2) points, virtual sensor frame, lie on the vehicle."""
        if len(self.polygon) == 0:
            return np.zeros(len(points), dtype=bool)
        return in_polygon(points, self.polygon)

    def farthest_border_m(self, edges_rad: F64) -> F64:
        """(N,) the largest border distance within each sector between (N + 1,) ascending bearings; 0 from outside."""
        count = len(edges_rad) - 1
        if not self.contains_origin:
            return np.zeros(count)
        at_edges = self.border_m(edges_rad)
        farthest = np.maximum(at_edges[:-1], at_edges[1:])
        corner_m = np.hypot(self.polygon[:, 0], self.polygon[:, 1])
        corner_rad = np.arctan2(self.polygon[:, 1], self.polygon[:, 0])
        for bearing, distance in zip(corner_rad, corner_m):
            inside = (bearing - edges_rad[:-1]) % (2.0 * np.pi) <= np.diff(edges_rad)
            farthest[inside] = np.maximum(farthest[inside], distance)
        return farthest
