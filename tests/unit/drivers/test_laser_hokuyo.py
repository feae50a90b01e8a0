"""The conversation with a Hokuyo laser, against a peer that replays replies of the protocol's worked exchanges.

The peer is a table of replies with a few switches; it is no emulator. Time is turned by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.conversation import SetBaudRate
from drivers.laser_hokuyo import Codes, HokuyoConversation, Protocol
from drivers.readings import LinkState, ScanReading

MS = 1_000_000
S = 1000 * MS

VV_URG = (
    b"VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\nFIRM:3.1.00(18/Jan./2007);`\n"
    b"PROT:SCIP 2.0;N\nSERI:H0614967;V\n\n"
)
PP_URG = (
    b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
)
II_URG = (
    b"II\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nLASR:OFF;7\n"
    b"SCSP:Initial(600[rpm])<-Default setting by user;A\nMESM:IDLE;:\nSBPS:19200[bps]<-Default setting by user;A\n"
    b"TIME:001957;O\nSTAT:Sensor works well.;8\n\n"
)


def line(text: bytes) -> bytes:
    """A line with its sum: written out here so that a wrong sum in the driver does not agree with itself."""
    return text + bytes([sum(text) % 64 + 48]) + b"\n"


def keyed(text: bytes) -> bytes:
    return text + b";" + bytes([sum(text) % 64 + 48]) + b"\n"


PP_UTM = (
    b"PP\n00P\n"
    + keyed(b"MODL:UTM-30LX(Hokuyo Automatic Co.,Ltd.)")
    + b"DMIN:23;7\nDMAX:60000;J\nARES:1440;^\nAMIN:0;?\nAMAX:1080;Z\nAFRT:540;0\nSCAN:2400;U\n\n"
)


def number(value: int, chars: int) -> bytes:
    digits: list[int] = []
    for _ in range(chars):
        value, digit = divmod(value, 64)
        digits.insert(0, digit + 48)
    assert value == 0
    return bytes(digits)


def scan_reply(echo: bytes, stamp_ms: int, values: list[int], status: bytes = b"99b", chars: int = 3) -> bytes:
    data = b"".join(number(value, chars) for value in values)
    blocks = b"".join(line(data[at : at + 64]) for at in range(0, len(data), 64))
    return echo + b"\n" + status + b"\n" + line(number(stamp_ms % (1 << 24), 4)) + blocks + b"\n"


@dataclass
class Peer:
    """Answers as tabulated; streams scans of a wall on a clock of its own while MD is on."""

    utm: bool = False
    scip1: bool = False
    time_mode: bool = False
    power: bool = True
    speed: int | None = None  # None: USB, any speed will do
    paced: bool = False  # bytes trickle as slowly as the speed
    streaming: bytes = b""
    laser_trouble: bool = False
    has_time_mode: bool = True
    mute_to: tuple[bytes, ...] = ()
    speaks_me: bool = True
    clock_offset_ms: float = 5_000.0  # device clock ahead of the host's
    drift: float = 0.0
    spin_up_ns: int = 0
    delay_ns: int = 1 * MS
    range_mm: int = 1000
    values: list[int] | None = None
    line_speed: int = 0
    received: list[bytes] = field(default_factory=list)
    next_step0_ns: int = 0
    pending: list[tuple[int, bytes]] = field(default_factory=list)
    new_speed: int | None = None

    def period_ns(self) -> int:
        turn = 25 * MS if self.utm else 100 * MS
        return turn * (int(self.streaming[12:13] or b"0") + 1)

    def clock_ms(self, now_ns: int) -> int:
        return int((now_ns * (1.0 + self.drift)) / MS + self.clock_offset_ms)

    def heard(self, item: bytes | SetBaudRate, now_ns: int) -> None:
        if isinstance(item, SetBaudRate):
            self.line_speed = item.bits_per_s
            return
        if not self.power or (self.speed is not None and self.line_speed != self.speed):
            return
        for command in item.split(b"\n")[:-1]:
            self.received.append(command)
            reply = self.answer(command, now_ns)
            if reply:
                self.send(reply, now_ns)
            if self.new_speed is not None:
                self.speed, self.new_speed = self.new_speed, None

    def send(self, reply: bytes, at_ns: int) -> None:
        if self.paced and self.speed is not None:
            at_ns = max([at_ns, *(when for when, _ in self.pending)])
            for start in range(0, len(reply), 4):
                at_ns += len(reply[start : start + 4]) * 10_000 * MS // self.speed
                self.pending.append((at_ns, reply[start : start + 4]))
        else:
            self.pending.append((at_ns + self.delay_ns, reply))

    def answer(self, command: bytes, now_ns: int) -> bytes:
        if command[:2] in self.mute_to:
            return b""
        if command == b"SCIP2.0":
            reply = b"SCIP2.0\n0\n\n" if self.scip1 else b"SCIP2.0\n0Ee\n\n"
            self.scip1 = False
            return reply
        if self.scip1:
            return command + b"\nE\n\n"
        if command in (b"QT", b"RS"):
            self.streaming = b""
            if command == b"RS":
                self.time_mode = False
            return command + b"\n00P\n\n"
        if command[:2] == b"TM" and self.has_time_mode:
            return self.answer_time(command, now_ns)
        if self.time_mode:
            return command + b"\n0Ee\n\n"
        if command[:2] == b"SS":
            self.new_speed = int(command[2:]) if self.speed is not None else None
            return command + b"\n00P\n\n"
        if command == b"BM":
            return b"BM\n01Q\n\n" if self.laser_trouble else b"BM\n00P\n\n"
        if command[:2] in (b"MD", b"MS") or (command[:2] == b"ME" and self.speaks_me):
            if int(command[6:10]) > (1080 if self.utm else 768):
                return command + b"\n04T\n\n"
            self.streaming = command
            self.next_step0_ns = now_ns + self.spin_up_ns
            return command + b"\n00P\n\n"
        texts = {b"VV": VV_URG, b"PP": PP_UTM if self.utm else PP_URG, b"II": II_URG}
        return texts.get(command, command + b"\n0Ee\n\n")

    def answer_time(self, command: bytes, now_ns: int) -> bytes:
        if command == b"TM0":
            reply = b"TM0\n02R\n\n" if self.time_mode else b"TM0\n00P\n\n"
            self.time_mode = True
            return reply
        if command == b"TM2":
            reply = b"TM2\n00P\n\n" if self.time_mode else b"TM2\n03S\n\n"
            self.time_mode = False
            return reply
        return b"TM1\n00P\n" + line(number(self.clock_ms(now_ns + self.delay_ns // 2) % (1 << 24), 4)) + b"\n"

    def scan(self, step0_ns: int) -> bytes:
        request = self.streaming
        count = (int(request[6:10]) - int(request[2:6])) // max(int(request[10:12]), 1) + 1
        values = self.values or [self.range_mm] * count
        if request[:2] == b"ME":
            values = [n for value in values for n in (value, value + 7)]
        chars = 2 if request[:2] == b"MS" else 3
        return scan_reply(request, self.clock_ms(step0_ns), values, chars=chars)

    def step(self, now_ns: int) -> Iterator[tuple[int, bytes]]:
        """What has arrived by now, with its time."""
        while self.power and self.streaming and self.next_step0_ns + self.sweep_ns() <= now_ns:
            self.send(self.scan(self.next_step0_ns), self.next_step0_ns + self.sweep_ns())
            self.next_step0_ns += self.period_ns()
        due = sorted((item for item in self.pending if item[0] <= now_ns), key=lambda item: item[0])
        self.pending = [item for item in self.pending if item[0] > now_ns]
        yield from due

    def sweep_ns(self) -> int:
        turn, ares = (25 * MS, 1440) if self.utm else (100 * MS, 1024)
        return turn * int(self.streaming[6:10]) // ares


class Bench:
    """Turns the crank: peer and conversation, one millisecond a turn."""

    def __init__(self, conversation: HokuyoConversation, peer: Peer, now_ns: int = 1000 * S) -> None:
        self.conversation, self.peer, self.now_ns = conversation, peer, now_ns
        self.readings: list[ScanReading] = []
        self.arrivals: list[int] = []
        self.garble: Callable[[bytes], bytes] = bytes
        conversation.connected(now_ns)

    def run(self, duration_ns: int, *, turn_ns: int = MS) -> Bench:
        end = self.now_ns + duration_ns
        while self.now_ns < end:
            for item in self.conversation.requests(self.now_ns):
                self.peer.heard(item, self.now_ns)
            self.now_ns += turn_ns
            for when, chunk in self.peer.step(self.now_ns):
                for reading in self.conversation.receive(self.garble(chunk), when):
                    assert isinstance(reading, ScanReading)
                    self.readings.append(reading)
                    self.arrivals.append(when)
                for item in self.conversation.requests(when):
                    self.peer.heard(item, when)
        return self

    def run_until(self, condition: Callable[[], bool], limit_ns: int) -> int:
        start = self.now_ns
        while not condition():
            assert self.now_ns - start < limit_ns, f"not within {limit_ns / S} s; {self.conversation.trouble}"
            self.run(10 * MS)
        return self.now_ns - start

    def run_until_running(self, limit_ns: int = 5 * S) -> int:
        return self.run_until(lambda: self.conversation.state is LinkState.RUNNING, limit_ns)


def bench(peer: Peer, protocol: Protocol = "MD") -> Bench:
    return Bench(HokuyoConversation(protocol=protocol), peer)


def test_from_power_on_to_scans() -> None:
    b = bench(Peer())
    assert b.conversation.state is LinkState.SILENT
    assert b.run_until_running() < 1 * S
    identity = b.conversation.identity
    assert identity is not None
    assert (identity.vendor, identity.model) == ("Hokuyo Automatic Co.,Ltd.", "URG-04LX")
    assert (identity.serial, identity.firmware) == ("H0614967", "3.1.00(18/Jan./2007)")
    assert b.peer.received[-1] == b"MD0044072501000"
    b.run(1 * S)
    assert len(b.readings) == 11
    assert b.conversation.counters.drops == {}
    assert b.conversation.counters.readings == len(b.readings)
    assert b.conversation.trouble is None


def test_geometry_of_a_urg() -> None:
    reading = bench(Peer()).run(1 * S).readings[0]
    assert reading.bearing_rad.shape == reading.range_m.shape == (682,)
    assert math.degrees(reading.bearing_rad[0]) == pytest.approx(-119.53125)
    assert math.degrees(reading.bearing_rad[-1]) == pytest.approx(119.8828125)
    assert reading.bearing_rad[384 - 44] == 0.0
    assert (reading.range_min_m, reading.range_max_m) == (0.02, 5.6)
    assert reading.beam_period_ns == pytest.approx(100 * MS / 1024)
    assert reading.scan_period_ns == 100 * MS
    assert reading.intensity is None
    assert set(reading.range_m) == {1.0}


def test_geometry_of_a_utm_follows_its_parameters() -> None:
    reading = bench(Peer(utm=True, range_mm=25_000)).run(1 * S).readings[0]
    assert reading.bearing_rad.shape == (1081,)
    assert math.degrees(reading.bearing_rad[0]) == pytest.approx(-135.0)
    assert math.degrees(reading.bearing_rad[-1]) == pytest.approx(135.0)
    assert reading.range_max_m == 60.0
    assert reading.range_m[5] == 25.0


@pytest.mark.parametrize(
    "peer",
    [
        Peer(scip1=True),
        Peer(time_mode=True),
        Peer(streaming=b"MD0044072501000", next_step0_ns=1000 * S),
        Peer(has_time_mode=False),
        Peer(utm=True, streaming=b"ME0000108001000", next_step0_ns=1000 * S),
    ],
    ids=["scip 1.1 after power-on", "left in time mode", "left streaming", "no time mode", "left with intensities"],
)
def test_starts_from_any_state(peer: Peer) -> None:
    b = bench(peer)
    b.run_until_running()
    b.run(1 * S)
    assert b.conversation.trouble is None
    assert len(b.readings) >= 9


def test_intensities_when_asked_and_where_possible() -> None:
    reading = bench(Peer(utm=True), "ME").run(1 * S).readings[0]
    assert reading.intensity is not None
    assert set(reading.intensity) == {1007.0}
    assert set(reading.range_m) == {1.0}
    assert bench(Peer(utm=True), "auto").run(1 * S).readings[0].intensity is not None
    assert bench(Peer(speaks_me=False), "auto").run(1 * S).readings[0].intensity is None
    refused = bench(Peer(speaks_me=False), "ME").run(1 * S)
    assert refused.readings == []
    assert "refuses ME" in str(refused.conversation.trouble)


def test_short_distances_end_at_4095() -> None:
    peer = Peer(values=[1000, 4095] + [4094] * 680)
    reading = bench(peer, "MS").run(1 * S).readings[0]
    assert list(reading.range_m[:3]) == [1.0, math.inf, 4.094]
    assert reading.range_max_m == 4.095


@pytest.mark.parametrize(
    ("utm", "codes", "expected"),
    [
        (False, "auto", {0: math.inf, 1: math.nan, 7: math.nan, 18: math.nan, 19: math.nan, 20: 0.02, 5601: math.inf}),
        (True, "auto", {0: math.nan, 1: math.inf, 2: math.nan, 4: -math.inf, 22: math.nan, 23: 0.023, 60001: math.inf}),
        (True, "urg", {0: math.inf, 1: math.nan, 4: math.nan}),
        (True, "auto", {65533: math.inf, 65535: math.inf}),
    ],
)
def test_codes_are_not_distances(utm: bool, codes: Codes, expected: dict[int, float]) -> None:
    count = 1081 if utm else 682
    peer = Peer(utm=utm, values=(list(expected) + [3000] * count)[:count])
    reading = Bench(HokuyoConversation(error_codes=codes), peer).run(1 * S).readings[0]
    for at, value in enumerate(expected.values()):
        assert reading.range_m[at] == pytest.approx(value, nan_ok=True)


def test_limits_of_the_user_are_narrower_only() -> None:
    peer = Peer(values=[0, 25, 99, 100, 4000, 4001] + [3000] * 676)
    conversation = HokuyoConversation(range_min_m=0.1, range_max_m=4.0)
    reading = Bench(conversation, peer).run(1 * S).readings[0]
    assert list(reading.range_m[:6]) == [math.inf, -math.inf, -math.inf, 0.1, 4.0, math.inf]
    assert (reading.range_min_m, reading.range_max_m) == (0.1, 4.0)
    wide = Bench(HokuyoConversation(range_max_m=100.0), Peer()).run(1 * S).readings[0]
    assert wide.range_max_m == 5.6


def test_part_of_the_field_with_clusters_and_skipped_scans() -> None:
    conversation = HokuyoConversation(first_step=100, last_step=110, cluster=4, skip_interval=1)
    b = Bench(conversation, Peer()).run(3 * S)
    assert b.peer.received[-1] == b"MD0100011004100"
    reading = b.readings[1]
    # Groups 100..103, 104..107 and the short one 108..110, each seen at its middle.
    expected = (np.array([101.5, 105.5, 109.0]) - 384) * 2 * math.pi / 1024
    np.testing.assert_allclose(reading.bearing_rad, expected)
    assert reading.scan_period_ns == 200 * MS
    assert reading.beam_period_ns == pytest.approx(4 * 100 * MS / 1024)
    assert b.conversation.silence_limit_ns == 500 * MS
    assert b.conversation.state is LinkState.RUNNING


def test_steps_outside_the_field_name_the_repair() -> None:
    b = Bench(HokuyoConversation(last_step=800), Peer()).run(2 * S)
    assert b.readings == []
    assert "between 44 and 725" in str(b.conversation.trouble)


@pytest.mark.parametrize(
    "arguments",
    [
        {"protocol": "GD"},
        {"cluster": 0},
        {"skip_interval": 10},
        {"first_step": 10, "last_step": 9},
        {"first_step": -1},
        {"error_codes": "sick"},
    ],
)
def test_wrong_arguments(arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        HokuyoConversation(**arguments)  # type: ignore[arg-type]


# Stamps.


@pytest.mark.parametrize("drift", [0.0, 80e-6, -80e-6])
@pytest.mark.parametrize("delay_ms", [1, 9])
def test_stamp_is_the_first_beam_on_the_host_clock(drift: float, delay_ms: int) -> None:
    """Over more than one wrap of the device's counter, to a millisecond (its tick), whatever the delay of the wire."""
    peer = Peer(drift=drift, delay_ns=delay_ms * MS, clock_offset_ms=16_777_216 - 1_003_000.0)
    b = bench(peer)
    b.run_until_running()
    first_step0 = peer.next_step0_ns - len(b.readings) * peer.period_ns()
    b.run(25 * S)
    for at, reading in enumerate(b.readings):
        true_ns = first_step0 + at * 100 * MS + 100 * MS * 44 // 1024
        assert abs(reading.stamp_ns - true_ns) < 1.6 * MS, at
    stamps = np.array([reading.device_stamp_ns for reading in b.readings], dtype=np.float64)
    assert np.abs(np.diff(stamps) - 100 * MS).max() <= 1.1 * MS
    fit = b.conversation.clock_fit
    assert fit is not None
    assert fit.samples >= 200
    assert fit.drift_ppm == pytest.approx(-drift * 1e6, abs=60)
    last = b.readings[-1]
    assert last.device_stamp_ns is not None
    assert fit.offset_ns + last.device_stamp_ns * (1 + fit.drift_ppm * 1e-6) == pytest.approx(last.stamp_ns, abs=2 * MS)


