"""ROS 2 messages as bytes: OMG CDR, plain, little endian, for the few types that the daemon publishes.

Every message begins with the header 00 01 00 00; numbers are aligned to their own size (at most 8), counted from
after that header; a string is its length with the final NUL, the bytes, the NUL; nothing is padded at the end.
Written by hand because it starts at once and costs microseconds; tests hold it against an independent serialiser.
Field orders: the .msg files of common_interfaces, geometry2 and navigation_msgs.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I8 = NDArray[np.int8]

_HEADER = b"\x00\x01\x00\x00"
_NANOS = 1_000_000_000
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class CdrError(ValueError):
    """The bytes are not the message they are said to be."""


@dataclass(frozen=True, slots=True)
class Laser:
    """sensor_msgs/msg/LaserScan without intensities. stamp_ns: wall clock."""

    stamp_ns: int
    frame: str
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: F32


@dataclass(frozen=True, slots=True)
class RangeOne:
    """sensor_msgs/msg/Range of an ultrasonic transducer."""

    stamp_ns: int
    frame: str
    field_of_view: float
    min_range: float
    max_range: float
    range: float


@dataclass(frozen=True, slots=True)
class Grid:
    """nav_msgs/msg/OccupancyGrid. origin: the pose of the lower left corner of cells[0, 0]; cells: (rows, columns)."""

    stamp_ns: int
    frame: str
    resolution: float
    origin_position: Vector3
    origin_orientation: Quaternion
    cells: I8


@dataclass(frozen=True, slots=True)
class GridUpdate:
    """map_msgs/msg/OccupancyGridUpdate. x, y: column and row of cells[0, 0] in the full grid."""

    stamp_ns: int
    frame: str
    x: int
    y: int
    cells: I8


@dataclass(frozen=True, slots=True)
class PoseWithCovariance:
    """geometry_msgs/msg/PoseWithCovarianceStamped. covariance: (6, 6) of x, y, z, roll, pitch, yaw."""

    stamp_ns: int
    frame: str
    position: Vector3
    orientation: Quaternion
    covariance: F64


@dataclass(frozen=True, slots=True)
class OdometryMessage:
    """nav_msgs/msg/Odometry; the twist is in the child frame."""

    stamp_ns: int
    frame: str
    child_frame: str
    position: Vector3
    orientation: Quaternion
    covariance: F64
    linear: Vector3
    angular: Vector3
    twist_covariance: F64


@dataclass(frozen=True, slots=True)
class Transform:
    """geometry_msgs/msg/TransformStamped: coordinates in child_frame to coordinates in frame."""

    stamp_ns: int
    frame: str
    child_frame: str
    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, slots=True)
class Status:
    """diagnostic_msgs/msg/DiagnosticStatus. level: 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """diagnostic_msgs/msg/DiagnosticArray."""

    stamp_ns: int
    frame: str
    statuses: tuple[Status, ...]


@dataclass(frozen=True, slots=True)
class Cloud:
    """sensor_msgs/msg/PointCloud2 of x, y, z as 4-byte numbers, one row. points_m: (N, 3)."""

    stamp_ns: int
    frame: str
    points_m: F32


class _Writer:
    """Appends aligned values. Positions count from after the four header bytes, as buf does."""

    __slots__ = ("buf",)

    def __init__(self) -> None:
        self.buf = bytearray()

    def align(self, size: int) -> None:
        self.buf += bytes(-len(self.buf) % size)

    def pack(self, size: int, layout: str, *values: float) -> None:
        """Values that all have this size, or a layout without inner gaps that begins with this alignment."""
        self.align(size)
        self.buf += struct.pack(layout, *values)

    def string(self, text: str) -> None:
        raw = text.replace("\0", " ").encode("utf-8", "replace")
        self.pack(4, "<I", len(raw) + 1)
        self.buf += raw + b"\0"

    def header(self, stamp_ns: int, frame: str) -> None:
        self.stamp(stamp_ns)
        self.string(frame)

    def stamp(self, stamp_ns: int) -> None:
        self.pack(4, "<iI", *divmod(stamp_ns, _NANOS))

    def doubles(self, values: Sequence[float]) -> None:
        self.pack(8, f"<{len(values)}d", *values)

    def matrix(self, values: F64) -> None:
        self.align(8)
        self.buf += np.ascontiguousarray(values, dtype="<f8").tobytes()

    def floats(self, values: F32) -> None:
        self.pack(4, "<I", values.size)
        self.buf += np.ascontiguousarray(values, dtype="<f4").tobytes()

    def octets(self, values: I8) -> None:
        self.pack(4, "<I", values.size)
        self.buf += np.ascontiguousarray(values, dtype=np.int8).tobytes()

    def message(self) -> bytes:
        return _HEADER + bytes(self.buf)


def encode_laser(scan: Laser) -> bytes:
    """The bytes of a LaserScan; intensities are empty."""
    w = _Writer()
    w.header(scan.stamp_ns, scan.frame)
    w.pack(
        4,
        "<7f",
        scan.angle_min,
        scan.angle_max,
        scan.angle_increment,
        scan.time_increment,
        scan.scan_time,
        scan.range_min,
        scan.range_max,
    )
    w.floats(scan.ranges)
    w.pack(4, "<I", 0)
    return w.message()


