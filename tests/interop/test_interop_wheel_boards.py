"""Other people's drivers on the emulated wheel boards, over ptys: basicmicro, tcr-roboclaw, roboclaw, odrive-can,
canopen, canopen-asyncio and dronecan's slcan driver.

And the other way round: our drivers on the axes of odrive-can's mock and on nodes of durand.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import importlib.util
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import serial

from drivers.encoder_cia406 import Cia406PairConversation
from drivers.encoder_odrive import ODrivePairConversation
from drivers.ports import CanPort
from drivers.reader import WireReader
from drivers.readings import DeviceEvent, Reading, WheelReading
from sim_devices.attach import Attachment
from sim_devices.device import F64, Mount
from sim_devices.encoder_arduino_bridge import ArduinoBridge, Sonar
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.encoder_odrive import ODriveAxis
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.encoder_vesc import Vesc
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.wheel import Side, Wheel
from tests.waiting import GIVE_UP_S, SteadyClock, wait_for

TURN_M = 2.0 * np.pi * 0.1


def needs(package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"needs {package}")


class Bench:
    """Wheels on blocks that turn as their motors tell them."""

    def __init__(self) -> None:
        self._told: dict[str, tuple[float, int, float]] = {"left": (0.0, 0, 0.0), "right": (0.0, 0, 0.0)}

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), 2.0)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.07

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self._at("left", now_ns), self._at("right", now_ns)

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        self._told[side] = (self._at(side, now_ns), now_ns, speed_m_s)

    def _at(self, side: str, now_ns: int) -> float:
        base_m, since_ns, speed_m_s = self._told[side]
        return base_m + speed_m_s * (now_ns - since_ns) * 1e-9


def pair(ticks: float) -> tuple[Wheel, Wheel]:
    scene = Bench()
    return Wheel(scene, "left", 0.1, ticks), Wheel(scene, "right", 0.1, ticks)


@pytest.fixture
def claw(tmp_path: Path) -> Iterator[str]:
    loop = Attachment()
    loop.add("claw", RoboClaw(*pair(1000.0)), PtyLink(tmp_path / "claw"))
    with loop:
        yield str(tmp_path / "claw")


@needs("basicmicro")
def test_basicmicro_reads_and_drives(claw: str) -> None:
    board = importlib.import_module("basicmicro").Basicmicro(claw, 38400)
    assert board.Open()
    try:
        assert board.ReadVersion(0x80) == (True, "USB Roboclaw 2x15a v4.2.4\n")
        assert board.SpeedM1M2(0x80, 500, -500)
        begin = time.monotonic()
        time.sleep(0.5)
        ok, first, second = board.GetEncoders(0x80)
        assert ok
        assert first == pytest.approx(500 * (time.monotonic() - begin), rel=0.2)
        assert (2**32 - second) == pytest.approx(first, abs=5)
        assert board.ReadSpeedM1(0x80)[1] == pytest.approx(500, abs=2)
        assert board.ReadSpeedM2(0x80)[1:] == (pytest.approx(500, abs=2), 1)
        assert board.ReadMainBatteryVoltage(0x80)[1] == 121
        assert board.GetStatus(0x80)[0]
        assert board.SetM1VelocityPID(0x80, 1.0, 0.5, 0.25, 44000)
        assert tuple(board.ReadM1VelocityPID(0x80))[1:] == (0.25, 1.0, 0.5, 44000)
        assert board.SpeedM1M2(0x80, 0, 0)
        assert board.SetEncM1(0x80, 1000)
        assert board.ReadEncM1(0x80)[1] == 1000
        assert board.ResetEncoders(0x80)
        assert board.ReadEncM1(0x80)[1] == 0
    finally:
        board.close()


@needs("tcr_roboclaw")
def test_tcr_roboclaw_reads(claw: str) -> None:
    board = importlib.import_module("tcr_roboclaw").Roboclaw(claw, 38400)
    assert board.open()
    assert board.SpeedM1(700)
    time.sleep(0.3)
    assert board.ReadEncM1()[1] > 100
    assert board.ReadSpeedM1()[1] == pytest.approx(700, abs=3)
    assert board.ResetEncoders()


@pytest.mark.skipif(
    importlib.util.find_spec("roboclaw") is None or importlib.util.find_spec("PyCRC") is None,
    reason="needs roboclaw and pythoncrc",
)
def test_pyroboclaw_reads_all_that_it_knows_and_drives(claw: str) -> None:
    """It never empties the port: an answer longer than it expects would shift all that follow."""
    board: Any = importlib.import_module("roboclaw.roboclaw").RoboClaw(claw, 0x80)
    assert board.read_batt_voltage("main") == 12.1
    assert board.read_input_pin_modes() == ("Default", "Disabled", "Disabled")
    assert board.read_voltages() == (12.1, 5.0)
    assert board.read_max_speed(1) == 44000
    board.set_speed(1, 600)
    time.sleep(0.4)
    assert 150 < board.read_encoder(1) < 600
    board.stop_motor(1)


@needs("odrive_can")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it closes its bus a second time
@pytest.mark.parametrize("generation", ["0.5", "0.6"])
def test_odrive_can_reads_and_drives(tmp_path: Path, generation: str) -> None:
    station = CanBusStation(CanBus(bitrate_bps=250_000))
    station.add_member("host", PtyLink(tmp_path / "can"))
    station.bus.add_node("axis", ODriveAxis(pair(1.0)[0], 0, generation=generation))
    loop = Attachment()
    loop.add_station("can", station)
    make: Callable[..., Any] = importlib.import_module("odrive_can.odrive").ODriveCAN

    async def told(ask: Callable[[], Any]) -> Any:
        """What it is told; it waits for half a second, for which a machine may hold up the emulator."""
        for _ in range(20):
            with contextlib.suppress(TimeoutError):
                return await ask()
        raise AssertionError("no answer to twenty questions")

    async def drive() -> None:
        bus = can.Bus(interface="slcan", channel=str(tmp_path / "can"), bitrate=250_000, sleep_after_open=0)
        axis = make(axis_id=0, can_bus=bus)
        await asyncio.wait_for(axis.start(), 3.0)
        try:
            axis.check_alive()
            axis.check_errors()
            assert (await told(axis.get_bus_voltage_current))["Bus_Voltage"] == 24.0
            await axis.set_axis_state("CLOSED_LOOP_CONTROL")
            assert axis.axis_state == "CLOSED_LOOP_CONTROL"
            axis.set_controller_mode("VELOCITY_CONTROL", "PASSTHROUGH")
            axis.set_input_vel(2.0)
            await asyncio.sleep(0.5)
            estimate = await told(axis.get_encoder_estimates)
            assert estimate["Vel_Estimate"] == pytest.approx(2.0, abs=0.01)
            assert 0.5 < estimate["Pos_Estimate"] < 3.0
        finally:
            axis.stop()
            bus.shutdown()

    with loop:
        asyncio.run(drive())


@needs("odrive_can")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_our_driver_reads_odrive_cans_mock() -> None:
    """Another project's emulator: 5 heartbeats and 10 positions a second, and zeros for whoever asks for a position."""
    make: Callable[..., Any] = importlib.import_module("odrive_can.mock").ODriveCANMock
    channel = "mock of odrive_can"
    for axis in (0, 1):
        mock = make(axis, can.Bus(interface="virtual", channel=channel))
        mock.odrive.control_mode, mock.odrive.axis_state = "VELOCITY_CONTROL", "CLOSED_LOOP_CONTROL"
        mock.odrive.model.setpoint = 1.0
        threading.Thread(target=mock.start, daemon=True).start()
    heard: list[WheelReading] = []

    def sink(_: str, item: Reading | DeviceEvent) -> None:
        if isinstance(item, WheelReading):
            heard.append(item)

    pair = ODrivePairConversation(0, 1)
    reader = WireReader(
        "can",
        lambda: CanPort(interface="virtual", channel=channel, clock=time.monotonic_ns),
        {"drive": pair},
        sink,
        clock=time.monotonic_ns,
    )
    reader.start()
    time.sleep(4.0)
    reader.stop()
    assert pair.counters.drops == {}
    assert all(reading.continuous for reading in heard[1:])
    rolled = heard[-1].left_ticks - heard[0].left_ticks
    assert rolled == pytest.approx(8192 * (heard[-1].stamp_ns - heard[0].stamp_ns) * 1e-9, rel=0.1)


