"""Faults on demand: what goes wrong with wires, devices and the world, written as text, seeded and repeatable.

    TARGET:KIND[=VALUE][(name=value, ...)][@WHEN]       WHEN:  5s..8s   5s+2s   5s (and ever after)   nothing: always

    laser:unplug@5s+2s                    pull the plug after 5 s, put it back 2 s later
    laser:flip=0.01@3s..8s                one bit in a hundred bytes
    laser:lost_sector(from_deg=-30, to_deg=10)
    sonar.left:stuck=0.8(channel=3)       sonar:stall hits sonar.left and sonar.right
    bus:flood=2000@4s..6s                 frames a second
    laser:drop=0.1(to_device=1)           of what the host sends, not of what the device says
    bumper.front:stuck_on                 a switch that stays closed

A CAN bus as a whole (bus.NAME) can be unplugged (the hosts' adapters are pulled out), be silent or held up (nothing
crosses it), lose its supply (its nodes go dark and start again) and spoil frames; what befalls the serial port of the
daemon's adapter (rename, busy, bytes lost) is written as adapter.NAME. A board that counts both wheels takes side=1
(left) or side=2 (right) in the faults of wheels.

Times count from the first step of any device of the plan. A `FaultPlan` hands out wrappers; each looks up what is
active for its name. What is wrapped does not know:

    plan.scene("laser", scene)      what the device measures         plan.node("sonar.left", node)   a CAN node
    plan.device("laser", laser)     a serial or TCP device           plan.bus("bus", bus)            a whole CAN bus
    plan.contact("bumper", switch)  a bumper or cliff switch

A host's slcan adapter is a serial device too: station.wrap_member(name, plan.device("can.daemon", adapter)).
`KINDS` lists all kinds. A device that carries faults out inside itself has `fault_family` and `inflict` (wheel.Faulty);
lasers may have set_speed_share, set_clock_drift and trouble. Faults may be started and ended while everything runs, in
the loop's thread (Attachment.post).
"""

from __future__ import annotations

import difflib
import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_devices.contact import Contact, floor_under
from sim_devices.device import F64, ByteDevice, CanDevice, Frame, Mount, Scene
from sim_devices.encoder_cia406 import Cia406Encoder
from sim_devices.ranging import ManyAtOnce
from sim_devices.slcan_hub import CanBus
from sim_devices.sonar_usboard import UsBoard, UsBoardCan, UsBoardSerial
from sim_devices.wheel import DrivenScene, Faulty, Side, Undo
from sim_devices.wire import SECOND_NS

FOREVER_NS = 1 << 62
STEP_NS = 2_000_000
BACKLOG_LIMIT = 1 << 20


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault: what it hits, what its value means and what it is if none is given."""

    hits: str  # what can have it: any device, a wire, serial port, bus, laser, sonar, encoder, or what a scene shows
    meaning: str
    value: float = 1.0


KINDS: dict[str, Kind] = {
    # wires, and the nodes of a bus where that makes sense
    "unplug": Kind("any", "the plug is out; the device keeps its power"),
    "rename": Kind("port", "the port is gone and comes back under its name plus this number", 1),
    "busy": Kind("port", "another program holds the port"),
    "no_permission": Kind("port", "the port may not be opened"),
    "power_cycle": Kind("any", "no supply; starts from scratch afterwards"),
    "brown_out": Kind(
        "any", "the supply dips in the middle of a message; silent for this many seconds, then starts", 0.3
    ),
    "slow_boot": Kind("any", "the device is deaf and mute"),
    "silence": Kind("any", "the device runs, nothing of it arrives"),
    "stall": Kind("any", "what the device sends is held back, and arrives all at once afterwards"),
    "single_bytes": Kind("wire", "bytes arrive one at a time, so many a second", 20_000),
    "short_reads": Kind("wire", "bytes arrive in pieces of 1 to this many", 7),
    "bursts": Kind("wire", "bytes arrive at intervals of this many seconds", 0.2),
    "drop": Kind("any", "share of bytes (frames, on a bus) lost; to_device=1: of those the host sends", 0.01),
    "add": Kind("any", "share of bytes (frames, on a bus) followed by one too many; to_device=1 as above", 0.01),
    "flip": Kind("any", "share of bytes (frames, on a bus) with one bit turned; to_device=1 as above", 0.01),
    "wrong_baud": Kind("port", "the device runs at another line rate"),
    "flood": Kind("any", "so many bytes (frames, on a bus) of nonsense a second", 2000),
    "delay": Kind("any", "everything arrives so many seconds late", 0.1),
    # a CAN bus
    "bus_off": Kind("bus", "the adapters have gone off the bus; they must be closed and opened again"),
    "id_clash": Kind("bus", "another node sends under `id` as well, with other data"),
    # what lasers meet
    "frozen": Kind("scene", "old data under new stamps"),
    "lost_sector": Kind("beams", "nothing can be known between from_deg and to_deg"),
    "ghost": Kind("beams", "an echo at this many metres between from_deg and to_deg where none is", 0.5),
    "glass": Kind("beams", "share of beams that pass through what stands between from_deg and to_deg", 0.9),
    "black": Kind("beams", "surfaces between from_deg and to_deg swallow the beam"),
    "mixed_pixels": Kind("beams", "share of beams at edges that read between near and far", 0.8),
    "dust": Kind("beams", "share of beams with an echo within 1.5 m", 0.02),
    "sun": Kind("beams", "share of beams blinded between from_deg and to_deg", 0.5),
    "interference": Kind("beams", "share of beams with a random range", 0.02),
    "slow_blinding": Kind("beams", "seconds until all beams are blind; more and more are", 20.0),
    "clock_drift": Kind("laser", "the device's clock runs so many ppm fast", 500.0),
    "speed": Kind("laser", "the head turns at this share of its speed", 0.95),
    "varying_speed": Kind("laser", "the head's speed swings by this share to both sides, every `period_s` (4)", 0.1),
    "varying_count": Kind(
        "laser", "the head's speed jumps by up to this share: turns have unlike numbers of beams", 0.1
    ),
    "trouble": Kind("laser", "hardware trouble under this status (50 to 97)", 51),
    # what sonars meet
    "stuck": Kind("sonar", "`channel` (all, if none) always reads this many metres", 0.5),
    "specular": Kind("cones", "share of echoes that a slanted wall sends elsewhere", 0.5),
    "chain_break": Kind("sonar", "all transducers from this channel on are cut off", 1),
    "order_swap": Kind("sonar", "`channel` and `with` are plugged in crosswise"),
    "temperature": Kind("sonar", "the air has this many degrees Celsius", -10.0),
    "cross_talk": Kind("sonar", "hears others' pulses: of USBoards those in the plan, else 3 of 10 readings"),
    # what encoders meet
    "wrap": Kind("encoder", "the count jumps to this many steps before it wraps (negative: after)", 100),
    "reset": Kind("encoder", "the node restarts with its count at 0"),
    "sign": Kind("wheels", "the count runs the other way"),
    "swap": Kind("wheels", "left and right are exchanged"),
    "missed_counts": Kind("wheels", "share of the steps not counted", 0.05),
    "slip": Kind("wheels", "the wheel turns by this share more than the robot moves", 0.2),
    "size_change": Kind("wheels", "the wheel has this share of its size", 0.95),
    "alarm": Kind("encoder", "the node reports an internal fault (this emergency or status code)", 0x1000),
    # what switches meet
    "bounce": Kind("switch", "the contact chatters for so many seconds whenever it closes or opens", 0.05),
    "stuck_on": Kind("switch", "the contact stays closed: pressed, or no floor"),
    "stuck_off": Kind("switch", "the contact never closes"),
}


class FaultSyntaxError(ValueError):
    """A fault that is not written as it should be; the text says what to write."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: whom it hits, what it is, from when to when (nanoseconds from the plan's beginning)."""

    target: str
    kind: str
    value: float
    arguments: Mapping[str, float] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = FOREVER_NS

    def argument(self, name: str, default: float) -> float:
        """A named argument."""
        return self.arguments.get(name, default)

    def hits(self, target: str) -> bool:
        """Whether a device of that name is meant: its own name, or the part before a dot."""
        return target == self.target or target.startswith(self.target + ".")


