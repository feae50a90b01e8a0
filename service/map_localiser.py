"""Localisation in a known map as the daemon's localiser (`[localise] mode = "map"`): it changes no map, for it has none
to change.

The map's grid is read once and only published (`KnownMapLayer` draws nothing), no store is opened, nothing is kept.
Pose, state and candidates come from `mapping.localise.in_map`; searches run beside (`Submit`) and are taken up at a
moment that stamps decide. Until a place is sure, the correction stays what it was and its covariance says "anywhere".
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.deskew import deskew
from mapping.frames import IDENTITY, Pose2, compose_covariance
from mapping.grids.patch import GridPatch
from mapping.localise.in_map import Located as Placed
from mapping.localise.in_map import MapLocaliser, Search, SearchResult, State
from mapping.localise.known_map import BEAMS, FARTHEST_M, digest_of, known_map, points_of
from mapping.odometry import OdometryState
from mapping.pose_buffer import PoseBuffer
from mapping.scan import Scan
from service.background import Submit
from service.errors import Trouble
from service.export import load_pgm_yaml, patch_of
from service.fusion import Located, Round, StoredTile, Touch
from service.outputs import DocumentOut, GridOut, Output
from service.rpc import CallRefused

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]

KEY = "localisation"
_SCAN_GAP_NS = 40_000_000  # scans of a fast laser that come sooner say nothing new
_TELL_NS = 200_000_000
_REPUBLISH_NS = 5_000_000_000
_NEAREST_M = 0.05
_OCCUPIED = 65  # percent, as map servers have it
_DOUBTFUL = 50
_ANYWHERE: F64 = np.diag([1e6, 1e6, math.pi**2])


def read_map(path: Path) -> GridPatch:
    """The grid of a map server's pair (.yaml) or of a map file (.umfeld), on our lattice; turned origins are turned.

    The file is opened to be read only. Raises Trouble that names the file and the repair.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return patch_of(load_pgm_yaml(path))
    from service.store import MapStore, occupancy_patch

    with MapStore.open(path, wall_ns=lambda: 0, read_only=True) as store:
        return occupancy_patch(store)


def seen_by_lasers(path: Path, patch: GridPatch) -> GridPatch:
    """A map as lasers know it: what sonars alone heard (glass, table tops, edges) is taken out where it is told apart.

    A laser looks through it, and the robot would be told lost where much of it stands. patch: what read_map gives.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return patch
    from mapping.grids.occupancy import OccupancyGrid
    from service.live_map import GRID
    from service.store import MapStore

    with MapStore.open(path, wall_ns=lambda: 0, read_only=True) as store:
        made_with, tiles = store.get_meta(GRID), store.load_tiles(GRID)
    if not made_with or not tiles or made_with["resolution_m"] != patch.resolution_m:
        return patch
    grid = OccupancyGrid(resolution_m=made_with["resolution_m"], model=made_with["model"], max_tiles=len(tiles))
    try:
        for row, column, payload in tiles:
            grid.load_tile(row, column, payload, sonars=False)
    except ValueError as error:
        log.warning("%s: used as it is, sonars' obstacles among lasers': %s", path, error)
        return patch
    seen = _laid_on(grid.patch(), patch)
    return replace(patch, cells=np.where((patch.cells >= _OCCUPIED) & (seen < _DOUBTFUL), seen, patch.cells))


def _laid_on(one: GridPatch, other: GridPatch) -> NDArray[np.int8]:
    """The cells of one where the other's are; unknown where it has none."""
    cells = np.full(other.cells.shape, -1, dtype=np.int8)
    row, col = one.row0 - other.row0, one.col0 - other.col0
    rows, cols = one.cells.shape
    target = cells[max(row, 0) : max(row + rows, 0), max(col, 0) : max(col + cols, 0)]
    target[:] = one.cells[max(-row, 0) :, max(-col, 0) :][: target.shape[0], : target.shape[1]]
    return cells


class KnownMapLayer:
    """The known grid as fusion sees it: sweeps go by it (so that they reach the localiser), none is drawn."""

    def __init__(
        self, patch: GridPatch, sources: Iterable[str], *, name: str = "map", seen: GridPatch | None = None
    ) -> None:
        """seen: the map as lasers know it, where that is another; patch is what is published."""
        self.name = name
        self.patch = patch
        self.seen = patch if seen is None else seen
        self.sources = frozenset(sources)
        self._told_ns: int | None = None

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """The map is given: nothing is drawn."""

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        """Nothing is drawn."""

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        """Nothing is drawn."""

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        """The grid, whole, now and then: it never changes."""
        if self._told_ns is not None and now_ns - self._told_ns < _REPUBLISH_NS:
            return []
        self._told_ns = now_ns
        return [GridOut(stamp_ns or now_ns, 1, self.patch)]


class KnownMapLocaliser:
    """See the module's docstring and fusion.Localiser."""

    def __init__(
        self,
        patch: GridPatch,
        sources: Iterable[str],
        *,
        submit: Submit,
        start: Pose2 | None = None,
        name: str = "map",
        published: GridPatch | None = None,
    ) -> None:
        """patch: the map as lasers know it.  sources: lasers that are matched.  start: a hint where the robot is.

        name: of the map, for people.  published: the whole map, whose sum is told, if that is another.

        Raises Trouble if the map cannot be localised in.
        """
        try:
            self._known = known_map(patch)
        except ValueError as error:
            raise Trouble(f"{name}: {error}") from error
        self._digest = self._known.digest if published is None else digest_of(published)
        self._name = name
        self._sources = frozenset(sources)
        self._submit = submit
        self._localiser = MapLocaliser(self._known, start=start)
        self._map_from_odom = start or IDENTITY
        self._pending: Future[SearchResult] | None = None
        self._placed: Placed | None = None
        self._placed_odom = IDENTITY
        self._taken_ns: int | None = None
        self._told: tuple[int, State] | None = None
        self._counts = {"localise.scans": 0, "localise.scans_passed": 0, "localise.search_errors": 0}

    # --- what fusion asks

    def is_ready(self, stamp_ns: int) -> bool:
        return not (self._localiser.is_due(stamp_ns) and self._pending is not None and not self._pending.done())

    def take_odometry(self, state: OdometryState) -> None:
        """Scans are laid on the map with what they bring along."""

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        if sensor not in self._sources:
            return True
        if self._taken_ns is not None and scan.stamp_ns - self._taken_ns < _SCAN_GAP_NS:
            self._counts["localise.scans_passed"] += 1
            return True
        self._taken_ns = first_ns = scan.stamp_ns  # a search is due by the stamp that is_ready was asked about
        self._take_up(first_ns)
        swept = deskew(scan, odom_from_base, base_from_sensor)
        scan, odom = swept.scan, swept.odom_from_sensor @ base_from_sensor.inverse()
        nearest = max(_NEAREST_M, scan.range_min_m)
        points = points_of(
            scan.bearing_rad, scan.range_m, base_from_sensor, nearest_m=nearest, farthest_m=FARTHEST_M, most=BEAMS
        )  # fmt: skip
        placed = self._localiser.add_scan(first_ns, points, odom)
        self._take_placed(replace(placed, stamp_ns=scan.stamp_ns), odom)
        self._counts["localise.scans"] += 1
        work = self._localiser.take_work()
        if work is not None:
            self._pending = self._submit(work.run)
        return True

    def take_round(self, source: str, heard: Round | Touch, odom_from_base: Pose2) -> bool:
        """Sonars and switches are no help here."""
        return True

    def is_placed(self) -> bool:
        """Nothing is drawn into the map in any case; what is drawn around the robot needs no place."""
        return True

    def kept(self) -> None:
        """Nothing is kept."""

    def map_from_odom(self) -> Pose2:
        return self._map_from_odom

    def locate(self, state: OdometryState) -> Located:
        map_from_base = self._map_from_odom @ state.odom_from_base
        if self._placed is None or self._placed.state is not State.SURE:
            return Located(state.stamp_ns, map_from_base, self._map_from_odom, _ANYWHERE)
        step = self._placed_odom.inverse() @ state.odom_from_base
        at_scan = self._map_from_odom @ self._placed_odom
        covariance = compose_covariance(at_scan, self._placed.covariance, step, _step_covariance(step))
        return Located(state.stamp_ns, map_from_base, self._map_from_odom, covariance)

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """Nobody can: there is no map service in this mode."""

    def begin_map(self, map_from_odom: Pose2) -> None:
        """Nobody can, either."""

    def outputs(self, now_ns: int) -> list[Output]:
        if self._placed is None:
            return []
        stamp_ns, state = self._placed.stamp_ns, self._placed.state
        if self._told is not None and (
            stamp_ns == self._told[0] or (state is self._told[1] and stamp_ns - self._told[0] < _TELL_NS)
        ):
            return []
        self._told = (stamp_ns, state)
        return [DocumentOut(KEY, stamp_ns, {"frame": "map", **self.fields()})]

    def troubles(self) -> list[str]:
        if self._placed is None:
            return []
        match self._placed.state:
            case State.LOST:
                return [
                    f"lost: scans do not fit the place believed in (probability {self._placed.probability:.2f}); it is "
                    "looked for; drive a little, or say where with `@rpc/relocalise`"
                ]
            case State.SEARCHING:
                return [
                    f"not localised yet in {self._name}: {len(self._placed.candidates)} candidates, the best with "
                    f"probability {self._placed.probability:.2f}; drive a little"
                ]
        return []

    def counters(self) -> Mapping[str, int]:
        events = {f"localise.{name}": count for name, count in sorted(self._localiser.events.items())}
        return {**self._counts, **events}

    # --- what people ask

    def fields(self) -> dict[str, object]:
        """What is known, as JSON values: the document umfeld.localisation.v1 without frame and stamp."""
        placed = self._placed or self._localiser.located(0)
        return {**fields_of(placed), "map": {"name": self._name, "sha256": self._digest}}

    def search_for(self, arguments: Mapping[str, Any]) -> Search | None:
        """The search that a call asks for, to be run outside the fusion thread; it changes nothing here.

        None before the first scan.
        """
        return self._localiser.search_now(_hint_of(arguments))

    def start_over(self, arguments: Mapping[str, Any]) -> None:
        """Forget the place believed in; begin near a hint if there is one. For the fusion thread."""
        self._pending = None
        hint = _hint_of(arguments)
        if hint is None:
            self._localiser.relocalise()
        else:
            self._localiser.relocalise(hint[0], radius_m=hint[1])
        if self._placed is not None:
            self._placed = self._localiser.located(self._placed.stamp_ns)

    # --- inside

    def _take_up(self, stamp_ns: int) -> None:
        if not self._localiser.is_due(stamp_ns) or self._pending is None:
            return
        try:
            self._localiser.apply(self._pending.result())
        except Exception:  # the place is as sure as it was; the next search gets its chance
            self._counts["localise.search_errors"] += 1
            log.exception("internal error while searching the map; it is searched again")
            self._localiser.abandon()
        self._pending = None

    def _take_placed(self, placed: Placed, odom: Pose2) -> None:
        before = None if self._placed is None else self._placed.state
        self._placed, self._placed_odom = placed, odom
        if placed.state is State.SURE and placed.map_from_base is not None:
            self._map_from_odom = placed.map_from_base @ odom.inverse()
        if placed.state is not before and not (before is None and placed.state is State.SEARCHING):
            log.warning("%s: %s (probability %.2f)", self._name, placed.state.value, placed.probability)


