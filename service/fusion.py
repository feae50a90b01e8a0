"""Readings in, maps updated, outputs out. No thread, socket or clock: time is handed in, the same items give the same
outputs bit for bit.

A laser's sweep goes three ways. As it is: ScanOut. At once into the sector maps, de-skewed with the odometry known by
then; where odometry has not reached the last beams yet the newest pose is held, because a sector map that waits is
late (at 100 Hz odometry the hold is 10 ms at most, 1 cm at 1 m/s). And into the grids, where a wrong place stays
wrong for long: there, without mixed pixels and without what ends on the robot itself, it waits until odometry covers
the whole sweep, at most `wait_ns`, and is dropped otherwise; then the localiser sees it before it is drawn. While the
localiser waits for a result, scans are held back; the pose is not.

Input never stops fusion. What cannot be used is dropped and counted by source and reason:
    stamp_equal, stamp_backward, stamp_ahead    not newer than the source's last, or from the future
    wrong_count, no_beams, too_many_beams, bearing_not_finite, times_wrong, limits_wrong    a scan that is none
    range_out_of_bounds    single beams: not positive, or beyond the device's limit; taken as INVALID
    odometry_late, odometry_gone, odometry_broken, waiting_full    a scan that no pose belongs to, for the grids only;
        what was measured while odometry was starting is not counted: the map begins with the first pose
    map_refused    a place or a length that a grid cannot hold
    too_fast, not_a_pose    wheel counts that no wheel can have made, poses nobody can have gone to
    unconfirmed    a sonar's range much farther than its last, by a protocol without a check sum: the next decides
    unknown_channel, not_configured, wrong_kind    a reading from nowhere
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.readings import (
    AngleReading,
    ChainReading,
    ContactReading,
    ContactState,
    DeviceEvent,
    LinkState,
    PoseReading,
    RangeStatus,
    Reading,
    RingReading,
    ScanReading,
    WheelReading,
)
from mapping.deskew import beam_stamps, deskew
from mapping.frames import IDENTITY, Pose2, compose_covariance
from mapping.kernels import motion
from mapping.mixed_pixels import without_mixed_pixels
from mapping.narrow_gaps import without_narrow_gaps
from mapping.odometry import DifferentialOdometry, DriveGeometry, FollowedPoses, OdometryState
from mapping.pose_buffer import GoneError, PoseBuffer
from mapping.scan import Scan
from mapping.sectors.inputs import without_self
from service.align import WaitingRoom
from service.mounts import TiltingLaser
from service.outputs import (
    UNKNOWN_VARIANCE,
    LookOut,
    OdomOut,
    Output,
    PolarOut,
    PoseOut,
    RangesOut,
    RectOut,
    ScanOut,
)
from service.sensors import AxleEncoder, Chain, Contacts, Laser, PoseSource, Ring, Sensor, Switch, Wheels

if TYPE_CHECKING:
    from mapping.localise.laser_odometry import LaserOdometry

F64 = NDArray[np.float64]
StoredTile = tuple[int, int, bytes]

SECOND = 1_000_000_000
TICK_PERIOD_NS = 25_000_000  # how often tick() is to be called
_FOREVER_NS = 1 << 62
_AHEAD_LIMIT_NS = 100_000_000  # a stamp farther in the future is nonsense; taken, it would make the next ones old
_BEAMS_MAX = 100_000
_SECTOR_PERIOD_NS = 50_000_000  # a sector map is published so often even if nothing feeds it
_SECTOR_GAP_NS = 20_000_000  # sonars that follow each other faster are published together, with the next tick
POSE_PERIOD_NS = 25_000_000  # a pose is told as soon as its odometry is so much newer than the last one's
_HELD_MAX = 512  # scans and rounds that are held back for a localiser that is late; beyond, fusion waits for it
_TOO_FAST_IN_A_ROW = 5  # then the counts are believed, and what lay between them is unknown
_SPEED_VARIANCE_MIN = 1e-4  # (1 cm/s)^2 and (0.6 deg/s)^2: a count more or less
_LOST_SCANS = 3  # in a row that fit nothing, where they alone tell the motion: then it is said
_STALE_LIMIT_NS = 500_000_000
_FARTHEST_POSE_M = 1e7
_CONFIRMED_M = 0.25  # a robot drives away by less between two readings of a sonar
SECTOR_MEMORY_NS = _STALE_LIMIT_NS - _SECTOR_PERIOD_NS
"""How long a direction stays fresh without new evidence: what is stale is then published within half a second."""


@dataclass(frozen=True, slots=True)
class Cone:
    """What one sonar heard. range_m: +inf nothing up to range_max_m, -inf too close, NaN invalid or another's echo."""

    channel: int
    base_from_transducer: Pose2
    range_m: float


@dataclass(frozen=True, slots=True)
class Round:
    """Cones of one chain that were heard together."""

    stamp_ns: int
    cones: tuple[Cone, ...]
    cone_rad: float
    range_min_m: float
    range_max_m: float


@dataclass(frozen=True, slots=True)
class Touch:
    """What one switch says: True touched (or no floor), False not, None not known."""

    stamp_ns: int
    switch: Switch
    tripped: bool | None


class SectorLayer(Protocol):
    """One sector map, polar or rectangular, as fusion sees it. It lets evidence go stale after SECTOR_MEMORY_NS."""

    @property
    def sources(self) -> frozenset[str]:
        """Names of the sensors that feed it."""

    def take_scan(self, source: str, scan: Scan, base_from_sensor: Pose2) -> None:
        """Replace what this source said. base_from_sensor: seen from where the base is now."""

    def take_round(self, source: str, heard: Round) -> None:
        """The same for sonars; directions that are not in this round keep what they had."""

    def take_touch(self, source: str, touch: Touch) -> None:
        """The same for a switch."""

    def lose(self, source: str) -> None:
        """The source is gone: what it said is stale from now on."""

    def output(self, now_ns: int) -> PolarOut | RectOut:
        """As it stands now, ages counted to now_ns."""


