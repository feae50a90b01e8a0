"""SCIP 2.x, the line protocol of Hokuyo lasers: bytes to checked replies, replies to ranges. Pure.

    request   symbol(2) parameters [;text] LF
    reply     the request's echo LF | status(2) sum LF | lines, each ending in its sum, LF | LF

    text line       VV, PP, II: `KEY:value;` sum, the sum over `KEY:value` only; TM1: stamp(4) sum
    scan            GD GS GE: after status 00; MD MS ME: a reply of its own for each scan, status 99, its echo holding
                    the number of scans that remain.  stamp(4) sum LF, then the values in blocks of 64 characters,
                    each block followed by its sum and LF, the last one shorter
    number          6 bits a character, plus 30h, most significant first: distance 3 characters (MS GS: 2),
                    ME GE distance 3 and intensity 3, stamp 4 (ms)
    SCIP 1.1        an old URG-04LX after power-on: echo LF | `E` LF | LF to what it does not know; `0` to V, SCIP2.0

The sum has 6 bits and does not see order, so a scan must also have exactly the length its echo promises, only
characters that are digits, and an exact echo and status. One changed, lost or inserted byte, or any number of them
with at most one in each line, is then always noticed; what cancels within one line is not (1 of 64 random changes).

Source: Hokuyo "Communication Protocol Specification for SCIP2.0 Standard" C-42-03320B.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers.checksums import scip_sum
from drivers.errors import FrameError
from drivers.readings import F32, F64, SourceCounters

U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]

STAMP_WRAP_MS = 1 << 24  # 4 characters of 6 bits: 16 777.216 s
SHORT_MAX_MM = 4095  # the largest number that MS and GS can say
MAX_REPLY_BYTES = 1 << 16  # the longest reply known has 27 kB (4 321 steps with intensities)
_BLOCK = 64
_ROW = _BLOCK + 2  # a block, its sum, LF

# An echo may have noise before it on its line; a status never.
_HEADER = re.compile(
    rb"(?P<echo>(?:[GM][DSE]\d{10}(?:\d{3})?|VV|PP|II|BM|QT|RS|RB|TM\d|SS\d{6}|CR\d\d|HS\d|%ST|SCIP2\.0|(?:(?<=\n)|\A)V)"
    rb"(?:;[0-9A-Za-z ._+@-]{0,16})?)\n(?P<status>[0-9A-Z]{2}[0-o]|[0E])\n"
)
_ECHO_MAX = 32  # 15 characters, `;`, 16 more
_SCAN_ECHO = re.compile(rb"([GM][DSE])(\d{4})(\d{4})(\d{2})(?:(\d)(\d{2}))?(?:;.*)?")
_KEYED = (b"VV", b"PP", b"II", b"%S")  # text lines of the form KEY:value;


class CodeTable(Enum):
    """What distances below the least one mean: (nothing seen, too close); every other code is invalid.

    Source: SCIP wiki of the maker, error codes by generation. An unknown relative's codes say nothing for sure.
    """

    URG = (frozenset({0}), frozenset[int]())
    UTM = (frozenset({1}), frozenset({4}))
    UNKNOWN = (frozenset[int](), frozenset[int]())

    @staticmethod
    def of_model(model: str) -> CodeTable:
        """The table of a model's generation, by the first letters of its name."""
        family = model.strip().upper()[:3]
        if family in ("URG", "UBG", "UHG"):
            return CodeTable.URG
        if family in ("UTM", "UXM", "UST", "UAM"):
            return CodeTable.UTM
        return CodeTable.UNKNOWN


