"""Other people's MAVLink on the emulated autopilot: pymavlink's connections, on which most ground tools stand; mavsdk
(4 or later), which asks for version, parameters and rates as ground stations do; dronekit2; mavio, which has its own
codec and asks what a board is; mavping."""

from __future__ import annotations

import importlib
import importlib.util
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_devices.attach import Attachment
from sim_devices.device import F64, Mount
from sim_devices.mavlink_autopilot import MavlinkAutopilot, Rangefinder
from sim_devices.pty_link import PtyLink
from sim_devices.udp_link import UdpLink
from tests.waiting import GIVE_UP_S, wait_for

pytestmark = pytest.mark.skipif(importlib.util.find_spec("pymavlink") is None, reason="needs pymavlink")


class Rolling:
    """Wheels at half a metre a second, a wall a metre away."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.ones(len(bearing_rad))

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.5e-9 * now_ns, 0.5e-9 * now_ns


@pytest.fixture(params=["pty", "udpin", "udpout"])
def meeting(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[MavlinkAutopilot, Any]]:
    """An autopilot and a connection to it: on a serial line, as one who listens, as one who calls."""
    os.environ["MAVLINK20"] = "1"  # read when mavutil is imported
    from pymavlink import mavutil

    on_udp = request.param != "pty"
    pilot = MavlinkAutopilot(Rolling(), line_rate_bps=None if on_udp else 57600, rangefinders=[Rangefinder(0, Mount())])
    link: PtyLink | UdpLink
    identity = {"source_system": 1, "source_component": 196, "dialect": "common"}
    if request.param == "pty":
        link = PtyLink(tmp_path / "pilot")
        host = mavutil.mavlink_connection(str(tmp_path / "pilot"), baud=57600, **identity)
    elif request.param == "udpin":
        host = mavutil.mavlink_connection("udpin:127.0.0.1:0", **identity)
        link = UdpLink(host.port.getsockname()[1])
    else:
        link = UdpLink()
        host = mavutil.mavlink_connection(f"udpout:127.0.0.1:{link.port}", **identity)
    loop = Attachment()
    loop.add("pilot", pilot, link)
    with loop:
        host.mav.heartbeat_send(18, 8, 0, 0, 4)
        yield pilot, host
        host.close()


def test_messages_flow_both_ways(meeting: tuple[MavlinkAutopilot, Any]) -> None:
    pilot, host = meeting
    assert host.recv_match(type="HEARTBEAT", blocking=True, timeout=GIVE_UP_S).autopilot == 3
    for _ in range(3):
        host.mav.heartbeat_send(18, 8, 0, 0, 4)
        host.mav.obstacle_distance_send(0, 0, [100] + [401] * 71, 5, 20, 400, 5.0, 0.0, 12)
        time.sleep(0.1)
    first = host.recv_match(type="WHEEL_DISTANCE", blocking=True, timeout=GIVE_UP_S)
    odometry = host.recv_match(type="ODOMETRY", blocking=True, timeout=GIVE_UP_S)
    near = host.recv_match(type="DISTANCE_SENSOR", blocking=True, timeout=GIVE_UP_S)
    assert first.count == 2
    assert odometry.vx == pytest.approx(0.5, abs=0.01)
    assert near.current_distance == 100
    assert pilot.companion_ns is not None
    wait_for("all three", lambda: pilot.accepted == 3)
    assert pilot.refused == 0


@pytest.mark.skipif(importlib.util.find_spec("dronekit") is None, reason="needs dronekit2")
def test_dronekit_is_ready_with_all_that_it_waits_for(tmp_path: Path) -> None:
    """Parameters, a first word of the GPS, mode, attitude: its usual way to connect waits for each of them."""
    pilot = MavlinkAutopilot(Rolling(), line_rate_bps=57600, rangefinders=[Rangefinder(0, Mount())])
    loop = Attachment()
    loop.add("pilot", pilot, PtyLink(tmp_path / "pilot"))
    with loop:
        vehicle: Any = importlib.import_module("dronekit").connect(
            str(tmp_path / "pilot"), baud=57600, wait_ready=True, timeout=20
        )
        try:
            assert vehicle.parameters["PRX1_TYPE"] == 2.0
            assert vehicle.gps_0.fix_type == 1
            assert vehicle.mode.name == "MANUAL"
        finally:
            vehicle.close()


def said_on_a_line(command: list[str], path: Path, seconds: float) -> str:
    """What a program says that was given the emulated autopilot's serial port."""
    pilot = MavlinkAutopilot(Rolling(), line_rate_bps=57600, rangefinders=[Rangefinder(0, Mount())])
    loop = Attachment()
    loop.add("pilot", pilot, PtyLink(path))
    with loop:
        return subprocess.run(
            [str(Path(sys.executable).with_name(command[0])), *command[1:]],
            capture_output=True, text=True, timeout=seconds, check=False,
        ).stdout  # fmt: skip


@pytest.mark.skipif(importlib.util.find_spec("mavping") is None, reason="needs mavping")
def test_mavping_hears_the_clock(tmp_path: Path) -> None:
    port = str(tmp_path / "pilot")
    said = said_on_a_line(
        ["mavping", "--port", port, "--baud", "57600", "--count", "4", "--interval", "0.2"], tmp_path / "pilot", 30.0
    )
    assert "Successful: 4" in said


@pytest.mark.skipif(importlib.util.find_spec("mavio") is None, reason="needs mavio")
def test_mavio_finds_out_what_it_is(tmp_path: Path) -> None:
    said = said_on_a_line(["mavio", "probe", str(tmp_path / "pilot"), "--baud", "57600"], tmp_path / "pilot", 60.0)
    assert "GROUND_ROVER / ArduPilot" in said
    assert "ArduPilot 4.5.0" in said


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="needs mavsdk")
@pytest.mark.parametrize(("kind", "id_name"), [("px4", "MAV_SYS_ID"), ("ardupilot", "SYSID_THISMAV")])
def test_mavsdk_meets_its_autopilot(kind: Any, id_name: str) -> None:
    mavsdk = importlib.import_module("mavsdk")
    telemetry, info, param = (importlib.import_module(f"mavsdk.plugins.{n}") for n in ("telemetry", "info", "param"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    pilot = MavlinkAutopilot(Rolling(), kind=kind, system=7, line_rate_bps=None, rangefinders=[Rangefinder(0, Mount())])
    loop = Attachment()
    loop.add("pilot", pilot, UdpLink(port))
    ground = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION))
    try:
        ground.add_any_connection(f"udpin://127.0.0.1:{port}")
        with loop:
            system = ground.first_autopilot(5.0)
            assert system is not None
            assert system.get_system_id() == 7
            heard: dict[str, list[Any]] = {"odometry": [], "distance_sensor": []}
            asks = telemetry.Telemetry(system)
            for name, values in heard.items():
                getattr(asks, f"subscribe_{name}")(lambda value, _=None, values=values: values.append(value))
                getattr(asks, f"set_rate_{name}")(50.0)
            for values in heard.values():
                values.clear()
            time.sleep(1.0)
            assert len(heard["odometry"]) == pytest.approx(50, abs=8)
            assert heard["odometry"][-1].velocity_body.x_m_s == pytest.approx(0.5, abs=0.01)
            assert heard["distance_sensor"][-1].current_distance_m == pytest.approx(1.0)
            assert info.Info(system).get_version().flight_sw_major == (1 if kind == "px4" else 4)
            numbers = {each.name: each.value for each in param.Param(system).get_all_params().int_params}
            assert numbers[id_name] == 7
    finally:
        ground.destroy()
