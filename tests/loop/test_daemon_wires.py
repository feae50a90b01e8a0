"""The whole daemon as a process, its devices as another, a plain client as the third: what a robot's owner meets."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from service.store import MapStore, occupancy_patch
from service.zenoh_session import Client

ROOT = Path(__file__).resolve().parents[2]
ROBOT = "robots/artos"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Robot:
    """Emulated devices and a daemon in one folder."""

    folder: Path
    endpoint: str
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def config(self) -> Path:
        return self.folder / "umfeld.toml"

    def start(self, *arguments: str, log: str) -> subprocess.Popen[bytes]:
        with (self.folder / log).open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", *arguments], cwd=ROOT, stdout=output, stderr=output, stdin=subprocess.DEVNULL
            )
        self.processes.append(process)
        return process

    def start_devices(self) -> subprocess.Popen[bytes]:
        process = self.start("sim_devices", "--preset", "artos", "--dir", str(self.folder), log="sim.log")
        wait_for("the devices' configuration", lambda: self.config.exists() and (self.folder / "laser-front").exists())
        return process

    def start_daemon(self) -> subprocess.Popen[bytes]:
        return self.start("service", "run", "--config", str(self.config), log="run.log")

    def stop(self, process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> int:
        process.send_signal(number)
        self.processes.remove(process)
        return process.wait(15)

    def log(self) -> str:
        return (self.folder / "run.log").read_text()


def wait_for(what: str, ready: Callable[[], Any], seconds: float = 30.0) -> Any:
    deadline = time.monotonic() + seconds
    while not (result := ready()):
        assert time.monotonic() < deadline, f"{what} did not come within {seconds} s"
        time.sleep(0.02)
    return result


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    robot = Robot(tmp_path, f"tcp/127.0.0.1:{free_port()}")
    overlay = tmp_path / "umfeld.d"
    overlay.mkdir()
    (overlay / "test.toml").write_text(
        f'[network]\nlisten = ["{robot.endpoint}"]\n[store]\npath = "{tmp_path}/m.umfeld"\nsnapshot_period_s = 0.5\n'
    )
    try:
        yield robot
    finally:
        for process in robot.processes:
            process.kill()
            process.wait()


def connect(robot: Robot) -> Client:
    def attempt() -> Client | None:
        try:
            client = Client(robot.endpoint)
        except Exception:
            return None
        if client.bases() == [ROBOT]:
            return client
        client.close()
        return None

    client: Client = wait_for("the daemon", attempt)
    return client


def value(client: Client, key: str) -> Any:
    found = client.get(f"{ROBOT}/{key}")
    return json.loads(found[0].payload) if found else None


def states(client: Client, name: str) -> set[str]:
    document = value(client, f"sectors/polar/{name}")
    return {each["state"] for each in document["sectors"]} if document else set()


def device(client: Client, name: str) -> Any:
    health = value(client, "health/json")
    return next((each for each in health["sources"] if each["name"] == name), None) if health else None


def test_a_robot_maps_loses_its_devices_gets_them_back_and_keeps_its_map(robot: Robot) -> None:
    sim = robot.start_devices()
    daemon = robot.start_daemon()
    with connect(robot) as client:
        wait_for("sight", lambda: "obstacle" in states(client, "laser"))
        wait_for("sonars", lambda: states(client, "sonar_left") - {"unknown", "stale"})
        wait_for("a grid", lambda: client.get(f"{ROBOT}/map/grid"))
        wait_for("health", lambda: (value(client, "health/json") or {}).get("level") == "ok")
        assert {each["name"] for each in value(client, "health/json")["sources"]} == {"front", "left", "right", "drive"}

        # The cables are pulled: every sector that was fed is stale within half a second, none is freer than before.
        robot.stop(sim, signal.SIGKILL)
        pulled = time.monotonic()
        wait_for("staleness", lambda: states(client, "laser") <= {"stale", "unknown"}, 5.0)
        wait_for("staleness", lambda: states(client, "sonar_left") <= {"stale", "unknown"}, 5.0)
        assert time.monotonic() - pulled < 1.5  # half a second, and what asking takes on a busy machine
        lost = wait_for("the report", lambda: each if (each := device(client, "front"))["level"] != "ok" else None)
        assert lost["state"] in ("absent", "silent")
        assert "/laser-front" in lost["text"] or "cable" in lost["text"]

        # They are plugged in again: all by itself it goes on.
        robot.start_devices()
        wait_for("recovery", lambda: states(client, "laser") & {"obstacle", "free"})
        wait_for("recovery", lambda: (device(client, "front") or {}).get("state") == "running")

        saved = client.call(ROBOT, "save_map", {"name": "kitchen"})
        assert Path(saved["path"]).stat().st_size == saved["bytes"]

    assert robot.stop(daemon) == 0, robot.log()
    assert "Traceback" not in robot.log()
    with MapStore.open(robot.folder / "m.umfeld", wall_ns=lambda: 0, read_only=True) as store:
        kept = occupancy_patch(store)
        assert (kept.cells >= 65).sum() > 100

    # A new start has the old map from its first grid on.
    daemon = robot.start_daemon()
    with connect(robot) as client:
        document = wait_for(
            "the restored grid", lambda: [each.payload for each in client.get(f"{ROBOT}/map/grid?format=json")]
        )
        assert document
        info = client.call(ROBOT, "map_info")
        assert info["occupied_cells"] >= (kept.cells >= 65).sum() * 0.9
    assert robot.stop(daemon, signal.SIGINT) == 0


def test_without_devices_it_waits_and_says_so_and_a_second_daemon_is_refused(robot: Robot) -> None:
    robot.config.write_text(
        f'[robot]\nid = "artos"\n[lasers.front]\ndriver = "hokuyo"\nport = "{robot.folder}/laser-front"\n'
    )
    daemon = robot.start_daemon()
    with connect(robot) as client:
        absent = wait_for("a report", lambda: device(client, "front"))
        assert absent["state"] == "absent"
        assert "plugged in" in absent["text"]
    for changed, names in (
        ([], "laser-front is in use by another umfeld daemon"),
        (["--set", "lasers.front.port=/dev/none"], "writes this map"),
        (["--set", "lasers.front.port=/dev/none", "--set", f"store.path={robot.folder}/x.umfeld"], "is in use"),
    ):
        second = subprocess.run(
            [sys.executable, "-m", "service", "run", "--config", str(robot.config), *changed],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert second.returncode == 1
        told = [line for line in second.stderr.splitlines() if "compiling the kernels" not in line]
        assert len(told) == 1, second.stderr
        assert names in second.stderr
    assert robot.stop(daemon) == 0, robot.log()


def test_a_daemon_told_to_stop_while_it_starts_stops(robot: Robot) -> None:
    robot.config.write_text('[robot]\nid = "artos"\n')
    daemon = robot.start_daemon()
    time.sleep(0.8)  # somewhere in its imports or its start; either way it must end, and without a traceback
    code = robot.stop(daemon)
    assert code in (0, -signal.SIGTERM)
    assert "Traceback" not in robot.log()
