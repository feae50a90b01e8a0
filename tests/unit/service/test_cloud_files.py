"""Point clouds of others' making: every form, put together here by hand, and every way of being broken."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from service.cloud_files import (
    Camera,
    CloudTrouble,
    depth_cloud,
    lzf_unpack,
    read_camera,
    read_cloud,
    read_pcd,
    read_ply,
)

F64 = NDArray[np.float64]
DATA = os.environ.get("UMFELD_DATA", "")
POINTS = np.array([[0.5, -1.25, 2.0], [3.0, 0.0, -0.125], [np.nan, np.nan, np.nan], [1.0, 2.0, 4.0]])
LABELS = np.array([1, 2, 0, 20])


def pcd(
    form: str, body: bytes, *, points: int = 4, width: int = 2, height: int = 2, fields: str = "x y z label"
) -> bytes:
    names = fields.split()
    kinds = ["U" if name == "label" else "F" for name in names]
    lines = [
        "# .PCD v0.7", "VERSION 0.7", f"FIELDS {fields}", "SIZE" + " 4" * len(names), "TYPE " + " ".join(kinds),
        "COUNT" + " 1" * len(names), f"WIDTH {width}", f"HEIGHT {height}", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}", f"DATA {form}", "",
    ]  # fmt: skip
    return "\n".join(lines).encode() + body


def rows() -> bytes:
    return b"".join(struct.pack("<fffI", *p, k) for p, k in zip(POINTS, LABELS))


def columns() -> bytes:
    return POINTS.T.astype("<f4").tobytes() + LABELS.astype("<u4").tobytes()


def lzf_pack(plain: bytes) -> bytes:
    """A slow and simple compressor: the longest match anywhere in reach, else a literal of its own."""
    out, at = bytearray(), 0
    while at < len(plain):
        best, back = 0, 0
        for start in range(max(0, at - 8192), at):
            length = 0
            while length < 264 and at + length < len(plain) and plain[start + length] == plain[at + length]:
                length += 1
            if length > best:
                best, back = length, at - start
        if best >= 3:
            code, distance = best - 2, back - 1
            out.append((min(code, 7) << 5) | (distance >> 8))
            if code >= 7:
                out.append(code - 7)
            out.append(distance & 255)
            at += best
        else:
            out += bytes([0, plain[at]])
            at += 1
    return bytes(out)


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_the_three_forms_of_pcd_say_the_same(form: str) -> None:
    packed = lzf_pack(columns())
    body = {
        "ascii": "\n".join(" ".join(map(str, [*p, k])) for p, k in zip(POINTS, LABELS)).encode(),
        "binary": rows(),
        "binary_compressed": struct.pack("<II", len(packed), len(columns())) + packed,
    }[form]
    cloud = read_pcd(pcd(form, body))
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    assert cloud.label is not None
    np.testing.assert_array_equal(cloud.label, LABELS)
    assert cloud.shape == (2, 2)


def test_pcd_fields_of_other_sizes_and_padding() -> None:
    header = (
        b"VERSION .7\nFIELDS _ x y _ z\nSIZE 1 8 8 2 8\nTYPE U F F I F\nCOUNT 3 1 1 2 1\n"
        b"WIDTH 2\nHEIGHT 1\nDATA binary\n"
    )
    body = b"".join(struct.pack("<3sddhhd", b"abc", x, y, 7, 8, z) for x, y, z in POINTS[:2])
    cloud = read_pcd(header + body)
    np.testing.assert_array_equal(cloud.points_m, POINTS[:2])
    assert cloud.label is None
    assert cloud.shape is None


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_the_three_forms_of_ply_say_the_same(form: str) -> None:
    before = "" if form == "ascii" else "element camera 1\nproperty double f\n"
    header = (
        f"ply\nformat {form} 1.0\ncomment made by hand\n{before}element vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nproperty uchar red\nproperty int label\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if form == "ascii":
        body = "".join(f"{p[0]} {p[1]} {p[2]} 255 {k}\n" for p, k in zip(POINTS, LABELS)).encode() + b"3 0 1 2\n"
    else:
        order = "<" if form == "binary_little_endian" else ">"
        body = struct.pack(order + "d", 1.5)
        body += b"".join(struct.pack(order + "fffBi", *p, 255, k) for p, k in zip(POINTS, LABELS)) + b"\x03rest"
    cloud = read_ply(header.encode() + body)
    np.testing.assert_array_equal(cloud.points_m, POINTS)
    assert cloud.label is not None
    np.testing.assert_array_equal(cloud.label, LABELS)


def test_text_clouds_and_their_axes(tmp_path: Path) -> None:
    plain = tmp_path / "a.xyz"
    plain.write_text("# x y z intensity\n0.5,-1.25, 2.0, 17\n3.0 0.0 -0.125 18\n\n")
    np.testing.assert_array_equal(read_cloud(plain).points_m, POINTS[:2])
    turned = tmp_path / "scan000.3d.gz"
    turned.write_bytes(gzip.compress(b"100 200 300\n"))  # cm: right, up, forward
    np.testing.assert_allclose(read_cloud(turned).points_m, [[3.0, -1.0, 2.0]])
    empty = tmp_path / "b.xyz"
    empty.write_text("# nothing\n")
    assert read_cloud(empty).points_m.shape == (0, 3)


def depth_png(path: Path, depth_mm: NDArray[np.uint16]) -> None:
    Image.fromarray(depth_mm).save(path)


def test_a_depth_image_by_the_pinhole(tmp_path: Path) -> None:
    depth = np.array([[0, 1500, 2000], [1000, 1000, 65535]], dtype=np.uint16)
    depth_png(tmp_path / "room_12.png", depth)
    matrix = [500.0, 0, 0, 0, 400.0, 0, 1.0, 0.5, 1]
    (tmp_path / "room.camera.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    cloud = read_cloud(tmp_path / "room_12.png")
    assert cloud.shape == (2, 3)
    for row in range(2):
        for column in range(3):
            z = depth[row, column] / 1000.0
            expected = [(column - 1.0) / 500.0 * z, (row - 0.5) / 400.0 * z, z] if z else [np.nan] * 3
            np.testing.assert_allclose(cloud.points_m[row * 3 + column], expected, rtol=1e-12)


def test_the_lens_is_undone(tmp_path: Path) -> None:
    """Points projected by Brown's model, as it is written down, come back from the pixels they fall on."""
    k1, k2, p1, p2, k3 = lens = (-0.25, 0.07, 0.001, -0.002, 0.01)
    camera = Camera(300.0, 310.0, 160.0, 120.0, lens)
    cloud = depth_cloud(np.full((240, 320), 2.0), camera)
    x, y = cloud.points_m[:, 0] / 2.0, cloud.points_m[:, 1] / 2.0
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = camera.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + camera.cx
    v = camera.fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + camera.cy
    row, column = np.mgrid[:240, :320]
    assert np.isfinite(u).mean() > 0.99
    np.testing.assert_allclose(u[np.isfinite(u)], column.ravel()[np.isfinite(u)], atol=0.1)
    np.testing.assert_allclose(v[np.isfinite(v)], row.ravel()[np.isfinite(v)], atol=0.1)


