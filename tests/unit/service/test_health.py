"""The health report: levels, words, counters; and the process meter against the system's own figures."""

from __future__ import annotations

import os
import time

import psutil
import pytest

from drivers import reader
from drivers.readings import ClockFit, Identity, LinkState, SourceCounters
from service.health import ERROR, OK, STALE, WARNING, Inside, ProcessMeter, identity_text, level_of, report, trouble_of


def source(name: str, state: LinkState = LinkState.RUNNING, **changes: object) -> reader.SourceHealth:
    values: dict[str, object] = {
        "name": name,
        "state": state,
        "since_ns": 0,
        "trouble": None,
        "identity": Identity("Hokuyo", "URG-04LX", "H0500000", "3.4.03"),
        "rate_hz": 10.0,
        "age_ns": 50_000_000,
        "readings": 100,
        "restarts": 1,
        "bugs": 0,
        "counters": SourceCounters(drops={"bad_sum": 3}),
        "clock_fit": None,
    }
    return reader.SourceHealth(**(values | changes))  # type: ignore[arg-type]


def wire(*sources: reader.SourceHealth, **drops: int) -> reader.WireHealth:
    return reader.WireHealth("w", True, None, 2, dict(drops), {each.name: each for each in sources})


NOTHING = Inside(drops={}, counters={})


def test_all_is_well() -> None:
    out = report([wire(source("front"), source("drive"))], {"front": "laser", "drive": "wheels"}, NOTHING, {}, 7)
    assert (out.stamp_ns, out.level, out.text) == (7, OK, "2 devices running")
    assert [each.name for each in out.sources] == ["front", "drive"]
    assert [each.kind for each in out.sources] == ["laser", "wheels"]
    assert out.sources[0].identity == "Hokuyo URG-04LX, serial H0500000, firmware 3.4.03"
    assert out.counters["wire.w.openings"] == 2


def test_what_is_wrong_is_said_in_words() -> None:
    gone = source("front", LinkState.ABSENT, trouble="no /dev/ttyACM0: is it plugged in?")
    out = report([wire(gone)], {"front": "laser"}, NOTHING, {}, 0)
    assert out.level == ERROR
    assert out.text == "front: no /dev/ttyACM0: is it plugged in?"


def test_trouble_inside_is_a_warning_beside_healthy_devices() -> None:
    inside = Inside(drops={}, counters={"queue.depth": 1}, troubles=("grids wait for odometry of drive",))
    out = report([wire(source("front"))], {"front": "laser"}, inside, {}, 0)
    assert (out.level, out.text) == (WARNING, "grids wait for odometry of drive")
    assert out.counters["queue.depth"] == 1


def test_drops_of_driver_fusion_and_wire_are_all_counted() -> None:
    inside = Inside(drops={"front": {"stamp_equal": 2, "bad_sum": 1}}, counters={})
    out = report([wire(source("front"), overrun=5)], {"front": "laser"}, inside, {}, 0)
    assert out.sources[0].drops == {"bad_sum": 4, "stamp_equal": 2}
    assert out.counters["wire.w.overrun"] == 5


def test_no_device_is_no_fault_but_said() -> None:
    out = report([], {}, NOTHING, {}, 0)
    assert out.level == OK
    assert "no device is configured" in out.text


def test_a_reading_that_never_came_has_no_age() -> None:
    out = report([wire(source("front", LinkState.STARTING, age_ns=None))], {"front": "laser"}, NOTHING, {}, 0)
    assert out.sources[0].age_ns == -1
    assert out.sources[0].level == WARNING


def test_the_clock_fit_is_reported() -> None:
    fit = ClockFit(offset_ns=5, drift_ppm=12.5, jitter_ns=100.0, samples=9)
    out = report([wire(source("front", clock_fit=fit))], {"front": "laser"}, NOTHING, {}, 0)
    assert out.sources[0].clock == {"offset_ns": 5.0, "drift_ppm": 12.5, "jitter_ns": 100.0, "samples": 9.0}


@pytest.mark.parametrize(
    ("state", "trouble", "had_readings", "level"),
    [
        (LinkState.RUNNING, None, True, OK),
        (LinkState.RUNNING, "lens dirty", True, WARNING),
        (LinkState.STARTING, None, True, WARNING),
        (LinkState.SILENT, "silent", True, STALE),
        (LinkState.SILENT, "silent", False, ERROR),
        (LinkState.ABSENT, "absent", True, ERROR),
    ],
)
def test_levels(state: LinkState, trouble: str | None, had_readings: bool, level: int) -> None:
    assert level_of(state, trouble, had_readings=had_readings) == level


def test_silence_says_what_it_hints_at() -> None:
    quiet = source("front", LinkState.SILENT, trouble="no answer yet", readings=0, identity=None)
    assert "power and cable" in str(trouble_of(quiet))
    noisy = source(
        "front",
        LinkState.SILENT,
        trouble="no answer yet",
        readings=0,
        identity=None,
        counters=SourceCounters(bytes=680),
    )
    assert "680 bytes came" in str(trouble_of(noisy))
    assert "another device on this port" in str(trouble_of(noisy))
    assert trouble_of(source("front")) is None


def test_an_identity_says_only_what_is_known() -> None:
    assert identity_text(None) == ""
    assert identity_text(Identity()) == ""
    assert identity_text(Identity(model="X", serial="1")) == "X, serial 1"


def test_the_process_meter_agrees_with_the_system() -> None:
    meter = ProcessMeter(0)
    began = time.process_time()
    while time.process_time() - began < 0.05:
        pass
    used = time.process_time() - began
    figures = meter.measure(1_000_000_000)
    process = psutil.Process(os.getpid())
    assert figures["cpu_percent"] == pytest.approx(100 * used, rel=0.5)
    assert figures["memory_mb"] == pytest.approx(process.memory_info().rss / 1e6, rel=0.2)
    assert figures["threads"] >= 1
    assert figures["open_files"] >= 3
    assert figures["uptime_s"] == 1.0
    assert meter.measure(1_000_000_000)["cpu_percent"] == 0.0
