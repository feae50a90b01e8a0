"""The octree of voxels against a literal dictionary of voxels (S32): insertion, queries, merging, bytes, bounds."""

from __future__ import annotations

import math
import struct
import zlib
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.grids.evidence import FREE, OCCUPIED, PARTLY_FREE, UNKNOWN
from mapping.grids.octree import HALF, HEADER, Octree, VoxelRules
from mapping.kernels import octree_ends as ends
from mapping.kernels import octree_rays as rays

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Voxel = tuple[int, int, int]
D = 0.1
HIT, MISS, LOWEST, HIGHEST = 17, -8, -40, 70  # steps of 0.05, of the rules' defaults


def passed(origin: F64, end: F64) -> set[Voxel]:
    """Voxels that hold some of the way from origin to end, in voxels: the middles between all borders crossed."""
    way = end - origin
    borders = [0.0, 1.0]
    for axis in range(3):
        low, high = sorted((origin[axis], end[axis]))
        if way[axis] != 0.0:
            borders += [(k - origin[axis]) / way[axis] for k in range(math.ceil(low), math.floor(high) + 1)]
    borders = sorted(t for t in borders if 0.0 <= t <= 1.0)
    middles = [(a + b) / 2 for a, b in pairwise(borders) if b - a > 1e-12]
    return {voxel_of(origin + way * t) for t in middles}


def voxel_of(place: F64) -> Voxel:
    x, y, z = np.floor(place).astype(int)
    return int(x), int(y), int(z)


class Literal:
    """What the octree should hold: steps of log-odds by voxel."""

    def __init__(self) -> None:
        self.steps: dict[Voxel, int] = {}

    def insert(self, origin_m: F64, points_m: F64) -> None:
        hits = {voxel_of(point / D) for point in points_m}
        free = set().union(*(passed(origin_m / D, point / D) - {voxel_of(point / D)} for point in points_m))
        for voxel in free - hits:
            self.add(voxel, MISS)
        for voxel in hits:
            self.add(voxel, HIT)

    def add(self, voxel: Voxel, steps: int) -> None:
        self.steps[voxel] = min(max(self.steps.get(voxel, 0) + steps, LOWEST), HIGHEST)


def check(octree: Octree, literal: Literal) -> None:
    """The same voxels, the same values, and nothing else known."""
    voxels = np.array(list(literal.steps))
    wanted = 0.05 * np.array(list(literal.steps.values()))
    assert octree.log_odds_at((voxels + 0.5) * D) == pytest.approx(wanted)
    whole = octree.count_in((-HALF,) * 3, (HALF,) * 3)
    assert whole.free + whole.partly_free + whole.occupied == len(voxels)
    assert whole.unknown == (2 * HALF) ** 3 - len(voxels)


def clouds(seed: int, count: int, points: int = 25) -> list[tuple[F64, F64]]:
    """Clouds around the origin: rays cross all eight octants; some come twice, some are flat or parallel to an axis."""
    rng = np.random.default_rng(seed)
    made: list[tuple[F64, F64]] = []
    for k in range(count):
        if made and rng.random() < 0.3:
            made.append(made[rng.integers(len(made))])
            continue
        origin, ends = rng.normal(0.0, 0.6, 3), rng.normal(0.0, 1.5, (points, 3))
        if k % 3 == 1:
            ends[:, 2] = origin[2]
            ends[::4, 1] = origin[1]
        made.append((origin, ends))
    return made


def filled(seed: int, count: int) -> Octree:
    octree = Octree(resolution_m=D)
    for origin, points in clouds(seed, count):
        octree.insert(origin, points)
    return octree


# ------------------------------------------------------------------------------------------------------------ taking in


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_every_ray_marks_what_it_passes_and_every_voxel_counts_once(seed: int, count: int) -> None:
    octree, literal = Octree(resolution_m=D), Literal()
    for origin, points in clouds(seed, count):
        octree.insert(origin, points)
        literal.insert(origin, points)
    check(octree, literal)


def dense_cloud(origin: F64, seed: int) -> F64:
    """So many points that most bricks near the sensor have nothing left to mark and are passed in one step."""
    way = np.random.default_rng(seed).normal(0.0, 1.0, (1500, 3))
    return np.asarray(origin + 2.2 * way / np.linalg.norm(way, axis=1)[:, None])


