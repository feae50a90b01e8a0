"""The questions of S41 as a call, over a small house whose answers can be worked out by hand."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service import maker_calls
from service.routes import Passage, Ways, nearest_of, route_answer
from service.rpc import CallRefused

AT: dict[int | str, tuple[float, float] | None] = {
    1: (0.0, 0.0),
    2: (10.0, 0.0),
    3: (10.0, 10.0),
    4: (0.0, 10.0),
    5: (20.0, 0.0),
}
HOUSE = Ways(
    "rooms",
    AT,
    [
        Passage(1, 2, (5.0, 0.0)),
        Passage(2, 3, (10.0, 5.0)),
        Passage(3, 4, (5.0, 10.0)),
        Passage(1, 4, (0.0, 5.0)),
        Passage(2, 5, (15.0, 0.0)),
        Passage(5, 2, (15.0, 3.0)),  # a second door between the two
    ],
    nearest=lambda point, name: nearest_of(AT, point, name, "room"),
    names={"kitchen": 3},
)


def asked(**arguments: Any) -> dict[str, Any]:
    answer = route_answer(HOUSE, {name.rstrip("_"): value for name, value in arguments.items()})
    json.dumps(answer, allow_nan=False)
    return answer


def test_a_route_its_stops_and_a_way_round_each_door() -> None:
    answer = asked(from_=1, to="kitchen")
    assert (answer["nodes"], answer["length_m"], answer["stops"]) == ([1, 2, 3], 20.0, 1)
    assert answer["positions"] == [[0.0, 0.0], [5.0, 0.0], [10.0, 0.0], [10.0, 5.0], [10.0, 10.0]]
    assert [(each["edge"], each["at"], each["nodes"]) for each in answer["alternatives"]] == [
        ([1, 2], [5.0, 0.0], [1, 4, 3]),
        ([2, 3], [10.0, 5.0], [1, 4, 3]),
    ]
    assert asked(from_=[0.3, -0.4], to=3)["nodes"] == [1, 2, 3]


def test_via_and_one_or_the_other() -> None:
    assert asked(from_=1, to=3, via=[4])["nodes"] == [1, 4, 3]
    assert asked(from_=1, to=1, via=[2])["nodes"] == [1, 2, 1]
    either = asked(from_=1, to=3, either=[4, 5], avoid_edges=[[2, 5]])["either"]
    assert [(each["via"], each["nodes"]) for each in either] == [(4, [1, 4, 3]), (5, None)]


def test_what_fails_is_gone_round_and_what_is_cut_off_said() -> None:
    assert asked(from_=1, to=3, avoid=[2])["nodes"] == [1, 4, 3]
    assert asked(from_=1, to=3, avoid_edges=[[3, 2]])["nodes"] == [1, 4, 3]
    assert asked(from_=1, avoid=[2]) == {"kind": "rooms", "cut_off": [5]}
    assert asked(from_=1, avoid_edges=[[2, 5]]) == {"kind": "rooms", "cut_off": [5]}
    assert asked(from_=1, avoid_edges=[[1, 2]]) == {"kind": "rooms", "cut_off": []}
    with pytest.raises(CallRefused, match="no way from 1 to 5 without 2 - 5"):
        asked(from_=1, to=5, avoid_edges=[[2, 5]])


def test_of_two_doors_the_other_is_the_way_round() -> None:
    answer = asked(from_=2, to=5)
    (only,) = answer["alternatives"]
    assert only["nodes"] == [2, 5]
    assert only["at"] == [15.0, 0.0]
    assert only["length_m"] > answer["length_m"] == 10.0
    assert only["cut_off"] == []


def test_large_rooms_are_crossed_from_door_to_door() -> None:
    """A hallway of 40 m whose middle is far from two neighbouring doors."""
    hall = Ways(
        "rooms",
        {0: (20.0, 0.0), 1: (0.0, 3.0), 2: (3.0, 3.0)},
        [Passage(0, 1, (0.0, 1.0)), Passage(2, 0, (3.0, 1.0))],
        through=True,
    )
    answer = route_answer(hall, {"from": 1, "to": 2})
    assert (answer["nodes"], answer["length_m"]) == ([1, 0, 2], 7.0)
    assert answer["positions"] == [[0.0, 3.0], [0.0, 1.0], [3.0, 1.0], [3.0, 3.0]]
    assert route_answer(hall, {"from": 1, "to": 2, "via": [0]})["length_m"] > 40.0


def test_a_map_without_a_frame_has_lengths_and_no_positions() -> None:
    places = Ways("places", {"place 0": None, "node 1.0": None}, [Passage("place 0", "node 1.0", None, 2.5)])
    answer = route_answer(places, {"from": "place 0", "to": "node 1.0"})
    assert (answer["nodes"], answer["length_m"]) == (["place 0", "node 1.0"], 2.5)
    assert "positions" not in answer
    with pytest.raises(CallRefused, match='"from" is a node of the map of places, got'):
        route_answer(places, {"from": [1.0, 2.0], "to": "place 0"})


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_positions_are_as_long_as_the_route_and_detours_no_shorter(seed: int, through: bool) -> None:
    import random

    rng = random.Random(seed)
    at: dict[int | str, tuple[float, float] | None] = {k: (rng.uniform(0, 9), rng.uniform(0, 9)) for k in range(7)}
    pairs = [rng.sample(range(7), 2) for _ in range(12)]
    doors = [Passage(a, b, (rng.uniform(0, 9), rng.uniform(0, 9))) for a, b in pairs]
    try:
        answer = route_answer(Ways("rooms", at, doors, through=through), {"from": 0, "to": 6})
    except CallRefused:
        return
    length = sum(math.dist(a, b) for a, b in zip(answer["positions"], answer["positions"][1:]))
    assert length == pytest.approx(answer["length_m"], abs=0.02)
    assert len(answer["alternatives"]) == len(answer["nodes"]) - 1
    for each in answer["alternatives"]:
        assert (each["nodes"] is None) == bool(each["cut_off"])
        if each["nodes"] is not None:
            assert each["length_m"] >= answer["length_m"] - 1e-6
            assert (each["nodes"][0], each["nodes"][-1]) == (0, 6)


@dataclass
class Fixed:
    told: Ways

    def ways(self) -> Ways:
        return self.told


def test_which_map_is_meant() -> None:
    other = Ways("regions", {1: (0.0, 0.0)}, [])
    both = {"topo": Fixed(other), "rooms": Fixed(HOUSE)}
    assert maker_calls.route(both, {"from": 1, "to": 1})["kind"] == "regions"
    answer = maker_calls.route(both, {"map": "rooms", "from": 1, "to": 2})
    assert (answer["map"], answer["nodes"]) == ("rooms", [1, 2])
    assert maker_calls.route({"rooms": Fixed(HOUSE)}, {"from": 1, "to": 2})["map"] == "rooms"
    for wrong in ("places", 3, None):
        with pytest.raises(CallRefused, match='"map": this daemon has rooms and topo'):
            maker_calls.route(both, {"map": wrong, "from": 1, "to": 2})
