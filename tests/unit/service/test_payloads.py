"""Outputs to bytes: meaning survives, null instead of NaN, pieces of updates add up, cost."""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2, wrap_angle
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from mapping.sectors.polar import PolarSectors
from mapping.sectors.rectangular import RectSectors
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot, SectorState, Squares
from service import cdr, topics
from service.outputs import (
    GridOut,
    GridUpdateOut,
    HealthOut,
    OdomOut,
    Output,
    PolarOut,
    PoseOut,
    RangesOut,
    RectOut,
    ScanOut,
    SourceHealth,
)
from service.payloads import GRID_ATTACHMENT, Encoder, Message, RobotInfo, SensorPlace, laser_message

OFFSET = 1_700_000_000_000_000_000


def scan_of(bearings: list[float] | np.ndarray, ranges: list[float] | np.ndarray, stamp_ns: int = 5) -> Scan:
    return Scan(stamp_ns, 1000.0, np.asarray(bearings, float), np.asarray(ranges, float), 0.1, 30.0)


def polar(count: int, seed: int = 0) -> PolarSnapshot:
    rng = np.random.default_rng(seed)
    unknown = rng.random(count) < 0.3
    distance = np.where(unknown, np.nan, rng.uniform(0, 5, count))
    return PolarSnapshot(
        123,
        Pose2(0.1, -0.2, 0.3),
        np.linspace(-math.pi, math.pi, count + 1),
        rng.integers(0, 4, count).astype(np.int8),
        distance,
        np.where(unknown, np.nan, rng.uniform(-3, 3, count)),
        distance - 0.2,
        np.where(unknown, -1, rng.integers(0, 10**9, count)),
        np.where(unknown, -1, 0).astype(np.int16),
        ('a "quoted" name',),
        rng.uniform(0, 5, count),
    )


def test_scan_carries_the_conventions_for_no_range() -> None:
    ranges = [1.0, math.inf, -math.inf, math.nan, 2.0]
    scan = scan_of(np.linspace(-1, 1, 5), ranges)
    (message,) = Encoder().encode(ScanOut("front", scan, Pose2(), 0.2), OFFSET)
    laser = cdr.decode_laser(message.payload)
    assert message.suffix == "scan/front"
    assert message.encoding == "application/cdr;sensor_msgs/msg/LaserScan"
    assert (laser.stamp_ns, laser.frame) == (OFFSET + 5, "front")
    np.testing.assert_array_equal(laser.ranges, np.array(ranges, np.float32))
    assert laser.angle_min == -1.0
    assert laser.angle_max == 1.0
    assert laser.angle_increment == pytest.approx(0.5)
    assert laser.time_increment == pytest.approx(1e-6)


def test_scan_time_is_the_time_between_scans_of_one_sensor() -> None:
    encoder = Encoder()
    times = []
    for stamp_ns, sensor in ((0, "a"), (7, "b"), (25_000_000, "a"), (50_000_000, "a"), (60_050_000_000, "a")):
        scan = scan_of([0.0, 0.1], [1.0, 1.0], stamp_ns)
        (message,) = encoder.encode(ScanOut(sensor, scan, Pose2(), 0.0), OFFSET)
        times.append(cdr.decode_laser(message.payload).scan_time)
    assert times == pytest.approx([0.0, 0.0, 0.025, 0.025, 0.0])