def test_no_beam_is_later_than_its_bytes() -> None:
    b = bench(Peer(utm=True)).run(3 * S)
    for reading, arrived in zip(b.readings, b.arrivals, strict=True):
        assert reading.stamp_ns + reading.beam_period_ns * (reading.range_m.size - 1) <= arrived + 1
    assert all(a.stamp_ns < c.stamp_ns for a, c in zip(b.readings, b.readings[1:], strict=False))


def test_late_scans_keep_their_stamps() -> None:
    """The host sleeps for 0.3 s; what waited in the port then comes at once and must not be stamped "now"."""
    b = bench(Peer(utm=True))
    b.run_until_running()
    b.run(2 * S)
    before = len(b.readings)
    b.run(300 * MS, turn_ns=300 * MS)
    b.run(100 * MS)
    steps = np.diff([reading.stamp_ns for reading in b.readings[before - 1 :]])
    assert len(steps) >= 14
    assert np.abs(steps - 25 * MS).max() < 2 * MS
    assert b.peer.received.count(b"QT") == 1


def test_a_device_clock_that_jumps_starts_the_fit_anew() -> None:
    b = bench(Peer())
    b.run_until_running()
    b.run(6 * S)
    b.peer.clock_offset_ms -= 3_000
    before = len(b.readings)
    b.run(2 * S)
    assert b.conversation.counters.drops == {"implausible_stamp": 2}
    assert len(b.readings) - before == 18
    delay = np.array(b.arrivals[before:]) - [reading.stamp_ns for reading in b.readings[before:]]
    assert np.all(delay < 80 * MS)