class GridLayer(Protocol):
    """A grid as fusion sees it; poses are those of the map frame."""

    @property
    def sources(self) -> frozenset[str]:
        """Names of the sensors that draw it."""

    def take_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        """Insert one sweep. map_from_sensor: x, y, yaw of every beam's sensor pose (N, 3), or one for all (3,)."""

    def take_round(self, source: str, heard: Round, map_from_base: Pose2) -> None:
        """Insert the cones of one round."""

    def take_touch(self, source: str, touch: Touch, map_from_base: Pose2) -> None:
        """Draw what a switch touches; only called for those that are tripped."""

    def outputs(self, map_from_base: Pose2 | None, stamp_ns: int, now_ns: int) -> list[Output]:
        """What is due for publication at now_ns. map_from_base: where the robot is, None while unknown."""


@dataclass(frozen=True, slots=True)
class Located:
    """Where the base is in the map. covariance: (3, 3) of map_from_base.  map_from_odom: the correction behind it."""

    stamp_ns: int
    map_from_base: Pose2
    map_from_odom: Pose2
    covariance: F64


@runtime_checkable
class FollowsCorrections(GridLayer, Protocol):
    """A layer around the robot that forgets: it begins again when the map frame moves under the robot."""

    def start_over(self) -> None:
        """Forget everything; what was seen last is drawn again."""


class Localiser(Protocol):
    """Where the odom frame lies in the map frame: odometry alone, SLAM, or a known map.

    All calls come from the fusion thread, in the order of what is measured. What it says depends on these calls alone,
    so that a replay is told the same; what it works out elsewhere it takes up at a moment that stamps decide.
    """

    def is_ready(self, stamp_ns: int) -> bool:
        """Whether take_scan of this stamp would not have to wait for something; while not, scans are held back."""

    def take_odometry(self, state: OdometryState) -> None:
        """Each new state, in order."""

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        """Each sweep that odometry covers, in order of stamps, before it is put into the grids: whether it may be."""

    def take_round(self, source: str, heard: Round | Touch, odom_from_base: Pose2) -> bool:
        """Each round of sonars, and each touch, before it is put into the grids: whether it may be."""

    def map_from_odom(self) -> Pose2:
        """The correction as of now."""

    def is_placed(self) -> bool:
        """Whether the robot knows where it is in a map that was there before: while not, nothing is drawn into it."""

    def locate(self, state: OdometryState) -> Located:
        """The base at the newest odometry."""

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """Another map was loaded: tiles of its grid, and of its layer `slam`; the pose stays until scans tell."""

    def begin_map(self, map_from_odom: Pose2) -> None:
        """The map is empty from now on, and the odom frame lies there in it."""

    def kept(self) -> Callable[[], list[StoredTile]] | None:
        """What is to be stored as of now: makes the tiles of the layer `slam` that changed, in whichever thread."""

    def outputs(self, now_ns: int) -> list[Output]:
        """What is due for publication at now_ns."""

    def troubles(self) -> list[str]:
        """What is wrong, each in one line with the repair."""

    def counters(self) -> Mapping[str, int]:
        """Its figures, by name."""


class OdometryOnly:
    """Believes the wheels: map and odom stay where they were put at the start."""

    def __init__(self, map_from_odom: Pose2 = IDENTITY) -> None:
        self._map_from_odom = map_from_odom

    def is_ready(self, stamp_ns: int) -> bool:
        return True

    def take_odometry(self, state: OdometryState) -> None:
        """Nothing to learn from it."""

    def take_scan(self, sensor: str, scan: Scan, odom_from_base: PoseBuffer, base_from_sensor: Pose2) -> bool:
        return True

    def take_round(self, source: str, heard: Round | Touch, odom_from_base: Pose2) -> bool:
        return True

    def map_from_odom(self) -> Pose2:
        return self._map_from_odom

    def is_placed(self) -> bool:
        return True

    def locate(self, state: OdometryState) -> Located:
        return located_by_odometry(self._map_from_odom, state)

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """The robot is where it was."""

    def begin_map(self, map_from_odom: Pose2) -> None:
        self._map_from_odom = map_from_odom

    def kept(self) -> Callable[[], list[StoredTile]] | None:
        return None

    def outputs(self, now_ns: int) -> list[Output]:
        return []

    def troubles(self) -> list[str]:
        return []

    def counters(self) -> Mapping[str, int]:
        return {}


def located_by_odometry(map_from_odom: Pose2, state: OdometryState) -> Located:
    """The base where odometry has it, the correction taken as exact."""
    covariance = compose_covariance(map_from_odom, np.zeros((3, 3)), state.odom_from_base, state.covariance)
    return Located(state.stamp_ns, map_from_odom @ state.odom_from_base, map_from_odom, covariance)


@dataclass(frozen=True, slots=True)
class Parts:
    """What fusion is made of.

    drive: name of the source whose counts make odometry, and the geometry to read them by.  pose_source: name of
    another estimator whose poses are used instead.  odometry_laser: the level laser whose sweeps tell the motion where
    nothing else does; without any of them the robot is taken to stand still.  wait_ns: how long a sweep waits for
    odometry.  footprint: (V, 2) outline of the robot in its base frame; beams that end on it are
    left out of whatever is drawn.
    """

    sensors: Mapping[str, Sensor]
    sectors: Sequence[SectorLayer] = ()
    grids: Sequence[GridLayer] = ()
    drive: tuple[str, DriveGeometry] | None = None
    pose_source: str | None = None
    odometry_laser: str | None = None
    max_wheel_speed_m_s: float = 5.0
    localiser: Localiser = field(default_factory=OdometryOnly)
    mounts: Sequence[TiltingLaser] = ()
    footprint: F64 | None = None
    wait_ns: int = 500_000_000
    odometry_memory_s: float = 30.0