def fields_of(placed: Placed) -> dict[str, object]:
    """What is known at a scan, as JSON values; metres and degrees, rounded."""
    sigma = np.sqrt(np.diag(placed.covariance))
    pose = placed.map_from_base
    return {
        "state": placed.state.value,
        "probability": round(placed.probability, 4),
        "pose": None if pose is None else _pose_fields(pose),
        "sigma": None
        if pose is None
        else {
            "x_m": round(float(sigma[0]), 4),
            "y_m": round(float(sigma[1]), 4),
            "yaw_deg": round(math.degrees(float(sigma[2])), 3),
        },
        "candidates": [
            {
                **_pose_fields(each.pose),
                "share": round(each.share, 4),
                "explained": round(each.explained, 3),
                "through": round(each.through, 3),
            }
            for each in placed.candidates
        ],
    }


def relocalise(
    localiser: KnownMapLocaliser, ask: Any, arguments: Mapping[str, Any]
) -> Mapping[str, object]:  # fmt: skip
    """The call `relocalise`: where am I? ask: runs a function on the fusion thread.

    {} searches the whole map by the last scans, {"hint": {"x_m", "y_m", "yaw_deg"}, "radius_m"} near a place; the
    answer has the state and the candidates of that search. {"forget": true} starts over with it.
    """
    forget = arguments.get("forget", False)
    if not isinstance(forget, bool):
        raise CallRefused('"forget" must be true or false')
    search = ask(lambda: localiser.search_for(arguments))
    if search is None:
        raise CallRefused("no scan has come yet: is a laser running? (umfeld status)")
    found = search.candidates()
    if forget:
        ask(lambda: localiser.start_over(arguments))
    told = ask(localiser.fields)
    return {
        "state": told["state"],
        "probability": told["probability"],
        "pose": told["pose"],
        "found": [
            {**_pose_fields(each.pose), "share": round(each.share, 4), "explained": round(each.explained, 3)}
            for each in found
        ],
    }


def _hint_of(arguments: Mapping[str, Any]) -> tuple[Pose2, float] | None:
    """A pose and a radius, or None; CallRefused says what is wrong with them."""
    hint = arguments.get("hint")
    if hint is None:
        return None
    radius = arguments.get("radius_m", 3.0)
    values = [hint.get(name, 0.0) for name in ("x_m", "y_m", "yaw_deg")] if isinstance(hint, dict) else [math.nan]
    numbers: list[Any] = [*values, radius]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in numbers):
        raise CallRefused('write {"hint": {"x_m": 12.5, "y_m": 3.0, "yaw_deg": 90}, "radius_m": 3}')
    if not 0.0 < radius <= 1000.0:
        raise CallRefused('"radius_m" must lie between 0 and 1000')
    x_m, y_m, yaw_deg = (float(v) for v in numbers[:3])
    return Pose2(x_m, y_m, math.radians(yaw_deg)), float(radius)


def _pose_fields(pose: Pose2) -> dict[str, float]:
    return {
        "x_m": round(pose.x_m, 4) + 0.0,
        "y_m": round(pose.y_m, 4) + 0.0,
        "yaw_deg": round(math.degrees(pose.yaw_rad), 3) + 0.0,
    }


def _step_covariance(step: Pose2) -> F64:
    """Of odometry since the last scan: a tenth of the way and of the turn, and a little."""
    sigma_m = 0.005 + 0.1 * math.hypot(step.x_m, step.y_m)
    sigma_rad = math.radians(0.3) + 0.1 * abs(step.yaw_rad)
    return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
