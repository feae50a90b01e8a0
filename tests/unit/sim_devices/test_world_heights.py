"""Tilted beams against a literal reference; floors, pits, furniture; what a nodding scanner and its encoder tell."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.device import F64, Frame, Mount
from sim_devices.floor_plan import Box, Circle, FloorPlan, Pit, Table, Wall, WorldError, parse_floor_plan
from sim_devices.mount_nodding import Axle, Swing, TiltedScene, angle_encoder, turned
from sim_devices.robot import CommandedMotion, SimScene
from sim_devices.world import World

SECOND = 1_000_000_000
Holds = Callable[[F64], bool]
ROOM = FloorPlan(
    walls=(Wall(((-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0), (-3.0, -2.0))), Wall(((1.0, 0.5), (1.0, 1.5)))),
    boxes=(Box((-1.5, 1.0), (1.0, 0.6), 30.0, top_m=0.8), Box((2.0, -1.0), (0.8, 0.4), bottom_m=1.2, top_m=1.6)),
    tables=(Table((-1.5, -1.0), (1.2, 0.7), 10.0),),
    circles=(Circle((0.8, -0.8), 0.2, top_m=1.0),),
    pits=(Pit((0.0, 1.2), (0.8, 0.5), 20.0, depth_m=0.3),),
)
WORLD = World.from_plan(ROOM)


def literal(origin: F64, direction: F64) -> float:
    """The nearest of all surfaces, each met on its own; for origins outside all bodies."""
    found = [math.inf]
    for a, b, low, high in zip(WORLD.segments.a, WORLD.segments.b, WORLD.segments.bottom_m, WORLD.segments.top_m):
        edge = np.array([b[0] - a[0], b[1] - a[1], 0.0])
        matrix = np.column_stack((edge, [0.0, 0.0, 1.0], -direction))
        if abs(np.linalg.det(matrix)) > 1e-12:
            along, height, away = np.linalg.solve(matrix, origin - [a[0], a[1], 0.0])
            if 0 <= along <= 1 and low <= height <= high and away > 0:
                found.append(float(away))
    for center, radius, low, high in zip(
        WORLD.circles.center, WORLD.circles.radius_m, WORLD.circles.bottom_m, WORLD.circles.top_m
    ):
        off, flat = origin[:2] - center, direction[:2]
        a, b, c = flat @ flat, 2 * off @ flat, off @ off - radius**2
        if a > 0 and b * b >= 4 * a * c:
            away = (-b - math.sqrt(b * b - 4 * a * c)) / (2 * a)
            if away > 0 and low <= origin[2] + away * direction[2] <= high:
                found.append(float(away))
    if abs(direction[2]) > 1e-12:
        for z, holds in levels():
            away = (z - origin[2]) / direction[2]
            if away > 0 and holds(origin[:2] + away * direction[:2]):
                found.append(float(away))
    return min(found)


def levels() -> list[tuple[float, Holds]]:
    def within(center: tuple[float, float], size: tuple[float, float], yaw_deg: float) -> Holds:
        turn = np.radians(-yaw_deg)
        matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return lambda p: bool(np.all(np.abs(matrix @ (p - np.array(center))) <= np.array(size) / 2))

    pit = ROOM.pits[0]
    in_pit = within(pit.center, pit.size_m, pit.yaw_deg)
    out: list[tuple[float, Holds]] = [(2.5, lambda p: True), (0.0, lambda p: not in_pit(p)), (-0.3, lambda p: True)]
    for box in ROOM.boxes:
        out += [(z, within(box.center, box.size_m, box.yaw_deg)) for z in (box.top_m, box.bottom_m) if z > 0]
    for table in ROOM.tables:
        out += [(z, within(table.center, table.size_m, table.yaw_deg)) for z in (0.72, 0.69)]
    return out


coordinates = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0.3, 2.2))
angles = st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5))


@settings(max_examples=150, deadline=None)
@given(coordinates, st.lists(angles, min_size=1, max_size=20))
def test_tilted_beams_meet_what_a_literal_search_meets(
    where: tuple[float, float, float], looks: list[tuple[float, float]]
) -> None:
    direction = np.array([[math.cos(e) * math.cos(h), math.cos(e) * math.sin(h), math.sin(e)] for h, e in looks])
    origin = np.broadcast_to(np.array(where), direction.shape).copy()
    found = WORLD.ray_distances(origin, direction, np.zeros(len(looks)), range_max_m=30.0)
    expected = [literal(o, d) for o, d in zip(origin, direction)]
    bad = np.abs(found - expected) > 1e-6
    for k in np.flatnonzero(bad):  # at an edge one of the two may just miss: its neighbours must agree on both sides
        nearby = [literal(origin[k], (direction[k] + nudge) / np.linalg.norm(direction[k] + nudge)) for nudge in NUDGES]
        assert min(nearby) - 1e-3 <= found[k] <= max(nearby) + 1e-3


NUDGES = 1e-6 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)


@settings(max_examples=50, deadline=None)
@given(coordinates, st.floats(-math.pi, math.pi))
def test_level_beams_are_the_flat_worlds(where: tuple[float, float, float], first: float) -> None:
    heading = first + np.linspace(0, 6.2, 90)
    origin = np.broadcast_to(np.array(where), (90, 3)).copy()
    direction = np.stack((np.cos(heading), np.sin(heading), np.zeros(90)), axis=-1)
    solid = WORLD.ray_distances(origin, direction, np.zeros(90), range_max_m=30.0)
    flat = WORLD.beam_distances(origin[:, :2], heading, np.zeros(90), z_m=where[2], range_max_m=30.0)
    assert np.allclose(solid, flat, atol=1e-9)


def test_straight_down_up_and_out_of_range() -> None:
    origin = np.array([[0.0, 0.0, 1.0]] * 3)
    direction = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    assert WORLD.ray_distances(origin, direction, np.zeros(3), range_max_m=30.0) == pytest.approx([1.0, 1.5, 2.95])
    assert WORLD.ray_distances(origin, direction, np.zeros(3), range_max_m=1.2)[1:] == pytest.approx([np.inf, np.inf])


def test_floor_is_lower_in_a_pit() -> None:
    assert WORLD.floor_m((0.0, 1.2)) == -0.3
    assert WORLD.floor_m((0.0, 0.0)) == 0.0
    scene = SimScene(WORLD, CommandedMotion((0.0, 0.2, math.pi / 2)))
    assert scene.floor_m(Mount(1.0), 0) == -0.3
    assert scene.floor_m(Mount(-0.5), 0) == 0.0


def test_pits_in_floor_plans() -> None:
    plan = parse_floor_plan({"pits": [{"center": [1, 2], "size_m": [1, 1], "depth_m": 0.5}]})
    assert plan.pits[0].depth_m == 0.5
    with pytest.raises(WorldError, match="depth_m"):
        parse_floor_plan({"pits": [{"center": [1, 2], "size_m": [1, 1], "depth_m": 0}]})


# -- the mount --------------------------------------------------------------------------------------------------------


def test_turning_about_each_axle() -> None:
    ahead, quarter = np.array([[1.0, 0.0, 0.0]]), np.array([math.pi / 2])
    assert turned(ahead, "pitch", quarter) == pytest.approx(np.array([[0.0, 0.0, -1.0]]))
    assert turned(ahead, "yaw", quarter) == pytest.approx(np.array([[0.0, 1.0, 0.0]]))
    assert turned(np.array([[0.0, 1.0, 0.0]]), "roll", quarter) == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


@pytest.mark.parametrize("axle", ["pitch", "roll", "yaw"])
def test_points_of_a_swing_lie_on_the_room(axle: Axle) -> None:
    swing = Swing(period_s=2.0, swing_rad=0.8)
    scene = SimScene(WORLD, CommandedMotion((0.1, -0.1, 0.3)))
    tilted = TiltedScene(scene, swing, axle, arm_m=(0.05, 0.0, 0.1), roll_rad=math.pi / 2 if axle == "yaw" else 0.0)
    mount = Mount(0.2, 0.0, 1.0, 0.1)
    bearing = np.radians(np.linspace(-120, 120, 241))
    seen = np.zeros((0, 3))
    for sweep in range(20):
        stamps = sweep * 5e7 + np.linspace(0.0, 2.5e7, 241)
        ranges = tilted.beam_ranges(mount, bearing, stamps, 30.0)
        origin, direction = tilted.beams(mount, bearing, stamps)
        seen = np.concatenate((seen, (origin + ranges[:, None] * direction)[np.isfinite(ranges)]))
    c, s = math.cos(0.3), math.sin(0.3)
    x, y, z = seen[:, 0] * c - seen[:, 1] * s + 0.1, seen[:, 0] * s + seen[:, 1] * c - 0.1, seen[:, 2]
    assert np.all((np.abs(x) < 2.951) & (np.abs(y) < 1.951) & (z > -0.301) & (z < 2.501))
    on_shell = (np.abs(np.abs(x) - 2.95) < 1e-6) | (np.abs(np.abs(y) - 1.95) < 1e-6) | (np.abs(z) < 1e-6)
    assert np.mean(on_shell | (np.abs(z - 2.5) < 1e-6)) > 0.5
    assert np.sum(np.abs(z) < 1e-6) > 20


def test_a_level_mount_is_no_mount() -> None:
    scene = SimScene(WORLD, CommandedMotion((0.1, -0.1, 0.3)))
    tilted = TiltedScene(scene, Swing(swing_rad=0.0))
    bearing = np.radians(np.linspace(-120, 120, 241))
    stamps = np.zeros(241)
    mount = Mount(0.2, 0.1, 1.0, 0.4)
    flat = scene.beam_ranges(mount, bearing, stamps, 30.0)
    assert tilted.beam_ranges(mount, bearing, stamps, 30.0) == pytest.approx(flat)


def test_the_encoder_on_the_axle_counts_the_angle() -> None:
    swing = Swing(period_s=4.0, swing_rad=0.6)
    encoder = angle_encoder(SimScene(WORLD, CommandedMotion()), swing, 0x30, steps_per_turn=36000)
    encoder.step(0, [])
    encoder.step(SECOND, [])
    for at_s in (1.0, 2.0, 3.0, 3.7):
        answer = encoder.step(round(at_s * SECOND), [Frame(0x630, bytes.fromhex("4004600000000000"))])[-1]
        count = int.from_bytes(answer.data[4:8], "little", signed=True)
        assert math.radians(count / 100) == pytest.approx(0.6 * math.sin(math.pi / 2 * at_s), abs=2e-4)


def test_motors_drive_a_robot_that_has_no_route() -> None:
    scene = SimScene(WORLD, CommandedMotion((0.0, 0.0, 0.0)), track_width_m=0.5, begin_at_origin=False)
    scene.drive_wheel(SECOND, "left", 0.2)
    scene.drive_wheel(SECOND, "right", 0.2)
    assert scene.pose_at([3 * SECOND])[0] == pytest.approx([0.4, 0.0, 0.0])
    scene.drive_wheel(3 * SECOND, "left", -0.2)
    assert scene.pose_at([4 * SECOND])[0] == pytest.approx([0.4, 0.0, 0.8])
    assert scene.wheel_travel_m(4 * SECOND) == pytest.approx((0.2, 0.6))
