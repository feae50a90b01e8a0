"""Sector map to grid (S39): tiles, arcs and cones against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.sectors.polar import sector_edges
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from mapping.sectors.to_grid import obstacle_tiles, robot_cells, world_cells

OBSTACLE, FREE, UNKNOWN, STALE = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE


def sectors(
    state: list[SectorState], distance: list[float], *, pose: Pose2 = IDENTITY, start: float = 0.0, width: float = 0.1
) -> PolarSnapshot:
    count = len(state)
    edges = sector_edges(start_rad=start, stop_rad=start + width * count, sector_rad=width)
    nothing = np.full(count, np.nan)
    return PolarSnapshot(
        0, pose, edges, np.array(state, dtype=np.int8), np.array(distance), nothing, nothing,
        np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int16), ("laser",),
    )  # fmt: skip


def as_set(cells: NDArray[np.int64]) -> set[tuple[int, int]]:
    return {(int(row), int(col)) for row, col in cells}


def test_tiles_count_the_position_once() -> None:
    # Robot at (10.3, -4.2), wall 2 m ahead, 1 m tiles: at 12.3 in x, that is 2 tiles on, and in the same row.
    tiles = obstacle_tiles(
        position_m=(10.3, -4.2), heading_rad=0.0, distance_m=2.0, bearing_rad=0.0, width_rad=1e-6, resolution_m=1.0
    )
    np.testing.assert_array_equal(tiles, [[0, 2]] * 3)


def test_three_tiles_of_a_wide_sector() -> None:
    tiles = obstacle_tiles(
        position_m=(0.5, 0.5), heading_rad=math.pi / 2.0, distance_m=4.0, bearing_rad=0.0, width_rad=math.pi / 2.0,
        resolution_m=1.0,
    )  # fmt: skip
    np.testing.assert_array_equal(tiles, [[4, 0], [3, -3], [3, 3]])


def test_a_border_of_a_tile_belongs_to_the_next() -> None:
    tiles = obstacle_tiles(
        position_m=(0.0, 0.0), heading_rad=0.0, distance_m=3.0, bearing_rad=0.0, width_rad=0.0, resolution_m=1.0
    )
    np.testing.assert_array_equal(tiles, [[0, 3]] * 3)


def test_unknown_and_stale_give_nothing() -> None:
    hits, frees = robot_cells(sectors([UNKNOWN, STALE, STALE], [math.nan, 1.0, math.nan]), resolution_m=0.1)
    assert hits.shape == (0, 2)
    assert frees.shape == (0, 2)


def test_a_full_circle_covers_its_area_and_its_rim() -> None:
    count = 72
    snapshot = sectors([OBSTACLE] * count, [2.0] * count, start=-math.pi, width=2.0 * math.pi / count)
    hits, frees = robot_cells(snapshot, resolution_m=0.05)
    # A circle about a corner of the grid crosses 2 r / d lines in x twice and in y twice: 8 r / d cells.
    assert len(hits) == pytest.approx(8 * 2.0 / 0.05, abs=8)
    assert len(frees) * 0.05**2 == pytest.approx(math.pi * 4.0, rel=0.06)
    assert not as_set(hits) & as_set(frees)
    away = np.hypot(frees[:, 0] + 0.5, frees[:, 1] + 0.5) * 0.05
    assert away.max() < 2.0


poses = st.builds(Pose2, st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-3.2, 3.2))


@settings(max_examples=60, deadline=None)
@given(poses, poses, st.floats(0.02, 6.0), st.floats(-3.2, 3.2), st.floats(0.02, 1.5))
def test_hits_are_the_whole_arc_and_nothing_else(
    base: Pose2, sensor: Pose2, distance: float, start: float, width: float
) -> None:
    snapshot = sectors([OBSTACLE], [distance], pose=sensor, start=start, width=width)
    hits = as_set(world_cells(snapshot, base, resolution_m=0.1)[0])
    angle = np.linspace(start, start + width, 4001)
    arc = (base @ sensor).apply(distance * np.stack((np.cos(angle), np.sin(angle)), axis=-1))
    away = np.abs(arc / 0.1 - np.round(arc / 0.1)).min(axis=1) > 1e-6  # off the lines, where rounding decides
    sampled = as_set(np.floor(arc[away][:, ::-1] / 0.1).astype(np.int64))
    assert sampled <= hits
    for row, col in hits - sampled:  # cells the sampling stepped over are clipped at a corner
        gap = np.abs(arc - [(col + 0.5) * 0.1, (row + 0.5) * 0.1]).max(axis=1).min()
        assert gap < 0.05 + distance * width / 4000.0
    world = base @ sensor
    tiles = obstacle_tiles(
        position_m=(world.x_m, world.y_m), heading_rad=world.yaw_rad, distance_m=distance,
        bearing_rad=start + 0.5 * width, width_rad=width * (1.0 - 1e-6), resolution_m=0.1,
    )  # fmt: skip
    own = np.array([math.floor(world.y_m / 0.1), math.floor(world.x_m / 0.1)])
    for tile in tiles + own:
        assert any(abs(tile[0] - row) + abs(tile[1] - col) <= 1 for row, col in hits)


@settings(max_examples=40, deadline=None)
@given(
    poses,
    st.floats(-3.2, 3.2),
    st.lists(st.tuples(st.sampled_from(SectorState), st.floats(0.1, 3.0)), min_size=1, max_size=6),
)
def test_frees_lie_in_sectors_that_know(base: Pose2, start: float, content: list[tuple[SectorState, float]]) -> None:
    snapshot = sectors([s for s, _ in content], [r for _, r in content], start=start, width=0.7)
    hits, frees = world_cells(snapshot, base, resolution_m=0.1)
    assert not as_set(hits) & as_set(frees)
    own = base.inverse().apply((frees[:, ::-1] + 0.5) * 0.1)
    sector = (((np.arctan2(own[:, 1], own[:, 0]) - start) % (2.0 * math.pi)) / 0.7 + 1e-6).astype(int)
    sector[sector == int(2.0 * math.pi / 0.7)] %= max(1, len(content))
    for k, distance in zip(sector, np.hypot(own[:, 0], own[:, 1])):
        assert content[k][0] in (OBSTACLE, FREE)
        assert distance < content[k][1]


def test_reach_limits_what_is_transferred() -> None:
    hits, frees = world_cells(sectors([FREE, OBSTACLE], [30.0, 5.0]), IDENTITY, resolution_m=0.1, reach_m=2.0)
    assert len(hits) == 0
    assert np.hypot(frees[:, 0], frees[:, 1]).max() < 20.0
    with pytest.raises(ValueError, match="reach_m"):
        world_cells(sectors([FREE], [1e6]), IDENTITY, resolution_m=0.01)
