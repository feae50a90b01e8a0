"""The whole way, measured: an emulated robot, the daemon, the page and a subscriber, each a process of its own.

    python bench/latency.py [--seconds N] [--json FILE]

The robot is ARTOS with a UTM-30LX (1081 beams, 40 Hz), two sonar chains and encoders at 100 Hz, driving through a flat;
the daemon keeps sector maps, grid and store; `umfeld view` has a page connected. Latency: from the write() of a scan's
last byte into the pty to the callback of a plain Zenoh subscriber that gets the sector map made from that scan. Both
ends read CLOCK_MONOTONIC, which all processes of one machine share. The sector map tells the scan it was made from by
its stamp less the age of its newest sector. Everything runs on this machine: emulators, page and subscriber take their
share of the same cores, so on a busy machine the figures are upper bounds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

SCAN_PERIOD_S = 0.025
HALF_SECOND = 20  # scans
WARM_UP_S = 4.0


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured value beside its budget (None: told for scale)."""

    name: str
    value: float
    unit: str
    budget: float | None

    @property
    def is_kept(self) -> bool:
        """Whether the budget is kept."""
        return self.budget is None or self.value <= self.budget


# --- the emulated robot and the subscriber, each in a process of its own ----------------------------------------------


def robot(folder: Path) -> int:
    """Emulate ARTOS until SIGTERM; then write when the last byte of each scan had gone out, monotonic nanoseconds."""
    from sim_devices import __main__ as simulation
    from sim_devices import presets
    from sim_devices.pty_link import PtyLink

    ended: list[int] = []

    class TimedLink(PtyLink):
        """Notes when a whole scan has gone out. Other replies end alike, but come before the first scan only."""

        def write(self, data: bytes) -> int:
            sent = super().write(data)
            if data.endswith(b"\n\n"):
                ended.append(time.monotonic_ns())
            return sent

    setattr(presets, "PtyLink", TimedLink)  # noqa: B010 - its own name for it, which type checkers hide
    code = simulation.main(["--preset", "artos", "--dir", str(folder), "--start-after", "2"])
    (folder.parent / "ends.json").write_text(json.dumps(ended))
    return code


def subscriber(endpoint: str, seconds: float, out: Path) -> int:
    """A plain Zenoh client: when each sector map of the laser came, and when the scan behind it began."""
    import zenoh

    config = zenoh.Config()
    for key, value in (("mode", "client"), ("scouting/multicast/enabled", False), ("connect/endpoints", [endpoint])):
        config.insert_json5(key, json.dumps(value))
    came: list[tuple[int, bytes]] = []
    with zenoh.open(config) as session:
        session.declare_subscriber(
            "robots/*/sectors/polar/laser",
            lambda sample: came.append((time.monotonic_ns(), sample.payload.to_bytes())),
        )
        time.sleep(seconds)
    wall_ns = time.time_ns() - time.monotonic_ns()
    rows = []
    for at_ns, payload in came:
        document = json.loads(payload)
        ages = [sector["age_s"] for sector in document["sectors"] if sector["age_s"] is not None]
        if ages:
            stamp_ns = document["stamp"]["sec"] * 1_000_000_000 + document["stamp"]["nanosec"]
            rows.append((at_ns, stamp_ns - wall_ns - round(min(ages) * 1e9)))
    out.write_text(json.dumps(rows))
    return 0


async def visitor(address: str, seconds: float) -> int:
    """A browser's share: take what the page sends; returns how many bytes that were."""
    import aiohttp

    taken = 0
    end = time.monotonic() + seconds
    async with aiohttp.ClientSession() as client, client.ws_connect(f"{address.rstrip('/')}/stream") as stream:
        with contextlib.suppress(asyncio.TimeoutError):
            while (left := end - time.monotonic()) > 0:
                message = await stream.receive(timeout=left)
                taken += len(message.data) if isinstance(message.data, bytes | str) else 0
    return taken