def test_opencv_calibrations_prefer_the_infrared_camera(tmp_path: Path) -> None:
    def matrix(tag: str, values: str) -> str:
        return f'<{tag} type_id="opencv-matrix"><rows>3</rows><data>{values}</data></{tag}>'

    text = matrix("RGB_intrinsic", "1 0 2 0 3 4 0 0 1") + matrix("IR_intrinsic", "5 0 6 0 7 8\n 0 0 1")
    path = tmp_path / "c.xml"
    path.write_text(f"<opencv_storage>{text}{matrix('IR_distortion', '0.1 0.2 0 0 0.3')}</opencv_storage>")
    assert read_camera(path) == Camera(5.0, 7.0, 6.0, 8.0, (0.1, 0.2, 0.0, 0.0, 0.3))
    path.write_text('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>')
    with pytest.raises(CloudTrouble, match="entities"):
        read_camera(path)


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.pcd", b"", "no PCD header"),
        ("a.pcd", pcd("binary", rows()[:-1]), "ends early"),
        ("a.pcd", pcd("binary", rows(), points=10**15), "announces"),
        ("a.pcd", pcd("ascii", b"1 2 3 4\n"), "announces 4 points and holds 1"),
        ("a.pcd", pcd("ascii", b"1 2 three 4\n" * 4), "no point"),
        ("a.pcd", pcd("binary_compressed", struct.pack("<II", 2, 64) + b"\x20\x05"), "damaged"),
        ("a.pcd", pcd("binary_compressed", struct.pack("<II", 2, 10) + b"\x20\x05"), "unpacks to 10"),
        ("a.pcd", pcd("lzma", rows()), "not known"),
        ("a.pcd", pcd("binary", rows(), fields="x y w label"), "no field z"),
        ("a.ply", b"plo\n", "no PLY header"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "garbled"),
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "no PLY element"),
        ("a.xyz", b"1 2\n", "no point"),
        ("a.xyz.gz", b"\x1f\x8bnonsense", "cannot be read"),
        ("a.las", b"LASF", "unknown ending"),
        ("a.png", b"\x89PNG", "no picture"),
    ],
)
def test_what_is_broken_is_named(tmp_path: Path, name: str, data: bytes, says: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(CloudTrouble, match=says) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)


