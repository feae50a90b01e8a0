"""A recording of ours as a log: its bytes through the real drivers and fusion, sweeps de-skewed by the odometry in it.

What `umfeld map build` and the other commands about logs do with other people's logs they do with it. The recorded
configuration says which laser: the first that SLAM would match. Without wheels its own sweeps are the odometry.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.logs import Log, LogError, LogScan, Odometry, PoseKind, Provenance, WheelGeometry, read_log
from mapping.frames import IDENTITY, Pose2
from mapping.scan import Scan, seen_from
from service import assemble
from service.config import Config, check
from service.config_files import Layers
from service.errors import Trouble
from service.fusion import Round, Touch
from service.outputs import OdomOut, Output, ScanOut
from service.replay import Recording, Replay
from service.sensors import Laser

F64 = NDArray[np.float64]

_SAME_RAD = 1e-6
_MCAP_MAGIC = b"\x89MCAP0\r\n"


def read_any_log(path: Path) -> Log:
    """A log of any kind that is known here, a recording (.mcap or its folder) too. LogError says what is wrong."""
    if not path.is_dir() and not _is_recording(path):
        return read_log(path)
    try:
        return log_of_recording(path)
    except Trouble as error:
        raise LogError(str(error)) from error


def log_of_recording(path: Path) -> Log:
    """The sweeps of one laser with the robot's odometry. Trouble if there is no recording, or no laser in it."""
    recording = Recording.of(path)
    config = _plain(recording)
    found = assemble.sensors(config)
    lasers = [name for name, sensor in found.items() if isinstance(sensor, Laser)]
    chosen = next((name for name in config.slam.sources or lasers if name in lasers), None)
    if chosen is None:
        raise Trouble(f"{path}: no laser is configured in this recording")
    taken = _Taken(chosen)
    replay = Replay(recording, config=config, layers=(taken,))
    replay.offer = taken.offer
    replay.run()
    offset_ns = replay.head.wall_offset_ns
    sweeps, laser = taken.posed, taken.base_from_laser
    scans = tuple(
        _log_scan(sweep, poses, laser, offset_ns, number) for number, (sweep, poses) in enumerate(sweeps, start=1)
    )
    files = b"".join(hashlib.sha256(file.read_bytes()).digest() for file in recording.files)
    return Log(
        scans=scans,
        odometry=Odometry(np.array(taken.odom_s) + offset_ns * 1e-9, np.array(taken.odom).reshape(-1, 3)),
        poses=PoseKind.ODOMETRY,
        robot_from_laser=(laser.x_m, laser.y_m, laser.yaw_rad),
        range_max_m=max((sweep.range_max_m for sweep, _ in sweeps), default=0.0),
        no_echo_from_m=float("inf"),
        stamps_repaired=0,
        stamps_made_up=False,
        provenance=Provenance(
            path=str(path), dialect="umfeld recording", file_bytes=sum(file.stat().st_size for file in recording.files),
            sha256=hashlib.sha256(files).hexdigest(),
        ),
        wheels=_wheels_of(config), odometry_by_laser=assemble.odometry_laser(config, found) is not None,
    )  # fmt: skip


class _Taken:
    """A layer of fusion that draws nothing and keeps one laser's sweeps with the poses of their beams."""

    def __init__(self, laser: str) -> None:
        self.sources = frozenset((laser,))
        self.base_from_laser = IDENTITY
        self.posed: list[tuple[Scan, F64]] = []
        self.odom_s: list[float] = []
        self.odom: list[tuple[float, float, float]] = []

    def offer(self, output: Output) -> None:
        if isinstance(output, OdomOut):
            place = output.odom_from_base
            self.odom_s.append(output.stamp_ns * 1e-9)
            self.odom.append((place.x_m, place.y_m, place.yaw_rad))
        elif isinstance(output, ScanOut) and output.sensor in self.sources:
            self.base_from_laser = output.base_from_sensor

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        if source in self.sources:
            self.posed.append((scan, np.atleast_2d(map_from_sensor).copy()))

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        pass

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        pass

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        return []


def _log_scan(scan: Scan, poses: F64, robot_from_laser: Pose2, offset_ns: int, number: int) -> LogScan:
    """As seen from where the first beam was taken, beams from right to left; no two at the same bearing."""
    laser = Pose2(*poses[0])
    bearing, distance = (scan.bearing_rad, scan.range_m) if len(poses) == 1 else seen_from(laser, scan, poses)
    order = np.argsort(bearing, kind="stable")
    bearing, distance = bearing[order], distance[order]
    kept = np.diff(bearing, prepend=-np.inf) > _SAME_RAD
    kept &= bearing < bearing[0] + 2.0 * np.pi - _SAME_RAD
    robot = laser @ robot_from_laser.inverse()
    stamp_ns = scan.stamp_ns + offset_ns
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return LogScan(
        stamp_s=stamp_ns * 1e-9,
        stamp_text=f"{seconds}.{rest:09d}",
        bearing_rad=bearing[kept],
        range_m=distance[kept],
        laser_pose=(laser.x_m, laser.y_m, laser.yaw_rad),
        robot_pose=(robot.x_m, robot.y_m, robot.yaw_rad),
        line=number,
    )


def _wheels_of(config: Config) -> WheelGeometry | None:
    """What made the odometry, if wheels did."""
    if config.drive.source is None:
        return None
    drive = assemble.geometry_of(config.drive)
    return WheelGeometry(drive.left_m_per_tick, drive.right_m_per_tick, drive.track_width_m)


def _plain(recording: Recording) -> Config:
    """The recorded configuration, the robot's place being that of its odometry."""
    try:
        data = json.loads(recording.head().start.config)
        data["slam"] = {**data.get("slam", {}), "enabled": False}
        data.pop("localise", None)
        return check(Layers(data, {}, {}, ()))
    except ValueError as error:
        raise Trouble(f"{recording.files[0]}: its configuration cannot be read: {error}") from error


def _is_recording(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
    except OSError:
        return False
