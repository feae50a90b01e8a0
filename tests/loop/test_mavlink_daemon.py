"""An autopilot's view of the daemon: pymavlink on UDP hears what surrounds an emulated robot, and when it is blind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported

from pymavlink import mavutil

ROOT = Path(__file__).resolve().parents[2]


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[tuple[Any, subprocess.Popen[bytes]]]:
    """The autopilot's end of the link, and the process of the devices."""
    port = free_port(socket.SOCK_DGRAM)
    overlay = tmp_path / "umfeld.d"
    overlay.mkdir()
    (overlay / "test.toml").write_text(
        f'[network]\nlisten = ["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]\n[store]\nenabled = false\n'
        f'[mavlink]\nenabled = true\nmap = "laser"\nport = "udpout:127.0.0.1:{port}"\nrange_max_m = 6.0\n'
    )
    config = tmp_path / "umfeld.toml"
    autopilot = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=1, dialect="common")
    command = [sys.executable, "-m"]
    with (tmp_path / "log").open("wb") as log:
        told: dict[str, Any] = {"cwd": ROOT, "stdout": log, "stderr": log, "stdin": subprocess.DEVNULL}
        devices = subprocess.Popen([*command, "sim_devices", "--preset", "artos", "--dir", str(tmp_path)], **told)
        deadline = time.monotonic() + 20
        while not config.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        daemon = subprocess.Popen([*command, "service", "run", "--config", str(config)], **told)
    try:
        yield autopilot, devices
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(15) == 0, (tmp_path / "log").read_text()
    finally:
        for process in (daemon, devices):
            process.kill()
            process.wait()
        autopilot.close()


def hear(autopilot: Any, kind: str = "OBSTACLE_DISTANCE", seconds: float = 30.0) -> Any:
    message = autopilot.recv_match(type=kind, blocking=True, timeout=seconds)
    assert message is not None, f"no {kind} within {seconds} s"
    return message


def test_an_autopilot_hears_obstacles_on_a_steady_beat_and_blindness_at_once(
    robot: tuple[Any, subprocess.Popen[bytes]],
) -> None:
    autopilot, devices = robot
    heartbeat = hear(autopilot, "HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (18, 8)
    assert heartbeat.get_srcComponent() == 196
    deadline = time.monotonic() + 30
    message = hear(autopilot)
    while not any(20 < each < 601 for each in message.distances):
        assert time.monotonic() < deadline, "no obstacle was ever told"
        message = hear(autopilot)
    assert (message.frame, message.increment, message.increment_f, message.angle_offset) == (12, 5, 0.0, 0.0)
    assert (message.max_distance, message.sensor_type) == (600, 0)
    behind = message.distances[30:43]  # the laser looks 120 degrees to either side
    assert set(behind) == {65535}
    began = time.monotonic()
    for _ in range(45):
        hear(autopilot, seconds=1.0)
    assert time.monotonic() - began < 4.5, "at least ten a second, whatever else this machine does"
    devices.kill()
    killed = time.monotonic()
    while set(hear(autopilot, seconds=1.0).distances) != {65535}:
        assert time.monotonic() - killed < 2.0, "half a second, and what waited in between"
    for _ in range(10):
        assert set(hear(autopilot, seconds=1.0).distances) == {65535}
