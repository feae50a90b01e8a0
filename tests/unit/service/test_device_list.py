"""Ports of this machine, from folders made like the system's."""

from __future__ import annotations

import os
import pty
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from drivers.readings import Identity
from service.commands.devices import _as_toml
from service.config import load
from service.detect import PROBES, Detected, Probe, ports_like
from service.device_list import can_interfaces, permission_trouble, serial_ports


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.driver)
@pytest.mark.parametrize("serial", ["", "H0614967"])
def test_tables_that_detect_prints_are_a_configuration(probe: Probe, serial: str, tmp_path: Path) -> None:
    said = Identity(model="3 digits" if probe.driver == "maxbotix" else "", serial=serial)
    found = [Detected("/dev/ttyUSB0", "", probe.driver, probe.section, 115200, said)]
    path = tmp_path / "umfeld.toml"
    path.write_text(_as_toml(found))
    config = load(path, environment={}).config
    device = next((device for _, _, device in config.devices()), None)
    assert (device is None) == (probe.section == "can")
    if probe.driver in ("maxbotix", "arduino-bridge", "roboclaw", "mavlink"):  # which do not look for the speed
        assert getattr(device, "baud_bps", None) == 115200


@pytest.mark.parametrize(("trouble", "is_advised"), [("", True), ("permission denied", False)])
def test_who_finds_nobody_is_told_what_to_look_for(
    trouble: str, is_advised: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from typer.testing import CliRunner

    from service.commands import devices

    monkeypatch.setattr(devices, "_detect", lambda _: [Detected("/dev/ttyUSB0", "", trouble=trouble)])
    told = CliRunner().invoke(devices.app, ["detect"])
    assert told.exit_code == 1
    assert ("is it powered" in told.output) is is_advised


def test_files_beside_ports_are_not_asked(tmp_path: Path) -> None:
    """A pattern over the folder of emulated devices: their configuration lies beside them."""
    master, slave = pty.openpty()
    (tmp_path / "laser-front").symlink_to(os.ttyname(slave))
    (tmp_path / "umfeld.toml").touch()
    (tmp_path / "recordings").mkdir()
    try:
        assert ports_like([f"{tmp_path}/*"]) == [f"{tmp_path}/laser-front"]
        assert ports_like([f"{tmp_path}/umfeld.toml"]) == []
    finally:
        os.close(master)
        os.close(slave)


def test_a_port_is_shown_by_the_name_that_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    (tmp_path / "usb-Hokuyo_URG").symlink_to(device)
    info = ListPortInfo(device)
    info.manufacturer, info.product, info.serial_number = "Hokuyo", "URG", None
    monkeypatch.setattr(list_ports, "comports", lambda: [info])
    (port,) = serial_ports(tmp_path)
    os.close(master)
    os.close(slave)
    assert (port.name, port.stable_name, port.description) == (device, str(tmp_path / "usb-Hokuyo_URG"), "Hokuyo URG")
    assert port.trouble == ""
    assert serial_ports(tmp_path / "none")[0].stable_name == ""


def test_can_interfaces_and_whether_they_are_up(tmp_path: Path) -> None:
    for name, kind, state, flags in (
        ("can0", "280", "up", "0x40081"),
        ("can1", "280", "down", "0x40080"),
        ("eth0", "1", "up", "0x1003"),
    ):
        (tmp_path / name).mkdir()
        for file, text in (("type", kind), ("operstate", state), ("flags", flags)):
            (tmp_path / name / file).write_text(text + "\n")
    (tmp_path / "bonding_masters").write_text("")
    assert [(each.name, each.trouble) for each in can_interfaces(tmp_path)] == [
        ("can0", ""),
        ("can1", "it is down; sudo ip link set can1 up type can bitrate 1000000"),
    ]
    assert can_interfaces(tmp_path / "none") == []


def test_a_port_that_may_not_be_opened_names_the_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "tty"
    port.write_text("")
    assert permission_trouble(port) == ""
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "sudo usermod -aG" in permission_trouble(port)