def test_a_device_without_a_running_clock_is_timed_by_arrival() -> None:
    class Stopped(Peer):
        def clock_ms(self, now_ns: int) -> int:
            return 777

    b = Bench(HokuyoConversation(), Stopped())
    b.run_until_running()
    b.run(1500 * MS)
    assert "clock" in str(b.conversation.trouble)
    assert b.readings[-1].device_stamp_ns is None
    assert np.diff([reading.stamp_ns for reading in b.readings[-5:]]) == pytest.approx(100 * MS)


def test_one_false_stamp_costs_one_scan() -> None:
    """A stamp whose sum is right but that cannot be (two changes that cancel) is not believed."""
    b = bench(Peer())
    b.run_until_running()
    b.run(6 * S)
    b.peer.clock_offset_ms += 64
    b.run_until(lambda: len(b.conversation.counters.drops) > 0, 1 * S)
    b.peer.clock_offset_ms -= 64
    before = len(b.readings)
    b.run(1 * S)
    assert b.conversation.counters.drops == {"implausible_stamp": 1}
    assert len(b.readings) - before == 10


# Faults.


def test_silence_is_seen_and_the_device_comes_back() -> None:
    b = bench(Peer())
    b.run_until_running()
    b.run(1 * S)
    b.peer.power = False
    seen = b.run_until(lambda: b.conversation.state is LinkState.SILENT, 1 * S)
    assert seen <= 500 * MS
    b.run(5 * S)
    assert "check power" in str(b.conversation.trouble)
    b.peer.power, b.peer.scip1, b.peer.streaming = True, True, b""
    b.peer.clock_offset_ms = -b.now_ns / MS
    assert b.run_until_running() <= 2 * S
    assert b.conversation.trouble is None
    b.run(1 * S)
    assert "implausible_stamp" not in b.conversation.counters.drops


