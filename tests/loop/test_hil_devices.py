"""Every driver on its device over real wires, through fusion: whole, split, noisy and lost bytes; cables pulled.

The device is an emulator on a pty, or, with `--device KIND=PORT`, hardware: then the driver opens the real port, damage
is done by a pty put between, and a person pulls the plug. The room around an emulated device is known, so every value
is held against the truth; what hardware sees is only held against its own limits.
"""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from drivers.conversation import CanFrame
from drivers.ports import CanPort
from drivers.reader import SourceHealth, WireReader
from drivers.readings import ChainReading, DeviceEvent, LinkState, RangeStatus, Reading, ScanReading, WheelReading
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from service import assemble, assemble_wires
from service.config import Config, load
from service.fusion import Fusion, OdometryOnly
from service.outputs import HealthOut, OdomOut, Output, PolarOut
from service.warm_up import warm_up
from service.worker import Worker
from sim_devices.attach import Attachment, Link
from sim_devices.device import F64, Frame, Mount
from sim_devices.faults import Fault, FaultPlan
from sim_devices.laser_hokuyo import PROFILES
from sim_devices.presets import HOST, Table, emulate, preset, to_toml
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation
from tests.waiting import GIVE_UP_S, BeatStation, SteadyClock, wait_for, waited_ns

SECOND = 1_000_000_000
SEEN_NS = SECOND // 2
RECOVERED_NS = 2 * SECOND
WALL_M, NEAR_M, SPEED_M_S = 2.0, 1.05, 0.2
TICKS_PER_S = SPEED_M_S / (2.0 * math.pi * 0.10) * 4096.0

KINDS = {"laser": ("lasers",), "sonars": ("sonars",), "wheels": ("wheels",), "bus": ("sonars", "wheels")}
WIRE = {"laser": "laser.front", "sonars": "adapter.main", "wheels": "adapter.main", "bus": "adapter.main"}
PROFILE = {"laser-urg": "urg-04lx", "laser-utm": "utm-30lx"}
DEVICES = ["laser-urg", "laser-utm", "sonars", "wheels"]


