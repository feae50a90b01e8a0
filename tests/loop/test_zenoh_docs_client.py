"""The client printed in docs/keys.md, run as it stands in a process of its own, against the publisher."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.sectors.snapshot import PolarSnapshot
from service.clock import SystemClock
from service.outputs import GridOut, GridUpdateOut, PolarOut
from service.publisher import Publisher
from service.zenoh_session import NetworkSettings
from tests.waiting import GIVE_UP_S, free_port

PAGE = Path(__file__).parents[2] / "docs" / "keys.md"


def printed_client() -> str:
    blocks: list[str] = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    return max(blocks, key=len)


def played(command: list[str], folder: Path, offer: Callable[[], None]) -> str:
    """What a client prints that hears offers all the time."""
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        while process.poll() is None:
            offer()
            time.sleep(0.05)
        out, err = process.communicate()
    finally:
        process.kill()
    assert process.returncode == 0, err
    return out


def test_the_client_in_the_docs_draws_sectors_and_grid(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    script = tmp_path / "client.py"
    script.write_text(printed_client())
    publisher = Publisher("robots/r1", NetworkSettings(listen=(endpoint,)), clock=SystemClock())
    publisher.start()
    cells = np.full((3, 4), -1, np.int8)
    cells[0] = (0, 100, 40, 100)
    publisher.offer(GridOut(1, 5, GridPatch(0.1, -2, 3, cells)))
    snapshot = PolarSnapshot(
        1,
        Pose2(),
        np.linspace(-1, 1, 4),
        np.array([0, 1, 0], np.int8),
        np.array([2.5, 1.0, 1.25]),
        np.array([-0.5, np.nan, 0.5]),
        np.array([2.0, 0.5, 0.75]),
        np.zeros(3, np.int64),
        np.zeros(3, np.int16),
        ("front",),
    )

    def offer() -> None:
        publisher.offer(PolarOut("laser", snapshot))
        publisher.offer(GridUpdateOut(1, 5, GridPatch(0.1, 0, 5, np.full((1, 2), 100, np.int8))))
        publisher.offer(GridUpdateOut(1, 4, GridPatch(0.1, 0, 5, np.full((1, 2), 7, np.int8))))

    try:
        for seconds in ("4", str(GIVE_UP_S)):  # on a computer that lets it wait for seconds it is given minutes
            out = played([sys.executable, str(script), endpoint, seconds], tmp_path, offer)
            if "sectors" in out and "epoch 5" in out:
                break
    finally:
        assert publisher.close(GIVE_UP_S)
    assert "robots/r1/sectors/polar/laser 1.25 m" in out
    assert "grid 4 x 3 of 0.100 m at 0.30, -0.20, epoch 5" in out
    picture = (tmp_path / "grid.pgm").read_bytes()
    assert picture == b"P5 4 3 255\n" + bytes([205, 205, 0, 0, 205, 205, 205, 205, 254, 0, 205, 0])
