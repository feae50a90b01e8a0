"""What the emulated lasers have in common: how a true distance becomes a measured one, and where they stand on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from sim_devices.device import F64, Mount, Scene

MOST_FORESEEN = 4096  # beams


@runtime_checkable
class ManyAtOnce(Protocol):
    """A scene that may be asked for many beams in one go."""

    def is_beam_by_beam(self, first_ns: int, last_ns: int) -> bool:
        """Whether between these times each beam's range depends on nothing but itself."""


@dataclass(slots=True)
class Ranger:
    """The optics of one laser: asks the scene, adds noise, loses beams.

    range_max_m: the farthest surface that gives an echo.  noise_floor_m, noise_per_range: standard deviation of a range
    r is noise_floor_m + noise_per_range * r, times noise_scale (0: exact).  dropout: share of beams without an echo.
    """

    scene: Scene
    mount: Mount
    random: np.random.Generator
    range_max_m: float
    noise_floor_m: float
    noise_per_range: float = 0.0
    noise_scale: float = 1.0
    dropout: float = 0.0
    _foreseen: tuple[F64, F64, F64] | None = field(default=None, init=False)  # stamps, bearings, true ranges

    def foresee(self, bearing_rad: F64, stamp_ns: F64) -> None:
        """Ask the scene at once for beams (N,) that will be measured in several parts from now on.

        Asking has a price of its own, whatever the number of beams: a device that is served late, and asked for each
        part by itself, would fall behind for ever on a machine with too much work. What is measured stays the same.
        """
        if self.may_foresee(stamp_ns):
            true_m = self.scene.beam_ranges(self.mount, bearing_rad, stamp_ns, self.range_max_m)
            self._foreseen = stamp_ns, bearing_rad, true_m

    def may_foresee(self, stamp_ns: F64) -> bool:
        """Whether beams at these times (N,) have the same ranges asked together or in parts."""
        scene, self._foreseen = self.scene, None
        return isinstance(scene, ManyAtOnce) and scene.is_beam_by_beam(int(stamp_ns[0]), int(stamp_ns[-1]))

    def _true_m(self, bearing_rad: F64, stamp_ns: F64) -> F64:
        if self._foreseen is not None:
            stamps, bearings, ranges = self._foreseen
            first = int(np.searchsorted(stamps, stamp_ns[0]))
            part = slice(first, first + len(stamp_ns))
            if np.array_equal(stamps[part], stamp_ns) and np.array_equal(bearings[part], bearing_rad):
                return ranges[part]
        return self.scene.beam_ranges(self.mount, bearing_rad, stamp_ns, self.range_max_m)

    def measure(self, bearing_rad: F64, stamp_ns: F64) -> F64:
        """Ranges (N,) of beams fired at their stamps; +inf no echo, NaN blinded, -inf and below 0 too close.

        bearing_rad: (N,) in the sensor frame, counter-clockwise.
        """
        true_m = self._true_m(bearing_rad, stamp_ns)
        seen_m = true_m
        if self.noise_scale:
            sigma_m = self.noise_floor_m + self.noise_per_range * np.where(np.isfinite(true_m), true_m, 0.0)
            seen_m = true_m + self.noise_scale * sigma_m * self.random.standard_normal(len(true_m))
        if self.dropout:
            seen_m = np.where(self.random.random(len(seen_m)) < self.dropout, np.inf, seen_m)
        return seen_m


def garbled(sent: bytes, random: np.random.Generator) -> bytes:
    """What a host at another line rate makes of these bytes."""
    return random.integers(0, 256, len(sent), dtype=np.uint8).tobytes()
