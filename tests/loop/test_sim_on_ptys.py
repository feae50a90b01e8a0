"""Emulators on real ptys and sockets, met by other people's code: pyserial, python-can, canopen."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
import pytest
import serial

from sim_devices.attach import Attachment
from sim_devices.device import F64, Mount
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.faults import FaultPlan
from sim_devices.laser_hokuyo import URG_04LX, UTM_30LX, HokuyoLaser
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_usboard import Transducer, board_with
from tests.waiting import GIVE_UP_S, SteadyClock, wait_for


class Room:
    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), 2.0)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.05

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return now_ns * 0.5e-9, now_ns * 0.4e-9


def ask(port: serial.Serial, command: bytes) -> bytes:
    port.write(command)
    return bytes(port.read_until(b"\n\n"))


# -- laser ------------------------------------------------------------------------------------------------------------


def test_forty_scans_a_second_arrive_whole(tmp_path: Path) -> None:
    with SteadyClock() as clock:
        loop = Attachment(clock=clock)
        loop.add("laser", HokuyoLaser(Room(), profile=UTM_30LX, spin_up_s=0.0), PtyLink(tmp_path / "laser"))
        with loop, serial.Serial(str(tmp_path / "laser"), timeout=1) as port:
            assert ask(port, b"MD0000108001000\n") == b"MD0000108001000\n00P\n\n"
            received, began_ns = bytearray(), clock()
            while clock() < began_ns + 1_000_000_000:
                received += port.read(port.in_waiting or 1)
            port.write(b"QT\n")
            while not received.endswith(b"QT\n00P\n\n"):
                received += port.read(port.in_waiting or 1)
            passed_s = (clock() - began_ns) * 1e-9  # one second, and what this thread was held up at its end
    scans = bytes(received).split(b"\n\n")[:-2]
    assert {len(scan) for scan in scans} == {3370}
    assert 35 <= len(scans) <= 40 * passed_s + 4


def test_baud_search_finds_the_urg_and_speeds_it_up(tmp_path: Path) -> None:
    laser = HokuyoLaser(Room(), profile=URG_04LX, start_in_scip1=True, spin_up_s=0.0)
    loop, link = Attachment(), PtyLink(tmp_path / "laser")
    loop.add("laser", laser, link)

    def has_heard(count: int) -> bool:
        return link.counters.received_bytes == count

    with loop, serial.Serial(str(tmp_path / "laser"), 115200, timeout=0.2) as port:
        for baud, heard_bytes in ((115200, 3), (57600, 6)):
            port.baudrate = baud
            assert ask(port, b"QT\n") == b""
            wait_for("the laser to hear it", partial(has_heard, heard_bytes))
        port.baudrate = 19200
        port.timeout = GIVE_UP_S
        assert ask(port, b"QT\n") == b"QT\nE\n\n"
        assert ask(port, b"SCIP2.0\n") == b"SCIP2.0\n0\n\n"
        assert ask(port, b"SS500000\n") == b"SS500000\n00P\n\n"
        port.baudrate = 500000
        assert ask(port, b"QT\n") == b"QT\n00P\n\n"


def test_scripted_unplugging_breaks_and_restores_the_port(tmp_path: Path) -> None:
    plan = FaultPlan(["laser:unplug@300ms..600ms"])
    time_ms = [0]
    loop = Attachment(clock=lambda: time_ms[0] * 1_000_000)
    loop.add("laser", plan.device("laser", HokuyoLaser(Room(), profile=UTM_30LX)), PtyLink(tmp_path / "laser"))

    def ask_in_time(port: serial.Serial) -> bytes:
        """The answer takes some of the device's milliseconds."""
        port.write(b"QT\n")
        answer = b""

        def whole() -> bool:
            nonlocal answer
            time_ms[0] += 1
            answer += port.read(100)
            return answer.endswith(b"\n\n")

        wait_for("an answer", whole)
        return answer

    with loop:
        port = serial.Serial(str(tmp_path / "laser"), timeout=0.06)  # the loop looks at its clock every 50 ms
        assert ask_in_time(port) == b"QT\n00P\n\n"
        assert time_ms[0] < 300
        time_ms[0] = 310
        with pytest.raises((serial.SerialException, OSError)):
            wait_for("the loss", lambda: port.read(1))
        port.close()
        assert not os.path.lexists(tmp_path / "laser")
        time_ms[0] = 610
        wait_for("the port", lambda: os.path.lexists(tmp_path / "laser"))
        with serial.Serial(str(tmp_path / "laser"), timeout=0.06) as again:
            assert ask_in_time(again) == b"QT\n00P\n\n"