@given(st.integers(2, 400), st.floats(-3.1, 3.1), st.floats(0.2, 6.2), st.booleans(), st.integers(0, 2**31))
def test_even_beams_keep_their_order_and_direction(
    count: int, first: float, span: float, clockwise: bool, seed: int
) -> None:
    step = (-span if clockwise else span) / (count - 1)
    bearings = np.array([wrap_angle(first + step * i) for i in range(count)])
    ranges = np.random.default_rng(seed).uniform(0.1, 30, count)
    laser = laser_message(scan_of(bearings, ranges), "x", 0, 0.0)
    np.testing.assert_array_equal(laser.ranges, ranges.astype(np.float32))
    for index in (0, count // 2, count - 1):
        assert math.cos(laser.angle_min + index * laser.angle_increment - bearings[index]) == pytest.approx(1.0)


@given(st.integers(30, 300), st.booleans(), st.integers(0, 2**31))
def test_uneven_beams_never_move_far_nor_lose_the_nearest(count: int, clockwise: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bearings = np.cumsum(rng.uniform(0.2, 1.8, count))
    bearings *= 2 * math.pi * (count - 1) / count / (bearings[-1] - bearings[0])
    bearings -= bearings[0] + 1.0
    ranges = rng.uniform(0.1, 30, count)
    if clockwise:
        bearings = -bearings
    laser = laser_message(scan_of(bearings, ranges), "x", 0, 0.0)
    assert laser.ranges.size == count
    assert (laser.angle_increment < 0) == clockwise
    angles = laser.angle_min + laser.angle_increment * np.arange(count)
    half = abs(laser.angle_increment) / 2 + 1e-6
    for angle, value in zip(angles, laser.ranges):
        near = np.abs(bearings - angle) <= half
        if np.isfinite(value):
            assert np.any(np.isclose(ranges[near], value, rtol=1e-6))
        else:
            assert np.isnan(value)  # a gap is never "nothing there"
    for bearing, value in zip(bearings, ranges):
        # fmin: on the border of two bins the beam is in one of them, and the other may be a gap
        assert np.fmin.reduce(laser.ranges[np.abs(angles - bearing) <= half]) <= np.float32(value)


@pytest.mark.parametrize("count", [0, 1])
def test_tiny_scans(count: int) -> None:
    laser = laser_message(scan_of([0.5] * count, [1.0] * count), "x", 0, 0.0)
    assert laser.ranges.size == count
    assert math.isfinite(laser.angle_increment)


@given(st.integers(1, 80), st.integers(0, 2**31))
def test_polar_document_says_what_the_snapshot_says(count: int, seed: int) -> None:
    snapshot = polar(count, seed)
    (message,) = Encoder().encode(PolarOut("laser", snapshot), OFFSET)
    document = json.loads(message.payload, parse_constant=lambda text: pytest.fail(f"{text} in JSON"))
    assert document["stamp"] == {"sec": 1_700_000_000, "nanosec": 123}
    assert document["origin"] == {"x_m": 0.1, "y_m": -0.2, "yaw_rad": 0.3}
    starts = [sector["start_rad"] for sector in document["sectors"]]
    assert starts == sorted(starts)
    assert len(starts) == count
    for i, sector in enumerate(document["sectors"]):
        assert sector["index"] == i
        assert SectorState[sector["state"].upper()] == snapshot.state[i]
        assert sector["start_rad"] <= sector["center_rad"] <= sector["stop_rad"]
        for key, values in (("distance_m", snapshot.distance_m), ("clearance_m", snapshot.clearance_m)):
            assert sector[key] == (None if math.isnan(values[i]) else pytest.approx(values[i], abs=1e-4))
        age = snapshot.age_ns[i]
        assert sector["age_s"] == (None if age < 0 else pytest.approx(age / 1e9, abs=1e-3))
        assert snapshot.free_m is not None
        assert sector["free_m"] == pytest.approx(snapshot.free_m[sector["index"]], abs=1e-4)
        assert sector["source"] == (None if snapshot.source[i] < 0 else snapshot.sources[0])


def test_a_payload_is_made_when_it_is_asked_for_and_once() -> None:
    made: list[bytes] = []

    def make() -> bytes:
        made.append(b"bytes")
        return made[-1]

    message = Message(topics.SCAN, "scan/front", make, 0)
    assert not made
    assert message.payload is message.payload is made[0]
    assert len(made) == 1


def test_what_is_encoded_later_says_what_was_so_then() -> None:
    """Nothing that comes after an output changes its message: it may be made long after, for a get()."""
    sectors: list[PolarSectors | RectSectors] = [PolarSectors(sources=("front",)), RectSectors(sources=("front",))]
    encoder, bearing = Encoder(), np.linspace(-2.0, 2.0, 1081)
    texts: list[bytes] = []
    waiting: list[Message] = []
    for k in range(4):
        for each in sectors:
            each.update_beams(
                "front", base_from_sensor=Pose2(0.1 * k, 0.0, 0.2 * k), bearing_rad=bearing,
                range_m=np.full(1081, 1.0 + 0.3 * k), range_min_m=0.1, range_max_m=30.0, stamp_ns=k * 25_000_000,
            )  # fmt: skip
            snapshot = each.snapshot(k * 25_000_000)
            output = PolarOut("laser", snapshot) if isinstance(snapshot, PolarSnapshot) else RectOut("r", snapshot)
            texts += [message.payload for message in encoder.encode(output, OFFSET)]
            waiting += encoder.encode(output, OFFSET)
    assert [message.payload for message in waiting] == texts
    assert len(set(texts)) == len(texts)


@pytest.mark.parametrize("count", [1, 7, 48])
def test_the_slow_way_writes_the_same(count: int) -> None:
    """One number beyond all distances has a document written by the interpreter; the other sectors read the same."""
    snapshot = polar(count, 3)
    (fast,) = Encoder().encode(PolarOut("laser", snapshot), OFFSET)
    snapshot.distance_m[0] = 7e15
    (slow,) = Encoder().encode(PolarOut("laser", snapshot), OFFSET)
    ours, theirs = json.loads(fast.payload), json.loads(slow.payload)
    assert theirs["sectors"][0].pop("distance_m") == 7e15
    ours["sectors"][0].pop("distance_m")
    assert ours == theirs
    assert fast.payload.split(b'"index":1,')[1:] == slow.payload.split(b'"index":1,')[1:]


def test_polar_document_follows_changed_edges() -> None:
    encoder = Encoder()
    encoder.encode(PolarOut("laser", polar(4)), OFFSET)
    (message,) = encoder.encode(PolarOut("laser", polar(6)), OFFSET)
    assert len(json.loads(message.payload)["sectors"]) == 6


def test_infinite_numbers_become_null() -> None:
    snapshot = polar(3)
    snapshot.distance_m[:] = (math.inf, -math.inf, math.nan)
    (message,) = Encoder().encode(PolarOut("laser", snapshot), OFFSET)
    assert [sector["distance_m"] for sector in json.loads(message.payload)["sectors"]] == [None, None, None]


def test_rect_document_goes_row_by_row() -> None:
    state = np.array([[0, 1, 2], [3, 2, 1]], np.int8)
    nearest = np.array([[0.3, np.nan, np.nan], [1.5, np.nan, np.nan]])
    snapshot = RectSnapshot(
        0,
        Pose2(),
        np.array([0.0, 1.0, 2.0, 3.0]),
        np.array([-1.0, 0.0, 1.0]),
        ("front",),
        lambda: Squares(state, nearest, nearest, np.full((2, 3), 10), np.zeros((2, 3), np.int16)),
    )
    (message,) = Encoder().encode(RectOut("around", snapshot), OFFSET)
    document = json.loads(message.payload)
    assert (document["rows"], document["columns"]) == (2, 3)
    for at, sector in enumerate(document["sectors"]):
        row, column = divmod(at, 3)
        assert (sector["row"], sector["column"]) == (row, column)
        assert (sector["x_start_m"], sector["y_start_m"]) == (column, row - 1)
        assert SectorState[sector["state"].upper()] == state[row, column]
    assert document["sectors"][0]["distance_m"] == pytest.approx(math.hypot(0.3, 0.3), abs=1e-4)


def test_odom_and_pose_come_with_their_transforms() -> None:
    covariance = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    odom, tf = Encoder().encode(OdomOut(9, Pose2(1, 2, math.pi / 2), covariance, 0.5, -0.1, 0.04, 0.09), OFFSET)
    message = cdr.decode_odometry(odom.payload)
    assert (message.frame, message.child_frame, message.position) == ("odom", "base_link", (1.0, 2.0, 0.0))
    assert message.orientation == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))
    assert message.covariance[0, 5] == 3.0
    assert message.covariance[5, 1] == 5.0
    assert message.linear == (0.5, 0.0, 0.0)
    assert message.angular == (0.0, 0.0, -0.1)
    assert [message.twist_covariance[index, index] for index in (0, 1, 5)] == [0.04, 1e-4, 0.09]
    (transform,) = cdr.decode_transforms(tf.payload)
    assert (transform.frame, transform.child_frame) == ("odom", "base_link")

    pose, tf = Encoder().encode(PoseOut(9, Pose2(1, 2, 3), Pose2(4, 5, 0), covariance), OFFSET)
    assert cdr.decode_pose(pose.payload).frame == "map"
    (transform,) = cdr.decode_transforms(tf.payload)
    assert (transform.frame, transform.child_frame, transform.translation) == ("map", "odom", (4.0, 5.0, 0.0))


