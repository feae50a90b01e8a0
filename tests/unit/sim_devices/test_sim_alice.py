"""The simulated ALICE: light and touch in closed form, its drive, its bytes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_devices.alice import BAUD, BEAM_RAD, RADIUS_M, WHISKER_M, Alice, Daylight, Lamp, LampRoom, lamp_room

SECOND_NS = 1_000_000_000
WALL = np.array([(2.0, -1.0, 2.0, 1.0)])


def test_light_falls_with_distance_and_angle_and_behind_walls() -> None:
    room = LampRoom(WALL, (Lamp(1.0, 0.0, 0.8), Lamp(3.0, 0.0, 1.0)), ambient=0.1)
    light = room.lights(0.0, 0.0, np.array([0.0, BEAM_RAD, math.pi]))
    assert light == pytest.approx([0.1 + 0.64, 0.1 + 0.64 / math.e, 0.1])  # the second lamp is behind the wall
    sky = LampRoom(WALL, (), (Daylight(1.0, 0.5, 0.4),), ambient=0.0)
    assert sky.lights(5.0, 5.0, np.array([1.0, 1.4])) == pytest.approx([0.5, 0.5 / math.e])


def test_whiskers_touch_what_is_near() -> None:
    room = LampRoom(WALL, ())
    bearing = np.radians([0.0, 30.0, 60.0])
    assert room.reaches(1.5, 0.0, bearing, 0.5).tolist() == [True, False, False]
    assert room.reaches(1.5, 0.0, bearing, 0.6).tolist() == [True, True, False]


def test_it_stays_inside_and_off_the_walls() -> None:
    alice = Alice(seed=3)
    walls = alice.room.walls
    for second in range(300):
        alice.step(second * SECOND_NS, b"")
        a, e = walls[:, :2], walls[:, 2:] - walls[:, :2]
        share = np.clip(np.sum(([alice.x_m, alice.y_m] - a) * e, axis=1) / np.sum(e * e, axis=1), 0.0, 1.0)
        gap = np.hypot(*([alice.x_m, alice.y_m] - a - share[:, None] * e).T).min()
        assert gap > RADIUS_M - WHISKER_M / 2
        assert 0.0 < alice.x_m < 6.0
        assert 0.0 < alice.y_m < 4.5


def test_body_is_dragged_along_by_the_way() -> None:
    alice = Alice(drift_rad_per_m=0.02, speed_m_s=0.2, seed=1)
    alice.step(0, b"")
    alice.step(60 * SECOND_NS, b"")
    assert 0.02 * 12.0 * 0.8 < alice.yaw_rad <= 0.02 * 12.0


def test_frames_come_at_their_pace_and_alike_for_a_seed() -> None:
    sent = []
    for _ in range(2):
        alice = Alice(looks_hz=4.0, seed=5)
        data = b"".join(alice.step(k * SECOND_NS // 10, b"") for k in range(101))
        sent.append(data)
        assert alice.looks == 40
    assert sent[0] == sent[1]
    assert len(sent[0]) in (39 * 45, 40 * 45 - 45, 40 * 45)
    assert sent[0].startswith(b"\xa5\x4c\x28\x00")


def test_wrong_speed_garbles() -> None:
    alice = Alice()
    alice.step(0, b"")
    data = alice.step(SECOND_NS, b"", 9600)
    assert data
    assert b"\xa5\x4c" not in data
    assert alice.step(2 * SECOND_NS, b"", BAUD).startswith(b"\xa5\x4c")


def test_false_looks_are_as_many_as_asked_for() -> None:
    alice = Alice(false_looks=0.05, looks_hz=20.0)
    alice.step(0, b"")
    alice.step(100 * SECOND_NS, b"")
    assert 60 <= len(alice.false_sequences) <= 140
    assert lamp_room().lamps == alice.room.lamps
