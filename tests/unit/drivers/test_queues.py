"""The queue between readers and fusion: who waits is woken once, and nothing is lost around a time-out."""

from __future__ import annotations

import threading

from drivers.queues import BoundedQueue
from tests.waiting import GIVE_UP_S


def test_who_waits_is_woken() -> None:
    queue: BoundedQueue[int] = BoundedQueue(10)
    got: list[tuple[str, int]] = []
    waiter = threading.Thread(target=lambda: got.extend(queue.get_all(GIVE_UP_S)))
    waiter.start()
    queue.put("a", 1)
    waiter.join(GIVE_UP_S)
    assert not waiter.is_alive()
    assert got == [("a", 1)]


def test_nothing_is_lost_and_no_ring_is_left_over_around_time_outs() -> None:
    """Puts that fall together with the end of a wait: every item comes, in order, and afterwards waiting is waiting."""
    queue: BoundedQueue[int] = BoundedQueue(100_000)
    count = 3000

    def put_all() -> None:
        for number in range(count):
            queue.put("a", number)
            if number % 7 == 0:
                threading.Event().wait(0.0002)

    putter = threading.Thread(target=put_all)
    putter.start()
    got: list[int] = []
    while len(got) < count:
        got.extend(item for _, item in queue.get_all(0.0001))
    putter.join(GIVE_UP_S)
    assert got == list(range(count))
    assert queue.get_all(0.01) == []
    assert queue.get(0.01) is None
    assert not queue._bell.acquire(blocking=False)  # a ring that is left over would end the next wait at once


def test_without_time_to_wait_it_does_not_wait() -> None:
    queue: BoundedQueue[int] = BoundedQueue(10)
    assert queue.get_all(0.0) == []
    assert queue.get_all(-1.0) == []  # a deadline that has passed: no wait for ever
    assert queue.get(0.0) is None
    queue.put("a", 1)
    queue.put("b", 2)
    assert queue.get(0.0) == ("a", 1)
    assert queue.get_all(None) == [("b", 2)]


def test_what_can_wait_wakes_nobody_and_comes_in_order_with_what_cannot() -> None:
    queue: BoundedQueue[int] = BoundedQueue(10)
    queue.put("a", 1, urgent=False)
    assert queue.get_all(0.0) == [("a", 1)], "whoever does not wait takes all there is"
    queue.put("a", 2, urgent=False)
    got: list[tuple[str, int]] = []
    waiter = threading.Thread(target=lambda: got.extend(queue.get_all(GIVE_UP_S)))
    waiter.start()
    waiter.join(0.05)
    assert waiter.is_alive(), "it is not woken by what was there"
    queue.put("a", 3, urgent=False)
    waiter.join(0.05)
    assert waiter.is_alive(), "nor by what comes"
    queue.put("b", 4)
    waiter.join(GIVE_UP_S)
    assert got == [("a", 2), ("a", 3), ("b", 4)]
    queue.put("a", 5, urgent=False)
    assert queue.get_all(0.001) == [("a", 5)], "the time is up"
    queue.put("a", 6, urgent=False)
    queue.put("b", 7)
    assert [queue.get(GIVE_UP_S), queue.get(GIVE_UP_S)] == [("a", 6), ("b", 7)]
    queue.put("a", 8, urgent=False)
    assert queue.get(0.001) == ("a", 8)


def test_what_is_chosen_is_taken_and_the_rest_keeps_its_order() -> None:
    queue: BoundedQueue[int] = BoundedQueue(4)
    assert queue.take(lambda items: range(len(items))) == []
    for number in range(4):
        queue.put("ab"[number % 2], number)
    assert queue.take(lambda _: []) == []
    assert queue.take(lambda items: [k for k, (_, item) in enumerate(items) if item in (1, 2)]) == [("b", 1), ("a", 2)]
    queue.put("a", 4)
    queue.put("a", 5)
    queue.put("a", 6)  # one too many: of a, which fills it most, the oldest goes
    assert queue.dropped() == {"a": 1}
    assert queue.get_all(0.0) == [("b", 3), ("a", 4), ("a", 5), ("a", 6)]
    queue.put("a", 7)
    assert queue.take(lambda items: range(len(items))) == [("a", 7)]
    assert queue.get_all(0.001) == [], "nothing urgent is left to wake for"
