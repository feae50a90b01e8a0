"""Sums of the emulators against published bytes."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from sim_devices.checksums import scip_sum, scip_sums, sick_crc, usboard_crc


@pytest.mark.parametrize(
    ("line", "character"), [(b"Hokuyo", "o"), (b"00", "P"), (b"0E", "e"), (b"99", "b"), (b"10", "Q")]
)
def test_scip_sum_of_published_lines(line: bytes, character: str) -> None:
    assert chr(scip_sum(line)) == character


def test_scip_sums_are_the_sum_of_each_row() -> None:
    rows = np.random.default_rng(1).integers(0x30, 0x70, (9, 64), dtype=np.uint8)
    assert [chr(sum_) for sum_ in scip_sums(rows)] == [chr(scip_sum(row.tobytes())) for row in rows]


@pytest.mark.parametrize(
    "packet",
    [
        "FF 00 01 02 03 04 05 06 07 04 0F",
        "FF 02 00 1E 23 28 2D 00 00 83 04",
        "FF 02 01 32 37 3C 41 00 00 6E D6",
        "FF 03 00 46 4B 50 55 00 00 6C C3",
        "FF 03 01 5A 5F 64 69 00 00 97 32",
        "FF 07 23 56 89 BC 41 A7 00 31 7C",
        "FF 0D F4 3C 46 50 5A 00 00 3C 14",
    ],
)
def test_usboard_crc_of_the_makers_packets(packet: str) -> None:
    octets = bytes.fromhex(packet)
    assert usboard_crc(octets[1:9]).to_bytes(2, "big") == octets[9:]


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")
def test_scip_sum_of_every_recorded_line() -> None:
    """Each line a real sensor sent with a sum ends with the one we would have sent."""
    path = Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "urg04lx_scip2.bin.gz"
    lines = gzip.decompress(path.read_bytes()).split(b"\n")
    begin = next(i for i, line in enumerate(lines) if line.startswith(b"GD"))
    told = [line for line in lines[begin:] if len(line) > 2 and line[-2:-1] == b";" and line[:4].isalpha()]
    data = [line for line in lines[begin:] if len(line) > 2 and not line.startswith(b"GD") and line not in told]
    assert len(told) >= 20
    assert len(data) > 1900
    assert all(line[-1] == scip_sum(line[:-2]) for line in told)
    assert all(line[-1] == scip_sum(line[:-1]) for line in data)


@pytest.mark.parametrize(
    "telegram",
    ["02 00 01 00 10 34 12", "02 00 02 00 20 24 34 08", "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5",
     "02 81 03 00 A0 00 10 36 1A", "02 80 0E 00 B0 05 40 E8 03 E9 03 FF 1F 51 00 C4 09 10 B3 42"],
)  # fmt: skip
def test_sick_crc_of_published_telegrams(telegram: str) -> None:
    octets = bytes.fromhex(telegram)
    assert sick_crc(octets[:-2]).to_bytes(2, "little") == octets[-2:]
