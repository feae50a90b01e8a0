"""Recording and replay without wires: one robot in memory, recorded while it maps, and played again."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.conversation import CanFrame
from drivers.ports import Direction
from drivers.readings import DeviceEvent, Identity, LinkState
from service import recording, recording_files, topics
from service.clock import CrankedClock
from service.errors import Trouble
from service.payloads import Message
from service.recording import Calls, Recorder, Settings, Start, decode_calls, encode_calls, event_of, event_text
from service.replay import Lost, Recording, Replay, Taken
from tests.waiting import wait_for

STAMPS = st.integers(0, 1 << 60)
SECOND = 1_000_000_000


@given(st.lists(st.tuples(STAMPS, STAMPS, st.integers(0, 3), st.integers(0, 255)), min_size=1, max_size=40))
def test_calls_come_back_and_bag_readers_read_them(calls: list[tuple[int, int, int, int]]) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    now, stamps, kinds, sources = zip(*calls)
    made = Calls(now, stamps, bytes(kinds), bytes(sources))
    message = encode_calls(made)
    assert decode_calls(message) == made
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(recording.CALLS_DEFINITION, recording.CALLS_TYPE))
    read: Any = store.deserialize_cdr(message, recording.CALLS_TYPE)
    assert (tuple(read.now_ns), tuple(read.stamp_ns), bytes(read.kind)) == (now, stamps, made.kind)
    for cut in range(len(message)):
        with pytest.raises(ValueError):
            decode_calls(message[:cut])


@given(
    st.builds(DeviceEvent, STAMPS, st.sampled_from(LinkState), st.text(), st.none() | st.builds(Identity, st.text()))
)
def test_events_come_back(event: DeviceEvent) -> None:
    assert event_of(json.loads(event_text("front", event))) == ("front", event)


# --- files


class Desk:
    """A recorder on a folder, with a clock that is turned by hand."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.clock = CrankedClock(SECOND, 1_700_000_000 * SECOND)
        self.settings = replace(
            Settings(folder, file_bytes=60_000, total_bytes=300_000, free_bytes=0), waiting_bytes=2_000_000, **changes
        )
        self.recorder = Recorder(self.settings, clock=self.clock)
        self.noise = random.Random(1)
        self.tap = self.recorder.tap("can-main")

    def begin(self, **changes: Any) -> Path:
        return self.recorder.begin(replace(Start("artos", "1", "{}", ("front", "drive")), **changes))

    def say(self, count: int = 1, size: int = 500) -> list[bytes]:
        """Chunks on the wire, 10 ms apart."""
        said = [self.noise.randbytes(size) for _ in range(count)]
        for chunk in said:
            self.clock.turn(10_000_000)
            self.tap(Direction.IN, self.clock.now_ns(), chunk)
        return said

    def written(self, check: Callable[[], bool]) -> None:
        """Wait for the writing thread to have done something."""
        wait_for("the writing thread", check)


