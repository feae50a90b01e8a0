"""Presets against the daemon's own configuration, and TOML against the standard library's reader."""

from __future__ import annotations

import math
import socket
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.config import load
from sim_devices.attach import Attachment, TcpLink
from sim_devices.device import Mount
from sim_devices.faults import FaultPlan
from sim_devices.floor_plan import FloorPlan, load_floor_plan
from sim_devices.lasers import MODELS
from sim_devices.presets import PRESETS, PresetError, emulate, for_log, preset, to_toml
from sim_devices.robot import SimScene, Trajectory, follow
from sim_devices.world import World
from tests.waiting import GIVE_UP_S

names = st.text("abcdefgh_", min_size=1, max_size=6)
scalars = st.one_of(
    st.booleans(),
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=12),
    st.lists(st.integers(-5, 5), max_size=3),
    st.lists(st.lists(st.floats(-5, 5), min_size=2, max_size=2), max_size=3),
)
tables = st.dictionaries(names, st.one_of(scalars, st.dictionaries(names, scalars, min_size=1, max_size=3)), min_size=1)


@given(st.dictionaries(names, tables, max_size=3))
def test_toml_reads_back(config: dict[str, Any]) -> None:
    assert tomllib.loads(to_toml(config)) == config


def test_toml_of_small_tables_and_lists_of_tables() -> None:
    config: dict[str, Any] = {
        "lasers": {"a": {"mount": {"x_m": 0.5, "yaw_deg": -0.0}, "port": 'with "quotes" \\ and \x07'}}
    }
    config["sonars"] = {"s": {"base_id": 0x400, "transducers": [{"channel": 1}, {"channel": 2}]}}
    text = to_toml(config)
    assert tomllib.loads(text) == config
    assert "mount = {" in text
    assert "base_id = 0x400" in text


def motionless() -> SimScene:
    return SimScene(World.from_plan(FloorPlan()), Trajectory((0.0, 0.0, 0.0), []))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_the_daemon_accepts_what_a_preset_prints(name: str, tmp_path: Path) -> None:
    attachment = Attachment(clock=lambda: 0)
    try:
        robot = emulate(preset(name), motionless(), attachment, tmp_path)
        path = tmp_path / "umfeld.toml"
        path.write_text(to_toml(robot.config))
        loaded = load(path).config
        for laser in loaded.lasers.values():
            assert Path(laser.port).is_symlink()
        for bus in loaded.can.values():
            assert bus.interface == "slcan"
            assert Path(bus.channel).is_symlink()
        for ring in loaded.rings.values():
            assert Path(ring.port).is_symlink()
        for wheels in loaded.wheels.values():
            assert wheels.serial_port() is None or Path(wheels.serial_port() or "").is_symlink()
        polar, rect, transducers = {
            "artos": (3, 1, 16),
            "nodding": (3, 1, 16),
            "two_wheeler": (1, 1, 2),
            "autopilot": (1, 1, 2),
            "alice": (0, 0, 0),
        }.get(name, (1, 1, 0))
        assert (len(loaded.sectors.polar), len(loaded.sectors.rect)) == (polar, rect)
        assert sum(len(s.transducers) for s in loaded.sonars.values()) == transducers
    finally:
        attachment.stop()


def test_transducers_sit_on_the_body_and_look_away_from_it() -> None:
    for name, side in (("left", 1.0), ("right", -1.0)):
        chain = preset("artos")["sonars"][name]["transducers"]
        assert [t["channel"] for t in chain] == list(range(1, 9))
        for t in chain:
            assert abs(t["x_m"]) <= 0.45
            assert abs(t["y_m"]) <= 0.30
            assert math.copysign(1.0, t["y_m"]) == side
            look = math.radians(t["yaw_deg"])
            assert t["x_m"] * math.cos(look) + t["y_m"] * math.sin(look) > 0.2


def test_unknown_devices_presets_and_buses_are_told(tmp_path: Path) -> None:
    with pytest.raises(PresetError, match="artos"):
        preset("artus")
    attachment = Attachment(clock=lambda: 0)
    try:
        with pytest.raises(PresetError, match=r"lasers\.a\.driver"):
            emulate({"lasers": {"a": {"driver": "other"}}}, motionless(), attachment, tmp_path)
        with pytest.raises(PresetError, match=r"no \[can\.x\]"):
            emulate({"wheels": {"w": {"driver": "cia406", "can": "x"}}}, motionless(), attachment, tmp_path)
    finally:
        attachment.stop()


