"""OBSTACLE_DISTANCE: the 72 numbers against literal geometry, the bytes against vectors and pymavlink's reading."""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.waiting import GIVE_UP_S

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported

from pymavlink.dialects.v20 import common

from drivers.errors import PortAbsent
from drivers.mavlink_frames import DISTANCE_SENSOR, HEARTBEAT, OBSTACLE_DISTANCE, WHEEL_DISTANCE, encode_v2
from mapping.frames import IDENTITY, Pose2
from mapping.sectors.polar import PolarSectors
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from service.mavlink_out import (
    UNKNOWN,
    MavlinkOut,
    Settings,
    Talker,
    distances_cm,
    distances_m,
    seen_reach_m,
    sensor_type_of,
)
from service.outputs import PolarOut

F64 = NDArray[np.float64]
SECOND = 1_000_000_000
BODY = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
OBST, FREE, UNKN, STAL = SectorState.OBSTACLE, SectorState.FREE, SectorState.UNKNOWN, SectorState.STALE


def snapshot(
    states: list[SectorState],
    distances: list[float],
    *,
    start_deg: float = -180.0,
    stop_deg: float = 180.0,
    pose: Pose2 = IDENTITY,
    stamp_ns: int = SECOND,
) -> PolarSnapshot:
    count = len(states)
    edges = np.radians(np.linspace(start_deg, stop_deg, count + 1))
    state = np.array([int(each) for each in states], dtype=np.int8)
    distance = np.where(state == int(UNKN), np.nan, np.array(distances, dtype=np.float64))
    bearing = np.where(state == int(OBST), 0.5 * (edges[1:] + edges[:-1]), np.nan)
    none = np.full(count, -1)
    return PolarSnapshot(
        stamp_ns,
        pose,
        edges,
        state,
        distance,
        bearing,
        distance,
        none.astype(np.int64),
        none.astype(np.int16),
        ("front",),
    )


def all_free(distance_m: float = 20.0, count: int = 72, **changes: float) -> PolarSnapshot:
    return snapshot([FREE] * count, [distance_m] * count, **changes)  # type: ignore[arg-type]


# --- the numbers


def test_an_obstacle_stands_where_it_is_clockwise_from_ahead() -> None:
    for bearing_deg, index in ((0, 0), (-90, 18), (90, 54), (180, 36), (-45, 9), (5, 71)):
        # Sectors of 5 degrees centred like the elements: then each is one element.
        states, reach = [FREE] * 72, [20.0] * 72
        sector = round((bearing_deg + 180) / 5) % 72
        states[sector], reach[sector] = OBST, 3.0
        found = distances_m(snapshot(states, reach, start_deg=-182.5, stop_deg=177.5), 10.0, BODY)
        assert [k for k in range(72) if found[k] == 3.0] == [index]
        assert np.isinf(np.delete(found, index)).all()


def test_what_was_not_looked_at_is_unknown_and_stale_is_not_free() -> None:
    half = distances_m(snapshot([FREE] * 36, [20.0] * 36, start_deg=-90.0, stop_deg=90.0), 10.0, BODY)
    assert np.isinf(half[:18]).all()
    assert np.isnan(half[18:55]).all(), "the element at the edge was looked at only in part"
    assert np.isinf(half[55:]).all()
    for state in (UNKN, STAL):
        assert np.isnan(distances_m(snapshot([state] * 72, [3.0] * 72), 10.0, BODY)).all()
    assert np.isnan(distances_m(all_free(9.0), 10.0, BODY)).all(), "free to 9 m is not free to 10 m"
    assert np.isinf(distances_m(all_free(9.0), 9.0, BODY)).all()


def test_an_obstacle_beyond_the_limit_is_empty_up_to_it() -> None:
    assert np.isinf(distances_m(snapshot([OBST] * 72, [12.0] * 72), 10.0, BODY)).all()


STATES = st.lists(st.tuples(st.sampled_from([OBST, FREE, UNKN, STAL]), st.floats(0.3, 15.0)), min_size=1, max_size=90)


def claims(known: F64, element: int) -> float:
    """How far the message says that an element is free, m."""
    return 0.0 if math.isnan(known[element]) else float(known[element])


