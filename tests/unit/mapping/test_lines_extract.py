"""Lines of one scan: against the truth of simulated rooms, a plain version, numpy's SVD, and recorded logs."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.logs import read_log
from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, LineRules, extract_from_points, extract_lines
from mapping.lines.fit import regression_line, split_at_end_points
from mapping.lines.lines import Lines, segment_distance
from mapping.lines.segment import segment_points

F64 = NDArray[np.float64]
DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")
LOGS = ("seattle", "belgioioso", "acapulco")

BEARING = np.radians(np.arange(-135.0, 135.01, 0.25))
TURN = np.radians(np.arange(-180.0, 180.0, 0.5))


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


ROOM: F64 = np.array([*box(-3.0, -2.0, 4.0, 3.0), *box(1.0, 1.0, 2.0, 1.6)])


def cast(walls: F64, pose: Pose2, bearing: F64) -> F64:
    """(N,) distance to the nearest wall along each bearing; +inf if there is none."""
    d = np.stack((np.cos(bearing + pose.yaw_rad), np.sin(bearing + pose.yaw_rad)), axis=-1)[:, None, :]
    a, e = walls[:, :2] - [pose.x_m, pose.y_m], walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
        along = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        share = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    return np.asarray(np.where((along > 0.0) & (share >= 0.0) & (share <= 1.0), along, np.inf).min(axis=1))


def office(seed: int) -> tuple[F64, Pose2]:
    """A room with a door and some boxes, and a place in it."""
    random = np.random.default_rng(seed)
    walls = box(-4.0, -3.0, 4.0, 3.0)[1:] + [(-4.0, -3.0, 1.0, -3.0), (2.0, -3.0, 4.0, -3.0)] + box(-5, -9, 5, 9)
    for _ in range(4):
        x, y = random.uniform(-3.8, 3.0), random.choice([-2.8, 2.0])
        w, h = random.uniform(0.3, 0.9, 2)
        walls += box(x, y, x + w, y + h)
    return np.array(walls), Pose2(*map(float, random.uniform([-0.8, -0.8, -3.0], [0.8, 0.8, 3.0])))


def wall_error(lines: Lines, walls: F64) -> tuple[F64, F64]:
    """Of each line: the mean distance of its two ends and its middle from the wall it fits best; which wall."""
    way = walls[:, 2:] - walls[:, :2]
    normal = np.stack((-way[:, 1], way[:, 0]), axis=-1) / np.hypot(way[:, 0], way[:, 1])[:, None]
    spots = np.stack((lines.start_m, 0.5 * (lines.start_m + lines.end_m), lines.end_m))
    off = np.abs(np.sum((spots[:, :, None, :] - walls[:, :2]) * normal, axis=3)).mean(axis=0)
    off[segment_distance(spots[1], walls[:, :2], walls[:, 2:]) > 0.1] = np.inf
    return off.min(axis=1), off.argmin(axis=1)


def plain_lines(bearing: F64, ranges: F64, rules: LineRules) -> list[tuple[float, int]]:
    """What the book's steps alone give: (length, points) of each line; segmentation, split, fit."""
    points = np.stack((ranges * np.cos(bearing), ranges * np.sin(bearing)), axis=-1)
    spacing = float(np.median(np.diff(bearing))) * rules.gap_beams
    found = []
    for cluster in segment_points(points, rules.gap_m, gap_per_m=spacing, smallest=rules.smallest).clusters:
        for run in split_at_end_points(points[cluster], rules.split_m):
            part = points[cluster][run]
            length = float(np.hypot(*(part[-1] - part[0])))
            if len(part) >= rules.min_points and length >= rules.min_length_m:
                found.append((length, len(part)))
    return found


def test_an_empty_room_is_four_lines() -> None:
    walls = ROOM[:4]
    lines = extract_lines(TURN, cast(walls, Pose2(), TURN))
    assert len(lines) == 4
    angle, distance, covariance = lines.parameters()
    found = sorted(zip(np.round(np.degrees(angle)).astype(int) % 360, np.round(distance, 6)))
    assert found == [(0, 4.0), (90, 3.0), (180, 3.0), (270, 2.0)]
    assert np.all(lines.rms_m < 1e-7)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert np.sum(lines.length_m) > 23.5


