"""Random and damaged bytes for the wheel, sonar and MAVLink drivers: no exception, no slow chunk, nothing false.

UMFELD_FUZZ_CASES scales the number of frames (default 12000; the long run has 300000). Seeds are fixed.
"""

from __future__ import annotations

import os
import random
import struct
import time

import pytest

from drivers.checksums import crc16_ccitt
from drivers.conversation import CanFrame, Conversation
from drivers.encoder_arduino_bridge import ArduinoBridgeConversation
from drivers.encoder_odrive import ODrivePairConversation
from drivers.encoder_roboclaw import Command, RoboClawConversation, decode_answer
from drivers.encoder_vesc import VescPairConversation
from drivers.errors import FrameError
from drivers.mavlink_frames import DISTANCE_SENSOR, WHEEL_DISTANCE, Frames, encode_v2
from drivers.mavlink_in import MavlinkConversation
from drivers.readings import SourceCounters
from drivers.sonar_maxbotix import MaxBotixConversation

CASES = int(os.environ.get("UMFELD_FUZZ_CASES", "12000"))
MS = 1_000_000
SLOWEST_S = 0.05


def serial_drivers() -> list[Conversation[bytes]]:
    return [
        ArduinoBridgeConversation(pings=(7,), contacts={2: True}),
        RoboClawConversation(),
        MaxBotixConversation("hr-5m"),
        MaxBotixConversation("lv", form="labelled"),
        MaxBotixConversation("lv", form="list"),
        MavlinkConversation(),
    ]


@pytest.mark.parametrize("index", range(6))
def test_random_bytes_raise_nothing_and_hold_up_nobody(index: int) -> None:
    """Chunks of noise, of the marks the protocols begin and end with, and of one letter without end."""
    rng = random.Random(index)
    conversation = serial_drivers()[index]
    conversation.connected(0)
    alphabet = b"\r\nR0123456789 -:,\xfd\xfe\xff\x00e"
    slowest_s = 0.0
    for step in range(CASES // 40):
        kind = rng.randrange(4)
        size = rng.choice((1, 7, 64, 4096))
        if kind == 0:
            chunk = rng.randbytes(size)
        elif kind == 1:
            chunk = bytes(rng.choices(alphabet, k=size))
        elif kind == 2:
            chunk = bytes((rng.choice(alphabet),)) * 65536
        else:
            chunk = bytes(rng.choices(b"\r\n", k=size))
        conversation.requests(step * 20 * MS)
        began = time.process_time()
        list(conversation.receive(chunk, step * 20 * MS))
        slowest_s = max(slowest_s, time.process_time() - began)
    assert slowest_s < SLOWEST_S * 10, "no hang; the machine may have other work"


def damaged(rng: random.Random, frame: bytes) -> bytes:
    """Bytes changed, lost or added at one to three places."""
    work = bytearray(frame)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(work))
        action = rng.randrange(3)
        if action == 0:
            work[at] ^= rng.randrange(1, 256)
        elif action == 1 and len(work) > 1:
            del work[at]
        else:
            work.insert(at, rng.randrange(256))
    return bytes(work)


def test_damaged_roboclaw_answers_do_not_pass() -> None:
    """A code of 16 bits lets one of 65536 arbitrary changes pass: where three places changed, that is the bound."""
    rng = random.Random(78)
    false = 0
    for _ in range(CASES):
        data = struct.pack(">ii", rng.randrange(-(2**31), 2**31), rng.randrange(-(2**31), 2**31))
        whole = data + crc16_ccitt(b"\x80\x4e" + data).to_bytes(2, "big")
        bad = damaged(rng, whole)
        if bad == whole:
            continue
        try:
            decode_answer(0x80, Command.BOTH_COUNTS, bad)
        except FrameError:
            continue
        false += 1
    assert false <= 1 + CASES // 20_000


def test_damaged_mavlink_frames_do_not_pass_and_the_next_one_is_read() -> None:
    rng = random.Random(330)
    guard = encode_v2(DISTANCE_SENSOR, (1, 20, 400, 77, 1, 0, 0, 255, *[0.0] * 6, 0), sequence=0, system=9, component=9)
    false = lost = 0
    began = time.process_time()
    for count in range(CASES // 2):
        ways = tuple(rng.uniform(-100, 100) for _ in range(16))
        whole = encode_v2(WHEEL_DISTANCE, (count, *ways, 2), sequence=count, system=1, component=1)
        bad = damaged(rng, whole)
        if whole in bad:  # a byte added in front is no damage
            continue
        found = [message for message, _ in Frames(SourceCounters()).feed(bad + guard + bytes(300))]
        lost += not any(message.system == 9 for message in found)
        false += sum(message.system != 9 for message in found)
    frames_per_s = CASES / (time.process_time() - began)
    assert lost == 0
    assert false <= 1 + CASES // 20_000
    assert frames_per_s > 500, "encoding and damaging them took time too, and the machine may have other work"


@pytest.mark.parametrize("conversation", [ODrivePairConversation(0, 1), VescPairConversation(1, 2)])
def test_random_can_frames_raise_nothing(conversation: Conversation[CanFrame]) -> None:
    rng = random.Random(9)
    conversation.connected(0)
    ids = [1, 9, 10, 33, 41, 42, 0x901, 0x1B01, 0x902, 0x1B02]
    for step in range(CASES):
        frame = CanFrame(rng.choice(ids), rng.randbytes(rng.choice((8, 8, 8, 6, 0, 3))), extended=rng.random() < 0.5)
        list(conversation.receive(frame, step * MS))
        conversation.requests(step * MS)
        assert conversation.trouble is None or conversation.trouble
