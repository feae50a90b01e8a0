"""Hokuyo lasers that speak SCIP 2.x: URG-04LX, UTM-30LX and their relatives. Bytes in, scans out. Pure.

    bring-up   QT at each speed until it is answered (SCIP 1.1 first: `E`, then SCIP2.0) -> VV, PP twice, II
               -> SS where a real serial line is too slow -> TM0, TM1 (clock), TM2 -> BM -> MD endless
    then       a scan per turn, each checked whole: sums, length, echo, remaining count, stamp, values
    after      status 21..49 wait for 98; status 50..97, silence, nonsense: QT and bring-up again

The messages and their layout are in scip.py. Geometry: bearing = (step - AFRT) * 360 / ARES degrees, positive to the
left; the stamp is taken when the head passes step 0 (rear), so step k is looked at k / ARES of a turn later.

The bring-up is written as one generator that yields what to send and what to wait for, and reads from top to bottom.
Source: Hokuyo C-42-03320B; quirks: docs/devices/hokuyo.md.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from drivers.clock_fit import DeviceClock
from drivers.conversation import SetBaudRate
from drivers.errors import FrameError
from drivers.readings import F64, ClockFit, Identity, LinkState, Reading, ScanReading, SourceCounters
from drivers.scip import (
    SHORT_MAX_MM,
    STAMP_WRAP_MS,
    CodeTable,
    Profile,
    Reply,
    ScanRequest,
    ScipReplies,
    Sweep,
    decode_number,
    decode_scan,
    model_name,
    parse_profile,
    text_fields,
)

_MS = 1_000_000
SPEEDS = (19200, 115200, 57600, 38400)  # power-on speed first, then the one that this driver sets
PROBE_NS = 250 * _MS  # devices answer within 140 ms
REPLY_NS = 400 * _MS
FIRST_SCAN_NS = 4_000 * _MS  # the motor takes seconds to spin up
SILENCE_CAP_NS = 500 * _MS
RESTART_NS = 450 * _MS  # without a scan for this long the device is asked what is the matter
GARBLED_NS = 2_000 * _MS  # so long when bytes do come, but no scan is whole
STALL_NS = 150 * _MS  # we ourselves were not called for so long: what came meanwhile must be read first
CLOCK_QUESTIONS = 12
SLOW_LINE_SCAN_NS = 300 * _MS  # a scan may take this long on a serial line before beams are joined

Protocol = Literal["MD", "MS", "ME", "auto"]
Codes = Literal["auto", "urg", "utm"]

_TEXT = bytes([0x0A, *range(0x20, 0x7F)])
_REFUSALS = {
    "01": "the first step is not a number to it",
    "02": "the last step is not a number to it",
    "03": "the cluster count is not a number to it",
    "04": "the last step is beyond its field",
    "05": "the last step is before the first",
    "06": "the interval is not a number to it",
    "07": "the scan count is not a number to it",
    "10": "its laser is off",
}


@dataclass(frozen=True, slots=True)
class _Step:
    """One step of the script: send this, then wait for a reply that `awaits` takes, or for wait_ns."""

    send: tuple[bytes | SetBaudRate, ...]
    awaits: Callable[[Reply], bool]
    wait_ns: int


_Script = Generator[_Step, Reply | None, bool]


class HokuyoConversation:
    """A `Conversation[bytes]` with a Hokuyo laser on USB, RS-232 or TCP. No argument is needed.

    protocol: "MD" distances, "ME" with intensities, "MS" short (up to 4.095 m), "auto" ME where the device can.
    first_step, last_step: part of the field, in the device's steps (default: all of AMIN..AMAX).
    cluster: steps joined to one beam; skip_interval: scans left out between two (default: what a serial line needs).
    baud: the speed to try first.  set_baud: speed to set on a serial line (default 115200 if it is slower; 0 never).
    range_min_m, range_max_m: narrower limits than the device's own.  error_codes: which table, by model if "auto".
    """

    def __init__(
        self,
        *,
        protocol: Protocol = "MD",
        first_step: int | None = None,
        last_step: int | None = None,
        cluster: int | None = None,
        skip_interval: int | None = None,
        baud: int | None = None,
        set_baud: int | None = None,
        range_min_m: float | None = None,
        range_max_m: float | None = None,
        error_codes: Codes = "auto",
    ) -> None:
        _check_arguments(protocol, first_step, last_step, cluster, skip_interval, set_baud, error_codes)
        self._protocol = protocol
        self._steps = (first_step, last_step)
        self._cluster = cluster
        self._skip = skip_interval
        self._set_baud = set_baud
        self._range_limits_m = (range_min_m, range_max_m)
        self._error_codes = error_codes
        wanted = [*([baud] if baud else []), *SPEEDS, *([set_baud] if set_baud else [])]
        self._speeds = list(dict.fromkeys(wanted))

        self._counters = SourceCounters()
        self._replies = ScipReplies(counters=self._counters)
        self._clock = DeviceClock(wrap_ns=STAMP_WRAP_MS * _MS, tick_ns=_MS)
        self._state = LinkState.SILENT
        self._trouble: str | None = None
        self._identity: Identity | None = None
        self._profile: Profile | None = None
        self._device_says = ""  # the STAT line of II
        self._reset(0)

    def _reset(self, now_ns: int) -> None:
        """What a reopened wire makes void."""
        self._replies.clear()
        self._script: Generator[_Step, Reply | None, None] | None = None
        self._step = _Step((), _nothing, 0)
        self._step_sent = False
        self._deadline_ns = now_ns
        self._sent_ns = now_ns
        self._asked_ns = now_ns  # newest call of requests()
        self._received_ns = now_ns
        self._bytes_at_speed = self._bytes_at_probe = 0  # counters.bytes when the speed, and QT, was last tried
        self._other_bytes = 0  # since the former, those that are not text
        self._line_ns_per_byte = 0.0  # of a real serial line; 0 on USB and TCP
        self._sees_serial_line: list[bool] = []
        self._speed_lost = False  # it did not answer at the speed that was set
        self._stream: _Stream | None = None
        self._last_scan_ns = now_ns

    # What a reader asks.

    @property
    def state(self) -> LinkState:
        """SILENT until the device answers, STARTING until scans flow, RUNNING while they do."""
        return self._state

    @property
    def trouble(self) -> str | None:
        """What is wrong now and how to repair it, in one line, or None."""
        return self._trouble

    @property
    def identity(self) -> Identity | None:
        """From the device's VV reply, the model's name from PP."""
        return self._identity

    @property
    def profile(self) -> Profile | None:
        """The parameters the device gave (PP), with this conversation's overrides; None before they are known."""
        return self._profile

    @property
    def clock_fit(self) -> ClockFit | None:
        """The 24-bit millisecond clock of the device, unwrapped, against the host's."""
        return self._clock.fit

    @property
    def counters(self) -> SourceCounters:
        """What was counted since construction."""
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        """3 scan periods, at most 500 ms (but never less than 1.5 periods); generous while the motor spins up."""
        if self._stream is None or self._state is not LinkState.RUNNING:
            return FIRST_SCAN_NS
        period_ns = self._stream.period_ns
        return round(max(min(3 * period_ns, SILENCE_CAP_NS), 1.5 * period_ns))

    # How a reader drives.

    def connected(self, now_ns: int) -> None:
        """The wire was opened or reopened."""
        self._reset(now_ns)
        self._state = LinkState.SILENT
        self._script = self._life()
        self._take_step(next(self._script), now_ns)

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        """Take what arrived; yields finished scans."""
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        self._received_ns = stamp_ns
        if self._stream is None:
            self._other_bytes += len(chunk.translate(None, _TEXT))
        for reply in self._replies.feed(chunk, stamp_ns):
            if self._stream is not None and reply.scan is not None:
                reading = self._stream_scan(self._stream, reply)
                if reading is not None:
                    self._counters.readings += 1
                    self._last_scan_ns = stamp_ns
                    self._state = LinkState.RUNNING
                    self._trouble = self._stream.trouble
                    yield reading
            if self._script is not None and self._step_sent and self._step.awaits(reply):
                self._advance(reply, stamp_ns)
            elif self._stream is None or reply.scan is None:
                self._counters.drop("leftover_scan" if reply.scan is not None else "unexpected_reply")

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        """What is to be sent now; notices time-outs."""
        if self._script is None:
            return []
        self._notice_silence(now_ns)
        out: list[bytes | SetBaudRate] = []
        while not self._step_sent or now_ns >= self._deadline_ns:
            if not self._step_sent:
                out += self._step.send
                self._step_sent, self._sent_ns = True, now_ns
                self._deadline_ns = now_ns + self._step.wait_ns
            else:
                self._advance(None, now_ns)
        return out

    def next_request_ns(self) -> int:
        """When requests() has something to say next, if nothing arrives before."""
        return self._deadline_ns if self._step_sent else 0

    def is_amid(self) -> bool:
        """Whether a part of a scan came, whose rest is on its way."""
        return self._stream is not None and self._step_sent and self._replies.is_amid

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """Stops the stream and the laser, in any mode."""
        return [b"QT\n"]

    # The script and its clockwork.

    def _advance(self, reply: Reply | None, now_ns: int) -> None:
        assert self._script is not None
        self._take_step(self._script.send(reply), now_ns)

    def _take_step(self, step: _Step, now_ns: int) -> None:
        self._step = step
        self._step_sent = not step.send
        self._deadline_ns = now_ns + step.wait_ns

    def _notice_silence(self, now_ns: int) -> None:
        """Say that scans have stopped, long after the reader did; after a stall, read first what waits."""
        if now_ns - self._asked_ns > STALL_NS and now_ns - self._received_ns > STALL_NS:
            self._deadline_ns = max(self._deadline_ns, now_ns + STALL_NS // 3)
        elif self._state is LinkState.RUNNING and now_ns - self._last_scan_ns > max(self.silence_limit_ns, RESTART_NS):
            self._state = LinkState.SILENT
            self._trouble = "scans have stopped: check the cable and the power supply; the driver keeps asking"
        self._asked_ns = now_ns

    def _life(self) -> Generator[_Step, Reply | None, None]:
        """The device's life from our side; never ends."""
        failures = 0
        while True:
            yield from self._find()
            if self._state is LinkState.SILENT:
                self._trouble = None
            self._state = LinkState.STARTING
            if (yield from self._bring_up()):
                failures = 0
                yield from self._watch_stream()
            else:
                failures += 1
                yield _pause(500 * _MS)
            self._stream = None
            if failures and failures % 3 == 0:  # more than a stop is needed: defaults, also of the speed
                yield _ask(b"RS", REPLY_NS)

    def _bring_up(self) -> _Script:
        return (
            (yield from self._identify())
            and (yield from self._suit_line_speed())
            and (yield from self._sample_clock())
            and (yield from self._laser_on())
            and (yield from self._start_stream())
        )

    # Finding the device.

    def _find(self) -> Generator[_Step, Reply | None, None]:
        """Try the speeds in turn, for ever, until QT is answered with "done"."""
        while True:
            heard_bytes = self._counters.bytes
            for speed in tuple(self._speeds):
                if (yield from self._try_speed(speed)):
                    self._speeds.remove(speed)
                    self._speeds.insert(0, speed)  # the first one to try next time
                    return
            self._state = LinkState.SILENT
            self._trouble = _trouble_of_silence(self._counters.bytes > heard_bytes)

    def _try_speed(self, speed: int) -> _Script:
        self._line_ns_per_byte = 0.0
        self._bytes_at_speed = self._counters.bytes
        self._other_bytes = 0
        yield _Step((SetBaudRate(speed),), _nothing, 0)
        for _ in range(12):  # 3 s, for as long as an old stream of the right speed runs out
            self._bytes_at_probe = self._counters.bytes
            reply = yield _ask(b"QT", PROBE_NS)
            if reply is None and not self._hears_scip():
                return False
            if reply is not None and reply.status == "00":
                return True
            if reply is not None and reply.status == "E":
                self._state = LinkState.STARTING
                yield _ask(b"SCIP2.0", PROBE_NS)
        return False

    def _hears_scip(self) -> bool:
        """Whether text has come in just now: at a wrong speed it would be no text."""
        heard = self._counters.bytes - self._bytes_at_speed
        fresh = self._counters.bytes - self._bytes_at_probe
        return fresh > 0 and heard >= 8 and heard > 20 * self._other_bytes

    # Who it is.

    def _identify(self) -> _Script:
        fields = yield from self._ask_text(b"VV")
        if fields == {}:
            yield _ask(b"TM2", REPLY_NS)  # an old session may have left it in time mode, where all else is refused
            fields = yield from self._ask_text(b"VV")
        profile = (yield from self._ask_profile()) if fields else None
        if not fields or profile is None:
            self._trouble = "answers QT but does not say who it is (VV, PP): no SCIP 2 laser, or the line is noisy"
            return False
        state = yield from self._ask_text(b"II")
        self._device_says = (state or {}).get("STAT", "")
        speed = _turns_per_minute((state or {}).get("SCSP", ""))
        if speed is not None and 0.5 * profile.turns_per_minute <= speed <= profile.turns_per_minute:
            profile = replace(profile, turns_per_minute=speed)
        self._identity = Identity(
            vendor=fields.get("VEND", ""),
            model=profile.model or model_name(fields.get("PROD", "")),
            serial=fields.get("SERI", ""),
            firmware=fields.get("FIRM", ""),
        )
        self._profile = self._with_overrides(profile)
        return True

    def _ask_text(self, command: bytes) -> Generator[_Step, Reply | None, dict[str, str] | None]:
        """The fields of a text reply; empty if it is refused, None if it does not come."""
        for _ in range(3):
            reply = yield _ask(command, REPLY_NS)
            if reply is None:
                continue
            if reply.status != "00":
                return {}
            self._look_at_pace(reply)
            try:
                return text_fields(reply)
            except FrameError as error:
                self._counters.drop(error.reason)
        return None

    def _ask_profile(self) -> Generator[_Step, Reply | None, Profile | None]:
        """PP until it said the same twice: a 6-bit sum is little for what all geometry hangs on."""
        before: Profile | None = None
        for _ in range(6):
            fields = yield from self._ask_text(b"PP")
            if not fields:
                return None
            try:
                profile = parse_profile(fields)
            except FrameError as error:
                self._counters.drop(error.reason)
                continue
            if profile == before:
                return profile
            before = profile
        return None

    def _with_overrides(self, profile: Profile) -> Profile:
        low_m, high_m = self._range_limits_m
        if self._error_codes != "auto":
            profile = replace(profile, codes=CodeTable[self._error_codes.upper()])
        if high_m is not None:
            profile = replace(profile, far_limit_mm=round(high_m * 1000))
        if low_m is not None:
            profile = replace(profile, near_limit_mm=round(low_m * 1000))
        return profile

    # The line's speed.

    def _look_at_pace(self, reply: Reply) -> None:
        """Replies trickle in on a real serial line, as slowly as its speed says; USB and TCP deliver at once."""
        expected_ns = reply.size * 10e9 / self._speeds[0]
        self._sees_serial_line.append(0.6 * expected_ns <= reply.arrived_ns - reply.began_ns <= 1.3 * expected_ns)

    def _suit_line_speed(self) -> _Script:
        """On a real serial line: its time per byte, and a higher speed where it is slow."""
        serial = len(self._sees_serial_line) >= 3 and all(self._sees_serial_line[-3:])
        speed = self._set_baud if self._set_baud is not None else 115200 if serial else 0
        wanted = speed not in (0, self._speeds[0]) and (self._set_baud is not None or self._speeds[0] < speed)
        if wanted and not self._speed_lost:
            reply = yield _ask(b"SS%06d" % speed, REPLY_NS)
            if reply is not None and reply.status in ("00", "03"):
                yield _Step((SetBaudRate(speed),), _nothing, 50 * _MS)
                if not (yield from self._answers_at(speed)):
                    self._speed_lost = True
                    return False
            elif self._set_baud is not None:
                self._trouble = f"refuses set_baud = {speed}: choose another speed or leave it out"
        self._line_ns_per_byte = 10e9 / self._speeds[0] if serial else 0.0
        return True

    def _answers_at(self, speed: int) -> _Script:
        if not (yield from self._try_speed(speed)):
            return False
        if speed in self._speeds:
            self._speeds.remove(speed)
        self._speeds.insert(0, speed)
        return True

    # The clock.

    def _sample_clock(self) -> _Script:
        """Ask for the time, a dozen times. A device that has no time mode does without."""
        self._clock.restart()
        entered = yield _ask(b"TM0", REPLY_NS)
        if entered is None or entered.status not in ("00", "02"):
            return True
        for _ in range(CLOCK_QUESTIONS):
            reply = yield _ask(b"TM1", REPLY_NS)
            if reply is None or reply.status != "00":
                continue
            try:
                stamp_ns = decode_number(reply.lines[0]) * _MS
            except FrameError as error:
                self._counters.drop(error.reason)
                continue
            self._clock.ask(
                stamp_ns,
                sent_ns=self._sent_ns + self._wire_ns(len(b"TM1\n")),
                received_ns=self._arrival_ns(reply) - self._wire_ns(reply.size),
            )
        for _ in range(3):
            left = yield _ask(b"TM2", REPLY_NS)
            if left is not None and left.status in ("00", "03"):
                return True
        return False

    def _wire_ns(self, size: int) -> int:
        return round(size * self._line_ns_per_byte)

    def _arrival_ns(self, reply: Reply) -> int:
        """When the reply's last byte came, where more of the same chunk came behind it on a slow line."""
        return reply.arrived_ns - self._wire_ns(reply.bytes_after)

    # Laser and stream.

    def _laser_on(self) -> _Script:
        reply = None
        for _ in range(3):
            reply = yield _ask(b"BM", 1_000 * _MS)
            if reply is not None:
                break
        if reply is not None and reply.status == "01":
            says = f' It says "{self._device_says}".' if self._device_says else ""
            self._trouble = (
                f"laser trouble (BM status 01): power it off and on; if it stays, the unit needs service.{says}"
            )
            return False
        if reply is None:  # the stream switches it on as well
            self._trouble = "does not answer BM (laser on): check the power supply, it must carry the motor's start"
        return True

    def _start_stream(self) -> _Script:
        profile = self._profile
        assert profile is not None
        for symbol in ("ME", "MD") if self._protocol == "auto" else (self._protocol,):
            request = self._request(symbol, profile)
            if request is None:
                return False
            # Scans may follow the reply in the same chunk, so they are expected from here on.
            self._stream = _Stream(request, profile, self._line_ns_per_byte)
            reply = yield _ask(request.command(), 1_500 * _MS)
            if reply is not None and reply.status in ("00", "99"):
                return True
            self._stream = None
            if reply is not None or self._trouble is None:
                self._trouble = _trouble_of_refusal(request.command().decode(), None if reply is None else reply.status)
        return False

    def _request(self, symbol: str, profile: Profile) -> ScanRequest | None:
        first = profile.first_step if self._steps[0] is None else self._steps[0]
        last = profile.last_step if self._steps[1] is None else self._steps[1]
        if not profile.first_step <= first <= last <= profile.last_step:
            self._trouble = (
                f"steps {first} to {last} are not within {profile.model}'s field: "
                f"set first_step and last_step between {profile.first_step} and {profile.last_step}"
            )
            return None
        request = ScanRequest(symbol, first, last, self._cluster or 1, self._skip or 0)
        if self._cluster is None:
            while self._wire_ns(request.reply_bytes()) > SLOW_LINE_SCAN_NS and request.cluster < 99:
                request = replace(request, cluster=request.cluster + 1)
        if self._skip is None:
            turns = self._wire_ns(request.reply_bytes()) / profile.turn_ns
            request = replace(request, skip=min(int(turns), 9))
        return request

    def _watch_stream(self) -> Generator[_Step, Reply | None, None]:
        """Until something ends the stream. Scans themselves were read on the way; here only their coming counts."""
        stream = self._stream
        assert stream is not None
        head = stream.head
        wait_ns = FIRST_SCAN_NS
        while True:
            reply = yield _Step((), lambda reply: reply.echo.startswith(head), wait_ns)
            if reply is None and self._is_only_garbled(stream):
                wait_ns = RESTART_NS // 2
            elif reply is None:
                self._state = LinkState.SILENT
                self._trouble = "no scans: check the cable and the power supply; the driver keeps asking"
                return
            elif reply.status == "99":
                wait_ns = max(RESTART_NS, round(1.5 * stream.period_ns))
            elif reply.status == "98":
                self._trouble = None
                wait_ns = FIRST_SCAN_NS
            elif "21" <= reply.status <= "49":
                self._state = LinkState.STARTING
                self._trouble = f"pauses to verify an error (status {reply.status}): keep the window clean and dry"
                wait_ns = FIRST_SCAN_NS
            elif reply.status != "00":
                self._state = LinkState.STARTING
                self._trouble = f"hardware trouble, status {reply.status}: started anew; if it stays, service is needed"
                yield _pause(500 * _MS)
                return

    def _is_only_garbled(self, stream: _Stream) -> bool:
        """Bytes still come, so a new start would not help; but not for ever."""
        bytes_come = self._asked_ns - self._received_ns < max(2 * stream.period_ns, STALL_NS)
        return bytes_come and self._asked_ns - self._last_scan_ns < GARBLED_NS

    def _stream_scan(self, stream: _Stream, reply: Reply) -> ScanReading | None:
        """The reading in a scan, if it is ours and nothing speaks against it; else None, counted."""
        assert reply.scan is not None
        if reply.echo != stream.echo:
            self._counters.drop("bad_count" if reply.echo.startswith(stream.head) else "bad_echo")
            return None
        sweep = decode_scan(reply.scan, stream.profile)
        if not stream.believes_values(sweep):
            self._counters.drop("implausible_value")
            return None
        arrived_ns = self._arrival_ns(reply) - self._wire_ns(reply.size)
        placed = self._clock.place(sweep.device_ms * _MS, arrived_ns - stream.last_beam_ns, period_ns=stream.period_ns)
        first_ns = stream.first_beam_of(placed, arrived_ns)
        if first_ns is None:
            self._counters.drop("implausible_stamp")
            return None
        device_ns = None if placed is None else placed[0] + stream.first_beam_ns
        return stream.reading(sweep, first_ns, device_ns)


class _Stream:
    """What stays the same from scan to scan, and what one scan says about the next."""

    PATIENCE = 3  # odd scans in a row until they are how this device is
    CLOCK_PATIENCE = 8

    def __init__(self, request: ScanRequest, profile: Profile, line_ns_per_byte: float) -> None:
        self.profile = profile
        self.echo = request.command()
        self.head = self.echo[:-2]
        self.period_ns = max(profile.turn_ns * (request.skip + 1), request.reply_bytes() * line_ns_per_byte)
        self.trouble: str | None = None
        steps = request.step_of_beams()
        step_ns = profile.turn_ns / profile.steps_per_turn
        self.first_beam_ns = round(float(steps[0]) * step_ns)
        self.last_beam_ns = round(float(steps[-1]) * step_ns)
        self._beam_period_ns = step_ns * max(request.cluster, 1)
        self._bearing_rad: F64 = (steps - profile.front_step) * profile.step_rad
        self._bearing_rad.setflags(write=False)
        far_mm = min(profile.far_mm, SHORT_MAX_MM) if request.value_chars == 2 else profile.far_mm
        self._limits_m = (profile.near_mm / 1000.0, far_mm / 1000.0)
        self._odd_scans = 0
        self._refused_stamps = 0
        self._newest_ns: int | None = None

    def believes_values(self, sweep: Sweep) -> bool:
        """Numbers that no known device says are damage, unless every scan has them."""
        if sweep.odd_values == 0:
            self._odd_scans = 0 if self._odd_scans < self.PATIENCE else self._odd_scans
            return True
        self._odd_scans += 1
        return self._odd_scans >= self.PATIENCE

    def first_beam_of(self, placed: tuple[int, int] | None, arrived_ns: int) -> int | None:
        """Host time of the first beam, later than the one before; None if there is no telling.

        A device whose stamps make no sense for long has no clock: then a scan ends when it arrives.
        """
        no_later_ns = arrived_ns - (self.last_beam_ns - self.first_beam_ns)
        if placed is not None:
            self._refused_stamps, self.trouble = 0, None
            # No beam is measured after its bytes came in.
            first_ns = min(placed[1] + self.first_beam_ns, no_later_ns)
        else:
            self._refused_stamps += 1
            if self._refused_stamps < self.CLOCK_PATIENCE:
                return None
            self.trouble = "its clock makes no sense: scans are timed by their arrival, which is less exact"
            first_ns = no_later_ns
        if self._newest_ns is not None and first_ns <= self._newest_ns:
            return None
        self._newest_ns = first_ns
        return first_ns

    def reading(self, sweep: Sweep, first_ns: int, device_ns: int | None) -> ScanReading:
        """The sweep as a reading."""
        return ScanReading(
            stamp_ns=first_ns,
            beam_period_ns=self._beam_period_ns,
            scan_period_ns=round(self.period_ns),
            bearing_rad=self._bearing_rad,
            range_m=sweep.range_m,
            range_min_m=self._limits_m[0],
            range_max_m=self._limits_m[1],
            intensity=sweep.intensity,
            device_stamp_ns=device_ns,
        )


def _ask(command: bytes, wait_ns: int) -> _Step:
    return _Step((command + b"\n",), lambda reply: reply.echo == command, wait_ns)


def _pause(wait_ns: int) -> _Step:
    return _Step((), _nothing, wait_ns)


def _nothing(_: Reply) -> bool:
    return False


def _turns_per_minute(text: str) -> float | None:
    """`Initial(600[rpm])<-Default setting by user` -> 600."""
    digits = "".join(c if c.isdigit() else " " for c in text.partition("[rpm]")[0]).split() if "[rpm]" in text else []
    return float(digits[-1]) if digits else None


def _trouble_of_silence(heard: bool) -> str:
    if heard:
        return "answers, but not in SCIP: another device is on this port, or its speed is none of 19200 to 115200 bit/s"
    return "does not answer QT at any speed: check power, cable and the port's name"


def _trouble_of_refusal(command: str, status: str | None) -> str:
    if status is None:
        return f"does not answer {command[:2]} (start of scans): check the power supply"
    why = _REFUSALS.get(status, "the manual's status table tells why")
    return f"refuses {command}, status {status}: {why}; check protocol, first_step, last_step, cluster, skip_interval"


def _check_arguments(
    protocol: str,
    first_step: int | None,
    last_step: int | None,
    cluster: int | None,
    skip_interval: int | None,
    set_baud: int | None,
    error_codes: str,
) -> None:
    if protocol not in ("MD", "MS", "ME", "auto"):
        raise ValueError(f'protocol is "MD", "MS", "ME" or "auto", not {protocol!r}')
    if error_codes not in ("auto", "urg", "utm"):
        raise ValueError(f'error_codes is "auto", "urg" or "utm", not {error_codes!r}')
    for name, value, low, high in (
        ("first_step", first_step, 0, 9999),
        ("last_step", last_step, 0, 9999),
        ("cluster", cluster, 1, 99),
        ("skip_interval", skip_interval, 0, 9),
        ("set_baud", set_baud, 0, 999_999),
    ):
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name} is {low} to {high}, not {value}")
    if first_step is not None and last_step is not None and last_step < first_step:
        raise ValueError(f"last_step {last_step} is before first_step {first_step}")
