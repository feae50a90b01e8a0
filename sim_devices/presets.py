"""Whole robots: from a configuration of the daemon to emulated devices that fit it, and back with their ports in it.

A preset is such a configuration; any other that names devices known here does as well. Every laser gets a pty of its
own, every CAN bus an adapter on a pty; both are links with fixed names in one folder. `emulate` returns the running
parts and the configuration in which those names stand.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim_devices.alice import Alice
from sim_devices.attach import Attachment, MemoryLink, TcpLink
from sim_devices.contact import Bumper, Cliff, Contact
from sim_devices.device import ByteDevice, CanDevice, Mount, Scene
from sim_devices.encoder_arduino_bridge import ArduinoBridge, Pin, Sonar
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.encoder_odrive import ODriveAxis
from sim_devices.encoder_roboclaw import RoboClaw
from sim_devices.encoder_vesc import STEPS_PER_ELECTRICAL_TURN, Vesc
from sim_devices.faults import FaultPlan
from sim_devices.laser_hokuyo import LaserProfile
from sim_devices.lasers import FIRST_MODEL, MODELS, make_laser
from sim_devices.mount_nodding import SolidScene, Swing, TiltedScene, angle_encoder
from sim_devices.pty_link import PtyLink
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_maxbotix import FAMILIES, MaxBotix, TextMultiplexer
from sim_devices.sonar_usboard import ANALOG_ON, Transducer, UsBoard, UsBoardCan, UsBoardSerial, default_parameters
from sim_devices.udp_link import UdpLink
from sim_devices.wheel import Side, Wheel

if TYPE_CHECKING:  # pymavlink is for robots with an autopilot only
    from sim_devices.mavlink_autopilot import MavlinkAutopilot

Table = dict[str, Any]

SIDES: tuple[Side, Side] = ("left", "right")
BRIDGE = "arduino-bridge"
MAVLINK = "mavlink"
FIRST_NODE = {"cia406": 0x20, "odrive": 0, "vesc": 1}  # one node a wheel on a CAN bus
WHEEL_DRIVERS = (BRIDGE, "roboclaw", MAVLINK, *FIRST_NODE)
SONAR_DRIVERS = ("usboard", "usboard-serial", "maxbotix", BRIDGE, MAVLINK)
TICK_LIMITED = (BRIDGE, "roboclaw", "vesc")  # their limit of speed is max_ticks_per_s, others' max_turns_per_s

HOST = "host"  # the daemon's adapter on every bus
INLINE_TABLES = frozenset({"mount", "arm", "pose", "tls"})
NODS = Swing(period_s=4.0, middle_rad=0.15, swing_rad=0.6)
TURNS = Swing(period_s=4.0, turning=True)


class PresetError(ValueError):
    """A configuration that no emulated robot fits; the text names the key and the repair."""


@dataclass(slots=True)
class Robot:
    """An emulated robot on its wires.

    config: the daemon's configuration for it.  links: every pty, TCP or UDP port, under its station's name
    ("lasers.front", "can.main").  buses, lasers, sonars, encoders: by their names in the configuration (encoders as
    "drive.left").  autopilots: by their stations' names.
    """

    config: Table
    links: dict[str, PtyLink | TcpLink | UdpLink | MemoryLink] = field(default_factory=dict)
    buses: dict[str, CanBusStation] = field(default_factory=dict)
    lasers: dict[str, ByteDevice] = field(default_factory=dict)
    sonars: dict[str, UsBoard] = field(default_factory=dict)
    encoders: dict[str, Cia406Encoder] = field(default_factory=dict)
    autopilots: dict[str, MavlinkAutopilot] = field(default_factory=dict)

    def was_spoken_to(self) -> bool:
        """Whether a host has sent anything on any wire yet."""
        return any(link.counters.received_bytes for link in self.links.values())


def emulate(
    config: Mapping[str, Any],
    scene: Scene,
    attachment: Attachment,
    folder: Path,
    *,
    laser: str | None = None,
    profile: LaserProfile | None = None,
    exact: bool = False,
    seed: int = 0,
    plan: FaultPlan | None = None,
    in_memory: bool = False,
) -> Robot:
    """Attach an emulated device for each device of a configuration, and say where.

    folder: where the ptys' links stand.  laser: model of all lasers, whatever the configuration says; default: the
    first of each laser's driver.  profile: of a Hokuyo that is no model.  exact: no noise on lasers (recorded ranges
    have theirs).  plan: faults; its targets are laser.NAME, sonar.NAME, contact.NAME.LINE, encoder.left and
    .right, bus.NAME, and adapter.NAME, the daemon's port on that bus; mount.NAME, the encoder of a mount; autopilot, or
    autopilot.1, .2 if there are several.  in_memory: wires within this process instead of ptys and sockets, under the
    same names.  Raises PresetError for a device that cannot be emulated.
    """
    robot = Robot(copy.deepcopy(dict(config)))
    builder = _Builder(robot, scene, attachment, folder, plan or FaultPlan(seed=seed), plan is not None, in_memory)
    for name, bus in robot.config.get("can", {}).items():
        builder.add_bus(name, bus)
    for k, (name, table) in enumerate(sorted(robot.config.get("lasers", {}).items())):
        builder.add_laser(name, table, laser, profile, exact=exact, seed=seed + k, number=k)
    for k, (name, sonar) in enumerate(sorted(robot.config.get("sonars", {}).items())):
        builder.add_sonar(name, sonar, seed=seed + 100 + k)
    for k, (name, contacts) in enumerate(sorted(robot.config.get("contacts", {}).items())):
        builder.add_usboard_contacts(name, contacts, seed=seed + 200 + k)
    for name, wheels in robot.config.get("wheels", {}).items():
        builder.add_wheels(name, wheels)
    for name, mount in robot.config.get("mounts", {}).items():
        builder.add_mount(name, mount)
    for name, ring in robot.config.get("rings", {}).items():
        builder.add_ring(name, ring, seed=seed)
    for port in builder.bridge_ports():
        builder.add_bridge(port)
    ports = builder.autopilot_ports()
    for k, port in enumerate(ports, 1):
        builder.add_autopilot(port, "autopilot" if len(ports) == 1 else f"autopilot.{k}")
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
    in_memory: bool
    _joined: set[str] = field(default_factory=set)  # tables of switches that are on a board with sonars

    def add_bus(self, name: str, bus: Table) -> None:
        can = CanBus(bitrate_bps=int(bus.get("bitrate_bps", 1000000)))
        station = CanBusStation(can)
        link = self._line(f"can-{name}")
        adapter = station.add_member(HOST, link)
        if self.faulty:
            station.wrap_member(HOST, self.plan.device(f"adapter.{name}", adapter))
            self.plan.bus(f"bus.{name}", can)
        self.attachment.add_station(f"can.{name}", station)
        self.robot.buses[name], self.robot.links[f"can.{name}"] = station, link
        bus["interface"], bus["channel"] = "slcan", str(link.path)

    def add_laser(
        self,
        name: str,
        laser: Table,
        model: str | None,
        profile: LaserProfile | None,
        *,
        exact: bool,
        seed: int,
        number: int,
    ) -> None:
        driver = _required(laser, f"lasers.{name}", FIRST_MODEL)
        model = model or FIRST_MODEL[driver]
        if MODELS[model] != driver:  # another kind than configured: only where it sits stays as it was
            mount = laser.get("mount", {})
            laser.clear()
            laser |= {"driver": MODELS[model], "mount": mount}
        target = f"laser.{name}"
        on_tcp = MODELS[model] == "sick_cola" or str(laser.get("port", "")).startswith("tcp:")
        tilted = self._tilted(name)
        device = make_laser(
            model,
            self._seen(target, tilted and tilted[0]),
            tilted[1] if tilted else _mount(laser.get("mount", {})),
            seed=seed,
            number=number,
            exact=exact,
            profile=profile,
            on_tcp=on_tcp,
        )
        link = TcpLink(0) if on_tcp and not self.in_memory else self._line(f"laser-{name}")
        faulty = self.plan.device(target, device, on_network=on_tcp) if self.faulty else device
        self.attachment.add(f"lasers.{name}", faulty, link)
        self.robot.lasers[name], self.robot.links[f"lasers.{name}"] = device, link
        if isinstance(link, TcpLink):
            laser["port"] = f"tcp://{link.host}:{link.port}"
        elif not on_tcp:
            laser["port"] = str(link.path)

    def add_sonar(self, name: str, sonar: Table, *, seed: int) -> None:
        driver = _required(sonar, f"sonars.{name}", SONAR_DRIVERS)
        if driver in (BRIDGE, MAVLINK):
            return  # see add_bridge and add_autopilot
        target = f"sonar.{name}"
        if driver == "maxbotix":
            device = self._maxbotix(sonar, self._seen(target), f"sonars.{name}", seed)
            self._attach_serial(f"sonars.{name}", f"sonar-{name}", [sonar], target, device)
            return
        switches = self._contacts_on(sonar)
        board = self.robot.sonars[name] = self._usboard(sonar, self._seen(target), switches, seed)
        if driver == "usboard":
            self._join(_bus_of(self.robot, sonar, f"sonars.{name}"), target, UsBoardCan(board))
        else:
            tables = [sonar, *(self.robot.config["contacts"][each] for each in switches)]
            self._attach_serial(f"sonars.{name}", f"sonar-{name}", tables, target, UsBoardSerial(board))

    def add_usboard_contacts(self, name: str, contacts: Table, *, seed: int) -> None:
        """A USBoard that has switches only; those of boards with sonars are there already."""
        driver = contacts.get("driver")
        if driver not in ("usboard", "usboard-serial") or name in self._joined:
            return
        target = f"contact.{name}"
        board = self._usboard(contacts, self._seen(target), [name], seed)
        if driver == "usboard":
            self._join(_bus_of(self.robot, contacts, f"contacts.{name}"), target, UsBoardCan(board))
        else:
            self._attach_serial(f"contacts.{name}", f"contact-{name}", [contacts], target, UsBoardSerial(board))

    def _contacts_on(self, sonar: Table) -> list[str]:
        """The switches at the inputs of the board that these sonars are on: at most one table of them."""
        keys = ("driver", "can", "base_id") if sonar["driver"] == "usboard" else ("driver", "port")
        board = [sonar.get(key, 0x400 if key == "base_id" else None) for key in keys]
        found = [
            name
            for name, each in self.robot.config.get("contacts", {}).items()
            if [each.get(key, 0x400 if key == "base_id" else None) for key in keys] == board
        ]
        self._joined.update(found)
        return found[:1]

    def _usboard(self, table: Table, scene: Scene, contacts: list[str], seed: int) -> UsBoard:
        half_angle_rad = _half_cone_rad(table)
        transducers = {channel: Transducer(m, half_angle_rad) for channel, m in _transducer_mounts(table).items()}
        base_id = int(table.get("base_id", 0x400))
        parameters = bytearray(default_parameters(base_id, serial=20000 + base_id))
        if contacts:
            parameters[5] |= ANALOG_ON
        switches = self._switches(contacts[0]) if contacts else {}
        return UsBoard(scene, transducers, parameters=bytes(parameters), switches=switches, seed=seed)

    def _maxbotix(self, sonar: Table, scene: Scene, place: str, seed: int) -> MaxBotix | TextMultiplexer:
        """One sensor or several behind a multiplexer; the rate in the configuration becomes what they can do."""
        mounts = _transducer_mounts(sonar) or {1: Mount()}
        family = str(sonar.get("family", "hr-5m"))
        if family not in FAMILIES:
            raise PresetError(f"{place}.family: no {family!r}; there are {', '.join(FAMILIES)}")
        lines, half_angle_rad = str(sonar.get("lines", "single")), _half_cone_rad(sonar)
        baud_bps = int(sonar.get("baud_bps", 9600))
        if lines == "single":
            first = mounts[min(mounts)]
            sonar["rate_hz"] = round(1e9 / FAMILIES[family].period_ns, 2)
            return MaxBotix(scene, first, family=family, half_angle_rad=half_angle_rad, baud_bps=baud_bps, seed=seed)
        if lines == "list" and sorted(mounts) != list(range(1, len(mounts) + 1)):
            raise PresetError(f"{place}.transducers: a list has channels 1 to {len(mounts)}, each in its place")
        several = TextMultiplexer(
            scene, mounts, family=family, half_angle_rad=half_angle_rad, baud_bps=baud_bps, lines=lines, seed=seed
        )
        sonar["rate_hz"] = round(several.rate_hz, 2)
        return several

    # -- boards with the sketch of ros_arduino_bridge: wheels and sonars that name the same port are one board ---------

    def bridge_ports(self) -> list[str]:
        """The ports of such boards, as the configuration names them."""
        return list(dict.fromkeys(str(table.get("port")) for _, _, table in self._members(BRIDGE)))

    def add_bridge(self, port: str) -> None:
        members = [member for member in self._members(BRIDGE) if str(member[2].get("port")) == port]
        tables = [table for _, _, table in members]
        wheels = [name for section, name, _ in members if section == "wheels"]
        sonars = [name for section, name, _ in members if section == "sonars"]
        contacts = [name for section, name, _ in members if section == "contacts"]
        if max(len(wheels), len(sonars), len(contacts)) > 1:
            raise PresetError(f"{port}: a board has one pair of wheels, one set of sonars and one of switches")
        pins = {
            pin: Sonar(mount, _half_cone_rad(table), range_max_m=float(table.get("range_max_m", 3.0)))
            for table in tables
            for pin, mount in _transducer_mounts(table).items()
        }
        own = f"sonar.{sonars[0]}" if sonars else f"contact.{contacts[0]}" if contacts else ""
        target = self._wheels_target(wheels[0]) if wheels else own
        pair = self._wheel_pair(self._seen(target)) if wheels else (None, None)
        switches = self._switches(contacts[0]) if contacts else {}
        baud_bps = int(tables[0].get("baud_bps", 57600))
        board = ArduinoBridge(*pair, sonars=pins, pins=switches, baud_bps=baud_bps)
        if sonars:
            board.see(self._seen(f"sonar.{sonars[0]}"))
        section, name = next((section, name) for section, name, _ in sorted(members, key=_first_wheels))
        place = f"{section}.{name}"
        self._attach_serial(place, place.replace(".", "-"), tables, target, board)

    def _switches(self, name: str) -> dict[int, Pin]:
        """Lines of bumpers that feel this scene, and of cliff switches above its floor."""
        lines: dict[int, Pin] = {}
        for each in self.robot.config["contacts"][name]["switches"]:
            line, mount = int(each["line"]), _mount(each)
            target = f"contact.{name}.{line}"
            is_cliff = each.get("kind") == "cliff"
            scene = self._seen(target)
            touch = Cliff(scene, mount) if is_cliff else Bumper(scene, mount, width_m=float(each.get("width_m", 0.2)))
            contact = Contact(touch, normally_closed=each.get("tripped", "high") == "high", seed=line)
            lines[line] = (self.plan.contact(target, contact) if self.faulty else contact).level
        return lines

    def _members(self, driver: str) -> list[tuple[str, str, Table]]:
        """Section, name and table of everything that hangs on boards with this driver."""
        return [
            (section, name, table)
            for section in ("wheels", "sonars", "contacts", "poses")
            for name, table in self.robot.config.get(section, {}).items()
            if table.get("driver") == driver
        ]

    # -- autopilots: wheels, sonars and the map that is sent to one, where they name the same port ---------------------

    def autopilot_ports(self) -> list[str]:
        """The ports of autopilots, as the configuration names them."""
        return list(dict.fromkeys(str(table.get("port")) for table in self._autopilot_tables()))

    def _autopilot_tables(self) -> list[Table]:
        tables = [table for _, _, table in self._members(MAVLINK)]
        sending = self.robot.config.get("mavlink", {})
        if sending.get("enabled"):
            sending.setdefault("port", "udpout:127.0.0.1:14550")
            tables.append(sending)
        return tables

    def add_autopilot(self, port: str, target: str) -> None:
        from sim_devices.mavlink_autopilot import MavlinkAutopilot, Rangefinder

        here = [(section, table) for section, _, table in self._members(MAVLINK) if str(table.get("port")) == port]
        wheels = next((table for section, table in here if section == "wheels"), {})
        sonars = next((table for section, table in here if section == "sonars"), {})
        finders = [
            Rangefinder(
                channel - 1,
                mount,
                min_cm=max(1, round(100.0 * float(sonars.get("range_min_m", 0.02)))),
                max_cm=round(100.0 * float(sonars.get("range_max_m", 3.0))),
                half_angle_rad=_half_cone_rad(sonars),
            )
            for channel, mount in sorted(_transducer_mounts(sonars).items())
        ]
        tables = [table for table in self._autopilot_tables() if str(table.get("port")) == port]
        on_udp = port.startswith("udp")
        pilot = MavlinkAutopilot(
            self._seen(target),
            system=next((int(t[key]) for t in tables for key in ("system", "system_id") if t.get(key)), 1),
            line_rate_bps=None if on_udp else int(tables[0].get("baud_bps", 57600)),
            rangefinders=finders,
            wheels=(int(wheels.get("wheel_left", 0)), int(wheels.get("wheel_right", 1))),
            track_width_m=float(self.robot.config.get("drive", {}).get("track_width_m", 0.5)),
        )
        self.robot.autopilots[target] = pilot
        if not on_udp:
            self._attach_serial(target, target.replace(".", "-"), tables, target, pilot)
            return
        link: UdpLink | MemoryLink
        if self.in_memory:
            link = MemoryLink(path=self.folder / target)
        else:
            link = UdpLink(int(port.rpartition(":")[2]) if port.startswith("udpin") else None)
        if port.startswith("udpout") and isinstance(link, UdpLink):
            for table in tables:
                table["port"] = f"udpout:{link.host}:{link.port}"
        faulty = self.plan.device(target, pilot, on_network=True) if self.faulty else pilot
        self.attachment.add(target, faulty, link)
        self.robot.links[target] = link

    # -- wheels -------------------------------------------------------------------------------------------------------

    def add_wheels(self, name: str, wheels: Table) -> None:
        driver = _required(wheels, f"wheels.{name}", WHEEL_DRIVERS)
        target = self._wheels_target(name)
        if driver in (BRIDGE, MAVLINK):
            return  # see add_bridge and add_autopilot
        if driver == "roboclaw":
            first, second = self._wheel_pair(self._seen(target))
            if int(wheels.get("left_motor", 1)) == 2:
                first, second = second, first
            board = RoboClaw(first, second, address=int(wheels.get("address", 0x80)))
            self._attach_serial(f"wheels.{name}", f"wheels-{name}", [wheels], target, board)
            return
        bus = _bus_of(self.robot, wheels, f"wheels.{name}")
        for number, side in enumerate(SIDES):
            node = self._wheel_node(driver, wheels, number, f"{target}.{side}")
            self._join(bus, f"{target}.{side}", node)
            if isinstance(node, Cia406Encoder):
                self.robot.encoders[f"{name}.{side}"] = node

    def add_ring(self, name: str, ring: Table, *, seed: int) -> None:
        """ALICE, in a room of its own: it drives by itself, whatever the world."""
        _required(ring, f"rings.{name}", ("alice",))
        self._attach_serial(f"rings.{name}", f"rings-{name}", [ring], "ring", Alice(seed=seed))

    def _wheels_target(self, name: str) -> str:
        return "encoder" if len(self.robot.config["wheels"]) == 1 else f"encoder.{name}"

    def _wheel_pair(self, scene: Scene) -> tuple[Wheel, Wheel]:
        return self._wheel("left", scene), self._wheel("right", scene)

    def _wheel_node(self, driver: str, wheels: Table, number: int, target: str) -> CanDevice:
        side = SIDES[number]
        wheel = self._wheel(side, self._seen(target))
        ticks, sign = abs(wheel.ticks_per_turn), 1 if wheel.ticks_per_turn > 0 else -1
        key = "id" if driver == "vesc" else "node"
        node = int(wheels.get(f"{key}_{side}", FIRST_NODE[driver] + number))
        if driver == "odrive":
            cpr = int(wheels.get("counts_per_turn", 8192))
            generation = "0.5" if wheels.get("firmware") == "0.5" else "0.6"
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

    def _attach_serial(self, station: str, file: str, tables: list[Table], target: str, device: ByteDevice) -> None:
        """Put a device on a pty of its own and its name into the configuration."""
        link = self._line(file)
        self.attachment.add(station, self.plan.device(target, device) if self.faulty else device, link)
        self.robot.links[station] = link
        for table in tables:
            table["port"] = str(link.path)

    def _line(self, file: str) -> PtyLink | MemoryLink:
        """A serial line under a name of its own."""
        path = self.folder / file
        return MemoryLink(path=path) if self.in_memory else PtyLink(path)

    def _seen(self, target: str, scene: Scene | None = None) -> Scene:
        scene = scene or self.scene
        return self.plan.scene(target, scene) if self.faulty else scene

    # -- mounts -------------------------------------------------------------------------------------------------------

    def _tilted(self, laser: str) -> tuple[Scene, Mount] | None:
        """What a laser on a mount sees, and where the axle is; None for one that stands level."""
        mounts: dict[str, Table] = self.robot.config.get("mounts", {})
        name = next((name for name, table in mounts.items() if table.get("laser") == laser), None)
        if name is None:
            return None
        if not isinstance(self.scene, SolidScene):
            raise PresetError(f"mounts.{name}: what is played knows no heights; use a world")
        table, arm = mounts[name], mounts[name].get("arm", {})
        if any(float(arm.get(key, 0.0)) for key in ("pitch_deg", "yaw_deg")):
            raise PresetError(f"mounts.{name}.arm: a laser can be emulated that is rolled, not pitched or yawed")
        scene = TiltedScene(
            self.scene,
            _swing(table),
            table.get("axle", "pitch"),
            (float(arm.get("x_m", 0.0)), float(arm.get("y_m", 0.0)), float(arm.get("z_m", 0.0))),
            math.radians(float(arm.get("roll_deg", 0.0))),
        )
        return scene, _mount(table.get("mount", {}))

    def add_mount(self, name: str, mount: Table) -> None:
        """The encoder on its axle; the laser on it is added like any other."""
        _required(mount, f"mounts.{name}", ("cia406",))
        target = f"mount.{name}"
        counts = float(mount.get("counts_per_turn", 4096.0))
        zero_rad = math.radians(float(mount.get("zero_deg", 0.0)))
        swing = replace(_swing(mount), middle_rad=_swing(mount).middle_rad - zero_rad)  # the count is 0 at zero_deg
        node = angle_encoder(
            self._seen(target),
            swing,
            int(mount.get("node", 0x30)),
            steps_per_turn=max(1, round(abs(counts))),
            sign=1 if counts > 0 else -1,
        )
        self._join(_bus_of(self.robot, mount, f"mounts.{name}"), target, node)
        self.robot.encoders[name] = node

    def _join(self, bus: CanBus, target: str, node: CanDevice) -> None:
        bus.add_node(target, self.plan.node(target, node) if self.faulty else node)


def _first_wheels(member: tuple[str, str, Table]) -> int:
    return ("wheels", "sonars", "contacts", "poses").index(member[0])


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


def _swing(mount: Table) -> Swing:
    return TURNS if mount.get("motion") == "turns" else NODS


def _half_cone_rad(sonar: Table) -> float:
    return math.radians(float(sonar.get("cone_deg", 30.0))) / 2.0


def _transducer_mounts(sonar: Table) -> dict[int, Mount]:
    return {int(t["channel"]): _mount(t) for t in sonar.get("transducers", [])}


def _mount(table: Mapping[str, Any]) -> Mount:
    return Mount(
        float(table.get("x_m", 0.0)),
        float(table.get("y_m", 0.0)),
        float(table.get("z_m", 0.0)),
        math.radians(float(table.get("yaw_deg", 0.0))),
        bool(table.get("upside_down", False)),
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


def nodding() -> Table:
    """ARTOS with a second laser on a mast, which nods: clouds of points, and planes in them."""
    table = artos()
    table["robot"]["id"] = "nodding"
    table["lasers"]["tilt"] = {"driver": "hokuyo", "port": "/dev/ttyACM1", "range_max_m": 30.0}
    table["mounts"] = {
        "mast": {
            "driver": "cia406",
            "can": "main",
            "node": 0x30,
            "laser": "tilt",
            "axle": "pitch",
            "motion": "nods",
            "mount": {"x_m": 0.10, "y_m": 0.0, "z_m": 0.90, "yaw_deg": 0.0},
            "arm": {"x_m": 0.06, "z_m": 0.04},
            "counts_per_turn": 4096.0,
        }
    }
    return table


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


def two_wheeler() -> Table:
    """A small robot off the shelf: an LD06 on top, an Arduino that counts, drives and pings, all on USB."""
    port = "/dev/ttyUSB0"
    pings = [_transducer(pin, yaw, half_length_m=0.15, half_width_m=0.11) for pin, yaw in ((7, 30.0), (8, -30.0))]
    sonars = {"driver": BRIDGE, "port": port, "cone_deg": 30.0, "range_max_m": 3.0, "transducers": pings}
    laser = {"driver": "ldrobot", "port": "/dev/ttyUSB1", "mount": {"x_m": 0.0, "y_m": 0.0, "z_m": 0.18}}
    table = _small("two_wheeler", laser, {"driver": BRIDGE, "port": port}, ticks_per_turn=1320.0)
    table["sonars"] = {"front": sonars}
    table["sectors"]["rect"]["around"]["sources"].append("sonars.front")
    return table


def roboclaw() -> Table:
    """A robot with an RPLIDAR and a RoboClaw."""
    laser = {"driver": "rplidar", "port": "/dev/ttyUSB0", "mount": {"x_m": 0.05, "y_m": 0.0, "z_m": 0.20}}
    wheels = {"driver": "roboclaw", "port": "/dev/ttyACM0", "address": 0x80}
    return _small("roboclaw", laser, wheels, ticks_per_turn=2797.0)


def odrive() -> Table:
    """A robot with hub motors on an ODrive, and a Hokuyo."""
    laser = {"driver": "hokuyo", "port": "/dev/ttyACM0", "mount": {"x_m": 0.12, "y_m": 0.0, "z_m": 0.20}}
    wheels = {"driver": "odrive", "can": "main", "node_left": 0, "node_right": 1, "counts_per_turn": 8192}
    table = _small("odrive", laser, wheels, ticks_per_turn=8192.0)
    table["can"] = {"main": {"interface": "socketcan", "channel": "can0", "bitrate_bps": 250000}}
    return table


def autopilot() -> Table:
    """A rover: an autopilot counts its wheels, pings and is told of obstacles; an RPLIDAR on top."""
    port = "/dev/ttyACM0"
    laser = {"driver": "rplidar", "port": "/dev/ttyUSB0", "mount": {"x_m": 0.0, "y_m": 0.0, "z_m": 0.20}}
    micrometres = round(2.0 * math.pi * 0.0325 * 1e6, 3)  # a tick of an autopilot's wheel
    table = _small("autopilot", laser, {"driver": MAVLINK, "port": port}, ticks_per_turn=micrometres)
    pings = [_transducer(k, yaw, half_length_m=0.15, half_width_m=0.11) for k, yaw in ((1, 0.0), (2, 180.0))]
    table["sonars"] = {
        "ends": {"driver": MAVLINK, "port": port, "cone_deg": 30.0, "range_max_m": 4.0, "transducers": pings}
    }
    table["sectors"]["rect"]["around"]["sources"].append("sonars.ends")
    table["mavlink"] = {"enabled": True, "map": "laser", "port": "udpout:127.0.0.1:14550"}
    return table


def _small(name: str, laser: Table, wheels: Table, *, ticks_per_turn: float) -> Table:
    """What the small robots share: the body, one laser that sees all round, the usual maps."""
    return {
        "robot": {"id": name, "footprint_m": [[0.16, 0.12], [-0.16, 0.12], [-0.16, -0.12], [0.16, -0.12]]},
        "drive": {
            "kind": "differential",
            "source": "drive",
            "wheel_radius_left_m": 0.0325,
            "wheel_radius_right_m": 0.0325,
            "track_width_m": 0.20,
            "ticks_per_turn_left": ticks_per_turn,
            "ticks_per_turn_right": ticks_per_turn,
        },
        "lasers": {"front": laser},
        "wheels": {"drive": wheels},
        "sectors": {
            "polar": {
                "laser": {"sources": ["lasers.front"], "sector_deg": 5.0, "start_deg": -180.0, "stop_deg": 180.0}
            },
            "rect": {"around": {"sources": ["lasers.front"], "size_m": [4.0, 4.0], "sector_m": 0.25}},
        },
        "grid": {"resolution_m": 0.05, "model": "counters"},
    }


def alice() -> Table:
    """ALICE: light and touch around a synchro drive; no range sensor, so no grid."""
    corners = [(0.15 * math.cos(a), 0.15 * math.sin(a)) for a in (k * math.pi / 6.0 for k in range(12))]
    return {
        "robot": {"id": "alice", "footprint_m": [[round(x, 3), round(y, 3)] for x, y in corners]},
        "rings": {"body": {"driver": "alice", "port": "/dev/ttyUSB0"}},
        "grid": {"enabled": False},
    }


def hurry(config: Table, speed: float) -> None:
    """Let the daemon believe wheels that turn so many times faster than in real time."""
    config.setdefault("drive", {})["max_wheel_speed_m_s"] = 5.0 * speed
    for wheels in config.get("wheels", {}).values():
        if wheels.get("driver") == MAVLINK:
            continue  # has no such limit
        limit, value = ("max_ticks_per_s", 2e5) if wheels.get("driver") in TICK_LIMITED else ("max_turns_per_s", 20.0)
        wheels[limit] = max(float(wheels.get(limit, 0.0)), value) * speed


PRESETS: dict[str, Callable[[], Table]] = {
    "artos": artos,
    "nodding": nodding,
    "two_wheeler": two_wheeler,
    "roboclaw": roboclaw,
    "odrive": odrive,
    "autopilot": autopilot,
    "alice": alice,
}


def preset(name: str) -> Table:
    """A preset's configuration. Raises PresetError if there is none of this name."""
    if name not in PRESETS:
        raise PresetError(f"no preset {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]()


def for_log(
    config: Mapping[str, Any], mount: Mount, *, track_width_m: float, rate_hz: float, wheel_m_s: float
) -> Table:
    """A configuration in which only the laser and the wheels are left, as a recorded log knows them.

    What the laser does not hear proves no free space: `umfeld map build` reads logs alike.

    mount: the log's laser.  rate_hz, wheel_m_s: how often wheels are asked, and how fast they may turn.
    """
    table = copy.deepcopy(dict(config))
    lasers = table.get("lasers", {})
    if not lasers or not table.get("wheels"):
        raise PresetError("playing a log needs a laser and wheels in the configuration")
    name = sorted(lasers)[0]
    laser: Table = lasers[name]
    if laser.get("driver") != "hokuyo":  # the one whose steps can be those of any log
        laser = {"driver": "hokuyo", "port": laser.get("port", "")}
    laser["mount"] = {
        "x_m": round(mount.x_m, 4),
        "y_m": round(mount.y_m, 4),
        "z_m": mount.z_m,
        "yaw_deg": round(math.degrees(mount.yaw_rad), 6),
    }
    laser.pop("range_max_m", None)
    laser["no_echo"] = "unknown"  # in a log it may be glass or a dark surface as well as nothing
    table["lasers"] = {name: laser}
    table.pop("sonars", None)
    table.pop("mounts", None)
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
