"""`umfeld replay`: a recording through the real drivers and fusion."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import Trouble, WrongUsage

if TYPE_CHECKING:
    from service.config import Config
    from service.replay import Recording, Replay

app = typer.Typer()


@app.command()
def replay(
    file: Annotated[Path, typer.Argument(help="A file of the recording, or the folder: its newest recording.")],
    *,
    out: Annotated[Path | None, typer.Option(help="Folder for map, trajectory and report; made if absent.")] = None,
    speed: Annotated[float, typer.Option(min=0.0, help="Times real time; 0: as fast as possible.")] = 0.0,
    listen: Annotated[
        str | None, typer.Option(help="Publish on this endpoint meanwhile, e.g. tcp/127.0.0.1:7448.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="Another configuration than recorded.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE over --config or the recorded one.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Play recorded bytes through the drivers and build the map again, by the recording's clock.

    A recording from a daemon's first byte gives the map that was made live, bit for bit, at any speed; the report says
    so. With --config or --set other maps are made from the same bytes. Exit code 1: the map is not the recorded one.

    Example: umfeld replay recordings --out again
    """
    from service.replay import Recording, Replay

    recording = Recording.of(file)
    changed = _changed_config(recording, config, settings or [])
    player = Replay(recording, config=changed)
    if listen is not None:
        player.pace = _pace(player, speed or 1.0)
        with _published(player, listen):
            _play(player)
    else:
        if speed:
            player.pace = _pace(player, speed)
        _play(player)
    report = player.finish().document()
    if out is not None:
        report["files"] = _write(player, out)
        (out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        _tell(report)
    if report["same_map_as_live"] is False and changed is None and report["exact"]:
        raise typer.Exit(1)


def _changed_config(recording: Recording, config: Path | None, settings: list[str]) -> Config | None:
    """The configuration to play with, None for the recorded one as it is."""
    from service.config import check, load
    from service.config_files import Layers, read_layers

    if config is not None:
        return load(config, settings=settings).config
    if not settings:
        return None
    data = json.loads(recording.head().start.config)
    _merge(data, read_layers(None, environment={}, settings=settings).data)
    return check(Layers(data, {}, {}, ()))


def _merge(data: dict[str, Any], more: Mapping[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, Mapping) and isinstance(data.get(key), dict):
            _merge(data[key], value)
        else:
            data[key] = value


def _pace(player: Replay, speed: float) -> Callable[[int], None]:
    """Hold the replay back to so many times real time."""
    began_ns, begun_ns = time.monotonic_ns(), player.head.begun_ns

    def wait(now_ns: int) -> None:
        ahead_s = ((now_ns - begun_ns) / speed - (time.monotonic_ns() - began_ns)) / 1e9
        if ahead_s > 0:
            time.sleep(min(ahead_s, 10.0))

    return wait


@contextmanager
def _published(player: Replay, endpoint: str) -> Iterator[None]:
    """What comes out is published as a daemon would, by the recording's clock."""
    from service.config_around import is_local
    from service.daemon import robot_info
    from service.publisher import Publisher
    from service.zenoh_session import NetworkSettings

    if not is_local(endpoint):
        raise WrongUsage(f"--listen {endpoint}: a replay is for this machine only, for example tcp/127.0.0.1:7448")
    config = player.config
    publisher = Publisher(f"robots/{config.robot.id}", NetworkSettings(listen=(endpoint,)), clock=player.clock)
    publisher.start()
    typer.echo(f"publishing robots/{config.robot.id} on {endpoint}; umfeld view --connect {endpoint}", err=True)
    publisher.publish_info(robot_info(config, player.head.begun_ns + player.head.wall_offset_ns))
    player.offer = publisher.offer
    try:
        yield
    finally:
        publisher.close()


def _play(player: Replay) -> None:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    total = sum(path.stat().st_size for path in player.recording.files)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("replay", total=total)
        for count, _ in enumerate(player.steps()):
            if count % 1000 == 0:
                bar.update(task, completed=player.recording.bytes_read)


def _write(player: Replay, out: Path) -> list[str]:
    """Map and trajectory, in the forms of `umfeld map build`."""
    from service.export import image_of, save_grid, save_pgm_yaml
    from service.files import write_whole
    from service.map_import import write_grid_map
    from service.replay import trajectory_text

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Trouble(f"{out}: cannot be made: {error.strerror}") from error
    receipts = [write_whole(out / "trajectory.tum", trajectory_text(player).encode())]
    grid = player.grid
    if grid is not None and grid.patch().cells.size:
        image = image_of(grid.patch())
        receipts += save_pgm_yaml(image, out / "map.yaml")
        receipts += save_grid(image, out / "map.png")
        receipts.append(write_grid_map(grid, out / "map.umfeld", source=player.recording.files[0].name))
    return [str(receipt.path) for receipt in receipts]


def _tell(report: Mapping[str, Any]) -> None:
    typer.echo(
        f"{report['recorded_seconds']:.1f} s recorded: {report['records']} records, {report['readings']} readings, "
        f"{report['requests_as_recorded']} requests as recorded, {report['requests_otherwise']} otherwise"
    )
    typer.echo(f"map sha256 {report['map_sha256'] or '(there is no map)'}")
    same = report["same_map_as_live"]
    if not report["readings"]:
        text = "nothing to play: the recording holds no reading of any device (`umfeld check` opens each and tells why)"
        typer.secho(text, fg="yellow")
    if same is not None:
        text = "bit for bit the map that was made live" if same else "NOT the map that was made live"
        typer.secho(text, fg="green" if same else "red")
    for why in report["why_not"]:
        typer.secho(f"not exact: {why}", fg="yellow")
    if report["errors"]:
        typer.secho(f"{report['errors']} errors; see the log above", fg="red")
