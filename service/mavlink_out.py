"""A polar sector map as MAVLink OBSTACLE_DISTANCE, for the obstacle avoidance of ArduPilot and PX4; and HEARTBEAT.

72 elements of 5 degrees, element 0 straight ahead, then clockwise, in the body frame (MAV_FRAME_BODY_FRD), centimetres
from the base's origin:

    range_min .. range_max     something is there; nearer than range_min counts as range_min, or autopilots ignore it
    max_distance + 1           the whole element was looked at, nothing up to max_distance
    65535                      not looked at, not up to max_distance, or too long ago

Where an element overlaps several sectors, the nearest obstacle of all of them counts: an obstacle may appear in the
element beside its own, it never disappears. max_distance is as far as the sensors see: the farthest that a free sector
was seen free, at most the configured limit.

The messages leave on a steady beat, whether the map is new or not; without a map for half a second every element is
65535. Sources: common.xml; AP_Proximity_MAV and CollisionPrevention for what is made of it (docs/mavlink.md).
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import PortError
from drivers.mavlink_frames import HEARTBEAT, OBSTACLE_DISTANCE, encode_v2
from drivers.ports import Clock
from drivers.reader import WireReader
from mapping.frames import IDENTITY
from mapping.sectors.footprint import Outline
from mapping.sectors.snapshot import PolarSnapshot, SectorState
from service.outputs import Output, PolarOut

log = logging.getLogger(__name__)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

ELEMENTS = 72
UNKNOWN = 65535
_WIDTH_RAD = 2.0 * math.pi / ELEMENTS
_INCREMENT_DEG = 5
_FRAME_BODY_FRD = 12
_LASER, _ULTRASOUND, _SENSOR_UNKNOWN = 0, 1, 4
_ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, _STATE_ACTIVE, _MAVLINK_VERSION = 18, 8, 4, 3
_STALE_NS = 500_000_000
_HEARTBEAT_NS = 1_000_000_000
_FARTHEST_CM = 60000
_RAYS = 5  # through an element, where the map's origin is not the base's
_STEP_M = 0.05
_RETRY_NS = 1_000_000_000


# --- a sector map in 72 elements ------------------------------------------------------------------------------------


def distances_m(snapshot: PolarSnapshot, range_max_m: float, footprint: ArrayLike) -> F64:
    """(72,) what each element knows, clockwise from straight ahead: distance, +inf empty to range_max_m, NaN unknown.

    footprint: (V, 2) corners in the base frame; what lies inside needs no looking at.
    """
    pose = snapshot.base_from_sensor
    if math.hypot(pose.x_m, pose.y_m) < 1e-6:
        return _from_the_same_origin(snapshot, range_max_m)
    return _from_another_origin(snapshot, range_max_m, footprint)


def seen_reach_m(snapshot: PolarSnapshot) -> float:
    """The farthest that was looked in any sector, free or up to an obstacle; 0 if nowhere."""
    return float(_known_free_m(snapshot).max(initial=0.0))


def _known_free_m(snapshot: PolarSnapshot) -> F64:
    """(N,) up to which nothing is in each sector: nothing is nearer than its nearest obstacle."""
    known = (snapshot.state == SectorState.FREE) | (snapshot.state == SectorState.OBSTACLE)
    return np.where(known & np.isfinite(snapshot.distance_m), snapshot.distance_m, 0.0)


def _from_the_same_origin(snapshot: PolarSnapshot, range_max_m: float) -> F64:
    centre = -_WIDTH_RAD * np.arange(ELEMENTS) - snapshot.base_from_sensor.yaw_rad
    low = snapshot.edges_rad[:-1]
    begin: F64 = np.asarray(centre - 0.5 * _WIDTH_RAD, dtype=np.float64)
    overlap = _overlap(begin, low, np.diff(snapshot.edges_rad))
    touches = overlap > 1e-9
    reach = _known_free_m(snapshot)
    obstacle = np.where(snapshot.state == SectorState.OBSTACLE, snapshot.distance_m, np.inf)
    nearest = np.where(touches, obstacle, np.inf).min(axis=1)
    least_reach = np.where(touches, reach, np.inf).min(axis=1)
    is_covered = overlap.sum(axis=1) >= _WIDTH_RAD - 1e-6
    empty = is_covered & (least_reach >= range_max_m - 1e-9)
    return np.where(nearest <= range_max_m, nearest, np.where(empty, np.inf, np.nan))


def _overlap(begin: F64, low: F64, width: F64) -> F64:
    """(72, N) radians shared by each element, from `begin` on, and each sector, from `low` on."""
    offset = (low[None, :] - begin[:, None]) % (2.0 * math.pi)  # of the sector's begin behind the element's
    ahead = np.clip(np.minimum(_WIDTH_RAD, offset + width) - offset, 0.0, None)
    behind = np.clip(np.minimum(_WIDTH_RAD, offset - 2.0 * math.pi + width), 0.0, None)  # it began before, reaches in
    return np.asarray(ahead + behind, dtype=np.float64)


def _from_another_origin(snapshot: PolarSnapshot, range_max_m: float, footprint: ArrayLike) -> F64:
    """Along rays from the base: how far what is known to be free goes, and whether an obstacle ends it."""
    share = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
    bearing = -_WIDTH_RAD * np.arange(ELEMENTS)[:, None] + _WIDTH_RAD * share
    along = np.arange(0.0, range_max_m + _STEP_M, _STEP_M).clip(max=range_max_m)
    inside = along < Outline(footprint, IDENTITY).border_m(bearing.ravel())[:, None] + _STEP_M
    x = np.cos(bearing.ravel())[:, None] * along
    y = np.sin(bearing.ravel())[:, None] * along
    points = snapshot.base_from_sensor.inverse().apply(np.stack((x.ravel(), y.ravel()), axis=-1))
    distance = np.hypot(points[:, 0], points[:, 1]).reshape(x.shape)
    sector = _sector_at(snapshot.edges_rad, np.arctan2(points[:, 1], points[:, 0])).reshape(x.shape)
    reach = np.append(_known_free_m(snapshot), 0.0)[sector]
    is_out = ~inside & (distance > reach)
    first = is_out.argmax(axis=1)
    rows = np.arange(len(first))
    states = np.append(snapshot.state, SectorState.UNKNOWN)
    met = is_out.any(axis=1) & (states[sector[rows, first]] == SectorState.OBSTACLE)
    ends = np.where(met, along[np.maximum(first - 1, 0)], np.where(is_out.any(axis=1), np.nan, np.inf))
    rays = np.vstack([ends.reshape(ELEMENTS, _RAYS).T, _obstacles_m(snapshot, range_max_m)])
    nearest = np.where(np.isfinite(rays), rays, np.inf).min(axis=0)
    return np.where(np.isfinite(nearest), nearest, np.where(np.isnan(rays).any(axis=0), np.nan, np.inf))


def _obstacles_m(snapshot: PolarSnapshot, range_max_m: float) -> F64:
    """(72,) the nearest obstacles themselves, seen from the base, whatever hides them; +inf where there is none."""
    is_obstacle = snapshot.state == SectorState.OBSTACLE
    bearing, distance = snapshot.bearing_rad[is_obstacle], snapshot.distance_m[is_obstacle]
    points = snapshot.base_from_sensor.apply(
        np.stack((distance * np.cos(bearing), distance * np.sin(bearing)), axis=-1).reshape(-1, 2)
    )
    found = np.full(ELEMENTS, np.inf)
    element = np.round(-np.arctan2(points[:, 1], points[:, 0]) / _WIDTH_RAD).astype(np.int64) % ELEMENTS
    np.minimum.at(found, element, np.hypot(points[:, 0], points[:, 1]))
    return np.where(found <= range_max_m, found, np.inf)


def _sector_at(edges_rad: F64, bearing_rad: F64) -> I64:
    """Index of the sector at each bearing, one past the last where there is none."""
    count = len(edges_rad) - 1
    turned = edges_rad[0] + (bearing_rad - edges_rad[0]) % (2.0 * math.pi)
    index = np.searchsorted(edges_rad, turned, side="right") - 1
    return np.where(turned < edges_rad[-1], np.minimum(index, count - 1), count).astype(np.int64)


def distances_cm(known_m: F64, min_cm: int, max_cm: int) -> tuple[int, ...]:
    """The 72 values of the message. Rounded down: nothing is farther than it is."""
    values = np.full(ELEMENTS, UNKNOWN, dtype=np.int64)
    finite = np.isfinite(known_m)
    values[finite] = np.clip(np.floor(known_m[finite] * 100.0 + 1e-6), min_cm, max_cm)
    values[np.isposinf(known_m)] = max_cm + 1
    return tuple(int(value) for value in values)


# --- messages -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Settings:
    """What is sent. source: name of the polar map.  sensor_type: of MAV_DISTANCE_SENSOR.  footprint: base frame."""

    source: str
    footprint: tuple[tuple[float, float], ...]
    system_id: int = 1
    component_id: int = 196
    rate_hz: float = 15.0
    range_min_m: float = 0.1
    range_max_m: float = 10.0
    sensor_type: int = _SENSOR_UNKNOWN


def sensor_type_of(kinds: Iterable[str]) -> int:
    """MAV_DISTANCE_SENSOR of what feeds a map: laser or ultrasound if it is nothing else."""
    return {frozenset(["laser"]): _LASER, frozenset(["sonar"]): _ULTRASOUND}.get(frozenset(kinds), _SENSOR_UNKNOWN)


class Talker:
    """What is to be sent when: pure, time is handed in."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._sequence = 0
        self._heartbeat_ns: int | None = None
        self._seen_m = 0.0

    def frames(self, snapshot: PolarSnapshot | None, now_ns: int) -> list[bytes]:
        """The frames that are due on a beat at now_ns. snapshot: the newest, None before the first."""
        frames = []
        if self._heartbeat_ns is None or now_ns - self._heartbeat_ns >= _HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            values = (0, _ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, _STATE_ACTIVE, _MAVLINK_VERSION)
            frames.append(self._frame(HEARTBEAT, values))
        frames.append(self._obstacles(snapshot, now_ns))
        return frames

    def _obstacles(self, snapshot: PolarSnapshot | None, now_ns: int) -> bytes:
        settings = self._settings
        min_cm = max(1, math.ceil(settings.range_min_m * 100.0 - 1e-6))
        if snapshot is not None:
            self._seen_m = max(self._seen_m, seen_reach_m(snapshot))
        range_max_m = min(settings.range_max_m, self._seen_m or settings.range_max_m)
        max_cm = min(max(math.floor(range_max_m * 100.0 + 1e-6), min_cm + 1), _FARTHEST_CM)
        if snapshot is None or now_ns - snapshot.stamp_ns > _STALE_NS:
            known = np.full(ELEMENTS, np.nan)
            stamp_ns = now_ns
        else:
            known = distances_m(snapshot, max_cm / 100.0, settings.footprint)
            stamp_ns = snapshot.stamp_ns
        values = (
            stamp_ns // 1000,
            *distances_cm(known, min_cm, max_cm),
            min_cm,
            max_cm,
            settings.sensor_type,
            _INCREMENT_DEG,
            0.0,  # increment_f: only for what is not a whole number of degrees
            0.0,  # angle_offset: element 0 is centred on straight ahead
            _FRAME_BODY_FRD,
        )
        return self._frame(OBSTACLE_DISTANCE, values)

    def _frame(self, message_id: int, values: tuple[float, ...]) -> bytes:
        frame = encode_v2(
            message_id,
            values,
            sequence=self._sequence,
            system=self._settings.system_id,
            component=self._settings.component_id,
        )
        self._sequence = (self._sequence + 1) % 256
        return frame


