"""`umfeld bench`: our kernels on this machine, and with --all the whole daemon, beside their budgets."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from service.errors import Trouble

app = typer.Typer()

_GRID_BUDGET_US = 160.0  # 1081 beams into a 5 cm grid, office, on an idle core
_NUMPY = "numpy alone"


@app.command()
def bench(
    *,
    everything: Annotated[
        bool, typer.Option("--all", help="Also latency, load and start of the whole daemon, and MRPT: minutes.")
    ] = False,
    seconds: Annotated[float, typer.Option(min=5.0, help="How long the daemon is measured, with --all.")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Time the kernels on this machine (half a minute), each beside its budget. Exit code 1 if one is missed.

    Example: umfeld bench --json
    """
    rows: list[dict[str, Any]] = []
    if everything:
        from dataclasses import asdict

        rows += [
            asdict(figure) | {"ok": figure.is_kept} for figure in _program("latency").measure(seconds)
        ]  # before the kernels load: they would count against nothing, but warm the processor
    rows += _grid_rows(_program("grid_insert"), everything)
    rows += _sector_rows()
    if as_json:
        typer.echo(json.dumps({"machine": machine(), "figures": rows}, indent=2))
    else:
        _print(rows)
    if not all(row["ok"] for row in rows):
        raise typer.Exit(1)


def machine() -> dict[str, object]:
    """What the figures were taken on. load: processes that wanted to run, over the last minute."""
    model = next(
        (line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")), "unknown"
    )
    return {"processor": model, "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 2)}


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def _program(name: str) -> ModuleType:
    """A program of bench/, which lies beside the packages in a source tree and is not installed without it."""
    path = Path(__file__).resolve().parents[2] / "bench" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"umfeld_bench_{name}", path)
    if not path.exists() or spec is None or spec.loader is None:
        raise Trouble(f"{path} is not there: run `umfeld bench` from a source tree (git clone, make venv)")
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


def _figure(name: str, value: float, unit: str, budget: float | None) -> dict[str, Any]:
    value = float(value)  # numpy's own floats and truths are no JSON
    return {"name": name, "value": value, "unit": unit, "budget": budget, "ok": budget is None or value <= budget}


# --- kernels ----------------------------------------------------------------------------------------------------------


def _grid_rows(program: ModuleType, with_peers: bool) -> list[dict[str, Any]]:
    import contextlib
    import tempfile

    contenders = [
        program.Contender("ours, wedges (the default)", program.timed(program.ours())),
        program.Contender("ours, wedges, de-skewed beams", program.timed(program.ours_moving())),
        program.Contender(_NUMPY, program.timed(program.NumpyGrid().insert)),
    ]
    with contextlib.ExitStack() as stack:
        if with_peers:
            peer, _ = program.mrpt(Path(stack.enter_context(tempfile.TemporaryDirectory())))
            contenders += [] if peer is None else [peer]
        report: Mapping[str, Any] = program.measure(contenders, 6)
    rows = []
    for contender in report["rows"]:
        for place in ("office", "hall"):
            is_judged = contender["name"].startswith("ours, wedges (") and place == "office"
            rows.append(
                _figure(
                    f"grid, 1081 beams, {place}: {contender['name']}",
                    contender[place]["median_us"],
                    "us",
                    _GRID_BUDGET_US if is_judged else None,
                )
            )
    return rows


def _sector_rows() -> list[dict[str, Any]]:
    """Median times of what the daemon does for each scan and each sonar round, on the ARTOS sector maps."""
    import numpy as np

    from mapping.frames import Pose2
    from mapping.sectors.polar import PolarSectors
    from mapping.sectors.rectangular import RectSectors

    footprint = np.array([[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]])
    rng = np.random.default_rng(1)
    bearing = np.deg2rad(np.linspace(-135.0, 135.0, 1081))
    scans = [3.0 + np.sin(3.0 * bearing) + rng.normal(0.0, 0.01, 1081) for _ in range(8)]
    polar = PolarSectors(sources=("s",), footprint=footprint)
    rect = RectSectors(sources=("s",), footprint=footprint)
    mount = Pose2(0.3, 0.0, 0.0)

    def scan_into(sectors: PolarSectors | RectSectors) -> Callable[[int], None]:
        def take(k: int) -> None:
            sectors.update_beams(
                "s",
                base_from_sensor=mount,
                bearing_rad=bearing,
                range_m=scans[k % 8],
                range_min_m=0.1,
                range_max_m=30.0,
                stamp_ns=k,
            )
            sectors.snapshot(k)

        return take

    def round_into(sectors: PolarSectors | RectSectors, *, centimetres: bool) -> Callable[[int], None]:
        def take(k: int) -> None:
            for channel in range(8):
                range_m = 1.0 + 0.01 * ((k * 7 + channel) % 40) if centimetres else 1.0 + 0.4 * rng.random()
                sectors.update_cone(
                    "s",
                    channel,
                    base_from_transducer=Pose2(0.4, 0.0, 0.3 * channel - 1.0),
                    cone_rad=math.radians(30.0),
                    range_m=range_m,
                    range_min_m=0.2,
                    range_max_m=3.0,
                    stamp_ns=k,
                )
            sectors.snapshot(k)

        return take

    kernels = {
        "polar sectors, 1081 beams off centre": scan_into(polar),
        "rectangular sectors, 1081 beams": scan_into(rect),
        "polar sectors, 8 sonar cones, new distances": round_into(
            PolarSectors(sources=("s",), footprint=footprint), centimetres=False
        ),
        "polar sectors, 8 sonar cones, whole centimetres": round_into(
            PolarSectors(sources=("s",), footprint=footprint), centimetres=True
        ),
        "rectangular sectors, 8 sonar cones, whole centimetres": round_into(
            RectSectors(sources=("s",), footprint=footprint), centimetres=True
        ),
    }
    return [_figure(name, median_us(work, 300), "us", None) for name, work in kernels.items()]


def median_us(work: Callable[[int], None], rounds: int) -> float:
    """Median time of one call, the first tenth left out; work is told the number of the call."""
    times = []
    for k in range(1, rounds + 1):
        before = time.perf_counter_ns()
        work(k)
        times.append(time.perf_counter_ns() - before)
    kept = sorted(times[rounds // 10 :])
    return round(kept[len(kept) // 2] / 1e3, 1)


# --- for people -------------------------------------------------------------------------------------------------------


def _print(rows: Sequence[Mapping[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    about = machine()
    table = Table(title=f"{about['processor']}, {about['cores']} cores, load {about['load']}")
    for heading in ("what", "measured", "budget", ""):
        table.add_column(heading, justify="left" if heading in ("what", "") else "right")
    for row in rows:
        budget = "" if row["budget"] is None else f"{row['budget']:g} {row['unit']}"
        verdict = "" if row["budget"] is None else ("ok" if row["ok"] else "missed")
        table.add_row(
            row["name"], f"{row['value']:.2f} {row['unit']}", budget, verdict, style=None if row["ok"] else "red"
        )
    Console().print(table)
