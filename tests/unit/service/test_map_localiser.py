"""Localisation in a known map as the daemon's localiser: it finds the robot, says so, and changes no map."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.patch import GridPatch
from mapping.grids.tiles import TILE
from mapping.odometry import OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service import assemble
from service.background import at_once
from service.config import Config
from service.config_maps import LocaliseIn
from service.errors import Trouble
from service.export import image_of, save_pgm_yaml
from service.fusion import Fusion
from service.map_localiser import KEY, KnownMapLayer, KnownMapLocaliser, read_map, relocalise, seen_by_lasers
from service.outputs import DocumentOut, GridOut
from service.payloads import document_message
from service.rpc import CallRefused
from service.store import OCCUPANCY, MapStore, occupancy_tiles

SCHEMA = Path(__file__).parents[3] / "docs" / "schemas" / "localisation.v1.json"
PERIOD_NS = 100_000_000
F64 = NDArray[np.float64]
T = TypeVar("T")
WALLS = [
    (0.0, 0.0, 8.0, 0.0), (8.0, 0.0, 8.0, 5.0), (8.0, 5.0, 0.0, 5.0), (0.0, 5.0, 0.0, 0.0),
    (3.0, 0.0, 3.0, 2.0), (3.0, 3.4, 3.0, 5.0), (5.5, 5.0, 5.5, 3.6), (6.5, 0.0, 6.5, 1.2), (6.5, 1.2, 8.0, 1.2),
]  # fmt: skip
BEARINGS: F64 = np.radians(np.arange(-135.0, 135.5, 1.5))


def plan() -> GridPatch:
    cells = np.zeros((101, 161), dtype=np.int8)
    for x0, y0, x1, y1 in WALLS:
        at = np.linspace(0.0, 1.0, 2000)
        cells[((y0 + at * (y1 - y0)) / 0.05).astype(int), ((x0 + at * (x1 - x0)) / 0.05).astype(int)] = 100
    return GridPatch(0.05, 0, 0, cells)


def sweep(pose: Pose2, stamp_ns: int) -> Scan:
    """What a laser on the base sees, in closed form."""
    found = np.full(len(BEARINGS), 80.0)
    angle = pose.yaw_rad + BEARINGS
    c, s = np.cos(angle), np.sin(angle)
    for x0, y0, x1, y1 in WALLS:
        ex, ey, ax, ay = x1 - x0, y1 - y0, x0 - pose.x_m, y0 - pose.y_m
        cross = c * ey - s * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            t, u = (ax * ey - ay * ex) / cross, (ax * s - ay * c) / cross
        hit = (np.abs(cross) > 1e-12) & (t > 0.0) & (u >= 0.0) & (u <= 1.0)
        found = np.where(hit, np.minimum(found, t), found)
    return Scan(stamp_ns, 0.0, BEARINGS, found, 0.05, 30.0)


def way() -> list[Pose2]:
    return [Pose2(1.0 + 0.04 * k, 2.7 + 0.2 * math.sin(0.1 * k), 0.15 * math.sin(0.2 * k)) for k in range(110)]


def drive(localiser: KnownMapLocaliser, poses: list[Pose2]) -> list[DocumentOut]:
    """Drive by odometry whose zero is the start; returns what is told."""
    buffer, told = PoseBuffer(), []
    for k, pose in enumerate(poses):
        odom, stamp_ns = poses[0].inverse() @ pose, (k + 1) * PERIOD_NS
        buffer.add(stamp_ns, odom)
        localiser.take_odometry(OdometryState(stamp_ns, odom, np.zeros((3, 3)), 0.0, 0.0, False))
        assert localiser.is_ready(stamp_ns)
        localiser.take_scan("lasers", sweep(pose, stamp_ns), buffer, Pose2())
        told += [out for out in localiser.outputs(stamp_ns) if isinstance(out, DocumentOut)]
    return told


def ask(work: Callable[[], T]) -> T:
    return work()


@pytest.fixture
def localiser() -> KnownMapLocaliser:
    return KnownMapLocaliser(plan(), ["lasers"], submit=at_once, name="plan.yaml")


def test_it_finds_the_robot_and_tells_so(localiser: KnownMapLocaliser) -> None:
    assert localiser.outputs(0) == []
    told = drive(localiser, way())
    states = [out.fields["state"] for out in told]
    assert states[0] == "searching"
    assert states[-1] == "sure"
    assert localiser.troubles() == []
    found = localiser.map_from_odom() @ (way()[0].inverse() @ way()[-1])
    assert math.hypot(found.x_m - way()[-1].x_m, found.y_m - way()[-1].y_m) < 0.1
    validator = Draft202012Validator(json.loads(SCHEMA.read_text()))
    for out in told:
        assert out.key == KEY
        validator.validate(json.loads(document_message(out, 0).payload))


def test_until_it_is_sure_the_pose_may_be_anywhere(localiser: KnownMapLocaliser) -> None:
    state = OdometryState(PERIOD_NS, Pose2(0.3, 0.0, 0.0), np.zeros((3, 3)), 0.0, 0.0, False)
    assert localiser.locate(state).covariance[0, 0] > 1e5
    drive(localiser, way()[:2])
    assert "not localised yet in plan.yaml" in localiser.troubles()[0]
    assert localiser.locate(state).covariance[0, 0] > 1e5
    drive(localiser, way())
    last = way()[0].inverse() @ way()[-1]
    sure = localiser.locate(OdometryState(20 * PERIOD_NS, last, np.zeros((3, 3)), 0.0, 0.0, False))
    assert sure.covariance[0, 0] < 0.1**2


@pytest.mark.parametrize("period_ns", [100_000_000, 110_000_000, 125_000_000, 143_000_000])
def test_sweeps_that_take_time_are_all_taken(localiser: KnownMapLocaliser, period_ns: int) -> None:
    # a search's result is asked for by the first beam's stamp, and the sweep is placed at its middle: both are one scan
    standing, buffer = way()[0], PoseBuffer()
    for stamp_ns in range(0, 62 * period_ns, period_ns):
        buffer.add(stamp_ns, Pose2())
    for stamp_ns in range(period_ns, 60 * period_ns, period_ns):
        scan = replace(sweep(standing, stamp_ns), beam_period_ns=period_ns / (len(BEARINGS) + 1))
        assert localiser.is_ready(stamp_ns)
        localiser.take_scan("lasers", scan, buffer, Pose2())
        told = [out for out in localiser.outputs(stamp_ns) if isinstance(out, DocumentOut)]
        assert all(out.stamp_ns > stamp_ns for out in told)  # the middle, where the pose is
    assert localiser.counters()["localise.scans"] == 59
    assert localiser.counters()["localise.searches"] > 0


def test_where_am_i_is_answered_with_candidates(localiser: KnownMapLocaliser) -> None:
    with pytest.raises(CallRefused, match="no scan"):
        relocalise(localiser, ask, {})
    drive(localiser, way())
    told = relocalise(localiser, ask, {})
    found = told["found"]
    assert isinstance(found, list)
    assert math.hypot(found[0]["x_m"] - way()[-1].x_m, found[0]["y_m"] - way()[-1].y_m) < 0.15
    assert 0.0 < found[0]["share"] <= 1.0
    assert told["state"] == "sure"  # asking changes nothing
    elsewhere = relocalise(localiser, ask, {"hint": {"x_m": 1.0, "y_m": 1.0, "yaw_deg": 0.0}, "radius_m": 0.8})["found"]
    assert isinstance(elsewhere, list)
    assert all(math.hypot(each["x_m"] - 1.0, each["y_m"] - 1.0) < 2.5 for each in elsewhere)
    assert relocalise(localiser, ask, {"forget": True})["pose"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        {"hint": 3}, {"hint": {"x_m": "far"}}, {"hint": {"x_m": math.nan}}, {"hint": {}, "radius_m": -1.0},
        {"forget": "yes"}, {"hint": {"x_m": True}},
    ],
)  # fmt: skip
def test_calls_that_make_no_sense_are_refused(localiser: KnownMapLocaliser, arguments: dict[str, Any]) -> None:
    drive(localiser, way()[:3])
    with pytest.raises(CallRefused):
        relocalise(localiser, ask, arguments)


def test_no_map_is_changed(tmp_path: Path) -> None:
    """The daemon's parts, put together from a configuration: no grid that draws, no store, the file as it was."""
    save_pgm_yaml(image_of(plan()), tmp_path / "plan.yaml")
    files = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in tmp_path.iterdir()}
    config = Config(localise=LocaliseIn(mode="map", map=str(tmp_path / "plan.yaml")))
    made = assemble.maps(config, {})
    assert made.building is None
    assert len(made.grids) == 1
    localiser = assemble.localiser(config, {}, made, Pose2(), at_once)
    assert isinstance(localiser, KnownMapLocaliser)
    layer = made.grids[0]
    assert isinstance(layer, KnownMapLayer)
    before = layer.patch.cells.copy()
    for k, pose in enumerate(way()[:20]):
        layer.take_sweep("lasers", sweep(pose, k), np.array([pose.x_m, pose.y_m, pose.yaw_rad]))
    fusion = Fusion(assemble.parts(config, {}, made, localiser))
    grids = [out for k in range(200) for out in fusion.tick((k + 1) * PERIOD_NS) if isinstance(out, GridOut)]
    assert len(grids) >= 2
    assert all(np.array_equal(out.patch.cells, before) for out in grids)
    assert {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in tmp_path.iterdir()} == files


