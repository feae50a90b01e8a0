"""The parts around fusion: its thread, the locks, the live map on disk, sd_notify, clocks."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.readings import ChainReading, DeviceEvent, LinkState, Reading, ScanReading, WheelReading
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from service.clock import CrankedClock, SystemClock, wall_offset_ns
from service.daemon import Daemon, network_settings
from service.errors import Trouble
from service.fusion import Fusion, Parts
from service.layers import BuildingLayer
from service.live_map import GRID, LiveMap, restore, told_of
from service.locks import Claims
from service.outputs import GridOut, GridUpdateOut, HealthOut, Output, ScanOut
from service.rpc import CallRefused
from service.sensors import Laser
from service.store import MapStore, StoreNotWritten, occupancy_patch
from service.systemd import Notifier
from service.worker import Worker, _Asked
from tests.waiting import GIVE_UP_S, free_port

SECOND = 1_000_000_000


def scan(stamp_ns: int) -> ScanReading:
    return ScanReading(stamp_ns, 0.0, 100_000_000, np.linspace(-1, 1, 21), np.full(21, 2.0), 0.1, 10.0)


# --- the fusion thread


class Office:
    """A worker with a cranked clock and what it put out."""

    def __init__(self) -> None:
        self.clock = CrankedClock(SECOND)
        self.told: list[Output] = []
        self.beats: list[int] = []
        self.fusion = Fusion(Parts(sensors={"front": Laser("front", Pose2())}))
        self.worker = Worker(
            self.fusion,
            self.told.append,
            now_ns=self.clock.now_ns,
            beat=self.beats.append,
            health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
        )


def test_readings_become_outputs_and_every_turn_beats() -> None:
    office = Office()
    office.worker.sink("front", scan(SECOND))
    office.worker.turn(0.0)
    assert [type(each) for each in office.told] == [ScanOut, HealthOut]
    assert office.beats == [SECOND]


def test_health_comes_every_second_and_at_once_when_a_device_changes() -> None:
    office = Office()

    def told_at() -> list[int]:
        return [each.stamp_ns // 1_000_000 for each in office.told if isinstance(each, HealthOut)]

    for _ in range(30):
        office.worker.turn(0.0)
        office.clock.turn(100_000_000)
    assert told_at() == [1000, 2000, 3000]
    office.worker.sink("front", DeviceEvent(office.clock.now_ns(), LinkState.ABSENT, "gone"))
    office.worker.turn(0.0)
    assert told_at()[-1] == 4000
    office.clock.turn(20_000_000)
    office.worker.sink("front", DeviceEvent(office.clock.now_ns(), LinkState.ABSENT, "gone"))
    office.worker.turn(0.0)
    assert told_at()[-1] == 4000  # a device that flutters does not flood
    office.clock.turn(80_000_000)
    office.worker.turn(0.0)
    assert told_at()[-1] == 4100


class Busy(Office):
    """A worker whose fusion only notes what it is asked to do; while it does the first of it, readings come."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.done: list[str] = []
        self.coming: list[tuple[str, Reading | DeviceEvent]] = []
        monkeypatch.setattr(self.fusion, "stream", self._stream)
        monkeypatch.setattr(self.fusion, "settle", lambda now_ns: self.done.append("settle"))
        monkeypatch.setattr(self.fusion, "tick", lambda now_ns: [])

    def _stream(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> list[Output]:
        self.done.append(f"{source} {item.state.name}" if isinstance(item, DeviceEvent) else source)
        coming, self.coming = self.coming, []
        for each in coming:
            self.worker.sink(*each)
        return []

    def turn(self) -> list[str]:
        self.done.clear()
        self.worker.turn(0.0)
        return list(self.done)


ROUND, MOTION, SWEEP = ChainReading(SECOND, ()), WheelReading(SECOND, 0, 0, True), scan(SECOND)
SILENT = DeviceEvent(SECOND, LinkState.SILENT, "", None)


def test_a_sweep_goes_before_sonar_rounds_questions_and_what_else_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that comes while a round is worked on, too. Motions, which de-skew it, keep their place before it."""
    office = Busy(monkeypatch)
    office.worker.sink("left", ROUND)
    office.worker._queue.put("", _Asked(lambda: office.done.append("question")))
    for source, item in (("drive", MOTION), ("front", SWEEP), ("right", ROUND)):
        office.worker.sink(source, item)
    assert office.turn() == ["drive", "front", "left", "question", "right", "settle"]
    office.worker.sink("left", ROUND)
    office.worker.sink("right", ROUND)
    office.coming = [("rear", ROUND), ("drive", MOTION), ("front", SWEEP), ("top", ROUND)]
    assert office.turn() == ["left", "drive", "front", "right", "settle"]
    assert office.turn() == ["rear", "top", "settle"]


def test_nothing_overtakes_news_about_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """A round that was heard before a chain fell silent would make it fresh again; the sweep of a laser that is back
    would be called lost."""
    office = Busy(monkeypatch)
    for source, item in (("left", ROUND), ("left", SILENT), ("front", SILENT)):
        office.worker.sink(source, item)
    office.coming = [("front", SWEEP)]
    assert office.turn() == ["left", "left SILENT", "front SILENT", "front", "settle"]
    office.worker.sink("left", ROUND)
    office.coming = [("front", SILENT), ("front", SWEEP)]
    assert office.turn() == ["left", "settle"]
    assert office.turn() == ["front SILENT", "front", "settle"]


def test_motions_wake_fusion_where_they_are_read_and_otherwise_as_often_as_poses_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    office = Office()
    is_read = True
    worker = Worker(
        office.fusion,
        office.told.append,
        now_ns=office.clock.now_ns,
        beat=office.beats.append,
        health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
        odometry_is_read=lambda: is_read,
    )
    woken: list[int] = []

    def put(_source: str, item: WheelReading, *, urgent: bool) -> None:
        if urgent:
            woken.append(item.stamp_ns // 1_000_000)

    monkeypatch.setattr(worker._queue, "put", put)
    for ms in range(0, 30, 10):
        worker.sink("drive", WheelReading(ms * 1_000_000, 0, 0, True))
    assert woken == [0, 10, 20]
    is_read = False
    woken.clear()
    for ms in range(100, 200, 10):
        worker.sink("drive", WheelReading(ms * 1_000_000, 0, 0, True))
    assert woken == [100, 130, 160, 190]
    woken.clear()
    worker.sink("drive", WheelReading(50_000_000, 0, 0, True))
    assert woken == [50], "whose clock went back begins anew"
    woken.clear()
    worker.sink("front", scan(60_000_000))
    worker.sink("drive", DeviceEvent(70_000_000, LinkState.ABSENT, "gone"))
    assert woken == [60, 70], "everything else is taken at once"
    monkeypatch.undo()
    office.clock.turn(SECOND)
    worker.sink("front", scan(office.clock.now_ns()))
    worker.turn(0.0)
    monkeypatch.setattr(worker._queue, "put", put)
    woken.clear()
    for ms in range(1000, 1050, 10):
        worker.sink("drive", WheelReading(ms * 1_000_000, 0, 0, True))
    assert woken == [1000, 1010, 1040], "the first behind a scan, beside those of the poses"


def test_a_bug_costs_one_reading_not_the_daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    office = Office()
    good = office.fusion.stream
    monkeypatch.setattr(office.fusion, "stream", lambda *_: 1 / 0)
    office.worker.sink("front", scan(SECOND))
    office.worker.turn(0.0)
    monkeypatch.setattr(office.fusion, "stream", good)
    office.worker.sink("front", scan(SECOND))
    office.worker.turn(0.0)
    assert office.worker.counters()["fusion.errors"] == 1
    assert sum(isinstance(each, ScanOut) for each in office.told) == 1


def test_others_ask_between_readings_and_get_results_and_errors() -> None:
    office = Office()
    clock = SystemClock()
    worker = Worker(
        office.fusion,
        office.told.append,
        now_ns=clock.now_ns,
        beat=lambda _: None,
        health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
    )
    worker.start()
    try:
        assert worker.ask(threading.current_thread).name == "fusion"
        with pytest.raises(ZeroDivisionError):
            worker.ask(lambda: 1 // 0)
    finally:
        assert worker.stop(GIVE_UP_S)
    assert worker.ask(lambda: 7) == 7  # after the thread has ended the maps belong to whoever asks


def test_who_asks_as_the_thread_ends_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that is late in its last turn never looks at its queue again."""
    office = Office()
    late, go_on = threading.Event(), threading.Event()

    def slow(_source: str, _item: object, _now_ns: int) -> list[Output]:
        late.set()
        assert go_on.wait(GIVE_UP_S)
        return []

    monkeypatch.setattr(office.fusion, "stream", slow)
    office.worker.start()
    office.worker.sink("front", scan(SECOND))
    assert late.wait(GIVE_UP_S)
    assert not office.worker.stop(0.0)
    office.worker.turn(0.0)  # the last turn has taken what there was
    threading.Timer(0.1, go_on.set).start()
    asked = []
    monkeypatch.setattr(office.worker, "turn", lambda _timeout_s: asked.append("turned"))
    assert office.worker.ask(lambda: 7) == 7
    assert asked == ["turned"]


def test_a_flood_is_bounded_and_counted_but_events_survive(monkeypatch: pytest.MonkeyPatch) -> None:
    office = Office()
    office.worker.sink("front", DeviceEvent(0, LinkState.SILENT, "silent"))
    for number in range(5000):
        office.worker.sink("front", scan(number))
    counters = office.worker.counters()
    assert counters["queue.depth"] <= 2048
    assert counters["queue.dropped.front"] == 5001 - counters["queue.depth"]
    seen: list[object] = []

    def remember(_source: str, item: object, _now_ns: int) -> list[Output]:
        seen.append(item)
        return []

    monkeypatch.setattr(office.fusion, "stream", remember)
    office.worker.turn(0.0)
    assert isinstance(seen[0], DeviceEvent)


# --- locks


def test_a_port_belongs_to_one_daemon(tmp_path: Path) -> None:
    port = tmp_path / "tty"
    alias = tmp_path / "alias"
    alias.symlink_to(port)
    with Claims() as first, Claims() as second:
        first.claim_ports([str(port)])
        for _ in range(5):
            with pytest.raises(Trouble, match=f"process {os.getpid()}\\).*port of its own"):
                second.claim_ports([str(alias)])
    with Claims() as third:
        third.claim_ports([str(alias)])


def test_a_device_is_taken_from_a_daemon_that_lost_it_but_not_from_one_that_has_it(tmp_path: Path) -> None:
    """Numbers are given anew: /dev/ttyACM0, open under one link, is another adapter after both were replugged."""
    device = tmp_path / "ttyACM0"
    device.touch()
    for link in ("one", "other"):
        (tmp_path / link).symlink_to(device)
    with Claims() as first:
        first.claim_ports([str(tmp_path / "one")])
        with device.open(), Claims() as second, pytest.raises(Trouble, match="in use by another"):
            second.claim_ports([str(tmp_path / "other")])
        with Claims() as second:
            second.claim_ports([str(tmp_path / "other")])
        with Claims() as second, pytest.raises(Trouble, match="in use by another"):
            second.claim_ports([str(tmp_path / "one")])  # the same name is the same device to both


def test_a_killed_daemon_leaves_no_lock(tmp_path: Path) -> None:
    code = """
import sys, time
from service.locks import Claims
claims = Claims()
claims.claim_ports(sys.argv[1:])
print("held", flush=True)
time.sleep(600)
"""
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "tty")], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with Claims() as claims:
        with pytest.raises(Trouble, match=f"process {holder.pid}"):
            claims.claim_ports([str(tmp_path / "tty")])
        holder.kill()
        holder.wait()
        holder.stdout.close()
        claims.claim_ports([str(tmp_path / "tty")])


