"""Load or compile every kernel of the line maps before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.frames import Pose2
from mapping.lines.extract import LineExtractor, extract_from_points
from mapping.lines.gone import LOOKS, Doubts
from mapping.lines.line_map import LineMap


def warm_up() -> None:
    """Map an empty room twice, from beams and from points, and look around in it."""
    bearing = np.linspace(-np.pi, np.pi, 180, endpoint=False)
    ranges = 2.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    points = np.stack((ranges * np.cos(bearing), ranges * np.sin(bearing)), axis=-1)
    line_map = LineMap()
    line_map.insert(LineExtractor(bearing).extract(ranges), Pose2())
    line_map.insert(extract_from_points(points, spacing_rad=0.035, full_turn=True), Pose2(0.01, 0.0, 0.0))
    line_map.raycast((0.0, 0.0), bearing)
    doubts = Doubts()
    for _ in range(LOOKS):
        doubts.look(line_map, bearing, 2.0 * ranges, Pose2())
