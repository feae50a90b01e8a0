"""A floor plan in a TOML file: what stands where, and the way that the robot takes through it. Metres, degrees.

    name = "flat"                    # all of these are optional, lists of tables may repeat
    [[walls]]                        # a run of wall, drawn by its middle line; both faces are seen
    points = [[0, 0], [4, 0], [4, 3]]
    thickness_m = 0.10               # 0: a single face
    material = "wall"                # wall | glass | black | soft: below
    bottom_m = 0.0
    top_m = 2.5                      # a sensor at another height does not see it
    [[doors]]                        # a leaf on its hinge, swung open from closed_deg by open_deg
    hinge = [2.0, 3.4]
    width_m = 0.9
    closed_deg = 0.0
    open_deg = 80.0
    [[boxes]]                        # furniture: an upright box
    center = [1.0, 1.0]
    size_m = [2.0, 0.9]
    yaw_deg = 0.0
    [[tables]]                       # four legs under a top: as a box, but seen only by its legs
    center = [1.0, 1.0]
    size_m = [1.4, 0.8]
    leg_radius_m = 0.03
    [[circles]]                      # pillars, bins
    center = [3.0, 3.0]
    radius_m = 0.15
    [[pits]]                         # stairs down, ramps of a loading bay: the floor is lower here
    center = [5.0, 1.0]
    size_m = [1.0, 2.0]
    depth_m = 0.2
    [[walkers]]                      # people on their way round these points
    points = [[1, 1], [3, 1]]
    speed_m_s = 0.8
    pause_s = 2.0                    # at each point
    [route]
    points = [[0.8, 4.1], [7.5, 4.1]]  # corners are rounded; sharp ones are turned on the spot
    closed = true                    # go round again and again
    speed_m_s = 1.0

Glass answers light only within 5 degrees of head on, black only up to 6 m, at a slant sooner, and says nothing beyond;
both answer sound. Soft things answer light, not sound.

Faults are reported as WorldError with the file, the table and the key.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

WORLDS = Path(__file__).parent / "worlds"
MATERIALS = ("wall", "glass", "black", "soft")
CEILING_M = 2.5

Point = tuple[float, float]


class WorldError(ValueError):
    """A floor plan that cannot be used; the text names the file, the place in it and the repair."""


@dataclass(frozen=True, slots=True)
class Wall:
    points: tuple[Point, ...]
    thickness_m: float = 0.10
    material: str = "wall"
    bottom_m: float = 0.0
    top_m: float = CEILING_M


@dataclass(frozen=True, slots=True)
class Door:
    hinge: Point
    width_m: float = 0.9
    closed_deg: float = 0.0
    open_deg: float = 80.0
    thickness_m: float = 0.04
    material: str = "wall"


@dataclass(frozen=True, slots=True)
class Box:
    center: Point
    size_m: Point
    yaw_deg: float = 0.0
    material: str = "wall"
    bottom_m: float = 0.0
    top_m: float = 0.8


@dataclass(frozen=True, slots=True)
class Table:
    center: Point
    size_m: Point
    yaw_deg: float = 0.0
    leg_radius_m: float = 0.03
    top_m: float = 0.72


@dataclass(frozen=True, slots=True)
class Circle:
    center: Point
    radius_m: float
    material: str = "wall"
    bottom_m: float = 0.0
    top_m: float = CEILING_M


@dataclass(frozen=True, slots=True)
class Pit:
    center: Point
    size_m: Point
    yaw_deg: float = 0.0
    depth_m: float = 0.2


@dataclass(frozen=True, slots=True)
class WalkerPlan:
    points: tuple[Point, ...]
    speed_m_s: float = 0.8
    pause_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Route:
    """The way of the robot. corner_radius_m: corners are rounded up to this radius, less where legs are short."""

    points: tuple[Point, ...]
    closed: bool = False
    speed_m_s: float = 0.8
    acceleration_m_s2: float = 0.8
    turn_rad_s: float = 1.5
    turn_acceleration_rad_s2: float = 3.0
    corner_radius_m: float = 0.6
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Everything a floor plan file says."""

    name: str = ""
    walls: tuple[Wall, ...] = ()
    doors: tuple[Door, ...] = ()
    boxes: tuple[Box, ...] = ()
    tables: tuple[Table, ...] = ()
    circles: tuple[Circle, ...] = ()
    pits: tuple[Pit, ...] = ()
    walkers: tuple[WalkerPlan, ...] = ()
    route: Route | None = None


LISTS: dict[str, type] = {
    "walls": Wall,
    "doors": Door,
    "boxes": Box,
    "tables": Table,
    "circles": Circle,
    "pits": Pit,
    "walkers": WalkerPlan,
}


def world_names() -> list[str]:
    """The floor plans that come with the program."""
    return sorted(p.stem for p in WORLDS.glob("*.toml"))


