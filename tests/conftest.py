"""Options and fixtures of all tests: `--device` puts hardware in the place of emulators (docs/testing.md)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# The same examples at every run, so that a failure is the change's and not the day's; `make fuzz` tries new ones.
# No example is judged by the time that it took: a machine that is stopped for a second is no fault of a test.
TIMELESS: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **TIMELESS)
settings.register_profile("new", derandomize=False, print_blob=True, **TIMELESS)
settings.load_profile("same")

KINDS = ("laser", "sonars", "wheels")
NO_PERSON = "needs a person at the terminal to pull a plug (pytest's standard input is no terminal)"
EMULATED_ONLY = "is about an emulated device, or another than those named by --device"

_left_out: dict[str, int] = {}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        action="append",
        default=[],
        metavar="KIND=PORT[@ADDRESSES]",
        help="run the tests marked hil on hardware: laser=/dev/ttyACM0, sonars=can0@0x400,0x420, wheels=can0@0x20,0x21 "
        "(a CAN port with a slash is an slcan adapter); repeatable, the emulated devices are then left out",
    )


def pytest_configure(config: pytest.Config) -> None:
    for text in config.getoption("--device"):
        kind, _, port = text.partition("=")
        if kind not in KINDS or not port:
            raise pytest.UsageError(f"--device {text}: write KIND=PORT, KIND one of {', '.join(KINDS)}")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With hardware, only tests of that hardware are left, and those that need a person only if there is one.

    Files of few but long tests come first: where several processes share the files, none is left with minutes of
    work in the end (with xdist's --no-loadscope-reorder, which puts files of many tests first).
    """
    items.sort(key=lambda item: "world" not in item.path.parts)
    hardware = _hardware(config)
    if not hardware:
        return
    person = _is_there_a_person(config)
    kept: list[pytest.Item] = []
    gone: list[pytest.Item] = []
    taken: set[str] = set()
    for item in items:
        reason = _reason_to_leave_out(item, hardware, person, taken)
        if reason is None:
            kept.append(item)
        else:
            gone.append(item)
            _left_out[reason] = _left_out.get(reason, 0) + 1
    if gone:
        config.hook.pytest_deselected(items=gone)
        items[:] = kept


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for reason, count in sorted(_left_out.items()):
        terminalreporter.write_line(f"left out: {count} x {reason}")


@pytest.fixture(scope="session")
def hardware(request: pytest.FixtureRequest) -> dict[str, str]:
    """What --device named: the port of each kind of device."""
    return _hardware(request.config)


@pytest.fixture
def ask_person(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Say something to the person at the terminal and wait for Enter."""

    def ask(text: str) -> None:
        with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
            print(f"\n>>> {text}, then press Enter ", end="", flush=True)
            sys.stdin.readline()

    return ask


def _hardware(config: pytest.Config) -> dict[str, str]:
    return dict(text.split("=", 1) for text in config.getoption("--device"))


def _is_there_a_person(config: pytest.Config) -> bool:
    capture = config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        return sys.stdin is not None and sys.stdin.isatty()


def _reason_to_leave_out(item: pytest.Item, hardware: dict[str, str], person: bool, taken: set[str]) -> str | None:
    """taken: tests that have their device already; two emulated models of one kind are one piece of hardware."""
    mark = item.get_closest_marker("hil")
    if mark is None:
        return None
    callspec = getattr(item, "callspec", None)
    parameters = dict(callspec.params) if callspec is not None else {}
    kind = str(parameters.pop("device", "")).partition("-")[0]
    name = f"{item.nodeid.partition('[')[0]} {kind} {sorted(map(str, parameters.values()))}"
    if kind not in hardware or mark.kwargs.get("emulated", False) or name in taken:
        return EMULATED_ONLY
    if mark.kwargs.get("person", False) and not person:
        return NO_PERSON
    taken.add(name)
    return None
