"""Calls that look into the maps of the slow thread: each runs there, between two turns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from service.map_makers import MapMaker, MapMakers
from service.outputs import Output
from service.routes import Ways, route_answer
from service.rpc import CallRefused, Handler

if TYPE_CHECKING:
    from service.room_maker import RoomMaker

ROOMS = "rooms"
TOPO = "topo"


@runtime_checkable
class HasWays(Protocol):
    """A maker over whose map routes can be asked for."""

    def ways(self) -> Ways:
        """As it stands; CallRefused while there is nothing."""


def maker_calls(
    makers: Sequence[MapMaker], slow: MapMakers, offer: Callable[[Output], None]
) -> Iterator[tuple[str, Handler]]:
    """Every call that these makers can answer, by name. offer: where documents go that a call changes."""
    by_name = {maker.name: maker for maker in makers}
    if "scenes" in by_name:
        from service.scene_maker import SceneMaker

        scenes = by_name["scenes"]
        assert isinstance(scenes, SceneMaker)
        yield "where_am_i", partial(_ask, slow, scenes.where_am_i)
    if ROOMS in by_name:
        from service.room_maker import RoomMaker

        rooms = by_name[ROOMS]
        assert isinstance(rooms, RoomMaker)
        yield "plan", partial(_ask, slow, partial(_plan, rooms, offer))
        yield "name_room", partial(_ask, slow, partial(_name_room, rooms, offer))
    routed = {ROOMS if maker.name == ROOMS else TOPO: maker for maker in makers if isinstance(maker, HasWays)}
    if routed:
        yield "route", partial(_ask, slow, partial(route, routed))


def route(maps: Mapping[str, HasWays], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """The call @rpc/route. maps: "topo" (what map/topo tells) and "rooms", as far as there are.

    The argument "map" chooses; default: topo, or else rooms. The rest is route_answer's.
    """
    wanted = arguments.get("map", TOPO if TOPO in maps else ROOMS)
    if not isinstance(wanted, str) or wanted not in maps:
        raise CallRefused(f'"map": this daemon has {" and ".join(sorted(maps))}, got {wanted!r}')
    return {"map": wanted, **route_answer(maps[wanted].ways(), arguments)}


def _plan(rooms: RoomMaker, offer: Callable[[Output], None], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Plan, and tell everybody the way."""
    answer = rooms.plan(arguments)
    if (told := rooms.planned()) is not None:
        offer(told)
    return answer


def _name_room(rooms: RoomMaker, offer: Callable[[Output], None], arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Name a room, and tell everybody at once."""
    answer = rooms.name_room(arguments)
    for output in rooms.news():
        offer(output)
    return answer


def _ask(slow: MapMakers, answer: Handler, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    return slow.ask(partial(answer, arguments))
