"""What a topological map is asked: routes, ways round, what is cut off (S41). Any undirected networkx graph will do.

Edges have a `length_m`; where one has none it counts as 1, so that bare graphs give fewest steps. Of routes that are
equally long the one whose nodes sort first is returned: the same graph gives the same answer, in whatever order it was
built. Nodes are named by anything hashable; numbers sort as numbers, all else by its text.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import networkx as nx

Node = Any  # hashable
EdgeName = tuple[Node, Node]
LENGTH = "length_m"


class NoRoute(ValueError):  # noqa: N818 - says what it is
    """There is no way; the text says from where to where, and what was to be avoided."""


@dataclass(frozen=True, slots=True)
class Route:
    """nodes: from start to goal, both included.  length_m: sum over its edges."""

    nodes: tuple[Node, ...]
    length_m: float

    @property
    def between(self) -> tuple[Node, ...]:
        """The stops on the way: all but start and goal."""
        return self.nodes[1:-1]

    @property
    def edges(self) -> tuple[EdgeName, ...]:
        """In order."""
        return tuple(pairwise(self.nodes))


def route(
    graph: nx.Graph[Any],
    start: Node,
    goal: Node,
    *,
    via: Sequence[Node] = (),
    avoid_nodes: Collection[Node] = (),
    avoid_edges: Collection[EdgeName] = (),
) -> Route:
    """The shortest way from start to goal through the nodes `via` in their order, without what is to be avoided.

    KeyError for a node that is not in the graph, or an edge to be avoided that is not; NoRoute if there is none.
    Start, goal and via are never avoided. ValueError for a negative length.
    """
    points = [start, *via, goal]
    _check_nodes(graph, [*points, *avoid_nodes])
    _check_edges(graph, avoid_edges)
    closed = set(avoid_nodes) - set(points)
    shut = {frozenset(edge) for edge in avoid_edges}
    nodes, length = [start], 0.0
    for a, b in pairwise(points):
        leg = _shortest(graph, a, b, closed, shut)
        if leg is None:
            without = f" without {_listed([*closed, *avoid_edges])}" if closed or shut else ""
            raise NoRoute(f"no way from {a} to {b}{without}")
        nodes += leg.nodes[1:]
        length += leg.length_m
    return Route(tuple(nodes), length)


def routes_via(graph: nx.Graph[Any], start: Node, goal: Node, either: Iterable[Node]) -> dict[Node, Route]:
    """ "Can I also go via C or via D?": the shortest route through each, of those there are one through."""
    found = {}
    for stop in either:
        try:
            found[stop] = route(graph, start, goal, via=[stop])
        except NoRoute:
            continue
    return found


def ways_round(graph: nx.Graph[Any], along: Route) -> dict[EdgeName, Route | None]:
    """For each edge of a route, the way from its start to its goal if just that edge fails; None if there is none."""
    start, goal = along.nodes[0], along.nodes[-1]
    return {edge: _or_none(graph, start, goal, avoid_edges=[edge]) for edge in along.edges}


def ways_round_nodes(graph: nx.Graph[Any], along: Route) -> dict[Node, Route | None]:
    """The same for each stop between start and goal."""
    start, goal = along.nodes[0], along.nodes[-1]
    return {node: _or_none(graph, start, goal, avoid_nodes=[node]) for node in along.between}


def cut_off(
    graph: nx.Graph[Any], origin: Node, *, nodes: Collection[Node] = (), edges: Collection[EdgeName] = ()
) -> set[Node]:
    """Which nodes can no longer be reached from the origin when these nodes and edges fail, the failed not counted.

    Nodes that could not be reached before are not cut off. KeyError for what is not in the graph.
    """
    _check_nodes(graph, [origin, *nodes])
    _check_edges(graph, edges)
    before = nx.node_connected_component(graph, origin)
    left: nx.Graph[Any] = nx.Graph(graph)
    left.remove_edges_from(edges)
    left.remove_nodes_from(set(nodes) - {origin})
    return set(before) - set(nx.node_connected_component(left, origin)) - set(nodes)


def nearest_of(graph: nx.Graph[Any], start: Node, targets: Collection[Node]) -> Route:
    """ "Where is the entrance?": the route to whichever of the targets is nearest. NoRoute if none can be reached."""
    _check_nodes(graph, [start, *targets])
    routes = [found for target in targets if (found := _or_none(graph, start, target)) is not None]
    if not routes:
        raise NoRoute(f"no way from {start} to any of {_listed(targets)}")
    return min(routes, key=lambda found: (found.length_m, [rank(node) for node in found.nodes]))


def single_connections(graph: nx.Graph[Any]) -> list[EdgeName]:
    """The edges whose failure cuts something off (bridges), sorted."""
    edges = ((a, b) if rank(a) <= rank(b) else (b, a) for a, b in nx.bridges(graph))
    return sorted(edges, key=lambda edge: (rank(edge[0]), rank(edge[1])))


def rank(node: Node) -> tuple[bool, float, str]:
    """For sorting nodes of any kind."""
    is_number = isinstance(node, (int, float))
    return (not is_number, float(node) if isinstance(node, (int, float)) else 0.0, str(node))


def _or_none(graph: nx.Graph[Any], start: Node, goal: Node, **avoid: Any) -> Route | None:
    try:
        return route(graph, start, goal, **avoid)
    except NoRoute:
        return None


def _shortest(
    graph: nx.Graph[Any], start: Node, goal: Node, closed: set[Node], shut: set[frozenset[Node]]
) -> Route | None:
    """Dijkstra's; the heap is ordered by length, then by the names along the way."""
    waiting: list[tuple[float, tuple[tuple[bool, float, str], ...], tuple[Node, ...]]] = [
        (0.0, (rank(start),), (start,))
    ]
    done: set[Node] = set()
    while waiting:
        length, names, nodes = heapq.heappop(waiting)
        here = nodes[-1]
        if here in done:
            continue
        if here == goal:
            return Route(nodes, length)
        done.add(here)
        for other, facts in graph.adj[here].items():
            if other in done or other in closed or frozenset((here, other)) in shut:
                continue
            step = float(facts.get(LENGTH, 1.0))
            if not step >= 0.0:
                raise ValueError(f"edge {here} - {other} has length {step}")
            heapq.heappush(waiting, (length + step, (*names, rank(other)), (*nodes, other)))
    return None


def _check_nodes(graph: nx.Graph[Any], nodes: Iterable[Node]) -> None:
    for node in nodes:
        if node not in graph:
            raise KeyError(f"no node {node}; there are {_listed(graph.nodes)}")


def _check_edges(graph: nx.Graph[Any], edges: Iterable[EdgeName]) -> None:
    for a, b in edges:
        if not graph.has_edge(a, b):
            raise KeyError(f"no edge {a} - {b}")


def _listed(items: Iterable[object]) -> str:
    names = sorted(" - ".join(map(str, item)) if isinstance(item, tuple) else str(item) for item in items)
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
