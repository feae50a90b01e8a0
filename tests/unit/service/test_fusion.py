"""Fusion with maps that only remember what they are told: order, waiting, dropping, staleness."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.readings import (
    ChainReading,
    DeviceEvent,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    ScanReading,
    WheelReading,
)
from mapping.frames import IDENTITY, Pose2
from mapping.odometry import DriveGeometry
from mapping.scan import Scan
from mapping.sectors.snapshot import PolarSnapshot
from service.fusion import Fusion, Parts, Round, Touch, carry, compose_many, stale_after_ns
from service.outputs import UNKNOWN_VARIANCE, OdomOut, Output, PolarOut, PoseOut, RangesOut, ScanOut
from service.sensors import Chain, Laser, Transducer, Wheels

MS = 1_000_000
GEOMETRY = DriveGeometry(
    wheel_radius_left_m=1 / (2 * math.pi),  # a metre a turn
    wheel_radius_right_m=1 / (2 * math.pi),
    track_width_m=0.5,
    ticks_per_turn_left=1000.0,  # so a millimetre a tick
    ticks_per_turn_right=1000.0,
)
LASER = Laser("front", Pose2(0.3, 0.0, 0.0), height_m=0.25)
CHAIN = Chain(
    "ring",
    (Transducer(1, Pose2(0.4, 0.1, 0.3)), Transducer(7, Pose2(0.4, -0.1, -0.3))),
    cone_rad=0.5,
    range_min_m=0.2,
    range_max_m=3.0,
)


@dataclass
class SectorDiary:
    """A sector layer that writes down what it is told; its one sector is free while the source is there."""

    sources: frozenset[str]
    scans: list[tuple[Scan, Pose2]] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    state: int = 2

    def take_scan(self, source: str, scan: Scan, base_from_sensor: Pose2) -> None:
        self.scans.append((scan, base_from_sensor))
        self.state = 1

    def take_touch(self, source: str, touch: Touch) -> None:
        raise AssertionError("no switch feeds it")

    def take_round(self, source: str, heard: Round) -> None:
        self.rounds.append(heard)
        self.state = 1

    def lose(self, source: str) -> None:
        self.lost.append(source)
        self.state = 3

    def output(self, now_ns: int) -> PolarOut:
        one = np.zeros(1)
        snapshot = PolarSnapshot(
            now_ns,
            IDENTITY,
            np.array([-1.0, 1.0]),
            np.array([self.state], dtype=np.int8),
            one,
            one,
            one,
            np.zeros(1, dtype=np.int64),
            np.zeros(1, dtype=np.int16),
            tuple(sorted(self.sources)),
        )
        return PolarOut("diary", snapshot)


@dataclass
class GridDiary:
    """A grid layer that writes down what it is told."""

    sources: frozenset[str]
    sweeps: list[tuple[str, Scan, NDArray[np.float64]]] = field(default_factory=list)
    rounds: list[tuple[Round, Pose2]] = field(default_factory=list)

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: NDArray[np.float64]) -> None:
        self.sweeps.append((source, scan, np.atleast_2d(map_from_sensor)))

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        raise AssertionError("no switch draws it")

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        self.rounds.append((heard, map_from_base))

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        return []


class Driven(Fusion):
    """Fusion that settles after every item, as its thread does."""

    def on_item(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> list[Output]:
        outputs = super().on_item(source, item, now_ns)
        self.settle(now_ns)
        return outputs


@dataclass
class Bench:
    """Fusion between a driver's hand and two diaries."""

    fusion: Driven
    sectors: SectorDiary
    grid: GridDiary


def bench(*, drive: bool = True, wait_ms: int = 500) -> Bench:
    sources = frozenset({"front", "ring"})
    sectors, grid = SectorDiary(sources), GridDiary(sources)
    parts = Parts(
        sensors={"front": LASER, "ring": CHAIN, "drive": Wheels("drive")},
        sectors=(sectors,),
        grids=(grid,),
        drive=("drive", GEOMETRY) if drive else None,
        wait_ns=wait_ms * MS,
    )
    return Bench(Driven(parts), sectors, grid)


