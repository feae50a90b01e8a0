"""Emulated devices on real wires: ptys under fixed names, a TCP port, or memory; and the loop that runs them.

A link is the host's end of a wire: bytes in, bytes out, the host's line speed, and it can be pulled out and put back.
A station is what the loop serves: a device on its link here, a whole CAN bus in slcan_hub.py. One thread serves all
stations; others talk to it through `post`. The loop sleeps until a host sends something or a device has something due.

A pty carries no modem lines and no pace of its own; the devices keep the wire's time. Its queue holds about 20 KB: what
does not fit is dropped and counted, as an overrun would.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from sim_devices.device import ByteDevice
from sim_devices.pty_link import READ_SIZE, LinkCounters, PtyLink

MOST_OWED = 65536
OWED_NS = 250_000_000
HOKUYO_TCP_PORT = 10940
IDLE_NS = 50_000_000  # longest sleep
STOP_S = 60.0  # a loop on a starved machine ends late; its wires must not be pulled out under it
STEP_NS = 2_000_000  # step of a device that does not say when it wants the next one


class Link(Protocol):
    """The emulator's end of a wire."""

    counters: LinkCounters

    @property
    def is_open(self) -> bool:
        """Whether the wire is plugged in."""

    @property
    def baud(self) -> int | None:
        """The host's line speed; None where a link has none."""

    def open(self) -> None:
        """Plug it in, under the same name as before."""

    def close(self) -> None:
        """Pull it out: the host's end breaks."""

    def files(self) -> list[int]:
        """Descriptors that become readable when there is something to read."""

    def read(self) -> bytes:
        """What the host sent since the last call, without waiting."""

    def write(self, data: bytes) -> int:
        """Send without waiting; what does not fit is dropped and counted. Returns how many bytes went out."""


class TcpLink:
    """A device that listens on a TCP port of the loopback interface; one host at a time, as such devices do.

    port: 0 takes a free one. While it is unplugged the port is kept, bound but deaf, as long as this link lives: hosts
    are refused, and no other program is given it meanwhile.
    """

    def __init__(self, port: int = HOKUYO_TCP_PORT, host: str = "127.0.0.1") -> None:
        self.host = host
        self.port = port
        self.counters = LinkCounters()
        self.baud: int | None = None
        self.hosts_lost = 0
        self._listener: socket.socket | None = None
        self._kept: socket.socket | None = None
        self._client: socket.socket | None = None
        self.open()

    @property
    def is_open(self) -> bool:
        return self._listener is not None

    def open(self) -> None:
        if self._listener is not None:
            return
        listener, self._kept = self._kept or self._bound(), None
        listener.listen(1)
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener

    def close(self) -> None:
        self._lose_client()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self._kept = self._bound()

    def _bound(self) -> socket.socket:
        bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # past connections that are being closed
        bound.bind((self.host, self.port))
        return bound

    def __del__(self) -> None:
        if self._kept is not None:
            self._kept.close()

    def files(self) -> list[int]:
        return [end.fileno() for end in (self._listener, self._client) if end is not None]

    def read(self) -> bytes:
        data = self._received()  # before anybody is welcomed: a host that has hung up makes room for the next
        if not data and self._welcomed():
            data = self._received()
        return data

    def _received(self) -> bytes:
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_SIZE)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._lose_client()
        self.counters.received_bytes += len(data)
        return data

    def write(self, data: bytes) -> int:
        sent = 0
        if self._client is not None:
            try:
                while sent < len(data):
                    sent += self._client.send(data[sent:])
            except BlockingIOError:
                pass
            except OSError:
                self._lose_client()
        self.counters.sent_bytes += sent
        self.counters.dropped_bytes += len(data) - sent
        return sent

    def _welcomed(self) -> bool:
        """Whether a host has just been let in; while one is there, others are turned away."""
        if self._listener is None:
            return False
        try:
            client, _ = self._listener.accept()
        except OSError:
            return False
        if self._client is not None:
            client.close()
            return False
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        return True

    def _lose_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            self.hosts_lost += 1