def _described(objects: dict[int, tuple[str, int]]) -> Any:
    """An object dictionary as an EDS file would give it: names and types by index, and the two PDOs."""
    od = importlib.import_module("canopen.objectdictionary")

    def variable(index: int, sub: int, name: str, kind: int) -> Any:
        made = od.ODVariable(name, index, sub)
        made.data_type = kind
        return made

    found = od.ObjectDictionary()
    for index, (name, kind) in objects.items():
        found.add_object(variable(index, 0, name, kind))
    for k in (0, 1):
        settings, mapped = od.ODRecord("settings", 0x1800 + k), od.ODRecord("mapping", 0x1A00 + k)
        for sub, kind in ((0, 5), (1, 7), (2, 5), (3, 6), (5, 6)):
            settings.add_member(variable(0x1800 + k, sub, f"{sub}", kind))
        for sub, kind in ((0, 5), (1, 7), (2, 7)):
            mapped.add_member(variable(0x1A00 + k, sub, f"{sub}", kind))
        found.add_object(settings)
        found.add_object(mapped)
    return found


@needs("canopen")
def test_canopen_finds_an_encoder_and_sets_up_its_pdos(tmp_path: Path) -> None:
    canopen: Any = importlib.import_module("canopen")
    station = CanBusStation(CanBus())
    station.add_member("host", PtyLink(tmp_path / "can"))
    scene = Bench()
    scene.drive_wheel(0, "left", 0.5)
    station.bus.add_node("encoder", Cia406Encoder(scene, 0x20))
    loop = Attachment()
    loop.add_station("can", station)
    with loop:
        time.sleep(0.5)
        network = canopen.Network()
        network.connect(interface="slcan", channel=str(tmp_path / "can"), bitrate=1_000_000, sleep_after_open=0)
        try:
            network.scanner.search()
            wait_for("the node", lambda: network.scanner.nodes)
            assert network.scanner.nodes == [0x20]
            kinds = {0x1000: ("device type", 7), 0x1008: ("name", 9), 0x1017: ("heartbeat", 6), 0x6004: ("position", 7)}
            node = network.add_node(0x20, _described(kinds))
            node.sdo.RESPONSE_TIMEOUT = GIVE_UP_S
            assert node.sdo[0x1000].raw & 0xFFFF == 406
            assert node.sdo[0x1008].raw == "UMFELD SIM ENC"
            node.sdo[0x1017].raw = 50
            assert node.nmt.wait_for_heartbeat(GIVE_UP_S) == "PRE-OPERATIONAL"
            node.tpdo.read()
            heard: dict[int, list[int]] = {1: [], 2: []}
            for number, kind in ((1, 254), (2, 1)):
                pdo = node.tpdo[number]
                pdo.clear()
                pdo.add_variable(0x6004)
                pdo.trans_type, pdo.enabled = kind, True
                if number == 1:
                    pdo.event_timer = 20
                pdo.save()
                pdo.add_callback(lambda found, values=heard[number]: values.append(found["position"].raw))
            node.nmt.state = "OPERATIONAL"
            network.sync.start(0.05)
            wait_for("a second's positions by timer and by SYNC", lambda: len(heard[1]) >= 50 and len(heard[2]) >= 20)
            network.sync.stop()
            assert heard[1] == sorted(heard[1])
            assert heard[1][-1] > heard[1][0]
        finally:
            network.disconnect()


@needs("canopen_asyncio")
def test_canopen_asyncio_finds_encoders_and_reads_their_objects(tmp_path: Path) -> None:
    """The same library made for asyncio, with a search, uploads, a download and a heartbeat of its own."""
    master: Any = importlib.import_module("canopen_asyncio")
    station = CanBusStation(CanBus())
    station.add_member("host", PtyLink(tmp_path / "can"))
    for number in (0x20, 0x21):
        station.bus.add_node(f"encoder {number}", Cia406Encoder(Bench(), number))
    loop = Attachment()
    loop.add_station("can", station)

    async def ask() -> None:
        bus = can.Bus(interface="slcan", channel=str(tmp_path / "can"), bitrate=1_000_000, sleep_after_open=0)
        network = master.Network(bus=bus)
        notifier = can.Notifier(bus, network.listeners, 1.0, loop=asyncio.get_running_loop())
        try:
            network.scanner.search()
            for _ in range(int(GIVE_UP_S / 0.05)):
                if len(network.scanner.nodes) == 2:
                    break
                await asyncio.sleep(0.05)
            assert sorted(network.scanner.nodes) == [0x20, 0x21]
            for number in network.scanner.nodes:
                node = network.add_node(number, master.ObjectDictionary())
                node.sdo.RESPONSE_TIMEOUT = GIVE_UP_S
                assert int.from_bytes(await node.sdo.aupload(0x1000, 0), "little") & 0xFFFF == 406
                assert await node.sdo.aupload(0x1008, 0) == b"UMFELD SIM ENC"
                with pytest.raises(master.SdoAbortedError):
                    await node.sdo.aupload(0x9999, 0)
                await node.sdo.adownload(0x1017, 0, (50).to_bytes(2, "little"))
                assert await node.nmt.await_for_heartbeat(GIVE_UP_S) == "PRE-OPERATIONAL"
        finally:
            notifier.stop()
            bus.shutdown()

    with loop:
        asyncio.run(ask())


