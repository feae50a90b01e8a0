"""SCIP 2.x replies: the protocol page's worked exchanges, damage of every kind, and a real URG-04LX's bytes."""

from __future__ import annotations

import gzip
import math
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import FrameError
from drivers.readings import SourceCounters
from drivers.scip import (
    MAX_REPLY_BYTES,
    CodeTable,
    Profile,
    Reply,
    ScanRequest,
    ScipReplies,
    decode_number,
    decode_scan,
    encode_number,
    model_name,
    parse_profile,
    text_fields,
)

# The worked MD exchange: ranges 1000..1039 mm, stamp 5000 ms.
SCAN_40 = (
    b"MD0044008301000\n99b\n01>8G\n"
    b"0?X0?Y0?Z0?[0?\\0?]0?^0?_0?`0?a0?b0?c0?d0?e0?f0?g0?h0?i0?j0?k0?l0E\n"
    b"?m0?n0?o0@00@10@20@30@40@50@60@70@80@90@:0@;0@<0@=0@>0@?O\n\n"
)
URG = Profile("URG-04LX", 20, 5600, 1024, 44, 725, 384, 600.0, CodeTable.URG)


def read(data: bytes) -> list[Reply]:
    return list(ScipReplies().feed(data, 0))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234, b"CB"),
        (4095, b"oo"),
        (5432, b"1Dh"),
        (1000, b"0?X"),
        (0, b"000"),
        (16000000, b"m2@0"),
        (16777215, b"oooo"),
    ],
)
def test_numbers(value: int, text: bytes) -> None:
    assert encode_number(value, len(text)) == text
    assert decode_number(text) == value


def test_numbers_that_are_none() -> None:
    for text in (b"0p", b"/0", b"\xb00"):
        with pytest.raises(FrameError):
            decode_number(text)
    for value in (4096, -1):
        with pytest.raises(ValueError):
            encode_number(value, 2)


@pytest.mark.parametrize(
    ("data", "echo", "status", "lines"),
    [
        (b"QT\n00P\n\n", b"QT", "00", ()),
        (b"BM\n02R\n\n", b"BM", "02", ()),
        (b"TM1\n00P\n0N90W\n\n", b"TM1", "00", (b"0N90",)),
        (b"TM0\n04T\n\n", b"TM0", "04", ()),
        (b"SS115200\n03S\n\n", b"SS115200", "03", ()),
        (b"CR00\n03S\n\n", b"CR00", "03", ()),
        (b"HS0\n0Cc\n\n", b"HS0", "0C", ()),
        (b"SCIP2.0\n0\n\n", b"SCIP2.0", "0", ()),
        (b"SCIP2.0\n0Ee\n\n", b"SCIP2.0", "0E", ()),
        (b"QT\nE\n\n", b"QT", "E", ()),
        (b"BM;hello-1\n00P\n\n", b"BM;hello-1", "00", ()),
        (b"MD0044072501000\n00P\n\n", b"MD0044072501000", "00", ()),
        (b"MD0044072501000\n98a\n\n", b"MD0044072501000", "98", ()),
        (b"GD0044072501\n10Q\n\n", b"GD0044072501", "10", ()),
    ],
)
def test_short_replies(data: bytes, echo: bytes, status: str, lines: tuple[bytes, ...]) -> None:
    (reply,) = read(data)
    assert (reply.echo, reply.status, reply.lines, reply.scan) == (echo, status, lines, None)
    assert reply.size == len(data)


def test_text_may_end_in_semicolons() -> None:
    """The sum, or the end of a value, may be a `;` itself."""
    text = b"STAT:a;b;"
    line = text + b";" + bytes([sum(text) % 64 + 48]) + b"\n"
    other = b"MESM:x'"
    assert sum(other) % 64 + 48 == ord(";")
    (reply,) = read(b"II\n00P\n" + line + other + b";;\n\n")
    assert text_fields(reply) == {"STAT": "a;b;", "MESM": "x'"}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"QT\n00Q\n\n", "bad_sum"),
        (b"QT\n00P\nxyz\n\n", "bad_length"),
        (b"TM1\n00P\n0N90V\n\n", "bad_sum"),
        (b"TM1\n00P\n\n", "bad_length"),
        (b"VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;\\\n\n", "bad_sum"),
        (b"VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.[\n\n", "bad_text"),
        (b"VV\n00P\n\n", "bad_length"),
        (b"QT\n0\n\n", "bad_status"),
        (b"hello\n\n", "noise"),
        (SCAN_40.replace(b"?m", b"?n"), "bad_sum"),
        (SCAN_40.replace(b"0E\n", b"\xb0E\n"), "bad_character"),
        (SCAN_40.replace(b"01>8G", b"01>9G"), "bad_sum"),
        (SCAN_40.replace(b"MD00440083", b"MD00440084"), "bad_length"),
        (SCAN_40.replace(b"MD00440083", b"MD00840083"), "bad_echo"),
        (SCAN_40.replace(b"99b", b"00P"), "bad_length"),
        (SCAN_40.replace(b"0?X", b""), "bad_length"),
    ],
)
def test_damage_is_counted_by_its_reason(data: bytes, reason: str) -> None:
    counters = SourceCounters()
    replies = ScipReplies(counters=counters)
    assert list(replies.feed(data, 0)) == []
    assert counters.drops == {reason: 1}
    assert [reply.echo for reply in replies.feed(b"BM\n00P\n\n", 0)] == [b"BM"]