def test_a_map_that_is_none_ends_the_start(tmp_path: Path) -> None:
    with pytest.raises(Trouble, match=r"nothing\.yaml"):
        read_map(tmp_path / "nothing.yaml")
    with pytest.raises(Trouble, match="walls"):
        KnownMapLocaliser(GridPatch(0.05, 0, 0, np.zeros((9, 9), dtype=np.int8)), [], submit=at_once)
    with pytest.raises(ValueError, match="map to find the robot in"):
        LocaliseIn(mode="map")


def test_what_sonars_alone_heard_is_published_but_lasers_are_not_laid_on_it(tmp_path: Path) -> None:
    """A laser looks through glass that a sonar has drawn: were it held to it, a robot in its place would be lost."""
    grid = OccupancyGrid(resolution_m=0.05)
    bearing = np.linspace(-math.pi, math.pi, 721)
    for _ in range(5):
        grid.insert_scan(Pose2(), bearing, np.full(len(bearing), 4.0), range_max_m=10.0)
        grid.insert_cone(Pose2(), 2.0, cone_rad=0.3, range_max_m=3.0, range_min_m=0.2)
    path = tmp_path / "glass.umfeld"
    with MapStore.open(path, wall_ns=lambda: 0) as store:
        meta = {
            "grid": {"resolution_m": 0.05, "model": grid.model},
            OCCUPANCY: {"resolution_m": 0.05, "tile_cells": TILE},
        }
        store.snapshot(
            {"grid": list(grid.tiles()), OCCUPANCY: occupancy_tiles(grid.patch(whole_tiles=True), TILE)}, meta
        )
    whole = read_map(path)
    seen = seen_by_lasers(path, whole)
    assert (seen.row0, seen.col0, seen.cells.shape) == (whole.row0, whole.col0, whole.cells.shape)

    def nearest_m(patch: GridPatch) -> float:
        rows, cols = np.nonzero(patch.cells >= 65)
        return float(np.hypot(rows + patch.row0 + 0.5, cols + patch.col0 + 0.5).min() * 0.05)

    assert nearest_m(whole) == pytest.approx(2.0, abs=0.1)
    assert nearest_m(seen) == pytest.approx(4.0, abs=0.1)
    walls = whole.cells >= 65
    far = np.hypot(*(np.indices(walls.shape) + 0.5 + np.array([[[whole.row0]], [[whole.col0]]]))) * 0.05 > 3.5
    np.testing.assert_array_equal((seen.cells >= 65) & far, walls & far)
