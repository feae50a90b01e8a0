"""`umfeld devices`: what there is to name in a configuration, who answers there, and leaving it all safe."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from service.config import Config
    from service.detect import Detected
    from service.identify import Meant

app = typer.Typer()

AsJson = Annotated[bool, typer.Option("--json", help="As JSON.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", "-c", help="The configuration file; default: the first usual place.")
]
Ports = Annotated[list[str] | None, typer.Argument(help="Ports or patterns; default: every serial port there is.")]


@app.callback()
def devices() -> None:
    """Ports of this machine, who answers there, and how to tell devices apart."""


@app.command("list")
def list_devices(*, as_json: AsJson = False) -> None:
    """Serial ports and CAN interfaces, by the name that stays, and whether you may open them.

    Example: umfeld devices list --json
    """
    from service.commands.status import print_table
    from service.device_list import can_interfaces, serial_ports

    ports = [*serial_ports(), *can_interfaces()]
    if as_json:
        typer.echo(json.dumps([port.document() for port in ports], indent=2))
        return
    if not ports:
        typer.echo("no serial port and no CAN interface is there; plug a device in, or try `umfeld sim`")
        return
    rows = [("port", "kind", "name that stays", "what it says", "trouble")]
    rows += [(port.name, port.kind, port.stable_name or "-", port.description or "-", port.trouble) for port in ports]
    print_table(rows, [None, *("red" if port.trouble else None for port in ports)])


@app.command("detect")
def detect_devices(ports: Ports = None, *, as_json: AsJson = False) -> None:
    """Ask on every port, at every usual line speed, who is there; by questions that set nothing in motion.

    About 12 seconds, all ports side by side. Exit code 1 if nobody answers.

    Example: umfeld devices detect /dev/ttyUSB0
    """
    found = _detect(ports)
    if as_json:
        typer.echo(json.dumps([each.document() for each in found], indent=2))
    else:
        _print_detected(found)
    if not any(each.driver for each in found):
        if any(not each.trouble for each in found):
            typer.echo(
                "nobody answers: is it powered, do the wires cross (TX to RX), is its protocol one of docs/devices? "
                "On CAN and on networks none is looked for: configure the device, then `umfeld check`",
                err=True,
            )
        raise typer.Exit(1)


@app.command()
def identify(
    ports: Ports = None,
    *,
    config: ConfigFile = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="How long to wait for a hand.")] = 60.0,
    as_json: AsJson = False,
) -> None:
    """Cover the sensor you mean with a hand, or turn the wheel: its name and port are told.

    With --config the sensors of that configuration are watched, otherwise every device that `detect` finds.

    Example: umfeld devices identify --config umfeld.toml
    """
    watched, where = _watched(ports, config)
    meant = _wait_for_hand(watched, seconds)
    if meant is None:
        typer.echo("no sensor was covered; hold a hand right before it, for a second", err=True)
        raise typer.Exit(1)
    port = where.get(meant.source, "")
    if as_json:
        typer.echo(json.dumps({"source": meant.source, "part": meant.part, "port": port}))
    else:
        typer.echo(f"{meant.text()}  on {port}" if port else meant.text())


@app.command()
def udev(
    *,
    config: ConfigFile = None,
    out: Annotated[Path | None, typer.Option(help="File to write; default: standard output.")] = None,
) -> None:
    """Rules that name every configured serial device /dev/umfeld/NAME, wherever it is plugged in.

    Example: umfeld devices udev --config umfeld.toml | sudo tee /etc/udev/rules.d/61-umfeld-names.rules
    """
    from service.config import load
    from service.files import write_whole
    from service.udev_rules import rules, usb_ports

    loaded = load(config).config
    wanted = {
        loaded.source_name(section, name): port
        for section, name, device in loaded.devices()
        if (port := device.serial_port()) is not None and port.startswith("/")
    }
    wanted |= {f"can-{name}": bus.channel for name, bus in loaded.can.items() if bus.channel.startswith("/")}
    text, troubles = rules(wanted, usb_ports())
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_whole(out, text.encode())
    for trouble in troubles:
        typer.secho(trouble, fg="red", err=True)
    if troubles:
        raise typer.Exit(1)


@app.command()
def stop(*, config: ConfigFile = None, as_json: AsJson = False) -> None:
    """Leave every configured device safe: lasers dark, motors off. Also after a crash.

    Devices of a running daemon are left to it. Exit code 1 if a device could not be told.

    Example: umfeld devices stop --config /etc/umfeld/umfeld.toml
    """
    from service.config import load
    from service.farewell import stop_devices

    told = stop_devices(load(config).config, clock=time.monotonic_ns)
    if as_json:
        typer.echo(json.dumps([each.document() for each in told], indent=2))
    else:
        for each in told:
            state = each.trouble or ("told to stop" if each.items else "nothing of it moves or shines by our doing")
            typer.secho(f"{each.name}: {state}", fg="red" if each.trouble else None, err=bool(each.trouble))
    if any(each.trouble for each in told):
        raise typer.Exit(1)


def _detect(patterns: list[str] | None) -> list[Detected]:
    from service.detect import detect, ports_like
    from service.device_list import serial_ports

    known = {port.name: port.stable_name for port in serial_ports()}
    names = ports_like(patterns) or patterns if patterns else list(known)
    if not names:
        typer.echo("no serial port is there; plug a device in, or try `umfeld sim`", err=True)
        return []
    typer.echo(f"asking on {len(names)} ports", err=True)
    return detect([(name, known.get(name, "")) for name in names])


def _print_detected(found: list[Detected]) -> None:
    from service.commands.status import print_table
    from service.health import identity_text

    if not found:
        return
    rows = [("port", "driver", "speed", "identity", "serial number", "trouble")]
    for each in found:
        serial = each.identity.serial if each.identity is not None else ""
        speed = str(each.speed_bps) if each.speed_bps else "-"
        trouble = each.trouble or ("" if each.driver else "nobody answers")
        rows.append(
            (each.best_name, each.driver or "-", speed, identity_text(each.identity) or "-", serial or "-", trouble)
        )
    print_table(rows, [None, *("red" if each.trouble else None for each in found)])
    if any(each.driver for each in found):
        typer.echo("\nfor the configuration:\n")
        typer.echo(_as_toml(found))


def _as_toml(found: list[Detected]) -> str:
    """Tables to begin with, which `umfeld check` takes as they are; names are to be changed, sizes to be measured."""
    lines = []
    counts: dict[str, int] = {}
    for each in found:
        if not each.driver:
            continue
        number = counts[each.section] = counts.get(each.section, 0) + 1
        name = f"{_FIRST_NAMES[each.section]}{'' if number == 1 else number}"
        lines.append(f"[{each.section}.{name}]")
        if each.section == "can":
            lines += ['interface = "slcan"', f"channel = {json.dumps(each.best_name)}", ""]
            continue
        lines.append(f"driver = {json.dumps(each.driver)}")
        serial = each.identity.serial if each.identity is not None else ""
        lines.append(f"serial = {json.dumps(serial)}" if serial else f"port = {json.dumps(each.best_name)}")
        if each.speed_bps not in (None, _USUAL_BPS.get(each.driver, each.speed_bps)):
            lines.append(f"baud_bps = {each.speed_bps}")
        if each.driver == "maxbotix":
            digits = each.identity.model if each.identity is not None else ""
            lines.append(f'family = "{"lv" if digits.startswith("3") else "hr-5m"}"    # {_FAMILIES}')
        lines.append("")
        if each.section == "wheels" and number == 1:
            lines += ["[drive]", f'source = "{name}"', f"# {_DRIVE}", ""]
    return "\n".join(lines)


_FIRST_NAMES = {"lasers": "front", "sonars": "ring", "wheels": "drive", "can": "main"}
_USUAL_BPS = {
    "maxbotix": 9600,
    "arduino-bridge": 57600,
    "roboclaw": 38400,
    "mavlink": 57600,
}  # of drivers that do not look for it
_FAMILIES = "as printed on the sensor: lv, xl, hr-5m or hr-10m"
_DRIVE = "measure: wheel_radius_left_m, wheel_radius_right_m, track_width_m, ticks_per_turn_left, ticks_per_turn_right"


def _watched(ports: list[str] | None, config: Path | None) -> tuple[Config, dict[str, str]]:
    """What to listen to, and the port of each source."""
    from service.config import check, load
    from service.config_files import Layers
    from service.errors import Trouble

    if config is not None:
        loaded = load(config).config
        return loaded, _places(loaded)
    data: dict[str, Any] = {}
    for number, each in enumerate(_detect(ports), start=1):
        if each.section in ("lasers", "wheels", "sonars"):
            data.setdefault(each.section, {})[f"device{number}"] = {"driver": each.driver, "port": each.port}
    if not data:
        raise Trouble(
            "no device answers on any port; `umfeld devices detect` tells more, --config names devices on CAN"
        )
    if wheels := data.get("wheels"):
        data["drive"] = {"source": next(iter(wheels))}
    found: Config = check(Layers(data, {}, {}, ()))
    return found, _places(found)


def _places(config: Config) -> dict[str, str]:
    return {
        config.source_name(section, name): device.serial_port() or f"can.{device.can_bus()}"
        for section, name, device in config.devices()
    }


def _wait_for_hand(config: Config, seconds: float) -> Meant | None:
    import queue

    from drivers.readings import DeviceEvent, Reading
    from service import assemble_wires
    from service.identify import Watch
    from service.locks import Claims

    items: queue.SimpleQueue[tuple[str, Reading | DeviceEvent]] = queue.SimpleQueue()
    with Claims() as claims:
        wires = assemble_wires.wires(config)
        claims.claim_ports(wire.port for wire in wires if wire.port is not None)
        readers = [wire.reader(lambda name, item: items.put((name, item)), time.monotonic_ns) for wire in wires]
        for reader in readers:
            reader.start()
        try:
            typer.echo("starting the devices; do not cover any yet", err=True)
            _wait_until_running(readers)
            watch = Watch(time.monotonic_ns())
            told = False
            end_ns = time.monotonic_ns() + round(seconds * 1e9)
            while (now_ns := time.monotonic_ns()) < end_ns:
                if not told and not watch.learns(now_ns):
                    told = True
                    heard = ", ".join(watch.heard()) or "nobody: check cables and power"
                    typer.echo(f"heard: {heard}\nnow cover the sensor you mean, or turn the wheel", err=True)
                try:
                    source, item = items.get(timeout=0.1)
                except queue.Empty:
                    continue
                if isinstance(item, DeviceEvent):
                    continue
                meant = watch.take(source, item, time.monotonic_ns())
                if meant is not None:
                    return meant
            return None
        finally:
            for reader in readers:
                reader.stop()


def _wait_until_running(readers: list[Any], seconds: float = 12.0) -> None:
    from drivers.readings import LinkState

    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        sources = [source for reader in readers for source in reader.health().sources.values()]
        if all(source.state is LinkState.RUNNING for source in sources):
            return
        time.sleep(0.05)