def test_encoders_count_as_the_drive_says(tmp_path: Path) -> None:
    config = preset("artos")
    config["drive"] |= {"ticks_per_turn_left": 1000.5, "ticks_per_turn_right": -2000.0, "wheel_radius_right_m": 0.2}
    scene = SimScene(World.from_plan(FloorPlan()), Trajectory((0, 0, 0), [*follow_straight(3.0)]))
    attachment = Attachment(clock=lambda: 0)
    try:
        robot = emulate(config, scene, attachment, tmp_path)
        left, right = robot.encoders["drive.left"], robot.encoders["drive.right"]
        before = [e.position(0) for e in (left, right)]
        after = [e.position(10**10) for e in (left, right)]
        turns = 3.0 / (2 * math.pi * np.array([0.1, 0.2]))
        moved = [math.remainder(a - b, 2**32) for a, b in zip(after, before)]
        np.testing.assert_allclose(moved, [turns[0] * 1000.5, turns[1] * -2000.0], atol=1.01)
    finally:
        attachment.stop()


def follow_straight(metres: float) -> list[Any]:
    from sim_devices.robot import twist

    return [twist(1.0, 0.0, metres)]


def test_faults_reach_the_device_that_they_name(tmp_path: Path) -> None:
    plan = FaultPlan(["laser.front:unplug", "sonar:silence", "encoder.left:silence", "bus.main:flood", "adapter:drop"])
    attachment = Attachment(clock=lambda: 0)
    try:
        emulate(preset("artos"), motionless(), attachment, tmp_path, plan=plan)
        assert plan.complaints() == []
        attachment.service(10**9)
        assert not (tmp_path / "laser-front").exists()
        assert (tmp_path / "can-main").exists()
    finally:
        attachment.stop()


def test_a_log_leaves_laser_and_wheels_only() -> None:
    config = for_log(preset("artos"), Mount(0.2, 0.0, 0.25, 0.1), track_width_m=0.4, rate_hz=200.0, wheel_m_s=10.0)
    assert "sonars" not in config
    assert list(config["lasers"]) == ["front"]
    assert config["lasers"]["front"]["mount"]["yaw_deg"] == pytest.approx(math.degrees(0.1), abs=1e-6)
    assert config["drive"]["track_width_m"] == 0.4
    assert config["wheels"]["drive"]["rate_hz"] == 200.0
    assert list(config["sectors"]["polar"]) == ["laser"]
    assert config["sectors"]["rect"]["around"]["sources"] == ["lasers.front"]
    with pytest.raises(PresetError, match="needs a laser and wheels"):
        for_log({}, Mount(), track_width_m=0.5, rate_hz=100.0, wheel_m_s=1.0)


@pytest.mark.parametrize("world", ["flat", "hall", "loop", "office", "warehouse", "walkers"])
def test_artos_drives_every_route_without_touching_anything(world: str) -> None:
    plan = load_floor_plan(world)
    assert plan.route is not None
    trajectory = follow(plan.route)
    surfaces = World.from_plan(plan)
    half = np.array([0.45, 0.30])
    low = surfaces.segments.at_height(0.25)
    parts = np.linspace(0.0, 1.0, 60)[:, None, None]
    points = (low.a + parts * (low.b - low.a)).reshape(-1, 2)
    around = np.linspace(0, 2 * np.pi, 16)[:, None, None]
    round_things = surfaces.circles.center + surfaces.circles.radius_m[:, None] * np.concatenate(
        (np.cos(around), np.sin(around)), axis=-1
    )
    points = np.concatenate((points, round_things.reshape(-1, 2)))
    for x, y, yaw in trajectory.pose_at(np.arange(0.0, trajectory.lap_s, 0.1)):
        near = points[np.abs(points - [x, y]).max(axis=1) < 1.0] - [x, y]
        c, s = math.cos(yaw), math.sin(yaw)
        off = np.abs(near @ np.array([[c, -s], [s, c]])) - half
        assert not np.any((off < 0.02).all(axis=1)), f"touches something at {x:.2f}, {y:.2f}"


def test_the_flat_is_driven_within_a_minute_and_people_keep_away() -> None:
    plan = load_floor_plan("flat")
    assert plan.route is not None
    trajectory = follow(plan.route)
    assert trajectory.lap_s < 60.0
    times = np.arange(0.0, 10 * trajectory.lap_s, 0.1)
    for seed in range(3):
        for walker in World.from_plan(plan, seed).walkers:
            gap = np.hypot(*(walker.place(times)[0] - trajectory.pose_at(times)[:, :2]).T)
            assert gap.min() > 0.8


