"""Other people's laser drivers on the emulated lasers, over ptys and TCP, held against the room they stand in.

Packages: pyrplidarsdk (the maker's SDK), rplidar-roboticia or one of its heirs (rplidar-sharpattack, rplidar-mrumel,
rplidar), adafruit-rplidar, pyrplidar, rplidarc1, robot-hat, lds2d, hokuyolx, sick-scan-tcp. Programs, if they are on
the PATH: lms2xx_simple_app and lms2xx_set_variant (sicktoolbox), ldlidar_stl_node (ldlidar_stl_sdk), ultra_simple
(rplidar_sdk), sick_generic_caller (sick_scan_xd, built without ROS; its launch files in the folder named by
SICK_SCAN_LAUNCH), rawlog-grabber and rawlog-edit (mrpt-apps), the C samples of urg_library in the folder named by
URG_SAMPLES.

And the other way round: other people's emulators under our drivers, urg_sim (urg_stamped) and SICK's own test server
(SICK_TEST_SERVER names its test_server.py, in sick_scan_xd).
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import importlib.util
import inspect
import itertools
import json
import os
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from drivers.laser_hokuyo import HokuyoConversation
from drivers.laser_sick_cola import SickColaConversation
from drivers.ports import TcpPort
from drivers.reader import SourceHealth, WireReader
from drivers.readings import ScanReading
from sim_devices.attach import Attachment, TcpLink
from sim_devices.device import F64, ByteDevice, Mount
from sim_devices.laser_hokuyo import PROFILES, HokuyoLaser
from sim_devices.laser_ldrobot import LdLidar
from sim_devices.laser_rplidar import RPLIDAR_PROFILES, RpLidar
from sim_devices.laser_sick_cola import COLA_PROFILES, SickColaLaser
from sim_devices.laser_sick_lms2xx import SickLms2xxLaser
from sim_devices.pty_link import PtyLink

# Mean error of a reader that reads right: 0.0197 m, the lasers' noise and angles rounded to an eighth of a degree; of
# one turn of 286 samples it scatters by 0.0008 m. Half a degree off would be 0.025 m.
NOISE_M = 0.023


class Room:
    """Walls 3 m ahead, 4 m behind, 2 m to the left and 1 m to the right."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        c, s = np.cos(bearing_rad), np.sin(bearing_rad)
        with np.errstate(divide="ignore"):
            along = np.where(c > 0, 3.0, 4.0) / np.abs(c)
            across = np.where(s > 0, 2.0, 1.0) / np.abs(s)
        return np.minimum(along, across)

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return 1.0

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return 0.0, 0.0


def needs(package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"needs {package}")


def needs_program(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"needs {name} on the PATH")


@contextlib.contextmanager
def on_a_pty(device: ByteDevice, path: Path) -> Iterator[str]:
    loop = Attachment()
    loop.add("laser", device, PtyLink(path))
    with loop:
        time.sleep(1.6)  # the device boots and spins up before anybody asks, as on a desk
        yield str(path)


def mean_error_m(clockwise_deg: list[float], range_m: list[float]) -> float:
    """Of what a reader read, against the room."""
    got = np.array([(angle, r) for angle, r in zip(clockwise_deg, range_m) if r > 0.0])
    assert len(got) > 100
    true_m = Room().beam_ranges(Mount(), -np.radians(got[:, 0]), np.zeros(len(got)), 12.0)
    return float(np.abs(got[:, 1] - true_m).mean())


@pytest.fixture
def no_modem_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pty has no DTR and no RTS; drivers that insist on them believe they were set."""
    monkeypatch.setattr(serial.Serial, "_update_dtr_state", lambda self: None)
    monkeypatch.setattr(serial.Serial, "_update_rts_state", lambda self: None)


# -- RPLIDAR -----------------------------------------------------------------------------------------------------------


SDK_PROGRAM = """
import json, sys, time
from pyrplidarsdk import RplidarDriver
reader = RplidarDriver(port=sys.argv[1], baudrate=115200)
assert reader.connect()
info, health = reader.get_device_info(), reader.get_health()
assert reader.start_scan()
turns, end = [], time.monotonic() + 8.0
while len(turns) < 15 and time.monotonic() < end:  # the first ones while the motor gets up to speed
    turn = reader.get_scan_data()
    if turn is not None:
        turns.append(turn)
