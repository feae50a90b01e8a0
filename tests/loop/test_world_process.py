"""`python -m sim_devices` as a process: what it prints, what its ptys answer, how it ends."""

from __future__ import annotations

import itertools
import json
import os
import select
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.config import load
from tests.waiting import GIVE_UP_S, wait_for

ROOT = Path(__file__).parents[2]


@contextmanager
def simulation(
    folder: Path, *arguments: str, command: Sequence[str] = ("-m", "sim_devices")
) -> Iterator[subprocess.Popen[bytes]]:
    """A running simulation whose configuration is there."""
    process = subprocess.Popen(
        [sys.executable, *command, "--dir", str(folder), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    try:
        wait_for("the configuration", lambda: (folder / "umfeld.toml").exists() or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1].decode()
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def ended(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> tuple[int, str, str]:
    process.send_signal(number)
    out, err = process.communicate(timeout=GIVE_UP_S)
    return process.returncode, out.decode(), err.decode()


def played(*arguments: str) -> tuple[int, str, str]:
    """A simulation that ends by itself; it may be over before anybody has seen its files."""
    command = [sys.executable, "-m", "sim_devices", *arguments]
    done = subprocess.run(command, capture_output=True, cwd=ROOT, timeout=GIVE_UP_S, check=False)
    return done.returncode, done.stdout.decode(), done.stderr.decode()


def refused(*arguments: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "sim_devices", *arguments], capture_output=True, cwd=ROOT, timeout=GIVE_UP_S, check=False
    )
    assert done.stdout == b""
    return done.returncode, done.stderr.decode()


def asked(path: Path, question: bytes, ending: bytes) -> bytes:
    """What a device answers on its pty, up to an ending."""
    file = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(file, question)
        answer = b""
        deadline = time.monotonic() + GIVE_UP_S
        while not answer.endswith(ending) and time.monotonic() < deadline:
            if select.select([file], [], [], 0.1)[0]:
                answer += os.read(file, 4096)
        return answer
    finally:
        os.close(file)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_prints_a_configuration_answers_on_its_ports_and_leaves_nothing_behind(tmp_path: Path, number: int) -> None:
    folder = tmp_path / "sim"
    with simulation(folder) as process:
        text = (folder / "umfeld.toml").read_text()
        config = load(folder / "umfeld.toml").config
        assert asked(Path(config.lasers["front"].port), b"VV\n", b"\n\n").count(b"\n") == 8
        assert asked(Path(config.can["main"].channel), b"V\r", b"\r").startswith(b"V")
        code, out, err = ended(process, number)
    assert code == 0
    assert out == text
    assert "Traceback" not in err
    assert tomllib.loads(out)["robot"]["id"] == "artos"
    assert sorted(p.name for p in folder.iterdir()) == [".lock"]


def test_a_folder_serves_one_simulation(tmp_path: Path) -> None:
    folder = tmp_path / "sim"
    with simulation(folder) as process:
        code, said = refused("--dir", str(folder))
        assert code == 1
        assert "another simulation" in said
        assert asked(folder / "can-main", b"V\r", b"\r")  # the first still runs
        assert ended(process)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--world", "flatt"], 1, "no world 'flatt'"),
        (["--world", "/nonexistent.toml"], 1, "cannot be read"),
        (["--log", "/nonexistent.log"], 1, "/nonexistent.log: cannot be read"),
        (["--preset", "r2d2"], 1, "no preset 'r2d2'"),
        (["--fault", "laser:unplugged"], 1, "did you mean unplug"),
        (["--fault", "lasr:unplug"], 1, "lasr"),
        (["--preset", "artos", "--config", "x"], 1, "exclude each other"),
        (["--config", "/nonexistent.toml"], 1, "cannot be read"),
        (["--speed", "0"], 2, "not above 0"),
        (["--speed", "nan"], 2, "not above 0"),
        (["--laser", "sick"], 2, "invalid choice"),
        (["--nonsense"], 2, "unrecognized"),
    ],
)
def test_wrong_use_is_told_in_one_line(tmp_path: Path, arguments: list[str], code: int, said: str) -> None:
    got, text = refused("--dir", str(tmp_path / "sim"), *arguments)
    assert got == code
    assert said in text.splitlines()[-1]
    assert "Traceback" not in text


