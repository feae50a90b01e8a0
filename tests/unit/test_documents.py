"""The documents point at what is there: links, pictures, and the files named in the table of systems."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"!?\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")


def without_code(text: str) -> str:
    """A document without its fenced and quoted code."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(document: Path) -> None:
    links = [link for link in LINK.findall(without_code(document.read_text())) if "://" not in link]
    missing = [link for link in links if not (document.parent / link).exists()]
    assert not missing


def test_every_picture_is_shown() -> None:
    shown = {Path(link).name for document in DOCUMENTS for link in LINK.findall(document.read_text())}
    assert {path.name for path in (ROOT / "docs" / "pictures").iterdir()} - shown == set()


def test_the_table_of_systems_is_whole_and_true() -> None:
    rows = re.findall(r"^\| (S\d\d) \| [^|]+ \| ([^|]+) \| ([^|]+) \|", (ROOT / "docs/algorithms.md").read_text(), re.M)
    assert [row for row, _, _ in rows] == [f"S{number:02}" for number in range(1, 47)]
    for row, code, tests in rows:
        modules = re.findall(r"`([^`]+)`", code)
        assert any(row in (ROOT / "mapping" / module).read_text() or _in_span(row, module) for module in modules), row
        assert all((ROOT / "tests" / test).is_file() for test in re.findall(r"`([^`]+)`", tests)), row


def _in_span(row: str, module: str) -> bool:
    """Whether a module says 'S03 to S06' with the row in between."""
    spans = re.findall(r"\bS(\d\d) to S(\d\d)\b", (ROOT / "mapping" / module).read_text())
    return any(int(first) <= int(row[1:]) <= int(last) for first, last in spans)