def test_the_worked_scan() -> None:
    (reply,) = read(SCAN_40)
    assert reply.scan is not None
    assert (reply.scan.remaining, reply.scan.device_ms) == (0, 5000)
    assert reply.scan.request == ScanRequest("MD", 44, 83, 1, 0)
    assert reply.scan.request.command() + b"\n" == SCAN_40[:16]
    assert reply.scan.request.reply_bytes() == len(SCAN_40)
    sweep = decode_scan(reply.scan, URG)
    np.testing.assert_array_equal(sweep.range_m, np.arange(1000, 1040) / 1000.0)
    assert sweep.intensity is None


def test_short_and_intensity_scans() -> None:
    """MS data 0,19,1000,4095 -> 000C?Xoo8 and ME (1000,500)(1001,501) -> 0?X07d0?Y07eV."""
    short, both = read(b"MS0000000301002\n99b\n01>8G\n000C?Xoo8\n\nME0000000101000\n99b\n01>8G\n0?X07d0?Y07eV\n\n")
    assert short.scan is not None
    assert short.scan.remaining == 2
    sweep = decode_scan(short.scan, URG)
    np.testing.assert_array_equal(sweep.range_m, [math.inf, math.nan, 1.0, math.inf])
    assert both.scan is not None
    sweep = decode_scan(both.scan, URG)
    np.testing.assert_array_equal(sweep.range_m, [1.0, 1.001])
    assert sweep.intensity is not None
    assert sweep.intensity.dtype == np.float32
    np.testing.assert_array_equal(sweep.intensity, [500, 501])


def test_odd_values_are_counted() -> None:
    request = ScanRequest("MD", 0, 5)
    values = [5600, 5601, 11_200, 11_201, 65_533, 262_143]
    digits = np.frombuffer(b"".join(encode_number(v, 3) for v in values), dtype=np.uint8) - 48
    (reply,) = read(SCAN_40)
    assert reply.scan is not None
    sweep = decode_scan(type(reply.scan)(request, 0, 0, digits), URG)
    np.testing.assert_array_equal(sweep.range_m, [5.6] + 5 * [math.inf])
    assert sweep.odd_values == 1


@pytest.mark.parametrize(
    ("model", "table"),
    [
        ("URG-04LX", CodeTable.URG),
        ("UHG-08LX", CodeTable.URG),
        ("utm-30lx", CodeTable.UTM),
        ("UST-10LX", CodeTable.UTM),
        ("XYZ-1", CodeTable.UNKNOWN),
        ("", CodeTable.UNKNOWN),
    ],
)
def test_code_tables(model: str, table: CodeTable) -> None:
    assert CodeTable.of_model(model) is table


def test_model_name() -> None:
    assert model_name("UTM-30LX(Hokuyo Automatic Co.,Ltd.)") == "UTM-30LX"
    assert model_name("UTM-30LX[Hokuyo Automatic Co., Ltd.]") == "UTM-30LX"
    assert model_name("UST-10LX") == "UST-10LX"


@pytest.mark.parametrize(
    "change",
    [
        {"ARES": "0"},
        {"AMAX": "10"},
        {"SCAN": "fast"},
        {"DMIN": "6000"},
        {"SCAN": "0"},
        {"AMAX": "9999"},
        {"AFRT": "-3"},
    ],
)
def test_parameters_that_contradict_themselves(change: dict[str, str]) -> None:
    text = "MODL:X DMIN:20 DMAX:5600 ARES:1024 AMIN:44 AMAX:725 AFRT:384 SCAN:600"
    good = {field.split(":")[0]: field.split(":")[1] for field in text.split()}
    assert parse_profile(good).turn_ns == 100e6
    with pytest.raises(FrameError):
        parse_profile(good | change)
    for key in good:
        with pytest.raises(FrameError):
            parse_profile({k: v for k, v in good.items() if k != key})