def literal_free(snap: PolarSnapshot, bearing_rad: float) -> float:
    """How far the map knows that a bearing, seen from the base, is free; the virtual sensor is at the base."""
    bearing = bearing_rad - snap.base_from_sensor.yaw_rad
    turned = snap.edges_rad[0] + (bearing - snap.edges_rad[0]) % (2 * math.pi)
    for k in range(len(snap.state)):
        if snap.edges_rad[k] <= turned < snap.edges_rad[k + 1]:
            return float(snap.distance_m[k]) if snap.state[k] in (int(OBST), int(FREE)) else 0.0
    return 0.0


@given(STATES, st.floats(-180, 180), st.floats(10, 360), st.floats(-3, 3), st.floats(-2.4, 2.4))
@settings(max_examples=60, deadline=None)
def test_no_element_is_freer_than_the_map_and_no_obstacle_is_lost(
    sectors: list[tuple[SectorState, float]], start: float, span: float, yaw: float, off_deg: float
) -> None:
    states, reach = [state for state, _ in sectors], [distance for _, distance in sectors]
    snap = snapshot(states, reach, start_deg=start, stop_deg=start + span, pose=Pose2(0.0, 0.0, yaw))
    known = distances_m(snap, 10.0, BODY)
    for element in range(72):
        bearing = math.radians(-5.0 * element + off_deg)
        if np.isinf(known[element]):
            assert literal_free(snap, bearing) >= 10.0 - 1e-9
    for k in range(len(states)):
        if states[k] is OBST and reach[k] <= 10.0:
            element = round(-math.degrees(snap.bearing_rad[k] + yaw) / 5.0) % 72
            assert known[element] <= reach[k]


@given(
    st.floats(-0.4, 0.4),
    st.floats(-0.4, 0.4),
    st.floats(-math.pi, math.pi),
    st.lists(st.tuples(st.floats(-6, 6), st.floats(-6, 6)), max_size=8),
)
@settings(max_examples=40, deadline=None)
def test_from_a_sensor_elsewhere_no_obstacle_is_lost_and_none_is_hidden(
    x_m: float, y_m: float, yaw: float, posts: list[tuple[float, float]]
) -> None:
    posts = [post for post in posts if math.hypot(*post) > 1.0]
    pose = Pose2(x_m, y_m, yaw)
    sectors = PolarSectors(
        sources=("front",),
        start_rad=-math.pi,
        stop_rad=math.pi,
        sector_rad=math.radians(5.0),
        base_from_sensor=pose,
        stale_after_ns=SECOND,
        footprint=np.array(BODY),
        range_max_m=math.inf,
    )
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    distance = np.full(bearing.shape, np.inf)
    for post in posts:  # 5 cm thick
        at = pose.inverse().apply(np.array([post]))[0]
        r, b = math.hypot(*at), math.atan2(at[1], at[0])
        hit = np.abs(np.angle(np.exp(1j * (bearing - b)))) <= max(math.asin(min(1.0, 0.05 / r)), math.radians(0.5))
        distance[hit] = np.minimum(distance[hit], r)
    sectors.update_beams(
        "front",
        base_from_sensor=pose,
        bearing_rad=bearing,
        range_m=distance,
        range_min_m=0.05,
        range_max_m=12.0,
        stamp_ns=0,
    )
    known = distances_m(sectors.snapshot(0), 8.0, BODY)
    for x, y in posts:
        element = round(-math.degrees(math.atan2(y, x)) / 5.0) % 72
        neighbours = [(element + d) % 72 for d in (-1, 0, 1)]
        nearest = min(claims(known, k) for k in neighbours)
        assert nearest <= math.hypot(x, y) + 0.06, "an obstacle is there, and no element around says free beyond it"
        assert not np.isinf(known[element]) or any(np.isfinite(known[k]) for k in neighbours)
    if not posts:
        assert np.isinf(known).sum() >= 60, "an empty room is seen to be empty"


def test_centimetres_are_never_more_than_there_are() -> None:
    known = np.full(72, np.nan)
    known[:5] = [2.999, 0.02, 10.0, np.inf, 3.0]
    assert distances_cm(known, 10, 1000)[:6] == (299, 10, 1000, 1001, 300, UNKNOWN)


def test_sensor_type_is_that_of_what_feeds_the_map() -> None:
    assert [sensor_type_of(kinds) for kinds in (["laser", "laser"], ["sonar"], ["laser", "sonar"], [])] == [0, 1, 4, 4]
    assert seen_reach_m(snapshot([UNKN, STAL], [1.0, 2.0])) == 0.0
    assert seen_reach_m(snapshot([UNKN, OBST, FREE], [9.0, 2.0, 1.0])) == 2.0


