"""A known grid as something to localise in, against literal versions and closed forms; and a robot that finds itself.

The floor is known exactly: its walls are segments, what a laser sees from anywhere in it is worked out in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.grids.patch import GridPatch
from mapping.kernels import localise_known as kernels
from mapping.kernels import localise_known_search as kernels_search
from mapping.kernels.localise_known_search import BLOCK
from mapping.localise.confidence import Evidence, held, probability
from mapping.localise.in_map import (
    InMapSettings,
    Located,
    MapLocaliser,
    SearchIsDueError,
    SearchResult,
    State,
    _corrected,
    _Crowd,
    _crowd_at,
)
from mapping.localise.known_map import (
    BEAMS,
    LOG_APART,
    LOG_ELSE,
    KnownMap,
    Points,
    digest_of,
    find_places,
    hold,
    known_map,
    lay,
    points_of,
    thinned,
)

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WALLS: F64 = np.array(
    [
        # x0, y0, x1, y1: outside
        (0.0, 0.0, 14.0, 0.0), (14.0, 0.0, 14.0, 9.0), (14.0, 9.0, 0.0, 9.0), (0.0, 9.0, 0.0, 0.0),
        # a corridor with doors to two rooms below and one above
        (0.0, 3.5, 2.0, 3.5), (3.2, 3.5, 9.0, 3.5), (10.0, 3.5, 14.0, 3.5),
        (0.0, 5.5, 5.0, 5.5), (6.4, 5.5, 14.0, 5.5),
        (6.0, 0.0, 6.0, 3.5), (11.0, 5.5, 11.0, 9.0),
        # a niche, a pillar, a slanted wall
        (4.5, 7.5, 5.5, 7.5), (5.5, 7.5, 5.5, 9.0),
        (2.0, 1.5, 2.4, 1.5), (2.4, 1.5, 2.4, 1.9), (2.4, 1.9, 2.0, 1.9), (2.0, 1.9, 2.0, 1.5),
        (12.0, 0.0, 14.0, 2.0),
    ]
)  # fmt: skip


def floor_plan(resolution_m: float = 0.05) -> GridPatch:
    """The rooms as a grid: walls one or two cells thick, all else free, a margin of unknown around."""
    rows, cols = round(9.0 / resolution_m) + 1, round(14.0 / resolution_m) + 1
    cells = np.zeros((rows, cols), dtype=np.int8)
    for x0, y0, x1, y1 in WALLS:
        n = math.ceil(math.hypot(x1 - x0, y1 - y0) / resolution_m) * 8
        at = np.linspace(0.0, 1.0, n + 1)
        cells[
            np.floor((y0 + at * (y1 - y0)) / resolution_m).astype(int),
            np.floor((x0 + at * (x1 - x0)) / resolution_m).astype(int),
        ] = 100
    return GridPatch(resolution_m, 0, 0, cells)


def seen(pose: Pose2, bearing_rad: F64, walls: F64 = WALLS) -> F64:
    """Ranges (N,) to the nearest wall, in closed form; inf where there is none."""
    angle = pose.yaw_rad + bearing_rad
    d = np.stack((np.cos(angle), np.sin(angle)), axis=-1)[:, None, :]
    a, b = walls[None, :, :2] - (pose.x_m, pose.y_m), walls[None, :, 2:] - (pose.x_m, pose.y_m)
    e = b - a
    cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (a[..., 0] * e[..., 1] - a[..., 1] * e[..., 0]) / cross
        along = (a[..., 0] * d[..., 1] - a[..., 1] * d[..., 0]) / cross
    hit = (np.abs(cross) > 1e-12) & (reach > 0.0) & (along >= 0.0) & (along <= 1.0)
    return np.asarray(np.where(hit, reach, np.inf).min(axis=1))


BEARINGS: F64 = np.radians(np.arange(-90.0, 90.5, 1.0))


def points_at(pose: Pose2, rng: np.random.Generator | None = None, *, walls: F64 = WALLS) -> Points:
    """What a laser of 180 degrees on the base sees, with 1 cm of noise if there is a generator."""
    reach = seen(pose, BEARINGS, walls)
    if rng is not None:
        reach = reach + rng.normal(0.0, 0.01, len(reach))
    return points_of(BEARINGS, reach, Pose2(), nearest_m=0.05, farthest_m=20.0, most=BEAMS)


def way_through(corners: list[tuple[float, float]], *, step_m: float = 0.06, turn_rad: float = 0.12) -> list[Pose2]:
    """Poses of a robot that turns on the spot at each corner and drives straight between them."""
    poses: list[Pose2] = []
    yaw = math.atan2(corners[1][1] - corners[0][1], corners[1][0] - corners[0][0])
    for (x0, y0), (x1, y1) in pairwise(corners):
        wanted = math.atan2(y1 - y0, x1 - x0)
        turn = (wanted - yaw + math.pi) % (2.0 * math.pi) - math.pi
        turns = math.ceil(abs(turn) / turn_rad)
        poses += [Pose2(x0, y0, yaw + turn * k / max(1, turns)) for k in range(turns)]
        yaw = wanted
        n = math.ceil(math.hypot(x1 - x0, y1 - y0) / step_m)
        poses += [Pose2(x0 + (x1 - x0) * k / n, y0 + (y1 - y0) * k / n, yaw) for k in range(n)]
    return poses


PATCH = floor_plan()


KNOWN = known_map(PATCH)


@pytest.fixture
def rooms() -> KnownMap:
    return KNOWN


def row(pose: Pose2) -> F64:
    return np.array([[pose.x_m, pose.y_m, pose.yaw_rad]])


def test_a_map_without_walls_or_free_space_is_refused() -> None:
    for cells in (np.zeros((5, 5), dtype=np.int8), np.full((5, 5), 100, dtype=np.int8)):
        with pytest.raises(ValueError, match="walls and free space"):
            known_map(GridPatch(0.05, 0, 0, cells))


def test_the_grid_is_only_read() -> None:
    patch = floor_plan(0.1)
    before = digest_of(patch)
    known = known_map(patch)
    points = points_at(Pose2(3.0, 4.5, 0.2))
    find_places(known, np.stack((points.x_m, points.y_m), axis=-1))
    hold(known, points, row(Pose2(3.0, 4.5, 0.2)))
    assert digest_of(patch) == before == known.digest


def test_surfaces_lie_on_the_walls_and_face_across_them(rooms: KnownMap) -> None:
    surface = rooms.surface.astype(float)
    x, y = surface[:, 0] + rooms.x0_m, surface[:, 1] + rooms.y0_m
    straight = (np.abs(y - 3.5) < 0.08) & (x > 3.6) & (x < 5.6)  # the corridor's wall, away from its ends and corners
    assert straight.sum() >= 40
    np.testing.assert_allclose(y[straight], 3.525, atol=0.002)  # the middle of the cells the wall was drawn into
    np.testing.assert_allclose(np.abs(surface[straight, 3]), 1.0, atol=0.01)
    assert surface[straight, 4].max() < 0.15


@settings(max_examples=25)
@given(st.floats(0.4, 13.6), st.floats(3.9, 5.1), st.floats(-math.pi, math.pi))
def test_rays_end_where_the_walls_stand(x: float, y: float, yaw: float) -> None:
    known = KNOWN
    angle = np.array([yaw])
    truth = float(seen(Pose2(x, y, 0.0), angle)[0])
    reach, what = kernels.cast(
        known.kind, known.room_m, known.nearest, known.surface, known.resolution_m,
        x - known.x0_m, y - known.y0_m, math.cos(yaw), math.sin(yaw), 30.0,
    )  # fmt: skip
    assert what in (kernels.WALL, kernels.UNKNOWN)
    # A wall is drawn into whole cells: a ray meets the cell up to a cell earlier or later across, more at a slant;
    # at a grazing angle it may be let pass, and at an end of a wall it may miss it.
    if what == kernels.WALL and abs(reach - truth) > 0.35:
        others = [float(seen(Pose2(x, y, 0.0), np.array([yaw + d]))[0]) for d in (-0.06, 0.06)]
        assert min(abs(reach - other) for other in others) < 0.35 or reach > truth


@settings(max_examples=20)
@given(
    st.floats(3.6, 12.0),
    st.floats(4.0, 5.0),
    st.floats(-3.0, 3.0),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(-0.1, 0.1),
)
def test_laying_brings_a_scan_home(x: float, y: float, yaw: float, dx: float, dy: float, turn: float) -> None:
    known = KNOWN
    truth = Pose2(x, y, yaw)
    points = points_at(truth)
    fits = lay(known, points, row(Pose2(x + dx, y + dy, yaw + turn)), steps=25)
    information = fits.hessian[0]
    held = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / information[2, 2]
    weak, strong = np.linalg.eigh(held)
    if weak[0] < 8.0:  # a bare corridor: nothing says where along it, and it need not guess
        off = np.array([fits.poses[0, 0] - x, fits.poses[0, 1] - y]) @ strong[:, 1]
        assert abs(off) < 0.06
        return
    assert math.hypot(fits.poses[0, 0] - x, fits.poses[0, 1] - y) < 0.06  # the walls are drawn half a cell off
    assert abs(wrap_angle(fits.poses[0, 2] - yaw)) < math.radians(1.0)


def test_a_prior_holds_what_the_scan_does_not() -> None:
    known = KNOWN
    walls = np.array([(-20.0, 3.5, 20.0, 3.5), (-20.0, 5.5, 20.0, 5.5)])
    reach = seen(Pose2(7.5, 4.5, 0.0), BEARINGS, walls)
    points = points_of(BEARINGS, np.where(reach < 3.0, reach, np.inf), Pose2(), nearest_m=0.1, farthest_m=20, most=90)
    guess = row(Pose2(7.7, 4.4, 0.03))
    fits = lay(known, points, guess, priors=np.diag([5.0, 5.0, 5.0])[None])
    assert fits.poses[0, 0] == pytest.approx(7.7, abs=0.1)  # along the corridor the prior
    assert fits.poses[0, 1] == pytest.approx(4.5, abs=0.06)  # across it the walls


def test_beams_bear_witness(rooms: KnownMap) -> None:
    truth = Pose2(4.0, 4.5, 0.3)
    points = points_at(truth)
    right = hold(rooms, points, row(truth))
    assert right.explained[0] > 0.97
    beyond = hold(rooms, points, row(Pose2(4.0, 2.4, 0.3)))  # the room next door: long beams went through its wall
    assert beyond.through[0] > 0.1
    assert beyond.log[0] < right.log[0] - 30.0
    reach = seen(truth, BEARINGS)
    person = np.where(np.abs(BEARINGS) < 0.3, np.minimum(reach, 0.8), reach)
    crowded = hold(
        rooms, points_of(BEARINGS, person, Pose2(), nearest_m=0.05, farthest_m=20, most=90), row(truth)
    )  # fmt: skip
    assert crowded.through[0] < 0.02
    assert 0.02 < crowded.unexpected[0] < 0.4
    away = hold(rooms, points, row(Pose2(-30.0, -30.0, 0.0)))
    assert away.unseen[0] == 1.0


def test_a_beam_says_what_its_end_is_apart_from_the_walls() -> None:
    """One beam from (4, 4.5) to the east in a room whose wall stands at x = 6, ended short of it or beyond."""
    cells = np.zeros((180, 240), dtype=np.int8)
    cells[:, 120:124] = 100
    cells[:, 124:] = -1
    known = known_map(GridPatch(0.05, 0, 0, cells))

    def log_of(range_m: float) -> float:
        points = points_of(
            np.zeros(1), np.array([range_m]), Pose2(), nearest_m=0.05, farthest_m=20.0, most=BEAMS
        )  # fmt: skip
        return float(hold(known, points, row(Pose2(4.0, 4.5, 0.0))).log[0])

    on_it = 2.1  # the surface is the middle of what is drawn
    assert log_of(on_it) == pytest.approx(LOG_APART[0])
    halfway = 0.175 * (1.0 + 0.08 * 1.9)  # from 0.1 to 0.25, and less sharp the longer the beam
    assert log_of(on_it - halfway) == pytest.approx(0.5 * (LOG_APART[1] + LOG_APART[2]), abs=0.05)
    assert log_of(1.0) == pytest.approx(LOG_ELSE[kernels.UNEXPECTED])
    assert log_of(2.42) == pytest.approx(LOG_ELSE[kernels.EXPLAINED])  # just behind the wall
    assert log_of(4.0) == pytest.approx(LOG_ELSE[kernels.THROUGH])
    fine = [log_of(range_m) for range_m in np.arange(on_it, 0.5, -0.02)]
    assert all(near >= far for near, far in pairwise(fine))


def test_search_finds_what_a_literal_search_finds() -> None:
    """Every cell and heading tried one by one gives the same best score."""
    patch = floor_plan(0.1)
    small = GridPatch(0.1, 0, 0, np.ascontiguousarray(patch.cells[:60, :70]))
    known = known_map(small)
    points = thinned(np.stack(_xy(points_at(Pose2(3.05, 2.55, 1.0))), axis=-1), cell_m=0.3, most=40)
    step = math.radians(10.0)
    places = find_places(known, points, turn_step_rad=step, share=0.6)
    best, where, fine = -1.0, (0.0, 0.0, 0.0), likelihoods(known)
    rows, cols = np.nonzero(known.allowed)
    for t in range(36):
        c, s = math.cos(t * step), math.sin(t * step)
        u = np.floor(0.5 + (c * points[:, 0] - s * points[:, 1]) / 0.1).astype(int)
        v = np.floor(0.5 + (s * points[:, 0] + c * points[:, 1]) / 0.1).astype(int)
        uu, vv = cols[:, None] + u, rows[:, None] + v
        inside = (uu >= 0) & (vv >= 0) & (uu < fine.shape[1]) & (vv < fine.shape[0])
        values = np.where(inside, fine[np.clip(vv, 0, fine.shape[0] - 1), np.clip(uu, 0, fine.shape[1] - 1)], 0)
        scores = values.astype(int).sum(axis=1)
        if scores.max() > best:
            k = int(scores.argmax())
            best = float(scores.max())
            where = (known.search_x0_m + (cols[k] + 0.5) * 0.1, known.search_y0_m + (rows[k] + 0.5) * 0.1, t * step)
    assert places.score[0] == pytest.approx(best / (255.0 * len(points)))
    assert places.poses[0, :2] == pytest.approx(where[:2])
    assert np.all(np.diff(places.score) <= 1e-12)


def likelihoods(known: KnownMap) -> U8:
    """The raster of a search as rows and columns: words of phase 0 side by side."""
    return np.asarray(known.fine[0].astype("<u8").view(np.uint8))


def test_pooled_likelihoods_bound_every_block(rooms: KnownMap) -> None:
    rng, fine = np.random.default_rng(5), likelihoods(rooms)
    assert fine.max() == 255
    for _ in range(500):
        v, u = (int(rng.integers(0, n - BLOCK)) for n in fine.shape)
        pooled = rooms.coarse[v % BLOCK, u % BLOCK, v // BLOCK, u // BLOCK]
        assert pooled == fine[v : v + BLOCK, u : u + BLOCK].max()


def test_eight_poses_at_once_score_as_one_by_one(rooms: KnownMap) -> None:
    """As many points as fit, most of them on walls: the sums in 16 bits hold."""
    rng, fine = np.random.default_rng(6), likelihoods(rooms)
    v0, u0 = (int(v) * BLOCK for v in rooms.blocks[len(rooms.blocks) // 2])
    rows, cols = np.nonzero(fine > 200)
    chosen = rng.integers(0, len(rows), kernels_search.MOST_POINTS)
    cx, cy = cols[chosen] - u0 - 3, rows[chosen] - v0 - 5
    high, wide = rooms.fine.shape[1:]
    offset = ((cx % BLOCK) * high + cy) * wide + cx // BLOCK
    scores = np.empty((BLOCK, BLOCK), dtype=np.int32)
    kernels_search.block_scores(rooms.fine.ravel(), wide, v0 * wide + u0 // BLOCK, offset, scores)
    assert scores[5, 3] == fine[rows[chosen], cols[chosen]].astype(int).sum() > 200 * len(cx)
    for v in range(BLOCK):
        for u in range(BLOCK):
            assert scores[v, u] == fine[v0 + v + cy, u0 + u + cx].astype(int).sum()


def test_a_point_farther_than_the_margin_is_left_out(rooms: KnownMap) -> None:
    points = np.stack(_xy(points_at(Pose2(3.0, 4.5, 0.0))), axis=-1)
    far = np.array([[1e4, 0.0], [-26.5, 0.0], [0.0, 27.0]])
    plain, more = find_places(rooms, points), find_places(rooms, np.concatenate((points, far)))
    assert np.array_equal(plain.poses, more.poses)
    assert not len(find_places(rooms, far).poses)


def test_a_hint_keeps_the_search_near(rooms: KnownMap) -> None:
    points = np.stack(_xy(points_at(Pose2(3.0, 4.5, 0.0))), axis=-1)
    places = find_places(rooms, points, near=(Pose2(10.0, 4.5, 0.0), 1.5))
    assert len(places.poses)
    assert np.hypot(places.poses[:, 0] - 10.0, places.poses[:, 1] - 4.5).max() < 1.5 + 1.5 * BLOCK * rooms.search_m


def test_thinning_keeps_one_point_a_square() -> None:
    rng = np.random.default_rng(2)
    cloud = rng.uniform(-3.0, 3.0, (500, 2))
    kept = thinned(cloud, cell_m=0.5, most=1000)
    assert len(np.unique(np.floor(kept / 0.5), axis=0)) == len(kept) == len(np.unique(np.floor(cloud / 0.5), axis=0))
    assert len(thinned(cloud, cell_m=0.5, most=20)) == 20


def _xy(points: Points) -> tuple[F64, F64]:
    return points.x_m, points.y_m


# --- a robot in it ----------------------------------------------------------------------------------------------------

PERIOD_NS = 200_000_000
ROUND = [(1.0, 2.6), (2.6, 3.0), (2.6, 4.5), (5.7, 4.5), (5.7, 6.6), (8.0, 7.5), (5.7, 6.6), (5.7, 4.5), (9.5, 4.5)]


def drive(
    localiser: MapLocaliser,
    way: Iterable[Pose2],
    *,
    seed: int = 1,
    began_ns: int = 0,
    pool: ThreadPoolExecutor | None = None,
) -> list[Located]:
    """Drive along with odometry that errs by 2 % and noisy scans; searches here or in a pool. No jump is felt."""
    rng = np.random.default_rng(seed)
    found: list[Located] = []
    odom, last = Pose2(), None
    pending: SearchResult | Future[SearchResult] | None = None
    for index, pose in enumerate(way):
        if last is not None:
            step = last.inverse() @ pose
            if math.hypot(step.x_m, step.y_m) > 0.5:
                step = Pose2()  # carried: the wheels feel nothing
            odom = odom @ Pose2(1.02 * step.x_m, step.y_m, 0.98 * step.yaw_rad + float(rng.normal(0.0, 0.002)))
        last = pose
        stamp_ns = index * PERIOD_NS
        if localiser.is_due(stamp_ns):
            assert pending is not None
            localiser.apply(pending.result() if isinstance(pending, Future) else pending)
        found.append(localiser.add_scan(stamp_ns, points_at(pose, rng), odom))
        work = localiser.take_work()
        if work is not None:
            pending = work.run() if pool is None else pool.submit(work.run)
    return found


def off(located: Located, truth: Pose2) -> float:
    assert located.map_from_base is not None
    return math.hypot(located.map_from_base.x_m - truth.x_m, located.map_from_base.y_m - truth.y_m)


def test_a_robot_finds_itself_and_stays_found() -> None:
    way = way_through(ROUND)
    found = drive(MapLocaliser(KNOWN), way)
    first = next(k for k, each in enumerate(found) if each.state is State.SURE)
    assert first * PERIOD_NS <= 10e9
    errors = [off(each, pose) for each, pose in zip(found[first:], way[first:])]
    assert float(np.median(errors)) < 0.05
    assert max(errors) < 0.3
    assert all(each.state is State.SURE for each in found[first:])


def test_the_covariance_tells_how_far_off_it_is() -> None:
    """Squared errors in units of the covariance told: on average 3 for three numbers, if it is right."""
    way = way_through(ROUND)
    squares = []
    for seed in range(3):
        for located, pose in list(zip(drive(MapLocaliser(KNOWN), way, seed=seed), way))[60::5]:
            assert located.map_from_base is not None
            p = located.map_from_base
            e = np.array([p.x_m - pose.x_m, p.y_m - pose.y_m, wrap_angle(p.yaw_rad - pose.yaw_rad)])
            squares.append(float(e @ np.linalg.solve(located.covariance, e)))
    assert 0.5 < float(np.mean(squares)) < 6.0  # the grid's half cell is a bias that no covariance averages out


def test_a_robot_carried_away_says_so_and_comes_back() -> None:
    before, after = (
        way_through(ROUND),
        way_through([(1.2, 1.0), (4.5, 0.8), (5.0, 2.5), (2.7, 2.8), (2.6, 4.5), (0.8, 4.5)]),
    )
    localiser = MapLocaliser(KNOWN)
    found = drive(localiser, [*before, *[after[0]] * 5, *after])
    jump = len(before)
    wrong = [
        k for k, each in enumerate(found[jump:]) if each.state is State.SURE and off(each, _at(after, k - 5)) > 0.5
    ]
    assert len(wrong) * PERIOD_NS <= 5e9
    assert any(each.state is State.LOST for each in found[jump : jump + 25])
    assert found[-1].state is State.SURE
    assert off(found[-1], after[-1]) < 0.15


def _at(way: list[Pose2], k: int) -> Pose2:
    return way[min(max(k, 0), len(way) - 1)]


def test_what_was_seen_outlasts_a_doubt() -> None:
    """Somebody stands in front of the laser for a while: lost, then sure of the same place again at once."""
    way = way_through(ROUND)
    localiser = MapLocaliser(KNOWN)
    found = drive(localiser, way[:80])
    assert found[-1].state is State.SURE
    odom, stamp_ns = localiser._last_odom, 80 * PERIOD_NS
    assert odom is not None
    crowded = points_of(BEARINGS, np.full(len(BEARINGS), 0.6), Pose2(), nearest_m=0.05, farthest_m=20.0, most=BEAMS)
    states, pending = [], None
    for k in range(30):
        if localiser.is_due(stamp_ns):
            localiser.apply(localiser._outstanding.run() if pending is None else pending)  # type: ignore[union-attr]
        points = crowded if k < 15 else points_at(way[79])
        states.append(localiser.add_scan(stamp_ns, points, odom).state)
        work = localiser.take_work()
        pending = pending if work is None else work.run()
        stamp_ns += PERIOD_NS
    assert State.LOST in states[:15]
    assert State.SURE in states[15:25]
    assert off(localiser.located(stamp_ns), way[79]) < 0.1
    assert len(localiser._keys) > 5


def test_sure_must_be_earned_and_is_kept_for_a_moment_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Told probabilities, a key scan every half second: in the grey between sure and lost it stays sure for 2 s."""
    told: dict[str, float] = {}
    monkeypatch.setattr("mapping.localise.in_map.probability", lambda evidence: told["now"])
    localiser = MapLocaliser(KNOWN, start=Pose2(3.0, 4.5, 0.0))
    stamp_ns, states = 0, []
    points = points_at(Pose2(3.0, 4.5, 0.0))
    for now, key_scans in (
        (0.96, 4),
        (0.98, 1),
        (0.96, 8),
        (0.9, 3),
        (0.96, 1),
        (0.9, 4),
        (0.98, 1),
        (0.69, 1),
    ):
        told["now"] = now
        for _ in range(key_scans):
            if localiser.is_due(stamp_ns):
                localiser.abandon()
            states.append(localiser.add_scan(stamp_ns, points, Pose2()).state)
            stamp_ns += 500_000_000
    searching, sure, lost = State.SEARCHING, State.SURE, State.LOST
    assert states == [*[searching] * 4, *[sure] * 16, lost, sure, lost]
    assert localiser.events["lost"] == 2


