"""`umfeld map`: maps of a running daemon, or of a map file."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import Trouble, WrongUsage

if TYPE_CHECKING:
    from mapping.geo import Anchor
    from mapping.lines.lines import Lines
    from service.export import MapImage
    from service.zenoh_session import Client

app = typer.Typer()

_PLAIN_ENDINGS = (".yaml", ".pgm", ".png", ".npy", ".json")


class Model(StrEnum):
    """How a grid's cells count."""

    COUNTERS = "counters"
    LOG_ODDS = "log-odds"


class Poses(StrEnum):
    """Where the poses of a log's scans come from."""

    SLAM = "slam"
    LOG = "log"
    ODOMETRY = "odometry"


Connect = Annotated[str | None, typer.Option(help="The daemon's endpoint; default: that of the configuration.")]
Config = Annotated[Path | None, typer.Option("--config", "-c", help="The daemon's configuration file.")]
Robot = Annotated[str | None, typer.Option(help="The robot's id, where several answer.")]
AsJson = Annotated[bool, typer.Option("--json", help="As JSON.")]
Store = Annotated[Path | None, typer.Option(help="A map file instead of a running daemon.")]


@app.command()
def save(
    name: Annotated[str, typer.Argument(help="One word; with --store, a new map file.")],
    *,
    store: Store = None,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """Save the live map under a name, in the daemon's folder of maps; or copy a map file.

    Example: umfeld map save kitchen
    """
    if store is not None:
        with _open(store) as opened:
            receipt = opened.save_as(Path(name) if "." in name else Path(f"{name}.umfeld")).document()
    else:
        with _client(connect, config) as client:
            receipt = client.call(_base(client, robot), "save_map", {"name": name}, timeout_s=60.0)
    _report(receipt, as_json)


@app.command()
def load(
    name: Annotated[str, typer.Argument(help="A name from `umfeld map list`.")],
    *,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """Replace the live map of a running daemon by a saved one.

    Example: umfeld map load kitchen
    """
    with _client(connect, config) as client:
        answer = client.call(_base(client, robot), "load_map", {"name": name}, timeout_s=60.0)
    if as_json:
        _report(answer, as_json)
    else:
        kept = f"; the map before is kept as {answer['kept']}" if answer.get("kept") else ""
        typer.echo(f"{name} is the live map now{kept}")


@app.command()
def new(
    name: Annotated[
        str | None, typer.Argument(help="What the map so far is kept as, one word; none: `until-` and the time.")
    ] = None,
    *,
    store: Store = None,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """Begin an empty map where the robot stands, as after it was carried to another house; the one so far is kept.

    Example: umfeld map new old-house
    """
    from service.new_map import told

    arguments = {} if name is None else {"name": name}
    if store is not None:
        answer = _emptied(store, arguments)
    else:
        with _client(connect, config) as client:
            answer = client.call(_base(client, robot), "new_map", arguments, timeout_s=60.0)
    if as_json:
        _report(answer, as_json)
    else:
        typer.echo(told(answer))


def _emptied(path: Path, arguments: Mapping[str, str]) -> Mapping[str, Any]:
    """As new_map, of a map file that no daemon writes."""
    import time

    from service.new_map import keep_and_empty
    from service.rpc import map_name
    from service.store import MapStore, StoreInUse, StoreTrouble

    name = map_name(arguments) if arguments else None
    if not path.is_file():
        raise StoreTrouble(f"{path}: there is no such map; a daemon makes one by itself")
    try:
        opened = MapStore.open(path, wall_ns=time.time_ns)
    except StoreInUse as trouble:
        raise StoreTrouble(f"{trouble}, or leave --store out: then that daemon does it") from trouble
    with opened:
        return keep_and_empty(opened, name, wall_ns=time.time_ns())


@app.command("list")
def list_saved(
    *,
    folder: Annotated[Path | None, typer.Option(help="Look in a folder instead of asking the daemon.")] = None,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """The saved maps.

    Example: umfeld map list --folder ~/maps
    """
    if folder is not None:
        from service.store import list_maps

        if not folder.is_dir():
            raise WrongUsage(f"{folder}: is not a folder")
        answer: Mapping[str, Any] = {"maps": list_maps(folder)}
    else:
        with _client(connect, config) as client:
            answer = client.call(_base(client, robot), "list_maps")
    if as_json:
        typer.echo(json.dumps(answer, indent=2))
        return
    if not answer["maps"]:
        typer.echo("no saved maps; `umfeld map save NAME` makes one")
    for entry in answer["maps"]:
        note = entry.get("trouble") or _saved_at(entry.get("saved_ns"))
        typer.echo(f"{entry['name']:<24} {entry['bytes'] / 1e6:8.2f} MB  {note}")


@app.command()
def info(
    name: Annotated[
        str | None, typer.Argument(help="A name from `umfeld map list`, a .umfeld or a .yaml file; none: the live map.")
    ] = None,
    *,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """About a map: size, cells, who wrote it.

    Example: umfeld map info kitchen --json
    """
    if name is None:
        with _client(connect, config) as client:
            _report(client.call(_base(client, robot), "map_info"), as_json)
        return
    file = Path(name)
    if not file.exists() and file.name == name and not file.suffix:  # no file: one of the daemon's maps
        with _client(connect, config) as client:
            entry = _saved_map(client.call(_base(client, robot), "list_maps")["maps"], name)
        file = Path(entry["path"])
        if not file.exists():  # the daemon runs elsewhere: what it says of it is all there is
            document = dict(entry) | {"check": entry.get("trouble") or "ok"}
        else:
            document = _info_of_file(file)
    else:
        document = _info_of_file(file)
    _report(document, as_json)
    if document["check"] != "ok":
        raise typer.Exit(1)


def _saved_map(maps: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """The entry of that name in the daemon's list."""
    for entry in maps:
        if entry["name"] == name:
            return entry
    known = ", ".join(sorted(str(entry["name"]) for entry in maps)) or "none"
    raise WrongUsage(f"{name}: is neither a file nor one of the daemon's maps ({known})")


def _info_of_file(file: Path) -> dict[str, Any]:
    """What a map file, or a map server's pair, says of itself; `check` is "ok" or what is wrong."""
    if not _is_store(file):
        return {"path": str(file), "check": "ok", "grid": _grid_info(_image(file))}
    from service.store import check_file

    with _open(file) as opened:
        document: dict[str, Any] = opened.info()
    document["check"] = check_file(file) or "ok"
    if "occupancy" in document["layers"]:
        document["grid"] = _grid_info(_image(file))
    return document


@app.command()
def export(
    out: Annotated[
        Path,
        typer.Argument(
            help="Where to, by the ending. The grid: .yaml (with .pgm), .png, .npy, .json, .tif (GeoTIFF), .ply. "
            "Its walls: .geojson, .svg, .dxf."
        ),
    ],
    *,
    anchor: Annotated[
        str | None,
        typer.Option(
            help="LAT,LON[,YAW] of the map's origin in degrees, for .geojson and .tif; none: metres of the map frame. "
            "Default: what the map itself says."
        ),
    ] = None,
    inflate_m: Annotated[
        float, typer.Option("--inflate", min=0.0, help="Also occupied: all that comes so near, metres, to an obstacle.")
    ] = 0.0,
    store: Store = None,
    connect: Connect = None,
    config: Config = None,
    robot: Robot = None,
    as_json: AsJson = False,
) -> None:
    """Write the map as a file other programs read: the grid (PGM and YAML are the ROS map server's) or its walls.

    Walls are the lines that the laser saw, or the borders of occupied cells where nobody kept lines.

    Example: umfeld map export kitchen.yaml --store kitchen.umfeld --inflate 0.3
    """
    from service.export import save_grid

    if out.suffix.lower() in _PLAIN_ENDINGS:  # light: nothing that only walls and places on the earth need
        plain = _plain_image(store, connect, config, robot)
        _tell_files(
            [each.document() for each in save_grid(_inflated(plain, inflate_m) if inflate_m else plain, out)], as_json
        )
        return
    from service.map_export import save_map

    place = None if anchor in (None, "none") else _anchor(str(anchor))
    if store is not None:
        image, walls, own = _image(store), _lines_of_file(store), _anchor_of_file(store)
    else:
        with _client(connect, config) as client:
            base = _base(client, robot)
            image, walls = _live_image(client, base), _live_lines(client, base)
            own = client.call(base, "map_info").get("store", {}).get("meta", {}).get("anchor")
    if anchor is None and own is not None:
        place = _stored_anchor(own)
    if inflate_m > 0.0:
        image, walls = _inflated(image, inflate_m), None
    _tell_files([receipt.document() for receipt in save_map(image, walls, out, anchor=place)], as_json)


@app.command("import")
def import_map(
    source: Annotated[Path, typer.Argument(help="A map server's .yaml, beside its picture.")],
    out: Annotated[Path, typer.Argument(help="The map file to make, NAME.umfeld.")],
    *,
    resolution: Annotated[float | None, typer.Option(help="Cells of this many metres; default: the picture's.")] = None,
    model: Annotated[Model, typer.Option(help="As grid.model of the daemon that shall load it.")] = Model.COUNTERS,
    anchor: Annotated[
        str | None, typer.Option(help="LAT,LON[,YAW] of the map's origin on the earth, in degrees; kept in the file.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace the file if it is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make a map file from a grid of another program; turned origins and any size are fine.

    Beside the daemon's own map file it can be loaded by name: `umfeld map load floor1`.

    Example: umfeld map import floor1.yaml floor1.umfeld
    """
    from service.export import load_pgm_yaml, patch_of
    from service.map_import import write_imported_map

    if out.suffix != ".umfeld":
        raise WrongUsage(f"{out}: a map file ends with .umfeld")
    if out.exists() and not force:
        raise WrongUsage(f"{out}: is there already; choose another name, or replace it with --force")
    if resolution is not None and not 0.001 <= resolution <= 10.0:
        raise WrongUsage(f"--resolution {resolution}: metres a cell, from 0.001 to 10")
    patch = patch_of(load_pgm_yaml(source), resolution)
    place = None if anchor is None else _anchor(anchor)
    receipt = write_imported_map(patch, out, source=source.name, model=model.value, anchor=place)
    _report(receipt.document(), as_json)


@app.command()
def build(
    log: Annotated[Path, typer.Argument(help="A recorded log.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the results; made if absent.")],
    poses: Annotated[
        Poses,
        typer.Option(help="slam: found from the scans; log: as the log has them; odometry: only if they are odometry."),
    ] = Poses.SLAM,
    every: Annotated[int, typer.Option(min=1, help="Use every N-th scan.")] = 1,
    hold_out: Annotated[int, typer.Option(min=0, help="Keep every N-th scan back and judge the grid by it.")] = 0,
    resolution: Annotated[float, typer.Option(min=0.005, max=1.0, help="Metres a cell.")] = 0.05,
    model: Annotated[Model, typer.Option(help="How cells count.")] = Model.LOG_ODDS,
    crisp: Annotated[
        bool, typer.Option(help="Find walls in all scans together; --no-crisp leaves each cell as it was counted.")
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Map a recorded log offline: trajectory, grid in every form, report.

    Example: umfeld map build seattle-corrected.log.gz --out seattle --hold-out 10
    """
    from rich.console import Console
    from rich.progress import Progress

    from service import map_build

    console = Console(stderr=True)
    with console.status("compiling the kernels, if they have changed") if console.is_terminal else nullcontext():
        subprocess.run([sys.executable, "-m", "service.warm_up", "logs"], check=False)  # in here it would stay: 80 MB
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(log.name, total=None)
        built = map_build.build(
            log,
            poses=map_build.PoseSource(poses.value),
            every=every,
            hold_out=hold_out,
            resolution_m=resolution,
            model=model.value,
            crisp=crisp,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    _report(map_build.write(built, out, source=map_build.PoseSource(poses.value)), as_json)


def _client(connect: str | None, config: Path | None) -> Client:
    from service.zenoh_session import client_for

    return client_for(connect, config)


def _base(client: Client, robot: str | None) -> str:
    return client.only_base(None if robot is None else f"robots/{robot}")


def _open(path: Path) -> Any:
    from service.store import MapStore

    return MapStore.open(path, wall_ns=lambda: 0, read_only=True)


def _is_store(path: Path) -> bool:
    return path.suffix not in (".yaml", ".yml")


def _image(path: Path) -> MapImage:
    """The grid of a map file or of a map server's pair."""
    from service.export import image_of, load_pgm_yaml
    from service.store import occupancy_patch

    if not _is_store(path):
        return load_pgm_yaml(path)
    with _open(path) as opened:
        return image_of(occupancy_patch(opened))


def _plain_image(store: Path | None, connect: str | None, config: Path | None, robot: str | None) -> MapImage:
    if store is not None:
        return _image(store)
    with _client(connect, config) as client:
        return _live_image(client, _base(client, robot))


def _tell_files(receipts: Sequence[Mapping[str, Any]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"files": receipts}, indent=2))
        return
    for receipt in receipts:
        typer.echo(_receipt_line(receipt))


def _anchor(text: str) -> Anchor:
    """LAT,LON[,YAW] in degrees; YAW is the map's x axis, counter-clockwise from east."""
    import math

    from mapping.geo import Anchor

    try:
        latitude, longitude, yaw = (*(float(part) for part in text.split(",")), 0.0)[:3]
        return Anchor(latitude, longitude, yaw_rad=math.radians(yaw))
    except ValueError as error:
        raise WrongUsage(f"--anchor {text}: LAT,LON or LAT,LON,YAW in degrees, such as 49.42,7.75") from error


def _stored_anchor(fields: Mapping[str, float]) -> Anchor:
    import math

    from mapping.geo import Anchor

    yaw_rad = math.radians(fields["yaw_deg"])
    return Anchor(fields["latitude_deg"], fields["longitude_deg"], fields["height_m"], yaw_rad)


def _anchor_of_file(path: Path) -> Mapping[str, float] | None:
    if not _is_store(path):
        return None
    with _open(path) as opened:
        anchor: Mapping[str, float] | None = opened.get_meta("anchor")
        return anchor


def _lines_of_file(path: Path) -> Lines | None:
    from service.map_export import lines_of_store

    if not _is_store(path):
        return None
    with _open(path) as opened:
        return lines_of_store(opened)


def _live_lines(client: Client, base: str) -> Lines | None:
    """The line map of a running daemon, if it keeps one."""
    from service.map_export import lines_of_document

    answers = client.get(f"{base}/map/lines", timeout_s=10.0)
    return lines_of_document(json.loads(answers[0].payload)) if answers else None


def _inflated(image: MapImage, radius_m: float) -> MapImage:
    """Where the middle of a round vehicle of that radius can be."""
    from dataclasses import replace

    from mapping.grids.clearance import inflated
    from mapping.grids.patch import GridPatch

    return replace(image, cells=inflated(GridPatch(image.resolution_m, 0, 0, image.cells), radius_m).cells)


def _live_image(client: Client, base: str) -> MapImage:
    """The last full grid of a running daemon."""
    from mapping.frames import Pose2
    from service.cdr import decode_grid
    from service.export import MapImage

    answers = client.get(f"{base}/map/grid", timeout_s=10.0)
    if not answers:
        raise Trouble(f"{base} has published no grid yet; let the robot drive a little, then try again")
    grid = decode_grid(answers[0].payload)
    x_m, y_m, _z = grid.origin_position
    resolution_m = round(grid.resolution, 7)  # it travels as a float32
    return MapImage(grid.cells, resolution_m, Pose2(x_m, y_m, 0.0))


def _grid_info(image: MapImage) -> dict[str, Any]:
    rows, columns = image.cells.shape
    occupied, free = int((image.cells >= 65).sum()), int(((image.cells >= 0) & (image.cells < 20)).sum())
    area = image.resolution_m**2
    return {
        "rows": rows,
        "columns": columns,
        "resolution_m": image.resolution_m,
        "origin": {"x_m": image.origin.x_m, "y_m": image.origin.y_m, "yaw_rad": image.origin.yaw_rad},
        "occupied_cells": occupied,
        "free_m2": round(free * area, 3),
    }


def _report(document: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(document, indent=2, ensure_ascii=False))
    elif {"path", "bytes", "sha256"} <= set(document):
        typer.echo(_receipt_line(document))
    else:
        for line in _lines(document):
            typer.echo(line)


def _receipt_line(receipt: Mapping[str, Any]) -> str:
    return f"{receipt['path']}  {receipt['bytes']} bytes  sha256 {receipt['sha256'][:16]}…  {receipt['saved_at']}"


def _lines(value: Any, name: str = "") -> Sequence[str]:
    """A JSON object for people: one value a line, the path to it in front."""
    if isinstance(value, Mapping) and value:
        return [line for key, entry in value.items() for line in _lines(entry, f"{name}.{key}" if name else str(key))]
    return [f"{name}: {value}"]


def _saved_at(saved_ns: Any) -> str:
    from datetime import UTC, datetime

    if not isinstance(saved_ns, int):
        return "never saved"
    return datetime.fromtimestamp(saved_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
