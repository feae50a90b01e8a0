"""Regions from floor plans, and queries on graphs: the book's figures, shapely, networkx (S41)."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from mapping.topology.queries import (
    NoRoute,
    cut_off,
    nearest_of,
    route,
    routes_via,
    single_connections,
    ways_round,
    ways_round_nodes,
)
from mapping.topology.regions import RegionMap, decompose, decomposition_tree, floor_plan, room_graph

F64 = NDArray[np.float64]
Box = list[tuple[float, float]]


def box(x0: float, y0: float, x1: float, y1: float) -> Box:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


# Fig. 5.32: three rooms beside each other, joined by a passageway; walls 1 m thick, doors 0.9 m wide.
ROOMS = [box(0, 0, 4, 4), box(5, 0, 9, 4), box(10, 0, 14, 4), box(0, 5, 14, 7)]
DOORS = [box(1.5, 4, 2.4, 5), box(6.5, 4, 7.4, 5), box(11.5, 4, 12.4, 5)]
FURNITURE = [box(1, 1, 2, 2), box(6, 1, 8, 1.5)]


def check(found: RegionMap, free: MultiPolygon) -> None:
    """Regions are convex, free, and are all of free space, once; passages are shared edges."""
    pieces = [Polygon(region.corners_m) for region in found.regions]
    assert sum(piece.area for piece in pieces) == pytest.approx(free.area, rel=1e-9)
    assert shapely.union_all(pieces).symmetric_difference(free).area == pytest.approx(0.0, abs=1e-7)
    for piece, region in zip(pieces, found.regions):
        assert piece.exterior.is_ccw
        assert free.buffer(1e-6).covers(piece)
        corners = region.corners_m
        way, last = np.roll(corners, -1, axis=0) - corners, corners - np.roll(corners, 1, axis=0)
        turn = np.arctan2(last[:, 0] * way[:, 1] - last[:, 1] * way[:, 0], np.sum(last * way, axis=1))
        assert turn.min() > -math.radians(2.1)  # to the right by the tolerance at most
    for passage in found.passages:
        edge = shapely.LineString(passage.ends_m)
        assert edge.length == pytest.approx(passage.width_m)
        assert passage.a < passage.b
        for number in (passage.a, passage.b):
            assert pieces[number].boundary.buffer(1e-7).covers(edge)
    shared = {
        (a, b)
        for a, b in itertools.combinations(range(len(pieces)), 2)
        if pieces[a].boundary.intersection(pieces[b].boundary).length > 1e-6
    }
    assert {(passage.a, passage.b) for passage in found.passages} == shared


def test_three_rooms_of_the_book() -> None:
    """Fig. 5.33 and 5.34: the obstacles make rings of regions, each door is a single connection."""
    free = floor_plan([*ROOMS, *DOORS], FURNITURE)
    found = decompose(free)
    check(found, free)
    tree = decomposition_tree(found.graph())
    sizes = sorted(len(part.members) for part in tree.subgraphs)
    assert len(tree.subgraphs) == 7  # three rooms, the passageway, three doorways
    assert len(tree.joints) == 6
    assert sizes[:5] == [1, 1, 1, 1, 1]
    assert min(sizes[5:]) >= 4  # around an obstacle
    graph = nx.Graph([joint[:2] for joint in tree.joints])
    assert nx.is_tree(graph)
    centres = [tuple(found.regions[n].centre_m for n in part.members) for part in tree.subgraphs]
    hub = max(graph.degree, key=lambda pair: pair[1])[0]
    assert graph.degree[hub] == 3
    assert all(y > 5.0 for _, y in centres[hub])


def test_rooms_of_the_book() -> None:
    rooms = room_graph(decompose(floor_plan([*ROOMS, *DOORS], FURNITURE)), door_m=0.95)
    areas = sorted(round(rooms.nodes[n]["area_m2"], 6) for n in rooms)
    assert areas == [0.9, 0.9, 0.9, 15.0, 15.0, 16.0, 28.0]
    assert all(rooms.edges[edge]["width_m"] == pytest.approx(0.9) for edge in rooms.edges)
    assert nx.is_tree(rooms)
    with pytest.raises(ValueError, match="door_m"):
        room_graph(decompose(floor_plan(ROOMS)), door_m=-1.0)


def test_convex_room_is_one_region() -> None:
    found = decompose(floor_plan([box(0, 0, 4, 3)]))
    assert (len(found.regions), len(found.passages)) == (1, 0)
    assert found.regions[0].centre_m == (2.0, 1.5)
    assert found.graph().number_of_edges() == 0


def test_shortest_edges_become_borders() -> None:
    """An hour-glass is cut at its waist."""
    found = decompose(Polygon([(0, 0), (4, 0), (2.2, 2), (4, 4), (0, 4), (1.8, 2)]))
    assert len(found.regions) == 2
    assert found.passages[0].width_m == pytest.approx(0.4)


def test_parts_that_do_not_hang_together() -> None:
    free = floor_plan([box(0, 0, 1, 1), box(2, 0, 3, 1)])
    found = decompose(free)
    check(found, free)
    assert decomposition_tree(found.graph()).joints == ()


def test_measured_plan_is_smoothed_first() -> None:
    random = np.random.default_rng(3)
    outline = np.array([(x, 0.0) for x in np.arange(0, 6, 0.1)] + [(6.0, 4.0), (3.0, 4.0), (3.0, 2.0), (0.0, 2.0)])
    rough = floor_plan([outline + random.uniform(-0.02, 0.02, outline.shape)])
    assert len(decompose(rough, simplify_m=0.06).regions) == 2
    assert len(decompose(rough).regions) > 10


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(0, 11)] * 2, *[st.integers(1, 4)] * 2, st.integers(0, 3)), max_size=6),
    st.lists(st.tuples(*[st.integers(0, 11)] * 2, *[st.integers(3, 8)] * 2), min_size=1, max_size=4),
)
def test_any_plan(obstacles: list[tuple[int, int, int, int, int]], rooms: list[tuple[int, int, int, int]]) -> None:
    """Boxes and slanted ones, overlapping as they like, on a grid: collinear corners and touching edges abound."""

    def slanted(x: int, y: int, w: int, h: int, slant: int) -> Box:
        return [(x, y), (x + w, y + 0.25 * slant), (x + w, y + h), (x, y + h)]

    try:
        free = floor_plan([box(x, y, x + w, y + h) for x, y, w, h in rooms], [slanted(*entry) for entry in obstacles])
    except ValueError:
        return  # nothing is left
    found = decompose(free)
    check(found, free)
    assert nx.number_connected_components(found.graph()) == len(free.geoms)


@pytest.mark.parametrize(
    "outline",
    [[(0, 0), (1, 1)], [(0, 0), (1, math.nan), (1, 1)], [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 0), (1, 1), (2, 2)]],
)
def test_bad_outlines(outline: list[tuple[float, ...]]) -> None:
    with pytest.raises(ValueError):
        floor_plan([outline])


def test_too_large_and_broken_plans() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 2500, endpoint=False)
    with pytest.raises(ValueError, match="simplify_m"):
        decompose(floor_plan([np.stack((np.cos(angle), np.sin(angle)), axis=-1)]))
    with pytest.raises(ValueError, match="valid"):
        decompose(Polygon([(0, 0), (3, 3), (3, 0), (0, 2)]))
    with pytest.raises(ValueError, match="no free space"):
        decompose(Polygon())


# --- queries


@pytest.fixture
def town() -> nx.Graph[str]:
    """A-C-B, A-D-B (longer), B-E a single line, F alone."""
    graph: nx.Graph[str] = nx.Graph()
    for a, b, length in [("A", "C", 1.0), ("C", "B", 1.0), ("A", "D", 2.0), ("D", "B", 2.0), ("B", "E", 5.0)]:
        graph.add_edge(a, b, length_m=length)
    graph.add_node("F")
    return graph


def test_the_questions_of_the_book(town: nx.Graph[str]) -> None:
    found = route(town, "A", "E")
    assert (found.nodes, found.length_m, found.between) == (("A", "C", "B", "E"), 7.0, ("C", "B"))
    assert {stop: way.length_m for stop, way in routes_via(town, "A", "B", ["C", "D", "F"]).items()} == {
        "C": 2.0,
        "D": 4.0,
    }
    assert route(town, "A", "B", via=["E", "D"]).nodes == ("A", "C", "B", "E", "B", "D", "B")
    round_edges = ways_round(town, found)
    assert round_edges["A", "C"] is not None
    assert round_edges["A", "C"].nodes == ("A", "D", "B", "E")
    assert round_edges["B", "E"] is None
    assert {stop: way is not None for stop, way in ways_round_nodes(town, found).items()} == {"C": True, "B": False}
    assert cut_off(town, "A", edges=[("E", "B")]) == {"E"}
    assert cut_off(town, "A", nodes=["B"]) == {"E"}
    assert cut_off(town, "A", nodes=["C"]) == set()
    assert cut_off(town, "A", edges=[("A", "C"), ("B", "D")]) == {"B", "C", "E"}
    assert single_connections(town) == [("B", "E")]
    assert nearest_of(town, "E", ["A", "D", "F"]).nodes == ("E", "B", "C", "A")


def test_what_cannot_be_answered_says_why(town: nx.Graph[str]) -> None:
    with pytest.raises(NoRoute, match="no way from A to F"):
        route(town, "A", "F")
    with pytest.raises(NoRoute, match="no way from A to E without B - E"):
        route(town, "A", "E", avoid_edges=[("B", "E")])
    with pytest.raises(NoRoute, match="any of F"):
        nearest_of(town, "A", ["F"])
    with pytest.raises(KeyError, match="no node X"):
        route(town, "A", "X")
    with pytest.raises(KeyError, match="no edge A - B"):
        cut_off(town, "A", edges=[("A", "B")])
    town.edges["A", "C"]["length_m"] = math.nan
    with pytest.raises(ValueError, match="length nan"):
        route(town, "A", "B")


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 9), st.integers(0, 20))
def test_routes_and_cuts_are_those_of_networkx(seed: int, nodes: int, edges: int) -> None:
    random = np.random.default_rng(seed)
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(range(nodes))
    for _ in range(edges):
        a, b = (int(n) for n in random.integers(0, nodes, 2))
        if a != b:
            graph.add_edge(a, b, length_m=float(random.integers(1, 4)))
    avoided = {int(n) for n in random.integers(1, nodes, 2)} - {0, nodes - 1}
    left = nx.Graph(graph)
    left.remove_nodes_from(avoided)
    try:
        found = route(graph, 0, nodes - 1, avoid_nodes=avoided)
    except NoRoute:
        assert not nx.has_path(left, 0, nodes - 1)
    else:
        ways = list(nx.all_shortest_paths(left, 0, nodes - 1, weight="length_m"))
        assert found.length_m == nx.shortest_path_length(left, 0, nodes - 1, weight="length_m")
        assert list(found.nodes) == min(ways)
        for edge, other in ways_round(graph, found).items():
            without = nx.Graph(graph)
            without.remove_edges_from(e for e in list(without.edges) if set(e) == set(edge))
            assert (other is not None) == nx.has_path(without, 0, nodes - 1)
    assert cut_off(graph, 0, nodes=avoided) == {
        n for n in graph if n not in avoided and nx.has_path(graph, 0, n) and not nx.has_path(left, 0, n)
    }
    tree = decomposition_tree(graph)
    assert sorted(n for part in tree.subgraphs for n in part.members) == list(graph)
    joined: nx.Graph[int] = nx.Graph()
    joined.add_nodes_from(range(len(tree.subgraphs)))
    joined.add_edges_from(joint[:2] for joint in tree.joints)
    assert nx.is_forest(joined)
    assert joined.number_of_edges() == len(tree.joints)
    for part in tree.subgraphs:
        inside = nx.Graph(graph.subgraph(part.members))
        assert nx.is_connected(inside)
        assert not list(nx.bridges(inside))
