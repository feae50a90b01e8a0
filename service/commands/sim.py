"""`umfeld sim`: emulated devices, as a process of their own (`python -m sim_devices`), which this one becomes."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def sim(
    *,
    preset: Annotated[
        str | None,
        typer.Option(help="The robot: artos (the default), two_wheeler, nodding, alice, roboclaw, odrive, autopilot."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Emulate the devices of this configuration instead.")] = None,
    world: Annotated[
        str | None, typer.Option(help="Floor plan: flat (the default), hall, loop, office, ... or a .toml file.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Play this recorded log instead of a world.")] = None,
    poses: Annotated[
        str | None, typer.Option(help="What the log's poses are: odometry or corrected; default: found out.")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="Times real time, of robot and world or log.")] = None,
    laser: Annotated[
        str | None,
        typer.Option(help="Model of the lasers: utm-30lx, lms200, rplidar-a1, ld06, tim571, ...; default: by driver."),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="What goes wrong, for example laser:unplug@20s+2s; may be repeated. docs/faults.md explains all "
            "kinds; a wrong one lists them."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of noise, faults, slip and people.")] = None,
    slip: Annotated[float | None, typer.Option(help="Random wheel slip in m after one metre.")] = None,
    wheel_error: Annotated[
        float | None, typer.Option(help="The left wheel rolls by this share farther than told.")
    ] = None,
    folder: Annotated[Path | None, typer.Option("--dir", help="Folder of the ptys' links and of umfeld.toml.")] = None,
    truth: Annotated[Path | None, typer.Option(help="Write the true pose here: JSON lines t, x, y, yaw.")] = None,
    start_after: Annotated[
        float | None, typer.Option(help="Drive so many seconds after the start, not after a host spoke.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="End after so many seconds; default: when told.")] = None,
    until_end: Annotated[bool, typer.Option("--until-end", help="End when the log or an open route is over.")] = False,
    drive: Annotated[
        bool, typer.Option("--drive", help="Drive by lines on standard input: forward m/s, turn rad/s, seconds.")
    ] = False,
) -> None:
    """Emulated devices on ptys; prints a configuration with which `umfeld run` meets them.

    Example: umfeld sim --preset artos --world flat --fault laser:unplug@20s+2s
    """
    values = {
        "--preset": preset,
        "--config": config,
        "--world": world,
        "--log": log,
        "--poses": poses,
        "--speed": speed,
        "--laser": laser,
        "--seed": seed,
        "--slip": slip,
        "--wheel-error": wheel_error,
        "--dir": folder,
        "--truth": truth,
        "--start-after": start_after,
        "--duration": duration,
    }
    # `--name=value` in one word: a value such as -0.01 is then no option
    arguments = [f"{name}={value}" for name, value in values.items() if value is not None]
    arguments += [f"--fault={text}" for text in fault or []]
    arguments += [name for name, wanted in (("--until-end", until_end), ("--drive", drive)) if wanted]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", "sim_devices", *arguments])