# --- bytes


def test_published_vectors() -> None:
    who = {"system": 1, "component": 196}
    assert (
        encode_v2(HEARTBEAT, (0, 18, 8, 0, 4, 3), sequence=0, **who).hex()
        == "fd0900000001c4000000000000001208000403f49a"
    )
    values = (1_000_000, *[300] * 72, 20, 400, 0, 5, 0.0, 0.0, 0)
    cut = "fd9e00000001c44a010040420f0000000000" + "2c01" * 72 + "140090010005" + "94b2"
    assert encode_v2(OBSTACLE_DISTANCE, values, sequence=0, **who).hex() == cut
    values = (1_000_000, 100, 250, *[65535] * 69, 401, 20, 400, 0, 5, 5.0, -180.0, 12)
    whole = "fda700000701c44a010040420f00000000006400fa00" + "ffff" * 69 + "91011400900100050000a040000034c30ce30f"
    assert encode_v2(OBSTACLE_DISTANCE, values, sequence=7, **who).hex() == whole
    sensor = (5000, 20, 400, 123, 1, 3, 2, 255, 0.5, 0.25, 0.0, 0.0, 0.0, 0.0, 90)
    assert encode_v2(DISTANCE_SENSOR, sensor, sequence=1, **who).hex().startswith("fd2700000101c4840000881300001400")
    wheels = (1_000_000, 1.25, -0.5, *[0.0] * 14, 2)
    assert encode_v2(WHEEL_DISTANCE, wheels, sequence=2, **who).hex().endswith("02b664")


def parsed(frames: list[bytes]) -> list[object]:
    link = common.MAVLink(None)
    return [link.parse_char(frame) for frame in frames]


def test_pymavlink_reads_every_field() -> None:
    talker = Talker(Settings("laser", BODY, system_id=7, range_min_m=0.2, range_max_m=4.0, sensor_type=0))
    states, reach = [FREE] * 72, [20.0] * 72
    states[36], reach[36] = OBST, 1.5  # [0, 5) degrees: elements 0 and 71
    states[0] = UNKN  # behind
    heartbeat, message = parsed(talker.frames(snapshot(states, reach, stamp_ns=5 * SECOND), 5 * SECOND + 1000))
    assert (heartbeat.type, heartbeat.autopilot, heartbeat.system_status) == (18, 8, 4)  # type: ignore[attr-defined]
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (7, 196)  # type: ignore[attr-defined]
    assert message.get_type() == "OBSTACLE_DISTANCE"  # type: ignore[attr-defined]
    fields = message.to_dict()  # type: ignore[attr-defined]
    assert fields["time_usec"] == 5_000_000
    assert (fields["min_distance"], fields["max_distance"]) == (20, 400)
    assert (fields["increment"], fields["increment_f"], fields["angle_offset"]) == (5, 0.0, 0.0)
    assert (fields["frame"], fields["sensor_type"]) == (12, 0)
    expected = [401] * 72
    expected[0] = expected[71] = 150
    expected[35] = expected[36] = UNKNOWN
    assert list(fields["distances"]) == expected


def test_old_maps_and_none_are_unknown_the_beat_goes_on() -> None:
    talker = Talker(Settings("laser", BODY))
    fresh = all_free(stamp_ns=SECOND)
    told = []
    for snap, now_ns in ((None, 0), (fresh, SECOND), (fresh, SECOND + 499_000_000), (fresh, SECOND + 501_000_000)):
        message = parsed(talker.frames(snap, now_ns))[-1]
        told.append(set(message.distances))  # type: ignore[attr-defined]
    assert told == [{UNKNOWN}, {1001}, {1001}, {UNKNOWN}]


def test_in_a_room_the_limit_is_its_farthest_wall_not_the_reach_of_a_beam_along_glass() -> None:
    """A laser in a flat: walls all around, and two sectors that are free up to where their beams grazed something."""
    states, reach = [OBST] * 72, [4.0] * 72
    reach[36] = 6.95
    states[20], reach[20] = FREE, 1.29
    message = parsed(Talker(Settings("laser", BODY)).frames(snapshot(states, reach), SECOND))[-1]
    assert message.max_distance == 695  # type: ignore[attr-defined]
    told = list(message.distances)  # type: ignore[attr-defined]
    assert told.count(400) >= 68
    assert 696 not in told


