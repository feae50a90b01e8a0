"""`umfeld devices`: what there is to name in a configuration."""

from __future__ import annotations

import json
from typing import Annotated

import typer

app = typer.Typer()


@app.callback()
def devices() -> None:
    """Ports of this machine."""


@app.command("list")
def list_devices(*, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False) -> None:
    """Serial ports and CAN interfaces, by the name that stays, and whether you may open them.

    Example: umfeld devices list --json
    """
    from service.commands.status import print_table
    from service.device_list import can_interfaces, serial_ports

    ports = [*serial_ports(), *can_interfaces()]
    if as_json:
        typer.echo(json.dumps([port.document() for port in ports], indent=2))
        return
    if not ports:
        typer.echo("no serial port and no CAN interface is there; plug a device in, or try `umfeld sim`")
        return
    rows = [("port", "kind", "name that stays", "what it says", "trouble")]
    rows += [(port.name, port.kind, port.stable_name or "-", port.description or "-", port.trouble) for port in ports]
    print_table(rows, [None, *("red" if port.trouble else None for port in ports)])
