"""Tables of bearings: any laser's sweep, in any order, gives the same points, and the walls' normals."""

from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.kernels.localise_table import EMPTY, bearing_of, bin_of
from mapping.localise.views import MOST_BINS, ViewStore, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]


def room_scan(bearing: F64, *, half_m: float = 2.0, yaw: float = 0.0) -> Scan:
    """A square room seen from its middle."""
    c, s = np.abs(np.cos(bearing + yaw)), np.abs(np.sin(bearing + yaw))
    return Scan(0, 0.0, bearing, half_m / np.maximum(c, s), 0.05, 30.0)


@pytest.mark.parametrize(
    ("degrees", "bins", "closed"),
    [
        (np.arange(-90.0, 90.0, 1.0), 192, False),
        (np.arange(-90.0, 90.5, 0.5), 385, False),
        (np.arange(-135.0, 135.25, 0.25), 720, False),
        (np.arange(0.0, 360.0, 1.0), 360, True),
        (-np.arange(0.0, 360.0, 0.8), 450, True),
    ],
)
def test_a_table_fits_the_laser(degrees: F64, bins: int, closed: bool) -> None:
    table = table_for(np.radians(degrees))
    assert table.closed is closed
    assert abs(table.bins - bins) <= 2
    assert table.bins <= MOST_BINS
    at = np.array([bin_of(float(b), table.frame()) for b in np.radians(degrees)])
    assert at.min() >= 0
    assert at.max() < table.bins
    if len(degrees) <= table.bins:
        assert len(np.unique(at)) == len(degrees)  # no two beams of the first sweep share a bin


def test_a_field_of_view_over_the_back_is_one_piece() -> None:
    table = table_for(np.radians(np.arange(100.0, 260.0, 1.0)))
    assert not table.closed
    assert bin_of(math.pi, table.frame()) == bin_of(-math.pi, table.frame())
    assert 0 <= bin_of(math.radians(-120.0), table.frame()) < table.bins


def test_two_beams_are_no_scan() -> None:
    with pytest.raises(ValueError, match="three beams"):
        table_for(np.array([0.0, 0.1, np.nan]))


@pytest.mark.parametrize("order", ["forward", "backward", "shuffled"])
def test_the_order_of_beams_does_not_matter(order: str) -> None:
    bearing = np.radians(np.arange(-135.0, 135.5, 0.5))
    scan = room_scan(bearing)
    table = table_for(bearing)
    index = {"forward": np.arange(len(bearing)), "backward": np.arange(len(bearing))[::-1]}.get(
        order, np.random.default_rng(0).permutation(len(bearing))
    )
    other = Scan(0, 0.0, bearing[index], scan.range_m[index], 0.05, 30.0)
    a, b = view_of(scan, table, farthest_m=30.0), view_of(other, table, farthest_m=30.0)
    for name in ("x", "y", "nx", "ny", "quality"):
        assert np.array_equal(getattr(a, name), getattr(b, name))


def test_points_and_normals_are_those_of_the_walls() -> None:
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    view = view_of(room_scan(bearing, yaw=0.3), table_for(bearing), farthest_m=30.0)
    assert view.points == len(bearing)
    turned = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    points = np.stack((view.x, view.y), axis=-1).astype(np.float64) @ turned.T
    assert np.abs(np.abs(points).max(axis=1) - 2.0).max() < 2e-6
    normals = np.stack((view.nx, view.ny), axis=-1).astype(np.float64) @ turned.T
    flat = (view.quality > 0.0) & (np.abs(points).min(axis=1) < 1.7)  # away from the corners
    assert flat.sum() > 500
    inwards = -points * (np.abs(points) > 1.99) / 2.0
    assert np.abs(normals[flat] - inwards[flat]).max() < 1e-3
    assert np.all(view.quality[flat] > 0.99)


def corridor_scan(yaw: float, noise_m: float, seed: int) -> Scan:
    """A corridor 2.5 m wide, seen 180 degrees wide every degree."""
    bearing = np.radians(np.arange(-90.0, 90.0))
    distance = 1.25 / np.maximum(np.abs(np.sin(bearing + yaw)), 0.04)
    distance = distance + np.random.default_rng(seed).normal(0.0, noise_m, len(bearing))
    distance[distance > 20.0] = np.inf
    return Scan(0, 0.0, bearing, distance, 0.05, 80.0)


