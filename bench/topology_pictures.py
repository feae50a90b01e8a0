"""Pictures for docs/algorithms/topology.md: regions of a plan, ALICE's map, nets over a recorded log.

    python bench/topology_pictures.py [--out docs/pictures]

The nets need UMFELD_DATA.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
from pathlib import Path
from typing import Any

import matplotlib
import networkx as nx
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.neural_gas import sonar_ring
from drivers.alice import AliceConversation
from drivers.readings import RingReading
from mapping.topology.alice import AliceMap, AliceRules
from mapping.topology.neural_gas import FritzkeGas, FritzkeRules, GasRules, NeuralGas, flat_picture
from mapping.topology.queries import route
from mapping.topology.regions import decompose, decomposition_tree, floor_plan
from sim_devices.alice import Alice

Box = list[tuple[float, float]]
STEP_NS = 50_000_000
START = np.array([1.0, 1.0])


def box(x0: float, y0: float, x1: float, y1: float) -> Box:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def regions(folder: Path) -> None:
    """S41: figs. 5.32 to 5.34 with some furniture."""
    rooms = [box(0, 0, 4, 4), box(5, 0, 9, 4), box(10, 0, 14, 4), box(0, 5, 14, 7)]
    doors = [box(x, 4, x + 0.9, 5) for x in (1.5, 6.5, 11.5)]
    found = decompose(floor_plan([*rooms, *doors], [box(1, 1, 2, 2), box(6, 1, 8, 1.5)]))
    graph = found.graph()
    tree = decomposition_tree(graph)
    part_of = {member: k for k, part in enumerate(tree.subgraphs) for member in part.members}
    figure, axes = plt.subplots(2, 1, figsize=(10, 11))
    for region in found.regions:
        axes[0].fill(*region.corners_m.T, color=f"C{part_of[region.number] % 10}", alpha=0.35)
        axes[0].text(*region.centre_m, str(region.number), ha="center", va="center")
    for passage in found.passages:
        axes[0].plot(*passage.ends_m.T, "k--", lw=1)
    axes[0].set_title(
        f"S41: {len(found.regions)} convex regions, {len(found.passages)} passages (dashed); "
        f"colours: the {len(tree.subgraphs)} subgraphs of the decomposition tree"
    )
    at = {region.number: region.centre_m for region in found.regions}
    nx.draw_networkx(graph, at, ax=axes[1], node_size=260, node_color=[f"C{part_of[n] % 10}" for n in graph])
    nx.draw_networkx_edges(graph, at, edgelist=[j[2] for j in tree.joints], ax=axes[1], edge_color="C3", width=3)
    ways = route(graph, 0, max(graph, key=lambda n: at[n][0] - at[n][1]))
    axes[1].set_title(f"region graph; red: single connections; shortest way {' - '.join(map(str, ways.nodes))}")
    for axis in axes:
        axis.set_aspect("equal")
    save(figure, folder / "topology_regions.png")


def drive(rules: AliceRules, *, minutes: float) -> tuple[AliceMap, dict[int, list[tuple[float, float]]], Alice]:
    """ALICE through its bytes."""
    robot, wire, topo = Alice(seed=1, false_looks=0.01), AliceConversation(), AliceMap(rules)
    wire.connected(0)
    before: RingReading | None = None
    truth: dict[int, list[tuple[float, float]]] = {}
    for now in range(STEP_NS, round(minutes * 60e9), STEP_NS):
        wire.requests(now)
        for reading in wire.receive(robot.step(now, b""), now):
            assert isinstance(reading, RingReading)
            moved = before is not None and reading.continuous
            way = (reading.ahead_m - before.ahead_m, reading.left_m - before.left_m) if moved and before else (0.0, 0.0)
            before = reading
            unit = topo.look(reading.light, reading.touch.astype(np.float64), way)
            truth.setdefault(unit, []).append((robot.x_m, robot.y_m))
    return topo, truth, robot


def alice(folder: Path) -> None:
    """S43: figs. 5.38 to 5.40."""
    figure, axes = plt.subplots(1, 3, figsize=(17, 5))
    for axis, correct in ((axes[1], True), (axes[2], False)):
        topo, truth, robot = drive(AliceRules(correct_heading=correct), minutes=20.0)
        for wall in robot.room.walls:
            axis.plot(wall[[0, 2]], wall[[1, 3]], color="0.4", lw=2)
        graph = topo.graph()
        at = {node.number: START + node.position_m for node in graph.nodes}
        for a, b, *_ in graph.edges:
            axis.plot(*np.array([at[a], at[b]]).T, "C0-", lw=1)
        for number, place in at.items():
            axis.plot(*place, "C1.", ms=6)
            axis.plot(*np.array([place, np.mean(truth[number], axis=0)]).T, "C3-", lw=0.8)
        errors = [math.dist(START + topo.position_m(n), np.mean(met, axis=0)) for n, met in truth.items()]
        title = "heading from the light" if correct else "odometry alone"
        axis.set_title(f"{title}: {len(graph.nodes)} nodes, {len(graph.edges)} edges; off by {np.median(errors):.2f} m")
        axis.set_aspect("equal")
        if correct:
            looks(axes[0], topo, graph.nodes[0].number)
    save(figure, folder / "topology_alice.png")


def looks(axis: Any, topo: AliceMap, number: int) -> None:
    """One unit's vector around the robot."""
    vector = next(node.vector for node in topo.graph().nodes if node.number == number)
    angle = np.arange(25) * math.pi / 12.0
    for ring, color, name in ((vector[:24], "C1", "light"), (vector[24:], "C0", "touch")):
        size = 0.3 + np.append(ring, ring[0])
        axis.plot(size * np.cos(angle), size * np.sin(angle), color=color, label=name)
    axis.plot(0.3 * np.cos(angle), 0.3 * np.sin(angle), color="0.6", lw=0.8)
    axis.set_title(f"what unit {number} looks like")
    axis.legend(loc="lower right")
    axis.set_aspect("equal")


