"""What an ultrasonic echo proves about the cells of its cone, and when it is believed (S29).

An echo says: the nearest thing in the cone is r away, in some direction of the cone. So the cells of the arc at r get
evidence for an obstacle, most on the axis; the cells nearer than the arc get evidence for free space, which fades
towards the edges of the cone and towards the arc. No echo (+inf) says less, for a smooth wall seen at a slant throws
the sound away: it clears a short and narrow inner part, weakly. Too close (-inf) is an obstacle at range_min_m and
clears nothing.

Lies are the rule with sonars, so one reading proves nothing:

- Cross-talk and stray echoes differ from ping to ping. A reading is used when enough of the transducer's latest
  readings agree with it: two of three for an echo, three of three for "nothing there". Two echoes agree when they
  differ by no more than a tolerance plus the way the transducer moved in between, which is the most by which the
  distance to a fixed thing can change.
- A neighbour that hears nothing, or hears something farther away, must not wipe out what the first one sees: the
  latest arc of every other transducer is left alone by free evidence until that transducer itself says otherwise, or
  has said nothing for GUARD_READINGS readings of the others.

- An echo whose range is that of an obstacle which the laser knows in the cone has its reason: no other cell of the arc
  gets evidence for an obstacle. What is left speaks of things that the laser does not see (glass, table edges, what is
  above or below its plane); without this rule every wall grows arcs on both sides of what the cone really touched.

The evidence is a layer of its own, log-odds within narrow bounds: however often a cone looks through a laser's wall,
the wall stays (`mapping.kernels.grids.percent_of_tile` joins the two).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels.sonar_cones import SONAR_STEP

F64 = NDArray[np.float64]

GUARD_READINGS: Final = 64
MAX_TRANSDUCERS: Final = 256


@dataclass(frozen=True, slots=True)
class SonarRules:
    """How much a cone's evidence weighs (log-odds) and how readings are believed.

    arc_half_m: half the thickness of the arc (range noise; at least one cell is used).  explain_m: how much farther off
    the arc a laser's obstacle may lie and still be the reason of the echo.  edge_share: what part of the
    arc's evidence is left at the edge of the cone.  no_return_share: how much of range_max_m, of the opening angle
    and of the free weight is used when nothing was heard.  echo_votes, silence_votes: of the last `memory` readings.
    """

    occupied_log_odds: float = 0.6
    free_log_odds: float = 0.3
    lowest_log_odds: float = -1.75
    highest_log_odds: float = 2.5
    edge_share: float = 0.4
    arc_half_m: float = 0.05
    explain_m: float = 0.1
    no_return_share: float = 0.5
    memory: int = 3
    echo_votes: int = 2
    silence_votes: int = 3
    agree_m: float = 0.1

    def __post_init__(self) -> None:
        if not (1 <= self.echo_votes <= self.memory and 1 <= self.silence_votes <= self.memory <= 64):
            raise ValueError("votes are 1 to memory, memory at most 64")
        if not (self.lowest_log_odds < 0.0 < self.highest_log_odds <= 127 * SONAR_STEP):
            raise ValueError(f"log-odds bounds are below and above 0, at most {127 * SONAR_STEP:.3f}")
        if self.lowest_log_odds < -127 * SONAR_STEP or not 0.0 <= self.edge_share <= 1.0:
            raise ValueError(f"log-odds are at least {-127 * SONAR_STEP:.3f}, edge_share 0 to 1")
        if not 0.0 < self.no_return_share <= 1.0 or min(self.agree_m, self.arc_half_m, self.explain_m) < 0.0:
            raise ValueError("no_return_share is above 0 and at most 1, lengths are not negative")
        if self.occupied_log_odds < 0.0 or self.free_log_odds < 0.0:
            raise ValueError("weights are not negative")


class EchoFilter:
    """Believes a reading of one transducer when its latest readings agree."""

    def __init__(self, rules: SonarRules) -> None:
        self._rules = rules
        self._latest: deque[tuple[float, float, float]] = deque(maxlen=rules.memory)  # range, x, y

    def believe(self, range_m: float, x_m: float, y_m: float) -> bool:
        """Take the next reading, with the transducer's place; whether it may be used.

        NaN is never believed and is no vote; -inf needs as many votes as an echo and agrees with -inf only.
        """
        if math.isnan(range_m):
            return False
        self._latest.append((range_m, x_m, y_m))
        votes = sum(self._agree(range_m, x_m, y_m, other) for other in self._latest)
        needed = self._rules.silence_votes if range_m == math.inf else self._rules.echo_votes
        return votes >= needed

    def _agree(self, range_m: float, x_m: float, y_m: float, other: tuple[float, float, float]) -> bool:
        if not (math.isfinite(range_m) and math.isfinite(other[0])):
            return range_m == other[0]
        moved = math.hypot(x_m - other[1], y_m - other[2])
        return abs(range_m - other[0]) <= self._rules.agree_m + moved


@dataclass(frozen=True, slots=True)
class Cone:
    """One believed reading, ready for the kernel; metres, in the map. arc_m is negative without an echo."""

    x_m: float
    y_m: float
    axis_x: float
    axis_y: float
    cos_half: float
    arc_m: float
    arc_half_m: float
    free_from_m: float
    free_m: float
    free_log_odds: float


class SonarMemory:
    """All transducers of a robot: their filters, and their latest arcs as guards for each other, in cells."""

    def __init__(self, rules: SonarRules, resolution_m: float) -> None:
        self._rules = rules
        self._resolution_m = resolution_m
        self._filters: dict[Hashable, EchoFilter] = {}
        self._arcs: dict[Hashable, tuple[int, int]] = {}  # of each transducer: when it was heard, and its row
        self._rows: F64 = np.zeros((16, 7))
        self._row_of: dict[Hashable, int] = {}
        self._count = 0
        self.rejected = 0

    def believe(self, transducer: Hashable | None, range_m: float, x_m: float, y_m: float) -> bool:
        """Whether a reading may be used; without a name (None) it is taken as it is, unless it is NaN."""
        self._count += 1
        if transducer is None:
            return not math.isnan(range_m)
        if transducer not in self._filters and len(self._filters) >= MAX_TRANSDUCERS:
            raise ValueError(f"more than {MAX_TRANSDUCERS} transducers: their names must not change from ping to ping")
        echo_filter = self._filters.setdefault(transducer, EchoFilter(self._rules))
        believed = echo_filter.believe(range_m, x_m, y_m)
        self.rejected += not believed
        return believed

    def guards(self, transducer: Hashable | None) -> F64:
        """(K, 7) latest arcs of the other transducers, as the kernel takes them."""
        fresh = self._count - GUARD_READINGS
        rows = [row for name, (at, row) in self._arcs.items() if at > fresh and name != transducer]
        return self._rows[rows]

    def remember(self, transducer: Hashable | None, cone: Cone) -> None:
        """A believed reading replaces the transducer's arc; with no echo it takes it away."""
        if transducer is None:
            return
        if cone.arc_m < 0.0:
            self._arcs.pop(transducer, None)
            return
        row = self._row_of.setdefault(transducer, len(self._row_of))
        if row == len(self._rows):
            self._rows = np.concatenate((self._rows, np.zeros_like(self._rows)))
        d = self._resolution_m
        self._rows[row] = (
            cone.x_m / d, cone.y_m / d, cone.axis_x, cone.axis_y, cone.cos_half, cone.arc_m / d, cone.arc_half_m / d,
        )  # fmt: skip
        self._arcs[transducer] = (self._count, row)