def bytes_in(folder: Path) -> int:
    """Size of a run's files [bytes] while the writing thread makes and removes some; one just removed takes none."""
    total = 0
    for path in folder.glob("artos-*"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def chunks(path: Path) -> list[bytes]:
    items = [entry.record.item for entry in Recording((path,)).entries() if isinstance(entry, Taken)]
    return [item for item in items if isinstance(item, bytes)]


def test_what_was_heard_is_in_the_file_with_its_time(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    desk.tap(Direction.IN, 1, b"before it begins")
    path = desk.begin(tiles=((0, -1, b"tile"),), pose=(1.0, 2.0, 3.0))
    frame = CanFrame(0x181, b"\x01\x02")
    desk.tap(Direction.CONNECTED, 10, "front")
    for now_ns in (20, 30):
        desk.tap(Direction.TURN, now_ns, "")
    desk.tap(Direction.IN, 35, frame)
    desk.tap(Direction.TURN, 40, "")
    desk.recorder.call(recording.TICK, 41)
    sink = desk.recorder.sink(lambda _source, _item: None)
    sink("front", DeviceEvent(42, LinkState.RUNNING, "readings arrive"))
    done = desk.recorder.end({"map_sha256": "abc"})
    assert done is not None
    assert done["finished"]
    assert done["files"] == [str(path)]
    found = Recording.of(path)
    head = found.head()
    assert head.start == Start("artos", "1", "{}", ("front", "drive"), (1.0, 2.0, 3.0), True, ((0, -1, b"tile"),))
    taken = [entry.record for entry in found.entries() if isinstance(entry, Taken)]
    assert [(each.direction, each.stamp_ns, each.item, each.asked_ns) for each in taken] == [
        (Direction.CONNECTED, 10, "front", ()),
        (Direction.IN, 35, frame, (20, 30)),
        (Direction.TURN, 40, "", (40,)),
    ]
    assert [type(entry).__name__ for entry in found.entries()].count("Calls") == 1
    assert found.end == {"map_sha256": "abc"}
    assert not found.cut


def test_two_runs_of_one_second_have_two_names_and_one_recorder_records_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    first = desk.begin()
    with pytest.raises(Trouble, match="under way"):
        desk.begin()
    desk.recorder.end()
    second = desk.begin()
    desk.recorder.end()
    assert first != second
    assert Recording.of(tmp_path).files == (second,)
    assert desk.recorder.end() is None


def test_a_folder_that_cannot_be_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Trouble, match=r"\[recording\] folder"):
        Desk(tmp_path / "file" / "below").begin()
    with pytest.raises(Trouble, match="no recording"):
        Recording.of(tmp_path)
    with pytest.raises(Trouble, match="no such file"):
        Recording.of(tmp_path / "none.mcap")
    (tmp_path / "other.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(Trouble, match="not a recording of umfeld"):
        Recording.of(tmp_path / "other.mcap").head()


def test_disk_space_is_bounded_and_the_first_file_stays(tmp_path: Path) -> None:
    old = tmp_path / "artos-20200101T000000Z-0000.mcap"
    old.write_bytes(bytes(50_000))
    strangers = [tmp_path / "holiday.mcap", tmp_path / "their-bag-0001.mcap"]
    for stranger in strangers:
        stranger.write_bytes(bytes(10))
    desk = Desk(tmp_path)
    first = desk.begin()
    said: list[bytes] = []
    for _ in range(40):
        said += desk.say(100, 400)
        desk.written(lambda: desk.recorder.counters()["recording.waiting_bytes"] == 0)
        assert bytes_in(tmp_path) < 300_000 + 60_000
    desk.recorder.end()
    files = recording_files.files_of_run(tmp_path, first.name.removesuffix("-0000.mcap"))
    assert files[0] == first
    assert not old.exists()
    assert all(stranger.exists() for stranger in strangers)
    assert 3 <= len(files) <= 6
    entries = list(Recording.of(first).entries())
    assert sum(isinstance(entry, Lost) for entry in entries) == 1, "the gap in the middle is told"
    heard = [entry.record.item for entry in entries if isinstance(entry, Taken)]
    assert heard[: len(chunks(first))] == said[: len(chunks(first))]
    assert heard[-1] == said[-1]


def test_a_file_cut_anywhere_gives_what_was_whole(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "a", file_bytes=10_000_000, total_bytes=100_000_000)
    path = desk.begin()
    said = []
    for _ in range(12):
        said += desk.say(60)
        desk.clock.turn(SECOND)
        desk.written(lambda: desk.recorder.counters()["recording.waiting_bytes"] == 0)
    before_the_end = path.read_bytes()
    desk.recorder.end()
    whole = path.read_bytes()
    cut = tmp_path / path.name
    seen = set()
    for size in [*range(600, len(whole), 7001), len(before_the_end)]:
        cut.write_bytes(whole[:size])
        found = Recording((cut,))
        heard = [entry.record.item for entry in found.entries() if isinstance(entry, Taken)]
        assert heard == said[: len(heard)]
        assert found.cut or size == len(whole)
        seen.add(len(heard))
    assert len(seen) > 8, "chunks end every second, whatever their size"
    cut.write_bytes(whole[: len(before_the_end)])
    assert len(chunks(cut)) >= 0.8 * len(said), "killed, it has lost no more than the last second or two"
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    cut.write_bytes(flipped)
    assert chunks(cut) == said[: len(chunks(cut))], "a bad sector ends the reading, it makes nothing up"


class FullDisk:
    """Makes every sync fail while it is full, as ENOSPC does once buffers must go to the disk."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full = False
        self._sync = os.fdatasync
        monkeypatch.setattr(os, "fdatasync", self.sync)

    def sync(self, descriptor: int) -> None:
        if self.full:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._sync(descriptor)


def test_a_full_disk_stops_nothing_is_told_and_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = FullDisk(monkeypatch)
    desk = Desk(tmp_path, file_bytes=10_000_000, total_bytes=100_000_000)
    path = desk.begin()

    def pass_time(seconds: int) -> list[bytes]:
        said = []
        for _ in range(seconds):
            said += desk.say(10)
            desk.clock.turn(SECOND)
            desk.written(lambda: desk.recorder.counters()["recording.waiting_bytes"] == 0)
        return said

    pass_time(3)
    disk.full = True
    pass_time(4)
    desk.written(lambda: desk.recorder.trouble() is not None)
    assert "free some space" in str(desk.recorder.trouble())
    assert "No space left" in str(desk.recorder.trouble())
    disk.full = False
    pass_time(8)
    desk.written(lambda: desk.recorder.trouble() is None)
    last = pass_time(2)
    done = desk.recorder.end()
    assert done is not None
    assert len(done["files"]) == 2
    assert done["not_written"] > 0
    entries = list(Recording.of(path).entries())
    assert any(isinstance(entry, Lost) and "lost while recording" in entry.why for entry in entries)
    heard = [entry.record.item for entry in entries if isinstance(entry, Taken)]
    assert heard[-len(last) :] == last


def test_when_writing_is_too_slow_published_messages_go_first_and_losses_are_told(tmp_path: Path) -> None:
    waiting = recording._Waiting(1000)
    message = Message(topics.HEALTH, "health", bytes(100), 0)
    for number in range(10):
        waiting.put(recording.Published(message, number), 300, is_extra=True)
    assert waiting.counts() == {"lost": 0, "lost_published": 9, "waiting_bytes": 300}
    for number in range(10):
        waiting.put((number, 0, recording.TICK, 0), 100)
    assert waiting.counts()["lost"] == 3
    things, lost = waiting.take_all()
    assert (len(things), lost) == (8, 3)
    assert waiting.take_all() == ([], 0)


def test_published_messages_can_be_left_out_and_json_is_a_string(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    for published in (True, False):
        desk = Desk(tmp_path / str(published), published=published)
        path = desk.begin()
        desk.recorder.message(Message(topics.HEALTH_JSON, "health/json", '{"ä": 1}'.encode(), 5))
        desk.recorder.end()
        with path.open("rb") as stream:
            found = [
                (channel.topic, schema.name if schema else "", recording.decode_string(message.data))
                for schema, channel, message in make_reader(stream).iter_messages()
            ]
        assert found == ([("/health/json", "std_msgs/msg/String", '{"ä": 1}')] if published else [])


def test_who_does_not_record_loads_no_mcap() -> None:
    import subprocess
    import sys

    code = "import sys, service.daemon; sys.exit(any(name.startswith(('mcap', 'rosbags')) for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], timeout=300, check=False).returncode == 0


def test_news_before_a_device_is_set_up_anew_do_not_stand_for_its_readings(tmp_path: Path) -> None:
    """A recording that begins while the daemon runs: silence is told, then a reading is taken that began before it."""
    desk = Desk(tmp_path)
    path = desk.begin(complete=False)
    desk.recorder.sink(lambda _source, _item: None)("front", DeviceEvent(5, LinkState.SILENT, "no reading for 0.1 s"))
    desk.recorder.call(recording.EVENT, 6, "front", 5)
    desk.recorder.call(recording.READING, 8, "front", 7)
    desk.recorder.end()
    report = Replay(Recording.of(path)).run()
    assert report.why_not == ["it began while the daemon was running: its first poses are not in it"]
    assert report.exact is False


def test_a_recording_of_nothing_proves_nothing(tmp_path: Path) -> None:
    """No device said anything: the map is the one it began with, which is no proof that a replay makes the same."""
    from typer.testing import CliRunner

    from service.commands.replay import app

    desk = Desk(tmp_path)
    path = desk.begin(complete=True)
    desk.clock.turn(SECOND)
    desk.recorder.end({"map_sha256": Replay(Recording.of(path)).run().digest})
    report = Replay(Recording.of(path)).run()
    assert report.readings == 0
    assert report.same_map is None
    told = CliRunner().invoke(app, [str(path)])
    assert told.exit_code == 0
    assert "no reading of any device" in told.output
    assert "bit for bit" not in told.output
    desk = Desk(tmp_path / "other")
    path = desk.begin(complete=True)
    desk.recorder.end({"map_sha256": "another"})
    assert Replay(Recording.of(path)).run().same_map is False
