"""The emulated CiA 406 encoder: exchanges recorded with another master, then that master (canopen) itself."""

from __future__ import annotations

import math
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import canopen
import pytest

from sim_devices.device import F64, Frame, Mount
from sim_devices.encoder_cia406 import FULL_RANGE, Cia406Encoder
from tests.waiting import GIVE_UP_S, wait_for

MS = 1_000_000
SECOND = 1_000_000_000
NODE = 0x21


class Rolling:
    """Wheels that roll at a steady speed from the first instant on."""

    def __init__(self, left_m_s: float = 0.0, right_m_s: float = 0.0) -> None:
        self.speeds = left_m_s, right_m_s

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        raise AssertionError("an encoder sees nothing")

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        raise AssertionError("an encoder hears nothing")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return self.speeds[0] * now_ns * 1e-9, self.speeds[1] * now_ns * 1e-9


class Bench:
    def __init__(self, scene: Rolling | None = None, node: int = NODE, **options: object) -> None:
        self.encoder = Cia406Encoder(scene or Rolling(), node, **options)  # type: ignore[arg-type]
        self.node = node
        self.now_ns = 0
        self.up = self.run(0.2)

    def run(self, seconds: float, step_s: float = 0.001) -> list[str]:
        end_ns = self.now_ns + round(seconds * SECOND)
        out: list[Frame] = []
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + round(step_s * SECOND))
            out += self.encoder.step(self.now_ns, [])
        return [text(frame) for frame in out]

    def tell(self, *frames: str) -> list[str]:
        sent = [Frame(int(one.split("#")[0], 16), bytes.fromhex(one.split("#")[1])) for one in frames]
        return [text(frame) for frame in self.encoder.step(self.now_ns, sent)]

    def read(self, index: int, sub: int = 0) -> int:
        (answer,) = self.tell(f"{0x600 + self.node:03X}#40{struct.pack('<HB', index, sub).hex()}00000000")
        data = bytes.fromhex(answer.split("#")[1])
        assert data[0] & 0xF3 == 0x43, answer
        return int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little")

    def write(self, index: int, sub: int, value: int, size: int) -> str:
        head = 0x23 | (4 - size) << 2
        key = struct.pack("<HB", index, sub).hex()
        data = value.to_bytes(size, "little").ljust(4, b"\0").hex()
        (answer,) = self.tell(f"{0x600 + self.node:03X}#{head:02X}{key}{data}")
        return answer


def text(frame: Frame) -> str:
    return f"{frame.can_id:03X}#{frame.data.hex().upper()}"


def abort_code(answer: str) -> int:
    data = bytes.fromhex(answer.split("#")[1])
    assert data[0] == 0x80, answer
    return int.from_bytes(data[4:], "little")


# -- recorded exchanges -----------------------------------------------------------------------------------------------


def test_boot_up_comes_first_and_once() -> None:
    assert Bench().up == ["721#00"]


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("621#4000100000000000", "5A1#4300100096010200"),
        ("621#4004600000000000", "5A1#4304600044040000"),
        ("621#2B17100064000000", "5A1#6017100000000000"),
        ("621#2B00620014000000", "5A1#6000620000000000"),
        ("621#2304600001000000", "5A1#8004600002000106"),
        ("621#4008100000000000", "5A1#410810000B000000"),
        ("621#4034120000000000", "5A1#8034120000000206"),
        ("621#4018100900000000", "5A1#8018100911000906"),
    ],
)
def test_sdo_exchanges(request_: str, answer: str) -> None:
    assert Bench(start_count=1092, name="SCRATCH ENC").tell(request_) == [answer]


def test_name_in_segments() -> None:
    bench = Bench(name="SCRATCH ENC")
    bench.tell("621#4008100000000000")
    assert bench.tell("621#6000000000000000") == ["5A1#0053435241544348"]
    assert bench.tell("621#7000000000000000") == ["5A1#1720454E43000000"]


def test_start_sends_the_position_at_once_and_then_cyclically() -> None:
    bench = Bench(start_count=0x0452, tpdo1_ms=20)
    assert bench.tell("000#0121") == ["1A1#52040000"]
    assert bench.run(0.1) == ["1A1#52040000"] * 5
    assert bench.tell("080#") == ["2A1#52040000"]
    bench.tell("000#8021")
    assert bench.run(0.1) == []
    assert bench.tell("080#") == []


def test_heartbeat_tells_the_state() -> None:
    bench = Bench(tpdo1_ms=0)
    bench.write(0x1017, 0, 100, 2)
    assert bench.run(0.35) == ["721#7F"] * 3
    bench.tell("000#0100")
    assert [frame for frame in bench.run(0.2) if frame.startswith("721")] == ["721#05"] * 2
    bench.tell("000#0221")
    assert bench.run(0.2) == ["721#04"] * 2
    assert bench.tell("621#4000100000000000") == []  # stopped: no SDO


