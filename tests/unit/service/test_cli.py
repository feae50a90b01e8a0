"""The command line: quick, honest exit codes, one clear line for every mistake a person can make."""

from __future__ import annotations

import io
import json
import socket
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.__main__ import COMMANDS, main
from tests.waiting import free_port

HEAVY = ("numba", "scipy", "can", "canopen", "aiohttp", "matplotlib", "rosbags", "networkx", "shapely")
LIGHT = r"""
import sys
from service.__main__ import main
try:
    main({arguments!r})
except SystemExit as end:
    code = end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
peak = next(int(line.split()[1]) // 1024 for line in open("/proc/self/status") if line.startswith("VmHWM"))
print("\nREPORT", code, peak, heavy)
"""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


def umfeld(*arguments: str, cwd: Path | None = None, **environment: str) -> Ended:
    """The command line inside this process: a process of its own costs half a second each."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        for name, value in {"COLUMNS": "200", **environment}.items():
            patch.setenv(name, value)
        if cwd is not None:
            patch.chdir(cwd)
        code: object = 0
        try:
            main(arguments)
        except SystemExit as end:
            code = end.code
    return Ended(int(str(code or 0)), out.getvalue(), err.getvalue())


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["status", "--connect", "tcp/127.0.0.1:1"]])
def test_light_commands_load_nothing_heavy(arguments: list[str]) -> None:
    code = LIGHT.format(arguments=arguments, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    _, exit_code, megabytes, *heavy = done.stdout.splitlines()[-1].split(maxsplit=3)
    assert heavy == ["[]"]
    assert int(megabytes) <= 80
    assert exit_code == ("1" if arguments[0] == "status" else "0")


def test_help_names_every_command_that_is_there() -> None:
    done = umfeld("--help")
    assert done.returncode == 0
    for name in ("run", "check", "status", "config"):
        assert name in done.stdout
        assert COMMANDS[name] in done.stdout


@pytest.mark.parametrize("name", ["run", "check", "status", "config"])
def test_every_command_has_an_example(name: str) -> None:
    done = umfeld("config", "show", "--help") if name == "config" else umfeld(name, "--help")
    assert done.returncode == 0
    assert "Example: umfeld" in done.stdout


def test_only_the_command_that_was_called_is_imported() -> None:
    code = "import sys; from service.__main__ import build_app; build_app('status'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    loaded = {name for name in done.stdout.split() if name.startswith("service.commands.")}
    assert loaded == {"service.commands.status"}


def test_an_unknown_command_suggests_the_nearest() -> None:
    done = umfeld("chek")
    assert done.returncode == 2
    assert "check" in done.stderr


def test_wrong_configuration_is_one_line_a_fault_and_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "umfeld.toml").write_text("[robto]\n[grid]\nresolution = 1\n")
    for command in ("run", "check", "config"):
        done = umfeld(command, *(["show"] if command == "config" else []), cwd=tmp_path)
        assert done.returncode == 2
        lines = done.stderr.splitlines()
        assert len(lines) == 2, done.stderr
        assert lines[0].endswith("robto: unknown key; did you mean robot?")
        assert lines[1].endswith("grid.resolution: unknown key; did you mean resolution_m?")


def test_a_missing_configuration_file() -> None:
    done = umfeld("run", "--config", "/nowhere/umfeld.toml")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "umfeld config init" in done.stderr


def test_a_zenoh_port_in_use_ends_the_start_with_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        port = taken.getsockname()[1]
        (tmp_path / "umfeld.toml").write_text(
            f'[network]\nlisten = ["tcp/127.0.0.1:{port}"]\n[store]\npath = "{tmp_path}/m.umfeld"\n'
        )
        done = umfeld("run", cwd=tmp_path)
        assert done.returncode == 1
        told = [line for line in done.stderr.splitlines() if "INFO" not in line]  # a cold cache is told of
        assert [line for line in told if "umfeld: " in line] == told
        assert f"tcp/127.0.0.1:{port} is in use" in done.stderr
        assert "[network] listen" in done.stderr
        checked = umfeld("check", cwd=tmp_path)
        assert checked.returncode == 1
        assert "stop the daemon or router" in checked.stderr


def test_check_names_an_absent_port_and_the_repair(tmp_path: Path) -> None:
    (tmp_path / "umfeld.toml").write_text(
        f'[lasers.front]\ndriver = "hokuyo"\nport = "{tmp_path}/none"\n[store]\npath = "{tmp_path}/m.umfeld"\n'
        f'[network]\nlisten = ["tcp/127.0.0.1:{free_port()}"]\n'
    )
    done = umfeld("check", "--seconds", "0.5", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        line for line in done.stderr.splitlines() if line.startswith(f"front: no {tmp_path}/none")
    ]
    assert "plugged in" in done.stderr
    document = json.loads(umfeld("check", "--seconds", "0.5", "--json", cwd=tmp_path).stdout)
    assert document["ok"] is False
    assert document["devices"][0]["state"] == "absent"
    assert document["problems"] == []


def test_check_accepts_a_configuration_without_devices(tmp_path: Path) -> None:
    done = umfeld(
        "check",
        *("--set", f"network.listen=['tcp/127.0.0.1:{free_port()}']", "--set", f"store.path={tmp_path}/m.umfeld"),
        cwd=tmp_path,
        HOME=str(tmp_path),
    )
    assert done.returncode == 0, done.stderr
    assert "no device is configured" in done.stdout


def test_status_without_a_daemon_says_how_to_start_one() -> None:
    done = umfeld("status", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "umfeld run" in done.stderr


def test_config_init_does_not_overwrite(tmp_path: Path) -> None:
    assert umfeld("config", "init", cwd=tmp_path).returncode == 0
    assert umfeld("config", "show", "--json", cwd=tmp_path).returncode == 0
    again = umfeld("config", "init", cwd=tmp_path)
    assert again.returncode == 2
    assert "--force" in again.stderr
    assert umfeld("config", "init", "--force", cwd=tmp_path).returncode == 0
    assert umfeld("config", "init", "-").stdout == (tmp_path / "umfeld.toml").read_text()


def test_config_schema_is_json() -> None:
    schema = json.loads(umfeld("config", "schema").stdout)
    assert schema["additionalProperties"] is False
    assert "lasers" in schema["properties"]


def test_output_cut_off_by_the_reader_is_no_error() -> None:
    command = f"{sys.executable} -m service config schema | head -c 10"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=300, check=False)
    assert "Traceback" not in done.stderr