class Room:
    """What emulated devices see: a wall all around, and a floor that rolls away under the wheels."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), WALL_M)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return NEAR_M

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return now_ns * 1e-9 * SPEED_M_S, now_ns * 1e-9 * SPEED_M_S


class SerialBridge:
    """A real serial device where an emulator would stand, so that damage can be put between it and the driver."""

    def __init__(self, port: str) -> None:
        self._port = serial.Serial(port, timeout=0, exclusive=True)

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        if baud is not None and baud != self._port.baudrate:
            self._port.baudrate = baud
        if received:
            self._port.write(received)
        return bytes(self._port.read(65536))

    def close(self) -> None:
        self._port.close()


class CanBridge:
    """A real CAN bus as one node of the emulated one."""

    def __init__(self, bus: Mapping[str, Any]) -> None:
        self._port = CanPort(
            interface=bus["interface"],
            channel=bus["channel"],
            bitrate_bps=int(bus["bitrate_bps"]),
            clock=time.monotonic_ns,
        )

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        for frame in received:
            self._port.write(CanFrame(frame.can_id, frame.data, frame.extended, frame.remote, frame.dlc))
        return [Frame(f.can_id, f.data, f.extended, f.remote, f.dlc) for f, _ in self._port.read(0.0)]

    def close(self) -> None:
        self._port.close()


@dataclass
class Rig:
    """Devices of one kind on their wires, read by the daemon's own readers into the daemon's own fusion."""

    folder: Path
    device: str
    hardware: Mapping[str, str]
    between: bool  # put a pty between hardware and driver
    heard: list[tuple[str, Reading | DeviceEvent]] = field(default_factory=list)
    told: list[tuple[int, Output]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.kind = self.device.partition("-")[0]
        self.is_real = self.kind in self.hardware
        self.bridges: list[SerialBridge | CanBridge] = []
        self.links: list[Link] = []
        self.plan = FaultPlan(seed=7)
        self._steady = None if self.is_real else SteadyClock()
        self.clock: Callable[[], int] = self._steady or time.monotonic_ns
        self.attachment = Attachment(clock=self.clock)
        if self._steady is not None:
            self.attachment.add_station("beat", BeatStation(self._steady))
        table = self._attach(config_for(self.kind, self.hardware.get(self.kind)))
        path = self.folder / "umfeld.toml"
        path.write_text(to_toml(table))
        self.config: Config = load(path, environment={}).config
        self.sensors = assemble.sensors(self.config)
        warm_up(self.config)
        made = assemble.maps(self.config, self.sensors)
        parts = assemble.parts(self.config, self.sensors, made, OdometryOnly())
        fusion = Fusion(replace(parts, odometry_laser=None))  # the rig stands, whatever the laser says
        self.worker = Worker(
            fusion,
            lambda output: self.told.append((self.clock(), output)),
            now_ns=self.clock,
            beat=lambda now_ns: None,
            health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
        )
        (wire,) = assemble_wires.wires(self.config)
        self.reader: WireReader[Any] = wire.reader(self._sink, self.clock)

    def _attach(self, table: Table) -> Table:
        if not self.is_real:
            profile = PROFILES[PROFILE.get(self.device, "utm-30lx")]
            robot = emulate(table, Room(), self.attachment, self.folder, profile=profile, exact=True, plan=self.plan)
            self.links += robot.links.values()
            return robot.config
        if not self.between:
            return table
        link = PtyLink(self.folder / "between")
        self.links.append(link)
        if self.kind == "laser":
            bridge = SerialBridge(table["lasers"]["front"]["port"])
            self.bridges.append(bridge)
            self.attachment.add("lasers.front", self.plan.device(WIRE[self.kind], bridge), link)
            table["lasers"]["front"]["port"] = str(link.path)
            return table
        bus = table["can"]["main"]
        station = CanBusStation(CanBus(bitrate_bps=int(bus["bitrate_bps"])))
        node = CanBridge(bus)
        self.bridges.append(node)
        station.bus.add_node("real", node)
        adapter = station.add_member(HOST, link)
        station.wrap_member(HOST, self.plan.device(WIRE[self.kind], adapter))
        self.attachment.add_station("can.main", station)
        bus["interface"], bus["channel"] = "slcan", str(link.path)
        return table

    def _sink(self, source: str, item: Reading | DeviceEvent) -> None:
        self.heard.append((source, item))
        self.worker.sink(source, item)

    def __enter__(self) -> Rig:
        self.attachment.start()
        self.worker.start()
        self.reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        assert self.reader.stop(GIVE_UP_S)
        assert self.worker.stop(GIVE_UP_S)
        self.attachment.stop()
        if self._steady is not None:
            self._steady.stop()
        for bridge in self.bridges:
            bridge.close()
        assert self.worker.errors == 0
        assert [health.bugs for health in self.health().values()] == [0] * len(self.sensors)

    # --- what happened

    def health(self) -> dict[str, SourceHealth]:
        return self.reader.health().sources

    def readings(self, source: str, since_ns: int = 0) -> list[Any]:
        found = [item for name, item in list(self.heard) if name == source and not isinstance(item, DeviceEvent)]
        return [item for item in found if item.stamp_ns >= since_ns]

    def events(self, source: str, since_ns: int = 0) -> list[DeviceEvent]:
        found = [item for name, item in list(self.heard) if name == source and isinstance(item, DeviceEvent)]
        return [item for item in found if item.stamp_ns >= since_ns]

    def polar(self, since_ns: int = 0, until_ns: int = 1 << 62) -> list[tuple[str, PolarSnapshot]]:
        """Every polar map that was published with a stamp in a span of time."""
        return [
            (output.name, output.snapshot)
            for _, output in list(self.told)
            if isinstance(output, PolarOut) and since_ns <= output.snapshot.stamp_ns < until_ns
        ]

    def is_running(self, since_ns: int = 0) -> bool:
        """Whether every device has been running since, and every one has measured."""
        healths = self.health().values()
        return all(each.state is LinkState.RUNNING for each in healths) and all(
            self.readings(name, since_ns) for name in self.sensors
        )

    def next_readings(self, source: str, count: int, since_ns: int) -> list[Any]:
        """Readings of a source once there are so many."""
        wait_for(f"{count} readings of {source}", lambda: len(self.readings(source, since_ns)) >= count)
        return self.readings(source, since_ns)

    def next_event(self, source: str, since_ns: int, *, running: bool) -> DeviceEvent:
        """The first news that a source is running, or is not."""

        def found() -> DeviceEvent | None:
            events = self.events(source, since_ns)
            return next((each for each in events if (each.state is LinkState.RUNNING) == running), None)

        return wait_for(f"{source} {'back' if running else 'missed'}", found)

    def waited_ns(self) -> int:
        """How long the machine has let this process wait, by its threads: whichever waits may hold the others up.

        Nobody sees anything while reader or fusion wait, or while a thread waits that has the interpreter's lock.
        """
        return waited_ns(*threading.enumerate())

    def overrun_bytes(self) -> int:
        """What ptys had no room for, because this machine let the reader wait: lost, and no fault of the driver."""
        return sum(link.counters.dropped_bytes for link in self.links)

    # --- what is done to it

    def in_loop(self, work: Callable[[int], Any]) -> tuple[Any, int]:
        """Run something between two steps of the emulators; its result, and when that was."""
        done: list[tuple[Any, int]] = []
        self.attachment.post(lambda: done.append((work(self.clock()), self.clock())))
        wait_for("the emulators", lambda: done)
        return done[0]

    def begin(self, fault: str) -> tuple[Fault, int]:
        return self.in_loop(lambda now_ns: self.plan.start(fault, now_ns))

    def end(self, fault: Fault) -> int:
        return self.in_loop(lambda _now_ns: self.plan.end(fault))[1]


def config_for(kind: str, hardware: str | None) -> Table:
    """The ARTOS robot with nothing but these devices, on emulated or real ports. hardware: PORT or PORT@ADDRESS,..."""
    table = preset("artos")
    sections = KINDS[kind]
    for section in {"lasers", "sonars", "wheels"} - set(sections):
        del table[section]
    if "wheels" not in sections:
        del table["drive"]
    table["sectors"] = {
        "polar": {
            name: each
            for name, each in table["sectors"]["polar"].items()
            if all(source.partition(".")[0] in sections for source in each["sources"])
        }
    }
    table |= {"grid": {"enabled": False}, "local_grid": {"enabled": False}, "store": {"enabled": False}}
    if kind == "laser":
        del table["can"]
        del table["lasers"]["front"]["range_max_m"]
    if hardware is not None:
        _put_on(table, kind, hardware)
    return table


def _put_on(table: Table, kind: str, hardware: str) -> None:
    port, _, addresses = hardware.partition("@")
    if kind == "laser":
        table["lasers"]["front"]["port"] = port
        return
    table["can"]["main"] |= {"interface": "slcan" if "/" in port else "socketcan", "channel": port}
    numbers = [int(each, 0) for each in addresses.split(",") if each]
    if numbers and kind == "sonars":
        sonars = table["sonars"]
        for name, number in zip(list(sonars), [*numbers, None]):
            if number is None:
                del sonars[name], table["sectors"]["polar"][f"sonar_{name}"]
            else:
                sonars[name]["base_id"] = number
    elif numbers:
        table["wheels"]["drive"]["node_left"], table["wheels"]["drive"]["node_right"] = numbers


@pytest.fixture
def rig(device: str, tmp_path: Path, hardware: dict[str, str], request: pytest.FixtureRequest) -> Iterator[Rig]:
    mark = request.node.get_closest_marker("hil")
    with Rig(tmp_path, device, hardware, between=bool(mark and mark.kwargs.get("between"))) as rig:
        wait_for("the device", rig.is_running)
        yield rig


# --- what devices say, against the truth ----------------------------------------------------------------------------


def assert_true(rig: Rig, readings: Sequence[Any]) -> None:
    """Every reading is what the device must have measured."""
    match readings[0]:
        case ScanReading():
            assert_scans(rig, readings)
        case ChainReading():
            assert_rounds(rig, readings)
        case WheelReading():
            assert_counts(rig, readings)
    stamps = [reading.stamp_ns for reading in readings]
    assert max(stamps) <= rig.clock()
    if not isinstance(readings[0], ChainReading):  # groups of a chain fire together
        assert all(a < b for a, b in itertools.pairwise(stamps))


def assert_scans(rig: Rig, scans: Sequence[ScanReading]) -> None:
    assert len({len(scan.range_m) for scan in scans}) == 1
    for scan in scans:
        measured = scan.range_m[np.isfinite(scan.range_m)]
        assert ((measured > 0.0) & (measured <= scan.range_max_m)).all()
        if not rig.is_real:
            assert len(measured) == len(scan.range_m)
            np.testing.assert_allclose(measured, WALL_M, atol=0.002)


def assert_rounds(rig: Rig, rounds: Sequence[ChainReading]) -> None:
    for heard in (each for reading in rounds for each in reading.ranges):
        if rig.is_real:
            assert heard.status is not RangeStatus.ECHO or 0.0 < heard.range_m < 10.0
        elif heard.status is RangeStatus.ECHO:
            assert heard.range_m == pytest.approx(NEAR_M, abs=0.05)
        else:
            assert heard.status is RangeStatus.NOT_LOOKED  # a channel without a transducer


def assert_counts(rig: Rig, counts: Sequence[WheelReading]) -> None:
    first = counts[0]
    for reading in counts[1:]:
        if not reading.continuous:
            first = reading
        passed_s = (reading.stamp_ns - first.stamp_ns) * 1e-9
        if rig.is_real:
            assert abs(reading.left_ticks - first.left_ticks) <= 1e6 * passed_s
            continue
        late = 0.05 * TICKS_PER_S  # a SYNC that waited for its turn on this machine
        assert reading.left_ticks - first.left_ticks == pytest.approx(TICKS_PER_S * passed_s, abs=late)
        assert first.right_ticks - reading.right_ticks == pytest.approx(TICKS_PER_S * passed_s, abs=late)


def damage(rig: Rig) -> int:
    """How much has been thrown away so far, by the drivers and by their port."""
    health = rig.reader.health()
    return sum(health.drops.values()) + sum(sum(s.counters.drops.values()) for s in health.sources.values())


def drops(rig: Rig) -> list[dict[str, int]]:
    """The same by reasons."""
    return [rig.reader.health().drops, *(health.counters.drops for health in rig.health().values())]


def enough(rig: Rig) -> int:
    """Readings of each source that a test waits for: about half a second of them."""
    return 6 if rig.kind == "laser" else 10


# --- bytes -----------------------------------------------------------------------------------------------------------

# Pieces small enough to cut every message, and bursts of several: as many as a pty holds for a laser, as few as keep
# an encoder's answer within the period of its SYNC and a board's within the patience of its driver.
SPLITS = {
    "laser-urg": ["short_reads=80", "bursts=0.06"],
    "laser-utm": ["short_reads=400", "bursts=0.06"],
    "sonars": ["short_reads=30", "bursts=0.03"],
    "wheels": ["short_reads=30", "bursts=0.005"],
}
# Chances that damage some replies and leave some whole: a UTM's scan has 3370 bytes, an slcan line 27. The sum in SCIP
# shows any one flipped bit, slcan has no sum at all, only lengths: flipped there, a digit is another true digit.
DAMAGE = {
    "laser-urg": ["drop=0.0003", "flip=0.0003"],
    "laser-utm": ["drop=0.0002", "add=0.0002", "flip=0.0002", "flood=1000"],
    "sonars": ["drop=0.005", "flood=500"],
    "wheels": ["drop=0.005", "add=0.005"],
}


@pytest.mark.hil
@pytest.mark.parametrize("device", DEVICES)
def test_whole_bytes_are_the_truth(rig: Rig) -> None:
    begin_ns, damaged = rig.clock(), damage(rig)
    for source in rig.sensors:
        readings = rig.next_readings(source, 2 * enough(rig), begin_ns)
        assert_true(rig, readings)
    assert damage(rig) - damaged <= rig.overrun_bytes(), drops(rig)
    if rig.kind == "wheels":
        wait_for("an odometry", lambda: any(isinstance(output, OdomOut) for _, output in list(rig.told)))
        return
    seen = {SectorState.OBSTACLE} if not rig.is_real else set(SectorState) - {SectorState.UNKNOWN}
    wait_for(
        "what was measured in a sector map",
        lambda: seen & {SectorState(s) for _, snapshot in rig.polar(begin_ns) for s in snapshot.state},
    )


@pytest.mark.hil(between=True)
@pytest.mark.parametrize(("device", "split"), [(device, each) for device, splits in SPLITS.items() for each in splits])
def test_bytes_in_pieces_are_the_same_readings(rig: Rig, split: str) -> None:
    damaged = damage(rig)
    rig.begin(f"{WIRE[rig.kind]}:{split}")
    begin_ns = rig.clock()
    for source in rig.sensors:
        readings = rig.next_readings(source, enough(rig), begin_ns)
        if rig.kind == "laser":  # how late a piece comes shows in the stamps of devices without a clock
            assert_true(rig, readings)
    assert damage(rig) - damaged <= rig.overrun_bytes(), drops(rig)


@pytest.mark.hil(between=True)
@pytest.mark.parametrize(("device", "harm"), [(device, harm) for device, harms in DAMAGE.items() for harm in harms])
def test_noise_and_loss_are_counted_and_never_believed(rig: Rig, harm: str) -> None:
    damaged = damage(rig)
    fault, begin_ns = rig.begin(f"{WIRE[rig.kind]}:{harm}")
    wait_for("damage", lambda: damage(rig) > damaged + 2)
    for source in rig.sensors:
        assert_true(rig, rig.next_readings(source, 1, begin_ns))
    ended_ns = rig.end(fault)
    for source in rig.sensors:
        readings = rig.next_readings(source, enough(rig), ended_ns)
        assert_true(rig, readings)
    wait_for("silence of the counters", lambda: is_calm(rig))


def is_calm(rig: Rig) -> bool:
    """Whether nothing is damaged over some readings."""
    damaged, count = damage(rig), sum(health.readings for health in rig.health().values())
    wait_for("readings", lambda: sum(health.readings for health in rig.health().values()) >= count + 6)
    return damage(rig) == damaged


# --- plugs -----------------------------------------------------------------------------------------------------------

# (devices on the rig, what is done, which sources lose their device, how long it starts afterwards)
PLUGS = [
    ("laser-urg", "laser.front:unplug", ["front"], 0.0),
    ("laser-utm", "laser.front:unplug", ["front"], 0.0),
    ("laser-utm", "laser.front:power_cycle", ["front"], 1.0),  # and the mirror spins up
    ("laser-utm", "laser.front:rename=1", ["front"], 0.0),
    ("laser-utm", "laser.front:silence", ["front"], 0.0),
    ("bus", "adapter.main:unplug", ["left", "right", "drive"], 0.0),
    ("bus", "adapter.main:power_cycle", ["left", "right", "drive"], 0.0),
    ("bus", "sonar.left:unplug", ["left"], 0.0),
    ("bus", "sonar.right:power_cycle", ["right"], 0.25),
    ("bus", "encoder.left:unplug", ["drive"], 0.0),
    ("bus", "encoder.right:power_cycle", ["drive"], 0.1),
]


@pytest.mark.hil(emulated=True)
@pytest.mark.parametrize(("device", "fault", "lost", "start_s"), PLUGS, ids=[f"{p[0]} {p[1]}" for p in PLUGS])
def test_a_lost_device_is_seen_goes_stale_and_comes_back(rig: Rig, fault: str, lost: list[str], start_s: float) -> None:
    wait_for("sectors", lambda: rig.kind == "wheels" or len(rig.polar()) >= 4)
    settled_ns = rig.clock()
    wait_for("sectors", lambda: len(rig.polar(settled_ns)) >= 6)
    waited = rig.waited_ns()
    unplugged, pulled_ns = rig.begin(fault)
    for source in lost:
        event = rig.next_event(source, pulled_ns, running=False)
        assert event.state in (LinkState.ABSENT, LinkState.SILENT)
        assert 0 <= event.stamp_ns - pulled_ns <= SEEN_NS + rig.waited_ns() - waited
        assert event.text
    late_ns = rig.waited_ns() - waited
    wait_for("more sectors", lambda: rig.clock() > pulled_ns + SEEN_NS + late_ns + SECOND // 5)
    if {*lost} != {"drive"}:
        wait_for("more sectors", lambda: len(fed_by(rig, lost, pulled_ns + SEEN_NS + late_ns)) >= 2)
    plugged_ns = rig.end(unplugged)
    for source in lost:
        event = rig.next_event(source, plugged_ns, running=True)
        assert event.stamp_ns - plugged_ns <= RECOVERED_NS + start_s * SECOND + rig.waited_ns() - waited
        assert_true(rig, rig.next_readings(source, 3, event.stamp_ns))
    for source in set(rig.sensors) - set(lost):
        assert not rig.events(source, pulled_ns), f"{source} was not touched"
    assert_never_freer(rig, lost, settled_ns, pulled_ns, plugged_ns, late_ns)
    wait_for("fresh sectors", lambda: {*lost} <= {"drive"} or is_fresh(rig, lost))
    if "drive" in lost:
        assert not rig.readings("drive", plugged_ns)[0].continuous


@pytest.mark.hil(person=True)
@pytest.mark.parametrize("device", DEVICES[1:])
def test_a_plug_pulled_by_hand(rig: Rig, ask_person: Callable[[str], None]) -> None:
    """On emulators the hand is a fault; on hardware a person's."""
    source = next(iter(rig.sensors))
    begin_ns = rig.clock()
    wait_for("readings", lambda: len(rig.readings(source, begin_ns)) >= enough(rig))
    if rig.is_real:
        ask_person(f"unplug the {rig.kind}")
    else:
        fault, _ = rig.begin(f"{WIRE[rig.kind]}:unplug")
    event = rig.next_event(source, begin_ns, running=False)
    last_ns = max(reading.stamp_ns for reading in rig.readings(source) if reading.stamp_ns < event.stamp_ns)
    assert event.stamp_ns - last_ns <= SEEN_NS + SECOND // 5  # the last reading is up to a period older than its loss
    wait_for("staleness", lambda: rig.clock() > event.stamp_ns + SEEN_NS)
    for _, snapshot in rig.polar(event.stamp_ns + SEEN_NS):
        assert {int(s) for s in snapshot.state} <= {int(SectorState.STALE), int(SectorState.UNKNOWN)}
    if rig.is_real:
        ask_person(f"plug the {rig.kind} in again")
    else:
        rig.end(fault)
    port = rig.reader.health()
    plugged_ns = rig.clock()
    back = rig.next_event(source, event.stamp_ns + 1, running=True)
    assert back.stamp_ns - plugged_ns <= RECOVERED_NS + (4 * SECOND if rig.is_real else 0), port