@needs("dronecan")
def test_dronecans_own_slcan_driver_hears_and_drives_a_vesc(tmp_path: Path) -> None:
    """It talks to the adapter by itself: flushes, waits for each answer, reads in a process of its own."""
    driver: Any = importlib.import_module("dronecan.driver.slcan")
    frame: Any = importlib.import_module("dronecan.driver.common").CANFrame
    station = CanBusStation(CanBus(bitrate_bps=500_000))
    station.add_member("host", PtyLink(tmp_path / "can"))
    wheel = pair(90.0)[0]
    station.bus.add_node("motor", Vesc(wheel, 1))
    loop = Attachment()
    loop.add_station("can", station)
    with loop:
        time.sleep(0.5)
        host = driver.SLCAN(str(tmp_path / "can"), bitrate=500_000)
        try:
            heard: dict[int, bytes] = {}

            def next_status(number: int) -> bytes:
                heard.clear()
                wait_for("status", lambda: _take(host, heard) and number << 8 | 1 in heard)
                return heard[number << 8 | 1]

            assert int.from_bytes(next_status(9)[:4], "big", signed=True) == 0
            host.send_frame(frame(3 << 8 | 1, struct.pack(">i", 3000), True))
            wait_for("its speed", lambda: abs(int.from_bytes(next_status(9)[:4], "big", signed=True) - 3000) < 100)
        finally:
            host.close()


def _take(host: Any, heard: dict[int, bytes]) -> bool:
    got = host.receive(0.2)
    if got is not None:
        heard[got.id] = bytes(got.data)
    return got is not None


