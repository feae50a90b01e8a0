"""The fault ledger: every emulated device under every fault that a wire, a supply or the device itself can have.

    python -m bench.fault_ledger      writes docs/fault-ledger.md and docs/fault-ledger.json

Each cell is one fault of one device, carried out on a clock of the program's own (bench/fault_rig.py), so that the same
program gives the same figures everywhere. What is asserted of each cell is in `Row.complaints`; tests/loop/
test_fault_ledger.py runs them all, and tests/loop/test_hil_devices.py part of them on real ptys and on hardware.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.fault_rig import SECOND, TURN_NS, Rig
from drivers.readings import ChainReading, LinkState, ScanReading
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from sim_devices.device import F64
from sim_devices.presets import Table

ROOT = Path(__file__).resolve().parent.parent
PAGE, DATA = ROOT / "docs" / "fault-ledger.md", ROOT / "docs" / "fault-ledger.json"

SEEN_MOST_MS = 500
SEEN_LEAST_MS = 30  # shorter pauses are those of USB chips and schedulers
BACK_MS = 2000
BASELINE_S, FAULT_S = 0.8, 0.8
SLACK_M = 0.05  # sonars' noise of 5 mm, ten sigma
POLL_MS = 10  # the crank turns in steps of 4

# ---- devices --------------------------------------------------------------------------------------------------------

CAN: Table = {"main": {"interface": "slcan", "channel": "main", "bitrate_bps": 1000000}}
SWITCH_LINE = 2
YAWS = {1: -40.0, 2: 0.0, 3: 40.0}


def robot(*sources: str, **sections: Table) -> Table:
    """A small robot with one sector map around it and the building's grid."""
    around = {"sources": list(sources), "sector_deg": 15.0, "start_deg": -180.0, "stop_deg": 180.0}
    return {
        "robot": {"id": "ledger", "footprint_m": [[0.16, 0.12], [-0.16, 0.12], [-0.16, -0.12], [0.16, -0.12]]},
        **sections,
        "sectors": {"polar": {"around": around}},
        "store": {"enabled": False},
    }


def with_laser(driver: str, port: str = "/dev/ttyUSB0") -> Table:
    return robot("front", lasers={"front": {"driver": driver, "port": port, "no_echo": "unknown"}})


def with_sonars(driver: str, channels: Sequence[int] = (1, 2, 3), **more: object) -> Table:
    heads = [{"channel": channel, "x_m": 0.1, "yaw_deg": YAWS[channel]} for channel in channels]
    sonars = {"side": {"driver": driver, "cone_deg": 40.0, **more, "transducers": heads}}
    buses = {"can": {"main": dict(CAN["main"])}} if "can" in more else {}
    return robot("side", **buses, sonars=sonars)


def with_wheels(driver: str, ticks_per_turn: float = 4096.0, **more: object) -> Table:
    """Wheels, and an LD06 whose scans need their odometry to be drawn."""
    drive = {
        "source": "drive",
        "wheel_radius_left_m": 0.1,
        "wheel_radius_right_m": 0.1,
        "track_width_m": 0.3,
        "ticks_per_turn_left": ticks_per_turn,
        "ticks_per_turn_right": ticks_per_turn,
    }
    buses = {"can": {"main": dict(CAN["main"])}} if "can" in more else {}
    lasers = {"front": {"driver": "ldrobot", "port": "/dev/ttyUSB9"}}
    return robot("front", drive=drive, **buses, lasers=lasers, wheels={"drive": {"driver": driver, **more}})


def with_contacts(driver: str, **more: object) -> Table:
    """A bumper in front, and an LD06 that sees over it."""
    switch = {"line": SWITCH_LINE, "x_m": 0.16, "width_m": 0.24}
    bumpers = {"bumpers": {"driver": driver, **more, "switches": [switch]}}
    buses = {"can": {"main": dict(CAN["main"])}} if "can" in more else {}
    lasers = {"front": {"driver": "ldrobot", "port": "/dev/ttyUSB9"}}
    return robot("front", "bumpers", **buses, lasers=lasers, contacts=bumpers)


