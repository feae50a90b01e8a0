"""Leave every configured device safe: lasers dark, motors off. On the way out, and after a crash.

A daemon that ends does this by itself. After a crash nothing is known of the devices, so each is told at every line
speed that it may have been left at, and twice: what it heard at a wrong speed spoils the first message, as it would
spoil any, and is over with its end. Between speeds the line gets a moment, for adapters that keep bytes back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from drivers.conversation import SetBaudRate
from drivers.errors import DriverError
from drivers.ports import Clock, Port
from service import assemble_wires
from service.config import Config
from service.config_devices import HokuyoLaser, RplidarLaser, SickLms2xxLaser
from service.errors import Trouble
from service.locks import Claims

_MOMENT_S = 0.06
_SILENT_S = 0.4  # longer than any laser here takes from one answer to the next
_DRAINED_NS = 2_000_000_000  # what a system keeps for a reader has come by then
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Told:
    """What became of one device. trouble: why it was not told, empty if it was; items: messages sent."""

    name: str
    items: int = 0
    trouble: str = ""

    def document(self) -> dict[str, object]:
        """For JSON."""
        return {"name": self.name, "messages": self.items, "trouble": self.trouble}


def stop_devices(config: Config, *, clock: Clock, sleep: Callable[[float], object] = time.sleep) -> list[Told]:
    """Say farewell on every wire, side by side. A wire that a running daemon has is left to it."""
    speeds = {config.source_name(section, name): _speeds(device) for section, name, device in config.devices()}
    with ThreadPoolExecutor(max_workers=8) as pool:
        answers = pool.map(lambda wire: _stop_wire(wire, speeds, clock, sleep), assemble_wires.wires(config))
        return [told for answer in answers for told in answer]


def _stop_wire(
    wire: assemble_wires.Wire, speeds: dict[str, tuple[int, ...]], clock: Clock, sleep: Callable[[float], object]
) -> list[Told]:
    farewells = {name: tuple(make().farewell()) for name, make in wire.conversations.items()}
    if not any(farewells.values()):
        return [Told(name) for name in farewells]  # nothing of it moves or shines
    with Claims() as claims:
        try:
            claims.claim_ports([] if wire.port is None else [wire.port])
            port = wire.open_port(clock)
        except (Trouble, DriverError) as error:
            return [Told(name, 0, str(error)) for name in farewells]
        try:
            return [
                _convince(port, name, items, speeds.get(name, ()), clock, sleep) for name, items in farewells.items()
            ]
        finally:
            port.close()


def _convince(
    port: Port[Any],
    name: str,
    items: Sequence[Any],
    speeds: tuple[int, ...],
    clock: Clock,
    sleep: Callable[[float], object],
) -> Told:
    """Say it, and say it again to a laser on a serial line that is heard afterwards."""
    said = 0
    for _ in range(_ROUNDS):
        told = _say(port, name, items, speeds, sleep)
        said += told.items
        if told.trouble or not speeds:
            return Told(name, said, told.trouble)
        try:
            if _falls_silent(port, clock):
                return Told(name, said)
        except DriverError as error:
            return Told(name, said, str(error))
    return Told(name, said, "it goes on sending after it was told to stop at each of its speeds: switch off its power")


def _falls_silent(port: Port[Any], clock: Clock) -> bool:
    """Whether nothing comes for a while, once what the system kept has been read."""
    until_ns = clock() + _DRAINED_NS
    while clock() < until_ns:
        if not port.read(_SILENT_S):
            return True
    return False


def _say(
    port: Port[Any], name: str, items: Sequence[Any], speeds: tuple[int, ...], sleep: Callable[[float], object]
) -> Told:
    said = 0
    try:
        for item in _at_every_speed(items, speeds):
            if isinstance(item, SetBaudRate):
                sleep(_MOMENT_S)
                port.set_baud(item.bits_per_s)
            else:
                port.write(item)
                said += 1
        sleep(_MOMENT_S)
    except DriverError as error:
        return Told(name, said, str(error))
    return Told(name, said)


def _at_every_speed(items: Sequence[Any], speeds: tuple[int, ...]) -> Iterator[Any]:
    yield from items if not speeds else ()
    for speed in speeds:
        yield SetBaudRate(speed)
        yield from items
        yield from items


def _speeds(device: object) -> tuple[int, ...]:
    """Line speeds that a device may have been left at; empty if it has but one."""
    match device:
        case HokuyoLaser():
            from drivers.laser_hokuyo import SPEEDS

            return SPEEDS
        case SickLms2xxLaser():
            from drivers.laser_sick_lms2xx import SPEEDS as SICK_SPEEDS

            return tuple(SICK_SPEEDS)
        case RplidarLaser():
            from drivers.laser_rplidar import SPEEDS as RPLIDAR_SPEEDS

            return RPLIDAR_SPEEDS
        case _:
            return ()
