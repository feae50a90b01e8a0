"""Zenoh sessions and everything of its API that is marked unstable, in one place.

The daemon is a router with explicit endpoints, everyone else a client of it: nothing is scouted, nothing listens that
was not named. Callbacks only copy into bounded channels (a full one would stop the whole session); sessions are closed
with a deadline (a session left open keeps the process alive).
"""

from __future__ import annotations

import ipaddress
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from zenoh import ext, handlers

from service.config_files import DEFAULT_ENDPOINT, daemon_endpoint, daemon_tls, find_config
from service.errors import Trouble
from service.tls import TlsFiles, why_refused
from service.topics import ALIVE, RPC, Priority

HEARTBEAT_S = 0.5
_LEASE_MS = 3000
_PORT_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
_OTHER_PROTOCOLS = ("unixsock-stream", "unixpipe", "serial", "vsock")
_RETRY = {"period_init_ms": 500, "period_max_ms": 1000, "period_increase_factor": 2}  # Zenoh's own rises to 4 s
_MAX_MESSAGE_BYTES = 64 << 20
_PRIORITIES = {priority: getattr(zenoh.Priority, priority.value) for priority in Priority}


class NetworkTrouble(Trouble):
    """A session could not be opened; the text says why and what to do."""


class PortInUse(NetworkTrouble):
    """Another program listens on one of our endpoints."""


class NoDaemon(NetworkTrouble):
    """Nobody answers at the endpoint of the daemon."""


class NotAdmitted(NetworkTrouble):
    """Something answers at the endpoint of the daemon, and does not let us in."""


class WrongAddress(NetworkTrouble):
    """What was given as an endpoint is none."""

    exit_code = 2


class CallFailed(NetworkTrouble):
    """A call was answered with an error, or not at all."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """listen: where the router listens.  connect: other routers to link to.  zenoh_config: a Zenoh configuration file
    (access rules, users, limits) laid under ours; endpoints and scouting are decided here alone."""

    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    connect: tuple[str, ...] = ()
    tls: TlsFiles | None = None
    zenoh_config: Path | None = None
    lease_ms: int = _LEASE_MS
    max_message_bytes: int = _MAX_MESSAGE_BYTES


def open_router(settings: NetworkSettings) -> zenoh.Session:
    """The daemon's session. PortInUse or NetworkTrouble if it cannot be had."""
    config = _base_config(settings.zenoh_config)
    values: dict[str, object] = {
        "mode": "router",
        "transport/link/rx/max_message_size": settings.max_message_bytes,
        "transport/link/tx/lease": settings.lease_ms,
        "listen/exit_on_failure": True,
        "connect/exit_on_failure": False,  # a fleet router that is down is tried again for ever
        "connect/timeout_ms": -1,
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
    }
    if settings.tls is not None:
        values |= settings.tls.values()
    _insert(config, values)
    refuse_open_listeners(settings.listen)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise _explain_open(error, settings.listen) from error


def open_client(
    endpoint: str = DEFAULT_ENDPOINT, *, zenoh_config: Path | None = None, tls: TlsFiles | None = None
) -> zenoh.Session:
    """A session for status, view and tools. NoDaemon if nothing answers at the endpoint, WrongAddress if it is none.

    tls: our certificate, for a tls/ endpoint.  zenoh_config: may bring one, too.
    """
    _check_address(endpoint)
    tls = tls if endpoint.startswith(("tls/", "quic/")) else None
    config = _base_config(zenoh_config)
    _insert(
        config,
        {
            "mode": "client",
            "listen/endpoints": [],
            "connect/endpoints": [endpoint],
            "transport/link/tx/lease": _LEASE_MS,
            "connect/retry": _RETRY,
            **({} if tls is None else tls.values()),
        },
    )
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        refusal = _why_refused(endpoint, tls, zenoh_config)
        if refusal is not None:
            raise NotAdmitted(f"the daemon at {endpoint} cannot be spoken to: {refusal}") from error
        raise NoDaemon(
            f"no daemon answers at {endpoint}: start one with `umfeld run`, or name its address with --connect"
            f" (zenoh: {_first_line(error)})"
        ) from error


def _why_refused(endpoint: str, tls: TlsFiles | None, zenoh_config: Path | None) -> str | None:
    """Why what listens at an endpoint does not let us in; None if it may not be there at all."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream" and Path(address).exists() and not os.access(address, os.W_OK):
        return (
            f"{address} is another user's; run this as the daemon's user, for instance `sudo -u umfeld umfeld status`"
        )
    if protocol == "tls" and zenoh_config is None:  # else we do not know what it brings
        return why_refused(endpoint, tls)
    return None


def client_for(connect: str | None, config: Path | None) -> Client:
    """The client of a command: connect, or where the configuration's daemon listens, with the certificate it names."""
    path = find_config(config)
    return Client(connect or daemon_endpoint(path), tls=daemon_tls(path))