def test_many_rays_in_full_bricks_mark_no_more_and_no_less() -> None:
    octree, literal = Octree(resolution_m=D), Literal()
    for k, origin in enumerate((np.array([0.05, 0.05, 0.05]), np.array([-0.8, 0.31, 0.0]))):
        octree.insert(origin, dense_cloud(origin, k))
        literal.insert(origin, dense_cloud(origin, k))
    check(octree, literal)


def test_rays_through_corners_pass_the_same_voxels_alone_and_in_a_crowd() -> None:
    """A ray through a corner passes one of two neighbours: the same one whether its bricks are full or not."""
    rng = np.random.default_rng(4)
    origin = np.array([0.8, 0.4, -0.4])
    crowd, corners = dense_cloud(origin, 3), np.round(rng.normal(0.0, 1.5, (200, 3)) / 0.4) * 0.4
    alone = known_after(origin, crowd).union(*(known_after(origin, point[None, :]) for point in corners))
    assert known_after(origin, np.concatenate((crowd, corners))) == alone


def known_after(origin: F64, points: F64) -> set[Voxel]:
    """Voxels that a fresh octree knows after these rays without echo."""
    octree = Octree(resolution_m=D)
    octree.insert(origin, points, is_hit=np.zeros(len(points), dtype=np.bool_))
    z, y, x = np.nonzero(octree.states_in((-40, -40, -40), (40, 40, 40)) != UNKNOWN)
    return {voxel_of(v) for v in np.stack((x, y, z), axis=-1).astype(float) - 40}


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_a_clouds_points_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = Octree(resolution_m=D), Octree(resolution_m=D)
    for origin, points in clouds(seed, 3):
        one.insert(origin, points)
        other.insert(np.broadcast_to(origin, points.shape), points[rng.permutation(len(points))])
    assert one.to_bytes() == other.to_bytes()


def test_repeated_evidence_saturates_and_turns() -> None:
    octree = Octree(resolution_m=D)
    wall, ahead = [(2.05, 0.05, 0.05)], [(1.05, 0.05, 0.05)]
    for _ in range(10):
        octree.insert((0.05, 0.05, 0.05), wall)
    assert octree.state_at(wall + ahead).tolist() == [OCCUPIED, FREE]
    assert octree.log_odds_at(wall + ahead).tolist() == pytest.approx([3.5, -2.0])
    for _ in range(12):
        octree.insert((0.05, 0.05, 0.05), [(3.05, 0.05, 0.05)])
    assert octree.state_at(wall).tolist() == [FREE]
    for _ in range(3):
        octree.insert((0.05, 0.05, 0.05), ahead)
    assert octree.state_at(ahead).tolist() == [PARTLY_FREE]
    assert octree.state_at([(2.05, 0.25, 0.05)]).tolist() == [UNKNOWN]


def test_long_rays_are_cut_and_rays_without_an_echo_put_no_obstacle() -> None:
    octree = Octree(resolution_m=D)
    octree.insert((0.0, 0.05, 0.05), [(5.0, 0.05, 0.05)], range_max_m=2.0)
    octree.insert((0.0, 0.05, 1.05), [(1.55, 0.05, 1.05)], is_hit=[False])
    at = [(1.95, 0.05, 0.05), (2.05, 0.05, 0.05), (5.0, 0.05, 0.05), (1.45, 0.05, 1.05), (1.55, 0.05, 1.05)]
    assert octree.state_at(at).tolist() == [FREE, UNKNOWN, UNKNOWN, FREE, UNKNOWN]


def test_whether_one_ray_met_something_says_nothing_of_the_others() -> None:
    ends = [(1.55, 0.05, 0.05), (0.05, 1.55, 0.05), (0.05, 0.05, 1.55), (0.05, 1.55, 0.05)]
    for echo in ([False, True, False, False], [True, False, True, False]):
        octree = Octree(resolution_m=D)
        octree.insert((0.05, 0.05, 0.05), ends, is_hit=echo)
        met = [echo[0], echo[1] or echo[3], echo[2]]
        assert octree.state_at(ends[:3]).tolist() == [OCCUPIED if one else UNKNOWN for one in met]