def test_it_tells_when_it_has_something_to_say_and_when_a_scan_has_begun() -> None:
    b = bench(Peer(utm=True))
    b.run_until_running()
    b.run(1 * S)
    assert b.conversation.next_request_ns() > b.now_ns + 100 * MS, "scans come by themselves"
    assert not b.conversation.is_amid()
    scan = b.peer.scan(b.now_ns)
    assert not list(b.conversation.receive(scan[:-1], b.now_ns))
    assert b.conversation.is_amid()
    assert not b.conversation.requests(b.now_ns)
    list(b.conversation.receive(scan[-1:], b.now_ns))
    assert not b.conversation.is_amid()
    due_ns = b.conversation.next_request_ns()
    b.conversation.requests(due_ns - MS)
    assert b.conversation.next_request_ns() <= due_ns + 100 * MS
    b.conversation.connected(b.now_ns)
    assert b.conversation.next_request_ns() <= b.now_ns
    assert not b.conversation.is_amid()


def test_a_stream_that_stops_is_started_again() -> None:
    b = bench(Peer(utm=True))
    b.run_until_running()
    b.peer.streaming = b""
    assert b.run_until(lambda: b.conversation.state is not LinkState.RUNNING, 1 * S) <= 460 * MS, (
        "the reader tells first"
    )
    assert b.run_until_running() <= 1 * S


