"""Ways from corner to corner (S44): what a shortest way is made of.

A shortest way is straight but where it goes round something. So for one clearance the corners of what keeps it are
looked for, and joined where they see each other; in passages hardly wider than the clearance, where corners on both
sides crowd each other out, the middle takes their place. A way on this graph is within some hundredths of the shortest
and, once pulled taut, most often is that. Nothing rests on it: what it does not join, the diagram may.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels import corners as kernels
from mapping.kernels.paths import distances_from

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

LANDMARKS = kernels.MARKS

_BULGE = 0.555  # of the window around a corner's cell that is open; before a straight wall it is half and a row
_APART, _APART_CELLS = 0.7, 2.0  # between corners on one side, by the clearance
_PUSHED = 0.4  # outward, by the clearance: where the tangents on both sides of a right angle meet
_NARROW, _NARROW_CELLS = 0.6, 4.0  # how much wider than the clearance a passage is that gets places in its middle
_STEP, _STEP_MOST = 0.8, 6  # between these, by the clearance; cells
_REACH = 4.0
_PULLS = 2
_HUGE = 1e30


class CornerGraph:
    """The corners of a grid for one clearance, joined. Some 100 ms for four million cells, a way some 0.2 ms.

    Not to be used from two threads at once.
    """

    def __init__(
        self, grid: VoronoiGrid, need: float, room: NDArray[np.uint8], edge: I32, chain: I32, first: I32
    ) -> None:
        """need: clearance in cells.  room: (R, C) from paths.measure_room.  edge, chain, first: of a DiagramGraph."""
        self._room, self._step = room, 0.75 * need
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
        spot, first, link = self._join()
        count = len(self.place)
        most = len(link) + 2 * count + 1
        search = np.zeros((count, 4), dtype=np.int32)
        search.view(np.float32)[:, kernels.TO_END] = _HUGE
        spot, self._first, link, search = _side_by_side(spot, first, link, search)
        self._stamp = 0
        self._point = np.empty((count + 2, 2))
        self._given: tuple[Any, ...] = (
            room, spot, self._first, link, search, self._tile, self._across, self._step, link.view(np.float32),
            search.view(np.float32), np.empty(most, dtype=np.int32), np.empty(most),
            np.empty((2, count), dtype=np.int32), np.empty((2, count)), self._point, np.empty_like(self._point), _PULLS,
        )  # fmt: skip

    def way(self, begin: F64, end: F64) -> F64 | None:
        """Corners (N, 2) of a way between two open places (row, col in cells); None if none is known."""
        self._stamp += 2
        given: tuple[Any, ...] = (*self._given, self._stamp, *begin.tolist(), *end.tolist())
        n = int(kernels.way_round(*given))
        return self.last_way(n) if n else None

    def last_way(self, count: int) -> F64:
        """Corners (count, 2) of the way that was found last."""
        return self._point[:count].copy()

    def plan(self, given: tuple[Any, ...], begin: tuple[float, float], end: tuple[float, float]) -> tuple[Any, ...]:
        """A way with its poses in one compiled call. given: what kernels.plan_round takes first; what it tells."""
        self._stamp += 2
        given = (*given, *self._given, self._stamp, *begin, *end)
        told: tuple[Any, ...] = kernels.plan_round(*given)
        return told

    def _links(self) -> I32:
        pair = np.empty((8 * len(self.place) + 64, 2), dtype=np.int32)
        while True:
            m = int(
                kernels.link_places(self._room, self.place, self.outward, self._tile, self._across, self._step, pair)
            )
            if m <= len(pair):
                return pair[:m].copy()
            pair = np.empty((m, 2), dtype=np.int32)

    def _join(self) -> tuple[NDArray[np.float32], I32, I32]:
        """What kernels.way_round calls spot, first and link."""
        count, pair = len(self.place), self.pair
        length = np.hypot(*(self.place[pair[:, 0]] - self.place[pair[:, 1]]).astype(np.float64).T)
        ends = np.concatenate((pair[:, 0], pair[:, 1]))
        order = np.argsort(ends, kind="stable")
        first = np.searchsorted(ends[order], np.arange(count + 1)).astype(np.int32)
        link = np.empty((len(ends), 2), dtype=np.int32)
        link[:, kernels.OTHER] = np.concatenate((pair[:, 1], pair[:, 0]))[order]
        link.view(np.float32)[:, kernels.COST] = np.concatenate((length, length))[order]
        mark = landmarks(first, np.tile(np.arange(len(pair), dtype=np.int32), 2)[order], pair, length)
        spot = np.zeros((count, kernels.SPOT), dtype=np.float32)
        spot[:, : kernels.MARK] = np.concatenate((self.place, self.outward), axis=1)
        spot[:, kernels.MARK : kernels.MARK + mark.shape[1]] = mark
        return spot, first, link


def _side_by_side(*arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Copies in one block of memory, each from a line of the cache on. numpy asks for large pages for a block of more
    than 4 MB: what a search reads here and there is then found without walks through page tables."""
    line, room = 64, 1 << 22
    begin = np.cumsum([0] + [-(-array.nbytes // line) * line for array in arrays])
    block = np.empty(int(begin[-1]) + line + room, dtype=np.uint8)
    skipped = -block.ctypes.data % line
    copies = []
    for at, array in zip(begin.tolist(), arrays):
        part = block[skipped + at : skipped + at + array.nbytes]
        copies.append(part.view(array.dtype).reshape(array.shape))
        copies[-1][...] = array
    return copies


def landmarks(first: I32, link: I32, edge: I32, cost: F64) -> NDArray[np.float32]:
    """(N, L) distances from nodes of the largest part that hangs together (of those found in some tries), each of which
    is as far as can be from those before it; huge where nothing joins a node with them."""
    nodes = len(first) - 1
    mark = np.empty((nodes, min(LANDMARKS, nodes)), dtype=np.float32)
    row, known = np.empty(nodes, dtype=np.float32), np.zeros(nodes, dtype=np.bool_)
    if not nodes:
        return mark
    source, most = 0, 0
    for _ in range(LANDMARKS):
        start = int(np.argmin(known))
        if known[start] or np.count_nonzero(~known) <= most:
            break
        distances_from(start, first, link, edge, cost, row)
        reached = row < 0.5 * _HUGE
        known |= reached
        if np.count_nonzero(reached) > most:
            source, most = start, int(np.count_nonzero(reached))
    away = np.full(nodes, np.inf, dtype=np.float32)
    for k in range(mark.shape[1]):
        distances_from(source, first, link, edge, cost, row)
        mark[:, k] = row
        away = np.minimum(away, row)
        source = int(np.argmax(np.where(away < 0.5 * _HUGE, away, -1.0)))
    return mark


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
