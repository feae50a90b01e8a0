"""Sums and check codes as the emulated devices compute them, each pinned in the tests by published bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def scip_sum(line: bytes) -> int:
    """Sum character of one SCIP line (without its line feed): the low six bits of the byte sum, plus 30h."""
    return (sum(line) & 0x3F) + 0x30


def scip_sums(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Sum characters of many lines of equal length at once. rows: (M, L); returns (M,)."""
    sums: NDArray[np.uint8] = ((rows.sum(axis=1, dtype=np.uint32) & 0x3F) + 0x30).astype(np.uint8)
    return sums


def usboard_crc(data: bytes) -> int:
    """The 16-bit code after a Neobotix USBoard serial message: polynomial 1021h over byte pairs, start 0."""
    crc = previous = 0
    for byte in data:
        crc = ((crc << 1) ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
        crc ^= byte | previous << 8
        previous = byte
    return crc


def _crc8_table(polynomial: int) -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial) & 0xFF if value & 0x80 else value << 1
        table.append(value)
    return bytes(table)


LDROBOT_TABLE = _crc8_table(0x4D)


def ldrobot_crc(data: bytes) -> int:
    """The 8-bit code after an LDROBOT packet: polynomial 4Dh, start 0, not reflected."""
    crc = 0
    for byte in data:
        crc = LDROBOT_TABLE[crc ^ byte]
    return crc


def sick_crc(data: bytes) -> int:
    """The 16-bit code after a SICK LMS2xx telegram: polynomial 8005h over byte pairs, start 0."""
    crc = previous = 0
    for byte in data:
        crc = ((crc & 0x7FFF) << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        crc ^= byte | previous << 8
        previous = byte
    return crc


def crc16_ccitt(data: bytes, crc: int = 0) -> int:
    """CRC-16 of RoboClaw packets: polynomial 1021h, start 0, highest bit first. crc: of what went before."""
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc
