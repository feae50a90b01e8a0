"""State and counters of every source and of the daemon itself, as one document: pure, but for the process meter.

What is wrong comes first and in words. Levels are those of ROS diagnostics: 0 ok, 1 warning, 2 error, 3 stale.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from drivers import reader
from drivers.readings import ClockFit, Identity, LinkState
from service.outputs import HealthOut, SourceHealth

OK, WARNING, ERROR, STALE = range(4)


@dataclass(frozen=True, slots=True)
class Inside:
    """What the daemon knows about itself.

    drops: what fusion threw away, by source and reason.  counters: by name.  troubles: one line each, with the repair.
    """

    drops: Mapping[str, Mapping[str, int]]
    counters: Mapping[str, int]
    troubles: Sequence[str] = ()


def report(
    wires: Iterable[reader.WireHealth],
    kinds: Mapping[str, str],
    inside: Inside,
    process: Mapping[str, float],
    now_ns: int,
) -> HealthOut:
    """The health of everything at now_ns. kinds: by source name, in the order of the report."""
    wires = list(wires)
    found = {name: source for wire in wires for name, source in wire.sources.items()}
    sources = tuple(_source(found[name], kind, inside.drops.get(name, {})) for name, kind in kinds.items())
    troubles = [f"{source.name}: {source.text}" for source in sources if source.level >= WARNING] + [*inside.troubles]
    level = max((min(source.level, ERROR) for source in sources), default=OK)
    if inside.troubles:
        level = max(level, WARNING)
    counters = dict(inside.counters)
    for wire in wires:
        counters[f"wire.{wire.name}.openings"] = wire.openings
        counters |= {f"wire.{wire.name}.{reason}": count for reason, count in sorted(wire.drops.items())}
    return HealthOut(now_ns, level, "; ".join(troubles) or _all_well(sources), sources, counters, dict(process))


def _all_well(sources: Sequence[SourceHealth]) -> str:
    if not sources:
        return "no device is configured; add [lasers.NAME] or [sonars.NAME] (umfeld config init)"
    return f"{len(sources)} device{'s' if len(sources) > 1 else ''} running"


def _source(source: reader.SourceHealth, kind: str, fusion_drops: Mapping[str, int]) -> SourceHealth:
    trouble = trouble_of(source)
    drops = dict(source.counters.drops)
    for reason, count in fusion_drops.items():
        drops[reason] = drops.get(reason, 0) + count
    return SourceHealth(
        name=source.name,
        kind=kind,
        level=level_of(source.state, trouble, had_readings=source.readings > 0),
        state=source.state.name.lower(),
        text=trouble or source.state.name.lower(),
        identity=identity_text(source.identity),
        rate_hz=source.rate_hz,
        age_ns=-1 if source.age_ns is None else source.age_ns,
        readings=source.readings,
        drops=dict(sorted(drops.items())),
        clock=_clock(source.clock_fit),
    )


def trouble_of(source: reader.SourceHealth) -> str | None:
    """What is wrong with a device, in words; where it only keeps silent, what that hints at."""
    if source.state is LinkState.SILENT and source.readings == 0 and source.identity is None:
        said = source.trouble or "no answer yet"
        if source.counters.bytes:
            return (
                f"{said}; {source.counters.bytes} bytes came that are not its language: another device on this port, "
                "or another line speed? (driver, port, baud_bps)"
            )
        if said == _NO_ANSWER:
            return f"{said}: check its power and cable, and that this port is its own"
    return source.trouble


_NO_ANSWER = "no answer yet"


def level_of(state: LinkState, trouble: str | None, *, had_readings: bool) -> int:
    """How bad a device's state is: one that fell silent is stale, one that never spoke an error."""
    match state:
        case LinkState.RUNNING:
            return OK if trouble is None else WARNING
        case LinkState.STARTING:
            return WARNING
        case LinkState.SILENT if had_readings:
            return STALE
        case _:
            return ERROR


def identity_text(identity: Identity | None) -> str:
    """Vendor, model, serial and firmware as far as the device tells them."""
    if identity is None:
        return ""
    parts = [
        " ".join(filter(None, (identity.vendor, identity.model))),
        f"serial {identity.serial}" if identity.serial else "",
        f"firmware {identity.firmware}" if identity.firmware else "",
    ]
    return ", ".join(filter(None, parts))


def _clock(fit: ClockFit | None) -> dict[str, float]:
    if fit is None:
        return {}
    return {
        "offset_ns": float(fit.offset_ns),
        "drift_ppm": fit.drift_ppm,
        "jitter_ns": fit.jitter_ns,
        "samples": float(fit.samples),
    }


class ProcessMeter:
    """What this process takes from the machine; shares are counted between two calls."""

    def __init__(self, now_ns: int) -> None:
        self._began_ns = now_ns
        self._last_ns = now_ns
        self._last_cpu_s = _cpu_s()

    def measure(self, now_ns: int) -> dict[str, float]:
        """cpu_percent of one core, memory_mb resident, threads, open_files, uptime_s."""
        cpu_s = _cpu_s()
        elapsed_s = (now_ns - self._last_ns) / 1e9
        percent = 100.0 * (cpu_s - self._last_cpu_s) / elapsed_s if elapsed_s > 0 else 0.0
        self._last_ns, self._last_cpu_s = now_ns, cpu_s
        return {
            "cpu_percent": round(percent, 1),
            "memory_mb": round(_resident_bytes() / 1e6, 1),
            "threads": float(_count("/proc/self/task")),
            "open_files": float(_count("/proc/self/fd")),
            "uptime_s": round((now_ns - self._began_ns) / 1e9, 1),
        }


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def _resident_bytes() -> int:
    try:
        with open("/proc/self/statm", encoding="ascii") as statm:
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # no /proc here: the peak is the next best
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _count(folder: str) -> int:
    try:
        return len(os.listdir(folder))
    except OSError:
        return 0
