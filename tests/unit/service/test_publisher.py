"""What waits to be sent: newest wins, order where it matters, nothing lost uncounted; and calls without a network."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service.clock import CrankedClock
from service.errors import Trouble
from service.outputs import GridOut, GridUpdateOut, HealthOut, OdomOut, Output, PoseOut, RangesOut, ScanOut
from service.payloads import Message
from service.publisher import Outbox, Parcel, Publisher, slot_of
from service.rpc import _NEEDS, CallRefused, Calls, map_name
from service.zenoh_session import NetworkSettings, is_loopback, refuse_open_listeners
from tests.waiting import GIVE_UP_S


def parcel(number: int) -> Parcel:
    def make() -> list[Message]:
        return [number]  # type: ignore[list-item]  # a label is enough here

    return make


def taken(outbox: Outbox) -> list[Any]:
    outbox.close()
    numbers: list[Any] = []
    while (item := outbox.take()) is not None:
        numbers += item()
    return numbers


def test_the_newest_takes_the_place_of_the_one_before() -> None:
    outbox = Outbox()
    for number in range(5):
        outbox.put("scan", parcel(number))
    outbox.put("pose", parcel(10))
    assert taken(outbox) == [4, 10]
    assert outbox.dropped == {"scan": 4}


def test_a_busy_slot_does_not_starve_the_others() -> None:
    outbox = Outbox()
    outbox.put("updates", parcel(1), depth=9)
    outbox.put("updates", parcel(2), depth=9)
    outbox.put("grid", parcel(3))
    assert taken(outbox) == [1, 3, 2]


@given(st.lists(st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(1, 4)), max_size=60))
def test_what_is_put_is_taken_or_counted(puts: list[tuple[str, int]]) -> None:
    outbox = Outbox()
    for number, (slot, depth) in enumerate(puts):
        outbox.put(slot, parcel(number), depth=depth)
    numbers = taken(outbox)
    assert len(numbers) + sum(outbox.dropped.values()) == len(puts)
    for slot in "abc":
        mine = [number for number in numbers if puts[number][0] == slot]
        assert mine == sorted(mine)
        last = max((number for number, put in enumerate(puts) if put[0] == slot), default=None)
        assert last is None or last in mine


def test_who_takes_sleeps_until_it_is_woken() -> None:
    """Waking is dear: what is put quietly waits for wake(), and that finds it even if more was put since."""
    outbox, came = Outbox(), threading.Semaphore(0)
    numbers: list[Any] = []

    def take() -> None:
        while (item := outbox.take()) is not None:
            numbers.extend(item())
            came.release()

    outbox.wake()  # nothing waits, nobody sleeps
    thread = threading.Thread(target=take)
    thread.start()
    for round_ in range(50):
        outbox.put("a", parcel(2 * round_), wake=False)
        outbox.put("b", parcel(2 * round_ + 1), wake=round_ % 2 == 0)
        if round_ % 2:
            outbox.wake()
        assert came.acquire(timeout=GIVE_UP_S)
        assert came.acquire(timeout=GIVE_UP_S)
    outbox.put("a", parcel(100), wake=False)
    outbox.close()
    thread.join(GIVE_UP_S)
    assert numbers == list(range(101))


def test_a_full_grid_supersedes_the_updates_before_it() -> None:
    outbox = Outbox()
    outbox.put("grid", parcel(1), supersedes="update")
    outbox.put("update", parcel(2), depth=9)
    outbox.put("update", parcel(3), depth=9)
    outbox.put("grid", parcel(4), supersedes="update")
    outbox.put("update", parcel(5), depth=9)
    assert taken(outbox) == [4, 5]
    assert outbox.dropped == {"grid": 1, "update": 2}


def test_take_waits_and_close_wakes_it() -> None:
    outbox = Outbox()
    got: list[Any] = []
    thread = threading.Thread(target=lambda: got.append(outbox.take()))
    thread.start()
    outbox.close()
    thread.join(GIVE_UP_S)
    assert got == [None]


def test_slots_tell_apart_what_must_not_replace_each_other() -> None:
    scan = Scan(0, 0.0, np.zeros(1), np.zeros(1), 0.0, 1.0)
    patch = GridPatch(0.1, 0, 0, np.zeros((1, 1), np.int8))
    outputs: list[Output] = [
        ScanOut("a", scan, Pose2(), 0.0),
        ScanOut("b", scan, Pose2(), 0.0),
        RangesOut("a", 0, (), 0.1, 0.1, 1.0, ()),
        OdomOut(0, Pose2(), np.eye(3), 0, 0),
        PoseOut(0, Pose2(), Pose2(), np.eye(3)),
        GridOut(0, 1, patch),
        GridOut(0, 1, patch, "local"),
        GridUpdateOut(0, 1, patch),
        HealthOut(0, 0, "", (), {}, {}),
    ]
    slots = [slot_of(output) for output in outputs]
    assert len(set(slots)) == len(slots)


@pytest.mark.parametrize(
    ("address", "inside"),
    [
        ("127.0.0.1:7447", True),
        ("127.8.9.10:1", True),
        ("localhost:7447", True),
        ("[::1]:7447", True),
        ("127.0.0.1:7447?rel=1", True),
        ("0.0.0.0:7447", False),
        ("[::]:7447", False),
        ("192.168.1.20:7447", False),
        ("robot.local:7447", False),
        ("127.evil.example:7447", False),
        ("", False),
    ],
)
def test_loopback(address: str, inside: bool) -> None:
    assert is_loopback(address) == inside
    if not inside:
        with pytest.raises(Trouble, match="without a certificate"):
            refuse_open_listeners([f"tcp/{address}"])
    refuse_open_listeners([f"tls/{address}", "unixsock-stream//run/x.sock"])


class FakeQuery:
    """A query as a queryable gets it."""

    def __init__(self, key: str, payload: bytes | None = None) -> None:
        self.key_expr, self.payload = key, payload
        self.replies: list[Any] = []
        self.errors: list[str] = []
        self.ended = threading.Event()

    def __enter__(self) -> FakeQuery:
        return self

    def __exit__(self, *_error: object) -> None:
        self.ended.set()

    def reply(self, key: str, payload: bytes, *, encoding: str) -> None:
        assert key == self.key_expr
        assert encoding.startswith("application/json;")
        self.replies.append(json.loads(payload))

    def reply_err(self, payload: bytes, *, encoding: str) -> None:
        self.errors.append(json.loads(payload)["error"])


class FakeSession:
    """Gives the queryable's callback away."""

    def declare_queryable(self, key: str, on_query: Any, *, complete: bool) -> None:
        assert key == "robots/r/@rpc/*"
        self.ask = on_query


