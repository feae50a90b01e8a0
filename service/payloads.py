"""What fusion hands out, as the bytes that travel: ROS 2 CDR for standard things, JSON documents for the rest.

Stamps leave as wall clock: the offset wall minus monotonic is handed in with every output. JSON says null where a
number is not known, never NaN. Documents are described in docs/keys.md and docs/schemas/.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.height import Ground
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from mapping.sectors.ground import SectorGround
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot, SectorState
from service import cdr, topics
from service.export import grid_origin
from service.outputs import (
    CloudOut,
    DocumentOut,
    GridOut,
    GridUpdateOut,
    HealthOut,
    LookOut,
    OdomOut,
    Output,
    PolarOut,
    PoseOut,
    RangesOut,
    RectOut,
    ScanOut,
    SourceHealth,
)
from service.topics import Topic

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I16 = NDArray[np.int16]
I8 = NDArray[np.int8]

UPDATE_CELLS_MAX = 32_000  # with the header below 32 KB
GRID_ATTACHMENT = struct.Struct("<QQ")
"""Epoch of the full grid, number of the update within it (from 1; 0 on the full grid itself)."""

_SIDEWAYS_VARIANCE = 1e-4  # wheels do not roll sideways; no number here is 0, which some filters take for certain
_LEVELS = ("ok", "warning", "error", "stale")
_STATES = {state.value: state.name.lower() for state in SectorState}
_CAN_DRIVE = {Ground.TRAVERSABLE.value: "true", Ground.UNKNOWN.value: "null"}
_NANOS = 1_000_000_000
_LONGEST_SCAN_PERIOD_NS = 10 * _NANOS
_UNEVEN = 0.25  # of the angle between beams: what still counts as evenly spaced


@dataclass(slots=True)
class Message:
    """One sample to publish: suffix is the key below the base, stamp_ns wall clock.

    body: the payload, or what makes it of values that stay as they are: for keys that most of the time nobody reads.
    """

    topic: Topic
    suffix: str
    body: bytes | Callable[[], bytes]
    stamp_ns: int
    attachment: bytes | None = None

    @property
    def payload(self) -> bytes:
        """The bytes, made when they are first asked for. Two threads that ask at once make the same."""
        body = self.body
        if not isinstance(body, bytes):
            body = self.body = body()
        return body

    @property
    def encoding(self) -> str:
        """The Zenoh encoding, from the table."""
        return self.topic.encoding


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the reference frames (REP-105). A sensor's frame is named like the sensor."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"


@dataclass(frozen=True, slots=True)
class SensorPlace:
    """Where a sensor sits, for `info` and the fixed transforms. kind: laser, sonar or wheels."""

    name: str
    kind: str
    base_from_sensor: Pose2
    height_m: float = 0.0


@dataclass(frozen=True, slots=True)
class RobotInfo:
    """What the `info` document says. started_ns: wall clock. footprint_m: polygon in the base frame."""

    robot: str
    base_key: str
    version: str
    started_ns: int
    sensors: tuple[SensorPlace, ...] = ()
    footprint_m: tuple[tuple[float, float], ...] = ()
    frames: Frames = Frames()


class Encoder:
    """Outputs to messages. It remembers what single outputs do not say: scan periods and where the full grid lies.

    Scans and grids may be encoded from two threads: their memories are separate.
    """

    def __init__(self, frames: Frames | None = None, *, range_messages: bool = True) -> None:
        """range_messages: also publish each ultrasonic transducer as a ROS 2 Range."""
        self._frames = frames or Frames()
        self._range_messages = range_messages
        self._scan_stamps: dict[str, int] = {}
        self._beams: dict[str, Beams] = {}
        self._ranges_forms: dict[str, RangesForm] = {}
        self._polar_forms: dict[str, SectorForm] = {}
        self._rect_forms: dict[str, SectorForm] = {}
        self._grid: _GridPlace | None = None
        self.cells_outside = 0  # cells of updates that lay outside their full grid and were not sent

    def encode(self, output: Output, wall_offset_ns: int) -> list[Message]:
        """The messages of one output. wall_offset_ns: wall clock minus monotonic clock."""
        match output:
            case LookOut():
                return []
            case CloudOut():
                return [self._cloud(output, wall_offset_ns)]
            case ScanOut():
                return [self._scan(output, wall_offset_ns)]
            case PolarOut():
                return [self._polar(output, wall_offset_ns)]
            case RectOut():
                return [self._rect(output, wall_offset_ns)]
            case OdomOut():
                return self._odom(output, wall_offset_ns)
            case PoseOut():
                return self._pose(output, wall_offset_ns)
            case RangesOut():
                return self._ranges(output, wall_offset_ns)
            case GridOut():
                return [self._full_grid(output, wall_offset_ns)]
            case GridUpdateOut():
                return self._grid_update(output, wall_offset_ns)
            case HealthOut():
                return self._health(output, wall_offset_ns)
            case DocumentOut():
                return [document_message(output, wall_offset_ns)]

    def info(self, info: RobotInfo) -> list[Message]:
        """The messages of `info` and of the fixed transforms, `tf/static`."""
        transforms = [
            cdr.Transform(
                info.started_ns,
                info.frames.base,
                place.name,
                (place.base_from_sensor.x_m, place.base_from_sensor.y_m, place.height_m),
                _quaternion(place.base_from_sensor.yaw_rad),
            )
            for place in info.sensors
        ]
        return [
            Message(topics.INFO, "info", _json(info_document(info)), info.started_ns),
            Message(topics.TF_STATIC, "tf/static", cdr.encode_transforms(transforms), info.started_ns),
        ]

    def _scan(self, out: ScanOut, offset_ns: int) -> Message:
        stamp_ns = out.scan.stamp_ns + offset_ns
        period_ns = out.scan.stamp_ns - self._scan_stamps.get(out.sensor, out.scan.stamp_ns)
        self._scan_stamps[out.sensor] = out.scan.stamp_ns
        scan_time_s = period_ns / _NANOS if 0 < period_ns < _LONGEST_SCAN_PERIOD_NS else 0.0
        beams = self._beams.get(out.sensor)
        if beams is None or beams.bearing_rad is not out.scan.bearing_rad:
            beams = self._beams[out.sensor] = Beams.of(out.scan.bearing_rad)
        body = partial(_laser_bytes, out.scan, out.sensor, stamp_ns, scan_time_s, beams)
        return Message(topics.SCAN, f"scan/{out.sensor}", body, stamp_ns)

    def _cloud(self, out: CloudOut, offset_ns: int) -> Message:
        stamp_ns = out.stamp_ns + offset_ns
        payload = cdr.encode_cloud(cdr.Cloud(stamp_ns, self._frames.base, out.points_m))
        return Message(topics.CLOUD, f"cloud/{out.mount}", payload, stamp_ns)

    def _polar(self, out: PolarOut, offset_ns: int) -> Message:
        snap, stamp_ns = out.snapshot, out.snapshot.stamp_ns + offset_ns
        form = self._polar_forms.get(out.name)
        if form is None or not form.is_of(snap.base_from_sensor, snap.sources, snap.edges_rad):
            heads = _polar_heads(snap.edges_rad)
            begin = _document_begin("polar", out.name, self._frames.base, snap.base_from_sensor)
            form = SectorForm(begin, heads, _POLAR_FIELDS, snap.base_from_sensor, snap.sources, (snap.edges_rad,))
            self._polar_forms[out.name] = form
        body = partial(_polar_document, snap, form, out.ground, stamp_ns)
        return Message(topics.POLAR, f"sectors/polar/{out.name}", body, stamp_ns)

    def _rect(self, out: RectOut, offset_ns: int) -> Message:
        snap, stamp_ns = out.snapshot, out.snapshot.stamp_ns + offset_ns
        form = self._rect_forms.get(out.name)
        if form is None or not form.is_of(snap.base_from_sensor, snap.sources, snap.x_edges_m, snap.y_edges_m):
            rows, columns = snap.shape
            heads, edges = _rect_heads(snap.x_edges_m, snap.y_edges_m), (snap.x_edges_m, snap.y_edges_m)
            begin = _document_begin(
                "rect", out.name, self._frames.base, snap.base_from_sensor, rows=rows, columns=columns
            )
            form = SectorForm(begin, heads, _RECT_FIELDS, snap.base_from_sensor, snap.sources, edges)
            self._rect_forms[out.name] = form
        body = partial(_rect_document, snap, form, stamp_ns)
        return Message(topics.RECT, f"sectors/rect/{out.name}", body, stamp_ns)

    def _odom(self, out: OdomOut, offset_ns: int) -> list[Message]:
        stamp_ns, pose = out.stamp_ns + offset_ns, out.odom_from_base
        body = partial(_odometry_bytes, out, stamp_ns, self._frames.odom, self._frames.base)
        return [
            Message(topics.ODOM, "odom", body, stamp_ns),
            self._transform(stamp_ns, self._frames.odom, self._frames.base, pose),
        ]

    def _pose(self, out: PoseOut, offset_ns: int) -> list[Message]:
        stamp_ns = out.stamp_ns + offset_ns
        return [
            Message(topics.POSE_KEY, "pose", partial(_pose_bytes, out, stamp_ns, self._frames.map), stamp_ns),
            self._transform(stamp_ns, self._frames.map, self._frames.odom, out.map_from_odom),
        ]

    def _transform(self, stamp_ns: int, frame: str, child: str, pose: Pose2) -> Message:
        return Message(topics.TF_KEY, "tf", partial(_transform_bytes, stamp_ns, frame, child, pose), stamp_ns)

    def _ranges(self, out: RangesOut, offset_ns: int) -> list[Message]:
        stamp_ns = out.stamp_ns + offset_ns
        form = self._ranges_forms.get(out.sensor)
        if form is None or not form.is_of(out):
            form = self._ranges_forms[out.sensor] = RangesForm(out, self._frames.base)
        document = partial(form.document, out.range_m, stamp_ns)
        messages = [Message(topics.RANGES, f"range/{out.sensor}", document, stamp_ns)]
        if self._range_messages:
            for number in range(1, len(out.range_m) + 1):
                body = partial(_range_bytes, out, number, stamp_ns)
                messages.append(Message(topics.RANGE_ONE, f"range/{out.sensor}/{number}", body, stamp_ns))
        return messages

    def _full_grid(self, out: GridOut, offset_ns: int) -> Message:
        stamp_ns, suffix = out.stamp_ns + offset_ns, f"map/{out.name}"
        topic = topics.topic_of(suffix)
        if topic is topics.MAP_GRID:
            self._grid = _GridPlace(out.epoch, out.patch.row0, out.patch.col0, *out.patch.cells.shape)
        payload = cdr.encode_grid(grid_message(out.patch, out.frame, out.frame_from_grid, stamp_ns))
        return Message(topic, suffix, payload, stamp_ns, GRID_ATTACHMENT.pack(out.epoch, 0))

    def _grid_update(self, out: GridUpdateOut, offset_ns: int) -> list[Message]:
        place = self._grid
        if place is None or place.epoch != out.epoch:  # its full grid never came by: nobody could apply it
            self.cells_outside += out.patch.cells.size
            return []
        cells, x, y = place.clip(out.patch)
        self.cells_outside += out.patch.cells.size - cells.size
        stamp_ns = out.stamp_ns + offset_ns
        messages = []
        for row, column, piece in _pieces(cells):
            place.updates += 1
            payload = cdr.encode_grid_update(cdr.GridUpdate(stamp_ns, self._frames.map, x + column, y + row, piece))
            attachment = GRID_ATTACHMENT.pack(out.epoch, place.updates)
            messages.append(Message(topics.MAP_GRID_UPDATE, "map/grid/update", payload, stamp_ns, attachment))
        return messages

    def _health(self, out: HealthOut, offset_ns: int) -> list[Message]:
        stamp_ns = out.stamp_ns + offset_ns
        daemon = cdr.Status(
            out.level, "umfeld: daemon", out.text, "", {k: str(v) for k, v in {**out.counters, **out.process}.items()}
        )
        sources = [(source.name, _status_of(source)) for source in out.sources]
        everything = cdr.Diagnostics(stamp_ns, "", (daemon, *(status for _, status in sources)))
        messages = [
            Message(topics.HEALTH, "health", cdr.encode_diagnostics(everything), stamp_ns),
            Message(topics.HEALTH_JSON, "health/json", _json(health_document(out, stamp_ns)), stamp_ns),
        ]
        for name, status in sources:
            payload = cdr.encode_diagnostics(cdr.Diagnostics(stamp_ns, "", (status,)))
            messages.append(Message(topics.HEALTH_ONE, f"health/{name}", payload, stamp_ns))
        return messages


@dataclass(slots=True)
class _GridPlace:
    """Where the newest full grid lies, so that updates can be placed in it."""

    epoch: int
    row0: int
    col0: int
    rows: int
    columns: int
    updates: int = 0

    def clip(self, patch: GridPatch) -> tuple[NDArray[np.int8], int, int]:
        """The part of a patch inside the full grid, and its column and row there."""
        top, left = max(0, self.row0 - patch.row0), max(0, self.col0 - patch.col0)
        x, y = patch.col0 + left - self.col0, patch.row0 + top - self.row0
        cells = patch.cells[top : max(top, top + self.rows - y), left : max(left, left + self.columns - x)]
        return cells, x, y


def _pieces(cells: NDArray[np.int8]) -> list[tuple[int, int, NDArray[np.int8]]]:
    """Cut a rectangle into pieces of at most UPDATE_CELLS_MAX cells: (row, column, piece), whole rows if they fit."""
    rows, columns = cells.shape
    if rows == 0 or columns == 0:
        return []
    width = min(columns, UPDATE_CELLS_MAX)
    height = max(1, UPDATE_CELLS_MAX // width)
    return [
        (row, column, cells[row : row + height, column : column + width])
        for row in range(0, rows, height)
        for column in range(0, columns, width)
    ]


def document_message(out: DocumentOut, wall_offset_ns: int) -> Message:
    """A document with its schema and stamp before its own fields. ValueError if a number in it is not finite."""
    topic, stamp_ns = topics.topic_of(out.key), out.stamp_ns + wall_offset_ns
    document = {"schema": topic.payload, "stamp": stamp_document(stamp_ns), **out.fields}
    return Message(topic, out.key, _json(document), stamp_ns)


@dataclass(frozen=True, slots=True)
class Beams:
    """How a sensor's beams lie, worked out once for all sweeps with these very bearings.

    first_rad, increment_rad: of even beams; is_even: whether they are so.  unwrapped_rad: (N,) without jumps.
    """

    bearing_rad: F64
    unwrapped_rad: F64
    first_rad: float
    increment_rad: float
    is_even: bool

    @classmethod
    def of(cls, bearing_rad: F64) -> Beams:
        """bearing_rad: (N,); what is still writeable is copied, so that it is never taken for itself."""
        count = bearing_rad.size
        if count == 0:
            return cls(bearing_rad, bearing_rad, 0.0, 0.0, True)
        unwrapped: F64 = np.unwrap(bearing_rad)
        first = float(unwrapped[0])
        increment = float(unwrapped[-1] - unwrapped[0]) / (count - 1) if count > 1 else 0.0
        ideal = unwrapped[0] + increment * np.arange(count)
        even = not np.abs(unwrapped - ideal).max() > _UNEVEN * abs(increment)
        known = bearing_rad.copy() if bearing_rad.flags.writeable else bearing_rad
        return cls(known, unwrapped, first, increment, even)


def laser_message(
    scan: Scan, frame: str, stamp_ns: int, scan_time_s: float, *, beams: Beams | None = None
) -> cdr.Laser:
    """A scan as LaserScan (REP-117: +inf nothing, -inf too close, NaN invalid).

    The message knows only evenly spaced beams, in the order measured (a scanner that turns clockwise has a negative
    increment). Beams that are not evenly spaced are sorted into as many even bins, the nearest range of a bin wins,
    an empty bin is NaN.
    """
    count = scan.bearing_rad.size
    if count == 0:
        nothing = np.zeros(0, dtype=np.float32)
        return cdr.Laser(stamp_ns, frame, 0.0, 0.0, 0.0, 0.0, scan_time_s, scan.range_min_m, scan.range_max_m, nothing)
    beams = Beams.of(scan.bearing_rad) if beams is None else beams
    first, increment = beams.first_rad, beams.increment_rad
    last = float(beams.unwrapped_rad[-1])
    ranges = scan.range_m.astype(np.float32)
    if not beams.is_even:
        ranges, low, span = _even_bins(beams.unwrapped_rad, ranges)
        increment = span / (count - 1)
        bearing = np.asarray(low + increment * np.arange(count))
        first, last = float(bearing[0]), float(bearing[-1])
    return cdr.Laser(
        stamp_ns,
        frame,
        first,
        last,
        increment,
        scan.beam_period_ns / _NANOS,
        scan_time_s,
        scan.range_min_m,
        scan.range_max_m,
        ranges,
    )


def _even_bins(bearing_rad: F64, range_m: F32) -> tuple[F32, float, float]:
    """Ranges in as many even bins as there are beams; returns them, the first bin's bearing and the signed span."""
    low, high = float(bearing_rad.min()), float(bearing_rad.max())
    if high - low > 2.0 * math.pi:  # a little more than a turn: fold the rest onto its beginning
        bearing_rad = low + (bearing_rad - low) % (2.0 * math.pi)
        high = float(bearing_rad.max())
    if bearing_rad[0] > bearing_rad[-1]:
        low, high = high, low
    count = bearing_rad.size
    step = (high - low) / (count - 1) or 1.0
    index = np.clip(np.rint((bearing_rad - low) / step).astype(np.int64), 0, count - 1)
    bins = np.full(count, np.nan, dtype=np.float32)
    np.fmin.at(bins, index, range_m)  # fmin: a range beats NaN, -inf (too close) beats all
    return bins, low, high - low


