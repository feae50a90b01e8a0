"""Wires: a serial line, a CAN bus or a TCP connection behind one small Protocol.

A port moves bytes or frames and knows no device. Opening is what the constructor does. What arrives leaves `read`
at once, with its arrival time; nothing polls, nothing waits without a deadline. Any failure raises an error of the
PortError family whose text names the port and the repair; the port is then to be closed and opened anew.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import os
import select
import socket
import struct
import termios
import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import serial

from drivers.conversation import CanFrame, SetBaudRate, WireT
from drivers.errors import PortAbsent, PortBusy, PortDenied, PortError

if TYPE_CHECKING:
    import can

    from drivers.slcan_bus import LawicelBus

T = TypeVar("T")
Clock = Callable[[], int]

_READ_SIZE = 65536
_CHECK_PERIOD_NS = 200_000_000  # how often an idle serial line is asked whether it is still the one under its name


class Direction(StrEnum):
    """What a tap hears of."""

    IN = "in"  # item: what arrived, at its arrival time
    OUT = "out"  # item: what was sent, or SetBaudRate, at the time given to requests()
    CONNECTED = "connected"  # item: name of the source whose conversation was (re)started
    LOST = "lost"  # item: why the wire was given up
    TURN = "turn"  # requests() is called with this time, before what is then sent; item: "": of every conversation,
    # else the names of those of which it is, one a line


Tap = Callable[[Direction, int, "bytes | CanFrame | SetBaudRate | str"], None]
"""Hears everything on a wire, for the raw recording: (direction, stamp_ns, item). Must not block."""


class Port(Protocol[WireT]):
    """An open wire. `silence_reopen_s`: reopen when nothing at all came for so long (None: silence proves nothing)."""

    @property
    def silence_reopen_s(self) -> float | None: ...

    @property
    def drops(self) -> dict[str, int]:
        """What this wire threw away or failed to send, by reason."""

    def read(self, timeout_s: float) -> list[tuple[WireT, int]]:
        """What arrived, each with its arrival stamp; returns as soon as there is anything, [] after timeout_s."""

    def write(self, item: WireT) -> None:
        """Send, waiting no longer than the port's write time-out."""

    def set_baud(self, bits_per_s: int) -> None:
        """Change the line speed after what was written has left. Without meaning (ignored) but on serial lines."""

    def close(self) -> None:
        """Give the wire back; never raises, never hangs."""

    def fileno(self) -> int | None:
        """A descriptor to select on, or None."""