def test_spin_up_takes_seconds() -> None:
    b = bench(Peer(spin_up_ns=3 * S))
    b.run_until_running()
    assert b.peer.received.count(b"QT") == 1
    assert b.conversation.counters.drops == {}


def test_a_simple_device_that_knows_only_how_to_say_who_it_is_and_to_stream() -> None:
    """Others' simulators, mostly: the stream switches the laser on as well as BM does."""
    b = bench(Peer(mute_to=(b"BM", b"II", b"TM")))
    b.run_until_running(8 * S)
    assert b.conversation.trouble is None


def test_laser_trouble_is_told_and_tried_again() -> None:
    b = bench(Peer(laser_trouble=True)).run(3 * S)
    assert b.conversation.state is LinkState.STARTING
    assert "BM status 01" in str(b.conversation.trouble)
    b.peer.laser_trouble = False
    b.run_until_running(2 * S)
    assert b.conversation.trouble is None


@pytest.mark.parametrize("status", [b"55", b"97"])
def test_hardware_trouble_while_running_starts_anew(status: bytes) -> None:
    b = bench(Peer())
    b.run_until_running()
    b.peer.send(b.peer.streaming + b"\n" + line(status) + b"\n", b.now_ns)
    b.peer.streaming = b""
    b.run(20 * MS)
    assert f"status {status.decode()}" in str(b.conversation.trouble)
    assert b.conversation.state is LinkState.STARTING
    b.run_until_running(2 * S)
    assert b.conversation.trouble is None


