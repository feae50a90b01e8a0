"""Pictures of the sector maps and of what is drawn from them, for docs/algorithms, from a simulated room.

python bench/sectors_pictures.py [--data FOLDER] [--out docs/pictures]

The room has a cupboard, two boxes, a thin post and a pane of glass that only sonars notice. --data: recorded clouds,
for the picture of the ground in sectors; without it that one is left out.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon, Rectangle, Wedge

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.grid_insert import box, cast
from mapping.frames import IDENTITY, Pose2
from mapping.grids.height import Elevation, ElevationMap, Ground
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.sectors.artos import ArtosMap
from mapping.sectors.ground import ground_in_sectors
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from mapping.sectors.to_grid import robot_cells, world_cells
from mapping.sectors.virtual import probe_path
from service.cloud_files import read_cloud

F64 = NDArray[np.float64]
WALLS = np.array(
    [*box(0.0, 0.0, 7.0, 5.0), *box(4.6, 0.0, 5.6, 1.1), *box(1.0, 3.7, 1.9, 4.4), *box(5.0, 3.2, 5.1, 3.3)]
)
GLASS = np.array([(2.6, 0.7, 3.9, 0.7)])
EVERYTHING = np.concatenate((WALLS, GLASS))
ROBOT = Pose2(2.9, 2.1, math.radians(18.0))
FOOTPRINT = np.array([[0.45, 0.3], [-0.35, 0.3], [-0.35, -0.3], [0.45, -0.3]])
LASER = Pose2(0.35, 0.0, 0.0)
BEARING_RAD = np.radians(np.linspace(-120.0, 120.0, 683))
SONARS = [Pose2(x, side * 0.3, side * math.pi / 2.0) for side in (1.0, -1.0) for x in (0.3, 0.1, -0.1, -0.3)]
CONE_RAD = math.radians(30.0)
LASER_MAX_M, SONAR_MIN_M, SONAR_MAX_M = 4.0, 0.2, 3.0
COLORS = {
    SectorState.OBSTACLE: "#d08770",
    SectorState.FREE: "#a8d5a2",
    SectorState.UNKNOWN: "#d8d8d8",
    SectorState.STALE: "#b9a6d3",
}


def laser_ranges(robot: Pose2) -> F64:
    """What the laser reads: it looks through glass, and not beyond its range."""
    at = robot @ LASER
    ranges = cast(WALLS, at.x_m, at.y_m, BEARING_RAD + at.yaw_rad)
    return np.where(ranges > LASER_MAX_M, np.inf, ranges)


def sonar_range(robot: Pose2, sonar: Pose2) -> float:
    """The nearest thing in a transducer's cone, glass as well."""
    at = robot @ sonar
    nearest = float(cast(EVERYTHING, at.x_m, at.y_m, at.yaw_rad + np.linspace(-0.5, 0.5, 61) * CONE_RAD).min())
    return nearest if nearest < SONAR_MAX_M else math.inf


def feed(sectors: PolarSectors | RectSectors, robot: Pose2, sources: tuple[str, ...], stamp_ns: int = 0) -> None:
    """One round of readings of the sources named."""
    if "laser" in sources:
        sectors.update_beams(
            "laser", base_from_sensor=LASER, bearing_rad=BEARING_RAD, range_m=laser_ranges(robot), range_min_m=0.06,
            range_max_m=LASER_MAX_M, stamp_ns=stamp_ns,
        )  # fmt: skip
    for channel, sonar in enumerate(SONARS):
        name = "left" if sonar.y_m > 0.0 else "right"
        if name in sources:
            sectors.update_cone(
                name, channel, base_from_transducer=sonar, cone_rad=CONE_RAD, range_m=sonar_range(robot, sonar),
                range_min_m=SONAR_MIN_M, range_max_m=SONAR_MAX_M, stamp_ns=stamp_ns,
            )  # fmt: skip


def polar(robot: Pose2, *sources: str, **options: Any) -> PolarSnapshot:
    """A polar sector map of the sources named, after one round of readings."""
    whole = {"start_rad": -math.pi, "stop_rad": math.pi} | options
    sectors = PolarSectors(sources=sources, footprint=FOOTPRINT, range_max_m=LASER_MAX_M, **whole)
    feed(sectors, robot, sources)
    return sectors.snapshot(0)


