"""The emulated autopilot: what it says, read byte by byte, and how it judges published obstacle messages."""

from __future__ import annotations

import itertools
import math
import socket
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from sim_devices.device import F64, Mount
from sim_devices.mavlink_autopilot import KINDS, Kind, MavlinkAutopilot, Rangefinder
from sim_devices.udp_link import UdpLink
from tests.waiting import GIVE_UP_S

MS = 1_000_000
SECOND = 1_000_000_000

# messages of other implementations, system 1, component 196
HEARTBEAT = bytes.fromhex("fd0900000001c4000000000000001208000403f49a")
ALL_300_FRAME_0 = bytes.fromhex(
    "fd9e00000001c44a010040420f0000000000" + "2c01" * 72 + "1400" + "9001" + "00" + "05" + "94b2"
)
FROM_BEHIND = bytes.fromhex(
    "fda700000701c44a010040420f0000000000" + "6400fa00" + "ffff" * 69 + "9101" + "1400900100050000a040000034c30ce30f"
)


class Vehicle:
    """Wheels at given speeds, a wall around it."""

    def __init__(self, left_m_s: float = 0.0, right_m_s: float = 0.0, wall_m: float = 1.23) -> None:
        self.speeds = left_m_s, right_m_s
        self.wall_m = wall_m
        self.asked: list[Mount] = []

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        raise AssertionError("an autopilot has no laser")

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        self.asked.append(mount)
        return self.wall_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self.speeds[0] * now_ns * 1e-9, self.speeds[1] * now_ns * 1e-9


class Bench:
    """An autopilot with the time in hand, booted."""

    def __init__(self, vehicle: Vehicle | None = None, **options: object) -> None:
        self.vehicle = vehicle or Vehicle()
        self.pilot = MavlinkAutopilot(self.vehicle, **({"line_rate_bps": None} | options))  # type: ignore[arg-type]
        self.now_ns = 9 * SECOND
        self.pilot.step(self.now_ns, b"")
        self.wait(0.501)

    def wait(self, seconds: float, step_ms: float = 5.0, baud: int | None = None) -> bytes:
        out = bytearray()
        end_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_ms * MS))
            out += self.pilot.step(self.now_ns, b"", baud)
        return bytes(out)

    def tell(self, data: bytes) -> bytes:
        return self.pilot.step(self.now_ns, data)

    def seen(self) -> F64:
        return self.pilot.seen(self.now_ns)


def read(stream: bytes) -> list[Any]:
    """Messages of a stream, which must be whole and of version 2."""
    reader = mavlink.MAVLink(None)
    found = reader.parse_buffer(stream) or []
    assert sum(len(message.get_msgbuf()) for message in found) == len(stream)
    assert all(message.get_msgbuf()[0] == 0xFD for message in found)
    return list(found)


def of(stream: bytes, kind: str) -> list[Any]:
    return [message for message in read(stream) if message.get_type() == kind]


def obstacles(
    values: list[int], *, frame: int = 12, increment: int = 5, increment_f: float = 0.0, offset: float = 0.0
) -> bytes:
    full = values + [65535] * (72 - len(values))
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=196)
    message = sender.obstacle_distance_encode(0, 0, full, increment, 20, 400, increment_f, offset, frame)
    return bytes(message.pack(sender))


def command(number: int, *parameters: float, system: int = 1) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=196)
    padded = list(parameters) + [0.0] * (7 - len(parameters))
    return bytes(sender.command_long_encode(system, 1, number, 0, *padded).pack(sender))


# -- what it says ------------------------------------------------------------------------------------------------------


def test_frames_are_as_the_standard_lays_them_out() -> None:
    bench = Bench(Vehicle(1.0, 1.0))
    found = {message.get_msgId(): message.get_msgbuf() for message in read(bench.wait(1.0))}
    heartbeat, wheels = found[0], found[9000]
    assert heartbeat[:2] == b"\xfd\x09"
    assert (heartbeat[5], heartbeat[6]) == (1, 1)
    assert wheels[7:10] == (9000).to_bytes(3, "little")
    assert wheels[1] == 137  # the count at the end is not 0, so nothing was cut
    assert struct.unpack_from("<dd", wheels, 18) == pytest.approx((10.5, 10.5), abs=0.11)