# --- the live map


def building(**changes: float) -> BuildingLayer:
    grid = OccupancyGrid(resolution_m=changes.get("resolution_m", 0.05))
    return BuildingLayer(grid, {"front"}, publish_period_ns=SECOND, update_period_ns=SECOND // 5)


def draw(layer: BuildingLayer, x_m: float, y_m: float = 0.0) -> None:
    pose = Pose2(x_m, y_m)
    for _ in range(3):
        layer.grid.insert_scan(pose, np.linspace(-3, 3, 361), np.full(361, 2.0), range_max_m=10.0)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "live.umfeld", wall_ns=lambda: 1) as opened:
        yield opened


@dataclass
class Standing:
    """A robot that stands at a place."""

    at: Pose2 | None
    replaced_by: list[tuple[int, int, bytes]] = field(default_factory=list)
    maps_begun: int = 0

    def pose(self) -> Pose2 | None:
        return self.at

    def drain(self) -> None:
        pass

    def map_was_replaced(self, tiles: Iterable[tuple[int, int, bytes]], slam: Iterable[tuple[int, int, bytes]]) -> None:
        self.replaced_by = list(tiles)

    def begin_map(self) -> None:
        self.maps_begun += 1
        self.at = Pose2()

    def kept_of_slam(self) -> None:
        return None


