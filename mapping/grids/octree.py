"""The 3D grid: an octree of voxels with log-odds, fed by rays (S32, after algorithm 5.4 with eight parts for four).

Voxel (i, j, k) is the half-open cube [i d, (i + 1) d) along x, y, z alike (borders to within 1e-11 of an edge). A
point is a hit in its voxel; the ray to it is a miss in every voxel that it passes before. A voxel counts once in an
insertion, and a hit there before a miss. What no ray passed is unknown, and unknown is never free.

The tree ends in bricks of 8 x 8 x 8 voxels, a byte each, and a region of one value, of whatever size, is one entry:
see mapping.kernels.octree. Deeper nodes would cost more than they save where rooms are full of surfaces.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.grids.evidence import FREE, OCCUPIED, PARTLY_FREE, UNKNOWN
from mapping.grids.geometry import check_resolution
from mapping.kernels import octree as kernels
from mapping.kernels import octree_ends as ends
from mapping.kernels import octree_marks as marking
from mapping.kernels import octree_rays as rays

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
I8 = NDArray[np.int8]
U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
T = TypeVar("T", bound=np.generic)

STEP: Final = 0.05  # log-odds of one step of a voxel
HALF: Final = kernels.SIDE // 2  # voxels from the origin to the side of the cube: 1.6 km at 5 cm
MAX_BOX_VOXELS: Final = 1 << 28

# Bytes: magic, version, resolution, bytes of the tree, bricks, CRC-32 of all that and of both; then zlib of the
# tree and the bricks.
HEADER: Final = struct.Struct("<4sBdIII")
MAGIC: Final = b"UOCT"
VERSION: Final = 1

_STATES: Final = np.array([UNKNOWN, FREE, PARTLY_FREE, OCCUPIED], dtype=np.int8)


@dataclass(frozen=True, slots=True)
class VoxelRules:
    """How evidence adds up in a voxel: log-odds, kept in steps of 0.05.

    free_below, occupied_from: a voxel with a smaller probability is FREE, from the other on OCCUPIED, else
    PARTLY_FREE.
    """

    hit_log_odds: float = 0.85
    miss_log_odds: float = 0.4
    lowest_log_odds: float = -2.0
    highest_log_odds: float = 3.5
    free_below: float = 0.45
    occupied_from: float = 0.65

    def __post_init__(self) -> None:
        if not (-6.0 <= self.lowest_log_odds <= -STEP and STEP <= self.highest_log_odds <= 6.0):
            raise ValueError("lowest_log_odds is -6 to -0.05, highest_log_odds 0.05 to 6")
        if not (STEP <= self.hit_log_odds <= 6.0 and STEP <= self.miss_log_odds <= 6.0):
            raise ValueError("hit_log_odds and miss_log_odds are 0.05 to 6")
        if not 0.0 < self.free_below <= self.occupied_from < 1.0:
            raise ValueError("0 < free_below <= occupied_from < 1")


@dataclass(frozen=True, slots=True)
class BoxCount:
    """Voxels of a box by what is known about them."""

    unknown: int
    free: int
    partly_free: int
    occupied: int


_LEAST: Final = 5  # rays that end in one voxel: fewer are walked one by one
_MANY: Final = 64  # fewer are quickly asked for their slopes


class _Marks:
    """What an insertion under way says of the voxels of the bricks it touches."""

    def __init__(self, room: int) -> None:
        self.touched: I64 = np.zeros(room, dtype=np.int64)
        self.left: I32 = np.zeros(room, dtype=np.int32)
        self.marks: U64 = np.zeros(room * marking.WORDS, dtype=np.uint64)
        self.shortcuts: I64 = np.full((marking.SHORTCUTS, 2), -1, dtype=np.int64)

    def grow(self, room: int) -> None:
        self.touched, self.left = _longer(self.touched, room), _longer(self.left, room)
        self.marks = _longer(self.marks, room * marking.WORDS)

    def arrays(self) -> tuple[I64, I32, U64, I64]:
        return self.touched, self.left, self.marks, self.shortcuts


class Octree:
    """Voxels of resolution_m in a cube of 65,536 voxels an edge around the origin. Not for two threads at once.

    max_bricks: bound of its memory, about 0.6 KB each; a furnished room at 5 cm takes 2,000. When it is reached, bricks
    that are there learn on. A ray whose end finds no room leaves nothing behind, another ends before the first brick
    that finds none, so what lies beyond stays unknown; refused_rays counts both.
    """

    def __init__(
        self, *, resolution_m: float = 0.05, rules: VoxelRules | None = None, max_bricks: int = 1 << 17
    ) -> None:
        if not 1 <= max_bricks <= 1 << 22:
            raise ValueError(f"max_bricks is 1 to {1 << 22}, got {max_bricks}")
        self.resolution_m = check_resolution(resolution_m)
        self.rules = rules if rules is not None else VoxelRules()
        self.max_bricks = max_bricks
        self.refused_rays = 0
        self.rejected_points = 0
        self._hit, self._miss = round(self.rules.hit_log_odds / STEP), round(self.rules.miss_log_odds / STEP)
        self._lowest = round(self.rules.lowest_log_odds / STEP)
        self._highest = round(self.rules.highest_log_odds / STEP)
        self._free_most = math.ceil(_log_odds(self.rules.free_below) / STEP - 1e-9) - 1
        self._occupied_least = math.ceil(_log_odds(self.rules.occupied_from) / STEP - 1e-9)
        self._path: I64 = np.zeros(kernels.PATH_LENGTH, dtype=np.int64)
        self._touched_before = 64
        self._begin(min(64, max_bricks))

    def _begin(self, room: int, nodes: int = 0) -> None:
        """An empty tree with room for that many bricks."""
        self._nodes: I32 = np.zeros((max(2 * room + 64 * kernels.LEVELS, nodes), 8), dtype=np.int32)
        self._free_nodes: I32 = np.zeros(len(self._nodes), dtype=np.int32)
        self._bricks: I8 = np.zeros((room + 1) * kernels.BRICK_VOXELS, dtype=np.int8)
        self._brick_at: I32 = np.zeros((room + 1, 3), dtype=np.int32)
        self._mark_of: I32 = np.zeros(room + 1, dtype=np.int32)
        self._free_bricks: I32 = np.zeros(room + 1, dtype=np.int32)
        self._state: I64 = np.zeros(kernels.STATE_LENGTH, dtype=np.int64)
        self._state[kernels.NODE_TOP] = self._state[kernels.BRICK_TOP] = 1

    # ------------------------------------------------------------------ taking in

    def insert(
        self,
        origin_m: ArrayLike,
        points_m: ArrayLike,
        *,
        range_max_m: float = math.inf,
        is_hit: ArrayLike | None = None,
    ) -> None:
        """One cloud: rays from the sensor to its points.

        origin_m: (3,) place of the sensor, or (N, 3) one for each point.  points_m: (N, 3), map frame.
        range_max_m: a longer ray is free up to there and has no hit.  is_hit: (N,) false where nothing was met and
        the point only says how far it is free.
        Points that are not finite, and rays that leave the cube, say nothing and are counted in rejected_points.
        Raises ValueError for other shapes, an origin (3,) that is not finite or in the cube, or a range_max_m that is
        not above 0.
        """
        points = _points(points_m)
        origin = np.asarray(origin_m, dtype=np.float64)
        if origin.shape not in ((3,), points.shape):
            raise ValueError(f"origins are (3,) or as many as points, got {origin.shape}")
        if not range_max_m > 0.0:
            raise ValueError(f"range_max_m is above 0, got {range_max_m}")
        if origin.shape == (3,) and not _is_inside(self._places(origin[None, :]))[0]:
            raise ValueError(f"the sensor is finite and in the octree's cube, got {origin.tolist()}")
        hit = np.ones(1, dtype=np.bool_)
        if is_hit is not None:
            hit = np.array(is_hit, dtype=np.bool_)
            if hit.shape != (len(points),):
                raise ValueError(f"is_hit is (N,) with N = {len(points)} points, got {hit.shape}")
        if len(points):
            origin = np.ascontiguousarray(np.atleast_2d(origin))
            self._insert_rays(origin, np.ascontiguousarray(points), float(range_max_m), hit)

    def _insert_rays(self, origin: F64, points: F64, range_max_m: float, hit: NDArray[np.bool_]) -> None:
        n = len(points)
        marks, refused = _Marks(self._touched_before), np.zeros(n, dtype=np.uint8)
        names, starts = np.empty(n, dtype=np.int64), np.empty(n + 1, dtype=np.int32)
        runs = ends.name_ends(origin, points, self.resolution_m, range_max_m, hit, names, starts)
        before, groups = np.empty(runs, dtype=np.int32), np.empty((runs, ends.GROUP), dtype=np.int64)
        table = np.full(1 << (2 * runs - 1).bit_length(), -1, dtype=np.int32)
        count = np.zeros(ends.COUNT_LENGTH, dtype=np.int64)
        some, slope = np.empty(n, dtype=np.int32), np.empty((n, 2))
        keep = self._lowest - kernels.UNIFORM
        many = _MANY if 4 * runs < 3 * n else 0  # where neighbours end apart, a group's rays lie apart in memory

        done, full = 0, False
        while done < runs:
            done = ends.mark_ends(
                done, full, runs, names, starts, before, groups, table, count, *self._tree(), *marks.arrays(),
                self._path, refused,
            )  # fmt: skip
            full = done < runs and not self._grow(marks)
        for first_only in (True, False):
            done, full = 0, False
            while done < count[ends.GROUPS]:
                done = rays.mark_ways(
                    done, full, first_only, _LEAST, many, origin, points, self.resolution_m, range_max_m, keep, starts,
                    before, groups, count, some, slope, *self._tree(), *marks.arrays(), self._path, refused,
                )  # fmt: skip
                full = done < count[ends.GROUPS] and not self._grow(marks)
        self.rejected_points += int(count[ends.SAID_NOTHING])
        self.refused_rays += int(np.count_nonzero(refused))
        self._touched_before = max(64, int(1.25 * self._state[kernels.TOUCHED]))
        marking.settle(
            self._hit, self._miss, self._lowest, self._highest, *self._tree(), marks.touched, marks.marks, self._path
        )

    def _tree(self) -> tuple[I32, I8, I32, I32, I32, I32, I64]:
        return (
            self._nodes, self._bricks, self._brick_at, self._mark_of, self._free_nodes, self._free_bricks, self._state
        )  # fmt: skip

    def _grow(self, marks: _Marks) -> bool:
        """More room for the insertion under way; False if the bound is reached."""
        room, touched = len(self._mark_of) - 1, len(marks.touched)
        if touched <= self.max_bricks:
            marks.grow(2 * touched)
        if room < self.max_bricks:
            self._make_room(2 * room)
        return touched <= self.max_bricks or room < self.max_bricks

    def _make_room(self, room: int, nodes: int = 0) -> None:
        room = min(room, self.max_bricks)
        nodes = max(2 * room + 64 * kernels.LEVELS, nodes)
        self._nodes = _longer(self._nodes, nodes)
        self._free_nodes = _longer(self._free_nodes, nodes)
        self._bricks = _longer(self._bricks, (room + 1) * kernels.BRICK_VOXELS)
        self._brick_at = _longer(self._brick_at, room + 1)
        self._mark_of = _longer(self._mark_of, room + 1)
        self._free_bricks = _longer(self._free_bricks, room + 1)

    def merge(self, other: Octree) -> None:
        """Add another tree's evidence to this one's; the other stays as it is.

        Raises ValueError, and changes nothing, if its resolution differs or max_bricks is too small for both.
        """
        if other.resolution_m != self.resolution_m:
            raise ValueError(f"octrees of {other.resolution_m} m and {self.resolution_m} m do not merge")
        if other is self:
            raise ValueError("an octree does not merge with itself")
        bricks = int(self._state[kernels.BRICK_TOP] + other._state[kernels.BRICK_TOP])
        if bricks > self.max_bricks:
            raise ValueError(f"the two may take {bricks} bricks: raise max_bricks ({self.max_bricks})")
        nodes = int(self._state[kernels.NODE_TOP] + other._state[kernels.NODE_TOP])
        self._make_room(max(bricks, len(self._mark_of) - 1), max(nodes, len(self._nodes)))
        kernels.add_tree(self._lowest, self._highest, other._nodes, other._bricks, *self._tree())
        self.prune()

    def prune(self) -> None:
        """Join what has one value. Insertions and merges leave nothing to prune; so does from_bytes."""
        kernels.prune(self._nodes, self._bricks, self._free_nodes, self._free_bricks, self._state)

    # ------------------------------------------------------------------ answering

    def log_odds_at(self, points_m: ArrayLike) -> F64:
        """(N,) log-odds of being occupied at (N, 3) points, NaN where unknown, outside, or the point is not finite."""
        value = self._values(points_m)
        return np.where(value == kernels.UNKNOWN, np.nan, value * STEP)

    def state_at(self, points_m: ArrayLike) -> I8:
        """(N,) CellState at (N, 3) points."""
        return self._state_of(self._values(points_m))

    def _values(self, points_m: ArrayLike) -> I8:
        places = np.ascontiguousarray(self._places(_points(points_m)))
        value = np.empty(len(places), dtype=np.int8)
        kernels.values_at(places, self._nodes, self._bricks, self._path, value)
        return value

    def _state_of(self, value: I8) -> I8:
        state = np.full(value.shape, PARTLY_FREE, dtype=np.int8)
        state[value <= self._free_most] = FREE
        state[value >= self._occupied_least] = OCCUPIED
        state[value == kernels.UNKNOWN] = UNKNOWN
        return state

    def states_in(self, low: tuple[int, int, int], high: tuple[int, int, int]) -> I8:
        """(NZ, NY, NX) CellState of the voxels low (x, y, z) up to, without, high; ValueError if they are too many."""
        first, end = self._box(low, high)
        sides = np.maximum(end - first, 0)
        if math.prod(int(side) for side in sides) > MAX_BOX_VOXELS:
            raise ValueError(f"a box of more than {MAX_BOX_VOXELS} voxels: ask for less, or count_in")
        value = np.empty(tuple(sides[::-1]), dtype=np.int8)
        kernels.read_box(first, self._nodes, self._bricks, self._path, value)
        return self._state_of(value)

    def count_in(self, low: tuple[int, int, int], high: tuple[int, int, int]) -> BoxCount:
        """What is known in a box of voxels of any size: whole regions of one value count at once."""
        first, end = self._box(low, high)
        counts = np.zeros(4, dtype=np.int64)
        kernels.count_box(first, end, self._free_most, self._occupied_least, self._nodes, self._bricks, counts)
        return BoxCount(*(int(count) for count in counts))

    def _box(self, low: tuple[int, int, int], high: tuple[int, int, int]) -> tuple[I64, I64]:
        corners = np.array([low, high])
        if corners.shape != (2, 3) or not np.issubdtype(corners.dtype, np.integer):
            raise ValueError(f"a box is two voxels (x, y, z), got {low} and {high}")
        if np.any(np.abs(corners) > HALF):
            raise ValueError(f"a box lies within {HALF} voxels of the origin, got {low} to {high}")
        corners = corners.astype(np.int64) + HALF
        return corners[0], corners[1]

    def cast(self, origin_m: ArrayLike, direction: ArrayLike, *, range_max_m: float) -> tuple[F64, I8]:
        """How far it is free along rays.

        origin_m: (N, 3).  direction: (N, 3), of any length above 0.
        Returns (N,) metres to the first voxel that is not FREE, range_max_m if there is none, and (N,) the CellState
        of that voxel, FREE if there is none. A ray from outside, or that leaves the cube, ends in UNKNOWN there.
        Raises ValueError for other shapes, or numbers that are not finite.
        """
        origin, way = self._places(_points(origin_m)), _points(direction)
        if way.shape != origin.shape or not (0.0 < range_max_m < math.inf):
            raise ValueError("as many directions as origins, and a range_max_m above 0")
        norm = np.linalg.norm(way, axis=1)
        if not (np.all(np.isfinite(origin)) and np.all(np.isfinite(norm)) and np.all(norm > 0.0)):
            raise ValueError("origins and directions are finite, directions not 0")
        way = way / norm[:, None]
        longest = np.full(len(way), range_max_m / self.resolution_m)
        length, kind = np.zeros(len(way)), np.zeros(len(way), dtype=np.int64)
        inside = _is_inside(origin)
        found_length, found_kind = np.zeros(int(inside.sum())), np.zeros(int(inside.sum()), dtype=np.int64)
        kernels.cast_rays(
            np.ascontiguousarray(origin[inside]), np.ascontiguousarray(way[inside]), longest[inside], self._free_most,
            self._occupied_least, self._nodes, self._bricks, self._path, found_length, found_kind,
        )  # fmt: skip
        length[inside], kind[inside] = found_length, found_kind
        return np.minimum(length * self.resolution_m, range_max_m), _STATES[kind]

    def occupied_voxels(self) -> I32:
        """(N, 3) voxels (x, y, z) that are OCCUPIED, in the order of z, y, x within bricks, bricks as in the tree."""
        slots = self._slots()
        cubes = self._bricks.reshape(-1, 8, 8, 8)
        which, z, y, x = np.nonzero(cubes[slots] >= self._occupied_least)
        found = [(self._brick_at[slots][which].astype(np.int64) << 3) + np.stack((x, y, z), axis=-1)]
        for low, side, value in self._uniform_regions():
            if value >= self._occupied_least:
                steps = np.arange(side)
                grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
                found.append(low + grid[:, ::-1])
        return (np.concatenate(found) - HALF).astype(np.int32)

    def _slots(self) -> I64:
        """Bricks in use, in the order of their place (z, y, x)."""
        level0 = self._reached()[0]
        entries = self._nodes[level0].ravel()
        slots = entries[entries > 0].astype(np.int64)
        at = self._brick_at[slots]
        return slots[np.lexsort((at[:, 0], at[:, 1], at[:, 2]))]

    def _reached(self) -> list[I64]:
        """Nodes of each level, from the level above the bricks (0) up to the root."""
        levels = [np.zeros(1, dtype=np.int64)]
        for _ in range(kernels.LEVELS - 1):
            entries = self._nodes[levels[-1]].ravel()
            levels.append(entries[entries > 0].astype(np.int64))
        return levels[::-1]

    def _uniform_regions(self) -> list[tuple[I64, int, int]]:
        """(lowest voxel, side in voxels, value) of every region that is one entry."""
        regions = []
        stack = [(0, kernels.LEVELS - 1, 0, 0, 0)]
        while stack:
            node, level, x, y, z = stack.pop()
            for k in range(8):
                entry = int(self._nodes[node, k])
                at = (2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2))
                if entry < 0:
                    side = kernels.BRICK << level
                    regions.append((np.array(at, dtype=np.int64) * side, side, entry + kernels.UNIFORM))
                elif entry > 0 and level > 0:
                    stack.append((entry, level - 1, *at))
        return regions

    # ------------------------------------------------------------------ size

    @property
    def bricks(self) -> int:
        """Bricks in use."""
        return int(self._state[kernels.BRICK_TOP] - 1 - self._state[kernels.BRICKS_BACK])

    @property
    def memory_bytes(self) -> int:
        """What nodes and bricks in use take, with what finds them."""
        nodes = int(self._state[kernels.NODE_TOP] - self._state[kernels.NODES_BACK])
        return nodes * (32 + 4) + self.bricks * (kernels.BRICK_VOXELS + 12 + 4 + 4)

    def leaf_count(self) -> int:
        """Leaves of a tree divided down to single voxels wherever values differ: what other octrees count."""
        level0 = self._reached()
        uniform = sum(int(np.count_nonzero(self._nodes[nodes] < 0)) for nodes in level0)
        work = np.zeros(64, dtype=np.int64)
        return uniform + sum(
            int(kernels.leaves_of_brick(self._bricks, int(slot), work)) for slot in self._slots()
        )  # fmt: skip

    def to_bytes(self) -> bytes:
        """Everything, compact; equal contents give equal bytes, however they came to be."""
        nodes, bricks = int(self._state[kernels.NODE_TOP]), self.bricks
        tree = np.zeros(10 * nodes, dtype=np.uint8)
        body = np.zeros((bricks, kernels.BRICK_VOXELS), dtype=np.int8)
        size, count = kernels.write_tree(self._nodes, self._bricks, tree, body)
        plain = tree[:size].tobytes() + body[:count].tobytes()
        fields = (MAGIC, VERSION, self.resolution_m, size, count)
        crc = zlib.crc32(plain, zlib.crc32(HEADER.pack(*fields, 0)))
        return HEADER.pack(*fields, crc) + zlib.compress(plain, 6)

    @classmethod
    def from_bytes(cls, data: bytes, *, rules: VoxelRules | None = None, max_bricks: int = 1 << 17) -> Octree:
        """The octree that to_bytes wrote; ValueError if it is damaged, of another version or larger than max_bricks."""
        if len(data) < HEADER.size:
            raise ValueError("a stored octree is shorter than its header")
        *fields, crc = HEADER.unpack_from(data)
        magic, version, resolution_m, size, count = fields
        if magic != MAGIC:
            raise ValueError("this is no stored octree")
        if version != VERSION:
            raise ValueError(f"a stored octree of version {version}: this program reads {VERSION}")
        if count > max_bricks or size > 20 * (kernels.LEVELS * max_bricks + 8):
            raise ValueError(f"a stored octree of {count} bricks: raise max_bricks ({max_bricks})")
        length = size + count * kernels.BRICK_VOXELS
        try:
            plain = zlib.decompressobj().decompress(data[HEADER.size :], length + 1)
        except zlib.error as error:
            raise ValueError(f"a stored octree is torn: {error}") from error
        if len(plain) != length or zlib.crc32(plain, zlib.crc32(HEADER.pack(*fields, 0))) != crc:
            raise ValueError("a stored octree is torn: its checksum does not fit")
        octree = cls(resolution_m=resolution_m, rules=rules, max_bricks=max_bricks)
        octree._begin(max(1, count), size // 2 + 8 * kernels.LEVELS + 8)
        tree = np.frombuffer(plain, dtype=np.uint8, count=size)
        body = np.frombuffer(plain, dtype=np.int8, offset=size).reshape(count, kernels.BRICK_VOXELS)
        if not kernels.read_tree(tree.copy(), body.copy(), *octree._tree()):
            raise ValueError("a stored octree is damaged: its nodes do not fit together")
        octree.prune()
        return octree

    def _places(self, points_m: F64) -> F64:
        """(N, 3) in voxels, from the corner of the cube."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(points_m / self.resolution_m + float(HALF))


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


def _is_inside(places: F64) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = np.all((places >= 0.0) & (places < kernels.SIDE), axis=1)  # false for NaN
    return inside


def _points(points_m: ArrayLike) -> F64:
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points are (N, 3), got {points.shape}")
    return points


def _longer(array: NDArray[T], length: int) -> NDArray[T]:
    """The array with zeros after it."""
    if length <= len(array):
        return array
    longer = np.zeros((length, *array.shape[1:]), dtype=array.dtype)
    longer[: len(array)] = array
    return longer
