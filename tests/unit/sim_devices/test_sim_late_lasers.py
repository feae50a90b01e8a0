"""Lasers that are served late, as on a machine with too much work: the same bytes, little asked for each of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sim_devices.device import F64, ByteDevice, Mount, Scene
from sim_devices.faults import FaultPlan
from sim_devices.laser_ldrobot import LD06, STL27L, LdLidar
from sim_devices.laser_rplidar import RpLidar

MS = 1_000_000


class Counted:
    """A room whose walls are somewhere else at every bearing and time; it counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        self.asked += 1
        return 3.0 + np.sin(3.0 * bearing_rad) + np.cos(stamp_ns * 1e-9)

    def is_beam_by_beam(self, first_ns: int, last_ns: int) -> bool:
        return True

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 2.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


class Whole(Counted):
    """A scene that answers for whole scans, as a recorded log does."""

    def is_beam_by_beam(self, first_ns: int, last_ns: int) -> bool:
        return False


LASERS: dict[str, tuple[Callable[[Scene], ByteDevice], bytes]] = {
    "ld06": (lambda scene: LdLidar(scene, profile=LD06, dropout=0.1), b""),
    "stl27l": (lambda scene: LdLidar(scene, profile=STL27L), b""),
    "rplidar, nodes": (lambda scene: RpLidar(scene, dropout=0.1), b"\xa5\x20"),
    "rplidar, capsules": (lambda scene: RpLidar(scene), bytes.fromhex("a582050000000000") + b"\x22"),
}


def said(make: Callable[[Scene], ByteDevice], request: bytes, scene: Scene, step_ms: int) -> bytes:
    """What it says in half a second."""
    laser = make(scene)
    out = b""
    for at_ms in range(0, 2500, 250):
        laser.step(at_ms * MS, request if at_ms == 1500 else b"")
    for at_ms in range(2500, 3001, step_ms):
        out += laser.step(at_ms * MS, b"")
    return out


@pytest.mark.parametrize("name", LASERS)
def test_a_late_laser_says_the_same_and_asks_the_world_once_each_time(name: str) -> None:
    make, request = LASERS[name]
    in_time, late = Counted(), Counted()
    bytes_in_time = said(make, request, in_time, 1)
    bytes_late = said(make, request, late, 250)
    assert len(bytes_in_time) > 2000
    assert bytes_late == bytes_in_time
    assert in_time.asked - late.asked > 50, "a few questions in half a second instead of one for each message"


@pytest.mark.parametrize("name", LASERS)
def test_a_late_laser_has_the_faults_of_every_beam(name: str) -> None:
    make, request = LASERS[name]

    def faulty() -> Scene:
        plan = FaultPlan(["laser:dust=0.3@2.6s..2.7s", "laser:black(from_deg=0,to_deg=90)@2.9s"], seed=4)
        plan.begin(0)
        return plan.scene("laser", Counted())

    assert said(make, request, faulty(), 250) == said(make, request, faulty(), 1)


def test_a_scene_that_answers_for_whole_scans_is_asked_for_each_part() -> None:
    scene = Whole()
    laser = LdLidar(scene)
    laser.step(0, b"")
    laser.step(2000 * MS, b"")
    assert scene.asked == 675  # packets in 1.8 s