def test_verification_pause_is_waited_out() -> None:
    b = bench(Peer())
    b.run_until_running()
    stream, b.peer.streaming = b.peer.streaming, b""
    b.peer.send(stream + b"\n21S\n\n", b.now_ns)
    b.run(2 * S)
    assert "keep the window clean" in str(b.conversation.trouble)
    assert b.conversation.state is LinkState.STARTING
    b.peer.send(stream + b"\n98a\n\n", b.now_ns)
    b.peer.streaming, b.peer.next_step0_ns = stream, b.now_ns
    b.run_until_running(1 * S)
    assert b.conversation.trouble is None
    assert b.peer.received.count(b"QT") == 1


def test_another_device_on_the_port() -> None:
    conversation = HokuyoConversation()
    now = 0
    conversation.connected(now)
    noise = np.random.default_rng(4)
    while now < 5 * S:
        conversation.requests(now)
        now += 10 * MS
        assert list(conversation.receive(noise.bytes(40), now)) == []
    assert "another device" in str(conversation.trouble)
    assert conversation.state is LinkState.SILENT


def test_text_that_is_not_scip() -> None:
    conversation = HokuyoConversation()
    conversation.connected(0)
    for turn in range(3000):
        conversation.requests(turn * 10 * MS)
        assert not list(conversation.receive(b"$GPGGA,1,2,3*47\r\n", turn * 10 * MS))
    assert "another device" in str(conversation.trouble)


