"""Loops of the topological maps: the node nearest to a vector, without reading all nodes (S42).

Two ways to read less, both exact. Marks: a bit for each node, dimension and interval; the bits that are set in all
dimensions are the candidates. Bounds: each node as a few bytes whose distance, scaled, is never above the true one;
only nodes whose bound is low enough are looked at further. All arrays are C-contiguous; nodes (capacity, n) float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

WORD = 64  # nodes in a word of marks
BLOCK = 64  # nodes that lie together: one box around them, one register of codes for each direction
LARGEST_FIRST, LARGEST = 255.0, 127.0  # code: eight bits in the first, widest group, else seven; see lead_sums
GROUP = 8  # directions that are added at a time
MOST_SHIFT = 8  # of a group's squares: sums of 16 groups stay below FAR
FAR = 1 << 30  # above every sum
GUARD = 1e-4  # distance; far above what 32-bit coordinates and sums in up to 100 directions are off


@njit(cache=True, nogil=True)
def in_unit_cube(vector: Any) -> bool:
    """Whether all components lie in [0, 1]; NaN does not."""
    for r in range(vector.shape[0]):  # noqa: SIM110 - compiled as it stands
        if not 0.0 <= vector[r] <= 1.0:
            return False
    return True


@njit(cache=True, nogil=True)
def squared_up_to(node: Any, query: Any, limit: float) -> float:
    """Squared distance, summed in order; inf as soon as it is above the limit."""
    total = 0.0
    n = query.shape[0]
    first = 0
    while first < n:
        last = min(first + 8, n)
        for r in range(first, last):
            away = node[r] - query[r]
            total += away * away
        if total > limit:
            return np.inf
        first = last
    return total


@njit(cache=True, nogil=True)
def nearest_flat(nodes: Any, count: int, query: Any) -> Any:
    """(number, squared distance) of the nearest of the first count nodes; of equals the lowest number; -1 if none."""
    best, best_squared = -1, np.inf
    for j in range(count):
        squared = squared_up_to(nodes[j], query, best_squared)
        if squared < best_squared:
            best, best_squared = j, squared
    return best, best_squared


@njit(cache=True, nogil=True)
def two_nearest_flat(nodes: Any, alive: Any, query: Any) -> Any:
    """(nearest, second, squared distance of the nearest) among the nodes that are alive; -1 where there is none."""
    best, second = -1, -1
    best_squared, second_squared = np.inf, np.inf
    for j in range(nodes.shape[0]):
        if not alive[j]:
            continue
        squared = squared_up_to(nodes[j], query, second_squared)
        if squared < best_squared:
            second, second_squared = best, best_squared
            best, best_squared = j, squared
        elif squared < second_squared:
            second, second_squared = j, squared
    return best, second, best_squared


@njit(cache=True, nogil=True)
def mark(marks: Any, number: int, low: Any, high: Any, on: bool) -> None:
    """Set or clear a node's bit in the intervals low[r] .. high[r] of each dimension. marks: (n, intervals, words)."""
    word, bit = number // WORD, np.uint64(1) << np.uint64(number % WORD)
    for r in range(marks.shape[0]):
        for q in range(low[r], high[r] + 1):
            if on:
                marks[r, q, word] |= bit
            else:
                marks[r, q, word] &= ~bit


@njit(cache=True, nogil=True)
def nearest_marked(marks: Any, words: int, interval: Any, nodes: Any, query: Any, most: int, common: Any) -> Any:
    """(number, squared distance, candidates) of the nearest node that is marked in all dimensions.

    interval: (n,) the query's interval in each dimension.  common: (words,) uint64 work.  Gives up with number -1 and
    the count so far when more than `most` candidates would have to be read: another way is cheaper then.
    """
    dimensions = marks.shape[0]
    for w in range(words):
        common[w] = marks[0, interval[0], w]
    for r in range(1, dimensions):
        row = marks[r, interval[r]]
        for w in range(words):
            common[w] &= row[w]
    candidates = 0
    for w in range(words):
        left = common[w]
        while left != 0:
            left &= left - np.uint64(1)
            candidates += 1
    if candidates > most:
        return -1, np.inf, candidates
    best, best_squared = -1, np.inf
    for w in range(words):
        left = common[w]
        while left != 0:
            lowest = left & (~left + np.uint64(1))
            j = w * WORD + bit_number(lowest)
            squared = squared_up_to(nodes[j], query, best_squared)
            if squared < best_squared:
                best, best_squared = j, squared
            left ^= lowest
    return best, best_squared, candidates


