"""Bumpers and cliff switches in sector maps: touched blocks, silence is stale, nothing they say frees anything."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot, SectorState

BODY = [[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]]
BUMPER = Pose2(0.32, 0.0, 0.0)
LIMIT_NS = 500
Map = PolarSectors | RectSectors
OBSTACLE, FREE, STALE, UNKNOWN = SectorState.OBSTACLE, SectorState.FREE, SectorState.STALE, SectorState.UNKNOWN


def polar(*sources: str) -> PolarSectors:
    return PolarSectors(
        sources=sources,
        start_rad=-math.pi,
        stop_rad=math.pi,
        sector_rad=math.radians(15.0),
        footprint=BODY,
        stale_after_ns=LIMIT_NS,
    )


def rect(*sources: str) -> RectSectors:
    return RectSectors(sources=sources, size_m=(2.0, 2.0), sector_m=0.25, footprint=BODY, stale_after_ns=LIMIT_NS)


def touch(to: Map, tripped: bool | None, stamp_ns: int, *, pose: Pose2 = BUMPER, width_m: float = 0.3) -> None:
    to.update_contact("bumper", 4, base_from_contact=pose, width_m=width_m, tripped=tripped, stamp_ns=stamp_ns)


def see_far(to: Map, stamp_ns: int) -> None:
    bearing = np.radians(np.arange(-180.0, 180.0, 1.0))
    to.update_beams(
        "laser",
        base_from_sensor=Pose2(),
        bearing_rad=bearing,
        range_m=np.full(360, np.inf),
        range_min_m=0.1,
        range_max_m=5.0,
        stamp_ns=stamp_ns,
    )


def states(snapshot: PolarSnapshot | RectSnapshot) -> set[SectorState]:
    return {SectorState(int(each)) for each in snapshot.state.ravel()}


@pytest.mark.parametrize("make", [polar, rect])
def test_a_touched_bumper_is_an_obstacle_along_its_width(make: Callable[..., Map]) -> None:
    sectors = make("bumper")
    touch(sectors, True, 10)
    snapshot = sectors.snapshot(11)
    assert states(snapshot) == {OBSTACLE, UNKNOWN}
    if isinstance(snapshot, PolarSnapshot):
        at = np.flatnonzero(snapshot.state == OBSTACLE)
        edges = np.degrees(snapshot.edges_rad)
        reach = math.degrees(math.atan2(0.15, 0.32))
        assert edges[at[0]] <= -reach < edges[at[0] + 1]
        assert edges[at[-1]] < reach <= edges[at[-1] + 1]
        x, y = snapshot.distance_m * np.cos(snapshot.bearing_rad), snapshot.distance_m * np.sin(snapshot.bearing_rad)
        np.testing.assert_allclose(x[at], 0.32, atol=1e-9)
        assert (np.abs(y[at]) <= 0.15 + 1e-9).all()
    else:
        rows, cols = np.nonzero(snapshot.state == OBSTACLE)
        assert set(cols) == {5}  # 0.25 to 0.5 m ahead
        assert set(rows) == {3, 4}  # 0.25 m to both sides


@pytest.mark.parametrize("make", [polar, rect])
def test_a_bumper_that_touches_nothing_says_nothing(make: Callable[..., Map]) -> None:
    alone = make("bumper")
    touch(alone, False, 10)
    assert states(alone.snapshot(11)) == {UNKNOWN}
    both = make("bumper", "laser")
    see_far(both, 10)
    assert FREE not in states(both.snapshot(11))  # nobody knows yet what the bumper feels
    touch(both, False, 12)
    with_bumper = both.snapshot(13)
    laser = make("laser")
    see_far(laser, 10)
    np.testing.assert_array_equal(with_bumper.state, laser.snapshot(13).state)


@pytest.mark.parametrize("make", [polar, rect])
@pytest.mark.parametrize("how", ["not answering", "lost", "lost after a touch"])
def test_an_unheard_bumper_makes_its_sectors_stale_until_it_speaks(make: Callable[..., Map], how: str) -> None:
    sectors = make("bumper", "laser")
    see_far(sectors, 10)
    touch(sectors, how == "lost after a touch", 10)
    if how == "not answering":
        touch(sectors, None, 12)
    else:
        sectors.lost("bumper")
    free = make("laser")
    see_far(free, 10)
    before, after = free.snapshot(13), sectors.snapshot(13)
    changed = before.state != after.state
    assert changed.any()
    assert (after.state[changed] == STALE).all()
    touch(sectors, False, 14)
    np.testing.assert_array_equal(sectors.snapshot(15).state, before.state)


def test_an_obstacle_of_a_laser_nearer_than_the_bumper_stays() -> None:
    sectors = polar("bumper", "laser")
    see_far(sectors, 10)
    touch(sectors, True, 10, pose=Pose2(1.0, 0.0, 0.0))
    sectors.update_beams(
        "laser",
        base_from_sensor=Pose2(),
        bearing_rad=np.radians(np.arange(-180.0, 180.0, 1.0)),
        range_m=np.full(360, 0.7),
        range_min_m=0.1,
        range_max_m=5.0,
        stamp_ns=12,
    )
    np.testing.assert_allclose(sectors.snapshot(13).distance_m, 0.7, rtol=1e-9)


def test_an_unknown_source_is_refused() -> None:
    with pytest.raises(ValueError, match="does not feed"):
        touch(polar("laser"), True, 1)
