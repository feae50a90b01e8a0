"""`umfeld check`: is the configuration right, and does every device answer?"""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def check(
    *,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="The configuration file; default: the first usual place.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE, wins over the file; repeatable.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="How long devices may take to answer.")] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Validate the configuration, open every device, and tell what was found. Exit code 1 if something is wrong.

    Example: umfeld check --config umfeld.toml
    """
    logging.getLogger("drivers").addHandler(logging.NullHandler())  # what they would log stands in the table
    from service.commands.status import print_table
    from service.config import load
    from service.device_check import check_devices, check_surroundings

    loaded = load(config, settings=settings or ())
    problems = check_surroundings(loaded.config)
    found = check_devices(loaded.config, seconds=seconds, now_ns=time.monotonic_ns, sleep=time.sleep)
    files = [str(file) for file in loaded.files]
    is_well = not problems and all(device.is_well for device in found)
    if as_json:
        document = {
            "ok": is_well,
            "files": files,
            "devices": [device.document() for device in found],
            "problems": problems,
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        typer.echo(f"configuration: {', '.join(files) or 'defaults only (no file was found)'}: valid")
        if found:
            rows = [("device", "kind", "wire", "found", "identity", "rate"), *(device.row() for device in found)]
            print_table(rows, [None, *(None if device.is_well else "red" for device in found)])
        else:
            typer.echo("no device is configured; add [lasers.NAME], [sonars.NAME] or [wheels.NAME]")
        for line in (*(f"{each.name}: {each.trouble}" for each in found if each.trouble), *problems):
            typer.secho(line, fg="red", err=True)
        unheard = sorted(
            {each.wire for each in found if each.state in ("silent", "starting") and each.wire.startswith("/")}
        )
        if unheard:
            typer.echo(f"who answers there: umfeld devices detect {' '.join(unheard)}")
    if not is_well:
        raise typer.Exit(1)
