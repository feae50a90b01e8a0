"""Open everything a configuration names, listen for a while, and tell what was found; then give it all back."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.reader import SourceHealth, WireReader
from drivers.readings import LinkState
from service import assemble, assemble_wires
from service.config import Config
from service.errors import Trouble
from service.health import identity_text, trouble_of
from service.locks import Claims
from service.tls import TlsFiles, TlsTrouble, own_certificate

_LISTEN_S = 1.0  # so long after the first reading, for a rate
_OPEN_S = 1.0  # a port that could not be opened until then is not there
_POLL_S = 0.05
_STOP_S = 2.0


@dataclass(frozen=True, slots=True)
class Found:
    """What became of one device. trouble: in words with the repair, None if all is well."""

    name: str
    kind: str
    wire: str
    state: str
    identity: str
    rate_hz: float
    trouble: str | None

    @property
    def is_well(self) -> bool:
        """Readings arrive and the device complains about nothing."""
        return self.state == "running" and self.trouble is None

    def row(self) -> tuple[str, str, str, str, str, str]:
        """For a table."""
        rate = f"{self.rate_hz:.1f} Hz" if self.rate_hz else "-"
        return (self.name, self.kind, self.wire, self.state, self.identity or "-", rate)

    def document(self) -> dict[str, object]:
        """For JSON."""
        return {
            "name": self.name,
            "kind": self.kind,
            "wire": self.wire,
            "state": self.state,
            "identity": self.identity,
            "rate_hz": round(self.rate_hz, 2),
            "trouble": self.trouble,
        }


def check_devices(
    config: Config, *, seconds: float, now_ns: Callable[[], int], sleep: Callable[[float], None]
) -> list[Found]:
    """Every device of the configuration, after at most `seconds`."""
    kinds = {name: sensor.kind for name, sensor in assemble.sensors(config).items()}
    found: list[Found] = []
    opened: list[tuple[str, WireReader[Any]]] = []
    with Claims() as claims:
        for wire in assemble_wires.wires(config):
            where = wire.port or wire.name
            try:
                claims.claim_ports([wire.port] if wire.port is not None else [])
            except Trouble as trouble:
                found += [Found(name, kinds[name], where, "busy", "", 0.0, str(trouble)) for name in wire.conversations]
                continue
            reader = wire.reader(lambda _source, _item: None, now_ns)
            reader.start()
            opened.append((where, reader))
        try:
            _wait_for_all([reader for _, reader in opened], seconds, now_ns, sleep)
            for where, reader in opened:
                found += [_found(each, kinds[each.name], where) for each in reader.health().sources.values()]
        finally:
            for _, reader in opened:
                reader.stop(_STOP_S)
    order = list(kinds)
    return sorted(found, key=lambda each: order.index(each.name))


def _wait_for_all(
    readers: list[WireReader[Any]], seconds: float, now_ns: Callable[[], int], sleep: Callable[[float], None]
) -> None:
    """Until every device has been heard for a while, or its port cannot be opened, or the time is up."""
    began_ns = now_ns()
    deadline_ns = began_ns + int(seconds * 1e9)
    heard_ns: dict[str, int] = {}
    while now_ns() < deadline_ns:
        wires = [reader.health() for reader in readers]
        hopeless = now_ns() - began_ns >= _OPEN_S * 1e9
        awaited = [wire for wire in wires if not hopeless or wire.is_open or wire.openings or not wire.attempts]
        sources = [source for wire in awaited for source in wire.sources.values()]
        for source in sources:
            if source.state is LinkState.RUNNING and source.readings > 0:
                heard_ns.setdefault(source.name, now_ns())
            else:
                heard_ns.pop(source.name, None)
        if all(now_ns() - heard_ns.get(source.name, deadline_ns) >= _LISTEN_S * 1e9 for source in sources):
            return
        sleep(_POLL_S)


def _found(source: SourceHealth, kind: str, where: str) -> Found:
    trouble = trouble_of(source)
    if trouble is None and source.state is not LinkState.RUNNING:
        trouble = "no reading arrived in time; check its power and cable, or give it longer (--seconds)"
    return Found(
        source.name,
        kind,
        where,
        source.state.name.lower(),
        identity_text(source.identity),
        source.rate_hz,
        trouble,
    )


def check_surroundings(config: Config) -> list[str]:
    """What would keep the daemon from starting besides devices: its network addresses and its map's folder."""
    problems = []
    for endpoint in config.network.listen:
        problem = _address_problem(endpoint)
        if problem is not None:
            problems.append(problem)
    if config.network.tls is not None:
        tls = config.network.tls
        files = TlsFiles(tls.root_ca_certificate, tls.listen_certificate, tls.listen_private_key, tls.mutual)
        try:
            trouble = own_certificate(files).trouble(time.time(), config.network.listen)
        except TlsTrouble as fault:
            trouble = str(fault)
        problems += [] if trouble is None else [f"[network.tls] {trouble}"]
    if config.store.enabled:
        folder = config.store_path().parent
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not os.access(folder, os.W_OK | os.X_OK):
            problems.append(f"[store] path: {folder} cannot be written; allow it, or set another path")
    return problems


def _address_problem(endpoint: str) -> str | None:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in ("tcp", "tls", "ws") or not port.isdecimal():
        return None
    if int(port) > 65535:
        return f"[network] listen: {endpoint} has no such port; ports are 1 to 65535"
    host = host.strip("[]")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(port)))
        except OSError as error:
            return (
                f"[network] listen: {endpoint} cannot be used ({error}); stop the daemon or router that has it "
                "(`ss -ltnp` names it), or set another port"
            )
    return None