def test_ranges_as_document_and_one_by_one() -> None:
    values = (1.5, math.inf, -math.inf, math.nan)
    out = RangesOut("chain", 0, (Pose2(),) * 4, 0.5, 0.1, 3.0, values)
    document, *ones = Encoder().encode(out, OFFSET)
    transducers = json.loads(document.payload)["transducers"]
    assert [entry["status"] for entry in transducers] == ["echo", "nothing", "too_close", "invalid"]
    assert [entry["range_m"] for entry in transducers] == [1.5, None, None, None]
    assert [one.suffix for one in ones] == [f"range/chain/{n}" for n in (1, 2, 3, 4)]
    np.testing.assert_array_equal([cdr.decode_range(one.payload).range for one in ones], values)


def test_health_levels_and_words() -> None:
    source = SourceHealth(
        "front", "laser", 3, "silent", "no answer", "URG", 0.0, -1, 4, {"bad_sum": 2}, {"x": math.nan}
    )
    everything, document, one = Encoder().encode(HealthOut(1, 2, "bad", (source,), {"sent": 3}, {}), OFFSET)
    statuses = cdr.decode_diagnostics(everything.payload).statuses
    assert [(s.level, s.name) for s in statuses] == [(2, "umfeld: daemon"), (3, "umfeld: front")]
    assert cdr.decode_diagnostics(one.payload).statuses[0].values["drops.bad_sum"] == "2"
    entry = json.loads(document.payload)["sources"][0]
    assert (entry["level"], entry["age_s"], entry["clock"]) == ("stale", None, {"x": None})


