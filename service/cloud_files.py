"""Point clouds as others wrote them: PCD, PLY, XYZ, 3DTK's .3d, and depth images with the camera's calibration.

    .pcd           Point Cloud Library: ascii, binary, binary_compressed (LZF, field after field)
    .ply           ascii, binary little and big endian; the element "vertex"
    .xyz .txt      a point a line, x y z first, blanks or commas between, "#" begins a comment
    .3d            3DTK: as .xyz in centimetres, x right, y up, z forward; given here as metres, x forward, y left, z up
    .png           depth image: 16 bit, 0 is no reading; with a calibration (see `Camera`)

Each also as .gz. Lengths are metres (but .3d, and depth images: 1000 steps a metre). Coordinates are the file's: PCD's
VIEWPOINT and 3DTK's .pose are not applied. A point without reading is NaN, so organised clouds keep their rows.
Sizes are checked before anything is allocated.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from service.files import FileTrouble

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST_POINTS: Final = 50_000_000
MOST_BYTES: Final = 2_000_000_000
_MOST_CALIBRATION_BYTES: Final = 1_000_000
_DEPTH_STEPS_PER_M: Final = 1000.0
_LONGEST_HEADER: Final = 65_536
_UNDISTORT_ROUNDS: Final = 40
_UNDISTORT_PIXELS: Final = 0.1

ENDINGS = (".pcd", ".ply", ".xyz", ".txt", ".3d", ".png")


class CloudTrouble(FileTrouble):
    """A file is not the point cloud it should be; names the file, what is wrong in it, and the repair."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of a file.

    points_m: (N, 3), rows of NaN where nothing was read.  label: (N,) of each point where the file has a field of that
    name.  shape: (rows, columns) of an organised cloud or an image, points row by row; None if there is no such order.
    """

    points_m: F64
    label: I64 | None = None
    shape: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole with the usual lens: x = (u - cx) / fx, distorted by k1 k2 p1 p2 k3 (Brown's model); pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


def read_cloud(path: Path, *, camera: Path | None = None) -> Cloud:
    """The point cloud in a file, its form told by its ending.

    camera: calibration of a depth image; None looks beside it for NAME.calib.xml and NAME.camera.json, NAME with or
    without a number at its end.  Raises CloudTrouble.
    """
    ending = _ending(path)
    if ending == ".png":
        return _read_depth(path, camera)
    data = _bytes_of(path)
    match ending:
        case ".pcd":
            return read_pcd(data, str(path))
        case ".ply":
            return read_ply(data, str(path))
        case ".xyz" | ".txt":
            return Cloud(_text_points(data, str(path)))
        case ".3d":
            p = _text_points(data, str(path))
            return Cloud(np.stack((p[:, 2], -p[:, 0], p[:, 1]), axis=-1) / 100.0)
    raise CloudTrouble(f"{path}: unknown ending {ending!r} for a point cloud; there are {', '.join(ENDINGS)}")


def _ending(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    return Path(name).suffix


def _bytes_of(path: Path, most: int = MOST_BYTES) -> bytes:
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            stream = gzip.GzipFile(fileobj=file) if packed else file
            data = stream.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise CloudTrouble(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > most:
        raise CloudTrouble(f"{path}: holds more than {most} bytes; cut it")
    return data


# ----------------------------------------------------------------------------------------------------------------- PCD


def read_pcd(data: bytes, name: str = "cloud") -> Cloud:
    """A Point Cloud Library file of version .7 (and .5, .6: no VIEWPOINT). Raises CloudTrouble, naming it `name`."""
    header, body = _pcd_header(data, name)
    try:
        fields = header["FIELDS"]
        sizes = [int(v) for v in header["SIZE"]]
        kinds = header["TYPE"]
        counts = [int(v) for v in header.get("COUNT", ["1"] * len(fields))]
        width, height = int(header["WIDTH"][0]), int(header.get("HEIGHT", ["1"])[0])
        number = int(header["POINTS"][0]) if "POINTS" in header else width * height
        form = header["DATA"][0]
    except (KeyError, ValueError, IndexError) as error:
        raise CloudTrouble(f"{name}: its PCD header lacks or garbles {error}") from error
    if not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise CloudTrouble(f"{name}: FIELDS, SIZE, TYPE and COUNT of its PCD header differ in length")
    if not (0 <= number <= MOST_POINTS and width >= 0 and height >= 0 and all(0 < c <= 4096 for c in counts)):
        raise CloudTrouble(f"{name}: its PCD header announces {number} points; at most {MOST_POINTS} are read")
    types = [_pcd_type(kind, size, name) for kind, size in zip(kinds, sizes)]
    columns = _pcd_columns(body, form, types, counts, number, name)
    by_name = dict(zip(fields, columns))
    shape = (height, width) if height > 1 and height * width == number else None
    return _cloud(by_name, shape, name)


def _pcd_header(data: bytes, name: str) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    at = 0
    while at < min(len(data), _LONGEST_HEADER):
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            break
        words = data[at:end].decode("ascii", errors="replace").split()
        at = end + 1
        if not words or words[0].startswith("#"):
            continue
        header[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA":
            return header, data[at:]
    raise CloudTrouble(f"{name}: no PCD header with a DATA line in it")


def _pcd_type(kind: str, size: int, name: str) -> np.dtype[np.generic]:
    known = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
    if size not in known.get(kind, ()):
        raise CloudTrouble(f"{name}: a PCD field of TYPE {kind} and SIZE {size} is not known")
    return np.dtype(f"<{kind.lower()}{size}")


def _pcd_columns(
    body: bytes, form: str, types: Sequence[np.dtype[np.generic]], counts: Sequence[int], number: int, name: str
) -> list[NDArray[np.generic]]:
    """The first value of each field, as columns."""
    if form == "ascii":
        table = _text_table(body, name, sum(counts))
        if len(table) != number:
            raise CloudTrouble(f"{name}: announces {number} points and holds {len(table)}")
        first = np.concatenate(([0], np.cumsum(counts)[:-1])).astype(int)
        return [table[:, k] for k in first]
    if form == "binary":
        row = np.dtype([(f"f{k}", t, (c,)) for k, (t, c) in enumerate(zip(types, counts))])
        _enough(len(body), number * row.itemsize, name)
        points = np.frombuffer(body, dtype=row, count=number)
        return [points[f"f{k}"][:, 0] for k in range(len(types))]
    if form == "binary_compressed":
        _enough(len(body), 8, name)
        packed, unpacked = (int(v) for v in np.frombuffer(body, dtype="<u4", count=2))
        needed = number * sum(t.itemsize * c for t, c in zip(types, counts))
        if unpacked < needed or unpacked > MOST_BYTES:
            raise CloudTrouble(f"{name}: unpacks to {unpacked} bytes where its header asks for {needed}")
        _enough(len(body) - 8, packed, name)
        plain = lzf_unpack(body[8 : 8 + packed], unpacked, name)
        columns, at = [], 0
        for t, c in zip(types, counts):  # all of a field, then all of the next
            columns.append(np.frombuffer(plain, dtype=t, count=number * c, offset=at).reshape(number, c)[:, 0])
            at += number * c * t.itemsize
        return columns
    raise CloudTrouble(f"{name}: PCD DATA {form} is not known; there are ascii, binary, binary_compressed")


def lzf_unpack(packed: bytes, size: int, name: str = "cloud") -> bytes:
    """LibLZF's stream: runs of 1 to 32 literal bytes, or copies of 3 to 264 from up to 8191 bytes back.

    A control byte below 32 announces so many literals and one more; else its upper 3 bits are the length - 2 (7: add
    the next byte), its lower 5 and the byte after them the distance - 1.  Raises CloudTrouble unless `size` comes out.
    """
    out = bytearray()
    at, end = 0, len(packed)
    while at < end and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            if at + control + 1 > end:
                break
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            if at >= end:
                break
            length += packed[at]
            at += 1
        if at >= end:
            break
        back = ((control & 31) << 8) + packed[at] + 1
        at += 1
        start, length = len(out) - back, length + 2
        if start < 0:
            break
        if back >= length:
            out += out[start : start + length]
        else:  # the copy reads what it writes: a pattern of `back` bytes, repeated
            out += (bytes(out[start:]) * (length // back + 1))[:length]
    if at != end or len(out) != size:
        raise CloudTrouble(f"{name}: its compressed data are damaged at byte {at} of {end}")
    return bytes(out)


# ----------------------------------------------------------------------------------------------------------------- PLY

_PLY_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]  # name, numpy type without byte order; "list" for lists


def read_ply(data: bytes, name: str = "cloud") -> Cloud:
    """The vertices of a PLY file of version 1.0. Raises CloudTrouble, naming it `name`."""
    form, elements, body = _ply_header(data, name)
    at = 0
    for element in elements:
        if element.name == "vertex":
            break
        if form == "ascii" or any(kind == "list" for _, kind in element.properties):
            raise CloudTrouble(f"{name}: a PLY file whose vertices come after {element.name!r} is not read")
        at += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties)
    else:
        raise CloudTrouble(f"{name}: has no PLY element called vertex")
    names = [key for key, _ in element.properties]
    if any(kind == "list" for _, kind in element.properties) or len(set(names)) != len(names):
        raise CloudTrouble(f"{name}: PLY vertices with lists or repeated properties are not read")
    if not 0 <= element.count <= MOST_POINTS:
        raise CloudTrouble(f"{name}: announces {element.count} vertices; at most {MOST_POINTS} are read")
    if form == "ascii":
        lines = body.split(b"\n", element.count)[: element.count]
        table = _text_table(b"\n".join(lines), name, len(names))
        if len(table) != element.count:
            raise CloudTrouble(f"{name}: announces {element.count} vertices and holds {len(table)}")
        return _cloud({key: table[:, k] for k, key in enumerate(names)}, None, name)
    order = ">" if form == "binary_big_endian" else "<"
    row = np.dtype([(key, order + kind) for key, kind in element.properties])
    _enough(len(body), at + element.count * row.itemsize, name)
    vertices = np.frombuffer(body, dtype=row, count=element.count, offset=at)
    return _cloud({key: vertices[key] for key in names}, None, name)


def _ply_header(data: bytes, name: str) -> tuple[str, list[_Element], bytes]:
    match = re.search(rb"^end_header[ \t]*\r?\n", data[:_LONGEST_HEADER], re.MULTILINE)
    if not data.startswith(b"ply") or match is None:
        raise CloudTrouble(f"{name}: no PLY header in it")
    form, elements = "", list[_Element]()
    try:
        for line in data[: match.start()].decode("ascii", errors="replace").splitlines():
            words = line.split()
            if not words or words[0] in ("ply", "comment", "obj_info"):
                continue
            if words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append((words[-1], "list"))
            elif words[0] == "property":
                elements[-1].properties.append((words[2], _PLY_TYPES[words[1]]))
            else:
                raise ValueError(line)
    except (ValueError, IndexError, KeyError) as error:
        raise CloudTrouble(f"{name}: its PLY header is garbled: {error}") from error
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise CloudTrouble(f"{name}: PLY format {form!r} is not known")
    return form, elements, data[match.end() :]


# ---------------------------------------------------------------------------------------------------------------- text


def _text_points(data: bytes, name: str) -> F64:
    return _text_table(data, name, 3, more=True)


def _text_table(data: bytes, name: str, columns: int, *, more: bool = False) -> F64:
    """(N, columns) numbers, blanks or commas between; nan is a number. more: further columns may follow."""
    lines = data.replace(b",", b" ").decode("ascii", errors="replace")
    if not any(line.split("#", 1)[0].strip() for line in io.StringIO(lines)):
        return np.empty((0, columns))
    wanted = range(columns) if more else None
    try:
        table = np.loadtxt(io.StringIO(lines), dtype=np.float64, comments="#", usecols=wanted, ndmin=2)
    except ValueError as error:
        raise CloudTrouble(f"{name}: a line of it is no point: {error}") from error
    if table.shape[1] != columns or len(table) > MOST_POINTS:
        raise CloudTrouble(f"{name}: has lines of {table.shape[1]} numbers where {columns} are announced")
    return table


# -------------------------------------------------------------------------------------------------------- depth images


def _read_depth(path: Path, camera: Path | None) -> Cloud:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(_bytes_of(path))) as image:
            if image.mode not in ("I;16", "I;16B", "I"):
                raise CloudTrouble(f"{path}: its pixels are {image.mode}; a depth image has 16 bits, grey")
            depth = np.asarray(image).astype(np.float64)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise CloudTrouble(f"{path}: no picture that can be read: {error}") from error
    found = camera if camera is not None else _calibration_beside(path)
    return depth_cloud(depth / _DEPTH_STEPS_PER_M, read_camera(found))


def _calibration_beside(path: Path) -> Path:
    stem = path.name.removesuffix(path.suffix)
    names = dict.fromkeys((stem, re.sub(r"_?\d+$", "", stem)))
    for name in names:
        for ending in (".camera.json", ".calib.xml"):
            candidate = path.with_name(name + ending)
            if name and candidate.is_file():
                return candidate
    raise CloudTrouble(
        f"{path}: no calibration beside it ({stem}.camera.json or {stem}.calib.xml); name one with --camera"
    )


def depth_cloud(depth_m: F64, camera: Camera) -> Cloud:
    """Points (R * C, 3) of a depth image (R, C) in the camera's frame: x right, y down, z forward; 0 and NaN give NaN.

    depth_m: along z, not along the ray.
    """
    rows, columns = depth_m.shape
    z = np.where(depth_m > 0.0, depth_m, np.nan)
    x, y = _directions(rows, columns, camera)
    points = np.stack((x * z, y * z, z), axis=-1).reshape(-1, 3)
    points[np.isnan(points[:, 0])] = np.nan
    return Cloud(points, None, (rows, columns))


def _directions(rows: int, columns: int, camera: Camera) -> tuple[F64, F64]:
    """x / z and y / z (R, C) of each pixel: Brown's model undone by repeated substitution.

    NaN where that does not settle: outside the part of the image in which the calibration is one to one.
    """
    v, u = np.mgrid[:rows, :columns].astype(np.float64)
    x0, y0 = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    k1, k2, p1, p2, k3 = camera.distortion
    if not any(camera.distortion):
        return x0, y0
    x, y = x0, y0
    reach = 2.0 * float(np.hypot(x0, y0).max(initial=0.0))
    for _ in range(_UNDISTORT_ROUNDS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        off = np.maximum(np.abs(x * radial + dx - x0), np.abs(y * radial + dy - y0))
        x = np.clip((x0 - dx) / np.where(radial > 0.1, radial, 0.1), -reach, reach)
        y = np.clip((y0 - dy) / np.where(radial > 0.1, radial, 0.1), -reach, reach)
    settled = off < _UNDISTORT_PIXELS / max(camera.fx, camera.fy)
    return np.where(settled, x, np.nan), np.where(settled, y, np.nan)


def read_camera(path: Path) -> Camera:
    """A calibration: JSON with "intrinsic_matrix" column by column (Open3D), or OpenCV's XML, where the matrix of the
    IR camera (else the first whose name tells of a camera) and its distortion count. Raises CloudTrouble."""
    data = _bytes_of(path, _MOST_CALIBRATION_BYTES)
    try:
        if path.suffix.lower() == ".json":
            values = [float(v) for v in json.loads(data)["intrinsic_matrix"]]
            camera = Camera(values[0], values[4], values[6], values[7])
        else:
            camera = _opencv_camera(data)
    except (ValueError, KeyError, IndexError, TypeError, ElementTree.ParseError) as error:
        raise CloudTrouble(f"{path}: no camera calibration that is known here: {error}") from error
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not all(math.isfinite(v) for v in numbers) or camera.fx <= 0.0 or camera.fy <= 0.0:
        raise CloudTrouble(f"{path}: its focal lengths must be above 0, all numbers finite")
    return camera


def _opencv_camera(data: bytes) -> Camera:
    if b"<!" in data.replace(b"<!--", b""):
        raise ValueError("document types and entities are refused")
    matrices = {node.tag: node for node in ElementTree.fromstring(data) if node.find("data") is not None}
    intrinsic = [tag for tag in matrices if re.search("intrinsic|camera", tag, re.IGNORECASE)]
    lens = [tag for tag in matrices if re.search("distortion", tag, re.IGNORECASE)]
    m = _numbers(matrices[_infrared_first(intrinsic)], 9)
    k = _numbers(matrices[_infrared_first(lens)], 5) if lens else [0.0] * 5
    return Camera(m[0], m[4], m[2], m[5], (k[0], k[1], k[2], k[3], k[4]))


def _infrared_first(tags: Sequence[str]) -> str:
    return sorted(tags, key=lambda tag: not tag.upper().startswith("IR"))[0]


def _numbers(node: ElementTree.Element, count: int) -> list[float]:
    values = [float(v) for v in (node.findtext("data") or "").split()]
    if len(values) < count:
        raise ValueError(f"{node.tag} holds {len(values)} numbers, not {count}")
    return values


# -------------------------------------------------------------------------------------------------------------- common


def _enough(there: int, needed: int, name: str) -> None:
    if there < needed:
        raise CloudTrouble(f"{name}: ends early: {there} bytes of {needed}; copy it again")


def _cloud(columns: dict[str, NDArray[np.generic]], shape: tuple[int, int] | None, name: str) -> Cloud:
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise CloudTrouble(f"{name}: has no field {', '.join(missing)}")
    points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    points[~np.all(np.isfinite(points), axis=1)] = np.nan
    label = columns["label"].astype(np.int64) if "label" in columns else None
    return Cloud(points, label, shape)
