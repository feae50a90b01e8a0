"""`umfeld calibrate`: what the wheels and the laser's mount really are, from a recorded drive or a running daemon."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer()


@app.command()
def calibrate(
    log: Annotated[
        Path | None,
        typer.Argument(
            help="A recorded log with wheel ticks or odometry, and a laser; or .gz; or a recording (.mcap or its "
            "folder). Without one the running daemon is asked."
        ),
    ] = None,
    *,
    way_m: Annotated[
        float | None,
        typer.Option("--way", min=0.05, help="Compare sweeps so far apart, metres; else by what they see."),
    ] = None,
    ticks_per_turn: Annotated[
        float | None, typer.Option(help="Ticks of a turn of each wheel, gear included: tells radii too.")
    ] = None,
    track_width_m: Annotated[
        float | None, typer.Option("--track-width", min=0.01, help="As the odometry took it, for logs without ticks.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option(help="The daemon's endpoint; default: that of the configuration.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The daemon's configuration file.")] = None,
    robot: Annotated[str | None, typer.Option(help="The robot's id, where several answer.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Wheel gains, track width, the laser's place on the robot and the time between both clocks, each with how sure.

    Any drive will do that goes straight, turns both ways and changes its speed. What it does not tell is said to be
    "not observable yet". Nothing is changed: the numbers are advice. Exit code 1 if nothing at all is observable.

    Examples: umfeld calibrate exp1.dat.gz --ticks-per-turn 2000
    umfeld calibrate
    """
    if log is None:
        _ask_daemon(connect, config, robot, as_json=as_json)
        return
    from rich.console import Console
    from rich.progress import Progress

    from service import calibrate_log as offline

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(log.name, total=None)
        run = offline.calibrate_log(
            log, way_m=way_m, track_width_m=track_width_m,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    report = run.report(None if ticks_per_turn is None else (ticks_per_turn, ticks_per_turn))
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        _print(report)
    if not run.found.observable.any():
        raise typer.Exit(1)


def _ask_daemon(connect: str | None, config: Path | None, robot: str | None, *, as_json: bool) -> None:
    from service.errors import Trouble
    from service.zenoh_session import client_for

    with client_for(connect, config) as client:
        base = client.only_base(None if robot is None else f"robots/{robot}")
        payloads = [each.payload for each in client.get(f"{base}/calibration")]
    if not payloads:
        raise Trouble(
            f"{base} has no calibration yet: it needs [calibration] enabled, [drive] source, a laser and a few metres "
            "of driving"
        )
    document = json.loads(payloads[0])
    if as_json:
        typer.echo(json.dumps(document, indent=2))
        return
    for laser, report in document["lasers"].items():
        typer.secho(f"by {laser}", bold=True)
        _print(report)
        if (wrong := report.get("contradiction")) is not None:
            typer.echo(f"{'look at':<22} {wrong}")
        for each in report["advice"]:
            typer.echo(
                f"{'look at':<22} {each['setting']} = {each['value']} ± {each['deviation']}, not {each['instead_of']}"
            )


def _print(report: dict[str, Any]) -> None:
    from service.calibration_report import NOT_OBSERVABLE

    for name, row in report["values"].items():
        factor = 180.0 / math.pi if name.endswith("_rad") else 1.0
        label = name.removesuffix("_rad") + "_deg" if factor != 1.0 else name
        deviation, believed = row["deviation"] * factor, row["believed"] * factor
        found = NOT_OBSERVABLE if row["value"] is None else f"{row['value'] * factor:<12.6g} ± {deviation:.2g}"
        typer.echo(f"{label:<22} {found:<26} believed {believed:.6g}")
    motions = report["motions"]
    typer.echo(
        f"{'from':<22} {motions['used']} motions, {motions['way_m']} m, {motions['turn_deg']} deg of turns; "
        f"{motions['outliers']} outliers and {motions['sweeps_that_did_not_fit']} sweeps that did not fit left out"
    )
    typer.echo(f"{'off by (median)':<22} {motions['median_off_m']} m, {motions['median_off_deg']} deg")
    if report["umbmark"] is not None:
        square = report["umbmark"]
        typer.echo(
            f"{'UMBmark':<22} with what was believed, a square of {square['side_m']:g} m ends {square['worst_m']} m off"
        )
    typer.echo(f"{'wheels':<22} {report['wheels']}")
