"""Pictures of the plane maps for docs/algorithms/planes.md, from recorded clouds (UMFELD_DATA).

UMFELD_DATA=... python bench/planes_pictures.py [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.frames import Pose3
from mapping.planes.cloud import TiltMount
from mapping.planes.extract import PlaneRules, extract_planes, range_limit_m
from service.cloud_files import read_cloud
from service.plane_files import draw_planes

F64 = NDArray[np.float64]


def clouds(data: Path, folder: Path) -> None:
    """S12: the book's form and the refined one on three recordings."""
    room = read_cloud(data / "point_clouds" / "room_scan1.pcd").points_m
    room = room[(np.abs(room[:, :2]).max(axis=1) < 4.0) & (room[:, 2] < 1.0)]  # without its ceiling
    steps = read_cloud(data / "point_clouds" / "synpeb_100x100.pcd.gz").points_m
    table = read_cloud(data / "point_clouds" / "table_test10.pcd.gz").points_m
    views = (("room_scan1", room, 60.0, -70.0), ("synpeb", steps, 20.0, 200.0), ("table_test10", table, -70.0, -90.0))
    figure = plt.figure(figsize=(13, 8))
    for column, (name, points, elevation, azimuth) in enumerate(views):
        for row, (form, rules) in enumerate((("book", PlaneRules.book()), ("refined", PlaneRules()))):
            axes = figure.add_subplot(2, 3, 3 * row + column + 1, projection="3d")
            planes = extract_planes(points, rules)
            draw_planes(axes, points, planes, size=0.3)
            axes.view_init(elevation, azimuth)
            axes.set_title(f"{name}, {form}: {len(planes)} planes", fontsize=9)
            plain(axes)
    save(figure, folder / "planes_clouds.png")


def camera(data: Path, folder: Path) -> None:
    """S12: a depth image, whose depths come in steps."""
    cloud = read_cloud(data / "depth_images" / "living_room_0.png")
    assert cloud.shape is not None
    planes = extract_planes(cloud.points_m)
    figure, axes = plt.subplots(1, 2, figsize=(12, 5.0))
    axes[0].imshow(cloud.points_m[:, 2].reshape(cloud.shape), cmap="viridis")
    axes[0].set_title("living_room_0: depth, m")
    label = planes.label.reshape(cloud.shape)
    axes[1].imshow(np.where(label < 0, np.nan, label % 20), cmap="tab20", interpolation="nearest")
    axes[1].set_title(f"{len(planes)} planes; white: none, or no reading")
    for each in axes:
        each.set_axis_off()
    save(figure, folder / "planes_depth.png")


def mount(folder: Path) -> None:
    """S11 and S13: where beams of a nodding laser meet a room, and how far planes can be seen."""
    bearing = np.radians(np.arange(-80.0, 80.1, 2.0))
    laser = TiltMount(Pose3(0.0, 0.0, 0.9), "pitch", Pose3(0.06, 0.0, 0.04))
    figure = plt.figure(figsize=(12, 4.8))
    axes = figure.add_subplot(1, 2, 1, projection="3d")
    for angle in np.radians(np.arange(-20.0, 45.0, 4.0)):
        origin, way = laser.rays(bearing, np.full(bearing.size, angle))
        with np.errstate(divide="ignore"):
            reach = np.where(way[:, 2] < 0.0, -origin[:, 2] / way[:, 2], np.inf)
            for axis, wall in ((0, 4.0), (1, 2.5), (1, -2.5)):
                hit = (wall - origin[:, axis]) / way[:, axis]
                reach = np.minimum(reach, np.where(hit > 0.0, hit, np.inf))
        points = (origin + reach[:, None] * way)[reach < 20.0]
        axes.plot(*points.T, ".", ms=1.5, color=plt.get_cmap("viridis")((angle + 0.35) / 1.1))
    axes.set_box_aspect((4.0, 5.0, 2.5))
    axes.set_title("S11: sweeps of a nodding laser, colour by the mount's angle", fontsize=9)
    plain(axes)
    limit = figure.add_subplot(1, 2, 2)
    spacing = np.linspace(0.1, 2.0, 100)
    for cell in (0.1, 0.2, 0.4, 0.8):
        limit.plot(spacing, [range_limit_m(cell, float(np.radians(s))) for s in spacing], label=f"cells of {cell:g} m")
    limit.plot(0.5, 11.46, "k+", ms=12)
    limit.set_ylim(0.0, 40.0)
    limit.set_xlabel("angle between beams, degrees")
    limit.set_ylabel("planes can be seen up to, m")
    limit.set_title("S13: the range limit; +: the book's example", fontsize=9)
    limit.legend()
    limit.grid(alpha=0.3)
    save(figure, folder / "planes_mount.png")


def plain(axes: Any) -> None:
    """No numbers on the axes."""
    for set_labels in (axes.set_xticklabels, axes.set_yticklabels, axes.set_zticklabels):
        set_labels([])
    for set_label in (axes.set_xlabel, axes.set_ylabel, axes.set_zlabel):
        set_label("")


def save(figure: Any, path: Path) -> None:
    """Write a picture and say so."""
    figure.tight_layout()
    figure.savefig(path, dpi=70)
    plt.close(figure)
    print(path, path.stat().st_size)


def main() -> int:
    """All pictures."""
    parser = argparse.ArgumentParser(description="Pictures of the plane maps.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "pictures")
    folder: Path = parser.parse_args().out
    data = Path(os.environ["UMFELD_DATA"])
    folder.mkdir(parents=True, exist_ok=True)
    clouds(data, folder)
    camera(data, folder)
    mount(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
