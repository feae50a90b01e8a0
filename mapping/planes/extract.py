"""Planes of a point cloud (S12, S13): algorithm 5.2, and a refined form of it.

    planes = extract_planes(points_m)                        # (N, 3), the sensor at the origin
    planes.normal, planes.distance_m                         # <n, x> = d, d >= 0
    planes.label                                             # (N,) plane of each point, -1 none
    book = extract_planes(points_m, PlaneRules.book())

The book: (1, 2) points are sorted in cubic cells; (3) in each cell RANSAC finds a plane, PCA fits it to the inliers;
(4) cells whose planes continue each other grow into regions; (5) regions of enough cells stay; (6) PCA fits each.

The refined form, which is the default, goes the same way, and
- takes the noise of ranges from the cloud, unless it is told: the book's 50 mm is the most that an inlier may be off,
  a multiple of the noise the usual; points weigh by it in every PCA;
- lets cells be larger where points are few, and cuts those that hold more than one plane into eight;
- holds a cell that would join against the plane of the whole region, so that regions cannot bend around a curve;
- joins regions that touch and lie in one plane, or make up one that is flat against its size;
- gives each point to the nearest plane of its own and the touching cells, where the book leaves out all points of a
  cell but those of its one plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import planes as kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FARTHEST_M: Final = 1e4  # a point beyond is no measurement
_ROUNDS: Final = 2  # of giving points to planes and fitting these
_CHUNKS: Final = 2  # of the work, for two cores; their number changes nothing
_NOISE_SAMPLES: Final = 500
_NOISE_CELL: Final = 16.0  # a cell is so many times as large as the noise, or its scatter says more of its size
_NOISE_MOST: Final = 32  # points of a cell from which noise is taken
_NOISE_LEAST: Final = 9
_NOISE_SHARE: Final = 0.4  # of cells scatter less than the noise that is taken: some hold an edge
_STEP_SAMPLES: Final = 6_000
_SAME_M: Final = 1e-6  # depths closer than this are one
_FEWEST_STEPS: Final = 50
_STEPS_SHARE: Final = 0.1  # of the sample: more different values are no steps
_STEP_GROWTH: Final = 1.2
_STEP_PART: Final = 5


class Runner(Protocol):
    """How parts of the work are done: the built-in map, or that of a pool of threads (kernels release the GIL)."""

    def __call__(self, work: Callable[[int], Any], parts: Iterable[int], /) -> Iterable[Any]: ...


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """Standard deviation of a range r: sigma_m + sigma_per_m2 * r^2. Lasers have the first, depth cameras the second.

    step_per_m2: depth comes in steps of step_per_m2 * r^2, as from whole parts of a pixel of disparity; cells stay
    some steps large, since in a smaller one a slanted wall looks like a piece of one step, flat and facing the camera.
    """

    sigma_m: float
    sigma_per_m2: float = 0.0
    step_per_m2: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma_m) and self.sigma_m > 0.0):
            raise ValueError(f"sigma_m must be above 0: weights are 1/sigma^2; got {self.sigma_m}")
        for name in ("sigma_per_m2", "step_per_m2"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be >= 0, got {value}")

    def at(self, range_m: ArrayLike) -> F64:
        """Standard deviations at ranges of any shape."""
        return np.asarray(self.sigma_m + self.sigma_per_m2 * np.square(np.asarray(range_m, dtype=np.float64)))


@dataclass(frozen=True, slots=True)
class PlaneRules:
    """What makes a plane. Defaults are those of table 5.13.

    cell_m: edge of a cubic cell.  min_points: of a cell, to look for a plane in it.  iterations: of RANSAC, at most.
    inlier_m: farthest that an inlier is off.  angle_rad: between the normals of neighbouring cells.  apart_m: from
    the plane of a cell to the centre of gravity of its neighbour.  min_cells: that support a plane.
    seed: of RANSAC; the same seed and points give the same planes, bit for bit.
    refined: False is the book's algorithm; what follows is of the refined form alone.
    noise: of ranges; None takes it from the cloud.  inlier_sigmas, flat_m: an inlier is off by at most
    inlier_sigmas * sigma + flat_m, and inlier_m; flat_m is how flat planes are taken to be.  warp: by how much more a
    far part of a plane may be off, as a share of its distance (0.01: 1 cm a metre): ranges are biased, floors sag.
    coarser, finer: how many times cells may double, and halve.  one_plane: a cell of whose points a smaller share lies
    in its plane is cut.  min_support: points of a plane; None: min_cells * min_points.
    """

    cell_m: float = 0.2
    min_points: int = 10
    iterations: int = 50
    inlier_m: float = 0.05
    angle_rad: float = math.radians(15.0)
    apart_m: float = 0.05
    min_cells: int = 10
    seed: int = 1
    refined: bool = True
    noise: RangeNoise | None = None
    inlier_sigmas: float = 3.0
    flat_m: float = 0.003
    warp: float = 0.01
    coarser: int = 2
    finer: int = 3
    one_plane: float = 0.8
    min_support: int | None = None

    def __post_init__(self) -> None:
        for name in ("cell_m", "inlier_m", "apart_m"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be above 0, got {value}")
        for name in ("inlier_sigmas", "flat_m", "warp", "one_plane"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be >= 0, got {value}")
        if not 0.0 <= self.angle_rad <= math.pi / 2.0:
            raise ValueError(f"angle_rad lies between 0 and a right angle, got {self.angle_rad}")
        if self.min_points < 3 or self.iterations < 1 or self.min_cells < 1 or not 0 <= self.seed < 2**31:
            raise ValueError("min_points must be at least 3, iterations and min_cells at least 1, seed from 0 to 2^31")
        if not (0 <= self.coarser <= 8 and 0 <= self.finer <= 8):
            raise ValueError("coarser and finer lie between 0 and 8")

    @staticmethod
    def book(**changes: Any) -> PlaneRules:
        """Algorithm 5.2 as the book has it: cells of one size, weights 1, labels by the cell's own plane."""
        return replace(PlaneRules(refined=False, coarser=0, finer=0, noise=RangeNoise(1.0)), **changes)

    def vector(self, noise: RangeNoise) -> F64:
        """As kernels take it, in the order of their column names."""
        return np.array(
            [
                self.min_points, self.iterations, self.inlier_m, self.inlier_sigmas, math.cos(self.angle_rad),
                self.apart_m, self.one_plane if self.refined else 0.0, float(self.refined), self.seed,
                noise.sigma_m, noise.sigma_per_m2, self.flat_m, self.warp,
                noise.step_per_m2, self.cell_m,
            ],
            dtype=np.float64,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Planes:
    """Planes of a cloud, those of most points first.

    normal (P, 3), distance_m (P,): <n, x> = d, d >= 0, so normals point away from the sensor.  centre_m (P, 3): centre
    of gravity.  covariance (P, 3, 3): of the points about it, weighted (5.23).  count (P,): points.  cells (P,):
    supporting cells.  rms_m (P,): of the points' distances.  polygon: P arrays (K, 3), the convex outline of the points
    in the plane, counter-clockwise seen from the sensor.  label (N,): plane of each point given, -1 none.
    noise: of ranges, as taken.
    """

    normal: F64
    distance_m: F64
    centre_m: F64
    covariance: F64
    count: I64
    cells: I64
    rms_m: F64
    polygon: tuple[F64, ...]
    label: I64
    noise: RangeNoise

    def __len__(self) -> int:
        return len(self.distance_m)


def range_limit_m(cell_m: float, beam_spacing_rad: float) -> float:
    """How far a plane can be seen with cells of this size: d_max = e / tan(alpha), e = cell_m / 2, 3 x 3 beams a cell.

    0.2 m and 0.5 degrees give 11.46 m.  Raises ValueError for a size or an angle that is not above 0 (or 90 degrees).
    Source: S13.
    """
    if not (math.isfinite(cell_m) and cell_m > 0.0):
        raise ValueError(f"cell_m must be above 0, got {cell_m}")
    if not 0.0 < beam_spacing_rad < math.pi / 2.0:
        raise ValueError(f"beam_spacing_rad lies between 0 and a right angle, got {beam_spacing_rad}")
    return 0.5 * cell_m / math.tan(beam_spacing_rad)


def range_warning(rules: PlaneRules, beam_spacing_rad: float, range_m: float) -> str | None:
    """A sentence if planes at range_m cannot be found with these rules, else None (S13).

    The refined form's largest cell counts; where a cell needs more than 3 x 3 points, so does the limit.
    """
    cell_m = rules.cell_m * 2**rules.coarser if rules.refined else rules.cell_m
    across = max(3.0, math.sqrt(rules.min_points)) - 1.0
    limit = range_limit_m(2.0 * cell_m / across, beam_spacing_rad)
    if range_m <= limit:
        return None
    return (
        f"cells of {cell_m:g} m hold too few beams {math.degrees(beam_spacing_rad):g} degrees apart beyond "
        f"{limit:.1f} m, and ranges reach {range_m:g} m: planes there are not found; use larger cells or finer beams"
    )


def extract_planes(
    points_m: ArrayLike, rules: PlaneRules | None = None, *, sensor_m: ArrayLike = (0.0, 0.0, 0.0), run: Runner = map
) -> Planes:
    """Planes of a cloud.

    points_m: (N, 3); rows with NaN, infinities or more than FARTHEST_M from the sensor are no points.  sensor_m: where
    ranges were measured from, in the points' frame.  run: does the parts of the work, in any order (see `Runner`).
    Returns no planes if there are too few points.  Raises ValueError for another shape.  About n log n.
    Source: S12, algorithm 5.2, equations 5.22 and 5.23; the module says what is added.
    """
    given = np.asarray(points_m, dtype=np.float64)
    sensor = np.asarray(sensor_m, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ValueError(f"points_m is (N, 3), got {given.shape}")
    if sensor.shape != (3,) or not np.all(np.isfinite(sensor)):
        raise ValueError("sensor_m is (3,) and finite")
    chosen = rules or PlaneRules()
    moved = np.ascontiguousarray(given - sensor if np.any(sensor) else given)
    box = np.empty((2, 3))
    usable = np.flatnonzero(kernels.usable(moved, FARTHEST_M, box[0], box[1]))
    label = np.full(len(given), -1, dtype=np.int64)
    if len(usable) < chosen.min_points:
        return _none(label, chosen.noise or RangeNoise(1.0))
    cloud = moved if len(usable) == len(moved) else moved[usable]
    return _Extraction(cloud, box, chosen, run).planes(usable, label, sensor)


class _Extraction:
    """One cloud on its way; attributes are what the steps hand on."""

    def __init__(self, points: F64, box: F64, rules: PlaneRules, run: Runner) -> None:
        self.rules, self.run = rules, run
        self._sort(points, box)
        self.vector = rules.vector(self.noise)
        kernels.weigh(self.x, self.y, self.z, self.vector, self.weight)

    def planes(self, usable: I64, label: I64, sensor: F64) -> Planes:
        """Steps 3 to 6."""
        self._fit_cells()
        first, neighbour = self._neighbours()
        region = np.empty(len(self.begin), dtype=np.int64)
        sums = np.zeros((len(region), kernels.ROW))
        fitted = np.flatnonzero(self.row[:, kernels.COUNT] > 0.0)
        seeds = fitted[np.argsort(self.row[fitted, kernels.DOUBT], kind="stable")]  # the surest first
        count = kernels.grow(self.row, seeds, first, neighbour, False, self.vector, region, sums)
        sums = sums[:count]
        if self.rules.refined:
            count = kernels.join_regions(region, first, neighbour, sums, count, self.vector)
            wide, wide_sums = np.empty_like(region), np.zeros_like(self.row)
            wides = kernels.grow(self.row, seeds, first, neighbour, True, self.vector, wide, wide_sums)
            count = kernels.gather_flat(region, count, self.row, wide, wide_sums[:wides], self.vector, sums)
            sums = sums[:count]
            found, sums = self._label_refined(region, first, neighbour, sums)
        else:
            found, sums = self._label_by_book(region, sums)
        return self._result(found, sums, region, usable, label, sensor)

    def _sort(self, points: F64, box: F64) -> None:
        """Steps 1 and 2; the lattice stands still in the frame, whatever points there are. box (2, 3): their bounds."""
        rules = self.rules
        low, high = box
        finest = rules.cell_m / 2**rules.finer
        self.deepest = rules.coarser + rules.finer
        while float((high - low).max()) / finest >= 2 ** (kernels.BITS - 1) - 2**self.deepest:
            finest *= 2.0  # so far apart that the finest cells have no number: leave them out
            self.deepest -= 1
            if self.deepest < 0:
                raise ValueError(
                    f"cells of {rules.cell_m} m are too small for a cloud of {float((high - low).max())} m"
                )
        self.book_depth = min(rules.coarser, self.deepest)
        largest = finest * 2**self.deepest
        corner = np.floor(low / largest) * largest
        key = np.empty(len(points), dtype=np.int64)
        cut = np.linspace(0, len(points), _CHUNKS + 1).astype(np.int64)
        list(self.run(lambda k: kernels.morton_keys(points, corner, finest, cut[k], cut[k + 1], key), range(_CHUNKS)))
        self.order, self.key = kernels.sort_by_key(key)
        self.x, self.y, self.z, self.weight = np.empty((4, len(points)))
        columns = (self.x, self.y, self.z)
        list(self.run(lambda k: kernels.gather(points, self.order, cut[k], cut[k + 1], *columns), range(_CHUNKS)))
        self.noise = rules.noise or self._noise()

    def _noise(self) -> RangeNoise:
        """From the scatter in small cells, the smallest that are large against the noise they tell."""
        range_m, sigma = np.empty(2 * _NOISE_SAMPLES), np.empty(2 * _NOISE_SAMPLES)
        size = self.rules.cell_m / 2 ** (self.deepest - self.book_depth)
        self.weight[:] = 1.0
        for smallest in range(self.deepest, -1, -1):
            found = kernels.local_noise(
                self.x, self.y, self.z, self.weight, self.key, self.deepest, smallest, _NOISE_MOST, _NOISE_LEAST,
                _NOISE_SAMPLES, range_m, sigma,
            )  # fmt: skip
            if found and _usual(sigma[:found]) * _NOISE_CELL <= size:
                break
            size *= 2.0
        noise = noise_of_scatter(range_m[:found], sigma[:found], most_m=self.rules.inlier_m / 2.0)
        step = depth_step_per_m2(self.x, self.y, self.z)
        if step == 0.0:
            return noise
        return RangeNoise(noise.sigma_m, max(noise.sigma_per_m2, step / math.sqrt(12.0)), step)

    def _fit_cells(self) -> None:
        """Step 3, in chunks of about as many points."""
        start = kernels.runs_of(self.key, 3 * self.deepest)
        share = np.linspace(0, len(self.key), _CHUNKS + 1)
        cut = np.unique(np.searchsorted(start, share))
        cut[-1] = len(start) - 1

        def work(part: int) -> tuple[F64, I64, I64, I64]:
            first, last = int(cut[part]), int(cut[part + 1])
            room = int(start[last] - start[first])  # no more cells than points
            row = np.empty((room, kernels.ROW))
            begin, end, level = (np.empty(room, dtype=np.int64) for _ in range(3))
            count = kernels.fit_cells(
                self.x, self.y, self.z, self.weight, self.key, start, first, last, 0, self.book_depth, self.deepest,
                self.vector, row, begin, end, level,
            )  # fmt: skip
            return row[:count], begin[:count], end[:count], level[:count]

        rows, begins, ends, levels = zip(*self.run(work, range(len(cut) - 1)))
        self.row, self.begin = np.concatenate(rows), np.concatenate(begins)
        self.end, self.level = np.concatenate(ends), np.concatenate(levels)

    def _neighbours(self) -> tuple[I64, I64]:
        """Which cells touch which."""
        mark, index = kernels.names_of_cells(self.key, self.begin, self.level, self.deepest)
        cut = np.linspace(0, len(self.begin), _CHUNKS + 1).astype(np.int64)

        def work(part: int) -> I64:
            first, last = int(cut[part]), int(cut[part + 1])
            pair = np.empty((26 * (last - first), 2), dtype=np.int64)
            count = kernels.pairs_of_cells(
                mark, index, self.key, self.begin, self.level, self.deepest, first, last, pair
            )
            return pair[:count]

        pairs = np.concatenate(list(self.run(work, range(_CHUNKS))))
        first, neighbour = kernels.neighbours_of_pairs(pairs, len(self.begin))
        return first, neighbour

    def _label_by_book(self, region: I64, sums: F64) -> tuple[I64, F64]:
        """Steps 5 and 6: regions of enough cells, and their cells' inliers."""
        supporting = np.bincount(region[region >= 0], minlength=len(sums))
        sums = _renumber(region, supporting >= self.rules.min_cells, sums)
        label = np.empty(len(self.key), dtype=np.int64)
        kernels.label_inliers(
            self.x, self.y, self.z, self.begin, self.end, self.row, region, self.rules.inlier_m, label
        )
        kernels.sums_of_labels(self.x, self.y, self.z, self.weight, label, sums[:, 1:4].copy(), sums)
        return label, sums

    def _label_refined(self, region: I64, first: I64, neighbour: I64, sums: F64) -> tuple[I64, F64]:
        """Steps 5 and 6: points go to the nearest plane and planes are fitted to their points, in turn."""
        label = np.empty(len(self.key), dtype=np.int64)
        least = self.rules.min_support or self.rules.min_cells * self.rules.min_points
        sums = _renumber(region, sums[:, kernels.COUNT] >= 0.5 * least, sums)
        cut = np.linspace(0, len(region), _CHUNKS + 1).astype(np.int64)
        mark, index, pairs = kernels.touching_regions(region, first, neighbour)
        edge = np.zeros((pairs, 2))
        for turn in range(_ROUNDS):
            plane = sums[:, kernels.NX : kernels.D + 1].copy()
            rms = kernels.rms_of(sums)

            def work(part: int, plane: F64 = plane, rms: F64 = rms, turn: int = turn) -> I64:
                sides = np.zeros((pairs if turn == 0 else 0, 4), dtype=np.int64)
                kernels.label_nearest(
                    self.x, self.y, self.z, self.begin, self.end, region, first, neighbour, plane, rms, self.vector,
                    mark, index, edge, int(cut[part]), int(cut[part + 1]), label, sides,
                )  # fmt: skip
                return sides

            sides = list(self.run(work, range(_CHUNKS)))
            if turn == 0:
                kernels.edges_of_sides(np.sum(sides, axis=0), edge)
            kernels.sums_of_labels(self.x, self.y, self.z, self.weight, label, sums[:, 1:4].copy(), sums)
            weak = sums[:, kernels.COUNT] < least
            if np.any(weak):
                kernels.leave_out(weak, region)
                kernels.leave_out(weak, label)
        enough = sums[:, kernels.COUNT] >= least
        if not np.all(enough):
            sums = _renumber(region, enough, sums)
            label = np.where(label >= 0, (np.cumsum(enough) - 1)[label], -1)
        return label, sums

    def _result(self, found: I64, sums: F64, region: I64, usable: I64, label: I64, sensor: F64) -> Planes:
        big = np.argsort(-sums[:, kernels.COUNT], kind="stable")
        rank = np.empty(len(big), dtype=np.int64)
        rank[big] = np.arange(len(big))
        sums = sums[big]
        cells = np.bincount(rank[region[region >= 0]], minlength=len(sums)) if len(sums) else np.zeros(0, np.int64)
        kernels.labels_as_given(found, self.order, usable, rank, label)
        weight = np.maximum(sums[:, kernels.WEIGHT], 1e-300)
        normal, centre = sums[:, kernels.NX : kernels.NZ + 1].copy(), sums[:, kernels.CX : kernels.CZ + 1].copy()
        s = sums[:, kernels.XX : kernels.ZZ + 1] / weight[:, None]
        covariance = s[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        distance = np.einsum("pi,pi->p", normal, centre)
        normal[distance < 0.0] *= -1.0
        rms = np.sqrt(np.maximum(np.einsum("pi,pij,pj->p", normal, covariance, normal), 0.0))
        polygon = self._polygons(found, normal, centre)
        centre += sensor
        distance = np.einsum("pi,pi->p", normal, centre)
        if np.any(sensor):
            normal[distance < 0.0] *= -1.0
        return Planes(
            normal,
            np.abs(distance),
            centre,
            covariance,
            sums[:, kernels.COUNT].astype(np.int64),
            cells,
            rms,
            tuple(p + sensor for p in polygon),
            label,
            self.noise,
        )

    def _polygons(self, label: I64, normal: F64, centre: F64) -> list[F64]:
        along, across = axes_of(normal)
        first, member = kernels.groups_of(label, len(normal))
        share = np.linspace(0, len(member), _CHUNKS + 1)
        cut = np.unique(np.concatenate((np.searchsorted(first, share[:-1]), [len(normal)])))

        def work(part: int) -> list[F64]:
            a, b = int(cut[part]), int(cut[part + 1])
            corner = np.empty((int(first[b] - first[a]) + 2 * (b - a) + 2, 2))
            begins = kernels.hulls(
                self.x, self.y, self.z, first[a : b + 1], member, centre[a:b], along[a:b], across[a:b], corner
            )
            return [
                centre[r] + corner[i:j, :1] * along[r] + corner[i:j, 1:] * across[r]
                for r, (i, j) in enumerate(pairwise(begins), a)
            ]

        return [outline for outlines in self.run(work, range(len(cut) - 1)) for outline in outlines]


def _usual(sigma: F64) -> float:
    """What so large a share of cells does not exceed."""
    return float(np.sort(sigma)[int(_NOISE_SHARE * (len(sigma) - 1))])


def noise_of_scatter(range_m: F64, sigma: F64, *, most_m: float) -> RangeNoise:
    """The noise that the scatter of small cells tells: (M,) each. most_m: no noise is larger."""
    floor = 1e-4
    if len(sigma) < 8:
        return RangeNoise(min(max(floor, float(np.median(sigma))) if len(sigma) else most_m, most_m))
    order = np.argsort(range_m, kind="stable")
    groups = [g for g in np.array_split(order, min(8, len(order) // 8)) if len(g)]
    typical = np.array([_usual(sigma[g]) for g in groups])
    far2 = np.array([range_m[g[len(g) // 2]] for g in groups]) ** 2
    slope = 0.0
    if len(groups) > 2:
        pairs = [
            (typical[j] - typical[i]) / (far2[j] - far2[i])
            for i in range(len(groups))
            for j in range(i)
            if far2[i] - far2[j] > 0.05 * far2[-1]
        ]
        slope = max(0.0, float(np.median(pairs))) if pairs else 0.0  # Theil and Sen's line, which outliers leave alone
    base = float(np.median(typical - slope * far2))
    if base < floor:  # all of it grows with the range
        base, slope = floor, float(np.median(typical / np.maximum(far2, 1e-9)))
    return RangeNoise(min(base, most_m), min(slope, most_m / max(float(far2[-1]), 1e-9)))


def depth_step_per_m2(x: F64, y: F64, z: F64) -> float:
    """The step of a depth camera, over the square of the depth; 0 if depths do not come in steps.

    They do if one coordinate takes few values and the gaps between these grow with it about as its square.
    x, y, z: (N,) finite; no points have no steps.
    """
    if len(x) == 0:
        return 0.0
    for column in (z, x, y):
        sample = np.abs(column[:: max(1, len(column) // _STEP_SAMPLES)])
        part = np.sort(sample[::_STEP_PART])
        if np.count_nonzero(np.diff(part) > _SAME_M) > _STEPS_SHARE * len(sample):
            continue  # a part of the sample has too many values: no need to sort it all
        sample.sort()
        value = sample[np.concatenate(([True], np.diff(sample) > _SAME_M))]
        if not _FEWEST_STEPS <= len(value) <= _STEPS_SHARE * len(sample):
            continue
        gap, at = np.diff(value), value[1:]
        near, far = (np.median(part) for part in np.array_split(gap, 3)[::2])
        near_at, far_at = (np.median(part) for part in np.array_split(at, 3)[::2])
        if near_at > 0.0 and far > _STEP_GROWTH * near and far_at > _STEP_GROWTH * near_at:
            return float(np.median(gap / at**2))
    return 0.0


def axes_of(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors (P, 3) each that span planes of normals (P, 3), so that along x across = -normal: seen from the
    side that the normal comes from, across is to the left of along. The first lies level, where that says something."""
    level = np.stack((-normal[:, 1], normal[:, 0], np.zeros(len(normal))), axis=-1)
    length = np.hypot(level[:, 0], level[:, 1])
    flat = length < 1e-3
    level[flat] = np.array([1.0, 0.0, 0.0]) - normal[flat, :1] * normal[flat]
    along = level / np.linalg.norm(level, axis=1, keepdims=True)
    return along, np.cross(along, normal)


def _renumber(region: I64, keep: NDArray[np.bool_], sums: F64) -> F64:
    """Leave regions out: region changes in place, the sums of those kept are returned."""
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    has = region >= 0
    region[has] = number[region[has]]
    return sums[keep]


def _none(label: I64, noise: RangeNoise) -> Planes:
    empty = np.zeros((0, 3))
    none, zero = np.zeros(0, dtype=np.int64), np.zeros(0)
    return Planes(empty, zero, empty, np.zeros((0, 3, 3)), none, none, zero, (), label, noise)
