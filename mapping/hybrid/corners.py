"""Ways from corner to corner (S44): what a shortest way is made of.

A shortest way is straight but where it goes round something. So for one clearance the corners of what keeps it are
looked for, and joined where they see each other; in passages hardly wider than the clearance, where corners on both
sides crowd each other out, the middle takes their place. A way on this graph is within some hundredths of the shortest
and, once pulled taut, most often is that. Nothing rests on it: what it does not join, the diagram may.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels import corner_ways as ways
from mapping.kernels import corners as kernels
from mapping.kernels.paths import distances_from
from mapping.kernels.sight import BLOCK_COLS, BLOCK_ROWS, pack_open

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_BULGE = 0.555  # of the window around a corner's cell that is open; before a straight wall it is half and a row
_APART, _APART_CELLS = 0.7, 2.0  # between corners on one side, by the clearance
_PUSHED = 0.4  # outward, by the clearance: where the tangents on both sides of a right angle meet
_NARROW, _NARROW_CELLS = 0.6, 4.0  # how much wider than the clearance a passage is that gets places in its middle
_STEP, _STEP_MOST = 0.8, 6  # between these, by the clearance; cells
_REACH = 4.0
_PULLS = 1
_LONGER = 1.01  # than a link two others may be that make it needless
_LANDMARKS, _TRIED, _PAIRS = 8, 48, 1000  # of the diagram; of corners, from which those are taken that tell most
_TRIES = 8  # to find the largest part that hangs together
_AROUND = 512  # places looked at around an end, at most
_HUGE = 1e30
_LINE = 64  # bytes of the cache


class CornerGraph:
    """The corners of a grid for one clearance, joined. Some 100 ms for four million cells, a way some 0.1 ms.

    Not to be used from two threads at once.
    """

    def __init__(
        self, grid: VoronoiGrid, need: float, room: NDArray[np.uint8], edge: I32, chain: I32, first: I32
    ) -> None:
        """need: clearance in cells.  room: (R, C) from sight.measure_room.  edge, chain, first: of a DiagramGraph."""
        self._room, self._step = room, 0.75 * need
        self.sight = packed(room), packed(room.T)
        place, outward = _corners(room, need)
        middle = _passages(grid, need, edge, chain, first)
        place = np.concatenate((place, middle))
        outward = np.concatenate((outward, np.zeros((len(middle), 2))))
        self._across = room.shape[1] // kernels.TILE + 1
        tile = (place[:, 0] // kernels.TILE) * self._across + place[:, 1] // kernels.TILE
        order = np.argsort(tile, kind="stable")
        self.place, self.outward = np.ascontiguousarray(place[order]), np.ascontiguousarray(outward[order])
        tiles = self._across * (room.shape[0] // kernels.TILE + 1)
        self._tile = np.searchsorted(tile[order], np.arange(tiles + 1)).astype(np.int32)
        self.pair = self._links()
        first, link, cost = self._join()
        spot, grain = self._spots(first, link, cost)
        at = self.place.astype(np.int16)
        spot, at, link, tile, outward = _side_by_side(spot, at, link, self._tile, self.outward.astype(np.float32))
        self._of_places = spot.view(np.int16)
        most, count = len(link) + 2 * _AROUND + 1, len(self.place)
        self._point = np.empty((count + 2, 2))
        self.given: tuple[Any, ...] = (
            room, *self.sight, spot, link, at, outward, tile, self._across, self._step, grain,
            np.empty(most, dtype=np.int32), np.empty(most), np.empty((2, _AROUND), dtype=np.int32),
            np.empty((2, _AROUND)), self._point, np.empty_like(self._point), _PULLS, np.zeros(1, dtype=np.int64),
        )  # fmt: skip
        """What ways.way_round takes, and ways.plan_round at last, but for the ends."""

    def way(self, begin: F64, end: F64) -> F64 | None:
        """Corners (N, 2) of a way between two open places (row, col in cells); None if none is known."""
        n = int(ways.way_round(*self.given, *begin.tolist(), *end.tolist()))
        return self.last_way(n) if n else None

    def last_way(self, count: int) -> F64:
        """Corners (count, 2) of the way that was found last."""
        return self._point[:count].copy()

    def forget_links(self) -> None:
        """Join nothing any more: to see what is found without."""
        self._of_places[:, ways.COUNT] = 0

    def _links(self) -> I32:
        pair = np.empty((8 * len(self.place) + 64, 2), dtype=np.int32)
        while True:
            given: tuple[Any, ...] = (self.place, self.outward, self._tile, self._across, self._step, pair)
            m = int(kernels.link_places(self._room, *self.sight, *given))
            if m <= len(pair):
                return pair[:m].copy()
            pair = np.empty((m, 2), dtype=np.int32)

    def _join(self) -> tuple[I32, I32, F32]:
        """Links that are needed: the first of each place (N + 1,), what it is joined with, and how far that is."""
        count, pair = len(self.place), self.pair
        length = np.hypot(*(self.place[pair[:, 0]] - self.place[pair[:, 1]]).astype(np.float64).T).astype(np.float32)
        ends = np.concatenate((pair[:, 0], pair[:, 1]))
        order = np.argsort(ends, kind="stable")
        first = np.searchsorted(ends[order], np.arange(count + 1)).astype(np.int32)
        link, cost = np.concatenate((pair[:, 1], pair[:, 0]))[order], np.concatenate((length, length))[order]
        kept = np.empty(len(link), dtype=np.bool_)
        ways.needed_links(first, link, cost, _LONGER, kept)
        first = np.concatenate(([0], np.cumsum(kept)))[first].astype(np.int32)
        return first, link[kept], cost[kept]

    def _spots(self, first: I32, link: I32, cost: F32) -> tuple[NDArray[np.uint16], float]:
        """What mapping.kernels.corner_ways calls mark (N, 32), with what lies beside it, and grain."""
        heap, key = np.empty(len(link) + 2, dtype=np.int32), np.empty(len(link) + 2)

        def from_place(source: int, row: F32) -> None:
            ways.distances(source, first, link, cost, row, heap, key)

        row = _telling(_far_apart(len(self.place), _TRIED, from_place), self.place)
        reached = row < 0.5 * _HUGE
        grain = max(float(row.max(initial=0.0, where=reached)) / (ways.FAR_MARK - 1.5), 1.0 / 64.0)
        spot = np.zeros((len(self.place), _LINE // 2), dtype=np.uint16)
        told = np.rint(np.where(reached, row, 0.0) / grain)
        spot[:, ways.MARK : ways.MARK + len(row)] = np.where(reached, told, ways.FAR_MARK).T
        cells, wide = spot.view(np.int16), spot.view(np.int32)
        cells[:, ways.ROW], cells[:, ways.COL] = self.place.T
        cells[:, ways.COUNT], wide[:, ways.FIRST] = np.diff(first), first[:-1]
        return spot, grain


def packed(room: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """sight.by_row; of the transpose by_col."""
    rows, cols = room.shape
    packed = np.empty((rows // BLOCK_ROWS + 1, cols // BLOCK_COLS + 1, BLOCK_ROWS), dtype=np.uint32)
    pack_open(room, packed)
    return packed


def _side_by_side(*arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Copies in one block of memory, each from a line of the cache on. numpy asks for large pages for a block of more
    than 4 MB: what a search reads here and there is then found without walks through page tables."""
    room = 1 << 22
    begin = np.cumsum([0] + [-(-array.nbytes // _LINE) * _LINE for array in arrays])
    block = np.empty(int(begin[-1]) + _LINE + room, dtype=np.uint8)
    skipped = -block.ctypes.data % _LINE
    copies = []
    for at, array in zip(begin.tolist(), arrays):
        part = block[skipped + at : skipped + at + array.nbytes]
        copies.append(part.view(array.dtype).reshape(array.shape))
        copies[-1][...] = array
    return copies


def landmarks(first: I32, link: I32, edge: I32, cost: F64) -> F32:
    """(N, L) distances from nodes that _far_apart chooses, of a DiagramGraph with these costs of its edges."""
    nodes = len(first) - 1
    row = _far_apart(nodes, _LANDMARKS, lambda source, row: distances_from(source, first, link, edge, cost, row))
    return np.ascontiguousarray(row.T)


def _far_apart(nodes: int, count: int, from_node: Callable[[int, F32], None]) -> F32:
    """(L, N) distances from nodes of the largest part that hangs together (of those found in some tries), each of which
    is as far as can be from those before it; huge where nothing joins a node with them.

    from_node: fills a row with the distances from a node.
    """
    table = np.empty((min(count, nodes), nodes), dtype=np.float32)
    row, known = np.empty(nodes, dtype=np.float32), np.zeros(nodes, dtype=np.bool_)
    if not nodes:
        return table
    source, most = 0, 0
    for _ in range(_TRIES):
        start = int(np.argmin(known))
        if known[start] or np.count_nonzero(~known) <= most:
            break
        from_node(start, row)
        reached = row < 0.5 * _HUGE
        known |= reached
        if np.count_nonzero(reached) > most:
            most = int(np.count_nonzero(reached))
            source = int(np.argmax(np.where(reached, row, -1.0)))
    away = np.full(nodes, np.inf, dtype=np.float32)
    for row in table:
        from_node(source, row)
        away = np.minimum(away, row)
        source = int(np.argmax(np.where(away < 0.5 * _HUGE, away, -1.0)))
    return table


def _telling(row: F32, place: I32) -> F32:
    """Of landmarks (L, N) those MARKS that together tell most about how far random places are from each other."""
    among = np.flatnonzero(row[0] < 0.5 * _HUGE) if len(row) else np.empty(0, dtype=np.int64)
    if len(row) <= ways.MARKS or not len(among):
        return row
    a, b = np.random.default_rng(0).choice(among, size=(2, _PAIRS))
    told = np.abs(row[:, a] - row[:, b])
    best = np.hypot(*(place[a] - place[b]).astype(np.float64).T)
    chosen: list[int] = []
    for _ in range(ways.MARKS):
        gain = np.maximum(told - best, 0.0).sum(axis=1)
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
        best = np.maximum(best, told[chosen[-1]])
    return row[chosen]


def _corners(room: NDArray[np.uint8], need: float) -> tuple[I32, F64]:
    """Cells [row, col] a little off what a way goes round, and which way that is outward."""
    total = np.empty((room.shape[0] + 1, room.shape[1] + 1), dtype=np.int32)
    kernels.count_open(room, total)
    reach = int(min(max(1.25 * need, _REACH), 20.0))
    cell, score = np.empty(1 << 16, dtype=np.int32), np.empty(1 << 16, dtype=np.int32)
    while (n := int(kernels.bulges(room, total, reach, _BULGE, cell, score))) > len(cell):
        cell, score = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    cell = cell[:n][np.argsort(-score[:n], kind="stable")]
    place, outward = np.empty((n, 2), dtype=np.int32), np.empty((n, 2))
    apart = _APART * need + _APART_CELLS
    n = int(kernels.choose_corners(room, total, reach, cell, apart, _PUSHED * need, place, outward))
    return place[:n], outward[:n]


def _passages(grid: VoronoiGrid, need: float, edge: I32, chain: I32, first: I32) -> I32:
    """Cells [row, col] along the middle of narrow passages."""
    field, wide2 = grid.field, (need + max(_NARROW * need, _NARROW_CELLS)) ** 2
    step = max(min(int(_STEP * need), _STEP_MOST), 1)
    middle = np.empty((1 << 14, 2), dtype=np.int32)
    while True:
        n = int(
            kernels.choose_passages(
                field.squared, field.site, edge, chain, first, math.ceil(need * need), wide2, step, middle
            )
        )
        if n <= len(middle):
            return middle[:n]
        middle = np.empty((n, 2), dtype=np.int32)
