"""A view against others: the pose comes back, the covariance knows a corridor, free space speaks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels.localise_match import nearest_bin
from mapping.kernels.localise_search import pool
from mapping.localise.scan_match import Reach, agreement, match_view, weakest_information
from mapping.localise.search import find_view, raster_of
from mapping.localise.views import View, ViewStore, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-180.0, 180.0, 1.0))
ROOM = [((-3.0, -2.0), (4.0, -2.0)), ((4.0, -2.0), (4.0, 2.5)), ((4.0, 2.5), (1.0, 2.5)), ((1.0, 2.5), (1.0, 3.5)),
        ((1.0, 3.5), (-3.0, 3.5)), ((-3.0, 3.5), (-3.0, -2.0)), ((-1.0, 0.8), (-0.5, 1.3))]  # fmt: skip
CORRIDOR = [((-50.0, -1.0), (50.0, -1.0)), ((50.0, 1.0), (-50.0, 1.0))]
Wall = tuple[tuple[float, float], tuple[float, float]]


def seen(walls: list[Wall], pose: Pose2, *, noise_m: float = 0.0, seed: int = 0) -> View:
    """A scan of walls by ray casting."""
    heading = pose.yaw_rad + BEARING
    direction = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    reach = np.full(len(BEARING), np.inf)
    for (ax, ay), (bx, by) in walls:
        ex, ey = bx - ax, by - ay
        det = direction[:, 0] * ey - direction[:, 1] * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((ax - pose.x_m) * ey - (ay - pose.y_m) * ex) / det
            u = ((ax - pose.x_m) * direction[:, 1] - (ay - pose.y_m) * direction[:, 0]) / det
        hit = (t > 0.0) & (u >= 0.0) & (u <= 1.0)
        reach = np.where(hit & (t < reach), t, reach)
    reach = reach + np.random.default_rng(seed).normal(0.0, noise_m, len(reach))
    return view_of(Scan(0, 0.0, BEARING, reach, 0.05, 20.0), table_for(BEARING), farthest_m=20.0)


def store_of(walls: list[Wall], poses: list[Pose2], noise_m: float = 0.0) -> ViewStore:
    store = ViewStore()
    for k, pose in enumerate(poses):
        store.add(seen(walls, pose, noise_m=noise_m, seed=100 + k))
    return store


def rows_of(poses: list[Pose2]) -> F64:
    return np.array([(p.x_m, p.y_m, p.yaw_rad) for p in poses])


@pytest.mark.parametrize("off", [Pose2(0.2, -0.15, 0.1), Pose2(-0.25, 0.1, -0.15), Pose2(0.0, 0.3, 0.0)])
def test_the_pose_comes_back_from_a_wrong_guess(off: Pose2) -> None:
    poses = [Pose2(0.0, 0.0, 0.2), Pose2(0.4, 0.1, 0.4), Pose2(0.8, 0.1, 0.1)]
    store = store_of(ROOM, poses)
    truth = Pose2(0.6, 0.3, 0.5)
    match = match_view(seen(ROOM, truth), store.kept(), np.arange(3), rows_of(poses), truth @ off)
    assert match is not None
    left = truth.inverse() @ match.pose
    assert math.hypot(left.x_m, left.y_m) < 2e-3
    assert abs(left.yaw_rad) < 1e-3
    assert match.mean_cost < 0.05
    assert weakest_information(match.information()) > 1e4


def test_a_crowd_in_front_of_half_the_walls_does_no_harm() -> None:
    poses = [Pose2(0.0, 0.0, 0.0), Pose2(0.3, 0.0, 0.1)]
    store = store_of(ROOM, poses)
    people: list[Wall] = [((0.9 * c - 0.1, 0.9 * s), (0.9 * c + 0.1, 0.9 * s + 0.1)) for c, s in
                          ((math.cos(k), math.sin(k)) for k in range(6))]  # fmt: skip
    truth = Pose2(0.2, 0.1, 0.05)
    match = match_view(seen(ROOM + people, truth), store.kept(), np.arange(2), rows_of(poses), Pose2(0.3, 0.0, 0.1))
    assert match is not None
    left = truth.inverse() @ match.pose
    assert math.hypot(left.x_m, left.y_m) < 0.02
    assert abs(left.yaw_rad) < math.radians(0.5)


def test_a_corridor_holds_nothing_along_itself_and_the_prior_does() -> None:
    poses = [Pose2(0.0, 0.0, 0.0)]
    store = store_of(CORRIDOR, poses)
    view = seen(CORRIDOR, Pose2(0.5, 0.2, 0.0))
    free = match_view(view, store.kept(), np.arange(1), rows_of(poses), Pose2(0.4, 0.1, 0.02))
    assert free is not None
    assert weakest_information(free.information()) < 100.0
    assert free.pose.y_m == pytest.approx(0.2, abs=2e-3)
    held = match_view(
        view, store.kept(), np.arange(1), rows_of(poses), Pose2(0.4, 0.1, 0.02), prior=np.diag([1e4, 1.0, 1.0])
    )
    assert held is not None
    assert held.pose.x_m == pytest.approx(0.4, abs=2e-3)
    assert held.pose.y_m == pytest.approx(0.2, abs=2e-3)


def test_the_promised_variance_is_the_variance() -> None:
    """200 matches of noisy views against one noisy reference: mean squared error in the promised covariance."""
    squares = []
    for k in range(200):
        store = ViewStore()
        store.add(seen(ROOM, Pose2(), noise_m=0.02, seed=2 * k))
        truth = Pose2(0.1, 0.05, 0.03)
        match = match_view(
            seen(ROOM, truth, noise_m=0.02, seed=2 * k + 1), store.kept(), np.arange(1), np.zeros((1, 3)), truth
        )
        assert match is not None
        off = np.array([match.pose.x_m - truth.x_m, match.pose.y_m - truth.y_m, match.pose.yaw_rad - truth.yaw_rad])
        squares.append(float(off @ match.information() @ off))
    assert 0.5 < np.mean(squares) < 4.5  # 3 if exact; the tangents' own noise is not in the model


def test_nothing_to_hold_on_to_is_no_match() -> None:
    poses = [Pose2()]
    store = store_of(ROOM, poses)
    empty = view_of(Scan(0, 0.0, BEARING, np.full(360, np.inf), 0.05, 20.0), table_for(BEARING), farthest_m=20.0)
    assert match_view(empty, store.kept(), np.arange(1), rows_of(poses), Pose2()) is None
    far = Pose2(200.0, 0.0, 0.0)
    assert match_view(seen(ROOM, Pose2()), store.kept(), np.arange(1), rows_of(poses), far) is None


def test_a_corridor_seen_every_degree_holds_the_heading() -> None:
    """Of 180 beams of a corridor 2.5 m wide most of those far ahead meet it half a metre and more apart."""
    bearing = np.radians(np.arange(-90.0, 90.0))
    table = table_for(bearing)

    def corridor(yaw: float, seed: int) -> View:
        distance = 1.25 / np.maximum(np.abs(np.sin(bearing + yaw)), 0.02)
        noise = np.random.default_rng(seed).normal(0.0, 0.02, len(bearing))
        return view_of(Scan(0, 0.0, bearing, distance + noise, 0.05, 20.0), table, farthest_m=20.0, grazed=True)

    off = []
    for k in range(30):
        store = ViewStore()
        store.add(corridor(0.0, 2 * k))
        held = np.diag([100.0, 100.0, 1.0])  # along itself nothing holds it
        at = Pose2(0.3, 0.0, math.radians(5.0))
        match = match_view(
            corridor(at.yaw_rad, 2 * k + 1),
            store.kept(),
            np.arange(1),
            np.zeros((1, 3)),
            Pose2(0.3, 0.0, 0.0),
            prior=held,
        )
        assert match is not None
        assert math.sqrt(1.0 / match.information()[2, 2]) < math.radians(0.15)
        off.append(match.pose.yaw_rad - at.yaw_rad)
    assert float(np.std(off)) < math.radians(0.2)
    assert abs(float(np.mean(off))) < math.radians(0.1)


def test_free_space_refutes_a_wrong_place() -> None:
    poses = [Pose2(0.0, 0.0, 0.0)]
    store = store_of(ROOM, poses)
    view = seen(ROOM, Pose2(0.3, 0.2, 0.1))
    right = agreement(view, store.kept(), np.arange(1), rows_of(poses), Pose2(0.3, 0.2, 0.1))
    assert right.explained > 0.95
    assert right.refuted < 0.01
    wrong = agreement(view, store.kept(), np.arange(1), rows_of(poses), Pose2(-0.9, -0.6, 0.1))
    assert wrong.explained < 0.5
    assert wrong.refuted > 0.15
    assert right.explained + right.refuted + right.unseen == pytest.approx(1.0)


def test_partners_are_the_nearest_points() -> None:
    view = seen(ROOM, Pose2(), noise_m=0.01)
    points = np.stack((view.x, view.y), axis=-1).astype(np.float64)
    usable = view.quality > 0.0
    rng = np.random.default_rng(1)
    for p in points[rng.integers(0, 360, 300)] + rng.normal(0.0, 0.1, (300, 2)):
        found = nearest_bin(p[0], p[1], 0.3, False, view.x, view.y, view.quality, view.table.frame())
        distance = np.where(usable, np.hypot(*(points - p).T), np.inf)
        if distance.min() < 0.299:
            assert found >= 0
            assert distance[found] == pytest.approx(distance.min(), abs=1e-6)
        elif distance.min() > 0.301:
            assert found == -1


def test_a_search_finds_what_a_guess_does_not() -> None:
    poses = [Pose2(0.0, 0.0, 0.0), Pose2(1.0, 0.2, 0.5)]
    store = store_of(ROOM, poses)
    truth = Pose2(1.2, -0.4, 0.35)
    raster = raster_of(store.kept(), np.arange(2), rows_of(poses))
    found = find_view(seen(ROOM, truth), raster, Pose2(-0.9, 1.3, 0.0), window_m=3.0, turn_rad=math.radians(30.0))
    assert found is not None
    assert math.hypot(found.pose.x_m - truth.x_m, found.pose.y_m - truth.y_m) < 0.15
    assert abs(found.pose.yaw_rad - truth.yaw_rad) < math.radians(1.5)
    assert found.score > 0.8
    assert found.rival < 0.85


def test_a_corridor_is_ambiguous() -> None:
    poses = [Pose2(0.0, 0.0, 0.0)]
    store = store_of(CORRIDOR, poses)
    raster = raster_of(store.kept(), np.arange(1), rows_of(poses))
    found = find_view(seen(CORRIDOR, Pose2()), raster, Pose2(), window_m=3.0, turn_rad=0.2)
    assert found is not None
    assert found.rival > 0.85  # a metre on, it fits nearly as well


@pytest.mark.parametrize("window_m", [1.0, 6.0])
def test_blocks_do_not_hide_the_best(window_m: float) -> None:
    """Two resolutions find what the fine raster alone says is best."""
    poses = [Pose2(0.0, 0.0, 0.0)]
    store = store_of(ROOM, poses)
    view = seen(ROOM, Pose2(0.3, 0.2, 0.1))
    raster = raster_of(store.kept(), np.arange(1), rows_of(poses), window_m=window_m)
    found = find_view(view, raster, Pose2(), window_m=1.0, turn_rad=math.radians(8.0))
    assert found is not None
    near = np.flatnonzero(view.quality >= 0.0)
    chosen = near[np.linspace(0, len(near) - 1, 120).astype(np.int64)]
    best = 0.0
    for turn in range(-8, 9):
        yaw = math.radians(turn)
        x = math.cos(yaw) * view.x[chosen] - math.sin(yaw) * view.y[chosen]
        y = math.sin(yaw) * view.x[chosen] + math.cos(yaw) * view.y[chosen]
        u = np.floor((x.astype(np.float64) - raster.x0_m) / 0.1).astype(np.int64)
        v = np.floor((y.astype(np.float64) - raster.y0_m) / 0.1).astype(np.int64)
        for dy in range(-10, 11):
            for dx in range(-10, 11):
                best = max(best, float(raster.fine[v + dy, u + dx].sum()) / (255.0 * len(chosen)))
    assert found.score >= best - 0.02


def test_maxima_over_wide_blocks_come_from_those_over_small_ones() -> None:
    fine = np.random.default_rng(2).integers(0, 255, (70, 90)).astype(np.uint8)
    np.testing.assert_array_equal(pool(pool(fine, 8, 1), 4, 8), pool(fine, 32, 1))


def test_one_rival_is_enough_where_more_need_not_be_known() -> None:
    store = store_of(CORRIDOR, [Pose2(0.0, 0.0, 0.0)])
    raster = raster_of(store.kept(), np.arange(1), rows_of([Pose2()]), window_m=8.0)
    view = seen(CORRIDOR, Pose2())
    found = find_view(view, raster, Pose2(), window_m=8.0, turn_rad=0.2, doubtful_share=0.85)
    every = find_view(view, raster, Pose2(), window_m=8.0, turn_rad=0.2)
    assert found is not None
    assert every is not None
    assert found.pose == every.pose
    assert 0.85 < found.rival <= every.rival


def test_a_schedule_has_all_its_levels() -> None:
    with pytest.raises(ValueError, match="levels"):
        Reach((0.5,), (0.1,))