# --- the thread -----------------------------------------------------------------------------------------------------


class Link(Protocol):
    """What is needed of a port."""

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]: ...

    def write(self, item: bytes) -> None: ...

    def close(self) -> None: ...


class ReaderLink:
    """The wire of a MAVLink source that hears and speaks on the same line: its reader sends for us."""

    def __init__(self, reader: WireReader[bytes]) -> None:
        self._reader = reader

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        """Nothing: what arrives is the source's."""
        return []

    def write(self, item: bytes) -> None:
        self._reader.post(item)

    def close(self) -> None:
        """The wire is the reader's."""


class MavlinkOut:
    """Owns the thread that sends. offer() takes fusion's outputs and never blocks."""

    def __init__(self, settings: Settings, open_link: Callable[[], Link], *, clock: Clock) -> None:
        self._settings = settings
        self._open_link = open_link
        self._clock = clock
        self._talker = Talker(settings)
        self._newest: PolarSnapshot | None = None
        self._link: Link | None = None
        self._retry_ns = 0
        self._trouble: str | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)
        self.sent = 0
        self.late = 0

    def offer(self, output: Output) -> None:
        """Take the newest of the map that is sent."""
        if isinstance(output, PolarOut) and output.name == self._settings.source:
            self._newest = output.snapshot

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, deadline_s: float) -> bool:
        """End; False if that took longer."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(deadline_s)
        return not self._thread.is_alive()

    def trouble(self) -> str | None:
        """Why nothing is sent, in one line with the repair."""
        return self._trouble

    def counters(self) -> dict[str, int]:
        """Frames sent, and beats that came late."""
        return {"mavlink.sent": self.sent, "mavlink.late_beats": self.late}

    def beat(self) -> None:
        """One turn: what is due leaves. Tests call it without the thread."""
        now_ns = self._clock()
        frames = self._talker.frames(self._newest, now_ns)
        try:
            if self._link is None:
                if now_ns < self._retry_ns:
                    return
                self._retry_ns = now_ns + _RETRY_NS
                self._link = self._open_link()
            while self._link.read(0.0):
                pass  # what the autopilot says is drained, or its words would fill the line
            for frame in frames:
                self._link.write(frame)
                self.sent += 1
            self._trouble = None
        except PortError as error:
            self._note(error)

    def _note(self, error: PortError) -> None:
        if self._trouble is None:
            log.warning("mavlink: %s", error)
        self._trouble = f"[mavlink] {error}"
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _run(self) -> None:
        period_ns = round(1e9 / self._settings.rate_hz)
        due_ns = self._clock()
        while not self._stopping.wait(max(0.0, (due_ns - self._clock()) / 1e9)):
            try:
                self.beat()
            except Exception:  # a bug here must not leave the autopilot with an old picture of the world
                log.exception("mavlink: internal error; the next beat is tried again")
            due_ns += period_ns
            if (now_ns := self._clock()) > due_ns + period_ns:
                self.late += 1
                due_ns = now_ns
        if self._link is not None:
            self._link.close()