def live(layer: BuildingLayer, store: MapStore | None, pose: Pose2 | None = None) -> LiveMap:
    return LiveMap(layer, store, ask=lambda work: work(), fusion=Standing(pose))


def test_a_map_comes_back_as_it_was_left_and_the_robot_where_it_stood(store: MapStore) -> None:
    layer = building()
    draw(layer, 0.0)
    draw(layer, 30.0, -5.0)
    assert live(layer, store, Pose2(30.0, -5.0, 1.0)).snapshot()
    again = building()
    assert restore(again.grid, store) == Pose2(30.0, -5.0, 1.0)
    assert list(again.grid.tiles()) == list(layer.grid.tiles())
    np.testing.assert_array_equal(occupancy_patch(store).cells, layer.grid.patch().cells)


@pytest.mark.parametrize(
    ("later_s", "told"),
    [
        (12, "saved at 1970-01-01 00:00:00 UTC, 12 s ago"),
        (600, "10 min ago"),
        (7 * 3600, "7 h ago"),
        (9 * 86400, "9 days ago"),
        (-3600, "by a clock that was ahead of today's"),
    ],
)
def test_the_start_says_how_much_was_restored_and_how_old_it_is(store: MapStore, later_s: int, told: str) -> None:
    layer = building()
    draw(layer, 0.0)
    assert live(layer, store).snapshot()
    told_now = told_of(store, layer.grid, 1 + later_s * SECOND)
    assert told_now.startswith(f"{store.path}, 12 m² known, ")
    assert told in told_now


