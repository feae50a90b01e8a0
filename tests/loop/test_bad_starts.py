"""What goes wrong at the start, as its user meets it: one clear line that names the repair, exit 1 or 2, nothing lost.

Every case is the real command in a process of its own; ports are ptys, the network is loopback.
"""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from service.store import MapStore
from sim_devices.attach import Attachment
from sim_devices.device import F64, ByteDevice, Mount
from sim_devices.laser_hokuyo import UTM_30LX, HokuyoLaser
from sim_devices.pty_link import PtyLink
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardSerial
from tests.waiting import GIVE_UP_S, START_S, free_port, wait_for

ROOT = Path(__file__).resolve().parents[2]
# Root may open anything, unless it has laid down this right.
AS_MERE_OWNER = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", "--inh-caps=-all"]


class Place:
    """A folder with a configuration of one laser, a map and an address of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = folder / "laser-front"
        self.store = folder / "map.umfeld"
        self.endpoint_port = free_port()
        self.config = folder / "umfeld.toml"
        self.write()

    def write(self, more: str = "") -> None:
        self.config.write_text(
            f'[robot]\nid = "r"\n[lasers.front]\ndriver = "hokuyo"\nport = "{self.port}"\n{more}\n'
            f'[network]\nlisten = ["tcp/127.0.0.1:{self.endpoint_port}"]\n[store]\npath = "{self.store}"\n'
        )

    def umfeld(self, *arguments: str, through: Sequence[str] = ()) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*through, *self.command(*arguments)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=START_S,
            check=False,
        )

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "service", arguments[0], "--config", str(self.config), *arguments[1:]]

    @contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[str]]:
        """A daemon that listens."""
        process = subprocess.Popen(
            self.command("run"), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            wait_for("the daemon", lambda: process.poll() is not None or is_listening(self.endpoint_port), START_S)
            assert process.poll() is None
            yield process
        finally:
            process.kill()
            process.communicate()


def is_listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def assert_told(done: subprocess.CompletedProcess[str], code: int, *words: str) -> str:
    """One line on stderr with these words in it, beside the one that says that kernels are being compiled."""
    lines = [line for line in done.stderr.splitlines() if "compiling the kernels" not in line]
    assert len(lines) == 1, done.stderr + done.stdout
    assert done.returncode == code, done.stderr
    for word in words:
        assert word in lines[0]
    return lines[0]


# --- the configuration ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["run", "check"])
def test_an_unknown_key_names_the_nearest(place: Place, command: str) -> None:
    place.write("baudd_bps = 115200")
    assert_told(place.umfeld(command), 2, "baudd_bps", "baud_bps", str(place.config))


def test_every_fault_has_its_line(place: Place) -> None:
    place.write('baudd_bps = 1\nmount = { x = 1.0 }\n[grid]\nresolution_m = -1.0\nmodel = "guess"')
    done = place.umfeld("run")
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert len(lines) == 4
    assert {
        word for word in ("baudd_bps", "mount", "resolution_m", "model") if any(word in line for line in lines)
    } == {
        "baudd_bps",
        "mount",
        "resolution_m",
        "model",
    }


def test_no_file_under_that_name(place: Place) -> None:
    place.config.unlink()
    assert_told(place.umfeld("run"), 2, str(place.config), "config init")


# --- ports ----------------------------------------------------------------------------------------------------------


class Wall:
    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        return np.full(len(bearing_rad), 2.0)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


class Echo:
    """A device that repeats what it hears, as a loopback plug or a terminal with echo does."""

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        return received


class Chatter:
    """A device of another trade that talks without being asked, as a GPS receiver does."""

    next_ns: int | None = 0

    def step(self, now_ns: int, received: bytes, baud: int | None = None) -> bytes:
        if self.next_ns is not None and now_ns < self.next_ns:
            return b""
        self.next_ns = now_ns + 100_000_000
        return b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"


def laser() -> ByteDevice:
    return HokuyoLaser(Wall(), profile=UTM_30LX, spin_up_s=0.0)


def sonar_board() -> ByteDevice:
    return UsBoardSerial(UsBoard(Wall(), {1: Transducer(Mount())}, boot_s=0.0))


def test_a_port_that_is_not_there(place: Place) -> None:
    told = assert_told(place.umfeld("check", "--seconds", "60"), 1, f"no {place.port}", "plugged in")
    assert told.startswith("front: ")


def test_a_port_that_is_no_port(place: Place) -> None:
    place.port.write_text("not a terminal")
    assert_told(place.umfeld("check", "--seconds", "60"), 1, "is not a serial port")
    assert place.port.read_text() == "not a terminal"


def test_a_port_that_may_not_be_opened(place: Place) -> None:
    with Attachment() as attachment:
        link = PtyLink(place.port)
        attachment.add("laser", laser(), link)
        assert link.tty is not None
        os.chmod(link.tty, 0o000)
        done = place.umfeld("check", "--seconds", "60", through=AS_MERE_OWNER if os.geteuid() == 0 else ())
    assert_told(done, 1, f"no permission on {place.port}", "group", "udev rules")


def test_a_port_that_another_program_holds(place: Place) -> None:
    with Attachment() as attachment:
        attachment.add("laser", laser(), PtyLink(place.port))
        holder = os.open(place.port, os.O_RDWR | os.O_NOCTTY)
        try:
            fcntl.flock(holder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            assert_told(place.umfeld("check", "--seconds", "60"), 1, f"another program holds {place.port}", "fuser")
        finally:
            os.close(holder)


@pytest.mark.parametrize("stranger", [Echo, sonar_board, Chatter])
def test_another_device_on_the_port(place: Place, stranger: Callable[[], ByteDevice]) -> None:
    with Attachment() as attachment:
        attachment.add("laser", stranger(), PtyLink(place.port))
        done = place.umfeld("check", "--seconds", "10")
    told = assert_told(done, 1, "front: ")
    assert any(word in told for word in ("no Hokuyo", "not a Hokuyo", "another device", "does not answer")), told
    assert any(word in told for word in ("check", "port", "`")), told
    assert f"umfeld devices detect {place.port}" in done.stdout


def test_the_same_device_twice_is_found_where_it_is_right(place: Place) -> None:
    """The check of the checks: with the right device on the port all is well."""
    with Attachment() as attachment:
        attachment.add("laser", laser(), PtyLink(place.port))
        done = place.umfeld("check", "--seconds", "100")
    assert done.returncode == 0, done.stderr
    assert not done.stderr


# --- two at once ----------------------------------------------------------------------------------------------------


def test_a_second_daemon_on_the_port_goes_and_the_first_stays(place: Place, tmp_path: Path) -> None:
    with Attachment() as attachment, place.daemon() as first:
        link = PtyLink(place.port)
        attachment.post(lambda: attachment.add("laser", laser(), link))
        wait_for("the laser", lambda: link.counters.sent_bytes > 20_000)
        (tmp_path / "second").mkdir()
        second = Place(tmp_path / "second")
        second.port = place.port
        second.write()
        assert_told(second.umfeld("run"), 1, f"{place.port} is in use", f"process {first.pid}")
        assert_told(second.umfeld("check", "--seconds", "60"), 1, f"{place.port} is in use", f"process {first.pid}")
        assert not second.store.exists()
        sent = link.counters.sent_bytes
        wait_for("more scans for the first", lambda: link.counters.sent_bytes > sent + 50_000)
        first.send_signal(signal.SIGTERM)
        said, _ = first.communicate(timeout=GIVE_UP_S)
        assert first.returncode == 0, said
    with MapStore.open(place.store, wall_ns=lambda: 0, read_only=True) as store:
        assert store.info()


def test_an_address_that_another_program_has(place: Place) -> None:
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", place.endpoint_port))
        other.listen()
        assert_told(place.umfeld("run"), 1, str(place.endpoint_port), "in use", "[network] listen")
        checked = place.umfeld("check", "--seconds", "60")
        assert checked.returncode == 1
        assert any(str(place.endpoint_port) in line and "ss -ltnp" in line for line in checked.stderr.splitlines())
        other.settimeout(0.0)  # and it was left in peace: nobody is still connected
        with pytest.raises(BlockingIOError):
            other.accept()


# --- the map --------------------------------------------------------------------------------------------------------


def test_a_map_that_another_program_writes(place: Place) -> None:
    with place.daemon() as first:
        other = Place(place.folder)
        other.store = place.store
        other.config = place.folder / "other.toml"
        other.port = place.folder / "another-laser"
        other.write()
        assert_told(other.umfeld("run"), 1, str(place.store), f"process {first.pid}", "[store] path")
        assert first.poll() is None


def test_a_map_that_is_locked_by_a_database_browser(place: Place) -> None:
    with place.daemon() as first:
        first.send_signal(signal.SIGTERM)
        first.communicate(timeout=GIVE_UP_S)
    before = place.store.read_bytes()
    browser = sqlite3.connect(place.store)
    try:
        browser.execute("BEGIN EXCLUSIVE")
        assert_told(place.umfeld("run"), 1, str(place.store), "locked", "fuser -v")
    finally:
        browser.close()
    assert place.store.read_bytes() == before


def test_a_file_that_is_no_map_is_left_as_it_is(place: Place) -> None:
    place.store.write_bytes(b"the only copy of my thesis" * 100)
    assert_told(place.umfeld("run"), 1, str(place.store), "[store] path")
    assert place.store.read_bytes() == b"the only copy of my thesis" * 100


def test_a_map_in_a_folder_that_may_not_be_written(place: Place) -> None:
    folder = place.folder / "shut"
    folder.mkdir(mode=0o555)
    place.store = folder / "deep" / "map.umfeld"
    place.write()
    told = place.umfeld("run", through=AS_MERE_OWNER if os.geteuid() == 0 else ())
    assert_told(told, 1, str(place.store), "allow writing", "[store] path")
    assert list(folder.iterdir()) == []


def test_a_torn_map_is_put_aside_and_told(place: Place) -> None:
    """Half of a map's pages are gone: the daemon says so at its start, keeps the broken file, and runs."""
    with place.daemon() as first:
        first.send_signal(signal.SIGTERM)
        first.communicate(timeout=GIVE_UP_S)
    whole = place.store.read_bytes()
    torn = whole[:4096] + b"\xa5" * (len(whole) - 4096)
    place.store.write_bytes(torn)
    with place.daemon() as second:
        second.send_signal(signal.SIGTERM)
        said, _ = second.communicate(timeout=GIVE_UP_S)
        assert second.returncode == 0, said
    (told,) = (line for line in said.splitlines() if "ERROR" in line)
    assert f"{place.store} was damaged" in told
    assert "Traceback" not in said
    assert any(path.read_bytes() == torn for path in place.folder.glob("map*") if path != place.store)