class SerialPort:
    """A serial line, 8N1, locked against a second program that asks for the lock too (pyserial's flock).

    Pseudo terminals are welcome: what they lack (modem lines, low latency flag) is skipped.
    dtr: level of the line DTR while open (default: on).  dtr_at_close: level to leave it at; by default the system
    switches it off. On an RPLIDAR A1 it stops the motor.
    """

    silence_reopen_s: float | None = None  # reopening resets boards that watch DTR, so silence alone is no reason

    def __init__(
        self,
        path: str,
        *,
        baud: int = 115200,
        clock: Clock,
        write_timeout_s: float = 0.25,
        dtr: bool = True,
        dtr_at_close: bool | None = None,
    ) -> None:
        self.name = path
        self.drops: dict[str, int] = {}
        self._clock = clock
        self._write_timeout_ns = int(write_timeout_s * 1e9)
        self._dtr_at_close = dtr_at_close
        try:
            self._serial = serial.Serial(None, baud, timeout=0, write_timeout=0, exclusive=True)
            self._serial.port = path
            self._serial.dtr = dtr  # set on opening, where there is such a line
            self._serial.open()
        except (OSError, ValueError, termios.error) as error:  # serial.SerialException is an OSError
            raise _opening_failed(path, error) from error
        self._fd = self._serial.fileno()
        with contextlib.suppress(OSError, ValueError, termios.error, NotImplementedError):
            self._serial.set_low_latency_mode(True)  # FTDI chips gather bytes for 16 ms otherwise
        self._device_number = os.fstat(self._fd).st_rdev
        self._poll_in = select.poll()
        self._poll_in.register(self._fd, select.POLLIN)
        self._poll_out = select.poll()
        self._poll_out.register(self._fd, select.POLLOUT)
        self._empty_reads = 0
        self._checked_ns = clock()

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        """One chunk with its arrival time, or nothing. Raises PortAbsent when the device has gone."""
        ready = self._poll_in.poll(timeout_s * 1e3)
        if not ready:
            self._check_name()
            return []
        try:
            chunk = os.read(self._fd, _READ_SIZE)
        except BlockingIOError:
            return []
        except OSError as error:
            raise _lost(self.name, str(error)) from error
        stamp_ns = self._clock()
        if chunk:
            self._empty_reads = 0
            return [(chunk, stamp_ns)]
        # Readable but empty: hung up, unless a second reader was faster than we.
        self._empty_reads += 1
        if ready[0][1] & (select.POLLHUP | select.POLLERR | select.POLLNVAL) or self._empty_reads >= 3:
            raise _lost(self.name, "hung up")
        return []

    def write(self, item: bytes) -> None:
        """Send all bytes; PortError if the line takes none for the write time-out."""
        rest = memoryview(item)
        deadline_ns = self._clock() + self._write_timeout_ns
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                self._await_writable(deadline_ns)
            except OSError as error:
                raise _lost(self.name, str(error)) from error

    def set_baud(self, bits_per_s: int) -> None:
        """Change speed once the bytes written before have left at the old one."""
        try:
            self._drain(self._clock() + self._write_timeout_ns)
            self._serial.baudrate = bits_per_s
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f"{self.name} cannot be set to {bits_per_s} bit/s: {error}") from error

    def discard_input(self) -> None:
        """Throw away what arrived but was not read."""
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self._fd, termios.TCIFLUSH)

    def close(self) -> None:
        """Close; what was written gets a moment to leave, a stuck line is cut off rather than waited for."""
        with contextlib.suppress(OSError, termios.error):
            if not self._drain(self._clock() + self._write_timeout_ns):
                termios.tcflush(self._fd, termios.TCOFLUSH)  # else close itself may wait 30 s
        if self._dtr_at_close is not None:
            self._leave_dtr(self._dtr_at_close)
        with contextlib.suppress(OSError, termios.error):
            self._serial.close()

    def fileno(self) -> int:
        return self._fd

    def _leave_dtr(self, level: bool) -> None:
        """The system lowers modem lines on closing, unless told not to."""
        with contextlib.suppress(OSError, termios.error):
            settings = termios.tcgetattr(self._fd)
            settings[2] &= ~termios.HUPCL
            termios.tcsetattr(self._fd, termios.TCSANOW, settings)
        with contextlib.suppress(OSError, termios.error):
            self._serial.dtr = level

    def _await_writable(self, deadline_ns: int) -> None:
        left_ms = (deadline_ns - self._clock()) / 1e6
        if left_ms <= 0 or not self._poll_out.poll(left_ms):
            raise PortError(
                f"{self.name} takes no bytes for {self._write_timeout_ns / 1e9:.2f} s: is the device powered and its "
                "flow control off?"
            )

    def _drain(self, deadline_ns: int) -> bool:
        """Wait until the driver's output queue is empty; False if it is not by the deadline."""
        while True:
            waiting = struct.unpack("i", fcntl.ioctl(self._fd, termios.TIOCOUTQ, b"\0\0\0\0"))[0]
            if waiting == 0:
                termios.tcdrain(self._fd)  # only the transmitter's own few bytes are left
                return True
            if self._clock() >= deadline_ns:
                return False
            time.sleep(0.001)

    def _check_name(self) -> None:
        """A silent line may be one whose device came back elsewhere: does the name still lead to what we opened?"""
        now_ns = self._clock()
        if now_ns - self._checked_ns < _CHECK_PERIOD_NS:
            return
        self._checked_ns = now_ns
        try:
            device_number = os.stat(self.name).st_rdev
        except OSError as error:
            raise _lost(self.name, error.strerror or "gone") from error
        if device_number != self._device_number:
            raise _lost(self.name, "the name leads to another device now")