def test_a_depth_image_needs_a_calibration(tmp_path: Path) -> None:
    depth_png(tmp_path / "a.png", np.ones((2, 2), dtype=np.uint16))
    with pytest.raises(CloudTrouble, match="--camera"):
        read_cloud(tmp_path / "a.png")
    with pytest.raises(CloudTrouble, match="cannot be read"):
        read_cloud(tmp_path / "missing.pcd")


@given(st.binary(max_size=400))
def test_lzf_comes_back(plain: bytes) -> None:
    assert lzf_unpack(lzf_pack(plain), len(plain)) == plain


@given(st.lists(st.sampled_from([b"ab", b"abcabc", b"\x00" * 40, bytes(range(40))]), max_size=12))
def test_lzf_comes_back_where_there_is_much_to_copy(parts: list[bytes]) -> None:
    plain = b"".join(parts)
    assert lzf_unpack(lzf_pack(plain), len(plain)) == plain


@settings(max_examples=200)
@given(st.binary(max_size=80), st.integers(0, 200), st.sampled_from(["pcd", "ply"]))
def test_damaged_bytes_are_refused_or_read_never_worse(noise: bytes, at: int, form: str) -> None:
    if form == "pcd":
        packed = b"\x1f" + columns()[:32] + b"\x1f" + columns()[32:]
        data, read = pcd("binary_compressed", struct.pack("<II", len(packed), 64) + packed), read_pcd
    else:
        axes = b"".join(b"property float %c\n" % axis for axis in b"xyz")
        header = b"ply\nformat binary_big_endian 1.0\nelement vertex 2\n" + axes + b"end_header\n"
        data, read = header + bytes(24), read_ply
    broken = data[:at] + noise + data[at + len(noise) :]
    try:
        cloud = read(broken)
    except CloudTrouble:
        return
    assert cloud.points_m.ndim == 2
    assert cloud.points_m.shape[1] == 3


@pytest.mark.data
@pytest.mark.skipif(not DATA, reason="UMFELD_DATA is not set")
@pytest.mark.parametrize(
    ("name", "points", "read"),
    [
        ("point_clouds/synpeb_100x100.pcd.gz", 10_000, 10_000),
        ("point_clouds/table_learn13.pcd.gz", 76_800, 51_892),
        ("point_clouds/room_scan1.pcd", 112_586, 112_586),
        ("point_clouds/rotating_sick_scan000.3d.gz", 81_360, 81_360),
        ("point_clouds/indoor_pair_0.xyz.gz", 36_674, 36_674),
        ("depth_images/living_room_0.png", 307_200, 267_129),
    ],
)
def test_recorded_clouds(name: str, points: int, read: int) -> None:
    cloud = read_cloud(Path(DATA) / name)
    assert cloud.points_m.shape == (points, 3)
    assert int(np.isfinite(cloud.points_m).all(axis=1).sum()) == read


def test_reading_needs_no_compiled_kernels() -> None:
    import subprocess
    import sys

    program = "import sys, service.cloud_files; print([m for m in ('numba', 'scipy', 'shapely') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert io.StringIO(out.stdout).readline().strip() == "[]"
