"""Localisation with line features: the robot's pose and the lines of its surroundings in one extended Kalman filter.

    ekf = LineEkf()
    ekf.predict(step, step_covariance)              # odometry, robot frame
    ekf.update(extractor.extract(range_m), base_from_laser)
    ekf.pose, ekf.pose_covariance, ekf.lines()

A line is the angle of its perpendicular from the origin and the perpendicular's length, alpha and d, so that a point p
lies on it if <n(alpha), p> = d. State: x, y, psi of the base in the map, then alpha, d of every line. A wall that is
known (`known`) may be held fixed: the filter then localises and learns nothing.
Derivatives are taken at first estimates (the predicted pose, a line as it was learned), not at corrected ones: else the
filter would believe to have observed which way its map is turned, and become surer than it is.
Cost: with n lines known and m seen about n^2 m. Meant for small computers and for places of a few rooms: it closes
loops no wider than its own uncertainty. Source: S46 (chapter 5.6.2, state vector of pose and line parameters).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapping.frames import IDENTITY, Pose2, wrap_angle, wrap_angles
from mapping.kernels.motion import rolled_covariance
from mapping.lines.lines import Lines

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_POSE = 3
_FARTHEST_M = 1e6


@dataclass(frozen=True, slots=True)
class EkfRules:
    """When an observed line is a known one, when it is new, and how true lines are taken to be.

    gate: squared Mahalanobis distance of (angle, distance) below which a known line may be meant (9.21: 1 % of true
    ones are refused).  surely_other: above this it is another line; between the two it is nobody's and left out.
    gap_m: along the line, how far beyond its known ends it may go on.  new_length_m, new_points: of a line that is
    learned.  flat_m, straight_rad: what walls are off the line that stands for them, added to each observation.
    forget_scans, least_seen: a line not seen least_seen times within so many scans of its birth is forgotten.
    lines_max: then nothing new is learned.
    """

    gate: float = 9.21
    surely_other: float = 40.0
    gap_m: float = 1.5
    new_length_m: float = 0.3
    new_points: int = 5
    flat_m: float = 0.03
    straight_rad: float = 0.01
    forget_scans: int = 20
    least_seen: int = 3
    lines_max: int = 400


@dataclass(frozen=True, slots=True)
class MappedLines:
    """Lines of the filter in the map frame, K of them.

    angle_rad, distance_m: (K,) perpendicular.  covariance: (K, 2, 2).  start_m, end_m: (K, 2) as far as they were
    seen, free space to the right of the walk.  seen: (K,) scans.
    """

    angle_rad: F64
    distance_m: F64
    covariance: F64
    start_m: F64
    end_m: F64
    seen: I64

    def __len__(self) -> int:
        return len(self.angle_rad)


@dataclass(frozen=True, slots=True)
class Seen:
    """What came of one scan: observed lines matched with known ones, learned, and left out as ambiguous or small.

    nis: squared, normalised innovation of all matched lines together; degrees: its degrees of freedom.
    """

    matched: int
    learned: int
    left_out: int
    nis: float
    degrees: int


class LineEkf:
    """See the module's docstring. Same calls, same state, bit for bit."""

    def __init__(
        self,
        start: Pose2 = IDENTITY,
        covariance: ArrayLike | None = None,
        *,
        rules: EkfRules | None = None,
        known: MappedLines | None = None,
        learn: bool = True,
    ) -> None:
        """covariance: (3, 3) of the start, zero by default.  known: lines to begin with.  learn: whether lines are
        added and corrected; if not, only the pose is, and how unsure the known lines are counts.

        Raises ValueError for a covariance that is not (3, 3), finite and symmetric.
        """
        self.rules = rules or EkfRules()
        self._learn = learn
        count = 0 if known is None else len(known)
        self._x: F64 = np.zeros(_POSE + 2 * count)
        self._x[:_POSE] = start.x_m, start.y_m, wrap_angle(start.yaw_rad)
        self._p: F64 = np.zeros((_POSE + 2 * count, _POSE + 2 * count))
        self._p[:_POSE, :_POSE] = _checked_covariance(np.zeros((3, 3)) if covariance is None else covariance)
        self._first_pose = self.pose  # as predicted, before scans corrected it: where derivatives are taken
        self._first: F64 = np.zeros((count, 2))  # alpha, d when a line was first seen, likewise
        self._ends: F64 = np.zeros((count, 2))  # along the direction of each line, from its perpendicular's foot
        self._side: F64 = np.ones(count)  # +1: seen from where <n, p> < d
        self._count: I64 = np.zeros(count, dtype=np.int64)
        self._born: I64 = np.zeros(count, dtype=np.int64)
        self._scans = 0
        if known is not None:
            self._take_known(known)

    @property
    def pose(self) -> Pose2:
        """The base in the map."""
        return Pose2(float(self._x[0]), float(self._x[1]), float(self._x[2]))

    @property
    def pose_covariance(self) -> F64:
        """(3, 3) of x, y, yaw."""
        return self._p[:_POSE, :_POSE].copy()

    def __len__(self) -> int:
        return len(self._count)

    def nees(self, truth: Pose2) -> float:
        """Squared error of the pose, normalised by its covariance: 3 on average if the filter is consistent."""
        error = self._x[:_POSE] - np.array([truth.x_m, truth.y_m, truth.yaw_rad])
        error[2] = wrap_angle(float(error[2]))
        return float(error @ np.linalg.solve(self._p[:_POSE, :_POSE], error))

    def lines(self, *, least_seen: int = 1) -> MappedLines:
        """What is known, by order of appearance."""
        kept = np.flatnonzero(self._count >= least_seen)
        alpha, distance = self._x[_POSE::2][kept], self._x[_POSE + 1 :: 2][kept]
        at = _POSE + 2 * kept
        covariance = self._p[at[:, None, None] + np.array([[0], [1]]), at[:, None, None] + np.array([[0, 1]])]
        normal, along = _directions(alpha)
        foot = distance[:, None] * normal
        first, last = foot + self._ends[kept, :1] * along, foot + self._ends[kept, 1:] * along
        # Seen from where <n, p> < d, n points away from free space: walking along +u has it on the left.
        swap = (self._side[kept] > 0.0)[:, None]
        return MappedLines(
            alpha.copy(), distance.copy(), covariance, np.where(swap, last, first), np.where(swap, first, last),
            self._count[kept].copy(),
        )  # fmt: skip

    # --- motion

    def predict(self, step: Pose2, covariance: ArrayLike) -> None:
        """The base moved by `step`, given in its own frame before; covariance (3, 3) of that step there.

        Raises ValueError if anything is not finite.
        """
        noise = _checked_covariance(covariance)
        if not all(math.isfinite(v) for v in (step.x_m, step.y_m, step.yaw_rad)):
            raise ValueError("a step must be finite")
        yaw = float(self._x[2])
        c, s = math.cos(yaw), math.sin(yaw)
        moved = self.pose @ step
        # From prediction to prediction, so that the turn of everything together stays what nobody can observe.
        way_x, way_y = moved.x_m - self._first_pose.x_m, moved.y_m - self._first_pose.y_m
        by_pose = np.array([[1.0, 0.0, -way_y], [0.0, 1.0, way_x], [0.0, 0.0, 1.0]])
        self._first_pose = moved
        by_step = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._x[:_POSE] = moved.x_m, moved.y_m, moved.yaw_rad
        self._p[:_POSE, :] = by_pose @ self._p[:_POSE, :]
        self._p[:, :_POSE] = self._p[:, :_POSE] @ by_pose.T
        self._p[:_POSE, :_POSE] += by_step @ noise @ by_step.T

    # --- observation

    def update(self, lines: Lines, base_from_sensor: Pose2 = IDENTITY) -> Seen:
        """Take the lines of one scan, in the sensor's frame."""
        self._scans += 1
        angle, distance, covariance = lines.parameters()
        usable = np.isfinite(angle) & np.isfinite(distance) & (distance < _FARTHEST_M)
        noise = self._noise(lines, angle, covariance)
        pairs, free = self._associate(lines, angle, distance, noise, base_from_sensor, usable)
        nis = self._correct(pairs, angle, distance, noise, base_from_sensor)
        for observed, known in pairs:
            self._count[known] += 1
            self._stretch(known, lines, observed, base_from_sensor)
        learned = 0
        if self._learn:
            for observed in free:
                if self._is_worth_it(lines, observed) and len(self) < self.rules.lines_max:
                    self._add(lines, observed, angle, distance, noise, base_from_sensor)
                    learned += 1
            self._forget()
        return Seen(len(pairs), learned, len(lines) - len(pairs) - learned, nis, 2 * len(pairs))

    def _noise(self, lines: Lines, angle: F64, covariance: F64) -> F64:
        """(K, 2, 2) of the observations: what was measured, and that walls are neither flat nor straight."""
        centre = lines.rows[:, 5:7]
        lever = np.sin(angle) * centre[:, 0] - np.cos(angle) * centre[:, 1]
        bend, off = self.rules.straight_rad**2, self.rules.flat_m**2
        noise = covariance.copy()
        noise[:, 0, 0] += bend
        noise[:, 0, 1] -= lever * bend
        noise[:, 1, 0] -= lever * bend
        noise[:, 1, 1] += off + lever * lever * bend
        return noise

    def _expected(self, base_from_sensor: Pose2) -> tuple[F64, F64, F64, Pose2]:
        """Angles and distances (n,) of all known lines as seen now; H's columns (n, 2, 5): x, y, psi, alpha, d."""
        sensor = self.pose @ base_from_sensor
        alpha, d = self._x[_POSE::2], self._x[_POSE + 1 :: 2]
        c, s = np.cos(alpha), np.sin(alpha)
        reach = d - (c * sensor.x_m + s * sensor.y_m)
        sign = np.where(reach < 0.0, -1.0, 1.0)
        angle = wrap_angles(alpha - sensor.yaw_rad + np.where(sign < 0.0, math.pi, 0.0))
        first = self._first_pose @ base_from_sensor
        c, s = np.cos(self._first[:, 0]), np.sin(self._first[:, 0])
        h = np.zeros((len(alpha), 2, 5))
        h[:, 0, 2], h[:, 0, 3] = -1.0, 1.0
        arm_x, arm_y = first.x_m - self._first_pose.x_m, first.y_m - self._first_pose.y_m
        h[:, 1, 0], h[:, 1, 1] = -sign * c, -sign * s
        h[:, 1, 2] = -sign * (s * arm_x - c * arm_y)
        h[:, 1, 3] = sign * (s * first.x_m - c * first.y_m)
        h[:, 1, 4] = sign
        return angle, np.abs(reach), h, sensor

    def _associate(
        self, lines: Lines, angle: F64, distance: F64, noise: F64, base_from_sensor: Pose2, usable: NDArray[np.bool_]
    ) -> tuple[list[tuple[int, int]], list[int]]:
        """Pairs (observed, known), each at most once, nearest first; and the observed that are surely no known line."""
        if not len(self):
            return [], [int(k) for k in np.flatnonzero(usable)]
        expected, reach, h, sensor = self._expected(base_from_sensor)
        spread = self._spread(h)
        candidates: list[tuple[float, int, int]] = []
        free: list[int] = []
        side = np.where(self._x[_POSE + 1 :: 2] > self._at(sensor), 1.0, -1.0)
        doubtful_side = reach < 3.0 * np.sqrt(spread[:, 1, 1])
        same_side = (side == self._side) | doubtful_side
        start, end = (sensor.apply(each) for each in (lines.start_m, lines.end_m))
        for k in np.flatnonzero(usable):
            innovation = np.stack((wrap_angles(angle[k] - expected), distance[k] - reach), axis=-1)
            gap = self._gap_along(start[k], end[k])
            near = np.flatnonzero(same_side & (gap <= self.rules.gap_m) & (np.abs(innovation[:, 0]) < 0.5))
            if not len(near):
                free.append(int(k))
                continue
            total = spread[near] + noise[k]
            solved = np.linalg.solve(total, innovation[near][..., None])[..., 0]
            cost = np.sum(innovation[near] * solved, axis=1)
            if float(cost.min()) > self.rules.surely_other:
                free.append(int(k))
            candidates += [(float(m), int(k), int(i)) for m, i in zip(cost, near) if m < self.rules.gate]
        pairs: list[tuple[int, int]] = []
        taken: set[int] = set()
        used: set[int] = set()
        for _, observed, known in sorted(candidates):
            if observed not in used and known not in taken:
                pairs.append((observed, known))
                used.add(observed)
                taken.add(known)
        return sorted(pairs), free

    def _at(self, sensor: Pose2) -> F64:
        alpha = self._x[_POSE::2]
        return np.asarray(np.cos(alpha) * sensor.x_m + np.sin(alpha) * sensor.y_m)

    def _spread(self, h: F64) -> F64:
        """(n, 2, 2) covariance of what is expected of each known line."""
        count = len(h)
        at = np.empty((count, 5), dtype=np.int64)
        at[:, :_POSE] = np.arange(_POSE)
        at[:, 3] = _POSE + 2 * np.arange(count)
        at[:, 4] = at[:, 3] + 1
        block = self._p[at[:, :, None], at[:, None, :]]
        return np.asarray(h @ block @ np.swapaxes(h, 1, 2))

    def _gap_along(self, start: F64, end: F64) -> F64:
        """(n,) how far an observed piece lies beyond the known ends of each line, along it; at most 0 inside."""
        _, along = _directions(self._x[_POSE::2])
        a, b = along @ start, along @ end
        low, high = np.minimum(a, b), np.maximum(a, b)
        return np.maximum(low - self._ends[:, 1], self._ends[:, 0] - high)

    def _correct(
        self, pairs: list[tuple[int, int]], angle: F64, distance: F64, noise: F64, base_from_sensor: Pose2
    ) -> float:
        """The filter's correction with all pairs at once; returns the normalised innovation squared."""
        if not pairs:
            return 0.0
        expected, reach, blocks, _ = self._expected(base_from_sensor)
        size = len(self._x)
        h = np.zeros((2 * len(pairs), size))
        innovation = np.empty(2 * len(pairs))
        total = np.zeros((2 * len(pairs), 2 * len(pairs)))
        for row, (observed, known) in enumerate(pairs):
            rows = slice(2 * row, 2 * row + 2)
            h[rows, :_POSE] = blocks[known, :, :_POSE]
            h[rows, _POSE + 2 * known : _POSE + 2 * known + 2] = blocks[known, :, _POSE:]
            innovation[2 * row] = wrap_angle(float(angle[observed] - expected[known]))
            innovation[2 * row + 1] = distance[observed] - reach[known]
            total[rows, rows] = noise[observed]
        across = self._p @ h.T
        total += h @ across
        gain = np.linalg.solve(total, across.T).T
        if not self._learn:
            gain[_POSE:] = 0.0  # lines are considered, not corrected (Schmidt)
        self._x += gain @ innovation
        self._x[2] = wrap_angle(float(self._x[2]))
        self._x[_POSE::2] = wrap_angles(self._x[_POSE::2])
        if self._learn:
            self._p -= gain @ across.T
        else:
            lost = gain @ across.T
            self._p += gain @ total @ gain.T - lost - lost.T
        self._p = 0.5 * (self._p + self._p.T)
        return float(innovation @ np.linalg.solve(total, innovation))

    # --- the lines

    def _is_worth_it(self, lines: Lines, k: int) -> bool:
        return bool(lines.length_m[k] >= self.rules.new_length_m and lines.count[k] >= self.rules.new_points)

    def _add(self, lines: Lines, k: int, angle: F64, distance: F64, noise: F64, base_from_sensor: Pose2) -> None:
        sensor = self.pose @ base_from_sensor
        alpha = wrap_angle(float(angle[k]) + sensor.yaw_rad)
        c, s = math.cos(alpha), math.sin(alpha)
        d = float(distance[k]) + c * sensor.x_m + s * sensor.y_m
        first = self._first_pose @ base_from_sensor
        turn = c * first.y_m - s * first.x_m  # of d with alpha
        arm_x, arm_y = first.x_m - self._first_pose.x_m, first.y_m - self._first_pose.y_m
        by_pose = np.array([[0.0, 0.0, 1.0], [c, s, turn + s * arm_x - c * arm_y]])
        by_line = np.array([[1.0, 0.0], [turn, 1.0]])
        size = len(self._x)
        p = np.empty((size + 2, size + 2))
        p[:size, :size] = self._p
        p[size:, :size] = by_pose @ self._p[:_POSE, :]
        p[:size, size:] = p[size:, :size].T
        p[size:, size:] = by_pose @ self._p[:_POSE, :_POSE] @ by_pose.T + by_line @ noise[k] @ by_line.T
        self._p, self._x = p, np.append(self._x, (alpha, d))
        self._first = np.vstack((self._first, (alpha, d)))
        self._ends = np.vstack((self._ends, (math.inf, -math.inf)))
        self._side = np.append(self._side, 1.0)
        self._count, self._born = np.append(self._count, 1), np.append(self._born, self._scans)
        self._stretch(len(self) - 1, lines, k, base_from_sensor)

    def _stretch(self, known: int, lines: Lines, observed: int, base_from_sensor: Pose2) -> None:
        """A line reaches as far as it was seen."""
        sensor = self.pose @ base_from_sensor
        alpha = float(self._x[_POSE + 2 * known])
        along = np.array([-math.sin(alpha), math.cos(alpha)])
        ends = [float(along @ sensor.apply(each[observed])) for each in (lines.start_m, lines.end_m)]
        self._ends[known, 0] = min(self._ends[known, 0], *ends)
        self._ends[known, 1] = max(self._ends[known, 1], *ends)

    def _forget(self) -> None:
        old = self._scans - self._born >= self.rules.forget_scans
        kept = np.flatnonzero(~(old & (self._count < self.rules.least_seen)))
        if len(kept) == len(self):
            return
        at = np.concatenate((np.arange(_POSE), (_POSE + 2 * kept[:, None] + np.arange(2)).ravel()))
        self._x, self._p = self._x[at], self._p[np.ix_(at, at)]
        self._first, self._ends, self._side = self._first[kept], self._ends[kept], self._side[kept]
        self._count, self._born = self._count[kept], self._born[kept]

    def _take_known(self, known: MappedLines) -> None:
        self._x[_POSE::2], self._x[_POSE + 1 :: 2] = wrap_angles(known.angle_rad), known.distance_m
        self._first = self._x[_POSE:].reshape(-1, 2).copy()
        _, along = _directions(self._x[_POSE::2])
        for k in range(len(known)):
            at = _POSE + 2 * k
            self._p[at : at + 2, at : at + 2] = known.covariance[k]
            ends = (float(along[k] @ known.start_m[k]), float(along[k] @ known.end_m[k]))
            self._ends[k] = min(ends), max(ends)
            self._side[k] = 1.0 if ends[0] > ends[1] else -1.0
        self._count[:] = np.maximum(known.seen, self.rules.least_seen)


