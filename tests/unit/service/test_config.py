"""The configuration: its defaults, every kind of fault, where values come from, and its texts."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import jsonschema
import pytest

from service.config import Config, Loaded, load
from service.config_devices import HokuyoLaser, UsBoardSonars
from service.config_files import daemon_endpoint, find_config, lines_of_keys
from service.config_text import EXAMPLE, effective_values, reference
from service.errors import WrongUsage

ROOT = Path(__file__).resolve().parents[3]

ROBOT = """
[drive]
source = "drive"

[can.main]
interface = "slcan"
channel = "/dev/pts/91"

[lasers.front]
driver = "hokuyo"
port = "/dev/pts/90"
mount = { x_m = 0.3, yaw_deg = 10.0 }

[sonars.front]
driver = "usboard"
can = "main"
transducers = [{ channel = 1, x_m = 0.45 }, { channel = 16, yaw_deg = -20 }]

[wheels.drive]
driver = "cia406"
can = "main"

[sectors.polar.laser]
sources = ["front"]

[sectors.rect.around]
sources = ["lasers.front", "sonars.front"]
"""


def load_text(folder: Path, text: str, *settings: str) -> Loaded:
    file = folder / "umfeld.toml"
    file.write_text(text)
    return load(file, settings=settings, environment={})


def faults(folder: Path, text: str, *settings: str) -> list[str]:
    with pytest.raises(WrongUsage) as trouble:
        load_text(folder, text, *settings)
    return [line.removeprefix(f"{folder}/umfeld.toml:") for line in trouble.value.lines]


def test_everything_has_a_default(tmp_path: Path) -> None:
    config = load_text(tmp_path, "").config
    assert config == Config.model_validate({})
    assert config.network.listen == ("tcp/127.0.0.1:7447",)
    assert config.grid.resolution_m == 0.05


def test_a_robot_is_read_as_written(tmp_path: Path) -> None:
    config = load_text(tmp_path, ROBOT).config
    laser = config.lasers["front"]
    assert isinstance(laser, HokuyoLaser)
    assert (laser.port, laser.mount.x_m, laser.mount.y_m, laser.mount.yaw_deg) == ("/dev/pts/90", 0.3, 0.0, 10.0)
    assert [each.channel for each in config.sonars["front"].transducers] == [1, 16]
    assert config.sonars["front"].transducers[1].yaw_deg == -20.0
    assert [(section, name) for section, name, _ in config.devices()] == [
        ("lasers", "front"),
        ("sonars", "front"),
        ("wheels", "drive"),
    ]


def test_names_shared_by_sections_stay_apart(tmp_path: Path) -> None:
    config = load_text(tmp_path, ROBOT).config
    assert config.source_name("lasers", "front") == "front"
    assert config.source_name("sonars", "front") == "sonars-front"
    assert config.source_name("wheels", "drive") == "drive"
    assert config.resolve("front") == ("lasers", "front")
    assert config.resolve("sonars.front") == ("sonars", "front")
    with pytest.raises(KeyError):
        config.resolve("wheels.drive")


def test_the_configuration_of_the_architecture_page_is_valid(tmp_path: Path) -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    config = load_text(tmp_path, page.split("```toml")[1].split("```")[0]).config
    assert config.robot.id == "artos"
    chain = config.sonars["front"]
    assert isinstance(chain, UsBoardSonars)
    assert chain.base_id == 0x400


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[robto]\n", "1: robto: unknown key; did you mean robot?"),
        ("[robot]\nidd = 'x'\n", "2: robot.idd: unknown key; did you mean id?"),
        ("[grid]\nresolution = 0.05", "2: grid.resolution: unknown key; did you mean resolution_m?"),
        (
            "[lasers.front]\ndriver = 'rplidar'\nport = '/dev/ttyUSB0'\ny_m = 0.2",
            "4: lasers.front.y_m: unknown key; did you mean mount.y_m?",
        ),
        (
            "[lasers.front]\ndriver = 'rplidar'\nport = '/dev/ttyUSB0'\nserail = 'AA55'",
            "4: lasers.front.serail: unknown key; did you mean serial?",
        ),
        ("[grid]\n\nresolution_m = '5 cm'", "3: grid.resolution_m: is '5 cm', expected a number"),
        ("[grid]\nresolution_m = nan", "2: grid.resolution_m: is nan, expected a finite number"),
        ("[grid]\nresolution_m = 0.0", "2: grid.resolution_m: is 0.0, .*0.005"),
        ("[grid]\nenabled = 1", "2: grid.enabled: is 1, expected true or false"),
        ("[grid]\nmodel = 'odds'", "2: grid.model: is 'odds', must be 'counters' or 'log-odds'"),
        ("grid = 3", "1: grid: is 3, expected a table"),
        (
            "[drive]\nticks_per_turn_left = 0",
            "2: drive.ticks_per_turn_left: counts per turn cannot be 0; .*data sheet.*",
        ),
        ("[lasers.Front]\ndriver='hokuyo'\nport='a'", "1: lasers.Front: 'Front' is not a name; use lower case .*"),
        ("[lasers.front]\ndriver = 'hokuyo'", "1: lasers.front.port: is missing; add it"),
        ("[lasers.front]\nport = 'a'", "1: lasers.front.driver: .*missing.*add it"),
        ("[lasers.front]\ndriver = 'hokujo'\nport = 'a'", "2: lasers.front.driver: .*'hokujo'.*'hokuyo'.*"),
        (
            "[lasers.front]\ndriver = 'hokuyo'\nport = 'a'\nmount = { x_m = 1.0, yaw = 3.0 }",
            "4: lasers.front.mount.yaw: unknown key; did you mean yaw_deg?",
        ),
        (
            "[drive]\nsource = 'drvie'\n[can.c]\n[wheels.drive]\ndriver='cia406'\ncan='c'",
            r"2: drive.source: there is no \[wheels.drvie\]; add \[wheels.drvie\], or name one of: drive",
        ),
        (
            "[sonars.a]\ndriver = 'usboard'\ncan = 'main'",
            r"3: sonars.a.can: there is no \[can.main\]; add \[can.main\]",
        ),
        ("[sectors.polar.a]\nsources = ['nose']", r"2: sectors.polar.a.sources: there is no sensor nose; .*"),
        ("[grid]\nsources = ['nose']", r"2: grid.sources: there is no sensor nose; .*"),
        (
            "[lasers.a]\ndriver='hokuyo'\nport='/dev/x'\n[lasers.b]\ndriver='hokuyo'\nport='/dev/x'",
            "6: lasers.b.port: /dev/x is already used by lasers.a; each wire has a port of its own",
        ),
        (
            "[can.c]\ninterface='slcan'\nchannel='/dev/x'\n[lasers.b]\ndriver='hokuyo'\nport='/dev/x'",
            "3: can.c.channel: /dev/x is already used by lasers.b; each wire has a port of its own",
        ),
        (
            "[can.c]\n[sonars.a]\ndriver='usboard'\ncan='c'\n[sonars.b]\ndriver='usboard'\ncan='c'\nbase_id=0x410",
            r"5: sonars.b: uses CAN id 0x410 on \[can.c\] like sonars.a; give one other ids .*",
        ),
        (
            "[can.c]\n[drive]\nsource='w'\n[wheels.w]\ndriver='cia406'\ncan='c'\nnode_left=5\nnode_right=5",
            "4: wheels.w: node_left and node_right are the same; each encoder has a node id of its own",
        ),
        (
            "[can.c]\n[wheels.w]\ndriver='cia406'\ncan='c'",
            r'2: wheels.w: no drive uses it; add source = "w" to \[drive\].*',
        ),
        ("[robot]\nfootprint_m = [[1,1],[1,-1],[2,0]]", "2: robot.footprint_m: the outline must enclose the origin .*"),
        (
            "[sectors.polar.a]\nsources=['f']\nsector_deg=7\n[lasers.f]\ndriver='hokuyo'\nport='a'",
            "1: .*whole number.*",
        ),
        ("[network]\nlisten = ['tcp/0.0.0.0:7447']", "1: network: .*open to everyone.*tcp/127.0.0.1:7447.*"),
        ("[network]\nlisten = ['tcp/[::]:7447']", "1: network: .*open to everyone.*"),
        ("[network]\nlisten = ['127.0.0.1:7447']", "2: network.listen: .*is not an endpoint; write it like tcp/127.*"),
        ("[network]\nlisten = ['tls/0.0.0.0:7447']", r"1: network: .*needs certificates; add \[network.tls\].*"),
        ("[artos]\nenabled = true", r"2: artos.enabled: .*add a \[sectors.polar.NAME\]"),
    ],
)
def test_each_fault_is_one_line_with_place_and_repair(tmp_path: Path, text: str, line: str) -> None:
    found = faults(tmp_path, text)
    assert len(found) == 1, found
    assert re.fullmatch(line.replace("?", r"\?"), found[0]), found[0]


def test_all_faults_are_listed_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = (
        ROBOT.replace("channel =", "chanel =", 1).replace("port =", "prot =").replace("sectors.polar", "sectors.polr")
    )
    text += "sources_m = []\n[drive2]\n[store]\npath = 3\n"
    found = faults(tmp_path, text, "grid.resolution_m=wide")
    keys = [re.sub(r"^(\d+|--set): ", "", line).split(": ")[0] for line in found]
    assert sorted(keys) == sorted(
        [
            "grid.resolution_m",
            "can.main.chanel",
            "lasers.front.port",
            "lasers.front.prot",
            "sectors.polr",
            "sectors.rect.around.sources_m",
            "drive2",
            "store.path",
        ]
    )
    numbers = [int(line.split(":")[0]) for line in found if line[0].isdigit()]
    assert numbers == sorted(numbers)
    assert len(numbers) == 7


def test_local_endpoints_are_allowed(tmp_path: Path) -> None:
    listen = ["tcp/127.0.0.1:1", "tcp/localhost:2", "tcp/[::1]:3", "unixsock-stream//run/u.sock", "tcp/127.1.2.3:4"]
    assert load_text(tmp_path, f"[network]\nlisten = {json.dumps(listen)}").config.network.listen == tuple(listen)


def test_a_name_that_looks_like_loopback_is_not(tmp_path: Path) -> None:
    assert "open to everyone" in faults(tmp_path, "[network]\nlisten = ['tcp/127.0.0.1.example.org:7447']")[0]


def test_origins_say_where_each_value_was_set(tmp_path: Path) -> None:
    file = tmp_path / "umfeld.toml"
    file.write_text(ROBOT)
    overlays = tmp_path / "umfeld.d"
    overlays.mkdir()
    (overlays / "10-a.toml").write_text("[grid]\nresolution_m = 0.1\n[lasers.front.mount]\nx_m = 0.4\n")
    (overlays / "20-b.toml").write_text("\n[grid]\nresolution_m = 0.2\n")
    (overlays / "ignored.txt").write_text("nonsense")
    loaded = load(
        file, settings=["store.snapshot_period_s=9.5"], environment={"UMFELD__ROBOT__ID": "r9", "UMFELD_X": "1"}
    )
    assert loaded.config.grid.resolution_m == 0.2
    assert loaded.config.lasers["front"].mount.x_m == 0.4
    assert loaded.config.lasers["front"].mount.yaw_deg == 10.0
    assert loaded.config.robot.id == "r9"
    assert loaded.config.store.snapshot_period_s == 9.5
    origin = {".".join(each.path): each.origin for each in effective_values(loaded)}
    assert origin["grid.resolution_m"] == f"{overlays}/20-b.toml:3"
    assert origin["lasers.front.mount.x_m"] == f"{overlays}/10-a.toml:4"
    assert origin["lasers.front.mount.yaw_deg"] == f"{file}:12"
    assert origin["lasers.front.mount.y_m"] == "default"
    assert origin["lasers.front.port"] == f"{file}:11"
    assert origin["lasers.front.baud_bps"] == "default"
    assert origin["robot.id"] == "environment UMFELD__ROBOT__ID"
    assert origin["store.snapshot_period_s"] == "--set"
    assert loaded.files == (file, overlays / "10-a.toml", overlays / "20-b.toml")


def test_lines_are_found_in_any_layout() -> None:
    keys, tables = lines_of_keys(
        'top = 1\n# c\n[a.b]\nx = [\n  1, # ]\n  2,\n]\ny.z = "[no]"\ns = """\n[not.a.table]\nq = 1\n"""\n'
        '[ "quoted key" ]\nm = { i = 1, j.k = 2 }\n[[list]]\nv = 1\n'
    )
    assert keys == {
        ("top",): 1,
        ("a", "b", "x"): 4,
        ("a", "b", "y", "z"): 8,
        ("a", "b", "s"): 9,
        ("quoted key", "m", "i"): 14,
        ("quoted key", "m", "j", "k"): 14,
        ("list", "v"): 16,
    }
    assert tables == {("a", "b"): 3, ("quoted key",): 13, ("list",): 15}


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"[robot\n", "is not valid TOML"), (b"\xff\xfe", "is not UTF-8"), (b"a = 1\na = 2\n", "is not valid TOML")],
)
def test_a_file_that_cannot_be_parsed(tmp_path: Path, content: bytes, says: str) -> None:
    file = tmp_path / "umfeld.toml"
    file.write_bytes(content)
    with pytest.raises(WrongUsage, match=says):
        load(file, environment={})


def test_a_file_that_is_not_there_names_the_repair(tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match="umfeld config init"):
        load(tmp_path / "none.toml")


def test_the_first_of_the_usual_places_wins(tmp_path: Path) -> None:
    here, home = tmp_path / "here", tmp_path / "home"
    (home / ".config/umfeld").mkdir(parents=True)
    here.mkdir()
    (home / ".config/umfeld/umfeld.toml").write_text("")
    assert find_config(None, home=home, here=here) == home / ".config/umfeld/umfeld.toml"
    (here / "umfeld.toml").write_text("")
    assert find_config(None, home=home, here=here) == here / "umfeld.toml"


def test_clients_find_the_daemon_even_if_the_rest_of_the_file_is_wrong(tmp_path: Path) -> None:
    file = tmp_path / "umfeld.toml"
    file.write_text("[network]\nlisten = ['tcp/127.0.0.1:9']\n[nonsense]\n")
    assert daemon_endpoint(file) == "tcp/127.0.0.1:9"
    assert daemon_endpoint(tmp_path / "none.toml") == "tcp/127.0.0.1:7447"
    file.write_text("[network]\nlisten = 3\n")
    assert daemon_endpoint(file) == "tcp/127.0.0.1:7447"


def test_the_store_follows_the_service_managers_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_text(tmp_path, "[robot]\nid = 'r1'").config
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/state:/other")
    assert config.store_path() == tmp_path / "state/r1.umfeld"
    monkeypatch.delenv("STATE_DIRECTORY")
    assert config.store_path() == Path.home() / ".local/share/umfeld/r1.umfeld"


def test_the_example_is_valid_as_it_is_and_with_everything_in_use(tmp_path: Path) -> None:
    load_text(tmp_path, EXAMPLE)
    used = re.sub(r"(?m)^# ?(?=\[|[a-z_]+ = |\s+\{|\]$)", "", EXAMPLE)
    config = load_text(tmp_path, used).config
    assert config.lasers.keys() == {"front"}
    assert len(config.sonars["bumper"].transducers) == 2
    assert config.drive.source == "drive"
    assert config.sectors.rect["around"].sources == ("front", "bumper")


def test_the_schema_accepts_what_we_accept_and_refuses_unknown_keys() -> None:
    import tomllib

    schema = Config.model_json_schema()
    jsonschema.validate(tomllib.loads(ROBOT), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"robot": {"idd": "x"}}, schema)


def test_the_page_of_all_keys_is_up_to_date() -> None:
    page = (ROOT / "docs/configuration.md").read_text()
    assert reference().strip() in page, "run: umfeld config schema --markdown, and put it into docs/configuration.md"


def test_no_key_lacks_its_meaning() -> None:
    rows = [row for row in reference().splitlines() if row.startswith("| `")]
    assert len(rows) > 80
    assert not [row for row in rows if row.split(" | ")[2].strip(" |") == ""]


def test_environment_is_read_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "umfeld.toml"
    file.write_text("")
    monkeypatch.setitem(os.environ, "UMFELD__GRID__RESOLUTION_M", "0.25")
    assert load(file).config.grid.resolution_m == 0.25
