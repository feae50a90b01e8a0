"""Hosts that read once for each message: behind a USB chip a message comes in one piece, when its last byte has left.

Other people's drivers do that: one for RPLIDARs reads descriptor, answer and capsule with one `read` each, one for
Hokuyo lasers throws away what a `read` has beyond the first reply.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sim_devices.device import F64, ByteDevice, Mount
from sim_devices.laser_hokuyo import HokuyoLaser
from sim_devices.laser_ldrobot import LdLidar
from sim_devices.laser_rplidar import RpLidar
from sim_devices.sonar_maxbotix import MaxBotix
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardSerial

MS = 1_000_000
SECOND = 1_000_000_000


class Wall:
    """Two metres away, in every direction."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), 2.0)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 2.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


def reads(device: ByteDevice, asked: bytes, seconds: float, step_ns: int = MS // 4) -> list[bytes]:
    """What each of many looks finds after a question, empty ones left out. The device has run for 10 s before."""
    device.step(0, b"")
    device.step(10 * SECOND, b"")
    found = [device.step(10 * SECOND, asked)]
    found += [device.step(10 * SECOND + at_ns, b"") for at_ns in range(step_ns, round(seconds * SECOND), step_ns)]
    return [each for each in found if each]


@pytest.mark.parametrize(
    ("asked", "length"), [("a550", 27), ("a552", 10), ("a559", 11)], ids=["info", "health", "sample times"]
)
def test_answers_of_an_rplidar(asked: str, length: int) -> None:
    assert [len(each) for each in reads(RpLidar(Wall()), bytes.fromhex(asked), 0.05)] == [length]


def test_capsules_of_an_rplidar() -> None:
    head, *capsules = reads(RpLidar(Wall()), bytes.fromhex("a58205000000000022"), 0.5)
    assert head == bytes.fromhex("a55a5400004082")
    assert len(capsules) > 50
    assert {len(each) for each in capsules} == {84}


@pytest.mark.parametrize(
    ("make", "asked", "length"),
    [
        (lambda: LdLidar(Wall()), b"", 47),
        (lambda: MaxBotix(Wall(), Mount(), family="hr"), b"", 6),
        (lambda: UsBoardSerial(UsBoard(Wall(), {1: Transducer(Mount())})), bytes(8), 11),
    ],
    ids=["LD06", "MaxBotix", "USBoard"],
)
def test_messages_of_others(make: Callable[[], ByteDevice], asked: bytes, length: int) -> None:
    found = reads(make(), asked, 0.6)
    assert found
    assert len(found[-1]) == length
    assert {len(each) for each in found[1:]} <= {length}


@pytest.mark.parametrize("link", ["usb", "tcp"])
def test_a_hokuyo_answers_commands_that_come_together_one_at_a_time(link: str) -> None:
    laser = HokuyoLaser(Wall(), link=link)
    asked = b"\nQT\n\nQT\n\nQT\n\nSCIP2.0\n"
    assert reads(laser, asked, 0.05) == [b"QT\n00P\n\n"] * 3 + [b"SCIP2.0\n0Ee\n\n"]


def test_a_hokuyo_tells_its_time_at_once_however_often_it_is_asked() -> None:
    laser = HokuyoLaser(Wall(), link="usb")
    laser.step(0, b"")
    laser.step(10 * SECOND, b"TM0\n")
    for k in range(12):
        at_ns = 10 * SECOND + 100 * MS + k * MS // 10
        answer = laser.step(at_ns, b"TM1\n") + laser.step(at_ns + MS // 20, b"")
        assert answer.endswith(b"\n\n")


def test_a_hokuyo_flooded_with_commands_still_answers_soon() -> None:
    laser = HokuyoLaser(Wall(), link="usb")
    laser.step(0, b"")
    laser.step(10 * SECOND, b"VV\n" * 2000)
    late = b"".join(laser.step(10 * SECOND + at_ms * MS, b"") for at_ms in range(1, 400))
    assert late.count(b"VEND:") > 1000
    laser.step(11 * SECOND, b"")
    assert laser.step(12 * SECOND, b"QT\n") + laser.step(12 * SECOND + MS, b"") == b"QT\n00P\n\n"
