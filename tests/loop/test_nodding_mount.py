"""A laser on a nodding mount from its wires to a client: clouds on `cloud/mast`, planes in `map/planes`, the ground."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from service.cdr import decode_cloud, decode_grid
from tests.clients import connected, document
from tests.waiting import GIVE_UP_S, free_port, wait_for

ROOT = Path(__file__).resolve().parents[2]
BASE = "robots/nodding"


def floor_of(told: Any) -> list[Any]:
    """Level planes at the height of the wheels."""
    planes = [] if told is None else told["planes"]
    return [each for each in planes if abs(each["normal"][2]) > 0.99 and abs(each["centre_m"][2]) < 0.03]


def is_flat(ground: Any) -> bool:
    """Ranges have 3 cm of noise, and most of the ground is seen at a low angle; sweeps that a starved machine times
    wrongly are worse, and pass."""
    level = [h for row in zip(ground["height_m"], ground["ground"]) for h, kind in zip(*row) if kind == 0]
    return bool(level) and abs(float(np.median(level))) < 0.05


def test_a_nodding_laser_shows_floor_and_walls(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    overlay = tmp_path / "umfeld.d"
    overlay.mkdir()
    (overlay / "test.toml").write_text(
        f'[network]\nlisten = ["{endpoint}"]\n[store]\nenabled = false\n'
        "[clearance]\nenabled = true\n[elevation]\nsector_hidden_m = 1.5\n"
    )
    processes: list[subprocess.Popen[bytes]] = []

    def start(*arguments: str) -> None:
        with (tmp_path / f"{arguments[0]}.log").open("ab") as log:
            processes.append(subprocess.Popen([sys.executable, "-m", *arguments], cwd=ROOT, stdout=log, stderr=log))

    try:
        start("sim_devices", "--preset", "nodding", "--dir", str(tmp_path))
        wait_for("the devices", lambda: (tmp_path / "umfeld.toml").exists() and (tmp_path / "laser-tilt").exists())
        start("service", "run", "--config", str(tmp_path / "umfeld.toml"))

        with connected(endpoint, BASE) as client:

            def upright_of(told: Any) -> list[Any]:
                return [plane for plane in told["planes"] if abs(plane["normal"][2]) < 0.03]

            def floor_and_walls() -> Any:
                told = document(client, f"{BASE}/map/planes")
                return told if floor_of(told) and len(upright_of(told)) >= 2 else None

            flat = wait_for("planes: the floor, and two walls that stand upright", floor_and_walls)

            def whole_cloud() -> Any:
                found = client.get(f"{BASE}/cloud/mast")
                told = decode_cloud(found[0].payload) if found else None
                return told if told and len(told.points_m) > 20_000 else None

            cloud = wait_for("a cloud of a whole sweep", whole_cloud)

            def elevation() -> Any:
                told = document(client, f"{BASE}/map/elevation")
                return told if told and told["cells"]["traversable"] > 100 and is_flat(told) else None

            ground = wait_for("a hundred cells of ground, at the height of the wheels", elevation)
            heard = client.subscribe(f"{BASE}/sectors/polar/laser", ring=1)

            def sectors() -> Any:
                sample = heard.try_recv()
                found = [] if sample is None else json.loads(bytes(sample.payload))["sectors"]
                return found if any(each["traversable_m"] > 0.0 for each in found) else None

            told = wait_for("sectors that know the ground", sectors)

            def clearance() -> bool:
                found = client.get(f"{BASE}/map/clearance")
                return bool(found) and {-1, 100} < set(np.unique(decode_grid(found[0].payload).cells).tolist())

            wait_for("clearance: known somewhere, not everywhere", clearance)

            def sources() -> set[str]:
                health = document(client, f"{BASE}/health/json")
                return {each["name"] for each in health["sources"]} if health else set()

            wait_for("health of lasers and mount", lambda: sources() >= {"front", "tilt", "mast"})
        assert flat["schema"] == "umfeld.planes.v1"
        assert {plane["mount"] for plane in flat["planes"]} == {"mast"}
        assert ground["schema"] == "umfeld.elevation.v1"
        assert all(each["slope_rad"] is not None for each in told if each["traversable"])
        assert cloud.frame == "base_link"
        assert 0.02 < np.mean(np.abs(cloud.points_m[:, 2]) < 0.05) < 0.95
    finally:
        for process in processes[::-1]:
            process.send_signal(signal.SIGTERM)
        for process in processes:
            process.wait(GIVE_UP_S)
