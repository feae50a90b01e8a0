"""Floor plans for bench/slam_logs.py: storeys of offices, halls of shelves, arcades that bend, yards with trees."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_devices.big_building import BigBuilding
from sim_devices.floor_plan import Box, Circle, FloorPlan, Point, Route, Table, WalkerPlan, Wall

F64 = NDArray[np.float64]

WALKER_APART_M = 25.0


def corridors(building: BigBuilding, seed: int, *, walkers: bool = False, backwards: bool = False) -> FloorPlan:
    """A building of corridors. walkers: people go up and down beside the way.  backwards: the tour is driven once more
    from its end to its start, and half of it forth again."""
    plan = building.plan(seed)
    assert plan.route is not None
    points = plan.route.points
    people = _up_and_down(points, np.random.default_rng(seed + 1)) if walkers else ()
    if backwards:
        points = (*points, *points[-2::-1], *points[1 : len(points) // 2])
    return replace(plan, walkers=people, route=replace(plan.route, points=points))


def _up_and_down(way: tuple[Point, ...], rng: np.random.Generator) -> tuple[WalkerPlan, ...]:
    """People who walk along legs of a way, one every WALKER_APART_M or so, beside its middle."""
    people = []
    for a, b in itertools.pairwise(np.array(way)):
        length = float(np.hypot(*(b - a)))
        if length < 4.0 or rng.random() > length / WALKER_APART_M:
            continue
        across = np.array([-(b - a)[1], (b - a)[0]]) / length * float(rng.choice([-0.75, 0.75]))
        ends = (_point(a + across), _point(b + across))
        people.append(WalkerPlan(ends, float(rng.uniform(0.6, 1.3)), float(rng.uniform(0.0, 20.0))))
    return tuple(people)


def _point(p: F64) -> Point:
    return float(p[0]), float(p[1])


def offices(seed: int, *, bays: int = 9, laps: int = 2, walkers: bool = True) -> FloorPlan:
    """Two parallel corridors joined at both ends, rooms with furniture on either side; the robot enters every third."""
    rng = np.random.default_rng(seed)
    walls: list[Wall] = []
    boxes: list[Box] = []
    circles: list[Circle] = []
    tables: list[Table] = []
    wide = rng.uniform(2.8, 6.0, bays)
    left = np.concatenate(([0.0], np.cumsum(wide)))
    length, gap, half, depth = float(left[-1]), 14.0, 1.0, 4.6
    visits: dict[int, list[Point]] = {0: [], 1: []}
    for side, (corridor_y, out) in enumerate(((0.0, -1.0), (gap, 1.0))):
        for inward in (1.0, -1.0):
            direction = out * inward
            y0, y1 = corridor_y + direction * half, corridor_y + direction * (half + depth)
            for k in range(bays):
                a, b = float(left[k]), float(left[k + 1])
                door = float(rng.uniform(a + 0.3, b - 1.3))
                is_open = rng.random() < 0.6
                enters = is_open and inward > 0.0 and k % 3 == 1
                walls += [Wall(((a, y0), (door, y0)), 0.08), Wall(((door + 0.95, y0), (b, y0)), 0.08)]
                if not is_open:
                    walls.append(Wall(((door, y0), (door + 0.95, y0)), 0.04))
                    continue
                walls += [Wall(((a, y0), (a, y1), (b, y1), (b, y0)), 0.08, "glass" if rng.random() < 0.1 else "wall")]
                middle = (door + 0.47, y0 + direction * 1.6)
                _furnish(rng, (a, b), (y0, y1), middle, boxes, circles, tables)
                if enters:
                    visits[side].append(middle)
    for x, sign in ((0.0, -1.0), (length, 1.0)):  # what joins the corridors
        far = x + sign * 2.2
        walls += [
            Wall(((x, -half), (far, -half), (far, gap + half), (x, gap + half)), 0.08),
            Wall(((x, half), (x, gap - half)), 0.08),
        ]
    points: list[Point] = [(0.0, 0.0)]
    for _ in range(laps):
        for before, inside in _doors(visits[0]):
            points += [before, inside, before]
        points += [(length + 1.0, 0.0), (length + 1.0, gap)]
        for before, inside in _doors(visits[1][::-1], gap):
            points += [before, inside, before]
        points += [(-1.0, gap), (-1.0, 0.0), (0.5, 0.0)]
    points += [(length * 0.6, 0.0)]
    way = tuple(p for k, p in enumerate(points) if k == 0 or math.dist(p, points[k - 1]) > 0.05)
    people = _up_and_down(way, rng) if walkers else ()
    return FloorPlan(
        "offices", tuple(walls), (), tuple(boxes), tuple(tables), tuple(circles), walkers=people,
        route=Route(way, speed_m_s=0.5, turn_rad_s=1.0, corner_radius_m=0.4),
    )  # fmt: skip


def _doors(rooms: list[Point], y: float = 0.0) -> list[tuple[Point, Point]]:
    return [((x, y), (x, inside)) for x, inside in rooms]


def _furnish(
    rng: np.random.Generator, span: tuple[float, float], depth: tuple[float, float], clear: Point, boxes: list[Box],
    circles: list[Circle], tables: list[Table],
) -> None:  # fmt: skip
    """Desks, cupboards and chairs, none within 1 m of a place."""
    for _ in range(int(rng.integers(2, 7))):
        low, high = sorted(depth)
        at = (float(rng.uniform(span[0] + 0.5, span[1] - 0.5)), float(rng.uniform(low + 0.6, high - 0.6)))
        if math.dist(at, clear) < 1.2 or abs(at[0] - clear[0]) < 0.7:
            continue
        kind = rng.random()
        if kind < 0.4:
            boxes.append(
                Box(at, (float(rng.uniform(0.4, 1.4)), 0.45), float(rng.choice([0.0, 90.0, rng.uniform(0, 90)])))
            )
        elif kind < 0.7:
            tables.append(Table(at, (1.4, 0.8), float(rng.choice([0.0, 90.0]))))
        else:
            circles.append(Circle(at, float(rng.uniform(0.03, 0.25))))


def shelves(seed: int, *, aisles: int = 8, length_m: float = 28.0) -> FloorPlan:
    """A hall with rows of shelves, all alike, driven up one aisle and down the next, there and back, then round it."""
    rng = np.random.default_rng(seed)
    pitch, margin = 3.2, 4.0
    width = (aisles + 1) * pitch + 2.0 * margin
    hall = ((0.0, 0.0), (width, 0.0), (width, length_m + 2.0 * margin), (0.0, length_m + 2.0 * margin), (0.0, 0.0))
    boxes = []
    for k in range(aisles + 1):
        x = margin + k * pitch + 0.5 * pitch
        for y in np.arange(margin, margin + length_m - 2.0, 2.4):
            if rng.random() < 0.93:
                boxes.append(Box((x, float(y) + 1.2), (0.9, 2.3)))
    circles = tuple(
        Circle((float(x), float(y)), 0.3) for x in (0.6, width - 0.6) for y in rng.uniform(2.0, length_m, 3)
    )
    points: list[Point] = [(1.8, 1.8)]
    for k in range(aisles):
        x = margin + (k + 1) * pitch
        ends = [(x, 1.8), (x, length_m + margin + 2.0)]
        points += ends if k % 2 == 0 else ends[::-1]
    top = points[-1][1]
    around: list[Point] = [(width - 1.8, top), (width - 1.8, 1.8), (1.8, 1.8), (1.8, length_m + margin + 2.0)]
    way = [*points, *points[-2::-1], *around[::-1], (width - 1.8, top)]
    clean = tuple(p for k, p in enumerate(way) if k == 0 or math.dist(p, way[k - 1]) > 0.05)
    return FloorPlan(
        "shelves", (Wall(hall, 0.0),), (), tuple(boxes), (), circles, walkers=_up_and_down(clean, rng),
        route=Route(clean, speed_m_s=0.7, corner_radius_m=0.5),
    )  # fmt: skip


def curved(plan: FloorPlan, radius_m: float) -> FloorPlan:
    """A plan whose x axis is bent into an arc of that radius about (0, radius): walls and way in short pieces."""

    def onto(p: Point) -> Point:
        angle, reach = p[0] / radius_m, radius_m - p[1]
        return reach * math.sin(angle), radius_m - reach * math.cos(angle)

    def run(points: tuple[Point, ...], every_m: float) -> tuple[Point, ...]:
        out = [onto(points[0])]
        for a, b in itertools.pairwise(points):
            count = max(1, math.ceil(math.dist(a, b) / every_m))
            out += [
                onto((a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count)) for k in range(1, count + 1)
            ]
        return tuple(out)

    assert plan.route is not None
    return replace(
        plan,
        walls=tuple(replace(wall, points=run(wall.points, 2.0)) for wall in plan.walls),
        boxes=tuple(
            replace(b, center=onto(b.center), yaw_deg=math.degrees(b.center[0] / radius_m)) for b in plan.boxes
        ),
        circles=tuple(replace(c, center=onto(c.center)) for c in plan.circles),
        walkers=tuple(replace(w, points=run(w.points, 4.0)) for w in plan.walkers),
        route=replace(plan.route, points=run(plan.route.points, 6.0)),
    )


def yard(seed: int, *, laps: int = 2) -> FloorPlan:
    """Outdoors: houses at odd angles around which the way leads, trees, hedges, parked cars."""
    rng = np.random.default_rng(seed)
    centres = [(x, y) for x in (25.0, 65.0, 105.0) for y in (22.0, 62.0)]
    boxes = [
        Box(c, (float(rng.uniform(16.0, 26.0)), float(rng.uniform(12.0, 20.0))), float(rng.uniform(-12.0, 12.0)))
        for c in centres
    ]
    lanes = [(5.0, 2.0), (45.0, 2.0), (85.0, 2.0), (125.0, 2.0)]
    xs, ys = [x for x, _ in lanes], [2.0, 42.0, 82.0]
    circles: list[Circle] = []
    for _ in range(500):  # trees and posts beside the lanes
        x, y = (float(v) for v in (rng.uniform(-3.0, 133.0), rng.uniform(-6.0, 90.0)))
        beside = min(min(abs(x - lane) for lane in xs), min(abs(y - lane) for lane in ys))
        if 2.0 < beside < 6.5:
            circles.append(Circle((x, y), float(rng.uniform(0.05, 0.35))))
    for lane in ys:  # hedges: nothing is a plane
        for x0 in rng.uniform(5.0, 110.0, 3):
            for t in np.arange(0.0, 12.0, 0.35):
                off = 2.6 + 0.35 * float(rng.random())
                if min(abs(float(x0) + float(t) - road) for road in xs) < 2.0:
                    continue
                circles.append(Circle((float(x0) + float(t), lane + off), float(rng.uniform(0.05, 0.2))))
    for lane in xs:
        for y in rng.uniform(4.0, 80.0, 4):
            boxes.append(
                Box((lane + float(rng.choice([-3.0, 3.0])), float(y)), (1.7, 4.2), float(rng.uniform(-4.0, 4.0)))
            )
    grid = [[(x, y) for y in ys] for x in xs]
    once = [
        grid[0][0], grid[1][0], grid[1][1], grid[0][1], grid[0][0], grid[3][0], grid[3][1], grid[2][1], grid[2][0],
        grid[1][0], grid[1][2], grid[0][2], grid[0][1], grid[3][1], grid[3][2], grid[1][2], grid[1][1], grid[0][1],
    ]  # fmt: skip
    way = once + ([*once[-2::-1]] if laps > 1 else [])
    clean = tuple(p for k, p in enumerate(way) if k == 0 or math.dist(p, way[k - 1]) > 0.05)
    return FloorPlan(
        "yard", (), (), tuple(boxes), (), tuple(circles), walkers=_up_and_down(clean, rng),
        route=Route(clean, speed_m_s=0.8, corner_radius_m=1.5),
    )  # fmt: skip


def columns_m(count: int, seed: int, low: float, high: float) -> tuple[float, ...]:
    """Where corridors lie, unevenly."""
    return (0.0, *np.cumsum(np.random.default_rng(seed).uniform(low, high, count - 1)).round(1).tolist())


Plan = Callable[[], FloorPlan]
