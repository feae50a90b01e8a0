"""Room decomposition on maps whose rooms people labelled: recall, precision, counts and time.

    UMFELD_DATA=... python bench/rooms.py [--maps] [--json FILE]

Measure of Bormann et al. (2016): recall is the mean over labelled rooms of the largest overlap with one found region,
as a share of the room; precision the mean over found regions of the largest overlap with one labelled room, as a share
of the region. One set of rules for all maps. Pixels of 250 and above are free; a pixel is taken for 0.05 m. Time is of
one call, kernels compiled, by the million cells of the map.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.hybrid.rooms import find_rooms
from mapping.kernels import rooms as kernels

FREE_FROM = 250
PIXEL_M = 0.05
ROOM_MIN_PIXELS = 400  # of the drawn truth
DRAWN = (
    "Freiburg52_scan", "Freiburg79_scan", "NLB", "lab_a_scan", "lab_c_scan", "lab_intel", "office_b", "office_d",
    "office_f", "office_h",
)  # fmt: skip
ROBOT = ("intel", "freiburg52", "freiburg79", "g4s_y2", "map15")
VARIANTS = {
    "drawn, plain": "", "drawn, waste bins": "_trashbins", "drawn, furniture": "_furnitures",
    "drawn, furniture and bins": "_furnitures_trashbins",
}  # fmt: skip

I32 = NDArray[np.int32]
Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Score:
    """Of one map."""

    group: str
    name: str
    recall: float
    precision: float
    rooms: int
    found: int
    seconds_per_million: float


def pixels(path: Path) -> Grey:
    return np.asarray(Image.open(path).convert("L"), dtype=np.uint8)


def drawn_truth(path: Path) -> I32:
    """Rooms of a plan that dark lines cut apart: 4-connected white pixels, at least a square metre."""
    white = pixels(path) >= FREE_FROM
    label = np.empty(white.shape, dtype=np.int32)
    kernels.connected(white, False, label)
    area = np.bincount((label + 1).ravel())
    area[0] = 0
    number = np.cumsum(area >= ROOM_MIN_PIXELS) * (area >= ROOM_MIN_PIXELS)
    return np.asarray(number[label + 1], dtype=np.int32)


def labelled_maps(data: Path) -> Iterator[tuple[str, str, Grey, I32]]:
    """Group, name, map and true rooms."""
    for group, suffix in VARIANTS.items():
        for name in DRAWN:
            folder = data / "room_maps_drawn"
            yield group, name, pixels(folder / f"{name}{suffix}.png"), drawn_truth(folder / f"{name}.rooms.png")
    for name in ROBOT:
        folder = data / "room_maps_robot"
        truth = np.asarray(Image.open(folder / f"{name}.rooms.png"), dtype=np.int32)
        yield "robot", name, pixels(folder / f"{name}.png"), truth


def overlap_scores(truth: I32, found: I32) -> tuple[float, float, int, int]:
    """Recall, precision, number of true rooms, number of regions found; 0 in either array is no room."""
    both = np.zeros((truth.max() + 1, found.max() + 1))
    np.add.at(both, (truth, found), 1.0)
    room, region, common = both.sum(axis=1)[1:], both.sum(axis=0)[1:], both[1:, 1:]
    rooms, regions = room > 0, region > 0
    recall = float((common.max(axis=1)[rooms] / room[rooms]).mean())
    precision = float((common.max(axis=0)[regions] / region[regions]).mean()) if regions.any() else 0.0
    return recall, precision, int(rooms.sum()), int(regions.sum())


def score(group: str, name: str, grey: Grey, truth: I32) -> Score:
    started = time.perf_counter()
    found = find_rooms(grey >= FREE_FROM, PIXEL_M).labels
    seconds = time.perf_counter() - started
    return Score(group, name, *overlap_scores(truth, found), seconds * 1e6 / grey.size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", action="store_true", help="a line for each map, too")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if not os.environ.get("UMFELD_DATA"):
        parser.exit(2, "UMFELD_DATA is not set: name the folder of the recorded data there\n")
    maps = list(labelled_maps(Path(os.environ["UMFELD_DATA"])))
    score(*maps[0])  # compiles
    scores = [score(*each) for each in maps]
    print(f"{'':28} recall precision  found/rooms (least, most)  s/Mcell")
    for group in dict.fromkeys(each.group for each in scores):
        rows = [each for each in scores if each.group == group]
        shares = [each.found / each.rooms for each in rows]
        print(
            f"{group:28} {np.mean([e.recall for e in rows]):.3f}  {np.mean([e.precision for e in rows]):.3f}"
            f"      {np.mean(shares):.2f} ({min(shares):.2f}, {max(shares):.2f})"
            f"            {np.mean([e.seconds_per_million for e in rows]):.3f}"
        )
        if arguments.maps:
            for e in rows:
                print(f"  {e.name:26} {e.recall:.3f}  {e.precision:.3f}      {e.found}/{e.rooms}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(each) for each in scores], indent=2))


if __name__ == "__main__":
    main()