def test_walls_that_beams_graze_have_normals() -> None:
    """Half a metre and more between beams, along a corridor: without these walls nothing holds the heading there."""
    scan = corridor_scan(0.1, 0.02, 1)
    view = view_of(scan, table_for(scan.bearing_rad), farthest_m=30.0, grazed=True)
    far = np.hypot(view.x, view.y) > 4.0
    assert far.sum() > 20
    assert (view.quality[far] > 0.0).mean() > 0.75
    along = math.cos(0.1) * view.nx - math.sin(0.1) * view.ny  # of the corridor
    assert np.degrees(np.arcsin(np.abs(along[view.quality > 0.0]))).max() < 12.0
    assert np.degrees(np.abs(np.arcsin(along[far & (view.quality > 0.0)]))).mean() < 1.5


def test_scattered_points_are_no_grazed_wall() -> None:
    rng = np.random.default_rng(3)
    bearing = np.radians(np.arange(-90.0, 90.0))
    shares = []
    for _ in range(20):
        scan = Scan(0, 0.0, bearing, rng.uniform(4.0, 15.0, len(bearing)), 0.05, 80.0)
        shares.append(float((view_of(scan, table_for(bearing), farthest_m=30.0, grazed=True).quality > 0.0).mean()))
    assert np.mean(shares) < 0.02


def test_what_is_no_reading_leaves_an_empty_bin() -> None:
    bearing = np.radians(np.arange(-90.0, 91.0, 1.0))
    distance = np.full(181, 3.0)
    distance[[10, 20, 30, 40, 50]] = [np.nan, np.inf, -np.inf, 0.01, 31.0]
    view = view_of(Scan(0, 0.0, bearing, distance, 0.05, 80.0), table_for(bearing), farthest_m=30.0)
    assert view.points == 176
    assert np.all((view.x == 0.0) == (view.quality == EMPTY))


def test_a_bin_takes_the_nearest_surface_only() -> None:
    table = table_for(np.radians(np.arange(-90.0, 91.0, 1.0)))
    bearing = np.radians([0.0, 0.1, 0.2, -0.1])
    view = view_of(Scan(0, 0.0, bearing, np.array([2.0, 2.02, 5.0, 2.04]), 0.05, 30.0), table, farthest_m=30.0)
    assert view.points == 1
    assert float(view.x.max()) == pytest.approx(2.02, abs=1e-3)


def test_lengths_that_differ_are_refused() -> None:
    table = table_for(np.radians(np.arange(-90.0, 91.0, 1.0)))
    with pytest.raises(ValueError, match="one length"):
        view_of(Scan(0, 0.0, np.zeros(3), np.ones(4), 0.05, 30.0), table, farthest_m=30.0)


def test_a_store_gives_back_what_it_took_and_keeps_old_copies() -> None:
    wide, narrow = np.radians(np.arange(-90.0, 90.5, 0.5)), np.radians(np.arange(0.0, 360.0, 2.0))
    store = ViewStore()
    first = view_of(room_scan(narrow), table_for(narrow), farthest_m=30.0)
    store.add(first)
    before = store.kept()
    for _ in range(100):
        store.add(view_of(room_scan(wide), table_for(wide), farthest_m=30.0))
    assert before.count == 1
    for kept in (before, store.kept()):
        again = kept.view(0)
        assert again.table == first.table
        assert np.array_equal(again.x, first.x)
        assert again.normals == first.normals
    assert len(store) == 101


def test_quick_bearings_are_bearings() -> None:
    rng = np.random.default_rng(0)
    for x, y in rng.normal(0.0, 5.0, (2000, 2)):
        assert bearing_of(x, y) == pytest.approx(math.atan2(y, x), abs=1e-5)
    for x, y in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (-1.0, 1e-300)):
        assert bearing_of(x, y) == pytest.approx(math.atan2(y, x), abs=1e-5)


