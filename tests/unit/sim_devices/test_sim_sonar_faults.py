"""Faults of sonars on boards of every kind."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from sim_devices.device import F64, Mount
from sim_devices.encoder_arduino_bridge import ArduinoBridge, Sonar
from sim_devices.faults import FaultPlan
from sim_devices.mavlink_autopilot import MavlinkAutopilot, Rangefinder
from sim_devices.sonar_faults import SONAR_KINDS, SonarTroubles
from sim_devices.sonar_maxbotix import TextMultiplexer

SECOND = 1_000_000_000


class Steps:
    """A sonar that looks along x sees 1 m, one that looks to the left 2 m."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.ones(len(bearing_rad))

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 2.0 if mount.yaw_rad > 1.0 else 1.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


PLACES = {1: Mount(), 2: Mount(yaw_rad=np.pi / 2)}


def pings() -> tuple[Any, Any]:
    board = ArduinoBridge(None, None, sonars={pin: Sonar(at) for pin, at in PLACES.items()}, boot_s=0.0, noise_m=0.0)
    board.see(Steps())

    def read(device: Any, now_ns: int) -> dict[int, float]:
        found = {}
        for pin in PLACES:
            device.step(now_ns, b"p %d\r" % pin)
            now_ns += 2 * SECOND
            found[pin] = int(device.step(now_ns, b"")) / 100.0
        return found

    return board, read


def rangefinders() -> tuple[Any, Any]:
    finders = [Rangefinder(channel - 1, at) for channel, at in PLACES.items()]
    pilot = MavlinkAutopilot(Steps(), line_rate_bps=None, rangefinders=finders, boot_s=0.0)

    def read(device: Any, now_ns: int) -> dict[int, float]:
        device.step(now_ns, b"")
        told = mavlink.MAVLink(None).parse_buffer(device.step(now_ns + SECOND, b"")) or []
        return {m.id + 1: m.current_distance / 100.0 for m in told if m.get_type() == "DISTANCE_SENSOR"}

    return pilot, read


@pytest.mark.parametrize("make", [pings, rangefinders])
def test_faults_of_sonars_come_and_go(make: Any) -> None:
    device, read = make()
    plan = FaultPlan(seed=3)
    faulty = plan.device("sonar.side", device)
    now_ns = SECOND
    faulty.step(now_ns, b"")

    def reads(*faults: str) -> dict[int, float]:
        nonlocal now_ns
        begun = [plan.start(f"sonar.side:{fault}", now_ns) for fault in faults]
        found: dict[int, float] = read(faulty, now_ns)
        for fault in begun:
            plan.end(fault)
        now_ns += 10 * SECOND
        faulty.step(now_ns, b"")
        return found

    assert reads() == {1: 1.0, 2: 2.0}
    assert reads("stuck=0.5(channel=2)") == {1: 1.0, 2: 0.5}
    assert reads("stuck=0.5") == {1: 0.5, 2: 0.5}
    assert reads("order_swap(channel=1,with=2)") == {1: 2.0, 2: 1.0}
    assert reads("temperature=-20")[2] == pytest.approx(2.0 * 343.4 / 319.2, abs=0.02)
    cut = reads("chain_break=2")
    assert cut.get(2, 0.0) == 0.0
    assert cut[1] == 1.0
    heard = [reads("cross_talk")[2] for _ in range(30)]
    assert 2 <= sum(value < 1.9 for value in heard) <= 20
    assert reads() == {1: 1.0, 2: 2.0}
    assert not plan.complaints()


def test_others_pulses_reach_maxbotix_too() -> None:
    several = TextMultiplexer(Steps(), PLACES, family="hr-5m", lines="labelled", noise_m=0.0)
    undo = several.inflict("cross_talk", 1.0, {}, 0)
    assert undo is not None
    texts = [ear.text(0) for ear in several._ears.values() for _ in range(50)]
    assert 10 <= sum(text not in (b"R1000", b"R2000") for text in texts) <= 50
    undo(0)
    assert {ear.text(0) for ear in several._ears.values()} == {b"R1000", b"R2000"}


def test_without_faults_nothing_changes() -> None:
    random = np.random.default_rng(1)
    assert SonarTroubles().told_m(3, lambda channel: 1.25, random, 4.0) == 1.25
    assert SonarTroubles().told_m(3, lambda channel: inf, random, 4.0) == inf
    assert all(SonarTroubles().inflict(kind, 1.0, {}) is not None for kind in SONAR_KINDS)
    assert SonarTroubles().inflict("wrap", 1.0, {}) is None