def _three_places(log: F64) -> _Crowd:
    none = np.zeros_like(log)
    return _Crowd(np.zeros((3, 3)), np.zeros((3, 3, 3)), np.zeros(3), log, none, none, none)


def test_being_carried_must_be_made_good_once() -> None:
    """Three places and six key scans, the newest first: one was right until four ago, one is since, one is never."""
    s = InMapSettings(window=6, forget=1.0, most_per_key=5.0, carried=7.0, places=1)
    crowd = _three_places(np.array([[-4.0, -4, -4, 0, 0, 0], [0.0, 0, 0, -3, -3, -3], [-4.0, -4, -4, -4, -4, -4]]))
    assert crowd.weight(s).tolist() == [-12.0, -7.0, -19.0]
    assert crowd.weight(replace(s, carried=20.0)).tolist() == [-12.0, -9.0, -24.0]
    shared = crowd.weight(replace(s, places=4))  # carried to one of four places
    np.testing.assert_allclose(shared, [-12.0, -7.0 - math.log(4.0), -19.0 - math.log(4.0)])


def test_what_a_place_that_was_given_up_explained_counts_for_nobody() -> None:
    """The place that was sure until three key scans ago is not followed any more. Of three that are, none saw the
    older key scans: whether one fits those by chance somewhat better than another decides nothing."""
    s = InMapSettings(window=6, forget=1.0, most_per_key=5.0, carried=10.0, places=1)
    crowd = _three_places(np.array([[0.0, 0, 0, -9, -9, -9], [-1.0, -1, -1, -7, -7, -7], [-4.0, -4, -4, -6, -6, -6]]))
    then = np.array([0.0, 0.0, math.nan, -1.0, -1.0, -1.0])
    alone, weight = crowd.weight(s), crowd.weight(s, then)
    assert alone.tolist() == [-27.0, -24.0, -30.0]
    np.testing.assert_allclose(weight, [-13.0, -16.0, -25.0])
    assert np.array_equal(crowd.weight(s, np.full(6, math.nan)), alone)


