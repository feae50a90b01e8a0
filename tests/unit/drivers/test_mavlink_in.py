"""MAVLink in: published frames, pymavlink as the sender and the judge, truncation, noise, versions, UDP."""

from __future__ import annotations

import importlib
import math
import random
import socket
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import PortBusy
from drivers.mavlink_frames import (
    ATTITUDE,
    COMMAND_LONG,
    DISTANCE_SENSOR,
    HEARTBEAT,
    LAYOUTS,
    WHEEL_DISTANCE,
    Frames,
    Message,
    crc16_mcrf4xx,
    encode_v2,
)
from drivers.mavlink_in import MavlinkConversation
from drivers.readings import (
    AttitudeReading,
    ChainReading,
    LinkState,
    PoseReading,
    RangeStatus,
    Reading,
    SourceCounters,
    WheelReading,
)
from drivers.udp_port import UdpPort, parse_udp
from tests.waiting import free_port

MS = 1_000_000

HEARTBEAT_VECTOR = bytes.fromhex("fd0900000001c4000000000000001208000403f49a")
DISTANCE_VECTOR = bytes.fromhex(
    "fd2700000101c484000088130000140090017b00010302ff0000003f0000803e000000000000000000000000000000005a5c91"
)
WHEEL_VECTOR = bytes.fromhex(
    "fd8900000201c428230040420f0000000000000000000000f43f000000000000e0bf" + "00" * 112 + "02b664"
)
VECTORS = (HEARTBEAT_VECTOR, DISTANCE_VECTOR, WHEEL_VECTOR)


def peer(version: int = 2) -> Any:
    """pymavlink's encoder of the common dialect."""
    dialect = importlib.import_module(f"pymavlink.dialects.v{version}0.common")
    return dialect.MAVLink(None, srcSystem=7, srcComponent=1)


def messages(stream: bytes) -> tuple[list[Message], dict[str, int]]:
    counters = SourceCounters()
    return [message for message, _ in Frames(counters).feed(stream)], counters.drops


def said(stream: bytes, conversation: MavlinkConversation | None = None) -> list[Reading]:
    return list((conversation or MavlinkConversation()).receive(stream, 1000 * MS))


def test_crc_check_value_and_extras_agree_with_the_dialect() -> None:
    assert crc16_mcrf4xx(b"123456789") == 0x6F91
    dialect = importlib.import_module("pymavlink.dialects.v20.common")
    for message_id, layout in LAYOUTS.items():
        theirs = dialect.mavlink_map[message_id]
        assert (theirs.crc_extra, theirs.unpacker.size) == (layout.crc_extra, layout.fields.size)


@pytest.mark.parametrize("version", [1, 2])
@given(data=st.data())
def test_messages_of_other_kinds_are_no_noise_and_hide_nothing(version: int, data: st.DataObject) -> None:
    """Autopilots send dozens of kinds; noise is still counted, to the byte."""
    codec = peer(version)
    others = [
        codec.sys_status_encode(1, 1, 1, 100, 12600, -1, 90, 0, 0, 0, 0, 0, 0),
        codec.gps_raw_int_encode(9, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0),
        codec.statustext_encode(6, b"EKF is using GPS"),
    ]
    known = codec.heartbeat_encode(10, 3, 1, 0, 4)
    stream, beats, noise = b"", 0, 0
    for _ in range(data.draw(st.integers(1, 12))):
        kind = data.draw(st.integers(0, 4))
        stream += b"\x11\x22\x33" if kind == 4 else (known if kind == 3 else others[kind]).pack(codec)
        beats += kind == 3
        noise += 3 * (kind == 4)
    counters = SourceCounters()
    frames = Frames(counters)
    found = 0
    while stream:
        size = data.draw(st.integers(1, 60))
        found += sum(message.message_id == HEARTBEAT for message, _ in frames.feed(stream[:size]))
        stream = stream[size:]
    assert found == beats
    assert counters.drops.get("noise_bytes", 0) == noise


