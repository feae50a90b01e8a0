"""Kernels ready before the first reading: loaded from numba's cache, or else compiled by processes beside this one.

After each update compiling takes a minute of processor time. Two processes share it; this one compiles nothing, stays
as small as with a warm cache (a compiler keeps some 250 MB) and can be told to stop meanwhile.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numba.core import event

from drivers.readings import (
    AngleReading,
    ChainReading,
    ContactLine,
    ContactReading,
    ContactState,
    PoseReading,
    RangeReading,
    RangeStatus,
    Reading,
    RingReading,
    ScanReading,
    WheelReading,
)
from service import assemble, assemble_makers
from service.config import Config, from_document
from service.fusion import Fusion, OdometryOnly
from service.outputs import PolarOut, RectOut
from service.payloads import Encoder
from service.sensors import AxleEncoder, Chain, Contacts, Laser, PoseSource, Ring, Sensor, Wheels

_LOG = logging.getLogger(__name__)

_POLL_S = 0.2
_COMPILERS = 2
_FOR_LOGS = ("footprint", "lines", "slam", "grids")
Step = Callable[[], None]
Meanwhile = Callable[[str], None]


class StoppedWhileCompiling(Exception):  # noqa: N818 - no error: somebody asked for it
    """Stopping was asked for before the kernels were ready."""


def warm_up(config: Config, *, stop_asked: Callable[[], bool] = bool, meanwhile: Meanwhile | None = None) -> None:
    """Load or compile every kernel this configuration uses, on maps that are thrown away.

    meanwhile: called every fifth of a second while others compile, with what is going on.
    Raises StoppedWhileCompiling soon after stop_asked() is true.
    """
    _warm(config, _steps(config), stop_asked, meanwhile)


def warm_up_for_logs() -> None:
    """Load or compile what SLAM, grid and lines of a recorded log use, so that a first run is as fast as others."""
    config = Config.model_validate({"lasers": {"front": {"driver": "hokuyo", "port": "/dev/null"}}})
    steps = {name: step for name, step in _steps(config).items() if name in _FOR_LOGS}
    _warm(config, steps, bool, None)
    from mapping.grids.warm_up import warm_up_walls

    warm_up_walls()


def _warm(config: Config, steps: dict[str, Step], stop_asked: Callable[[], bool], meanwhile: Meanwhile | None) -> None:
    is_cold = False
    for count, step in enumerate(steps.values()):
        if is_cold:
            step()
            continue
        try:
            with _nothing_compiled():
                step()
        except _CacheIsCold:
            is_cold = True
            _compile_beside(config, list(steps)[count:], stop_asked, meanwhile)
            step()  # what others could not put into the cache is compiled here after all


def _steps(config: Config) -> dict[str, Step]:
    """What there is to warm up, by name; the small ones first: the first tells whether the cache is cold."""
    found = assemble.sensors(config)
    names = {maker.name for maker in assemble_makers.map_makers(config, found)}
    steps: dict[str, Step] = {"footprint": lambda: _footprint(config), "clearance": _clearance, "scan": _scan}
    if "lines" in names:
        from mapping.lines.warm_up import warm_up as warm_up_lines

        steps["lines"] = warm_up_lines
    if config.rings:
        from mapping.topology.warm_up import warm_up as warm_up_topology

        steps["topology"] = warm_up_topology
    if config.planes.enabled and config.mounts:
        from mapping.planes.warm_up import warm_up as warm_up_planes

        steps["planes"] = warm_up_planes
    if "places" in names:
        from service.place_maker import warm_up as warm_up_places

        steps["places"] = warm_up_places
    if "scenes" in names:
        from mapping.features.warm_up import warm_up as warm_up_features

        steps["features"] = warm_up_features
    if "rooms" in names:
        from service.room_maker import warm_up as warm_up_rooms

        steps["rooms"] = warm_up_rooms
    if config.grid.enabled and config.grid.crisp and any(isinstance(sensor, Laser) for sensor in found.values()):
        from mapping.grids.warm_up import warm_up_live_walls

        steps["walls"] = warm_up_live_walls
    if config.localise.mode == "map":
        from mapping.localise.warm_up import warm_up_in_map

        steps["localise"] = warm_up_in_map
    has_slam = config.localise.mode != "map" and config.slam.enabled
    has_slam = has_slam and any(isinstance(sensor, Laser) for sensor in found.values())
    if has_slam or "calibration" in names or assemble.odometry_laser(config, found) is not None:
        from mapping.localise.warm_up import warm_up as warm_up_slam

        steps["slam"] = warm_up_slam
    if "calibration" in names:
        from mapping.localise.warm_up import warm_up_calibration

        steps["calibration"] = warm_up_calibration
    if has_slam:
        from mapping.grids.warm_up import warm_up as warm_up_grids

        steps["grids"] = warm_up_grids
    steps["fusion"] = lambda: _fusion(config, found)
    return steps


# --- compiling beside this process ------------------------------------------------------------------------------------


class _CacheIsCold(BaseException):
    """A kernel would have to be compiled. No Exception: no part of ours may take it for a failure of its own."""


@contextmanager
def _nothing_compiled() -> Iterator[None]:
    """The first kernel that is not in the cache ends the block with _CacheIsCold, before anything is compiled: what a
    compiler takes it keeps, some 50 MB for the smallest kernel."""

    def refuse(_kernel: str) -> None:
        raise _CacheIsCold

    with _on_compiling(refuse):
        yield


@contextmanager
def _compilations() -> Iterator[list[str]]:
    """Names of the kernels that are to be compiled, not loaded, while the block runs."""
    names: list[str] = []
    with _on_compiling(names.append):
        yield names


@contextmanager
def _on_compiling(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell each kernel that is about to be compiled while the block runs."""

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            tell(str(event.data["dispatcher"]))

        def on_end(self, event: Any) -> None:
            pass

    listener = Listener()
    event.register("numba:compile", listener)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)  # type: ignore[no-untyped-call]


