"""Slamtec RPLIDAR A1, A2 and A3 lasers. Bytes in, scans out. Pure.

    bring-up   stop, let the rest run out -> info (twice the same) -> health; with an error: reset, again
               -> motor (A2 and later; the A1's hangs on the port's DTR line) -> modes, or sample rates on firmware
               before 1.24 -> legacy express scan, else standard scan
    then       a scan per turn
    after      silence, nonsense: from the beginning

Ultra and dense capsules (A3, later A2) are not read: their scanners are asked for a mode with legacy capsules or nodes.
Angles grow clockwise: bearing = -angle. Every sample's time follows from the sample period and the earliest arrival in
its turn. Messages: rplidar_messages.py; quirks: docs/devices/rplidar.md.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.conversation import SetBaudRate
from drivers.readings import F64, Identity, LinkState, Reading
from drivers.rplidar_messages import (
    ANSWER_TYPE,
    BOARD,
    CAPSULES,
    CONFIG,
    GET_BOARD,
    GET_HEALTH,
    GET_INFO,
    GET_RATES,
    HEALTH,
    INFO,
    MAX_DISTANCE,
    MODE_COUNT,
    NODES,
    RATES,
    RESET,
    SCAN,
    STOP,
    TYPICAL_MODE,
    US_PER_SAMPLE,
    Answer,
    AnswerReader,
    Block,
    DeviceInfo,
    config_value,
    decode_info,
    express_scan,
    get_config,
    motor_pwm,
)
from drivers.rplidar_messages import SAMPLES as CAPSULE_SAMPLES
from drivers.scripted import ScriptedConversation, Step, pause
from drivers.turns import Limits, NoEcho, Samples, TurnAssembler

_MS = 1_000_000
SPEEDS = (115200, 256000)
REPLY_NS = 300 * _MS
DRAIN_NS = 100 * _MS  # what was on its way when stop was sent
RESET_NS = 2_000 * _MS
STREAM_NS = 1_000 * _MS
CONFIG_SINCE = (1, 24)  # firmware that knows modes
EXPRESS_SINCE = (1, 17)
DEFAULT_PWM = 660
STANDARD_US, EXPRESS_US = 500.0, 250.0
RANGE_MIN_M = 0.15
_BEFORE_LAST: F64 = np.arange(CAPSULE_SAMPLES, dtype=np.float64)[::-1].copy()
_RANGE_MAX_M = {1: 12.0, 2: 16.0, 3: 25.0}  # by model family

ScanMode = Literal["auto", "standard", "express"]
_Message = Answer | Block
_Script = Generator[Step[_Message], _Message | None, bool]


@dataclass(frozen=True, slots=True)
class _Mode:
    """A scan mode. number: in the device's list, None for the standard scan.  max_m: 0 if unknown."""

    number: int | None
    us_per_sample: float
    max_m: float = 0.0


