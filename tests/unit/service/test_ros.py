"""Keys, hashes, tokens and attachments as rmw_zenoh wants them, against an independent source of the hashes."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
import xxhash
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from service import cdr, ros, topics, zenoh_session
from service.outputs import GridOut, HealthOut, OdomOut, PoseOut, RangesOut
from service.payloads import Encoder, Message, RobotInfo
from service.ros import RosMirror, RosSettings, RosTopic

GRID_UPDATE_TEXT = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"


class FakeToken:
    """Stands for what the session declares."""


class FakeSession:
    """Notes what is declared and put."""

    def __init__(self) -> None:
        self.tokens: list[str] = []
        self.puts: list[tuple[str, bytes, bytes]] = []

    def zid(self) -> str:
        return "abc123"

    def liveliness(self) -> FakeSession:
        return self

    def declare_token(self, key: str) -> FakeToken:
        self.tokens.append(key)
        return FakeToken()

    def declare(self, key: str) -> Any:
        session = self

        class Publisher:
            def put(self, payload: bytes, *, attachment: bytes) -> None:
                session.puts.append((key, payload, attachment))

        return Publisher()


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> FakeSession:
    fake = FakeSession()
    monkeypatch.setattr(zenoh_session, "declare_stream", lambda _s, key, _p, express: fake.declare(key))
    monkeypatch.setattr(zenoh_session, "declare_latched", lambda _s, key, _p: fake.declare(key))
    return fake


@pytest.mark.parametrize("store", [Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
@pytest.mark.parametrize("ros_type", [t.payload for t in topics.TOPICS if t.is_cdr and "Update" not in t.payload])
def test_hashes(store: Stores, ros_type: str) -> None:
    assert ros.type_hash(ros_type, "jazzy") == get_typestore(store).hash_rihs01(ros_type)


def test_hash_of_the_update() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(GRID_UPDATE_TEXT, topics.GRID_UPDATE))
    assert ros.type_hash(topics.GRID_UPDATE, "iron") == store.hash_rihs01(topics.GRID_UPDATE)


def test_humble_has_no_hashes() -> None:
    assert ros.type_hash(topics.TF, "humble") == "TypeHashNotSupported"


def test_data_key() -> None:
    topic = RosTopic("/front/scan", topics.LASER_SCAN, "")
    assert ros.data_key(7, topic, "humble") == "7/front/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"


def test_attachment_layout() -> None:
    raw = ros.attachment(3, 1_700_000_000_000_000_001, bytes(range(16)))
    assert len(raw) == 33
    assert struct.unpack("<qqB16s", raw) == (3, 1_700_000_000_000_000_001, 16, bytes(range(16)))


def test_publisher_id_is_the_hash_low_half_first() -> None:
    token = "@ros2_lv/0/abc/0/1/MP/%/%/umfeld/%scan/x/y/z"
    canonical = xxhash.xxh3_128_digest(token.encode())  # big endian: high half, low half
    assert ros.publisher_id(token) == canonical[:7:-1] + canonical[7::-1]


def messages() -> list[Message]:
    encoder = Encoder()
    made: list[Message] = encoder.info(RobotInfo("r", "robots/r", "0", 0))
    made += encoder.encode(GridOut(0, 1, GridPatch(0.05, 0, 0, np.zeros((2, 2), np.int8))), 0)
    made += encoder.encode(OdomOut(0, Pose2(), np.eye(3), 0, 0), 0)
    made += encoder.encode(PoseOut(0, Pose2(), Pose2(), np.eye(3)), 0)
    made += encoder.encode(HealthOut(0, 0, "", (), {}, {}), 0)
    made += encoder.encode(RangesOut("rear-left", 0, (Pose2(),), 0.5, 0.1, 3.0, (1.0,)), 0)
    return made


def test_a_node_with_its_topics_appears(session: FakeSession) -> None:
    mirror = RosMirror(session, RosSettings(domain_id=5))
    for message in messages():
        mirror.publish(message)
    assert session.tokens[0] == "@ros2_lv/5/abc123/0/0/NN/%/%/umfeld"
    endpoints = [token.split("/") for token in session.tokens[1:]]
    names = [token[9] for token in endpoints]
    expected = ["%tf_static", "%map", "%odom", "%tf", "%pose", "%diagnostics", "%rear_left%range_1"]
    assert names == expected
    assert all(token[5] == "MP" and token[8] == "umfeld" and len(token) == 13 for token in endpoints)
    assert len({token[4] for token in endpoints}) == len(endpoints)  # every entity has its own number
    qos = {token[9]: token[12] for token in endpoints}
    assert qos["%map"] == ":1:,1:,:,:,,"
    keys = {key for key, _payload, _attachment in session.puts}
    assert f"5/map/nav_msgs::msg::dds_::OccupancyGrid_/{ros.type_hash(topics.GRID, 'jazzy')}" in keys


def test_sequence_numbers_count_by_publisher(session: FakeSession) -> None:
    mirror = RosMirror(session, RosSettings())
    for _ in range(3):
        for message in messages():
            mirror.publish(message)
    numbers: dict[str, list[int]] = {}
    gids: dict[str, set[bytes]] = {}
    for key, _payload, raw in session.puts:
        number, _stamp, size, gid = struct.unpack("<qqB16s", raw)
        assert size == 16
        numbers.setdefault(key, []).append(number)
        gids.setdefault(key, set()).add(gid)
    for key, counted in numbers.items():
        assert counted == list(range(1, len(counted) + 1)), key
    assert all(len(ids) == 1 for ids in gids.values())
    assert len(set.union(*gids.values())) == len(gids)


def test_one_laser_is_scan_and_several_have_their_names() -> None:
    message = Message(topics.SCAN, "scan/front-1", b"", 0)
    alone = ros.ros_topic(message, ("front-1",))
    together = ros.ros_topic(message, ("front-1", "rear"))
    assert alone is not None
    assert alone.name == "/scan"
    assert together is not None
    assert together.name == "/front_1/scan"
    digit = ros.ros_topic(Message(topics.SCAN, "scan/2nd", b"", 0), ())
    assert digit is not None
    assert digit.name == "/s2nd/scan"


def test_range_has_no_variance_in_humble(session: FakeSession) -> None:
    for distro in ("humble", "jazzy"):
        mirror = RosMirror(session, RosSettings(distro=distro))
        for message in messages():
            mirror.publish(message)
    humble, jazzy = (payload for key, payload, _ in session.puts if "Range_" in key)
    assert jazzy[:-4] == humble
    reference = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(humble, topics.RANGE)
    assert reference.range == cdr.decode_range(jazzy).range == 1.0  # type: ignore[attr-defined]


def test_json_has_no_place_in_ros() -> None:
    for topic, suffix in (
        (topics.POLAR, "sectors/polar/x"),
        (topics.HEALTH_JSON, "health/json"),
        (topics.INFO, "info"),
    ):
        assert ros.ros_topic(Message(topic, suffix, b"", 0), ()) is None