class MemoryLink:
    """A wire inside one process, for tests: `host_write` and `host_read` are the other end.

    path: the name it has in configurations.  is_denied, is_busy: why a host could not open it now.
    """

    def __init__(self, baud: int | None = None, path: Path | str = "memory") -> None:
        self.path = Path(path)
        self.counters = LinkCounters()
        self.baud = baud
        self.is_open = True
        self.is_busy = self.is_denied = False
        self.pulled = 0  # how often it was closed: a host that had it open has lost it
        self._name = self.path.name
        self._to_device = bytearray()
        self._to_host = bytearray()

    def open(self) -> None:
        self.is_open = True

    def close(self) -> None:
        self.is_open = False
        self.pulled += 1
        self._to_device.clear()
        self._to_host.clear()

    def rename(self, suffix: str) -> None:
        """Come back under the first name with a suffix; whoever had it open has lost it."""
        if self.path.name != self._name + suffix:
            self.close()
            self.path = self.path.with_name(self._name + suffix)

    def obstruct(self, *, busy: bool, denied: bool) -> None:
        """See PtyLink."""
        self.is_busy, self.is_denied = busy, denied

    def files(self) -> list[int]:
        return []

    def read(self) -> bytes:
        data = bytes(self._to_device)
        self._to_device.clear()
        self.counters.received_bytes += len(data)
        return data

    def write(self, data: bytes) -> int:
        if not self.is_open:
            self.counters.dropped_bytes += len(data)
            return 0
        self._to_host += data
        self.counters.sent_bytes += len(data)
        return len(data)

    def host_write(self, data: bytes) -> None:
        """What the host sends. Raises BrokenPipeError while the wire is pulled out."""
        if not self.is_open:
            raise BrokenPipeError("the wire is unplugged")
        self._to_device += data

    def host_read(self) -> bytes:
        """What has arrived at the host. Raises BrokenPipeError while the wire is pulled out."""
        if not self.is_open:
            raise BrokenPipeError("the wire is unplugged")
        data = bytes(self._to_host)
        self._to_host.clear()
        return data


class Station(Protocol):
    """Something the loop serves: a device on its link, or a bus with all its members."""

    def files(self) -> list[int]:
        """Descriptors to wait for."""

    def service(self, now_ns: int) -> int | None:
        """Move bytes and step devices; returns when it wants to be served again, None: when something arrives."""

    def plug(self, connected: bool, member: str = "") -> None:
        """Put the wire in or pull it out. member: which wire, where a station has several."""

    def close(self) -> None:
        """Give back what it holds."""


class PortOf:
    """Keeps a link as its device wants it: plugged in or not, under which name, busy or not permitted."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._obstructed = (False, False)

    def follow(self, device: object, wanted: bool) -> bool:
        """Do what the device's attributes say (see DeviceStation); returns whether the plug was pulled just now."""
        wanted = wanted and bool(getattr(device, "plugged", True))
        link, was_open = self._link, self._link.is_open
        if isinstance(link, PtyLink | MemoryLink):
            link.rename(str(getattr(device, "port_suffix", "")))
        was_pulled = was_open and not (wanted and link.is_open)
        if wanted and not link.is_open:
            link.open()
            self._obstructed = (False, False)
        elif not wanted and link.is_open:
            link.close()
        self._obstruct(bool(getattr(device, "port_busy", False)), bool(getattr(device, "port_denied", False)))
        return was_pulled

    def _obstruct(self, busy: bool, denied: bool) -> None:
        link = self._link
        if (busy, denied) != self._obstructed and isinstance(link, PtyLink | MemoryLink) and link.is_open:
            with contextlib.suppress(BlockingIOError):  # a host holds it: try again at the next service
                link.obstruct(busy=busy, denied=denied)
                self._obstructed = busy, denied


class DeviceStation:
    """One serial or TCP device on its link.

    A device with an attribute `plugged` (a fault wrapper) pulls its own wire by setting it False, with `port_suffix` it
    renames its pty, with `port_busy` and `port_denied` it keeps others out; one with `next_ns` is served when it asks
    for it; one with `link_lost(now_ns)` is told when its TCP host went away.

    A pty holds less than what the kernel holds for a real port (64 KiB), so as much waits here for a host that is
    busy; where nothing at all was taken for 0.25 s nobody reads, and what comes is lost, as on a port that is not open.
    """

    def __init__(self, device: ByteDevice, link: Link) -> None:
        self.device = device
        self.link = link
        self._wanted = True
        self._hosts_lost = 0
        self._port = PortOf(link)
        self._owed = b""
        self._moved_ns = 0  # when the link last took something

    def files(self) -> list[int]:
        return self.link.files()

    def plug(self, connected: bool, member: str = "") -> None:
        self._wanted = connected

    def service(self, now_ns: int) -> int | None:
        self._follow_plug()
        received = self.link.read() if self.link.is_open else b""
        self._tell_loss(now_ns)
        sent = self.device.step(now_ns, received, self.link.baud)
        if self._follow_plug():
            self._owed = b""
        self._hand_over(sent, now_ns)
        due_ns: int | None = getattr(self.device, "next_ns", now_ns + STEP_NS)
        if self._owed:
            due_ns = now_ns + STEP_NS if due_ns is None else min(due_ns, now_ns + STEP_NS)
        return due_ns

    def _hand_over(self, sent: bytes, now_ns: int) -> None:
        """Give the link what it takes, and keep the rest for a host that was busy for a moment."""
        data = self._owed + sent
        if not data:
            return
        taken = self.link.write(data)
        if taken:
            self._moved_ns = now_ns
        is_read = now_ns - self._moved_ns <= OWED_NS and self.link.is_open
        self._owed = data[taken : taken + MOST_OWED] if is_read else b""
        self.link.counters.dropped_bytes -= len(self._owed)

    def close(self) -> None:
        self.link.close()

    def _follow_plug(self) -> bool:
        return self._port.follow(self.device, self._wanted)

    def _tell_loss(self, now_ns: int) -> None:
        lost = int(getattr(self.link, "hosts_lost", 0))
        if lost != self._hosts_lost:
            self._hosts_lost = lost
            self.link.counters.dropped_bytes += len(self._owed)
            self._owed = b""  # what waited for it is not for the next one
            tell = getattr(self.device, "link_lost", None)
            if tell is not None:
                tell(now_ns)


