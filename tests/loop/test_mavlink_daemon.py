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

import numpy as np
import pytest

from tests.waiting import GIVE_UP_S, START_S, free_port, kill_devices, wait_for

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported

from pymavlink import mavutil

ROOT = Path(__file__).resolve().parents[2]


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
        wait_for("the devices", config.exists)
        daemon = subprocess.Popen([*command, "service", "run", "--config", str(config)], **told)
    try:
        yield autopilot, devices
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(GIVE_UP_S) == 0, (tmp_path / "log").read_text()
    finally:
        for process in (daemon, devices):
            process.kill()
            process.wait()
        autopilot.close()


def hear(autopilot: Any, kind: str = "OBSTACLE_DISTANCE") -> Any:
    message = autopilot.recv_match(type=kind, blocking=True, timeout=START_S)
    assert message is not None, f"no {kind} within {START_S} s"
    return message


def test_an_autopilot_hears_obstacles_on_a_steady_beat_and_blindness_at_once(
    robot: tuple[Any, subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    autopilot, devices = robot
    heartbeat = hear(autopilot, "HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (18, 8)
    assert heartbeat.get_srcComponent() == 196

    def obstacle() -> Any:
        heard = hear(autopilot)
        return heard if any(20 < each < 601 for each in heard.distances) else None

    message = wait_for("an obstacle", obstacle, every_s=0.0)
    assert (message.frame, message.increment, message.increment_f, message.angle_offset) == (12, 5, 0.0, 0.0)
    assert (message.max_distance, message.sensor_type) == (600, 0)
    behind = message.distances[30:43]  # the laser looks 120 degrees to either side
    assert set(behind) == {65535}
    heard_s = []
    for _ in range(45):
        hear(autopilot)
        heard_s.append(time.monotonic())
    assert np.median(np.diff(heard_s)) < 0.1  # at least ten a second; a machine that is held up is late for a few
    kill_devices(devices, tmp_path)
    blind_usec = time.monotonic_ns() // 1000 + 500_000  # a message has the stamp of the map that it tells
    while (message := hear(autopilot)).time_usec < blind_usec:
        pass
    assert set(message.distances) == {65535}
    for _ in range(10):
        assert set(hear(autopilot).distances) == {65535}
