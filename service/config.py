"""The whole configuration: what may stand in umfeld.toml, checked as a whole, frozen afterwards.

TOML, strict: an unknown key is a fault that names the nearest known one; all faults are reported at once, each one
line with file, line, key and repair. Every value has a default and its unit in its name. The
tables themselves: config_devices.py, config_maps.py, config_around.py. Reference for users: docs/configuration.md.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from service.config_around import Log, Mavlink, Network, RecordingSettings, Ros, Search, Store
from service.config_base import Name, Section
from service.config_devices import (
    SHARED_DRIVERS,
    AliceRing,
    CanBus,
    Cia406Mount,
    ContactDevice,
    Device,
    Drive,
    LaserDevice,
    MavlinkPose,
    Robot,
    SonarDevice,
    WheelDevice,
)
from service.config_faults import Fault, faults_of, without_faults
from service.config_files import KeyPath, Layers, find_config, origin_of, read_layers
from service.config_maps import (
    AgreementSettings,
    Alignment,
    Artos,
    CalibrationSettings,
    ClearanceSettings,
    ElevationSettings,
    Grid,
    LineMapSettings,
    LocalGrid,
    LocaliseIn,
    PlaceMapSettings,
    PlaneMapSettings,
    RoomMapSettings,
    SceneMapSettings,
    SectorMaps,
    SlamLive,
    TopoMapSettings,
)
from service.errors import WrongUsage

SENSOR_SECTIONS = ("lasers", "sonars", "contacts")
DEVICE_SECTIONS = (*SENSOR_SECTIONS, "wheels", "mounts", "poses", "rings")


class Config(Section):
    """umfeld.toml as a whole."""

    robot: Robot = Field(default=Robot(), description="The vehicle.")
    drive: Drive = Field(default=Drive(), description="How wheel counts become motion.")
    can: dict[Name, CanBus] = Field(default={}, description="CAN buses by name.")
    lasers: dict[Name, LaserDevice] = Field(default={}, description="Laser rangefinders by name.")
    sonars: dict[Name, SonarDevice] = Field(default={}, description="Ultrasonic chains by name.")
    contacts: dict[Name, ContactDevice] = Field(default={}, description="Bumpers and cliff switches by name.")
    wheels: dict[Name, WheelDevice] = Field(default={}, description="Wheel encoders by name.")
    mounts: dict[Name, Cia406Mount] = Field(default={}, description="Mounts that nod or turn a laser, by name.")
    poses: dict[Name, MavlinkPose] = Field(default={}, description="Other estimators of the robot's pose by name.")
    rings: dict[Name, AliceRing] = Field(default={}, description="Robots with rings of light and touch, by name.")
    sectors: SectorMaps = Field(default=SectorMaps(), description="Sector maps.")
    grid: Grid = Field(default=Grid(), description="The grid of the whole building.")
    local_grid: LocalGrid = Field(default=LocalGrid(), description="The grid around the robot.")
    artos: Artos = Field(default=Artos(), description="The ARTOS two-step map.")
    lines: LineMapSettings = Field(default=LineMapSettings(), description="The map of walls as lines.")
    planes: PlaneMapSettings = Field(default=PlaneMapSettings(), description="Planes of tilting lasers.")
    elevation: ElevationSettings = Field(default=ElevationSettings(), description="Heights of the ground around.")
    clearance: ClearanceSettings = Field(default=ClearanceSettings(), description="Distances to obstacles.")
    topo: TopoMapSettings = Field(default=TopoMapSettings(), description="Regions of free space and ways between them.")
    places: PlaceMapSettings = Field(default=PlaceMapSettings(), description="Places and hallways.")
    scenes: SceneMapSettings = Field(default=SceneMapSettings(), description="Scenes to be recognised again.")
    rooms: RoomMapSettings = Field(default=RoomMapSettings(), description="Rooms, doors, plans.")
    calibration: CalibrationSettings = Field(
        default=CalibrationSettings(), description="What wheels and mounts of lasers really are."
    )
    agreement: AgreementSettings = Field(default=AgreementSettings(), description="Maps held against each other.")
    slam: SlamLive = Field(default=SlamLive(), description="Where the robot is, by laser scans.")
    localise: LocaliseIn = Field(default=LocaliseIn(), description="Finding the robot in a given map.")
    alignment: Alignment = Field(default=Alignment(), description="How long readings wait for each other.")
    network: Network = Field(default=Network(), description="The Zenoh router.")
    ros: Ros = Field(default=Ros(), description="ROS 2 beside our own keys.")
    store: Store = Field(default=Store(), description="The map on disk.")
    search: Search = Field(default=Search(), description="Where devices are looked for by serial number.")
    mavlink: Mavlink = Field(default=Mavlink(), description="A sector map for an autopilot.")
    recording: RecordingSettings = Field(
        default=RecordingSettings(), description="What happened, byte by byte, for `umfeld replay`."
    )
    log: Log = Field(default=Log(), description="What is written to standard error.")

    def devices(self) -> Iterator[tuple[str, str, Device]]:
        """(section, name, device) of every device, in a fixed order."""
        for section in DEVICE_SECTIONS:
            for name, device in sorted(getattr(self, section).items()):
                yield section, name, device

    def source_name(self, section: str, name: str) -> str:
        """The one name of a device in keys and reports: its own, with its section before it if an earlier one has it.

        lasers come before sonars, then contacts, wheels, mounts, poses, rings: with [lasers.front] and [sonars.front]
        these are `front` and `sonars-front`.
        """
        earlier = DEVICE_SECTIONS[: DEVICE_SECTIONS.index(section)]
        return f"{section}-{name}" if any(name in getattr(self, other) for other in earlier) else name

    def resolve(self, reference: str) -> tuple[str, str]:
        """(section, name) of a sector map's or grid's source; a bare name means the laser if there is one.

        Raises KeyError if there is no such sensor.
        """
        section, dot, name = reference.rpartition(".")
        for candidate in (section,) if dot else SENSOR_SECTIONS:
            if candidate in SENSOR_SECTIONS and name in getattr(self, candidate):
                return candidate, name
        raise KeyError(reference)

    def store_path(self) -> Path:
        """The map's file."""
        if self.store.path is not None:
            return Path(self.store.path).expanduser()
        return state_folder() / f"{self.robot.id}.umfeld"

    def recording_folder(self) -> Path:
        """Where recordings are kept."""
        if self.recording.folder is not None:
            return Path(self.recording.folder).expanduser()
        return state_folder() / "recordings"


