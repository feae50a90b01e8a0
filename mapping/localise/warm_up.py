"""Load or compile every kernel of localisation before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import math

import numpy as np

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.localise.calibrate import LEAST_MOTIONS, RobotModel, WheelTicks, calibrate
from mapping.localise.in_map import MapLocaliser
from mapping.localise.kept_sweeps import kept_sweep
from mapping.localise.known_map import known_map, points_of
from mapping.localise.pose_graph import Edges, optimise
from mapping.localise.relative_motions import RelativeMotions
from mapping.localise.scan_match import agreement, match_view
from mapping.localise.search import find_view, raster_of
from mapping.localise.slam import Slam
from mapping.localise.slam_records import SlamSettings
from mapping.localise.sweep_change import depths_of, is_changed
from mapping.localise.views import table_for
from mapping.scan import Scan


def warm_up() -> None:
    """Drive past two walls and back, in numbers that are thrown away; one search, one optimisation.

    That also loads the solver of the pose graph: with the first closure of a drive, its import would hold all threads
    up for a tenth of a second and more.
    """
    bearing = np.linspace(-math.pi, math.pi, 90, endpoint=False)
    slam = Slam(SlamSettings(work_keys=2, lag_s=0.0, lag_s_per_key=0.0))
    for step in range(6):
        at = 0.4 * step
        with np.errstate(divide="ignore"):
            walls = np.minimum(2.0 / np.abs(np.sin(bearing)), 3.0 / np.abs(np.cos(bearing)) + at * 0.1)
        scan = Scan(step * 100_000_000, 0.0, bearing, walls, 0.05, 30.0)
        slam.add_scan(scan, odom_from_base=Pose2(at, 0.0, 0.0))
        work = slam.take_work()
        if work is not None:
            slam.apply(work.run())
    snapshot = slam.snapshot()
    rows = np.arange(snapshot.views.count)
    view = snapshot.views.view(0)
    match_view(view, snapshot.views, rows, snapshot.poses, Pose2())
    agreement(view, snapshot.views, rows, snapshot.poses, Pose2())
    for window_m in (1.0, 6.0):  # two sizes of blocks
        raster = raster_of(snapshot.views, rows, snapshot.poses, window_m=window_m)
        find_view(view, raster, Pose2(), window_m=window_m, turn_rad=0.1)
    slam.finish()
    there, back = np.array([0, 1]), np.array([1, 0])
    optimise(np.zeros((2, 3)), Edges(there, back, np.zeros((2, 3)), np.array([np.eye(3)] * 2), np.array([False, True])))
    for _ in range(2):  # sweeps of the daemon share their bearings, which nobody may write: another kind of array
        is_changed(scan, depths_of(scan, table_for(bearing)), np.zeros((len(bearing), 3)), Pose2())
        bearing.setflags(write=False)
    kept = kept_sweep("", scan, key=0, in_key=np.zeros((2, 3)))
    kept.poses(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1]]), np.zeros(3))


def warm_up_in_map() -> None:
    """Find a robot in a small room that is thrown away."""
    cells = np.zeros((60, 80), dtype=np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    localiser = MapLocaliser(known_map(GridPatch(0.05, 0, 0, cells)))
    bearing = np.linspace(-math.pi, math.pi, 90, endpoint=False)
    for step in range(3):
        with np.errstate(divide="ignore"):
            walls = np.minimum(1.5 / np.abs(np.sin(bearing)), 2.0 / np.abs(np.cos(bearing)))
        points = points_of(bearing, walls, Pose2(), nearest_m=0.05, farthest_m=20.0, most=90)
        if localiser.is_due(step * 2_000_000_000):
            localiser.abandon()
        localiser.add_scan(step * 2_000_000_000, points, Pose2(0.3 * step, 0.0, 0.0))
        work = localiser.take_work()
        if work is not None:
            work.run()


def warm_up_calibration() -> None:
    """Fit a drive that is thrown away: straight on, and a bend every third second."""
    seconds = np.arange(LEAST_MOTIONS + 2.0)
    turn = 0.1 * (seconds[:-2] % 3.0 == 0.0)
    ticks = WheelTicks(seconds, 0.2 * seconds, 0.2 * seconds + 0.04 * np.ceil(seconds / 3.0))
    motion = np.stack((np.full(len(turn), 0.2), 0.1 * turn, turn), axis=-1)
    certainty = np.repeat(1e-6 * np.eye(3)[None, :], len(turn), axis=0)
    calibrate(ticks, RelativeMotions(seconds[:-2], seconds[1:-1], motion, certainty), RobotModel(1.0, 1.0, 0.4))
