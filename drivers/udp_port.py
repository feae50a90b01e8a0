"""A wire over UDP on this machine: datagrams in and out, each a chunk. For MAVLink beside a router or a simulator."""

from __future__ import annotations

import contextlib
import ipaddress
import re
import select
import socket

from drivers.errors import PortAbsent, PortBusy, PortError
from drivers.ports import Clock

_LARGEST_DATAGRAM = 65536
_BATCH = 64
_ADDRESS = re.compile(r"(udpin|udpout):([0-9.]+|localhost):(\d{1,5})")


def parse_udp(address: str) -> tuple[bool, str, int] | None:
    """(listens, host, port) of `udpin:127.0.0.1:14550` or `udpout:…`, None if it is not of this form.

    Raises ValueError for an address that is not this machine's: MAVLink has no password.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        return None
    host = "127.0.0.1" if match[2] == "localhost" else match[2]
    if not ipaddress.ip_address(host).is_loopback:
        raise ValueError(f"{address}: only addresses of this machine (127.0.0.1); use a MAVLink router for others")
    port = int(match[3])
    if not 1 <= port <= 65535:
        raise ValueError(f"{address}: ports are 1 to 65535")
    return match[1] == "udpin", host, port


class UdpPort:
    """udpin: listens, and answers to whoever sent last. udpout: sends to an address and hears what comes back."""

    silence_reopen_s: float | None = None

    def __init__(self, address: str, *, clock: Clock) -> None:
        parsed = parse_udp(address)
        if parsed is None:
            raise PortAbsent(f"{address} is no UDP address: write udpin:127.0.0.1:14550 or udpout:127.0.0.1:14550")
        listens, host, port = parsed
        self.name = address
        self.drops: dict[str, int] = {}
        self._clock = clock
        self._peer: tuple[str, int] | None = None if listens else (host, port)
        self._listens = listens
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind((host, port) if listens else ("127.0.0.1", 0))
        except OSError as error:
            self._socket.close()
            raise PortBusy(f"{address} cannot be opened ({error}): does another program listen there?") from error
        self._poll = select.poll()
        self._poll.register(self._socket.fileno(), select.POLLIN)

    def read(self, timeout_s: float) -> list[tuple[bytes, int]]:
        """The datagrams that wait, each with its arrival time."""
        if not self._poll.poll(timeout_s * 1e3):
            return []
        chunks: list[tuple[bytes, int]] = []
        while len(chunks) < _BATCH:
            try:
                data, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except (BlockingIOError, ConnectionRefusedError):  # refused: what we sent met nobody, who may come yet
                break
            except OSError as error:
                raise PortError(f"{self.name} was lost ({error})") from error
            if self._listens:
                self._peer = sender
            chunks.append((data, self._clock()))
        return chunks

    def write(self, item: bytes) -> None:
        """Send one datagram; while nobody is known to send to, it is counted `no_peer`."""
        if self._peer is None:
            self.drops["no_peer"] = self.drops.get("no_peer", 0) + 1
            return
        try:
            self._socket.sendto(item, self._peer)
        except (BlockingIOError, ConnectionRefusedError):
            self.drops["not_sent"] = self.drops.get("not_sent", 0) + 1
        except OSError as error:
            raise PortError(f"{self.name} was lost ({error})") from error

    def set_baud(self, bits_per_s: int) -> None:
        """UDP has no speed to set."""

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()
