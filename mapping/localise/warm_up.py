"""Load or compile every kernel of localisation before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import math

import numpy as np

from mapping.frames import Pose2
from mapping.localise.scan_match import agreement, match_view
from mapping.localise.search import find_view, raster_of
from mapping.localise.slam import Slam, SlamSettings
from mapping.scan import Scan


def warm_up() -> None:
    """Drive past two walls and back, in numbers that are thrown away; one search, one optimisation."""
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
