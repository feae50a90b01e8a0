"""Whole robots: from a configuration of the daemon to emulated devices that fit it, and back with their ports in it.

A preset is such a configuration; any other that names devices known here does as well. Every laser gets a pty of its
own, every CAN bus an adapter on a pty; both are links with fixed names in one folder. `emulate` returns the running
parts and the configuration in which those names stand.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim_devices.attach import Attachment, PtyLink
from sim_devices.device import ByteDevice, CanDevice, Mount, Scene
from sim_devices.encoder_arduino_bridge import ArduinoBridge
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.encoder_odrive import ODriveAxis
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.encoder_vesc import STEPS_PER_ELECTRICAL_TURN, Vesc
from sim_devices.faults import FaultPlan
from sim_devices.laser_hokuyo import PROFILES, UTM_30LX, HokuyoLaser, LaserProfile
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardCan, default_parameters
from sim_devices.wheel import Side, Wheel

Table = dict[str, Any]

SIDES: tuple[Side, Side] = ("left", "right")
WHEEL_BOARDS = frozenset({"arduino-bridge", "roboclaw"})  # one board on a serial line counts both wheels
FIRST_NODE = {"cia406": 0x20, "odrive": 0, "vesc": 1}  # one node a wheel on a CAN bus
WHEEL_DRIVERS = WHEEL_BOARDS | FIRST_NODE.keys()

HOST = "host"  # the daemon's adapter on every bus
INLINE_TABLES = frozenset({"mount", "pose", "tls"})


class PresetError(ValueError):
    """A configuration that no emulated robot fits; the text names the key and the repair."""


@dataclass(slots=True)
class Robot:
    """An emulated robot on its wires.

    config: the daemon's configuration for it.  links: every pty, under its station's name ("lasers.front", "can.main").
    buses, lasers, sonars, encoders: by their names in the configuration (encoders as "drive.left").
    """

    config: Table
    links: dict[str, PtyLink] = field(default_factory=dict)
    buses: dict[str, CanBusStation] = field(default_factory=dict)
    lasers: dict[str, HokuyoLaser] = field(default_factory=dict)
    sonars: dict[str, UsBoard] = field(default_factory=dict)
    encoders: dict[str, Cia406Encoder] = field(default_factory=dict)

    def was_spoken_to(self) -> bool:
        """Whether a host has sent anything on any wire yet."""
        return any(link.counters.received_bytes for link in self.links.values())


def emulate(
    config: Mapping[str, Any],
    scene: Scene,
    attachment: Attachment,
    folder: Path,
    *,
    profile: LaserProfile = UTM_30LX,
    exact: bool = False,
    seed: int = 0,
    plan: FaultPlan | None = None,
) -> Robot:
    """Attach an emulated device for each device of a configuration, and say where.

    folder: where the ptys' links stand.  profile: model of the lasers.  exact: no noise on lasers (recorded ranges have
    theirs).  plan: faults; its targets are laser.NAME, sonar.NAME, encoder.left and .right, bus.NAME, and adapter.NAME,
    the daemon's port on that bus.  Raises PresetError for a device that cannot be emulated.
    """
    robot = Robot(copy.deepcopy(dict(config)))
    builder = _Builder(robot, scene, attachment, folder, plan or FaultPlan(seed=seed), faulty=plan is not None)
    for name, bus in robot.config.get("can", {}).items():
        builder.add_bus(name, bus)
    for k, (name, laser) in enumerate(sorted(robot.config.get("lasers", {}).items())):
        builder.add_laser(name, laser, profile, exact=exact, seed=seed + k, number=k)
    for k, (name, sonar) in enumerate(sorted(robot.config.get("sonars", {}).items())):
        builder.add_sonar(name, sonar, seed=seed + 100 + k)
    for name, wheels in robot.config.get("wheels", {}).items():
        builder.add_wheels(name, wheels)
    return robot


@dataclass(frozen=True, slots=True)
class _Builder:
    """Makes emulators, wraps them in their faults if there are any, and puts them on wires."""

    robot: Robot
    scene: Scene
    attachment: Attachment
    folder: Path
    plan: FaultPlan
    faulty: bool

    def add_bus(self, name: str, bus: Table) -> None:
        can = CanBus(bitrate_bps=int(bus.get("bitrate_bps", 1000000)))
        station = CanBusStation(can)
        link = PtyLink(self.folder / f"can-{name}")
        adapter = station.add_member(HOST, link)
        if self.faulty:
            station.wrap_member(HOST, self.plan.device(f"adapter.{name}", adapter))
            self.plan.bus(f"bus.{name}", can)
        self.attachment.add_station(f"can.{name}", station)
        self.robot.buses[name], self.robot.links[f"can.{name}"] = station, link
        bus["interface"], bus["channel"] = "slcan", str(link.path)

    def add_laser(self, name: str, laser: Table, profile: LaserProfile, *, exact: bool, seed: int, number: int) -> None:
        _require(laser, f"lasers.{name}", "hokuyo")
        target = f"laser.{name}"
        device = HokuyoLaser(
            self._seen(target),
            _mount(laser.get("mount", {})),
            profile=profile,
            serial=f"{profile.serial[:-1]}{number}" if number else None,
            seed=seed,
            link="usb",
            noise_scale=0.0 if exact else 1.0,
        )
        link = PtyLink(self.folder / f"laser-{name}")
        self.attachment.add(f"lasers.{name}", self.plan.device(target, device) if self.faulty else device, link)
        self.robot.lasers[name], self.robot.links[f"lasers.{name}"] = device, link
        laser["port"] = str(link.path)

    def add_sonar(self, name: str, sonar: Table, *, seed: int) -> None:
        place, target = f"sonars.{name}", f"sonar.{name}"
        _require(sonar, place, "usboard")
        half = math.radians(float(sonar.get("cone_deg", 30.0))) / 2.0
        transducers = {int(t["channel"]): Transducer(_mount(t), half) for t in sonar.get("transducers", [])}
        base_id = int(sonar.get("base_id", 0x400))
        parameters = default_parameters(base_id, serial=20000 + base_id)
        board = UsBoard(self._seen(target), transducers, parameters=parameters, seed=seed)
        self._join(_bus_of(self.robot, sonar, place), target, UsBoardCan(board))
        self.robot.sonars[name] = board

    def add_wheels(self, name: str, wheels: Table) -> None:
        driver = _required(wheels, f"wheels.{name}", WHEEL_DRIVERS)
        alone = len(self.robot.config["wheels"]) == 1
        target = "encoder" if alone else f"encoder.{name}"
        if driver in WHEEL_BOARDS:
            board = self._wheel_board(driver, wheels, target)
            self._attach_serial(f"wheels.{name}", wheels, target, board)
            return
        bus = _bus_of(self.robot, wheels, f"wheels.{name}")
        for number, side in enumerate(SIDES):
            node = self._wheel_node(driver, wheels, number, f"{target}.{side}")
            self._join(bus, f"{target}.{side}", node)
            if isinstance(node, Cia406Encoder):
                self.robot.encoders[f"{name}.{side}"] = node

    def _wheel_board(self, driver: str, wheels: Table, target: str) -> ArduinoBridge | RoboClaw:
        left, right = (self._wheel(side, self._seen(target)) for side in SIDES)
        if driver == "roboclaw":
            return RoboClaw(left, right, address=int(wheels.get("address", 0x80)))
        return ArduinoBridge(left, right, baud_bps=int(wheels.get("baud_bps", 57600)))

    def _wheel_node(self, driver: str, wheels: Table, number: int, target: str) -> CanDevice:
        side = SIDES[number]
        wheel = self._wheel(side, self._seen(target))
        ticks, sign = abs(wheel.ticks_per_turn), 1 if wheel.ticks_per_turn > 0 else -1
        node = int(wheels.get(f"node_{side}", FIRST_NODE[driver] + number))
        if driver == "odrive":
            cpr = int(wheels.get("cpr", 8192))
            generation = "0.5" if str(wheels.get("firmware", "0.6")).startswith("0.5") else "0.6"
            return ODriveAxis(wheel, node, generation=generation, gear=ticks / cpr, sign=sign, cpr=cpr)
        if driver == "vesc":  # a tick is a step of the tachometer
            return Vesc(wheel, node, pole_pairs=1, gear=ticks / STEPS_PER_ELECTRICAL_TURN, sign=sign)
        steps = max(1, round(ticks))
        return Cia406Encoder(
            wheel.scene,
            node,
            wheel=side,
            wheel_radius_m=wheel.radius_m,
            steps_per_turn=steps,
            gear=ticks / steps,
            sign=sign,
            serial=4700 + node,
        )

    def _wheel(self, side: Side, scene: Scene) -> Wheel:
        drive = self.robot.config.get("drive", {})
        radius_m = float(drive.get(f"wheel_radius_{side}_m", 0.10))
        return Wheel(scene, side, radius_m, float(drive.get(f"ticks_per_turn_{side}", 4096.0)))

    def _attach_serial(self, station: str, table: Table, target: str, device: ByteDevice) -> None:
        """Put a device on a pty of its own and its name into the configuration."""
        link = PtyLink(self.folder / station.replace(".", "-"))
        self.attachment.add(station, self.plan.device(target, device) if self.faulty else device, link)
        self.robot.links[station] = link
        table["port"] = str(link.path)

    def _seen(self, target: str) -> Scene:
        return self.plan.scene(target, self.scene) if self.faulty else self.scene

    def _join(self, bus: CanBus, target: str, node: CanDevice) -> None:
        bus.add_node(target, self.plan.node(target, node) if self.faulty else node)


def _bus_of(robot: Robot, device: Table, place: str) -> CanBus:
    name = device.get("can")
    if name not in robot.buses:
        raise PresetError(f"{place}.can: there is no [can.{name}]")
    return robot.buses[name].bus


def _required(device: Table, place: str, drivers: Collection[str]) -> str:
    driver = device.get("driver")
    if driver not in drivers:
        raise PresetError(f"{place}.driver: {', '.join(sorted(drivers))} can be emulated here, not {driver!r}")
    return str(driver)


def _require(device: Table, place: str, driver: str) -> None:
    if device.get("driver") != driver:
        raise PresetError(f"{place}.driver: only {driver!r} can be emulated here, not {device.get('driver')!r}")


def _mount(table: Mapping[str, Any]) -> Mount:
    return Mount(
        float(table.get("x_m", 0.0)),
        float(table.get("y_m", 0.0)),
        float(table.get("z_m", 0.0)),
        math.radians(float(table.get("yaw_deg", 0.0))),
    )


# --- presets ---------------------------------------------------------------------------------------------------------


def artos() -> Table:
    """The robot ARTOS: differential drive, one laser ahead, a chain of eight sonars on each side, two encoders."""
    return {
        "robot": {
            "id": "artos",
            "footprint_m": [[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]],
        },
        "drive": {
            "kind": "differential",
            "source": "drive",
            "wheel_radius_left_m": 0.10,
            "wheel_radius_right_m": 0.10,
            "track_width_m": 0.50,
            "ticks_per_turn_left": 4096.0,
            "ticks_per_turn_right": -4096.0,
        },
        "can": {"main": {"interface": "socketcan", "channel": "can0", "bitrate_bps": 1000000}},
        "lasers": {
            "front": {
                "driver": "hokuyo",
                "port": "/dev/ttyACM0",
                "mount": {"x_m": 0.30, "y_m": 0.0, "z_m": 0.25, "yaw_deg": 0.0},
                "range_max_m": 30.0,
            }
        },
        "sonars": {"left": _chain(0x400, 1.0), "right": _chain(0x420, -1.0)},
        "wheels": {"drive": {"driver": "cia406", "can": "main", "node_left": 0x20, "node_right": 0x21}},
        "sectors": {
            "polar": {
                "laser": {"sources": ["lasers.front"], "sector_deg": 5.0, "start_deg": -120.0, "stop_deg": 120.0},
                "sonar_left": {"sources": ["sonars.left"], "sector_deg": 15.0, "start_deg": 0.0, "stop_deg": 180.0},
                "sonar_right": {"sources": ["sonars.right"], "sector_deg": 15.0, "start_deg": -180.0, "stop_deg": 0.0},
            },
            "rect": {
                "around": {
                    "sources": ["lasers.front", "sonars.left", "sonars.right"],
                    "size_m": [4.0, 4.0],
                    "sector_m": 0.25,
                }
            },
        },
        "grid": {"resolution_m": 0.05, "model": "counters"},
    }


def _chain(base_id: int, side: float) -> Table:
    """Eight transducers along one side, from the front corner to the rear, each looking away from the robot."""
    looks = (11.25, 33.75, 56.25, 78.75, 101.25, 123.75, 146.25, 168.75)
    return {
        "driver": "usboard",
        "can": "main",
        "base_id": base_id,
        "cone_deg": 30.0,
        "range_max_m": 3.0,
        "transducers": [_transducer(k + 1, side * look) for k, look in enumerate(looks)],
    }


def _transducer(channel: int, yaw_deg: float, *, half_length_m: float = 0.44, half_width_m: float = 0.29) -> Table:
    """Where a ray from the middle leaves the body; it looks along that ray."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    reach = min(half_length_m / max(abs(c), 1e-9), half_width_m / max(abs(s), 1e-9))
    return {"channel": channel, "x_m": round(reach * c, 3), "y_m": round(reach * s, 3), "z_m": 0.30, "yaw_deg": yaw_deg}