def test_noise_in_front_of_a_reply_does_not_cost_it() -> None:
    for noise in (b"\x00\xff", b"abc", b"\n", b"\n\n", b"\n\n\n", b"MD0044008301000\n", b"99b\n01>8G\n", SCAN_40[:100]):
        replies = read(noise + SCAN_40)
        assert len(replies) == 1, noise
        assert replies[0].scan is not None


def test_a_lost_end_costs_one_reply() -> None:
    for lost in (SCAN_40[:-1], SCAN_40[:-2], SCAN_40[:-2] + b"x\n"):
        assert [reply.echo for reply in read(SCAN_40 + lost + SCAN_40 + b"QT\n00P\n\n")] == [
            b"MD0044008301000",
            b"MD0044008301000",
            b"QT",
        ]


def test_endless_noise_is_bounded_and_survived() -> None:
    counters = SourceCounters()
    replies = ScipReplies(counters=counters)
    for _ in range(100):
        assert list(replies.feed(b"\x55" * 4096, 0)) == []
        assert len(replies._buffer) <= MAX_REPLY_BYTES + 4096
    assert counters.drops["no_end"] >= 4
    assert len(list(replies.feed(SCAN_40, 0))) == 1


def test_stamps_and_what_came_behind() -> None:
    replies = ScipReplies()
    assert list(replies.feed(SCAN_40[:50], 1000)) == []
    (reply,) = replies.feed(SCAN_40[50:] + b"QT\n", 2000)
    assert (reply.began_ns, reply.arrived_ns, reply.bytes_after) == (1000, 2000, 3)
    (reply,) = replies.feed(b"00P\n\n", 3000)
    assert (reply.began_ns, reply.arrived_ns, reply.bytes_after) == (2000, 3000, 0)


needs_data = pytest.mark.skipif(not os.environ.get("UMFELD_DATA"), reason="needs UMFELD_DATA")


def recorded() -> bytes:
    folder = Path(os.environ["UMFELD_DATA"]) / "device_bytes"
    return gzip.decompress((folder / "urg04lx_scip2.bin.gz").read_bytes())


@pytest.mark.data
@needs_data
def test_every_recorded_reply_parses() -> None:
    counters = SourceCounters()
    replies = list(ScipReplies(counters=counters).feed(recorded(), 0))
    assert counters.drops == {}
    assert Counter(reply.echo for reply in replies) == {
        b"V": 1, b"SCIP2.0": 1, b"VV": 3, b"PP": 3, b"II": 3, b"BM": 1, b"CR00": 1, b"HS0": 1, b"GD0046072201": 60,
    }  # fmt: skip
    assert sum(reply.size for reply in replies) - 1 == len(recorded())  # V alone has no empty line
    by_echo = {reply.echo: reply for reply in replies}
    assert text_fields(by_echo[b"VV"])["SERI"] == "H0706400"
    assert by_echo[b"CR00"].status == "03"
    profile = parse_profile(text_fields(by_echo[b"PP"]))
    assert profile == URG
    scans = [reply.scan for reply in replies if reply.scan is not None]
    steps = np.diff([scan.device_ms for scan in scans])
    assert sorted(set(steps)) == [99, 100, 400]
    for scan in scans:
        sweep = decode_scan(scan, profile)
        assert sweep.range_m.shape == (677,)
        assert sweep.odd_values == 0
        finite = sweep.range_m[np.isfinite(sweep.range_m)]
        assert 0.02 <= finite.min() < finite.max() < 5.6
    # The first scan's first ten distances, read off the file by hand.
    first = decode_scan(scans[0], profile).range_m[:10]
    np.testing.assert_array_equal(first, [1.113, 1.113, 1.114, 1.115, 1.12, 1.132, 1.139, 1.146, 1.15, 1.151])


@pytest.mark.data
@needs_data
def test_recorded_bytes_in_the_chunks_they_came_in() -> None:
    data = recorded()
    table = Path(os.environ["UMFELD_DATA"]) / "device_bytes" / "urg04lx_scip2.chunks.csv.gz"
    rows = gzip.decompress(table.read_bytes()).decode().split()[1:]
    replies = ScipReplies()
    seen = []
    for row in rows:
        time_s, offset, length = row.split(",")
        chunk = data[int(offset) : int(offset) + int(length)]
        seen += list(replies.feed(chunk, round(float(time_s) * 1e9)))
    assert len(seen) == 74
    assert replies.counters.drops == {}
    arrivals = [reply.arrived_ns for reply in seen]
    assert arrivals == sorted(arrivals)