def sector_maps(folder: Path) -> None:
    """S34 to S36, S38: the same instant as polar, as rectangular and as a virtual sensor sees it."""
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.4))
    snapshot = polar(ROBOT, "laser", "left", "right")
    draw_polar(axes[0], snapshot, ROBOT)
    nearest = int(np.nanargmin(np.where(snapshot.state == SectorState.OBSTACLE, snapshot.clearance_m, np.nan)))
    start = (ROBOT @ snapshot.base_from_sensor).apply(np.zeros((1, 2)))[0]
    end = _obstacles(snapshot, ROBOT)[nearest]
    border = end - (end - start) / snapshot.distance_m[nearest] * snapshot.clearance_m[nearest]
    axes[0].plot(*np.stack((border, end)).T, "k-", lw=2.0)
    to_centre, to_border = snapshot.distance_m[nearest], snapshot.clearance_m[nearest]
    axes[0].set_title(f"S34, S35: polar; nearest {to_centre:.2f} m, {to_border:.2f} m from the border (black)")
    rect = RectSectors(sources=("laser", "left", "right"), size_m=(5.0, 5.0), footprint=FOOTPRINT)
    feed(rect, ROBOT, ("laser", "left", "right"))
    draw_rect(axes[1], rect, ROBOT)
    axes[1].set_title("S36: rectangular, 0.25 m, the nearest obstacle in each (dots)")
    ahead = Pose2(1.2, 0.0, math.radians(-50.0))
    virtual = polar(ROBOT, "laser", "left", "right", base_from_sensor=ahead, start_rad=-1.2, stop_rad=1.2)
    draw_polar(axes[2], virtual, ROBOT)
    axes[2].set_title("S38: a virtual sensor 1.2 m ahead that looks to the right")
    for axis in axes:
        finish(axis)
    save(figure, folder / "sectors_maps.png")


def sectors_to_grid(folder: Path) -> None:
    """S38, S39: sectors of a grid map along a path; sectors as cells of a grid around the robot and of the world."""
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.4))
    grid = OccupancyGrid(resolution_m=0.05)
    path = [Pose2(x, 2.1 + 0.25 * math.sin(2.0 * x), 0.5 * math.cos(2.0 * x)) for x in np.linspace(1.5, 5.6, 12)]
    for pose in path:
        grid.insert_scan(pose @ LASER, BEARING_RAD, laser_ranges(pose), range_max_m=LASER_MAX_M, clear_no_return=False)
    patch = grid.patch()
    show(axes[0], patch)
    probed = probe_path(patch, path, range_max_m=1.0, stamp_ns=0, footprint=FOOTPRINT)
    for pose, snapshot in list(zip(path, probed))[::3]:
        draw_polar(axes[0], snapshot, IDENTITY, outline=pose, walls=False, alpha=0.55)
    axes[0].set_title("S38: sectors of a grid map, moved ahead on a path")
    snapshot = polar(ROBOT, "laser", "left", "right", sector_rad=math.radians(15.0))
    for axis, (hits, frees), pose, what in (
        (axes[1], robot_cells(snapshot, resolution_m=0.1), IDENTITY, "a grid that turns with the robot"),
        (axes[2], world_cells(snapshot, ROBOT, resolution_m=0.1), ROBOT, "the world's grid"),
    ):
        cells(axis, frees, 0.1, COLORS[SectorState.FREE])
        cells(axis, hits, 0.1, COLORS[SectorState.OBSTACLE])
        _edges(axis, snapshot, pose)
        draw_robot(axis, pose)
        axis.set_title(f"S39: 15 degree sectors in {what}")
    axes[2].add_collection(LineCollection(list(EVERYTHING.reshape(-1, 2, 2)), colors="0.3", linewidths=0.8))
    for axis in axes:
        finish(axis)
    save(figure, folder / "sectors_grid.png")


def artos(folder: Path) -> None:
    """S40: three sector maps of one instant, and the map of counters after one and after many."""
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.4))
    window = ArtosMap(resolution_m=0.1, size_m=8.0, counter_max=10)
    path = [
        Pose2(2.9 + 1.2 * math.cos(t), 2.3 + 0.5 * math.sin(t), t + math.pi / 2.0)
        for t in np.linspace(0.0, 2.0 * math.pi, 60)
    ]
    shown = {0: axes[0], len(path) - 1: axes[1]}
    for number, pose in enumerate(path):
        window.update([polar(pose, source) for source in ("laser", "left", "right")], pose)
        if number in shown:
            show(shown[number], window.patch())
            draw_robot(shown[number], pose)
            shown[number].set_title(f"S40: counters after {number + 1} update{'s' * (number > 0)} of three sector maps")
    sonar = ArtosMap(resolution_m=0.1, size_m=8.0, counter_max=10)
    for pose in path:
        sonar.update([polar(pose, source) for source in ("left", "right")], pose)
    show(axes[2], sonar.patch())
    axes[2].set_title("the two ultrasonic chains alone: they know the glass")
    for axis in axes:
        axis.add_collection(LineCollection(list(WALLS.reshape(-1, 2, 2)), colors="C0", linewidths=0.8))
        axis.add_collection(LineCollection(list(GLASS.reshape(-1, 2, 2)), colors="C3", linewidths=1.2))
        finish(axis)
    save(figure, folder / "sectors_artos.png")


