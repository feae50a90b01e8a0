"""What deploy/ ships is valid: configurations, the unit's command, the files its page names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from service.config import load

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "deploy"


@pytest.mark.parametrize("path", sorted(DEPLOY.glob("*.toml")), ids=lambda path: path.stem)
def test_an_example_configuration_is_valid_and_drives(path: Path) -> None:
    config = load(path).config
    assert config.drive.source in config.wheels
    assert config.lasers
    assert config.sectors.polar
    assert config.network.listen == ("tcp/127.0.0.1:7447",)


def test_the_page_names_files_that_are_there_and_all_of_them() -> None:
    table = (DEPLOY / "README.md").read_text().split("| file |")[1]
    named = set(re.findall(r"^\| `([\w.-]+)` \|", table.split("\n\n")[0], re.MULTILINE))
    present = {path.name for path in DEPLOY.iterdir()} - {"README.md", "README-security.md"}
    assert named == present


def test_the_unit_feeds_a_watchdog_and_may_reach_serial_lines_and_can() -> None:
    unit = (DEPLOY / "umfeld.service").read_text()
    for line in (
        "Type=notify",
        "WatchdogSec=10",
        "NoNewPrivileges=yes",
        "IPAddressDeny=any",
        "IPAddressAllow=localhost",
    ):
        assert f"\n{line}\n" in unit
    assert "AF_CAN" in unit
    assert "char-ttyACM rw" in unit
