"""Sonar rounds and touches that are kept to draw the map again, as sweeps are: see mapping.localise.kept_sweeps.

Thousands of rounds are kept. What rounds of one chain have in common is held once; the rest of a round, where the base
was and the ranges, is a string of doubles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from service.fusion import Cone, Round, Touch

F64 = NDArray[np.float64]

TOUCH_REACH_M = 3.0  # a switch sits on the robot
_POSES = 6  # doubles: two poses


@dataclass(frozen=True, slots=True)
class RoundShape:
    """All but time, place and ranges of a round: the same for every round of the same transducers."""

    sensor: str
    transducers: tuple[tuple[int, Pose2], ...]  # channel, base_from_transducer
    cone_rad: float
    range_min_m: float
    range_max_m: float

    @property
    def name(self) -> str:
        """Rounds of one name may stand for each other."""
        return f"{self.sensor}/{sorted(channel for channel, _ in self.transducers)}"


Shapes = dict[RoundShape, RoundShape]
"""Those that are known, so that equal ones are one."""


@dataclass(frozen=True, slots=True)
class KeptRound:
    """A round of sonars, kept with a key scan. numbers: poses (2, 3) as `in_key`, then the range of each transducer."""

    shape: RoundShape
    key: int
    stamp_ns: int
    numbers: bytes

    @staticmethod
    def of(sensor: str, key: int, in_key: F64, heard: Round, shapes: Shapes) -> KeptRound:
        """in_key: (2, 3) the base, seen from the key scan's base.  shapes: known ones; grows."""
        transducers = tuple((cone.channel, cone.base_from_transducer) for cone in heard.cones)
        shape = RoundShape(sensor, transducers, heard.cone_rad, heard.range_min_m, heard.range_max_m)
        numbers = np.concatenate((np.ravel(in_key), [cone.range_m for cone in heard.cones]))
        return KeptRound(shapes.setdefault(shape, shape), key, heard.stamp_ns, numbers.tobytes())

    @property
    def sensor(self) -> str:
        return self.shape.sensor

    @property
    def in_key(self) -> F64:
        """(2, 3) as in KeptSweep; both ends are one."""
        return np.frombuffer(self.numbers)[:_POSES].reshape(2, 3)

    @property
    def heard(self) -> Round:
        """The round again."""
        shape, ranges = self.shape, np.frombuffer(self.numbers)[_POSES:].tolist()
        cones = tuple(Cone(*where, range_m) for where, range_m in zip(shape.transducers, ranges, strict=True))
        return Round(self.stamp_ns, cones, shape.cone_rad, shape.range_min_m, shape.range_max_m)

    @property
    def reach_m(self) -> float:
        """The farthest that it says anything about."""
        return self.shape.range_max_m


@dataclass(frozen=True, slots=True)
class KeptTouch:
    """What a switch said, kept alike."""

    sensor: str
    key: int
    in_key: F64
    heard: Touch

    @property
    def reach_m(self) -> float:
        """The farthest that it says anything about."""
        return TOUCH_REACH_M
