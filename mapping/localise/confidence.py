"""Am I lost? The probability that the place believed in is the right one, from what the last scans said.

Two things must hold: no other place is as likely, and the scans fit this one now. So it is a product of two logistic
functions; their coefficients are fitted by bench/localise.py on some of the recorded logs, and judged on others.

How well scans fit at the right place depends on the map: one that is coarse, or half empty, explains 80 % of the beams
all the time. So a place that has been ahead for some way, and is explained now as well as it was on that way, is
given credit for it (`held`); one that fits suddenly worse gets none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a belief is judged by.

    lead: log of how much more likely the first place is than all its rivals together.  explained, through: shares of
    beams that end on a wall of the map, and that went through one, over six key scans; explained_now over two, of which
    the newest counts more while the robot stands.  keys: key scans there were to judge by; own_keys: the newest of them
    that the place itself rests on, older ones were made elsewhere, and explained_own: the share over those.
    challenged: the map has been searched for rivals.
    """

    lead: float = 0.0
    explained: float = 0.0
    explained_now: float = 0.0
    through: float = 1.0
    keys: int = 0
    own_keys: int = 0
    explained_own: float = 0.0
    challenged: bool = False


@dataclass(frozen=True, slots=True)
class Coefficients:
    """alone: of one, lead, log(1 + keys).  fits: of one, explained_now, explained, held."""

    alone: tuple[float, float, float]
    fits: tuple[float, float, float, float]


FITTED = Coefficients((3.42, 0.9, -1.16), (-7.02, 10.6, 1.33, 1.0))
LEAD = (-6.0, 12.0)  # beyond, a lead says no more
MOST_KEYS = 32
HELD_KEYS = (4, 16)  # a place earns its credit from so many key scans of its own to so many
HELD_LEAD = 10.0  # with this lead all of it
HELD_EXPLAINED = (0.7, 0.8)  # nor does a place that explained less on its way earn any
HELD_DROP = (0.09, 0.03)  # none of it if so much less is explained now than on the way, all if not more than so much


def features(evidence: Evidence) -> tuple[F64, F64]:
    """(3,) and (4,), as `Coefficients` weigh them."""
    lead = min(max(evidence.lead, LEAD[0]), LEAD[1])
    alone = np.array([1.0, lead, math.log1p(min(evidence.keys, MOST_KEYS))])
    return alone, np.array([1.0, evidence.explained_now, evidence.explained, held(evidence)])


def held(evidence: Evidence) -> float:
    """0 to 1: how long, how far ahead and how steadily the place has explained what was seen."""
    drop = evidence.explained_own - evidence.explained_now
    return (
        _share(evidence.own_keys, *HELD_KEYS)
        * _share(evidence.lead, 0.0, HELD_LEAD)
        * _share(evidence.explained_own, *HELD_EXPLAINED)
        * (1.0 - _share(drop, HELD_DROP[1], HELD_DROP[0]))
    )


def _share(value: float, low: float, high: float) -> float:
    """Of the way from low to high, 0 to 1."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


def probability(evidence: Evidence, coefficients: Coefficients = FITTED) -> float:
    """That the first place is right, 0 to 1; 0 while nobody has looked for another."""
    if evidence.keys == 0 or not evidence.challenged:
        return 0.0
    alone, fits = features(evidence)
    return _logistic(float(alone @ coefficients.alone)) * _logistic(float(fits @ coefficients.fits))


def _logistic(z: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(z, -60.0), 60.0)))
