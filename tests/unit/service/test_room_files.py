"""`umfeld extract rooms` and `voronoi` on maps as robots and people make them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from service.commands.extract import app
from service.files import FileTrouble
from service.room_files import geojson_bytes, rooms_of_file, write_rooms

YAML = (
    "image: map.pgm\nresolution: 0.1\norigin: [-3.0, 12.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def picture() -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """Two rooms of 5 m x 5 m (at 0.1 m) and a door; the first line is the uppermost."""
    pixels = np.full((60, 112), 205, dtype=np.uint8)
    pixels[4:56, 3:109] = 0
    pixels[5:55, 4:54] = pixels[5:55, 56:106] = pixels[10:20, 54:56] = 254
    return pixels


def test_rooms_of_a_map_server_map_stand_where_its_yaml_says(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text(YAML)
    for name in ("map.yaml", "map.pgm"):
        document = json.loads(geojson_bytes(rooms_of_file(tmp_path / name, resolution_m=1.0, with_diagram=False)))
        kinds = [feature["properties"]["kind"] for feature in document["features"]]
        assert kinds == ["room", "room", "door"]
        xs, ys = zip(*document["features"][0]["geometry"]["coordinates"][0])
        assert (min(xs), min(ys), max(ys)) == pytest.approx((-2.6, 12.5, 17.5), abs=0.11)
        door = document["features"][2]["properties"]
        assert door["critical_point"] == pytest.approx([2.5, 16.5], abs=0.3)


def test_the_diagram_of_a_picture_is_written_and_drawn(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "plan.png")
    done = CliRunner().invoke(
        app, ["voronoi", str(tmp_path / "plan.png"), "--resolution-m", "0.1", "--out", str(tmp_path / "v.geojson"),
              "--png", str(tmp_path / "v.png"), "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    report = json.loads(done.output)
    assert (report["rooms"], report["doors"]) == (2, 1)
    assert report["edges"] > 0
    features = json.loads((tmp_path / "v.geojson").read_text())["features"]
    edges = [feature for feature in features if feature["properties"]["kind"] == "edge"]
    assert len(edges) == report["edges"]
    for edge in edges:
        points = np.array(edge["geometry"]["coordinates"])
        length = np.hypot(*np.diff(points, axis=0).T).sum()
        assert edge["properties"]["length_m"] == pytest.approx(length, abs=0.005)
    drawn = np.asarray(Image.open(tmp_path / "v.png"))
    assert drawn.shape[:2] == (60, 112)
    assert (drawn == (200, 30, 30)).all(axis=2).any()


def test_rooms_alone_are_printed(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "plan.png")
    done = CliRunner().invoke(app, ["rooms", str(tmp_path / "plan.png"), "--resolution-m", "0.1"])
    assert done.exit_code == 0
    assert {f["properties"]["kind"] for f in json.loads(done.output)["features"]} == {"room", "door"}


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((30, 30), dtype=np.uint8)).save(tmp_path / "black.png")
    with pytest.raises(FileTrouble, match="no cell of it is free"):
        rooms_of_file(tmp_path / "black.png", resolution_m=0.05, with_diagram=False)
    (tmp_path / "map.txt").write_text("rooms?")
    with pytest.raises(FileTrouble, match="a map is"):
        rooms_of_file(tmp_path / "map.txt", resolution_m=0.05, with_diagram=False)
    with pytest.raises(FileTrouble, match=r"not a picture|cannot be read"):
        rooms_of_file(tmp_path / "none.png", resolution_m=0.05, with_diagram=False)
    Image.fromarray(picture()).save(tmp_path / "plan.png")
    found = rooms_of_file(tmp_path / "plan.png", resolution_m=0.1, with_diagram=False)
    with pytest.raises(FileTrouble, match="unknown ending"):
        write_rooms(found, tmp_path / "rooms.svg")