def test_a_snapshot_writes_only_what_changed(store: MapStore) -> None:
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)
    assert keeper.snapshot()
    before = keeper.counters()["store_tiles"]
    assert keeper.snapshot()
    assert keeper.counters()["store_tiles"] == before
    draw(layer, 50.0)
    assert keeper.snapshot()
    assert 0 < keeper.counters()["store_tiles"] - before <= 2 * 4


def test_a_last_snapshot_that_the_disk_refuses_is_told(store: MapStore, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)

    def refuse(*_: object, **__: object) -> int:
        raise StoreNotWritten("m.umfeld: not saved: database or disk is full; free some space")

    with monkeypatch.context() as full:
        full.setattr(MapStore, "snapshot", refuse)
        with pytest.raises(Trouble, match="free some space"):
            keeper.finish()
    keeper.finish()  # there is room again: nothing was lost meanwhile
    assert store.load_tiles(GRID)


def test_a_map_of_another_resolution_is_refused_with_the_setting_to_change(store: MapStore) -> None:
    layer = building()
    draw(layer, 0.0)
    live(layer, store).snapshot()
    with pytest.raises(Trouble, match=r"resolution_m 0.05, the configuration 0.1; set resolution_m in \[grid\]"):
        restore(building(resolution_m=0.1).grid, store)


