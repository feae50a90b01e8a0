"""The robot and its devices in the configuration. A new device is one more small model, told apart by its `driver`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from service.config_base import Direction, Heard, Name, Opening, Place, Point, Positive, Section, Track, Wheel

SERIAL_NUMBER = "serial:"
"""What a port begins with that is a device's serial number: where it is plugged in is found out when it is opened."""
SHARED_DRIVERS = ("arduino-bridge", "mavlink", "usboard", "usboard-serial")
"""Of boards that are several sources: a table in each section may name the same port."""


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
    source: Name | None = Field(default=None, description="The [wheels.NAME] that counts how the wheels roll.")
    pose_source: Name | None = Field(
        default=None, description="A [poses.NAME] whose poses are the odometry instead of wheel counts."
    )
    laser_odometry: bool = Field(
        default=True,
        description="Without source and pose_source: the sweeps of the first level laser are the odometry.",
    )
    wheel_radius_left_m: Wheel = Field(default=0.10, description="Rolling radius of the left wheel.")
    wheel_radius_right_m: Wheel = Field(default=0.10, description="Rolling radius of the right wheel.")
    track_width_m: Track = Field(default=0.50, description="Distance between the wheels' contact points.")
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

    @model_validator(mode="after")
    def _one_source(self) -> Drive:
        if self.source is not None and self.pose_source is not None:
            raise ValueError("source and pose_source both say how the robot moves; keep one of them")
        return self

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

    x_m: Place = Field(default=0.0, description="Forward of the base's origin.")
    y_m: Place = Field(default=0.0, description="Left of the base's origin.")
    z_m: Place = Field(default=0.0, description="Above the ground.")
    yaw_deg: Direction = Field(default=0.0, description="Direction it looks in, counter-clockwise from forward.")
    upside_down: bool = Field(default=False, description="Mounted head down: its bearings count the other way.")


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
_NOTHING_SEEN = (
    "What it means when the laser says that it saw nothing. clear: free up to the line between the echoes beside it "
    "(docs/algorithms/grids.md); unknown: nothing, as where things stand that give no echo."
)
_NO_ECHO = (
    "What a distance of 0 means. unknown: too far, or too near, too dark, glass; clear: nothing up to the line between "
    "the echoes beside it, which frees space and is right only where none of these is around."
)


def _refuse_unless_below(device: Device, low: str, high: str) -> None:
    """ValueError where both are given and the lower one is not."""
    lower, upper = getattr(device, low), getattr(device, high)
    if lower is not None and upper is not None and lower >= upper:
        raise ValueError(f"{low} must be below {high}")


