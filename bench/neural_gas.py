"""Growing neural gas: the exact nearest node, ours and others in one run; and nets over a recorded log.

    OPENBLAS_NUM_THREADS=1 python bench/neural_gas.py [--nodes N] [--queries N] [--exact N] [--json FILE]

Vectors have 48 components. `impressions`: 24 lights and 24 smoothed touches of a small round robot anywhere in a room
of 8 x 6 m with five lamps, 2 % noise; `driven`: the same, queries along a drive and nodes in the order of another;
`uniform`: uniform random, where every node is about equally far and no index can help.
One thread each. numpy: matrix product and argmin, in float64 as ours, and in float32, which is not exact.
exact: queries whose answer is compared with brute force
in float64. With UMFELD_DATA also the log of a ring of 24 sonars: nets learnt on its first half, judged on its second.
"""

from __future__ import annotations

import argparse
import gzip
import importlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.topology.nearest import Effort, NearestNodes
from mapping.topology.neural_gas import FritzkeGas, FritzkeRules, GasRules, NeuralGas, quantisation_error

F64 = NDArray[np.float64]
REACH = 0.25
ROOM_M = np.array([8.0, 6.0])
LAMPS = np.array([[0.0, 0.0], [8.0, 1.0], [4.0, 6.0], [1.0, 5.0], [7.0, 5.5]])


def impressions(place: F64, yaw: F64, random: np.random.Generator) -> F64:
    """(N, 48) at places (N, 2) and headings (N,)."""
    bearing = yaw[:, None] + np.arange(24) * np.pi / 12.0
    light = np.zeros((len(place), 24))
    for lamp in LAMPS:
        away = lamp - place
        off = bearing - np.arctan2(away[:, 1], away[:, 0])[:, None]
        light += np.exp(-((np.angle(np.exp(1j * off)) / 0.35) ** 2)) / (1.0 + np.sum(away**2, axis=1))[:, None]
    light = np.clip(light + random.normal(0.0, 0.02, light.shape), 0.0, 1.0)
    x, y = place[:, :1] + 0.35 * np.cos(bearing), place[:, 1:] + 0.35 * np.sin(bearing)
    touch = ((x < 0.0) | (x > ROOM_M[0]) | (y < 0.0) | (y > ROOM_M[1])).astype(float)
    touch = (2.0 * touch + np.roll(touch, 1, axis=1) + np.roll(touch, -1, axis=1)) / 4.0
    return np.concatenate((light, touch), axis=1)


def scattered(count: int, random: np.random.Generator) -> F64:
    """Anywhere, any heading."""
    return impressions(random.random((count, 2)) * ROOM_M, random.random(count) * 2.0 * np.pi, random)


def driven(count: int, random: np.random.Generator) -> F64:
    """Along a drive that wanders, 2 cm and a few degrees a step, mirrored at the walls."""
    yaw = np.cumsum(random.normal(0.0, 0.06, count))
    way = np.cumsum(0.02 * np.stack((np.cos(yaw), np.sin(yaw)), axis=1), axis=0) + ROOM_M * random.random(2)
    folded = np.abs(way % (2.0 * ROOM_M))
    return impressions(np.minimum(folded, 2.0 * ROOM_M - folded), yaw, random)


def uniform(count: int, random: np.random.Generator) -> F64:
    """The hard case."""
    return random.random((count, 48))


def median_us(ask: Callable[[F64], Any], queries: F64) -> float:
    """Of one call, after a warm-up."""
    for query in queries[:200]:
        ask(query)
    taken = []
    for query in queries:
        start = time.perf_counter()
        ask(query)
        taken.append(time.perf_counter() - start)
    return 1e6 * float(np.median(taken))


def search(make: Callable[[int, np.random.Generator], F64], count: int, queries: int) -> dict[str, float]:
    """One kind of vectors."""
    nodes, asked = make(count, np.random.default_rng(1)), make(queries, np.random.default_rng(2))
    net = NearestNodes(48, reach=REACH)
    start = time.perf_counter()
    for node in nodes:
        net.add(node)
    added = 1e6 * (time.perf_counter() - start) / count
    single = nodes.astype(np.float32)
    half, half64 = 0.5 * np.sum(single**2, axis=1), 0.5 * np.sum(nodes**2, axis=1)
    tree = cKDTree(nodes)
    figures = {"ours_us": median_us(net.nearest, asked)}
    net.effort = Effort()
    figures["ours_again_us"] = median_us(net.nearest, asked)
    figures |= {
        "numpy_us": median_us(lambda q: np.argmin(half64 - nodes @ q), asked),
        "numpy_float32_us": median_us(lambda q: np.argmin(half - single @ q.astype(np.float32)), asked),
        "tree_us": median_us(tree.query, asked[:300]),
    }
    try:
        faiss = importlib.import_module("faiss")
    except ImportError:
        pass
    else:
        flat = faiss.IndexFlatL2(48)
        flat.add(single)
        figures["faiss_us"] = median_us(lambda q: flat.search(q[None, :].astype(np.float32), 1), asked)
    asked_again = net.effort.queries
    figures |= {
        "add_us": added,
        "by_marks": net.effort.by_marks / asked_again,
        "read_in_full": net.effort.read / asked_again,
        "in_question": net.effort.in_question / asked_again,
        "looked_at": net.effort.looked_at / asked_again,
    }
    return figures