def test_saving_and_loading_by_name(store: MapStore) -> None:
    layer = building()
    keeper = live(layer, store, Pose2())
    draw(layer, 0.0)
    receipt = keeper.save("kitchen")
    assert Path(str(receipt["path"])) == store.path.parent / "kitchen.umfeld"
    kitchen = layer.grid.patch()
    draw(layer, 40.0)
    assert layer.grid.patch().cells.shape != kitchen.cells.shape
    assert keeper.load("kitchen")["tiles"] == len(store.load_tiles(GRID))
    np.testing.assert_array_equal(layer.grid.patch().cells, kitchen.cells)
    np.testing.assert_array_equal(occupancy_patch(store).cells, kitchen.cells)
    assert {each["name"] for each in keeper.list()["maps"]} == {"kitchen", "live", "replaced"}
    assert keeper.info()["occupied_cells"] > 10
    with pytest.raises(Trouble, match="kitche"):
        keeper.load("kitche")
    with pytest.raises(CallRefused, match="live map itself"):
        keeper.load("live")


def test_the_place_on_the_earth_goes_with_the_map(store: MapStore) -> None:
    layer, place = building(), {"latitude_deg": 49.42, "longitude_deg": 7.75, "height_m": 0.0, "yaw_deg": 30.0}
    keeper = LiveMap(layer, store, ask=lambda work: work(), fusion=Standing(None), anchor=place)
    draw(layer, 0.0)
    keeper.save("kitchen")
    assert live(layer, store).info()["store"]["meta"]["anchor"] == place
    draw(layer, 10.0)
    live(layer, store).snapshot()  # a later start that does not say it
    assert store.get_meta("anchor") == place
    with MapStore.open(store.path.parent / "hall.umfeld", wall_ns=lambda: 1) as hall:
        hall.snapshot({GRID: list(layer.grid.tiles())}, {GRID: store.get_meta(GRID)})
    keeper.load("hall")
    assert store.get_meta("anchor") is None, "another map, which does not say where it lies"
    keeper.load("kitchen")
    assert store.get_meta("anchor") == place


def test_a_torn_map_is_not_loaded_and_the_live_one_stays(store: MapStore) -> None:
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)
    with MapStore.open(store.path.parent / "torn.umfeld", wall_ns=lambda: 1) as torn:
        tiles = list(layer.grid.tiles())
        row, column, payload = tiles[-1]
        torn.snapshot({GRID: [*tiles[:-1], (row, column, payload[:-9])]})
    before = layer.grid.patch()
    with pytest.raises(CallRefused, match=r"torn.*live map is as it was"):
        keeper.load("torn")
    np.testing.assert_array_equal(layer.grid.patch().cells, before.cells)


def names_beside(store: MapStore) -> set[str]:
    return {path.stem for path in store.path.parent.glob("*.umfeld")}


def refusing(*_: object, **__: object) -> int:
    raise StoreNotWritten("m.umfeld: not saved: database or disk is full; free some space")


def test_a_new_map_begins_empty_and_the_one_before_is_kept(store: MapStore) -> None:
    layer, robot = building(), Standing(Pose2(30.0, -5.0, 1.0))
    keeper = LiveMap(layer, store, ask=lambda work: work(), fusion=robot)
    draw(layer, 0.0)
    draw(layer, 30.0, -5.0)
    old = layer.grid.patch()
    answer = keeper.new("old-house")
    assert answer["kept"]["name"] == "old-house"
    assert robot.maps_begun == 1
    assert (layer.grid.patch().cells.size, store.load_tiles(GRID), store.get_meta("pose")) == (0, [], None)
    with MapStore.open(Path(answer["kept"]["path"]), wall_ns=lambda: 0, read_only=True) as kept:
        np.testing.assert_array_equal(occupancy_patch(kept).cells, old.cells)
    draw(layer, 100.0)
    keeper.snapshot()
    again = building()
    restore(again.grid, store)
    new = again.grid.patch()
    assert (new.row0, new.cells.shape) == (layer.grid.patch().row0, layer.grid.patch().cells.shape)
    assert new.cells.shape[1] * 0.05 < 10.0, "nothing of the old house is in it"
    keeper.load("old-house")  # and back
    np.testing.assert_array_equal(layer.grid.patch().cells, old.cells)


