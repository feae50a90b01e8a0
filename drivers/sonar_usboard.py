"""Neobotix USBoard and USBoard-USS5 ultrasonic chains, on CAN or on a serial line: the conversation.

The four analog inputs may be switches (bumpers, cliff sensors): a line near 0 V is low, one near 5 V high, one between
is not believed.

    CONNECT each 0.25 s until anything comes -> READ_PARASET (identity, what is active, how often it sends)
    -> GET_DATA at the wanted rate, or listening to what the board sends by itself; GET_ANALOGIN for switches

The messages stand in usboard_messages.py. Old boards (hardware version 0) know GET_DATA_1TO8 and GET_DATA_9TO16 only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from drivers.conversation import CanFrame, SetBaudRate, silence_limit
from drivers.errors import FrameError
from drivers.readings import (
    ChainReading,
    ClockFit,
    ContactLine,
    ContactReading,
    ContactState,
    Identity,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    SourceCounters,
)
from drivers.usboard_messages import (
    LEGACY_RESOLUTION_M,
    MESSAGE_SIZE,
    PARAMETER_PARTS,
    SERIAL_HEADER,
    SERIAL_SIZE,
    Command,
    GroupValues,
    SendMode,
    UsBoardParameters,
    check_message,
    decode_analog,
    decode_group,
    decode_parameters,
    decode_part,
    encode_command,
    encode_get_data,
    encode_serial_frame,
    offset_of,
)

_ALL_CHANNELS = tuple(range(1, 17))
Mode = Literal["auto", "request", "listen"]
"""auto: listens if the board sends often enough by itself, else asks. request: asks. listen: never asks for data."""

_CONNECT_PERIOD_NS = 250_000_000
_ANSWER_PATIENCE_NS = 500_000_000  # then it is told that nobody answers
_PARAMETERS_PERIOD_NS = 400_000_000
_PARAMETERS_TRIES = 3  # then it is measured without them
_PARAMETERS_LATER_NS = 5_000_000_000
_LISTEN_PATIENCE_NS = 1_000_000_000
_SETUP_PATIENCE_NS = 2_500_000_000  # the slowest automatic sending is every 2 s
_SLOWEST_LISTENING_S = 0.16  # three intervals must fit in the 500 ms within which silence has to be noticed
_LEGACY_AFTER = 3  # GET_DATA unanswered so often: perhaps an old board
_MISSED_ROUNDS = 2  # so often the others answered without this group
_DEFAULT_FIRE_NS = 20_000_000
_NEVER = 1 << 62
INPUTS = (0, 1, 2, 3)
_NONE: Mapping[int, bool] = MappingProxyType({})
_LOW_V, _HIGH_V = 1.5, 3.5  # the levels of 5 V logic


@dataclass(slots=True)
class _Progress:
    """What is forgotten whenever the wire is opened."""

    connected_ns: int = 0
    overdue: bool = False  # it should have answered by now
    answered: bool = False
    heard_ns: int = 0
    running: bool = False
    parameters: UsBoardParameters | None = None
    parts: dict[int, bytes] = field(default_factory=dict)
    parameters_asked: int = 0
    legacy: bool = False
    distrust_sending: bool = False  # the parameters say that it sends, but nothing comes
    unanswered: int = 0
    measuring_since_ns: int = 0
    connect_due_ns: int = 0
    parameters_due_ns: int = 0
    request_due_ns: int = 0
    analog_due_ns: int = 0
    analog_heard: bool = False
    group_seen_ns: dict[int, int] = field(default_factory=dict)
    frames_since: dict[int, int] = field(default_factory=dict)  # of other groups, since this one was heard
    silent_groups: set[int] = field(default_factory=set)
    unconnected: set[int] = field(default_factory=set)


class _Board:
    """The message layer: 8-byte messages in and out, the same on CAN and on the serial line."""

    def __init__(
        self,
        *,
        channels: Sequence[int] | None,
        rate_hz: float | None,
        mode: Mode,
        range_max_m: float,
        analog_rate_hz: float,
        switches: Mapping[int, bool],
        measures: bool,
        sends_itself: tuple[SendMode, ...],
        wire_time_ns: int,
        slowest_period_ns: int,
        silent_hint: str,
    ) -> None:
        self.channels = tuple(sorted(set(channels))) if channels is not None else _ALL_CHANNELS
        if not self.channels or not set(self.channels) <= set(_ALL_CHANNELS):
            raise ValueError(f"channels {channels}: a USBoard has channels 1 to 16")
        if rate_hz is not None and not 0.0 < rate_hz <= 100.0:
            raise ValueError(f"rate_hz {rate_hz}: above 0, up to 100, or None for as fast as it fires")
        if not set(switches) <= set(INPUTS):
            raise ValueError(f"inputs {sorted(switches)}: a USBoard has inputs 0 to 3")
        self._all_wanted = channels is None
        self._measures = measures
        self._groups = sorted({(channel - 1) // 4 for channel in self.channels}) if measures else []
        self._active_low = dict(switches)
        self._rate_hz = rate_hz
        self._mode = mode
        self._range_max_m = range_max_m
        self._analog_period_ns = round(1e9 / analog_rate_hz) if analog_rate_hz > 0 else 0
        self._sends_itself = sends_itself
        self._wire_time_ns = wire_time_ns
        self._slowest_period_ns = slowest_period_ns
        self._silent_hint = silent_hint
        self._now = _Progress()
        self._last_stamp_ns = self._last_contact_ns = -(1 << 62)
        self.counters = SourceCounters()
        self.identity: Identity | None = None
        self.analog_v: tuple[float, ...] | None = None

    @property
    def state(self) -> LinkState:
        if self._now.running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._now.answered else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        now = self._now
        if not now.answered:
            return self._silent_hint if now.overdue else None
        if now.silent_groups:
            names = ", ".join(f"{4 * group + 1} to {4 * group + 4}" for group in sorted(now.silent_groups))
            return f"no more values of channels {names}: does the board send all groups?"
        if self._mode == "listen" and now.parameters is not None and self._slow_or_mute(now.parameters):
            return (
                "the board does not send all wanted channels by itself often enough: set automatic sending with a "
                "custom interval of 150 ms or less, or let mode be auto"
            )
        if self._all_wanted:
            return None
        if off := [channel for channel in self.channels if not self._is_active(channel)]:
            return f"channels {_list(off)} are switched off on the board: activate them in its parameters (bytes 8, 9)"
        if now.unconnected:
            return f"no transducer on channels {_list(sorted(now.unconnected))}: check the plug, or leave them out"
        return None

    @property
    def silence_limit_ns(self) -> int:
        period_ns = self._period_ns()
        limit_ns = silence_limit(period_ns)
        return max(limit_ns, period_ns * 3 // 2)  # only when told to listen to a board that speaks less often

    @property
    def contact_limit_ns(self) -> int:
        """The same for the switches."""
        return silence_limit(self._analog_period_ns)

    @property
    def contact_trouble(self) -> str | None:
        """What is wrong with the switches."""
        now = self._now
        if not self._active_low or now.parameters is None or now.parameters.analog_inputs or now.analog_heard:
            return None
        return "the board does not tell its inputs: switch the analog inputs on in its parameters (byte 5, bit 2)"

    def connected(self, now_ns: int) -> None:
        self._now = _Progress(connected_ns=now_ns, connect_due_ns=now_ns)

    # ---- out

    def due(self, now_ns: int) -> list[bytes]:
        """The messages to send now."""
        self._give_up_setup(now_ns)
        self._watch_sending(now_ns)
        now = self._now
        if not now.answered:
            now.overdue = now_ns - now.connected_ns > _ANSWER_PATIENCE_NS
            if now_ns < now.connect_due_ns:
                return []
            now.connect_due_ns = now_ns + _CONNECT_PERIOD_NS
            return [encode_command(Command.CONNECT)]
        messages = []
        if now.parameters is None and now_ns >= now.parameters_due_ns:
            messages.append(self._ask_parameters(now_ns))
        if now.parameters is None and now.parameters_asked <= _PARAMETERS_TRIES:
            return messages
        if self._asks() and now_ns >= now.request_due_ns:
            messages += self._ask_data(now_ns)
        if self._analog_period_ns and now_ns >= now.analog_due_ns:
            now.analog_due_ns = now_ns + self._analog_period_ns
            messages.append(encode_command(Command.GET_ANALOGIN))
        return messages

    def next_due_ns(self) -> int:
        """When `due` has something to say next, if nothing arrives before."""
        now = self._now
        if not now.answered:
            return now.connect_due_ns
        if now.parameters is None and now.parameters_asked <= _PARAMETERS_TRIES:
            return now.parameters_due_ns
        due_ns = now.request_due_ns if self._asks() else _NEVER
        return min(due_ns, now.analog_due_ns) if self._analog_period_ns else due_ns

    def _give_up_setup(self, now_ns: int) -> None:
        """It answered once, but no longer: look for it again."""
        now = self._now
        if now.answered and not now.running and now_ns - now.heard_ns > _SETUP_PATIENCE_NS:
            self.connected(now_ns)

    def _watch_sending(self, now_ns: int) -> None:
        """The parameters say that the board sends by itself, but nothing comes: do not believe them."""
        now = self._now
        if now.parameters is None or now.running or not self._measures:
            return
        now.measuring_since_ns = now.measuring_since_ns or now_ns
        if now_ns - now.measuring_since_ns > _LISTEN_PATIENCE_NS:
            now.distrust_sending = True

    def _ask_parameters(self, now_ns: int) -> bytes:
        now = self._now
        now.parameters_asked += 1
        # The last of the first tries waits for its answer too, then the question is put now and then.
        patient = now.parameters_asked > _PARAMETERS_TRIES
        now.parameters_due_ns = now_ns + (_PARAMETERS_LATER_NS if patient else _PARAMETERS_PERIOD_NS)
        now.parts.clear()
        return encode_command(Command.READ_PARASET)

    def _ask_data(self, now_ns: int) -> list[bytes]:
        now = self._now
        if now.unanswered:
            self.counters.drop("unanswered")
        may_be_old = now.parameters is None or now.parameters.hardware_version == 0
        if may_be_old and now.unanswered and now.unanswered % _LEGACY_AFTER == 0:
            now.legacy = not now.legacy
        now.unanswered += 1
        now.request_due_ns = max(now.request_due_ns + self._period_ns(), now_ns + 1)
        if now.request_due_ns <= now_ns + self._period_ns() // 2:  # far behind: keep the beat, not the backlog
            now.request_due_ns = now_ns + self._period_ns()
        if not now.legacy:
            return [encode_get_data(self._groups)]
        commands = {Command.GET_DATA_1TO8 if group < 2 else Command.GET_DATA_9TO16 for group in self._groups}
        return [encode_command(command) for command in sorted(commands)]

    def _asks(self) -> bool:
        """Whether data must be asked for."""
        if not self._measures:
            return False
        now = self._now
        if self._mode != "auto":
            return self._mode == "request"
        return now.parameters is None or now.distrust_sending or self._slow_or_mute(now.parameters)

    def _slow_or_mute(self, parameters: UsBoardParameters) -> bool:
        """Whether the board does not send all that is wanted, in full, often enough, on this link."""
        groups = parameters.send_groups or 0xF
        return (
            parameters.send_mode not in self._sends_itself
            or parameters.interval_s > _SLOWEST_LISTENING_S
            or (parameters.legacy_format and parameters.hardware_version != 0)
            or any(not groups >> group & 1 for group in self._groups)
        )

    # ---- in

    def take(self, message: bytes, stamp_ns: int) -> Iterator[Reading]:
        """One whole message that arrived at stamp_ns."""
        try:
            readings = self._understand(message, stamp_ns)
        except FrameError as error:
            self.counters.drop(error.reason)
            return
        self._now.heard_ns = stamp_ns
        if not self._now.answered:
            self._now.answered = True
            self._now.parameters_due_ns = stamp_ns
        for reading in readings:
            self._now.running = True
            self.counters.readings += 1
            yield reading

    def _understand(self, message: bytes, stamp_ns: int) -> Sequence[Reading]:
        command = message[0]
        if command == Command.GET_DATA:
            return self._readings(decode_group(message), stamp_ns)
        if command in (Command.GET_DATA_1TO8, Command.GET_DATA_9TO16):
            return self._readings(decode_part(message), stamp_ns)
        check_message(message)
        if command == Command.READ_PARASET:
            self._take_parameters(message)
        elif command == Command.GET_ANALOGIN:
            self.analog_v = decode_analog(message)
            self._now.analog_heard = True
            return self._contacts(self.analog_v, stamp_ns)
        return []

    def _contacts(self, inputs_v: tuple[float, ...], stamp_ns: int) -> list[ContactReading]:
        """What the switches at the inputs say; a line between the levels is torn or shorted, and says nothing."""
        if not self._active_low:
            return []
        lines = []
        for line, trips_low in sorted(self._active_low.items()):
            state = ContactState.UNKNOWN
            if inputs_v[line] <= _LOW_V or inputs_v[line] >= _HIGH_V:
                is_low = inputs_v[line] <= _LOW_V
                state = ContactState.TRIPPED if is_low is trips_low else ContactState.CLEAR
            else:
                self.counters.drop("between_levels")
            lines.append(ContactLine(line, state))
        self._last_contact_ns = max(stamp_ns - self._wire_time_ns, self._last_contact_ns + 1)
        return [ContactReading(self._last_contact_ns, tuple(lines))]

    def _take_parameters(self, message: bytes) -> None:
        now = self._now
        part = message[1]
        now.parts[part] = message[2:]
        if len(now.parts) < PARAMETER_PARTS:
            return
        block = b"".join(now.parts[index] for index in range(PARAMETER_PARTS))
        now.parts.clear()
        now.parameters = decode_parameters(block)
        now.legacy = now.parameters.hardware_version == 0
        self.identity = _identity(now.parameters)

    def _readings(self, group: GroupValues, stamp_ns: int) -> list[ChainReading]:
        index = (group.first_channel - 1) // 4
        if not self._measures:
            return []  # somebody else's question, or the board's habit
        if index not in self._groups:
            self.counters.drop("unwanted_group")
            return []
        self._now.unanswered = 0
        self._now.group_seen_ns[index] = stamp_ns
        self._now.silent_groups.discard(index)
        wanted = [
            self._range(channel, value, group)
            for channel, value in enumerate(group.values, start=group.first_channel)
            if channel in self.channels
        ]
        readings = [ChainReading(self._fired_ns(stamp_ns), tuple(found))] if (found := [r for r in wanted if r]) else []
        return readings + self._gone_silent(stamp_ns)

    def _range(self, channel: int, value: int, group: GroupValues) -> RangeReading | None:
        """What one value means; None if it says nothing (no echo of somebody else's ping frees nothing)."""
        heard_from = group.fired_by if group.fired_by != channel else None
        if heard_from is None:
            (self._now.unconnected.add if value == 0 else self._now.unconnected.discard)(channel)
        elif value in (0, 2):
            return None
        if value == 1:
            return RangeReading(channel, -math.inf, RangeStatus.TOO_CLOSE, heard_from)
        if value == 0 or (value == 2 and not self._is_active(channel)):
            return RangeReading(channel, math.nan, RangeStatus.NOT_LOOKED, heard_from)
        if value == 2:
            if self._is_cut(group):
                return RangeReading(channel, math.nan, RangeStatus.INVALID, heard_from)
            return RangeReading(channel, math.inf, RangeStatus.NO_RETURN, heard_from)
        range_m = value * group.resolution_m
        if range_m > self._range_max_m:
            self.counters.drop("range_implausible")
            return RangeReading(channel, math.nan, RangeStatus.INVALID, heard_from)
        return RangeReading(channel, range_m, RangeStatus.ECHO, heard_from)

    def _is_cut(self, group: GroupValues) -> bool:
        """A USS5 told to use the old format cuts its values to 8 bits: 258 units would read as 2, "no echo"."""
        parameters = self._now.parameters
        return (
            group.resolution_m == LEGACY_RESOLUTION_M
            and parameters is not None
            and parameters.hardware_version != 0
            and parameters.legacy_format
        )

    def _gone_silent(self, stamp_ns: int) -> list[ChainReading]:
        """Groups that no longer answer while others do: told once as STALE, so that nobody goes on believing them."""
        now = self._now
        readings = []
        for group in self._groups:
            seen_ns = now.group_seen_ns.setdefault(group, stamp_ns)
            now.frames_since[group] = now.frames_since.get(group, 0) + 1 if seen_ns < stamp_ns else 0
            passed_over = now.frames_since[group] > _MISSED_ROUNDS * (len(self._groups) - 1)  # not: all paused
            if group in now.silent_groups or not passed_over or stamp_ns - seen_ns <= self.silence_limit_ns:
                continue
            now.silent_groups.add(group)
            self.counters.drop("group_silent")
            stale = tuple(
                RangeReading(channel, math.nan, RangeStatus.STALE)
                for channel in range(4 * group + 1, 4 * group + 5)
                if channel in self.channels
            )
            readings.append(ChainReading(self._fired_ns(stamp_ns), stale))
        return readings

    # ---- times

    def _fired_ns(self, arrived_ns: int) -> int:
        """When the earliest of the values that arrived was measured, as well as can be known; strictly rising.

        The transducers of a group fire in turn, each for one fire interval T, the groups at the same time, and the
        board sends the newest finished value of each. With n active in a group the oldest of them was fired between
        (n - 1) T and (n + 1) T before: n T is taken, of the slowest group for all, so that stamps never fall back.
        """
        stamp_ns = max(arrived_ns - self._wire_time_ns - self._round_ns(), self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        return stamp_ns

    def _round_ns(self) -> int:
        """Time in which every active transducer of the wanted groups fires once."""
        parameters = self._now.parameters
        if parameters is None:
            return 4 * _DEFAULT_FIRE_NS
        rounds_s = [
            (parameters.active >> 4 * group & 0xF).bit_count() * parameters.fire_interval_s[group]
            for group in self._groups
        ]
        return round(max(rounds_s) * 1e9) or 4 * _DEFAULT_FIRE_NS

    def _period_ns(self) -> int:
        """Time between two readings of the same channel."""
        parameters = self._now.parameters
        if self._mode == "listen" and parameters is not None and parameters.send_mode in self._sends_itself:
            return round(parameters.interval_s * 1e9)
        period_ns = self._round_ns() if self._rate_hz is None else round(1e9 / self._rate_hz)
        return max(period_ns, self._slowest_period_ns)

    def _is_active(self, channel: int) -> bool:
        parameters = self._now.parameters
        return parameters is None or bool(parameters.active >> (channel - 1) & 1)


_MODELS = {0: "USBoard V1", 20: "USBoard-USS5", 21: "USBoard-USS5", 200: "USBoard-USS5-IP", 201: "USBoard-USS5-IP"}


def _identity(parameters: UsBoardParameters) -> Identity:
    version = parameters.hardware_version
    return Identity(
        vendor="Neobotix",
        model=_MODELS.get(version, "USBoard"),
        serial=str(parameters.serial_number),
        firmware=f"hardware {version}",
    )


def _list(channels: Sequence[int]) -> str:
    return ", ".join(str(channel) for channel in channels)


class _UsBoardLink:
    """What both links share: the properties that a conversation shows."""

    def __init__(self, board: _Board) -> None:
        self._board = board

    @property
    def state(self) -> LinkState:
        return self._board.state

    @property
    def trouble(self) -> str | None:
        return self._board.trouble

    @property
    def identity(self) -> Identity | None:
        return self._board.identity

    @property
    def clock_fit(self) -> ClockFit | None:
        """The board has no clock."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._board.counters

    @property
    def silence_limit_ns(self) -> int:
        return self._board.silence_limit_ns

    def silence_limit_of(self, kind: type[Reading]) -> int:
        """See drivers.shares.ManySources."""
        return self._board.contact_limit_ns if kind is ContactReading else self._board.silence_limit_ns

    def trouble_of(self, kind: type[Reading]) -> str | None:
        """See drivers.shares.ManySources."""
        return self._board.contact_trouble if kind is ContactReading else self._board.trouble

    @property
    def analog_v(self) -> tuple[float, ...] | None:
        """The four analog inputs in volts, if they are asked for and were answered."""
        return self._board.analog_v

    def next_request_ns(self) -> int:
        """When requests() has something to say next."""
        return self._board.next_due_ns()


class UsBoardConversation(_UsBoardLink):
    """A USBoard on CAN. Several boards share a bus by their base ids (400h, 420h, …).

    channels: those in use, 1..16 (None: all).  rate_hz: of the values; None: as fast as the transducers fire.
    range_max_m: a value beyond what the transducers can measure is INVALID.  analog_rate_hz: of the four inputs, 0 does
    not ask.  switches: those inputs (0..3) that are switches, and whether low means tripped.  measures: False where
    only the switches are of interest.
    """

    def __init__(
        self,
        base_id: int = 0x400,
        *,
        extended: bool = False,
        channels: Sequence[int] | None = None,
        rate_hz: float | None = 10.0,
        mode: Mode = "auto",
        range_max_m: float = 6.0,
        analog_rate_hz: float = 0.0,
        switches: Mapping[int, bool] = _NONE,
        measures: bool = True,
    ) -> None:
        super().__init__(
            _Board(
                channels=channels,
                rate_hz=rate_hz,
                mode=mode,
                range_max_m=range_max_m,
                analog_rate_hz=analog_rate_hz,
                switches=switches,
                measures=measures,
                sends_itself=(SendMode.ON_CAN, SendMode.ON_BOTH),
                wire_time_ns=0,  # a frame takes 0.13 ms at 1 Mbit/s
                slowest_period_ns=0,
                silent_hint=(
                    f"no answer from a USBoard at base id {base_id:X}h: check its power, the wiring and "
                    "termination of the bus, bit rate and base id"
                ),
            )
        )
        self._base_id = base_id
        self._extended = extended

    def connected(self, now_ns: int) -> None:
        self._board.connected(now_ns)

    def hears(self, chunk: CanFrame) -> bool:
        """Whether a frame is of this board."""
        return 1 <= chunk.can_id - self._base_id <= 16

    def receive(self, chunk: CanFrame, stamp_ns: int) -> Iterator[Reading]:
        offset = chunk.can_id - self._base_id
        if not 1 <= offset <= 16 or chunk.extended is not self._extended:
            return iter(())
        counters = self._board.counters
        counters.chunks += 1
        counters.bytes += len(chunk.data)
        if chunk.remote or len(chunk.data) != MESSAGE_SIZE:
            counters.drop("wrong_length")
            return iter(())
        if offset != offset_of(chunk.data):
            counters.drop("id_mismatch")
            return iter(())
        return self._board.take(chunk.data, stamp_ns)

    def requests(self, now_ns: int) -> Sequence[CanFrame | SetBaudRate]:
        return [CanFrame(self._base_id, message, self._extended) for message in self._board.due(now_ns)]

    def farewell(self) -> Sequence[CanFrame | SetBaudRate]:
        """Nothing moves and nothing shines: the board may go on."""
        return ()


_SERIAL_BAUD = 19200


class UsBoardSerialConversation(_UsBoardLink):
    """A USBoard on its RS-232 or USB line, 19200 8N1. Arguments as UsBoardConversation.

    Four groups take 44 bytes, 23 ms, and the question 4 ms: the rate is held at 20 Hz or below.
    """

    def __init__(
        self,
        *,
        channels: Sequence[int] | None = None,
        rate_hz: float | None = 10.0,
        mode: Mode = "auto",
        range_max_m: float = 6.0,
        analog_rate_hz: float = 0.0,
        switches: Mapping[int, bool] = _NONE,
        measures: bool = True,
    ) -> None:
        super().__init__(
            _Board(
                channels=channels,
                rate_hz=rate_hz,
                mode=mode,
                range_max_m=range_max_m,
                analog_rate_hz=analog_rate_hz,
                switches=switches,
                measures=measures,
                sends_itself=(SendMode.ON_SERIAL, SendMode.ON_BOTH),
                wire_time_ns=SERIAL_SIZE * 10 * 1_000_000_000 // _SERIAL_BAUD,
                slowest_period_ns=50_000_000,
                silent_hint="no answer from a USBoard: check its power and the crossed RS-232 wires",
            )
        )
        self._buffer = bytearray()

    def connected(self, now_ns: int) -> None:
        self._buffer.clear()
        self._board.connected(now_ns)

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        counters = self._board.counters
        counters.chunks += 1
        counters.bytes += len(chunk)
        self._buffer += chunk
        while (message := self._next_message()) is not None:
            yield from self._board.take(message, stamp_ns)

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        return self._board.due(now_ns)

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """Nothing moves and nothing shines: the board may go on."""
        return ()

    def _next_message(self) -> bytes | None:
        """The next message with a right CRC; None if more bytes are needed."""
        buffer = self._buffer
        while True:
            start = buffer.find(SERIAL_HEADER)
            noise = len(buffer) if start < 0 else start
            if noise:
                self._board.counters.drop("noise_bytes", noise)
                del buffer[:noise]
            if len(buffer) < SERIAL_SIZE:
                return None
            frame = bytes(buffer[:SERIAL_SIZE])
            try:
                return self._whole_message(frame)
            except FrameError as error:
                self._board.counters.drop(error.reason)
                del buffer[0]  # look again from byte 1

    def _whole_message(self, frame: bytes) -> bytes:
        """Checks CRC and content before any byte is given up: noise can have a right CRC, and a true frame in it."""
        message = frame[1:-2]
        if encode_serial_frame(message) != frame:
            raise FrameError("bad_crc", frame.hex())
        check_message(message)
        del self._buffer[:SERIAL_SIZE]
        return message
