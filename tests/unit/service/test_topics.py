"""The table of keys, and the document made from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from service import topics

KEYS_PAGE = Path(__file__).parents[3] / "docs" / "keys.md"


def test_docs_hold_the_table_as_it_is() -> None:
    """After a change: python -c 'from service.topics import markdown_table; print(markdown_table())' into keys.md."""
    assert topics.markdown_table() in KEYS_PAGE.read_text()


def test_patterns_are_unique_and_have_no_forbidden_characters() -> None:
    patterns = [topic.pattern for topic in topics.TOPICS]
    assert len(set(patterns)) == len(patterns)
    for pattern in patterns:
        assert not set(pattern) & set("*#?$ ")
        assert not pattern.startswith("/")
        assert not pattern.endswith("/")


@pytest.mark.parametrize(
    ("suffix", "topic"),
    [
        ("scan/front", topics.SCAN),
        ("range/a-b_1", topics.RANGES),
        ("range/chain/12", topics.RANGE_ONE),
        ("health", topics.HEALTH),
        ("health/json", topics.HEALTH_JSON),
        ("health/front", topics.HEALTH_ONE),
        ("map/grid", topics.MAP_GRID),
        ("map/grid/update", topics.MAP_GRID_UPDATE),
    ],
)
def test_a_key_finds_its_row(suffix: str, topic: topics.Topic) -> None:
    assert topics.topic_of(suffix) is topic


@pytest.mark.parametrize("suffix", ["", "scan", "scan/", "scan/Front", "scan/a/b", "nothing", "map/grid/update/x"])
def test_other_keys_have_none(suffix: str) -> None:
    with pytest.raises(KeyError):
        topics.topic_of(suffix)


def test_scans_are_urgent_and_maps_cached() -> None:
    assert topics.SCAN.express
    assert not topics.SCAN.cached
    assert topics.MAP_GRID.cached
    assert topics.MAP_GRID.lane is topics.Lane.MAP
    assert topics.MAP_GRID_UPDATE.lane is topics.Lane.MAP  # behind its full grid, in order


@pytest.mark.parametrize("base", ["", "/a", "a/", "a//b", "a/**", "A", "a b", "robots/r1/#", "robots/r1\n", "@rpc"])
def test_bad_bases_are_refused(base: str) -> None:
    with pytest.raises(ValueError, match="key base"):
        topics.check_base(base)


def test_good_bases_pass() -> None:
    assert topics.check_base("robots/r1") == "robots/r1"
    assert topics.check_base("x") == "x"
