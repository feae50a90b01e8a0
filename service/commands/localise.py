"""`umfeld localise`: a recorded log in a known map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapping.frames import Pose2

app = typer.Typer()


@app.command()
def localise(
    log: Annotated[Path, typer.Argument(help="A recorded log with odometry: CARMEN, robotdata, tinySLAM; or .gz.")],
    *,
    map_file: Annotated[Path, typer.Option("--map", help="MAP.yaml with its picture, or a .umfeld file.")],
    start: Annotated[
        str | None, typer.Option(help="A hint: X,Y,YAW of the robot at first, in metres and degrees.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Use every N-th scan.")] = 1,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Every scan's pose and state: .json or .tum.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw the way into the map.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Where the robot was in a known map, from no idea at all, and how sure it was; the map is only read.

    Example: umfeld localise robotdata1.log.gz --map wean5300.yaml --png way.png
    """
    from rich.console import Console
    from rich.progress import Progress

    from service import localise_log as offline
    from service.errors import WrongUsage
    from service.files import write_whole

    hint = None if start is None else _pose(start)
    if out is not None and out.suffix.lower() not in (".json", ".tum"):
        raise WrongUsage(f"--out {out}: ends in .json (everything) or .tum (the trajectory while sure)")
    if png is not None and png.suffix.lower() != ".png":
        raise WrongUsage(f"--png {png}: a picture's name ends in .png")
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(log.name, total=None)
        run = offline.localise_log(
            log, map_file, every=every, start=hint,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    receipts = []
    if out is not None:
        as_tum = out.suffix.lower() == ".tum"
        text = offline.trajectory_text(run)
        receipts.append(write_whole(out, text.encode()) if as_tum else offline.write_json(run, out))
    if png is not None:
        receipts.append(offline.write_png(run, png))
    report = {**offline.report_of(run), "files": [receipt.document() for receipt in receipts]}
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        _print_way(offline.rows_of(run))
        for name, value in report.items():
            typer.echo(f"{name:<18} {value}")
    if report["first_sure_s"] is None:
        raise typer.Exit(1)


def _pose(text: str) -> Pose2:
    import math

    from mapping.frames import Pose2
    from service.errors import WrongUsage

    try:
        x_m, y_m, yaw_deg = (float(part) for part in text.split(","))
    except ValueError as error:
        raise WrongUsage(f"--start {text!r}: write X,Y,YAW in metres and degrees, such as 12.5,3,90") from error
    return Pose2(x_m, y_m, math.radians(yaw_deg))


def _print_way(rows: list[dict[str, object]]) -> None:
    """One line a second, and one whenever the state changes."""
    typer.echo(f"{'s':>8}  {'state':<10} {'p':>6}  {'x_m':>8} {'y_m':>8} {'yaw_deg':>8}  candidates")
    told_s, told_state = -1e9, ""
    for row in rows:
        seconds, state = float(str(row["s"])), str(row["state"])
        if seconds - told_s < 1.0 and state == told_state:
            continue
        told_s, told_state = seconds, state
        pose = row["pose"]
        where = (
            f"{pose['x_m']:8.2f} {pose['y_m']:8.2f} {pose['yaw_deg']:8.1f}" if isinstance(pose, dict) else f"{'-':>26}"
        )
        candidates = row["candidates"]
        count = len(candidates) if isinstance(candidates, list) else 0
        typer.echo(f"{seconds:8.1f}  {state:<10} {row['probability']:6.3f}  {where}  {count}")