def _compile_beside(
    config: Config, names: list[str], stop_asked: Callable[[], bool], meanwhile: Meanwhile | None
) -> None:
    """Fill the cache by other processes; what they fail to compile is left to the one who needs it."""
    begun_s = time.monotonic()
    _LOG.info("compiling the kernels, as after each update: about a minute on one slow core")
    todo = names[::-1]  # the large ones first
    compilers = [_Compiler(config, todo) for _ in range(min(_COMPILERS, len(names), os.cpu_count() or 1))]
    try:
        while any(each.is_busy() for each in compilers):
            if stop_asked():
                raise StoppedWhileCompiling
            if meanwhile is not None:
                meanwhile(f"compiling the kernels: {len(names) - len(todo)} of {len(names)} parts begun")
            for each in compilers:
                each.wait(_POLL_S / len(compilers))
    finally:
        for each in compilers:
            each.close()
    _LOG.info("kernels compiled in %.0f s", time.monotonic() - begun_s)


class _Compiler:
    """A process that compiles what it is told, and the thread that tells it. todo: shared; taken from the front."""

    def __init__(self, config: Config, todo: list[str]) -> None:
        self._todo = todo
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.warm_up"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,  # a terminal's Ctrl-C reaches us; it ends when its input does
        )
        self._thread = threading.Thread(target=self._tell, args=(config,), name="compile", daemon=True)
        self._thread.start()

    def _tell(self, config: Config) -> None:
        told, answers = self._process.stdin, self._process.stdout
        assert told is not None
        assert answers is not None
        with suppress(OSError, IndexError, ValueError):  # it died or was closed; or nothing is left to do
            print(config.model_dump_json(), file=told, flush=True)
            while True:
                print(self._todo.pop(0), file=told, flush=True)
                if not answers.readline():
                    return

    def is_busy(self) -> bool:
        """Whether there is something left for it."""
        return self._thread.is_alive()

    def wait(self, timeout_s: float) -> None:
        """Until nothing is left for it, or so long."""
        self._thread.join(timeout_s)

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                assert stream is not None
                stream.close()


