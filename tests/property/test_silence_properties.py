"""What gives no echo frees nothing behind the room it stands in, whichever map is asked; losing beams frees nothing.

The room is a rectangle, so that a straight line between two of its walls stays in it.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.occupancy import OccupancyGrid
from mapping.lines.free_space import visibility_polygon
from mapping.no_echo import WIDE_M, reach_without_echo
from mapping.scan import Scan
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from mapping.sectors.snapshot import SectorState

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

D = 0.05
MAX_M = 60.0
SLOW = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
VIEWS = {  # degrees: view, step
    "urg": (240.0, 0.352), "utm": (270.0, 0.25), "lms": (180.0, 0.5), "turn": (360.0, 0.8)
}  # fmt: skip


class Room:
    """The sensor at the origin of a room; black discs, and black stretches of its walls by bearing."""

    def __init__(self, walls_m: tuple[float, float, float, float], discs: list[tuple[float, float, float]]) -> None:
        self.walls_m = walls_m  # ahead, left, behind, right
        self.discs = discs  # bearing, distance of the middle, radius

    def ranges(self, bearing: F64) -> F64:
        c, s = np.cos(bearing), np.sin(bearing)
        ahead, left, behind, right = self.walls_m
        far = np.where(c > 0.0, ahead / np.maximum(c, 1e-12), behind / np.maximum(-c, 1e-12))
        side = np.where(s > 0.0, left / np.maximum(s, 1e-12), right / np.maximum(-s, 1e-12))
        wall = np.minimum(far, side)
        for at, away, radius in self.discs:
            off = np.abs((bearing - at + math.pi) % (2.0 * math.pi) - math.pi)
            reaches = (off < math.pi / 2) & (away * np.sin(off) < radius)
            wall = np.where(reaches & (away * np.cos(off) - radius < wall), np.inf, wall)
        return np.asarray(wall)

    def outside_m(self, x: F64, y: F64) -> F64:
        ahead, left, behind, right = self.walls_m
        return np.asarray(np.maximum.reduce([x - ahead, y - left, -x - behind, -y - right]))


sides = st.floats(0.4, 9.0)
rooms = st.builds(
    Room,
    st.tuples(sides, sides, sides, sides),
    # one thing, however large and near, that the sensor is not in: less than half a turn
    st.lists(st.tuples(st.floats(-3.2, 3.2), st.floats(0.3, 8.0), st.floats(0.02, 0.98)), max_size=1).map(
        lambda found: [(at, away, away * share) for at, away, share in found]
    ),
)


def view(name: str) -> F64:
    width, step = VIEWS[name]
    half = 0.5 * width
    return np.asarray(np.radians(np.arange(-half, half - 1e-6 if name == "turn" else half + 1e-6, step)))


def centres(grid: OccupancyGrid) -> tuple[F64, F64]:
    """Middles of the cells that are called free."""
    patch = grid.patch()
    rows, cols = np.nonzero((patch.cells >= 0) & (patch.cells < 50))
    return np.asarray((cols + patch.col0 + 0.5) * D), np.asarray((rows + patch.row0 + 0.5) * D)


@SLOW
@given(rooms, st.sampled_from(sorted(VIEWS)), st.booleans())
def test_no_map_calls_free_what_lies_behind_the_walls(room: Room, name: str, is_clockwise: bool) -> None:
    bearing = view(name)
    bearing = bearing[::-1].copy() if is_clockwise else bearing
    ranges = room.ranges(bearing)
    at_once, moved = OccupancyGrid(resolution_m=D), OccupancyGrid(resolution_m=D)
    at_once.insert_scan(Pose2(), bearing, ranges, range_max_m=MAX_M)
    moved.insert_beams(beams_of_scan(Scan(0, 0.0, bearing, ranges, 0.02, MAX_M), np.zeros(3)))
    for grid in (at_once, moved):
        x, y = centres(grid)
        behind = room.outside_m(x, y) > 1.5 * D  # a cell that the wall crosses, and the one its chord may cut
        assert (np.hypot(x, y)[behind] <= WIDE_M + D).all()

    reach = reach_without_echo(bearing, ranges, MAX_M)
    ends_outside = room.outside_m(reach * np.cos(bearing), reach * np.sin(bearing)) > 1e-6
    assert (reach[ends_outside] <= WIDE_M).all()

    ahead, left, behind_m, right = room.walls_m
    inside = shapely.union(shapely.box(-behind_m, -right, ahead, left), shapely.Point(0.0, 0.0).buffer(WIDE_M, 64))
    seen = visibility_polygon(bearing, ranges, range_max_m=MAX_M)
    assert seen.difference(inside.buffer(0.01)).area < 1e-9

    polar = PolarSectors(sources=("laser",), start_rad=-math.pi, stop_rad=math.pi, sector_rad=math.radians(7.5))
    rect = RectSectors(sources=("laser",), size_m=(12.0, 12.0), sector_m=0.5)
    for each in (polar, rect):
        each.update_beams(
            "laser", base_from_sensor=Pose2(), bearing_rad=bearing, range_m=ranges, range_min_m=0.02,
            range_max_m=MAX_M, stamp_ns=0,
        )  # fmt: skip
    wedges = polar.snapshot(0)
    free = wedges.state == SectorState.FREE
    longest = np.array([reach[(bearing >= lo) & (bearing <= hi)].max(initial=0.0) for lo, hi in
                        zip(wedges.edges_rad[:-1], wedges.edges_rad[1:])])  # fmt: skip
    assert (wedges.distance_m[free] <= longest[free] + 1e-6).all()
    squares = rect.snapshot(0)
    is_free = squares.state == SectorState.FREE
    assert is_free.any() or min(room.walls_m) < 1.0 or bool(room.discs)
    rows, cols = np.nonzero(is_free)
    x, y = np.asarray(-6.0 + 0.5 * (cols + 0.5)), np.asarray(-6.0 + 0.5 * (rows + 0.5))
    assert (np.hypot(x, y)[room.outside_m(x, y) > 0.0] <= WIDE_M).all()


@settings(SLOW, max_examples=300)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(VIEWS)), st.booleans())
def test_losing_beams_frees_nothing(seed: int, name: str, are_missing: bool) -> None:
    """Walls, posts and silence in turn; beams are lost around the edges of these."""
    random, bearing = np.random.default_rng(seed), view(name)
    counts = random.integers(1, 150, random.integers(2, 12))
    values = random.choice([math.inf, math.inf, 0.5, 2.0, 5.0, math.nan], len(counts))
    ranges = np.resize(np.repeat(values, counts), len(bearing))
    lost = np.zeros(len(bearing), dtype=bool)
    for edge in random.choice(np.cumsum(counts), random.integers(1, 4)):
        first = max(int(edge) + int(random.integers(-30, 5)), 0)
        lost[first : first + int(random.integers(1, 60))] = True
    whole = reach_without_echo(bearing, ranges, MAX_M)[~lost]
    if are_missing:
        left = reach_without_echo(bearing[~lost], ranges[~lost], MAX_M)
    else:
        left = reach_without_echo(bearing, np.where(lost, np.nan, ranges), MAX_M)[~lost]
    silent = np.isposinf(ranges[~lost])
    assert (left[silent] <= whole[silent] + 1e-9).all()
