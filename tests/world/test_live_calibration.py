"""Calibration in the daemon: five minutes of the flat, by a robot that is not what is believed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from service import assemble, assemble_makers
from service.calibration_maker import KEY, CalibrationMaker
from service.config import Config
from service.map_makers import MapMakers
from service.outputs import DocumentOut, Output
from service.payloads import Encoder
from tests.world.test_live_slam_worlds import CONFIG, MOUNT, TICKS_PER_M, TRACK_M, drive, robot

GAIN = 1.0 / 1.015  # the wheels say 1.5 % too much, and 4 % too much turn
TRUE_TRACK_M = TRACK_M * 1.04 / 1.015
SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "schemas" / "calibration.v1.json").read_text())


def misplaced() -> Config:
    """Believes the laser 3 cm, 3 cm and 3 degrees from where it is."""
    data = CONFIG.model_dump()
    mount = data["lasers"]["front"]["mount"]
    mount["x_m"], mount["y_m"], mount["yaw_deg"] = MOUNT.x_m - 0.03, MOUNT.y_m - 0.03, math.degrees(MOUNT.yaw_rad) + 3.0
    return Config.model_validate(data)


@pytest.fixture(scope="module")
def documents() -> list[dict[str, Any]]:
    config, told = misplaced(), list[dict[str, Any]]()

    def offer(output: Output) -> None:
        if isinstance(output, DocumentOut) and output.key == KEY:
            told.append(json.loads(Encoder().encode(output, 0)[0].payload))

    sensors = assemble.sensors(config)
    (maker,) = (each for each in assemble_makers.map_makers(config, sensors) if isinstance(each, CalibrationMaker))
    driving = drive("flat", 6.3)
    made = robot(driving.truth(0), config=config, makers=MapMakers([maker], offer, now_ns=lambda: 0))
    made.play(driving.items)
    return told


def test_five_minutes_of_driving_tell_wheels_and_mount(documents: list[dict[str, Any]]) -> None:
    assert len(documents) > 8
    for document in documents:
        jsonschema.validate(document, SCHEMA)
    report = documents[-1]["lasers"]["front"]
    value = {name: row["value"] for name, row in report["values"].items()}
    assert report["not_observable"] == []
    assert value["left_m_per_tick"] * TICKS_PER_M == pytest.approx(GAIN, rel=0.003)
    assert value["right_m_per_tick"] * TICKS_PER_M == pytest.approx(GAIN, rel=0.003)
    assert value["track_width_m"] == pytest.approx(TRUE_TRACK_M, rel=0.003)
    assert value["laser_x_m"] == pytest.approx(MOUNT.x_m, abs=0.005)
    assert value["laser_y_m"] == pytest.approx(MOUNT.y_m, abs=0.005)
    assert value["laser_yaw_rad"] == pytest.approx(MOUNT.yaw_rad, abs=math.radians(0.2))
    assert value["time_offset_s"] == pytest.approx(0.0, abs=0.005)


def test_no_report_is_surer_than_it_is_right(documents: list[dict[str, Any]]) -> None:
    truth = {
        "wheel_radius_left_m": GAIN * CONFIG.drive.wheel_radius_left_m,
        "wheel_radius_right_m": GAIN * CONFIG.drive.wheel_radius_right_m,
        "track_width_m": TRUE_TRACK_M,
        "laser_x_m": MOUNT.x_m,
        "laser_y_m": MOUNT.y_m,
        "laser_yaw_rad": MOUNT.yaw_rad,
    }
    off = [
        abs(row["value"] - truth[name]) / row["deviation"]
        for document in documents
        for name, row in document["lasers"]["front"]["values"].items()
        if name in truth and row["value"] is not None
    ]
    assert max(off) < 4.0


def test_the_settings_that_are_wrong_are_named(documents: list[dict[str, Any]]) -> None:
    advice = {each["setting"]: each for each in documents[-1]["lasers"]["front"]["advice"]}
    assert set(advice) == {
        "drive.wheel_radius_left_m",
        "drive.wheel_radius_right_m",
        "drive.track_width_m",
        "lasers.front.mount.x_m",
        "lasers.front.mount.y_m",
        "lasers.front.mount.yaw_deg",
    }
    assert advice["lasers.front.mount.yaw_deg"]["value"] == pytest.approx(math.degrees(MOUNT.yaw_rad), abs=0.2)
    assert advice["drive.track_width_m"]["instead_of"] == TRACK_M