def test_published_frames() -> None:
    found, drops = messages(b"".join(VECTORS))
    assert [each.message_id for each in found] == [HEARTBEAT, DISTANCE_SENSOR, WHEEL_DISTANCE]
    assert drops == {}
    assert {(each.system, each.component) for each in found} == {(1, 196)}
    assert list(found[0].values) == [0, 18, 8, 0, 4, 3]
    assert list(found[1].values[:10]) == [5000, 20, 400, 123, 1, 3, 2, 255, 0.5, 0.25]
    assert found[1].values[14] == 90
    assert list(found[2].values) == [1_000_000, 1.25, -0.5, *[0.0] * 14, 2]
    assert encode_v2(HEARTBEAT, (0, 18, 8, 0, 4, 3), sequence=0, system=1, component=196) == HEARTBEAT_VECTOR


def test_published_readings() -> None:
    chain, wheels = said(b"".join(VECTORS))
    assert isinstance(chain, ChainReading)
    [value] = chain.ranges
    assert (value.channel, value.status) == (4, RangeStatus.ECHO)
    assert value.range_m == pytest.approx(1.23)
    assert isinstance(wheels, WheelReading)
    assert not wheels.continuous


@pytest.mark.parametrize("vector", VECTORS)
def test_no_single_changed_bit_passes(vector: bytes) -> None:
    for bit in range(8, 8 * len(vector)):
        bad = bytearray(vector)
        bad[bit // 8] ^= 1 << bit % 8
        found, _ = messages(bytes(bad) + DISTANCE_VECTOR)
        assert [each.message_id for each in found] in ([DISTANCE_SENSOR], []), bit  # []: it waits for a longer frame
        found, _ = messages(bytes(bad) + DISTANCE_VECTOR + bytes(300))
        assert [each.message_id for each in found] == [DISTANCE_SENSOR], bit


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=10),
    st.binary(max_size=20),
    st.binary(max_size=20),
    st.permutations(VECTORS),
)
def test_any_split_and_noise_between_lose_nothing(
    cuts: list[int], before: bytes, between: bytes, order: list[bytes]
) -> None:
    stream = before + between.join(order) + bytes(300)
    frames = Frames(SourceCounters())
    found = []
    at = 0
    for cut in cuts * len(stream):
        found += [message.message_id for message, _ in frames.feed(stream[at : at + cut])]
        at += cut
    assert found == [messages(vector)[0][0].message_id for vector in order]


def test_mutated_frames_do_not_pass() -> None:
    """Frames damaged at one to three places; the code has 16 bits, so one in 65536 of arbitrary damage would pass."""
    rng = random.Random(132)
    for _ in range(20_000):
        bad = bytearray(rng.choice(VECTORS))
        original = bytes(bad)
        for _ in range(rng.randrange(1, 4)):
            bad[rng.randrange(1, len(bad))] = rng.randrange(256)
        if bytes(bad) != original:
            assert messages(bytes(bad) + bytes(300))[0] == []


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    *[st.integers(0, 65535)] * 3,
    st.integers(0, 255),
    st.integers(0, 40),
    st.integers(0, 100),
)
def test_distances_as_pymavlink_sends_them(
    time_ms: int, least: int, most: int, current: int, sensor: int, orientation: int, quality: int
) -> None:
    message = peer().distance_sensor_encode(
        time_ms, least, most, current, 1, sensor, orientation, 255, 0.5, 0.5, [0.0] * 4, quality
    )
    [reading] = said(bytes(message.pack(peer())))
    assert isinstance(reading, ChainReading)
    [value] = reading.ranges
    assert value.channel == sensor + 1
    if quality == 1 or least > most or most == 0 or current == 0:
        assert value.status is RangeStatus.INVALID
    elif current < least:
        assert value.status is RangeStatus.TOO_CLOSE
    elif current > most:
        assert value.status is RangeStatus.NO_RETURN
    else:
        assert value.range_m == pytest.approx(current / 100)


def test_version_1_and_signed_frames_are_read() -> None:
    old = peer(1).attitude_encode(5, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0).pack(peer(1))
    assert old[0] == 0xFE
    [reading] = said(bytes(old))
    assert isinstance(reading, AttitudeReading)
    signer = peer()
    signer.signing.secret_key = b"k" * 32
    signer.signing.link_id = 1
    signer.signing.timestamp = 1
    signer.signing.sign_outgoing = True
    signed = bytes(signer.attitude_encode(5, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0).pack(signer))
    assert signed[2] == 1
    assert len(said(signed + DISTANCE_VECTOR, MavlinkConversation(system=7))) == 1
    assert len(messages(signed + DISTANCE_VECTOR)[0]) == 2


