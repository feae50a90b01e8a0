"""Calls about closures: what they tell, what they forget, and when."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.odometry import OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service import assemble
from service.background import Submit, at_once
from service.fusion import Cone, OdometryOnly, Round
from service.redraw import Redrawer
from service.rpc import CallRefused, Calls
from service.slam_live import SlamLocaliser, stored_or_none

F64 = NDArray[np.float64]

MS = 1_000_000
BEARING = np.linspace(-math.pi, math.pi, 241)[:-1]
WALLS = np.array(  # a room of 6 m by 5 m with a niche and a pillar: x0, y0, x1, y1
    [
        [-3.0, -2.0, 3.0, -2.0], [3.0, -2.0, 3.0, 3.0], [3.0, 3.0, 1.0, 3.0], [1.0, 3.0, 1.0, 2.2],
        [1.0, 2.2, -3.0, 2.2], [-3.0, 2.2, -3.0, -2.0], [-1.0, 1.2, -0.6, 1.2], [-0.6, 1.2, -0.6, 1.6],
    ]
)  # fmt: skip
SURE = np.diag([1e4, 1e4, 1e5])


def seen_from(pose: Pose2) -> F64:
    """Exact ranges to the walls."""
    ray = np.stack((np.cos(BEARING + pose.yaw_rad), np.sin(BEARING + pose.yaw_rad)), axis=-1)[:, None]
    a, along = WALLS[None, :, :2] - (pose.x_m, pose.y_m), WALLS[None, :, 2:] - WALLS[None, :, :2]
    cross = ray[..., 0] * along[..., 1] - ray[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (a[..., 0] * along[..., 1] - a[..., 1] * along[..., 0]) / cross
        share = (a[..., 0] * ray[..., 1] - a[..., 1] * ray[..., 0]) / cross
    return np.asarray(np.where((share >= 0.0) & (share <= 1.0) & (reach > 0.0), reach, np.inf).min(axis=1))


class Driver:
    """Drives a localiser along a line through the room, a scan each 0.2 s."""

    def __init__(self, submit: Submit = at_once) -> None:
        self.redrawer = Redrawer([], None, {"front": Pose2(0.0, 0.0, 0.0)}, submit=submit)
        self.localiser = SlamLocaliser(["front"], submit=submit, redrawer=self.redrawer)
        self.stamp_ns = 0
        self.odometry = PoseBuffer()

    def drive(self, scans: int, step_m: float = 0.12) -> None:
        for _ in range(scans):
            self.stamp_ns += 200 * MS
            x = -2.0 + step_m * self.stamp_ns / (200 * MS)
            pose = Pose2(x, -0.5, 0.05 * math.sin(x))
            self.odometry.add(self.stamp_ns, pose)
            scan = Scan(self.stamp_ns, 0.0, BEARING, seen_from(pose), 0.05, 20.0)
            self.localiser.take_scan("front", scan, self.odometry, Pose2(0.0, 0.0, 0.0))


@pytest.fixture
def driver() -> Driver:
    """Some key scans, too few for a piece of work, and three false closures."""
    made = Driver()
    made.drive(20)
    slam = made.localiser.slam
    assert 5 < slam.keys < 10
    for start, to in ((0, 4), (1, 5), (0, 2)):
        slam.add_closure(start, to, Pose2(1.0, 0.5, 0.2), SURE)
    return made


def test_closures_are_listed_with_how_far_off_they_are(driver: Driver) -> None:
    told: Any = driver.localiser.closures_told()
    assert [(each["from"], each["to"]) for each in told["closures"]] == [(0, 4), (1, 5), (0, 2)]
    slam = driver.localiser.slam
    poses = [Pose2(*row.tolist()) for row in slam.key_poses()]
    apart = (poses[0].inverse() @ poses[4]) if poses else Pose2(0.0, 0.0, 0.0)
    off = Pose2(1.0, 0.5, 0.2).inverse() @ apart
    assert told["closures"][0]["off_m"] == pytest.approx(math.hypot(off.x_m, off.y_m), abs=1e-3)
    assert told["closures"][0]["off_deg"] == pytest.approx(math.degrees(abs(off.yaw_rad)), abs=0.01)
    assert told["on_probation"] == []


@pytest.mark.parametrize(
    ("arguments", "gone"),
    [
        ({"number": 1}, {(1, 5)}),
        ({"first": 4, "second": 0}, {(0, 4)}),
        ({"number": 0, "near": 1}, {(0, 4), (1, 5)}),
        ({"first": 0, "second": 4, "near": 2}, {(0, 4), (1, 5), (0, 2)}),
    ],
)
def test_what_is_undone_is_told_and_gone(driver: Driver, arguments: dict[str, Any], gone: set[tuple[int, int]]) -> None:
    told: Any = driver.localiser.undo(arguments)
    assert {(each["from"], each["to"]) for each in told["undone"]} == gone
    left = {(each.start, each.to) for each in driver.localiser.slam.closures}
    assert left == {(0, 4), (1, 5), (0, 2)} - gone
    assert told["closures"] == len(left)
    assert driver.localiser.counters()["slam.closures_undone"] == len(gone)


def test_the_graph_settles_before_a_scan_that_stamps_alone_decide(driver: Driver) -> None:
    slam = driver.localiser.slam
    before = slam.key_poses()
    driver.localiser.undo({"number": 0, "near": 100})
    assert slam.is_working
    driver.drive(4)  # 0.8 s: the lag is longer
    assert slam.is_working
    driver.drive(2)
    np.testing.assert_allclose(slam.key_poses()[: len(before)], before, atol=1e-6)  # what the path alone says


def test_while_work_is_under_way_it_is_undone_afterwards(driver: Driver) -> None:
    slam = driver.localiser.slam
    while not slam.is_working:
        driver.drive(1)
    told: Any = driver.localiser.undo({"number": 0, "near": 100})
    assert len(told["undone"]) == 3
    assert told["closures"] == 0
    assert len(slam.closures) == 3
    driver.drive(6)
    assert {(each.start, each.to) for each in slam.closures} & {(0, 4), (1, 5), (0, 2)} == set()


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"first": 0},
        {"number": 0, "first": 0, "second": 4},
        {"number": "0"},
        {"number": True},
        {"number": -1},
        {"number": 0, "near": 1.5},
        {"number": 0, "all": 1},
        {"number": 99},
        {"first": 0, "second": 3},
    ],
)
def test_what_names_no_closure_is_refused_in_words_and_changes_nothing(
    driver: Driver, arguments: dict[str, Any]
) -> None:
    with pytest.raises(CallRefused, match=r"write|no such closure"):
        driver.localiser.undo(arguments)
    assert len(driver.localiser.slam.closures) == 3


def test_the_calls_are_there_with_slam_alone_and_answer_in_json(driver: Driver) -> None:
    calls = Calls("robots/x")
    for name, handler in assemble.closure_calls(driver.localiser, lambda work: work()):
        calls.register(name, handler)
    assert calls.names == ["list_closures", "undo_closure"]
    answer = json.loads(calls._call("undo_closure", b'{"number": 2}'))
    assert [each["number"] for each in answer["undone"]] == [2]
    assert len(json.loads(calls._call("list_closures", b""))["closures"]) == 2
    assert list(assemble.closure_calls(OdometryOnly(Pose2(0.0, 0.0, 0.0)), lambda work: work())) == []


# --- what is not drawn


class Wheels:
    """A robot whose odometry is told apart from where it is; a scan every 50 ms."""

    def __init__(self) -> None:
        self.localiser = SlamLocaliser(["front"], submit=at_once)
        self.odometry = PoseBuffer()
        self.stamp_ns = 0

    def look(self, truth: Pose2, odom: Pose2, ranges: F64 | None = None) -> bool:
        """Whether it is drawn."""
        self.stamp_ns += 50 * MS
        self.odometry.add(self.stamp_ns, odom)
        seen = seen_from(truth) if ranges is None else ranges
        scan = Scan(self.stamp_ns, 0.0, BEARING, seen, 0.05, 20.0)
        return self.localiser.take_scan("front", scan, self.odometry, Pose2())

    def place(self, odom: Pose2) -> Pose2:
        return self.localiser.map_from_odom() @ odom


@pytest.mark.parametrize(("way_m", "turn_rad"), [(0.0, 0.06), (0.0, -0.06), (0.08, 0.02)])
def test_wheels_that_tell_nothing_are_not_believed_for_long(way_m: float, turn_rad: float) -> None:
    """Carried or slipping: where a scan is drawn is never off by more than is seen, though odometry stands still."""
    robot, still = Wheels(), Pose2()
    truth = Pose2(0.3, -0.4, 0.0)
    for _ in range(3):
        robot.look(truth, still)
    start = robot.place(still)
    for step in range(1, 16):
        moved = Pose2(way_m * step, 0.0, turn_rad * step)
        assert robot.look(truth @ moved, still)
        off = (start @ moved).inverse() @ robot.place(still)
        assert math.hypot(off.x_m, off.y_m) < 0.2
        assert abs(off.yaw_rad) < 0.11
    assert robot.localiser.counters()["slam.scans_elsewhere"] > 3


def test_where_odometry_is_right_hardly_a_scan_is_matched_twice() -> None:
    robot = Wheels()
    rng = np.random.default_rng(3)
    for step in range(80):
        at = Pose2(-1.5 + 0.03 * step, -0.5, 0.3 * math.sin(0.1 * step))
        noise = rng.normal(0.0, 0.02, len(BEARING))
        assert robot.look(at, at, seen_from(at) + noise)
    assert robot.localiser.counters()["slam.scans_elsewhere"] == 0


def test_what_fits_nothing_is_not_drawn_until_something_fits_again() -> None:
    robot, here = Wheels(), Pose2(0.3, -0.4, 0.0)
    for _ in range(3):
        assert robot.look(here, here)
    clutter = np.random.default_rng(5).uniform(0.4, 0.6, len(BEARING))  # a cloth over the lens
    round_ = Round(robot.stamp_ns, (Cone(0, Pose2(), 1.0),), 0.5, 0.1, 3.0)
    for _ in range(30):
        robot.stamp_ns += 1000 * MS  # so long that a robot which stands looks anew
        assert not robot.look(here, here, clutter)
        assert not robot.localiser.take_round("sonars", round_, here)
    counts = robot.localiser.counters()
    assert counts["slam.scans_not_drawn"] == counts["slam.rounds_not_drawn"] == 30
    assert any("nothing is drawn" in trouble for trouble in robot.localiser.troubles())
    assert robot.look(here, here)
    assert robot.localiser.take_round("sonars", round_, here)


@pytest.mark.parametrize("left_m", [0.0, 20.0], ids=["left near by", "left elsewhere"])
def test_a_robot_that_was_never_found_may_be_anywhere_though_track_is_lost(left_m: float) -> None:
    """How far it can have been carried counts from where it was seen, not from where a stored map left it."""
    driver = Driver()
    driver.drive(20)
    keep = driver.localiser.kept()
    assert keep is not None
    redrawer = Redrawer([], None, {"front": Pose2()}, submit=at_once)
    again = SlamLocaliser(
        ["front"], start=Pose2(left_m, 0.0, 0.0), submit=at_once, redrawer=redrawer, stored=stored_or_none(keep()),
        lost_when_broken=True,
    )  # fmt: skip
    odometry, place = PoseBuffer(), Pose2(-1.8, 0.3, 0.1)
    for k in range(60):
        stamp_ns = driver.stamp_ns + k * 200 * MS
        state = OdometryState(stamp_ns, Pose2(), np.zeros((3, 3)), 0.0, 0.0, k == 1)
        odometry.add(stamp_ns, Pose2(), after_break=state.broken)
        again.take_odometry(state)
        again.take_scan("front", Scan(stamp_ns, 0.0, BEARING, seen_from(place), 0.05, 20.0), odometry, Pose2())
    assert again.is_placed()
    assert math.hypot(again.map_from_odom().x_m - place.x_m, again.map_from_odom().y_m - place.y_m) < 0.1


def test_a_map_that_begins_has_the_robot_where_it_is_said_to_be(driver: Driver) -> None:
    """Nothing of the map before is held against the next scans: they are drawn, by odometry, from the new origin."""
    localiser = driver.localiser
    odom = driver.odometry.at(driver.stamp_ns)
    localiser.begin_map(odom.inverse())
    assert localiser.slam.keys == 0
    assert localiser.is_placed()
    assert localiser.troubles() == []
    driver.drive(3)
    assert localiser.slam.keys
    map_from_base = localiser.map_from_odom() @ driver.odometry.at(driver.stamp_ns)
    expected = odom.inverse() @ driver.odometry.at(driver.stamp_ns)
    assert map_from_base.x_m == pytest.approx(expected.x_m, abs=0.02)
    assert map_from_base.y_m == pytest.approx(expected.y_m, abs=0.02)
    assert localiser.counters()["slam.scans_not_drawn"] == 0
