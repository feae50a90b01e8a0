"""The publisher against real Zenoh clients on loopback: what is offered arrives, late joiners and get() included."""

from __future__ import annotations

import io
import json
import re
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count, pairwise
from typing import Any

import numpy as np
import pytest

from mapping.frames import Pose2
from mapping.grids.patch import GridPatch
from mapping.scan import Scan
from service import cdr
from service.clock import CrankedClock, SystemClock
from service.namesakes import BELIEVED_AFTER_NS
from service.outputs import GridOut, GridUpdateOut, HealthOut, OdomOut, Output, PoseOut, ScanOut
from service.payloads import RobotInfo
from service.publisher import Publisher
from service.rpc import CallRefused
from service.zenoh_session import (
    CallFailed,
    Client,
    NetworkSettings,
    NetworkTrouble,
    NoDaemon,
    PortInUse,
    closing,
    open_router,
    received,
)
from tests.clients import PatientClient
from tests.waiting import GIVE_UP_S, SteadyClock, free_port, seconds_of, wait_for

SECOND = 1_000_000_000
BASE = "robots/r1"


def free_endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def wait_until(condition: Callable[[], Any]) -> Any:
    """What the condition gives, as soon as it is true."""
    return wait_for("what was waited for", condition, every_s=0.005)


def offer_until_it_arrives(publisher: Publisher, output: Output, subscriber: Any) -> list[Any]:
    """Offer again and again: the first ones may be sent before the subscription is known to the router."""

    def arrived() -> list[Any]:
        publisher.offer(output)
        return drain(subscriber)

    return list(wait_until(arrived))


def drain(subscriber: Any) -> list[Any]:
    samples = []
    while (sample := subscriber.try_recv()) is not None:
        samples.append(received(sample))
    return samples


def scan_out(stamp_ns: int = 1, sensor: str = "front") -> ScanOut:
    return ScanOut(sensor, Scan(stamp_ns, 0.0, np.linspace(-1, 1, 11), np.full(11, 2.0), 0.1, 30.0), Pose2(), 0.0)


def grid_out(epoch: int, value: int = 0, shape: tuple[int, int] = (3, 4)) -> GridOut:
    return GridOut(epoch, epoch, GridPatch(0.05, -1, -2, np.full(shape, value, np.int8)))


