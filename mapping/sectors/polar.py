"""Polar sector maps: per wedge of bearings the nearest obstacle, and what is known (S34, S35, S38)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.kernels import sector_cones as cones
from mapping.kernels import sectors as kernels
from mapping.sectors.evidence import Evidence, Finding, blind_finding
from mapping.sectors.footprint import Outline, checked_polygon
from mapping.sectors.inputs import (
    FanReader,
    echo_and_free,
    is_nothing,
    touched_line,
)
from mapping.sectors.remembered import RememberedCones
from mapping.sectors.sight import LEAST_RANGE_M, Sight, arc_directions, arc_of_cone, cone_pieces
from mapping.sectors.snapshot import PolarSnapshot, SectorState

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
_BEAMS = -1  # the one channel of a source that sends whole fans
_STEP_M = 1e-6  # just outside the vehicle's border


def sector_edges(*, start_rad: float, stop_rad: float, sector_rad: float) -> F64:
    """(N + 1,) ascending edges of sectors of equal width; a remainder makes a narrower last one.

    Raises ValueError if the range is empty or more than one turn, or a sector wider than half a turn.
    """
    span = stop_rad - start_rad
    if not (0.0 < span <= 2.0 * math.pi + 1e-9 and 0.0 < sector_rad <= math.pi + 1e-9):
        raise ValueError("sectors need 0 < stop - start <= one turn and 0 < width <= half a turn")
    count = max(1, math.ceil(span / sector_rad - 1e-6))
    if min(span, sector_rad) > math.pi + 1e-9:
        raise ValueError("one sector covers at most half a turn")
    return np.append(start_rad + sector_rad * np.arange(count), stop_rad)


class PolarSectors:
    """The newest word of every source on each direction.

    base_from_sensor: the virtual sensor; it may stand anywhere.  footprint: (V, 2) outline of the vehicle in the base
    frame: distances to it are reported, its inside needs no looking at and, with self_filter, beams that end in it
    are ignored.  sources: names that may call update_*.  stale_after_ns: one limit, or one for each source.
    range_max_m: what lies farther does not count.  cone_free_share: part of a sonar's range, or of the distance of
    its echo, that its silence clears: an object that reflects badly is heard only from nearer.  fans: shared with other
    maps of the same footprint, which also decides there what is left out.
    """

    def __init__(
        self,
        *,
        sources: tuple[str, ...],
        start_rad: float = math.radians(-120.0),
        stop_rad: float = math.radians(120.0),
        sector_rad: float = math.radians(5.0),
        base_from_sensor: Pose2 = IDENTITY,
        footprint: ArrayLike | None = None,
        stale_after_ns: int | tuple[int, ...] = 500_000_000,
        range_max_m: float = math.inf,
        self_filter: bool = True,
        cone_free_share: float = 0.5,
        wait_for_sources: bool = True,
        fans: FanReader | None = None,
    ) -> None:
        if not 0.0 <= cone_free_share <= 1.0 or not range_max_m > 0.0:
            raise ValueError("cone_free_share must be within 0 and 1, range_max_m above 0")
        self.edges_rad = sector_edges(start_rad=start_rad, stop_rad=stop_rad, sector_rad=sector_rad)
        self.edges_rad.setflags(write=False)
        self.base_from_sensor = base_from_sensor
        self._width = sector_rad
        self._range_max_m = range_max_m
        self._cone_free_share = cone_free_share
        self._virtual_from_base = base_from_sensor.inverse()
        self._outline = Outline(footprint, base_from_sensor)
        own = checked_polygon(footprint) if footprint is not None and self_filter else None
        self._fans = FanReader(own) if fans is None else fans
        self._frame = _Wedges(self.edges_rad, sector_rad, range_max_m, self._outline)
        self._heard = RememberedCones(len(self.edges_rad) - 1, self._find_in_cone)
        self._evidence = Evidence(
            count=len(self.edges_rad) - 1,
            sources=tuple(sources),
            stale_after_ns=stale_after_ns,
            wait_for_sources=wait_for_sources,
        )

    def update_beams(
        self,
        source: str,
        *,
        base_from_sensor: Pose2,
        bearing_rad: ArrayLike,
        range_m: ArrayLike,
        range_min_m: float,
        range_max_m: float,
        stamp_ns: int,
        spacing_rad: float | None = None,
    ) -> None:
        """Take a whole fan of beams: (N,) bearings in any order, (N,) ranges as in mapping.scan.

        spacing_rad: the device's angle between beams; default: the finest this source has shown. Beams farther apart
        than 1.5 times that leave a gap nobody looked through.  Raises ValueError for an unknown source.
        """
        self._evidence.index(source)
        fan = self._fans.read(source, stamp_ns, bearing_rad, range_m, base_from_sensor, range_max_m, spacing_rad)
        sight, points = fan.seen_from(self._virtual_from_base @ base_from_sensor, range_min_m)
        nearest_m, at_rad = self._frame.nearest(points)
        finding = Finding(nearest_m, at_rad, at_rad, self._frame.free(sight), np.zeros(len(nearest_m), dtype=bool))
        self._evidence.revise(
            source,
            _BEAMS,
            finding,
            stamp_ns=stamp_ns,
            looked=lambda distance_m, bearing_rad, _: sight.looked_at(_points(distance_m, bearing_rad)),
        )

    def update_cone(
        self,
        source: str,
        channel: int,
        *,
        base_from_transducer: Pose2,
        cone_rad: float,
        range_m: float,
        range_min_m: float,
        range_max_m: float,
        stamp_ns: int,
    ) -> None:
        """Take one sonar's range: +inf no echo, -inf too close, NaN invalid (what it said before ages on).

        cone_rad: full opening angle.  An echo counts for every sector its arc passes, at the arc's nearest point
        there and the bearing of its point nearest to the axis.  Raises ValueError for an unknown source.
        """
        if is_nothing(range_m):  # what it said before stays and ages; a first one only says where it is blind
            if self._evidence.has_heard(source, channel):
                return
            pose = self._virtual_from_base @ base_from_transducer
            finding = blind_finding(self._frame.covered_by_cone(cone_rad, range_max_m, pose))
        else:
            pose = self._virtual_from_base @ base_from_transducer
            finding = self._heard(pose, cone_rad, range_m, range_min_m, range_max_m)
        self._evidence.revise(source, channel, finding, stamp_ns=stamp_ns, looked=None)

    def _find_in_cone(
        self, pose: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float
    ) -> Finding:
        echo_m, free_m = echo_and_free(range_m, range_min_m, range_max_m, self._cone_free_share)
        nearest_m, at_rad, all_free_m = self._frame.of_cone(pose, cone_rad, echo_m, free_m, range_min_m)
        return Finding(nearest_m, at_rad, at_rad, all_free_m, np.zeros(len(all_free_m), dtype=bool))

    def update_contact(
        self,
        source: str,
        channel: int,
        *,
        base_from_contact: Pose2,
        width_m: float,
        tripped: bool | None,
        stamp_ns: int,
    ) -> None:
        """Take a bumper or cliff switch. tripped: an obstacle along it; not tripped: nothing, it frees no sector.

        None: it does not answer; its sectors are stale, as they are once the source is lost. base_from_contact: its
        middle, looking outwards.  width_m: its length across.  Raises ValueError for an unknown source.
        """
        self._evidence.index(source)
        line = touched_line(self._virtual_from_base @ base_from_contact, width_m)
        nearest_m, at_rad = self._frame.nearest(line)
        touched = Finding(nearest_m, at_rad, at_rad, np.zeros(len(at_rad)), np.zeros(len(at_rad), dtype=bool))
        self._evidence.feel(source, channel, touched, tripped=tripped, stamp_ns=stamp_ns)

    def lost(self, source: str) -> None:
        """The device is gone: its evidence is stale now, not only when its time is up."""
        self._evidence.lost(source)
        self._fans.forget(source)

    def snapshot(self, now_ns: int) -> PolarSnapshot:
        """What is known at an instant, immutable, in bearing order."""
        known = self._evidence.verdict(now_ns)
        free = known.state == SectorState.FREE
        clearance = known.distance_m - self._outline.border_m(known.u)
        # A free sector is clear of its whole border, so the most protruding part of it counts.
        clearance[free] = known.distance_m[free] - self._frame.border_m[free]
        return PolarSnapshot(
            stamp_ns=now_ns,
            base_from_sensor=self.base_from_sensor,
            edges_rad=self.edges_rad,
            state=known.state,
            distance_m=known.distance_m,
            bearing_rad=known.u,
            clearance_m=clearance,
            age_ns=known.age_ns,
            source=known.source,
            sources=self._evidence.sources,
            free_m=known.free_m,
        )


class _Wedges:
    """The geometry of one map's sectors: which points, arcs and free areas fall into which."""

    def __init__(self, edges_rad: F64, width_rad: float, range_max_m: float, outline: Outline) -> None:
        self._edges = np.ascontiguousarray(edges_rad)
        self._width = width_rad
        self._range_max_m = range_max_m
        self._outline = outline
        self.border_m = outline.farthest_border_m(edges_rad)
        # No part of the vehicle needs no looking at unless the wedges begin inside it.
        self._body = outline.polygon if outline.contains_origin else np.empty((0, 2))
        self._reach_m = float(np.hypot(self._body[:, 0], self._body[:, 1]).max()) if len(self._body) else 0.0
        middle = 0.5 * (edges_rad[:-1] + edges_rad[1:])
        begin = outline.border_m(middle) + _STEP_M if outline.contains_origin else np.zeros(len(middle))
        self._begins = _points(begin, middle)

    def nearest(self, points: F64) -> tuple[F64, F64]:
        """(N,) distances and bearings of the nearest of (M, 2) points in each sector."""
        x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
        distance, bearing = kernels.nearest_in_sectors(x, y, self._edges, self._width, self._range_max_m)
        return distance, bearing

    def of_cone(
        self, virtual_from_transducer: Pose2, cone_rad: float, echo_m: float, free_m: float, near_m: float
    ) -> tuple[F64, F64, F64]:
        """(N,) least distance of an echo's arc, the bearing of its point nearest to the axis, and up to which all of a
        sector is free and its far corners lie within the cone. near_m: up to which the whole front is free, if free_m
        is above 0 (see sight_of_cone).
        """
        pose = virtual_from_transducer
        pieces, near_m = cone_pieces(cone_rad, near_m if free_m > 0.0 else 0.0)
        nearest, at, free = cones.cone_in_sectors(
            pose.x_m, pose.y_m, pose.yaw_rad, 0.5 * cone_rad, free_m, near_m, max(echo_m, LEAST_RANGE_M), *pieces,
            *arc_directions(cone_rad), self._edges, self._width, self._range_max_m, self.border_m, self._begins,
            self._body, self._reach_m,
        )  # fmt: skip
        return nearest, at, free

    def free(self, sight: Sight) -> F64:
        """(N,) up to which all of each sector, but for the vehicle itself, lies in what was seen; 0 if nothing does."""
        if sight.from_origin:
            yaw = sight.virtual_from_sensor.yaw_rad
            from_origin: F64 = kernels.free_from_origin(
                sight.star.lo_rad + yaw,
                sight.star.hi_rad + yaw,
                sight.star.length_m,
                self._edges,
                self._width,
                self._range_max_m,
            )
            return from_origin
        free: F64 = kernels.free_reach(
            sight.border(), self._edges, self._width, self._body, self._reach_m, self._range_max_m
        )
        # Outside the vehicle, where the wedge begins, it must be seen; a border that cuts the vehicle's own, which
        # lies no farther than border_m, may leave a part of that line unseen.
        free[(free <= self.border_m) | ~sight.contains(self._begins)] = 0.0
        return free

    def covered_by_cone(self, cone_rad: float, range_max_m: float, virtual_from_transducer: Pose2) -> Bool:
        """(N,) sectors that a cone reaches into at its far end."""
        arc, off_axis = arc_of_cone(
            cone_rad=cone_rad, range_m=range_max_m, virtual_from_transducer=virtual_from_transducer
        )
        bearing = kernels.arc_in_sectors(np.ascontiguousarray(arc), off_axis, self._edges, self._width, math.inf)[1]
        return np.asarray(np.isfinite(bearing))


def _points(distance_m: F64, bearing_rad: F64) -> F64:
    points = np.empty((len(distance_m), 2))
    points[:, 0] = distance_m * np.cos(bearing_rad)
    points[:, 1] = distance_m * np.sin(bearing_rad)
    return points
