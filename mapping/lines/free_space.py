"""Free space as polygons: what one scan sees, what a drive has seen, where it ends in the unknown (S09)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely import LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from mapping.frames import Pose2
from mapping.no_echo import reach_without_echo

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

_NEIGHBOUR_FACTOR: Final = 1.5
_WIDEST_WEDGE_RAD: Final = 0.2  # farther apart, beams see nothing between them
_BATCH: Final = 16
_LATTICE_M: Final = 1e-6


def visibility_polygon(
    bearing_rad: ArrayLike, range_m: ArrayLike, *, range_max_m: float, gap_m: float = 0.3, clear_no_return: bool = True
) -> MultiPolygon:
    """What one scan proves free, in the sensor's frame: never more than what its beams passed.

    bearing_rad, range_m: (N,), rising or falling by at most a full turn. Between two neighbouring beams lies free
    space up to the chord of their ends if these are closer than gap_m or 6 beam widths, else up to the shorter of the
    two. +inf is free as mapping.no_echo has it if the device can be trusted to say "nothing seen" (clear_no_return);
    NaN, -inf and numbers outside (0, range_max_m] prove nothing, and neither does a single beam, which has no width.
    Returns a MultiPolygon, empty if nothing is free. Raises ValueError for other shapes and bearings that go astray.
    """
    bearing, reach, _ = _beams(bearing_rad, range_m, range_max_m, clear_no_return)
    if bearing.size < 2:
        return MultiPolygon()
    step = np.diff(bearing)
    spacing = float(np.median(step))
    joined = (reach[:-1] > 0.0) & (reach[1:] > 0.0) & (step <= min(_NEIGHBOUR_FACTOR * spacing, _WIDEST_WEDGE_RAD))
    turn = 2.0 * math.pi - (bearing[-1] - bearing[0])
    around = bool(turn <= min(_NEIGHBOUR_FACTOR * spacing, _WIDEST_WEDGE_RAD)) and reach[0] > 0.0 and reach[-1] > 0.0
    if around and bool(np.all(joined)):
        ring = _outline(np.append(bearing, bearing[0] + 2.0 * math.pi), np.append(reach, reach[0]), spacing, gap_m)
        return _multi([_valid(Polygon(ring[:-1]))])
    if around:  # begin where something is missing, so that no fan is cut by the seam
        cut = int(np.flatnonzero(~joined)[0]) + 1
        bearing = np.concatenate((bearing[cut:], bearing[:cut] + 2.0 * math.pi))
        reach = np.roll(reach, -cut)
        joined = np.roll(np.append(joined, True), -cut)[:-1]
    fans: list[BaseGeometry] = []
    for part in np.split(np.arange(bearing.size), np.flatnonzero(~joined) + 1):
        if part.size >= 2:
            outline = _outline(bearing[part], reach[part], spacing, gap_m)
            fans += _fans(outline)
    return _multi(fans)


class FreeSpace:
    """Free space in the map frame, enlarged by driving. The rest is unknown (or an obstacle)."""

    def __init__(self, *, simplify_m: float = 0.01, surface_gap_m: float = 0.3) -> None:
        """simplify_m: corners of outlines that matter less are left out, always so that free space only shrinks, by up
        to twice as much; 0 keeps all.  surface_gap_m: neighbouring end points closer than this, or than 6 beam widths,
        are one surface. ValueError if one is negative or not finite."""
        for name, value in (("simplify_m", simplify_m), ("surface_gap_m", surface_gap_m)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be a number >= 0, got {value}")
        self._simplify_m, self._surface_gap_m = simplify_m, surface_gap_m
        self._free: BaseGeometry = MultiPolygon()
        self._waiting: list[BaseGeometry] = []
        self._surfaces: list[BaseGeometry] = []

    def insert(
        self, map_from_sensor: Pose2, bearing_rad: ArrayLike, range_m: ArrayLike, *, range_max_m: float,
        clear_no_return: bool = True,
    ) -> None:  # fmt: skip
        """Add what one scan sees; arguments as visibility_polygon. ValueError too if the pose is not finite."""
        pose = (map_from_sensor.x_m, map_from_sensor.y_m, map_from_sensor.yaw_rad)
        if not all(math.isfinite(v) for v in pose):
            raise ValueError(f"a pose must be finite, got {pose}")
        seen = visibility_polygon(
            bearing_rad, range_m, range_max_m=range_max_m, gap_m=self._surface_gap_m, clear_no_return=clear_no_return
        )
        if self._simplify_m > 0.0:
            seen = _smaller(seen, self._simplify_m)
        self._waiting.append(_moved(seen, map_from_sensor))
        self._surfaces += [
            _moved(part, map_from_sensor).simplify(self._simplify_m)
            for part in surfaces(bearing_rad, range_m, range_max_m=range_max_m, gap_m=self._surface_gap_m)
        ]
        if len(self._waiting) >= _BATCH:
            self._merge()

    @property
    def polygon(self) -> MultiPolygon:
        """All free space so far."""
        self._merge()
        return _multi(list(getattr(self._free, "geoms", [self._free])))

    @property
    def area_m2(self) -> float:
        """Its area."""
        return float(self.polygon.area)

    def frontiers(self, *, near_m: float = 0.15, min_length_m: float = 0.3) -> list[F64]:
        """Edges between free and unknown: the outline of free space but where a surface was seen within near_m.

        Returns polylines (N, 2), longest first, at least min_length_m long: openings to drive to.
        """
        if not (near_m > 0.0 and min_length_m >= 0.0):
            raise ValueError("near_m must be above 0, min_length_m at least 0")
        outline = self.polygon.boundary
        if outline.is_empty:
            return []
        edges = _without(outline, self._surfaces, near_m)
        edges = [edge for edge in edges if edge.length >= min_length_m]
        edges.sort(key=lambda edge: (-edge.length, edge.coords[0]))
        return [np.asarray(edge.coords, dtype=np.float64) for edge in edges]

    def _merge(self) -> None:
        if self._waiting:
            self._free = _union([self._free, *self._waiting])
            self._waiting = []


def surfaces(bearing_rad: ArrayLike, range_m: ArrayLike, *, range_max_m: float, gap_m: float = 0.3) -> list[LineString]:
    """What one scan saw of things: lines through neighbouring end points closer than gap_m or 6 beam widths; sensor
    frame. Arguments and errors as visibility_polygon."""
    bearing, reach, hit = _beams(bearing_rad, range_m, range_max_m, clear_no_return=False)
    if bearing.size < 2:
        return []
    ends = _ends(bearing, reach)
    spacing = float(np.median(np.diff(bearing)))
    joined = hit[:-1] & hit[1:] & _close(bearing[:-1], reach[:-1], bearing[1:], reach[1:], spacing, gap_m)
    parts = np.split(np.arange(bearing.size), np.flatnonzero(~joined) + 1)
    lines = [LineString(ends[part]) for part in parts if part.size >= 2]
    turn = bearing[:1] + 2.0 * math.pi
    if hit[0] and hit[-1] and bool(_close(bearing[-1:], reach[-1:], turn, reach[:1], spacing, gap_m)[0]):
        lines.append(LineString(ends[[-1, 0]]))
    return lines


def _beams(
    bearing_rad: ArrayLike, range_m: ArrayLike, range_max_m: float, clear_no_return: bool
) -> tuple[F64, F64, Bools]:
    """Rising bearings, how far each beam is free (0: nothing known), which hit something."""
    bearing, ranges = np.asarray(bearing_rad, dtype=np.float64), np.asarray(range_m, dtype=np.float64)
    if bearing.ndim != 1 or bearing.shape != ranges.shape or not np.all(np.isfinite(bearing)):
        raise ValueError(f"bearings and ranges are two rows of one length, got {bearing.shape} and {ranges.shape}")
    if not (math.isfinite(range_max_m) and range_max_m > 0.0):
        raise ValueError(f"range_max_m must be above 0 and finite, got {range_max_m}")
    if bearing.size and bearing[0] > bearing[-1]:
        bearing, ranges = bearing[::-1], ranges[::-1]
    step = np.diff(bearing)
    if np.any(step <= 0.0) or float(np.sum(step)) >= 2.0 * math.pi + 1e-9:
        raise ValueError("bearing_rad must rise or fall throughout, by no more than a full turn")
    hit = (ranges > 0.0) & (ranges <= range_max_m)
    silent = reach_without_echo(bearing, ranges, range_max_m)
    reach = np.where(hit, ranges, np.where((ranges == np.inf) & clear_no_return, silent, 0.0))
    return bearing, reach, hit


def _ends(bearing: F64, reach: F64) -> F64:
    return np.stack((reach * np.cos(bearing), reach * np.sin(bearing)), axis=-1)


def _close(b1: F64, r1: F64, b2: F64, r2: F64, spacing: float, gap_m: float) -> Bools:
    """Whether ends are on one surface."""
    apart = np.hypot(*(_ends(b2, r2) - _ends(b1, r1)).T)
    neighbours = b2 - b1 <= min(_NEIGHBOUR_FACTOR * spacing, _WIDEST_WEDGE_RAD)
    return np.asarray(neighbours & (apart < np.maximum(gap_m, 6.0 * spacing * np.minimum(r1, r2))))


def _outline(bearing: F64, reach: F64, spacing: float, gap_m: float) -> F64:
    """Ends of neighbouring beams by bearing, with a step along the longer beam where two are not on one surface."""
    apart = ~_close(bearing[:-1], reach[:-1], bearing[1:], reach[1:], spacing, gap_m)
    shorter = np.minimum(reach[:-1], reach[1:])
    beam = np.where(reach[1:] > reach[:-1], bearing[1:], bearing[:-1])
    steps = np.flatnonzero(apart & (shorter < np.maximum(reach[:-1], reach[1:])))
    return np.insert(_ends(bearing, reach), steps + 1, _ends(beam[steps], shorter[steps]), axis=0)


def _fans(outline: F64) -> list[BaseGeometry]:
    """The star-shaped polygon of the origin and an outline; in two where it opens wider than half a turn, so that
    no polygon's edges cross at the origin."""
    turn = np.cumsum(np.abs(_turns(outline)))
    if turn.size == 0 or turn[-1] < math.pi:
        pieces = [outline]
    else:
        middle = int(np.searchsorted(turn, 0.5 * turn[-1])) + 1
        pieces = [outline[: middle + 1], outline[middle:]]
    return [_valid(Polygon(np.concatenate((np.zeros((1, 2)), piece)))) for piece in pieces if len(piece) >= 2]