def test_attitude_is_turned_to_z_up() -> None:
    frame = peer().attitude_encode(5, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0).pack(peer())
    [reading] = said(bytes(frame))
    assert isinstance(reading, AttitudeReading)
    got = (reading.roll_rad, reading.pitch_rad, reading.yaw_rad, *reading.rates_rad_s)
    assert got == pytest.approx((0.1, -0.2, -0.3, 1.0, -2.0, -3.0), abs=1e-6)
    assert not said(bytes(peer().attitude_encode(5, math.nan, 0.2, 0.3, 1.0, 2.0, 3.0).pack(peer())))


def odometry(
    x: float, y: float, yaw: float, *, frame: int = 20, child: int = 12, resets: int = 0, quality: int = 0
) -> bytes:
    half = yaw / 2
    q = [math.cos(half), 0.0, 0.0, math.sin(half)]
    covariance = [math.nan] + [0.0] * 20
    message = peer().odometry_encode(
        1, frame, child, x, y, 0.0, q, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, covariance, covariance, resets, 0, quality
    )
    return bytes(message.pack(peer()))


@pytest.mark.parametrize(("frame", "child", "sign"), [(20, 12, -1), (1, 12, -1), (1, 8, -1), (21, 13, 1), (4, 13, 1)])
def test_odometry_is_turned_to_y_left(frame: int, child: int, sign: int) -> None:
    [reading] = said(odometry(1.5, 0.5, 0.7, frame=frame, child=child, quality=80))
    assert isinstance(reading, PoseReading)
    assert (reading.x_m, reading.y_m, reading.yaw_rad) == pytest.approx((1.5, sign * 0.5, sign * 0.7), abs=1e-6)
    assert reading.quality == pytest.approx(0.8)


def test_odometry_that_began_anew_or_failed_is_no_motion() -> None:
    conversation = MavlinkConversation()
    stream = (
        odometry(1, 0, 0)
        + odometry(1.1, 0, 0)
        + odometry(9, 0, 0, resets=1)
        + odometry(9.1, 0, 0, resets=1)
        + odometry(9.2, 0, 0, resets=1, quality=-1)
        + odometry(5, 0, 0, resets=1)
        + odometry(5, 0, 0, frame=0)
    )
    readings = [each for each in said(stream, conversation) if isinstance(each, PoseReading)]
    assert [each.continuous for each in readings] == [False, True, False, True, False]
    assert conversation.counters.drops == {"odometry_failed": 1, "odometry_frame": 1}


def ways(left_m: float, right_m: float, count: int = 2) -> bytes:
    message = peer().wheel_distance_encode(1, count, [left_m, right_m] + [0.0] * 14)
    return bytes(message.pack(peer()))


def test_wheel_ways_are_counted_in_micrometres_and_resets_are_no_motion() -> None:
    conversation = MavlinkConversation()
    found: list[Reading] = []
    for index, (left, right) in enumerate([(70.0, -3.0), (70.02, -3.01), (0.0, 0.0), (0.01, 0.0), (math.nan, 0.0)]):
        found += conversation.receive(ways(left, right), index * 50 * MS)
    readings = [each for each in found if isinstance(each, WheelReading)]
    assert [(each.left_ticks, each.right_ticks) for each in readings] == [(0, 0), (20_000, -10_000), (30_000, -10_000)]
    assert [each.continuous for each in readings] == [False, True, False]
    assert not said(ways(1.0, 2.0, count=1), conversation)
    assert conversation.counters.drops == {"count_reset": 1, "not_a_way": 1, "wheel_missing": 1}


def test_only_one_system_is_listened_to_and_ground_stations_are_none() -> None:
    gcs = encode_v2(HEARTBEAT, (0, 6, 8, 0, 4, 3), sequence=0, system=255, component=190)
    conversation = MavlinkConversation()
    assert said(gcs + odometry(0, 0, 0) + DISTANCE_VECTOR, conversation)
    assert conversation.counters.drops == {"other_system": 1}
    assert conversation.identity is not None
    assert conversation.identity.model == "MAVLink system 7"


