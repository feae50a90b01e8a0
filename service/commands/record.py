"""`umfeld record`: keep what happens, of a running daemon or from the first byte of a new one."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.errors import Trouble, WrongUsage

if TYPE_CHECKING:
    from service.zenoh_session import Client

app = typer.Typer()


@app.command()
def record(
    *,
    out: Annotated[Path | None, typer.Option(help="Folder for the recording; default: the configured one.")] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="End after so long; 0: when interrupted.")] = 0.0,
    raw_only: Annotated[bool, typer.Option("--raw-only", help="Only what replay needs, nothing published.")] = False,
    detach: Annotated[bool, typer.Option("--detach", help="Start recording in the daemon and return.")] = False,
    stop: Annotated[bool, typer.Option("--stop", help="End the recording of a running daemon.")] = False,
    connect: Annotated[
        str | None, typer.Option(help="The daemon's endpoint; default: that of the configuration.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The daemon's configuration file.")] = None,
    robot: Annotated[str | None, typer.Option(help="The robot's id, where several answer.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE for a daemon that is started; repeatable.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Record every byte of every wire with its time, and everything published, as MCAP.

    Where a daemon runs, it records until you interrupt this command; every device is set up anew at the start, so that
    its set-up is in the recording (readings pause for about a second). Where none runs, it is started here with a
    recording from the first byte on: its replay ends with the very same map.

    Example: umfeld record --seconds 60 --out recordings
    """
    client = _client(connect, config)
    if client is None:
        if stop or detach or connect is not None:
            raise Trouble("no daemon answers; start it with `umfeld run`, or say --connect with its endpoint")
        _run_recording(config, settings or [], out, seconds, raw_only)
        return
    if settings:
        raise WrongUsage("--set is for a daemon that is started here; one is running already")
    with client:
        base = client.only_base(None if robot is None else f"robots/{robot}")
        if stop:
            _report(client.call(base, "record_stop", timeout_s=20.0), as_json)
            return
        if detach and out is not None:
            raise WrongUsage("--detach leaves the files with the daemon, in [recording] folder; leave --out away")
        begun = client.call(base, "record_start", {"published": False if raw_only else None}, timeout_s=20.0)
        if detach:
            _report(begun, as_json)
            return
        typer.echo(f"recording to {begun['file']}; Ctrl-C ends it", err=True)
        try:
            _wait(client, base, seconds)
        except KeyboardInterrupt:
            typer.echo("", err=True)
        done = client.call(base, "record_stop", timeout_s=20.0)
        _report(done if out is None else {**done, "files": _fetched(done["files"], out)}, as_json)


def _client(connect: str | None, config: Path | None) -> Client | None:
    """A connection to a running daemon, None if there is none."""
    from service.zenoh_session import NoDaemon, client_for

    try:
        client = client_for(connect, config)
    except NoDaemon:
        return None
    if client.bases():
        return client
    client.close()
    return None


def _wait(client: Client, base: str, seconds: float) -> None:
    deadline = time.monotonic() + (seconds or float("inf"))
    told: str | None = None
    while (left := deadline - time.monotonic()) > 0:
        time.sleep(min(left, 1.0))
        status = client.call(base, "record_status")
        if not status["recording"]:
            raise Trouble("the daemon ended the recording by itself; its log says why")
        if status["trouble"] != told and status["trouble"] is not None:
            typer.secho(status["trouble"], fg="red", err=True)
        told = status["trouble"]


def _fetched(files: list[str], out: Path) -> list[str]:
    """Copies of the daemon's files in a folder of the user's; the daemon writes only where it was told to."""
    import shutil

    try:
        out.mkdir(parents=True, exist_ok=True)
        return [str(shutil.copy2(file, out)) for file in files]
    except OSError as error:
        raise Trouble(
            f"{out}: {error.strerror or error}: the recording could not be copied there; it is whole in "
            f"{', '.join(files)} (they belong to the daemon's user)"
        ) from error


def _run_recording(config: Path | None, settings: list[str], out: Path | None, seconds: float, raw_only: bool) -> None:
    """Be the daemon, with a recording from its first byte."""
    from service.commands.run import serve

    wanted = [*settings, "recording.enabled=true"]
    if out is not None:
        wanted.append(f"recording.folder={json.dumps(str(out.absolute()))}")
    if raw_only:
        wanted.append("recording.published=false")
    typer.echo("no daemon is running: this is one now, and it records; Ctrl-C ends both", err=True)
    serve(config, wanted, seconds=seconds)


def _report(answer: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(answer, indent=2))
        return
    for name in answer.get("files", [answer["file"]] if "file" in answer else []):
        typer.echo(name)
    if not answer.get("recording", True):
        typer.echo("nothing was being recorded")
    lost = answer.get("lost", 0) + answer.get("not_written", 0)
    if lost:
        typer.secho(f"{lost} records were lost: the disk is too slow or full", fg="red", err=True)
    if answer.get("trouble"):
        typer.secho(str(answer["trouble"]), fg="red", err=True)
        raise typer.Exit(1)
