"""Scenes in the daemon: collected while driving, told of in `map/scenes`, asked by `@rpc/where_am_i`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mapping.features.scenes import Answer, Candidate, SceneDatabase, sight_of
from mapping.features.stretch import Stretch
from mapping.frames import Pose2, wrap_angle
from mapping.lines.extract import are_in_order
from mapping.scan import Scan, seen_from
from service.map_makers import MapView, Tile
from service.outputs import DocumentOut, Output
from service.rpc import CallRefused

F64 = NDArray[np.float64]

KEY = "map/scenes"
SKIP_NEWEST: Final = 10
_NEWEST_MAX: Final = 200  # scenes that the document lists one by one
_HEAD_TILE: Final = (0, 0)  # how many scenes there are; scene n is tile (n, 1)


@dataclass(frozen=True, slots=True)
class _Swept:
    """A sweep and the poses of its beams, (N, 3) or (1, 3), as it came. middle: the pose from which it is looked at."""

    scan: Scan
    poses: F64
    middle: Pose2


class SceneMaker:
    """A SceneDatabase as a map maker: a sweep becomes a scene where the laser has come to a new place, and the newest
    sweeps of each laser are kept to answer where the robot is.

    A sweep is looked at where the robot has moved, and the newest one when somebody asks: most are replaced unseen.
    """

    def __init__(
        self,
        base_from_laser: Mapping[str, Pose2],
        *,
        most: int = 5000,
        period_ns: int = 5_000_000_000,
        step_m: float = 0.4,
        step_rad: float = math.radians(20.0),
    ) -> None:
        """base_from_laser: where the lasers that feed it sit.  most: scenes that are kept; later ones are counted and
        left out.  step_m, step_rad: how far a laser must have moved or turned from its last scene."""
        self.name = "scenes"
        self.sources = frozenset(base_from_laser)
        self.period_ns = period_ns
        self._base_from_laser = dict(base_from_laser)
        self._step_m, self._step_rad = step_m, step_rad
        self.database = SceneDatabase(most=most)
        self._last: dict[str, Pose2] = {}
        self._stretches: dict[str, Stretch] = {}
        self._unseen: dict[str, _Swept] = {}  # the newest sweeps that nobody has looked at, the newest last
        self._newest_source = ""
        self._version, self._told_version = 0, 0
        self._kept, self._kept_version = 0, 0
        self._left_out = 0

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Keep one sweep, and remember it as a scene if it was taken at a new place.

        map_from_sensor: (N, 3) the pose of every beam, or (3,) one for all; a sweep of which a pose is not known, or
        that turned so fast that its beams crossed, is left out.
        """
        poses = np.atleast_2d(np.asarray(map_from_sensor, dtype=np.float64))
        middle = Pose2(*(float(v) for v in poses[len(poses) // 2]))
        if not np.all(np.isfinite(poses)) or len(scan.bearing_rad) < 3:
            return
        self._unseen.pop(source, None)
        self._unseen[source] = _Swept(scan, poses, middle)
        is_new_place = self._has_moved(source, middle) and not self.database.covers(middle)
        stretch = self._stretches.get(source)
        if not is_new_place and stretch is not None and not stretch.would_keep(middle):
            return
        still = self._look(source)
        if still is None or not is_new_place:
            return
        self._last[source] = middle
        sight = sight_of(still)
        if len(sight.graph) == 0:
            return
        if self.database.add(sight, middle) is None:
            self._left_out += 1
        else:
            self._version += 1

    def _look(self, source: str) -> Scan | None:
        """The newest sweep of a laser as seen from one pose, kept from now on; None if it can tell nothing."""
        swept = self._unseen.pop(source)
        still = swept.scan if len(swept.poses) == 1 else _as_seen_from(swept.middle, swept.scan, swept.poses)
        if still is None or not are_in_order(still.bearing_rad):  # kept in few bits, or turned fast
            return None
        self._stretches.setdefault(source, Stretch()).take(still, swept.middle)
        self._newest_source = source
        return still

    def _look_at_newest(self) -> None:
        for source in list(self._unseen):
            self._look(source)

    def make(self, view: MapView) -> list[Output]:
        """The summary, if a scene has come or gone since it was last told."""
        if self._version == self._told_version:
            return []
        self._told_version = self._version
        return [DocumentOut(KEY, view.stamp_ns, self._fields())]

    def where_am_i(self, arguments: Mapping[str, Any]) -> dict[str, object]:
        """The answer to `@rpc/where_am_i`, of the newest sweep and the anchors of the last metres.

        arguments: {"laser": NAME} to ask by one of several; {"skip_newest": N}: so many of the newest scenes do not
        count (SKIP_NEWEST), as a robot that was carried away has just put them at wrong poses.
        CallRefused if there is no such laser, or none has been heard yet.
        """
        self._look_at_newest()
        skip = arguments.get("skip_newest", SKIP_NEWEST)
        if not isinstance(skip, int) or isinstance(skip, bool) or skip < 0:
            raise CallRefused(f"skip_newest is a number of scenes, 0 or more, not {skip!r}")
        source = arguments.get("laser", self._newest_source)
        if not isinstance(source, str) or (source and source not in self.sources):
            raise CallRefused(f"no laser {source!r} feeds the scenes; there are {', '.join(sorted(self.sources))}")
        stretch = self._stretches.get(source)
        sight = None if stretch is None else stretch.sight()
        if stretch is None or sight is None:
            raise CallRefused("no scan has come yet: a laser must run, and odometry with it")
        graph = stretch.graph()
        answer = self.database.where_am_i(sight, on_the_way=graph, skip_newest=skip)
        return answer_fields(answer, self._base_from_laser[source].inverse()) | {
            "laser": source,
            "anchors": len(graph),
            "scenes": len(self.database),
        }

    def changed_tiles(self) -> list[Tile]:
        """Scenes that came since the last call, and how many there are now."""
        if self._version == self._kept_version:
            return []
        new = range(self._kept, len(self.database))
        self._kept, self._kept_version = len(self.database), self._version
        head = (*_HEAD_TILE, len(self.database).to_bytes(4, "little"))
        return [head, *((number, 1, self.database.scene_bytes(number)) for number in new)]

    def restore(self, tiles: Iterable[Tile]) -> None:
        """Go on with stored scenes. ValueError if they are damaged."""
        stored = {(row, column): payload for row, column, payload in tiles}
        self.start_anew()
        head = stored.get(_HEAD_TILE)
        count = 0 if head is None else int.from_bytes(head, "little")
        if count > len(stored):
            raise ValueError(f"{count} scenes are told of, {len(stored) - 1} are there")
        for number in range(count):
            self.database.add_bytes(stored.get((number, 1), b""))
        self._kept = len(self.database)

    def start_anew(self) -> None:
        """Forget the scenes: the map was corrected or replaced. The newest sweeps stay, they say what is seen now."""
        self.database = SceneDatabase(self.database.rules, most=self.database.most)
        self._last.clear()
        self._look_at_newest()
        for stretch in self._stretches.values():
            stretch.begin_anew()
        self._kept, self._left_out = 0, 0
        self._version += 1

    def _has_moved(self, source: str, pose: Pose2) -> bool:
        last = self._last.get(source)
        if last is None:
            return True
        way = math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        return way >= self._step_m or abs(wrap_angle(pose.yaw_rad - last.yaw_rad)) >= self._step_rad

    def _fields(self) -> dict[str, object]:
        count = len(self.database)
        newest = range(max(0, count - _NEWEST_MAX), count)
        return {
            "frame": "map",
            "version": self._version,
            "scenes": count,
            "anchors": self.database.anchors,
            "most": self.database.most,
            "left_out": self._left_out,
            "newest": [
                {"scene": k, **_pose_fields(self.database.pose(k)), "anchors": len(self.database.graph(k))}
                for k in newest
            ],
        }


def answer_fields(answer: Answer, sensor_from_base: Pose2) -> dict[str, object]:
    """An answer as JSON: known, reason, place and candidates, the best first, as poses of the robot's base."""
    candidates = [_candidate_fields(each, sensor_from_base) for each in answer.candidates]
    return {
        "known": answer.place is not None,
        "reason": answer.reason,
        "frame": "map",
        "place": None if answer.place is None else _candidate_fields(answer.place, sensor_from_base),
        "candidates": candidates,
    }


def _candidate_fields(candidate: Candidate, sensor_from_base: Pose2) -> dict[str, object]:
    return {
        **_pose_fields(candidate.map_from_sensor @ sensor_from_base),
        "score": round(candidate.score, 4),
        "explained": round(candidate.explained, 4),
        "refuted": round(candidate.refuted, 4),
        "anchors": candidate.partners,
        "scene": candidate.scene,
    }


def _pose_fields(pose: Pose2) -> dict[str, float]:
    return {"x_m": round(pose.x_m, 4), "y_m": round(pose.y_m, 4), "yaw_rad": round(pose.yaw_rad, 6)}


def _as_seen_from(middle: Pose2, scan: Scan, poses: F64) -> Scan | None:
    """A sweep taken while moving, as it would have been seen from one pose; None if its beams cross there."""
    if len(poses) != len(scan.bearing_rad):
        return None
    if np.abs(poses[-1] - poses[0]).max(initial=0.0) < 1e-6 and np.ptp(poses, axis=0).max() < 1e-6:
        return scan
    bearing, distance = seen_from(middle, scan, poses)
    # A beam without a range may end up beside its neighbours' order; where it does, it tells nothing.
    order = np.sign(scan.bearing_rad[-1] - scan.bearing_rad[0])
    if len(bearing) < 3:
        return None
    onward = np.diff(bearing) * order > 0.0
    kept = np.isfinite(scan.range_m)
    kept[1:-1] |= onward[:-1] & onward[1:]
    kept[0] |= onward[0]
    kept[-1] |= onward[-1]
    bearing, distance = bearing[kept], distance[kept]
    if len(bearing) < 3 or not np.all(np.diff(bearing) * order > 0.0):
        return None
    return Scan(scan.stamp_ns, 0.0, bearing, distance, scan.range_min_m, scan.range_max_m)