def test_points_that_say_nothing_are_counted_and_change_nothing() -> None:
    octree = Octree(resolution_m=D)
    octree.insert((0.0, 0.0, 0.0), [(np.nan, 0, 0), (np.inf, 0, 0), (0, 1e300, 0), (0, 0, -HALF * D - 1.0)])
    origins = [(0.0, 0.0, 0.0), (np.nan, 0.0, 0.0)]
    octree.insert(origins, [(np.nan, 0.0, 1.0), (1.0, 0.0, 0.0)])
    assert octree.rejected_points == 6
    assert octree.bricks == 0
    octree.insert((0.0, 0.0, 0.0), np.zeros((0, 3)))
    assert octree.count_in((-5, -5, -5), (5, 5, 5)).unknown == 1000


def test_a_full_tree_refuses_rays_and_says_so() -> None:
    octree = Octree(resolution_m=D, max_bricks=3)
    octree.insert((0.05, 0.05, 0.05), [(0.3, 0.05, 0.05), (9.05, 0.05, 0.05), (-9.0, 0.3, 0.05), (0.05, 0.05, 9.0)])
    assert octree.refused_rays == 3
    assert octree.bricks <= 3
    at = [(5.0, 0.05, 0.05), (0.2, 0.05, 0.05), (0.05, 0.05, 9.0), (0.05, 0.05, 0.35)]
    assert octree.state_at(at).tolist() == [UNKNOWN, FREE, UNKNOWN, UNKNOWN]


def test_a_full_tree_learns_on_in_the_bricks_it_has() -> None:
    octree = Octree(resolution_m=D, max_bricks=2)
    octree.insert((0.05, 0.05, 0.05), [(0.45, 0.05, 0.05), (0.85, 0.05, 0.05)])
    for _ in range(3):
        octree.insert((0.05, 0.05, 0.05), [(0.65, 0.05, 0.05)])
    assert octree.refused_rays == 0
    assert octree.state_at([(0.45, 0.05, 0.05), (0.65, 0.05, 0.05), (0.85, 0.05, 0.05)]).tolist() == [
        FREE, OCCUPIED, OCCUPIED,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("origin", "points", "options"),
    [
        ((0, 0), [(1, 1, 1)], {}),
        ((0, 0, 0), [(1, 1)], {}),
        ((0, 0, 0), [1, 2, 3], {}),
        ((np.nan, 0, 0), [(1, 1, 1)], {}),
        ((0, 0, 1e9), [(1, 1, 1)], {}),
        ((0, 0, 0), [(1, 1, 1)], {"range_max_m": 0.0}),
        ((0, 0, 0), [(1, 1, 1)], {"range_max_m": math.nan}),
        ((0, 0, 0), [(1, 1, 1)], {"is_hit": [True, False]}),
        ([(0, 0, 0), (0, 0, 0)], [(1, 1, 1)], {}),
    ],
)
def test_bad_clouds_are_refused(origin: object, points: object, options: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        Octree().insert(origin, points, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options", [{"hit_log_odds": 0.0}, {"lowest_log_odds": 1.0}, {"highest_log_odds": 9.0}, {"free_below": 0.9}]
)
def test_rules_that_make_no_sense_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        VoxelRules(**options)


# ------------------------------------------------------------------------------------------------------------ answering


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1))
def test_a_box_says_what_its_voxels_say(seed: int) -> None:
    octree = filled(seed, 3)
    rng = np.random.default_rng(seed)
    low = rng.integers(-25, 15, 3)
    sides = rng.integers(0, 20, 3)
    box = ((int(low[0]), int(low[1]), int(low[2])), tuple(int(v) for v in low + sides))
    states = octree.states_in(box[0], (box[1][0], box[1][1], box[1][2]))
    z, y, x = np.indices(states.shape).reshape(3, -1)
    centres = (np.stack((x, y, z), axis=-1) + low + 0.5) * D
    assert np.array_equal(states.ravel(), octree.state_at(centres))
    counts = octree.count_in(box[0], (box[1][0], box[1][1], box[1][2]))
    kinds = [np.count_nonzero(states == kind) for kind in (UNKNOWN, FREE, PARTLY_FREE, OCCUPIED)]
    assert [counts.unknown, counts.free, counts.partly_free, counts.occupied] == kinds


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1))
def test_a_ray_runs_to_the_first_voxel_that_is_not_free(seed: int) -> None:
    octree = filled(seed, 4)
    rng = np.random.default_rng(seed)
    origin, way = rng.normal(0.0, 0.5, (20, 3)), rng.normal(0.0, 1.0, (20, 3))
    way[::5, 1:] = 0.0
    length, state = octree.cast(origin, way, range_max_m=3.0)
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    for k in range(20):
        along = np.arange(0.0, 3.0, 0.003)
        seen = octree.state_at(origin[k] + along[:, None] * unit[k])
        blocked = np.flatnonzero(seen != FREE)
        if state[k] == FREE:
            assert length[k] == 3.0
            assert len(blocked) == 0
        else:
            # Samples 3 mm apart may jump over a corner, the walk does not.
            assert len(blocked) == 0 or length[k] <= along[blocked[0]] + 1e-9
            assert octree.state_at([origin[k] + (length[k] + 1e-9) * unit[k]])[0] in (state[k], FREE)
            assert np.all(seen[along < length[k] - 1e-9] == FREE)