class HokuyoLaser(Device):
    """Hokuyo laser rangefinder, SCIP 2.x (URG-04LX, UTM-30LX and kin), on USB, RS-232 or TCP (port 10940)."""

    driver: Literal["hokuyo"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int | None = Field(
        default=None, ge=1200, le=4000000, description="Line speed to try first on RS-232; default: all of them."
    )
    intensity: bool = Field(default=False, description="Ask for intensities where the device has them (UTM-30LX).")
    no_echo: NoEcho = Field(default="clear", description=_NOTHING_SEEN)
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
        _refuse_unless_below(self, "first_step", "last_step")
        _refuse_unless_below(self, "range_min_m", "range_max_m")
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
    no_echo: NoEcho = Field(default="clear", description=_NOTHING_SEEN)
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

    @model_validator(mode="after")
    def _in_order(self) -> RplidarLaser:
        _refuse_unless_below(self, "range_min_m", "range_max_m")
        return self


class LdrobotLaser(Device):
    """LDROBOT LD06 or LD19, on a serial line; it sends as soon as it has power."""

    driver: Literal["ldrobot"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int = Field(default=230400, ge=1200, le=4000000, description="Line speed.")
    no_echo: NoEcho = Field(default="unknown", description=_NO_ECHO)
    range_min_m: float = Field(default=0.02, ge=0, description="Nearest echo.")
    range_max_m: Positive = Field(default=12.0, description="Farthest echo.")
    mount: Mount = Field(default=Mount(), description="Where the laser sits; it looks where its mark points.")

    @model_validator(mode="after")
    def _in_order(self) -> LdrobotLaser:
        _refuse_unless_below(self, "range_min_m", "range_max_m")
        return self


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

    @model_validator(mode="after")
    def _in_order(self) -> SickColaLaser:
        _refuse_unless_below(self, "range_min_m", "range_max_m")
        return self


LaserDevice = Annotated[
    HokuyoLaser | SickLms2xxLaser | RplidarLaser | LdrobotLaser | SickColaLaser, Field(discriminator="driver")
]


class Transducer(Section):
    """One transducer of an ultrasonic chain."""

    channel: int = Field(ge=1, le=64, description="Number printed on the board, from 1.")
    x_m: Place = Field(default=0.0, description="Forward of the base's origin.")
    y_m: Place = Field(default=0.0, description="Left of the base's origin.")
    z_m: Place = Field(default=0.0, description="Above the ground.")
    yaw_deg: Direction = Field(default=0.0, description="Direction it looks in.")


class _UsBoard(Device):
    """What a USBoard is, whatever its link."""

    sending: Literal["auto", "request", "listen"] = Field(
        default="auto",
        description="Who sets the pace. auto: as the board is set; request: we ask; listen: it sends by itself.",
    )
    rate_hz: float = Field(default=10.0, gt=0, le=25, description="Rounds a second.")
    cone_deg: Opening = Field(default=30.0, description="Full opening angle of a transducer.")
    range_min_m: float = Field(default=0.2, ge=0, description="Nearest distance a transducer measures.")
    range_max_m: Heard = Field(default=3.0, description="Farther echoes count as nothing seen.")
    transducers: tuple[Transducer, ...] = Field(default=(), max_length=16, description="The connected ones.")

    @model_validator(mode="after")
    def _sensible(self) -> _UsBoard:
        channels = [transducer.channel for transducer in self.transducers]
        for channel in channels:
            if channel > 16:
                raise ValueError(f"a USBoard has channels 1 to 16, not {channel}")
            if channels.count(channel) > 1:
                raise ValueError(f"channel {channel} is given to two transducers; each has a channel of its own")
        _refuse_unless_below(self, "range_min_m", "range_max_m")
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

    cone_deg: Opening = Field(default=30.0, description="Full opening angle of a transducer.")
    range_min_m: float = Field(default=0.02, ge=0, description="Nearest distance a transducer measures.")
    range_max_m: Heard = Field(default=3.0, description="Farther echoes count as nothing seen.")
    transducers: tuple[Transducer, ...] = Field(default=(), max_length=64, description="The connected ones.")

    @model_validator(mode="after")
    def _sensible(self) -> _PlainSonars:
        channels = [transducer.channel for transducer in self.transducers]
        if len(set(channels)) != len(channels):
            raise ValueError("two transducers have the same channel; each has a channel of its own")
        _refuse_unless_below(self, "range_min_m", "range_max_m")
        return self


class MaxBotixSonars(_PlainSonars):
    """MaxBotix sensors by their serial text: one on a UART, or several behind a micro-controller that prints lines."""

    driver: Literal["maxbotix"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description="Serial port, best by a stable name: /dev/serial/by-id/...")
    baud_bps: int = Field(
        default=9600, ge=1200, le=4000000, description="Line speed; a sensor's own is 9600, of USB types 57600."
    )
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


_BRIDGE_PORT = "Serial port of the board; its wheels, sonars and switches name the same."
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


class Arm(Section):
    """Where a laser sits on its mount, seen from the axle, when the mount's angle is 0."""

    x_m: Place = Field(default=0.0, description="Forward of the axle.")
    y_m: Place = Field(default=0.0, description="Left of the axle.")
    z_m: Place = Field(default=0.0, description="Above the axle.")
    roll_deg: Direction = Field(default=0.0, description="Turned about its forward axis; 90: on its side.")
    pitch_deg: Direction = Field(default=0.0, description="Then about the left axis; positive looks down.")
    yaw_deg: Direction = Field(default=0.0, description="Then about the vertical.")


class Cia406Mount(Device):
    """A mount that nods or turns a laser, with a CANopen encoder (CiA 406) on its axle: key cloud/NAME."""

    driver: Literal["cia406"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] the encoder is on.")
    node: int = Field(default=0x30, ge=1, le=127, description="Node id of the encoder.")
    laser: Name = Field(description="The [lasers.NAME] on it; where that sits is said here, by mount and arm.")
    axle: Literal["pitch", "roll", "yaw"] = Field(
        default="pitch", description="pitch nods, roll turns about the direction it looks in, yaw about the vertical."
    )
    motion: Literal["nods", "turns"] = Field(
        default="nods", description="nods: a cloud from turning point to turning point; turns: a cloud each turn."
    )
    mount: Mount = Field(default=Mount(), description="Where the axle is.")
    arm: Arm = Field(default=Arm(), description="Where the laser is on the axle.")
    counts_per_turn: float = Field(
        default=4096.0, description="Counts per turn of the axle, gear included; negative if they fall looking down."
    )
    zero_deg: float = Field(default=0.0, ge=-360, le=360, description="The mount's angle where the count is 0.")
    rate_hz: float = Field(default=100.0, ge=10, le=200, description="Angles a second, by the encoder's own timer.")
    delay_ms: float = Field(
        default=0.0,
        ge=0,
        le=200,
        description="From measuring an angle to its arrival; right if floors seen up and down fit.",
    )
    max_turns_per_s: Positive = Field(
        default=20.0, description="Of the encoder's shaft; bounds how long a gap may hide that the count wrapped."
    )

    @field_validator("counts_per_turn")
    @classmethod
    def _not_zero(cls, counts: float) -> float:
        if counts == 0:
            raise ValueError("counts per turn cannot be 0; take them from the encoder's data sheet, times the gear")
        return counts

    def can_ids(self) -> frozenset[int]:
        """The predefined connection set of the node."""
        return frozenset(base + self.node for base in (0x080, 0x180, 0x280, 0x580, 0x600, 0x700))


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


class Switch(Section):
    """One bumper or cliff switch: where it covers the robot's border."""

    line: int = Field(ge=0, le=255, description="Its number on the device: a pin.")
    kind: Literal["bumper", "cliff"] = Field(default="bumper", description="What it feels; both block where they are.")
    tripped: Literal["low", "high"] = Field(
        default="high",
        description="Level of the line when it touches (or sees no floor). high: a switch that opens, with a pull-up, "
        "so that a broken wire counts as touched.",
    )
    x_m: Place = Field(default=0.0, description="Middle of what it covers, forward of the base's origin.")
    y_m: Place = Field(default=0.0, description="Left of the base's origin.")
    yaw_deg: Direction = Field(default=0.0, description="Direction it faces.")
    width_m: float = Field(default=0.2, gt=0, le=10, description="How wide it is.")


class _Contacts(Device):
    """Switches of whatever device."""

    rate_hz: float = Field(default=20.0, gt=0, le=50, description="How often each switch is asked.")
    hold_s: float = Field(
        default=0.5, ge=0, le=60, description="How long it counts as touched after it was: contacts bounce."
    )
    switches: tuple[Switch, ...] = Field(min_length=1, max_length=32, description="The connected ones.")

    @model_validator(mode="after")
    def _lines_of_their_own(self) -> _Contacts:
        lines = [switch.line for switch in self.switches]
        if len(set(lines)) != len(lines):
            raise ValueError("two switches have the same line; each has a line of its own")
        return self


class ArduinoContacts(_Contacts):
    """Bumpers and cliff switches at digital pins of a board with the text protocol of ros_arduino_bridge."""

    driver: Literal["arduino-bridge"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_BRIDGE_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed as set in the sketch.")


class _UsBoardContacts(_Contacts):
    """Switches at the analog inputs of a USBoard, whatever its link."""

    @model_validator(mode="after")
    def _inputs_there(self) -> _UsBoardContacts:
        for switch in self.switches:
            if switch.line > 3:
                raise ValueError(f"a USBoard has inputs 0 to 3, not {switch.line}")
        return self


class UsBoardContacts(_UsBoardContacts):
    """Bumpers and cliff switches at the four analog inputs of a USBoard on CAN."""

    driver: Literal["usboard"] = Field(description="Says that it is this kind of device.")
    can: Name = Field(description="The [can.NAME] it is on.")
    base_id: int = Field(default=0x400, ge=0, le=0x7EF, description="First of its CAN ids; that of its sonars.")

    def can_ids(self) -> frozenset[int]:
        """Those of the board: see UsBoardSonars."""
        return frozenset(range(self.base_id, self.base_id + 0x11))


class UsBoardSerialContacts(_UsBoardContacts):
    """The same at a board on its RS-232 or USB line."""

    driver: Literal["usboard-serial"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description="Its serial port; the same as that of its sonars.")


ContactDevice = Annotated[
    ArduinoContacts | UsBoardContacts | UsBoardSerialContacts,
    Field(discriminator="driver", description="Bumpers and cliff switches."),
]


class AliceRing(Device):
    """ALICE: rings of 24 photo and 24 touch sensors on a synchro drive, which makes the map of places: key map/topo."""

    driver: Literal["alice"] = Field(description="Says that it is this kind of device.")
    port: PortName = Field(description=_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed.")


class MavlinkPose(Device):
    """Where an autopilot's own estimator says the robot is: ODOMETRY. Named by pose_source of [drive]."""

    driver: Literal["mavlink"] = Field(description="Says that it is this kind of device.")
    port: str = Field(min_length=1, description=_MAVLINK_PORT)
    baud_bps: int = Field(default=57600, ge=1200, le=4000000, description="Line speed of a serial port.")
    system: int | None = Field(default=None, ge=1, le=255, description="System id; default: the first that is heard.")
    rate_hz: float = Field(
        default=15.0, gt=0, le=200, description="Asked of the autopilot; 57600 bit/s carry 20 at most."
    )

    @field_validator("port")
    @classmethod
    def _reachable(cls, port: str) -> str:
        return _mavlink_port(port)
