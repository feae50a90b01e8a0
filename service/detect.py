"""Which device answers on which serial port, and at which line speed: asked by questions that set nothing in motion.

Each probe is one question that reads (a version, a status, a count) or mere listening, and a check of what comes back
by the driver's own messages with their sums. Probes that ask are tried after it was listened: who sends by itself needs
no question. Speeds are tried one after the other, ports side by side: about 12 s, however many there are.

Not asked: anything that starts a motor, a laser or a stream, resets a count, or writes a setting. What must be said
to an RPLIDAR that was left scanning is "stop": it answers nothing else before.
"""

from __future__ import annotations

import glob
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Protocol

from drivers.errors import FrameError, PortAbsent, PortError
from drivers.ports import Clock, SerialPort
from drivers.readings import Identity, SourceCounters

log = logging.getLogger(__name__)

Recognise = Callable[[bytes], Identity | None]
"""Who sent these bytes, everything since the question; None if it cannot be told (yet)."""


@dataclass(frozen=True, slots=True)
class Probe:
    """driver: its name in the configuration.  ask: the question, empty to listen.  wait_s: for the answer."""

    driver: str
    section: str
    speeds: tuple[int, ...]
    ask: tuple[bytes, ...]
    recognise: Recognise
    wait_s: float = 0.3


@dataclass(frozen=True, slots=True)
class Detected:
    """One port and who answered there. driver: empty if nobody did.  trouble: why it could not be asked."""

    port: str
    stable_name: str
    driver: str = ""
    section: str = ""
    speed_bps: int = 0
    identity: Identity | None = None
    trouble: str = ""

    def document(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)

    @property
    def best_name(self) -> str:
        """What to write as `port`: the name that stays, if there is one."""
        return self.stable_name or self.port


class Line(Protocol):
    """What is needed of a serial port."""

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]: ...

    def write(self, item: bytes) -> None: ...

    def set_baud(self, bits_per_s: int) -> None: ...

    def discard_input(self) -> None: ...

    def close(self) -> None: ...


# --- who is it? -----------------------------------------------------------------------------------------------------


def _hokuyo(data: bytes) -> Identity | None:
    from drivers.scip import ScipReplies, text_fields

    for reply in ScipReplies().feed(data[max(data.find(b"VV"), 0) :], 0):
        if reply.echo.startswith(b"VV") and reply.status in ("00", "0"):
            try:
                fields = text_fields(reply)
            except FrameError:
                continue
            return _hokuyo_named(fields)
    old = re.search(rb"V\n0\n((?:[A-Z]{4}:[^\n]*\n)*SERI:[^\n]*\n)", data)  # SCIP 1.1: without sums
    if old is None:
        return None
    return _hokuyo_named(dict(line.split(":", 1) for line in old[1].decode("ascii", "replace").splitlines()))


def _hokuyo_named(fields: dict[str, str]) -> Identity:
    from drivers.scip import model_name

    model = model_name(fields.get("PROD", ""))
    return Identity(fields.get("VEND", ""), model, fields.get("SERI", ""), fields.get("FIRM", ""))


def _rplidar(data: bytes) -> Identity | None:
    from drivers.rplidar_messages import INFO, Answer, AnswerReader, decode_info

    start = data.find(b"\xa5\x5a\x14\0\0\0")
    for answer in AnswerReader().feed(data[start:], 0) if start >= 0 else ():
        if isinstance(answer, Answer) and answer.kind == INFO and len(answer.body) == 20:
            info = decode_info(answer.body)
            if info.model and info.hardware < 0x40:
                firmware = f"{info.firmware[0]}.{info.firmware[1]:02d}"
                return Identity("Slamtec", info.name, info.serial, firmware)
    return None


def _ldrobot(data: bytes) -> Identity | None:
    from drivers.laser_ldrobot import PacketReader

    return Identity("LDROBOT", "LD06/LD19") if len(PacketReader().feed(data, 0)) >= 2 else None


def _sick(data: bytes) -> Identity | None:
    from drivers.sick_telegrams import TelegramReader, decode_type

    for telegram in TelegramReader(SourceCounters()).feed(data, 0):
        if telegram.payload[:1] in (b"\xba", b"\x90"):
            model, firmware = decode_type(telegram.payload)
            return Identity("SICK", model, "", firmware)
        if telegram.payload[:1] == b"\xb0" and telegram.size > 100:
            return Identity("SICK", "LMS2xx")  # left streaming
    return None


def _usboard(data: bytes) -> Identity | None:
    from drivers.usboard_messages import CONNECT_ANSWER, encode_serial_frame

    return Identity("Neobotix", "USBoard") if encode_serial_frame(CONNECT_ANSWER) in data else None


def _maxbotix(data: bytes) -> Identity | None:
    lines = data.split(b"\r")[1:-1]  # the first and the last may be torn
    good = [line for line in lines if re.fullmatch(rb"R\d{3,5} ?", line)]
    if len(good) < 2 or len(good) < 0.8 * len(lines):
        return None
    return Identity("MaxBotix", f"{len(good[-1].strip()) - 1} digits")


