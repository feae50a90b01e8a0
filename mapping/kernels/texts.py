"""Numbers as text, compiled: a sector map goes out as JSON up to 40 times a second, and most of that is digits.

The digits are those of printf: the exact value of the double, rounded half to even. Short: it keeps the interpreter's
lock, see sectors.py.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

_SPLIT = 134217729.0  # 2^27 + 1
_LARGEST = 9e15  # times its scale; larger ones have no digits after the point
_MINUS, _POINT, _ZERO, _COMMA, _BRACE = 45, 46, 48, 44, 125
LONGEST = 24  # characters of a number


@njit(cache=True)
def rest_of_product(a: float, b: float, product: float) -> float:
    """What rounding took from a product: a * b - product, exactly. Source: Dekker 1971, Veltkamp's split."""
    t = _SPLIT * a
    a_high = t - (t - a)
    a_low = a - a_high
    t = _SPLIT * b
    b_high = t - (t - b)
    b_low = b - b_high
    return ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@njit(cache=True)
def write_number(out: Any, at: int, value: float, digits: int) -> int:
    """Write a finite number with so many digits after the point; returns where it ends, -1 if it is too large."""
    scale = 1.0
    for _ in range(digits):
        scale *= 10.0
    size = abs(value)
    if not size * scale < _LARGEST:
        return -1
    product = size * scale
    whole = np.int64(math.floor(product))
    above_half = (product - whole - 0.5) + rest_of_product(size, scale, product)
    if above_half > 0.0 or (above_half == 0.0 and whole % 2 == 1):
        whole += 1
    if math.copysign(1.0, value) < 0.0:
        out[at] = _MINUS
        at += 1
    count = 1
    left = whole // 10
    while left > 0:
        count += 1
        left //= 10
    count = max(count, digits + 1)
    end = at + count + (1 if digits > 0 else 0)
    place = end - 1
    for k in range(count):
        if k == digits and digits > 0:
            out[place] = _POINT
            place -= 1
        out[place] = _ZERO + whole % 10
        whole //= 10
        place -= 1
    return end


@njit(cache=True)
def copied(out: Any, at: int, texts: Any, starts: Any, number: int) -> int:
    """Write text `number` of those that follow each other in texts, from starts[number]; returns where it ends."""
    for k in range(starts[number], starts[number + 1]):
        out[at] = texts[k]
        at += 1
    return at


@njit(cache=True)
def write_rows(
    out: Any, heads: Any, head_starts: Any, words: Any, word_starts: Any, labels: Any, label_starts: Any,
    state: Any, columns: Any, digits: Any, source: Any, null: int, first_source: int,
) -> int:  # fmt: skip
    """Write N JSON objects with commas between: head, word of the state, a label before each of K numbers, a label,
    the word of the source, a brace. Returns the length, -1 if a number is too large.

    heads, labels: texts of N and K + 1, see copied.  words: those of states, sources and null.  columns: (K, N), null
    where not finite.  digits: (K,).  source: (N,) negative for none, else counted from first_source.
    """
    at = 0
    for row in range(len(state)):
        if row > 0:
            out[at] = _COMMA
            at += 1
        at = copied(out, at, heads, head_starts, row)
        at = copied(out, at, words, word_starts, state[row])
        for column in range(len(digits)):
            at = copied(out, at, labels, label_starts, column)
            value = columns[column, row]
            if math.isfinite(value):
                at = write_number(out, at, value, digits[column])
                if at < 0:
                    return -1
            else:
                at = copied(out, at, words, word_starts, null)
        at = copied(out, at, labels, label_starts, len(digits))
        at = copied(out, at, words, word_starts, null if source[row] < 0 else first_source + source[row])
        out[at] = _BRACE
        at += 1
    return at