def cone_of_reading(
    rules: SonarRules,
    map_from_sensor: Pose2,
    range_m: float,
    *,
    cone_rad: float,
    range_min_m: float,
    range_max_m: float,
    resolution_m: float,
    clear_no_return: bool,
) -> Cone | None:
    """What a believed reading says about which cells; None if nothing.

    range_m as everywhere: +inf nothing heard, -inf too close, NaN invalid; beyond range_max_m or negative: nothing.
    """
    half = cone_rad / 2.0
    arc_half = max(rules.arc_half_m, resolution_m)
    arc, free, weight = -1.0, 0.0, rules.free_log_odds
    if 0.0 <= range_m <= range_max_m:
        arc = range_m
        # One cell's diagonal more, so that no cell that the arc touches is cleared.
        free = range_m - arc_half - resolution_m * math.sqrt(0.5)
    elif range_m == math.inf and clear_no_return:
        half *= rules.no_return_share
        free = range_max_m * rules.no_return_share
        weight *= rules.no_return_share
    elif range_m == -math.inf and range_min_m > 0.0:
        arc = range_min_m
    else:
        return None
    return Cone(
        x_m=map_from_sensor.x_m,
        y_m=map_from_sensor.y_m,
        axis_x=math.cos(map_from_sensor.yaw_rad),
        axis_y=math.sin(map_from_sensor.yaw_rad),
        cos_half=math.cos(half),
        arc_m=arc,
        arc_half_m=arc_half,
        free_from_m=range_min_m,
        free_m=free,
        free_log_odds=weight,
    )