def scan(stamp_ns: int, *, beams: int = 5, beam_period_ns: float = 0.0, range_m: float = 2.0) -> ScanReading:
    return ScanReading(
        stamp_ns,
        beam_period_ns,
        100 * MS,
        np.linspace(-1.0, 1.0, beams),
        np.full(beams, range_m),
        0.05,
        10.0,
    )


def wheels(stamp_ns: int, left: int, right: int, *, continuous: bool = True) -> WheelReading:
    return WheelReading(stamp_ns, left, right, continuous)


# --- lasers


def test_a_scan_is_published_at_once_and_feeds_the_sectors() -> None:
    b = bench()
    outputs = b.fusion.on_item("front", scan(100 * MS), 130 * MS)
    assert [type(each) for each in outputs] == [PolarOut, ScanOut]
    assert isinstance(outputs[1], ScanOut)
    assert outputs[1].scan.stamp_ns == 100 * MS
    assert outputs[1].height_m == 0.25
    assert len(b.sectors.scans) == 1
    assert b.grid.sweeps == []  # no odometry has been heard yet


def test_a_scan_goes_into_the_grid_when_odometry_covers_all_of_it() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(90 * MS, 0, 0), 90 * MS)
    b.fusion.on_item("front", scan(100 * MS, beam_period_ns=5 * MS), 120 * MS)
    b.fusion.on_item("drive", wheels(119 * MS, 29, 29), 119 * MS)
    assert b.grid.sweeps == []  # the last beam was at 120 ms
    b.fusion.on_item("drive", wheels(130 * MS, 40, 40), 130 * MS)
    source, _, poses = b.grid.sweeps[0]
    assert source == "front"
    assert poses[:, 0] == pytest.approx([0.310, 0.315, 0.320, 0.325, 0.330], abs=1e-9)  # 1 m/s, laser 0.3 m ahead
    assert poses[:, 1:] == pytest.approx(np.zeros((5, 2)), abs=1e-12)


def test_scans_that_wait_go_in_by_stamps_whatever_the_order_they_came_in() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(0, 0, 0), 0)
    b.fusion.on_item("ring", ring(60 * MS, 1.0), 65 * MS)
    b.fusion.on_item("front", scan(50 * MS), 70 * MS)
    assert (b.grid.sweeps, b.grid.rounds) == ([], [])
    b.fusion.on_item("drive", wheels(55 * MS, 0, 0), 71 * MS)
    assert (len(b.grid.sweeps), len(b.grid.rounds)) == (1, 0)
    b.fusion.on_item("drive", wheels(80 * MS, 0, 0), 81 * MS)
    assert (len(b.grid.sweeps), len(b.grid.rounds)) == (1, 1)


def test_a_scan_without_odometry_is_dropped_in_time_and_the_culprit_named() -> None:
    b = bench(wait_ms=500)
    b.fusion.on_item("drive", wheels(0, 0, 0), 0)
    b.fusion.on_item("front", scan(100 * MS), 130 * MS)
    b.fusion.tick(600 * MS)
    assert "front" not in b.fusion.drops
    assert b.fusion.troubles(600 * MS) == []
    b.fusion.tick(631 * MS)
    assert b.fusion.drops["front"] == {"odometry_late": 1}
    assert "drive" in b.fusion.troubles(640 * MS)[0]
    assert b.grid.sweeps == []
    b.fusion.on_item("drive", wheels(700 * MS, 0, 0), 700 * MS)
    b.fusion.on_item("front", scan(690 * MS), 701 * MS)
    assert len(b.grid.sweeps) == 1
    assert b.fusion.troubles(701 * MS) == []


def test_a_scan_from_before_the_first_odometry_is_not_drawn_and_no_loss() -> None:
    b = bench()
    b.fusion.on_item("front", scan(100 * MS), 130 * MS)
    b.fusion.on_item("drive", wheels(150 * MS, 0, 0), 150 * MS)
    assert b.grid.sweeps == []
    assert b.fusion.drops == {}


