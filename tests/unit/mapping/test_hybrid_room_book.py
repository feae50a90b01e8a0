"""Ids of rooms against the truth of a plan, while furniture moves, doors close, walls fall and a wing is found."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.hybrid.room_book import RoomBook
from mapping.hybrid.rooms import RoomMap, find_rooms

Bools = NDArray[np.bool_]
I32 = NDArray[np.int32]

CELL_M = 0.1
_WALL = 2


def building() -> tuple[Bools, I32, list[tuple[int, int]]]:
    """A corridor with five rooms on each side; room numbers, and the first cell of each room's door (5 cells wide)."""
    truth = np.zeros((120, 230), dtype=np.int32)
    truth[52:68, 5:225] = 1
    doors = []
    for k in range(5):
        left = 5 + 44 * k
        truth[10:50, left : left + 42] = 2 + k
        truth[70:110, left : left + 42] = 7 + k
        doors += [(50, left + 12), (68, left + 25)]
    free = truth > 0
    for row, col in doors:
        free[row : row + _WALL, col : col + 10] = True
    return free, truth, doors


def meaning(ids: dict[int, int], found: RoomMap, truth: I32) -> dict[int, int]:
    """The true room that makes up most of the region of each id."""
    return {room_id: int(np.bincount(truth[found.labels == n]).argmax()) for n, room_id in ids.items()}


def test_no_id_changes_its_meaning_in_two_hundred_laps() -> None:
    plan, truth, doors = building()
    random = np.random.default_rng(4)
    book = RoomBook()
    meant: dict[int, int] = {}
    first_id: dict[int, int] = {}
    for lap in range(200):
        free = plan.copy()
        for _ in range(25):  # furniture stands elsewhere in each lap
            row, col = int(random.integers(12, 105)), int(random.integers(8, 215))
            piece = (slice(row, row + int(random.integers(2, 9))), slice(col, col + int(random.integers(2, 9))))
            free[piece] &= truth[piece] < 2  # not in the corridor, nor in walls
        for row, col in doors:
            if random.random() < 0.2:
                free[row : row + _WALL, col : col + 10] = False  # closed
        if lap < 60:
            free[:, 137:] = False  # the east wing is not found yet
        if 90 <= lap < 110:
            free[10:50, 47:49] = True  # the wall between rooms 2 and 3 is down
        top = int(random.integers(0, 5))  # what is known of the grid begins elsewhere
        found = find_rooms(free[top:], CELL_M)
        ids = book.update(found, row0=100 + top, col0=-7)
        assert len(set(ids.values())) == len(found.rooms)
        for room_id, room in meaning(ids, found, truth[top:]).items():
            if 90 <= lap < 110 and room in (2, 3):
                continue
            assert meant.setdefault(room_id, room) == room, f"lap {lap}: id {room_id}"
            number = next(n for n, k in ids.items() if k == room_id)
            if (found.labels[truth[top:] == room] == number).mean() > 0.8:  # in one piece
                assert first_id.setdefault(room, room_id) == room_id, f"lap {lap}: room {room}"
    assert sorted(first_id) == list(range(1, 12))
    assert len(book.known_ids) <= 22  # furniture cut a room in two now and then


def test_a_room_that_is_cut_in_two_keeps_its_id_in_the_larger_part_and_gets_both_back() -> None:
    whole = np.zeros((60, 120), dtype=np.bool_)
    whole[5:55, 5:115] = True
    split = whole.copy()
    split[:, 80:82] = False
    book = RoomBook()
    assert book.update(find_rooms(whole, CELL_M)) == {1: 1}
    assert book.update(find_rooms(split, CELL_M)) == {1: 1, 2: 2}
    for _ in range(3):
        assert book.update(find_rooms(whole, CELL_M)) == {1: 1}
        assert book.update(find_rooms(split, CELL_M)) == {1: 1, 2: 2}
    assert book.known_ids == [1, 2]


def test_a_room_grows_while_it_is_explored() -> None:
    book = RoomBook()
    for width in (30, 45, 80, 110):
        free = np.zeros((60, 120), dtype=np.bool_)
        free[5:55, 5 : 5 + width] = True
        assert book.update(find_rooms(free, CELL_M)) == {1: 1}


def test_the_book_comes_back_from_the_store() -> None:
    plan, _, _ = building()
    found = find_rooms(plan, CELL_M)
    book = RoomBook()
    ids = book.update(found, row0=-20, col0=33)
    assert book.changed == set(ids.values())
    book.names[3] = "kitchen"
    stored = {room_id: book.territory_bytes(room_id) for room_id in book.known_ids}
    again = RoomBook()
    again.restore(stored, book.names, book.next_id)
    assert again.names == {3: "kitchen"}
    assert again.update(found, row0=-20, col0=33) == ids
    assert again.changed == set()
    again.forget_all()
    assert min(again.update(found).values()) == book.next_id


@pytest.mark.parametrize("damage", [b"", b"R1", b"XX" + bytes(40), b"R1" + bytes(16) + b"x"])
def test_damaged_territories_are_refused(damage: bytes) -> None:
    book = RoomBook()
    with pytest.raises(ValueError, match="territory"):
        book.restore({1: damage}, {}, 2)
    with pytest.raises(ValueError, match="fit together"):
        book.restore({}, {4: "attic"}, 2)
    assert book.known_ids == []


def test_a_region_gets_an_id_when_it_was_there_in_enough_updates_running() -> None:
    free = np.zeros((60, 130), dtype=np.bool_)
    free[5:55, 5:55] = True
    both = free.copy()
    both[5:55, 60:110] = True
    one, two = find_rooms(free, CELL_M), find_rooms(both, CELL_M)
    book = RoomBook(settle=3)
    assert book.update(one, entered=1) == {1: 1}
    assert [book.update(found) for found in (two, two, one, two, two)] == [{1: 1}] * 5  # it was away in between
    assert book.update(two, row0=0) == {1: 1, 2: 2}
    assert book.known_ids == [1, 2]
    mask = book.territory_mask((60, 40), 0, 40)
    np.testing.assert_array_equal(mask, two.labels[:, 40:80] > 0)
    np.testing.assert_array_equal(book.territory_mask((60, 130), 0, 0, only=2), two.labels == 2)
