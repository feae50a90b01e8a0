"""How tests wait, find ports and measure time on a machine that may stop them for seconds (docs/testing.md).

A wait ends when what it waits for is there; its limit only ends a run that would hang, so no good run ever meets it.
What is asserted afterwards is what was waited for: one thread's work says nothing of another's.
"""

from __future__ import annotations

import fcntl
import socket
import subprocess
import termios
import threading
import time
from array import array
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

GIVE_UP_S = 120.0
"""A machine that does not come round in two minutes is broken, or the program is."""

START_S = 300.0
"""For what may have to compile all kernels first, beside other tests."""

T = TypeVar("T")


def wait_for(what: str, ready: Callable[[], T | None], seconds: float = GIVE_UP_S, *, every_s: float = 0.01) -> T:
    """What `ready` gives, as soon as that is true. AssertionError naming `what` if it never is."""
    deadline = time.monotonic() + seconds
    while not (result := ready()):
        assert time.monotonic() < deadline, f"{what}: not within {seconds:g} s"
        time.sleep(every_s)
    return result


# --- ports of the network -------------------------------------------------------------------------------------------

_FIRST_PORT, _PORTS = 20_000, 10_000
_reserved: list[socket.socket] = []


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of the loopback interface that nobody has, and that nobody else is given until this process ends.

    Below those that the system gives to connections: one of those may be taken before whoever is told of it binds it.
    Reserved by an abstract socket of that name, which all test processes of this machine respect.
    """
    begin = time.monotonic_ns() % _PORTS
    for offset in range(_PORTS):
        port = _FIRST_PORT + (begin + offset) % _PORTS
        reservation = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            reservation.bind(f"\0umfeld-test-port-{port}")
            with socket.socket(socket.AF_INET, kind) as probe:
                probe.bind(("127.0.0.1", port))
        except OSError:
            reservation.close()
            continue
        _reserved.append(reservation)
        return port
    raise AssertionError("no port is free")


def wait_for_input(descriptor: int, count: int) -> None:
    """Until a terminal has so many bytes to read: a pty hands them on in its own time, and in pieces of its own."""
    waiting = array("i", [0])

    def there() -> bool:
        fcntl.ioctl(descriptor, termios.FIONREAD, waiting)
        return waiting[0] >= count

    wait_for(f"{count} bytes of input", there, every_s=0.001)


def kill_devices(process: subprocess.Popen[bytes], folder: Path) -> None:
    """End emulated devices as if all their cables were pulled at once.

    Their links go first: a killed process leaves them, and the terminal that such a link names is given to whoever
    opens one next. A daemon that tries its port again would then speak to another test's device.
    """
    for link in folder.iterdir():
        if link.is_symlink():
            link.unlink()
    process.kill()
    process.wait()


# --- time -----------------------------------------------------------------------------------------------------------


class SteadyClock:
    """Nanoseconds that all but stand still while this process is held up, so that real demands on time can be asked.

    A thread of its own beats every few milliseconds; MOST_NS after a beat the clock goes a thousand times slower (so
    that two stamps still differ), up to the next one. Devices, drivers and judges that share it are held up together: a
    process that is stopped for a second has lost 11 ms by it, not 1000. The loop of emulated devices beats as well
    (`beat`, see BeatStation), since a device that is not served is silent for no fault of its own. Nobody else does: a
    program that lets a device wait shows as ever. A context manager; call it for the time.
    """

    BEAT_S = 0.003
    MOST_NS = 10_000_000

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen_ns = self._steady_ns = time.monotonic_ns()
        self._crumbs = 0
        self._beats = {"clock": self._seen_ns}
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="steady clock", daemon=True)
        self._thread.start()

    def __call__(self) -> int:
        with self._lock:
            return self._read()

    def __enter__(self) -> SteadyClock:
        return self

    def __exit__(self, *_error: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the thread; from then on the clock creeps."""
        self._ending.set()
        self._thread.join()

    def beat(self, name: str) -> None:
        """Somebody who is to be waited for from now on is alive."""
        with self._lock:
            self._read()
            self._beats[name] = self._seen_ns

    def _read(self) -> int:
        now_ns = time.monotonic_ns()
        passed_ns = now_ns - self._seen_ns
        surely_ns = min(max(min(self._beats.values()) + self.MOST_NS - self._seen_ns, 0), passed_ns)
        crept_ns, self._crumbs = divmod(passed_ns - surely_ns + self._crumbs, 1000)
        self._steady_ns += surely_ns + crept_ns
        self._seen_ns = now_ns
        return self._steady_ns

    def _run(self) -> None:
        while not self._ending.wait(self.BEAT_S):
            self.beat("clock")


class BeatStation:
    """Lets a loop of emulated devices (sim_devices.attach) beat a clock whenever it serves them."""

    PERIOD_NS = 3_000_000

    def __init__(self, clock: SteadyClock) -> None:
        self._clock = clock

    def files(self) -> list[int]:
        return []

    def service(self, now_ns: int) -> int:
        self._clock.beat("devices")
        return now_ns + self.PERIOD_NS

    def plug(self, connected: bool, member: str = "") -> None: ...

    def close(self) -> None: ...


def waited_ns(*threads: threading.Thread) -> int:
    """How long threads of this process were ready to run so far and did not come to it; 0 where that is not told."""
    total_ns = 0
    for thread in threads:
        with suppress(OSError):
            total_ns += int(Path(f"/proc/self/task/{thread.native_id}/schedstat").read_text().split()[1])
    return total_ns


def seconds_of(clock: Callable[[], int], work: Callable[[], object]) -> float:
    """How long something takes by a clock."""
    began_ns = clock()
    work()
    return (clock() - began_ns) / 1e9
