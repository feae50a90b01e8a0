"""While the slow maps are being drawn anew: the rest of the map is saved on time, and nothing of theirs is lost."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.scan import Scan
from service.layers import BuildingLayer
from service.live_map import LiveMap
from service.map_makers import MakersBusy, MapMakers, MapView, Sweep, Tile
from service.outputs import DocumentOut, Output
from service.store import MapStore
from tests.waiting import GIVE_UP_S

SECOND = 1_000_000_000
SCAN = Scan(7, 0.0, np.zeros(1), np.ones(1), 0.1, 10.0)


class Sketch:
    """Draws from sweeps; tells its one tile once, until it is drawn anew."""

    name, sources, period_ns = "sketch", frozenset({"front"}), SECOND

    def __init__(self) -> None:
        self._changed: list[Tile] = [(0, 0, b"first")]

    def start_anew(self) -> None:
        self._changed = [(0, 0, b"second")]

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: NDArray[np.float64]) -> None:
        pass

    def make(self, view: MapView) -> list[Output]:
        return [DocumentOut("map/lines", 0, {"of": self.name})]

    def changed_tiles(self) -> list[Tile]:
        changed, self._changed = self._changed, []
        return changed

    def restore(self, tiles: Iterable[Tile]) -> None:
        pass


class Standing:
    """A robot that stands, without SLAM."""

    def pose(self) -> Pose2:
        return Pose2()

    def drain(self) -> None:
        pass

    def map_was_replaced(self, tiles: Iterable[Tile], slam: Iterable[Tile]) -> None:
        pass

    def begin_map(self) -> None:
        pass

    def kept_of_slam(self) -> None:
        return None


@pytest.fixture
def told() -> list[Output]:
    return []


@pytest.fixture
def makers(told: list[Output]) -> MapMakers:
    return MapMakers([Sketch()], told.append, now_ns=lambda: 0)


@contextmanager
def drawing(makers: MapMakers) -> Iterator[threading.Event]:
    """Their thread is in the midst of drawing anew until the event is set, at the latest at the end of the block."""
    inside, go_on = threading.Event(), threading.Event()

    def sweep() -> Sweep:
        inside.set()
        assert go_on.wait(GIVE_UP_S)
        return "front", SCAN, np.zeros(3)

    makers.redraw([sweep])
    makers.start()
    try:
        assert inside.wait(GIVE_UP_S)
        yield go_on
    finally:
        go_on.set()
        assert makers.stop(GIVE_UP_S)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "live.umfeld", wall_ns=lambda: 1) as opened:
        yield opened


def live_map(store: MapStore, makers: MapMakers) -> LiveMap:
    layer = BuildingLayer(
        OccupancyGrid(resolution_m=0.05), {"front"}, publish_period_ns=SECOND, update_period_ns=SECOND
    )
    layer.grid.insert_scan(Pose2(), np.linspace(-3, 3, 361), np.full(361, 2.0), range_max_m=10.0)
    return LiveMap(layer, store, ask=lambda work: work(), fusion=Standing(), makers=makers)


def test_what_busy_makers_did_not_begin_is_not_done_later_either(makers: MapMakers) -> None:
    asked: list[int] = []
    with drawing(makers) as go_on:
        with pytest.raises(MakersBusy, match="try again"):
            makers.ask(lambda: asked.append(1), limit_s=0.0)
        go_on.set()
        makers.ask(lambda: asked.append(2))
    assert asked == [2]


def test_a_snapshot_goes_on_without_busy_makers_and_takes_theirs_with_the_next(
    makers: MapMakers, store: MapStore
) -> None:
    live = live_map(store, makers)
    with drawing(makers):
        assert live.snapshot()
        assert "grid" in store.layers()
        assert "maker-sketch" not in store.layers()
        assert live.counters()["makers_left_out"] == 1
    assert live.snapshot()
    assert store.load_tiles("maker-sketch") == [(0, 0, b"second")]
    assert live.counters()["makers_left_out"] == 1


def test_the_last_snapshot_is_written_when_makers_are_left_behind(
    makers: MapMakers, store: MapStore, caplog: pytest.LogCaptureFixture
) -> None:
    live = live_map(store, makers)
    with drawing(makers):
        live.finish()
        assert "grid" in store.layers()
    assert "they stay as they were saved before" in caplog.text


def test_maps_that_are_half_drawn_when_it_stops_are_not_kept(
    makers: MapMakers, store: MapStore, told: list[Output], caplog: pytest.LogCaptureFixture
) -> None:
    live = live_map(store, makers)
    assert live.snapshot()
    inside = threading.Event()

    def sweep() -> Sweep:
        inside.set()
        return "front", SCAN, np.zeros(3)

    makers.redraw(itertools.repeat(sweep))  # it never ends
    makers.start()
    assert inside.wait(GIVE_UP_S)
    assert makers.stop(1.0)
    live.finish()
    assert store.load_tiles("maker-sketch") == [(0, 0, b"first")]
    assert told == []
    assert "they stay as they were saved before" in caplog.text


def test_a_map_that_is_to_be_whole_is_not_saved_without_them(store: MapStore) -> None:
    makers = MapMakers([Sketch()], lambda _output: None, now_ns=lambda: 0, ask_limit_s=0.0)
    live = live_map(store, makers)
    with drawing(makers), pytest.raises(MakersBusy):
        live.save("kitchen")
    assert not store.path.with_name("kitchen.umfeld").exists()
    live.save("kitchen")
    assert store.path.with_name("kitchen.umfeld").exists()
