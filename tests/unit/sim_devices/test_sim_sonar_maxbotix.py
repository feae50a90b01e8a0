"""MaxBotix sensors and their multiplexer: text, pace, ends of range, banner, faults."""

from __future__ import annotations

import itertools
from math import inf, nan

import pytest

from sim_devices.device import F64, Mount
from sim_devices.faults import FaultPlan
from sim_devices.sonar_maxbotix import FAMILIES, MaxBotix, TextMultiplexer

MS = 1_000_000
SECOND = 1_000_000_000


class Wall:
    """Hears the wall at `range_m`, or at 1, 2, 3 m for sensors 1, 2, 3 m ahead."""

    range_m: float = 0.48

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return 0.0 * bearing_rad

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        range_m = mount.x_m or self.range_m
        return range_m if range_m <= range_max_m else inf

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


def lines(device: MaxBotix | TextMultiplexer, begin_ns: int, end_ns: int) -> list[bytes]:
    said = b"".join(device.step(at_ns, b"") for at_ns in range(begin_ns, end_ns, MS))
    return [line for line in said.replace(b"\n", b"").split(b"\r") if line]


def sensor(family: str, range_m: float) -> MaxBotix:
    wall = Wall()
    wall.range_m = range_m
    return MaxBotix(wall, Mount(), family=family, noise_m=0.0)


@pytest.mark.parametrize(
    ("family", "range_m", "text"),
    [
        ("lv", 1.27, b"R050"), ("lv", 0.05, b"R006"), ("lv", 6.45, b"R254"), ("lv", inf, b"R255"), ("lv", nan, b"R255"),
        ("xl", 1.27, b"R127"), ("xl", 0.05, b"R020"), ("xl", 8.0, b"R765"),
        ("hr", 0.48, b"R0480"), ("hr", 0.1, b"R0300"), ("hr", 5.2, b"R5000"), ("hr", inf, b"R5000"),
        ("hr-10m", 7.123, b"R7123"), ("hr-10m", inf, b"R9999"), ("hrusb", 0.48, b"R0480 "),
    ],
)  # fmt: skip
def test_texts(family: str, range_m: float, text: bytes) -> None:
    assert lines(sensor(family, range_m), 0, 2 * SECOND)[-2] == text


def test_bytes_of_the_sheet() -> None:
    one = sensor("hr", 1.234)
    said = b"".join(one.step(at_ns, b"") for at_ns in range(0, SECOND, MS))
    assert said.endswith(bytes.fromhex("52313233340D"))


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_silence_then_banner_then_a_steady_pace(family: str) -> None:
    one = sensor(family, 0.5)
    arrivals = [at for at in range(2000) if one.step(at * MS, b"").endswith(b"\r")]
    assert arrivals[0] >= 250
    count = len(FAMILIES[family].banner)
    readings = arrivals[count:]
    period_ms = FAMILIES[family].period_ns // MS
    assert len(readings) == pytest.approx((2000 - readings[0]) / period_ms, abs=1)
    assert all(b - a == pytest.approx(period_ms, abs=1.01) for a, b in itertools.pairwise(readings))


def test_the_banner_begins_no_reading() -> None:
    for family in FAMILIES.values():
        assert not any(line[:1] == "R" and line[1:].strip().isdigit() for line in family.banner)


def test_the_multiplexer_takes_turns() -> None:
    device = TextMultiplexer(Wall(), {3: Mount(3.0), 1: Mount(1.0), 2: Mount(2.0)}, noise_m=0.0)
    assert lines(device, 0, 1400 * MS)[:7] == [
        b"1:R1000", b"2:R2000", b"3:R3000", b"1:R1000", b"2:R2000", b"3:R3000", b"1:R1000",
    ]  # fmt: skip


def test_the_multiplexer_lists_a_round_in_order_of_channels() -> None:
    device = TextMultiplexer(Wall(), {3: Mount(3.0), 1: Mount(1.0)}, noise_m=0.0, lines="list")
    assert lines(device, 0, 1400 * MS)[:2] == [b"R1000 R3000", b"R1000 R3000"]
    assert device.rate_hz == pytest.approx(1.0 / 0.266)


def test_a_long_pause_is_not_made_up_for() -> None:
    one = sensor("hr", 0.5)
    lines(one, 0, SECOND)
    assert len(lines(one, 60 * SECOND, 61 * SECOND)) <= 9


def test_faults_by_text() -> None:
    plan = FaultPlan(
        ["sonar:stuck=0.7(channel=2)@2s..4s", "sonar:chain_break=3@4s..6s", "sonar:order_swap(channel=1,with=3)@6s..8s"]
    )
    device = plan.device("sonar", TextMultiplexer(Wall(), {n: Mount(float(n)) for n in (1, 2, 3)}, noise_m=0.0))
    assert plan.complaints() == []
    seen = []
    for second in range(9):
        said = b"".join(device.step(second * SECOND + at * MS, b"") for at in range(1000))
        seen.append(set(said.split(b"\r\n")[1:-1]))  # whole lines
    assert seen[1] == seen[8] == {b"1:R1000", b"2:R2000", b"3:R3000"}
    assert seen[3] == {b"1:R1000", b"2:R0700", b"3:R3000"}
    assert seen[5] == {b"1:R1000", b"2:R2000"}
    assert seen[7] == {b"1:R3000", b"2:R2000", b"3:R1000"}


def test_another_rate_reads_nonsense() -> None:
    one = sensor("xl", 1.0)
    said = b"".join(one.step(at * MS, b"", 57600) for at in range(2000))
    assert said
    assert b"R" not in said
