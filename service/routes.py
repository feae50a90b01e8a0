"""The call @rpc/route: ways over a topological map, round what fails, and what is cut off (the questions of S41).

Any map answers that can give its nodes and passages (`Ways`): regions, places, rooms. Two rooms may have two doors, so
that passages are named by what they join and a number; the caller knows them by the pair of nodes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any, TypeGuard

from service.rpc import CallRefused

if TYPE_CHECKING:
    import networkx as nx

NodeId = int | str
Point = tuple[float, float]

NEAR_M = 1.0
_LIST_MAX = 100
_ARGUMENTS = ("map", "from", "to", "via", "either", "avoid", "avoid_edges")


@dataclass(frozen=True, slots=True)
class Passage:
    """From one node to another. at: where, None if the map has no common frame."""

    a: NodeId
    b: NodeId
    at: Point | None
    length_m: float | None = None
    """Between the nodes; None: straight from node to passage to node."""


@dataclass(frozen=True, slots=True)
class Ways:
    """A topological map as routes need it.

    kind: regions, rooms or places.  at: where each node is, None without a common frame.  through: a route goes from
    passage to passage and touches a node's own place only at its stops (rooms are large; convex regions small).
    nearest: the node at a position, CallRefused if there is none.  names: of nodes, by which they may be told as well.
    """

    kind: str
    at: Mapping[NodeId, Point | None]
    passages: Sequence[Passage]
    through: bool = False
    nearest: Callable[[Point, str], NodeId] | None = None
    names: Mapping[str, NodeId] = field(default_factory=dict)


def route_answer(ways: Ways, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Answer one call.

    arguments: "from" and "to", nodes or positions [x, y]; "via" (a list, in order), "either" (a list: a route over
    each of them), "avoid" (nodes), "avoid_edges" (pairs of nodes: every passage between them). Without "to": what can
    not be reached from "from" once "avoid" and "avoid_edges" have failed.
    Answers kind, nodes, length_m, stops, positions, alternatives (for each passage of the route a way round it, or
    null and what would be cut off), either. CallRefused says what is wrong, or that there is no way.
    """
    from mapping.topology.queries import NoRoute

    unknown = set(arguments) - set(_ARGUMENTS)
    if unknown:
        raise CallRefused(f"unknown argument {sorted(unknown)[0]!r}; there are {', '.join(_ARGUMENTS)}")
    asked = _Asked(ways)
    start = asked.place(arguments.get("from"), "from")
    avoid = {asked.node(each, "avoid") for each in _list(arguments, "avoid")}
    shut = asked.shut([_pair(each) for each in _list(arguments, "avoid_edges")])
    if arguments.get("to") is None:
        if not avoid and not shut:
            raise CallRefused('"to" is where the route ends; without it say what fails: "avoid" or "avoid_edges"')
        return {"kind": ways.kind, "cut_off": asked.cut_off(start, avoid, shut)}
    goal = asked.place(arguments["to"], "to")
    via = [asked.place(each, "via") for each in _list(arguments, "via")]
    try:
        found = asked.route(start, goal, via, avoid, shut)
    except NoRoute as error:
        raise CallRefused(str(error.args[0])) from error
    answer: dict[str, Any] = {"kind": ways.kind, **asked.told(found)}
    answer["alternatives"] = [asked.way_round(found, k) for k in range(len(found.passages))]
    if "either" in arguments:
        answer["either"] = [
            {"via": each, **asked.over(start, goal, asked.place(each, "either"), avoid, shut)}
            for each in _list(arguments, "either")
        ]
    return answer


@dataclass(frozen=True, slots=True)
class _Found:
    """A route: the nodes it leads over, the passages between them by number, its corners."""

    nodes: tuple[NodeId, ...]
    passages: tuple[int, ...]
    length_m: float
    positions: list[list[float]] | None