PRESETS: dict[str, Callable[[], Table]] = {"artos": artos}
LASERS = tuple(PROFILES)


def preset(name: str) -> Table:
    """A preset's configuration. Raises PresetError if there is none of this name."""
    if name not in PRESETS:
        raise PresetError(f"no preset {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]()


def for_log(
    config: Mapping[str, Any], mount: Mount, *, track_width_m: float, rate_hz: float, wheel_m_s: float
) -> Table:
    """A configuration in which only the laser and the wheels are left, as a recorded log knows them.

    mount: the log's laser.  rate_hz, wheel_m_s: how often wheels are asked, and how fast they may turn.
    """
    table = copy.deepcopy(dict(config))
    lasers = table.get("lasers", {})
    if not lasers or not table.get("wheels"):
        raise PresetError("playing a log needs a laser and wheels in the configuration")
    name = sorted(lasers)[0]
    laser = lasers[name]
    laser["mount"] = {
        "x_m": round(mount.x_m, 4),
        "y_m": round(mount.y_m, 4),
        "z_m": mount.z_m,
        "yaw_deg": round(math.degrees(mount.yaw_rad), 6),
    }
    laser.pop("range_max_m", None)
    table["lasers"] = {name: laser}
    table.pop("sonars", None)
    table.setdefault("drive", {})["track_width_m"] = track_width_m
    table["drive"]["max_wheel_speed_m_s"] = wheel_m_s
    for wheels in table["wheels"].values():
        wheels["rate_hz"] = rate_hz
    _keep_sources(table, f"lasers.{name}", name)
    return table


def _keep_sources(table: Table, full: str, short: str) -> None:
    """Sector maps fed by this laser alone; those that nothing feeds any more go."""
    for kind, maps in list(table.get("sectors", {}).items()):
        for name, sectors in list(maps.items()):
            sectors["sources"] = [s for s in sectors.get("sources", []) if s in (full, short)]
            if not sectors["sources"]:
                del maps[name]
        table["sectors"][kind] = maps


# --- TOML ------------------------------------------------------------------------------------------------------------


def to_toml(config: Mapping[str, Any]) -> str:
    """A configuration as TOML, in the order of its keys; small tables such as mounts on one line."""
    lines: list[str] = []
    for key, value in config.items():
        _write_table(lines, key, value)
    return "\n".join(lines).strip() + "\n"


def _write_table(lines: list[str], path: str, table: Mapping[str, Any]) -> None:
    values = {k: v for k, v in table.items() if not _is_section(k, v)}
    if values:
        lines.append(f"[{path}]")
        lines.extend(f"{key} = {_toml_value(key, value)}" for key, value in values.items())
        lines.append("")
    for key, value in table.items():
        if _is_section(key, value):
            _write_table(lines, f"{path}.{key}", value)


def _is_section(key: str, value: Any) -> bool:
    return isinstance(value, dict) and key not in INLINE_TABLES


def _toml_value(key: str, value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return hex(value) if key in ("base_id", "node_left", "node_right") else str(value)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, str):
        return _toml_text(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml_value(k, v)}" for k, v in value.items()) + " }"
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + "".join(f"    {_toml_value(key, v)},\n" for v in value) + "]"
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(key, v) for v in value) + "]"
    raise PresetError(f"{key}: {value!r} cannot be written as TOML")


def _toml_text(text: str) -> str:
    escapes = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}
    return '"' + "".join(escapes.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'
