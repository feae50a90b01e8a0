"""Wheel boards of a configuration: on their wires, counting as the configuration says, with their faults."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import serial

from service.config import load
from sim_devices.attach import Attachment, MemoryLink
from sim_devices.device import Mount
from sim_devices.faults import FaultPlan
from sim_devices.floor_plan import FloorPlan, Wall
from sim_devices.presets import PRESETS, PresetError, Robot, emulate, for_log, hurry, preset, to_toml
from sim_devices.robot import CommandedMotion, SimScene, Trajectory, twist
from sim_devices.world import World
from tests.waiting import GIVE_UP_S, wait_for

MS = 1_000_000
SECOND = 1_000_000_000


def config(**wheels: Any) -> dict[str, Any]:
    return {
        "robot": {"id": "two"},
        "drive": {
            "source": "drive",
            "wheel_radius_left_m": 0.1,
            "wheel_radius_right_m": 0.1,
            "ticks_per_turn_left": 2000.0,
            "ticks_per_turn_right": -2000.0,
        },
        "can": {"main": {"bitrate_bps": 250000}},
        "wheels": {"drive": wheels},
    }


def straight() -> SimScene:
    """One metre a second, three metres far: 3 / (2 pi 0.1) turns, 9549.3 ticks."""
    return SimScene(World.from_plan(FloorPlan()), Trajectory((0.0, 0.0, 0.0), [twist(1.0, 0.0, 3.0)]))


TICKS = 3.0 / (2.0 * math.pi * 0.1) * 2000.0


def stage(tmp_path: Path, *faults: str, **wheels: Any) -> tuple[Attachment, Robot]:
    attachment = Attachment(clock=lambda: 0)
    plan = FaultPlan(faults) if faults else None
    robot = emulate(config(**wheels), straight(), attachment, tmp_path, plan=plan)
    assert plan is None or plan.complaints() == []
    return attachment, robot


def ask(robot: Robot, attachment: Attachment, port: serial.Serial, command: bytes, at_ns: int) -> bytes:
    """What a device says within 60 of its milliseconds; a pty hands bytes on in its own time."""
    (counters,) = (link.counters for link in robot.links.values() if str(getattr(link, "path", "")) == port.port)
    received, sent = counters.received_bytes + len(command), counters.sent_bytes
    port.write(command)

    def is_heard() -> bool:
        attachment.service(at_ns)
        return counters.received_bytes >= received

    wait_for("the device to hear it", is_heard, every_s=0.001)
    for later_ns in range(0, 60 * MS, MS):
        attachment.service(at_ns + later_ns)
    return bytes(port.read(counters.sent_bytes - sent))


@pytest.mark.parametrize(("fault", "left"), [("", 1.0), ("encoder:missed_counts=0.5(side=1)", 0.5)])
def test_arduino_board_on_a_pty(tmp_path: Path, fault: str, left: float) -> None:
    attachment, robot = stage(tmp_path, *([fault] if fault else []), driver="arduino-bridge")
    try:
        attachment.service(0)
        with serial.Serial(robot.config["wheels"]["drive"]["port"], 57600, timeout=GIVE_UP_S) as port:
            assert ask(robot, attachment, port, b"b\r", 2 * SECOND) == b"57600\r\n"
            counts = ask(robot, attachment, port, b"e\r", 10 * SECOND).split()
            assert int(counts[0]) == pytest.approx(left * TICKS, abs=2)
            assert int(counts[1]) == pytest.approx(-TICKS, abs=2)
    finally:
        attachment.stop()


def test_roboclaw_on_a_pty(tmp_path: Path) -> None:
    attachment, robot = stage(tmp_path, driver="roboclaw", address=0x81)
    try:
        attachment.service(0)
        with serial.Serial(robot.config["wheels"]["drive"]["port"], 115200, timeout=GIVE_UP_S) as port:
            counts = ask(robot, attachment, port, b"\x81\x4e", 10 * SECOND)
            assert int.from_bytes(counts[:4], "big") == pytest.approx(TICKS, abs=2)
            assert int.from_bytes(counts[4:8], "big", signed=True) == pytest.approx(-TICKS, abs=2)
            assert ask(robot, attachment, port, b"\x80\x4e", 11 * SECOND) == b""
    finally:
        attachment.stop()


@pytest.mark.parametrize(
    ("wheels", "ids"),
    [
        ({"driver": "odrive", "node_left": 3, "node_right": 4, "firmware": "0.5"}, (0x06A, 0x08A)),
        ({"driver": "vesc", "id_left": 10, "id_right": 11}, (0x1B0A, 0x1B0B)),
    ],
)
def test_nodes_on_a_bus(tmp_path: Path, wheels: dict[str, Any], ids: tuple[int, int]) -> None:
    attachment, robot = stage(tmp_path, can="main", **wheels)
    link = MemoryLink()
    robot.buses["main"].add_member("spy", link)
    try:
        attachment.service(0)
        link.host_write(b"S5\rO\r")
        for at_ms in range(0, 10_000, 20):
            attachment.service(at_ms * MS)
        link.host_read()
        little = wheels["driver"] == "odrive"
        if little:
            link.host_write(b"".join(b"r%03X8\r" % can_id for can_id in ids))
        for at_ms in range(10_000, 10_050, 5):
            attachment.service(at_ms * MS)
        seen = {}
        for line in link.host_read().split(b"\r"):
            digits = {b"t": 3, b"T": 8}.get(line[:1])
            if digits:
                data = bytes.fromhex(line[digits + 2 :].decode())
                seen[int(line[1 : digits + 1], 16)] = int.from_bytes(
                    data[:4], "little" if little else "big", signed=True
                )
        assert seen[ids[0]] == pytest.approx(TICKS, abs=3)
        assert seen[ids[1]] == pytest.approx(-TICKS, abs=3)
    finally:
        attachment.stop()


def test_hosts_commands_drive_a_robot_without_a_route(tmp_path: Path) -> None:
    scene = SimScene(World.from_plan(FloorPlan()), CommandedMotion((0.0, 0.0, 0.0)), begin_at_origin=False)
    attachment = Attachment(clock=lambda: 0)
    table = config(driver="arduino-bridge")
    table["drive"]["ticks_per_turn_right"] = 2000.0
    robot = emulate(table, scene, attachment, tmp_path, plan=FaultPlan(["encoder:slip=0.0"]))
    try:
        attachment.service(0)
        with serial.Serial(robot.config["wheels"]["drive"]["port"], 57600, timeout=GIVE_UP_S) as port:
            assert ask(robot, attachment, port, b"m 20 20\r", 2 * SECOND) == b"OK\r\n"
            for at_ns in range(2 * SECOND, 5 * SECOND, 20 * MS):
                attachment.service(at_ns)
            # 600 ticks a second for two seconds
            assert scene.pose_at([6 * SECOND])[0, 0] == pytest.approx(1200 / 2000 * 2 * math.pi * 0.1, abs=0.02)
    finally:
        attachment.stop()


def sonar_lines(tmp_path: Path, **sonar: Any) -> tuple[list[bytes], dict[str, Any]]:
    """What the sonar of a configuration says in three seconds, and its configuration afterwards."""
    attachment = Attachment(clock=lambda: 0)
    walls = FloorPlan(walls=(Wall(((2.05, -3.0), (2.05, 3.0))), Wall(((-3.0, 1.05), (3.0, 1.05)))))
    scene = SimScene(World.from_plan(walls), CommandedMotion((0.0, 0.0, 0.0)))
    robot = emulate({"robot": {"id": "two"}, "sonars": {"s": sonar}}, scene, attachment, tmp_path)
    try:
        with serial.Serial(robot.config["sonars"]["s"]["port"], 9600, timeout=0.1) as port:
            said = b""
            for at_ms in range(3000):
                attachment.service(at_ms * MS)
                if at_ms % 500 == 0:
                    said += port.read(4096)
            said += port.read(4096)
    finally:
        attachment.stop()
    return [line for line in said.replace(b"\n", b"").split(b"\r") if line], robot.config["sonars"]["s"]


def transducers(*channels: int) -> list[dict[str, float]]:
    return [{"channel": c, "yaw_deg": 90.0 * k} for k, c in enumerate(channels)]


def test_sonar_on_its_own_line(tmp_path: Path) -> None:
    said, table = sonar_lines(tmp_path, driver="maxbotix", family="xl", transducers=transducers(1))
    assert said[-2] in (b"R199", b"R200", b"R201")
    assert table["rate_hz"] == pytest.approx(10.1)


def test_sonars_behind_a_multiplexer(tmp_path: Path) -> None:
    settings = {"driver": "maxbotix", "family": "xl"}
    said, table = sonar_lines(tmp_path, **settings, lines="labelled", transducers=transducers(2, 5))
    assert {line[:4] for line in said[:-1]} <= {b"2:R1", b"2:R2", b"5:R1", b"5:R0"}
    assert table["rate_hz"] == pytest.approx(5.05)
    said, _ = sonar_lines(tmp_path, **settings, lines="list", transducers=transducers(1, 2))
    assert {len(line) for line in said[:-1]} == {9}
    with pytest.raises(PresetError, match="channels 1 to 2"):
        sonar_lines(tmp_path, **settings, lines="list", transducers=transducers(1, 4))


def test_wheels_and_sonars_on_one_port_are_one_board(tmp_path: Path) -> None:
    table = config(driver="arduino-bridge", port="/dev/ttyUSB7")
    pings = {"driver": "arduino-bridge", "transducers": [{"channel": 7}]}
    table["sonars"] = {"a": pings | {"port": "/dev/ttyUSB7"}, "b": pings | {"port": "/dev/ttyUSB8"}}
    attachment = Attachment(clock=lambda: 0)
    try:
        robot = emulate(
            table, straight(), attachment, tmp_path, plan=FaultPlan(["sonar.a:specular=1", "encoder:drop=0"])
        )
        ports = [robot.config["wheels"]["drive"], robot.config["sonars"]["a"], robot.config["sonars"]["b"]]
        assert ports[0]["port"] == ports[1]["port"] != ports[2]["port"]
        attachment.service(0)
        with serial.Serial(ports[0]["port"], 57600, timeout=GIVE_UP_S) as port:
            assert ask(robot, attachment, port, b"e\r", 2 * SECOND).count(b" ") == 1
            assert ask(robot, attachment, port, b"p 7\r", 3 * SECOND) == b"0\r\n"
    finally:
        attachment.stop()


@pytest.mark.parametrize("name", sorted(set(PRESETS) - {"alice"}))
def test_every_preset_with_a_laser_can_play_a_log(name: str, tmp_path: Path) -> None:
    table = for_log(preset(name), Mount(0.1), track_width_m=0.4, rate_hz=100.0, wheel_m_s=10.0)
    table["lasers"]["front"]["port"] = "/dev/null"
    path = tmp_path / "umfeld.toml"
    path.write_text(to_toml(table))
    loaded = load(path).config
    assert loaded.lasers["front"].driver == "hokuyo"
    assert not loaded.sonars


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_can_hurry(name: str, tmp_path: Path) -> None:
    table = preset(name)
    hurry(table, 3.0)
    path = tmp_path / "umfeld.toml"
    path.write_text(to_toml(table))
    assert load(path).config.drive.max_wheel_speed_m_s == 15.0


def test_unknown_wheels_say_what_there_is(tmp_path: Path) -> None:
    attachment = Attachment(clock=lambda: 0)
    try:
        with pytest.raises(PresetError, match="roboclaw"):
            emulate(config(driver="steam"), straight(), attachment, tmp_path)
    finally:
        attachment.stop()


@pytest.mark.parametrize("fault", ["rename=1", "busy", "no_permission", "wrong_baud"])
def test_what_only_a_serial_port_can_have_is_refused_on_a_network(tmp_path: Path, fault: str) -> None:
    """It was taken, and did nothing."""
    table = {"lasers": {"front": {"driver": "sick_cola", "port": "tcp://192.168.0.1:2112"}}}
    for laser, refused in ((None, True), ("utm-30lx", False)):
        plan = FaultPlan([f"laser:{fault}"])
        attachment = Attachment(clock=lambda: 0)
        emulate(copy.deepcopy(table), straight(), attachment, tmp_path, laser=laser, plan=plan, in_memory=True)
        attachment.stop()
        assert bool(plan.complaints()) is refused
        assert all("it hits port" in each for each in plan.complaints())
