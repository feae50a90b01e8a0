"""What devices say, in SI units, with status and stamp; nothing here knows a protocol.

Ranges follow one rule everywhere: +inf nothing seen up to the range limit, -inf an echo closer than the device can
measure, NaN invalid (nothing known). They are never 0, 9999 or max + 1. Angles: radians, counter-clockwise from the
sensor's x axis, which points forward (REP-103). Stamps: host monotonic nanoseconds, wire time taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


class RangeStatus(IntEnum):
    """What a single range measurement means."""

    ECHO = 0  # a distance was measured
    NO_RETURN = 1  # looked, saw nothing up to the range limit
    TOO_CLOSE = 2  # something is nearer than the device can measure
    INVALID = 3  # looked, cannot tell
    STALE = 4  # was known, is too old now
    NOT_LOOKED = 5  # this direction was not measured (transducer absent or switched off)


def status_of_range(range_m: float) -> RangeStatus:
    """Status implied by a range that follows the rule of this module. A finite range is an ECHO."""
    if math.isnan(range_m):
        return RangeStatus.INVALID
    if math.isinf(range_m):
        return RangeStatus.NO_RETURN if range_m > 0 else RangeStatus.TOO_CLOSE
    return RangeStatus.ECHO


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a device says it is; empty text where it does not say."""

    vendor: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class ScanReading:
    """One sweep of a laser rangefinder, beams in the order they were measured.

    stamp_ns: the first beam, host clock.  beam_period_ns: time from one beam to the next (0 if all at once).
    bearing_rad: (N,) sensor frame, running on where it passes the back (no jump of a turn).
    range_m: (N,) by this module's rule.  intensity: (N,) device units, or None.
    device_stamp_ns: the device's own clock at the first beam, unwrapped, or None.
    scan_period_ns: time from this sweep's first beam to the next sweep's, as the device profile gives it.
    """

    stamp_ns: int
    beam_period_ns: float
    scan_period_ns: int
    bearing_rad: F64
    range_m: F64
    range_min_m: float
    range_max_m: float
    intensity: F32 | None = None
    device_stamp_ns: int | None = None


@dataclass(frozen=True, slots=True)
class RangeReading:
    """One transducer of a chain. channel counts from 1 as printed on the board.

    heard_from: the channel that fired when it was not this one (cross echo), else None.
    """

    channel: int
    range_m: float
    status: RangeStatus
    heard_from: int | None = None


@dataclass(frozen=True, slots=True)
class ChainReading:
    """Part or all of one firing round of an ultrasonic chain. stamp_ns: earliest firing in it, host clock."""

    stamp_ns: int
    ranges: tuple[RangeReading, ...]


@dataclass(frozen=True, slots=True)
class WheelReading:
    """Counts of a left and a right wheel at one instant, unwrapped, in the device's own counting directions.

    Counts are running totals from the first sample after connecting; only differences mean anything.
    continuous is False for the first sample after a connection, a reset or a gap in which a wrap could hide:
    motion between it and the sample before is then unknown, not zero.
    """

    stamp_ns: int
    left_ticks: int
    right_ticks: int
    continuous: bool


@dataclass(frozen=True, slots=True)
class AngleReading:
    """The absolute count of an encoder on an axle at one instant, in the device's own counting direction.

    It goes on below 0 and through full turns as long as continuous is True; else the count starts anew from what the
    device says (0 to half its range as it is, above that as below 0), and what lay between is unknown.
    """

    stamp_ns: int
    ticks: int
    continuous: bool


class ContactState(IntEnum):
    """What a switch says: of a bumper that it touches, of a cliff sensor that the floor is missing."""

    CLEAR = 0
    TRIPPED = 1
    UNKNOWN = 2  # not answered any more, or not yet


@dataclass(frozen=True, slots=True)
class ContactLine:
    """One switch. line: its number on the device (a pin), as printed there."""

    line: int
    state: ContactState


@dataclass(frozen=True, slots=True)
class ContactReading:
    """One or more switches read at one instant. What each one means (bumper, cliff) and where it sits is not said here.

    Sent again at the device's own rate also when nothing changes: silence is a fault, not "clear".
    """

    stamp_ns: int
    lines: tuple[ContactLine, ...]


@dataclass(frozen=True, slots=True)
class PoseReading:
    """Where another estimator says the robot is, in its own fixed frame: z up, yaw counter-clockwise.

    continuous is False for the first one and wherever the estimator began anew: the step before is then no motion.
    quality: 0 to 1, None if not told.
    """

    stamp_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    continuous: bool
    quality: float | None = None


@dataclass(frozen=True, slots=True)
class AttitudeReading:
    """How the robot is tilted (x forward, y left, z up): roll right side down, pitch nose down, yaw to the left."""

    stamp_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rates_rad_s: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RingReading:
    """One look of a robot with rings of photo and touch sensors, the first to the front, the rest counter-clockwise.

    light: (N,) 0 to 1 of full scale.  touch: (N,) whether each one feels something.  ahead_m, left_m: the way since
    the first look after connecting, in the body's frame; only differences mean anything.  continuous is False for the
    first look after a connection, a reset or a gap: motion between it and the one before is unknown, not zero.
    """

    stamp_ns: int
    light: F64
    touch: NDArray[np.bool_]
    ahead_m: float
    left_m: float
    continuous: bool


Reading = (
    ScanReading
    | ChainReading
    | WheelReading
    | AngleReading
    | ContactReading
    | PoseReading
    | AttitudeReading
    | RingReading
)


class LinkState(IntEnum):
    """How a device is doing, seen from its wire."""

    ABSENT = 0  # the port cannot be opened
    SILENT = 1  # the port is open, the device does not answer, or no longer
    STARTING = 2  # the device answers and is being set up
    RUNNING = 3  # readings arrive


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """A change in a device's state, in words for a person. Queued with the readings, in order."""

    stamp_ns: int
    state: LinkState
    text: str
    identity: Identity | None = None


@dataclass(frozen=True, slots=True)
class ClockFit:
    """A device clock fitted to the host's: host = offset + device * (1 + drift); jitter is the residual's scatter."""

    offset_ns: int
    drift_ppm: float
    jitter_ns: float
    samples: int


@dataclass(slots=True)
class SourceCounters:
    """Everything that was counted about one device. Drops are named: {"bad_sum": 3, "queue_full": 1, ...}."""

    chunks: int = 0
    bytes: int = 0
    readings: int = 0
    drops: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str, count: int = 1) -> None:
        """Count something thrown away."""
        self.drops[reason] = self.drops.get(reason, 0) + count