def test_nothing_on_the_port() -> None:
    b = bench(Peer(power=False)).run(3 * S)
    assert "does not answer" in str(b.conversation.trouble)


def test_a_scan_of_another_request_is_not_ours() -> None:
    b = bench(Peer())
    b.run_until_running()
    b.run(500 * MS)
    before = len(b.readings)
    other = scan_reply(b"MD0045072501000", b.peer.clock_ms(b.now_ns), [1000] * 681)
    counted = scan_reply(b"MD0044072501003", b.peer.clock_ms(b.now_ns), [1000] * 682)
    assert not list(b.conversation.receive(other + counted, b.now_ns))
    assert b.conversation.counters.drops == {"bad_echo": 1, "bad_count": 1}
    assert len(b.readings) == before


def test_values_that_no_device_says_are_not_believed_at_first() -> None:
    b = bench(Peer())
    b.run_until_running()
    b.peer.values = [200_000] + [1000] * 681
    before = len(b.readings)
    b.run_until(lambda: b.conversation.counters.drops.get("implausible_value", 0) == 2, 1 * S)
    assert len(b.readings) == before
    b.run(1 * S)
    assert b.conversation.counters.drops == {"implausible_value": 2}
    assert b.readings[-1].range_m[0] == math.inf


def test_noisy_line_costs_only_the_damaged_scans() -> None:
    b = bench(Peer())
    b.run_until_running()
    rng = np.random.default_rng(8)
    damaged = 0

    def garble(chunk: bytes) -> bytes:
        nonlocal damaged
        if chunk.startswith(b"MD") and rng.random() < 0.3:
            damaged += 1
            at = int(rng.integers(len(chunk)))
            return chunk[:at] + chunk[at + 1 :]
        return chunk

    before = len(b.readings)
    b.garble = garble
    b.run(10 * S)
    b.garble = bytes
    assert damaged >= 10
    assert sum(b.conversation.counters.drops.values()) == damaged, b.conversation.counters.drops
    assert len(b.readings) - before + damaged in (100, 101)
    assert b.peer.received.count(b"QT") == 1