@dataclass(frozen=True, slots=True)
class Device:
    """One kind of device: its robot, its name there, the target of its faults, the wire it is on."""

    table: Callable[[], Table]
    source: str
    target: str
    wire: str = "serial"  # serial, tcp, udp, can
    model: str | None = None
    sends_every_ms: float | None = None  # where two send at their own times; None: the time between readings

    @property
    def is_wheels(self) -> bool:
        return self.source == "drive"

    @property
    def cells_of_doubt(self) -> int:
        """How many cells beside what was free may turn free without a fault: by noise of sonars, by the pose's."""
        return 2 if self.is_wheels else 1 if self.source == "side" else 0


def _laser(driver: str, model: str) -> Device:
    return Device(lambda: with_laser(driver), "front", "laser.front", model=model)


DEVICES: dict[str, Device] = {
    "Hokuyo URG-04LX": _laser("hokuyo", "urg-04lx"),
    "Hokuyo UTM-30LX": _laser("hokuyo", "utm-30lx"),
    "SICK LMS200": _laser("sick_lms2xx", "lms200"),
    "SICK TiM571": Device(
        lambda: with_laser("sick_cola", "tcp://127.0.0.1:2112"), "front", "laser.front", "tcp", "tim571"
    ),
    "RPLIDAR A1": _laser("rplidar", "rplidar-a1"),
    "RPLIDAR A2": _laser("rplidar", "rplidar-a2"),
    "LDROBOT LD06": _laser("ldrobot", "ld06"),
    "USBoard, CAN": Device(lambda: with_sonars("usboard", can="main"), "side", "sonar.side", "can"),
    "USBoard, serial": Device(lambda: with_sonars("usboard-serial", port="/dev/ttyUSB0"), "side", "sonar.side"),
    "MaxBotix, one": Device(
        lambda: with_sonars("maxbotix", (1,), port="/dev/ttyUSB0", family="hr-5m"), "side", "sonar.side"
    ),
    "MaxBotix, several": Device(
        lambda: with_sonars("maxbotix", port="/dev/ttyUSB0", family="hr-5m", lines="labelled"), "side", "sonar.side"
    ),
    "ros_arduino_bridge, pings": Device(
        lambda: with_sonars("arduino-bridge", port="/dev/ttyUSB0"), "side", "sonar.side"
    ),
    "ros_arduino_bridge, wheels": Device(
        lambda: with_wheels("arduino-bridge", port="/dev/ttyUSB0"), "drive", "encoder"
    ),
    "ros_arduino_bridge, contacts": Device(
        lambda: with_contacts("arduino-bridge", port="/dev/ttyUSB0"), "bumpers", "contact.bumpers"
    ),
    "USBoard, contacts": Device(lambda: with_contacts("usboard", can="main"), "bumpers", "contact.bumpers", "can"),
    "RoboClaw": Device(lambda: with_wheels("roboclaw", port="/dev/ttyACM0"), "drive", "encoder"),
    "CiA 406 encoders": Device(lambda: with_wheels("cia406", can="main"), "drive", "encoder.left", "can"),
    "ODrive 0.5": Device(
        lambda: with_wheels("odrive", 8192.0, can="main", firmware="0.5"), "drive", "encoder.left", "can"
    ),
    "ODrive 0.6": Device(
        lambda: with_wheels("odrive", 8192.0, can="main", firmware="0.6"), "drive", "encoder.left", "can"
    ),
    "VESC": Device(
        lambda: with_wheels("vesc", 90.0, can="main", id_left=1, id_right=2),
        "drive",
        "encoder.left",
        "can",
        sends_every_ms=20.0,
    ),
    "MAVLink, distances": Device(
        lambda: with_sonars("mavlink", port="/dev/ttyACM0", baud_bps=115200), "side", "autopilot"
    ),
    "MAVLink over UDP, distances": Device(
        lambda: with_sonars("mavlink", port="udpin:127.0.0.1:14550"), "side", "autopilot", "udp"
    ),
    "MAVLink over UDP, wheels": Device(
        lambda: with_wheels("mavlink", 628318.5, port="udpout:127.0.0.1:14550"), "drive", "autopilot", "udp"
    ),
    "MAVLink, wheels": Device(
        lambda: with_wheels("mavlink", 628318.5, port="/dev/ttyACM0", baud_bps=115200), "drive", "autopilot"
    ),
}

