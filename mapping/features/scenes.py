"""Scenes and where they were seen (S25): anchor graphs propose, points prove.

    database = SceneDatabase()
    database.add(sight_of(scan), map_from_sensor)             # while driving
    answer = database.where_am_i(sight_of(scan))              # after start-up, or having been carried away
    answer.place                                              # None: unknown

An index over distances holds every edge of every stored graph by its length and by how the walls at its ends run.
Edges of the query look theirs up, longest first, and each pair found votes for the pose that it implies in the frame of
that scene. The best poses are settled on their correspondences, held against the scene's points, then laid on all
scenes around (mapping.localise). A place is told only if the scan fits it well and nowhere else nearly so.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mapping.features.anchors import AnchorFinder, AnchorRules, Anchors
from mapping.features.graph import AnchorGraph, anchor_graph
from mapping.features.histograms import box_feature, square_scene
from mapping.features.moments import arc_weights, centre_of_gravity, smoothed_inertia
from mapping.features.vectors import Feature, FeatureSpace, Scale
from mapping.frames import Pose2, wrap_angle, wrap_angles
from mapping.kernels import features as kernels
from mapping.kernels.localise_table import EMPTY
from mapping.localise.scan_match import agreement, match_view
from mapping.localise.views import BearingTable, KeptViews, View, ViewStore, alone, fill_normals, table_for, view_of
from mapping.scan import Scan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]

FARTHEST_M: Final = 25.0
MOST_SCENES: Final = 20_000

# The index.
_STEP_M: Final = 0.3
_TURNS: Final = 24
_SHORTEST_M: Final = 0.8
_LONGEST_M: Final = 2.0 * FARTHEST_M
_BINS: Final = math.ceil(_LONGEST_M / _STEP_M) * _TURNS * _TURNS * 4
_TAIL: Final = 64  # scenes that wait in a small index before the large one is made anew

_REFERENCES: Final = 2  # scenes that a sight is laid on; twice as many tell how it fits
_GLANCE_MARGIN: Final = 0.35  # places that fit worse than the best by more, at a glance, are not looked at again

# Voting.
_BIN_M: Final = 0.5
_BIN_RAD: Final = math.radians(12.0)
_SLOTS: Final = 1 << 15
_MOST_VOTES: Final = 30_000

SCENE_FEATURES: Final = FeatureSpace(
    [
        Feature("mean_distance_m", high=10.0),
        Feature("axis_ratio"),
        Feature("orientation_share"),
        Feature("box_long_m", high=20.0),
        Feature("box_short_m", high=20.0),
        Feature("has_box", Scale.UNORDERED),
    ]
)


@dataclass(frozen=True, slots=True)
class Sight:
    """One scan, as scenes are compared. graph: its anchors, sensor frame.  view: its points for matching.
    vector: (6,) normalised features (SCENE_FEATURES)."""

    graph: AnchorGraph
    view: View
    vector: F64


def sight_of(scan: Scan, rules: AnchorRules | None = None) -> Sight:
    """What is to be remembered of a scan, or looked for.

    A scan without points is a sight without anchors: it is recognised nowhere.  ValueError if its bearings neither rise
    nor fall throughout, or are fewer than three.
    """
    finder = AnchorFinder(scan.bearing_rad, rules, range_min_m=scan.range_min_m, range_max_m=scan.range_max_m)
    view = view_of(scan, table_for(scan.bearing_rad), farthest_m=FARTHEST_M)
    return Sight(anchor_graph(finder.find(scan.range_m)), view, scene_vector(_points(view)))


def scene_vector(points: F64) -> F64:
    """Features of points (N, 2) in order of bearing, sensor frame: normalised SCENE_FEATURES (S14 to S17, S23, S24)."""
    if len(points) < 3 or not np.ptp(points, axis=0).max() > 0.0:
        return np.zeros(len(SCENE_FEATURES))
    weight = arc_weights(points)
    weight = weight if weight.sum() > 0.0 else np.ones(len(points))
    centre = centre_of_gravity(points, weight=weight)
    mean = float(np.sum(weight * np.hypot(*(points - centre).T)) / np.sum(weight))
    square = square_scene(points)
    box = None if square is None else box_feature(square)
    values = [
        mean,
        smoothed_inertia(points, weight=weight).axis_ratio,
        0.0 if square is None else square.share,
        *((0.0, 0.0, 0.0) if box is None else (*box.size_m, 1.0)),
    ]
    return SCENE_FEATURES.normalised(np.array(values))


def _points(view: View) -> F64:
    hit = view.quality > EMPTY
    return np.stack((view.x[hit], view.y[hit]), axis=-1).astype(np.float64)


@dataclass(frozen=True, slots=True)
class RecogniseRules:
    """What it takes to say where one is.

    tolerance_m, near_m, turn_deg: as in MatchRules.  most_proposals: poses taken from the vote.  most_places: places
    that are looked at; most_matched: those of them that the scan is laid on.
    least_score: the share of points that lie on what the scenes around saw, less the share in space they saw through.
    least_lead: by how much the best place must fit better than any other, apart_m or apart_deg away.
    least_partners: anchors that must have partners.
    """

    tolerance_m: float = 0.15
    near_m: float = 0.25
    turn_deg: float = 10.0
    most_proposals: int = 100
    most_places: int = 16
    most_matched: int = 6
    least_score: float = 0.7
    least_lead: float = 0.1
    least_partners: int = 2
    apart_m: float = 0.6
    apart_deg: float = 8.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = float(getattr(self, each.name))
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{each.name} must be a number above 0, got {value}")


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place that a sight may have been seen from.

    map_from_sensor: its pose.  scene: the stored scene that proposed it.  partners: anchors with partners there.
    score: explained less refuted.  explained: share of points on what the scenes around saw; refuted: in space they saw
    through.
    """

    map_from_sensor: Pose2
    scene: int
    partners: int
    score: float
    explained: float
    refuted: float