def state_folder() -> Path:
    """Where a service keeps its own: systemd's StateDirectory, or a place in the user's home."""
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    return Path(state) if state else Path.home() / ".local/share/umfeld"


@dataclass(frozen=True, slots=True)
class Loaded:
    """A valid configuration, where each value came from, and the files that were read."""

    config: Config
    origins: Mapping[KeyPath, str]
    files: tuple[Path, ...]

    def origin(self, path: KeyPath) -> str:
        """`default`, `FILE:LINE`, `environment NAME` or `--set`."""
        return origin_of(self.origins, path)


def load(
    path: Path | None = None, *, settings: Sequence[str] = (), environment: Mapping[str, str] | None = None
) -> Loaded:
    """Find, read, merge and check the configuration.

    path: the file, or None to look for one (docs/configuration.md).  settings: `KEY=VALUE` from the command line.
    Raises WrongUsage with one line per fault, all of them at once.
    """
    layers = read_layers(find_config(path), environment=environment, settings=settings)
    return Loaded(check(layers), layers.origins, layers.files)


def from_document(document: Mapping[str, Any]) -> Config:
    """A configuration that was checked before, from what its `model_dump_json()` says."""
    return Config.model_validate(_tuples(document))


def check(layers: Layers) -> Config:
    """Validate merged tables; raises WrongUsage with one line per fault."""
    data = _tuples(layers.data)
    config, faults = _parse(data)
    faults.extend(_cross_faults(config, data))
    if faults:
        places = layers.tables | layers.origins
        located = [(_place(places, fault.path), fault) for fault in faults]
        located.sort(key=lambda each: _in_file_order(each[0]))
        lines = (": ".join(filter(None, (place, ".".join(fault.path), fault.text))) for place, fault in located)
        raise WrongUsage(*dict.fromkeys(lines))
    return config


def _place(places: Mapping[KeyPath, str], path: KeyPath) -> str:
    """Where a key stands, or the table around it, or the first key below it; empty if in no file."""
    path = tuple(step.partition("[")[0] for step in path)
    for length in range(len(path), 0, -1):
        below = next((place for keys, place in places.items() if keys[:length] == path[:length]), None)
        if found := places.get(path[:length], below):
            return found
    return ""


