"""Polar sector maps: nearest obstacle, what is free, what is not known (S34, S35, S38)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.no_echo import OPEN_M
from mapping.sectors.polar import PolarSectors, sector_edges
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]
OBSTACLE, FREE, UNKNOWN, STALE = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE
LIMIT_NS = 500_000_000
BODY = [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]]
BEARING = np.deg2rad(np.arange(-540, 541) * 0.25)  # 270 degrees, a beam on every sector edge


def laser_map(
    *,
    sources: tuple[str, ...] = ("laser",),
    base_from_sensor: Pose2 = IDENTITY,
    footprint: list[list[float]] | None = None,
    range_max_m: float = math.inf,
    start_rad: float = math.radians(-120.0),
    stop_rad: float = math.radians(120.0),
) -> PolarSectors:
    return PolarSectors(
        sources=sources,
        base_from_sensor=base_from_sensor,
        footprint=footprint,
        range_max_m=range_max_m,
        stale_after_ns=LIMIT_NS,
        start_rad=start_rad,
        stop_rad=stop_rad,
    )


def sweep(
    sectors: PolarSectors,
    range_m: F64,
    *,
    stamp_ns: int = 0,
    bearing: F64 = BEARING,
    mount: Pose2 = IDENTITY,
    source: str = "laser",
) -> None:
    sectors.update_beams(
        source,
        base_from_sensor=mount,
        bearing_rad=bearing,
        range_m=range_m,
        range_min_m=0.05,
        range_max_m=30.0,
        stamp_ns=stamp_ns,
    )


def ping(sectors: PolarSectors, range_m: float, *, stamp_ns: int = 0, channel: int = 0, axis_deg: float = 0.0) -> None:
    sectors.update_cone(
        "sonar",
        channel,
        base_from_transducer=Pose2(0.0, 0.0, math.radians(axis_deg)),
        cone_rad=math.radians(30.0),
        range_m=range_m,
        range_min_m=0.2,
        range_max_m=3.0,
        stamp_ns=stamp_ns,
    )


def at(snapshot: PolarSnapshot, degrees: float) -> int:
    return int(np.searchsorted(snapshot.edges_rad, math.radians(degrees), side="right")) - 1


def nothing_seen() -> F64:
    return np.full(len(BEARING), np.inf)


def test_nothing_said_is_unknown() -> None:
    snapshot = laser_map().snapshot(5)
    assert (snapshot.state == UNKNOWN).all()
    assert (snapshot.age_ns == -1).all()
    assert (snapshot.source == -1).all()
    assert np.isnan(snapshot.distance_m).all()
    assert len(snapshot.state) == 48


def test_no_return_everywhere_is_free_as_far_as_silence_is_believed() -> None:
    sectors = laser_map()
    sweep(sectors, nothing_seen())
    snapshot = sectors.snapshot(7)
    assert (snapshot.state == FREE).all()
    assert (snapshot.distance_m == OPEN_M).all()
    assert np.isnan(snapshot.bearing_rad).all()
    assert (snapshot.age_ns == 7).all()
    assert (snapshot.source == 0).all()


def test_a_wall_is_the_nearest_obstacle_of_every_sector() -> None:
    sectors = laser_map(start_rad=math.radians(-60.0), stop_rad=math.radians(60.0))
    ahead = np.abs(BEARING) < math.radians(70.0)
    sweep(sectors, np.where(ahead, 3.0 / np.cos(BEARING), np.inf))
    snapshot = sectors.snapshot(0)
    assert len(snapshot.state) == 24  # 24 x 5 = 120 degrees
    assert (snapshot.state == OBSTACLE).all()
    # A sector has its lower edge's beam, and not its upper edge's.
    lower, upper = snapshot.edges_rad[:-1], snapshot.edges_rad[1:] - math.radians(0.25)
    nearest = 3.0 / np.maximum(np.cos(lower), np.cos(upper))
    nearest[-1] = 3.0 / math.cos(snapshot.edges_rad[-2])
    np.testing.assert_allclose(snapshot.distance_m, nearest)
    np.testing.assert_allclose(snapshot.distance_m * np.cos(snapshot.bearing_rad), 3.0)


def test_the_sector_beside_a_beam_that_ends_on_its_edge_is_free_only_so_far() -> None:
    sectors = laser_map()
    ranges = nothing_seen()
    ranges[np.argmin(np.abs(BEARING - math.radians(60.0)))] = 2.0
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 62.0)] == OBSTACLE
    assert snapshot.state[at(snapshot, 58.0)] == FREE
    assert snapshot.distance_m[at(snapshot, 58.0)] == 2.0
    assert snapshot.distance_m[at(snapshot, 53.0)] == OPEN_M


@pytest.mark.parametrize("bad", [math.nan, -1.0])
def test_one_invalid_beam_leaves_its_sector_unknown(bad: float) -> None:
    sectors = laser_map()
    ranges = nothing_seen()
    ranges[np.argmin(np.abs(BEARING - math.radians(12.0)))] = bad
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 12.0)] == UNKNOWN
    assert (np.delete(snapshot.state, at(snapshot, 12.0)) == FREE).all()


def test_a_missing_beam_is_a_gap() -> None:
    sectors = laser_map()
    keep = np.abs(BEARING - math.radians(12.0)) > 1e-6
    sweep(sectors, nothing_seen()[keep], bearing=BEARING[keep])
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 12.0)] == UNKNOWN
    assert (np.delete(snapshot.state, at(snapshot, 12.0)) == FREE).all()


def test_half_the_beams_do_not_pass_for_a_whole_scan() -> None:
    sectors = laser_map()
    sweep(sectors, nothing_seen())
    sweep(sectors, nothing_seen()[::2], bearing=BEARING[::2], stamp_ns=1)
    assert (sectors.snapshot(1).state == UNKNOWN).all()


def test_too_close_stands_at_the_least_range() -> None:
    sectors = laser_map()
    ranges = nothing_seen()
    ranges[np.argmin(np.abs(BEARING - math.radians(12.0)))] = -np.inf
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 12.0)] == OBSTACLE
    assert snapshot.distance_m[at(snapshot, 12.0)] == pytest.approx(0.05)


def test_what_the_field_of_view_does_not_reach_is_unknown() -> None:
    sectors = laser_map(start_rad=-math.pi, stop_rad=math.pi)
    sweep(sectors, nothing_seen())
    snapshot = sectors.snapshot(0)
    middle = np.rad2deg(0.5 * (snapshot.edges_rad[:-1] + snapshot.edges_rad[1:]))
    np.testing.assert_array_equal(snapshot.state == FREE, np.abs(middle) < 135.0)
    np.testing.assert_array_equal(snapshot.state == UNKNOWN, np.abs(middle) > 135.0)


@pytest.mark.parametrize("shift", [0.0, 1.0, math.pi, 5.0])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_whole_turn_across_the_seam(shift: float, backwards: bool) -> None:
    sectors = laser_map(start_rad=-math.pi, stop_rad=math.pi)
    bearing = shift + np.deg2rad(np.arange(720) * 0.5)
    ranges = np.where(np.cos(bearing - math.pi) > math.cos(math.radians(1.1)), 2.0, np.inf)
    order = slice(None, None, -1) if backwards else slice(None)
    sweep(sectors, ranges[order], bearing=bearing[order])
    snapshot = sectors.snapshot(0)
    assert snapshot.state[0] == OBSTACLE
    assert snapshot.state[-1] == OBSTACLE
    assert (snapshot.state[1:-1] == FREE).all()


def test_a_seam_beam_with_rounding_belongs_to_one_end() -> None:
    sectors = laser_map(start_rad=-math.pi, stop_rad=math.pi)
    for bearing in (-math.pi, math.pi, np.nextafter(-math.pi, -4.0), np.nextafter(math.pi, 4.0)):
        sweep(sectors, np.array([1.0]), bearing=np.array([bearing]))
        snapshot = sectors.snapshot(0)
        assert snapshot.state[0] == OBSTACLE or snapshot.state[-1] == OBSTACLE


def test_a_displaced_virtual_sensor_measures_from_its_own_origin() -> None:
    sectors = laser_map(base_from_sensor=Pose2(-1.0, 0.0, 0.0))
    sweep(sectors, np.where(BEARING == 0.0, 2.0, np.nan), mount=Pose2(0.5, 0.0, 0.0))
    snapshot = sectors.snapshot(0)
    assert snapshot.distance_m[at(snapshot, 0.1)] == pytest.approx(3.5)
    assert snapshot.bearing_rad[at(snapshot, 0.1)] == pytest.approx(0.0)


def test_a_laser_at_the_front_frees_what_lies_outside_the_body() -> None:
    mount = Pose2(0.30, 0.0, 0.0)
    sectors = laser_map(footprint=BODY)
    sweep(sectors, nothing_seen(), mount=mount)
    snapshot = sectors.snapshot(0)
    ahead = [at(snapshot, d) for d in (-40.0, 0.1, 40.0, 80.0)]
    assert (snapshot.state[ahead] == FREE).all()
    # so far from the laser, 0.3 m in front: from the kinematic centre ahead is a little more, behind less
    assert snapshot.distance_m[at(snapshot, 0.1)] == pytest.approx(OPEN_M + 0.3, abs=0.01)
    assert OPEN_M - 0.3 < snapshot.distance_m[at(snapshot, 80.0)] < OPEN_M + 0.2
    # the field of view ends at 135 degrees from the laser: it leaves the body behind x = 0
    assert (snapshot.state[[at(snapshot, 112.0), at(snapshot, -112.0)]] == UNKNOWN).all()


def test_without_an_outline_a_blind_start_is_not_free() -> None:
    sectors = laser_map()
    sweep(sectors, nothing_seen(), mount=Pose2(0.30, 0.0, 0.0))
    assert (sectors.snapshot(0).state == UNKNOWN).all()


def test_an_occluded_part_of_a_displaced_sector_is_not_free() -> None:
    # The laser, 2 m to the left, looks past a post at (3, 1): its shadow crosses the sectors ahead beyond the post.
    bearing = np.deg2rad(np.arange(720) * 0.5)
    sectors = laser_map()
    toward = math.atan2(-1.0, 3.0)
    near = np.abs((bearing - toward + np.pi) % (2 * np.pi) - np.pi) < math.radians(1.0)
    sweep(sectors, np.where(near, math.sqrt(10.0), np.inf), bearing=bearing, mount=Pose2(0.0, 2.0, 0.0))
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 18.0)] == OBSTACLE
    shadow = snapshot.distance_m[at(snapshot, 2.5)]
    assert snapshot.state[at(snapshot, 2.5)] == FREE
    assert 4.4 < shadow < 4.78  # the shadow of 2.5 to 3 degrees meets the ray at 5 degrees first; its axis at 4.77 m
    assert snapshot.distance_m[at(snapshot, -60.0)] > 8.0


def test_clearance_is_distance_less_the_border() -> None:
    sectors = laser_map(footprint=BODY, start_rad=-math.pi, stop_rad=math.pi)
    bearing = np.deg2rad(np.arange(360.0))
    sweep(sectors, np.full(360, 2.0), bearing=bearing)
    snapshot = sectors.snapshot(0)
    ahead = at(snapshot, 0.1)
    assert snapshot.clearance_m[ahead] == pytest.approx(2.0 - 0.45)
    assert snapshot.clearance_m[at(snapshot, 90.1)] == pytest.approx(2.0 - 0.30)


def test_the_vehicle_itself_is_no_obstacle_and_frees_nothing() -> None:
    sectors = laser_map(footprint=BODY)
    ranges = nothing_seen()
    mast = np.abs(BEARING - math.radians(90.0)) < math.radians(1.0)
    ranges[mast] = 0.2
    sweep(sectors, ranges)
    snapshot = sectors.snapshot(0)
    assert (snapshot.state[[at(snapshot, 88.0), at(snapshot, 91.0)]] == UNKNOWN).all()
    assert OBSTACLE not in snapshot.state


def test_an_old_sector_is_stale_and_keeps_its_distance() -> None:
    sectors = laser_map()
    sweep(sectors, np.full(len(BEARING), 2.0))
    assert (sectors.snapshot(LIMIT_NS).state == OBSTACLE).all()
    old = sectors.snapshot(LIMIT_NS + 1)
    assert (old.state == STALE).all()
    np.testing.assert_allclose(old.distance_m, 2.0)
    assert (old.age_ns == LIMIT_NS + 1).all()


def test_a_lost_device_is_stale_at_once_and_comes_back() -> None:
    sectors = laser_map()
    sweep(sectors, nothing_seen())
    sectors.lost("laser")
    assert (sectors.snapshot(1).state == STALE).all()
    sweep(sectors, nothing_seen(), stamp_ns=2)
    assert (sectors.snapshot(2).state == FREE).all()


def test_a_stamp_from_the_future_does_not_keep_a_sector_young() -> None:
    sectors = laser_map()
    sweep(sectors, nothing_seen(), stamp_ns=10**15)
    assert (sectors.snapshot(0).state == STALE).all()
    assert (sectors.snapshot(10**15).state == STALE).all()
    sweep(sectors, nothing_seen(), stamp_ns=5)
    assert (sectors.snapshot(6).state == FREE).all()


def test_a_late_reading_changes_nothing() -> None:
    sectors = laser_map()
    sweep(sectors, np.full(len(BEARING), 2.0), stamp_ns=100)
    sweep(sectors, nothing_seen(), stamp_ns=50)
    assert (sectors.snapshot(100).state == OBSTACLE).all()


def test_an_obstacle_stays_until_somebody_looks_there_again() -> None:
    sectors = laser_map()
    ranges, blind = nothing_seen(), nothing_seen()
    post = np.argmin(np.abs(BEARING - math.radians(12.0)))
    ranges[post], blind[post] = 1.0, np.nan
    sweep(sectors, ranges)
    sweep(sectors, blind, stamp_ns=10)
    sector = at(sectors.snapshot(10), 12.0)
    assert sectors.snapshot(10).state[sector] == OBSTACLE
    sweep(sectors, blind, stamp_ns=LIMIT_NS + 10)
    stale = sectors.snapshot(LIMIT_NS + 10)
    assert stale.state[sector] == STALE
    assert stale.distance_m[sector] == pytest.approx(1.0)
    sweep(sectors, nothing_seen(), stamp_ns=LIMIT_NS + 20)
    assert sectors.snapshot(LIMIT_NS + 20).state[sector] == FREE


def test_an_obstacle_from_before_a_loss_stays_stale_after_it() -> None:
    sectors = laser_map()
    ranges, blind = nothing_seen(), nothing_seen()
    post = np.argmin(np.abs(BEARING - math.radians(12.0)))
    ranges[post], blind[post] = 1.0, np.nan
    sweep(sectors, ranges)
    sweep(sectors, blind, stamp_ns=1)
    sectors.lost("laser")
    sweep(sectors, blind, stamp_ns=2)
    snapshot = sectors.snapshot(2)
    assert snapshot.state[at(snapshot, 12.0)] == STALE
    assert snapshot.state[at(snapshot, 40.0)] == FREE


def test_an_echo_counts_for_every_sector_of_its_cone() -> None:
    sectors = laser_map(sources=("sonar",))
    ping(sectors, 1.5, axis_deg=2.0)  # from -13 to 17 degrees
    snapshot = sectors.snapshot(0)
    hit = np.flatnonzero(snapshot.state == OBSTACLE)
    np.testing.assert_array_equal(hit, np.arange(at(snapshot, -13.0), at(snapshot, 17.0) + 1))
    np.testing.assert_allclose(snapshot.distance_m[hit], 1.5, rtol=1e-4)
    wanted = np.clip(math.radians(2.0), snapshot.edges_rad[hit], snapshot.edges_rad[hit + 1])
    np.testing.assert_allclose(snapshot.bearing_rad[hit], wanted, atol=1e-4)


def test_silence_frees_the_inside_of_the_cone_to_half_its_range() -> None:
    sectors = laser_map(sources=("sonar",))
    ping(sectors, math.inf, axis_deg=2.0)
    snapshot = sectors.snapshot(0)
    free = np.flatnonzero(snapshot.state == FREE)
    np.testing.assert_array_equal(free, np.arange(at(snapshot, -9.0), at(snapshot, 14.0) + 1))
    np.testing.assert_allclose(snapshot.distance_m[free], 1.5)
    assert (np.delete(snapshot.state, free) == UNKNOWN).all()


def test_a_sonar_on_the_bumper_frees_sectors_of_the_middle() -> None:
    sectors = laser_map(sources=("sonar",), footprint=BODY)
    sectors.update_cone(
        "sonar",
        1,
        base_from_transducer=Pose2(0.45, 0.0, 0.0),
        cone_rad=math.radians(40.0),
        range_m=math.inf,
        range_min_m=0.2,
        range_max_m=3.0,
        stamp_ns=0,
    )
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 1.0)] == FREE
    assert 1.9 < snapshot.distance_m[at(snapshot, 1.0)] <= 0.45 + 1.5
    assert snapshot.state[at(snapshot, 40.0)] == UNKNOWN


def test_a_too_close_echo_is_never_farther_than_the_least_range() -> None:
    sectors = laser_map(sources=("sonar",))
    ping(sectors, -math.inf)
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 0.1)] == OBSTACLE
    assert snapshot.distance_m[at(snapshot, 0.1)] <= 0.2


def test_silence_does_not_override_what_a_laser_sees() -> None:
    sectors = laser_map(sources=("laser", "sonar"))
    sweep(sectors, np.full(len(BEARING), 1.0))
    ping(sectors, math.inf)
    assert (sectors.snapshot(0).state == OBSTACLE).all()


def test_glass_only_the_sonar_hears_stays_when_the_sonar_dies() -> None:
    sectors = laser_map(sources=("laser", "sonar"))
    sweep(sectors, nothing_seen())
    ping(sectors, 1.0)
    ahead = at(sectors.snapshot(0), 0.1)
    assert sectors.snapshot(0).state[ahead] == OBSTACLE
    sweep(sectors, nothing_seen(), stamp_ns=LIMIT_NS + 1)
    snapshot = sectors.snapshot(LIMIT_NS + 1)
    assert snapshot.state[ahead] == STALE
    assert snapshot.distance_m[ahead] == pytest.approx(1.0, rel=1e-4)
    assert snapshot.state[at(snapshot, 60.0)] == FREE  # the sonar never spoke about that one
    sweep(sectors, np.full(len(BEARING), 0.9), stamp_ns=LIMIT_NS + 2)
    assert sectors.snapshot(LIMIT_NS + 2).state[ahead] == OBSTACLE


def test_a_sonar_that_never_spoke_keeps_the_map_from_being_free() -> None:
    sectors = laser_map(sources=("laser", "sonar"))
    ranges = nothing_seen()
    ranges[:100] = 2.0
    sweep(sectors, ranges)
    states = set(sectors.snapshot(0).state.tolist())
    assert states == {int(OBSTACLE), int(UNKNOWN)}
    ping(sectors, math.nan)  # alive but blind: only what it would have seen stays unknown
    snapshot = sectors.snapshot(0)
    assert snapshot.state[at(snapshot, 0.1)] == UNKNOWN
    assert snapshot.state[at(snapshot, 60.0)] == FREE


def test_what_lies_beyond_the_map_limits_what_is_free() -> None:
    sectors = laser_map(range_max_m=5.0)
    sweep(sectors, np.full(len(BEARING), 8.0))
    snapshot = sectors.snapshot(0)
    assert (snapshot.state == FREE).all()
    assert (snapshot.distance_m == 5.0).all()


def test_wrong_calls_are_refused() -> None:
    sectors = laser_map()
    with pytest.raises(ValueError, match="sonar"):
        ping(sectors, 1.0)
    with pytest.raises(ValueError, match="alike"):
        sweep(sectors, np.ones(3))
    for start, stop, width in ((0.0, 0.0, 0.1), (0.0, 7.0, 0.1), (0.0, 6.0, 4.0), (0.0, 1.0, 0.0)):
        with pytest.raises(ValueError):
            sector_edges(start_rad=start, stop_rad=stop, sector_rad=width)


def test_no_beams_at_all_is_no_knowledge() -> None:
    sectors = laser_map()
    sweep(sectors, np.empty(0), bearing=np.empty(0))
    assert (sectors.snapshot(0).state == UNKNOWN).all()


# --- how far all of a sector was looked through


def told_free(snapshot: PolarSnapshot, degrees: float) -> tuple[SectorState, float, float]:
    assert snapshot.free_m is not None
    sector = at(snapshot, degrees)
    return SectorState(snapshot.state[sector]), float(snapshot.distance_m[sector]), float(snapshot.free_m[sector])


def test_an_obstacle_in_a_sector_that_was_seen_whole_is_told_from_one_that_was_not() -> None:
    sectors, reach = laser_map(), np.full(len(BEARING), 4.0)
    reach[(math.radians(2.0) < BEARING) & (math.radians(3.0) > BEARING)] = 2.0
    sweep(sectors, reach)
    state, distance_m, free_m = told_free(sectors.snapshot(0), 2.5)
    assert state == OBSTACLE
    assert distance_m == pytest.approx(2.0)
    assert free_m == pytest.approx(2.0, abs=0.05)
    reach[(math.radians(3.4) < BEARING) & (math.radians(4.6) > BEARING)] = np.nan  # came back with nothing to go by
    sweep(sectors, reach, stamp_ns=1)
    state, distance_m, free_m = told_free(sectors.snapshot(1), 2.5)
    assert (state, free_m) == (OBSTACLE, 0.0)
    assert distance_m == pytest.approx(2.0)
    assert told_free(sectors.snapshot(1), 12.5)[2] == pytest.approx(4.0, abs=0.1), "the sectors beside were seen"


def test_a_sonar_that_covers_part_of_a_sector_looked_through_none_of_it() -> None:
    sectors = PolarSectors(sources=("sonar",), sector_rad=math.radians(60.0), stale_after_ns=LIMIT_NS)
    ping(sectors, 1.0)
    state, _, free_m = told_free(sectors.snapshot(0), 0.5)
    assert (state, free_m) == (OBSTACLE, 0.0)


def test_what_is_told_free_is_never_beyond_the_obstacle_nor_stale() -> None:
    sectors, rng = laser_map(), np.random.default_rng(7)
    for stamp in range(20):
        reach = rng.uniform(0.3, 6.0, len(BEARING))
        reach[rng.random(len(BEARING)) < 0.2] = np.inf
        reach[rng.random(len(BEARING)) < 0.01] = np.nan
        sweep(sectors, reach, stamp_ns=stamp)
        snapshot = sectors.snapshot(stamp)
        assert snapshot.free_m is not None
        seen = np.isin(snapshot.state, (OBSTACLE, FREE))
        assert (snapshot.free_m[seen] <= snapshot.distance_m[seen] + 1e-9).all()
        assert (snapshot.free_m[~seen] == 0.0).all()
    old = sectors.snapshot(10 * LIMIT_NS)
    assert old.free_m is not None
    assert not old.free_m.any()
