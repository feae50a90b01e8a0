"""Ultrasonic cones into grids (S29): what they may touch, when they are believed, and that walls survive them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from mapping.frames import Pose2
from mapping.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, SonarRules
from mapping.grids.sonar_model import EchoFilter

D = 0.05
CONE = math.radians(30.0)
MAX_M = 3.0
SLOW = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
POSES = st.builds(Pose2, st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.floats(-3.2, 3.2))
READINGS = st.one_of(st.floats(0.0, MAX_M), st.sampled_from([math.inf, -math.inf, math.nan, -1.0, 3.01, 655.35, 0.0]))


def ping(grid: OccupancyGrid, pose: Pose2, range_m: float, name: str | None = None, **options: float) -> bool:
    return grid.insert_cone(
        pose,
        range_m,
        cone_rad=options.get("cone_rad", CONE),
        range_max_m=MAX_M,
        range_min_m=options.get("range_min_m", 0.0),
        transducer=name,
    )


@SLOW
@given(POSES, READINGS, st.floats(math.radians(15.0), math.radians(60.0)), st.integers(1, 40))
def test_evidence_stays_in_the_cone_and_free_space_before_the_echo(
    pose: Pose2, range_m: float, cone_rad: float, times: int
) -> None:
    grid = OccupancyGrid()
    for _ in range(times):
        ping(grid, pose, range_m, cone_rad=cone_rad, range_min_m=0.1)
    patch = grid.patch()
    for row, col in np.argwhere(patch.cells >= 0):
        x, y = (col + patch.col0 + 0.5) * D - pose.x_m, (row + patch.row0 + 0.5) * D - pose.y_m
        distance, bearing = math.hypot(x, y), math.atan2(y, x) - pose.yaw_rad
        assert abs((bearing + math.pi) % (2 * math.pi) - math.pi) <= cone_rad / 2 + 1e-9
        occupied = patch.cells[row, col] > 50
        if range_m == math.inf:
            assert not occupied
            assert distance <= MAX_M / 2 + 1e-9
            assert abs((bearing + math.pi) % (2 * math.pi) - math.pi) <= cone_rad / 4 + 1e-9
        elif range_m == -math.inf:
            assert occupied
            assert abs(distance - 0.1) <= D + 1e-9
        elif occupied:
            assert abs(distance - range_m) <= D + 1e-9
        else:
            # The whole cell lies before the arc.
            assert distance + D * math.sqrt(0.5) <= range_m - D + 1e-9
    if math.isnan(range_m) or range_m in (-1.0, 3.01, 655.35):
        assert patch.cells.size == 0


@SLOW
@given(POSES, st.floats(0.3, MAX_M), st.floats(math.radians(15.0), math.radians(60.0)))
def test_an_echo_weighs_in_each_cell_what_the_model_says(pose: Pose2, range_m: float, cone_rad: float) -> None:
    """Log-odds after one echo, by the angle and the distance of each cell, to half a step (0.0125).

    Cells within a millionth of a border of the cone, of the arc or of the free part may be on either side.
    """
    grid, rules = OccupancyGrid(), SonarRules()
    ping(grid, pose, range_m, cone_rad=cone_rad)
    half_rad, arc_half_m = cone_rad / 2.0, max(rules.arc_half_m, D)
    free_m = range_m - arc_half_m - D * math.sqrt(0.5)
    side = np.arange(-math.ceil(MAX_M / D) - 3, math.ceil(MAX_M / D) + 4)
    row, col = math.floor(pose.y_m / D) + side[:, None], math.floor(pose.x_m / D) + side[None, :]
    places = np.stack(np.broadcast_arrays((col + 0.5) * D, (row + 0.5) * D), axis=-1).reshape(-1, 2)
    distance = np.hypot(places[:, 0] - pose.x_m, places[:, 1] - pose.y_m)
    turn = np.arctan2(places[:, 1] - pose.y_m, places[:, 0] - pose.x_m) - pose.yaw_rad
    off_rad = np.abs((turn + math.pi) % (2.0 * math.pi) - math.pi)
    centred = 1.0 - (1.0 - np.cos(off_rad)) / (1.0 - math.cos(half_rad))
    from_arc = (distance - range_m) / (arc_half_m + D / 2.0)
    occupied = rules.occupied_log_odds * (rules.edge_share + (1.0 - rules.edge_share) * centred) * (1.0 - from_arc**2)
    free = -rules.free_log_odds * centred * (1.0 - 0.5 * distance / max(free_m, D))
    in_cone, on_arc = off_rad <= half_rad, np.abs(distance - range_m) <= arc_half_m
    wanted = np.where(in_cone & on_arc, occupied, np.where(in_cone & (distance <= free_m), free, 0.0))
    borders = (off_rad - half_rad, np.abs(distance - range_m) - arc_half_m, distance - free_m, distance)
    sure = np.all(np.abs(borders) > 1e-6, axis=0)
    with np.errstate(divide="ignore"):
        p = grid.probability_at(places)
        found = np.where(np.isnan(p), 0.0, np.log(p / (1.0 - p)))
    assert np.abs(found - wanted)[sure].max() <= 0.0125 + 1e-9
    assert np.any(found[sure] > 0.0)


@SLOW
@given(st.lists(st.tuples(POSES, READINGS, st.sampled_from(["a", "b", None])), max_size=30))
def test_no_cone_makes_freer_what_a_laser_holds(pings: list[tuple[Pose2, float, str | None]]) -> None:
    bearing = np.radians(np.arange(0.0, 360.0, 1.0))
    grid, laser_only = OccupancyGrid(), OccupancyGrid()
    for g in (grid, laser_only):
        g.insert_scan(Pose2(0.01, 0.02), bearing, np.full(360, 2.0), range_max_m=5.0)
    for pose, range_m, name in pings:
        ping(grid, Pose2(pose.x_m / 10, pose.y_m / 10, pose.yaw_rad), range_m, name)
    patch = laser_only.patch()
    rows, cols = np.nonzero(patch.cells >= 0)
    points = np.stack(((cols + patch.col0 + 0.5) * D, (rows + patch.row0 + 0.5) * D), axis=-1)
    assert np.all(grid.probability_at(points) >= laser_only.probability_at(points))


def test_evidence_fades_to_the_edges_and_needs_repetition() -> None:
    grid = OccupancyGrid()
    ping(grid, Pose2(), 2.0)

    def at(distance: float, degrees: float) -> float:
        a = math.radians(degrees)
        return float(grid.probability_at([(distance * math.cos(a), distance * math.sin(a))])[0])

    assert 0.5 < at(2.0, 13.0) < at(2.0, 0.5) < 0.65
    assert at(0.5, 0.5) < at(0.5, 10.0) < 0.5
    assert math.isnan(at(0.5, 14.8))
    assert at(0.5, 0.5) < at(1.5, 0.5)
    assert grid.state_at([(2.0, 0.02), (1.0, 0.02)]).tolist() not in ([OCCUPIED, FREE],)
    for _ in range(20):
        ping(grid, Pose2(), 2.0)
    assert grid.state_at([(2.0, 0.02), (1.0, 0.02), (2.2, 0.02)]).tolist() == [OCCUPIED, FREE, UNKNOWN]


def test_silence_clears_less_and_slower_than_an_echo() -> None:
    silent, echoing = OccupancyGrid(), OccupancyGrid()
    ping(silent, Pose2(), math.inf)
    ping(echoing, Pose2(), MAX_M)
    quiet, loud = silent.patch().cells, echoing.patch().cells
    assert 0 < np.count_nonzero(quiet >= 0) < 0.3 * np.count_nonzero((loud >= 0) & (loud < 50))
    assert quiet[quiet >= 0].min() > loud[loud >= 0].min()
    untrusted = OccupancyGrid()
    untrusted.insert_cone(Pose2(), math.inf, cone_rad=CONE, range_max_m=MAX_M, clear_no_return=False)
    assert untrusted.patch().cells.size == 0


def test_a_single_lie_changes_nothing() -> None:
    """Cross-talk: one false echo among true ones, from a transducer at rest."""
    true_only, with_lies = OccupancyGrid(), OccupancyGrid()
    for k in range(30):
        ping(true_only, Pose2(), 2.0, "left")
        ping(with_lies, Pose2(), 2.0, "left")
        if k % 5 == 4:
            assert not ping(with_lies, Pose2(), 0.4 + 0.01 * k, "left")
            assert not ping(with_lies, Pose2(), math.inf, "left")
    assert true_only.rejected_echoes == 1
    assert with_lies.rejected_echoes == 18  # that one, the lies, and the true echo after each pair of them
    assert with_lies.state_at([(0.45, 0.02)])[0] != OCCUPIED
    assert with_lies.state_at([(2.0, 0.02), (1.0, 0.02)]).tolist() == [OCCUPIED, FREE]


def test_random_stray_echoes_are_rarely_believed() -> None:
    rng = np.random.default_rng(4)
    echoes = EchoFilter(SonarRules())
    believed = sum(echoes.believe(float(r), 0.0, 0.0) for r in rng.uniform(0.2, 6.0, 2000))
    assert believed / 2000 < 0.1


def test_a_moving_transducer_hears_an_approaching_wall() -> None:
    echoes = EchoFilter(SonarRules())
    believed = [echoes.believe(2.5 - 0.3 * k, 0.3 * k, 0.0) for k in range(8)]
    assert believed == [False] + [True] * 7


def test_three_silences_are_needed_and_nan_is_no_vote() -> None:
    echoes = EchoFilter(SonarRules())
    said = [echoes.believe(r, 0.0, 0.0) for r in (math.inf, math.nan, math.inf, math.inf, 1.0, math.inf, math.inf)]
    assert said == [False, False, False, True, False, False, False]


def test_neighbours_do_not_erase_each_other() -> None:
    """Left sees a post at 1 m in its part of the overlap; right looks past it and hears the wall at 2.5 m."""
    post_yaw = math.radians(10.0)
    left, right = Pose2(0.0, 0.0, math.radians(12.0)), Pose2(0.0, 0.0, math.radians(-5.0))
    place = [(math.cos(post_yaw), math.sin(post_yaw))]

    def probability_after(guarded: bool) -> float:
        grid = OccupancyGrid()
        for _ in range(6):
            ping(grid, left, 1.0, "left")
        for _ in range(60):
            ping(grid, left, 1.0, "left")
            for _ in range(4):
                ping(grid, right, 2.5, "right" if guarded else None)
        return float(grid.probability_at(place)[0])

    assert probability_after(True) > 0.85
    # When left itself no longer hears the post, it goes.
    grid = OccupancyGrid()
    for name, pose, range_m in (("left", left, 1.0), ("left", left, 2.5), ("right", right, 2.5)):
        for _ in range(40):
            ping(grid, pose, range_m, name)
    assert grid.state_at(place)[0] == FREE


def test_a_silent_neighbour_does_not_guard_for_ever() -> None:
    grid = OccupancyGrid()
    for _ in range(10):
        ping(grid, Pose2(), 1.0, "unplugged")
    for _ in range(200):
        ping(grid, Pose2(), 2.5, "other")
    assert grid.state_at([(1.0, 0.02)])[0] == FREE


def test_glass_that_the_laser_looks_through_is_kept_by_the_sonar() -> None:
    bearing = np.radians(np.arange(-45.0, 45.1, 0.5))
    grid = OccupancyGrid()
    for _ in range(30):
        grid.insert_scan(Pose2(), bearing, np.full(bearing.size, 4.0), range_max_m=5.0)
        ping(grid, Pose2(), 1.5, "front")
    assert grid.state_at([(1.5, 0.02), (1.0, 0.02)]).tolist() == [OCCUPIED, FREE]
    assert np.any([np.any(change.cells >= 65) for change in grid.take_changes()])


@SLOW
@given(POSES, st.floats(0.3, 2.8), st.sampled_from([2.0, 5.0, 33.3]))
def test_a_cone_moves_with_its_pose(pose: Pose2, range_m: float, shift_m: float) -> None:
    assume(abs(pose.yaw_rad) > 0.01)
    d = 0.0625
    grids = [OccupancyGrid(resolution_m=d) for _ in range(2)]
    base = Pose2(round(pose.x_m) + 0.0311, round(pose.y_m) + 0.0173, pose.yaw_rad)
    cells = round(shift_m / d)
    for grid, moved in zip(grids, (base, Pose2(base.x_m + cells * d, base.y_m - cells * d, base.yaw_rad))):
        ping(grid, moved, range_m)
    assert np.array_equal(grids[0].patch().cells, grids[1].patch().cells)


@pytest.mark.parametrize(
    ("cone_rad", "range_max_m", "pose"),
    [
        (0.0, 3.0, Pose2()),
        (4.0, 3.0, Pose2()),
        (math.nan, 3.0, Pose2()),
        (0.5, math.nan, Pose2()),
        (0.5, math.inf, Pose2()),
        (0.5, 3.0, Pose2(math.nan)),
        (0.5, 3.0, Pose2(yaw_rad=math.inf)),
    ],
)
def test_cones_that_are_none_are_refused(cone_rad: float, range_max_m: float, pose: Pose2) -> None:
    grid = OccupancyGrid()
    with pytest.raises(ValueError, match=r"."):
        grid.insert_cone(pose, 1.0, cone_rad=cone_rad, range_max_m=range_max_m)
    assert grid.patch().cells.size == 0


def test_names_that_change_from_ping_to_ping_are_noticed() -> None:
    grid = OccupancyGrid()
    for k in range(256):
        ping(grid, Pose2(), 1.0, f"ping {k}")
    with pytest.raises(ValueError, match="names"):
        ping(grid, Pose2(), 1.0, "one more")


def walled_room(grid: OccupancyGrid, wall_m: float) -> None:
    """A laser at the origin sees a wall at x = wall_m, up and down to 60 degrees."""
    bearing = np.radians(np.arange(-60.0, 60.5, 0.5))
    for _ in range(5):
        grid.insert_scan(Pose2(0.01, 0.01), bearing, wall_m / np.cos(bearing), range_max_m=30.0)


@SLOW
@given(st.floats(-0.2, 0.2), st.floats(0.8, 2.0))
def test_an_echo_from_a_known_wall_grows_no_arc(yaw: float, wall_m: float) -> None:
    grid, before = OccupancyGrid(), OccupancyGrid()
    for g in (grid, before):
        walled_room(g, wall_m)
    for _ in range(10):
        ping(grid, Pose2(0.01, 0.01, yaw), wall_m)  # the cone holds the wall's nearest point, straight ahead
    assert np.array_equal(grid.patch().cells >= 65, before.patch().cells >= 65)


def test_an_echo_in_front_of_a_known_wall_is_something_the_laser_does_not_see() -> None:
    grid = OccupancyGrid()
    walled_room(grid, 2.0)
    assert grid.state_at([[1.0, 0.0]])[0] == FREE
    for _ in range(10):
        ping(grid, Pose2(0.01, 0.01), 1.0)
    assert grid.state_at([[1.0, 0.0]])[0] == OCCUPIED