# ---- faults ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Trouble:
    """One fault and how it must show.

    target: of the fault, None for the device's own.  kinds: what is begun; a second one lasts for 0.2 s only.
    shows: lost (the source's state), counted (that or a counter of drops), blind (beams), blocked (a sector).
    starts: the device starts from scratch afterwards.
    """

    kinds: tuple[str, ...]
    shows: str = "lost"
    target: str | None = None
    starts: bool = False

    @property
    def name(self) -> str:
        first = self.kinds[0] if len(self.kinds) == 1 else f"{self.kinds[0]} after {self.kinds[1]}"
        return f"{self.target}:{first}" if self.target else first


SUPPLY = [Trouble((kind,), starts=True) for kind in ("power_cycle", "brown_out=0.8", "slow_boot")]
CUT = [Trouble((kind,)) for kind in ("unplug", "silence", "stall")]
SERIAL = [
    *CUT,
    Trouble(("rename=1",)),
    Trouble(("busy", "unplug")),
    Trouble(("no_permission", "unplug")),
    *SUPPLY,
    Trouble(("wrong_baud",)),
    Trouble(("drop=0.3",), "counted"),
    Trouble(("add=0.3",), "counted"),
    Trouble(("flip=0.3",), "counted"),
    Trouble(("flood=20000",), "counted"),
]
TCP = [*CUT, *SUPPLY, *(Trouble((kind,), "counted") for kind in ("drop=0.3", "add=0.3", "flip=0.3"))]
UDP = [*TCP, Trouble(("flood=20000",), "counted")]  # a flood: another program sends to the same port
NODE = [*CUT, *SUPPLY]
BUS = [
    *(Trouble((kind,), target="bus.main") for kind in ("unplug", "silence", "stall", "bus_off")),
    Trouble(("power_cycle",), target="bus.main", starts=True),
    Trouble(("unplug",), target="adapter.main"),
    Trouble(("rename=1",), target="adapter.main"),
    Trouble(("drop=0.3",), "counted", target="adapter.main"),
]
LASER = [Trouble((kind,), "blind") for kind in ("lost_sector", "sun=1", "black", "glass=1")]

SWITCH = [Trouble((kind,), "blocked", target=f"contact.bumpers.{SWITCH_LINE}") for kind in ("stuck_on",)]


def troubles_of(device: Device) -> list[Trouble]:
    """All faults of a device that must show."""
    found = {"serial": SERIAL, "tcp": TCP, "udp": UDP, "can": [*NODE, *BUS]}[device.wire]
    if device.target.startswith("laser"):
        found = [*found, *LASER]
    if device.target.startswith("contact"):
        found = [*found, *SWITCH]
    return found


CELLS = [(name, trouble) for name, device in DEVICES.items() for trouble in troubles_of(device)]

# ---- what happens ---------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Row:
    """What one cell showed. Times in ms from the fault's beginning, `back_ms` from its end; None: it never came."""

    device: str
    fault: str
    shows: str
    period_ms: float
    seen_ms: float | None = None
    state: str = ""
    stale_ms: float | None = None  # all that was known of the directions it feeds; None: it feeds none, or not asked
    back_ms: float | None = None
    start_ms: float = 0.0  # the device's own, where it starts from scratch
    freer: list[str] = field(default_factory=list)

    @property
    def limit_ms(self) -> float:
        """By when it must be seen: three periods, within bounds; damage may spare the first."""
        periods = 4.0 if self.shows == "counted" else 3.0
        return min(max(periods * self.period_ms, SEEN_LEAST_MS), SEEN_MOST_MS) + POLL_MS

    def complaints(self) -> list[str]:
        """What does not hold."""
        found = list(self.freer)
        if self.seen_ms is None or self.seen_ms > self.limit_ms:
            found.append(f"seen after {self.seen_ms} ms, not within {self.limit_ms:.0f}")
        if self.back_ms is None or self.back_ms > BACK_MS + self.start_ms:
            found.append(f"back after {self.back_ms} ms, not within {BACK_MS + self.start_ms:.0f}")
        if self.stale_ms is not None and self.stale_ms > SEEN_MOST_MS + POLL_MS:
            found.append(f"stale after {self.stale_ms} ms")
        return found


