"""The maps in the configuration."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from service.config_base import Name, PlanePose, Positive, Reference, Section


class PolarSectorMap(Section):
    """A polar sector map: per wedge of bearings the nearest obstacle and what is known."""

    sources: tuple[Reference, ...] = Field(
        min_length=1,
        description="Lasers, sonars and contacts that feed it; lasers.NAME and the like where several have the name.",
    )
    sector_deg: float = Field(default=5.0, gt=0, le=180, description="Width of a sector.")
    start_deg: float = Field(default=-120.0, ge=-360, le=360, description="Where the first sector begins.")
    stop_deg: float = Field(default=120.0, ge=-360, le=360, description="Where the last one ends.")
    range_max_m: Positive | None = Field(default=None, description="What lies farther does not count; default: all.")
    pose: PlanePose = Field(default=PlanePose(), description="The virtual sensor in the base frame.")

    @model_validator(mode="after")
    def _whole_sectors(self) -> PolarSectorMap:
        span = self.stop_deg - self.start_deg
        if not 0 < span <= 360:
            raise ValueError("stop_deg must lie above start_deg, by at most 360")
        count = span / self.sector_deg
        if abs(count - round(count)) > 1e-6:
            raise ValueError(f"{span:g} degrees are not a whole number of sectors of {self.sector_deg:g}")
        return self


class RectSectorMap(Section):
    """A rectangular sector map around the robot: per square the nearest obstacle and what is known."""

    sources: tuple[Reference, ...] = Field(
        min_length=1,
        description="Lasers, sonars and contacts that feed it; lasers.NAME and the like where several have the name.",
    )
    size_m: tuple[Positive, Positive] = Field(
        default=(4.0, 4.0), description="Extent along x and y, centred on the pose."
    )
    sector_m: Positive = Field(default=0.25, description="Edge of a sector.")
    pose: PlanePose = Field(default=PlanePose(), description="The virtual sensor in the base frame.")

    @model_validator(mode="after")
    def _whole_sectors(self) -> RectSectorMap:
        for size in self.size_m:
            count = size / self.sector_m
            if abs(count - round(count)) > 1e-6:
                raise ValueError(f"{size:g} m are not a whole number of sectors of {self.sector_m:g} m")
        if math.prod(self.size_m) / self.sector_m**2 > 40000:
            raise ValueError("more than 40000 sectors; take a larger sector_m or a smaller size_m")
        return self


class SectorMaps(Section):
    """All sector maps by name."""

    polar: dict[Name, PolarSectorMap] = Field(default={}, description="Polar sector maps.")
    rect: dict[Name, RectSectorMap] = Field(default={}, description="Rectangular sector maps.")


class Grid(Section):
    """The occupancy grid of the whole building, fixed in the map frame."""

    enabled: bool = Field(default=True, description="Keep it.")
    resolution_m: float = Field(default=0.05, ge=0.005, le=1.0, description="Edge of a cell.")
    model: Literal["counters", "log-odds"] = Field(default="counters", description="What a cell remembers.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Sensors that draw it; default: all.")
    halve_every_s: float = Field(
        default=0.0, ge=0, le=86400, description="Forget half of all evidence so often, wherever it is; 0: never."
    )
    publish_period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two whole grids.")
    update_period_s: float = Field(default=0.2, ge=0.2, le=3600, description="Shortest time between two updates.")
    crisp: bool = Field(
        default=True,
        description="Publish and export walls as lasers' sweeps together show them, not as each cell was counted.",
    )


class LocalGrid(Section):
    """The occupancy grid around the robot, which rolls with it: key map/local."""

    enabled: bool = Field(default=False, description="Keep it.")
    size_m: float = Field(default=8.0, gt=0, le=200, description="Edge of the square it covers.")
    period_s: float = Field(default=0.2, ge=0.05, le=10, description="Shortest time between two that are published.")
    resolution_m: float = Field(default=0.05, ge=0.005, le=1.0, description="Edge of a cell.")
    model: Literal["counters", "log-odds"] = Field(default="counters", description="What a cell remembers.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Sensors that draw it; default: all.")
    halve_every_s: float = Field(
        default=0.0, ge=0, le=86400, description="Forget half of all evidence so often, wherever it is; 0: never."
    )


class Artos(Section):
    """The two-step map of ARTOS from polar sector maps to a robot-centred grid: key map/artos."""

    enabled: bool = Field(default=False, description="Keep it.")
    size_m: float = Field(default=8.0, gt=0, le=100, description="Edge of the square it covers.")
    resolution_m: float = Field(default=0.1, ge=0.01, le=1.0, description="Edge of a cell.")
    sources: tuple[Name, ...] = Field(default=(), description="The [sectors.polar.NAME] it is made from; default: all.")
    period_s: float = Field(default=0.2, ge=0.05, le=10, description="Time between two updates.")


class LineMapSettings(Section):
    """The map of walls as straight lines: key map/lines."""

    enabled: bool = Field(default=True, description="Keep it.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that draw it; default: all.")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")
    min_scans: int = Field(default=2, ge=1, le=255, description="Scans that must have seen a line before it is told.")


class PlaneMapSettings(Section):
    """Planes of what nodding and turning lasers see: key map/planes, if there is a [mounts.NAME]."""

    enabled: bool = Field(default=True, description="Look for them.")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")
    cell_m: float = Field(default=0.2, ge=0.02, le=5.0, description="Edge of a cubic cell.")
    min_points: int = Field(default=10, ge=3, le=1000, description="Points of a cell, to look for a plane in it.")
    min_cells: int = Field(default=10, ge=1, le=10000, description="A plane has at least so many times min_points.")
    inlier_m: Positive = Field(default=0.05, description="Farthest that a point of a plane is off.")
    sigma_m: Positive | None = Field(default=None, description="Noise of ranges; default: taken from each cloud.")


class ElevationSettings(Section):
    """The ground as nodding and turning lasers see it: key map/elevation, and fields of polar sectors."""

    enabled: bool = Field(default=True, description="Keep it, if there is a [mounts.NAME].")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")
    resolution_m: float = Field(default=0.1, ge=0.02, le=1.0, description="Edge of a cell.")
    size_m: float = Field(default=10.0, gt=0, le=100, description="Edge of the square around the vehicle.")
    height_max_m: Positive = Field(default=2.0, description="What lies higher above the wheels' level is passed under.")
    clouds: int = Field(default=10, ge=1, le=100, description="How many of each mount's newest clouds count.")
    slope_max_deg: float = Field(default=20.0, gt=0, lt=90, description="Steeper ground cannot be driven on.")
    step_max_m: Positive = Field(default=0.08, description="Nor can higher steps.")
    roughness_max_m: Positive = Field(default=0.03, description="Nor ground that is rougher: rms off its plane.")
    sector_reach_m: float = Field(
        default=1.0, gt=0, le=50, description="How far sectors look at the ground, beyond what is hidden."
    )
    sector_hidden_m: Positive | None = Field(
        default=None,
        description="Ground that the lasers never see: so far around a sector map's origin on the vehicle nothing is"
        " asked. Default: its outline's farthest corner.",
    )
    stale_s: float = Field(default=5.0, gt=0, le=600, description="Without a cloud for so long the ground is unknown.")

    @model_validator(mode="after")
    def _not_too_many_cells(self) -> ElevationSettings:
        if (self.size_m / self.resolution_m) ** 2 > 22500:
            raise ValueError("more than 150 x 150 cells; take a larger resolution_m or a smaller size_m")
        return self


class ClearanceSettings(Section):
    """How near the next obstacle of the grid is: key map/clearance. Needs [grid]."""

    enabled: bool = Field(default=False, description="Keep it.")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")
    reach_m: float = Field(default=2.0, ge=0.1, le=50, description="Farther away the cost is 0.")
    unknown_is_obstacle: bool = Field(default=False, description="Keep off what was never seen as well.")


class TopoMapSettings(Section):
    """Regions of free space and the passages between them: key map/topo, call @rpc/route. Needs [grid]."""

    enabled: bool = Field(default=False, description="Keep it.")
    period_s: float = Field(default=5.0, ge=1.0, le=3600, description="Shortest time between two that are made.")
    smooth_m: float = Field(default=0.15, ge=0.02, le=1.0, description="Regions keep so far off what is not free.")
    door_m: float = Field(default=1.3, ge=0.1, le=10.0, description="Wider passages join regions to one room.")


class PlaceMapSettings(Section):
    """Places with local maps and hallways between them, without a common frame: key map/topo, call @rpc/route."""

    enabled: bool = Field(default=False, description="Keep it; [topo] has the same key.")
    source: Reference | None = Field(default=None, description="The laser that sees them; default: the first by name.")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")


class SceneMapSettings(Section):
    """Scenes to be recognised again: key map/scenes, call @rpc/where_am_i."""

    enabled: bool = Field(default=True, description="Collect them.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that see them; default: all.")
    period_s: float = Field(default=5.0, ge=1.0, le=3600, description="Shortest time between two summaries.")
    most: int = Field(default=5000, ge=1, le=20000, description="Scenes that are kept; later ones are left out.")


class RoomMapSettings(Section):
    """Rooms and doors with ids and names that stay: key map/rooms, calls @rpc/plan and @rpc/name_room. Needs [grid]."""

    enabled: bool | None = Field(
        default=None, description="Keep it; default: where a laser draws the grid, fixed on the robot."
    )
    period_s: float = Field(
        default=5.0, ge=1.0, le=3600, description="Shortest time between two that are made; longer for a large map."
    )
    clearance_m: float = Field(default=0.3, ge=0.0, le=10.0, description="What plans keep off, if they are not told.")


class CalibrationSettings(Section):
    """What wheels and mounts of lasers really are, from driving about: key calibration. Needs [drive] source."""

    enabled: bool = Field(default=True, description="Look for it.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that are used; default: all.")
    period_s: float = Field(default=10.0, ge=1.0, le=3600, description="Shortest time between two reports.")


class AgreementSettings(Section):
    """Grid, lines, rooms and regions held against each other: key map/agreement. Needs [grid]."""

    enabled: bool = Field(default=True, description="Do it.")
    period_s: float = Field(
        default=2.0, ge=1.0, le=3600, description="Shortest time between two comparisons; longer for a large map."
    )


class SlamLive(Section):
    """Where the robot is: found by laying laser scans on each other, not by the wheels alone."""

    enabled: bool = Field(
        default=True, description="Do it, on a robot with a laser; false: believe the wheels, however they drift."
    )
    method: Literal["scans", "lines"] = Field(
        default="scans",
        description="scans: scan matching, loops closed, maps drawn again. lines: a Kalman filter on straight walls, "
        "for small computers; needs wheels, closes no loops.",
    )
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that are matched; default: all.")


class LocaliseIn(Section):
    """Localisation in a given map, which is only read: no grid is drawn, no store written, [slam] is left out."""

    mode: Literal["off", "map"] = Field(default="off", description="map: find the robot in a given map.")
    map: str | None = Field(default=None, description="The map's file: a map server's .yaml or a .umfeld.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that are matched; default: all.")
    start: PlanePose | None = Field(
        default=None, description="A hint where the robot begins; default: anywhere in the map."
    )

    @model_validator(mode="after")
    def _has_a_map(self) -> LocaliseIn:
        if self.mode == "map" and not self.map:
            raise ValueError('mode = "map" needs map = "FILE.yaml" (or .umfeld): the map to find the robot in')
        return self


class Alignment(Section):
    """How long readings wait for each other."""

    odometry_wait_ms: int = Field(
        default=500,
        ge=20,
        le=5000,
        description="A scan waits this long for odometry that covers it, then it is dropped.",
    )
    odometry_memory_s: float = Field(default=30.0, ge=1, le=600, description="How far back poses are remembered.")