def test_only_a_place_that_is_sure_keeps_what_it_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    """While places change in the search, the best of each moment together would explain more than any single one."""
    told = {"now": 0.5}
    monkeypatch.setattr("mapping.localise.in_map.probability", lambda evidence: told["now"])
    localiser = MapLocaliser(KNOWN, start=Pose2(3.0, 4.5, 0.0))
    for k in range(6):
        told["now"] = 0.99 if k >= 3 else 0.5
        if localiser.is_due(k * 500_000_000):
            localiser.abandon()
        at = Pose2(3.0 + 0.25 * k, 4.5, 0.0)
        localiser.add_scan(k * 500_000_000, points_at(at), at)
    assert localiser.state is State.SURE
    assert np.isnan(localiser._then[:6]).tolist() == [False, False, True, True, True, True]  # the newest first
    np.testing.assert_array_equal(localiser._then[:2], localiser._crowd.log[0, :2])


def test_small_differences_add_up_over_a_long_way() -> None:
    """A corridor that repeats itself: each key scan says little, 0.2, but places are told apart by 12 m of them."""
    s = InMapSettings()
    log = np.full((3, s.window), -1.0)
    log[1:] -= 0.2
    weight = _three_places(log).weight(s)
    assert s.window * s.key_m > 12.0
    assert weight[0] - weight[1] > 6.0


