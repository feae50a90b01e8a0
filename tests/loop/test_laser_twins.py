"""Every laser driver on its emulated twin, over a real pty or socket: they must all see the same room alike.

Twin and driver share no code, and the drivers differ in direction of turning, zero and units; so a mirrored, turned or
scaled scan shows against the others'. A Hokuyo is the yardstick: its own loop tests hold it to the world.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.readings import DeviceEvent, LinkState, Reading, ScanReading
from service.assemble_wires import wires
from service.config import load
from tests.waiting import GIVE_UP_S, wait_for

TWINS = ["lms200", "rplidar-a1", "rplidar-a2", "ld06", "tim571"]
READINGS = 4
WORLD = "office"  # seen from its start, left and right differ


@contextmanager
def standing_robot(model: str, folder: Path) -> Iterator[Path]:
    """The emulated robot with this laser, standing; yields its configuration."""
    command = [
        sys.executable,
        "-m",
        "sim_devices",
        "--laser",
        model,
        "--dir",
        str(folder),
        "--start-after",
        "1000",
        "--world",
        WORLD,
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=Path(__file__).parents[2]
    )
    try:
        config = folder / "umfeld.toml"
        wait_for("the configuration", lambda: config.exists() or process.poll() is not None)
        assert process.poll() is None, f"the simulation ended with {process.returncode}"
        yield config
    finally:
        process.terminate()
        process.wait(GIVE_UP_S)


def scans(model: str, folder: Path) -> list[ScanReading]:
    """The first scans of a laser, through its driver and its port."""
    found: list[ScanReading] = []
    troubles: list[str] = []

    def sink(source: str, item: Reading | DeviceEvent) -> None:
        if source == "front" and isinstance(item, ScanReading):
            found.append(item)
        elif source == "front" and isinstance(item, DeviceEvent) and item.state is not LinkState.RUNNING:
            troubles.append(item.text)

    with standing_robot(model, folder) as path:
        (wire,) = [each for each in wires(load(path, environment={}).config) if "front" in each.conversations]
        reader = wire.reader(sink, time.monotonic_ns)
        reader.start()
        try:
            wait_for("scans", lambda: len(found) >= READINGS)
        finally:
            assert reader.stop(GIVE_UP_S), troubles
    return found


def profile(found: list[ScanReading], bearing_rad: np.ndarray) -> np.ndarray:
    """Median range over the scans, at these bearings."""
    rows = []
    for scan in found:
        wrapped = (scan.bearing_rad + np.pi) % (2.0 * np.pi) - np.pi
        order = np.argsort(wrapped)
        bearing, distance = wrapped[order], scan.range_m[order]
        nearest = np.clip(np.searchsorted(bearing, bearing_rad), 1, len(bearing) - 1)
        nearest -= bearing_rad - bearing[nearest - 1] < bearing[nearest] - bearing_rad
        rows.append(distance[nearest])
    return np.asarray(np.median(np.array(rows), axis=0))


@pytest.fixture(scope="module")
def yardstick(tmp_path_factory: pytest.TempPathFactory) -> list[ScanReading]:
    return scans("utm-30lx", tmp_path_factory.mktemp("yardstick"))


@pytest.mark.slow
@pytest.mark.parametrize("model", TWINS)
def test_sees_the_room_as_the_others_do(model: str, tmp_path: Path, yardstick: list[ScanReading]) -> None:
    found = scans(model, tmp_path)
    bearing = np.radians(np.arange(-85.0, 86.0, 2.0))
    expected, seen = profile(yardstick, bearing), profile(found, bearing)
    both = np.isfinite(expected) & np.isfinite(seen) & (expected < found[0].range_max_m - 0.5)
    assert both.sum() > 40
    difference = np.abs(seen - expected)[both]
    # A beam beside an edge may end on either side of it, so a few differ; mirrored or turned, most would.
    assert np.median(difference) < 0.04
    assert np.mean(difference < 0.15) > 0.85
    mirrored = profile(found, -bearing)
    told_apart = np.isfinite(mirrored) & both
    assert np.median(np.abs(mirrored - expected)[told_apart]) > 0.1, "this room does not show a mirrored scan"
    stamps = np.array([scan.stamp_ns for scan in found])
    assert np.all(np.diff(stamps) > 0)
    assert np.abs(np.diff(stamps) / found[0].scan_period_ns - 1).min() < 0.5
