"""The same data for an unmodified ROS 2 system with rmw_zenoh: its keys, attachments, tokens and quality of service.

Payloads are the CDR bytes of the native keys, encoded once. What rmw_zenoh_cpp expects (its design document and
source, version 0.2 and later):

    key          <domain>/<topic>/<pkg::msg::dds_::Name_>/<type hash>
    attachment   int64 sequence from 1, int64 source time ns, byte 16, 16-byte id of the publisher; little endian
    tokens       @ros2_lv/<domain>/<session>/<node>/<entity>/<NN|MP>/<enclave>/<namespace>/<node name>[/<topic>/
                 <type>/<hash>/<qos>], with % for / and for what is empty
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from typing import Any

import xxhash

from service import topics, zenoh_session
from service.payloads import Message
from service.topics import Priority

_SENSOR_QOS = "2::,5:,:,:,,"  # best effort, volatile, keep last 5
_LATCHED_QOS = ":1:,1:,:,:,,"  # reliable, transient local, keep last 1
_TF_QOS = "::,100:,:,:,,"  # reliable, volatile, keep last 100
_RELIABLE_QOS = "::,10:,:,:,,"

_HUMBLE_HASH = "TypeHashNotSupported"
_HASHES = {
    topics.GRID: "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    topics.GRID_UPDATE: "c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8",
    topics.LASER_SCAN: "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    topics.CLOUD_TYPE: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    topics.RANGE: "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    topics.ODOMETRY: "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    topics.TF: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    topics.POSE: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    topics.DIAGNOSTICS: "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
}
"""REP-2016 hashes (RIHS01) of our types, the same from Iron on."""


@dataclass(frozen=True, slots=True)
class RosSettings:
    """distro: humble, or iron and later. lasers: names of the lasers; one alone is /scan, several are /<name>/scan."""

    distro: str = "jazzy"
    domain_id: int = 0
    node: str = "umfeld"
    lasers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RosTopic:
    """A ROS topic: name with its leading slash, type, quality of service as rmw_zenoh writes it."""

    name: str
    type: str
    qos: str

    @property
    def is_latched(self) -> bool:
        """Transient local: late subscribers receive the last value."""
        return self.qos == _LATCHED_QOS


def ros_topic(message: Message, lasers: tuple[str, ...]) -> RosTopic | None:
    """Where a message goes in ROS; None if it has no place there (JSON, health of single devices)."""
    parts = message.suffix.split("/")
    match message.topic:
        case topics.SCAN:
            name = "/scan" if lasers == (parts[1],) else f"/{_ros_name(parts[1])}/scan"
            return RosTopic(name, topics.LASER_SCAN, _SENSOR_QOS)
        case topics.CLOUD:
            return RosTopic(f"/{_ros_name(parts[1])}/points", topics.CLOUD_TYPE, _RELIABLE_QOS)
        case topics.RANGE_ONE:
            return RosTopic(f"/{_ros_name(parts[1])}/range_{parts[2]}", topics.RANGE, _SENSOR_QOS)
        case topics.ODOM:
            return RosTopic("/odom", topics.ODOMETRY, _RELIABLE_QOS)
        case topics.POSE_KEY:
            return RosTopic("/pose", topics.POSE, _RELIABLE_QOS)
        case topics.TF_KEY:
            return RosTopic("/tf", topics.TF, _TF_QOS)
        case topics.TF_STATIC:
            return RosTopic("/tf_static", topics.TF, _LATCHED_QOS)
        case topics.MAP_GRID:
            return RosTopic("/map", topics.GRID, _LATCHED_QOS)
        case topics.MAP_GRID_UPDATE:
            return RosTopic("/map_updates", topics.GRID_UPDATE, _RELIABLE_QOS)
        case topics.HEALTH:
            return RosTopic("/diagnostics", topics.DIAGNOSTICS, _RELIABLE_QOS)
    return None


def _ros_name(name: str) -> str:
    """A name as ROS allows it in topics: letters, digits, underscores, not beginning with a digit."""
    plain = name.replace("-", "_")
    return f"s{plain}" if plain[0].isdigit() else plain


def type_hash(ros_type: str, distro: str) -> str:
    """The hash chunk of keys and tokens."""
    return _HUMBLE_HASH if distro == "humble" else f"RIHS01_{_HASHES[ros_type]}"


def dds_type(ros_type: str) -> str:
    """sensor_msgs/msg/LaserScan as sensor_msgs::msg::dds_::LaserScan_."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain_id: int, topic: RosTopic, distro: str) -> str:
    """The key a topic's samples travel under."""
    return f"{domain_id}/{topic.name.strip('/')}/{dds_type(topic.type)}/{type_hash(topic.type, distro)}"


def publisher_id(token: str) -> bytes:
    """The 16 bytes that tell publishers apart: XXH3-128 of the token's text, low half first, little endian."""
    digest = xxhash.xxh3_128_intdigest(token.encode())
    return (digest & (1 << 64) - 1).to_bytes(8, "little") + (digest >> 64).to_bytes(8, "little")


def attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh wants beside every sample; one without it is dropped there."""
    return struct.pack("<qqB", sequence, source_ns, len(gid)) + gid


@dataclass(slots=True)
class _RosPublisher:
    publisher: Any
    token: Any
    gid: bytes
    sent: int = 0


class RosMirror:
    """One ROS node on the daemon's session; publishers appear with their first message."""

    def __init__(self, session: Any, settings: RosSettings) -> None:
        self._session = session
        self._settings = settings
        self._entities = itertools.count(1)
        self._publishers: dict[str, _RosPublisher | None] = {}
        zid = str(session.zid())
        self._token_head = f"@ros2_lv/{settings.domain_id}/{zid}/0"
        self._node_token = session.liveliness().declare_token(f"{self._token_head}/0/NN/%/%/{settings.node}")

    def publish(self, message: Message) -> None:
        """Send the message's bytes under its ROS key, if it has one."""
        if message.suffix not in self._publishers:
            self._publishers[message.suffix] = self._declare(message)
        mirror = self._publishers[message.suffix]
        if mirror is None:
            return
        mirror.sent += 1
        payload = message.payload
        if message.topic is topics.RANGE_ONE and self._settings.distro == "humble":
            payload = payload[:-4]  # Range got its variance in Iron
        mirror.publisher.put(payload, attachment=attachment(mirror.sent, message.stamp_ns, mirror.gid))

    def _declare(self, message: Message) -> _RosPublisher | None:
        topic = ros_topic(message, self._settings.lasers)
        if topic is None:
            return None
        settings = self._settings
        token_key = (
            f"{self._token_head}/{next(self._entities)}/MP/%/%/{settings.node}/{topic.name.replace('/', '%')}"
            f"/{dds_type(topic.type)}/{type_hash(topic.type, settings.distro)}/{topic.qos}"
        )
        key = data_key(settings.domain_id, topic, settings.distro)
        if topic.is_latched:
            publisher = zenoh_session.declare_latched(self._session, key, Priority.DATA)
        else:
            publisher = zenoh_session.declare_stream(
                self._session, key, message.topic.priority, express=message.topic.express
            )
        token = self._session.liveliness().declare_token(token_key)
        return _RosPublisher(publisher, token, publisher_id(token_key))
