"""A calibration as a document: each number beside what was believed, what is not observable, what to write instead."""

from __future__ import annotations

import math

import numpy as np

from mapping.localise.calibrate import NAMES, Calibration, RobotModel
from mapping.localise.umbmark import SIDE_M, square_end

NOT_OBSERVABLE = "not observable yet"

_SIGMAS = 3.0
_YAW = NAMES.index("laser_yaw_rad")
# Less than this is not worth a line in the configuration: shares of the first three, metres, radians, seconds.
_WORTH = np.array([0.003, 0.003, 0.005, 0.005, 0.005, math.radians(0.3), math.inf])


def report_of(
    found: Calibration,
    believed: RobotModel,
    *,
    rejected: int,
    has_ticks: bool,
    ticks_per_turn: tuple[float, float] | None = None,
) -> dict[str, object]:
    """Numbers that the drive does not tell are null and named.

    rejected: sweeps that did not fit.  has_ticks: False where the wheels were worked back from odometry of which
    nothing is known.  ticks_per_turn: of the left and right wheel, to tell radii.
    """
    values: dict[str, object] = {}
    for k, name in enumerate(NAMES):
        row = {"value": found.value(name), "deviation": float(found.deviation[k]), "believed": float(believed.row()[k])}
        values[name] = row
        if ticks_per_turn is not None and k < 2:
            radius = abs(ticks_per_turn[k]) / (2.0 * math.pi)
            values[("wheel_radius_left_m", "wheel_radius_right_m")[k]] = {
                key: None if value is None else abs(value) * radius for key, value in row.items()
            }
    return {
        "values": values,
        "not_observable": [name for name in NAMES if found.value(name) is None],
        "wheels": "ticks" if has_ticks else "worked back from odometry: gains and track are factors on it",
        "motions": {
            "used": found.motions,
            "outliers": found.trimmed,
            "sweeps_that_did_not_fit": rejected,
            "way_m": round(found.way_m, 2),
            "turn_deg": round(math.degrees(found.turn_rad), 1),
            "median_off_m": round(found.residual_m, 5),
            "median_off_deg": round(math.degrees(found.residual_rad), 4),
        },
        "umbmark": _umbmark(found, believed),
    }


def advice_of(
    found: Calibration, believed: RobotModel, *, laser: str, ticks_per_turn: tuple[float, float]
) -> list[dict[str, object]]:
    """Settings that the drive contradicts: three deviations off and by more than 0.3 % (radii), 0.5 % (track), 5 mm
    or 0.3 degrees. laser: the section of its configuration."""
    off = found.best - believed.row()
    off[_YAW] = math.remainder(off[_YAW], 2.0 * math.pi)  # 180 degrees are -180
    best = believed.row() + off
    worth = _WORTH * np.concatenate((np.abs(believed.row()[:3]), np.ones(4)))
    contradicted = found.observable & (np.abs(off) > _SIGMAS * found.deviation) & (np.abs(off) > worth)
    radii = [abs(ticks) / (2.0 * math.pi) for ticks in ticks_per_turn]
    degrees = math.degrees(1.0)
    settings = (
        ("drive.wheel_radius_left_m", radii[0], 5),
        ("drive.wheel_radius_right_m", radii[1], 5),
        ("drive.track_width_m", 1.0, 4),
        (f"{laser}.mount.x_m", 1.0, 3),
        (f"{laser}.mount.y_m", 1.0, 3),
        (f"{laser}.mount.yaw_deg", degrees, 2),
    )
    size = (abs, abs, float, float, float, float)
    return [
        {
            "setting": setting,
            "value": round(size[k](float(best[k])) * unit, digits),
            "deviation": float(f"{found.deviation[k] * unit:.2g}"),
            "instead_of": round(size[k](float(believed.row()[k])) * unit, digits),
        }
        for k, (setting, unit, digits) in enumerate(settings)
        if contradicted[k]
    ]


def contradiction_of(
    as_believed: tuple[bool, bool] | None, *, laser: str, ticks_per_turn: tuple[float, float]
) -> str | None:
    """What no number puts right, in words: see `calibrate.turns_as_believed`. laser: the section of its
    configuration."""
    if as_believed is None or all(as_believed):
        return None
    if not any(as_believed):
        return (
            f"{laser} turns the other way than the wheels say: is {laser}.mount.upside_down wrong, are the left and "
            "the right wheel exchanged, or do both count backwards (drive.ticks_per_turn_left and _right)?"
        )
    k = as_believed.index(False)
    side = ("left", "right")[k]
    return f"the {side} wheel counts backwards: drive.ticks_per_turn_{side} = {-ticks_per_turn[k]:g}"


def _umbmark(found: Calibration, believed: RobotModel) -> dict[str, object] | None:
    """How far off a square of 4 m would end that is driven by what was believed; None unless the wheels are known."""
    left, right, track = (found.value(name) for name in NAMES[:3])
    if left is None or right is None or track is None:
        return None
    b = believed
    ends = {
        name: square_end((left, right, track), (b.left_m_per_tick, b.right_m_per_tick, b.track_width_m), way=way)
        for name, way in (("clockwise_m", -1), ("counter_clockwise_m", 1))
    }
    worst = max(float(np.hypot(*end)) for end in ends.values())
    return {"side_m": SIDE_M, "worst_m": round(worst, 4)} | {
        name: [round(float(v), 4) for v in end] for name, end in ends.items()
    }
