"""The relation error of the SLAM benchmark: how well a trajectory keeps what people measured between two moments.

A relation is a pose d of the robot at stamp2 seen from its pose at stamp1, checked by hand. With the trajectory's poses
a and b at the two stamps, e = inverse(a) * b is what the trajectory says, and E = inverse(d) * e what it is off. The
error of translation is the length of E's x, y, that of rotation its absolute angle. Only differences between poses
count, so a trajectory may lie anywhere. Source: Kümmerle et al., On measuring the accuracy of SLAM algorithms,
Autonomous Robots 27 (2009), as the benchmark's own evaluator computes it (Cartographer's tool takes e * inverse(d):
translations differ a little).

Stamps name poses: they are looked up as text, else the nearest within 0.1 ms. Nothing is interpolated. Relations whose
stamps the trajectory does not hold are counted, never dropped in silence.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.errors import Trouble

F64 = NDArray[np.float64]

STAMP_TOLERANCE_S = 1e-4
DEFINITION = "inverse(d) * (inverse(a) * b), poses not interpolated (Kümmerle et al. 2009)"


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses by stamp. text: the stamps as written; stamp_s (M,), pose (M, 3): x_m, y_m, yaw_rad."""

    text: tuple[str, ...]
    stamp_s: F64
    pose: F64


@dataclass(frozen=True, slots=True)
class Relations:
    """Poses at second seen from first, both stamps as written; pose (R, 3): x_m, y_m, yaw_rad."""

    first: tuple[str, ...]
    second: tuple[str, ...]
    pose: F64


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation (population) of errors and of their squares; NaN if there are none."""

    mean: float
    std: float
    mean_of_squares: float
    std_of_squares: float
    largest: float

    @staticmethod
    def of(errors: F64) -> Spread:
        """The figures of errors (N,)."""
        if not len(errors):
            return Spread(math.nan, math.nan, math.nan, math.nan, math.nan)
        squares = errors**2
        return Spread(
            float(errors.mean()), float(errors.std()), float(squares.mean()), float(squares.std()), float(errors.max())
        )


@dataclass(frozen=True, slots=True)
class RelationError:
    """What `relation_error` found. relations: all; not_evaluated: those whose stamps the trajectory lacks.

    translation in metres, rotation in degrees.  missing: some stamps that were looked for in vain.
    """

    relations: int
    not_evaluated: int
    translation_m: Spread
    rotation_deg: Spread
    missing: tuple[str, ...] = ()


def relation_error(trajectory: Trajectory, relations: Relations) -> RelationError:
    """Errors of a trajectory against relations; see the module's text."""
    find = _Finder(trajectory)
    first = np.array([find(stamp) for stamp in relations.first], dtype=np.int64)
    second = np.array([find(stamp) for stamp in relations.second], dtype=np.int64)
    known = (first >= 0) & (second >= 0)
    said = _relative(trajectory.pose[first[known]], trajectory.pose[second[known]])
    off = _relative(relations.pose[known], said)
    return RelationError(
        relations=len(known),
        not_evaluated=int((~known).sum()),
        translation_m=Spread.of(np.hypot(off[:, 0], off[:, 1])),
        rotation_deg=Spread.of(np.degrees(np.abs(off[:, 2]))),
        missing=tuple(sorted(find.missing)[:5]),
    )


class _Finder:
    """Looks up stamps in a trajectory: as text, else the nearest within the tolerance; -1 if there is none."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._by_text = {text: k for k, text in reversed(list(enumerate(trajectory.text)))}
        self._order = np.argsort(trajectory.stamp_s, kind="stable")
        self._sorted_s = trajectory.stamp_s[self._order]
        self.missing: set[str] = set()

    def __call__(self, text: str) -> int:
        exact = self._by_text.get(text)
        if exact is not None:
            return exact
        stamp = float(text)
        at = int(np.searchsorted(self._sorted_s, stamp))
        near = [k for k in (at - 1, at) if 0 <= k < len(self._sorted_s)]
        best = min(near, key=lambda k: abs(self._sorted_s[k] - stamp), default=None)
        if best is None or abs(self._sorted_s[best] - stamp) > STAMP_TOLERANCE_S:
            self.missing.add(text)
            return -1
        return int(self._order[best])


def _relative(a: F64, b: F64) -> F64:
    """inverse(a) * b, row by row: (N, 3), yaw in [-pi, pi)."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    yaw = (b[:, 2] - a[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack((c * dx + s * dy, -s * dx + c * dy, yaw), axis=-1)


# --- files -----------------------------------------------------------------------------------------------------------


def read_trajectory(path: Path) -> Trajectory:
    """A trajectory file, plain or gzip: rows `stamp x y z qx qy qz qw` (TUM) or `stamp x y theta`; # begins a comment.

    Raises Trouble naming the file and the line.
    """
    rows = list(_rows(path, (4, 8), "stamp x y z qx qy qz qw, or stamp x y theta"))
    poses = [(v[1], v[2], _yaw(v[4:8]) if len(v) == 8 else v[3]) for _, v in rows]
    return Trajectory(
        tuple(words[0] for words, _ in rows),
        np.array([v[0] for _, v in rows], dtype=np.float64),
        np.array(poses, dtype=np.float64).reshape(-1, 3),
    )


def read_relations(path: Path) -> Relations:
    """A file of relations, plain or gzip: rows `stamp1 stamp2 x y z roll pitch yaw`. Raises Trouble."""
    rows = list(_rows(path, (8,), "stamp1 stamp2 x y z roll pitch yaw"))
    return Relations(
        tuple(words[0] for words, _ in rows),
        tuple(words[1] for words, _ in rows),
        np.array([(v[2], v[3], v[7]) for _, v in rows], dtype=np.float64).reshape(-1, 3),
    )


def _yaw(quaternion: Sequence[float]) -> float:
    """Heading of a rotation (qx, qy, qz, qw), which need not be of length 1."""
    x, y, z, w = quaternion
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rows(path: Path, widths: Sequence[int], form: str) -> Iterator[tuple[list[str], list[float]]]:
    """Words and numbers of each line that is not empty."""
    found = False
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise Trouble(f"{path}: line {number} is not all numbers; expected {form}") from None
        if len(values) not in widths:
            raise Trouble(f"{path}: line {number} has {len(values)} numbers; expected {form}")
        if not all(map(math.isfinite, values)):
            raise Trouble(f"{path}: line {number} has a number that is not finite")
        found = True
        yield words, values
    if not found:
        raise Trouble(f"{path}: no row in it; expected {form}")


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
        unpacked = gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw
    except OSError as error:
        raise Trouble(f"{path}: cannot be read: {error.strerror or error}") from error
    except EOFError as error:
        raise Trouble(f"{path}: damaged gzip file; fetch it again") from error
    return unpacked.decode("utf-8", errors="replace")