def grid_out(epoch: int, row0: int, col0: int, shape: tuple[int, int]) -> GridOut:
    return GridOut(0, epoch, GridPatch(0.05, row0, col0, np.full(shape, -1, np.int8)))


def test_grid_lies_where_its_patch_says() -> None:
    (message,) = Encoder().encode(grid_out(7, -3, 4, (2, 5)), OFFSET)
    grid = cdr.decode_grid(message.payload)
    assert grid.cells.shape == (2, 5)
    assert grid.origin_position == pytest.approx((0.2, -0.15, 0.0))
    assert message.attachment is not None
    assert struct.unpack("<QQ", message.attachment) == (7, 0)


small = st.integers(-30, 30)


@given(
    small,
    small,
    st.integers(1, 40),
    st.integers(1, 40),
    st.lists(st.tuples(small, small, st.integers(0, 50), st.integers(0, 50)), max_size=6),
)
def test_updates_build_the_grid_that_was_changed(
    row0: int, col0: int, rows: int, columns: int, changes: list[tuple[int, int, int, int]]
) -> None:
    """A client that only knows the messages ends with the same cells; what lies outside is clipped and counted."""
    encoder = Encoder()
    (full,) = encoder.encode(grid_out(1, row0, col0, (rows, columns)), OFFSET)
    client = cdr.decode_grid(full.payload).cells.copy()
    truth = {(r, c): -1 for r in range(row0, row0 + rows) for c in range(col0, col0 + columns)}
    outside = 0
    for number, (r0, c0, height, width) in enumerate(changes, start=1):
        patch = GridPatch(0.05, r0, c0, np.full((height, width), number, np.int8))
        for r in range(r0, r0 + height):
            for c in range(c0, c0 + width):
                outside += (r, c) not in truth
                if (r, c) in truth:
                    truth[r, c] = number
        for message in encoder.encode(GridUpdateOut(0, 1, patch), OFFSET):
            update = cdr.decode_grid_update(message.payload)
            h, w = update.cells.shape
            client[update.y : update.y + h, update.x : update.x + w] = update.cells
    expected = np.array([truth[r, c] for r in range(row0, row0 + rows) for c in range(col0, col0 + columns)])
    np.testing.assert_array_equal(client.ravel(), expected)
    assert encoder.cells_outside == outside


@pytest.mark.parametrize("shape", [(300, 700), (1, 100_000), (70_000, 1)])
def test_updates_come_in_small_numbered_pieces(shape: tuple[int, int]) -> None:
    encoder = Encoder()
    encoder.encode(grid_out(3, 0, 0, shape), OFFSET)
    cells = np.random.default_rng(0).integers(-1, 101, shape).astype(np.int8)
    messages = encoder.encode(GridUpdateOut(0, 3, GridPatch(0.05, 0, 0, cells)), OFFSET)
    assert all(len(message.payload) <= 32 * 1024 for message in messages)
    numbers = [GRID_ATTACHMENT.unpack(message.attachment or b"") for message in messages]
    assert numbers == [(3, n) for n in range(1, len(messages) + 1)]
    built = np.full(shape, -1, np.int8)
    for message in messages:
        update = cdr.decode_grid_update(message.payload)
        h, w = update.cells.shape
        built[update.y : update.y + h, update.x : update.x + w] = update.cells
    np.testing.assert_array_equal(built, cells)


