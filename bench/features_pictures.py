"""Pictures of the feature maps for docs/algorithms/features.md, from recorded logs.

UMFELD_DATA=... python bench/features_pictures.py [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.relocalise_features import SHARE, outcome, posed_scans, remembered, spaced
from mapping.features.anchors import AnchorFinder, AnchorKind
from mapping.features.graph import anchor_graph, compare
from mapping.features.histograms import box_feature, square_scene, virtual_edges
from mapping.features.moments import arc_weights, inertia, smoothed_distances
from mapping.features.range_image import Mark, segment_ranges, surface_angles
from mapping.features.scenes import SCENE_FEATURES, sight_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
STYLE = {
    AnchorKind.FALSE_EDGE: ("x", "0.4"),
    AnchorKind.WALL_END: ("s", "C0"),
    AnchorKind.CORNER: ("o", "C3"),
    AnchorKind.JUMP_EDGE: ("^", "C2"),
    AnchorKind.VIRTUAL: ("*", "C4"),
}


def points_of(scan: Scan) -> tuple[F64, NDArray[np.bool_]]:
    hit = np.isfinite(scan.range_m) & (scan.range_m > 0.0)
    r, b = scan.range_m[hit], scan.bearing_rad[hit]
    return np.stack((r * np.cos(b), r * np.sin(b)), axis=-1), hit


def one_scan(folder: Path, scan: Scan) -> None:
    """S14 to S21 on one scan."""
    points, hit = points_of(scan)
    figure, axes = plt.subplots(2, 3, figsize=(15, 9))
    segments = segment_ranges(np.where(hit, scan.range_m, np.nan), 0.3, jump_per_m=0.05)
    degrees = np.degrees(scan.bearing_rad)
    panel = axes[0, 0]
    for k in range(segments.count):
        own = segments.label == k
        panel.plot(degrees[own], scan.range_m[own], ".", ms=3, color=f"C{k % 10}")
    for mark, style in ((Mark.STRAY, "kx"), (Mark.FALSE_EDGE, "r+"), (Mark.EDGE, "kv")):
        own = segments.mark == mark
        panel.plot(degrees[own], scan.range_m[own], style, ms=5, mfc="none")
    panel.set_title(f"S18: r(φ), {segments.count} segments; x stray, v edge, + false edge")
    panel = axes[0, 1]
    angle = surface_angles(points, segments.label[hit])
    panel.plot(degrees[hit], np.degrees(angle), "k.", ms=3)
    panel.set_title("S19: surface angle α(φ) [deg]")
    panel = axes[0, 2]
    found = inertia(points, weight=arc_weights(points))
    panel.plot(*points.T, ".", ms=3, color="0.6")
    panel.plot(*found.centre, "r+", ms=12)
    size = 2.0 * np.sqrt([found.most, found.least])
    panel.add_patch(Ellipse(found.centre, *size, angle=math.degrees(found.direction_rad), fill=False, color="C3"))
    panel.set_title(f"S15, S16: centre by arc length, ellipse {found.axis_ratio:.2f}")
    panel.set_aspect("equal")
    scene = square_scene(points)
    assert scene is not None
    panel = axes[1, 0]
    panel.plot(*scene.points.T, ".", ms=3, color="0.6")
    for x, low, high in zip(scene.x_walls.position_m, scene.x_walls.low_m, scene.x_walls.high_m):
        panel.plot([x, x], [low, high], "C0-", lw=1)
    for y, low, high in zip(scene.y_walls.position_m, scene.y_walls.low_m, scene.y_walls.high_m):
        panel.plot([low, high], [y, y], "C1-", lw=1)
    box = box_feature(scene)
    if box is not None:
        corners = scene.scene_from_sensor.apply(box.corners())
        panel.plot(*np.vstack((corners, corners[:1])).T, "--", color="C3", lw=1)
    panel.set_title("S14, S20: turned to its main orientation; walls, box")
    panel.set_aspect("equal")
    panel = axes[1, 1]
    anchors = AnchorFinder(scan.bearing_rad, range_max_m=scan.range_max_m).find(scan.range_m)
    virtual = virtual_edges(scene)
    graph = anchor_graph(anchors, virtual)
    for i, j in graph.edges:
        panel.plot(*graph.anchors.points[[i, j]].T, "-", color="0.85", lw=0.5)
    panel.plot(*points.T, ".", ms=3, color="0.6")
    for kind, (marker, colour) in STYLE.items():
        own = (virtual if kind is AnchorKind.VIRTUAL else anchors).of_kinds(kind)
        panel.plot(*own.points.T, marker, color=colour, mfc="none", ms=8, label=kind.name.lower())
    panel.legend(fontsize=7)
    panel.set_title(f"S19, S21: anchors, {len(graph)} vertices")
    panel.set_aspect("equal")
    panel = axes[1, 2]
    d = np.hypot(*(points - points.mean(axis=0)).T)
    for steepness in (2.0, 5.0, 10.0):
        order = np.argsort(d)
        panel.plot(d[order], smoothed_distances(points, steepness=steepness)[order], label=f"α = {steepness:g}")
    panel.legend(fontsize=8)
    panel.set_title("S17: distances from the centre, smoothed")
    save(figure, folder / "features_scan.png")


def found_place(folder: Path) -> None:
    """S22 and S25: questions over a run, and one of them with what proposed its place."""
    scans = posed_scans("fr079")
    cut = round(SHARE * len(scans))
    database = remembered(scans[:cut])
    figure, axes = plt.subplots(1, 2, figsize=(15, 6))
    poses = np.array([[p.x_m, p.y_m] for p in (database.pose(k) for k in range(len(database)))])
    axes[0].plot(*poses.T, ".", ms=3, color="0.7", label="scenes")
    told: dict[str, list[tuple[float, float]]] = {"right": [], "wrong": [], "unknown": []}
    example: Any = None
    for scan, pose in spaced(scans[cut:]):
        sight = sight_of(scan)
        kind = outcome(database, sight, pose)
        told[kind].append((pose.x_m, pose.y_m))
        if kind == "right" and (example is None or len(sight.graph) > len(example[1].graph)):
            example = (scan, sight)
    for kind, style in (("unknown", "C1."), ("right", "C2."), ("wrong", "rx")):
        axes[0].plot(*np.array(told[kind]).reshape(-1, 2).T, style, ms=5, label=f"{kind}: {len(told[kind])}")
    axes[0].legend()
    axes[0].set_title("fr079: questions from the last 40 % of the run, at their true places")
    axes[0].set_aspect("equal")
    scan, sight = example
    place = database.where_am_i(sight).place
    assert place is not None
    stored = database.pose(place.scene).apply(database.graph(place.scene).anchors.points)
    seen = place.map_from_sensor.apply(points_of(scan)[0])
    asked = place.map_from_sensor.apply(sight.graph.anchors.points)
    axes[1].plot(*seen.T, ".", ms=3, color="0.6", label="the question's points")
    axes[1].plot(*stored.T, "o", mfc="none", ms=10, color="C0", label=f"anchors of scene {place.scene}")
    axes[1].plot(*asked.T, "+", ms=8, color="C3", label="anchors of the question")
    axes[1].legend()
    axes[1].set_title(f"{place.partners} partners, score {place.score:.2f}")
    axes[1].set_aspect("equal")
    save(figure, folder / "features_place.png")


def compared(folder: Path) -> None:
    """S22: two scans of one place and what their graphs have in common; S23, S24: how feature vectors differ with the
    way between the places they are of, and where the nearest vectors of one question were taken."""
    kept = [(scan, pose, sight_of(scan)) for scan, pose in spaced(posed_scans("fr079"))]
    pair, most = (0, 0), 0
    for i in range(0, len(kept), 5):
        for j in range(i + 20, len(kept), 3):  # not from the same pass
            if 0.3 < np.hypot(kept[i][1].x_m - kept[j][1].x_m, kept[i][1].y_m - kept[j][1].y_m) < 1.5:
                match = compare(kept[i][2].graph, kept[j][2].graph)
                if match is not None and len(match) > most:
                    pair, most = (i, j), len(match)
    figure, axes = plt.subplots(1, 3, figsize=(18, 6), layout="constrained")
    (scan_a, _, a), (scan_b, _, b) = kept[pair[0]], kept[pair[1]]
    match = compare(a.graph, b.graph)
    assert match is not None
    panel = axes[0]
    shift = np.array([-1.2 * float(np.ptp(points_of(scan_a)[0][:, 0])), 0.0])
    own, its = a.graph.anchors.points + shift, b.graph.anchors.points
    for corners, edges in ((own, a.graph.edges), (its, b.graph.edges)):
        for i, j in edges:
            panel.plot(*corners[[i, j]].T, "-", color="0.9", lw=0.5)
    panel.plot(*(points_of(scan_a)[0] + shift).T, ".", ms=3, color="C0")
    panel.plot(*points_of(scan_b)[0].T, ".", ms=3, color="C1")
    panel.plot(*own.T, "o", mfc="none", color="C0")
    panel.plot(*its.T, "o", mfc="none", color="C1")
    for i, j in match.pairs:
        panel.plot(*np.stack((own[i], its[j])).T, "-", color="C3", lw=1)
    panel.set_title(
        f"S22: {len(match)} partners of {len(own)} and {len(its)} anchors, {100 * match.rms_m:.0f} cm apart"
    )
    panel.set_aspect("equal")
    panel = axes[1]
    at = np.array([(pose.x_m, pose.y_m) for _, pose, _ in kept])
    vectors = np.array([sight.vector for _, _, sight in kept])
    first, second = np.triu_indices(len(kept), 1)
    way = np.hypot(*(at[first] - at[second]).T)
    apart = SCENE_FEATURES.distance(vectors[first], vectors[second])
    lows = np.arange(0.0, 12.5, 0.5)
    for share, style in ((0.25, "C0--"), (0.5, "C0-"), (0.75, "C0--")):
        inside = [apart[(way >= low) & (way < low + 0.5)] for low in lows]
        panel.plot(lows + 0.25, [float(np.quantile(v, share)) for v in inside], style)
    panel.set_title(
        "S23, S24: distance of feature vectors by the way between\nthe places [m]; median and quartiles, all pairs"
    )
    panel.set_ylim(0.0)
    panel = axes[2]
    asked = pair[1]
    distance = SCENE_FEATURES.distance(vectors, vectors[asked])
    others = np.flatnonzero(np.arange(len(kept)) != asked)
    shown = panel.scatter(*at[others].T, c=distance[others], s=8, cmap="viridis")
    nearest = others[np.argsort(distance[others], kind="stable")[:8]]
    panel.plot(*at[nearest].T, "o", mfc="none", ms=10, color="C3", label="the eight nearest vectors")
    panel.plot(*at[asked], "k*", ms=12, label="the question")
    panel.legend()
    figure.colorbar(shown, ax=panel, shrink=0.7)
    panel.set_title("S24, S25: distance of each scene's vector from one question's")
    panel.set_aspect("equal")
    figure.savefig(folder / "features_compare.png", dpi=70)
    plt.close(figure)


def save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=70)
    plt.close(figure)


def telling(scans: Iterable[Scan]) -> Scan:
    """The scan with most anchors among those that show a box and a virtual edge."""
    best, most = None, -1
    for scan in scans:
        scene = square_scene(points_of(scan)[0])
        if scene is None or box_feature(scene) is None or not len(virtual_edges(scene)):
            continue
        count = len(sight_of(scan).graph)
        if count > most:
            best, most = scan, count
    assert best is not None
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    folder = parser.parse_args().out
    one_scan(folder, telling(scan for scan, _ in spaced(posed_scans("fr079"))))
    found_place(folder)
    compared(folder)


if __name__ == "__main__":
    main()
