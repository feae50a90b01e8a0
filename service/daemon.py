"""The daemon: which threads there are, in which order they start and stop, and that the process always ends.

    wires (one thread each) --> fusion thread --> publisher's threads        keeper thread --> store
                        |            \\--> maps thread --^
                        +--> background threads: closing loops, drawing anew after a correction
    main thread: waits for a signal

Start: the map's file, the kernels (warm before a port is opened, or the first scans would wait for them), the router,
fusion, the keeper, the wires. Whatever cannot be had ends the start with one line and gives everything back. A device
that is absent does not: the daemon waits for it and says so. Stop: the wires (devices are left safe), fusion, the last
snapshot, the router. If that takes longer than EXIT_DEADLINE_S the process ends anyway.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import hashlib
import logging
import math
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from drivers.reader import WireReader
from mapping.frames import IDENTITY, Pose2
from service import assemble, assemble_makers, assemble_wires, health, recording
from service.background import Background
from service.clock import Clock, SystemClock
from service.config import Config, Loaded
from service.errors import Trouble
from service.live_map import GRID, SLAM, LiveMap, restore, told_of
from service.loaded_kernels import keep_loaded_kernels_packed
from service.locks import Claims
from service.maker_calls import maker_calls
from service.map_makers import MapMakers, SweepTap
from service.outputs import HealthOut, OdomOut, Output, PolarOut, PoseOut, RangesOut, RectOut, ScanOut
from service.payloads import RobotInfo, SensorPlace
from service.publisher import Publisher
from service.recording import RecordedFusion, Recorder
from service.resident import give_back_code, give_back_heap, keep_heap_small
from service.ros import RosSettings
from service.rpc import CallRefused
from service.sensors import Chain, Laser
from service.store import MapStore, Provenance
from service.systemd import Notifier
from service.tls import TlsFiles
from service.warm_up import StoppedWhileCompiling, warm_up
from service.worker import Worker
from service.zenoh_session import NetworkSettings

if TYPE_CHECKING:
    from mapping.grids.occupancy import OccupancyGrid
    from service.layers import BuildingLayer
    from service.mavlink_out import MavlinkOut

log = logging.getLogger(__name__)

EXIT_DEADLINE_S = 8.0  # systemd would kill after 10
_WIRE_STOP_S = 1.5
_FUSION_STOP_S = 2.0
_MAKERS_STOP_S = 4.0  # a turn of theirs may be rooms of a large map, and the computer slow
_BACKGROUND_STOP_S = 0.5
_PUBLISHER_STOP_S = 2.0
_MAVLINK_STOP_S = 1.0
_GIVE_BACK_AT_S = (1, 6, 60)  # makers of maps load theirs with the first sweeps, a closure with the first lap
_TRIM_EVERY_S = 20  # maps that grew and were drawn anew leave holes in the heap
_GIL_SWITCH_S = 0.0002  # a scan takes the lock some six times; by default each may wait 5 ms for the one that computes


class Daemon:
    """One robot's daemon. run() does everything; start() and stop() are for tests."""

    def __init__(self, loaded: Loaded, *, clock: Clock | None = None, notifier: Notifier | None = None) -> None:
        self._config = loaded.config
        self._clock = clock or SystemClock()
        self._notifier = notifier or Notifier()
        self._sensors = assemble.sensors(self._config)
        self._parts = contextlib.ExitStack()
        self._readers: list[WireReader[Any]] = []
        self._clean = True
        self._meter = health.ProcessMeter(self._clock.now_ns())
        self._mavlink: MavlinkOut | None = None
        self._stop_asked: Callable[[], bool] = bool
        self._recorder = Recorder(recording_settings(self._config), clock=self._clock)

    # --- the life of the process

    def run(self, *, seconds: float = 0.0) -> int:
        """Start, wait until told to stop, stop; returns the exit code. Trouble if it cannot start.

        seconds: end by itself so long after it was ready; 0: when told.
        """
        faulthandler.enable(file=sys.__stderr__ or sys.stderr)
        keep_heap_small()
        keep_loaded_kernels_packed()
        with _StopSignals() as asked:
            self._stop_asked = asked
            try:
                self.start()
            except StoppedWhileCompiling:
                log.info("stopped before the kernels were ready")
                return 0
            gc.collect()
            gc.freeze()  # modules and kernels stay: looking through them again would hold every thread for 50 ms
            give_back_heap()  # what loading the kernels left
            try:
                self._notifier.ready(self._summary())
                log.info("%s", self._summary())
                end_ns = self._clock.now_ns() + round(seconds * 1e9)
                turns = 0
                while not asked.wait(1.0) and not (seconds and self._clock.now_ns() >= end_ns):
                    self._notifier.status(self._summary())
                    turns += 1
                    if turns in _GIVE_BACK_AT_S:
                        log.debug("%.0f MB that only starting needed given back", give_back_code() / 1e6)
                    if turns % _TRIM_EVERY_S == 0:
                        give_back_heap()
            finally:
                log.info("stopping: closing ports, saving the map")
                self._notifier.stopping("closing ports and saving the map")
                clean = self.stop()
        log.info("stopped")
        return 0 if clean else 1

    def start(self) -> None:
        """Bring everything up, or nothing: Trouble says why, with what had been started stopped again."""
        try:
            self._start_parts()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> bool:
        """Take everything down in the reverse order, or end the process after EXIT_DEADLINE_S.

        False if something did not stop in time.
        """
        self._clean = True
        with _exit_deadline(EXIT_DEADLINE_S):
            self._parts.close()
        return self._clean

    def _start_parts(self) -> None:
        sys.setswitchinterval(_GIL_SWITCH_S)
        config, wires = self._config, assemble_wires.wires(self._config)
        claims = self._parts.enter_context(Claims())
        claims.claim_ports(wire.port for wire in wires if wire.port is not None)
        store = self._open_store()
        maps = assemble.maps(config, self._sensors)
        start_pose = None if store is None or maps.building is None else restore(maps.building.grid, store)
        is_new = store is not None and not store.layers().get(GRID)
        if start_pose is not None and store is not None and maps.building is not None and not is_new:
            self._tell_where_it_goes_on(store, maps.building.grid, start_pose)
        self._publisher = self._make_publisher()
        self._parts.callback(self._close_publisher)
        self._publisher.add_tap(self._recorder.message)
        starting = _Beside("router", partial(self._publisher.start, announce=False))  # half a second, as the kernels
        try:
            warm_up(
                config,
                stop_asked=lambda: self._stop_asked() or starting.has_failed(),
                meanwhile=self._notifier.still_starting,
            )
        finally:
            starting()  # what hindered it is told before a minute of compiling has passed
        if is_new and store is not None:
            log.info("a new map begins: %s", store.path)
        makers = assemble_makers.map_makers(config, self._sensors)
        walls = assemble_makers.wall_maker(config, self._sensors, maps.building)
        makers += [] if walls is None else [walls]
        self._makers = MapMakers(makers, self._publisher.offer, now_ns=self._clock.now_ns)
        self._ground = assemble_makers.sector_ground(config, makers)
        if store is not None:
            self._makers.restore(store.load_tiles)
        background = Background()
        self._parts.callback(self._stop_background, background)
        self._stored_slam = () if store is None else tuple(store.load_tiles(SLAM))
        localiser = assemble.localiser(
            config,
            self._sensors,
            maps,
            start_pose or IDENTITY,
            background.submit,
            self._makers.redraw,
            self._stored_slam,
        )
        parts = assemble.parts(config, self._sensors, maps, localiser)
        if sources := self._makers.sources:
            parts = replace(parts, grids=(*parts.grids, SweepTap(self._makers, sources)))
        self._fusion = RecordedFusion(parts)
        self._building = maps.building
        self._fusion.recorder = self._recorder
        self._worker = Worker(
            self._fusion,
            self._offer,
            now_ns=self._clock.now_ns,
            beat=self._notifier.beat,
            health=self._health,
            offered=self._publisher.flush,
            odometry_is_read=self._publisher.odometry_is_read,
        )
        self._live_map = None
        if maps.building is not None:
            self._live_map = LiveMap(
                maps.building, store, ask=self._worker.ask, fusion=self._fusion, makers=self._makers,
                anchor=None if config.store.anchor is None else config.store.anchor.model_dump(),
                settle_walls=(lambda: None) if walls is None else walls.settle,
            )  # fmt: skip
            self._publisher.calls.register_map_service(self._live_map)
            self._parts.callback(self._finish_map, self._live_map)
        sink = self._recorder.sink(self._worker.sink)
        self._readers = [wire.reader(sink, self._clock.now_ns, self._recorder.tap(wire.name)) for wire in wires]
        by_name = {reader.name: reader for reader in self._readers}
        self._mavlink = assemble.mavlink_out(config, self._sensors, by_name, self._clock.now_ns)
        if config.localise.mode == "map":
            from service.map_localiser import KnownMapLocaliser, relocalise

            assert isinstance(localiser, KnownMapLocaliser)
            self._publisher.calls.register("relocalise", partial(relocalise, localiser, self._worker.ask))
        closure_calls = assemble.closure_calls(localiser, self._worker.ask)
        for name, answer in (*closure_calls, *maker_calls(makers, self._makers, self._publisher.offer)):
            self._publisher.calls.register(name, answer)
        self._publisher.calls.register("record_start", self._on_record_start)
        self._publisher.calls.register("record_stop", lambda _arguments: self._end_recording())
        self._publisher.calls.register("record_status", lambda _arguments: self._recorder.status())
        self._parts.callback(self._end_recording)
        if config.recording.enabled:
            self._begin_recording(start_pose or IDENTITY, complete=True)
        self._stored_slam = ()  # a recording from the first byte needed it
        self._publisher.publish_info(robot_info(config, self._wall_ns()))
        self._publisher.announce()
        self._parts.callback(self._stop_makers)
        self._makers.start()
        self._worker.start()
        self._parts.callback(self._stop_worker)
        if self._mavlink is not None:
            self._parts.callback(self._mavlink.stop, _MAVLINK_STOP_S)
            self._mavlink.start()
        if self._live_map is not None and store is not None:
            keeper = _Keeper(self._live_map, config.store.snapshot_period_s)
            self._parts.callback(keeper.stop)
            keeper.start()
        self._parts.callback(self._stop_readers)
        for reader in self._readers:
            reader.start()

    # --- parts

    def _open_store(self) -> MapStore | None:
        if not self._config.store.enabled or not self._config.grid.enabled or self._config.localise.mode == "map":
            return None
        path = self._config.store_path()
        store = self._parts.enter_context(MapStore.open(path, wall_ns=self._wall_ns))
        if store.restored:
            log.error("%s", store.restored)
        digest = hashlib.sha256(self._config.model_dump_json().encode()).hexdigest()
        devices = {name: type(sensor).__name__.lower() for name, sensor in self._sensors.items()}
        store.add_provenance(Provenance(self._wall_ns(), _version(), digest, devices))
        return store

    def _tell_where_it_goes_on(self, store: MapStore, grid: OccupancyGrid, pose: Pose2) -> None:
        log.warning(
            "the map goes on where it was left (%s), with the robot at x %.2f m y %.2f m yaw %.0f deg: %s",
            told_of(store, grid, self._wall_ns()), pose.x_m, pose.y_m, math.degrees(pose.yaw_rad),
            "it is looked for there, then everywhere, before anything is drawn"
            if self._config.slam.enabled and store.layers().get(SLAM)
            else "if it was moved since, begin a new map (`umfeld map new`) or load one",
        )  # fmt: skip

    def _make_publisher(self) -> Publisher:
        config = self._config
        ros = RosSettings(
            distro=config.ros.distro,
            domain_id=config.ros.domain_id,
            lasers=tuple(s.name for s in self._sensors.values() if isinstance(s, Laser) and not s.tilts),
        )
        return Publisher(
            f"robots/{config.robot.id}",
            network_settings(config),
            clock=self._clock,
            ros=ros if config.ros.enabled else None,
        )

    def _health(self, now_ns: int) -> HealthOut:
        inside = health.Inside(
            drops=self._fusion.drops,
            counters={
                **self._worker.counters(),
                **self._fusion.counters(),
                **{f"publish.{name}": count for name, count in self._publisher.counters().items()},
                **({} if self._live_map is None else self._live_map.counters()),
                **self._recorder.counters(),
                **self._makers.counters(),
                **({} if self._mavlink is None else self._mavlink.counters()),
            },
            troubles=[*self._fusion.troubles(now_ns), *self._map_troubles(), *self._other_troubles(now_ns)],
        )
        kinds = {name: sensor.kind for name, sensor in self._sensors.items()}
        wires = [reader.health() for reader in self._readers]
        return health.report(wires, kinds, inside, self._meter.measure(now_ns), now_ns)

    def _map_troubles(self) -> list[str]:
        trouble = None if self._live_map is None else self._live_map.trouble()
        return [] if trouble is None else [trouble]

    # --- recording

    def _on_record_start(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Begin a recording on request; every device is set up anew, so that its set-up is in it."""
        published = arguments.get("published")
        if not isinstance(published, bool | None):
            raise CallRefused('"published" must be true or false')
        pose = self._worker.ask(lambda: self._fusion.pose()) or IDENTITY
        path = self._begin_recording(pose, complete=False, published=published)
        for reader in self._readers:
            reader.start_anew()
        return {"file": str(path)}

    def _begin_recording(self, map_from_odom: Pose2, *, complete: bool, published: bool | None = None) -> Path:
        building = self._building
        tiles = () if building is None else tuple(self._worker.ask(lambda: list(building.grid.tiles())))
        start = recording.Start(
            self._config.robot.id,
            _version(),
            self._config.model_dump_json(),
            tuple(self._sensors),
            (map_from_odom.x_m, map_from_odom.y_m, map_from_odom.yaw_rad),
            complete,
            tiles,
            self._stored_slam if complete else (),
        )
        path = self._recorder.begin(start, published=published)
        log.info("recording to %s", path)
        return path

    def _end_recording(self) -> Mapping[str, Any]:
        """Close the recording, if there is one, with a digest of the map as it stands."""
        if not self._recorder.is_active:
            return {"recording": False}
        building, end = self._building, {}
        if building is not None:
            end = self._worker.ask(partial(self._digest, building))
        done = self._recorder.end(end) or {"recording": False}
        log.info("recorded: %s", ", ".join(done.get("files", ())))
        return done

    def _digest(self, building: BuildingLayer) -> dict[str, str]:
        self._fusion.drain()
        return {"map_sha256": recording.digest_of(building.grid)}

    def _other_troubles(self, now_ns: int) -> list[str]:
        mavlink = None if self._mavlink is None else self._mavlink.trouble()
        troubles = (*self._publisher.troubles(now_ns), self._recorder.trouble(), mavlink)
        return [trouble for trouble in troubles if trouble is not None]

    def _offer(self, output: Output) -> None:
        if self._ground is not None:
            output = self._ground.with_ground(output)
        if isinstance(output, PolarOut | RectOut):
            self._publisher.send(output)
        elif isinstance(output, ScanOut | OdomOut | PoseOut | RangesOut):
            self._publisher.defer(output)
        else:
            self._publisher.offer(output, wake=False)
        self._makers.take_output(output)
        if self._mavlink is not None:
            self._mavlink.offer(output)

    def _summary(self) -> str:
        config = self._config
        where = f"robots/{config.robot.id} on {', '.join(config.network.listen)}"
        if not self._sensors:
            return f"{where}: no device is configured; add [lasers.NAME], [sonars.NAME] or [wheels.NAME]"
        return f"{where}: {len(self._sensors)} devices on {len(self._readers)} wires"

    def _wall_ns(self) -> int:
        return self._clock.wall_from_monotonic_ns(self._clock.now_ns())

    # --- the way down

    def _stop_readers(self) -> None:
        """All at once: a wire that hangs must not keep the others' lasers on."""

        def stop(reader: WireReader[Any]) -> None:
            self._note(f"wire {reader.name}", reader.stop(_WIRE_STOP_S))

        for wait in [_Beside(f"stop {reader.name}", partial(stop, reader)) for reader in self._readers]:
            wait()

    def _stop_worker(self) -> None:
        self._note("fusion", self._worker.stop(_FUSION_STOP_S))

    def _stop_makers(self) -> None:
        self._note("the making of maps", self._makers.stop(_MAKERS_STOP_S))

    def _stop_background(self, background: Background) -> None:
        background.stop(_BACKGROUND_STOP_S)  # what it works out nobody takes any more: it may end in the midst of it

    def _finish_map(self, live_map: LiveMap) -> None:
        try:
            live_map.finish()
        except Trouble as trouble:
            log.error("the last snapshot was not written: %s", trouble)
            self._clean = False

    def _close_publisher(self) -> None:
        self._note("publishing", self._publisher.close(_PUBLISHER_STOP_S))

    def _note(self, what: str, in_time: bool) -> None:
        if not in_time:
            log.error("%s did not end within its time and is left behind: the exit code is 1", what)
        self._clean = self._clean and in_time


class _Keeper:
    """The thread that writes snapshots."""

    def __init__(self, live_map: LiveMap, period_s: float) -> None:
        self._live_map = live_map
        self._period_s = period_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join(_FUSION_STOP_S)

    def _run(self) -> None:
        told: str | None = None
        while not self._stopping.wait(self._period_s):
            try:
                self._live_map.snapshot()
            except Exception:  # the map in memory is what counts; the disk is tried again
                log.exception("internal error while saving the map; it is tried again")
                continue
            trouble = self._live_map.trouble()
            if trouble is not None and trouble != told:
                log.error("%s", trouble)
            told = trouble


def network_settings(config: Config) -> NetworkSettings:
    """What the router needs of the configuration."""
    network = config.network
    tls = network.tls
    return NetworkSettings(
        listen=network.listen,
        connect=network.connect,
        tls=None
        if tls is None
        else TlsFiles(tls.root_ca_certificate, tls.listen_certificate, tls.listen_private_key, tls.mutual),
        zenoh_config=None if network.config is None else Path(network.config).expanduser(),
    )


def robot_info(config: Config, started_ns: int) -> RobotInfo:
    """What the `info` document says of a configuration. started_ns: wall clock."""
    places: list[SensorPlace] = []
    for sensor in assemble.sensors(config).values():
        if isinstance(sensor, Laser) and not sensor.tilts:
            places.append(SensorPlace(sensor.name, sensor.kind, sensor.base_from_sensor, sensor.height_m))
        elif isinstance(sensor, Chain):
            places.extend(
                SensorPlace(f"{sensor.name}_{number}", sensor.kind, each.base_from_transducer, each.height_m)
                for number, each in enumerate(sensor.transducers, start=1)
            )
    base = f"robots/{config.robot.id}"
    return RobotInfo(config.robot.id, base, _version(), started_ns, tuple(places), config.robot.footprint_m)


def recording_settings(config: Config) -> recording.Settings:
    """Where recordings go and how large they get."""
    wanted = config.recording
    return recording.Settings(
        folder=config.recording_folder(),
        file_bytes=round(wanted.file_mb * 1e6),
        total_bytes=round(wanted.total_mb * 1e6),
        free_bytes=round(wanted.free_mb * 1e6),
        published=wanted.published,
    )


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("umfeld")
    except PackageNotFoundError:
        return "unknown"


class _Beside:
    """Something that runs beside us from now on; calling it waits for the end and raises what was raised."""

    def __init__(self, name: str, work: Callable[[], object]) -> None:
        self._work = work
        self._failed: list[BaseException] = []
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:  # handed to whoever waits
            self._failed.append(error)

    def has_failed(self) -> bool:
        """Whether it ended by an exception."""
        return bool(self._failed)

    def __call__(self) -> None:
        self._thread.join()
        if self._failed:
            raise self._failed[0]


class _StopSignals:
    """SIGINT, SIGTERM and a closed terminal ask to stop; a second SIGINT or SIGTERM ends the process at once.

    A context manager. Under nohup a daemon outlives its terminal; of a closed one it may be told twice. The handler
    only counts: anything with a lock in it could meet itself. A pipe, written by the interpreter's own handler in
    whichever thread the signal arrives, wakes the main thread.
    """

    def __init__(self) -> None:
        self._count = 0

    def __enter__(self) -> _StopSignals:
        self._reading, self._writing = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        heeded = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            heeded.append(signal.SIGHUP)
        self._before = {number: signal.signal(number, self._handle) for number in heeded}
        self._wakeup_before = signal.set_wakeup_fd(self._writing, warn_on_full_buffer=False)
        return self

    def __exit__(self, *_error: object) -> None:
        signal.set_wakeup_fd(self._wakeup_before)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._reading)
        os.close(self._writing)

    def __call__(self) -> bool:
        """Whether stopping was asked for."""
        return self._count > 0

    def wait(self, timeout_s: float) -> bool:
        """Whether stopping was asked for, waiting for it."""
        if self._count == 0:
            select.select([self._reading], [], [], timeout_s)
        return self._count > 0

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        self._count += 1
        if self._count > 1 and number != signal.SIGHUP:
            os._exit(128 + number)


@contextlib.contextmanager
def _exit_deadline(seconds: float) -> Iterator[None]:
    """End the process, saying where it hangs, if the body takes longer."""

    def end() -> None:
        print(f"umfeld: not stopped within {seconds:.0f} s, ending now; the threads were at:", file=sys.stderr)
        faulthandler.dump_traceback(file=sys.__stderr__ or sys.stderr)
        os._exit(1)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