def test_free_space_is_to_the_right() -> None:
    for bearing in (BEARING, BEARING[::-1]):
        lines = extract_lines(bearing, cast(ROOM, Pose2(), bearing))
        way = lines.end_m - lines.start_m
        to_sensor = -lines.start_m
        assert np.all(way[:, 0] * to_sensor[:, 1] - way[:, 1] * to_sensor[:, 0] < 0.0)


def test_a_falling_scan_gives_the_same_lines_and_its_own_beam_numbers() -> None:
    ranges = cast(ROOM, Pose2(), BEARING) + np.random.default_rng(1).normal(0.0, 0.008, BEARING.size)
    rising, falling = extract_lines(BEARING, ranges), extract_lines(BEARING[::-1], ranges[::-1])
    np.testing.assert_array_equal(rising.rows, falling.rows)
    np.testing.assert_array_equal(rising.beams, BEARING.size - 1 - falling.beams)
    for (first, last), count in zip(rising.beams, rising.count):
        assert 0 <= first < last < BEARING.size
        assert count <= last - first + 1


def test_kernel_and_book_form_agree_on_weights_and_covariance() -> None:
    """The fast fit against regression_line with the same sigmas, from the points it says it used."""
    rules = LineRules(sigma_m=0.01, sigma_per_m=0.002, bearing_sigma_rad=0.002)
    ranges = cast(ROOM[:4], Pose2(), BEARING) + np.random.default_rng(2).normal(0.0, 0.01, BEARING.size)
    lines = extract_lines(BEARING, ranges, rules)
    angle, distance, covariance = lines.parameters()
    points = np.stack((ranges * np.cos(BEARING), ranges * np.sin(BEARING)), axis=-1)
    whole = 0
    for k, (first, last) in enumerate(lines.beams):
        if lines.count[k] != last - first + 1:  # ends were left out
            continue
        whole += 1
        part, r = points[first : last + 1], ranges[first : last + 1]
        rough = regression_line(part)
        cosine = np.cos(BEARING[first : last + 1] - rough.angle_rad)
        sigma = np.sqrt(
            ((0.01 + 0.002 * r) * cosine) ** 2 + (r * 0.002) ** 2 * (1.0 - cosine**2) + rules.flat_m**2
        )  # fmt: skip
        line = regression_line(part, sigma_m=sigma)
        assert distance[k] == pytest.approx(line.distance_m, abs=1e-9)
        assert math.cos(angle[k] - line.angle_rad) == pytest.approx(1.0)
        scale = max(1.0, line.sum_of_squares / (len(part) - 2))
        np.testing.assert_allclose(covariance[k], line.covariance * scale, rtol=1e-6)
    assert whole >= 2


def test_covariance_is_what_noise_scatters() -> None:
    """800 scans of one wall: angle and distance vary as their covariance says (15 %: about 3 sigma of the estimate)."""
    rules = LineRules(sigma_m=0.01, bearing_sigma_rad=1e-6, flat_m=0.0)
    bearing, random = np.radians(np.arange(-30.0, 45.1, 1.0)), np.random.default_rng(3)
    extractor, clean = LineExtractor(bearing, rules), 2.0 / np.cos(bearing)
    found, said = [], []
    for _ in range(800):
        lines = extractor.extract(clean + random.normal(0.0, 0.01, bearing.size))
        assert len(lines) == 1
        if lines.count[0] == bearing.size:
            angle, distance, covariance = lines.parameters()
            found.append((angle[0], distance[0]))
            said.append(covariance[0])
    observed, predicted = np.cov(np.array(found).T), np.mean(said, axis=0)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert len(found) > 600
    np.testing.assert_allclose(observed / scale, predicted / scale, atol=0.15)