_FAULT = re.compile(
    r"(?P<target>[a-z0-9_.-]+):(?P<kind>[a-z_]+)(=(?P<value>[^@()]+))?(\((?P<arguments>[^()]*)\))?(@(?P<when>.+))?"
)
_TIME = re.compile(r"(?P<number>[0-9]*\.?[0-9]+)(?P<unit>ms|s|min)?")
_UNIT_NS = {"ms": 1_000_000, "s": SECOND_NS, "min": 60 * SECOND_NS, None: SECOND_NS}


def parse_fault(text: str) -> Fault:
    """A fault from its text. Raises FaultSyntaxError."""
    match = _FAULT.fullmatch(text.strip())
    if match is None:
        raise FaultSyntaxError(
            f"{text!r} is no fault; write TARGET:KIND=VALUE@START..END, as in laser:flip=0.01@3s..8s"
        )
    start_ns, end_ns = _parse_when(match["when"], text)
    arguments = dict(_parse_argument(part, text) for part in (match["arguments"] or "").split(",") if part.strip())
    value = None if match["value"] is None else _parse_number(match["value"], text)
    return _checked(match["target"], match["kind"], value, arguments, start_ns, end_ns)


def fault_from_table(table: Mapping[str, object]) -> Fault:
    """A fault from a TOML table: target, kind, and value, start_s, end_s or for_s; all else is an argument."""
    rest = dict(table)
    target, kind = rest.pop("target", None), rest.pop("kind", None)
    if not isinstance(target, str) or not isinstance(kind, str):
        raise FaultSyntaxError(f"a fault needs the texts `target` and `kind`: {dict(table)!r}")
    numbers: dict[str, float] = {}
    for name, value in rest.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FaultSyntaxError(f"{target}:{kind}: {name} must be a number, not {value!r}")
        numbers[name] = float(value)
    start_s = numbers.pop("start_s", 0.0)
    end_s = start_s + numbers.pop("for_s", math.inf)
    end_s = min(end_s, numbers.pop("end_s", math.inf))
    end_ns = FOREVER_NS if math.isinf(end_s) else round(end_s * SECOND_NS)
    return _checked(target, kind, numbers.pop("value", None), numbers, round(start_s * SECOND_NS), end_ns)


def _checked(
    target: str, kind: str, value: float | None, arguments: Mapping[str, float], start_ns: int, end_ns: int
) -> Fault:
    known = KINDS.get(kind)
    if known is None:
        near = difflib.get_close_matches(kind, KINDS, n=1)
        hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(sorted(KINDS))}"
        raise FaultSyntaxError(f"{target}: unknown kind of fault {kind!r}{hint}")
    if end_ns <= start_ns:
        raise FaultSyntaxError(f"{target}:{kind} ends before it begins")
    return Fault(target, kind, known.value if value is None else value, arguments, start_ns, end_ns)


def _parse_when(text: str | None, whole: str) -> tuple[int, int]:
    if text is None:
        return 0, FOREVER_NS
    for mark in ("..", "+"):
        if mark in text:
            first, second = (_parse_time(part, whole) for part in text.split(mark, 1))
            return first, second if mark == ".." else first + second
    return _parse_time(text, whole), FOREVER_NS


def _parse_time(text: str, whole: str) -> int:
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise FaultSyntaxError(f"{whole!r}: {text!r} is no time; write 5s, 500ms or 2min")
    return round(float(match["number"]) * _UNIT_NS[match["unit"]])


