"""What fusion knows of each source: where it sits and how it hears. No wires, no protocols."""

from __future__ import annotations

from dataclasses import dataclass

from mapping.frames import Pose2


@dataclass(frozen=True, slots=True)
class Laser:
    """A 2D laser. upside_down: mounted head down, its bearings count clockwise seen from above.

    nothing_is_free: where it says that it saw nothing, there is nothing; else nothing is known.
    tilts: it sits on a mount that nods or turns: its sweeps make a cloud of points, and go into no flat map.
    """

    name: str
    base_from_sensor: Pose2
    height_m: float = 0.0
    upside_down: bool = False
    nothing_is_free: bool = True
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
    """Sonars fired in turn. cone_rad: full opening angle.  period_ns: from one round to the next, as configured.

    unchecked: its protocol has no check sum, so that a damaged value may pass for a true one.
    """

    name: str
    transducers: tuple[Transducer, ...]
    cone_rad: float
    range_min_m: float
    range_max_m: float
    period_ns: int = 100_000_000
    unchecked: bool = False

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


@dataclass(frozen=True, slots=True)
class Switch:
    """A bumper or cliff switch. line: its number on the device.  base_from_contact: its middle, looking outwards.

    width_m: how much of the robot's border it covers.
    """

    line: int
    base_from_contact: Pose2
    width_m: float


@dataclass(frozen=True, slots=True)
class Contacts:
    """The switches of one device. hold_ns: how long one counts as tripped after it was last seen so."""

    name: str
    switches: tuple[Switch, ...]
    period_ns: int = 50_000_000
    hold_ns: int = 500_000_000

    kind = "contacts"


@dataclass(frozen=True, slots=True)
class PoseSource:
    """Another estimator that says where the robot is."""

    name: str

    kind = "poses"


@dataclass(frozen=True, slots=True)
class Ring:
    """Light and touch all around, with the robot's own way."""

    name: str

    kind = "ring"


Sensor = Laser | Chain | Wheels | AxleEncoder | Contacts | PoseSource | Ring