def encode_range(one: RangeOne) -> bytes:
    """The bytes of a Range (Iron and later, which end with a variance: 0, unknown)."""
    w = _Writer()
    w.header(one.stamp_ns, one.frame)
    w.pack(1, "<B", 0)  # ULTRASOUND
    w.pack(4, "<5f", one.field_of_view, one.min_range, one.max_range, one.range, 0.0)
    return w.message()


def encode_grid(grid: Grid) -> bytes:
    """The bytes of an OccupancyGrid; map_load_time is the stamp."""
    w = _Writer()
    w.header(grid.stamp_ns, grid.frame)
    w.stamp(grid.stamp_ns)
    rows, columns = grid.cells.shape
    w.pack(4, "<fII", grid.resolution, columns, rows)
    w.doubles((*grid.origin_position, *grid.origin_orientation))
    w.octets(grid.cells)
    return w.message()


def encode_grid_update(update: GridUpdate) -> bytes:
    """The bytes of an OccupancyGridUpdate."""
    w = _Writer()
    w.header(update.stamp_ns, update.frame)
    rows, columns = update.cells.shape
    w.pack(4, "<iiII", update.x, update.y, columns, rows)
    w.octets(update.cells)
    return w.message()


def encode_pose(pose: PoseWithCovariance) -> bytes:
    """The bytes of a PoseWithCovarianceStamped."""
    w = _Writer()
    w.header(pose.stamp_ns, pose.frame)
    w.doubles((*pose.position, *pose.orientation))
    w.matrix(pose.covariance)
    return w.message()


def encode_odometry(odometry: OdometryMessage) -> bytes:
    """The bytes of an Odometry."""
    w = _Writer()
    w.header(odometry.stamp_ns, odometry.frame)
    w.string(odometry.child_frame)
    w.doubles((*odometry.position, *odometry.orientation))
    w.matrix(odometry.covariance)
    w.doubles((*odometry.linear, *odometry.angular))
    w.matrix(odometry.twist_covariance)
    return w.message()


def encode_transforms(transforms: Sequence[Transform]) -> bytes:
    """The bytes of a TFMessage."""
    w = _Writer()
    w.pack(4, "<I", len(transforms))
    for transform in transforms:
        w.header(transform.stamp_ns, transform.frame)
        w.string(transform.child_frame)
        w.doubles((*transform.translation, *transform.rotation))
    return w.message()


def encode_diagnostics(diagnostics: Diagnostics) -> bytes:
    """The bytes of a DiagnosticArray."""
    w = _Writer()
    w.header(diagnostics.stamp_ns, diagnostics.frame)
    w.pack(4, "<I", len(diagnostics.statuses))
    for status in diagnostics.statuses:
        w.pack(1, "<B", status.level)
        w.string(status.name)
        w.string(status.message)
        w.string(status.hardware_id)
        w.pack(4, "<I", len(status.values))
        for key, value in status.values.items():
            w.string(key)
            w.string(value)
    return w.message()


_FLOAT32 = 7  # of PointField
_POINT_BYTES = 12


def encode_cloud(cloud: Cloud) -> bytes:
    """The bytes of a PointCloud2; dense: all points are finite."""
    w = _Writer()
    w.header(cloud.stamp_ns, cloud.frame)
    count = len(cloud.points_m)
    w.pack(4, "<III", 1, count, 3)
    for number, axis in enumerate("xyz"):
        w.string(axis)
        w.pack(4, "<I", 4 * number)
        w.pack(1, "<B", _FLOAT32)
        w.pack(4, "<I", 1)
    w.pack(1, "<B", 0)  # little endian
    w.pack(4, "<III", _POINT_BYTES, _POINT_BYTES * count, _POINT_BYTES * count)
    w.buf += np.ascontiguousarray(cloud.points_m, dtype="<f4").tobytes()
    w.pack(1, "<B", 1)
    return w.message()


class _Reader:
    """Takes aligned values; every length is checked against what is left before anything is made of it."""

    __slots__ = ("at", "body")

    def __init__(self, payload: bytes) -> None:
        if len(payload) < 4 or payload[:2] != b"\x00\x01":
            raise CdrError(f"not little-endian CDR: begins with {payload[:4].hex(' ') or 'nothing'}")
        self.body = memoryview(payload)[4:]
        self.at = 0

    def take(self, alignment: int, size: int) -> memoryview:
        start = self.at + -self.at % alignment
        if size < 0 or start + size > len(self.body):
            raise CdrError(f"cut short: {size} bytes wanted at {start}, {len(self.body)} there")
        self.at = start + size
        return self.body[start : start + size]

    def unpack(self, alignment: int, layout: str) -> tuple[float, ...]:
        return struct.unpack(layout, self.take(alignment, struct.calcsize(layout)))

    def uint(self) -> int:
        return int(struct.unpack("<I", self.take(4, 4))[0])

    def string(self) -> str:
        raw = bytes(self.take(1, 0) if (length := self.uint()) == 0 else self.take(1, length))
        return raw.rstrip(b"\0").decode("utf-8", "replace")

    def stamp(self) -> int:
        seconds, nanos = struct.unpack("<iI", self.take(4, 8))
        return int(seconds) * _NANOS + int(nanos)

    def array(self, dtype: str, count: int) -> NDArray[np.generic]:
        size = np.dtype(dtype).itemsize
        return np.frombuffer(self.take(size, size * count), dtype=dtype)

    def vector(self) -> Vector3:
        x, y, z = self.unpack(8, "<3d")
        return x, y, z

    def quaternion(self) -> Quaternion:
        x, y, z, w = self.unpack(8, "<4d")
        return x, y, z, w

    def covariance(self) -> F64:
        return self.array("<f8", 36).astype(np.float64).reshape(6, 6)

    def cells(self, rows: int, columns: int) -> I8:
        count = self.uint()
        if count != rows * columns:
            raise CdrError(f"{count} cells for {rows} rows of {columns}")
        return self.array("i1", count).astype(np.int8).reshape(rows, columns)