class RplidarConversation(ScriptedConversation[_Message]):
    """A `Conversation[bytes]` with an RPLIDAR. No argument is needed.

    baud: only this line speed (default: 115200 and 256000 in turn).  scan_mode: "auto" is express where there is one.
    pwm: motor speed of A2 and later, 0..1023.  range_min_m, range_max_m: default by model.  no_echo: what a distance
    of 0 means.
    """

    def __init__(
        self,
        *,
        baud: int | None = None,
        scan_mode: ScanMode = "auto",
        pwm: int = DEFAULT_PWM,
        range_min_m: float | None = None,
        range_max_m: float | None = None,
        no_echo: NoEcho = "unknown",
    ) -> None:
        if scan_mode not in ("auto", "standard", "express"):
            raise ValueError(f'scan_mode is "auto", "standard" or "express", not {scan_mode!r}')
        if not 0 < pwm <= 1023:
            raise ValueError(f"pwm is 1 to 1023, not {pwm}")
        self._speeds = [baud] if baud else list(SPEEDS)
        self._scan_mode = scan_mode
        self._pwm = pwm
        self._range_min_m = RANGE_MIN_M if range_min_m is None else range_min_m
        self._range_max_m = range_max_m
        self._no_echo: NoEcho = no_echo
        super().__init__()
        self._answers = AnswerReader(self._counters)
        self._turns = TurnAssembler(self._limits(0.0, 0), beam_ns=STANDARD_US * 1e3, counters=self._counters)
        self._forget()

    def _forget(self) -> None:
        self._answers.clear()
        self._turns.restart()
        self._info: DeviceInfo | None = None
        self._motor_by_pwm = False
        self._streams = False
        self._express_fails = False
        self._pace = _Pace(STANDARD_US * 1e3)

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """Stops stream and laser, and the motor where a command can."""
        return [STOP, motor_pwm(0)] if self._motor_by_pwm else [STOP]

    # The script.

    def _life(self) -> Generator[Step[_Message], _Message | None, None]:
        resets = 0
        while True:
            self._period_ns = None
            self._streams = False
            yield from self._find()
            if self._state is LinkState.SILENT:
                self._trouble = None
            self._state = LinkState.STARTING
            if not (yield from self._is_healthy()):
                resets += 1
                yield from self._reset(2_000 * _MS if resets < 3 else 8_000 * _MS)
                continue
            resets = 0
            yield from self._start_motor()
            if (yield from self._start_scan((yield from self._choose_mode()))):
                yield from self._watch()
            else:
                yield pause(500 * _MS)

    def _find(self) -> Generator[Step[_Message], _Message | None, None]:
        """Stop and ask who it is, at each speed in turn, for ever."""
        while True:
            heard_bytes = self._counters.bytes
            for speed in tuple(self._speeds):
                if (yield from self._answers_at(speed)):
                    self._speeds.remove(speed)
                    self._speeds.insert(0, speed)
                    return
            self._state = LinkState.SILENT
            if self._counters.bytes > heard_bytes:
                self._trouble = "sends bytes but does not say who it is: another device, or another line speed"
            else:
                self._trouble = f"does not answer at {', '.join(map(str, self._speeds))} bit/s: check power and cable"

    def _answers_at(self, speed: int) -> _Script:
        self._ns_per_byte = 10e9 / speed
        yield Step((SetBaudRate(speed),))
        before: bytes | None = None
        for _ in range(3):
            yield Step((STOP,), wait_ns=DRAIN_NS)
            self._answers.clear()
            reply = yield _ask(GET_INFO, INFO)
            if not isinstance(reply, Answer):
                if before is None:
                    return False
                continue
            if reply.body == before:  # no sum guards it, so it is asked for twice
                self._note_info(decode_info(reply.body))
                return True
            before = reply.body
            reply = yield _ask(GET_INFO, INFO)
            if isinstance(reply, Answer) and reply.body == before:
                self._note_info(decode_info(reply.body))
                return True
        return False

    def _note_info(self, info: DeviceInfo) -> None:
        self._info = info
        self._identity = Identity(
            vendor="Slamtec",
            model=info.name,
            serial=info.serial,
            firmware=f"{info.firmware[0]}.{info.firmware[1]:02d}",
        )

    def _is_healthy(self) -> _Script:
        self._standing_trouble = None
        reply = yield _ask(GET_HEALTH, HEALTH)
        if not isinstance(reply, Answer):
            return True  # a scan will tell
        status, code = struct.unpack("<BH", reply.body)
        if status == 1:
            self._standing_trouble = f"warns of its health (code {code:04X}h): keep its window and bearing clean"
        if status >= 2:
            self._trouble = f"reports an error (code {code:04X}h) and is reset: if it stays, it needs service"
        return bool(status < 2)

    def _reset(self, wait_ns: int) -> Generator[Step[_Message], _Message | None, None]:
        yield Step((RESET,), wait_ns=wait_ns)
        self._answers.clear()

    def _start_motor(self) -> Generator[Step[_Message], _Message | None, None]:
        """A2 and later turn by command; the accessory board says whether it takes one, where it says anything."""
        assert self._info is not None
        self._motor_by_pwm = False
        if self._info.model >> 4 < 2:
            return
        reply = yield _ask(GET_BOARD, BOARD)
        if isinstance(reply, Answer) and not reply.body[0] & 1:
            return
        self._motor_by_pwm = True
        yield Step((motor_pwm(self._pwm),), wait_ns=10 * _MS)

    def _choose_mode(self) -> Generator[Step[_Message], _Message | None, _Mode]:
        assert self._info is not None
        if self._info.firmware >= CONFIG_SINCE:
            mode = yield from self._mode_from_list()
            if mode is not None:
                return mode
        standard_us, express_us = STANDARD_US, EXPRESS_US
        reply = yield _ask(GET_RATES, RATES)
        if isinstance(reply, Answer):
            told = struct.unpack("<HH", reply.body)
            standard_us, express_us = told[0] or STANDARD_US, told[1] or EXPRESS_US
        if self._wants_express and self._info.firmware >= EXPRESS_SINCE:
            return _Mode(0, express_us)
        return _Mode(None, standard_us)

    @property
    def _wants_express(self) -> bool:
        return self._scan_mode != "standard" and not self._express_fails

    def _mode_from_list(self) -> Generator[Step[_Message], _Message | None, _Mode | None]:
        """The mode that the device calls typical if we can read it, else the fastest we can; None without a list."""
        count = yield from self._ask_config(MODE_COUNT)
        if count is None:
            return None
        typical = yield from self._ask_config(TYPICAL_MODE)
        modes: list[_Mode] = []
        numbers = range(min(count, 16))
        for number in sorted(numbers, key=lambda each: each != typical):
            kind = yield from self._ask_config(ANSWER_TYPE, number)
            if kind not in (NODES, CAPSULES) or (kind == CAPSULES and not self._wants_express):
                continue
            us_per_sample = yield from self._ask_config(US_PER_SAMPLE, number)
            max_m = yield from self._ask_config(MAX_DISTANCE, number)
            default_us = STANDARD_US if kind == NODES else EXPRESS_US
            mode = _Mode(
                None if kind == NODES else number,
                us_per_sample / 256.0 if us_per_sample else default_us,
                max_m / 256.0 if max_m else 0.0,
            )
            if number == typical:
                return mode
            modes.append(mode)
        return min(modes, key=lambda mode: mode.us_per_sample, default=None)

    def _ask_config(self, key: int, mode: int | None = None) -> Generator[Step[_Message], _Message | None, int | None]:
        for _ in range(2):
            reply = yield Step((get_config(key, mode),), _answer(CONFIG), REPLY_NS)
            if isinstance(reply, Answer):
                return config_value(reply.body, key)
        return None

    def _start_scan(self, mode: _Mode) -> _Script:
        assert self._info is not None
        self._turns.restart()
        self._turns.limits = self._limits(mode.max_m, self._info.model)
        self._pace = _Pace(mode.us_per_sample * 1e3)
        self._turns.beam_ns = self._pace.sample_ns
        request = SCAN if mode.number is None else express_scan(mode.number)
        self._streams = True
        self._period_ns = 180.0 * _MS
        reply = yield Step((request,), _answer(NODES, CAPSULES), STREAM_NS)
        if reply is not None:
            return True
        self._streams = False
        self._period_ns = None
        if mode.number is not None:
            self._express_fails = True
        self._trouble = "does not start to scan: check its supply (5 V, 1 A) and that its head turns freely"
        return False

    def _limits(self, max_m: float, model: int) -> Limits:
        by_model = max_m or _RANGE_MAX_M.get(model >> 4, 12.0)
        return Limits(self._range_min_m, by_model if self._range_max_m is None else self._range_max_m, self._no_echo)

    # Answers and samples.

    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[_Message]:
        return self._answers.feed(chunk, stamp_ns)

    def _take(self, message: _Message, stamp_ns: int) -> Iterator[Reading]:
        if isinstance(message, Answer):
            return
        if not self._streams:
            self._counters.drop("leftover_samples", len(message.angle_rad))
            return
        if message.after_gap:
            self._counters.drop("gap")
            self._pace.restart()
            yield from self._turns.cut()
        sample_ns = self._pace.sample_ns
        record = 84 if message.starts is None else 5
        count = len(message.angle_rad)
        arrived_ns = message.arrived_ns - (message.bytes_after + record) * self._ns_per_byte
        if message.starts is None:  # all came with their capsule
            arrived_ns = arrived_ns - sample_ns * _BEFORE_LAST
        self._pace.count(count, message.arrived_ns)
        self._turns.beam_ns = self._pace.sample_ns
        yield from self._turns.add(
            Samples(message.angle_rad, message.distance_m, message.quality, arrived_ns, None, message.starts)
        )
        if self._turns.turn_ns is not None:
            self._period_ns = self._turns.turn_ns


class _Pace:
    """Time from sample to sample: as the device says, unless what comes contradicts it."""

    WINDOW_NS = 2_000 * _MS
    AGREES = 0.04

    def __init__(self, told_ns: float) -> None:
        self._told_ns = told_ns
        self.sample_ns = told_ns
        self.restart()

    def restart(self) -> None:
        """Samples were lost: what was counted so far says nothing."""
        self._since_ns: int | None = None
        self._counted = 0

    def count(self, samples: int, stamp_ns: int) -> None:
        """So many more at this time."""
        if self._since_ns is None:
            self._since_ns = stamp_ns
            return
        self._counted += samples
        if stamp_ns - self._since_ns < self.WINDOW_NS:
            return
        measured_ns = (stamp_ns - self._since_ns) / self._counted
        agrees = abs(measured_ns / self._told_ns - 1.0) <= self.AGREES
        self.sample_ns = self._told_ns if agrees else measured_ns
        self._since_ns, self._counted = stamp_ns, 0


def _ask(request: bytes, kind: int) -> Step[_Message]:
    return Step((request,), _answer(kind), REPLY_NS)


def _answer(*kinds: int) -> Callable[[_Message], bool]:
    return lambda message: isinstance(message, Answer) and message.kind in kinds
