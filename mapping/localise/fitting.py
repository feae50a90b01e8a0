"""Which key scans are around a place, and whether a view lies there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.closures import REFINING
from mapping.localise.scan_match import Match, agreement, match_view, weakest_information
from mapping.localise.views import KeptViews, View

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

HELD_PER_M2 = 2500.0  # the worst direction of a match is sure to 2 cm
PLACED_EXPLAINED = 0.6
PLACED_OVERLAP = 0.85  # doors and chairs were moved since


def nearest_keys(poses: F64, near: Pose2, within_m: float, most: int, there: Bools) -> I64:
    """Key scans (K, 3) around a place, the nearest first, those seen from the same side before others; at least one.

    there: (K,) those whose views are still kept.
    """
    distance = np.where(there, np.hypot(poses[:, 0] - near.x_m, poses[:, 1] - near.y_m), np.inf)
    order = np.argsort(distance + 1.0 - np.cos(poses[:, 2] - near.yaw_rad), kind="stable")
    close = order[distance[order] < within_m][:most]
    return close if len(close) else order[:1]


def fitting_match(view: View, store: KeptViews, rows: I64, poses: F64, guess: Pose2) -> Match | None:
    """The view laid on key scans from a rough guess; None unless it fits well enough to say where it was taken."""
    match = match_view(view, store, rows, poses, guess, reach=REFINING)
    if match is None or weakest_information(match.information()) < HELD_PER_M2:
        return None
    agrees = agreement(view, store, rows, poses, match.pose)
    fits = agrees.explained >= PLACED_EXPLAINED and agrees.overlap >= PLACED_OVERLAP
    off = guess.inverse() @ match.pose
    return match if fits and math.hypot(off.x_m, off.y_m) < 0.8 and abs(off.yaw_rad) < math.radians(10.0) else None
