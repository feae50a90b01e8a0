"""Ports on real ptys, TCP on loopback, and python-can buses that exist everywhere."""

from __future__ import annotations

import os
import socket
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.conversation import CanFrame
from drivers.errors import PortAbsent, PortBusy, PortDenied, PortError
from drivers.ports import CanPort, SerialPort, TcpPort, _opening_failed
from drivers.slcan_bus import LawicelBus, decode_line, encode_line
from tests.waiting import GIVE_UP_S, SteadyClock, free_port, seconds_of, wait_for, wait_for_input

CLOCK = time.monotonic_ns
OPENING = b"\r\r\rC\rS8\rO\r"


class Pty:
    """The device's end of a line: `path` is what the program opens."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def receive(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += os.read(self.master, count - len(data))
        return data

    def receive_until(self, end: bytes) -> bytes:
        """What comes, up to this: a pty may hand it on in pieces."""
        data = b""
        while not data.endswith(end):
            data += os.read(self.master, 4096)
        return data

    def unplug(self) -> None:
        for descriptor in (self.master, self.slave):
            with suppress(OSError):
                os.close(descriptor)


@pytest.fixture
def pty() -> Iterator[Pty]:
    line = Pty()
    yield line
    line.unplug()


def read_all(port: SerialPort | TcpPort, count: int) -> bytes:
    data = bytearray()

    def there() -> bool:
        data.extend(b"".join(chunk for chunk, _ in port.read(0.1)))
        return len(data) >= count

    wait_for(f"{count} bytes", there)
    return bytes(data)


def assert_soon_lost(read: Callable[[float], object]) -> None:
    """Within half a second, counted in reads of 20 ms: a machine that is held up reads less, and sees it as soon."""
    with pytest.raises(PortError, match=r"was lost|refuses every frame"):
        repeat(lambda: read(0.02), 25)


def repeat(action: Callable[[], object], times: int) -> None:
    for _ in range(times):
        action()


# ---- serial


def test_bytes_both_ways_with_their_arrival_time(pty: Pty) -> None:
    port = SerialPort(pty.path, clock=CLOCK)
    before = CLOCK()
    pty.send(b"\x00\x02BM\r\n\xff")
    wait_for_input(pty.slave, 7)
    [(chunk, stamp_ns)] = port.read(GIVE_UP_S)
    assert chunk == b"\x00\x02BM\r\n\xff", "raw: nothing translated, nothing echoed"
    assert before <= stamp_ns <= CLOCK()
    port.write(b"\x00\r\n\x03\xff")
    assert pty.receive(5) == b"\x00\r\n\x03\xff"
    port.close()


def test_a_read_returns_as_soon_as_bytes_are_there(pty: Pty) -> None:
    port = SerialPort(pty.path, clock=CLOCK)
    delays = []
    sent: list[int] = []

    def send() -> None:
        sent.append(CLOCK())
        pty.send(b"x")

    for _ in range(20):
        timer = threading.Timer(0.01, send)
        timer.start()
        [(_, stamp_ns)] = port.read(GIVE_UP_S)
        timer.join()
        delays.append(stamp_ns - sent[-1])
    # Who only looked now and then would be late by half of that on the average; a machine that is busy delays some.
    assert sorted(delays)[4] < 5_000_000
    port.close()


def test_waiting_costs_no_cpu(pty: Pty) -> None:
    port = SerialPort(pty.path, clock=CLOCK)
    before = time.thread_time()
    for _ in range(25):
        assert port.read(0.02) == []
    assert time.thread_time() - before < 0.1, "of half a second"
    port.close()


def test_line_speed_is_really_set(pty: Pty) -> None:
    port = SerialPort(pty.path, baud=19200, clock=CLOCK)
    assert termios.tcgetattr(pty.slave)[5] == termios.B19200
    port.set_baud(500000)
    assert termios.tcgetattr(pty.slave)[5] == termios.B500000
    port.set_baud(256000)  # not a standard rate
    port.close()


def test_unplugging_is_noticed_at_once(pty: Pty) -> None:
    port = SerialPort(pty.path, clock=CLOCK)
    assert port.read(0.02) == []
    pty.unplug()
    assert_soon_lost(port.read)
    with pytest.raises(PortError):
        port.write(b"x")
    port.close()


def test_last_bytes_before_unplugging_are_not_lost(pty: Pty) -> None:
    """Those that the kernel still has; a pty throws them away when its master closes, so they are read before."""
    port = SerialPort(pty.path, clock=CLOCK)
    pty.send(b"last words")
    assert read_all(port, 10) == b"last words"
    pty.unplug()
    assert_soon_lost(port.read)
    port.close()


def test_a_name_that_leads_elsewhere_is_noticed(pty: Pty, tmp_path: Path) -> None:
    """A device that comes back as another node: the old line stays silent for ever."""
    link = tmp_path / "laser"
    link.symlink_to(pty.path)
    port = SerialPort(str(link), clock=CLOCK)
    other = Pty()
    try:
        assert port.read(0.25) == []
        link.unlink()
        link.symlink_to(other.path)
        assert_soon_lost(port.read)
        link.unlink()
    finally:
        port.close()
        other.unplug()


def test_a_name_that_is_gone_is_noticed(pty: Pty, tmp_path: Path) -> None:
    link = tmp_path / "laser"
    link.symlink_to(pty.path)
    port = SerialPort(str(link), clock=CLOCK)
    link.unlink()
    assert_soon_lost(port.read)
    port.close()


def test_absent_port_names_the_repair() -> None:
    with pytest.raises(PortAbsent, match=r"no /dev/ttyNOWHERE7: is the device plugged in.*umfeld devices list"):
        SerialPort("/dev/ttyNOWHERE7", clock=CLOCK)


def test_second_program_is_told_who_to_stop(pty: Pty) -> None:
    first = SerialPort(pty.path, clock=CLOCK)
    with pytest.raises(PortBusy, match=r"another program holds .*fuser"):
        SerialPort(pty.path, clock=CLOCK)
    first.close()
    SerialPort(pty.path, clock=CLOCK).close()


def test_denied_port_names_its_group(tmp_path: Path) -> None:
    """As root everything may be opened, so the error itself is handed in."""
    node = tmp_path / "ttyACM0"
    node.touch()
    error = _opening_failed(str(node), PermissionError(13, "Permission denied"))
    assert isinstance(error, PortDenied)
    assert "sudo usermod -aG" in str(error)
    assert "udev rules" in str(error)
    gone = _opening_failed("/dev/ttyACM99", PermissionError(13, "Permission denied"))
    assert "group dialout" in str(gone)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_not_a_serial_port(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "thing"
    path.touch() if kind == "file" else path.mkdir()
    with pytest.raises(PortError, match=r"not a serial port|cannot be opened"):
        SerialPort(str(path), clock=CLOCK)


def test_a_line_that_takes_nothing_fails_in_time(pty: Pty) -> None:
    port = SerialPort(pty.path, clock=CLOCK, write_timeout_s=0.1)
    with SteadyClock() as clock:
        began_ns = clock()
        with pytest.raises(PortError, match="takes no bytes"):
            repeat(lambda: port.write(bytes(4096)), 100)
        assert clock() - began_ns < 2_000_000_000
        assert seconds_of(clock, port.close) < 1.0


# ---- TCP


@pytest.fixture
def server() -> Iterator[socket.socket]:
    listener = socket.create_server(("127.0.0.1", 0))
    yield listener
    listener.close()


def test_tcp_both_ways_and_closed_by_the_device(server: socket.socket) -> None:
    port = TcpPort("127.0.0.1", server.getsockname()[1], clock=CLOCK)
    peer, _ = server.accept()
    peer.sendall(b"hello")
    assert read_all(port, 5) == b"hello"
    port.write(b"VV\n")
    assert peer.recv(10) == b"VV\n"
    assert port.read(0.01) == []
    peer.close()
    with pytest.raises(PortAbsent, match="closed by the device"):
        port.read(1.0)
    port.close()


def test_tcp_that_nobody_answers() -> None:
    number = free_port()
    with pytest.raises(PortAbsent, match=f"tcp://127.0.0.1:{number}.*ping"):
        TcpPort("127.0.0.1", number, clock=CLOCK)


def test_tcp_peer_that_reads_nothing(server: socket.socket) -> None:
    port = TcpPort("127.0.0.1", server.getsockname()[1], clock=CLOCK, write_timeout_s=0.1)
    peer, _ = server.accept()
    with pytest.raises(PortError):
        repeat(lambda: port.write(bytes(65536)), 1000)
    peer.close()
    port.close()


# ---- slcan


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"t1233010203", CanFrame(0x123, b"\1\2\3")),
        (b"t7FF0", CanFrame(0x7FF)),
        (b"T1ABCDEF080001020304050607", CanFrame(0x1ABCDEF0, bytes(range(8)), extended=True)),
        (b"r3214", CanFrame(0x321, remote=True, dlc=4)),
        (b"R000003212", CanFrame(0x321, extended=True, remote=True, dlc=2)),
    ],
)
def test_lines_both_ways(line: bytes, frame: CanFrame) -> None:
    assert decode_line(line) == frame
    assert decode_line(line + b"EA5F") == frame, "with the adapter's time stamp"
    dlc = frame.dlc if frame.dlc is not None else len(frame.data)
    assert encode_line(frame.can_id, frame.data, frame.extended, frame.remote, dlc) == line + b"\r"


@pytest.mark.parametrize(
    "line",
    [b"t", b"t12", b"t1239", b"t123201", b"t12320102 ", b"t1232010G", b"t8001FF", b"T200000000", b"t+121FF", b"x1230",
     b"t1_2101", b"t12310", b"r32141", b"V1013", b"t123101020", "t123\u0661".encode()],
)  # fmt: skip
def test_damaged_lines_are_no_frames(line: bytes) -> None:
    assert decode_line(line) is None


def read_frames(port: CanPort, count: int) -> list[CanFrame]:
    frames: list[CanFrame] = []

    def there() -> bool:
        frames.extend(frame for frame, _ in port.read(0.1))
        return len(frames) >= count

    wait_for(f"{count} frames", there)
    return frames


def test_slcan_opens_the_adapter_from_any_state_and_closes_it(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    assert pty.receive(len(OPENING)) == OPENING
    port.write(CanFrame(0x601, b"\x40\x00\x10\x00"))
    assert pty.receive(14) == b"t601440001000\r"
    port.close()
    assert pty.receive(2) == b"C\r"


def test_slcan_bitrates(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path + "@57600", bitrate_bps=250_000, clock=CLOCK)
    assert b"S5\r" in pty.receive(len(OPENING))
    port.close()
    with pytest.raises(PortError, match="300000 bit/s: choose one of"):
        CanPort(interface="slcan", channel=pty.path, bitrate_bps=300_000, clock=CLOCK)


def test_slcan_frames_in_any_pieces(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    stream = b"0203\r\rz\rt2A1401020304\r\aT0000012320A0B\rV1013\rt2A1zz\rr1230\r"
    frames: list[CanFrame] = []
    for byte in stream:
        pty.send(bytes((byte,)))
        wait_for_input(pty.slave, 1)
        frames += [frame for frame, _ in port.read(0.0)]
    expected = [
        CanFrame(0x2A1, b"\1\2\3\4"),
        CanFrame(0x123, b"\x0a\x0b", extended=True),
        CanFrame(0x123, remote=True, dlc=0),
    ]
    assert frames == expected
    assert port.drops == {"slcan_malformed": 2, "slcan_refused": 1}
    pty.send(stream)
    assert read_frames(port, 3) == expected
    port.close()


def test_slcan_burst_keeps_all_and_their_order(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    numbers = iter(range(1000))
    sender = threading.Thread(target=repeat, args=(lambda: pty.send(b"t%03X20102\r" % next(numbers)), 1000))
    sender.start()
    assert [frame.can_id for frame in read_frames(port, 1000)] == list(range(1000))
    sender.join()
    port.close()


def test_slcan_frames_carry_the_time_at_which_their_bytes_came(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    before_ns = CLOCK()
    pty.send(b"t1230\r" * 300)
    wait_for_input(pty.slave, 1800)
    read = port.read(GIVE_UP_S)
    later = port.read(0.0)  # what one read may not hand out at once is there without another byte
    while len(read) + len(later) < 300:
        later += port.read(GIVE_UP_S)
    stamps = [stamp_ns for _, stamp_ns in read + later]
    assert len(read) == 256
    assert stamps == sorted(stamps)
    assert before_ns <= stamps[0] <= stamps[-1] <= CLOCK()
    port.close()


def test_slcan_serves_other_users_of_the_bus(pty: Pty) -> None:
    bus = LawicelBus(pty.path, bitrate_bps=1_000_000, clock=CLOCK)
    pty.send(b"t1232AABB\r")
    wait_for_input(pty.slave, 10)
    message = bus.recv(GIVE_UP_S)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x123, b"\xaa\xbb")
    assert 0.0 < message.timestamp <= CLOCK() / 1e9
    assert bus.recv(0.0) is None
    bus.shutdown()


class ScriptedLine:
    """A line that hands out one chunk a read, each after so many milliseconds of a clock of its own."""

    name = "scripted"
    silence_reopen_s = None

    def __init__(self, chunks: list[tuple[int, bytes]]) -> None:
        self.chunks = chunks
        self.now_ns = 0
        self.waits_s: list[float] = []
        self.written = b""
        self.drops: dict[str, int] = {}

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        self.waits_s.append(timeout_s)
        if not self.chunks or self.chunks[0][0] * 1_000_000 > timeout_s * 1e9:
            self.now_ns += round(timeout_s * 1e9)
            return []
        after_ms, chunk = self.chunks.pop(0)
        self.now_ns += after_ms * 1_000_000
        return [(chunk, self.now_ns)]

    def write(self, item: bytes) -> None:
        self.written += item

    def set_baud(self, bits_per_s: int) -> None: ...

    def discard_input(self) -> None: ...

    def close(self) -> None: ...

    def fileno(self) -> int | None:
        return None


def test_slcan_answers_and_halves_of_lines_do_not_end_the_wait() -> None:
    line = ScriptedLine([(1, b"z\r"), (2, b"t123"), (3, b"0\rt1240\r")])
    bus = LawicelBus("nowhere", bitrate_bps=1_000_000, clock=lambda: line.now_ns, line=line)
    assert bus.frames(0.020, 10) == [(CanFrame(0x123), 6_000_000), (CanFrame(0x124), 6_000_000)]
    assert line.waits_s == pytest.approx([0.020, 0.019, 0.017])
    line.chunks = [(1, b"z\r"), (100, b"t1230\r")]
    assert bus.frames(0.020, 10) == []
    assert line.now_ns == 26_000_000  # not a moment longer than asked for
    bus.shutdown()


def test_slcan_noise_that_never_ends_gives_the_reader_its_turn() -> None:
    line = ScriptedLine([(0, b"?\r")] * 100)
    bus = LawicelBus("nowhere", bitrate_bps=1_000_000, clock=lambda: line.now_ns, line=line)
    assert bus.frames(0.020, 10) == []
    assert len(line.chunks) > 90
    bus.shutdown()


def test_slcan_sends_our_frames_as_it_sends_messages() -> None:
    line = ScriptedLine([])
    bus = LawicelBus("nowhere", bitrate_bps=1_000_000, clock=lambda: line.now_ns, line=line)
    frames = [
        CanFrame(0x080),
        CanFrame(0x601, bytes(range(8))),
        CanFrame(0x1ABCDEF0, b"\xab", extended=True),
        CanFrame(0x321, remote=True, dlc=4),
    ]
    line.written = b""
    for frame in frames:
        bus.put(frame)
    ours, line.written = line.written, b""
    for frame in frames:
        bus.send(
            can.Message(
                arbitration_id=frame.can_id, data=None if frame.remote else frame.data, is_extended_id=frame.extended,
                is_remote_frame=frame.remote, dlc=frame.dlc if frame.dlc is not None else len(frame.data),
            )
        )  # fmt: skip
    assert ours == line.written == b"t0800\rt60180001020304050607\rT1ABCDEF01AB\rr3214\r"
    bus.shutdown()


def test_slcan_endless_line_needs_no_memory(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    for _ in range(10):
        pty.send(b"t" * 1000)
        wait_for_input(pty.slave, 1000)
        port.read(0.05)
    assert port.drops["slcan_malformed"] > 0
    pty.send(b"\rt1230\r")
    assert read_frames(port, 1) == [CanFrame(0x123)]
    port.close()


def test_slcan_adapter_that_refuses_everything_is_reopened(pty: Pty) -> None:
    """It was without power for a moment: still there, but closed."""
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    pty.send(b"\a" * 7)
    assert port.read(0.1) == []
    pty.send(b"\rt1230\r\a")
    assert len(read_frames(port, 1)) == 1, "a frame between them: it is alive"
    pty.send(b"\a" * 8)
    assert_soon_lost(port.read)
    port.close()


def test_slcan_refusal_to_close_what_was_not_open_is_no_drop(pty: Pty) -> None:
    """The answers of the emulated adapter to the opening sequence, frames it has queued right behind."""
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    pty.send(b"\r\r\r\a\r\rz\rt1230\r")
    assert len(read_frames(port, 1)) == 1
    assert port.drops == {}
    pty.send(b"\at1230\r")
    assert len(read_frames(port, 1)) == 1
    assert port.drops == {"slcan_refused": 1}
    port.close()


def test_slcan_unplugged_is_noticed_in_time(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    assert port.read(0.02) == []
    pty.unplug()
    assert_soon_lost(port.read)
    port.close()


def test_slcan_replugged_gets_the_whole_opening_sequence(pty: Pty, tmp_path: Path) -> None:
    link = tmp_path / "can"
    link.symlink_to(pty.path)
    first = CanPort(interface="slcan", channel=str(link), clock=CLOCK)
    pty.receive(len(OPENING))
    pty.unplug()
    assert_soon_lost(first.read)
    first.close()
    link.unlink()
    with pytest.raises(PortAbsent):
        CanPort(interface="slcan", channel=str(link), clock=CLOCK)
    again = Pty()
    link.symlink_to(again.path)
    second = CanPort(interface="slcan", channel=str(link), clock=CLOCK)
    assert again.receive(len(OPENING)) == OPENING
    second.close()
    again.unplug()


def test_slcan_understands_python_cans_own_client_and_the_other_way() -> None:
    """Both ends of a wire: our bus here, python-can's slcan there, a relay between."""
    ours, theirs = Pty(), Pty()
    bus = LawicelBus(ours.path, bitrate_bps=1_000_000, clock=CLOCK)
    other = can.Bus(interface="slcan", channel=theirs.path, bitrate=1_000_000, sleep_after_open=0, ignore_config=True)
    try:
        ours.receive(len(OPENING))
        sent = [
            can.Message(arbitration_id=0x123, data=b"\1\2", is_extended_id=False),
            can.Message(arbitration_id=0x1ABCDEF0, data=bytes(range(8))),
            can.Message(arbitration_id=0x321, is_remote_frame=True, dlc=4, is_extended_id=False),
        ]
        for message in sent:
            line = encode_line(
                message.arbitration_id,
                bytes(message.data),
                message.is_extended_id,
                message.is_remote_frame,
                message.dlc,
            )
            other.send(message)
            theirs.receive_until(line)  # behind what it says to open the first time
            ours.send(line)
            assert _same(bus.recv(GIVE_UP_S), message)
            bus.send(message)
            assert ours.receive_until(line) == line
            theirs.send(line)
            assert _same(other.recv(GIVE_UP_S), message)
    finally:
        bus.shutdown()
        other.shutdown()
        ours.unplug()
        theirs.unplug()


