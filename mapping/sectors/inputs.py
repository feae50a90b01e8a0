"""Readings as both kinds of sector map take them: checked, and without the vehicle's own reflections."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import Pose2
from mapping.kernels import beams as kernels
from mapping.sectors.sight import Sight, Star, arc_of_cone, end_points, median_spacing, sight_of_cone, star_of_beams

F64 = NDArray[np.float64]

_TOUCH_STEP_M = 0.02
_SCANS_REMEMBERED = 40  # four seconds of a slow scanner


class SpacingMemory:
    """The finest spacing of beams each source has shown lately: a scan that lost every other beam must not pass for
    whole. Lately, because a head that still gathers speed measures more finely than it ever will again.
    """

    def __init__(self) -> None:
        self._lately: dict[str, deque[float]] = {}
        self._last: dict[str, F64] = {}

    def of(self, source: str, bearing_rad: F64, spacing_rad: float | None) -> float:
        """The spacing to judge gaps by; spacing_rad is the device's own figure, if it is known."""
        if spacing_rad is not None:
            return spacing_rad
        lately = self._lately.setdefault(source, deque(maxlen=_SCANS_REMEMBERED))
        if lately and np.array_equal(self._last[source], bearing_rad):
            lately.append(lately[-1])  # the usual case: the same directions as the last time
            return min(lately)
        median = median_spacing(bearing_rad)
        if median is not None and median > 0.0:
            self._last[source] = bearing_rad.copy()
            lately.append(median)
        return min(lately, default=0.0)

    def forget(self, source: str) -> None:
        """The device is gone; what answers next may be set differently."""
        self._lately.pop(source, None)
        self._last.pop(source, None)


def checked_beams(bearing_rad: ArrayLike, range_m: ArrayLike) -> tuple[F64, F64]:
    """Two (N,) float64 arrays; a beam without a finite bearing is invalid. ValueError if the shapes differ."""
    bearing = np.ascontiguousarray(bearing_rad, dtype=np.float64)
    ranges = np.ascontiguousarray(range_m, dtype=np.float64)
    if bearing.ndim != 1 or bearing.shape != ranges.shape:
        raise ValueError(f"bearings and ranges must be (N,) alike, got {bearing.shape} and {ranges.shape}")
    good = np.isfinite(bearing)
    return (bearing, ranges) if good.all() else (bearing[good], ranges[good])


def without_self(
    bearing_rad: F64, range_m: F64, base_from_sensor: Pose2, footprint: F64, *, too_close_m: float | None = None
) -> F64:
    """(N,) ranges in which what ends on the vehicle itself is invalid: it is no obstacle and frees nothing.

    footprint: (V, 2) corners in the base frame.  too_close_m: where a map would put what is too close (-inf); None:
    such beams are left as they are.  Returns range_m itself if nothing ends there. Raises ValueError if shapes differ.
    """
    bearing, ranges = (
        np.ascontiguousarray(bearing_rad, dtype=np.float64),
        np.ascontiguousarray(range_m, dtype=np.float64),
    )
    if bearing.shape != ranges.shape or ranges.ndim != 1:
        raise ValueError(f"bearings and ranges must be (N,) alike, got {bearing.shape} and {ranges.shape}")
    cleaned = np.empty_like(ranges)
    sensor, outline = base_from_sensor, np.ascontiguousarray(footprint, dtype=np.float64)
    nowhere = math.nan if too_close_m is None else float(too_close_m)
    dropped = kernels.drop_own(bearing, ranges, sensor.x_m, sensor.y_m, sensor.yaw_rad, outline, nowhere, cleaned)
    return cleaned if dropped > 0 else range_m


@dataclass(frozen=True, slots=True)
class Fan:
    """A sweep as every map takes it: (N,) bearings and ranges without the vehicle's own, and the star it has seen."""

    bearing_rad: F64
    range_m: F64
    star: Star

    def seen_from(self, virtual_from_sensor: Pose2, range_min_m: float) -> tuple[Sight, F64]:
        """What was seen, and (M, 2) obstacles, both in the frame of a map's virtual sensor."""
        points = end_points(
            self.bearing_rad, self.range_m, range_min_m=range_min_m, virtual_from_sensor=virtual_from_sensor
        )
        return Sight(virtual_from_sensor, self.star), points


