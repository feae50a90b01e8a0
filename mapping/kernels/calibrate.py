"""Compiled loops of the calibration: where wheels have the base at given times, and what measured motions are off.

They give up the interpreter's lock: a fit asks them some hundred times, while sweeps want it. In numpy, a fit held a
sweep up by tens of milliseconds.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.motion import wrapped

LEFT, RIGHT, TRACK, X, Y, YAW, OFFSET = range(7)


@njit(cache=True, nogil=True)
def chord_share(turn: float) -> float:
    """Length of an arc's chord over that of the arc."""
    half = 0.5 * turn
    return 1.0 if half == 0.0 else math.sin(half) / half


@njit(cache=True, nogil=True)
def roll(left: Any, right: Any, model: Any, corners: Any) -> None:
    """Poses (M, 3) of the base at each sample of the ticks (M,), from (0, 0, 0) at the first, into corners."""
    x = y = yaw = 0.0
    corners[0, :] = 0.0
    for k in range(1, len(left)):
        left_m, right_m = (left[k] - left[k - 1]) * model[LEFT], (right[k] - right[k - 1]) * model[RIGHT]
        turn = (right_m - left_m) / model[TRACK]
        chord = 0.5 * (left_m + right_m) * chord_share(turn)
        x += chord * math.cos(yaw + 0.5 * turn)
        y += chord * math.sin(yaw + 0.5 * turn)
        yaw += turn
        corners[k, 0], corners[k, 1], corners[k, 2] = x, y, yaw


@njit(cache=True, nogil=True)
def on_the_way(stamp_s: Any, left: Any, right: Any, model: Any, corners: Any, at_s: float) -> Any:
    """x, y, yaw of the base at a time: between two samples both wheels turn evenly, beyond the ends it stands."""
    k = int(np.searchsorted(stamp_s, at_s, side="right")) - 1
    if k < 0 or k > len(stamp_s) - 2:
        k = 0 if k < 0 else len(stamp_s) - 2
    share = min(max((at_s - stamp_s[k]) / (stamp_s[k + 1] - stamp_s[k]), 0.0), 1.0)
    left_m, right_m = (left[k + 1] - left[k]) * model[LEFT], (right[k + 1] - right[k]) * model[RIGHT]
    turn = share * ((right_m - left_m) / model[TRACK])
    chord = share * (0.5 * (left_m + right_m)) * chord_share(turn)
    yaw = corners[k, 2]
    x = corners[k, 0] + chord * math.cos(yaw + 0.5 * turn)
    y = corners[k, 1] + chord * math.sin(yaw + 0.5 * turn)
    return x, y, yaw + turn


@njit(cache=True, nogil=True)
def poses_at(stamp_s: Any, left: Any, right: Any, model: Any, at_s: Any, poses: Any) -> None:
    """The same for times (N,), into poses (N, 3)."""
    corners = np.empty((len(stamp_s), 3))
    roll(left, right, model, corners)
    for k in range(len(at_s)):
        x, y, yaw = on_the_way(stamp_s, left, right, model, corners, at_s[k])
        poses[k, 0], poses[k, 1], poses[k, 2] = x, y, yaw


@njit(cache=True, nogil=True)
def misfits(
    stamp_s: Any, left: Any, right: Any, models: Any, start_s: Any, end_s: Any, motion: Any, whiten: Any, off: Any
) -> None:
    """Measured motions of the laser (K, 3) minus those that models (P, 7) let expect, each times its (3, 3) of whiten
    (K, 3, 3), into off (P, K, 3). Models that follow each other with the same wheels share what their wheels roll."""
    corners = np.empty((len(stamp_s), 3))
    for p in range(len(models)):
        model = models[p]
        before = models[p - 1]
        if p == 0 or model[LEFT] != before[LEFT] or model[RIGHT] != before[RIGHT] or model[TRACK] != before[TRACK]:
            roll(left, right, model, corners)
        c, s = math.cos(model[YAW]), math.sin(model[YAW])
        for k in range(len(start_s)):
            x0, y0, yaw0 = on_the_way(stamp_s, left, right, model, corners, start_s[k] + model[OFFSET])
            x1, y1, yaw1 = on_the_way(stamp_s, left, right, model, corners, end_s[k] + model[OFFSET])
            turn = yaw1 - yaw0
            c0, s0 = math.cos(yaw0), math.sin(yaw0)
            ct, st = math.cos(turn), math.sin(turn)
            dx = c0 * (x1 - x0) + s0 * (y1 - y0) + ct * model[X] - st * model[Y] - model[X]
            dy = c0 * (y1 - y0) - s0 * (x1 - x0) + st * model[X] + ct * model[Y] - model[Y]
            u = motion[k, 0] - (c * dx + s * dy)
            v = motion[k, 1] - (c * dy - s * dx)
            w = wrapped(motion[k, 2] - turn)
            for i in range(3):
                off[p, k, i] = whiten[k, i, 0] * u + whiten[k, i, 1] * v + whiten[k, i, 2] * w
