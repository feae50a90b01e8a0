"""What fusion hands to the publisher, the store and the recording: immutable, stamped, named. No bytes yet.

Stamps are host monotonic nanoseconds; the publisher turns them into wall time at the edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import IDENTITY, Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from mapping.sectors.ground import SectorGround
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot

F64 = NDArray[np.float64]


UNKNOWN_VARIANCE = 1e6
"""Of a speed that nobody knows, in (m/s)^2 or (rad/s)^2: who fuses it takes nothing from it, as ROS drivers do it."""


@dataclass(frozen=True, slots=True)
class ScanOut:
    """A laser's sweep: key scan/<sensor>."""

    sensor: str
    scan: Scan
    base_from_sensor: Pose2
    height_m: float


@dataclass(frozen=True, slots=True)
class RangesOut:
    """A round of sonar ranges, for the page and ROS: key range/<sensor>. One entry per transducer of the chain."""

    sensor: str
    stamp_ns: int
    base_from_transducer: tuple[Pose2, ...]
    cone_rad: float
    range_min_m: float
    range_max_m: float
    range_m: tuple[float, ...]  # +inf nothing, -inf too close, NaN invalid or not looked


@dataclass(frozen=True, slots=True)
class PolarOut:
    """Key sectors/polar/<name>. ground: what the elevation map says about each sector; None where there is none."""

    name: str
    snapshot: PolarSnapshot
    ground: SectorGround | None = None


@dataclass(frozen=True, slots=True)
class RectOut:
    """Key sectors/rect/<name>."""

    name: str
    snapshot: RectSnapshot


@dataclass(frozen=True, slots=True)
class OdomOut:
    """Key odom: base in the odom frame. covariance: (3, 3) of x, y, yaw. Twist: forward m/s, yaw rad/s; variances."""

    stamp_ns: int
    odom_from_base: Pose2
    covariance: F64
    forward_m_s: float
    yaw_rad_s: float
    forward_variance: float = UNKNOWN_VARIANCE
    yaw_rate_variance: float = UNKNOWN_VARIANCE


@dataclass(frozen=True, slots=True)
class PoseOut:
    """Key pose: base in the map frame, and the correction map_from_odom behind it."""

    stamp_ns: int
    map_from_base: Pose2
    map_from_odom: Pose2
    covariance: F64


@dataclass(frozen=True, slots=True)
class GridOut:
    """Key map/<name>: a whole grid. epoch: counts full grids; updates name the epoch they belong to.

    name: `grid` is the map-fixed grid of the building, the only one with updates; `local` (rolling around the robot)
    and `artos` (the two-step map) are small, sent whole, and have no ROS twin.  frame: in which cell (0, 0) begins at
    frame_from_grid: `map` with the identity for `grid`.
    """

    stamp_ns: int
    epoch: int
    patch: GridPatch
    name: str = "grid"
    frame: str = "map"
    frame_from_grid: Pose2 = IDENTITY


@dataclass(frozen=True, slots=True)
class GridUpdateOut:
    """Key map/grid/update: a changed rectangle of the grid `epoch`."""

    stamp_ns: int
    epoch: int
    patch: GridPatch


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """One device, as health/<sensor> says it. level: 0 ok, 1 warning, 2 error, 3 stale (as in DiagnosticStatus)."""

    name: str
    kind: str
    level: int
    state: str
    text: str
    identity: str
    rate_hz: float
    age_ns: int  # of the newest reading, -1 never
    readings: int
    drops: dict[str, int]
    clock: dict[str, float]


@dataclass(frozen=True, slots=True)
class HealthOut:
    """Keys health, health/<sensor>, health/json."""

    stamp_ns: int
    level: int
    text: str
    sources: tuple[SourceHealth, ...]
    counters: dict[str, int]  # of the daemon itself: queues, drops by name
    process: dict[str, float]  # cpu_percent, memory_mb, ...


@dataclass(frozen=True, slots=True)
class DocumentOut:
    """A JSON document: key `key`, a row of topics.py. fields: what it says, in plain JSON values; schema and stamp are
    added where it is encoded, and an optional `frame` stands in fields like the rest."""

    key: str
    stamp_ns: int
    fields: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class CloudOut:
    """Key cloud/<mount>: the points of one nod or turn of a laser's mount, in the base frame at stamp_ns.

    points_m: (N, 3).  map_from_base: where the base was, None while unknown.  sensor_m: whence ranges were measured.
    """

    mount: str
    stamp_ns: int
    points_m: NDArray[np.float32]
    map_from_base: Pose2 | None
    sensor_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LookOut:
    """One look of a ring, for the makers of maps; not published.

    light, touch: (24,) in [0, 1].  way_m: ahead and left in the body's frame, since the first look; only differences
    mean anything, and none to the look before unless continuous.
    """

    sensor: str
    stamp_ns: int
    light: F64
    touch: F64
    way_m: tuple[float, float]
    continuous: bool


Output = (
    CloudOut
    | LookOut
    | ScanOut
    | RangesOut
    | PolarOut
    | RectOut
    | OdomOut
    | PoseOut
    | GridOut
    | GridUpdateOut
    | HealthOut
    | DocumentOut
)
