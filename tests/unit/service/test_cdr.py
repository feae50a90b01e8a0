"""Our CDR bytes against an independent serialiser (rosbags), and the reader against anything."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from service import cdr, topics

GRID_UPDATE_TEXT = """
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
"""

# LaserScan, frame laser, ranges 1, 2, inf, nan, 0.05: bytes that other programs have read.
KNOWN_LASER = bytes.fromhex(
    "0001000000f1536515cd5b07060000006c617365720000000000c0bf0000c03f0000403f00000000cdcccc3dcdcccc3d00004041050000"
    "000000803f000000400000807f0000c07fcdcc4c3d00000000"
)


@cache
def typestore() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(GRID_UPDATE_TEXT, topics.GRID_UPDATE))
    return store


def reference(ros_type: str, message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, ros_type))


def make(ros_type: str, **fields: Any) -> Any:
    return typestore().types[ros_type](**fields)


def header(stamp_ns: int, frame: str) -> Any:
    seconds, nanos = divmod(stamp_ns, 1_000_000_000)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanos)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def pose(position: cdr.Vector3, orientation: cdr.Quaternion) -> Any:
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=position[0], y=position[1], z=position[2]),
        orientation=quaternion(orientation),
    )


def quaternion(q: cdr.Quaternion) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])


def vector(v: cdr.Vector3) -> Any:
    return make("geometry_msgs/msg/Vector3", x=v[0], y=v[1], z=v[2])


stamps = st.integers(0, 2**31 * 1_000_000_000 - 1)
frames = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
singles = st.floats(width=32, allow_nan=False)
doubles = st.floats(allow_nan=False)
vectors = st.tuples(doubles, doubles, doubles)
quaternions = st.tuples(doubles, doubles, doubles, doubles)
cells = st.tuples(st.integers(0, 5), st.integers(0, 7), st.integers(0, 2**31)).map(
    lambda t: np.random.default_rng(t[2]).integers(-1, 101, (t[0], t[1])).astype(np.int8)
)
matrices = st.integers(0, 2**31).map(lambda seed: np.random.default_rng(seed).normal(size=(6, 6)))


def test_known_laser_bytes() -> None:
    ranges = np.array([1, 2, np.inf, np.nan, 0.05], dtype=np.float32)
    scan = cdr.Laser(1_700_000_000_123_456_789, "laser", -1.5, 1.5, 0.75, 0.0, 0.1, 0.1, 12.0, ranges)
    assert cdr.encode_laser(scan) == KNOWN_LASER


@given(stamps, frames, st.lists(singles, min_size=7, max_size=7), st.lists(st.floats(width=32), max_size=40))
def test_laser(stamp_ns: int, frame: str, n: list[float], ranges: list[float]) -> None:
    values = np.array(ranges, dtype=np.float32)
    ours = cdr.encode_laser(cdr.Laser(stamp_ns, frame, n[0], n[1], n[2], n[3], n[4], n[5], n[6], values))
    message = make(
        topics.LASER_SCAN,
        header=header(stamp_ns, frame),
        angle_min=n[0],
        angle_max=n[1],
        angle_increment=n[2],
        time_increment=n[3],
        scan_time=n[4],
        range_min=n[5],
        range_max=n[6],
        ranges=values,
        intensities=np.zeros(0, dtype=np.float32),
    )
    assert ours == reference(topics.LASER_SCAN, message)
    again = cdr.decode_laser(ours)
    assert (again.stamp_ns, again.frame) == (stamp_ns, frame)
    np.testing.assert_array_equal(again.ranges, values)


@given(stamps, frames, st.integers(0, 9), st.integers(0, 2**31))
def test_cloud(stamp_ns: int, frame: str, count: int, seed: int) -> None:
    points = np.random.default_rng(seed).normal(0.0, 10.0, (count, 3)).astype(np.float32)
    ours = cdr.encode_cloud(cdr.Cloud(stamp_ns, frame, points))
    fields = [
        make("sensor_msgs/msg/PointField", name=axis, offset=4 * k, datatype=7, count=1) for k, axis in enumerate("xyz")
    ]
    message = make(
        topics.CLOUD_TYPE,
        header=header(stamp_ns, frame),
        height=1,
        width=count,
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * count,
        data=np.frombuffer(points.tobytes(), dtype=np.uint8),
        is_dense=True,
    )
    assert ours == reference(topics.CLOUD_TYPE, message)
    again = cdr.decode_cloud(ours)
    assert (again.stamp_ns, again.frame) == (stamp_ns, frame)
    np.testing.assert_array_equal(again.points_m, points)


@given(stamps, frames, st.lists(singles, min_size=4, max_size=4))
def test_range(stamp_ns: int, frame: str, n: list[float]) -> None:
    ours = cdr.encode_range(cdr.RangeOne(stamp_ns, frame, *n))
    message = make(
        topics.RANGE,
        header=header(stamp_ns, frame),
        radiation_type=0,
        field_of_view=n[0],
        min_range=n[1],
        max_range=n[2],
        range=n[3],
        variance=0.0,
    )
    assert ours == reference(topics.RANGE, message)
    assert cdr.decode_range(ours) == cdr.RangeOne(stamp_ns, frame, *n)


@given(stamps, frames, singles, vectors, quaternions, cells)
def test_grid(
    stamp_ns: int, frame: str, resolution: float, at: cdr.Vector3, turn: cdr.Quaternion, values: cdr.I8
) -> None:
    ours = cdr.encode_grid(cdr.Grid(stamp_ns, frame, resolution, at, turn, values))
    head = header(stamp_ns, frame)
    info = make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=head.stamp,
        resolution=resolution,
        width=values.shape[1],
        height=values.shape[0],
        origin=pose(at, turn),
    )
    message = make(topics.GRID, header=head, info=info, data=values.ravel())
    assert ours == reference(topics.GRID, message)
    again = cdr.decode_grid(ours)
    assert (again.origin_position, again.origin_orientation, again.resolution) == (at, turn, resolution)
    np.testing.assert_array_equal(again.cells, values)


@given(stamps, frames, st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1), cells)
def test_grid_update(stamp_ns: int, frame: str, x: int, y: int, values: cdr.I8) -> None:
    ours = cdr.encode_grid_update(cdr.GridUpdate(stamp_ns, frame, x, y, values))
    message = make(
        topics.GRID_UPDATE,
        header=header(stamp_ns, frame),
        x=x,
        y=y,
        width=values.shape[1],
        height=values.shape[0],
        data=values.ravel(),
    )
    assert ours == reference(topics.GRID_UPDATE, message)
    again = cdr.decode_grid_update(ours)
    assert (again.x, again.y) == (x, y)
    np.testing.assert_array_equal(again.cells, values)


@given(stamps, frames, vectors, quaternions, matrices)
def test_pose(stamp_ns: int, frame: str, at: cdr.Vector3, turn: cdr.Quaternion, covariance: cdr.F64) -> None:
    ours = cdr.encode_pose(cdr.PoseWithCovariance(stamp_ns, frame, at, turn, covariance))
    inner = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(at, turn), covariance=covariance.ravel())
    assert ours == reference(topics.POSE, make(topics.POSE, header=header(stamp_ns, frame), pose=inner))
    again = cdr.decode_pose(ours)
    assert (again.position, again.orientation) == (at, turn)
    np.testing.assert_array_equal(again.covariance, covariance)


@given(stamps, frames, frames, vectors, quaternions, matrices, vectors, vectors)
def test_odometry(
    stamp_ns: int,
    frame: str,
    child: str,
    at: cdr.Vector3,
    turn: cdr.Quaternion,
    covariance: cdr.F64,
    linear: cdr.Vector3,
    angular: cdr.Vector3,
) -> None:
    ours = cdr.encode_odometry(
        cdr.OdometryMessage(stamp_ns, frame, child, at, turn, covariance, linear, angular, covariance.T)
    )
    message = make(
        topics.ODOMETRY,
        header=header(stamp_ns, frame),
        child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(at, turn), covariance=covariance.ravel()),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make("geometry_msgs/msg/Twist", linear=vector(linear), angular=vector(angular)),
            covariance=np.ascontiguousarray(covariance.T).ravel(),
        ),
    )
    assert ours == reference(topics.ODOMETRY, message)
    again = cdr.decode_odometry(ours)
    assert (again.child_frame, again.position, again.linear, again.angular) == (child, at, linear, angular)


@given(st.lists(st.tuples(stamps, frames, frames, vectors, quaternions), max_size=4))
def test_transforms(rows: list[tuple[int, str, str, cdr.Vector3, cdr.Quaternion]]) -> None:
    ours = cdr.encode_transforms([cdr.Transform(*row) for row in rows])
    message = make(
        topics.TF,
        transforms=[
            make(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp_ns, frame),
                child_frame_id=child,
                transform=make("geometry_msgs/msg/Transform", translation=vector(at), rotation=quaternion(turn)),
            )
            for stamp_ns, frame, child, at, turn in rows
        ],
    )
    assert ours == reference(topics.TF, message)
    assert cdr.decode_transforms(ours) == tuple(cdr.Transform(*row) for row in rows)


statuses = st.builds(cdr.Status, st.integers(0, 3), frames, frames, frames, st.dictionaries(frames, frames, max_size=3))


@given(stamps, frames, st.lists(statuses, max_size=3).map(tuple))
def test_diagnostics(stamp_ns: int, frame: str, rows: tuple[cdr.Status, ...]) -> None:
    ours = cdr.encode_diagnostics(cdr.Diagnostics(stamp_ns, frame, rows))
    message = make(
        topics.DIAGNOSTICS,
        header=header(stamp_ns, frame),
        status=[
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=row.level,
                name=row.name,
                message=row.message,
                hardware_id=row.hardware_id,
                values=[make("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in row.values.items()],
            )
            for row in rows
        ],
    )
    assert ours == reference(topics.DIAGNOSTICS, message)
    assert cdr.decode_diagnostics(ours) == cdr.Diagnostics(stamp_ns, frame, rows)


DECODERS: tuple[Callable[[bytes], object], ...] = (
    cdr.decode_laser,
    cdr.decode_range,
    cdr.decode_grid,
    cdr.decode_grid_update,
    cdr.decode_pose,
    cdr.decode_odometry,
    cdr.decode_transforms,
    cdr.decode_diagnostics,
)


@pytest.mark.parametrize("decode", DECODERS)
@given(noise=st.binary(max_size=400), with_header=st.booleans())
def test_noise_is_refused_or_read_but_never_crashes(
    decode: Callable[[bytes], object], noise: bytes, with_header: bool
) -> None:
    with contextlib.suppress(cdr.CdrError):
        decode(b"\x00\x01\x00\x00" + noise if with_header else noise)


def test_every_prefix_is_refused() -> None:
    for length in range(len(KNOWN_LASER) - 4):
        with pytest.raises(cdr.CdrError):
            cdr.decode_laser(KNOWN_LASER[:length])


def test_huge_counts_allocate_nothing() -> None:
    with pytest.raises(cdr.CdrError):
        cdr.decode_transforms(b"\x00\x01\x00\x00\xff\xff\xff\xff")
    head = cdr.encode_grid(cdr.Grid(0, "", 0.05, (0, 0, 0), (0, 0, 0, 1), np.zeros((0, 0), np.int8)))
    with pytest.raises(cdr.CdrError):
        cdr.decode_grid(head[:-4] + b"\xff\xff\xff\x7f")
