"""The thread of the slow maps: what makers see, what is lost and counted, and that one bad maker stops no other."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.map_makers import (
    SWEEPS_WAITING_MAX,
    THINNED_M,
    THINNED_RAD,
    MapMakers,
    MapView,
    SweepTap,
    Tile,
)
from service.outputs import DocumentOut, GridOut, GridUpdateOut, Output, PoseOut
from tests.waiting import GIVE_UP_S

F64 = NDArray[np.float64]
SECOND = 1_000_000_000
SCAN = Scan(7, 0.0, np.zeros(1), np.ones(1), 0.1, 10.0)


class Notebook:
    """A maker that writes down what it is handed."""

    def __init__(self, name: str = "notes", sources: Iterable[str] = (), *, breaks: bool = False) -> None:
        self.name, self.sources, self.period_ns = name, frozenset(sources), SECOND
        self.sweeps: list[str] = []
        self.views: list[MapView] = []
        self.grids: list[GridPatch] = []
        self.kept: list[Tile] = []
        self._breaks = breaks

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        self.sweeps.append(source)

    def make(self, view: MapView) -> list[Output]:
        if self._breaks:
            raise RuntimeError("a bug")
        self.views.append(view)
        if view.grid is not None:
            self.grids.append(GridPatch(view.grid.resolution_m, view.grid.row0, view.grid.col0, view.grid.cells.copy()))
        return [DocumentOut("map/lines", view.stamp_ns, {"of": self.name})]

    def changed_tiles(self) -> list[Tile]:
        return [(0, 0, self.name.encode())]

    def restore(self, tiles: Iterable[Tile]) -> None:
        self.kept = list(tiles)
        if any(payload == b"damaged" for _, _, payload in self.kept):
            raise ValueError("damaged")


def makers_of(*makers: Notebook) -> tuple[MapMakers, list[Output]]:
    told: list[Output] = []
    return MapMakers(makers, told.append, now_ns=lambda: 0), told


def grid(cells: NDArray[np.int8], row0: int = 0, col0: int = 0, epoch: int = 1) -> GridOut:
    return GridOut(5, epoch, GridPatch(0.05, row0, col0, cells))


def test_a_maker_is_called_when_something_changed_and_its_period_is_over() -> None:
    notes = Notebook()
    makers, told = makers_of(notes)
    makers.turn(0)
    assert notes.views == []
    makers.take_output(grid(np.zeros((2, 3), dtype=np.int8)))
    makers.take_output(PoseOut(9, Pose2(1.0, 2.0, 0.0), Pose2(), np.zeros((3, 3))))
    makers.turn(1)
    (view,) = notes.views
    assert (view.stamp_ns, view.map_from_base) == (9, Pose2(1.0, 2.0, 0.0))
    makers.take_output(GridUpdateOut(10, 1, GridPatch(0.05, 1, 1, np.full((1, 1), 100, dtype=np.int8))))
    makers.turn(2)
    assert len(notes.views) == 1  # too soon
    makers.turn(1 + SECOND)
    (change,) = notes.views[1].changed
    assert (change.row0, change.col0, change.rows, change.cols) == (1, 1, 1, 1)
    makers.turn(9 * SECOND)
    assert len(notes.views) == len(told) == 2  # nothing new


def test_a_map_that_replaces_another_begins_without_what_was_measured_in_that() -> None:
    notes = Notebook(sources=("front",))
    makers, _ = makers_of(notes)
    makers.take_output(grid(np.full((2, 2), 100, dtype=np.int8)))
    makers.take_sweep("front", SCAN, np.zeros((1, 3)))
    makers.turn(0)
    makers.take_sweep("front", SCAN, np.zeros((1, 3)))
    makers.take_output(GridUpdateOut(10, 1, GridPatch(0.05, 1, 1, np.full((1, 1), 100, dtype=np.int8))))
    makers.replace({"maker-notes": [(3, 4, b"other")]})
    makers.take_sweep("front", SCAN, np.zeros((1, 3)))
    makers.take_output(grid(np.zeros((1, 1), dtype=np.int8), epoch=2))
    makers.turn(SECOND)
    assert notes.kept == [(3, 4, b"other")]
    assert len(notes.sweeps) == 2, "one before and one after"
    assert notes.grids[-1].cells.tolist() == [[0]]
    makers.replace({})
    assert makers.changed_tiles() == {"maker-notes": [(0, 0, b"notes")]}
    assert notes.kept == [], "taken up before anything is asked"


def test_updates_of_another_epoch_and_grids_of_other_names_change_nothing() -> None:
    notes = Notebook()
    makers, _ = makers_of(notes)
    makers.take_output(GridUpdateOut(10, 1, GridPatch(0.05, 0, 0, np.ones((1, 1), dtype=np.int8))))
    makers.take_output(GridOut(5, 1, GridPatch(0.05, 0, 0, np.ones((1, 1), dtype=np.int8)), name="local"))
    makers.take_output(grid(np.zeros((2, 2), dtype=np.int8), epoch=3))
    makers.take_output(GridUpdateOut(10, 2, GridPatch(0.05, 0, 0, np.ones((1, 1), dtype=np.int8))))
    makers.turn(0)
    assert [patch.cells.tolist() for patch in notes.grids] == [[[0, 0], [0, 0]]]


patches = st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(1, 5), st.integers(1, 5), st.integers(-1, 2))


@given(patches, st.lists(st.tuples(st.booleans(), patches), max_size=6))
def test_what_is_told_as_changed_holds_every_change(
    first: tuple[int, int, int, int, int], rest: list[tuple[bool, tuple[int, int, int, int, int]]]
) -> None:
    """Against a dictionary of cells kept beside it."""
    notes = Notebook()
    makers, _ = makers_of(notes)
    truth: dict[tuple[int, int], int] = {}
    epoch, place = 0, first
    for number, (is_full, (row0, col0, rows, cols, value)) in enumerate([(True, first), *rest]):
        patch = GridPatch(0.05, row0, col0, np.full((rows, cols), value, dtype=np.int8))
        before = dict(truth)
        if is_full:
            epoch, place, truth = epoch + 1, (row0, col0, rows, cols, value), {}
            makers.take_output(GridOut(0, epoch, patch))
        else:
            makers.take_output(GridUpdateOut(0, epoch, patch))
        for row in range(row0, row0 + rows):
            for col in range(col0, col0 + cols):
                if place[0] <= row < place[0] + place[2] and place[1] <= col < place[1] + place[3]:
                    truth[row, col] = value
        seen = len(notes.views)
        makers.turn(number * SECOND)
        inside = {cell for cell in truth if truth[cell] != before.get(cell, -1)}
        if len(notes.views) == seen:
            assert not inside
            continue
        view, copy = notes.views[-1], notes.grids[-1]
        told = {
            (row, col)
            for rect in view.changed
            for row in range(rect.row0, rect.row0 + rect.rows)
            for col in range(rect.col0, rect.col0 + rect.cols)
        }
        assert inside <= told
        assert {
            (row + copy.row0, col + copy.col0): int(copy.cells[row, col]) for row, col in np.ndindex(copy.cells.shape)
        } == truth


def test_sweeps_go_to_who_wants_them_and_too_many_are_counted() -> None:
    front, none = Notebook("a", ["front"]), Notebook("b")
    makers, _ = makers_of(front, none)
    assert makers.sources == {"front"}
    tap = SweepTap(makers, makers.sources)
    for number in range(SWEEPS_WAITING_MAX + 3):
        tap.take_sweep("front", SCAN, np.array([0.2 * number, 0.0, 0.0]))
    tap.take_sweep("rear", SCAN, np.zeros(3))
    makers.turn(0)
    assert len(front.sweeps) == SWEEPS_WAITING_MAX - 1
    assert (none.sweeps, none.views) == ([], [])
    assert makers.counters()["makers.sweeps_lost"] == 4
    assert makers.counters()["makers.sweeps_thinned"] == 0
    assert len(front.views) == 1


class Places(Notebook):
    """Also where each sweep was taken."""

    def __init__(self) -> None:
        super().__init__("places", ["front", "rear"])
        self.at: dict[str, list[F64]] = {"front": [], "rear": []}

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        self.at[source].append(np.atleast_2d(map_from_sensor)[0])


@pytest.mark.parametrize("beams", [1, 5])
@pytest.mark.parametrize(("seconds", "steps"), [(5, 1.0), (10, 2.0)])
def test_makers_that_are_busy_for_long_miss_no_place_where_the_robot_was(
    beams: int, seconds: int, steps: float
) -> None:
    """At 40 Hz, one laser half a metre a second fast, another that turns."""
    places = Places()
    makers, _ = makers_of(places)
    rng = np.random.default_rng(3)
    for number in range(40 * seconds):
        for source, pose in (("front", [0.0125 * number, 0.0, 0.0]), ("rear", [0.0, 0.0, 0.01 * number - 3.0])):
            row = np.array(pose) + rng.normal(size=3) * 1e-4
            makers.take_sweep(source, SCAN, row if beams == 1 else np.tile(row, (beams, 1)))
    makers.turn(0)
    front, rear = (np.array(at) for at in places.at.values())
    counts = makers.counters()
    assert (counts["makers.sweeps_lost"], counts["makers.sweeps_thinned"]) == (0, 80 * seconds - len(front) - len(rear))
    coarseness = 2.0 * steps - 1.0  # a step may end just behind one that was thinned before
    assert np.diff(front[:, 0]).max() < coarseness * THINNED_M + 0.013
    assert np.diff(rear[:, 2]).max() < coarseness * THINNED_RAD + 0.011
    assert front[0, 0] < 0.001, "the first"
    assert front[-1, 0] > 0.5 * seconds - 0.02, "and where the robot is now"


def test_a_map_drawn_again_takes_every_kept_sweep_once_and_each_is_made_once() -> None:
    class Drawn(Notebook):
        def start_anew(self) -> None:
            self.sweeps.clear()

    made: list[str] = []

    def kept(source: str) -> Callable[[], tuple[str, Scan, F64]]:
        def make() -> tuple[str, Scan, F64]:
            made.append(source)
            return source, SCAN, np.zeros(3)

        return make

    one, two, other = Drawn("one", ["front"]), Drawn("two", ["front", "rear"]), Notebook("other", ["front"])
    makers, _ = makers_of(one, two, other)
    makers.take_sweep("front", SCAN, np.zeros(3))
    makers.turn(0)
    makers.redraw([kept("front"), kept("rear"), kept("front")])
    makers.turn(SECOND)
    assert (one.sweeps, two.sweeps) == (["front"] * 2, ["front", "rear", "front"])
    assert other.sweeps == ["front"], "what moves by itself, or does not care, is let be"
    assert made == ["front", "rear", "front"]
    assert len(one.views) == 2, "and it is told"


def test_a_maker_that_breaks_stops_no_other(caplog: pytest.LogCaptureFixture) -> None:
    good = Notebook("good")
    makers, told = makers_of(Notebook("bad", breaks=True), good)
    for turn in range(3):
        makers.take_output(grid(np.full((1, 1), turn, dtype=np.int8), epoch=turn))
        makers.turn(turn * SECOND)
    assert len(good.views) == len(told) == 3
    assert makers.counters()["makers.errors"] == 3
    assert sum("bad: RuntimeError" in record.getMessage() for record in caplog.records) == 1


def test_what_was_kept_comes_back_and_what_is_damaged_begins_empty(caplog: pytest.LogCaptureFixture) -> None:
    one, two = Notebook("one"), Notebook("two")
    makers, told = makers_of(one, two)
    stored = {"maker-one": [(0, 0, b"one")], "maker-two": [(0, 0, b"damaged")]}
    makers.restore(lambda layer: stored[layer])
    assert (one.kept, two.kept) == ([(0, 0, b"one")], [])
    assert "two: begins empty" in caplog.text
    assert makers.changed_tiles() == {"maker-one": [(0, 0, b"one")], "maker-two": [(0, 0, b"two")]}
    makers.turn(0)
    assert len(told) == 2  # what came back is told without waiting for news


def test_questions_are_answered_by_the_thread_and_errors_go_to_who_asked() -> None:
    makers, _ = makers_of(Notebook())
    makers.start()
    try:
        assert makers.ask(lambda: 5) == 5
        with pytest.raises(ZeroDivisionError):
            makers.ask(lambda: 1 // 0)
    finally:
        assert makers.stop(GIVE_UP_S)
    assert makers.ask(lambda: 6) == 6  # nobody is left to disturb
