"""Lasers that sit otherwise than upright and looking ahead: emulator, driver and daemon mean the same by the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.loop.test_two_processes import ask, check_against_the_flat, process
from tests.waiting import START_S, free_port, wait_for

ROBOT = """
[robot]
id = "artos"
[drive]
source = "claw"
wheel_radius_left_m = 0.076
wheel_radius_right_m = 0.076
track_width_m = 0.38
ticks_per_turn_left = 3415.92
ticks_per_turn_right = -3415.92
[wheels.claw]
driver = "roboclaw"
port = "/dev/ttyACM4"
address = 0x82
left_motor = 2
rate_hz = 40
[lasers.lidar]
driver = "{driver}"
port = "/dev/ttyUSB5"
mount = {{ x_m = 0.12, y_m = -0.04, z_m = 0.25, {turned} }}
"""


@pytest.mark.parametrize(
    ("driver", "turned"),
    [("ldrobot", "yaw_deg = 90, upside_down = true"), ("rplidar", "yaw_deg = 180")],
    ids=["head down", "backwards"],
)
def test_the_map_is_the_flat_however_the_laser_sits(tmp_path: Path, driver: str, turned: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    folder, truth, mine = tmp_path / "robot", tmp_path / "truth.jsonl", tmp_path / "mine.toml"
    mine.write_text(ROBOT.format(driver=driver, turned=turned))
    sim = ("sim_devices", "--config", str(mine), "--dir", str(folder), "--truth", str(truth))
    config = folder / "umfeld.toml"
    run = ("service", "run", "--config", str(config), "--set", f'network.listen=["{endpoint}"]')
    with process(tmp_path / "sim.log", *sim):
        wait_for("the printed configuration", config.exists)
        with process(tmp_path / "run.log", *run):
            found = ask(tmp_path, endpoint, START_S)
    check_against_the_flat(found["grid"], truth)
