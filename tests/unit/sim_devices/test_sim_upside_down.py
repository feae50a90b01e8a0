"""A laser that is mounted head down: its left is the robot's right, wherever it looks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_devices.device import Mount
from sim_devices.floor_plan import FloorPlan, Wall
from sim_devices.mount_nodding import Swing, TiltedScene
from sim_devices.robot import CommandedMotion, SimScene
from sim_devices.world import World

ROOM = FloorPlan(walls=(Wall(((-5.0, -2.0), (4.0, -2.0), (4.0, 1.0), (-5.0, 1.0), (-5.0, -2.0)), thickness_m=0.0),))
LEFT_M, RIGHT_M, AHEAD_M, BEHIND_M = 1.0, 2.0, 4.0, 5.0
OWN = np.radians([0.0, 90.0, 180.0, -90.0])  # ahead, left, behind, right of the laser


@pytest.mark.parametrize(
    ("mount", "seen"),
    [
        (Mount(), [AHEAD_M, LEFT_M, BEHIND_M, RIGHT_M]),
        (Mount(upside_down=True), [AHEAD_M, RIGHT_M, BEHIND_M, LEFT_M]),
        (Mount(yaw_rad=math.pi / 2), [LEFT_M, BEHIND_M, RIGHT_M, AHEAD_M]),
        (Mount(yaw_rad=math.pi / 2, upside_down=True), [LEFT_M, AHEAD_M, RIGHT_M, BEHIND_M]),
    ],
)
def test_what_it_sees(mount: Mount, seen: list[float]) -> None:
    scene = SimScene(World.from_plan(ROOM), CommandedMotion((0.0, 0.0, 0.0)))
    stamps = np.zeros(4)
    assert scene.beam_ranges(mount, OWN, stamps, 30.0) == pytest.approx(seen)
    level = TiltedScene(scene, Swing(period_s=2.0, swing_rad=0.0))
    assert level.beam_ranges(mount, OWN, stamps, 30.0) == pytest.approx(seen)