def test_a_new_map_needs_no_name_and_replaces_none(store: MapStore) -> None:
    layer = building()
    keeper = live(layer, store)
    assert keeper.new()["kept"] is None, "there was nothing"
    for number in range(3):
        draw(layer, float(number))
        assert keeper.new()["kept"] is not None
    assert names_beside(store) == {
        "live",
        "until-19700101-000000",
        "until-19700101-000000-2",
        "until-19700101-000000-3",
    }
    draw(layer, 0.0)
    for name, why in (("until-19700101-000000", "there already"), ("live", "the live map's own")):
        with pytest.raises(Trouble, match=f"{name}: is {why}"):
            keeper.new(name)
    assert layer.grid.patch().cells.size
    assert store.load_tiles(GRID)


@pytest.mark.parametrize("refused", ["snapshot", "save_as"])
def test_a_full_disk_lets_the_old_map_go_on(store: MapStore, monkeypatch: pytest.MonkeyPatch, refused: str) -> None:
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)
    keeper.save("kitchen")
    draw(layer, 10.0)
    before = layer.grid.patch().cells
    with monkeypatch.context() as full:
        full.setattr(MapStore, refused, refusing)
        with pytest.raises(Trouble, match="free some space"):
            keeper.new()
        with pytest.raises(Trouble, match="free some space"):
            keeper.load("kitchen")
    np.testing.assert_array_equal(layer.grid.patch().cells, before)
    assert names_beside(store) <= {"live", "kitchen", "replaced"}, "no copy is left of a map that goes on"
    keeper.snapshot()
    np.testing.assert_array_equal(occupancy_patch(store).cells, before)


def test_a_map_that_is_replaced_by_a_loaded_one_can_be_loaded_again(store: MapStore) -> None:
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)
    keeper.save("kitchen")
    draw(layer, 20.0)
    unsaved = layer.grid.patch().cells
    assert keeper.load("kitchen")["kept"] == "replaced"
    assert keeper.load("replaced")["kept"] == "replaced"
    np.testing.assert_array_equal(layer.grid.patch().cells, unsaved)
    keeper.load("replaced")
    assert layer.grid.patch().cells.shape[1] < unsaved.shape[1]


def test_ground_that_is_unknown_again_is_so_in_the_file_as_well(store: MapStore) -> None:
    """After a correction of the map: what other programs read of the file may be no freer than the live map."""
    layer = building()
    keeper = live(layer, store)
    draw(layer, 0.0)
    draw(layer, 30.0)
    keeper.snapshot()
    layer.grid.clear()
    draw(layer, 0.0)
    keeper.snapshot()
    np.testing.assert_array_equal(occupancy_patch(store).cells, layer.grid.patch().cells)


def test_subscribers_of_a_new_map_are_told_that_nothing_is_known(store: MapStore) -> None:
    layer, mirror = building(), Mirror()
    keeper = live(layer, store)
    draw(layer, 40.0)
    for output in layer.outputs(None, 0, SECOND):
        mirror.take(output, SECOND)
    assert (mirror.full.cells >= 0).any()
    keeper.new()
    for output in layer.outputs(None, 0, 2 * SECOND):
        mirror.take(output, 2 * SECOND)
    assert (mirror.full.cells == -1).all()
    draw(layer, 0.0)
    for now_ns in (3 * SECOND, 4 * SECOND):
        for output in layer.outputs(None, 0, now_ns):
            mirror.take(output, now_ns)
    truth = layer.grid.patch(whole_tiles=True)
    np.testing.assert_array_equal(mirror.full.cells, truth.cells)
    assert truth.cells.shape[1] * 0.05 < 13.0, "as wide as the new map, not as both"


def test_without_a_store_calls_are_refused_in_words() -> None:
    keeper = live(building(), None)
    assert keeper.snapshot()
    with pytest.raises(CallRefused, match=r"\[store\] enabled"):
        keeper.save("x")


