"""The map-fixed grid: statuses of ranges, aging, bounds, what is published and what is kept (S26 to S28)."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.grids.beam_model import Beams, beams_of_scan
from mapping.grids.occupancy import FREE, OCCUPIED, PARTLY_FREE, UNKNOWN, CellRules, OccupancyGrid, SonarRules
from mapping.grids.tiles import TILE, Window
from mapping.scan import Scan

F64 = NDArray[np.float64]
BEARING = np.radians(np.arange(-30.0, 30.1, 0.5))
AHEAD = len(BEARING) // 2
HERE = Pose2(0.025, 0.025, 0.0)


def ranges(value: float) -> F64:
    return np.full(BEARING.size, value)


def look(grid: OccupancyGrid, range_m: F64, pose: Pose2 = HERE, **options: bool | float) -> None:
    clear = bool(options.get("clear_no_return", True))
    near = float(options.get("range_min_m", 0.0))
    grid.insert_scan(pose, BEARING, range_m, range_max_m=5.0, clear_no_return=clear, range_min_m=near)


def state(grid: OccupancyGrid, x: float, y: float = 0.025) -> int:
    return int(grid.state_at([(x, y)])[0])


# ------------------------------------------------------------------------------------------------- statuses of ranges


def test_a_wall_is_occupied_before_it_is_free_behind_unknown() -> None:
    grid = OccupancyGrid()
    look(grid, 2.0 / np.cos(BEARING))
    assert state(grid, 2.03) == OCCUPIED
    assert state(grid, 1.0) == FREE
    assert state(grid, 2.2) == UNKNOWN
    assert state(grid, -1.0) == UNKNOWN
    assert grid.state_at([(1e300, 0.0), (np.nan, 0.0), (np.inf, 1.0)]).tolist() == [UNKNOWN] * 3


@pytest.mark.parametrize("nothing", [np.nan, -np.inf, -1.0, 5.0001, 65.535, 9999.0])
def test_what_is_no_measurement_frees_nothing(nothing: float) -> None:
    grid = OccupancyGrid()
    look(grid, ranges(nothing))
    assert grid.patch().cells.size == 0


def test_no_return_frees_up_to_the_range_if_the_device_can_be_trusted() -> None:
    grid, bearing = OccupancyGrid(), np.radians(np.arange(-95.0, 95.1, 0.5))  # half a turn of silence is believed
    nothing = np.full(bearing.size, np.inf)
    grid.insert_scan(HERE, bearing, nothing, range_max_m=5.0, clear_no_return=False)
    assert grid.patch().cells.size == 0
    grid.insert_scan(HERE, bearing, nothing, range_max_m=5.0)
    assert state(grid, 4.9) == FREE
    assert state(grid, 5.06) == UNKNOWN
    assert np.all(grid.patch().cells <= 0)


def test_too_close_is_an_obstacle_at_the_shortest_range_and_frees_nothing() -> None:
    grid = OccupancyGrid()
    look(grid, ranges(-np.inf), range_min_m=0.3)
    assert state(grid, 0.33) == OCCUPIED
    assert np.all((grid.patch().cells == -1) | (grid.patch().cells == 100))


def test_range_zero_is_real() -> None:
    grid = OccupancyGrid()
    look(grid, ranges(0.0))
    assert state(grid, 0.03) == OCCUPIED


def test_a_missing_beam_leaves_its_surroundings_unknown() -> None:
    grid = OccupancyGrid()
    seen = ranges(4.0)
    seen[AHEAD - 2 : AHEAD + 3] = np.nan
    look(grid, seen)
    beside = 3.0 * math.sin(math.radians(6.0))
    assert state(grid, 3.0) == UNKNOWN
    assert state(grid, 3.0, 0.025 + beside) == FREE
    assert state(grid, 3.0, 0.025 - beside) == FREE


def test_a_single_beam_frees_its_line_only() -> None:
    grid = OccupancyGrid()
    grid.insert_scan(HERE, np.array([0.0]), np.array([1.0]), range_max_m=5.0)
    cells = grid.patch().cells
    assert cells.shape == (1, 21)
    assert cells[0].tolist() == [0] * 20 + [100]


def test_beams_are_cut_at_use_max() -> None:
    grid = OccupancyGrid(use_max_m=1.5)
    look(grid, 2.0 / np.cos(BEARING))
    assert state(grid, 1.4) == FREE
    assert state(grid, 1.6) == UNKNOWN
    assert state(grid, 2.03) == UNKNOWN


def test_beams_far_apart_free_only_what_they_pass() -> None:
    """Two degrees apart at 4 m: 14 cm; with fill_gap_m = 0.05 wedges end at 1.43 m."""
    bearing = np.radians(np.arange(-20.0, 20.1, 2.0))
    grid = OccupancyGrid(fill_gap_m=0.05)
    grid.insert_scan(HERE, bearing, np.full(bearing.size, 4.0), range_max_m=5.0)
    middle = math.radians(1.0)
    for distance, expected in ((1.2, FREE), (3.8, UNKNOWN)):
        assert state(grid, 0.025 + distance * math.cos(middle), 0.025 + distance * math.sin(middle)) == expected
    assert state(grid, 3.8) == FREE


# -------------------------------------------------------------------------------------------------- evidence over time


def test_partly_free_is_between_free_and_occupied() -> None:
    grid = OccupancyGrid()
    for hit in (True, False):
        grid.insert_cells([(0, 0)] if hit else [], [] if hit else [(0, 0)])
    assert grid.probability_at([(0.01, 0.01)])[0] == 0.5
    assert grid.state_at([(0.01, 0.01)])[0] == PARTLY_FREE
    assert grid.patch().cells.tolist() == [[50]]


@pytest.mark.parametrize("model", ["counters", "log-odds"])
def test_a_moved_obstacle_disappears_and_a_new_one_appears(model: str) -> None:
    grid = OccupancyGrid(model="counters" if model == "counters" else "log-odds", rules=CellRules(count_limit=32))
    wall, open_space = 2.0 / np.cos(BEARING), 4.0 / np.cos(BEARING)
    for _ in range(500):
        look(grid, wall)
    assert state(grid, 2.03) == OCCUPIED
    for _ in range(96):
        look(grid, open_space)
    assert state(grid, 2.03) == FREE
    for _ in range(96):
        look(grid, wall)
    assert state(grid, 2.03) == OCCUPIED


def test_decay_forgets_down_to_unknown() -> None:
    for grid in (OccupancyGrid(), OccupancyGrid(model="log-odds")):
        for _ in range(10):
            look(grid, 2.0 / np.cos(BEARING))
        ratio = grid.probability_at([(2.03, 0.025)])[0]
        grid.decay()
        assert grid.probability_at([(2.03, 0.025)])[0] >= 0.8 * ratio
        for _ in range(16):
            grid.decay()
        assert grid.patch().cells.size == 0
        assert any(np.all(change.cells == -1) for change in grid.take_changes()) or grid.take_changes() == []


def test_clear_forgets_everything_and_says_so() -> None:
    grid = OccupancyGrid()
    look(grid, 2.0 / np.cos(BEARING))
    grid.take_changes()
    grid.clear()
    assert grid.patch().cells.size == 0
    assert {int(v) for change in grid.take_changes() for v in np.unique(change.cells)} == {-1}


# ---------------------------------------------------------------------------------------------------- bounds and input


def test_a_full_pool_leaves_the_rest_unknown_and_counts() -> None:
    grid = OccupancyGrid(max_tiles=1)
    grid.insert_cells([], [(0, 0)])
    grid.insert_scan(HERE, BEARING, 20.0 / np.cos(BEARING), range_max_m=30.0)
    assert grid.refused_tiles > 0
    assert grid.state_at([(1.0, 0.025), (20.03, 0.025), (10.0, 0.025)]).tolist() == [FREE, UNKNOWN, UNKNOWN]
    rows, cols = np.nonzero(grid.patch(whole_tiles=True).cells >= 0)
    assert rows.size
    assert cols.size
    assert grid.patch(whole_tiles=True).cells.shape == (TILE, TILE)
    again = grid.patch().cells
    grid.insert_scan(Pose2(50.0, 50.0), BEARING, ranges(2.0), range_max_m=5.0)
    assert np.array_equal(grid.patch().cells, again)


def test_a_scan_absurdly_far_away_is_refused_and_counted() -> None:
    grid = OccupancyGrid()
    look(grid, ranges(2.0))
    before = grid.patch()
    look(grid, ranges(2.0), Pose2(2e7, -2e7))
    assert grid.refused_insertions == 1
    assert np.array_equal(grid.patch().cells, before.cells)


def test_a_map_far_from_its_origin_works() -> None:
    """Such as UTM coordinates."""
    near, far = OccupancyGrid(resolution_m=0.125), OccupancyGrid(resolution_m=0.125)
    look(near, 2.0 / np.cos(BEARING), Pose2(0.0371, 0.0213, 0.3))
    look(far, 2.0 / np.cos(BEARING), Pose2(5.0e5 + 0.0371, 5.4e6 + 0.0213, 0.3))
    assert np.array_equal(near.patch().cells, far.patch().cells)
    assert far.patch().col0 - near.patch().col0 == 4_000_000


def test_a_long_drive_takes_tiles_only_where_something_was_seen() -> None:
    grid = OccupancyGrid()
    for k in range(60):
        look(grid, ranges(2.0), Pose2(20.0 * k, -3.0 * k))
    assert 60 <= len(list(grid.tiles())) <= 240
    assert grid.refused_insertions == grid.refused_tiles == 0


@pytest.mark.parametrize(
    ("bearing", "range_m", "pose", "range_max_m"),
    [
        (BEARING, ranges(1.0)[:-1], HERE, 5.0),
        (BEARING[None], ranges(1.0)[None], HERE, 5.0),
        (BEARING * np.nan, ranges(1.0), HERE, 5.0),
        (BEARING, ranges(1.0), Pose2(math.nan, 0.0), 5.0),
        (BEARING, ranges(1.0), Pose2(0.0, math.inf), 5.0),
        (BEARING, ranges(1.0), Pose2(0.0, 0.0, math.nan), 5.0),
        (BEARING, ranges(1.0), HERE, math.nan),
        (BEARING, ranges(1.0), HERE, -1.0),
        (BEARING, ranges(1.0), HERE, math.inf),
        (BEARING, ranges(1.0), HERE, 1e6),
        (BEARING[:0], ranges(1.0)[:0], Pose2(math.nan, 0.0), 5.0),
    ],
)
def test_input_that_is_no_scan_is_refused_and_changes_nothing(
    bearing: F64, range_m: F64, pose: Pose2, range_max_m: float
) -> None:
    grid = OccupancyGrid()
    with pytest.raises(ValueError, match=r"."):
        grid.insert_scan(pose, bearing, range_m, range_max_m=range_max_m)
    assert grid.patch().cells.size == 0


def test_an_empty_scan_is_nothing() -> None:
    grid = OccupancyGrid()
    grid.insert_scan(HERE, BEARING[:0], BEARING[:0], range_max_m=5.0)
    grid.insert_cells([], [])
    grid.insert_beams(Beams(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.bool_), np.zeros(0, np.bool_)))
    assert grid.patch().cells.size == 0
    assert grid.take_changes() == []
    assert list(grid.tiles()) == []


def test_scans_with_more_beams_than_the_work_arrays_hold() -> None:
    bearing = np.linspace(-3.1, 3.1, 40_000)
    rng = np.random.default_rng(3)
    grid = OccupancyGrid()
    grid.insert_scan(HERE, bearing, rng.uniform(0.0, 30.0, bearing.size), range_max_m=30.0)
    grid.insert_scan(HERE, bearing[::400], rng.uniform(0.0, 30.0, 100), range_max_m=30.0, fill="lines")
    hits, misses = grid.counts_at([(0.1, 0.1)])
    assert (int(hits[0]), int(misses[0])) != (0, 0)


@pytest.mark.parametrize(
    "rules",
    [
        {"count_limit": 1},
        {"count_limit": 255},
        {"free_below": 0.0},
        {"free_below": 0.7},
        {"occupied_from": 1.1},
        {"hit_log_odds": 0.0},
        {"miss_log_odds": -1.0},
        {"lowest_log_odds": 0.5},
        {"highest_log_odds": 9.0},
    ],
)
def test_rules_that_make_no_sense_are_refused(rules: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"."):
        CellRules(**rules)  # type: ignore[arg-type]


def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="model"):
        OccupancyGrid(model="both")  # type: ignore[arg-type]
    for option in ({"resolution_m": 0.0}, {"max_tiles": 0}, {"fill_gap_m": -1.0}, {"use_max_m": 0.0}):
        with pytest.raises(ValueError, match=r"."):
            OccupancyGrid(**option)
    with pytest.raises(ValueError, match="votes"):
        SonarRules(echo_votes=4)


def test_cells_of_wrong_shape_or_kind_are_refused() -> None:
    grid = OccupancyGrid()
    for bad in ([(0.5, 1.0)], [1, 2], [(1, 2, 3)]):
        with pytest.raises(ValueError, match="cells"):
            grid.insert_cells(bad, [])
    with pytest.raises(ValueError, match="far"):
        grid.insert_cells([(1 << 50, 0)], [])


def test_a_cell_listed_as_hit_and_free_is_a_hit() -> None:
    grid = OccupancyGrid()
    grid.insert_cells([(3, 4), (3, 4)], [(3, 4), (3, 5), (3, 5)])
    assert [k.tolist() for k in grid.counts_at([(0.21, 0.16), (0.26, 0.16)])] == [[1, 0], [0, 1]]


def test_a_sensor_turning_fast_does_not_smear_the_wall() -> None:
    """A sweep while turning at 2 rad/s: de-skewed the wall lies where it is, taken from one pose it does not."""
    n, period = 541, 0.05
    bearing = np.radians(np.linspace(-60.0, 60.0, n))
    yaw = np.linspace(0.0, 2.0 * period, n)
    range_m = 3.0 / np.cos(bearing + yaw)
    range_m[range_m > 20.0] = np.inf
    scan = Scan(0, period / n * 1e9, bearing, range_m, 0.05, 20.0)
    poses = np.stack((np.full(n, 0.01), np.full(n, 0.02), yaw), axis=-1)
    straight, smeared = OccupancyGrid(), OccupancyGrid()
    straight.insert_beams(beams_of_scan(scan, poses))
    smeared.insert_beams(beams_of_scan(scan, poses[0]))
    columns = []
    for grid in (straight, smeared):
        patch = grid.patch()
        columns.append(set((np.nonzero(patch.cells == 100)[1] + patch.col0).tolist()))
    assert columns[0] == {60}
    assert len(columns[1]) > 5


def test_beams_of_a_fast_vehicle_are_drawn_one_by_one() -> None:
    n = 91
    bearing = np.radians(np.linspace(-45.0, 45.0, n))
    poses = np.stack((np.linspace(0.0, 1.0, n), np.zeros(n), np.zeros(n)), axis=-1)
    range_m = (4.0 - poses[:, 0]) / np.cos(bearing)
    scan = Scan(0, 1e6, bearing, range_m, 0.05, 10.0)
    grid = OccupancyGrid()
    grid.insert_beams(beams_of_scan(scan, poses))
    patch = grid.patch()
    assert set((np.nonzero(patch.cells == 100)[1] + patch.col0).tolist()) <= {79, 80}
    assert state(grid, 2.0, 0.0) == FREE


def test_beams_without_a_pose_prove_nothing() -> None:
    scan = Scan(0, 0.0, BEARING, ranges(1.0), 0.05, 5.0)
    poses = np.zeros((BEARING.size, 3))
    poses[:, 2] = np.nan
    grid = OccupancyGrid()
    grid.insert_beams(beams_of_scan(scan, poses))
    assert grid.patch().cells.size == 0
    with pytest.raises(ValueError, match="poses"):
        beams_of_scan(scan, np.zeros((3, 3)))
    broken = beams_of_scan(scan, np.zeros(3))
    broken.end_m[5] = np.nan
    with pytest.raises(ValueError, match="finite"):
        grid.insert_beams(broken)


# ------------------------------------------------------------------------------------------------ published and stored


def test_a_patch_names_its_cells() -> None:
    grid = OccupancyGrid(resolution_m=0.1)
    grid.insert_cells([(-3, 7)], [(5, -200)])
    patch = grid.patch()
    assert (patch.resolution_m, patch.row0, patch.col0, patch.cells.shape) == (0.1, -3, -200, (9, 208))
    assert patch.cells[0, 207] == 100
    assert patch.cells[8, 0] == 0
    assert np.count_nonzero(patch.cells >= 0) == 2
    whole = grid.patch(whole_tiles=True)
    assert (whole.row0 % TILE, whole.col0 % TILE, whole.cells.shape) == (0, 0, (2 * TILE, 3 * TILE))
    assert np.array_equal(grid.cells_in(Window(-3, 6, -200, 8)), patch.cells)


def test_more_of_the_same_is_no_change() -> None:
    grid = OccupancyGrid()
    for _ in range(3):
        look(grid, 2.0 / np.cos(BEARING))
    assert grid.take_changes()
    for _ in range(3):
        look(grid, 2.0 / np.cos(BEARING))
    assert grid.take_changes() == []
    assert grid.changed_tiles()
    assert grid.changed_tiles() == []


def busy_grid(model: str, sonar: bool) -> OccupancyGrid:
    grid = OccupancyGrid(model="counters" if model == "counters" else "log-odds")
    rng = np.random.default_rng(5)
    for _ in range(4):
        look(
            grid, rng.uniform(0.0, 5.0, BEARING.size), Pose2(rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(-3, 3))
        )
        if sonar:
            grid.insert_cone(Pose2(), float(rng.uniform(0.5, 2.0)), cone_rad=0.5, range_max_m=3.0)
    return grid


@pytest.mark.parametrize("model", ["counters", "log-odds"])
@pytest.mark.parametrize("sonar", [False, True])
def test_stored_tiles_come_back_exactly(model: str, sonar: bool) -> None:
    grid = busy_grid(model, sonar)
    stored = list(grid.tiles())
    other = OccupancyGrid(model=grid.model)
    for row, col, payload in reversed(stored):
        other.load_tile(row, col, payload)
    assert list(other.tiles()) == stored
    assert np.array_equal(other.patch().cells, grid.patch().cells)
    assert other.changed_tiles() == []
    assert sum(change.cells.size for change in other.take_changes()) > 0
    # The two go on alike.
    for g in (grid, other):
        look(g, ranges(3.0))
    assert list(other.tiles()) == list(grid.tiles())
    assert [(t.tile_row, t.tile_col, t.payload()) for t in other.changed_tiles()]


def test_copies_of_tiles_do_not_change_afterwards() -> None:
    grid = OccupancyGrid()
    look(grid, ranges(2.0))
    copies = grid.changed_tiles()
    payloads = [copy.payload() for copy in copies]
    look(grid, ranges(1.0))
    assert [copy.payload() for copy in copies] == payloads
    assert all(len(payload) < 32_768 for payload in payloads)


def test_a_loaded_tile_replaces_what_is_there() -> None:
    grid, other = OccupancyGrid(), OccupancyGrid()
    grid.insert_cells([(0, 0)], [])
    other.insert_cells([(5, 5)], [])
    other.insert_cone(Pose2(), 1.0, cone_rad=0.5, range_max_m=3.0)
    ((row, col, payload),) = grid.tiles()
    other.load_tile(row, col, payload)
    assert other.state_at([(0.01, 0.01), (0.26, 0.26), (1.0, 0.01)]).tolist() == [OCCUPIED, UNKNOWN, UNKNOWN]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_torn_tiles_are_refused_and_change_nothing(data: st.DataObject) -> None:
    ((_, _, payload), *_) = busy_grid("counters", True).tiles()
    place = data.draw(st.integers(0, len(payload) - 1))
    kind = data.draw(st.sampled_from(["flip", "cut", "empty"]))
    broken = bytearray(payload)
    if kind == "flip":
        broken[place] ^= 1 << data.draw(st.integers(0, 7))
    torn = bytes(broken) if kind == "flip" else payload[:place] if kind == "cut" else b""
    grid = OccupancyGrid()
    try:
        grid.load_tile(0, 0, torn)
    except ValueError:
        assert grid.patch().cells.size == 0
    else:  # a flip that the decompressor does not mind: the cells must be the true ones
        assert [p for _, _, p in grid.tiles()] == [payload]


def test_tiles_of_other_grids_are_refused_by_name() -> None:
    ((row, col, payload), *_) = busy_grid("counters", False).tiles()
    for grid, message in (
        (OccupancyGrid(model="log-odds"), "model"),
        (OccupancyGrid(resolution_m=0.1), "0.05 m cells"),
    ):
        with pytest.raises(ValueError, match=message):
            grid.load_tile(row, col, payload)
    later = payload[:4] + bytes([9]) + payload[5:]
    with pytest.raises(ValueError, match="version 9"):
        OccupancyGrid().load_tile(row, col, later)
    with pytest.raises(ValueError, match="far"):
        OccupancyGrid().load_tile(1 << 60, 0, payload)
    full = OccupancyGrid(max_tiles=1)
    full.load_tile(0, 0, payload)
    with pytest.raises(ValueError, match="max_tiles"):
        full.load_tile(3, 3, payload)


def test_tiles_with_impossible_cells_are_refused() -> None:
    """A sound checksum over contents that would confuse the kernels, as another program could write."""
    header = struct.Struct("<4sBBHd?I")
    for model, value in (("counters", 0xFFFF), ("counters", 0x00FF), ("log-odds", 1)):
        body = np.full(TILE * TILE, value, dtype="<u2").tobytes()
        number = 0 if model == "counters" else 1
        payload = header.pack(b"UGRT", 1, number, TILE, 0.05, False, zlib.crc32(body)) + zlib.compress(body)
        grid = OccupancyGrid(model="counters" if model == "counters" else "log-odds")
        with pytest.raises(ValueError, match="impossible"):
            grid.load_tile(0, 0, payload)


def test_a_huge_payload_is_not_unpacked() -> None:
    header = struct.Struct("<4sBBHd?I")
    bomb = header.pack(b"UGRT", 1, 0, TILE, 0.05, False, 0) + zlib.compress(bytes(200_000_000), 9)
    with pytest.raises(ValueError, match="torn"):
        OccupancyGrid().load_tile(0, 0, bomb)


def test_the_same_scans_give_the_same_bytes() -> None:
    assert list(busy_grid("counters", True).tiles()) == list(busy_grid("counters", True).tiles())


def test_warming_up_leaves_nothing_to_compile() -> None:
    """In a process of its own: after warm_up no kernel that a running daemon calls gets a new signature."""
    code = """
