"""Rectangular sector maps: nearest obstacle by square, and which squares were seen whole (S36)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.kernels import sectors as kernels
from mapping.sectors.footprint import Outline
from mapping.sectors.rectangular import RectSectors, _Raster
from mapping.sectors.sight import Sight, star_of_beams
from mapping.sectors.snapshot import RectSnapshot, SectorState

F64 = NDArray[np.float64]
OBSTACLE, FREE, UNKNOWN, STALE = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE
BEARING = np.deg2rad(np.arange(720) * 0.5)
BODY = [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]]


def sweep(sectors: RectSectors, range_m: F64, *, mount: Pose2 = IDENTITY, stamp_ns: int = 0) -> None:
    sectors.update_beams(
        "laser",
        base_from_sensor=mount,
        bearing_rad=BEARING[: len(range_m)],
        range_m=range_m,
        range_min_m=0.05,
        range_max_m=30.0,
        stamp_ns=stamp_ns,
    )


def cell(snapshot: RectSnapshot, x: float, y: float) -> tuple[int, int]:
    return (
        int(np.searchsorted(snapshot.y_edges_m, y, side="right")) - 1,
        int(np.searchsorted(snapshot.x_edges_m, x, side="right")) - 1,
    )


def test_raster_is_centred_and_ascending() -> None:
    snapshot = RectSectors(sources=("laser",), size_m=(4.0, 2.1), sector_m=0.25).snapshot(0)
    assert snapshot.state.shape == (9, 16)
    assert snapshot.x_edges_m[0] == -2.0
    assert snapshot.x_edges_m[-1] == 2.0
    assert snapshot.y_edges_m[0] == -1.125
    assert (snapshot.state == UNKNOWN).all()


def test_no_return_frees_every_square() -> None:
    sectors = RectSectors(sources=("laser",))
    sweep(sectors, np.full(720, np.inf))
    assert (sectors.snapshot(0).state == FREE).all()


def test_a_wall_is_met_and_what_is_behind_it_unknown() -> None:
    sectors = RectSectors(sources=("laser",))
    with np.errstate(divide="ignore"):
        ranges = np.where(np.cos(BEARING) > 0.05, 1.1 / np.cos(BEARING), np.inf)
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    row, col = cell(snapshot, 1.1, 0.1)
    assert (snapshot.state[:, col] == OBSTACLE).all()
    np.testing.assert_allclose(snapshot.x_m[:, col], 1.1)
    assert (np.abs(snapshot.y_m[row, col]) <= 0.25).all()
    assert (snapshot.state[:, col + 1 :] == UNKNOWN).all()
    assert (snapshot.state[:, :col] == FREE).all()


def test_the_nearest_point_of_a_square_is_kept() -> None:
    sectors = RectSectors(sources=("laser",), sector_m=1.0)
    ranges = np.full(720, np.nan)
    ranges[:20] = np.linspace(1.9, 1.2, 20)
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    row, col = cell(snapshot, 1.2, 0.2)
    assert math.hypot(snapshot.x_m[row, col], snapshot.y_m[row, col]) == pytest.approx(1.2)


def test_one_invalid_beam_spoils_the_squares_it_crosses_only() -> None:
    sectors = RectSectors(sources=("laser",))
    ranges = np.full(720, np.inf)
    ranges[30] = np.nan  # 15 degrees
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    along = np.linspace(0.01, 2.0, 200)
    crossed = {cell(snapshot, r * math.cos(math.radians(15.0)), r * math.sin(math.radians(15.0))) for r in along}
    for row, col in crossed:
        assert snapshot.state[row, col] == UNKNOWN
    assert (snapshot.state[:, :7] == FREE).all()
    assert (snapshot.state == UNKNOWN).sum() <= len(crossed) + 6


def test_the_vehicle_needs_no_looking_at() -> None:
    sectors = RectSectors(sources=("laser",), footprint=BODY)
    # a laser on the right front corner that cannot see through the vehicle: 270 degrees
    ranges = np.full(720, np.inf)
    ranges[(math.radians(100.0) < BEARING) & (math.radians(170.0) > BEARING)] = np.nan
    sweep(sectors, ranges, mount=Pose2(0.44, -0.29, 0.0))
    snapshot = sectors.snapshot(0)
    assert snapshot.state[cell(snapshot, 0.0, 0.0)] == UNKNOWN  # under it
    assert snapshot.state[cell(snapshot, 0.5, -0.5)] == FREE
    assert snapshot.state[cell(snapshot, 1.0, 1.0)] == FREE
    assert snapshot.state[cell(snapshot, -1.0, 0.7)] == UNKNOWN  # behind it
    assert snapshot.state[cell(snapshot, 0.45, -0.20)] == FREE  # half under it


def test_an_echo_is_an_obstacle_in_every_square_of_its_arc() -> None:
    sectors = RectSectors(sources=("sonar",))
    sectors.update_cone(
        "sonar",
        0,
        base_from_transducer=Pose2(0.0, 0.0, math.pi / 2.0),
        cone_rad=math.radians(60.0),
        range_m=1.6,
        range_min_m=0.1,
        range_max_m=3.0,
        stamp_ns=0,
    )
    snapshot = sectors.snapshot(0)
    angle = math.pi / 2.0 + np.linspace(-math.radians(29.9), math.radians(29.9), 500)
    arc = {cell(snapshot, 1.6 * math.cos(a), 1.6 * math.sin(a)) for a in angle}
    hit = set(zip(*(i.tolist() for i in np.nonzero(snapshot.state == OBSTACLE))))
    assert arc <= hit
    assert len(hit) <= len(arc) + 2
    assert snapshot.state[cell(snapshot, 0.01, 0.6)] == FREE  # well before the echo, within the cone
    assert snapshot.state[cell(snapshot, 0.01, 1.1)] == UNKNOWN  # nearer to the echo than half its distance
    assert snapshot.state[cell(snapshot, 1.0, 0.1)] == UNKNOWN


def test_lost_and_old_squares_are_stale() -> None:
    sectors = RectSectors(sources=("laser",), stale_after_ns=100)
    sweep(sectors, np.full(720, 1.0))
    seen = sectors.snapshot(50).state.copy()
    old = sectors.snapshot(101)
    assert ((old.state == STALE) == (seen != UNKNOWN)).all()
    sweep(sectors, np.full(720, 1.0), stamp_ns=102)
    assert (sectors.snapshot(102).state == seen).all()
    sectors.lost("laser")
    assert not (sectors.snapshot(102).state == FREE).any()


def test_an_obstacle_stays_where_the_next_scan_is_blind() -> None:
    sectors = RectSectors(sources=("laser",))
    ranges = np.full(720, np.inf)
    ranges[30] = 1.0
    sweep(sectors, ranges)
    ranges[30] = np.nan
    sweep(sectors, ranges, stamp_ns=1)
    snapshot = sectors.snapshot(1)
    at = cell(snapshot, math.cos(math.radians(15.0)), math.sin(math.radians(15.0)))
    assert snapshot.state[at] == OBSTACLE
    ranges[30] = np.inf
    sweep(sectors, ranges, stamp_ns=2)
    assert sectors.snapshot(2).state[at] == FREE


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("sweep"), st.integers(0, 719), st.integers(0, 300), st.floats(0.2, 3.0)),
            st.tuples(st.just("cone"), st.integers(0, 2), st.just(0), st.sampled_from([0.4, 1.0, math.inf, math.nan])),
            st.tuples(st.just("lost"), st.sampled_from([0, 1]), st.just(0), st.just(0.0)),
        ),
        min_size=1,
        max_size=12,
    )
)
@settings(max_examples=60, deadline=None)
def test_a_snapshot_looked_into_later_says_what_was_known_then(steps: list[tuple[str, int, int, float]]) -> None:
    at_once, later = (RectSectors(sources=("laser", "sonar"), stale_after_ns=300, footprint=BODY) for _ in range(2))
    kept: list[tuple[RectSnapshot, RectSnapshot]] = []
    for number, (kind, first, count, value) in enumerate(steps):
        stamp_ns = 100 * number
        for sectors in (at_once, later):
            if kind == "sweep":  # a wall all around, and some beams that saw nothing or are lost
                ranges = np.full(720, value)
                ranges[first : first + count] = np.nan if count % 2 else np.inf
                sweep(sectors, ranges, stamp_ns=stamp_ns)
            elif kind == "cone":
                sectors.update_cone(
                    "sonar", first, base_from_transducer=Pose2(0.0, 0.0, first - 1.0), cone_rad=1.0, range_m=value,
                    range_min_m=0.2, range_max_m=2.0, stamp_ns=stamp_ns,
                )  # fmt: skip
            else:
                sectors.lost(("laser", "sonar")[first])
        now, then = at_once.snapshot(stamp_ns), later.snapshot(stamp_ns)
        assert now.state.shape == then.shape
        kept.append((now, then))
    for now, then in kept:
        for name in ("state", "x_m", "y_m", "age_ns", "source"):
            np.testing.assert_array_equal(getattr(then, name), getattr(now, name), name)


def test_nothing_is_worked_out_for_a_map_that_nobody_looks_into(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Sight] = []
    free = _Raster.free

    def counted(raster: _Raster, sight: Sight) -> F64:
        asked.append(sight)
        return free(raster, sight)

    monkeypatch.setattr(_Raster, "free", counted)
    sectors = RectSectors(sources=("laser",))
    for number in range(5):
        sweep(sectors, np.full(720, 1.0), stamp_ns=number)
        snapshot = sectors.snapshot(number)
    assert not asked
    assert snapshot.state[cell(snapshot, 0.5, 0.1)] == FREE
    assert snapshot.state is snapshot.state
    assert len(asked) == 1


@pytest.mark.parametrize(("size", "edge"), [((0.0, 1.0), 0.1), ((1.0, 1.0), 0.0), ((1e5, 1e5), 0.1)])
def test_impossible_rasters_are_refused(size: tuple[float, float], edge: float) -> None:
    with pytest.raises(ValueError):
        RectSectors(sources=("laser",), size_m=size, sector_m=edge)


@given(
    st.integers(1, 60),
    st.floats(-0.6, 0.6),
    st.floats(-3.2, 3.2),
    st.integers(0, 10_000),
)
@settings(max_examples=150, deadline=None)
def test_free_squares_are_those_no_border_passes_and_whose_corners_are_seen(
    beams: int, x_m: float, yaw_rad: float, seed: int
) -> None:
    """Square by square, from the star's border and its inside alone."""
    rng = np.random.default_rng(seed)
    bearing = np.sort(rng.uniform(-3.0, 3.0, beams))
    ranges = rng.choice([0.0, 0.4, 1.0, 2.5, math.inf], beams) * rng.uniform(0.5, 1.0)
    sight = Sight(Pose2(x_m, 0.1, yaw_rad), star_of_beams(bearing, ranges, range_max_m=3.0, spacing_rad=0.1))
    edges = np.linspace(-1.0, 1.0, 9)
    outline = Outline([[0.3, 0.2], [-0.4, 0.2], [-0.4, -0.2], [0.3, -0.2]], Pose2())
    free = _Raster(edges, edges, 0.25, outline).free(sight).reshape(8, 8)
    border = sight.border()
    passes = np.zeros((8, 8), dtype=bool)
    if len(border):
        closed = np.ascontiguousarray(np.vstack((border, border[:1])))
        reach = float(np.hypot(outline.polygon[:, 0], outline.polygon[:, 1]).max())
        passes = np.isfinite(kernels.line_through_cells(closed, -1.0, -1.0, 0.25, 8, 8, outline.polygon, reach)[0])
    for row in range(8):
        for col in range(8):
            corners = np.array([[edges[col + i], edges[row + j]] for j in (0, 1) for i in (0, 1)])
            points = np.vstack((corners, corners.mean(axis=0)))
            covered = outline.contains(points)
            whole = bool((sight.contains(points) | covered).all()) and not covered.all() and not passes[row, col]
            assert (free[row, col] > 0.0) == whole
            assert free[row, col] in (0.0, pytest.approx(np.hypot(corners[:, 0], corners[:, 1]).max()))
