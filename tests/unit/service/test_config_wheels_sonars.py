"""Configuration of wheels, sonars and boards that are several sources, and what is assembled from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.encoder_odrive import ODrivePairConversation
from drivers.encoder_roboclaw import RoboClawConversation
from drivers.encoder_vesc import VescPairConversation
from drivers.readings import ChainReading, LinkState, Reading, WheelReading
from drivers.sonar_maxbotix import MaxBotixConversation
from service.assemble import sensors
from service.assemble_wires import conversation_of, wires
from service.config import Config, load
from service.errors import WrongUsage
from service.sensors import Chain, Wheels

MS = 1_000_000

BOARD = """
[drive]
source = "drive"
[wheels.drive]
driver = "arduino-bridge"
port = "/dev/board"
[sonars.front]
driver = "arduino-bridge"
port = "/dev/board"
transducers = [{ channel = 7, x_m = 0.2 }, { channel = 8 }]
"""

AUTOPILOT = """
[drive]
source = "drive"
[wheels.drive]
driver = "mavlink"
port = "udpin:127.0.0.1:14550"
[sonars.front]
driver = "mavlink"
port = "udpin:127.0.0.1:14550"
transducers = [{ channel = 1 }]
"""


def config(tmp_path: Path, text: str) -> Config:
    file = tmp_path / "umfeld.toml"
    file.write_text(text)
    return load(file, environment={}).config


@pytest.mark.parametrize(("text", "port"), [(BOARD, "/dev/board"), (AUTOPILOT, None)])
def test_a_board_is_one_wire_with_two_sources(tmp_path: Path, text: str, port: str | None) -> None:
    whole = config(tmp_path, text)
    [wire] = wires(whole)
    assert wire.port == port
    assert set(wire.conversations) == {"drive", "front"}
    found = sensors(whole)
    assert isinstance(found["drive"], Wheels)
    assert isinstance(found["front"], Chain)


def test_every_reader_gets_a_board_of_its_own_and_its_sources_share_it(tmp_path: Path) -> None:
    [wire] = wires(config(tmp_path, BOARD))
    first = {name: make() for name, make in wire.conversations.items()}
    second = {name: make() for name, make in wire.conversations.items()}
    assert not {id(each) for each in first.values()} & {id(each) for each in second.values()}
    for talk in first.values():
        talk.connected(0)
    answers = {b"\rb\r": b"57600\r\n", b"e\r": b"5 7\r\n", b"p 7\r": b"107\r\n", b"p 8\r": b"45\r\n"}
    found: dict[str, list[Reading]] = {"drive": [], "front": []}
    for ms in range(500):
        asked = [question for talk in first.values() for question in talk.requests(ms * MS)]
        assert len(asked) <= 1
        for question in asked:
            assert isinstance(question, bytes)
            for name, talk in first.items():
                found[name] += talk.receive(answers[question], (ms + 1) * MS)
    assert {type(each) for each in found["drive"]} == {WheelReading}
    assert {type(each) for each in found["front"]} == {ChainReading}
    assert all(talk.state is LinkState.RUNNING for talk in first.values())
    assert all(talk.state is LinkState.SILENT for talk in second.values())


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (
            "[drive]\nsource='w'\n[wheels.w]\ndriver='roboclaw'\nport='a'\naddress=0x81\nleft_motor=2",
            RoboClawConversation,
        ),
        ("[drive]\nsource='w'\n[can.c]\n[wheels.w]\ndriver='odrive'\ncan='c'\nfirmware='0.6'", ODrivePairConversation),
        (
            "[drive]\nsource='w'\n[can.c]\n[wheels.w]\ndriver='vesc'\ncan='c'\nid_left=1\nid_right=2",
            VescPairConversation,
        ),
        ("[sonars.s]\ndriver='maxbotix'\nport='a'\nfamily='lv'\ntransducers=[{channel=1}]", MaxBotixConversation),
        (
            "[sonars.s]\ndriver='maxbotix'\nport='a'\nfamily='xl'\nlines='labelled'\n"
            "transducers=[{channel=1},{channel=4}]",
            MaxBotixConversation,
        ),
    ],
)
def test_each_device_has_its_driver(tmp_path: Path, text: str, kind: type) -> None:
    whole = config(tmp_path, text)
    [(_, _, device)] = whole.devices()
    assert isinstance(conversation_of(device), kind)
    assert len(sensors(whole)) == 1
    [wire] = wires(whole)
    assert len(wire.conversations) == 1


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            BOARD + "[sonars.rear]\ndriver='arduino-bridge'\nport='/dev/board'\ntransducers=[{channel=9}]",
            "already used by",
        ),
        (BOARD.replace('"arduino-bridge"', '"mavlink"', 1), "already used by"),
        ("[sonars.s]\ndriver='mavlink'\nport='udpin:0.0.0.0:14550'", "only addresses of this machine"),
        ("[sonars.s]\ndriver='mavlink'\nport='udpin:14550'", "is no UDP address"),
        ("[sonars.s]\ndriver='maxbotix'\nport='a'\nfamily='lv'\ntransducers=[{channel=2}]", "labelled"),
        ("[drive]\nsource='w'\n[can.c]\n[wheels.w]\ndriver='odrive'\ncan='c'\nnode_right=0", "node id of its own"),
        (
            "[drive]\nsource='w'\n[can.c]\n[wheels.w]\ndriver='odrive'\ncan='c'\nnode_left=32\n"
            "[sonars.s]\ndriver='usboard'\ncan='c'",
            "uses CAN id 0x400",
        ),
    ],
)
def test_what_cannot_be_is_told(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(WrongUsage) as refused:
        config(tmp_path, text)
    assert fault in str(refused.value)


UNITS = """
[robot]
footprint_m = [[0.45, 0.3], [-0.45, 0.3], [-0.45, -0.3], [0.45, -0.3]]
[drive]
source = "drive"
wheel_radius_left_m = 0.1
track_width_m = 0.5
[wheels.drive]
driver = "arduino-bridge"
port = "/dev/board"
[sonars.front]
driver = "arduino-bridge"
port = "/dev/board"
cone_deg = 30.0
range_max_m = 3.5
transducers = [{ channel = 7, x_m = 0.2, yaw_deg = 90.0 }]
"""


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("[0.45, 0.3], [-0.45", "[45, 0.3], [-0.45", r"footprint_m\[0\]\[0\]: is 45 metres; write 0.45 or 0.045"),
        (
            "left_m = 0.1",
            "left_m = 100",
            "wheel_radius_left_m: is 100 metres; write 1 or 0.1 if centimetres or millimetres",
        ),
        ("width_m = 0.5", "width_m = 50", "track_width_m: is 50 metres; write 0.5"),
        ("cone_deg = 30.0", "cone_deg = 0.5236", "cone_deg: is 0.5236 degrees; write 30 if radians were meant"),
        ("range_max_m = 3.5", "range_max_m = 350", "range_max_m: is 350 metres; write 3.5"),
        ("x_m = 0.2", "x_m = 200", "x_m: is 200 metres; write 2 or 0.2"),
        ("yaw_deg = 90.0", "yaw_deg = 1.5708", "yaw_deg: is 1.5708 degrees; write 90 if radians were meant"),
        ("yaw_deg = 90.0", "yaw_deg = -3.14159", "yaw_deg: is -3.14159 degrees; write -180 if radians were meant"),
    ],
)
def test_units_that_were_mistaken_are_told_with_what_was_meant(
    tmp_path: Path, right: str, wrong: str, told: str
) -> None:
    config(tmp_path, UNITS)
    assert right in UNITS
    with pytest.raises(WrongUsage, match=told):
        config(tmp_path, UNITS.replace(right, wrong))
