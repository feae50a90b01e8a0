"""After a crash the devices are left safe; and a hand before a sensor tells its name. Over ptys, as commands."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.laser_rplidar import SPEEDS
from drivers.reader import WireReader
from service import assemble_wires
from service.config import load
from service.farewell import stop_devices
from service.locks import Claims
from sim_devices.attach import Attachment
from sim_devices.device import Mount
from sim_devices.laser_hokuyo import HokuyoLaser
from sim_devices.laser_rplidar import RpLidar
from sim_devices.pty_link import PtyLink
from tests.waiting import GIVE_UP_S, START_S, free_port, wait_for

F64 = NDArray[np.float64]
# A command that checks devices waits for this one.
ABSENT_SONAR = """
[sonars.side]
driver = "maxbotix"
family = "hr-5m"
port = "/dev/none"
transducers = [{channel = 1}]
"""
ROOT = Path(__file__).resolve().parents[2]


class Room:
    """A round room; its radius may change, as if a hand were held before the sensor."""

    radius_m = 2.0

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), self.radius_m)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return self.radius_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


class Deaf(RpLidar):
    """Loses what it is told after it began to scan: `deaf_for` bytes of it, None for ever."""

    deaf_for: int | None = 0

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        if received and self.is_scanning and self.deaf_for != 0:
            self.deaf_for = None if self.deaf_for is None else max(self.deaf_for - len(received), 0)
            received = b""
        return super().step(now_ns, received, baud)


class Robot:
    """Two lasers on ptys and a configuration that names them."""

    def __init__(self, folder: Path) -> None:
        self.rooms = {"front": Room(), "rear": Room()}
        self.front = HokuyoLaser(self.rooms["front"], spin_up_s=0.1)
        self.rear = Deaf(self.rooms["rear"])
        self.attachment = Attachment()
        self.attachment.add("front", self.front, PtyLink(folder / "front"))
        self.attachment.add("rear", self.rear, PtyLink(folder / "rear"))
        self.attachment.start()
        self.config = folder / "umfeld.toml"
        self.config.write_text(
            f'[lasers.front]\ndriver = "hokuyo"\nport = "{folder}/front"\n'
            f'[lasers.rear]\ndriver = "rplidar"\nport = "{folder}/rear"\n'
            "[grid]\nenabled = false\n"
        )


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    made = Robot(tmp_path)
    yield made
    made.attachment.stop()


def crashed(robot: Robot) -> None:
    """Bring the lasers up, then drop the lines without a word, as a killed daemon does."""
    wires = assemble_wires.wires(load(robot.config).config)
    readers: list[WireReader[Any]] = [wire.reader(lambda _name, _item: None, time.monotonic_ns) for wire in wires]
    stopping = threading.Event()

    def turn(reader: WireReader[Any]) -> None:
        while not stopping.is_set():
            reader.step()

    threads = [threading.Thread(target=turn, args=(reader,)) for reader in readers]
    for thread in threads:
        thread.start()
    try:
        wait_for("both lasers", lambda: robot.front.laser_is_on and robot.rear.is_scanning)
    finally:
        stopping.set()
        for thread in threads:
            thread.join()
    for reader in readers:
        port = reader._port
        assert port is not None
        port.close()
    assert robot.front.laser_is_on


def test_after_a_crash_stop_leaves_every_laser_dark(robot: Robot) -> None:
    crashed(robot)
    done = subprocess.run(
        [sys.executable, "-m", "service", "devices", "stop", "--config", str(robot.config), "--json"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=GIVE_UP_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert [each["name"] for each in json.loads(done.stdout)] == ["front", "rear"]
    wait_for("darkness", lambda: not robot.front.laser_is_on and not robot.rear.is_scanning)


ONE_ROUND = len(SPEEDS) * 2 * len(b"\xa5\x25")  # STOP, twice at each speed


@pytest.mark.parametrize("deaf_for", [ONE_ROUND, None], ids=["for a moment", "for ever"])
def test_a_laser_that_did_not_hear_is_told_again(robot: Robot, deaf_for: int | None) -> None:
    crashed(robot)
    robot.rear.deaf_for = deaf_for
    front, rear = stop_devices(load(robot.config).config, clock=time.monotonic_ns)
    wait_for("darkness", lambda: not robot.front.laser_is_on)
    assert not front.trouble
    assert ("goes on sending" in rear.trouble) == (deaf_for is None)
    assert robot.rear.is_scanning == (deaf_for is None)


def take_terminal() -> None:
    """As a shell in a terminal has it: that is the one whose closing is told, also where the tests run under nohup."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize(
    ("command", "number"),
    [("run", signal.SIGHUP), ("check --seconds 600", signal.SIGTERM), ("devices identify", signal.SIGHUP)],
)
def test_a_command_leaves_devices_safe_when_its_terminal_is_closed(robot: Robot, command: str, number: int) -> None:
    """Or when it is told to end. A lost ssh connection closes the terminal: SIGHUP, and no printing any more."""
    settings = f'\n[network]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n[store]\nenabled = false\n'
    robot.config.write_text(robot.config.read_text() + settings + ABSENT_SONAR)
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "service", *command.split(), "--config", str(robot.config)],
        cwd=ROOT,
        stdin=end,
        stdout=end,
        stderr=end,
        start_new_session=True,
        preexec_fn=take_terminal,
    )
    os.close(end)
    os.set_blocking(terminal, False)
    said = b""

    def are_on() -> bool:
        nonlocal said
        with suppress(BlockingIOError):
            said += os.read(terminal, 4096)
        assert process.poll() is None, said.decode()
        return robot.front.laser_is_on and robot.rear.is_scanning

    try:
        wait_for("both lasers", are_on, START_S)
        if number == signal.SIGHUP:
            os.close(terminal)
        else:
            process.send_signal(number)
        code = process.wait(GIVE_UP_S)
    finally:
        if process.poll() is None:
            process.kill()
        if number != signal.SIGHUP:
            os.close(terminal)
    assert code == (0 if command == "run" else 128 + number)
    wait_for("darkness", lambda: not robot.front.laser_is_on and not robot.rear.is_scanning)