class TcpPort:
    """A byte stream over TCP. A half-open connection shows only as silence: see silence_reopen_s."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        clock: Clock,
        connect_timeout_s: float = 0.5,
        write_timeout_s: float = 0.25,
        silence_reopen_s: float | None = 1.5,
    ) -> None:
        self.name = f"tcp://{host}:{port}"
        self.drops: dict[str, int] = {}
        self.silence_reopen_s = silence_reopen_s
        self._clock = clock
        try:
            self._socket = socket.create_connection((host, port), timeout=connect_timeout_s)
        except OSError as error:
            raise PortAbsent(
                f"no answer from {self.name} ({error}): is the device powered, the address right "
                f"(`ping {host}`), and no other host connected to it?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(write_timeout_s)
        self._poll = select.poll()
        self._poll.register(self._socket.fileno(), select.POLLIN)

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        """One chunk with its arrival time, or nothing. Raises PortAbsent when the peer closed."""
        if not self._poll.poll(timeout_s * 1e3):
            return []
        try:
            chunk = self._socket.recv(_READ_SIZE)
        except TimeoutError:
            return []
        except OSError as error:
            raise _lost(self.name, str(error)) from error
        if not chunk:
            raise _lost(self.name, "closed by the device")
        return [(chunk, self._clock())]

    def write(self, item: bytes) -> None:
        """Send all bytes; PortError if that takes longer than the write time-out."""
        try:
            self._socket.sendall(item)
        except OSError as error:  # TimeoutError is one
            raise _lost(self.name, str(error)) from error

    def set_baud(self, bits_per_s: int) -> None:
        """A network line has no speed to set."""

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()


_CAN_BATCH = 256  # frames handed out by one read, so that requests keep their turn under a flood
_CAN_ERR_BUSOFF = 0x40  # linux/can/error.h: class bits in the id of an error frame


class CanPort:
    """One member of a CAN bus, through python-can.

    interface: any of python-can's; "socketcan" on a robot, "slcan" for adapters on a serial port (our own receiver,
    see slcan_bus.py), "virtual" inside one process.  channel: "can0", "/dev/ttyACM0", a name.
    bitrate_bps: used where the interface sets it (a socketcan interface is set up by `ip link`).
    """

    def __init__(
        self,
        *,
        interface: str = "socketcan",
        channel: str,
        bitrate_bps: int = 1_000_000,
        clock: Clock,
        write_timeout_s: float = 0.1,
        silence_reopen_s: float | None = 1.5,
    ) -> None:
        self.name = f"{interface}:{channel}"
        self.drops: dict[str, int] = {}
        # An adapter that lost its power keeps its serial port but has forgotten to be open: begin anew.
        self.silence_reopen_s = silence_reopen_s if interface != "virtual" else None
        self._clock = clock
        self._write_timeout_s = write_timeout_s
        self._repair = _can_repair(interface, channel, bitrate_bps)
        import can  # here, because robots without a CAN bus need not load it

        self._can = can
        self._slcan: LawicelBus | None = None
        try:
            self._bus = self._open(interface, channel, bitrate_bps)
        except PortError:
            raise
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise self._opening_failed(error) from error
        self._more_waiting = False
        self._poll = self._make_poll()

    def read(self, timeout_s: float) -> list[tuple[CanFrame, int]]:
        """All frames that wait, each with its arrival time. Raises PortError when the interface is gone or bus-off."""
        if self._slcan is not None:  # one wait and one read, where python-can's way takes three of each
            bus = self._slcan
            return self._guarded(lambda: bus.frames(timeout_s, _CAN_BATCH))
        frames: list[tuple[CanFrame, int]] = []
        if self._poll is not None:
            # python-can's own waiting goes by the wall clock: set back by an hour, it would wait for an hour.
            if not self._more_waiting:
                self._poll.poll(timeout_s * 1e3)
            timeout_s = 0.0
        message = self._receive(timeout_s)
        stamp_ns = self._clock()
        while message is not None:
            if message.is_error_frame:
                self._note_error_frame(message)
            elif message.is_fd:
                self.drops["fd_frame"] = self.drops.get("fd_frame", 0) + 1
            else:
                frames.append((_frame_of(message), stamp_ns))
            if len(frames) >= _CAN_BATCH:
                break
            message = self._receive(0.0)
        self._more_waiting = message is not None
        return frames

    def write(self, item: CanFrame) -> None:
        """Send one frame. A full transmit queue (nobody acknowledges) loses it and counts `tx_full`."""
        if (slcan := self._slcan) is not None:
            self._guarded(lambda: slcan.put(item))
            return
        message = self._can.Message(
            arbitration_id=item.can_id,
            is_extended_id=item.extended,
            is_remote_frame=item.remote,
            dlc=item.dlc if item.remote and item.dlc is not None else len(item.data),
            data=None if item.remote else item.data,
        )
        try:
            self._bus.send(message, timeout=self._write_timeout_s)
        except PortError:
            raise
        except (self._can.CanError, OSError) as error:
            if _errno_of(error) == errno.ENOBUFS:
                self.drops["tx_full"] = self.drops.get("tx_full", 0) + 1
                return
            raise PortError(f"{self.name} was lost ({error}): {self._repair}") from error

    def set_baud(self, bits_per_s: int) -> None:
        """A CAN bus has one speed, set when it is opened."""

    def close(self) -> None:
        with contextlib.suppress(Exception):  # back ends raise what they like from a dead interface
            self._bus.shutdown()

    def fileno(self) -> int | None:
        try:
            return self._bus.fileno()
        except NotImplementedError:
            return None

    def _make_poll(self) -> select.poll | None:
        """None for a bus without a descriptor, such as the virtual one."""
        descriptor = self.fileno()
        if descriptor is None or descriptor < 0:
            return None
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        return poll

    def _open(self, interface: str, channel: str, bitrate_bps: int) -> can.BusABC:
        if interface == "slcan":
            from drivers.slcan_bus import LawicelBus

            self._slcan = LawicelBus(channel, bitrate_bps=bitrate_bps, clock=self._clock, drops=self.drops)
            return self._slcan
        # ignore_config: a ~/.canrc of the user must not change which bus this is.
        if interface in ("socketcan", "virtual"):
            return self._can.Bus(interface=interface, channel=channel, ignore_config=True)
        return self._can.Bus(interface=interface, channel=channel, ignore_config=True, bitrate=bitrate_bps)

    def _receive(self, timeout_s: float) -> can.Message | None:
        return self._guarded(lambda: self._bus.recv(timeout_s))

    def _guarded(self, work: Callable[[], T]) -> T:
        try:
            return work()
        except PortError:
            raise
        except (self._can.CanError, OSError, ValueError) as error:
            raise PortError(f"{self.name} was lost ({error}): {self._repair}") from error

    def _note_error_frame(self, message: can.Message) -> None:
        if message.arbitration_id & _CAN_ERR_BUSOFF:
            raise PortError(
                f"{self.name} is bus-off: check wiring, termination (120 ohm at both ends) and that all members use "
                f"one bit rate; {self._repair}"
            )
        self.drops["bus_error"] = self.drops.get("bus_error", 0) + 1

    def _opening_failed(self, error: Exception) -> PortError:
        code = _errno_of(error)
        if code in (errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EAFNOSUPPORT):
            return PortAbsent(f"no {self.name} ({error}): {self._repair}")
        if code in (errno.EACCES, errno.EPERM):
            return PortDenied(f"no permission on {self.name} ({error}): {self._repair}")
        return PortError(f"{self.name} cannot be opened ({error}): {self._repair}")


def _frame_of(message: can.Message) -> CanFrame:
    remote = message.is_remote_frame
    return CanFrame(
        can_id=message.arbitration_id,
        data=b"" if remote else bytes(message.data),
        extended=message.is_extended_id,
        remote=remote,
        dlc=message.dlc if remote else None,
    )


def _can_repair(interface: str, channel: str, bitrate_bps: int) -> str:
    if interface == "socketcan":
        return (
            f"`sudo ip link set {channel} up type can bitrate {bitrate_bps} restart-ms 100` sets it up "
            f"(`ip -details link show {channel}` tells its state); without CAN in the kernel use interface slcan"
        )
    return f"check the interface {interface} and the channel {channel}"


def _errno_of(error: BaseException) -> int | None:
    """The system's error number, wherever python-can or pyserial left it."""
    seen: BaseException | None = error
    while seen is not None:
        first = seen.args[0] if isinstance(seen, termios.error) and seen.args else None  # it has no errno
        for value in (getattr(seen, "errno", None), getattr(seen, "error_code", None), first):
            if isinstance(value, int):
                return value
        seen = seen.__cause__ or seen.__context__
    return None


def _opening_failed(path: str, error: Exception) -> PortError:
    """The right member of the error family for a serial line that cannot be opened, with the repair."""
    code = _errno_of(error)
    if code in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK) or "exclusively lock" in str(error):
        return PortBusy(
            f"another program holds {path}: stop it (`fuser -v {path}` names it), or give this device another port"
        )
    if code in (errno.EACCES, errno.EPERM):
        group = _group_of(path)
        return PortDenied(
            f"no permission on {path}: add the user to the group {group} (sudo usermod -aG {group} $USER, then log in "
            "again) or install the udev rules in deploy/"
        )
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO, errno.ENOTDIR):
        return PortAbsent(
            f"no {path}: is the device plugged in and powered? `umfeld devices list` shows the ports that are there"
        )
    if code in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or isinstance(error, termios.error):
        return PortError(f"{path} is not a serial port: name one such as /dev/ttyACM0 (`umfeld devices list`)")
    return PortError(f"{path} cannot be opened: {error}")


def _group_of(path: str) -> str:
    try:
        return grp.getgrgid(Path(path).stat().st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"


def _lost(name: str, why: str) -> PortAbsent:
    return PortAbsent(f"{name} was lost ({why}): check its cable and power; it is opened again as soon as it is back")
