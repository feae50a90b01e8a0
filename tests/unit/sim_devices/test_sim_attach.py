"""Links and the loop that serves devices on them."""

from __future__ import annotations

import os
import select
import socket
import stat
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from sim_devices.attach import Attachment, DeviceStation, MemoryLink, TcpLink
from sim_devices.pty_link import PtyLink
from tests.waiting import GIVE_UP_S, SteadyClock, wait_for, wait_for_input


class Upper:
    """A device that answers in capitals and notes the line speeds it is told."""

    def __init__(self) -> None:
        self.bauds: list[int | None] = []
        self.lost = 0
        self.next_ns: int | None = None
        self.plugged = True

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        self.bauds.append(baud)
        return received.upper()

    def link_lost(self, now_ns: int) -> None:
        self.lost += 1


# -- ptys -------------------------------------------------------------------------------------------------------------


def test_pty_is_raw_and_published_by_its_name(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "folder" / "laser")
    assert (tmp_path / "folder" / "laser").is_symlink()
    with serial.Serial(str(link.path), 57600, timeout=GIVE_UP_S) as host:
        link.write(b"\x00\r\n\x03\x11\x13\xff")
        assert host.read(7) == b"\x00\r\n\x03\x11\x13\xff"
        host.write(b"\r\x04")
        wait_for("both bytes", lambda: link.read() and link.counters.received_bytes == 2)
    assert link.read() == b""  # nothing echoed
    link.close()
    assert not os.path.lexists(link.path)


@pytest.mark.parametrize("baud", [9600, 19200, 115200, 250000, 500000, 750000])
def test_line_speed_of_the_host_is_seen(tmp_path: Path, baud: int) -> None:
    link = PtyLink(tmp_path / "p")
    with serial.Serial(str(link.path), baud):
        assert link.baud == baud
    link.close()
    assert link.baud is None


def test_full_queue_drops_and_counts(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "p")
    host = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    sent = sum(link.write(bytes(1000)) for _ in range(60))
    assert sent == link.counters.sent_bytes
    assert 0 < sent < 60_000
    assert link.counters.dropped_bytes == 60_000 - sent
    os.close(host)
    link.close()


