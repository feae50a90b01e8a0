"""The two-step update of ARTOS (S40) against the book's text, transcribed slowly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.sectors.artos import ArtosMap
from mapping.sectors.polar import sector_edges
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]
OBSTACLE, FREE, UNKNOWN, STALE = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE
RESOLUTION_M = 0.1


def sectors(
    state: list[SectorState], distance: list[float], *, pose: Pose2 = IDENTITY, start: float = -2.0, width: float = 0.5
) -> PolarSnapshot:
    count = len(state)
    edges = sector_edges(start_rad=start, stop_rad=start + width * count, sector_rad=width)
    middle = 0.5 * (edges[:-1] + edges[1:])
    nothing = np.zeros(count)
    states = np.array(state, dtype=np.int8)
    return PolarSnapshot(
        0, pose, edges, states, np.array(distance), np.where(states == OBSTACLE, middle, np.nan), nothing,
        np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int16), ("laser",),
    )  # fmt: skip


def literal(
    snapshots: list[tuple[PolarSnapshot, Pose2]], resolution_m: float, limit: int
) -> dict[tuple[int, int], int]:
    """Counters of an unbounded map by the words of section 5.3; a cell counted up is not counted down at once."""
    counters: dict[tuple[int, int], int] = {}
    for snapshot, map_from_base in snapshots:
        sensor = map_from_base @ snapshot.base_from_sensor
        hit = set()
        for i in range(len(snapshot.state)):  # first step: all sectors are traversed
            if snapshot.state[i] != OBSTACLE:
                continue
            r, a = snapshot.distance_m[i], snapshot.bearing_rad[i]
            x, y = sensor.apply([r * math.cos(a), r * math.sin(a)])
            cell = (math.floor(y / resolution_m), math.floor(x / resolution_m))
            counters[cell] = min(counters.get(cell, 0) + 1, limit)
            hit.add(cell)
        for row in range(-30, 30):  # second step: all cells in a rectangular area
            for col in range(-30, 30):
                x, y = (col + 0.5) * resolution_m - sensor.x_m, (row + 0.5) * resolution_m - sensor.y_m
                distance = math.hypot(x, y)
                bearing = (math.atan2(y, x) - sensor.yaw_rad) % (2 * math.pi)
                for i in range(len(snapshot.state)):  # the containing sector is determined
                    lower, upper = snapshot.edges_rad[i], snapshot.edges_rad[i + 1]
                    inside = any(
                        lower <= bearing + turn < upper for turn in (-2 * math.pi, 0.0, 2 * math.pi, -4 * math.pi)
                    )
                    if inside and snapshot.state[i] in (OBSTACLE, FREE) and distance < snapshot.distance_m[i]:
                        if (row, col) not in hit:
                            counters[row, col] = max(counters.get((row, col), 0) - 1, -limit)
                        break
    return counters


def as_dict(grid: ArtosMap) -> dict[tuple[int, int], int]:
    patch, counters = grid.patch(), grid.counters()
    return {
        (int(row) + patch.row0, int(col) + patch.col0): int(counters[row, col])
        for row, col in zip(*np.nonzero(patch.cells >= 0))
    }


poses = st.builds(Pose2, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.2, 3.2))


@st.composite
def snapshots(draw: st.DrawFn) -> PolarSnapshot:
    count = draw(st.integers(1, 8))
    state = [SectorState(draw(st.integers(0, 3))) for _ in range(count)]
    distance = [draw(st.floats(0.05, 3.0)) if s in (OBSTACLE, FREE) else math.nan for s in state]
    return sectors(
        state, distance, pose=draw(poses), start=draw(st.floats(-4.0, 4.0)), width=draw(st.floats(0.05, 0.75))
    )


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(snapshots(), poses), min_size=1, max_size=2))
def test_as_the_book_says(seen: list[tuple[PolarSnapshot, Pose2]]) -> None:
    grid = ArtosMap(resolution_m=0.2, size_m=12.0, counter_max=3, follow=False)
    for snapshot, pose in seen:
        grid.update(snapshot, pose)
    wanted = literal(seen, 0.2, 3)
    got = as_dict(grid)
    # A cell whose middle lies within rounding of an edge may go either way: no more than a few of ten thousand.
    different = {cell for cell in wanted.keys() | got.keys() if wanted.get(cell) != got.get(cell)}
    assert len(different) <= 2


def test_sectors_without_knowledge_change_nothing() -> None:
    grid = ArtosMap(resolution_m=RESOLUTION_M, size_m=8.0)
    grid.update(sectors([UNKNOWN, STALE, STALE], [math.nan, 1.0, math.nan]), IDENTITY)
    assert (grid.patch().cells == -1).all()


def test_an_obstacle_rises_and_its_foreground_falls() -> None:
    grid = ArtosMap(resolution_m=RESOLUTION_M, size_m=8.0, counter_max=4)
    snapshot = sectors([OBSTACLE], [2.04], start=-0.25, width=0.5)
    for _ in range(4):
        grid.update(snapshot, Pose2(0.05, 0.05, 0.0))
    patch = grid.patch()
    row, col = 0 - patch.row0, 20 - patch.col0
    assert patch.cells[row, col] == 100
    assert patch.cells[row, col - 1] == 0
    assert patch.cells[row, col + 1] == -1


def test_the_window_scrolls_and_cells_stay_in_the_map() -> None:
    grid = ArtosMap(resolution_m=RESOLUTION_M, size_m=4.0)
    snapshot = sectors([OBSTACLE], [1.04], start=-0.05, width=0.1)
    nothing = sectors([UNKNOWN], [math.nan])
    grid.update(snapshot, Pose2(0.0, 0.05, 0.0))
    before = as_dict(grid)
    grid.update(nothing, Pose2(-0.73, 0.61, 1.0))
    assert as_dict(grid) == before
    assert (grid.patch().row0, grid.patch().col0) == (6 - 20, -8 - 20)
    grid.update(nothing, Pose2(-1.93, 0.0, 0.0))
    assert as_dict(grid).items() < before.items()
    grid.update(nothing, Pose2(50.0, 0.0, 0.0))
    assert as_dict(grid) == {}
    grid.update(nothing, IDENTITY)
    assert as_dict(grid) == {}


def test_maps_of_one_instant_do_not_clear_each_other() -> None:
    glass = sectors([OBSTACLE], [1.04], start=-0.05, width=0.1)
    through = sectors([FREE], [3.0], start=-0.05, width=0.1)
    grid = ArtosMap(resolution_m=RESOLUTION_M, size_m=8.0, counter_max=5)
    for _ in range(5):
        grid.update([through, glass], Pose2(0.0, 0.05, 0.0))
    assert as_dict(grid)[0, 10] == 5


def test_the_second_step_stays_in_its_rectangle() -> None:
    grid = ArtosMap(resolution_m=RESOLUTION_M, size_m=8.0, area_m=(2.0, 1.0))
    grid.update(sectors([FREE] * 8, [3.0] * 8, start=-math.pi, width=math.pi / 4), Pose2(0.05, 0.05, 0.0))
    rows, cols = zip(*as_dict(grid))
    assert (min(rows), max(rows), min(cols), max(cols)) == (-5, 5, -10, 10)


@pytest.mark.parametrize(
    ("resolution", "size", "limit"), [(0.0, 1.0, 1), (0.1, -1.0, 1), (0.1, 1.0, 0), (1e-4, 1e3, 1)]
)
def test_impossible_maps_are_refused(resolution: float, size: float, limit: int) -> None:
    with pytest.raises(ValueError):
        ArtosMap(resolution_m=resolution, size_m=size, counter_max=limit)