class Attachment:
    """All stations of one emulation and the loop that serves them.

    clock: nanoseconds; by default the machine's monotonic clock.  speed: simulated seconds for each second of it.

    Use it by hand in tests (`service(now_ns)`), run it in this thread (`run(until)`), or in one of its own
    (`start()`, `stop()`). Everything but `post`, `plug`, `stop` and what they carry belongs to the loop's thread.
    """

    def __init__(self, *, clock: Callable[[], int] = time.monotonic_ns, speed: float = 1.0) -> None:
        if not speed > 0:
            raise ValueError("speed must be greater than 0")
        self._clock = clock
        self._speed = speed
        self._origin_ns = clock()
        self._stations: dict[str, Station] = {}
        self._posted: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    # -- building -----------------------------------------------------------------------------------------------------

    def add(self, name: str, device: ByteDevice, link: Link) -> DeviceStation:
        """Attach a serial or TCP device."""
        station = DeviceStation(device, link)
        self.add_station(name, station)
        return station

    def add_station(self, name: str, station: Station) -> None:
        """Attach anything that can be served, such as a CAN bus."""
        if name in self._stations:
            raise ValueError(f"there is a station {name!r} already")
        self._stations[name] = station

    # -- from any thread ----------------------------------------------------------------------------------------------

    def post(self, action: Callable[[], object]) -> None:
        """Have the loop run something between two services."""
        self._posted.put(action)
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"\0")

    def plug(self, name: str, connected: bool, member: str = "") -> None:
        """Pull out (False) or put back (True) a station's wire; takes effect at once, from any thread."""
        station = self._stations[name]
        self.post(lambda: station.plug(connected, member))

    def unplug(self, name: str, member: str = "") -> None:
        """Pull out a wire: its pty goes away with its name."""
        self.plug(name, False, member)

    def replug(self, name: str, member: str = "") -> None:
        """Put the wire back: a new pty under the same name."""
        self.plug(name, True, member)

    # -- the loop -----------------------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Simulated time: the clock's, run at `speed` from when this was made."""
        now_ns = self._clock()
        if self._speed == 1.0:
            return now_ns
        return self._origin_ns + round((now_ns - self._origin_ns) * self._speed)

    def service(self, now_ns: int) -> int | None:
        """Serve every station once; returns the earliest time any wants to be served again."""
        return self._serve_all(lambda: now_ns)

    def _serve_all(self, clock: Callable[[], int]) -> int | None:
        """Each at its own time: one that measures a sweep for milliseconds makes the next one's values no older."""
        while not self._posted.empty():
            self._posted.get()()
        due = [station.service(clock()) for station in self._stations.values()]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def run(self, until: Callable[[], bool] | None = None) -> None:
        """Serve in this thread until `until()` is true or stop() was called."""
        while not self._ending.is_set() and not (until is not None and until()):
            due_ns = self._serve_all(self.now_ns)
            self._wait(due_ns)

    def start(self) -> Attachment:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self._run_guarded, name="attachment", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the loop and pull out all wires. Raises what the loop's thread died of, if it did."""
        self._ending.set()
        self.post(lambda: None)
        if self._thread is not None:
            self._thread.join(timeout=STOP_S)
            self._thread = None
        for station in self._stations.values():
            station.close()
        os.close(self._wake_read)
        os.close(self._wake_write)
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Attachment:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run_guarded(self) -> None:
        try:
            self.run()
        except BaseException as error:
            self._failure = error

    def _wait(self, due_ns: int | None) -> None:
        """Sleep until something arrives or is due."""
        left_ns = IDLE_NS if due_ns is None else round((due_ns - self.now_ns()) / self._speed)
        timeout_s = min(max(left_ns, 0), IDLE_NS) * 1e-9
        files: Sequence[int] = [self._wake_read, *(file for one in self._stations.values() for file in one.files())]
        ready, _, _ = select.select(files, [], [], timeout_s)
        if self._wake_read in ready:
            with contextlib.suppress(OSError):
                os.read(self._wake_read, 4096)
