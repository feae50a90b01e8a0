"""Work that takes its time, done beside the fusion thread, whose result is taken up later: see Submit.

Which moment that is never depends on how fast the work was: whoever submits decides by stamps when the result is due,
and waits for it then. So a robot and a replay of its recording do the same, whichever of the two runners they have.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class Submit(Protocol):
    """Takes a pure function; the future says when it is done and what came of it, a raised error included."""

    def __call__(self, work: Callable[[], T], /) -> Future[T]: ...


def at_once(work: Callable[[], T], /) -> Future[T]:
    """Do it now, in this thread: for replays, offline work and tests."""
    future: Future[T] = Future()
    _run(work, future)
    return future


class Background:
    """Threads that do what is submitted, in order. They hold up nobody: the process may end in the midst of it."""

    def __init__(self, *, threads: int = 2, name: str = "background") -> None:
        self._waiting: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._loop, name=f"{name}-{number}", daemon=True) for number in range(threads)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, work: Callable[[], T], /) -> Future[T]:
        """See Submit."""
        future: Future[T] = Future()
        self._waiting.put((work, future))
        return future

    def stop(self, deadline_s: float) -> bool:
        """End when what was submitted is done; False if that takes longer."""
        for _ in self._threads:
            self._waiting.put(None)
        for thread in self._threads:
            thread.join(deadline_s)
        return not any(thread.is_alive() for thread in self._threads)

    def _loop(self) -> None:
        while (entry := self._waiting.get()) is not None:
            _run(*entry)


def _run(work: Callable[[], T], future: Future[T]) -> None:
    try:
        future.set_result(work())
    except Exception as error:  # it belongs to whoever takes the result
        future.set_exception(error)
