"""How far apart the readings of 100 Hz encoders come in on a busy machine: how soon silence may be told.

    python -m bench.encoder_gaps --busy 2 --seconds 60

Two emulated CiA 406 encoders on an slcan pty in a process of their own, the daemon's reader in this one, and so many
processes that do nothing but compute. What is measured is what the driver's watch sees: the time between readings.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from drivers.encoder_cia406 import Cia406PairConversation
from drivers.ports import CanPort
from drivers.reader import WireReader
from drivers.readings import DeviceEvent, LinkState, Reading
from sim_devices.attach import Attachment
from sim_devices.device import F64, Mount
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation

LEFT, RIGHT = 0x20, 0x21
PERIOD_MS = 10.0
SETTLED_S = 2.0


class Blocks:
    """A robot on blocks, its wheels turning."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.ones(len(bearing_rad))

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.5e-9 * now_ns, 0.5e-9 * now_ns


def emulate(path: Path) -> None:
    """Both encoders behind an adapter on this pty, until the process is ended."""
    station = CanBusStation(CanBus())
    station.add_member("host", PtyLink(path))
    for node in (LEFT, RIGHT):
        station.bus.add_node(f"{node}", Cia406Encoder(Blocks(), node))
    loop = Attachment()
    loop.add_station("can", station)
    with loop:
        while True:
            time.sleep(1.0)


def measure(path: Path, seconds: float) -> tuple[F64, int]:
    """Gaps in ms, and how often silence was told."""
    arrived_ns: list[int] = []
    silences = 0

    def sink(_: str, item: Reading | DeviceEvent) -> None:
        nonlocal silences
        if isinstance(item, DeviceEvent):
            silences += item.state is LinkState.SILENT
        else:
            arrived_ns.append(time.monotonic_ns())

    def port() -> CanPort:
        return CanPort(interface="slcan", channel=str(path), clock=time.monotonic_ns)

    reader = WireReader("can", port, {"drive": Cia406PairConversation(LEFT, RIGHT)}, sink, clock=time.monotonic_ns)
    reader.start()
    time.sleep(SETTLED_S)
    arrived_ns.clear()
    silences = 0
    time.sleep(seconds)
    gaps_ms: F64 = np.diff(np.array(arrived_ns, dtype=np.float64)) * 1e-6
    told = silences
    reader.stop()
    return gaps_ms, told


def main() -> None:
    parser = argparse.ArgumentParser(description="Gaps between readings of 100 Hz encoders.")
    parser.add_argument("--busy", type=int, default=0, help="processes that compute beside it")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--emulate", type=Path, help=argparse.SUPPRESS)
    told = parser.parse_args()
    if told.emulate is not None:
        emulate(told.emulate)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "can"
        emulator = subprocess.Popen([sys.executable, "-m", "bench.encoder_gaps", "--emulate", str(path)])
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(told.busy)]
        try:
            while not path.exists():
                time.sleep(0.05)
            gaps_ms, silences = measure(path, told.seconds)
        finally:
            for each in (*others, emulator):
                each.kill()
                each.wait()
    most = " ".join(f"{np.percentile(gaps_ms, share):.1f}" for share in (50.0, 99.0, 99.9, 100.0))
    over = " ".join(
        f">{periods * PERIOD_MS:.0f} ms: {(gaps_ms > periods * PERIOD_MS).sum()}" for periods in (3, 4.5, 6)
    )
    print(f"busy {told.busy}: {len(gaps_ms)} gaps, ms at 50, 99, 99.9, 100 %: {most}; {over}; told silent: {silences}")


if __name__ == "__main__":
    main()