@pytest.mark.parametrize(("kind", "autopilot"), [("ardupilot", 3), ("px4", 12)])
def test_heartbeat_says_whose_autopilot_it_is(kind: Kind, autopilot: int) -> None:
    beats = of(Bench(kind=kind).wait(5.0), "HEARTBEAT")
    assert len(beats) == pytest.approx(5, abs=1)
    assert {beat.autopilot for beat in beats} == {autopilot}


def test_rates_and_sequence() -> None:
    stream = read(Bench().wait(2.0))
    kinds = [message.get_type() for message in stream]
    assert kinds.count("ATTITUDE") == pytest.approx(20, abs=1)
    assert kinds.count("ODOMETRY") == pytest.approx(20, abs=1)
    assert kinds.count("WHEEL_DISTANCE") == pytest.approx(20, abs=1)
    assert "DISTANCE_SENSOR" not in kinds
    sequence = [message.get_seq() for message in stream]
    assert all((b - a) % 256 == 1 for a, b in itertools.pairwise(sequence))


def test_turning_left_is_negative_yaw_and_moves_to_negative_y() -> None:
    bench = Bench(Vehicle(0.4, 0.6), track_width_m=0.5)
    stream = bench.wait(2.0)
    first, last = of(stream, "ODOMETRY")[0], of(stream, "ODOMETRY")[-1]
    seconds = (last.time_usec - first.time_usec) * 1e-6
    assert (last.frame_id, last.child_frame_id) == (20, 12)
    assert last.vx == pytest.approx(0.5, rel=1e-3)
    assert last.yawspeed == pytest.approx(-0.4, rel=1e-3)
    yaw = [2.0 * math.atan2(m.q[3], m.q[0]) for m in (first, last)]
    assert yaw[1] - yaw[0] == pytest.approx(-0.4 * seconds, rel=0.02)
    assert (last.x > first.x, last.y < first.y) == (True, True)
    assert math.isnan(last.pose_covariance[0])
    turned = of(stream, "ATTITUDE")[-1]
    assert turned.yaw == pytest.approx(yaw[1], abs=0.05)
    assert turned.yawspeed == pytest.approx(-0.4, rel=1e-3)


@pytest.mark.parametrize(
    ("wall_m", "cm", "quality"), [(1.23, 123, 100), (0.05, 19, 100), (4.5, 401, 0), (math.inf, 401, 0)]
)
def test_rangefinders_look_where_they_say(wall_m: float, cm: int, quality: int) -> None:
    right = Rangefinder(3, Mount(yaw_rad=math.radians(-90.0)))
    bench = Bench(Vehicle(wall_m=wall_m), rangefinders=[right])
    told = of(bench.wait(1.0), "DISTANCE_SENSOR")
    assert len(told) == pytest.approx(10, abs=1)
    assert {(m.id, m.orientation, m.current_distance, m.min_distance, m.max_distance) for m in told} == {
        (3, 2, cm, 20, 400)
    }
    assert told[0].signal_quality == quality
    assert {round(math.degrees(mount.yaw_rad)) for mount in bench.vehicle.asked} == {-90}


def test_clock_counts_from_power_on_and_drifts_without_a_jump() -> None:
    bench = Bench()
    before = bench.pilot.clock_us(bench.now_ns)
    assert before == 501_000
    bench.pilot.set_clock_drift(1000.0, bench.now_ns)
    assert bench.pilot.clock_us(bench.now_ns) == before
    assert bench.pilot.clock_us(bench.now_ns + SECOND) == before + 1_001_000