def test_rays_end_unknown_where_nothing_is_known() -> None:
    octree = Octree(resolution_m=D)
    length, state = octree.cast([(0.0, 0.0, 0.0), (HALF * D + 5.0, 0.0, 0.0)], [(1, 0, 0), (1, 0, 0)], range_max_m=9.0)
    assert length.tolist() == [0.0, 0.0]
    assert state.tolist() == [UNKNOWN, UNKNOWN]
    for origin, way in (([(np.nan, 0, 0)], [(1, 0, 0)]), ([(0, 0, 0)], [(0, 0, 0)]), ([(0, 0, 0)], np.zeros((2, 3)))):
        with pytest.raises(ValueError):
            octree.cast(origin, way, range_max_m=1.0)


def test_questions_that_make_no_sense() -> None:
    octree = filled(1, 1)
    assert np.all(np.isnan(octree.log_odds_at([(np.nan, 0, 0), (np.inf, 0, 0), (1e300, 0, 0)])))
    with pytest.raises(ValueError, match="voxels"):
        octree.states_in((-HALF,) * 3, (HALF,) * 3)
    with pytest.raises(ValueError, match="box"):
        octree.count_in((0, 0, 0), (0, 0, HALF + 1))
    assert octree.states_in((3, 3, 3), (0, 5, 5)).shape == (2, 2, 0)


def test_occupied_voxels_are_those_that_say_so() -> None:
    octree = filled(5, 4)
    states = octree.states_in((-80, -80, -80), (80, 80, 80))
    z, y, x = np.nonzero(states == OCCUPIED)
    wanted = {tuple(v) for v in (np.stack((x, y, z), axis=-1) - 80).tolist()}
    found = [tuple(v) for v in octree.occupied_voxels().tolist()]
    assert len(found) == len(wanted)
    assert set(found) == wanted


# -------------------------------------------------------------------------------------------- pruning, merging, bytes


def block(state: str) -> Octree:
    """A cube of 16 x 16 x 16 voxels, all with one value: rays through every row of it."""
    octree = Octree(resolution_m=D)
    y, z = np.meshgrid(np.arange(16), np.arange(16))
    starts = np.stack((np.full(256, -0.05), (y.ravel() + 0.5) * D, (z.ravel() + 0.5) * D), axis=-1)
    for _ in range(6):
        octree.insert(starts, starts + [1.7, 0.0, 0.0], is_hit=np.zeros(256, dtype=np.bool_))
    if state == "mixed":
        octree.insert((0.85, 0.85, -0.5), [(0.85, 0.85, 0.75)])
    return octree


