"""Ours beside every other SLAM program that installs from Debian or PyPI, one after the other in one run.

    UMFELD_DATA=folder .venv/bin/python -m bench.slam_peers [--python PYTHON] [--logs LOG ...] [--only NAME ...]

From Debian: mrpt-apps (icp-slam, rbpf-slam, graphslam-engine); libmrpt-dev and g++ write the logs in its form. From
PyPI: yag-slam (with opencv-python-headless), kiss-icp, kiss-slam, retro-slam, genz-icp; PYTHON is the interpreter that
has them (its own environment: they pin other versions than this project). What is missing is named and left out.

Each is a process of its own. Core seconds are its user and system time over all threads, from its start to its end
with the path written; memory is its largest resident set. Converting the log is not counted. Ours is the whole command
`umfeld map build`, which also draws and stores the map, compiled before. Whatever takes more than 400 core seconds is
stopped. Paths are what the programs wrote, judged by `service.evaluate`; none is told the relations.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version as version_of
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.slam import LOGS
from bench.slam_peers_child import carried, moved
from drivers.logs import Log, read_log
from service.evaluate import Trajectory, read_relations, read_trajectory, relation_error

F64 = NDArray[np.float64]
Sections = dict[str, dict[str, object]]

LIMIT_S = 400
CHILD = Path(__file__).with_name("slam_peers_child.py")
MRPT_PARTS = (
    *("obs", "maps", "poses", "math", "core", "io", "serialization", "system", "bayes", "config", "rtti", "typemeta"),
    *("containers", "img", "opengl", "tfest", "random", "graphs", "expr"),
)
MRPT_LIBRARIES = ("obs", "poses", "math", "io", "serialization", "system", "rtti", "core", "img")

# A process's largest resident set never falls below that of the process it was forked from: fork from a small one.
MEASURE = """
import json, os, resource, sys, time
began = time.monotonic()
child = os.fork()
if child == 0:
    resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[1]), int(sys.argv[1])))
    out = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0); os.dup2(out, 1); os.dup2(out, 2)
    os.execvp(sys.argv[2], sys.argv[2:])
_, status, used = os.wait4(child, 0)
print(json.dumps({"core_s": used.ru_utime + used.ru_stime, "wall_s": time.monotonic() - began,
                  "mib": used.ru_maxrss / 1024.0, "exit": os.waitstatus_to_exitcode(status)}))
