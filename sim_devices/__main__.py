"""`python -m sim_devices`: an emulated robot on ptys, in a simulated world or in a recorded log, in real time.

Standard output gets one thing: a configuration with which `umfeld run` meets this robot; it also stands in
DIR/umfeld.toml. All else goes to standard error. SIGINT, SIGTERM and a closed terminal end it cleanly: exit code 0.
Exit code 1: something is wrong with a file or a folder; 2: wrong usage.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import select
import signal
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from drivers.logs import LogError, PoseKind, read_log
from sim_devices.attach import Attachment
from sim_devices.faults import KINDS, FaultPlan, FaultSyntaxError
from sim_devices.floor_plan import WorldError, load_floor_plan, world_names
from sim_devices.laser_hokuyo import LaserProfile
from sim_devices.lasers import MODELS
from sim_devices.log_scene import LogScene, Pace, laser_profile
from sim_devices.presets import PRESETS, PresetError, Robot, Table, emulate, for_log, hurry, preset, to_toml
from sim_devices.robot import CommandedMotion, Motion, SimScene, WheelErrors, follow
from sim_devices.world import World

SECOND_NS = 1_000_000_000
TRUTH_PERIOD_NS = SECOND_NS // 20
WATCH_PERIOD_NS = SECOND_NS // 20
DEFAULT_SLIP_M = 0.0005
HOST_NEEDS_NS = 3 * SECOND_NS  # for bringing up all devices, before the first metre

AnyScene = SimScene | LogScene


class Refused(Exception):  # noqa: N818 - said to a person, as it stands
    """Something outside is not as it must be; the text names it and the repair."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until told to end; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        return _run(options)
    except (Refused, LogError, WorldError, PresetError, FaultSyntaxError, FileExistsError) as error:
        print(f"umfeld sim: {error}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="umfeld sim",
        description="Emulated devices on ptys, with a configuration for `umfeld run` that fits them.",
        epilog="Example: umfeld sim --preset artos --world flat --fault laser:unplug@20s+2s",
    )
    add = parser.add_argument
    first, *others = PRESETS
    add("--preset", default=None, help=f"the robot: {first} (the default), {', '.join(others)}")
    add("--config", type=Path, help="emulate the devices of this configuration instead of a preset's")
    add("--world", default="flat", help=f"floor plan: {', '.join(world_names())}, or a .toml file")
    add("--log", type=Path, help="play this recorded log instead of a world")
    add("--poses", choices=[k.value for k in PoseKind], help="what the log's poses are; default: found out")
    add("--speed", type=_positive, default=1.0, help="times real time, of the robot and the world or log")
    add("--laser", choices=list(MODELS), help="model of the lasers; default: the first of the configured driver")
    add("--fault", action="append", default=[], metavar="SPEC", help=f"what goes wrong; kinds: {', '.join(KINDS)}")
    add("--seed", type=int, default=0, help="of noise, faults, slip and people")
    add("--slip", type=_not_negative, default=DEFAULT_SLIP_M, help="random wheel slip, m after one metre")
    add("--wheel-error", type=float, default=0.0, metavar="SHARE", help="left wheel rolls so much farther than told")
    add("--dir", type=Path, default=None, help="folder of the ptys' links and of umfeld.toml")
    add("--truth", type=Path, help="write the true pose here: JSON lines t, x, y, yaw (t: monotonic seconds)")
    add(
        "--start-after", type=_not_negative, metavar="S", help="drive S seconds after the start, not after a host spoke"
    )
    add("--duration", type=_not_negative, default=0.0, metavar="S", help="end after so many seconds; 0: when told")
    add("--until-end", action="store_true", help="end when the log was played or an open route driven")
    add("--drive", action="store_true", help="drive by lines on standard input: forward m/s, turn rad/s, seconds")
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not 0 or more")
    return value


def _run(options: argparse.Namespace) -> int:
    folder = (options.dir or _default_folder()).absolute()
    plan = FaultPlan(options.fault, seed=options.seed) if options.fault else None
    ending = _ending_signals()
    with _owned(folder), contextlib.ExitStack() as stack:
        attachment = Attachment()
        stack.callback(attachment.stop)
        stage = _stage(options, attachment.now_ns())
        robot = emulate(
            stage.config,
            stage.scene,
            attachment,
            folder,
            laser=options.laser,
            profile=stage.profile,
            exact=stage.exact,
            seed=options.seed,
            plan=plan,
        )
        _refuse_unknown_targets(plan)
        conductor = _Conductor(stage, robot, options, attachment.now_ns())
        attachment.add_station("conductor", conductor)
        if options.truth is not None:
            attachment.add_station("truth", _TruthWriter(stage.scene, _opened(stack, options.truth)))
        if options.drive:
            attachment.add_station("drive", _Driver(stage))
        _publish(robot.config, folder, stage.name)
        attachment.run(lambda: bool(ending) or conductor.is_over)
    return 0


