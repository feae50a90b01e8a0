"""What a recorded log holds, whatever dialect it was written in; SI units, angles counter-clockwise.

Ranges follow the rule of `drivers.readings`: +inf nothing seen, NaN nothing known; the reader decides which numbers of
a log are "no echo" (see `no_echo_threshold`). Poses are rows (x_m, y_m, yaw_rad).
"""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
PlanarPose = tuple[float, float, float]

SYNTHETIC_SPEED_M_S = 0.3
SYNTHETIC_TURN_RAD_S = 0.5
SYNTHETIC_SHORTEST_S = 0.1
SMALLEST_ORDERED_SHARE = 0.8  # more rows out of order than the rest: the file is shuffled, the stamps are right
SHORTEST_LIMIT_M = 3.9  # no laser's range ends sooner
WORST_LEGIBLE_SHARE = 0.5  # fewer different stamps than this share of the scans: the stamps are useless


class LogError(ValueError):
    """A file that is not a log we can read; the text names the file, what was found and what would be right."""


class PoseKind(Enum):
    """Where the poses written beside the scans come from."""

    ODOMETRY = "odometry"  # the wheels: drifts
    CORRECTED = "corrected"  # somebody's mapper: consistent


@dataclass(frozen=True, slots=True)
class LogScan:
    """One sweep of a log.

    stamp_s: seconds, never falling from scan to scan; repaired or made up where the file's make no sense (`Log`).
    stamp_text: the scan's name: the stamp as the file has it (files of relations name scans by it, so trajectories
    should too), or stamp_s if stamps were made up.  bearing_rad, range_m: (N,) sensor frame, beams from right to left;
    bearings are shared between scans and read-only.  laser_pose, robot_pose: as logged, or dead reckoned from ticks.
    line: where in the file, from 1.
    """

    stamp_s: float
    stamp_text: str
    bearing_rad: F64
    range_m: F64
    laser_pose: PlanarPose
    robot_pose: PlanarPose
    line: int


@dataclass(frozen=True, slots=True)
class WheelGeometry:
    """How a log's ticks become metres; a factor is negative where ticks fall when rolling forward."""

    left_m_per_tick: float
    right_m_per_tick: float
    track_width_m: float


@dataclass(frozen=True, slots=True)
class Odometry:
    """Robot poses by the log's own odometry, or its corrected path: stamp_s (M,) rising, pose (M, 3)."""

    stamp_s: F64
    pose: F64

    def __len__(self) -> int:
        return len(self.stamp_s)


@dataclass(frozen=True, slots=True)
class Ticks:
    """Running totals of wheel ticks: stamp_s (M,) rising, left and right (M,), counting directions of the device."""

    stamp_s: F64
    left: I64
    right: I64

    def __len__(self) -> int:
        return len(self.stamp_s)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a log came from: enough to name it in a report and to see that it is the same file."""

    path: str
    dialect: str
    file_bytes: int
    sha256: str
    comments: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Log:
    """A whole log.

    scans: in the order in which they were taken.  robot_from_laser: where the laser sits on the robot.
    no_echo_from_m: readings at or above it were taken as "no echo" (+inf if the log has none).
    stamps_repaired: how many scans' stamps were replaced (`in_order`).  stamps_made_up: all were (`made_up_stamps`).
    skipped: lines that were not used, by reason.  ticks: raw counts, where the log has them.  wheels: their meaning, or
    what made the odometry.  odometry_by_laser: it was made from the scans themselves.
    """

    scans: tuple[LogScan, ...]
    odometry: Odometry
    poses: PoseKind
    robot_from_laser: PlanarPose
    range_max_m: float
    no_echo_from_m: float
    stamps_repaired: int
    stamps_made_up: bool
    provenance: Provenance
    ticks: Ticks | None = None
    wheels: WheelGeometry | None = None
    odometry_by_laser: bool = False
    skipped: dict[str, int] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """From the first scan to the last."""
        return self.scans[-1].stamp_s - self.scans[0].stamp_s if self.scans else 0.0


def read_head(path: Path, characters: int) -> str:
    """The beginning of a file's text, unpacked if it is gzip."""
    raw, _ = _packed(path)
    with _damage_told(path):
        return _text(raw).read(characters)


def read_lines(path: Path) -> tuple[Iterator[str], Provenance]:
    """The lines of a file, unpacked on the way if it is gzip (by its first bytes, not its name), and where it is from.

    A log of an hour has tens of megabytes of text: no more of it than a line is kept.
    """
    raw, provenance = _packed(path)
    return _lines(path, raw), provenance


