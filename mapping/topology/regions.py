"""From a floor plan of polygons to regions, rooms and passages (S41, figs. 5.32 to 5.34).

    free space with obstacles --corners joined--> convex regions --shared edges--> region graph
                                                                 --narrow edges cut--> rooms and passages (a tree, or
                                                                                       with rings where ways close)

Corners that stick out into free space are joined to others by edges that cross no object, the shortest first, until no
region has a corner that sticks into it: then every region is convex and free, and one can go straight across. The
shortest edges first are doors and the gaps between furniture, so these become the borders of regions. An edge that a
later one made superfluous is taken out again, the longest first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import networkx as nx
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import LineString, MultiPolygon, Polygon

from mapping.topology.queries import LENGTH, rank, single_connections

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST_CORNERS = 2000
_CLEAN_M = 1e-6
_FLAT_RAD = math.radians(2.0)
_CLEAN_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Region:
    """A convex piece of free space. corners_m: (K, 2), counter-clockwise."""

    number: int
    corners_m: F64
    area_m2: float
    centre_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Passage:
    """An edge between two corners, and between two regions a < b. ends_m: (2, 2)."""

    a: int
    b: int
    ends_m: F64
    width_m: float


@dataclass(frozen=True, slots=True)
class RegionMap:
    """regions and passages of one floor plan, numbered from below left to above right, by their centres' y, then x."""

    regions: tuple[Region, ...]
    passages: tuple[Passage, ...]

    def graph(self) -> nx.Graph[int]:
        """Nodes: numbers of regions, with `centre_m`, `area_m2`.  Edges: `length_m` centre to centre through the middle
        of the passage (the widest, where two regions share several), `width_m`, `at_m`."""
        graph: nx.Graph[int] = nx.Graph()
        for region in self.regions:
            graph.add_node(region.number, centre_m=region.centre_m, area_m2=region.area_m2)
        for passage in self.passages:
            if graph.has_edge(passage.a, passage.b) and graph.edges[passage.a, passage.b]["width_m"] >= passage.width_m:
                continue
            at = passage.ends_m.mean(axis=0)
            length = sum(math.dist(at, self.regions[n].centre_m) for n in (passage.a, passage.b))
            graph.add_edge(passage.a, passage.b, **{LENGTH: length}, width_m=passage.width_m, at_m=tuple(at))
        return graph


@dataclass(frozen=True, slots=True)
class Subgraph:
    """A node of the decomposition tree: members that hang together without any of the single connections."""

    members: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Decomposition:
    """Subgraphs joined by single connections. joints: (subgraph, subgraph, edge), edge being the nodes it joins.

    As a graph of subgraphs it is a forest: a tree for each connected part.
    """

    subgraphs: tuple[Subgraph, ...]
    joints: tuple[tuple[int, int, tuple[Any, Any]], ...]


def floor_plan(rooms: Sequence[ArrayLike], obstacles: Sequence[ArrayLike] = ()) -> MultiPolygon:
    """Free space: the union of room outlines (K, 2) less the obstacles, either in any order of walking.

    ValueError for an outline with fewer than 3 points, a number that is not finite, or no free space at all.
    """
    free = shapely.union_all([_polygon(outline) for outline in rooms])
    return _as_multi(shapely.difference(free, shapely.union_all([_polygon(outline) for outline in obstacles])))


def decompose(free: Polygon | MultiPolygon, *, simplify_m: float = 0.0) -> RegionMap:
    """Convex, obstacle-free regions and the passages between them.

    free: as from floor_plan or FreeSpace.polygon.  simplify_m: leave out corners that stand out less than this; 0 for
    drawn plans, about the noise for measured ones.  Time grows as the square of the number of corners.  Raises
    ValueError if free is empty or not valid, or has more than 2,000 corners after that.
    """
    plan = _as_multi(free)
    if simplify_m > 0.0:
        plan = _as_multi(shapely.simplify(plan, simplify_m))
    regions: list[Polygon] = []
    passages: list[F64] = []
    if sum(len(ring.coords) - 1 for part in plan.geoms for ring in (part.exterior, *part.interiors)) > MOST_CORNERS:
        raise ValueError(f"more than {MOST_CORNERS} corners; smooth the plan with simplify_m")
    for part in plan.geoms:
        edges = _dividing_edges(part)
        passages += list(edges)
        lines = [part.boundary, *(LineString(edge) for edge in edges)]
        pieces = shapely.get_parts(shapely.polygonize([shapely.union_all(lines)]))
        shapely.prepare(part)
        regions += [piece for piece in pieces if part.contains(piece.representative_point())]
    regions.sort(key=lambda piece: (round(piece.centroid.y, 6), round(piece.centroid.x, 6)))
    numbered = tuple(_region(number, piece) for number, piece in enumerate(regions))
    return RegionMap(numbered, _passages(numbered, passages))


