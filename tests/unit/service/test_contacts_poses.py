"""Switches and other estimators from the configuration to the maps, with the emulated board and autopilot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.fault_rig import Rig
from drivers.readings import ContactLine, ContactReading, ContactState, PoseReading
from mapping.frames import Pose2
from mapping.grids.occupancy import OccupancyGrid
from mapping.sectors.snapshot import SectorState
from service import assemble, assemble_wires
from service.config import Config, load
from service.errors import WrongUsage
from service.fusion import Fusion, Parts, Touch
from service.layers import insert_touch
from service.outputs import OdomOut
from service.sensors import Contacts, PoseSource, Switch
from service.warm_up import warm_up
from sim_devices.presets import Table

SECOND = 1_000_000_000
BUMPERS = """
[contacts.bumpers]
driver = "arduino-bridge"
port = "/dev/ttyUSB0"
switches = [{ line = 4, x_m = 0.26, width_m = 0.4 }, { line = 5, kind = "cliff", x_m = -0.26, tripped = "low" }]
[store]
enabled = false
"""


USBOARD = """
[can.main]
interface = "slcan"
channel = "/dev/ttyACM0"
[sonars.ring]
driver = "usboard"
can = "main"
transducers = [{ channel = 1 }]
[contacts.bumpers]
driver = "usboard"
can = "main"
base_id = 0x420
switches = [{ line = 0, x_m = 0.26 }, { line = 1, x_m = -0.26 }]
"""


def read(folder: Path, text: str) -> Config:
    file = folder / "umfeld.toml"
    file.write_text(text)
    return load(file, environment={}).config


def test_switches_share_the_board_and_feed_maps(tmp_path: Path) -> None:
    wheels = '[wheels.drive]\ndriver = "arduino-bridge"\nport = "/dev/ttyUSB0"\n[drive]\nsource = "drive"\n'
    config = read(tmp_path, BUMPERS + wheels + '[sectors.polar.near]\nsources = ["contacts.bumpers"]\n')
    (wire,) = assemble_wires.wires(config)
    assert set(wire.conversations) == {"bumpers", "drive"}
    found = assemble.sensors(config)
    contacts = found["bumpers"]
    assert isinstance(contacts, Contacts)
    assert [switch.line for switch in contacts.switches] == [4, 5]
    made = assemble.maps(config, found)
    assert [layer.sources for layer in made.sectors] == [frozenset({"bumpers"})]
    assert all("bumpers" in grid.sources for grid in made.grids)
    warm_up(config)


@pytest.mark.parametrize("base_id", ["0x400", "0x420"])
def test_switches_of_a_usboard_stand_with_its_sonars_or_alone(tmp_path: Path, base_id: str) -> None:
    config = read(tmp_path, USBOARD.replace("0x420", base_id))
    (wire,) = assemble_wires.wires(config)
    assert set(wire.conversations) == {"bumpers", "ring"}
    asked = []
    for make in wire.conversations.values():
        conversation = make()
        conversation.connected(0)
        asked.append(len(conversation.requests(0)))
    assert sum(asked) == (1 if base_id == "0x400" else 2), "one board, one host; two boards, one host each"
    warm_up(config)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BUMPERS.replace("line = 5", "line = 4"), "two switches have the same line"),
        (USBOARD.replace("line = 1", "line = 4"), "inputs 0 to 3, not 4"),
        (USBOARD.replace("0x420", "0x410"), "uses CAN id 0x410"),
        (
            USBOARD + '[contacts.more]\ndriver = "usboard"\ncan = "main"\nbase_id = 0x420\nswitches = [{ line = 0 }]\n',
            "uses CAN id 0x420",
        ),
        ('[drive]\npose_source = "pilot"\n', "there is no [poses.pilot]"),
        ('[poses.pilot]\ndriver = "mavlink"\nport = "/dev/ttyACM0"\n', 'add pose_source = "pilot" to [drive]'),
        ('[drive]\nsource = "a"\npose_source = "b"\n', "keep one of them"),
    ],
)
def test_what_cannot_be_is_told(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(WrongUsage) as told:
        read(tmp_path, text)
    assert words in str(told.value)


# --- fusion


class Recorder:
    """A sector map that keeps what it is told."""

    def __init__(self) -> None:
        self.sources = frozenset({"bumpers"})
        self.touches: list[Touch] = []

    def take_touch(self, source: str, touch: Touch) -> None:
        self.touches.append(touch)

    def lose(self, source: str) -> None:
        self.touches.clear()

    def output(self, now_ns: int) -> object:
        return None


SWITCH = Switch(4, Pose2(0.3, 0.0, 0.0), 0.2)


def fusion_of(recorder: Recorder) -> Fusion:
    contacts = Contacts("bumpers", (SWITCH,), hold_ns=SECOND // 2)
    return Fusion(Parts(sensors={"bumpers": contacts}, sectors=(recorder,)))  # type: ignore[arg-type]


def say(fusion: Fusion, state: ContactState, at_ns: int, line: int = 4) -> None:
    fusion.on_item("bumpers", ContactReading(at_ns, (ContactLine(line, state),)), at_ns)


def test_a_bouncing_contact_is_tripped_until_it_was_clear_for_long_enough() -> None:
    recorder = Recorder()
    fusion = fusion_of(recorder)
    times = [0, 100, 150, 200, 600, 699, 701]
    tells = "CTCTCCC"
    for ms, tell in zip(times, tells):
        say(fusion, ContactState.TRIPPED if tell == "T" else ContactState.CLEAR, SECOND + ms * 1_000_000)
    assert [touch.tripped for touch in recorder.touches] == [False, True, True, True, True, True, False]


def test_a_switch_that_does_not_answer_is_not_known_and_strangers_are_counted() -> None:
    recorder = Recorder()
    fusion = fusion_of(recorder)
    say(fusion, ContactState.UNKNOWN, SECOND)
    assert [touch.tripped for touch in recorder.touches] == [None]
    say(fusion, ContactState.TRIPPED, SECOND + 1, line=9)
    assert fusion.drops["bumpers"] == {"unknown_channel": 1}


def test_a_silent_board_is_lost_within_half_a_second() -> None:
    recorder = Recorder()
    fusion = fusion_of(recorder)
    say(fusion, ContactState.CLEAR, SECOND)
    fusion.tick(SECOND + 140_000_000)
    assert recorder.touches
    fusion.tick(SECOND + SECOND // 2)
    assert not recorder.touches


def test_a_touch_is_drawn_even_where_a_laser_has_looked_through_often() -> None:
    grid = OccupancyGrid(resolution_m=0.05)
    cells = np.array([[row, col] for row in range(-4, 4) for col in range(12)])
    for _ in range(400):
        grid.insert_cells(np.empty((0, 2), dtype=np.int64), cells)
    ahead = np.array([[0.325, 0.0], [0.325, 0.09], [0.325, -0.09]])
    assert (grid.probability_at(ahead) < 0.05).all()
    insert_touch(grid, Touch(0, SWITCH, True), Pose2())
    assert (grid.probability_at(ahead) > 0.65).all()
    assert grid.probability_at(np.array([[0.2, 0.0], [0.325, 0.17]])) == pytest.approx([0.0, 0.0], abs=0.05)


def test_poses_of_another_estimator_are_the_odometry() -> None:
    fusion = Fusion(Parts(sensors={"pilot": PoseSource("pilot")}, pose_source="pilot"))
    assert fusion.pose() is None
    told = []
    for k in range(5):
        reading = PoseReading(SECOND + k * 50_000_000, 5.0 + 0.1 * k, -3.0, 0.0, k > 0)
        told += [out for out in fusion.on_item("pilot", reading, reading.stamp_ns) if isinstance(out, OdomOut)]
    assert told[-1].odom_from_base.x_m == pytest.approx(0.4)
    assert told[-1].forward_m_s == pytest.approx(2.0)
    wild = PoseReading(2 * SECOND, float("nan"), 0.0, 0.0, True)
    fusion.on_item("pilot", wild, wild.stamp_ns)
    assert fusion.drops["pilot"] == {"not_a_pose": 1}


# --- with the emulated devices


def table(**sections: Table) -> Table:
    around = {"sources": ["bumpers"], "sector_deg": 15.0, "start_deg": -180.0, "stop_deg": 180.0}
    return {"sectors": {"polar": {"around": around}}, "store": {"enabled": False}, **sections}


CAN: dict[str, Table] = {"can": {"main": {"interface": "slcan", "channel": "main", "bitrate_bps": 1000000}}}
HEADS: Table = {"transducers": [{"channel": 1, "x_m": 0.1}], "cone_deg": 20.0}
BOARDS: dict[str, tuple[Table, dict[str, Table]]] = {
    "arduino-bridge": ({"driver": "arduino-bridge", "port": "/dev/ttyUSB0"}, {}),
    "usboard": ({"driver": "usboard", "can": "main", "base_id": 0x420}, CAN),
    "usboard, with sonars": (
        {"driver": "usboard", "can": "main"},
        {**CAN, "sonars": {"side": {"driver": "usboard", "can": "main", **HEADS}}},
    ),
    "usboard-serial": ({"driver": "usboard-serial", "port": "/dev/ttyUSB0"}, {}),
    "usboard-serial, with sonars": (
        {"driver": "usboard-serial", "port": "/dev/ttyUSB0"},
        {"sonars": {"side": {"driver": "usboard-serial", "port": "/dev/ttyUSB0", **HEADS}}},
    ),
}


@pytest.mark.parametrize("board", BOARDS)
def test_a_bumper_at_the_wall_blocks_and_one_before_it_does_not(board: str) -> None:
    switches = [
        {"line": 2, "x_m": 1.995, "width_m": 0.2},
        {"line": 3, "x_m": -1.0, "yaw_deg": 180.0, "width_m": 0.2},
    ]
    device, others = BOARDS[board]
    with Rig(table(contacts={"bumpers": {**device, "switches": switches}}, **others)) as rig:
        assert rig.run_until(lambda: all(rig.is_running(each) for each in rig.sensors), 5.0)
        assert rig.health()["bumpers"].counters.drops == {}
        rig.run(0.5)
        snapshot = rig.maps[-1][1].snapshot
        blocked = snapshot.state == SectorState.OBSTACLE
        assert blocked.sum() == 2  # both sides of straight ahead
        np.testing.assert_allclose(snapshot.distance_m[blocked], 1.995, atol=1e-3)
        assert not (snapshot.state == SectorState.FREE).any()
        assert rig.grid is not None
        assert rig.grid.grid.probability_at(np.array([[2.02, 0.0]]))[0] > 0.65


def test_an_autopilots_poses_move_the_robot() -> None:
    laser = {"front": {"driver": "ldrobot", "port": "/dev/ttyUSB9"}}
    poses = {"pilot": {"driver": "mavlink", "port": "/dev/ttyACM0"}}
    robot = table(lasers=laser, poses=poses, drive={"pose_source": "pilot"})
    robot["sectors"]["polar"]["around"]["sources"] = ["front"]
    with Rig(robot, sways=True) as rig:
        assert rig.run_until(lambda: rig.is_running("pilot") and rig.fusion.pose() is not None, 5.0)
        began_x = rig.room.x_m(np.array(float(rig.now_ns)))
        first = rig.fusion.pose()
        rig.run(1.2)
        pose = rig.fusion.pose()
        assert pose is not None
        assert first is not None
        moved_m = float(rig.room.x_m(np.array(float(rig.now_ns))) - began_x)
        assert pose.x_m - first.x_m == pytest.approx(moved_m, abs=0.02)
        assert rig.free_cells()