def _in_file_order(origin: str) -> tuple[str, int]:
    file, _, line = origin.rpartition(":")
    return (file, int(line)) if line.isdecimal() else (origin, 0)


def _parse(data: dict[str, Any]) -> tuple[Config, list[Fault]]:
    """The configuration without its faulty parts, and the faults; so that what is left can be checked as well."""
    faults: list[Fault] = []
    while True:
        try:
            return Config.model_validate(data), faults
        except ValidationError as error:
            found = faults_of(error, Config, data)
            known = {fault.path for fault in faults}  # what was taken out is now missing: not a fault of its own
            faults.extend(fault for fault in found if fault.path not in known)
            smaller = without_faults(data, found)
            if smaller == data:
                return Config(), faults
            data = smaller


def _tuples(value: Any) -> Any:
    """Arrays as tuples, which frozen models keep."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


# --- what several tables must agree on --------------------------------------------------------------------------------


def _cross_faults(config: Config, data: Mapping[str, Any]) -> list[Fault]:
    """References that lead nowhere, and things claimed twice.

    Looked for in the raw tables, where tables that are faulty otherwise still stand: one fault does not hide another.
    """
    return [
        *_name_faults(data),
        *_reference_faults(data),
        *_port_faults(data),
        *_can_id_faults(config),
        *_unused_faults(config, data),
    ]


def _table(data: Mapping[str, Any], *keys: str) -> Mapping[str, Any]:
    table: Any = data
    for key in keys:
        table = table.get(key) if isinstance(table, Mapping) else None
    return table if isinstance(table, Mapping) else {}


def _tables(data: Mapping[str, Any], *keys: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    return ((name, each) for name, each in sorted(_table(data, *keys).items()) if isinstance(each, Mapping))


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(each for each in value if isinstance(each, str)) if isinstance(value, tuple) else ()


def _missing(path: KeyPath, name: str, section: str, data: Mapping[str, Any]) -> Fault:
    there = ", ".join(sorted(_table(data, *section.split("."))))
    repair = f"add [{section}.{name}], or name one of: {there}" if there else f"add [{section}.{name}]"
    return Fault(path, f"there is no [{section}.{name}]; {repair}")


def _name_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    for section in DEVICE_SECTIONS:
        if "json" in _table(data, section):
            yield Fault((section, "json"), "the name json is taken by the key health/json; take another name")


def _reference_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    for key, section in (("source", "wheels"), ("pose_source", "poses")):
        source = _table(data, "drive").get(key)
        if isinstance(source, str) and source not in _table(data, section):
            yield _missing(("drive", key), source, section, data)
    for section in DEVICE_SECTIONS:
        for name, device in _tables(data, section):
            bus = device.get("can")
            if isinstance(bus, str) and bus not in _table(data, "can"):
                yield _missing((section, name, "can"), bus, "can", data)
    tilting = {table.get("laser"): name for name, table in _tables(data, "mounts")}
    for name, table in _tables(data, "mounts"):
        laser = table.get("laser")
        if isinstance(laser, str) and laser not in _table(data, "lasers"):
            yield _missing(("mounts", name, "laser"), laser, "lasers", data)
        elif isinstance(laser, str) and tilting[laser] != name:
            yield Fault(("mounts", name, "laser"), f"{laser} is on mounts.{tilting[laser]} already; each has its own")
    for path, table in (
        *((("sectors", "polar", name), table) for name, table in _tables(data, "sectors", "polar")),
        *((("sectors", "rect", name), table) for name, table in _tables(data, "sectors", "rect")),
        (("grid",), _table(data, "grid")),
        (("local_grid",), _table(data, "local_grid")),
        (("lines",), _table(data, "lines")),
        (("scenes",), _table(data, "scenes")),
        (("calibration",), _table(data, "calibration")),
        (("slam",), _table(data, "slam")),
        (("localise",), _table(data, "localise")),
    ):
        for reference in _texts(table.get("sources")):
            section, dot, name = reference.rpartition(".")
            if not any(name in _table(data, each) for each in ((section,) if dot else SENSOR_SECTIONS)):
                known = [f"{each}.{one}" for each in SENSOR_SECTIONS for one in sorted(_table(data, each))]
                text = f"there is no sensor {reference}; name one of: {', '.join(known) or '(none yet)'}"
                yield Fault((*path, "sources"), text)
            elif section != "sonars" and name in tilting and name in _table(data, "lasers"):
                text = (
                    f"the laser {name} is tilted by mounts.{tilting[name]}: it makes clouds, and goes into no flat map"
                )
                yield Fault((*path, "sources"), text)
    sent = _table(data, "mavlink").get("map")
    if isinstance(sent, str) and sent not in _table(data, "sectors", "polar"):
        yield _missing(("mavlink", "map"), sent, "sectors.polar", data)
    for name in _texts(_table(data, "artos").get("sources")):
        if name not in _table(data, "sectors", "polar"):
            yield _missing(("artos", "sources"), name, "sectors.polar", data)


def _port_faults(data: Mapping[str, Any]) -> Iterator[Fault]:
    taken: dict[str, tuple[str, str, Any]] = {}
    claims: list[tuple[KeyPath, Any, Any]] = [
        ((section, name, key), table.get(key), table.get("driver"))
        for section, key in (*((each, "port") for each in DEVICE_SECTIONS), ("can", "channel"))
        for name, table in _tables(data, section)
    ]
    mavlink = _table(data, "mavlink")
    if mavlink.get("enabled"):
        claims.append((("mavlink", "port"), mavlink.get("port"), "mavlink"))
    for path, port, driver in claims:
        if not isinstance(port, str):
            continue
        real = os.path.realpath(port) if port.startswith("/") else port
        section, owner, owners_driver = taken.setdefault(real, (path[0], ".".join(path[:-1]), driver))
        if owner == ".".join(path[:-1]) or (
            driver in SHARED_DRIVERS and driver == owners_driver and path[0] != section
        ):
            continue
        yield Fault(path, f"{port} is already used by {owner}; each wire has a port of its own")


def _can_id_faults(config: Config) -> Iterator[Fault]:
    taken: dict[tuple[str, int], str] = {}
    boards: dict[tuple[str, int], set[str]] = {}  # a USBoard's sonars and its switches have the ids in common
    for section, name, device in config.devices():
        bus = device.can_bus()
        if bus is None:
            continue
        base_id = getattr(device, "base_id", None)
        if base_id is not None:
            sections = boards.setdefault((bus, base_id), set())
            is_same_board = bool(sections) and section not in sections
            sections.add(section)
            if is_same_board:
                continue
        clashes = sorted(can_id for can_id in device.can_ids() if (bus, can_id) in taken)
        if clashes:
            other = taken[bus, clashes[0]]
            yield Fault(
                (section, name),
                f"uses CAN id 0x{clashes[0]:03X} on [can.{bus}] like {other}; give one other ids (base_id, node_...)",
            )
        taken.update({(bus, can_id): f"{section}.{name}" for can_id in device.can_ids()})


def _unused_faults(config: Config, data: Mapping[str, Any]) -> Iterator[Fault]:
    """What was written down to be used and cannot be."""
    for name in config.wheels:
        if config.drive.source is None and "source" not in _table(data, "drive"):
            yield Fault(
                ("wheels", name), f'no drive uses it; add source = "{name}" to [drive], with the wheels\' measures'
            )
    for name in config.poses:
        if config.drive.pose_source is None and "pose_source" not in _table(data, "drive"):
            yield Fault(("poses", name), f'no drive uses it; add pose_source = "{name}" to [drive]')
    if config.rings and config.topo.enabled:
        yield Fault(("topo", "enabled"), "map/topo is what the ring makes; leave [topo] out, or [rings.NAME]")
    if config.places.enabled and (config.topo.enabled or config.rings):
        other = "[topo]" if config.topo.enabled else "[rings.NAME]"
        yield Fault(("places", "enabled"), f"map/topo is one map, and {other} makes it; leave one of the two out")
    if len(config.rings) > 1:
        yield Fault(("rings", sorted(config.rings)[1]), "a robot has one ring: map/topo is one map")
    polar = _table(data, "sectors", "polar")
    if config.mavlink.enabled and config.mavlink.map is None and len(polar) != 1:
        names = ", ".join(sorted(polar)) or "(none yet)"
        yield Fault(("mavlink", "map"), f"say which [sectors.polar.NAME] to send, of: {names}")
    if config.artos.enabled and not _table(data, "sectors", "polar"):
        yield Fault(("artos", "enabled"), "the ARTOS map is made from polar sector maps; add a [sectors.polar.NAME]")
