"""The live page: a Zenoh client that relays what a robot publishes to browsers. Read-only, loopback only.

Nothing is decoded here but JSON that the page itself needs; payloads pass byte for byte (relay.py), so a page costs
the robot's computer next to nothing. A request whose Host is not ours is refused (a foreign site could otherwise make
a visitor's browser read the robot by rebinding its name to 127.0.0.1), a WebSocket from a foreign Origin as well.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import WSMsgType, web

from service.relay import Latest, Outbox, Sample, pack

_LOG = logging.getLogger(__name__)
_PAGE = Path(__file__).parent / "page"
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_FILES = {
    "/": "index.html",
    **{f"/{name}": name for name in ("page.js", "cdr.js", "draw.js", "overlays.js", "page.css")},
}
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_SEND_TIMEOUT_S = 10.0
PAGES_MAX = 32

ALIVE_KEY = "!alive"  # not a Zenoh key: tells pages which robots are there, as a JSON list of base keys


class Relay:
    """Fans samples out to pages. All methods but `from_thread` run on the event loop's thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._latest = Latest()
        self._alive: set[str] = set()
        self._pages: dict[object, tuple[Outbox, asyncio.Event]] = {}

    def from_thread(self, samples: Sequence[Sample]) -> None:
        """Hand samples over from a receiving thread; after the loop has closed they are dropped."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._put_all, samples)

    def robot_from_thread(self, base_key: str, alive: bool) -> None:
        """A robot's token came or went."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._robot, base_key, alive)

    def _put_all(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self._latest.put(sample)
            for outbox, ready in self._pages.values():
                outbox.put(sample)
                ready.set()

    def _robot(self, base_key: str, alive: bool) -> None:
        if alive:
            self._alive.add(base_key)
        else:
            self._alive.discard(base_key)
            self._latest.forget(base_key)
        note = self._alive_note()
        for outbox, ready in self._pages.values():
            outbox.put(note)
            ready.set()

    def _alive_note(self) -> Sample:
        return Sample(ALIVE_KEY, json.dumps(sorted(self._alive)).encode())

    async def serve_page(self, socket: web.WebSocketResponse) -> None:
        """Send everything to one page until it goes away."""
        outbox, ready = Outbox(), asyncio.Event()
        outbox.put(self._alive_note())
        for sample in self._latest:
            outbox.put(sample)
        ready.set()
        self._pages[socket] = (outbox, ready)
        sender = asyncio.create_task(self._send_loop(socket, outbox, ready))
        try:
            async for message in socket:  # pages have nothing to say; this notices that they close
                if message.type is WSMsgType.ERROR:
                    break
        finally:
            sender.cancel()
            del self._pages[socket]

    async def _send_loop(self, socket: web.WebSocketResponse, outbox: Outbox, ready: asyncio.Event) -> None:
        while True:
            await ready.wait()
            ready.clear()
            while (sample := outbox.take()) is not None:
                try:
                    async with asyncio.timeout(_SEND_TIMEOUT_S):
                        await socket.send_bytes(pack(sample))
                except (TimeoutError, ConnectionError):
                    await socket.close()
                    return

    @property
    def pages(self) -> int:
        """How many pages are open."""
        return len(self._pages)


def make_app(relay: Relay, *, hosts: Collection[str] = LOOPBACK_NAMES) -> web.Application:
    """The web application. hosts: names under which it may be asked for, without port."""

    @web.middleware
    async def guard(request: web.Request, handler: Callable[[web.Request], object]) -> web.StreamResponse:
        if _host_of("//" + request.headers.get("Host", "")) not in hosts:
            raise web.HTTPForbidden(text="unknown host name; see `umfeld view --allow-host`\n", headers=_HEADERS)
        return await handler(request)  # type: ignore[misc, no-any-return]

    async def page_file(request: web.Request) -> web.Response:
        name = _FILES[request.path]
        body = (_PAGE / name).read_bytes()
        return web.Response(body=body, content_type=_TYPES[Path(name).suffix], charset="utf-8", headers=_HEADERS)

    async def stream(request: web.Request) -> web.StreamResponse:
        origin = request.headers.get("Origin")
        if origin is not None and _host_of(origin) not in hosts:
            raise web.HTTPForbidden(text="foreign origin\n", headers=_HEADERS)
        if relay.pages >= PAGES_MAX:
            raise web.HTTPServiceUnavailable(text=f"{PAGES_MAX} pages are open already\n", headers=_HEADERS)
        socket = web.WebSocketResponse(heartbeat=5.0, max_msg_size=1024)
        await socket.prepare(request)
        await relay.serve_page(socket)
        return socket

    app = web.Application(middlewares=[guard])
    for path in _FILES:
        app.router.add_get(path, page_file)
    app.router.add_get("/stream", stream)
    return app


def _host_of(url: str) -> str:
    try:
        return (urlsplit(url).hostname or "").lower()
    except ValueError:
        return ""


async def serve(
    subscribe: Callable[[Relay], Callable[[], None]],
    *,
    port: int,
    on_ready: Callable[[str], None],
    hosts: Collection[str] = LOOPBACK_NAMES,
    stop: asyncio.Event | None = None,
) -> None:
    """Serve the page on 127.0.0.1 until stop is set or the task is cancelled.

    subscribe: given the relay, starts receiving and returns what ends it.  port: 0 takes a free one.
    on_ready: called with the address.  Raises OSError if the port is taken.
    """
    relay = Relay(asyncio.get_running_loop())
    runner = web.AppRunner(make_app(relay, hosts=hosts), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, "127.0.0.1", port)
        await site.start()
        unsubscribe = await asyncio.to_thread(subscribe, relay)
        try:
            on_ready(f"http://127.0.0.1:{runner.addresses[0][1]}/")
            await (stop or asyncio.Event()).wait()
        finally:
            await asyncio.to_thread(unsubscribe)
    finally:
        await runner.cleanup()


class Pump:
    """Drains a Zenoh channel in a thread of its own, many samples a hand-over."""

    def __init__(self, take: Callable[[], Sequence[Sample] | None], relay: Relay) -> None:
        """take: blocks for the next samples; None when the channel has closed."""
        self._take, self._relay = take, relay
        self._thread = threading.Thread(target=self._run, name="view-pump", daemon=True)

    def start(self) -> None:
        """Begin to drain."""
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait for the end, which comes when the channel closes."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (samples := self._take()) is not None:
            if samples:
                self._relay.from_thread(samples)
