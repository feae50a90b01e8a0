"""Rays and cones of the simulated world against slow literal geometry and against distances known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_devices.floor_plan import (
    Box,
    Circle,
    Door,
    FloorPlan,
    Table,
    WalkerPlan,
    Wall,
    WorldError,
    load_floor_plan,
    parse_floor_plan,
    world_names,
)
from sim_devices.world import BODY_RADIUS_M, World

SQUARE = FloorPlan(walls=(Wall(((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0), (0.0, 0.0)), thickness_m=0.0),))


def look(world: World, x: float, y: float, degrees: list[float], *, z_m: float = 0.25, far: float = 30.0) -> np.ndarray:
    n = len(degrees)
    return world.beam_distances(np.tile([x, y], (n, 1)), np.radians(degrees), np.zeros(n), z_m=z_m, range_max_m=far)


def hear(world: World, x: float, y: float, degrees: float, *, half: float = 15.0, far: float = 4.0) -> float:
    return world.cone_distance((x, y), math.radians(degrees), math.radians(half), 0.0, z_m=0.3, range_max_m=far)


def test_distances_in_a_square_room() -> None:
    world = World.from_plan(SQUARE)
    np.testing.assert_allclose(
        look(world, 1.0, 1.0, [0, 90, 180, 270, 45, 360, -90]),
        [3.0, 2.0, 1.0, 1.0, 2.0 * math.sqrt(2.0), 3.0, 1.0],
        rtol=1e-12,
    )


def test_beyond_the_limit_and_outside_is_nothing() -> None:
    world = World.from_plan(SQUARE)
    assert look(world, 1.0, 1.0, [0, 180], far=2.0).tolist() == [math.inf, 1.0]
    assert look(world, 9.0, 9.0, [0]).tolist() == [math.inf]
    assert look(world, 1.0, 1.0, []).shape == (0,)
    assert look(World.from_plan(FloorPlan()), 0.0, 0.0, [0.0]).tolist() == [math.inf]


def test_thick_walls_show_both_faces_and_corners_are_closed() -> None:
    world = World.from_plan(FloorPlan(walls=(Wall(((0.0, 0.0), (4.0, 0.0), (4.0, 3.0)), thickness_m=0.2),)))
    assert look(world, 2.0, 1.0, [-90])[0] == pytest.approx(0.9)
    assert look(world, 2.0, -1.0, [90])[0] == pytest.approx(0.9)
    outside = look(world, 5.0, -1.0, [math.degrees(math.atan2(0.9, -0.9))])[0]
    assert outside == pytest.approx(0.9 * math.sqrt(2.0))


def test_circles_boxes_doors_and_table_legs() -> None:
    world = World.from_plan(
        FloorPlan(
            circles=(Circle((3.0, 0.0), 0.5),),
            boxes=(Box((0.0, 3.0), (1.0, 1.0), yaw_deg=45.0),),
            doors=(Door((-2.0, 0.0), width_m=1.0, closed_deg=0.0, open_deg=-90.0, thickness_m=0.0),),
            tables=(Table((0.0, -3.0), (2.0, 1.0), leg_radius_m=0.05),),
        )
    )
    seen = look(world, 0.0, 0.0, [0, 90, -90])
    np.testing.assert_allclose(seen, [2.5, 3.0 - math.sqrt(0.5), math.inf])
    assert look(world, 0.0, -0.5, [180])[0] == pytest.approx(2.0)
    assert look(world, -0.95, 0.0, [-90])[0] == pytest.approx(2.5)


def test_heights() -> None:
    world = World.from_plan(FloorPlan(boxes=(Box((2.0, 0.0), (1.0, 1.0), bottom_m=0.5, top_m=0.8),)))
    assert look(world, 0.0, 0.0, [0], z_m=0.3).tolist() == [math.inf]
    assert look(world, 0.0, 0.0, [0], z_m=0.6).tolist() == [1.5]


def test_glass_answers_only_at_right_angles_and_black_only_near() -> None:
    glass = FloorPlan(
        walls=(
            Wall(((2.0, -5.0), (2.0, 5.0)), thickness_m=0.0, material="glass"),
            Wall(((4.0, -9.0), (4.0, 9.0)), thickness_m=0.0),
        )
    )
    np.testing.assert_allclose(
        look(World.from_plan(glass), 0.0, 0.0, [0, 4, 20]),
        [2.0, 2.0 / math.cos(math.radians(4)), 4.0 / math.cos(math.radians(20))],
    )
    black = FloorPlan(
        walls=(
            Wall(((7.0, -9.0), (7.0, 9.0)), thickness_m=0.0, material="black"),
            Wall(((8.0, -9.0), (8.0, 9.0)), thickness_m=0.0),
        )
    )
    world = World.from_plan(black)
    assert look(world, 0.0, 0.0, [0]).tolist() == [math.inf]  # swallowed, not seen through
    assert look(world, 3.0, 0.0, [0]).tolist() == [4.0]
    assert look(world, 3.0, 0.0, [60]).tolist() == [math.inf]  # 8 m away, reach 3 m at that slant


def test_each_beam_has_its_own_origin() -> None:
    world = World.from_plan(SQUARE)
    n = 7
    origin = np.stack((np.linspace(0.5, 3.5, n), np.linspace(0.5, 2.5, n)), axis=-1)
    heading = np.linspace(-3.0, 3.0, n)
    together = world.beam_distances(origin, heading, np.zeros(n), z_m=0.3, range_max_m=30.0)
    for k in range(n):
        alone = world.beam_distances(origin[k : k + 1], heading[k : k + 1], np.zeros(1), z_m=0.3, range_max_m=30.0)
        assert together[k] == pytest.approx(alone[0], rel=1e-12)


def test_people_walk_are_seen_by_their_legs_and_never_jump() -> None:
    world = World.from_plan(FloorPlan(walkers=(WalkerPlan(((2.0, -1.0), (2.0, 1.0)), speed_m_s=1.0, pause_s=0.5),)), 3)
    walker = world.walkers[0]
    times = np.arange(0.0, 20.0, 0.01)
    place = walker.place(times)[0]
    assert np.hypot(*np.diff(place, axis=0).T).max() <= 0.0116  # 1.15 m/s at most
    assert place[:, 1].max() == pytest.approx(1.0, abs=0.02)
    assert place[:, 1].min() == pytest.approx(-1.0, abs=0.02)
    np.testing.assert_allclose([walker.place_now(float(t)) for t in times[::7]], place[::7], atol=1e-12)
    left, right = walker.legs(times)
    gap = np.hypot(*(left - right).T)
    assert gap.min() >= 0.2
    moment = 7.3
    leg = walker.legs(np.array([moment]))[0][0]
    heading = math.atan2(leg[1], leg[0])
    seen = world.beam_distances(np.zeros((1, 2)), np.array([heading]), np.array([moment]), z_m=0.3, range_max_m=9.0)[0]
    assert seen <= np.hypot(*leg) - 0.07 + 1e-9
    assert math.isfinite(seen)


def test_the_same_seed_gives_the_same_people() -> None:
    plan = FloorPlan(walkers=(WalkerPlan(((0.0, 0.0), (5.0, 0.0))),))
    times = np.linspace(0.0, 60.0, 7)
    one, two, other = (World.from_plan(plan, seed).walkers[0].place(times)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


# --- ultrasound ----------------------------------------------------------------------------------------------------


def test_a_wall_answers_at_its_nearest_point_even_off_the_axis() -> None:
    world = World.from_plan(FloorPlan(walls=(Wall(((2.0, -9.0), (2.0, 9.0)), thickness_m=0.0),)))
    assert hear(world, 0.0, 0.0, 0.0) == pytest.approx(2.0)
    assert hear(world, 0.0, 0.0, 10.0) == pytest.approx(2.0)  # its perpendicular is within the cone
    assert hear(world, 0.0, 0.0, 25.0) == pytest.approx(2.0 / math.cos(math.radians(10.0)))
    assert hear(world, 0.0, 0.0, 50.0) == math.inf  # hit at 35 degrees at best: thrown aside


def test_corners_ends_and_round_things_answer_always() -> None:
    world = World.from_plan(FloorPlan(walls=(Wall(((1.0, 1.0), (3.0, 3.2)), thickness_m=0.0),)))
    assert hear(world, 0.0, 0.0, 40.0) == pytest.approx(math.sqrt(2.0))
    pillar = World.from_plan(FloorPlan(circles=(Circle((2.0, 0.5), 0.3),)))
    assert hear(pillar, 0.0, 0.0, 10.0) == pytest.approx(math.hypot(2.0, 0.5) - 0.3)
    assert hear(pillar, 0.0, 0.0, -45.0) == math.inf


def test_what_is_hidden_is_not_heard() -> None:
    plan = FloorPlan(
        walls=(
            Wall(((0.5, -1.0), (6.0, 4.5)), thickness_m=0.0),  # struck at 45 degrees: silent, but in the way
            Wall(((3.0, -1.0), (3.0, 1.0)), thickness_m=0.0),
        )
    )
    assert hear(World.from_plan(plan), 0.0, 0.0, 0.0) == math.inf
    assert hear(World.from_plan(FloorPlan(walls=plan.walls[1:])), 0.0, 0.0, 0.0) == pytest.approx(3.0)


def test_glass_is_heard_and_soft_things_are_not() -> None:
    def wall(material: str) -> World:
        return World.from_plan(FloorPlan(walls=(Wall(((2.0, -1.0), (2.0, 1.0)), thickness_m=0.0, material=material),)))

    assert hear(wall("glass"), 0.0, 0.0, 0.0) == pytest.approx(2.0)
    assert hear(wall("soft"), 0.0, 0.0, 0.0) == math.inf


def test_people_are_heard_as_bodies() -> None:
    world = World.from_plan(FloorPlan(walkers=(WalkerPlan(((2.0, 0.0), (2.0, 0.0001))),)))
    assert hear(world, 0.0, 0.0, 0.0) == pytest.approx(2.0 - BODY_RADIUS_M, abs=1e-3)


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", world_names())
def test_shipped_worlds_load_and_have_a_route(name: str) -> None:
    plan = load_floor_plan(name)
    assert plan.name == name
    assert plan.route is not None
    assert plan.walls


def test_worlds_that_are_promised_exist() -> None:
    assert {"flat", "hall", "loop", "office", "warehouse", "walkers"} <= set(world_names())


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"wals": []}, "did you mean walls"),
        ({"walls": [{"points": [[0, 0], [1, 1]], "thicknes_m": 1}]}, "did you mean thickness_m"),
        ({"walls": [{"points": [[0, 0]]}]}, "walls[0].points: at least two"),
        ({"walls": [{"points": [[0, 0], [1, "x"]]}]}, "expected a number"),
        ({"walls": [{"points": [[0, 0], [1, 1]], "material": "wood"}]}, "unknown 'wood'"),
        ({"walls": {"points": []}}, "expected [[walls]]"),
        ({"boxes": [{"center": [0, 0], "size_m": [0, 1]}]}, "size_m: both must be above 0"),
        ({"boxes": [{"center": [0, 0]}]}, "boxes[0]: missing"),
        ({"circles": [{"center": [0, 0], "radius_m": -1}]}, "radius_m: must be above 0"),
        ({"circles": [{"center": [0, 0], "radius_m": True}]}, "expected a number"),
        ({"circles": [{"center": [0, 0], "radius_m": 1, "bottom_m": 3.0}]}, "top_m: must be above"),
        ({"route": {"points": [[0, 0], [1, 1]], "closed": 1}}, "true or false"),
    ],
)
def test_faults_in_a_floor_plan_name_their_place(table: dict[str, object], said: str) -> None:
    with pytest.raises(WorldError) as caught:
        parse_floor_plan(table)
    assert said in str(caught.value)


def test_unknown_world_names_the_known_ones() -> None:
    with pytest.raises(WorldError, match="flat"):
        load_floor_plan("flatt")
    with pytest.raises(WorldError, match="cannot be read"):
        load_floor_plan("/nonexistent/x.toml")
