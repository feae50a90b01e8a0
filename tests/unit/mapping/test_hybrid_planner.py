"""Ways on the Voronoi diagram against ways on the grid, found with networkx."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from mapping.hybrid.corners import packed
from mapping.hybrid.planner import HALF_CELLS, NoWayError, Planner, Way, graph_of
from mapping.hybrid.voronoi import VoronoiGrid
from mapping.kernels import paths as kernels
from mapping.kernels.rooms import connected
from mapping.kernels.sight import measure_room, sees_open

Bools = NDArray[np.bool_]
CELL_M = 0.05


def place(row: int, col: int) -> tuple[float, float]:
    return (col + 0.5) * CELL_M, (row + 0.5) * CELL_M


def cluttered(seed: int, rows: int = 90, cols: int = 120) -> Bools:
    """Two halls, a wall with two openings between them, boxes everywhere."""
    random = np.random.default_rng(seed)
    free = np.zeros((rows, cols), dtype=np.bool_)
    free[2:-2, 2:-2] = True
    free[:, cols // 2] = False
    for at in random.integers(4, rows - 14, size=2):
        free[at : at + 9, cols // 2] = True
    for _ in range(12):
        r, c = random.integers(2, rows - 8), random.integers(2, cols - 8)
        free[r : r + random.integers(1, 6), c : c + random.integers(1, 6)] = False
    return free


def grid_lengths(grid: VoronoiGrid, clearance_m: float, start: tuple[int, int]) -> dict[tuple[int, int], float]:
    """Metres from start to every cell that can be reached with the clearance, by steps to the eight neighbours."""
    allowed = grid.field.squared >= (clearance_m / CELL_M + HALF_CELLS) ** 2
    graph: nx.Graph[tuple[int, int]] = nx.Graph()
    for r, c in np.argwhere(allowed).tolist():
        graph.add_node((r, c))
        for rr, cc in ((r + 1, c - 1), (r + 1, c), (r + 1, c + 1), (r, c + 1)):
            if rr < allowed.shape[0] and 0 <= cc < allowed.shape[1] and allowed[rr, cc]:
                graph.add_edge((r, c), (rr, cc), weight=CELL_M * math.hypot(rr - r, cc - c))
    lengths: dict[tuple[int, int], float] = nx.single_source_dijkstra_path_length(graph, start)
    return lengths


def check_way(way: Way, grid: VoronoiGrid, clearance_m: float) -> None:
    """Length, yaw and spacing agree; points all along the way are as far from the obstacles' squares as is told."""
    steps = np.diff(way.poses[:, :2], axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    assert way.length_m == pytest.approx(lengths.sum())
    assert lengths.max(initial=0.0) <= 0.5 + 1e-9
    turn = np.arctan2(steps[:, 1], steps[:, 0]) - way.poses[:-1, 2]
    assert np.allclose(np.remainder(turn + 1.0, 2.0 * math.pi), 1.0)
    assert way.least_clearance_m >= clearance_m - 1e-9
    assert way.least_clearance_m <= way.clearance_m.min() + 1e-9
    squares = (np.argwhere(grid.field.obstacle)[:, ::-1] + 0.5) * CELL_M
    for (a, b), told in zip(zip(way.poses[:-1, :2], way.poses[1:, :2]), way.clearance_m):
        t = np.linspace(0.0, 1.0, 2 + int(4 * np.hypot(*(b - a)) / CELL_M))[:, None]
        beyond = np.maximum(np.abs((a + t * (b - a))[:, None, :] - squares) - 0.5 * CELL_M, 0.0)
        away = np.hypot(beyond[..., 0], beyond[..., 1]).min(axis=1)
        assert away.min() >= way.least_clearance_m - 1e-9
        assert away[0] >= told - 1e-9


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("clearance_m", [0.0, 0.1])
def test_ways_exist_where_the_grid_has_one_and_are_about_as_short(seed: int, clearance_m: float) -> None:
    grid = VoronoiGrid(cluttered(seed), gap_cells=1.0)
    planner = Planner(grid, CELL_M)
    random = np.random.default_rng(seed)
    places = np.argwhere(grid.field.squared >= (clearance_m / CELL_M + HALF_CELLS) ** 2)
    start = tuple(int(v) for v in places[random.integers(len(places))])
    lengths = grid_lengths(grid, clearance_m, (start[0], start[1]))
    ratios = []
    for goal in places[random.integers(len(places), size=12)].tolist():
        expected = lengths.get((goal[0], goal[1]))
        if expected is None:
            with pytest.raises(NoWayError, match="no way"):
                planner.plan(place(*start), place(*goal), clearance_m=clearance_m)
            continue
        plan = planner.plan(place(*start), place(*goal), clearance_m=clearance_m)
        check_way(plan.way, grid, clearance_m)
        for other in plan.alternatives:
            check_way(other, grid, clearance_m)
            assert other.length_m >= plan.way.length_m
        assert plan.way.poses[0, :2] == pytest.approx(place(*start))
        assert plan.way.poses[-1, :2] == pytest.approx(place(*goal))
        ratios.append(plan.way.length_m / max(expected, CELL_M))
    assert np.median(ratios) <= 1.0  # any direction is allowed, on the grid only eight
    assert max(ratios) <= 1.03


def wild(seed: int, rows: int = 150, cols: int = 200) -> Bools:
    """Free space of no shape at all: rough edges, narrow gaps, islands, pieces that nothing joins."""
    random = np.random.default_rng(seed)
    rough = ndimage.gaussian_filter(random.standard_normal((rows, cols)), random.uniform(2.0, 6.0))
    free = rough + 0.1 * rough.std() * random.standard_normal((rows, cols)) > -0.5 * rough.std()
    free[[0, -1]] = free[:, [0, -1]] = False
    return np.asarray(free)


@pytest.mark.parametrize("seed", range(12))
def test_ways_through_the_wild_keep_the_clearance_and_are_about_as_short(seed: int) -> None:
    grid = VoronoiGrid(wild(seed), gap_cells=1.0)
    planner = Planner(grid, CELL_M)
    random = np.random.default_rng(seed)
    clearance_m = (0.0, 0.05, 0.12)[seed % 3]
    places = np.argwhere(grid.field.squared >= (clearance_m / CELL_M + HALF_CELLS) ** 2)
    ratios = []
    for _ in range(3):
        start = tuple(int(v) for v in places[random.integers(len(places))])
        lengths = grid_lengths(grid, clearance_m, (start[0], start[1]))
        for goal in places[random.integers(len(places), size=8)].tolist():
            expected = lengths.get((goal[0], goal[1]))
            if expected is None:
                with pytest.raises(NoWayError, match="no way"):
                    planner.plan(place(*start), place(*goal), clearance_m=clearance_m)
                continue
            plan = planner.plan(place(*start), place(*goal), clearance_m=clearance_m, alternatives=seed % 2)
            for way in (plan.way, *plan.alternatives):
                check_way(way, grid, clearance_m)
            ratios.append(plan.way.length_m / max(expected, CELL_M))
    assert np.median(ratios) <= 1.0
    assert np.mean(np.array(ratios) > 1.03) <= 0.2  # rougher than any map, at clearances of some cells


def test_where_corners_know_no_way_the_diagram_does() -> None:
    grid = VoronoiGrid(cluttered(2), gap_cells=1.0)
    planner = Planner(grid, CELL_M)
    places = np.argwhere(grid.field.squared >= (0.1 / CELL_M + HALF_CELLS) ** 2).tolist()
    ends = places[0], places[-1]
    with_corners = planner.plan(place(*ends[0]), place(*ends[1]), clearance_m=0.1)
    planner._tables_for(0.1 / CELL_M + HALF_CELLS).corners.forget_links()
    without = planner.plan(place(*ends[0]), place(*ends[1]), clearance_m=0.1)
    assert with_corners.way.length_m <= without.way.length_m <= 1.1 * with_corners.way.length_m


def test_corners_see_what_they_are_joined_with() -> None:
    grid = VoronoiGrid(cluttered(4), gap_cells=1.0)
    planner, need = Planner(grid, CELL_M), 2.5
    corners = planner._tables_for(need).corners
    assert len(corners.pair) > len(corners.place) > 20
    for a, b in corners.pair.tolist():
        (r0, c0), (r1, c1) = corners.place[a].tolist(), corners.place[b].tolist()
        assert kernels.sees(grid.field.squared, need, r0, c0, r1, c1)


def test_two_openings_give_an_alternative() -> None:
    free = np.zeros((100, 120), dtype=np.bool_)
    free[2:-2, 2:-2] = True
    free[:, 60] = False
    free[10:22, 60] = free[75:90, 60] = True
    plan = Planner(VoronoiGrid(free), CELL_M).plan(place(30, 20), place(30, 100), clearance_m=0.1)
    assert len(plan.alternatives) == 1
    assert plan.way.poses[:, 1].min() < 22 * CELL_M
    assert plan.alternatives[0].poses[:, 1].max() > 75 * CELL_M


@pytest.mark.parametrize("seed", range(5))
def test_an_alternative_winds_about_no_furniture(seed: int) -> None:
    """It is as short as the way is when the other opening is shut; boxes near both ends tempt it to go round them on
    the side where the first does not."""
    random = np.random.default_rng(seed)
    free = np.zeros((100, 160), dtype=np.bool_)
    free[2:-2, 2:-2] = True
    free[:, 80] = False
    for left in (10, 115):
        for r, c in random.integers((15, left), (85, left + 30), size=(8, 2)).tolist():
            free[r : r + 4, c : c + 4] = False
    free[10:22, 80] = free[78:90, 80] = True
    shut = free.copy()
    shut[78:90, 80] = False
    other = free.copy()
    other[10:22, 80] = False
    ends = place(45, 6), place(45, 153)
    plan = Planner(VoronoiGrid(free), CELL_M).plan(*ends, clearance_m=0.1)
    lengths = [Planner(VoronoiGrid(f), CELL_M).plan(*ends, clearance_m=0.1).way.length_m for f in (shut, other)]
    assert plan.way.length_m <= 1.03 * min(lengths)
    assert len(plan.alternatives) >= 1
    assert plan.alternatives[0].length_m <= 1.03 * max(lengths)


def test_clearance_closes_a_narrow_door() -> None:
    free = np.zeros((60, 90), dtype=np.bool_)
    free[2:-2, 2:-2] = True
    free[:, 45] = False
    free[20:30, 45] = True  # half a metre
    planner = Planner(VoronoiGrid(free), CELL_M)
    assert planner.plan(place(10, 10), place(10, 80), clearance_m=0.15).way.least_clearance_m >= 0.15
    with pytest.raises(NoWayError, match=r"0\.25 m of clearance"):
        planner.plan(place(10, 10), place(10, 80), clearance_m=0.25)


def test_ends_must_be_free_and_say_how_free_they_are() -> None:
    free = np.ones((60, 60), dtype=np.bool_)
    free[30, 30] = False
    planner = Planner(VoronoiGrid(free), CELL_M, row0=-100, col0=40)
    with pytest.raises(NoWayError, match=r"start .* not known to be free"):
        planner.plan((0.0, 0.0), (3.0, -4.0))
    inside = (40 * CELL_M + 1.0, -100 * CELL_M + 1.0)
    with pytest.raises(NoWayError, match=r"goal .* not known to be free"):
        planner.plan(inside, (40 * CELL_M + 30.5 * CELL_M, -100 * CELL_M + 30.5 * CELL_M))
    with pytest.raises(NoWayError, match=r"has 0\.\d\d m of clearance, asked are 0\.40 m"):
        planner.plan(inside, (40 * CELL_M + 0.3, -100 * CELL_M + 1.0), clearance_m=0.4)
    with pytest.raises(ValueError, match="no position"):
        planner.plan((math.nan, 0.0), inside)
    with pytest.raises(ValueError, match="no position"):
        planner.plan(inside, (1e308, 0.0))
    with pytest.raises(ValueError, match="clearance_m"):
        planner.plan(inside, inside, clearance_m=-0.1)
    still = planner.plan(inside, inside)
    assert still.way.length_m == 0.0


def test_the_graph_is_the_diagram_line_by_line() -> None:
    grid = VoronoiGrid(cluttered(3))
    graph = graph_of(grid)
    cells = np.concatenate((graph.chain, graph.node_cell))
    assert len(np.unique(cells)) == len(cells)
    assert grid.axis.ravel()[cells].all()
    for e, (a, b, begin, end) in enumerate(graph.edge.tolist()):
        run = np.concatenate(([graph.node_cell[a]], graph.chain[begin:end], [graph.node_cell[b]]))
        rows, cols = np.divmod(run, grid.shape[1])
        steps = np.hypot(np.diff(rows), np.diff(cols))
        assert (steps <= math.sqrt(2.0) + 1e-9).all()
        assert graph.length[e] == pytest.approx(steps.sum())
        assert graph.least_squared[e] == grid.field.squared.ravel()[run].min()
    whole: nx.MultiGraph[int] = nx.MultiGraph()
    whole.add_nodes_from(range(len(graph.node)))
    whole.add_edges_from((int(a), int(b)) for a, b, _, _ in graph.edge)
    # Thinning keeps what hangs together: as many pieces, and as many rings, as the diagram has.
    label = np.empty(grid.shape, dtype=np.int32)
    assert nx.number_connected_components(whole) == connected(grid.axis, True, label)
    for n in np.flatnonzero(graph.leads_out >= 0).tolist():
        assert n in graph.edge[graph.leads_out[n], :2]


def test_shortest_way_is_that_of_networkx() -> None:
    graph = graph_of(VoronoiGrid(cluttered(5)))
    reference: nx.Graph[int] = nx.Graph()
    for e, (a, b, _, _) in enumerate(graph.edge.tolist()):
        known = reference.get_edge_data(a, b, {"weight": math.inf})["weight"]
        reference.add_edge(a, b, weight=min(known, float(graph.chord[e])))
    random, usable = np.random.default_rng(0), np.ones(len(graph.edge), dtype=np.bool_)
    via = np.empty(len(graph.node), dtype=np.int32)
    best, state, stamp = np.empty(len(graph.node)), np.zeros(len(graph.node), dtype=np.int32), 0
    heap, key = np.empty(len(graph.link) + 1, dtype=np.int32), np.empty(len(graph.link) + 1)
    lengths = dict(nx.all_pairs_dijkstra_path_length(reference))
    for a, b in random.integers(len(graph.node), size=(40, 2)).tolist():
        stamp += 2
        last, total = kernels.shortest_way(
            graph.first, graph.link, graph.edge, graph.chord, usable, graph.node, graph.mark,
            np.array([a], dtype=np.int32), np.zeros(1), np.array([b], dtype=np.int32), np.zeros(1),
            graph.node[b].astype(np.float64), via, best, state, stamp, heap, key,
        )  # fmt: skip
        if b in lengths.get(a, {}):
            assert (last, total) == (b, pytest.approx(lengths[a][b]))
        else:
            assert last == -1


def sight_of(squared: NDArray[np.int32], need: float) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    room = np.empty(squared.shape, dtype=np.uint8)
    measure_room(squared, need, room)
    return packed(room), packed(room.T)


@pytest.mark.parametrize("need", [math.sqrt(2.0), 3.3])
def test_sight_by_bits_is_that_by_distances(need: float) -> None:
    """And neither overlooks a cell that the line crosses."""
    grid = VoronoiGrid(cluttered(6))
    squared = grid.field.squared
    sight = sight_of(squared, need)
    random = np.random.default_rng(1)
    places = np.argwhere(squared >= need * need)
    seen = 0
    for a, b in random.integers(len(places), size=(3000, 2)).tolist():
        (r0, c0), (r1, c1) = (places[i] + random.uniform(-0.49, 0.49, 2) for i in (a, b))
        told = sees_open(*sight, r0, c0, r1, c1)
        assert told == kernels.sees(squared, need, r0, c0, r1, c1)
        t = np.linspace(0.0, 1.0, 4000)
        cells = np.floor(np.stack((r0 + t * (r1 - r0), c0 + t * (c1 - c0)), axis=-1) + 0.5).astype(int)
        least = squared[cells[:, 0], cells[:, 1]].min()
        if told:
            assert least >= need * need
            assert kernels.least_along(squared, np.array([[r0, c0], [r1, c1]]), 2) <= least
        seen += told
    assert 100 < seen < 2900


def test_tables_of_many_clearances_are_let_go() -> None:
    planner = Planner(VoronoiGrid(cluttered(3)), CELL_M)
    lengths = [planner.plan(place(20, 20), place(60, 30), clearance_m=0.01 * k).way.length_m for k in range(8)]
    assert len(planner._tables) <= 4
    assert planner.plan(place(20, 20), place(60, 30), clearance_m=0.0).way.length_m == lengths[0]


def test_sight_along_the_borders_of_cells_comes_to_an_end() -> None:
    """Where a line that leaves its row at once, by rounding, went on from the same place for ever."""
    free = np.zeros((60, 200), dtype=np.bool_)
    free[2:58, 2:198] = True
    squared = VoronoiGrid(free).field.squared
    sight = sight_of(squared, 3.0)
    for lean in (0.0, 1e-17, -1e-15, 1e-12, -1e-9, 1e-6):
        for at in (20.5, 30.0, 30.5):
            for a, b in ((10.0, 180.5), (180.5, 10.0), (10.5, 180.5)):
                assert sees_open(*sight, at, a, at + lean, b)
                assert kernels.sees(squared, 3.0, at, a, at + lean, b)
    tall = np.ascontiguousarray(squared.T)
    sight = sight_of(tall, 3.0)
    for at in (20.5, 30.0, 30.5):
        for a, b in ((10.0, 180.5), (180.5, 10.0)):
            assert sees_open(*sight, a, at, b, at)
            assert kernels.sees(tall, 3.0, a, at, b, at)


def test_a_way_along_a_border_of_cells_lies_in_one_row_of_them() -> None:
    """It was measured by the row before, too, which the way does not cross."""
    free = np.ones((30, 40), dtype=np.bool_)
    free[14, 10:30] = False
    squared = VoronoiGrid(free).field.squared
    for way in (np.array([[15.5, 8.0], [15.5, 32.0]]), np.array([[15.5, 32.0], [15.5, 8.0]])):
        assert sees_open(*sight_of(squared, 2.0), *way[0], *way[1])
        assert kernels.sees(squared, 2.0, *way[0], *way[1])
        assert kernels.least_along(squared, way, 2) == 4
        assert not sees_open(*sight_of(squared, 2.1), *way[0], *way[1])
        assert not kernels.sees(squared, 2.1, *way[0], *way[1])


def test_a_way_of_more_poses_than_there_is_room_for() -> None:
    """Work arrays hold 1,024 poses at first; both ways of planning tell all of a longer way."""
    free = np.zeros((20, 150), dtype=np.bool_)
    free[2:-2, 2:-2] = True
    ends = (17.5, 47.5), (700.0, 52.5)
    for alternatives in (0, 1):
        plan = Planner(VoronoiGrid(free), 5.0).plan(*ends, alternatives=alternatives)
        assert len(plan.way.poses) == len(plan.way.clearance_m) > 1024
        assert plan.way.length_m == pytest.approx(math.dist(*ends))
        assert plan.way.poses[0, :2] == pytest.approx(ends[0])
        assert plan.way.poses[-1, :2] == pytest.approx(ends[1])


def test_space_whose_diagram_has_no_node_is_planned_in_or_refused() -> None:
    """As a robot's first grids: nothing free yet, a slit of one cell, a disc about it, equally far from all walls."""
    nothing = np.zeros((40, 40), dtype=np.bool_)
    slit, disc = nothing.copy(), np.hypot(*(np.indices(nothing.shape) - 20)) < 15
    slit[20, 5:35] = True
    for free in (nothing, slit):
        planner = Planner(VoronoiGrid(free), CELL_M)
        planner.ready_for(0.2)
        with pytest.raises(NoWayError):
            planner.plan(place(20, 10), place(20, 30), clearance_m=0.1)
    grid = VoronoiGrid(disc)
    planner = Planner(grid, CELL_M)
    planner.ready_for(0.1)
    way = planner.plan(place(20, 10), place(22, 30), clearance_m=0.1).way
    check_way(way, grid, 0.1)
    assert way.length_m == pytest.approx(math.dist(place(20, 10), place(22, 30)), rel=0.03)
