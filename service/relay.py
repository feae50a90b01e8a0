"""What stands between Zenoh samples and one WebSocket: newest value per key, updates in order, everything bounded.

No socket, thread or session in here, so that tests own every step. A page is sent whole messages of the form

    u16 LE key length, key, u16 LE attachment length, attachment, u8 packing (0 plain, 1 zlib), payload

where payload is what was published, byte for byte: pages decode CDR and JSON by themselves.
"""

from __future__ import annotations

import struct
import zlib
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field

_PACK_ABOVE_BYTES = 8192
_UPDATES_KEPT = 256


@dataclass(frozen=True, slots=True)
class Sample:
    """One published value under its full Zenoh key."""

    key: str
    payload: bytes
    attachment: bytes = b""

    @property
    def is_delta(self) -> bool:
        """A change to an earlier value, worthless alone and needed in order (a grid update)."""
        return self.key.endswith("/update")

    @property
    def base_key(self) -> str:
        """The key whose value a delta changes."""
        return self.key.removesuffix("/update")


def pack(sample: Sample) -> bytes:
    """The message for a page; large payloads are deflated (level 1: a room's grid shrinks six times in 2 ms)."""
    key = sample.key.encode()
    payload, packing = sample.payload, 0
    if len(payload) > _PACK_ABOVE_BYTES:
        payload, packing = zlib.compress(payload, 1), 1
    head = struct.pack("<H", len(key)) + key + struct.pack("<H", len(sample.attachment)) + sample.attachment
    return head + bytes((packing,)) + payload


@dataclass(slots=True)
class Latest:
    """The last value of every key, and the deltas since, for pages that connect later."""

    keys_kept: int = 512
    refused: int = 0
    _values: dict[str, Sample] = field(default_factory=dict)
    _deltas: dict[str, deque[Sample]] = field(default_factory=dict)

    def put(self, sample: Sample) -> None:
        """Keep a sample; one more key than keys_kept is refused and counted."""
        if sample.is_delta:
            self._deltas.setdefault(sample.base_key, deque(maxlen=_UPDATES_KEPT)).append(sample)
            return
        if sample.key not in self._values and len(self._values) >= self.keys_kept:
            self.refused += 1
            return
        self._values[sample.key] = sample
        self._deltas.pop(sample.key, None)

    def forget(self, base_key: str) -> None:
        """That robot went away: a page that connects now must not be shown its past as the present."""
        for kept in (self._values, self._deltas):
            for key in [key for key in kept if key.startswith(base_key + "/")]:
                del kept[key]

    def __iter__(self) -> Iterator[Sample]:
        for key, sample in self._values.items():
            yield sample
            yield from self._deltas.get(key, ())


@dataclass(slots=True)
class Outbox:
    """What one page still has to be sent. A slow page loses old values, counted, never the newest.

    Deltas keep their order; when more than `deltas_kept` wait, they are dropped: the page sees the gap in the numbers
    and waits for the next full value, which comes within seconds.
    """

    deltas_kept: int = _UPDATES_KEPT
    dropped: int = 0
    _waiting: OrderedDict[str, Sample] = field(default_factory=OrderedDict)
    _deltas: deque[Sample] = field(default_factory=deque)

    def put(self, sample: Sample) -> None:
        """Queue a sample; it takes the place of an older value of its key."""
        if not sample.is_delta:
            self.dropped += sample.key in self._waiting
            self._waiting[sample.key] = sample
            return
        self._deltas.append(sample)
        if len(self._deltas) > self.deltas_kept:
            self._deltas.popleft()
            self.dropped += 1

    def take(self) -> Sample | None:
        """The next sample to send: values first, oldest first, then deltas; None when empty."""
        if self._waiting:
            return self._waiting.popitem(last=False)[1]
        return self._deltas.popleft() if self._deltas else None