# --- what of the grid is published when


class Mirror:
    """A client: takes full grids, applies updates of the same epoch, and minds the rules."""

    def __init__(self) -> None:
        self.full = GridPatch(0.05, 0, 0, np.full((1, 1), -1, dtype=np.int8))
        self.epoch = 0
        self.full_ns: list[int] = []

    def take(self, output: Output, now_ns: int) -> None:
        assert isinstance(output, GridOut | GridUpdateOut)
        patch = output.patch
        if isinstance(output, GridOut):
            assert output.epoch == self.epoch + 1
            self.epoch, self.full = output.epoch, GridPatch(0.05, patch.row0, patch.col0, patch.cells.copy())
            self.full_ns.append(now_ns)
            return
        assert output.epoch == self.epoch
        row, col = patch.row0 - self.full.row0, patch.col0 - self.full.col0
        assert row >= 0
        assert col >= 0
        target = self.full.cells[row : row + patch.cells.shape[0], col : col + patch.cells.shape[1]]
        assert target.shape == patch.cells.shape
        target[:] = patch.cells


def test_a_client_that_applies_updates_has_the_grid() -> None:
    layer, mirror = building(), Mirror()
    rng = np.random.default_rng(1)
    now_ns = 0
    for step in range(60):
        now_ns += 150_000_000
        if step % 3:
            draw(layer, float(rng.uniform(-3, 3)) + step * 0.2)
        for output in layer.outputs(None, now_ns, now_ns):
            mirror.take(output, now_ns)
    now_ns += 2 * SECOND
    for output in layer.outputs(None, now_ns, now_ns):
        mirror.take(output, now_ns)
    assert np.diff(mirror.full_ns).min() >= SECOND
    truth = layer.grid.patch(whole_tiles=True)
    assert (truth.row0, truth.col0) == (mirror.full.row0, mirror.full.col0)
    np.testing.assert_array_equal(truth.cells, mirror.full.cells)


def test_a_grid_that_does_not_change_is_not_sent_again() -> None:
    layer = building()
    assert layer.outputs(None, 0, 0) == []
    draw(layer, 0.0)
    assert [type(each) for each in layer.outputs(None, 0, SECOND)] == [GridOut]
    assert [layer.outputs(None, 0, n * SECOND) for n in range(2, 20)] == [[]] * 18


# --- systemd


def test_the_service_manager_hears_ready_beats_and_stopping(tmp_path: Path) -> None:
    address = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(GIVE_UP_S)
        notifier = Notifier({"NOTIFY_SOCKET": str(address), "WATCHDOG_USEC": "10000000"})
        assert notifier.watched
        notifier.ready("4 devices")
        assert manager.recv(4096) == b"READY=1\nSTATUS=4 devices"
        for now_s in (0, 1, 4, 6, 7, 11):
            notifier.beat(now_s * SECOND)
        notifier.stopping("bye")
        heard = [manager.recv(4096) for _ in range(4)]
        assert heard == [b"WATCHDOG=1"] * 3 + [b"STOPPING=1\nSTATUS=bye"]


def test_an_abstract_address_and_a_deaf_manager() -> None:
    name = f"@umfeld-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name[1:])
        manager.settimeout(GIVE_UP_S)
        Notifier({"NOTIFY_SOCKET": name}).status("x")
        assert manager.recv(100) == b"STATUS=x"
    Notifier({"NOTIFY_SOCKET": name}).status("nobody listens")
    Notifier({}).ready("nobody ever did")