# -- network management -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["000#8121", "000#8221", "000#8100"])
def test_resets_boot_again(command: str) -> None:
    bench = Bench()
    bench.tell("000#0121")
    bench.tell(command)
    assert bench.tell("621#4000100000000000") == []
    assert bench.run(0.2)[0] == "721#00"
    assert bench.encoder.state == 0x7F


@pytest.mark.parametrize("command", ["000#0122", "000#01", "000#FF21", "001#0121"])
def test_commands_that_are_not_for_it(command: str) -> None:
    bench = Bench()
    assert bench.tell(command) == []
    assert bench.encoder.state == 0x7F


def test_node_guarding_toggles() -> None:
    bench = Bench()
    ask = Frame(0x721, remote=True, dlc=1)
    answers = [text(bench.encoder.step(bench.now_ns, [ask])[0]) for _ in range(3)]
    assert answers == ["721#7F", "721#FF", "721#7F"]


def test_stored_values_survive_a_reset_and_unstored_ones_do_not() -> None:
    bench = Bench()
    bench.write(0x1017, 0, 250, 2)
    assert abort_code(bench.write(0x1010, 1, 1, 4)) == 0x08000020
    bench.write(0x1010, 1, int.from_bytes(b"save", "little"), 4)
    bench.write(0x6200, 0, 77, 2)
    bench.tell("000#8121")
    bench.run(0.2)
    assert bench.read(0x1017) == 250
    assert bench.read(0x6200) == 20
    bench.write(0x1011, 1, int.from_bytes(b"load", "little"), 4)
    bench.tell("000#8121")
    bench.run(0.2)
    assert bench.read(0x1017) == 0


# -- position ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("wheel", "sign"), [("left", 1), ("right", 1), ("right", -1)])
def test_position_follows_the_wheel(wheel: str, sign: int) -> None:
    bench = Bench(Rolling(0.5, 0.8), wheel=wheel, sign=sign, wheel_radius_m=0.1, steps_per_turn=4096, gear=2.0)
    bench.run(0.8)
    turns = {"left": 0.5, "right": 0.8}[wheel] * 1.0 / (2 * math.pi * 0.1) * 2.0
    expected = sign * math.floor(turns * 4096)
    assert bench.read(0x6004) == expected % FULL_RANGE


def test_wraps_downwards_and_upwards() -> None:
    backward = Bench(Rolling(-0.5))
    assert backward.read(0x6004) == FULL_RANGE - math.ceil(0.1 / (0.2 * math.pi) * 4096)
    forward = Bench(Rolling(0.5), start_count=FULL_RANGE - 10)
    assert forward.read(0x6004) == math.floor(0.1 / (0.2 * math.pi) * 4096) - 10


def test_preset_and_code_sequence_and_scaling() -> None:
    bench = Bench(Rolling(0.2 * math.pi))
    bench.run(0.8)
    assert bench.read(0x6004) == 4096
    bench.write(0x6003, 0, 1000, 4)
    assert bench.read(0x6004) == 1000
    bench.write(0x6000, 0, 5, 2)
    before = bench.read(0x6004)
    bench.run(1.0)
    assert (bench.read(0x6004) - before) % FULL_RANGE == FULL_RANGE - 4096
    bench.write(0x6000, 0, 4, 2)
    bench.write(0x6001, 0, 1000, 4)
    bench.write(0x6002, 0, 5000, 4)
    before = bench.read(0x6004)
    bench.run(6.0, 0.01)
    assert bench.read(0x6004) == (before + 6000) % 5000
    assert abort_code(bench.write(0x6003, 0, 5000, 4)) == 0x06090030


def test_speed_is_in_steps_a_second_and_saturates() -> None:
    assert Bench(Rolling(0.2 * math.pi)).read(0x6030, 1) == pytest.approx(4096, abs=100)
    backward = Bench(Rolling(-2.0 * math.pi)).read(0x6030, 1)
    assert backward - 0x10000 == -32768


def test_both_wheels_are_sampled_at_the_same_sync() -> None:
    scene = Rolling(0.3, 0.3)
    left, right = Bench(scene, 0x20, tpdo1_ms=0), Bench(scene, 0x21, wheel="right", tpdo1_ms=0)
    for bench in (left, right):
        bench.tell("000#0100")
        bench.run(0.0537)
    (one,), (other,) = left.tell("080#"), right.tell("080#")
    assert one.split("#")[1] == other.split("#")[1]


def test_position_on_change_only() -> None:
    still = Bench(tpdo1_ms=0)
    still.tell("000#0121")
    assert still.run(0.5) == []
    moving = Bench(Rolling(0.5), tpdo1_ms=0)
    moving.tell("000#0121")
    moving.write(0x1800, 3, 200, 2)  # 20 ms
    assert 22 <= len(moving.run(0.5)) <= 26