def test_message_intervals_follow_commands() -> None:
    bench = Bench()
    (answer,) = of(bench.tell(command(511, 9000, 20_000)), "COMMAND_ACK")
    assert (answer.command, answer.result) == (511, 0)
    assert len(of(bench.wait(1.0), "WHEEL_DISTANCE")) == pytest.approx(50, abs=1)
    bench.tell(command(511, 9000, -1))
    assert of(bench.wait(1.0), "WHEEL_DISTANCE") == []
    bench.tell(command(511, 9000, 0))
    assert len(of(bench.wait(1.0), "WHEEL_DISTANCE")) == pytest.approx(10, abs=1)
    assert len(of(bench.tell(command(512, 331)), "ODOMETRY")) == 1
    assert of(bench.tell(command(511, 4242, 1000)), "COMMAND_ACK")[0].result == 2
    assert of(bench.tell(command(400, 1)), "COMMAND_ACK")[0].result == 3
    assert bench.tell(command(511, 9000, 1000, system=9)) == b""


def test_groups_of_messages_have_rates_the_old_way() -> None:
    """REQUEST_DATA_STREAM, which tools for ArduPilot still send; a PX4 does not know it."""
    for kind, per_second in (("ardupilot", 4), ("px4", 10)):
        bench = Bench(kind=kind, rangefinders=[Rangefinder(0, Mount())])
        codec = mavlink.MAVLink(None, srcSystem=255)
        bench.tell(codec.request_data_stream_encode(1, 1, mavlink.MAV_DATA_STREAM_EXTRA3, 4, 1).pack(codec))
        said = bench.wait(5.0)
        assert len(of(said, "DISTANCE_SENSOR")) == pytest.approx(5 * per_second, abs=1)
        assert len(of(said, "ATTITUDE")) == pytest.approx(50, abs=1)
        assert len(of(said, "GPS_RAW_INT")) == pytest.approx(5, abs=1)
        bench.tell(codec.request_data_stream_encode(1, 1, mavlink.MAV_DATA_STREAM_ALL, 4, 0).pack(codec))
        if kind == "ardupilot":
            assert {message.get_type() for message in read(bench.wait(3.0))} == {"HEARTBEAT"}


@pytest.mark.parametrize("asked", [(512, 148), (520, 1)])
def test_version_is_told_when_asked_for(asked: tuple[int, int]) -> None:
    bench = Bench()
    answers = read(bench.tell(command(*asked)))
    assert [message.get_type() for message in answers] == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert answers[0].result == 0
    assert answers[1].flight_sw_version >> 24 == 4


@pytest.mark.parametrize(("kind", "told"), [("ardupilot", 1.0), ("px4", struct.unpack("<f", struct.pack("<i", 1))[0])])
def test_parameters_are_listed_read_and_set(kind: Kind, told: float) -> None:
    """Whole numbers as floats of their value, or of their bits: where the two disagree, ids come out as 1e-45."""
    bench = Bench(kind=kind)
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=196)
    listed = of(bench.tell(bytes(sender.param_request_list_encode(1, 1).pack(sender))), "PARAM_VALUE")
    assert [value.param_index for value in listed] == list(range(listed[0].param_count))
    assert listed[0].param_value == told
    last = listed[-1]
    name = last.param_id.encode()
    one = bytes(sender.param_request_read_encode(1, 1, name, -1).pack(sender))
    assert of(bench.tell(one), "PARAM_VALUE")[0].param_value == last.param_value
    set_it = bytes(sender.param_set_encode(1, 1, name, 3.5, last.param_type).pack(sender))
    assert of(bench.tell(set_it), "PARAM_VALUE")[0].param_value == 3.5
    assert of(bench.tell(one), "PARAM_VALUE")[0].param_value == 3.5
    assert bench.tell(bytes(sender.param_request_read_encode(1, 1, b"NO_SUCH", -1).pack(sender))) == b""
    assert bench.tell(bytes(sender.param_request_list_encode(9, 1).pack(sender))) == b""


def test_ping_and_an_empty_mission_are_answered() -> None:
    bench = Bench()
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=196)
    (answer,) = of(bench.tell(bytes(sender.ping_encode(77, 5, 0, 0).pack(sender))), "PING")
    assert (answer.time_usec, answer.seq, answer.target_component) == (77, 5, 196)
    (answer,) = of(bench.tell(bytes(sender.mission_request_list_encode(1, 1).pack(sender))), "MISSION_COUNT")
    assert (answer.count, answer.target_component) == (0, 196)