# --- what is measured ------------------------------------------------------------------------------------------------


def latencies_ms(ends_ns: Sequence[int], samples: Sequence[tuple[int, int]]) -> list[float]:
    """For each scan that reached the subscriber: from its last byte on the wire to its sector map.

    samples: (came, first beam of the scan behind it). A map sent again without a new scan has the same first beam. How
    long after a first beam the last byte goes out (a sweep, an emulator that is late, a clock's fit that is off) is
    taken from the quickest of the second around it, which are surely quicker than half a period; the end nearest to
    that is the scan's. No end counts twice.
    """
    fresh: list[tuple[int, int]] = []
    for came_ns, beam_ns in samples:
        if not fresh or beam_ns - fresh[-1][1] >= SCAN_PERIOD_S * 1e9 / 2:
            fresh.append((came_ns, beam_ns))
    found: list[float] = []
    at, used = 0, -1
    for number, (came_ns, beam_ns) in enumerate(fresh):
        around = fresh[max(0, number - HALF_SECOND) : number + HALF_SECOND + 1]
        wanted_ns = beam_ns + min(came - beam for came, beam in around)
        while at + 1 < len(ends_ns) and abs(ends_ns[at + 1] - wanted_ns) <= abs(ends_ns[at] - wanted_ns):
            at += 1
        if at < len(ends_ns) and at != used and ends_ns[at] <= came_ns:
            found.append((came_ns - ends_ns[at]) / 1e6)
            used = at
    return found


def percentile(values: Sequence[float], share: float) -> float:
    """Nearest rank."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, int(share * len(ordered))))]


@contextlib.contextmanager
def process(*command: str, environment: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is ended with SIGTERM."""
    started = subprocess.Popen(
        command,
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **(environment or {})},
    )
    try:
        yield started
    finally:
        started.terminate()
        try:
            started.communicate(timeout=15)
        except subprocess.TimeoutExpired:
            started.kill()
            started.communicate()


def ready_s(listener: socket.socket, began: float) -> float:
    """Seconds until the daemon said READY=1, as it does to systemd."""
    while b"READY=1" not in listener.recv(4096):
        pass
    return time.monotonic() - began


def first_output(*command: str) -> tuple[float, float]:
    """Seconds to a command's first byte of output, and its largest resident memory in MB."""
    began = time.monotonic()
    started = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert started.stdout is not None
    heard = os.read(started.stdout.fileno(), 1)
    took = time.monotonic() - began
    time.sleep(0.3)
    os.kill(started.pid, signal.SIGTERM)  # not poll() before: it would take the figures that wait4 is to give
    started.stdout.read()
    _, _, used = os.wait4(started.pid, 0)
    started.returncode = 0
    if not heard:
        raise RuntimeError(f"{' '.join(command)} printed nothing")
    return took, used.ru_maxrss / 1024


def free_port() -> int:
    """One that nobody has right now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for(ready: Callable[[], Any], seconds: float = 30.0) -> None:
    """Until something is so; TimeoutError otherwise."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise TimeoutError("the processes did not come up")
        time.sleep(0.02)


