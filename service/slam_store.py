"""What SLAM knows, as tiles of the store's layer `slam`, so that a map goes on where it was left.

    row 0  key scans, 64 a tile: points in millimetres, normals, how good they are; motion between them
    row 1  the graph as it stands: poses, closures, where every kept sweep is drawn
    row 2  kept sweeps and sonar rounds, by number, 128 a tile; of what was given up nothing is left but the gap
    row 3  stored tiles that lie under everything that is drawn again

A tile is a numpy archive of plain arrays (nothing in it can execute), compressed; equal contents give equal bytes.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels.localise_table import EMPTY
from mapping.localise.closure_records import Closure
from mapping.localise.kept_sweeps import KeptSweep
from mapping.localise.slam_records import SlamState
from mapping.localise.views import PackedView, View, ViewStore, table_of
from service.fusion import Cone, Round, Touch
from service.kept_rounds import KeptRound, KeptTouch, Shapes
from service.redraw import Kept, RedrawState
from service.sensors import Switch

F64 = NDArray[np.float64]
Tile = tuple[int, int, bytes]

VERSION = 1
KEYS_A_TILE = 64
KEPT_A_TILE = 128
_KEYS, _GRAPH, _KEPT, _BASE = range(4)
_POINT_M = 1e-3
_PACKING = 1  # zlib's level; every few seconds the newest tiles are packed anew
_PLACE = struct.Struct("<qq")


@dataclass(frozen=True, slots=True)
class Stored:
    """Everything that is kept."""

    slam: SlamState
    redraw: RedrawState


class Keeper:
    """Makes tiles of what changed since it last did."""

    def __init__(self) -> None:
        self._keys = 0
        self._kept: dict[int, tuple[int, ...]] | None = None  # serials in each tile
        self._graph = b""
        self._base: set[tuple[int, int]] | None = None

    def changed_tiles(self, stored: Stored) -> list[Tile]:
        """Tiles that differ from those made last; slow, for the thread that writes."""
        keys, kept = stored.slam.views.count, _by_tile(stored.redraw)
        tiles = [
            (_KEYS, number, _key_tile(stored.slam, number))
            for number in range(self._keys // KEYS_A_TILE, -(-keys // KEYS_A_TILE))
        ] if keys != self._keys else []  # fmt: skip
        place = {serial: k for k, serial in enumerate(stored.redraw.serials.tolist())}
        for number, serials in kept.items():
            if self._kept is None or self._kept.get(number, ()) != serials:
                tiles.append((_KEPT, number, _kept_tile([stored.redraw.kept[place[serial]] for serial in serials])))
        graph = _graph_tile(stored)
        if graph != self._graph:
            tiles.append((_GRAPH, 0, graph))
        if self._base is None or self._base != stored.redraw.base.keys():
            tiles += [
                (_BASE, number, _PLACE.pack(*place) + payload)
                for number, (place, payload) in enumerate(sorted(stored.redraw.base.items()))
            ]
        self._keys, self._kept, self._graph, self._base = keys, kept, graph, set(stored.redraw.base)
        return tiles


def _by_tile(redraw: RedrawState) -> dict[int, tuple[int, ...]]:
    """The serials of each tile that there is or ever was."""
    serials = redraw.serials.tolist()
    tiles: dict[int, list[int]] = {number: [] for number in range(-(-redraw.next_serial // KEPT_A_TILE))}
    for serial in serials:
        tiles[serial // KEPT_A_TILE].append(serial)
    return {number: tuple(each) for number, each in tiles.items()}


def tiles_of(stored: Stored) -> list[Tile]:
    """All of it."""
    return Keeper().changed_tiles(stored)


def stored_of(tiles: Iterable[Tile]) -> Stored | None:
    """What tiles hold; None if there are none. ValueError if they are damaged or of a later version."""
    rows: dict[int, list[bytes]] = {_KEYS: [], _GRAPH: [], _KEPT: [], _BASE: []}
    for row, _, payload in sorted(tiles, key=lambda tile: tile[:2]):
        rows.setdefault(row, []).append(payload)
    if not rows[_GRAPH]:
        return None
    try:
        return _stored_of(rows)
    except (KeyError, TypeError, IndexError, OSError, zipfile.BadZipFile, zlib.error, struct.error) as error:
        raise ValueError(f"stored key scans are damaged: {error}") from error


def _stored_of(rows: Mapping[int, Sequence[bytes]]) -> Stored:
    graph = _unpack(rows[_GRAPH][0])
    if int(graph["version"]) != VERSION:
        raise ValueError(f"key scans stored by a later version ({int(graph['version'])}); this program reads {VERSION}")
    n, m = len(graph["poses"]), len(graph["drawn"])
    keys = [_unpack(payload) for payload in rows[_KEYS]]
    views = ViewStore()
    for tile in keys:
        for k in range(len(tile["stamps"])):
            views.add_packed(_packed_of(tile, k))
    joined = {name: np.concatenate([tile[name] for tile in keys])[:n] for name in ("stamps", "mounts")}
    between = {name: np.concatenate([tile[name] for tile in keys])[1:n] for name in ("path", "information")}
    if len(views) != n:
        raise ValueError(f"{len(views)} stored key scans for {n} poses")
    closures = tuple(
        Closure(int(a), int(b), Pose2(*z.tolist()), w, float(worth), bool(searched), int(number))
        for (a, b, searched, number), z, w, worth in zip(
            graph["closures"], graph["measured"], graph["certainty"], graph["worth"]
        )
    )
    slam = SlamState(
        views.kept(), graph["poses"], graph["travel"], joined["mounts"], joined["stamps"], between["path"],
        between["information"], closures, graph["weight"], int(graph["epoch"]), int(graph["next_number"]),
    )  # fmt: skip
    shapes: Shapes = {}
    kept = [each for payload in rows[_KEPT] if payload for each in _kept_of(_unpack(payload), shapes)]
    if len(kept) != m:
        raise ValueError(f"{len(kept)} stored sweeps for {m} poses")
    base = {_PLACE.unpack_from(payload): payload[_PLACE.size :] for payload in rows[_BASE]}
    serials = graph["serials"] if "serials" in graph else np.arange(m)  # nothing was given up once
    next_serial = int(graph["next_serial"]) if "next_serial" in graph else m
    mounts = _mounts_of(graph, kept, joined["mounts"])
    return Stored(slam, RedrawState(tuple(kept), graph["drawn"], serials, next_serial, base, mounts))


def _mounts_of(graph: Mapping[str, Any], kept: Iterable[Kept], of_keys: F64) -> dict[str, F64]:
    """Where lasers sat when sweeps were kept. Once it was not told; of a single laser its key scans know."""
    if "sensors" in graph:
        return dict(zip(json.loads(graph["sensors"].tobytes()), graph["mounts"]))
    names = {each.sensor for each in kept if isinstance(each, KeptSweep)}
    is_one = len(names) == 1 and len(of_keys) > 0 and bool((of_keys == of_keys[0]).all())
    return dict.fromkeys(names, of_keys[0]) if is_one else {}


# --- key scans and graph


def _key_tile(state: SlamState, number: int) -> bytes:
    """What was given up of the views stands there as nothing: no bins."""
    first, last = number * KEYS_A_TILE, min(state.views.count, (number + 1) * KEYS_A_TILE)
    views = {k: _rounded(each) for k in range(last - first) if (each := state.views.packed(first + k)) is not None}
    bins = max((view.table.bins for view in views.values()), default=0)
    frames = np.zeros((last - first, 4))
    points, normals = (np.zeros((2, last - first, bins), dtype=kind) for kind in (np.int32, np.int16))
    quality = np.full((last - first, bins), EMPTY, dtype=np.float16)
    for k, view in views.items():
        width = view.table.bins
        frames[k] = view.table.frame()
        points[:, k, :width] = _millimetres(view.x), _millimetres(view.y)
        normals[:, k, :width] = np.rint(np.stack((view.nx, view.ny)) * 32767.0)
        quality[k, :width] = view.quality
    keys = slice(first, last)
    path = np.concatenate((np.zeros((1, 3)), state.path))[keys]
    information = np.concatenate((np.zeros((1, 3, 3)), state.information))[keys]
    return _pack(
        stamps=state.stamps[keys],
        mounts=state.base_from_sensor[keys],
        frames=frames,
        points=points,
        normals=normals,
        quality=quality,
        path=path,
        information=information,
    )


def _rounded(packed: PackedView) -> View:
    """A view as it comes back: its normals are those of the points that are kept."""
    x, y = (_metres(_millimetres(each)) for each in (packed.x, packed.y))
    return replace(packed, x=x, y=y).opened()


def _packed_of(tile: Mapping[str, Any], k: int) -> PackedView | None:
    """Its points; normals, which stand there for older programs, follow from them. None: it was given up."""
    table = table_of(tile["frames"][k])
    if not table.bins:
        return None
    x, y = (_metres(row[k, : table.bins]) for row in tile["points"])
    return PackedView(table, x, y, grazed=True)


def _millimetres(points: NDArray[np.float32]) -> NDArray[np.int32]:
    return np.asarray(np.rint(points / _POINT_M), dtype=np.int32)


def _metres(millimetres: NDArray[np.int32]) -> NDArray[np.float32]:
    return np.asarray(millimetres.astype(np.float32) * np.float32(_POINT_M))


def _graph_tile(stored: Stored) -> bytes:
    state, closures = stored.slam, stored.slam.closures
    return _pack(
        version=np.array(VERSION),
        poses=state.poses,
        travel=state.travel_m,
        closures=np.array([(c.start, c.to, c.searched, c.number) for c in closures], dtype=np.int64).reshape(-1, 4),
        measured=np.array([(c.measured.x_m, c.measured.y_m, c.measured.yaw_rad) for c in closures]).reshape(-1, 3),
        certainty=np.array([c.information for c in closures]).reshape(-1, 3, 3),
        worth=np.array([c.worth for c in closures], dtype=np.float64),
        weight=state.weight,
        epoch=np.array(state.epoch),
        next_number=np.array(state.next_number),
        drawn=stored.redraw.drawn,
        serials=stored.redraw.serials,
        next_serial=np.array(stored.redraw.next_serial),
        sensors=np.frombuffer(json.dumps(sorted(stored.redraw.mounts)).encode(), dtype=np.uint8),
        mounts=np.array([stored.redraw.mounts[name] for name in sorted(stored.redraw.mounts)]).reshape(-1, 3),
    )


# --- kept sweeps


def _kept_tile(kept: Sequence[Kept]) -> bytes:
    if not kept:
        return b""
    sweeps = [each for each in kept if isinstance(each, KeptSweep)]
    bearings: list[NDArray[np.float32]] = []
    which: list[int] = []
    for sweep in sweeps:
        known = next((k for k, each in enumerate(bearings) if each is sweep.bearing_rad), None)
        if known is None:
            known = len(bearings)
            bearings.append(sweep.bearing_rad)
        which.append(known)
    about = {
        "order": [isinstance(each, KeptSweep) for each in kept],
        "sensors": [sweep.sensor for sweep in sweeps],
        "rounds": [_round_document(each) for each in kept if not isinstance(each, KeptSweep)],
    }
    return _pack(
        about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        bearing=np.concatenate(bearings) if bearings else np.zeros(0, dtype=np.float32),
        bearing_count=np.array([len(each) for each in bearings], dtype=np.int64),
        which=np.array(which, dtype=np.int64),
        codes=np.concatenate([s.codes for s in sweeps]) if sweeps else np.zeros(0, dtype=np.uint16),
        numbers=np.array([(s.stamp_ns, s.key) for s in sweeps], dtype=np.int64).reshape(-1, 2),
        lengths=np.array([(s.range_min_m, s.range_max_m, s.reach_m) for s in sweeps]).reshape(-1, 3),
        in_key=np.array([s.in_key for s in sweeps]).reshape(-1, 2, 3),
    )


def _kept_of(tile: Mapping[str, Any], shapes: Shapes) -> list[Kept]:
    about = json.loads(tile["about"].tobytes())
    bearings = np.split(tile["bearing"], np.cumsum(tile["bearing_count"])[:-1])
    counts = tile["bearing_count"][tile["which"]]
    codes = np.split(tile["codes"], np.cumsum(counts)[:-1]) if len(counts) else []
    sweeps = iter(
        KeptSweep(sensor, int(stamp), int(key), in_key, bearings[which], each, *map(float, lengths))
        for sensor, (stamp, key), in_key, which, each, lengths in zip(
            about["sensors"], tile["numbers"], tile["in_key"], tile["which"], codes, tile["lengths"]
        )
    )
    rounds = iter(about["rounds"])
    return [next(sweeps) if is_sweep else _round_of(next(rounds), shapes) for is_sweep in about["order"]]


def _round_document(kept: KeptRound | KeptTouch) -> list[Any]:
    heard = kept.heard
    if isinstance(heard, Touch):
        at, switch = heard.switch.base_from_contact, heard.switch
        place = (switch.line, at.x_m, at.y_m, at.yaw_rad, switch.width_m)
        return [kept.sensor, kept.key, kept.in_key.tolist(), heard.stamp_ns, heard.tripped, place]
    cones = [
        (c.channel, c.base_from_transducer.x_m, c.base_from_transducer.y_m, c.base_from_transducer.yaw_rad, c.range_m)
        for c in heard.cones
    ]
    limits = (heard.cone_rad, heard.range_min_m, heard.range_max_m)
    return [kept.sensor, kept.key, kept.in_key.tolist(), heard.stamp_ns, *limits, cones]


def _round_of(document: list[Any], shapes: Shapes) -> KeptRound | KeptTouch:
    if len(document) == 6:
        sensor, key, in_key, stamp_ns, tripped, (line, x, y, yaw, width_m) = document
        touch = Touch(int(stamp_ns), Switch(int(line), Pose2(x, y, yaw), width_m), tripped)
        return KeptTouch(sensor, int(key), np.array(in_key), touch)
    sensor, key, in_key, stamp_ns, cone_rad, range_min_m, range_max_m, cones = document
    heard = tuple(Cone(int(channel), Pose2(x, y, yaw), range_m) for channel, x, y, yaw, range_m in cones)
    told = Round(int(stamp_ns), heard, cone_rad, range_min_m, range_max_m)
    return KeptRound.of(sensor, int(key), np.array(in_key), told, shapes)


def _pack(**arrays: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=_PACKING) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    return out.getvalue()


def _unpack(payload: bytes) -> dict[str, NDArray[Any]]:
    with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
