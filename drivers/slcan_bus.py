"""CAN adapters on a serial port that speak the Lawicel text protocol (slcan), as a python-can bus.

python-can has such a bus of its own, which reads byte by byte, waits for the line to drain after each frame and fails
with ValueError on a damaged line; this one takes chunks, counts damaged lines, notices an adapter that refuses all
frames, and costs a fraction (figures: docs/devices/can.md). It answers to the same API: any can.BusABC user works.

    every line ends CR (0D), a refusal is BEL (07)
    C, S0..S8, O        close, bit rate (only while closed), open
    tiiil[dd..]         data frame: id 3 hex digits, length 0..8, data; Tiiiiiiiil.. with 8 id digits when extended
    riiil, Riiiiiiiil   remote frames
    z, Z, (nothing)     answers to frames accepted; received frames may end with a 4 digit time stamp

Source: command set of the Lawicel CANUSB and CAN232 manuals.
"""

from __future__ import annotations

import re
from collections import deque
from typing import Protocol

import can

from drivers.conversation import CanFrame
from drivers.errors import PortError
from drivers.ports import Clock, Port, SerialPort

_RATE_COMMANDS = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    800_000: "S7",
    1_000_000: "S8",
}
_LINE = re.compile(rb"([tr])([0-7][0-9A-Fa-f]{2})([0-8])|([TR])([01][0-9A-Fa-f]{7})([0-8])")
_HEX = re.compile(rb"[0-9A-Fa-f]*")
_LONGEST_LINE = 64  # a frame needs at most 30 characters
_REFUSALS = 8  # so many BELs in a row, and nothing else heard: the adapter is closed or bus-off
_MOST_QUEUED = 10_000
_READS_MAX = 4


class Line(Port[bytes], Protocol):
    """What the adapter hangs on."""

    @property
    def name(self) -> str:
        """For messages."""

    def discard_input(self) -> None:
        """Throw away what arrived but was not read."""