def load_floor_plan(name_or_path: str) -> FloorPlan:
    """A floor plan that comes with the program, by name, or a file. Raises WorldError."""
    path = Path(name_or_path)
    if not path.suffix and not path.exists():
        path = WORLDS / f"{name_or_path}.toml"
        if not path.exists():
            raise WorldError(f"no world {name_or_path!r}; there are {', '.join(world_names())}, or give a .toml file")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WorldError(f"{path}: cannot be read: {error}") from error
    try:
        return parse_floor_plan(tomllib.loads(text))
    except (tomllib.TOMLDecodeError, WorldError) as error:
        raise WorldError(f"{path}: {error}") from error


def parse_floor_plan(table: Mapping[str, Any]) -> FloorPlan:
    """A floor plan from the tables of its file. Raises WorldError naming the table and the key."""
    _refuse_unknown(table, [f.name for f in fields(FloorPlan)], "the file")
    lists = {key: tuple(_items(table, key, kind)) for key, kind in LISTS.items()}
    route = table.get("route")
    return FloorPlan(
        name=str(table.get("name", "")),
        route=None if route is None else _item(route, Route, "route"),
        **lists,
    )


def _items(table: Mapping[str, Any], key: str, kind: type) -> Iterable[Any]:
    entries = table.get(key, [])
    if not isinstance(entries, list):
        raise WorldError(f"{key}: expected [[{key}]] tables")
    return (_item(entry, kind, f"{key}[{i}]") for i, entry in enumerate(entries))


def _item(entry: Any, kind: type, place: str) -> Any:
    if not isinstance(entry, dict):
        raise WorldError(f"{place}: expected a table")
    known = {f.name: f for f in fields(kind)}
    _refuse_unknown(entry, list(known), place)
    values = {key: _value(value, str(known[key].type), f"{place}.{key}") for key, value in entry.items()}
    try:
        item = kind(**values)
    except TypeError as error:
        raise WorldError(f"{place}: {str(error).split('__init__() ')[-1]}") from error
    _check(item, place)
    return item


def _refuse_unknown(table: Mapping[str, Any], known: list[str], place: str) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"
            raise WorldError(f"{place}: unknown key {key!r}{hint}")


def _value(value: Any, kind: str, place: str) -> Any:
    if kind == "Point":
        return _point(value, place)
    if kind == "tuple[Point, ...]":
        if not isinstance(value, list):
            raise WorldError(f"{place}: expected a list of [x, y]")
        return tuple(_point(p, f"{place}[{i}]") for i, p in enumerate(value))
    if kind == "float":
        return _number(value, place)
    if kind == "bool" and not isinstance(value, bool):
        raise WorldError(f"{place}: expected true or false, not {value!r}")
    if kind == "str" and not isinstance(value, str):
        raise WorldError(f"{place}: expected text, not {value!r}")
    return value


def _number(value: Any, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise WorldError(f"{place}: expected a number, not {value!r}")
    return float(value)


def _point(value: Any, place: str) -> Point:
    if not isinstance(value, list) or len(value) != 2:
        raise WorldError(f"{place}: expected [x, y], not {value!r}")
    return (_number(value[0], place), _number(value[1], place))


@dataclass(frozen=True, slots=True)
class _Rule:
    """What must hold for a key, wherever it stands."""

    least: float
    strict: bool = field(default=False)


_RULES = {
    "thickness_m": _Rule(0.0),
    "width_m": _Rule(0.0, True),
    "depth_m": _Rule(0.0, True),
    "radius_m": _Rule(0.0, True),
    "leg_radius_m": _Rule(0.0, True),
    "corner_radius_m": _Rule(0.0),
    "speed_m_s": _Rule(0.0, True),
    "acceleration_m_s2": _Rule(0.0, True),
    "turn_rad_s": _Rule(0.0, True),
    "turn_acceleration_rad_s2": _Rule(0.0, True),
    "pause_s": _Rule(0.0),
}


def _check(item: Any, place: str) -> None:
    for name, rule in _RULES.items():
        value = getattr(item, name, None)
        if value is not None and (value < rule.least or (rule.strict and value == rule.least)):
            raise WorldError(f"{place}.{name}: must be {'above' if rule.strict else 'at least'} {rule.least:g}")
    if getattr(item, "material", "wall") not in MATERIALS:
        raise WorldError(f"{place}.material: unknown {item.material!r}; there are {', '.join(MATERIALS)}")
    if len(getattr(item, "points", ((0.0, 0.0), (1.0, 1.0)))) < 2:
        raise WorldError(f"{place}.points: at least two are needed")
    if min(getattr(item, "size_m", (1.0, 1.0))) <= 0.0:
        raise WorldError(f"{place}.size_m: both must be above 0")
    if getattr(item, "top_m", 1.0) <= getattr(item, "bottom_m", 0.0):
        raise WorldError(f"{place}.top_m: must be above bottom_m")
