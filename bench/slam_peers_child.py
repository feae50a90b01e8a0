"""Runs one SLAM program from PyPI over a recorded log; `bench/slam_peers.py` starts it, in whatever environment has it.

    python bench/slam_peers_child.py PROGRAM LOG.npz PATH

LOG.npz: stamp (N,) text, odometry (N, 3), bearing (N, B), range (N, B; not finite: no echo), mount (3,). PATH gets a
line `stamp x y yaw` of the robot for every scan. Imports numpy and the program, nothing of this project.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

NODE_M, NODE_RAD = 0.2, math.radians(10.0)  # OpenKarto's defaults: it takes a scan after that much motion
INDOOR_RANGE_M = 10.0  # the advice of KISS-ICP's authors for indoors; voxels are a hundredth of it


def main() -> None:
    program, log_file, path_file = sys.argv[1:]
    log = dict(np.load(log_file))
    robot = PROGRAMS[program](log)
    with open(path_file, "w") as out:
        for stamp, (x, y, yaw) in zip(log["stamp"], robot):
            out.write(f"{stamp} {x:.6f} {y:.6f} {yaw:.8f}\n")


def yag_slam(log: dict[str, Any]) -> Any:
    """Karto's scan matcher and graph with the package's own defaults, wheels as the start of each match."""
    from yag_slam.graph_slam import GraphSlam
    from yag_slam.models import LocalizedRangeScan
    from yag_slam.scan_matching import Scan2DMatcherCpp

    slam = GraphSlam(Scan2DMatcherCpp({}), Scan2DMatcherCpp({}, loop=True))
    bearing, odometry = log["bearing"][0], log["odometry"]
    step = (bearing[-1] - bearing[0]) / (len(bearing) - 1)
    nodes, indices = [], [0, *moved(odometry, NODE_M, NODE_RAD)]
    for index in indices:
        laser = odometry[index] if not log["mount"].any() else compose(odometry[index], log["mount"])
        ranges = np.where(np.isfinite(log["range"][index]), log["range"][index], 1000.0)
        scan = LocalizedRangeScan(ranges.tolist(), bearing[0], bearing[-1], step, 0.05, 80.0, 20.0, *map(float, laser))
        slam.process_scan(scan)
        nodes.append(scan)
    undo = inverse(log["mount"])
    lasers = np.array([(n.corrected_pose.x, n.corrected_pose.y, n.corrected_pose.euler[-1]) for n in nodes])
    return carried(odometry, indices, np.array([compose(pose, undo) for pose in lasers]))


def kiss_icp(log: dict[str, Any]) -> Any:
    """Odometry from the points alone."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.deskew = INDOOR_RANGE_M, False
    config.mapping.voxel_size = INDOOR_RANGE_M / 100.0
    odometry = KissICP(config)
    poses = []
    for points in clouds(log):
        odometry.register_frame(points, np.array([]))
        poses.append(odometry.last_pose)
    return robot_poses(poses, log)


def genz_icp(log: dict[str, Any]) -> Any:
    """Odometry from the points alone, the settings it ships with."""
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    odometry = GenZICP(GenZConfig())
    poses = []
    for points in clouds(log):
        odometry.register_frame(points, None)
        poses.append(odometry.last_pose)
    return robot_poses(poses, log)


def kiss_slam(log: dict[str, Any]) -> Any:
    """KISS-ICP, closures by pictures of local maps, a pose graph."""
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    config = load_config(None)
    indoors(config)
    slam = KissSLAM(config)
    for points in clouds(log):
        slam.process_scan(points, np.array([]))
    slam.generate_new_node()
    slam.local_map_graph.erase_last_local_map()
    poses, _ = slam.fine_grained_optimization()
    return robot_poses(poses[-len(log["range"]) :], log)


def retro_slam(log: dict[str, Any]) -> Any:
    """The successor of KISS-SLAM."""
    from retro_slam.config import load_config
    from retro_slam.slam import RetroSLAM

    config = load_config(None)
    indoors(config)
    slam = RetroSLAM(config)
    for points in clouds(log):
        slam.process_scan(points, np.array([]))
    slam.exit()
    return robot_poses(slam.poses[-len(log["range"]) :], log)


PROGRAMS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "yag-slam": yag_slam,
    "kiss-icp": kiss_icp,
    "kiss-slam": kiss_slam,
    "retro-slam": retro_slam,
    "genz-icp": genz_icp,
}


def indoors(config: Any) -> None:
    config.odometry.preprocessing.max_range, config.odometry.preprocessing.deskew = INDOOR_RANGE_M, False
    config.odometry.mapping.voxel_size = INDOOR_RANGE_M / 100.0


def clouds(log: dict[str, Any]) -> Iterator[Any]:
    """(P, 3) points of each scan, laser coordinates, z = 0."""
    for bearing, ranges in zip(log["bearing"], log["range"]):
        seen = np.isfinite(ranges)
        b, r = bearing[seen], ranges[seen]
        yield np.ascontiguousarray(np.stack((r * np.cos(b), r * np.sin(b), np.zeros_like(r)), axis=1))


def robot_poses(lasers: Any, log: dict[str, Any]) -> Any:
    """The robot's x, y, yaw from the laser's 4 x 4 transforms."""
    undo = inverse(log["mount"])
    return [compose((t[0, 3], t[1, 3], math.atan2(t[1, 0], t[0, 0])), undo) for t in np.asarray(lasers)]


# --- poses x, y, yaw --------------------------------------------------------------------------------------------------


def compose(a: Any, b: Any) -> Any:
    """a * b."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array((a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]))


def inverse(a: Any) -> Any:
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array((-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]))


def moved(odometry: Any, far_m: float, turned_rad: float) -> list[int]:
    """Indices of scans that are farther, or turned more, than that from the last one so chosen; odometry (N, 3)."""
    chosen, last = [], odometry[0]
    for index, pose in enumerate(odometry):
        turn = abs((pose[2] - last[2] + math.pi) % (2.0 * math.pi) - math.pi)
        if math.hypot(pose[0] - last[0], pose[1] - last[1]) > far_m or turn > turned_rad:
            chosen.append(index)
            last = pose
    return chosen


def carried(odometry: Any, indices: list[int], poses: Any) -> Any:
    """Poses (N, 3) of all scans from those (K, 3) of some (ascending, from 0 on): odometry goes on from the last."""
    found = []
    at = 0
    for index, wheels in enumerate(odometry):
        if at + 1 < len(indices) and indices[at + 1] == index:
            at += 1
        found.append(compose(poses[at], compose(inverse(odometry[indices[at]]), wheels)))
    return np.array(found)


if __name__ == "__main__":
    main()
