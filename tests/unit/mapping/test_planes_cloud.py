"""Sweeps of a tilting laser as clouds: against the emulated mount, closed forms, and numpy's interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2, Pose3
from mapping.planes.cloud import AngleBuffer, Axle, SweepGatherer, SweepPoints, TiltMount, points_of_sweep
from mapping.pose_buffer import GoneError, NotYetError, PoseBuffer
from mapping.scan import Scan
from sim_devices.device import Mount
from sim_devices.mount_nodding import Swing, TiltedScene

F64 = NDArray[np.float64]
MS = 1_000_000


def angles_of(swing: Swing, until_ns: int, every_ns: int = 5 * MS) -> AngleBuffer:
    buffer = AngleBuffer()
    for stamp in range(0, until_ns + 1, every_ns):
        assert buffer.add(stamp, float(swing.angle_at(np.array([float(stamp)]))[0]))
    return buffer


@pytest.mark.parametrize("axle", ["pitch", "roll", "yaw"])
def test_rays_are_those_of_the_emulated_mount(axle: Axle) -> None:
    """The emulator has its own arithmetic; both must send each beam the same way from the same place."""
    swing = Swing(period_s=3.0, middle_rad=0.2, swing_rad=0.5)
    scene = TiltedScene(None, swing, axle, arm_m=(0.1, -0.05, 0.07), roll_rad=0.3)  # type: ignore[arg-type]
    bearing = np.linspace(-2.0, 2.0, 41)
    stamps = np.linspace(0.0, 160.0 * MS, 41)
    origin, direction = scene.beams(Mount(0.3, -0.1, 0.6, 0.8), bearing, stamps)
    mount = TiltMount(Pose3(0.3, -0.1, 0.6, 0.0, 0.0, 0.8), axle, Pose3(0.1, -0.05, 0.07, 0.3))
    ours = mount.rays(bearing, swing.angle_at(stamps))
    np.testing.assert_allclose(ours[0], origin, atol=1e-12)
    np.testing.assert_allclose(ours[1], direction, atol=1e-12)


def test_a_wall_stays_flat_while_the_vehicle_turns_and_the_laser_nods() -> None:
    """Ranges to the plane x = 5 of the odom frame, in closed form; every point must lie on it."""
    mount = TiltMount(Pose3(0.2, 0.0, 0.5), "pitch", Pose3(0.08, 0.0, 0.03))
    swing, poses = Swing(period_s=2.0), PoseBuffer()
    for k in range(101):
        stamp = k * 10 * MS
        poses.add(stamp, Pose2(0.4 * k * 0.01, 0.1 * k * 0.01, 0.8 * k * 0.01))
    angles = angles_of(swing, 1000 * MS, every_ns=MS)
    bearing = np.linspace(-0.5, 0.5, 61)
    scan = Scan(300 * MS, 2.0 * MS, bearing, np.zeros(61), 0.05, 30.0)
    stamps = 300 * MS + np.arange(61) * 2 * MS
    origin, direction = mount.rays(bearing, angles.at(stamps))
    base = poses.at_many(stamps)
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    x = base[:, 0] + c * origin[:, 0] - s * origin[:, 1]
    ranges = (5.0 - x) / (c * direction[:, 0] - s * direction[:, 1])
    ranges[::7] = (np.inf, np.nan, -np.inf, np.inf, np.inf, np.nan, np.inf, np.inf, np.inf)
    sweep = points_of_sweep(Scan(scan.stamp_ns, 2.0 * MS, bearing, ranges, 0.05, 30.0), angles, mount, poses)
    assert sweep.stamp_ns == stamps[30]
    assert sweep.points_m.shape == (52, 3)
    in_odom = Pose3.from_plane(poses.at(sweep.stamp_ns)).apply(sweep.points_m)
    np.testing.assert_allclose(in_odom[:, 0], 5.0, atol=1e-9)
    assert np.ptp(in_odom[:, 2]) > 0.1
    standing = points_of_sweep(Scan(scan.stamp_ns, 2.0 * MS, bearing, ranges, 0.05, 30.0), angles, mount)
    assert np.ptp(standing.points_m[:, 0]) > 0.05, "without the vehicle's motion the wall bends"


def test_angles_between_readings_never_beyond() -> None:
    buffer = AngleBuffer(capacity=8)
    with pytest.raises(NotYetError):
        buffer.at(np.array([0]))
    stamps = np.arange(20) * 10 * MS
    angle = np.cumsum(np.random.default_rng(1).uniform(-0.3, 0.3, 20))
    for stamp, value in zip(stamps.tolist(), angle.tolist()):
        assert buffer.add(stamp, value)
    assert len(buffer) == 8
    asked = np.linspace(stamps[-8], stamps[-1], 57).astype(np.int64)
    np.testing.assert_allclose(buffer.at(asked), np.interp(asked, stamps, angle), atol=1e-12)
    with pytest.raises(NotYetError):
        buffer.at(stamps[-1:] + 1)
    with pytest.raises(GoneError):
        buffer.at(stamps[-8:-7] - 1)
    assert not buffer.add(int(stamps[-1]), 0.0)
    assert not buffer.add(int(stamps[-1]) + 5, np.nan)
    buffer.clear()
    with pytest.raises(NotYetError):
        buffer.at(stamps[-1:])


def test_a_gap_or_half_a_turn_is_not_bridged() -> None:
    buffer = AngleBuffer(max_gap_ns=100 * MS)
    for stamp, value in ((0, 0.0), (50 * MS, 0.1), (200 * MS, 0.2), (250 * MS, 3.5)):
        buffer.add(stamp, value)
    buffer.at(np.array([0, 25 * MS, 50 * MS, 200 * MS, 250 * MS]))
    for between in (100 * MS, 225 * MS):
        with pytest.raises(GoneError):
            buffer.at(np.array([between]))


def sweep_at(first_rad: float, last_rad: float, points: int = 3) -> SweepPoints:
    return SweepPoints(np.full((points, 3), 1.0), np.zeros((points, 3)), 0, first_rad, last_rad)


def test_a_nod_is_a_cloud() -> None:
    gatherer = SweepGatherer(turning=False, least_swing_rad=0.4)
    swing = 0.5 * np.sin(np.arange(400) * 2.0 * np.pi / 100.0)
    ends = [k for k in range(1, 400) if gatherer.add(sweep_at(swing[k - 1], swing[k]), Pose2()) is not None]
    assert 7 <= len(ends) <= 8, "two a period of 100 sweeps, but for the beginning"
    assert set(np.diff(ends[1:]).tolist()) <= {49, 50, 51}


def test_a_turn_is_a_cloud_and_points_move_with_the_vehicle() -> None:
    gatherer = SweepGatherer(turning=True)
    clouds = []
    for k in range(1, 101):
        cloud = gatherer.add(sweep_at(0.2 * (k - 1), 0.2 * k), Pose2(0.01 * k, 0.0, 0.0))
        if cloud is not None:
            clouds.append((k, cloud))
    assert [k for k, _ in clouds] == [32, 64, 96]
    cloud = clouds[0][1]
    assert cloud.shape == (96, 3)
    np.testing.assert_allclose(cloud[-1], (1.0, 1.0, 1.0))
    np.testing.assert_allclose(cloud[0], (1.0 - 0.31, 1.0, 1.0), atol=1e-12)


def test_a_cloud_has_a_bound() -> None:
    gatherer = SweepGatherer(turning=True, most_points=10)
    sizes = [gatherer.add(sweep_at(0.0, 0.0), Pose2()) for _ in range(8)]
    assert [None if c is None else len(c) for c in sizes] == [None, None, None, 12, None, None, None, 12]


def test_an_empty_sweep_and_wrong_settings() -> None:
    angles = angles_of(Swing(), 100 * MS)
    empty = points_of_sweep(Scan(0, 0.0, np.empty(0), np.empty(0), 0.1, 5.0), angles, TiltMount())
    assert empty.points_m.shape == (0, 3)
    with pytest.raises(ValueError, match="axle"):
        TiltMount(axle="spin")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least two"):
        AngleBuffer(capacity=1)