def _main() -> None:
    """Compile the parts named on standard input, one a line after the configuration; an empty line back for each."""
    steps = _steps(from_document(json.loads(sys.stdin.readline())))
    for line in sys.stdin:
        steps[line.strip()]()
        print(flush=True)


# --- the parts --------------------------------------------------------------------------------------------------------


def _clearance() -> None:
    from mapping.grids.patch import GridPatch
    from service.clearance_maker import ClearanceMaker
    from service.map_makers import MapView, Rect

    cells, maker = np.full((3, 3), -1, dtype=np.int8), ClearanceMaker(reach_m=2.0)
    for seen in (100, 0):
        cells[1, 1] = seen
        maker.make(MapView(0, GridPatch(1.0, 0, 0, cells), (Rect(0, 0, 3, 3),), None))


def _footprint(config: Config) -> None:
    from mapping.sectors.footprint import in_polygon

    in_polygon(np.zeros((1, 2)), np.array(config.robot.footprint_m))


def _scan() -> None:
    from mapping.frames import IDENTITY
    from mapping.scan import Scan, seen_from

    for is_writeable in (False, True):  # bearings that drivers keep, and those of others
        bearing = np.zeros(1)
        bearing.setflags(write=is_writeable)
        seen_from(IDENTITY, Scan(0, 0.0, bearing, np.ones(1), 0.1, 10.0), np.zeros((1, 3)))


def _fusion(config: Config, found: dict[str, Sensor]) -> None:
    fusion = Fusion(assemble.parts(config, found, assemble.maps(config, found), OdometryOnly()))
    encoder = Encoder()
    now_ns = 0
    for step in range(8):  # standing, then moving: the two take different kernels
        now_ns += 100_000_000
        for name, sensor in found.items():
            fusion.on_item(name, _pretended(sensor, step, now_ns), now_ns)
        for name, sensor in found.items():
            if isinstance(sensor, Wheels):
                fusion.on_item(name, WheelReading(now_ns + 50_000_000, 100 * step, -100 * step, True), now_ns)
        for output in fusion.tick(now_ns + 60_000_000):
            if isinstance(output, PolarOut | RectOut):
                assert all(message.payload for message in encoder.encode(output, 0))


def _pretended(sensor: Sensor, step: int, now_ns: int) -> Reading:
    match sensor:
        case Laser():
            bearing = np.linspace(-2.0, 2.0, 64)
            bearing.setflags(write=step >= 4)  # what is compiled for the one does not serve the other
            distance = np.full(64, 2.0)
            distance[:3] = (np.inf, -np.inf, np.nan)
            return ScanReading(now_ns, 100_000.0 * (step % 2), 100_000_000, bearing, distance, 0.05, 10.0)
        case Chain():
            ranges = tuple(RangeReading(each.channel, 1.0, RangeStatus.ECHO) for each in sensor.transducers)
            return ChainReading(now_ns, ranges)
        case Wheels():
            return WheelReading(now_ns, 100 * step, 100 * step, True)
        case AxleEncoder():
            return AngleReading(now_ns, 10 * step, step > 0)
        case Contacts():
            lines = tuple(ContactLine(each.line, ContactState.TRIPPED) for each in sensor.switches)
            return ContactReading(now_ns, lines)
        case PoseSource():
            return PoseReading(now_ns, 0.1 * step, 0.0, 0.0, step > 0)
        case Ring():
            return RingReading(now_ns, np.full(24, 0.5), np.zeros(24, dtype=np.bool_), 0.1 * step, 0.0, step > 0)


if __name__ == "__main__":
    if sys.argv[1:] == ["logs"]:
        warm_up_for_logs()
    else:
        _main()
