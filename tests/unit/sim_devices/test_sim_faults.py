"""The fault language and what each kind of fault does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import inf

import numpy as np
import pytest

from sim_devices.attach import Attachment, MemoryLink
from sim_devices.device import F64, Frame, Mount
from sim_devices.encoder_cia406 import FULL_RANGE, Cia406Encoder
from sim_devices.faults import BEAM_FAULTS, KINDS, Fault, FaultPlan, FaultSyntaxError, fault_from_table, parse_fault
from sim_devices.laser_hokuyo import UTM_30LX, HokuyoLaser
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardCan

MS = 1_000_000
SECOND = 1_000_000_000


class Room:
    """Everything at 2 m, wheels at 1 m/s; beams right of straight ahead at 4 m."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.where(bearing_rad < 0, 4.0, 2.0) + 0.0 * stamp_ns

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 2.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return now_ns * 1e-9, now_ns * 2e-9


class Chatter:
    """Sends ten bytes each step of 1 ms, counting; obeys resets."""

    def __init__(self) -> None:
        self.count = 0
        self.received = b""
        self.starts = 0
        self.steps = 0

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        self.received += received
        self.steps += 1
        out = bytes((self.count + i) % 256 for i in range(10))
        self.count += 10
        return out

    def power_on(self, now_ns: int) -> None:
        self.starts += 1
        self.count = 0


class Ticker:
    """A node that sends one frame a step."""

    def __init__(self) -> None:
        self.heard: list[Frame] = []
        self.number = 0

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        self.heard += received
        self.number += 1
        return [Frame(0x1A0, self.number.to_bytes(4, "little"))]


def stream(faults: str | Sequence[str], seconds: float = 1.0, seed: int = 0) -> tuple[list[bytes], Chatter]:
    """What arrives in each millisecond."""
    plan = FaultPlan([faults] if isinstance(faults, str) else faults, seed=seed)
    chatter = Chatter()
    device = plan.device("laser", chatter)
    return [device.step(5 * SECOND + i * MS, b"q") for i in range(round(seconds * 1000))], chatter


CLEAN = b"".join(stream([])[0])


# -- the language -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("laser:unplug@5s+2s", Fault("laser", "unplug", 1.0, {}, 5 * SECOND, 7 * SECOND)),
        ("laser:flip=0.01@3s..8s", Fault("laser", "flip", 0.01, {}, 3 * SECOND, 8 * SECOND)),
        ("sonar.left:cross_talk", Fault("sonar.left", "cross_talk", 1.0)),
        ("laser:stall@500ms", Fault("laser", "stall", 1.0, {}, SECOND // 2)),
        (" laser:ghost=0.7(from_deg=-3, to_deg=4.5)@1min..62 ",
         Fault("laser", "ghost", 0.7, {"from_deg": -3.0, "to_deg": 4.5}, 60 * SECOND, 62 * SECOND)),
        ("bus:id_clash(id=0x1A0)", Fault("bus", "id_clash", 1.0, {"id": 0x1A0})),
    ],
)  # fmt: skip
def test_texts(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault


def test_tables_say_the_same() -> None:
    table = {"target": "laser", "kind": "ghost", "value": 0.7, "from_deg": -3, "start_s": 1, "end_s": 2.5}
    assert fault_from_table(table) == parse_fault("laser:ghost=0.7(from_deg=-3)@1s..2500ms")
    assert fault_from_table({"target": "a", "kind": "drop", "start_s": 1, "for_s": 2}) == parse_fault("a:drop@1s+2s")


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("laser", "TARGET:KIND"), ("laser:flipp=1", "did you mean flip"), ("laser:zzzzzz", "there are"),
        ("laser:flip=x", "no number"), ("laser:flip=nan", "finite"), ("laser:flip@soon", "no time"),
        ("laser:flip@8s..3s", "ends before"), ("laser:ghost(deg)", "name=value"), ("laser:flip@", "TARGET:KIND"),
    ],
)  # fmt: skip
def test_bad_texts_say_what_to_write(text: str, hint: str) -> None:
    with pytest.raises(FaultSyntaxError, match=hint):
        parse_fault(text)