def test_a_region_of_one_value_is_one_entry() -> None:
    uniform, mixed = block("uniform"), block("mixed")
    assert uniform.count_in((0, 0, 0), (16, 16, 16)).free == 4096
    assert mixed.count_in((0, 0, 0), (16, 16, 16)).free == 4096  # at the bound, one hit is not enough
    assert uniform.bricks == mixed.bricks - 2  # the changed brick, and the ray's way to it
    assert uniform.leaf_count() < 300  # one for the cube, 256 for the layer before it
    before = mixed.to_bytes()
    mixed.prune()
    assert mixed.to_bytes() == before


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_merging_adds_the_evidence_voxel_by_voxel(seed: int, other_seed: int) -> None:
    one, other = filled(seed, 2), filled(other_seed, 3)
    box = ((-70, -70, -70), (70, 70, 70))
    centres = (np.argwhere(one.states_in(*box) != UNKNOWN)[:, ::-1] - 70 + 0.5) * D
    more = (np.argwhere(other.states_in(*box) != UNKNOWN)[:, ::-1] - 70 + 0.5) * D
    at = np.concatenate((centres, more))
    a, b = one.log_odds_at(at), other.log_odds_at(at)
    wanted = np.clip(np.nan_to_num(a) + np.nan_to_num(b), -2.0, 3.5)
    kept = other.to_bytes()
    one.merge(other)
    assert one.log_odds_at(at) == pytest.approx(wanted)
    assert one.count_in(*box).unknown == 140**3 - len(np.unique(np.floor(at / D), axis=0))
    assert other.to_bytes() == kept
    mirror = filled(other_seed, 3)
    mirror.merge(filled(seed, 2))
    assert mirror.to_bytes() == one.to_bytes()


def test_merging_regions_of_one_value_with_bricks_and_with_each_other() -> None:
    uniform, mixed = block("uniform"), block("mixed")
    uniform.merge(mixed)
    assert uniform.log_odds_at([(0.05, 0.05, 0.05), (0.85, 0.85, 0.75)]) == pytest.approx([-2.0, -2.0])
    mixed.merge(block("uniform"))
    assert mixed.to_bytes() == uniform.to_bytes()
    fresh = Octree(resolution_m=D)
    fresh.merge(block("mixed"))
    assert fresh.to_bytes() == block("mixed").to_bytes()


def test_trees_that_do_not_fit_are_not_merged() -> None:
    octree = filled(1, 2)
    before = octree.to_bytes()
    for other in (Octree(resolution_m=0.2), octree):
        with pytest.raises(ValueError, match="merge"):
            octree.merge(other)
    small = Octree(resolution_m=D, max_bricks=4)
    with pytest.raises(ValueError, match="max_bricks"):
        small.merge(octree)
    assert octree.to_bytes() == before


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_bytes_and_back(seed: int, count: int) -> None:
    octree = filled(seed, count)
    data = octree.to_bytes()
    again = Octree.from_bytes(data)
    assert again.to_bytes() == data
    assert again.resolution_m == D
    assert (again.bricks, again.leaf_count()) == (octree.bricks, octree.leaf_count())
    for origin, points in clouds(seed, 2):
        octree.insert(origin, points)
        again.insert(origin, points)
    assert again.to_bytes() == octree.to_bytes()


def repacked(data: bytes, *, size: int | None = None, body: bytes | None = None) -> bytes:
    """Other contents under a right checksum."""
    magic, version, resolution, tree, count, _ = HEADER.unpack_from(data)
    plain = zlib.decompress(data[HEADER.size :]) if body is None else body
    fields = (magic, version, resolution, tree if size is None else size, count)
    crc = zlib.crc32(plain, zlib.crc32(HEADER.pack(*fields, 0)))
    return HEADER.pack(*fields, crc) + zlib.compress(plain)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_mean_a_tree(data: st.DataObject) -> None:
    good = filled(2, 2).to_bytes()
    at = data.draw(st.integers(0, len(good) - 1))
    kind = data.draw(st.sampled_from(["flip", "cut", "inside"]))
    if kind == "flip":
        bad = good[:at] + bytes([good[at] ^ 1 << data.draw(st.integers(0, 7))]) + good[at + 1 :]
    elif kind == "cut":
        bad = good[:at]
    else:
        plain = bytearray(zlib.decompress(good[HEADER.size :]))
        at %= 400
        plain[at] = data.draw(st.integers(0, 255))
        bad = repacked(good, body=bytes(plain))
    try:
        octree = Octree.from_bytes(bad)
    except ValueError:
        return
    octree.insert((0.0, 0.0, 0.0), [(1.0, 1.0, 1.0)])
    assert Octree.from_bytes(octree.to_bytes()).to_bytes() == octree.to_bytes()


