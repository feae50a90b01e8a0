"""Damaged messages of lasers: none may pass as true where the code can find it, and the one behind must not be lost.

UMFELD_FUZZ_CASES scales the number of damaged messages (default 12000; the long run has 300000 for each parser).

Every code here finds one changed byte. LMS2xx telegrams have 16 bits, but their scheme moves by one bit only from byte
to byte, so that changes of neighbours may cancel (d and 2 d). LD06 packets, CoLa telegrams and legacy RPLIDAR capsules
have 8 bits: two changes cancel in 1 of 256 cases. That is the protocols' limit, and is measured here. Lost and surplus
bytes are always found, in these three by what stands around a message. RPLIDAR nodes have no code.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce
from operator import xor

import numpy as np
import pytest

from drivers import cola, laser_ldrobot, rplidar_messages, sick_telegrams
from drivers.checksums import crc8_ld06, crc16_sick
from drivers.conversation import Conversation
from drivers.laser_ldrobot import LdrobotConversation
from drivers.laser_rplidar import RplidarConversation
from drivers.laser_sick_cola import SickColaConversation
from drivers.laser_sick_lms2xx import SickLms2xxConversation

CASES = int(os.environ.get("UMFELD_FUZZ_CASES", "12000"))
Rng = np.random.Generator
Damage = Callable[[Rng, bytes], bytes]


# --- damage -----------------------------------------------------------------------------------------------------------


def substitute(rng: Rng, frame: bytes) -> bytes:
    at = int(rng.integers(len(frame)))
    return frame[:at] + bytes([frame[at] ^ int(rng.integers(1, 256))]) + frame[at + 1 :]


def flip_bit(rng: Rng, frame: bytes) -> bytes:
    at = int(rng.integers(len(frame)))
    return frame[:at] + bytes([frame[at] ^ 1 << int(rng.integers(8))]) + frame[at + 1 :]


def delete(rng: Rng, frame: bytes) -> bytes:
    at = int(rng.integers(len(frame)))
    return frame[:at] + frame[at + 1 :]


def insert(rng: Rng, frame: bytes) -> bytes:
    at = int(rng.integers(1, len(frame)))
    return frame[:at] + rng.bytes(1) + frame[at:]


def lose_run(rng: Rng, frame: bytes) -> bytes:
    a, b = sorted(rng.integers(0, len(frame) + 1, 2))
    return frame[:a] + frame[max(b, a + 1) :]


def double_run(rng: Rng, frame: bytes) -> bytes:
    a, b = sorted(rng.integers(0, len(frame) + 1, 2))
    return frame[:b] + frame[min(a, b - 1) :]


def cut_end(rng: Rng, frame: bytes) -> bytes:
    return frame[: int(rng.integers(1, len(frame)))]


def two_bytes(rng: Rng, frame: bytes) -> bytes:
    return substitute(rng, substitute(rng, frame))


def burst(rng: Rng, frame: bytes) -> bytes:
    length = int(rng.integers(2, 12))
    at = int(rng.integers(len(frame) - length))
    return frame[:at] + rng.bytes(length) + frame[at + length :]


ONE_PLACE: list[Damage] = [substitute, flip_bit]
SHIFTED: list[Damage] = [delete, insert, lose_run, double_run, cut_end]
MANY: list[Damage] = [two_bytes, burst]


# --- protocols --------------------------------------------------------------------------------------------------------

Key = object


@dataclass(frozen=True)
class Protocol:
    """stream: messages before, the one to damage, at least two behind; read gives keys of what was accepted."""

    name: str
    stream: Callable[[Rng], list[bytes]]
    read: Callable[[bytes], list[Key]]
    many_limit: float  # how much of damage at several places may pass


def sick_stream(rng: Rng) -> list[bytes]:
    frames = []
    for _ in range(4):
        payload = (
            b"\xb0" + struct.pack("<H", 101 | 0x4000) + rng.integers(0, 0x1FFF, 101).astype("<u2").tobytes() + b"\x10"
        )
        frame = struct.pack("<BBH", 2, 0x80, len(payload)) + payload
        frames.append(frame + struct.pack("<H", crc16_sick(frame)))
    return [frames[0], frames[1], b"".join(frames[2:])]


def read_sick(data: bytes) -> list[Key]:
    return [each.payload for each in sick_telegrams.TelegramReader().feed(data, 0) if each.size > 1]


def ld_stream(rng: Rng) -> list[bytes]:
    start, when = float(rng.integers(0, 360)), float(rng.integers(0, 30000))
    packets = []
    for number in range(5):
        first = (start + 9.6 * number) % 360
        body = b"\x54\x2c" + struct.pack("<HH", 3600, int(first * 100)) + rng.bytes(36)
        body += struct.pack("<HH", int((first + 8.8) % 360 * 100), int(when + 2.667 * number) % 30000)
        packets.append(body + bytes([crc8_ld06(body)]))
    return [packets[0], packets[1], b"".join(packets[2:])]


def read_ld(data: bytes) -> list[Key]:
    screen = laser_ldrobot.Screen()
    return [
        (each.start_deg, each.end_deg, each.time_ms, each.distance_mm.tobytes(), each.intensity.tobytes())
        for packet in laser_ldrobot.PacketReader().feed(data, 0)
        for each in screen.check(packet)
    ]


def cola_stream(rng: Rng) -> list[bytes]:
    frames = []
    for number in range(4):
        fixed = (1, 1, 18480390, 0, number, number, 66_667 * number, 66_667 * number + 6_000, 0, 0, 0, 1500, 162, 0)
        payload = b"sSN LMDscandata " + struct.pack(">HHIHHHIIHHHIIH", *fixed) + b"\0\x01DIST1"
        payload += struct.pack(">ffiHH", 1.0, 0.0, -450000, 5000, 60)
        payload += rng.integers(200, 9000, 60).astype(">u2").tobytes()
        payload += bytes(8) + b"\0\x01\x07\xb2\x01\x01\0\x32\x0e\0\x02\x13\x40" + bytes(2)
        frames.append(b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes([reduce(xor, payload)]))
    return [frames[0], frames[1], b"".join(frames[2:])]


def read_cola(data: bytes) -> list[Key]:
    found: list[Key] = []
    for each in cola.TelegramReader().feed(data, 0):
        scan = each.scan
        if scan is not None and scan.serial == 18480390 and not scan.tail_is_odd:
            rows = [(name, row.raw.tobytes(), row.first_deg, row.step_deg) for name, row in scan.channels.items()]
            found.append((scan.status, scan.scan_us, scan.sent_us, scan.scans_per_s, rows))
    return found


STREAM_HEAD = b"\xa5\x5a\x54\0\0\x40\x82"


def capsule_stream(rng: Rng) -> list[bytes]:
    """From the begin of a scan, so that the head's speed is known; a capsule is told with the one behind it."""
    start = int(rng.integers(0, 300 * 64))
    capsules = []
    for number in range(14):
        body = struct.pack("<H", (start + number * 14 * 64) % 23040 | (0x8000 if number == 0 else 0)) + rng.bytes(80)
        total = reduce(xor, body)
        capsules.append(bytes([0xA0 | total & 15, 0x50 | total >> 4]) + body)
    return [b"".join(capsules[:3]), capsules[3], b"".join(capsules[4:])]


