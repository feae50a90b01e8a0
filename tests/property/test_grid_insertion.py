"""Scans into grids, against slow literal forms of what mapping.grids.beam_model promises (S26 to S28)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.occupancy import CellRules, OccupancyGrid
from mapping.grids.tiles import Window
from mapping.no_echo import reach_without_echo
from mapping.scan import Scan

F64 = NDArray[np.float64]
Cells = set[tuple[int, int]]

D = 0.1
GAP_M = 0.15
RANGE_MAX_M = 4.0
SLOW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@dataclass(frozen=True)
class Sweep:
    """A scan and where it was taken."""

    pose: Pose2
    bearing_rad: F64
    range_m: F64


@st.composite
def sweeps(draw: st.DrawFn) -> Sweep:
    """Scans with few or many beams, any field of view, smooth or wild ranges, and every kind of missing range."""
    n = draw(st.integers(1, 90))
    view = draw(st.sampled_from([0.4, 1.5, math.pi, 4.7, 2 * math.pi * (n - 1) / n, 2 * math.pi]))
    first = draw(st.floats(-4.0, 4.0))
    bearing = first + np.linspace(0.0, view, n) if n > 1 else np.array([first])
    if draw(st.booleans()):
        bearing = bearing[::-1].copy()
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["wall", "noisy wall", "wild"]))
    distance = draw(st.floats(0.05, 3.5))
    if kind == "wild":
        ranges = rng.uniform(0.0, RANGE_MAX_M, n)
    else:
        ranges = distance / np.maximum(np.cos(bearing - first - view / 2), 0.3)
        ranges = np.where(ranges > RANGE_MAX_M, np.inf, ranges)
        if kind == "noisy wall":
            ranges = ranges + rng.normal(0.0, 0.03, n)
    strange = rng.random(n) < draw(st.sampled_from([0.0, 0.1, 0.5]))
    ranges = np.where(strange, rng.choice([np.inf, -np.inf, np.nan, -1.0, 9999.0], n), ranges)
    # Poses of binary fractions make exact borders likely.
    at = st.one_of(st.floats(-30.0, 30.0), st.integers(-80, 80).map(lambda k: k * D / 2))
    yaw = draw(st.one_of(st.floats(-3.2, 3.2), st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi])))
    return Sweep(Pose2(draw(at), draw(at), yaw), bearing, ranges)


def grid_of(
    sweep: Sweep, *, fill: str = "wedges", clear_no_return: bool = True, model: str = "counters"
) -> OccupancyGrid:
    grid = OccupancyGrid(resolution_m=D, fill_gap_m=GAP_M, model="log-odds" if model == "log-odds" else "counters")
    insert(grid, sweep, fill=fill, clear_no_return=clear_no_return)
    return grid


def insert(grid: OccupancyGrid, sweep: Sweep, *, fill: str = "wedges", clear_no_return: bool = True) -> None:
    grid.insert_scan(
        sweep.pose,
        sweep.bearing_rad,
        sweep.range_m,
        range_max_m=RANGE_MAX_M,
        clear_no_return=clear_no_return,
        fill="lines" if fill == "lines" else "wedges",
    )


def around(sweep: Sweep) -> Window:
    """A rectangle of cells that the scan cannot leave."""
    reach = math.ceil(RANGE_MAX_M / D) + 3
    row, col = math.floor(sweep.pose.y_m / D), math.floor(sweep.pose.x_m / D)
    return Window(row - reach, row + reach, col - reach, col + reach)


def counts(grid: OccupancyGrid, window: Window) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows, cols = np.mgrid[window.row0 : window.row1, window.col0 : window.col1]
    points = np.stack(((cols.ravel() + 0.5) * D, (rows.ravel() + 0.5) * D), axis=-1)
    hits, misses = grid.counts_at(points)
    return hits.reshape(rows.shape), misses.reshape(rows.shape)


def as_set(mask: NDArray[np.bool_], window: Window) -> Cells:
    return {(int(r) + window.row0, int(c) + window.col0) for r, c in np.argwhere(mask)}


# ------------------------------------------------------------------------------------------ the slow literal reference


def free_lengths(place: F64, range_m: F64, clear_no_return: bool) -> list[float]:
    """Of beams by ascending bearing; how far silence goes has tests of its own (test_no_echo)."""
    silent = reach_without_echo(place, range_m, RANGE_MAX_M)
    silent = np.where(np.isposinf(range_m) & clear_no_return & (silent > 0.0), silent, -1.0)
    return [float(r) if 0.0 <= r <= RANGE_MAX_M else float(s) for r, s in zip(range_m, silent)]


@dataclass(frozen=True)
class Expected:
    """Cells that must, and cells that may be hit and free; between the two lie those decided by rounding."""

    hit_must: Cells
    hit_may: Cells
    free_must: Cells
    free_may: Cells


def expected(sweep: Sweep, *, fill: str, clear_no_return: bool) -> Expected:
    """Each rule of the beam model, one beam and one cell after the other."""
    pose, window = sweep.pose, around(sweep)
    angle = sweep.bearing_rad + pose.yaw_rad
    n = len(angle)
    place = np.mod(sweep.bearing_rad - sweep.bearing_rad[0], 2 * math.pi)
    order = sorted(range(n), key=lambda i: (place[i], i))
    gaps = [place[order[k + 1]] - place[order[k]] for k in range(n - 1)] + [2 * math.pi - place[order[-1]]]
    positive = [g for g in gaps[:-1] if g > 0.0]
    nominal = float(np.median(positive)) if positive else 0.0
    free = free_lengths(place[order], sweep.range_m[order], clear_no_return)
    wedge = [0.0] * n
    for k in range(n):
        if fill == "wedges" and nominal > 0.0 and gaps[k] <= min(1.5 * nominal, 0.2):
            wedge[k] = max(0.0, min(free[k], free[(k + 1) % n], GAP_M / max(gaps[k], 1e-9)))

    hit_must: Cells = set()
    hit_may: Cells = set()
    for i in range(n):
        r = float(sweep.range_m[i])
        if 0.0 <= r <= RANGE_MAX_M:
            x, y = pose.x_m + r * math.cos(angle[i]), pose.y_m + r * math.sin(angle[i])
            near = {(math.floor((y + b) / D), math.floor((x + a) / D)) for a in (-1e-9, 1e-9) for b in (-1e-9, 1e-9)}
            hit_may |= near
            if len(near) == 1:
                hit_must |= near

    rows, cols = np.mgrid[window.row0 : window.row1, window.col0 : window.col1]
    cx, cy = (cols + 0.5) * D - pose.x_m, (rows + 0.5) * D - pose.y_m
    inside_must, inside_may = np.zeros(cx.shape, np.bool_), np.zeros(cx.shape, np.bool_)
    for k in range(n):
        if wedge[k] > 0.0:
            a, b = angle[order[k]], angle[order[(k + 1) % n]]
            inside_must |= in_triangle(cx, cy, wedge[k], a, b, 1e-9)
            inside_may |= in_triangle(cx, cy, wedge[k], a, b, -1e-9)
    # A centre on the side that two wedges share belongs to one of them; so does one at the sensor itself.
    close = np.hypot(cx, cy) < 1e-9
    free_must, free_may = as_set(inside_must & ~close, window), as_set(inside_may | close, window)
    for k in range(n):
        reach = max(wedge[k], wedge[k - 1])
        # What is left over in front of both wedges, if it is worth a line.
        if free[k] - reach > 2.0 * D - 1e-9:
            start = max(0.0, reach - D)
            touched = cells_on_line(pose, angle[order[k]], start, free[k], 1e-9)
            free_may |= touched[1]
            if free[k] - reach > 2.0 * D + 1e-9:
                free_must |= touched[0]
    return Expected(hit_must, hit_may, free_must - hit_may, free_may)


def in_triangle(cx: F64, cy: F64, length: float, a: float, b: float, shrink: float) -> NDArray[np.bool_]:
    """Centres inside the triangle (0, length at a, length at b), which turns left, by more than `shrink`."""
    ax, ay, bx, by = length * math.cos(a), length * math.sin(a), length * math.cos(b), length * math.sin(b)
    left_of_a = (math.cos(a) * cy - math.sin(a) * cx) > shrink
    right_of_b = (math.cos(b) * cy - math.sin(b) * cx) < -shrink
    chord = math.hypot(bx - ax, by - ay)
    if chord < 1e-12:
        return np.zeros(cx.shape, np.bool_) if shrink >= 0 else (np.hypot(cx, cy) <= length) & left_of_a & right_of_b
    short_of_chord = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / chord > shrink
    return np.asarray(left_of_a & right_of_b & short_of_chord)


def cells_on_line(pose: Pose2, angle: float, start: float, stop: float, eps: float) -> tuple[Cells, Cells]:
    """Cells whose inside (by eps) and whose surroundings (by eps) a line meets: clipped against each square in turn."""
    x0, y0 = pose.x_m + start * math.cos(angle), pose.y_m + start * math.sin(angle)
    x1, y1 = pose.x_m + stop * math.cos(angle), pose.y_m + stop * math.sin(angle)
    must: Cells = set()
    may: Cells = set()
    for row in range(math.floor(min(y0, y1) / D) - 1, math.floor(max(y0, y1) / D) + 2):
        for col in range(math.floor(min(x0, x1) / D) - 1, math.floor(max(x0, x1) / D) + 2):
            if line_meets(x0, y0, x1, y1, row, col, eps):
                must.add((row, col))
            if line_meets(x0, y0, x1, y1, row, col, -eps):
                may.add((row, col))
    return must, may


def line_meets(x0: float, y0: float, x1: float, y1: float, row: int, col: int, eps: float) -> bool:
    """Whether a line has a point in the square of a cell, its sides moved inwards by eps."""
    low, high = 0.0, 1.0
    for p, q, lower in ((x0, x1, col * D), (y0, y1, row * D)):
        a, b, way = lower + eps, lower + D - eps, q - p
        if abs(way) < 1e-15:
            if not a <= p <= b:
                return False
            continue
        s, t = sorted(((a - p) / way, (b - p) / way))
        low, high = max(low, s), min(high, t)
    return low <= high


# ------------------------------------------------------------------------------------------------------ the properties


@SLOW
@given(sweeps(), st.sampled_from(["wedges", "lines"]), st.booleans())
def test_a_scan_hits_and_frees_exactly_the_cells_of_the_literal_reference(
    sweep: Sweep, fill: str, clear_no_return: bool
) -> None:
    window = around(sweep)
    hits, misses = counts(grid_of(sweep, fill=fill, clear_no_return=clear_no_return), window)
    want = expected(sweep, fill=fill, clear_no_return=clear_no_return)
    hit, free = as_set(hits > 0, window), as_set(misses > 0, window)
    assert want.hit_must <= hit <= want.hit_may
    assert free <= want.free_may, "freed without evidence"
    assert want.free_must <= free, "evidence not used"


@SLOW
@given(sweeps(), st.sampled_from(["wedges", "lines"]))
def test_a_cell_counts_once_per_scan_and_a_hit_cell_is_not_cleared(sweep: Sweep, fill: str) -> None:
    hits, misses = counts(grid_of(sweep, fill=fill), around(sweep))
    assert hits.max() <= 1
    assert misses.max() <= 1
    assert not np.any((hits > 0) & (misses > 0))


@SLOW
@given(sweeps())
def test_no_cell_is_freed_beyond_what_the_beams_beside_it_saw(sweep: Sweep) -> None:
    """Independent of how cells are filled: a freed cell has a beam near enough in bearing that looked as far."""
    window = around(sweep)
    _, misses = counts(grid_of(sweep), window)
    free = np.where(np.isposinf(sweep.range_m), RANGE_MAX_M, sweep.range_m)
    known = (free >= 0.0) & (free <= RANGE_MAX_M)
    assert bool(misses.any()) <= bool(known.any())
    angle = sweep.bearing_rad[known] + sweep.pose.yaw_rad
    length = free[known]
    for row, col in np.argwhere(misses > 0):
        x = (col + window.col0 + 0.5) * D - sweep.pose.x_m
        y = (row + window.row0 + 0.5) * D - sweep.pose.y_m
        distance = math.hypot(x, y)
        along = x * np.cos(angle) + y * np.sin(angle)
        beside = np.abs(-x * np.sin(angle) + y * np.cos(angle))
        half_diagonal = D * math.sqrt(0.5)
        # Neighbours are at most GAP_M apart where a wedge is filled, so one of the two is at most that far away.
        close = (beside <= GAP_M + half_diagonal) & (along >= -half_diagonal)
        assert np.any(close & (length >= distance - half_diagonal))


@SLOW
@given(sweeps(), st.integers(-3, 3), st.integers(-3, 3))
def test_tiles_are_seamless(sweep: Sweep, tile_row: int, tile_col: int) -> None:
    """Moving everything by 50 cells and whole tiles moves the result and nothing else."""
    d = 0.125
    # Off the borders, where the rounding of a place decides which cells a beam meets.
    pose = Pose2(round(sweep.pose.x_m) + 0.0371, round(sweep.pose.y_m) + 0.0213, sweep.pose.yaw_rad + 0.0123)
    rows, cols = 50 + 128 * tile_row, 50 + 128 * tile_col
    moved = Pose2(pose.x_m + cols * d, pose.y_m + rows * d, pose.yaw_rad)
    patches = []
    for p in (pose, moved):
        grid = OccupancyGrid(resolution_m=d, fill_gap_m=GAP_M)
        grid.insert_scan(p, sweep.bearing_rad, sweep.range_m, range_max_m=RANGE_MAX_M)
        patches.append(grid.patch())
    assert np.array_equal(patches[0].cells, patches[1].cells)
    if patches[0].cells.size:
        assert (patches[1].row0 - patches[0].row0, patches[1].col0 - patches[0].col0) == (rows, cols)


@SLOW
@given(sweeps())
def test_both_models_agree_on_which_cells_are_hit_and_free(sweep: Sweep) -> None:
    window = around(sweep)
    hits, misses = counts(grid_of(sweep), window)
    odds = grid_of(sweep, model="log-odds").cells_in(window)
    assert np.array_equal(odds >= 0, (hits + misses) > 0)
    assert np.all(odds[hits > 0] > 50)
    assert np.all(odds[misses > 0] < 50)


@SLOW
@given(sweeps(), st.permutations(range(40)))
def test_the_order_of_beams_does_not_matter(sweep: Sweep, order: list[int]) -> None:
    n = len(sweep.bearing_rad)
    picked = np.array([k for k in order if k < n] + list(range(40, n)), dtype=np.int64)
    # The gap between the first and the last beam is where the field of view ends: keep the first beam first.
    picked = np.concatenate(([0], picked[picked != 0]))
    shuffled = Sweep(sweep.pose, sweep.bearing_rad[picked], sweep.range_m[picked])
    window = around(sweep)
    want = expected(sweep, fill="wedges", clear_no_return=True)
    hits, misses = counts(grid_of(shuffled), window)
    if np.all(np.diff(sweep.bearing_rad) > 0):
        assert want.hit_must <= as_set(hits > 0, window) <= want.hit_may
        assert want.free_must <= as_set(misses > 0, window) <= want.free_may


@SLOW
@given(sweeps(), st.sampled_from([0.0, 0.02, 0.049, 0.3]), st.floats(-3.0, 3.0))
def test_deskewed_beams_free_nothing_that_no_beam_passed(sweep: Sweep, drift_m: float, heading: float) -> None:
    """Beams from a moving sensor; near the sensor, and anywhere for one reference origin, half a cell is allowed."""
    n = len(sweep.bearing_rad)
    along = np.linspace(-drift_m, drift_m, n)
    poses = np.stack(
        (
            sweep.pose.x_m + along * math.cos(heading),
            sweep.pose.y_m + along * math.sin(heading),
            np.full(n, sweep.pose.yaw_rad),
        ),
        axis=-1,
    )
    scan = Scan(0, 1e5, sweep.bearing_rad, sweep.range_m, 0.05, RANGE_MAX_M)
    beams = beams_of_scan(scan, poses)
    grid = OccupancyGrid(resolution_m=D, fill_gap_m=GAP_M)
    grid.insert_beams(beams)
    window = Window(*(k + (-6 if i % 2 == 0 else 6) for i, k in enumerate(window_tuple(around(sweep)))))
    hits, misses = counts(grid, window)
    assert hits.max() <= 1
    assert misses.max() <= 1
    assert not np.any((hits > 0) & (misses > 0))
    for i in range(n):
        if beams.hit[i] and np.all(np.abs(np.mod(beams.end_m[i] / D, 1.0) - 0.5) < 0.499999):
            row, col = math.floor(beams.end_m[i, 1] / D), math.floor(beams.end_m[i, 0] / D)
            assert hits[row - window.row0, col - window.col0] == 1
    start, way = beams.origin_m[beams.free], (beams.end_m - beams.origin_m)[beams.free]
    length = np.hypot(way[:, 0], way[:, 1])
    unit = way / np.maximum(length, 1e-12)[:, None]
    half_diagonal = D * math.sqrt(0.5)
    for row, col in np.argwhere(misses > 0):
        to = np.array([(col + window.col0 + 0.5) * D, (row + window.row0 + 0.5) * D]) - start
        ahead = to[:, 0] * unit[:, 0] + to[:, 1] * unit[:, 1]
        beside = np.abs(to[:, 0] * unit[:, 1] - to[:, 1] * unit[:, 0])
        near = (beside <= GAP_M + half_diagonal + D / 2) & (ahead >= -half_diagonal - D / 2)
        assert np.any(near & (ahead <= length + half_diagonal + D / 2))


def window_tuple(window: Window) -> tuple[int, int, int, int]:
    return window.row0, window.row1, window.col0, window.col1


@SLOW
@given(sweeps())
def test_a_standing_sensor_gives_the_same_map_from_beams_and_from_a_scan(sweep: Sweep) -> None:
    """But for missing beams, which hide a device's spacing, and for two beams in one direction, whose order is open."""
    assume(np.ptp(sweep.bearing_rad) < 6.28)
    gaps = np.diff(np.sort(np.mod(sweep.bearing_rad - sweep.bearing_rad[0], 2 * math.pi)))
    assume(not np.any(np.abs(gaps - 0.2) < 1e-9))  # the widest wedge: rounding decides there
    ranges = np.where(np.isfinite(sweep.range_m) & (sweep.range_m >= 0), sweep.range_m, 1.0)
    whole = Sweep(sweep.pose, sweep.bearing_rad, np.minimum(ranges, RANGE_MAX_M))
    want = expected(whole, fill="wedges", clear_no_return=True)
    scan = Scan(0, 0.0, whole.bearing_rad, whole.range_m, 0.05, RANGE_MAX_M)
    grid = OccupancyGrid(resolution_m=D, fill_gap_m=GAP_M)
    grid.insert_beams(beams_of_scan(scan, [whole.pose.x_m, whole.pose.y_m, whole.pose.yaw_rad]))
    window = around(whole)
    hits, misses = counts(grid, window)
    assert want.hit_must <= as_set(hits > 0, window) <= want.hit_may
    assert as_set(misses > 0, window) <= want.free_may | want.hit_may


