"""Emulated devices, the daemon's readers and its fusion on one clock that the caller turns: no thread, no pty, no wait.

Everything between the device's bytes and the published maps is the daemon's own; only the wires are of memory, so that
a minute of trouble takes a second. For bench/fault_ledger.py; real ptys are driven by tests/loop/test_hil_devices.py.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np

from drivers.errors import PortAbsent, PortBusy, PortDenied
from drivers.ports import CanPort, Port
from drivers.reader import SourceHealth, WireReader
from drivers.readings import DeviceEvent, LinkState, Reading
from drivers.slcan_bus import LawicelBus
from service import assemble, assemble_wires
from service.config import Config, load
from service.fusion import Fusion, OdometryOnly
from service.outputs import HealthOut, Output, PolarOut
from service.worker import Worker
from sim_devices.attach import Attachment, MemoryLink
from sim_devices.device import F64, Mount
from sim_devices.faults import Fault, FaultPlan
from sim_devices.presets import Table, emulate, to_toml

SECOND = 1_000_000_000
TURN_NS = 4_000_000  # of the crank: a daemon on a pty turns at least so often
SILENT_REOPEN_S = 2.0  # of a TCP port
FREE_PERCENT = 19  # as map_server draws it
FOLDER = Path("/dev/memory")

HALF_ROOM_M = 2.0
SWAY_M, SWAY_RAD_S = 0.10, 2.0  # the robot rolls to and fro, at most 0.2 m/s
CONE_M = 1.05


class Room:
    """A square room, the robot swaying along x in its middle (or standing), a pole that sonars hear."""

    def __init__(self, *, sways: bool) -> None:
        self._sway_m = SWAY_M if sways else 0.0

    def x_m(self, stamp_ns: F64) -> F64:
        return self._sway_m * (1.0 - np.cos(SWAY_RAD_S * 1e-9 * stamp_ns))

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """Distances to the four walls in closed form."""
        at = bearing_rad + mount.yaw_rad
        c, s = np.cos(at), np.sin(at)
        x = self.x_m(np.asarray(stamp_ns, dtype=np.float64)) + mount.x_m
        with np.errstate(divide="ignore"):
            along_x = np.where(c > 0.0, HALF_ROOM_M - x, -HALF_ROOM_M - x) / c
            along_y = np.where(s > 0.0, HALF_ROOM_M - mount.y_m, -HALF_ROOM_M - mount.y_m) / s
        range_m = np.minimum(np.where(c == 0.0, np.inf, along_x), np.where(s == 0.0, np.inf, along_y))
        return np.where(range_m <= range_max_m, range_m, np.inf)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return CONE_M if range_max_m >= CONE_M else math.inf

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        x_m = float(self.x_m(np.array(float(now_ns))))
        return x_m, x_m


class MemoryPort:
    """A port of the daemon on a link of memory. Raises the PortError that a serial port would."""

    def __init__(
        self, link: MemoryLink, name: str, baud: int | None, clock: Callable[[], int], *, on_tcp: bool
    ) -> None:
        if not link.is_open or str(link.path) != name:
            raise PortAbsent(f"no {name}: is the device plugged in and powered?")
        if link.is_denied:
            raise PortDenied(f"no permission on {name}")
        if link.is_busy:
            raise PortBusy(f"another program holds {name}")
        self.name = name
        self.drops: dict[str, int] = {}
        self.silence_reopen_s: float | None = SILENT_REOPEN_S if on_tcp else None
        self._link = link
        self._pulled = link.pulled
        self._clock = clock
        link.baud = baud
        link.host_read()  # what arrived while nobody had it open

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        self._check()
        chunk = self._link.host_read()
        return [(chunk, self._clock())] if chunk else []

    def write(self, item: bytes) -> None:
        self._check()
        self._link.host_write(item)

    def set_baud(self, bits_per_s: int) -> None:
        if self._link.baud is not None:
            self._link.baud = bits_per_s

    def discard_input(self) -> None:
        self._link.host_read()

    def close(self) -> None:
        """Nothing to give back."""

    def fileno(self) -> int | None:
        return None

    def _check(self) -> None:
        if not self._link.is_open or self._link.pulled != self._pulled:
            raise PortAbsent(f"{self.name} was lost: check its cable and power")


class MemoryUdpPort:
    """The daemon's UDP socket: it stays open whatever becomes of who speaks there, and knows nobody before he spoke."""

    silence_reopen_s: float | None = None

    def __init__(self, link: MemoryLink, name: str, clock: Callable[[], int]) -> None:
        self.name = name
        self.drops: dict[str, int] = {}
        self._link = link
        self._clock = clock
        self._has_peer = name.startswith("udpout")

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        datagrams = self._link.host_read() if self._link.is_open else b""
        self._has_peer = self._has_peer or bool(datagrams)
        return [(datagrams, self._clock())] if datagrams else []

    def write(self, item: bytes) -> None:
        if not self._has_peer:
            self.drops["no_peer"] = self.drops.get("no_peer", 0) + 1
        elif self._link.is_open:
            self._link.host_write(item)

    def set_baud(self, bits_per_s: int) -> None:
        """UDP has no speed to set."""

    def close(self) -> None:
        """Nothing to give back."""

    def fileno(self) -> int | None:
        return None


