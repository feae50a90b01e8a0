"""Faults of a whole bus, of one direction, of switches, of heads that swing, of one wheel of two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from sim_devices.attach import MemoryLink
from sim_devices.contact import Bumper, Cliff, Contact
from sim_devices.device import F64, Frame, Mount
from sim_devices.encoder_arduino_bridge import ArduinoBridge
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.encoder_vesc import Vesc
from sim_devices.faults import KINDS, FaultPlan
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.wheel import Wheel

MS = 1_000_000
SECOND = 1_000_000_000


class Lane:
    """Wheels at 1 m/s, walls `wall_m` away, a pit where x of the mount is above 1."""

    wall_m = 5.0

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return (self.wall_m - mount.x_m) / np.maximum(np.cos(bearing_rad), 1e-6)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return self.wall_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return now_ns * 1e-9, now_ns * 1e-9

    def floor_m(self, mount: Mount, now_ns: int) -> float:
        return -0.2 if mount.x_m > 1.0 else 0.0


class Ticker:
    """Sends one frame every 10 ms, counting from 1 at each power-on; notes what it hears."""

    def __init__(self) -> None:
        self.heard: list[Frame] = []
        self.starts = 0
        self.next_ns: int | None = None
        self._number = 0

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        self.heard += received
        if self.next_ns is not None and now_ns < self.next_ns:
            return []
        self.next_ns = now_ns + 10 * MS
        self._number += 1
        return [Frame(0x123, self._number.to_bytes(4, "little"))]

    def power_on(self, now_ns: int) -> None:
        self.starts += 1
        self._number = 0
        self.next_ns = now_ns


def bus_with(fault: str, seconds: float = 1.0) -> tuple[dict[int, int], Ticker, list[bool]]:
    """When (ms) which number arrived at the host of an slcan adapter, and when its port was there."""
    plan = FaultPlan([fault] if fault else [])
    bus, link, ticker = CanBus(), MemoryLink(), Ticker()
    station = CanBusStation(bus)
    adapter = station.add_member("host", link)
    station.wrap_member("host", plan.device("adapter.main", adapter))
    bus.add_node("ticker", plan.node("encoder", ticker))
    plan.bus("bus.main", bus)
    assert plan.complaints() == []
    arrived: dict[int, int] = {}
    there = []
    was_there = False
    for at_ms in range(round(1000 * seconds)):
        if link.is_open and not was_there:
            link.host_write(b"C\rS8\rO\r")
        was_there = link.is_open
        if was_there and at_ms % 10 == 5:
            link.host_write(b"t2000\r")
        station.service(SECOND + at_ms * MS)
        there.append(link.is_open)
        if link.is_open:
            for line in link.host_read().split(b"\r"):
                if line.startswith(b"t123"):
                    arrived[at_ms] = int.from_bytes(bytes.fromhex(line[5:].decode()), "little")
        else:
            was_there = False
    return arrived, ticker, there


def test_a_sound_bus_carries_everything() -> None:
    arrived, ticker, there = bus_with("")
    assert list(arrived.values()) == list(range(1, 101))
    assert all(there)
    assert len(ticker.heard) == 100


def test_unplugging_a_bus_pulls_out_the_adapter() -> None:
    arrived, ticker, there = bus_with("bus.main:unplug@200ms..500ms")
    assert there == [True] * 200 + [False] * 300 + [True] * 500
    assert not [at for at in arrived if 200 <= at < 500]
    assert arrived[510] > 45  # the nodes went on counting
    assert ticker.starts == 0


def test_a_silent_bus_keeps_its_port_and_loses_its_frames_both_ways() -> None:
    arrived, ticker, there = bus_with("bus.main:silence@200ms..500ms")
    assert all(there)
    assert not [at for at in arrived if 200 <= at < 500]
    assert len(ticker.heard) == 70


@pytest.mark.parametrize("kind", ["power_cycle", "slow_boot", "brown_out=0.3"])
def test_power_of_a_whole_bus_restarts_its_nodes(kind: str) -> None:
    arrived, ticker, there = bus_with(f"bus.main:{kind}@200ms..500ms")
    assert all(there)
    assert not [at for at in arrived if 201 <= at < 500]
    assert ticker.starts == 1
    assert arrived[500] == 1


def test_a_stalled_bus_loses_nothing() -> None:
    arrived, _, _ = bus_with("bus.main:stall@200ms..500ms")
    assert not [at for at in arrived if 200 <= at < 500]
    assert arrived[500] == 51  # the last of those that came at once


def test_delay_and_loss_on_a_whole_bus() -> None:
    late, _, _ = bus_with("bus.main:delay=0.1")
    assert min(late) == pytest.approx(100, abs=2)
    lost, _, _ = bus_with("bus.main:drop=0.3")
    assert 50 < len(lost) < 90


def test_serial_faults_on_a_bus_point_to_its_adapter() -> None:
    plan = FaultPlan(["bus.main:busy"])
    plan.bus("bus.main", CanBus())
    assert "adapter.main" in plan.complaints()[0]


# -- one direction ----------------------------------------------------------------------------------------------------


class Listener:
    def __init__(self) -> None:
        self.received = b""

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        self.received += received
        return b"0123456789"


def test_loss_towards_the_device_only() -> None:
    listener = Listener()
    device = FaultPlan(["laser:drop=0.5(to_device=1)"], seed=3).device("laser", listener)
    said = b"".join(device.step(i * MS, b"abcdefgh") for i in range(100))
    assert said == b"0123456789" * 100
    assert 250 < len(listener.received) < 550


def test_both_directions_at_once_with_different_shares() -> None:
    listener = Listener()
    plan = FaultPlan(["laser:flip=1(to_device=1)", "laser:drop=1"])
    device = plan.device("laser", listener)
    assert device.step(0, b"aaaa") == b""
    assert len(listener.received) == 4
    assert b"a" not in listener.received


def test_nodes_can_be_made_hard_of_hearing() -> None:
    ticker = Ticker()
    node = FaultPlan(["encoder:drop=1(to_device=1)"]).node("encoder", ticker)
    assert len([1 for i in range(100) if node.step(i * MS, [Frame(0x1)])]) == 10
    assert ticker.heard == []


# -- switches ---------------------------------------------------------------------------------------------------------


def test_bumper_feels_what_is_within_its_travel() -> None:
    lane = Lane()
    bumper = Bumper(lane, Mount(0.4), width_m=0.5, travel_m=0.02)
    assert not bumper(0)
    lane.wall_m = 0.425
    assert not bumper(0)
    lane.wall_m = 0.415
    assert bumper(0)


def test_cliff_feels_a_pit() -> None:
    assert not Cliff(Lane(), Mount(0.9))(0)
    assert Cliff(Lane(), Mount(1.1))(0)


class Finger:
    def __init__(self) -> None:
        self.pressed = False

    def __call__(self, now_ns: int) -> bool:
        return self.pressed


def levels(contact: Contact, begin_ms: int, end_ms: int) -> list[bool]:
    return [contact.is_closed(at * MS) for at in range(begin_ms, end_ms)]


def test_contacts_bounce_after_an_edge_and_then_tell_the_truth() -> None:
    finger = Finger()
    contact = Contact(finger, bounce_s=0.02, seed=1)
    assert not any(levels(contact, 0, 100))
    finger.pressed = True
    chatter = levels(contact, 100, 120)
    assert set(chatter) == {True, False}
    assert all(levels(contact, 120, 200))


def test_polarity() -> None:
    finger = Finger()
    opening, closing = Contact(finger, normally_closed=True), Contact(finger)
    assert (opening.level(0), closing.level(0)) == (False, True)
    finger.pressed = True
    for contact in (opening, closing):
        contact.level(MS)
    assert (opening.level(SECOND), closing.level(SECOND)) == (True, False)


def test_switch_faults_come_and_go() -> None:
    finger = Finger()
    plan = FaultPlan(["bumper.front:stuck_on@1s..2s", "bumper:stuck_off@3s..4s", "bumper.front:bounce=0.5@5s..7s"])
    faulty = plan.contact("bumper.front", Contact(finger, seed=2))
    assert plan.complaints() == []
    seen = {}
    for at_ms in range(0, 8000, 10):
        finger.pressed = at_ms >= 6000 or 3000 <= at_ms < 4000
        seen[at_ms] = faulty.is_closed(at_ms * MS)
    assert [seen[at] for at in (500, 1500, 2500, 3500, 4500)] == [False, True, False, False, False]
    assert {seen[at] for at in range(6000, 6500, 10)} == {True, False}
    assert seen[6600]


def test_a_switch_on_a_pin_of_a_board() -> None:
    finger = Finger()
    plan = FaultPlan(["bumper:stuck_on@5s..6s"])
    contact = plan.contact("bumper", Contact(finger))
    board = plan.device("board", ArduinoBridge(None, None, pins={4: contact.level}))

    def read(now_ns: int) -> bytes:
        board.step(now_ns, b"d 4\r")
        return board.step(now_ns + 20 * MS, b"")

    board.step(0, b"")
    assert [read(at * SECOND) for at in (2, 3, 5, 7)] == [b"1\r\n", b"1\r\n", b"0\r\n", b"1\r\n"]


# -- heads and wheels -------------------------------------------------------------------------------------------------


class Head:
    """A laser as far as faults know it."""

    def __init__(self) -> None:
        self.shares: list[float] = []

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        return b""

    @property
    def next_ns(self) -> int | None:
        return None

    def set_speed_share(self, share: float, now_ns: int) -> None:
        self.shares.append(share)


def test_a_head_swings_round_its_speed_and_comes_back_to_it() -> None:
    head = Head()
    plan = FaultPlan(["laser:varying_speed=0.2(period_s=2)@1s..5s"])
    device = plan.device("laser", head)
    assert plan.complaints() == []
    device.step(0, b"")
    while (due_ns := device.next_ns) is not None and due_ns <= 7 * SECOND:
        device.step(due_ns, b"")
    assert len(head.shares) == pytest.approx(41, abs=2)
    assert (min(head.shares), max(head.shares)) == pytest.approx((0.8, 1.2), abs=0.01)
    assert head.shares[-1] == 1.0


def test_a_head_with_varying_counts_never_turns_twice_alike() -> None:
    runs = []
    for seed in (1, 1, 2):
        head = Head()
        device = FaultPlan(["laser:varying_count=0.2@1s..5s"], seed=seed).device("laser", head)
        device.step(0, b"")
        while (due_ns := device.next_ns) is not None:
            device.step(due_ns, b"")
        runs.append(head.shares)
    assert runs[0] == runs[1] != runs[2]
    assert len(set(runs[0])) > 35
    assert all(abs(share - 1.0) <= 0.2 for share in runs[0])
    assert runs[0][-1] == 1.0


def test_faults_of_one_wheel_of_a_board() -> None:
    plan = FaultPlan(["encoder:missed_counts=0.5(side=2)@1s..3s", "encoder:sign(side=1)@3s..4s"])
    scene = plan.scene("encoder", Lane())
    plan.begin(0)
    assert scene.wheel_travel_m(4 * SECOND) == pytest.approx((2.0, 3.0))


def board_of(scene: Lane) -> Mapping[str, object]:
    left, right = Wheel(scene, "left"), Wheel(scene, "right")
    return {"arduino": ArduinoBridge(left, right), "vesc": Vesc(left, 1), "cia406": Cia406Encoder(scene, 0x20)}


@pytest.mark.parametrize("kind", ["wrap=100", "reset"])
@pytest.mark.parametrize("name", ["arduino", "vesc", "cia406"])
def test_every_counter_can_wrap_and_reset_by_text(name: str, kind: str) -> None:
    plan = FaultPlan([f"encoder:{kind}@1s"])
    scene = Lane()
    board = board_of(scene)[name]
    wrapped = plan.device("encoder", board) if name == "arduino" else plan.node("encoder", board)  # type: ignore[arg-type]
    assert plan.complaints() == []
    for at_ms in range(1001):
        wrapped.step(at_ms * MS, b"" if name == "arduino" else ())  # type: ignore[arg-type]
    if isinstance(board, ArduinoBridge):
        count, end = board.wheels[0].count(SECOND), 1 << 31
    elif isinstance(board, Vesc):
        count, end = board.tachometer(SECOND), 1 << 31
    else:
        assert isinstance(board, Cia406Encoder)
        count, end = board.position(SECOND), 1 << 32
    assert count == (end - 100 if kind == "wrap=100" else 0)


def test_the_page_for_users_lists_every_kind_as_it_is() -> None:
    page = (Path(__file__).parents[3] / "docs" / "faults.md").read_text(encoding="utf-8")
    for name, kind in KINDS.items():
        assert f"| `{name}` | {kind.hits} | {kind.meaning} | {kind.value:g} |" in page