class Fusion:
    """See the module's docstring. `drops`: by source and reason."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self.drops: dict[str, dict[str, int]] = {}
        self._last_stamps: dict[str, int] = {}
        self._waiting: WaitingRoom[Scan | Round | Touch] = WaitingRoom(limit_ns=parts.wait_ns)
        self._chains = {
            sensor.name: _ChainMemory(sensor) for sensor in parts.sensors.values() if isinstance(sensor, Chain)
        }
        self._contacts = {
            sensor.name: _ContactMemory(sensor) for sensor in parts.sensors.values() if isinstance(sensor, Contacts)
        }
        self._odometry = None if parts.drive is None else DifferentialOdometry(parts.drive[1])
        self._followed = None
        if parts.pose_source is not None:
            self._followed = FollowedPoses(max_speed_m_s=parts.max_wheel_speed_m_s)
        self._laser_odometry = None if parts.odometry_laser is None else _laser_odometry()
        self._moves = any(each is not None for each in (self._odometry, self._followed, self._laser_odometry))
        self._poses = PoseBuffer(capacity=max(64, int(parts.odometry_memory_s * 250)))
        self._wheels_last: WheelReading | None = None
        self._too_fast = 0
        self._broken = False
        self._state: OdometryState | None = None
        self._begun_ns: int | None = None  # the first pose
        self._pose_told_ns: int | None = None
        self._fresh_until_ns: dict[str, int] = {}
        self._sectors_told_ns: dict[int, int] = {}
        self._sectors_untold: set[int] = set()  # changed since they were published
        self._newest_stamp_ns = 0
        self._late_since_ns: int | None = None
        self._mixed_pixels = self._beams_on_robot = self._narrow_gaps = 0
        self._tilting = {mount.settings.laser: mount for mount in parts.mounts}
        self._by_axle = {mount.settings.name: mount for mount in parts.mounts}
        self._around = [grid for grid in parts.grids if isinstance(grid, FollowsCorrections)]
        self._held: deque[tuple[str, Scan | Round | Touch]] = deque()  # covered, until the localiser is ready

    # --- what comes in

    def on_item(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> list[Output]:
        """Take one reading or event of a source; returns what it changes, in the order to publish."""
        return list(self.stream(source, item, now_ns))

    def stream(self, source: str, item: Reading | DeviceEvent, now_ns: int) -> Iterable[Output]:
        """As on_item, each output as soon as it is ready; to be exhausted before anything else is asked of fusion."""
        if isinstance(item, DeviceEvent):
            return self._on_event(source, item, now_ns)
        sensor = self._parts.sensors.get(source)
        if sensor is None:
            return self._drop(source, "not_configured")
        match sensor, item:
            case Laser(tilts=True), ScanReading():
                return self._on_tilted_scan(sensor, item, now_ns)
            case AxleEncoder(), AngleReading():
                if self._is_newer(source, item.stamp_ns, now_ns) and source in self._by_axle:
                    self._by_axle[source].take_angle(item)
                return []
            case Laser(), ScanReading():
                return self._on_scan(sensor, item, now_ns) if self._is_newer(source, item.stamp_ns, now_ns) else []
            case Wheels(), WheelReading():
                return self._on_wheels(sensor, item, now_ns) if self._is_newer(source, item.stamp_ns, now_ns) else []
            case (
                Chain(),
                ChainReading(),
            ):  # groups of a chain fire at the same time: its channels have stamps of their own
                return self._on_round(sensor, item, now_ns)
            case PoseSource(), PoseReading():
                newer = self._is_newer(source, item.stamp_ns, now_ns)
                return self._on_pose(sensor, item, now_ns) if newer else []
            case Ring(), RingReading():
                return self._on_look(sensor, item) if self._is_newer(source, item.stamp_ns, now_ns) else []
            case Contacts(), ContactReading():
                newer = self._is_newer(source, item.stamp_ns, now_ns)
                return self._on_contacts(sensor, item, now_ns) if newer else []
        return self._drop(source, "wrong_kind")

    def tick(self, now_ns: int) -> list[Output]:
        """To be called every TICK_PERIOD_NS: ages sectors, ends waiting, publishes grids that are due."""
        for source in [name for name, until_ns in self._fresh_until_ns.items() if now_ns > until_ns]:
            self._lose(source)
        outputs: list[Output] = [
            self._tell(index, now_ns)
            for index in range(len(self._parts.sectors))
            if index in self._sectors_untold or self._told_since_ns(index, now_ns) >= _SECTOR_PERIOD_NS
        ]
        self.settle(now_ns)
        outputs.extend(self._parts.localiser.outputs(now_ns))
        outputs.extend(self._clouds(now_ns))
        map_from_base = self._map_from_base_now()
        for grid in self._parts.grids:
            outputs.extend(grid.outputs(map_from_base, self._newest_stamp_ns, now_ns))
        return outputs

    def counters(self) -> dict[str, int]:
        """Figures of fusion itself."""
        return {
            "fusion.waiting_for_odometry": len(self._waiting),
            "fusion.held_back": len(self._held),
            "fusion.mixed_pixels": self._mixed_pixels,
            "fusion.narrow_gaps": self._narrow_gaps,
            "fusion.beams_on_robot": self._beams_on_robot,
            **({} if self._laser_odometry is None else self._laser_odometry.counters()),
            **self._parts.localiser.counters(),
        }

    def troubles(self, now_ns: int) -> list[str]:
        """What fusion waits for or lacks, each in one line with the repair."""
        troubles = self._parts.localiser.troubles()
        motion = self._parts.pose_source or (self._parts.drive and self._parts.drive[0]) or self._parts.odometry_laser
        if motion is None and any(g.sources for g in self._parts.grids):
            troubles.append(
                "no [drive] source, and no laser that tells the motion: the grid is drawn as if the robot stood still"
            )
        elif self._laser_odometry is not None:
            if self._laser_odometry.lost_scans >= _LOST_SCANS:
                troubles.append(
                    f"no wheels tell the motion, and {self._laser_odometry.lost_scans} scans of {motion} in a row fit "
                    "nothing seen before: it is moved too fast, or sees too little; hold it still for a moment"
                )
        elif motion is not None and self._late_since_ns is not None:
            troubles.append(f"grids wait for odometry of {motion}: check that device; scans are not drawn meanwhile")
        return troubles

    def pose(self) -> Pose2 | None:
        """The base in the map frame, None before the first odometry."""
        return self._map_from_base_now()

    # --- events

    def _on_event(self, source: str, event: DeviceEvent, now_ns: int) -> list[Output]:
        if event.state is LinkState.RUNNING or source not in self._parts.sensors:
            return []
        if event.state is LinkState.STARTING and source in self._chains:
            self._chains[source].forget()
        if source in self._by_axle:
            self._by_axle[source].lose()
        self._lose(source)
        return [self._tell(index, now_ns) for index in self._fed_by(source)]

    def _lose(self, source: str) -> None:
        """Nothing of what it said is fresh any more."""
        self._fresh_until_ns.pop(source, None)
        for index in self._fed_by(source):
            self._parts.sectors[index].lose(source)
            self._sectors_untold.add(index)

    # --- lasers

    def _on_scan(self, laser: Laser, reading: ScanReading, now_ns: int) -> Iterator[Output]:
        scan = self._checked_scan(laser, reading)
        if scan is None:
            return
        sweep_ns = _last_beam_ns(scan) - scan.stamp_ns
        self._fresh_until_ns[laser.name] = min(scan.stamp_ns, now_ns) + stale_after_ns(reading.scan_period_ns, sweep_ns)
        tells_motion = self._laser_odometry is not None and laser.name == self._parts.odometry_laser
        drawn = self._to_draw(laser, scan) if tells_motion or self._is_drawn(laser.name) else None
        if tells_motion and drawn is not None:
            yield from self._on_motion_seen(laser, drawn)
        if fed := self._fed_by(laser.name):
            seen, base_from_sensor = self._as_seen_now(scan, laser.base_from_sensor)
            first_ns = min(scan.stamp_ns, now_ns)  # ages count from the first beam, never from later
            seen = replace(seen, stamp_ns=first_ns)
            for index in fed:
                self._parts.sectors[index].take_scan(laser.name, seen, base_from_sensor)
                yield self._tell(index, now_ns)
        yield ScanOut(laser.name, scan, laser.base_from_sensor, laser.height_m)
        self._newest_stamp_ns = max(self._newest_stamp_ns, scan.stamp_ns)
        if drawn is not None:
            self._wait_for_poses(laser.name, drawn, scan.stamp_ns, _last_beam_ns(scan), now_ns)

    def _on_motion_seen(self, laser: Laser, drawn: Scan) -> list[Output]:
        """What a sweep tells of the motion, on a robot where nothing else does: the pose at its middle."""
        assert self._laser_odometry is not None
        state = self._laser_odometry.take(drawn, laser.base_from_sensor)
        return [] if state is None else self._take_state(state)

    def _on_tilted_scan(self, laser: Laser, reading: ScanReading, now_ns: int) -> list[Output]:
        """A sweep that is not level goes into no flat map."""
        mount = self._tilting.get(laser.name)
        if mount is None or not self._is_newer(laser.name, reading.stamp_ns, now_ns):
            return []
        scan = self._checked_scan(laser, reading)
        if scan is not None:
            mount.take_scan(scan, now_ns)
            self._newest_stamp_ns = max(self._newest_stamp_ns, scan.stamp_ns)
        return []

    def _clouds(self, now_ns: int) -> list[Output]:
        poses = self._poses if self._moves else None
        made: list[Output] = []
        for mount in self._parts.mounts:
            made.extend(mount.clouds(poses, self._map_from_base_at, now_ns))
            for reason, count in mount.drops.items():
                self._drop(mount.settings.name, reason, count)
            mount.drops.clear()
        return made

    def _map_from_base_at(self, stamp_ns: int) -> Pose2 | None:
        map_from_odom = self._parts.localiser.map_from_odom()
        if not self._moves:
            return map_from_odom
        try:
            return map_from_odom @ self._poses.at(stamp_ns)
        except LookupError:
            return None

    def _checked_scan(self, laser: Laser, reading: ScanReading) -> Scan | None:
        bearing = np.asarray(reading.bearing_rad, dtype=np.float64)
        distance = np.array(reading.range_m, dtype=np.float64)
        reason = _fault_of_scan(reading, bearing, distance)
        if reason is not None:
            self._drop(laser.name, reason)
            return None
        if not laser.nothing_is_free:
            distance[np.isposinf(distance)] = np.nan
        measured = np.isfinite(distance)
        impossible = measured & ((distance <= 0.0) | (distance > reading.range_max_m * (1.0 + 1e-9)))
        if impossible.any():
            distance[impossible] = np.nan
            self._drop(laser.name, "range_out_of_bounds", int(impossible.sum()))
        return Scan(
            reading.stamp_ns,
            float(reading.beam_period_ns),
            -bearing if laser.upside_down else bearing,
            distance,
            float(reading.range_min_m),
            float(reading.range_max_m),
        )

    def _to_draw(self, laser: Laser, scan: Scan) -> Scan:
        """The scan without what ends on the robot itself, mixed pixels, and nothings between surfaces close by."""
        ranges, mixed = without_mixed_pixels(scan.bearing_rad, scan.range_m)
        ranges, narrow = without_narrow_gaps(scan.bearing_rad, ranges)
        self._mixed_pixels += mixed
        self._narrow_gaps += narrow
        footprint = self._parts.footprint
        if footprint is not None:
            seen = ranges
            ranges = without_self(
                scan.bearing_rad, seen, laser.base_from_sensor, footprint, too_close_m=scan.range_min_m
            )
            if ranges is not seen:
                self._beams_on_robot += int(np.isnan(ranges).sum() - np.isnan(seen).sum())
        return replace(scan, range_m=ranges)

    def _as_seen_now(self, scan: Scan, base_from_sensor: Pose2) -> tuple[Scan, Pose2]:
        """The scan de-skewed as far as odometry is known, and its sensor's pose as seen from where the base is now."""
        if self._state is None or self._poses.newest_ns is None:
            return scan, base_from_sensor
        try:
            swept = deskew(scan, _HeldPoses(self._poses), base_from_sensor)
        except GoneError:
            return scan, base_from_sensor
        return swept.scan, self._state.odom_from_base.inverse() @ swept.odom_from_sensor

    # --- sonars

    def _on_round(self, chain: Chain, reading: ChainReading, now_ns: int) -> list[Output]:
        memory = self._chains[chain.name]
        if reading.stamp_ns > now_ns + _AHEAD_LIMIT_NS:
            return self._drop(chain.name, "stamp_ahead")
        cones, refused = memory.take(reading)
        for reason in refused:
            self._drop(chain.name, reason)
        if not cones:
            return []
        heard = Round(reading.stamp_ns, cones, chain.cone_rad, chain.range_min_m, chain.range_max_m)
        self._fresh_until_ns[chain.name] = min(reading.stamp_ns, now_ns) + memory.stale_after_ns
        now_heard = replace(heard, stamp_ns=min(reading.stamp_ns, now_ns))
        outputs: list[Output] = [memory.output(reading.stamp_ns)]
        for index in self._fed_by(chain.name):
            self._parts.sectors[index].take_round(chain.name, now_heard)
            if self._told_since_ns(index, now_ns) >= _SECTOR_GAP_NS:
                outputs.append(self._tell(index, now_ns))
            else:
                self._sectors_untold.add(index)
        self._newest_stamp_ns = max(self._newest_stamp_ns, reading.stamp_ns)
        self._wait_for_poses(chain.name, heard, reading.stamp_ns, reading.stamp_ns, now_ns)
        return outputs

    # --- switches

    def _on_contacts(self, contacts: Contacts, reading: ContactReading, now_ns: int) -> list[Output]:
        stamp_ns = min(reading.stamp_ns, now_ns)
        touches, unknown = self._contacts[contacts.name].take(reading, stamp_ns)
        if unknown:
            self._drop(contacts.name, "unknown_channel", unknown)
        if not touches:
            return []
        self._fresh_until_ns[contacts.name] = stamp_ns + stale_after_ns(contacts.period_ns, 0)
        fed = self._fed_by(contacts.name)
        for index in fed:
            for touch in touches:
                self._parts.sectors[index].take_touch(contacts.name, touch)
        for touch in touches:
            if touch.tripped:
                self._wait_for_poses(contacts.name, touch, stamp_ns, stamp_ns, now_ns)
        if any(touch.tripped for touch in touches):
            return [self._tell(index, now_ns) for index in fed]
        self._sectors_untold.update(fed)
        return []

    def _on_look(self, ring: Ring, reading: RingReading) -> list[Output]:
        way_m = (reading.ahead_m, reading.left_m)
        touch = reading.touch.astype(np.float64)
        return [LookOut(ring.name, reading.stamp_ns, reading.light, touch, way_m, reading.continuous)]

    # --- wheels

    def _on_wheels(self, wheels: Wheels, reading: WheelReading, now_ns: int) -> list[Output]:
        if self._odometry is None or self._parts.drive is None or wheels.name != self._parts.drive[0]:
            return []
        if self._is_too_fast(reading):
            self._too_fast += 1
            self._drop(wheels.name, "too_fast")
            if self._too_fast <= _TOO_FAST_IN_A_ROW:
                return []
            reading = replace(reading, continuous=False)
        self._too_fast = 0
        self._wheels_last = reading
        return self._take_state(
            self._odometry.update(
                reading.stamp_ns, reading.left_ticks, reading.right_ticks, continuous=reading.continuous
            )
        )

    def _on_pose(self, poses: PoseSource, reading: PoseReading, now_ns: int) -> list[Output]:
        """Another estimator's pose in the place of wheel odometry."""
        if self._followed is None or poses.name != self._parts.pose_source:
            return []
        place = (reading.x_m, reading.y_m, reading.yaw_rad)
        if not all(math.isfinite(value) and abs(value) < _FARTHEST_POSE_M for value in place):
            return self._drop(poses.name, "not_a_pose")
        state = self._followed.update(reading.stamp_ns, Pose2(*place), continuous=reading.continuous)
        if state is None:
            return self._drop(poses.name, "too_fast")
        return self._take_state(state)

    def _take_state(self, state: OdometryState) -> list[Output]:
        variances = _twist_variances(self._state, state)
        self._state = state
        if self._begun_ns is None:
            self._begun_ns = state.stamp_ns
        self._poses.add(state.stamp_ns, state.odom_from_base, after_break=state.broken)
        self._parts.localiser.take_odometry(state)
        outputs: list[Output] = [
            OdomOut(
                state.stamp_ns, state.odom_from_base, state.covariance, state.forward_m_s, state.yaw_rad_s, *variances
            )
        ]
        if self._pose_told_ns is None or state.stamp_ns - self._pose_told_ns >= POSE_PERIOD_NS:
            self._pose_told_ns = state.stamp_ns
            outputs.append(self._pose_of(state))
        return outputs

    def _is_too_fast(self, reading: WheelReading) -> bool:
        last = self._wheels_last
        if last is None or not reading.continuous or self._parts.drive is None:
            return False
        geometry = self._parts.drive[1]
        reach_m = self._parts.max_wheel_speed_m_s * (reading.stamp_ns - last.stamp_ns) * 1e-9
        left_m = (reading.left_ticks - last.left_ticks) * geometry.left_m_per_tick
        right_m = (reading.right_ticks - last.right_ticks) * geometry.right_m_per_tick
        # A tick of slack: the counter's step is not speed.
        slack_m = abs(geometry.left_m_per_tick) + abs(geometry.right_m_per_tick)
        return max(abs(left_m), abs(right_m)) > reach_m + slack_m

    def _pose_of(self, state: OdometryState) -> PoseOut:
        return _pose_out(self._parts.localiser.locate(state))

    def _map_from_base_now(self) -> Pose2 | None:
        map_from_odom = self._parts.localiser.map_from_odom()
        if not self._moves:
            return map_from_odom
        return None if self._state is None else map_from_odom @ self._state.odom_from_base

    # --- grids

    def settle(self, now_ns: int) -> None:
        """Draw into the grids what poses cover by now, in order of stamps; to be called after on_item.

        Apart from it so that sector maps leave before the slower grids are worked on.
        """
        if not len(self._waiting):
            self._draw_held(patience=_HELD_MAX)
            return
        if not self._moves:
            released = self._waiting.release(oldest_ns=-_FOREVER_NS, newest_ns=_FOREVER_NS, now_ns=now_ns)
        else:
            released = self._waiting.release(
                oldest_ns=self._poses.oldest_ns,
                newest_ns=self._poses.newest_ns,
                now_ns=now_ns,
                begun_ns=self._begun_ns,
            )
        for source, reason in released.dropped:
            if reason != "before_odometry":
                self._drop(source, reason)
            if reason == "odometry_late":
                self._late_since_ns = self._late_since_ns or now_ns
        if released.ready:
            self._late_since_ns = None
        self._held.extend(released.ready)
        self._draw_held(patience=_HELD_MAX)

    def map_was_replaced(self, tiles: Iterable[StoredTile], slam: Iterable[StoredTile]) -> None:
        """The building's grid holds these stored tiles now; the robot's pose stays. slam: that layer of the map."""
        self._parts.localiser.map_was_replaced(tiles, slam)

    def begin_map(self) -> None:
        """The building's grid was emptied: the robot stands at the origin of a new map frame, looking along x."""
        odom_from_base = IDENTITY if self._state is None else self._state.odom_from_base
        self._parts.localiser.begin_map(odom_from_base.inverse())
        for grid in self._around:
            grid.start_over()

    def kept_of_slam(self) -> Callable[[], list[StoredTile]] | None:
        """Makes the changed tiles of the layer `slam`, in the thread that writes; None if there is nothing to keep."""
        return self._parts.localiser.kept()

    def drain(self) -> None:
        """Draw what is held back, waiting for whatever it is held back for."""
        self._draw_held(patience=0)

    def _draw_held(self, *, patience: int) -> None:
        """Draw in order, up to a scan that the localiser is not ready for; with more than `patience` it waits there."""
        while self._held:
            source, value = self._held[0]
            is_ready = isinstance(value, Round | Touch) or self._parts.localiser.is_ready(value.stamp_ns)
            if not is_ready and len(self._held) <= patience:
                return
            self._held.popleft()
            try:
                self._draw(source, value)
            except GoneError:
                self._drop(source, "odometry_broken")

    def _wait_for_poses(
        self, source: str, value: Scan | Round | Touch, first_ns: int, last_ns: int, now_ns: int
    ) -> None:
        if self._is_drawn(source):
            for lost, reason in self._waiting.put(source, value, first_ns, last_ns, now_ns):
                self._drop(lost, reason)

    def _is_drawn(self, source: str) -> bool:
        return any(source in grid.sources for grid in self._parts.grids)

    def _draw(self, source: str, value: Scan | Round | Touch) -> None:
        if not self._moves:
            self._draw_standing(source, value)
        else:
            self._draw_moving(source, value)

    def _draw_moving(self, source: str, value: Scan | Round | Touch) -> None:
        """Raises GoneError if the track is broken under the sweep."""
        localiser = self._parts.localiser
        if isinstance(value, Round | Touch):
            odom_from_base = self._poses.at(value.stamp_ns)
            if localiser.take_round(source, value, odom_from_base):
                self._insert_round(source, value, localiser.map_from_odom() @ odom_from_base)
            return
        base_from_sensor = self._laser(source).base_from_sensor
        odom_from_bases = self._poses.at_many(beam_stamps(value))
        if not localiser.take_scan(source, value, self._poses, base_from_sensor):
            return
        map_from_base = compose_many(localiser.map_from_odom(), odom_from_bases)
        self._insert_sweep(source, value, carry(map_from_base, base_from_sensor))

    def _draw_standing(self, source: str, value: Scan | Round | Touch) -> None:
        """On a robot that is taken to stand where it is."""
        map_from_base = self._parts.localiser.map_from_odom()
        if isinstance(value, Round | Touch):
            self._insert_round(source, value, map_from_base)
            return
        pose = map_from_base @ self._laser(source).base_from_sensor
        self._insert_sweep(source, value, np.array([pose.x_m, pose.y_m, pose.yaw_rad]))

    def _laser(self, source: str) -> Laser:
        laser = self._parts.sensors[source]
        assert isinstance(laser, Laser)
        return laser

    def _insert_sweep(self, source: str, scan: Scan, map_from_sensor: F64) -> None:
        for grid in self._drawn_by(source):
            try:
                grid.take_sweep(source, scan, map_from_sensor)
            except ValueError:  # farther or longer than a grid can hold
                self._drop(source, "map_refused")

    def _insert_round(self, source: str, heard: Round | Touch, map_from_base: Pose2) -> None:
        for grid in self._drawn_by(source):
            try:
                if isinstance(heard, Round):
                    grid.take_round(source, heard, map_from_base)
                else:
                    grid.take_touch(source, heard, map_from_base)
            except ValueError:
                self._drop(source, "map_refused")

    def _drawn_by(self, source: str) -> list[GridLayer]:
        """Grids that take what a source says now."""
        grids = self._parts.grids if self._parts.localiser.is_placed() else self._around
        return [grid for grid in grids if source in grid.sources]

    # --- small things

    def _is_newer(self, source: str, stamp_ns: int, now_ns: int) -> bool:
        """Whether a stamp follows the source's last one; counts it otherwise."""
        last = self._last_stamps.get(source)
        if stamp_ns > now_ns + _AHEAD_LIMIT_NS:
            self._drop(source, "stamp_ahead")
        elif last is not None and stamp_ns <= last:
            self._drop(source, "stamp_equal" if stamp_ns == last else "stamp_backward")
        else:
            self._last_stamps[source] = stamp_ns
            return True
        return False

    def _fed_by(self, source: str) -> list[int]:
        return [index for index, layer in enumerate(self._parts.sectors) if source in layer.sources]

    def _told_since_ns(self, index: int, now_ns: int) -> int:
        told_ns = self._sectors_told_ns.get(index)
        return _SECTOR_PERIOD_NS if told_ns is None else now_ns - told_ns

    def _tell(self, index: int, now_ns: int) -> PolarOut | RectOut:
        self._sectors_told_ns[index] = now_ns
        self._sectors_untold.discard(index)
        return self._parts.sectors[index].output(now_ns)

    def _drop(self, source: str, reason: str, count: int = 1) -> list[Output]:
        reasons = self.drops.setdefault(source, {})
        reasons[reason] = reasons.get(reason, 0) + count
        return []


