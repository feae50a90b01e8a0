"""What is kept to draw the map again stays bounded where a robot drives the same rooms again and again."""

from __future__ import annotations

import io
import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.localise.kept_places import BEARINGS, MOST, KeptPlaces, profile_of
from mapping.localise.kept_sweeps import KeptSweep
from mapping.localise.slam import Slam
from mapping.scan import Scan
from service.background import at_once
from service.layers import BuildingLayer
from service.redraw import GIVE_UP_AT_ONCE, Redrawer, RedrawState
from service.slam_store import Keeper, Stored, stored_of, tiles_of

F64 = NDArray[np.float64]

BEARING = np.radians(np.arange(-90.0, 91.0))
WIDE_M, DEEP_M, DOOR_M, BEHIND_M = 8.0, 6.0, 0.5, 3.0
RADIUS_M = 1.5
LAP = 90  # sweeps, each more than 0.1 m on
MOVED = np.array([[0.3, 0.1, 0.0]])


def seen(pose: Pose2, *, door_is_open: bool) -> F64:
    """Ranges in a room around the origin; behind its wall at +x, where the door is, another."""
    heading = pose.yaw_rad + BEARING
    c, s = np.cos(heading), np.sin(heading)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0.0, 0.5 * WIDE_M - pose.x_m, -0.5 * WIDE_M - pose.x_m) / c
        to_y = np.where(s > 0.0, 0.5 * DEEP_M - pose.y_m, -0.5 * DEEP_M - pose.y_m) / s
    at_door = np.abs(pose.y_m + to_x * s) < DOOR_M
    through = door_is_open & at_door & (c > 0.0) & (to_x < to_y)
    return np.asarray(np.minimum(to_x, to_y) + np.where(through, BEHIND_M / np.maximum(c, 1e-9), 0.0))


def lap_on(redrawer: Redrawer, step: int, *, door_is_open: bool = False) -> None:
    """The sweep of a step on the way round."""
    angle = 2.0 * math.pi * step / LAP
    pose = Pose2(RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), angle + 0.5 * math.pi)
    scan = Scan(step, 0.0, BEARING, seen(pose, door_is_open=door_is_open), 0.05, 10.0)
    redrawer.keep_sweep("front", scan, 0, Pose2(), np.array([[pose.x_m, pose.y_m, pose.yaw_rad]] * 2))


def drive(laps: int, *, open_on: int = -1) -> tuple[Redrawer, BuildingLayer, list[int]]:
    """Round and round; how much is kept after each lap. open_on: the lap on which the door is open."""
    layer = BuildingLayer(OccupancyGrid(), ("front",), publish_period_ns=10**9, update_period_ns=10**8)
    redrawer = Redrawer([layer], layer, {"front": Pose2()}, submit=at_once)
    kept = []
    for lap in range(laps):
        for step in range(LAP):
            lap_on(redrawer, lap * LAP + step, door_is_open=lap == open_on)
        kept.append(redrawer.kept)
    return redrawer, layer, kept


def drawn_again(redrawer: Redrawer, layer: BuildingLayer) -> OccupancyGrid:
    redrawer.corrected(0, MOVED)
    redrawer.take_up(1 << 60, MOVED)
    return layer.grid


def cells(grid: OccupancyGrid, x_m: F64, y_m: F64) -> F64:
    """Probabilities there, seen from the room; NaN is unknown."""
    return np.asarray(grid.probability_at(np.stack((x_m + MOVED[0, 0], y_m + MOVED[0, 1]), axis=-1)))


def test_fifty_laps_keep_no_more_than_five() -> None:
    redrawer, layer, kept = drive(50)
    assert kept[0] == LAP
    assert max(kept) < 5 * LAP
    assert max(kept[12:]) <= kept[11] + GIVE_UP_AT_ONCE  # flat, but for what goes together
    assert redrawer.counts["map.given_up_sweeps"] > 40 * LAP
    assert len(redrawer.state().kept) == kept[-1]
    stamps = {kept.stamp_ns for kept in redrawer.state().kept if isinstance(kept, KeptSweep)}
    assert stamps >= set(range(49 * LAP, 50 * LAP))  # the newest lap
    grid = drawn_again(redrawer, layer)
    along = np.linspace(-2.9, 2.9, 59)
    assert np.min(cells(grid, np.full(59, 0.5 * WIDE_M + 0.01), along)) > 0.65  # the wall is whole
    inside = cells(grid, *(v.ravel() for v in np.meshgrid(np.linspace(-3.8, 3.8, 20), np.linspace(-2.8, 2.8, 20))))
    assert np.max(inside) < 0.35
    assert not np.any(cells(grid, np.full(59, 0.5 * WIDE_M + 0.2), along) < 0.5)  # and behind it nothing is free


def test_what_was_seen_through_a_door_once_is_not_forgotten() -> None:
    redrawer, layer, _ = drive(30, open_on=3)
    through = np.array([4.5, 5.5]), np.array([0.0, 0.0])
    assert np.all(cells(drawn_again(redrawer, layer), *through) < 0.5)  # of the room behind
    redrawer, layer, _ = drive(30)
    assert np.all(np.isnan(cells(drawn_again(redrawer, layer), *through)))