def occupancy(folder: Path) -> None:
    """S26 to S29: one scan, one echo, and a drive with both."""
    figure, axes = plt.subplots(1, 3, figsize=(17, 5.4))
    for axis, pieces in ((axes[0], ("laser",)), (axes[1], ("sonar",)), (axes[2], ("laser", "sonar"))):
        grid = OccupancyGrid(resolution_m=0.05)
        poses = [ROBOT] if len(pieces) == 1 else [ROBOT @ Pose2(0.02 * k, 0.0, 0.01 * k) for k in range(40)]
        for pose in poses:
            if "laser" in pieces:
                grid.insert_scan(
                    pose @ LASER, BEARING_RAD, laser_ranges(pose), range_max_m=LASER_MAX_M, clear_no_return=False
                )
            for channel, sonar in enumerate(SONARS):
                if "sonar" in pieces:
                    grid.insert_cone(
                        pose @ sonar, sonar_range(pose, sonar), cone_rad=CONE_RAD, range_max_m=SONAR_MAX_M,
                        range_min_m=SONAR_MIN_M, transducer=channel if len(poses) > 1 else None,
                    )  # fmt: skip
        show(axis, grid.patch())
        axis.add_collection(LineCollection(list(GLASS.reshape(-1, 2, 2)), colors="C3", linewidths=1.2))
        draw_robot(axis, poses[-1])
    axes[0].set_title("S26 to S28: one scan; what no beam passed is unknown (grey)")
    axes[1].set_title("S29: one echo of each transducer")
    axes[2].set_title("forty of both; red: glass, which the laser looks through")
    for axis in axes:
        finish(axis)
        axis.set_xlim(-0.1, 7.1)
        axis.set_ylim(-0.1, 5.1)
    save(figure, folder / "grids_occupancy.png")


def ground(folder: Path, data: Path) -> None:
    """S37: how far the ground of a recorded room can be driven on, by direction."""
    points = read_cloud(data / "point_clouds" / "room_scan1.pcd").points_m
    heights = ElevationMap(resolution_m=0.1, height_max_m=-0.3)
    heights.insert(points)
    elevation = heights.elevation()
    robot, edges = Pose2(0.2, 1.7, 0.0), np.radians(np.arange(-180.0, 181.0, 5.0))
    found = ground_in_sectors(elevation, robot, edges, reach_m=2.5, blind_m=0.45)
    figure, axis = plt.subplots(figsize=(8, 6.4))
    draw_ground(axis, elevation)
    steepest = np.degrees(np.nan_to_num(found.slope_rad))
    for k, reach in enumerate(found.traversable_m):
        color = plt.get_cmap("viridis")(min(float(steepest[k]) / 20.0, 1.0))
        part = np.degrees(edges[k : k + 2])
        axis.add_patch(Wedge((robot.x_m, robot.y_m), float(reach), *part, facecolor=color, alpha=0.6, lw=0.2, ec="k"))
    axis.set_xlim(-3.2, 4.4)
    axis.set_ylim(-2.2, 3.8)
    axis.set_title(
        "S37: traversable stretches by direction; colour: steepest slope in it, 0 to 20 degrees", fontsize=10
    )
    axis.set_aspect("equal")
    save(figure, folder / "sectors_ground.png")


# ------------------------------------------------------------------------------------------------------------ drawing


def draw_ground(axis: Any, elevation: Elevation) -> None:
    """Cells by what one may do there."""
    colors = np.full((*elevation.ground.shape, 3), 0.85)
    colors[elevation.ground == Ground.TRAVERSABLE] = 1.0
    known = (elevation.ground != Ground.TRAVERSABLE) & (elevation.ground != Ground.UNKNOWN)
    colors[known] = (0.55, 0.35, 0.3)
    d, rows, cols = elevation.resolution_m, *elevation.ground.shape
    extent = np.array([elevation.col0, elevation.col0 + cols, elevation.row0, elevation.row0 + rows]) * d
    axis.imshow(colors, origin="lower", extent=extent, interpolation="nearest")