class _HeldPoses(PoseBuffer):
    """A pose buffer that answers with its newest pose for later times: for sector maps, which do not wait."""

    def __init__(self, poses: PoseBuffer) -> None:
        self._poses = poses

    def at_many(self, stamp_ns: ArrayLike) -> F64:
        return self._poses.at_many(np.minimum(np.asarray(stamp_ns, dtype=np.int64), self._poses.newest_ns or 0))


class _ChainMemory:
    """The newest range of every channel of a chain."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._places = {each.channel: index for index, each in enumerate(chain.transducers)}
        self.forget()

    def forget(self) -> None:
        """The chain starts anew: its stamps may too."""
        count = len(self._places)
        self._range_m = [math.nan] * count
        self._believed_m = [math.nan] * count
        self._doubted_m = [math.nan] * count
        self._stamp_ns: list[int | None] = [None] * count
        self._interval_ns = float(self._chain.period_ns)

    @property
    def stale_after_ns(self) -> int:
        """How long its ranges hold: by its rate, measured or as configured, whichever is slower."""
        return stale_after_ns(int(max(self._interval_ns, self._chain.period_ns)), 0)

    def take(self, reading: ChainReading) -> tuple[tuple[Cone, ...], list[str]]:
        """A cone for every transducer that is configured, and a reason for every value that was refused."""
        cones: list[Cone] = []
        refused: list[str] = []
        for heard in reading.ranges:
            place = self._places.get(heard.channel)
            if place is None:
                if heard.status is not RangeStatus.NOT_LOOKED:
                    refused.append("unknown_channel")
                continue
            last_ns = self._stamp_ns[place]
            if last_ns is not None and reading.stamp_ns <= last_ns:
                refused.append("stamp_equal" if reading.stamp_ns == last_ns else "stamp_backward")
                continue
            if last_ns is not None:
                self._interval_ns += 0.2 * (min(reading.stamp_ns - last_ns, SECOND) - self._interval_ns)
            self._stamp_ns[place] = reading.stamp_ns
            range_m = self._range_of(heard.status, heard.range_m) if heard.heard_from is None else math.nan
            if self._chain.unchecked and self._is_doubtful(place, range_m):
                refused.append("unconfirmed")
                range_m = math.nan
            self._range_m[place] = range_m
            cones.append(Cone(heard.channel, self._chain.transducers[place].base_from_transducer, range_m))
        return tuple(cones), refused

    def _is_doubtful(self, place: int, range_m: float) -> bool:
        """Whether a range is much farther than the last one that was believed, and not yet said twice.

        A wrong near range costs a detour, a wrong far one a bumper.
        """
        if math.isnan(range_m):
            return False
        doubted_m, self._doubted_m[place] = self._doubted_m[place], range_m
        confirmed = range_m == doubted_m or abs(range_m - doubted_m) <= _CONFIRMED_M
        if range_m <= self._believed_m[place] + _CONFIRMED_M or math.isnan(self._believed_m[place]) or confirmed:
            self._believed_m[place] = range_m
            return False
        return True

    def _range_of(self, status: RangeStatus, range_m: float) -> float:
        """By the rule of readings.py, within the limits of this chain's transducers."""
        match status:
            case RangeStatus.NO_RETURN:
                return math.inf
            case RangeStatus.TOO_CLOSE:
                return -math.inf
            case RangeStatus.ECHO if math.isfinite(range_m) and range_m > 0.0:
                if range_m > self._chain.range_max_m:
                    return math.inf
                return range_m if range_m >= self._chain.range_min_m else -math.inf
        return math.nan

    def output(self, now_ns: int) -> RangesOut:
        """The whole chain; what is too old to be believed is NaN."""
        chain, limit_ns = self._chain, self.stale_after_ns
        fresh = (stamp_ns is not None and now_ns - stamp_ns <= limit_ns for stamp_ns in self._stamp_ns)
        return RangesOut(
            chain.name,
            now_ns,
            tuple(each.base_from_transducer for each in chain.transducers),
            chain.cone_rad,
            chain.range_min_m,
            chain.range_max_m,
            tuple(range_m if is_fresh else math.nan for range_m, is_fresh in zip(self._range_m, fresh)),
        )