def _parse_argument(text: str, whole: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    if not equals:
        raise FaultSyntaxError(f"{whole!r}: {text.strip()!r} is no argument; write name=value")
    return name.strip(), _parse_number(value, whole)


def _parse_number(text: str, whole: str) -> float:
    try:
        return float(int(text.strip(), 0))
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        raise FaultSyntaxError(f"{whole!r}: {text.strip()!r} is no number") from None
    if not math.isfinite(number):
        raise FaultSyntaxError(f"{whole!r}: {text.strip()!r} is no finite number")
    return number


class FaultPlan:
    """The faults of one run, and the wrappers that carry them out.

    faults: Fault objects or their text.  seed: of everything random; the same seed gives the same bytes.
    """

    def __init__(self, faults: Iterable[Fault | str] = (), *, seed: int = 0) -> None:
        self.seed = seed
        self.faults = [parse_fault(fault) if isinstance(fault, str) else fault for fault in faults]
        self.boards: list[UsBoard] = []
        self._origin_ns: int | None = None
        self._targets: dict[str, set[str]] = {}

    # -- what is active -----------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        """The plan's time begins, at the first call."""
        if self._origin_ns is None:
            self._origin_ns = now_ns

    def now_ns(self, now_ns: int) -> int:
        """Time since the plan began; negative before."""
        return -1 if self._origin_ns is None else now_ns - self._origin_ns

    def active(self, target: str, kind: str, now_ns: int) -> Fault | None:
        """The first fault of a kind that hits a target now."""
        at_ns = self.now_ns(now_ns)
        for fault in self.faults:
            if fault.kind == kind and fault.start_ns <= at_ns < fault.end_ns and fault.hits(target):
                return fault
        return None

    def all_active(self, target: str, now_ns: int) -> list[Fault]:
        """All faults that hit a target now, in the order they were written."""
        at_ns = self.now_ns(now_ns)
        return [fault for fault in self.faults if fault.start_ns <= at_ns < fault.end_ns and fault.hits(target)]

    def next_change_ns(self, target: str, now_ns: int) -> int | None:
        """When the next fault of a target begins or ends."""
        at_ns = self.now_ns(now_ns)
        edges = [edge for fault in self.faults if fault.hits(target) for edge in (fault.start_ns, fault.end_ns)]
        ahead = [edge for edge in edges if at_ns < edge < FOREVER_NS]
        return min(ahead) - at_ns + now_ns if ahead else None

    def start(self, fault: Fault | str, now_ns: int) -> Fault:
        """Begin a fault now; its own times count from now. Returns it, for `end`."""
        self.begin(now_ns)
        written = parse_fault(fault) if isinstance(fault, str) else fault
        at_ns = self.now_ns(now_ns)
        end_ns = FOREVER_NS if written.end_ns == FOREVER_NS else written.end_ns + at_ns
        begun = Fault(written.target, written.kind, written.value, written.arguments, written.start_ns + at_ns, end_ns)
        self.faults.append(begun)
        return begun

    def end(self, fault: Fault) -> None:
        """End a fault that `start` began."""
        self.faults.remove(fault)

    def complaints(self) -> list[str]:
        """What is wrong with the faults' targets, in words. Call when all wrappers are made."""
        found = []
        for fault in self.faults:
            carried = [what for target, what in self._targets.items() if fault.hits(target)]
            if not carried:
                near = difflib.get_close_matches(fault.target, self._targets, n=1, cutoff=0.0)
                hint = f"; did you mean {near[0]}?" if near else ""
                found.append(f"{fault.target}:{fault.kind}: there is no device {fault.target!r}{hint}")
            elif not any(KINDS[fault.kind].hits in what for what in carried):
                hint = f"it hits {KINDS[fault.kind].hits}, this has {', '.join(sorted(set().union(*carried)))}"
                if KINDS[fault.kind].hits in ("wire", "port") and any("bus" in what for what in carried):
                    hint = f"the serial port of its adapter is adapter{fault.target.removeprefix('bus')}"
                found.append(f"{fault.target}:{fault.kind}: {fault.target!r} cannot have this fault; {hint}")
        return found

    def random(self, target: str, *more: int) -> np.random.Generator:
        """A generator of its own for each target."""
        return np.random.default_rng((self.seed, zlib.crc32(target.encode("ascii")), *more))

    # -- wrappers -----------------------------------------------------------------------------------------------------

    def scene(self, target: str, scene: Scene) -> FaultyScene:
        """What a device sees of the world through the faults that hit it."""
        self._carries(target, "scene", "beams", "cones", "wheels")
        return FaultyScene(scene, self, target)

    def device(self, target: str, device: ByteDevice, *, on_network: bool = False) -> FaultyByteDevice:
        """A serial or network device with its faults."""
        self._carries(target, "any", "wire", *([] if on_network else ["port"]), *_families(device))
        return FaultyByteDevice(device, self, target)

    def node(self, target: str, node: CanDevice) -> FaultyNode:
        """A CAN node with its faults."""
        self._carries(target, "any", *_families(node))
        return FaultyNode(node, self, target)

    def bus(self, target: str, bus: CanBus) -> None:
        """Faults of a whole CAN bus: a trouble-maker joins it as a node, and stands between all others."""
        self._carries(target, "any", "bus")
        trouble = BusTrouble(bus, self, target)
        bus.add_node(f"{target} faults", trouble)
        bus.disturbance = trouble

    def contact(self, target: str, contact: Contact) -> FaultyContact:
        """A switch with its faults."""
        self._carries(target, "switch")
        return FaultyContact(contact, self, target)

    def _carries(self, target: str, *what: str) -> None:
        self._targets.setdefault(target, set()).update(what)


# -- what the world shows ---------------------------------------------------------------------------------------------


class FaultyScene:
    """The world as a faulty sensor measures it."""

    def __init__(self, scene: Scene, plan: FaultPlan, target: str) -> None:
        self._scene = scene
        self._plan = plan
        self._target = target

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        now_ns = int(stamp_ns[-1]) if len(stamp_ns) else 0
        faults = self._plan.all_active(self._target, now_ns)
        frozen = next((fault for fault in faults if fault.kind == "frozen"), None)
        if frozen is not None:
            stamp_ns = stamp_ns - (self._plan.now_ns(now_ns) - frozen.start_ns)
        range_m = self._scene.beam_ranges(mount, bearing_rad, stamp_ns, range_max_m)
        for number, fault in enumerate(faults):
            change = BEAM_FAULTS.get(fault.kind)
            if change is not None:
                sight = Sight(
                    bearing_rad=bearing_rad,
                    range_max_m=range_max_m,
                    since_s=(self._plan.now_ns(now_ns) - fault.start_ns) * 1e-9,
                    random=self._plan.random(self._target, number, max(0, now_ns)),
                )
                range_m = change(range_m.copy(), fault, sight)
        return range_m

    def is_beam_by_beam(self, first_ns: int, last_ns: int) -> bool:
        """See `ranging.ManyAtOnce`: where no fault changes what is seen."""
        scene = self._scene
        if not isinstance(scene, ManyAtOnce) or not scene.is_beam_by_beam(first_ns, last_ns):
            return False
        begin_ns, end_ns = self._plan.now_ns(first_ns), self._plan.now_ns(last_ns)
        return not any(
            fault.hits(self._target) and fault.start_ns <= end_ns and fault.end_ns > begin_ns
            for fault in self._plan.faults
            if fault.kind == "frozen" or fault.kind in BEAM_FAULTS
        )

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        frozen = self._plan.active(self._target, "frozen", now_ns)
        at_ns = now_ns if frozen is None else now_ns - (self._plan.now_ns(now_ns) - frozen.start_ns)
        missed = self._plan.active(self._target, "specular", now_ns)
        if missed is not None:
            place = zlib.crc32(np.array([mount.x_m, mount.y_m, mount.yaw_rad]).tobytes())
            if self._plan.random(self._target, place, max(0, now_ns)).random() < missed.value:
                return math.inf
        return self._scene.cone_range(mount, half_angle_rad, at_ns, range_max_m)

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """Each fault adds to the travel what it has changed since it began, so nothing jumps when it ends."""
        at_ns = self._plan.now_ns(now_ns)
        true = np.array(self._scene.wheel_travel_m(now_ns))
        seen = true.copy()
        for fault in self._plan.faults:
            if not fault.hits(self._target) or fault.start_ns > at_ns:
                continue
            begin_ns = now_ns - at_ns + fault.start_ns
            until_ns = now_ns - at_ns + min(at_ns, fault.end_ns)
            rolled = np.array(self._scene.wheel_travel_m(until_ns)) - np.array(self._scene.wheel_travel_m(begin_ns))
            extra = _extra_roll(fault, rolled)
            side = round(fault.argument("side", 0))
            seen += extra if side not in (1, 2) else np.where(np.arange(2) == side - 1, extra, 0.0)
        return float(seen[0]), float(seen[1])

    def drive_wheel(self, now_ns: int, side: Side, speed_m_s: float) -> None:
        """Motors turn what is really there."""
        if isinstance(self._scene, DrivenScene):
            self._scene.drive_wheel(now_ns, side, speed_m_s)

    def floor_m(self, mount: Mount, now_ns: int) -> float:
        """See contact.GroundScene."""
        return floor_under(self._scene, mount, now_ns)


def _extra_roll(fault: Fault, rolled: F64) -> F64:
    """What a fault adds to the travel of both wheels that truly rolled so far while it was active."""
    if fault.kind == "frozen":
        return -rolled
    if fault.kind == "sign":
        return -2.0 * rolled
    if fault.kind == "swap":
        return rolled[::-1] - rolled
    if fault.kind == "missed_counts":
        return -fault.value * rolled
    if fault.kind == "slip":
        return fault.value * rolled
    if fault.kind == "size_change":  # a smaller wheel turns more for the same way
        return (1.0 / fault.value - 1.0) * rolled
    return np.zeros(2)


@dataclass(frozen=True, slots=True)
class Sight:
    """What a fault of beams may want to know of the scan it changes."""

    bearing_rad: F64
    range_max_m: float
    since_s: float
    random: np.random.Generator

    def chance(self, share: float) -> NDArray[np.bool_]:
        """True for that share of the beams."""
        return self.random.random(len(self.bearing_rad)) < share

    def sector(self, fault: Fault, *, half_width_deg: float = 20.0) -> NDArray[np.bool_]:
        """The beams from from_deg to to_deg, counter-clockwise."""
        begin = math.radians(fault.argument("from_deg", -half_width_deg))
        end = math.radians(fault.argument("to_deg", half_width_deg))
        width = (end - begin) % (2 * math.pi) or 2 * math.pi
        return (self.bearing_rad - begin) % (2 * math.pi) <= width


def _lost_sector(range_m: F64, fault: Fault, sight: Sight) -> F64:
    range_m[sight.sector(fault)] = np.nan
    return range_m


def _ghost(range_m: F64, fault: Fault, sight: Sight) -> F64:
    inside = sight.sector(fault, half_width_deg=5.0)
    range_m[inside] = np.fmin(range_m[inside], fault.value)
    return range_m


def _glass(range_m: F64, fault: Fault, sight: Sight) -> F64:
    range_m[sight.sector(fault) & sight.chance(fault.value)] = np.inf
    return range_m


def _black(range_m: F64, fault: Fault, sight: Sight) -> F64:
    """Too little light comes back to measure by; a device that can tells so, others say what they say of nothing."""
    range_m[sight.sector(fault) & np.isfinite(range_m)] = np.nan
    return range_m


def _mixed_pixels(range_m: F64, fault: Fault, sight: Sight) -> F64:
    near, far = range_m[:-1], range_m[1:]
    both = np.isfinite(near) & np.isfinite(far)
    step_m = np.where(both, far, 0.0) - np.where(both, near, 0.0)
    edge = (np.abs(step_m) > 0.3) & sight.chance(fault.value)[:-1]
    range_m[:-1] = np.where(edge, near + sight.random.random(len(near)) * step_m, near)
    return range_m


def _dust(range_m: F64, fault: Fault, sight: Sight) -> F64:
    speck_m = sight.random.uniform(0.05, 1.5, len(range_m))
    return np.where(sight.chance(fault.value), np.fmin(range_m, speck_m), range_m)


def _sun(range_m: F64, fault: Fault, sight: Sight) -> F64:
    range_m[sight.sector(fault, half_width_deg=30.0) & sight.chance(fault.value)] = np.nan
    return range_m


def _interference(range_m: F64, fault: Fault, sight: Sight) -> F64:
    return np.where(sight.chance(fault.value), sight.random.uniform(0.05, sight.range_max_m, len(range_m)), range_m)


def _slow_blinding(range_m: F64, fault: Fault, sight: Sight) -> F64:
    range_m[sight.chance(min(1.0, sight.since_s / fault.value))] = np.nan
    return range_m


BEAM_FAULTS: dict[str, Callable[[F64, Fault, Sight], F64]] = {
    "lost_sector": _lost_sector,
    "ghost": _ghost,
    "glass": _glass,
    "black": _black,
    "mixed_pixels": _mixed_pixels,
    "dust": _dust,
    "sun": _sun,
    "interference": _interference,
    "slow_blinding": _slow_blinding,
}


# -- devices ----------------------------------------------------------------------------------------------------------


SWING_STEP_NS = 100_000_000  # between two speeds of a head whose speed swings


def _families(device: object) -> list[str]:
    """Which of the kinds' families a device belongs to."""
    found = list(getattr(device, "fault_families", (device.fault_family,))) if isinstance(device, Faulty) else []
    if hasattr(device, "set_speed_share"):
        found.append("laser")
    if isinstance(device, UsBoardCan | UsBoardSerial):
        found.append("sonar")
    return [*found, "encoder"] if isinstance(device, Cia406Encoder) else found


class _Knobs:
    """Faults that turn something inside a device when they begin, and turn it back when they end."""

    def __init__(self, device: object, plan: FaultPlan, target: str) -> None:
        self._device = device
        self._plan = plan
        self._target = target
        self._undo: dict[int, Undo] = {}
        self._faults: list[Fault] = []
        self.frames: list[Frame] = []
        self._swing_ns: int | None = None
        if isinstance(device, UsBoardCan | UsBoardSerial):
            plan.boards.append(device.board)

    def follow(self, now_ns: int) -> list[Fault]:
        """Turn what changed since the last call; returns what is active."""
        active = self._plan.all_active(self._target, now_ns)
        for fault in self._faults:
            if not any(fault is other for other in active) and (undo := self._undo.pop(id(fault), None)) is not None:
                undo(now_ns)
        for fault in active:
            if not any(fault is other for other in self._faults) and (undo := self._turn(fault, now_ns)) is not None:
                self._undo[id(fault)] = undo
        self._faults = active
        self._swing(active, now_ns)
        return active

    @property
    def next_ns(self) -> int | None:
        """When it must turn something again."""
        return self._swing_ns

    def _swing(self, active: Sequence[Fault], now_ns: int) -> None:
        """A head whose speed swings gets another speed now and then."""
        swinging = next((fault for fault in active if fault.kind in ("varying_speed", "varying_count")), None)
        if swinging is None:
            self._swing_ns = None
        elif self._swing_ns is None or now_ns >= self._swing_ns:
            since_s = (self._plan.now_ns(now_ns) - swinging.start_ns) / SECOND_NS
            off = math.sin(2.0 * math.pi * since_s / swinging.argument("period_s", 4.0))
            if swinging.kind == "varying_count":
                off = float(self._plan.random(self._target, max(0, now_ns)).uniform(-1.0, 1.0))
            _call(self._device, "set_speed_share", 1.0 + swinging.value * off, now_ns)
            self._swing_ns = now_ns + SWING_STEP_NS

    def _turn(self, fault: Fault, now_ns: int) -> Undo | None:
        if isinstance(self._device, Faulty):
            return self._device.inflict(fault.kind, fault.value, fault.arguments, now_ns)
        if hasattr(self._device, "set_speed_share"):
            return _turn_laser(self._device, fault, now_ns)
        if isinstance(self._device, UsBoardCan | UsBoardSerial):
            return _turn_board(self._device.board, fault, self._plan.boards)
        if isinstance(self._device, Cia406Encoder):
            return self._turn_encoder(self._device, fault, now_ns)
        return None

    def _turn_encoder(self, encoder: Cia406Encoder, fault: Fault, now_ns: int) -> Undo | None:
        if fault.kind == "wrap":
            encoder.start_count += -round(fault.value) - encoder.position(now_ns)
        elif fault.kind == "reset":
            encoder.start_count -= encoder.position(now_ns)
            encoder.power_on(now_ns)
        elif fault.kind == "alarm":
            self.frames += encoder.raise_alarm(now_ns, code=round(fault.value))
            return lambda then_ns: self.frames.extend(encoder.raise_alarm(then_ns, code=0))
        return None


def _turn_laser(laser: object, fault: Fault, now_ns: int) -> Undo | None:
    if fault.kind == "clock_drift":
        before_ppm = getattr(laser, "clock_drift_ppm", 0.0)
        _call(laser, "set_clock_drift", fault.value, now_ns)
        return lambda then_ns: _call(laser, "set_clock_drift", before_ppm, then_ns)
    if fault.kind == "speed":
        _call(laser, "set_speed_share", fault.value, now_ns)
    if fault.kind in ("speed", "varying_speed", "varying_count"):
        return lambda then_ns: _call(laser, "set_speed_share", 1.0, then_ns)
    if fault.kind == "trouble":
        _call(laser, "trouble", f"{round(fault.value):02d}", now_ns)
        return lambda then_ns: _call(laser, "trouble", None, then_ns)
    return None


def _call(device: object, method: str, *arguments: object) -> None:
    """Call a method that not every device of the family has."""
    wanted = getattr(device, method, None)
    if wanted is not None:
        wanted(*arguments)


def _turn_board(board: UsBoard, fault: Fault, boards: Sequence[UsBoard]) -> Undo | None:
    channel = round(fault.argument("channel", 0))
    if fault.kind == "stuck":
        stuck = [channel] if channel else list(board.transducers)
        return _set(board, "stuck_m", board.stuck_m | dict.fromkeys(stuck, fault.value))
    if fault.kind == "chain_break":
        left = {one: there for one, there in board.transducers.items() if one < fault.value}
        return _set(board, "transducers", left)
    if fault.kind == "order_swap":
        first, second = channel or 1, round(fault.argument("with", 2))
        crossed = {first: second, second: first}
        return _set(board, "transducers", {crossed.get(one, one): there for one, there in board.transducers.items()})
    if fault.kind == "temperature":
        return _set(board, "air_temp_c", fault.value)
    if fault.kind == "cross_talk":
        return _set(board, "hears", [other for other in boards if other is not board])
    return None


def _set(thing: object, name: str, value: object) -> Undo:
    """Set an attribute; what comes back sets it as it was."""
    before = getattr(thing, name)
    setattr(thing, name, value)
    return lambda _: setattr(thing, name, before)


class FaultyByteDevice:
    """A serial or TCP device seen through its faults. See DeviceStation for the attributes it reads."""

    def __init__(self, device: ByteDevice, plan: FaultPlan, target: str) -> None:
        self.inner = device
        self.plugged = True
        self.port_suffix = ""
        self.port_busy = False
        self.port_denied = False
        self._plan = plan
        self._target = target
        self._knobs = _Knobs(device, plan, target)
        self._random = plan.random(target)
        self._now_ns: int | None = None
        self._was_off = False
        self._dark_until_ns: int | None = None
        self._browned: list[Fault] = []
        self._backlog = bytearray()
        self._released_ns = 0
        self._late: list[tuple[int, bytes]] = []

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        """Step the device and carry out what its faults do to the bytes."""
        self._plan.begin(now_ns)
        faults, inward = _by_direction(self._knobs.follow(now_ns))
        elapsed_ns = 0 if self._now_ns is None else now_ns - self._now_ns
        self._now_ns = now_ns
        self._follow_port(faults)
        if received and inward:
            received = self._mangled(np.frombuffer(received, np.uint8), inward)
        if self._is_dark(faults, now_ns):
            return b""
        deaf = not self.plugged or "wrong_baud" in faults
        out = self.inner.step(now_ns, b"" if deaf else received, baud)
        out = self._browning(out, faults, now_ns)
        if not self.plugged or "silence" in faults:
            self._backlog.clear()
            return b""
        return self._paced(self._spoiled(out, faults, elapsed_ns), faults, now_ns, elapsed_ns)

    @property
    def next_ns(self) -> int | None:
        """When the device, the next change of its faults, or held-back bytes want to be served."""
        now_ns = self._now_ns or 0
        due = [self._plan.next_change_ns(self._target, now_ns), self._dark_until_ns, self._knobs.next_ns]
        if not self._was_off:
            due.append(getattr(self.inner, "next_ns", now_ns + STEP_NS))
        held = self._plan.active(self._target, "stall", now_ns) is not None
        if (self._backlog and not held) or self._plan.active(self._target, "flood", now_ns):
            due.append(now_ns + STEP_NS // 4)
        due += [at_ns for at_ns, _ in self._late[:1]]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def link_lost(self, now_ns: int) -> None:
        """Its TCP host went away."""
        tell = getattr(self.inner, "link_lost", None)
        if tell is not None:
            tell(now_ns)

    def _follow_port(self, faults: Mapping[str, Fault]) -> None:
        self.plugged = "unplug" not in faults
        self.port_suffix = str(round(faults["rename"].value)) if "rename" in faults else ""
        self.port_busy = "busy" in faults
        self.port_denied = "no_permission" in faults

    def _is_dark(self, faults: Mapping[str, Fault], now_ns: int) -> bool:
        """Whether the device has no supply or still boots; switches it on when that ends."""
        off = "power_cycle" in faults or "slow_boot" in faults
        if self._dark_until_ns is not None:
            off = off or now_ns < self._dark_until_ns
        if off:
            self._backlog.clear()
            self._late.clear()
        elif self._was_off:
            self._dark_until_ns = None
            _switch_on(self.inner, now_ns)
        self._was_off = off
        return off

    def _browning(self, out: bytes, faults: Mapping[str, Fault], now_ns: int) -> bytes:
        """Once a fault: half of a message, then darkness."""
        fault = faults.get("brown_out")
        if fault is None or len(out) < 2 or any(fault is done for done in self._browned):
            return out
        self._browned.append(fault)
        self._dark_until_ns = now_ns + round(fault.value * SECOND_NS)
        return out[: len(out) // 2]

    def _spoiled(self, out: bytes, faults: Mapping[str, Fault], elapsed_ns: int) -> bytes:
        if "wrong_baud" in faults:
            return self._random.integers(0, 256, len(out), dtype=np.uint8).tobytes()
        if out and not faults.keys().isdisjoint(("drop", "flip", "add")):
            out = self._mangled(np.frombuffer(out, np.uint8), faults)
        if (flood := faults.get("flood")) is not None:
            count = min(4096, int(self._random.poisson(flood.value * elapsed_ns / SECOND_NS)))
            out += self._random.integers(0, 256, count, dtype=np.uint8).tobytes()
        return out

    def _mangled(self, data: NDArray[np.uint8], faults: Mapping[str, Fault]) -> bytes:
        if (drop := faults.get("drop")) is not None:
            data = data[self._random.random(len(data)) >= drop.value]
        if (flip := faults.get("flip")) is not None:
            bits = (1 << self._random.integers(0, 8, len(data))).astype(np.uint8)
            data = np.where(self._random.random(len(data)) < flip.value, data ^ bits, data)
        if (add := faults.get("add")) is not None:
            places = np.flatnonzero(self._random.random(len(data)) < add.value) + 1
            data = np.insert(data, places, self._random.integers(0, 256, len(places), dtype=np.uint8))
        return data.tobytes()

    def _paced(self, out: bytes, faults: Mapping[str, Fault], now_ns: int, elapsed_ns: int) -> bytes:
        """Hold back, cut up or delay what is to arrive."""
        if (delay := faults.get("delay")) is not None:
            self._late.append((now_ns + round(delay.value * SECOND_NS), out))
            out = b""
        while self._late and self._late[0][0] <= now_ns:
            out += self._late.pop(0)[1]
        self._backlog += out
        del self._backlog[:-BACKLOG_LIMIT]
        count = len(self._backlog)
        if "stall" in faults:
            count = 0
        elif (bursts := faults.get("bursts")) is not None:
            if now_ns - self._released_ns < bursts.value * SECOND_NS:
                count = 0
            else:
                self._released_ns = now_ns
        elif (single := faults.get("single_bytes")) is not None:
            count = 1 if elapsed_ns * single.value >= SECOND_NS else 0
            count = max(count, min(len(self._backlog), int(elapsed_ns * single.value // SECOND_NS)))
        elif (short := faults.get("short_reads")) is not None:
            count = int(self._random.integers(1, round(short.value) + 1))
        released = bytes(self._backlog[:count])
        del self._backlog[:count]
        return released


class FaultyNode:
    """A CAN node seen through its faults."""

    def __init__(self, node: CanDevice, plan: FaultPlan, target: str) -> None:
        self.inner = node
        self._plan = plan
        self._target = target
        self._knobs = _Knobs(node, plan, target)
        self._random = plan.random(target)
        self._now_ns: int | None = None
        self._was_off = False
        self._dark_until_ns: int | None = None
        self._browned: list[Fault] = []
        self._held: list[tuple[int, Frame]] = []

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """Step the node and carry out what its faults do to its frames."""
        self._plan.begin(now_ns)
        faults, inward = _by_direction(self._knobs.follow(now_ns))
        elapsed_ns = 0 if self._now_ns is None else now_ns - self._now_ns
        self._now_ns = now_ns
        if inward:
            received = [copy for frame in received for copy in self._mangled(frame, inward)]
        if self._is_dark(faults, now_ns):
            return []
        cut = "unplug" in faults
        out = self._knobs.frames + self.inner.step(now_ns, () if cut else received)
        self._knobs.frames = []
        out = self._browning(out, faults, now_ns)
        if cut or "silence" in faults:
            self._held.clear()
            return []
        out = [copy for frame in out for copy in self._mangled(frame, faults)]
        if (flood := faults.get("flood")) is not None:
            out += [Frame(0x7EF, self._random.bytes(8))] * min(200, int(flood.value * elapsed_ns / SECOND_NS))
        return self._timed(out, faults, now_ns)

    def power_on(self, now_ns: int) -> None:
        """The supply of the whole bus came back."""
        self._held.clear()
        _switch_on(self.inner, now_ns)

    @property
    def next_ns(self) -> int | None:
        """When the node, the next change of its faults, or held-back frames want to be served."""
        now_ns = self._now_ns or 0
        due = [self._plan.next_change_ns(self._target, now_ns), self._dark_until_ns, self._knobs.next_ns]
        if not self._was_off:
            due.append(getattr(self.inner, "next_ns", now_ns + STEP_NS))
        due += [max(at_ns, now_ns + STEP_NS) for at_ns, _ in self._held[:1]]
        if self._plan.active(self._target, "flood", now_ns):
            due.append(now_ns + STEP_NS)
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def _is_dark(self, faults: Mapping[str, Fault], now_ns: int) -> bool:
        off = "power_cycle" in faults or "slow_boot" in faults
        if self._dark_until_ns is not None:
            off = off or now_ns < self._dark_until_ns
        if off:
            self._held.clear()
        elif self._was_off:
            self._dark_until_ns = None
            _switch_on(self.inner, now_ns)
        self._was_off = off
        return off

    def _browning(self, out: list[Frame], faults: Mapping[str, Fault], now_ns: int) -> list[Frame]:
        fault = faults.get("brown_out")
        if fault is None or not out or any(fault is done for done in self._browned):
            return out
        self._browned.append(fault)
        self._dark_until_ns = now_ns + round(fault.value * SECOND_NS)
        return out[: len(out) // 2]

    def _mangled(self, frame: Frame, faults: Mapping[str, Fault]) -> list[Frame]:
        return _mangled_frame(frame, faults, self._random)

    def _timed(self, out: list[Frame], faults: Mapping[str, Fault], now_ns: int) -> list[Frame]:
        delay = faults.get("delay")
        late_ns = round(delay.value * SECOND_NS) if delay is not None else 0
        self._held += [(now_ns + late_ns, frame) for frame in out]
        if "stall" in faults:
            return []
        ready = [frame for at_ns, frame in self._held if at_ns <= now_ns]
        self._held = [item for item in self._held if item[0] > now_ns]
        return ready


class BusTrouble:
    """What befalls a whole bus: a node that floods it or sends under another's id, and a hand on its wires."""

    def __init__(self, bus: CanBus, plan: FaultPlan, target: str) -> None:
        self.is_dark = False
        self._bus = bus
        self._plan = plan
        self._target = target
        self._random = plan.random(target)
        self._now_ns: int | None = None
        self._owed = 0.0
        self._dark_until_ns: int | None = None
        self._browned: list[Fault] = []
        self._held: list[tuple[int, object, Frame]] = []

    # -- between the nodes --------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        """Before the nodes are stepped: plugs, supply and adapters as they are now."""
        self._plan.begin(now_ns)
        faults = self._active(now_ns)
        for adapter in self._bus.adapters.values():
            adapter.plugged = "unplug" not in faults
            adapter.bus_off = adapter.bus_off or "bus_off" in faults
        browned = faults.get("brown_out")
        if browned is not None and not any(browned is done for done in self._browned):
            self._browned.append(browned)
            self._dark_until_ns = now_ns + round(browned.value * SECOND_NS)
        if self._dark_until_ns is not None and now_ns >= self._dark_until_ns:
            self._dark_until_ns = None
        was_dark = self.is_dark
        self.is_dark = self._dark_until_ns is not None or not faults.keys().isdisjoint(("power_cycle", "slow_boot"))
        if self.is_dark:
            self._held.clear()
        elif was_dark:
            for node in self._bus.nodes.values():
                _switch_on(node, now_ns)

    def carried(self, moved: Sequence[tuple[object, Frame]], now_ns: int) -> list[tuple[object, Frame]]:
        """What of these frames (sender, frame) gets across now."""
        faults = self._active(now_ns)
        if not faults.keys().isdisjoint(("unplug", "silence")):
            self._held.clear()
            return []
        delay = faults.get("delay")
        at_ns = now_ns + (0 if delay is None else round(delay.value * SECOND_NS))
        for sender, frame in moved:
            self._held += [(at_ns, sender, copy) for copy in _mangled_frame(frame, faults, self._random)]
        if "stall" in faults:
            return []
        ready = [(sender, frame) for due_ns, sender, frame in self._held if due_ns <= now_ns]
        self._held = [item for item in self._held if item[0] > now_ns]
        return ready

    def _active(self, now_ns: int) -> dict[str, Fault]:
        return {fault.kind: fault for fault in reversed(self._plan.all_active(self._target, now_ns))}

    # -- as a node ----------------------------------------------------------------------------------------------------

    def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
        """What the trouble-maker sends."""
        self._plan.begin(now_ns)
        out: list[Frame] = []
        elapsed_ns = 0 if self._now_ns is None else now_ns - self._now_ns
        self._now_ns = now_ns
        if (flood := self._plan.active(self._target, "flood", now_ns)) is not None:
            self._owed = min(1000.0, self._owed + flood.value * elapsed_ns / SECOND_NS)
            out += [Frame(round(flood.argument("id", 0x7EF)), self._random.bytes(8)) for _ in range(int(self._owed))]
            self._owed -= int(self._owed)
        if (clash := self._plan.active(self._target, "id_clash", now_ns)) is not None:
            theirs = round(clash.argument("id", 0x1A0))
            out += [Frame(theirs, self._random.bytes(len(one.data))) for one in received if one.can_id == theirs]
        return out

    @property
    def next_ns(self) -> int | None:
        """Soon while it floods, else when a fault begins or ends or held-back frames are due."""
        now_ns = self._now_ns or 0
        if self._plan.active(self._target, "flood", now_ns):
            return now_ns + STEP_NS
        due = [self._plan.next_change_ns(self._target, now_ns), self._dark_until_ns]
        due += [max(at_ns, now_ns + STEP_NS) for at_ns, _, _ in self._held[:1]]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)


def _by_direction(faults: Sequence[Fault]) -> tuple[dict[str, Fault], dict[str, Fault]]:
    """The first fault of each kind: of what the device says (and all that have no direction), of what it hears."""
    inward = {fault.kind: fault for fault in reversed(faults) if fault.argument("to_device", 0.0)}
    outward = {fault.kind: fault for fault in reversed(faults) if not fault.argument("to_device", 0.0)}
    return outward, inward


def _mangled_frame(frame: Frame, faults: Mapping[str, Fault], random: np.random.Generator) -> list[Frame]:
    """What becomes of a frame: nothing, itself, with a bit turned, or twice itself."""
    if (drop := faults.get("drop")) is not None and random.random() < drop.value:
        return []
    if (flip := faults.get("flip")) is not None and frame.data and random.random() < flip.value:
        data = bytearray(frame.data)
        data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        frame = Frame(frame.can_id, bytes(data), frame.extended, frame.remote, frame.dlc)
    if (add := faults.get("add")) is not None and random.random() < add.value:
        return [frame, frame]
    return [frame]


class FaultyContact:
    """A switch seen through its faults."""

    def __init__(self, contact: Contact, plan: FaultPlan, target: str) -> None:
        self.inner = contact
        self._knobs = _Knobs(contact, plan, target)
        self._plan = plan

    def is_closed(self, now_ns: int) -> bool:
        """See Contact."""
        self._follow(now_ns)
        return self.inner.is_closed(now_ns)

    def level(self, now_ns: int) -> bool:
        """See Contact."""
        self._follow(now_ns)
        return self.inner.level(now_ns)

    def _follow(self, now_ns: int) -> None:
        self._plan.begin(now_ns)
        self._knobs.follow(now_ns)


def _switch_on(device: object, now_ns: int) -> None:
    """The supply comes back."""
    power_on = getattr(device, "power_on", None)
    if power_on is not None:
        power_on(now_ns)