def test_a_stream_that_stays_garbled_is_started_again() -> None:
    b = bench(Peer())
    b.run_until_running()
    b.garble = lambda chunk: chunk.replace(b"0", b"1", 1) if chunk.startswith(b"MD") else chunk
    assert b.run_until(lambda: b.conversation.state is LinkState.SILENT, 1 * S) <= 460 * MS
    b.run(3 * S)
    assert b.peer.received.count(b"QT") >= 2
    b.garble = bytes
    b.run_until_running(2 * S)


def test_parameters_must_be_heard_twice_alike() -> None:
    """PP with two changes that cancel in a line's sum: right sums, wrong geometry."""
    b = bench(Peer())
    forged = PP_URG.replace(b"AFRT:384;6", b"AFRT:483;6")
    told: list[bytes] = []

    def garble(chunk: bytes) -> bytes:
        if chunk == PP_URG and not told:
            told.append(chunk)
            return forged
        return chunk

    b.garble = garble
    b.run_until_running()
    assert told
    assert math.degrees(b.readings[0].bearing_rad[0]) == pytest.approx(-119.53125)
    assert b.peer.received.count(b"PP") == 3


# Serial lines.


@pytest.mark.parametrize("speed", [19200, 38400, 57600, 115200])
def test_finds_the_speed_of_a_serial_line(speed: int) -> None:
    b = bench(Peer(speed=speed))
    b.run_until_running()
    assert b.peer.line_speed == speed


def test_raises_the_speed_of_a_real_serial_line_and_asks_for_what_it_carries() -> None:
    b = bench(Peer(speed=19200, paced=True))
    b.run_until_running()
    assert b"SS115200" in b.peer.received
    assert b.peer.speed == b.peer.line_speed == 115200
    assert b.peer.received[-1] == b"MD0044072501100"  # 2.2 kB take 190 ms: every second scan
    first_step0 = b.peer.next_step0_ns - 200 * MS * len(b.readings)
    b.run(3 * S)
    assert len(b.readings) >= 14
    errors = [r.stamp_ns - (first_step0 + at * 200 * MS + 4_296_875) for at, r in enumerate(b.readings)]
    assert max(map(abs, errors)) < 3 * MS, errors
    assert b.conversation.silence_limit_ns == 500 * MS


def test_set_baud_zero_stays_and_joins_beams() -> None:
    b = Bench(HokuyoConversation(set_baud=0), Peer(speed=19200, paced=True))
    b.run_until_running(8 * S)
    assert not any(command.startswith(b"SS") for command in b.peer.received)
    assert int(b.peer.received[-1][10:12]) >= 4
    b.run(3 * S)
    assert b.conversation.state is LinkState.RUNNING


def test_set_baud_is_obeyed() -> None:
    b = Bench(HokuyoConversation(set_baud=57600), Peer(speed=19200))
    b.run_until_running()
    assert b.peer.speed == b.peer.line_speed == 57600


def test_farewell_and_reconnection() -> None:
    b = bench(Peer())
    b.run_until_running()
    for item in b.conversation.farewell():
        b.peer.heard(item, b.now_ns)
    assert b.peer.streaming == b""
    half = scan_reply(b"MD0044072501000", 1, [1000] * 682)[:900]
    assert not list(b.conversation.receive(half, b.now_ns))
    b.conversation.connected(b.now_ns)
    b.peer.pending.clear()
    assert b.conversation.state is LinkState.SILENT
    b.run_until_running()
    assert b.conversation.counters.drops == {}