class Bench:
    """One device, on which faults are carried out one after the other."""

    def __init__(self, name: str, seed: int = 7) -> None:
        self.name = name
        self.device = DEVICES[name]
        self.rig = Rig(self.device.table(), model=self.device.model, sways=self.device.is_wheels, seed=seed)
        began_ns = self.rig.now_ns
        self._await_running(20.0)
        self.start_ms = (self.rig.now_ns - began_ns) / 1e6
        self.rig.run(3.5)  # the grid has all there is to see, the robot has been everywhere
        self.has_broken = False  # by the last fault: the grid is drawn from another pose since
        self._free: set[tuple[int, int]] = set()  # at the beginning of any fault
        self._first = [each.snapshot for _, each in self.rig.maps] if self.device.is_wheels else []

    def carry_out(self, trouble: Trouble) -> Row:
        """Begin a fault, end it, and tell what happened."""
        rig = self.rig
        self._await_running(10.0)
        rig.run(BASELINE_S)
        settled_ns = rig.now_ns - round(BASELINE_S * SECOND)
        row = Row(self.name, trouble.name, trouble.shows, self.device.sends_every_ms or self._period_ms(settled_ns))
        row.start_ms = self.start_ms if trouble.starts else 0.0
        before = _Reach([*self._first, *(each.snapshot for at_ns, each in rig.maps if at_ns >= settled_ns)])
        blind = self._blind_beams(settled_ns)
        self._free |= rig.free_cells()
        target = trouble.target or self.device.target
        damage, begun_ns = rig.damage(), rig.now_ns
        faults = [rig.begin(f"{target}:{kind}") for kind in trouble.kinds]
        short_ns = begun_ns + SECOND // 5
        drawn: set[tuple[int, int]] | None = None
        while rig.now_ns < begun_ns + FAULT_S * SECOND:
            rig.turn()
            if drawn is None and self._has_broken(begun_ns):
                drawn = rig.free_cells()
            if len(faults) > 1 and rig.now_ns >= short_ns:
                rig.plan.end(faults.pop())
            if row.seen_ms is None and trouble.shows == "counted" and rig.damage() > damage:
                row.seen_ms, row.state = (rig.now_ns - begun_ns) / 1e6, "counted"
            if row.seen_ms is None and trouble.shows == "blind" and self._blind_beams(begun_ns) > blind:
                row.seen_ms, row.state = (rig.now_ns - begun_ns) / 1e6, "invalid beams"
        self._note_loss(row, before, begun_ns)
        for fault in faults:
            rig.plan.end(fault)
        ended_ns = rig.now_ns
        row.freer += before.freer([each.snapshot for at_ns, each in rig.maps if begun_ns < at_ns <= ended_ns])
        free = rig.free_cells() if drawn is None else drawn
        new = free - grown(self._free, self.device.cells_of_doubt)
        if self.device.source in ("front", "bumpers"):  # what single beams at the field's edge truly see free
            new = {cell for cell in new if not rig.is_in_room(cell)}
        if new:
            row.freer.append(f"{len(new)} cells freer")
        if rig.run_until(lambda: self._is_back(ended_ns), 8.0):
            row.back_ms = (rig.now_ns - ended_ns) / 1e6
        self.has_broken = self._has_broken(begun_ns)
        rig.maps.clear()
        rig.heard[:] = rig.heard[-200:]
        return row

    def _await_running(self, within_s: float) -> None:
        rig, source = self.rig, self.device.source
        if not rig.run_until(lambda: all(rig.is_running(each) for each in rig.sensors), within_s):
            raise RuntimeError(f"{self.name} does not run: {rig.health()[source].trouble}")

    def _period_ms(self, since_ns: int) -> float:
        """Between readings; of a chain, from one reading of a transducer to its next."""
        readings = self.rig.readings(self.device.source, since_ns)
        if readings and isinstance(readings[0], ChainReading):
            first = readings[0].ranges[0].channel
            readings = [
                each
                for each in readings
                if isinstance(each, ChainReading) and any(heard.channel == first for heard in each.ranges)
            ]
        if len(readings) < 2:
            return BASELINE_S * 1e3
        intervals_ns = np.sort(np.diff([each.stamp_ns for each in readings]))
        usual_ns = np.median(intervals_ns[len(intervals_ns) // 2 :])
        return float(intervals_ns[intervals_ns >= usual_ns / 4.0].mean()) / 1e6  # a burst after a pause is none

    def _note_loss(self, row: Row, before: _Reach, begun_ns: int) -> None:
        rig = self.rig
        events = [each for each in rig.events(self.device.source, begun_ns) if each.state is not LinkState.RUNNING]
        lost_ms = (events[0].stamp_ns - begun_ns) / 1e6 if events else math.inf
        if row.shows in ("lost", "counted") and lost_ms < (math.inf if row.seen_ms is None else row.seen_ms):
            row.seen_ms, row.state = lost_ms, events[-1].state.name.lower()
        if row.shows == "blocked":
            nearer = (at for at, each in rig.maps if at > begun_ns and before.is_nearer(each.snapshot))
            row.seen_ms, row.state = (next(nearer, rig.now_ns + SECOND) - begun_ns) / 1e6, "obstacle"
        if row.shows == "blind":
            gone = (at for at, each in rig.maps if at > begun_ns and before.has_gone(each.snapshot, some=True))
            row.stale_ms = (next(gone, rig.now_ns + SECOND) - begun_ns) / 1e6
        if row.shows == "lost" and not self.device.is_wheels:
            some = self.device.source == "bumpers"  # the laser still sees the other sectors
            fresh = [at for at, each in rig.maps if at > begun_ns and not before.has_gone(each.snapshot, some=some)]
            row.stale_ms = (max(fresh, default=begun_ns) + TURN_NS - begun_ns) / 1e6

    def _blind_beams(self, since_ns: int) -> int:
        """The most beams of one scan that told nothing, or that they saw nothing."""
        readings = self.rig.readings(self.device.source, since_ns)
        scans = (each.range_m for each in readings if isinstance(each, ScanReading))
        return max((int((np.isnan(each) | np.isposinf(each)).sum()) for each in scans), default=0)

    def _has_broken(self, since_ns: int) -> bool:
        """Whether wheels have told that motion was lost: the pose is another one from there on."""
        return self.device.is_wheels and any(
            not each.continuous for each in self.rig.readings(self.device.source, since_ns)
        )

    def _is_back(self, since_ns: int) -> bool:
        source = self.device.source
        return self.rig.is_running(source) and len(self.rig.readings(source, since_ns)) >= 3


def grown(cells: set[tuple[int, int]], by: int) -> set[tuple[int, int]]:
    """Cells and their neighbours, so many away."""
    steps = range(-by, by + 1)
    return {(row + up, col + right) for row, col in cells for up in steps for right in steps}


class _Reach:
    """How far each sector could be driven into before the fault, at most."""

    def __init__(self, snapshots: Sequence[PolarSnapshot]) -> None:
        self._reach_m = np.max([_reach_m(each) for each in snapshots], axis=0)
        self._free = np.any([each.state == SectorState.FREE for each in snapshots], axis=0)

    def freer(self, snapshots: Sequence[PolarSnapshot]) -> list[str]:
        """In words, which sectors any of these maps shows freer."""
        found = set()
        for each in snapshots:
            farther = (self._reach_m > 0.0) & (_reach_m(each) > self._reach_m + SLACK_M)
            newly = (each.state == SectorState.FREE) & ~self._free
            found |= {int(index) for index in np.flatnonzero(farther | newly)}
        return [f"sectors {sorted(found)} freer"] if found else []

    def is_nearer(self, snapshot: PolarSnapshot) -> bool:
        """Whether an obstacle stands where the way was longer."""
        stands = snapshot.state == SectorState.OBSTACLE
        return bool((stands & (_reach_m(snapshot) + SLACK_M < self._reach_m)).any())

    def has_gone(self, snapshot: PolarSnapshot, *, some: bool) -> bool:
        """Whether some or all of what was known is stale or unknown."""
        gone = np.isin(snapshot.state, (SectorState.STALE, SectorState.UNKNOWN))[self._reach_m > 0.0]
        return bool(gone.any() if some else gone.all())


def _reach_m(snapshot: PolarSnapshot) -> F64:
    known = np.isin(snapshot.state, (SectorState.OBSTACLE, SectorState.FREE))
    return np.where(known & np.isfinite(snapshot.distance_m), snapshot.distance_m, 0.0)


@lru_cache
def rows_of(name: str) -> tuple[Row, ...]:
    """All cells of one device."""
    bench = Bench(name)
    with bench.rig:
        return tuple(bench.carry_out(trouble) for trouble in troubles_of(bench.device))


# ---- the page -------------------------------------------------------------------------------------------------------

GRAIN_MS = 50  # figures are rounded up to this, so that they stay as they are when a device is made a little different


def rounded(ms: float | None) -> int | None:
    """Up to the grain."""
    return None if ms is None else math.ceil(ms / GRAIN_MS) * GRAIN_MS


def as_data(rows: Sequence[Row]) -> list[dict[str, object]]:
    """What docs/fault-ledger.json holds."""
    return [
        {
            "device": row.device,
            "fault": row.fault,
            "period_ms": round(row.period_ms),
            "seen_ms": rounded(row.seen_ms),
            "state": row.state,
            "stale_ms": rounded(row.stale_ms),
            "back_ms": rounded(row.back_ms),
            "start_ms": rounded(row.start_ms),
            "holds": not row.complaints(),
        }
        for row in rows
    ]


BEGIN, END = "<!-- written by `make ledger` from here -->\n", "<!-- to here -->\n"


def page(rows: Sequence[Row], text: str) -> str:
    """The page with its tables written anew; what is before and after them stays."""
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    parts = [f"{len(rows)} cells, {sum(not row.complaints() for row in rows)} of them hold.\n"]
    for name in dict.fromkeys(row.device for row in rows):
        own = [row for row in rows if row.device == name]
        parts.append(f"\n## {name}\n\nA reading every {round(own[0].period_ms)} ms.\n\n")
        parts.append("| fault | seen | as | stale | back |\n| --- | ---: | --- | ---: | ---: |\n")
        for row in own:
            start = f" ({rounded(row.start_ms)})" if row.start_ms else ""
            mark = "" if not row.complaints() else " **does not hold**"
            cells = f"{_text(row.seen_ms)} | {row.state} | {_text(row.stale_ms)} | {_text(row.back_ms)}{start}{mark}"
            parts.append(f"| `{row.fault}` | {cells} |\n")
    return f"{before}{BEGIN}{''.join(parts)}{END}{after}"


def _text(ms: float | None) -> str:
    return "" if ms is None else str(rounded(ms))


def main() -> int:
    """Write the ledger; 1 if a cell does not hold."""
    parser = argparse.ArgumentParser(description="Write the fault ledger.")
    parser.add_argument("--only", default="", help="devices with this in their name; shown, not written")
    only = parser.parse_args().only
    rows = [row for name in DEVICES if only in name for row in rows_of(name)]
    for row in rows:
        if only or row.complaints():
            print(row.device, row.fault, row.seen_ms, row.state, row.stale_ms, row.back_ms, *row.complaints())
    if not only:
        PAGE.write_text(page(rows, PAGE.read_text()))
        DATA.write_text(json.dumps(as_data(rows), indent=1) + "\n")
    return int(any(row.complaints() for row in rows))


if __name__ == "__main__":
    sys.exit(main())