@pytest.mark.parametrize("table", [{}, {"target": "a"}, {"target": "a", "kind": "drop", "value": "much"}])
def test_bad_tables(table: dict[str, object]) -> None:
    with pytest.raises(FaultSyntaxError):
        fault_from_table(table)


def test_targets_are_checked_by_name_and_by_what_they_can_have() -> None:
    plan = FaultPlan(["lasr:stall", "laser:stuck", "sonar:stuck", "laser:dust", "bus:bus_off", "sonar.left:bus_off"])
    plan.scene("laser", Room())
    plan.device("laser", HokuyoLaser(Room()))
    plan.node("sonar.left", UsBoardCan(UsBoard(Room(), {})))
    plan.bus("bus", CanBus())
    complaints = plan.complaints()
    assert len(complaints) == 3
    assert "did you mean laser" in complaints[0]
    assert "laser:stuck" in complaints[1]
    assert "sonar.left:bus_off" in complaints[2]


def test_group_and_member_names() -> None:
    fault = parse_fault("sonar:stall")
    assert fault.hits("sonar")
    assert fault.hits("sonar.left")
    assert not fault.hits("sonarx")
    assert not parse_fault("sonar.left:stall").hits("sonar")


def test_times_count_from_the_first_step() -> None:
    arrived, _ = stream("laser:silence@100ms..300ms")
    assert [bool(part) for part in arrived] == [True] * 100 + [False] * 200 + [True] * 700


def test_started_faults_count_from_now() -> None:
    plan = FaultPlan()
    device = plan.device("laser", Chatter())
    device.step(0, b"")
    fault = plan.start("laser:silence@10ms..20ms", 50 * MS)
    got = [bool(device.step((50 + i) * MS, b"")) for i in range(30)]
    assert got == [True] * 10 + [False] * 10 + [True] * 10
    plan.end(fault)
    lasting = plan.start("laser:silence", 100 * MS)
    assert device.step(200 * MS, b"") == b""
    plan.end(lasting)
    assert device.step(201 * MS, b"") != b""


# -- bytes ------------------------------------------------------------------------------------------------------------


def test_no_fault_changes_nothing() -> None:
    _, chatter = stream([])
    assert bytes(i % 256 for i in range(10_000)) == CLEAN
    assert chatter.received == b"q" * 1000


@pytest.mark.parametrize("kind", ["drop=0.1", "add=0.1", "flip=0.1", "wrong_baud", "short_reads", "flood"])
def test_the_same_seed_spoils_the_same_bytes(kind: str) -> None:
    first, second, other = (b"".join(stream(f"laser:{kind}", seed=seed)[0]) for seed in (1, 1, 2))
    assert first == second
    assert first != other
    assert first != CLEAN


def test_drop_and_add_change_the_length_by_their_share() -> None:
    assert len(b"".join(stream("laser:drop=0.1")[0])) == pytest.approx(9000, abs=150)
    assert len(b"".join(stream("laser:add=0.1")[0])) == pytest.approx(11000, abs=150)


def test_flip_turns_single_bits() -> None:
    spoiled = b"".join(stream("laser:flip=0.1")[0])
    changes = [bin(a ^ b).count("1") for a, b in zip(spoiled, CLEAN) if a != b]
    assert len(spoiled) == len(CLEAN)
    assert set(changes) == {1}
    assert len(changes) == pytest.approx(1000, abs=120)


def test_stall_holds_back_and_loses_nothing() -> None:
    arrived, _ = stream("laser:stall@100ms..300ms")
    assert not any(arrived[100:300])
    assert len(arrived[300]) == 2010
    assert b"".join(arrived) == CLEAN


def test_single_bytes_and_short_reads_and_bursts_keep_the_order() -> None:
    single, _ = stream("laser:single_bytes=1000")
    assert {len(part) for part in single[1:]} == {1}
    assert CLEAN.startswith(b"".join(single))
    short, _ = stream("laser:short_reads=7")
    assert max(map(len, short)) <= 7
    assert CLEAN.startswith(b"".join(short))
    bursts, _ = stream("laser:bursts=0.2")
    assert sum(bool(part) for part in bursts) <= 6
    assert CLEAN.startswith(b"".join(bursts))