def _laser_bytes(scan: Scan, frame: str, stamp_ns: int, scan_time_s: float, beams: Beams) -> bytes:
    return cdr.encode_laser(laser_message(scan, frame, stamp_ns, scan_time_s, beams=beams))


def _odometry_bytes(out: OdomOut, stamp_ns: int, frame: str, child: str) -> bytes:
    pose = out.odom_from_base
    twist = np.zeros((6, 6))
    twist[0, 0], twist[1, 1], twist[5, 5] = out.forward_variance, _SIDEWAYS_VARIANCE, out.yaw_rate_variance
    return cdr.encode_odometry(
        cdr.OdometryMessage(
            stamp_ns,
            frame,
            child,
            (pose.x_m, pose.y_m, 0.0),
            _quaternion(pose.yaw_rad),
            _planar_covariance(out.covariance),
            (out.forward_m_s, 0.0, 0.0),
            (0.0, 0.0, out.yaw_rad_s),
            twist,
        )
    )


def _pose_bytes(out: PoseOut, stamp_ns: int, frame: str) -> bytes:
    pose = out.map_from_base
    position, turn = (pose.x_m, pose.y_m, 0.0), _quaternion(pose.yaw_rad)
    return cdr.encode_pose(cdr.PoseWithCovariance(stamp_ns, frame, position, turn, _planar_covariance(out.covariance)))


