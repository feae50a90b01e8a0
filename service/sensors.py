"""What fusion knows of each source: where it sits and how it hears. No wires, no protocols."""

from __future__ import annotations

from dataclasses import dataclass

from mapping.frames import Pose2


@dataclass(frozen=True, slots=True)
class Laser:
    """A 2D laser. upside_down: mounted head down, its bearings count clockwise seen from above.

    tilts: it sits on a mount that nods or turns: its sweeps make a cloud of points, and go into no flat map.
    """

    name: str
    base_from_sensor: Pose2
    height_m: float = 0.0
    upside_down: bool = False
    tilts: bool = False

    kind = "laser"


@dataclass(frozen=True, slots=True)
class Transducer:
    """One sonar of a chain. channel: as printed on the board."""

    channel: int
    base_from_transducer: Pose2
    height_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Chain:
    """Sonars fired in turn. cone_rad: full opening angle.  period_ns: from one round to the next, as configured."""

    name: str
    transducers: tuple[Transducer, ...]
    cone_rad: float
    range_min_m: float
    range_max_m: float
    period_ns: int = 100_000_000

    kind = "sonar"


@dataclass(frozen=True, slots=True)
class Wheels:
    """The encoders of the drive."""

    name: str

    kind = "wheels"


@dataclass(frozen=True, slots=True)
class AxleEncoder:
    """The encoder on the axle of a mount that nods or turns a laser."""

    name: str

    kind = "mount"


Sensor = Laser | Chain | Wheels | AxleEncoder