def test_timesync_is_answered() -> None:
    bench = Bench()
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=196)
    asked = bytes(sender.timesync_encode(0, 123456789).pack(sender))
    (answer,) = of(bench.tell(asked), "TIMESYNC")
    assert (answer.ts1, answer.tc1) == (123456789, bench.pilot.clock_us(bench.now_ns) * 1000)
    assert bench.tell(bytes(sender.timesync_encode(5, 6).pack(sender))) == b""


def test_serial_line_has_its_pace_and_its_rate() -> None:
    bench = Bench(line_rate_bps=57600)
    sent = bench.wait(2.0, baud=57600)
    assert len(sent) <= 2.0 * 5760
    reader = mavlink.MAVLink(None)
    reader.robust_parsing = True
    assert {m.get_type() for m in reader.parse_buffer(sent)} >= {"HEARTBEAT", "ATTITUDE"}
    noise = bench.wait(1.0, baud=115200)
    assert len(noise) > 1000
    deaf = mavlink.MAVLink(None)
    deaf.robust_parsing = True
    heard = {m.get_type() for m in deaf.parse_buffer(noise) or []}
    assert not heard & {"HEARTBEAT", "ATTITUDE", "ODOMETRY", "WHEEL_DISTANCE", "SYS_STATUS"}


# -- how it judges -----------------------------------------------------------------------------------------------------


def test_companion_is_heard() -> None:
    bench = Bench()
    assert bench.pilot.companion_ns is None
    bench.tell(HEARTBEAT)
    assert bench.pilot.companion_ns == bench.now_ns


@pytest.mark.parametrize("kind", KINDS)
def test_published_messages_of_others_are_understood(kind: Kind) -> None:
    bench = Bench(kind=kind)
    bench.tell(ALL_300_FRAME_0)
    assert np.allclose(bench.seen(), 3.0)
    bench.wait(0.6)
    assert np.isnan(bench.seen()).all()
    bench.tell(FROM_BEHIND)  # element 0 looks back, element 1 is 5 degrees further clockwise
    seen = bench.seen()
    assert (seen[36], seen[37]) == (1.0, 2.5)
    assert math.isnan(seen[0])
    assert (seen[35] == math.inf) == (kind == "px4")  # 401: looked and empty
    assert (bench.pilot.accepted, bench.pilot.refused) == (2, 0)


