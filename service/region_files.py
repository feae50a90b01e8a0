"""Floor plans in, regions and passages out: GeoJSON, and a picture (S41).

A plan is GeoJSON: Polygons and MultiPolygons are rooms, their holes and those with the property kind = "obstacle" are
not free. Or it is a line map as `umfeld extract lines` writes it: its closed outlines are the rooms and obstacles.
Coordinates are metres of a plane, not longitude and latitude.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.files import FileTrouble, Receipt, write_whole

if TYPE_CHECKING:
    import networkx as nx
    from shapely.geometry import MultiPolygon

    from mapping.topology.regions import RegionMap

ENDINGS = (".geojson", ".json", ".png")
_SIZE_MAX = 64 << 20
_COLOURS = ((166, 206, 227), (178, 223, 138), (251, 154, 153), (253, 191, 111), (202, 178, 214), (255, 255, 153))


@dataclass(frozen=True, slots=True)
class FoundRegions:
    """free: the plan's free space.  rooms: see mapping.topology.regions.room_graph.  report: figures by name."""

    free: MultiPolygon
    regions: RegionMap
    rooms: nx.Graph[int]
    report: dict[str, object]


def regions_of_file(path: Path, *, simplify_m: float, door_m: float) -> FoundRegions:
    """Decompose the plan in a file. FileTrouble if it cannot be read, or holds no plan."""
    from mapping.topology.regions import decompose, decomposition_tree, room_graph

    try:
        if path.stat().st_size > _SIZE_MAX:
            raise FileTrouble(f"{path}: larger than {_SIZE_MAX >> 20} MB: no floor plan")
        data = path.read_bytes()
    except OSError as error:
        raise FileTrouble(f"{path}: {error.strerror}") from error
    try:
        free = free_space_of(data)
        regions = decompose(free, simplify_m=simplify_m)
        rooms = room_graph(regions, door_m=door_m)
    except ValueError as error:
        raise FileTrouble(f"{path}: {error}") from error
    tree = decomposition_tree(regions.graph())
    report: dict[str, object] = {
        "free space, m²": round(free.area, 3),
        "regions": len(regions.regions),
        "passages": len(regions.passages),
        "subgraphs": len(tree.subgraphs),
        "single connections": len(tree.joints),
        "rooms": rooms.number_of_nodes(),
        "doors": rooms.number_of_edges(),
    }
    return FoundRegions(free, regions, rooms, report)


def free_space_of(data: bytes) -> MultiPolygon:
    """The free space of a plan in GeoJSON. ValueError says what is wrong with it."""
    from mapping.topology.regions import floor_plan

    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not GeoJSON: {error}") from error
    shapes = list(_shapes(document))
    if any(geometry.get("type") == "LineString" for geometry, _ in shapes):
        return _of_line_map(data)
    rooms: list[Any] = []
    obstacles: list[Any] = []
    for geometry, properties in shapes:
        for outer, *holes in _polygons(geometry):
            (obstacles if properties.get("kind") == "obstacle" else rooms).append(outer)
            obstacles += holes
    if not rooms:
        raise ValueError("no polygon in it that is a room")
    return floor_plan([_plane(ring) for ring in rooms], [_plane(ring) for ring in obstacles])


def write_regions(found: FoundRegions, path: Path) -> Receipt:
    """Write a file in the form that its ending names; whole or not at all. FileTrouble for an unknown ending."""
    match path.suffix.lower():
        case ".geojson" | ".json":
            return write_whole(path, geojson_bytes(found))
        case ".png":
            return write_whole(path, png_bytes(found))
    raise FileTrouble(f"{path}: unknown ending {path.suffix!r} for regions; there are {', '.join(ENDINGS)}")


