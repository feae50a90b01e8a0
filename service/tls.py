"""Certificates looked at before and after Zenoh does, since it says little: what is wrong with which file, in one line.

Everything is asked of OpenSSL by handshakes: in memory for our own certificate, over the wire for a refused client.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import Trouble

_NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME of OpenSSL
_SOON_S = 14 * 86400
_WAIT_S = 2.0
_REPAIR = "deploy/README-security.md shows how one is made"
_OF_ANOTHER = "it is not of the authority that the daemon trusts ([network.tls] root_ca_certificate there)"
_ALERTS = {
    "CERTIFICATE_EXPIRED": "it has expired: issue a new one",
    "CERTIFICATE_REQUIRED": "it asks for one: name yours in [network.tls] of the configuration",
    "HANDSHAKE_FAILURE": "it asks for another one",
    "UNKNOWN_CA": _OF_ANOTHER,
    "DECRYPT_ERROR": _OF_ANOTHER,
    "CERTIFICATE_UNKNOWN": _OF_ANOTHER,
    "BAD_CERTIFICATE": "it is damaged or not of the authority that the daemon trusts",
}


class TlsTrouble(Trouble):
    """A file of [network.tls] cannot be used; names the file and the repair."""


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files, of the daemon or of a client. mutual: clients must show a certificate of the same authority."""

    root_ca_certificate: str
    certificate: str
    private_key: str
    mutual: bool = True

    def values(self) -> dict[str, object]:
        """As Zenoh's configuration names them; used for listening and for links to routers."""
        return {
            f"transport/link/tls/{key}": value
            for key, value in {
                "root_ca_certificate": self.root_ca_certificate,
                "listen_certificate": self.certificate,
                "listen_private_key": self.private_key,
                "connect_certificate": self.certificate,
                "connect_private_key": self.private_key,
                "enable_mtls": self.mutual,
                "close_link_on_expiration": True,
            }.items()
        }


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate whose files can be used. names: hosts it stands for.  from_s, until_s: wall clock, since 1970."""

    path: str
    names: tuple[str, ...]
    from_s: float
    until_s: float

    def trouble(self, wall_s: float, listen: Sequence[str] = ()) -> str | None:
        """What clients find wrong with it, or soon will. listen: endpoints by which they may come."""
        if wall_s < self.from_s:
            return f"{self.path}: is valid only later, every client refuses it; set this clock, or issue another"
        if wall_s > self.until_s:
            return f"{self.path}: has expired, every client refuses it; issue a new one and start the daemon again"
        if wall_s > self.until_s - _SOON_S:
            days = (self.until_s - wall_s) / 86400
            return f"{self.path}: expires in {days:.0f} days; issue a new one and start the daemon again"
        for host in filter(None, map(_host_of, listen)):
            if not _is_anywhere(host) and not any(_is_same(host, name) for name in self.names):
                names = ", ".join(self.names) or "no host"
                return (
                    f"{self.path}: does not name {host}, where the daemon listens (but {names}): clients refuse it "
                    "there; issue one with that address in subjectAltName"
                )
        return None


def own_certificate(files: TlsFiles) -> Certificate:
    """Read the files as a listener needs them; TlsTrouble if one is missing, unreadable or does not fit the others."""
    for path in (files.root_ca_certificate, files.certificate, files.private_key):
        _readable(path)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    authority = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        authority.load_verify_locations(files.root_ca_certificate)
    except ssl.SSLError:
        raise TlsTrouble(f"{files.root_ca_certificate}: holds no certificate of an authority; {_REPAIR}") from None
    try:
        client.load_verify_locations(files.certificate)
    except ssl.SSLError:
        raise TlsTrouble(f"{files.certificate}: holds no certificate; {_REPAIR}") from None
    try:
        server.load_cert_chain(files.certificate, files.private_key, password=lambda: b"")
    except ssl.SSLError as error:
        what = (
            f"is not the key of {files.certificate}" if "MISMATCH" in str(error) else "holds no key without a password"
        )
        raise TlsTrouble(f"{files.private_key}: {what}; {_REPAIR}") from None
    client.check_hostname = False
    client.verify_flags = ssl.VerifyFlags(ssl.VERIFY_X509_PARTIAL_CHAIN | _NO_CHECK_TIME)
    try:
        found = _handshake(server, client)
    except ssl.SSLCertVerificationError as error:
        raise TlsTrouble(f"{files.certificate}: {error.verify_message}; {_REPAIR}") from None
    names = tuple(str(entry[1]) for entry in found.get("subjectAltName", ()))
    from_s, until_s = (ssl.cert_time_to_seconds(str(found[key])) for key in ("notBefore", "notAfter"))
    return Certificate(files.certificate, names, from_s, until_s)


def why_refused(endpoint: str, files: TlsFiles | None) -> str | None:
    """Why a tls/ endpoint does not let this client in, in words; None if nothing answers there, or it would."""
    host, port = _host_of(endpoint), endpoint.split("?")[0].split("#")[0].rpartition(":")[2]
    if host is None or not port.isdecimal():
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if files is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    else:
        own_certificate(files)
        context.load_verify_locations(files.root_ca_certificate)
        context.load_cert_chain(files.certificate, files.private_key, password=lambda: b"")
    whose = "no certificate" if files is None else files.certificate
    try:
        with (
            socket.create_connection((host, int(port)), timeout=_WAIT_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as wrapped,
        ):
            wrapped.recv(1)  # a refusal of ours comes after the handshake
    except ssl.SSLCertVerificationError as error:
        return (
            f"the certificate that it shows is refused here: {error.verify_message} (root_ca_certificate, this clock?)"
        )
    except ssl.SSLError as error:
        alert = next((words for name, words in _ALERTS.items() if name in str(error)), str(error.reason or error))
        return f"it refuses {whose}: {alert}"
    except OSError:
        return None
    return None


def _readable(path: str) -> None:
    try:
        with Path(path).open("rb"):
            pass
    except FileNotFoundError:
        raise TlsTrouble(f"{path}: there is no such file; [network.tls] names it ({_REPAIR})") from None
    except OSError as error:
        raise TlsTrouble(f"{path}: {error.strerror}; give it to the user who runs this (`chown`)") from None


def _handshake(server: ssl.SSLContext, client: ssl.SSLContext) -> dict[str, Any]:
    """What the server's certificate says, by a handshake in memory."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours = client.wrap_bio(to_client, to_server)
    theirs = server.wrap_bio(to_server, to_client, server_side=True)
    for _ in range(3):
        for end in (ours, theirs):
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return dict(ours.getpeercert() or {})


def _host_of(endpoint: str) -> str | None:
    protocol, _, rest = endpoint.partition("/")
    host = rest.split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")
    return host if protocol in ("tls", "quic") and host else None


def _is_same(host: str, name: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host) == ipaddress.ip_address(name)
    if name.startswith("*."):
        return host.partition(".")[2].lower() == name[2:].lower()
    return host.lower() == name.lower()


def _is_anywhere(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_unspecified
    return False