def differing(make: Callable[[int, np.random.Generator], F64], count: int, queries: int) -> int:
    """How many of the queries have another answer than brute force."""
    nodes = make(count, np.random.default_rng(3))
    net = NearestNodes(48, reach=REACH)
    for node in nodes:
        net.add(node)
    tree, wrong = cKDTree(nodes), 0
    for query in make(queries, np.random.default_rng(4)):
        found = net.nearest(query)
        distance, number = tree.query(query)
        wrong += found is None or (found[0] != number and abs(found[1] - distance) > 1e-12)
    return wrong


def sonar_ring(path: Path) -> F64:
    """(N, 24) in [0, 1]; 5 m, no echo, is 1."""
    with gzip.open(path, "rt") as lines:
        rows = [line.split(",")[:24] for line in lines if not line.startswith("us")]
    return np.clip(np.array(rows, dtype=np.float64) / 5.0, 0.0, 1.0)


def on_log(path: Path) -> dict[str, dict[str, float]]:
    """Learn the first half, judge on the second; then learn that, too, and see what of the graph stays."""
    ring = sonar_ring(path)
    first, second = ring[: len(ring) // 2], ring[len(ring) // 2 :]
    table = {}
    for distance in (0.4, 0.6, 0.8):
        gas = NeuralGas(24, GasRules(new_node_distance=distance, split_count=100))
        before = _walked([gas.learn(scene).node for scene in first])
        nodes = gas.vectors.copy()
        error = quantisation_error(nodes, second)
        again = [gas.learn(scene).node for scene in second]
        after = _walked(again)
        known = [(a, b) for a, b in _steps(again) if a < len(nodes) and b < len(nodes)]
        table[f"book D={distance}"] = {
            "nodes": len(nodes),
            "edges": len(before),
            "error_mean": float(error.mean()),
            "error_p95": float(np.quantile(error, 0.95)),
            "nodes_added_by_second": len(gas) - len(nodes),
            "edges_added_by_second": len(after - before),
            "moves_along_known_edges": float(np.mean([tuple(sorted(s)) in before for s in known])) if known else 0.0,
            "nodes_moved_mean": float(np.linalg.norm(gas.vectors[: len(nodes)] - nodes, axis=1).mean()),
        }
        fritzke = FritzkeGas(24, FritzkeRules(max_nodes=max(len(nodes), 2), every=10))
        for _ in range(10):
            for scene in first:
                fritzke.learn(scene)
        old = {n: fritzke.vector(n) for n in fritzke.numbers}
        edges = set(fritzke.edges)
        error = quantisation_error(np.array(list(old.values())), second)
        for scene in second:
            fritzke.learn(scene)
        table[f"Fritzke, {len(old)} nodes"] = {
            "nodes": len(old),
            "edges": len(edges),
            "error_mean": float(error.mean()),
            "error_p95": float(np.quantile(error, 0.95)),
            "edges_added_by_second": len(set(fritzke.edges) - edges),
            "edges_kept": len(edges & set(fritzke.edges)) / len(edges),
            "nodes_moved_mean": float(
                np.mean([np.linalg.norm(fritzke.vector(n) - v) for n, v in old.items() if n in fritzke.numbers])
            ),
        }
    return table


def _steps(walk: list[int]) -> list[tuple[int, int]]:
    return [(a, b) for a, b in itertools.pairwise(walk) if a != b]


def _walked(walk: list[int]) -> set[tuple[int, int]]:
    return {(min(step), max(step)) for step in _steps(walk)}


def main() -> int:
    """All figures."""
    parser = argparse.ArgumentParser(description="Growing neural gas: search and nets.")
    parser.add_argument("--nodes", type=int, default=20_000)
    parser.add_argument("--queries", type=int, default=2_000)
    parser.add_argument("--exact", type=int, default=0, help="compare so many answers with brute force")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = {}
    for make in (scattered, driven, uniform):
        result[make.__name__] = search(make, options.nodes, options.queries)
        if options.exact:
            result[make.__name__]["differing"] = differing(make, 3_000, options.exact)
        print(make.__name__, {name: round(value, 2) for name, value in result[make.__name__].items()})
    data = os.environ.get("UMFELD_DATA")
    if data:
        result["log"] = on_log(Path(data) / "ultrasonic" / "scitos_ring24.csv.gz")
        for name, figures in result["log"].items():
            print(name, {key: round(value, 3) for key, value in figures.items()})
    if options.json:
        options.json.write_text(json.dumps(result, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
