"""Pictures for docs/algorithms/rooms.md, of the office that bench/planning.py makes, 35 m square.

python bench/rooms_pictures.py [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.plans import CELL_M, office
from mapping.hybrid.planner import Planner
from mapping.hybrid.rooms import find_rooms
from mapping.hybrid.voronoi import VoronoiGrid

SIDE = 720
EXTENT = (0.0, SIDE * CELL_M, 0.0, SIDE * CELL_M)


def base(free: NDArray[np.bool_], axes: Any) -> None:
    axes.imshow(np.where(free, 1.0, 0.25), cmap="gray", vmin=0, vmax=1, origin="lower", extent=EXTENT)
    axes.set_xticks([])
    axes.set_yticks([])


def steps(free: NDArray[np.bool_], folder: Path) -> None:
    """Diagram; rooms and doors."""
    grid, found = VoronoiGrid(free), find_rooms(free, CELL_M)
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 6.4), layout="constrained")
    base(free, left)
    rows, cols = np.nonzero(grid.axis)
    left.scatter((cols + 0.5) * CELL_M, (rows + 0.5) * CELL_M, s=0.15, color="tab:blue", linewidths=0)
    left.set_title("Voronoi diagram")
    base(free, right)
    colours = plt.get_cmap("tab20")(np.arange(len(found.rooms) + 1) % 20)
    colours[0] = (0, 0, 0, 0)
    right.imshow(colours[found.labels], origin="lower", extent=EXTENT, alpha=0.75)
    for door in found.doors:
        ends = (np.array(door.ends)[:, ::-1] + 0.5) * CELL_M
        right.plot(ends[:, 0], ends[:, 1], color="red", linewidth=2)
    right.set_title("rooms, and the critical lines that stayed")
    figure.savefig(folder / "rooms_steps.png", dpi=80)
    plt.close(figure)


def ways(free: NDArray[np.bool_], folder: Path) -> None:
    """A plan and its alternatives."""
    grid = VoronoiGrid(free)
    planner = Planner(grid, CELL_M)
    room = np.argwhere(grid.field.squared >= 100)
    near = [room[np.argmin(np.abs(room - corner).sum(axis=1))] for corner in ((110, 110), (600, 640))]
    start, goal = (((c + 0.5) * CELL_M, (r + 0.5) * CELL_M) for r, c in near)
    plan = planner.plan(start, goal, clearance_m=0.3)
    figure, axes = plt.subplots(figsize=(6, 6))
    base(free, axes)
    for way in plan.alternatives:
        axes.plot(way.poses[:, 0], way.poses[:, 1], "--", color="tab:orange", label=f"{way.length_m:.1f} m")
    best = plan.way
    axes.plot(best.poses[:, 0], best.poses[:, 1], color="tab:green", linewidth=2.5, label=f"{best.length_m:.1f} m")
    axes.plot(*start, "o", color="tab:green")
    axes.plot(*goal, "*", color="tab:red", markersize=12)
    axes.legend(loc="upper left")
    figure.tight_layout()
    figure.savefig(folder / "rooms_ways.png", dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    folder = parser.parse_args().out
    free = office(side=SIDE)
    steps(free, folder)
    ways(free, folder)


if __name__ == "__main__":
    main()