def _transform_bytes(stamp_ns: int, frame: str, child: str, pose: Pose2) -> bytes:
    transform = cdr.Transform(stamp_ns, frame, child, (pose.x_m, pose.y_m, 0.0), _quaternion(pose.yaw_rad))
    return cdr.encode_transforms([transform])


def grid_message(patch: GridPatch, frame: str, frame_from_grid: Pose2, stamp_ns: int) -> cdr.Grid:
    """A grid as OccupancyGrid: row 0 lowest, origin at the lower left corner of the first cell."""
    origin = grid_origin(patch, frame_from_grid)
    position, turn = (origin.x_m, origin.y_m, 0.0), _quaternion(origin.yaw_rad)
    return cdr.Grid(stamp_ns, frame, patch.resolution_m, position, turn, patch.cells)


class RangesForm:
    """What is the same in all documents of one chain, umfeld.ranges.v1."""

    def __init__(self, out: RangesOut, base_frame: str) -> None:
        self._of = _chain_of(out)
        before = {"schema": "umfeld.ranges.v1", "sensor": out.sensor}
        after = {
            "frame": base_frame,
            "cone_rad": _number(out.cone_rad, 5),
            "range_min_m": _number(out.range_min_m),
            "range_max_m": _number(out.range_max_m),
        }
        self._before = f'{_json(before)[:-1].decode()},"stamp":'
        self._after = f',{_json(after)[1:-1].decode()},"transducers":['
        self._heads = [
            f'{{"number":{number},"pose":{_json(pose_document(pose)).decode()},"status":"'
            for number, pose in enumerate(out.base_from_transducer, start=1)
        ]

    def is_of(self, out: RangesOut) -> bool:
        """Whether a round has this form."""
        return self._of == _chain_of(out)

    def document(self, range_m: Sequence[float], stamp_ns: int) -> bytes:
        """The document of one round. range_m: by transducer."""
        told = ",".join(
            f'{head}{_range_status(each)}","range_m":{repr(round(each, 4)) if math.isfinite(each) else "null"}}}'
            for head, each in zip(self._heads, range_m)
        )
        return f"{self._before}{_json(stamp_document(stamp_ns)).decode()}{self._after}{told}]}}".encode()