def _check_address(endpoint: str) -> None:
    """WrongAddress unless it is `protocol/host:port`, or another protocol's `protocol/address`."""
    protocol, _, address = endpoint.partition("/")
    _, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    if protocol in _PORT_PROTOCOLS:
        fits = port.isdecimal() and 0 < int(port) < 65536
    else:
        fits = protocol in _OTHER_PROTOCOLS and bool(address)
    if not fits:
        raise WrongAddress(f"{endpoint}: is no address of a daemon; one looks like {DEFAULT_ENDPOINT} (--connect)")


def _base_config(path: Path | None) -> zenoh.Config:
    """A configuration file, or nothing but what every session of ours has. Scouting is off in any case."""
    try:
        config = zenoh.Config() if path is None else zenoh.Config.from_file(path)
    except (zenoh.ZError, OSError) as error:
        raise NetworkTrouble(f"zenoh configuration {path}: {_first_line(error)}; repair the file") from error
    values: dict[str, object] = {"scouting/multicast/enabled": False, "timestamping/enabled": True}
    if path is None:
        values["transport/shared_memory/enabled"] = False
    _insert(config, values)
    return config


def _insert(config: zenoh.Config, values: Mapping[str, object]) -> None:
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise NetworkTrouble(f"zenoh refuses {key} = {value!r}: {_first_line(error)}") from error


def refuse_open_listeners(endpoints: Sequence[str]) -> None:
    """NetworkTrouble if an endpoint can be reached from other machines without TLS."""
    for endpoint in endpoints:
        protocol, _, rest = endpoint.partition("/")
        if protocol not in ("tls", "quic", "unixsock-stream") and not is_loopback(rest):
            raise NetworkTrouble(
                f"[network] listen {endpoint}: other machines could reach it without a certificate;"
                " listen on 127.0.0.1, or use tls/… with a zenoh_config file (deploy/README-security.md)"
            )


def is_loopback(address: str) -> bool:
    """Whether `host:port` names this machine only."""
    host = address.split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _explain_open(error: zenoh.ZError, listen: Sequence[str]) -> NetworkTrouble:
    text = _first_line(error)
    if "in use" in str(error).lower() or "os error 98" in str(error).lower():
        return PortInUse(
            f"{', '.join(listen)} is in use: another daemon or Zenoh router runs here."
            " Stop it (`ss -ltnp` names it), or set another port in [network] listen"
        )
    return NetworkTrouble(f"the Zenoh router cannot listen on {', '.join(listen)}: {text}; check [network] listen")


def _first_line(error: BaseException) -> str:
    """What went wrong, without the source positions that Zenoh appends."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].split(" at /")[0].strip()[:300]


def close_within(session: zenoh.Session, deadline_s: float) -> bool:
    """Close a session; False if it was not closed in time (the caller then ends the process with os._exit)."""
    closer = threading.Thread(target=session.close, name="zenoh-close", daemon=True)
    closer.start()
    closer.join(deadline_s)
    return not closer.is_alive()


@contextmanager
def closing(session: zenoh.Session, deadline_s: float = 2.0) -> Iterator[zenoh.Session]:
    """The session, closed at the end within a deadline."""
    try:
        yield session
    finally:
        close_within(session, deadline_s)


def declare_stream(session: zenoh.Session, key: str, priority: Priority, *, express: bool) -> Any:
    """A publisher for values that soon are old: never blocks, drops under congestion."""
    return session.declare_publisher(
        key, priority=_PRIORITIES[priority], express=express, congestion_control=zenoh.CongestionControl.DROP
    )


class Readers:
    """Whether any subscriber would get what a publisher puts: kept up to date by Zenoh, since asking it for every
    message costs some microseconds and the interpreter's lock."""

    __slots__ = ("_listener", "_told", "any")

    def __init__(self, publisher: Any) -> None:
        self._told = False
        self.any = True
        self._listener = publisher.declare_matching_listener(self._hear)
        now = bool(publisher.matching_status.matching)
        if not self._told:  # else what was told since is newer
            self.any = now

    def _hear(self, status: Any) -> None:
        self.any = bool(status.matching)
        self._told = True


def declare_latched(session: zenoh.Session, key: str, priority: Priority, *, depth: int = 1) -> Any:
    """A publisher whose last value late AdvancedSubscribers receive, numbered so that a lost one is noticed."""
    return ext.declare_advanced_publisher(
        session,
        key,
        priority=_PRIORITIES[priority],
        congestion_control=zenoh.CongestionControl.DROP,
        cache=ext.CacheConfig(max_samples=depth),
        publisher_detection=True,
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
    )


def subscribe(session: zenoh.Session, key: str, *, ring: int = 256) -> Any:
    """A plain subscriber with a ring of the newest values: .try_recv() gives None when empty, .recv() waits."""
    return session.declare_subscriber(key, handlers.RingChannel(ring))


