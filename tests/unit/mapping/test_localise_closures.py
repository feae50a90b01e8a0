"""Votes of closures on probation: how many, from how much of the way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.closure_records import Closure, ClosureSettings, Snapshot, edges_of
from mapping.localise.closures import Work
from mapping.localise.pose_graph import Edges
from mapping.localise.scan_match import Agreement
from mapping.localise.views import View, ViewStore, table_for, view_of
from mapping.scan import Scan

STEP_M = 0.8
AGAIN = 100  # key scans after which the way begins anew
ROUGH = ClosureSettings().rough_worth
FAINT = ClosureSettings().faint_worth


def work(votes: int, worth: float, step_m: float = STEP_M) -> tuple[Work, list[Closure]]:
    """A straight way driven twice, in truth 5 m beside where it is thought to be the second time."""
    keys = np.arange(2.0 * AGAIN)
    poses: NDArray[np.float64] = np.zeros((2 * AGAIN, 3))
    poses[:, 0] = keys % AGAIN * step_m
    path = Edges.none()
    shot = Snapshot(ViewStore().kept(), poses, keys * step_m, path, (), (), (), 0, 0)
    pending = [Closure(k, AGAIN + k, Pose2(0.0, 5.0), np.eye(3), worth, True) for k in range(votes)]
    return Work(shot, ClosureSettings()), pending


@pytest.mark.parametrize(
    ("votes", "worth", "step_m", "are_enough"),
    [
        (2, 1.0, 0.8, False),
        (3, 1.0, 0.8, True),
        (3, 1.0, 0.5, False),  # 1 m of the way
        (5, 0.5, 0.8, False),
        (6, 0.5, 0.8, True),
        (8, ROUGH, 0.8, False),
        (9, ROUGH, 0.8, True),
        (12, ROUGH, 0.5, False),  # 5.5 m of the way
        (17, FAINT, 0.8, False),
        (18, FAINT, 0.8, True),
        (22, FAINT, 0.5, False),  # 10.5 m of the way
    ],
)
def test_so_many_votes_from_so_much_of_the_way_are_needed(
    votes: int, worth: float, step_m: float, are_enough: bool
) -> None:
    judge, pending = work(votes, worth, step_m)
    group, waiting = judge._agreeing(pending)
    assert (len(group), len(waiting)) == ((votes, 0) if are_enough else (0, votes))


@pytest.mark.parametrize(("surprise", "are_enough"), [(0.5, True), (5.0, True), (9.0, False), (11.5, False)])
def test_what_nobody_expected_needs_more_votes(surprise: float, are_enough: bool) -> None:
    judge, pending = work(5, 1.0)
    pending = [replace(c, surprise=surprise) for c in pending]
    assert bool(judge._agreeing(pending)[0]) is are_enough
    more = [replace(c, surprise=surprise) for c in work(24, 1.0)[1]]
    assert judge._agreeing(more)[0]


def test_what_the_way_cannot_explain_surprises() -> None:
    """After 80 m round a square of sure steps a place 5 m beside cannot be that where the way began."""
    side = [Pose2(0.5, 0.0, 0.0)] * 39 + [Pose2(0.5, 0.0, math.pi / 2.0)]
    poses = [Pose2()]
    for step in 4 * side:
        poses.append(poses[-1] @ step)
    rows = np.array([(p.x_m, p.y_m, p.yaw_rad) for p in poses])
    steps = np.array([(p.x_m, p.y_m, p.yaw_rad) for p in 4 * side])
    n = len(steps)
    sure = np.repeat(np.diag([0.01**-2.0, 0.01**-2.0, math.radians(0.2) ** -2.0])[None], n, axis=0)
    path = Edges(np.arange(n), np.arange(1, n + 1), steps, sure, np.zeros(n, dtype=np.bool_))
    shot = Snapshot(ViewStore().kept(), rows, 0.5 * np.arange(n + 1.0), path, (), (), (), 0, 0)
    judge = Work(shot, ClosureSettings())
    seen = np.diag([0.02**-2.0, 0.02**-2.0, math.radians(0.3) ** -2.0])
    assert judge._surprise(Closure(0, n, Pose2(0.5, -0.6, 0.02), seen, 1.0, True)) < ClosureSettings().expected
    assert judge._surprise(Closure(0, n, Pose2(0.0, 5.0, 0.0), seen, 1.0, True)) > ClosureSettings().surprise


def test_who_asks_for_another_correction_is_no_vote() -> None:
    judge, pending = work(9, ROUGH)
    pending[4] = Closure(4, AGAIN + 4, Pose2(1.5, 5.0), np.eye(3), ROUGH, True)
    assert judge._agreeing(pending)[0] == []
    assert len(edges_of(pending)) == 9


@pytest.mark.parametrize(
    ("agrees", "mean_cost", "weakest_per_m2", "worth"),
    [
        (Agreement(0.80, 0.02, 0.18, 100), 0.20, 1500.0, 1.0),
        (Agreement(0.80, 0.02, 0.18, 100), 0.40, 1500.0, 0.5),
        (Agreement(0.80, 0.02, 0.18, 100), 0.50, 1500.0, ROUGH),
        (Agreement(0.80, 0.02, 0.18, 100), 0.20, 300.0, ROUGH),
        (Agreement(0.80, 0.02, 0.18, 100), 0.20, 100.0, 0.0),  # a bare corridor
        (Agreement(0.80, 0.02, 0.18, 100), 0.70, 1500.0, 0.0),
        (Agreement(0.80, 0.06, 0.14, 100), 0.50, 1500.0, 0.0),  # it sees through what was there
        (Agreement(0.60, 0.00, 0.40, 100), 0.50, 1500.0, FAINT),
        (Agreement(0.60, 0.00, 0.40, 100), 0.50, 100.0, 0.0),
        (Agreement(0.60, 0.06, 0.34, 100), 0.50, 1500.0, 0.0),
        (Agreement(0.60, 0.00, 0.40, 100), 0.25, 300.0, 0.0),  # plain: it repeats
        (Agreement(0.45, 0.00, 0.55, 100), 0.50, 1500.0, 0.0),
    ],
)
def test_what_a_single_closure_is_worth(
    agrees: Agreement, mean_cost: float, weakest_per_m2: float, worth: float
) -> None:
    assert work(0, 1.0)[0]._worth(agrees, mean_cost, weakest_per_m2) == worth


def test_faint_votes_beside_firm_ones_need_no_more_of_the_way() -> None:
    judge, sure = work(3, 1.0)
    assert len(judge._agreeing(sure + [replace(c, worth=FAINT) for c in work(6, 1.0)[1][3:]])[0]) == 6
    few = sure[:2] + [replace(c, worth=FAINT) for c in work(8, 1.0)[1][2:]]
    assert judge._agreeing(few)[0] == []  # two firm ones and six faint ones over 5.6 m


def test_a_street_driven_the_other_way_is_laid_on_the_keys_that_saw_its_houses() -> None:
    """Key scans look along the way and see what lies ahead: of a view the other way those farther on saw most."""
    bearing = np.radians(np.arange(-90.0, 90.0))
    table, store = table_for(bearing), ViewStore()

    def seen_from(x_m: float, yaw_rad: float) -> View:
        c, s = np.cos(bearing + yaw_rad), np.sin(bearing + yaw_rad)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(s > 0.0, 3.0 / s, -3.0 / s)
            along = x_m + reach * c
            end = np.where(c > 0.0, (40.0 - x_m) / c, (-10.0 - x_m) / c)  # the houses end, a wall stands across
        reach = np.minimum(np.where((along > -10.0) & (along < 40.0), reach, np.inf), end)
        return view_of(Scan(0, 0.0, bearing, np.where(reach < 9.0, reach, np.inf), 0.05, 30.0), table, farthest_m=30.0)

    keys = np.arange(40)
    for k in keys:
        store.add(seen_from(0.5 * k, 0.0))
    poses = np.stack((0.5 * keys, 0.0 * keys, 0.0 * keys), axis=-1)
    shot = Snapshot(store.kept(), np.vstack((poses, [[20.0, 0.0, math.pi]])), np.append(0.5 * keys, 100.0),
                    Edges.none(), (), (), (), 0, 0)  # fmt: skip
    judge, pose = Work(shot, ClosureSettings()), Pose2(14.0, 0.0, math.pi)
    chosen = judge._seeing(seen_from(14.0, math.pi), 40, keys, pose)
    assert 0.5 * chosen < 11.0  # looking that way from behind it: its own place saw nothing that it sees


def test_rough_ones_stay_if_the_others_bear_them_out() -> None:
    judge, rough = work(4, ROUGH)
    sure = work(2, 1.0)[1]
    assert judge._staying([*sure, *rough], np.array([0.3, 0.9, 0.5, 0.9, 0.9, 0.9])).tolist() == [
        True, True, False, True, True, True,
    ]  # fmt: skip
    assert judge._staying(rough, np.array([0.3, 0.4, 0.5, 0.9])).all()