def _turns(outline: F64) -> F64:
    angle = np.arctan2(outline[:, 1], outline[:, 0])
    return np.asarray((np.diff(angle) + math.pi) % (2.0 * math.pi) - math.pi)


def _valid(polygon: Polygon) -> BaseGeometry:
    """Beams less than rounding apart can make an edge touch itself: mend that."""
    return polygon if polygon.is_valid else polygon.buffer(0.0)


def _union(parts: Sequence[BaseGeometry]) -> BaseGeometry:
    """All parts as one.

    Edges that differ by less than rounding, from beams of no length or after a motion, can leave no answer. Corners are
    then laid on a lattice of a micrometre, and a part that cannot be joined even so is left out, which frees nothing.
    """
    with np.errstate(all="ignore"):  # of what GEOS tries on its way
        try:
            return shapely.union_all(parts)
        except shapely.errors.GEOSException:
            pass
        joined: BaseGeometry = MultiPolygon()
        for part in parts:
            try:
                laid = shapely.set_precision(part if part.is_valid else part.buffer(0.0), _LATTICE_M)
                joined = shapely.union(joined, laid, grid_size=_LATTICE_M)
            except shapely.errors.GEOSException:
                continue
    return joined


def _smaller(seen: MultiPolygon, by_m: float) -> MultiPolygon:
    """Fewer corners, never more space: what simplifying might add is cut off again."""
    plain = seen.simplify(by_m).buffer(-by_m, join_style="mitre")
    return _multi([shapely.intersection(plain, seen)] if not seen.contains(plain) else [plain])


def _multi(parts: Sequence[BaseGeometry]) -> MultiPolygon:
    """Everything with an area, as one."""
    joined = _union([part for part in parts if not part.is_empty])
    pieces = list(getattr(joined, "geoms", [joined]))
    return MultiPolygon([piece for piece in pieces if isinstance(piece, Polygon) and not piece.is_empty])


def _moved(shape: BaseGeometry, a_from_b: Pose2) -> BaseGeometry:
    return shapely.transform(shape, a_from_b.apply)


def _without(outline: BaseGeometry, seen: list[BaseGeometry], near_m: float) -> list[LineString]:
    """Pieces of an outline farther than near_m from all surfaces."""
    if seen:
        outline = outline.difference(shapely.union_all(shapely.buffer(np.array(seen, dtype=object), near_m)))
    merged = shapely.line_merge(outline) if not outline.is_empty else outline
    pieces = list(getattr(merged, "geoms", [merged]))
    return [piece for piece in pieces if isinstance(piece, LineString) and not piece.is_empty]
