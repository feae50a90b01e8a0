"""Devices that are told apart by who they are: two lasers of a kind plugged in the other way round, and `detect`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.readings import ScanReading
from service import assemble_wires, detect
from service.config import check
from service.config_files import Layers
from sim_devices.attach import Attachment
from sim_devices.device import Mount
from sim_devices.encoder_arduino_bridge import ArduinoBridge
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.laser_hokuyo import HokuyoLaser
from sim_devices.laser_ldrobot import LdLidar
from sim_devices.laser_rplidar import RpLidar
from sim_devices.laser_sick_lms2xx import SickLms2xxLaser
from sim_devices.mavlink_autopilot import MavlinkAutopilot
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_maxbotix import MaxBotix
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardSerial
from sim_devices.wheel import Wheel
from tests.waiting import GIVE_UP_S, BeatStation, SteadyClock, wait_for

F64 = NDArray[np.float64]


class Room:
    """A round room: all a laser sees is how far its wall is, which tells whose scan it is."""

    def __init__(self, radius_m: float) -> None:
        self.radius_m = radius_m

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), self.radius_m)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return self.radius_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)


def swap_paths(first: PtyLink, second: PtyLink) -> None:
    first.path, second.path = second.path, first.path


def test_two_lasers_of_a_kind_keep_their_names_when_plugged_in_the_other_order(tmp_path: Path) -> None:
    attachment = Attachment()
    links = {name: PtyLink(tmp_path / f"ttyACM{number}") for number, name in enumerate(("H0000001", "H0000002"))}
    for (number, link), radius_m in zip(links.items(), (1.0, 2.0)):
        laser = HokuyoLaser(Room(radius_m), serial=number, spin_up_s=0.1, noise_scale=0.0)
        attachment.add(number, laser, link)
    attachment.start()
    data = {
        "lasers": {
            "left": {"driver": "hokuyo", "serial": "H0000001"},
            "right": {"driver": "hokuyo", "port": "serial:H0000002"},
        },
        "search": {"ports": [f"{tmp_path}/ttyACM*"]},
    }
    wires = assemble_wires.wires(check(Layers(data, {}, {}, ())))
    assert [wire.port for wire in wires] == [None, None]
    heard: dict[str, list[float]] = {"left": [], "right": []}

    def sink(source: str, item: object) -> None:
        if isinstance(item, ScanReading):
            heard[source].append(round(float(np.median(item.range_m)), 1))

    readers = [wire.reader(sink, time.monotonic_ns) for wire in wires]
    for reader in readers:
        reader.start()
    try:
        wait_for("both lasers", lambda: all(len(scans) > 3 for scans in heard.values()))
        for name in links:
            attachment.unplug(name)
        wait_for("the loss", lambda: not any(reader.health().is_open for reader in readers))
        attachment.post(lambda: swap_paths(*links.values()))
        before = {name: len(scans) for name, scans in heard.items()}
        for name in links:
            attachment.replug(name)
        wait_for("both lasers again", lambda: all(len(heard[name]) > before[name] + 3 for name in heard))
    finally:
        for reader in readers:
            assert reader.stop(GIVE_UP_S)
        attachment.stop()
    assert set(heard["left"]) == {1.0}
    assert set(heard["right"]) == {2.0}


def test_a_laser_that_is_not_there_is_told_by_its_number(tmp_path: Path) -> None:
    data = {"lasers": {"left": {"driver": "hokuyo", "serial": "H7"}}, "search": {"ports": [f"{tmp_path}/*"]}}
    (wire,) = assemble_wires.wires(check(Layers(data, {}, {}, ())))
    with pytest.raises(Exception, match=r"no device with serial number H7 .*plugged in"):
        wire.open_port(time.monotonic_ns)


def test_detect_names_what_is_on_each_port_in_time_and_side_by_side(tmp_path: Path) -> None:
    clock = SteadyClock()
    attachment = Attachment(clock=clock)
    room = Room(2.0)
    wheels = Wheel(room, "left", 0.1, 1000.0), Wheel(room, "right", 0.1, 1000.0)
    devices: dict[str, Any] = {
        "hokuyo": HokuyoLaser(room, serial="H0614967"),
        "sick_lms2xx": SickLms2xxLaser(room),
        "rplidar": RpLidar(room),
        "ldrobot": LdLidar(room),
        "arduino-bridge": ArduinoBridge(None, None),
        "roboclaw": RoboClaw(*wheels, link="ttl"),
        "usboard-serial": UsBoardSerial(UsBoard(room, {1: Transducer(Mount())})),
        "maxbotix": MaxBotix(room, Mount()),
        "maxbotix on USB": MaxBotix(room, Mount(), family="hrusb"),
        "mavlink": MavlinkAutopilot(room),
    }
    for name, device in devices.items():
        attachment.add(name, device, PtyLink(tmp_path / name))
    adapter = CanBusStation(CanBus())
    adapter.add_member("host", PtyLink(tmp_path / "slcan"))
    attachment.add_station("slcan", adapter)
    attachment.add_station("beat", BeatStation(clock))
    devices["slcan"] = adapter
    silent = PtyLink(tmp_path / "silent")
    attachment.start()
    try:
        began_ns = clock()
        ports = [(str(tmp_path / name), "") for name in (*devices, "silent", "absent")]
        found = {Path(each.port).name: each for each in detect.detect(ports, now_ns=clock)}
        took_s = (clock() - began_ns) / 1e9
    finally:
        attachment.stop()
        silent.close()
        clock.stop()
    assert {name: each.driver for name, each in found.items()} == {
        **{name: name.removesuffix(" on USB") for name in devices},
        "silent": "",
        "absent": "",
    }
    assert "plugged in" in found["absent"].trouble
    identity = found["hokuyo"].identity
    assert identity is not None
    assert identity.serial == "H0614967"
    assert found["ldrobot"].speed_bps == 230400
    assert (found["maxbotix"].speed_bps, found["maxbotix on USB"].speed_bps) == (9600, 57600)
    assert took_s < 30.0, "one after the other would take minutes: a silent port alone takes twelve seconds"


def test_an_old_urg_is_found_as_it_wakes_up_in_scip_1(tmp_path: Path) -> None:
    attachment = Attachment()
    laser = HokuyoLaser(Room(2.0), serial="H0300011", start_in_scip1=True)  # RS-232, 19200 bit/s
    attachment.add("laser", laser, PtyLink(tmp_path / "laser"))
    attachment.start()
    try:
        (found,) = detect.detect([(str(tmp_path / "laser"), "")])
    finally:
        attachment.stop()
    assert (found.driver, found.speed_bps) == ("hokuyo", 19200)
    assert found.identity is not None
    assert (found.identity.serial, found.identity.model) == ("H0300011", "SOKUIKI Sensor URG-04LX")


@pytest.mark.parametrize("end", [b"", b"\n"], ids=["as a real one", "by the book"])
def test_an_old_urg_is_known_once_its_whole_answer_came(end: bytes) -> None:
    told = b"VEND:Hokuyo\nPROD:URG\nFIRM:3.0.00\nPROT:00003,(SCIP 1.0)\nSERI:H7\n" + end
    (probe,) = (probe for probe in detect.PROBES if probe.driver == "hokuyo")
    said = b"VV\nE\n\nV\n0\n" + told
    answers = [probe.recognise(said[:cut]) for cut in range(len(said) + 1)]
    known = [answer for answer in answers if answer is not None]
    assert len(known) == 1 + len(end)
    assert known[0].serial == "H7"


def test_no_noise_is_taken_for_a_device() -> None:
    random = np.random.default_rng(5)
    texts = [b"", b"Invalid Command\r\n" * 3, b"hello 57600 world\r\n", b"$GPGGA,123519,4807.038,N*47\r\n" * 5, b"V\r"]
    noise = [random.bytes(int(size)) for size in random.integers(1, 4000, 300)]
    for data in [*texts, *noise, b"\xff" * 2000, b"\x00" * 2000, b"R" * 500, b"\x54\x2c" * 200, b"\xa5\x5a" * 100]:
        for probe in detect.PROBES:
            assert probe.recognise(data) is None, (probe.driver, data[:40])


def test_questions_only_read() -> None:
    """No probe says what sets a motor going, resets a count or writes a setting, in anybody's protocol."""
    everything = b"".join(question for probe in detect.PROBES for question in probe.ask)
    for letter in b"mruowxcs":  # ros_arduino_bridge: motors, resets, gains, outputs, servos
        assert letter not in everything
    assert b"\x80" not in everything.replace(b"\x80\x15", b"")  # RoboClaw's address, but for its version
    assert all(word not in everything for word in (b"BM", b"MD", b"GD", b"RS", b"RT", b"\xa5\x20", b"\xa5\x40"))
