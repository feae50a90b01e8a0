"""A picture for docs/algorithms/topology.md: places and hallways of the simulated flat, as the daemon tells them.

    python bench/places_pictures.py [--out docs/pictures]

The drive is that of tests/world/test_live_places.py: glass, people, wheels that err, SLAM beside.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.frames import Pose2
from tests.world.test_live_places import driven
from tests.world.test_live_slam_worlds import HEIGHT_M

TINTS = ("#1769c2", "#2f9e6e", "#d9480f", "#7048e8", "#b97600", "#d6336c")


def draw(nodes: list[Any], edges: list[Any], segments: Any, path: Path) -> None:
    """Left: each area in its own frame, side by side. Right: laid where they were in the map, over the true walls."""
    figure, axes = plt.subplots(1, len(nodes) + 1, figsize=(19, 4.6), width_ratios=[*([1.0] * len(nodes)), 2.6])
    whole = axes[-1]
    for a, b in zip(segments.a, segments.b):
        whole.plot(*zip(a, b), color="#c8cfd8", linewidth=3)
    at = {}
    for axis, node, tint in zip(axes, nodes, TINTS):
        frame = Pose2(*node["area_frame"])
        at[node["id"]] = node["position"]
        for wall in node["walls"]:
            axis.plot(*zip(*wall), color=tint, linewidth=2)
            whole.plot(*frame.apply(np.array(wall)).T, color=tint, linewidth=1.5)
        for opening in node["openings"]:
            axis.plot(*zip(*opening["ends"]), color="#1b232d", linewidth=1, linestyle=":")
        for corner in node["corners"]:
            axis.plot(*corner["at"], "o" if corner["convex"] else "s", color="#1b232d", markersize=3)
        axis.plot(0, 0, "+", color="#1b232d", markersize=9)
        axis.set_title(node["name"], fontsize=10)
        axis.set_aspect("equal")
    for edge in edges:
        middle = np.mean(edge["ends"], axis=0)
        whole.plot(*zip(at[edge["from"]], middle, at[edge["to"]]), color="#1b232d", linewidth=1)
        whole.plot(*zip(*edge["ends"]), color="#1b232d", linewidth=3)
    for node in nodes:
        whole.annotate(node["name"], node["position"], fontsize=10)
    whole.set_title("as they lay in the map last, over the true walls", fontsize=10)
    whole.set_aspect("equal")
    figure.tight_layout()
    figure.savefig(path, dpi=75)


def main() -> int:
    """Draw it."""
    parser = argparse.ArgumentParser(description="Places and hallways of the simulated flat.")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    told = driven("flat")
    fields: Any = told.documents[-1].fields
    segments = told.driving.world.segments.at_height(HEIGHT_M)
    draw(fields["nodes"], fields["edges"], segments, parser.parse_args().out / "topology_places.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
