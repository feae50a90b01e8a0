"""What the wheels and the laser's mount really are, from driving about: seven numbers and how sure each is.

Wheel travels say how the base moved, sweeps how the laser did; both are one rigid body. The gains of the wheels, the
track width, the laser's place on the base and the time between both clocks are those under which the two agree best.

Source: Censi, Franchi, Marchionni, Oriolo, "Simultaneous calibration of odometry and sensor parameters for mobile
robots", IEEE T-RO 29(2), 2013: turning is linear in gain / track; given those, ways, track and mount are a quadratic
form under one constraint. That closed form starts a Gauss-Newton over all seven (there is no time offset in the
paper). Each motion is weighed by its own covariance; those far off what the others say (people, slip) are left out.
How sure: the larger of what the fit says and of what blocks of motions say that are independent but not alike within
(Liang and Zeger 1986). A number that the drive does not determine is None, never a number with a footnote.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import wrap_angles
from mapping.kernels import calibrate as kernels
from mapping.localise.pose_graph import relative_poses
from mapping.localise.relative_motions import RelativeMotions

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

NAMES = (
    "left_m_per_tick", "right_m_per_tick", "track_width_m",
    "laser_x_m", "laser_y_m", "laser_yaw_rad", "time_offset_s",
)  # fmt: skip
LEFT, RIGHT, TRACK, X, Y, YAW, OFFSET = range(7)
RELATIVE = slice(LEFT, X)  # whose deviations are shares of the value

# Standard deviations of what is known beforehand, which is next to nothing; it holds what the drive does not.
PRIOR = np.array([0.5, 0.5, 0.7, 2.0, 2.0, 2.0, 0.3])
# A number is told if it is surer than this: shares, metres, radians, seconds.
TOLD_BELOW = np.array([0.01, 0.01, 0.02, 0.02, 0.02, math.radians(1.0), 0.02])
NUDGE = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-5, 0.1])  # to differentiate by; the time by more than ticks jitter
# What matches get wrong alike (drawn towards no motion by a fraction of a millimetre), which no drive averages out.
ALIKE = np.array([3e-4, 3e-4, 3e-4, 3e-4, 3e-4, 3e-4, 1e-4])
LEAST_MOTIONS = 20
GATE = 16.3  # squared Mahalanobis distance that 1 in 1000 exceeds, 3 degrees of freedom
# Motions that tell the time offset, at starts and stops, look like outliers until it is right: the gate closes slowly.
WIDEST_GATE, NARROWING = 3e4, 0.5
MEDIAN_SQUARE = 2.366  # of the same
MOST_STEPS = 30
BLOCKS = 25
MOST_ALIKE = 1e10  # condition of the normal matrix of both wheels' ticks: beyond, they only roll in one proportion
LEAST_TURN_SIGNIFICANCE = 10.0  # how many deviations both turn gains are from nought, for the closed form


@dataclass(frozen=True, slots=True)
class WheelTicks:
    """Running totals of both wheels: stamp_s (M,) rising, left, right (M,) ticks, each in its own direction."""

    stamp_s: F64
    left: F64
    right: F64

    def __post_init__(self) -> None:
        if not self.stamp_s.shape == self.left.shape == self.right.shape or self.stamp_s.ndim != 1:
            raise ValueError("stamps and ticks are rows of one length")
        if np.any(np.diff(self.stamp_s) <= 0.0):
            raise ValueError("stamps of wheel ticks must rise")


@dataclass(frozen=True, slots=True)
class RobotModel:
    """What is calibrated.

    A gain is negative where ticks fall when rolling forward. laser_*: base_from_laser.  time_offset_s: a sweep stamped
    t was taken when the wheels' clock said t + time_offset_s.
    """

    left_m_per_tick: float
    right_m_per_tick: float
    track_width_m: float
    laser_x_m: float = 0.0
    laser_y_m: float = 0.0
    laser_yaw_rad: float = 0.0
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not (self.left_m_per_tick and self.right_m_per_tick and self.track_width_m > 0.0):
            raise ValueError("gains are not 0 and the track width is positive")

    def row(self) -> F64:
        """(7,) in the order of NAMES."""
        return np.array([getattr(self, name) for name in NAMES])


@dataclass(frozen=True, slots=True)
class Calibration:
    """What the drive says.

    best: (7,) the fit, order of NAMES; where not observable, hardly more than the start value: use `value`.
    deviation: (7,) standard deviations in the units of the values.  correlation: (7, 7).  observable: (7,).
    motions: how many were used; trimmed: left out as outliers.  scale: how much wider than their covariances the
    motions scatter.  residual_m, residual_rad: (median) what motions are off.  way_m, turn_rad: driven, absolute.
    """

    best: F64
    deviation: F64
    correlation: F64
    observable: Bools
    motions: int
    trimmed: int
    scale: float
    residual_m: float
    residual_rad: float
    way_m: float
    turn_rad: float

    def value(self, name: str) -> float | None:
        """One of NAMES; None: not observable yet."""
        k = NAMES.index(name)
        return float(self.best[k]) if self.observable[k] else None


def calibrate(ticks: WheelTicks, motions: RelativeMotions, start: RobotModel) -> Calibration:
    """Fit all seven numbers; start: what was taken for granted so far, signs of the gains included.

    Motions outside the time of the ticks are not used. With fewer than 20 motions nothing is observable.
    """
    motions = _within(ticks, motions, start.time_offset_s)
    if len(motions) < LEAST_MOTIONS or len(ticks.stamp_s) < 2:
        return _nothing(start, len(motions))
    problem = _Problem(ticks, motions, start)
    starts = [np.zeros(7)]
    closed = _closed_form(ticks, motions, start)
    if closed is not None:
        starts.append(problem.offsets_of(closed))
    return problem.solved(min(starts, key=problem.spread))


def rolled_back(stamp_s: F64, pose: F64, model: RobotModel) -> WheelTicks:
    """Wheels that would have made these poses of the base (M, 3): each step's arc and turn, forwards where it points
    forwards.

    Exact for poses that such wheels made. Rows whose stamp does not rise are left out.
    """
    if not len(stamp_s):
        return WheelTicks(stamp_s, stamp_s, stamp_s)
    turn = wrap_angles(np.diff(pose[:, 2]))
    dx, dy = np.diff(pose[:, 0]), np.diff(pose[:, 1])
    heading = pose[:-1, 2] + 0.5 * turn
    arc = (dx * np.cos(heading) + dy * np.sin(heading)) / np.sinc(turn / (2.0 * np.pi))
    half = 0.5 * turn * model.track_width_m
    left = np.concatenate(([0.0], np.cumsum(arc - half))) / model.left_m_per_tick
    right = np.concatenate(([0.0], np.cumsum(arc + half))) / model.right_m_per_tick
    return rising(stamp_s, left, right)


def rising(stamp_s: F64, left: F64, right: F64) -> WheelTicks:
    """Without the rows whose stamp does not rise."""
    first = np.diff(np.maximum.accumulate(stamp_s), prepend=-np.inf) > 0.0
    return WheelTicks(stamp_s[first], left[first], right[first])


def dead_reckoned(ticks: WheelTicks, model: F64, at_s: F64) -> F64:
    """Poses (N, 3) of the base at times (N,) of the wheels' clock, from (0, 0, 0) at the first ticks; model: (7,).

    Between two samples both wheels turn evenly: arcs, exact. Beyond the ends the robot stands.
    """
    poses = np.empty((len(at_s), 3))
    stamp_s, left, right, model, at_s = _contiguous(ticks.stamp_s, ticks.left, ticks.right, model, at_s)
    kernels.poses_at(stamp_s, left, right, model, at_s, poses)
    return poses


def base_motions(ticks: WheelTicks, motions: RelativeMotions, model: F64) -> F64:
    """(K, 3) how the base moved during each motion, by a model (7,); yaw not wrapped."""
    before = dead_reckoned(ticks, model, motions.start_s + model[OFFSET])
    after = dead_reckoned(ticks, model, motions.end_s + model[OFFSET])
    return relative_poses(before, after)


class _Problem:
    """Residuals as a function of offsets (7,) from the start: logarithms of ratios, then plain differences."""

    def __init__(self, ticks: WheelTicks, motions: RelativeMotions, start: RobotModel) -> None:
        self._ticks, self._motions, self._start = ticks, motions, start.row()
        self._rows = _contiguous(ticks.stamp_s, ticks.left, ticks.right)
        self._measured = _contiguous(motions.start_s, motions.end_s, motions.motion)
        self._whiten = np.linalg.inv(np.linalg.cholesky(motions.covariance))

    def model(self, offsets: F64) -> F64:
        model = self._start + offsets
        model[RELATIVE] = self._start[RELATIVE] * np.exp(offsets[RELATIVE])
        return model

    def offsets_of(self, model: RobotModel) -> F64:
        offsets = model.row() - self._start
        offsets[RELATIVE] = np.log(np.abs(model.row()[RELATIVE] / self._start[RELATIVE]))
        return offsets

    def whitened(self, *offsets: F64) -> F64:
        """(P, K, 3) measured minus expected motions of the laser for each of P offsets, in their own deviations."""
        return self._off(np.array([self.model(each) for each in offsets]), self._whiten)

    def plain(self, offsets: F64) -> F64:
        """(K, 3) the same in metres and radians."""
        as_measured = np.broadcast_to(np.eye(3), self._whiten.shape).copy()
        off: F64 = self._off(self.model(offsets)[None, :], as_measured)[0]
        return off

    def _off(self, models: F64, whiten: F64) -> F64:
        off = np.empty((len(models), len(self._motions), 3))
        (stamp_s, left, right), (start_s, end_s, motion) = self._rows, self._measured
        kernels.misfits(stamp_s, left, right, models, start_s, end_s, motion, whiten, off)
        return off

    def jacobian(self, offsets: F64) -> tuple[F64, F64]:
        """The whitened residuals (K, 3), and (K, 3, 7) how they change with each offset."""
        nudged = [offsets + sign * nudge * unit for nudge, unit in zip(NUDGE, np.eye(7)) for sign in (1.0, -1.0)]
        residual, *ahead_and_behind = self.whitened(offsets, *nudged)
        columns = [
            (ahead - behind) / (2.0 * nudge)
            for nudge, ahead, behind in zip(NUDGE, ahead_and_behind[::2], ahead_and_behind[1::2])
        ]
        return residual, np.stack(columns, axis=-1)

    def spread(self, offsets: F64) -> float:
        """Median squared distance, which outliers do not move."""
        return float(np.median(np.sum(self.whitened(offsets)[0] ** 2, axis=1)))

    def solved(self, offsets: F64) -> Calibration:
        information = np.diag(PRIOR**-2.0)
        for number in range(MOST_STEPS):
            gate = max(GATE, WIDEST_GATE * NARROWING**number)
            residual, J = self.jacobian(offsets)
            kept, scale2 = _kept(residual, gate)
            rows = J[kept].reshape(-1, 7) / math.sqrt(scale2)
            normal = rows.T @ rows + information
            pull = rows.T @ residual[kept].ravel() / math.sqrt(scale2) + information @ offsets
            step = -np.linalg.solve(normal, pull)
            offsets = offsets + np.clip(step, -PRIOR, PRIOR)
            if gate == GATE and np.max(np.abs(step) / TOLD_BELOW) < 1e-4:
                break
        return self._told(offsets)

    def _told(self, offsets: F64) -> Calibration:
        residual, J = self.jacobian(offsets)
        kept, scale2 = _kept(residual)
        covariance = _covariance(J[kept], residual[kept], scale2)
        deviation = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(deviation, deviation)
        model = self.model(offsets)
        unit = np.ones(7)
        unit[RELATIVE] = np.abs(model[RELATIVE])
        base = base_motions(self._ticks, self._motions, model)
        off = self.plain(offsets)[kept]
        return Calibration(
            model, deviation * unit, correlation, deviation < TOLD_BELOW,
            int(kept.sum()), int((~kept).sum()), math.sqrt(scale2),
            float(np.median(np.hypot(off[:, 0], off[:, 1]))), float(np.median(np.abs(off[:, 2]))),
            float(np.sum(np.hypot(base[:, 0], base[:, 1]))), float(np.sum(np.abs(base[:, 2]))),
        )  # fmt: skip


def _kept(residual: F64, gate: float = GATE) -> tuple[Bools, float]:
    """(K,) which motions agree with most others, and the variance factor that their scatter shows."""
    square = np.sum(residual**2, axis=1)
    scale2 = max(float(np.median(square)) / MEDIAN_SQUARE, 1e-12)
    kept = square < gate * scale2
    return kept, max(float(np.mean(square[kept])) / 3.0, scale2)


def _covariance(J: F64, residual: F64, scale2: float) -> F64:
    """(7, 7): the fit's, each deviation widened to what whole blocks of motions say where that is more."""
    rows = J.reshape(-1, 7)
    covariance = np.linalg.inv(rows.T @ rows / scale2 + np.diag(PRIOR**-2.0))
    blocks = min(BLOCKS, len(J) // 3)
    pulls = np.array([
        np.einsum("kij,ki->j", a, b) / scale2
        for a, b in zip(np.array_split(J, blocks), np.array_split(residual, blocks))
    ])  # fmt: skip
    spread = covariance @ (pulls.T @ pulls) @ covariance * (blocks / max(1, blocks - 7))
    own = np.diag(covariance)
    wider = np.sqrt((np.maximum(own, np.diag(spread)) + ALIKE**2) / own)
    return np.asarray(covariance * np.outer(wider, wider))


def _closed_form(ticks: WheelTicks, motions: RelativeMotions, start: RobotModel) -> RobotModel | None:
    """Gains, track and mount without a guess (Censi et al. 2013, section V), the time offset as at the start.

    None if the drive does not tell both wheels' share of the turns, or signs differ from those of the start.
    """
    shift = start.time_offset_s
    turns = _fitted(_rolled(ticks, motions, shift), motions.motion[:, 2])
    if turns is None or turns[0] * start.left_m_per_tick >= 0.0 or turns[1] * start.right_m_per_tick <= 0.0:
        return None
    per_track = np.array([-turns[0], turns[1], 1.0, 0.0, 0.0, 0.0, shift])  # the base's way in units of the track
    base = base_motions(ticks, motions, per_track)
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    tx, ty = motions.motion[:, 0], motions.motion[:, 1]
    one = np.ones(len(c))
    # R(yaw) t - (R(turn) - 1) l - track * way = 0, linear in track, l and the cosine and sine of yaw.
    equations = np.concatenate((
        np.stack((-base[:, 0], one - c, s, tx, -ty), axis=-1),
        np.stack((-base[:, 1], -s, one - c, ty, tx), axis=-1),
    ))  # fmt: skip
    free, bound = equations[:, :3], equations[:, 3:]
    if np.linalg.matrix_rank(free) < 3:
        return None
    eliminated, *_ = np.linalg.lstsq(free, bound, rcond=None)
    rest = bound - free @ eliminated
    _, vectors = np.linalg.eigh(rest.T @ rest)
    cosine, sine = vectors[:, 0]
    track, x, y = -eliminated @ np.array([cosine, sine])
    if track < 0.0:  # the constraint leaves the sign open
        track, x, y, cosine, sine = -track, -x, -y, -cosine, -sine
    if not track > 1e-6:
        return None
    yaw = math.atan2(sine, cosine)
    return RobotModel(-turns[0] * track, turns[1] * track, float(track), float(x), float(y), yaw, shift)


def turns_as_believed(ticks: WheelTicks, motions: RelativeMotions, start: RobotModel) -> tuple[bool, bool] | None:
    """Whether the laser turns as the counts of the left and of the right wheel let expect; None if that is not clear.

    Both wrong: the laser hangs head down (or does not), the wheels are exchanged, or both count backwards. One wrong:
    that wheel counts backwards. Such signs are settings that no fit can put right.
    """
    motions = _within(ticks, motions, start.time_offset_s)
    if len(motions) < LEAST_MOTIONS or len(ticks.stamp_s) < 2:
        return None
    turns = _fitted(_rolled(ticks, motions, start.time_offset_s), motions.motion[:, 2])
    if turns is None:
        return None
    return turns[0] * start.left_m_per_tick < 0.0, turns[1] * start.right_m_per_tick > 0.0


def _rolled(ticks: WheelTicks, motions: RelativeMotions, shift_s: float) -> F64:
    """(K, 2) counts of both wheels during each motion."""
    counted = np.stack((ticks.left, ticks.right), axis=-1)
    ends, starts = motions.end_s + shift_s, motions.start_s + shift_s
    return _at(ticks.stamp_s, counted, ends) - _at(ticks.stamp_s, counted, starts)


def _at(stamp_s: F64, values: F64, at_s: F64) -> F64:
    return np.stack([np.interp(at_s, stamp_s, column) for column in values.T], axis=-1)


def _fitted(rolled: F64, turn: F64) -> tuple[float, float] | None:
    """Both coefficients of turn (K,) over ticks (K, 2), outliers left out; None if one is not clear of nought."""
    kept = np.ones(len(turn), dtype=np.bool_)
    for _ in range(4):
        normal = rolled[kept].T @ rolled[kept]
        if not np.linalg.cond(normal) < MOST_ALIKE:
            return None
        gains = np.linalg.solve(normal, rolled[kept].T @ turn[kept])
        off = np.abs(turn - rolled @ gains)
        typical = 1.4826 * float(np.median(off)) + 1e-9
        kept = off < 4.0 * typical
    deviation = typical * np.sqrt(np.diag(np.linalg.inv(normal)))
    if np.any(np.abs(gains) < LEAST_TURN_SIGNIFICANCE * deviation):
        return None
    return float(gains[0]), float(gains[1])


def _within(ticks: WheelTicks, motions: RelativeMotions, offset_s: float) -> RelativeMotions:
    """Motions during the time of the ticks."""
    if not len(ticks.stamp_s):
        return motions
    begin, end = ticks.stamp_s[0], ticks.stamp_s[-1]
    return _only(motions, (motions.start_s + offset_s >= begin - 0.01) & (motions.end_s + offset_s <= end + 0.01))


def _only(motions: RelativeMotions, chosen: Bools) -> RelativeMotions:
    m = motions
    return RelativeMotions(m.start_s[chosen], m.end_s[chosen], m.motion[chosen], m.covariance[chosen], m.rejected)


def _contiguous(*arrays: F64) -> tuple[F64, ...]:
    """As compiled loops take them."""
    return tuple(np.array(array, dtype=np.float64, order="C") for array in arrays)


def _nothing(start: RobotModel, motions: int) -> Calibration:
    """What too short a drive says."""
    unit = np.ones(7)
    unit[RELATIVE] = np.abs(start.row()[RELATIVE])
    nothing = np.zeros(7, dtype=np.bool_)
    return Calibration(start.row(), PRIOR * unit, np.eye(7), nothing, motions, 0, 1.0, 0.0, 0.0, 0.0, 0.0)
