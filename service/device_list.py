"""Serial ports and CAN interfaces of this machine: what there is to name in a configuration."""

from __future__ import annotations

import grp
import os
from dataclasses import asdict, dataclass
from pathlib import Path

_ARPHRD_CAN = "280"  # linux/if_arp.h


@dataclass(frozen=True, slots=True)
class PortInfo:
    """One port. stable_name: a name that stays when devices are plugged in another order, empty if there is none.

    trouble: why this user cannot open it, with the repair, or empty.
    """

    name: str
    kind: str
    stable_name: str
    description: str
    trouble: str

    def document(self) -> dict[str, str]:
        """For JSON."""
        return asdict(self)


def serial_ports(by_id: Path = Path("/dev/serial/by-id")) -> list[PortInfo]:
    """Serial ports with a device behind them."""
    from serial.tools import list_ports

    links = {os.path.realpath(link): str(link) for link in sorted(by_id.iterdir())} if by_id.is_dir() else {}
    return [
        PortInfo(
            port.device,
            "serial",
            links.get(os.path.realpath(port.device), ""),
            " ".join(filter(None, (port.manufacturer, port.product, port.serial_number))) or port.description or "",
            permission_trouble(Path(port.device)),
        )
        for port in sorted(list_ports.comports(), key=lambda each: str(each.device))
    ]


def can_interfaces(net: Path = Path("/sys/class/net")) -> list[PortInfo]:
    """CAN cards that the system knows, whether they are up."""
    found = []
    for interface in sorted(net.iterdir()) if net.is_dir() else []:
        if _text(interface / "type") != _ARPHRD_CAN:
            continue
        is_up = _text(interface / "operstate") in ("up", "unknown") and int(_text(interface / "flags") or "0", 16) & 1
        repair = f"it is down; sudo ip link set {interface.name} up type can bitrate 1000000"
        found.append(PortInfo(interface.name, "can", interface.name, "CAN interface", "" if is_up else repair))
    return found


def permission_trouble(port: Path) -> str:
    """Why this user cannot open a port, and the repair; empty if it can."""
    if os.access(port, os.R_OK | os.W_OK):
        return ""
    try:
        group = grp.getgrgid(port.stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "dialout"
    return f"no permission; add the user to the group {group} (sudo usermod -aG {group} $USER, then log in again)"


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""
