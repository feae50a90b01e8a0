"""Walls of a map that is being made: counted as they come, judged tile by tile, kept and taken up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids import live_walls
from mapping.grids.evidence import Model
from mapping.grids.live_walls import LiveWalls
from mapping.grids.occupancy import OCCUPIED, OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import TILE
from mapping.grids.walls import BeamCounts
from tests.unit.mapping.test_grid_walls import BEARING, MAX_M, WALL_Y_M, drive, grid_of, to_wall

F64 = NDArray[np.float64]


def row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])


def walls_of(scans: list[tuple[Pose2, F64]], max_tiles: int = 4096) -> LiveWalls:
    walls = LiveWalls(resolution_m=0.05, max_tiles=max_tiles)
    for pose, ranges in scans:
        walls.add(row(pose), BEARING, ranges, range_max_m=MAX_M)
    return walls


def show(grid: OccupancyGrid, walls: LiveWalls) -> None:
    for place in walls.places:
        grid.show_walls(*place, walls.judge(place))


def cells_of(walls: LiveWalls) -> set[tuple[int, int]]:
    """[row, col] of all walls."""
    found: set[tuple[int, int]] = set()
    for tile_row, tile_col in walls.places:
        at = np.argwhere(walls.judge((tile_row, tile_col))) + (tile_row * TILE, tile_col * TILE)
        found |= {(int(r), int(c)) for r, c in at}
    return found


def columns(patch: GridPatch) -> NDArray[np.int64]:
    """How many cells of the wall along x are occupied, in each column from 0 to 8 m."""
    return np.asarray(np.sum(patch.cells[:, -patch.col0 : 160 - patch.col0] >= 65, axis=0))


@pytest.mark.parametrize("model", ["counters", "log-odds"])
def test_a_smeared_wall_is_shown_thin_and_no_cell_freer(model: Model) -> None:
    scans = drive(0.04, seed=1)
    grid = grid_of(scans, model)
    before, cells = grid.patch(), [payload for _, _, payload in grid.tiles()]
    show(grid, walls_of(scans))
    after = grid.patch()
    thick, thin = columns(before), columns(after)
    assert np.mean(thin == 0) < 0.01
    assert np.mean(thin == 0) <= np.mean(thick == 0)
    assert np.mean(thin > 2) < 0.25
    if model == "log-odds":  # counters have gaps rather than thick walls
        assert np.mean(thin) < 0.75 * np.mean(thick)
    assert (after.row0, after.col0, after.cells.shape) == (before.row0, before.col0, before.cells.shape)
    assert np.all((after.cells < 25) <= (before.cells < 25))
    assert [payload for _, _, payload in grid.tiles()] == cells  # what is kept stays as counted


def test_walls_are_those_of_all_scans_together() -> None:
    """Cells that lie within one tile: what a rim of the neighbours cannot tell apart."""
    scans = [(Pose2(0.0, 3.0, 0.0) @ pose, ranges) for pose, ranges in drive(0.03, seed=2, places=30)]
    grid, walls = grid_of(scans), walls_of(scans)
    counts = BeamCounts(grid)
    for pose, ranges in scans:
        counts.add(pose, BEARING, ranges, range_max_m=MAX_M)
    whole = {(int(r), int(c)) for r, c in counts.walls()}
    found = cells_of(walls)
    assert len(found) > 100
    assert len(found ^ whole) <= 0.01 * len(whole)  # where the rim ends a chain of choices


def test_the_sensor_may_move_in_a_sweep() -> None:
    still, moving = LiveWalls(resolution_m=0.05), LiveWalls(resolution_m=0.05)
    pose = np.array([0.3, 0.1, 0.2])
    ranges = to_wall(Pose2(*pose))
    still.add(pose, BEARING, ranges, range_max_m=MAX_M)
    moving.add(np.tile(pose, (len(BEARING), 1)), BEARING, ranges, range_max_m=MAX_M)
    assert [still.payload(p) for p in still.places] == [moving.payload(p) for p in moving.places]
    poses = np.tile(pose, (len(BEARING), 1))
    poses[:, 0] += np.linspace(0.0, 1.0, len(BEARING))
    moving.clear()
    moving.add(poses, BEARING, ranges, range_max_m=MAX_M)
    assert {r for r, _ in cells_of(moving)} <= {math.floor(WALL_Y_M / 0.05)}


def test_a_wall_that_is_moved_is_found_where_it_stands_now() -> None:
    """Counts are halved where they are full: no place is what it was for ever."""
    grid, walls = OccupancyGrid(), LiveWalls(resolution_m=0.05)
    for y_m, times in ((2.03, 1000), (2.53, 400)):
        for _ in range(times):
            ranges = to_wall(Pose2(), y_m)
            grid.insert_scan(Pose2(0.0, 0.0, math.pi / 2), BEARING, np.abs(y_m / np.cos(BEARING)), range_max_m=8.0)
            walls.add(np.array([0.0, 0.0, 0.0]), BEARING, ranges, range_max_m=8.0)
    rows = {r for r, c in cells_of(walls) if abs(c) < 20}
    assert rows == {math.floor(2.53 / 0.05)}


def test_what_steps_into_view_is_shown_at_once_and_goes_again() -> None:
    scans = drive(0.03, seed=5)
    grid = grid_of(scans, "counters")
    show(grid, walls_of(scans))
    person = np.where(np.abs(BEARING) < 0.1, 1.22, np.inf)
    pose = Pose2(4.02, 0.0, math.pi / 2)
    at = np.array([[4.02, 1.22]])
    for _ in range(100):
        grid.insert_scan(pose, BEARING, person, range_max_m=MAX_M, clear_no_return=False)
    r, c = grid.cell_at(4.02, 1.22)
    patch = grid.patch()
    assert grid.state_at(at)[0] == OCCUPIED
    assert patch.cells[r - patch.row0, c - patch.col0] >= 65
    for _ in range(200):
        grid.insert_scan(pose, BEARING, to_wall(pose), range_max_m=MAX_M, clear_no_return=False)
    patch = grid.patch()
    assert 0 <= patch.cells[r - patch.row0, c - patch.col0] < 25


def test_tiles_are_made_where_beams_end_only_and_no_more_than_there_may_be() -> None:
    walls = LiveWalls(resolution_m=0.05, max_tiles=2)
    bearing = np.zeros(1)
    for far_m in (20.0, 20.0, np.inf, np.nan, -1.0, 50.0):
        walls.add(np.array([0.1, 0.1, 0.0]), bearing, np.array([far_m]), range_max_m=30.0)
    assert walls.places == [(0, 3)]
    walls.add(np.array([0.1, 0.1, math.pi]), bearing, np.array([20.0]), range_max_m=30.0)
    walls.add(np.array([0.1, 0.1, math.pi / 2]), bearing, np.array([20.0]), range_max_m=30.0)
    assert (walls.places, walls.refused) == ([(0, 3), (0, -4)], 1)
    assert not walls.judge((7, 7)).any()


def test_a_tile_is_worth_judging_when_many_beams_came_since() -> None:
    walls = LiveWalls(resolution_m=0.05)

    def add(beams: int) -> None:
        walls.add(np.zeros(3), np.zeros(beams), np.ones(beams), range_max_m=2.0)

    add(100)
    assert walls.worth(0.25) == [(0, 0)]
    walls.judge((0, 0))
    assert walls.worth(0.0) == []
    add(25)
    assert (walls.worth(0.25), walls.worth(0.0)) == ([], [(0, 0)])
    add(1)
    assert walls.worth(0.25) == [(0, 0)]
    add(100 * live_walls.MANY)
    walls.judge((0, 0))
    add(live_walls.MANY)
    assert walls.worth(0.25) == [(0, 0)]


def test_what_is_kept_is_taken_up() -> None:
    walls = walls_of(drive(0.03, seed=4, places=20))
    kept = [(*place, walls.payload(place)) for place in walls.places]
    again = LiveWalls(resolution_m=0.05)
    again.load(kept)
    assert cells_of(again) == cells_of(walls)
    again.load(kept)
    assert [(*place, again.payload(place)) for place in again.places] == kept
    assert set(again.worth(0.0)) == set(again.places)  # to be shown


@pytest.mark.parametrize("damage", ["torn", "short", "flipped", "other", "version", "far"])
def test_damaged_counts_are_refused_whole(damage: str) -> None:
    walls = walls_of(drive(0.0, seed=4, places=3))
    kept = [(*place, walls.payload(place)) for place in walls.places]
    r, c, payload = kept[-1]
    kept[-1] = {
        "torn": (r, c, payload[: len(payload) // 2]),
        "short": (r, c, payload[:7]),
        "flipped": (r, c, payload[:-1] + bytes([payload[-1] ^ 1])),
        "other": (r, c, b"UGRT" + payload[4:]),
        "version": (r, c, payload[:4] + b"\x02" + payload[5:]),
        "far": (1 << 40, c, payload),
    }[damage]
    with pytest.raises(ValueError, match=r"stored counts|too far"):
        walls.load(kept)
    assert walls.places == []


def test_counts_of_another_resolution_are_refused() -> None:
    kept = [(*p, walls.payload(p)) for walls in [walls_of(drive(0.0, seed=4, places=1))] for p in walls.places]
    with pytest.raises(ValueError, match=r"0\.05 m cells"):
        LiveWalls(resolution_m=0.1).load(kept)