class Rig:
    """A robot of emulated devices and what the daemon makes of it, on a clock of its own.

    table: the daemon's configuration.  model: of its lasers.  heard: everything the readers said.  maps: every polar
    map that was published.
    """

    def __init__(self, table: Table, *, model: str | None = None, sways: bool = False, seed: int = 7) -> None:
        self.now_ns = SECOND
        self.heard: list[tuple[str, Reading | DeviceEvent]] = []
        self.maps: list[tuple[int, PolarOut]] = []
        self.plan = FaultPlan(seed=seed)
        self.attachment = Attachment(clock=lambda: self.now_ns)
        self.room = Room(sways=sways)
        robot = emulate(
            table, self.room, self.attachment, FOLDER, laser=model, exact=True, plan=self.plan, in_memory=True
        )
        self._links = {name: link for name, link in robot.links.items() if isinstance(link, MemoryLink)}
        self.config = config_of(robot.config)
        self.sensors = assemble.sensors(self.config)
        made = assemble.maps(self.config, self.sensors)
        self.grid = made.building
        parts = assemble.parts(self.config, self.sensors, made, OdometryOnly())
        self.fusion = Fusion(replace(parts, odometry_laser=None))  # the rig stands, whatever the laser says
        self.worker = Worker(
            self.fusion,
            self._publish,
            now_ns=lambda: self.now_ns,
            beat=lambda now_ns: None,
            health=lambda now_ns: HealthOut(now_ns, 0, "", (), {}, {}),
        )
        self.readers = [self._reader(wire) for wire in assemble_wires.wires(self.config)]

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back what the emulation holds."""
        for reader in self.readers:
            reader.close()
        self.attachment.stop()

    # --- the clock

    def turn(self) -> None:
        """One turn of the crank: devices, wires, fusion."""
        self.now_ns += TURN_NS
        self.attachment.service(self.now_ns)
        for reader in self.readers:
            reader.step()
        self.worker.turn(0.0)

    def run(self, seconds: float) -> None:
        """Turn for so long."""
        until_ns = self.now_ns + round(seconds * SECOND)
        while self.now_ns < until_ns:
            self.turn()

    def run_until(self, ready: Callable[[], bool], within_s: float) -> bool:
        """Turn until it is so; False if it is not in time."""
        until_ns = self.now_ns + round(within_s * SECOND)
        while not ready():
            if self.now_ns >= until_ns:
                return False
            self.turn()
        return True

    def begin(self, fault: str) -> Fault:
        return self.plan.start(fault, self.now_ns)

    # --- what happened

    def health(self) -> dict[str, SourceHealth]:
        return {name: each for reader in self.readers for name, each in reader.health().sources.items()}

    def damage(self) -> int:
        """How much was thrown away so far, by drivers, ports and fusion."""
        wires = [reader.health() for reader in self.readers]
        in_drivers = (sum(source.counters.drops.values()) for wire in wires for source in wire.sources.values())
        in_fusion = (sum(reasons.values()) for reasons in self.fusion.drops.values())
        return sum(sum(wire.drops.values()) for wire in wires) + sum(in_drivers) + sum(in_fusion)

    def readings(self, source: str, since_ns: int) -> list[Any]:
        return [
            item
            for name, item in self.heard
            if name == source and not isinstance(item, DeviceEvent) and item.stamp_ns >= since_ns
        ]

    def events(self, source: str, since_ns: int) -> list[DeviceEvent]:
        return [
            item
            for name, item in self.heard
            if name == source and isinstance(item, DeviceEvent) and item.stamp_ns >= since_ns
        ]

    def link_of(self, source: str) -> MemoryLink:
        """The wire of a source."""
        (wire,) = (wire for wire in assemble_wires.wires(self.config) if source in wire.conversations)
        return self._link_of(wire)

    def is_running(self, source: str) -> bool:
        return self.health()[source].state is LinkState.RUNNING

    def free_cells(self) -> set[tuple[int, int]]:
        """Row and column of every cell of the building's grid that is drawn as free."""
        if self.grid is None:
            return set()
        patch = self.grid.grid.patch()
        rows, cols = np.nonzero((patch.cells >= 0) & (patch.cells <= FREE_PERCENT))
        return set(zip((rows + patch.row0).tolist(), (cols + patch.col0).tolist()))

    def is_in_room(self, cell: tuple[int, int]) -> bool:
        """Whether a cell's middle lies before the walls, where the robot stands still."""
        edge_m = self.config.grid.resolution_m
        return all(abs((place + 0.5) * edge_m) < HALF_ROOM_M for place in cell)

    # --- inside

    def _publish(self, output: Output) -> None:
        if isinstance(output, PolarOut):
            self.maps.append((self.now_ns, output))

    def _sink(self, source: str, item: Reading | DeviceEvent) -> None:
        self.heard.append((source, item))
        self.worker.sink(source, item)

    def _reader(self, wire: assemble_wires.Wire) -> WireReader[Any]:
        link = self._link_of(wire)
        name = str(link.path)
        on_tcp = wire.name in self.config.lasers and self.config.lasers[wire.name].driver == "sick_cola"
        device = next((d for s, n, d in self.config.devices() if self.config.source_name(s, n) in wire.conversations))
        baud = None if on_tcp or device.can_bus() else getattr(device, "baud_bps", None)

        def open_port() -> Port[Any]:
            if (address := device.serial_port() or "").startswith("udp"):
                return MemoryUdpPort(link, address, lambda: self.now_ns)
            line = MemoryPort(link, name, baud, lambda: self.now_ns, on_tcp=on_tcp)
            if not wire.name.startswith("can-"):
                return line
            bus = self.config.can[wire.name.removeprefix("can-")]
            return _MemoryCanPort(line, bus.bitrate_bps, lambda: self.now_ns)

        conversations = {source: make() for source, make in wire.conversations.items()}
        return WireReader(
            wire.name, open_port, conversations, self._sink, clock=lambda: self.now_ns, wait=lambda seconds: None
        )

    def _link_of(self, wire: assemble_wires.Wire) -> MemoryLink:
        for link in self._links.values():
            if wire.port == str(link.path):
                return link
        named = [link for name, link in self._links.items() if name.partition(".")[2] in wire.conversations]
        (link,) = named or [link for name, link in self._links.items() if name.startswith("autopilot")]
        return link


def config_of(table: Table) -> Config:
    """As the daemon reads it from a file."""
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
        file.write(to_toml(table))
        file.flush()
        return load(Path(file.name), environment={}).config


class _MemoryCanPort(CanPort):
    """The daemon's CAN port on an slcan adapter of memory."""

    def __init__(self, line: MemoryPort, bitrate_bps: int, clock: Callable[[], int]) -> None:
        self._line = line
        super().__init__(interface="slcan", channel=line.name, bitrate_bps=bitrate_bps, clock=clock)

    def _open(self, interface: str, channel: str, bitrate_bps: int) -> can.BusABC:
        return LawicelBus(channel, bitrate_bps=bitrate_bps, clock=self._clock, drops=self.drops, line=self._line)