def fed_by(rig: Rig, lost: Sequence[str], since_ns: int) -> list[PolarSnapshot]:
    """Maps published since then that a lost device feeds."""
    return [snapshot for _, snapshot in rig.polar(since_ns) if {*snapshot.sources} & {*lost}]


def is_fresh(rig: Rig, lost: Sequence[str]) -> bool:
    newest = dict(rig.polar())
    fed = [snapshot for snapshot in newest.values() if {*snapshot.sources} <= {*lost}]
    seen = (SectorState.OBSTACLE, SectorState.FREE)
    return all(np.isin(snapshot.state, seen).any() and not stale(snapshot).any() for snapshot in fed)


def stale(snapshot: PolarSnapshot) -> Any:
    return snapshot.state == SectorState.STALE


def reach_m(snapshot: PolarSnapshot) -> F64:
    """(N,) how far each sector may be driven into: nowhere in an unknown or a stale one."""
    is_known = np.isin(snapshot.state, (SectorState.OBSTACLE, SectorState.FREE))
    return np.where(is_known & np.isfinite(snapshot.distance_m), snapshot.distance_m, 0.0)


def assert_never_freer(
    rig: Rig, lost: Sequence[str], settled_ns: int, pulled_ns: int, plugged_ns: int, late_ns: int
) -> None:
    """Of every map that was published: no sector freer than before the plug was pulled, and all stale in time."""
    before: dict[str, tuple[F64, Any]] = {}
    for name, snapshot in rig.polar(settled_ns, pulled_ns):
        reach, free = before.get(name, (np.zeros(len(snapshot.state)), np.zeros(len(snapshot.state), np.bool_)))
        before[name] = np.maximum(reach, reach_m(snapshot)), free | (snapshot.state == SectorState.FREE)
    checked = 0
    for name, snapshot in rig.polar(pulled_ns, plugged_ns):
        if not {*snapshot.sources} & {*lost}:
            continue
        reach, was_free = before[name]
        assert (reach_m(snapshot) <= reach + 0.05).all(), name  # sonars: noise of 5 mm, ten sigma
        assert not ((snapshot.state == SectorState.FREE) & ~was_free).any(), name
        if snapshot.stamp_ns >= pulled_ns + SEEN_NS + late_ns:
            assert stale(snapshot)[reach > 0.0].all(), (name, snapshot.state)
            assert np.isin(snapshot.state, (SectorState.STALE, SectorState.UNKNOWN)).all()
            checked += 1
    assert checked >= 2 or not any(source in ("front", "left", "right") for source in lost)


def test_the_ports_of_hardware_are_understood() -> None:
    assert config_for("laser", "/dev/ttyACM3")["lasers"]["front"]["port"] == "/dev/ttyACM3"
    assert config_for("sonars", "can1")["can"]["main"]["interface"] == "socketcan"
    one = config_for("sonars", "/dev/ttyUSB0@0x480")
    assert one["can"]["main"]["interface"] == "slcan"
    assert [each["base_id"] for each in one["sonars"].values()] == [0x480]
    assert list(one["sectors"]["polar"]) == ["sonar_left"]
    wheels = config_for("wheels", "can0@5,6")["wheels"]["drive"]
    assert (wheels["node_left"], wheels["node_right"]) == (5, 6)
    assert os.path.basename(config_for("wheels", "can0@5,6")["can"]["main"]["channel"]) == "can0"
