"""`umfeld demo`: emulated robot, daemon and page as three processes, wired together on this machine only."""

from __future__ import annotations

import shutil
import signal
import socket
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from service.config_files import DEFAULT_ENDPOINT
from service.errors import Trouble
from service.locks import Claims
from service.processes import Child, Family

app = typer.Typer()

COMPILING = "compiling the kernels"
"""Of the line with which service.warm_up begins; that module is too heavy for here."""

_COMPILING_TOLD_S = 10.0


@app.command()
def demo(
    *,
    headless: Annotated[bool, typer.Option("--headless", help="Do not open a browser.")] = False,
    seconds: Annotated[float, typer.Option(min=0.0, help="End after so many seconds; 0: when interrupted.")] = 0.0,
    port: Annotated[int, typer.Option(min=0, max=65535, help="The page's port on 127.0.0.1; 0: a free one.")] = 0,
    world: Annotated[str, typer.Option(help="The world to drive through: a name or a floor plan file.")] = "flat",
    preset: Annotated[str, typer.Option(help="The robot.")] = "artos",
    keep: Annotated[Path | None, typer.Option(help="Keep configuration, outputs and map in this folder.")] = None,
) -> None:
    """An emulated robot maps a flat before your eyes: emulated devices on ptys, the daemon, the page.

    Example: umfeld demo --headless --seconds 60 --port 8080
    """
    folder = keep or Path(tempfile.mkdtemp(prefix="umfeld-demo-"))
    folder.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # its terminal is closed; under nohup it outlives that
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    try:
        with Family(folder) as family, Claims() as claims:
            endpoint = _endpoint(claims)
            address = _start_all(family, folder, endpoint, world=world, preset=preset, port=port)
            connect = "" if endpoint == DEFAULT_ENDPOINT else f" --connect {endpoint}"
            typer.echo(f"page     {address}")
            typer.echo(f"daemon   {endpoint}; in another terminal: umfeld status{connect}")
            typer.echo(f"outputs  {folder}")
            typer.echo("Ctrl-C ends the demo." if not seconds else f"The demo ends by itself after {seconds:.0f} s.")
            sys.stdout.flush()
            if not headless:
                webbrowser.open(address)
            _watch(family, seconds, tell=typer.echo)
    except KeyboardInterrupt:
        typer.echo("ended")
    finally:
        if keep is None:
            shutil.rmtree(folder, ignore_errors=True)


def _endpoint(claims: Claims) -> str:
    """The one that every command asks by itself, if no other daemon or demo has it; else a free one."""
    try:
        claims.claim_endpoint(DEFAULT_ENDPOINT)
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the daemon will, past old connections
            probe.bind(_host_and_port(DEFAULT_ENDPOINT))
        return DEFAULT_ENDPOINT
    except (Trouble, OSError):
        return f"tcp/127.0.0.1:{_free_port()}"


def _start_all(family: Family, folder: Path, endpoint: str, *, world: str, preset: str, port: int) -> str:
    """Start the three in the order in which they need each other; returns the page's address."""
    python = [sys.executable, "-m"]
    config = folder / "umfeld.toml"
    family.start("sim", [*python, "sim_devices", "--preset", preset, "--world", world, "--dir", str(folder)])
    family.wait_for("the emulators' configuration", config.exists, seconds=20.0)
    overlay = folder / "umfeld.d"
    overlay.mkdir(exist_ok=True)
    (overlay / "demo.toml").write_text(
        f'[network]\nlisten = ["{endpoint}"]\n\n[store]\npath = "{folder / "demo.umfeld"}"\n'
    )
    family.start("run", [*python, "service", "run", "--config", str(config)])
    family.wait_for("the daemon", lambda: _answers(endpoint), seconds=60.0)
    view = family.start("view", [*python, "service", "view", "--connect", endpoint, "--port", str(port)])
    family.wait_for("the page", lambda: _address_in(view) is not None, seconds=20.0)
    address = _address_in(view)
    if address is None:
        raise Trouble("the page gave no address")
    return address


def _watch(family: Family, seconds: float, *, tell: Callable[[str], None]) -> None:
    """Until the time is up; tell: given the line that says why the page stays empty for a while."""
    begun = time.monotonic()
    deadline = begun + seconds if seconds else float("inf")
    may_compile = True
    while (now := time.monotonic()) < deadline:
        family.check()
        if may_compile and _compiles(family):
            tell("The daemon compiles its kernels first, as after each update: about a minute, then the page fills.")
            may_compile = False
        may_compile &= now - begun < _COMPILING_TOLD_S
        time.sleep(0.2)


def _compiles(family: Family) -> bool:
    """Whether the daemon has said so."""
    return any(COMPILING in child.last_lines() for child in family.children if child.name == "run")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _answers(endpoint: str) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(_host_and_port(endpoint)) == 0


def _host_and_port(endpoint: str) -> tuple[str, int]:
    host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
    return host, int(port)


def _address_in(view: Child) -> str | None:
    """The page's address, once the view process has printed its line."""
    for line in view.log.read_text(errors="replace").splitlines():
        if line.startswith("http://"):
            return line.strip()
    return None
