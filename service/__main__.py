"""The command `umfeld`.

Every subcommand is a module service/commands/NAME.py with an `app = typer.Typer()`: one function decorated with
`@app.command()` becomes `umfeld NAME`, several become `umfeld NAME SUB`. Only the module of the command that was
called is imported, so that help and the light commands stay quick; COMMANDS carries the others' one-line help.

A module reports trouble by raising service.errors.Trouble (or any DriverError): its lines go to stderr, the exit code
is Trouble.exit_code. `raise typer.Exit(1)` says "a problem was found and has been printed".
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType, ModuleType

import typer

COMMANDS: dict[str, str] = {
    "demo": "An emulated robot maps a flat before your eyes: emulators, daemon and page in one.",
    "run": "The daemon: devices in, maps out over Zenoh.",
    "check": "Validate the configuration and open every device: found, identity, rate, trouble.",
    "status": "State, rates, ages, drops and pose of a running daemon.",
    "view": "The live page in a browser.",
    "sim": "Emulated devices on ptys, with a configuration that fits them.",
    "devices": "Ports, the protocols that answer there, and who they are.",
    "config": "Show effective values and their origin, write an example, print the schema.",
    "map": "Save, load, begin, list, describe, import, export and build maps.",
    "record": "Record raw bytes and everything published.",
    "replay": "Play a recording through the real drivers.",
    "extract": "One algorithm on one file: lines, planes, features, rooms, regions, trees, ground.",
    "localise": "Where a recorded log's robot was in a known map, and how sure.",
    "evaluate": "The relation error of a trajectory.",
    "calibrate": "Wheel radii, track width and sensor poses from a log.",
    "bench": "Our kernels on this machine.",
}

PACKAGE = "service.commands"
EPILOG = "First steps: `umfeld demo`. With devices: `umfeld config init`, `umfeld check`, `umfeld run`, `umfeld view`."


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: runs one command and ends the process with its exit code."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _ending_in_order():
            build_app(_called_command(argv))(args=argv, prog_name="umfeld")
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output went away, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        sys.exit(_explain(error))


@contextmanager
def _ending_in_order() -> Iterator[None]:
    """SIGTERM, and SIGHUP of a terminal that is closed, unwind the command as Ctrl-C does: devices are left safe."""
    numbers = [each for each in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(each) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _end(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def build_app(called: str | None) -> typer.Typer:
    """The whole command tree; only `called` is imported, the others stand in with their help line."""
    app = typer.Typer(
        name="umfeld",
        help="Maps of a robot's surroundings, from range sensors to Zenoh.",
        epilog=EPILOG,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_root)
    for name, help_line in COMMANDS.items():
        if not _exists(name):
            continue
        if name == called:
            _attach(app, name, importlib.import_module(f"{PACKAGE}.{name}"), help_line)
        else:
            app.command(name, help=help_line)(_placeholder)
    return app


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
    from importlib.metadata import PackageNotFoundError, version

    try:
        typer.echo(f"umfeld {version('umfeld')}")
    except PackageNotFoundError:
        typer.echo("umfeld (not installed)")
    raise typer.Exit


def _root(
    _version: bool = typer.Option(
        False, "--version", help="Print the version and end.", is_eager=True, callback=_print_version
    ),
) -> None:
    pass


def _called_command(argv: Sequence[str]) -> str | None:
    completing = os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS"))
    words = completing.split()[1:] if "_UMFELD_COMPLETE" in os.environ and completing else argv
    return next((word for word in words if not word.startswith("-")), None)


def _exists(name: str) -> bool:
    return importlib.util.find_spec(f"{PACKAGE}.{name}") is not None


def _attach(app: typer.Typer, name: str, module: ModuleType, help_line: str) -> None:
    """Hang a command module's Typer into the tree, a single command without a level of its own."""
    sub: typer.Typer = module.app
    single = len(sub.registered_commands) == 1 and not sub.registered_groups and sub.registered_callback is None
    if single:
        info = sub.registered_commands[0]
        info.name = name
        app.registered_commands.append(info)
    else:
        app.add_typer(sub, name=name, help=help_line, no_args_is_help=True)


def _placeholder() -> None:
    raise AssertionError("a command that was not called cannot run")


def _explain(error: Exception) -> int:
    """Print a person's trouble in its own words and return the exit code; anything else is our bug and propagates."""
    from drivers.errors import DriverError
    from service.errors import Trouble

    if isinstance(error, Trouble):
        for line in error.lines:
            print(f"umfeld: {line}", file=sys.stderr)
        return error.exit_code
    if isinstance(error, DriverError):
        print(f"umfeld: {error}", file=sys.stderr)
        return 1
    raise error


if __name__ == "__main__":
    main()
