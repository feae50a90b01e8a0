"""ALICE's driver: frames by hand, chunks, noise, gaps."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.alice import FRAME_SIZE, AliceConversation, decode_frame
from drivers.checksums import crc16_ccitt
from drivers.errors import FrameError
from drivers.readings import LinkState, Reading, RingReading


def frame(sequence: int, time_ms: int, ahead: int, left: int, light: bytes, touch: int) -> bytes:
    body = b"\xa5\x4c\x28" + struct.pack("<BIii", sequence, time_ms, ahead, left) + light + touch.to_bytes(3, "little")
    return body + struct.pack("<H", crc16_ccitt(body, 0xFFFF))


STREAM = [
    frame(k % 256, 250 * k, 500 * k, -20 * k, bytes((7 * k + j) % 256 for j in range(24)), 1 << (k % 24))
    for k in range(300)
]


def hear(data: bytes, size: int = 10_000) -> tuple[AliceConversation, list[Reading]]:
    conversation = AliceConversation()
    conversation.connected(0)
    conversation.requests(0)
    readings = []
    for at in range(0, len(data), size):
        readings += list(conversation.receive(data[at : at + size], 1_000_000_000 + at))
    return conversation, readings


def test_code_is_the_published_one() -> None:
    assert crc16_ccitt(b"123456789", 0xFFFF) == 0x29B1


def test_one_frame() -> None:
    """Bytes written out by hand; the code by the table of the catalogue's algorithm."""
    data = bytes.fromhex("a54c28 07 e8030000 10270000 f0d8ffff") + bytes(range(24)) + b"\x01\x80\x00"
    assert len(data) == 43 == FRAME_SIZE - 2
    conversation, (reading,) = hear(data + struct.pack("<H", crc16_ccitt(data, 0xFFFF)))
    assert isinstance(reading, RingReading)
    np.testing.assert_allclose(reading.light, np.arange(24) / 255.0)
    assert np.flatnonzero(reading.touch).tolist() == [0, 15]
    assert not reading.continuous
    assert conversation.state is LinkState.RUNNING
    look = decode_frame(data + struct.pack("<H", crc16_ccitt(data, 0xFFFF)))
    assert (look.sequence, look.time_ms, look.ahead, look.left) == (7, 1000, 10_000, -10_000)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 200))
def test_any_split_gives_the_same_readings(size: int) -> None:
    _, readings = hear(b"".join(STREAM[:20]), size)
    assert len(readings) == 20
    assert [r.ahead_m for r in readings if isinstance(r, RingReading)] == pytest.approx([0.05 * k for k in range(20)])


def test_noise_and_damage_cost_only_what_they_hit() -> None:
    damaged = bytearray(STREAM[3])
    damaged[20] ^= 4
    conversation, readings = hear(
        b"\x00\xa5\xa5" + STREAM[0] + b"\xa5\x4c\x28junk" + STREAM[1] + bytes(damaged) + STREAM[4]
    )
    assert len(readings) == 3
    assert conversation.counters.drops["bad_crc"] >= 1
    assert conversation.counters.drops["missing"] == 2
    last = readings[-1]
    assert isinstance(last, RingReading)
    assert last.continuous
    assert last.ahead_m == pytest.approx(0.2)


def test_every_single_bit_is_caught() -> None:
    for bit in range(8 * FRAME_SIZE):
        damaged = bytearray(STREAM[5])
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError):
            decode_frame(bytes(damaged))


def test_counts_wrap_and_restart() -> None:
    top = (1 << 31) - 100
    _, readings = hear(
        frame(0, 0, top, 0, bytes(24), 0)
        + frame(1, 250, top + 500 - (1 << 32), 0, bytes(24), 0)
        + frame(2, 500, 0, 0, bytes(24), 0)
        + frame(0, 10, 50, 0, bytes(24), 0)
    )
    rings = [r for r in readings if isinstance(r, RingReading)]
    assert [r.continuous for r in rings] == [False, True, False, False]
    assert rings[1].ahead_m - rings[0].ahead_m == pytest.approx(0.05)


def test_silence_is_noticed_and_named() -> None:
    conversation, _ = hear(b"".join(STREAM[:8]))
    now = 1_000_000_000
    for _ in range(200):
        now += 20_000_000
        conversation.requests(now)
    assert conversation.state is LinkState.SILENT
    assert conversation.trouble
    assert list(conversation.receive(STREAM[9], now))
    states = [conversation.state]
    conversation.connected(now)
    assert [*states, conversation.state] == [LinkState.RUNNING, LinkState.SILENT]
    assert conversation.farewell() == ()


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
def test_never_raises(data: bytes) -> None:
    hear(data, 7)