def test_delay_shifts_everything() -> None:
    arrived, _ = stream("laser:delay=0.1")
    assert not any(arrived[:100])
    assert CLEAN.startswith(b"".join(arrived))
    assert len(b"".join(arrived)) == 9000


def test_wrong_baud_works_both_ways() -> None:
    arrived, chatter = stream("laser:wrong_baud@100ms..200ms")
    assert b"".join(arrived[100:200]) != CLEAN[1000:2000]
    assert len(chatter.received) == 900


def test_unplugged_wire_carries_nothing_and_the_device_goes_on() -> None:
    arrived, chatter = stream("laser:unplug@100ms..200ms")
    assert not any(arrived[100:200])
    assert arrived[200] == bytes(i % 256 for i in range(2000, 2010))
    assert len(chatter.received) == 900
    assert chatter.starts == 0


@pytest.mark.parametrize("kind", ["power_cycle", "slow_boot"])
def test_power_comes_back_from_scratch(kind: str) -> None:
    arrived, chatter = stream(f"laser:{kind}@100ms..200ms")
    assert not any(arrived[100:200])
    assert arrived[200] == bytes(range(10))
    assert (chatter.starts, chatter.steps) == (1, 900)


def test_brown_out_cuts_a_message_in_half() -> None:
    arrived, chatter = stream("laser:brown_out=0.3@100ms+1ms")
    assert arrived[100] == CLEAN[1000:1005]
    assert not any(arrived[101:400])
    assert arrived[400] == bytes(range(10))
    assert chatter.starts == 1


def test_flood_adds_nonsense_at_its_rate() -> None:
    assert len(b"".join(stream("laser:flood=5000")[0])) == pytest.approx(15_000, abs=400)


def test_port_faults_are_told_to_the_link() -> None:
    plan = FaultPlan(["laser:rename=1@1s..2s", "laser:busy@2s..3s", "laser:no_permission@3s..4s"])
    device = plan.device("laser", Chatter())
    states = []
    for second in range(5):
        device.step(second * SECOND, b"")
        states.append((device.port_suffix, device.port_busy, device.port_denied))
    assert states == [("", False, False), ("1", False, False), ("", True, False), ("", False, True), ("", False, False)]


