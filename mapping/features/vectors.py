"""Scenes as vectors of features, and how far apart they are (S23, S24)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]


class Scale(Enum):
    """What the values of a feature are to each other."""

    CONTINUOUS = "continuous"
    """Numbers in a range."""
    ORDERED = "ordered"
    """One of a few values that have an order."""
    UNORDERED = "unordered"
    """One of a few values: equal, or as far apart as can be."""


@dataclass(frozen=True, slots=True)
class Feature:
    """One component of a vector.

    low, high: the range of a continuous feature.  values: how many there are of a discrete one, numbered from 0.
    must_agree: a condition sine qua non: if it differs, the scenes are as far apart as can be.
    """

    name: str
    scale: Scale = Scale.CONTINUOUS
    low: float = 0.0
    high: float = 1.0
    values: int = 2
    must_agree: bool = False

    def __post_init__(self) -> None:
        if self.scale is Scale.CONTINUOUS:
            if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
                raise ValueError(f"{self.name}: low must be below high, got {self.low} to {self.high}")
            if self.must_agree:
                raise ValueError(f"{self.name}: numbers never agree exactly; only discrete features can be a must")
        elif self.values < 2:
            raise ValueError(f"{self.name}: a discrete feature has at least 2 values, got {self.values}")


class FeatureSpace:
    """The unit cube that scenes are points of."""

    def __init__(self, features: Sequence[Feature]) -> None:
        """ValueError without features, or if two have one name."""
        if not features:
            raise ValueError("a vector has at least one feature")
        names = [feature.name for feature in features]
        if len(set(names)) != len(names):
            raise ValueError(f"features must have different names, got {names}")
        self.features = tuple(features)
        self._low = np.array([f.low if f.scale is Scale.CONTINUOUS else 0.0 for f in features])
        span = [f.high - f.low if f.scale is Scale.CONTINUOUS else float(f.values - 1) for f in features]
        self._span = np.array(span)
        self._unordered = np.array([f.scale is Scale.UNORDERED for f in features])
        self._must = np.array([f.must_agree for f in features])
        self._discrete = np.array([f.scale is not Scale.CONTINUOUS for f in features])

    def __len__(self) -> int:
        return len(self.features)

    @property
    def farthest(self) -> float:
        """sqrt(k): no two scenes are farther apart (eq. 5.42)."""
        return math.sqrt(len(self.features))

    def normalised(self, values: ArrayLike) -> F64:
        """(k,) or (N, k) values, each brought to [0, 1]: (M - low) / (high - low) (eq. 5.40), rank / (n - 1).

        Continuous values outside their range are cut off there.  ValueError for another shape, a number that is not
        finite, or a discrete value that is no rank 0 .. n - 1.
        """
        v = np.asarray(values, dtype=np.float64)
        if v.ndim not in (1, 2) or v.shape[-1] != len(self.features):
            raise ValueError(f"a vector has {len(self.features)} values, got shape {v.shape}")
        if not np.all(np.isfinite(v)):
            raise ValueError("features must be finite numbers")
        ranks = v[..., self._discrete]
        if not (
            np.all(ranks == np.floor(ranks)) and np.all(ranks >= 0.0) and np.all(ranks <= self._span[self._discrete])
        ):
            raise ValueError("a discrete feature is the rank of its value, 0 .. n - 1")
        return np.asarray(np.clip((v - self._low) / self._span, 0.0, 1.0))

    def distance(self, first: ArrayLike, second: ArrayLike) -> F64:
        """Distances in [0, sqrt(k)] of normalised vectors: (k,) or (N, k) each, broadcast.

        Euclid's (eq. 5.41); unordered features differ by 0 or 1; where a must does not agree, sqrt(k) (eq. 5.43).
        ValueError for other shapes, or values outside [0, 1].
        """
        a, b = self._checked(first), self._checked(second)
        differ = a != b
        step = np.where(self._unordered, differ.astype(np.float64), a - b)
        distance = np.sqrt(np.sum(step * step, axis=-1))
        return np.where(np.any(differ & self._must, axis=-1), self.farthest, distance)

    def _checked(self, vector: ArrayLike) -> F64:
        v = np.asarray(vector, dtype=np.float64)
        if v.ndim not in (1, 2) or v.shape[-1] != len(self.features):
            raise ValueError(f"a vector has {len(self.features)} values, got shape {v.shape}")
        if not (np.all(v >= 0.0) and np.all(v <= 1.0)):  # NaN fails, too
            raise ValueError("normalised values lie in [0, 1]")
        return v
