"""`umfeld config`: what the configuration is, a file to begin with, and the schema of all keys."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.errors import Trouble, WrongUsage

app = typer.Typer()

ConfigOption = Annotated[
    Path | None, typer.Option("--config", "-c", help="The configuration file; default: the first of the usual places.")
]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE, wins over the file; repeatable.")]


@app.command()
def show(
    *,
    config: ConfigOption = None,
    settings: SetOption = None,
    changed: Annotated[bool, typer.Option("--changed", help="Only values that are not the default.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Every effective value and where it came from: default, file and line, overlay, environment, command line.

    Example: umfeld config show --changed
    """
    from service.config import load
    from service.config_text import effective_values

    values = effective_values(load(config, settings=settings or ()))
    if changed:
        values = [each for each in values if each.origin != "default"]
    if as_json:
        entries = [{"key": ".".join(each.path), "value": each.value, "origin": each.origin} for each in values]
        typer.echo(json.dumps(entries, indent=2))
        return
    width = min(60, max((len(each.text) for each in values), default=0))
    for each in values:
        typer.echo(f"{each.text:<{width}}  # {each.origin}")


@app.command()
def init(
    file: Annotated[Path, typer.Argument(help="The file to write; - prints it.")] = Path("umfeld.toml"),
    *,
    force: Annotated[bool, typer.Option("--force", help="Overwrite it if it is there.")] = False,
) -> None:
    """Write a commented example to begin with.

    Example: umfeld config init
    """
    from service.config_text import EXAMPLE

    if str(file) == "-":
        typer.echo(EXAMPLE, nl=False)
        return
    if file.exists() and not force:
        raise WrongUsage(f"{file}: is already there; take another name, or --force to overwrite it")
    try:
        file.write_text(EXAMPLE, encoding="utf-8")
    except OSError as error:
        raise Trouble(f"{file}: cannot be written ({error.strerror}); take a folder you may write to") from error
    typer.echo(f"wrote {file}; next: edit it, then `umfeld check --config {file}`")


@app.command()
def schema(
    *,
    markdown: Annotated[bool, typer.Option("--markdown", help="As tables for people instead.")] = False,
) -> None:
    """The JSON schema of all keys.

    Example: umfeld config schema > umfeld.schema.json
    """
    from service.config import Config
    from service.config_text import reference

    typer.echo(reference() if markdown else json.dumps(Config.model_json_schema(), indent=2))