def _chain_of(out: RangesOut) -> tuple[object, ...]:
    return out.base_from_transducer, out.cone_rad, out.range_min_m, out.range_max_m


def _range_bytes(out: RangesOut, number: int, stamp_ns: int) -> bytes:
    """One transducer of a round, numbered from 1."""
    range_m, frame = out.range_m[number - 1], f"{out.sensor}_{number}"
    one = cdr.RangeOne(stamp_ns, frame, out.cone_rad, out.range_min_m, out.range_max_m, range_m)
    return cdr.encode_range(one)


def _range_status(range_m: float) -> str:
    if math.isnan(range_m):
        return "invalid"
    if math.isinf(range_m):
        return "nothing" if range_m > 0 else "too_close"
    return "echo"


def health_document(out: HealthOut, stamp_ns: int) -> dict[str, object]:
    """umfeld.health.v1."""
    return {
        "schema": "umfeld.health.v1",
        "stamp": stamp_document(stamp_ns),
        "level": _level(out.level),
        "text": out.text,
        "sources": [
            {
                "name": source.name,
                "kind": source.kind,
                "level": _level(source.level),
                "state": source.state,
                "text": source.text,
                "identity": source.identity,
                "rate_hz": _number(source.rate_hz, 2),
                "age_s": _number(source.age_ns / _NANOS, 3) if source.age_ns >= 0 else None,
                "readings": source.readings,
                "drops": dict(source.drops),
                "clock": {key: _number(value, 3) for key, value in source.clock.items()},
            }
            for source in out.sources
        ],
        "counters": dict(out.counters),
        "process": {key: _number(value, 3) for key, value in out.process.items()},
    }


