"""`umfeld extract quadtree, octree, elevation`: files in, bytes, pictures and reports out."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from mapping.frames import Pose2
from mapping.grids.height import Ground
from mapping.grids.octree import Octree
from mapping.grids.quadtree import Quadtree
from mapping.grids.tiles import Window
from service.cloud_files import CloudTrouble
from service.commands.extract import app
from service.export import MapFileTrouble, MapImage, save_grid
from service.files import FileTrouble
from service.space_files import elevation_of_file, octree_of_file, quadtree_of_file, write_extracted

runner = CliRunner()


def map_file(folder: Path) -> Path:
    cells = np.full((40, 60), -1, dtype=np.int8)
    cells[5:30, 5:50] = 100
    cells[6:29, 6:49] = 0
    save_grid(MapImage(cells, 0.05, Pose2(-1.0, 0.5, 0.0)), folder / "map.yaml")
    return folder / "map.yaml"


def cloud_file(folder: Path) -> Path:
    """A floor of 4 m x 4 m, 1 m below the sensor, with a wall."""
    rng = np.random.default_rng(1)
    floor = np.column_stack((rng.uniform(-2.0, 2.0, (20_000, 2)), np.full(20_000, -1.0)))
    wall = np.column_stack((np.full(3000, 2.02), rng.uniform(-2.0, 2.0, 3000), rng.uniform(-1.0, 1.0, 3000)))
    lines = (" ".join(f"{v:.3f}" for v in point) for point in np.concatenate((floor, wall)))
    (folder / "room.xyz").write_text("\n".join(lines))
    return folder / "room.xyz"


def test_a_quadtree_file_holds_the_map(tmp_path: Path) -> None:
    found = quadtree_of_file(map_file(tmp_path))
    tree = Quadtree.from_bytes(found.data)
    cells = tree.cells_in(Window(10, 50, -20, 40))
    assert np.count_nonzero(cells == 100) == 25 * 45 - 23 * 43
    assert np.count_nonzero(cells == 0) == 23 * 43
    by_picture = quadtree_of_file(tmp_path / "map.pgm")
    assert by_picture.data == found.data
    (tmp_path / "map.yaml").unlink()
    assert quadtree_of_file(tmp_path / "map.pgm", resolution_m=0.05).report["nodes"]
    with pytest.raises(MapFileTrouble, match="--resolution-m"):
        quadtree_of_file(tmp_path / "map.pgm")


def test_an_octree_file_holds_the_room(tmp_path: Path) -> None:
    found = octree_of_file(cloud_file(tmp_path), resolution_m=0.1)
    tree = Octree.from_bytes(found.data)
    assert tree.state_at([(0.05, 0.05, -0.5), (2.02, 0.0, 0.0), (0.0, 0.0, 0.5)]).tolist() == [0, 2, -1]
    assert found.report["points"] == 23_000


def test_an_elevation_file_has_every_layer(tmp_path: Path) -> None:
    found = elevation_of_file(cloud_file(tmp_path), resolution_m=0.2)
    document = json.loads(found.data)
    schema = json.loads((Path(__file__).parents[3] / "docs/schemas/elevation.v1.json").read_text())
    jsonschema.validate(document, schema, cls=jsonschema.Draft202012Validator)
    row, col = (round((0.1 - document["origin"][axis]) / 0.2 - 0.5) for axis in ("y_m", "x_m"))
    assert document["ground"][row][col] == Ground.TRAVERSABLE
    assert document["height_m"][row][col] == pytest.approx(-1.0)
    shape = (document["rows"], document["columns"])
    for layer in ("min_m", "max_m", "variance_m2", "points", "height_m", "slope_rad", "step_m", "roughness_m"):
        assert np.shape(document[layer]) == shape
    assert Ground.STEP in {value for row in document["ground"] for value in row}
    below = elevation_of_file(tmp_path / "room.xyz", resolution_m=0.2, height_max_m=-0.95)
    assert below.report["step_cells"] == 0


def test_files_and_pictures_are_written_by_their_endings(tmp_path: Path) -> None:
    from PIL import Image

    cloud = cloud_file(tmp_path)
    for found in (quadtree_of_file(map_file(tmp_path)), octree_of_file(cloud), elevation_of_file(cloud)):
        own = write_extracted(found, tmp_path / f"own{found.ending}")
        assert own.path.read_bytes() == found.data
        write_extracted(found, tmp_path / "drawn.png")
        with Image.open(tmp_path / "drawn.png") as picture:
            assert min(picture.size) > 20
            assert len(picture.convert("RGB").getcolors(10_000) or []) >= 3
        with pytest.raises(FileTrouble, match="ending"):
            write_extracted(found, tmp_path / "map.bin")


def test_clouds_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "empty.xyz").write_text("nan nan nan\n")
    with pytest.raises(CloudTrouble, match="no point"):
        octree_of_file(tmp_path / "empty.xyz")
    (tmp_path / "far.xyz").write_text("0 0 0\n1e9 1e9 0\n")
    with pytest.raises(CloudTrouble, match="too many"):
        elevation_of_file(tmp_path / "far.xyz")
    assert octree_of_file(tmp_path / "far.xyz").report["rejected_points"] == 1


def test_the_commands_report_and_refuse(tmp_path: Path) -> None:
    map_path, cloud = str(map_file(tmp_path)), str(cloud_file(tmp_path))
    for arguments in (
        ["quadtree", map_path, "--out", str(tmp_path / "a.uqdt"), "--json"],
        ["octree", cloud, "--png", str(tmp_path / "b.png"), "--sensor", "0", "0", "0.2", "--json"],
        ["elevation", cloud, "--out", str(tmp_path / "c.json"), "--png", str(tmp_path / "c.png"), "--json"],
    ):
        done = runner.invoke(app, arguments)
        assert done.exit_code == 0, done.output
        report = json.loads(done.stdout)
        assert all(Path(entry["path"]).exists() for entry in report["files"])
        assert report["resolution_m"] > 0.0
    assert runner.invoke(app, ["elevation", cloud, "--slope-max-deg", "95"]).exit_code != 0
    assert runner.invoke(app, ["octree", cloud, "--sensor", "0", "0", "1e9"]).exit_code != 0
    assert math.isfinite(float(json.loads(done.stdout)["points"]))
