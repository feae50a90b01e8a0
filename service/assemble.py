"""Configuration to parts: wires with their conversations, sensors with their places, maps. The maps of the slow thread
are in assemble_makers.

Drivers are imported when a configuration names them, so that a robot without a CAN bus never loads one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.conversation import Conversation
from drivers.ports import Clock, Port, Tap
from drivers.reader import Sink, WireReader
from drivers.readings import (
    ChainReading,
    ContactReading,
    PoseReading,
    Reading,
    WheelReading,
)
from mapping.frames import Pose2, Pose3
from mapping.odometry import DriveGeometry
from mapping.planes.cloud import TiltMount
from service.config import Config
from service.config_base import PlanePose
from service.config_devices import (
    SERIAL_NUMBER,
    SHARED_DRIVERS,
    AliceRing,
    ArduinoContacts,
    ArduinoSonars,
    ArduinoWheels,
    CanBus,
    Cia406Mount,
    Cia406Wheels,
    Device,
    Drive,
    HokuyoLaser,
    LdrobotLaser,
    MavlinkPose,
    MavlinkSonars,
    MavlinkWheels,
    MaxBotixSonars,
    Mount,
    ODriveWheels,
    RoboClawWheels,
    RplidarLaser,
    SickColaLaser,
    SickLms2xxLaser,
    UsBoardContacts,
    UsBoardSerialContacts,
    UsBoardSerialSonars,
    UsBoardSonars,
    VescWheels,
    tcp_address,
)
from service.fusion import SECTOR_MEMORY_NS, GridLayer, Localiser, OdometryOnly, Parts, SectorLayer, StoredTile
from service.mounts import MountSettings, TiltingLaser
from service.sensors import (
    AxleEncoder,
    Chain,
    Contacts,
    Laser,
    PoseSource,
    Ring,
    Sensor,
    Switch,
    Transducer,
    Wheels,
)

if TYPE_CHECKING:
    from drivers.encoder_arduino_bridge import ArduinoBridgeConversation
    from drivers.mavlink_in import MavlinkConversation
    from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation
    from service.background import Submit
    from service.layers import ArtosLayer, BuildingLayer, PolarLayer, RectLayer
    from service.map_localiser import KnownMapLayer
    from service.mavlink_out import MavlinkOut
    from service.redraw import OnRedrawn
    from service.rpc import Handler


@dataclass(frozen=True, slots=True)
class Wire:
    """One wire and who is on it. port: the serial port behind it, None for a bus of the system or a network address."""

    name: str
    port: str | None
    open_port: Callable[[Clock], Port[Any]]
    conversations: Mapping[str, Callable[[], Conversation[Any]]]

    def reader(self, sink: Sink, clock: Clock, tap: Tap | None = None) -> WireReader[Any]:
        """A reader for this wire; call start() on it."""
        conversations = {name: make() for name, make in self.conversations.items()}
        return WireReader(self.name, partial(self.open_port, clock), conversations, sink, clock=clock, tap=tap)


def wires(config: Config) -> list[Wire]:
    """Every wire of a configuration, each once, with the conversations on it by source name."""
    return [*_serial_wires(config), *_can_wires(config)]


def sensors(config: Config) -> dict[str, Sensor]:
    """Every source by its name: what fusion must know of it."""
    found: dict[str, Sensor] = {}
    for section, name, device in config.devices():
        source = config.source_name(section, name)
        found[source] = _sensor_of(source, device)
    for mount in config.mounts.values():
        laser = found[mount.laser]
        assert isinstance(laser, Laser)
        found[mount.laser] = replace(laser, tilts=True)
    return found


def pose_of(place: Mount | PlanePose) -> Pose2:
    """A mounting in the base frame."""
    return Pose2(place.x_m, place.y_m, math.radians(place.yaw_deg))


# --- wires ------------------------------------------------------------------------------------------------------------


def _serial_wires(config: Config) -> Iterator[Wire]:
    members: dict[str, dict[str, Device]] = {}
    for section, name, device in config.devices():
        port = device.serial_port()
        if port is not None:
            members.setdefault(port, {})[config.source_name(section, name)] = device
    for port, devices in members.items():
        source, device = next(iter(devices.items()))
        baud = getattr(device, "baud_bps", None) or _FIRST_BAUD.get(type(device), 115200)
        address = tcp_address(port)
        if address is not None:
            yield Wire(source, None, partial(_open_tcp, *address), _talks(devices))
        elif port.startswith(_UDP):
            yield Wire(source, None, partial(_open_udp, port), _talks(devices))
        elif port.startswith(SERIAL_NUMBER):
            looked_for = _ByNumber(port, str(getattr(device, "driver", "")), config.search.ports)
            yield Wire(source, None, partial(_open_found, looked_for, baud, _stops_by_dtr(device)), _talks(devices))
        else:
            yield Wire(source, port, partial(_open_serial, port, baud, _stops_by_dtr(device)), _talks(devices))


def _talks(devices: Mapping[str, Device]) -> Mapping[str, Callable[[], Conversation[Any]]]:
    """Makers of the conversations on one serial port; of a board that is several sources they share the board."""
    is_one = len(devices) == 1 or not any(getattr(each, "driver", None) in SHARED_DRIVERS for each in devices.values())
    if is_one:
        return {source: partial(conversation_of, device) for source, device in devices.items()}
    made: dict[str, Conversation[Any]] = {}

    def make(source: str) -> Conversation[Any]:
        if source not in made:
            made.update(_shares_of(devices))
        return made.pop(source)

    return {source: partial(make, source) for source in devices}


def _shares_of(devices: Mapping[str, Device]) -> dict[str, Conversation[Any]]:
    """One new board or autopilot as the sources that it is."""
    from drivers.shares import share_out

    kinds: dict[str, type[Reading]] = {source: _reading_of(device) for source, device in devices.items()}
    if any(isinstance(device, MavlinkWheels | MavlinkSonars | MavlinkPose) for device in devices.values()):
        return share_out(_mavlink(list(devices.values())), kinds)
    if any(isinstance(device, _USBOARD) for device in devices.values()):
        return share_out(_usboard(list(devices.values())), kinds)
    return share_out(_arduino_board(list(devices.values())), kinds)


def _reading_of(device: Device) -> type[Reading]:
    """What a source on a shared board says."""
    match device:
        case ArduinoWheels() | MavlinkWheels():
            return WheelReading
        case ArduinoContacts() | UsBoardContacts() | UsBoardSerialContacts():
            return ContactReading
        case MavlinkPose():
            return PoseReading
    return ChainReading


def _arduino_board(devices: Sequence[Device]) -> ArduinoBridgeConversation:
    from drivers.encoder_arduino_bridge import ArduinoBridgeConversation

    settings: dict[str, Any] = {"wheels": False}
    for device in devices:
        if isinstance(device, ArduinoWheels):
            settings |= {
                "wheels": True,
                "wheel_rate_hz": device.rate_hz,
                "max_ticks_per_s": device.max_ticks_per_s,
                "baud_bps": device.baud_bps,
            }
        elif isinstance(device, ArduinoSonars):
            settings |= {
                "pings": [each.channel for each in device.transducers],
                "ping_rate_hz": device.rate_hz,
                "ping_range_max_m": device.range_max_m,
                "zero_is_free": device.zero_is_free,
                "baud_bps": device.baud_bps,
            }
        elif isinstance(device, ArduinoContacts):
            settings |= {
                "contacts": {switch.line: switch.tripped == "low" for switch in device.switches},
                "contact_rate_hz": device.rate_hz,
                "baud_bps": device.baud_bps,
            }
    return ArduinoBridgeConversation(**settings)


def _mavlink(devices: Sequence[Device]) -> MavlinkConversation:
    from drivers.mavlink_in import MavlinkConversation

    kinds: list[type[Reading]] = []
    settings: dict[str, Any] = {}
    for device in devices:
        if not isinstance(device, MavlinkSonars | MavlinkWheels | MavlinkPose):
            continue
        on_udp = device.port.startswith(_UDP)
        settings["baud_bps"] = 0 if on_udp else device.baud_bps
        settings["system"] = settings.get("system") or device.system
        settings["rate_hz"] = max(settings.get("rate_hz", 0.0), device.rate_hz)
        kinds.append(_reading_of(device))
        if isinstance(device, MavlinkWheels):
            settings["wheels"] = (device.wheel_left, device.wheel_right)
    return MavlinkConversation(kinds, **settings)


_USBOARD = (UsBoardSonars, UsBoardSerialSonars, UsBoardContacts, UsBoardSerialContacts)


def _usboard(devices: Sequence[Device]) -> UsBoardConversation | UsBoardSerialConversation:
    """One board, as sonars, as switches, or as both."""
    from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation

    settings: dict[str, Any] = {"measures": False}
    for device in devices:
        if isinstance(device, UsBoardSonars | UsBoardSerialSonars):
            settings |= {
                "measures": True,
                "channels": _channels(device),
                "rate_hz": device.rate_hz,
                "mode": device.sending,
            }
        elif isinstance(device, UsBoardContacts | UsBoardSerialContacts):
            settings |= {
                "switches": {switch.line: switch.tripped == "low" for switch in device.switches},
                "analog_rate_hz": device.rate_hz,
            }
    on_can = [device for device in devices if isinstance(device, UsBoardSonars | UsBoardContacts)]
    return UsBoardConversation(on_can[0].base_id, **settings) if on_can else UsBoardSerialConversation(**settings)


def _can_wires(config: Config) -> Iterator[Wire]:
    members: dict[str, dict[str, Callable[[], Conversation[Any]]]] = {}
    boards: dict[tuple[str, int], dict[str, Device]] = {}
    for section, name, device in config.devices():
        bus = device.can_bus()
        if bus is None:
            continue
        source = config.source_name(section, name)
        members.setdefault(bus, {})[source] = partial(conversation_of, device)
        if isinstance(device, UsBoardSonars | UsBoardContacts):
            boards.setdefault((bus, device.base_id), {})[source] = device
    for (bus, _), devices in boards.items():
        members[bus] |= _talks(devices)
    for bus, conversations in members.items():
        can = config.can[bus]
        port = can.channel if can.interface == "slcan" else None
        yield Wire(f"can-{bus}", port, partial(_open_can, can), conversations)


_UDP = ("udpin:", "udpout:")
_FIRST_BAUD: dict[type[Device], int] = {UsBoardSerialSonars: 19200, UsBoardSerialContacts: 19200}


def _stops_by_dtr(device: Device) -> bool:
    return isinstance(device, RplidarLaser)


@dataclass(frozen=True, slots=True)
class _ByNumber:
    """A device that is named by its serial number. port: with the prefix."""

    port: str
    driver: str
    search: tuple[str, ...]


def _open_found(wanted: _ByNumber, baud: int, dtr_stops_motor: bool, clock: Clock) -> Port[bytes]:
    """Wherever the device is plugged in now."""
    from service.detect import find_by_serial

    number = wanted.port.removeprefix(SERIAL_NUMBER)
    port = find_by_serial(number, driver=wanted.driver, search=wanted.search, now_ns=clock)
    return _open_serial(port, baud, dtr_stops_motor, clock)


def _open_serial(port: str, baud: int, dtr_stops_motor: bool, clock: Clock) -> Port[bytes]:
    from drivers.ports import SerialPort

    if dtr_stops_motor:
        return SerialPort(port, baud=baud, clock=clock, dtr=False, dtr_at_close=True)
    return SerialPort(port, baud=baud, clock=clock)


def _open_udp(address: str, clock: Clock) -> Port[bytes]:
    from drivers.udp_port import UdpPort

    return UdpPort(address, clock=clock)


def _open_tcp(host: str, port: int, clock: Clock) -> Port[bytes]:
    from drivers.ports import TcpPort

    return TcpPort(host, port, clock=clock)


def _open_can(bus: CanBus, clock: Clock) -> Port[Any]:
    from drivers.ports import CanPort

    return CanPort(interface=bus.interface, channel=bus.channel, bitrate_bps=bus.bitrate_bps, clock=clock)


def conversation_of(device: Device) -> Conversation[Any]:
    """The driver of a device. TypeError for a model nobody taught this function."""
    match device:
        case HokuyoLaser():
            from drivers.laser_hokuyo import HokuyoConversation

            return HokuyoConversation(
                protocol="auto" if device.intensity else "MD",
                first_step=device.first_step,
                last_step=device.last_step,
                cluster=device.cluster,
                skip_interval=device.skip_scans,
                baud=device.baud_bps,
                range_min_m=device.range_min_m,
                range_max_m=device.range_max_m,
            )
        case SickLms2xxLaser():
            from drivers.laser_sick_lms2xx import SickLms2xxConversation

            return SickLms2xxConversation(
                field_deg=device.field_deg,
                resolution_deg=device.resolution_deg,
                baud=device.baud_bps,
                unit=device.unit,
            )
        case RplidarLaser():
            from drivers.laser_rplidar import RplidarConversation

            return RplidarConversation(
                baud=device.baud_bps,
                scan_mode=device.scan,
                pwm=device.motor_pwm,
                range_min_m=device.range_min_m,
                range_max_m=device.range_max_m,
                no_echo=device.no_echo,
            )
        case LdrobotLaser():
            from drivers.laser_ldrobot import LdrobotConversation

            return LdrobotConversation(
                baud=device.baud_bps,
                range_min_m=device.range_min_m,
                range_max_m=device.range_max_m,
                no_echo=device.no_echo,
            )
        case SickColaLaser():
            from drivers.laser_sick_cola import SickColaConversation

            return SickColaConversation(
                ahead_deg=device.ahead_deg,
                range_min_m=device.range_min_m,
                range_max_m=device.range_max_m,
                no_echo=device.no_echo,
                start=device.start,
            )
        case UsBoardSonars() | UsBoardSerialSonars():
            return _usboard([device])
        case Cia406Wheels():
            from drivers.encoder_cia406 import Cia406PairConversation

            return Cia406PairConversation(
                device.node_left,
                device.node_right,
                sync_rate_hz=device.rate_hz,
                produce_sync=device.produce_sync,
                sampling=device.sampling,
                max_turns_per_s=device.max_turns_per_s,
            )
        case Cia406Mount():
            from drivers.encoder_cia406 import Cia406AxleConversation

            return Cia406AxleConversation(device.node, rate_hz=device.rate_hz, max_turns_per_s=device.max_turns_per_s)
        case RoboClawWheels():
            from drivers.encoder_roboclaw import RoboClawConversation

            return RoboClawConversation(
                device.address,
                left_motor=device.left_motor,
                rate_hz=device.rate_hz,
                max_ticks_per_s=device.max_ticks_per_s,
                baud_bps=device.baud_bps,
            )
        case ODriveWheels():
            from drivers.encoder_odrive import ODrivePairConversation

            return ODrivePairConversation(
                device.node_left,
                device.node_right,
                rate_hz=device.rate_hz,
                counts_per_turn=device.counts_per_turn,
                max_turns_per_s=device.max_turns_per_s,
                firmware=device.firmware,
            )
        case VescWheels():
            from drivers.encoder_vesc import VescPairConversation

            return VescPairConversation(
                device.id_left, device.id_right, rate_hz=device.rate_hz, max_ticks_per_s=device.max_ticks_per_s
            )
        case MaxBotixSonars():
            from drivers.sonar_maxbotix import MaxBotixConversation

            return MaxBotixConversation(
                device.family, form=device.lines, channels=_channels(device), period_s=_maxbotix_period_s(device)
            )
        case AliceRing():
            from drivers.alice import AliceConversation

            return AliceConversation(baud=device.baud_bps)
        case ArduinoWheels() | ArduinoSonars() | ArduinoContacts() | MavlinkWheels() | MavlinkSonars() | MavlinkPose():
            return _shares_of({"": device})[""]
        case UsBoardContacts() | UsBoardSerialContacts():
            return _shares_of({"": device})[""]
        case _:
            raise TypeError(f"no driver for {type(device).__name__}")


def _maxbotix_period_s(device: MaxBotixSonars) -> float:
    """From one value of a channel to its next: as told, or as the family fires, one sensor after the other."""
    from drivers.sonar_maxbotix import MODELS

    if device.rate_hz is not None:
        return 1.0 / device.rate_hz
    return MODELS[device.family].period_ns * 1e-9 * max(len(device.transducers), 1)


def _channels(board: UsBoardSonars | UsBoardSerialSonars | MaxBotixSonars) -> list[int] | None:
    return sorted(each.channel for each in board.transducers) or None


# --- sensors ----------------------------------------------------------------------------------------------------------


def _sensor_of(source: str, device: Device) -> Sensor:
    match device:
        case HokuyoLaser() | SickLms2xxLaser() | RplidarLaser() | LdrobotLaser() | SickColaLaser():
            said_by_laser = isinstance(
                device, HokuyoLaser | SickLms2xxLaser
            )  # of others the driver knows what a 0 means
            return Laser(
                source,
                pose_of(device.mount),
                height_m=device.mount.z_m,
                upside_down=device.mount.upside_down,
                nothing_is_free=not said_by_laser or device.no_echo == "clear",
            )
        case UsBoardSonars() | UsBoardSerialSonars() | MaxBotixSonars() | ArduinoSonars() | MavlinkSonars():
            transducers = tuple(
                Transducer(each.channel, Pose2(each.x_m, each.y_m, math.radians(each.yaw_deg)), each.z_m)
                for each in device.transducers
            )
            return Chain(
                source,
                transducers,
                math.radians(device.cone_deg),
                device.range_min_m,
                device.range_max_m,
                round(
                    1e9 * (_maxbotix_period_s(device) if isinstance(device, MaxBotixSonars) else 1.0 / device.rate_hz)
                ),
                unchecked=isinstance(device, MaxBotixSonars | ArduinoSonars),
            )
        case Cia406Wheels() | ArduinoWheels() | RoboClawWheels() | ODriveWheels() | VescWheels() | MavlinkWheels():
            return Wheels(source)
        case Cia406Mount():
            return AxleEncoder(source)
        case ArduinoContacts() | UsBoardContacts() | UsBoardSerialContacts():
            switches = tuple(
                Switch(each.line, Pose2(each.x_m, each.y_m, math.radians(each.yaw_deg)), each.width_m)
                for each in device.switches
            )
            return Contacts(source, switches, round(1e9 / device.rate_hz), round(1e9 * device.hold_s))
        case MavlinkPose():
            return PoseSource(source)
        case AliceRing():
            return Ring(source)
        case _:
            raise TypeError(f"no sensor for {type(device).__name__}")


# --- maps -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Maps:
    """The maps of a configuration. building: the one the store keeps, None if there is none."""

    sectors: tuple[SectorLayer, ...]
    grids: tuple[GridLayer, ...]
    building: BuildingLayer | None


def maps(config: Config, found: Mapping[str, Sensor]) -> Maps:
    """Empty maps as configured, fed by the sensors found."""
    from mapping.grids.occupancy import OccupancyGrid
    from mapping.grids.rolling import RollingGrid
    from service.layers import BuildingLayer, PolarLayer, RollingLayer

    building = None
    grids: list[GridLayer] = []
    if config.localise.mode == "map":
        grids.append(_known_map(config, found))
    elif config.grid.enabled:
        building = BuildingLayer(
            OccupancyGrid(resolution_m=config.grid.resolution_m, model=config.grid.model),
            sources_of(config, config.grid.sources, found),
            publish_period_ns=round(config.grid.publish_period_s * 1e9),
            update_period_ns=round(config.grid.update_period_s * 1e9),
            halve_period_ns=round(config.grid.halve_every_s * 1e9),
        )
        grids.append(building)
    if config.local_grid.enabled:
        local = config.local_grid
        grids.append(
            RollingLayer(
                "local",
                RollingGrid(side_m=local.size_m, resolution_m=local.resolution_m, model=local.model),
                sources_of(config, local.sources, found),
                period_ns=round(local.period_s * 1e9),
                halve_period_ns=round(local.halve_every_s * 1e9),
            )
        )
    sectors = tuple(_sector_maps(config))
    if config.artos.enabled:
        grids.append(_artos_map(config, [layer for layer in sectors if isinstance(layer, PolarLayer)]))
    return Maps(sectors, tuple(grids), building)


def _known_map(config: Config, found: Mapping[str, Sensor]) -> KnownMapLayer:
    """The given map of [localise]. Trouble if its file cannot be read."""
    from service.map_localiser import KnownMapLayer, read_map

    lasers = frozenset(name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts)
    path = Path(config.localise.map or "").expanduser()
    return KnownMapLayer(read_map(path), lasers & sources_of(config, config.localise.sources, found), name=path.name)


def tilting_lasers(config: Config) -> tuple[TiltingLaser, ...]:
    """The mounts that nod or turn a laser."""
    return tuple(TiltingLaser(_mount_settings(config, name)) for name in sorted(config.mounts))


def _mount_settings(config: Config, name: str) -> MountSettings:
    device = config.mounts[name]
    place, arm = device.mount, device.arm
    roll = math.pi if place.upside_down else 0.0
    return MountSettings(
        name=config.source_name("mounts", name),
        laser=config.source_name("lasers", device.laser),
        mount=TiltMount(
            Pose3(place.x_m, place.y_m, place.z_m, roll, 0.0, math.radians(place.yaw_deg)),
            device.axle,
            Pose3(arm.x_m, arm.y_m, arm.z_m, *map(math.radians, (arm.roll_deg, arm.pitch_deg, arm.yaw_deg))),
        ),
        rad_per_tick=2.0 * math.pi / device.counts_per_turn,
        zero_rad=math.radians(device.zero_deg),
        turning=device.motion == "turns",
        delay_ns=round(device.delay_ms * 1e6),
        wait_ns=config.alignment.odometry_wait_ms * 1_000_000,
    )


def closure_calls(localiser: Localiser, ask: Callable[[Callable[[], Any]], Any]) -> Iterator[tuple[str, Handler]]:
    """Calls about the closures of a daemon that does SLAM, by name. ask: runs a function on the fusion thread."""
    if isinstance(localiser, OdometryOnly):
        return
    from service.slam_live import SlamLocaliser

    if isinstance(localiser, SlamLocaliser):
        yield "list_closures", lambda _arguments: ask(localiser.closures_told)
        yield "undo_closure", lambda arguments: ask(partial(localiser.undo, arguments))


def _artos_map(config: Config, polar: Sequence[PolarLayer]) -> ArtosLayer:
    from mapping.sectors.artos import ArtosMap
    from service.layers import ArtosLayer

    artos = config.artos
    wanted = [layer for layer in polar if not artos.sources or layer.name in artos.sources]
    grid = ArtosMap(resolution_m=artos.resolution_m, size_m=artos.size_m)
    return ArtosLayer(grid, wanted, period_ns=round(artos.period_s * 1e9))


def _sector_maps(config: Config) -> Iterator[PolarLayer | RectLayer]:
    from mapping.sectors.footprint import checked_polygon
    from mapping.sectors.inputs import FanReader
    from mapping.sectors.polar import PolarSectors
    from mapping.sectors.rectangular import RectSectors
    from service.layers import PolarLayer, RectLayer

    footprint = np.array(config.robot.footprint_m)
    fans = FanReader(checked_polygon(footprint))
    for name, polar in sorted(config.sectors.polar.items()):
        fed_by = _in_order(config, polar.sources)
        yield PolarLayer(
            name,
            PolarSectors(
                sources=fed_by,
                start_rad=math.radians(polar.start_deg),
                stop_rad=math.radians(polar.stop_deg),
                sector_rad=math.radians(polar.sector_deg),
                base_from_sensor=pose_of(polar.pose),
                stale_after_ns=SECTOR_MEMORY_NS,
                footprint=footprint,
                range_max_m=math.inf if polar.range_max_m is None else polar.range_max_m,
                fans=fans,
            ),
            fed_by,
        )
    for name, rect in sorted(config.sectors.rect.items()):
        fed_by = _in_order(config, rect.sources)
        yield RectLayer(
            name,
            RectSectors(
                sources=fed_by,
                size_m=rect.size_m,
                sector_m=rect.sector_m,
                base_from_sensor=pose_of(rect.pose),
                stale_after_ns=SECTOR_MEMORY_NS,
                footprint=footprint,
                fans=fans,
            ),
            fed_by,
        )


def _in_order(config: Config, references: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(config.source_name(*config.resolve(reference)) for reference in references))


def parts(config: Config, found: Mapping[str, Sensor], made: Maps, localiser: Localiser) -> Parts:
    """What fusion is made of."""
    from mapping.sectors.footprint import checked_polygon

    drive = None
    if config.drive.source is not None:
        drive = (config.source_name("wheels", config.drive.source), geometry_of(config.drive))
    return Parts(
        sensors=found,
        sectors=made.sectors,
        grids=made.grids,
        drive=drive,
        pose_source=None if config.drive.pose_source is None else config.source_name("poses", config.drive.pose_source),
        odometry_laser=odometry_laser(config, found),
        max_wheel_speed_m_s=config.drive.max_wheel_speed_m_s,
        localiser=localiser,
        mounts=tilting_lasers(config),
        footprint=checked_polygon(config.robot.footprint_m),
        wait_ns=config.alignment.odometry_wait_ms * 1_000_000,
        odometry_memory_s=config.alignment.odometry_memory_s,
    )


def localiser(
    config: Config,
    found: Mapping[str, Sensor],
    made: Maps,
    start_pose: Pose2,
    submit: Submit,
    on_redrawn: OnRedrawn | None = None,
    stored: Sequence[StoredTile] = (),
) -> Localiser:
    """What says where the odom frame lies in the map; the same for a daemon and for a replay of what it recorded.

    submit: where slow work is done.  on_redrawn: see Redrawer.  stored: the layer `slam` of the map
    that was taken up.
    """
    lasers = {
        name: sensor.base_from_sensor
        for name, sensor in found.items()
        if isinstance(sensor, Laser) and not sensor.tilts
    }
    if config.localise.mode == "map":
        from service.map_localiser import KnownMapLayer, KnownMapLocaliser

        known = next(layer for layer in made.grids if isinstance(layer, KnownMapLayer))
        start = None if config.localise.start is None else pose_of(config.localise.start)
        return KnownMapLocaliser(known.patch, known.sources, submit=submit, start=start, name=known.name)
    matched = lasers.keys() & sources_of(config, config.slam.sources, found)
    if not config.slam.enabled or not matched:
        return OdometryOnly(start_pose)
    if config.slam.method == "lines":
        from service.line_localiser import LineLocaliser

        return LineLocaliser(matched, geometry_of(config.drive), start=start_pose)
    from mapping.localise.slam_records import without_wheels
    from service.redraw import Redrawer
    from service.slam_live import SlamLocaliser, stored_or_none

    redrawer = Redrawer(made.grids, made.building, lasers, submit=submit)
    kept = stored_or_none(stored)
    if made.building is not None and kept is None:
        redrawer.start_over(made.building.grid.tiles())
    redrawer.on_redrawn = on_redrawn or redrawer.on_redrawn
    alone = odometry_laser(config, found) is not None
    return SlamLocaliser(
        matched, start=start_pose, submit=submit, redrawer=redrawer, settings=without_wheels() if alone else None,
        stored=kept, lost_when_broken=alone,
    )  # fmt: skip


def odometry_laser(config: Config, found: Mapping[str, Sensor]) -> str | None:
    """The level laser that tells the motion of a robot on which nothing else does: the first of those that are laid
    on the map. None where wheels or another estimator tell it, or nobody wants it told."""
    drive = config.drive
    if drive.source is not None or drive.pose_source is not None or not drive.laser_odometry:
        return None
    wanted = config.localise.sources if config.localise.mode == "map" else config.slam.sources
    level = {name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts}
    return min(level & sources_of(config, wanted, found), default=None)


def geometry_of(drive: Drive) -> DriveGeometry:
    """How counts become motion."""
    return DriveGeometry(
        wheel_radius_left_m=drive.wheel_radius_left_m,
        wheel_radius_right_m=drive.wheel_radius_right_m,
        track_width_m=drive.track_width_m,
        ticks_per_turn_left=drive.ticks_per_turn_left,
        ticks_per_turn_right=drive.ticks_per_turn_right,
        travel_noise_m_per_sqrt_m=drive.travel_noise_m_per_sqrt_m,
        unknown_speed_m_s=drive.unknown_speed_m_s,
        unknown_turn_rad_s=drive.unknown_turn_rad_s,
    )


def sources_of(config: Config, references: Sequence[str] | None, found: Mapping[str, Sensor]) -> frozenset[str]:
    """The sensors that feed a map: those named, or every one that looks level; and switches."""
    if references is None:
        return frozenset(
            name
            for name, sensor in found.items()
            if isinstance(sensor, Chain | Contacts) or (isinstance(sensor, Laser) and not sensor.tilts)
        )
    return frozenset(config.source_name(*config.resolve(reference)) for reference in references)


# --- autopilots -------------------------------------------------------------------------------------------------------


def mavlink_out(
    config: Config, found: Mapping[str, Sensor], readers: Mapping[str, WireReader[Any]], clock: Clock
) -> MavlinkOut | None:
    """What sends a sector map to an autopilot, None if nothing shall. readers: by name of their wire.

    On a port that a MAVLink source has too, it speaks through that source's reader.
    """
    wanted = config.mavlink
    if not wanted.enabled:
        return None
    from service.mavlink_out import MavlinkOut, ReaderLink, Settings, sensor_type_of

    name = wanted.map or next(iter(config.sectors.polar))
    settings = Settings(
        source=name,
        footprint=config.robot.footprint_m,
        system_id=wanted.system_id,
        component_id=wanted.component_id,
        rate_hz=wanted.rate_hz,
        range_min_m=wanted.range_min_m,
        range_max_m=wanted.range_max_m,
        sensor_type=sensor_type_of(found[each].kind for each in _in_order(config, config.sectors.polar[name].sources)),
    )
    sharing = next((each for each in _mavlink_sources(config) if each[1] == wanted.port and each[0] in readers), None)
    if sharing is not None:
        return MavlinkOut(settings, partial(ReaderLink, readers[sharing[0]]), clock=clock)
    if wanted.port.startswith(_UDP):
        return MavlinkOut(settings, partial(_open_udp, wanted.port, clock), clock=clock)
    return MavlinkOut(settings, partial(_open_serial, wanted.port, wanted.baud_bps, False, clock), clock=clock)


def _mavlink_sources(config: Config) -> list[tuple[str, str]]:
    """(source, port) of every MAVLink source; a wire is named like the first on it."""
    return [
        (config.source_name(section, name), device.port)
        for section, name, device in config.devices()
        if isinstance(device, MavlinkSonars | MavlinkWheels | MavlinkPose)
    ]
