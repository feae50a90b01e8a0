"""A scan's place among others when the guess may be metres off: correlative search, then nothing is refined here."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.kernels.localise_search import draw_points, pool, search
from mapping.localise.views import KeptViews, View

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

RESOLUTION_M = 0.10
BLOCK = 4
WIDE_BLOCK = 8
WIDE_M = 5.0  # wider windows are cut into wider blocks, and these into
WIDEST_BLOCK = 32
FARTHEST_M = 18.0  # points beyond are left out: at one degree a step they are spread over cells
POINTS = 120
TURN_STEP_RAD = math.radians(1.0)
APART_M = 1.0
APART_RAD = math.radians(12.0)
RIVAL_SHARE = 0.85  # rivals that score less are not looked for


@dataclass(frozen=True, slots=True)
class Raster:
    """Likelihood of a surface around some key scans: (H, W) uint8 cells from (x0_m, y0_m) on, and their pooled copies,
    the maxima over blocks of `block` and of `top_block` cells."""

    fine: U8
    pooled: U8
    block: int
    top: U8
    top_block: int
    x0_m: float
    y0_m: float


@dataclass(frozen=True, slots=True)
class Found:
    """The best pose of a search. score: mean likelihood of its points, 0 to 1.  rival: of the best pose that lies
    1 m or 12 degrees apart, as a share of score; 0 if below RIVAL_SHARE, or what else was asked for."""

    pose: Pose2
    score: float
    rival: float


def raster_of(store: KeptViews, rows: I64, poses: F64, *, window_m: float = 0.0) -> Raster:
    """Draw views `rows` (R,) at poses (R, 3), to be searched within window_m."""
    is_wide = window_m > WIDE_M
    block = WIDE_BLOCK if is_wide else BLOCK
    margin = FARTHEST_M + (WIDEST_BLOCK * RESOLUTION_M if is_wide else 0.0)
    x0, y0 = (float(v) - margin for v in poses[:, :2].min(axis=0))
    x1, y1 = (float(v) + FARTHEST_M for v in poses[:, :2].max(axis=0))
    fine = np.zeros((math.ceil((y1 - y0) / RESOLUTION_M) + 1, math.ceil((x1 - x0) / RESOLUTION_M) + 1), dtype=np.uint8)
    on = store.opened(rows)
    draw_points(on.x, on.y, on.quality, on.rows, poses, x0, y0, RESOLUTION_M, fine)
    pooled = pool(fine, block, 1)
    if not is_wide:
        return Raster(fine, pooled, block, pooled, block, x0, y0)
    return Raster(fine, pooled, block, pool(pooled, WIDEST_BLOCK // block, block), WIDEST_BLOCK, x0, y0)


def find_view(
    view: View, raster: Raster, guess: Pose2, *, window_m: float, turn_rad: float, doubtful_share: float | None = None,
    least: float = 0.0,
) -> Found | None:  # fmt: skip
    """The place within window_m and turn_rad of a guess where a view fits best; None if it has too few points, or
    scores less than `least` everywhere.

    doubtful_share: it is enough to know whether any rival reaches this share; much is saved where many do.
    """
    near = (view.quality >= 0.0) & (np.hypot(view.x, view.y) <= FARTHEST_M)
    if int(near.sum()) < 20:
        return None
    chosen = np.flatnonzero(near)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(POINTS, len(chosen))).astype(np.int64)]
    px, py = view.x[chosen].astype(np.float64), view.y[chosen].astype(np.float64)
    result = np.zeros(5)
    search(
        raster.fine, raster.pooled, raster.block, raster.top, raster.top_block, raster.x0_m, raster.y0_m, RESOLUTION_M,
        px, py, np.array([guess.x_m, guess.y_m, guess.yaw_rad]), window_m, turn_rad, TURN_STEP_RAD, APART_M, APART_RAD,
        RIVAL_SHARE if doubtful_share is None else doubtful_share, doubtful_share is not None, least,
        result,
    )  # fmt: skip
    x, y, yaw, score, rival = (float(v) for v in result)
    if score < least:
        return None
    return Found(Pose2(x, y, wrap_angle(yaw)), score, rival / score if score > 0.0 else 0.0)
