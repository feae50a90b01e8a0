"""Lines as files: GeoJSON, SVG, DXF, and a picture.

GeoJSON has a feature a line, from start to end (free space to the right), with what is known of it. Coordinates are
metres of the map frame, named in the foreign member "frame"; with an anchor they are longitude and latitude, as the
standard (RFC 7946) wants them. SVG and DXF are in metres, y up. Numbers are rounded to a tenth of a millimetre.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.geo import Anchor
from mapping.lines.line_map import rows_of_ends
from mapping.lines.lines import Lines
from service.errors import Trouble
from service.files import FileTrouble, Receipt, write_whole

F64 = NDArray[np.float64]

ENDINGS = (".geojson", ".json", ".svg", ".dxf", ".png")
_MARGIN_M = 0.5


def write_lines(lines: Lines, path: Path, *, frame: str = "map", anchor: Anchor | None = None) -> Receipt:
    """Write a file in the form that its ending names; whole or not at all. FileTrouble for an unknown ending."""
    match path.suffix.lower():
        case ".geojson" | ".json":
            return write_whole(path, geojson_bytes(lines, frame=frame, anchor=anchor))
        case ".svg":
            return write_whole(path, svg_bytes(lines))
        case ".dxf":
            return write_whole(path, dxf_bytes(lines))
        case ".png":
            return write_whole(path, png_bytes(lines))
    raise FileTrouble(f"{path}: unknown ending {path.suffix!r} for lines; there are {', '.join(ENDINGS)}")


def line_properties(lines: Lines) -> list[dict[str, float | int]]:
    """What is known of each line beside its ends: SI units; sigma: standard deviations of angle and distance."""
    angle, distance, covariance = lines.parameters()
    columns = (
        ("length_m", lines.length_m, 4),
        ("angle_rad", angle, 6),
        ("distance_m", distance, 4),
        ("sigma_angle_rad", np.sqrt(covariance[:, 0, 0]), 7),
        ("sigma_distance_m", np.sqrt(np.maximum(covariance[:, 1, 1], 0.0)), 6),
        ("rms_m", lines.rms_m, 5),
    )
    rounded = {name: [round(float(v), digits) for v in values] for name, values, digits in columns}
    whole = {"points": lines.count.tolist(), "scans": lines.seen.tolist()}
    table = {**rounded, **whole}
    return [{name: values[k] for name, values in table.items()} for k in range(len(lines))]


def geojson_bytes(lines: Lines, *, frame: str = "map", anchor: Anchor | None = None) -> bytes:
    """A FeatureCollection of LineStrings, a feature a line of text."""
    start, end, digits = lines.start_m, lines.end_m, 4
    if anchor is not None:
        start, end, digits = _lon_lat(anchor, start), _lon_lat(anchor, end), 9
    features = [
        {
            "type": "Feature",
            "id": k,
            "geometry": {"type": "LineString", "coordinates": [_rounded(a, digits), _rounded(b, digits)]},
            "properties": properties,
        }
        for k, (a, b, properties) in enumerate(zip(start, end, line_properties(lines)))
    ]
    head = '{"type": "FeatureCollection"'
    if anchor is None:
        head += f', "frame": {json.dumps(frame)}, "unit": "m"'
    body = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    return f'{head}, "features": [\n{body}\n]}}\n'.encode()


def lines_of_geojson(data: bytes) -> Lines:
    """The lines of a file that geojson_bytes wrote in metres; points are taken as spread evenly between the ends.

    Raises FileTrouble if it is something else.
    """
    try:
        document = json.loads(data)
        if document.get("unit") != "m":
            raise ValueError("its coordinates are not metres of a map frame")
        ends, known = [], []
        for feature in document["features"]:
            (x0, y0), (x1, y1) = feature["geometry"]["coordinates"]
            ends.append([float(x0), float(y0), float(x1), float(y1)])
            properties: Mapping[str, Any] = feature["properties"]
            known.append([float(properties["points"]), float(properties["scans"]), float(properties["rms_m"])])
        table, facts = np.array(ends).reshape(-1, 4), np.array(known).reshape(-1, 3)
        if not (np.all(np.isfinite(table)) and np.all(np.isfinite(facts)) and np.all(facts >= 0.0)):
            raise ValueError("a number in it is not finite, or below 0")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileTrouble(f"not a line map in GeoJSON: {error}") from error
    rows = rows_of_ends(table[:, :2], table[:, 2:], facts[:, 0], facts[:, 1], np.maximum(facts[:, 2], 1e-4))
    return Lines(rows, np.full((len(rows), 2), -1, dtype=np.int64))


def svg_bytes(lines: Lines) -> bytes:
    """A drawing in metres, y up: 1 user unit is 1 m, its size on paper 1:100."""
    x0, y0, x1, y1 = _extent(lines)
    width, height = x1 - x0, y1 - y0
    strokes = "\n".join(
        f'<line x1="{a[0]:.4f}" y1="{a[1]:.4f}" x2="{b[0]:.4f}" y2="{b[1]:.4f}"/>'
        for a, b in zip(lines.start_m, lines.end_m)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{10 * width:.2f}mm" height="{10 * height:.2f}mm" '
        f'viewBox="{x0:.4f} {-y1:.4f} {width:.4f} {height:.4f}">\n'
        '<g transform="scale(1,-1)" stroke="black" stroke-width="0.03" stroke-linecap="round">\n'
        f"{strokes}\n</g>\n</svg>\n"
    ).encode()


def dxf_bytes(lines: Lines) -> bytes:
    """A drawing for CAD: LINE entities in metres on the layer "lines". Trouble if ezdxf is not installed."""
    try:
        from ezdxf import units
        from ezdxf.filemanagement import new
    except ImportError as error:
        raise Trouble("DXF needs the package ezdxf: pip install 'umfeld[cad]'") from error
    drawing = new("R2010")
    drawing.units = units.M
    drawing.layers.add("lines")
    space = drawing.modelspace()
    for a, b in zip(lines.start_m, lines.end_m):
        space.add_line(_rounded(a, 4), _rounded(b, 4), dxfattribs={"layer": "lines"})
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue().encode(drawing.output_encoding)


def png_bytes(lines: Lines, *, longest_px: int = 1200) -> bytes:
    """A picture, black on white, y up, with a bar of 1, 5 or 20 metres."""
    from PIL import Image, ImageDraw

    x0, y0, x1, y1 = _extent(lines)
    scale = longest_px / max(x1 - x0, y1 - y0)
    fine = 3  # drawn larger and shrunk, so that slanted lines are smooth
    size = (max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale)))
    image = Image.new("L", (size[0] * fine, size[1] * fine), 255)
    pen = ImageDraw.Draw(image)
    for a, b in zip(lines.start_m, lines.end_m):
        ends = [((p[0] - x0) * scale * fine, (y1 - p[1]) * scale * fine) for p in (a, b)]
        pen.line(ends, fill=0, width=2 * fine)
    bar_m = next((m for m in (20.0, 5.0, 1.0) if m < 0.4 * (x1 - x0)), 1.0)
    at = (12 * fine, (size[1] - 12) * fine)
    pen.line([at, (at[0] + bar_m * scale * fine, at[1])], fill=128, width=3 * fine)
    pen.text((at[0], at[1] - 16 * fine), f"{bar_m:g} m", fill=96, font_size=12 * fine)
    out = io.BytesIO()
    image.resize(size, Image.Resampling.LANCZOS).save(out, "PNG")
    return out.getvalue()


def _extent(lines: Lines) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 around all lines, with a margin; a square of 1 m if there are none."""
    if not len(lines):
        return (-0.5, -0.5, 0.5, 0.5)
    ends = np.concatenate((lines.start_m, lines.end_m))
    low, high = ends.min(axis=0) - _MARGIN_M, ends.max(axis=0) + _MARGIN_M
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _rounded(point: Sequence[float] | F64, digits: int) -> list[float]:
    """Numbers as they are written; never -0.0."""
    return [round(float(v), digits) + 0.0 for v in point]


def _lon_lat(anchor: Anchor, points: F64) -> F64:
    if not len(points):
        return points
    geodetic = anchor.geodetic_from_map(points)
    longitude = (geodetic[:, 1] + 180.0) % 360.0 - 180.0
    return np.stack((longitude, geodetic[:, 0]), axis=-1)