def step_covariance(step: Pose2, *, track_width_m: float, travel_noise_m_per_sqrt_m: float) -> F64:
    """Covariance (3, 3) of a differential drive's step in its own frame before it; noise as in DriveGeometry."""
    half = 0.5 * step.yaw_rad
    chord = math.copysign(math.hypot(step.x_m, step.y_m), step.x_m)
    way = chord * (half / math.sin(half) if abs(half) > 1e-6 else 1.0)
    left, right = way - track_width_m * half, way + track_width_m * half
    noise = travel_noise_m_per_sqrt_m**2
    covariance: F64 = rolled_covariance(
        np.zeros((3, 3)), 0.0, way, step.yaw_rad, track_width_m, noise * abs(left), noise * abs(right)
    )
    return covariance


def _directions(alpha: F64) -> tuple[F64, F64]:
    """(n, 2) normals and (n, 2) directions of lines."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.stack((c, s), axis=-1), np.stack((-s, c), axis=-1)


def _checked_covariance(value: ArrayLike) -> F64:
    covariance = np.array(value, dtype=np.float64)
    if covariance.shape != (3, 3) or not np.all(np.isfinite(covariance)):
        raise ValueError("a pose's covariance is (3, 3) and finite")
    if not np.allclose(covariance, covariance.T, atol=1e-12, rtol=1e-6):
        raise ValueError("a covariance is symmetric")
    return 0.5 * (covariance + covariance.T)
