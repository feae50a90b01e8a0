"""SICK LMS2xx lasers on RS-232 or RS-422. Bytes in, scans out. Pure.

    bring-up   stop the stream (20 25) at each speed until it is answered -> type, status
               -> line speed (20 40 / 20 48, answered at the old one) -> configuration (unit, measuring mode)
               -> variant (field and resolution) -> stream (20 24)
    then       B0 telegrams, each checked by CRC and against the variant
    after      power-on telegram, silence, nonsense: from the beginning

Geometry: value i of an F degree field looks i * resolution - F / 2, positive to the left. The mirror turns 75 times a
second and measures whole degrees; finer resolutions take 2 or 4 turns, each a fraction of a degree further on. Beams
are handed out in that order. The scanner has no clock: a scan ends when the first bit of its telegram leaves.
Telegrams: sick_telegrams.py. Source: SICK telegram listing LMS2xx (8007954); quirks: docs/devices/sick_lms2xx.md.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.readings import F64, Identity, LinkState, Reading, ScanReading
from drivers.scripted import ScriptedConversation, Step, pause
from drivers.sick_telegrams import (
    ACK,
    CONFIGURATION,
    CONFIGURED,
    MEASURING_MODES,
    MODE,
    NAK,
    POWER_ON,
    REFUSED,
    STATUS,
    TYPE,
    VALUES,
    VARIANT,
    Telegram,
    TelegramReader,
    Values,
    decode_status,
    decode_type,
    decode_values,
    encode_telegram,
    range_max_m,
    ranges_of,
    trouble_of_status,
)

_MS = 1_000_000
MIRROR_TURN_NS = 1e9 / 75
SPEEDS = {9600: 0x42, 19200: 0x41, 38400: 0x40, 500000: 0x48}
VARIANTS = ((180, 1.0), (180, 0.5), (100, 1.0), (100, 0.5), (100, 0.25))
PROBE_NS = 250 * _MS
REPLY_NS = 400 * _MS
MODE_NS = 3_000 * _MS  # a change of mode may take this long
WRITE_NS = 7_000 * _MS  # writing the configuration
NAK_PAUSE_NS = 40 * _MS  # at least 30 ms between NAK and the next telegram
PASSWORD = b"SICK_LMS"

STOP = encode_telegram(b"\x20\x25")
START = encode_telegram(b"\x20\x24")
ASK_TYPE = encode_telegram(b"\x3a")
ASK_STATUS = encode_telegram(b"\x31")
ASK_CONFIGURATION = encode_telegram(b"\x74")
INSTALLATION = encode_telegram(b"\x20\x00" + PASSWORD)

Unit = Literal["keep", "mm", "cm"]
_Script = Generator[Step[Telegram], Telegram | None, bool]


class SickLms2xxConversation(ScriptedConversation[Telegram]):
    """A `Conversation[bytes]` with a SICK LMS2xx. No argument is needed.

    field_deg, resolution_deg: one of VARIANTS.  baud: the speed to work at (500000 needs RS-422).
    unit: "mm" (8 m) or "cm" (80 m) is written to the scanner if it is set otherwise; "keep" writes nothing.
    """

    def __init__(
        self, *, field_deg: int = 180, resolution_deg: float = 0.5, baud: int = 38400, unit: Unit = "keep"
    ) -> None:
        if (field_deg, resolution_deg) not in VARIANTS:
            raise ValueError(f"a field of {field_deg} deg in steps of {resolution_deg} deg: choose one of {VARIANTS}")
        if baud not in SPEEDS:
            raise ValueError(f"baud is one of {', '.join(map(str, SPEEDS))}, not {baud}")
        if unit not in ("keep", "mm", "cm"):
            raise ValueError(f'unit is "keep", "mm" or "cm", not {unit!r}')
        self._baud = baud
        self._unit = unit
        self._sweep = _Sweep(field_deg, resolution_deg)
        self._speeds = list(dict.fromkeys((baud, 9600, 38400, 19200, *([500000] if baud == 500000 else []))))
        super().__init__()
        self._replies = TelegramReader(self._counters)
        self._forget()

    def _forget(self) -> None:
        self._replies.clear()
        self._speed = self._speeds[0]
        self._mode = MEASURING_MODES[0]
        self._speed_lost = False  # it did not answer at the speed that was wanted
        self._set_up_trouble: str | None = None  # what set-up could not do, or was told
        self._heard = 0  # signs of an LMS at this speed
        self._newest_ns: int | None = None
        self._pacing = 1.0  # 1: bytes take their time on the wire; 0: telegrams come at once (TCP, pty)

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """Stops the stream; the mirror of these scanners cannot be stopped."""
        return [STOP]

    # The script.

    def _life(self) -> Generator[Step[Telegram], Telegram | None, None]:
        while True:
            self._period_ns = None
            yield from self._find()
            self._trouble = None
            self._state = LinkState.STARTING
            if not (yield from self._bring_up()):
                yield pause(500 * _MS)
                continue
            ended = yield from self._watch(_is(POWER_ON))
            if ended is not None:
                self._state = LinkState.STARTING
                self._trouble = "has started anew: check its power supply (24 V) if this comes again"

    def _bring_up(self) -> _Script:
        return (
            (yield from self._identify())
            and (yield from self._set_speed())
            and (yield from self._configure())
            and (yield from self._choose_variant())
            and (yield from self._start_stream())
        )

    def _find(self) -> Generator[Step[Telegram], Telegram | None, None]:
        """Try the speeds in turn, for ever, until stop is answered."""
        while True:
            heard_bytes = self._counters.bytes
            for speed in tuple(self._speeds):
                if (yield from self._answers_at(speed)):
                    self._speeds.remove(speed)
                    self._speeds.insert(0, speed)  # the first one to try next time
                    return
            self._state = LinkState.SILENT
            if self._counters.bytes > heard_bytes:
                self._trouble = "sends bytes that are no LMS2xx telegrams: is another device on this port?"
            else:
                self._trouble = f"does not answer at {', '.join(map(str, self._speeds))} bit/s: check power and cable"

    def _answers_at(self, speed: int) -> _Script:
        self._speed = speed
        self._replies.clear()
        yield Step((SetBaudRate(speed),))
        for _ in range(12):  # for as long as there is a sign of life at this speed
            heard = self._heard
            reply = yield from self._ask(STOP, _is(MODE), PROBE_NS)
            if reply is not None:  # twice: a reply that was held up may come when another speed is tried already
                again = yield from self._ask(ASK_STATUS, _is(STATUS), PROBE_NS)
                if again is None:  # a unit that does not tell its status
                    again = yield from self._ask(STOP, _is(MODE), PROBE_NS)
                if again is not None:
                    return True
            if self._heard == heard:
                return False
        return False

    def _ask(
        self, telegram: bytes, awaits: Callable[[Telegram], bool], wait_ns: int = REPLY_NS
    ) -> Generator[Step[Telegram], Telegram | None, Telegram | None]:
        """Ask until a reply comes; a refused telegram (NAK) is repeated after a pause. None if there is no reply."""
        for _ in range(3):
            reply = yield Step((telegram,), lambda reply: awaits(reply) or reply.command in (NAK, REFUSED), wait_ns)
            if reply is None:
                return None
            if reply.command != NAK:
                return reply
            yield pause(NAK_PAUSE_NS)
        return None

    def _ask_twice(
        self, telegram: bytes, awaits: Callable[[Telegram], bool], wait_ns: int = REPLY_NS
    ) -> Generator[Step[Telegram], Telegram | None, Telegram | None]:
        """As _ask, with a second try after silence."""
        reply = yield from self._ask(telegram, awaits, wait_ns)
        if reply is None:
            reply = yield from self._ask(telegram, awaits, wait_ns)
        return reply

    def _identify(self) -> _Script:
        """Type and status; old units refuse the type, which is no reason to do without them."""
        reply = yield from self._ask_twice(ASK_TYPE, _is(TYPE))
        model, firmware = decode_type(reply.payload) if reply is not None and reply.command == TYPE else ("LMS2xx", "")
        reply = yield from self._ask_twice(ASK_STATUS, _is(STATUS))
        if reply is not None and reply.command == STATUS:
            try:
                status = decode_status(reply.payload)
            except FrameError as error:
                self._counters.drop(error.reason)
            else:
                firmware = firmware or status.software
                if status.defective:
                    self._set_up_trouble = (
                        "says that it is defective: power it off and on; if it stays, it needs service"
                    )
        self._identity = Identity(vendor="SICK", model=model, firmware=firmware)
        return True

    def _set_speed(self) -> _Script:
        """Answered at the old speed, then both change; a line that does not carry it is left at what it carries."""
        if self._speed == self._baud or self._speed_lost:
            return True
        reply = yield from self._ask_twice(_mode(SPEEDS[self._baud]), _is(MODE), MODE_NS)
        if reply is None or reply.command != MODE or reply.payload[1] != 0:
            self._set_up_trouble = f"refuses {self._baud} bit/s and stays at {self._speed}: scans are fewer"
            self._speed_lost = True
            return True
        yield Step((SetBaudRate(self._baud),), wait_ns=20 * _MS)
        if (yield from self._answers_at(self._baud)):
            self._speeds.remove(self._baud)
            self._speeds.insert(0, self._baud)
            return True
        self._speed_lost = True
        self._set_up_trouble = f"does not answer at {self._baud} bit/s: check the cable, or set a lower baud"
        return False

    def _configure(self) -> _Script:
        """Learn the measuring mode; set the unit if one is wanted and it is another."""
        reply = yield from self._ask_twice(ASK_CONFIGURATION, _is(CONFIGURATION))
        if reply is None or reply.command != CONFIGURATION:
            return self._unit == "keep" or self._fail("does not tell its configuration, so the unit cannot be set")
        data = reply.payload[1:-1]
        mode = MEASURING_MODES.get(data[5])
        if mode is None:
            return self._fail(f"is set to measuring mode {data[5]:02X}h, which gives no distances: set another")
        self._mode = mode
        wanted = {"keep": data[6], "cm": 0, "mm": 1}[self._unit]
        if wanted == data[6]:
            return True
        return (yield from self._write_configuration(data[:6] + bytes([wanted]) + data[7:]))

    def _write_configuration(self, data: bytes) -> _Script:
        entered = yield from self._ask_twice(INSTALLATION, _is(MODE), MODE_NS)
        if entered is None or entered.command != MODE or entered.payload[1] != 0:
            return self._fail("refuses the password of the installation mode: set unit to keep")
        written = yield from self._ask(encode_telegram(b"\x77" + data), _is(CONFIGURED), WRITE_NS)
        left = yield from self._ask_twice(STOP, _is(MODE), MODE_NS)
        if written is None or written.command != CONFIGURED or written.payload[1] != 1:
            return self._fail("refuses the configuration: set unit to keep")
        return left is not None

    def _choose_variant(self) -> _Script:
        field_deg, step_cdeg = self._sweep.field_deg, round(100 * self._sweep.resolution_deg)
        wanted = struct.pack("<HH", field_deg, step_cdeg)
        reply = yield from self._ask_twice(encode_telegram(b"\x3b" + wanted), _is(VARIANT), MODE_NS)
        if reply is None:  # scans of another field have another count of values, and are dropped
            self._set_up_trouble = "does not answer the choice of field and resolution; scans are taken as they come"
            return True
        if reply.command != VARIANT or reply.payload[1] != 1 or reply.payload[2:6] != wanted:
            return self._fail(
                f"refuses a field of {field_deg} deg in steps of {self._sweep.resolution_deg} deg: "
                "choose other field_deg and resolution_deg"
            )
        return True

    def _start_stream(self) -> _Script:
        # Values may follow the reply in the same chunk, so they are expected from here on.
        self._newest_ns = None
        self._period_ns = self._sweep.period_ns(self._ns_per_byte)
        reply = yield from self._ask_twice(START, _is(MODE, VALUES), MODE_NS)
        if reply is not None and (reply.command == VALUES or (reply.command == MODE and reply.payload[1] == 0)):
            return True
        self._period_ns = None
        return self._fail("refuses to send scans (20 24)")

    def _fail(self, trouble: str) -> bool:
        self._trouble = trouble
        return False

    # Telegrams and scans.

    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[Telegram]:
        telegrams = self._replies.feed(chunk, stamp_ns)
        self._heard += sum(each.size > 1 for each in telegrams) + (chunk == bytes([ACK]))
        return telegrams

    def _take(self, telegram: Telegram, stamp_ns: int) -> Iterator[Reading]:
        if telegram.command in (ACK, NAK):
            return
        self._standing_trouble = trouble_of_status(telegram.status) or self._set_up_trouble
        if telegram.command != VALUES:
            return
        if self._period_ns is None:
            self._counters.drop("leftover_scan")
            return
        try:
            values = decode_values(telegram.payload)
        except FrameError as error:
            self._counters.drop(error.reason)
            return
        part = self._sweep.part(values.partial, len(values.words))
        if part is None:
            self._counters.drop("bad_count")
            return
        yield self._reading(telegram, values, part)

    def _reading(self, telegram: Telegram, values: Values, part: _Part) -> ScanReading:
        first_ns = self._sent_ns(telegram) - round(part.sweep_ns)
        if self._newest_ns is not None:
            first_ns = max(first_ns, self._newest_ns + 1)
        self._newest_ns = first_ns
        assert self._period_ns is not None
        return ScanReading(
            stamp_ns=first_ns,
            beam_period_ns=part.sweep_ns / max(len(part.bearing_rad) - 1, 1),
            scan_period_ns=round(self._period_ns),
            bearing_rad=part.bearing_rad,
            range_m=ranges_of(values, self._mode)[part.order],
            range_min_m=0.0,
            range_max_m=range_max_m(values.unit_mm, self._mode),
        )

    @property
    def _ns_per_byte(self) -> float:
        return 10e9 / self._speed

    def _sent_ns(self, telegram: Telegram) -> int:
        """When the telegram's first bit left: its own time on the wire taken off, where the wire takes time."""
        wire_ns = telegram.size * self._ns_per_byte
        trickled = telegram.arrived_ns - telegram.began_ns >= 0.4 * wire_ns
        self._pacing += 0.2 * (trickled - self._pacing)
        if self._pacing < 0.5:
            return telegram.began_ns
        return telegram.arrived_ns - round(wire_ns + telegram.bytes_after * self._ns_per_byte)


