"""Scan to scans: the pose that lays one view on several others at once, and how sure it is.

Every point is held against the tangent line of the nearest point of each reference view, which is found by its
bearing. Weights fall off as Geman and McClure's, from a coarse scale to a fine one (graduated non-convexity), so that
people, glass edges and furniture that moved count little. All references pull jointly: noise of a single view
averages out, and there is no map to be blurred by what was put into it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.kernels.localise_match import (
    LEVELS,
    RESULT_COST,
    RESULT_COUNT,
    RESULT_HESSIAN,
    RESULT_LENGTH,
    RESULT_POSE,
    RESULT_STEPS,
    align,
    compare,
)
from mapping.localise.views import KeptViews, View

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

POINT_SIGMA_M = 0.04  # scale of the finest level: what a point on the same surface is off
MOST_STEPS = 16
SAME_PARTNERS = 0.01
NEAR_M = 0.15


@dataclass(frozen=True, slots=True)
class Reach:
    """From where a match may start: (LEVELS,) largest distance of partners and robust scale, from coarse to fine."""

    reach_m: tuple[float, ...]
    scale_m: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.reach_m) == len(self.scale_m) == LEVELS:
            raise ValueError(f"a schedule has {LEVELS} levels")


TRACKING = Reach((0.50, 0.33, 0.22, 0.15), (0.15, 0.10, 0.06, POINT_SIGMA_M))
"""From a prediction that is 0.3 m and 10 degrees off."""

NO_PRIOR: F64 = np.zeros((3, 3))


@dataclass(frozen=True, slots=True)
class Match:
    """A source view laid on references.

    pose: source in the references' common frame.  hessian: (3, 3) over (x, y, yaw) there, in squared metres of
    residual (divide by POINT_SIGMA_M ** 2 and the number of references that overlap for an information matrix).
    mean_cost: 0 all partners fit, 1 none.  partners: pairs of points used.  references: views that were offered.
    """

    pose: Pose2
    hessian: F64
    mean_cost: float
    partners: int
    references: int
    points: int
    steps: int

    @property
    def share(self) -> float:
        """Partners for each point and reference, 0 to 1."""
        return self.partners / max(1, self.points * self.references)

    @property
    def score(self) -> float:
        """How well all of it fits, 0 to 1: share of partners, each worth what it is not off."""
        return self.share * (1.0 - self.mean_cost)

    def information(self) -> F64:
        """(3, 3) inverse covariance of the pose, as if one reference had been matched.

        The same points meet every reference, so references are no independent measurements: they count once.
        """
        return self.hessian / (max(1, self.references) * POINT_SIGMA_M**2)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Shares of a view's points: on a surface of the references, in space they saw through, not seen by any."""

    explained: float
    refuted: float
    unseen: float
    points: int

    @property
    def overlap(self) -> float:
        """Of the points that the references could judge, the share that fits."""
        return self.explained / max(self.explained + self.refuted, 1e-9)


def match_view(
    view: View,
    store: KeptViews,
    rows: I64,
    poses: F64,
    guess: Pose2,
    *,
    prior: F64 = NO_PRIOR,
    reach: Reach = TRACKING,
    same_partners: float = SAME_PARTNERS,
) -> Match | None:
    """Lay a view on the store's views `rows` (R,), whose poses are (R, 3); None where nothing holds it.

    guess: the pose to start from.  prior: (3, 3) information of the guess [1/m^2, 1/rad^2], in the frame of poses.
    same_partners: after a step that is smaller, metres and a third of radians, partners are kept: half the work, and
    the answer is drawn some hundredths of a degree to the guess; 0: never.
    """
    result = np.zeros(RESULT_LENGTH)
    at = np.array([guess.x_m, guess.y_m, guess.yaw_rad])
    weight = prior * (POINT_SIGMA_M**2 * max(1, len(rows)))
    on = store.opened(rows)
    align(
        view.x, view.y, view.nx, view.ny, view.quality,
        on.x, on.y, on.nx, on.ny, on.quality, on.frames, on.rows, poses,
        at, weight, np.asarray(reach.reach_m), np.asarray(reach.scale_m), MOST_STEPS, same_partners, result,
    )  # fmt: skip
    if result[RESULT_STEPS] <= 0.0 or result[RESULT_COUNT] < 3.0 or not np.all(np.isfinite(result)):
        return None
    a, b, c, d, e, f = (float(v) for v in result[RESULT_HESSIAN : RESULT_HESSIAN + 6])
    x, y, yaw = (float(v) for v in result[RESULT_POSE : RESULT_POSE + 3])
    return Match(
        Pose2(x, y, wrap_angle(yaw)),
        np.array([[a, b, c], [b, d, e], [c, e, f]]),
        float(result[RESULT_COST] / result[RESULT_COUNT]),
        int(result[RESULT_COUNT]),
        len(rows),
        view.points,
        int(result[RESULT_STEPS]),
    )


def agreement(view: View, store: KeptViews, rows: I64, poses: F64, pose: Pose2, *, near_m: float = NEAR_M) -> Agreement:
    """How a view at a pose fits what the references saw: the free space they saw counts as much as their walls."""
    votes = np.zeros(3)
    at = np.array([pose.x_m, pose.y_m, pose.yaw_rad])
    on = store.opened(rows)
    compare(
        view.x, view.y, view.quality, on.x, on.y, on.quality, on.frames, on.rows, poses,
        at, near_m, votes,
    )  # fmt: skip
    n = max(1.0, float(votes.sum()))
    return Agreement(float(votes[0]) / n, float(votes[1]) / n, float(votes[2]) / n, int(votes.sum()))


def weakest_information(information: F64) -> float:
    """Smallest eigenvalue of the translational part [1/m^2], rotation marginalised: how well the worst direction of a
    match is held. A straight corridor holds none along itself."""
    turn = information[2, 2]
    if not turn > 0.0:
        return 0.0
    held = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / turn
    a, b, d = float(held[0, 0]), float(held[0, 1]), float(held[1, 1])
    return max(0.0, 0.5 * (a + d) - math.sqrt(0.25 * (a - d) ** 2 + b * b))
