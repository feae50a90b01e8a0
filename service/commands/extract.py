"""`umfeld extract`: one algorithm on one file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.callback()
def extract() -> None:
    """One algorithm on one file; the result as GeoJSON or JSON, --png draws it."""


@app.command()
def lines(
    file: Annotated[Path, typer.Argument(help="A scan log: CARMEN, robotdata, tinySLAM; plain or .gz.")],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=".geojson, .svg or .dxf; default: to the screen.")
    ] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    scan: Annotated[int | None, typer.Option(help="Only this scan, from 0, in the laser's frame.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Use every N-th scan.")] = 1,
    min_seen: Annotated[int, typer.Option(min=1, help="Leave out what fewer scans saw.")] = 2,
    min_points: Annotated[int, typer.Option(min=1, help="Leave out what fewer points support.")] = 12,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON; needs --out or --png.")] = False,
) -> None:
    """Straight walls: of one scan, or of a whole run as a map, by the poses in the log.

    Example: umfeld extract lines seattle.log.gz --out walls.geojson --png walls.png
    """
    from service.errors import WrongUsage
    from service.line_files import geojson_bytes, write_lines
    from service.log_lines import lines_of_log

    if as_json and out is None and png is None:
        raise WrongUsage("--json reports on files: say where with --out or --png (without them GeoJSON is printed)")
    found = lines_of_log(file, scan=scan, every=every, min_seen=min_seen, min_points=min_points)
    if out is None and png is None:
        typer.echo(geojson_bytes(found.lines, frame=found.frame).decode(), nl=False)
        return
    written = [write_lines(found.lines, path, frame=found.frame) for path in (out, _as_png(png)) if path is not None]
    report = {**found.report, "files": [receipt.document() for receipt in written]}
    if as_json:
        typer.echo(json.dumps(report, indent=2))
        return
    for name, value in found.report.items():
        typer.echo(f"{name:<16} {value}")
    for receipt in written:
        typer.echo(f"{receipt.path}  {receipt.size} bytes")


def _as_png(path: Path | None) -> Path | None:
    from service.errors import WrongUsage

    if path is not None and path.suffix.lower() != ".png":
        raise WrongUsage(f"--png {path}: a picture's name ends in .png")
    return path