def test_a_map_that_explains_less_all_the_time_is_no_reason_to_doubt() -> None:
    """83 % of the beams explained, far ahead of all rivals: sure after some way; not at once, not if it was 95 %."""
    long = Evidence(0.0, 0.83, 0.83, 0.0, 40, 40, 0.83, True)
    told = [
        probability(replace(long, lead=8.0)),
        probability(replace(long, lead=8.0, own_keys=4)),
        probability(replace(long, lead=8.0, explained_own=0.95)),
        probability(replace(long, lead=8.0, challenged=False)),
        probability(replace(long, lead=0.0)),
    ]
    assert told[0] >= InMapSettings().sure
    assert max(told[1:3]) < InMapSettings().stays
    assert told[3] == 0.0
    assert told[4] < 0.5
    steps = [held(replace(long, lead=20.0, own_keys=keys)) for keys in (1, 4, 10, 16, 64)]
    assert steps == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    poor = [held(replace(long, lead=20.0, explained_own=own)) for own in (0.6, 0.7, 0.75, 0.8)]
    assert poor == pytest.approx([0.0, 0.0, 0.5, 1.0])  # outside the map, the best place is ahead for long too
    drops = [held(replace(long, lead=20.0, explained_now=now)) for now in (1.0, 0.8, 0.77, 0.74, 0.2)]
    assert drops == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])