def test_a_sweep_across_a_break_of_the_track_is_dropped() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(90 * MS, 0, 0), 90 * MS)
    b.fusion.on_item("drive", wheels(100 * MS, 0, 0), 100 * MS)
    b.fusion.on_item("front", scan(95 * MS, beam_period_ns=10 * MS), 140 * MS)
    b.fusion.on_item("drive", wheels(120 * MS, 9000, 0, continuous=False), 141 * MS)
    b.fusion.on_item("drive", wheels(140 * MS, 9000, 0), 142 * MS)
    assert b.grid.sweeps == []
    assert set(b.fusion.drops["front"]) <= {"odometry_gone", "odometry_broken"}


def test_without_a_drive_the_robot_is_taken_to_stand() -> None:
    b = bench(drive=False)
    b.fusion.on_item("front", scan(100 * MS), 130 * MS)
    assert b.grid.sweeps[0][2] == pytest.approx(np.array([[0.3, 0.0, 0.0]]))
    assert "[drive]" in b.fusion.troubles(0)[0]
    assert b.fusion.pose() == IDENTITY


def test_sectors_see_from_where_the_robot_is_now() -> None:
    """At 1 m/s: the scan began 20 ms ago, 2 cm behind; a wall 2 m ahead of the laser then is nearer now."""
    b = bench()
    b.fusion.on_item("drive", wheels(90 * MS, 0, 0), 90 * MS)
    b.fusion.on_item("drive", wheels(120 * MS, 30, 30), 120 * MS)
    b.fusion.on_item("front", scan(100 * MS, beams=5, beam_period_ns=0.0), 121 * MS)
    seen, base_from_sensor = b.sectors.scans[0]
    ahead = base_from_sensor.apply(seen.points())[2]
    assert ahead == pytest.approx([2.3 - 0.02, 0.0], abs=1e-9)
    assert seen.stamp_ns == 100 * MS


def test_sectors_do_not_wait_for_odometry_but_hold_the_newest_pose() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(90 * MS, 0, 0), 90 * MS)
    b.fusion.on_item("drive", wheels(105 * MS, 15, 15), 106 * MS)
    b.fusion.on_item("front", scan(100 * MS, beam_period_ns=5 * MS), 121 * MS)
    seen, base_from_sensor = b.sectors.scans[0]
    points = base_from_sensor.apply(seen.points())
    assert points[2] == pytest.approx([2.3, 0.0], abs=1e-9)  # beam at 110 ms: the pose of 105 ms is held
    first = LASER.base_from_sensor.apply(np.array([2 * math.cos(-1), 2 * math.sin(-1)]))
    assert points[0] == pytest.approx([first[0] - 0.005, first[1]], abs=1e-9)  # beam at 100 ms, 5 mm behind


def test_a_laser_mounted_head_down_counts_the_other_way() -> None:
    fusion = Fusion(Parts(sensors={"front": replace(LASER, upside_down=True)}))
    outputs = fusion.on_item("front", scan(0, beams=3), 1)
    assert isinstance(outputs[0], ScanOut)
    assert list(outputs[0].scan.bearing_rad) == [1.0, 0.0, -1.0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"range_m": np.ones(4)}, "wrong_count"),
        ({"bearing_rad": np.ones((5, 1)), "range_m": np.ones((5, 1))}, "wrong_count"),
        ({"bearing_rad": np.ones(0), "range_m": np.ones(0)}, "no_beams"),
        ({"bearing_rad": np.zeros(100_001), "range_m": np.zeros(100_001)}, "too_many_beams"),
        ({"bearing_rad": np.array([0.0, 1.0, np.nan, 2.0, 3.0])}, "bearing_not_finite"),
        ({"beam_period_ns": math.nan}, "times_wrong"),
        ({"beam_period_ns": -1.0}, "times_wrong"),
        ({"beam_period_ns": 1e12}, "times_wrong"),
        ({"range_max_m": math.inf}, "limits_wrong"),
        ({"range_min_m": 11.0}, "limits_wrong"),
        ({"range_min_m": -0.1}, "limits_wrong"),
        ({"stamp_ns": 99 * MS}, "stamp_backward"),
        ({"stamp_ns": 100 * MS}, "stamp_equal"),
        ({"stamp_ns": 10**15}, "stamp_ahead"),
    ],
)
def test_a_scan_that_is_none_changes_nothing_and_is_counted(change: dict[str, object], reason: str) -> None:
    b = bench()
    b.fusion.on_item("front", scan(100 * MS), 110 * MS)
    bad = replace(scan(200 * MS), **change)  # type: ignore[arg-type]
    assert b.fusion.on_item("front", bad, 210 * MS) == []
    assert b.fusion.drops["front"] == {reason: 1}
    assert len(b.sectors.scans) == 1
    assert b.fusion.on_item("front", scan(300 * MS), 310 * MS) != []