def info_document(info: RobotInfo) -> dict[str, object]:
    """umfeld.info.v1."""
    return {
        "schema": "umfeld.info.v1",
        "project": "umfeld",
        "version": info.version,
        "robot": info.robot,
        "base_key": info.base_key,
        "started": stamp_document(info.started_ns),
        "frames": {"map": info.frames.map, "odom": info.frames.odom, "base": info.frames.base},
        "footprint_m": [list(corner) for corner in info.footprint_m],
        "sensors": [
            {
                "name": place.name,
                "kind": place.kind,
                "frame": place.name,
                "pose": {**pose_document(place.base_from_sensor), "z_m": _number(place.height_m)},
            }
            for place in info.sensors
        ],
        "keys": [
            {
                "key": f"{info.base_key}/{topic.pattern}",
                "payload": topic.payload,
                "encoding": topic.encoding,
                "rate": topic.rate,
                "cached": topic.cached,
                "meaning": topic.meaning,
            }
            for topic in topics.TOPICS
        ],
    }


def stamp_document(stamp_ns: int) -> dict[str, int]:
    """A wall clock stamp as ROS has it: whole seconds since 1970 and nanoseconds (a double could not hold both)."""
    seconds, nanos = divmod(stamp_ns, _NANOS)
    return {"sec": seconds, "nanosec": nanos}


