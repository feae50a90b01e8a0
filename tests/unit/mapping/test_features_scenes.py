"""S25: a flat of rooms that are known, driven through; queries from other places in it, from elsewhere, and rubbish."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.features.graph import compare
from mapping.features.scenes import SCENE_FEATURES, RecogniseRules, SceneDatabase, sight_of
from mapping.frames import Pose2, wrap_angle
from mapping.scan import Scan

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-120.0, 120.01, 0.5))


def flat(seed: int = 7) -> F64:
    """Walls (K, 4) of three rooms in a row with doors, and cupboards at random places in each."""
    random = np.random.default_rng(seed)
    walls: list[list[float]] = [[0, 0, 15, 0], [0, 4, 15, 4], [0, 0, 0, 4], [15, 0, 15, 4]]
    for x, door in ((5.0, 1.0), (9.5, 2.4)):
        walls += [[x, 0, x, door], [x, door + 0.9, x, 4]]
    for room in ((0.4, 4.4), (5.4, 9.0), (10.0, 14.4)):
        for _ in range(3):
            x, y = random.uniform(room[0], room[1] - 1.0), random.choice([0.0, 3.4])
            w, h = random.uniform(0.4, 1.0), random.uniform(0.3, 0.6)
            walls += [[x, y, x + w, y], [x + w, y, x + w, y + h], [x + w, y + h, x, y + h], [x, y + h, x, y]]
    return np.array(walls, dtype=np.float64)


def scan_at(walls: F64, pose: Pose2, *, noise: float = 0.01, seed: int = 0) -> Scan:
    angle = BEARING + pose.yaw_rad
    d = np.stack((np.cos(angle), np.sin(angle)), axis=-1)[:, None]
    a, b = walls[:, :2] - [pose.x_m, pose.y_m], walls[:, 2:] - [pose.x_m, pose.y_m]
    side_a, side_b = d[..., 0] * a[:, 1] - d[..., 1] * a[:, 0], d[..., 0] * b[:, 1] - d[..., 1] * b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = side_a / (side_a - side_b)
        along = np.sum(d * (a + share[..., None] * (b - a)), axis=-1)
    along[~((share >= 0.0) & (share <= 1.0) & (along > 0.0))] = np.inf
    ranges = along.min(axis=1) + np.random.default_rng(seed).normal(0.0, noise, BEARING.size)
    return Scan(0, 0.0, BEARING, ranges, 0.05, 20.0)


DRIVE = [Pose2(1.0 + 0.5 * k, 1.5 + 0.9 * (k > 13), 0.0) for k in range(26)]
BESIDE = ((1.7, 1.8, 0.3), (3.2, 2.2, -0.4), (6.3, 1.9, 0.2), (8.2, 2.3, -0.2), (11.3, 2.1, 0.4))
PLACES = [Pose2(*pose) for pose in BESIDE]


def driven(walls: F64, rules: RecogniseRules | None = None) -> SceneDatabase:
    database = SceneDatabase(rules)
    for k, pose in enumerate(DRIVE):
        assert database.add(sight_of(scan_at(walls, pose, seed=k)), pose) == k
    return database


@pytest.fixture(scope="module")
def database() -> SceneDatabase:
    return driven(flat())


def test_places_beside_the_drive_are_found_without_a_hint(database: SceneDatabase) -> None:
    known = 0
    for k, pose in enumerate(PLACES):
        answer = database.where_am_i(sight_of(scan_at(flat(), pose, seed=100 + k)))
        if answer.place is None:
            assert answer.reason
            continue
        known += 1
        found = answer.place.map_from_sensor
        assert math.hypot(found.x_m - pose.x_m, found.y_m - pose.y_m) < 0.05
        assert abs(wrap_angle(found.yaw_rad - pose.yaw_rad)) < math.radians(1.0)
        assert answer.place.explained > 0.8
        assert answer.candidates[0] == answer.place
    assert known >= 4


def test_another_flat_is_unknown(database: SceneDatabase) -> None:
    for k, pose in enumerate(PLACES):
        stranger = flat(99) * [1.0, 1.3, 1.0, 1.3]
        assert database.where_am_i(sight_of(scan_at(stranger, pose, seed=k))).place is None


def test_rooms_that_are_alike_are_unknown_and_it_says_so() -> None:
    one = flat()
    twins = np.vstack((one, one + [100.0, 0.0, 100.0, 0.0]))
    database = SceneDatabase()
    for pose in DRIVE:
        for shift in (0.0, 100.0):
            at = Pose2(pose.x_m + shift, pose.y_m, pose.yaw_rad)
            database.add(sight_of(scan_at(twins, at)), at)
    answer = database.where_am_i(sight_of(scan_at(twins, PLACES[0], seed=5)))
    assert answer.place is None
    assert "alike" in answer.reason
    assert len(answer.candidates) >= 2


def test_the_answer_is_the_same_as_that_of_a_slow_search_through_all_graphs(database: SceneDatabase) -> None:
    """The index proposes the scenes that comparing graph by graph finds best."""
    for k, pose in enumerate(PLACES):
        sight = sight_of(scan_at(flat(), pose, seed=100 + k))
        answer = database.where_am_i(sight)
        best, most = None, 0
        for scene in range(len(database)):
            match = compare(sight.graph, database.graph(scene))
            if match is not None and len(match) > most:
                best, most = database.pose(scene) @ match.second_from_first, len(match)
        assert best is not None
        if answer.place is not None:
            found = answer.place.map_from_sensor
            assert math.hypot(found.x_m - best.x_m, found.y_m - best.y_m) < 0.3
            assert answer.place.partners >= most - 2


def test_scenes_that_came_late_are_found_like_the_first() -> None:
    late, whole = SceneDatabase(), driven(flat())
    query = sight_of(scan_at(flat(), PLACES[4], seed=104))
    for k, pose in enumerate(DRIVE):
        late.add(sight_of(scan_at(flat(), pose, seed=k)), pose)
        late.where_am_i(query)  # an index is made at each
    assert late.where_am_i(query) == whole.where_am_i(query)
    assert late.where_am_i(query) == late.where_am_i(query)


def test_a_scene_survives_its_bytes(database: SceneDatabase) -> None:
    copy = SceneDatabase()
    for scene in range(len(database)):
        assert copy.add_bytes(database.scene_bytes(scene)) == scene
    assert copy.anchors == database.anchors
    assert copy.pose(3) == database.pose(3)
    assert copy.scene_bytes(3) == database.scene_bytes(3)
    query = sight_of(scan_at(flat(), PLACES[0], seed=100))
    mine, theirs = copy.where_am_i(query).place, database.where_am_i(query).place
    assert mine is not None
    assert theirs is not None
    assert mine.scene == theirs.scene
    assert mine.score == pytest.approx(theirs.score, abs=0.02)


def test_damaged_bytes_are_refused(database: SceneDatabase) -> None:
    good = database.scene_bytes(0)
    random = np.random.default_rng(3)
    for cut in range(0, len(good) - 1, 97):
        with pytest.raises(ValueError, match="not a scene"):
            SceneDatabase().add_bytes(good[:cut])
    refused = 0
    for _ in range(300):
        damaged = bytearray(good)
        damaged[int(random.integers(len(good)))] ^= 1 << int(random.integers(8))
        try:
            SceneDatabase().add_bytes(bytes(damaged))
        except ValueError:
            refused += 1
    assert refused > 150  # a flipped bit of a pose is a pose; the store's hash finds it


def test_nothing_is_recognised_in_nothing() -> None:
    empty = SceneDatabase()
    sight = sight_of(scan_at(flat(), PLACES[0]))
    assert "no scenes" in empty.where_am_i(sight).reason
    for filler in (math.nan, math.inf, -math.inf, 0.0, 1e300):
        blind = sight_of(Scan(0, 0.0, BEARING, np.full(BEARING.size, filler), 0.05, 20.0))
        empty.add(blind, Pose2())
        answer = empty.where_am_i(blind)
        assert answer.place is None
        assert "too few" in answer.reason
    answer = empty.where_am_i(sight)
    assert answer.place is None
    assert "no stored scene" in answer.reason


def test_a_full_database_takes_no_more() -> None:
    small = SceneDatabase(most=2)
    sight = sight_of(scan_at(flat(), PLACES[0]))
    assert [small.add(sight, Pose2(float(k))) for k in range(4)] == [0, 1, None, None]
    assert len(small) == 2
    assert small.covers(Pose2(1.1))
    assert not small.covers(Pose2(2.0))
    assert not small.covers(Pose2(1.1, 0.0, 1.0))
    assert small.memory_bytes > 0


def test_the_newest_scenes_can_be_left_out() -> None:
    database = driven(flat())
    query = sight_of(scan_at(flat(), PLACES[0], seed=100))
    database.add(query, Pose2(50.0, 50.0, 1.0))  # what a robot that was carried away believes
    assert database.where_am_i(query).place is None
    place = database.where_am_i(query, skip_newest=1).place
    assert place is not None
    assert math.hypot(place.map_from_sensor.x_m - 1.7, place.map_from_sensor.y_m - 1.8) < 0.05
    assert "no scenes" in database.where_am_i(query, skip_newest=99).reason
    with pytest.raises(ValueError, match="skip_newest"):
        database.where_am_i(query, skip_newest=-1)


def test_vectors_find_the_scene_they_are_of(database: SceneDatabase) -> None:
    for scene in (0, 9, 20):
        sight = sight_of(scan_at(flat(), DRIVE[scene], seed=scene))
        (best, distance), (_, second) = database.similar(sight.vector, 2)
        assert (best, distance) == (scene, 0.0)
        assert 0.0 < second <= SCENE_FEATURES.farthest


def test_bad_input(database: SceneDatabase) -> None:
    with pytest.raises(ValueError, match="finite"):
        SceneDatabase().add(sight_of(scan_at(flat(), PLACES[0])), Pose2(math.nan))
    with pytest.raises(ValueError, match="least_score"):
        RecogniseRules(least_score=math.nan)
    with pytest.raises(ValueError, match="rise or fall"):
        sight_of(Scan(0, 0.0, np.array([0.0, 2.0, 1.0]), np.ones(3), 0.0, 9.0))
    with pytest.raises(IndexError):
        database.pose(999)
