"""The front end of SLAM alone: what a step of the path promises."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.slam import Slam
from mapping.scan import Scan

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-90.0, 90.0))


def room(at: Pose2, k: int) -> Scan:
    """A room 8 m by 6 m, from a place and heading in it."""
    c, s = np.cos(BEARING + at.yaw_rad), np.sin(BEARING + at.yaw_rad)
    with np.errstate(divide="ignore"):
        wide = np.where(c > 0.0, (4.0 - at.x_m) / c, (-4.0 - at.x_m) / c)
        deep = np.where(s > 0.0, (3.0 - at.y_m) / s, (-3.0 - at.y_m) / s)
    reach = np.minimum(wide, deep) + np.random.default_rng(k).normal(0.0, 0.01, len(BEARING))
    return Scan(k * 200_000_000, 0.0, BEARING, reach, 0.05, 30.0)


def test_a_step_on_which_nothing_was_matched_promises_little() -> None:
    """A slip or a push while dust fills the view must be found again by a closure: the way must allow for it."""
    slam = Slam()
    for k in range(10):
        at = Pose2(-2.0 + 0.12 * k, 0.0, 0.0)
        slam.add_scan(room(at, k), Pose2(), at)
    seen = slam.keys
    rng = np.random.default_rng(1)
    for k in range(10, 40):
        at = Pose2(-2.0 + 0.12 * k, 0.0, 0.0)
        dust = Scan(k * 200_000_000, 0.0, BEARING, rng.uniform(0.3, 6.0, len(BEARING)), 0.05, 30.0)
        slam.add_scan(dust, Pose2(), at)
    assert slam.events["not_matched"] > 10
    steps = np.linalg.inv(slam.snapshot().path.information)
    sigma = np.sqrt(np.einsum("nii->ni", steps))
    assert sigma[: seen - 1].max() < 0.1
    unmatched = sigma[sigma[:, 0] > 0.1]
    assert len(unmatched) > 0
    assert unmatched[:, 2].min() > math.radians(5.0)


def test_what_the_way_explains_is_asked_of_odometry_only() -> None:
    """In fr079 without its odometry true closures were refused: turns that went astray were not known to."""
    for has_odometry in (True, False):
        slam = Slam()
        for k in range(12):
            at = Pose2(-2.0 + 0.12 * k, 0.0, 0.0)
            slam.add_scan(room(at, k), Pose2(), at if has_odometry else None)
        assert math.isinf(slam._closing().surprise) is not has_odometry


def test_odometry_that_begins_anew_moves_nobody() -> None:
    """A base that was switched off and on in the midst of a log counts from (0, 0, 0) again, or says what it likes."""
    for again in (Pose2(0.0, 0.0, 0.0), Pose2(40.0, -7.0, 2.5), Pose2(-1.5, 0.3, -1.8)):
        slam = Slam(start=Pose2(-2.0, 0.0, 0.3))
        start = Pose2(5.0, 5.0, 1.0)
        for k in range(30):
            at = Pose2(-2.0 + 0.1 * k, 0.0, 0.3 + 0.02 * k)
            since = Pose2(-2.0, 0.0, 0.3).inverse() @ at
            odom = start @ since if k < 15 else again @ (Pose2(-0.5, 0.0, 0.6).inverse() @ at)
            found = slam.add_scan(room(at, k), Pose2(), odom).map_from_base
            assert math.hypot(found.x_m - at.x_m, found.y_m - at.y_m) < 0.03
            assert abs(found.yaw_rad - at.yaw_rad) < math.radians(0.7)
        assert slam.events["odometry_leapt"] == 1
