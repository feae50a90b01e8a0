"""Planning on the Voronoi diagram, made straight on the grid (S44).

A way is looked for from corner to corner, or, where these do not join the ends, and for others that go elsewhere, on
the graph of the diagram, which is small. It is then pulled taut on the grid, which makes it about as short as any.
Every cell that it crosses is free and keeps the clearance; unknown cells are obstacles like others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.grids.geometry import check_resolution
from mapping.hybrid.corners import CornerGraph, landmarks
from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels import paths as kernels
from mapping.kernels.corner_ways import plan_round
from mapping.kernels.rooms import connected
from mapping.kernels.sight import length_of, measure_room, taut

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

HALF_CELLS = math.sqrt(2.0)
"""A robot anywhere in a cell D cells from an obstacle's cell is at least D - sqrt(2) from the obstacle."""

_USED_AGAIN = 1.4  # what an edge of an earlier way costs in the search for others
_ELSEWHERE = 0.3  # of an alternative's length, at least
_PULLS = 1
_APART_M = 0.5  # poses of a way, at most
_CLEARANCES_KEPT = 3
_NEAR_CELLS = 120  # ends nearer than this are joined on the grid, too, if the way is so much longer than straight on:
_DETOUR = 1.1


class NoWayError(ValueError):
    """There is no way, and why: one of the ends is not free enough, or nothing joins them."""


@dataclass(frozen=True, slots=True)
class Way:
    """poses: (N, 3) x, y in metres and yaw along the way.  clearance_m: (N,) free room around each pose, at least."""

    poses: F64
    length_m: float
    clearance_m: F64
    least_clearance_m: float


@dataclass(frozen=True, slots=True)
class Plan:
    """The shortest way found, and others that go elsewhere for a good part, by length."""

    way: Way
    alternatives: tuple[Way, ...]


@dataclass(frozen=True, slots=True)
class DiagramGraph:
    """The diagram as a graph. node: (N, 2) cells [row, col].  edge: (E, 4) columns of mapping.kernels.paths.

    chain: (K,) cells of all edges, row * C + col.  along: (K,) length from node A, cells.  length, least_squared: (E,).
    chord: (E,) straight from node to node: what a way that is pulled taut is nearer to.
    first, link: edges of node n are link[first[n] : first[n + 1]].  leads_out: (N,) the edge out of a dead end, or -1.
    mark: (N, L) float32 shortest way by chords to each node from some that lie far apart.
    """

    node: I32
    node_cell: I32
    edge: I32
    chain: I32
    along: F64
    length: F64
    chord: F64
    least_squared: F64
    where: I32
    first: I32
    link: I32
    leads_out: I32
    mark: NDArray[np.float32]


def graph_of(grid: VoronoiGrid) -> DiagramGraph:
    """Thin the diagram to lines of single cells and follow them from node to node."""
    squared = grid.field.squared
    cells = np.flatnonzero(grid.axis).astype(np.int32)
    cells = cells[np.argsort(squared.ravel()[cells], kind="stable")]
    line = grid.axis.copy()
    kernels.thin(line, cells)
    cells = np.sort(cells[line.ravel()[cells]])
    size = len(cells) + 1
    where = np.zeros(grid.shape, dtype=np.int32)
    node, chain = np.empty(size, dtype=np.int32), np.empty(size, dtype=np.int32)
    along = np.empty(size)
    edge, measure = np.empty((4 * size, 4), dtype=np.int32), np.empty((4 * size, 2))
    nodes, chained, edges = kernels.trace(line, squared, cells, where, node, chain, along, edge, measure)
    edge, measure = edge[:edges].copy(), measure[:edges]
    ends = np.concatenate((edge[:, kernels.A], edge[:, kernels.B]))
    number = np.tile(np.arange(edges, dtype=np.int32), 2)
    order = np.argsort(ends, kind="stable")
    first = np.searchsorted(ends[order], np.arange(nodes + 1)).astype(np.int32)
    places = np.stack(np.divmod(node[:nodes], grid.shape[1]), axis=-1).astype(np.int32)
    link, leads_out = number[order], np.empty(nodes, dtype=np.int32)
    kernels.find_dead_ends(first, link, edge, leads_out)
    chord = np.hypot(*(places[edge[:, kernels.A]] - places[edge[:, kernels.B]]).astype(np.float64).T)
    return DiagramGraph(
        places, node[:nodes].copy(), edge, chain[:chained].copy(), along[:chained].copy(), measure[:, 0].copy(), chord,
        measure[:, 1].copy(), where, first, link, leads_out, landmarks(first, link, edge, chord),
    )  # fmt: skip