def test_its_own_configuration_can_be_emulated_again(tmp_path: Path) -> None:
    first, second = tmp_path / "one", tmp_path / "two"
    with simulation(first) as process:
        (tmp_path / "config.toml").write_text((first / "umfeld.toml").read_text())
        ended(process)
    code, text, _ = played("--dir", str(second), "--config", str(tmp_path / "config.toml"), "--duration", "0.5")
    assert code == 0
    again = load_text(text, tmp_path)
    assert again["can"]["main"]["channel"] == str(second / "can-main")


def test_a_configuration_of_one_device_is_emulated(tmp_path: Path) -> None:
    """As a device's page has it: without a robot, a drive or maps."""
    config = tmp_path / "robot.toml"
    config.write_text('[lasers.front]\ndriver = "ldrobot"\nport = "/dev/ttyUSB0"\n')
    code, text, said = played("--dir", str(tmp_path / "sim"), "--config", str(config), "--duration", "0.5")
    assert code == 0, said
    assert load_text(text, tmp_path)["lasers"]["front"]["port"] == str(tmp_path / "sim" / "laser-front")


def load_text(text: str, folder: Path) -> dict[str, dict[str, dict[str, object]]]:
    path = folder / "again.toml"
    path.write_text(text)
    load(path)
    return tomllib.loads(text)


def truth(path: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_robot_waits_for_a_host_unless_told_when(tmp_path: Path) -> None:
    waiting, driving = tmp_path / "waiting.jsonl", tmp_path / "driving.jsonl"
    assert played("--dir", str(tmp_path / "a"), "--truth", str(waiting), "--duration", "1.5")[0] == 0
    options = ("--truth", str(driving), "--start-after", "0", "--duration", "1.5")
    assert played("--dir", str(tmp_path / "b"), *options)[0] == 0
    assert {(row["x"], row["y"]) for row in truth(waiting)} == {(1.0, 4.1)}
    rows = truth(driving)
    assert rows[-1]["x"] > 1.2
    assert all(a["t"] < b["t"] for a, b in itertools.pairwise(rows))


def test_drive_commands_move_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "truth.jsonl"
    with simulation(tmp_path / "sim", "--drive", "--truth", str(path)) as process:
        assert process.stdin is not None
        process.stdin.write(b"nonsense\n0.5 0 0.6\n")
        process.stdin.flush()
        wait_for("the way", lambda: path.exists() and moved(path, 0.3), every_s=0.05)
        _, _, err = ended(process)
    assert truth(path)[-1]["x"] == pytest.approx(1.3, abs=1e-6)
    assert "is no command" in err


def moved(path: Path, metres: float) -> bool:
    lines = path.read_text().splitlines()
    return bool(lines) and json.loads(lines[-1])["x"] - 1.0 > metres - 1e-6


def test_a_log_is_played_to_its_end(tmp_path: Path) -> None:
    log, path = tmp_path / "small.log", tmp_path / "truth.jsonl"
    lines = [
        f"FLASER 180 {' '.join(['1.50'] * 180)} {k * 0.1} 0 0 {k * 0.1} 0 0 {100.0 + k * 0.1} host {k * 0.1}"
        for k in range(5)
    ]
    log.write_text("\n".join(lines) + "\n")
    options = ["--log", str(log), "--until-end", "--truth", str(path)]  # it begins when it is spoken to
    with simulation(tmp_path / "sim", *options, command=("-m", "service", "sim")) as process:
        config = load(tmp_path / "sim" / "umfeld.toml").config
        told = asked(tmp_path / "sim" / "laser-front", b"PP\n", b"\n\n")
        _, err = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == 0
    assert not config.sonars
    assert b"ARES:360" in told
    assert b"DMAX:1500" in told
    assert "5 scans" in err.decode()
    assert truth(path)[-1]["x"] == pytest.approx(0.4, abs=0.006)


def test_a_fault_on_the_command_line_pulls_the_plug(tmp_path: Path) -> None:
    pulled, back, clock = tmp_path / "pulled", tmp_path / "back", tmp_path / "truth.jsonl"
    with simulation(pulled, "--fault", "laser:unplug@100ms") as process:
        wait_for("the plug to be pulled", lambda: not (pulled / "laser-front").exists())
        assert ended(process)[0] == 0

    def has_run_s() -> float:
        rows = truth(clock) if clock.exists() else []
        return rows[-1]["t"] - rows[0]["t"] if rows else 0.0

    with simulation(back, "--fault", "laser:unplug@0s+200ms", "--truth", str(clock)) as process:
        wait_for("the end of the fault", lambda: has_run_s() > 0.4)
        wait_for("the wire to come back", lambda: (back / "laser-front").exists())
        assert ended(process)[0] == 0