def test_a_watchdog_for_another_process_is_not_ours() -> None:
    assert not Notifier({"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}).watched
    assert Notifier({"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": str(os.getpid())}).watched
    assert not Notifier({"WATCHDOG_USEC": "soon"}).watched


# --- clocks


def test_the_system_clocks_agree_with_the_system() -> None:
    import time

    clock = SystemClock()
    before = time.time_ns()
    wall = clock.wall_from_monotonic_ns(clock.now_ns())
    assert before - 5_000_000 <= wall <= time.time_ns() + 5_000_000


def test_one_moment_has_one_label_until_the_clock_is_really_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """Labels came from a new reading each: messages of the same moment ran backwards by some hundred nanoseconds."""
    wall_ahead = [100 * SECOND]
    clocks = SimpleNamespace(monotonic_ns=lambda: 10 * SECOND, time_ns=lambda: 10 * SECOND + wall_ahead[-1])
    monkeypatch.setattr("service.clock.time", clocks)
    clock = SystemClock()
    for jitter_ns in (0, 300, -300, 60_000, -60_000):
        wall_ahead.append(100 * SECOND + jitter_ns)
        assert clock.wall_from_monotonic_ns(7) == 100 * SECOND + 7
    for step_ns in (3600 * SECOND, -3600 * SECOND, 150_000):
        wall_ahead.append(wall_ahead[-1] + step_ns)
        assert clock.wall_from_monotonic_ns(7) == wall_ahead[-1] + 7


def test_a_label_is_right_although_the_clocks_were_not_read_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process was stopped for a second between two readings; the next ones are close together."""
    monotonic = iter((10 * SECOND, 11 * SECOND, 12 * SECOND, 12 * SECOND + 200))
    wall = iter((110 * SECOND, 112 * SECOND + 100))
    clocks = SimpleNamespace(monotonic_ns=lambda: next(monotonic), time_ns=lambda: next(wall))
    monkeypatch.setattr("service.clock.time", clocks)
    assert wall_offset_ns() == 100 * SECOND


def test_a_cranked_clock_moves_when_turned() -> None:
    clock = CrankedClock(5, wall_offset_ns=100)
    assert clock.turn(7) == clock.now_ns() == 12
    assert clock.wall_from_monotonic_ns(12) == 112
    with pytest.raises(ValueError):
        clock.turn(-1)


# --- configuration of the router


def test_the_router_is_set_up_as_configured() -> None:
    from service.config import Config

    config = Config.model_validate(
        {
            "network": {
                "listen": ("tls/0.0.0.0:7447",),
                "connect": ("tls/fleet:7447",),
                "tls": {"root_ca_certificate": "a", "listen_certificate": "b", "listen_private_key": "c"},
                "config": "~/zenoh.json5",
            }
        }
    )
    settings = network_settings(config)
    assert (settings.listen, settings.connect) == (("tls/0.0.0.0:7447",), ("tls/fleet:7447",))
    assert settings.tls is not None
    assert (settings.tls.root_ca_certificate, settings.tls.private_key, settings.tls.mutual) == ("a", "c", True)
    assert settings.zenoh_config == Path.home() / "zenoh.json5"


def test_what_does_not_end_in_time_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exit code alone said that something was late."""
    from service.config import load

    file = tmp_path / "umfeld.toml"
    file.write_text(f'[network]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n[store]\nenabled = false\n')
    daemon = Daemon(load(file, environment={}))
    daemon.start()
    publisher = daemon._publisher
    assert publisher is not None
    close = publisher.close

    def late(deadline_s: float) -> bool:
        close(GIVE_UP_S)
        return False

    monkeypatch.setattr(publisher, "close", late)
    assert not daemon.stop()
    assert "publishing did not end within its time" in caplog.text


def test_a_start_that_fails_gives_everything_back(tmp_path: Path) -> None:
    from service.config import load

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        file = tmp_path / "umfeld.toml"
        file.write_text(
            f'[network]\nlisten = ["tcp/127.0.0.1:{taken.getsockname()[1]}"]\n[store]\npath = "{tmp_path}/m.umfeld"\n'
            f'[lasers.front]\ndriver = "hokuyo"\nport = "{tmp_path}/tty"\n'
        )
        with pytest.raises(Trouble, match="in use"):
            Daemon(load(file, environment={})).start()
    with Claims() as claims, MapStore.open(tmp_path / "m.umfeld", wall_ns=lambda: 1):
        claims.claim_ports([f"{tmp_path}/tty"])