class _ContactMemory:
    """When every switch of a device was last seen tripped: contacts bounce, and a wall stays when a robot backs off."""

    def __init__(self, contacts: Contacts) -> None:
        self._switches = {switch.line: switch for switch in contacts.switches}
        self._hold_ns = contacts.hold_ns
        self._tripped_ns: dict[int, int] = {}

    def take(self, reading: ContactReading, stamp_ns: int) -> tuple[list[Touch], int]:
        """What the switches of a reading say now, and how many of its lines nobody knows."""
        touches, unknown = [], 0
        for heard in reading.lines:
            switch = self._switches.get(heard.line)
            if switch is None:
                unknown += 1
                continue
            if heard.state is ContactState.TRIPPED:
                self._tripped_ns[heard.line] = stamp_ns
            held = stamp_ns - self._tripped_ns.get(heard.line, -_FOREVER_NS) < self._hold_ns
            not_tripped = None if heard.state is ContactState.UNKNOWN else False
            touches.append(Touch(stamp_ns, switch, True if held else not_tripped))
        return touches, unknown


def compose_many(a_from_b: Pose2, b_from_c: F64) -> F64:
    """a_from_c (N, 3) of one pose and many."""
    placed: F64 = motion.placed(np.ascontiguousarray(b_from_c), a_from_b.x_m, a_from_b.y_m, a_from_b.yaw_rad)
    return placed