def test_a_heading_that_was_lost_in_a_turn_is_found_again() -> None:
    truth, s = Pose2(3.0, 4.5, 0.4), InMapSettings()
    for lost_deg in (-9.0, 9.0):
        at = np.array([[truth.x_m, truth.y_m, truth.yaw_rad + math.radians(lost_deg)]])
        crowd = _crowd_at(at, np.diag([0.02**2, 0.02**2, math.radians(1.0) ** 2]), s.window)
        placed = _corrected(KNOWN, points_at(truth), crowd, s, turned=1)
        assert abs(math.degrees(wrap_angle(float(placed.poses[0, 2]) - truth.yaw_rad))) < 2.0
        assert math.hypot(placed.poses[0, 0] - truth.x_m, placed.poses[0, 1] - truth.y_m) < 0.1


def test_a_robot_elsewhere_is_never_sure() -> None:
    """Scans of a round hall that is not in the map."""
    localiser = MapLocaliser(KNOWN)
    angle = np.linspace(0.0, 2.0 * math.pi, 25)
    hall = np.stack((6 * np.cos(angle[:-1]), 6 * np.sin(angle[:-1]), 6 * np.cos(angle[1:]), 6 * np.sin(angle[1:])), -1)
    pending = None
    for k in range(60):
        if localiser.is_due(k * PERIOD_NS):
            assert pending is not None
            localiser.apply(pending)
        pose = Pose2(0.05 * k - 1.5, 0.5, 0.05 * k)
        located = localiser.add_scan(k * PERIOD_NS, points_at(pose, walls=hall), pose)
        assert located.state is not State.SURE
        work = localiser.take_work()
        pending = pending if work is None else work.run()


