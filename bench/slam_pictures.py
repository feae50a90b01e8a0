"""Maps and ways of recorded logs as `umfeld map build` makes them with its defaults, for docs/slam.md.

UMFELD_DATA=folder python bench/slam_pictures.py [--only NAME ...] [--out docs/pictures]

Grey unknown, white free, black occupied, the way in blue; a bar of ten metres.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from pathlib import Path
from typing import Final

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.grids.patch import GridPatch
from service.map_build import Built, PoseSource, build

U8 = NDArray[np.uint8]

SHEETS: Final[dict[str, tuple[tuple[str, str], ...]]] = {
    "slam_indoors": (("Intel", "carmen_logs/intel.clf.gz"), ("fr079", "carmen_logs/fr079.clf.gz")),
    "slam_clinic": (("fr-clinic", "carmen_logs/fr-clinic.clf.gz"),),
    "slam_corrected": (
        ("belgioioso", "known_pose_logs/belgioioso-corrected.log.gz"),
        ("seattle", "known_pose_logs/seattle-corrected.log.gz"),
        ("acapulco", "known_pose_logs/acapulco-corrected.log.gz"),
    ),
    "slam_ticks": (
        ("exp1", "encoder_laser/exp1.dat.gz"),
        ("exp2", "encoder_laser/exp2.dat.gz"),
        ("test_lab2", "encoder_laser/test_lab2.dat.gz"),
        ("UAL car", "encoder_laser/ual_car.scans.csv.gz"),
    ),
    "slam_wean": (
        ("Wean 1", "wean_localisation/robotdata1.log.gz"),
        ("Wean 3", "wean_localisation/robotdata3.log.gz"),
    ),
}
BAR_M: Final = 10.0


def pixels(patch: GridPatch, widest: int) -> U8:
    """(R, C) grey levels of a grid, row 0 below; in a map wider than the picture the darkest cell of a block counts."""
    level = np.full(patch.cells.shape, 205, dtype=np.uint8)
    known = patch.cells >= 0
    level[known] = np.round(254.0 * (1.0 - patch.cells[known] / 100.0)).astype(np.uint8)
    height, width = patch.cells.shape
    block = max(1, math.ceil(max(height, width) / widest))
    rows, cols = math.ceil(height / block), math.ceil(width / block)
    padded = np.full((rows * block, cols * block), 205, dtype=np.uint8)
    padded[:height, :width] = level
    blocks = padded.reshape(rows, block, cols, block)
    darkest, median = blocks.min(axis=(1, 3)), np.median(blocks, axis=(1, 3))
    drawn: U8 = np.where(darkest < 90, darkest, median).astype(np.uint8)
    return drawn


def sheet(title_of: dict[str, Built], path: Path) -> None:
    """One picture of one to four maps, each as large as its place allows."""
    columns = 2 if len(title_of) == 4 else len(title_of)
    figure = Figure(figsize=(14.0, {1: 9.0, 2: 6.2, 3: 6.2, 4: 12.4}[len(title_of)]))
    for place, (title, built) in enumerate(title_of.items()):
        axis = figure.add_subplot((len(title_of) + columns - 1) // columns, columns, place + 1)
        patch = built.grid.patch()
        d, (rows, cols) = patch.resolution_m, patch.cells.shape
        extent = (patch.col0 * d, (patch.col0 + cols) * d, patch.row0 * d, (patch.row0 + rows) * d)
        level = pixels(patch, 1050 // columns)
        axis.imshow(level, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
        axis.plot(built.robot_poses[:, 0], built.robot_poses[:, 1], lw=0.5, color="#2b6cb0", alpha=0.7)
        axis.plot((extent[0] + 1.0, extent[0] + 1.0 + BAR_M), (extent[2] + 1.0,) * 2, "k-", lw=3)
        closures = built.slam["closures"] if built.slam is not None else 0
        axis.set_title(f"{title}: {len(built.scans)} scans, {closures} closures, bar {BAR_M:.0f} m", fontsize=10)
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=75)
    Image.open(path).convert("RGB").quantize(48).save(path, optimize=True)


def main() -> int:
    """All pictures, or those named."""
    parser = argparse.ArgumentParser(description="Pictures of the maps of recorded logs.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs" / "pictures")
    parser.add_argument("--only", nargs="+", choices=sorted(SHEETS), default=sorted(SHEETS))
    options = parser.parse_args()
    data = Path(os.environ["UMFELD_DATA"])
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        built = {title: build(data / file, poses=PoseSource.SLAM) for title, file in SHEETS[name]}
        sheet(built, options.out / f"{name}.png")
        print(options.out / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