def read_capsules(data: bytes) -> list[Key]:
    found = rplidar_messages.AnswerReader().feed(STREAM_HEAD + data, 0)
    return [
        each.distance_m.tobytes() + np.round(each.angle_rad, 9).tobytes()
        for each in found
        if isinstance(each, rplidar_messages.Block)
    ]


PROTOCOLS = [
    Protocol("sick_lms2xx", sick_stream, read_sick, 1.0 / 500),
    Protocol("ldrobot", ld_stream, read_ld, 1.0 / 100),
    Protocol("cola", cola_stream, read_cola, 1.0 / 100),
    Protocol("capsules", capsule_stream, read_capsules, 1.0 / 100),
]


def false_accepts(protocol: Protocol, damage: Damage, cases: int) -> int:
    """How many damaged messages were told; asserts that no true one behind was lost and no true one told twice."""
    rng = np.random.default_rng(sum(map(ord, protocol.name + damage.__name__)))
    false = 0
    for case in range(cases):
        if case % 50 == 0:
            before, victim, behind = protocol.stream(rng)
            true = protocol.read(before + victim + behind)
            last = true[-1]
        damaged = damage(rng, victim)
        if damaged == victim:
            continue
        seen = protocol.read(before + damaged + behind)
        assert seen, (protocol.name, damage.__name__, case)
        assert seen[-1] == last, (protocol.name, damage.__name__, case)
        false += any(each not in true for each in seen)
    return false


every = pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda each: each.name)


@every
@pytest.mark.parametrize("damage", [*ONE_PLACE, *SHIFTED], ids=lambda each: each.__name__)
def test_damage_that_is_always_found(protocol: Protocol, damage: Damage) -> None:
    assert false_accepts(protocol, damage, max(CASES // len([*ONE_PLACE, *SHIFTED]), 100)) == 0


@every
@pytest.mark.parametrize("damage", MANY, ids=lambda each: each.__name__)
def test_damage_that_may_cancel_stays_below_its_limit(protocol: Protocol, damage: Damage) -> None:
    cases = max(CASES // 8, 500)
    assert false_accepts(protocol, damage, cases) <= protocol.many_limit * cases


CONVERSATIONS: list[Callable[[], Conversation[bytes]]] = [
    SickLms2xxConversation,
    RplidarConversation,
    LdrobotConversation,
    SickColaConversation,
]


@pytest.mark.parametrize("make", CONVERSATIONS, ids=lambda each: each.__name__)
def test_no_bytes_raise_or_hang(make: Callable[[], Conversation[bytes]]) -> None:
    """Random bytes, pieces of true messages and damaged ones, into whatever state the conversation is in."""
    rng = np.random.default_rng(7)
    conversation = make()
    conversation.connected(0)
    pool = [frame for protocol in PROTOCOLS for frame in protocol.stream(rng)]
    pool += [STREAM_HEAD, NODES_HEAD, b"\xa5\x5a\x14\0\0\0\x04" + rng.bytes(20), b"\xa5\x5a\x03\0\0\0\x06\0\0\0"]
    pool += [b"\xa5\x5a\xff\0\0\0\x20", b"\x06", b"\x15"]
    sick_payloads = ["a00010", "bb01b400320010", "f4" + 34 * "00" + "10", "f4" + rng.bytes(34).hex() + "10", "ba10"]
    sick_payloads += ["9061626310", "b1" + rng.bytes(152).hex() + "10", "9210", "f701" + 34 * "00" + "10"]
    pool += [sick(bytes.fromhex(payload)) for payload in sick_payloads]
    heads = [
        b"sRA DeviceIdent \0\x05a",
        b"sEA LMDscandata \x01",
        b"sFA\0\x03",
        b"sSN LMDscandata ",
        b"sRA DeviceIdent ",
    ]
    pool += [told(payload) for payload in heads]
    slowest = 0.0
    now_ns = 0
    for turn in range(max(CASES // 4, 1000)):
        now_ns += int(rng.choice([1, 20, 300, 3000], p=[0.7, 0.2, 0.08, 0.02])) * 1_000_000
        piece = pool[int(rng.integers(len(pool)))]
        chunk = (
            rng.bytes(int(rng.integers(0, 200))),
            piece,
            piece + pool[int(rng.integers(len(pool)))],
            burst(rng, piece) if len(piece) > 20 else piece,
            piece[: int(rng.integers(len(piece) + 1))],
        )[turn % 5]
        begin = time.thread_time()
        list(conversation.receive(chunk, now_ns))
        conversation.requests(now_ns)
        slowest = max(slowest, time.thread_time() - begin)
        assert conversation.silence_limit_ns > 0
    assert slowest < 0.5  # no hang; what it takes when nobody else works: 0.05


def sick(payload: bytes) -> bytes:
    frame = struct.pack("<BBH", 2, 0x80, len(payload)) + payload
    return frame + struct.pack("<H", crc16_sick(frame))


def told(payload: bytes) -> bytes:
    return b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes([reduce(xor, payload)])


NODES_HEAD = b"\xa5\x5a\x05\0\0\x40\x81"
FEEDS: dict[str, Callable[[], Callable[[bytes], object]]] = {
    "sick": lambda: lambda data: sick_telegrams.TelegramReader().feed(data, 0),
    "ldrobot": lambda: lambda data: laser_ldrobot.PacketReader().feed(data, 0),
    "cola": lambda: lambda data: cola.TelegramReader().feed(data, 0),
    "answers": lambda: lambda data: rplidar_messages.AnswerReader().feed(data, 0),
    "nodes": lambda: lambda data: rplidar_messages.AnswerReader().feed(NODES_HEAD + data, 0),
    "capsules": lambda: lambda data: rplidar_messages.AnswerReader().feed(STREAM_HEAD + data, 0),
}
FILLERS = [
    b"\0", b"\x02", b"\x02\x80", b"\x54\x2c", b"\xa5", b"\xa5\x5a", b"\x01\x01", b"\x02\x01", b"\xa5\x55",
    b"\x02\x80\x02\x00\x91", b"\x02\x02\x02\x02\x00\x00\x00\x20sSN", b"\xa5\x5a\x14\0\0\0\x03", b"\x01\x03\0\0\0",
    b"\x02\x80\x42\x00\x90",
]  # fmt: skip


@pytest.mark.parametrize("name", FEEDS)
def test_no_filler_takes_long(name: str) -> None:
    """4 kB, as much as a serial line has ready at once, of the worst; 50 ms for each."""
    feed = FEEDS[name]()
    for filler in FILLERS:
        data = filler * (4096 // len(filler))
        feed(data)  # tables are made once
        begin = time.thread_time()
        feed(data)
        assert time.thread_time() - begin < 0.5, filler


def rate_of(run: Callable[[], Iterable[object]]) -> float:
    """Messages a second, the best of several rounds."""
    best = 0.0
    for _ in range(7):
        begin = time.thread_time()
        count = len(list(run()))
        best = max(best, count / (time.thread_time() - begin))
    return best


def test_speed() -> None:
    """5000 messages a second or more of every kind, of full size."""
    rng = np.random.default_rng(9)
    payload = b"\xb0" + struct.pack("<H", 361 | 0x4000) + rng.integers(0, 0x1FFF, 361).astype("<u2").tobytes() + b"\x10"
    scans = sick(payload) * 50
    mode = sick_telegrams.MEASURING_MODES[0]

    def sick_scans() -> Iterable[object]:
        for each in sick_telegrams.TelegramReader().feed(scans, 0):
            yield sick_telegrams.ranges_of(sick_telegrams.decode_values(each.payload), mode)

    packets = b"".join(b"".join(ld_stream(rng)) for _ in range(20))
    telegrams = b"".join(cola_stream(rng)) * 20
    capsules = b"".join(capsule_stream(rng)[0] for _ in range(60))
    answers = (b"\xa5\x5a\x14\0\0\0\x04" + rng.bytes(20)) * 100
    assert rate_of(sick_scans) > 5000
    assert rate_of(lambda: read_ld(packets)) > 5000
    assert rate_of(lambda: read_cola(telegrams)) > 5000
    assert rate_of(lambda: rplidar_messages.AnswerReader().feed(STREAM_HEAD + capsules, 0)) > 2000
    assert rate_of(lambda: rplidar_messages.AnswerReader().feed(answers, 0)) > 5000