# -- PDOs -------------------------------------------------------------------------------------------------------------


def test_remapped_pdo_carries_position_speed_and_error() -> None:
    bench = Bench(Rolling(0.2 * math.pi), tpdo1_ms=0)
    assert abort_code(bench.write(0x1A01, 2, 0x60300110, 4)) == 0x08000022
    bench.write(0x1A01, 0, 0, 1)
    assert abort_code(bench.write(0x1A01, 1, 0x10080020, 4)) == 0x06040041
    bench.write(0x1A01, 1, 0x60040020, 4)
    bench.write(0x1A01, 2, 0x60300110, 4)
    bench.write(0x1A01, 3, 0x10010008, 4)
    assert abort_code(bench.write(0x1A01, 0, 4, 1)) == 0x06040041
    assert bench.write(0x1A01, 0, 3, 1).startswith("5A1#60")
    bench.tell("000#0121")
    (frame,) = bench.tell("080#")
    position, speed, error = struct.unpack("<IhB", bytes.fromhex(frame.split("#")[1]))
    assert position == bench.read(0x6004)
    assert speed == pytest.approx(4096, abs=100)
    assert error == 0


def test_too_long_mapping_is_refused() -> None:
    bench = Bench()
    bench.write(0x1A00, 0, 0, 1)
    for sub in (1, 2, 3):
        bench.write(0x1A00, sub, 0x60040020, 4)
    assert abort_code(bench.write(0x1A00, 0, 3, 1)) == 0x06040042


def test_every_third_sync_and_switched_off_pdo() -> None:
    bench = Bench(tpdo1_ms=0)
    bench.write(0x1801, 2, 3, 1)
    bench.write(0x1800, 1, 0x800001A1, 4)
    assert bench.tell("000#0121") == []
    assert [len(bench.tell("080#")) for _ in range(7)] == [0, 0, 1, 0, 0, 1, 0]
    assert abort_code(bench.write(0x1801, 2, 245, 1)) == 0x06090030


def test_remote_request_for_a_pdo() -> None:
    bench = Bench(tpdo1_ms=0, start_count=7)
    bench.tell("000#0121")
    assert [text(one) for one in bench.encoder.step(bench.now_ns, [Frame(0x2A1, remote=True)])] == ["2A1#07000000"]


def test_cyclic_timer_is_one_number_in_two_places() -> None:
    bench = Bench()
    bench.write(0x6200, 0, 50, 2)
    assert bench.read(0x1800, 5) == 50
    bench.write(0x1800, 5, 40, 2)
    assert bench.read(0x6200) == 40
    bench.tell("000#0121")
    assert len(bench.run(0.4)) == 10


# -- SDO against bad clients ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("621#2F17100064000000", 0x06070013),  # one byte where two belong
        ("621#2317100064000000", 0x06070012),  # four
        ("621#6000000000000000", 0x05040001),  # a segment of nothing
        ("621#0000000000000000", 0x05040001),
        ("621#A000100000000000", 0x05040001),  # block transfer
        ("621#E000100000000000", 0x05040001),
    ],
)
def test_refusals(request_: str, code: int) -> None:
    (answer,) = Bench().tell(request_)
    assert abort_code(answer) == code


def test_wrong_toggle_ends_the_transfer() -> None:
    bench = Bench()
    bench.tell("621#4008100000000000")
    (answer,) = bench.tell("621#7000000000000000")
    assert abort_code(answer) == 0x05030000
    assert answer.startswith("5A1#80081000")
    (answer,) = bench.tell("621#6000000000000000")
    assert abort_code(answer) == 0x05040001


def test_segmented_download_checks_its_length() -> None:
    bench = Bench()
    assert bench.tell("621#2117100002000000") == ["5A1#6017100000000000"]
    assert bench.tell("621#0BE8030000000000") == ["5A1#2000000000000000"]
    assert bench.read(0x1017) == 1000
    bench.tell("621#2117100004000000")
    (answer,) = bench.tell("621#0BE8030000000000")
    assert abort_code(answer) == 0x06070010


def test_client_abort_and_short_frames_are_not_answered() -> None:
    bench = Bench()
    bench.tell("621#4008100000000000")
    assert bench.tell("621#8008100000000405") == []
    assert bench.tell("621#40") == []


def test_emergency_and_error_history() -> None:
    bench = Bench()
    (frame,) = bench.encoder.raise_alarm(bench.now_ns, code=0x5000)
    assert text(frame) == "0A1#0050810000000000"
    assert bench.read(0x1003) == 1
    assert bench.read(0x1003, 1) == 0x5000
    assert bench.read(0x6503) == 1
    (frame,) = bench.encoder.raise_alarm(bench.now_ns, code=0)
    assert text(frame) == "0A1#0000000000000000"
    bench.write(0x1003, 0, 0, 1)
    assert bench.read(0x1003) == 0


