"""Configuration to the maps that are made on the slow thread; each is imported where it is wanted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from service.assemble import geometry_of, sources_of
from service.config import Config
from service.sensors import Laser, Ring, Sensor

if TYPE_CHECKING:
    from mapping.planes.extract import PlaneRules
    from service.elevation_maker import ElevationMaker
    from service.layers import BuildingLayer
    from service.map_makers import MapMaker
    from service.sector_ground import SectorGroundTeller
    from service.wall_maker import WallMaker


def map_makers(config: Config, found: Mapping[str, Sensor]) -> list[MapMaker]:
    """The maps that are made on the slow thread."""
    makers: list[MapMaker] = []
    if config.planes.enabled and config.mounts:
        from service.plane_maker import PlaneMaker

        makers.append(PlaneMaker(_plane_rules(config), period_ns=round(config.planes.period_s * 1e9)))
    if config.elevation.enabled and config.mounts:
        makers.append(_elevation_maker(config))
    lasers = frozenset(name for name, sensor in found.items() if isinstance(sensor, Laser))
    if config.lines.enabled and (fed_by := lasers & sources_of(config, config.lines.sources, found)):
        from mapping.lines.line_map import LineMap
        from service.line_maker import LineMaker

        lines = config.lines
        period_ns = round(lines.period_s * 1e9)
        makers.append(LineMaker(LineMap(), fed_by, period_ns=period_ns, min_seen=lines.min_scans))
    if any(isinstance(sensor, Ring) for sensor in found.values()):
        from service.alice_maker import AliceMaker

        makers.append(AliceMaker())
    if config.topo.enabled and config.grid.enabled:
        from service.topo_maker import TopoMaker

        topo = config.topo
        period_ns = round(topo.period_s * 1e9)
        makers.append(TopoMaker(period_ns=period_ns, smooth_m=topo.smooth_m, door_m=topo.door_m))
    if config.places.enabled:
        makers.extend(_place_maker(config, found))
    if config.scenes.enabled and (fed_by := lasers & sources_of(config, config.scenes.sources, found)):
        from service.scene_maker import SceneMaker

        seen_by = [each for each in found.values() if isinstance(each, Laser) and each.name in fed_by]
        mounts = {each.name: each.base_from_sensor for each in seen_by}
        makers.append(SceneMaker(mounts, most=config.scenes.most, period_ns=round(config.scenes.period_s * 1e9)))
    if config.calibration.enabled and config.drive.source is not None:
        makers.extend(_calibration_maker(config, found))
    if _has_rooms(config, found):
        from service.room_maker import RoomMaker

        rooms = config.rooms
        across_m = [corner[1] for corner in config.robot.footprint_m]
        width_m = max(across_m) - min(across_m)
        makers.append(RoomMaker(period_ns=round(rooms.period_s * 1e9), clearance_m=rooms.clearance_m, width_m=width_m))
    if config.clearance.enabled and config.grid.enabled:
        from service.clearance_maker import ClearanceMaker

        wanted = config.clearance
        makers.append(
            ClearanceMaker(
                reach_m=wanted.reach_m,
                unknown_is_obstacle=wanted.unknown_is_obstacle,
                period_ns=round(wanted.period_s * 1e9),
            )
        )
    if config.agreement.enabled and config.grid.enabled:
        makers.extend(_agreement_maker(config, makers, lasers))
    return makers


def wall_maker(config: Config, found: Mapping[str, Sensor], building: BuildingLayer | None) -> WallMaker | None:
    """What shows the grid of the building by its walls; None if it is not wanted or no laser draws the grid."""
    lasers = frozenset(name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts)
    if building is None or not config.grid.crisp or not (fed_by := lasers & building.sources):
        return None
    from mapping.grids.live_walls import LiveWalls
    from service.wall_maker import WallMaker

    return WallMaker(LiveWalls(resolution_m=building.grid.resolution_m), fed_by, building.offer_walls)


def _agreement_maker(config: Config, makers: Sequence[MapMaker], lasers: frozenset[str]) -> Iterator[MapMaker]:
    """After the makers whose maps it compares; none if there is nothing to compare."""
    known = {maker.name: maker for maker in makers}
    if not known.keys() & {"lines", "rooms", "topo"}:
        return
    from service.agreement_maker import AgreementMaker
    from service.line_maker import LineMaker
    from service.room_maker import RoomMaker
    from service.topo_maker import TopoMaker

    lines, rooms, topo = (known.get(name) for name in ("lines", "rooms", "topo"))
    yield AgreementMaker(
        lines=lines if isinstance(lines, LineMaker) else None,
        rooms=rooms if isinstance(rooms, RoomMaker) else None,
        topo=topo if isinstance(topo, TopoMaker) else None,
        sources=lasers,
        period_ns=round(config.agreement.period_s * 1e9),
    )


def _calibration_maker(config: Config, found: Mapping[str, Sensor]) -> Iterator[MapMaker]:
    """None without a laser that looks level."""
    wanted = sources_of(config, config.calibration.sources, found)
    lasers = {name: each for name, each in found.items() if isinstance(each, Laser) and not each.tilts}
    mounts = {name: each.base_from_sensor for name, each in lasers.items() if name in wanted}
    if mounts:
        from service.calibration_maker import CalibrationMaker

        sections = {config.source_name(section, name): f"{section}.{name}" for section, name, _ in config.devices()}
        period_ns = round(config.calibration.period_s * 1e9)
        yield CalibrationMaker(geometry_of(config.drive), mounts, sections, period_ns=period_ns)


def _place_maker(config: Config, found: Mapping[str, Sensor]) -> Iterator[MapMaker]:
    """None without a laser that looks level."""
    from service.place_maker import PlaceMaker

    lasers = {name: each for name, each in found.items() if isinstance(each, Laser) and not each.tilts}
    if config.places.source is not None:
        wanted = config.source_name(*config.resolve(config.places.source))
        lasers = {name: each for name, each in lasers.items() if name == wanted}
    for name in sorted(lasers)[:1]:
        period_ns = round(config.places.period_s * 1e9)
        yield PlaceMaker(name, lasers[name].base_from_sensor, period_ns=period_ns)


def _has_rooms(config: Config, found: Mapping[str, Sensor]) -> bool:
    """Unless told: on a robot whose own grid a laser draws. Cones leave holes in walls, which would be doors."""
    if not config.grid.enabled:
        return False
    if config.rooms.enabled is not None:
        return config.rooms.enabled
    drawn_by = sources_of(config, config.grid.sources, found)
    lasers = {name for name, sensor in found.items() if isinstance(sensor, Laser) and not sensor.tilts}
    return config.localise.mode == "off" and bool(lasers & drawn_by)


def _elevation_maker(config: Config) -> ElevationMaker:
    from mapping.grids.height import GroundRules
    from service.elevation_maker import ElevationMaker

    wanted = config.elevation
    rules = GroundRules(
        slope_max_rad=math.radians(wanted.slope_max_deg),
        step_max_m=wanted.step_max_m,
        roughness_max_m=wanted.roughness_max_m,
    )
    return ElevationMaker(
        resolution_m=wanted.resolution_m,
        size_m=wanted.size_m,
        height_max_m=wanted.height_max_m,
        clouds=wanted.clouds,
        rules=rules,
        footprint=config.robot.footprint_m,
        period_ns=round(wanted.period_s * 1e9),
    )


def sector_ground(config: Config, makers: Sequence[MapMaker]) -> SectorGroundTeller | None:
    """What adds the ground to the sector maps; None without an elevation map."""
    if not (config.elevation.enabled and config.mounts):
        return None
    from service.elevation_maker import ElevationMaker
    from service.sector_ground import SectorGroundTeller

    for maker in makers:
        if isinstance(maker, ElevationMaker):
            return SectorGroundTeller(
                maker,
                footprint=config.robot.footprint_m,
                reach_m=config.elevation.sector_reach_m,
                hidden_m=config.elevation.sector_hidden_m,
                stale_ns=round(config.elevation.stale_s * 1e9),
            )
    return None


def _plane_rules(config: Config) -> PlaneRules:
    from mapping.planes.extract import PlaneRules, RangeNoise

    wanted = config.planes
    return PlaneRules(
        cell_m=wanted.cell_m,
        min_points=wanted.min_points,
        min_cells=wanted.min_cells,
        inlier_m=wanted.inlier_m,
        noise=None if wanted.sigma_m is None else RangeNoise(wanted.sigma_m),
    )
