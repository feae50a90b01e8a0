"""Virtual sensors fed by a grid (S38)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from mapping.sectors.virtual import polar_from_grid, probe_path

OBSTACLE, FREE, UNKNOWN = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN
MIDDLE = Pose2(0.025, 0.025, 0.0)


def grid(fill: int = 0) -> NDArray[np.int8]:
    return np.full((200, 200), fill, dtype=np.int8)  # 10 m at 5 cm, centred


def look(cells: NDArray[np.int8], pose: Pose2 = MIDDLE, *, range_max_m: float = 3.0) -> PolarSnapshot:
    patch = GridPatch(0.05, -100, -100, cells)
    return polar_from_grid(
        patch, pose, start_rad=-math.pi, stop_rad=math.pi, sector_rad=math.radians(5.0), range_max_m=range_max_m,
        stamp_ns=9,
    )  # fmt: skip


def at(snapshot: PolarSnapshot, degrees: float) -> int:
    return int(np.searchsorted(snapshot.edges_rad, math.radians(degrees), side="right")) - 1


def test_all_free_is_free_to_the_range() -> None:
    snapshot = look(grid())
    assert (snapshot.state == FREE).all()
    assert (snapshot.distance_m == 3.0).all()
    assert snapshot.stamp_ns == 9


@pytest.mark.parametrize("value", [-1, 50])
def test_one_cell_nobody_knows_blocks_its_sectors(value: int) -> None:
    cells = grid()
    cells[100, 140] = value
    snapshot = look(cells)
    half = math.degrees(math.atan2(0.025, 2.0 - 0.025))
    blocked = {at(snapshot, -half), at(snapshot, half)}
    assert set(np.flatnonzero(snapshot.state == UNKNOWN).tolist()) == blocked
    assert np.isnan(snapshot.distance_m[list(blocked)]).all()


def test_a_wall_is_met_at_its_near_edge() -> None:
    cells = grid()
    cells[:, 140] = 100
    snapshot = look(cells)
    for degrees in (1.0, 20.0, 40.0):
        k = at(snapshot, degrees)
        assert snapshot.state[k] == OBSTACLE
        nearest = min(abs(snapshot.edges_rad[k]), abs(snapshot.edges_rad[k + 1]))
        assert snapshot.distance_m[k] == pytest.approx(1.975 / math.cos(nearest), abs=1e-9)
    assert snapshot.state[at(snapshot, 120.0)] == FREE


@pytest.mark.parametrize(("near", "far", "wanted"), [(100, -1, OBSTACLE), (-1, 100, UNKNOWN)])
def test_the_nearest_cell_that_is_not_free_decides(near: int, far: int, wanted: SectorState) -> None:
    cells = grid()
    cells[80:120, 120], cells[80:120, 130] = near, far
    assert look(cells).state[at(look(cells), 2.0)] == wanted


def test_outside_the_patch_is_unknown() -> None:
    assert (look(grid(), range_max_m=4.9).state == FREE).all()
    beyond = look(grid(), range_max_m=6.0)
    assert beyond.state[at(beyond, 1.0)] == UNKNOWN
    assert beyond.state[at(beyond, 46.0)] == FREE  # the corner is 7 m away
    assert (look(grid(), Pose2(20.0, 0.0, 0.0)).state == UNKNOWN).all()
    edge = look(grid(), Pose2(4.0, 0.0, 0.0))
    assert edge.state[at(edge, 1.0)] == UNKNOWN
    assert edge.state[at(edge, 179.0)] == FREE


def test_the_ground_under_the_vehicle_may_be_unknown() -> None:
    cells = grid()
    cells[97:104, 97:104] = -1
    patch = GridPatch(0.05, -100, -100, cells)
    body = [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]]
    assert (look(cells).state == UNKNOWN).all()
    snapshot = polar_from_grid(patch, MIDDLE, range_max_m=3.0, stamp_ns=0, footprint=body)
    assert (snapshot.state == FREE).all()
    ahead = at(snapshot, 1.0)
    assert snapshot.clearance_m[ahead] == pytest.approx(3.0 - 0.45 / math.cos(math.radians(5.0)))


def test_an_obstacle_on_the_sensor_is_everywhere() -> None:
    cells = grid()
    cells[100, 100] = 100
    snapshot = look(cells)
    assert (snapshot.state == OBSTACLE).all()
    assert (snapshot.distance_m == 0.0).all()


def test_yaw_turns_the_sectors() -> None:
    cells = grid()
    cells[:, 140] = 100
    turned = look(cells, Pose2(0.025, 0.025, math.pi / 2.0))
    assert turned.state[at(turned, -89.0)] == OBSTACLE
    assert turned.state[at(turned, 1.0)] == FREE


def test_a_probe_meets_the_wall_as_it_goes() -> None:
    cells = grid()
    cells[:, 160] = 100
    path = [Pose2(x, 0.025, 0.0) for x in (0.0, 1.0, 2.0)]
    found = probe_path(GridPatch(0.05, -100, -100, cells), path, range_max_m=3.5, stamp_ns=0)
    np.testing.assert_allclose([s.distance_m[at(s, 1.0)] for s in found], [3.0, 2.0, 1.0])
    assert [s.base_from_sensor for s in found] == path


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError):
        look(grid(), range_max_m=math.inf)
    with pytest.raises(ValueError):
        polar_from_grid(GridPatch(0.05, 0, 0, grid()), MIDDLE, range_max_m=1.0, stamp_ns=0, free_to=70)