class _Asked:
    """One call's view of the map."""

    def __init__(self, ways: Ways) -> None:
        self._ways = ways
        self._has_places = all(at is not None for at in ways.at.values())

    # --- what the caller names

    def place(self, given: object, name: str) -> NodeId:
        """A node by id, name or position."""
        match given:
            case [x, y] if _is_number(x) and _is_number(y) and self._ways.nearest is not None:
                return self._ways.nearest((float(x), float(y)), name)
        return self.node(given, name)

    def node(self, given: object, name: str) -> NodeId:
        """A node by id or name."""
        if isinstance(given, int | str) and not isinstance(given, bool):
            node = self._ways.names.get(given, given) if isinstance(given, str) else given
            if node in self._ways.at:
                return node
            raise CallRefused(f'"{name}": no node {given} in the map of {self._ways.kind}; it has {self._known()}')
        position = " or a position [x, y]" if self._ways.nearest is not None else ""
        raise CallRefused(f'"{name}" is a node of the map of {self._ways.kind}{position}, got {json.dumps(given)}')

    def shut(self, pairs: Sequence[tuple[object, object]]) -> set[int]:
        """Numbers of the passages between pairs of nodes."""
        found: set[int] = set()
        for a, b in pairs:
            ends = {self.node(a, "avoid_edges"), self.node(b, "avoid_edges")}
            between = {k for k, each in enumerate(self._ways.passages) if {each.a, each.b} == ends}
            if not between:
                raise CallRefused(f'"avoid_edges": no edge {a} - {b} in the map of {self._ways.kind}')
            found |= between
        return found

    def _known(self) -> str:
        from mapping.topology.queries import rank

        names = [str(node) for node in sorted(self._ways.at, key=rank)]
        return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "") or "none yet"

    # --- ways

    def route(
        self, start: NodeId, goal: NodeId, via: Sequence[NodeId], avoid: Collection[NodeId], shut: Collection[int]
    ) -> _Found:
        """NoRoute if there is none. Start, goal and stops on the way are never avoided."""
        from mapping.topology.queries import NoRoute, route

        stops = [start, *via, goal]
        graph = self._graph(set(avoid) - set(stops), shut)
        try:
            found = route(graph, _own(start), _own(goal), via=[_own(each) for each in via])
        except NoRoute:
            raise NoRoute(f"no way from {start} to {goal}" + _without(avoid, shut, self._ways.passages)) from None
        crossed = [(a, b) for a, b in pairwise(found.nodes) if a[1] is not None and a[1] == b[1]]
        nodes = (start, *(b[0] for _, b in crossed))
        corners = [self._at(each) for each in found.nodes]
        positions = None
        if self._has_places:
            positions = [_rounded(at) for k, at in enumerate(corners) if at is not None and corners[k - 1 : k] != [at]]
        return _Found(nodes, tuple(a[1] for a, _ in crossed), found.length_m, positions)

    def route_or_none(
        self, start: NodeId, goal: NodeId, via: Sequence[NodeId], avoid: Collection[NodeId], shut: Collection[int]
    ) -> _Found | None:
        """The same, None if there is none."""
        from mapping.topology.queries import NoRoute

        try:
            return self.route(start, goal, via, avoid, shut)
        except NoRoute:
            return None

    def cut_off(self, start: NodeId, avoid: Collection[NodeId], shut: Collection[int]) -> list[NodeId]:
        """Nodes that cannot be reached any more from a start."""
        from mapping.topology.queries import rank

        before, after = self._reached(start, (), ()), self._reached(start, set(avoid) - {start}, shut)
        return sorted(before - after - set(avoid), key=rank)

    def way_round(self, found: _Found, k: int) -> dict[str, Any]:
        """If the k-th passage of a route fails."""
        start, goal, number = found.nodes[0], found.nodes[-1], found.passages[k]
        other = self.route_or_none(start, goal, (), (), {number})
        told: dict[str, Any] = {
            "edge": [found.nodes[k], found.nodes[k + 1]],
            "nodes": None if other is None else list(other.nodes),
            "length_m": None if other is None else round(other.length_m, 3),
            "cut_off": [] if other is not None else self.cut_off(start, (), {number}),
        }
        at = self._ways.passages[number].at
        return told if at is None else {**told, "at": _rounded(at)}

    def over(
        self, start: NodeId, goal: NodeId, node: NodeId, avoid: Collection[NodeId], shut: Collection[int]
    ) -> dict[str, Any]:
        """The route over one node, if there is one."""
        found = self.route_or_none(start, goal, [node], avoid, shut)
        return {"nodes": None} if found is None else self.told(found)

    def told(self, found: _Found) -> dict[str, Any]:
        """For the answer."""
        told: dict[str, Any] = {
            "nodes": list(found.nodes),
            "length_m": round(found.length_m, 3),
            "stops": max(len(found.nodes) - 2, 0),
        }
        if found.positions is not None:
            told["positions"] = found.positions
        return told

    def _reached(self, start: NodeId, avoid: Collection[NodeId], shut: Collection[int]) -> set[NodeId]:
        import networkx as nx

        graph = self._graph(avoid, shut)
        return {node for node, _ in nx.node_connected_component(graph, _own(start))}

    def _graph(self, avoid: Collection[NodeId], shut: Collection[int]) -> nx.Graph[Any]:
        """Of points: a node's own place (node, None), and each end of a passage (node, its number)."""
        import networkx as nx

        graph: nx.Graph[Any] = nx.Graph()
        graph.add_nodes_from(_own(node) for node in self._ways.at if node not in avoid)
        of: dict[NodeId, list[int]] = {}
        for k, each in enumerate(self._ways.passages):
            if k in shut or each.a == each.b or {each.a, each.b} & set(avoid):
                continue
            graph.add_edge((each.a, k), (each.b, k), length_m=0.0)
            for node in (each.a, each.b):
                graph.add_edge(_own(node), (node, k), length_m=self._length_m(node, each))
                of.setdefault(node, []).append(k)
        for node, numbers in of.items() if self._ways.through else ():
            for k, other in combinations(numbers, 2):
                a, b = self._ways.passages[k].at, self._ways.passages[other].at
                assert a is not None
                assert b is not None
                graph.add_edge((node, k), (node, other), length_m=math.dist(a, b))
        return graph

    def _length_m(self, node: NodeId, passage: Passage) -> float:
        if passage.length_m is not None:
            return 0.5 * passage.length_m
        at = self._ways.at[node]
        assert at is not None
        assert passage.at is not None
        return math.dist(at, passage.at)

    def _at(self, point: tuple[NodeId, int | None]) -> Point | None:
        node, number = point
        return self._ways.at[node] if number is None else self._ways.passages[number].at


