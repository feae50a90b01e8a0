"""How a laser moved between pairs of its own sweeps, told by the sweeps alone: what a calibration is measured on.

Where SLAM predicts by odometry, its poses carry some of what is wrong with the wheels. Here a prediction only starts
the search: no prior pulls at the result, and a direction that the walls do not hold has a large variance instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, inverse_covariance
from mapping.localise.scan_match import Match, match_view
from mapping.localise.views import BearingTable, View, ViewStore, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

WAY_M = 0.5
FARTHEST_WAY_M = 2.0
WAY_SHARE = 0.15  # of the typical distance of what is seen: so far two sweeps still see the same
TURN_RAD = math.radians(30.0)
FARTHEST_M = 30.0
LEAST_POINTS = 30
LEAST_SCORE = 0.15  # of all points, each worth what it is not off
FLOOR_M = 0.001  # no match is surer than this: surfaces are rough, beams are quantised
FLOOR_RAD = math.radians(0.02)
UNHELD_M2 = 1.0  # variance that stands for "not held at all"
FIRST_FRAME = np.zeros((1, 3))
FIRST_ROW = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class RelativeMotions:
    """K motions of the laser: where it was at end_s seen from where it was at start_s.

    start_s, end_s: (K,) by the laser's clock.  motion: (K, 3) x, y, yaw in the laser's frame at the start.
    covariance: (K, 3, 3) of it, up to a factor common to all.  rejected: pairs of sweeps that did not fit.
    """

    start_s: F64
    end_s: F64
    motion: F64
    covariance: F64
    rejected: int = 0

    def __post_init__(self) -> None:
        k = len(self.start_s)
        if self.end_s.shape != (k,) or self.motion.shape != (k, 3) or self.covariance.shape != (k, 3, 3):
            raise ValueError("times (K,), motions (K, 3) and covariances (K, 3, 3) belong together")

    def __len__(self) -> int:
        return len(self.start_s)


def way_between(scans: Sequence[Scan]) -> float:
    """How far apart sweeps are best compared, metres: far, as a match errs by the same however long its way is."""
    seen = [scan.range_m[np.isfinite(scan.range_m) & (scan.range_m < FARTHEST_M)] for scan in scans]
    readings = np.concatenate(seen) if seen else np.zeros(0)
    typical = float(np.median(readings)) if len(readings) else 0.0
    return min(FARTHEST_WAY_M, max(WAY_M, WAY_SHARE * typical))


def spread_out(poses: F64, *, way_m: float = WAY_M, turn_rad: float = TURN_RAD) -> I64:
    """Rows of poses (N, 3), the first one and then each that lies way_m or turn_rad from the row chosen before."""
    chosen = [0] if len(poses) else []
    for k in range(1, len(poses)):
        dx, dy, turn = poses[k] - poses[chosen[-1]]
        turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
        if math.hypot(dx, dy) >= way_m or abs(turn) >= turn_rad:
            chosen.append(k)
    return np.array(chosen, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class LaserMotion:
    """One of them: as a row of RelativeMotions."""

    start_s: float
    end_s: float
    motion: F64
    covariance: F64


def joined_motions(found: Sequence[LaserMotion], rejected: int = 0) -> RelativeMotions:
    """As the calibration takes them."""
    span = np.array([(each.start_s, each.end_s) for each in found]).reshape(-1, 2)
    motion = np.array([each.motion for each in found]).reshape(-1, 3)
    covariance = np.array([each.covariance for each in found]).reshape(-1, 3, 3)
    return RelativeMotions(span[:, 0], span[:, 1], motion, covariance, rejected)


class MotionMeter:
    """Takes one sweep after another; each is matched with the one before it.

    Each pair is matched both ways and the two answers are joined, so what one way gets wrong at the edges of what
    both saw, the other gets wrong the other way round. Sweeps are taken as swept at once (de-skewed).  rejected: how
    many pairs did not fit.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self._table: BearingTable | None = None
        self._before: tuple[int, View, Pose2] | None = None

    def take(self, scan: Scan, guess: Pose2) -> LaserMotion | None:
        """The motion from the sweep before to this one; None if there is none before, or they do not fit.

        guess: about where the laser is, in the frame of the guess before. ValueError if the first sweep has fewer than
        three beams.
        """
        self._table = table_for(scan.bearing_rad) if self._table is None else self._table
        before, here = self._before, (scan.stamp_ns, view_of(scan, self._table, farthest_m=FARTHEST_M), guess)
        self._before = here
        if before is None:
            return None
        found = _between(before[1], here[1], before[2].inverse() @ guess)
        if found is None:
            self.rejected += 1
            return None
        return LaserMotion(before[0] * 1e-9, scan.stamp_ns * 1e-9, _row(found[0]), found[1])

    def begin_anew(self) -> None:
        """The next sweep has none before it: the frame of the guesses changed."""
        self._before = None


def relative_motions(scans: Sequence[Scan], guesses: F64) -> RelativeMotions:
    """Motions between sweeps that follow each other; guesses: (N, 3) about where the laser was in any one frame.

    Choose the sweeps by `spread_out`. Pairs that do not fit are left out and counted.
    """
    if len(scans) != len(guesses):
        raise ValueError(f"{len(scans)} scans and {len(guesses)} guesses")
    meter = MotionMeter()
    taken = [meter.take(scan, Pose2(*row.tolist())) for scan, row in zip(scans, guesses)]
    return joined_motions([each for each in taken if each is not None], meter.rejected)


def _between(first: View, second: View, guess: Pose2) -> tuple[Pose2, F64] | None:
    """Second seen from first, and the covariance; None if they do not fit."""
    onto_first = _match(second, first, guess)
    if onto_first is None:
        return None
    onto_second = _match(first, second, onto_first.pose.inverse())
    if onto_second is None:
        return None
    forth, cov_forth = onto_first.pose, _covariance(onto_first)
    back, cov_back = onto_second.pose.inverse(), inverse_covariance(onto_second.pose, _covariance(onto_second))
    off = forth.inverse() @ back
    if math.hypot(off.x_m, off.y_m) > 0.1 or abs(off.yaw_rad) > math.radians(2.0):
        return None
    # The same noise is in both: the covariance of the mean is that of one, not half of it.
    gain = cov_forth @ np.linalg.inv(cov_forth + cov_back)
    difference = _row(back) - _row(forth)
    difference[2] = off.yaw_rad
    joined = _row(forth) + gain @ difference
    return Pose2(*joined.tolist()), 0.5 * (cov_forth + cov_back) + np.diag([FLOOR_M**2, FLOOR_M**2, FLOOR_RAD**2])


def _match(view: View, on: View, guess: Pose2) -> Match | None:
    if view.points < LEAST_POINTS or on.points < LEAST_POINTS:
        return None
    store = ViewStore()
    store.add(on)
    match = match_view(view, store.kept(), FIRST_ROW, FIRST_FRAME, guess, same_partners=0.0)
    return match if match is not None and match.score >= LEAST_SCORE else None


def _covariance(match: Match) -> F64:
    return np.asarray(np.linalg.inv(match.information() + np.diag([1.0, 1.0, 1.0]) / UNHELD_M2))


def _row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])
