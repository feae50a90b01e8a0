"""What the emulated lasers have in common: how a true distance becomes a measured one, and where they stand on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_devices.device import F64, Mount, Scene


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

    def measure(self, bearing_rad: F64, stamp_ns: F64) -> F64:
        """Ranges (N,) of beams fired at their stamps; +inf no echo, NaN blinded, -inf and below 0 too close.

        bearing_rad: (N,) in the sensor frame, counter-clockwise.
        """
        true_m = self.scene.beam_ranges(self.mount, bearing_rad, stamp_ns, self.range_max_m)
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
