"""Planes of any cloud: turned, moved, damaged; eigenvectors against numpy's; outlines."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from mapping.kernels import planes as kernels
from mapping.planes.extract import PlaneRules, extract_planes

F64 = NDArray[np.float64]
COORDINATE = st.one_of(st.floats(-20.0, 20.0), st.sampled_from([0.0, 0.2, -0.2, np.nan, np.inf, 1e30, 9e3]))


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 80), st.just(3)), elements=COORDINATE), st.booleans(), st.booleans()
)
def test_any_cloud_gives_planes_that_hold_together(points: F64, repeated: bool, book: bool) -> None:
    cloud = np.concatenate([points] * 4) if repeated else points
    rules = (PlaneRules.book if book else PlaneRules)(min_points=3, min_cells=1)
    planes = extract_planes(cloud, rules)
    assert planes.label.shape == (len(cloud),)
    assert planes.count.tolist() == [int(np.sum(planes.label == k)) for k in range(len(planes))]
    usable = np.isfinite(cloud).all(axis=1)
    assert np.all(planes.label[~usable] == -1)
    if len(planes):
        np.testing.assert_allclose(np.linalg.norm(planes.normal, axis=1), 1.0, atol=1e-9)
        assert np.all(planes.distance_m >= 0.0)
        assert all(len(corners) >= 1 for corners in planes.polygon)


@settings(deadline=None)
@given(hnp.arrays(np.float64, (12, 3), elements=st.floats(-5.0, 5.0)), st.floats(1e-6, 1e3))
def test_the_eigenvector_is_numpys(points: F64, scale: float) -> None:
    row = np.zeros(kernels.ROW)
    x, y, z = (points * scale).T.copy()
    kernels.scatter_of(x, y, z, np.ones(12), 0, 12, 0.0, 0.0, 0.0, 0.0, 1.0, row)
    small, middle, large = kernels.fit_plane(row)
    centred = points * scale - (points * scale).mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred)
    rounding = 1e-14 * scale**2 * float(np.sum(points**2))  # of coordinates that differ by little
    np.testing.assert_allclose([small, middle, large], np.maximum(values, 0.0), atol=1e-9 * float(values[2]) + rounding)
    if values[1] - values[0] > 1e-6 * values[2] + 1e6 * rounding:
        normal = row[kernels.NX : kernels.NZ + 1]
        assert abs(float(normal @ vectors[:, 0])) > 1.0 - 1e-6


@settings(max_examples=25, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(0.6, 6.0), st.integers(0, 2**31 - 1), st.floats(0.0, 0.01))
def test_a_plane_anywhere_is_found_where_it_is(
    yaw: float, pitch: float, distance: float, seed: int, sigma: float
) -> None:
    normal = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    u = np.cross(normal, (0.0, 0.0, 1.0) if abs(normal[2]) < 0.9 else (1.0, 0.0, 0.0))
    u /= np.linalg.norm(u)
    random = np.random.default_rng(seed)
    s, t = random.uniform(-1.0, 1.0, (2, 3000, 1))
    points = distance * normal + s * u + t * np.cross(normal, u) + random.normal(0.0, sigma, (3000, 1)) * normal
    planes = extract_planes(points, PlaneRules(seed=seed))
    assert len(planes) == 1
    assert float(planes.normal[0] @ normal) > np.cos(0.01)
    assert abs(planes.distance_m[0] - distance) < 0.002
    assert planes.count[0] > 2900


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), min_size=1, max_size=60), st.booleans())
def test_the_hull_holds_all_points_and_turns_left(spots: list[tuple[float, float]], rounded: bool) -> None:
    flat = np.round(np.array(spots), 1) if rounded else np.array(spots)
    n = len(flat)
    corner = np.empty((n + 8, 2))
    begins = kernels.hulls(
        flat[:, 0].copy(), flat[:, 1].copy(), np.zeros(n), np.array([0, n]), np.arange(n), np.zeros((1, 3)),
        np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]), corner,
    )  # fmt: skip
    hull = corner[: begins[1]]
    assert {tuple(p) for p in hull} <= {tuple(p) for p in flat}
    if len(hull) < 3:
        return
    way = np.roll(hull, -1, axis=0) - hull
    away = flat[:, None, :] - hull[None, :, :]
    assert np.all(way[None, :, 0] * away[:, :, 1] - way[None, :, 1] * away[:, :, 0] >= -1e-9)
