"""Anchor points: the places of a scan that are the same from wherever they are seen (S19)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angles
from mapping.kernels import features as kernels
from mapping.lines.extract import FARTHEST_M, LineExtractor, LineRules
from mapping.lines.lines import Lines

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_SEAM_FACTOR: Final = 1.5


class AnchorKind(IntEnum):
    """The book's four types (figure 5.18), and virtual edges."""

    FALSE_EDGE = kernels.FALSE_EDGE
    """A wall ends only because something nearer hides the rest."""
    WALL_END = kernels.WALL_END
    """A wall goes over into something that is not straight."""
    CORNER = kernels.CORNER
    """Two walls meet."""
    JUMP_EDGE = kernels.JUMP_EDGE
    """A wall really ends: what lies behind it is farther away."""
    VIRTUAL = kernels.VIRTUAL
    """Two walls would meet here; no beam hit it (S20)."""


@dataclass(frozen=True, slots=True)
class Anchors:
    """N anchors in one frame. rows: (N, 7) as described in mapping/kernels/features.py, read-only by custom."""

    rows: F64

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def points(self) -> F64:
        """(N, 2) [m]."""
        return self.rows[:, kernels.X : kernels.KIND]

    @property
    def kinds(self) -> I64:
        """(N,) numbers of AnchorKind."""
        return self.rows[:, kernels.KIND].astype(np.int64)

    @property
    def walls_rad(self) -> F64:
        """(N, 2) directions from the anchor along its walls, the one at smaller bearings first; NaN: no wall."""
        return self.rows[:, kernels.BEFORE : kernels.LENGTH]

    @property
    def beams(self) -> I64:
        """(N,) the nearest beam; -1 for virtual ones."""
        return self.rows[:, kernels.BEAM].astype(np.int64)

    def of_kinds(self, *kinds: AnchorKind) -> Anchors:
        """Those of some kinds."""
        return Anchors(self.rows[np.isin(self.kinds, kinds)])

    def transformed(self, a_from_b: Pose2) -> Anchors:
        """These anchors, given in frame b, in frame a."""
        rows = self.rows.copy()
        rows[:, kernels.X : kernels.KIND] = a_from_b.apply(self.points)
        rows[:, kernels.BEFORE : kernels.LENGTH] = wrap_angles(self.walls_rad + a_from_b.yaw_rad)
        return Anchors(rows)


def no_anchors() -> Anchors:
    """None."""
    return Anchors(np.empty((0, kernels.ROW)))


def joined(parts: Iterable[Anchors]) -> Anchors:
    """All anchors of several sets, in order."""
    return Anchors(np.concatenate([np.empty((0, kernels.ROW)), *(part.rows for part in parts)]))


def _wall_rules() -> LineRules:
    return LineRules(min_points=5, min_length_m=0.2, sigma_m=0.015, split_m=0.05)


@dataclass(frozen=True, slots=True)
class AnchorRules:
    """What makes an anchor.

    lines: what a wall is: a stretch of constant surface angle.  bend_deg: walls that meet under less are one.
    corner_m: how far from a wall's last point its corner may lie.  look_beams: how many beams past a wall's end tell
    what it is.  shortest_m: walls shorter than this give no anchors.
    """

    lines: LineRules = field(default_factory=_wall_rules)
    bend_deg: float = 25.0
    corner_m: float = 0.15
    look_beams: int = 3
    shortest_m: float = 0.25

    def __post_init__(self) -> None:
        for each in fields(self):
            if each.name != "lines":
                value = float(getattr(self, each.name))
                if not (math.isfinite(value) and value > 0.0):
                    raise ValueError(f"{each.name} must be a number above 0, got {value}")
        if self.bend_deg >= 90.0:
            raise ValueError(f"bend_deg must be below 90, got {self.bend_deg}")


class AnchorFinder:
    """Anchors of the scans of one device."""

    def __init__(
        self,
        bearing_rad: ArrayLike,
        rules: AnchorRules | None = None,
        *,
        range_min_m: float = 0.0,
        range_max_m: float = FARTHEST_M,
    ) -> None:
        """bearing_rad: (N,) strictly rising or strictly falling, at most a full turn.  ValueError otherwise."""
        self.rules = rules or AnchorRules()
        bearing = np.array(bearing_rad, dtype=np.float64)
        self.extractor = LineExtractor(bearing, self.rules.lines, range_min_m=range_min_m, range_max_m=range_max_m)
        self._cosine, self._sine = np.cos(bearing), np.sin(bearing)
        self._falling = bool(bearing.size > 1 and bearing[0] > bearing[-1])
        step = np.abs(np.diff(bearing))
        spacing = float(np.median(step)) if step.size else 0.0
        self._spacing = self.rules.lines.gap_beams * spacing
        self._full_turn = bool(step.size and 2.0 * math.pi - np.sum(step) <= _SEAM_FACTOR * spacing)
        self._near_m, self._far_m = max(range_min_m, 0.0), min(range_max_m, FARTHEST_M)

    def find(self, range_m: ArrayLike) -> Anchors:
        """Anchors of types 1 to 4 of one scan, in the sensor's frame, by rising bearing of their walls.

        range_m: (N,); +inf is looked at as "nothing near", NaN, -inf and what is below range_min_m as "not known": a
        wall that ends there has no anchor.  No walls, no anchors.  ValueError for another shape.
        """
        ranges = np.ascontiguousarray(range_m, dtype=np.float64)
        return self.of_lines(ranges, self.extractor.extract(ranges))

    def of_lines(self, range_m: ArrayLike, lines: Lines) -> Anchors:
        """The same with the scan's lines, where they are known already (from `extractor`, or one with other rules).

        Type 3: two walls of one surface that meet under an angle, at the intersection of their regression lines.
        Type 4: the surface ends and what comes next is farther, or nothing.  Type 1: what comes next is nearer, so the
        end is a shadow's.  Type 2: the surface goes on and is not straight.  Source: S19, figure 5.18.
        """
        ranges = np.ascontiguousarray(range_m, dtype=np.float64)
        if ranges.shape != self._cosine.shape:
            raise ValueError(f"range_m is ({self._cosine.size},) like the bearings, got {ranges.shape}")
        chosen = lines.chosen(np.flatnonzero(lines.length_m >= self.rules.shortest_m))
        cosine, sine, beams = self._cosine, self._sine, chosen.beams
        if self._falling:
            cosine, sine, ranges = cosine[::-1].copy(), sine[::-1].copy(), ranges[::-1].copy()
            beams = ranges.size - 1 - beams
        out = np.empty((2 * len(chosen), kernels.ROW))
        count = kernels.anchors_of_lines(
            cosine, sine, ranges, self._near_m, self._far_m, self._full_turn, chosen.rows, beams, len(chosen),
            self.rules.lines.gap_m, self._spacing, math.cos(math.radians(self.rules.bend_deg)), self.rules.corner_m,
            self.rules.look_beams, out,
        )  # fmt: skip
        rows = out[:count]
        if self._falling:
            rows[:, kernels.BEAM] = ranges.size - 1 - rows[:, kernels.BEAM]
        return Anchors(rows)
