"""`umfeld evaluate`: the relation error of a trajectory."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer()


@app.command()
def evaluate(
    trajectory: Annotated[Path, typer.Argument(help="Rows stamp x y z qx qy qz qw (TUM) or stamp x y theta.")],
    relations: Annotated[Path, typer.Argument(help="Rows stamp1 stamp2 x y z roll pitch yaw; plain or .gz.")],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """How well a trajectory keeps relations that people checked: the error of the SLAM benchmark.

    Exit code 1 if not one relation could be evaluated.

    Example: umfeld evaluate out/trajectory.tum intel.relations.gz
    """
    from service.evaluate import DEFINITION, read_relations, read_trajectory, relation_error

    result = relation_error(read_trajectory(trajectory), read_relations(relations))
    if as_json:
        typer.echo(json.dumps(_without_nan({"definition": DEFINITION, **asdict(result)}), indent=2))
    else:
        typer.echo(f"relations      {result.relations}, of which not evaluated: {result.not_evaluated}")
        for name, unit, spread in (
            ("translation", "m", result.translation_m),
            ("rotation", "deg", result.rotation_deg),
        ):
            typer.echo(f"{name:<14} {spread.mean:.4f} ± {spread.std:.4f} {unit}, largest {spread.largest:.4f}")
            typer.echo(f"{name + '²':<14} {spread.mean_of_squares:.4f} ± {spread.std_of_squares:.4f} {unit}²")
        if result.missing:
            typer.echo(f"not in the trajectory, for example: {', '.join(result.missing)}")
        typer.echo(f"error          {DEFINITION}")
    if result.not_evaluated == result.relations:
        raise typer.Exit(1)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