def pose_document(pose: Pose2) -> dict[str, float | None]:
    """A planar pose."""
    return {"x_m": _number(pose.x_m), "y_m": _number(pose.y_m), "yaw_rad": _number(pose.yaw_rad, 6)}


def _json(document: Mapping[str, object]) -> bytes:
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def _number(value: float, digits: int = 4) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _level(level: int) -> str:
    return _LEVELS[level] if 0 <= level < len(_LEVELS) else "error"


def _quaternion(yaw_rad: float) -> cdr.Quaternion:
    return (0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0))


def _planar_covariance(covariance: F64) -> F64:
    """(3, 3) of x, y, yaw into the (6, 6) of x, y, z, roll, pitch, yaw; what a planar vehicle cannot do is 0."""
    if covariance.shape != (3, 3):
        raise ValueError(f"a covariance of x, y, yaw is (3, 3), not {covariance.shape}")
    wide = np.zeros((6, 6))
    wide[:2, :2], wide[:2, 5], wide[5, :2], wide[5, 5] = (
        covariance[:2, :2], covariance[:2, 2], covariance[2, :2], covariance[2, 2],
    )  # fmt: skip
    return wide


def _status_of(source: SourceHealth) -> cdr.Status:
    values = {
        "kind": source.kind,
        "state": source.state,
        "rate_hz": f"{source.rate_hz:.2f}",
        "age_s": f"{source.age_ns / _NANOS:.3f}" if source.age_ns >= 0 else "never",
        "readings": str(source.readings),
        **{f"drops.{reason}": str(count) for reason, count in source.drops.items()},
        **{f"clock.{key}": f"{value:.3f}" for key, value in source.clock.items()},
    }
    return cdr.Status(source.level, f"umfeld: {source.name}", source.text or source.state, source.identity, values)


