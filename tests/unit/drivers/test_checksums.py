"""Every sum and CRC against published frames, and against the errors it must see."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.checksums import crc8_ld06, crc16_ccitt, crc16_sick, crc16_usboard, scip_sum


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"Hokuyo", "o"),
        (b"00", "P"),
        (b"99", "b"),
        (b"0E", "e"),
        (b"21", "S"),
        (b"VEND:Hokuyo Automatic Co.,Ltd.", "["),
        (b"ARES:1024", "\\"),
        (b"0N90", "W"),
        (b"01>8", "G"),
        (b"0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0", "E"),
        (b"", "0"),
    ],
)
def test_scip_sum(line: bytes, expected: str) -> None:
    assert chr(scip_sum(line)) == expected


@pytest.mark.parametrize(
    "frame",
    [
        "02 00 01 00 10 34 12",
        "02 00 01 00 31 15 12",
        "02 00 01 00 74 50 12",
        "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5",
        "02 00 02 00 20 24 34 08",
        "02 00 05 00 3B B4 00 64 00 97 49",
        "02 80 03 00 A0 00 10 16 0A",
        "02 81 03 00 A0 00 10 36 1A",
        "02 80 07 00 BB 01 B4 00 32 00 10 03 9D",
    ],
)
def test_crc16_sick_over_published_telegrams(frame: str) -> None:
    raw = bytes.fromhex(frame)
    assert crc16_sick(raw[:-2]) == int.from_bytes(raw[-2:], "little")


@pytest.mark.parametrize(
    "frame",
    [
        "FF 00 01 02 03 04 05 06 07 04 0F",
        "FF 02 00 1E 23 28 2D 00 00 83 04",
        "FF 03 01 5A 5F 64 69 00 00 97 32",
        "FF 07 23 56 89 BC 41 A7 00 31 7C",
        "FF 0D F4 3C 46 50 5A 00 00 3C 14",
    ],
)
def test_crc16_usboard_over_published_frames(frame: str) -> None:
    raw = bytes.fromhex(frame)
    assert crc16_usboard(raw[1:9]) == int.from_bytes(raw[9:], "big")


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("80 10", "00 00 03 E8 00 71 36"),
        ("80 11", "FF FF F8 30 02 8A F5"),
        ("80 18", "00 79 D8 44"),
        ("80", "14 49 2D"),
        ("80", "25 00 00 01 F4 FF FF FE 0C B2 76"),
    ],
)
def test_crc16_ccitt_over_published_packets(command: str, reply: str) -> None:
    raw = bytes.fromhex(command + reply)
    assert crc16_ccitt(raw[:-2]) == int.from_bytes(raw[-2:], "big")


def test_crc16_ccitt_check_value_and_continuation() -> None:
    assert crc16_ccitt(b"123456789") == 0x31C3
    assert crc16_ccitt(b"6789", crc16_ccitt(b"12345")) == 0x31C3


def test_crc8_ld06_over_the_makers_packet() -> None:
    packet = bytes.fromhex(
        "54 2C 68 08 AB 7E E0 00 E4 DC 00 E2 D9 00 E5 D5 00 E3 D3 00 E4 D0 00 E9 CD 00 E4 CA 00 E2 C7 00 E9 C5 00 E5"
        "C2 00 E5 C0 00 E5 BE 82 3A 1A 50"
    )
    assert crc8_ld06(packet[:-1]) == packet[-1] == 0x50
    assert [crc8_ld06(bytes([value])) for value in range(8)] == [0x00, 0x4D, 0x9A, 0xD7, 0x79, 0x34, 0xE3, 0xAE]


@pytest.mark.parametrize("code", [crc16_sick, crc16_usboard, crc16_ccitt, crc8_ld06])
@given(data=st.binary(min_size=1, max_size=60), where=st.integers(0, 10_000), change=st.integers(1, 255))
def test_codes_see_every_single_changed_byte(
    code: Callable[[bytes], int], data: bytes, where: int, change: int
) -> None:
    damaged = bytearray(data)
    damaged[where % len(data)] ^= change
    assert code(bytes(damaged)) != code(data)


@given(data=st.binary(max_size=60))
def test_codes_stay_in_their_width(data: bytes) -> None:
    assert 0x30 <= scip_sum(data) <= 0x6F
    assert max(crc16_sick(data), crc16_usboard(data), crc16_ccitt(data)) <= 0xFFFF
    assert crc8_ld06(data) <= 0xFF
