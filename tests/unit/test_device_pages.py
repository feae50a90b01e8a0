"""Each device's page is enough to begin with: its tables are a configuration, and its emulated twin runs on them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from bench.fault_rig import Rig

PAGES = Path(__file__).resolve().parents[2] / "docs" / "devices"
NO_DEVICE = {"finding", "can", "mounts"}  # how to find them; a bus; what carries a laser (its preset: `nodding`)
DEVICES = sorted(path.stem for path in PAGES.glob("*.md") if path.stem not in NO_DEVICE)


@pytest.mark.parametrize("name", DEVICES)
def test_the_settings_of_a_page_are_keys_of_the_configuration(name: str) -> None:
    known = set(re.findall(r"^\| `([a-z0-9_]+)` \|", (PAGES.parent / "configuration.md").read_text(), re.M))
    rows: list[str] = []
    for table in re.findall(
        r"^\| (?:key|setting) \|.*\n\| ---.*\n((?:\|.*\n)+)", (PAGES / f"{name}.md").read_text(), re.M
    ):
        rows += [row.split("|")[1] for row in table.splitlines()]
    told = {key for row in rows for key in re.findall(r"`(?:\[\w+\] )?([a-z0-9_]+)`", row)}
    assert told - known == set()


@pytest.mark.parametrize("name", DEVICES)
def test_the_tables_of_a_page_run_on_the_emulated_device(name: str) -> None:
    text = (PAGES / f"{name}.md").read_text()
    table = tomllib.loads(re.findall(r"^```toml\n(.*?)^```", text, re.M | re.S)[0])
    command = re.search(r"\*\*Without hardware:\*\* .*`umfeld sim --config robot\.toml --dir sim( --laser \S+)?`", text)
    assert command is not None
    table.setdefault("store", {})["enabled"] = False
    model = (command[1] or "").removeprefix(" --laser ") or None
    with Rig(table, model=model) as rig:
        assert rig.run_until(lambda: all(rig.is_running(source) for source in rig.sensors), 30.0), rig.health()
        assert all(rig.readings(source, 0) for source in rig.sensors)