def test_a_port_that_nobody_has_open_hears_nothing(tmp_path: Path) -> None:
    """As a serial port: its next host finds neither what was said to nobody nor what the last one left unread."""
    link = PtyLink(tmp_path / "p")
    assert link.write(b"good morning") == 12
    assert link.counters.unheard_bytes == 12
    first = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    another = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    os.close(another)
    link.write(b"left unread")
    wait_for_input(first, len(b"left unread"))
    os.close(first)
    with serial.Serial(str(link.path), timeout=GIVE_UP_S) as host:  # before the device says anything again
        link.read()
        link.write(b"heard")
        assert host.read(5) == b"heard"
    link.write(b"to nobody")
    assert link.counters.unheard_bytes == 21
    assert link.counters.sent_bytes == 16
    fresh = os.open(link.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    assert select.select([fresh], [], [], 0)[0] == []
    os.close(fresh)
    link.close()


class Talker:
    """A device that sends 1000 numbered bytes at each step while it is told to."""

    def __init__(self) -> None:
        self.talks = True
        self.sent = bytearray()
        self.next_ns: int | None = None

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        out = bytes(i % 251 for i in range(len(self.sent), len(self.sent) + 1000)) if self.talks else b""
        self.sent += out
        return out


def test_a_host_that_is_busy_for_a_moment_loses_nothing(tmp_path: Path) -> None:
    """What a kernel holds for a real port is more than a pty takes."""
    device, link, loop = Talker(), PtyLink(tmp_path / "p"), Attachment()
    loop.add("talker", device, link)
    with serial.Serial(str(link.path), 115200, timeout=0) as host:
        for step in range(40):
            loop.service(step * 5_000_000)
        device.talks = False
        heard = bytearray()
        for step in range(40, 100):
            loop.service(step * 5_000_000)
            while len(heard) < link.counters.sent_bytes:
                wait_for_input(host.fileno(), 1)  # a pty hands bytes on in its own time
                heard += host.read(65536)
        assert heard == device.sent
        assert link.counters.dropped_bytes == 0
    loop.stop()


def test_what_nobody_reads_is_lost(tmp_path: Path) -> None:
    device, link, loop = Talker(), PtyLink(tmp_path / "p"), Attachment()
    loop.add("talker", device, link)
    host = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
    for step in range(100):
        loop.service(step * 5_000_000)
    device.talks = False
    for step in range(100, 400):  # a busy kernel takes some late: what waits is given up 0.25 s after the last of it
        loop.service(step * 5_000_000)
    assert link.counters.sent_bytes + link.counters.dropped_bytes == len(device.sent)
    assert link.counters.dropped_bytes > 50_000
    os.close(host)
    loop.stop()


def test_replug_is_a_new_terminal_under_the_old_name(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "p")
    host = serial.Serial(str(link.path), timeout=GIVE_UP_S)
    link.close()
    with pytest.raises((serial.SerialException, OSError)):
        host.read(1)
    with pytest.raises(serial.SerialException):
        serial.Serial(str(link.path))
    link.open()
    link.open()
    with serial.Serial(str(link.path), timeout=GIVE_UP_S) as again:
        link.write(b"back")
        assert again.read(4) == b"back"
    host.close()
    link.close()
    link.close()


def test_stale_link_is_replaced_and_a_foreign_file_is_not(tmp_path: Path) -> None:
    (tmp_path / "stale").symlink_to("/dev/pts/nowhere")
    PtyLink(tmp_path / "stale").close()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FileExistsError, match="choose another folder"):
        PtyLink(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_closing_leaves_a_name_that_another_took_over(tmp_path: Path) -> None:
    first = PtyLink(tmp_path / "p")
    second = PtyLink(tmp_path / "p")
    first.close()
    assert os.readlink(tmp_path / "p") == second.tty
    second.close()


def test_busy_and_forbidden_ports(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "p")
    link.obstruct(busy=True, denied=True)
    with pytest.raises((serial.SerialException, OSError)):
        serial.Serial(str(link.path), exclusive=True)
    assert stat.S_IMODE(os.stat(str(link.tty)).st_mode) == 0
    link.obstruct(busy=False, denied=False)
    serial.Serial(str(link.path), exclusive=True).close()
    link.close()


def test_rename(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "ttyACM")
    link.rename("1")
    link.open()
    assert not os.path.lexists(tmp_path / "ttyACM")
    assert (tmp_path / "ttyACM1").is_symlink()
    link.rename("")
    link.open()
    assert (tmp_path / "ttyACM").is_symlink()
    link.close()


# -- memory and TCP ---------------------------------------------------------------------------------------------------


def test_memory_link_breaks_when_unplugged() -> None:
    link = MemoryLink()
    link.host_write(b"ab")
    assert link.read() == b"ab"
    link.write(b"cd")
    link.close()
    with pytest.raises(BrokenPipeError):
        link.host_read()
    with pytest.raises(BrokenPipeError):
        link.host_write(b"x")
    assert link.write(b"xyz") == 0
    assert link.counters.dropped_bytes == 3
    link.open()
    assert link.host_read() == b""


def test_tcp_serves_one_host_at_a_time_and_tells_the_device_when_it_goes() -> None:
    link, device = TcpLink(port=0), Upper()
    with_loop = Attachment()
    with_loop.add("device", device, link)
    with with_loop:
        with socket.create_connection((link.host, link.port), GIVE_UP_S) as host:
            host.sendall(b"hello")
            assert host.recv(10) == b"HELLO"
            with socket.create_connection((link.host, link.port), GIVE_UP_S) as second:
                assert second.recv(1) == b""
            host.sendall(b"still")
            assert host.recv(10) == b"STILL"
        wait_for("the loss", lambda: device.lost == 1)
        with socket.create_connection((link.host, link.port), GIVE_UP_S) as host:
            host.sendall(b"again")
            assert host.recv(10) == b"AGAIN"
            with_loop.unplug("device")
            assert host.recv(1) == b""
        wait_for("the unplugging", lambda: not link.is_open)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((link.host, link.port), GIVE_UP_S)
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind((link.host, link.port))  # the port is kept for its return
        with_loop.replug("device")
        wait_for("the port", lambda: link.is_open)
        with socket.create_connection((link.host, link.port), GIVE_UP_S) as host:
            host.sendall(b"x")
            assert host.recv(1) == b"X"


def test_tcp_host_that_calls_behind_one_that_has_hung_up_is_served() -> None:
    """Both are waiting when the device comes to look, as when a program is run again at once."""
    link, device = TcpLink(port=0), Upper()
    loop = Attachment()
    loop.add("device", device, link)

    def call(text: bytes) -> socket.socket:
        host = socket.create_connection((link.host, link.port), GIVE_UP_S)
        host.sendall(text)
        return host

    with call(b"first"):
        loop.service(0)
    with call(b"second") as second:
        for _ in range(3):
            loop.service(0)
        assert second.recv(10) == b"SECOND"
        assert device.lost == 1
    loop.stop()


def test_what_waited_for_a_tcp_host_is_not_given_to_the_next_one() -> None:
    link, device = TcpLink(port=0), Upper()
    station = DeviceStation(device, link)
    with socket.create_connection((link.host, link.port), GIVE_UP_S):
        station.service(0)
        lost = b"x" * 10_000_000  # more than any socket holds
        station._hand_over(lost, 0)
        station.service(0)
    with socket.create_connection((link.host, link.port), GIVE_UP_S) as host:
        host.sendall(b"mine")
        for _ in range(3):
            station.service(0)
        assert host.recv(100) == b"MINE"
        assert device.lost == 1
    station.close()


# -- the loop ---------------------------------------------------------------------------------------------------------


def test_loop_answers_at_once_and_sleeps_between(tmp_path: Path) -> None:
    device = Upper()
    loop = Attachment()
    loop.add("device", device, PtyLink(tmp_path / "p"))
    with loop, serial.Serial(str(tmp_path / "p"), 19200, timeout=GIVE_UP_S) as host:
        host.write(b"warm")
        assert host.read(4) == b"WARM"
        steps = len(device.bauds)
        time.sleep(0.3)
        assert len(device.bauds) - steps < 20
        delays = []
        for _ in range(20):
            begin = time.monotonic()
            host.write(b"q")
            assert host.read(1) == b"Q"
            delays.append(time.monotonic() - begin)
        # A loop that only looked now and then would let each question wait for its next look, 50 ms later. A machine
        # that is held up delays some, not all of twenty.
        assert min(delays) < 0.01
        assert device.bauds[-1] == 19200


def test_device_is_stepped_when_it_asks_for_it() -> None:
    class Metronome:
        def __init__(self) -> None:
            self.ticks: list[int] = []
            self.next_ns = 0

        def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
            if now_ns >= self.next_ns:
                self.ticks.append(now_ns)
                self.next_ns = now_ns + 5_000_000
            return b""

    device = Metronome()
    with SteadyClock() as clock:
        loop = Attachment(clock=clock)
        loop.add("metronome", device, MemoryLink())
        loop.run(lambda: len(device.ticks) >= 60)
        loop.stop()
    gaps_ms = np.diff(device.ticks) / 1e6
    assert gaps_ms.min() >= 5.0
    assert np.median(gaps_ms) < 15.0, "the loop would sleep for 50 ms if nobody asked"


def test_simulated_time_runs_at_its_speed() -> None:
    now = [1_000]
    loop = Attachment(clock=lambda: now[0], speed=10.0)
    now[0] += 50
    assert loop.now_ns() == 1_500
    loop.stop()
    with pytest.raises(ValueError, match="speed"):
        Attachment(speed=0.0)


def test_posted_work_runs_in_the_loops_thread() -> None:
    loop, names = Attachment(), []
    with loop:
        done = threading.Event()
        loop.post(lambda: names.append(threading.current_thread().name))
        loop.post(done.set)
        assert done.wait(GIVE_UP_S)
    assert names == ["attachment"]


def is_unplugged(link: MemoryLink) -> bool:
    return not link.is_open


def test_device_may_pull_its_own_plug_and_a_person_too() -> None:
    loop, link, device = Attachment(), MemoryLink(), Upper()
    station = loop.add("device", device, link)
    device.plugged = False
    loop.service(0)
    assert is_unplugged(link)
    station.plug(False)
    device.plugged = True
    loop.service(1)
    assert is_unplugged(link)
    station.plug(True)
    loop.service(2)
    assert not is_unplugged(link)
    loop.stop()


def test_bug_in_a_device_reaches_whoever_stops_the_loop() -> None:
    stepped = threading.Event()

    class Broken:
        def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
            stepped.set()
            raise ZeroDivisionError("bug")

    loop = Attachment()
    loop.add("broken", Broken(), MemoryLink())
    loop.start()
    assert stepped.wait(GIVE_UP_S)
    with pytest.raises(ZeroDivisionError):
        loop.stop()


def test_names_are_unique() -> None:
    loop = Attachment()
    loop.add("one", Upper(), MemoryLink())
    with pytest.raises(ValueError, match="one"):
        loop.add("one", Upper(), MemoryLink())
    loop.stop()


def test_terminal_settings_of_a_host_do_not_leak_echo(tmp_path: Path) -> None:
    link = PtyLink(tmp_path / "p")
    with serial.Serial(str(link.path)) as host:
        flags = termios.tcgetattr(host.fileno())[3]
        assert not flags & (termios.ECHO | termios.ICANON)
    link.close()