def _default_folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "umfeld-sim" if runtime else Path(f"/tmp/umfeld-sim-{os.getuid()}")


def _ending_signals() -> list[int]:
    """Grows when the process is told to end."""
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup: outlive the terminal
            signal.signal(number, lambda number, _: told.append(number))
    return told


@contextlib.contextmanager
def _owned(folder: Path) -> Iterator[None]:
    """The folder for this process alone, as long as it runs."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise Refused(f"{folder}: cannot be used: {error.strerror}; choose another with --dir") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise Refused(f"another simulation runs in {folder}; end it or give this one a --dir") from None
        yield
        with contextlib.suppress(OSError):
            (folder / "umfeld.toml").unlink()


def _opened(stack: contextlib.ExitStack, path: Path) -> IO[str]:
    try:
        return stack.enter_context(path.open("w", encoding="ascii"))
    except OSError as error:
        raise Refused(f"{path}: cannot be written: {error.strerror}") from error


def _refuse_unknown_targets(plan: FaultPlan | None) -> None:
    complaints = plan.complaints() if plan is not None else []
    if complaints:
        raise Refused("; ".join(complaints))


# --- what is played --------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Stage:
    """Scene, configuration and laser of one play. name: of the world or log, for file names and people."""

    name: str
    scene: AnyScene
    config: Table
    profile: LaserProfile | None = None
    exact: bool = False
    commands: CommandedMotion | None = None
    lap_s: float | None = None  # of a route that ends
    notes: list[str] = field(default_factory=list)


def _stage(options: argparse.Namespace, now_ns: int) -> Stage:
    config = _configuration(options)
    return _log_stage(options, config, now_ns) if options.log else _world_stage(options, config, now_ns)


def _configuration(options: argparse.Namespace) -> Table:
    if options.config is None:
        return preset(options.preset or next(iter(PRESETS)))
    if options.preset is not None:
        raise Refused("--preset and --config exclude each other")
    try:
        return tomllib.loads(options.config.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise Refused(f"{options.config}: cannot be read: {error}") from error


def _world_stage(options: argparse.Namespace, config: Table, now_ns: int) -> Stage:
    plan = load_floor_plan(options.world)
    world = World.from_plan(plan, seed=options.seed)
    motion: Motion
    commands = lap_s = None
    if options.drive or plan.route is None:
        begin = plan.route.points[0] if plan.route is not None else (0.0, 0.0)
        motion = commands = CommandedMotion((begin[0], begin[1], 0.0))
    else:
        motion = route = follow(plan.route)
        lap_s = None if plan.route.closed else route.lap_s
    scene = SimScene(
        world,
        motion,
        track_width_m=float(config.get("drive", {}).get("track_width_m", 0.5)),
        errors=WheelErrors(options.wheel_error, 0.0, options.slip, options.seed),
        origin_ns=now_ns,
        begin_at_origin=False,
        speed=options.speed,
    )
    if options.speed > 1.0 and plan.route is not None:
        hurry(config, options.speed)
    name = plan.name or Path(options.world).stem
    return Stage(name, scene, config, commands=commands, lap_s=lap_s)


def _log_stage(options: argparse.Namespace, config: Table, now_ns: int) -> Stage:
    if options.drive:
        raise Refused("--drive does not go with --log: a log has its own way")
    log = read_log(options.log, poses=PoseKind(options.poses) if options.poses else None)
    pace = Pace(speed=options.speed)
    track_width_m = float(config.get("drive", {}).get("track_width_m", 0.5))
    scene = LogScene(log, pace=pace, track_width_m=track_width_m, origin_ns=now_ns)
    config = for_log(
        config, scene.mount, track_width_m=track_width_m, rate_hz=round(1.0 / pace.sample_s, 3), wheel_m_s=10.0
    )
    stage = Stage(options.log.name.split(".")[0], scene, config, laser_profile(log, sweep_s=pace.sweep_s), exact=True)
    stage.notes.append(
        f"{len(log.scans)} scans of {options.log}, {log.poses.value} poses; the play takes {scene.duration_s:.0f} s"
    )
    if log.stamps_made_up:
        stage.notes.append("the log's stamps are useless; times were made up from the way between scans")
    if log.stamps_repaired:
        stage.notes.append(f"{log.stamps_repaired} stamps out of order were repaired")
    return stage


def _publish(config: Table, folder: Path, name: str) -> None:
    """Print the configuration and put it into the folder, whole or not at all."""
    robot = config.get("robot", {}).get("id", "robot")
    config.setdefault("store", {}).setdefault("path", str(folder / f"{robot}-{name}.umfeld"))
    head = f"# Emulated devices of `umfeld sim` in {folder}; they are there as long as it runs.\n"
    head += f"# umfeld run --config {folder / 'umfeld.toml'}\n\n"
    text = head + to_toml(config)
    fresh = folder / ".umfeld.toml.new"
    fresh.write_text(text, encoding="utf-8")
    fresh.replace(folder / "umfeld.toml")
    with contextlib.suppress(BrokenPipeError):
        print(text, end="", flush=True)


# --- stations of the loop ---------------------------------------------------------------------------------------------


class _Conductor:
    """Lets the robot drive once somebody listens, and ends the run when it is over."""

    def __init__(self, stage: Stage, robot: Robot, options: argparse.Namespace, now_ns: int) -> None:
        self._stage = stage
        self._robot = robot
        self._start_ns = None if options.start_after is None else now_ns + round(options.start_after * SECOND_NS)
        self._end_ns = now_ns + round(options.duration * SECOND_NS) if options.duration else None
        self._until_end = options.until_end
        self._said_end = False
        self.is_over = False
        for note in stage.notes:
            self._say(note)

    def files(self) -> list[int]:
        return []

    def plug(self, connected: bool, member: str = "") -> None:
        """It has no wire."""

    def close(self) -> None:
        """It holds nothing."""

    def service(self, now_ns: int) -> int | None:
        if self._start_ns is None and self._robot.was_spoken_to():
            self._start_ns = now_ns + HOST_NEEDS_NS
            self._say(f"a host is there; off in {HOST_NEEDS_NS / SECOND_NS:.0f} s")
        if self._start_ns is not None and now_ns >= self._start_ns:
            self._stage.scene.begin_motion(now_ns)
        if self._has_ended(now_ns) and not self._said_end:
            self._said_end = True
            self._say("played to the end")
            self.is_over = self.is_over or self._until_end
        if self._end_ns is not None and now_ns >= self._end_ns:
            self.is_over = True
        return now_ns + WATCH_PERIOD_NS

    def _has_ended(self, now_ns: int) -> bool:
        scene = self._stage.scene
        if isinstance(scene, LogScene):
            return scene.has_ended(now_ns)
        lap_s = self._stage.lap_s
        return lap_s is not None and float(scene.motion_s(np.array([float(now_ns)]))[0]) >= lap_s

    @staticmethod
    def _say(text: str) -> None:
        print(f"umfeld sim: {text}", file=sys.stderr, flush=True)


class _TruthWriter:
    """Writes the true pose, twenty times a second."""

    def __init__(self, scene: AnyScene, file: IO[str]) -> None:
        self._scene = scene
        self._file = file
        self._next_ns = 0

    def files(self) -> list[int]:
        return []

    def plug(self, connected: bool, member: str = "") -> None:
        """It has no wire."""

    def close(self) -> None:
        """The file is closed by who opened it."""

    def service(self, now_ns: int) -> int | None:
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + TRUTH_PERIOD_NS
            x, y, yaw = (float(v) for v in self._scene.pose_at(np.array([float(now_ns)]))[0])
            row: dict[str, Any] = {"t": now_ns * 1e-9, "x": x, "y": y, "yaw": yaw}
            self._file.write(json.dumps({k: round(v, 6) for k, v in row.items()}) + "\n")
            self._file.flush()
        return self._next_ns


class _Driver:
    """Drive commands from standard input: lines of forward m/s, turn rad/s, and seconds (1 if not given)."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._buffer = b""
        self._open = True

    def files(self) -> list[int]:
        return [sys.stdin.fileno()] if self._open else []

    def plug(self, connected: bool, member: str = "") -> None:
        """It has no wire that can be pulled."""

    def close(self) -> None:
        """Standard input is not ours to close."""

    def service(self, now_ns: int) -> int | None:
        if self._open and _is_readable(sys.stdin.fileno()):
            data = os.read(sys.stdin.fileno(), 4096)
            self._open = bool(data)
            *lines, self._buffer = (self._buffer + data).split(b"\n")
            for line in lines:
                self._obey(line.decode("utf-8", errors="replace"), now_ns)
        return None

    def _obey(self, line: str, now_ns: int) -> None:
        try:
            forward, turn, *rest = (float(v) for v in line.split())
            hold_s = rest[0] if rest else 1.0
            if not all(np.isfinite((forward, turn, hold_s))) or hold_s <= 0.0 or len(rest) > 1:
                raise ValueError
        except ValueError:
            print(f"umfeld sim: {line!r} is no command; write for example: 0.5 0.2 2", file=sys.stderr)
            return
        scene, commands = self._stage.scene, self._stage.commands
        if isinstance(scene, SimScene) and commands is not None:
            scene.begin_motion(now_ns)
            commands.command(float(scene.motion_s(np.array([float(now_ns)]))[0]), forward, turn, hold_s=hold_s)


def _is_readable(file: int) -> bool:
    return bool(select.select([file], [], [], 0.0)[0])


if __name__ == "__main__":
    sys.exit(main())
