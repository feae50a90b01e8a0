"""Rectangular sector maps: a raster of squares, each with the nearest obstacle in it (S36, S38)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.kernels import sectors as kernels
from mapping.sectors.evidence import Evidence, Finding, Later, Verdict, blind_finding
from mapping.sectors.footprint import Outline, checked_polygon
from mapping.sectors.inputs import (
    FanReader,
    is_nothing,
    see_cone,
    touched_line,
)
from mapping.sectors.remembered import RememberedCones
from mapping.sectors.sight import Sight, arc_of_cone
from mapping.sectors.snapshot import RectSnapshot, Squares

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
_BEAMS = -1  # the one channel of a source that sends whole fans
_SECTORS_MAX = 250_000


class RectSectors:
    """The newest word of every source on each square around a virtual sensor.

    What readings say of the squares is worked out when a snapshot is looked into: most of the time nobody does. Which
    obstacles a sweep leaves unseen, and for that what it met, is found with every sweep.

    size_m: extent along x and y, centred on the virtual sensor, rounded up to whole sectors.  sector_m: edge of one.
    A sector is free if all of its area outside the vehicle's outline was seen free; one that lies wholly under the
    vehicle is seen by nobody and stays unknown.  The other arguments and the rules are those of PolarSectors.
    """

    def __init__(
        self,
        *,
        sources: tuple[str, ...],
        size_m: tuple[float, float] = (4.0, 4.0),
        sector_m: float = 0.25,
        base_from_sensor: Pose2 = IDENTITY,
        footprint: ArrayLike | None = None,
        stale_after_ns: int | tuple[int, ...] = 500_000_000,
        self_filter: bool = True,
        cone_free_share: float = 0.5,
        wait_for_sources: bool = True,
        fans: FanReader | None = None,
    ) -> None:
        if not 0.0 <= cone_free_share <= 1.0:
            raise ValueError("cone_free_share must be within 0 and 1")
        self.x_edges_m = _edges(size_m[0], sector_m)
        self.y_edges_m = _edges(size_m[1], sector_m)
        self.base_from_sensor = base_from_sensor
        self._cone_free_share = cone_free_share
        self._virtual_from_base = base_from_sensor.inverse()
        own = checked_polygon(footprint) if footprint is not None and self_filter else None
        self._fans = FanReader(own) if fans is None else fans
        self._shape = (len(self.y_edges_m) - 1, len(self.x_edges_m) - 1)
        if self._shape[0] * self._shape[1] > _SECTORS_MAX:
            raise ValueError(f"{self._shape[0]} x {self._shape[1]} sectors are too many: enlarge sector_m")
        self._raster = _Raster(self.x_edges_m, self.y_edges_m, sector_m, Outline(footprint, base_from_sensor))
        self._heard = RememberedCones(self._shape[0] * self._shape[1], self._find_in_cone)
        self._evidence = Evidence(
            count=self._shape[0] * self._shape[1],
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
        """Take a whole fan of beams; as PolarSectors.update_beams."""
        self._evidence.index(source)
        fan = self._fans.read(source, stamp_ns, bearing_rad, range_m, base_from_sensor, range_max_m, spacing_rad)
        sight, points = fan.seen_from(self._virtual_from_base @ base_from_sensor, range_min_m)
        nearest_m, x, y = self._raster.nearest(points)
        finding = partial(_seen, self._raster, sight, nearest_m, x, y)
        self._evidence.revise(
            source,
            _BEAMS,
            Later(finding, (nearest_m, x, y)),
            stamp_ns=stamp_ns,
            looked=lambda _, x_m, y_m: sight.looked_at(np.stack((x_m, y_m), axis=-1)),
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
        """Take one sonar's range; as PolarSectors.update_cone. An echo counts in every square its arc passes."""
        if is_nothing(range_m):  # what it said before stays and ages; a first one only says where it is blind
            if self._evidence.has_heard(source, channel):
                return
            make = partial(self._find_blind, base_from_transducer, cone_rad, range_max_m)
        else:
            make = partial(self._find_heard, base_from_transducer, cone_rad, range_m, range_min_m, range_max_m)
        self._evidence.revise(source, channel, Later(make), stamp_ns=stamp_ns, looked=None)

    def _find_blind(self, base_from_transducer: Pose2, cone_rad: float, range_max_m: float) -> Finding:
        pose = self._virtual_from_base @ base_from_transducer
        return blind_finding(self._raster.covered_by_cone(cone_rad, range_max_m, pose))

    def _find_heard(
        self, base_from_transducer: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float
    ) -> Finding:
        pose = self._virtual_from_base @ base_from_transducer
        return self._heard(pose, cone_rad, range_m, range_min_m, range_max_m)

    def _find_in_cone(
        self, pose: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float
    ) -> Finding:
        sight, arc, _ = see_cone(
            range_m,
            cone_rad=cone_rad,
            range_min_m=range_min_m,
            range_max_m=range_max_m,
            free_share=self._cone_free_share,
            virtual_from_transducer=pose,
        )
        nearest_m, x, y = self._raster.along(arc)
        return Finding(nearest_m, x, y, self._raster.free(sight), np.zeros(len(nearest_m), dtype=bool))

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
        """Take a bumper or cliff switch; as PolarSectors.update_contact."""
        self._evidence.index(source)
        line = touched_line(self._virtual_from_base @ base_from_contact, width_m)
        nearest_m, x, y = self._raster.along(line)
        touched = Finding(nearest_m, x, y, np.zeros(len(x)), np.zeros(len(x), dtype=bool))
        self._evidence.feel(source, channel, touched, tripped=tripped, stamp_ns=stamp_ns)

    def lost(self, source: str) -> None:
        """The device is gone: its evidence is stale now, not only when its time is up."""
        self._evidence.lost(source)
        self._fans.forget(source)

    def snapshot(self, now_ns: int) -> RectSnapshot:
        """What is known at an instant, immutable; of squares worked out when it is first asked for."""
        return RectSnapshot(
            now_ns,
            self.base_from_sensor,
            self.x_edges_m,
            self.y_edges_m,
            self._evidence.sources,
            partial(_squares_of, self._evidence.verdict_later(now_ns), self._shape),
        )