def _arduino(data: bytes) -> Identity | None:
    """The answer to `b` is a line speed; whatever was not understood before it is Invalid Command."""
    from drivers.encoder_arduino_bridge import INVALID_COMMAND

    lines = [line for line in data.decode("ascii", "replace").split("\r\n")[:-1] if line != INVALID_COMMAND]
    if len(lines) >= 1 and re.fullmatch(r"\d{4,7}", lines[-1]) and int(lines[-1]) in _USUAL_SPEEDS:
        return Identity(model="ros_arduino_bridge", firmware=f"{lines[-1]} bit/s")
    return None


def _roboclaw(data: bytes) -> Identity | None:
    from drivers.encoder_roboclaw import Command, decode_answer, decode_version

    try:
        text = decode_version(decode_answer(0x80, Command.VERSION, data))
    except FrameError:
        return None
    model, _, firmware = text.rpartition(" ")
    return Identity("Basicmicro", model, "", firmware)


def _mavlink(data: bytes) -> Identity | None:
    from drivers.mavlink_frames import Frames

    for message, _ in Frames(SourceCounters()).feed(data):
        return Identity(model=f"MAVLink system {message.system}")
    return None


def _slcan(data: bytes) -> Identity | None:
    match = re.search(rb"(?:^|[\r\a])V([0-9A-Fa-f]{4})\r", data)
    return Identity(model="slcan adapter", firmware=match[1].decode()) if match else None


_USUAL_SPEEDS = frozenset((1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200, 230400, 250000, 500000))

PROBES = (
    Probe("ldrobot", "lasers", (230400,), (), _ldrobot),
    Probe("maxbotix", "sonars", (9600, 57600), (), _maxbotix, 0.9),
    Probe("mavlink", "wheels", (57600, 115200), (), _mavlink, 1.1),
    Probe("hokuyo", "lasers", (115200, 19200, 57600, 38400), (b"VV\nV\n",), _hokuyo),
    Probe("sick_lms2xx", "lasers", (9600, 38400, 19200, 500000), (bytes.fromhex("020001003a1e12"),), _sick, 0.5),
    Probe("rplidar", "lasers", (115200, 256000), (b"\xa5\x25", b"\xa5\x50"), _rplidar),
    Probe("usboard-serial", "sonars", (19200,), (bytes(8),), _usboard),
    Probe("roboclaw", "wheels", (38400, 115200), (b"\x80\x15",), _roboclaw, 0.2),
    Probe("slcan", "can", (115200,), (b"\rV\r",), _slcan, 0.2),
    Probe("arduino-bridge", "wheels", (57600, 115200), (b"\rb\r",), _arduino),
)
"""Every device on a serial line. Listeners stand first."""

_SPEEDS = (115200, 57600, 230400, 19200, 9600, 38400, 256000, 500000)
_BETWEEN_S = 0.02  # a RoboClaw forgets what is not for it after 10 ms
_BOOT_S = 1.7  # boards that were reset by our opening the port


# --- asking ---------------------------------------------------------------------------------------------------------


def identify(
    line: Line, *, now_ns: Clock, probes: Sequence[Probe] | None = None, boot_s: float = 0.0
) -> tuple[Probe, int, Identity] | None:
    """Who is on this line: probe, speed, identity; None if nobody answers. PortError if the line is lost.

    boot_s: how long a board that is reset by opening the port may need; it is asked once more after that.
    """
    wanted = PROBES if probes is None else probes
    began_ns = now_ns()
    found = _at_every_speed(line, wanted, now_ns)
    if found is not None or boot_s <= 0.0:
        return found
    left_s = boot_s - (now_ns() - began_ns) / 1e9
    if left_s > 0.0:
        _listen(line, lambda _: None, left_s, now_ns)
        return _at_every_speed(line, [probe for probe in wanted if probe.driver == "arduino-bridge"], now_ns)
    return None


def _at_every_speed(line: Line, probes: Sequence[Probe], now_ns: Clock) -> tuple[Probe, int, Identity] | None:
    for speed in _SPEEDS:
        here = [probe for probe in probes if speed in probe.speeds]
        if not here:
            continue
        line.set_baud(speed)
        line.discard_input()
        found = _listeners(line, [probe for probe in here if not probe.ask], now_ns) or _askers(
            line, [probe for probe in here if probe.ask], now_ns
        )
        if found is not None:
            return found[0], speed, found[1]
    return None


def _listeners(line: Line, probes: Sequence[Probe], now_ns: Clock) -> tuple[Probe, Identity] | None:
    if not probes:
        return None
    hit: list[tuple[Probe, Identity]] = []

    def recognise(data: bytes) -> Identity | None:
        for probe in probes:
            if (identity := probe.recognise(data)) is not None:
                hit.append((probe, identity))
                return identity
        return None

    _listen(line, recognise, max(probe.wait_s for probe in probes), now_ns)
    return hit[0] if hit else None