@dataclass(frozen=True, slots=True)
class _Read:
    """What a fan was made of, and what was made."""

    source: str
    stamp_ns: int
    bearing_rad: ArrayLike
    range_m: ArrayLike
    base_from_sensor: Pose2
    range_max_m: float
    spacing_rad: float | None
    fan: Fan

    def is_of(
        self, source: str, stamp_ns: int, bearing_rad: ArrayLike, range_m: ArrayLike, base_from_sensor: Pose2,
        range_max_m: float, spacing_rad: float | None,
    ) -> bool:  # fmt: skip
        """Whether these very arrays were read, at the same time and place."""
        return (
            self.bearing_rad is bearing_rad
            and self.range_m is range_m
            and self.stamp_ns == stamp_ns
            and self.source == source
            and self.base_from_sensor == base_from_sensor
            and self.range_max_m == range_max_m
            and self.spacing_rad == spacing_rad
        )


class FanReader:
    """Makes fans of sweeps. Maps that take the same sweeps may share one, so that what they have in common is worked
    out once: the newest fan is remembered. footprint: (V, 2), beams that end in it are left out; None: none are."""

    def __init__(self, footprint: F64 | None) -> None:
        self._footprint = footprint
        self._spacing = SpacingMemory()
        self._last: _Read | None = None

    def read(
        self, source: str, stamp_ns: int, bearing_rad: ArrayLike, range_m: ArrayLike, base_from_sensor: Pose2,
        range_max_m: float, spacing_rad: float | None,
    ) -> Fan:  # fmt: skip
        """The fan of a sweep, whose arrays must not be written to afterwards. ValueError if their shapes differ."""
        last = self._last
        if last is not None and last.is_of(
            source, stamp_ns, bearing_rad, range_m, base_from_sensor, range_max_m, spacing_rad
        ):
            return last.fan
        bearing, ranges = checked_beams(bearing_rad, range_m)
        if self._footprint is not None:
            ranges = without_self(bearing, ranges, base_from_sensor, self._footprint)
        spacing = self._spacing.of(source, bearing, spacing_rad)
        fan = Fan(bearing, ranges, star_of_beams(bearing, ranges, range_max_m=range_max_m, spacing_rad=spacing))
        self._last = _Read(source, stamp_ns, bearing_rad, range_m, base_from_sensor, range_max_m, spacing_rad, fan)
        return fan

    def forget(self, source: str) -> None:
        """The device is gone; what answers next may be set differently."""
        self._spacing.forget(source)
        self._last = None


def is_nothing(range_m: float) -> bool:
    """Whether a sonar's range is invalid; infinite ones are not."""
    return math.isnan(range_m) or (math.isfinite(range_m) and range_m < 0.0)


def echo_and_free(range_m: float, range_min_m: float, range_max_m: float, free_share: float) -> tuple[float, float]:
    """Where a sonar's echo came from, inf if there was none, and how far its cone is free."""
    echo_m = range_min_m if math.isinf(range_m) and range_m < 0.0 else range_m
    return echo_m, 0.0 if echo_m <= range_min_m else free_share * min(echo_m, range_max_m)


def see_cone(
    range_m: float,
    *,
    cone_rad: float,
    range_min_m: float,
    range_max_m: float,
    free_share: float,
    virtual_from_transducer: Pose2,
) -> tuple[Sight, F64, F64]:
    """What a sonar has seen: its star, the (M, 2) arc the echo came from (empty: no echo), and (M,) angles off axis."""
    echo_m, free_m = echo_and_free(range_m, range_min_m, range_max_m, free_share)
    sight = sight_of_cone(
        cone_rad=cone_rad,
        free_m=free_m,
        near_m=range_min_m if free_m > 0.0 else 0.0,
        virtual_from_transducer=virtual_from_transducer,
    )
    if math.isinf(echo_m):
        return sight, np.empty((0, 2)), np.empty(0)
    arc, off_axis = arc_of_cone(cone_rad=cone_rad, range_m=echo_m, virtual_from_transducer=virtual_from_transducer)
    return sight, arc, off_axis


def touched_line(virtual_from_contact: Pose2, width_m: float) -> F64:
    """(M, 2) points along a bumper or a cliff sensor, from its right end to its left, virtual sensor frame."""
    count = max(2, math.ceil(width_m / _TOUCH_STEP_M) + 1)
    across = np.linspace(-0.5 * width_m, 0.5 * width_m, count)
    return virtual_from_contact.apply(np.stack((np.zeros(count), across), axis=-1))
