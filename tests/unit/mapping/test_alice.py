"""ALICE's map: rings, edges, positions (S43)."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import wrap_angle
from mapping.topology.alice import (
    RING,
    SENSOR_RAD,
    AliceMap,
    AliceRules,
    ring_offsets,
    smoothed_touch,
    turned_ring,
)

F64 = NDArray[np.float64]
RANDOM = np.random.default_rng(11)
LOOKS = [RANDOM.random(RING) for _ in range(8)]
NOTHING = np.zeros(RING)


def lamp_ring(bearing_rad: float) -> F64:
    """One lamp and one window: smooth enough for 24 sensors."""
    at = np.arange(RING) * SENSOR_RAD
    return np.asarray(0.1 + 0.6 * np.exp(np.cos(at - bearing_rad) * 4 - 4) + 0.2 * np.cos(at - bearing_rad - 1.0) ** 2)


def test_touch_is_smoothed_around_the_ring() -> None:
    touch = np.zeros(RING)
    touch[[0, 1, 12]] = 1.0
    expected = np.zeros(RING)
    expected[[23, 0, 1, 2, 11, 12, 13]] = [0.25, 0.75, 0.75, 0.25, 0.25, 0.5, 0.25]
    np.testing.assert_array_equal(smoothed_touch(touch), expected)


@given(st.integers(-30, 30))
def test_turning_by_whole_sensors_is_a_roll(sensors: int) -> None:
    ring = LOOKS[0]
    np.testing.assert_allclose(turned_ring(ring, sensors * SENSOR_RAD), np.roll(ring, sensors), atol=1e-12)


@settings(max_examples=60)
@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_offset_between_two_rings(first: float, second: float) -> None:
    angle, likeness = ring_offsets(lamp_ring(first), np.stack((lamp_ring(second), lamp_ring(first))))
    assert abs(wrap_angle(float(angle[0]) - (second - first))) < math.radians(0.3)
    assert abs(wrap_angle(float(angle[1]))) < 1e-9
    assert likeness.min() > 0.99


def test_offset_is_where_correlation_is_largest() -> None:
    """Against correlation summed up at each shift."""
    for a, b in itertools.pairwise(LOOKS):
        c, d = a - a.mean(), b - b.mean()
        sums = [float(np.sum(np.roll(c, k) * d)) for k in range(RING)]
        angle, likeness = ring_offsets(a, b)
        assert likeness[0] >= max(sums) / np.linalg.norm(c) / np.linalg.norm(d) - 1e-9
        at_best = float(turned_ring(c, float(angle[0])) @ d)  # straight lines between sensors: a little less
        assert at_best > 0.5 * max(sums)


def test_ring_without_contrast_has_no_direction() -> None:
    angle, likeness = ring_offsets(np.full(RING, 0.3), LOOKS[0])
    assert (angle[0], likeness[0]) == (0.0, 0.0)


def drive(topo: AliceMap, units: list[int]) -> list[int]:
    return [topo.look(LOOKS[k], NOTHING, (0.1, 0.0)) for k in units]


def blind() -> AliceRules:
    return AliceRules(correct_heading=False)


def test_edges_count_drives_in_a_direction() -> None:
    topo = AliceMap(blind())
    assert drive(topo, [0, 0, 1, 2, 0, 1, 1, 2]) == [0, 0, 1, 2, 0, 1, 1, 2]
    assert {pair: (edge.up, edge.down) for pair, edge in topo.edges.items()} == {
        (0, 1): (2, 0),
        (1, 2): (2, 0),
        (0, 2): (0, 1),
    }
    graph = topo.graph()
    assert [(a, b, driven) for a, b, _, driven in graph.edges] == [(0, 1, 2), (1, 2, 2)]
    assert [(node.number, node.looks) for node in graph.nodes] == [(0, 3), (1, 3), (2, 2)]


def test_false_look_in_a_unit_is_no_way() -> None:
    """There and back: the edge is not published, gains nothing by it, and goes."""
    topo = AliceMap(blind())
    drive(topo, [0, 7, 0])
    assert topo.edges[(0, 1)].strength == 1.0
    assert topo.graph().edges == ()
    drive(topo, [1, 0] * 11)
    assert (0, 1) not in topo.edges
    assert topo.dropped == 1


def test_other_edges_weaken_by_the_book() -> None:
    topo = AliceMap(AliceRules(correct_heading=False, weaken=0.1, drop_below=0.75))
    drive(topo, [0, 1, 2, 0, 1, 2])  # a ring, then again
    assert topo.edges[(0, 1)].strength == pytest.approx(2.0 - 2 * 0.1)  # 1 was left to 2 twice
    assert topo.edges[(0, 2)].strength == pytest.approx(1.0 - 0.1)  # 0 was left to 1
    drive(topo, [0, 1, 2, 3, 1, 2, 3])
    assert topo.edges[(1, 2)].strength <= topo.rules.most_strength


def test_positions_are_the_mean_of_where_units_were_met() -> None:
    topo = AliceMap(blind())
    ways = [(0.0, 0.0), (1.0, 0.0), (0.5, 0.2), (-1.5, -0.2)]
    for k, way in zip([0, 1, 1, 0], ways):
        topo.look(LOOKS[k], NOTHING, way)
    assert topo.position_m(0) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert topo.position_m(1) == pytest.approx((1.25, 0.1))
    with pytest.raises(IndexError):
        topo.position_m(5)


def test_heading_follows_the_light() -> None:
    """The robot goes to and fro while its body turns by 0.02 rad a metre; light comes from far away."""
    seeing, unseeing = AliceMap(), AliceMap(blind())
    heading = 0.0
    for k in range(2000):
        way = 0.05 if k // 20 % 2 == 0 else -0.05
        heading += 0.02 * 0.05
        for topo in (seeing, unseeing):
            topo.look(np.clip(turned_ring(lamp_ring(0.5), -heading), 0.0, 1.0), NOTHING, (way, 0.0))
    assert heading == pytest.approx(2.0)
    assert abs(wrap_angle(seeing.pose.yaw_rad - heading)) < math.radians(2.0)
    assert seeing.drift_rad_per_m == pytest.approx(0.02, abs=0.005)
    assert unseeing.pose.yaw_rad == 0.0


def test_bad_looks_change_nothing() -> None:
    topo = AliceMap()
    topo.look(LOOKS[0], NOTHING, (0.0, 0.0))
    for light, touch, way in (
        (LOOKS[0][:5], NOTHING, (0.0, 0.0)),
        (np.full(RING, np.nan), NOTHING, (0.0, 0.0)),
        (LOOKS[0], np.full(RING, 2.0), (0.0, 0.0)),
        (LOOKS[0], NOTHING, (math.inf, 0.0)),
    ):
        with pytest.raises(ValueError):
            topo.look(light, touch, way)
    assert len(topo) == 1
    assert topo.pose.x_m == 0.0


@pytest.mark.parametrize(
    "wrong",
    [{"weaken": -0.1}, {"drop_below": 0.0}, {"new_strength": 9.0}, {"driven_at_least": 0}, {"reference_m": 0.0}],
)
def test_wrong_rules(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        AliceRules(**wrong)  # type: ignore[arg-type]
