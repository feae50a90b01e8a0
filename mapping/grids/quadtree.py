"""A grid map as a quadtree: squares of one kind are one leaf, mixed ones are divided in four (S31, algorithm 5.4).

A leaf is all free, all occupied or all unknown. A cell that is neither for sure (partly free) is unknown here, as in
picture files. Walls and the rim of what was seen cost nodes, rooms and the unknown outside nearly none. The two lowest
levels are kept in place: a mixed square of 4 x 4 cells is one entry that says each of them, so that a real map takes
less than a twentieth of its cells in entries (8 bytes each, four a node). Questions, counts and bytes are those of
algorithm 5.4, which divides down to the cell. Cells follow mapping.grids.geometry: [row, col], row with +y.
"""

from __future__ import annotations

import copy
import struct
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.evidence import FREE, OCCUPIED, UNKNOWN
from mapping.grids.geometry import cells_of, check_resolution
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import Window
from mapping.kernels import quadtree as kernels

I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
I8 = NDArray[np.int8]

MAX_LEVELS: Final = 24  # 16.8 million cells an edge
_LEAST_LEVELS: Final = 2  # a root of 4 x 4 cells
_CELLS_A_NODE: Final = 128  # room that is made for a map at once: what is too small means writing all again
MAX_WINDOW_CELLS: Final = 1 << 28
MAX_CORNER: Final = 1 << 40
# Squares of 2^i cells begin at multiples of 2^i, counted from here: so all quadtrees divide the plane alike. Up to 256
# cells those are the multiples counted from the origin, too; of larger ones the borders keep away from it, so that a
# map around it needs no huge root (1/3 is 0.010101... in twos).
BASE: Final = 0x155_5555_5500
_STATES: Final = np.array([UNKNOWN, FREE, OCCUPIED], dtype=np.int8)
_PERCENT: Final = np.array([-1, 0, 100], dtype=np.int8)

# Bytes: magic, version, resolution, levels, row and column of the corner, the root's kind, nodes, CRC-32 of all that
# and of the nodes; then zlib of a byte a node.
HEADER: Final = struct.Struct("<4sBdBqqBII")
MAGIC: Final = b"UQDT"
VERSION: Final = 1


@dataclass(frozen=True, slots=True)
class CellCount:
    """Cells of a rectangle by what is known about them."""

    unknown: int
    free: int
    occupied: int