def _askers(line: Line, probes: Sequence[Probe], now_ns: Clock) -> tuple[Probe, Identity] | None:
    for probe in probes:
        line.discard_input()
        for question in probe.ask:
            line.write(question)
            if question is not probe.ask[-1]:
                _listen(line, lambda _: None, _BETWEEN_S, now_ns)
                line.discard_input()
        identity = _listen(line, probe.recognise, probe.wait_s, now_ns)
        if identity is not None:
            return probe, identity
        _listen(line, lambda _: None, _BETWEEN_S, now_ns)
    return None


def _listen(line: Line, recognise: Recognise, seconds: float, now_ns: Clock) -> Identity | None:
    data = bytearray()
    end_ns = now_ns() + round(seconds * 1e9)
    while (left_ns := end_ns - now_ns()) > 0:
        for chunk, _ in line.read(left_ns / 1e9):
            data += chunk
            if len(data) > 20_000:
                del data[:-10_000]
        if data and (identity := recognise(bytes(data))) is not None:
            return identity
    return None


def detect(ports: Iterable[tuple[str, str]], *, now_ns: Clock = time.monotonic_ns) -> list[Detected]:
    """Ask on every port at the same time. ports: (name, name that stays or empty)."""
    asked = list(ports)
    with ThreadPoolExecutor(max_workers=max(1, min(len(asked), 16))) as pool:
        return list(pool.map(lambda port: _detect_one(port[0], port[1], now_ns), asked))


def _detect_one(port: str, stable_name: str, now_ns: Clock) -> Detected:
    try:
        line = SerialPort(port, clock=now_ns)
    except PortError as error:
        return Detected(port, stable_name, trouble=str(error))
    try:
        found = identify(line, now_ns=now_ns, boot_s=_BOOT_S)
    except PortError as error:
        return Detected(port, stable_name, trouble=str(error))
    finally:
        line.close()
    if found is None:
        return Detected(port, stable_name)
    probe, speed, identity = found
    return Detected(port, stable_name, probe.driver, probe.section, speed, identity)


# --- by serial number -----------------------------------------------------------------------------------------------

_SEARCHING = threading.Lock()  # two wires that look for their devices must not ask on the same port at once


def find_by_serial(serial: str, *, driver: str, search: Sequence[str], now_ns: Clock, patience_s: float = 1.0) -> str:
    """The port behind which a device has this serial number. PortAbsent if there is none now.

    First by what the system knows of USB devices, then by asking the devices with the driver's question. search:
    patterns of port names. A port that another reader has open is passed over: its device has been found.
    """
    from serial.tools import list_ports

    if not _SEARCHING.acquire(timeout=patience_s):
        raise PortAbsent(
            f"the device with serial number {serial} is looked for in a moment: another search is under way"
        )
    try:
        candidates = ports_like(search)
        usb = {os.path.realpath(port.device): port.serial_number for port in list_ports.comports()}
        for port in candidates:
            if usb.get(os.path.realpath(port)) == serial:
                return port
        probes = [probe for probe in PROBES if probe.driver == driver]
        deadline_ns = now_ns() + round(patience_s * 1e9)
        for port in candidates:
            if not _is_another(port, serial) and _serial_on(port, probes, deadline_ns, now_ns) == serial:
                return port
    finally:
        _SEARCHING.release()
    where = ", ".join(candidates) or f"no port like {', '.join(search)} is there"
    raise PortAbsent(
        f"no device with serial number {serial} answers ({where}): is it plugged in and powered? "
        "`umfeld devices detect` shows who is there"
    )


def ports_like(search: Sequence[str]) -> list[str]:
    """What matches any of the patterns, each port once, under the first name found. Files and folders are none."""
    found: dict[str, str] = {}
    for pattern in search:
        for name in sorted(glob.glob(pattern)):
            if not os.path.isfile(name) and not os.path.isdir(name):
                found.setdefault(os.path.realpath(name), name)
    return list(found.values())


Node = tuple[int, int, int]
_known: dict[str, tuple[Node, str]] = {}
"""Serial numbers that answered, by port, and which device node that was: to pass over what is surely another one."""


def _node_of(port: str) -> Node | None:
    """A device that is plugged in again has a new node, even where its numbers are used again."""
    try:
        about = os.stat(port)
    except OSError:
        return None
    return about.st_rdev, about.st_ino, about.st_ctime_ns


def _is_another(port: str, serial: str) -> bool:
    known = _known.get(port)
    return known is not None and known[0] == _node_of(port) and known[1] != serial


def _serial_on(port: str, probes: Sequence[Probe], deadline_ns: int, now_ns: Clock) -> str | None:
    """The serial number of who answers on a port. After the deadline nobody is asked: the next attempt goes on."""
    node = _node_of(port)
    if node is None or now_ns() > deadline_ns:
        return None
    try:
        line = SerialPort(port, clock=now_ns)
    except PortError:
        return None
    try:
        found = identify(line, now_ns=now_ns, probes=probes)
    except PortError:
        return None
    finally:
        line.close()
    if found is None or not found[2].serial:
        return None
    _known[port] = (node, found[2].serial)
    return found[2].serial
