"""Every cell of the fault ledger holds, and the committed ledger is what the program gives.

The last test is the one-way rule over all faults of the language: nothing that goes wrong makes a sector or a cell
freer, but for faults that make a device say what could be true (the page says which, and why).
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from bench.fault_ledger import CELLS, DATA, DEVICES, GRAIN_MS, PAGE, Bench, Trouble, as_data, rows_of
from sim_devices.faults import KINDS

COMMITTED = json.loads(DATA.read_text())


@pytest.mark.parametrize("name", DEVICES)
def test_every_cell_of_a_device_holds(name: str) -> None:
    rows = rows_of(name)
    assert not {row.fault: row.complaints() for row in rows if row.complaints()}
    now = as_data(rows)
    then = [each for each in COMMITTED if each["device"] == name]
    assert [(row["fault"], row["state"]) for row in now] == [(row["fault"], row["state"]) for row in then]
    for row, was in zip(now, then):
        for key in ("seen_ms", "stale_ms", "back_ms"):
            before, after = was[key], row[key]
            assert (before is None) == (after is None)
            assert before is None or abs(int(str(after)) - before) <= GRAIN_MS, f"{row}: `make ledger` writes it anew"


def test_the_ledger_is_long_enough_and_its_page_tells_all_of_it() -> None:
    assert len(COMMITTED) == len(CELLS) >= 120
    assert all(each["holds"] for each in COMMITTED)
    text = PAGE.read_text()
    assert "## What no driver can see" in text
    assert f"{len(CELLS)} cells, {len(CELLS)} of them hold." in text
    for each in COMMITTED:
        assert f"## {each['device']}\n" in text
        assert f"| `{each['fault']}` |" in text


# Faults of devices and wires, with any value; what a device could truly see is left to the maps' own tests.
WIRE = ["unplug", "rename", "busy", "no_permission", "power_cycle", "brown_out", "slow_boot", "silence", "stall"]
BYTES = ["single_bytes", "short_reads", "bursts", "drop", "add", "flip", "wrong_baud", "flood"]
BEAMS = ["lost_sector", "ghost", "black", "glass", "dust", "sun", "slow_blinding"]
HEAD = ["clock_drift", "speed", "varying_speed", "varying_count", "trouble"]
NODE = ["unplug", "power_cycle", "brown_out", "slow_boot", "silence", "stall", "drop", "add"]
BUS = ["unplug", "silence", "stall", "drop", "add", "power_cycle", "slow_boot", "brown_out", "bus_off", "flood"]
COUNTS = ["wrap", "reset", "alarm"]
LIES = {
    "frozen", "delay", "mixed_pixels", "interference", "stuck", "specular", "chain_break", "order_swap",
    "temperature", "cross_talk", "sign", "swap", "missed_counts", "slip", "size_change", "id_clash",
}  # fmt: skip
SWITCHES = {"bounce", "stuck_on", "stuck_off"}
VALUES = {
    "drop": (0.001, 0.9), "add": (0.001, 0.9), "flip": (0.001, 0.9), "flood": (100.0, 30000.0),
    "brown_out": (0.05, 0.5), "bursts": (0.01, 0.4), "short_reads": (1.0, 300.0),
    "single_bytes": (1000.0, 30000.0), "speed": (0.8, 1.1),
    "varying_speed": (0.01, 0.15), "varying_count": (0.01, 0.15), "ghost": (0.2, 1.9), "dust": (0.01, 0.9),
    "glass": (0.1, 1.0), "sun": (0.1, 1.0), "slow_blinding": (0.1, 2.0), "clock_drift": (-2000.0, 2000.0),
    "wrap": (-500.0, 500.0),
}  # fmt: skip


benches: dict[str, Bench] = {}


def bench(name: str) -> Bench:
    """A device at work; another one where the last fault has moved the pose."""
    if name in benches and benches[name].has_broken:
        benches.pop(name).rig.close()
    if name not in benches:
        benches[name] = Bench(name, seed=11)
    return benches[name]


@pytest.fixture(scope="module", autouse=True)
def _closed_in_the_end() -> Iterator[None]:
    yield
    for each in benches.values():
        each.rig.close()


def faults_of(name: str) -> list[tuple[str | None, str]]:
    """(target, kind) of everything this device can have that is no lie."""
    device = DEVICES[name]
    own = NODE if device.wire == "can" else [*WIRE, *BYTES]
    own = [*own, *(BEAMS + HEAD if device.target.startswith("laser") else []), *(COUNTS if device.is_wheels else [])]
    buses = [("bus.main", kind) for kind in BUS] if device.wire == "can" else []
    return [*((None, kind) for kind in own), *buses]


@st.composite
def cases(draw: st.DrawFn) -> tuple[str, Trouble]:
    name = draw(st.sampled_from(sorted(DEVICES)))
    target, kind = draw(st.sampled_from(faults_of(name)))
    value = f"={draw(st.floats(*VALUES[kind])):.4f}" if kind in VALUES else ""
    to_device = "(to_device=1)" if kind in ("drop", "add", "flip") and draw(st.booleans()) else ""
    return name, Trouble((f"{kind}{value}{to_device}",), "counted", target)


@settings(max_examples=50, phases=(Phase.generate,))  # devices are not made anew for each fault
@given(cases())
def test_no_fault_makes_anything_freer(case: tuple[str, Trouble]) -> None:
    name, trouble = case
    row = bench(name).carry_out(trouble)
    assert not row.freer
    assert row.back_ms is not None


def test_every_kind_of_fault_is_in_one_list_or_the_other() -> None:
    assert {*WIRE, *BYTES, *BEAMS, *HEAD, *NODE, *BUS, *COUNTS} | LIES | SWITCHES == set(KINDS)
