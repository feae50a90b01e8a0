"""What holds for every emulator, whatever a host sends and however time passes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.attach import MemoryLink
from sim_devices.device import F64, Frame, Mount
from sim_devices.encoder_cia406 import FULL_RANGE, Cia406Encoder
from sim_devices.faults import KINDS, FaultPlan, FaultSyntaxError, parse_fault
from sim_devices.laser_hokuyo import PROFILES, UTM_30LX, HokuyoLaser, LaserProfile
from sim_devices.slcan_hub import CanBus, CanBusStation
from sim_devices.sonar_usboard import Transducer, UsBoard, UsBoardCan, UsBoardSerial
from sim_devices.wire import PacedWire

MS = 1_000_000
SECOND = 1_000_000_000


class Anything:
    """Ranges of every sort, wheels that turn both ways."""

    def beam_ranges(self, mount: Mount, bearing_rad: F64, stamp_ns: F64, range_max_m: float) -> F64:
        sorts = np.array([0.0, 0.01, 1.0, 5.0, 70.0, np.inf, -np.inf, np.nan])
        return sorts[(np.arange(len(bearing_rad)) + int(stamp_ns[0] if len(stamp_ns) else 0)) % len(sorts)]

    def cone_range(self, mount: Mount, half_angle_rad: float, now_ns: int, range_max_m: float) -> float:
        return [0.05, 1.0, 9.0, math.inf][now_ns // MS % 4]

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        return math.sin(now_ns * 1e-9), -0.5 * now_ns * 1e-9


def well_formed(reply: bytes) -> bool:
    """A whole SCIP 2 reply: echo, status with its sum, lines with theirs."""
    echo, status, *lines = reply.split(b"\n")
    sums = [line[-1] in (total(line[:-1]), total(line[:-2])) for line in lines if line]
    return len(status) == 3 and status[2] == total(status[:2]) and all(sums) and b"\r" not in echo


def total(line: bytes) -> int:
    return (sum(line) & 0x3F) + 0x30


COMMANDS = st.sampled_from(
    [b"VV", b"PP", b"II", b"QT", b"BM", b"RS", b"TM0", b"TM1", b"TM2", b"HS1", b"CR05", b"RB", b"%ST", b"DB05", b"DB10",
     b"MD0044072501000", b"MS0044072503202", b"ME0000108001001", b"GD0044072501", b"GS0000076899", b"SS115200", b"XX"]
)  # fmt: skip


@given(st.lists(COMMANDS, max_size=12), st.sampled_from(sorted(PROFILES)), st.data())
@settings(max_examples=60, deadline=None)
def test_laser_answers_the_same_however_its_commands_are_cut(
    commands: list[bytes], profile: str, data: st.DataObject
) -> None:
    sent = b"".join(command + b"\n" for command in commands)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=6)))
    replies = []
    for pieces in ([sent], [sent[a:b] for a, b in zip([0, *cuts], [*cuts, len(sent)])]):
        laser = HokuyoLaser(Anything(), profile=PROFILES[profile], link="usb", spin_up_s=0.0, noise_scale=0.0)
        laser.step(0, b"")
        out = b"".join(laser.step(SECOND, piece) for piece in pieces)
        replies.append(out + b"".join(laser.step(SECOND + i * 20 * MS, b"QT\n" if i == 20 else b"") for i in range(60)))
    assert replies[0] == replies[1]
    for reply in replies[0].split(b"\n\n")[:-1]:
        assert well_formed(reply), reply


@given(st.binary(max_size=300), st.lists(st.integers(0, 300 * MS), max_size=8))
@settings(max_examples=80, deadline=None)
def test_laser_survives_any_bytes(junk: bytes, pauses: list[int]) -> None:
    laser = HokuyoLaser(Anything(), profile=UTM_30LX, spin_up_s=0.0)
    now_ns = 0
    for number, pause in enumerate(pauses):
        now_ns += pause
        laser.step(now_ns, junk[number::8])
    now_ns += SECOND
    laser.step(now_ns, junk + b"\n")
    laser.step(now_ns + 2 * SECOND, b"\nTM2\nQT\n")
    assert laser.step(now_ns + 4 * SECOND, b"").endswith(b"QT\n00P\n\n")


@given(
    st.sampled_from(sorted(PROFILES)),
    st.integers(0, 768),
    st.integers(0, 768),
    st.integers(0, 99),
    st.sampled_from("DS"),
)
@settings(max_examples=60, deadline=None)
def test_scan_has_as_many_values_as_asked_for(profile: str, one: int, other: int, cluster: int, form: str) -> None:
    told: LaserProfile = PROFILES[profile]
    start, end = sorted((one, other))
    laser = HokuyoLaser(Anything(), profile=told, link="tcp", spin_up_s=0.0)
    laser.step(0, b"")
    laser.step(SECOND, f"M{form}{start:04d}{end:04d}{cluster:02d}001\n".encode())
    reply = laser.step(3 * SECOND, b"").split(b"\n\n")[1]
    data = b"".join(line[:-1] for line in reply.split(b"\n")[3:])
    assert well_formed(reply)
    assert len(data) == (2 if form == "S" else 3) * ((end - start) // max(1, cluster) + 1)


@given(st.lists(st.binary(min_size=1, max_size=200), max_size=10), st.lists(st.integers(50_000, 40 * MS), min_size=1))
@settings(deadline=None)
def test_paced_wire_keeps_order_and_never_hurries(messages: list[bytes], steps: list[int]) -> None:
    wire = PacedWire(19200)
    now_ns, out, queued = 0, b"", list(messages)
    while queued or not wire.is_empty:
        if queued:
            wire.send(queued.pop(0), now_ns)
        now_ns += steps[len(out) % len(steps)]
        out += wire.leave_by(now_ns)
        assert len(out) <= now_ns * 1920 / SECOND
    assert out == b"".join(messages)
    assert not wire.busy_at(now_ns)


@given(st.lists(st.binary(max_size=40), max_size=12))
@settings(deadline=None)
def test_slcan_adapter_survives_any_bytes_and_answers_every_line(pieces: list[bytes]) -> None:
    station = CanBusStation(CanBus())
    link, other = MemoryLink(), MemoryLink()
    station.add_member("a", link)
    station.add_member("b", other)
    for number, piece in enumerate(pieces):
        link.host_write(piece)
        station.service(number * MS)
    link.host_write(b"\rC\rV\r")
    station.service(100 * MS)
    replies = link.host_read()
    assert replies.endswith(b"V1013\r")
    assert replies.count(b"\r") + replies.count(b"\x07") >= b"".join(pieces).count(b"\r") + 3


@st.composite
def any_frame(draw: st.DrawFn) -> Frame:
    extended, remote = draw(st.booleans()), draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    if remote:
        return Frame(can_id, extended=extended, remote=True, dlc=draw(st.integers(0, 8)))
    return Frame(can_id, draw(st.binary(max_size=8)), extended=extended)


@given(st.lists(any_frame(), max_size=8))
@settings(deadline=None)
def test_frames_cross_the_bus_unchanged(frames: list[Frame]) -> None:
    class Ear:
        def __init__(self) -> None:
            self.heard: list[Frame] = []

        def step(self, now_ns: int, received: Sequence[Frame]) -> list[Frame]:
            self.heard += received
            return []

    bus, ear = CanBus(), Ear()
    station = CanBusStation(bus)
    links = MemoryLink(), MemoryLink()
    for name, link in zip("ab", links):
        station.add_member(name, link)
        link.host_write(b"O\r")
    station.service(0)
    for frame in frames:
        bus.send(None, frame)
    station.service(MS)
    links[1].host_read()
    bus.add_node("ear", ear)
    links[1].host_write(links[0].host_read()[1:])  # what one host hears, the other sends
    station.service(2 * MS)
    assert ear.heard == frames


@given(st.lists(st.tuples(st.sampled_from([0x000, 0x080, 0x621, 0x721, 0x1A1]), st.binary(max_size=8)), max_size=20))
@settings(deadline=None)
def test_encoder_survives_any_frames_and_answers_sdo_with_eight_bytes(told: list[tuple[int, bytes]]) -> None:
    encoder = Cia406Encoder(Anything(), 0x21, boot_s=0.0)
    encoder.step(0, [])
    for number, (can_id, data) in enumerate(told):
        for frame in encoder.step((number + 1) * 3 * MS, [Frame(can_id, data)]):
            assert frame.can_id != 0x5A1 or len(frame.data) == 8
            assert len(frame.data) <= 8
    encoder.step(SECOND, [Frame(0, bytes((0x81, 0)))])
    booted = encoder.step(2 * SECOND, [])
    assert Frame(0x721, b"\0") in booted


@given(
    st.lists(st.tuples(st.sampled_from([0x6000, 0x6001, 0x6002, 0x6003]), st.integers(0, FULL_RANGE - 1)), max_size=6)
)
@settings(deadline=None)
def test_position_stays_within_its_range_and_preset_is_shown(settings_: list[tuple[int, int]]) -> None:
    encoder = Cia406Encoder(Anything(), 0x21, boot_s=0.0)
    encoder.step(0, [])
    for index, value in settings_:
        size = 2 if index == 0x6000 else 4
        value %= 1 << 8 * size
        head = bytes((0x23 | (4 - size) << 2,)) + index.to_bytes(2, "little") + b"\0"
        (answer,) = encoder.step(MS, [Frame(0x621, head + value.to_bytes(size, "little").ljust(4, b"\0"))])
        if index == 0x6003 and answer.data[0] == 0x60:
            assert encoder.position(MS) == value
        assert 0 <= encoder.position(MS) < FULL_RANGE


@given(st.lists(st.binary(max_size=8), max_size=15), st.integers(0, 3))
@settings(deadline=None)
def test_board_survives_any_commands(commands: list[bytes], mode: int) -> None:
    parameters = bytearray(UsBoard(Anything(), {}).eeprom)
    parameters[6] = 0xF0 | mode
    fitted = {channel: Transducer(Mount(x_m=channel)) for channel in range(1, 12)}
    on_can = UsBoardCan(UsBoard(Anything(), fitted, parameters=bytes(parameters)))
    on_serial = UsBoardSerial(UsBoard(Anything(), fitted, parameters=bytes(parameters)))
    on_can.step(0, [])
    on_serial.step(0, b"")
    for number, command in enumerate(commands):
        now_ns = SECOND + number * 70 * MS
        base = on_can.board.base_id
        sent = on_can.step(now_ns, [Frame(base, command, extended=on_can.board.extended_ids)])
        assert all(len(frame.data) == 8 for frame in sent)
        on_serial.step(now_ns, command)
    packets = on_serial.step(60 * SECOND, b"")
    assert len(packets) % 11 in range(11)


@given(st.text(max_size=40))
def test_any_text_is_a_fault_or_a_complaint(text: str) -> None:
    for candidate in (text, f"laser:{text}", f"laser:flip{text}"):
        try:
            fault = parse_fault(candidate)
        except FaultSyntaxError:
            continue
        assert fault.kind in KINDS
        assert fault.end_ns > fault.start_ns


@given(st.lists(st.sampled_from(sorted(KINDS)), max_size=5), st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_any_mix_of_faults_runs_repeats_and_ends(kinds: list[str], seed: int) -> None:
    """Devices under any faults neither crash nor differ from run to run, and are themselves again afterwards."""
    texts = [f"{target}:{kind}@{100 + 40 * i}ms+200ms" for i, kind in enumerate(kinds) for target in ("laser", "node")]
    runs = []
    for _ in range(2):
        plan = FaultPlan(texts, seed=seed)
        laser = plan.device("laser", HokuyoLaser(plan.scene("laser", Anything()), profile=UTM_30LX, spin_up_s=0.0))
        board = UsBoard(plan.scene("node", Anything()), {1: Transducer(Mount())}, boot_s=0.0)
        nodes = [plan.node("node", UsBoardCan(board)), plan.node("node", Cia406Encoder(Anything(), 9, boot_s=0.0))]
        said: list[object] = []
        for i in range(60):
            now_ns = SECOND + i * 10 * MS
            said.append(laser.step(now_ns, b"MD0000001001000\n" if i == 0 else b""))
            said += [node.step(now_ns, [Frame(0x400, bytes((13, 1)))]) for node in nodes]
        laser.step(5 * SECOND, b"")
        laser.step(6 * SECOND, b"")
        laser.step(7 * SECOND, b"TM2\nQT\n")
        assert laser.step(8 * SECOND, b"").endswith(b"QT\n00P\n\n")
        runs.append(said)
    assert runs[0] == runs[1]
