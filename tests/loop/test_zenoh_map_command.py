"""`umfeld map` against a publisher on loopback and against files."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.grids.patch import GridPatch
from service.clock import SystemClock
from service.export import image_of, load_pgm_yaml, save_pgm_yaml
from service.outputs import GridOut
from service.publisher import Publisher
from service.rpc import CallRefused
from service.store import MapStore, list_maps, write_occupancy_map
from service.zenoh_session import NetworkSettings
from tests.waiting import GIVE_UP_S, free_port, wait_for

CELLS = np.array([[0, 0, 100, -1], [0, -1, 100, 0], [100, 0, 0, 0]], np.int8)


class Maps:
    """A daemon's map service, as far as these tests need one."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.loaded = folder, ""

    def save(self, name: str) -> dict[str, Any]:
        return write_occupancy_map(GridPatch(0.1, 0, 0, CELLS), self.folder / f"{name}.umfeld", source="x").document()

    def load(self, name: str) -> dict[str, Any]:
        if not (self.folder / f"{name}.umfeld").exists():
            raise CallRefused(f"there is no map {name}")
        self.loaded = name
        return {"name": name, "kept": "replaced"}

    def new(self, name: str | None) -> dict[str, Any]:
        if name is None:
            return {"kept": None, "path": "/maps/live.umfeld"}
        return {"kept": {"name": name, "path": f"/maps/{name}.umfeld"}, "path": "/maps/live.umfeld"}

    def list(self) -> dict[str, Any]:
        return {"maps": list_maps(self.folder)}

    def info(self) -> dict[str, Any]:
        return {"rows": 3, "grid": {"columns": 4}}


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    publisher = Publisher("robots/r1", NetworkSettings(listen=(address,)), clock=SystemClock())
    publisher.calls.register_map_service(Maps(tmp_path_factory.mktemp("maps")))
    publisher.start()
    publisher.offer(GridOut(1, 1, GridPatch(0.1, -5, 7, CELLS)))
    yield address
    assert publisher.close(GIVE_UP_S)


