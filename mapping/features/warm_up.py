"""Load or compile every kernel of the feature maps before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.features.graph import compare
from mapping.features.range_image import segment_ranges
from mapping.features.scenes import SceneDatabase, sight_of
from mapping.frames import Pose2
from mapping.scan import Scan


def warm_up() -> None:
    """Look at an empty room, remember it, and recognise it."""
    bearing = np.linspace(-np.pi, np.pi, 180, endpoint=False)
    ranges = 2.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing) / 1.5))
    sight = sight_of(Scan(0, 0.0, bearing, ranges, 0.0, 10.0))
    segment_ranges(ranges)
    compare(sight.graph, sight.graph)
    database = SceneDatabase()
    database.add(sight, Pose2())
    database.where_am_i(sight)
    database.add_bytes(database.scene_bytes(0))
