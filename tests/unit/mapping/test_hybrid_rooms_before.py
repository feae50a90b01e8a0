"""Rooms that were told as one or as two: what stands about for a while changes nothing, what is built does."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.hybrid.room_book import RoomBook
from mapping.hybrid.rooms import RoomMap, RoomRules, find_rooms, join_rooms
from mapping.hybrid.rooms_before import RoomsBefore

Bools = NDArray[np.bool_]

CELL_M = 0.1
EAST, WEST, CORRIDOR = (40, 90), (40, 20), (10, 50)
SETTLE = 3


def house(*, wall: bool) -> Bools:
    """A hall of 11 x 5 m over a corridor of 1.6 m; with a wall the hall is two rooms, with an opening of 0.9 m."""
    free = np.zeros((70, 120), dtype=np.bool_)
    free[2:18, 5:115] = True
    free[20:70, 5:115] = True
    free[18:20, 30:39] = True
    if wall:
        free[20:40, 60:62] = free[49:70, 60:62] = False
    return free


class Turns:
    """A room maker's turns over such houses."""

    def __init__(self) -> None:
        self.before, self.book = RoomsBefore(settle=SETTLE), RoomBook(settle=SETTLE)

    def turn(self, free: Bools, here: tuple[int, int] | None, *, row0: int = 0, col0: int = 0) -> dict[int, int]:
        """Area in cells by id."""
        before = self.before.window(free.shape, row0, col0)
        raw = find_rooms(free, CELL_M, before=before)
        found, settled = self.before.as_told(raw, before, here)
        entered = None if here is None else int(found.labels[here])
        ids = self.book.update(found, row0=row0, col0=col0, entered=entered, settled=settled)
        self.before.keep(found, ids, row0, col0)
        return {room_id: int((found.labels == number).sum()) for number, room_id in ids.items()}


def told(*, wall: bool) -> tuple[Turns, dict[int, int]]:
    turns = Turns()
    for here in (CORRIDOR, EAST, WEST, EAST, EAST):
        rooms = turns.turn(house(wall=wall), here)
    return turns, rooms


def test_a_room_that_is_cut_for_some_turns_stays_one() -> None:
    turns, rooms = told(wall=False)
    assert len(rooms) == 2
    for _ in range(SETTLE - 1):
        assert turns.turn(house(wall=True), EAST).keys() == rooms.keys()
    assert turns.turn(house(wall=False), EAST) == rooms
    for _ in range(SETTLE - 1):  # counted anew
        assert turns.turn(house(wall=True), EAST).keys() == rooms.keys()


def test_a_robot_elsewhere_does_not_settle_that_a_room_is_two() -> None:
    turns, rooms = told(wall=False)
    for here in 10 * [CORRIDOR, None]:
        assert turns.turn(house(wall=True), here).keys() == rooms.keys()


def test_a_wall_that_is_built_is_told_when_the_robot_has_been_there_long_enough() -> None:
    turns, rooms = told(wall=False)
    counts = [len(turns.turn(house(wall=True), here)) for here in (EAST, CORRIDOR, WEST, EAST, CORRIDOR, WEST)]
    assert counts == [2, 2, 2, 3, 3, 3]
    assert rooms.keys() < turns.turn(house(wall=True), WEST).keys()


def test_a_wall_that_is_taken_down_makes_one_room_at_once() -> None:
    turns, rooms = told(wall=True)
    assert len(rooms) == 3
    assert len(turns.turn(house(wall=False), CORRIDOR)) == 2


def test_it_does_not_matter_where_the_grid_begins() -> None:
    turns, rooms = told(wall=False)
    moved = np.pad(house(wall=True), ((7, 0), (3, 2)))
    assert turns.turn(moved, (EAST[0] + 7, EAST[1] + 3), row0=-7, col0=-3).keys() == rooms.keys()
    assert turns.turn(house(wall=True)[1:], (EAST[0] - 1, EAST[1]), row0=1).keys() == rooms.keys()
    assert turns.before.window((70, 120), 0, 0)[EAST] == turns.before.window((70, 120), 0, 0)[WEST]
    assert not turns.before.window((5, 5), 1000, 1000).any()


def test_a_doubtful_cut_goes_with_what_was_before() -> None:
    """An opening of 2.6 m in a room: told as one or as two before, so it stays; what is convincing does not ask."""
    free = house(wall=False)
    free[20:34, 60:62] = free[60:70, 60:62] = False
    one = np.where(house(wall=False), 1, 0).astype(np.int32)
    two = one.copy()
    two[20:, 61:] *= 2
    rules = RoomRules(stay=2.0)
    assert len(find_rooms(free, CELL_M, rules, before=one).rooms) < len(
        find_rooms(free, CELL_M, rules, before=two).rooms
    )
    nothing = np.zeros_like(one)
    plain = find_rooms(free, CELL_M)
    assert np.array_equal(find_rooms(free, CELL_M, before=nothing).labels, plain.labels)
    with pytest.raises(ValueError, match="before has the shape"):
        find_rooms(free, CELL_M, before=one[1:])


def test_rooms_are_joined_with_their_doors_and_numbered_anew() -> None:
    found = find_rooms(house(wall=True), CELL_M)
    assert len(found.rooms) == 3
    assert [(door.a, door.b) for door in found.doors] == [(1, 2), (2, 3)]
    joined, number_of = join_rooms(found, [(2, 3)])
    assert number_of == [0, 1, 2, 2]
    assert [room.number for room in joined.rooms] == [1, 2]
    assert joined.rooms[1].area_m2 == pytest.approx(found.rooms[1].area_m2 + found.rooms[2].area_m2)
    assert joined.rooms[1].clearance_m == max(room.clearance_m for room in found.rooms)
    assert [(door.a, door.b) for door in joined.doors] == [(1, 2)]
    assert np.array_equal(joined.labels, np.minimum(found.labels, 2))
    assert isinstance(joined, RoomMap)
    same, numbers = join_rooms(found, [])
    assert np.array_equal(same.labels, found.labels)
    assert numbers == [0, 1, 2, 3]