def test_an_update_of_an_epoch_never_sent_is_not_sent() -> None:
    encoder = Encoder()
    update = GridUpdateOut(0, 2, GridPatch(0.05, 0, 0, np.zeros((2, 2), np.int8)))
    assert encoder.encode(update, OFFSET) == []
    encoder.encode(grid_out(1, 0, 0, (2, 2)), OFFSET)
    assert encoder.encode(update, OFFSET) == []
    assert encoder.cells_outside == 8


def test_info_names_every_key_and_the_fixed_transforms() -> None:
    place = SensorPlace("front", "laser", Pose2(0.3, 0.0, math.pi), 0.25)
    info, fixed = Encoder().info(RobotInfo("r1", "robots/r1", "0.1", OFFSET, (place,)))
    document = json.loads(info.payload)
    assert [entry["key"] for entry in document["keys"]] == [f"robots/r1/{topic.pattern}" for topic in topics.TOPICS]
    (transform,) = cdr.decode_transforms(fixed.payload)
    assert (transform.frame, transform.child_frame, transform.translation) == ("base_link", "front", (0.3, 0.0, 0.25))
    assert transform.rotation == pytest.approx((0.0, 0.0, 1.0, 0.0), abs=1e-9)


def test_every_message_has_its_row_in_the_table() -> None:
    encoder = Encoder()
    outputs: list[Output] = [
        ScanOut("front", scan_of([0, 1], [1, 1]), Pose2(), 0.0),
        RangesOut("chain", 0, (Pose2(),), 0.5, 0.1, 3.0, (1.0,)),
        PolarOut("laser", polar(3)),
        OdomOut(0, Pose2(), np.eye(3), 0, 0),
        PoseOut(0, Pose2(), Pose2(), np.eye(3)),
        grid_out(1, 0, 0, (2, 2)),
        GridUpdateOut(0, 1, GridPatch(0.05, 0, 0, np.zeros((1, 1), np.int8))),
        HealthOut(0, 0, "", (SourceHealth("front", "laser", 0, "", "", "", 0, -1, 0, {}, {}),), {}, {}),
    ]
    for output in outputs:
        for message in encoder.encode(output, OFFSET):
            assert topics.topic_of(message.suffix) is message.topic


def operations(work: Callable[[], object]) -> int:
    """How many instructions of Python something takes: its cost, on any machine."""
    count = 0

    def trace(frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def test_python_does_nothing_element_by_element() -> None:
    """Sector maps and scans are encoded as arrays: ten times as many elements are no more work for the interpreter."""
    encoder = Encoder()

    def scan(beams: int) -> ScanOut:
        return ScanOut("front", scan_of(np.linspace(-2.3, 2.3, beams), np.ones(beams)), Pose2(), 0.2)

    def cost(output: Output) -> int:
        return operations(lambda: [message.payload for message in encoder.encode(output, 0)])

    pairs: list[tuple[Output, Output]] = [
        (PolarOut("coarse", polar(36)), PolarOut("fine", polar(360))),
        (scan(108), scan(1081)),
    ]
    for small, large in pairs:
        cost(small)
        cost(large)  # what depends on the number of elements alone is kept
        assert 0 < cost(large) <= cost(small) + 50 < 2000


def test_other_grids_lie_in_their_own_frame_and_leave_the_first_alone() -> None:
    encoder = Encoder()
    encoder.encode(grid_out(1, 0, 0, (4, 4)), OFFSET)
    patch = GridPatch(0.1, 0, 10, np.zeros((2, 3), np.int8))
    turned = Pose2(2.0, 1.0, math.pi / 2)
    (message,) = encoder.encode(GridOut(0, 9, patch, "artos", "odom", turned), OFFSET)
    grid = cdr.decode_grid(message.payload)
    assert (message.suffix, grid.frame) == ("map/artos", "odom")
    assert message.topic is topics.MAP_ARTOS
    assert grid.origin_position == pytest.approx((2.0, 2.0, 0.0))
    assert grid.origin_orientation == pytest.approx((0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))
    update = GridUpdateOut(0, 1, GridPatch(0.05, 3, 3, np.zeros((1, 1), np.int8)))
    assert len(encoder.encode(update, OFFSET)) == 1
    with pytest.raises(KeyError, match="no topic"):
        encoder.encode(GridOut(0, 1, patch, "nameless"), OFFSET)
