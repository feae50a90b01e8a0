"""The maker of walls: which sweeps it counts, when it judges, what it tells the grid and keeps for the store."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.live_walls import LiveWalls
from mapping.grids.occupancy import OccupancyGrid
from mapping.scan import Scan
from service.layers import BuildingLayer
from service.live_map import GRID, LiveMap, restore
from service.map_makers import MapMakers, MapView, Tile
from service.outputs import GridOut, GridUpdateOut, Output
from service.store import OCCUPANCY, MapStore, occupancy_patch
from service.wall_maker import ALL_PERIOD_NS, BEAMS_MOST, PERIOD_NS, STEP_M, STEP_RAD, WallMaker

F64 = NDArray[np.float64]
SECOND = 1_000_000_000
BEARING = np.radians(np.arange(-60.0, 60.5, 0.5))
Told = list[tuple[int, int, NDArray[np.uint8]]]


def sweep(seed: int | None = None) -> Scan:
    """A wall across, 2 m ahead, with 3 cm of noise."""
    noise = 0.0 if seed is None else np.random.default_rng(seed).normal(0.0, 0.03, len(BEARING))
    return Scan(7, 0.0, BEARING, 2.03 / np.cos(BEARING) + noise, 0.05, 10.0)


def maker_of(told: Told | None = None) -> tuple[WallMaker, LiveWalls]:
    walls = LiveWalls(resolution_m=0.05)
    told = [] if told is None else told
    return WallMaker(walls, ["front"], lambda row, col, found: told.append((row, col, found))), walls


def view(stamp_s: float = 0.0) -> MapView:
    return MapView(round(stamp_s * SECOND), None, (), None)


def beams(walls: LiveWalls) -> int:
    return int(walls._beams.sum())


def test_sweeps_count_a_step_or_a_turn_apart() -> None:
    maker, walls = maker_of()
    n = len(BEARING)
    for x_m, yaw, many in (
        (0.0, 0.0, 1),
        (0.9 * STEP_M, 0.0, 1),
        (1.1 * STEP_M, 0.0, 2),
        (1.1 * STEP_M, 0.9 * STEP_RAD, 2),
        (1.1 * STEP_M, 1.1 * STEP_RAD, 3),
    ):
        maker.take_sweep("front", sweep(), np.tile([x_m, 0.0, yaw], (n, 1)))
        assert beams(walls) == many * n
    maker.take_sweep("rear", sweep(), np.array([1.1 * STEP_M, 0.0, 0.0]))
    assert beams(walls) == 4 * n  # each laser by itself


def test_a_sweep_that_ends_nowhere_makes_no_step() -> None:
    maker, walls = maker_of()
    for nothing in (math.inf, math.nan):
        blind = Scan(7, 0.0, BEARING, np.full(len(BEARING), nothing), 0.05, 10.0)
        maker.take_sweep("front", blind, np.zeros(3))
    maker.take_sweep("front", sweep(), np.array([0.01, 0.0, 0.0]))
    assert beams(walls) == len(BEARING)


def test_of_fine_sweeps_every_second_beam_counts_and_the_others_of_the_next() -> None:
    maker, walls = maker_of()
    bearing = np.linspace(-1.0, 1.0, BEAMS_MOST + 1)
    sure = Scan(7, 0.0, bearing, 2.03 / np.cos(bearing), 0.05, 10.0)
    for k in range(2):
        maker.take_sweep("front", sure, np.array([1.0 * k, 0.0, 0.0]) if k else np.zeros((len(bearing), 3)))
    assert beams(walls) == len(bearing)


def test_it_judges_tiles_with_many_new_beams_at_once_and_the_others_in_time() -> None:
    told: Told = []
    maker, _ = maker_of(told)
    steps = iter(np.arange(0.0, 100.0, 2.0 * STEP_M))

    def drive(count: int) -> None:
        for _ in range(count):
            maker.take_sweep("front", sweep(), np.array([0.0, next(steps) % 0.9, 0.0]))

    drive(20)
    assert maker.make(view(1.0)) == []
    first = len(told)
    assert first > 0
    drive(2)  # a tenth more
    maker.make(view(3.0))
    assert len(told) == first
    maker.make(view(1.0 + ALL_PERIOD_NS / SECOND))
    assert len(told) > first
    judged = len(told)
    maker.make(view(100.0))  # nothing new
    assert len(told) == judged
    drive(8)
    maker.make(view(101.0))
    assert len(told) > judged


def test_after_a_correction_tiles_that_end_nothing_any_more_are_told_and_kept_empty() -> None:
    told: Told = []
    maker, _ = maker_of(told)
    maker.take_sweep("front", sweep(), np.zeros(3))
    maker.settle()
    before = {(row, col) for row, col, found in told if found.any()}
    assert before
    maker.changed_tiles()
    maker.start_anew()
    told.clear()
    maker.take_sweep("front", sweep(), np.array([100.0, 0.0, 0.0]))
    maker.settle()
    gone = {(row, col) for row, col, found in told if not found.any()}
    assert before <= gone
    kept = {(row, col): payload for row, col, payload in maker.changed_tiles()}
    assert all(kept[place] == b"" for place in before)
    again, walls = maker_of()
    again.restore([(*place, payload) for place, payload in kept.items()])
    assert set(walls.places) == {place for place, payload in kept.items() if payload}


def test_what_was_counted_goes_on_after_a_start() -> None:
    told: Told = []
    maker, walls = maker_of()
    for k in range(8):
        maker.take_sweep("front", sweep(k), np.array([0.0, 0.0, 1.1 * k * STEP_RAD]))
    maker.settle()
    kept = maker.changed_tiles()
    assert maker.changed_tiles() == []
    again, walls_again = maker_of(told)
    again.restore(kept)
    again.make(view())
    assert {(row, col) for row, col, _ in told} == set(walls.places)
    for row, col, found in told:
        np.testing.assert_array_equal(found, walls.judge((row, col)))
    with pytest.raises(ValueError, match="stored counts"):
        again.restore([(0, 0, b"rubbish")])
    assert walls_again.places == []


class Standing:
    """Draws nothing."""

    def pose(self) -> Pose2 | None:
        return None

    def drain(self) -> None:
        pass

    def map_was_replaced(self, tiles: object, slam: object) -> None:
        pass

    def begin_map(self) -> None:
        pass

    def kept_of_slam(self) -> None:
        return None


def layer() -> BuildingLayer:
    return BuildingLayer(OccupancyGrid(), ["front"], publish_period_ns=SECOND, update_period_ns=SECOND // 5)


def drawn(building: BuildingLayer, makers: MapMakers) -> None:
    """Forty noisy sweeps from places along the wall."""
    for k in range(40):
        pose = np.array([0.0, 0.12 * (k % 8), 0.02 * (k % 5)])
        building.take_sweep("front", sweep(k), pose)
        makers.take_sweep("front", sweep(k), pose)


def test_what_is_published_saved_and_restored_shows_the_walls_and_the_grid_stays_as_counted(tmp_path: Path) -> None:
    building = layer()
    maker = WallMaker(LiveWalls(resolution_m=0.05), ["front"], building.offer_walls)
    makers = MapMakers([maker], lambda _output: None, now_ns=lambda: 0)
    drawn(building, makers)
    published: list[Output] = building.outputs(None, 0, SECOND)
    counted = building.grid.patch(whole_tiles=True)
    makers.turn(PERIOD_NS)
    published += building.outputs(None, 0, 2 * SECOND)
    store = MapStore.open(tmp_path / "live.umfeld", wall_ns=lambda: 1)
    live = LiveMap(
        building, store, ask=lambda work: work(), fusion=Standing(), makers=makers, settle_walls=maker.settle
    )
    live.save("kitchen")
    shown = building.grid.patch(whole_tiles=True)
    assert np.sum(shown.cells >= 65) < np.sum(counted.cells >= 65)
    seen = np.full_like(counted.cells, -2)
    for output in published + building.outputs(None, 0, 3 * SECOND):
        assert isinstance(output, GridOut | GridUpdateOut)
        row, col = output.patch.row0 - counted.row0, output.patch.col0 - counted.col0
        rows, cols = output.patch.cells.shape
        seen[row : row + rows, col : col + cols] = output.patch.cells
    np.testing.assert_array_equal(seen, shown.cells)
    exported = occupancy_patch(store)
    row, col = exported.row0 - shown.row0, exported.col0 - shown.col0
    rows, cols = exported.cells.shape
    np.testing.assert_array_equal(exported.cells, shown.cells[row : row + rows, col : col + cols])
    again = layer()
    restore(again.grid, store)
    assert list(again.grid.tiles()) == list(building.grid.tiles())
    np.testing.assert_array_equal(again.grid.patch(whole_tiles=True).cells, counted.cells)
    maker_again = WallMaker(LiveWalls(resolution_m=0.05), ["front"], again.offer_walls)
    makers_again = MapMakers([maker_again], lambda _output: None, now_ns=lambda: 0)
    makers_again.restore(store.load_tiles)
    makers_again.turn(0)
    again.show_walls()
    np.testing.assert_array_equal(again.grid.patch(whole_tiles=True).cells, shown.cells)
    live.load("kitchen")
    makers.turn(10 * PERIOD_NS)
    building.show_walls()
    np.testing.assert_array_equal(building.grid.patch(whole_tiles=True).cells, shown.cells)
    assert {GRID, OCCUPANCY, "maker-walls"} <= store.layers().keys()
    store.close()


def test_walls_of_a_map_that_was_replaced_are_not_shown_in_the_next() -> None:
    building = layer()
    building.take_sweep("front", sweep(1), np.zeros(3))
    counted = building.grid.patch()
    building.offer_walls(0, 0, np.ones((128, 128), dtype=np.uint8))
    building.start_anew()
    building.outputs(None, 0, SECOND)
    np.testing.assert_array_equal(building.grid.patch().cells, counted.cells)


def test_makers_tiles_are_plain(tmp_path: Path) -> None:
    """As the store takes them."""
    maker, _ = maker_of()
    maker.take_sweep("front", sweep(), np.zeros(3))
    maker.settle()
    kept: list[Tile] = maker.changed_tiles()
    assert all(type(row) is int and type(col) is int and type(payload) is bytes for row, col, payload in kept)