@SLOW
@given(st.lists(st.lists(st.sampled_from("hm."), min_size=3, max_size=3), max_size=60), st.integers(2, 12))
def test_counters_follow_their_literal_rule(history: list[list[str]], limit: int) -> None:
    """Hits and misses of three cells over a run: before one counter would pass the limit, both are halved."""
    grid = OccupancyGrid(resolution_m=D, rules=CellRules(count_limit=limit))
    cells = [(0, 0), (-1, 127), (5, -129)]
    count = [[0, 0] for _ in cells]
    for step in history:
        grid.insert_cells(
            [c for c, what in zip(cells, step) if what == "h"], [c for c, what in zip(cells, step) if what == "m"]
        )
        for pair, what in zip(count, step):
            if what != ".":
                k = 0 if what == "h" else 1
                if pair[k] >= limit:
                    pair[0], pair[1] = pair[0] // 2, pair[1] // 2
                pair[k] += 1
    points = [((c + 0.5) * D, (r + 0.5) * D) for r, c in cells]
    hits, misses = grid.counts_at(points)
    assert [[int(h), int(m)] for h, m in zip(hits, misses)] == count
    probability = grid.probability_at(points)
    for p, (h, m) in zip(probability, count):
        assert math.isnan(p) if h + m == 0 else p == h / (h + m)  # eq. 5.46


