"""`umfeld demo` as its user calls it: three processes that find each other, an address, an ordered end."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from tests.waiting import GIVE_UP_S, START_S, wait_for

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_the_demo_gives_the_address_of_its_page_and_takes_all_of_it_down(tmp_path: Path, number: int) -> None:
    folder, said = tmp_path / "kept", tmp_path / "said"
    command = [sys.executable, "-m", "service", "demo", "--headless", "--keep", str(folder)]
    with said.open("wb") as out:
        process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT)
    try:
        wait_for("the page", lambda: "Ctrl-C" in said.read_text() or process.poll() is not None, START_S)
        assert process.poll() is None, said.read_text()
        address = next(line.split()[1] for line in said.read_text().splitlines() if line.startswith("page "))
        with urllib.request.urlopen(address, timeout=GIVE_UP_S) as answer:
            assert b"umfeld" in answer.read()
        process.send_signal(number)
        assert process.wait(GIVE_UP_S) == 0, said.read_text()
    finally:
        process.kill()
        process.wait()
    assert not any(each.is_symlink() for each in folder.iterdir()), "the emulators have taken their ports away"
    assert (folder / "demo.umfeld").exists()
