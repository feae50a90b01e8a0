"""Maps on disk: one SQLite file a map, old or new but never torn.

Write-ahead log, synced at every commit; a snapshot is one transaction of the tiles that changed, so that a power cut
at any instant leaves the state before or after it. One process writes (a lock beside the file), others may read
meanwhile. On opening the file is checked; a broken one is set aside, never deleted, and the newest sound generation
(FILE.1, FILE.2: whole copies made by keep_generation) takes its place.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import sqlite3
import struct
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.grids.patch import GridPatch
from service.files import FileTrouble, Receipt, receipt_of, remove_abandoned, replacing, sync

_LOG = logging.getLogger(__name__)

APPLICATION_ID = 0x756D6664  # "umfd": tells our files from other SQLite files
SUFFIX = ".umfeld"
OCCUPANCY = "occupancy"
"""The layer that exports read: int8 tiles, -1 unknown, 0 to 100; meta `occupancy` has resolution_m and tile_cells."""

_GENERATIONS = 2
_WAL_PAGES = 1000
_SQLITE_HEAD = b"SQLite format 3\0"
_BUSY_MS = 2000
Tile = tuple[int, int, bytes]


class StoreTrouble(FileTrouble):
    """A map file cannot be used; the text names it, the reason and the repair."""


class StoreInUse(StoreTrouble):
    """Another process writes this map."""


class StoreNotWritten(StoreTrouble):
    """A snapshot was not written, for instance because the disk is full; what was there before is untouched."""


MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
        """CREATE TABLE tiles (layer TEXT NOT NULL, row INTEGER NOT NULL, col INTEGER NOT NULL, payload BLOB NOT NULL,
           hash BLOB NOT NULL, PRIMARY KEY (layer, row, col))""",
        """CREATE TABLE provenance (id INTEGER PRIMARY KEY, opened_ns INTEGER NOT NULL, version TEXT NOT NULL,
           config_sha256 TEXT NOT NULL, devices TEXT NOT NULL)""",
    ),
)
"""Schema changes in order; step N brings a file from version N to N + 1. Never edit a step, add one."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """Who wrote a map. opened_ns: wall clock. devices: identity by name."""

    opened_ns: int
    version: str
    config_sha256: str
    devices: Mapping[str, str]


class MapStore:
    """An open map file. Methods may be called from any thread, one after the other.

    `wall_ns` is asked for the time of each snapshot.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, lock: int | None, wall_ns: Callable[[], int], *, restored: str
    ) -> None:
        """Use open() instead."""
        self.path = path
        self.restored = restored  # in words, if a generation took the place of a broken file; else empty
        self._db = connection
        self._lock_descriptor = lock
        self._wall_ns = wall_ns
        self._mutex = threading.RLock()

    @classmethod
    def open(cls, path: Path, *, wall_ns: Callable[[], int], read_only: bool = False) -> MapStore:
        """Open a map, made anew if there is none (not when read_only).

        StoreInUse if another process writes it; StoreTrouble if it is no map of ours, or newer than this program.
        """
        if read_only:
            if not path.is_file():
                raise StoreTrouble(f"{path}: there is no such map; `umfeld map list` names those there are")
            return cls(path, _connect(path, read_only=True), None, wall_ns, restored="")
        if path.is_dir():
            raise StoreTrouble(f"{path}: is a folder; set [store] path to a file in it, e.g. {path / f'map{SUFFIX}'}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = _take_lock(path)
        except OSError as error:
            where = f" ({error.filename})" if error.filename not in (None, str(path)) else ""
            raise StoreTrouble(f"{path}: {error.strerror}{where}; allow writing there or set [store] path") from error
        try:
            if abandoned := remove_abandoned(path.parent, SUFFIX):
                _LOG.info("%s: %.1f MB that a killed process had begun to save removed", path.parent, abandoned / 1e6)
            restored = _repair(path)
            connection = _connect(path, read_only=False)
            _migrate(connection, path)
        except OSError as error:  # another user's, for instance root's
            os.close(lock)
            owner = "give it to the user of the daemon (`chown`), or set another [store] path"
            raise StoreTrouble(f"{error.filename or path}: {error.strerror}; {owner}") from error
        except BaseException:
            os.close(lock)
            raise
        return cls(path, connection, lock, wall_ns, restored=restored)

    def __enter__(self) -> MapStore:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Fold the write-ahead log into the file, so that it is one file again, and let go of it."""
        with self._mutex:
            if self._lock_descriptor is not None:
                with contextlib.suppress(sqlite3.Error):  # a reader has it open: the log stays beside it, as good
                    self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()
            if self._lock_descriptor is not None:
                os.close(self._lock_descriptor)
                self._lock_descriptor = None

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """All or nothing; a failure to write becomes StoreNotWritten."""
        with self._mutex:
            try:
                self._db.execute("BEGIN IMMEDIATE")
                try:
                    yield self._db
                    self._db.execute("COMMIT")
                except BaseException:
                    if self._db.in_transaction:
                        self._db.execute("ROLLBACK")
                    raise
            except (sqlite3.Error, OSError) as error:
                raise StoreNotWritten(_why_not_written(self.path, error)) from error

    def snapshot(
        self, tiles: Mapping[str, Iterable[Tile]], meta: Mapping[str, Any] | None = None, *, replace: bool = False
    ) -> int:
        """Write changed tiles by layer, and meta values, in one transaction; returns the tiles that really differed.

        replace: the layers named hold nothing but these tiles afterwards. StoreNotWritten leaves all as it was.
        """
        written = 0
        with self._transaction() as db:
            for layer, changed in tiles.items():
                if replace:
                    db.execute("DELETE FROM tiles WHERE layer = ?", (layer,))
                for row, column, payload in changed:
                    written += _put_tile(db, layer, row, column, payload)
            for key, value in {**(meta or {}), "saved_ns": self._wall_ns()}.items():
                db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, json.dumps(value)))
        return written

    def save_tiles(self, layer: str, tiles: Iterable[Tile]) -> int:
        """A snapshot of one layer's changed tiles (row, column, bytes)."""
        return self.snapshot({layer: tiles})

    def load_tiles(self, layer: str) -> list[Tile]:
        """All tiles of a layer, by row and column. StoreTrouble if one does not match its hash."""
        with self._mutex, _explained(self.path):
            rows = self._db.execute(
                "SELECT row, col, payload, hash FROM tiles WHERE layer = ? ORDER BY row, col", (layer,)
            ).fetchall()
        for row, column, payload, digest in rows:
            if _hash(payload) != digest:
                raise StoreTrouble(
                    f"{self.path}: tile {row}, {column} of {layer} is damaged; load a generation ({self.path.name}.1)"
                )
        return [(row, column, payload) for row, column, payload, _ in rows]

    def layers(self) -> dict[str, int]:
        """Tiles by layer."""
        with self._mutex, _explained(self.path):
            return dict(self._db.execute("SELECT layer, count(*) FROM tiles GROUP BY layer ORDER BY layer").fetchall())

    def meta(self) -> dict[str, Any]:
        """All meta values."""
        with self._mutex, _explained(self.path):
            return {key: json.loads(value) for key, value in self._db.execute("SELECT key, value FROM meta")}

    def wall_ns(self) -> int:
        """Now, by the clock of its snapshots."""
        return self._wall_ns()

    def get_meta(self, key: str, default: Any = None) -> Any:
        """One meta value, anything JSON can say."""
        return self.meta().get(key, default)

    def set_meta(self, key: str, value: Any) -> None:
        """Write one meta value."""
        self.snapshot({}, {key: value})

    def add_provenance(self, provenance: Provenance) -> None:
        """Note who writes from now on; the last 1000 are kept."""
        with self._transaction() as db:
            db.execute(
                "INSERT INTO provenance (opened_ns, version, config_sha256, devices) VALUES (?, ?, ?, ?)",
                (
                    provenance.opened_ns,
                    provenance.version,
                    provenance.config_sha256,
                    json.dumps(dict(provenance.devices)),
                ),
            )
            db.execute("DELETE FROM provenance WHERE id <= (SELECT max(id) FROM provenance) - 1000")

    def provenance(self) -> list[Provenance]:
        """Who wrote this map, oldest first."""
        with self._mutex, _explained(self.path):
            rows = self._db.execute(
                "SELECT opened_ns, version, config_sha256, devices FROM provenance ORDER BY id"
            ).fetchall()
        return [Provenance(opened, version, digest, json.loads(devices)) for opened, version, digest, devices in rows]

    def save_as(self, path: Path) -> Receipt:
        """A whole copy under another name, checked by reading it back; the old file there is replaced at the end."""
        if path.resolve() == self.path.resolve():
            raise StoreTrouble(f"{path}: is the open map itself; choose another name")
        with self._mutex:
            try:
                with replacing(path) as temporary:  # empty, as VACUUM INTO wants it
                    self._db.execute("VACUUM INTO ?", (str(temporary),))
            except sqlite3.Error as error:
                raise StoreNotWritten(_why_not_written(path, error)) from error
        problem = check_file(path)
        if problem is not None:
            raise StoreNotWritten(f"{path}: the copy does not read back: {problem}; check the disk, save elsewhere")
        return receipt_of(path)

    def keep_generation(self) -> Receipt | None:
        """Make the present state FILE.1, the one before it FILE.2; None if nothing was saved since FILE.1."""
        newest = generation_path(self.path, 1)
        if newest.exists() and _saved_ns(newest) == self.get_meta("saved_ns"):
            return None
        fresh = newest.with_name(newest.name + ".new")
        self.save_as(fresh)
        for number in range(_GENERATIONS, 1, -1):
            older, younger = generation_path(self.path, number), generation_path(self.path, number - 1)
            if younger.exists():
                younger.replace(older)
        fresh.replace(newest)
        sync(newest.parent)
        return receipt_of(newest)

    def info(self) -> dict[str, Any]:
        """About the file: size, layers, meta, who wrote it last."""
        provenance = self.provenance()
        last = provenance[-1] if provenance else None
        with self._mutex, _explained(self.path):
            version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        return {
            "path": str(self.path),
            "bytes": bytes_of(self.path),
            "schema_version": version,
            "layers": self.layers(),
            "meta": self.meta(),
            "sessions": len(provenance),
            "written_by": None
            if last is None
            else {"version": last.version, "config_sha256": last.config_sha256, "devices": dict(last.devices)},
        }


class SnapshotQueue:
    """Changed tiles on their way to the disk: kept until a commit succeeded, the newest of each tile.

    It is bounded by the map itself, as every tile waits at most once. Thread-safe.
    """

    def __init__(self, store: MapStore) -> None:
        self._store = store
        self._tiles: dict[str, dict[tuple[int, int], bytes]] = {}
        self._meta: dict[str, Any] = {}
        self._mutex = threading.Lock()
        self.counts: Counter[str] = Counter()
        self.trouble: str | None = None  # why the last commit failed

    def offer(self, layer: str, tiles: Iterable[Tile], meta: Mapping[str, Any] | None = None) -> None:
        """Tiles that changed; they are written at the next commit."""
        with self._mutex:
            waiting = self._tiles.setdefault(layer, {})
            for row, column, payload in tiles:
                waiting[row, column] = payload
            self._meta |= meta or {}

    @property
    def waiting(self) -> int:
        """Tiles not on the disk yet."""
        with self._mutex:
            return sum(len(tiles) for tiles in self._tiles.values())

    def commit(self) -> bool:
        """Write what waits. False if it could not be: it stays in the queue, for the next commit."""
        with self._mutex:
            tiles, meta = self._tiles, self._meta
            self._tiles, self._meta = {}, {}
        if not tiles and not meta:
            return True
        try:
            written = self._store.snapshot(
                {
                    layer: ((row, column, payload) for (row, column), payload in sorted(waiting.items()))
                    for layer, waiting in tiles.items()
                },
                meta,
            )
        except StoreNotWritten as trouble:
            self._put_back(tiles, meta)
            self.counts["store_failed"] += 1
            self.trouble = str(trouble)
            return False
        self.counts["store_commits"] += 1
        self.counts["store_tiles"] += written
        self.trouble = None
        return True

    def _put_back(self, tiles: dict[str, dict[tuple[int, int], bytes]], meta: dict[str, Any]) -> None:
        with self._mutex:
            for layer, waiting in tiles.items():
                self._tiles[layer] = waiting | self._tiles.get(layer, {})  # what came meanwhile is newer
            self._meta = meta | self._meta


def generation_path(path: Path, number: int) -> Path:
    """FILE.umfeld.1 and so on."""
    return path.with_name(f"{path.name}.{number}")


def check_file(path: Path) -> str | None:
    """What is wrong with a map file, or None: SQLite's own check, and every tile against its hash."""
    try:
        connection = _connect(path, read_only=True)
    except StoreTrouble as trouble:
        return str(trouble)
    try:
        verdict = connection.execute("PRAGMA quick_check").fetchone()[0]
        if verdict != "ok":
            return str(verdict).splitlines()[0]
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        if version == 0:
            return None  # new, nothing in it yet
        for layer, row, column, payload, digest in connection.execute(
            "SELECT layer, row, col, payload, hash FROM tiles"
        ):
            if _hash(payload) != digest:
                return f"tile {row}, {column} of {layer} does not match its hash"
    except sqlite3.Error as error:
        return str(error)
    finally:
        connection.close()
    return None


def bytes_of(path: Path) -> int:
    """What a map takes on the disk, with what is not yet moved from its journal into the file itself."""
    journal = path.with_name(f"{path.name}-wal")
    return path.stat().st_size + (journal.stat().st_size if journal.exists() else 0)


def list_maps(folder: Path) -> list[dict[str, Any]]:
    """The map files of a folder: name, path, bytes, when saved; damaged ones say so."""
    found = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        entry: dict[str, Any] = {"name": path.stem, "path": str(path), "bytes": bytes_of(path)}
        try:
            with MapStore.open(path, wall_ns=lambda: 0, read_only=True) as store:
                entry |= {"saved_ns": store.get_meta("saved_ns"), "layers": store.layers(), "trouble": None}
        except StoreTrouble as trouble:
            entry |= {"saved_ns": None, "layers": {}, "trouble": str(trouble)}
        found.append(entry)
    return found


_ARRAY_HEAD = struct.Struct("<2s4sII")
_ARRAY_BYTES_MAX = 1 << 28


def pack_array(array: NDArray[Any]) -> bytes:
    """A plane of numbers as a tile's bytes: type, rows, columns, then the deflated values."""
    kind = array.dtype.newbyteorder("<").str.encode()
    head = _ARRAY_HEAD.pack(b"A1", kind, *array.shape)
    return head + zlib.compress(np.ascontiguousarray(array, dtype=kind.decode()).tobytes(), 1)


def unpack_array(payload: bytes) -> NDArray[Any]:
    """What pack_array packed; StoreTrouble if the bytes are something else."""
    try:
        magic, kind, rows, columns = _ARRAY_HEAD.unpack_from(payload)
        dtype = np.dtype(kind.rstrip(b"\0").decode())
        size = rows * columns * dtype.itemsize
        if magic != b"A1" or dtype.hasobject or size > _ARRAY_BYTES_MAX:
            raise ValueError(f"{magic!r} {dtype} {rows} x {columns}")
        inflater = zlib.decompressobj()
        values = inflater.decompress(payload[_ARRAY_HEAD.size :], size + 1)
        return np.frombuffer(values, dtype=dtype).reshape(rows, columns).copy()
    except (struct.error, ValueError, TypeError, UnicodeDecodeError, zlib.error) as error:
        raise StoreTrouble(f"a tile is not an array: {error}") from error


def occupancy_tiles(patch: GridPatch, tile_cells: int, *, also_unknown: bool = False) -> Iterator[Tile]:
    """A grid cut into the tiles of the layer OCCUPANCY.

    also_unknown: tiles that are unknown throughout as well, which take the place of what was known there before.
    """
    rows, columns = patch.cells.shape
    for row in range(patch.row0 // tile_cells, -(-(patch.row0 + rows) // tile_cells)):
        for column in range(patch.col0 // tile_cells, -(-(patch.col0 + columns) // tile_cells)):
            tile = np.full((tile_cells, tile_cells), -1, dtype=np.int8)
            top, left = row * tile_cells - patch.row0, column * tile_cells - patch.col0
            source = patch.cells[max(0, top) : max(0, top + tile_cells), max(0, left) : max(0, left + tile_cells)]
            tile[max(0, -top) : max(0, -top) + source.shape[0], max(0, -left) : max(0, -left) + source.shape[1]] = (
                source
            )
            if also_unknown or (tile >= 0).any():
                yield row, column, pack_array(tile)


def occupancy_patch(store: MapStore) -> GridPatch:
    """The whole grid of a store, cut to what is known; StoreTrouble if it holds none."""
    properties = store.get_meta(OCCUPANCY)
    tiles = [(row, column, unpack_array(payload)) for row, column, payload in store.load_tiles(OCCUPANCY)]
    if not properties or not tiles:
        raise StoreTrouble(f"{store.path}: holds no grid yet; let the robot drive, then save")
    side, resolution_m = int(properties["tile_cells"]), float(properties["resolution_m"])
    row0, col0 = min(tile[0] for tile in tiles), min(tile[1] for tile in tiles)
    rows, columns = max(tile[0] for tile in tiles) - row0 + 1, max(tile[1] for tile in tiles) - col0 + 1
    if rows * columns * side * side > _ARRAY_BYTES_MAX:
        raise StoreTrouble(f"{store.path}: {rows * side} x {columns * side} cells are too many for one picture")
    cells = np.full((rows * side, columns * side), -1, dtype=np.int8)
    for row, column, tile in tiles:
        top, left = (row - row0) * side, (column - col0) * side
        cells[top : top + side, left : left + side] = tile
    return trimmed(GridPatch(resolution_m, row0 * side, col0 * side, cells))


def trimmed(patch: GridPatch) -> GridPatch:
    """A patch without its borders of unknown cells; one unknown cell stays if there is nothing else."""
    known = np.argwhere(patch.cells >= 0)
    if known.size == 0:
        return GridPatch(patch.resolution_m, patch.row0, patch.col0, patch.cells[:1, :1])
    (top, left), (bottom, right) = known.min(axis=0).tolist(), (known.max(axis=0) + 1).tolist()
    return GridPatch(
        patch.resolution_m,
        patch.row0 + top,
        patch.col0 + left,
        np.ascontiguousarray(patch.cells[top:bottom, left:right]),
    )


def _put_tile(db: sqlite3.Connection, layer: str, row: int, column: int, payload: bytes) -> int:
    """Write a tile if it differs from what is there; 1 if it did."""
    digest = _hash(payload)
    cursor = db.execute(
        "INSERT INTO tiles VALUES (?, ?, ?, ?, ?) ON CONFLICT (layer, row, col) DO UPDATE"
        " SET payload = excluded.payload, hash = excluded.hash WHERE hash != excluded.hash",
        (layer, row, column, payload, digest),
    )
    return cursor.rowcount


def _hash(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=16).digest()


def _saved_ns(path: Path) -> int | None:
    try:
        with MapStore.open(path, wall_ns=lambda: 0, read_only=True) as store:
            value = store.get_meta("saved_ns")
    except StoreTrouble:
        return None
    return value if isinstance(value, int) else None


def _take_lock(path: Path) -> int:
    """The only writer's lock; the kernel takes it back when the process ends, however it ends."""
    lock_path = path.with_name(path.name + ".lock")
    descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip() or "unknown"
        os.close(descriptor)
        raise StoreInUse(
            f"{path}: another daemon (process {owner}) writes this map; stop it, or set another [store] path"
        ) from None
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    return descriptor


def _connect(path: Path, *, read_only: bool) -> sqlite3.Connection:
    uri = f"{path.resolve().as_uri()}?mode={'ro' if read_only else 'rwc'}"
    try:
        connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
    except sqlite3.Error as error:
        raise StoreTrouble(f"{path}: cannot be opened: {error}") from error
    try:
        connection.execute(f"PRAGMA busy_timeout = {_BUSY_MS}")
        application, version = (
            int(connection.execute(f"PRAGMA {name}").fetchone()[0]) for name in ("application_id", "user_version")
        )
        is_new = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if application != APPLICATION_ID and (not is_new or read_only):
            raise StoreTrouble(f"{path}: is not a map of umfeld; choose another file")
        if version > len(MIGRATIONS):
            raise StoreTrouble(
                f"{path}: was written by a newer umfeld (schema {version}, here {len(MIGRATIONS)}); update umfeld"
            )
        if not read_only:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute(f"PRAGMA wal_autocheckpoint = {_WAL_PAGES}")
            connection.execute("PRAGMA journal_size_limit = 4194304")
    except sqlite3.Error as error:
        connection.close()
        raise StoreTrouble(f"{path}: cannot be read as a map: {error}") from error
    except BaseException:
        connection.close()
        raise
    return connection


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    """Bring a file to the newest schema, each step in a transaction of its own."""
    try:
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        for number, statements in enumerate(MIGRATIONS[version:], start=version + 1):
            connection.execute("BEGIN IMMEDIATE")
            for statement in statements:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {number}")
            connection.execute("COMMIT")
    except sqlite3.Error as error:
        connection.close()
        raise StoreNotWritten(_why_not_written(path, error)) from error


def _repair(path: Path) -> str:
    """Set a broken file aside and put the newest sound generation in its place; what was done, in words."""
    if not path.exists() or path.stat().st_size == 0:
        return ""
    problem = check_file(path)
    if problem is None or "not a map of umfeld" in problem or "newer umfeld" in problem:
        return ""
    if "is locked" in problem:  # it is whole, but not ours to look at now
        raise StoreInUse(
            f"{path}: another program has locked this map: close it (`fuser -v {path}` names it), or set another "
            "[store] path"
        )
    if not _was_ours(path):
        raise StoreTrouble(f"{path}: is not a map of umfeld; move it away, or set another [store] path")
    aside = _free_name(path)
    for suffix in ("", "-wal", "-shm"):
        part = path.with_name(path.name + suffix)
        if part.exists():
            part.replace(aside.with_name(aside.name + suffix))
    text = f"{path} was damaged ({problem.removeprefix(f'{path}: ')}) and is kept as {aside.name}; "
    for number in range(1, _GENERATIONS + 1):
        generation = generation_path(path, number)
        if generation.exists() and check_file(generation) is None:
            with replacing(path) as temporary:
                temporary.write_bytes(generation.read_bytes())
            text += f"{generation.name} took its place"
            break
    else:
        text += "no sound generation was found, the map begins empty"
        sync(path.parent)
    return text


def _was_ours(path: Path) -> bool:
    """Whether a file that cannot be read was a map: it begins as databases do, or has generations beside it."""
    with path.open("rb") as file:
        head = file.read(len(_SQLITE_HEAD))
    return head == _SQLITE_HEAD or generation_path(path, 1).exists()


def _free_name(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    return aside


def _why_not_written(path: Path, error: Exception) -> str:
    text = str(error)
    if "full" in text or "disk I/O" in text or "No space" in text or "too large" in text.lower():
        repair = "free some space; it is tried again, and what was saved before is untouched"
    elif "readonly" in text or "unable to open" in text:
        repair = f"allow writing to {path.parent}"
    else:
        repair = "it is tried again"
    return f"{path}: not saved: {text}; {repair}"


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise StoreTrouble(f"{path}: cannot be read: {error}; load a generation ({path.name}.1)") from error


def write_occupancy_map(
    patch: GridPatch,
    path: Path,
    *,
    source: str,
    tile_cells: int = 128,
    layers: Mapping[str, Iterable[Tile]] | None = None,
    meta: Mapping[str, Any] | None = None,
) -> Receipt:
    """A new map file made from a finished grid; replaces path whole.

    source: where the grid came from, in words.  layers, meta: more to put into the same snapshot, for instance the
    tiles from which a daemon restores its own grid.
    """
    properties = {"resolution_m": patch.resolution_m, "tile_cells": tile_cells}
    with replacing(path) as temporary:
        try:
            with MapStore.open(temporary, wall_ns=time.time_ns) as store:
                store.snapshot(
                    {**(layers or {}), OCCUPANCY: occupancy_tiles(patch, tile_cells)},
                    {**(meta or {}), OCCUPANCY: properties, "made_from": source},
                )
        finally:
            temporary.with_name(temporary.name + ".lock").unlink(missing_ok=True)
    return receipt_of(path)
