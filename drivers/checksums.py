"""Sums and CRCs of the device protocols: pure functions, each pinned by published values in its test.

Only what a driver needs stands here; a generic CRC engine would hide which device wants what.
"""

from __future__ import annotations

import binascii


def scip_sum(line: bytes) -> int:
    """The sum character that ends a line of a Hokuyo laser (SCIP 2.x): low 6 bits of the byte sum, plus 30h.

    line: without its line feed. Blind to the order of bytes and to changes that cancel within one line.
    Source: Hokuyo C-42-03320B, "Check sum". `Hokuyo` gives `o`.
    """
    return (sum(line) & 0x3F) + 0x30


def crc16_sick(data: bytes) -> int:
    """The 16-bit code of SICK LMS2xx telegrams, over STX up to the last payload byte; sent low byte first.

    Not a standard CRC: each byte is mixed in together with the one before it.
    Source: SICK telegram listing LMS2xx, appendix on the CRC; polynomial 8005h.
    """
    return _crc16_pairwise(data, 0x8005)


def crc16_usboard(data: bytes) -> int:
    """The 16-bit code of a Neobotix USBoard on its serial line, over the 8 payload bytes; sent high byte first.

    SICK's scheme with polynomial 1021h.
    """
    return _crc16_pairwise(data, 0x1021)


def crc16_ccitt(data: bytes, start: int = 0) -> int:
    """CRC-16/XMODEM (polynomial 1021h, initial 0, not reflected), as RoboClaw has it; sent high byte first.

    start: the value so far, to continue over several pieces. Check value of `123456789`: 31C3h.
    """
    return binascii.crc_hqx(data, start)


def crc8_ld06(data: bytes) -> int:
    """CRC-8 (polynomial 4Dh, initial 0, not reflected) of LDROBOT LD06 and LD19 packets, over all bytes before it."""
    crc = 0
    for byte in data:
        crc = _CRC8_4D[crc ^ byte]
    return crc


def _crc16_pairwise(data: bytes, polynomial: int) -> int:
    crc = previous = 0
    for byte in data:
        crc = ((crc & 0x7FFF) << 1) ^ polynomial if crc & 0x8000 else crc << 1
        crc ^= byte | previous << 8
        previous = byte
    return crc


def _crc8_table(polynomial: int) -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ polynomial) & 0xFF if value & 0x80 else value << 1
        table.append(value)
    return tuple(table)


_CRC8_4D = _crc8_table(0x4D)
