"""Runs Open3D's plane finders on one cloud, for the side-by-side figures of bench/planes.py.

    python bench/open3d_planes.py POINTS LABELS ROUNDS patches | ransac DISTANCE_M SMALLEST

A program of its own, because Open3D is no dependency: it is run with the Python that has it. POINTS, LABELS, and what
is printed: as bench/pcl_planes.cpp has them.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import open3d  # type: ignore[import-not-found]


def patches(cloud: Any, points: Any, distance_m: float) -> Any:
    """detect_planar_patches with its defaults, normals of 30 neighbours; a patch owns the points in its rectangle that
    are near its plane."""
    cloud.normals = open3d.utility.Vector3dVector()
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    found = cloud.detect_planar_patches(search_param=open3d.geometry.KDTreeSearchParamKNN(30))
    took = time.perf_counter()
    label, nearest = np.full(len(points), -1), np.full(len(points), distance_m)
    for number, box in enumerate(found):
        local = (points - box.center) @ box.R
        half = 0.5 * np.asarray(box.extent) * 1.01
        off = np.abs(local[:, 2])
        mine = (np.abs(local[:, 0]) <= half[0]) & (np.abs(local[:, 1]) <= half[1]) & (off < nearest)
        label[mine], nearest[mine] = number, off[mine]
    return label, took


def ransac(cloud: Any, points: Any, distance_m: float, smallest: int) -> Any:
    """segment_plane, the largest plane first, until none has enough points."""
    open3d.utility.random.seed(1)
    label, rest = np.full(len(points), -1), np.arange(len(points))
    left, number = cloud, 0
    while len(rest) >= max(smallest, 3):
        _, inliers = left.segment_plane(distance_m, 3, 1000)
        if len(inliers) < smallest:
            break
        label[rest[inliers]] = number
        number += 1
        rest = np.delete(rest, inliers)
        left = left.select_by_index(inliers, invert=True)
    return label, time.perf_counter()


def main() -> int:
    """One cloud, some rounds."""
    source, target, rounds, how, distance, smallest = sys.argv[1:7]
    points = np.fromfile(source, dtype="<f4", offset=4).reshape(-1, 3).astype(np.float64)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    for _ in range(int(rounds)):
        before = time.perf_counter()
        if how == "patches":
            label, after = patches(cloud, points, float(distance))
        else:
            label, after = ransac(cloud, points, float(distance), int(smallest))
        print(f"{1e3 * (after - before):.3f}")
    label.astype("<i4").tofile(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
