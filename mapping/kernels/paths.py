"""Compiled loops of planning on the Voronoi diagram (S44): diagram to graph, shortest ways on it, straightening.

    squared (R, C) int32    squared distance to the nearest obstacle in cells, 0 on obstacles
    line    (R, C) bool     the diagram, thinned to lines of single cells
    where   (R, C) int32    0 off the lines, k + 1 for the k-th cell of `chain`, -(n + 1) for node n

A node is a cell of the lines that has not exactly two neighbours (and one cell of every ring). An edge joins two nodes
over a run of chain cells, or directly. Edge rows: columns A, B (nodes), BEGIN, END (run of chain cells from A to B).

Run the tests also with NUMBA_BOUNDSCHECK=1 (and a NUMBA_CACHE_DIR of its own) and with NUMBA_DISABLE_JIT=1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

A, B, BEGIN, END = range(4)
_ROW_STEP = (-1, -1, 0, 1, 1, 1, 0, -1)  # the eight neighbours in turn
_COL_STEP = (0, 1, 1, 1, 0, -1, -1, -1)
_FAR_AWAY = 1e30


@njit(cache=True, nogil=True)
def is_simple(line: Any, r: Any, c: Any) -> bool:
    """Whether taking this cell away neither cuts nor joins anything, and it is no end of a line: its neighbours in the
    set are two or more and hang together (8-connected), and one of its four sides is open."""
    count = 0
    crossings = 0
    for k in range(8):
        here = line[r + _ROW_STEP[k], c + _COL_STEP[k]]
        count += here
        # Yokoi's number of 8-connected components.
        if k % 2 == 0 and not here:
            first = line[r + _ROW_STEP[(k + 1) % 8], c + _COL_STEP[(k + 1) % 8]]
            second = line[r + _ROW_STEP[(k + 2) % 8], c + _COL_STEP[(k + 2) % 8]]
            crossings += first or second
    return count >= 2 and crossings == 1


@njit(cache=True, nogil=True)
def thin(line: Any, order: Any) -> None:
    """Take cells away, in this order, wherever they are simple; in place.

    order: cells of the lines as row * C + col, none of them on the border.
    """
    cols = line.shape[1]
    for _ in range(2):  # what an earlier cell held open may be simple now
        for i in range(order.size):
            r, c = order[i] // cols, order[i] % cols
            if line[r, c] and is_simple(line, r, c):
                line[r, c] = False


@njit(cache=True, nogil=True)
def neighbours(line: Any, r: Any, c: Any) -> Any:
    """How many of the eight are on the lines."""
    n = 0
    for k in range(8):
        n += line[r + _ROW_STEP[k], c + _COL_STEP[k]]
    return n


@njit(cache=True, nogil=True)
def find_nodes(line: Any, cells: Any, where: Any, node: Any) -> Any:
    """node: (N,) int32 out, row * C + col of the nodes; returns how many. cells: of the lines, as row * C + col."""
    cols = line.shape[1]
    n = 0
    for i in range(cells.size):
        r, c = cells[i] // cols, cells[i] % cols
        if line[r, c] and neighbours(line, r, c) != 2:
            node[n] = cells[i]
            n += 1
            where[r, c] = -n
    return n


@njit(cache=True, nogil=True)
def follow(
    line: Any, squared: Any, where: Any, node: Any, n: int, chain: Any, along: Any, edge: Any, measure: Any, at: Any
) -> None:  # fmt: skip
    """Edges of node n that are not known yet. at: (2,) int64, chain cells and edges so far; moved on.

    along: (K,) float64 out, length from A to each chain cell.  measure: (E, 2) float64 out, length and least squared
    distance, in cells.
    """
    cols = line.shape[1]
    r0, c0 = node[n] // cols, node[n] % cols
    for k in range(8):
        r, c = r0 + _ROW_STEP[k], c0 + _COL_STEP[k]
        if not line[r, c] or where[r, c] > 0:
            continue
        begin = at[0]
        length = math.hypot(r - r0, c - c0)
        least = min(squared[r0, c0], squared[r, c])
        before_r, before_c = r0, c0
        while where[r, c] == 0:
            chain[at[0]] = r * cols + c
            along[at[0]] = length
            at[0] += 1
            where[r, c] = at[0]
            next_r, next_c = r0, c0
            for j in range(8):
                rr, cc = r + _ROW_STEP[j], c + _COL_STEP[j]
                if line[rr, cc] and not (rr == before_r and cc == before_c):
                    next_r, next_c = rr, cc
            before_r, before_c = r, c
            length += math.hypot(next_r - r, next_c - c)
            r, c = next_r, next_c
            least = min(least, squared[r, c])
        other = -where[r, c] - 1
        if at[0] == begin and other <= n:
            continue  # side by side: told once
        e = at[1]
        edge[e, A], edge[e, B], edge[e, BEGIN], edge[e, END] = n, other, begin, at[0]
        measure[e, 0], measure[e, 1] = length, least
        at[1] += 1


@njit(cache=True, nogil=True)
def trace(
    line: Any, squared: Any, cells: Any, where: Any, node: Any, chain: Any, along: Any, edge: Any, measure: Any
) -> Any:  # fmt: skip
    """The graph of the lines; numbers of nodes, chain cells, edges. where: zero before."""
    cols = line.shape[1]
    nodes = find_nodes(line, cells, where, node)
    at = np.zeros(2, dtype=np.int64)
    for n in range(nodes):
        follow(line, squared, where, node, n, chain, along, edge, measure, at)
    for i in range(cells.size):  # rings
        r, c = cells[i] // cols, cells[i] % cols
        if line[r, c] and where[r, c] == 0:
            node[nodes] = cells[i]
            nodes += 1
            where[r, c] = -nodes
            follow(line, squared, where, node, nodes - 1, chain, along, edge, measure, at)
    return nodes, at[0], at[1]


@njit(cache=True, nogil=True)
def reach_line(
    squared: Any, where: Any, need2: int, start: int, goal: int, seen: Any, stamp: int, queue: Any, came: Any
) -> Any:
    """Breadth first from a cell, over cells with squared distance >= need2, to the first on a line, or to the goal.

    seen: (R, C) int32, cells marked `stamp` were met.  queue, came: (M,) int32 work: cells, and the place in the queue
    they were met from.  Returns the place in the queue of the cell found, -1 if there is none (or the queue is full).
    """
    rows, cols = squared.shape
    queue[0] = start
    came[0] = -1
    seen[start // cols, start % cols] = stamp
    head, tail = 0, 1
    while head < tail:
        cell = queue[head]
        r, c = cell // cols, cell % cols
        if cell == goal or where[r, c] != 0:
            return head
        for k in range(8):
            rr, cc = r + _ROW_STEP[k], c + _COL_STEP[k]
            if rr < 0 or rr >= rows or cc < 0 or cc >= cols or seen[rr, cc] == stamp or squared[rr, cc] < need2:
                continue
            if tail == queue.size:
                return -1
            seen[rr, cc] = stamp
            queue[tail] = rr * cols + cc
            came[tail] = head
            tail += 1
        head += 1
    return -1


@njit(cache=True, nogil=True)
def push(heap: Any, key: Any, size: Any, k: float, value: Any) -> None:
    """Onto a binary heap of (key, value), the least first. size: (1,) int64; what does not fit is a bug of ours."""
    i = size[0]
    size[0] += 1
    while i > 0:
        up = (i - 1) >> 1
        if key[up] <= k:
            break
        key[i], heap[i] = key[up], heap[up]
        i = up
    key[i], heap[i] = k, value


@njit(cache=True, nogil=True)
def pop(heap: Any, key: Any, size: Any) -> Any:
    """The value with the least key, taken off."""
    top = heap[0]
    size[0] -= 1
    n = size[0]
    k, value = key[n], heap[n]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= n:
            break
        if child + 1 < n and key[child + 1] < key[child]:
            child += 1
        if key[child] >= k:
            break
        key[i], heap[i] = key[child], heap[child]
        i = child
    key[i], heap[i] = k, value
    return top


@njit(cache=True, nogil=True)
def distances_from(source: Any, first: Any, link: Any, edge: Any, cost: Any, best: Any) -> None:
    """best: (N,) float32 out, shortest way from a node to each; huge where there is none."""
    nodes = first.size - 1
    heap = np.empty(link.size + 1, dtype=np.int32)
    key = np.empty(link.size + 1, dtype=np.float64)
    size = np.zeros(1, dtype=np.int64)
    done = np.zeros(nodes, dtype=np.bool_)
    best[:] = _FAR_AWAY
    best[source] = 0.0
    push(heap, key, size, 0.0, source)
    while size[0] > 0:
        n = pop(heap, key, size)
        if done[n]:
            continue
        done[n] = True
        for i in range(first[n], first[n + 1]):
            e = link[i]
            other = edge[e, B] if edge[e, A] == n else edge[e, A]
            reached = best[n] + cost[e]
            if reached < best[other]:
                best[other] = reached
                push(heap, key, size, reached, other)


@njit(cache=True, nogil=True)
def still_to_go(mark: Any, n: Any, node: Any, goal: Any, to_goal: Any) -> float:
    """No more than the way from node n to the goal: straight, or by the triangle of both and each landmark.

    goal: (2,) row, col.  to_goal: (L,) shortest way from each landmark.
    """
    bound = np.float32(0.0)
    for k in range(mark.shape[1]):
        bound = max(bound, abs(to_goal[k] - mark[n, k]))
    dr, dc = node[n, 0] - goal[0], node[n, 1] - goal[1]
    straight = math.sqrt(dr * dr + dc * dc)
    if bound > _FAR_AWAY / 2:  # nothing joins one of them with a landmark
        return straight
    by_marks = np.float64(0.9999 * bound)  # what 32 bits may have rounded up
    return by_marks if by_marks > straight else straight


@njit(cache=True, nogil=True)
def shortest_way(
    first: Any, link: Any, edge: Any, cost: Any, open_edge: Any, node: Any, mark: Any, seeds: Any, seed_cost: Any,
    ends: Any, end_cost: Any, goal: Any, via: Any, best: Any, state: Any, stamp: int, heap: Any, key: Any,
) -> Any:  # fmt: skip
    """A* over nodes. first, link: edges of node n are link[first[n]:first[n + 1]].  mark: (N, L) from distances_from.

    seeds, ends: nodes next to start and goal, with the way to or from there.  goal: (2,) row, col.
    via: (N,) int32 out, the edge by which a node was reached, -1 at seeds.  best (N,) float64, state (N,) int32, heap,
    key (edges and seeds): work; states of this search are stamp and stamp + 1, all others are less.
    Returns the last node and the cost, (-1, huge) if there is no way.
    """
    met, done = stamp, stamp + 1
    size = np.zeros(1, dtype=np.int64)
    to_goal = np.full(mark.shape[1], np.float32(_FAR_AWAY))
    for i in range(ends.size):
        for k in range(mark.shape[1]):
            to_goal[k] = min(to_goal[k], mark[ends[i], k] + np.float32(end_cost[i]))
    for i in range(seeds.size):
        n = seeds[i]
        if state[n] < met or seed_cost[i] < best[n]:
            best[n] = seed_cost[i]
            state[n] = met
            via[n] = -1
            push(heap, key, size, best[n] + still_to_go(mark, n, node, goal, to_goal), n)
    last, total = -1, _FAR_AWAY
    while size[0] > 0:
        if key[0] >= total:
            break
        n = pop(heap, key, size)
        if state[n] == done:
            continue
        state[n] = done
        for i in range(ends.size):
            if ends[i] == n and best[n] + end_cost[i] < total:
                last, total = n, best[n] + end_cost[i]
        for i in range(first[n], first[n + 1]):
            e = link[i]
            if not open_edge[e]:
                continue
            other = edge[e, B] if edge[e, A] == n else edge[e, A]
            reached = best[n] + cost[e]
            if state[other] < met or (state[other] == met and reached < best[other]):
                best[other] = reached
                state[other] = met
                via[other] = e
                push(heap, key, size, reached + still_to_go(mark, other, node, goal, to_goal), other)
    return last, total


@njit(cache=True, nogil=True)
def find_dead_ends(first: Any, link: Any, edge: Any, leads_out: Any) -> None:
    """leads_out: (N,) int32 out: of nodes from which all ways but one end blindly, that one edge; -1 of the others."""
    nodes = first.size - 1
    degree = np.empty(nodes, dtype=np.int32)
    stack = np.empty(nodes, dtype=np.int32)
    size = 0
    leads_out[:] = -1
    gone = np.zeros(edge.shape[0], dtype=np.bool_)
    for n in range(nodes):
        degree[n] = first[n + 1] - first[n]
        if degree[n] == 1:
            stack[size] = n
            size += 1
    while size > 0:
        size -= 1
        n = stack[size]
        for i in range(first[n], first[n + 1]):
            e = link[i]
            if gone[e] or degree[n] != 1:
                continue
            gone[e] = True
            leads_out[n] = e
            degree[n] = 0
            other = edge[e, B] if edge[e, A] == n else edge[e, A]
            degree[other] -= 1
            if degree[other] == 1:
                stack[size] = other
                size += 1


@njit(cache=True, nogil=True)
def open_edges(edge: Any, least: Any, need2: int, leads_out: Any, usable: Any) -> None:
    """usable: (E,) bool out: edges wide enough, without dead ends."""
    for e in range(edge.shape[0]):
        usable[e] = least[e] >= need2 and leads_out[edge[e, A]] != e and leads_out[edge[e, B]] != e


@njit(cache=True, nogil=True)
def open_ways_out(edge: Any, least: Any, need2: int, leads_out: Any, from_nodes: Any, usable: Any) -> None:
    """Open the ways that lead out of the dead ends in which these nodes lie, as far as they are wide enough."""
    for i in range(from_nodes.size):
        n = from_nodes[i]
        while leads_out[n] >= 0:
            e = leads_out[n]
            if usable[e] or least[e] < need2:
                break
            usable[e] = True
            n = edge[e, B] if edge[e, A] == n else edge[e, A]


@njit(cache=True, nogil=True)
def way_in_queue(queue: Any, came: Any, i: Any, cells: Any) -> Any:
    """The cells from the first of a search to the one in place i of its queue; how many. cells: (K,) int32 out."""
    n = 0
    while i >= 0:
        cells[n] = queue[i]
        n += 1
        i = came[i]
    cells[:n] = cells[:n][::-1].copy()
    return n


@njit(cache=True, nogil=True)
def joints(
    squared: Any, where: Any, node_cell: Any, edge: Any, chain: Any, along: Any, length: Any, cell: int, need2: int,
    nodes: Any, ways: Any,
) -> Any:  # fmt: skip
    """Nodes that a cell of the diagram leads to along its edge; how many, and its place in the chain (-1 at a node).

    nodes: (2,) int32, ways: (2,) float64 out, the length to there.
    """
    flat = squared.reshape(-1)
    at = where.reshape(-1)[cell]
    if at < 0:
        nodes[0], ways[0] = -at - 1, 0.0
        return 1, -1
    k = at - 1
    e = edge_of(edge, k)
    n = 0
    for side in range(2):
        end = edge[e, A] if side == 0 else edge[e, B]
        first, last = (edge[e, BEGIN], k) if side == 0 else (k, edge[e, END] - 1)
        wide = flat[node_cell[end]] >= need2
        for i in range(first, last + 1):
            wide = wide and flat[chain[i]] >= need2
        if wide:
            nodes[n], ways[n] = end, along[k] if side == 0 else length[e] - along[k]
            n += 1
    return n, k


@njit(cache=True, nogil=True)
def edge_of(edge: Any, k: Any) -> Any:
    """The edge that cell k of the chain is on."""
    low, high = 0, edge.shape[0]
    while high - low > 1:
        middle = (low + high) >> 1
        if edge[middle, BEGIN] <= k:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def cells_of_way(node: Any, edge: Any, chain: Any, via: Any, last: int, cells: Any, used: Any) -> Any:
    """The way that shortest_way found, backwards from its last node: numbers of cells and of edges written.

    node: (N,) cells of the nodes.  cells, used: out, long enough for all cells and edges.
    """
    k, m, n = 0, 0, last
    while True:
        cells[k] = node[n]
        k += 1
        e = via[n]
        if e < 0:
            return k, m
        used[m] = e
        m += 1
        if edge[e, A] == n:
            for i in range(edge[e, BEGIN], edge[e, END]):
                cells[k] = chain[i]
                k += 1
            n = edge[e, B]
        else:
            for i in range(edge[e, END] - 1, edge[e, BEGIN] - 1, -1):
                cells[k] = chain[i]
                k += 1
            n = edge[e, A]


@njit(cache=True, nogil=True)
def way_on_grid(
    squared: Any, need2: int, start: int, goal: int, top: int, left: int, rows: int, cols: int, cells: Any
) -> Any:
    """A* over the cells of a window, to the eight neighbours: for ends so near that the diagram is a detour.

    cells: out, long enough for the window, the way backwards from goal to start.  Returns how many, 0 if none.
    """
    width = squared.shape[1]
    best = np.full(rows * cols, np.float32(_FAR_AWAY))
    came = np.full(rows * cols, np.int8(-1))
    done = np.zeros(rows * cols, dtype=np.bool_)
    heap = np.empty(8 * rows * cols + 1, dtype=np.int32)
    key = np.empty(8 * rows * cols + 1, dtype=np.float64)
    size = np.zeros(1, dtype=np.int64)
    gr, gc = goal // width - top, goal % width - left
    first = (start // width - top) * cols + start % width - left
    best[first] = 0.0
    push(heap, key, size, 0.0, first)
    while size[0] > 0:
        here = pop(heap, key, size)
        if done[here]:
            continue
        done[here] = True
        r, c = here // cols, here % cols
        if r == gr and c == gc:
            n = 0
            while True:
                cells[n] = (r + top) * width + c + left
                n += 1
                k = came[r * cols + c]
                if k < 0:
                    return n
                r, c = r - _ROW_STEP[k], c - _COL_STEP[k]
        for k in range(8):
            rr, cc = r + _ROW_STEP[k], c + _COL_STEP[k]
            if rr < 0 or rr >= rows or cc < 0 or cc >= cols or squared[rr + top, cc + left] < need2:
                continue
            other = rr * cols + cc
            reached: Any = np.float32(best[here] + (1.41421356 if _ROW_STEP[k] != 0 and _COL_STEP[k] != 0 else 1.0))
            if reached < best[other] and not done[other]:
                best[other] = reached
                came[other] = k
                push(heap, key, size, reached + math.hypot(rr - gr, cc - gc), other)
    return 0


@njit(cache=True, nogil=True)
def sees(squared: Any, need: float, r0: float, c0: float, r1: float, c1: float) -> bool:
    """Whether the straight way between two points (in cells, a cell's centre at whole numbers) crosses only cells whose
    distance is at least `need`. Every cell that the line touches is looked at, but for those that are far enough from
    obstacles because one before them is farther still."""
    need2, far2 = need * need, (need + 3.4143) ** 2
    r, c = math.floor(r0 + 0.5), math.floor(c0 + 0.5)
    last_r, last_c = math.floor(r1 + 0.5), math.floor(c1 + 0.5)
    if squared[last_r, last_c] < need2:
        return False
    dr, dc = r1 - r0, c1 - c0
    length = math.sqrt(dr * dr + dc * dc)
    # How far along the line a row and a column take, and where it leaves those of this cell.
    per_r = length / abs(dr) if dr != 0.0 else _FAR_AWAY
    per_c = length / abs(dc) if dc != 0.0 else _FAR_AWAY
    step_r, step_c = (1 if dr > 0.0 else -1), (1 if dc > 0.0 else -1)
    leave_r = (0.5 + step_r * (r - r0)) * per_r if dr != 0.0 else _FAR_AWAY
    leave_c = (0.5 + step_c * (c - c0)) * per_c if dc != 0.0 else _FAR_AWAY
    on = 0.0
    while True:
        value = squared[r, c]
        if value < need2:
            return False
        if value > far2:
            # A cell's diagonal less, since it was entered up to that before it is left. Rounding may tell a line that
            # runs along a border of cells to leave at once, for ever: `on` never falls back.
            leave = max(min(leave_r, leave_c), on)
            t = leave + math.sqrt(value) - need - 2.8285
            if t >= length:
                return True
            if t > leave:
                on = t
                r, c = math.floor(r0 + t / length * dr + 0.5), math.floor(c0 + t / length * dc + 0.5)
                leave_r = (0.5 + step_r * (r - r0)) * per_r if dr != 0.0 else _FAR_AWAY
                leave_c = (0.5 + step_c * (c - c0)) * per_c if dc != 0.0 else _FAR_AWAY
                continue
        if min(leave_r, leave_c) >= length:
            return True
        if abs(leave_r - leave_c) < 1e-6:  # through a corner
            r, c = r + step_r, c + step_c
            leave_r, leave_c = leave_r + per_r, leave_c + per_c
        elif leave_r < leave_c:
            r, leave_r = r + step_r, leave_r + per_r
        else:
            c, leave_c = c + step_c, leave_c + per_c


@njit(cache=True, nogil=True)
def least_along(squared: Any, point: Any, n: int) -> Any:
    """Least squared distance of the cells that a way of n points crosses.

    Where obstacles are far, the way is followed in steps within which none can be nearer than the nearest so far.
    """
    least = np.int64(squared[math.floor(point[0, 0] + 0.5), math.floor(point[0, 1] + 0.5)])
    root = math.sqrt(least)
    for i in range(n - 1):
        r0, c0, r1, c1 = point[i, 0], point[i, 1], point[i + 1, 0], point[i + 1, 1]
        dr, dc = r1 - r0, c1 - c0
        length = math.sqrt(dr * dr + dc * dc)
        r, c = math.floor(r0 + 0.5), math.floor(c0 + 0.5)
        per_r = length / abs(dr) if dr != 0.0 else _FAR_AWAY
        per_c = length / abs(dc) if dc != 0.0 else _FAR_AWAY
        step_r, step_c = (1 if dr > 0.0 else -1), (1 if dc > 0.0 else -1)
        leave_r = (0.5 + step_r * (r - r0)) * per_r if dr != 0.0 else _FAR_AWAY
        leave_c = (0.5 + step_c * (c - c0)) * per_c if dc != 0.0 else _FAR_AWAY
        on = 0.0
        while True:
            value = np.int64(squared[r, c])
            if value < least:
                least, root = value, math.sqrt(value)
            leave = max(min(leave_r, leave_c), on)
            far = root + 3.4143
            if value > far * far:  # as in `sees`, of which `on` is known, too
                t = leave + math.sqrt(value) - root - 2.8285
                if t >= length:
                    break
                if t > leave:
                    on = t
                    r, c = math.floor(r0 + t / length * dr + 0.5), math.floor(c0 + t / length * dc + 0.5)
                    leave_r = (0.5 + step_r * (r - r0)) * per_r if dr != 0.0 else _FAR_AWAY
                    leave_c = (0.5 + step_c * (c - c0)) * per_c if dc != 0.0 else _FAR_AWAY
                    continue
            if min(leave_r, leave_c) >= length:
                break
            if abs(leave_r - leave_c) < 1e-6:
                r, c = r + step_r, c + step_c
                leave_r, leave_c = leave_r + per_r, leave_c + per_c
            elif leave_r < leave_c:
                r, leave_r = r + step_r, leave_r + per_r
            else:
                c, leave_c = c + step_c, leave_c + per_c
        least = min(least, np.int64(squared[math.floor(r1 + 0.5), math.floor(c1 + 0.5)]))
        root = math.sqrt(least)
    return least


@njit(cache=True, nogil=True)
def clear_at(squared: Any, r: float, c: float) -> float:
    """Distance from a point to obstacles' cells; on the border of cells, what holds for one of them holds."""
    top, bottom = math.floor(r + 0.5 - 1e-9), math.floor(r + 0.5 + 1e-9)
    left, right = math.floor(c + 0.5 - 1e-9), math.floor(c + 0.5 + 1e-9)
    most = squared[top, left]
    if bottom != top or right != left:
        most = max(max(most, squared[top, right]), max(squared[bottom, left], squared[bottom, right]))
    return math.sqrt(most)


@njit(cache=True, nogil=True)
def describe(
    squared: Any, corner: Any, n: int, spacing: float, cell_m: float, row0: float, col0: float, less: float,
    pose: Any, clear: Any,
) -> Any:  # fmt: skip
    """Poses along a way of n corners, no farther apart than spacing (cells): how many, the way's length and the least
    clearance of all cells that it crosses, both in metres.

    row0, col0: of the grid on the map, cells.  less: cells that clearance is less than a distance between centres.
    pose: (K, 3) out, x, y in metres and yaw along the way.  clear: (K,) out, metres.  What does not fit is counted.
    """
    m, total, yaw = 0, 0.0, 0.0
    for i in range(n):
        parts, dr, dc = 1, 0.0, 0.0
        if i < n - 1:
            dr, dc = corner[i + 1, 0] - corner[i, 0], corner[i + 1, 1] - corner[i, 1]
            length = math.hypot(dr, dc)
            parts = int(length / spacing) + 1
            yaw = math.atan2(dr, dc)
            total += length
        for k in range(parts):
            if m < pose.shape[0]:
                r, c = corner[i, 0] + dr * k / parts, corner[i, 1] + dc * k / parts
                pose[m, 0], pose[m, 1], pose[m, 2] = (c + 0.5 + col0) * cell_m, (r + 0.5 + row0) * cell_m, yaw
                clear[m] = max(clear_at(squared, r, c) - less, 0.0) * cell_m
            m += 1
    least = max(math.sqrt(least_along(squared, corner, n)) - less, 0.0) * cell_m
    return m, total * cell_m, least