@dataclass(frozen=True, slots=True)
class _Part:
    """Beams of one telegram in the order they were measured. order: their places in it.  sweep_ns: first to last."""

    bearing_rad: F64
    order: slice | NDArray[np.intp]
    sweep_ns: float


class _Sweep:
    """One variant: where its values look, and when."""

    def __init__(self, field_deg: int, resolution_deg: float) -> None:
        self.field_deg = field_deg
        self.resolution_deg = resolution_deg
        self.turns = round(1.0 / resolution_deg)  # of the mirror, for a whole scan
        self.values = field_deg * self.turns + 1
        index = np.arange(self.values)
        bearing = np.radians(index * resolution_deg - field_deg / 2)
        turn_of_value = index % self.turns
        order = np.lexsort((index, turn_of_value))
        whole_ns = MIRROR_TURN_NS * (self.turns - 1 + order[-1] * resolution_deg / 360.0)
        self._whole = _Part(_frozen(bearing[order]), order, whole_ns)
        self._parts = [
            _Part(
                _frozen(bearing[turn :: self.turns]),
                slice(None),
                MIRROR_TURN_NS * (len(index[turn :: self.turns]) - 1) / 360,
            )
            for turn in range(self.turns)
        ]

    def part(self, partial: int | None, values: int) -> _Part | None:
        """The beams of a telegram, or None if its count of values is not this variant's."""
        if partial is None:
            return self._whole if values == self.values else None
        if partial >= self.turns or values != len(self._parts[partial].bearing_rad):
            return None
        return self._parts[partial]

    def period_ns(self, ns_per_byte: float) -> float:
        """From scan to scan: what the mirror needs, or the line; whichever is longer."""
        return max(self.turns * MIRROR_TURN_NS, (2 * self.values + 10) * ns_per_byte)


def _frozen(values: F64) -> F64:
    values = np.array(values, dtype=np.float64)
    values.setflags(write=False)
    return values


def _mode(number: int) -> bytes:
    return encode_telegram(bytes([0x20, number]))


def _is(*commands: int) -> Callable[[Telegram], bool]:
    return lambda telegram: telegram.command in commands
