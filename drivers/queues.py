"""A queue with a bound, a policy when it is full, and a counter: between the reader threads and the fusion thread.

Putting never blocks: a slow consumer must not stop a wire. When full, the oldest reading of the source that fills the
queue most is thrown away, so that a flood from one device does not cost the others theirs. Events about devices
(absent, silent) are kept as long as any reading can go instead: a lost "silent" would leave old sectors looking fresh.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Generic, TypeVar

from drivers.readings import DeviceEvent

ItemT = TypeVar("ItemT")


class BoundedQueue(Generic[ItemT]):
    """Items of named sources, first in first out, never more than `limit` of them. Many may put, one thread gets.

    keep: tells what must not be thrown away while anything else can; by default the DeviceEvents.
    """

    def __init__(self, limit: int, *, keep: Callable[[ItemT], bool] | None = None) -> None:
        if limit < 1:
            raise ValueError(f"a queue needs room for at least one item, not {limit}")
        self._limit = limit
        self._keep = keep if keep is not None else _is_event
        self._items: deque[tuple[str, ItemT]] = deque()
        self._droppable: dict[str, int] = {}
        self._dropped: dict[str, int] = {}
        self._lock = threading.Lock()
        # A bare lock as bell, since a Condition makes a lock for every wait and rings with its own lock held.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._waiting = False  # somebody waits for the bell, and nobody has rung it
        self._urgent = False  # among the items is one that does not wait for others

    def put(self, source: str, item: ItemT, *, urgent: bool = True) -> None:
        """Add an item; never blocks. May be given to a reader as its sink.

        urgent: False if nobody need be woken for it: it is taken with the next that is, or when whoever waits for items
        has waited long enough.
        """
        with self._lock:
            if len(self._items) >= self._limit:
                self._drop_one()
            self._items.append((source, item))
            if not self._keep(item):
                self._droppable[source] = self._droppable.get(source, 0) + 1
            if not urgent:
                return
            self._urgent = True
            ring, self._waiting = self._waiting, False
        if ring:
            self._bell.release()

    def get(self, timeout_s: float | None = None) -> tuple[str, ItemT] | None:
        """The oldest item with its source; None if nothing comes within timeout_s (None: wait for ever).

        This and get_all wait for an item that is urgent, and take what else there is when the time is up.
        """
        self._wait(timeout_s)
        with self._lock:
            return self._take_first() if self._items else None

    def get_all(self, timeout_s: float | None = None) -> list[tuple[str, ItemT]]:
        """Everything that waits, oldest first; an empty list if nothing comes within timeout_s."""
        self._wait(timeout_s)
        with self._lock:
            items = list(self._items)
            self._items.clear()
            self._droppable.clear()
            self._urgent = False
            return items

    def take(self, choose: Callable[[Sequence[tuple[str, ItemT]]], Collection[int]]) -> list[tuple[str, ItemT]]:
        """What is chosen of all that waits, oldest first, without waiting; the rest keeps its order.

        choose: gets the items, oldest first, and tells places among them; it must be quick and put nothing.
        """
        if not self._items:
            return []
        with self._lock:
            places = set(choose(tuple(self._items)))
            if not places:
                return []
            taken = [entry for place, entry in enumerate(self._items) if place in places]
            self._items = deque(entry for place, entry in enumerate(self._items) if place not in places)
            for source, item in taken:
                if not self._keep(item):
                    self._droppable[source] -= 1
            self._urgent = self._urgent and bool(self._items)
            return taken

    def __len__(self) -> int:
        return len(self._items)

    def dropped(self) -> dict[str, int]:
        """How many items were thrown away because the queue was full, by source."""
        with self._lock:
            return dict(self._dropped)

    def _wait(self, timeout_s: float | None) -> None:
        """Until there is an urgent item, or for timeout_s."""
        with self._lock:
            if self._urgent or (timeout_s is not None and timeout_s <= 0.0):
                return
            self._waiting = True
        if self._bell.acquire(timeout=-1 if timeout_s is None else min(timeout_s, threading.TIMEOUT_MAX)):
            return
        with self._lock:
            is_rung, self._waiting = not self._waiting, False
        if is_rung:  # just after the time was up: the bell must not ring for the next who waits
            self._bell.acquire()

    def _take_first(self) -> tuple[str, ItemT]:
        source, item = self._items.popleft()
        if not self._keep(item):
            self._droppable[source] -= 1
        self._urgent = self._urgent and bool(self._items)
        return source, item

    def _drop_one(self) -> None:
        victim = max(self._droppable, key=self._droppable.__getitem__, default=None)
        if victim is None or self._droppable[victim] == 0:
            source, _ = self._items.popleft()  # nothing but events: the oldest of them is the least true
            self._dropped[source] = self._dropped.get(source, 0) + 1
            return
        for index, (source, item) in enumerate(self._items):
            if source == victim and not self._keep(item):
                del self._items[index]
                break
        self._droppable[victim] -= 1
        self._dropped[victim] = self._dropped.get(victim, 0) + 1


def _is_event(item: object) -> bool:
    return isinstance(item, DeviceEvent)