def test_walls_are_hit_to_two_millimetres_and_none_is_missed() -> None:
    """8 mm of noise, 1081 beams. A wall counts as visible if a plain split of the scan without noise finds it, with 9
    points and half a metre."""
    errors, found, plain, fewer = [], 0, 0, 0
    extractor = LineExtractor(BEARING, LineRules(sigma_m=0.008))
    for seed in range(40):
        walls, pose = office(seed)
        clean = cast(walls, pose, BEARING)
        lines = extractor.extract(clean + np.random.default_rng(seed).normal(0.0, 0.008, BEARING.size))
        big = lines.chosen((lines.count >= 9) & (lines.length_m >= 0.5)).transformed(pose)
        error, _ = wall_error(big, walls)
        errors.append(error)
        visible = sum(n >= 9 and length >= 0.5 for length, n in plain_lines(BEARING, clean, extractor.rules))
        found, plain, fewer = found + len(big), plain + visible, fewer + (len(big) < visible)
    error = np.concatenate(errors)
    assert np.all(np.isfinite(error))
    assert float(error.mean()) <= 0.002
    assert float(np.quantile(error, 0.95)) <= 0.006
    assert found >= 0.99 * plain
    assert fewer <= 3


def test_noise_does_not_cut_walls() -> None:
    """Neighbours that the end point fit cuts by chance are joined: one wall is one line in every scan."""
    bearing = np.radians(np.arange(-60.0, 60.01, 0.25))
    rules = LineRules(sigma_m=0.012, split_m=0.03, split_sigmas=0.0)
    random = np.random.default_rng(8)
    pieces, cut = 0, 0
    for _ in range(50):
        ranges = 2.0 / np.cos(bearing) + random.normal(0.0, 0.012, bearing.size)
        pieces += len(extract_lines(bearing, ranges, rules))
        cut += len(plain_lines(bearing, ranges, rules))
    assert cut > 80  # the test would be none if the plain split did not cut
    assert pieces <= 52


def test_a_step_in_a_wall_is_two_lines() -> None:
    walls = np.array([(2.0, -3.0, 2.0, 0.0), (2.0, 0.0, 2.15, 0.0), (2.15, 0.0, 2.15, 3.0)])
    bearing = np.radians(np.arange(-50.0, 50.01, 0.25))
    ranges = cast(walls, Pose2(0.0, 0.5, 0.0), bearing) + np.random.default_rng(4).normal(0.0, 0.005, bearing.size)
    lines = extract_lines(bearing, ranges, LineRules(sigma_m=0.005))
    _, distance, _ = lines.parameters()
    assert sorted(np.round(distance, 2)) == [2.0, 2.15]


def test_ends_are_shifted_onto_the_line() -> None:
    lines = extract_lines(BEARING, cast(ROOM, Pose2(), BEARING) + 0.005 * np.sin(50.0 * BEARING))
    angle, distance, _ = lines.parameters()
    normal = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    for ends in (lines.start_m, lines.end_m):
        np.testing.assert_allclose(np.sum(ends * normal, axis=1), distance, atol=1e-9)


def test_what_is_no_measurement_is_no_point() -> None:
    clean = cast(ROOM[:4], Pose2(), BEARING)
    with_gaps = clean.copy()
    for k, nothing in enumerate((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300)):
        with_gaps[2 * k + 1 :: 12] = nothing
    thin, whole = extract_lines(BEARING, with_gaps), extract_lines(BEARING, clean)
    assert len(thin) == len(whole) == 3
    assert thin.count.sum() <= BEARING.size // 2 + 1
    np.testing.assert_allclose(thin.parameters()[1], whole.parameters()[1], atol=1e-3)
    limited = extract_lines(BEARING, clean, range_min_m=2.5, range_max_m=3.2)
    ends = np.concatenate((limited.start_m, limited.end_m))
    assert np.all((np.hypot(*ends.T) > 2.4) & (np.hypot(*ends.T) < 3.3))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, -3.0, 1e6, 1e300])
def test_scans_without_a_point_have_no_lines(value: float) -> None:
    lines = extract_lines(BEARING, np.full(BEARING.size, value))
    assert len(lines) == 0
    assert lines.parameters()[2].shape == (0, 2, 2)
    assert len(lines.transformed(Pose2(1.0, 2.0, 3.0))) == 0