def test_devices_of_a_running_daemon_are_left_to_it_and_absent_ones_are_told(robot: Robot, tmp_path: Path) -> None:
    config = load(robot.config).config
    with Claims() as claims:
        claims.claim_ports([str(tmp_path / "front")])
        front, rear = stop_devices(config, clock=time.monotonic_ns)
    assert "in use by another umfeld daemon" in front.trouble
    assert (rear.trouble, rear.items > 0) == ("", True)
    robot.attachment.unplug("front")
    wait_for("the loss", lambda: not (tmp_path / "front").exists())
    front, _ = stop_devices(config, clock=time.monotonic_ns)
    assert "plugged in" in front.trouble


def test_the_unit_file_stops_devices_also_after_a_crash() -> None:
    lines = (ROOT / "deploy/umfeld.service").read_text().splitlines()
    (start,) = (line for line in lines if line.startswith("ExecStart="))
    (stop,) = (line for line in lines if line.startswith("ExecStopPost="))
    command = start.removeprefix("ExecStart=").split()[0]
    assert stop.removeprefix("ExecStopPost=-").startswith(f"{command} devices stop --config ")
    assert stop.split("--config ")[1] == start.split("--config ")[1]


def test_a_covered_sensor_tells_its_name_and_port(robot: Robot, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "service", "devices", "identify", "--config", str(robot.config), "--seconds", "30"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        said: list[str] = []
        while "now cover" not in "".join(said[-1:]):
            said.append(process.stderr.readline())
            assert said[-1], "".join(said)
        robot.rooms["rear"].radius_m = 0.16
        out, _ = process.communicate(timeout=GIVE_UP_S)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
    assert out.split() == ["rear", "on", f"{tmp_path}/rear"]
    assert any("heard: front, rear" in line for line in said)
    wait_for("darkness", lambda: not robot.front.laser_is_on and not robot.rear.is_scanning)
