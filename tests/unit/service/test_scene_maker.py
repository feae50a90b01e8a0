"""Scenes in the daemon: what becomes one, what is told, asked, kept and taken up again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import jsonschema
import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.scan import Scan
from service import scene_maker
from service.map_makers import MapMaker, MapView
from service.outputs import DocumentOut
from service.payloads import Encoder
from service.rpc import CallRefused
from service.scene_maker import KEY, SceneMaker
from tests.unit.mapping.test_features_scenes import BEARING, DRIVE, PLACES, flat, scan_at

F64 = NDArray[np.float64]
MOUNT = Pose2(0.3, 0.1, 0.2)


def row(pose: Pose2) -> F64:
    return np.array([pose.x_m, pose.y_m, pose.yaw_rad])


def driven() -> SceneMaker:
    maker = SceneMaker({"front": MOUNT})
    for k, pose in enumerate(DRIVE):
        maker.take_sweep("front", scan_at(flat(), pose, seed=k), row(pose))
    return maker


def told(maker: MapMaker) -> list[dict[str, Any]]:
    outputs = maker.make(MapView(5, None, (), None))
    documents = [out for out in outputs if isinstance(out, DocumentOut) and out.key == KEY]
    assert len(documents) == len(outputs)
    return [json.loads(Encoder().encode(out, 0)[0].payload) for out in documents]


def test_scenes_are_taken_at_new_places_only_and_told_once() -> None:
    maker = driven()
    (document,) = told(maker)
    assert document["scenes"] == len(maker.database) == len(DRIVE)
    assert document["anchors"] > 50
    assert len(document["newest"]) == len(DRIVE)
    with open("docs/schemas/scenes.v1.json") as file:
        jsonschema.validate(document, json.load(file))
    assert told(maker) == []
    for k, pose in enumerate(DRIVE[::-1]):  # back the same way: nothing new
        maker.take_sweep("front", scan_at(flat(), pose, seed=50 + k), row(pose))
    assert told(maker) == []


def test_where_am_i_is_the_bases_pose_by_the_newest_sweep() -> None:
    maker = driven()
    maker.take_sweep("front", scan_at(flat(), PLACES[0], seed=100), row(Pose2(50.0, 50.0, 1.0)))  # carried away
    answer = maker.where_am_i({})
    assert answer["known"]
    place = answer["place"]
    assert isinstance(place, dict)
    truth = PLACES[0] @ MOUNT.inverse()
    assert math.hypot(place["x_m"] - truth.x_m, place["y_m"] - truth.y_m) < 0.05
    assert place["yaw_rad"] == pytest.approx(truth.yaw_rad, abs=0.02)
    assert answer == maker.where_am_i({"laser": "front"})
    json.dumps(answer, allow_nan=False)


def test_sweeps_of_a_robot_that_stays_are_looked_at_when_somebody_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[int] = []

    def noting(middle: Pose2, scan: Scan, poses: F64) -> Scan:
        looked.append(scan.stamp_ns)
        return scan

    monkeypatch.setattr(scene_maker, "_as_seen_from", noting)
    maker = SceneMaker({"front": MOUNT})
    scan = scan_at(flat(), PLACES[0])
    poses = np.tile(row(PLACES[0]), (BEARING.size, 1))
    for stamp_ns in range(1, 11):
        maker.take_sweep("front", replace(scan, stamp_ns=stamp_ns), poses)
    assert looked == [1]
    answer = maker.where_am_i({})
    assert looked == [1, 10]
    assert answer == maker.where_am_i({})
    assert looked == [1, 10]


def test_unknown_is_an_answer_with_its_reason() -> None:
    maker = driven()
    maker.take_sweep("front", Scan(0, 0.0, BEARING, np.full(BEARING.size, np.inf), 0.05, 20.0), row(Pose2(90.0)))
    answer = maker.where_am_i({})
    assert (answer["known"], answer["place"]) == (False, None)
    assert "too few" in str(answer["reason"])


def test_a_call_that_cannot_be_answered_says_why() -> None:
    maker = SceneMaker({"front": MOUNT})
    with pytest.raises(CallRefused, match="no scan"):
        maker.where_am_i({})
    for number in (-1, 1.5, True, "3"):
        with pytest.raises(CallRefused, match="skip_newest"):
            maker.where_am_i({"skip_newest": number})
    for wrong in ("rear", 7, None, ["front"]):
        with pytest.raises(CallRefused, match="front"):
            maker.where_am_i({"laser": wrong})


def test_what_was_kept_is_taken_up_again() -> None:
    maker = driven()
    tiles = maker.changed_tiles()
    assert maker.changed_tiles() == []
    other = SceneMaker({"front": MOUNT})
    other.restore(tiles)
    assert len(other.database) == len(DRIVE)
    assert told(other)[0]["scenes"] == len(DRIVE)
    other.take_sweep("front", scan_at(flat(), PLACES[0], seed=100), row(Pose2()))
    assert other.where_am_i({})["known"]
    more = Pose2(13.8, 3.0, 2.0)
    other.take_sweep("front", scan_at(flat(), more), row(more))
    new = range(len(DRIVE), len(other.database))
    assert [tile[:2] for tile in other.changed_tiles()] == [(0, 0), *((n, 1) for n in new)]


def test_tiles_of_a_larger_map_that_stay_behind_do_no_harm() -> None:
    maker = driven()
    stored = {tile[:2]: tile[2] for tile in maker.changed_tiles()}
    maker.start_anew()
    maker.take_sweep("front", scan_at(flat(), DRIVE[0]), row(DRIVE[0]))
    stored |= {tile[:2]: tile[2] for tile in maker.changed_tiles()}
    other = SceneMaker({"front": MOUNT})
    other.restore((row, column, payload) for (row, column), payload in stored.items())
    assert len(other.database) == 1


def test_damaged_tiles_are_refused() -> None:
    tiles = driven().changed_tiles()
    with pytest.raises(ValueError, match="told of"):
        SceneMaker({"front": MOUNT}).restore(tiles[:3])
    with pytest.raises(ValueError, match="not a scene"):
        SceneMaker({"front": MOUNT}).restore([*tiles[:-1], (*tiles[-1][:2], b"rubbish")])
    empty = SceneMaker({"front": MOUNT})
    empty.restore(())
    assert len(empty.database) == 0


def test_a_map_that_was_corrected_begins_anew_and_the_newest_sweep_stays() -> None:
    maker = driven()
    told(maker)
    maker.start_anew()
    assert told(maker)[0]["scenes"] == 0
    assert maker.where_am_i({"skip_newest": 0})["reason"] == "no scenes are stored yet"


def test_a_full_database_counts_what_it_leaves_out() -> None:
    maker = SceneMaker({"front": MOUNT}, most=3)
    for k, pose in enumerate(DRIVE[:6]):
        maker.take_sweep("front", scan_at(flat(), pose, seed=k), row(pose))
    (document,) = told(maker)
    assert (document["scenes"], document["left_out"]) == (3, 3)


def test_a_sweep_taken_while_turning_is_seen_from_one_place() -> None:
    """A laser that turns by 6 degrees during its sweep sees the same scene as one that stands."""
    pose = PLACES[0]
    turn = np.linspace(-0.05, 0.05, BEARING.size)
    poses = np.stack((np.full(BEARING.size, pose.x_m), np.full(BEARING.size, pose.y_m), pose.yaw_rad + turn), axis=-1)
    each = [scan_at(flat(), Pose2(*p), noise=0.0).range_m[k] for k, p in enumerate(poses)]
    maker = driven()
    maker.take_sweep("front", Scan(0, 1e5, BEARING, np.array(each), 0.05, 20.0), poses)
    place = maker.where_am_i({})["place"]
    assert isinstance(place, dict)
    truth = pose @ MOUNT.inverse()
    assert math.hypot(place["x_m"] - truth.x_m, place["y_m"] - truth.y_m) < 0.05


def test_sweeps_without_a_pose_or_with_crossed_beams_are_left_out() -> None:
    maker = SceneMaker({"front": MOUNT})
    scan = scan_at(flat(), PLACES[0])
    maker.take_sweep("front", scan, np.array([math.nan, 0.0, 0.0]))
    spinning = np.zeros((BEARING.size, 3))
    spinning[:, 2] = np.linspace(0.0, -6.0, BEARING.size)
    maker.take_sweep("front", scan, spinning)
    maker.take_sweep("front", Scan(0, 0.0, BEARING[:2], scan.range_m[:2], 0.05, 20.0), row(Pose2()))
    assert len(maker.database) == 0
    with pytest.raises(CallRefused, match="no scan"):
        maker.where_am_i({})


def test_sweeps_whose_beams_lie_in_no_order_are_left_out() -> None:
    """As they are after a correction, when kept sweeps come again: kept in few bits, two beams may change places."""
    maker = SceneMaker({"front": MOUNT})
    scan = scan_at(flat(), PLACES[0], seed=1)
    bearing = scan.bearing_rad.copy()
    bearing[[40, 41]] = bearing[[41, 40]]
    crossed = Scan(scan.stamp_ns, 0.0, bearing, scan.range_m, scan.range_min_m, scan.range_max_m)
    maker.take_sweep("front", crossed, row(PLACES[0]))
    assert len(maker.database) == 0
    maker.take_sweep("front", scan, row(PLACES[0]))
    assert len(maker.database) == 1