def test_everything_is_asked_for_once_and_what_is_missing_again_as_pymavlink_understands_it() -> None:
    """Once, though it comes: an autopilot's own rate is another, and how datagrams fall must not decide."""
    conversation = MavlinkConversation((AttitudeReading, WheelReading), rate_hz=25)
    conversation.connected(0)
    parser = peer()
    [frame] = conversation.requests(0)
    assert isinstance(frame, bytes)
    [heartbeat] = parser.parse_buffer(frame)
    assert (heartbeat.get_type(), heartbeat.type, heartbeat.autopilot) == ("HEARTBEAT", 18, 8)
    autopilot = encode_v2(HEARTBEAT, (0, 10, 3, 0, 4, 3), sequence=0, system=7, component=1)
    said(autopilot + ways(0, 0), conversation)
    frames = [each for each in conversation.requests(1100 * MS) if isinstance(each, bytes)]
    _, *both = parser.parse_buffer(b"".join(frames))
    for asked, message in zip(both, (ATTITUDE, WHEEL_DISTANCE), strict=True):
        assert (asked.get_type(), asked.command, asked.param1) == ("COMMAND_LONG", 511, message)
        assert asked.param2 == pytest.approx(40_000)
        assert (asked.target_system, asked.target_component) == (7, 1)
    list(conversation.receive(ways(1, 1), 3000 * MS))
    frames = [each for each in conversation.requests(3101 * MS) if isinstance(each, bytes)]
    _, again = parser.parse_buffer(b"".join(frames))
    assert again.param1 == ATTITUDE
    assert conversation.identity is not None
    assert conversation.identity.vendor == "ArduPilot"
    conversation.requests(4000 * MS)
    assert "ATTITUDE" in (conversation.trouble_of(AttitudeReading) or "")
    assert COMMAND_LONG in LAYOUTS


def test_the_time_on_the_wire_is_taken_off() -> None:
    conversation = MavlinkConversation(baud_bps=57600)
    [reading] = conversation.receive(DISTANCE_VECTOR, 1000 * MS)
    assert isinstance(reading, ChainReading)
    assert (1000 * MS - reading.stamp_ns) / MS == pytest.approx(len(DISTANCE_VECTOR) * 10 / 57.6, rel=1e-3)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.binary(max_size=60), max_size=10))
def test_any_bytes_raise_nothing(chunks: list[bytes]) -> None:
    conversation = MavlinkConversation()
    for index, chunk in enumerate(chunks):
        list(conversation.receive(b"\xfd" + chunk, index * MS))
        conversation.requests(index * MS)
    assert conversation.state in LinkState


# ---- UDP on this machine


def test_datagrams_go_both_ways_and_only_to_this_machine() -> None:
    now = iter(range(1_000_000))
    listening = UdpPort(f"udpin:127.0.0.1:{free_port(socket.SOCK_DGRAM)}", clock=lambda: next(now))
    sending = UdpPort(listening.name.replace("udpin", "udpout"), clock=lambda: next(now))
    try:
        listening.write(b"to nobody yet")
        assert listening.drops == {"no_peer": 1}
        sending.write(DISTANCE_VECTOR)
        [(data, _)] = listening.read(2.0)
        assert data == DISTANCE_VECTOR
        listening.write(HEARTBEAT_VECTOR)
        [(data, _)] = sending.read(2.0)
        assert data == HEARTBEAT_VECTOR
        assert sending.read(0.0) == []
        with pytest.raises(PortBusy):
            UdpPort(listening.name, clock=lambda: 0)
    finally:
        listening.close()
        sending.close()


def test_udp_addresses() -> None:
    assert parse_udp("udpin:localhost:14550") == (True, "127.0.0.1", 14550)
    assert parse_udp("udpout:127.0.0.1:14550") == (False, "127.0.0.1", 14550)
    assert parse_udp("/dev/ttyACM0") is None
    for bad in ("udpin:0.0.0.0:14550", "udpin:192.168.0.1:1", "udpin:127.0.0.1:99999"):
        with pytest.raises(ValueError):
            parse_udp(bad)