def health_out(text: str = "fine") -> HealthOut:
    return HealthOut(1, 0, text, (), {}, {})


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def publisher(endpoint: str) -> Iterator[Publisher]:
    made = Publisher(BASE, NetworkSettings(listen=(endpoint,)), clock=SystemClock())

    def add(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"sum": arguments["a"] + arguments["b"]}

    def decline(_arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        raise CallRefused("not today: the map is empty")

    made.calls.register("add", add)
    made.calls.register("decline", decline)
    made.start()
    yield made
    assert made.close(GIVE_UP_S)


@pytest.fixture
def client(publisher: Publisher, endpoint: str) -> Iterator[Client]:
    with PatientClient(endpoint) as opened:
        yield opened


def test_a_stream_arrives(publisher: Publisher, client: Client) -> None:
    subscriber = client.subscribe(f"{BASE}/scan/**")
    samples = offer_until_it_arrives(publisher, scan_out(stamp_ns=77), subscriber)
    assert samples[0].key == f"{BASE}/scan/front"
    assert samples[0].encoding == "application/cdr;sensor_msgs/msg/LaserScan"
    laser = cdr.decode_laser(samples[0].payload)
    assert laser.frame == "front"
    assert abs(laser.stamp_ns - 77 - SystemClock().wall_from_monotonic_ns(0)) < 1_000_000_000


def test_a_late_joiner_has_every_last_value(publisher: Publisher, client: Client) -> None:
    publisher.publish_info(RobotInfo("r1", BASE, "0", 0))
    for epoch in (1, 2, 3):
        publisher.offer(grid_out(epoch, value=epoch))
        publisher.offer(health_out(f"state {epoch}"))
        wait_until(partial(kept_epoch, client, epoch))
    late = client.subscribe_latched(f"{BASE}/**", ring=64)
    seen: dict[str, Any] = {}

    def has_the_last() -> bool:
        seen.update({sample.key.removeprefix(f"{BASE}/"): sample for sample in drain(late)})
        return (
            {"map/grid", "health", "health/json", "info", "tf/static"} <= set(seen)
            and struct.unpack("<QQ", seen["map/grid"].attachment) == (3, 0)
            and json.loads(seen["health/json"].payload)["text"] == "state 3"
        )

    wait_until(has_the_last)  # what a get() gave may still be on its way into the cache: it comes a moment later
    assert cdr.decode_grid(seen["map/grid"].payload).cells.tolist() == [[3] * 4] * 3


def kept_epoch(client: Client, epoch: int) -> bool:
    answers = client.get(f"{BASE}/map/grid")
    return bool(answers) and struct.unpack("<QQ", answers[0].attachment or b"") == (epoch, 0)


def test_get_gives_the_last_values_on_their_own_keys(publisher: Publisher, client: Client) -> None:
    publisher.offer(grid_out(1))
    publisher.offer(health_out())
    publisher.offer(PoseOut(1, Pose2(1, 2, 3), Pose2(), np.eye(3)))
    keys = {"map/grid", "health", "health/json", "pose", "tf"}

    def everything() -> set[str]:
        return {answer.key.removeprefix(f"{BASE}/") for answer in client.get(f"{BASE}/**")}

    wait_until(lambda: keys <= everything())
    assert [answer.key for answer in client.get(f"{BASE}/map/**")] == [f"{BASE}/map/grid"]
    assert client.get(f"{BASE}/nothing") == []
    assert client.get("robots/other/**") == []


def test_what_nobody_reads_is_not_sent_and_get_has_it(publisher: Publisher, client: Client) -> None:
    for stamp_ns in range(1, 20):
        publisher.offer(scan_out(stamp_ns))
    publisher.offer(health_out())  # cached for those who come later: always sent
    wait_until(lambda: publisher.counters().get("sent") == 2)  # health and health/json, behind all scans
    (answer,) = client.get(f"{BASE}/scan/front")
    stamp_ns = cdr.decode_laser(answer.payload).stamp_ns
    assert abs(stamp_ns - 19 - SystemClock().wall_from_monotonic_ns(0)) < 1_000_000_000
    assert publisher.counters()["sent"] == 2
    subscriber = client.subscribe(f"{BASE}/scan/*")
    offer_until_it_arrives(publisher, scan_out(), subscriber)
    subscriber.undeclare()

    def is_quiet() -> bool:
        """Of a scan and the health behind it, only the health is sent."""
        before, stamp_ns = publisher.counters()["sent"], SystemClock().now_ns()
        publisher.offer(scan_out(stamp_ns))
        publisher.offer(HealthOut(stamp_ns, 0, f"at {stamp_ns}", (), {}, {}))
        wait_until(lambda: f"at {stamp_ns}" in client.get(f"{BASE}/health/json")[0].payload.decode())
        return bool(publisher.counters()["sent"] == before + 2)

    wait_until(is_quiet)


def test_what_was_deferred_leaves_in_order_with_the_next_flush(publisher: Publisher, client: Client) -> None:
    subscriber = client.subscribe(f"{BASE}/scan/*")
    first, *_ = offer_until_it_arrives(publisher, scan_out(1, "rear"), subscriber)
    first_ns = cdr.decode_laser(first.payload).stamp_ns
    stamps: list[int] = []

    def take() -> int:
        for sample in drain(subscriber):
            stamp_ns = cdr.decode_laser(sample.payload).stamp_ns
            if stamp_ns - first_ns > SECOND // 2:  # not one of those that were offered first
                stamps.append(stamp_ns)
        return len(stamps)

    for stamp_ns in (SECOND, 2 * SECOND, 3 * SECOND):
        publisher.defer(scan_out(stamp_ns, "rear"))
    assert take() == 0
    publisher.flush()
    publisher.flush()  # nothing is sent twice
    wait_until(lambda: take() >= 3)
    assert [round((later - earlier) / SECOND) for earlier, later in pairwise(stamps)] == [1, 1]


def test_a_reader_behind_another_router_counts(publisher: Publisher, endpoint: str) -> None:
    """A fleet's router that is linked to the daemon's: what is read there is sent."""
    there = free_endpoint()
    settings = NetworkSettings(listen=(there,), connect=(endpoint,))
    with closing(open_router(settings)), PatientClient(there) as far:
        subscriber = far.subscribe(f"{BASE}/scan/*")
        samples = offer_until_it_arrives(publisher, scan_out(), subscriber)
    assert samples[0].key == f"{BASE}/scan/front"


def test_get_converts_the_grid(publisher: Publisher, client: Client) -> None:
    cells = np.array([[0, 0, 100], [-1, 50, 0]], np.int8)
    publisher.offer(GridOut(1, 1, GridPatch(0.1, 2, -3, cells)))
    wait_until(lambda: client.get(f"{BASE}/map/grid"))
    (pgm,) = client.get(f"{BASE}/map/grid?format=pgm")
    assert pgm.payload == b"P5\n3 2\n255\n" + bytes([205, 205, 254, 254, 254, 0])
    assert pgm.encoding == "image/x-portable-graymap"
    properties = json.loads(pgm.attachment or b"")
    assert properties["origin"] == {"x_m": -0.3, "y_m": 0.2, "yaw_rad": 0.0}
    (npy,) = client.get(f"{BASE}/map/grid?format=npy")
    np.testing.assert_array_equal(np.load(io.BytesIO(npy.payload)), cells)
    (png,) = client.get(f"{BASE}/map/**?format=png;max_age=1e6")
    assert png.payload.startswith(b"\x89PNG")
    (document,) = client.get(f"{BASE}/map/grid?format=json")
    assert json.loads(document.payload)["cells"] == cells.tolist()
    assert client.get(f"{BASE}/map/grid?format=bmp") == []
    assert publisher.counters().get("queries_failed", 0) == 0


def test_max_age_leaves_out_what_is_older(publisher: Publisher, client: Client) -> None:
    clock = SystemClock()
    publisher.offer(scan_out(clock.now_ns() - 60_000_000_000, "old"))
    publisher.offer(scan_out(clock.now_ns(), "new"))
    wait_until(lambda: len(client.get(f"{BASE}/scan/*")) == 2)
    assert [answer.key for answer in client.get(f"{BASE}/scan/*?max_age=30")] == [f"{BASE}/scan/new"]


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_a_wall_clock_that_is_set_makes_no_value_young_or_old(endpoint: str, step_s: int) -> None:
    """Ages went by the wall clock: set back by an hour it made a pose of a minute ago one that is not measured yet."""
    clock = CrankedClock(1000 * SECOND, 1_700_000_000 * SECOND)
    made = Publisher(BASE, NetworkSettings((endpoint,)), clock=clock)
    made.start()
    made.send(scan_out(clock.now_ns() - 60 * SECOND, "old"))
    made.send(scan_out(clock.now_ns(), "new"))
    clock.wall_offset_ns += step_s * SECOND
    with PatientClient(endpoint) as client:
        wait_until(lambda: len(client.get(f"{BASE}/scan/*")) == 2)
        assert [answer.key for answer in client.get(f"{BASE}/scan/*?max_age=30")] == [f"{BASE}/scan/new"]
    assert made.close(GIVE_UP_S)


def test_updates_arrive_in_order_behind_their_grid(publisher: Publisher, client: Client) -> None:
    subscriber = client.subscribe(f"{BASE}/map/**", ring=256)
    offer_until_it_arrives(publisher, grid_out(1, -1, (40, 40)), subscriber)
    for row in range(30):
        patch = GridPatch(0.05, row - 1, -2, np.full((1, 5), row, np.int8))
        publisher.offer(GridUpdateOut(1, 1, patch))
    updates: list[Any] = []

    def all_there() -> bool:
        updates.extend(sample for sample in drain(subscriber) if sample.key.endswith("/update"))
        return len(updates) >= 30

    wait_until(all_there)
    assert [struct.unpack("<QQ", sample.attachment) for sample in updates] == [(1, n) for n in range(1, 31)]
    assert [cdr.decode_grid_update(sample.payload).y for sample in updates] == list(range(30))


def test_calls_answer_or_say_why_not(publisher: Publisher, client: Client) -> None:
    assert client.call(BASE, "add", {"a": 2, "b": 3}) == {"sum": 5}
    with pytest.raises(CallFailed, match="not today: the map is empty"):
        client.call(BASE, "decline")
    with pytest.raises(CallFailed, match="add, decline"):
        client.call(BASE, "unknown")
    with pytest.raises(CallFailed, match="KeyError"):
        client.call(BASE, "add", {"a": 1})
    with pytest.raises(CallFailed, match="does not answer"):
        client.call("robots/other", "add", timeout_s=0.5)
    assert client.call(BASE, "add", {"a": 1, "b": 1}) == {"sum": 2}
    assert publisher.counters()["calls_failed"] == 3


def test_a_wildcard_get_calls_nothing(publisher: Publisher, client: Client) -> None:
    client.get(f"{BASE}/**")
    client.get("**")
    client.get("**/@rpc/**", timeout_s=0.5)  # no call has such a name
    counters = publisher.counters()
    assert counters["calls_answered"] == 0


def test_alive_while_it_lives(endpoint: str) -> None:
    publisher = Publisher(BASE, NetworkSettings(listen=(endpoint,)), clock=SystemClock())
    publisher.start()
    with PatientClient(endpoint) as client:
        assert wait_until(client.bases) == [BASE]
        assert client.only_base() == BASE
        assert client.only_base("robots/x") == "robots/x"
        publisher.close()
        with pytest.raises(NoDaemon):
            client.only_base()


def test_another_daemon_of_this_name_is_told_with_its_repair(
    publisher: Publisher, endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Two robots with one id behind linked routers: whoever reads gets both, mixed, and nothing said so."""
    assert not publisher.troubles(0)
    other_robot = Publisher("robots/r2", NetworkSettings((free_endpoint(),), (endpoint,)), clock=SystemClock())
    twin = Publisher(BASE, NetworkSettings((free_endpoint(),), (endpoint,)), clock=SystemClock())
    other_robot.start()
    twin.start()
    stamps = count(0, SECOND)  # a second passes with each question

    trouble = wait_until(lambda: publisher.troubles(next(stamps)))[0]
    assert re.fullmatch(r"another daemon calls itself r1 too \(process \d+ on \S+\) .*\[robot\] id", trouble)
    assert next(stamps) > BELIEVED_AFTER_NS, "our own earlier self may linger behind another router for a lease"
    assert publisher.troubles(next(stamps)) == [trouble]
    assert wait_until(lambda: twin.troubles(next(stamps)))
    assert not other_robot.troubles(next(stamps))
    assert [record.message for record in caplog.records] == [trouble] * 2, "each tells it once"
    assert twin.close(GIVE_UP_S)
    wait_until(lambda: not publisher.troubles(next(stamps)))
    assert other_robot.close(GIVE_UP_S)


def test_a_port_in_use_names_the_repair(publisher: Publisher, endpoint: str) -> None:
    second = Publisher("robots/r2", NetworkSettings(listen=(endpoint,)), clock=SystemClock())
    with pytest.raises(PortInUse, match=r"another daemon or Zenoh router.*\[network\] listen"):
        second.start()
    assert second.close(GIVE_UP_S)


def test_no_daemon_names_the_repair(endpoint: str) -> None:
    with pytest.raises(NoDaemon, match="umfeld run"):
        Client(endpoint)


def test_listening_to_the_world_needs_certificates() -> None:
    with pytest.raises(NetworkTrouble, match="without a certificate"):
        Publisher(BASE, NetworkSettings(listen=("tcp/0.0.0.0:0",)), clock=SystemClock()).start()


def test_a_frozen_client_holds_up_nobody(publisher: Publisher, endpoint: str) -> None:
    """A subscriber whose callback never returns: offers stay immediate and others go on receiving.

    An offer that waited for it would do so until it is let go, at the end, or for the seconds that Zenoh has patience.
    """
    frozen_at, released = threading.Event(), threading.Event()

    def freeze(_sample: Any) -> None:
        frozen_at.set()
        released.wait()

    with SteadyClock() as clock, PatientClient(endpoint) as frozen, PatientClient(endpoint) as lively:
        frozen.session.declare_subscriber(f"{BASE}/**", freeze)
        subscriber = lively.subscribe(f"{BASE}/scan/**", ring=2000)
        offer_until_it_arrives(publisher, scan_out(), subscriber)
        big = grid_out(1, 0, (1000, 1000))
        longest, count = 0.0, 0

        def offer_both() -> None:
            publisher.offer(scan_out(count))
            publisher.offer(big)

        def others_go_on() -> bool:
            nonlocal longest, count
            longest = max(longest, seconds_of(clock, offer_both))
            count += len(drain(subscriber))
            return frozen_at.is_set() and count > 100

        try:
            wait_until(others_go_on)
        finally:
            released.set()
        assert longest < 0.5


def test_close_is_quick_and_final(endpoint: str) -> None:
    publisher = Publisher(BASE, NetworkSettings(listen=(endpoint,)), clock=SystemClock())
    publisher.start()
    publisher.offer(grid_out(1))
    with SteadyClock() as clock:
        began_ns = clock()
        assert publisher.close(GIVE_UP_S)
        assert clock() - began_ns < 3_000_000_000, "the daemon gives it two seconds"
    publisher.offer(grid_out(2))  # afterwards offers go nowhere, without an error
    again = Publisher(BASE, NetworkSettings(listen=(endpoint,)), clock=SystemClock())
    again.start()  # the port is free at once
    assert again.close(GIVE_UP_S)


def test_whether_odometry_is_read_is_known(publisher: Publisher, client: Client) -> None:
    """While it is, every motion wakes fusion; while it is not known yet, too."""

    def odom_out() -> OdomOut:
        return OdomOut(1, Pose2(), np.eye(3), 0.0, 0.0)

    assert publisher.odometry_is_read()
    poses = client.subscribe(f"{BASE}/pose")
    offer_until_it_arrives(publisher, PoseOut(1, Pose2(), Pose2(), np.eye(3)), poses)
    publisher.offer(odom_out())
    wait_until(lambda: not publisher.odometry_is_read())
    odometry = client.subscribe(f"{BASE}/odom")
    wait_until(publisher.odometry_is_read)
    odometry.undeclare()
    wait_until(lambda: not publisher.odometry_is_read())
    transforms = client.subscribe(f"{BASE}/tf")
    wait_until(publisher.odometry_is_read)
    transforms.undeclare()


def test_a_bad_value_is_counted_and_silences_nothing(publisher: Publisher, client: Client) -> None:
    subscriber = client.subscribe(f"{BASE}/scan/**")
    poses = client.subscribe(f"{BASE}/pose")  # what nobody reads is not even made
    offer_until_it_arrives(publisher, scan_out(), subscriber)
    offer_until_it_arrives(publisher, PoseOut(1, Pose2(), Pose2(), np.eye(3)), poses)
    publisher.offer(PoseOut(1, Pose2(), Pose2(), np.eye(2)))  # a covariance of the wrong shape
    wait_until(lambda: publisher.counters().get("not_sent_errors"))
    publisher.offer(scan_out(2))
    wait_until(lambda: drain(subscriber))
