"""One device that is several sources: a board with wheels, sonars and switches, or an autopilot. Pure.

The device's own conversation says everything; each share shows one kind of its readings and is a conversation too, so
that every source has a name, a state, a rate and an age of its own. All shares of a device go on one wire, in the
order in which they were made: the first one passes on what arrives and what is to be sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Generic, Protocol

from drivers.conversation import Conversation, SetBaudRate, WireT
from drivers.readings import ClockFit, Identity, LinkState, Reading, SourceCounters

_BOUND = 256  # readings kept for a share; its turn comes with the same chunk, so that this is never reached


class ManySources(Conversation[WireT], Protocol[WireT]):
    """A conversation whose readings belong to several sources."""

    def silence_limit_of(self, kind: type[Reading]) -> int:
        """No reading of this kind for longer than this (ns) means that something is lost."""

    def trouble_of(self, kind: type[Reading]) -> str | None:
        """What is wrong with this kind of reading now, in one line with the repair, or None."""


def share_out(device: ManySources[WireT], kinds: Mapping[str, type[Reading]]) -> dict[str, Conversation[WireT]]:
    """A conversation for each source, by its name; readings of other kinds are not passed on."""
    hub = _Hub(device, tuple(kinds.values()))
    return {name: _Share(hub, kind, leads=index == 0) for index, (name, kind) in enumerate(kinds.items())}


class _Hub(Generic[WireT]):
    """The device and what waits for the shares."""

    def __init__(self, device: ManySources[WireT], kinds: Sequence[type[Reading]]) -> None:
        if len(set(kinds)) != len(kinds):
            raise ValueError("two sources want the same readings of one device")
        self.device: ManySources[WireT] = device
        self.waiting: dict[type[Reading], deque[Reading]] = {kind: deque(maxlen=_BOUND) for kind in kinds}

    def take(self, chunk: WireT, stamp_ns: int) -> None:
        for reading in self.device.receive(chunk, stamp_ns):
            queue = self.waiting.get(type(reading))
            if queue is not None:
                queue.append(reading)


class _Share(Generic[WireT]):
    """One kind of a device's readings."""

    def __init__(self, hub: _Hub[WireT], kind: type[Reading], *, leads: bool) -> None:
        self._hub: _Hub[WireT] = hub
        self._kind = kind
        self._leads = leads
        self._running = False
        self._own = SourceCounters()

    @property
    def state(self) -> LinkState:
        state = self._hub.device.state
        if state is LinkState.RUNNING and not self._running:
            return LinkState.STARTING
        return state

    @property
    def trouble(self) -> str | None:
        device = self._hub.device  # whose own trouble, once it answers, is that of all its shares
        return device.trouble if device.state is LinkState.SILENT else device.trouble_of(self._kind)

    @property
    def identity(self) -> Identity | None:
        return self._hub.device.identity

    @property
    def clock_fit(self) -> ClockFit | None:
        return self._hub.device.clock_fit

    @property
    def counters(self) -> SourceCounters:
        """Those of the whole device for the first share, which sees all bytes; of its readings alone for the others."""
        return self._hub.device.counters if self._leads else self._own

    @property
    def silence_limit_ns(self) -> int:
        return self._hub.device.silence_limit_of(self._kind)

    def connected(self, now_ns: int) -> None:
        self._running = False
        self._hub.waiting[self._kind].clear()
        if self._leads:
            self._hub.device.connected(now_ns)

    def receive(self, chunk: WireT, stamp_ns: int) -> Iterator[Reading]:
        if self._leads:
            self._hub.take(chunk, stamp_ns)
        queue = self._hub.waiting[self._kind]
        while queue:
            self._running = True
            self._own.readings += 1
            yield queue.popleft()

    def requests(self, now_ns: int) -> Sequence[WireT | SetBaudRate]:
        return self._hub.device.requests(now_ns) if self._leads else ()

    def next_request_ns(self) -> int | None:
        """When the device has something to say next, if it knows."""
        ask = getattr(self._hub.device, "next_request_ns", None)
        if not self._leads or ask is None:
            return None
        due_ns: int | None = ask()
        return due_ns

    def farewell(self) -> Sequence[WireT | SetBaudRate]:
        return self._hub.device.farewell() if self._leads else ()