def started(calls: Calls) -> Any:
    session = FakeSession()
    calls.start(session)
    return session.ask


def test_a_call_that_is_not_there_says_what_it_needs() -> None:
    calls = Calls("robots/r")
    calls.register("record_stop", lambda _: {})
    with pytest.raises(CallRefused, match=r"save_map needs a map: \[grid\].*there are: record_stop"):
        calls._call("save_map", b"")
    with pytest.raises(CallRefused, match="no call 'dance'"):
        calls._call("dance", b"")
    documented = (Path(__file__).parents[3] / "docs/keys.md").read_text()
    assert all(f"{name}`" in documented for name in _NEEDS)


@pytest.mark.parametrize(
    ("payload", "complaint"),
    [
        (b"[1]", "JSON object"),
        (b"{", "not JSON"),
        (b"\xff", "not JSON"),
        (b"[" * 5000, "not JSON"),
        (b" " * 70_000, "70000"),
    ],
)
def test_bad_arguments_are_refused_in_words(payload: bytes, complaint: str) -> None:
    calls = Calls("robots/r")
    calls.register("go", lambda arguments: {"got": dict(arguments)})
    ask = started(calls)
    query = FakeQuery("robots/r/@rpc/go", payload)
    ask(query)
    assert query.ended.wait(GIVE_UP_S)
    assert complaint in query.errors[0]
    fine = FakeQuery("robots/r/@rpc/go", b'{"a": 1}')
    ask(fine)
    assert fine.ended.wait(GIVE_UP_S)
    assert fine.replies == [{"got": {"a": 1}}]
    calls.stop(5)


