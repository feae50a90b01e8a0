"""udev rules that give each configured serial device a name of its own: /dev/umfeld/NAME.

By the serial number of its USB chip where it has one of its own, else by the socket it is plugged into. Two adapters
of a kind without serial numbers are told apart by their sockets only: plugged in the other way round they swap names,
which the rules say in a comment.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class UsbPort:
    """What the system knows of a serial port. place: its socket, as in ID_PATH (by-path)."""

    name: str
    vendor_id: int | None = None
    product_id: int | None = None
    serial: str | None = None
    place: str = ""


def usb_ports() -> list[UsbPort]:
    """The serial ports of this machine."""
    from pathlib import Path

    from serial.tools import list_ports

    by_path = Path("/dev/serial/by-path")
    places = {os.path.realpath(link): link.name for link in sorted(by_path.iterdir())} if by_path.is_dir() else {}
    return [
        UsbPort(each.device, each.vid, each.pid, each.serial_number, places.get(os.path.realpath(each.device), ""))
        for each in sorted(list_ports.comports(), key=lambda port: str(port.device))
    ]


def rules(wanted: Mapping[str, str], ports: Iterable[UsbPort]) -> tuple[str, list[str]]:
    """The rules file, and what could not be named, one line each. wanted: name -> port as configured."""
    known = {os.path.realpath(port.name): port for port in ports}
    counts: dict[tuple[int | None, int | None, str | None], int] = {}
    for port in known.values():
        key = (port.vendor_id, port.product_id, port.serial)
        counts[key] = counts.get(key, 0) + 1
    lines = [
        "# Written by `umfeld devices udev`. Install as /etc/udev/rules.d/61-umfeld-names.rules, then:",
        "#   sudo udevadm control --reload && sudo udevadm trigger --subsystem-match=tty",
        "",
    ]
    troubles = []
    for name, configured in sorted(wanted.items()):
        found = known.get(os.path.realpath(configured))
        if found is None:
            troubles.append(f"{name}: {configured} is not plugged in now, or is no USB port; no rule for it")
            continue
        rule = _rule(name, found, is_alone=counts[found.vendor_id, found.product_id, found.serial] == 1)
        if rule is None:
            troubles.append(f"{name}: nothing tells {configured} from others: no serial number, no socket")
        else:
            lines += rule
    return "\n".join(lines) + "\n", troubles


def _rule(name: str, port: UsbPort, *, is_alone: bool) -> list[str] | None:
    access = f'GROUP="dialout", MODE="0660", SYMLINK+="umfeld/{name}"'
    if port.vendor_id is not None and port.product_id is not None and port.serial and is_alone and _plain(port.serial):
        ids = f'ATTRS{{idVendor}}=="{port.vendor_id:04x}", ATTRS{{idProduct}}=="{port.product_id:04x}"'
        return [f'SUBSYSTEM=="tty", {ids}, ATTRS{{serial}}=="{port.serial}", {access}']
    if port.place and _plain(port.place):
        return [
            f"# {name}: by its socket, as its USB chip has no serial number of its own; keep it plugged in there",
            f'SUBSYSTEM=="tty", IMPORT{{builtin}}="path_id", ENV{{ID_PATH}}=="{_path_of(port.place)}", {access}',
        ]
    return None


def _path_of(link_name: str) -> str:
    """ID_PATH from the name of a by-path link, which adds -port0 for the chip's first line."""
    head, dash, tail = link_name.rpartition("-port")
    return head if dash and tail.isdecimal() else link_name


def _plain(text: str) -> bool:
    """Nothing in it that means something in a rule: quotes, patterns, substitutions."""
    return all(letter.isalnum() or letter in "._:-+ /" for letter in text)