reader.stop_scan()
reader.disconnect()
print(json.dumps([info.model, repr(health), list(turns[-1][0]), list(turns[-1][1])]))
"""


@needs("pyrplidarsdk")
@pytest.mark.parametrize("model", ["a1", "a2"])
@pytest.mark.parametrize("firmware", [(1, 29), (1, 20)])
def test_makers_sdk_reads_turns(model: str, firmware: tuple[int, int], tmp_path: Path) -> None:
    """In a process of its own: it keeps the interpreter to itself while it waits."""
    told = RPLIDAR_PROFILES[model]
    with on_a_pty(RpLidar(Room(), profile=told, firmware=firmware), tmp_path / "laser") as port:
        program = [sys.executable, "-c", SDK_PROGRAM, port]
        out = subprocess.run(program, capture_output=True, text=True, timeout=30.0, check=True).stdout
    device, health, angle_rad, range_m = json.loads(out.splitlines()[-1])
    assert device == told.model
    assert "OK" in health
    slower = 600 / 660 if told.has_pwm and firmware < (1, 24) else 1.0  # it cannot ask which PWM is best, and takes 600
    assert len(angle_rad) == pytest.approx(4000 / (told.turns_per_s * slower), rel=0.04)
    assert mean_error_m(list(np.degrees(angle_rad)), range_m) < NOISE_M


@needs("rplidar")
@pytest.mark.usefixtures("no_modem_lines")
def test_roboticia_reads_standard_turns(tmp_path: Path) -> None:
    with on_a_pty(RpLidar(Room()), tmp_path / "laser") as port:
        reader = importlib.import_module("rplidar").RPLidar(port)
        try:
            assert reader.get_info()["firmware"] == (1, 29)
            assert reader.get_health() == ("Good", 0)
            turns = list(itertools.islice(reader.iter_scans(), 4))
            _, angles, ranges_mm = zip(*turns[-1])
            assert len(angles) == pytest.approx(2000 / 7, rel=0.05)
            assert mean_error_m(list(angles), [r * 1e-3 for r in ranges_mm]) < NOISE_M
            if "scan_type" in inspect.signature(reader.iter_scans).parameters:  # the heirs of that library
                reader.stop()
                turns = list(itertools.islice(reader.iter_scans("express"), 4))
                assert len(turns[-1]) == pytest.approx(4000 / 7, rel=0.05)
        finally:
            reader.stop()
            reader.disconnect()


@needs("adafruit_rplidar")
@pytest.mark.usefixtures("no_modem_lines")
def test_adafruits_library_reads_turns(tmp_path: Path) -> None:
    with on_a_pty(RpLidar(Room()), tmp_path / "laser") as port:
        reader = importlib.import_module("adafruit_rplidar").RPLidar(None, port)
        try:
            assert reader.health == ("Good", 0)
            _, angles, ranges_mm = zip(*list(itertools.islice(reader.iter_scans(), 4))[-1])
            assert mean_error_m(list(angles), [r * 1e-3 for r in ranges_mm]) < NOISE_M
        finally:
            reader.stop()
            reader.disconnect()


@needs("pyrplidar")
@pytest.mark.usefixtures("no_modem_lines")
def test_pyrplidar_reads_all_kinds_of_scans(tmp_path: Path) -> None:
    with on_a_pty(RpLidar(Room()), tmp_path / "laser") as port:
        reader = importlib.import_module("pyrplidar").PyRPlidar()
        reader.connect(port=port, baudrate=115200, timeout=3)
        assert [mode.name for mode in reader.get_scan_modes()] == ["Standard", "Express"]
        for begin in (reader.force_scan, reader.start_scan, lambda: reader.start_scan_express(0)):
            got = list(itertools.islice(begin()(), 1000))
            assert mean_error_m([s.angle for s in got], [s.distance * 1e-3 for s in got]) < NOISE_M
            reader.stop()
            time.sleep(0.3)
            reader.lidar_serial._serial.reset_input_buffer()
        reader.disconnect()


@needs("rplidarc1")
@pytest.mark.usefixtures("no_modem_lines")
def test_rplidarc1_reads_samples(tmp_path: Path) -> None:
    """Made for the C1, which begins with the same standard scan."""

    async def read(port: str) -> list[dict[str, Any]]:
        reader = importlib.import_module("rplidarc1").RPLidar(port, 115200)
        scanning = asyncio.create_task(reader.simple_scan())
        await asyncio.sleep(2.0)
        reader.stop_event.set()
        await scanning
        reader.shutdown()
        return [reader.output_queue.get_nowait() for _ in range(reader.output_queue.qsize())]

    with on_a_pty(RpLidar(Room()), tmp_path / "laser") as port:
        samples = asyncio.run(read(port))
    assert len(samples) > 1000
    seen = [sample for sample in samples if sample["d_mm"]]
    assert mean_error_m([each["a_deg"] for each in seen], [each["d_mm"] * 1e-3 for each in seen]) < NOISE_M


@needs("robot_hat")
@pytest.mark.usefixtures("no_modem_lines")
def test_robot_hat_reads_samples(tmp_path: Path) -> None:
    settings = importlib.import_module("robot_hat.data_types.config.lidar").RPLidarC1Config
    make = importlib.import_module("robot_hat.sensors.lidar.rplidar_c1").RPLidarC1
    with on_a_pty(RpLidar(Room()), tmp_path / "laser") as port, make(settings(port=port, baudrate=115200)) as reader:
        assert reader.get_device_info().firmware_version == "1.29"
        assert reader.get_health().status.value == "ok"
        reader.start_scan()
        samples = list(itertools.islice(reader.iter_measurements(), 1500))
        reader.stop_scan()
    clockwise_deg = [-each.angle_deg for each in samples]
    assert mean_error_m(clockwise_deg, [each.distance_m for each in samples]) < NOISE_M


@needs("lds2d")
@pytest.mark.parametrize(("model", "device", "points"), [("LD06", LdLidar, 450), ("RPLIDAR-A1", RpLidar, 286)])
def test_lds2d_reads_turns(model: str, device: Any, points: int, tmp_path: Path) -> None:
    with (
        on_a_pty(device(Room()), tmp_path / "laser") as port,
        importlib.import_module("lds2d").Lidar.open(model, port) as reader,
    ):
        turn = list(itertools.islice(reader.scans(), 4))[-1]
        assert len(turn) == pytest.approx(points, rel=0.05)
        assert mean_error_m([p.angle_deg for p in turn], [p.dist_mm * 1e-3 for p in turn]) < NOISE_M


# -- programs ----------------------------------------------------------------------------------------------------------


def heard(command: list[str], until: str, limit_s: float) -> str:
    """Runs a program until a line of its output has come often enough, or time is up; returns its output."""
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert program.stdout is not None
    out, end = "", time.monotonic() + limit_s
    try:
        while time.monotonic() < end and len(re.findall(until, out)) < 5:
            if select.select([program.stdout], [], [], 0.1)[0]:
                data = os.read(program.stdout.fileno(), 65536)
                if not data:
                    break
                out += data.decode("utf-8", errors="replace")
    finally:
        program.kill()
        program.wait()
        program.stdout.close()
    return out


@needs_program("lms2xx_simple_app")
def test_sicktoolbox_starts_and_reads_an_lms200(tmp_path: Path) -> None:
    with on_a_pty(SickLms2xxLaser(Room()), tmp_path / "laser") as port:
        out = heard(["lms2xx_simple_app", port, "38400"], r"Num\. Values: 361", 30.0)
    assert "Sick LMS 200-30106" in out
    assert out.count("Num. Values: 361") >= 5


@needs_program("ldlidar_stl_node")
def test_makers_sdk_reads_an_ld06(tmp_path: Path) -> None:
    with on_a_pty(LdLidar(Room()), tmp_path / "laser") as port:
        out = heard(["ldlidar_stl_node", "LD06", "serialcom", port], r"size:4[45]\d", 15.0)
    sizes = [int(size) for size in re.findall(r"size:(\d+)", out)]
    assert len(sizes) >= 5
    assert all(size == pytest.approx(450, abs=12) for size in sizes[1:])


@needs_program("lms2xx_set_variant")
def test_sicktoolbox_changes_the_variant(tmp_path: Path) -> None:
    with on_a_pty(SickLms2xxLaser(Room()), tmp_path / "laser") as port:
        out = heard(["lms2xx_set_variant", port, "38400"], r"Num\. Values: 361", 40.0)
    counts = [int(count) for count in re.findall(r"Num\. Values: (\d+)", out)]
    assert {401, 361} <= set(counts), "100 degrees by a quarter, then 180 by a half"


@needs_program("ultra_simple")
@pytest.mark.parametrize(("model", "baud"), [("a1", "115200"), ("a2", "115200"), ("a2m7", "256000")])
def test_makers_own_sample_reads_turns(model: str, baud: str, tmp_path: Path) -> None:
    with on_a_pty(RpLidar(Room(), profile=RPLIDAR_PROFILES[model]), tmp_path / "laser") as port:
        program = ["stdbuf", "-o0", "ultra_simple", "--channel", "--serial", port, baud]
        out = heard(program, r"theta: 0\.\d\d .*", 20.0)
    points = re.findall(r"theta: +([\d.]+) Dist: +([\d.]+) Q", out)
    assert "health status : 0" in out
    assert mean_error_m([float(a) for a, _ in points], [float(d) * 1e-3 for _, d in points]) < NOISE_M


# -- MRPT --------------------------------------------------------------------------------------------------------------


MRPT: dict[str, tuple[Any, list[str]]] = {
    "hokuyo-urg": (lambda: HokuyoLaser(Room(), link="usb"), ["CHokuyoURG", "COM_baudRate = 115200"]),
    "hokuyo-utm": (
        lambda: HokuyoLaser(Room(), profile=PROFILES["utm-30lx"]),
        ["CHokuyoURG", "COM_baudRate = 115200"],
    ),
    "hokuyo-ust": (
        lambda: HokuyoLaser(Room(), profile=PROFILES["ust-10lx"]),
        ["CHokuyoURG", "IP_DIR = 127.0.0.1", "PORT_DIR = {port}"],
    ),
    "rplidar": (lambda: RpLidar(Room()), ["CRoboPeakLidar"]),
    "lms200": (
        lambda: SickLms2xxLaser(Room()),
        ["CSickLaserSerial", "COM_baudRate = 38400", "mm_mode = true", "FOV = 180", "resolution = 50"],
    ),
    "lms111": (
        lambda: SickColaLaser(Room(), profile=COLA_PROFILES["lms111"]),
        ["CLMS100Eth", "ip_address = 127.0.0.1", "TCP_port = {port}"],
    ),
}


@needs_program("rawlog-grabber")
@needs_program("rawlog-edit")
@pytest.mark.parametrize("device", MRPT)
def test_mrpt_records_scans_of_the_room(device: str, tmp_path: Path) -> None:
    make, keys = MRPT[device]
    on_tcp = any("{port}" in key for key in keys)
    link: PtyLink | TcpLink = TcpLink(0) if on_tcp else PtyLink(tmp_path / "laser")
    place = f"{link.port}" if isinstance(link, TcpLink) else ""
    lines = [f"driver = {keys[0]}", *(key.format(port=place) for key in keys[1:])]
    if not on_tcp:
        lines.append(f"COM_port_LIN = {tmp_path / 'laser'}")
    pose = [f"pose_{axis} = 0" for axis in ("x", "y", "z", "yaw", "pitch", "roll")]
    whole = [
        "[global]",
        f"rawlog_prefix = {tmp_path / 'log'}",
        "time_between_launches = 300",
        "GRABBER_PERIOD_MS = 500",
    ]
    whole += ["use_sensoryframes = false", "rawlog_GZ_compress_level = 0", "[LASER]", "process_rate = 90"]
    (tmp_path / "grab.ini").write_text("\n".join([*whole, "sensorLabel = laser", *lines, *pose]) + "\n")
    loop = Attachment()
    loop.add("laser", make(), link)
    with loop:
        time.sleep(1.6)
        seconds = 24 if device == "lms111" else 12  # of an LMS100 it asks for the state each 10 s
        subprocess.run(
            ["bash", "-c", f"sleep {seconds} | rawlog-grabber {tmp_path / 'grab.ini'}"],
            cwd=tmp_path, capture_output=True, timeout=seconds + 20, check=False,
        )  # fmt: skip
    (log,) = tmp_path.glob("log*.rawlog")
    subprocess.run(
        ["rawlog-edit", "-i", log.name, "--export-2d-scans-txt"],
        cwd=tmp_path,
        capture_output=True,
        timeout=30,
        check=True,
    )
    ranges = next(path for path in tmp_path.glob("log*_laser.txt") if "times" not in path.name)
    rows = [line.split() for line in ranges.read_text().splitlines() if line and not line.startswith("%")]
    longest = max(map(len, rows))  # a scan without ranges is its note of an answer that it did not wait for
    scans = np.array([row for row in rows if len(row) == longest], dtype=float)  # time, ranges, which of them are valid
    assert len(scans) > len(rows) / 2
    count = (scans.shape[1] - 1) // 2
    ranges_m = scans[-1, 1 : 1 + count]
    if device == "rplidar":  # whose full turn it lays out its own way
        assert np.min(ranges_m[ranges_m > 0.0]) == pytest.approx(1.0, abs=0.1)
    else:
        assert ranges_m[count // 2] == pytest.approx(3.0, abs=0.1), "straight ahead"
    assert scans[-1, 1 + count :].mean() > 0.7


# -- Hokuyo's own library ----------------------------------------------------------------------------------------------


def urg_sample(name: str, *arguments: str) -> str:
    program = Path(os.environ["URG_SAMPLES"]) / name
    return subprocess.run([program, *arguments], capture_output=True, text=True, timeout=30.0, check=True).stdout


@pytest.mark.skipif(not os.environ.get("URG_SAMPLES"), reason="needs URG_SAMPLES")
@pytest.mark.parametrize("kind", ["tcp", "serial, in SCIP 1.1"])
def test_makers_library_reads_a_hokuyo(kind: str, tmp_path: Path) -> None:
    link: PtyLink | TcpLink
    if kind == "tcp":
        laser, link = HokuyoLaser(Room(), profile=PROFILES["ust-10lx"]), TcpLink()  # the samples know one port
        place = ("-e", "127.0.0.1")
    else:
        laser, link = HokuyoLaser(Room(), start_in_scip1=True), PtyLink(tmp_path / "laser")
        place = ("-s", str(tmp_path / "laser"))
    loop = Attachment()
    loop.add("laser", laser, link)
    with loop:
        time.sleep(1.6)
        assert f"sensor data size: {1081 if kind == 'tcp' else 726}" in urg_sample("sensor_parameter", *place)
        for name in ("get_distance", "get_distance_handshake"):
            told = re.findall(r"(\d+) \[mm\]", urg_sample(name, *place))
            assert len(told) == 10
            assert np.mean([int(value) for value in told]) == pytest.approx(3000, abs=20)
        assert len(urg_sample("sync_time_stamp", *place).splitlines()) > 5
        if kind == "tcp":
            assert "3" in urg_sample("get_distance_intensity", *place)


@needs_program("sick_generic_caller")
@pytest.mark.skipif(not os.environ.get("SICK_SCAN_LAUNCH"), reason="needs SICK_SCAN_LAUNCH")
@pytest.mark.parametrize(("profile", "file"), [("tim571", "sick_tim_5xx"), ("lms111", "sick_lms_1xx")])
def test_makers_driver_starts_a_scanner(profile: str, file: str) -> None:
    laser, link = SickColaLaser(Room(), profile=COLA_PROFILES[profile]), TcpLink(0)
    loop = Attachment()
    loop.add("laser", laser, link)
    launch = Path(os.environ["SICK_SCAN_LAUNCH"]) / f"{file}.launch"
    with loop:
        time.sleep(1.5)
        command = ["sick_generic_caller", str(launch), "hostname:=127.0.0.1", f"port:={link.port}"]
        out = heard(command, "packets dropped. Software PLL not yet locked", 20.0)
    assert profile != "tim571" or "Angle resolution of scanner is 0.3333" in out
    assert "sEA LMDscandata" in out
    assert "sFA" not in out
    assert link.counters.sent_bytes > 5 * (3374 if profile == "tim571" else 1100)


@needs("sick_scan_tcp")
@pytest.mark.parametrize(("profile", "count"), [("tim571", 811), ("lms111", 541)])
def test_text_client_that_reads_once_has_a_whole_scan(profile: str, count: int) -> None:
    """One `recv` for each question, whatever came by then: scanners give TCP whole telegrams."""
    link = TcpLink(0)
    loop = Attachment()
    loop.add("laser", SickColaLaser(Room(), profile=COLA_PROFILES[profile]), link)
    with loop:
        time.sleep(1.5)
        host: Any = importlib.import_module("sick_scan_tcp").SickScan("127.0.0.1", link.port)
        angles, ranges_m = host.extract_telegram(host.scan())
        host.set_start_stop_angle(0, 180)
        _, half = host.extract_telegram(host.scan())
        host.release()
    assert (angles[0], angles[-1]) == pytest.approx((-45.0, 225.0), abs=0.05)
    assert len(ranges_m) == count
    assert ranges_m[count // 2] == pytest.approx(3.0, abs=0.1)
    assert len(half) == pytest.approx(count * 2 / 3, abs=2)


def scans_read_by(conversation: Any, port: int, seconds: float) -> tuple[list[ScanReading], SourceHealth]:
    """What our driver reads on this TCP port."""
    heard: list[ScanReading] = []
    reader = WireReader(
        "laser",
        lambda: TcpPort("127.0.0.1", port, clock=time.monotonic_ns),
        {"laser": conversation},
        lambda _, item: heard.append(item) if isinstance(item, ScanReading) else None,
        clock=time.monotonic_ns,
    )
    reader.start()
    time.sleep(seconds)
    told = reader.health().sources["laser"]
    reader.stop()
    return heard, told


@needs_program("urg_sim")
@pytest.mark.parametrize(("model", "product"), [("UTM", "UTM-30LX-EW"), ("UST", "UST-30LC"), ("UUST2", "UST-30LC")])
def test_our_driver_reads_urg_sim(model: str, product: str) -> None:
    """A simulator that times its clock and its scans as the devices do; it knows one port."""
    simulator = subprocess.Popen(["urg_sim", model], stderr=subprocess.DEVNULL)
    try:
        time.sleep(3.0)  # it boots
        heard, told = scans_read_by(HokuyoConversation(), 10940, 4.0)
    finally:
        simulator.kill()
        simulator.wait()
    assert told.identity is not None
    assert told.identity.model == product
    assert told.counters.drops == {}
    assert len(heard) > 80
    assert {len(scan.range_m) for scan in heard} == {1081}
    steps_ms = np.diff([scan.stamp_ns for scan in heard]) * 1e-6
    assert steps_ms.mean() == pytest.approx(25.05, abs=0.05)
    assert steps_ms.std() < 1.0


@pytest.mark.skipif(not os.environ.get("SICK_TEST_SERVER"), reason="needs SICK_TEST_SERVER")
def test_our_driver_reads_sicks_test_server(tmp_path: Path) -> None:
    """It answers some questions, starts when told to run, and sends the same scan of an LMS511 again and again."""
    (tmp_path / "none").touch()  # of recorded scans: it then has one of its own
    arguments = [f"--scandata_file={tmp_path / 'none'}", "--scandata_frequency=25", "--tcp_port=2113"]
    server = subprocess.Popen([sys.executable, os.environ["SICK_TEST_SERVER"], *arguments], stdout=subprocess.DEVNULL)
    try:
        time.sleep(1.0)
        heard, _ = scans_read_by(SickColaConversation(), 2113, 9.0)
    finally:
        server.kill()
        server.wait()
    assert len(heard) > 40
    assert len(heard[-1].range_m) == 1141
    assert heard[-1].range_m[570] == pytest.approx(0.913)


@needs("hokuyolx")
def test_hokuyolx_over_tcp() -> None:
    """Time synchronisation, information, single scans, streams, filters and every change of state."""
    laser, link = HokuyoLaser(Room(), profile=PROFILES["ust-10lx"], link="tcp"), TcpLink(0)
    loop = Attachment()
    loop.add("laser", laser, link)
    with loop:
        time.sleep(2.5)
        host: Any = importlib.import_module("hokuyolx").HokuyoLX(addr=("127.0.0.1", link.port), convert_time=False)
        assert host.version()["PROT"].startswith("SCIP 2")
        assert host.sensor_parameters()["AMAX"] == 1080
        bearing = np.radians((np.arange(1081) - 540) * 0.25)
        true_mm = 1000.0 * Room().beam_ranges(Mount(), bearing, np.zeros(1081), 30.0)
        for _, scan in (host.get_dist(), (0, host.get_intens()[1][:, 0])):
            assert np.abs(scan - true_mm).mean() < 1000.0 * NOISE_M
        assert [len(each) for each in host.iter_dist(4)] == [3] * 4
        assert len(list(host.iter_intens(2, skips=1))) == 2
        host.standby()
        assert host.laser_state()[0] == 0
        host.sleep()
        assert host.laser_state()[0] == 5
        assert host.activate()[0] == 0
        host.partial_reset()
        host.reset()
        host.close()