def test_all_rooms_of_the_flat_are_seen_on_one_lap() -> None:
    """From the laser's end points: every room of the flat holds many, on its far walls too."""
    plan = load_floor_plan("flat")
    assert plan.route is not None
    trajectory = follow(plan.route)
    scene = SimScene(World.from_plan(plan), trajectory)
    bearing = np.radians(np.linspace(-135, 135, 271))
    ends = []
    for t in np.arange(0.0, trajectory.lap_s, 0.5):
        ranges = scene.beam_ranges(Mount(0.3, 0, 0.25), bearing, np.full(271, t * 1e9), 30.0)
        x, y, yaw = scene.pose_at([t * 1e9])[0]
        hit = np.isfinite(ranges)
        ahead = np.array([x + 0.3 * math.cos(yaw), y + 0.3 * math.sin(yaw)])
        ends.append(ahead + ranges[hit, None] * np.stack((np.cos(yaw + bearing[hit]), np.sin(yaw + bearing[hit])), -1))
    points = np.concatenate(ends)
    far_walls = {  # a piece of the farthest wall of each room
        "bedroom": (1.9, 3.3, 0.0, 0.2),
        "bath": (4.0, 6.2, 0.7, 0.85),
        "study": (8.2, 9.9, 0.0, 0.2),
        "kitchen": (6.7, 9.2, 7.2, 7.4),
        "living room": (2.0, 6.0, 7.8, 8.0),
        "corridor": (9.4, 9.6, 3.7, 4.5),
    }
    for room, (x0, x1, y0, y1) in far_walls.items():
        inside = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
        assert inside.sum() > 20, room


@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_laser_model_stands_on_its_wire_and_is_told_to_the_daemon(model: str, tmp_path: Path) -> None:
    attachment = Attachment()
    try:
        robot = emulate(preset("artos"), motionless(), attachment, tmp_path, laser=model, exact=True, plan=FaultPlan())
        laser = robot.config["lasers"]["front"]
        link = robot.links["lasers.front"]
        assert laser["driver"] == MODELS[model]
        assert laser["mount"] == preset("artos")["lasers"]["front"]["mount"]
        if isinstance(link, TcpLink):
            assert laser["port"] == f"tcp://127.0.0.1:{link.port}"
        else:
            assert Path(laser["port"]).is_symlink()
        if MODELS[model] != "hokuyo":
            assert set(laser) == {"driver", "mount", "port"}
        assert attachment.service(0) is not None
    finally:
        attachment.stop()


def test_configured_driver_chooses_the_model(tmp_path: Path) -> None:
    config = preset("artos")
    config["lasers"] = {"low": {"driver": "ldrobot"}, "high": {"driver": "hokuyo", "port": "tcp://192.168.0.10:10940"}}
    attachment = Attachment()
    try:
        robot = emulate(config, motionless(), attachment, tmp_path)
        assert type(robot.lasers["low"]).__name__ == "LdLidar"
        assert robot.config["lasers"]["high"]["port"].startswith("tcp://127.0.0.1:")
    finally:
        attachment.stop()


def test_autopilots_serve_whatever_names_their_port(tmp_path: Path) -> None:
    config = preset("autopilot")
    attachment = Attachment(clock=lambda: 0)
    try:
        robot = emulate(config, motionless(), attachment, tmp_path, plan=FaultPlan())
        assert sorted(robot.autopilots) == ["autopilot.1", "autopilot.2"]
        source, sent = robot.config["wheels"]["drive"]["port"], robot.config["mavlink"]["port"]
        assert source == robot.config["sonars"]["ends"]["port"]
        assert Path(source).is_symlink()
        port = int(sent.removeprefix("udpout:127.0.0.1:"))
        assert port == getattr(robot.links["autopilot.2"], "port", None)
        assert [r.number for r in robot.autopilots["autopilot.1"].rangefinders] == [0, 1]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as daemon:
            daemon.sendto(b"hello", ("127.0.0.1", port))
            attachment.service(0)
            attachment.service(2_000_000_000)
            daemon.settimeout(GIVE_UP_S)
            assert daemon.recv(2000)[0] == 0xFD
    finally:
        attachment.stop()


def test_one_autopilot_for_all_on_one_port(tmp_path: Path) -> None:
    config = preset("autopilot")
    config["mavlink"]["port"] = config["wheels"]["drive"]["port"]
    attachment = Attachment(clock=lambda: 0)
    try:
        robot = emulate(config, motionless(), attachment, tmp_path)
        assert list(robot.autopilots) == ["autopilot"]
        assert robot.config["mavlink"]["port"] == robot.config["wheels"]["drive"]["port"]
    finally:
        attachment.stop()