import numpy as np
from numba.core.registry import CPUDispatcher
from mapping.frames import Pose2
from mapping.grids.beam_model import beams_of_scan
from mapping.grids.occupancy import OccupancyGrid
from mapping.grids.warm_up import warm_up
from mapping.kernels import clearance, grids, sonar_cones
from mapping.scan import Scan

def compiled():
    kernels = [k for m in (grids, sonar_cones, clearance) for k in vars(m).values() if isinstance(k, CPUDispatcher)]
    return sum(len(k.signatures) for k in kernels)

warm_up()
before = compiled()
bearing = np.linspace(-2.0, 2.0, 200)
for model in ("counters", "log-odds"):
    grid = OccupancyGrid(model=model)
    for k in range(3):
        ranges = np.full(200, 3.0 + k)
        grid.insert_scan(Pose2(k, 0, 1), bearing, ranges, range_max_m=30, range_min_m=0, clear_no_return=False)
        poses = np.stack((np.full(200, 0.5) * k, np.linspace(0, k, 200), np.zeros(200)), axis=-1)
        grid.insert_beams(beams_of_scan(Scan(0, 0.0, bearing, ranges, 0.1, 30), poses))
        grid.insert_cone(Pose2(), 1, cone_rad=1, range_max_m=2, transducer="a")
        grid.insert_cells(np.array([[0, 0]]), [])
    grid.patch(), grid.take_changes(), grid.changed_tiles()
assert compiled() == before, (before, compiled())
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_light_parts_of_mapping_do_not_load_compiled_kernels() -> None:
    code = "import sys, mapping.frames, mapping.scan, mapping.grids.patch; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