@SLOW
@given(st.lists(st.sampled_from("hm"), max_size=40))
def test_log_odds_add_up_within_their_bounds(history: list[str]) -> None:
    rules = CellRules(hit_log_odds=0.9, miss_log_odds=0.4, lowest_log_odds=-1.3, highest_log_odds=2.0)
    grid = OccupancyGrid(resolution_m=D, model="log-odds", rules=rules)
    odds: float | None = None
    for what in history:
        grid.insert_cells([(0, 0)] if what == "h" else [], [(0, 0)] if what == "m" else [])
        odds = (odds or 0.0) + (0.9 if what == "h" else -0.4)
        odds = min(max(odds, -1.3), 2.0)
    p = float(grid.probability_at([(0.05, 0.05)])[0])
    assert math.isnan(p) if odds is None else abs(p - 1 / (1 + math.exp(-odds))) < 1e-9


@SLOW
@given(st.lists(sweeps(), min_size=1, max_size=5))
def test_changes_replayed_give_the_map(several: list[Sweep]) -> None:
    """Whoever paints the published rectangles sees exactly the grid, and nothing is published twice."""
    grid = OccupancyGrid(resolution_m=D, fill_gap_m=GAP_M)
    window = Window(-400, 400, -400, 400)
    painted = np.full((800, 800), -1, dtype=np.int8)
    for sweep in several:
        insert(grid, sweep)
        for change in grid.take_changes():
            rows, cols = change.cells.shape
            assert change.cells.nbytes <= 32_768
            row, col = change.row0 - window.row0, change.col0 - window.col0
            part = painted[row : row + rows, col : col + cols]
            for rim in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
                assert np.any(part[rim] != change.cells[rim]), "rectangle larger than the change"
            part[:] = change.cells
        assert np.array_equal(painted, grid.cells_in(window))
        assert grid.take_changes() == []