class Planner:
    """Plans on one state of a grid. Making it costs some tens of milliseconds for millions of cells, the first plan
    with a clearance some hundreds, others little.

    Not to be used from two threads at once. The grid must not change under it.
    """

    def __init__(self, grid: VoronoiGrid, resolution_m: float, *, row0: int = 0, col0: int = 0) -> None:
        """row0, col0: the grid's first cell on the map; it begins at x = col0 * resolution_m, y alike."""
        self.resolution_m = check_resolution(resolution_m)
        self.grid, self.row0, self.col0 = grid, row0, col0
        self.graph = graph_of(grid)
        graph = self.graph
        self._seen: I32 = np.zeros(grid.shape, dtype=np.int32)
        self._stamp = 0
        self._queue = np.empty(min(grid.field.squared.size, 1 << 20), dtype=np.int32)
        self._came = np.empty_like(self._queue)
        self._tables: dict[float, _Tables] = {}
        self._best, self._via = np.empty(len(graph.node)), np.empty(len(graph.node), dtype=np.int32)
        self._state: I32 = np.zeros(len(graph.node), dtype=np.int32)
        room = len(graph.link) + 3
        self._heap, self._key = np.empty(room, dtype=np.int32), np.empty(room)
        self._cells = np.empty(len(graph.chain) + len(graph.node), dtype=np.int32)
        self._used = np.empty(len(graph.edge), dtype=np.int32)
        self._given: tuple[Any, ...] | None = None  # what plan_round takes but for the ends, for this clearance:
        self._given_for_m = math.nan
        self._room_for_poses(1 << 10)

    def plan(
        self, start: tuple[float, float], goal: tuple[float, float], *, clearance_m: float = 0.0, alternatives: int = 2
    ) -> Plan:
        """A short way from start to goal (x, y, metres) that stays clearance_m from all that is not known to be free.

        alternatives: how many others at most. Raises NoWayError if there is none, ValueError for numbers that are no
        positions or no clearance.
        """
        if alternatives == 0 and (way := self._at_once(start, goal, clearance_m)) is not None:
            return Plan(way, ())
        if not (math.isfinite(clearance_m) and clearance_m >= 0.0):
            raise ValueError(f"clearance_m is a length, got {clearance_m}")
        need = clearance_m / self.resolution_m + HALF_CELLS
        begin, end = np.array(self._cell("start", start, need)), np.array(self._cell("goal", goal, need))
        if self._given is None or clearance_m != self._given_for_m:
            self.ready_for(clearance_m)
        pulled = self._ways(begin, end, need, alternatives)
        if not pulled:
            raise NoWayError(f"no way with {clearance_m:.2f} m of clearance leads from the start to the goal")
        pulled.sort(key=lambda corners: float(length_of(corners, len(corners))))
        kept = pulled[:1]
        for corners in pulled[1:]:
            if len(kept) > alternatives or not all(_goes_elsewhere(corners, other) for other in kept):
                continue
            direct = self._by_way_of(_farthest_off(corners, kept[0]), begin, end, need)
            if direct is None:
                kept.append(corners)
            elif all(_goes_elsewhere(direct, other) for other in kept):
                kept.append(direct)
        kept.sort(key=lambda corners: float(length_of(corners, len(corners))))
        described = [self._describe(corners) for corners in kept]
        return Plan(described[0], tuple(described[1:]))

    def _at_once(self, start: tuple[float, float], goal: tuple[float, float], clearance_m: float) -> Way | None:
        """The way from corner to corner, if it is known and nothing else is to be tried, in one compiled call; of the
        clearance that was asked for last."""
        if self._given is None or clearance_m != self._given_for_m:
            return None
        given = (*self._given, float(start[0]), float(start[1]), float(goal[0]), float(goal[1]))
        corners, poses, length_m, least_m = plan_round(*given)
        if corners == 0:
            return None
        if poses > len(self._clear):
            tables = self._tables_for(clearance_m / self.resolution_m + HALF_CELLS)
            return self._describe(tables.corners.last_way(corners))
        return Way(self._pose[:poses].copy(), length_m, self._clear[:poses].copy(), least_m)

    def _ways(self, begin: F64, end: F64, need: float, alternatives: int) -> list[F64]:
        """Corners of ways that are pulled taut, in any order; none only if the grid has none."""
        if not self._are_joined(begin, end, need):
            return []
        found = self._tables_for(need).corners.way(begin, end)
        ways = [] if found is None else [found]
        straight = math.hypot(*(end - begin))
        if straight <= _NEAR_CELLS and (found is None or length_of(found, len(found)) > _DETOUR * straight):
            cells = self._on_grid(begin, end, need, margin=_NEAR_CELLS // 3)
            if len(cells):
                ways.append(self._taut(cells, begin, end, need))
        if not ways or alternatives > 0:
            tries = 1 + 2 * alternatives if alternatives > 0 else 1
            ways += [self._taut(cells, begin, end, need) for cells in self._candidates(begin, end, need, tries)]
        if not ways:
            ways.append(self._taut(self._on_grid(begin, end, need, margin=max(self.grid.shape)), begin, end, need))
        return ways

    def _by_way_of(self, place: F64, begin: F64, end: F64, need: float) -> F64 | None:
        """Corners of the way over a place that is short before it and after; None if corners know none.

        A way of the diagram that has to be another winds about furniture at its ends, where it could go as others do.
        """
        corners = self._tables_for(need).corners
        to, on = corners.way(begin, place), corners.way(place, end)
        if to is None or on is None:
            return None
        points = np.concatenate((to, on[1:]))
        n = int(taut(*corners.sight, points, len(points), _PULLS, np.empty_like(points)))
        return points[:n].copy()

    def _are_joined(self, begin: F64, end: F64, need: float) -> bool:
        """Whether the cells of both hang together."""
        part = self._tables_for(need).part
        (r0, c0), (r1, c1) = np.floor(begin + 0.5).astype(int), np.floor(end + 0.5).astype(int)
        return bool(part[r0, c0] == part[r1, c1])

    def ready_for(self, clearance_m: float) -> None:
        """Make now what the first plan with this clearance would have to wait for."""
        need = clearance_m / self.resolution_m + HALF_CELLS
        tables = self._tables_for(need)
        squared, *others = self._to_describe
        self._given_for_m = clearance_m
        self._given = (
            tables.part,
            squared,
            math.ceil(need * need),
            float(_NEAR_CELLS),
            _DETOUR,
            *others,
            *tables.corners.given,
        )

    def _cell(self, what: str, place: tuple[float, float], need: float) -> tuple[float, float]:
        """(row, col) in cells, a cell's centre at whole numbers; NoWayError if it is not free enough."""
        at_row = place[1] / self.resolution_m - self.row0 - 0.5
        at_col = place[0] / self.resolution_m - self.col0 - 0.5
        if not (math.isfinite(at_row) and math.isfinite(at_col)):
            raise ValueError(f"the {what} is no position: {place}")
        row, col = math.floor(at_row + 0.5), math.floor(at_col + 0.5)
        height, width = self.grid.shape
        inside = 0 <= row < height and 0 <= col < width
        clear = math.sqrt(self.grid.field.squared.item(row, col)) if inside else 0.0
        if clear == 0.0:
            raise NoWayError(f"the {what} ({place[0]:.2f}, {place[1]:.2f}) is not known to be free")
        if clear < need:
            have = max(clear - HALF_CELLS, 0.0) * self.resolution_m
            raise NoWayError(
                f"the {what} ({place[0]:.2f}, {place[1]:.2f}) has {have:.2f} m of clearance, "
                f"asked are {(need - HALF_CELLS) * self.resolution_m:.2f} m"
            )
        return at_row, at_col

    def _candidates(self, begin: F64, end: F64, need: float, tries: int) -> list[I32]:
        """Ways from cell to cell on the graph, shortest first."""
        width = self.grid.shape[1]
        start, goal = (int(r) * width + int(c) for r, c in (np.floor(begin + 0.5), np.floor(end + 0.5)))
        found: list[I32] = []
        need2 = math.ceil(need * need)
        outward, met = self._reach(start, goal, need2)
        if outward is None:
            return found
        if met:
            return [*found, outward]
        inward, _ = self._reach(goal, -1, need2)
        if inward is None:
            return found
        first, last = self._joints(int(outward[-1]), need2), self._joints(int(inward[-1]), need2)
        along = self._within_edge(first, last, need2)
        if along is not None:
            found.append(np.concatenate((outward, along, inward[::-1])))
        graph = self.graph
        usable = self._tables_for(need).usable.copy()
        for joint in (first, last):
            kernels.open_ways_out(graph.edge, graph.least_squared, need2, graph.leads_out, joint.nodes, usable)
        target = np.array(divmod(int(inward[-1]), width), dtype=np.float64)
        cost = graph.chord if tries == 1 else graph.chord.copy()
        for _ in range(tries):
            self._stamp += 2
            node, _total = kernels.shortest_way(
                graph.first, graph.link, graph.edge, cost, usable, graph.node, graph.mark, first.nodes, first.ways,
                last.nodes, last.ways, target, self._via, self._best, self._state, self._stamp, self._heap, self._key,
            )  # fmt: skip
            if node < 0:
                break
            cells, used = self._cells, self._used
            k, m = kernels.cells_of_way(graph.node_cell, graph.edge, graph.chain, self._via, node, cells, used)
            begun = -int(graph.where.ravel()[cells[k - 1]]) - 1
            found.append(
                np.concatenate(
                    (
                        outward,
                        self._to_node(first, begun),
                        cells[:k][::-1],
                        self._to_node(last, node)[::-1],
                        inward[::-1],
                    )
                )
            )
            if tries > 1:
                cost[used[:m]] *= _USED_AGAIN
        return found

    def _tables_for(self, need: float) -> _Tables:
        """Kept for the clearances asked for last."""
        tables = self._tables.pop(need, None)
        if tables is None:
            graph, room = self.graph, np.empty(self.grid.shape, dtype=np.uint8)
            usable = np.empty(len(graph.edge), dtype=np.bool_)
            kernels.open_edges(graph.edge, graph.least_squared, math.ceil(need * need), graph.leads_out, usable)
            measure_room(self.grid.field.squared, need, room)
            part = np.empty(self.grid.shape, dtype=np.int32)
            connected(room > 0, True, part)
            corners = CornerGraph(self.grid, need, room, graph.edge, graph.chain, graph.first)
            tables = _Tables(usable, corners, part)
        self._tables[need] = tables
        if len(self._tables) > _CLEARANCES_KEPT:
            del self._tables[next(iter(self._tables))]
        return tables

    def _on_grid(self, begin: F64, end: F64, need: float, *, margin: int) -> I32:
        """Cells of the shortest way within a window around both; none if there is no such way."""
        height, width = self.grid.shape
        (r0, c0), (r1, c1) = (np.floor(at + 0.5).astype(int).tolist() for at in (begin, end))
        top, left = max(min(r0, r1) - margin, 0), max(min(c0, c1) - margin, 0)
        window = min(max(r0, r1) + margin + 1, height) - top, min(max(c0, c1) + margin + 1, width) - left
        cells, start, goal = np.empty(window[0] * window[1], dtype=np.int32), r0 * width + c0, r1 * width + c1
        need2 = math.ceil(need * need)
        n = int(kernels.way_on_grid(self.grid.field.squared, need2, start, goal, top, left, *window, cells))
        return cells[:n][::-1]

    def _reach(self, start: int, goal: int, need2: int) -> tuple[I32 | None, bool]:
        """Cells from start to the diagram (or to the goal: True)."""
        self._stamp += 2
        i = int(
            kernels.reach_line(
                self.grid.field.squared,
                self.graph.where,
                need2,
                start,
                goal,
                self._seen,
                self._stamp,
                self._queue,
                self._came,
            )
        )
        if i < 0:
            return None, False
        cells = np.empty(i + 1, dtype=np.int32)
        n = kernels.way_in_queue(self._queue, self._came, i, cells)
        return cells[:n], int(cells[n - 1]) == goal

    def _joints(self, cell: int, need2: int) -> _Joints:
        graph = self.graph
        nodes, ways = np.empty(2, dtype=np.int32), np.empty(2)
        n, k = kernels.joints(
            self.grid.field.squared, graph.where, graph.node_cell, graph.edge, graph.chain, graph.along, graph.length,
            cell, need2, nodes, ways,
        )  # fmt: skip
        return _Joints(int(k), nodes[:n], ways[:n])

    def _within_edge(self, first: _Joints, last: _Joints, need2: int) -> I32 | None:
        """Cells between two cells of one edge, along it; None if they are not, or it is too narrow between."""
        graph, a, b = self.graph, first.k, last.k
        if a < 0 or b < 0 or kernels.edge_of(graph.edge, a) != kernels.edge_of(graph.edge, b):
            return None
        cells = graph.chain[a : b + 1] if a <= b else graph.chain[b : a + 1][::-1]
        return cells if self.grid.field.squared.ravel()[cells].min() >= need2 else None

    def _to_node(self, joint: _Joints, node: int) -> I32:
        """Cells from the diagram cell of a joint to the node, without the node."""
        graph = self.graph
        if joint.k < 0:
            return graph.chain[:0]
        a, b, begin, end = (int(v) for v in graph.edge[kernels.edge_of(graph.edge, joint.k)])
        ways = joint.ways[joint.nodes == node]
        back = node == a and (node != b or ways.min() == graph.along[joint.k])
        return graph.chain[begin : joint.k + 1][::-1] if back else graph.chain[joint.k : end]

    def _taut(self, cells: I32, begin: F64, end: F64, need: float) -> F64:
        """(N, 2) corners of the way, in cells."""
        rows, cols = np.divmod(cells, self.grid.shape[1])
        n = len(cells) + 2
        points = np.empty((n, 2))
        points[0], points[n - 1] = begin, end
        points[1 : n - 1, 0], points[1 : n - 1, 1] = rows, cols
        work = np.empty_like(points)
        n = int(taut(*self._tables_for(need).corners.sight, points, n, _PULLS, work))
        return points[:n].copy()

    def _room_for_poses(self, count: int) -> None:
        self._pose, self._clear = np.empty((count, 3)), np.empty(count)
        self._given = None
        self._to_describe: tuple[Any, ...] = (
            self.grid.field.squared, _APART_M / self.resolution_m, self.resolution_m, float(self.row0),
            float(self.col0), HALF_CELLS, self._pose, self._clear,
        )  # fmt: skip

    def _describe(self, corners: F64) -> Way:
        """Poses at the corners and between them, at most half a metre apart."""
        squared, *others = self._to_describe
        n, length_m, least_m = kernels.describe(squared, corners, len(corners), *others)
        if n > len(self._clear):
            self._room_for_poses(2 * n)
            return self._describe(corners)
        return Way(self._pose[:n].copy(), length_m, self._clear[:n].copy(), least_m)


@dataclass(frozen=True, slots=True)
class _Tables:
    """For one clearance. usable: (E,) edges wide enough, without dead ends.  corners: of the same clearance.
    part: (R, C), cells of one number hang together, -1 where there is too little."""

    usable: Bools
    corners: CornerGraph
    part: I32


@dataclass(frozen=True, slots=True)
class _Joints:
    """Where an end comes to the diagram. k: place in the chain, -1 at a node.  nodes, ways: next to it, how far."""

    k: int
    nodes: I32
    ways: F64


def _goes_elsewhere(corners: F64, other: F64) -> bool:
    """Whether a good part of one way lies well off another."""
    mine, others = _samples(corners), _samples(other)
    away = np.hypot(mine[:, None, 0] - others[:, 0], mine[:, None, 1] - others[:, 1]).min(axis=1)
    step = np.hypot(*(others[1] - others[0]))
    return bool(np.mean(away > max(10.0, step)) >= _ELSEWHERE)


def _farthest_off(corners: F64, other: F64) -> F64:
    """The point of a way that is farthest from another."""
    mine, others = _samples(corners), _samples(other)
    away = np.hypot(mine[:, None, 0] - others[:, 0], mine[:, None, 1] - others[:, 1]).min(axis=1)
    farthest: F64 = mine[int(np.argmax(away))]
    return farthest


def _samples(corners: F64, count: int = 64) -> F64:
    """(count, 2) points evenly along a way."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    at = np.linspace(0.0, along[-1], count)
    return np.stack((np.interp(at, along, corners[:, 0]), np.interp(at, along, corners[:, 1])), axis=-1)