"""

# Settings of MRPT's own example for icp-slam (icp-slam_demo_classic.ini), pictures off.
ICP_SLAM: Sections = {
    "ICP": {
        "maxIterations": 80,
        "minAbsStep_trans": 1e-6,
        "minAbsStep_rot": 1e-6,
        "thresholdDist": 0.3,
        "thresholdAng_DEG": 5,
        "ALFA": 0.8,
        "smallestThresholdDist": 0.05,
        "onlyClosestCorrespondences": "true",
        "onlyUniqueRobust": "true",
        "ICP_algorithm": "icpClassic",
        "corresponding_points_decimation": 5,
    },
    "MappingApplication": {
        "rawlog_offset": 0,
        "logOutput_dir": "icp-slam",
        "LOG_FREQUENCY": 0,
        "SAVE_3D_SCENE": 0,
        "SAVE_POSE_LOG": 0,
        "SHOW_PROGRESS_3D_REAL_TIME": 0,
        "CAMERA_3DSCENE_FOLLOWS_ROBOT": 0,
        "localizationLinDistance": 0.2,
        "localizationAngDistance": 5,
        "insertionLinDistance": 1.2,
        "insertionAngDistance": 45.0,
        "minICPgoodnessToAccept": 0.40,
        "matchAgainstTheGrid": 0,
        "occupancyGrid_count": 0,
        "gasGrid_count": 0,
        "beaconMap_count": 0,
        "pointsMap_count": 1,
        "likelihoodMapSelection": -1,
    },
    "MappingApplication_pointsMap_00_insertOpts": {
        "minDistBetweenLaserPoints": 0.05,
        "fuseWithExisting": "false",
        "isPlanarMap": 1,
    },
}

# Those of MRPT's example for rbpf-slam on Intel (gridmapping_RBPF_ICPbased_intel.ini): 10 particles, proposals by ICP.
RBPF_SLAM: Sections = {
    "MappingApplication": {
        "rawlog_offset": 0,
        "logOutput_dir": "rbpf-slam",
        "LOG_FREQUENCY": 0,
        "SAVE_MAP_IMAGES": 0,
        "SAVE_3D_SCENE": 0,
        "SAVE_POSE_LOG": 0,
        "CAMERA_3DSCENE_FOLLOWS_ROBOT": 0,
        "SHOW_PROGRESS_IN_WINDOW": 0,
        "insertionLinDistance": 2.0,
        "insertionAngDistance_deg": 30.0,
        "localizeLinDistance": 0.2,
        "localizeAngDistance_deg": 10.0,
        "verbosity_level": "ERROR",
        "PF_algorithm": 2,
        "adaptiveSampleSize": 0,
        "resamplingMethod": 0,
        "sampleSize": 10,
        "BETA": 0.5,
        "occupancyGrid_count": 0,
        "gasGrid_count": 0,
        "beaconMap_count": 0,
        "pointsMap_count": 1,
        "likelihoodMapSelection": -1,
        "pfAuxFilterOptimal_MaximumSearchSamples": 250,
        "pfOptimalProposal_mapSelection": 3,
        "ICPGlobalAlign_MinQuality": 0.8,
        "KLD_maxSampleSize": 150,
        "KLD_minSampleSize": 15,
        "KLD_binSize_XY": 0.03,
        "KLD_binSize_PHI_deg": 1,
        "KLD_delta": 0.001,
        "KLD_epsilon": 0.5,
        "ICP_algorithm": 1,
        "maxIterations": 60,
        "thresholdDist": 1.0,
        "thresholdAng_DEG": 5,
        "ALFA": 0.5,
        "smallestThresholdDist": 0.1,
        "onlyClosestCorrespondences": 1,
    },
    "MappingApplication_pointsMap_00_insertOpts": {
        "minDistBetweenLaserPoints": 0.05,
        "fuseWithExisting": 0,
        "isPlanarMap": 1,
    },
    "MappingApplication_pointsMap_00_likelihoodOpts": {"max_corr_distance": 5.0, "sigma_dist": 0.05},
}

# Those of MRPT's example for graphslam-engine with odometry and laser (odometry_2DRangeScans.ini).
GRAPH_M, GRAPH_DEG = 0.2, 30.0
GRAPH_SLAM: Sections = {
    "GeneralConfiguration": {
        "output_dir_fname": "graphslam-engine",
        "user_decides_about_output_dir": "false",
        "save_3DScene": "false",
        "save_3DScene_fname": "scene.3DScene",
        "save_graph": "true",
        "save_graph_fname": "graph.txt",
        "class_verbosity": 3,
        "LC_min_nodeid_diff": 50,
    },
    "NodeRegistrationDeciderParameters": {
        "registration_max_distance": GRAPH_M,
        "registration_max_angle": GRAPH_DEG,
        "class_verbosity": 3,
    },
    "EdgeRegistrationDeciderParameters": {
        "ICP_goodness_thresh": 0.73,
        "ICP_max_distance": 2,
        "LC_min_nodeid_diff": 30,
        "use_mahal_distance": 0,
        "class_verbosity": 3,
    },
    "OptimizerParameters": {
        "optimization_on_second_thread": "false",
        "optimization_distance": 1.5,
        "verbose": "false",
        "profiler": "false",
        "max_iterations": 100,
        "scale_hessian": 0.2,
        "tau": 1e-3,
        "class_verbosity": 3,
    },
    "VisualizationParameters": {"visualize_map": "false"},
    "ICP": {
        "maxIterations": 100,
        "minAbsStep_trans": 1e-6,
        "minAbsStep_rot": 1e-6,
        "thresholdDist": 0.3,
        "thresholdAng_DEG": 5,
        "ALFA": 0.8,
        "smallestThresholdDist": 0.05,
        "onlyClosestCorrespondences": "false",
        "doRANSAC": "true",
        "ICP_algorithm": "icpLevenbergMarquardt",
        "corresponding_points_decimation": 5,
    },
}
MRPT_SETTINGS: dict[str, dict[str, dict[str, object]]] = {
    "icp-slam": ICP_SLAM,
    "rbpf-slam": RBPF_SLAM,
    "graphslam-engine": GRAPH_SLAM,
}


class MissingError(Exception):
    """A program cannot take part; the text says why."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A log, and a folder where programs find it in their form and leave what they make of it.

    odometry: (N, 3) of the scans, the first at the origin.
    """

    log: Log
    relations: Path
    folder: Path
    odometry: F64 = field(repr=False)

    @staticmethod
    def read(name: str, data: Path, folder: Path) -> Recording:
        folder.mkdir()
        log = read_log(data / f"{LOGS[name]}.clf.gz")
        return Recording(
            log, data / f"{LOGS[name]}.relations.gz", folder, from_first([s.robot_pose for s in log.scans])
        )

    def trajectory(self, poses: F64) -> Trajectory:
        """Poses of the first scans, as the evaluator takes them."""
        scans = self.log.scans[: len(poses)]
        return Trajectory(tuple(s.stamp_text for s in scans), np.array([s.stamp_s for s in scans]), poses)


@dataclass(frozen=True, slots=True)
class Program:
    """One that takes part. command: its words for a recording; path: what it wrote. Both may raise MissingError."""

    name: str
    version: Callable[[], str]
    command: Callable[[Recording], Sequence[str]]
    path: Callable[[Recording], Trajectory]


def programs(python: str) -> list[Program]:
    """Ours first."""
    return [
        Program("umfeld map build", lambda: version_of("umfeld"), our_command, our_path),
        Program("MRPT icp-slam", mrpt_version, partial(mrpt_command, "icp-slam"), icp_path),
        Program("MRPT rbpf-slam", mrpt_version, partial(mrpt_command, "rbpf-slam"), rbpf_path),
        Program("MRPT graphslam-engine", mrpt_version, partial(mrpt_command, "graphslam-engine"), graph_path),
        *(
            Program(name, partial(pypi_version, python, name), partial(pypi_command, python, name), pypi_path(name))
            for name in ("yag-slam", "kiss-icp", "kiss-slam", "retro-slam", "genz-icp")
        ),
    ]


# --- ours -------------------------------------------------------------------------------------------------------------


def our_command(recording: Recording) -> list[str]:
    log = Path(recording.log.provenance.path).resolve()
    return [sys.executable, "-m", "service", "map", "build", str(log), "--out", str(recording.folder / "ours")]


def our_path(recording: Recording) -> Trajectory:
    return read_trajectory(recording.folder / "ours" / "trajectory.tum")


# --- MRPT -------------------------------------------------------------------------------------------------------------


def mrpt_version() -> str:
    for program in MRPT_SETTINGS:
        if shutil.which(program) is None:
            raise MissingError(f"no {program}: apt install mrpt-apps")
    if shutil.which("g++") is None or not Path("/usr/include/mrpt/obs/include").exists():
        raise MissingError("its logs cannot be written: apt install g++ libmrpt-dev")
    asked = subprocess.run(["dpkg-query", "-W", "-f", "${Version}", "mrpt-apps"], capture_output=True, text=True)
    return asked.stdout.strip() or "unknown"


def mrpt_command(program: str, recording: Recording) -> list[str]:
    folder = recording.folder
    observations, frames = folder / "observations.rawlog", folder / "frames.rawlog"
    if not frames.exists():
        writer = folder / "mrpt_rawlog"
        includes = [f"-I/usr/include/mrpt/{part}/include" for part in MRPT_PARTS] + ["-I/usr/include/eigen3"]
        source = str(Path(__file__).with_name("mrpt_rawlog.cpp"))
        libraries = [f"-lmrpt-{part}" for part in MRPT_LIBRARIES]
        words = ["g++", "-O2", "-std=c++17", *includes, source, "-o", str(writer), *libraries]
        built = subprocess.run(words, capture_output=True, text=True)
        if built.returncode != 0:
            raise MissingError("mrpt_rawlog.cpp did not compile:\n" + "\n".join(built.stderr.splitlines()[:6]))
        scans = folder / "scans.txt"
        scans.write_text(scans_text(recording))
        subprocess.run([str(writer), str(scans), str(observations), str(frames)], check=True)
    settings = folder / f"{program}.ini"
    settings.write_text(ini_text(MRPT_SETTINGS[program]))
    if program == "graphslam-engine":
        deciders = ["-n", "CFixedIntervalsNRD", "-e", "CICPCriteriaERD", "-o", "CLevMarqGSO"]
        return [program, "--2d", "--disable-visuals", *deciders, "-i", str(settings), "-r", str(observations)]
    return [program, str(settings), str(observations if program == "icp-slam" else frames)]


def ini_text(sections: Sections) -> str:
    return "".join(
        f"[{name}]\n" + "".join(f"{key} = {value}\n" for key, value in settings.items())
        for name, settings in sections.items()
    )


def scans_text(recording: Recording) -> str:
    """As bench/mrpt_rawlog.cpp reads them."""
    log = recording.log
    lines = [f"{' '.join(f'{v:.6f}' for v in log.robot_from_laser)} {min(80.0, log.range_max_m):.3f}\n"]
    for scan, (x, y, yaw) in zip(log.scans, recording.odometry):
        bearing, beams = scan.bearing_rad, len(scan.bearing_rad)
        step = (bearing[-1] - bearing[0]) / (beams - 1)
        ranges = " ".join(f"{r:.3f}" if math.isfinite(r) else "-1" for r in scan.range_m)
        lines.append(f"{scan.stamp_s:.6f} {x:.6f} {y:.6f} {yaw:.6f} {bearing[0]:.9f} {step:.9f} {beams} {ranges}\n")
    return "".join(lines)


def icp_path(recording: Recording) -> Trajectory:
    rows = np.loadtxt(recording.folder / "icp-slam" / "log_estimated_path.txt", ndmin=2)
    return recording.trajectory(after_scans(rows))


def after_scans(rows: F64) -> F64:
    """Poses (N, 3) of the scans from rows (2 N, 4) of step, x, y, yaw: one after odometry, one after each scan."""
    return rows[1::2, 1:4]


def rbpf_path(recording: Recording) -> Trajectory:
    """The mean of the particles as it was told at each scan."""
    rows = np.loadtxt(recording.folder / "rbpf-slam" / "log_estimated_path.txt", ndmin=2)
    return recording.trajectory(rows[:, (1, 2, 4)])  # step, x, y, z, yaw, ...


def graph_path(recording: Recording) -> Trajectory:
    text = (recording.folder / "graphslam-engine" / "graph.txt").read_text()
    return recording.trajectory(between_nodes(text, recording.odometry, GRAPH_M, math.radians(GRAPH_DEG)))


def between_nodes(graph: str, odometry: F64, far_m: float, turned_rad: float) -> F64:
    """Poses (N, 3) of all scans from a graph's text, with lines `VERTEX_SE2 id x y yaw`.

    The first node is the start; another is made after so much motion. Between nodes odometry goes on. Raises
    MissingError if their number is not what the odometry asks for.
    """
    rows = [line.split()[2:5] for line in graph.splitlines() if line.startswith("VERTEX_SE2")]
    nodes = [0, *moved(odometry, far_m, turned_rad)]
    if len(rows) != len(nodes):
        raise MissingError(f"its graph has {len(rows)} nodes where {len(nodes)} were expected")
    return np.asarray(carried(odometry, nodes, np.array(rows, dtype=np.float64)), dtype=np.float64)


# --- PyPI -------------------------------------------------------------------------------------------------------------


def pypi_version(python: str, package: str) -> str:
    program = f"import importlib.metadata as m; print(m.version({package!r}))"
    asked = subprocess.run([python, "-c", program], capture_output=True, text=True)
    if asked.returncode != 0:
        raise MissingError(f"not in {python}: pip install {package}")
    return asked.stdout.strip()


def pypi_command(python: str, name: str, recording: Recording) -> list[str]:
    arrays = recording.folder / "log.npz"
    if not arrays.exists():
        scans = recording.log.scans
        np.savez(
            arrays,
            stamp=np.array([s.stamp_text for s in scans]),
            odometry=recording.odometry,
            bearing=np.array([s.bearing_rad for s in scans]),
            range=np.array([s.range_m for s in scans]),
            mount=np.array(recording.log.robot_from_laser),
        )
    return [python, str(CHILD), name, str(arrays), str(recording.folder / f"{name}.txt")]


def pypi_path(name: str) -> Callable[[Recording], Trajectory]:
    return lambda recording: read_trajectory(recording.folder / f"{name}.txt")


# --- running and judging ----------------------------------------------------------------------------------------------


def from_first(poses: Sequence[Sequence[float]]) -> F64:
    """Poses (N, 3) seen from the first of them."""
    all_ = np.array(poses, dtype=np.float64)
    c, s = math.cos(all_[0, 2]), math.sin(all_[0, 2])
    dx, dy = all_[:, 0] - all_[0, 0], all_[:, 1] - all_[0, 1]
    return np.stack((c * dx + s * dy, -s * dx + c * dy, all_[:, 2] - all_[0, 2]), axis=-1)


def measured(command: Sequence[str], folder: Path) -> dict[str, float]:
    """core_s, wall_s, mib and exit of a command, run in a folder; what it says goes into said.txt there."""
    words = [sys.executable, "-S", "-c", MEASURE, str(LIMIT_S), *command]
    told = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True)
    return {key: float(value) for key, value in json.loads(told.stdout).items()}


def row_of(program: Program, version: str, name: str, recording: Recording) -> dict[str, object]:
    """One row of the table; `failed` says why there are no errors in it."""
    row: dict[str, object] = {"log": name, "program": program.name, "version": version}
    try:
        used = measured(program.command(recording), recording.folder)
        row |= {"core_s": round(used["core_s"], 1), "wall_s": round(used["wall_s"], 1), "mib": round(used["mib"])}
        if used["exit"] != 0:
            stopped = used["core_s"] > LIMIT_S - 2
            return row | {"failed": f"stopped after {LIMIT_S} s" if stopped else f"exit code {used['exit']:.0f}"}
        found = relation_error(program.path(recording), read_relations(recording.relations))
    except MissingError as why:
        return row | {"failed": str(why)}
    return row | {
        "translation_m": round(found.translation_m.mean, 4),
        "rotation_deg": round(found.rotation_deg.mean, 3),
        "largest_m": round(found.translation_m.largest, 2),
        "not_evaluated": found.not_evaluated,
        "relations": found.relations,
    }


def line_of(row: dict[str, object]) -> str:
    start = f"| {row['log']} | {row['program']} {row['version']} | {row.get('core_s', '')} | {row.get('mib', '')} | "
    if "failed" in row:
        return start + f"{row['failed']} | | | |"
    return start + (
        f"{row['translation_m']} m | {row['rotation_deg']}° | {row['largest_m']} m | "
        f"{row['not_evaluated']} of {row['relations']} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=list(LOGS))
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the programs from PyPI")
    parser.add_argument("--only", nargs="+", choices=[program.name for program in programs("")])
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    data = Path(os.environ.get("UMFELD_DATA", ""))
    taking_part: list[tuple[Program, str]] = []
    for program in programs(options.python):
        if options.only is not None and program.name not in options.only:
            continue
        try:
            taking_part.append((program, program.version()))
        except MissingError as why:
            print(f"{program.name} is left out: {why}")
    rows: list[dict[str, object]] = []
    print("| log | program | core seconds | MiB | translation | rotation | largest | not evaluated |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.logs:
            recording = Recording.read(name, data, Path(scratch) / name)
            for program, version in taking_part:
                if program.command is our_command and not rows:
                    measured(program.command(recording), recording.folder)  # compiles what was not yet
                rows.append(row_of(program, version, name, recording))
                print(line_of(rows[-1]), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
