"""Load or compile every kernel of the plane maps before a device is opened: a first call takes up to some seconds."""

from __future__ import annotations

import numpy as np

from mapping.planes.extract import PlaneRules, extract_planes


def warm_up() -> None:
    """Find the planes of a corner of a room with something round in it, both ways."""
    side = np.arange(0.5, 2.0, 0.05)
    u, v = (grid.ravel() for grid in np.meshgrid(side, side))
    walls = [np.stack((u, v, np.full(u.size, 0.5)), axis=-1), np.stack((np.full(u.size, 0.5), u, v), axis=-1)]
    ball = np.random.default_rng(1).normal(1.0, 0.05, (400, 3))
    points = np.concatenate((*walls, ball))
    extract_planes(points)
    extract_planes(points, PlaneRules.book())
