"""Lines that are no more: what is cut out of a line map, and above all what is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor
from mapping.lines.gone import LOOKS, Doubts
from mapping.lines.line_map import LineMap

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-135.0, 135.01, 0.5))
WALL_Y_M, FAR_Y_M = 2.0, 4.0
DOOR = (1.0, 2.0)
GLASS_RAD = math.radians(5.0)


def sweep(at: Pose2, *, door: str = "open", seed: int = 0, far: bool = True, bearing: F64 = BEARING) -> F64:
    """Ranges of a wall along y = 2 with a door in it and a wall along y = 4 behind, from below; +inf: no echo.

    door: "open", "shut", or "glass" (shut, and answering within 5 degrees of the perpendicular only).
    """
    angle = bearing + at.yaw_rad
    up = np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.where(up > 1e-6, (WALL_Y_M - at.y_m) / up, np.inf)
        behind = np.where(up > 1e-6, (FAR_Y_M - at.y_m) / up, np.inf) if far else np.full(len(up), np.inf)
        x = at.x_m + near * np.cos(angle)
    in_door = (x > DOOR[0]) & (x < DOOR[1])
    through = {"open": in_door, "shut": np.zeros_like(in_door), "glass": in_door & (up < math.cos(GLASS_RAD))}[door]
    reach = np.where(through, behind, near)
    reach = reach + np.random.default_rng(seed).normal(0.0, 0.01, len(reach))
    return np.where(reach > 12.0, np.inf, reach)


def wall_map() -> LineMap:
    line_map = LineMap()
    for k, x in enumerate(np.arange(-2.0, 3.0, 0.5).tolist()):
        at = Pose2(x, 0.0, math.pi / 2)
        line_map.insert(LineExtractor(BEARING).extract(sweep(at, door="shut", seed=k)), at)
    return line_map


def covered(line_map: LineMap, x_m: float) -> bool:
    """Whether a line of the map passes (x, 2)."""
    lines = line_map.lines()
    low, high = np.minimum(lines.start_m, lines.end_m), np.maximum(lines.start_m, lines.end_m)
    near = np.abs(0.5 * (lines.start_m + lines.end_m)[:, 1] - WALL_Y_M) < 0.1
    return bool(np.any(near & (low[:, 0] <= x_m) & (high[:, 0] >= x_m)))


def test_an_opened_door_is_cut_out_and_the_wall_beside_it_stays() -> None:
    line_map, doubts = wall_map(), Doubts()
    assert all(covered(line_map, x) for x in (-1.0, 0.9, 1.5, 2.1))
    length = float(line_map.lines().length_m.sum())
    changed = 0
    for k, x in enumerate(np.arange(-1.0, 4.0, 0.05).tolist()):
        at = Pose2(x, 0.0, 0.3)
        changed += doubts.look(line_map, BEARING, sweep(at, seed=k), at)
    assert changed > 0
    assert not any(covered(line_map, x) for x in np.arange(1.15, 1.9, 0.1).tolist())
    assert all(covered(line_map, x) for x in (-1.0, 0.85, 2.15, 2.5))
    assert length - float(line_map.lines().length_m.sum()) == pytest.approx(1.0, abs=0.25)


def test_a_robot_that_stands_before_the_door_sees_it_too() -> None:
    line_map, doubts = wall_map(), Doubts()
    at = Pose2(1.5, 0.0, 1.0)
    for k in range(LOOKS + 1):
        doubts.look(line_map, BEARING, sweep(at, seed=k), at)
    assert not covered(line_map, 1.5)
    assert covered(line_map, 0.9)
    assert covered(line_map, 2.1)


def test_beams_in_any_order_say_the_same() -> None:
    cut = []
    order = np.random.default_rng(3).permutation(len(BEARING))
    for chosen in (np.arange(len(BEARING)), np.arange(len(BEARING))[::-1], order):
        line_map, doubts = wall_map(), Doubts()
        for k in range(30):
            at = Pose2(0.5 + 0.05 * k, 0.0, 0.3)
            doubts.look(line_map, BEARING[chosen], sweep(at, seed=k)[chosen], at)
        cut.append(line_map.lines().rows)
    np.testing.assert_array_equal(cut[0], cut[1])
    np.testing.assert_array_equal(cut[0], cut[2])


@pytest.mark.parametrize("door", ["shut", "glass"])
@pytest.mark.parametrize("y_m", [0.0, 1.0, -3.0])
def test_walls_and_glass_stay_however_often_they_are_passed(door: str, y_m: float) -> None:
    line_map, doubts = wall_map(), Doubts()
    before = line_map.version
    for lap in range(3):
        for k, x in enumerate(np.arange(-1.0, 4.0, 0.05).tolist()):
            at = Pose2(x, y_m, 0.3)
            assert doubts.look(line_map, BEARING, sweep(at, door=door, seed=100 * lap + k), at) == 0
    assert line_map.version == before


def test_what_gives_no_echo_is_no_hole() -> None:
    """A door painted black, or one onto a field: unknown is not open."""
    line_map, doubts = wall_map(), Doubts()
    for k, x in enumerate(np.arange(-1.0, 4.0, 0.05).tolist()):
        at = Pose2(x, 0.0, 0.3)
        doubts.look(line_map, BEARING, sweep(at, seed=k, far=False), at)
    assert covered(line_map, 1.5)
    assert len(doubts) == 0


def test_one_echo_tears_up_what_was_noted() -> None:
    line_map, doubts = wall_map(), Doubts()
    at = Pose2(1.5, 0.0, math.pi / 2)
    for k in range(20):
        for _ in range(LOOKS - 1):
            doubts.look(line_map, BEARING, sweep(at, seed=k), at)
        assert len(doubts) > 0
        doubts.look(line_map, BEARING, sweep(at, door="shut", seed=k), at)
        assert len(doubts) == 0
    assert covered(line_map, 1.5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.06), st.floats(0.0, math.radians(1.0)))
def test_poses_that_are_somewhat_off_cut_nothing(seed: int, off_m: float, off_rad: float) -> None:
    rng = np.random.default_rng(seed)
    line_map, doubts = wall_map(), Doubts()
    for k in range(60):
        at = Pose2(float(rng.uniform(-1.0, 3.0)), float(rng.uniform(-2.0, 1.5)), float(rng.uniform(-1.0, 2.0)))
        believed = Pose2(
            at.x_m + float(rng.normal(0.0, off_m)),
            at.y_m + float(rng.normal(0.0, off_m)) * 0.9,
            at.yaw_rad + float(rng.uniform(-off_rad, off_rad)),
        )
        doubts.look(line_map, BEARING, sweep(at, door="shut", seed=k), believed)
    assert all(covered(line_map, x) for x in (-1.0, 0.0, 1.0, 1.5, 2.0))


@pytest.mark.parametrize("ranges", [np.full(len(BEARING), np.nan), np.full(len(BEARING), -np.inf), np.zeros(0)])
def test_sweeps_that_say_nothing_change_nothing(ranges: F64) -> None:
    line_map, doubts = wall_map(), Doubts()
    assert doubts.look(line_map, BEARING[: len(ranges)], ranges, Pose2()) == 0
    assert doubts.look(LineMap(), BEARING, sweep(Pose2()), Pose2()) == 0


def test_pieces_share_the_points_and_are_found_where_they_are() -> None:
    line_map = wall_map()
    (line,) = (number for number in line_map.around(0.0, 2.0, 1.0).tolist())
    before = line_map.lines()
    length = float(before.length_m[0])
    line_map.keep_pieces(line, [(0.0, 1.0), (length - 2.0, length)])
    after = line_map.lines()
    assert len(after) == 2
    np.testing.assert_allclose(sorted(after.length_m), [1.0, 2.0], atol=1e-9)
    assert int(after.count.sum()) == pytest.approx(int(before.count[0]) * 3.0 / length, abs=2)
    angle, distance, covariance = after.parameters()
    was = before.parameters()
    np.testing.assert_allclose(distance, was[1][0], atol=0.02)
    np.testing.assert_allclose(angle, was[0][0], atol=0.01)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert np.all(covariance[:, 1, 1] >= was[2][0, 1, 1] * 0.9)  # fewer points, no surer
    for number in line_map.around(float(after.start_m[0, 0]), 2.0, 0.1).tolist():
        line_map.keep_pieces(number, [])
    assert len(line_map) < 2