def _packed(path: Path) -> tuple[bytes, Provenance]:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    digest = hashlib.sha256(raw).hexdigest()
    return raw, Provenance(path=str(path), dialect="", file_bytes=len(raw), sha256=digest)


def _lines(path: Path, raw: bytes) -> Iterator[str]:
    with _damage_told(path):
        yield from _text(raw)


def _text(raw: bytes) -> io.TextIOWrapper:
    packed = io.BytesIO(raw)
    is_gzip = raw[:2] == b"\x1f\x8b"
    return io.TextIOWrapper(gzip.GzipFile(fileobj=packed) if is_gzip else packed, encoding="utf-8", errors="replace")


@contextmanager
def _damage_told(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"{path}: damaged gzip file ({error}); fetch it again") from error


def compose(a: PlanarPose, b: PlanarPose) -> PlanarPose:
    """Pose of c in a's parent frame, from a and the pose b of c in a; yaw in [-pi, pi)."""
    c, s = np.cos(a[2]), np.sin(a[2])
    yaw = (a[2] + b[2] + np.pi) % (2.0 * np.pi) - np.pi
    return (float(a[0] + c * b[0] - s * b[1]), float(a[1] + s * b[0] + c * b[1]), float(yaw))


def relative(a: ArrayLike, b: ArrayLike) -> F64:
    """Poses b seen from poses a, row by row: inverse(a) * b; both (M, 3), yaw in [-pi, pi)."""
    p, q = np.atleast_2d(np.asarray(a, dtype=np.float64)), np.atleast_2d(np.asarray(b, dtype=np.float64))
    c, s = np.cos(p[:, 2]), np.sin(p[:, 2])
    d = q[:, :2] - p[:, :2]
    yaw = (q[:, 2] - p[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack((c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], yaw), axis=-1)


def mounting_of(robot_poses: ArrayLike, laser_poses: ArrayLike) -> PlanarPose:
    """Where the laser sits on the robot: the median over all scans of the laser's pose seen from the robot's."""
    seen = relative(robot_poses, laser_poses)
    if not len(seen):
        return (0.0, 0.0, 0.0)
    yaw = float(np.median(seen[:, 2]))
    x, y = (round(float(v), 4) + 0.0 for v in np.median(seen[:, :2], axis=0))
    return (x, y, round(yaw, 6) + 0.0)


def dead_reckoning(left_m: ArrayLike, right_m: ArrayLike, track_width_m: float) -> F64:
    """Poses (M, 3) of a differential drive from running wheel travels (M,), starting at the origin.

    Between two samples both wheels turn evenly, so the robot follows an arc, whose chord is exact (S01).
    """
    left, right = np.asarray(left_m, dtype=np.float64), np.asarray(right_m, dtype=np.float64)
    turn = np.diff(right - left) / track_width_m
    forward = 0.5 * np.diff(left + right) * np.sinc(turn / (2.0 * np.pi))  # chord = arc * sin(t/2) / (t/2)
    yaw = np.concatenate(([0.0], np.cumsum(turn)))
    heading = yaw[:-1] + 0.5 * turn
    pose = np.zeros((len(left), 3))
    pose[1:, 0] = np.cumsum(forward * np.cos(heading))
    pose[1:, 1] = np.cumsum(forward * np.sin(heading))
    pose[:, 2] = (yaw + np.pi) % (2.0 * np.pi) - np.pi
    return pose


def no_echo_threshold(scans: Sequence[F64], declared_max_m: float | None = None) -> float:
    """The reading from which on a log means "no echo", or +inf if the log has no such reading.

    Lasers write one fixed number (or a few) for it, their largest: a needle in the histogram at the far end, seen
    by beams all over the field. A wall at the log's greatest distance is no such needle: noise and slant spread it, and
    only a few beams meet it. So among the 1 cm bins within 3 % of the largest reading the lowest needle counts: 3 times
    what its neighbourhood of 10 cm holds, more than a fluke, said by at least one beam in 30, not by all beams always,
    and no shorter than any laser's limit. Readings of 81.83 m and more are codes of SICK's LMS family (8183 and up, in
    cm), few or many; a declared maximum range counts too.
    """
    scans = [np.asarray(s, dtype=np.float64) for s in scans]
    real = [np.flatnonzero(np.isfinite(s) & (s > 0.0)) for s in scans]
    readings = sum(map(len, real))
    largest = max((float(s[at].max()) for s, at in zip(scans, real) if len(at)), default=0.0)
    candidates = [81.825]
    if declared_max_m is not None and declared_max_m > 0.0:
        candidates.append(declared_max_m - 0.005)
    if largest >= SHORTEST_LIMIT_M:
        far = [at[s[at] >= 0.97 * largest - 0.1] for s, at in zip(scans, real)]
        last_beam = max(int(at[-1]) for at in real if len(at))
        far_m = np.concatenate([s[at] for s, at in zip(scans, far)])
        candidates.extend(_needles(far_m, np.concatenate(far), largest, readings, last_beam))
    threshold = min(candidates)
    return threshold if readings and largest >= threshold else np.inf


def _needles(far_m: F64, beams: NDArray[np.intp], largest: float, readings: int, last_beam: int) -> list[float]:
    """far_m, beams: (M,) readings near the largest and which beam said each, of so many readings in all."""
    bins = np.rint(far_m * 100.0).astype(np.int64)
    first = int(bins.min())
    count = np.bincount(bins - first)
    fluke = max(10, readings // 10000)
    wide = max(3, (last_beam + 1) // 30)
    found = []
    for k in np.flatnonzero(count >= fluke):
        near = int(count[max(0, k - 1) : k + 2].sum())
        around = int(count[max(0, k - 10) : k + 11].sum()) - near
        everywhere = len(np.unique(beams[bins == first + k])) >= wide
        at_end = first + k >= 97.0 * largest
        if at_end and near >= 3 * around and everywhere and count[k] < 0.95 * readings:
            found.append((first + int(k)) / 100.0 - 0.005)
    return found


def without_fillers(scans: Sequence[LogScan]) -> list[LogScan]:
    """Scans with NaN for what is no distance: zero, negative, not a number, or a filler.

    A filler is a beam that says the same far number in every scan of a long log: it does not measure.
    """
    fillers = _fillers(scans)
    out = []
    for scan in scans:
        r = np.where(scan.range_m > 0.0, scan.range_m, np.nan)
        r[fillers.get(len(r), [])] = np.nan
        out.append(replace(scan, range_m=r))
    return out


def without_echo_from(scans: Sequence[LogScan], threshold_m: float) -> list[LogScan]:
    """Scans with +inf for readings from threshold_m on."""
    return [replace(s, range_m=np.where(s.range_m >= threshold_m, np.inf, s.range_m)) for s in scans]


def _fillers(scans: Sequence[LogScan], *, shortest_log: int = 50) -> dict[int, list[int]]:
    """For each number of beams: the beams that never change."""
    groups: dict[int, list[F64]] = {}
    for scan in scans:
        groups.setdefault(len(scan.range_m), []).append(scan.range_m)
    largest = max((float(np.max(s.range_m, initial=0.0)) for s in scans), default=0.0)
    found: dict[int, list[int]] = {}
    for beams, rows in groups.items():
        if len(rows) < shortest_log:
            continue
        same = rows[0] >= 0.9 * largest
        for row in rows:
            same &= row == rows[0]
        if same.mean() < 0.1:  # a few dead beams; a sensor looking into the void is another matter
            found[beams] = [int(i) for i in np.flatnonzero(same)]
    return found


def in_order(stamps_s: ArrayLike) -> tuple[NDArray[np.intp], F64, int]:
    """The order in which rows of one kind were taken, their stamps in that order, and how many stamps were replaced.

    A logger writes rows as they come, so if nearly all stamps rise with the lines, the lines are right and the few
    stamps that break the order are wrong (Intel's clock prints 5.040404 s as 5.40404: 900 of its rows). They get
    the time between their neighbours. If stamps fall often, the file is shuffled: sort by stamp.
    stamps_s: (M,) in file order.  Returns (M,) indices into it and (M,) stamps, which never fall.
    """
    stamps = np.asarray(stamps_s, dtype=np.float64)
    lines = np.arange(len(stamps))
    if np.all(stamps[1:] >= stamps[:-1]):
        return lines, stamps, 0
    kept = _longest_rising(stamps)
    if len(kept) < SMALLEST_ORDERED_SHARE * len(stamps):
        order = np.argsort(stamps, kind="stable")
        return order, stamps[order], 0
    return lines, np.interp(lines, kept, stamps[kept]), len(stamps) - len(kept)


def _longest_rising(values: F64) -> NDArray[np.intp]:
    """Indices of a longest subsequence that never falls (patience sorting)."""
    tails: list[float] = []
    tail_index: list[int] = []
    before = np.full(len(values), -1, dtype=np.intp)
    for i, value in enumerate(values.tolist()):
        at = bisect_right(tails, value)
        before[i] = tail_index[at - 1] if at else -1
        tails[at : at + 1] = [value]
        tail_index[at : at + 1] = [i]
    chain = []
    i = tail_index[-1] if tail_index else -1
    while i >= 0:
        chain.append(i)
        i = int(before[i])
    return np.array(chain[::-1], dtype=np.intp)


def stamps_are_useless(stamps_s: ArrayLike) -> bool:
    """Whether a log's stamps were written with too few digits to order its scans."""
    stamps = np.asarray(stamps_s, dtype=np.float64)
    return len(stamps) > 2 and len(np.unique(stamps)) < WORST_LEGIBLE_SHARE * len(stamps)


def made_up_stamps(poses: ArrayLike) -> F64:
    """Times for scans whose stamps are useless: as if driven at 0.3 m/s and turned at 0.5 rad/s, in file order.

    poses: (M, 3).  Returns (M,) seconds from 0, at least 0.1 s apart.
    """
    p = np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    if not len(p):
        return np.zeros(0)
    step = relative(p[:-1], p[1:])
    driving = np.hypot(step[:, 0], step[:, 1]) / SYNTHETIC_SPEED_M_S
    turning = np.abs(step[:, 2]) / SYNTHETIC_TURN_RAD_S
    pauses = np.maximum(np.maximum(driving, turning), SYNTHETIC_SHORTEST_S)
    return np.concatenate(([0.0], np.cumsum(pauses)))


def odometry_from(stamps_s: ArrayLike, poses: ArrayLike) -> Odometry:
    """Odometry in the order in which it was taken (`in_order`), the later row of equal stamps kept."""
    order, stamps, _ = in_order(stamps_s)
    ordered = np.asarray(poses, dtype=np.float64).reshape(-1, 3)[order]
    keep = np.append(stamps[1:] != stamps[:-1], True) if len(stamps) else np.zeros(0, dtype=bool)
    return Odometry(stamps[keep], ordered[keep])


def timed(scans: Sequence[LogScan]) -> tuple[list[LogScan], int, bool]:
    """Scans in the order in which they were taken, with stamps that never fall; how many were repaired; all made up?

    scans: in file order.
    """
    if stamps_are_useless([s.stamp_s for s in scans]):
        times = made_up_stamps([s.laser_pose for s in scans])
        named = [replace(s, stamp_s=round(float(t), 6), stamp_text=f"{t:.6f}") for s, t in zip(scans, times)]
        return named, 0, True
    order, stamps, repaired = in_order([s.stamp_s for s in scans])
    return [replace(scans[i], stamp_s=float(t)) for i, t in zip(order, stamps)], repaired, False


def path_of(scans: Sequence[LogScan], odometry: Odometry) -> Odometry:
    """The robot's path: the log's own odometry if it is about as dense as the scans and spans them, else their poses.

    Not a mixture: scans often carry a pose that is a little old, and a mixture would go to and fro.
    """
    if _spans(odometry, scans):
        return odometry
    return odometry_from([s.stamp_s for s in scans], [s.robot_pose for s in scans])


def _spans(odometry: Odometry, scans: Sequence[LogScan]) -> bool:
    """Whether odometry is about as dense as the scans and spans them."""
    first, last = scans[0].stamp_s, scans[-1].stamp_s
    dense = len(odometry) >= 0.5 * len(scans)
    return dense and bool(odometry.stamp_s[0] - first < 5.0 and last - odometry.stamp_s[-1] < 5.0)


def posed_by(scans: Sequence[LogScan], odometry: Odometry) -> list[LogScan]:
    """Scans with the robot where odometry has it at their stamps, the laser on the robot as before; as they are if
    odometry does not span them."""
    if len(odometry) < 2 or not _spans(odometry, scans):
        return list(scans)
    stamps = np.array([scan.stamp_s for scan in scans])
    x, y, yaw = (np.interp(stamps, odometry.stamp_s, column) for column in _unwrapped(odometry.pose).T)
    robot = zip(x.tolist(), y.tolist(), ((yaw + np.pi) % (2.0 * np.pi) - np.pi).tolist())
    return [
        replace(scan, robot_pose=pose, laser_pose=compose(pose, mounting_of([scan.robot_pose], [scan.laser_pose])))
        for scan, pose in zip(scans, robot)
    ]


def _unwrapped(poses: F64) -> F64:
    return np.column_stack((poses[:, :2], np.unwrap(poses[:, 2])))
