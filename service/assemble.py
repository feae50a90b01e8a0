"""Configuration to parts: sensors with their places, maps, the localiser, autopilots. Wires are in assemble_wires, the
maps of the slow thread in assemble_makers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.ports import Clock
from drivers.reader import WireReader
from mapping.frames import Pose2, Pose3
from mapping.odometry import DriveGeometry
from mapping.planes.cloud import TiltMount
from service.assemble_wires import UDP, maxbotix_period_s, open_serial, open_udp
from service.config import Config
from service.config_base import PlanePose
from service.config_devices import (
    AliceRing,
    ArduinoContacts,
    ArduinoSonars,
    ArduinoWheels,
    Cia406Mount,
    Cia406Wheels,
    Device,
    Drive,
    HokuyoLaser,
    LdrobotLaser,
    MavlinkPose,
    MavlinkSonars,
    MavlinkWheels,
    MaxBotixSonars,
    Mount,
    ODriveWheels,
    RoboClawWheels,
    RplidarLaser,
    SickColaLaser,
    SickLms2xxLaser,
    UsBoardContacts,
    UsBoardSerialContacts,
    UsBoardSerialSonars,
    UsBoardSonars,
    VescWheels,
)
from service.fusion import SECTOR_MEMORY_NS, GridLayer, Localiser, OdometryOnly, Parts, SectorLayer, StoredTile
from service.mounts import MountSettings, TiltingLaser
from service.sensors import (
    AxleEncoder,
    Chain,
    Contacts,
    Laser,
    PoseSource,
    Ring,
    Sensor,
    Switch,
    Transducer,
    Wheels,
)

if TYPE_CHECKING:
    from service.background import Submit
    from service.layers import ArtosLayer, BuildingLayer, PolarLayer, RectLayer
    from service.map_localiser import KnownMapLayer
    from service.mavlink_out import MavlinkOut
    from service.redraw import OnRedrawn
    from service.rpc import Handler


def sensors(config: Config) -> dict[str, Sensor]:
    """Every source by its name: what fusion must know of it."""
    found: dict[str, Sensor] = {}
    for section, name, device in config.devices():
        source = config.source_name(section, name)
        found[source] = _sensor_of(source, device)
    for mount in config.mounts.values():
        laser = found[mount.laser]
        assert isinstance(laser, Laser)
        found[mount.laser] = replace(laser, tilts=True)
    return found


def pose_of(place: Mount | PlanePose) -> Pose2:
    """A mounting in the base frame."""
    return Pose2(place.x_m, place.y_m, math.radians(place.yaw_deg))


# --- sensors ----------------------------------------------------------------------------------------------------------


def _sensor_of(source: str, device: Device) -> Sensor:
    match device:
        case HokuyoLaser() | SickLms2xxLaser() | RplidarLaser() | LdrobotLaser() | SickColaLaser():
            said_by_laser = isinstance(
                device, HokuyoLaser | SickLms2xxLaser
            )  # of others the driver knows what a 0 means
            return Laser(
                source,
                pose_of(device.mount),
                height_m=device.mount.z_m,
                upside_down=device.mount.upside_down,
                nothing_is_free=not said_by_laser or device.no_echo == "clear",
            )
        case UsBoardSonars() | UsBoardSerialSonars() | MaxBotixSonars() | ArduinoSonars() | MavlinkSonars():
            transducers = tuple(
                Transducer(each.channel, Pose2(each.x_m, each.y_m, math.radians(each.yaw_deg)), each.z_m)
                for each in device.transducers
            )
            return Chain(
                source,
                transducers,
                math.radians(device.cone_deg),
                device.range_min_m,
                device.range_max_m,
                round(
                    1e9 * (maxbotix_period_s(device) if isinstance(device, MaxBotixSonars) else 1.0 / device.rate_hz)
                ),
                unchecked=isinstance(device, MaxBotixSonars | ArduinoSonars),
            )
        case Cia406Wheels() | ArduinoWheels() | RoboClawWheels() | ODriveWheels() | VescWheels() | MavlinkWheels():
            return Wheels(source)
        case Cia406Mount():
            return AxleEncoder(source)
        case ArduinoContacts() | UsBoardContacts() | UsBoardSerialContacts():
            switches = tuple(
                Switch(each.line, Pose2(each.x_m, each.y_m, math.radians(each.yaw_deg)), each.width_m)
                for each in device.switches
            )
            return Contacts(source, switches, round(1e9 / device.rate_hz), round(1e9 * device.hold_s))
        case MavlinkPose():
            return PoseSource(source)
        case AliceRing():
            return Ring(source)
        case _:
            raise TypeError(f"no sensor for {type(device).__name__}")


# --- maps -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Maps:
    """The maps of a configuration. building: the one the store keeps, None if there is none."""

    sectors: tuple[SectorLayer, ...]
    grids: tuple[GridLayer, ...]
    building: BuildingLayer | None


def maps(config: Config, found: Mapping[str, Sensor]) -> Maps:
    """Empty maps as configured, fed by the sensors found."""
    from mapping.grids.occupancy import OccupancyGrid
    from mapping.grids.rolling import RollingGrid
    from service.layers import BuildingLayer, PolarLayer, RollingLayer

    building = None
    grids: list[GridLayer] = []
    if config.localise.mode == "map":
        grids.append(_known_map(config, found))
    elif config.grid.enabled:
        building = BuildingLayer(
            OccupancyGrid(resolution_m=config.grid.resolution_m, model=config.grid.model),
            sources_of(config, config.grid.sources, found),
            publish_period_ns=round(config.grid.publish_period_s * 1e9),
            update_period_ns=round(config.grid.update_period_s * 1e9),
            halve_period_ns=round(config.grid.halve_every_s * 1e9),
        )
        grids.append(building)
    if config.local_grid.enabled:
        local = config.local_grid
        grids.append(
            RollingLayer(
                "local",
                RollingGrid(side_m=local.size_m, resolution_m=local.resolution_m, model=local.model),
                sources_of(config, local.sources, found),
                period_ns=round(local.period_s * 1e9),
                halve_period_ns=round(local.halve_every_s * 1e9),
            )
        )
    sectors = tuple(_sector_maps(config))
    if config.artos.enabled:
        grids.append(_artos_map(config, [layer for layer in sectors if isinstance(layer, PolarLayer)]))
    return Maps(sectors, tuple(grids), building)


def _known_map(config: Config, found: Mapping[str, Sensor]) -> KnownMapLayer:
    """The given map of [localise]. Trouble if its file cannot be read."""
    from service.map_localiser import KnownMapLayer, read_map, seen_by_lasers

    lasers = frozenset(name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts)
    path = Path(config.localise.map or "").expanduser()
    patch, sources = read_map(path), lasers & sources_of(config, config.localise.sources, found)
    return KnownMapLayer(patch, sources, name=path.name, seen=seen_by_lasers(path, patch))


def tilting_lasers(config: Config) -> tuple[TiltingLaser, ...]:
    """The mounts that nod or turn a laser."""
    return tuple(TiltingLaser(_mount_settings(config, name)) for name in sorted(config.mounts))


def _mount_settings(config: Config, name: str) -> MountSettings:
    device = config.mounts[name]
    place, arm = device.mount, device.arm
    roll = math.pi if place.upside_down else 0.0
    return MountSettings(
        name=config.source_name("mounts", name),
        laser=config.source_name("lasers", device.laser),
        mount=TiltMount(
            Pose3(place.x_m, place.y_m, place.z_m, roll, 0.0, math.radians(place.yaw_deg)),
            device.axle,
            Pose3(arm.x_m, arm.y_m, arm.z_m, *map(math.radians, (arm.roll_deg, arm.pitch_deg, arm.yaw_deg))),
        ),
        rad_per_tick=2.0 * math.pi / device.counts_per_turn,
        zero_rad=math.radians(device.zero_deg),
        turning=device.motion == "turns",
        delay_ns=round(device.delay_ms * 1e6),
        wait_ns=config.alignment.odometry_wait_ms * 1_000_000,
    )


def closure_calls(localiser: Localiser, ask: Callable[[Callable[[], Any]], Any]) -> Iterator[tuple[str, Handler]]:
    """Calls about the closures of a daemon that does SLAM, by name. ask: runs a function on the fusion thread."""
    if isinstance(localiser, OdometryOnly):
        return
    from service.slam_live import SlamLocaliser

    if isinstance(localiser, SlamLocaliser):
        yield "list_closures", lambda _arguments: ask(localiser.closures_told)
        yield "undo_closure", lambda arguments: ask(partial(localiser.undo, arguments))


def _artos_map(config: Config, polar: Sequence[PolarLayer]) -> ArtosLayer:
    from mapping.sectors.artos import ArtosMap
    from service.layers import ArtosLayer

    artos = config.artos
    wanted = [layer for layer in polar if not artos.sources or layer.name in artos.sources]
    grid = ArtosMap(resolution_m=artos.resolution_m, size_m=artos.size_m)
    return ArtosLayer(grid, wanted, period_ns=round(artos.period_s * 1e9))


def _sector_maps(config: Config) -> Iterator[PolarLayer | RectLayer]:
    from mapping.sectors.footprint import checked_polygon
    from mapping.sectors.inputs import FanReader
    from mapping.sectors.polar import PolarSectors
    from mapping.sectors.rectangular import RectSectors
    from service.layers import PolarLayer, RectLayer

    footprint = np.array(config.robot.footprint_m)
    fans = FanReader(checked_polygon(footprint))
    for name, polar in sorted(config.sectors.polar.items()):
        fed_by = _in_order(config, polar.sources)
        yield PolarLayer(
            name,
            PolarSectors(
                sources=fed_by,
                start_rad=math.radians(polar.start_deg),
                stop_rad=math.radians(polar.stop_deg),
                sector_rad=math.radians(polar.sector_deg),
                base_from_sensor=pose_of(polar.pose),
                stale_after_ns=SECTOR_MEMORY_NS,
                footprint=footprint,
                range_max_m=math.inf if polar.range_max_m is None else polar.range_max_m,
                fans=fans,
            ),
            fed_by,
        )
    for name, rect in sorted(config.sectors.rect.items()):
        fed_by = _in_order(config, rect.sources)
        yield RectLayer(
            name,
            RectSectors(
                sources=fed_by,
                size_m=rect.size_m,
                sector_m=rect.sector_m,
                base_from_sensor=pose_of(rect.pose),
                stale_after_ns=SECTOR_MEMORY_NS,
                footprint=footprint,
                fans=fans,
            ),
            fed_by,
        )


def _in_order(config: Config, references: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(config.source_name(*config.resolve(reference)) for reference in references))


def parts(config: Config, found: Mapping[str, Sensor], made: Maps, localiser: Localiser) -> Parts:
    """What fusion is made of."""
    from mapping.sectors.footprint import checked_polygon

    drive = None
    if config.drive.source is not None:
        drive = (config.source_name("wheels", config.drive.source), geometry_of(config.drive))
    return Parts(
        sensors=found,
        sectors=made.sectors,
        grids=made.grids,
        drive=drive,
        pose_source=None if config.drive.pose_source is None else config.source_name("poses", config.drive.pose_source),
        odometry_laser=odometry_laser(config, found),
        max_wheel_speed_m_s=config.drive.max_wheel_speed_m_s,
        localiser=localiser,
        mounts=tilting_lasers(config),
        footprint=checked_polygon(config.robot.footprint_m),
        wait_ns=config.alignment.odometry_wait_ms * 1_000_000,
        odometry_memory_s=config.alignment.odometry_memory_s,
    )


def localiser(
    config: Config,
    found: Mapping[str, Sensor],
    made: Maps,
    start_pose: Pose2,
    submit: Submit,
    on_redrawn: OnRedrawn | None = None,
    stored: Sequence[StoredTile] = (),
) -> Localiser:
    """What says where the odom frame lies in the map; the same for a daemon and for a replay of what it recorded.

    submit: where slow work is done.  on_redrawn: see Redrawer.  stored: the layer `slam` of the map
    that was taken up.
    """
    lasers = {
        name: sensor.base_from_sensor
        for name, sensor in found.items()
        if isinstance(sensor, Laser) and not sensor.tilts
    }
    if config.localise.mode == "map":
        from service.map_localiser import KnownMapLayer, KnownMapLocaliser

        known = next(layer for layer in made.grids if isinstance(layer, KnownMapLayer))
        start = None if config.localise.start is None else pose_of(config.localise.start)
        return KnownMapLocaliser(
            known.seen, known.sources, submit=submit, start=start, name=known.name, published=known.patch
        )
    matched = lasers.keys() & sources_of(config, config.slam.sources, found)
    if not config.slam.enabled or not matched:
        return OdometryOnly(start_pose)
    if config.slam.method == "lines":
        from service.line_localiser import LineLocaliser

        return LineLocaliser(matched, geometry_of(config.drive), start=start_pose)
    from mapping.localise.slam_records import without_wheels
    from service.redraw import Redrawer
    from service.slam_live import SlamLocaliser, stored_or_none

    redrawer = Redrawer(made.grids, made.building, lasers, submit=submit)
    kept = stored_or_none(stored)
    if made.building is not None and kept is None:
        redrawer.start_over(made.building.grid.tiles())
    redrawer.on_redrawn = on_redrawn or redrawer.on_redrawn
    alone = odometry_laser(config, found) is not None
    return SlamLocaliser(
        matched, start=start_pose, submit=submit, redrawer=redrawer, settings=without_wheels() if alone else None,
        stored=kept, lost_when_broken=alone,
    )  # fmt: skip


def odometry_laser(config: Config, found: Mapping[str, Sensor]) -> str | None:
    """The level laser that tells the motion of a robot on which nothing else does: the first of those that are laid
    on the map. None where wheels or another estimator tell it, or nobody wants it told."""
    drive = config.drive
    if drive.source is not None or drive.pose_source is not None or not drive.laser_odometry:
        return None
    wanted = config.localise.sources if config.localise.mode == "map" else config.slam.sources
    level = {name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts}
    return min(level & sources_of(config, wanted, found), default=None)


def geometry_of(drive: Drive) -> DriveGeometry:
    """How counts become motion."""
    return DriveGeometry(
        wheel_radius_left_m=drive.wheel_radius_left_m,
        wheel_radius_right_m=drive.wheel_radius_right_m,
        track_width_m=drive.track_width_m,
        ticks_per_turn_left=drive.ticks_per_turn_left,
        ticks_per_turn_right=drive.ticks_per_turn_right,
        travel_noise_m_per_sqrt_m=drive.travel_noise_m_per_sqrt_m,
        unknown_speed_m_s=drive.unknown_speed_m_s,
        unknown_turn_rad_s=drive.unknown_turn_rad_s,
    )


def sources_of(config: Config, references: Sequence[str] | None, found: Mapping[str, Sensor]) -> frozenset[str]:
    """The sensors that feed a map: those named, or every one that looks level; and switches."""
    if references is None:
        return frozenset(
            name
            for name, sensor in found.items()
            if isinstance(sensor, Chain | Contacts) or (isinstance(sensor, Laser) and not sensor.tilts)
        )
    return frozenset(config.source_name(*config.resolve(reference)) for reference in references)


# --- autopilots -------------------------------------------------------------------------------------------------------


def mavlink_out(
    config: Config, found: Mapping[str, Sensor], readers: Mapping[str, WireReader[Any]], clock: Clock
) -> MavlinkOut | None:
    """What sends a sector map to an autopilot, None if nothing shall. readers: by name of their wire.

    On a port that a MAVLink source has too, it speaks through that source's reader.
    """
    wanted = config.mavlink
    if not wanted.enabled:
        return None
    from service.mavlink_out import MavlinkOut, ReaderLink, Settings, sensor_type_of

    name = wanted.map or next(iter(config.sectors.polar))
    settings = Settings(
        source=name,
        footprint=config.robot.footprint_m,
        system_id=wanted.system_id,
        component_id=wanted.component_id,
        rate_hz=wanted.rate_hz,
        range_min_m=wanted.range_min_m,
        range_max_m=wanted.range_max_m,
        sensor_type=sensor_type_of(found[each].kind for each in _in_order(config, config.sectors.polar[name].sources)),
    )
    sharing = next((each for each in _mavlink_sources(config) if each[1] == wanted.port and each[0] in readers), None)
    if sharing is not None:
        return MavlinkOut(settings, partial(ReaderLink, readers[sharing[0]]), clock=clock)
    if wanted.port.startswith(UDP):
        return MavlinkOut(settings, partial(open_udp, wanted.port, clock), clock=clock)
    return MavlinkOut(settings, partial(open_serial, wanted.port, wanted.baud_bps, False, clock), clock=clock)


def _mavlink_sources(config: Config) -> list[tuple[str, str]]:
    """(source, port) of every MAVLink source; a wire is named like the first on it."""
    return [
        (config.source_name(section, name), device.port)
        for section, name, device in config.devices()
        if isinstance(device, MavlinkSonars | MavlinkWheels | MavlinkPose)
    ]