def test_threads_change_nothing() -> None:
    way = way_through(ROUND)[:90]
    alone = drive(MapLocaliser(KNOWN), way)
    with ThreadPoolExecutor(1) as pool:
        beside = drive(MapLocaliser(KNOWN), way, pool=pool)
    for a, b in zip(alone, beside):
        assert (a.state, a.probability, a.map_from_base, a.candidates) == (
            b.state, b.probability, b.map_from_base, b.candidates,
        )  # fmt: skip
        assert np.array_equal(a.covariance, b.covariance)


def test_a_result_that_is_due_is_asked_for() -> None:
    localiser = MapLocaliser(KNOWN)
    localiser.add_scan(0, points_at(Pose2(3.0, 4.5, 0.0)), Pose2())
    work = localiser.take_work()
    assert work is not None
    assert localiser.take_work() is None
    assert localiser.is_due(10**10)
    with pytest.raises(SearchIsDueError):
        localiser.add_scan(10**10, points_at(Pose2(3.0, 4.5, 0.0)), Pose2())
    localiser.apply(work.run())
    assert localiser.located(10**10).candidates


def test_a_hint_is_looked_at_first_and_a_start_is_believed_when_scans_agree() -> None:
    truth = Pose2(3.0, 4.5, 0.0)
    hinted = MapLocaliser(KNOWN)
    hinted.relocalise(Pose2(3.5, 4.3, 0.3), radius_m=1.5)
    hinted.add_scan(0, points_at(truth), Pose2())
    work = hinted.take_work()
    assert work is not None
    hinted.apply(work.run())
    assert off(hinted.located(0), truth) < 0.1
    started = MapLocaliser(KNOWN, start=Pose2(3.2, 4.4, 0.05))
    assert started.located(0).state is State.SEARCHING
    assert off(drive(started, [truth] * 4)[-1], truth) < 0.1


