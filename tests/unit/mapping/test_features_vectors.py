"""S23 and S24 against the equations written out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mapping.features.vectors import Feature, FeatureSpace, Scale

SPACE = FeatureSpace(
    [
        Feature("width", low=2.0, high=10.0),
        Feature("doors", Scale.ORDERED, values=5),
        Feature("colour", Scale.UNORDERED, values=3),
        Feature("floor", Scale.UNORDERED, values=4, must_agree=True),
    ]
)


def test_normalised_is_equation_5_40_and_rank_by_n_minus_1() -> None:
    np.testing.assert_allclose(SPACE.normalised([4.0, 1.0, 2.0, 3.0]), [0.25, 0.25, 1.0, 1.0])
    np.testing.assert_allclose(SPACE.normalised([[99.0, 0, 0, 0], [-5.0, 4, 1, 0]])[:, :2], [[1.0, 0.0], [0.0, 1.0]])


def test_distance_is_euclids_with_unordered_ones_equal_or_not() -> None:
    a, b = SPACE.normalised([4.0, 1.0, 2.0, 1.0]), SPACE.normalised([8.0, 3.0, 1.0, 1.0])
    assert float(SPACE.distance(a, b)) == pytest.approx(math.sqrt(0.5**2 + 0.5**2 + 1.0))
    assert float(SPACE.distance(a, a)) == 0.0


def test_a_must_that_differs_is_the_largest_distance_there_is() -> None:
    a, b = SPACE.normalised([4.0, 1.0, 2.0, 1.0]), SPACE.normalised([4.0, 1.0, 2.0, 0.0])
    assert float(SPACE.distance(a, b)) == SPACE.farthest == 2.0


def test_many_at_once_are_each_alone() -> None:
    random = np.random.default_rng(4)
    table = SPACE.normalised(
        np.stack(
            (
                random.uniform(0, 12, 30),
                random.integers(0, 5, 30),
                random.integers(0, 3, 30),
                random.integers(0, 2, 30),
            ),
            axis=-1,
        )
    )
    together = SPACE.distance(table, table[0])
    assert together.shape == (30,)
    for k in range(30):
        assert float(SPACE.distance(table[k], table[0])) == together[k]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1.0, 2.0], "4 values"),
        ([math.nan, 0.0, 0.0, 0.0], "finite"),
        ([3.0, 0.5, 0.0, 0.0], "rank"),
        ([3.0, 5.0, 0.0, 0.0], "rank"),
        ([3.0, -1.0, 0.0, 0.0], "rank"),
    ],
)
def test_bad_values(values: list[float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        SPACE.normalised(values)


def test_bad_vectors_and_spaces() -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        SPACE.distance([0.0, 0.0, 0.0, math.nan], [0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="4 values"):
        SPACE.distance([0.0], [0.0])
    with pytest.raises(ValueError, match="at least one"):
        FeatureSpace([])
    with pytest.raises(ValueError, match="different names"):
        FeatureSpace([Feature("a"), Feature("a")])
    with pytest.raises(ValueError, match="low must be below high"):
        Feature("a", low=1.0, high=1.0)
    with pytest.raises(ValueError, match="at least 2 values"):
        Feature("a", Scale.ORDERED, values=1)
    with pytest.raises(ValueError, match="must"):
        Feature("a", must_agree=True)
