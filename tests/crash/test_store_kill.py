"""kill -9 and torn writes: a map file is always one that was committed, and never older than what was reported.

UMFELD_CRASHES scales the number of kills (default 25) and of torn files (ten times as many).
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from service.files import replacing
from service.store import MapStore, check_file

KILLS = int(os.environ.get("UMFELD_CRASHES", "25"))
TILES = 12

WRITER = f"""
import sys
from pathlib import Path
from service.store import MapStore
with MapStore.open(Path(sys.argv[1]), wall_ns=lambda: 0) as store:
    number = int(sys.argv[2])
    while True:
        number += 1
        payload = number.to_bytes(4, "big") * 500
        store.snapshot({{"a": [(row, 0, payload) for row in range({TILES})]}}, {{"number": number}})
        print(number, flush=True)
        if number % 20 == 0:
            store.keep_generation()
"""


def state_of(path: Path) -> int:
    """The number of the snapshot a file holds; fails if it holds parts of several."""
    with MapStore.open(path, wall_ns=lambda: 0) as store:
        assert store.restored == ""
        numbers = {payload[:4] for _row, _column, payload in store.load_tiles("a")}
        number = int(store.get_meta("number", 0))
        assert numbers <= {number.to_bytes(4, "big")}
        assert len(store.load_tiles("a")) == (TILES if number else 0)
    return number


def test_kill_at_any_time(tmp_path: Path) -> None:
    path = tmp_path / "m.umfeld"
    dice = random.Random(20240601)
    last = 0
    for kill in range(KILLS):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path), str(last)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        reported = int(writer.stdout.readline())  # it runs
        time.sleep(dice.uniform(0, 0.05))  # the very point of the test is an arbitrary instant
        writer.send_signal(signal.SIGKILL)
        reported = max([reported, *(int(line) for line in writer.stdout.read().split(b"\n")[:-1])])
        writer.wait()
        last = state_of(path)
        assert last >= reported, f"kill {kill}: {reported} was reported as saved, {last} is there"
    for generation in tmp_path.glob("m.umfeld.[12]"):
        assert check_file(generation) is None
    assert last > KILLS


SAVER = """
import sys
from pathlib import Path
from service.store import MapStore
with MapStore.open(Path(sys.argv[1]), wall_ns=lambda: 0) as store:
    print("saving", flush=True)
    while True:
        store.save_as(Path(sys.argv[1]).with_name("kitchen.umfeld"))
"""


def test_what_a_killed_save_left_behind_goes_with_the_next_start(tmp_path: Path) -> None:
    """Each one is as large as the map, and nothing else would ever remove it."""
    path = tmp_path / "m.umfeld"
    with MapStore.open(path, wall_ns=lambda: 0) as store:
        store.snapshot({"a": [(row, 0, os.urandom(100_000)) for row in range(TILES)]}, {})
    dice = random.Random(5)
    left = 0
    for _ in range(KILLS):
        saver = subprocess.Popen([sys.executable, "-c", SAVER, str(path)], stdout=subprocess.PIPE)
        assert saver.stdout is not None
        assert saver.stdout.readline()
        time.sleep(dice.uniform(0, 0.03))  # the very point of the test is an arbitrary instant
        saver.kill()
        saver.communicate()
        left += bool([*tmp_path.glob(".*.part*")])
        MapStore.open(path, wall_ns=lambda: 0).close()
        assert not [*tmp_path.glob(".*.part*")]
    assert left > KILLS / 5, "else nothing was tried"
    assert check_file(tmp_path / "kitchen.umfeld") is None


def test_what_another_process_still_saves_stays(tmp_path: Path) -> None:
    elsewhere = tmp_path / "other[1].umfeld"
    with replacing(elsewhere) as temporary:
        temporary.write_bytes(b"begun")
        MapStore.open(tmp_path / "m.umfeld", wall_ns=lambda: 0).close()
        assert temporary.read_bytes() == b"begun"
    assert elsewhere.read_bytes() == b"begun"


def test_torn_writes_of_the_log(tmp_path: Path) -> None:
    """The write-ahead log cut off or spoilt anywhere, as after a power cut: an earlier snapshot, whole."""
    path = tmp_path / "m.umfeld"
    wal = path.with_name(path.name + "-wal")
    with MapStore.open(path, wall_ns=lambda: 0) as store:
        for number in range(1, 9):
            tiles = [(row, 0, number.to_bytes(4, "big") * 500) for row in range(TILES)]
            store.snapshot({"a": tiles}, {"number": number})
        database, log = path.read_bytes(), wal.read_bytes()
    dice = random.Random(7)
    seen = set()
    for case in range(10 * KILLS):
        folder = tmp_path / "torn"
        folder.mkdir()
        torn = bytearray(log[: dice.randrange(len(log) + 1)])
        if case % 2 and torn:  # the tail holds old or random sectors instead
            begin = dice.randrange(len(torn)) // 512 * 512
            torn[begin : begin + 512] = dice.randbytes(len(torn[begin : begin + 512]))
        (folder / "m.umfeld").write_bytes(database)
        (folder / "m.umfeld-wal").write_bytes(torn)
        seen.add(state_of(folder / "m.umfeld"))
        shutil.rmtree(folder)
    assert seen <= set(range(9))
    assert len(seen) > 4  # the cuts really fell into different snapshots
