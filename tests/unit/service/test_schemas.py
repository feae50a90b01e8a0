"""The published JSON schemas: they hold for the examples and for what is really sent, and refuse what is wrong."""

from __future__ import annotations

import copy
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator, ValidationError

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.sectors.snapshot import PolarSnapshot, RectSnapshot, Squares
from service import export, topics
from service.outputs import HealthOut, PolarOut, RangesOut, RectOut, SourceHealth
from service.payloads import Encoder, RobotInfo, SensorPlace

DOCS = Path(__file__).parents[3] / "docs"
SCHEMAS = sorted((DOCS / "schemas").glob("*.json"))
EXAMPLES = sorted((DOCS / "schemas" / "examples").glob("*.json"))


def validator(name: str) -> Draft202012Validator:
    """name: as in the document's `schema`, e.g. umfeld.sectors.v1."""
    schema = json.loads((DOCS / "schemas" / f"{name.removeprefix('umfeld.')}.json").read_text())
    return Draft202012Validator(schema)


def check(payload: bytes) -> None:
    document = json.loads(payload)
    validator(document["schema"]).validate(document)


@pytest.mark.parametrize("path", SCHEMAS, ids=lambda path: path.name)
def test_schemas_are_schemas(path: Path) -> None:
    Draft202012Validator.check_schema(json.loads(path.read_text()))
    assert any(example.name.startswith(path.stem) for example in EXAMPLES)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_hold(path: Path) -> None:
    check(path.read_bytes())


def test_every_json_topic_has_a_schema() -> None:
    for topic in topics.TOPICS:
        if not topic.is_cdr:
            assert topic.encoding == f"application/json;{topic.payload}"
            validator(topic.payload)


def test_json_in_the_docs_holds() -> None:
    documents = [json.loads(block) for block in re.findall(r"```json\n(.*?)```", (DOCS / "keys.md").read_text(), re.S)]
    named = [document for document in documents if "schema" in document]
    assert {document["schema"] for document in named} >= {"umfeld.sectors.v1", "umfeld.health.v1", "umfeld.info.v1"}
    for document in named:
        validator(document["schema"]).validate(document)


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)


@settings(max_examples=50)
@given(st.integers(1, 9), st.data())
def test_sent_sector_documents_hold(count: int, data: st.DataObject) -> None:
    def column(values: st.SearchStrategy[Any], dtype: Any) -> Any:
        return np.array(data.draw(st.lists(values, min_size=count, max_size=count)), dtype=dtype)

    positive = st.one_of(st.just(math.nan), st.floats(0, 100))
    state, age, source = (
        column(st.integers(0, 3), np.int8),
        column(st.integers(-1, 2**40), np.int64),
        column(st.integers(-1, 0), np.int16),
    )
    snapshot = PolarSnapshot(
        0,
        Pose2(),
        np.linspace(-1, 1, count + 1),
        state,
        column(positive, float),
        column(numbers, float),
        column(numbers, float),
        age,
        source,
        ("front",),
    )
    check(Encoder().encode(PolarOut("laser", snapshot), 0)[0].payload)
    x, row = column(numbers, float).reshape(1, count), (1, count)
    rect = RectSnapshot(
        0,
        Pose2(),
        np.linspace(-1, 1, count + 1),
        np.array([0.0, 1.0]),
        ("front",),
        lambda: Squares(state.reshape(row), x, x, age.reshape(row), source.reshape(row)),
    )
    check(Encoder().encode(RectOut("around", rect), 0)[0].payload)


def test_other_sent_documents_hold() -> None:
    encoder = Encoder()
    ranges = RangesOut("chain", 0, (Pose2(),) * 4, 0.5, 0.1, 3.0, (1.0, math.inf, -math.inf, math.nan))
    check(encoder.encode(ranges, 0)[0].payload)
    source = SourceHealth("front", "laser", 0, "running", "", "", math.nan, 5, 0, {"x": 1}, {"drift_ppm": math.inf})
    check(encoder.encode(HealthOut(0, 1, "", (source,), {"a": 1}, {"cpu_percent": math.nan}), 0)[1].payload)
    place = SensorPlace("front", "laser", Pose2(), 0.1)
    check(encoder.info(RobotInfo("r1", "robots/r1", "0", 0, (place,), ((1.0, 2.0),)))[0].payload)
    patch = GridPatch(0.05, 0, 0, np.zeros((2, 3), np.int8))
    check(export.render_grid(patch, "json", export.grid_properties(patch, 0))[0])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d["sectors"][0].update(state="clear"),
        lambda d: d["sectors"][0].pop("state"),
        lambda d: d["sectors"][0].update(distance_m=-1.0),
        lambda d: d["sectors"][0].update(distance_m="far"),
        lambda d: d.update(schema="umfeld.sectors.v2"),
        lambda d: d.update(kind="rect"),
        lambda d: d["stamp"].update(sec=1.5),
        lambda d: d.update(sectors=[]),
    ],
)
def test_the_sector_schema_refuses_what_is_wrong(spoil: Any) -> None:
    document = json.loads((DOCS / "schemas/examples/sectors.v1.polar.json").read_text())
    spoiled = copy.deepcopy(document)
    spoil(spoiled)
    with pytest.raises(ValidationError):
        validator("umfeld.sectors.v1").validate(spoiled)