def show(axis: Any, patch: GridPatch) -> None:
    """A grid: black occupied, white free, grey unknown."""
    level = np.where(patch.cells < 0, 0.8, 1.0 - patch.cells / 100.0)
    rows, cols = patch.cells.shape
    extent = np.array([patch.col0, patch.col0 + cols, patch.row0, patch.row0 + rows]) * patch.resolution_m
    axis.set_facecolor("0.8")  # what is outside the patch is unknown, too
    axis.imshow(level, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")


def draw_polar(
    axis: Any,
    snapshot: PolarSnapshot,
    robot: Pose2,
    *,
    outline: Pose2 | None = None,
    walls: bool = True,
    alpha: float = 1.0,
) -> None:
    """Each sector to its distance in the colour of its state, obstacles as dots, and the room."""
    sensor = robot @ snapshot.base_from_sensor
    degrees = np.degrees(snapshot.edges_rad + sensor.yaw_rad)
    for k, state in enumerate(snapshot.state):
        reach = snapshot.distance_m[k] if np.isfinite(snapshot.distance_m[k]) else 0.75
        color = COLORS[SectorState(int(state))]
        where = (sensor.x_m, sensor.y_m)
        axis.add_patch(Wedge(where, float(reach), *degrees[k : k + 2], lw=0.3, ec="w", facecolor=color, alpha=alpha))
    axis.plot(*_obstacles(snapshot, robot).T, ".", color="#8c2d04", ms=4)
    draw_robot(axis, robot if outline is None else outline)
    if walls:
        axis.add_collection(LineCollection(list(WALLS.reshape(-1, 2, 2)), colors="0.2", linewidths=1.0))
        axis.add_collection(LineCollection(list(GLASS.reshape(-1, 2, 2)), colors="C3", linewidths=1.2))


def draw_rect(axis: Any, sectors: RectSectors, robot: Pose2) -> None:
    """Squares in the colour of their state."""
    snapshot = sectors.snapshot(0)
    for row, col in np.ndindex(snapshot.state.shape):
        x, y = snapshot.x_edges_m[col : col + 2], snapshot.y_edges_m[row : row + 2]
        corners = robot.apply(np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]))
        color = COLORS[SectorState(int(snapshot.state[row, col]))]
        axis.add_patch(Polygon(corners, facecolor=color, ec="w", lw=0.3))
    found = np.isfinite(snapshot.x_m)
    axis.plot(*robot.apply(np.stack((snapshot.x_m[found], snapshot.y_m[found]), axis=-1)).T, ".", color="#8c2d04", ms=4)
    draw_robot(axis, robot)
    axis.add_collection(LineCollection(list(WALLS.reshape(-1, 2, 2)), colors="0.2", linewidths=1.0))
    axis.add_collection(LineCollection(list(GLASS.reshape(-1, 2, 2)), colors="C3", linewidths=1.2))


def cells(axis: Any, places: NDArray[np.int64], d: float, color: str) -> None:
    """Cells [row, col] as squares."""
    for row, col in places.tolist():
        axis.add_patch(Rectangle((col * d, row * d), d, d, facecolor=color, ec="w", lw=0.2))


def draw_robot(axis: Any, pose: Pose2) -> None:
    """The vehicle's outline and which way it looks."""
    axis.add_patch(Polygon(pose.apply(FOOTPRINT), facecolor="#5b7fa8", alpha=0.8, ec="k", lw=0.6))
    axis.plot(*pose.apply(np.array([[0.1, 0.0], [0.45, 0.0]])).T, "w-", lw=1.2)


def _obstacles(snapshot: PolarSnapshot, robot: Pose2) -> F64:
    """(N, 2) the obstacle of each sector, NaN without one."""
    is_obstacle = snapshot.state == SectorState.OBSTACLE
    distance = np.where(is_obstacle, snapshot.distance_m, np.nan)
    along = np.stack((np.cos(snapshot.bearing_rad), np.sin(snapshot.bearing_rad)), axis=-1)
    return (robot @ snapshot.base_from_sensor).apply(distance[:, None] * along)


def _edges(axis: Any, snapshot: PolarSnapshot, robot: Pose2) -> None:
    """The borders of sectors as thin lines."""
    sensor = robot @ snapshot.base_from_sensor
    reach = np.fmax(np.nan_to_num(snapshot.distance_m), np.roll(np.nan_to_num(snapshot.distance_m), 1))
    tips = np.stack((np.cos(snapshot.edges_rad[:-1]), np.sin(snapshot.edges_rad[:-1])), axis=-1) * reach[:, None]
    start = np.array([sensor.x_m, sensor.y_m])
    axis.add_collection(
        LineCollection([np.stack((start, tip)) for tip in sensor.apply(tips)], colors="0.5", linewidths=0.4)
    )


def finish(axis: Any) -> None:
    """Metres, upright."""
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.title.set_fontsize(10)


def save(figure: Any, path: Path) -> None:
    """Write a picture and say so."""
    figure.tight_layout()
    figure.savefig(path, dpi=70)
    plt.close(figure)
    print(path)


def main() -> int:
    """All pictures."""
    parser = argparse.ArgumentParser(description="Pictures of the sector maps.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "pictures")
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ["UMFELD_DATA"]) if "UMFELD_DATA" in os.environ else None
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for make in (sector_maps, sectors_to_grid, artos, occupancy):
        make(options.out)
    if options.data is not None:
        ground(options.out, Path(options.data))
    return 0


if __name__ == "__main__":
    sys.exit(main())
