"""What the ground is like in each sector of the polar maps (S37): added to their documents on the way out.

The sector maps are made without it, so that they depend on nothing that another thread makes and a replay is the same;
without an elevation map nothing is added and nothing is computed. Unknown is null: before the first cloud, when the
clouds have stopped, while the pose is old, and after the map was moved until there are clouds from after that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2, wrap_angle
from mapping.grids.height import Ground
from mapping.sectors.footprint import in_polygon
from mapping.sectors.ground import SectorGround, ground_in_sectors
from mapping.sectors.snapshot import PolarSnapshot
from service.elevation_maker import ElevationMaker, KnownGround
from service.outputs import Output, PolarOut, PoseOut

F64 = NDArray[np.float64]

_SAME_M = 0.02
_SAME_RAD = math.radians(0.5)
_MOVED_M = 0.1  # between two poses: the map was corrected, not followed
_MOVED_RAD = math.radians(2.0)
_POSE_OLD_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class _Told:
    known: KnownGround
    map_from_base: Pose2
    edges_rad: F64
    ground: SectorGround


class SectorGroundTeller:
    """Adds the ground to polar outputs. All calls come from the thread that publishes sectors.

    footprint: (N, 2) in the base frame.  hidden_m: so far around an origin inside of it the ground cannot be seen, and
    nothing is asked; None: to its farthest corner.  reach_m: how far beyond that the ground is looked at.
    stale_ns: an elevation map older than that is none.
    """

    def __init__(
        self,
        maker: ElevationMaker,
        *,
        footprint: ArrayLike,
        reach_m: float,
        stale_ns: int,
        hidden_m: float | None = None,
    ) -> None:
        self._maker = maker
        self._footprint = np.asarray(footprint, dtype=np.float64)
        self._reach_m, self._hidden = reach_m, hidden_m
        self._stale_ns = stale_ns
        self._pose: PoseOut | None = None
        self._moved_ns = 0
        self._told: dict[str, _Told] = {}

    def with_ground(self, output: Output) -> Output:
        """A polar output with its ground; any other as it is."""
        match output:
            case PoseOut():
                self._follow(output)
            case PolarOut():
                return replace(output, ground=self._ground_of(output.name, output.snapshot))
        return output

    def _follow(self, pose: PoseOut) -> None:
        last, self._pose = self._pose, pose
        if last is not None and _is_apart(last.map_from_odom, pose.map_from_odom, _MOVED_M, _MOVED_RAD):
            self._maker.forget_before(pose.stamp_ns)
            self._moved_ns = pose.stamp_ns

    def _ground_of(self, name: str, snapshot: PolarSnapshot) -> SectorGround:
        known = self._maker.newest
        count = len(snapshot.edges_rad) - 1
        if known is None or known.since_ns < self._moved_ns or snapshot.stamp_ns - known.stamp_ns > self._stale_ns:
            return _unknown(count)
        pose = self._pose
        if pose is not None and snapshot.stamp_ns - pose.stamp_ns > _POSE_OLD_NS:
            return _unknown(count)
        map_from_base = known.map_from_base if pose is None else pose.map_from_base  # without a pose it stands
        told = self._told.get(name)
        if (
            told is None
            or told.known is not known
            or _is_apart(told.map_from_base, map_from_base, _SAME_M, _SAME_RAD)
            or not np.array_equal(told.edges_rad, snapshot.edges_rad)
        ):
            ground = self._look(known, map_from_base, snapshot)
            told = self._told[name] = _Told(known, map_from_base, snapshot.edges_rad, ground)
        return told.ground

    def _look(self, known: KnownGround, map_from_base: Pose2, snapshot: PolarSnapshot) -> SectorGround:
        blind_m = self._hidden_m(snapshot.base_from_sensor)
        found = ground_in_sectors(
            known.elevation,
            map_from_base @ snapshot.base_from_sensor,
            snapshot.edges_rad,
            reach_m=blind_m + self._reach_m,
            blind_m=blind_m,
        )
        seen = ~np.isnan(found.slope_rad)
        unsaid = ~seen & (found.stopped_by == Ground.TRAVERSABLE)  # no cell at all
        stopped_by = np.where(unsaid, np.int8(Ground.UNKNOWN), found.stopped_by)
        return replace(found, traversable_m=np.where(seen, found.traversable_m, 0.0), stopped_by=stopped_by)

    def _hidden_m(self, base_from_sensor: Pose2) -> float:
        """How far around a virtual sensor the vehicle stands; one that looks from elsewhere sees all."""
        origin = np.array((base_from_sensor.x_m, base_from_sensor.y_m))
        if not in_polygon(origin, self._footprint)[0]:
            return 0.0
        if self._hidden is not None:
            return self._hidden
        return float(np.hypot(*(self._footprint - origin).T).max())


def _unknown(count: int) -> SectorGround:
    return SectorGround(np.zeros(count), np.full(count, Ground.UNKNOWN, dtype=np.int8), np.full(count, np.nan))


def _is_apart(one: Pose2, other: Pose2, way_m: float, turn_rad: float) -> bool:
    way = math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)
    return way > way_m or abs(wrap_angle(one.yaw_rad - other.yaw_rad)) > turn_rad