def _own(node: NodeId) -> tuple[NodeId, None]:
    """A node's own place in the graph."""
    return node, None


def nearest_of(at: Mapping[NodeId, Point | None], point: Point, name: str, what: str) -> NodeId:
    """The node whose own place is nearest; CallRefused if that is farther than NEAR_M."""
    away = [(math.dist(place, point), str(node), node) for node, place in at.items() if place is not None]
    if not away:
        raise CallRefused(f'"{name}": there is no {what} yet')
    distance, _, node = min(away)
    if distance > NEAR_M:
        raise CallRefused(
            f'"{name}": no {what} within {NEAR_M:g} m of {list(point)}; the nearest is {distance:.1f} m away'
        )
    return node


def _without(avoid: Collection[NodeId], shut: Collection[int], passages: Sequence[Passage]) -> str:
    names = [str(each) for each in avoid] + [f"{passages[k].a} - {passages[k].b}" for k in shut]
    return f" without {', '.join(sorted(set(names)))}" if names else ""


def _pair(given: object) -> tuple[object, object]:
    if not isinstance(given, list) or len(given) != 2:
        raise CallRefused(f'"avoid_edges" is a list of pairs of nodes, got {json.dumps(given)} in it')
    return given[0], given[1]


def _list(arguments: Mapping[str, Any], name: str) -> list[object]:
    given = arguments.get(name, [])
    if not isinstance(given, list) or len(given) > _LIST_MAX:
        raise CallRefused(f'"{name}" is a list of at most {_LIST_MAX}')
    return given


def _is_number(value: object) -> TypeGuard[float]:
    """Of a size that may be reckoned with; not NaN, nor an int that no float holds."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e9 <= value <= 1e9


def _rounded(point: Any) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in point]
