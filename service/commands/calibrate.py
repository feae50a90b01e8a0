"""`umfeld calibrate`: what the wheels and the laser's mount really are, from a recorded drive."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer()


@app.command()
def calibrate(
    log: Annotated[Path, typer.Argument(help="A recorded log with wheel ticks or odometry, and a laser; or .gz.")],
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
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Wheel gains, track width, the laser's place on the robot and the time between both clocks, each with how sure.

    Any drive will do that goes straight, turns both ways and changes its speed. What it does not tell is said to be
    "not observable yet". Nothing is changed: the numbers are advice. Exit code 1 if nothing at all is observable.

    Example: umfeld calibrate exp1.dat.gz --ticks-per-turn 2000
    """
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
    report = offline.report_of(run, None if ticks_per_turn is None else (ticks_per_turn, ticks_per_turn))
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        _print(report)
    if not run.found.observable.any():
        raise typer.Exit(1)


def _print(report: dict[str, Any]) -> None:
    from service.calibrate_log import NOT_OBSERVABLE

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
