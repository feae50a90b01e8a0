"""One daemon per port and per map: a name in the abstract socket space, free again the moment its holder ends.

No files, so nothing is left behind by kill -9; and the kernel tells the process that holds a name. It guards against a
second daemon of ours; other programs are kept off a serial port by the lock on the port itself.
"""

from __future__ import annotations

import hashlib
import os
import socket
import struct
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from service.errors import Trouble


class Held(Trouble):
    """Another process has the name. pid: which, "unknown" if it does not say."""

    def __init__(self, message: str, pid: str) -> None:
        super().__init__(message)
        self.pid = pid


class Claims:
    """Names this process holds until close(); a context manager."""

    def __init__(self) -> None:
        self._sockets: list[socket.socket] = []

    def claim_ports(self, ports: Iterable[str]) -> None:
        """Take serial ports for this daemon; Trouble names the process that has one already, and the repair."""
        for port in ports:
            refusal = (
                f"{port} is in use by another umfeld daemon (process {{pid}}): stop that one, or give this "
                "configuration a port of its own"
            )
            # Under its own name too: a daemon that waits for its device claims it before the link leads anywhere.
            self._claim("port", os.path.abspath(port), refusal)
            self._claim_device(os.path.realpath(port), refusal)

    def _claim_device(self, device: str, refusal: str) -> None:
        """What a name leads to. A holder that lost it has no say: the number may be another plug's by now."""
        try:
            self._claim("device", device, refusal)
        except Held as held:
            if not os.path.exists(device) or _has_open(held.pid, device):
                raise

    def claim_store(self, path: Path) -> None:
        """Take the file of a map."""
        self._claim(
            "store",
            os.path.realpath(path),
            f"the map {path} is in use by another umfeld daemon (process {{pid}}): stop that one, or set another "
            "path in [store]",
        )

    def claim_endpoint(self, endpoint: str) -> None:
        """Take a Zenoh endpoint for a daemon that is about to be started."""
        self._claim("endpoint", endpoint, f"{endpoint} is taken by process {{pid}}")

    def _claim(self, kind: str, name: str, refusal: str) -> None:
        holder = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = "\0umfeld/" + kind + "/" + hashlib.sha256(name.encode()).hexdigest()[:32]
        try:
            holder.bind(address)
            holder.listen(1024)  # nobody accepts: every refused daemon takes a place
        except OSError as error:
            holder.close()
            pid = _holder_of(address)
            raise Held(refusal.format(pid=pid), pid) from error
        self._sockets.append(holder)

    def close(self) -> None:
        """Give everything back."""
        while self._sockets:
            self._sockets.pop().close()

    def __enter__(self) -> Claims:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _holder_of(address: str) -> str:
    """The process that listens on an abstract address, as the kernel knows it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        try:
            probe.connect(address)
            credentials = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        except OSError:
            return "unknown"
    pid, _uid, _gid = struct.unpack("3i", credentials)
    return str(pid)


def _has_open(pid: str, device: str) -> bool:
    """Whether a process has a device open; True where that cannot be seen."""
    folder = Path("/proc") / pid / "fd"
    try:
        return any(os.path.realpath(each) == device for each in folder.iterdir())
    except OSError:
        return True
