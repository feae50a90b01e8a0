"""The whole daemon as a process, its devices as another, a plain client as the third: what a robot's owner meets."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from service.store import MapStore, occupancy_patch
from service.zenoh_session import Client
from tests.clients import connected, document
from tests.waiting import GIVE_UP_S, START_S, free_port, kill_devices, wait_for

ROOT = Path(__file__).resolve().parents[2]
ROBOT = "robots/artos"
SECOND = 1_000_000_000


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
        return process.wait(GIVE_UP_S)

    def log(self) -> str:
        return (self.folder / "run.log").read_text()


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
        for process in reversed(robot.processes):  # devices last: see kill_devices
            process.kill()
            process.wait()


def value(client: Client, key: str) -> Any:
    return document(client, f"{ROBOT}/{key}")


def states(client: Client, name: str) -> set[str]:
    document = value(client, f"sectors/polar/{name}")
    return {each["state"] for each in document["sectors"]} if document else set()


def device(client: Client, name: str) -> Any:
    health = value(client, "health/json")
    return next((each for each in health["sources"] if each["name"] == name), None) if health else None


def stamp_ns(told: Any) -> int:
    """Wall time."""
    return int(told["stamp"]["sec"]) * SECOND + int(told["stamp"]["nanosec"])


def told_until(subscriber: Any, until_ns: int) -> Iterator[Any]:
    """Documents as they come, up to one with a stamp of that time."""
    newest_ns = 0
    while newest_ns < until_ns:
        told = json.loads(bytes(wait_for("a document", subscriber.try_recv).payload))
        newest_ns = stamp_ns(told)
        yield told


def test_a_robot_maps_loses_its_devices_gets_them_back_and_keeps_its_map(robot: Robot) -> None:
    sim = robot.start_devices()
    daemon = robot.start_daemon()
    with connected(robot.endpoint, ROBOT) as client:
        wait_for("sight", lambda: "obstacle" in states(client, "laser"))
        wait_for("sonars", lambda: states(client, "sonar_left") - {"unknown", "stale"})
        wait_for("a map", lambda: client.call(ROBOT, "map_info")["occupied_cells"] > 200)

        def healthy() -> Any:
            health = value(client, "health/json")
            return health if health and health["level"] == "ok" else None

        health = wait_for("health", healthy)
        assert {each["name"] for each in health["sources"]} == {"front", "left", "right", "drive"}

        # The cables are pulled: every sector that was fed is stale within half a second, by the stamps of the maps.
        names = ("laser", "sonar_left")
        heard = {name: client.subscribe(f"{ROBOT}/sectors/polar/{name}", ring=4096) for name in names}
        robot.processes.remove(sim)
        kill_devices(sim, robot.folder)
        pulled_ns = time.time_ns()
        for name in names:
            for told in told_until(heard[name], pulled_ns + 2 * SECOND):
                fresh = {each["state"] for each in told["sectors"]} - {"stale", "unknown"}
                assert not fresh or stamp_ns(told) <= pulled_ns + SECOND // 2, (name, fresh)

        def lost() -> Any:
            front = device(client, "front")
            return front if front and front["level"] != "ok" else None

        report = wait_for("the report", lost)
        assert report["state"] in ("absent", "silent")
        assert "/laser-front" in report["text"] or "cable" in report["text"]

        # They are plugged in again: all by itself it goes on.
        robot.start_devices()
        wait_for("recovery", lambda: states(client, "laser") & {"obstacle", "free"})
        wait_for("recovery", lambda: (device(client, "front") or {}).get("state") == "running")

        saved = client.call(ROBOT, "save_map", {"name": "kitchen"})
        assert Path(saved["path"]).stat().st_size == saved["bytes"]

    assert robot.stop(daemon) == 0, robot.log()
    assert "Traceback" not in robot.log(), robot.log()
    with MapStore.open(robot.folder / "m.umfeld", wall_ns=lambda: 0, read_only=True) as store:
        kept = occupancy_patch(store)
        assert (kept.cells >= 65).sum() > 100

    # A new start has the old map from its first grid on.
    daemon = robot.start_daemon()
    with connected(robot.endpoint, ROBOT) as client:
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
    with connected(robot.endpoint, ROBOT) as client:

        def is_told() -> bool:
            """The first report may have been made before the port was tried."""
            front = device(client, "front")
            return front is not None and front["state"] == "absent" and "plugged in" in front["text"]

        wait_for("word of the absent port", is_told)
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
            timeout=START_S,
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
    assert code in (0, -signal.SIGTERM, 128 + signal.SIGTERM)  # running, not yet a command, a command that begins
    assert "Traceback" not in robot.log(), robot.log()