def decode_laser(payload: bytes) -> Laser:
    """The message in the bytes; CdrError if they are not one. The same for the other decode functions."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    a0, a1, da, dt, period, near, far = r.unpack(4, "<7f")
    ranges = r.array("<f4", r.uint()).astype(np.float32)
    return Laser(stamp_ns, frame, a0, a1, da, dt, period, near, far, ranges)


def decode_range(payload: bytes) -> RangeOne:
    """A Range, with or without the variance that Iron added."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    r.take(1, 1)
    return RangeOne(stamp_ns, frame, *r.unpack(4, "<4f"))


def decode_grid(payload: bytes) -> Grid:
    """An OccupancyGrid."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    r.stamp()
    (resolution,) = r.unpack(4, "<f")
    columns, rows = r.uint(), r.uint()
    return Grid(stamp_ns, frame, resolution, r.vector(), r.quaternion(), r.cells(rows, columns))


def decode_grid_update(payload: bytes) -> GridUpdate:
    """An OccupancyGridUpdate."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    x, y = struct.unpack("<ii", r.take(4, 8))
    columns, rows = r.uint(), r.uint()
    return GridUpdate(stamp_ns, frame, x, y, r.cells(rows, columns))


def decode_cloud(payload: bytes) -> Cloud:
    """A PointCloud2 whose fields are x, y, z as 4-byte numbers, in this order and little endian."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    rows, columns = r.uint(), r.uint()
    fields = []
    for _ in range(_bounded(r, 13)):
        name, (offset,), kind, (number,) = r.string(), r.unpack(4, "<I"), r.take(1, 1)[0], r.unpack(4, "<I")
        fields.append((name, offset, kind, number))
    big_endian = r.take(1, 1)[0]
    point_bytes, _, size = r.uint(), r.uint(), r.uint()
    if big_endian or fields != [(axis, 4 * k, _FLOAT32, 1) for k, axis in enumerate("xyz")]:
        raise CdrError(f"a cloud of {[name for name, *_ in fields]}, not of x, y, z as 4-byte numbers")
    if point_bytes != _POINT_BYTES or size != rows * columns * _POINT_BYTES:
        raise CdrError(f"{size} bytes for {rows * columns} points of {point_bytes}")
    points = np.frombuffer(r.take(1, size), dtype="<f4").astype(np.float32).reshape(-1, 3)
    return Cloud(stamp_ns, frame, points)


def decode_pose(payload: bytes) -> PoseWithCovariance:
    """A PoseWithCovarianceStamped."""
    r = _Reader(payload)
    return PoseWithCovariance(r.stamp(), r.string(), r.vector(), r.quaternion(), r.covariance())


def decode_odometry(payload: bytes) -> OdometryMessage:
    """An Odometry."""
    r = _Reader(payload)
    return OdometryMessage(
        r.stamp(),
        r.string(),
        r.string(),
        r.vector(),
        r.quaternion(),
        r.covariance(),
        r.vector(),
        r.vector(),
        r.covariance(),
    )


def decode_transforms(payload: bytes) -> tuple[Transform, ...]:
    """The transforms of a TFMessage."""
    r = _Reader(payload)
    return tuple(
        Transform(r.stamp(), r.string(), r.string(), r.vector(), r.quaternion()) for _ in range(_bounded(r, 72))
    )


def decode_diagnostics(payload: bytes) -> Diagnostics:
    """A DiagnosticArray."""
    r = _Reader(payload)
    stamp_ns, frame = r.stamp(), r.string()
    return Diagnostics(stamp_ns, frame, tuple(_status(r) for _ in range(_bounded(r, 14))))


def _status(r: _Reader) -> Status:
    level = r.take(1, 1)[0]
    name, message, hardware_id = r.string(), r.string(), r.string()
    return Status(level, name, message, hardware_id, {r.string(): r.string() for _ in range(_bounded(r, 8))})


def _bounded(r: _Reader, least_size: int) -> int:
    """An element count that the bytes left can hold."""
    count = r.uint()
    if count * least_size > len(r.body):
        raise CdrError(f"{count} elements in {len(r.body)} bytes")
    return count