def test_what_is_kept_may_go_while_the_map_is_drawn_again() -> None:
    redrawer, layer, _ = drive(4)
    redrawer.corrected(0, MOVED)  # a job is under way: nothing moves up in the list
    before = redrawer.kept
    for step in range(2 * LAP):
        pose = Pose2(0.11 * step, 0.0)
        scan = Scan(10**6 + step, 0.0, BEARING, seen(Pose2(), door_is_open=False), 0.05, 10.0)
        redrawer.keep_sweep("front", scan, 0, Pose2(*MOVED[0].tolist()), np.array([[pose.x_m, 0.0, 0.0]] * 2))
    assert redrawer.kept == before + 2 * LAP
    redrawer.take_up(1 << 60, MOVED)
    assert not redrawer.is_due(1 << 60)
    assert redrawer.kept <= before + 2 * LAP
    wall = cells(layer.grid, np.full(20, -0.5 * WIDE_M - 0.01), np.linspace(-2.5, 2.5, 20))
    assert np.min(wall) > 0.65


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-9.0, 9.0)), max_size=200))
def test_a_place_never_holds_more_than_its_share(poses: list[tuple[float, float, float]]) -> None:
    places, known = KeptPlaces(), set[int]()
    for serial, pose in enumerate(poses):
        profile = np.full(BEARINGS, float(serial % 7), dtype=np.float32)
        gone = places.add(serial, "front", np.array(pose), profile)
        assert set(gone) <= known
        assert serial not in gone
        known = (known | {serial}) - set(gone)
    assert len(places) == len(known)
    cell = [
        (math.floor(x / 0.5), math.floor(y / 0.5), math.floor(yaw / math.pi * 4.0 + 0.5) % 8) for x, y, yaw in poses
    ]
    for at in set(cell):
        assert sum(cell[serial] == at for serial in known) <= MOST
    places.move(list(known), np.zeros((len(known), 3)))
    gone = places.add(10**6, "front", np.zeros(3), None)
    assert len(places) == min(len(known) + 1, MOST)
    assert len(gone) == max(0, len(known) + 1 - MOST)


def test_a_profile_tells_the_farthest_of_each_direction() -> None:
    bearing = np.array([0.0, 0.01, math.pi, -0.5 * math.pi, 0.5 * math.pi])
    profile = profile_of(bearing, np.array([2.0, 3.0, math.inf, math.nan, -math.inf]), 0.5 * math.pi + 0.02)
    assert profile[BEARINGS // 4] == 3.0
    assert profile[3 * BEARINGS // 4] > 1e30
    assert np.count_nonzero(profile) == 2


def test_what_was_given_up_goes_from_the_store_too() -> None:
    slam, at_first, later = Slam(), drive(10)[0], drive(10)
    for step in range(3):
        pose = Pose2(0.4 * step, 0.0)
        slam.add_scan(Scan(step, 0.0, BEARING, seen(pose, door_is_open=False), 0.05, 10.0), odom_from_base=pose)
    keeper, store = Keeper(), dict[tuple[int, int], bytes]()

    def save(redrawer: Redrawer, keeper: Keeper) -> int:
        tiles = keeper.changed_tiles(Stored(slam.state(), redrawer.state()))
        store.update({(row, number): payload for row, number, payload in tiles})
        return sum(row == 2 for row, _, _ in tiles)

    def restored() -> RedrawState:
        stored = stored_of([(row, number, payload) for (row, number), payload in store.items()])
        assert stored is not None
        return stored.redraw

    save(at_first, keeper)
    assert save(at_first, keeper) == 0
    for step in range(3 * LAP):  # goes on: the oldest tiles change, and new ones come
        lap_on(at_first, 10 * LAP + step)
    assert 0 < save(at_first, keeper) < 12
    for redrawer, writer in ((at_first, keeper), (later[0], Keeper())):
        if redrawer is not at_first:
            store.clear()  # another map
        save(redrawer, writer)
        state = restored()
        np.testing.assert_array_equal(state.serials, redrawer.state().serials)
        assert [each.in_key.tolist() for each in state.kept] == [each.in_key.tolist() for each in redrawer.state().kept]
    again = Redrawer([later[1]], later[1], {"front": Pose2()}, submit=at_once)
    again.resume(state)
    lap_on(again, 10 * LAP)
    lap_on(later[0], 10 * LAP)
    np.testing.assert_array_equal(again.state().serials, later[0].state().serials)
    save(again, Keeper())
    assert len(restored().kept) == again.kept


def test_maps_that_were_stored_before_anything_was_given_up_are_read() -> None:
    redrawer, slam = drive(1)[0], Slam()
    slam.add_scan(Scan(0, 0.0, BEARING, seen(Pose2(), door_is_open=False), 0.05, 10.0))
    tiles = []
    for row, number, payload in tiles_of(Stored(slam.state(), redrawer.state())):
        arrays = dict(np.load(io.BytesIO(payload))) if row == 1 else {}
        if arrays:
            del arrays["serials"], arrays["next_serial"]
            out = io.BytesIO()
            np.savez(out, **arrays)
            payload = out.getvalue()
        tiles.append((row, number, payload))
    stored = stored_of(tiles)
    assert stored is not None
    assert stored.redraw.next_serial == LAP == len(stored.redraw.kept)
    np.testing.assert_array_equal(stored.redraw.serials, np.arange(LAP))
