"""The map store: what goes in comes out, one writer, migrations, damage, a full disk."""

from __future__ import annotations

import errno
import hashlib
import resource
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapping.grids.patch import GridPatch
from service import store as store_module
from service.store import (
    OCCUPANCY,
    MapStore,
    Provenance,
    SnapshotQueue,
    StoreInUse,
    StoreNotWritten,
    StoreTrouble,
    check_file,
    generation_path,
    list_maps,
    occupancy_patch,
    occupancy_tiles,
    pack_array,
    trimmed,
    unpack_array,
    write_occupancy_map,
)


def wall() -> int:
    return 1_700_000_000_000_000_000


def open_map(path: Path, *, read_only: bool = False) -> MapStore:
    return MapStore.open(path, wall_ns=wall, read_only=read_only)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "maps" / "flat.umfeld"


def test_tiles_come_back_by_layer_and_place(path: Path) -> None:
    with open_map(path) as store:
        assert store.save_tiles("hits", [(1, -2, b"b"), (-1, 5, b"a"), (1, -3, b"")]) == 3
        assert store.save_tiles("misses", [(0, 0, bytes(range(256)))]) == 1
        store.set_meta("pose", [1.5, None, "x"])
    with open_map(path) as store:
        assert store.load_tiles("hits") == [(-1, 5, b"a"), (1, -3, b""), (1, -2, b"b")]
        assert store.load_tiles("nothing") == []
        assert store.layers() == {"hits": 3, "misses": 1}
        assert store.get_meta("pose") == [1.5, None, "x"]
        assert store.get_meta("absent", 7) == 7
        assert store.get_meta("saved_ns") == wall()


def test_only_what_differs_is_written(path: Path) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x"), (0, 1, b"y")])
        assert store.save_tiles("a", [(0, 0, b"x"), (0, 1, b"z")]) == 1
        assert store.snapshot({"a": [(0, 5, b"q")]}, replace=True) == 1
        assert store.load_tiles("a") == [(0, 5, b"q")]


@settings(max_examples=25)
@given(
    st.lists(
        st.dictionaries(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), st.binary(max_size=30), max_size=5),
        max_size=6,
    )
)
def test_any_sequence_of_snapshots_equals_a_dictionary(
    tmp_path_factory: pytest.TempPathFactory, rounds: list[dict[tuple[int, int], bytes]]
) -> None:
    path = tmp_path_factory.mktemp("store") / "m.umfeld"
    expected: dict[tuple[int, int], bytes] = {}
    with open_map(path) as store:
        for tiles in rounds:
            store.save_tiles("a", [(row, column, payload) for (row, column), payload in tiles.items()])
            expected |= tiles
    with open_map(path, read_only=True) as store:
        assert store.load_tiles("a") == sorted((row, column, payload) for (row, column), payload in expected.items())


def test_one_file_at_rest(path: Path) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x")])
        assert path.with_name(path.name + "-wal").exists()
    assert {p.name for p in path.parent.iterdir()} == {path.name, path.name + ".lock"}


def test_a_failed_snapshot_changes_nothing(path: Path) -> None:
    def tiles() -> Iterator[tuple[int, int, bytes]]:
        yield 0, 0, b"new"
        raise KeyError("the map went away")

    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"old")])
        with pytest.raises(KeyError):
            store.save_tiles("a", tiles())
        assert store.load_tiles("a") == [(0, 0, b"old")]
        store.save_tiles("a", [(0, 0, b"next")])  # and the store goes on


def test_a_second_writer_is_told_who_has_it(path: Path) -> None:
    with open_map(path):
        with pytest.raises(StoreInUse, match=r"process \d+.*\[store\] path"):
            open_map(path)
        with open_map(path, read_only=True) as reader:
            assert reader.layers() == {}
    with open_map(path):
        pass


def test_readers_see_commits_while_a_writer_writes(path: Path) -> None:
    with open_map(path) as writer, open_map(path, read_only=True) as reader:
        writer.save_tiles("a", [(0, 0, b"x")])
        assert reader.load_tiles("a") == [(0, 0, b"x")]
        with pytest.raises(StoreNotWritten):
            reader.save_tiles("a", [(0, 0, b"y")])


def test_provenance_and_info(path: Path) -> None:
    with open_map(path) as store:
        store.add_provenance(Provenance(1, "0.1", "abc", {"front": "URG-04LX"}))
        store.add_provenance(Provenance(2, "0.2", "def", {}))
        assert [entry.version for entry in store.provenance()] == ["0.1", "0.2"]
        assert store.provenance()[0].devices == {"front": "URG-04LX"}
        info = store.info()
    assert info["sessions"] == 2
    assert info["written_by"]["config_sha256"] == "def"
    assert info["schema_version"] == len(store_module.MIGRATIONS)