def geojson_bytes(found: FoundRegions) -> bytes:
    """A FeatureCollection, a feature a line of text: regions (Polygon), then passages (LineString)."""
    room_of = {number: room for room, facts in found.rooms.nodes(data=True) for number in facts["regions"]}
    features = [
        {
            "type": "Feature",
            "geometry": {
                "type": "Polygon",
                "coordinates": [[_rounded(p) for p in (*region.corners_m, region.corners_m[0])]],
            },
            "properties": {
                "kind": "region",
                "region": region.number,
                "room": room_of[region.number],
                "area_m2": round(region.area_m2, 4),
                "centre": _rounded(region.centre_m),
            },
        }
        for region in found.regions.regions
    ]
    features += [
        {
            "type": "Feature",
            "geometry": {"type": "LineString", "coordinates": [_rounded(p) for p in passage.ends_m]},
            "properties": {
                "kind": "passage",
                "regions": [passage.a, passage.b],
                "rooms": [room_of[passage.a], room_of[passage.b]],
                "width_m": round(passage.width_m, 4),
            },
        }
        for passage in found.regions.passages
    ]
    body = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    return f'{{"type": "FeatureCollection", "frame": "map", "unit": "m", "features": [\n{body}\n]}}\n'.encode()


def png_bytes(found: FoundRegions, *, longest_px: int = 1200) -> bytes:
    """A picture, y up: rooms in colours, region borders grey, doors red, the region graph blue."""
    from PIL import Image, ImageDraw

    x0, y0, x1, y1 = (float(v) for v in found.free.buffer(0.5).bounds)
    scale = longest_px / max(x1 - x0, y1 - y0)
    size = (max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale)))
    image = Image.new("RGB", size, (70, 70, 70))
    pen = ImageDraw.Draw(image)

    def at(point: Any) -> tuple[float, float]:
        return ((float(point[0]) - x0) * scale, (y1 - float(point[1])) * scale)

    room_of = {number: room for room, facts in found.rooms.nodes(data=True) for number in facts["regions"]}
    for region in found.regions.regions:
        colour = _COLOURS[room_of[region.number] % len(_COLOURS)]
        pen.polygon([at(p) for p in region.corners_m], fill=colour)
    for passage in found.regions.passages:
        is_door = room_of[passage.a] != room_of[passage.b]
        pen.line([at(p) for p in passage.ends_m], fill=(200, 30, 30) if is_door else (150, 150, 150), width=3)
    for passage in found.regions.passages:
        ends = (found.regions.regions[number].centre_m for number in (passage.a, passage.b))
        a, b = ends
        pen.line([at(a), at(passage.ends_m.mean(axis=0)), at(b)], fill=(40, 70, 180), width=2)
    for region in found.regions.regions:
        x, y = at(region.centre_m)
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=(40, 70, 180))
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()


def _shapes(document: Any) -> Iterable[tuple[dict[str, Any], dict[str, Any]]]:
    """Geometries with their properties, of whatever GeoJSON object it is."""
    match document:
        case {"type": "FeatureCollection", "features": list(features)}:
            for feature in features:
                yield from _shapes(feature)
        case {"type": "Feature", "geometry": dict(geometry)}:
            properties = document.get("properties")
            yield geometry, properties if isinstance(properties, dict) else {}
        case {"type": str(), "coordinates": _}:
            yield document, {}
        case _:
            raise ValueError("not GeoJSON with polygons or lines in it")


def _polygons(geometry: dict[str, Any]) -> list[list[Any]]:
    match geometry:
        case {"type": "Polygon", "coordinates": [_, *_] as rings}:
            return [list(rings)]
        case {"type": "MultiPolygon", "coordinates": list(polygons)} if all(
            isinstance(rings, list) and rings for rings in polygons
        ):
            return polygons
    raise ValueError(f"a {geometry.get('type')} is no part of a floor plan")


def _plane(ring: Any) -> list[tuple[float, float]]:
    try:
        return [(float(point[0]), float(point[1])) for point in ring]
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise ValueError(f"coordinates are pairs of numbers: {error}") from error


def _of_line_map(data: bytes) -> MultiPolygon:
    from mapping.lines.outlines import OutlineKind, outlines
    from mapping.topology.regions import floor_plan
    from service.line_files import lines_of_geojson

    closed = outlines(lines_of_geojson(data))
    rooms = [outline.points_m for outline in closed if outline.kind is OutlineKind.ROOM]
    if not rooms:
        raise ValueError("its lines close no room; draw the plan as polygons")
    return floor_plan(rooms, [outline.points_m for outline in closed if outline.kind is OutlineKind.OBSTACLE])


def _rounded(point: Any) -> list[float]:
    return [round(float(value), 4) + 0.0 for value in point]
