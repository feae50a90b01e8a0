"""Findings about cones that are remembered: the same again, in the memory that was said."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.sectors.evidence import Finding
from mapping.sectors.remembered import RememberedCones


class Finder:
    """Counts how often something is worked out."""

    def __init__(self, sectors: int) -> None:
        self.sectors = sectors
        self.asked = 0

    def find(self, pose: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float) -> Finding:
        self.asked += 1
        obstacle, u = np.full(self.sectors, np.inf), np.full(self.sectors, np.nan)
        obstacle[0], u[0] = range_m, pose.yaw_rad
        return Finding(obstacle, u, 2.0 * u, np.full(self.sectors, range_max_m), np.zeros(self.sectors, dtype=bool))


def test_what_was_found_comes_back_and_is_found_once() -> None:
    finder = Finder(12)
    heard = RememberedCones(12, finder.find)
    told = (Pose2(0.1, 0.2, 0.3), 0.5, 1.25, 0.02, 3.0)
    first, again, found = heard(*told), heard(*told), finder.find(*told)
    assert finder.asked == 2
    for name in ("obstacle_m", "u", "v", "free_m", "blind"):
        np.testing.assert_array_equal(getattr(first, name), getattr(found, name))
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    heard(told[0], 0.5, 1.26, 0.02, 3.0)
    assert finder.asked == 3


@pytest.mark.parametrize("sectors", [12, 48, 256])
def test_it_keeps_no_more_than_it_says(sectors: int) -> None:
    finder = Finder(sectors)
    heard = RememberedCones(sectors, finder.find)
    pose = Pose2(0.1, 0.2, 0.3)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for k in range(8000):
            heard(pose, 0.5, 0.001 * k, 0.02, 3.0)
        taken = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 2.0e6 < taken < 4.6e6
    heard(pose, 0.5, 0.001 * 7999, 0.02, 3.0)
    assert finder.asked == 8000  # the latest is there
