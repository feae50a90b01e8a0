"""Fusion, outlines, free space and the map of a run: against the truth, shapely and recorded logs (S07 to S10)."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from drivers.logs import read_log
from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules, extract_from_points
from mapping.lines.free_space import FreeSpace, surfaces, visibility_polygon
from mapping.lines.fuse import FusionRules, fuse
from mapping.lines.line_map import LineMap, cells_along, rows_of_ends
from mapping.lines.lines import Lines, no_lines, segment_distance
from mapping.lines.outlines import OutlineKind, kind_of_polygon, outlines, signed_area

F64 = NDArray[np.float64]
DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
TURN = np.radians(np.arange(-180.0, 180.0, 0.5))


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


FLAT: F64 = np.array(
    [*box(0.0, 0.0, 8.0, 5.0), *box(5.0, 3.0, 6.2, 3.8), (3.0, 0.0, 3.0, 2.0), (3.0, 3.0, 3.0, 5.0)]
)  # fmt: skip
DRIVE = [Pose2(1.0 + 0.25 * k, 2.5 + 0.1 * math.sin(k), 0.3 * k) for k in range(24)]
DRIVE += [Pose2(7.3 - 0.25 * k, 4.4, 0.2 * k) for k in range(16)]


def cast(walls: F64, pose: Pose2, bearing: F64) -> F64:
    d = np.stack((np.cos(bearing + pose.yaw_rad), np.sin(bearing + pose.yaw_rad)), axis=-1)[:, None, :]
    a, e = walls[:, :2] - [pose.x_m, pose.y_m], walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
        along = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        share = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    return np.asarray(np.where((along > 0.0) & (share >= 0.0) & (share <= 1.0), along, np.inf).min(axis=1))


def line(*ends: float, count: float = 100.0, seen: float = 1.0, rms: float = 0.01) -> Lines:
    """Lines from x0, y0, x1, y1, ..."""
    e = np.array(ends, dtype=np.float64).reshape(-1, 4)
    n = np.ones(len(e))
    rows = rows_of_ends(e[:, :2], e[:, 2:], count * n, seen * n, rms * n)
    return Lines(rows, np.full((len(e), 2), -1, dtype=np.int64))


def mapped(noise_m: float = 0.008, seed: int = 1) -> LineMap:
    random = np.random.default_rng(seed)
    extractor, line_map = LineExtractor(TURN, LineRules(sigma_m=0.008)), LineMap()
    for pose in DRIVE:
        line_map.insert(extractor.extract(cast(FLAT, pose, TURN) + random.normal(0.0, noise_m, TURN.size)), pose)
    return line_map


# -------------------------------------------------------------------------------------------------------------- fusion


def test_second_line_goes_on_where_the_first_ends() -> None:
    """Fig. 5.5, case a: the start of the second lies on the first, its end beyond."""
    both = fuse(line(0.0, 0.0, 2.0, 0.0), line(1.5, 0.01, 4.0, 0.01))
    assert len(both) == 1
    np.testing.assert_allclose(both.start_m[0], [0.0, 0.005], atol=0.01)
    np.testing.assert_allclose(both.end_m[0], [4.0, 0.005], atol=0.01)
    assert both.count.tolist() == [200]
    assert both.seen.tolist() == [2]


def test_small_gaps_are_closed_larger_ones_not() -> None:
    """Case b."""
    rules = FusionRules(gap_m=0.3)
    assert len(fuse(line(0.0, 0.0, 2.0, 0.0), line(2.29, 0.0, 4.0, 0.0), rules)) == 1
    assert len(fuse(line(0.0, 0.0, 2.0, 0.0), line(2.31, 0.0, 4.0, 0.0), rules)) == 2


def test_contained_lines_are_absorbed() -> None:
    both = fuse(line(1.0, 0.02, 2.0, 0.02), line(0.0, 0.0, 4.0, 0.0))
    assert both.length_m == pytest.approx([4.0], abs=1e-3)


@pytest.mark.parametrize(
    "other",
    [
        (4.0, 0.0, 0.0, 0.0),  # the other side of a thin wall
        (0.0, 0.3, 4.0, 0.3),  # parallel, too far
        (0.0, 0.0, 4.0, 1.2),  # another angle
        (2.0, 0.0, 2.0, 3.0),  # at right angles
    ],
)
def test_other_lines_stay_apart(other: tuple[float, float, float, float]) -> None:
    assert len(fuse(line(0.0, 0.0, 4.0, 0.0), line(*other))) == 2


def test_fused_line_is_the_regression_over_all_points() -> None:
    """Moments lose nothing: a wall in two scans gives the line that all its points together give."""
    random = np.random.default_rng(7)
    rules = LineRules(bearing_sigma_rad=0.0, flat_m=0.0, split_m=1.0)
    x = np.linspace(3.0, -3.0, 120)
    points = np.stack((x, 2.0 + 0.1 * x + random.normal(0.0, 0.01, x.size)), axis=-1)[::-1][::-1]
    left, right = extract_from_points(points[60:], rules), extract_from_points(points[:60], rules)
    both = fuse(left, right)
    assert (len(left), len(right), len(both)) == (1, 1, 1)
    rows = np.concatenate((left.rows, right.rows))
    used = points[np.r_[right.beams[0, 0] : right.beams[0, 1] + 1, 60 + left.beams[0, 0] : 61 + left.beams[0, 1]]]
    if int(both.count[0]) == len(used):
        weight = np.empty(len(used))
        n = int(right.count[0])
        for part, lines in ((slice(0, n), right), (slice(n, None), left)):
            angle = lines.parameters()[0][0]
            toward = used[part] @ [math.cos(angle), math.sin(angle)]
            weight[part] = 1.0 / (0.01**2 * toward**2 / np.sum(used[part] ** 2, axis=1))
        centre = np.average(used, axis=0, weights=weight)
        _, _, v = np.linalg.svd((used - centre) * np.sqrt(weight)[:, None], full_matrices=False)
        angle, distance, _ = both.parameters()
        assert abs(math.cos(angle[0]) * v[1][0] + math.sin(angle[0]) * v[1][1]) == pytest.approx(1.0, abs=1e-6)
        assert distance[0] == pytest.approx(abs(v[1] @ centre), abs=1e-4)
    assert both.count[0] == rows[:, -2].sum() == len(used)


def test_nothing_fuses_with_nothing() -> None:
    assert len(fuse(no_lines(), no_lines())) == 0
    assert len(fuse(line(0.0, 0.0, 1.0, 0.0), no_lines())) == 1
    for wrong in ({"angle_rad": math.nan}, {"offset_m": -0.1}, {"gap_m": math.inf}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            FusionRules(**wrong)


# ------------------------------------------------------------------------------------------------------------ outlines


def test_rooms_are_clockwise_obstacles_counter_clockwise() -> None:
    found = outlines(mapped().lines(min_seen=3), join_m=0.4)
    obstacles = [signed_area(outline.points_m) for outline in found if outline.kind is OutlineKind.OBSTACLE]
    assert max(obstacles) == pytest.approx(1.2 * 0.8, rel=0.03)
    assert [area for area in obstacles if 0.05 < area < 0.9] == []  # the thin partitions have two sides and no area
    room = outlines(LineExtractor(TURN).extract(cast(FLAT[:4], DRIVE[0], TURN)).transformed(DRIVE[0]))
    assert [outline.kind for outline in room] == [OutlineKind.ROOM]
    assert signed_area(room[0].points_m) == pytest.approx(-40.0, rel=0.005)
    assert len(room[0].points_m) == 4


def test_partition_is_an_obstacle_even_if_noise_turns_it_inside_out() -> None:
    for across in (0.01, -0.01):
        faces = line(0.0, across, 4.0, across, 4.0, 0.0, 0.0, 0.0)
        assert [outline.kind for outline in outlines(faces)] == [OutlineKind.OBSTACLE]


def test_outline_of_an_open_chain_keeps_its_ends() -> None:
    chain = outlines(line(0.0, 0.0, 2.0, 0.0, 2.1, 0.1, 2.1, 3.0, 9.0, 9.0, 8.0, 9.0))
    assert sorted(len(each.members) for each in chain) == [1, 2]
    bend = max(chain, key=lambda each: len(each.members))
    assert bend.kind is OutlineKind.OPEN
    np.testing.assert_allclose(bend.points_m, [[0.0, 0.0], [2.1, 0.0], [2.1, 3.0]], atol=1e-9)


def test_orientation_is_shapelys() -> None:
    random = np.random.default_rng(2)
    for _ in range(50):
        angle = np.sort(random.uniform(0.0, 2.0 * np.pi, 8))
        polygon = np.stack((np.cos(angle), np.sin(angle)), axis=-1) * random.uniform(1.0, 5.0) + 1e4
        for p in (polygon, polygon[::-1]):
            clockwise = not shapely.LinearRing(p).is_ccw
            assert kind_of_polygon(p) is (OutlineKind.ROOM if clockwise else OutlineKind.OBSTACLE)
            assert abs(signed_area(p)) == pytest.approx(shapely.Polygon(p).area, rel=1e-6)
    assert kind_of_polygon([[0.0, 0.0], [1.0, 0.0]]) is OutlineKind.OPEN
    assert outlines(no_lines()) == []
    with pytest.raises(ValueError, match="join_m"):
        outlines(no_lines(), join_m=0.0)


# ---------------------------------------------------------------------------------------------------------- free space


def free_truth() -> shapely.Polygon:
    return shapely.Polygon(shapely.box(0, 0, 8, 5).exterior.coords, [shapely.box(5, 3, 6.2, 3.8).exterior.coords])


def test_visibility_is_inside_the_room_and_nearly_all_of_it() -> None:
    pose = Pose2(1.0, 1.0, 0.4)
    empty = visibility_polygon(TURN, cast(FLAT[:4], pose, TURN), range_max_m=20.0)
    assert empty.is_valid
    assert empty.area == pytest.approx(40.0, rel=0.001)
    seen = visibility_polygon(TURN, cast(FLAT, pose, TURN), range_max_m=20.0)
    placed = shapely.transform(seen, pose.apply)
    assert placed.is_valid
    assert placed.difference(free_truth().buffer(1e-6)).area < 0.001
    shadow = shapely.LineString([(3.0, 0.0), (3.0, 2.0)])
    assert placed.intersection(shadow.buffer(0.5)).area < 1.6  # nothing behind that wall but through the door


def test_free_space_never_holds_what_no_beam_passed() -> None:
    """A sector is free no farther than its shorter beam; what is unknown frees nothing."""
    bearing = np.radians(np.arange(-90.0, 91.0, 1.0))
    ranges = np.where(np.abs(bearing) < 0.5, 2.0, 6.0)
    ranges[:20], ranges[-20:] = np.nan, -np.inf
    seen = visibility_polygon(bearing, ranges, range_max_m=10.0)
    random = np.random.default_rng(1)
    angle, far = random.uniform(-math.pi, math.pi, 20000), random.uniform(0.0, 8.0, 20000)
    after = np.clip(np.searchsorted(bearing, angle), 1, len(bearing) - 1)
    shorter = np.fmin(ranges[after - 1], ranges[after])
    known = np.isfinite(ranges[after - 1]) & np.isfinite(ranges[after])
    outside = ~known | (far > shorter + 1e-9) | (np.abs(angle) > bearing[-1])
    inside = shapely.contains_xy(seen, far * np.cos(angle), far * np.sin(angle))
    assert not np.any(inside & outside)
    assert np.mean(inside[~outside & (far < 0.98 * shorter)]) > 0.99


def test_nothing_seen_is_free_only_if_the_device_says_so() -> None:
    bearing, nothing = np.radians(np.arange(-95.0, 96.0)), np.full(191, np.inf)
    assert visibility_polygon(bearing, nothing, range_max_m=4.0).area == pytest.approx(
        0.5 * 16.0 * 190 * math.pi / 180, rel=0.001
    )
    assert visibility_polygon(bearing, nothing, range_max_m=4.0, clear_no_return=False).is_empty
    for value in (np.nan, -np.inf, 0.0, -1.0, 4.1):
        assert visibility_polygon(bearing, np.full(191, value), range_max_m=4.0).is_empty


def test_falling_bearings_and_a_turned_seam_see_the_same() -> None:
    ranges = cast(FLAT, Pose2(1.0, 1.0, 0.0), TURN)
    ranges[100:130] = np.nan
    seen = visibility_polygon(TURN, ranges, range_max_m=20.0)
    for other_bearing, other_ranges in (
        (TURN[::-1], ranges[::-1]),
        (np.concatenate((TURN[110:], TURN[:110] + 2.0 * math.pi)), np.roll(ranges, -110)),
    ):
        other = visibility_polygon(other_bearing, other_ranges, range_max_m=20.0)
        assert other.symmetric_difference(seen).area < 1e-6


def test_driving_enlarges_free_space_towards_all_of_it() -> None:
    free, area = FreeSpace(), 0.0
    for pose in DRIVE:
        free.insert(pose, TURN, cast(FLAT, pose, TURN), range_max_m=20.0)
        assert free.area_m2 >= area - 1e-9
        area = free.area_m2
    assert free.polygon.difference(free_truth().buffer(1e-6)).area < 0.001
    assert area >= 0.93 * free_truth().area
    # Where nothing was seen, the truth has free space; everything else ends at a surface.
    walls = shapely.MultiLineString([[(a, b), (c, d)] for a, b, c, d in FLAT])
    for frontier in free.frontiers():
        assert shapely.LineString(frontier).length >= 0.3
        assert shapely.LineString(frontier).interpolate(0.5, normalized=True).distance(walls) > 0.05


def test_an_opening_is_a_frontier() -> None:
    """One look into a room with a door: the frontier closes the door, from jamb to jamb."""
    pose = Pose2(1.0, 2.5, 0.0)
    ranges = cast(np.array([*FLAT[:4], FLAT[-2], FLAT[-1]]), pose, TURN)
    ranges[ranges > 3.5] = np.nan  # what lies behind the door is too dark
    free = FreeSpace()
    free.insert(pose, TURN, ranges, range_max_m=20.0)
    longest = free.frontiers()[0]
    assert np.all((longest[:, 0] > 0.9) & (longest[:, 1] > 1.5) & (longest[:, 1] < 3.5))
    assert free.frontiers(min_length_m=100.0) == []


def test_surfaces_are_where_walls_are() -> None:
    pose = Pose2(1.0, 1.0, 0.2)
    seen = surfaces(TURN, cast(FLAT, pose, TURN), range_max_m=20.0)
    walls = shapely.MultiLineString([[(a, b), (c, d)] for a, b, c, d in FLAT]).buffer(0.06)
    for surface in seen:
        assert walls.covers(shapely.transform(surface, pose.apply))


def test_bad_free_space_arguments() -> None:
    with pytest.raises(ValueError, match="one length"):
        visibility_polygon(TURN, [1.0], range_max_m=5.0)
    with pytest.raises(ValueError, match="range_max_m"):
        visibility_polygon([0.0], [1.0], range_max_m=math.inf)
    with pytest.raises(ValueError, match="bearing_rad"):
        visibility_polygon([0.0, 0.0], [1.0, 1.0], range_max_m=5.0)
    with pytest.raises(ValueError, match="pose"):
        FreeSpace().insert(Pose2(math.nan, 0.0, 0.0), TURN, np.ones(TURN.size), range_max_m=5.0)
    with pytest.raises(ValueError, match="simplify_m"):
        FreeSpace(simplify_m=-1.0)
    empty = FreeSpace()
    assert (empty.area_m2, empty.frontiers()) == (0.0, [])
    assert visibility_polygon([], [], range_max_m=5.0).is_empty
    assert visibility_polygon([0.0], [1.0], range_max_m=5.0).is_empty


# ------------------------------------------------------------------------------------------------------- map of a run


def test_a_drive_gives_each_wall_once_and_in_place() -> None:
    line_map = mapped()
    lines = line_map.lines(min_seen=3)
    mid = 0.5 * (lines.start_m + lines.end_m)
    off = segment_distance(np.concatenate((lines.start_m, mid, lines.end_m)), FLAT[:, :2], FLAT[:, 2:]).min(axis=1)
    assert float(off.max()) < 0.02
    assert float(np.median(off)) < 0.003
    # 4 outer walls, two of which are cut by the partitions, the partitions from both sides, the pillar
    assert 8 <= len(lines) <= 16
    for x0, y0, x1, y1 in FLAT:
        along = np.linspace([x0, y0], [x1, y1], 21)[1:-1]
        assert np.mean(lines.distance_to(along).min(axis=1) < 0.02) > 0.8


def test_same_scans_same_map_bit_for_bit() -> None:
    assert mapped().to_bytes() == mapped().to_bytes()
    np.testing.assert_array_equal(mapped().lines().rows, mapped().lines().rows)


def test_map_is_a_fraction_of_its_scans() -> None:
    assert len(mapped().to_bytes(min_seen=2)) * 100 < len(DRIVE) * TURN.size * 4


def test_bytes_bring_the_map_back() -> None:
    line_map = mapped()
    again = LineMap.from_bytes(line_map.to_bytes())
    assert again.scans == line_map.scans
    a, b = line_map.lines(), again.lines()
    np.testing.assert_allclose(a.rows[:, :4], b.rows[:, :4], atol=5.1e-5)
    np.testing.assert_array_equal(np.minimum(a.count, 65535), b.count)
    np.testing.assert_array_equal(a.seen, b.seen)
    np.testing.assert_allclose(a.rms_m, b.rms_m, atol=1.3e-4)
    assert again.to_bytes() == line_map.to_bytes()
    data = line_map.to_bytes()
    for wrong in (b"", data[:-1], data + b"0", b"LNS9" + data[4:]):
        with pytest.raises(ValueError, match="line map"):
            LineMap.from_bytes(wrong)


def test_nearest_and_raycast_are_shapelys() -> None:
    line_map, random = mapped(), np.random.default_rng(3)
    lines = line_map.lines()
    shapes = [shapely.LineString([a, b]) for a, b in zip(lines.start_m, lines.end_m)]
    for _ in range(30):
        p = random.uniform([-1.0, -1.0], [9.0, 6.0])
        apart = np.array([shape.distance(shapely.Point(p)) for shape in shapes])
        found = line_map.nearest(p, 3)
        np.testing.assert_allclose([d for d, _ in found], np.sort(apart)[:3], atol=1e-9)
        assert apart[found[0][1]] == pytest.approx(found[0][0])
    origin, bearing = np.array([1.5, 2.4]), random.uniform(-4.0, 4.0, 60)
    distance, hit = line_map.raycast(origin, bearing, reach_m=7.0)
    for angle, d, k in zip(bearing, distance, hit):
        ray = shapely.LineString([origin, origin + 7.0 * np.array([math.cos(angle), math.sin(angle)])])
        crossed = [
            (shapely.Point(origin).distance(ray.intersection(s)), i) for i, s in enumerate(shapes) if ray.intersects(s)
        ]
        if not crossed:
            assert (d, k) == (math.inf, -1)
        else:
            assert d == pytest.approx(min(crossed)[0], abs=1e-9)
            assert k == min(crossed)[1]
    assert line_map.nearest((0.0, 50.0), within_m=10.0) == []
    assert LineMap().nearest((0.0, 0.0)) == []
    assert LineMap().raycast((0.0, 0.0), [0.0])[1].tolist() == [-1]


def test_prune_forgets_what_few_scans_saw() -> None:
    line_map = mapped()
    kept = len(line_map.lines(min_seen=4))
    before = len(line_map)
    assert line_map.prune(min_seen=4) == before - kept
    assert len(line_map) == kept == len(line_map.lines())
    assert LineMap().prune(min_seen=4) == 0


def test_index_covers_every_line() -> None:
    random = np.random.default_rng(9)
    for _ in range(300):
        row = random.uniform(-30.0, 30.0, 12)
        cells = set(cells_along(row, 0.0))
        wide = set(cells_along(row, 0.5))
        for share in np.linspace(0.0, 1.0, 200):
            x, y = row[:2] + share * (row[2:4] - row[:2])
            assert (math.floor(x / 4.0), math.floor(y / 4.0)) in cells
            for dx, dy in ((0.49, 0.0), (-0.49, 0.0), (0.0, 0.49), (0.0, -0.49)):
                assert (math.floor((x + dx) / 4.0), math.floor((y + dy) / 4.0)) in wide


def test_bad_maps() -> None:
    good = line(0.0, 0.0, 2.0, 0.0)
    line_map = LineMap()
    for pose in (Pose2(math.nan, 0.0, 0.0), Pose2(1e9, 0.0, 0.0), Pose2(0.0, 0.0, math.inf)):
        with pytest.raises(ValueError):
            line_map.insert(good, pose)
    with pytest.raises(ValueError, match="long"):
        line_map.insert(line(0.0, 0.0, 1e6, 0.0), Pose2())
    assert (len(line_map), line_map.scans) == (0, 0)
    for point in ([1.0], [math.nan, 0.0], [[1.0, 2.0], [3.0, 4.0]]):
        with pytest.raises(ValueError, match="points"):
            line_map.nearest(point)
    for origin, bearing in (([0.0], [0.0]), ([0.0, math.nan], [0.0]), ([0.0, 0.0], [[0.0]]), ([0.0, 0.0], [math.inf])):
        with pytest.raises(ValueError, match="ray"):
            line_map.raycast(origin, bearing)
    with pytest.raises(ValueError, match="reach_m"):
        line_map.raycast((0.0, 0.0), [0.0], reach_m=math.nan)


# -------------------------------------------------------------------------------------------------------- recorded runs


@pytest.mark.data
@needs_data
@pytest.mark.parametrize(
    ("name", "median_m", "times_smaller"), [("seattle", 0.010, 80), ("belgioioso", 0.012, 50), ("acapulco", 0.020, 50)]
)
def test_recorded_runs_become_small_maps(name: str, median_m: float, times_smaller: float) -> None:
    """Lines that two scans saw, against the scans as 4-byte ranges: 50 times smaller, 90 % of the supporting points
    within 10 cm of the map, half of them within 1.5 cm; within 2 cm in acapulco, whose ranges come in steps of 5 cm."""
    log = read_log(Path(DATA) / "known_pose_logs" / f"{name}-corrected.log.gz")
    extractor = LineExtractor(log.scans[0].bearing_rad, range_max_m=log.range_max_m)
    line_map = LineMap()
    supports = []
    for index, scan in enumerate(log.scans):
        lines, pose = extractor.extract(scan.range_m), Pose2(*scan.laser_pose)
        line_map.insert(lines, pose)
        if index % 7 == 0:
            seen = np.isfinite(scan.range_m)
            for first, last in lines.beams:
                part = np.arange(first, last + 1)[seen[first : last + 1]]
                r, a = scan.range_m[part], scan.bearing_rad[part]
                supports.append(pose.apply(np.stack((r * np.cos(a), r * np.sin(a)), axis=-1)))
    points = np.concatenate(supports)
    distance = line_map.lines(min_seen=2, min_count=12).distance_to(points).min(axis=1)
    assert len(line_map.to_bytes(min_seen=2, min_count=12)) * times_smaller <= sum(
        s.range_m.size * 4 for s in log.scans
    )
    assert float(np.mean(distance < 0.1)) >= 0.9
    assert float(np.median(distance)) <= median_m
