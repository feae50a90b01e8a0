"""Configuration to wires: who is on each, how its port is opened, and the conversations that speak to its devices.

Drivers are imported when a configuration names them, so that a robot without a CAN bus never loads one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

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
from service.config import Config
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
    HokuyoLaser,
    LdrobotLaser,
    MavlinkPose,
    MavlinkSonars,
    MavlinkWheels,
    MaxBotixSonars,
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

if TYPE_CHECKING:
    from drivers.encoder_arduino_bridge import ArduinoBridgeConversation
    from drivers.mavlink_in import MavlinkConversation
    from drivers.sonar_usboard import UsBoardConversation, UsBoardSerialConversation


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
        elif port.startswith(UDP):
            yield Wire(source, None, partial(open_udp, port), _talks(devices))
        elif port.startswith(SERIAL_NUMBER):
            looked_for = _ByNumber(port, str(getattr(device, "driver", "")), config.search.ports)
            yield Wire(source, None, partial(_open_found, looked_for, baud, _stops_by_dtr(device)), _talks(devices))
        else:
            yield Wire(source, port, partial(open_serial, port, baud, _stops_by_dtr(device)), _talks(devices))


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
        on_udp = device.port.startswith(UDP)
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


UDP = ("udpin:", "udpout:")
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
    return open_serial(port, baud, dtr_stops_motor, clock)


def open_serial(port: str, baud: int, dtr_stops_motor: bool, clock: Clock) -> Port[bytes]:
    from drivers.ports import SerialPort

    if dtr_stops_motor:
        return SerialPort(port, baud=baud, clock=clock, dtr=False, dtr_at_close=True)
    return SerialPort(port, baud=baud, clock=clock)


def open_udp(address: str, clock: Clock) -> Port[bytes]:
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
                device.family, form=device.lines, channels=_channels(device), period_s=maxbotix_period_s(device)
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


def maxbotix_period_s(device: MaxBotixSonars) -> float:
    """From one value of a channel to its next: as told, or as the family fires, one sensor after the other."""
    from drivers.sonar_maxbotix import MODELS

    if device.rate_hz is not None:
        return 1.0 / device.rate_hz
    return MODELS[device.family].period_ns * 1e-9 * max(len(device.transducers), 1)


def _channels(board: UsBoardSonars | UsBoardSerialSonars | MaxBotixSonars) -> list[int] | None:
    return sorted(each.channel for each in board.transducers) or None