class LawicelBus(can.BusABC):
    """A CAN adapter at the end of a serial line. Raises PortError (and its family) when the line is lost.

    channel: path of the serial port, "@115200" may follow.  drops: counts `slcan_malformed`, `slcan_refused`.
    line: used instead of opening that port.
    """

    def __init__(
        self,
        channel: str,
        *,
        bitrate_bps: int,
        clock: Clock,
        drops: dict[str, int] | None = None,
        line: Line | None = None,
    ) -> None:
        if bitrate_bps not in _RATE_COMMANDS:
            rates = ", ".join(str(rate) for rate in _RATE_COMMANDS)
            raise PortError(f"an slcan adapter cannot run at {bitrate_bps} bit/s: choose one of {rates}")
        path, _, baud = channel.partition("@")
        self.drops = drops if drops is not None else {}
        self.channel_info = f"slcan on {path}"
        speed = int(baud) if baud.isdigit() else 115200
        self._clock = clock
        self._line: Line = SerialPort(path, baud=speed, clock=clock) if line is None else line
        self._buffer = bytearray()
        self._frames: deque[tuple[CanFrame, int]] = deque()
        self._refusals = 0
        self._answered = False  # before the first frame came or was taken, a refusal is to closing what was not open
        self._line.discard_input()
        # Empty lines end whatever the adapter had half received; it may be open still, so close it first.
        self._line.write(f"\r\r\rC\r{_RATE_COMMANDS[bitrate_bps]}\rO\r".encode())
        super().__init__(channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; the serial port's write time-out applies."""
        self._line.write(
            encode_line(msg.arbitration_id, bytes(msg.data), msg.is_extended_id, msg.is_remote_frame, msg.dlc)
        )

    def shutdown(self) -> None:
        """Close the adapter and the port."""
        if self._is_shutdown:
            return
        try:
            self._line.write(b"C\r")
        except PortError:
            pass  # gone already
        finally:
            super().shutdown()
            self._line.close()

    def fileno(self) -> int:
        descriptor = self._line.fileno()
        return -1 if descriptor is None else descriptor

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame; None after timeout, or sooner if what arrived was no frame. Waits by no clock."""
        frames = self.frames(1.0 if timeout is None else max(timeout, 0.0), 1)
        return _message_of(*frames[0]) if frames else None

    def frames(self, timeout_s: float, most: int) -> list[tuple[CanFrame, int]]:
        """Up to `most` frames with their arrival times, as our drivers take them.

        The adapter's answers and beginnings of lines do not end the wait, up to a few of them: each would cost the
        reader a turn, and after every frame sent there is an answer.
        """
        left_s, end_ns = timeout_s, self._clock() + round(timeout_s * 1e9)
        for _ in range(_READS_MAX):
            if self._frames:
                break
            chunks = self._line.read(left_s)
            for chunk, stamp_ns in chunks:
                self._take(chunk, stamp_ns)
            left_s = (end_ns - self._clock()) / 1e9
            if not chunks or left_s <= 0.0:
                break
        return [self._frames.popleft() for _ in range(min(most, len(self._frames)))]

    def put(self, frame: CanFrame) -> None:
        """Send one frame of ours, without the detour over a can.Message; as send() otherwise."""
        length = frame.dlc if frame.remote and frame.dlc is not None else len(frame.data)
        self._line.write(encode_line(frame.can_id, frame.data, frame.extended, frame.remote, length))

    def _take(self, chunk: bytes, stamp_ns: int) -> None:
        self._buffer += chunk
        *lines, rest = self._buffer.replace(b"\a", b"\a\r").split(b"\r")
        if len(rest) > _LONGEST_LINE:
            self._count("slcan_malformed")
            rest = rest[-1:]  # no line is that long; keep an eye open for the next CR
        self._buffer = bytearray(rest)
        for line in lines:
            self._take_line(bytes(line), stamp_ns)

    def _take_line(self, line: bytes, stamp_ns: int) -> None:
        if line.endswith(b"\a"):
            self._note_refusal()
            return
        if line in (b"", b"z", b"Z"):
            self._refusals = 0
            self._answered = self._answered or line != b""  # empty lines are answered by a closed adapter, too
            return
        frame = decode_line(line)
        if frame is None:
            if line[:1] not in b"VNFv":  # answers to questions that others on this adapter may have put
                self._count("slcan_malformed")
            return
        self._refusals = 0
        self._answered = True
        if len(self._frames) >= _MOST_QUEUED:
            self._count("slcan_overrun")
            self._frames.popleft()
        self._frames.append((frame, stamp_ns))

    def _note_refusal(self) -> None:
        if self._answered:
            self._count("slcan_refused")
        self._refusals += 1
        if self._refusals >= _REFUSALS:
            self._refusals = 0
            raise PortError(
                f"the adapter on {self._line.name} refuses every frame: it lost its power for a moment or is bus-off; "
                "it is closed and opened again; if this goes on, check wiring, termination and the bit rate"
            )

    def _count(self, reason: str) -> None:
        self.drops[reason] = self.drops.get(reason, 0) + 1


def _message_of(frame: CanFrame, stamp_ns: int) -> can.Message:
    return can.Message(
        timestamp=stamp_ns / 1e9,
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        dlc=frame.dlc if frame.dlc is not None else len(frame.data),
        data=None if frame.remote else frame.data,
    )


def encode_line(can_id: int, data: bytes, extended: bool, remote: bool, dlc: int) -> bytes:
    """One frame as the line that sends it. dlc counts for remote frames only."""
    kind = ("R" if extended else "r") if remote else ("T" if extended else "t")
    head = f"{kind}{can_id:08X}" if extended else f"{kind}{can_id:03X}"
    return f"{head}{dlc}\r".encode() if remote else f"{head}{len(data)}{data.hex().upper()}\r".encode()


def decode_line(line: bytes) -> CanFrame | None:
    """The frame in one line (without its CR), or None if it is none: wrong length, not hex, id out of range."""
    match = _LINE.match(line)
    if match is None:
        return None
    kind = match[1] or match[4]
    length = int(match[3] or match[6])
    tail = line[match.end() :]
    remote = kind in b"rR"
    wanted = 0 if remote else 2 * length
    if len(tail) not in (wanted, wanted + 4) or not _HEX.fullmatch(tail):  # 4 more: the adapter's time stamp
        return None
    return CanFrame(
        can_id=int(match[2] or match[5], 16),
        data=bytes.fromhex(tail[:wanted].decode()),
        extended=kind in b"TR",
        remote=remote,
        dlc=length if remote else None,
    )
