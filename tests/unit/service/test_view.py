"""The page's server: whom it answers, what it sends, that it tells the living from the gone."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Awaitable, Callable
from pathlib import Path

import aiohttp
import pytest
import zenoh
from aiohttp.test_utils import TestClient, TestServer

import service.view
from service.commands.view import DRAWN
from service.relay import Sample
from service.view import ALIVE_KEY, PAGES_MAX, Relay, make_app
from tests.waiting import GIVE_UP_S

Task = Callable[[Relay, TestClient], Awaitable[None]]  # type: ignore[type-arg]


def with_page(task: Task) -> None:
    async def run() -> None:
        relay = Relay(asyncio.get_running_loop())
        async with TestClient(TestServer(make_app(relay))) as client:
            await asyncio.wait_for(task(relay, client), GIVE_UP_S)

    asyncio.run(run())


def split(message: bytes) -> tuple[str, bytes]:
    length = int.from_bytes(message[:2], "little")
    return message[2 : 2 + length].decode(), message[2 + length + 3 :]


@pytest.mark.parametrize("path", ["/", "/page.js", "/cdr.js", "/draw.js", "/overlays.js", "/page.css"])
def test_every_file_of_the_page_is_served_and_nothing_from_outside_allowed(path: str) -> None:
    async def task(_relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        reply = await client.get(path)
        assert reply.status == 200
        assert "default-src 'none'" in reply.headers["Content-Security-Policy"]
        text = await reply.text()
        assert "http://" not in text
        assert "https://" not in text

    with_page(task)


@pytest.mark.parametrize("path", ["/../view.py", "/page/../../view.py", "/secret", "/%2e%2e/view.py"])
def test_nothing_else_is_served(path: str) -> None:
    async def task(_relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        assert (await client.get(path)).status == 404

    with_page(task)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8765", "127.0.0.1.evil.example", "", "[bad"])
def test_a_foreign_name_is_refused(host: str) -> None:
    async def task(_relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        assert (await client.get("/", headers={"Host": host})).status == 403

    with_page(task)


def test_a_foreign_site_cannot_read_the_robot() -> None:
    async def task(_relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await client.ws_connect("/stream", headers={"Origin": "https://evil.example"})
        assert refused.value.status == 403

    with_page(task)


def test_a_late_page_gets_the_last_values_and_then_the_news() -> None:
    async def task(relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        relay.robot_from_thread("robots/a", True)
        relay.from_thread([Sample("robots/a/pose", b"old"), Sample("robots/a/pose", b"last")])
        await asyncio.sleep(0)
        async with client.ws_connect("/stream") as socket:
            first = [split((await socket.receive()).data) for _ in range(2)]
            assert first == [(ALIVE_KEY, b'["robots/a"]'), ("robots/a/pose", b"last")]
            relay.from_thread([Sample("robots/a/pose", b"new")])
            assert split((await socket.receive()).data) == ("robots/a/pose", b"new")
            relay.robot_from_thread("robots/a", False)
            assert split((await socket.receive()).data) == (ALIVE_KEY, b"[]")
        async with client.ws_connect("/stream") as late:
            key, payload = split((await late.receive()).data)
            assert (key, json.loads(payload)) == (ALIVE_KEY, [])
            with pytest.raises(asyncio.TimeoutError):
                await late.receive(timeout=0.1)

    with_page(task)


def test_the_number_of_pages_is_bounded() -> None:
    async def task(_relay: Relay, client: TestClient) -> None:  # type: ignore[type-arg]
        sockets = [await client.ws_connect("/stream") for _ in range(PAGES_MAX)]
        for socket in sockets:
            await socket.receive()
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await client.ws_connect("/stream")
        assert refused.value.status == 503
        await sockets[0].close()
        again = None
        while again is None:  # the server sees it a moment later
            try:
                again = await client.ws_connect("/stream")
            except aiohttp.WSServerHandshakeError:
                await asyncio.sleep(0.01)
        for socket in (*sockets[1:], again):
            await socket.close()

    with_page(task)


def test_after_the_loop_has_closed_samples_are_dropped_quietly() -> None:
    loop = asyncio.new_event_loop()
    relay = Relay(loop)
    loop.close()
    relay.from_thread([Sample("k", b"")])
    relay.robot_from_thread("robots/a", True)


def test_every_key_that_the_page_takes_is_subscribed_to_and_no_more() -> None:
    script = (Path(service.view.__file__).parent / "page" / "page.js").read_text()
    taken = [
        pattern.replace("([^/]+)", "x").replace("\\/", "/")
        for pattern in re.findall(r"^ {2}\[/\^(.*)\$/,", script, re.M)
    ]
    assert len(taken) > 10
    for key in taken:
        assert any(zenoh.KeyExpr(drawn).includes(zenoh.KeyExpr(key)) for drawn in DRAWN), key
    for drawn in DRAWN:
        assert any(zenoh.KeyExpr(drawn).includes(zenoh.KeyExpr(key)) for key in taken), drawn
