"""A nodding or rotating mount: it tilts a laser scanner to and fro, or turns it on; an encoder tells its angle.

Three parts make it up. `Swing` is the mount's own motion. `TiltedScene` is what the laser on it sees: the scene cut by
a plane that moves while the laser measures, each beam at its own angle. `angle_encoder` is the encoder on its axle, a
CANopen node like those on wheels; its count is the angle, 0 where the mount is level.

The axle: "pitch" nods (positive looks down), "roll" turns about the direction that the laser looks in, "yaw" about the
vertical; a laser that turns about the vertical is mounted on its side (roll_rad = 90 degrees) to see up and down.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from sim_devices.device import F64, Mount, Scene
from sim_devices.encoder_cia406 import Cia406Encoder

Axle = Literal["pitch", "roll", "yaw"]
TURN = 2.0 * pi


@runtime_checkable
class SolidScene(Scene, Protocol):
    """A scene that knows heights."""

    def ray_ranges(self, origin_m: F64, direction: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """True distances (N,) along rays; +inf beyond range_max_m.

        origin_m, direction: (N, 3) in the robot's base frame, directions of length 1.  stamp_ns: (N,) when fired.
        """


@dataclass(frozen=True, slots=True)
class Swing:
    """The mount's motion: nodding between two angles, or turning on for ever.

    period_s: of one nod there and back, or of one turn.  middle_rad, swing_rad: nods from middle - swing to middle +
    swing, as a sine; swing_rad 0 with turning=True rotates.  start_ns: when it passes the middle upwards.
    """

    period_s: float = 4.0
    middle_rad: float = 0.0
    swing_rad: float = 0.6
    turning: bool = False
    start_ns: int = 0

    def angle_at(self, stamp_ns: F64) -> F64:
        """Angles (N,) at times (N,), not wrapped."""
        phase = TURN * (np.asarray(stamp_ns, dtype=np.float64) - self.start_ns) * 1e-9 / self.period_s
        return self.middle_rad + (phase if self.turning else self.swing_rad * np.sin(phase))


@dataclass(frozen=True, slots=True)
class TiltedScene:
    """What a scanner on a mount sees. A `device.Scene`: the laser's own mount is where the axle is, level.

    arm_m: from the axle to the laser's origin, forward, left and up at angle 0.  roll_rad: the laser itself is turned
    about its forward axis.
    """

    scene: SolidScene
    swing: Swing
    axle: Axle = "pitch"
    arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll_rad: float = 0.0

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        """See `device.Scene`; every beam is tilted by the mount's angle at its own moment."""
        bearing = np.asarray(bearing_rad, dtype=np.float64)
        stamps = np.broadcast_to(np.asarray(stamp_ns, dtype=np.float64), bearing.shape)
        origin, direction = self.beams(mount, bearing, stamps)
        return self.scene.ray_ranges(origin, direction, stamps, range_max_m)

    def beams(self, mount: Mount, bearing_rad: F64, stamp_ns: F64) -> tuple[F64, F64]:
        """Origins and directions (N, 3) of beams in the robot's base frame."""
        count = len(bearing_rad)
        across = np.sin(bearing_rad)
        own = np.stack((np.cos(bearing_rad), across * np.cos(self.roll_rad), across * np.sin(self.roll_rad)), axis=-1)
        angle = self.swing.angle_at(stamp_ns)
        yaw, over = np.full(count, mount.yaw_rad), np.array([1.0, -1.0, -1.0] if mount.upside_down else [1.0, 1.0, 1.0])
        direction = turned(over * turned(own, self.axle, angle), "yaw", yaw)
        arm = np.broadcast_to(np.asarray(self.arm_m, dtype=np.float64), (count, 3))
        origin = turned(over * turned(arm, self.axle, angle), "yaw", yaw) + (mount.x_m, mount.y_m, mount.z_m)
        return origin, direction

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        """See `device.Scene`: the mount carries no sonar."""
        return self.scene.cone_range(mount, half_angle_rad, now_ns, range_max_m)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """See `device.Scene`."""
        return self.scene.wheel_travel_m(now_ns)


def turned(vector: F64, axle: Axle, angle_rad: F64) -> F64:
    """(N, 3) vectors turned by angles (N,) about the forward axis (roll), the left one (pitch), the vertical (yaw)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = vector.T
    if axle == "roll":
        return np.stack((x, c * y - s * z, s * y + c * z), axis=-1)
    if axle == "pitch":
        return np.stack((c * x + s * z, y, -s * x + c * z), axis=-1)
    return np.stack((c * x - s * y, s * x + c * y, z), axis=-1)


@dataclass(frozen=True, slots=True)
class _AxleScene:
    """The mount's axle as if it were a wheel of radius 1 that rolls the angle."""

    scene: Scene
    swing: Swing

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return self.scene.beam_ranges(mount, bearing_rad, stamp_ns, range_max_m)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return self.scene.cone_range(mount, half_angle_rad, now_ns, range_max_m)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        angle = float(self.swing.angle_at(np.array([float(now_ns)]))[0])
        return angle, angle


def axle_scene(scene: Scene, swing: Swing) -> Scene:
    """What an encoder on the mount's axle measures: wheel travel is the angle in radians, for a radius of 1."""
    return _AxleScene(scene, swing)


def angle_encoder(
    scene: Scene, swing: Swing, node: int, *, steps_per_turn: int = 4096, sign: int = 1, serial: int = 5811
) -> Cia406Encoder:
    """The encoder on the axle: a CiA 406 node whose count is the angle, 0 where level, falling below 0 by wrapping."""
    return Cia406Encoder(
        axle_scene(scene, swing),
        node,
        wheel_radius_m=1.0,
        steps_per_turn=steps_per_turn,
        sign=sign,
        name="UMFELD SIM TILT",
        serial=serial,
    )
