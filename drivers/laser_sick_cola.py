"""SICK lasers that speak CoLa binary: TiM5xx, TiM7xx, LMS1xx and relatives, over TCP. Bytes in, scans out. Pure.

    bring-up   who is it (DeviceIdent) -> subscribe to scans (sEN LMDscandata 1)
               -> where none come: log in, start measuring, run
    then       a scan per turn, each checked by sum, layout and the scanner's serial number
    after      silence, nonsense: from the beginning; the port reopens a connection on which nothing is heard

Geometry: angles are counter-clockwise and 90 degrees is ahead, so bearing = angle - 90 degrees. Time: each scan has the
scanner's own time of the scan and of sending; the latter is fitted to the host's clock at arrival.
Telegrams: cola.py; quirks: docs/devices/sick_cola.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence

import numpy as np

from drivers.clock_fit import DeviceClock
from drivers.cola import (
    Channel,
    ScanData,
    Telegram,
    TelegramReader,
    decode_identity,
    encode_telegram,
    exact_step_deg,
    trouble_of_status,
)
from drivers.conversation import SetBaudRate
from drivers.readings import F64, ClockFit, Identity, LinkState, Reading, ScanReading
from drivers.scripted import ScriptedConversation, Step, pause
from drivers.turns import Limits, NoEcho

_MS = 1_000_000
REPLY_NS = 500 * _MS
FIRST_SCAN_NS = 2_000 * _MS
STARTED_SCAN_NS = 12_000 * _MS  # the laser of an LMS1xx that was off
FIRST_DISTANCE = 16  # lower values are codes
CLOCK_WRAP_NS = (1 << 32) * 1_000
CLOCK_PATIENCE = 8
RANGE_MIN_M = 0.05
_RANGE_MAX_M = {"TiM5": 10.0, "TiM7": 25.0, "LMS1": 20.0, "LMS5": 80.0}
_RANGE_MAX_OTHERS_M = 25.0

IDENTIFY = encode_telegram(b"sRN DeviceIdent")
ASK_STATE = encode_telegram(b"sRN SCdevicestate")
SUBSCRIBE = encode_telegram(b"sEN LMDscandata \x01")
UNSUBSCRIBE = encode_telegram(b"sEN LMDscandata \x00")
LOG_IN = encode_telegram(b"sMN SetAccessMode \x03\xf4\x72\x47\x44")  # authorised client, as delivered
START_MEASURING = encode_telegram(b"sMN LMCstartmeas")
RUN = encode_telegram(b"sMN Run")

_Script = Generator[Step[Telegram], Telegram | None, bool]


class SickColaConversation(ScriptedConversation[Telegram]):
    """A `Conversation[bytes]` with a SICK laser that speaks CoLa binary. No argument is needed.

    ahead_deg: the scanner's angle that looks ahead.  range_min_m, range_max_m: default by model.  no_echo: what a
    distance of 0 means.  start: log in and start the measurement where it does not run.
    """

    def __init__(
        self,
        *,
        ahead_deg: float = 90.0,
        range_min_m: float = RANGE_MIN_M,
        range_max_m: float | None = None,
        no_echo: NoEcho = "unknown",
        start: bool = True,
    ) -> None:
        self._ahead_deg = ahead_deg
        self._range_min_m = range_min_m
        self._range_max_m = range_max_m
        self._no_echo: NoEcho = no_echo
        self._may_start = start
        super().__init__()
        self._telegrams = TelegramReader(self._counters)
        self._clock = DeviceClock(wrap_ns=CLOCK_WRAP_NS, tick_ns=1_000)
        self._forget()

    def _forget(self) -> None:
        self._telegrams.clear()
        self._name = ("", "")
        self._serial: int | None = None
        self._other_serials = 0
        self._odd_tails = 0
        self._refused_stamps = 0
        self._newest_ns: int | None = None
        self._bearing: tuple[tuple[float, float, int], F64] | None = None

    @property
    def clock_fit(self) -> ClockFit | None:
        """The scanner's microsecond clock against the host's."""
        return self._clock.fit

    def farewell(self) -> Sequence[bytes | SetBaudRate]:
        """Ends the subscription; the scanner goes on measuring, as it does from power-on."""
        return [UNSUBSCRIBE]

    # The script.

    def _life(self) -> Generator[Step[Telegram], Telegram | None, None]:
        while True:
            self._period_ns = None
            yield from self._find()
            if self._state is LinkState.SILENT:
                self._state = LinkState.STARTING
                self._trouble = None
            if (yield from self._subscribe()) and (yield from self._has_scans()):
                yield from self._watch()
            else:
                yield pause(500 * _MS)

    def _find(self) -> Generator[Step[Telegram], Telegram | None, None]:
        """Ask who it is, how it is, for scans (some know those only), until anything in CoLa binary comes back."""
        while True:
            heard_bytes = self._counters.bytes
            if (yield from self._answers(IDENTIFY)):
                return
            self._tell_silence(heard_bytes)
            if (yield from self._answers(ASK_STATE)):
                yield from self._answers(IDENTIFY)
                self._note_identity()
                return
            if (yield from self._answers(SUBSCRIBE)):
                self._note_identity()
                return

    def _answers(self, question: bytes) -> _Script:
        """Whether anything comes back; a name is kept."""
        reply = yield Step((question,), lambda reply: reply.scan is None, REPLY_NS)
        if reply is not None and reply.payload.startswith(b"sRA DeviceIdent"):
            self._name = decode_identity(reply.payload)
            self._note_identity()
        return reply is not None

    def _tell_silence(self, heard_bytes: int) -> None:
        self._state = LinkState.SILENT
        if self._counters.bytes > heard_bytes:
            self._trouble = (
                "answers, but not in CoLa binary: set its protocol to CoLa B (SOPAS: network, CoLa dialect binary)"
            )
        else:
            self._trouble = "is connected but does not answer: is this the CoLa port (2112 or 2111)?"

    def _subscribe(self) -> _Script:
        self._period_ns = 100.0 * _MS  # scans may follow the reply in the same chunk
        for _ in range(2):
            reply = yield Step((SUBSCRIBE,), _starts(b"sEA LMDscandata", b"sSN LMDscandata", b"sFA"), REPLY_NS)
            if reply is not None and not reply.payload.startswith(b"sFA"):
                return True
        self._trouble = "refuses to send scans (sEN LMDscandata): is it a 2D scanner with this telegram?"
        return False

    def _has_scans(self) -> _Script:
        """Whether scans come; if not, the measurement is started once and waited for."""
        if (yield from self._awaits_scans(FIRST_SCAN_NS)):
            return True
        if not self._may_start:
            self._trouble = "measures nothing: start it, or set start = true"
            return False
        self._trouble = "measures nothing, is being started"
        yield Step((LOG_IN,), _starts(b"sAN SetAccessMode", b"sFA"), REPLY_NS)
        yield Step((START_MEASURING,), _starts(b"sAN LMCstartmeas", b"sFA"), REPLY_NS)
        yield Step((RUN,), _starts(b"sAN Run", b"sFA"), REPLY_NS)
        yield Step((SUBSCRIBE,), _starts(b"sEA LMDscandata", b"sSN LMDscandata", b"sFA"), REPLY_NS)
        if (yield from self._awaits_scans(STARTED_SCAN_NS)):
            return True
        self._trouble = "sends no scans although it was started: is it in standby, or being configured by SOPAS?"
        return False

    def _awaits_scans(self, wait_ns: int) -> _Script:
        """Whether a scan comes. Meanwhile it is asked how it is: a TCP connection on which nothing comes looks dead."""
        questions: tuple[bytes, ...] = ()
        for _ in range(wait_ns // REPLY_NS):
            if (yield Step(questions, lambda telegram: telegram.scan is not None, REPLY_NS)) is not None:
                return True
            questions = (ASK_STATE,)
        return False

    def _note_identity(self) -> None:
        serial = "" if self._serial is None else f"{self._serial:08d}"
        self._identity = Identity("SICK", self._name[0] or "CoLa scanner", serial, self._name[1])

    # Telegrams and scans.

    def _messages(self, chunk: bytes, stamp_ns: int) -> Iterable[Telegram]:
        return self._telegrams.feed(chunk, stamp_ns)

    def _take(self, telegram: Telegram, stamp_ns: int) -> Iterator[Reading]:
        scan = telegram.scan
        if scan is None:
            return
        if self._period_ns is None:
            self._counters.drop("leftover_scan")
            return
        distance = scan.channels.get("DIST1")
        if distance is None or len(distance.raw) == 0:
            self._counters.drop("no_distances")
            return
        if not self._believes(scan):
            return
        first_ns = self._first_beam_ns(scan, distance, telegram.arrived_ns)
        if first_ns is not None:
            self._standing_trouble = trouble_of_status(scan.status)
            yield self._reading(scan, distance, first_ns)

    def _believes(self, scan: ScanData) -> bool:
        """The sum has 8 bits only: another serial number or an odd end is damage, unless it is so again and again."""
        self._odd_tails = self._odd_tails + 1 if scan.tail_is_odd else 0
        if 0 < self._odd_tails < 3:
            self._counters.drop("odd_tail")
            return False
        if self._serial is not None and scan.serial != self._serial:
            self._other_serials += 1
            if self._other_serials < 3:
                self._counters.drop("other_serial")
                return False
        self._other_serials = 0
        if scan.serial != self._serial:
            self._serial = scan.serial
            self._note_identity()
        return True

    def _first_beam_ns(self, scan: ScanData, distance: Channel, arrived_ns: int) -> int | None:
        """Host time of the first beam: by the scanner's clock, but never so late that a beam came after its bytes.

        The time of the scan is said to be its begin. Where the sweep does not fit between it and the sending (6 ms
        apart on a TiM, whose sweep takes 50), it can only be the sweep's end.
        """
        beam_ns = self._beam_ns(scan, distance)
        sweep_ns = beam_ns * (len(distance.raw) - 1)
        turn_ns = 1e9 / scan.scans_per_s
        self._period_ns = turn_ns
        placed = self._clock.place(scan.sent_us * 1_000, arrived_ns, period_ns=turn_ns)
        first_ns = arrived_ns - sweep_ns
        if placed is not None:
            self._refused_stamps = 0
            before_ns = (scan.sent_us - scan.scan_us) % (1 << 32) * 1_000
            since_first_ns = before_ns if before_ns >= sweep_ns else before_ns + sweep_ns
            if before_ns < 2 * turn_ns:
                first_ns = min(first_ns, placed[1] - since_first_ns)
        else:
            self._refused_stamps += 1
            if self._refused_stamps < CLOCK_PATIENCE:
                self._counters.drop("implausible_stamp")
                return None
        stamp_ns = round(first_ns)
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            self._counters.drop("implausible_stamp")
            return None
        self._newest_ns = stamp_ns
        return stamp_ns

    def _beam_ns(self, scan: ScanData, distance: Channel) -> float:
        return exact_step_deg(distance.step_deg) / 360.0 / scan.scans_per_s * 1e9

    def _reading(self, scan: ScanData, distance: Channel, first_ns: int) -> ScanReading:
        limits = self._limits()
        range_m = limits.ranges(distance.scaled / 1000.0)
        range_m[(distance.raw > 0) & (distance.raw < FIRST_DISTANCE)] = math.nan
        if self._no_echo == "unknown":
            range_m[distance.raw == 0] = math.nan
        intensity = scan.channels.get("RSSI1")
        if intensity is not None and len(intensity.raw) != len(distance.raw):
            intensity = None
        return ScanReading(
            stamp_ns=first_ns,
            beam_period_ns=self._beam_ns(scan, distance),
            scan_period_ns=round(1e9 / scan.scans_per_s),
            bearing_rad=self._bearings(distance),
            range_m=range_m,
            range_min_m=limits.range_min_m,
            range_max_m=limits.range_max_m,
            intensity=None if intensity is None else intensity.raw.astype(np.float32),
            device_stamp_ns=scan.scan_us * 1_000,
        )

    def _limits(self) -> Limits:
        by_model = next((far for name, far in _RANGE_MAX_M.items() if self._name[0].startswith(name)), None)
        far_m = self._range_max_m or by_model or _RANGE_MAX_OTHERS_M
        return Limits(self._range_min_m, far_m, self._no_echo)

    def _bearings(self, distance: Channel) -> F64:
        """Made once for as long as the field stays the same."""
        field = (distance.first_deg, distance.step_deg, len(distance.raw))
        if self._bearing is None or self._bearing[0] != field:
            angle = distance.first_deg + exact_step_deg(distance.step_deg) * np.arange(len(distance.raw))
            bearing = np.radians(angle - self._ahead_deg)
            bearing.setflags(write=False)
            self._bearing = (field, bearing)
        return self._bearing[1]


def _starts(*heads: bytes) -> Callable[[Telegram], bool]:
    return lambda telegram: telegram.payload.startswith(heads)
