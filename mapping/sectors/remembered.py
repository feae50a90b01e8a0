"""What sonars said before: findings about cones, worked out once and kept as one array each.

Sonars stand still on the robot and mostly tell whole centimetres, so the same distances come again and again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.sectors.evidence import Finding

_BYTES = 4 << 20
_HEAD_BYTES = 400  # of an array, its key and its place among the others


class RememberedCones:
    """Findings of one map about cones, the latest of them kept: 4 MB, all that 16 sonars of 3 m ever say in it."""

    def __init__(self, sectors: int, find: Callable[[Pose2, float, float, float, float], Finding]) -> None:
        """sectors: of the map.  find: of a pose, an opening angle, a range and its limits; nothing blind in it."""
        self._find = find
        self._kept = lru_cache(max(256, _BYTES // (4 * 8 * sectors + _HEAD_BYTES)))(self._packed)
        self._nothing_blind = np.zeros(sectors, dtype=np.bool_)
        self._nothing_blind.setflags(write=False)

    def __call__(self, pose: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float) -> Finding:
        """As `find` says; its arrays are not to be written to."""
        obstacle_m, u, v, free_m = self._kept(pose, cone_rad, range_m, range_min_m, range_max_m)
        return Finding(obstacle_m, u, v, free_m, self._nothing_blind)

    def _packed(self, *heard: object) -> NDArray[np.float64]:
        found = self._find(*heard)  # type: ignore[arg-type]
        return np.stack((found.obstacle_m, found.u, found.v, found.free_m))
