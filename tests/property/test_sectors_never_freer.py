"""No loss of data makes a sector freer, and no reading frees what it did not see (S34, S36, S38)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot, SectorState

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
OBSTACLE, FREE = SectorState.OBSTACLE, SectorState.FREE
LIMIT_NS = 1000
SPACING_RAD = math.radians(2.0)
BEAMS = 180
BODY = [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]]
BEARING = -math.pi + SPACING_RAD * np.arange(BEAMS)
MOUNTS = (Pose2(), Pose2(0.3, 0.0, 0.0), Pose2(-0.2, 0.1, 2.0))
VIRTUAL = (Pose2(), Pose2(0.1, -0.1, 0.4), Pose2(1.0, 0.5, -1.0))
SONARS = (Pose2(0.45, 0.1, 0.2), Pose2(0.45, -0.1, -0.2), Pose2(-0.45, 0.0, 3.1))

ranges = st.lists(
    st.sampled_from([math.inf, math.inf, math.inf, -math.inf, math.nan, 0.25, 0.7, 1.0, 1.6, 2.5]),
    min_size=12,
    max_size=12,
).map(lambda runs: np.repeat(np.array(runs), BEAMS // 12))
echoes = st.lists(st.sampled_from([math.inf, -math.inf, 0.5, 1.2, 2.2]), min_size=3, max_size=3)
Map = PolarSectors | RectSectors


def polar(mount: Pose2) -> PolarSectors:
    return PolarSectors(
        sources=("laser", "sonar"),
        start_rad=-math.pi,
        stop_rad=math.pi,
        sector_rad=math.radians(15.0),
        base_from_sensor=mount,
        footprint=BODY,
        stale_after_ns=LIMIT_NS,
    )


def rect(mount: Pose2) -> RectSectors:
    return RectSectors(
        sources=("laser", "sonar"),
        size_m=(3.0, 3.0),
        sector_m=0.5,
        base_from_sensor=mount,
        footprint=BODY,
        stale_after_ns=LIMIT_NS,
    )


def scan(to: Map, range_m: F64, mount: Pose2, stamp_ns: int, keep: Bool | None = None) -> None:
    kept = slice(None) if keep is None else keep
    to.update_beams(
        "laser",
        base_from_sensor=mount,
        bearing_rad=BEARING[kept],
        range_m=range_m[kept],
        range_min_m=0.1,
        range_max_m=4.0,
        stamp_ns=stamp_ns,
        spacing_rad=SPACING_RAD,
    )


def hear(to: Map, range_m: list[float], stamp_ns: int) -> None:
    for channel, (pose, value) in enumerate(zip(SONARS, range_m)):
        to.update_cone(
            "sonar",
            channel,
            base_from_transducer=pose,
            cone_rad=math.radians(40.0),
            range_m=value,
            range_min_m=0.15,
            range_max_m=2.5,
            stamp_ns=stamp_ns,
        )


def distances(snapshot: PolarSnapshot | RectSnapshot) -> F64:
    if isinstance(snapshot, PolarSnapshot):
        return snapshot.distance_m
    return np.where(snapshot.state == FREE, 0.0, np.hypot(snapshot.x_m, snapshot.y_m))


def freer(after: PolarSnapshot | RectSnapshot, before: PolarSnapshot | RectSnapshot) -> Bool:
    """Free where it was not, or a free or obstacle distance larger than it was."""
    was_known = (before.state == FREE) | (before.state == OBSTACLE)
    is_known = (after.state == FREE) | (after.state == OBSTACLE)
    newly_free = (after.state == FREE) & (before.state != FREE)
    farther = was_known & is_known & (np.nan_to_num(distances(after)) > np.nan_to_num(distances(before)) + 1e-9)
    return np.asarray(newly_free | farther)


@st.composite
def losses(draw: st.DrawFn) -> tuple[Bool, str]:
    """Which beams survive, and how the others are lost."""
    keep = np.ones(BEAMS, dtype=bool)
    for _ in range(draw(st.integers(0, 6))):
        first = draw(st.integers(0, BEAMS - 1))
        keep[first : first + draw(st.integers(1, 30))] = False
    return keep, draw(st.sampled_from(["nan", "removed"]))


def degraded(to: Map, range_m: F64, mount: Pose2, stamp_ns: int, loss: tuple[Bool, str]) -> None:
    keep, how = loss
    if how == "nan":
        scan(to, np.where(keep, range_m, np.nan), mount, stamp_ns)
    else:
        scan(to, range_m, mount, stamp_ns, keep)


kinds = st.sampled_from([polar, rect])
mounts = st.sampled_from(MOUNTS)
virtual = st.sampled_from(VIRTUAL)


@settings(max_examples=60, deadline=None)
@given(
    kinds,
    virtual,
    mounts,
    ranges,
    echoes,
    st.lists(losses(), min_size=1, max_size=4),
    st.integers(1, 700),
    st.booleans(),
)
def test_losing_beams_of_the_same_scene(
    kind: Callable[[Pose2], Map],
    pose: Pose2,
    mount: Pose2,
    range_m: F64,
    heard: list[float],
    lost: list[tuple[Bool, str]],
    step: int,
    with_sonar: bool,
) -> None:
    sectors = kind(pose)
    scan(sectors, range_m, mount, 0)
    hear(sectors, heard, 0)
    before = sectors.snapshot(0)
    for k, loss in enumerate(lost):
        degraded(sectors, range_m, mount, (k + 1) * step, loss)
        hear(sectors, heard if with_sonar else [math.nan] * 3, (k + 1) * step)
        assert not freer(sectors.snapshot((k + 1) * step), before).any()


@settings(max_examples=60, deadline=None)
@given(kinds, virtual, mounts, ranges, echoes, losses())
def test_fewer_beams_from_the_start_free_no_more(
    kind: Callable[[Pose2], Map], pose: Pose2, mount: Pose2, range_m: F64, heard: list[float], loss: tuple[Bool, str]
) -> None:
    whole, poor = kind(pose), kind(pose)
    scan(whole, range_m, mount, 0)
    degraded(poor, range_m, mount, 0, loss)
    for sectors in (whole, poor):
        hear(sectors, [math.nan] * 3, 0)
    # A scan that never saw an obstacle cannot know of it; but it must not call free what the whole scan did not. A
    # sector seen from the side may be free before an obstacle it lost, never as far as that.
    a, b = whole.snapshot(0), poor.snapshot(0)
    is_free = b.state == FREE
    if isinstance(b, PolarSnapshot):
        assert ((a.state == FREE) | (a.state == OBSTACLE))[is_free].all()
        assert (distances(b)[is_free] <= distances(a)[is_free] + 1e-9).all()
    else:
        assert (a.state == FREE)[is_free].all()


@settings(max_examples=60, deadline=None)
@given(kinds, virtual, mounts, ranges, echoes, st.sampled_from(["laser", "sonar"]), st.booleans())
def test_a_source_that_stops_or_is_lost(
    kind: Callable[[Pose2], Map], pose: Pose2, mount: Pose2, range_m: F64, heard: list[float], victim: str, told: bool
) -> None:
    sectors = kind(pose)
    scan(sectors, range_m, mount, 0)
    hear(sectors, heard, 0)
    previous = first = sectors.snapshot(0)
    if told:
        sectors.lost(victim)
    for now in range(300, 2400, 300):
        if victim == "sonar":
            scan(sectors, range_m, mount, now)
        else:
            hear(sectors, heard, now)
        snapshot = sectors.snapshot(now)
        assert not freer(snapshot, previous).any()
        assert not freer(snapshot, first).any()
        previous = snapshot
    both = kind(pose)
    if victim == "sonar":
        scan(both, range_m, mount, 0)
    else:
        hear(both, heard, 0)
    assert not (both.snapshot(0).state == FREE).any()  # never heard is not silence


@settings(max_examples=40, deadline=None)
@given(kinds, virtual, mounts, ranges, echoes, st.lists(st.integers(0, 900), min_size=1, max_size=5))
def test_time_alone(
    kind: Callable[[Pose2], Map], pose: Pose2, mount: Pose2, range_m: F64, heard: list[float], steps: list[int]
) -> None:
    sectors = kind(pose)
    scan(sectors, range_m, mount, 0)
    hear(sectors, heard, 0)
    previous, now = sectors.snapshot(0), 0
    for step in steps:
        now += step
        snapshot = sectors.snapshot(now)
        assert not freer(snapshot, previous).any()
        previous = snapshot
    if now > LIMIT_NS:
        assert not ((previous.state == FREE) | (previous.state == OBSTACLE)).any()


def seen_by_beams(points: F64, range_m: F64, mount: Pose2) -> Bool:
    """Which points lie before the end of a beam no more than half a spacing beside them, computed one by one."""
    own = mount.inverse().apply(points)
    off = (np.arctan2(own[:, 1], own[:, 0])[:, None] - BEARING[None, :] + math.pi) % (2.0 * math.pi) - math.pi
    nearest = np.abs(off).argmin(axis=1)
    reach = np.where(np.isposinf(range_m), 4.0, range_m)[nearest]
    return np.asarray(np.hypot(own[:, 0], own[:, 1]) <= np.nan_to_num(reach, nan=-1.0, neginf=-1.0) + 1e-6)


def on_body(points: F64) -> Bool:
    return np.asarray((np.abs(points[:, 0]) <= 0.45 + 1e-5) & (np.abs(points[:, 1]) <= 0.30 + 1e-5))


@settings(max_examples=80, deadline=None)
@given(virtual, mounts, ranges, st.integers(0, 2**31))
def test_every_point_of_a_free_sector_was_seen(pose: Pose2, mount: Pose2, range_m: F64, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sectors = polar(pose)
    scan(sectors, range_m, mount, 0)
    hear(sectors, [math.nan] * 3, 0)
    snapshot = sectors.snapshot(0)
    for k in np.flatnonzero(snapshot.state == FREE):
        angle = rng.uniform(snapshot.edges_rad[k], snapshot.edges_rad[k + 1], 300)
        away = snapshot.distance_m[k] * np.sqrt(rng.uniform(0.0, 1.0, 300)) * (1.0 - 1e-6)
        points = pose.apply(np.stack((away * np.cos(angle), away * np.sin(angle)), axis=-1))
        assert (on_body(points) | seen_by_beams(points, range_m, mount)).all()


@settings(max_examples=80, deadline=None)
@given(virtual, mounts, ranges, st.integers(0, 2**31))
def test_every_point_of_a_free_square_was_seen(pose: Pose2, mount: Pose2, range_m: F64, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sectors = rect(pose)
    scan(sectors, range_m, mount, 0)
    hear(sectors, [math.nan] * 3, 0)
    snapshot = sectors.snapshot(0)
    for row, col in np.argwhere(snapshot.state == FREE):
        x = rng.uniform(snapshot.x_edges_m[col], snapshot.x_edges_m[col + 1], 200)
        y = rng.uniform(snapshot.y_edges_m[row], snapshot.y_edges_m[row + 1], 200)
        points = pose.apply(np.stack((x, y), axis=-1))
        assert (on_body(points) | seen_by_beams(points, range_m, mount)).all()


@settings(max_examples=80, deadline=None)
@given(virtual, mounts, ranges)
def test_the_obstacle_of_a_sector_is_its_nearest_end_point(pose: Pose2, mount: Pose2, range_m: F64) -> None:
    sectors = polar(pose)
    scan(sectors, range_m, mount, 0)
    snapshot = sectors.snapshot(0)
    ends = np.where(np.isneginf(range_m), 0.1, range_m)
    hit = np.isfinite(ends)
    points = mount.apply(np.stack((ends[hit] * np.cos(BEARING[hit]), ends[hit] * np.sin(BEARING[hit])), axis=-1))
    outside = ~on_body(points) | np.isneginf(range_m[hit])
    own = pose.inverse().apply(points[outside])
    known = snapshot.state == OBSTACLE
    # sector to Cartesian: each obstacle is one of the end points ...
    back = np.stack(
        (snapshot.distance_m * np.cos(snapshot.bearing_rad), snapshot.distance_m * np.sin(snapshot.bearing_rad)),
        axis=-1,
    )[known]
    for point in back:
        assert np.hypot(*(own - point).T).min() < 1e-9
    # ... and Cartesian to sector: no end point is nearer than what its sector says.
    bearing, distance = np.arctan2(own[:, 1], own[:, 0]), np.hypot(own[:, 0], own[:, 1])
    for lower, upper, state, nearest in zip(
        snapshot.edges_rad[:-1], snapshot.edges_rad[1:], snapshot.state, snapshot.distance_m
    ):
        inside = (bearing > lower + 1e-6) & (bearing < upper - 1e-6)
        if inside.any():
            assert state == OBSTACLE
            assert nearest <= distance[inside].min() + 1e-9
    assert (np.diff(snapshot.edges_rad) > 0.0).all()
    at = snapshot.bearing_rad[known]
    assert (np.diff(at) >= -1e-9).sum() >= len(at) - 2  # in bearing order, but for the seam
