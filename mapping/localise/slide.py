"""Along a corridor: a match that walls do not hold along themselves, put where the ends of walls meet.

Doors, niches and frames have hardly a surface across a corridor, least of all one that is seen from both ends of it.
But where a piece of wall is missing, its points lie in the open: the share of points that others explain has a peak
where all pieces of wall lie on each other. It says where along itself a corridor is, to some centimetres.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.scan_match import POINT_SIGMA_M, Match, Reach, agreement, match_view
from mapping.localise.views import KeptViews, View

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FARTHEST_M = 0.6
COARSE_M, FINE_M = 0.1, 0.02
NEAR_M = 0.04  # of a point from a wall: less than a door is set back
BESIDE_M = 0.15  # so far from the peak the share must have fallen
SIGMA_M = 0.03  # what a peak is off
SETTLING = Reach((0.15, 0.15, 0.15, 0.15), (0.06, 0.05, 0.04, POINT_SIGMA_M))


def slid(view: View, store: KeptViews, rows: I64, poses: F64, match: Match, *, prominence: float) -> Match | None:
    """The match of a view with the store's views `rows` (R,) at poses (R, 3), moved along the direction that is held
    worst to where most of its points are explained, and held there to SIGMA_M.

    prominence: by so much the share must fall on either side.  None if it does not within FARTHEST_M, or nothing fits.
    """
    along = worst_direction(match.information())

    def at(off_m: float) -> Pose2:
        return Pose2(match.pose.x_m + off_m * along[0], match.pose.y_m + off_m * along[1], match.pose.yaw_rad)

    def shares(offs_m: F64) -> F64:
        return np.array(
            [agreement(view, store, rows, poses, at(off), near_m=NEAR_M).explained for off in offs_m.tolist()]
        )

    coarse = np.linspace(-FARTHEST_M, FARTHEST_M, 2 * round(FARTHEST_M / COARSE_M) + 1)
    around = shares(coarse)
    middle = float(coarse[int(np.argmax(around))])
    fine = np.linspace(middle - COARSE_M, middle + COARSE_M, 2 * round(COARSE_M / FINE_M) + 1)
    near = shares(fine)
    top = float(near.max())
    peak_m = float(np.average(fine, weights=np.maximum(near - top + 0.5 * prominence, 0.0)))
    is_inside = abs(peak_m) <= FARTHEST_M - BESIDE_M
    if not is_inside or top - float(around[np.abs(coarse - peak_m) >= BESIDE_M].max()) < prominence:
        return None
    pull = np.zeros((3, 3))
    pull[:2, :2] = np.outer(along, along) / SIGMA_M**2
    settled = match_view(view, store, rows, poses, at(peak_m), prior=pull, reach=SETTLING)
    if settled is None:
        return None
    return replace(settled, hessian=settled.hessian + pull * (max(1, settled.references) * POINT_SIGMA_M**2))


def worst_direction(information: F64) -> F64:
    """(2,) of length 1: where to a match (3, 3) is held worst, rotation marginalised."""
    held = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / max(float(information[2, 2]), 1e-9)
    angle = 0.5 * math.atan2(2.0 * float(held[0, 1]), float(held[0, 0] - held[1, 1])) + 0.5 * math.pi
    return np.array([math.cos(angle), math.sin(angle)])
