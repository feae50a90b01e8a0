"""Emulated lasers and autopilot under any mix of faults: no crash, the same bytes again, and well afterwards."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.device import F64, ByteDevice, Mount, Scene
from sim_devices.faults import KINDS, FaultPlan
from sim_devices.lasers import MODELS, make_laser
from sim_devices.mavlink_autopilot import MavlinkAutopilot, Rangefinder

MS = 1_000_000
SECOND = 1_000_000_000

START = {
    "lms200": bytes.fromhex("020002002024 3408"),
    "rplidar-a1": b"\xa5\x20",
    "rplidar-a2": bytes.fromhex("A5 82 05 00 00 00 00 00 22"),
    "ld06": b"",
    "tim571": b"\x02sEN LMDscandata 1\x03",
    "autopilot": b"",
}
# what is certain to stand in what each sends when it is well
SIGN = {
    "lms200": b"\x02\x80\xd6\x02\xb0",
    "rplidar-a1": b"\xa5\x5a\x05\x00\x00\x40\x81",
    "rplidar-a2": b"\xa5\x5a\x54\x00\x00\x40\x82",
    "ld06": b"\x54\x2c",
    "tim571": b"sSN LMDscandata ",
    "autopilot": b"\xfd\x09",
}


class Anything:
    """Ranges of every sort."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        sorts = np.array([0.0, 0.01, 1.0, 5.0, 70.0, np.inf, -np.inf, np.nan])
        return sorts[np.arange(len(bearing_rad)) % len(sorts)]

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 0.5

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return now_ns * 1e-10, now_ns * -1e-10


def made(name: str, scene: Scene) -> ByteDevice:
    if name == "autopilot":
        return MavlinkAutopilot(scene, rangefinders=[Rangefinder(0, Mount())])
    return make_laser(name, scene, Mount())


def played(name: str, texts: list[str], seed: int) -> tuple[bytes, bytes]:
    """What a device sends while faults come and go, and what it sends later, after it was asked again."""
    plan = FaultPlan(texts, seed=seed)
    device = plan.device("it", made(name, plan.scene("it", Anything())))
    said = bytearray()
    for i in range(120):
        said += device.step(SECOND + i * 10 * MS, START[name] if i == 70 else b"")
    end_ns = 4 * SECOND
    device.step(end_ns, b"")
    device.step(end_ns + 3 * SECOND, START[name])
    later = b"".join(device.step(end_ns + 3 * SECOND + i * 5 * MS, b"") for i in range(1, 500))
    return bytes(said), later


@pytest.mark.parametrize("name", sorted(START))
@given(kinds=st.lists(st.sampled_from(sorted(KINDS)), max_size=4), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=7, deadline=None)
def test_faults_come_repeat_and_go(name: str, kinds: list[str], seed: int) -> None:
    texts = [f"it:{kind}@{600 + 80 * i}ms+300ms" for i, kind in enumerate(kinds)]
    first, second = played(name, texts, seed), played(name, texts, seed)
    assert first == second
    assert SIGN[name] in first[1]


@given(
    st.sampled_from(sorted(MODELS)),
    st.lists(st.tuples(st.binary(max_size=40), st.integers(1, 40)), max_size=10),
)
@settings(max_examples=40, deadline=None)
def test_every_model_survives_any_bytes(model: str, pieces: list[tuple[bytes, int]]) -> None:
    device: ByteDevice = make_laser(model, Anything(), Mount())
    now_ns = SECOND
    device.step(now_ns, b"")
    for piece, pause_ms in pieces:
        now_ns += pause_ms * MS
        device.step(now_ns, piece)
        wanted_ns: int | None = getattr(device, "next_ns", None)
        assert wanted_ns is None or wanted_ns > now_ns - SECOND
    device.step(now_ns + 3 * SECOND, b"")