@dataclass(frozen=True, slots=True)
class Profile:
    """A laser's parameters as its `PP` gives them. Steps count counter-clockwise; step 0 looks to the rear.

    near_limit_mm, far_limit_mm: narrower limits than the device's own, if the user wants such.
    """

    model: str
    range_min_mm: int
    range_max_mm: int
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    turns_per_minute: float
    codes: CodeTable
    near_limit_mm: int = 0
    far_limit_mm: int = 1 << 18

    @property
    def near_mm(self) -> int:
        """The least distance that counts as one; what is nearer is too close."""
        return max(self.range_min_mm, self.near_limit_mm)

    @property
    def far_mm(self) -> int:
        """The largest distance that counts as one."""
        return min(self.range_max_mm, self.far_limit_mm)

    @property
    def turn_ns(self) -> float:
        """One turn of the mirror."""
        return 60e9 / self.turns_per_minute

    @property
    def step_rad(self) -> float:
        """From one step to the next."""
        return float(2.0 * np.pi / self.steps_per_turn)


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """Which steps are asked for, and how: symbol MD, MS, ME (a stream) or GD, GS, GE (the latest scan once).

    cluster: steps joined to one value, the smallest of them; 0 means 1.  skip: scans left out between two sent.
    """

    symbol: str
    first_step: int
    last_step: int
    cluster: int = 1
    skip: int = 0

    @property
    def streams(self) -> bool:
        """Whether replies follow without being asked for."""
        return self.symbol[0] == "M"

    @property
    def values(self) -> int:
        """Number of beams in a reply."""
        return (self.last_step - self.first_step) // max(self.cluster, 1) + 1

    @property
    def value_chars(self) -> int:
        """Characters that one beam takes."""
        return {"S": 2, "D": 3, "E": 6}[self.symbol[1]]

    def command(self, count: int = 0) -> bytes:
        """The request without its line feed; also the echo of a scan after which `count` scans remain (0 endless)."""
        text = f"{self.symbol}{self.first_step:04d}{self.last_step:04d}{self.cluster:02d}"
        return (f"{text}{self.skip:d}{count:02d}" if self.streams else text).encode("ascii")

    def reply_bytes(self) -> int:
        """Length of one scan on the wire, line feeds included."""
        chars = self.values * self.value_chars
        return len(self.command()) + 1 + 4 + 6 + chars + 2 * -(-chars // _BLOCK) + 1

    def step_of_beams(self) -> F64:
        """(values,) the middle step of each beam; the last group may be shorter than the others."""
        start = self.first_step + np.arange(self.values, dtype=np.float64) * max(self.cluster, 1)
        end = np.minimum(start + max(self.cluster, 1) - 1, self.last_step)
        return (start + end) / 2.0


@dataclass(frozen=True, slots=True)
class RawScan:
    """A scan whose sums, length and characters are right, not yet turned into ranges.

    remaining: scans that follow, from the echo (None for GD, GS, GE).  device_ms: 24-bit stamp, head at step 0.
    digits: (values * value_chars,) 0..63.
    """

    request: ScanRequest
    remaining: int | None
    device_ms: int
    digits: U8


@dataclass(frozen=True, slots=True)
class Reply:
    """One whole reply with every sum right.

    status: two characters, or one from SCIP 1.1.  lines: text without sums (and without the `;` of VV, PP, II).
    began_ns, arrived_ns: stamps of the chunks with its first and last byte.  size: bytes, final LF included.
    bytes_after: how much of the last chunk came behind it.
    """

    echo: bytes
    status: str
    lines: tuple[bytes, ...]
    scan: RawScan | None
    began_ns: int
    arrived_ns: int
    size: int
    bytes_after: int


@dataclass(frozen=True, slots=True)
class Sweep:
    """The content of a scan. range_m: (N,) by the rule of drivers.readings.  odd_values: see `decode_scan`."""

    device_ms: int
    range_m: F64
    intensity: F32 | None
    odd_values: int


class ScipReplies:
    """Cuts what arrives into replies. Any chunking gives the same; a damaged reply costs only itself.

    Replies end with an empty line and hold none. Noise before an echo, on its line or on lines before, is cut off.
    """

    def __init__(self, *, counters: SourceCounters | None = None) -> None:
        self.counters = counters if counters is not None else SourceCounters()
        self._buffer = bytearray()
        self._searched = 0
        self._began_ns = 0

    @property
    def is_amid(self) -> bool:
        """Whether a reply has begun that is not complete."""
        return len(self._buffer) > 0

    def clear(self) -> None:
        """Forget a partial reply."""
        self._buffer.clear()
        self._searched = 0

    def feed(self, chunk: bytes, stamp_ns: int) -> Iterator[Reply]:
        """Take bytes that arrived at stamp_ns; the replies that became whole, in order."""
        if not self._buffer:
            self._began_ns = stamp_ns
        self._buffer += chunk
        replies: list[Reply] = []
        start = 0
        while (end := self._buffer.find(b"\n\n", max(start, self._searched))) >= 0:
            block = bytes(self._buffer[start : end + 1]).lstrip(b"\n")
            start = self._searched = end + 2
            if block:
                replies += self._read(block, stamp_ns, len(self._buffer) - start)
            self._began_ns = stamp_ns
        del self._buffer[:start]
        self._searched = max(len(self._buffer) - 1, 0)
        if len(self._buffer) > MAX_REPLY_BYTES:
            self.counters.drop("no_end")
            del self._buffer[: -MAX_REPLY_BYTES // 2]
            self._searched = len(self._buffer) - 1
        return iter(replies)

    def _read(self, block: bytes, stamp_ns: int, bytes_after: int) -> list[Reply]:
        stamps = (self._began_ns, stamp_ns, bytes_after)
        header = _HEADER.match(block)
        reason = "noise"
        if header is not None:
            try:
                return [_read_reply(block, header, *stamps)]
            except FrameError as error:
                reason = error.reason
        # What is damaged may have lost its end, and the whole reply behind it is then in the same block.
        last = _last_header(block)
        if last is None or last.start() == 0:
            self.counters.drop(reason)
            return []
        replies = []
        if header is not None and header["echo"] == b"V":  # a real URG-04LX ends this reply without an empty line
            with contextlib.suppress(FrameError):
                replies.append(_read_reply(block[: last.start()], header, *stamps))
        if not replies:
            self.counters.drop(reason)
        try:
            replies.append(_read_reply(block, last, *stamps))
        except FrameError as error:
            self.counters.drop(error.reason)
        return replies


def decode_number(digits: bytes) -> int:
    """The number that 6-bit characters hold. FrameError if one is not a digit (`0` to `o`)."""
    value = 0
    for byte in digits:
        if not 0x30 <= byte <= 0x6F:
            raise FrameError("bad_character", f"byte {byte:#04x} is not a 6-bit digit")
        value = value << 6 | byte - 0x30
    return value


def encode_number(value: int, chars: int) -> bytes:
    """A number as 6-bit characters. ValueError if it does not fit."""
    if not 0 <= value < 1 << 6 * chars:
        raise ValueError(f"{value} does not fit into {chars} characters of 6 bits")
    return bytes(0x30 + (value >> 6 * place & 0x3F) for place in reversed(range(chars)))


def text_fields(reply: Reply) -> dict[str, str]:
    """The `KEY:value` lines of a VV, PP or II reply. FrameError if a line has no key."""
    fields = {}
    for line in reply.lines:
        key, colon, value = line.decode("ascii", "replace").partition(":")
        if not colon:
            raise FrameError("bad_text", f"{line!r} is not KEY:value")
        fields[key] = value
    return fields


def parse_profile(fields: Mapping[str, str]) -> Profile:
    """The profile in the fields of a PP reply. FrameError("bad_parameters") if they make no sense."""
    try:
        dmin, dmax, ares, amin, amax, afrt, scan = (
            int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
        )
        model = model_name(fields["MODL"])
    except (KeyError, ValueError) as error:
        raise FrameError("bad_parameters", f"PP without a usable value: {error}") from None
    sane = 0 <= dmin < dmax < 1 << 18 and ares > 0 and 0 <= amin < amax <= 9999 and amax - amin <= ares
    if not (sane and 0 <= afrt <= 9999 and 0 < scan < 100_000):
        raise FrameError("bad_parameters", f"PP contradicts itself: {dict(fields)}")
    return Profile(model, dmin, dmax, ares, amin, amax, afrt, float(scan), CodeTable.of_model(model))


def model_name(text: str) -> str:
    """`URG-04LX(Hokuyo Automatic Co.,Ltd.)` -> `URG-04LX`; some units bracket their maker."""
    return re.split(r"[(\[]", text, maxsplit=1)[0].strip()


# Beyond the range limit devices say the limit, a little more, or one of these; other numbers hint at damage.
_SENTINELS = np.array([65533, 65534, 65535, (1 << 18) - 1], dtype=np.int32)


def decode_scan(scan: RawScan, profile: Profile) -> Sweep:
    """Ranges in metres from a scan's digits.

    Below the profile's least distance stand codes: nothing seen becomes +inf, too close -inf, all others NaN. Above
    its largest distance +inf (a 2-character distance ends at 4095 mm, which then means "at least that").
    odd_values counts numbers that no known device says: more than twice the limit and no usual "nothing" mark.
    """
    numbers = _numbers(scan)
    distance_mm, intensity = numbers[0], numbers[1] if len(numbers) == 2 else None
    range_m: F64 = distance_mm / 1000.0
    low = distance_mm < profile.near_mm
    if low.any():
        range_m[low] = _near_ranges(profile.codes, profile.range_min_mm, profile.near_mm)[distance_mm[low]]
    limit_mm = profile.far_mm if scan.request.value_chars != 2 else min(profile.far_mm, SHORT_MAX_MM - 1)
    high = distance_mm > limit_mm
    odd = 0
    if high.any():
        range_m[high] = np.inf
        far = distance_mm[distance_mm > 2 * profile.range_max_mm]
        odd = int(far.size - np.isin(far, _SENTINELS).sum()) if far.size else 0
    return Sweep(scan.device_ms, range_m, None if intensity is None else intensity.astype(np.float32), odd)


def _numbers(scan: RawScan) -> tuple[I32, ...]:
    chars = scan.request.value_chars
    digit = scan.digits.reshape(scan.request.values, chars).astype(np.int32)
    if chars == 2:
        return (digit[:, 0] << 6 | digit[:, 1],)
    return tuple(digit[:, at] << 12 | digit[:, at + 1] << 6 | digit[:, at + 2] for at in range(0, chars, 3))


@lru_cache(maxsize=16)
def _near_ranges(codes: CodeTable, range_min_mm: int, near_mm: int) -> F64:
    """(near_mm,) what each number below near_mm means: a code, or from range_min_mm on an echo that is too close."""
    nothing_seen, too_close = codes.value
    table = np.full(near_mm, np.nan)
    table[range_min_mm:] = -np.inf
    table[[code for code in nothing_seen if code < range_min_mm]] = np.inf
    table[[code for code in too_close if code < range_min_mm]] = -np.inf
    return table


def _last_header(block: bytes) -> re.Match[bytes] | None:
    """The last echo and status in a block: from its end, line by line, at the lines that are as short as a status."""
    line_end = len(block) - 1
    while (line_start := block.rfind(b"\n", 0, line_end) + 1) > 0:
        if line_end - line_start in (1, 3):
            echo_line = block.rfind(b"\n", 0, line_start - 1) + 1
            header = _HEADER.search(block, max(echo_line, line_start - 1 - _ECHO_MAX), line_end + 1)
            if header is not None:
                return header
        line_end = line_start - 1
    return None


def _read_reply(block: bytes, header: re.Match[bytes], began_ns: int, arrived_ns: int, bytes_after: int) -> Reply:
    """The reply that begins at `header` and fills the rest of the block. FrameError names what is wrong."""
    echo, status = header["echo"], header["status"]
    if len(status) == 3:
        if scip_sum(status[:2]) != status[2]:
            raise FrameError("bad_sum", "in the status")
        status = status[:2]
    body_at = header.end()
    scan = None
    lines: tuple[bytes, ...] = ()
    if len(status) == 1:
        lines = _lines_of_scip1(echo, status, block[body_at:])
    elif _holds_scan(echo, status):
        scan = _read_scan(block, body_at, echo)
    else:
        lines = _checked_lines(echo, status, block[body_at:])
    size = len(block) - header.start() + 1
    return Reply(echo, status.decode("ascii"), lines, scan, began_ns, arrived_ns, size, bytes_after)


def _holds_scan(echo: bytes, status: bytes) -> bool:
    if echo[1:2] not in (b"D", b"S", b"E"):
        return False
    return (echo[:1] == b"M" and status == b"99") or (echo[:1] == b"G" and status == b"00")


def _lines_of_scip1(echo: bytes, status: bytes, body: bytes) -> tuple[bytes, ...]:
    """SCIP 1.1 has no sums, so only the forms that matter pass: `E` to anything, `0` to V and SCIP2.0."""
    lines = tuple(body.split(b"\n")[:-1])
    if status == b"E" and not lines:
        return lines
    if status == b"0" and echo == b"V" and lines and all(b":" in line for line in lines):
        return lines
    if status == b"0" and echo == b"SCIP2.0" and not lines:
        return lines
    raise FrameError("bad_status", "neither SCIP 1.1 nor 2")


def _checked_lines(echo: bytes, status: bytes, body: bytes) -> tuple[bytes, ...]:
    lines = body.split(b"\n")[:-1]
    keyed = echo[:2] in _KEYED
    if len(lines) != 0 and not keyed and echo[:3] != b"TM1":
        raise FrameError("bad_length", "lines where the reply has none")
    if status == b"00" and not lines and (keyed or echo[:3] == b"TM1"):
        raise FrameError("bad_length", "no lines where the reply has some")
    return tuple(_checked_line(line, keyed=keyed) for line in lines)


def _checked_line(line: bytes, *, keyed: bool) -> bytes:
    # A value, or the sum itself, may be a `;`: the form is known from the end of the line only.
    text = line[:-2] if keyed else line[:-1]
    if keyed and line[-2:-1] != b";":
        raise FrameError("bad_text", f"{line!r} does not end in `;` and a sum")
    if not text or scip_sum(text) != line[-1]:
        raise FrameError("bad_sum", f"in {line!r}")
    if min(text) < 0x20 or max(text) > 0x7E:
        raise FrameError("bad_character", f"in {line!r}")
    return text


@lru_cache(maxsize=256)
def _parse_echo(echo: bytes) -> tuple[ScanRequest, int | None]:
    match = _SCAN_ECHO.fullmatch(echo)
    if match is None or (match[4] is not None and match[5] is None) != (echo[:1] == b"G"):
        raise FrameError("bad_echo", repr(echo))
    symbol, first, last, cluster = match[1].decode("ascii"), int(match[2]), int(match[3]), int(match[4])
    if last < first:
        raise FrameError("bad_echo", repr(echo))
    if symbol[0] == "G":
        return ScanRequest(symbol, first, last, cluster), None
    return ScanRequest(symbol, first, last, cluster, int(match[5])), int(match[6])


def _read_scan(block: bytes, body_at: int, echo: bytes) -> RawScan:
    request, remaining = _parse_echo(echo)
    chars = request.values * request.value_chars
    whole, rest = divmod(chars, _BLOCK)
    data_at = body_at + 6
    if len(block) - data_at != whole * _ROW + (rest + 2 if rest else 0):
        raise FrameError("bad_length", f"{len(block) - data_at} bytes for {chars} characters")
    stamp = _read_stamp(block, body_at)
    rows_end = data_at + whole * _ROW
    digits = np.empty(chars, dtype=np.uint8)
    if whole:
        rows = np.frombuffer(block, dtype=np.uint8, count=whole * _ROW, offset=data_at).reshape(whole, _ROW)
        data = digits[: whole * _BLOCK].reshape(whole, _BLOCK)
        np.subtract(rows[:, :_BLOCK], 0x30, out=data)
        # 64 times 30h is 0 modulo 64, so the sum of a whole block's digits is the sum of its characters.
        sums = (np.add.reduce(data, axis=1, dtype=np.uint8) & 0x3F) + 0x30
        if not np.array_equal(rows[:, _BLOCK], sums):
            raise FrameError("bad_sum", "in the data")
        if (rows[:, _BLOCK + 1] != 0x0A).any():
            raise FrameError("bad_length", "a block does not end where it should")
    if rest:
        tail = block[rows_end : rows_end + rest]
        if block[rows_end + rest + 1] != 0x0A:
            raise FrameError("bad_length", "the last block does not end where it should")
        if scip_sum(tail) != block[rows_end + rest]:
            raise FrameError("bad_sum", "in the last block")
        np.subtract(np.frombuffer(tail, dtype=np.uint8), 0x30, out=digits[whole * _BLOCK :])
    if digits.max() > 0x3F:
        raise FrameError("bad_character", "in the data")
    return RawScan(request, remaining, stamp, digits)


def _read_stamp(block: bytes, at: int) -> int:
    if block[at + 5] != 0x0A:
        raise FrameError("bad_length", "the stamp's line")
    if scip_sum(block[at : at + 4]) != block[at + 4]:
        raise FrameError("bad_sum", "in the stamp")
    return decode_number(block[at : at + 4])