def test_asking_anew_forgets_places_and_work_under_way() -> None:
    localiser = MapLocaliser(KNOWN)
    drive(localiser, way_through(ROUND)[:60])
    localiser.relocalise()
    assert localiser.located(0).map_from_base is None
    assert localiser.located(0).probability == 0.0
    assert not localiser.is_due(1 << 60)
    localiser.apply(SearchResult(99, 0, localiser._crowd))
    assert localiser.located(0).map_from_base is None
    assert localiser.events["search_outdated"] == 1


def test_scans_with_too_few_points_change_nothing_but_the_odometry() -> None:
    localiser = MapLocaliser(KNOWN, start=Pose2(3.0, 4.5, 0.0))
    nothing = points_of(BEARINGS, np.full(len(BEARINGS), np.inf), Pose2(), nearest_m=0.1, farthest_m=20.0, most=90)
    localiser.add_scan(0, nothing, Pose2())
    located = localiser.add_scan(PERIOD_NS, nothing, Pose2(0.5, 0.0, 0.0))
    assert located.map_from_base is not None
    assert located.map_from_base.x_m == pytest.approx(3.5)
    assert localiser.events["scan_too_empty"] == 2


def test_without_odometry_slow_motion_is_followed() -> None:
    settings_ = InMapSettings()
    localiser = MapLocaliser(KNOWN, settings_, start=Pose2(2.6, 4.5, 0.0), start_sigma_m=0.1)
    pending = None
    for k in range(40):
        pose = Pose2(2.6 + 0.03 * k, 4.5, 0.0)
        if localiser.is_due(k * PERIOD_NS):
            assert pending is not None
            localiser.apply(pending)
        located = localiser.add_scan(k * PERIOD_NS, points_at(pose), None)
        work = localiser.take_work()
        pending = pending if work is None else work.run()
    assert off(located, pose) < 0.1