def test_save_as_is_a_whole_map_with_a_true_receipt(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.umfeld"
    copy.write_bytes(b"something older")
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x" * 10_000)])
        receipt = store.save_as(copy)
        store.save_tiles("a", [(0, 0, b"later")])
        with pytest.raises(StoreTrouble, match="the open map itself"):
            store.save_as(path)
    assert receipt.size == copy.stat().st_size
    assert receipt.sha256 == hashlib.sha256(copy.read_bytes()).hexdigest()
    assert receipt.path == copy.resolve()
    with open_map(copy, read_only=True) as opened:
        assert opened.load_tiles("a") == [(0, 0, b"x" * 10_000)]
    assert {p.name for p in tmp_path.iterdir()} == {"maps", "copy.umfeld"}


def test_save_as_into_nowhere_says_so(path: Path, tmp_path: Path) -> None:
    with open_map(path) as store, pytest.raises(Exception, match="make the folder"):
        store.save_as(tmp_path / "absent" / "m.umfeld")


def test_a_foreign_database_is_left_alone(path: Path) -> None:
    path.parent.mkdir()
    with sqlite3.connect(path) as foreign:
        foreign.execute("CREATE TABLE t (x)")
    foreign.close()
    before = path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(StoreTrouble, match="not a map of umfeld"):
            open_map(path, read_only=read_only)
    assert path.read_bytes() == before


def test_a_newer_map_is_left_alone(path: Path) -> None:
    open_map(path).close()
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreTrouble, match="newer umfeld"):
        open_map(path)
    assert not list(path.parent.glob("*.damaged*"))


def test_migrations_bring_an_old_map_up(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x")])
    steps = (*store_module.MIGRATIONS, ("CREATE TABLE rooms (id INTEGER PRIMARY KEY, name TEXT)",))
    monkeypatch.setattr(store_module, "MIGRATIONS", steps)
    with open_map(path) as store:
        assert store.info()["schema_version"] == len(steps)
        assert store.load_tiles("a") == [(0, 0, b"x")]


def test_a_migration_that_fails_leaves_the_old_map(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x")])
    good = store_module.MIGRATIONS
    monkeypatch.setattr(store_module, "MIGRATIONS", (*good, ("CREATE TABLE rooms (id)", "NONSENSE")))
    with pytest.raises(StoreTrouble):
        open_map(path)
    monkeypatch.setattr(store_module, "MIGRATIONS", good)
    with open_map(path) as store:
        assert store.load_tiles("a") == [(0, 0, b"x")]


def damage(path: Path) -> None:
    raw = bytearray(path.read_bytes())
    raw[100:3000] = bytes(2900)
    path.write_bytes(raw)


def test_a_damaged_map_is_kept_aside_and_a_generation_takes_over(path: Path) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"good")])
        assert store.keep_generation() is not None
    damage(path)
    with open_map(path) as store:
        assert "flat.umfeld.1 took its place" in store.restored
        assert store.load_tiles("a") == [(0, 0, b"good")]
    assert path.with_name("flat.umfeld.damaged-1").exists()


def test_without_a_generation_the_map_begins_empty_and_says_so(path: Path) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"good")])
    damage(path)
    with open_map(path) as store:
        assert "begins empty" in store.restored
        assert store.layers() == {}


def test_a_flipped_bit_in_a_tile_is_found(path: Path) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"needle" * 100)])
    raw = path.read_bytes()
    at = raw.index(b"needleneedle")
    path.write_bytes(raw[:at] + b"N" + raw[at + 1 :])
    assert "does not match its hash" in (check_file(path) or "")
    with open_map(path, read_only=True) as reader, pytest.raises(StoreTrouble, match="damaged"):
        reader.load_tiles("a")


def test_generations_rotate_and_skip_what_did_not_change(tmp_path: Path) -> None:
    path = tmp_path / "m.umfeld"
    now = [1]
    with MapStore.open(path, wall_ns=lambda: now[0]) as store:
        for number in range(1, 5):
            now[0] = number
            store.save_tiles("a", [(0, 0, bytes((number,)))])
            assert store.keep_generation() is not None
            assert store.keep_generation() is None
    for number, payload in ((1, 4), (2, 3)):
        with open_map(generation_path(path, number), read_only=True) as generation:
            assert generation.load_tiles("a") == [(0, 0, bytes((payload,)))]
    assert not generation_path(path, 3).exists()


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond size: the kernel then refuses writes as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_loses_nothing_and_is_tried_again(path: Path) -> None:
    noise = np.random.default_rng(0).bytes
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"old")])
        queue = SnapshotQueue(store)
        queue.offer("a", [(0, 0, b"new"), (0, 1, noise(500_000))], {"note": 1})
        with disk_of(200_000):
            assert not queue.commit()
            assert not queue.commit()
        assert "not saved" in (queue.trouble or "")
        assert "free some space" in (queue.trouble or "")
        assert queue.counts["store_failed"] == 2
        assert queue.waiting == 2
        assert store.load_tiles("a") == [(0, 0, b"old")]
        queue.offer("a", [(0, 0, b"newest")])
        assert queue.commit()
        assert queue.trouble is None
        assert queue.waiting == 0
        assert store.load_tiles("a")[0] == (0, 0, b"newest")
        assert store.get_meta("note") == 1
    assert check_file(path) is None


