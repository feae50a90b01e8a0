"""A building's Voronoi graph beside the waypoints that people laid over it for a robot's long-term runs.

    UMFELD_DATA=... python bench/waypoints.py

Map and waypoints: STRANDS, a care home, 55 x 143 m in cells of 5 cm. Told: how many waypoints lie within a metre of the
graph, and for how many of the people's edges the planner has a way of at most 1.5 times the straight length.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.hybrid.planner import NoWayError, Planner
from mapping.hybrid.voronoi import VoronoiGrid

CELL_M = 0.05
ORIGIN_M = (-39.85, -77.95)
FREE_FROM = 206
CLEARANCE_M = 0.0
NEAR_M, DETOUR = 1.0, 1.5


def main() -> None:
    if not os.environ.get("UMFELD_DATA"):
        sys.exit("UMFELD_DATA is not set: name the folder of the recorded data there")
    data = Path(os.environ["UMFELD_DATA"])
    free = np.asarray(Image.open(data / "grid_maps" / "aaf_winter.pgm"))[::-1] >= FREE_FROM
    people = json.loads((data / "topological_maps" / "aaf_winter.json").read_text())
    place = {node["name"]: (node["x"], node["y"]) for node in people["nodes"]}
    col0, row0 = (round(v / CELL_M) for v in ORIGIN_M)
    started = time.perf_counter()
    grid = VoronoiGrid(free)
    planner = Planner(grid, CELL_M, row0=row0, col0=col0)
    made_s = time.perf_counter() - started
    rows, cols = np.divmod(np.concatenate((planner.graph.chain, planner.graph.node_cell)), grid.shape[1])
    graph_xy = (np.stack((cols, rows), axis=-1) + 0.5 + (col0, row0)) * CELL_M
    away = np.array([np.hypot(*(graph_xy - xy).T).min() for xy in place.values()])
    straight, found = [], []
    for edge in people["edges"]:
        a, b = place[edge["a"]], place[edge["b"]]
        straight.append(float(np.hypot(a[0] - b[0], a[1] - b[1])))
        try:
            found.append(planner.plan(a, b, clearance_m=CLEARANCE_M, alternatives=0).way.length_m)
        except NoWayError as trouble:
            print(f"  {edge['a']} to {edge['b']}: {trouble}")
            found.append(np.inf)
    good = np.array(found) <= DETOUR * np.array(straight)
    print(f"made in                {1e3 * made_s:.0f} ms, kernels loaded or compiled ones included")
    print(
        f"waypoints within {NEAR_M:.0f} m   {(away <= NEAR_M).mean():.3f} of {len(place)}, farthest {away.max():.2f} m"
    )
    print(f"edges with a way       {good.mean():.3f} of {len(good)}")


if __name__ == "__main__":
    main()
