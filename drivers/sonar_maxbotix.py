"""MaxBotix ultrasonic sensors by their serial text: one sensor on a line, or several through a micro-controller.

    family      text               unit   range                                   period
    lv          R 3 digits CR      inch   006 (and below) .. 254                  49 ms
    xl          R 3 digits CR      cm     020 (and below) .. 765 (nothing)        99 ms
    hr-5m       R 4 digits CR      mm     0300 (and below) .. 5000 (nothing)      100 ms and more
    hr-10m      R 4 digits CR      mm     0300 (and below) .. 9999 (nothing)      100 ms and more

9600 8N1. One blank may stand before CR (HRUSB); LF after it is skipped (micro-controllers). After power-on lines of
text come first. There is no checksum: only R, exactly so many digits and CR is a value, all else is dropped.

Through a micro-controller two forms of lines are read, each ended by CR or LF:

    labelled    3:R1234   3 1234   S3=1234    channel from 1, one of : = , ; blank tab, the value with or without R
    list        R123 R087 R254   123,087,254  the value of each channel in order

These sensors only speak; nothing is sent. Source: MaxBotix data sheets LV-EZ, XL, HR/HRXL, section on serial output.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.conversation import LEAST_SILENCE_NS, SetBaudRate, silence_limit
from drivers.errors import FrameError
from drivers.readings import (
    ChainReading,
    ClockFit,
    Identity,
    LinkState,
    RangeReading,
    RangeStatus,
    Reading,
    SourceCounters,
)

Family = Literal["lv", "xl", "hr-5m", "hr-10m"]
Form = Literal["single", "labelled", "list"]

BAUD_BPS = 9600
_MS = 1_000_000
_BYTE_NS = 10 * 1_000_000_000 // BAUD_BPS
_LONGEST_LINE = 160
_OVERDUE_NS = 1_000 * _MS  # a sensor measures and calibrates itself for 0.25 s first
_STALE_AFTER = 3  # so many periods
_LONG_AGO = -(1 << 62)


@dataclass(frozen=True, slots=True)
class Model:
    """What the numbers of a family mean. least: this or nearer; nothing: this or farther means that nothing is there.

    period_ns: of a free running sensor, the slowest of the family where they differ.
    """

    digits: int
    unit_m: float
    least: int
    nothing: int
    greatest: int
    period_ns: int


MODELS: dict[Family, Model] = {
    "lv": Model(digits=3, unit_m=0.0254, least=6, nothing=254, greatest=255, period_ns=49 * _MS),
    "xl": Model(digits=3, unit_m=0.01, least=20, nothing=765, greatest=765, period_ns=99 * _MS),
    "hr-5m": Model(digits=4, unit_m=0.001, least=300, nothing=5000, greatest=9999, period_ns=150 * _MS),
    "hr-10m": Model(digits=4, unit_m=0.001, least=300, nothing=9999, greatest=9999, period_ns=150 * _MS),
}


def decode_value(digits: str, model: Model) -> tuple[float, RangeStatus]:
    """Range and status of the digits a sensor sent. FrameError `wrong_digits` or `range_implausible`."""
    if len(digits) != model.digits:
        raise FrameError("wrong_digits", digits)
    value = int(digits)
    if value > model.greatest or value == 0:
        raise FrameError("range_implausible", digits)
    if value >= model.nothing:
        return math.inf, RangeStatus.NO_RETURN
    if value <= model.least:
        return -math.inf, RangeStatus.TOO_CLOSE  # sensors say their least distance for anything nearer
    return value * model.unit_m, RangeStatus.ECHO


_END = re.compile(rb"[\r\n]")
_SINGLE = re.compile(r"(?:.*?)R(\d+) ?", re.DOTALL)  # noise in front is no reason to lose a whole value
_LABELLED = re.compile(r"[A-Za-z#]{0,8}(\d{1,2})[:=,; \t]+R?(\d+) ?")
_ITEM = re.compile(r"R?(\d+)")
_BETWEEN = re.compile(r"[,; \t]+")


def decode_line(line: str, form: Form) -> list[tuple[int, str]]:
    """Channels and digits in a line without its end. FrameError `bad_line`."""
    if form == "list":
        items = [_ITEM.fullmatch(word) for word in _BETWEEN.split(line.strip(" \t"))]
        if not items or not all(items):
            raise FrameError("bad_line", repr(line))
        return [(channel, item[1]) for channel, item in enumerate(items, start=1) if item is not None]
    match = (_SINGLE if form == "single" else _LABELLED).fullmatch(line)
    if match is None:
        raise FrameError("bad_line", repr(line))
    return [(1, match[1])] if form == "single" else [(int(match[1]), match[2])]


class MaxBotixConversation:
    """One sensor (form single, channel 1), or several whose lines a micro-controller joins.

    family: what the numbers mean; all sensors of a line are of one family.  channels: those expected (None: single: 1,
    else whoever speaks).  period_s: between two values of a channel; None: the family's own, times the channels of a
    micro-controller that fires them in turn.
    """

    def __init__(
        self,
        family: Family,
        *,
        form: Form = "single",
        channels: Sequence[int] | None = None,
        period_s: float | None = None,
    ) -> None:
        if period_s is not None and not 0.0 < period_s <= 10.0:
            raise ValueError(f"period_s {period_s}: above 0, up to 10")
        if form == "single" and channels is not None and tuple(channels) != (1,):
            raise ValueError("a sensor on a line of its own is channel 1")
        self._family = family
        self._model = MODELS[family]
        self._form: Form = form
        self._channels = frozenset(channels) if channels is not None else None
        count = len(self._channels) if self._channels and form != "single" else 1
        self._period_ns = round(period_s * 1e9) if period_s is not None else self._model.period_ns * count
        self._counters = SourceCounters()
        self._last_stamp_ns = _LONG_AGO
        self._restart(0)

    # ---- what a conversation shows

    @property
    def state(self) -> LinkState:
        if self._running:
            return LinkState.RUNNING
        return LinkState.STARTING if self._greeted else LinkState.SILENT

    @property
    def trouble(self) -> str | None:
        if self._running:
            if self._silent:
                names = ", ".join(str(channel) for channel in sorted(self._silent))
                return f"no more values of channel {names}: check its cable"
            return None
        if self._bytes_only:
            return (
                "bytes arrive, but no values: check that the line is not inverted (RS-232 against TTL), "
                f"its speed (9600 bit/s, USB types 57600) and the family ({self._family}: {self._model.digits} digits)"
            )
        return "nothing heard from the sensor: check its power and its serial wire" if self._overdue else None

    @property
    def identity(self) -> Identity | None:
        """What its greeting said, if it was heard; the sensors have no serial number to tell."""
        return Identity(vendor="MaxBotix", model=self._greeting or self._family) if self._running else None

    @property
    def clock_fit(self) -> ClockFit | None:
        """The sensors have no clock."""
        return None

    @property
    def counters(self) -> SourceCounters:
        return self._counters

    @property
    def silence_limit_ns(self) -> int:
        limit_ns = silence_limit(self._period_ns)
        if self._form == "labelled":  # other channels' lines come in between
            return limit_ns
        return max(limit_ns, self._period_ns * 3 // 2)  # a list, or one slow sensor, may come less often than that

    # ---- how it is driven

    def connected(self, now_ns: int) -> None:
        self._restart(now_ns)

    def _restart(self, now_ns: int) -> None:
        self._buffer = bytearray()
        self._greeting = ""
        self._greeted = self._running = self._overdue = self._bytes_only = False
        self._torn = True  # the first line may have begun before we listened
        self._connected_ns = now_ns
        self._seen_ns: dict[int, int] = {}
        self._silent: set[int] = set()

    def requests(self, now_ns: int) -> Sequence[bytes | SetBaudRate]:
        """Nothing is ever sent; only time is noted."""
        if not self._running and now_ns - self._connected_ns > _OVERDUE_NS:
            self._overdue = True
            self._bytes_only = self._greeted
        return ()

    def receive(self, chunk: bytes, stamp_ns: int) -> Iterator[Reading]:
        self._counters.chunks += 1
        self._counters.bytes += len(chunk)
        self._greeted = self._greeted or bool(chunk)
        self._buffer += chunk
        while (end := self._line_end()) is not None:
            line = bytes(self._buffer[:end])
            # What follows in the chunk came later: its time on the wire is taken off the stamp of this line too.
            sent_ns = stamp_ns - (len(self._buffer) - end - 1) * _BYTE_NS
            del self._buffer[: end + 1]
            torn, self._torn = self._torn, False
            yield from self._take_line(line, sent_ns - (len(line) + 1) * _BYTE_NS, torn=torn)
        if len(self._buffer) > _LONGEST_LINE:
            self._counters.drop("noise_bytes", len(self._buffer))
            self._buffer.clear()
            self._torn = True

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """The sensors only speak."""
        return ()

    # ---- in

    def _line_end(self) -> int | None:
        """Where the next line ends: CR, or LF too in lines of a micro-controller."""
        match = _END.search(self._buffer)
        return None if match is None else match.start()

    def _take_line(self, line: bytes, began_ns: int, *, torn: bool) -> Iterator[Reading]:
        if not line.strip(b" \t\0"):
            return
        try:
            values = self._values(line.decode("latin-1"), torn=torn)
        except FrameError as error:
            self._note_other(line, error)
            return
        wanted = [(channel, digits) for channel, digits in values if self._is_wanted(channel)]
        for channel, _ in wanted:
            self._seen_ns[channel] = began_ns
            self._silent.discard(channel)
        ranges = tuple(self._range(channel, digits) for channel, digits in wanted)
        readings = [ChainReading(self._fired_ns(began_ns), ranges)] if ranges else []
        for reading in readings + self._gone_silent(began_ns):
            self._running = True
            self._counters.readings += 1
            yield reading

    def _values(self, line: str, *, torn: bool) -> list[tuple[int, str]]:
        values = decode_line(line, self._form)
        if torn and self._form != "single":
            raise FrameError("torn_line", line)  # its channel may have lost a digit
        if self._form == "list" and self._channels is not None and len(values) < max(self._channels):
            raise FrameError("bad_line", line)  # which one is missing is not known
        for _, digits in values:
            if len(digits) != self._model.digits:
                raise FrameError("wrong_digits", line)
        return values

    def _note_other(self, line: bytes, error: FrameError) -> None:
        """Greetings come before the values; afterwards a line that is none is damage."""
        text = line.decode("ascii", "replace").strip()
        if error.reason == "bad_line" and not self._running and text.isprintable() and "\ufffd" not in text:
            self._greeting = self._greeting or text[:48]
        else:
            self._counters.drop(error.reason)

    def _is_wanted(self, channel: int) -> bool:
        if channel < 1 or (self._channels is not None and channel not in self._channels):
            self._counters.drop("unwanted_channel")
            return False
        return True

    def _range(self, channel: int, digits: str) -> RangeReading:
        try:
            range_m, status = decode_value(digits, self._model)
        except FrameError as error:
            self._counters.drop(error.reason)
            return RangeReading(channel, math.nan, RangeStatus.INVALID)
        return RangeReading(channel, range_m, status)

    def _gone_silent(self, now_ns: int) -> list[ChainReading]:
        """Channels that no longer come while others do: told once as STALE."""
        expected = self._channels if self._channels is not None else self._seen_ns.keys()
        limit_ns = max(_STALE_AFTER * self._period_ns, LEAST_SILENCE_NS)
        for channel in expected:
            self._seen_ns.setdefault(channel, now_ns)
        gone = [
            channel
            for channel in sorted(expected)
            if now_ns - self._seen_ns[channel] > limit_ns and channel not in self._silent
        ]
        if not gone:
            return []
        self._silent.update(gone)
        self._counters.drop("channel_silent", len(gone))
        stale = tuple(RangeReading(channel, math.nan, RangeStatus.STALE) for channel in gone)
        return [ChainReading(self._fired_ns(now_ns), stale)]

    def _fired_ns(self, began_ns: int) -> int:
        """When the pulse was sent, as well as can be known: the text comes at the end of a cycle, one period after it.

        A sensor of a family with several periods is taken to have the slowest. Stamps rise strictly.
        """
        stamp_ns = max(began_ns - self._model.period_ns, self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        return stamp_ns
