"""How fast every parser is, and how long it can be held up: frames a second, the slowest chunk of true and bad bytes.

    python -m bench.parsers       a table; exit code 1 below 5,000 frames a second or above 50 ms

The frames are what the emulated devices sent to the daemon's drivers for two seconds (bench/fault_rig.py); the bad
bytes are noise, the same frames with one byte in twenty changed, and what begins a frame again and again.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.fault_ledger import DEVICES
from bench.fault_rig import SECOND, Rig
from drivers import cola, laser_ldrobot, rplidar_messages, scip, sick_telegrams
from drivers.encoder_arduino_bridge import decode_line as bridge_line
from drivers.encoder_roboclaw import RoboClawConversation
from drivers.errors import FrameError
from drivers.mavlink_frames import Frames
from drivers.readings import SourceCounters
from drivers.slcan_bus import decode_line as slcan_line
from drivers.sonar_maxbotix import MaxBotixConversation
from drivers.sonar_usboard import UsBoardSerialConversation
from sim_devices.device import Mount
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.wheel import Wheel

LEAST_PER_S, MOST_S = 5000.0, 0.050
MS = 1_000_000
CHUNK = 4096  # what a serial line has ready at once
F64 = NDArray[np.float64]
Feed = Callable[[bytes], Iterable[object]]


def by_lines(decode: Callable[[bytes], object], end: bytes) -> Callable[[], Feed]:
    """A decoder of lines as a feed."""

    def feed(data: bytes) -> list[object]:
        found = []
        for line in data.split(end):
            try:
                found.append(decode(line.strip(b"\n")))
            except FrameError:
                continue
        return [each for each in found if each is not None]

    return lambda: feed


# A device of the ledger -> its parser.  RoboClaw answers are only told apart by their question: see measure_asked.
PARSERS: dict[str, Callable[[], Feed]] = {
    "Hokuyo UTM-30LX": lambda: _with_stamp(scip.ScipReplies().feed),
    "SICK LMS200": lambda: _with_stamp(sick_telegrams.TelegramReader().feed),
    "SICK TiM571": lambda: _with_stamp(cola.TelegramReader().feed),
    "RPLIDAR A1": lambda: _with_stamp(rplidar_messages.AnswerReader().feed),
    "LDROBOT LD06": lambda: _with_stamp(laser_ldrobot.PacketReader().feed),
    "USBoard, serial": lambda: _with_stamp(UsBoardSerialConversation().receive),
    "MaxBotix, one": lambda: _with_stamp(MaxBotixConversation("hr-5m").receive),
    "ros_arduino_bridge, wheels": by_lines(bridge_line, b"\r"),
    "RoboClaw": lambda: _with_stamp(RoboClawConversation().receive),
    "CiA 406 encoders": by_lines(slcan_line, b"\r"),
    "MAVLink, distances": lambda: Frames(SourceCounters()).feed,
}


def _with_stamp(feed: Callable[[bytes, int], Iterable[object]]) -> Feed:
    return lambda data: feed(data, SECOND)


def sent_by(name: str, seconds: float = 2.0) -> bytes:
    """What the emulated device tells the driver, from the first byte."""
    heard = bytearray()
    device = DEVICES[name]
    with Rig(device.table(), model=device.model, sways=device.is_wheels) as rig:
        link = rig.link_of(device.source)
        read = link.host_read

        def listen() -> bytes:
            data = read()
            heard.extend(data)
            return data

        link.host_read = listen  # type: ignore[method-assign]
        rig.run_until(lambda: rig.is_running(device.source), 10.0)
        rig.run(seconds)
    return bytes(heard)


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one parser."""

    name: str
    frames: int
    per_s: float
    slowest_s: float

    @property
    def holds(self) -> bool:
        return (self.frames == 0 or self.per_s >= LEAST_PER_S) and self.slowest_s <= MOST_S


def measure(name: str, data: bytes) -> Figures:
    """The best of several rounds over true bytes; the slowest chunk of bad ones, each the best of two."""
    make = PARSERS[name]
    frames = len(list(make()(data)))
    best_s = min(_took(lambda: list(make()(data))) for _ in range(7))
    slowest_s = 0.0
    for bad in bad_bytes(data):
        feed = make()
        for at in range(0, len(bad), CHUNK):
            chunk = bad[at : at + CHUNK]
            slowest_s = max(slowest_s, min(_took(lambda: list(feed(chunk))) for _ in range(2)))  # noqa: B023
    return Figures(name, frames, frames / best_s, slowest_s)


def measure_asked(rounds: int = 20_000) -> Figures:
    """RoboClaw: answers mean something only after their question: an emulated board is asked. Only reading counts."""
    still = _Still()
    board = RoboClaw(Wheel(still, "left", 0.1, 1000.0), Wheel(still, "right", 0.1, 1000.0))
    conversation = RoboClawConversation(rate_hz=200.0)
    conversation.connected(0)
    frames, took_s = 0, 0.0
    for now_ns in range(0, rounds * MS, MS):
        asked = b"".join(item for item in conversation.requests(now_ns) if isinstance(item, bytes))
        answer = board.step(now_ns, asked, None)
        if answer:
            frames += 1
            took_s += _took(lambda: list(conversation.receive(answer, now_ns)))  # noqa: B023
    noise = measure("RoboClaw", b"")
    return Figures("RoboClaw", frames, frames / took_s, noise.slowest_s)


class _Still:
    """A robot that stands and sees nothing (a sim_devices.device.Scene)."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), np.nan)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return float("nan")

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


def bad_bytes(data: bytes) -> list[bytes]:
    """Noise, damaged frames, and what looks like the begin of frames without end."""
    rng = np.random.default_rng(5)
    frames = np.frombuffer(data, np.uint8)
    damaged = np.where(rng.random(len(frames)) < 0.05, rng.integers(0, 256, len(frames)), frames).astype(np.uint8)
    fillers = [data[:size] * (CHUNK // size) for size in (1, 2, 4, 9) if data[:size]]
    return [rng.bytes(8 * CHUNK), damaged.tobytes(), *fillers]


def _took(work: Callable[[], object]) -> float:
    began = time.thread_time()
    work()
    return time.thread_time() - began


def main() -> int:
    """Print the table."""
    rows = [measure_asked() if name == "RoboClaw" else measure(name, sent_by(name)) for name in PARSERS]
    print(f"{'parser':28} {'frames':>7} {'frames/s':>9} {'slowest 4 kB':>13}")
    for row in rows:
        rate = f"{row.per_s:9,.0f}" if row.frames else "        -"
        print(f"{row.name:28} {row.frames:7} {rate} {1e3 * row.slowest_s:10.2f} ms{'' if row.holds else '  below'}")
    return int(not all(row.holds for row in rows))


if __name__ == "__main__":
    sys.exit(main())