@njit(cache=True, nogil=True)
def bit_number(single: Any) -> int:
    """Which bit of a word is set, given that one is."""
    number = 0
    for shift in (32, 16, 8, 4, 2, 1):
        if single >> np.uint64(shift):
            single >>= np.uint64(shift)
            number += shift
    return number


@njit(cache=True, nogil=True)
def turn(vector: Any, centre: Any, axes: Any, row: Any) -> None:
    """A vector's coordinates in the principal directions. axes: (n, m), a direction a column.  row: (m,) float32."""
    coordinates = np.zeros(row.shape[0])
    for r in range(vector.shape[0]):
        away = vector[r] - centre[r]
        for d in range(row.shape[0]):
            coordinates[d] += away * axes[r, d]
    for d in range(row.shape[0]):
        row[d] = np.float32(coordinates[d])


@njit(cache=True, nogil=True)
def code(row: Any, origin: Any, steps: Any, codes: Any, errors: Any) -> None:
    """Coordinates as seven or eight bits a direction, and how far that is off, summed up to each group of directions.

    origin: (m,) of the box, m = GROUP * groups.  steps: (groups,).  codes: (m,) uint8, written.  errors: (groups,),
    written: length of the rounding error in the directions up to this group; clipping is not counted, it brings no
    two vectors farther apart.
    """
    squared = 0.0
    for d in range(codes.shape[0]):
        step = steps[d // GROUP]
        inside = min(max((row[d] - origin[d]) / step, 0.0), LARGEST_FIRST if d < GROUP else LARGEST)
        whole = np.floor(inside + 0.5)
        codes[d] = np.uint8(whole)
        squared += ((inside - whole) * step) ** 2
        errors[d // GROUP] = np.sqrt(squared)


@njit(cache=True, nogil=True)
def code_all(
    nodes: Any,
    first: int,
    last: int,
    centre: Any,
    axes: Any,
    origin: Any,
    steps: Any,
    name: Any,
    columns: Any,
    rows: Any,
    low: Any,
    high: Any,
    errors: Any,
) -> None:
    """Turn and code the nodes in the places first .. last - 1.

    name: (capacity,) int32, which node is in a place.  rows: (capacity, m) float32, their coordinates.  columns:
    (blocks, m, BLOCK) uint8, their codes.  low, high: (m, blocks) float32, boxes around blocks, made wider where these
    nodes lie outside.  errors: (groups,), raised where these nodes are rounded more than any before.
    """
    codes = np.empty(rows.shape[1], dtype=np.uint8)
    off = np.empty(errors.shape[0])
    for j in range(first, last):
        turn(nodes[name[j]], centre, axes, rows[j])
        code(rows[j], origin, steps, codes, off)
        b = j // BLOCK
        for d in range(codes.shape[0]):
            columns[b, d, j % BLOCK] = codes[d]
            low[d, b] = min(low[d, b], rows[j, d])
            high[d, b] = max(high[d, b], rows[j, d])
        for g in range(errors.shape[0]):
            errors[g] = max(errors[g], off[g])


@njit(cache=True, nogil=True)
def lead_sums(columns: Any, query: Any, lead: int, shifts: Any, part: Any) -> Any:
    """Squared differences of the first `lead` groups of the nodes of a block, into part; the least of them.

    columns: (m, BLOCK).  part: (nodes,) int32.  Four squares of 7-bit numbers fit in 16 bits, of which a vector
    register holds twice as many as of 32: this is what most codes leave their eighth bit unused for. The first group
    has the widest directions, whose rounding would count most, and uses it.
    """
    count = part.shape[0]
    for j in range(count):
        part[j] = 0
    first_by = np.int32(shifts[0])
    for d in range(0, GROUP, 4):
        e0, e1, e2, e3 = columns[d], columns[d + 1], columns[d + 2], columns[d + 3]
        p0, p1, p2, p3 = np.int16(query[d]), np.int16(query[d + 1]), np.int16(query[d + 2]), np.int16(query[d + 3])
        for j in range(count):
            b0, b1 = np.int16(np.int16(e0[j]) - p0), np.int16(np.int16(e1[j]) - p1)
            b2, b3 = np.int16(np.int16(e2[j]) - p2), np.int16(np.int16(e3[j]) - p3)
            one = np.int32(np.int32(np.uint16(b0 * b0)) + np.int32(np.uint16(b1 * b1)))
            two = np.int32(np.int32(np.uint16(b2 * b2)) + np.int32(np.uint16(b3 * b3)))
            part[j] += np.int32(np.int32(one + two) << first_by)
    for d in range(GROUP, lead * GROUP, GROUP):
        by = np.int32(shifts[d // GROUP])
        c0, c1, c2, c3 = columns[d], columns[d + 1], columns[d + 2], columns[d + 3]
        c4, c5, c6, c7 = columns[d + 4], columns[d + 5], columns[d + 6], columns[d + 7]
        q0, q1, q2, q3 = np.int16(query[d]), np.int16(query[d + 1]), np.int16(query[d + 2]), np.int16(query[d + 3])
        q4, q5, q6, q7 = np.int16(query[d + 4]), np.int16(query[d + 5]), np.int16(query[d + 6]), np.int16(query[d + 7])
        for j in range(count):
            a0, a1 = np.int16(np.int16(c0[j]) - q0), np.int16(np.int16(c1[j]) - q1)
            a2, a3 = np.int16(np.int16(c2[j]) - q2), np.int16(np.int16(c3[j]) - q3)
            a4, a5 = np.int16(np.int16(c4[j]) - q4), np.int16(np.int16(c5[j]) - q5)
            a6, a7 = np.int16(np.int16(c6[j]) - q6), np.int16(np.int16(c7[j]) - q7)
            low = np.uint16(np.uint16(np.uint16(a0 * a0) + np.uint16(a1 * a1)) + np.uint16(a2 * a2))
            low = np.uint16(low + np.uint16(a3 * a3))
            high = np.uint16(np.uint16(np.uint16(a4 * a4) + np.uint16(a5 * a5)) + np.uint16(a6 * a6))
            high = np.uint16(high + np.uint16(a7 * a7))
            part[j] += np.int32(np.int32(np.int32(low) + np.int32(high)) << by)
    least = np.int32(FAR)
    for j in range(count):
        least = min(least, part[j])
    return least


@njit(cache=True, nogil=True)
def squared_row(row: Any, query: Any, limit: float) -> Any:
    """Squared distance of two (m,) float32 rows; inf as soon as it is above the limit: the widest directions first."""
    total = np.float32(0.0)
    for first in range(0, row.shape[0], GROUP):
        for d in range(first, first + GROUP):
            away = row[d] - query[d]
            total += away * away
        if total > limit:
            return np.inf
    return total


@njit(cache=True, nogil=True)
def box_distances(low: Any, high: Any, row: Any, bound: Any) -> Any:
    """bound: (blocks,) float32 out, squared distance to the box of each block; the block that is nearest."""
    for b in range(bound.shape[0]):
        bound[b] = np.float32(0.0)
    for d in range(row.shape[0]):
        here, least, most = row[d], low[d], high[d]
        for b in range(bound.shape[0]):
            before, beyond = least[b] - here, here - most[b]  # one of them at most is above 0
            twice = (before + abs(before)) + (beyond + abs(beyond))  # no maximum: that would not be vectorised
            bound[b] += twice * twice
    nearest = 0
    for b in range(bound.shape[0]):
        bound[b] *= np.float32(0.25)
    for b in range(bound.shape[0]):
        if bound[b] < bound[nearest]:
            nearest = b
    return nearest


@njit(cache=True, nogil=True)
def nearest_bounded(
    nodes: Any,
    count: int,
    query: Any,
    centre: Any,
    axes: Any,
    origin: Any,
    steps: Any,
    shifts: Any,
    name: Any,
    columns: Any,
    rows: Any,
    low: Any,
    high: Any,
    errors: Any,
    bound: Any,
    in_question: Any,
    nearness: Any,
    lead: int,
    best: int,
    best_squared: float,
) -> Any:
    """(number, squared distance, blocks looked at, nodes in question, nodes read) of the nearest node.

    centre .. errors: as code_all takes and makes them.  shifts: (groups,), steps[g] = steps.min() * 2^(shifts[g] / 2),
    so that sums are in units of the smallest step squared.  bound: (blocks,) float32, in_question (int32), nearness
    (float64): (capacity,), work.  lead: groups that are summed for all nodes of the blocks whose box is near enough;
    those not ruled out by it are in question and compared by their rows, and read only if rounding to 32 bits leaves a
    doubt.  best, best_squared: a node already known, or -1 and inf.
    """
    blocks = (count + BLOCK - 1) // BLOCK
    row = np.empty(axes.shape[1], dtype=np.float32)
    own = np.empty(axes.shape[1], dtype=np.uint8)
    slack = np.empty(steps.shape[0])
    sums = np.empty(BLOCK, dtype=np.int32)
    turn(query, centre, axes, row)
    code(row, origin, steps, own, slack)
    unit, off = steps.min(), slack[lead - 1] + errors[lead - 1] + GUARD
    start = box_distances(low, high, row, bound[:blocks])
    near = best_squared  # squared distance of the nearest so far, by rows
    limit = sum_limit(near, unit, off)
    found, looked_at = 0, 0
    for turn_number in range(3):  # the nearest block, then those half as far as the best in it, then the others
        first, last = (start, start + 1) if turn_number == 0 else (0, blocks)
        within = widened(near) if turn_number != 1 else 0.25 * near
        for b in range(first, last):
            if bound[b] > within:
                continue
            bound[b] = np.inf  # once only
            looked_at += 1
            size = min(count - b * BLOCK, BLOCK)
            least = lead_sums(columns[b], own, lead, shifts, sums[:size])
            if least > limit:
                continue
            likeliest = 0
            while sums[likeliest] != least:
                likeliest += 1
            near = min(near, squared_row(rows[b * BLOCK + likeliest], row, np.inf))
            limit = sum_limit(near, unit, off)
            for j in range(size):
                if sums[j] > limit:
                    continue
                squared = squared_row(rows[b * BLOCK + j], row, widened(near))
                in_question[found], nearness[found] = name[b * BLOCK + j], squared
                found += 1
                if squared < near:
                    near = squared
                    limit = sum_limit(near, unit, off)
            if turn_number == 2:
                within = widened(near)
    read = 0
    for place in range(found):
        if nearness[place] <= widened(near):
            number = in_question[place]
            squared = squared_up_to(nodes[number], query, best_squared)
            read += 1
            if squared < best_squared or (squared == best_squared and number < best):
                best, best_squared = number, squared
    return best, best_squared, looked_at, found, read


@njit(cache=True, nogil=True)
def widened(squared: float) -> Any:
    """The square of a distance that is longer by GUARD on both sides."""
    return (np.sqrt(squared) + 2.0 * GUARD) ** 2


@njit(cache=True, nogil=True)
def sum_limit(squared: float, unit: float, slack: float) -> Any:
    """The largest sum of codes that a node can have whose squared distance is at most `squared`."""
    if not np.isfinite(squared):
        return FAR
    reach = (np.sqrt(squared) + slack) / unit
    return np.int64(min(reach * reach + 1.0, 1.0 * FAR))
