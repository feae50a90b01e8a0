"""What a page is sent: the newest of everything, updates in order, bounded, byte for byte."""

from __future__ import annotations

import struct
import zlib

from hypothesis import given
from hypothesis import strategies as st

from service.relay import Latest, Outbox, Sample, pack

GRID, UPDATE, POSE = "robots/a/map/grid", "robots/a/map/grid/update", "robots/a/pose"
SAMPLES = st.builds(Sample, st.sampled_from([GRID, UPDATE, POSE, "robots/b/pose"]), st.binary(max_size=8))


def unpack(message: bytes) -> Sample:
    """The page's reading of a message, by the layout in the module's docstring."""
    (length,) = struct.unpack_from("<H", message)
    key, rest = message[2 : 2 + length].decode(), message[2 + length :]
    (length,) = struct.unpack_from("<H", rest)
    attachment, packed, payload = rest[2 : 2 + length], rest[2 + length], rest[3 + length :]
    return Sample(key, zlib.decompress(payload) if packed else payload, attachment)


def drain(outbox: Outbox) -> list[Sample]:
    sent = []
    while (sample := outbox.take()) is not None:
        sent.append(sample)
    return sent


@given(st.text(max_size=40), st.binary(max_size=50), st.binary(max_size=50), st.integers(1, 400))
def test_messages_arrive_as_they_left(key: str, payload: bytes, attachment: bytes, times: int) -> None:
    sample = Sample(key, payload * times, attachment)
    assert unpack(pack(sample)) == sample


def test_a_large_grid_is_deflated() -> None:
    assert len(pack(Sample(GRID, bytes(160_000)))) < 2_000


@given(st.lists(SAMPLES, max_size=60))
def test_a_slow_page_gets_the_newest_of_every_key(samples: list[Sample]) -> None:
    outbox = Outbox()
    for sample in samples:
        outbox.put(sample)
    values = {sample.key: sample for sample in samples if not sample.is_delta}
    sent = drain(outbox)
    assert {s.key: s for s in sent if not s.is_delta} == values
    assert [s for s in sent if s.is_delta] == [s for s in samples if s.is_delta]
    assert outbox.dropped == len(samples) - len(sent)


def test_updates_are_bounded_and_every_loss_is_counted() -> None:
    outbox = Outbox(deltas_kept=3)
    for k in range(10):
        outbox.put(Sample(UPDATE, bytes([k])))
    assert [s.payload[0] for s in drain(outbox)] == [7, 8, 9]
    assert outbox.dropped == 7


@given(st.lists(SAMPLES, max_size=60))
def test_a_late_page_begins_with_the_full_grid_and_the_updates_since(samples: list[Sample]) -> None:
    latest = Latest()
    for sample in samples:
        latest.put(sample)
    newest_full = max((i for i, s in enumerate(samples) if s.key == GRID), default=None)
    shown = [s for s in latest if s.key in (GRID, UPDATE)]
    if newest_full is None:
        assert shown == []
    else:
        assert shown == [samples[newest_full], *(s for s in samples[newest_full:] if s.key == UPDATE)]


def test_a_robot_that_went_is_forgotten_and_only_that_one() -> None:
    latest = Latest()
    for key in (GRID, UPDATE, POSE, "robots/ab/pose"):
        latest.put(Sample(key, b"1"))
    latest.forget("robots/a")
    assert [s.key for s in latest] == ["robots/ab/pose"]


def test_the_number_of_keys_is_bounded_and_refusals_are_counted() -> None:
    latest = Latest(keys_kept=2)
    for k in range(5):
        latest.put(Sample(f"robots/a/k{k}", b""))
    latest.put(Sample("robots/a/k1", b"new"))
    assert [(s.key, s.payload) for s in latest] == [("robots/a/k0", b""), ("robots/a/k1", b"new")]
    assert latest.refused == 3