def test_noise_on_a_pty_is_the_noise_of_the_seed(tmp_path: Path) -> None:
    def replies(name: str, *faults: str) -> list[bytes]:
        plan = FaultPlan([f"{name}:{fault}" for fault in faults], seed=3)
        loop = Attachment()
        loop.add(name, plan.device(name, HokuyoLaser(Room(), profile=UTM_30LX)), PtyLink(tmp_path / name))
        twin = HokuyoLaser(Room(), profile=UTM_30LX)
        whole, said = twin.step(0, b"PP\n") + twin.step(1_000_000_000, b""), []
        assert whole.endswith(b"\n\n")
        with loop, serial.Serial(str(tmp_path / name), timeout=GIVE_UP_S) as port:
            for _ in range(10):
                port.write(b"PP\n")
                said.append(bytes(port.read(len(whole))))  # its end may be flipped as well
        return said

    noisy = replies("laser", "flip=0.05")
    assert len(set(noisy)) > 5
    assert noisy == replies("laser", "flip=0.05")
    assert len(set(replies("laser"))) == 1


# -- the bus ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[tuple[Attachment, CanBusStation, Path]]:
    station = CanBusStation(CanBus())
    for name in ("daemon", "spy"):
        station.add_member(name, PtyLink(tmp_path / name))
    for name, node, wheel in (("left", 0x20, "left"), ("right", 0x21, "right")):
        station.bus.add_node(name, Cia406Encoder(Room(), node, wheel=wheel, boot_s=0.0))  # type: ignore[arg-type]
    station.bus.add_node("sonar", board_with(0x400, Room(), {1: Transducer(Mount())}, boot_s=0.0))
    loop = Attachment()
    loop.add_station("can", station)
    with loop:
        yield loop, station, tmp_path


def host(path: Path) -> Any:
    return can.Bus(interface="slcan", channel=str(path), bitrate=1_000_000, sleep_after_open=0)


def hear(bus: Any, is_last: Callable[[can.Message], bool]) -> list[can.Message]:
    """What comes, up to a certain message."""
    heard: list[can.Message] = []
    while not heard or not is_last(heard[-1]):
        message = bus.recv(GIVE_UP_S)
        assert message is not None, heard
        heard.append(message)
    return heard


def test_python_can_on_both_ends(bus: tuple[Attachment, CanBusStation, Path]) -> None:
    _, _, folder = bus
    daemon, spy = host(folder / "daemon"), host(folder / "spy")
    try:
        assert daemon.get_version(GIVE_UP_S) == (10, 13)
        assert daemon.get_serial_number(GIVE_UP_S) == "A123"
        assert spy.get_version(GIVE_UP_S) == (
            10,
            13,
        )  # both adapters are open: python-can waits for none
        for number in range(200):
            daemon.send(can.Message(arbitration_id=0x18FF0000 + number, data=[number % 256] * 8))
        heard = [one for one in hear(spy, lambda one: one.arbitration_id == 0x18FF0000 + 199) if one.is_extended_id]
        assert [one.arbitration_id - 0x18FF0000 for one in heard] == list(range(200))
        daemon.send(can.Message(arbitration_id=0x400, data=[13, 1], is_extended_id=False))
        answer = hear(spy, lambda one: one.arbitration_id == 0x40D)[-1]
        assert answer.data.hex() == "0df4d20000000000"
        assert not [one for one in hear(daemon, lambda one: one.arbitration_id == 0x40D) if one.is_extended_id]
    finally:
        daemon.shutdown()
        spy.shutdown()


def test_canopen_over_slcan_reads_both_wheels_at_one_sync(bus: tuple[Attachment, CanBusStation, Path]) -> None:
    _, _, folder = bus
    network = canopen.Network()
    network.connect(interface="slcan", channel=str(folder / "daemon"), bitrate=1_000_000, sleep_after_open=0)
    try:
        counts: dict[int, int] = {}
        for node in (0x20, 0x21):
            empty = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
            remote: Any = network.add_node(canopen.RemoteNode(node, empty))
            remote.sdo.RESPONSE_TIMEOUT = GIVE_UP_S
            remote.sdo.download(0x1800, 1, struct.pack("<I", 0x80000180 + node))
            assert remote.sdo.upload(0x1008, 0) == b"UMFELD SIM ENC"

            def note(can_id: int, data: bytearray, _stamp: float) -> None:
                counts[can_id] = struct.unpack("<I", bytes(data))[0]

            network.subscribe(0x280 + node, note)
            remote.nmt.state = "OPERATIONAL"
        network.sync.transmit()
        wait_for("both counts", lambda: len(counts) == 2)
        assert counts[0x2A1] / counts[0x2A0] == pytest.approx(0.8, abs=1e-6)
    finally:
        network.disconnect()


def test_unplugged_adapter_comes_back(bus: tuple[Attachment, CanBusStation, Path]) -> None:
    loop, _, folder = bus
    spy = host(folder / "spy")
    loop.unplug("can", "spy")
    wait_for("the loss", lambda: not os.path.lexists(folder / "spy"))
    with pytest.raises(can.CanError):
        hear(spy, lambda _: False)
    with pytest.raises(can.CanError):
        spy.shutdown()
    loop.replug("can", "spy")
    wait_for("the port", lambda: os.path.lexists(folder / "spy"))
    again, daemon = host(folder / "spy"), host(folder / "daemon")
    try:
        assert again.get_version(GIVE_UP_S) == daemon.get_version(GIVE_UP_S)  # both adapters are open
        daemon.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        hear(again, lambda one: one.arbitration_id == 0x123)
    finally:
        again.shutdown()
        daemon.shutdown()