@pytest.fixture
def umfeld(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command in this process: exit code, standard output, standard error."""
    from service.__main__ import main

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(["map", *(str(argument) for argument in arguments)])
        captured = capsys.readouterr()
        code = ended.value.code
        return (0 if code is None else int(code)), captured.out, captured.err

    return run


Run = Callable[..., tuple[int, str, str]]


def test_save_list_load_info_of_a_daemon(umfeld: Run, endpoint: str) -> None:
    code, out, _ = umfeld("save", "kitchen", "--connect", endpoint, "--json")
    receipt = json.loads(out)
    assert code == 0
    assert Path(receipt["path"]).stat().st_size == receipt["bytes"]
    code, out, _ = umfeld("list", "--connect", endpoint)
    assert code == 0
    assert out.startswith("kitchen ")
    code, out, _ = umfeld("load", "kitchen", "--connect", endpoint)
    assert (code, out) == (0, "kitchen is the live map now; the map before is kept as replaced\n")
    code, out, err = umfeld("load", "attic", "--connect", endpoint)
    assert (code, out) == (1, "")
    assert "there is no map attic" in err
    code, _, err = umfeld("save", "../evil", "--connect", endpoint)
    assert code == 1
    assert "one word" in err
    code, out, _ = umfeld("info", "--connect", endpoint)
    assert out.splitlines() == ["rows: 3", "grid.columns: 4"]
    code, out, _ = umfeld("info", "kitchen", "--connect", endpoint, "--json")  # a name, as `map list` tells them
    about = json.loads(out)
    assert code == 0
    assert (about["check"], about["grid"]["rows"], about["path"]) == ("ok", 3, receipt["path"])
    code, out, err = umfeld("info", "attic", "--connect", endpoint)
    assert (code, out) == (2, "")
    assert "(kitchen)" in err


def test_a_new_map_of_a_daemon_in_one_line(umfeld: Run, endpoint: str) -> None:
    code, out, _ = umfeld("new", "flat", "--connect", endpoint)
    assert code == 0
    assert out == ("a new map begins; the one before is kept as flat (umfeld map load flat): /maps/flat.umfeld\n")
    code, out, _ = umfeld("new", "--connect", endpoint, "--json")
    assert json.loads(out) == {"kept": None, "path": "/maps/live.umfeld"}
    code, _, err = umfeld("new", "../evil", "--connect", endpoint)
    assert code == 1
    assert "one word" in err


def test_a_new_map_of_a_file(umfeld: Run, tmp_path: Path) -> None:
    live = write_occupancy_map(GridPatch(0.1, 0, 0, CELLS), tmp_path / "live.umfeld", source="x").path
    with MapStore.open(live, wall_ns=lambda: 0):  # a daemon has it
        code, _, err = umfeld("new", "flat", "--store", live)
        assert code == 1
        assert "leave --store out" in err
    code, _, err = umfeld("new", "a/b", "--store", live)
    assert code == 1
    assert "one word" in err
    code, out, _ = umfeld("new", "flat", "--store", live)
    assert code == 0
    assert "kept as flat" in out
    assert {each["name"]: each["layers"] for each in list_maps(tmp_path)} == {
        "flat": {"occupancy": 1},
        "live": {},
    }
    code, out, _ = umfeld("new", "--store", live)
    assert (code, out) == (0, "a new map begins; the one before held nothing\n")
    code, _, err = umfeld("new", "--store", tmp_path / "absent.umfeld")
    assert code == 1
    assert "no such map" in err
    assert not (tmp_path / "absent.umfeld").exists()


def test_export_of_the_live_grid(umfeld: Run, endpoint: str, tmp_path: Path) -> None:
    wait_for("a grid", lambda: umfeld("export", tmp_path / "live.yaml", "--connect", endpoint)[0] == 0)
    image = load_pgm_yaml(tmp_path / "live.yaml")
    np.testing.assert_array_equal(image.cells, CELLS)
    assert (image.resolution_m, image.origin.x_m, image.origin.y_m) == pytest.approx((0.1, 0.7, -0.5))
    code, out, _ = umfeld("export", tmp_path / "live.png", "--connect", endpoint, "--json")
    assert code == 0
    assert [Path(entry["path"]).name for entry in json.loads(out)["files"]] == ["live.png"]


def test_import_and_export_of_files(umfeld: Run, tmp_path: Path) -> None:
    save_pgm_yaml(image_of(GridPatch(0.1, -5, 7, CELLS)), tmp_path / "in.yaml")
    target = tmp_path / "floor.umfeld"
    assert umfeld("import", tmp_path / "in.yaml", target)[0] == 0
    code, _, err = umfeld("import", tmp_path / "in.yaml", target)
    assert code == 2
    assert "--force" in err
    assert umfeld("import", tmp_path / "in.yaml", target, "--force")[0] == 0
    code, out, _ = umfeld("info", target, "--json")
    document = json.loads(out)
    assert code == 0
    assert (document["check"], document["grid"]["rows"], document["grid"]["columns"]) == ("ok", 3, 4)
    assert document["layers"]["grid"] >= 1  # what a daemon restores from
    assert umfeld("export", tmp_path / "out.pgm", "--store", target)[0] == 0
    np.testing.assert_array_equal(load_pgm_yaml(tmp_path / "out.yaml").cells, CELLS)
    assert (tmp_path / "out.pgm").read_bytes() == (tmp_path / "in.pgm").read_bytes()
    assert umfeld("save", tmp_path / "copy.umfeld", "--store", target)[0] == 0
    with MapStore.open(tmp_path / "copy.umfeld", wall_ns=lambda: 0, read_only=True) as copy:
        assert copy.get_meta("made_from") == "in.yaml"
    code, out, _ = umfeld("list", "--folder", tmp_path)
    assert [line.split()[0] for line in out.splitlines()] == ["copy", "floor"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("export", "x.bmp", "--store", "absent.umfeld"), "no such map"),
        (("info", "absent.yaml"), "cannot be read"),
        (("import", "absent.yaml", "x.umfeld"), "cannot be read"),
        (("import", "absent.yaml", "x.db"), "ends with .umfeld"),
        (("list", "--folder", "absent"), "not a folder"),
        (("info", "--connect", "tcp/127.0.0.1:1"), "umfeld run"),
    ],
)
def test_faults_name_the_repair(umfeld: Run, tmp_path: Path, arguments: tuple[str, ...], complaint: str) -> None:
    code, out, err = umfeld(*arguments)
    assert code in (1, 2)
    assert out == ""
    assert complaint in err
    assert err.startswith("umfeld: ")


def test_light_commands_stay_light(tmp_path: Path) -> None:
    """No numba, scipy or pydantic model is loaded to list, show or export a map."""
    write_occupancy_map(GridPatch(0.1, 0, 0, CELLS), tmp_path / "m.umfeld", source="x")
    script = (
        "import sys\nfrom service.__main__ import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as e:\n    assert not e.code, e.code\n"
        "print(sorted({'numba', 'scipy', 'shapely', 'networkx', 'rosbags'} & set(sys.modules)))"
    )
    for arguments in (
        ("info", tmp_path / "m.umfeld"),
        ("export", tmp_path / "o.png", "--store", tmp_path / "m.umfeld"),
    ):
        command = [sys.executable, "-c", script, "map", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "[]"
