"""Emulated robot, daemon and a stranger's client as three processes: what the first minute with this program is.

The client is written from docs/keys.md: it imports eclipse-zenoh and the standard library, and says so.
"""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
from numpy.typing import NDArray

from sim_devices.floor_plan import load_floor_plan
from sim_devices.world import World
from tests.waiting import GIVE_UP_S, START_S, free_port, wait_for

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = ROOT / "docs" / "schemas"

CLIENT = """
import json, struct, sys, time
import zenoh

endpoint, seconds, wanted = sys.argv[1], float(sys.argv[2]), set(sys.argv[3:])
config = zenoh.Config()
for key, value in (("mode", "client"), ("scouting/multicast/enabled", False), ("connect/endpoints", [endpoint])):
    config.insert_json5(key, json.dumps(value))


def corner_and_cells(payload):
    at = 4 + 8  # header stamp
    (length,) = struct.unpack_from("<I", payload, at)
    at += 4 + length
    at += -(at - 4) % 4 + 8  # map_load_time
    resolution, width, height = struct.unpack_from("<fII", payload, at)
    at += 12
    at += -(at - 4) % 8
    x, y, _, qx, qy, qz, qw = struct.unpack_from("<7d", payload, at)
    at += 56
    (count,) = struct.unpack_from("<I", payload, at)
    assert count == width * height
    return {"resolution": resolution, "width": width, "height": height, "x": x, "y": y,
            "cells": list(struct.unpack_from(f"<{count}b", payload, at + 4))}


deadline = time.monotonic() + seconds
found = {"sectors": {}, "grid": None}
session = None
while session is None:
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        assert time.monotonic() < deadline, "nobody listens"
        time.sleep(0.1)
with session:
    samples = session.declare_subscriber("robots/artos/sectors/polar/*", zenoh.handlers.RingChannel(64))
    while time.monotonic() < deadline:
        sample = samples.try_recv()
        if sample is not None:
            document = json.loads(bytes(sample.payload))
            if any(sector["state"] in ("obstacle", "free") for sector in document["sectors"]):
                found["sectors"][str(sample.key_expr).rpartition("/")[2]] = document
            continue
        for reply in session.get("robots/artos/map/grid", timeout=20.0):
            if reply.ok is not None:
                found["grid"] = corner_and_cells(bytes(reply.ok.payload))
        if found["grid"] and found["grid"]["cells"].count(100) >= 200 and wanted <= set(found["sectors"]):
            break
        time.sleep(0.3)
found["foreign"] = sorted({"mapping", "service", "drivers", "sim_devices", "numpy"} & set(sys.modules))
print(json.dumps(found))
"""


@contextmanager
def process(log: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("ab") as output:
        started = subprocess.Popen(
            [sys.executable, "-m", *arguments], cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=output
        )
    try:
        yield started
    finally:
        if started.poll() is None:
            started.kill()
        started.wait()


def ask(folder: Path, endpoint: str, seconds: float, *wanted: str) -> dict[str, Any]:
    """Run the client until it has what it wants, or the time is up."""
    script = folder / "client.py"
    script.write_text(CLIENT)
    done = subprocess.run(
        [sys.executable, str(script), endpoint, str(seconds), *wanted],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=seconds + GIVE_UP_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["foreign"] == []
    return found


def cells_of(grid: dict[str, Any]) -> NDArray[np.int8]:
    return np.array(grid["cells"], np.int8).reshape(grid["height"], grid["width"])


def distance_to_walls_m(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) from each point to the nearest surface of the flat, at the height of the laser."""
    segments = World.from_plan(load_floor_plan("flat")).segments.at_height(0.25)
    a, b = segments.a, segments.b
    along = b - a
    share = ((points[:, None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
    nearest = a + np.clip(share, 0.0, 1.0)[..., None] * along
    distance: NDArray[np.float64] = np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)
    return distance


def test_a_stranger_draws_three_sector_maps_and_a_grid_that_survives_a_restart(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    folder, truth = tmp_path / "robot", tmp_path / "truth.jsonl"
    settings = ["--set", f'network.listen=["{endpoint}"]', "--set", f"store.path={tmp_path}/m.umfeld"]
    config = tmp_path / "umfeld.toml"
    run = ("service", "run", "--config", str(config), *settings)
    log = tmp_path / "run.log"
    with ExitStack() as stack:
        sim = stack.enter_context(
            process(
                tmp_path / "sim.log", "sim_devices", "--preset", "artos", "--dir", str(folder), "--truth", str(truth)
            )
        )
        wait_for("the printed configuration", (folder / "umfeld.toml").exists)
        config.write_text((folder / "umfeld.toml").read_text())  # the robot takes its own away when it ends
        daemon = stack.enter_context(process(log, *run))
        names = ("laser", "sonar_left", "sonar_right")
        found = ask(tmp_path, endpoint, START_S, *names)
        assert daemon.poll() is None, log.read_text()
        assert sim.poll() is None

        schema = json.loads((SCHEMAS / "sectors.v1.json").read_text())
        assert sorted(found["sectors"]) == sorted(names)
        for document in found["sectors"].values():
            jsonschema.validate(document, schema)
        check_against_the_flat(found["grid"], truth)

        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(GIVE_UP_S) == 0, log.read_text()  # 0: every part of it ended within its own limit
        sim.terminate()
        assert sim.wait(GIVE_UP_S) == 0
    assert "Traceback" not in log.read_text()

    with process(log, *run):  # no devices any more: what it knows it knows from its store
        again = ask(tmp_path, endpoint, GIVE_UP_S)
    before, after = found["grid"], again["grid"]
    assert after is not None, log.read_text()
    kept = cells_of(after)
    row = round((before["y"] - after["y"]) / before["resolution"])
    column = round((before["x"] - after["x"]) / before["resolution"])
    assert row >= 0
    assert column >= 0
    kept = kept[row : row + before["height"], column : column + before["width"]]
    was = cells_of(before)
    assert (kept[was >= 65] >= 50).mean() >= 0.8  # it went on mapping between our look and its end
    assert (kept[(was >= 0) & (was < 35)] < 50).mean() >= 0.95
    assert (kept[was >= 0] >= 0).all()


def check_against_the_flat(grid: dict[str, Any], truth: Path) -> None:
    """Occupied cells are walls or furniture of the flat; the map frame lies where the robot began."""
    first = json.loads(truth.read_text().splitlines()[0])
    cells = cells_of(grid)
    rows, columns = np.nonzero(cells >= 65)
    assert len(rows) >= 100
    x = grid["x"] + (columns + 0.5) * grid["resolution"]
    y = grid["y"] + (rows + 0.5) * grid["resolution"]
    c, s = math.cos(first["yaw"]), math.sin(first["yaw"])
    points = np.stack((first["x"] + c * x - s * y, first["y"] + s * x + c * y), axis=-1)
    off = distance_to_walls_m(points)
    assert (off < 0.15).mean() >= 0.9, np.percentile(off, [50, 90, 99])
    assert ((cells >= 0) & (cells < 35)).sum() > 1000
