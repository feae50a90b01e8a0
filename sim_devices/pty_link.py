"""A pty as a serial port: published by a symbolic link, deaf while no program has it open."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import select
import struct
import termios
import tty
from dataclasses import dataclass
from pathlib import Path

TCGETS2 = 0x802C542A
TERMIOS2 = struct.Struct("4IB19s2I")  # flags, line discipline, control characters, input and output speed
READ_SIZE = 65536

IN_CLOSE, IN_OPEN = 0x08 | 0x10, 0x20


class PtyHosts:
    """Who is at the other end of a pty whose maker keeps that end closed. Make it before anybody can open it.

    master: the maker's end; while nobody is there it hangs up, so that select() finds it readable all the time.
    terminal: path of the other end.  is_known: whether this system can tell when somebody comes (inotify).
    Source: inotify(7), poll(2), tcflush(3).
    """

    def __init__(self, master: int, terminal: str) -> None:
        self._master = master
        self._poll = select.poll()
        self._poll.register(master, 0)
        self._watch = -1
        libc = ctypes.CDLL(None, use_errno=True)
        if hasattr(libc, "inotify_init1"):
            self._watch = int(libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
        self.is_known = (
            self._watch >= 0 and libc.inotify_add_watch(self._watch, os.fsencode(terminal), IN_OPEN | IN_CLOSE) >= 0
        )
        self._are_there = False

    def look(self) -> bool:
        """Whether anybody has it open. Empties it when the last one has gone."""
        there = not any(event & select.POLLHUP for _, event in self._poll.poll(0))
        if self._are_there and not there:
            termios.tcflush(self._master, termios.TCOFLUSH)
        self._are_there = there
        return there

    def files(self) -> list[int]:
        """Descriptors that become readable when somebody comes or goes, or says something."""
        if self._watch < 0:
            return [self._master]
        with contextlib.suppress(BlockingIOError):
            os.read(self._watch, 4096)
        return [self._watch, self._master] if self.look() else [self._watch]

    def close(self) -> None:
        if self._watch >= 0:
            os.close(self._watch)
            self._watch = -1


@dataclass(slots=True)
class LinkCounters:
    """What went over a link since it was made."""

    received_bytes: int = 0
    sent_bytes: int = 0
    dropped_bytes: int = 0
    unheard_bytes: int = 0  # said to a port that nobody had open


class PtyLink:
    """A pty published by a symbolic link, so that a replugged device comes back under its name.

    Like a serial port it hears nothing while no program has it open: what comes then is lost, and so is what the last
    one left unread. A pty alone would keep the oldest 4 KiB for whoever opens it next.

    path: the symbolic link, made with its folders and removed by close(). An existing symbolic link is replaced;
    anything else there is left alone and raises FileExistsError.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.counters = LinkCounters()
        self._name = self.path.name
        self._suffix = ""
        self._master: int | None = None
        self._tty: str | None = None
        self._hosts: PtyHosts | None = None
        self._held: int | None = None  # the host's end, where it keeps others out or where hosts cannot be told
        self.open()

    @property
    def is_open(self) -> bool:
        return self._master is not None

    @property
    def baud(self) -> int | None:
        if self._master is None:
            return None
        with contextlib.suppress(OSError):
            speed: int = TERMIOS2.unpack(fcntl.ioctl(self._master, TCGETS2, bytes(TERMIOS2.size)))[-1]
            return speed
        return None

    @property
    def tty(self) -> str | None:
        """The name of the terminal behind the symbolic link."""
        return self._tty

    def open(self) -> None:
        if self._master is not None:
            return
        if self.path.exists() and not self.path.is_symlink():
            raise FileExistsError(f"{self.path} exists and is no link of ours; choose another folder")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._master, slave = os.openpty()
        tty.setraw(slave)  # default settings echo: the emulator would hear itself
        os.set_blocking(self._master, False)
        self._tty = os.ttyname(slave)
        self._hosts = PtyHosts(self._master, self._tty)
        if self._hosts.is_known:
            os.close(slave)
        else:
            self._held = slave
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._tty)
        fresh.replace(self.path)

    def rename(self, suffix: str) -> None:
        """Come back under another name: the first one with a suffix; none for the first one. Unplugs if it changes."""
        if suffix == self._suffix:  # asked at every service: making a path would cost more than the device
            return
        self.close()
        self._suffix = suffix
        self.path = self.path.with_name(self._name + suffix)

    def obstruct(self, *, busy: bool, denied: bool) -> None:
        """Let programs that ask for the port find it held by another (busy) or not permitted (root still may)."""
        if self._tty is None or self._hosts is None:
            return
        if self._held is None:
            if not busy:
                os.chmod(self._tty, 0o000 if denied else 0o620)
                return
            os.chmod(self._tty, 0o620)
            self._held = os.open(self._tty, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB if busy else fcntl.LOCK_UN)
        fcntl.ioctl(self._held, termios.TIOCEXCL if busy else termios.TIOCNXCL)
        os.chmod(self._tty, 0o000 if denied else 0o620)
        if not busy and self._hosts.is_known:
            self._release()

    def close(self) -> None:
        if self._master is None or self._tty is None or self._hosts is None:
            return
        with contextlib.suppress(OSError):
            if os.readlink(self.path) == self._tty:
                self.path.unlink()
        self._release()
        self._hosts.close()
        os.close(self._master)  # hangs up: the host reads end of file or EIO
        self._master = self._tty = self._hosts = None

    def _release(self) -> None:
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def files(self) -> list[int]:
        return [] if self._hosts is None else self._hosts.files()

    def read(self) -> bytes:
        if self._master is None:
            return b""
        try:
            data = os.read(self._master, READ_SIZE)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise
        self.counters.received_bytes += len(data)
        return data

    def write(self, data: bytes) -> int:
        sent = 0
        if self._hosts is not None and not self._hosts.look():
            self.counters.unheard_bytes += len(data)
            return len(data)
        if self._master is not None:
            try:
                while sent < len(data):
                    sent += os.write(self._master, data[sent:])
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EIO):
                    raise
        self.counters.sent_bytes += sent
        self.counters.dropped_bytes += len(data) - sent
        return sent
