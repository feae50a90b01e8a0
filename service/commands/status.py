"""`umfeld status`: what a running daemon says about itself, asked over Zenoh. Light: no numpy, no pydantic."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from service.errors import Trouble

app = typer.Typer()

_REPLACED = "not_sent."
_LEVEL_COLOURS = {"ok": "green", "warning": "yellow", "error": "red", "stale": "magenta"}


@app.command()
def status(
    *,
    connect: Annotated[
        str | None, typer.Option(help="The daemon's endpoint; default: that of the configuration.")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="The daemon's configuration file.")] = None,
    robot: Annotated[str | None, typer.Option(help="The robot's id, where several answer.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """State, rates, ages, drops and pose of a running daemon. Exit code 1 if something is wrong there.

    Example: umfeld status --json
    """
    from service.zenoh_session import client_for

    with client_for(connect, config) as client:
        base = client.only_base(None if robot is None else f"robots/{robot}")
        values = {each.key.removeprefix(f"{base}/"): each.payload for each in client.get(f"{base}/health/json")}
        for key in ("pose", "map/agreement", "calibration"):
            values |= {each.key.removeprefix(f"{base}/"): each.payload for each in client.get(f"{base}/{key}")}
    if "health/json" not in values:
        raise Trouble(f"{base} has said nothing about its health yet; try again in a second")
    document = json.loads(values["health/json"])
    document["base"] = base
    document["pose"] = pose_in(values["pose"]) if "pose" in values else None
    document["agreement"] = json.loads(values["map/agreement"]) if "map/agreement" in values else None
    document["calibration"] = json.loads(values["calibration"]) if "calibration" in values else None
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _print(document)
    if document["level"] != "ok":
        raise typer.Exit(1)


def pose_in(payload: bytes) -> dict[str, float]:
    """x, y, yaw of a PoseWithCovarianceStamped in CDR: stamp, frame name, padding to 8 bytes, position, quaternion."""
    little = "<" if payload[1] & 1 else ">"
    body = payload[4:]
    seconds, nanoseconds, length = struct.unpack_from(f"{little}iII", body)
    x, y, _z, _qx, _qy, qz, qw = struct.unpack_from(f"{little}7d", body, (12 + length + 7) // 8 * 8)
    return {"x_m": x, "y_m": y, "yaw_rad": 2.0 * math.atan2(qz, qw), "stamp_s": seconds + nanoseconds * 1e-9}


def _print(document: Mapping[str, Any]) -> None:
    process = document["process"]
    typer.secho(f"{document['base']}: {document['text']}", fg=_LEVEL_COLOURS.get(document["level"]))
    if (pose := document["pose"]) is not None:
        typer.echo(
            f"pose     x {pose['x_m']:.2f} m  y {pose['y_m']:.2f} m  yaw {math.degrees(pose['yaw_rad']):.1f} deg"
        )
    typer.echo(
        f"process  {process.get('cpu_percent', 0):.0f} % of a core  {process.get('memory_mb', 0):.0f} MB"
        f"  up {process.get('uptime_s', 0):.0f} s"
    )
    if (agreement := document["agreement"]) is not None:
        text = agreement_text(agreement)
        typer.secho(f"maps     {text}", fg="yellow" if agreement["disagreements"] else None)
    if document["calibration"] is not None and (text := advice_text(document["calibration"])):
        typer.secho(f"settings {text}", fg="yellow")
    rows = [("device", "kind", "state", "rate", "age", "drops", "identity")]
    rows += [_row(source) for source in document["sources"]]
    print_table(rows, [None, *(_LEVEL_COLOURS.get(source["level"]) for source in document["sources"])])
    counters = {name: count for name, count in sorted(document["counters"].items()) if count}
    if lost := [f"{name} {count}" for name, count in counters.items() if _is_loss(name)]:
        typer.echo("lost     " + ", ".join(lost))
    if newer := [f"{name.partition(_REPLACED)[2]} {count}" for name, count in counters.items() if _REPLACED in name]:
        typer.echo("replaced by newer values before they were sent: " + ", ".join(newer))


def agreement_text(agreement: Mapping[str, Any]) -> str:
    """One line about map/agreement: what contradicts what, and where."""
    agree = sum(each["agree"] for each in agreement["kinds"])
    if not agreement["disagreements"]:
        return f"agree with each other in {agree} things" if agree else "have nothing in common yet"
    means = {each["kind"]: each["means"] for each in agreement["kinds"]}
    first = [
        f"{each['what']} at {each['position'][0]:.1f}, {each['position'][1]:.1f} ({means[each['kind']]})"
        for each in agreement["where"][:3]
    ]
    more = agreement["disagreements"] - len(first)
    return f"disagree: {'; '.join(first)}" + (f"; and {more} more" if more else "")


def advice_text(calibration: Mapping[str, Any]) -> str:
    """What the drive so far contradicts of the configuration; empty if nothing. Of several lasers the first to say."""
    found: dict[str, str] = {}
    for report in calibration["lasers"].values():
        if (wrong := report.get("contradiction")) is not None:
            found.setdefault(wrong, wrong)
        for each in report["advice"]:
            text = f"{each['setting']} = {each['value']} ± {each['deviation']}, not {each['instead_of']}"
            found.setdefault(each["setting"], text)
    return "to look at: " + "; ".join(found.values()) + " (umfeld calibrate)" if found else ""


def _row(source: Mapping[str, Any]) -> tuple[str, str, str, str, str, str, str]:
    age = source["age_s"]
    drops = ", ".join(f"{reason} {count}" for reason, count in source["drops"].items() if count)
    return (
        source["name"],
        source["kind"],
        source["state"] if source["level"] == "ok" else f"{source['state']}: {source['text']}",
        f"{source['rate_hz'] or 0:.1f} Hz",
        "never" if age is None else f"{age:.2f} s",
        drops or "-",
        source["identity"] or "-",
    )


def _is_loss(name: str) -> bool:
    if _REPLACED in name:
        return False
    return any(word in name for word in ("drop", "not_sent", "refused", "failed", "errors", "lost"))


def print_table(rows: Sequence[Sequence[str]], colours: Sequence[str | None]) -> None:
    """Columns as wide as their longest cell; the first row is the header."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row, colour in zip(rows, colours):
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
        typer.secho(line, fg=colour, bold=row is rows[0])
