"""`umfeld run`: the daemon."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def run(
    *,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="The configuration file; default: the first usual place.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE, wins over the file; repeatable.")
    ] = None,
) -> None:
    """The daemon: devices in, maps out over Zenoh. Ends with SIGINT, SIGTERM or its terminal.

    Example: umfeld run --config /etc/umfeld/umfeld.toml
    """
    serve(config, settings or ())


def serve(config: Path | None, settings: Sequence[str], *, seconds: float = 0.0) -> None:
    """Be the daemon until told to stop, or for so many seconds once it is ready; ends the process."""
    from service.config import load

    loaded = load(config, settings=settings)  # first, so that a fault in it is told before anything heavy loads
    logging.basicConfig(
        level=loaded.config.log.level.upper(), format="%(asctime)s %(levelname)-7s %(name)s: %(message)s", force=True
    )
    from service.daemon import Daemon

    code = Daemon(loaded).run(seconds=seconds)
    logging.shutdown()
    sys.stdout.flush()
    os._exit(code)  # all is closed; taking the interpreter and the compiled kernels apart would cost a second or two
