"""The emulated CAN bus: Lawicel's rules, and who hears what."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from sim_devices.attach import MemoryLink
from sim_devices.device import Frame
from sim_devices.slcan_hub import CanBus, CanBusStation, parsed_frame

MS = 1_000_000


class Echo:
    """A node that answers every frame under the id one higher, up to a limit."""

    def __init__(self, top_id: int = 0x7FF) -> None:
        self.heard: list[Frame] = []
        self.top_id = top_id

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        self.heard += received
        return [Frame(frame.can_id + 1, frame.data) for frame in received if frame.can_id < self.top_id]


class Bench:
    """Hosts with their serial ports on one bus."""

    def __init__(self, *names: str, paced: bool = False, bitrate_bps: int = 1_000_000) -> None:
        self.bus = CanBus(bitrate_bps=bitrate_bps, paced=paced)
        self.station = CanBusStation(self.bus)
        self.links = {name: MemoryLink() for name in names or ("a", "b")}
        self.adapters = {name: self.station.add_member(name, link) for name, link in self.links.items()}
        self.now_ns = 0

    def tell(self, name: str, data: bytes, wait_ms: float = 1) -> bytes:
        self.links[name].host_write(data)
        return self.hear(name, wait_ms)

    def hear(self, name: str, wait_ms: float = 1) -> bytes:
        self.now_ns += round(wait_ms * MS)
        self.station.service(self.now_ns)
        return self.links[name].host_read()

    def open_all(self) -> None:
        for name in self.links:
            assert self.tell(name, b"S8\rO\r") == b"\r\r"


def test_commands_and_their_replies() -> None:
    bench = Bench("a")
    for command, reply in [
        (b"", b"\r"), (b"V", b"V1013\r"), (b"N", b"NA123\r"), (b"F", b"\x07"), (b"C", b"\x07"), (b"S9", b"\x07"),
        (b"S", b"\x07"), (b"Sx", b"\x07"), (b"S6", b"\r"), (b"S8", b"\r"), (b"s031C", b"\r"), (b"s03", b"\x07"),
        (b"S8", b"\r"), (b"t1230", b"\x07"), (b"O", b"\r"), (b"O", b"\x07"), (b"L", b"\x07"), (b"S6", b"\x07"),
        (b"s031C", b"\x07"), (b"F", b"F00\r"), (b"t1233010203", b"z\r"), (b"T1ABCDEF080001020304050607", b"Z\r"),
        (b"r3214", b"z\r"), (b"R1ABCDEF08", b"Z\r"), (b"Z1", b"\r"), (b"Z0", b"\r"), (b"Z2", b"\x07"), (b"q", b"\x07"),
        (b"V", b"V1013\r"), (b"C", b"\r"), (b"C", b"\x07"), (b"L", b"\r"), (b"t1230", b"\x07"), (b"C", b"\r"),
    ]:  # fmt: skip
        assert bench.tell("a", command + b"\r") == reply, command


@pytest.mark.parametrize(
    "line",
    [b"t", b"t12", b"t123", b"t8000", b"t1239", b"t12310", b"t123101020", b"t1232010", b"t123Z", b"tXYZ0", b"t1231GG",
     b"T1234", b"T200000000", b"T1FFFFFFF9", b"r1239", b"r123200", b"t 1230", b"t123001"],
)  # fmt: skip
def test_malformed_frames_are_refused(line: bytes) -> None:
    bench = Bench("a", "b")
    bench.open_all()
    assert bench.tell("a", line + b"\r") == b"\x07"
    assert bench.hear("b") == b""
    assert parsed_frame(line[:1], line[1:]) is None


def test_lower_case_digits_are_understood_and_upper_case_sent() -> None:
    bench = Bench()
    bench.open_all()
    bench.tell("a", b"t7ab2c0ff\r")
    assert bench.hear("b") == b"t7AB2C0FF\r"


def test_frames_reach_all_but_the_sender() -> None:
    bench = Bench("a", "b", "c")
    bench.open_all()
    node = Echo(0x124)
    bench.bus.add_node("node", node)
    assert bench.tell("a", b"t1231AA\r") == b"z\rt1241AA\r"
    assert bench.hear("b") == b"t1231AA\rt1241AA\r"
    assert bench.hear("c") == b"t1231AA\rt1241AA\r"
    assert [frame.can_id for frame in node.heard] == [0x123]


@pytest.mark.parametrize("line", [b"t1233010203", b"T1ABCDEF080001020304050607", b"r3214", b"R000000018", b"t0000"])
def test_all_forms_pass_unchanged(line: bytes) -> None:
    bench = Bench()
    bench.open_all()
    bench.tell("a", line + b"\r")
    assert bench.hear("b") == line + b"\r"


def test_time_stamps_wrap_every_minute() -> None:
    bench = Bench()
    bench.open_all()
    bench.tell("b", b"Z1\r")
    bench.now_ns = 60_000 * MS - 1 * MS
    bench.tell("a", b"t1230\r")
    assert bench.hear("b") == b"t12300000\r"
    bench.now_ns = 119_000 * MS
    bench.tell("a", b"t1230\r", 0)
    assert bench.hear("b", 0) == b"t1230E678\r"


def test_closed_and_listening_adapters() -> None:
    bench = Bench("a", "b", "c")
    bench.tell("a", b"O\r")
    bench.tell("b", b"L\r")
    bench.tell("a", b"t1230\r")
    assert bench.hear("b") == b"t1230\r"
    assert bench.hear("c") == b""
    assert bench.tell("b", b"t1230\r") == b"\x07"


def test_wrong_bitrate_neither_sends_nor_hears_and_says_so() -> None:
    bench = Bench()
    bench.tell("a", b"S6\rO\r")
    bench.tell("b", b"S8\rO\r")
    assert bench.tell("a", b"t1230\r") == b"z\r"
    assert bench.hear("b") == b""
    bench.tell("b", b"t4560\r")
    assert bench.hear("a") == b""
    assert bench.tell("a", b"F\r") == b"FA4\r"
    assert bench.tell("a", b"F\r") == b"F00\r"
    assert bench.adapters["a"].counters.lost_to_bitrate == 1


def test_bus_off_lasts_until_reopened() -> None:
    bench = Bench()
    bench.open_all()
    bench.adapters["a"].bus_off = True
    assert bench.tell("a", b"t1230\r") == b"\x07"
    bench.tell("b", b"t1230\r")
    assert bench.hear("a") == b""
    assert bench.tell("a", b"F\r") == b"FA0\r"
    assert bench.tell("a", b"C\rO\r") == b"\r\r"
    assert bench.tell("a", b"t1230\r") == b"z\r"


def test_commands_in_any_pieces() -> None:
    bench = Bench()
    bench.open_all()
    replies = b"".join(bench.tell("a", bytes((byte,))) for byte in b"\nt1232AABB\r\rV\r")
    assert replies == b"z\r\rV1013\r"
    assert bench.hear("b") == b"t1232AABB\r"


def test_endless_line_is_refused_once_and_forgotten() -> None:
    bench = Bench("a")
    assert bench.tell("a", b"t" * 33) == b"\x07"
    assert bench.tell("a", b"V\r") == b"V1013\r"


class Narrow(MemoryLink):
    """A link that takes `room` bytes more."""

    room = 25

    def write(self, data: bytes) -> int:
        taken = super().write(data[: self.room])
        self.room -= taken
        return taken


def test_a_host_that_is_busy_for_a_moment_loses_nothing() -> None:
    bench = Bench("a")
    narrow = Narrow()
    adapter = bench.station.add_member("narrow", narrow)
    adapter.step(0, b"O\r")
    for number in range(10):
        bench.bus.send(None, Frame(0x100 + number, b"\x11"))
        bench.hear("a")
    bench.now_ns += 200 * MS
    narrow.room = 1000
    bench.hear("a")
    assert narrow.host_read() == b"".join(b"t%03X111\r" % (0x100 + number) for number in range(10))
    assert adapter.counters.dropped_lines == 0


def test_full_queue_loses_whole_lines_and_counts_them() -> None:
    bench = Bench("a")
    narrow = Narrow()
    adapter = bench.station.add_member("narrow", narrow)
    adapter.step(0, b"O\r")
    narrow.room = 25
    for number in range(10):
        bench.bus.send(None, Frame(0x100 + number, b"\x11"))
    bench.hear("a")
    bench.now_ns += 300 * MS  # nobody reads
    bench.hear("a")
    narrow.room = 1000
    bench.bus.send(None, Frame(0x200, b"\x22"))
    bench.hear("a")
    lines = narrow.host_read().split(b"\r")
    assert lines == [b"t100111", b"t101111", b"t102111", b"t103111", b"t200122", b""]
    assert adapter.counters.dropped_lines == 6
    adapter.step(0, b"F\r")


def test_unplugged_adapter_comes_back_closed() -> None:
    bench = Bench()
    bench.open_all()
    bench.station.plug(False, "b")
    bench.now_ns += MS
    bench.station.service(bench.now_ns)
    assert not bench.links["b"].is_open
    bench.tell("a", b"t1230\r")
    bench.station.plug(True, "b")
    assert bench.hear("b") == b""
    assert bench.tell("b", b"F\r") == b"\x07"
    assert bench.tell("b", b"O\r") == b"\r"


def test_answers_to_answers_end() -> None:
    bench = Bench("a")
    bench.open_all()
    bench.bus.add_node("one", Echo())
    bench.bus.add_node("two", Echo())
    assert bench.tell("a", b"t0000\r").startswith(b"z\r")  # two nodes that answer each other for ever


def test_paced_bus_takes_time_and_lets_the_lowest_id_first() -> None:
    bench = Bench(paced=True, bitrate_bps=125_000)
    assert bench.tell("a", b"S4\rO\r") == bench.tell("b", b"S4\rO\r") == b"\r\r"
    bench.tell("a", b"t30080000000000000000\rt1000\rt2000\r", 0)
    assert bench.hear("b", 0) == b""
    first_ns = bench.bus.next_ns
    assert first_ns is not None
    assert 350e3 < first_ns - bench.now_ns < 450e3  # 47 bits and stuffing at 125 kbit/s
    assert bench.hear("b", 0.5) == b"t1000\r"
    assert bench.hear("b", 0.5) == b"t2000\r"
    assert bench.hear("b", 2.0) == b"t30080000000000000000\r"
