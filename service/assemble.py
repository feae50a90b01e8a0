"""Configuration to parts: wires with their conversations, sensors with their places, maps.

Drivers are imported when a configuration names them, so that a robot without a CAN bus never loads one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from drivers.conversation import Conversation
from drivers.ports import Clock, Port, Tap
from drivers.reader import Sink, WireReader
from mapping.frames import Pose2
from service.config import (
    CanBus,
    Cia406Wheels,
    Config,
    Device,
    HokuyoLaser,
    Mount,
    PlanePose,
    UsBoardSerialSonars,
    UsBoardSonars,
)
from service.sensors import Chain, Laser, Sensor, Transducer, Wheels


@dataclass(frozen=True, slots=True)
class Wire:
    """One wire and who is on it. port: the serial port behind it, None for a bus of the system."""

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
    return found


def pose_of(place: Mount | PlanePose) -> Pose2:
    """A mounting in the base frame."""
    return Pose2(place.x_m, place.y_m, math.radians(place.yaw_deg))


# --- wires ------------------------------------------------------------------------------------------------------------


def _serial_wires(config: Config) -> Iterator[Wire]:
    for section, name, device in config.devices():
        port = device.serial_port()
        if port is None:
            continue
        source = config.source_name(section, name)
        baud = getattr(device, "baud_bps", None) or _FIRST_BAUD.get(type(device), 115200)
        yield Wire(source, port, partial(_open_serial, port, baud), {source: partial(conversation_of, device)})


def _can_wires(config: Config) -> Iterator[Wire]:
    members: dict[str, dict[str, Callable[[], Conversation[Any]]]] = {}
    for section, name, device in config.devices():
        bus = device.can_bus()
        if bus is not None:
            members.setdefault(bus, {})[config.source_name(section, name)] = partial(conversation_of, device)
    for bus, conversations in members.items():
        can = config.can[bus]
        port = can.channel if can.interface == "slcan" else None
        yield Wire(f"can-{bus}", port, partial(_open_can, can), conversations)


_FIRST_BAUD: dict[type[Device], int] = {UsBoardSerialSonars: 19200}


def _open_serial(port: str, baud: int, clock: Clock) -> Port[bytes]:
    from drivers.ports import SerialPort

    return SerialPort(port, baud=baud, clock=clock)


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
        case UsBoardSonars():
            from drivers.sonar_usboard import UsBoardConversation

            return UsBoardConversation(
                device.base_id, channels=_channels(device), rate_hz=device.rate_hz, mode=device.sending
            )
        case UsBoardSerialSonars():
            from drivers.sonar_usboard import UsBoardSerialConversation

            return UsBoardSerialConversation(channels=_channels(device), rate_hz=device.rate_hz, mode=device.sending)
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
        case _:
            raise TypeError(f"no driver for {type(device).__name__}")


def _channels(board: UsBoardSonars | UsBoardSerialSonars) -> list[int] | None:
    return sorted(each.channel for each in board.transducers) or None


# --- sensors ----------------------------------------------------------------------------------------------------------


def _sensor_of(source: str, device: Device) -> Sensor:
    match device:
        case HokuyoLaser():
            return Laser(source, pose_of(device.mount), height_m=device.mount.z_m, upside_down=device.mount.upside_down)
        case UsBoardSonars() | UsBoardSerialSonars():
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
                round(1e9 / device.rate_hz),
            )
        case Cia406Wheels():
            return Wheels(source)
        case _:
            raise TypeError(f"no sensor for {type(device).__name__}")
