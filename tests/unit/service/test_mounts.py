"""Tilting lasers in the daemon without its wires: configuration, fusion, planes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.readings import AngleReading, DeviceEvent, LinkState, PoseReading, ScanReading, WheelReading
from mapping.frames import Pose2
from service import assemble, assemble_makers
from service.config import Config, load
from service.errors import WrongUsage
from service.fusion import Fusion, OdometryOnly
from service.map_makers import MapMakers
from service.outputs import CloudOut, DocumentOut, Output, PolarOut, ScanOut
from service.payloads import document_message
from service.plane_maker import PlaneMaker

F64 = NDArray[np.float64]
MS = 1_000_000
BEARING = np.radians(np.arange(-60.0, 60.1, 0.5))
TEXT = """
[can.main]
interface = "virtual"
[lasers.front]
driver = "hokuyo"
port = "/dev/a"
[lasers.tilt]
driver = "hokuyo"
port = "/dev/b"
[mounts.mast]
driver = "cia406"
can = "main"
laser = "tilt"
counts_per_turn = -3600.0
zero_deg = 5.0
mount = { z_m = 1.0 }
arm = { x_m = 0.05, z_m = 0.02 }
[sectors.polar.around]
sources = ["front"]
[drive]
laser_odometry = false
"""


def config_of(tmp_path: Path, text: str = TEXT) -> Config:
    path = tmp_path / "umfeld.toml"
    path.write_text(text)
    return load(path, environment={}).config


def fusion_of(config: Config) -> Fusion:
    found = assemble.sensors(config)
    return Fusion(assemble.parts(config, found, assemble.maps(config, found), OdometryOnly()))


def angle_at(stamp_ns: int) -> float:
    return 0.3 + 0.5 * math.sin(2.0 * math.pi * stamp_ns / 2e9)


def sweep_of_floor_and_wall(stamp_ns: int, config: Config) -> ScanReading:
    """Ranges to the floor z = 0 and the wall x = 4, each beam at its own moment."""
    mount = assemble.tilting_lasers(config)[0].settings.mount
    stamps = stamp_ns + np.arange(len(BEARING)) * 50_000
    origin, way = mount.rays(BEARING, np.array([angle_at(int(s)) for s in stamps]))
    with np.errstate(divide="ignore"):
        floor = np.where(way[:, 2] < 0.0, -origin[:, 2] / way[:, 2], np.inf)
        wall = np.where(way[:, 0] > 0.0, (4.0 - origin[:, 0]) / way[:, 0], np.inf)
    ranges = np.minimum(floor, wall)
    ranges[ranges > 20.0] = np.inf
    return ScanReading(stamp_ns, 50_000.0, 25 * MS, BEARING, ranges, 0.05, 30.0)


def nod(fusion: Fusion, config: Config, *, until_ms: int = 2600, lost_ms: range = range(0)) -> list[Output]:
    outputs: list[Output] = []
    for ms in range(0, until_ms, 5):
        now_ns = ms * MS
        if ms not in lost_ms:
            ticks = round((math.degrees(angle_at(now_ns)) - 5.0) * -10.0)
            outputs += fusion.on_item("mast", AngleReading(now_ns, ticks, ms > 0), now_ns)
        if ms % 25 == 0 and ms > 0:
            stamp_ns = now_ns - 20 * MS
            outputs += fusion.on_item("tilt", sweep_of_floor_and_wall(stamp_ns, config), now_ns)
            outputs += fusion.tick(now_ns)
    return outputs


def test_sweeps_of_a_nodding_laser_become_clouds_and_nothing_else(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    fusion = fusion_of(config)
    outputs = nod(fusion, config)
    clouds = [each for each in outputs if isinstance(each, CloudOut)]
    assert len(clouds) == 2
    for cloud in clouds:
        assert cloud.mount == "mast"
        assert cloud.map_from_base == Pose2()
        off = np.minimum(np.abs(cloud.points_m[:, 2]), np.abs(cloud.points_m[:, 0] - 4.0))
        assert off.max() < 0.02  # a count is a tenth of a degree: 4 mm at 4 m, along a flat floor more
        assert np.median(off) < 0.002
    assert not [each for each in outputs if isinstance(each, ScanOut)]
    assert all("obstacle" not in str(each.snapshot.state) for each in outputs if isinstance(each, PolarOut))
    assert fusion.drops.get("mast", {}) == {}


def test_clouds_follow_another_estimators_poses(tmp_path: Path) -> None:
    pilot = TEXT.replace("laser_odometry = false", 'pose_source = "pilot"')
    config = config_of(tmp_path, pilot + '[poses.pilot]\ndriver = "mavlink"\nport = "/dev/c"\n')
    fusion, clouds = fusion_of(config), list[CloudOut]()
    for ms in range(0, 2600, 5):
        now_ns = ms * MS
        fusion.on_item("pilot", PoseReading(now_ns, 0.1 * now_ns * 1e-9, 0.0, 0.0, True), now_ns)
        ticks = round((math.degrees(angle_at(now_ns)) - 5.0) * -10.0)
        fusion.on_item("mast", AngleReading(now_ns, ticks, ms > 0), now_ns)
        if ms % 25 == 0 and ms > 0:
            fusion.on_item("tilt", sweep_of_floor_and_wall(now_ns - 20 * MS, config), now_ns)
            clouds += [each for each in fusion.tick(now_ns) if isinstance(each, CloudOut)]
    assert len(clouds) == 2
    for cloud in clouds:
        assert cloud.map_from_base is not None
        assert cloud.map_from_base.x_m == pytest.approx(0.1 * cloud.stamp_ns * 1e-9, abs=0.01)


def test_a_delay_that_is_told_is_taken_out_and_all_is_the_same_again(tmp_path: Path) -> None:
    """Angles that come 20 ms late, told so: the same clouds, bit for bit."""
    late = config_of(tmp_path, TEXT.replace("zero_deg = 5.0", "zero_deg = 5.0\ndelay_ms = 20.0"))
    config = config_of(tmp_path)
    clouds = []
    for chosen, delay_ns in ((config, 0), (config, 0), (late, 20 * MS)):
        fusion = fusion_of(chosen)
        found: list[CloudOut] = []
        for ms in range(0, 2600, 5):
            measured_ns = ms * MS
            ticks = round((math.degrees(angle_at(measured_ns)) - 5.0) * -10.0)
            fusion.on_item("mast", AngleReading(measured_ns + delay_ns, ticks, ms > 0), measured_ns + delay_ns)
            if ms % 25 == 0 and ms > 0:
                fusion.on_item("tilt", sweep_of_floor_and_wall(measured_ns - 20 * MS, config), measured_ns + delay_ns)
                found += [each for each in fusion.tick(measured_ns + delay_ns) if isinstance(each, CloudOut)]
        clouds.append(found)
    first, again, told = clouds
    assert len(first) == len(again) == len(told) == 2
    for a, b, c in zip(first, again, told):
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.points_m, c.points_m)


def test_without_angles_nothing_is_placed_and_all_is_counted(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    fusion = fusion_of(config)
    lost = range(400, 1000)
    clouds = [each for each in nod(fusion, config, lost_ms=lost) if isinstance(each, CloudOut)]
    drops = fusion.drops["mast"]
    assert drops["angle_gone"] + drops.get("angle_late", 0) == pytest.approx(600 / 25, abs=2)
    assert all(np.minimum(np.abs(c.points_m[:, 2]), np.abs(c.points_m[:, 0] - 4.0)).max() < 0.02 for c in clouds), (
        "no beam was put at an angle that was not measured"
    )
    fusion.on_item("mast", DeviceEvent(2600 * MS, LinkState.SILENT, ""), 2600 * MS)
    fusion.on_item("tilt", sweep_of_floor_and_wall(2590 * MS, config), 2610 * MS)
    fusion.tick(3200 * MS)
    assert fusion.drops["mast"]["angle_late"] >= 1


def test_the_vehicles_motion_is_taken_out(tmp_path: Path) -> None:
    wheels = TEXT.replace("laser_odometry = false", 'source = "drive"')
    config = config_of(tmp_path, wheels + '[wheels.drive]\ndriver = "roboclaw"\nport = "/dev/c"\n')
    fusion = fusion_of(config)
    fusion.on_item("tilt", sweep_of_floor_and_wall(0, config), 20 * MS)
    for ms in range(0, 100, 5):
        fusion.on_item("mast", AngleReading(ms * MS, 0, ms > 0), ms * MS)
    fusion.tick(200 * MS)
    assert "mast" not in fusion.drops, "it waits for odometry"
    fusion.tick(700 * MS)
    assert fusion.drops["mast"] == {"odometry_late": 1}
    fusion.on_item("drive", WheelReading(710 * MS, 0, 0, False), 710 * MS)


def test_planes_of_a_cloud_in_the_map() -> None:
    random = np.random.default_rng(1)
    u, v = random.uniform(-1.0, 1.0, (2, 4000))
    floor = np.column_stack((2.0 + u, v, np.zeros(4000)))
    wall = np.column_stack((np.full(4000, 3.0), v, 1.0 + u))
    points = (np.concatenate((floor, wall)) + random.normal(0.0, 0.004, (8000, 3))).astype(np.float32)
    told: list[Output] = []
    makers = MapMakers([PlaneMaker()], told.append, now_ns=lambda: 0)
    makers.take_output(CloudOut("mast", 5 * MS, points, Pose2(1.0, 2.0, math.pi / 2.0), (0.0, 0.0, 1.0)))
    makers.turn(10 * MS)
    (document,) = told
    assert isinstance(document, DocumentOut)
    assert document.key == "map/planes"
    message = json.loads(document_message(document, 0).payload)
    assert message["version"] == 1
    planes = sorted(message["planes"], key=lambda plane: abs(plane["normal"][2]))
    np.testing.assert_allclose(planes[0]["normal"], (0.0, 1.0, 0.0), atol=0.005)
    assert planes[0]["distance_m"] == pytest.approx(5.0, abs=0.005)
    assert abs(planes[1]["normal"][2]) > 0.999
    assert planes[1]["distance_m"] < 0.01
    makers.take_output(CloudOut("mast", 6 * MS, points, None, (0.0, 0.0, 1.0)))
    makers.turn(3000 * MS)
    assert len(told) == 1, "where it was is not known: nothing is told"
    for k in range(9):
        makers.take_output(CloudOut("mast", k * MS, points[:10], None, (0.0, 0.0, 1.0)))
    assert makers.counters()["makers.clouds_lost"] == 5


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (TEXT.replace('laser = "tilt"', 'laser = "none"'), "there is no [lasers.none]"),
        (TEXT.replace('sources = ["front"]', 'sources = ["front", "tilt"]'), "tilted by mounts.mast"),
        (TEXT.replace("-3600.0", "0.0"), "cannot be 0"),
        (TEXT.replace('can = "main"', 'can = "other"'), "there is no [can.other]"),
        (TEXT + '[mounts.two]\ndriver = "cia406"\ncan = "main"\nnode = 49\nlaser = "tilt"\n', "already"),
        (TEXT + '[mounts.two]\ndriver = "cia406"\ncan = "main"\nlaser = "front"\n', "CAN id"),
        (TEXT.replace("zero_deg", "zero_rad"), "zero_deg"),
    ],
)
def test_faults_of_a_mount_name_their_repair(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(WrongUsage) as caught:
        config_of(tmp_path, text)
    assert says in str(caught.value)


def test_a_tilted_laser_feeds_no_flat_map(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    found = assemble.sensors(config)
    maps = assemble.maps(config, found)
    assert all("tilt" not in grid.sources for grid in maps.grids)
    flat = [
        maker for maker in assemble_makers.map_makers(config, found) if maker.name != "agreement"
    ]  # which keeps no sweep
    assert all("tilt" not in maker.sources for maker in flat)
    assert "planes" in {maker.name for maker in assemble_makers.map_makers(config, found)}
