"""Plans of 2,000 x 2,000 cells of 5 cm to plan ways on, made here; each (R, C) bool, True where free."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

CELL_M = 0.05
SIDE = 2000

Bools = NDArray[np.bool_]


def office(seed: int = 7, side: int = SIDE) -> Bools:
    """Free cells: corridors 2.5 m wide every 17.5 m both ways, between them rooms with doors and furniture."""
    random = np.random.default_rng(seed)
    free = np.zeros((side, side), dtype=np.bool_)
    pitch, wide = 350, 50
    starts = range(10, side - wide, pitch)
    for at in starts:
        free[at : at + wide, 10 : side - 10] = True
        free[10 : side - 10, at : at + wide] = True
    for top in (at + wide + 4 for at in starts):
        for left in (at + wide + 4 for at in starts):
            bottom, right = min(top + pitch - wide - 8, side - 10), min(left + pitch - wide - 8, side - 10)
            _block(free, random, top, left, bottom, right)
    return free


def _block(free: Bools, random: np.random.Generator, top: int, left: int, bottom: int, right: int) -> None:
    """Four to nine rooms in a rectangle, doors of a metre to the corridors and to each other."""
    rows = np.linspace(top, bottom, int(random.integers(3, 5))).astype(int)
    cols = np.linspace(left, right, int(random.integers(3, 5))).astype(int)
    for r0, r1 in pairwise(rows):
        for c0, c1 in pairwise(cols):
            if r1 - r0 < 40 or c1 - c0 < 40:
                continue
            free[r0 + 2 : r1 - 2, c0 + 2 : c1 - 2] = True
            for _ in range(int((r1 - r0) * (c1 - c0) / 1500)):
                r, c = random.integers(r0 + 25, r1 - 25), random.integers(c0 + 25, c1 - 25)
                free[r : r + random.integers(1, 9), c : c + random.integers(1, 9)] = False
            for _ in range(2):
                if random.random() < 0.5:
                    at, edge = random.integers(c0 + 4, c1 - 26), (r0, r1)[random.integers(2)]
                    free[max(edge - 6, 10) : edge + 6, at : at + 20] = True
                else:
                    at, edge = random.integers(r0 + 4, r1 - 26), (c0, c1)[random.integers(2)]
                    free[at : at + 20, max(edge - 6, 10) : edge + 6] = True


def turned_office(seed: int = 11, degrees: float = 17.0) -> Bools:
    """Another office, its walls at an angle to the cells: steps everywhere."""
    turned = ndimage.rotate(office(seed).astype(np.uint8), degrees, order=0, reshape=False, cval=0)
    turned[[0, -1]] = turned[:, [0, -1]] = 0
    return np.asarray(turned > 0)


def warehouse(seed: int = 5, side: int = SIDE) -> Bools:
    """Rows of shelves 5 to 20 m long, aisles of 2.25 m, gaps of 1.2 to 2.5 m."""
    random = np.random.default_rng(seed)
    free = np.zeros((side, side), dtype=np.bool_)
    free[5:-5, 5:-5] = True
    for row in range(60, side - 100, 70):
        col = 60
        while col < side - 200:
            length = int(random.integers(100, 400))
            free[row : row + 25, col : min(col + length, side - 60)] = False
            col += length + int(random.integers(24, 50))
    return free


def hall_of_boxes(seed: int = 6, side: int = SIDE, boxes: int = 4000) -> Bools:
    """One hall, boxes up to 0.65 m long anywhere: a way is nearly straight, which is what A* on the grid likes best."""
    random = np.random.default_rng(seed)
    free = np.zeros((side, side), dtype=np.bool_)
    free[3:-3, 3:-3] = True
    for row, col in random.integers(5, side - 30, size=(boxes, 2)):
        free[row : row + random.integers(1, 14), col : col + random.integers(1, 14)] = False
    return free


PLANS: dict[str, Callable[[], Bools]] = {
    "office": office, "office, turned by 17 degrees": turned_office, "warehouse": warehouse,
    "hall of boxes": hall_of_boxes,
}  # fmt: skip