def test_the_limit_is_what_the_sensors_see() -> None:
    talker = Talker(Settings("sonar", BODY, range_max_m=10.0))
    near = parsed(talker.frames(all_free(3.0), SECOND))[-1]
    assert near.max_distance == 300  # type: ignore[attr-defined]
    assert set(near.distances) == {301}  # type: ignore[attr-defined]
    blocked = parsed(talker.frames(snapshot([OBST] * 72, [1.0] * 72), SECOND))[-1]
    assert blocked.max_distance == 300, "it does not shrink when something is near"  # type: ignore[attr-defined]


def test_heartbeats_once_a_second_and_sequence_numbers_without_a_gap() -> None:
    talker = Talker(Settings("laser", BODY))
    frames = [frame for beat in range(300) for frame in talker.frames(None, beat * SECOND // 15)]
    assert [frame[4] for frame in frames] == [k % 256 for k in range(len(frames))]
    assert sum(frame[7] == 0 and frame[8] == 0 for frame in frames) == 20


# --- the thread


class Line:
    """A port that keeps what is written; `lost` makes it fail."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.waiting = [(b"x", 0)] * 3
        self.lost = False
        self.closed = 0

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        return [self.waiting.pop()] if self.waiting else []

    def write(self, item: bytes) -> None:
        if self.lost:
            raise PortAbsent("gone: plug it in")
        self.written.append(item)

    def close(self) -> None:
        self.closed += 1


def sender(line: Line, clock: Callable[[], int]) -> MavlinkOut:
    return MavlinkOut(Settings("laser", BODY), lambda: line, clock=clock)


def test_only_the_map_that_was_named_is_sent_and_a_lost_line_comes_back() -> None:
    line, now = Line(), [SECOND]
    out = sender(line, lambda: now[0])
    out.offer(PolarOut("sonar", all_free(1.0)))
    out.beat()
    assert set(parsed(line.written)[-1].distances) == {UNKNOWN}  # type: ignore[attr-defined]
    out.offer(PolarOut("laser", all_free()))
    out.beat()
    assert set(parsed(line.written[-1:])[-1].distances) == {1001}  # type: ignore[attr-defined]
    assert not line.waiting, "what the autopilot says is drained"
    line.lost = True
    out.beat()
    assert out.trouble() == "[mavlink] gone: plug it in"
    assert line.closed == 1
    line.lost = False
    out.beat()
    assert out.trouble() is not None, "not tried again at once"
    now[0] += SECOND
    out.beat()
    assert out.trouble() is None


def test_the_thread_sends_on_a_beat_over_udp_and_ends() -> None:
    import socket
    import time

    from drivers.udp_port import UdpPort

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.settimeout(GIVE_UP_S)
        address = f"udpout:127.0.0.1:{ground.getsockname()[1]}"
        out = MavlinkOut(
            Settings("laser", BODY), lambda: UdpPort(address, clock=time.monotonic_ns), clock=time.monotonic_ns
        )
        out.start()
        sent_usec: list[int] = []  # without a map a message has the time at which it is sent
        while len(sent_usec) < 30:
            (message,) = parsed([ground.recv(1000)])
            if message.get_type() == "OBSTACLE_DISTANCE":  # type: ignore[attr-defined]
                sent_usec.append(message.time_usec)  # type: ignore[attr-defined]
        period_s = np.median(np.diff(sent_usec)) * 1e-6  # a machine that is held up is late for some
        assert 1 / 16.5 <= period_s <= 1 / 10.0
        assert out.stop(GIVE_UP_S)


@pytest.mark.parametrize("seconds_late", [0.3, 5.0])
def test_after_a_pause_it_does_not_send_what_it_missed(seconds_late: float) -> None:
    """The beat is taken up where it is now: a burst of old messages helps nobody."""
    now = [0]
    beats: list[int] = []

    class Stopping:
        def wait(self, timeout_s: float) -> bool:
            now[0] += round(timeout_s * 1e9)
            return len(beats) >= 20

    out = sender(Line(), lambda: now[0])
    out._stopping = Stopping()  # type: ignore[assignment]

    def beat() -> None:
        beats.append(now[0])
        if len(beats) == 5:
            now[0] += round(seconds_late * 1e9)

    out.beat = beat  # type: ignore[method-assign]
    out._run()
    gaps = np.diff(beats) / 1e9
    assert (gaps[5:] > 0.06).all()
    assert (np.delete(gaps, 4) < 0.08).all()