def _same(got: can.Message | None, sent: can.Message) -> bool:
    return got is not None and got.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)


# ---- python-can's other buses


def test_a_batch_left_over_is_read_without_waiting(pty: Pty) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    pty.send(b"t1230\r" * 600)
    wait_for_input(pty.slave, 3600)
    sizes: list[int] = []
    started = time.monotonic()
    while sum(sizes) < 600:
        sizes.append(len(port.read(GIVE_UP_S)))
    assert time.monotonic() - started < GIVE_UP_S, "nothing more comes: who waited would do so for all of it"
    assert max(sizes) == 256
    port.close()


def test_a_wall_clock_set_back_does_not_stop_a_read(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    port = CanPort(interface="slcan", channel=pty.path, clock=CLOCK)
    hours = iter(range(1_000_000, 0, -3600))
    monkeypatch.setattr(can.bus, "time", lambda: float(next(hours)))
    started = time.monotonic()
    assert port.read(0.05) == []
    assert time.monotonic() - started < GIVE_UP_S, "not until the hour has passed"
    port.close()


def test_virtual_bus_both_ways() -> None:
    one, two = (CanPort(interface="virtual", channel="ports-test", clock=CLOCK) for _ in range(2))
    frames = [CanFrame(0x80), CanFrame(0x1ABCDEF0, b"\1", extended=True), CanFrame(0x12, remote=True, dlc=3)]
    for frame in frames:
        one.write(frame)
    assert read_frames(two, 3) == frames
    assert one.read(0.01) == [], "nobody hears himself"
    one.close()
    two.close()


def test_socketcan_that_is_not_there_names_the_repair() -> None:
    with pytest.raises(PortError, match=r"ip link set canX9 up type can bitrate 500000"):
        CanPort(channel="canX9", bitrate_bps=500_000, clock=CLOCK)


class FakeBus:
    """Stands for a SocketCAN interface, which this machine may not have."""

    def __init__(self) -> None:
        self.messages: list[can.Message] = []
        self.recv_error: Exception | None = None
        self.send_error: Exception | None = None

    def recv(self, timeout: float) -> can.Message | None:
        if self.recv_error is not None:
            raise self.recv_error
        return self.messages.pop(0) if self.messages else None

    def send(self, message: can.Message, timeout: float) -> None:
        if self.send_error is not None:
            raise self.send_error

    def fileno(self) -> int:
        raise NotImplementedError  # as python-can's buses do that have none

    def shutdown(self) -> None:
        raise OSError("already gone")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    bus = FakeBus()

    def open_bus(**options: Any) -> FakeBus:
        assert options["interface"] == "socketcan"
        assert "bitrate" not in options, "SocketCAN's is set by `ip link`"
        return bus

    monkeypatch.setattr(can, "Bus", open_bus)
    return bus


def error_frame(bits: int) -> can.Message:
    return can.Message(arbitration_id=bits, is_error_frame=True, data=bytes(8))


def test_bus_off_gives_the_port_up(fake: FakeBus) -> None:
    port = CanPort(channel="can0", clock=CLOCK)
    fake.messages = [error_frame(0x04), can.Message(arbitration_id=5, is_extended_id=False)]
    assert [frame for frame, _ in port.read(0.0)] == [CanFrame(5)]
    assert port.drops == {"bus_error": 1}
    fake.messages = [error_frame(0x40)]
    with pytest.raises(PortError, match=r"bus-off.*termination.*restart-ms"):
        port.read(0.0)
    port.close()


def test_interface_going_down_gives_the_port_up(fake: FakeBus) -> None:
    port = CanPort(channel="can0", clock=CLOCK)
    fake.recv_error = can.CanOperationError("Network is down", 100)
    with pytest.raises(PortError, match="ip link set can0 up"):
        port.read(0.0)
    fake.send_error = OSError(100, "Network is down")
    with pytest.raises(PortError):
        port.write(CanFrame(0x80))
    port.close()


def test_a_full_transmit_queue_loses_frames_but_not_the_port(fake: FakeBus) -> None:
    port = CanPort(channel="can0", clock=CLOCK)
    fake.send_error = can.CanOperationError("Failed to transmit: No buffer space available", 105)
    port.write(CanFrame(0x80))
    port.write(CanFrame(0x80))
    assert port.drops == {"tx_full": 2}
    port.close()


def test_fd_frames_are_counted_and_left_out(fake: FakeBus) -> None:
    port = CanPort(channel="can0", clock=CLOCK)
    fake.messages = [can.Message(arbitration_id=5, is_fd=True, data=bytes(12)), can.Message(arbitration_id=6)]
    assert [frame.can_id for frame, _ in port.read(0.0)] == [6]
    assert port.drops == {"fd_frame": 1}


def test_a_flood_leaves_the_asking_its_turn(fake: FakeBus) -> None:
    port = CanPort(channel="can0", clock=CLOCK)
    fake.messages = [can.Message(arbitration_id=5) for _ in range(1000)]
    assert len(port.read(0.0)) == 256