@needs("durand")
def test_our_driver_sets_up_and_reads_nodes_of_durand() -> None:
    """Another project's CANopen device: its PDOs are delivered empty, its heartbeat off."""
    durand: Any = importlib.import_module("durand")
    kinds = importlib.import_module("durand.datatypes").DatatypeEnum
    clock = importlib.import_module("durand.scheduler").SyncScheduler()
    durand.set_scheduler(clock)
    clock.add(3600.0, id, (0,))
    threading.Thread(target=clock.run, daemon=True).start()
    channel, stop = "nodes of durand", threading.Event()
    nodes = []
    for number in (0x20, 0x21):
        bus = can.Bus(interface="virtual", channel=channel)
        node = importlib.import_module("durand.node").MinimalNode(durand.CANBusNetwork(bus), number)
        objects = node.object_dictionary
        objects.write(0x1000, 0, 0x00020196)
        objects.write(0x1008, 0, b"DURAND ENCODER")
        for index, value in ((0x6001, 4096), (0x6002, 1 << 24), (0x6004, 0)):
            objects[index] = durand.Variable(kinds.UNSIGNED32, "ro", value)
        nodes.append(objects)

    def turn() -> None:
        start = time.monotonic()
        while not stop.wait(0.002):
            way = int(4096 * (time.monotonic() - start))
            for objects, sign in zip(nodes, (1, -1)):
                objects.write(0x6004, 0, sign * way % (1 << 24))

    threading.Thread(target=turn, daemon=True).start()
    heard: list[WheelReading] = []
    reader = WireReader(
        "can",
        lambda: CanPort(interface="virtual", channel=channel, clock=time.monotonic_ns),
        {"drive": Cia406PairConversation(0x20, 0x21)},
        lambda _, item: heard.append(item) if isinstance(item, WheelReading) else None,
        clock=time.monotonic_ns,
    )
    reader.start()
    time.sleep(3.0)
    told = reader.health().sources["drive"]
    reader.stop()
    stop.set()
    assert told.identity is not None
    assert told.identity.model == "DURAND ENCODER"
    assert len(heard) > 200
    seconds = (heard[-1].stamp_ns - heard[0].stamp_ns) * 1e-9
    assert heard[-1].left_ticks - heard[0].left_ticks == pytest.approx(4096 * seconds, rel=0.03)
    assert heard[-1].right_ticks - heard[0].right_ticks == pytest.approx(-4096 * seconds, rel=0.03)


def test_bridge_by_a_blocking_serial_client(tmp_path: Path) -> None:
    """As the sketch's own Python driver talks: open once at the default rate, again at 57600, then one at a time."""
    board = ArduinoBridge(*pair(1000.0), sonars={7: Sonar(Mount())}, boot_s=0.2, noise_m=0.0)
    clock = SteadyClock()
    loop = Attachment(clock=clock)
    loop.add("board", board, PtyLink(tmp_path / "board"))
    with clock, loop:
        serial.Serial(str(tmp_path / "board")).close()
        with serial.Serial(str(tmp_path / "board"), 57600, timeout=0.5) as port:

            def execute(command: str, attempts: int = 5) -> str:
                for _ in range(attempts):
                    port.reset_input_buffer()
                    port.write(command.encode() + b"\r")
                    value = port.read_until(b"\r").decode().strip()
                    if value not in ("", "Invalid Command"):
                        return value
                raise AssertionError(f"no answer to {command!r}")

            assert execute("b", 100) == "57600"  # a board that boots says nothing
            port.timeout = GIVE_UP_S  # from here on every question has its answer: asked again, two would come
            wait_for("the answers to all that was asked", lambda: execute("r") == "OK")
            assert execute("r") == "OK"
            assert execute("m 20 20") == "OK"
            began_ns = clock()
            wait_for("three tenths of a second", lambda: clock() > began_ns + 300_000_000)
            left, right = (int(word) for word in execute("e").split())
            assert left == pytest.approx(right, abs=2)
            assert 100 < left < 900
            assert execute("p 7") == "107"
            assert execute("m 0 0") == "OK"
