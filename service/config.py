"""The whole configuration: what may stand in umfeld.toml, checked as a whole, frozen afterwards.

TOML, strict: an unknown key is a fault that names the nearest known one; all faults are reported at once, each one
line with file, line, key and repair. Every value has a default and its unit in its name. A new device is one more
small model in this file, told apart by its `driver`. Reference for users: docs/configuration.md.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from service.config_faults import Fault, faults_of, without_faults
from service.config_files import DEFAULT_ENDPOINT, KeyPath, Layers, find_config, origin_of, read_layers
from service.errors import WrongUsage

Name = Annotated[str, Field(pattern=r"^[a-z0-9_-]+$", max_length=64)]
Reference = Annotated[str, Field(pattern=r"^((lasers|sonars)\.)?[a-z0-9_-]+$", max_length=80)]
Positive = Annotated[float, Field(gt=0)]
Point = tuple[float, float]
SENSOR_SECTIONS = ("lasers", "sonars")
DEVICE_SECTIONS = (*SENSOR_SECTIONS, "wheels")
SERIAL_NUMBER = "serial:"
"""What a port begins with that is a device's serial number: where it is plugged in is found out when it is opened."""
SHARED_DRIVERS = ("arduino-bridge", "mavlink")
"""Of boards that are several sources: a table in each section may name the same port."""


class Section(BaseModel):
    """Settings common to all tables: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


# --- the robot ----------------------------------------------------------------------------------------------------


class Robot(Section):
    """The vehicle: its name in every key, and its outline."""

    id: Name = Field(default="robot", description="Name of the robot; all Zenoh keys begin with robots/<id>.")
    footprint_m: tuple[Point, ...] = Field(
        default=((0.25, 0.20), (-0.25, 0.20), (-0.25, -0.20), (0.25, -0.20)),
        min_length=3,
        max_length=64,
        description="Outline as a polygon in the base frame (x forward, y left); every corner must be visible from the "
        "base's origin.",
    )

    @field_validator("footprint_m")
    @classmethod
    def _seen_from_origin(cls, corners: tuple[Point, ...]) -> tuple[Point, ...]:
        turns = [x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1])]
        if not (all(turn > 0 for turn in turns) or all(turn < 0 for turn in turns)):
            raise ValueError(
                "the outline must enclose the origin and every corner be visible from it; list the corners in order "
                "around the robot, in the base frame"
            )
        return corners


class Drive(Section):
    """How wheel counts become motion."""

    kind: Literal["differential"] = Field(default="differential", description="Kind of drive.")
    source: Name | None = Field(
        default=None, description="The [wheels.NAME] that counts; without one there is no odometry."
    )
    wheel_radius_left_m: Positive = Field(default=0.10, description="Rolling radius of the left wheel.")
    wheel_radius_right_m: Positive = Field(default=0.10, description="Rolling radius of the right wheel.")
    track_width_m: Positive = Field(default=0.50, description="Distance between the wheels' contact points.")
    ticks_per_turn_left: float = Field(
        default=4096.0,
        description="Counts per turn of the left wheel, gear included; negative if they fall rolling forward.",
    )
    ticks_per_turn_right: float = Field(default=4096.0, description="The same for the right wheel.")
    travel_noise_m_per_sqrt_m: Positive = Field(
        default=0.01, description="Standard deviation of a wheel's travel after 1 m; grows with the root of the way."
    )
    unknown_speed_m_s: Positive = Field(
        default=1.0, description="How fast it may have moved while counts were missing."
    )
    unknown_turn_rad_s: Positive = Field(default=1.0, description="How fast it may have turned meanwhile.")
    max_wheel_speed_m_s: Positive = Field(
        default=5.0, description="Faster counting is dropped as a fault of the encoder."
    )

    @field_validator("ticks_per_turn_left", "ticks_per_turn_right")
    @classmethod
    def _not_zero(cls, ticks: float) -> float:
        if ticks == 0:
            raise ValueError(
                "counts per turn cannot be 0; take them from the encoder's data sheet, times the gear ratio"
            )
        return ticks


class Mount(Section):
    """Where a sensor sits, in the base frame."""

    x_m: float = Field(default=0.0, description="Forward of the base's origin.")
    y_m: float = Field(default=0.0, description="Left of the base's origin.")
    z_m: float = Field(default=0.0, description="Above the ground.")
    yaw_deg: float = Field(
        default=0.0, ge=-360, le=360, description="Direction it looks in, counter-clockwise from forward."
    )
    upside_down: bool = Field(default=False, description="Mounted head down: its bearings count the other way.")


class PlanePose(Section):
    """The pose of a virtual sensor in the base frame."""

    x_m: float = Field(default=0.0, description="Forward of the base's origin.")
    y_m: float = Field(default=0.0, description="Left of the base's origin.")
    yaw_deg: float = Field(default=0.0, ge=-360, le=360, description="Its x axis, counter-clockwise from forward.")


# --- wires and devices ----------------------------------------------------------------------------------------------


class CanBus(Section):
    """A CAN bus, through python-can."""

    interface: Literal["socketcan", "slcan", "virtual"] = Field(
        default="socketcan",
        description="socketcan: a CAN card; slcan: an adapter on a serial port; virtual: inside a process.",
    )
    channel: str = Field(
        default="can0", min_length=1, description="Interface name (can0) or the adapter's serial port."
    )
    bitrate_bps: Literal[10000, 20000, 50000, 100000, 125000, 250000, 500000, 1000000] = Field(
        default=1000000, description="Bus speed; for socketcan it is set by the system, not here."
    )


class Device(Section):
    """What every device has: which wire it is on and what it claims there.

    `serial = "H0614967"` in a device's table stands for its port: it is then found by its serial number.
    """

    @model_validator(mode="before")
    @classmethod
    def _by_serial(cls, table: Any) -> Any:
        if not isinstance(table, Mapping) or "serial" not in table or "port" not in cls.model_fields:
            return table
        serial = table["serial"]
        if "port" in table:
            raise ValueError("port and serial both say which device it is; keep one of them")
        if not isinstance(serial, str) or not serial or any(letter.isspace() for letter in serial):
            raise ValueError('serial must be the number as the device tells it, such as "H0614967"')
        rest = {key: value for key, value in table.items() if key != "serial"}
        return {**rest, "port": f"{SERIAL_NUMBER}{serial}"}

    def serial_port(self) -> str | None:
        """The serial port the device has for itself, or its address as tcp://HOST:PORT."""
        return getattr(self, "port", None)

    def can_bus(self) -> str | None:
        """The [can.NAME] the device is on."""
        return getattr(self, "can", None)

    def can_ids(self) -> frozenset[int]:
        """The 11-bit ids that belong to the device alone on its bus."""
        return frozenset()


