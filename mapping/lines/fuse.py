"""Lines of two scans become one line (S07)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from mapping.kernels import lines as kernels
from mapping.lines.lines import Lines

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FusionRules:
    """When two lines are one.

    angle_rad: their directions differ by less (the book's epsilon).  offset_m: the ends of the shorter are no farther
    from the longer, and no end of either is farther from the joint line (delta).  gap_m: between the end of one and
    the start of the other (d); lines that overlap have none.
    """

    angle_rad: float = math.radians(12.0)
    offset_m: float = 0.10
    gap_m: float = 0.30

    def __post_init__(self) -> None:
        for field in fields(self):
            value = float(getattr(self, field.name))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{field.name} must be a number >= 0, got {value}")


def fuse(lines: Lines, others: Lines, rules: FusionRules | None = None) -> Lines:
    """All lines of two sets in one frame, those that are the same drawn as one; also within a set.

    Both of the book's cases and containment: lines overlap, follow each other within a gap, or one holds the other.
    Opposite directions stay apart: they are the two sides of something. A fused line is the regression over the points
    of both, by their moments, as long as both together. Each line meets each other one: n^2; LineMap looks only near.
    Source: S07.
    """
    chosen = rules or FusionRules()
    table = np.concatenate((lines.rows, others.rows))
    order = np.argsort(-_lengths(table), kind="stable")
    done: list[int] = []
    for index in order:
        _swallow(table, int(index), done, chosen)
    kept = np.array(sorted(done), dtype=np.int64)
    return Lines(table[kept], np.full((len(kept), 2), -1, dtype=np.int64))


def _swallow(table: F64, index: int, done: list[int], rules: FusionRules) -> None:
    """Let row `index` swallow every row of `done` that is the same line, and join them."""
    angle_cos = math.cos(min(rules.angle_rad, math.pi))
    while True:
        candidates = np.array(done, dtype=np.int64)
        partner = int(kernels.best_partner(table[index], table, candidates, angle_cos, rules.offset_m, rules.gap_m))
        if partner < 0:
            done.append(index)
            return
        kernels.fuse_rows(table[partner], table[index], table[index])
        done.remove(partner)


def _lengths(rows: F64) -> F64:
    return np.asarray(
        np.hypot(rows[:, kernels.END_X] - rows[:, kernels.START_X], rows[:, kernels.END_Y] - rows[:, kernels.START_Y])
    )
