"""What scans on planes tell of odometry's turns, and what that is good for where scans lie on none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.odometry_trust import Heading
from mapping.localise.slam import Slam
from mapping.scan import Scan

F64 = NDArray[np.float64]
STEP_M = 0.2
DEG = math.radians(1.0)


def driven(
    heading: Heading, steps: int, *, wander: float, rad_per_m: float = 0.0, share: float = 0.0, rough: bool = False,
    match_rad: float = 0.1 * DEG, pulls_rad: float = 0.0, seed: int = 1,
) -> None:  # fmt: skip
    """Steps of a drive with bends. wander: of odometry, rad per square root of a metre.  match_rad: what matches err,
    each by itself; pulls_rad: what all of them turn too far."""
    rng = np.random.default_rng(seed)
    left = 0.0
    for k in range(steps):
        turn = math.sin(0.05 * k) * 2.0 * DEG
        true = turn * (1.0 + share) + rad_per_m * STEP_M + rng.normal(0.0, wander * math.sqrt(STEP_M))
        off, now = true - turn + pulls_rad, float(rng.normal(0.0, match_rad))
        heading.step(STEP_M, turn, off + now - left, 0.0, is_rough=rough)
        left = now


def test_nothing_is_said_before_enough_was_seen() -> None:
    heading = Heading(0.5 * DEG, 0.05)
    driven(heading, 15 * (Heading.ENOUGH - 1), wander=0.2 * DEG)
    assert math.isinf(heading.sigma_rad(STEP_M, 0.0))
    driven(heading, 15 * 4, wander=0.2 * DEG)
    assert heading.sigma_rad(STEP_M, 0.0) < 0.5 * DEG


@pytest.mark.parametrize("wander_deg", [0.2, 0.6])
def test_wheels_are_told_from_their_bias(wander_deg: float) -> None:
    heading = Heading(0.5 * DEG, 0.05)
    driven(heading, 1500, wander=wander_deg * DEG, rad_per_m=-0.15 * DEG, share=0.03)
    sigma = heading.sigma_rad(Heading.SPAN_M, 0.0) / math.sqrt(Heading.SPAN_M)
    assert 0.7 * wander_deg * DEG < sigma < 2.0 * wander_deg * DEG
    assert heading.bias_rad(1.0, 0.0) == pytest.approx(-0.15 * DEG, abs=0.1 * DEG)
    if wander_deg < 0.5:
        assert heading.bias_rad(0.0, 1.0) == pytest.approx(0.03, abs=0.015)


def test_a_bias_that_may_be_chance_is_none() -> None:
    heading = Heading(0.5 * DEG, 0.05)
    driven(heading, 15 * Heading.ENOUGH, wander=0.6 * DEG, seed=3)
    assert heading.bias_rad(1.0, 0.0) == 0.0


def test_scans_on_no_planes_teach_nothing_of_wheels() -> None:
    heading = Heading(0.5 * DEG, 0.05)
    driven(heading, 1000, wander=0.2 * DEG, rough=True, pulls_rad=0.3 * DEG)
    assert math.isinf(heading.sigma_rad(STEP_M, 0.0))
    assert not heading.is_better


@pytest.mark.parametrize(
    ("wander_deg", "match_deg", "pulls_deg", "is_better"),
    [
        (0.2, 0.05, 0.0, False),  # no planes, but they fit
        (0.2, 0.05, 0.25, True),  # hedge after hedge turns the map
        (0.2, 0.30, 0.0, True),
        (0.8, 0.05, 0.25, False),  # wheels are no better than that
    ],
)
def test_the_better_of_two_is_known(wander_deg: float, match_deg: float, pulls_deg: float, is_better: bool) -> None:
    heading = Heading(0.5 * DEG, 0.05)
    driven(heading, 600, wander=wander_deg * DEG)
    assert not heading.is_better
    driven(heading, 100, wander=wander_deg * DEG, rough=True, match_rad=match_deg * DEG, pulls_rad=pulls_deg * DEG)
    assert heading.is_better is is_better


# --- the whole front end

BEARING = np.radians(np.arange(-90.0, 90.0))
STREET_M = 60.0
HEDGE_M = 24.0
PULL_RAD_PER_M = 1.0 * DEG


def sweep(at: Pose2, k: int, *, is_street: bool) -> Scan:
    """Houses beside a street, with doors and corners, or hedges: leaves at any depth of them."""
    rng = np.random.default_rng(k)
    c, s = np.cos(BEARING + at.yaw_rad), np.sin(BEARING + at.yaw_rad)
    with np.errstate(divide="ignore", invalid="ignore"):
        aside = np.where(s > 0.0, (3.0 - at.y_m) / s, (-3.0 - at.y_m) / s)
        along = at.x_m + aside * c
        if is_street:
            deep = np.where(np.floor(along / 2.5).astype(np.int64) % 3 == 0, 0.8, 0.0)
            reach = aside * (1.0 + deep / 3.0) + rng.normal(0.0, 0.01, len(BEARING))
        else:
            leaves = 0.5 * np.sin(2.1 * along) + 0.4 * np.sin(5.3 * along + 1.0) + rng.uniform(0.0, 1.0, len(BEARING))
            reach = aside * (1.0 + leaves / 3.0)
    reach = np.where(np.isfinite(reach) & (reach < 12.0), reach, np.inf)
    return Scan(k * 500_000_000, 0.0, BEARING, reach, 0.05, 30.0)


def turned_beyond_the_street(slam: Slam) -> float:
    """Straight along a street and on between hedges that seem to turn; how far the robot thinks it turned there."""
    steps = round((STREET_M + HEDGE_M) / STEP_M)
    before = 0.0
    for k in range(steps):
        x = k * STEP_M
        is_street = x < STREET_M
        pulled = 0.0 if is_street else PULL_RAD_PER_M * (x - STREET_M)
        update = slam.add_scan(sweep(Pose2(x, 0.0, pulled), k, is_street=is_street), Pose2(), Pose2(x, 0.0, 0.0))
        if is_street:
            before = update.map_from_base.yaw_rad
    return abs(update.map_from_base.yaw_rad - before)


def test_a_hedge_that_moves_along_turns_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """24 degrees of pull on 24 m: matches alone follow half of it, odometry that was right in the street does not."""
    slam = Slam()
    turned = turned_beyond_the_street(slam)
    assert slam.events["turned_by_odometry"] > 50
    monkeypatch.setattr(Heading, "is_better", property(lambda _: False))
    by_matches = turned_beyond_the_street(Slam())
    assert turned < 4.0 * DEG < 8.0 * DEG < by_matches