def test_bytes_that_lie_about_their_size_are_refused() -> None:
    good = filled(2, 2).to_bytes()
    with pytest.raises(ValueError, match="max_bricks"):
        Octree.from_bytes(good, max_bricks=4)
    with pytest.raises(ValueError):
        Octree.from_bytes(repacked(good, size=4))
    bomb = HEADER.pack(b"UOCT", 1, D, 2, 0, 0) + zlib.compress(bytes(1 << 22))
    with pytest.raises(ValueError, match="torn"):
        Octree.from_bytes(bomb)
    newer = good[:4] + struct.pack("<B", 2) + good[5:]
    with pytest.raises(ValueError, match="version 2"):
        Octree.from_bytes(newer)


def depth_image(columns: int, rows: int, origin: tuple[float, float, float], seed: int) -> F64:
    """Points of a camera's pixels, row by row: a wall with steps and a slope, and some pixels that see far."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, columns), np.linspace(-0.45, 0.45, rows))
    depth = 1.5 + 0.6 * (u > 0.1) + 0.3 * v + rng.choice([0.0, 1.5], u.shape, p=(0.99, 0.01))
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]) if seed % 2 else np.eye(3)
    return np.asarray(origin + (np.stack((np.ones_like(u), u, v), axis=-1) * depth[..., None]).reshape(-1, 3) @ turn.T)


def walked_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapping.grids.octree._LEAST", 10**9)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.013, -0.377, 0.21), (0.05, 0.05, 0.025)])
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("resolution_m", [0.05, 0.11])
def test_a_dense_cloud_is_inserted_as_if_each_ray_was_walked(
    origin: tuple[float, float, float], seed: int, resolution_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Groups of rays only save work: the same bytes, also on top of what is known and with a bound on ranges."""
    trees = []
    for one_by_one in (False, True):
        if one_by_one:
            walked_one_by_one(monkeypatch)
        tree = Octree(resolution_m=resolution_m)
        for number, range_max_m in ((seed, math.inf), (seed + 2, 1.7), (seed, math.inf)):
            tree.insert(origin, depth_image(300, 200, origin, number), range_max_m=range_max_m)
        trees.append(tree)
    assert trees[0].to_bytes() == trees[1].to_bytes()
    assert trees[0].leaf_count() > 1000


@pytest.mark.parametrize("seed", range(12))
def test_any_crowd_of_rays_is_inserted_as_if_each_was_walked(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clusters, planes, points on borders of voxels, near the sensor and along axes; some rays met nothing."""
    rng = np.random.default_rng(seed)
    origin = np.round(rng.normal(0.0, 1.0, 3), rng.integers(1, 4))
    clusters = np.repeat(rng.normal(0.0, 2.0, (60, 3)), 30, axis=0) + rng.normal(0.0, 0.12, (1800, 3))
    plane = rng.uniform(-3.0, 3.0, (2000, 3)) * (1.0, 1.0, 0.0) + (0.0, 0.0, float(rng.normal(0.0, 1.0)))
    near = origin + rng.normal(0.0, 0.25, (500, 3))
    borders = np.round(rng.normal(0.0, 1.0, (400, 3)), 1)
    axes = origin + rng.uniform(-3.0, 3.0, (300, 1)) * np.eye(3)[rng.integers(0, 3, 300)]
    points = np.concatenate((clusters, plane, near, borders, axes, [[np.nan, 0.0, 0.0]]))
    points = points[rng.permutation(len(points))] if seed % 2 else points
    is_hit = rng.random(len(points)) < (0.9 if seed % 3 else 0.1)
    trees = []
    for one_by_one in (False, True):
        if one_by_one:
            walked_one_by_one(monkeypatch)
        tree = Octree(resolution_m=D)
        for range_max_m in (math.inf, 2.3):
            tree.insert(origin, points, range_max_m=range_max_m, is_hit=is_hit)
        trees.append(tree)
    assert trees[0].to_bytes() == trees[1].to_bytes()


def test_few_rays_of_a_depth_image_are_walked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else groups save nothing."""
    walked: list[int] = []
    mark_ways = rays.mark_ways

    def noted(*arguments: Any) -> int:
        done = int(mark_ways(*arguments))
        walked.append(int(arguments[-5][ends.WALKED]))
        return done

    monkeypatch.setattr(rays, "mark_ways", noted)
    Octree(resolution_m=0.05).insert((0.0, 0.0, 0.0), depth_image(640, 480, (0.0, 0.0, 0.0), 2))
    assert 0 < walked[-1] < 0.05 * 640 * 480
