"""`umfeld calibrate` on recorded logs: figures, the report as JSON, what a log does not tell."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mapping.localise.calibrate import NAMES, Calibration, RobotModel
from mapping.localise.relative_motions import RelativeMotions
from service.calibrate_log import LogCalibration
from service.commands.calibrate import app
from service.errors import WrongUsage

DATA = os.environ.get("UMFELD_DATA", "")
needs_data = pytest.mark.skipif(not DATA, reason="needs UMFELD_DATA")

BELIEVED = RobotModel(1e-4, -1e-4, 0.5, 0.2)
NO_MOTIONS = RelativeMotions(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), 3)


def found(observable: list[bool]) -> LogCalibration:
    best = np.array([1.01e-4, -1.02e-4, 0.51, 0.21, 0.01, 0.02, 0.03])
    told = Calibration(best, np.full(7, 1e-3), np.eye(7), np.array(observable), 50, 2, 1.0, 0.001, 0.002, 30.0, 9.0)
    return LogCalibration(told, BELIEVED, NO_MOTIONS, True)


def test_what_is_not_observable_is_null_and_named() -> None:
    report = found([True, True, False, True, True, False, True]).report((2000.0, 2000.0))
    values = report["values"]
    assert isinstance(values, dict)
    assert report["not_observable"] == ["track_width_m", "laser_yaw_rad"]
    assert values["track_width_m"]["value"] is None
    assert values["wheel_radius_right_m"]["value"] == pytest.approx(1.02e-4 * 2000.0 / (2.0 * math.pi))
    assert report["umbmark"] is None  # no square without a track
    json.dumps(report, allow_nan=False)


def test_a_square_of_what_was_believed_ends_off() -> None:
    square = found([True] * 7).report()["umbmark"]
    assert isinstance(square, dict)
    assert 0.1 < square["worst_m"] < 2.0


def test_a_log_with_corrected_poses_or_without_ticks_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "short.clf"
    lines = [
        f"FLASER 3 1.0 1.0 1.0 {x} 0 0 {x} 0 0 {x}.0 host {x}.0\nODOM {x} 0 0 0 0 0 {x}.0 host {x}.0" for x in range(5)
    ]
    log.write_text("\n".join(lines) + "\n")
    result = CliRunner().invoke(app, [str(log)])
    assert isinstance(result.exception, WrongUsage)


@pytest.mark.data
@needs_data
def test_the_electric_car_agrees_with_its_own_odometry() -> None:
    """0.00012910 m a tick is one number for both wheels: their mean is held against it, and their turns against truth.

    The wheels differ: with one number for both, the ticks turn by 378 degrees, the laser and the car's own odometry
    by 180 and 171.
    """
    path = Path(DATA) / "encoder_laser" / "ual_car.scans.csv.gz"
    result = CliRunner().invoke(app, [str(path), "--json"])
    assert result.exit_code == 0, result.output
    values = json.loads(result.output)["values"]
    left, right = abs(values[NAMES[0]]["value"]), abs(values[NAMES[1]]["value"])
    assert 0.5 * (left + right) == pytest.approx(0.00012910, rel=0.01)
    assert right / left == pytest.approx(0.982, abs=0.004)
    assert values["laser_x_m"]["value"] is None  # 180 degrees of turns are too few for 2 cm
    assert values["track_width_m"]["value"] is None or values["track_width_m"]["value"] == pytest.approx(1.27, abs=0.08)
