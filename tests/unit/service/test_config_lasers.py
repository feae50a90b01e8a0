"""Lasers of every kind in the configuration, from the table to the driver, and their wires."""

from __future__ import annotations

import os
import socket
import termios
from pathlib import Path
from typing import Any

import pytest

from drivers.laser_hokuyo import HokuyoConversation
from drivers.laser_ldrobot import LdrobotConversation
from drivers.laser_rplidar import RplidarConversation
from drivers.laser_sick_cola import SickColaConversation
from drivers.laser_sick_lms2xx import SickLms2xxConversation
from drivers.ports import SerialPort, TcpPort
from service.assemble import sensors
from service.assemble_wires import conversation_of, wires
from service.config import Config, load
from service.config_devices import tcp_address
from service.errors import WrongUsage
from service.sensors import Laser


def load_text(tmp_path: Path, text: str) -> Config:
    path = tmp_path / "umfeld.toml"
    path.write_text(text)
    return load(path, environment={}).config


def laser(tmp_path: Path, text: str) -> Any:
    return load_text(tmp_path, f"[lasers.front]\n{text}\n").lasers["front"]


@pytest.mark.parametrize(
    ("text", "driver"),
    [
        ('driver = "hokuyo"\nport = "tcp://192.168.0.10:10940"', HokuyoConversation),
        ('driver = "sick_lms2xx"\nport = "/dev/ttyUSB0"', SickLms2xxConversation),
        (
            'driver = "sick_lms2xx"\nport = "/dev/ttyUSB0"\nbaud_bps = 500000\nfield_deg = 100\nresolution_deg = 0.25\n'
            'unit = "mm"',
            SickLms2xxConversation,
        ),
        ('driver = "rplidar"\nport = "/dev/ttyUSB0"', RplidarConversation),
        (
            'driver = "rplidar"\nport = "/dev/ttyUSB0"\nscan = "standard"\nmotor_pwm = 500\nno_echo = "clear"',
            RplidarConversation,
        ),
        ('driver = "ldrobot"\nport = "/dev/ttyUSB0"\nmount = { upside_down = true }', LdrobotConversation),
        ('driver = "sick_cola"\nport = "tcp://192.168.0.1:2112"\nstart = false', SickColaConversation),
    ],
)
def test_every_kind_has_its_driver_and_sensor(tmp_path: Path, text: str, driver: type) -> None:
    config = load_text(tmp_path, f"[lasers.front]\n{text}\n")
    assert type(conversation_of(config.lasers["front"])) is driver
    found = sensors(config)["front"]
    assert isinstance(found, Laser)
    assert found.upside_down == ("upside_down" in text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('driver = "sick_lms2xx"\nport = "/dev/a"\nresolution_deg = 0.25', "resolution_deg is one of"),
        ('driver = "sick_lms2xx"\nport = "/dev/a"\nbaud_bps = 115200', "baud_bps"),
        ('driver = "sick"\nport = "/dev/a"', "sick_lms2xx"),
        ('driver = "rplidar"\nport = "/dev/a"\nmotor_pwm = 2000', "motor_pwm"),
        ('driver = "ldrobot"\nport = "/dev/a"\nno_echo = "free"', "no_echo"),
        ('driver = "sick_cola"\nport = "tcp://192.168.0.1"', "tcp://HOST:PORT"),
        ('driver = "hokuyo"\nport = "tcp://a:99999"', "tcp://HOST:PORT"),
        ('port = "/dev/a"', "driver"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(WrongUsage) as error:
        laser(tmp_path, text)
    assert words in str(error.value)


def test_two_lasers_on_one_address_are_refused(tmp_path: Path) -> None:
    text = (
        '[lasers.a]\ndriver = "hokuyo"\nport = "tcp://h:10940"\n[lasers.b]\ndriver = "hokuyo"\nport = "tcp://h:10940"\n'
    )
    with pytest.raises(WrongUsage, match="already used"):
        load_text(tmp_path, text)


def test_addresses() -> None:
    assert tcp_address("/dev/ttyUSB0") is None
    assert tcp_address("tcp://scanner.local:2112") == ("scanner.local", 2112)
    assert tcp_address("tcp://[fd00::1]:10940") == ("fd00::1", 10940)


def test_a_laser_behind_tcp(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        config = load_text(tmp_path, f'[lasers.front]\ndriver = "hokuyo"\nport = "{address}"\n')
        (wire,) = wires(config)
        assert wire.port is None
        port = wire.open_port(lambda: 0)
        assert isinstance(port, TcpPort)
        assert port.name == address
        port.close()


def test_the_motor_line_of_an_rplidar_on_a_port_without_one(tmp_path: Path) -> None:
    """A pty has no DTR: opening and closing must do without, and closing must still ask the system to keep it."""
    master, slave = os.openpty()
    try:
        config = load_text(tmp_path, f'[lasers.front]\ndriver = "rplidar"\nport = "{os.ttyname(slave)}"\n')
        (wire,) = wires(config)
        port = wire.open_port(lambda: 0)
        assert isinstance(port, SerialPort)
        port.close()
        assert not termios.tcgetattr(slave)[2] & termios.HUPCL
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize("driver", ["hokuyo", "sick_lms2xx"])
def test_what_a_laser_says_of_nothing_may_be_doubted(tmp_path: Path, driver: str) -> None:
    for no_echo, free in (("clear", True), ("unknown", False)):
        text = f'[lasers.front]\ndriver = "{driver}"\nport = "/dev/ttyUSB0"\nno_echo = "{no_echo}"\n'
        front = sensors(load_text(tmp_path, text))["front"]
        assert isinstance(front, Laser)
        assert front.nothing_is_free is free


@pytest.mark.parametrize("driver", ["hokuyo", "rplidar", "ldrobot", "sick_cola"])
def test_limits_that_nothing_lies_between_are_refused(tmp_path: Path, driver: str) -> None:
    port = "tcp://192.168.0.1:2112" if driver == "sick_cola" else "/dev/ttyUSB0"
    with pytest.raises(WrongUsage) as error:
        laser(tmp_path, f'driver = "{driver}"\nport = "{port}"\nrange_min_m = 5.0\nrange_max_m = 3.0')
    assert "lasers.front: range_min_m must be below range_max_m" in str(error.value)