def test_impossible_ranges_become_invalid_and_the_others_stay() -> None:
    b = bench()
    given = np.array([0.0, -1.0, 10.5, np.inf, -np.inf, np.nan, 5.0])
    reading = replace(scan(0, beams=7), range_m=given)
    outputs = b.fusion.on_item("front", reading, 1)
    assert isinstance(outputs[1], ScanOut)
    assert np.array_equal(outputs[1].scan.range_m, [np.nan] * 3 + [np.inf, -np.inf, np.nan, 5.0], equal_nan=True)
    assert b.fusion.drops["front"] == {"range_out_of_bounds": 3}
    assert given[0] == 0.0  # the reading itself is not ours to change


# --- sonars


def ring(stamp_ns: int, *ranges: float, status: RangeStatus = RangeStatus.ECHO) -> ChainReading:
    return ChainReading(stamp_ns, tuple(RangeReading(channel, each, status) for channel, each in zip((1, 7), ranges)))


def test_a_round_is_published_whole_with_what_is_still_fresh() -> None:
    b = bench()
    b.fusion.on_item("ring", ring(0, 1.0, 2.0), 10 * MS)
    outputs = b.fusion.on_item("ring", ring(100 * MS, 1.5), 110 * MS)
    assert isinstance(outputs[0], RangesOut)
    assert outputs[0].range_m == (1.5, 2.0)
    assert [each.channel for each in b.sectors.rounds[-1].cones] == [1]
    outputs = b.fusion.on_item("ring", ring(900 * MS, 1.5), 910 * MS)
    assert isinstance(outputs[0], RangesOut)
    assert outputs[0].range_m[0] == 1.5
    assert math.isnan(outputs[0].range_m[1])


@pytest.mark.parametrize(
    ("status", "given", "expected"),
    [
        (RangeStatus.ECHO, 1.0, 1.0),
        (RangeStatus.ECHO, 3.5, math.inf),
        (RangeStatus.ECHO, 0.1, -math.inf),
        (RangeStatus.ECHO, math.nan, math.nan),
        (RangeStatus.ECHO, -1.0, math.nan),
        (RangeStatus.NO_RETURN, math.inf, math.inf),
        (RangeStatus.TOO_CLOSE, -math.inf, -math.inf),
        (RangeStatus.INVALID, 1.0, math.nan),
        (RangeStatus.STALE, 1.0, math.nan),
        (RangeStatus.NOT_LOOKED, math.inf, math.nan),
    ],
)
def test_the_status_says_what_a_range_means(status: RangeStatus, given: float, expected: float) -> None:
    b = bench()
    b.fusion.on_item("ring", ring(0, given, status=status), 1)
    assert b.sectors.rounds[0].cones[0].range_m == pytest.approx(expected, nan_ok=True)


def test_an_echo_of_another_transducer_proves_nothing() -> None:
    b = bench()
    b.fusion.on_item("ring", ChainReading(0, (RangeReading(1, 1.0, RangeStatus.ECHO, heard_from=7),)), 1)
    assert math.isnan(b.sectors.rounds[0].cones[0].range_m)


def test_groups_that_fire_together_share_a_stamp_but_a_channel_does_not_repeat_its_own() -> None:
    b = bench()
    one, seven = (ChainReading(50 * MS, (RangeReading(c, 1.0, RangeStatus.ECHO),)) for c in (1, 7))
    assert b.fusion.on_item("ring", one, 60 * MS) != []
    assert b.fusion.on_item("ring", seven, 60 * MS) != []
    assert b.fusion.drops == {}
    assert b.fusion.on_item("ring", one, 60 * MS) == []
    assert b.fusion.drops["ring"] == {"stamp_equal": 1}


