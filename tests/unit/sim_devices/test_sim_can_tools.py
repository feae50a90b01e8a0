"""What set-up tools and libraries ask of emulated ODrives and VESCs, frame by frame."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import pytest

from sim_devices.checksums import crc16_ccitt
from sim_devices.device import F64, Frame, Mount
from sim_devices.encoder_odrive import ODriveAxis
from sim_devices.encoder_vesc import Vesc
from sim_devices.wheel import Side, Wheel

MS = 1_000_000
SECOND = 1_000_000_000
SERIAL = bytes.fromhex("2f1e9d7c5b3a")
OTHER = bytes.fromhex("2f1e9d7c5b3b")


class Still:
    """Wheels that turn no further than told."""

    def __init__(self) -> None:
        self.travel_m = 0.0
        self.speed_m_s = 0.0

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return bearing_rad + range_max_m

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return range_max_m

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self.travel_m, self.travel_m

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        self.speed_m_s = speed_m_s


def axis(generation: str = "0.6") -> ODriveAxis:
    one = ODriveAxis(
        Wheel(Still(), "left", 0.1, 1.0), 0, generation=generation, serial=int.from_bytes(SERIAL, "little")
    )
    one.step(0, [])
    one.step(SECOND, [])
    return one


def heard(one: ODriveAxis | Vesc, frame: Frame, now_ns: int = SECOND) -> list[Frame]:
    """What it answers, without what it sends by itself."""
    unasked = one.step(now_ns, [])
    assert not [each for each in unasked if each.can_id & 0x1F in (4, 5, 6)]
    return one.step(now_ns, [frame])


# -- ODrive -----------------------------------------------------------------------------------------------------------


def test_two_axes_are_two_boards_to_a_search() -> None:
    told = [
        heard(each, Frame(0x7E6, remote=True))
        for each in (
            ODriveAxis(Wheel(Still(), "left", 0.1, 1.0), 0),
            ODriveAxis(Wheel(Still(), "right", 0.1, 1.0), 1),
        )
        if not each.step(0, [])
    ]
    assert [[frame.can_id for frame in frames] for frames in told] == [[0x006], [0x026]]
    assert told[0][0].data[1:7] != told[1][0].data[1:7]


def test_an_address_goes_to_the_board_with_that_number() -> None:
    one = axis()
    assert heard(one, Frame(0x7E6, remote=True)) == [Frame(0x006, b"\x00" + SERIAL)]
    heard(one, Frame(0x7E6, b"\x05" + OTHER))
    assert one.node == 0
    heard(one, Frame(0x7E6, b"\x05" + SERIAL))
    assert one.node == 5
    assert heard(one, Frame(0x7E6, b"")) == [Frame(0x0A6, b"\x05" + SERIAL)]


def test_a_board_gives_its_address_up_to_another_and_falls_silent() -> None:
    one = axis()
    heard(one, Frame(0x7E6, b"\x00" + OTHER))
    later = [frame for at_ns in range(SECOND, 2 * SECOND, MS) for frame in one.step(at_ns, [])]
    assert later == []
    assert heard(one, Frame(0x009, remote=True), 2 * SECOND) == []
    assert heard(one, Frame(0x7E6, remote=True), 2 * SECOND) == [Frame(0x7E6, b"\x3f" + SERIAL)]
    heard(one, Frame(0x7E6, b"\x02" + SERIAL), 2 * SECOND)
    assert {frame.can_id >> 5 for frame in one.step(2 * SECOND + 200 * MS, [])} == {2}


@pytest.mark.parametrize(("how", "node"), [(b"\x00", 0), (b"\x01", 5), (b"\x02", 0x3F)])
def test_a_reboot_keeps_what_was_saved(how: bytes, node: int) -> None:
    one = axis()
    heard(one, Frame(0x7E6, b"\x05" + SERIAL))
    heard(one, Frame(0x0B6, how))
    assert one.node == node


def test_values_of_the_tree_read_as_written() -> None:
    one = axis()
    number = struct.pack("<H", 400)
    assert heard(one, Frame(0x004, b"\x00" + number + b"\x00")) == [Frame(0x005, b"\x00" + number + bytes(5))]
    assert heard(one, Frame(0x004, b"\x01" + number + b"\x00" + struct.pack("<f", 1.234))) == []
    (answer,) = heard(one, Frame(0x004, b"\x00" + number + b"\x00"))
    assert answer.can_id == 0x005
    assert struct.unpack("<BHBf", answer.data) == (0, 400, 0, pytest.approx(1.234))
    for short in (b"\x00", b"\x00\x01", b"\x07" + number + b"\x00"):
        assert heard(one, Frame(0x004, short)) == []


def test_older_firmware_has_no_tree_on_can() -> None:
    assert heard(axis("0.5"), Frame(0x004, b"\x00\x07\x00\x00")) == []
    assert heard(axis("0.5"), Frame(0x004, remote=True)) == [Frame(0x004, bytes(8))]


# -- VESC -------------------------------------------------------------------------------------------------------------


def controller() -> tuple[Vesc, Still]:
    scene = Still()
    one = Vesc(Wheel(scene, "left", 0.1, 1.0), 10, pole_pairs=7, rates_hz={})
    one.step(0, [])
    return one, scene


def joined(frames: Sequence[Frame], asker: int) -> bytes:
    """The message in the parts that hosts put together, its length and its code right."""
    *parts, end = frames
    assert {frame.can_id for frame in parts} == {0x0500 | asker}
    assert end.can_id == 0x0700 | asker
    message = b""
    for frame in parts:
        assert frame.data[0] == len(message)
        message += frame.data[1:]
    assert end.data == struct.pack(">BBHH", 10, 1, len(message), crc16_ccitt(message))
    return message


def test_vesc_tells_its_values_to_who_asks() -> None:
    one, scene = controller()
    scene.travel_m = 2.0 * 0.6283185307179586  # two turns
    asked = Frame(0x080A, bytes.fromhex("2a0004") + bytes(5), extended=True)  # some hosts fill up to eight bytes
    message = joined(one.step(SECOND, [asked]), 0x2A)
    assert len(message) == 74
    assert message[0] == 4
    assert struct.unpack_from(">hh", message, 1) == (300, 250)
    assert struct.unpack_from(">h", message, 27) == (240,)
    assert struct.unpack_from(">ii", message, 45) == (2 * 7 * 6, 2 * 7 * 6)
    assert message[58] == 10


def test_vesc_tells_chosen_values_alone() -> None:
    one, _ = controller()
    chosen = (1 << 8 | 1 << 13).to_bytes(4, "big")  # voltage, tachometer
    message = joined(one.step(SECOND, [Frame(0x080A, b"\x2a\x00\x32" + chosen, extended=True)]), 0x2A)
    assert message == b"\x32" + chosen + struct.pack(">hi", 240, 0)


def test_vesc_tells_its_firmware() -> None:
    one, _ = controller()
    message = joined(one.step(SECOND, [Frame(0x080A, b"\x2a\x00\x00", extended=True)]), 0x2A)
    assert message[:6] == b"\x00\x06\x02" + b"60\x00"
    assert len(message) == 31


def test_vesc_obeys_a_message_of_the_serial_protocol_and_owes_no_answer_elsewhere() -> None:
    one, scene = controller()
    assert one.step(SECOND, [Frame(0x080A, b"\x2a\x00\x08" + struct.pack(">i", 840)[:4], extended=True)]) == []
    assert scene.speed_m_s == pytest.approx(840 / 60 / 7 * 0.6283185307179586)
    for data in (b"\x2a\x01\x04", b"\x2a\x02\x04", b"\x2a\x00\x63", b"\x2a\x00\x32\x00", b"\x2a\x00"):
        assert one.step(SECOND, [Frame(0x080A, data, extended=True)]) == []