NoEcho = Literal["unknown", "clear"]
_ADDRESS = re.compile(r"tcp://(\[[0-9a-fA-F:]+\]|[^/:\s]+):(\d{1,5})")


def tcp_address(port: str) -> tuple[str, int] | None:
    """Host and TCP port of an address tcp://HOST:PORT; None for a serial port. ValueError if it is neither."""
    if not port.startswith("tcp:"):
        return None
    match = _ADDRESS.fullmatch(port)
    if match is None or not 0 < int(match[2]) < 65536:
        raise ValueError("an address is written tcp://HOST:PORT, such as tcp://192.168.0.10:10940")
    return match[1].strip("[]"), int(match[2])


def _good_port(port: str) -> str:
    tcp_address(port)
    return port


PortName = Annotated[str, Field(min_length=1), AfterValidator(_good_port)]
_PORT = (
    "Serial port, best by a stable name (/dev/serial/by-id/...), an address (tcp://192.168.0.10:10940), or the "
    "device's serial number (serial:H0614967, the same as serial = ...)."
)
_NO_ECHO = (
    "What a distance of 0 means. unknown: too far, or too near, too dark, glass; clear: nothing up to the farthest "
    "echo, which frees space and is right only where none of these is around."
)


class HokuyoLaser(Device):
    """Hokuyo laser rangefinder, SCIP 2.x (URG-04LX, UTM-30LX and kin), on USB, RS-232 or TCP (port 10940)."""

    driver: Literal["hokuyo"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int | None = Field(
        default=None, ge=1200, le=4000000, description="Line speed to try first on RS-232; default: all of them."
    )
    intensity: bool = Field(default=False, description="Ask for intensities where the device has them (UTM-30LX).")
    mount: Mount = Field(default=Mount(), description="Where the laser sits.")
    first_step: int | None = Field(default=None, ge=0, description="Narrows the field: first step of the device's own.")
    last_step: int | None = Field(default=None, ge=0, description="Narrows the field: last step.")
    cluster: int | None = Field(default=None, ge=1, le=99, description="Steps joined to one beam; default: none.")
    skip_scans: int | None = Field(
        default=None, ge=0, le=9, description="Scans left out between two; default: what the line's speed asks for."
    )
    range_min_m: float | None = Field(default=None, ge=0, description="Nearest echo; default: the device's own limit.")
    range_max_m: Positive | None = Field(default=None, description="Farthest echo; default: the device's own limit.")

    @model_validator(mode="after")
    def _in_order(self) -> HokuyoLaser:
        for low, high in (("first_step", "last_step"), ("range_min_m", "range_max_m")):
            lower, upper = getattr(self, low), getattr(self, high)
            if lower is not None and upper is not None and lower >= upper:
                raise ValueError(f"{low} must be below {high}")
        return self


class SickLms2xxLaser(Device):
    """SICK LMS200, 211, 220, 221 or 291, on RS-232 or RS-422."""

    driver: Literal["sick_lms2xx"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: Literal[9600, 19200, 38400, 500000] = Field(
        default=38400, description="Line speed to work at; 500000 needs RS-422. It is found at any other and set."
    )
    field_deg: Literal[180, 100] = Field(default=180, description="Field of view.")
    resolution_deg: float = Field(
        default=0.5, description="Angle between beams: 1.0 or 0.5; with a field of 100 also 0.25."
    )
    unit: Literal["keep", "mm", "cm"] = Field(
        default="keep", description="mm: up to 8 m; cm: up to 80 m; written into the scanner where it is set otherwise."
    )
    mount: Mount = Field(default=Mount(), description="Where the laser sits.")

    @model_validator(mode="after")
    def _variant(self) -> SickLms2xxLaser:
        choices = (1.0, 0.5, 0.25) if self.field_deg == 100 else (1.0, 0.5)
        if self.resolution_deg not in choices:
            raise ValueError(f"with a field of {self.field_deg} deg resolution_deg is one of {choices}")
        return self


class RplidarLaser(Device):
    """Slamtec RPLIDAR A1, A2 or A3, on its USB adapter."""

    driver: Literal["rplidar"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int | None = Field(
        default=None, ge=1200, le=4000000, description="Line speed; default: 115200 and 256000 are tried in turn."
    )
    scan: Literal["auto", "standard", "express"] = Field(
        default="auto", description="Scan mode; auto: express where the device has it."
    )
    motor_pwm: int = Field(default=660, ge=1, le=1023, description="Motor speed of A2 and later.")
    no_echo: NoEcho = Field(default="unknown", description=_NO_ECHO)
    range_min_m: float = Field(default=0.15, ge=0, description="Nearest echo.")
    range_max_m: Positive | None = Field(default=None, description="Farthest echo; default: by model or mode.")
    mount: Mount = Field(default=Mount(), description="Where the laser sits; it looks away from its cable.")


class LdrobotLaser(Device):
    """LDROBOT LD06 or LD19, on a serial line; it sends as soon as it has power."""

    driver: Literal["ldrobot"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int = Field(default=230400, ge=1200, le=4000000, description="Line speed.")
    no_echo: NoEcho = Field(default="unknown", description=_NO_ECHO)
    range_min_m: float = Field(default=0.02, ge=0, description="Nearest echo.")
    range_max_m: Positive = Field(default=12.0, description="Farthest echo.")
    mount: Mount = Field(default=Mount(), description="Where the laser sits; it looks where its mark points.")


class SickColaLaser(Device):
    """SICK TiM5xx, TiM7xx, LMS1xx and relatives that speak CoLa binary, over TCP."""

    driver: Literal["sick_cola"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description="Its address, such as tcp://192.168.0.1:2112.")
    start: bool = Field(default=True, description="Log in and start the measurement where it does not run.")
    ahead_deg: float = Field(default=90.0, ge=-360, le=360, description="The scanner's angle that looks ahead.")
    no_echo: NoEcho = Field(default="unknown", description=_NO_ECHO)
    range_min_m: float = Field(default=0.05, ge=0, description="Nearest echo.")
    range_max_m: Positive | None = Field(default=None, description="Farthest echo; default: by model.")
    mount: Mount = Field(default=Mount(), description="Where the laser sits.")


LaserDevice = Annotated[
    HokuyoLaser | SickLms2xxLaser | RplidarLaser | LdrobotLaser | SickColaLaser, Field(discriminator="driver")
]


class Transducer(Section):
    """One transducer of an ultrasonic chain."""

    channel: int = Field(ge=1, le=64, description="Number printed on the board, from 1.")
    x_m: float = Field(default=0.0, description="Forward of the base's origin.")
    y_m: float = Field(default=0.0, description="Left of the base's origin.")
    z_m: float = Field(default=0.0, description="Above the ground.")
    yaw_deg: float = Field(default=0.0, ge=-360, le=360, description="Direction it looks in.")


class _UsBoard(Device):
    """What a USBoard is, whatever its link."""

    sending: Literal["auto", "request", "listen"] = Field(
        default="auto",
        description="Who sets the pace. auto: as the board is set; request: we ask; listen: it sends by itself.",
    )
    rate_hz: float = Field(default=10.0, gt=0, le=25, description="Rounds a second.")
    cone_deg: float = Field(default=30.0, gt=0, le=120, description="Full opening angle of a transducer.")
    range_min_m: float = Field(default=0.2, ge=0, description="Nearest distance a transducer measures.")
    range_max_m: Positive = Field(default=3.0, description="Farther echoes count as nothing seen.")
    transducers: tuple[Transducer, ...] = Field(default=(), max_length=16, description="The connected ones.")

    @model_validator(mode="after")
    def _sensible(self) -> _UsBoard:
        channels = [transducer.channel for transducer in self.transducers]
        for channel in channels:
            if channel > 16:
                raise ValueError(f"a USBoard has channels 1 to 16, not {channel}")
            if channels.count(channel) > 1:
                raise ValueError(f"channel {channel} is given to two transducers; each has a channel of its own")
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class UsBoardSonars(_UsBoard):
    """Neobotix USBoard or USBoard-USS5, an ultrasonic chain of up to 16 transducers, on CAN."""

    driver: Literal["usboard"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] it is on.")
    base_id: int = Field(default=0x400, ge=0, le=0x7EF, description="First of its 17 CAN ids; second board 0x420.")

    def can_ids(self) -> frozenset[int]:
        """Command id, answers and measuring groups: base to base + 10h."""
        return frozenset(range(self.base_id, self.base_id + 0x11))


class UsBoardSerialSonars(_UsBoard):
    """The same board on its RS-232 or USB line."""

    driver: Literal["usboard-serial"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description="Serial port, best by a stable name: /dev/serial/by-id/...")


class _PlainSonars(Device):
    """Sonars without a board of their own."""

    cone_deg: float = Field(default=30.0, gt=0, le=120, description="Full opening angle of a transducer.")
    range_min_m: float = Field(default=0.02, ge=0, description="Nearest distance a transducer measures.")
    range_max_m: Positive = Field(default=3.0, description="Farther echoes count as nothing seen.")
    transducers: tuple[Transducer, ...] = Field(default=(), max_length=64, description="The connected ones.")

    @model_validator(mode="after")
    def _sensible(self) -> _PlainSonars:
        channels = [transducer.channel for transducer in self.transducers]
        if len(set(channels)) != len(channels):
            raise ValueError("two transducers have the same channel; each has a channel of its own")
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class MaxBotixSonars(_PlainSonars):
    """MaxBotix sensors by their serial text: one on a UART, or several behind a micro-controller that prints lines."""

    driver: Literal["maxbotix"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description="Serial port, best by a stable name: /dev/serial/by-id/...")
    baud_bps: int = Field(default=9600, ge=1200, le=4000000, description="Line speed; a sensor's own is 9600.")
    family: Literal["lv", "xl", "hr-5m", "hr-10m"] = Field(
        description="What the digits mean: lv inches, xl centimetres, hr millimetres (5 m or 10 m type)."
    )
    lines: Literal["single", "labelled", "list"] = Field(
        default="single",
        description="single: one sensor, channel 1; labelled: `3:R1234`; list: `R123 R087` in order of channels.",
    )
    rate_hz: float | None = Field(
        default=None, gt=0, le=50, description="How often each channel comes; default: as the family, fired in turn."
    )

    @model_validator(mode="after")
    def _one_on_a_line(self) -> MaxBotixSonars:
        if self.lines == "single" and [each.channel for each in self.transducers] not in ([], [1]):
            raise ValueError('a sensor on a UART of its own is channel 1; for several set lines = "labelled" or "list"')
        return self


_BRIDGE_PORT = "Serial port of the board; its wheels and sonars name the same."
_MAVLINK_PORT = "Serial port, udpin:127.0.0.1:14550 (listens) or udpout:127.0.0.1:14550; its sources name the same."


class ArduinoSonars(_PlainSonars):
    """Ping sonars of a board with the text protocol of ros_arduino_bridge."""

    driver: Literal["arduino-bridge"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_BRIDGE_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed as set in the sketch.")
    rate_hz: float = Field(default=5.0, gt=0, le=20, description="How often each sonar is asked.")
    zero_is_free: bool = Field(
        default=False, description="0 cm means that nothing is in reach; else that nothing is known."
    )
    transducers: tuple[Transducer, ...] = Field(
        min_length=1, max_length=64, description="The connected ones; the channel is the pin."
    )


class MavlinkSonars(_PlainSonars):
    """Distances from an autopilot: DISTANCE_SENSOR."""

    driver: Literal["mavlink"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_MAVLINK_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed of a serial port.")
    system: int | None = Field(default=None, ge=1, le=255, description="System id; default: the first that is heard.")
    rate_hz: float = Field(default=10.0, gt=0, le=200, description="Asked of the autopilot.")

    @field_validator("port")
    @classmethod
    def _reachable(cls, port: str) -> str:
        return _mavlink_port(port)


def _mavlink_port(port: str) -> str:
    if port.startswith(("udpin:", "udpout:")):
        from drivers.udp_port import parse_udp

        if parse_udp(port) is None:
            raise ValueError(f"{port} is no UDP address; write udpin:127.0.0.1:14550")
    return port


SonarDevice = Annotated[
    UsBoardSonars | UsBoardSerialSonars | MaxBotixSonars | ArduinoSonars | MavlinkSonars, Field(discriminator="driver")
]


class Cia406Wheels(Device):
    """Two CANopen encoders (CiA 406), one a wheel, sampled together by SYNC."""

    driver: Literal["cia406"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] they are on.")
    node_left: int = Field(default=0x20, ge=1, le=127, description="Node id of the left wheel's encoder.")
    node_right: int = Field(default=0x21, ge=1, le=127, description="Node id of the right wheel's encoder.")
    rate_hz: float = Field(default=100.0, ge=1, le=200, description="Samples a second.")
    produce_sync: bool = Field(default=True, description="We send SYNC; false if another node on the bus does.")
    sampling: Literal["auto", "sync", "cyclic"] = Field(
        default="auto", description="What starts a sample: SYNC, the encoders' own timers, or SYNC where they have it."
    )
    max_turns_per_s: Positive = Field(
        default=20.0, description="Of the encoder's shaft; bounds how long a gap may hide that the count wrapped."
    )

    def can_ids(self) -> frozenset[int]:
        """The predefined connection set of both nodes; SYNC and NMT are shared by all."""
        bases = (0x080, 0x180, 0x280, 0x580, 0x600, 0x700)
        return frozenset(base + node for base in bases for node in (self.node_left, self.node_right))

    @model_validator(mode="after")
    def _two_nodes(self) -> Cia406Wheels:
        if self.node_left == self.node_right:
            raise ValueError("node_left and node_right are the same; each encoder has a node id of its own")
        return self


class ArduinoWheels(Device):
    """Wheel counts of a board with the text protocol of ros_arduino_bridge."""

    driver: Literal["arduino-bridge"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_BRIDGE_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed as set in the sketch.")
    rate_hz: float = Field(default=30.0, gt=0, le=100, description="Samples a second.")
    max_ticks_per_s: Positive = Field(
        default=50000.0, description="No wheel counts faster; tells damage and resets from motion."
    )


class RoboClawWheels(Device):
    """A RoboClaw motor controller in packet serial mode, with an encoder at each motor."""

    driver: Literal["roboclaw"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description="Serial port, best by a stable name: /dev/serial/by-id/...")
    baud_bps: int = Field(default=38400, ge=1200, le=4000000, description="Line speed; any on USB.")
    address: int = Field(default=0x80, ge=0x80, le=0x87, description="As set in the controller, 0x80 to 0x87.")
    left_motor: Literal[1, 2] = Field(default=1, description="The motor at the left wheel.")
    rate_hz: float = Field(default=50.0, gt=0, le=200, description="Samples a second.")
    max_ticks_per_s: Positive = Field(
        default=200000.0, description="No wheel counts faster; tells damage and resets from motion."
    )


class ODriveWheels(Device):
    """Two ODrive axes on CAN (CANSimple), firmware 0.5.x or 0.6.x."""

    driver: Literal["odrive"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] they are on.")
    node_left: int = Field(default=0, ge=0, le=63, description="Node id of the left wheel's axis.")
    node_right: int = Field(default=1, ge=0, le=63, description="Node id of the right wheel's axis.")
    rate_hz: float = Field(default=100.0, gt=0, le=500, description="Samples a second.")
    counts_per_turn: int = Field(default=8192, ge=1, description="Of the encoders (cpr); positions are told in counts.")
    max_turns_per_s: Positive = Field(default=100.0, description="No motor turns faster; tells resets from motion.")
    firmware: Literal["auto", "0.5", "0.6"] = Field(default="auto", description="Generation; 0.6 has no counts.")

    def can_ids(self) -> frozenset[int]:
        """All commands of both nodes."""
        return frozenset(node << 5 | command for node in (self.node_left, self.node_right) for command in range(32))

    @model_validator(mode="after")
    def _two_nodes(self) -> ODriveWheels:
        if self.node_left == self.node_right:
            raise ValueError("node_left and node_right are the same; each axis has a node id of its own")
        return self


class VescWheels(Device):
    """Two VESC motor controllers on CAN that send status 5 (tachometer) by themselves."""

    driver: Literal["vesc"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] they are on.")
    id_left: int = Field(ge=0, le=254, description="Controller id of the left wheel.")
    id_right: int = Field(ge=0, le=254, description="Controller id of the right wheel.")
    rate_hz: float = Field(default=50.0, gt=0, le=1000, description="As set in VESC Tool for status 5.")
    max_ticks_per_s: Positive = Field(
        default=30000.0, description="No tachometer counts faster; tells resets from motion."
    )

    @model_validator(mode="after")
    def _two_controllers(self) -> VescWheels:
        if self.id_left == self.id_right:
            raise ValueError("id_left and id_right are the same; each controller has an id of its own")
        return self


class MavlinkWheels(Device):
    """The ways of an autopilot's wheels: WHEEL_DISTANCE. A tick is a micrometre."""

    driver: Literal["mavlink"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_MAVLINK_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed of a serial port.")
    system: int | None = Field(default=None, ge=1, le=255, description="System id; default: the first that is heard.")
    rate_hz: float = Field(default=20.0, gt=0, le=200, description="Asked of the autopilot.")
    wheel_left: int = Field(default=0, ge=0, le=15, description="Index of the left wheel.")
    wheel_right: int = Field(default=1, ge=0, le=15, description="Index of the right wheel.")

    @field_validator("port")
    @classmethod
    def _reachable(cls, port: str) -> str:
        return _mavlink_port(port)

    @model_validator(mode="after")
    def _two_wheels(self) -> MavlinkWheels:
        if self.wheel_left == self.wheel_right:
            raise ValueError("wheel_left and wheel_right are the same wheel")
        return self


WheelDevice = Annotated[
    Cia406Wheels | ArduinoWheels | RoboClawWheels | ODriveWheels | VescWheels | MavlinkWheels,
    Field(discriminator="driver", description="The encoders of both wheels."),
]


# --- maps -----------------------------------------------------------------------------------------------------------


class PolarSectorMap(Section):
    """A polar sector map: per wedge of bearings the nearest obstacle and what is known."""

    sources: tuple[Reference, ...] = Field(
        min_length=1, description="Lasers and sonars that feed it; lasers.NAME or sonars.NAME where both have the name."
    )
    sector_deg: float = Field(default=5.0, gt=0, le=180, description="Width of a sector.")
    start_deg: float = Field(default=-120.0, ge=-360, le=360, description="Where the first sector begins.")
    stop_deg: float = Field(default=120.0, ge=-360, le=360, description="Where the last one ends.")
    range_max_m: Positive | None = Field(default=None, description="What lies farther does not count; default: all.")
    pose: PlanePose = Field(default=PlanePose(), description="The virtual sensor in the base frame.")

    @model_validator(mode="after")
    def _whole_sectors(self) -> PolarSectorMap:
        span = self.stop_deg - self.start_deg
        if not 0 < span <= 360:
            raise ValueError("stop_deg must lie above start_deg, by at most 360")
        count = span / self.sector_deg
        if abs(count - round(count)) > 1e-6:
            raise ValueError(f"{span:g} degrees are not a whole number of sectors of {self.sector_deg:g}")
        return self


class RectSectorMap(Section):
    """A rectangular sector map around the robot: per square the nearest obstacle and what is known."""

    sources: tuple[Reference, ...] = Field(
        min_length=1, description="Lasers and sonars that feed it; lasers.NAME or sonars.NAME where both have the name."
    )
    size_m: tuple[Positive, Positive] = Field(
        default=(4.0, 4.0), description="Extent along x and y, centred on the pose."
    )
    sector_m: Positive = Field(default=0.25, description="Edge of a sector.")
    pose: PlanePose = Field(default=PlanePose(), description="The virtual sensor in the base frame.")

    @model_validator(mode="after")
    def _whole_sectors(self) -> RectSectorMap:
        for size in self.size_m:
            count = size / self.sector_m
            if abs(count - round(count)) > 1e-6:
                raise ValueError(f"{size:g} m are not a whole number of sectors of {self.sector_m:g} m")
        if math.prod(self.size_m) / self.sector_m**2 > 40000:
            raise ValueError("more than 40000 sectors; take a larger sector_m or a smaller size_m")
        return self


class SectorMaps(Section):
    """All sector maps by name."""

    polar: dict[Name, PolarSectorMap] = Field(default={}, description="Polar sector maps.")
    rect: dict[Name, RectSectorMap] = Field(default={}, description="Rectangular sector maps.")


class Grid(Section):
    """The occupancy grid of the whole building, fixed in the map frame."""

    enabled: bool = Field(default=True, description="Keep it.")
    resolution_m: float = Field(default=0.05, ge=0.005, le=1.0, description="Edge of a cell.")
    model: Literal["counters", "log-odds"] = Field(default="counters", description="What a cell remembers.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Sensors that draw it; default: all.")
    publish_period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two whole grids.")
    update_period_s: float = Field(default=0.2, ge=0.2, le=3600, description="Shortest time between two updates.")


class LocalGrid(Section):
    """The occupancy grid around the robot, which rolls with it: key map/local."""

    enabled: bool = Field(default=False, description="Keep it.")
    size_m: float = Field(default=8.0, gt=0, le=200, description="Edge of the square it covers.")
    period_s: float = Field(default=0.2, ge=0.05, le=10, description="Shortest time between two that are published.")
    resolution_m: float = Field(default=0.05, ge=0.005, le=1.0, description="Edge of a cell.")
    model: Literal["counters", "log-odds"] = Field(default="counters", description="What a cell remembers.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Sensors that draw it; default: all.")


class Artos(Section):
    """The two-step map of ARTOS from polar sector maps to a robot-centred grid: key map/artos."""

    enabled: bool = Field(default=False, description="Keep it.")
    size_m: float = Field(default=8.0, gt=0, le=100, description="Edge of the square it covers.")
    resolution_m: float = Field(default=0.1, ge=0.01, le=1.0, description="Edge of a cell.")
    sources: tuple[Name, ...] = Field(default=(), description="The [sectors.polar.NAME] it is made from; default: all.")
    period_s: float = Field(default=0.2, ge=0.05, le=10, description="Time between two updates.")


class LineMapSettings(Section):
    """The map of walls as straight lines: key map/lines."""

    enabled: bool = Field(default=True, description="Keep it.")
    sources: tuple[Reference, ...] | None = Field(default=None, description="Lasers that draw it; default: all.")
    period_s: float = Field(default=1.0, ge=1.0, le=3600, description="Shortest time between two that are published.")
    min_scans: int = Field(default=2, ge=1, le=255, description="Scans that must have seen a line before it is told.")


class Alignment(Section):
    """How long readings wait for each other."""

    odometry_wait_ms: int = Field(
        default=500,
        ge=20,
        le=5000,
        description="A scan waits this long for odometry that covers it, then it is dropped.",
    )
    odometry_memory_s: float = Field(default=30.0, ge=1, le=600, description="How far back poses are remembered.")


# --- around the maps --------------------------------------------------------------------------------------------------


class Tls(Section):
    """Certificates for listening beyond this machine."""

    root_ca_certificate: str = Field(min_length=1, description="File: who signed the certificates we accept.")
    listen_certificate: str = Field(min_length=1, description="File: our certificate.")
    listen_private_key: str = Field(min_length=1, description="File: its key.")
    mutual: bool = Field(default=True, description="Ask clients for a certificate too.")


class Network(Section):
    """The Zenoh router inside the daemon."""

    listen: tuple[str, ...] = Field(
        default=(DEFAULT_ENDPOINT,),
        min_length=1,
        description="Where clients connect. Anything but loopback and unix sockets needs tls/ and [network.tls].",
    )
    connect: tuple[str, ...] = Field(default=(), description="Other routers to link to, for example a fleet's.")
    tls: Tls | None = Field(default=None, description="Certificates; needed for tls/ endpoints.")
    config: str | None = Field(
        default=None, description="File (JSON5) with further Zenoh settings, for example access rules."
    )

    @field_validator("listen", "connect")
    @classmethod
    def _endpoints(cls, endpoints: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in endpoints:
            protocol, slash, address = endpoint.partition("/")
            if protocol not in ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream") or not slash or not address:
                raise ValueError(f"{endpoint!r} is not an endpoint; write it like {DEFAULT_ENDPOINT}")
        return endpoints

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> Network:
        for endpoint in (*self.listen, *self.connect):
            if endpoint.startswith(("tls/", "quic/")) and self.tls is None:
                raise ValueError(f"{endpoint} needs certificates; add [network.tls], see deploy/ for an example")
        for endpoint in self.listen:
            if not is_local(endpoint) and not endpoint.startswith(("tls/", "quic/")):
                port = endpoint.rpartition(":")[2]
                raise ValueError(
                    f"{endpoint} would be open to everyone on the network; listen on tcp/127.0.0.1:{port}, or on tls/ "
                    "with [network.tls]"
                )
        return self


def is_local(endpoint: str) -> bool:
    """Whether only this machine reaches an endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = address.partition("#")[0].partition("?")[0].rpartition(":")[0]
    return host in ("localhost", "[::1]") or (host.startswith("127.") and host.replace(".", "").isdigit())


class Ros(Section):
    """The same data for an unmodified ROS 2 system with rmw_zenoh."""

    enabled: bool = Field(default=False, description="Publish under ROS 2 names and tokens as well.")
    distro: Literal["humble", "iron", "jazzy", "kilted", "lyrical", "rolling"] = Field(
        default="jazzy", description="Whose type hashes to use."
    )
    domain_id: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID.")


class Store(Section):
    """The map on disk."""

    enabled: bool = Field(default=True, description="Keep the map across restarts.")
    path: str | None = Field(
        default=None, description="The map's file; default: ROBOT.umfeld in $STATE_DIRECTORY or ~/.local/share/umfeld."
    )
    snapshot_period_s: float = Field(
        default=5.0, ge=0.5, le=3600, description="At most this much is lost when power fails."
    )


class Search(Section):
    """Where devices are looked for that are named by their serial number."""

    ports: tuple[str, ...] = Field(
        default=("/dev/serial/by-id/*", "/dev/serial/by-path/*", "/dev/ttyACM*", "/dev/ttyUSB*"),
        min_length=1,
        description="Patterns of port names.",
    )


class Mavlink(Section):
    """A polar sector map for an autopilot's obstacle avoidance: OBSTACLE_DISTANCE."""

    enabled: bool = Field(default=False, description="Send it.")
    map: Name | None = Field(default=None, description="The [sectors.polar.NAME] to send; default: the only one.")
    port: str = Field(
        default="udpout:127.0.0.1:14550",
        min_length=1,
        description="udpout:127.0.0.1:PORT, udpin:127.0.0.1:PORT, or a serial port.",
    )
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed of a serial port.")
    rate_hz: float = Field(default=15.0, ge=10, le=50, description="Messages a second, on a steady beat.")
    system_id: int = Field(default=1, ge=1, le=255, description="That of the vehicle.")
    component_id: int = Field(default=196, ge=1, le=255, description="Ours; 196 is obstacle avoidance.")
    range_min_m: float = Field(default=0.1, gt=0, le=10, description="Nearer obstacles are told as this near.")
    range_max_m: float = Field(default=10.0, gt=0, le=600, description="Farther ones are not told.")

    @field_validator("port")
    @classmethod
    def _this_machine(cls, port: str) -> str:
        if port.startswith("/"):
            return port
        from drivers.udp_port import parse_udp

        if parse_udp(port) is None:
            raise ValueError(f"{port!r} is neither a serial port (/dev/...) nor like udpout:127.0.0.1:14550")
        return port

    @model_validator(mode="after")
    def _in_order(self) -> Mavlink:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class RecordingSettings(Section):
    """What happened, byte by byte, for `umfeld replay`."""

    enabled: bool = Field(default=False, description="From the first byte; `umfeld record` does it on demand.")
    folder: str | None = Field(
        default=None, description="Where to; default: recordings in $STATE_DIRECTORY or ~/.local/share/umfeld."
    )
    published: bool = Field(default=True, description="Keep what is published too, not only what replay needs.")
    file_mb: float = Field(default=256.0, ge=1, le=100000, description="A file this large is ended and the next begun.")
    total_mb: float = Field(default=8000.0, ge=2, description="All recordings together; the oldest make room.")
    free_mb: float = Field(default=1000.0, ge=0, description="So much of the disk is left free for others.")

    @model_validator(mode="after")
    def _room_for_two(self) -> RecordingSettings:
        if self.total_mb < 2 * self.file_mb:
            raise ValueError("total_mb must hold at least two files of file_mb")
        return self


class Log(Section):
    """What is written to standard error."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least weight that is written."
    )


class Config(Section):
    """umfeld.toml as a whole."""

    robot: Robot = Field(default=Robot(), description="The vehicle.")
    drive: Drive = Field(default=Drive(), description="How wheel counts become motion.")
    can: dict[Name, CanBus] = Field(default={}, description="CAN buses by name.")
    lasers: dict[Name, LaserDevice] = Field(default={}, description="Laser rangefinders by name.")
    sonars: dict[Name, SonarDevice] = Field(default={}, description="Ultrasonic chains by name.")
    wheels: dict[Name, WheelDevice] = Field(default={}, description="Wheel encoders by name.")
    sectors: SectorMaps = Field(default=SectorMaps(), description="Sector maps.")
    grid: Grid = Field(default=Grid(), description="The grid of the whole building.")
    local_grid: LocalGrid = Field(default=LocalGrid(), description="The grid around the robot.")
    artos: Artos = Field(default=Artos(), description="The ARTOS two-step map.")
    lines: LineMapSettings = Field(default=LineMapSettings(), description="The map of walls as lines.")
    alignment: Alignment = Field(default=Alignment(), description="How long readings wait for each other.")
    network: Network = Field(default=Network(), description="The Zenoh router.")
    ros: Ros = Field(default=Ros(), description="ROS 2 beside our own keys.")
    store: Store = Field(default=Store(), description="The map on disk.")
    search: Search = Field(default=Search(), description="Where devices are looked for by serial number.")
    mavlink: Mavlink = Field(default=Mavlink(), description="A sector map for an autopilot.")
    recording: RecordingSettings = Field(
        default=RecordingSettings(), description="What happened, byte by byte, for `umfeld replay`."
    )
    log: Log = Field(default=Log(), description="What is written to standard error.")

    def devices(self) -> Iterator[tuple[str, str, Device]]:
        """(section, name, device) of every device, in a fixed order."""
        for section in DEVICE_SECTIONS:
            for name, device in sorted(getattr(self, section).items()):
                yield section, name, device

    def source_name(self, section: str, name: str) -> str:
        """The one name of a device in keys and reports: its own, with its section before it if an earlier one has it.

        lasers come before sonars, sonars before wheels: with [lasers.front] and [sonars.front] these are `front` and
        `sonars-front`.
        """
        earlier = {"lasers": (), "sonars": ("lasers",), "wheels": ("lasers", "sonars")}[section]
        return f"{section}-{name}" if any(name in getattr(self, other) for other in earlier) else name

    def resolve(self, reference: str) -> tuple[str, str]:
        """(section, name) of a sector map's or grid's source; a bare name means the laser if there is one.

        Raises KeyError if there is no such sensor.
        """
        section, dot, name = reference.rpartition(".")
        for candidate in (section,) if dot else SENSOR_SECTIONS:
            if candidate in SENSOR_SECTIONS and name in getattr(self, candidate):
                return candidate, name
        raise KeyError(reference)

    def store_path(self) -> Path:
        """The map's file."""
        if self.store.path is not None:
            return Path(self.store.path).expanduser()
        return state_folder() / f"{self.robot.id}.umfeld"

    def recording_folder(self) -> Path:
        """Where recordings are kept."""
        if self.recording.folder is not None:
            return Path(self.recording.folder).expanduser()
        return state_folder() / "recordings"


def state_folder() -> Path:
    """Where a service keeps its own: systemd's StateDirectory, or a place in the user's home."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(state) if state else Path.home() / ".local/share/umfeld"


@dataclass(frozen=True, slots=True)
class Loaded:
    """A valid configuration, where each value came from, and the files that were read."""

    config: Config
    origins: Mapping[KeyPath, str]
    files: tuple[Path, ...]

    def origin(self, path: KeyPath) -> str:
        """`default`, `FILE:LINE`, `environment NAME` or `--set`."""
        return origin_of(self.origins, path)


def load(
    path: Path | None = None, *, settings: Sequence[str] = (), environment: Mapping[str, str] | None = None
) -> Loaded:
    """Find, read, merge and check the configuration.

    path: the file, or None to look for one (docs/configuration.md).  settings: `KEY=VALUE` from the command line.
    Raises WrongUsage with one line per fault, all of them at once.
    """
    layers = read_layers(find_config(path), environment=environment, settings=settings)
    return Loaded(check(layers), layers.origins, layers.files)


def check(layers: Layers) -> Config:
    """Validate merged tables; raises WrongUsage with one line per fault."""
    data = _tuples(layers.data)
    config, faults = _parse(data)
    faults.extend(_cross_faults(config, data))
    if faults:
        places = layers.tables | layers.origins
        located = [(_place(places, fault.path), fault) for fault in faults]
        located.sort(key=lambda each: _in_file_order(each[0]))
        lines = (": ".join(filter(None, (place, ".".join(fault.path), fault.text))) for place, fault in located)
        raise WrongUsage(*dict.fromkeys(lines))
    return config


def _place(places: Mapping[KeyPath, str], path: KeyPath) -> str:
    """Where a key stands, or the table around it, or the first key below it; empty if in no file."""
    path = tuple(step.partition("[")[0] for step in path)
    for length in range(len(path), 0, -1):
        below = next((place for keys, place in places.items() if keys[:length] == path[:length]), None)
        if found := places.get(path[:length], below):
            return found
    return ""


def _in_file_order(origin: str) -> tuple[str, int]:
    file, _, line = origin.rpartition(":")
    return (file, int(line)) if line.isdecimal() else (origin, 0)


def _parse(data: dict[str, Any]) -> tuple[Config, list[Fault]]:
    """The configuration without its faulty parts, and the faults; so that what is left can be checked as well."""
    faults: list[Fault] = []
    while True:
        try:
            return Config.model_validate(data), faults
        except ValidationError as error:
            found = faults_of(error, Config, data)
            known = {fault.path for fault in faults}  # what was taken out is now missing: not a fault of its own
            faults.extend(fault for fault in found if fault.path not in known)
            smaller = without_faults(data, found)
            if smaller == data:
                return Config(), faults
            data = smaller


def _tuples(value: Any) -> Any:
    """Arrays as tuples, which frozen models keep."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


# --- what several tables must agree on --------------------------------------------------------------------------------


def _cross_faults(config: Config, data: Mapping[str, Any]) -> list[Fault]:
    """References that lead nowhere, and things claimed twice.

    Looked for in the raw tables, where tables that are faulty otherwise still stand: one fault does not hide another.
    """
    return [
        *_name_faults(data),
        *_reference_faults(data),
        *_port_faults(data),
        *_can_id_faults(config),
        *_unused_faults(config, data),
    ]


def _table(data: Mapping[str, Any], *keys: str) -> Mapping[str, Any]:
    table: Any = data
    for key in keys:
        table = table.get(key) if isinstance(table, Mapping) else None
    return table if isinstance(table, Mapping) else {}


def _tables(data: Mapping[str, Any], *keys: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    return ((name, each) for name, each in sorted(_table(data, *keys).items()) if isinstance(each, Mapping))


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(each for each in value if isinstance(each, str)) if isinstance(value, tuple) else ()


def _missing(path: KeyPath, name: str, section: str, data: Mapping[str, Any]) -> Fault:
    there = ", ".join(sorted(_table(data, *section.split("."))))
    repair = f"add [{section}.{name}], or name one of: {there}" if there else f"add [{section}.{name}]"
    return Fault(path, f"there is no [{section}.{name}]; {repair}")


def _name_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    for section in DEVICE_SECTIONS:
        if "json" in _table(data, section):
            yield Fault((section, "json"), "the name json is taken by the key health/json; take another name")


def _reference_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    source = _table(data, "drive").get("source")
    if isinstance(source, str) and source not in _table(data, "wheels"):
        yield _missing(("drive", "source"), source, "wheels", data)
    for section in DEVICE_SECTIONS:
        for name, device in _tables(data, section):
            bus = device.get("can")
            if isinstance(bus, str) and bus not in _table(data, "can"):
                yield _missing((section, name, "can"), bus, "can", data)
    for path, table in (
        *((("sectors", "polar", name), table) for name, table in _tables(data, "sectors", "polar")),
        *((("sectors", "rect", name), table) for name, table in _tables(data, "sectors", "rect")),
        (("grid",), _table(data, "grid")),
        (("local_grid",), _table(data, "local_grid")),
    ):
        for reference in _texts(table.get("sources")):
            section, dot, name = reference.rpartition(".")
            if not any(name in _table(data, each) for each in ((section,) if dot else SENSOR_SECTIONS)):
                known = [f"{each}.{one}" for each in SENSOR_SECTIONS for one in sorted(_table(data, each))]
                text = f"there is no sensor {reference}; name one of: {', '.join(known) or '(none yet)'}"
                yield Fault((*path, "sources"), text)
    sent = _table(data, "mavlink").get("map")
    if isinstance(sent, str) and sent not in _table(data, "sectors", "polar"):
        yield _missing(("mavlink", "map"), sent, "sectors.polar", data)
    for name in _texts(_table(data, "artos").get("sources")):
        if name not in _table(data, "sectors", "polar"):
            yield _missing(("artos", "sources"), name, "sectors.polar", data)


def _port_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    taken: dict[str, tuple[str, str, Any]] = {}
    claims: list[tuple[KeyPath, Any, Any]] = [
        ((section, name, key), table.get(key), table.get("driver"))
        for section, key in (*((each, "port") for each in DEVICE_SECTIONS), ("can", "channel"))
        for name, table in _tables(data, section)
    ]
    mavlink = _table(data, "mavlink")
    if mavlink.get("enabled"):
        claims.append((("mavlink", "port"), mavlink.get("port"), "mavlink"))
    for path, port, driver in claims:
        if not isinstance(port, str):
            continue
        real = os.path.realpath(port) if port.startswith("/") else port
        section, owner, owners_driver = taken.setdefault(real, (path[0], ".".join(path[:-1]), driver))
        if owner == ".".join(path[:-1]) or (
            driver in SHARED_DRIVERS and driver == owners_driver and path[0] != section
        ):
            continue
        yield Fault(path, f"{port} is already used by {owner}; each wire has a port of its own")


def _can_id_faults(config: Config) -> Iterator[Fault]:
    taken: dict[tuple[str, int], str] = {}
    for section, name, device in config.devices():
        bus = device.can_bus()
        if bus is None:
            continue
        clashes = sorted(can_id for can_id in device.can_ids() if (bus, can_id) in taken)
        if clashes:
            other = taken[bus, clashes[0]]
            yield Fault(
                (section, name),
                f"uses CAN id 0x{clashes[0]:03X} on [can.{bus}] like {other}; give one other ids (base_id, node_...)",
            )
        taken.update({(bus, can_id): f"{section}.{name}" for can_id in device.can_ids()})


def _unused_faults(config: Config, data: Mapping[str, Any]) -> Iterator[Fault]:
    """What was written down to be used and cannot be."""
    for name in config.wheels:
        if config.drive.source is None and "source" not in _table(data, "drive"):
            yield Fault(
                ("wheels", name), f'no drive uses it; add source = "{name}" to [drive], with the wheels\' measures'
            )
    polar = _table(data, "sectors", "polar")
    if config.mavlink.enabled and config.mavlink.map is None and len(polar) != 1:
        names = ", ".join(sorted(polar)) or "(none yet)"
        yield Fault(("mavlink", "map"), f"say which [sectors.polar.NAME] to send, of: {names}")
    if config.artos.enabled and not _table(data, "sectors", "polar"):
        yield Fault(("artos", "enabled"), "the ARTOS map is made from polar sector maps; add a [sectors.polar.NAME]")
