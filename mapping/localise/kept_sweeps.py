"""Sweeps that are kept to draw the map again after a correction: few, small, and tied to key scans.

A sweep is kept with the key scan it was taken after and where it was seen from there, so that it moves with the map.
Ranges are rounded to a millimetre: 2 bytes a beam. Of a moving sensor the poses of the first and the last beam are
kept; the beams between lie on an arc (25 to 200 ms of constant twist).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.frames import wrap_angles
from mapping.kernels import motion
from mapping.localise.pose_graph import composed_poses
from mapping.scan import Scan

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U16 = NDArray[np.uint16]

UNIT_M = 1e-3
INVALID, TOO_CLOSE, NOTHING = 0, 65534, 65535
FARTHEST_M = 65.0  # what is farther is kept as this far and is no hit: it frees what lies before


@dataclass(frozen=True, slots=True)
class KeptSweep:
    """One sweep. in_key: (2, 3) the base at the first and the last beam, seen from the key scan's base.

    codes: (N,) millimetres, or INVALID, TOO_CLOSE, NOTHING.  bearing_rad: (N,), shared by sweeps with the same beams.
    reach_m: the farthest that it says anything about.
    """

    sensor: str
    stamp_ns: int
    key: int
    in_key: F64
    bearing_rad: F32
    codes: U16
    range_min_m: float
    range_max_m: float
    reach_m: float

    @property
    def memory_bytes(self) -> int:
        """What it takes beside its bearings."""
        return self.codes.nbytes + self.in_key.nbytes + 200

    def scan(self) -> Scan:
        """The sweep again, each beam at its own pose: see `poses`."""
        distance = self.codes.astype(np.float64) * UNIT_M
        distance[self.codes == INVALID] = math.nan
        distance[self.codes == TOO_CLOSE] = -math.inf
        distance[self.codes == NOTHING] = math.inf
        return Scan(
            self.stamp_ns, 0.0, self.bearing_rad.astype(np.float64), distance, self.range_min_m, self.range_max_m
        )

    def poses(self, ends: F64, base_from_sensor: F64) -> F64:
        """(N, 3) sensor poses of its beams, from base poses (2, 3) at both ends; (1, 3) if it stood."""
        if np.array_equal(ends[0], ends[1]):
            return composed_poses(ends[:1], base_from_sensor[None, :])
        share = np.linspace(0.0, 1.0, len(self.codes))
        between = motion.along_arc(ends[0], ends[1], share)
        return composed_poses(between, np.broadcast_to(base_from_sensor, (len(share), 3)))


def kept_sweep(sensor: str, scan: Scan, *, key: int, in_key: F64, known_bearing_rad: F32 | None = None) -> KeptSweep:
    """A sweep as it is kept. in_key: as in KeptSweep.  known_bearing_rad: of an earlier sweep, shared if it is equal.

    Ranges beyond FARTHEST_M are kept as nothing seen up to there.
    """
    distance = np.asarray(scan.range_m, dtype=np.float64)
    hit = np.isfinite(distance) & (distance > 0.0) & (distance < FARTHEST_M)
    codes = np.zeros(len(distance), dtype=np.uint16)
    codes[hit] = np.clip(np.rint(distance[hit] / UNIT_M), 1, TOO_CLOSE - 1).astype(np.uint16)
    codes[distance == -math.inf] = TOO_CLOSE
    codes[(distance == math.inf) | (np.isfinite(distance) & (distance >= FARTHEST_M))] = NOTHING
    range_max_m = min(scan.range_max_m, FARTHEST_M)
    sees_nothing = bool(np.any(codes == NOTHING))
    reach_m = range_max_m if sees_nothing else float(distance[hit].max(initial=scan.range_min_m))
    bearing = scan.bearing_rad.astype(np.float32)
    if known_bearing_rad is not None and np.array_equal(known_bearing_rad, bearing):
        bearing = known_bearing_rad
    return KeptSweep(
        sensor, scan.stamp_ns, key, np.array(in_key, dtype=np.float64), bearing, codes, scan.range_min_m, range_max_m,
        reach_m,
    )  # fmt: skip


def shifts_m(now: F64, drawn: F64, reach_m: F64) -> F64:
    """(N,) how far points of sweeps move if poses (N, 2, 3) they were drawn at become those of now: the place, and the
    turn over the reach (N,), of which more than 10 m seldom hold points."""
    off = now - drawn
    way = np.hypot(off[..., 0], off[..., 1]).max(axis=1)
    turn = np.abs(wrap_angles(off[..., 2])).max(axis=1)
    return np.asarray(way + turn * np.minimum(reach_m, 10.0))
