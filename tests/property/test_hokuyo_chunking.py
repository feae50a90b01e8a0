"""SCIP replies: any split, any start and noise between replies give the same true ones, and no others."""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterable
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.scip import Reply, ScipReplies

Key = tuple[bytes, str, tuple[bytes, ...], bytes | None, int | None]


def key(reply: Reply) -> Key:
    """A reply without what depends on chunks."""
    scan = reply.scan
    digits = None if scan is None else scan.digits.tobytes()
    return reply.echo, reply.status, reply.lines, digits, None if scan is None else scan.device_ms


def feed(chunks: Iterable[bytes]) -> list[Key]:
    replies = ScipReplies()
    return [key(reply) for at, chunk in enumerate(chunks) for reply in replies.feed(chunk, at)]


def line(text: bytes) -> bytes:
    return text + bytes([sum(text) % 64 + 48]) + b"\n"


def scan_reply(values: list[int], stamp: int) -> bytes:
    data = b"".join(bytes([48 + (v >> 12), 48 + (v >> 6) % 64, 48 + v % 64]) for v in values)
    blocks = b"".join(line(data[at : at + 64]) for at in range(0, len(data), 64))
    digits = bytes(48 + (stamp >> place) % 64 for place in (18, 12, 6, 0))
    return b"MD0000%04d01000\n99b\n" % (len(values) - 1) + line(digits) + blocks + b"\n"


replies_ = st.one_of(
    st.sampled_from([b"QT\n00P\n\n", b"BM\n02R\n\n", b"TM1\n00P\n0N90W\n\n", b"SCIP2.0\n0\n\n", b"QT\nE\n\n"]),
    st.sampled_from([b"VV\n00P\nPROT:SCIP 2.0;N\nSERI:H0614967;V\n\n"]),
    st.builds(scan_reply, st.lists(st.integers(0, 65_535), min_size=1, max_size=70), st.integers(0, (1 << 24) - 1)),
)
# Noise of a line: anything but an end of a reply (that is tested apart), so that what is whole can be told.
noise_ = st.one_of(
    st.binary(max_size=40).map(lambda data: data.replace(b"\n\n", b"\n")),
    st.sampled_from([b"\n", b"\n\n", b"\n\n\n", b"99b\n", b"MD0000000901000\n", b"QT\n", b"V\n0\n", b"\x00" * 100]),
)


def cut(data: bytes, cuts: list[int]) -> list[bytes]:
    ends = sorted({at % (len(data) + 1) for at in cuts} | {0, len(data)})
    return [data[a:b] for a, b in pairwise(ends)]


@settings(max_examples=150, deadline=None)
@given(replies=st.lists(replies_, max_size=6), cuts=st.lists(st.integers(0, 10_000), max_size=30))
def test_any_split_gives_the_same(replies: list[bytes], cuts: list[int]) -> None:
    data = b"".join(replies)
    whole = feed([data])
    assert len(whole) == len(replies)
    assert feed(cut(data, cuts)) == whole
    assert feed(data[at : at + 1] for at in range(len(data))) == whole


@settings(max_examples=150, deadline=None)
@given(replies=st.lists(replies_, min_size=1, max_size=4), start=st.integers(0, 10_000), cuts=st.lists(st.integers(0)))
def test_from_any_start_only_the_cut_reply_is_lost(replies: list[bytes], start: int, cuts: list[int]) -> None:
    data = b"".join(replies)
    start %= len(data)
    whole_after = [reply for at, reply in enumerate(replies) if sum(map(len, replies[:at])) >= start]
    expected = feed(whole_after)
    seen = feed(cut(data[start:], cuts))
    assert seen[len(seen) - len(expected) :] == expected
    # Of the cut reply nothing remains, unless what was cut off is no more than the start of its echo's line.
    assert len(seen) <= len(expected) + 1
    assert set(seen) <= set(feed(replies)) | set(feed([data[start:]]))


@settings(max_examples=200, deadline=None)
@given(
    parts=st.lists(st.tuples(noise_, replies_), min_size=1, max_size=5),
    last=noise_,
    cuts=st.lists(st.integers(0, 10_000), max_size=10),
)
def test_noise_between_replies_costs_none(parts: list[tuple[bytes, bytes]], last: bytes, cuts: list[int]) -> None:
    data = b"".join(noise + reply for noise, reply in parts) + last
    expected = feed(reply for _, reply in parts)
    assert feed(cut(data, cuts)) == expected


@cache
def recorded() -> bytes:
    path = Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "urg04lx_scip2.bin.gz"
    return gzip.decompress(path.read_bytes())


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1 << 30))
def test_recorded_bytes_split_started_anywhere_and_with_noise_between(seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = recorded()
    whole = feed([data])
    cuts = np.sort(rng.integers(0, len(data), int(rng.integers(1, 400))))
    assert feed(cut(data, cuts.tolist())) == whole

    start = int(rng.integers(len(data)))
    ends_before = data[:start].count(b"\n\n") + 1 if start > 205 else 0  # the first reply has no empty line
    seen = feed(cut(data[start:], [int(at) for at in cuts]))
    after = whole[ends_before + 1 :]
    assert seen[len(seen) - len(after) :] == after

    replies = [reply + b"\n\n" for reply in data.split(b"\n\n")[1:-1]]
    noisy = b"".join(rng.bytes(int(rng.integers(0, 60))).replace(b"\n", b"") + reply for reply in replies)
    assert feed(cut(noisy, cuts.tolist())) == whole[2:]