def test_a_folder_is_no_map(tmp_path: Path) -> None:
    with pytest.raises(StoreTrouble, match=r"is a folder; set \[store\] path to a file in it, e.g. .*/map.umfeld"):
        open_map(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_map_of_another_user_is_told_with_its_repair(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x")])

    def refused(file: Path) -> str:
        raise PermissionError(errno.EACCES, "Permission denied", str(file))

    with monkeypatch.context() as others:
        others.setattr(store_module, "_repair", refused)
        with pytest.raises(StoreTrouble, match=r"Permission denied; give it to the user of the daemon \(`chown`\)"):
            open_map(path)
    with open_map(path) as store:  # the lock was let go
        assert store.load_tiles("a") == [(0, 0, b"x")]


def test_a_full_disk_keeps_the_old_copy(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.umfeld"
    with open_map(path) as store:
        store.save_tiles("a", [(0, 0, b"x")])
        store.save_as(copy)
        before = copy.read_bytes()
        store.save_tiles("a", [(0, 1, np.random.default_rng(0).bytes(500_000))])
        with disk_of(200_000), pytest.raises(StoreNotWritten, match="free some space"):
            store.save_as(copy)
    assert copy.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {"maps", "copy.umfeld"}


def test_an_empty_queue_commits_nothing(path: Path) -> None:
    with open_map(path) as store:
        queue = SnapshotQueue(store)
        assert queue.commit()
        assert queue.counts["store_commits"] == 0


@pytest.mark.parametrize("dtype", ["i1", "u1", "<u2", "<f4", "<f8", ">i4"])
def test_arrays_come_back(dtype: str) -> None:
    array = (np.random.default_rng(0).random((7, 3)) * 100).astype(dtype)
    again = unpack_array(pack_array(array))
    np.testing.assert_array_equal(again, array)
    again[0, 0] = 1  # writable


@given(st.binary(max_size=60))
def test_other_bytes_are_no_array(noise: bytes) -> None:
    with pytest.raises(StoreTrouble):
        unpack_array(noise)
    with pytest.raises(StoreTrouble):
        unpack_array(b"A1" + noise)


def test_an_array_that_claims_to_be_huge_is_refused() -> None:
    raw = bytearray(pack_array(np.zeros((2, 2), np.int8)))
    raw[6:14] = b"\xff" * 8
    with pytest.raises(StoreTrouble):
        unpack_array(bytes(raw))


@settings(max_examples=30)
@given(
    st.integers(-40, 40),
    st.integers(-40, 40),
    st.integers(1, 60),
    st.integers(1, 60),
    st.integers(1, 33),
    st.integers(0, 99),
)
def test_a_grid_survives_being_cut_into_tiles(
    tmp_path_factory: pytest.TempPathFactory, row0: int, col0: int, rows: int, columns: int, side: int, seed: int
) -> None:
    cells = np.random.default_rng(seed).integers(-1, 3, (rows, columns)).astype(np.int8)
    cells[0, 0] = cells[-1, -1] = 100  # so that nothing is trimmed
    patch = GridPatch(0.05, row0, col0, cells)
    path = tmp_path_factory.mktemp("grid") / "m.umfeld"
    write_occupancy_map(patch, path, source="test", tile_cells=side)
    with open_map(path, read_only=True) as store:
        again = occupancy_patch(store)
    assert (again.resolution_m, again.row0, again.col0) == (0.05, row0, col0)
    np.testing.assert_array_equal(again.cells, cells)
    assert [p.name for p in path.parent.iterdir()] == ["m.umfeld"]


def test_unknown_tiles_take_no_space() -> None:
    cells = np.full((100, 100), -1, np.int8)
    cells[95, 95] = 0
    assert [(row, column) for row, column, _ in occupancy_tiles(GridPatch(0.1, 0, 0, cells), 32)] == [(2, 2)]


def test_trimming_cuts_to_what_is_known() -> None:
    cells = np.full((5, 6), -1, np.int8)
    cells[2, 3], cells[3, 1] = 0, 100
    cut = trimmed(GridPatch(0.1, 10, 20, cells))
    assert (cut.row0, cut.col0, cut.cells.shape) == (12, 21, (2, 3))
    assert trimmed(GridPatch(0.1, 0, 0, np.full((3, 3), -1, np.int8))).cells.tolist() == [[-1]]


def test_an_empty_map_has_no_grid(path: Path) -> None:
    with open_map(path) as store, pytest.raises(StoreTrouble, match="holds no grid yet"):
        occupancy_patch(store)


def test_the_list_names_damaged_maps(tmp_path: Path) -> None:
    write_occupancy_map(GridPatch(0.1, 0, 0, np.zeros((2, 2), np.int8)), tmp_path / "good.umfeld", source="x")
    (tmp_path / "bad.umfeld").write_bytes(b"rubbish" * 1000)
    entries: dict[str, Any] = {entry["name"]: entry for entry in list_maps(tmp_path)}
    assert set(entries) == {"good", "bad"}
    assert entries["good"]["layers"] == {OCCUPANCY: 1}
    assert entries["bad"]["trouble"]


def test_an_absent_map_is_not_made_by_reading(path: Path) -> None:
    with pytest.raises(StoreTrouble, match="no such map"):
        open_map(path, read_only=True)
    assert not path.parent.exists()
