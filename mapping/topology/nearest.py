"""The node nearest to a vector, exactly, without reading every node (S42).

Two structures are kept beside the nodes, both updated node by node:

- Marks: the book's interval index. The values 0 .. 1 of a dimension are cut into 2^k intervals; at each interval
  stands, as bits, which nodes have a component within reach D of it. A node nearer than D is marked in all
  dimensions, so if none is, none is that near. With k such that an interval is D wide this is the book's
  (q - 1) .. (q + 2); narrower intervals, the default, leave fewer candidates for the same number of bits read.
- Bounds: the nodes turned into their principal directions, in blocks that lie together. A box around each block rules
  out most of them. The others' nodes are compared in seven or eight bits a number, the widest directions first.
  Turning changes no distance; leaving directions out and clipping make none longer; the error of rounding is known:
  what remains is a bound below the distance. Few nodes are still in question after that; these are compared by their
  turned coordinates, and read in full where rounding those to 32 bits leaves a doubt.

Neither helps for every kind of data (uniform random vectors in 48 dimensions defeat both: everything is equally far),
so both are watched by counting, never by a clock, and the cheaper way is taken: marks, few directions, more of them,
all, or plain reading. The answer is the same whichever is taken: the nearest node, of equals the one added first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.kernels import topology as kernels

F64 = NDArray[np.float64]

FLAT_BELOW = 256  # nodes; fewer are read faster than bounded
MOST_DIRECTIONS = 100  # dimensions; for more, rounding is not proven to stay below kernels.GUARD
MOST_INTERVAL_BITS = 5
_WATCHED = 64  # queries between two decisions
_MANY_IN_QUESTION = 1 / 150  # of the nodes: one group of directions more for all then costs as much
_GROWN = 1.25
_TAIL = 1024
_MOVES = 8
_MARKS_WORTH = 128  # marks pay while candidates are fewer than one in so many nodes
_GUARD = 1e-9  # for the rounding of 64-bit numbers


@dataclass(slots=True)
class Effort:
    """What queries cost so far; read it to see which way is taken."""

    queries: int = 0
    by_marks: int = 0  # answered from the candidates of the interval index
    by_bounds: int = 0
    flat: int = 0
    candidates: int = 0  # of the interval index, summed
    looked_at: int = 0  # nodes of the blocks whose boxes did not rule them out, summed
    in_question: int = 0  # nodes that no bound ruled out, summed
    read: int = 0  # nodes read in full, summed


class NearestNodes:
    """Vectors with components in [0, 1], numbered from 0 in order of adding; they may be moved, never removed."""

    def __init__(self, dimensions: int, *, reach: float | None = None, finer_bits: int = 2) -> None:
        """reach: the distance D within which marks find nodes; None for no marks.  finer_bits: each halves the
        intervals; 0 is the book's 2^(p - k) = D.

        Raises ValueError for no dimensions, a reach that is not positive, or negative finer_bits.
        """
        if dimensions < 1:
            raise ValueError(f"dimensions is at least 1, got {dimensions}")
        if reach is not None and not (math.isfinite(reach) and reach > 0.0):
            raise ValueError(f"reach is a distance above 0, got {reach}")
        if finer_bits < 0:
            raise ValueError(f"finer_bits is 0 or more, got {finer_bits}")
        self.dimensions = dimensions
        self.reach = reach
        self.effort = Effort()
        self._count = 0
        self._nodes: F64 = np.zeros((FLAT_BELOW, dimensions))
        self._bounds = _Bounds(dimensions)
        self._marks = None if reach is None or reach >= 1.0 else _Marks(dimensions, reach, finer_bits)

    def __len__(self) -> int:
        return self._count

    @property
    def vectors(self) -> F64:
        """(count, n), a view that is not to be written."""
        view = self._nodes[: self._count]
        view.flags.writeable = False
        return view

    @property
    def marks_pay(self) -> bool:
        """Whether the interval index is used now."""
        return self._marks is not None and self._marks.pays

    def checked(self, vector: ArrayLike) -> F64:
        """(n,) as float64. ValueError unless it has n finite components in [0, 1]."""
        v = np.ascontiguousarray(vector, dtype=np.float64)
        if v.shape != (self.dimensions,):
            raise ValueError(f"a scene vector has {self.dimensions} components, got shape {v.shape}")
        if not kernels.in_unit_cube(v):
            raise ValueError("components of a scene vector lie in [0, 1]")
        return v

    def add(self, vector: ArrayLike) -> int:
        """Returns the new node's number."""
        v = self.checked(vector)
        if self._count == len(self._nodes):
            self._nodes = _grown(self._nodes, axis=0)
        number = self._count
        self._nodes[number] = v
        self._count += 1
        if self._marks is not None:
            self._marks.put(number, v)
        self._bounds.put(self._nodes, self._count, number)
        return number

    def move(self, number: int, vector: ArrayLike) -> None:
        """Give a node another vector. IndexError if there is no such node."""
        if not 0 <= number < self._count:
            raise IndexError(f"node {number} of {self._count}")
        v = self.checked(vector)
        self._nodes[number] = v
        if self._marks is not None:
            self._marks.put(number, v)
        self._bounds.put(self._nodes, self._count, number)

    def within_reach(self, vector: ArrayLike) -> tuple[int, float] | None:
        """Number and distance of the nearest node if it is at most `reach` away, else None; ValueError without one."""
        if self.reach is None:
            raise ValueError("no reach was given")
        return self._search(self.checked(vector), self.reach)

    def nearest(self, vector: ArrayLike) -> tuple[int, float] | None:
        """Number and distance of the nearest node, however far; None if there is no node."""
        return self._search(self.checked(vector), math.inf)

    def _search(self, query: F64, limit: float) -> tuple[int, float] | None:
        if not self._count:
            return None
        self.effort.queries += 1
        best, squared, complete = self._by_marks(query)
        near = self.reach is not None and math.sqrt(squared) <= self.reach
        answered = complete and (near or limit == self.reach)
        if complete and self._marks is not None:
            self._marks.note(answered=answered)
        if not answered:
            best, squared = self._by_bounds(query, best, squared)
        distance = math.sqrt(squared)
        return (best, distance) if distance <= limit and best >= 0 else None

    def _by_marks(self, query: F64) -> tuple[int, float, bool]:
        """Nearest candidate and its squared distance, or -1 and inf; and whether every node within reach was one."""
        if self._marks is None or self._count < FLAT_BELOW or not self._marks.worth_asking():
            return -1, math.inf, False
        most = max(32, self._count // _MARKS_WORTH)
        best, squared, candidates = self._marks.nearest(self._nodes, self._count, query, most)
        self.effort.candidates += candidates
        if candidates > most:
            return -1, math.inf, False
        self.effort.by_marks += 1
        return best, squared, True

    def _by_bounds(self, query: F64, best: int, squared: float) -> tuple[int, float]:
        if not self._bounds.lead:
            self.effort.flat += 1
            number, least = kernels.nearest_flat(self._nodes, self._count, query)
            return int(number), float(least)
        self.effort.by_bounds += 1
        number, least, looked_at, in_question, read = self._bounds.nearest(
            self._nodes, self._count, query, best, squared
        )
        self.effort.looked_at += looked_at
        self.effort.in_question += in_question
        self.effort.read += read
        return number, least


class _Marks:
    """The interval index: a bit for each dimension, interval and node."""

    def __init__(self, dimensions: int, reach: float, finer_bits: int) -> None:
        bits = min(max(0, math.floor(math.log2(1.0 / reach))) + finer_bits, MOST_INTERVAL_BITS)
        self.pays = True
        self._reach = reach + _GUARD
        self._intervals = 2**bits
        self._low: NDArray[np.int8] = np.zeros((FLAT_BELOW, dimensions), dtype=np.int8)
        self._high: NDArray[np.int8] = np.full((FLAT_BELOW, dimensions), -1, dtype=np.int8)  # nothing is marked
        words = FLAT_BELOW // kernels.WORD
        self._marks: NDArray[np.uint64] = np.zeros((dimensions, self._intervals, words), dtype=np.uint64)
        self._common: NDArray[np.uint64] = np.zeros(words, dtype=np.uint64)
        self._skipped = self._asked = self._found = self._answered = 0

    def put(self, number: int, vector: F64) -> None:
        """Mark a node where its vector now is."""
        if number >= len(self._low):
            self._low, self._high = _grown(self._low, axis=0), _grown(self._high, axis=0)
            self._high[number:] = -1
            self._marks, self._common = _grown(self._marks, axis=2), _grown(self._common, axis=0)
        last = self._intervals - 1
        low = np.clip(np.floor((vector - self._reach) * self._intervals), 0, last).astype(np.int8)
        high = np.clip(np.floor((vector + self._reach) * self._intervals), 0, last).astype(np.int8)
        if np.array_equal(low, self._low[number]) and np.array_equal(high, self._high[number]):
            return
        kernels.mark(self._marks, number, self._low[number], self._high[number], False)
        kernels.mark(self._marks, number, low, high, True)
        self._low[number], self._high[number] = low, high

    def nearest(self, nodes: F64, count: int, query: F64, most: int) -> tuple[int, float, int]:
        """Number, squared distance, and how many candidates there were; -1 and inf if none, or more than most."""
        interval = np.minimum((query * self._intervals).astype(np.int64), self._intervals - 1)
        words = -(-count // kernels.WORD)
        best, squared, candidates = kernels.nearest_marked(
            self._marks, words, interval, nodes, query, most, self._common
        )
        self._asked += 1
        self._found += candidates
        if self._asked == _WATCHED:
            self.pays = self._found * _MARKS_WORTH < _WATCHED * count and 2 * self._answered >= _WATCHED
            self._asked = self._found = self._answered = 0
        return int(best), float(squared), int(candidates)

    def note(self, *, answered: bool) -> None:
        """Whether the candidates were all that had to be looked at."""
        self._answered += answered

    def worth_asking(self) -> bool:
        """Always while marks pay; else now and then, to see whether they do by now."""
        self._skipped += 1
        return self.pays or self._skipped % _WATCHED == 0


class _Bounds:
    """Nodes in their principal directions, in blocks that lie together, seven or eight bits a number.

    Boxes rule out blocks, in full precision; sums of codes, below the distances, rule out nodes of the others.
    Directions come in groups of eight, the widest first; a group has a step of its own, the smallest times a power of
    two, so that narrow directions are rounded less. `errors` holds, up to each group, the longest rounding error of
    any node. The first `lead` groups are summed, the rest only for nodes still in question.

    Nodes that are added come into the last blocks, which are sorted whenever _TAIL have come; one that is moved stays
    in its own, whose box grows. Blocks and directions are made anew when the nodes have become a quarter more, or have
    been moved _MOVES times each.
    """

    def __init__(self, dimensions: int) -> None:
        self.lead = 0  # 0: there are no bounds yet
        self._n = dimensions
        self._built_at = 0  # count of nodes when the blocks were made
        self._moves = 0  # since then
        self._known = self._sorted_up_to = 0  # nodes that have a place, and that lie together in theirs
        groups = -(-dimensions // kernels.GROUP)
        width = groups * kernels.GROUP
        self._centre: F64 = np.zeros(dimensions)
        self._axes: F64 = np.zeros((dimensions, width))
        self._origin: F64 = np.zeros(width)
        self._steps: F64 = np.ones(groups)
        self._shifts: NDArray[np.int64] = np.zeros(groups, dtype=np.int64)
        self._errors: F64 = np.zeros(groups)
        self._name: NDArray[np.int32] = np.zeros(0, dtype=np.int32)  # node by place
        self._place: NDArray[np.int32] = np.zeros(0, dtype=np.int32)  # and back
        self._columns: NDArray[np.uint8] = np.zeros((0, width, kernels.BLOCK), dtype=np.uint8)
        self._rows: NDArray[np.float32] = np.zeros((0, width), dtype=np.float32)
        self._low: NDArray[np.float32] = np.zeros((width, 0), dtype=np.float32)
        self._high: NDArray[np.float32] = np.zeros((width, 0), dtype=np.float32)
        self._bound: NDArray[np.float32] = np.zeros(0, dtype=np.float32)
        self._in_question: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self._nearness: F64 = np.zeros(0)
        self._asked = self._looked_at_sum = self._in_question_sum = 0

    def put(self, nodes: F64, count: int, number: int) -> None:
        """Node `number` has been added (as the last of count) or moved."""
        if self._n > MOST_DIRECTIONS:
            return
        if number < self._built_at:
            self._moves += 1
        if count >= max(FLAT_BELOW, _GROWN * self._built_at) or self._moves > _MOVES * self._built_at > 0:
            self._build(nodes, count)
        elif self.lead:
            self._reserve(len(nodes))
            if number >= self._known:
                self._name[number] = self._place[number] = number
                self._known = count
            place = int(self._place[number])
            self._encode(nodes, place, place + 1)
            if self._known - self._sorted_up_to >= _TAIL:
                self._sort_tail(nodes)

    def nearest(
        self, nodes: F64, count: int, query: F64, best: int, squared: float
    ) -> tuple[int, float, int, int, int]:
        """Number, squared distance, nodes looked at, in question, read. best, squared: one known, or -1 and inf."""
        number, least, blocks, in_question, read = kernels.nearest_bounded(
            nodes, count, query, self._centre, self._axes, self._origin, self._steps, self._shifts, self._name,
            self._columns, self._rows, self._low, self._high, self._errors, self._bound, self._in_question,
            self._nearness, self.lead, best, squared,
        )  # fmt: skip
        self._asked += 1
        looked_at = blocks * kernels.BLOCK
        self._looked_at_sum += looked_at
        self._in_question_sum += in_question
        if self._asked == _WATCHED // 4:
            self._look_back()
        return int(number), float(least), int(looked_at), int(in_question), int(read)

    def _look_back(self) -> None:
        """One group more if too many were in question; fewer are tried again with new blocks."""
        if self._in_question_sum > _MANY_IN_QUESTION * self._looked_at_sum:
            self.lead = min(self.lead + 1, len(self._steps))
        self._asked = self._looked_at_sum = self._in_question_sum = 0

    def _build(self, nodes: F64, count: int) -> None:
        self._built_at, self._moves = count, 0
        self._known = self._sorted_up_to = count
        self.lead = max(self.lead - 1, 1)
        present = nodes[:count]
        self._centre = present.mean(axis=0)
        away = present - self._centre
        _, vectors = np.linalg.eigh(away.T @ away)
        self._axes[:, : self._n] = vectors[:, ::-1]
        along = away @ self._axes
        self._origin = along.min(axis=0)
        widest = np.ptp(along, axis=0).reshape(-1, kernels.GROUP).max(axis=1)
        self._steps, self._shifts = _steps(widest)
        self._errors[:] = 0.0
        self._reserve(len(nodes))
        self._low[:], self._high[:] = np.inf, -np.inf
        self._name[:count] = _together(along)
        self._place[self._name[:count]] = np.arange(count, dtype=np.int32)
        self._encode(nodes, 0, count)

    def _sort_tail(self, nodes: F64) -> None:
        """Let nodes that came since the directions were found lie together, too, in blocks of their own."""
        self._sorted_up_to = self._known
        first = -(-self._built_at // kernels.BLOCK) * kernels.BLOCK
        self._low[:, first // kernels.BLOCK :], self._high[:, first // kernels.BLOCK :] = np.inf, -np.inf
        here = self._name[first : self._known]
        here[:] = here[_together(self._rows[first : self._known])]
        self._place[here] = np.arange(first, self._known, dtype=np.int32)
        self._encode(nodes, first, self._known)

    def _reserve(self, capacity: int) -> None:
        missing = capacity - len(self._rows)
        if missing > 0:
            self._rows = np.pad(self._rows, ((0, missing), (0, 0)))
            self._name, self._place = np.pad(self._name, (0, missing)), np.pad(self._place, (0, missing))
            blocks = -(-capacity // kernels.BLOCK) - len(self._columns)
            self._columns = np.pad(self._columns, ((0, blocks), (0, 0), (0, 0)))
            self._low = np.pad(self._low, ((0, 0), (0, blocks)), constant_values=np.inf)
            self._high = np.pad(self._high, ((0, 0), (0, blocks)), constant_values=-np.inf)
            self._bound = np.zeros(len(self._columns), dtype=np.float32)
            self._in_question = np.zeros(capacity, dtype=np.int32)
            self._nearness = np.zeros(capacity)

    def _encode(self, nodes: F64, first: int, last: int) -> None:
        kernels.code_all(
            nodes, first, last, self._centre, self._axes, self._origin, self._steps, self._name, self._columns,
            self._rows, self._low, self._high, self._errors,
        )  # fmt: skip


def _together(along: NDArray[np.floating]) -> NDArray[np.int32]:
    """An order of (N, m) vectors in which each BLOCK of them lies together: halved across the widest direction, and
    the halves again."""
    order = np.arange(len(along), dtype=np.int32)
    waiting = [(0, len(along))]
    while waiting:
        first, last = waiting.pop()
        blocks = -(-(last - first) // kernels.BLOCK)
        if blocks < 2:
            continue
        part = order[first:last]
        values = along[part]
        across = values[:, int(np.argmax(np.var(values, axis=0)))]
        middle = (blocks + 1) // 2 * kernels.BLOCK
        order[first:last] = part[np.argpartition(across, middle)]
        waiting += [(first, first + middle), (first + middle, last)]
    return order


def _steps(widths: F64) -> tuple[F64, NDArray[np.int64]]:
    """Steps of groups as wide as told, and how far their squares are shifted against those of the smallest."""
    levels = np.full(len(widths), kernels.LARGEST)
    levels[0] = kernels.LARGEST_FIRST
    fitting = np.maximum(widths, 1e-9) / levels
    halvings = np.minimum(np.floor(np.log2(fitting.max() / fitting)), kernels.MOST_SHIFT // 2)
    return float(fitting.max()) / 2.0**halvings, (2 * (halvings.max() - halvings)).astype(np.int64)


def _grown(array: NDArray[Any], *, axis: int) -> NDArray[Any]:
    """Twice as long along an axis, zeros added."""
    wider = [(0, 0)] * array.ndim
    wider[axis] = (0, array.shape[axis])
    return np.ascontiguousarray(np.pad(array, wider))