def subscribe_latched(session: zenoh.Session, key: str, *, ring: int = 64) -> Any:
    """A subscriber that begins with the last value of every cached key and fetches lost ones again."""
    return ext.declare_advanced_subscriber(
        session,
        key,
        handlers.RingChannel(ring),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def subscribe_liveliness(session: zenoh.Session, key: str, *, ring: int = 64) -> Any:
    """A ring of tokens that come (PUT) and go (DELETE), beginning with those that are there."""
    return session.liveliness().declare_subscriber(key, handlers.RingChannel(ring), history=True)


def declare_queryable(session: zenoh.Session, key: str, on_query: Callable[[Any], None]) -> Any:
    """Answer queries. on_query must only hand the query on (a slow one would stop the whole session)."""
    return session.declare_queryable(key, on_query, complete=True)


@dataclass(frozen=True, slots=True)
class Received:
    """One sample, as plain Python values. key: the whole key."""

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None


def received(sample: zenoh.Sample) -> Received:
    """A Zenoh sample as plain values."""
    attachment = None if sample.attachment is None else bytes(sample.attachment)
    return Received(str(sample.key_expr), bytes(sample.payload), str(sample.encoding), attachment)


class Client:
    """What status, view and the map commands need of a running daemon. A context manager."""

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, *, zenoh_config: Path | None = None, tls: TlsFiles | None = None
    ) -> None:
        """NoDaemon if nothing answers."""
        self.endpoint = endpoint
        self.session = open_client(endpoint, zenoh_config=zenoh_config, tls=tls)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self, deadline_s: float = 2.0) -> bool:
        """End the session; False if that took too long."""
        return close_within(self.session, deadline_s)

    def bases(self, *, timeout_s: float = 1.0) -> list[str]:
        """Key bases of the robots that are alive, sorted."""
        # Not `**`: access rules admit a question only if they cover all of it.
        replies = self.session.liveliness().get(f"robots/*/{ALIVE}", timeout=timeout_s)
        found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        return sorted(key.removesuffix(f"/{ALIVE}") for key in found)

    def only_base(self, base: str | None = None) -> str:
        """The base that was named, or of the only robot; NoDaemon if there is none or more than one."""
        if base is not None:
            return base
        bases = self.bases()
        if len(bases) == 1:
            return bases[0]
        if not bases and self.endpoint.startswith(("tls/", "quic/")):
            raise NoDaemon(
                f"no daemon is seen at {self.endpoint}, and yet something lets us in: its access rules do not know the "
                "name (CN) of our certificate (deploy/README-security.md), or its kernels are still compiled"
            )
        if not bases:
            raise NoDaemon(
                f"no daemon is alive at {self.endpoint}: start one with `umfeld run`; after an update it answers only "
                "when its kernels are compiled, about a minute later"
            )
        names = ", ".join(found.removeprefix("robots/") for found in bases)
        raise NoDaemon(f"several robots answer at {self.endpoint}: choose one with --robot ({names})")

    def get(self, selector: str, *, timeout_s: float = 2.0) -> list[Received]:
        """Last values of the keys that match, e.g. `robots/r1/map/**` or `robots/r1/map/grid?format=png`."""
        replies = self.session.get(selector, handlers.FifoChannel(4096), timeout=timeout_s)
        return [received(reply.ok) for reply in replies if reply.ok is not None]

    def subscribe(self, key: str, *, ring: int = 256) -> Any:
        """See the function of this name."""
        return subscribe(self.session, key, ring=ring)

    def subscribe_latched(self, key: str, *, ring: int = 64) -> Any:
        """See the function of this name."""
        return subscribe_latched(self.session, key, ring=ring)

    def call(
        self, base: str, name: str, arguments: Mapping[str, object] | None = None, *, timeout_s: float = 10.0
    ) -> Any:
        """Call `@rpc/<name>`: JSON in, JSON out. CallFailed with the daemon's own words, or that nobody answered."""
        replies = list(
            self.session.get(
                f"{base}/{RPC}/{name}",
                handlers.FifoChannel(16),
                payload=json.dumps(dict(arguments or {})),
                encoding="application/json",
                timeout=timeout_s,
            )
        )
        for reply in replies:
            if reply.ok is not None:
                return json.loads(bytes(reply.ok.payload))
        for reply in replies:
            if reply.err is not None:
                raise CallFailed(_error_text(bytes(reply.err.payload)))
        raise CallFailed(f"{base} does not answer the call {name} (within {timeout_s:g} s, at {self.endpoint})")


def _error_text(payload: bytes) -> str:
    try:
        return str(json.loads(payload)["error"])
    except (ValueError, KeyError, TypeError):
        return payload.decode("utf-8", "replace") or "the call failed without a reason"