@pytest.mark.parametrize("node", [0, 128])
def test_node_numbers(node: int) -> None:
    with pytest.raises(ValueError, match="1 to 127"):
        Cia406Encoder(Rolling(), node)


# -- the independent judge --------------------------------------------------------------------------------------------


@contextmanager
def on_virtual_bus(*encoders: Cia406Encoder) -> Iterator[canopen.Network]:
    """Encoders on a python-can virtual bus, in real time, and canopen's network on it."""
    channel = f"sim-encoder-{time.monotonic_ns()}"
    bus = can.Bus(interface="virtual", channel=channel)
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            message = bus.recv(0.001)
            heard = []
            if message is not None:
                heard = [Frame(message.arbitration_id, bytes(message.data), remote=message.is_remote_frame)]
            for encoder in encoders:
                for frame in encoder.step(time.monotonic_ns(), heard):
                    bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    thread = threading.Thread(target=serve)
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    booted = threading.Event()
    network.subscribe(0x700 + NODE, lambda *_: booted.set())
    thread.start()
    try:
        assert booted.wait(GIVE_UP_S)
        yield network
    finally:
        ended.set()
        thread.join()
        network.disconnect()
        bus.shutdown()


def remote_node(network: canopen.Network, dictionary: canopen.ObjectDictionary) -> Any:
    """canopen's view of the node; its library is only partly typed."""
    node: Any = network.add_node(canopen.RemoteNode(NODE, dictionary))
    node.sdo.RESPONSE_TIMEOUT = GIVE_UP_S
    return node


def test_canopen_configures_reads_and_hears_it() -> None:
    encoder = Cia406Encoder(Rolling(0.5), NODE, boot_s=0.0, name="A NAME LONGER THAN SEVEN BYTES")
    with on_virtual_bus(encoder) as network:
        node = remote_node(network, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]
        assert node.sdo.upload(0x1008, 0) == b"A NAME LONGER THAN SEVEN BYTES"
        assert struct.unpack("<I", node.sdo.upload(0x1000, 0))[0] & 0xFFFF == 406
        with pytest.raises(canopen.SdoAbortedError) as refused:
            node.sdo.download(0x6004, 0, bytes(4))
        assert refused.value.code == 0x06010002
        node.sdo.download(0x1017, 0, struct.pack("<H", 50))
        node.sdo.download(0x6200, 0, struct.pack("<H", 10), force_segment=True)
        heard: list[int] = []
        network.subscribe(0x180 + NODE, lambda _id, data, _stamp: heard.append(struct.unpack("<I", bytes(data))[0]))
        synced = threading.Event()
        network.subscribe(0x280 + NODE, lambda *_: synced.set())
        node.nmt.state = "OPERATIONAL"
        network.sync.transmit()
        assert synced.wait(GIVE_UP_S)
        node.nmt.wait_for_heartbeat(GIVE_UP_S)
        assert node.nmt.state == "OPERATIONAL"
        wait_for("ten positions", lambda: len(heard) >= 10)
        assert heard == sorted(heard)


def test_canopen_remaps_a_pdo() -> None:
    dictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for index, name, data_type in ((0x6004, "position", 0x07), (0x1001, "error", 0x05)):
        variable = canopen.objectdictionary.ODVariable(name, index, 0)
        variable.data_type = data_type
        variable.pdo_mappable = True
        dictionary.add_object(variable)
    for index in (0x1800, 0x1A00):
        record = canopen.objectdictionary.ODRecord(f"{index:04X}", index)
        for sub in range(6 if index == 0x1800 else 9):
            member = canopen.objectdictionary.ODVariable(str(sub), index, sub)
            member.data_type = 0x05 if sub == 0 or (sub == 2 and index == 0x1800) else 0x07
            if index == 0x1800 and sub in (3, 5):
                member.data_type = 0x06
            record.add_member(member)
        dictionary.add_object(record)
    encoder = Cia406Encoder(Rolling(), NODE, boot_s=0.0, start_count=4711)
    with on_virtual_bus(encoder) as network:
        node = remote_node(network, dictionary)
        node.tpdo.read()
        assert [variable.index for variable in node.tpdo[1].map] == [0x6004]
        node.tpdo[1].clear()
        node.tpdo[1].add_variable("error")
        node.tpdo[1].add_variable("position")
        node.tpdo[1].event_timer = 10
        node.tpdo[1].enabled = True
        node.tpdo.save()
        node.nmt.state = "OPERATIONAL"
        assert node.tpdo[1].wait_for_reception(GIVE_UP_S) is not None
        assert node.tpdo[1]["position"].raw == 4711