def carry(a_from_b: F64, b_from_c: Pose2) -> F64:
    """a_from_c (N, 3) of many poses and one."""
    moved: F64 = motion.carried(np.ascontiguousarray(a_from_b), b_from_c.x_m, b_from_c.y_m, b_from_c.yaw_rad)
    return moved


def stale_after_ns(period_ns: int, sweep_ns: int) -> int:
    """How old evidence may be, from its stamp: three periods after its sweep ended, never more than 500 ms."""
    return min(3 * period_ns + sweep_ns, _STALE_LIMIT_NS) if period_ns > 0 else _STALE_LIMIT_NS


def _pose_out(located: Located) -> PoseOut:
    return PoseOut(located.stamp_ns, located.map_from_base, located.map_from_odom, located.covariance)


def _laser_odometry() -> LaserOdometry:
    from mapping.localise.laser_odometry import LaserOdometry  # its kernels, only where they are needed

    return LaserOdometry()


def _last_beam_ns(scan: Scan) -> int:
    return scan.stamp_ns + math.ceil((len(scan.bearing_rad) - 1) * scan.beam_period_ns)


def _fault_of_scan(reading: ScanReading, bearing: F64, distance: F64) -> str | None:
    """Why these arrays are no scan, or None."""
    if bearing.ndim != 1 or distance.shape != bearing.shape:
        return "wrong_count"
    if len(bearing) == 0:
        return "no_beams"
    if len(bearing) > _BEAMS_MAX:
        return "too_many_beams"
    if not np.isfinite(bearing).all():
        return "bearing_not_finite"
    period = reading.beam_period_ns
    if not math.isfinite(period) or not 0.0 <= period * len(bearing) <= 10 * SECOND:
        return "times_wrong"
    limits = (reading.range_min_m, reading.range_max_m)
    if not all(math.isfinite(limit) for limit in limits) or not 0.0 <= limits[0] < limits[1]:
        return "limits_wrong"
    return None


def _twist_variances(before: OdometryState | None, now: OdometryState) -> tuple[float, float]:
    """Of forward speed and yaw rate over the last step: by how much it made the pose less certain."""
    seconds = 0.0 if before is None else (now.stamp_ns - before.stamp_ns) * 1e-9
    if before is None or now.broken or seconds <= 0.0:
        return UNKNOWN_VARIANCE, UNKNOWN_VARIANCE
    grown = now.covariance - before.covariance
    ahead = np.array([math.cos(before.odom_from_base.yaw_rad), math.sin(before.odom_from_base.yaw_rad)])
    forward = max(0.0, float(ahead @ grown[:2, :2] @ ahead)) / seconds**2
    turn = max(0.0, float(grown[2, 2])) / seconds**2
    return forward + _SPEED_VARIANCE_MIN, turn + _SPEED_VARIANCE_MIN