def test_views_that_were_given_up_leave_the_numbers_of_the_others() -> None:
    bearing = np.linspace(-math.pi / 2.0, math.pi / 2.0, 91)
    table, store = table_for(bearing), ViewStore()
    scans = [Scan(k, 0.0, bearing, np.full(91, 1.0 + 0.01 * k), 0.05, 10.0) for k in range(400)]
    for scan in scans[:300]:
        store.add(view_of(scan, table, farthest_m=30.0))
    before, size = store.kept(), store.memory_bytes
    store.give_up(range(0, 280, 2))
    after = store.kept()
    assert store.memory_bytes < 0.6 * size
    assert after.is_there().sum() == 160
    assert not after.is_there()[:280:2].any()
    for number in (1, 279, 280, 299):
        np.testing.assert_array_equal(after.view(number).x, before.view(number).x)
    assert after.view(0).points == 0
    for scan in scans[300:]:
        store.add(view_of(scan, table, farthest_m=30.0))
    assert len(store) == 400
    np.testing.assert_allclose(store.kept().view(399).x, view_of(scans[399], table, farthest_m=30.0).x)
    assert before.view(0).points == 91  # what was handed out stays


def test_views_are_bounded_by_what_is_not_given_up() -> None:
    bearing = np.linspace(-math.pi / 2.0, math.pi / 2.0, 91)
    table, store = table_for(bearing), ViewStore()
    most = 0
    for k in range(3000):
        store.add(view_of(Scan(k, 0.0, bearing, np.full(91, 2.0), 0.05, 10.0), table, farthest_m=30.0))
        if k >= 100:
            store.give_up([k - 100])
        most = max(most, store.memory_bytes)
    assert most < 500 * (91 + 40) * 8


@pytest.mark.parametrize("grazed", [False, True])
def test_a_view_that_is_opened_again_is_the_same_to_the_last_bit(grazed: bool) -> None:
    rng = np.random.default_rng(5)
    store, views = ViewStore(open_most=1), []
    for k in range(40):
        bearing = np.sort(rng.uniform(-math.pi, math.pi * rng.choice([0.2, 1.0]), 30 + 20 * k))
        scan = room_scan(bearing)
        reach = np.where(rng.random(len(bearing)) < 0.1, math.inf, scan.range_m + rng.normal(0.0, 0.01, len(bearing)))
        noisy = Scan(0, 0.0, bearing, reach, scan.range_min_m, scan.range_max_m)
        views.append(view_of(noisy, table_for(bearing), farthest_m=30.0, grazed=grazed))
        store.add(views[-1])
    kept = store.kept()
    for number, view in enumerate(views):
        again = kept.view(number)
        assert (again.table, again.points, again.normals) == (view.table, view.points, view.normals)
        for name in ("x", "y", "nx", "ny", "quality"):
            np.testing.assert_array_equal(getattr(again, name), getattr(view, name))
    beside = kept.opened(np.array([3, 39, 0]))
    for row, number in enumerate((3, 39, 0)):
        width = views[number].table.bins
        np.testing.assert_array_equal(beside.nx[row, :width], views[number].nx)
        assert (beside.quality[row, width:] == -1.0).all()
        assert tuple(beside.frames[row]) == tuple(views[number].table.frame())


def test_views_that_were_given_up_are_not_looked_at() -> None:
    bearing = np.linspace(-math.pi / 2.0, math.pi / 2.0, 91)
    table, store = table_for(bearing), ViewStore()
    for _ in range(200):
        store.add(view_of(room_scan(bearing), table, farthest_m=30.0))
    store.give_up(range(100))
    assert not store.kept().is_there()[99]
    with pytest.raises(ValueError, match="given up"):
        store.kept().opened(np.array([150, 99]))


def test_a_copy_of_a_store_goes_its_own_way() -> None:
    bearing = np.radians(np.arange(-90.0, 91.0, 2.0))
    table = table_for(bearing)
    store = ViewStore()
    store.add(view_of(room_scan(bearing), table, farthest_m=30.0))
    copied = deepcopy(store)
    copied.add(view_of(room_scan(bearing, half_m=3.0), table, farthest_m=30.0))
    assert (len(store), len(copied)) == (1, 2)
    np.testing.assert_array_equal(copied.kept().view(0).nx, store.kept().view(0).nx)