def test_a_channel_nobody_configured_is_counted() -> None:
    b = bench()
    reading = ChainReading(0, (RangeReading(3, 1.0, RangeStatus.ECHO), RangeReading(4, 1.0, RangeStatus.NOT_LOOKED)))
    assert b.fusion.on_item("ring", reading, 1) == []
    assert b.fusion.drops["ring"] == {"unknown_channel": 1}


# --- wheels


def test_wheels_move_the_robot() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(0, 0, 0), 0)
    outputs = b.fusion.on_item("drive", wheels(100 * MS, 100, 100), 100 * MS)
    assert isinstance(outputs[0], OdomOut)
    assert outputs[0].odom_from_base.x_m == pytest.approx(0.1)
    assert outputs[0].forward_m_s == pytest.approx(1.0)
    assert isinstance(outputs[1], PoseOut)
    assert outputs[1].map_from_base.x_m == pytest.approx(0.1)
    assert outputs[1].map_from_odom == IDENTITY


def test_how_fast_it_drives_is_told_with_how_surely() -> None:
    """The variances were 0: a filter that fuses the speed would have believed it without any doubt."""
    b = bench()

    def told(at_ms: int, left: int, right: int, *, continuous: bool = True) -> tuple[float, float]:
        reading = wheels(at_ms * MS, left, right, continuous=continuous)
        out = b.fusion.on_item("drive", reading, at_ms * MS)[0]
        assert isinstance(out, OdomOut)
        return out.forward_variance, out.yaw_rate_variance

    assert told(0, 0, 0) == (UNKNOWN_VARIANCE, UNKNOWN_VARIANCE), "no step yet"
    per_m = GEOMETRY.travel_noise_m_per_sqrt_m**2
    noise = per_m * (0.1 + 0.12)  # of both wheels' ways
    at_least = 1e-4
    forward, turn = noise / 4 / 0.1**2 + at_least, noise / 0.5**2 / 0.1**2 + at_least
    assert told(100, 100, 120) == pytest.approx((forward, turn), rel=0.01)
    assert told(200, 220, 220) == pytest.approx((forward, turn), rel=0.01)
    assert told(300, 220, 220) == pytest.approx((1e-4, 1e-4)), "it stands, to a count"
    assert told(400, 400, 400, continuous=False) == (UNKNOWN_VARIANCE, UNKNOWN_VARIANCE)


def test_a_new_map_begins_where_the_robot_stands() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(0, 0, 0), 0)
    b.fusion.on_item("drive", wheels(100 * MS, 100, 140), 100 * MS)
    b.fusion.begin_map()
    pose = b.fusion.pose()
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    outputs = b.fusion.on_item("drive", wheels(200 * MS, 200, 240), 200 * MS)
    assert isinstance(outputs[1], PoseOut)
    assert (outputs[1].map_from_base.x_m, outputs[1].map_from_base.y_m) == pytest.approx((0.1, 0.0), abs=1e-9)


def test_a_pose_is_published_at_most_forty_times_a_second() -> None:
    b = bench()
    poses = [
        output
        for step in range(100)
        for output in b.fusion.on_item("drive", wheels(step * 10 * MS, step, step), step * 10 * MS)
        if isinstance(output, PoseOut)
    ]
    assert 20 <= len(poses) <= 40


def test_counts_no_wheel_can_have_made_are_dropped_and_believed_only_if_they_stay() -> None:
    b = bench()
    b.fusion.on_item("drive", wheels(0, 0, 0), 0)
    b.fusion.on_item("drive", wheels(10 * MS, 100_000, 0), 10 * MS)  # 100 m in 10 ms
    outputs = b.fusion.on_item("drive", wheels(20 * MS, 20, 20), 20 * MS)
    assert isinstance(outputs[0], OdomOut)
    assert outputs[0].odom_from_base.x_m == pytest.approx(0.02)
    results = [b.fusion.on_item("drive", wheels((30 + 10 * n) * MS, 100_000, 0), (30 + 10 * n) * MS) for n in range(6)]
    assert [len(each) for each in results[:5]] == [0] * 5
    assert isinstance(results[5][0], OdomOut)
    assert results[5][0].odom_from_base.x_m == pytest.approx(0.02)  # unknown is not motion
    assert results[5][0].covariance[0, 0] > 1e-3
    assert b.fusion.drops["drive"]["too_fast"] == 7