# The sector documents go out at up to 40 Hz each: what never changes is kept ready, the rest is compiled.

_POLAR_FIELDS = (("bearing_rad", 5), ("distance_m", 4), ("clearance_m", 4), ("age_s", 3), ("free_m", 4))
_RECT_FIELDS = (("x_m", 4), ("y_m", 4), ("distance_m", 4), ("age_s", 3))
_NO_ROOM = 64  # for what is counted elsewhere


class _Texts:
    """Texts one after the other, as compiled code takes them. starts: (N + 1,)."""

    def __init__(self, texts: Sequence[str]) -> None:
        raw = [text.encode() for text in texts]
        self.bytes = np.frombuffer(b"".join(raw), dtype=np.uint8).copy()
        self.starts = np.concatenate(([0], np.cumsum([len(each) for each in raw], dtype=np.int64)))
        self.longest = max((len(each) for each in raw), default=0)


class SectorForm:
    """What is the same in all documents of one sector map.

    begin: texts before and after the stamp.  heads: each sector up to its state.  fields: names of numbers, and their
    digits after the point.  edges: what heads were made of.
    """

    def __init__(
        self,
        begin: tuple[str, str],
        heads: Sequence[str],
        fields: Sequence[tuple[str, int]],
        base_from_sensor: Pose2,
        sources: Sequence[str],
        edges: tuple[F64, ...],
    ) -> None:
        self._before, self._after = (text.encode() for text in begin)
        self._place, self._sources, self._edges = base_from_sensor, tuple(sources), edges
        self._heads = _Texts(heads)
        self._words = _Texts([_STATES[number] for number in range(len(_STATES))] + _source_names(sources))
        names = [name for name, _ in fields]
        self._labels = _Texts([f'","{names[0]}":', *(f',"{name}":' for name in names[1:]), ',"source":'])
        self._digits = np.array([digits for _, digits in fields], dtype=np.int64)
        self._null = len(_STATES) + len(sources)

    def is_of(self, base_from_sensor: Pose2, sources: Sequence[str], *edges: F64) -> bool:
        """Whether a snapshot has this form."""
        if self._place != base_from_sensor or self._sources != tuple(sources):
            return False
        return all(ours is theirs or np.array_equal(ours, theirs) for ours, theirs in zip(self._edges, edges))

    def document(
        self, stamp_ns: int, state: I8, columns: F64, source: I16, ground: SectorGround | None = None
    ) -> bytes:
        """The document. columns: (K, N) numbers by field, null where not finite.  source: (N,), negative for none."""
        from mapping.kernels import texts  # here, for programs that only read what others encode

        count = len(state)
        room = self._labels.starts[-1] + len(self._digits) * texts.LONGEST + 2 * self._words.longest + _NO_ROOM
        out = np.empty(len(self._heads.bytes) + count * int(room), dtype=np.uint8)
        heads, words, labels = self._heads, self._words, self._labels
        length = texts.write_rows(
            out, heads.bytes, heads.starts, words.bytes, words.starts, labels.bytes, labels.starts,
            state, np.ascontiguousarray(columns), self._digits, source, self._null, len(_STATES),
        )  # fmt: skip
        sectors = out[:length].tobytes() if length >= 0 else self._slowly(state, columns, source)
        if ground is not None:  # a sector holds no other object
            sectors = ",".join(_with_ground(sectors.decode().replace("},{", "}\n{").split("\n"), ground)).encode()
        seconds, nanos = divmod(stamp_ns, _NANOS)
        stamp = b'{"sec":%d,"nanosec":%d}' % (seconds, nanos)
        return b"".join((self._before, stamp, self._after, sectors, b"]}"))

    def _slowly(self, state: I8, columns: F64, source: I16) -> bytes:
        """The same with numbers larger than compiled code takes, beyond all distances."""

        def text(texts: _Texts, number: int) -> str:
            return texts.bytes[texts.starts[number] : texts.starts[number + 1]].tobytes().decode()

        layouts = [f"%.{digits}f" for digits in self._digits]
        sectors = []
        for row, values in enumerate(columns.T.tolist()):
            numbers = [layout % value if math.isfinite(value) else "null" for layout, value in zip(layouts, values)]
            parts = [text(self._labels, k) + number for k, number in enumerate(numbers)]
            name = self._null if source[row] < 0 else len(_STATES) + int(source[row])
            head = text(self._heads, row) + text(self._words, int(state[row]))
            sectors.append(f"{head}{''.join(parts)}{text(self._labels, len(numbers))}{text(self._words, name)}}}")
        return ",".join(sectors).encode()


