"""sd_notify: tell systemd that we are ready, alive and stopping. Does nothing where nobody listens.

The protocol is one datagram of `KEY=VALUE` lines to the unix socket named by NOTIFY_SOCKET (a leading `@` stands for
the zero byte of an abstract name); see sd_notify(3) and sd_watchdog_enabled(3).
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends states to the service manager. `beat` is for the work loop: it sends at most twice a watchdog period."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        variables = os.environ if environment is None else environment
        self._address = _address_of(variables.get("NOTIFY_SOCKET", ""))
        self._beat_period_ns = _watchdog_period_ns(variables) // 2
        self._next_beat_ns = 0

    @property
    def watched(self) -> bool:
        """Whether the service manager expects beats."""
        return self._beat_period_ns > 0

    def ready(self, status: str) -> None:
        """Start-up is over."""
        self._send(f"READY=1\nSTATUS={status}")

    def still_starting(self, status: str) -> None:
        """Start-up goes on and deserves another half minute."""
        self._send(f"EXTEND_TIMEOUT_USEC=30000000\nSTATUS={status}")

    def stopping(self, status: str) -> None:
        """The way out has begun."""
        self._send(f"STOPPING=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """A line for `systemctl status`."""
        self._send(f"STATUS={status}")

    def beat(self, now_ns: int) -> None:
        """Called whenever work has been done; now_ns: monotonic."""
        if self._beat_period_ns and now_ns >= self._next_beat_ns:
            self._next_beat_ns = now_ns + self._beat_period_ns
            self._send("WATCHDOG=1")

    def _send(self, message: str) -> None:
        if self._address is None:
            return
        # A service manager that does not listen must not stop the daemon.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.setblocking(False)
            sock.sendto(message.encode(), self._address)


def _address_of(name: str) -> str | None:
    if name.startswith("@"):
        return "\0" + name[1:]
    return name if name.startswith("/") else None


def _watchdog_period_ns(variables: Mapping[str, str]) -> int:
    """WATCHDOG_USEC, if it is meant for this process."""
    usec, pid = variables.get("WATCHDOG_USEC", ""), variables.get("WATCHDOG_PID", "")
    if not usec.isdecimal() or (pid and pid != str(os.getpid())):
        return 0
    return int(usec) * 1000