@dataclass(frozen=True, slots=True)
class Answer:
    """place: None is an answer too: unknown, and reason says why.  candidates: the best first."""

    place: Candidate | None
    candidates: tuple[Candidate, ...]
    reason: str


class DistanceIndex:
    """Edges of the graphs of some scenes, by length and by how the walls at their ends run."""

    def __init__(self, graphs: Iterable[AnchorGraph], scenes: range) -> None:
        """scenes: the numbers of the graphs in the database."""
        rows = [np.empty((0, kernels.ROW)), *(graph.anchors.rows for graph in graphs)]
        sizes = np.array([len(each) for each in rows[1:]], dtype=np.int64)
        self.scenes = scenes
        self._first = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
        self._anchors = np.ascontiguousarray(np.concatenate(rows))
        room = int(np.sum(4 * sizes * (sizes - 1)))
        keys, entries = np.empty(room, dtype=np.int64), np.empty((room, 3), dtype=np.int32)
        count = kernels.index_entries(
            self._anchors, self._first, np.arange(len(sizes)), _SHORTEST_M, _LONGEST_M, _STEP_M, _TURNS, keys, entries
        )
        order = np.argsort(keys[:count], kind="stable")
        self._entries: I32 = entries[:count][order]
        self._starts: I32 = np.searchsorted(keys[:count][order], np.arange(_BINS + 1)).astype(np.int32)

    @property
    def memory_bytes(self) -> int:
        """What its arrays hold."""
        return sum(a.nbytes for a in (self._anchors, self._first, self._entries, self._starts))

    def propose(self, query: AnchorGraph, rules: RecogniseRules) -> list[tuple[int, int, float, Pose2]]:
        """(scene, partners, weight of votes, scene_from_query) of the best poses, most partners first."""
        if not len(query.edges) or not len(self._entries):
            return []
        turn_rad = math.radians(rules.turn_deg)
        key, where = np.zeros(_SLOTS, dtype=np.int64), np.zeros(_SLOTS, dtype=np.int64)
        last, sums = np.zeros(_SLOTS, dtype=np.int64), np.zeros((_SLOTS, 5))
        kernels.vote(
            query.anchors.rows, query.edges, query.length_m, self._anchors, self._first, self._starts, self._entries,
            _STEP_M, _TURNS, _SHORTEST_M, rules.tolerance_m, turn_rad, _BIN_M, _BIN_RAD, _MOST_VOTES, key, where, last,
            sums,
        )  # fmt: skip
        used = np.flatnonzero(last)
        best = used[np.lexsort((key[used], -sums[used, 4]))[: rules.most_proposals]]
        weight = sums[best, 4]
        turns = np.arctan2(sums[best, 3], sums[best, 2])
        poses = np.stack((sums[best, 0] / weight, sums[best, 1] / weight, turns), axis=-1)
        count, squares = np.zeros(len(best), dtype=np.int64), np.zeros(len(best))
        kernels.settle_proposals(
            query.anchors.rows, self._anchors, self._first, where[best], poses, rules.near_m, turn_rad, count, squares
        )
        return [
            (
                self.scenes.start + int(where[best[k]]),
                int(count[k]),
                float(weight[k]),
                Pose2(float(poses[k, 0]), float(poses[k, 1]), wrap_angle(float(poses[k, 2]))),
            )
            for k in np.lexsort((squares, -count))
        ]


