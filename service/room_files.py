"""Grid maps in, rooms, doors and the Voronoi diagram out: GeoJSON, and a picture (S44)."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapping.grids.patch import GridPatch
from service.export import MapFileTrouble, load_pgm_yaml, patch_of, read_pixels
from service.files import FileTrouble, Receipt, write_whole
from service.room_maker import FREE_BELOW
from service.room_outlines import RoomOutlines

if TYPE_CHECKING:
    from mapping.hybrid.planner import DiagramGraph
    from mapping.hybrid.rooms import RoomMap

ENDINGS = (".geojson", ".json", ".png")
WHITE_FROM = 250
"""In a picture that has no thresholds beside it, such pixels are free."""

U8 = NDArray[np.uint8]
_COLOURS = np.array(
    [(166, 206, 227), (178, 223, 138), (251, 154, 153), (253, 191, 111), (202, 178, 214), (255, 255, 153)],
    dtype=np.uint8,
)
_LONGEST_PX = 2400


@dataclass(frozen=True, slots=True)
class FoundRooms:
    """patch: the map, of which what is free decides.  graph: of the diagram, of the patch with a cell around it; None
    if it was not asked for.  report: figures by name."""

    patch: GridPatch
    found: RoomMap
    graph: DiagramGraph | None
    report: dict[str, object]


def rooms_of_file(path: Path, *, resolution_m: float, with_diagram: bool) -> FoundRooms:
    """Rooms of a map server's map (its .yaml, or the picture beside one), or of a picture alone.

    resolution_m: edge of a pixel where no .yaml tells.  Raises FileTrouble if the file cannot be used.
    """
    from mapping.hybrid.planner import graph_of
    from mapping.hybrid.rooms import find_rooms
    from mapping.hybrid.voronoi import VoronoiGrid

    patch = _patch_of_file(path, resolution_m)
    free = (patch.cells >= 0) & (patch.cells < FREE_BELOW)
    if not free.any():
        raise FileTrouble(f"{path}: no cell of it is free; in a picture without .yaml white is free")
    found = find_rooms(free, patch.resolution_m)
    report: dict[str, object] = {
        "cells": f"{free.shape[1]} x {free.shape[0]} of {patch.resolution_m:g} m",
        "free, m²": round(float(free.sum()) * patch.resolution_m**2, 2),
        "rooms": len(found.rooms),
        "doors": len(found.doors),
    }
    graph = None
    if with_diagram:
        graph = graph_of(VoronoiGrid(np.pad(free, 1)))
        report |= {"nodes": len(graph.node), "edges": len(graph.edge)}
    return FoundRooms(patch, found, graph, report)


def _patch_of_file(path: Path, resolution_m: float) -> GridPatch:
    if path.suffix.lower() in (".yaml", ".yml"):
        return patch_of(load_pgm_yaml(path))
    beside = path.with_suffix(".yaml")
    if beside.is_file():
        return patch_of(load_pgm_yaml(beside))
    if path.suffix.lower() not in (".pgm", ".png"):
        raise MapFileTrouble(f"{path}: a map is a .yaml with its .pgm, a .pgm or a .png")
    brightness, opaque = read_pixels(path)
    white = (np.rint(brightness * 255.0) >= WHITE_FROM) & opaque
    return GridPatch(resolution_m, 0, 0, np.where(white, 0, -1).astype(np.int8)[::-1].copy())


def write_rooms(found: FoundRooms, path: Path) -> Receipt:
    """Write a file in the form that its ending names; whole or not at all. FileTrouble for an unknown ending."""
    match path.suffix.lower():
        case ".geojson" | ".json":
            return write_whole(path, geojson_bytes(found))
        case ".png":
            return write_whole(path, png_bytes(found))
    raise FileTrouble(f"{path}: unknown ending {path.suffix!r} for rooms; there are {', '.join(ENDINGS)}")


def geojson_bytes(found: FoundRooms) -> bytes:
    """A FeatureCollection, a feature a line: rooms (Polygon), doors (LineString), then edges of the diagram."""
    outlines = RoomOutlines().of(found.found, found.patch)
    features: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
            "properties": {
                "kind": "room",
                "room": room.number,
                "area_m2": round(room.area_m2, 3),
                "centre": _metres(found.patch, room.anchor),
                "clearance_m": round(room.clearance_m, 3),
            },
        }
        for room in found.found.rooms
        for ring in [outlines[room.number]]
    ]
    features += [
        {
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": [_metres(found.patch, end) for end in door.ends]},
            "properties": {
                "kind": "door",
                "rooms": [door.a, door.b],
                "critical_point": _metres(found.patch, door.centre),
                "width_m": round(door.width_m, 3),
            },
        }
        for door in found.found.doors
    ]
    if found.graph is not None:
        graph = found.graph
        for e, cells in enumerate(_edge_cells(found)):
            least_m = float(np.sqrt(graph.least_squared[e])) * found.patch.resolution_m
            features.append(
                {
                    "type": "Feature",
                    "geometry": {"type": "LineString", "coordinates": [_metres(found.patch, cell) for cell in cells]},
                    "properties": {
                        "kind": "edge",
                        "nodes": graph.edge[e, :2].tolist(),
                        "length_m": round(float(graph.length[e]) * found.patch.resolution_m, 3),
                        "least_clearance_m": round(least_m, 3),
                    },
                }
            )
    body = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    return f'{{"type": "FeatureCollection", "frame": "map", "unit": "m", "features": [\n{body}\n]}}\n'.encode()


def _edge_cells(found: FoundRooms) -> list[list[tuple[int, int]]]:
    """Cells [row, col] of each edge of the diagram from node to node, in the patch."""
    assert found.graph is not None
    graph, width = found.graph, found.patch.cells.shape[1] + 2
    edges = []
    for a, b, begin, end in graph.edge.tolist():
        cells = [int(graph.node_cell[a]), *graph.chain[begin:end].tolist(), int(graph.node_cell[b])]
        edges.append([(cell // width - 1, cell % width - 1) for cell in cells])
    return edges


def png_bytes(found: FoundRooms) -> bytes:
    """A picture, y up: rooms in colours, obstacles and unknown dark, doors red, the diagram blue."""
    from PIL import Image, ImageDraw

    cells = found.patch.cells
    pixels: U8 = np.full((*cells.shape, 3), 70, dtype=np.uint8)
    pixels[(cells >= 0) & (cells < FREE_BELOW)] = 225
    in_room = found.found.labels > 0
    pixels[in_room] = _COLOURS[found.found.labels[in_room] % len(_COLOURS)]
    pixels[cells > FREE_BELOW] = 20
    if found.graph is not None:
        rows, cols = np.divmod(np.concatenate((found.graph.chain, found.graph.node_cell)), cells.shape[1] + 2)
        pixels[rows - 1, cols - 1] = (40, 70, 180)
    image = Image.fromarray(np.ascontiguousarray(pixels[::-1]))
    pen = ImageDraw.Draw(image)
    top = cells.shape[0] - 1
    for door in found.found.doors:
        pen.line([(col, top - row) for row, col in door.ends], fill=(200, 30, 30), width=3)
    if max(image.size) > _LONGEST_PX:
        image.thumbnail((_LONGEST_PX, _LONGEST_PX))
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()


def _metres(patch: GridPatch, cell: tuple[int, int]) -> list[float]:
    row, col = cell
    x, y = (col + patch.col0 + 0.5) * patch.resolution_m, (row + patch.row0 + 0.5) * patch.resolution_m
    return [round(x, 3) + 0.0, round(y, 3) + 0.0]