def nets(folder: Path, ring: np.ndarray[Any, Any]) -> None:
    """S42: both rules over the same log, in their two widest directions."""
    figure, axes = plt.subplots(1, 2, figsize=(14, 6))
    book = NeuralGas(24, GasRules(new_node_distance=0.8, split_count=100))
    walk = [book.learn(scene).node for scene in ring]
    edges = {(a, b) for a, b in itertools.pairwise(walk) if a != b}
    draw_net(axes[0], book.vectors, edges, f"alg. 5.5, D = 0.8: {len(book)} nodes; lines: ways driven")
    fritzke = FritzkeGas(24, FritzkeRules(max_nodes=len(book), every=10))
    for _ in range(10):
        for scene in ring:
            fritzke.learn(scene)
    rank = {number: k for k, number in enumerate(fritzke.numbers)}
    vectors = np.array([fritzke.vector(number) for number in rank])
    pairs = {(rank[a], rank[b]) for a, b in fritzke.edges}
    draw_net(axes[1], vectors, pairs, f"[Fri95]: {len(fritzke)} nodes; lines: its edges")
    save(figure, folder / "topology_nets.png")


def draw_net(axis: Any, vectors: Any, edges: set[tuple[int, int]], title: str) -> None:
    at = flat_picture(vectors)
    for a, b in edges:
        axis.plot(*at[[a, b]].T, "C0-", lw=0.5, alpha=0.5)
    axis.plot(*at.T, "C1.", ms=5)
    axis.set_title(title)


def save(figure: Any, path: Path) -> None:
    """Write a picture and say so."""
    figure.tight_layout()
    figure.savefig(path, dpi=75)
    plt.close(figure)
    print(path)


def main() -> int:
    """All pictures."""
    parser = argparse.ArgumentParser(description="Pictures of the topological maps.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "pictures")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    regions(folder)
    alice(folder)
    if data := os.environ.get("UMFELD_DATA"):
        nets(folder, sonar_ring(Path(data) / "ultrasonic" / "scitos_ring24.csv.gz"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