def _seen(raster: _Raster, sight: Sight, nearest_m: F64, x: F64, y: F64) -> Finding:
    return Finding(nearest_m, x, y, raster.free(sight), np.zeros(len(x), dtype=bool))


def _squares_of(verdict: Callable[[], Verdict], shape: tuple[int, int]) -> Squares:
    known = verdict()
    return Squares(
        known.state.reshape(shape),
        known.u.reshape(shape),
        known.v.reshape(shape),
        known.age_ns.reshape(shape),
        known.source.reshape(shape),
    )


class _Raster:
    """The geometry of one map's squares: which points, arcs and free areas fall into which. All results are flat."""

    def __init__(self, x_edges_m: F64, y_edges_m: F64, sector_m: float, outline: Outline) -> None:
        self._x0, self._y0, self._edge = float(x_edges_m[0]), float(y_edges_m[0]), sector_m
        self._rows, self._cols = len(y_edges_m) - 1, len(x_edges_m) - 1
        self._body = outline.polygon
        self._reach_m = float(np.hypot(self._body[:, 0], self._body[:, 1]).max()) if len(self._body) else 0.0
        x, y = np.meshgrid(x_edges_m, y_edges_m)
        middle_x, middle_y = np.meshgrid(0.5 * (x_edges_m[:-1] + x_edges_m[1:]), 0.5 * (y_edges_m[:-1] + y_edges_m[1:]))
        corners = np.stack((x.ravel(), y.ravel()), axis=-1)
        self._middles = np.stack((middle_x.ravel(), middle_y.ravel()), axis=-1)
        corner_body, middle_body = outline.contains(corners), outline.contains(self._middles)
        self._corner_exempt, self._middle_exempt = corner_body, middle_body
        c = corner_body.reshape(self._rows + 1, self._cols + 1)
        covered = c[:-1, :-1] & c[:-1, 1:] & c[1:, :-1] & c[1:, 1:]  # all four corners
        self._under_vehicle = middle_body & covered.ravel()
        away_m = np.hypot(x, y).reshape(self._rows + 1, self._cols + 1)
        far_m = [away_m[:-1, :-1], away_m[:-1, 1:], away_m[1:, :-1], away_m[1:, 1:]]
        self._far_m = np.asarray(np.max(far_m, axis=0), dtype=np.float64).ravel()

    def nearest(self, points: F64) -> tuple[F64, F64, F64]:
        """(N,) distance, x, y of the nearest of (M, 2) points in each square."""
        x, y = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1])
        distance, at_x, at_y = kernels.nearest_in_cells(x, y, self._x0, self._y0, self._edge, self._rows, self._cols)
        return _flat(distance), _flat(at_x), _flat(at_y)

    def along(self, line: F64) -> tuple[F64, F64, F64]:
        """(N,) distance, x, y of the nearest point of a polyline in each square it passes."""
        nothing = np.empty((0, 2))
        distance, at_x, at_y = kernels.line_through_cells(
            np.ascontiguousarray(line), self._x0, self._y0, self._edge, self._rows, self._cols, nothing, 0.0
        )
        return _flat(distance), _flat(at_x), _flat(at_y)

    def free(self, sight: Sight) -> F64:
        """(N,) the far corner's distance where all of a square outside the vehicle was seen, 0 for the others."""
        pose = sight.virtual_from_sensor
        free: F64 = kernels.free_cells(
            sight.star.lo_rad, sight.star.hi_rad, sight.star.length_m, pose.x_m, pose.y_m, pose.yaw_rad,
            self._x0, self._y0, self._edge, self._rows, self._cols, self._body, self._reach_m,
            self._corner_exempt, self._middle_exempt, self._under_vehicle, self._far_m,
        )  # fmt: skip
        return free

    def covered_by_cone(self, cone_rad: float, range_max_m: float, virtual_from_transducer: Pose2) -> Bool:
        """(N,) squares whose middle lies in a cone, or through which its far end passes."""
        own = virtual_from_transducer.inverse().apply(self._middles)
        inside = (np.abs(np.arctan2(own[:, 1], own[:, 0])) <= 0.5 * cone_rad) & (
            np.hypot(own[:, 0], own[:, 1]) <= range_max_m
        )
        arc = arc_of_cone(cone_rad=cone_rad, range_m=range_max_m, virtual_from_transducer=virtual_from_transducer)[0]
        return np.asarray(inside | np.isfinite(self.along(arc)[0]))


def _edges(size_m: float, sector_m: float) -> F64:
    if not (size_m > 0.0 and sector_m > 0.0 and math.isfinite(size_m)):
        raise ValueError("a rectangular sector map needs a positive size and sector")
    count = max(1, math.ceil(size_m / sector_m - 1e-6))
    edges: F64 = sector_m * (np.arange(count + 1, dtype=np.float64) - 0.5 * count)
    edges.setflags(write=False)
    return edges


def _flat(values: F64) -> F64:
    return np.asarray(values, dtype=np.float64).ravel()