def test_too_many_calls_are_refused_and_none_is_left_hanging() -> None:
    gate = threading.Event()
    calls = Calls("robots/r")

    def slow(_arguments: Any) -> dict[str, Any]:
        gate.wait(GIVE_UP_S)
        return {}

    calls.register("slow", slow)
    ask = started(calls)
    queries = [FakeQuery("robots/r/@rpc/slow") for _ in range(40)]
    for query in queries:
        ask(query)
    refused = [query for query in queries if query.errors]
    assert len(refused) in (23, 24)  # 16 wait, one may be at work already
    assert all("busy" in query.errors[0] for query in refused)
    assert calls.refused == len(refused)
    gate.set()
    assert all(query.ended.wait(GIVE_UP_S) for query in queries)
    assert calls.answered == len(queries) - len(refused)
    calls.stop(5)


def test_a_name_is_registered_once() -> None:
    calls = Calls("robots/r")
    calls.register("go", lambda arguments: arguments)
    with pytest.raises(ValueError, match="registered already"):
        calls.register("go", lambda arguments: arguments)


class Maps:
    """A map service that notes what it is asked."""

    def save(self, name: str) -> dict[str, Any]:
        return {"saved": name}

    def load(self, name: str) -> dict[str, Any]:
        raise CallRefused(f"no map {name}")

    def new(self, name: str | None) -> dict[str, Any]:
        return {"kept": name}

    def list(self) -> dict[str, Any]:
        return {"maps": []}

    def info(self) -> dict[str, Any]:
        return {"rows": 3}


def test_the_map_service_answers_its_calls() -> None:
    calls = Calls("robots/r")
    calls.register_map_service(Maps())
    assert calls.names == ["list_maps", "load_map", "map_info", "new_map", "save_map"]
    ask = started(calls)
    answers: list[Any] = []
    for name, payload in (
        ("save_map", b'{"name":"flat"}'),
        ("load_map", b'{"name":"x"}'),
        ("map_info", None),
        ("new_map", None),
        ("new_map", b'{"name":"old"}'),
    ):
        query = FakeQuery(f"robots/r/@rpc/{name}", payload)
        ask(query)
        assert query.ended.wait(GIVE_UP_S)
        answers.extend(query.replies or query.errors)
    assert answers == [{"saved": "flat"}, "no map x", {"rows": 3}, {"kept": None}, {"kept": "old"}]
    calls.stop(5)


@pytest.mark.parametrize("name", ["", "../x", "a/b", "a.b", ".", "x" * 65, "a b", "a\0", None, 7, ["a"]])
def test_names_of_maps_are_no_paths(name: Any) -> None:
    with pytest.raises(CallRefused, match="one word"):
        map_name({"name": name})


def test_good_names_of_maps() -> None:
    assert map_name({"name": "Floor-1_east"}) == "Floor-1_east"
    with pytest.raises(CallRefused):
        map_name({})


def test_readings_of_a_burst_are_all_sent_and_poses_only_the_newest() -> None:
    publisher = Publisher("robots/r1", NetworkSettings(), clock=CrankedClock(0, 0))
    for k in range(5):
        publisher.offer(RangesOut("left", k, (Pose2(),), 0.5, 0.1, 5.0, (1.0,)), wake=False)
        publisher.offer(OdomOut(k, Pose2(), np.eye(3), 0.0, 0.0), wake=False)
        publisher.offer(PoseOut(k, Pose2(), Pose2(), np.eye(3)), wake=False)
    lost = {name: count for name, count in publisher.counters().items() if name.startswith("not_sent.")}
    assert lost == {"not_sent.pose": 4}
    for k in range(20):
        publisher.offer(RangesOut("left", 5 + k, (Pose2(),), 0.5, 0.1, 5.0, (1.0,)), wake=False)
    assert publisher.counters()["not_sent.range/left"] == 25 - 8
