"""Am I lost? The probability that the place believed in is the right one, from what the last scans said.

Two things must hold: no other place is as likely, and the scans fit this one now. So it is a product of two logistic
functions; their coefficients are fitted by bench/localise.py on some of the recorded logs, and judged on others.
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
    the newest counts more while the robot stands.  keys: key scans there were to judge by.  challenged: the map has
    been searched for rivals.
    """

    lead: float = 0.0
    explained: float = 0.0
    explained_now: float = 0.0
    through: float = 1.0
    keys: int = 0
    challenged: bool = False


@dataclass(frozen=True, slots=True)
class Coefficients:
    """alone: of one, lead, log(1 + keys).  fits: of one, explained_now, explained."""

    alone: tuple[float, float, float]
    fits: tuple[float, float, float]


FITTED = Coefficients((3.42, 0.9, -1.16), (-7.02, 10.6, 1.33))
LEAD = (-6.0, 12.0)  # beyond, a lead says no more
MOST_KEYS = 32


def features(evidence: Evidence) -> tuple[F64, F64]:
    """(3,) each, as `Coefficients` weigh them."""
    lead = min(max(evidence.lead, LEAD[0]), LEAD[1])
    alone = np.array([1.0, lead, math.log1p(min(evidence.keys, MOST_KEYS))])
    return alone, np.array([1.0, evidence.explained_now, evidence.explained])


def probability(evidence: Evidence, coefficients: Coefficients = FITTED) -> float:
    """That the first place is right, 0 to 1; 0 while nobody has looked for another."""
    if evidence.keys == 0 or not evidence.challenged:
        return 0.0
    alone, fits = features(evidence)
    return _logistic(float(alone @ coefficients.alone)) * _logistic(float(fits @ coefficients.fits))


def _logistic(z: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(z, -60.0), 60.0)))