def room_graph(regions: RegionMap, *, door_m: float = 1.3) -> nx.Graph[int]:
    """Rooms: regions put together across every passage wider than door_m; edges: the doors between rooms.

    Nodes: numbers of rooms, with `regions` (sorted), `area_m2`, `centre_m`.  Edges: `width_m`, `at_m`, `length_m`,
    `doors` (all passages between the two, as pairs of regions).  A room is numbered by its first region's rank.
    """
    if not door_m >= 0.0:
        raise ValueError(f"door_m is a width, got {door_m}")
    wide: nx.Graph[int] = nx.Graph()
    wide.add_nodes_from(region.number for region in regions.regions)
    wide.add_edges_from((p.a, p.b) for p in regions.passages if p.width_m > door_m)
    groups = sorted(sorted(group) for group in nx.connected_components(wide))
    room_of = {region: room for room, group in enumerate(groups) for region in group}
    graph: nx.Graph[int] = nx.Graph()
    for room, group in enumerate(groups):
        parts = [regions.regions[number] for number in group]
        area = sum(part.area_m2 for part in parts)
        centre = np.average([part.centre_m for part in parts], axis=0, weights=[part.area_m2 for part in parts])
        graph.add_node(room, regions=tuple(group), area_m2=area, centre_m=(float(centre[0]), float(centre[1])))
    for passage in regions.passages:
        a, b = room_of[passage.a], room_of[passage.b]
        if a == b:
            continue
        if not graph.has_edge(a, b):
            graph.add_edge(a, b, width_m=0.0, doors=[])
        door = graph.edges[a, b]
        door["doors"].append((passage.a, passage.b))
        if passage.width_m > door["width_m"]:
            at = passage.ends_m.mean(axis=0)
            length = sum(math.dist(at, graph.nodes[n]["centre_m"]) for n in (a, b))
            door.update({"width_m": passage.width_m, "at_m": (float(at[0]), float(at[1])), LENGTH: length})
    return graph


def decomposition_tree(graph: nx.Graph[Any]) -> Decomposition:
    """Divide a graph at its single connections: fig. 5.34. Works on regions, rooms, or any other graph."""
    bridges = single_connections(graph)
    parts: nx.Graph[Any] = nx.Graph(graph)
    parts.remove_edges_from(bridges)
    groups = sorted(
        (sorted(group, key=rank) for group in nx.connected_components(parts)), key=lambda group: rank(group[0])
    )
    where = {node: number for number, group in enumerate(groups) for node in group}
    joints = tuple((min(where[a], where[b]), max(where[a], where[b]), (a, b)) for a, b in bridges)
    return Decomposition(tuple(Subgraph(tuple(group)) for group in groups), joints)


# --- corners and edges


@dataclass(slots=True)
class _Corners:
    """All corners of a polygon with holes. Free space lies counter-clockwise from `first` by the angle `open`."""

    points: F64  # (N, 2)
    first_rad: F64  # (N,) direction to the next corner
    open_rad: F64  # (N,) how far free space reaches from there

    @staticmethod
    def of(part: Polygon) -> _Corners:
        points, first, opened = [], [], []
        part = shapely.geometry.polygon.orient(part, 1.0)  # free space to the left of every ring
        for ring in (part.exterior, *part.interiors):
            p = np.asarray(ring.coords)[:-1, :2]
            after, before = np.roll(p, -1, axis=0) - p, np.roll(p, 1, axis=0) - p
            to_next, to_last = np.arctan2(after[:, 1], after[:, 0]), np.arctan2(before[:, 1], before[:, 0])
            points.append(p)
            first.append(to_next)
            opened.append((to_last - to_next) % (2.0 * math.pi))
        return _Corners(np.concatenate(points), np.concatenate(first), np.concatenate(opened))


def _dividing_edges(part: Polygon) -> F64:
    """(E, 2, 2) edges that divide a polygon into convex pieces."""
    corners = _Corners.of(part)
    sticking_out = np.flatnonzero(corners.open_rad > math.pi + _FLAT_RAD)
    candidates = _visible_pairs(part, corners, sticking_out)
    fans: list[list[float]] = [[0.0, float(angle)] for angle in corners.open_rad]
    taken: list[tuple[int, int]] = []
    for i, j in candidates:
        at_i, at_j = _angle(corners, i, j), _angle(corners, j, i)
        if not (_is_inside(corners, i, at_i) and _is_inside(corners, j, at_j)):
            continue
        if not (_is_needed(fans[i], at_i) or _is_needed(fans[j], at_j)) or _passes_corner(corners.points, i, j):
            continue
        if taken and _crosses(corners.points, (i, j), np.array(taken)):
            continue
        taken.append((i, j))
        fans[i].append(at_i)
        fans[j].append(at_j)
    for i, j in sorted(taken, key=lambda pair: -math.dist(corners.points[pair[0]], corners.points[pair[1]])):
        rest = [list(fans[i]), list(fans[j])]
        rest[0].remove(_angle(corners, i, j))
        rest[1].remove(_angle(corners, j, i))
        if all(_widest(fan) <= math.pi + _FLAT_RAD for fan in rest):
            fans[i], fans[j] = rest
            taken.remove((i, j))
    return corners.points[np.array(taken, dtype=np.int64).reshape(-1, 2)]