def measure(seconds: float) -> list[Figure]:
    """Everything in this file; takes about `seconds` and twenty more."""
    import psutil

    umfeld = [sys.executable, "-m", "service"]
    this = [sys.executable, str(Path(__file__).resolve())]
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory() as text, contextlib.ExitStack() as stack:
        folder = Path(text)
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        emulated = stack.enter_context(process(*this, "--role", "robot", str(folder / "robot")))
        config = folder / "robot" / "umfeld.toml"
        wait_for(config.exists)
        settings = [f'network.listen=["{endpoint}"]', f"store.path={folder}/m.umfeld"]
        run = [*umfeld, "run", "--config", str(config), *(f"--set={each}" for each in settings)]
        listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        listener.bind(str(folder / "notify"))
        listener.settimeout(120.0)  # the first start compiles
        tell = {"NOTIFY_SOCKET": str(folder / "notify")}
        with process(*run, environment=tell):  # compiles what is not compiled yet
            ready_s(listener, time.monotonic())
        began = time.monotonic()
        daemon = stack.enter_context(process(*run, environment=tell))
        figures.append(Figure("daemon: ready, warm", ready_s(listener, began), "s", 3.0))
        page = stack.enter_context(process(*umfeld, "view", "--port", str(free_port()), "--connect", endpoint))
        assert page.stdout is not None
        address = page.stdout.readline().decode().split()[-1]

        time.sleep(WARM_UP_S)
        watched = {"daemon": daemon.pid, "emulators": emulated.pid, "page": page.pid}
        measured = {name: psutil.Process(pid) for name, pid in watched.items()}
        before = {name: each.cpu_times() for name, each in measured.items()}
        with process(*this, "--role", "subscriber", endpoint, str(seconds), str(folder / "came.json")) as listening:
            start = time.monotonic()
            asyncio.run(visitor(address, seconds))
            passed = time.monotonic() - start
            after = {name: each.cpu_times() for name, each in measured.items()}
            resident = measured["daemon"].memory_info().rss / 1e6
            listening.wait(30)
        load = {
            name: 100.0 * (after[name].user + after[name].system - before[name].user - before[name].system) / passed
            for name in measured
        }
        for name, arguments in (
            ("umfeld --help", ["--help"]),
            ("umfeld status", ["status", "--connect", endpoint]),
            ("umfeld view", ["view", "--port", str(free_port()), "--connect", endpoint]),
        ):
            runs = [first_output(*umfeld, *arguments) for _ in range(3)]
            figures.append(Figure(f"{name}: first output", min(took for took, _ in runs), "s", 0.4))
            figures.append(Figure(f"{name}: memory", max(memory for _, memory in runs), "MB", 80.0))
        emulated.terminate()
        emulated.wait(15)
        ends = json.loads((folder / "ends.json").read_text())
        came = json.loads((folder / "came.json").read_text())
    late = latencies_ms(ends, came)
    if len(late) < 20 * seconds:
        raise RuntimeError(f"only {len(late)} scans of {40 * seconds:.0f} came through")
    return [
        Figure("scan on the wire to sector map at a subscriber, p50", percentile(late, 0.5), "ms", 3.0),
        Figure("scan on the wire to sector map at a subscriber, p99", percentile(late, 0.99), "ms", 10.0),
        Figure("scans that came through", 100.0 * len(late) / (40.0 * seconds), "%", None),
        Figure("daemon: processor, of one core", load["daemon"], "%", 35.0),
        Figure("daemon: memory", resident, "MB", 250.0),
        *figures,
        Figure("emulators: processor, of one core", load["emulators"], "%", None),
        Figure("page server: processor, of one core", load["page"], "%", None),
    ]


def table(figures: Sequence[Figure]) -> str:
    """For people without rich."""
    lines = []
    for each in figures:
        verdict = "" if each.budget is None else f"{each.budget:8.1f}  {'ok' if each.is_kept else 'MISSED'}"
        lines.append(f"{each.name:56}{each.value:9.2f} {each.unit:3}{verdict}")
    return "\n".join(lines)


def main() -> int:
    """Measure, print; 1 if a budget was missed."""
    parser = argparse.ArgumentParser(description="Latency and load of the whole daemon.")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to measure")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--role", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    match options.role:
        case ["robot", folder]:
            return robot(Path(folder))
        case ["subscriber", endpoint, seconds, out]:
            return subscriber(endpoint, float(seconds), Path(out))
    figures = measure(options.seconds)
    print(table(figures))
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(each) for each in figures], indent=2) + "\n")
    return 0 if all(each.is_kept for each in figures) else 1


if __name__ == "__main__":
    sys.exit(main())