def test_wheels_that_drive_nothing_are_ignored() -> None:
    b = bench(drive=False)
    assert b.fusion.on_item("drive", wheels(0, 0, 0), 0) == []


# --- devices that come and go


@pytest.mark.parametrize("state", [LinkState.ABSENT, LinkState.SILENT, LinkState.STARTING])
def test_a_lost_device_makes_its_sectors_stale_at_once(state: LinkState) -> None:
    b = bench()
    b.fusion.on_item("front", scan(0), 10 * MS)
    outputs = b.fusion.on_item("front", DeviceEvent(20 * MS, state, "gone"), 21 * MS)
    assert [type(each) for each in outputs] == [PolarOut]
    assert isinstance(outputs[0], PolarOut)
    assert outputs[0].snapshot.state[0] == 3
    assert b.sectors.lost == ["front"]


def test_a_device_that_says_nothing_more_is_stale_after_three_periods() -> None:
    b = bench()
    b.fusion.on_item("front", scan(1000 * MS), 1025 * MS)  # 100 ms period
    b.fusion.tick(1300 * MS)
    assert b.sectors.lost == []
    outputs = b.fusion.tick(1301 * MS)
    assert b.sectors.lost == ["front"]
    assert any(isinstance(each, PolarOut) and each.snapshot.state[0] == 3 for each in outputs)


@pytest.mark.parametrize(("period", "sweep", "limit"), [(25, 19, 94), (100, 67, 367), (400, 0, 500), (0, 0, 500)])
def test_staleness_follows_the_period_but_never_passes_half_a_second(period: int, sweep: int, limit: int) -> None:
    assert stale_after_ns(period * MS, sweep * MS) == limit * MS


def test_sectors_are_published_at_least_ten_times_a_second() -> None:
    b = bench()
    told = [n for n in range(40) if any(isinstance(o, PolarOut) for o in b.fusion.tick(n * 25 * MS))]
    assert 10 <= len(told) <= 20


def test_sonars_that_follow_each_other_closely_are_published_together() -> None:
    b = bench()
    assert any(isinstance(each, PolarOut) for each in b.fusion.on_item("ring", ring(0, 1.0), 10 * MS))
    assert not any(isinstance(each, PolarOut) for each in b.fusion.on_item("ring", ring(MS, 2.0), 15 * MS))
    assert any(isinstance(each, PolarOut) for each in b.fusion.tick(26 * MS))
    assert len(b.sectors.rounds) == 2


def test_readings_from_nowhere_are_counted() -> None:
    b = bench()
    assert b.fusion.on_item("nobody", scan(0), 1) == []
    assert b.fusion.on_item("drive", scan(0), 1) == []
    assert b.fusion.drops == {"nobody": {"not_configured": 1}, "drive": {"wrong_kind": 1}}
    assert b.fusion.on_item("nobody", DeviceEvent(0, LinkState.ABSENT, "x"), 1) == []


# --- algebra


def test_poses_compose_one_by_one_as_they_do_together() -> None:
    one = Pose2(1.0, -2.0, 0.7)
    many = [Pose2(0.3 * k, 0.1 - k, 0.9 * k) for k in range(-3, 4)]
    rows = np.array([[p.x_m, p.y_m, p.yaw_rad] for p in many])
    for got, expected in (
        (compose_many(one, rows), [one @ p for p in many]),
        (carry(rows, one), [p @ one for p in many]),
    ):
        for row, pose in zip(got, expected):
            assert row[:2] == pytest.approx([pose.x_m, pose.y_m])
            assert math.cos(row[2] - pose.yaw_rad) == pytest.approx(1.0)


@pytest.mark.parametrize("nothing_is_free", [True, False])
def test_nothing_seen_is_free_or_unknown_as_configured(nothing_is_free: bool) -> None:
    laser = replace(LASER, nothing_is_free=nothing_is_free)
    fusion = Fusion(Parts(sensors={"front": laser}))
    told = [
        out.scan
        for out in fusion.on_item("front", scan(1000 * MS, range_m=np.inf), 1000 * MS)
        if isinstance(out, ScanOut)
    ]
    assert np.isposinf(told[0].range_m).all() == nothing_is_free
    assert np.isnan(told[0].range_m).all() != nothing_is_free
