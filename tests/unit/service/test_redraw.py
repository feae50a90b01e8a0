"""Drawing the map again: what is kept, which tiles are replaced, and what they hold then."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.rolling import RollingGrid
from mapping.localise.kept_sweeps import kept_sweep
from mapping.scan import Scan
from service.background import Background, at_once
from service.fusion import Cone, Round, Touch
from service.kept_rounds import KeptTouch
from service.layers import BuildingLayer, RollingLayer, insert_sweep
from service.redraw import DELAY_NS, DELAY_NS_PER_KEPT, Redrawer
from service.sensors import Switch
from service.slam_store import _kept_of, _kept_tile, _mounts_of, _unpack
from tests.waiting import GIVE_UP_S

F64 = NDArray[np.float64]
T = TypeVar("T")

SECOND = 1_000_000_000
BEARING = np.linspace(-math.pi, math.pi, 361)
MOUNT = Pose2(0.2, 0.0, 0.3)
FAR_KEY = 1  # of the key scans below: 40 m from the other
KEYS = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.5]])


def building(*sources: str) -> BuildingLayer:
    return BuildingLayer(OccupancyGrid(), sources or ("front",), publish_period_ns=SECOND, update_period_ns=SECOND // 5)


def room(reach_m: float = 2.0) -> Scan:
    return Scan(0, 0.0, BEARING, np.full(len(BEARING), reach_m), 0.05, 10.0)


def ends_at(key: int, x_m: float, y_m: float = 0.0) -> F64:
    pose = Pose2(*KEYS[key].tolist()) @ Pose2(x_m, y_m)
    return np.array([[pose.x_m, pose.y_m, pose.yaw_rad]] * 2)


def draw_and_keep(redrawer: Redrawer, layer: BuildingLayer, key: int, x_m: float) -> None:
    """As fusion does."""
    ends = ends_at(key, x_m)
    redrawer.keep_sweep("front", room(), key, Pose2(*KEYS[key].tolist()), ends)
    pose = Pose2(*ends[0].tolist()) @ MOUNT
    layer.take_sweep("front", room(), np.array([pose.x_m, pose.y_m, pose.yaw_rad]))


def redrawer_of(
    layer: BuildingLayer, *others: RollingLayer, submit: Callable[[Callable[[], T]], Future[T]] = at_once
) -> Redrawer:
    return Redrawer([layer, *others], layer, {"front": MOUNT}, submit=submit)  # type: ignore[arg-type]


def due_ns(redrawer: Redrawer) -> int:
    return DELAY_NS + DELAY_NS_PER_KEPT * redrawer.kept


def moved_keys(x_m: float) -> F64:
    keys = KEYS.copy()
    keys[FAR_KEY, 0] += x_m
    return keys


def drawn_afresh(keys: F64, places: list[tuple[int, float]]) -> OccupancyGrid:
    grid = OccupancyGrid()
    for key, x_m in places:
        pose = Pose2(*keys[key].tolist()) @ Pose2(x_m, 0.0) @ MOUNT
        insert_sweep(grid, room(), np.array([pose.x_m, pose.y_m, pose.yaw_rad]))
    return grid


PLACES = [(0, 0.0), (0, 0.5), (FAR_KEY, 0.0), (FAR_KEY, 0.5)]


def test_what_moved_is_drawn_where_it_is_now_and_the_rest_stays() -> None:
    layer = building()
    redrawer = redrawer_of(layer)
    for key, x_m in PLACES:
        draw_and_keep(redrawer, layer, key, x_m)
    layer.grid.insert_scan(Pose2(), BEARING, np.full(361, 1.0), range_max_m=10.0)  # not kept, in the part that stays
    before = {(row, col): payload for row, col, payload in layer.grid.tiles()}
    redrawer.corrected(0, moved_keys(3.0))
    assert not redrawer.is_due(due_ns(redrawer) - 1)
    assert redrawer.is_due(due_ns(redrawer))
    redrawer.take_up(due_ns(redrawer), moved_keys(3.0))
    wanted = {(r, c): p for r, c, p in drawn_afresh(moved_keys(3.0), PLACES).tiles()}
    touched = {(tile.tile_row, tile.tile_col): tile for tile in layer.grid.changed_tiles()}
    for row, col, payload in layer.grid.tiles():
        if col < 3:
            assert payload == before[row, col]  # round the first key nothing was touched
        elif (row, col) in wanted:
            assert payload == wanted[row, col]
        else:
            assert not touched[row, col].cells.any()
    assert not redrawer.is_due(1 << 60)  # nothing is left to move


def test_a_sweep_that_says_nothing_is_no_step_of_the_way() -> None:
    """Sweeps of a laser that is blinded for a moment kept those away that came when it saw again."""
    layer = building()
    redrawer = redrawer_of(layer)
    blind, key_pose = replace(room(), range_m=np.full(len(BEARING), math.nan)), Pose2(*KEYS[0].tolist())
    redrawer.keep_sweep("front", blind, 0, key_pose, ends_at(0, 0.0))
    assert redrawer.kept == 0
    redrawer.keep_sweep("front", room(), 0, key_pose, ends_at(0, 0.01))
    assert redrawer.kept == 1
    nothing_there = replace(room(), range_m=np.full(len(BEARING), math.inf))
    redrawer.keep_sweep("front", nothing_there, 0, key_pose, ends_at(0, 0.5))
    assert redrawer.kept == 2, "nothing seen is something said"


def test_small_shifts_are_let_be_until_they_add_up() -> None:
    layer = building()
    redrawer = redrawer_of(layer)
    for key, x_m in PLACES:
        draw_and_keep(redrawer, layer, key, x_m)
    redrawer.corrected(0, moved_keys(0.008))
    assert not redrawer.is_due(1 << 60)
    redrawer.corrected(0, moved_keys(0.016))
    assert redrawer.is_due(1 << 60)


def test_what_was_drawn_meanwhile_is_there_afterwards() -> None:
    layer = building()
    redrawer = redrawer_of(layer)
    draw_and_keep(redrawer, layer, FAR_KEY, 0.0)
    redrawer.corrected(0, moved_keys(0.5))
    redrawer.keep_sweep("front", room(), FAR_KEY, Pose2(*moved_keys(0.5)[FAR_KEY].tolist()), ends_at(FAR_KEY, 1.5))
    redrawer.take_up(1 << 60, moved_keys(0.5))
    pose = Pose2(*ends_at(FAR_KEY, 1.5)[0].tolist()) @ MOUNT
    hit = pose.apply(np.array([[2.0, 0.0]]))[0]
    patch = layer.grid.patch()
    row, col = math.floor(hit[1] / 0.05) - patch.row0, math.floor(hit[0] / 0.05) - patch.col0
    assert patch.cells[row - 1 : row + 2, col - 1 : col + 2].max() >= 50


def test_tiles_of_earlier_runs_lie_under_what_is_drawn_anew() -> None:
    old = building()
    old.grid.insert_scan(Pose2(41.0, 0.0), BEARING, np.full(361, 3.0), range_max_m=10.0)
    layer = building()
    for row, col, payload in old.grid.tiles():
        layer.grid.load_tile(row, col, payload)
    redrawer = redrawer_of(layer)
    redrawer.start_over(old.grid.tiles())
    draw_and_keep(redrawer, layer, FAR_KEY, 0.0)
    redrawer.corrected(0, moved_keys(0.3))
    redrawer.take_up(1 << 60, moved_keys(0.3))
    patch, was = layer.grid.patch(whole_tiles=True), old.grid.patch(whole_tiles=True)
    rows, cols = was.row0 - patch.row0, was.col0 - patch.col0
    now = patch.cells[rows : rows + was.cells.shape[0], cols : cols + was.cells.shape[1]]
    assert np.mean(now[was.cells >= 65] >= 50) > 0.7  # a beam of the new sweep passed through the rest


def test_the_grid_around_the_robot_moves_at_once() -> None:
    layer = building()
    local = RollingLayer("local", RollingGrid(side_m=8.0), {"front"}, period_ns=1)
    redrawer = redrawer_of(layer, local)
    draw_and_keep(redrawer, layer, FAR_KEY, 0.0)
    redrawer.corrected(0, moved_keys(3.0))
    pose = Pose2(*moved_keys(3.0)[FAR_KEY].tolist()) @ MOUNT
    alone = RollingGrid(side_m=8.0)
    alone.centre_on(pose.x_m, pose.y_m)
    insert_sweep(alone, room(), np.array([pose.x_m, pose.y_m, pose.yaw_rad]))
    np.testing.assert_array_equal(local.grid.patch().cells, alone.patch().cells)


def test_sonar_rounds_move_too() -> None:
    layer = building("front", "ring")
    redrawer = redrawer_of(layer)
    for step in range(4):  # an echo must be heard more than once
        ends = ends_at(FAR_KEY, 0.12 * step)
        pose = Pose2(*ends[0].tolist())
        heard = Round(step, (Cone(1, Pose2(), 1.5 - 0.12 * step),), 0.5, 0.1, 3.0)
        redrawer.keep_round("ring", heard, FAR_KEY, Pose2(*KEYS[FAR_KEY].tolist()), pose)
        layer.take_round("ring", heard, pose)
    before = layer.grid.patch().cells.copy()
    keys = KEYS.copy()
    keys[FAR_KEY, :2] += (0.05 * 128, 0.0)  # by a tile
    redrawer.corrected(0, keys)
    redrawer.take_up(1 << 60, keys)
    np.testing.assert_array_equal(layer.grid.patch().cells, before)
    assert layer.grid.patch().col0 > 40.0 / 0.05 + 64


def test_what_was_touched_moves_too_and_is_stored() -> None:
    layer = building("front", "bumper")
    redrawer = redrawer_of(layer)
    touch = Touch(7, Switch(3, Pose2(0.3, 0.0), 0.2), True)
    pose = Pose2(*ends_at(FAR_KEY, 0.0)[0].tolist())
    redrawer.keep_touch("bumper", touch, FAR_KEY, Pose2(*KEYS[FAR_KEY].tolist()), pose)
    layer.take_touch("bumper", touch, pose)
    redrawer.corrected(0, moved_keys(1.0))
    redrawer.take_up(1 << 60, moved_keys(1.0))
    moved = Pose2(*moved_keys(1.0)[FAR_KEY].tolist())
    alone = building("bumper")
    alone.take_touch("bumper", touch, moved)
    felt = moved.apply(np.array([[0.325, 0.0]]))
    np.testing.assert_array_equal(layer.grid.probability_at(felt), alone.grid.probability_at(felt))
    assert layer.grid.probability_at(felt)[0] > 0.65
    assert not layer.grid.probability_at(pose.apply(np.array([[0.325, 0.0]])))[0] > 0.5  # NaN: unknown
    (kept,) = redrawer.state().kept
    assert isinstance(kept, KeptTouch)
    (again,) = _kept_of(_unpack(_kept_tile([kept])), {})
    assert isinstance(again, KeptTouch)
    assert (again.sensor, again.key, again.heard) == (kept.sensor, kept.key, kept.heard)


@pytest.mark.parametrize("told", [True, False])  # stores of before do not tell where the laser sat; their keys do
def test_a_mount_that_is_put_right_moves_nothing_that_was_seen(told: bool) -> None:
    layer = building()
    redrawer = redrawer_of(layer)
    draw_and_keep(redrawer, layer, 0, 0.5)
    draw_and_keep(redrawer, layer, FAR_KEY, 0.0)
    state = redrawer.state()
    assert list(state.mounts) == ["front"]
    if not told:
        mounts = np.broadcast_to(state.mounts["front"], (2, 3))
        state = replace(state, mounts=_mounts_of({}, state.kept, mounts))

    right = Pose2(0.12, -0.04, 0.3 - math.radians(5.0))
    later = Redrawer([layer], layer, {"front": right}, submit=at_once)
    later.resume(state)
    for before, after in zip(redrawer.sweeps(), later.sweeps()):
        np.testing.assert_allclose(after()[2], before()[2], atol=1e-9)
    later.corrected(0, KEYS)
    assert not later.is_due(1 << 60)  # nothing has moved
    later.corrected(0, moved_keys(1.0))
    later.take_up(1 << 60, moved_keys(1.0))
    np.testing.assert_array_equal(
        layer.grid.patch().cells, drawn_afresh(moved_keys(1.0), [(0, 0.5), (FAR_KEY, 0.0)]).patch().cells
    )
    np.testing.assert_array_equal(later.state().mounts["front"], [right.x_m, right.y_m, right.yaw_rad])


def test_where_lasers_sat_is_not_guessed_of_several() -> None:
    redrawer = redrawer_of(layer := building())
    draw_and_keep(redrawer, layer, 0, 0.5)
    kept = redrawer.state().kept
    assert _mounts_of({}, kept, np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])) == {}
    assert _mounts_of({}, kept, np.zeros((0, 3))) == {}


def test_a_job_that_fails_leaves_the_map_and_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    def broken(_work: Callable[[], T], /) -> Future[T]:
        future: Future[T] = Future()
        future.set_exception(RuntimeError("planted"))
        return future

    layer = building()
    redrawer = redrawer_of(layer, submit=broken)
    draw_and_keep(redrawer, layer, FAR_KEY, 0.0)
    before = list(layer.grid.tiles())
    redrawer.corrected(0, moved_keys(1.0))
    redrawer.take_up(1 << 60, moved_keys(1.0))
    assert list(layer.grid.tiles()) == before
    assert redrawer.counts["map.redraw_errors"] == 1
    assert "planted" in caplog.text


def test_every_kept_sweep_is_told_where_it_lies() -> None:
    layer = building()
    redrawer = redrawer_of(layer)
    told: list[tuple[str, Scan, F64]] = []
    redrawer.on_redrawn = lambda sweeps: told.extend(make() for make in sweeps)
    for key, x_m in PLACES:
        draw_and_keep(redrawer, layer, key, x_m)
    redrawer.corrected(0, moved_keys(1.0))
    redrawer.take_up(1 << 60, moved_keys(1.0))
    assert len(told) == 4
    wanted = Pose2(*moved_keys(1.0)[FAR_KEY].tolist()) @ Pose2(0.5, 0.0) @ MOUNT
    np.testing.assert_allclose(told[3][2][0], (wanted.x_m, wanted.y_m, wanted.yaw_rad), atol=1e-9)


@given(
    st.lists(
        st.one_of(st.floats(0.001, 64.9), st.sampled_from([math.inf, -math.inf, math.nan, 70.0])),
        min_size=1,
        max_size=50,
    )
)
def test_ranges_come_back_to_a_millimetre_and_never_longer_than_seen(ranges: list[float]) -> None:
    scan = Scan(5, 0.0, np.linspace(-1.0, 1.0, len(ranges)), np.array(ranges), 0.05, 100.0)
    again = kept_sweep("front", scan, key=0, in_key=np.zeros((2, 3))).scan()
    for was, now in zip(ranges, again.range_m):
        if math.isfinite(was) and was < 65.0:
            assert abs(now - was) <= 5.01e-4
        elif was == 70.0:
            assert now == math.inf  # nothing up to where it was looked
            assert again.range_max_m <= 65.0
        else:
            assert now == was or (math.isnan(now) and math.isnan(was))


def test_threads_beside_do_what_is_submitted_and_end() -> None:
    background = Background(threads=2)
    futures = [background.submit(lambda k=k: 10 // k) for k in (1, 2, 0)]  # type: ignore[misc]
    assert [futures[0].result(GIVE_UP_S), futures[1].result(GIVE_UP_S)] == [10, 5]
    assert isinstance(futures[2].exception(GIVE_UP_S), ZeroDivisionError)
    assert background.stop(GIVE_UP_S)