def test_odd_inputs() -> None:
    assert len(extract_lines([], [])) == 0
    assert len(extract_lines([0.0], [1.0])) == 0
    assert len(extract_lines([0.0, 0.1], [1.0, 1.0])) == 0
    assert len(extract_from_points([])) == 0
    assert len(extract_from_points([[1.0, 1.0]])) == 0
    assert len(extract_from_points([[1.0, 1.0]] * 500, full_turn=True)) == 0
    many = extract_from_points(np.stack((np.full(50000, 2.0), np.linspace(-9.0, 9.0, 50000)), axis=-1))
    assert many.count.tolist() == [50000]
    for points in ([1.0], [[1.0, 2.0, 3.0]], [[math.nan, 1.0], [0.0, 1.0]], [[1e9, 0.0], [0.0, 1.0]]):
        with pytest.raises(ValueError, match="points"):
            extract_from_points(points)
    with pytest.raises(ValueError, match="range_m"):
        extract_lines(BEARING, np.ones(5))
    for bearing in ([0.0, 0.0, 0.1], [0.0, 0.2, 0.1], [0.0, 7.0], [math.nan, 1.0], [[0.0, 0.1]]):
        with pytest.raises(ValueError, match="bearing_rad"):
            LineExtractor(bearing)
    with pytest.raises(ValueError, match="range_max_m"):
        LineExtractor(BEARING, range_min_m=2.0, range_max_m=1.0)


@pytest.mark.parametrize(
    "wrong",
    [{"gap_m": math.nan}, {"split_m": -1.0}, {"sigma_m": 0.0}, {"min_points": 1}, {"gap_m": 0.0, "gap_beams": 0.0}],
)
def test_rules_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LineRules(**wrong)  # type: ignore[arg-type]


def test_cost_does_not_explode_on_circles() -> None:
    """Every point of a circle far outside any tolerance is a corner; 20,000 of them still end."""
    angle = np.linspace(-3.0, 3.0, 20000)
    lines = extract_lines(angle, np.full(angle.size, 5.0), LineRules(split_m=1e-6, split_sigmas=0.0, gap_m=1.0))
    assert len(lines) < 20000


# ------------------------------------------------------------------------------------------------------ recorded scans


def wall_points(points: F64) -> NDArray[np.bool_]:
    """Which points of a scan lie on a wall, by no means of ours: those whose neighbours along the scan, within 0.4 m
    both ways, are at least five, span half a metre and stray less than 2 cm (rms, SVD) from a line."""
    n = len(points)
    gap = np.hypot(*np.diff(points, axis=0).T)
    on_wall = np.zeros(n, dtype=bool)
    for j in range(n):
        low = high = j
        while low > 0 and gap[low - 1] < 0.4 and math.dist(points[low - 1], points[j]) < 0.4:
            low -= 1
        while high < n - 1 and gap[high] < 0.4 and math.dist(points[high + 1], points[j]) < 0.4:
            high += 1
        part = points[low : high + 1]
        if len(part) >= 5 and math.dist(part[0], part[-1]) >= 0.5:
            across = float(np.linalg.svd(part - part.mean(axis=0), compute_uv=False)[1])
            on_wall[j] = across / math.sqrt(len(part)) < 0.02
    return on_wall


@pytest.mark.data
@needs_data
@pytest.mark.parametrize("name", LOGS)
def test_recorded_walls_are_explained(name: str) -> None:
    """Median distance of supporting points at most 1.5 cm, 90 % of the wall points within 5 cm of a line."""
    log = read_log(Path(DATA) / "known_pose_logs" / f"{name}-corrected.log.gz")
    extractor = LineExtractor(log.scans[0].bearing_rad, range_max_m=log.range_max_m)
    distances, walls, explained = [], 0, 0
    for scan in log.scans[::8]:
        lines = extractor.extract(scan.range_m)
        seen = np.isfinite(scan.range_m)
        r, a = scan.range_m[seen], scan.bearing_rad[seen]
        points = np.stack((r * np.cos(a), r * np.sin(a)), axis=-1)
        on_wall = wall_points(points)
        walls += int(on_wall.sum())
        if not len(lines):
            continue
        away = lines.distance_to(points)
        explained += int((on_wall & (away.min(axis=1) < 0.05)).sum())
        number = np.cumsum(seen) - 1
        distances += [away[number[first] : number[last] + 1, k] for k, (first, last) in enumerate(lines.beams)]
    assert walls > 1500
    assert explained >= 0.9 * walls
    assert float(np.median(np.concatenate(distances))) <= 0.015
