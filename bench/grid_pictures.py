"""Pictures of the grids for docs/algorithms/grids.md, from recorded maps and clouds.

python bench/grid_pictures.py --data FOLDER [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import io
import math
import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mapping.grids.clearance import clearance_layer, inflated
from service.export import load_map, patch_of
from service.space_files import elevation_of_file, octree_of_file, quadtree_of_file

WIDEST_PX = 1100


def fitted(picture: bytes) -> Image.Image:
    """A picture no wider than the page wants."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    scale = min(1.0, WIDEST_PX / image.width, 800 / image.height)
    return image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.LANCZOS)


def clearance_picture(map_file: Path, radius_m: float) -> Image.Image:
    """Left: distance to the nearest obstacle, lines every 0.5 m. Right: the map inflated by a radius."""
    patch = patch_of(load_map(map_file))
    distance = clearance_layer(patch)
    level = np.clip(np.nan_to_num(distance, posinf=6.0) / 6.0, 0.0, 1.0)
    left = (np.stack((60 + 190 * level, 90 + 140 * level, 160 - 60 * level), axis=-1)).astype(np.uint8)
    left[np.abs(np.mod(distance, 0.5)) < patch.resolution_m * 0.6] = (255, 255, 255)
    left[patch.cells < 0] //= 2
    left[patch.cells >= 65] = 0
    grown = inflated(patch, radius_m).cells
    right = np.full((*grown.shape, 3), 200, dtype=np.uint8)
    right[(grown >= 0) & (grown < 25)] = 255
    right[grown >= 65] = (200, 120, 110)
    right[patch.cells >= 65] = 0
    gap = np.full((grown.shape[0], 8, 3), 255, dtype=np.uint8)
    image = Image.fromarray(np.concatenate((left, gap, right), axis=1)[::-1])
    out = io.BytesIO()
    image.resize((image.width * 2, image.height * 2), Image.Resampling.NEAREST).save(out, format="PNG")
    return fitted(out.getvalue())


def main() -> None:
    parser = argparse.ArgumentParser(description="Pictures of the grids.")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("UMFELD_DATA", ".")), help="recorded data")
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    options = parser.parse_args()
    data = Path(options.data)
    room = data / "point_clouds/room_scan1.pcd"
    pictures = {
        "grids_quadtree": fitted(quadtree_of_file(data / "grid_maps/freiburg.yaml").picture()),
        "grids_octree": fitted(octree_of_file(room, resolution_m=0.05).picture()),
        "grids_elevation": fitted(elevation_of_file(room, resolution_m=0.1, height_max_m=-0.3).picture()),
        "grids_clearance": clearance_picture(data / "grid_maps/freiburg.yaml", math.sqrt(2.0) * 0.2),
    }
    for name, image in pictures.items():
        image.quantize(64).save(options.out / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
