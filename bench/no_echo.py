"""What beams without echo free: in made worlds with things that give no echo at all, and where silence is true.

    python bench/no_echo.py [--only WORDS] [--json FILE]

Three lasers drive through each world, turning round at both ends of the way. Their sweeps are put into three grids:
silence believed up to the laser's reach, as mapping.no_echo bounds it, and not at all. Told are square metres that are
called free and cannot be reached from the robot without passing a surface: inside what is black, and elsewhere (behind
it, behind walls); and how much of what silence truly frees within 20 m of the way each rule still does.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.frames import Pose2
from mapping.grids.beam_model import Beams
from mapping.grids.occupancy import OccupancyGrid
from mapping.narrow_gaps import without_narrow_gaps
from sim_devices import world as worlds
from sim_devices.floor_plan import Box, Circle, FloorPlan, Wall, load_floor_plan
from sim_devices.world import World

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

D = 0.05
WALL_M = 0.08  # a cell that a surface crosses may be free in part
NEAR_WAY_M = 20.0
NOISE_M = 0.01


@dataclass(frozen=True)
class Kind:
    """A laser: its view, how finely, how far."""

    view_deg: float
    step_deg: float
    range_max_m: float

    @property
    def bearing_rad(self) -> F64:
        half = 0.5 * self.view_deg
        end = half - 1e-9 if self.view_deg >= 360.0 else half + 1e-9
        return np.asarray(np.radians(np.arange(-half, end, self.step_deg)))


@dataclass(frozen=True)
class Scene:
    """A world and the way through it. black: (x0, y0, x1, y1) of what gives no echo."""

    plan: FloorPlan
    way: tuple[tuple[float, float], ...]
    black: tuple[tuple[float, float, float, float], ...] = ()


LASERS = {
    "UTM-30LX (270°, 60 m)": Kind(270.0, 0.25, 60.0),
    "URG-04LX (240°, 5.6 m)": Kind(240.0, 0.352, 5.6),
    "a turn, 1°, 12 m": Kind(360.0, 1.0, 12.0),
}


def room(x0: float, y0: float, x1: float, y1: float) -> Wall:
    return Wall(points=((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)))


def with_black(
    walls: Iterable[Wall], way: tuple[tuple[float, float], ...], *rects: tuple[float, float, float, float],
    circles: tuple[Circle, ...] = (),
) -> Scene:  # fmt: skip
    boxes = tuple(
        Box(center=(0.5 * (x0 + x1), 0.5 * (y0 + y1)), size_m=(x1 - x0, y1 - y0), material="black")
        for x0, y0, x1, y1 in rects
    )
    return Scene(FloorPlan(walls=tuple(walls), boxes=boxes, circles=circles), way, rects)


def scenes() -> dict[str, Scene]:
    flat = (room(-3.0, -2.5, 5.0, 2.5), room(5.2, -2.5, 12.0, 2.5), room(-3.0, 2.7, 5.0, 8.0))
    along = ((-2.0, 0.0), (3.5, 0.0))
    found = {
        "room, nothing black": with_black(flat, along),
        "black cabinet 0.9 m, at the end wall": with_black(flat, along, (4.5, -0.45, 4.95, 0.45)),
        "black cabinet 0.9 m, at the side wall": with_black(flat, along, (1.0, 2.0, 1.9, 2.45)),
        "black cabinet 0.5 m": with_black(flat, along, (1.0, 2.0, 1.5, 2.45)),
        "black cabinet 2 m": with_black(flat, along, (0.0, 2.0, 2.0, 2.45)),
        "black sofa 2.5 m, 0.5 m beside the way": with_black(flat, along, (-0.5, 0.5, 2.0, 1.3)),
        "black column 0.4 m in the room": with_black(flat, along, (2.0, 1.0, 2.4, 1.4)),
        "black corner of two cabinets": with_black(
            flat, along, (3.0, 2.0, 4.95, 2.45), (4.5, 0.0, 4.95, 1.99)
        ),
        "a wall of the room black": with_black(flat, along, (-2.9, 2.4, 4.9, 2.45)),
        "black cabinet in an office corridor": with_black(
            (room(-10.0, -1.0, 10.0, 1.0), room(-10.0, 1.1, 10.0, 7.0)), ((-8.0, 0.0), (6.0, 0.0)),
            (0.0, 0.55, 0.9, 0.95),
        ),
    }  # fmt: skip
    jambs = (Wall(points=((0.0, 0.5), (0.0, 4.0))), Wall(points=((0.0, -4.0), (0.0, -0.5))))
    found["door into a hall without echo"] = with_black(
        (*jambs, Wall(points=((0.0, 4.0), (-6.0, 4.0), (-6.0, -4.0), (0.0, -4.0)))), ((-5.0, 0.0), (8.0, 0.0))
    )
    found["corridor of 200 m"] = with_black((room(-100.0, -1.2, 100.0, 1.2),), ((-5.0, 0.0), (15.0, 0.0)))
    found["hall 40 by 30 m"] = with_black(
        (room(-20.0, -15.0, 20.0, 15.0),), ((-16.0, -11.0), (0.0, -11.0), (0.0, 0.0), (15.0, 0.0)),
        circles=tuple(Circle(center=(x, y), radius_m=0.3) for x in (-8.0, 8.0) for y in (-6.0, 6.0)),
    )  # fmt: skip
    found["open yard, a house and posts"] = with_black(
        (room(-8.0, 3.0, 8.0, 12.0),), ((-14.0, 0.0), (14.0, 0.0)),
        circles=tuple(Circle(center=(x, -7.0), radius_m=0.1) for x in (-12.0, -4.0, 4.0, 12.0)),
    )  # fmt: skip
    for name in ("flat", "office"):
        plan = load_floor_plan(name)
        assert plan.route is not None
        found[f"the simulator's {name}"] = Scene(plan, plan.route.points)
    found["open field"] = with_black((), ((-5.0, 0.0), (5.0, 0.0)))
    return found


def poses_on(way: tuple[tuple[float, float], ...]) -> list[Pose2]:
    """Every 0.2 m, and a turn on the spot at both ends."""
    poses: list[Pose2] = []
    for (x0, y0), (x1, y1) in itertools.pairwise(way):
        length, yaw = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        for s in np.arange(0.0, length, 0.2):
            poses.append(Pose2(x0 + s / length * (x1 - x0), y0 + s / length * (y1 - y0), yaw))
    for x, y in (way[0], way[-1]):
        poses += [Pose2(x, y, math.radians(a)) for a in range(0, 360, 10)]
    return poses


def sweep(world: World, pose: Pose2, laser: Kind, random: np.random.Generator) -> F64:
    n = len(laser.bearing_rad)
    origin = np.full((n, 2), (pose.x_m, pose.y_m))
    seen = world.beam_distances(
        origin, laser.bearing_rad + pose.yaw_rad, np.zeros(n), z_m=0.25, range_max_m=laser.range_max_m
    )
    measured = np.minimum(seen + random.normal(0.0, NOISE_M, n), laser.range_max_m)
    return np.where(np.isfinite(seen), measured, seen)


def believed(grid: OccupancyGrid, pose: Pose2, laser: Kind, ranges: F64) -> None:
    """Silence up to the laser's reach."""
    angle = laser.bearing_rad + pose.yaw_rad
    length = np.where(np.isposinf(ranges), laser.range_max_m, ranges)
    origin = np.full((len(angle), 2), (pose.x_m, pose.y_m))
    end = origin + length[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    free = ~np.isnan(ranges)
    grid.insert_beams(Beams(origin, end, free, np.isfinite(ranges)))


def bounded(grid: OccupancyGrid, pose: Pose2, laser: Kind, ranges: F64) -> None:
    grid.insert_scan(pose, laser.bearing_rad, ranges, range_max_m=laser.range_max_m)


def unknown(grid: OccupancyGrid, pose: Pose2, laser: Kind, ranges: F64) -> None:
    grid.insert_scan(pose, laser.bearing_rad, ranges, range_max_m=laser.range_max_m, clear_no_return=False)


RULES: dict[str, Callable[[OccupancyGrid, Pose2, Kind, F64], None]] = {
    "reach": believed, "bounded": bounded, "unknown": unknown
}  # fmt: skip


def drive(scene: Scene, laser: Kind) -> dict[str, OccupancyGrid]:
    world, random = World.from_plan(scene.plan), np.random.default_rng(1)
    grids = {name: OccupancyGrid(resolution_m=D) for name in RULES}
    for pose in poses_on(scene.way):
        ranges, _ = without_narrow_gaps(laser.bearing_rad, sweep(world, pose, laser, random))
        for name, insert in RULES.items():
            insert(grids[name], pose, laser, ranges)
    return grids


def figures(scene: Scene, laser: Kind) -> dict[str, float]:
    """Square metres by rule: free inside what is black, free elsewhere where nobody can get, truly free by the way."""
    grids = drive(scene, laser)
    patches = {name: grid.patch() for name, grid in grids.items()}
    row0, col0 = (min(getattr(p, at) for p in patches.values()) for at in ("row0", "col0"))
    rows = max(p.row0 + p.cells.shape[0] for p in patches.values()) - row0
    cols = max(p.col0 + p.cells.shape[1] for p in patches.values()) - col0
    free = {}
    for name, patch in patches.items():
        free[name] = np.zeros((rows, cols), dtype=bool)
        at = (patch.row0 - row0, patch.col0 - col0)
        shape = patch.cells.shape
        free[name][at[0] : at[0] + shape[0], at[1] : at[1] + shape[1]] = (patch.cells >= 0) & (patch.cells < 35)
    y, x = (np.arange(rows) + row0 + 0.5) * D, (np.arange(cols) + col0 + 0.5) * D
    solid = np.zeros((rows, cols), dtype=bool)
    for points in surfaces(World.from_plan(scene.plan)):
        r, c = np.floor(points[:, 1] / D).astype(int) - row0, np.floor(points[:, 0] / D).astype(int) - col0
        inside = (r >= 0) & (r < rows) & (c >= 0) & (c < cols)
        solid[r[inside], c[inside]] = True
    pieces, _ = ndimage.label(~solid)
    sx, sy = scene.way[0]
    here = pieces == pieces[math.floor(sy / D) - row0, math.floor(sx / D) - col0]
    deep = ndimage.distance_transform_edt(~here) * D > WALL_M
    black = np.zeros((rows, cols), dtype=bool)
    for x0, y0, x1, y1 in scene.black:
        black |= ((y > y0) & (y < y1))[:, None] & ((x > x0) & (x < x1))[None, :]
    near = np.ones((rows, cols), dtype=bool)
    for pose in poses_on(scene.way):
        r, c = math.floor(pose.y_m / D) - row0, math.floor(pose.x_m / D) - col0
        near[max(r, 0), max(c, 0)] = False
    near = ndimage.distance_transform_edt(near) * D < NEAR_WAY_M
    found = {}
    silent = free["reach"] & ~free["unknown"] & here & near
    for name, cells in free.items():
        found[f"{name}: in black"] = float((cells & black & deep).sum()) * D * D
        found[f"{name}: behind"] = float((cells & ~black & deep).sum()) * D * D
        found[f"{name}: by silence"] = float((cells & silent).sum()) * D * D
        found[f"{name}: all"] = float((cells & here & near).sum()) * D * D
    return found


def surfaces(world: World) -> list[F64]:
    """Points along everything at the laser's height, closer than the cells."""
    segments, found = world.segments.at_height(0.25), []
    for a, b in zip(segments.a, segments.b):
        steps = max(2, int(np.hypot(*(b - a)) / (0.4 * D)))
        found.append(a + np.linspace(0.0, 1.0, steps)[:, None] * (b - a))
    circles = world.circles.at_height(0.25)
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    found += [c + r * np.stack((np.cos(turn), np.sin(turn)), axis=-1) for c, r in zip(circles.center, circles.radius_m)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", default="", help="worlds whose name holds this")
    args = parser.parse_args()
    worlds.BLACK_REACH_M = 0.0  # no echo from any distance
    told = {}
    print(
        "square metres called free: in black / behind it and behind walls / truly free near the way, of it by silence"
    )
    print("silence believed up to the reach | bounded by echoes beside it | not believed")
    for laser_name, laser in LASERS.items():
        print(f"\n{laser_name}")
        for name, scene in scenes().items():
            if args.only not in name:
                continue
            told[f"{laser_name}: {name}"] = f = figures(scene, laser)
            cells = " | ".join(
                f"{f[f'{k}: in black']:5.2f} / {f[f'{k}: behind']:7.1f} / {f[f'{k}: all']:7.1f}, "
                f"{f[f'{k}: by silence']:6.1f}"
                for k in RULES
            )
            print(f"{name:40s} {cells}", flush=True)
    if args.json:
        args.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
