"""From configuration to wires, sensors and maps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from drivers.encoder_cia406 import Cia406PairConversation
from drivers.laser_hokuyo import HokuyoConversation
from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation
from mapping.frames import Pose2
from service import assemble, assemble_wires
from service.config import Config, load
from service.fusion import Fusion, OdometryOnly
from service.outputs import GridOut, PolarOut, RectOut
from service.sensors import Chain, Laser, Wheels
from service.warm_up import warm_up

ROBOT = """
[robot]
id = "r1"
[drive]
source = "base"
ticks_per_turn_right = -4096.0
[can.main]
interface = "slcan"
channel = "/dev/null0"
[can.second]
interface = "virtual"
channel = "here"
[lasers.front]
driver = "hokuyo"
port = "/dev/null1"
mount = { x_m = 0.3, y_m = -0.1, z_m = 0.2, yaw_deg = 90.0, upside_down = true }
[lasers.rear]
driver = "hokuyo"
port = "/dev/null2"
[sonars.front]
driver = "usboard"
can = "main"
transducers = [{ channel = 3, x_m = 0.4, yaw_deg = 45.0 }]
[sonars.side]
driver = "usboard-serial"
port = "/dev/null3"
cone_deg = 60.0
transducers = [{ channel = 1 }]
[wheels.base]
driver = "cia406"
can = "main"
[sectors.polar.all]
sources = ["front", "sonars.front", "rear"]
[sectors.rect.around]
sources = ["side"]
[local_grid]
enabled = true
[artos]
enabled = true
sources = ["all"]
[grid]
sources = ["front"]
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    file = tmp_path / "umfeld.toml"
    file.write_text(ROBOT)
    return load(file, environment={}).config


def test_every_wire_appears_once_with_everyone_on_it(config: Config) -> None:
    wires = {wire.name: wire for wire in assemble_wires.wires(config)}
    assert {name: (wire.port, sorted(wire.conversations)) for name, wire in wires.items()} == {
        "front": ("/dev/null1", ["front"]),
        "rear": ("/dev/null2", ["rear"]),
        "side": ("/dev/null3", ["side"]),
        "can-main": ("/dev/null0", ["base", "sonars-front"]),
    }
    made = {name: type(make()) for wire in wires.values() for name, make in wire.conversations.items()}
    assert made == {
        "front": HokuyoConversation,
        "rear": HokuyoConversation,
        "side": UsBoardSerialConversation,
        "sonars-front": UsBoardConversation,
        "base": Cia406PairConversation,
    }


def test_a_bus_of_the_system_has_no_port_of_its_own(config: Config) -> None:
    changed = config.model_copy(
        update={"can": {"main": config.can["main"].model_copy(update={"interface": "socketcan"})}}
    )
    assert {wire.name: wire.port for wire in assemble_wires.wires(changed)}["can-main"] is None


def test_sensors_sit_where_they_were_mounted(config: Config) -> None:
    sensors = assemble.sensors(config)
    assert list(sensors) == ["front", "rear", "sonars-front", "side", "base"]
    front, chain, wheels = sensors["front"], sensors["sonars-front"], sensors["base"]
    assert isinstance(front, Laser)
    assert front == Laser("front", Pose2(0.3, -0.1, math.pi / 2), height_m=0.2, upside_down=True)
    assert isinstance(chain, Chain)
    assert chain.transducers[0].channel == 3
    assert chain.transducers[0].base_from_transducer == Pose2(0.4, 0.0, math.pi / 4)
    assert chain.cone_rad == pytest.approx(math.radians(30))
    assert chain.period_ns == 100_000_000
    assert isinstance(wheels, Wheels)


def test_maps_are_fed_by_what_the_configuration_says(config: Config) -> None:
    sensors = assemble.sensors(config)
    maps = assemble.maps(config, sensors)
    assert [layer.sources for layer in maps.sectors] == [{"front", "sonars-front", "rear"}, {"side"}]
    assert [layer.sources for layer in maps.grids] == [{"front"}, {"front", "rear", "sonars-front", "side"}, set()]
    assert maps.building is maps.grids[0]
    parts = assemble.parts(config, sensors, maps, OdometryOnly())
    assert parts.drive is not None
    assert parts.drive[0] == "base"
    assert parts.drive[1].ticks_per_turn_right == -4096.0


def test_nothing_is_kept_that_is_switched_off(config: Config) -> None:
    off = config.model_copy(update={"grid": config.grid.model_copy(update={"enabled": False})})
    maps = assemble.maps(off, assemble.sensors(off))
    assert maps.building is None
    assert len(maps.grids) == 2


def test_the_whole_robot_draws_and_tells(config: Config) -> None:
    """Real maps behind fusion: a wall ahead is an obstacle in the sectors and occupied in the grid."""
    sensors = assemble.sensors(config)
    maps = assemble.maps(config, sensors)
    fusion = Fusion(assemble.parts(config, sensors, maps, OdometryOnly()))
    from drivers.readings import ChainReading, RangeReading, RangeStatus, ScanReading, WheelReading

    ms = 1_000_000
    bearing = np.linspace(-1.5, 1.5, 301)
    for step in range(12):
        now = (1000 + 100 * step) * ms
        fusion.on_item("base", WheelReading(now, 0, 0, True), now)
        for laser in ("front", "rear"):
            scan = ScanReading(now + 1, 0.0, 100 * ms, bearing, np.full(301, 2.0), 0.1, 10.0)
            told = fusion.on_item(laser, scan, now + 30 * ms)
        for name, channel in (("sonars-front", 3), ("side", 1)):
            fusion.on_item(name, ChainReading(now + 1, (RangeReading(channel, 1.0, RangeStatus.ECHO),)), now + 2)
        fusion.settle(now + 30 * ms)
    assert fusion.drops == {}
    polar = next(each for each in told if isinstance(each, PolarOut))
    ahead = int(np.searchsorted(polar.snapshot.edges_rad, 0.01)) - 1
    assert polar.snapshot.state[ahead] == 0
    outputs = fusion.tick(2200 * ms)
    grid = next(each for each in outputs if isinstance(each, GridOut) and each.name == "grid")
    patch = grid.patch
    row, column = int((-0.1 + 2.0) / 0.05) - patch.row0, int(0.3 / 0.05) - patch.col0  # it looks to the left
    assert patch.cells[row - 1 : row + 2, column].max() >= 90
    assert patch.cells[row - 10, column] <= 10
    assert any(isinstance(each, RectOut) for each in fusion.tick(2300 * ms))
    assert any(isinstance(each, GridOut) and each.name == "local" for each in outputs)
    artos = next(each.patch for each in outputs if isinstance(each, GridOut) and each.name == "artos")
    nearest = polar.snapshot.distance_m[ahead]
    assert artos.cells[-artos.row0, int(nearest / 0.1) - artos.col0] > 50
    assert artos.cells[-artos.row0, int(nearest / 0.2) - artos.col0] < 50


def test_warming_up_leaves_no_trace_and_reaches_every_map(config: Config) -> None:
    warm_up(config)
    warm_up(Config.model_validate({}))