def test_unplugging_reaches_the_link_of_an_attachment() -> None:
    plan = FaultPlan(["laser:unplug@1s..2s"])
    link, loop = MemoryLink(), Attachment()
    loop.add("laser", plan.device("laser", Chatter()), link)
    plugged = []
    for i in range(30):
        loop.service(i * SECOND // 10)
        plugged.append(link.is_open)
    assert plugged == [True] * 10 + [False] * 10 + [True] * 10
    loop.stop()


def test_wrapper_wakes_for_its_own_changes() -> None:
    plan = FaultPlan(["laser:unplug@5s..7s"])
    device = plan.device("laser", HokuyoLaser(Room(), profile=UTM_30LX))
    device.step(SECOND, b"")
    assert device.next_ns == 6 * SECOND
    device.step(6 * SECOND, b"")
    assert device.next_ns == 8 * SECOND


# -- beams ------------------------------------------------------------------------------------------------------------

BEARINGS = np.radians(np.arange(-90.0, 91.0))


def seen(fault: str, at_s: float = 1.0, seed: int = 0) -> F64:
    plan = FaultPlan([fault], seed=seed)
    plan.begin(0)
    stamps = np.full(len(BEARINGS), at_s * SECOND)
    return plan.scene("laser", Room()).beam_ranges(Mount(), BEARINGS, stamps, 30.0)


TRUE_M = np.where(BEARINGS < 0, 4.0, 2.0)


def test_sectors() -> None:
    lost = seen("laser:lost_sector(from_deg=-10, to_deg=20)")
    assert np.array_equal(np.isnan(lost), (np.degrees(BEARINGS) >= -10.001) & (np.degrees(BEARINGS) <= 20.001))
    black = seen("laser:black(from_deg=60, to_deg=-60)")
    assert np.array_equal(np.isnan(black), np.abs(np.degrees(BEARINGS)) > 59.999)
    assert np.array_equal(seen("laser:ghost=0.4(from_deg=-90, to_deg=90)"), np.full(181, 0.4))


def test_shares() -> None:
    everything = "(from_deg=-90, to_deg=90)"
    assert np.mean(seen(f"laser:sun=0.5{everything}") != TRUE_M) == pytest.approx(0.5, abs=0.12)
    assert np.mean(np.isinf(seen(f"laser:glass=0.9{everything}"))) == pytest.approx(0.9, abs=0.08)
    dust = seen("laser:dust=0.3")
    assert np.mean(dust != TRUE_M) == pytest.approx(0.3, abs=0.1)
    assert np.all(dust <= TRUE_M)
    assert np.mean(seen("laser:interference=0.3") != TRUE_M) == pytest.approx(0.3, abs=0.1)


def test_mixed_pixels_only_at_edges() -> None:
    mixed = seen("laser:mixed_pixels=1")
    changed = np.flatnonzero(mixed != TRUE_M)
    assert changed.tolist() == [89]
    assert 2.0 <= mixed[89] <= 4.0


def test_mixed_pixels_leave_what_is_not_finite() -> None:
    fault = parse_fault("laser:mixed_pixels=1")
    plan = FaultPlan([fault])
    plan.begin(0)

    class Holes(Room):
        def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
            return np.array([1.0, inf, np.nan, -inf, 2.0])

    holes = plan.scene("laser", Holes()).beam_ranges(Mount(), BEARINGS[:5], np.full(5, 1.0), 30.0)
    assert np.array_equal(holes, [1.0, inf, np.nan, -inf, 2.0], equal_nan=True)


def test_slow_blinding_grows() -> None:
    blind = [np.mean(np.isnan(seen("laser:slow_blinding=20", at_s))) for at_s in (0.1, 5.0, 10.0, 20.0)]
    assert blind[0] < 0.05
    assert blind[1] == pytest.approx(0.25, abs=0.12)
    assert blind[2] == pytest.approx(0.5, abs=0.15)
    assert blind[3] == 1.0


@pytest.mark.parametrize("kind", sorted(BEAM_FAULTS))
def test_beam_faults_repeat_with_their_seed_and_leave_the_scene_alone(kind: str) -> None:
    assert np.array_equal(seen(f"laser:{kind}", seed=5), seen(f"laser:{kind}", seed=5), equal_nan=True)
    assert len(seen(f"laser:{kind}")) == len(BEARINGS)
    assert np.array_equal(Room().beam_ranges(Mount(), BEARINGS, np.zeros(181), 30.0), TRUE_M)


def test_frozen_scene_shows_the_moment_it_froze() -> None:
    class Clock(Room):
        def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
            return stamp_ns * 1e-9

    plan = FaultPlan(["laser:frozen@2s..4s"])
    plan.begin(0)
    scene = plan.scene("laser", Clock())
    stamps = np.array([0.0, 0.01])
    shown = [scene.beam_ranges(Mount(), stamps, (at_s + stamps) * SECOND, 30.0) for at_s in (1.0, 3.0, 3.5, 5.0)]
    assert shown[0] == pytest.approx([1.0, 1.01])
    assert shown[1] == pytest.approx([1.99, 2.0])
    assert shown[2] == pytest.approx(shown[1])
    assert shown[3] == pytest.approx([5.0, 5.01])


# -- lasers, sonars ---------------------------------------------------------------------------------------------------


def test_laser_clock_drifts_while_told_to() -> None:
    plan = FaultPlan(["laser:clock_drift=1000@1s..2s"])
    laser = HokuyoLaser(Room(), profile=UTM_30LX)
    device = plan.device("laser", laser)
    for second in range(4):
        device.step(second * SECOND, b"")
    assert [laser.clock_ms(second * SECOND) for second in (3, 4, 5)] == [3001, 4001, 5001]


def test_laser_trouble_ends_the_stream_and_goes_away() -> None:
    plan = FaultPlan(["laser:trouble=51@2s..3s"])
    device = plan.device("laser", HokuyoLaser(Room(), profile=UTM_30LX, spin_up_s=0.0))
    device.step(0, b"MD0000000101000\n")
    said = b"".join(device.step(2 * SECOND + i * MS, b"") for i in range(-100, 200))
    assert said.endswith(b"MD0000000101000\n51V\n\n")
    device.step(2 * SECOND + 500 * MS, b"BM\n")
    assert device.step(2 * SECOND + 600 * MS, b"") == b"BM\n01Q\n\n"
    device.step(3 * SECOND, b"BM\n")
    assert device.step(3 * SECOND + 100 * MS, b"") == b"BM\n00P\n\n"


def test_slow_motor_gives_fewer_scans() -> None:
    plan = FaultPlan(["laser:speed=0.5@2s..4s"])
    device = plan.device("laser", HokuyoLaser(Room(), profile=UTM_30LX, spin_up_s=0.0))
    device.step(0, b"MD0000000101000\n")
    counts = [
        sum(device.step(second * SECOND + i * 5 * MS, b"").count(b"99b") for i in range(200)) for second in range(6)
    ]
    assert counts[1] == 40
    assert counts[2] == pytest.approx(20, abs=1)
    assert counts[3] == 20
    assert counts[4] == pytest.approx(40, abs=1)
    assert counts[5] == 40


def test_sonar_faults() -> None:
    class Own(Room):
        def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
            return mount.x_m

    def values(*faults: str) -> list[int]:
        plan = FaultPlan(faults)
        fitted = {i: Transducer(Mount(x_m=0.5 * i)) for i in (1, 2, 3, 4)}
        node = plan.node("sonar.left", UsBoardCan(UsBoard(plan.scene("sonar.left", Own()), fitted, noise_m=0.0)))
        node.step(0, [])
        (frame,) = node.step(SECOND, [Frame(0x400, bytes((13, 1)))])
        low, high = frame.data[2:6], frame.data[6:8]
        return [low[i] | (high[i // 2] >> 4 * (i % 2) & 15) << 8 for i in range(4)]

    assert values() == [100, 200, 300, 400]
    assert values("sonar:stuck=0.8(channel=3)") == [100, 200, 160, 400]
    assert values("sonar:chain_break=3") == [100, 200, 0, 0]
    assert values("sonar:order_swap(channel=2, with=4)") == [100, 400, 300, 200]
    assert values("sonar:specular=1") == [2, 2, 2, 2]
    assert values("sonar:temperature=-10") == [106, 211, 317, 422]
    assert values("sonar:stuck=0.8@0s..500ms") == [100, 200, 300, 400]
    assert values("sonar:stuck=0.8@0s..500ms", "sonar:temperature=-10") == [106, 211, 317, 422]


# -- wheels -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "left_m", "right_m"),
    [
        ("slip=0.5", 5.5, 11.0), ("missed_counts=0.25", 4.75, 9.5), ("sign", 3.0, 6.0), ("swap", 6.0, 9.0),
        ("size_change=0.5", 6.0, 12.0), ("frozen", 4.0, 8.0),
    ],
)  # fmt: skip
def test_wheel_faults_last_one_second_and_nothing_jumps(fault: str, left_m: float, right_m: float) -> None:
    plan = FaultPlan([f"drive:{fault}@2s..3s"])
    plan.begin(0)
    scene = plan.scene("drive.left", Room())
    assert scene.wheel_travel_m(5 * SECOND) == pytest.approx((left_m, right_m))
    assert scene.wheel_travel_m(2 * SECOND) == pytest.approx((2.0, 4.0))
    for at_ns in range(0, 5 * SECOND, SECOND // 100):
        before, after = (np.array(scene.wheel_travel_m(at_ns + late_ns)) for late_ns in (0, SECOND // 100))
        assert np.all(np.abs(after - before) < 0.05)


def test_encoder_faults() -> None:
    plan = FaultPlan(["drive.left:wrap=100@1s", "drive.left:reset@2s", "drive.left:alarm=0x5000@3s..4s"])
    encoder = Cia406Encoder(Room(), 0x20, boot_s=0.05)
    node = plan.node("drive.left", encoder)
    for i in range(100):
        node.step(i * 10 * MS, [])
    node.step(SECOND, [])
    assert encoder.position(SECOND) == FULL_RANGE - 100
    node.step(2 * SECOND, [])
    assert encoder.position(2 * SECOND) == 0
    assert [frame.data for frame in node.step(2 * SECOND + 60 * MS, [])] == [b"\0"]  # boots again
    assert [frame.data.hex() for frame in node.step(3 * SECOND, [])] == ["0050810000000000"]
    assert [frame.data.hex() for frame in node.step(4 * SECOND, [])] == ["0000000000000000"]


# -- the bus ----------------------------------------------------------------------------------------------------------


def frames(fault: str, count: int = 1000) -> tuple[list[list[Frame]], Ticker]:
    plan = FaultPlan([fault] if fault else [])
    ticker = Ticker()
    node = plan.node("drive.left", ticker)
    return [node.step(i * MS, [Frame(1)]) for i in range(count)], ticker


def test_node_faults() -> None:
    clean = [frame for sent in frames("")[0] for frame in sent]
    assert len(clean) == 1000
    assert sum(map(len, frames("drive:drop=0.2")[0])) == pytest.approx(800, abs=50)
    assert sum(map(len, frames("drive:add=0.2")[0])) == pytest.approx(1200, abs=50)
    flipped = [frame for sent in frames("drive:flip=0.2")[0] for frame in sent]
    assert sum(a.data != b.data for a, b in zip(clean, flipped)) == pytest.approx(200, abs=50)
    stalled, _ = frames("drive:stall@100ms..200ms")
    assert [len(sent) for sent in stalled[99:202]] == [1] + [0] * 100 + [101, 1]
    silent, ticker = frames("drive:unplug@100ms..200ms")
    assert not any(silent[100:200])
    assert len(ticker.heard) == 900
    late, _ = frames("drive:delay=0.05")
    assert not any(late[:50])
    assert late[50] == [clean[0]]
    dark, _ = frames("drive:power_cycle@100ms..200ms")
    assert not any(dark[100:200])
    flooded, _ = frames("drive:flood=5000")
    assert sum(map(len, flooded)) == pytest.approx(6000, abs=100)


def test_bus_faults() -> None:
    plan = FaultPlan(["bus:flood=3000@1s..2s", "bus:id_clash(id=0x1A0)@2s..3s", "bus:bus_off@3s..4s"])
    bus = CanBus()
    station = CanBusStation(bus)
    link = MemoryLink()
    station.add_member("host", link)
    bus.add_node("ticker", Ticker())
    plan.bus("bus", bus)
    link.host_write(b"S8\rO\r")
    lines = []
    for second in range(5):
        for i in range(100):
            station.service(second * SECOND + i * 10 * MS)
        lines.append(link.host_read().split(b"\r"))
    flood = sum(line.startswith(b"t7EF8") for line in lines[1])
    assert flood == pytest.approx(3000, abs=100)
    clash = sum(line.startswith(b"t1A0") for line in lines[2])
    assert clash > 1.9 * sum(line.startswith(b"t1A0") for line in lines[0])
    assert lines[3] == [b""]
    assert lines[4] == [b""]  # still off until reopened
    link.host_write(b"C\rO\r")
    station.service(6 * SECOND)
    assert link.host_read().startswith(b"\r\rt1A0")


def test_faults_of_a_hosts_adapter() -> None:
    plan = FaultPlan(["can.daemon:unplug@1s..2s"])
    station = CanBusStation(CanBus())
    link = MemoryLink()
    adapter = station.add_member("daemon", link)
    station.wrap_member("daemon", plan.device("can.daemon", adapter))
    link.host_write(b"O\r")
    station.service(0)
    assert adapter.is_open
    plugged = [(station.service(i * SECOND // 10), link.is_open)[1] for i in range(30)]
    assert plugged == [True] * 10 + [False] * 10 + [True] * 10
    assert adapter.is_open is False


def test_every_kind_has_a_meaning() -> None:
    assert len(KINDS) >= 45
    assert all(kind.meaning and math.isfinite(kind.value) for kind in KINDS.values())
