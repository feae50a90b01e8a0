"""A device's end of a UDP conversation on this machine."""

from __future__ import annotations

import contextlib
import socket

from sim_devices.pty_link import READ_SIZE, LinkCounters

LARGEST_DATAGRAM = 1400  # bytes; longer writes are cut


class UdpLink:
    """UDP on the loopback interface. Unplugged it keeps its port number, and nothing passes.

    peer_port: where datagrams go until somebody else has written; None: nowhere.  port: its own; 0: a free one.
    """

    def __init__(self, peer_port: int | None = None, *, port: int = 0, host: str = "127.0.0.1") -> None:
        self.host = host
        self.port = port
        self.counters = LinkCounters()
        self.baud: int | None = None
        self._peer = None if peer_port is None else (host, peer_port)
        self._socket: socket.socket | None = None
        self.open()

    @property
    def is_open(self) -> bool:
        return self._socket is not None

    def open(self) -> None:
        if self._socket is None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind((self.host, self.port))
            self._socket.setblocking(False)
            self.port = self._socket.getsockname()[1]

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def files(self) -> list[int]:
        return [] if self._socket is None else [self._socket.fileno()]

    def read(self) -> bytes:
        received = bytearray()
        while self._socket is not None:
            try:
                data, self._peer = self._socket.recvfrom(READ_SIZE)
            except BlockingIOError:
                break
            except OSError:  # what was sent before found nobody listening
                continue
            received += data
        self.counters.received_bytes += len(received)
        return bytes(received)

    def write(self, data: bytes) -> int:
        sent = 0
        if self._socket is not None and self._peer is not None:
            with contextlib.suppress(OSError):
                while sent < len(data):
                    sent += self._socket.sendto(data[sent : sent + LARGEST_DATAGRAM], self._peer)
        self.counters.sent_bytes += sent
        self.counters.dropped_bytes += len(data) - sent
        return sent