def _visible_pairs(part: Polygon, corners: _Corners, sticking_out: I64) -> list[tuple[int, int]]:
    """Pairs of corners, one of which sticks out, that see each other through free space; the nearest first."""
    count = len(corners.points)
    i, j = np.meshgrid(sticking_out, np.arange(count), indexing="ij")
    pairs = np.unique(np.sort(np.stack((i.ravel(), j.ravel()), axis=-1), axis=1), axis=0)
    ends = corners.points[pairs]
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    pairs, ends, length = pairs[length > _CLEAN_M], ends[length > _CLEAN_M], length[length > _CLEAN_M]
    lines = shapely.linestrings(ends)
    shapely.prepare(part)
    # Through free space, and not along a wall: that would divide nothing.
    seen = shapely.covers(part, lines) & ~shapely.covered_by(lines, part.boundary)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], np.round(length, 9)))
    return [(int(a), int(b)) for a, b in pairs[order[seen[order]]]]


def _angle(corners: _Corners, at: int, other: int) -> float:
    dx, dy = corners.points[other] - corners.points[at]
    return float((math.atan2(dy, dx) - corners.first_rad[at]) % (2.0 * math.pi))


def _is_inside(corners: _Corners, at: int, angle: float) -> bool:
    """Whether the direction leads into free space here; not along a wall, nor out of another corner at this place."""
    return _CLEAN_RAD < angle < float(corners.open_rad[at]) - _CLEAN_RAD


def _passes_corner(points: F64, i: int, j: int) -> bool:
    """Whether another corner lies on the edge: then shorter edges do the same."""
    way, away = points[j] - points[i], points - points[i]
    length = math.hypot(*way)
    along = away @ way / length
    aside = np.abs(away[:, 0] * way[1] - away[:, 1] * way[0]) / length
    return bool(np.any((along > _CLEAN_M) & (along < length - _CLEAN_M) & (aside < _CLEAN_M)))


def _is_needed(fan: list[float], angle: float) -> bool:
    """Whether the direction lies in a wedge of more than half a turn."""
    ordered = sorted(fan)
    for low, high in zip(ordered, ordered[1:]):  # noqa: RUF007 - reads as the wedge that it is
        if low < angle < high:
            return bool(high - low > math.pi + _FLAT_RAD)
    return False


def _widest(fan: list[float]) -> float:
    return float(np.diff(np.sort(fan)).max())


def _crosses(points: F64, pair: tuple[int, int], taken: I64) -> bool:
    """Whether the edge properly crosses one of the taken ones, or lies on it."""
    p, q = points[pair[0]], points[pair[1]]
    a, b = points[taken[:, 0]], points[taken[:, 1]]

    def side(o: F64, d: F64, x: F64) -> F64:
        return np.asarray(
            (d[..., 0] - o[..., 0]) * (x[..., 1] - o[..., 1]) - (d[..., 1] - o[..., 1]) * (x[..., 0] - o[..., 0])
        )

    s1, s2, s3, s4 = side(p, q, a), side(p, q, b), side(a, b, p), side(a, b, q)
    return bool(np.any((s1 * s2 < -(_CLEAN_M**2)) & (s3 * s4 < -(_CLEAN_M**2))))


# --- regions


def _region(number: int, piece: Polygon) -> Region:
    piece = shapely.geometry.polygon.orient(piece, 1.0)
    centre = piece.centroid
    return Region(number, np.asarray(piece.exterior.coords)[:-1, :2], float(piece.area), (centre.x, centre.y))


def _passages(regions: Sequence[Region], edges: Sequence[F64]) -> tuple[Passage, ...]:
    """Each edge with the regions on its two sides."""
    if not edges:
        return ()
    pieces = [Polygon(region.corners_m) for region in regions]
    tree = shapely.STRtree(pieces)
    found = []
    for ends in edges:
        way = ends[1] - ends[0]
        width = float(np.hypot(*way))
        middle, aside = ends.mean(axis=0), np.array([-way[1], way[0]]) / width * min(1e-4, 1e-3 * width)
        sides = [tree.query(shapely.Point(middle + s * aside), predicate="intersects") for s in (1.0, -1.0)]
        if all(len(side) for side in sides) and sides[0][0] != sides[1][0]:
            a, b = sorted((int(sides[0][0]), int(sides[1][0])))
            found.append(Passage(a, b, ends, width))
    return tuple(sorted(found, key=lambda p: (p.a, p.b, float(p.ends_m[0, 0]), float(p.ends_m[0, 1]))))


def _polygon(outline: ArrayLike) -> Any:
    points = np.asarray(outline, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.all(np.isfinite(points)):
        raise ValueError(f"an outline is (K, 2) finite points, at least 3, got shape {points.shape}")
    return shapely.make_valid(Polygon(points))


def _as_multi(shape: Any) -> MultiPolygon:
    """The polygons in a shape, cleaned of repeated points. ValueError if there are none, or they are not valid."""
    parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0.0]
    if not parts:
        raise ValueError("there is no free space")
    plan = MultiPolygon([shapely.simplify(part, 0.0) for part in parts])
    if not shapely.is_valid(plan):
        raise ValueError(f"the free space is not a valid polygon: {shapely.is_valid_reason(plan)}")
    return plan