def test_ardupilot_ignores_what_is_out_of_range_and_px4_takes_it_as_clear() -> None:
    told = [0, 19, 20, 400, 401, 65535]
    ardupilot, px4 = Bench(kind="ardupilot"), Bench(kind="px4")
    for bench in (ardupilot, px4):
        bench.tell(obstacles(told))
    assert np.array_equal(ardupilot.seen()[:6], [np.nan, np.nan, 0.2, 4.0, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(px4.seen()[:6], [0.0, 0.19, 0.2, np.inf, np.inf, np.nan], equal_nan=True)


def test_px4_refuses_other_frames_and_ardupilot_does_not_look() -> None:
    for kind, accepted in (("ardupilot", 1), ("px4", 0)):
        bench = Bench(kind=kind)
        bench.tell(obstacles([100] * 72, frame=8))
        assert bench.pilot.accepted == accepted
        assert bool(bench.pilot.complaint) == (not accepted)


def test_global_frame_is_turned_by_the_yaw_on_px4() -> None:
    bench = Bench(Vehicle(-0.25, 0.25), kind="px4", track_width_m=0.5)
    bench.wait(math.pi / 2)  # a quarter turn to the left at 1 rad/s: north is now to the right
    bench.tell(obstacles([100] + [300] * 71, frame=0))
    nearest = int(np.argmin(bench.seen()))
    assert nearest * 5.0 == pytest.approx(90.0, abs=10.0)
    turned = Bench(Vehicle(-0.25, 0.25), kind="px4", track_width_m=0.5)
    turned.wait(math.pi / 2)
    turned.tell(obstacles([100] + [300] * 71, frame=12))
    assert int(np.argmin(turned.seen())) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_increment_f_replaces_increment(kind: Kind) -> None:
    bench = Bench(kind=kind)
    bench.tell(obstacles([100, 200, 300, 300], increment=5, increment_f=90.0))
    seen = bench.seen()
    assert (seen[0], seen[18], seen[36], seen[54]) == (1.0, 2.0, 3.0, 3.0)


def test_negative_increment_is_counter_clockwise_on_ardupilot_and_not_taken_by_px4() -> None:
    ardupilot, px4 = Bench(kind="ardupilot"), Bench(kind="px4")
    for bench in (ardupilot, px4):
        bench.tell(obstacles([100, 200], increment=10, increment_f=-5.0))
    assert ardupilot.seen()[71] == 2.0
    assert px4.seen()[2] == 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_senseless_messages_are_refused(kind: Kind) -> None:
    bench = Bench(kind=kind)
    bench.tell(obstacles([100], increment=0))
    bench.tell(obstacles([100], offset=math.nan))
    bench.tell(obstacles([100], increment=0, increment_f=math.inf))
    assert (bench.pilot.accepted, bench.pilot.refused) == (0, 3)
    assert np.isnan(bench.seen()).all()


@pytest.mark.parametrize("kind", KINDS)
def test_health_bit_follows_the_stream(kind: Kind) -> None:
    bench = Bench(kind=kind)
    assert {m.onboard_control_sensors_health for m in of(bench.wait(2.0), "SYS_STATUS")} == {0}
    stream = bytearray()
    for _ in range(30):
        bench.tell(obstacles([401] * 72))
        stream += bench.wait(0.1)
    last = of(bytes(stream), "SYS_STATUS")[-1]
    assert last.onboard_control_sensors_health == last.onboard_control_sensors_present != 0


@given(st.lists(st.binary(max_size=300), max_size=6), st.sampled_from(KINDS))
@settings(max_examples=40, deadline=None)
def test_survives_any_bytes_and_goes_on(pieces: list[bytes], kind: Kind) -> None:
    bench = Bench(kind=kind)
    for piece in pieces:
        bench.tell(piece)
        bench.tell(b"\xfd" + piece)
    bench.tell(bytes(600))
    bench.tell(HEARTBEAT)
    assert bench.pilot.companion_ns == bench.now_ns


@given(
    st.lists(st.integers(0, 65535), min_size=72, max_size=72),
    st.integers(0, 255),
    st.floats(width=32),
    st.floats(width=32),
    st.integers(0, 255),
    st.sampled_from(KINDS),
)
@settings(max_examples=80, deadline=None)
def test_any_obstacle_message_is_taken_or_refused(
    values: list[int], increment: int, increment_f: float, offset: float, frame: int, kind: Kind
) -> None:
    bench = Bench(kind=kind)
    bench.tell(obstacles(values, frame=frame, increment=increment, increment_f=increment_f, offset=offset))
    assert bench.pilot.accepted + bench.pilot.refused == 1
    seen = bench.seen()
    assert not (seen < 0.0).any()
    assert bench.pilot.refused == 0 or np.isnan(seen).all()


# -- UDP ---------------------------------------------------------------------------------------------------------------


def test_udp_link_sends_to_its_peer_and_then_to_who_wrote() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second,
    ):
        for end in (first, second):
            end.bind(("127.0.0.1", 0))
            end.settimeout(GIVE_UP_S)
        link = UdpLink(first.getsockname()[1])
        try:
            assert link.write(b"one") == 3
            assert first.recvfrom(100)[0] == b"one"
            second.sendto(b"hello", ("127.0.0.1", link.port))
            assert link.read() == b"hello"
            assert link.write(b"x" * 3000) == 3000
            assert sum(len(second.recv(4000)) for _ in range(3)) == 3000
            port = link.port
            link.close()
            assert link.write(b"lost") == 0
            assert link.read() == b""
            link.open()
            assert link.port == port
        finally:
            link.close()


def test_udp_link_without_anybody_drops_and_counts() -> None:
    link = UdpLink()
    try:
        assert link.write(b"nobody") == 0
        assert link.counters.dropped_bytes == 6
    finally:
        link.close()
