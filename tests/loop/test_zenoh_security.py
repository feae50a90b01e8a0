"""The access rules in deploy/, with certificates made as its README says: what must pass passes, the rest does not."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.clock import SystemClock
from service.outputs import GridOut, ScanOut
from service.publisher import Publisher
from service.tls import TlsFiles, TlsTrouble, own_certificate
from service.zenoh_session import CallFailed, Client, NetworkSettings, NetworkTrouble, NoDaemon, NotAdmitted
from tests.clients import PatientClient
from tests.waiting import GIVE_UP_S, free_port, wait_for

DEPLOY = Path(__file__).parents[2] / "deploy"
BASE = "robots/r1"

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs the openssl command")

MAKE_CERTIFICATES = """
set -e
authority() {
  openssl ecparam -name prime256v1 -genkey -noout -out $1.key
  openssl req -x509 -new -key $1.key -days 30 -subj /CN=$1 -out $1.crt \
    -addext basicConstraints=critical,CA:TRUE -addext keyUsage=critical,keyCertSign
}
issue() {
  openssl ecparam -name prime256v1 -genkey -noout -out $1.key
  openssl req -new -key $1.key -subj /CN=$3 -out $1.csr
  printf 'extendedKeyUsage=serverAuth,clientAuth\\nsubjectAltName=%s\\n' $4 > $1.ext
  openssl x509 -req -in $1.csr -CA $2.crt -CAkey $2.key -CAcreateserial -days 30 -extfile $1.ext -out $1.crt
}
authority ca
authority otherca
issue mapper ca mapper DNS:localhost,IP:127.0.0.1
issue viewer ca viewer DNS:viewer
issue operator ca operator DNS:operator
issue stranger ca stranger DNS:stranger
issue forged otherca operator DNS:operator
openssl x509 -req -in viewer.csr -CA ca.crt -CAkey ca.key -CAcreateserial -days -1 -extfile viewer.ext -out old.crt
cp viewer.key old.key
openssl x509 -req -in mapper.csr -CA ca.crt -CAkey ca.key -CAcreateserial -days -1 -extfile mapper.ext -out gone.crt
cp mapper.key gone.key
"""


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run(["bash", "-c", MAKE_CERTIFICATES], cwd=folder, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def endpoints(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    return f"unixsock-stream/{tmp_path_factory.mktemp('run')}/zenoh.sock", f"tls/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def publisher(certificates: Path, endpoints: tuple[str, str]) -> Iterator[Publisher]:
    authority, certificate, key = (str(certificates / name) for name in ("ca.crt", "mapper.crt", "mapper.key"))
    files = TlsFiles(authority, certificate, key)
    settings = NetworkSettings(listen=endpoints, tls=files, zenoh_config=DEPLOY / "zenoh-security.json5")
    made = Publisher(BASE, settings, clock=SystemClock())

    def greet(_arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"hello": True}

    made.calls.register("greet", greet)
    made.start()
    made.offer(GridOut(1, 1, GridPatch(0.1, 0, 0, np.zeros((2, 2), np.int8))))
    yield made
    assert made.close(GIVE_UP_S)


def client_of(certificates: Path, endpoint: str, name: str | None) -> Client:
    """A client with the certificate of that name, or with none."""
    tls: dict[str, Any] = {"root_ca_certificate": str(certificates / "ca.crt")}
    if name is not None:
        tls |= {
            "connect_certificate": str(certificates / f"{name}.crt"),
            "connect_private_key": str(certificates / f"{name}.key"),
            "enable_mtls": True,
        }
    path = certificates / f"client-{name}.json5"
    path.write_text(json.dumps({"transport": {"unicast": {"compression": {"enabled": True}}, "link": {"tls": tls}}}))
    return PatientClient(endpoint, zenoh_config=path)


def wait_until(condition: Callable[[], Any]) -> Any:
    return wait_for("what was waited for", condition, every_s=0.02)


def scan(publisher: Publisher) -> None:
    swept = Scan(SystemClock().now_ns(), 0.0, np.linspace(-1, 1, 3), np.ones(3), 0.1, 30.0)
    publisher.offer(ScanOut("front", swept, Pose2(), 0.0))


def next_scan(publisher: Publisher, subscriber: Any) -> Any:
    scan(publisher)
    return subscriber.try_recv()


@pytest.mark.parametrize("name", ["viewer", "operator"])
def test_readers_read(publisher: Publisher, certificates: Path, endpoints: tuple[str, str], name: str) -> None:
    with client_of(certificates, endpoints[1], name) as client:
        assert wait_until(client.bases) == [BASE]
        assert wait_until(lambda: client.get(f"{BASE}/map/grid"))
        live = client.subscribe(f"{BASE}/scan/**")
        wait_until(lambda: next_scan(publisher, live))
        late = client.subscribe_latched(f"{BASE}/map/**")
        wait_until(late.try_recv)


def test_only_operators_call(publisher: Publisher, certificates: Path, endpoints: tuple[str, str]) -> None:
    with client_of(certificates, endpoints[1], "operator") as operator:
        assert operator.call(BASE, "greet") == {"hello": True}
    answered = publisher.calls.answered
    with client_of(certificates, endpoints[1], "viewer") as viewer:
        wait_until(lambda: viewer.get(f"{BASE}/map/grid"))  # it is connected
        with pytest.raises(CallFailed, match="does not answer"):
            viewer.call(BASE, "greet", timeout_s=0.7)
    assert publisher.calls.answered == answered


@pytest.mark.parametrize("name", ["viewer", "operator"])
def test_readers_cannot_speak_for_the_robot(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str], name: str
) -> None:
    with client_of(certificates, endpoints[0], None) as witness, client_of(certificates, endpoints[1], name) as reader:
        heard = witness.subscribe(f"{BASE}/**")
        wait_until(lambda: next_scan(publisher, heard))
        reader.session.put(f"{BASE}/pose", b"forged")
        reader.session.put(f"{BASE}/map/grid", b"forged")
        token: Any = reader.session.liveliness().declare_token("robots/r2/alive")
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            sample = next_scan(publisher, heard)
            assert sample is None or bytes(sample.payload) != b"forged"
        assert witness.bases() == [BASE]
        token.undeclare()


def test_a_certified_stranger_sees_nothing(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str]
) -> None:
    with client_of(certificates, endpoints[1], "stranger") as stranger:
        assert stranger.bases(timeout_s=0.5) == []
        assert stranger.get("**", timeout_s=0.5) == []
        live = stranger.subscribe("**")
        for _ in range(20):
            assert next_scan(publisher, live) is None
            time.sleep(0.02)


def test_the_owner_on_the_robot_may_do_everything(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str]
) -> None:
    with client_of(certificates, endpoints[0], None) as owner:
        assert owner.call(BASE, "greet") == {"hello": True}
        wait_until(lambda: owner.get(f"{BASE}/map/**"))


@pytest.mark.parametrize("name", [None, "forged"])
def test_without_a_certificate_of_ours_there_is_no_connection(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str], name: str | None
) -> None:
    scan(publisher)
    with pytest.raises(NetworkTrouble):
        client_of(certificates, endpoints[1], name)


def test_plain_tcp_is_refused(publisher: Publisher, endpoints: tuple[str, str]) -> None:
    scan(publisher)
    with pytest.raises(NetworkTrouble):
        Client(endpoints[1].replace("tls/", "tcp/"))


def test_the_file_forbids_plain_listening() -> None:
    settings = NetworkSettings(listen=("tcp/127.0.0.1:0",), zenoh_config=DEPLOY / "zenoh-security.json5")
    with pytest.raises(NetworkTrouble, match=r"cannot listen on tcp/127\.0\.0\.1:0"):
        Publisher(BASE, settings, clock=SystemClock()).start()


def files_of(certificates: Path, name: str, authority: str = "ca", key: str | None = None) -> TlsFiles:
    return TlsFiles(
        str(certificates / f"{authority}.crt"),
        str(certificates / f"{name}.crt"),
        str(certificates / f"{key or name}.key"),
    )


def test_a_command_with_a_certificate_comes_in(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str]
) -> None:
    """As `umfeld status` on a desk does, whose configuration names the certificate."""

    def comes_in() -> bool:
        with Client(endpoints[1], tls=files_of(certificates, "viewer")) as client:
            return client.bases() == [BASE]

    wait_until(comes_in)


@pytest.mark.parametrize(
    ("name", "authority", "words"),
    [
        (None, "ca", r"it refuses no certificate: it asks for one: name yours in \[network.tls\]"),
        ("old", "ca", r"it refuses \S+old.crt: it has expired: issue a new one"),
        ("forged", "ca", r"it refuses \S+forged.crt: it is not of the authority that the daemon trusts"),
        ("viewer", "otherca", r"the certificate that it shows is refused here: unable to get local issuer"),
    ],
)
def test_who_is_not_let_in_is_told_why(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str], name: str | None, authority: str, words: str
) -> None:
    """Zenoh says "Unable to connect" to all of them, and we said that there is no daemon."""
    with pytest.raises(NotAdmitted, match=words):
        Client(endpoints[1], tls=None if name is None else files_of(certificates, name, authority))


def test_a_name_that_the_rules_do_not_know_is_told(
    publisher: Publisher, certificates: Path, endpoints: tuple[str, str]
) -> None:
    tls = files_of(certificates, "stranger")
    with Client(endpoints[1], tls=tls) as client, pytest.raises(NoDaemon, match=r"do not know the name \(CN\)"):
        client.only_base()


def test_a_daemon_whose_certificate_nobody_accepts_says_so(
    certificates: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    files = files_of(certificates, "gone")
    made = Publisher("robots/r2", NetworkSettings((endpoint,), tls=files), clock=SystemClock())
    made.start()
    try:
        (trouble,) = made.troubles(SystemClock().now_ns())
        assert trouble.endswith("has expired, every client refuses it; issue a new one and start the daemon again")
        assert [record.message for record in caplog.records] == [trouble]
        with pytest.raises(NotAdmitted, match=r"refused here: certificate has expired"):
            Client(endpoint, tls=files_of(certificates, "viewer"))
    finally:
        assert made.close(GIVE_UP_S)


@pytest.mark.parametrize(
    ("name", "authority", "key", "words"),
    [
        ("nosuch", "ca", "mapper", r"nosuch.crt: there is no such file"),
        ("mapper", "ca", "viewer", r"viewer.key: is not the key of \S+mapper.crt"),
        ("mapper", "viewer.key", "mapper", r"viewer.key.crt: there is no such file"),
    ],
)
def test_files_that_no_daemon_can_use_are_told_by_name(
    certificates: Path, name: str, authority: str, key: str, words: str
) -> None:
    with pytest.raises(TlsTrouble, match=words):
        own_certificate(files_of(certificates, name, authority, key))


def test_what_holds_no_certificate_is_told_by_name(certificates: Path) -> None:
    key = str(certificates / "mapper.key")
    certificate = str(certificates / "mapper.crt")
    with pytest.raises(TlsTrouble, match=r"mapper.key: holds no certificate of an authority"):
        own_certificate(TlsFiles(key, certificate, key))
    with pytest.raises(TlsTrouble, match=r"mapper.key: holds no certificate;"):
        own_certificate(TlsFiles(str(certificates / "ca.crt"), key, key))
    with pytest.raises(TlsTrouble, match=r"mapper.crt: holds no key without a password"):
        own_certificate(TlsFiles(str(certificates / "ca.crt"), certificate, certificate))


def test_what_clients_will_find_wrong_with_a_certificate(certificates: Path) -> None:
    found = own_certificate(files_of(certificates, "mapper"))
    assert found.names == ("localhost", "127.0.0.1")
    today_s = found.from_s + 60.0
    assert found.trouble(today_s, ["tls/127.0.0.1:7447", "tls/localhost:1", "tls/[::]:2", "tcp/10.0.0.1:3"]) is None
    assert "does not name 192.168.1.20" in str(found.trouble(today_s, ["tls/192.168.1.20:7447"]))
    assert "is valid only later" in str(found.trouble(found.from_s - 60.0))
    assert "expires in 13 days" in str(found.trouble(found.until_s - 13.2 * 86400))
    assert "has expired" in str(found.trouble(found.until_s + 1.0))
