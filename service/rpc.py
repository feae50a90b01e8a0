"""Calls to the daemon: JSON in, JSON out, one at a time in a thread of its own, under `<base>/@rpc/<name>`.

A call that fails is answered with an error in words, never with silence. More calls than the queue holds are refused.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from service import zenoh_session
from service.errors import Trouble
from service.topics import JSON_REPLY, RPC

_LOG = logging.getLogger(__name__)
_WAITING_MAX = 16
_ARGUMENT_BYTES_MAX = 64 * 1024
_A_MAP = "a map: [grid] with a laser or sonars, and [store] enabled"
_NEEDS = {
    "save_map": _A_MAP,
    "load_map": _A_MAP,
    "new_map": _A_MAP,
    "list_maps": _A_MAP,
    "map_info": _A_MAP,
    "plan": "[rooms] enabled and a grid",
    "name_room": "[rooms] enabled and a grid",
    "where_am_i": "[scenes] enabled and a laser",
    "list_closures": "[slam] enabled and a laser",
    "undo_closure": "[slam] enabled and a laser",
    "relocalise": '[localise] mode = "map"',
}
"""What a daemon lacks that does not answer a call."""

Handler = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class CallRefused(Trouble):
    """Raised by a handler: the call cannot be done, and why. The text goes to the caller as it stands."""


class MapService(Protocol):
    """What the daemon does with whole maps; each answer is a JSON object."""

    def save(self, name: str) -> Mapping[str, Any]:
        """Write the map now, under this name in the daemon's folder; path, bytes, sha256, saved_at."""

    def load(self, name: str) -> Mapping[str, Any]:
        """Replace the live map by the one saved under this name."""

    def new(self, name: str | None) -> Mapping[str, Any]:
        """Keep the live map under this name, None: by the time, and begin an empty one where the robot stands."""

    def list(self) -> Mapping[str, Any]:
        """{"maps": [{name, path, bytes, ...}]}: what can be loaded."""

    def info(self) -> Mapping[str, Any]:
        """About the live map: size, cells, tiles, provenance."""


class Calls:
    """The registry of calls and the thread that works them off."""

    def __init__(self, base: str) -> None:
        self._base = base
        self._handlers: dict[str, Handler] = {}
        self._waiting: queue.Queue[Any] = queue.Queue(_WAITING_MAX)
        self._thread: threading.Thread | None = None
        self.answered = 0
        self.failed = 0
        self.refused = 0

    def register(self, name: str, handler: Handler) -> None:
        """Answer `@rpc/<name>` with handler(arguments). A handler raises CallRefused (or any Trouble) to decline."""
        if name in self._handlers:
            raise ValueError(f"the call {name!r} is registered already")
        self._handlers[name] = handler

    def register_map_service(self, service: MapService) -> None:
        """save_map, load_map, new_map, list_maps, map_info."""
        self.register("save_map", lambda arguments: service.save(map_name(arguments)))
        self.register("load_map", lambda arguments: service.load(map_name(arguments)))
        self.register("new_map", lambda arguments: service.new(map_name(arguments) if "name" in arguments else None))
        self.register("list_maps", lambda _arguments: service.list())
        self.register("map_info", lambda _arguments: service.info())

    @property
    def names(self) -> list[str]:
        """The calls there are, sorted."""
        return sorted(self._handlers)

    def start(self, session: Any) -> None:
        """Declare the queryable and start the thread."""
        self._thread = threading.Thread(target=self._run, name="calls", daemon=True)
        self._thread.start()
        zenoh_session.declare_queryable(session, f"{self._base}/{RPC}/*", self._on_query)

    def stop(self, deadline_s: float) -> None:
        """Let the call under way finish, within the deadline."""
        if self._thread is not None:
            try:
                self._waiting.put_nowait(None)
            except queue.Full:
                return  # daemon thread: it ends with the process
            self._thread.join(deadline_s)

    def _on_query(self, query: Any) -> None:
        try:
            self._waiting.put_nowait(query)
        except queue.Full:
            self.refused += 1
            with query:
                _reply_error(query, "busy: too many calls are waiting; try again")

    def _run(self) -> None:
        while (query := self._waiting.get()) is not None:
            with query:
                try:
                    self._answer(query)
                except Exception:  # the session may be closing: nobody is left to be told
                    self.failed += 1
                    _LOG.debug("a call could not be answered", exc_info=True)

    def _answer(self, query: Any) -> None:
        name = str(query.key_expr).removeprefix(f"{self._base}/{RPC}/")
        try:
            answer = self._call(name, b"" if query.payload is None else bytes(query.payload))
        except Trouble as trouble:
            self.failed += 1
            _reply_error(query, str(trouble))
        except Exception as error:
            self.failed += 1
            _LOG.exception("the call %s failed", name)
            _reply_error(query, f"{name} failed: {type(error).__name__}: {error}")
        else:
            self.answered += 1
            query.reply(f"{self._base}/{RPC}/{name}", answer, encoding=JSON_REPLY)

    def _call(self, name: str, payload: bytes) -> bytes:
        handler = self._handlers.get(name)
        if handler is None:
            need = _NEEDS.get(name)
            why = f"no call {name!r}" if need is None else f"{name} needs {need}"
            raise CallRefused(f"{why}; there are: {', '.join(self.names) or 'none'}")
        return json.dumps(dict(handler(_arguments(payload))), ensure_ascii=False).encode()


def map_name(arguments: Mapping[str, Any]) -> str:
    """The `name` of a map: one word, never a path."""
    name = arguments.get("name", "")
    if not isinstance(name, str) or not 0 < len(name) <= 64 or not all(c.isalnum() or c in "_-" for c in name):
        raise CallRefused('"name" must be one word of letters, digits, _ and - (at most 64), such as "kitchen"')
    return name


def _arguments(payload: bytes) -> Mapping[str, Any]:
    if len(payload) > _ARGUMENT_BYTES_MAX:
        raise CallRefused(f"arguments of {len(payload)} bytes: at most {_ARGUMENT_BYTES_MAX}")
    try:
        arguments = json.loads(payload or b"{}")
    except (ValueError, RecursionError) as error:
        raise CallRefused(f"the arguments are not JSON: {error}") from error
    if not isinstance(arguments, dict):
        raise CallRefused("the arguments must be a JSON object")
    return arguments


def _reply_error(query: Any, text: str) -> None:
    query.reply_err(json.dumps({"error": text}, ensure_ascii=False).encode(), encoding="application/json")