def _polar_document(snap: PolarSnapshot, form: SectorForm, ground: SectorGround | None, stamp_ns: int) -> bytes:
    free_m = _nan_like(snap.distance_m) if snap.free_m is None else snap.free_m
    columns = np.array((snap.bearing_rad, snap.distance_m, snap.clearance_m, _seconds(snap.age_ns), free_m))
    return form.document(stamp_ns, snap.state, columns, snap.source, ground)


def _rect_document(snap: RectSnapshot, form: SectorForm, stamp_ns: int) -> bytes:
    known = snap.squares
    x, y = known.x_m.ravel(), known.y_m.ravel()
    columns = np.array((x, y, np.hypot(x, y), _seconds(known.age_ns.ravel())))
    return form.document(stamp_ns, known.state.ravel(), columns, known.source.ravel())


def _nan_like(values: F64) -> F64:
    return np.full(len(values), np.nan)


def _seconds(age_ns: I64) -> F64:
    """NaN where there is no age."""
    seconds = age_ns / _NANOS
    seconds[age_ns < 0] = np.nan
    return seconds


def _document_begin(kind: str, name: str, frame: str, origin: Pose2, **more: int) -> tuple[str, str]:
    before = {"schema": "umfeld.sectors.v1", "kind": kind, "name": name}
    after = {"frame": frame, "origin": pose_document(origin), **more}
    texts = [json.dumps(each, separators=(",", ":"), ensure_ascii=False)[1:-1] for each in (before, after)]
    return f'{{{texts[0]},"stamp":', f',{texts[1]},"sectors":['


def _polar_heads(edges_rad: F64) -> list[str]:
    edges = edges_rad.tolist()
    return [
        f'{{"index":{i},"start_rad":{a:.6f},"stop_rad":{b:.6f},"center_rad":{(a + b) / 2.0:.6f},"state":"'
        for i, (a, b) in enumerate(pairwise(edges))
    ]


def _with_ground(sectors: Sequence[str], ground: SectorGround) -> list[str]:
    """Each sector with its ground; what is not known to be traversable is never said to be."""
    return [
        f'{sector[:-1]},"slope_rad":{slope},"traversable":{_CAN_DRIVE.get(stop, "false")},"traversable_m":{way}}}'
        for sector, slope, stop, way in zip(
            sectors,
            _texts(ground.slope_rad, "%.4f"),
            ground.stopped_by.tolist(),
            _texts(ground.traversable_m, "%.3f"),
        )
    ]


def _rect_heads(x_edges_m: F64, y_edges_m: F64) -> list[str]:
    xs, ys = x_edges_m.tolist(), y_edges_m.tolist()
    return [
        f'{{"row":{row},"column":{column},"x_start_m":{x0:.4f},"x_stop_m":{x1:.4f},'
        f'"y_start_m":{y0:.4f},"y_stop_m":{y1:.4f},"state":"'
        for row, (y0, y1) in enumerate(pairwise(ys))
        for column, (x0, x1) in enumerate(pairwise(xs))
    ]


def _source_names(sources: Sequence[str]) -> list[str]:
    """JSON text by source index; the last entry, which index -1 finds, is null."""
    return [*(json.dumps(name) for name in sources), "null"]


def _texts(values: F64, layout: str) -> list[str]:
    return [layout % value if value - value == 0.0 else "null" for value in values.tolist()]  # inf, NaN: null
