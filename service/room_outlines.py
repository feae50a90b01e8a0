"""Outlines of rooms for documents and drawings: the outer ring of a room's cells, simplified to about a decimetre."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapping.grids.patch import GridPatch

if TYPE_CHECKING:
    from mapping.hybrid.rooms import RoomMap

Bools = NDArray[np.bool_]
Ring = list[list[float]]

_SIMPLIFIED_M = 0.1


class RoomOutlines:
    """Outlines by a room's number; those of rooms whose cells are as they were are not worked out again."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int, int, bytes], Ring] = {}

    def of(self, found: RoomMap, grid: GridPatch) -> dict[int, Ring]:
        """Every room's outline in metres, map frame. grid: the one that the labels lie on."""
        from mapping.kernels.rooms import boxes

        box = np.empty((len(found.rooms) + 1, 4), dtype=np.int32)
        boxes(found.labels, box)
        known, self._known = self._known, {}
        outlines: dict[int, Ring] = {}
        for room in found.rooms:
            top, left, bottom, right = box[room.number].tolist()
            mask = found.labels[top : bottom + 1, left : right + 1] == room.number
            row0, col0 = top + grid.row0, left + grid.col0
            key = (row0, col0, mask.shape[1], np.packbits(mask).tobytes())
            ring = known.get(key)
            self._known[key] = outlines[room.number] = (
                outline(mask, grid.resolution_m, row0, col0) if ring is None else ring
            )
        return outlines


def outline(mask: Bools, resolution_m: float, row0: int, col0: int) -> Ring:
    """The outer ring of the largest piece of the cells in a mask (R, C), not empty; holes are left out.

    row0, col0: where it lies on the map. Metres, open: the first corner is not told again.
    """
    import shapely

    edge = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, begin = np.nonzero(edge == 1)
    _, end = np.nonzero(edge == -1)
    d = resolution_m
    runs = shapely.box((begin + col0) * d, (row + row0) * d, (end + col0) * d, (row + row0 + 1) * d)
    whole = shapely.union_all(runs)
    ring = max(shapely.get_parts(whole), key=lambda part: float(part.area)).exterior.simplify(_SIMPLIFIED_M)
    return [[round(float(x), 3) + 0.0, round(float(y), 3) + 0.0] for x, y in ring.coords[:-1]]
