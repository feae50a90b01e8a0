"""`umfeld extract`: one algorithm on one file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from service.files import Receipt

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
    _tell(found.report, written, as_json)


@app.command()
def planes(
    file: Annotated[Path, typer.Argument(help="A cloud: .pcd, .ply, .xyz, .3d, or a depth image .png; plain or .gz.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".json or .ply; default: JSON to the screen.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Calibration of a depth image; default: the one beside it.")
    ] = None,
    book: Annotated[
        bool, typer.Option("--book", help="The book's algorithm 5.2 as it stands, not the refined.")
    ] = False,
    cell_m: Annotated[float, typer.Option(help="Edge of a cubic cell.")] = 0.2,
    min_points: Annotated[int, typer.Option(help="Points of a cell, to look for a plane in it.")] = 10,
    iterations: Annotated[int, typer.Option(help="Of RANSAC in a cell, at most.")] = 50,
    inlier_m: Annotated[float, typer.Option(help="Farthest that a point of a plane is off.")] = 0.05,
    angle_deg: Annotated[float, typer.Option(help="Between the normals of neighbouring cells.")] = 15.0,
    apart_m: Annotated[float, typer.Option(help="From a cell's plane to its neighbour's centre of gravity.")] = 0.05,
    min_cells: Annotated[
        int, typer.Option(help="Supporting cells of a plane; the refined form: times min-points.")
    ] = 10,
    noise_m: Annotated[float | None, typer.Option(help="Noise of ranges; default: taken from the cloud.")] = None,
    range_max_m: Annotated[float | None, typer.Option(help="Farther points are no echo.")] = None,
    beam_deg: Annotated[float | None, typer.Option(help="Angle between beams: warns if cells are too small.")] = None,
    seed: Annotated[int, typer.Option(help="Of RANSAC.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON; needs --out or --png.")] = False,
) -> None:
    """Planes of a point cloud: walls, floors, table tops, with their outlines.

    Example: umfeld extract planes room.pcd --out planes.json --png planes.png
    """
    import math
    from dataclasses import replace

    from mapping.planes.extract import PlaneRules, RangeNoise
    from service.errors import WrongUsage
    from service.plane_files import json_bytes, planes_of_file, range_warning_of, write_planes

    if as_json and out is None and png is None:
        raise WrongUsage("--json reports on files: say where with --out or --png (without them the planes are printed)")
    try:
        rules = replace(
            PlaneRules.book() if book else PlaneRules(),
            cell_m=cell_m,
            min_points=min_points,
            iterations=iterations,
            inlier_m=inlier_m,
            angle_rad=math.radians(angle_deg),
            apart_m=apart_m,
            min_cells=min_cells,
            seed=seed,
        )
        if noise_m is not None:
            rules = replace(rules, noise=RangeNoise(noise_m))
    except ValueError as error:
        raise WrongUsage(str(error)) from error
    found = planes_of_file(
        file, rules=rules, camera=camera, range_max_m=math.inf if range_max_m is None else range_max_m
    )
    if beam_deg is not None and (warning := range_warning_of(found, rules, beam_deg)):
        typer.echo(warning, err=True)
    if out is None and png is None:
        typer.echo(json_bytes(found.planes, frame="sensor").decode(), nl=False)
        return
    _tell(found.report, [write_planes(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


@app.command()
def regions(
    file: Annotated[Path, typer.Argument(help="A floor plan in GeoJSON, in metres: polygons, or a line map.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".geojson; default: to the screen.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    simplify_m: Annotated[float, typer.Option(min=0.0, help="Leave out corners that stand out less.")] = 0.0,
    door_m: Annotated[float, typer.Option(min=0.0, help="Wider passages join regions to one room.")] = 1.3,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON; needs --out or --png.")] = False,
) -> None:
    """Convex free regions, the passages between them, and the rooms these make.

    Example: umfeld extract regions plan.geojson --out regions.geojson --png regions.png
    """
    from service.errors import WrongUsage
    from service.region_files import geojson_bytes, regions_of_file, write_regions

    if as_json and out is None and png is None:
        raise WrongUsage("--json reports on files: say where with --out or --png (without them GeoJSON is printed)")
    found = regions_of_file(file, simplify_m=simplify_m, door_m=door_m)
    if out is None and png is None:
        typer.echo(geojson_bytes(found).decode(), nl=False)
        return
    _tell(found.report, [write_regions(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


@app.command()
def quadtree(
    file: Annotated[Path, typer.Argument(help="A grid map: .yaml with its picture, or a .pgm or .png.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".uqdt, the tree as bytes.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw its squares, too.")] = None,
    resolution_m: Annotated[float | None, typer.Option(help="Metres a pixel, of a picture without .yaml.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """A grid map as a quadtree: how many squares of one kind it takes.

    Example: umfeld extract quadtree map.yaml --out map.uqdt --png squares.png
    """
    from service.space_files import quadtree_of_file, write_extracted

    found = quadtree_of_file(file, resolution_m=resolution_m)
    _tell(found.report, [write_extracted(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


@app.command()
def octree(
    file: Annotated[Path, typer.Argument(help="A point cloud (.pcd .ply .xyz .3d) or a depth image (.png).")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".uoct, the tree as bytes.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw the layer at --height-m, too.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Calibration of a depth image; default: the one beside it.")
    ] = None,
    resolution_m: Annotated[float, typer.Option(min=0.001, help="Edge of a voxel.")] = 0.05,
    sensor: Annotated[tuple[float, float, float], typer.Option(help="Where the sensor was: x y z in metres.")] = (
        0.0,
        0.0,
        0.0,
    ),
    range_max_m: Annotated[float | None, typer.Option(min=0.01, help="Farther points are no echo.")] = None,
    height_m: Annotated[float | None, typer.Option(help="Of the layer to draw; default: the sensor's.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Voxels that a point cloud shows free and occupied, as an octree.

    Example: umfeld extract octree room.pcd --out room.uoct --png layer.png
    """
    import math

    from service.errors import WrongUsage
    from service.space_files import octree_of_file, write_extracted

    try:
        found = octree_of_file(
            file,
            camera=camera,
            resolution_m=resolution_m,
            sensor_m=sensor,
            range_max_m=math.inf if range_max_m is None else range_max_m,
            height_m=height_m,
        )
    except ValueError as error:
        raise WrongUsage(str(error)) from error
    _tell(found.report, [write_extracted(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


@app.command()
def elevation(
    file: Annotated[Path, typer.Argument(help="A point cloud (.pcd .ply .xyz .3d) or a depth image (.png), z up.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".json, every layer by rows.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw heights and ground, too.")] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Calibration of a depth image; default: the one beside it.")
    ] = None,
    resolution_m: Annotated[float, typer.Option(min=0.001, help="Edge of a cell.")] = 0.1,
    slope_max_deg: Annotated[float, typer.Option(help="Steeper is not traversable.")] = 20.0,
    step_max_m: Annotated[float, typer.Option(help="Higher is not traversable.")] = 0.08,
    roughness_max_m: Annotated[float, typer.Option(help="Rougher (rms) is not traversable.")] = 0.03,
    height_max_m: Annotated[float | None, typer.Option(help="Leave out points above: ceilings.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Heights of a point cloud by cell: slope, step, roughness, and where a vehicle can drive.

    Example: umfeld extract elevation room.pcd --height-max-m 0.5 --out ground.json --png ground.png
    """
    import math

    from mapping.grids.height import GroundRules
    from service.errors import WrongUsage
    from service.space_files import elevation_of_file, write_extracted

    try:
        rules = GroundRules(
            slope_max_rad=math.radians(slope_max_deg), step_max_m=step_max_m, roughness_max_m=roughness_max_m
        )
    except ValueError as error:
        raise WrongUsage(str(error)) from error
    found = elevation_of_file(
        file,
        camera=camera,
        resolution_m=resolution_m,
        rules=rules,
        height_max_m=math.inf if height_max_m is None else height_max_m,
    )
    _tell(found.report, [write_extracted(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


@app.command()
def rooms(
    file: Annotated[Path, typer.Argument(help="A grid map: .yaml with its .pgm, or a picture, white free.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".geojson; default: to the screen.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    resolution_m: Annotated[float, typer.Option(min=0.005, max=1.0, help="Of a picture without .yaml.")] = 0.05,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON; needs --out or --png.")] = False,
) -> None:
    """Rooms of a grid map and the doors between them.

    Example: umfeld extract rooms map.yaml --out rooms.geojson --png rooms.png
    """
    _extract_rooms(file, out, png, resolution_m, as_json, with_diagram=False)


@app.command()
def voronoi(
    file: Annotated[Path, typer.Argument(help="A grid map: .yaml with its .pgm, or a picture, white free.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".geojson; default: to the screen.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    resolution_m: Annotated[float, typer.Option(min=0.005, max=1.0, help="Of a picture without .yaml.")] = 0.05,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON; needs --out or --png.")] = False,
) -> None:
    """The Voronoi diagram of a grid map as a graph, with the rooms and doors it yields.

    Example: umfeld extract voronoi map.yaml --out voronoi.geojson --png voronoi.png
    """
    _extract_rooms(file, out, png, resolution_m, as_json, with_diagram=True)


def _extract_rooms(
    file: Path, out: Path | None, png: Path | None, resolution_m: float, as_json: bool, *, with_diagram: bool
) -> None:
    from service.errors import WrongUsage
    from service.room_files import geojson_bytes, rooms_of_file, write_rooms

    if as_json and out is None and png is None:
        raise WrongUsage("--json reports on files: say where with --out or --png (without them GeoJSON is printed)")
    found = rooms_of_file(file, resolution_m=resolution_m, with_diagram=with_diagram)
    if out is None and png is None:
        typer.echo(geojson_bytes(found).decode(), nl=False)
        return
    _tell(found.report, [write_rooms(found, path) for path in (out, _as_png(png)) if path is not None], as_json)


def _tell(facts: dict[str, object], written: Sequence[Receipt], as_json: bool) -> None:
    """The report on the screen."""
    if as_json:
        typer.echo(json.dumps({**facts, "files": [receipt.document() for receipt in written]}, indent=2))
        return
    for name, value in facts.items():
        typer.echo(f"{name:<18} {value}")
    for receipt in written:
        typer.echo(f"{receipt.path}  {receipt.size} bytes")


@app.command()
def features(
    file: Annotated[Path, typer.Argument(help="A scan log: CARMEN, robotdata, tinySLAM; plain or .gz.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", "-o", help=".json; default: to the screen.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw them, too.")] = None,
    scan: Annotated[int, typer.Option(help="Which scan, from 0; negative from the end.")] = 0,
) -> None:
    """What one scan looks like: moments, main orientation, walls, box, anchor points and their graph.

    Example: umfeld extract features intel.clf.gz --scan 2500 --out features.json --png features.png
    """
    from service.errors import WrongUsage
    from service.feature_files import features_of_log, json_bytes, png_bytes
    from service.files import write_whole

    if out is not None and out.suffix.lower() != ".json":
        raise WrongUsage(f"--out {out}: features are written as .json")
    picture = _as_png(png)
    found = features_of_log(file, scan=scan)
    written = [] if out is None else [write_whole(out, json_bytes(found.document))]
    if picture is not None:
        written.append(write_whole(picture, png_bytes(found)))
    if out is None:
        typer.echo(json_bytes(found.document).decode(), nl=False)
        return
    for receipt in written:
        typer.echo(f"{receipt.path}  {receipt.size} bytes")


def _as_png(path: Path | None) -> Path | None:
    from service.errors import WrongUsage

    if path is not None and path.suffix.lower() != ".png":
        raise WrongUsage(f"--png {path}: a picture's name ends in .png")
    return path
