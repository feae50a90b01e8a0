"""Position and cell: the one convention of every grid here, and the book's (S26, eq. 5.44 and 5.45).

Ours: cell i along an axis is the half-open interval [i d, (i + 1) d), so cell 0 begins at the origin and a point on a
border belongs to the cell on its upper side; its centre is (i + 1/2) d. Borders are the doubles i * d, to the last
bit: the largest double below a border is in the lower cell, also left of the origin.

The book: tile i has its centre at i d and is (i d - d/2, i d + d/2], so a point on a border belongs to the tile on
its lower side. A book tile is therefore one of our cells in a frame whose origin lies half a tile lower: the tile i
covers what cell i covers after x -> x + d/2, but for points exactly on a border. `book_tile_of` answers in the book's
own terms; `shift_to_book_frame` is the conversion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_CELL = 2**40  # beyond, neighbouring borders are no longer well apart in doubles


def check_resolution(resolution_m: float) -> float:
    """The resolution as a float; ValueError unless it is positive and finite."""
    d = float(resolution_m)
    if not (np.isfinite(d) and d > 0.0):
        raise ValueError(f"a grid's resolution_m is a positive length, got {resolution_m}")
    return d


def cell_of(position_m: ArrayLike, resolution_m: float) -> I64:
    """Cell index along one axis of each coordinate; any shape.

    Raises ValueError for coordinates that are not finite or farther than MAX_CELL cells from the origin.
    """
    d = check_resolution(resolution_m)
    x = np.asarray(position_m, dtype=np.float64)
    with np.errstate(over="ignore"):
        quotient = np.floor(x / d)
    if not np.all(np.abs(quotient) <= MAX_CELL):  # catches NaN too
        raise ValueError("a position is not finite or too far from the origin for this grid")
    index = quotient.astype(np.int64)
    # The quotient is rounded; the borders decide.
    index = np.where(x < index * d, index - 1, index)
    return np.where(x >= (index + 1) * d, index + 1, index)


def cells_of(points_m: ArrayLike, resolution_m: float) -> I64:
    """(N, 2) cells [row, col] of (N, 2) points [x, y]; ValueError as in cell_of or for another shape."""
    p = np.asarray(points_m, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 2:
        raise ValueError(f"points are (N, 2), got {p.shape}")
    return np.stack((cell_of(p[:, 1], resolution_m), cell_of(p[:, 0], resolution_m)), axis=-1)


def centre_of(index: ArrayLike, resolution_m: float) -> F64:
    """Coordinate of the middle of each cell along one axis, metres."""
    return (np.asarray(index, dtype=np.float64) + 0.5) * check_resolution(resolution_m)


def centres_of(cells: ArrayLike, resolution_m: float) -> F64:
    """(N, 2) points [x, y] in the middle of (N, 2) cells [row, col]."""
    c = np.asarray(cells)
    if c.ndim != 2 or c.shape[1] != 2:
        raise ValueError(f"cells are (N, 2), got {c.shape}")
    return centre_of(c[:, ::-1], resolution_m)


def book_tile_of(position_m: ArrayLike, resolution_m: float) -> I64:
    """Tile index of the source chapter: i d - d/2 < x <= i d + d/2 (eq. 5.44, 5.45); any shape; errors as cell_of.

    Borders are the doubles i * d + d / 2; the lower one of a tile is the upper one of the tile below.
    """
    d = check_resolution(resolution_m)
    x = np.asarray(position_m, dtype=np.float64)
    index = cell_of(x + d / 2, d)  # right but for points on or next to a border
    index = np.where(x <= (index - 1) * d + d / 2, index - 1, index)
    return np.where(x > index * d + d / 2, index + 1, index)


def shift_to_book_frame(position_m: ArrayLike, resolution_m: float) -> F64:
    """Where our position stands when the origin moves to the centre of our cell 0.

    There, book tile i is our cell i: book_tile_of(shift_to_book_frame(x, d), d) == cell_of(x, d) off the borders.
    """
    return np.asarray(position_m, dtype=np.float64) - check_resolution(resolution_m) / 2