class SceneDatabase:
    """Scenes with the poses they were seen from. The same scenes in the same order give the same answers."""

    def __init__(self, rules: RecogniseRules | None = None, *, most: int = MOST_SCENES) -> None:
        """most: a database that is full takes no more (`add` returns None)."""
        self.rules = rules or RecogniseRules()
        self.most = most
        self._graphs: list[AnchorGraph] = []
        self._views = ViewStore(open_most=most)  # any of them may be looked at next
        self._poses: F64 = np.empty((0, 3))
        self._vectors: F64 = np.empty((0, len(SCENE_FEATURES)))
        self._indexes: list[DistanceIndex] = []

    def __len__(self) -> int:
        return len(self._graphs)

    @property
    def anchors(self) -> int:
        """Of all scenes."""
        return sum(len(graph) for graph in self._graphs)

    @property
    def memory_bytes(self) -> int:
        """What arrays hold."""
        graphs = sum(graph.anchors.rows.nbytes for graph in self._graphs)
        arrays = self._poses.nbytes + self._vectors.nbytes + graphs
        return arrays + self._views.memory_bytes + sum(index.memory_bytes for index in self._indexes)

    def pose(self, scene: int) -> Pose2:
        """From where a scene was seen: map_from_sensor.  IndexError if there is no such scene."""
        return Pose2(*(float(v) for v in self._poses[: len(self)][scene]))

    def graph(self, scene: int) -> AnchorGraph:
        """Of a scene; IndexError if there is no such scene."""
        return self._graphs[scene]

    def covers(self, pose: Pose2, *, near_m: float = 0.3, near_rad: float = math.radians(15.0)) -> bool:
        """Whether a scene was taken from about there."""
        place, turn = self.apart(pose)
        return bool(np.any((place <= near_m) & (turn <= near_rad)))

    def apart(self, pose: Pose2) -> tuple[F64, F64]:
        """How far (N,) [m] and turned (N,) [rad] every scene's pose is from another."""
        poses = self._poses[: len(self)]
        place = np.hypot(poses[:, 0] - pose.x_m, poses[:, 1] - pose.y_m)
        return place, np.abs(wrap_angles(poses[:, 2] - pose.yaw_rad))

    def add(self, sight: Sight, map_from_sensor: Pose2) -> int | None:
        """Remember a scene; its number, from 0.  None if the database is full.  ValueError for a pose that is none."""
        at = (map_from_sensor.x_m, map_from_sensor.y_m, map_from_sensor.yaw_rad)
        if not all(math.isfinite(v) for v in at):
            raise ValueError(f"a scene needs a pose of finite numbers, got {map_from_sensor}")
        number = len(self)
        if number >= self.most:
            return None
        if number == len(self._poses):
            room = max(64, number // 2)
            self._poses = np.concatenate((self._poses, np.zeros((room, 3))))
            self._vectors = np.concatenate((self._vectors, np.zeros((room, len(SCENE_FEATURES)))))
        self._poses[number], self._vectors[number] = at, sight.vector
        self._graphs.append(sight.graph)
        self._views.add(sight.view)
        return number

    def similar(self, vector: F64, most: int = 8) -> list[tuple[int, float]]:
        """Scenes by distance of their feature vectors, nearest first: (scene, distance in [0, sqrt(k)])."""
        distance = SCENE_FEATURES.distance(self._vectors[: len(self)], vector)
        return [(int(k), float(distance[k])) for k in np.argsort(distance, kind="stable")[:most]]

    def where_am_i(self, sight: Sight, *, on_the_way: AnchorGraph | None = None, skip_newest: int = 0) -> Answer:
        """From where a sight was seen, without a hint.

        on_the_way: anchors seen on the last metres, the sight's among them, in its frame (mapping.features.stretch).
        They are asked first, then those of the sight alone; what they propose is proved by the sight's points.
        skip_newest: so many of the newest scenes are not looked at. A robot that was carried away puts what it sees now
        at wrong poses, which must not vouch for themselves.

        Unknown, with a reason, if there are no scenes, no edges to look for, nothing that fits well, or two places
        that fit alike.  Cost: votes (edges of equal length and walls; bounded) and a fixed number of places.
        """
        if skip_newest < 0:
            raise ValueError(f"skip_newest must be >= 0, got {skip_newest}")
        count = len(self) - skip_newest
        if count <= 0:
            return Answer(None, (), "no scenes are stored yet")
        answer = self._answer(sight, sight.graph if on_the_way is None else on_the_way, count)
        if answer.place is None and on_the_way is not None:
            alone = self._answer(sight, sight.graph, count)
            return answer if alone.place is None else alone
        return answer

    def _answer(self, sight: Sight, graph: AnchorGraph, count: int) -> Answer:
        """By the places that a graph proposes."""
        if len(graph) < 2:
            return Answer(None, (), f"too few anchor points: {len(graph)}")
        views = self._views.kept()
        proposed = self._places(graph, count)
        places = [(self._glance(sight, views, scene, at), scene, n, at) for scene, n, at in proposed]
        places.sort(key=lambda place: -place[0])
        good = [place for place in places[: self.rules.most_matched] if place[0] > places[0][0] - _GLANCE_MARGIN]
        found = [self._prove(sight, views, count, *place[1:]) for place in good]
        candidates = tuple(sorted((each for each in found if each is not None), key=lambda each: -each.score))
        return self._verdict(candidates)

    def _verdict(self, candidates: tuple[Candidate, ...]) -> Answer:
        rules = self.rules
        if not candidates:
            return Answer(None, (), "no stored scene has a part of this one")
        best = candidates[0]
        if best.score < rules.least_score:
            return Answer(None, candidates, f"nothing fits well: the best place scores {best.score:.2f}")
        if best.partners < rules.least_partners:
            return Answer(None, candidates, f"only {best.partners} anchor points have partners")
        rivals = [each.score for each in candidates if self._are_apart(best.map_from_sensor, each.map_from_sensor)]
        if rivals and best.score - max(rivals) < rules.least_lead:
            return Answer(None, candidates, f"two places fit alike: scores {best.score:.2f} and {max(rivals):.2f}")
        return Answer(best, candidates, "")

    def _places(self, query: AnchorGraph, count: int) -> list[tuple[int, int, Pose2]]:
        """(scene, partners, map_from_query) of proposals, one for each place, most partners first."""
        self._bring_index_up_to_date()
        proposals = [each for index in self._indexes for each in index.propose(query, self.rules)]
        proposals.sort(key=lambda each: (-each[1], -each[2], each[0]))
        places: list[tuple[int, int, Pose2]] = []
        for scene, partners, _, scene_from_query in proposals:
            if partners < 2 or scene >= count:
                continue
            at = self.pose(scene) @ scene_from_query
            if all(self._are_apart(at, other[2], 0.5) for other in places):
                places.append((scene, partners, at))
                if len(places) == self.rules.most_places:
                    break
        return places

    def _glance(self, sight: Sight, views: KeptViews, scene: int, at: Pose2) -> float:
        """How the sight fits the scene that proposed a place, before it is laid on it."""
        rows = np.array([scene])
        seen = agreement(sight.view, views, rows, self._poses[rows], at, near_m=0.3)
        return seen.explained - seen.refuted

    def _prove(
        self, sight: Sight, views: KeptViews, count: int, scene: int, partners: int, at: Pose2
    ) -> Candidate | None:
        """Lay the sight on those of the first `count` scenes that are around a place, and see how it fits."""
        rows = self._around(at, count, _REFERENCES)
        match = match_view(sight.view, views, rows, self._poses[rows], at)
        if match is None:
            return None
        rows = self._around(match.pose, count, 2 * _REFERENCES)
        if not len(rows):
            return None
        seen = agreement(sight.view, views, rows, self._poses[rows], match.pose)
        back = self._seen_back(sight, views, rows[:_REFERENCES], match.pose)
        score = seen.explained - seen.refuted - back
        return Candidate(match.pose, scene, partners, score, seen.explained, seen.refuted)

    def _seen_back(self, sight: Sight, views: KeptViews, rows: I64, at: Pose2) -> float:
        """Share of what the nearest scenes saw that the sight would have seen through, were it from there."""
        view = sight.view
        own = alone(view)
        pose = np.array([[at.x_m, at.y_m, at.yaw_rad]])
        total = 0.0
        for row in rows:
            seen = agreement(views.view(int(row)), own, np.array([0]), pose, self.pose(int(row)))
            total += seen.refuted
        return total / max(1, len(rows))

    def _around(self, pose: Pose2, count: int, most: int) -> I64:
        """Scenes seen from near a pose, the nearest first; a radian counts as a metre."""
        place, turn = self.apart(pose)
        cost = place + turn
        near = np.flatnonzero(cost[:count] <= 3.5)
        return near[np.argsort(cost[near], kind="stable")[:most]]

    def _are_apart(self, a: Pose2, b: Pose2, share: float = 1.0) -> bool:
        way = math.hypot(a.x_m - b.x_m, a.y_m - b.y_m)
        turn = abs(wrap_angle(a.yaw_rad - b.yaw_rad))
        return way > share * self.rules.apart_m or turn > share * math.radians(self.rules.apart_deg)

    def _bring_index_up_to_date(self) -> None:
        """Two indexes: a large one, and one of what came since, which joins it when it is a quarter as large."""
        if sum(len(index.scenes) for index in self._indexes) == len(self):
            return
        large = len(self._indexes[0].scenes) if self._indexes else 0
        if len(self) - large > max(_TAIL, large // 4):
            large = len(self)
            self._indexes = [DistanceIndex(self._graphs, range(large))]
        if large < len(self):
            tail = DistanceIndex(self._graphs[large:], range(large, len(self)))
            self._indexes = [*self._indexes[: 1 if large else 0], tail]

    def scene_bytes(self, scene: int) -> bytes:
        """A scene to be kept: pose, points, anchors; 8 bytes a beam and 28 an anchor, deflated."""
        graph, view = self._graphs[scene], self._views.kept().view(scene)
        head = _HEAD.pack(_MAGIC, view.table.bins, len(graph), *self._poses[scene], *view.table.frame())
        filled = view.quality > EMPTY
        body = (
            np.where(filled, view.x, np.nan).astype("<f4").tobytes(),
            np.where(filled, view.y, np.nan).astype("<f4").tobytes(),
            graph.anchors.rows.astype("<f4").tobytes(),
        )
        return head + zlib.compress(b"".join(body), 1)

    def add_bytes(self, payload: bytes) -> int | None:
        """Take up what scene_bytes gave out, as `add` does.  ValueError if the bytes are something else."""
        return self.add(*_unpacked(payload))


_MAGIC: Final = b"S1"
_HEAD: Final = struct.Struct("<2sII3d4d")
_MOST_BEAMS: Final = 4096
_MOST_ANCHORS: Final = 256


def _unpacked(payload: bytes) -> tuple[Sight, Pose2]:
    try:
        magic, bins, count, x, y, yaw, first, width, again, closed = _HEAD.unpack_from(payload)
        if magic != _MAGIC or not 0 < bins <= _MOST_BEAMS or count > _MOST_ANCHORS or again != bins:
            raise ValueError(f"{magic!r}, {bins} beams, {count} anchors")
        if not (all(math.isfinite(v) for v in (x, y, yaw, first, closed)) and 0.0 < width <= 1.0):
            raise ValueError("a number in it is none")
        size = 8 * bins + 4 * kernels.ROW * count
        body = zlib.decompressobj().decompress(payload[_HEAD.size :], size + 1)
        if len(body) != size:
            raise ValueError(f"{len(body)} bytes instead of {size}")
    except (struct.error, zlib.error, ValueError) as error:
        raise ValueError(f"not a scene: {error}") from error
    numbers = np.frombuffer(body, dtype="<f4").astype(np.float32)
    px, py = numbers[:bins].copy(), numbers[bins : 2 * bins].copy()
    rows = numbers[2 * bins :].astype(np.float64).reshape(count, kernels.ROW)
    known = rows[:, [kernels.X, kernels.Y, kernels.KIND, kernels.LENGTH, kernels.BEAM]]
    if not (np.all(np.abs(known) < 1e5) and np.all(np.abs(np.nan_to_num(rows)) < 1e5)):
        raise ValueError("not a scene: an anchor lies nowhere")
    filled = (np.abs(px) < 1e5) & (np.abs(py) < 1e5)
    px[~filled], py[~filled] = 0.0, 0.0
    table = BearingTable(first, width, bins, closed > 0.0)
    quality = np.where(filled, 0.0, EMPTY).astype(np.float32)
    nx, ny = np.zeros(bins, dtype=np.float32), np.zeros(bins, dtype=np.float32)
    normals = fill_normals(px, py, table.frame(), nx, ny, quality)
    view = View(table, px, py, nx, ny, quality, int(filled.sum()), normals)
    return Sight(AnchorGraph(Anchors(rows)), view, scene_vector(_points(view))), Pose2(x, y, yaw)