class Quadtree:
    """A square of 2^k x 2^k cells that grows as cells are written, unknown outside. Not for two threads at once.

    free_below, occupied_from: a cell with less per cent is free, from the other on occupied, else unknown.
    """

    def __init__(self, *, resolution_m: float, free_below: int = 25, occupied_from: int = 65) -> None:
        if not 0 < free_below <= occupied_from <= 100:
            raise ValueError(f"0 < free_below <= occupied_from <= 100, got {free_below} and {occupied_from}")
        self.resolution_m = check_resolution(resolution_m)
        self.free_below = free_below
        self.occupied_from = occupied_from
        self._levels = _LEAST_LEVELS
        self._row0 = self._col0 = 0
        self._root: int = kernels.UNKNOWN
        self._begin(64)

    def _begin(self, room: int) -> None:
        self._nodes: I64 = np.empty((room, 4), dtype=np.int64)
        self._spare: I32 = np.empty(room, dtype=np.int32)
        self._state: I64 = np.zeros(kernels.STATE_LENGTH, dtype=np.int64)

    @classmethod
    def of_patch(cls, patch: GridPatch, *, free_below: int = 25, occupied_from: int = 65) -> Quadtree:
        """The quadtree of a grid."""
        tree = cls(resolution_m=patch.resolution_m, free_below=free_below, occupied_from=occupied_from)
        tree.write(patch)
        return tree

    # ------------------------------------------------------------------ taking in

    def write(self, patch: GridPatch) -> None:
        """Put a rectangle of cells in the place of what was there, dividing and joining squares as it needs.

        Raises ValueError for another resolution, cells that are not (R, C), or a place too far out.
        """
        if patch.resolution_m != self.resolution_m:
            raise ValueError(f"cells of {patch.resolution_m} m do not fit a quadtree of {self.resolution_m} m")
        cells = np.ascontiguousarray(patch.cells, dtype=np.int8)
        if cells.ndim != 2:
            raise ValueError(f"cells are (R, C), got {cells.shape}")
        if cells.size == 0:
            return
        row0, col0 = int(patch.row0), int(patch.col0)
        self._cover(Window(row0, row0 + cells.shape[0], col0, col0 + cells.shape[1]))
        while len(self._nodes) < self.record_count + cells.size // _CELLS_A_NODE:
            self._grow()
        while True:
            self._state[kernels.FULL] = 0
            self._root = int(
                kernels.write_cells(
                    self._root, self.side, 0, 0, cells, row0 - self._row0, col0 - self._col0, self.free_below - 1,
                    self.occupied_from, self._nodes, self._spare, self._state,
                )
            )  # fmt: skip
            if not self._state[kernels.FULL]:
                return
            self._grow()

    def merge(self, other: Quadtree) -> None:
        """Join another tree's knowledge: where the two differ, occupied wins over free, and both over unknown.

        Raises ValueError for another resolution.
        """
        if other.resolution_m != self.resolution_m:
            raise ValueError(f"quadtrees of {other.resolution_m} m and {self.resolution_m} m do not merge")
        if other._root == kernels.UNKNOWN or other is self:
            return
        self._cover(other.window)
        lifted = copy.copy(other)
        lifted._nodes, lifted._spare, lifted._state = other._nodes.copy(), other._spare.copy(), other._state.copy()
        lifted._cover(self.window)
        while True:
            self._state[kernels.FULL] = 0
            self._root = int(
                kernels.join_trees(self._root, lifted._root, lifted._nodes, self._nodes, self._spare, self._state)
            )
            if not self._state[kernels.FULL]:
                return
            self._grow()

    def _cover(self, window: Window) -> None:
        """Make the root reach over a rectangle."""
        if max(abs(window.row0), abs(window.row1), abs(window.col0), abs(window.col1)) > MAX_CORNER:
            raise ValueError(f"a cell is more than {MAX_CORNER} cells from the origin")
        if self._root == kernels.UNKNOWN:
            self._levels = _LEAST_LEVELS
            self._row0 = window.row0 - (window.row0 + BASE) % self.side
            self._col0 = window.col0 - (window.col0 + BASE) % self.side
        levels = self._levels
        for low, end, corner in ((window.row0, window.row1, self._row0), (window.col0, window.col1, self._col0)):
            first, last = min(low, corner) + BASE, max(end - 1, corner + self.side - 1) + BASE
            levels = max(levels, (first ^ last).bit_length())
        if levels > MAX_LEVELS:
            raise ValueError(f"a quadtree has at most {1 << MAX_LEVELS} cells an edge")
        while self._levels < levels:
            self._double()

    def _double(self) -> None:
        """A root of twice the size, on the lattice of such roots."""
        upper, right = (self._row0 + BASE) >> self._levels & 1, (self._col0 + BASE) >> self._levels & 1
        self._row0 -= upper << self._levels
        self._col0 -= right << self._levels
        self._levels += 1
        if self._root == kernels.UNKNOWN:
            return
        node = -1
        while node < 0:
            node = int(kernels.new_node(self._nodes, self._spare, self._state, kernels.UNKNOWN))
            if node < 0:
                self._grow()
        self._nodes[node, 2 * upper + right] = self._root
        self._root = node

    def _grow(self) -> None:
        room = 2 * len(self._nodes)
        nodes, spare = np.empty((room, 4), dtype=np.int64), np.empty(room, dtype=np.int32)
        nodes[: len(self._nodes)], spare[: len(self._spare)] = self._nodes, self._spare
        self._nodes, self._spare = nodes, spare

    # ------------------------------------------------------------------ answering

    @property
    def side(self) -> int:
        """Cells along an edge of the root."""
        return 1 << self._levels

    @property
    def window(self) -> Window:
        """The cells of the root."""
        return Window(self._row0, self._row0 + self.side, self._col0, self._col0 + self.side)

    def state_at(self, points_m: ArrayLike) -> I8:
        """(N,) CellState (never PARTLY_FREE) at (N, 2) points; outside, and for points that are not finite, UNKNOWN."""
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"points are (N, 2), got {points.shape}")
        answer = np.full(len(points), UNKNOWN, dtype=np.int8)
        near = np.all(np.abs(points) < MAX_CORNER * self.resolution_m, axis=1)
        answer[near] = self.leaf_of(cells_of(points[near], self.resolution_m))[:, 3]
        return answer

    def leaf_of(self, cells: ArrayLike) -> I64:
        """(N, 4) row, column, size, CellState of the leaf with each of (N, 2) cells; size 0 outside of the root."""
        wanted = np.asarray(cells)
        if wanted.size == 0:
            return np.zeros((0, 4), dtype=np.int64)
        if wanted.ndim != 2 or wanted.shape[1] != 2 or not np.issubdtype(wanted.dtype, np.integer):
            raise ValueError(f"cells are (N, 2) whole numbers, got {wanted.dtype} {wanted.shape}")
        corner = np.array([self._row0, self._col0], dtype=np.int64)
        found = np.empty((len(wanted), 4), dtype=np.int64)
        kernels.find_leaves(self._root, self.side, wanted.astype(np.int64) - corner, self._nodes, found)
        return self._named(found)

    def count_in(self, window: Window) -> CellCount:
        """What is known in a rectangle of cells of any size: whole leaves count at once."""
        counts = np.zeros(3, dtype=np.int64)
        high, wide = max(window.row1 - window.row0, 0), max(window.col1 - window.col0, 0)
        kernels.count_cells(
            self._root, self.side, 0, 0, self._nodes, window.row0 - self._row0, window.row1 - self._row0,
            window.col0 - self._col0, window.col1 - self._col0, counts,
        )  # fmt: skip
        outside = high * wide - int(counts.sum())
        return CellCount(int(counts[0]) + outside, int(counts[1]), int(counts[2]))

    def cells_in(self, window: Window) -> I8:
        """(R, C) int8 of a rectangle, -1 unknown, 0 free, 100 occupied; ValueError if it is too large."""
        shape = (max(window.row1 - window.row0, 0), max(window.col1 - window.col0, 0))
        if shape[0] * shape[1] > MAX_WINDOW_CELLS:
            raise ValueError(f"a rectangle of more than {MAX_WINDOW_CELLS} cells: ask for less, or count_in")
        out = np.full(shape, kernels.UNKNOWN, dtype=np.int8)
        kernels.read_cells(
            self._root, self.side, 0, 0, self._nodes, window.row0 - self._row0, window.col0 - self._col0, out
        )
        return np.asarray(_PERCENT[-1 - out])

    def leaves(self) -> I64:
        """(N, 4) row, column, size, CellState of every leaf, each node's parts in order."""
        out = np.empty((self.leaf_count, 4), dtype=np.int64)
        kernels.list_leaves(self._root, self.side, 0, 0, self._nodes, 0, out)
        return self._named(out)

    def _named(self, found: I64) -> I64:
        """Rows of (row, column, size, entry), from the root's corner, as the map and CellState have them."""
        found[:, 0] += self._row0
        found[:, 1] += self._col0
        found[:, 3] = _STATES[-1 - found[:, 3]]
        return found

    # ------------------------------------------------------------------ size and bytes

    @property
    def leaf_count(self) -> int:
        """Leaves of algorithm 5.4, down to single cells. Time grows with the nodes."""
        return int(kernels.leaves_below(self._root, self._nodes))

    @property
    def division_count(self) -> int:
        """Squares that algorithm 5.4 divides."""
        return (self.leaf_count - 1) // 3

    @property
    def node_count(self) -> int:
        """Nodes of algorithm 5.4: leaves, and those divided."""
        return self.division_count + self.leaf_count

    @property
    def record_count(self) -> int:
        """Nodes in memory, 32 bytes each: divided squares of 8 x 8 cells and larger."""
        return int(self._state[kernels.TOP] - self._state[kernels.BACK])

    @property
    def entry_count(self) -> int:
        """Squares that the tree knows of by itself: those divided, those of one kind, and mixed ones of 4 x 4 cells."""
        return 4 * self.record_count + 1

    def to_bytes(self) -> bytes:
        """A byte for each square that algorithm 5.4 divides, then packed; the same tree always gives the same bytes."""
        body = np.zeros(self.division_count, dtype=np.uint8)
        kernels.write_tree(self._root, self._nodes, 0, body)
        kind = 3 if self._root >= 0 or self._root <= kernels.MIXED else -1 - self._root
        plain = body.tobytes()
        fields = (MAGIC, VERSION, self.resolution_m, self._levels, self._row0, self._col0, kind, len(body))
        crc = zlib.crc32(plain, zlib.crc32(HEADER.pack(*fields, 0)))
        return HEADER.pack(*fields, crc) + zlib.compress(plain, 6)

    @classmethod
    def from_bytes(cls, data: bytes, *, max_nodes: int = 1 << 25) -> Quadtree:
        """The quadtree that to_bytes wrote; ValueError if it is damaged, of another version or too large."""
        if len(data) < HEADER.size:
            raise ValueError("a stored quadtree is shorter than its header")
        *fields, crc = HEADER.unpack_from(data)
        magic, version, resolution_m, levels, row0, col0, kind, count = fields
        if magic != MAGIC:
            raise ValueError("this is no stored quadtree")
        if version != VERSION:
            raise ValueError(f"a stored quadtree of version {version}: this program reads {VERSION}")
        if count > max_nodes or levels > MAX_LEVELS or max(abs(row0), abs(col0)) > 2 * MAX_CORNER or kind > 3:
            raise ValueError("a stored quadtree is damaged, or larger than max_nodes")
        if (row0 + BASE) % (1 << levels) or (col0 + BASE) % (1 << levels):
            raise ValueError("a stored quadtree is damaged: its root does not lie where one can")
        try:
            plain = zlib.decompressobj().decompress(data[HEADER.size :], count + 1)
        except zlib.error as error:
            raise ValueError(f"a stored quadtree is torn: {error}") from error
        if (
            len(plain) != count
            or zlib.crc32(plain, zlib.crc32(HEADER.pack(*fields, 0))) != crc
            or (count > 0) != (kind == 3)
        ):
            raise ValueError("a stored quadtree is torn: its checksum does not fit")
        tree = cls(resolution_m=resolution_m)
        body = np.frombuffer(plain, dtype=np.uint8).copy()
        if levels < _LEAST_LEVELS:  # as written before roots had 4 x 4 cells
            tree.write(GridPatch(resolution_m, row0, col0, _cells_of_tiny(levels, kind, body)))
            return tree
        tree._begin(max(64, count))
        tree._levels, tree._row0, tree._col0, tree._root = levels, row0, col0, -1 - kind
        if kind == 3:
            place = np.zeros(1, dtype=np.int64)
            tree._root = int(kernels.read_tree(tree.side, body, place, tree._nodes, tree._state))
            if tree._root == kernels.DAMAGED or place[0] != count:
                raise ValueError("a stored quadtree is damaged: its nodes do not fit together")
        return tree


def _cells_of_tiny(levels: int, kind: int, body: NDArray[np.uint8]) -> I8:
    """The cells of a stored root of one cell, or of 2 x 2."""
    kinds = np.full((1 << levels, 1 << levels), kind)
    if kind == 3:
        kinds = (int(body[0]) >> np.arange(0, 8, 2) & 3).reshape(2, 2)
        if levels == 0 or len(body) > 1 or np.any(kinds == 3):
            raise ValueError("a stored quadtree is damaged: its nodes do not fit together")
    return np.asarray(_PERCENT[kinds])
